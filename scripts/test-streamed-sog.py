#!/usr/bin/env python3
"""Reads streamed SOG back with PlayCanvas' splat-transform, an implementation of its own.

    scripts/test-streamed-sog.py [NIGHTSPLAT]      (default: target/release/nightsplat, or debug)

Trains a small synthetic street as a whole and in two blocks, exports three levels of detail of each model in small
chunks, and requires of each level that splat-transform reads that its Gaussians are ours within the precision of the
format, and that it scores within 0.5 dB of ours. Needs Python and npm, which fetches splat-transform into a folder that
is removed; without npm, or where it cannot fetch, this says that it is not run.
"""

import array
import json
import math
import pathlib
import shutil
import subprocess
import sys
import tempfile

SPLAT_TRANSFORM = "@playcanvas/splat-transform@3.7.0"
LEVELS, CHUNK = 3, 512
MOST_DB = 0.5
# Differences of positions (plots), ln scales, opacities, and colours (SH): of 98 % at most, and on average. Codebooks
# have few codes for what is rare.
MOST = [1e-3, 0.1, 0.004, 0.1]
MEAN = [1e-4, 0.02, 0.002, 0.02]


def read(path):
    """The header, and a row a Gaussian: position, ln scales in ascending order, opacity, SH of degree 0."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    values = array.array("f", data[end:])
    at = {name: place for place, name in enumerate(names)}
    rows = []
    for start in range(0, len(values), len(names)):
        own = {name: values[start + place] for name, place in at.items()}
        scales = sorted(own[f"scale_{k}"] for k in range(3))
        opacity = 1 / (1 + math.exp(-own["opacity"]))
        rows.append([own["x"], own["y"], own["z"], *scales, opacity, *(own[f"f_dc_{k}"] for k in range(3))])
    return lines, rows


def differences(own, other):
    by_place = {}
    for row in other:
        by_place.setdefault(tuple(math.floor(value) for value in row[:3]), []).append(row)

    def nearest(row):
        x, y, z = (math.floor(value) for value in row[:3])
        around = [
            candidate
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            for k in (-1, 0, 1)
            for candidate in by_place.get((x + i, y + j, z + k), [])
        ]
        return min(around, key=lambda candidate: math.dist(candidate[:3], row[:3]))

    def of_pair(a, b):
        most = lambda start, end: max(abs(a[k] - b[k]) for k in range(start, end))
        return [math.dist(a[:3], b[:3]), most(3, 6), most(6, 7), most(7, 10)]

    return list(zip(*(of_pair(row, nearest(row)) for row in own)))


def agree(level, own, other):
    if len(own) != len(other):
        sys.exit(f"{level}: {len(own)} Gaussians, splat-transform has {len(other)}")
    columns = differences(own, other)
    most = [sorted(column)[len(column) * 98 // 100] for column in columns]
    mean = [sum(column) / len(column) for column in columns]
    if any(a > b for a, b in zip(most + mean, MOST + MEAN)):
        sys.exit(f"{level}: positions, scales, opacities, colours differ by {most}, {mean} on average")
    return mean


def with_facts(path, lines):
    """Adds what our header states and splat-transform does not keep."""
    facts = "".join(f"{line}\n" for line in lines if line.startswith("comment nightsplat "))
    first, rest = path.read_bytes().split(b"element vertex", 1)
    path.write_bytes(first + facts.encode() + b"element vertex" + rest)


def program():
    if len(sys.argv) > 1:
        return sys.argv[1]
    root = pathlib.Path(__file__).parent.parent
    built = [root / "target" / profile / "nightsplat" for profile in ("release", "debug")]
    return next((str(path) for path in built if path.exists()), None) or sys.exit("build nightsplat first")


def not_run(why):
    return subprocess.call([pathlib.Path(__file__).parent / "not-run.sh", "npm", why])


def main():
    if not shutil.which("npm"):
        return not_run("reading streamed SOG with splat-transform: there is no npm")
    nightsplat = program()

    def run(*arguments):
        arguments = [nightsplat, *map(str, arguments)]
        return subprocess.run(arguments, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout

    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        install = ["npm", "install", "--no-audit", "--no-fund", "--silent", "--prefix", folder, SPLAT_TRANSFORM]
        if subprocess.run(install, check=False).returncode != 0:
            return not_run("reading streamed SOG with splat-transform: npm could not fetch it")
        splat_transform = folder / "node_modules/.bin/splat-transform"
        data, whole, city = folder / "set", folder / "run", folder / "city"
        run("synth", data, "--street", 5)
        run("train", data, "--out", whole, "--steps", 400, "--plan", "none", "--progress", "none")
        run("blocks", "plan", data, "--out", city, "--blocks", 2, "--steps", 800, "--plan", "none")
        run("blocks", "run", city)

        def score(model):
            return json.loads(run("eval", model, "--dataset", data, "--json"))["mean"]["psnr"]

        for name, model in [("whole", whole), ("joined", city)]:
            streamed = folder / f"{name}-streamed"
            run("export", model, "--format", "streamed-sog", "--levels", LEVELS, "--chunk", CHUNK, "--out", streamed)
            for level in range(LEVELS):
                ours, theirs = (folder / f"{name}-{level}-{whose}.ply" for whose in ("ours", "theirs"))
                run("export", model, "--format", "ply", "--level", level, "--chunk", CHUNK, "--out", ours)
                select = ["-q", "-w", "-g", "cpu", "-L", str(level), streamed / "lod-meta.json", theirs]
                subprocess.run([splat_transform, *select], check=True, stdout=subprocess.DEVNULL)
                (lines, own), (_, other) = read(ours), read(theirs)
                mean = agree(f"{name}, level {level}", own, other)
                with_facts(theirs, lines)
                scores = [score(ours), score(theirs)]
                if abs(scores[0] - scores[1]) > MOST_DB:
                    compared = f"{scores[0]:.2f} dB, {scores[1]:.2f} dB as splat-transform reads it"
                    sys.exit(f"{name}, level {level}: {compared}")
                mean = ", ".join(f"{value:.1e}" for value in mean)
                print(
                    f"{name}, level {level}: {len(own)} Gaussians agree within {mean}; "
                    f"{scores[0]:.2f} and {scores[1]:.2f} dB"
                )


if __name__ == "__main__":
    sys.exit(main())
