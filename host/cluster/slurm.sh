#!/usr/bin/env bash
# The paper's comparison as a Slurm array, a shard a task:
#     sbatch --array=1-24 host/cluster/slurm.sh /scratch/paper target/release/snakectl
# The same command goes on where tasks were stopped, by the time limit or otherwise. What comes after goes to `snakectl report paper` as it is.
#SBATCH --job-name=composer-paper
#SBATCH --cpus-per-task=1
#SBATCH --mem-per-cpu=4G
#SBATCH --time=12:00:00
#SBATCH --signal=TERM@120
#SBATCH --requeue
set -euo pipefail
out=${1:?"which folder? all nodes must see it"}
snakectl=${2:?"which program? target/release/snakectl, say"}
shift 2
shard=${SLURM_ARRAY_TASK_ID:?"this is for an array: sbatch --array=1-N"}
of=${SLURM_ARRAY_TASK_MAX:?"this is for an array: sbatch --array=1-N"}
# TERM, two minutes before the end of the time, makes a checkpoint.
exec "$snakectl" report paper --shard "$shard/$of" --out "$out/$shard" --jobs "${SLURM_CPUS_PER_TASK:-1}" "$@"
