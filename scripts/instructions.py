#!/usr/bin/env python3
"""Counts the instructions of what runs on the processor, by callgrind: scripts/instructions.py [--write] NIGHTSPLAT

Seconds of a shared machine scatter by a tenth and more, instructions by less than a thousandth. The counts of each path
are compared with docs/instructions.csv: a path that takes over 3 % more fails, one that takes over 3 % less asks for
`--write`. They are those of the dev profile and of the compiler that the table names; with another compiler they are
printed, and nothing fails. The kernels' instructions are in docs/gpu-compilers.
"""
import csv
import os
import pathlib
import re
import struct
import subprocess
import sys
import tempfile

TABLE = pathlib.Path(__file__).parent.parent / "docs/instructions.csv"
TOLERANCE = 0.03

# What a path does, and its command; the first ones make what the next ones read.
PATHS = {
    "ray-trace and encode a set": "synth {set} --views 8 --width 64 --height 48",
    "decode pairs and fit a curve to them": "tone fit {set} --curves ap3 --json",
    "sort, quantise and pack a model as SOG": "export {model} --format sog --out {out}/a.sog",
    "pack a model as SPZ": "export {model} --format spz --out {out}/a.spz",
    "read SPZ, rotate with its harmonics, write PLY": "edit {out}/a.spz --rotate 0,0,30 --out {out}/b.ply",
}


def model(path, count=20000):
    """Writes a PLY of Gaussians of degree 3 on a spiral, the same bytes everywhere."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    with open(path, "wb") as file:
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
        header += [f"property float {name}" for name in names] + ["end_header", ""]
        file.write("\n".join(header).encode())
        for index in range(count):
            # Quotients of integers: the same in every language and on every machine.
            value = lambda column: ((index * 7919 + column * 104729) % 2003) / 1001.5 - 1
            row = [value(column) for column in range(51)] + [value(51), -4 + value(52), -4 + value(53), -4 + value(54)]
            file.write(struct.pack(f"<{len(names)}f", *row, 1.0, value(56), value(57), value(58)))


def instructions(command):
    environment = {**os.environ, "RAYON_NUM_THREADS": "1", "LP_NUM_THREADS": "0", "NIGHTSPLAT_TUNE": "off"}
    run = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", *command]
    result = subprocess.run(run, env=environment, capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(command)}: {result.stderr[-2000:]}")
    return int(re.search(r"Collected : (\d+)", result.stderr).group(1))


def compiler():
    return subprocess.run(["rustc", "--version"], capture_output=True, text=True, check=True).stdout.strip()


def main():
    *options, program = sys.argv[1:]
    counted = {}
    with tempfile.TemporaryDirectory() as folder:
        paths = {"set": f"{folder}/set", "model": f"{folder}/model.ply", "out": folder}
        model(paths["model"])
        for path, command in PATHS.items():
            counted[path] = instructions([os.path.abspath(program), *command.format(**paths).split()])
    rows = list(csv.DictReader(TABLE.open())) if TABLE.exists() else []
    known = {row["path"]: int(row["instructions"]) for row in rows if row["compiler"] == compiler()}
    worse, better = [], []
    for path, count in counted.items():
        change = count / known[path] - 1 if path in known else None
        print(f"{count / 1e6:10.1f} million  {path}" + (f"  ({change:+.1%})" if change is not None else ""))
        if change is not None and abs(change) > TOLERANCE:
            (worse if change > 0 else better).append(path)
    if "--write" in options:
        with TABLE.open("w", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(["path", "instructions", "compiler"])
            table.writerows([path, count, compiler()] for path, count in counted.items())
    elif worse:
        sys.exit(f"more instructions than in {TABLE.name}: {', '.join(worse)}; mend it, or say why and pass --write")
    elif better:
        sys.exit(f"fewer instructions than in {TABLE.name}: {', '.join(better)}; keep them with --write")


if __name__ == "__main__":
    main()
