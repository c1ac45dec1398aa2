#!/usr/bin/env python3
"""Builds the example of an embedding host with a renderer alone, without files but PLY and without training, and draws
a frame."""

import os
import struct
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    model, picture = target / "renderer.ply", target / "renderer.ppm"
    target.mkdir(parents=True, exist_ok=True)
    write_model(model)
    alone = ["--no-default-features", "--features", "glslang"]
    draw = ["cargo", "run", "--quiet", *alone, "--example", "embed", "--", str(model), str(picture)]
    subprocess.run(draw, cwd=ROOT, check=True)
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
