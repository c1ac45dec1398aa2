#!/usr/bin/env bash
# A sweep as a Slurm array: a task per point, which may be stopped and run again.
#
#     nightsplat sweep photos --out sweep --curves all --seeds 1,2,3 --dry-run > points.txt
#     sbatch --array=1-$(wc -l < points.txt) --wait examples/schedulers/slurm.sh points.txt
#     nightsplat sweep photos --out sweep --curves all --seeds 1,2,3
#
# The last line, run when all points are finished, writes the leaderboard.
#SBATCH --gpus=1
#SBATCH --cpus-per-task=4
#SBATCH --time=01:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# Two minutes before the end of its time a point gets a signal: it saves and ends with 143.
#SBATCH --signal=TERM@120

point=$(sed -n "${SLURM_ARRAY_TASK_ID:?run by sbatch --array}p" "${1:?name the file of points}")
# `exec` within srun: the training receives the signal, not this script.
srun sh -c "exec $point"
code=$?
case $code in
    75 | 143 | 130 | 129) scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}" ;;
    *) exit $code ;;
esac
