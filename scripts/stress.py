#!/usr/bin/env python3
"""Campaigns that take too long for tests. Each prints its result; the first that fails ends the script.

    scripts/stress.py [table] [night] [conditioning] [cameras] [long] [kills] [terminals] [bombs] [links] [fuzz]
                      [guards] [growth]

Without a name, all of them run.

NIGHTSPLAT           the command (default: target/release/nightsplat, built first)
STEPS, KILLS         of long and kills (100000, 200); a tenth of KILLS is the number of terminals
FUZZ_SECONDS         for each fuzz target (600)
NIGHTSPLAT_SCENES    the scenes of growth, comma-separated; NIGHTSPLAT_DOWNSCALES (4,2,1), NIGHTSPLAT_SEEDS (1,2,3)
"""

import gzip
import os
import pty
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COMMAND = os.environ.get("NIGHTSPLAT", "")
STEPS = int(os.environ.get("STEPS", "100000"))
KILLS = int(os.environ.get("KILLS", "200"))
FUZZ_SECONDS = int(os.environ.get("FUZZ_SECONDS", "600"))
PLAIN = ["--model", "plain", "--plan", "none", "--curve", "ap3"]
# What a file that is refused may take: seconds of processor time, and KiB of memory.
MOST_SECONDS, MOST_MEMORY = 10, 600 * 1024
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
    run("cargo", "test", "--profile", "checked", "--test", "cli", "--", "--ignored", "--nocapture", "whole_table")


def night(_):
    """Night captures, with trainings: the table of docs/measurements.md."""
    run(ROOT / "scripts" / "night.sh", "--train", env={**os.environ, "NIGHTSPLAT": command()})


def conditioning(_):
    """Adam over 100 000 steps."""
    options = ["--include-ignored", "--nocapture"]
    run("cargo", "test", "--profile", "checked", "--test", "splats", "conditioning::", "--", *options)


def cameras(_):
    """COLMAP on real dark photographs, and training with its poses."""
    test = ["--test", "photographs", "--", "--ignored", "--nocapture", "real_dark_photographs"]
    run("cargo", "test", "--profile", "checked", *test)


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


def sparse(path, start, size):
    """A file that is long on paper alone."""
    path.write_bytes(start)
    os.truncate(path, size)
    return path


def png_chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bombs(folder):
    """Small files that unpack to gigabytes are refused in a line, soon and in little memory."""
    def path(name):
        return folder / name

    def photographs(name, photograph):
        data = synth(path(name), 16, 5)
        photograph(next((data / "low").glob("*.png")))
        return ["train", data, "--out", path("run"), "--steps", 1, "--plan", "none", "--overwrite"]

    def long_iccp(png):
        whole = png.read_bytes()
        # In parts: a process counts the memory of the one that started it as its own.
        packer = zlib.compressobj()
        packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 10)) + packer.flush()
        png.write_bytes(whole[:33] + png_chunk(b"iCCP", b"p\0\0" + packed) + whole[33:])

    with zipfile.ZipFile(path("deep.zip"), "w") as archive:
        archive.writestr("a/" * 16_000 + "x", "")
    head = b"ply\nformat binary_little_endian 1.0\n"
    sparse(path("endless.ply"), head + b"comment ", 6 << 30)
    many = "".join(f"property float p{index}\n" for index in range(200_000))
    path("wide.ply").write_bytes(head + b"element vertex 1\n" + many.encode() + b"end_header\n")
    spz = struct.pack("<IIIBBBB", 0x5053474E, 3, 40_000_000, 0, 12, 0, 0)
    with gzip.open(path("zeros.spz"), "wb") as file:
        file.write(spz)
        for _ in range(900):
            file.write(bytes(1 << 20))
    cases = {
        "an archive of 16 000 folders": ["train", path("deep.zip"), "--out", path("run")],
        "an endless header": ["export", path("endless.ply"), "--format", "spz", "--out", path("out.spz")],
        "200 000 properties": ["export", path("wide.ply"), "--format", "spz", "--out", path("out.spz")],
        "an SPZ of zeros": ["export", path("zeros.spz"), "--format", "ply", "--out", path("out.ply")],
        "a photograph of 3 GB": photographs("false", lambda png: sparse(png, b"", 3 << 30)),
        "a profile of 1 GB": photographs("profile", long_iccp),
    }
    for name, arguments in cases.items():
        child = subprocess.Popen([command(), *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        lines = child.stderr.read().decode().splitlines()
        _, status, usage = os.wait4(child.pid, 0)
        code, seconds = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        took = f"{seconds:.1f} s of processor time, {usage.ru_maxrss // 1024} MiB"
        # Of a set with a bad photograph the others are trained on.
        told = [line for line in lines if line.startswith("error: " if code else " WARN ")]
        print(f"{name}: exit code {code}, {took}: {told[:1]}")
        if not told or seconds > MOST_SECONDS or usage.ru_maxrss > MOST_MEMORY:
            sys.exit("it was not refused as it should be")


def links(folder):
    """Links planted in a run or beside an output decide nothing about other files."""
    data, precious = synth(folder / "set", 16, 5), folder / "precious"
    train = [command(), "train", data, "--out", folder / "run", "--steps", 2, *PLAIN]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    run(*train, **quiet)
    names = [file.name for file in (folder / "run").iterdir() if file.is_file()]
    for name in [name + end for name in names for end in ("", ".partial")] + [".lock"]:
        shutil.copytree(folder / "run", folder / "planted")
        precious.write_text("precious")
        (folder / "planted" / name).unlink(missing_ok=True)
        (folder / "planted" / name).symlink_to(precious)
        arguments = [str(one) for one in train + ["--overwrite"]]
        arguments[arguments.index(str(folder / "run"))] = str(folder / "planted")
        subprocess.run(arguments, **quiet)
        if precious.read_text() != "precious":
            sys.exit(f"a link named {name} led out of the run")
        shutil.rmtree(folder / "planted")
    model, out = folder / "run" / "model.ply", folder / "out.spz"
    (folder / "out.spz.partial").symlink_to(precious)
    run(command(), "export", model, "--format", "spz", "--out", out, **quiet)
    if precious.read_text() != "precious" or out.is_symlink():
        sys.exit("a link beside an output was followed")
    print(f"{2 * len(names) + 2} planted links: none was followed")


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
    run("cargo", "test", "--profile", "checked", "--lib", "--", "--ignored", "--nocapture", "no_round_of_a_real_scene")


ALL = (table, night, conditioning, cameras, long, kills, terminals, bombs, links, fuzz, guards, growth)
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
