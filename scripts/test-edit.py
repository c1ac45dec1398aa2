#!/usr/bin/env python3
"""Compares `nightsplat edit` with PlayCanvas' splat-transform, an implementation of its own.

    scripts/test-edit.py [NIGHTSPLAT]      (default: target/release/nightsplat, or debug)

Both crop, rotate, scale, move and merge the same random model of SH degree 3; every number of every Gaussian must
agree. Needs Python and npm, which fetches splat-transform into a folder that is removed; without npm, or where it
cannot fetch, this says that it is not run.
"""

import array
import math
import pathlib
import random
import shutil
import subprocess
import sys
import tempfile

SPLAT_TRANSFORM = "@playcanvas/splat-transform@3.7.0"
NAMES = (
    ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{k}" for k in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)
TOLERANCE = 2e-6


def write(path, rows):
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in NAMES] + ["end_header", ""]
    values = array.array("f", [value for row in rows for value in row])
    path.write_bytes("\n".join(header).encode() + values.tobytes())


def read(path):
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    values = array.array("f", data[end:])
    places = [place(name, names) for name in NAMES]
    rows = [values[at : at + len(names)] for at in range(0, len(values), len(names))]
    return [[0.0 if at is None else row[at] for at in places] for row in rows]


def place(name, names):
    """The column of a property of degree 3 in a file of any degree; None where its degree has no such coefficient."""
    if not name.startswith("f_rest_"):
        return names.index(name)
    channel, coefficient = divmod(int(name[len("f_rest_") :]), 15)
    own = sum(other.startswith("f_rest_") for other in names) // 3
    return names.index(f"f_rest_{channel * own + coefficient}") if coefficient < own else None


def model(seed, count=300):
    draw = random.Random(seed)
    return [[draw.uniform(-1, 1) for _ in NAMES] for _ in range(count)]


def unit(row):
    """The row with a unit quaternion whose largest component is positive: all others are the same rotation."""
    rotation = row[-4:]
    largest = max(rotation, key=abs)
    length = math.copysign(math.sqrt(sum(part * part for part in rotation)), largest)
    return row[:-4] + [part / length for part in rotation]


def axis_and_angle(x, y, z):
    """The axis and angle of splat-transform's `--rotate x,y,z` in the axes of a PLY, by quaternions.

    It rotates about x, then y, then z, in axes that are the file's turned by half a turn about z.
    """

    def times(a, b):
        return (
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        )

    def about(axis, degrees):
        half = math.radians(degrees) / 2
        return (math.cos(half),) + tuple(math.sin(half) if k == axis else 0.0 for k in range(3))

    w, i, j, k = times(about(2, z), times(about(1, y), about(0, x)))
    axis = (-i, -j, k)
    degrees = 2 * math.degrees(math.atan2(math.sqrt(sum(part * part for part in axis)), w))
    return ",".join(repr(part) for part in axis) + f":{degrees!r}"


# Name, arguments of nightsplat, arguments of splat-transform; B is the second model.
CASES = [
    ("box", ["--crop", "-0.5,-0.25,-1,0.5,0.75,0.5"], ["--filter-box", "-0.5,-0.75,-1,0.5,0.25,0.5"]),
    ("sphere", ["--crop", "0.25,0.5,0,0.75"], ["--filter-sphere", "-0.25,-0.5,0,0.75"]),
    ("rotation", ["--rotate", axis_and_angle(20, 37, -50)], ["--rotate", "20,37,-50"]),
    ("move", ["--move", "1,2,-3"], ["--translate", "-1,-2,-3"]),
    ("scale", ["--scale", "2.5"], ["--scale", "2.5"]),
    ("degree", ["--sh-degree", "1"], ["--filter-harmonics", "1"]),
    ("merge", ["--merge", "B"], ["B"]),
    (
        "order",
        ["--rotate", axis_and_angle(20, 37, -50), "--move", "1,2,-3", "--merge", "B", "--scale", "0.5"],
        None,
    ),
]


def agree(name, ours, theirs):
    ours, theirs = [sorted(map(unit, rows)) for rows in (ours, theirs)]
    if len(ours) != len(theirs):
        sys.exit(f"{name}: {len(ours)} Gaussians, splat-transform has {len(theirs)}")
    largest = 0.0
    for own, other in zip(ours, theirs):
        difference = max(abs(a - b) / max(1.0, abs(b)) for a, b in zip(own, other))
        largest = max(largest, difference)
        if difference > TOLERANCE:
            column = max(range(len(NAMES)), key=lambda k: abs(own[k] - other[k]))
            sys.exit(f"{name}: {NAMES[column]} is {own[column]}, splat-transform has {other[column]}")
    print(f"{name}: {len(ours)} Gaussians agree within {largest:.1e}")


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
        return not_run("comparing edits with splat-transform: there is no npm")
    nightsplat = program()
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        install = ["npm", "install", "--no-audit", "--no-fund", "--silent", "--prefix", folder, SPLAT_TRANSFORM]
        if subprocess.run(install, check=False).returncode != 0:
            return not_run("comparing edits with splat-transform: npm could not fetch it")
        splat_transform = folder / "node_modules/.bin/splat-transform"
        a, b, out, other = [folder / name for name in ("a.ply", "b.ply", "ours.ply", "theirs.ply")]
        write(a, model(1))
        write(b, model(2, 200))
        for name, own, theirs in CASES:
            own = [str(b) if argument == "B" else argument for argument in own]
            subprocess.run([nightsplat, "edit", a, *own, "--out", out], check=True, stdout=subprocess.DEVNULL)
            if theirs is None:
                # Its actions before an input apply to the inputs before it; later ones to the result.
                first = ["--rotate", "20,37,-50", "--translate", "-1,-2,-3"]
                theirs = [*first, str(b), str(other), "--scale", "0.5"]
            else:
                theirs = [str(b) if argument == "B" else argument for argument in theirs] + [str(other)]
            subprocess.run([splat_transform, "-q", "-w", a, *theirs], check=True, stdout=subprocess.DEVNULL)
            agree(name, read(out), read(other))


if __name__ == "__main__":
    sys.exit(main())
