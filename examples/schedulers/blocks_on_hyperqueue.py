#!/usr/bin/env python3
"""The blocks of a plan on HyperQueue (`pip install hyperqueue`): a task per line of tasks.jsonl, any number of workers.

    nightsplat blocks plan photos --out city
    blocks_on_hyperqueue.py city

Without a server (`hq server start`) it starts one with WORKERS workers (2) here. With one, a training takes a device
of a worker: $GPU names the resource (`gpus/nvidia`); empty, it takes none. Output is in city/logs.
"""

import json
import os
import sys
from pathlib import Path

from hyperqueue import Client, Job, LocalCluster
from hyperqueue.cluster import WorkerConfig
from hyperqueue.ffi.protocol import ResourceRequest

PROGRAM = os.environ.get("NIGHTSPLAT", "nightsplat")
PROGRAM = os.path.abspath(PROGRAM) if "/" in PROGRAM else PROGRAM
HAS_SERVER = (Path.home() / ".hq-server" / "hq-current").exists()
GPU = os.environ.get("GPU", "gpus/nvidia") if HAS_SERVER else ""
# Exit code 75: saved, run again. 137 and 143: killed, for example for lack of memory. $0 is the folder of the run,
# which a training that outlived its worker has locked, as a join has the folder of the plan: they are waited for.
AGAIN = """
for attempt in $(seq 20); do
    for lock in "$0/.lock" .lock; do [ ! -e "$lock" ] || flock "$lock" true; done
    "$@"
    code=$?
    case $code in 75 | 137 | 143) ;; *) exit $code ;; esac
done
exit $code
"""


def main() -> None:
    city = Path(sys.argv[1]).absolute()
    (city / "logs").mkdir(exist_ok=True)
    # A failed task stops those that need it, and no others.
    job, tasks = Job(default_workdir=city, max_fails=None, default_env=dict(os.environ)), {}
    for task in map(json.loads, (city / "tasks.jsonl").read_text().splitlines()):
        name, log = task["id"], str(city / "logs" / f"{task['id']}.log")
        command = ["sh", "-c", AGAIN, str(Path(task["done"]).parent), PROGRAM, *task["argv"][1:]]
        asks = ResourceRequest(cpus=1, resources={GPU: task["gpu"]} if GPU and task["gpu"] else {})
        options = {"name": name, "resources": asks, "stdout": log, "stderr": log, "crash_limit": 20}
        tasks[name] = job.program(command, deps=[tasks[need] for need in task["needs"]], **options)
    if HAS_SERVER:
        client = Client()
        client.wait_for_jobs([client.submit(job)])
        return
    with LocalCluster() as cluster:
        for _ in range(int(os.environ.get("WORKERS", "2"))):
            cluster.start_worker(WorkerConfig(cores=1))
        client = cluster.client()
        client.wait_for_jobs([client.submit(job)])


if __name__ == "__main__":
    main()
