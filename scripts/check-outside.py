#!/usr/bin/env python3
"""Compiles the examples and the programs of the crate's first page as a host does: without the feature `testing`.

Within the repository, tests switch that feature on for examples and documentation as well. The example of an embedding
host is also built as a renderer alone, without files but PLY, and draws a frame.
"""

import os
import re
import shutil
import struct
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Examples that use private items.
INSTRUMENTS = ["growth"]

MANIFEST = """\
[package]
name = "outside"
version = "0.0.0"
edition = "2024"
publish = false

[dependencies]
nightsplat = {{ path = "{root}", default-features = false, features = {features} }}

[workspace]

{profile}"""

PAGE = "fn main() -> nightsplat::Result<()> {{\n{code}\n}}\n"


def main() -> None:
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    package = target / "outside"
    programs = package / "src/bin"
    programs.mkdir(parents=True, exist_ok=True)
    for old in programs.iterdir():
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    # The profile with which the dependencies are already compiled.
    manifest = (ROOT / "Cargo.toml").read_text()
    profile = re.search(r"^\[profile\.dev\].*?(?=^\[profile\.release\])", manifest, re.M | re.S)

    def write_manifest(features: str) -> None:
        text = MANIFEST.format(root=ROOT, features=features, profile=profile[0])
        (package / "Cargo.toml").write_text(text)

    write_manifest('["glslang", "io"]')
    (package / "Cargo.lock").write_bytes((ROOT / "Cargo.lock").read_bytes())
    for example in (ROOT / "examples").glob("*.rs"):
        if example.stem not in INSTRUMENTS:
            (programs / example.name).write_text(example.read_text())
    lines = (ROOT / "src/lib.rs").read_text().splitlines()
    page = "\n".join(line.removeprefix("//!") for line in lines if line.startswith("//!"))
    for number, code in enumerate(re.findall(r"```no_run\n(.*?)```", page, re.DOTALL)):
        # Hidden lines are part of the program.
        code = "\n".join(line.strip().removeprefix("# ") for line in code.splitlines())
        (programs / f"page{number}.rs").write_text(PAGE.format(code=code))
    environment = os.environ | {"CARGO_TARGET_DIR": str(target)}
    subprocess.run(["cargo", "check", "--bins"], cwd=package, env=environment, check=True)

    write_manifest('["glslang"]')
    model, picture = target / "outside/model.ply", target / "outside/frame.ppm"
    write_model(model)
    draw = ["cargo", "run", "--quiet", "--bin", "embed", "--", str(model), str(picture)]
    subprocess.run(draw, cwd=package, env=environment, check=True)
    pixels = picture.read_bytes()[-3 * 320 * 240 :]
    assert max(pixels) > 100 and min(pixels) == 0, "the embedding host drew nothing"


def write_model(path: Path) -> None:
    """A row of ten white Gaussians in the INRIA layout, without SH above degree 0."""
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 10\n{properties}end_header\n"
    rows = ([x - 4.5, 0, 0, 0, 0, 0, 1.7, 1.7, 1.7, 4, -1, -1, -1, 1, 0, 0, 0] for x in range(10))
    path.write_bytes(header.encode() + b"".join(struct.pack("<17f", *row) for row in rows))


if __name__ == "__main__":
    main()
