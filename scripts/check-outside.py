#!/usr/bin/env python3
"""Compiles the examples and the programs of the crate's first page as a host does: without the feature `testing`.

Within the repository, tests switch that feature on for examples and documentation as well.
"""

import os
import re
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
nightsplat = {{ path = "{root}", default-features = false, features = ["glslang", "io"] }}

[workspace]

{profile}"""

PAGE = "fn main() -> nightsplat::Result<()> {{\n{code}\n}}\n"


def main() -> None:
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    package = target / "outside"
    programs = package / "src/bin"
    programs.mkdir(parents=True, exist_ok=True)
    for old in programs.iterdir():
        old.unlink()
    # The profile with which the dependencies are already compiled.
    manifest = (ROOT / "Cargo.toml").read_text()
    profile = re.search(r"^\[profile\.dev\].*?(?=^\[profile\.release\])", manifest, re.M | re.S)
    (package / "Cargo.toml").write_text(MANIFEST.format(root=ROOT, profile=profile[0]))
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


if __name__ == "__main__":
    main()
