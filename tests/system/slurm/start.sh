#!/bin/bash
# Starts a SLURM of one node, as root, on Debian with the packages slurm-wlm and munge:
#     tests/system/slurm/start.sh FOLDER [CORES]
#     export SLURM_CONF=FOLDER/slurm.conf
# Everything it writes lies in FOLDER, which stop.sh needs to end it.
set -euo pipefail
folder=$(realpath -m -- "$1")
cores=${2:-$(nproc)}
host=$(hostname -s)
mkdir -p -- "$folder"/{munge,state,spool,log}
chmod 755 "$folder"
chmod 700 "$folder/munge"
cd -- "$folder"

port() {  # a free one
    python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

dd if=/dev/urandom of=munge/key bs=1024 count=1 status=none
chmod 400 munge/key
munged --force --key-file="$folder/munge/key" --socket="$folder/munge.socket" \
    --pid-file="$folder/munged.pid" --log-file="$folder/log/munged" --seed-file="$folder/munge/seed" \
    > /dev/null 2>&1

cat > slurm.conf <<EOF
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
SlurmdUser=root
SlurmctldPort=$(port)
SlurmdPort=$(port)
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
CredType=cred/munge
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/log/slurmctld
SlurmdLogFile=$folder/log/slurmd
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
ReturnToService=2
SchedulerParameters=sched_min_interval=100000,bf_interval=1
KillWait=30
NodeName=$host NodeAddr=127.0.0.1 CPUs=$cores RealMemory=64000 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
EOF

export SLURM_CONF=$folder/slurm.conf
slurmctld > log/start 2>&1 < /dev/null
slurmd >> log/start 2>&1 < /dev/null
for _ in $(seq 100); do
    if sinfo --noheader --format=%t 2> /dev/null | grep -qx idle; then
        exit 0
    fi
    sleep 0.2
done
echo "the node does not come up:" >&2
tail -n 20 log/* >&2
exit 1
