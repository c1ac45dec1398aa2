#!/usr/bin/env bash
# The blocks of a plan on Slurm: a job per task of tasks.jsonl, which starts after the jobs that it needs.
#
#     nightsplat blocks plan photos --out city
#     examples/schedulers/blocks_slurm.sh city --time=04:00:00 --partition=gpu
#
# Further arguments are passed to sbatch. A task gets the memory and the devices of its line; GPU= (empty): no device.
# Slurm gives the job of a lost node to another. Repeat the command after a failure: what is done is not done again.
set -euo pipefail

# A job, in the folder of the plan: the file that its task leaves, and the command.
run() {
    local locks="$(dirname "$1")/.lock .lock" code=75 attempt
    shift
    for attempt in $(seq 20); do
        # A task that outlived its job is waited for.
        for lock in $locks; do [ ! -e "$lock" ] || flock "$lock" true; done
        code=0
        srun "$@" || code=$?
        case $code in
            # Saved, or killed for example for lack of memory: again, within the job. A requeue waits for two minutes.
            75 | 137) ;;
            # The signal two minutes before the end of the job's time.
            143 | 130 | 129) exec scontrol requeue "$SLURM_JOB_ID" ;;
            *) break ;;
        esac
    done
    exit "$code"
}

if [ "$1" = --task ]; then
    run "${@:2}"
fi
city=$(realpath "$1")
program=${NIGHTSPLAT:-nightsplat}
[[ $program != */* ]] || program=$(realpath "$program")
# A line for each task: name, names that it needs, memory in MiB, devices, file that it leaves, arguments.
lines='import json, shlex, sys
for task in map(json.loads, sys.stdin):
    needs, size = " ".join(task["needs"]), -(-task["memory"] // 2**20)
    print(task["id"], needs, size, task["gpu"], task["done"], shlex.join(task["argv"][1:]), sep="|")'

mkdir -p "$city/logs"
declare -A jobs
while IFS='|' read -r name needs size gpu file arguments; do
    [ ! -e "$city/$file" ] || continue
    after=""
    for need in $needs; do after+=${jobs[$need]:+:${jobs[$need]}}; done
    options=(--parsable --job-name="$name" --chdir="$city" --output="$city/logs/$name.log" --open-mode=append
        --mem="${size}M" --signal=TERM@120 --requeue --kill-on-invalid-dep=yes ${after:+--dependency=afterok$after})
    [ "$gpu" = 0 ] || [ -z "${GPU-1}" ] || options+=("--gpus=$gpu")
    eval "arguments=($arguments)"
    jobs[$name]=$(sbatch "${options[@]}" "${@:2}" "$0" --task "$file" "$program" "${arguments[@]}")
    echo "${jobs[$name]} $name"
done < <(python3 -c "$lines" < "$city/tasks.jsonl")
