#!/usr/bin/env python3
"""Compares what a driver reports of compiled kernels with a list of before, or writes that.

    scripts/gpu-compilers/ledger.py [--write] LEDGER STATISTICS

STATISTICS is the file of NIGHTSPLAT_STATISTICS. A LEDGER is JSON with one line for each kernel and constants.
"""

import json
import os
import subprocess
import sys

DEVICE = ("device", "driver", "subgroup_size")
NUMBERS = ("registers", "spills", "scratch", "shared", "instructions")
MANY = 1.1  # so much more is worth a warning


def read_statistics(path):
    """The device, and the numbers of each kernel and constants."""
    with open(path) as file:
        lines = [json.loads(line) for line in file]
    device = {key: lines[0][key] for key in DEVICE}
    pipelines = {(line["kernel"], line["constants"]): line for line in lines}
    return device, {key: {name: int(line[name]) for name in NUMBERS if name in line} for key, line in pipelines.items()}


def read_ledger(path):
    with open(path) as file:
        ledger = json.load(file)
    pipelines = ledger.pop("pipelines")
    return ledger, {(line.pop("kernel"), line.pop("constants")): line for line in pipelines}


def write_ledger(path, device, pipelines):
    rows = (json.dumps({"kernel": kernel, "constants": constants, **numbers})
            for (kernel, constants), numbers in sorted(pipelines.items()))
    head = "".join(f"  {json.dumps(key)}: {json.dumps(value)},\n" for key, value in device.items())
    with open(path, "w") as file:
        file.write("{\n" + head + '  "pipelines": [\n    ' + ",\n    ".join(rows) + "\n  ]\n}\n")


def differences(known, now):
    """What is wrong, and what is worth a warning."""
    failures, warnings = [], []
    for key in sorted(known.keys() | now.keys()):
        name = f"{key[0]} ({key[1]})" if key[1] else key[0]
        before, after = known.get(key), now.get(key)
        if after is None:
            failures.append(f"{name}: is in the list and is not compiled; --write removes it")
            continue
        for number in ("spills", "scratch"):
            had, has = (before or {}).get(number, 0), after.get(number, 0)
            if has > had:
                failures.append(f"{name}: {number} {had} > {has}")
        if before is None:
            failures.append(f"{name}: is not in the list; --write adds it")
            continue
        had, has = before.get("instructions", 0), after.get("instructions", 0)
        if has > MANY * had:
            warnings.append(f"{name}: instructions {had} > {has}")
    return failures, warnings


def main(arguments):
    write = "--write" in arguments
    ledger, statistics = [argument for argument in arguments if argument != "--write"]
    device, pipelines = read_statistics(statistics)
    title = os.path.splitext(os.path.basename(ledger))[0]
    said = f"{title}, {device['driver']}: {len(pipelines)} pipelines"
    if write:
        write_ledger(ledger, device, pipelines)
        print(f"{said}, written to {ledger}")
        return 0
    known_device, known = read_ledger(ledger)
    if known_device != device:
        need = {"n": "radv", "v": "radv", "g": "radv", "s": "nvk", "d": "anv"}[title[0]]
        why = f"the comparison of {said} with a list of {known_device['driver']}"
        return subprocess.call([os.path.join(os.path.dirname(__file__), "../not-run.sh"), need, why])
    failures, warnings = differences(known, pipelines)
    for what, lines in ("failed", failures), ("warning", warnings):
        for line in lines:
            print(f"{what}: {title}: {line}")
    spilled = sum(1 for numbers in pipelines.values() if numbers.get("spills", 0) or numbers.get("scratch", 0))
    changed = sum(1 for key in known.keys() & pipelines.keys() if known[key] != pipelines[key])
    print(f"{said}, {spilled} with spills or scratch memory; {len(failures)} failures, {len(warnings)} warnings, "
          f"{changed} differ from the list")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
