#!/usr/bin/env python3
"""A sweep on HyperQueue (`pip install hyperqueue`): a task per point, any number of workers, a leaderboard at the end.

    on_hyperqueue.py photos --out sweep --curves all --seeds 1,2,3

takes the arguments of `nightsplat sweep`. Without a server (`hq server start`) it starts one with WORKERS workers (2)
here. A task whose worker dies is given to another, and resumes from the checkpoint of its point.
"""

import os
import shlex
import subprocess
import sys
from pathlib import Path

from hyperqueue import Client, Job, LocalCluster
from hyperqueue.cluster import WorkerConfig

PROGRAM = os.environ.get("NIGHTSPLAT", "nightsplat")
# Exit code 75: saved, run again. 137 and 143: killed, for example for lack of memory. $0 is the lock of the point:
# a training may have outlived the worker that started it, and is waited for.
AGAIN = """
for attempt in $(seq 20); do
    [ ! -e "$0" ] || flock "$0" true
    "$@"
    code=$?
    case $code in 75 | 137 | 143) ;; *) exit $code ;; esac
done
exit $code
"""


def main() -> None:
    sweep = [PROGRAM, "sweep", *sys.argv[1:]]
    points = subprocess.run([*sweep, "--dry-run"], check=True, capture_output=True, text=True).stdout.splitlines()
    if points:
        run([shlex.split(point) for point in points])
    # All points are finished: this only ranks them.
    subprocess.run(sweep, check=True)


def run(points: list[list[str]]) -> None:
    # Several tasks on a graphics card share its memory: pass --max-vram, or use workers of one task each.
    job = Job(max_fails=0, default_env=dict(os.environ))
    logs = Path(os.environ.get("LOGS", "hyperqueue-logs")).absolute()
    logs.mkdir(parents=True, exist_ok=True)
    for point in points:
        folder = Path(point[point.index("--out") + 1])
        name = folder.name
        log = str(logs / f"{name}.log")
        command = ["sh", "-c", AGAIN, str(folder / ".lock"), *point]
        job.program(command, name=name, stdout=log, stderr=log, crash_limit=20)
    if (Path.home() / ".hq-server" / "hq-current").exists():
        wait(Client(), job)
        return
    with LocalCluster() as cluster:
        for _ in range(int(os.environ.get("WORKERS", "2"))):
            cluster.start_worker(WorkerConfig(cores=1))
        wait(cluster.client(), job)


def wait(client: Client, job: Job) -> None:
    submitted = client.submit(job)
    client.wait_for_jobs([submitted])


if __name__ == "__main__":
    main()
