#!/bin/bash
# A batch on 4 nodes of a SLURM cluster; give it the arguments of `autoalign batch`:
#
#     sbatch examples/cluster/slurm.sh /shared/pictures --reference /shared/reference.png --out-dir /shared/out
#
# Where it ends before the batch does, SLURM puts it in the queue again, and it goes on where it was.
#SBATCH --job-name=autoalign
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --mem-per-cpu=4G
#SBATCH --time=02:00:00
#SBATCH --requeue
#SBATCH --signal=B:TERM@60
set -euo pipefail

export AUTOALIGN_SCHEDULER="tcp://$(hostname):8786"
trap 'kill $(jobs -p) 2>/dev/null; scontrol requeue "$SLURM_JOB_ID"; exit 0' TERM
trap 'kill $(jobs -p) 2>/dev/null' EXIT

dask scheduler --port 8786 --no-dashboard &
# A thread for each core: all it does is wait for a process of its own. No nanny, or there could be no such process.
srun dask worker "$AUTOALIGN_SCHEDULER" --nthreads "$SLURM_CPUS_PER_TASK" --no-nanny --no-dashboard &

autoalign batch "$@" &  # waited for in the background, so that the signal is heard
wait $!
