#!/usr/bin/env python3
"""Measures what noise below black is worth: sensor values whose sign is kept, against the same values cut at 0.

    scripts/black-noise.py [folder]

Makes a synthetic set in the folder (default: a temporary one), and from its references photographs in linear light, a
24th as bright, with normal noise; as EXR, once as they are and once cut at 0. Trains on both, without the denoiser, and
prints the scores of the test views against the references, also after alignment of brightness.

NIGHTSPLAT names the command (default: target/release/nightsplat, built first), STEPS the number of steps (700), SNR the
ratio of the median light of the set to the standard deviation of the noise in dB (-4), SEEDS the seeds (1).
"""

import array
import json
import os
import random
import struct
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from fisheye import command, read_png

DARKENING = 24


def linear(code):
    x = code / 255
    return x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4


def write_exr(path, width, height, planes):
    """Scanlines of floats without compression; planes are red, green, blue."""
    channel = b"".join(name + struct.pack("<xiiii", 2, 0, 1, 1) for name in (b"B", b"G", b"R"))
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = [
        ("channels", "chlist", channel + b"\0"), ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window), ("displayWindow", "box2i", window), ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)), ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    ]
    head = struct.pack("<2i", 20000630, 2)
    for name, kind, value in attributes:
        head += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    head += b"\0"
    row = 12 * width
    offsets = [len(head) + 8 * height + y * (8 + row) for y in range(height)]
    with open(path, "wb") as file:
        file.write(head + struct.pack(f"<{height}Q", *offsets))
        for y in range(height):
            file.write(struct.pack("<2i", y, row))
            for plane in reversed(planes):
                file.write(array.array("f", plane[y * width:(y + 1) * width]).tobytes())


def main():
    program = command()
    run = lambda *arguments: subprocess.run([program, *map(str, arguments)], check=True, capture_output=True, text=True)
    root = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    kept, cut = root / "kept", root / "cut"
    run("synth", kept, "--views", 48, "--overwrite")
    run("synth", cut, "--views", 48, "--overwrite")
    table = [linear(code) / DARKENING for code in range(256)]
    files = sorted((kept / "high").iterdir())
    pictures = {file.stem: read_png(file) for file in files}
    middle = median(table[code] for _, rows in pictures.values() for row in rows for code in row[1::3])
    sigma = middle * 10 ** (-float(os.environ.get("SNR", "-4")) / 20)
    noise = random.Random(1)
    for stem, (width, rows) in pictures.items():
        codes = [code for row in rows for code in row]
        planes = [[table[code] + noise.gauss(0, sigma) for code in codes[channel::3]] for channel in range(3)]
        for folder, least in [(kept, float("-inf")), (cut, 0.0)]:
            (folder / "low" / f"{stem}.png").unlink()
            signed = [[max(value, least) for value in plane] for plane in planes]
            write_exr(folder / "low" / f"{stem}.exr", width, len(rows), signed)
    for folder in (kept, cut):
        frames = folder / "transforms_train.json"
        frames.write_text(frames.read_text().replace(".png", ".exr"))
    for seed in os.environ.get("SEEDS", "1").split():
        for folder in (kept, cut):
            out = root / "run"
            plain = ["--overwrite", "--set", "model.denoiser=false"]
            run("train", folder, "--out", out, "--steps", os.environ.get("STEPS", "700"), "--seed", seed, *plain)
            mean = json.loads(run("eval", out, "--align", "--json").stdout)["mean"]
            scores = {name: round(value, 4) for name, value in mean.items() if isinstance(value, float)}
            print(folder.name, "seed", seed, scores, flush=True)


if __name__ == "__main__":
    main()
