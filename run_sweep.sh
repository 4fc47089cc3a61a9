#!/usr/bin/env bash
# Runs the paper's grids, each run in a process of its own on one core: --help tells how to use it.
# Which runs there are, and the command line, stand in study/sweep.py.
#
# There is no queue and no database. The state of a run is what lies in its folder:
#   summary.json  the run is complete
#   failed        it failed: its exit code and error
#   log.txt       its output. While it runs, its process has a flock on this file.
# Each sweep goes through the list and takes runs that are free, so two sweeps share the work.

((BASH_VERSINFO[0] * 10 + BASH_VERSINFO[1] >= 44)) || { echo "bash 4.4 is needed" >&2; exit 2; }
set -ufo pipefail # -f: words with * and ? stay as they are

die() { # message
  echo "run_sweep.sh: $1" >&2
  exit 1
}

is_left() { [[ ! -e $1/summary.json && ! -e $1/failed ]]; }

run() { # number, and "wait" for a run that another process has: does a run that is left
  local folder=${folders[$1]} code said
  mkdir -p "$folder" && exec 9>>"$folder/log.txt" || exit
  flock -n 9 || { [[ $2 == wait ]] && echo "waiting for $folder" && flock 9; } || exit
  is_left "$folder" || exit
  printf '\n== %(%F %T)T %s: %s\n' -1 "$HOSTNAME" "${commands[$1]}" >&9
  { eval "${commands[$1]}"; } </dev/null >&9 2>&1 9>&-
  code=$? said=$(tail -c 4096 "$folder/log.txt" | tr '\r' '\n' | grep -v '^ *$' | tail -n 1)
  if [[ -e $folder/summary.json ]]; then
    echo "complete (run $(($1 + 1)) of ${#folders[@]}): $said"
  elif ((code == 3 || code > 128)); then # a process that no sweep started has it; or a signal
    echo "still to do: $folder: exit code $code: $said"
  else
    echo "exit code $code: $said" >"$folder/failed"
    echo "failed: $folder: exit code $code: $said"
  fi
}

work() { # "pass" or "wait": does what is left; passes over the runs of others, or waits for them
  local i
  for i in "${!folders[@]}"; do
    is_left "${folders[i]}" || continue
    while (($(jobs -rp | wc -l) >= jobs)); do wait -n; done
    set -m # in a process group of its own, which end_runs() kills
    run "$i" "$1" &
    set +m
  done
  wait
}

# shellcheck disable=SC2317 # reachable, by traps
end_runs() { # at once: their checkpoints are a few seconds old
  local group
  trap '' INT TERM HUP USR1
  for group in $(jobs -p); do kill -- "-$group"; done 2>/dev/null
  wait 2>/dev/null
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
  ((failed == 0)) || echo "their output is in log.txt there; --retry-failed runs them again"
  echo "$preset: $complete of ${#folders[@]} runs are complete, $failed failed"
  ((complete == ${#folders[@]}))
}

submit() { # the script's arguments: submits a job array, each task of which is this very command
  local folder left=0 job
  for folder in "${folders[@]}"; do is_left "$folder" && left=$((left + 1)); done
  ((left)) || { echo "$preset: nothing to do"; return; }
  mkdir -p "$runs_dir/slurm" || exit
  # USR1 comes a minute before the time limit
  # shellcheck disable=SC2086 # $sbatch is a list of options
  job=$(sbatch --parsable --job-name="$preset" --array="1-$slurm" --requeue --open-mode=append \
    --signal=B:USR1@60 --output="$runs_dir/slurm/%A_%a.log" $sbatch <<END
#!/bin/bash
exec env $(printf '%q ' "PYTHON=$python" bash "$scripts/run_sweep.sh" "$@")
END
  ) || exit
  echo "$left runs in $slurm tasks, submitted as job ${job%%;*}; to stop: scancel ${job%%;*};" \
    "to go on: the same command; messages: $runs_dir/slurm"
}

main() {
  local python=${PYTHON:-python} scripts sweep go_on task
  local preset runs_dir jobs retry_failed slurm sbatch folders commands
  scripts=$(dirname "$(realpath "$0")")
  export PYTHONPATH=$scripts${PYTHONPATH:+:$PYTHONPATH}
  sweep=$(PYTHONSAFEPATH=1 "$python" -m study.sweep "$@") || exit # no study in the current folder
  [[ $sweep == preset=* ]] || { printf '%s\n' "$sweep"; exit; }
  eval "$sweep"
  task=${slurm:+${SLURM_ARRAY_TASK_ID:-}} # in a task of the job array
  command -v flock >/dev/null || die "there is no flock here (on macOS: brew install flock)"
  [[ $task || -z $retry_failed ]] || printf '%s/failed\0' "${folders[@]}" | xargs -0 rm -f
  [[ $task || -z $slurm ]] || { submit "$@"; exit; }
  "$python" "$scripts/ppo_colored_continuous.py" --help >/dev/null ||
    die "$python cannot run ppo_colored_continuous.py; PYTHON=... names the interpreter"

  go_on=$(printf ' %q' ${PYTHON:+"PYTHON=$PYTHON"} "$0" "$@")
  trap 'end_runs; echo "stopped; to go on:$go_on"; exit 130' INT
  trap 'end_runs; echo "stopped; to go on:$go_on"; exit 143' TERM HUP
  if [[ $task ]]; then # its own id: that of the job alone is the whole array's
    trap 'end_runs; scontrol requeue "${SLURM_ARRAY_JOB_ID}_$task"; exit' USR1
  fi
  echo "$preset: ${#folders[@]} runs, $jobs at a time"
  work pass
  [[ $task ]] || work wait
  report || [[ $task ]] # a task is done when the others have the rest
}
main "$@"
