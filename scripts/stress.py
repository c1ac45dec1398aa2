#!/usr/bin/env python3
"""Campaigns that take too long for tests. Each prints its result; the first that fails ends the script.

    scripts/stress.py [table] [night] [conditioning] [cameras] [long] [kills] [terminals] [fuzz] [guards] [growth]

Without a name, all of them run.

NIGHTSPLAT           the command (default: target/release/nightsplat, built first)
STEPS, KILLS         of long and kills (100000, 200); a tenth of KILLS is the number of terminals
FUZZ_SECONDS         for each fuzz target (600)
NIGHTSPLAT_SCENES    the scenes of growth, comma-separated; NIGHTSPLAT_DOWNSCALES (4,2,1), NIGHTSPLAT_SEEDS (1,2,3)
"""

import os
import pty
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMMAND = os.environ.get("NIGHTSPLAT", "")
STEPS = int(os.environ.get("STEPS", "100000"))
KILLS = int(os.environ.get("KILLS", "200"))
FUZZ_SECONDS = int(os.environ.get("FUZZ_SECONDS", "600"))
PLAIN = ["--model", "plain", "--plan", "none", "--curve", "ap3"]
# The largest factor by which memory may grow from the second tenth of a run to its last: the allocator's share.
MOST_GROWTH = 1.05


def run(*arguments, **options):
    subprocess.run([str(argument) for argument in arguments], check=True, cwd=ROOT, **options)


def command():
    global COMMAND
    if not COMMAND:
        run("cargo", "build", "--release", "--bin", "nightsplat")
        target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
        COMMAND = str(target / "release" / "nightsplat")
    return COMMAND


def synth(folder, side, views):
    run(command(), "synth", folder, "--width", side, "--height", side, "--views", views, stdout=subprocess.DEVNULL)
    return folder


def table(_):
    """Hostile inputs, each against the references."""
    run("cargo", "test", "--release", "--test", "cli", "--", "--ignored", "--nocapture", "whole_table")


def night(_):
    """Night captures, with trainings: the table of docs/measurements.md."""
    run(ROOT / "scripts" / "night.sh", "--train", env={**os.environ, "NIGHTSPLAT": command()})


def conditioning(_):
    """Adam over 100 000 steps."""
    run("cargo", "test", "--release", "--test", "splats", "conditioning::", "--", "--include-ignored", "--nocapture")


def cameras(_):
    """COLMAP on real dark photographs, and training with its poses."""
    test = ["--test", "photographs", "--", "--ignored", "--nocapture", "real_dark_photographs"]
    run("cargo", "test", "--release", *test)


def resident(pid):
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1])
    return 0


def long(folder):
    """Memory over many steps.

    On a software device, device memory belongs to the process. A debug build grows, since its validation layer keeps a
    part of the allocations of each command buffer.
    """
    data, out = synth(folder / "set", 32, 8), folder / "long"
    arguments = [command(), "train", data, "--out", out, "--steps", STEPS, "--max-gaussians", 1000, *PLAIN]
    child = subprocess.Popen([str(a) for a in arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    samples = []
    while child.poll() is None:
        time.sleep(0.5)
        samples.append(resident(child.pid) if child.poll() is None else 0)
    samples = [sample for sample in samples if sample]
    tenth = max(1, len(samples) // 10)
    means = [sum(part) / len(part) for part in (samples[i:i + tenth] for i in range(0, len(samples), tenth))]
    print(f"{STEPS} steps: resident MB by tenths of the run: " + ", ".join(f"{mean / 1024:.0f}" for mean in means))
    # The first tenth includes the start, so the second is the base.
    if child.returncode != 0 or (len(means) > 2 and means[-1] > MOST_GROWTH * means[1]):
        sys.exit("memory grows, or the run failed")


def kills(folder):
    """Kills runs at random moments; resumed, they end with the bytes of an uninterrupted one."""
    data = synth(folder / "set", 32, 8)
    rounds = random.Random(14)

    def arguments(out):
        return [str(a) for a in (command(), "train", data, "--out", out, "--steps", 2000, "--max-gaussians", 500,
                                 "--checkpoint-every", 100, "--resume", *PLAIN)]

    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run(arguments(folder / "straight"), check=True, **quiet)
    expected = (folder / "straight" / "model.ply").read_bytes()
    killed = runs = 0
    while killed < KILLS:
        runs += 1
        out = folder / f"killed-{runs}"
        while True:
            child = subprocess.Popen(arguments(out), **quiet)
            try:
                # After enough kills the last run may finish.
                code = child.wait(timeout=rounds.uniform(0.05, 4) if killed < KILLS else None)
            except subprocess.TimeoutExpired:
                child.send_signal(signal.SIGKILL)
                child.wait()
                killed += 1
                continue
            if code != 0:
                sys.exit(f"after {killed} kills a run ended with {code}")
            break
        if (out / "model.ply").read_bytes() != expected:
            sys.exit(f"after {killed} kills a run ended with other bytes")
    print(f"{killed} kills over {runs} runs: every one ended with the bytes of an uninterrupted run")


def terminals(folder):
    """Closes the terminals of runs at random moments, and what they print to; nothing is lost."""
    data = synth(folder / "set", 32, 8)
    rounds = random.Random(15)

    def arguments(out, steps=2000):
        return [str(a) for a in (command(), "train", data, "--out", out, "--steps", steps, "--max-gaussians", 500,
                                 "--checkpoint-every", 0, "--checkpoint-minutes", 0, "--resume", "-v", *PLAIN)]

    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run(arguments(folder / "straight"), check=True, **quiet)
    expected = (folder / "straight" / "model.ply").read_bytes()
    closed = runs = 0
    while closed < max(1, KILLS // 10):
        runs += 1
        out = folder / f"closed-{runs}"
        while True:
            # A terminal of its own, as of a connection, or one that the run was started to outlive, as by nohup.
            outlives = rounds.random() < 0.5
            master, terminal = pty.openpty()
            disposition = signal.SIG_IGN if outlives else signal.SIG_DFL
            child = subprocess.Popen(arguments(out), stdout=terminal, stderr=terminal, start_new_session=True,
                                     preexec_fn=lambda: signal.signal(signal.SIGHUP, disposition))
            os.close(terminal)
            started = wait_for(child, out / "train.csv")
            time.sleep(rounds.uniform(0.05, 2))
            os.close(master)
            if started:
                child.send_signal(signal.SIGHUP)
            code = child.wait()
            closed += 1
            if code == 0:
                break
            steps = (out / "train.csv").read_text().count("\n") - 1
            if outlives or code != 129 or not (out / "checkpoint.safetensors").exists():
                sys.exit(f"a run whose terminal closed ended with {code} after {steps} steps")
        if (out / "model.ply").read_bytes() != expected:
            sys.exit(f"after {closed} closed terminals a run ended with other bytes")
    print(f"{closed} closed terminals over {runs} runs: every one ended with the bytes of an uninterrupted run")


def wait_for(child, file):
    """Whether the process has written a line of steps since it started."""
    before = file.stat().st_mtime_ns if file.exists() else 0
    while child.poll() is None:
        if file.exists() and file.stat().st_mtime_ns > before and file.read_text().count("\n") > 1:
            return True
        time.sleep(0.02)
    return False


def fuzz(_):
    """Every parser, FUZZ_SECONDS each."""
    run(ROOT / "scripts" / "fuzz.sh", FUZZ_SECONDS)


def guards(_):
    """Removes every guard of the kernels, one at a time: a test must fail."""
    run(sys.executable, ROOT / "scripts" / "plant-defects.py", "guard:")


def growth(_):
    """No round of density control costs the training views of a scene more than 0.3 dB."""
    if not os.environ.get("NIGHTSPLAT_SCENES"):
        subprocess.run([ROOT / "scripts/not-run.sh", "scenes", "NIGHTSPLAT_SCENES names none"], check=True)
        return
    run("cargo", "test", "--release", "--lib", "--", "--ignored", "--nocapture", "no_round_of_a_real_scene")


ALL = (table, night, conditioning, cameras, long, kills, terminals, fuzz, guards, growth)
CAMPAIGNS = {campaign.__name__: campaign for campaign in ALL}


def main():
    names = sys.argv[1:] or list(CAMPAIGNS)
    unknown = [name for name in names if name not in CAMPAIGNS]
    if unknown:
        sys.exit(f"unknown: {', '.join(unknown)}; there are {', '.join(CAMPAIGNS)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(f"== {name}: {CAMPAIGNS[name].__doc__.splitlines()[0]}", flush=True)
            place = Path(folder) / name
            place.mkdir()
            CAMPAIGNS[name](place)


if __name__ == "__main__":
    main()
