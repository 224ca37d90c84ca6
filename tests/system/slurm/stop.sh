#!/bin/bash
# Ends the SLURM that start.sh has started, and waits for its end:   tests/system/slurm/stop.sh FOLDER
folder=$(realpath -m -- "$1")
export SLURM_CONF=$folder/slurm.conf
scancel --user="$(id -un)" 2> /dev/null
for name in slurmctld slurmd munged; do
    [ -f "$folder/$name.pid" ] || continue
    process=$(cat "$folder/$name.pid")
    kill "$process"
    for _ in $(seq 100); do
        kill -0 "$process" 2> /dev/null || break
        sleep 0.1
    done
done
