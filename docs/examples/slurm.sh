#!/bin/bash
#SBATCH --nodes=4 --ntasks-per-node=1 --cpus-per-task=16 --time=2:00:00
# Train on four machines of a Slurm cluster, one Ray node each: docs/machines.md
export OMP_NUM_THREADS=1
HEAD=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
srun --nodes=1 --ntasks=1 -w "$HEAD" ray start --head --port 6379 --num-cpus 15 --block &
sleep 20
srun --nodes=3 --ntasks=3 --exclude="$HEAD" ray start --address "$HEAD:6379" --num-cpus 16 --block &
sleep 20
srun --overlap --nodes=1 --ntasks=1 -w "$HEAD" python recipes/ppo_anywhere.py --collectors 32 --address auto
