#!/usr/bin/env python3
"""Builds every mutant that cargo-mutants lists for some modules into one program, and names those that no test catches.

    scripts/mutants.py [--minutes N] [--jobs N] [--seed N] [--tests LIST] [--every] [MODULE ...]

A mutated function selects one of its bodies by the environment variable NIGHTSPLAT_MUTANT, so that a mutant costs the
tests that reach it but no build. This happens in a copy of the tree, target/mutants, where results are kept in JSON;
another run resumes from them as long as no file of the tree changes. Mutants come in random order: an interrupted run
is a fair sample.

  caught       a test that reaches it failed, or took four times its usual time
  missed       all tests that reach it passed, or all that fit in two minutes
  unreached    none of the tests calls the function
  unviable     it does not compile
  unplanted    not a whole body: in a const function, of an unnamed type, or a field left at its default

A mutant's tests end with the first that fails; --every runs all that reach it, and prints and writes the table of
kills, target/kills/mutants.json: every test that fails for each mutant, and the tests that are not needed.

Needs `cargo install cargo-mutants --locked`. Exit code 1 if a mutant was missed.
"""

import argparse
import concurrent.futures
import hashlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from pathlib import Path

import kills

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "target" / "mutants"
TREE = WORK / "tree"
MODULES = [
    "src/splats/optimizer", "src/splats/densify", "src/loss", "src/splats/render", "crates/photographs/src/tone"
]
TESTS = "cli core diagnose gpu loss models networks photographs pose splats train"
# The packages of these programs.
PACKAGES = ["nightsplat", *(f"nightsplat-{name}" for name in ("core", "diagnose", "models", "photographs", "pose"))]
# Tests of a mutant run in order of speed until they have taken this many seconds.
MOST_SECONDS = 120
# Tests of a program run together if that adds at most this to the time spent so far: fast tests catch most mutants,
# and slow ones are rarely started.
START_SECONDS = 2

CHOICE = """//! Which mutant is active, and which functions were reached.

use std::io::Write;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static REACHED: [AtomicBool; SITES] = [const { AtomicBool::new(false) }; SITES];

/// The active mutant; records that its function was reached.
pub fn mutant(site: usize) -> u32 {
    static MUTANT: OnceLock<u32> = OnceLock::new();
    if !REACHED[site].swap(true, Ordering::Relaxed) {
        if let Ok(path) = std::env::var("NIGHTSPLAT_REACHED") {
            let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
            file.unwrap().write_all(format!("{site}\\n").as_bytes()).unwrap();
        }
    }
    *MUTANT.get_or_init(|| {
        std::env::var("NIGHTSPLAT_MUTANT").map_or(0, |number| number.parse().unwrap())
    })
}
"""


def listed(modules):
    """The mutants of some modules, numbered from 1."""
    git = subprocess.run(["git", "ls-files", "src", "crates"], cwd=ROOT, check=True, capture_output=True, text=True)
    files = git.stdout.split()
    own = [file for file in files if re.match(rf"({'|'.join(modules)})(\.rs$|/.*\.rs$)", file)]
    files = [argument for file in own for argument in ("-f", file)]
    try:
        listing = ["cargo-mutants", "mutants", "--workspace", "--list", "--json", *files]
        run = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True)
    except FileNotFoundError:
        sys.exit("cargo-mutants is not installed: `cargo install cargo-mutants --locked`")
    if run.returncode != 0:
        sys.exit(run.stderr)
    return [dict(mutant, number=number) for number, mutant in enumerate(json.loads(run.stdout), 1)]


def offset(lines, place):
    """The offset of a line and column in the text of a file."""
    return sum(len(line) for line in lines[:place["line"] - 1]) + place["column"] - 1


def body_at(text):
    """The offset of a function's body in its text: its first brace outside of parentheses."""
    depth = 0
    for at, char in enumerate(text):
        depth += (char in "([") - (char in ")]")
        if char == "{" and depth == 0:
            return at
    return None


def planted(source, mutants, site):
    """The text of a file with all its mutants, and the next free site; records site and lines of each mutant."""
    lines = source.splitlines(keepends=True)
    functions = defaultdict(list)
    for mutant in mutants:
        functions[tuple(offset(lines, mutant["function"]["span"][end]) for end in ("start", "end"))].append(mutant)
    text, last = "", 0
    for (start, end), own in sorted(functions.items()):
        function = source[start:end]
        body = start + body_at(function)
        text += source[last:body] + f"{{\nmatch nightsplat_core::mutant::mutant({site}) {{\n"
        for mutant in own:
            begin, stop = (offset(lines, mutant["span"][end]) for end in ("start", "end"))
            arm = source[body:begin] + " " + mutant["replacement"] + " " + source[stop:end]
            first = text.count("\n") + 1
            text += f"{mutant['number']} => {arm}\n"
            mutant.update(site=site, lines=[first, text.count("\n")])
        text += f"_ => {source[body:end]}\n}}\n}}"
        last, site = end, site + 1
    return text + source[last:], site


def tracked():
    """The files of the tree, according to git."""
    run = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True)
    return [file for file in run.stdout.split("\0") if (ROOT / file).is_file()]


def kept_in():
    """The path of the results for the current tree."""
    digest = hashlib.sha256()
    for file in tracked():
        digest.update(file.encode() + b"\0" + (ROOT / file).read_bytes())
    folder = WORK / digest.hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def plant(mutants):
    """Writes the copy of the tree with these mutants."""
    for file in tracked():
        (TREE / file).parent.mkdir(parents=True, exist_ok=True)
        text = (ROOT / file).read_bytes()
        if not (TREE / file).exists() or (TREE / file).read_bytes() != text:
            shutil.copy2(ROOT / file, TREE / file)
    by_file, site = defaultdict(list), 0
    for mutant in mutants:
        by_file[mutant["file"]].append(mutant)
    for file, own in by_file.items():
        text, site = planted((ROOT / file).read_text(), own, site)
        (TREE / file).write_text(text)
    (TREE / "crates/core/src/mutant.rs").write_text(CHOICE.replace("SITES", str(site)))
    # Below all crates with mutants.
    library = (ROOT / "crates/core/src/lib.rs").read_text()
    first = re.search(r"^(?!//|#!|\s*$)", library, re.M).start()
    module = "#[doc(hidden)]\npub mod mutant;\n"
    (TREE / "crates/core/src/lib.rs").write_text(library[:first] + module + library[first:])


def messages(*arguments):
    """Runs cargo in the copy; returns the run and its messages."""
    run = subprocess.run(["cargo", *arguments, "--message-format=json"], cwd=TREE, capture_output=True, text=True)
    said = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    return run, said


def viable(mutants):
    """The mutants that compile, planted."""
    while True:
        plant(mutants)
        run, said = messages("check", "--lib")
        if run.returncode == 0:
            return mutants
        broken = set()
        for error in (message["message"] for message in said if message.get("message")):
            spans = list(error["spans"]) if error["level"] == "error" else []
            # Code from a macro is located at the call of the macro.
            for span in spans:
                spans += [span["expansion"]["span"]] if span["expansion"] else []
                line = span["line_start"]
                broken |= {mutant["number"] for mutant in mutants if mutant["file"] == span["file_name"]
                           and mutant["lines"][0] <= line <= mutant["lines"][1]}
        if not broken:
            sys.exit(run.stderr[-4000:])
        print(f"{len(broken)} of {len(mutants)} mutants do not compile", flush=True)
        mutants = [mutant for mutant in mutants if mutant["number"] not in broken]


def built(tests):
    """The test programs, by package and name: those of the crates too."""
    names = [argument for test in tests for argument in ("--test", test)]
    packages = [argument for package in PACKAGES for argument in ("--package", package)]
    run, said = messages("test", "--no-run", "--lib", *packages, *names)
    if run.returncode != 0:
        sys.exit(run.stderr[-4000:])
    programs = [message for message in said if message.get("executable") and message["profile"]["test"]]
    package = lambda message: Path(message["manifest_path"]).parent.name
    return {f"{package(message)}/{message['target']['name']}": message["executable"] for message in programs}


def run_tests(program, names, seconds, **variables):
    """The names of the tests that fail, all if they take too long or the process ends early; and their seconds."""
    begin = time.monotonic()
    try:
        quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True, "start_new_session": True}
        run = subprocess.run([program, "--exact", "--test-threads", "1", *names], cwd=TREE, timeout=seconds,
                             env=dict(os.environ, **variables), **quiet)
        failed = re.findall(r"^test (\S+)(?: - should panic)? \.\.\. FAILED", run.stdout, re.M)
        failed = failed or (names if run.returncode != 0 else [])
    except subprocess.TimeoutExpired:
        failed = names
    return failed, time.monotonic() - begin


def reach(programs, jobs, kept):
    """Program, seconds and reached sites of every test, cached in a file."""
    known = json.loads(kept.read_text()) if kept.exists() else {}

    def one(program, name):
        key = f"{program} {name}"
        if key not in known:
            file = WORK / f"reached-{abs(hash(key))}"
            file.unlink(missing_ok=True)
            failed, seconds = run_tests(programs[program], [name], 300, NIGHTSPLAT_REACHED=str(file))
            sites = sorted({int(line) for line in file.read_text().split()}) if file.exists() else []
            file.unlink(missing_ok=True)
            known[key] = {"program": program, "name": name, "passes": not failed, "seconds": seconds, "sites": sites}

    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        for program, path in programs.items():
            tests = subprocess.run([path, "--list"], cwd=TREE, check=True, capture_output=True, text=True).stdout
            names = [line.removesuffix(": test") for line in tests.splitlines() if line.endswith(": test")]
            list(pool.map(lambda name: one(program, name), names))
            print(f"{program}: {len(names)} tests", flush=True)
            kept.write_text(json.dumps(known))
    return list(known.values())


def verdict(mutant, tests, programs, every):
    """The verdict on a mutant, what there is to say of it, and the tests that fail for it: of every one that reaches it
    or of the first group in which one does."""
    own = [test for test in tests if mutant["site"] in test["sites"] and test["passes"]]
    own.sort(key=lambda test: test["seconds"])
    if not own:
        return "unreached", None, []
    spent, killers = 0.0, []
    while own and (every or spent < MOST_SECONDS and not killers):
        program, group, seconds = own[0]["program"], [], 0.0
        for test in own:
            if test["program"] == program and (not group or seconds + test["seconds"] < START_SECONDS + spent):
                group.append(test)
                seconds += test["seconds"]
        own = [test for test in own if test not in group]
        names = [test["name"] for test in group]
        failed, took = run_tests(programs[program], names, 4 * seconds + 20, NIGHTSPLAT_MUTANT=str(mutant["number"]))
        killers += [f"{program}: {name}" for name in failed]
        spent += took
    if killers:
        return "caught", None, killers
    return "missed", f"{len(own)} slow tests were not run" if own else None, []


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=MODULES, metavar="MODULE",
                        help=f"their paths [default: {', '.join(MODULES)}]")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this time")
    parser.add_argument("--jobs", type=int, default=2, help="tests that run in parallel")
    parser.add_argument("--seed", type=int, default=1, help="of the order of the mutants")
    parser.add_argument("--tests", default=TESTS, help="test programs in addition to the library's own tests")
    parser.add_argument("--every", action="store_true", help="run all tests of a mutant, and write the table of kills")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    known = kept_in()

    everything = listed(options.modules)
    unplanted = [mutant for mutant in everything
                 if not mutant["function"] or "impl " in (mutant["function"]["return_type"] or "")
                 or "StructField" == mutant["genre"] or is_constant(mutant)]
    candidates = [mutant for mutant in everything if mutant not in unplanted]
    mutants = viable(candidates)
    programs = built(options.tests.split())
    tests = reach(programs, options.jobs, known / "reach.json")
    failing = [test["name"] for test in tests if not test["passes"]]
    print(f"ignored, since they fail without a mutant: {', '.join(failing) or 'none'}")

    kept, lock = known / ("kills.json" if options.every else "verdicts.json"), threading.Lock()
    verdicts = json.loads(kept.read_text()) if kept.exists() else {}
    random.Random(options.seed).shuffle(mutants)

    def judge(mutant):
        name = mutant["name"]
        if name not in verdicts and time.monotonic() < end:
            own = verdict(mutant, tests, programs, options.every)
            with lock:
                verdicts[name] = own
                kept.write_text(json.dumps(verdicts, indent=1))
            if verdicts[name][0] == "missed":
                print("missed:", name, verdicts[name][1] or "", flush=True)

    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(judge, mutants))

    counts = defaultdict(Counter)
    numbers = {mutant["number"] for mutant in mutants}
    for mutant in everything:
        module = re.match(rf"({'|'.join(options.modules)})", mutant["file"])[1]
        what = verdicts.get(mutant["name"], ("not run",))[0] if mutant["number"] in numbers else \
            "unplanted" if mutant in unplanted else "unviable"
        counts[module][what] += 1
    if options.every:
        found = {name: own[2] for name, own in verdicts.items()}
        ran = [f"{test['program']}: {test['name']}" for test in tests if test["passes"]]
        table = ROOT / "target/kills/mutants.json"
        kills.save(table, found)
        kills.show(table, found, ran)
    columns = ["caught", "missed", "unreached", "unviable", "unplanted", "not run"]
    print(f"{'':12}" + "".join(f"{column:>11}" for column in columns))
    for module, count in counts.items():
        print(f"{module:12}" + "".join(f"{count[column]:11}" for column in columns))
    sys.exit(any(count["missed"] for count in counts.values()))


def is_constant(mutant):
    """Whether its function is a const function."""
    start = mutant["function"]["span"]["start"]
    line = (ROOT / mutant["file"]).read_text().splitlines()[start["line"] - 1]
    return "const " in line[start["column"] - 1:].split("(")[0]


if __name__ == "__main__":
    main()
