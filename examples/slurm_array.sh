#!/bin/bash
#SBATCH --cpus-per-task=8 --mem=8G --time=4:00:00 --requeue
# Generates a data set as an array job of SLURM, one slice a task, then merges and fits it:
#     examples/slurm_array.sh assets/cliff_rock out/cliff_rock --queries 400/texel
# The same command again resumes. SBATCH_PARTITION, SBATCH_ACCOUNT and SLICES choose where, and how many.
set -euo pipefail
if [ -z "${SLURM_JOB_ID:-}" ]; then            # on the login node: submit this script twice
    array=$(sbatch --parsable --array="1-${SLICES:-16}" "$0" "$@")
    sbatch --parsable --dependency="afterok:$array" --kill-on-invalid-dep=yes "$0" "$@"
elif [ -n "${SLURM_ARRAY_TASK_ID:-}" ]; then   # a task of the array
    mbtf-gen "$1" -o "$2/shards" "${@:3}" --slice "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
else                                           # after all of them
    mbtf-gen merge "$2/shards"
    mbtf-fit "$2/shards" -o "$2/material"
fi
