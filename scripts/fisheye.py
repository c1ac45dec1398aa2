#!/usr/bin/env python3
"""Measures the gain of a native fisheye over the same photographs undistorted and cropped.

    scripts/fisheye.py [folder]

Makes a synthetic fisheye set in the folder (default: a temporary one), replaces its dark photographs by its references,
and trains twice: native, and with --undistort. Both models are scored against ray-traced references:

- in the fisheye's test views, on the pixels that the undistorted photographs also show
- in a pinhole's test views from the same poses, at half the size, where a pixel is about as large as in either training

NIGHTSPLAT names the command (default: target/release/nightsplat, built first), STEPS the number of steps (1500).
"""

import json
import math
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STEPS = os.environ.get("STEPS", "1500")
SIZE = ["--views", "24", "--width", "160", "--height", "120"]
# The angle off the axis at the corners of an undistorted photograph.
WIDEST = math.radians(60)


def command():
    if "NIGHTSPLAT" in os.environ:
        return os.environ["NIGHTSPLAT"]
    subprocess.run(["cargo", "build", "--release", "--bin", "nightsplat"], check=True, cwd=ROOT)
    return str(Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release" / "nightsplat")


def read_png(path):
    """Width and rows of an 8-bit RGB file."""
    data, at, packed = path.read_bytes(), 8, b""
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, color = struct.unpack(">IIBB", body[:10])
            assert (depth, color) == (8, 2), f"{path} is not RGB in 8 bits"
        elif kind == b"IDAT":
            packed += body
        at += 12 + length
    raw, stride, rows = zlib.decompress(packed), 3 * width, []
    before = bytearray(stride)
    for y in range(height):
        kind, *row = raw[y * (stride + 1) : (y + 1) * (stride + 1)]
        for i in range(stride):
            left, corner = (row[i - 3], before[i - 3]) if i >= 3 else (0, 0)
            guess = left + before[i] - corner
            nearest = min((left, before[i], corner), key=lambda value: abs(guess - value))
            row[i] = (row[i] + (0, left, before[i], (left + before[i]) // 2, nearest)[kind]) & 255
        rows.append(row)
        before = row
    return width, rows


def shown_by_both(set_folder):
    """By row and column: whether the undistorted photograph shows the centre of that pixel of the fisheye."""
    listing = json.loads((set_folder / "transforms_train.json").read_text())
    width, height = int(listing["w"]), int(listing["h"])
    fx, fy, cx, cy = (listing[key] for key in ("fl_x", "fl_y", "cx", "cy"))
    k = [listing[f"k{i}"] for i in (1, 2, 3, 4)]

    def radius(angle):
        return angle + sum(k[i] * angle ** (2 * i + 3) for i in range(4))

    def angle_of(distance):
        low, high = 0.0, math.pi / 2
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if radius(middle) <= distance else (low, middle)
        return low

    corners = [(x, y) for x in (0.5, width - 0.5) for y in (0.5, height - 0.5)]
    farthest = max(math.hypot((x - cx) / fx, (y - cy) / fy) for x, y in corners)
    zoom = farthest / math.tan(WIDEST)

    def is_shown(x, y):
        u, v = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
        distance = math.hypot(u, v)
        slope = math.tan(min(angle_of(distance), 1.5)) / max(distance, 1e-9)
        px, py = u * slope * zoom * fx + cx, v * slope * zoom * fy + cy
        return 0.5 <= px <= width - 0.5 and 0.5 <= py <= height - 0.5

    return [[is_shown(x, y) for x in range(width)] for y in range(height)]


def psnr(render, reference, counts):
    (width, own), (_, other) = read_png(render), read_png(reference)
    pixels = [(y, x) for y in range(len(own)) for x in range(width) if counts[y][x]]
    squares = (
        (own[y][3 * x + c] - other[y][3 * x + c]) ** 2 for y, x in pixels for c in range(3)
    )
    return 10 * math.log10(255**2 / (sum(squares) / (3 * len(pixels))))


def configured(run, copy, **values):
    """A copy of a run with changed values in its configuration."""
    shutil.copytree(run, copy)
    lines = (copy / "config.toml").read_text().splitlines()
    for key, value in values.items():
        lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in lines]
    (copy / "config.toml").write_text("\n".join(lines) + "\n")
    return copy


def main(folder):
    nightsplat = command()

    def run(*arguments):
        done = subprocess.run([nightsplat, *map(str, arguments)], capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"{' '.join(map(str, arguments))}: {done.stderr}")
        return done.stdout

    fisheye, pinhole = folder / "fisheye", folder / "pinhole"
    run("synth", fisheye, "--fisheye", *SIZE)
    run("synth", pinhole, *SIZE)
    for picture in (fisheye / "high").iterdir():
        shutil.copy(picture, fisheye / "low")
    counts = shown_by_both(fisheye)
    share = sum(map(sum, counts)) / (len(counts) * len(counts[0]))
    print(f"both show {100 * share:.0f} % of the fisheye's pixels")
    plain = ["--plan", "none", "--model", "plain", "--curve", "none", "--steps", STEPS, "--seed", "1"]
    for name, options in [("native", []), ("undistorted", ["--undistort"])]:
        trained = folder / name
        run("train", fisheye, "--out", trained, *plain, *options)
        as_fisheye = configured(trained, folder / f"{name}-fisheye", undistort="false")
        renders = folder / f"{name}-renders"
        run("render", as_fisheye, "--split", "test", "--out", renders)
        scores = [psnr(own, fisheye / "high" / own.name, counts) for own in sorted(renders.glob("*.png"))]
        halved = configured(trained, folder / f"{name}-pinhole", downscale="2.0")
        of_pinhole = json.loads(run("eval", halved, "--dataset", pinhole, "--json"))
        mean = sum(scores) / len(scores)
        print(f"{name}: {mean:.2f} dB in the fisheye, {of_pinhole['mean']['psnr']:.2f} dB in the pinhole")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
