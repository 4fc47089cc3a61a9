#!/usr/bin/env bash
# Runs a Slurm of one node on this machine, for test_run_sweep.py: Debian's packages, as root, without systemd.
# Doing it twice does no harm. A Slurm that is configured already is left as it is.
set -euo pipefail
conf=/etc/slurm/slurm.conf
mark="# written by tests/slurm.sh"

if [[ -e $conf ]] && ! grep -qx "$mark" "$conf"; then
  echo "slurm.sh: $conf is not mine: this machine has a Slurm of its own, which the tests will use" && exit 0
fi
if ! command -v slurmctld slurmd sbatch munged >/dev/null; then
  export DEBIAN_FRONTEND=noninteractive
  apt-get update -qq
  apt-get install -y -qq --no-install-recommends slurm-wlm munge >/dev/null
fi

host=$(hostname -s)
state=/var/lib/slurm-test
mkdir -p "$state/ctld" "$state/d" "${conf%/*}"
wanted="$mark
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
# A job that is put back into the queue waits as long as its credential lives: 2 minutes by default
AuthInfo=cred_expire=5
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2,bf_interval=2,sched_min_interval=0
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=10
StateSaveLocation=$state/ctld
SlurmdSpoolDir=$state/d
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
SlurmctldLogFile=$state/slurmctld.log
SlurmdLogFile=$state/slurmd.log
NodeName=$host NodeAddr=127.0.0.1 CPUs=2 RealMemory=500 State=UNKNOWN
PartitionName=test Nodes=ALL Default=YES MaxTime=INFINITE State=UP"

alive() { [[ -s $state/$1.pid ]] && [[ $(cat "/proc/$(<"$state/$1.pid")/comm" 2>/dev/null) == "$1" ]]; }

if [[ ! -e $conf || $(<"$conf") != "$wanted" ]]; then
  for daemon in slurmd slurmctld; do
    if alive "$daemon"; then kill "$(<"$state/$daemon.pid")" && sleep 2; fi
  done
  echo "$wanted" >"$conf"
fi
if ! munge -n >/dev/null 2>&1; then
  install -d -o munge -g munge /run/munge
  su -s /bin/sh munge -c /usr/sbin/munged
fi
alive slurmctld || slurmctld
alive slurmd || slurmd
for _ in {1..60}; do
  [[ $(sinfo --noheader --format=%t 2>/dev/null) =~ idle|mix|alloc ]] && sinfo && exit 0
  sleep 1
done
echo "slurm.sh: no node came up:" >&2
sinfo >&2 || true
tail -n 20 "$state/slurmctld.log" "$state/slurmd.log" >&2
exit 1
