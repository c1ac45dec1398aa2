# The blocks of a plan on Snakemake (`pip install snakemake`): a job per task of tasks.jsonl, the join last.
#
#     nightsplat blocks plan photos --out city
#     snakemake -s blocks.smk --cores 2 --resources gpu=1 mem_mb=16000 -k --rerun-incomplete --config city=city
#
# `--resources` bounds what runs at a time: devices, and memory in MB. A task that is killed, or ends with exit code 75
# as its time is up, is run again and continues; one that outlived the Snakemake that started it is waited for. After a
# kill of Snakemake itself, run it with `--unlock` once.

import json
import os
import shlex
from pathlib import Path

CITY = Path(config["city"]).absolute()
# Tasks run in the folder of the plan; the program may be named from here.
PROGRAM = os.environ.get("NIGHTSPLAT", "nightsplat")
PROGRAM = os.path.abspath(PROGRAM) if "/" in PROGRAM else PROGRAM
TASKS = {task["id"]: task for task in map(json.loads, (CITY / "tasks.jsonl").read_text().splitlines())}


def mark(task):
    # Snakemake deletes the outputs of a failed job: it owns only a mark beside the runs.
    return str(CITY / "scheduled" / task)


rule all:
    input:
        map(mark, TASKS),


rule task:
    input:
        lambda wildcards: map(mark, TASKS[wildcards.task]["needs"]),
    output:
        touch(mark("{task}")),
    wildcard_constraints:
        task="|".join(TASKS),
    params:
        city=shlex.quote(str(CITY)),
        # That of the run, and that of a join.
        locks=lambda wildcards: shlex.join([str(Path(TASKS[wildcards.task]["done"]).parent / ".lock"), ".lock"]),
        command=lambda wildcards: shlex.join([PROGRAM, *TASKS[wildcards.task]["argv"][1:]]),
    resources:
        gpu=lambda wildcards: TASKS[wildcards.task]["gpu"],
        mem_mb=lambda wildcards: -(-TASKS[wildcards.task]["memory"] // 1_000_000),
    # A lost node. What a task says of its data or device is not repeated for long.
    retries: 3
    threads: 1
    shell:
        """
        cd {params.city}
        for attempt in $(seq 20); do
            for lock in {params.locks}; do if [ -e $lock ]; then flock $lock true; fi; done
            code=0; {params.command} || code=$?
            case $code in 75 | 137 | 143) ;; *) break ;; esac
        done
        exit $code
        """
