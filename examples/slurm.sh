#!/usr/bin/env bash
#SBATCH --job-name=radejax
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=4
#SBATCH --gpus-per-node=4
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@120
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=slurm-%j.out
# RADE-Net on eight GPUs of two nodes: one process a GPU, found by JAX from Slurm's
# variables. 120 s before the time is over (--signal), or when the job is preempted, all
# processes save a checkpoint and stop; started again, the run continues there.
#
#     sbatch --export=ALL,DATA=/data/kradar1,WORKDIR=$HOME/runs/radenet examples/slurm.sh
#
# WORKDIR and the records (beside the data, or RECORDS) lie on a disk that all nodes see.
# The global batch must divide over the GPUs: eight of the paper's ten frames here.
set -euo pipefail
: "${DATA:?folders of K-Radar, separated by commas}" "${WORKDIR:?folder of the run}"
records=${RECORDS:-${DATA%%,*}/records}

run() {
    srun --kill-on-bad-exit=1 python train.py --distributed \
        --config configs/radenet.py --config.train.batch_size=8 \
        --config.model.dtype=bfloat16 \
        --data "$DATA" --records "$records" --workdir "$WORKDIR"
}

status=0
run || status=$?
# Stopped by a signal, in training (0, and there is no evaluation yet) or in the final
# evaluation (143 = 128 + SIGTERM): back into the queue. Errors are not tried again.
if [ "$status" = 143 ] ||
    { [ "$status" = 0 ] && [ ! -e "$WORKDIR/evaluation/metrics.json" ]; }; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
