#!/usr/bin/env bash
# Trains a small street in four blocks: one after another, then with files in examples/schedulers, while trainings,
# Snakemake and a node of Slurm are killed. Every joined model must have the bytes of the first. Then joins that must be
# refused.
#
#     scripts/test-blocks.sh [NIGHTSPLAT]      (default: $NIGHTSPLAT, or target/debug/nightsplat)
#
# ENGINES lists the engines (default: hyperqueue; all: hyperqueue,snakemake,slurm). Snakemake and HyperQueue come from
# the Python registry into target/schedulers; Slurm from Debian's packages. One that cannot be installed is not run.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
program=$(realpath "${1:-${NIGHTSPLAT:-target/debug/nightsplat}}")
[ -x "$program" ] || { echo "failed: there is no $program; build it"; exit 1; }
venv=$root/target/schedulers
scratch=$(realpath "$(mktemp -d)")
# Output of the engines.
log=$scratch/log
# A line for each training or join that began: its process, its plan and its task.
export PROCESSES=$scratch/processes
touch "$PROCESSES"
# What the engines run in place of the program: it leaves such a line, and the first training of the block 0002 in each
# plan ends as if its time was up.
export PROGRAM=$program NIGHTSPLAT=$scratch/nightsplat
cat > "$NIGHTSPLAT" << 'WORKER'
#!/bin/sh
echo "$$ $PWD $2" >> "$PROCESSES"
[ "$2" != blocks/0002 ] || [ -e time-up ] || { touch time-up; exit 75; }
exec "$PROGRAM" "$@"
WORKER
chmod +x "$NIGHTSPLAT"

fail() {
    echo "failed: $1"
    [ ! -s "$log" ] || tail -n 40 "$log"
    exit 1
}

# The processes that this script started, however far down, with the given variable in their environment.
with() {
    sort <(grep -lsFxz "PROCESSES=$PROCESSES" /proc/[0-9]*/environ) <(grep -lsFxz "$1" /proc/[0-9]*/environ) |
        uniq -d | cut -d / -f 3
}

# Their parents that run the steps of Slurm, whose environment is empty.
steps_of() {
    local process parent
    for process in "$@"; do
        parent=$(sed -n 's/^PPid:[[:space:]]*//p' "/proc/$process/status" 2> /dev/null) || continue
        [ "$(cat "/proc/$parent/comm" 2> /dev/null)" != slurmstepd ] || echo "$parent"
    done
}

end_all() {
    local all
    mapfile -t all < <(with "PROGRAM=$PROGRAM")
    # shellcheck disable=SC2046
    kill -9 $(steps_of "${all[@]}") "${all[@]}"
    wait
    rm -rf "$scratch"
}
trap 'end_all > /dev/null 2>&1 || true' EXIT

# waits SECONDS WHAT COMMAND...: until the command succeeds.
waits() {
    local end=$((SECONDS + $1)) what=$2
    shift 2
    until "$@" > /dev/null 2>&1; do
        [ "$SECONDS" -lt "$end" ] || fail "waited too long for $what"
        sleep 0.05
    done
}

# under_way PLAN: sets `process` and `block` to a training of a block that has a checkpoint, and is not done.
under_way() {
    local place task
    while read -r process place task; do
        block=${task#blocks/}
        if [ "$place" = "$scratch/$1" ] && [ "$block" != "$task" ] && [ -e "/proc/$process/exe" ] &&
            [ -e "$1/$task/run/checkpoint.safetensors" ] && [ ! -e "$1/$task/run/done.json" ]; then
            return 0
        fi
    done < "$PROCESSES"
    return 1
}

# kills PLAN: kills such a training; another, where it was done before.
kills() {
    block=
    until [ -n "$block" ] && [ ! -e "$1/blocks/$block/run/done.json" ]; do
        waits 200 "a block to be trained" under_way "$1"
        kill -9 "$process" 2>> "$log" || true
    done
}

# The checksums of the joined model.
model() { (cd "$1" && find model -type f | sort | xargs -r sha256sum); }

# same PLAN ENGINE: fails unless the joined model is that of the blocks trained one after another.
same() {
    diff <(model serial) <(model "$1") || fail "$2: another model"
    echo "$2: the same model, at $SECONDS s"
}

plan() { "$program" blocks plan street --out "$@" > "$log" 2>&1 || fail "no plan"; }

cd "$scratch"
"$program" synth street --street 12 > "$log"
plan plan --blocks 4 --steps 1000 --max-gaussians 4000 --memory 1G --checkpoint-every 20
cp -r plan serial
"$program" blocks run serial > "$log" 2>&1 || fail "blocks run"
echo "blocks run: $(wc -l < serial/tasks.jsonl) tasks, joined at $SECONDS s"

is_wanted() { [[ ,${ENGINES:-hyperqueue}, = *,$1,* ]]; }

# has MODULE VERSION: whether Python's registry has brought it.
has() {
    "$venv/bin/python" -c "import $1" 2> "$log" ||
        { python3 -m venv "$venv" && "$venv/bin/pip" install -q "$1==$2"; } > "$log" 2>&1
}

# snakemake PLAN WORKERS [OPTIONS]
snakemake() {
    (cd "$1" && exec "$venv/bin/snakemake" -s "$root/examples/schedulers/blocks.smk" --cores "$2" "${@:3}" \
        --resources gpu="$2" --rerun-incomplete --config city=. > "$log" 2>&1)
}

on_snakemake() {
    cp -r plan three
    snakemake three 3 || fail "Snakemake with 3 workers"
    same three "Snakemake, 3 workers"

    cp -r plan two
    snakemake two 2 &
    local engine=$!
    kills two
    # This one outlives Snakemake, and is waited for by the next.
    waits 200 "another block to be trained" under_way two
    kill -9 "$engine"
    wait "$engine" 2> /dev/null || true
    snakemake two 2 --unlock || fail "Snakemake --unlock"
    snakemake two 2 || fail "Snakemake after it was killed"
    same two "Snakemake, 2 workers, a training and then Snakemake killed"
}

on_hyperqueue() {
    cp -r plan queue
    # Its server lives in the home folder.
    HOME=$scratch/home WORKERS=2 "$venv/bin/python" "$root/examples/schedulers/blocks_on_hyperqueue.py" queue \
        > "$log" 2>&1 &
    local engine=$!
    kills queue
    wait "$engine" || fail "HyperQueue"
    same queue "HyperQueue, 2 workers, a training killed"
}

if ! is_wanted snakemake; then
    :
elif has snakemake 9.27.0; then
    on_snakemake
else
    "$root/scripts/not-run.sh" snakemake 'blocks on Snakemake: the Python registry did not bring it'
fi
if ! is_wanted hyperqueue; then
    :
elif has hyperqueue 0.27.0; then
    on_hyperqueue
else
    "$root/scripts/not-run.sh" hyperqueue 'blocks on HyperQueue: the Python registry did not bring it'
fi

# Whether Slurm is there, or Debian's packages brought it.
has_slurm() {
    command -v slurmctld slurmd munged sbatch > /dev/null && return
    command -v apt-get > /dev/null || return
    local as_root=()
    [ "$(id -u)" -eq 0 ] || as_root=(sudo -n)
    "${as_root[@]}" apt-get update -qq > "$log" 2>&1 || return
    # Debian starts what it installs, and need not here.
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive RUNLEVEL=1 apt-get install -y -qq --no-install-recommends \
        slurmctld slurmd slurm-client munge >> "$log" 2>&1
}

# A cluster of three nodes on this machine, of its own configuration, keys and ports.
cluster() {
    local ports node host user slurm=$scratch/slurm
    host=$(hostname -s) user=$(id -un)
    mkdir -p "$slurm/state" "$slurm/munge" "$slurm"/w{1,2,3}
    # munged wants its socket to be reachable, and its key not to be.
    chmod 711 "$scratch"
    head -c 64 /dev/urandom > "$slurm/key"
    chmod 600 "$slurm/key"
    # shellcheck disable=SC2207
    ports=($(python3 -c 'import socket
sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(4)]
print(*(one.getsockname()[1] for one in sockets))'))
    export SLURM_CONF=$slurm/slurm.conf
    # A requeued job waits as long as its credential is valid.
    cat > "$SLURM_CONF" << CONF
ClusterName=blocks
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=${ports[0]}
SlurmUser=$user
SlurmdUser=$user
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket=$slurm/munge/socket,cred_expire=20
StateSaveLocation=$slurm/state
SlurmdSpoolDir=$slurm/%n
SlurmctldPidFile=$slurm/slurmctld.pid
SlurmdPidFile=$slurm/%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=2,bf_interval=2
SlurmdTimeout=10
ReturnToService=2
NodeName=w1 NodeHostname=$host NodeAddr=127.0.0.1 Port=${ports[1]} CPUs=1 RealMemory=2000
NodeName=w2 NodeHostname=$host NodeAddr=127.0.0.1 Port=${ports[2]} CPUs=1 RealMemory=2000
NodeName=w3 NodeHostname=$host NodeAddr=127.0.0.1 Port=${ports[3]} CPUs=1 RealMemory=2000
PartitionName=all Nodes=w[1-3] Default=YES State=UP
CONF
    munged -F --key-file="$slurm/key" --socket="$slurm/munge/socket" --pid-file="$slurm/munge/pid" \
        --log-file="$slurm/munge/log" --seed-file="$slurm/munge/seed" > "$slurm/munge.log" 2>&1 &
    waits 60 munged [ -S "$slurm/munge/socket" ]
    slurmctld -D > "$slurm/slurmctld.log" 2>&1 &
    for node in w1 w2 w3; do
        NODE=$node slurmd -D -N "$node" > "$slurm/$node.log" 2>&1 &
        # The shell does not report its end.
        disown
    done
    waits 120 "three nodes of Slurm" three_idle
}

three_idle() { [ "$(sinfo -h -o '%T %D')" = "idle 3" ]; }

no_jobs() { squeue -h > "$scratch/jobs" && [ ! -s "$scratch/jobs" ]; }

# job_under_way PLAN: sets `job` and `node` to those of a training under way, other than of the job $lost.
job_under_way() {
    local environment
    under_way "$1" && environment=$(tr '\0' '\n' < "/proc/$process/environ") || return
    job=$(sed -n 's/^SLURM_JOB_ID=//p' <<< "$environment")
    node=$(sed -n 's/^SLURMD_NODENAME=//p' <<< "$environment")
    [ -n "$job" ] && [ "$job" != "$lost" ]
}

on_slurm() {
    cluster
    cp -r plan nodes
    GPU="" "$root/examples/schedulers/blocks_slurm.sh" nodes > "$log" 2>&1 || fail "sbatch"
    local own job node lost="" killed
    waits 200 "a block to be trained" job_under_way nodes
    lost=$job killed=$node
    # The node, the steps that it runs, and what they started; what ends after its parent does is gone already.
    mapfile -t own < <(with "SLURMD_NODENAME=$killed")
    # shellcheck disable=SC2046
    kill -9 $(with "NODE=$killed") $(steps_of "${own[@]}") "${own[@]}" 2>> "$log" || true
    [ ! -e "nodes/blocks/$block/run/done.json" ] || fail "block $block was done before its node was killed"
    # As at the end of a job's time: another training saves, and its job is queued again; the next, if it was done.
    until grep -q "Requeuing JobId=$job" slurm/slurmctld.log && [ "$job" != "$lost" ]; do
        waits 200 "another block to be trained" job_under_way nodes
        scancel --signal=TERM "$job" 2>> "$log" || true
        sleep 3
    done
    waits 300 "the jobs of Slurm" no_jobs
    cat slurm/slurmctld.log nodes/logs/* >> "$log"
    grep -q "requeue job .* failure of node $killed" slurm/slurmctld.log || fail "Slurm noticed no lost node"
    same nodes "Slurm, 3 nodes, $killed killed and job $job queued again"
}

if ! is_wanted slurm; then
    :
elif has_slurm; then
    on_slurm
else
    "$root/scripts/not-run.sh" slurm "blocks on Slurm: Debian's packages could not be installed"
fi

# refused CODE TEXT: joining the plan `serial` ends with this exit code and one line of error, which contains the text;
# of the joined model, nothing changes.
refused() {
    local code=0 before=none after=none
    [ ! -e serial/model ] || before=$(model serial)
    "$program" blocks join serial > /dev/null 2> "$log" || code=$?
    [ ! -e serial/model ] || after=$(model serial)
    [ "$code" = "$1" ] || fail "a join that must be refused ($2): exit code $code"
    [ "$(wc -l < "$log")" = 1 ] && grep -qF "$2" "$log" || fail "a join that must be refused ($2): another error"
    [ "$before" = "$after" ] || fail "a refused join ($2) changed the model"
    sed 's/^/refused: /' "$log"
}

cp -r serial/model first
plan other --blocks 4 --steps 1000 --max-gaussians 4000 --memory 1G --seed 2
for model in joined none; do
    [ "$model" = joined ] || rm -r serial/model
    mv serial/blocks/0001-2 away
    refused 3 "0001-2: is missing"
    cp -r other/blocks/0001-2 serial/blocks/
    refused 3 "another plan"
    rm -r serial/blocks/0001-2
    mv away serial/blocks/0001-2
    mv serial/blocks/0003-2/run/done.json away
    refused 3 "block 0003-2 is not done"
    mv away serial/blocks/0003-2/run/done.json
done
photograph=$(find street/low -type f | head -n 1)
touch -r "$photograph" before
touch "$photograph"
refused 3 "has changed since the plan was made"
touch -r before "$photograph"

# Two joins at once: the first is held while the second begins. Joins are short: it may take several.
for attempt in {1..20}; do
    [ "$attempt" = 1 ] || rm -r serial/model
    "$program" blocks join serial > "$scratch/join" 2>&1 &
    first=$!
    # The number is written once the lock is held.
    until grep -qsx "$first" serial/.lock || [ ! -e "/proc/$first/exe" ]; do :; done
    kill -STOP "$first" 2>> "$log" || true
    [ -e serial/model/manifest.json ] || break
    kill -CONT "$first" 2>> "$log" || true
    wait "$first"
done
[ ! -e serial/model/manifest.json ] || fail "no join could be held"
refused 1 "process $first"
kill -CONT "$first"
wait "$first" || fail "the first of two joins"
diff -r first serial/model || fail "two joins at once: another model"
echo "two joins at once: one model; all at $SECONDS s"
