#!/usr/bin/env bash
#SBATCH --job-name=radejax
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=2
#SBATCH --gpus-per-node=2
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00
#SBATCH --signal=B:USR1@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=slurm-%j.out
# Trains a config with its own batch size and precision on two GPUs, one process per GPU.
# Further arguments are options of `radejax train`:
#
#     sbatch --export=ALL,DATA=/data/kradar1,WORKDIR=$HOME/runs/radenet \
#         examples/slurm.sh --seeds 0,1,2
#
# CONFIG names the config (default: radenet), whose batch size must be divisible by the
# number of GPUs: 10 for radenet, 6 for dinorade. WORKDIR and RECORDS (default: beside the
# data) must be on a disk that all nodes share.
set -euo pipefail
: "${DATA:?folders of K-Radar, separated by commas}" "${WORKDIR:?folder of the run}"

# Slurm sends USR1 to this script 120 s before the time limit. The processes then receive
# SIGTERM, save a checkpoint and stop, and the job returns to the queue. Without "B:", Slurm
# would send USR1 to the processes, which would also save and stop, and the job would end.
# A run that ends by itself, with or without an error or an evaluation, is never queued
# again. After a preemption or the failure of a node, Slurm requeues the job (--requeue).
is_stopped=false
stop() {
    is_stopped=true
    scancel --signal=TERM "$SLURM_JOB_ID" # signals the processes, not this script
}
trap stop USR1

# Since Slurm 22.05, srun does not take --cpus-per-task from sbatch.
srun --cpus-per-task="$SLURM_CPUS_PER_TASK" --kill-on-bad-exit=1 \
    radejax train --distributed --config "${CONFIG:-radenet}" --data "$DATA" \
    --records "${RECORDS:-${DATA%%,*}/records}" --workdir "$WORKDIR" "$@" &
process=$!
status=0
wait "$process" || status=$?
if $is_stopped; then # the signal ended the first `wait`
    status=0
    wait "$process" || status=$?
fi

# 143 = 128 + SIGTERM: stopped in the final evaluation, which the next start repeats.
if $is_stopped && [[ $status == 0 || $status == 143 ]]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
