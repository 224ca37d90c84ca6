#!/bin/bash
# Ends the SLURM that start.sh has started:   tests/system/slurm/stop.sh FOLDER
folder=$(realpath -m -- "$1")
export SLURM_CONF=$folder/slurm.conf
scancel --user="$(id -un)" 2> /dev/null
for name in slurmctld slurmd munged; do
    if [ -f "$folder/$name.pid" ]; then
        kill "$(cat "$folder/$name.pid")"
    fi
done
