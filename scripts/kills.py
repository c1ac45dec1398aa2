"""The table of kills: which tests fail for which defects, and which tests are needed.

A test is needed if it alone catches a defect, or if docs/promises.md names it; without the others, the same defects are
caught. scripts/mutants.py and scripts/plant-defects.py write the table with --every.
"""

import json
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def save(path, kills):
    """Writes the failing tests of each defect."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(kills, indent=1, sort_keys=True) + "\n")


def show(path, kills, tests=()):
    """Prints each test with its kills and those that are its alone, of the table in the file.

    kills: the names of the tests that fail, by defect; tests: those that ran, also if they caught nothing.
    """
    promises = (ROOT / "docs/promises.md").read_text()
    found = Counter(test for failed in kills.values() for test in failed)
    alone = Counter(failed[0] for failed in kills.values() if len(failed) == 1)
    print(f"{'kills':>6}{'alone':>6}  test, of {len(kills)} defects ({path})")
    for test in sorted(set(tests) | set(found), key=lambda test: (alone[test], found[test], test)):
        *_, module, name = ["", *test.split(": ")[-1].replace("::tests::", "::").split("::")]
        promised = f"`{module}::{name}`" in promises or f"`{module}::*`" in promises
        why = "  promised" if promised else "" if alone[test] else "  not needed"
        print(f"{found[test]:6}{alone[test]:6}  {test}{why}")
