#!/usr/bin/env bash
# Carries out the paper's grids, each run in a process of its own on one core (--help says how).
# How that is done stands here. Which runs there are, and the command line, stand in grids.py.

((BASH_VERSINFO[0] * 10 + BASH_VERSINFO[1] >= 44)) || { echo "bash 4.4 is needed" >&2; exit 2; }
set -ufo pipefail # -f: words with * and ? stay as they are

die() { # message, exit code
  echo "run_sweep.sh: $1" >&2
  exit "$2"
}

unusable() { # script, what the interpreter said
  die "$python cannot run $1: ${2##*$'\n'}; PYTHON=... names the interpreter" 1
}

# What grids.py makes of the script's arguments: a text for the user, or an assignment of the runs,
# folders[i] and commands[i], and of mode, preset, runs_dir and what else its for_bash() lists. It
# is followed here by a line with its exit code and the last line of its stderr.
ask_grids() {
  local answer end code said
  answer=$(
    { said=$("$python" "$scripts/grids.py" "$@" 2>&1 >&3); } 3>&1
    printf '\n%s %s' $? "${said##*$'\n'}"
  )
  end=$answer answer=${answer%$'\n'*}
  end=${end:${#answer}+1}
  code=${end%% *} said=${end#* }
  ((code != 2)) || die "$said" 2
  ((code == 0)) || unusable grids.py "$said"
  [[ -z $said ]] || echo "$said" >&2
  [[ $answer == mode=* ]] || { printf %s "$answer"; exit; } # with printf's code
  eval "$answer"
}

is_left() { [[ ! -e $1/summary.json && ! -e $1/failed ]]; }
is_locked() { [[ -e $1 ]] && ! flock -sn "$1" true; }

last_line() { # of what the run in folder $1 said since its last start; its error where there is one
  tail -c 4096 "$1/log.txt" 2>/dev/null | tr '\r' '\n' | awk '
    /^== / { error = last = ""; next }
    match($0, /error: /) { error = substr($0, RSTART) }
    NF { last = $0 }
    END { print error ? error : last ? last : "(it said nothing)" }'
}

halt() { # problem: ends the whole sweep, from a run's process
  kill -USR2 $$
  die "stopped: $1" 1
}

check_runs_dir() { # is it there, does it take a megabyte, and has it locks?
  local error probe=$runs_dir/.probe_${HOSTNAME}_$BASHPID
  [[ -d $runs_dir ]] || halt "the folder $runs_dir is gone"
  error=$({ printf '%1048576s' '' >"$probe" && flock -s "$probe" true; } 2>&1)
  rm -f "$probe"
  [[ -z $error ]] || halt "cannot write or lock files in $runs_dir: ${error##*: }"
}

# There is no queue and no database: a run's state is what lies in its folder. summary.json: it is
# complete. failed: it failed. A flock on log.txt: a sweep has it (the run's output goes there, so
# the lock lives as long as a process that writes to it). A flock on lock: a process trains. Each
# sweep goes through the list and starts what is free, and so two of them share the work.
run() { # number, attempt: does a run, in a process of its own, unless another sweep is faster
  local folder=${folders[$1]} code reason
  trap 'stopping=yes' TERM # and wait for the run, which saves
  check_runs_dir
  { mkdir -p "$folder" && exec 9>>"$folder/log.txt"; } || halt "cannot write to $folder"
  flock -n 9 && is_left "$folder" && [[ -z $stopping ]] || exit
  printf '\n== %(%F %T)T %s: %s\n' -1 "$HOSTNAME" "${commands[$1]}" >&9
  { eval "${commands[$1]}"; } </dev/null >&9 2>&1 9>&-
  code=$? reason=$(last_line "$folder")
  if [[ -e $folder/summary.json ]]; then
    echo "complete (run $(($1 + 1)) of ${#folders[@]}): $reason"
  elif [[ -z $stopping && $code != 3 ]]; then # 3: another process had it
    check_runs_dir
    [[ ! "$code $reason" =~ ^12[67]\ |No\ space\ left|[Qq]uota\ exceeded ]] ||
      halt "$folder: $reason"
    [[ $code =~ ^(129|130|137|143)$ && $2 -lt 5 ]] && exit # killed: it is taken up again
    echo "exit code $code: $reason" >"$folder/failed"
    echo "failed: $folder: exit code $code: $reason"
  fi
}

work() { # starts what is free until nothing is left; waits for runs of others, which may die
  local i n_left waiting='' started active attempts=()
  while [[ -z $stopping ]]; do
    n_left=0 started=''
    for i in "${!folders[@]}"; do
      is_left "${folders[i]}" || continue
      n_left=$((n_left + 1))
      is_locked "${folders[i]}/log.txt" || is_locked "${folders[i]}/lock" && continue
      while mapfile -t active < <(jobs -rp) && ((${#active[@]} >= jobs)); do wait -n; done
      [[ -z $stopping ]] || break
      attempts[i]=$((${attempts[i]-0} + 1)) started=yes
      set -m # in a process group of its own: Ctrl-C reaches the sweep alone, which tells it once
      run "$i" "${attempts[i]}" &
      set +m
    done
    until wait; do :; done # a signal ends a wait
    [[ -z $started ]] || continue
    ((n_left)) && [[ $mode == local ]] || return
    [[ -n $waiting ]] || echo "waiting for $n_left runs that other processes have taken"
    waiting=yes
    sleep 2
  done
}

# shellcheck disable=SC2317 # reachable, by traps
stop() { # exit code: ends the runs, which save what they have; at a second signal they do not
  local group
  stopping=$1
  for group in $(jobs -p); do kill -- "-$group" 2>/dev/null; done
}

report() { # lists what failed, and counts; true where all runs are complete
  local folder complete=0 failed=0
  for folder in "${folders[@]}"; do
    if [[ -e $folder/summary.json ]]; then
      complete=$((complete + 1))
    elif [[ -e $folder/failed ]]; then
      failed=$((failed + 1))
      echo "failed: $folder: $(<"$folder/failed")"
    fi
  done
  ((failed == 0)) || echo "all they said is in log.txt there; --retry-failed takes them up again"
  echo "$preset: $complete of ${#folders[@]} runs are complete, $failed failed"
  ((complete == ${#folders[@]}))
}

submit() { # the script's arguments: cuts what is left into tasks, and submits these as job arrays
  local i max size job ids='' n_left=0 starts=() load=0 weight capacity=${runs_per_task:-4}
  max=$(scontrol show config | awk '$1 == "MaxArraySize" { print $3 }')
  [[ -n $max ]] || die "--slurm: scontrol does not tell MaxArraySize: is this a Slurm cluster?" 1
  for i in "${!folders[@]}"; do
    is_left "${folders[i]}" || continue
    n_left=$((n_left + 1)) weight=1
    [[ -n $runs_per_task || ${commands[i]} != *" Ant"* ]] || weight=$capacity
    load=$((load + weight))
    ((load <= capacity && n_left > 1)) || starts+=("$i") load=$weight
  done
  ((n_left)) || { echo "$preset: nothing to do"; return; }
  mkdir -p "$runs_dir/slurm" || exit 1
  echo "$n_left runs in ${#starts[@]} tasks; their messages: $runs_dir/slurm" || exit 1
  # A task is this very command with --task FIRST:END, its part of the list: from where it starts to
  # where the next one does. USR1 comes two minutes before the time limit: main() queues it again.
  for ((i = 0; i < ${#starts[@]}; i += max)); do
    size=$((${#starts[@]} - i < max ? ${#starts[@]} - i : max))
    # shellcheck disable=SC2086 # $sbatch is a list of options
    job=$(sbatch --parsable --job-name="$preset" --array="0-$((size - 1))" --requeue \
      --open-mode=append --signal=B:USR1@120 --output="$runs_dir/slurm/%A_%a.log" \
      $sbatch --chdir="$PWD" <<END
#!/bin/bash
starts=(${starts[*]:i:max + 1} ${#folders[@]})
task=\${starts[SLURM_ARRAY_TASK_ID]}:\${starts[SLURM_ARRAY_TASK_ID + 1]}
exec env $(printf '%q ' "PYTHON=$python" bash "$0") --task \$task $(printf '%q ' "$@")
END
    ) || die "sbatch refused; submitted so far: ${ids:-nothing}; later, the same command again" 1
    ids+=" ${job%%;*}"
  done
  echo "submitted as job$ids; to stop: scancel$ids; to go on: the same command"
}

main() {
  local python=${PYTHON:-python} scripts stopping='' text
  local mode preset runs_dir jobs retry_failed sbatch runs_per_task folders commands
  scripts=$(dirname "$0")
  ask_grids "$@"
  [[ $mode != task ]] || jobs=${SLURM_CPUS_PER_TASK:-1} retry_failed=''
  command -v flock >/dev/null || die "no flock here (on macOS: brew install flock)" 1
  jobs=${jobs:-$(env -u OMP_NUM_THREADS nproc 2>/dev/null)}
  [[ -n $jobs ]] || die "no nproc here: say with -j how many runs at a time" 1
  text=$("$python" "$scripts/ppo_colored_continuous.py" --help 2>&1 >/dev/null) ||
    unusable ppo_colored_continuous.py "$text"
  trap '[[ -n $stopping ]] || stop 1' USR2
  mkdir -p "$runs_dir" || exit 1
  check_runs_dir
  [[ -z $retry_failed ]] || printf '%s/failed\0' "${folders[@]}" | xargs -0 rm -f
  [[ $mode != slurm ]] || { submit "$@"; exit; }

  echo "$preset: ${#folders[@]} runs, $jobs at a time" || exit
  trap 'stop 130' INT
  trap 'stop 143' TERM HUP
  [[ $mode != task ]] || trap 'stop requeue' USR1
  work
  report && exit
  if [[ $stopping == requeue ]]; then # the job id alone is the whole array's in its last task
    scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
    exit
  fi
  [[ $mode == task ]] || echo "to go on:$(printf ' %q' ${PYTHON:+"PYTHON=$PYTHON"} "$0" "$@")"
  exit "${stopping:-1}"
}
main "$@"
