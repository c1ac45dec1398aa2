#!/usr/bin/env python3
"""Scores a joined model beside the faces between its blocks, against a run on the whole scene.

    scripts/seam.py WHOLE CITY [--references DIR] [--nightsplat PROGRAM]

A pixel of a test view is in the band if the median depth of the run on the whole puts it within 5 % of the scene's span
of a face between two cores; all others are the rest. A score is the PSNR of all pixels of a part together, at 8 bits.
The seam is what the joined model gains over the whole in the band beyond what it gains in the rest: 0 if the faces do
no harm. References default to the dataset's photographs in normal light, the folder `high`.

For pinhole cameras without distortion in transforms_test.json. Needs numpy, Pillow and OpenEXR.
"""

import argparse
import json
import math
import pathlib
import subprocess
import tempfile
import tomllib

import numpy
import OpenEXR
from PIL import Image

BAND = 0.05


def faces_of(city):
    """Of each face between cores: its axis, its place, and the box of its core."""
    rows = tomllib.loads((city / "plan.toml").read_text())["block"]
    last = max(row["round"] for row in rows)
    for row in rows:
        if row["round"] == last:
            core = tomllib.loads((city / "blocks" / row["id"] / "block.toml").read_text())["core"]
            for axis, end in enumerate(core["to"]):
                if math.isfinite(end):
                    yield axis, end, numpy.array([core["from"], core["to"]])


def span_of(city):
    tiles = json.loads((city / "model/manifest.json").read_text())["tiles"]
    corners = [tile["bounds"] for tile in tiles if tile["bounds"]]
    return numpy.max([box["to"] for box in corners], 0) - numpy.min([box["from"] for box in corners], 0)


def points_of(camera, frame, depth):
    """The positions of all pixels in the world, (height, width, 3)."""
    value = {**camera, **frame}
    if any(value.get(key, 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")):
        raise SystemExit("cameras with distortion are not supported")
    rows, columns = numpy.indices(depth.shape) + 0.5
    right = (columns - value["cx"]) / value["fl_x"]
    down = (rows - value["cy"]) / value["fl_y"]
    local = numpy.stack([right, -down, -numpy.ones_like(right)], -1) * depth[..., None]
    to_world = numpy.array(value["transform_matrix"])
    return local @ to_world[:3, :3].T + to_world[:3, 3]


def in_band(points, faces, span):
    band = numpy.zeros(points.shape[:2], bool)
    for axis, end, core in faces:
        others = [other for other in range(3) if other != axis]
        beside = [(points[..., k] >= core[0, k]) & (points[..., k] < core[1, k]) for k in others]
        band |= (abs(points[..., axis] - end) <= BAND * span[axis]) & beside[0] & beside[1]
    return band


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("whole", type=pathlib.Path)
    parser.add_argument("city", type=pathlib.Path)
    parser.add_argument("--references", type=pathlib.Path)
    parser.add_argument("--nightsplat", default=pathlib.Path(__file__).parent.parent / "target/release/nightsplat")
    options = parser.parse_args()
    config = tomllib.loads((options.whole / "config.toml").read_text())
    dataset = options.whole / config["dataset"]
    references = options.references or dataset / "high"
    cameras = json.loads((dataset / "transforms_test.json").read_text())
    faces, span = list(faces_of(options.city)), span_of(options.city)
    errors, band = {"whole": [], "joined": []}, []
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for run, name, layer in [
            (options.whole, "depth", ["--layer", "depth", "--format", "exr"]),
            (options.whole, "whole", []),
            (options.city, "joined", []),
        ]:
            command = [options.nightsplat, "render", run, "--split", "test", "--out", folder / name, *layer]
            subprocess.run(command, check=True, capture_output=True)
        for frame in cameras["frames"]:
            name = pathlib.Path(frame["file_path"]).stem
            depth = OpenEXR.File(str(folder / f"depth/{name}.exr"), separate_channels=True).channels()["R"].pixels
            # Where there is no depth, the position is not a number, and beside no face.
            depth = numpy.where(numpy.isfinite(depth) & (depth > 0), depth, numpy.nan)
            band.append(in_band(points_of(cameras, frame, depth), faces, span))
            truth = numpy.asarray(Image.open(references / f"{name}.png").convert("RGB"), float)
            for kind, own in errors.items():
                image = numpy.asarray(Image.open(folder / kind / f"{name}.png").convert("RGB"), float)
                own.append(((image - truth) ** 2).mean(-1))
    band = numpy.concatenate([mask.ravel() for mask in band])
    errors = {kind: numpy.concatenate([one.ravel() for one in own]) for kind, own in errors.items()}

    def scores(part):
        return {kind: 10 * math.log10(255**2 / own[part].mean()) for kind, own in errors.items()}

    near, far = scores(band), scores(~band)
    gains = [part["joined"] - part["whole"] for part in (near, far)]
    print(f"band: {100 * band.mean():.0f} % of the pixels; whole {near['whole']:.2f}, joined {near['joined']:.2f} dB")
    print(f"rest: whole {far['whole']:.2f}, joined {far['joined']:.2f} dB")
    print(f"seam: {gains[0] - gains[1]:+.2f} dB")


if __name__ == "__main__":
    main()
