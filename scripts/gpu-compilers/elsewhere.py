#!/usr/bin/env python3
"""Compiles kernels by the driver of another processor, and prints what it reports of each, a line of JSON.

    scripts/gpu-compilers/elsewhere.py STATISTICS KERNELS COMMAND.. > LINES

STATISTICS is the file of NIGHTSPLAT_STATISTICS, and KERNELS the folder of NULL_DEVICE_KERNELS, of the same run: both
have a line for each pipeline, in the same order. COMMAND is compile.c, built and run for that driver. A kernel that it
does not compile within MOST_SECONDS of the processor is named on standard error, and its line has no numbers.
"""

import json
import resource
import signal
import subprocess
import sys

MOST_SECONDS = 120
ATTEMPTS = 3
# Turnip's names; a spill is stored and loaded.
NUMBERS = {
    "registers": ["Registers used"],
    "spills": ["STP Count", "LDP Count"],
    "instructions": ["Instruction Count"],
}


def limit():
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_SECONDS, MOST_SECONDS))


def compiled(command, folder, line):
    """The device, and the statistics of a kernel. An emulator that crashes is tried again."""
    for _ in range(ATTEMPTS):
        done = subprocess.run(command, cwd=folder, input=line, capture_output=True, text=True, preexec_fn=limit)
        printed = done.stdout.splitlines()
        if len(printed) == 2:
            return json.loads(printed[0]), json.loads(printed[1])
        if done.returncode in (-signal.SIGKILL, -signal.SIGXCPU):
            raise RuntimeError(f"{MOST_SECONDS} s do not suffice")
    raise RuntimeError(f"exit code {done.returncode}")


def main():
    path, folder, *command = sys.argv[1:]
    with open(path) as statistics, open(f"{folder}/list") as kernels:
        pairs = list(zip(map(json.loads, statistics), kernels, strict=True))
    unique = {(known["kernel"], known["constants"]): (known, line) for known, line in pairs}
    lines, device = [], {}
    for known, line in unique.values():
        numbers = {}
        try:
            device, told = compiled(command, folder, line)
            numbers = {name: sum(told[part] for part in parts) for name, parts in NUMBERS.items()}
        except RuntimeError as problem:
            print(f"{known['kernel']} ({known['constants']}): {problem}", file=sys.stderr)
        lines.append({name: known[name] for name in ("subgroup_size", "kernel", "constants")} | numbers)
    for line in lines:
        print(json.dumps(device | line))


if __name__ == "__main__":
    main()
