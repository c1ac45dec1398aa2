#!/usr/bin/env python3
"""Measures `nightsplat blocks join`: time and peak memory by the number of Gaussians.

    scripts/measure-join.py [NIGHTSPLAT [MILLIONS...]]      (default: target/release/nightsplat, 1 2 4)

Plans a small street in four blocks and trains each for a few steps. Then puts models of random Gaussians with all
spherical harmonics in place of the trained ones, a sixth of them outside the core, and joins them. Needs numpy, and
500 bytes of disk a Gaussian.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time
import tomllib

import numpy

REST = 45
NAMES = [
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{k}" for k in range(3)),
    *(f"f_rest_{k}" for k in range(REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
# Ends of the street, for cores that reach to infinity.
ENDS = [0.0, 24.0]


def write_model(block, count, random):
    """A model of `count` Gaussians in the core of a block and a fifth of that around it."""
    core = tomllib.loads((block / "block.toml").read_text())["core"]
    low, high = (numpy.clip(core[key][0], *ENDS) for key in ("from", "to"))
    around = 0.1 * (high - low)
    header = ["ply", "format binary_little_endian 1.0", "comment nightsplat near 0.1"]
    header += [f"element vertex {count * 6 // 5}", *(f"property float {name}" for name in NAMES), "end_header", ""]
    with open(block / "run/model.ply", "wb") as file:
        file.write("\n".join(header).encode())
        left = count * 6 // 5
        while left > 0:
            rows = random.random((min(left, 1 << 16), len(NAMES)), numpy.float32) - numpy.float32(0.5)
            x = rows[:, 0] + 0.5
            # A sixth lies beside the core, on the side where it ends.
            inner = low if numpy.isinf(core["from"][0]) else low - around
            outer = high if numpy.isinf(core["to"][0]) else high + around
            rows[:, 0] = inner + x * (outer - inner)
            rows.tofile(file)
            left -= len(rows)


def joined(nightsplat, city):
    """Seconds of processor and wall time, and bytes at the peak; what the join prints."""
    begin = time.monotonic()
    with open(city / "log", "w+") as log:
        process = os.posix_spawn(
            nightsplat,
            [nightsplat, "blocks", "join", str(city)],
            os.environ,
            file_actions=[(os.POSIX_SPAWN_DUP2, log.fileno(), 1), (os.POSIX_SPAWN_DUP2, log.fileno(), 2)],
        )
        _, status, usage = os.wait4(process, 0)
        log.seek(0)
        text = log.read()
    if status != 0:
        sys.exit(text)
    return usage.ru_utime + usage.ru_stime, time.monotonic() - begin, 1024 * usage.ru_maxrss, text.splitlines()[0]


def main():
    root = pathlib.Path(__file__).resolve().parent.parent
    nightsplat = os.path.abspath(sys.argv[1] if len(sys.argv) > 1 else root / "target/release/nightsplat")
    millions = [float(word) for word in sys.argv[2:]] or [1, 2, 4]
    with tempfile.TemporaryDirectory() as folder:
        street, city = (pathlib.Path(folder) / name for name in ("street", "city"))

        def run(*arguments):
            subprocess.run([nightsplat, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)

        run("synth", street, "--street", 24, "--width", 48, "--height", 36)
        options = ["--blocks", 4, "--rounds", 1, "--steps", 80, "--plan", "none"]
        run("blocks", "plan", street, "--out", city, *options)
        run("blocks", "run", city)
        blocks = sorted((city / "blocks").iterdir())
        for count in millions:
            random = numpy.random.default_rng(1)
            for block in blocks:
                write_model(block, int(1e6 * count) // len(blocks), random)
            processor, wall, peak, text = joined(nightsplat, city)
            print(f"{processor:.1f} s of processor time, {wall:.1f} s, {peak / 1e6:.0f} MB at the peak: {text}")


if __name__ == "__main__":
    main()
