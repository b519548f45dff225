#!/bin/bash
# One task of a Slurm array for each scene: sbatch --array=0-7 slurm_array.sh SCENES OUT [OPTION ...]
# SCENES is a folder of scenes, in the order of their names; options are those of `semstab-bench run`. Then:
# semstab-bench show OUT/* --out FOLDER: one table of all scenes
#SBATCH --job-name=semstab
#SBATCH --cpus-per-task=4
#SBATCH --mem=16G
#SBATCH --time=02:00:00
#SBATCH --output=semstab-%A_%a.txt
#SBATCH --requeue
set -euo pipefail

scenes=("$1"/*/)
out=$2
shift 2
if [ "$SLURM_ARRAY_TASK_ID" -ge ${#scenes[@]} ]; then
    echo "error: task $SLURM_ARRAY_TASK_ID has no scene; there are ${#scenes[@]}: sbatch --array=0-$((${#scenes[@]} - 1))" >&2
    exit 2
fi
scene=${scenes[$SLURM_ARRAY_TASK_ID]%/}
export NUMBA_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1} OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}

# A task that was requeued goes on with the units that are missing, as --out is the same
exec semstab-bench run --data "$scene" --rerun off --out "$out/$(basename "$scene")" "$@"
