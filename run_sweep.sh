#!/usr/bin/env bash
# Runs the paper's grids: each run in a process of its own on one core, resumable, none done twice.
#
# usage: run_sweep.sh PRESET [what to run] [how to run it] [-- FLAGS FOR EVERY RUN]
#
# presets, each the paper's experiment as it was (dm_control without bootstrap at time limits)  runs
#   quick     Mountain Car, beta 0 and 0.5, n_envs 4, seeds 1 and 2: minutes                       4
#   main      the study: 16 environments x 8 betas x n_envs 1, 2, 4, ..., 128 x 20 seeds       20480
#   vanilla   the Vanilla column: white noise from torch's own generator, else as main          2560
#   n_steps   n_envs 2, 4, 8 with n_steps 4096, 2048, 1024 (update size 8192), beta 0.5          960
#   n_epochs  5, 10 and 20 epochs, beta 0.2, 0.5 and 0.75, n_envs 4                             2880
#   complex   PointPush, AntPush, PointPushMaze and AntPushMaze, 8 betas, n_envs 4               640
#   transfer  TRPO and A2C (baselines.py), 16 environments, 8 betas, n_envs 4                   5120
#   gsde      gSDE (baselines.py) in place of colored noise, 16 environments, n_envs 1 to 128   2560
# what to run, quoted lists in place of the preset's
#   --envs "A B"        those below (or short: cheetah-run), or any id NAME-v0 or MODULE:NAME
#   --betas "0 0.5"     noise colors; likewise --n-envs, --seeds; in n_epochs --n-epochs "5 20"
#   --exp-name NAME     folder of the experiment (ppo_colored_continuous; trpo, a2c, gsde), to which
#                       n_steps and n_epochs add _n_steps_1024 and the like
#   --runs-dir FOLDER   where the experiments are (runs); on a cluster, all nodes must share it
#   -- FLAGS            for every run, as in "-- --device cpu". Those that change the result need an
#                       --exp-name of their own: a run's path does not show them.
# how to run it
#   -j N                N runs at a time on this machine (as many as it has cores)
#   --print             print one command per line and nothing else, for GNU parallel or a queue
#   --status            say how many are done, running, failed and to do, and the time left
#   --retry-failed      take up failed runs again, from their last checkpoint
#   --slurm             submit what is to do as job arrays
#   --sbatch "OPTIONS"  for sbatch: "--partition=cpu --time=12:00:00 --mem-per-cpu=2G"; with
#                       --cpus-per-task=8 a task does its runs 8 at a time
#   --runs-per-task K   runs in a task of the array (4; 1 for the ant, which takes over an hour)
#
# PYTHON names the interpreter (python), as in PYTHON=.venv/bin/python ./run_sweep.sh quick
# Stop it whenever you like (Ctrl-C, kill, scancel): the same command goes on where it was. On a
# second machine that sees the runs folder it shares the work. A run's output is in log.txt in its
# folder. A failed run has its exit code and error in the file "failed" there; it is not tried again
# without --retry-failed.
# Exit code: 0 all runs complete (or submitted), 1 some are not, 2 wrong usage, 130 or 143 stopped.

# shellcheck disable=SC2086,SC2206 # lists of words stand without quotes on purpose
((BASH_VERSINFO[0] * 10 + BASH_VERSINFO[1] >= 44)) || { echo "bash 4.4 is needed" >&2; exit 2; }
set -ufo pipefail # -f: words with * and ? stay as they are

study_envs=$(echo MountainCarContinuous-v0 dm_control/cartpole-{balance,swingup}_sparse-v0 \
  dm_control/{ball_in_cup-catch,hopper-hop,cheetah-run,walker-run,reacher-hard}-v0 \
  dm_control/pendulum-swingup-v0 door-v0 {PointUMaze,AntUMaze,Point4Rooms}-v1 \
  {SwimmerUMaze,Swimmer4Rooms,Ant4Rooms}-v1)
complex_envs="PointPush-v1 AntPush-v1 PointPushMaze-v1 AntPushMaze-v1"
all_n_envs="1 2 4 8 16 32 64 128"

die() { # message, exit code (2: wrong usage)
  echo "run_sweep.sh: $1" >&2
  exit "${2:-2}"
}

usage() { # the comment at the top
  sed '1d; /^$/,$d; s/^# \{0,1\}//' "$0" &&
    fold -sw 100 <<<"environments: $study_envs $complex_envs"
  exit
}

full_id() { # the id behind a short name such as cheetah-run, and any other id as it is
  local id
  for id in $study_envs $complex_envs; do
    [[ $id == ?(dm_control/)"$1"?(-v[0-9]) ]] && echo "$id" && return
  done
  [[ $1 =~ :|-v[0-9]+$ ]] && echo "$1"
}

parse_args() {
  local word words n='[1-9][0-9]{0,8}'
  local -A allowed=([--envs]='[A-Za-z0-9_./:-]+' [--betas]='-?([0-9]+\.?[0-9]*|\.[0-9]+)'
    [--n-envs]=$n [--seeds]="0|$n" [--n-epochs]=10 [--exp-name]='[A-Za-z0-9_][A-Za-z0-9._-]*'
    [--runs-dir]='[^-[:cntrl:]][^[:cntrl:]]*' [-j]=$n [--sbatch]='.+' [--runs-per-task]=$n
    [--task]='[0-9]+:[0-9]+')
  option=([--envs]=$study_envs [--betas]="-1 0 0.2 0.5 0.75 1 1.25 2" [--n-envs]=4
    [--seeds]=$(echo {1..20}) [--n-epochs]=10 [--runs-dir]=runs)
  preset=${1-} mode=local retry_failed='' methods=ppo run_flags=()
  case $preset in
    quick) option+=([--envs]=MountainCarContinuous-v0 [--betas]="0 0.5" [--seeds]="1 2") ;;
    main) option+=([--n-envs]=$all_n_envs) ;;
    vanilla) option+=([--n-envs]=$all_n_envs [--betas]=vanilla) allowed[--betas]=vanilla ;;
    n_steps) option+=([--n-envs]="2 4 8" [--betas]=0.5) allowed[--n-envs]="${all_n_envs// /|}" ;;
    n_epochs) option+=([--n-epochs]="5 10 20" [--betas]="0.2 0.5 0.75") allowed[--n-epochs]=$n ;;
    complex) option+=([--envs]=$complex_envs) ;;
    transfer) methods="trpo a2c" ;;
    gsde) option+=([--n-envs]=$all_n_envs [--betas]=gsde) methods=gsde allowed[--betas]=gsde ;;
    -h | --help) usage ;;
    *) die "'$preset' is not a preset: quick, main, vanilla, ... (--help)" ;;
  esac
  while shift && (($#)); do
    case $1 in
      --print | --status | --slurm)
        [[ $mode == local || --$mode == "$1" ]] || die "$1 and --$mode: choose one"
        mode=${1#--}
        ;;
      --retry-failed) retry_failed=yes ;;
      -h | --help) usage ;;
      --) run_flags=("${@:2}") && break ;;
      *)
        [[ -n ${allowed[$1]-} ]] || die "unknown argument '$1' (--help; flags for runs follow --)"
        if [[ $1 == *s ]]; then words=(${2-}); else words=("${2-}"); fi # plurals are lists
        for word in "${words[@]:-}"; do
          [[ $word =~ ^(${allowed[$1]})$ ]] || die "$1: '$word' is not allowed here (--help)"
        done
        option[$1]=$2 && shift
        ;;
    esac
  done
  [[ -z ${option[--task]-} ]] || mode=task
  for word in "${run_flags[@]%%=*}"; do
    [[ ! $word =~ ^--(env-id|beta|vanilla|n-envs|seed|exp-name|runs-dir|resume|overwrite)$ &&
      $word != "--${preset/_/-}" ]] || die "$word is set by the sweep and cannot follow --"
  done
}

# All runs of the sweep: folders[i] and commands[i]. Seeds come outermost, so that a sweep cut short
# has whole grids.
list_runs() {
  local word envs='' exp_name=${option[--exp-name]-} start end
  local seed env n beta epochs method script name noise flags
  local -A seen=()
  for word in ${option[--envs]}; do
    envs+=" $(full_id "$word")" || die "--envs: '$word' is no environment (--help lists them)"
  done
  printf -v start '%q %q/' "$python" "$scripts"
  printf -v end ' %q' --runs-dir "$runs_dir" --threads 1 --resume "${run_flags[@]}"
  for seed in ${option[--seeds]}; do for env in $envs; do for n in ${option[--n-envs]}; do
  for beta in ${option[--betas]}; do for epochs in ${option[--n-epochs]}; do
  for method in $methods; do
    script=ppo_colored_continuous.py name=${exp_name:-ppo_colored_continuous}
    [[ $method == ppo ]] || script="baselines.py $method" name=${exp_name:+${exp_name}_}$method
    noise=$beta flags=''
    if [[ $beta == vanilla ]]; then
      flags=" --vanilla"
    elif [[ $beta != gsde ]]; then
      LC_ALL=C printf -v beta %g "$beta" # 0.50 is 0.5
      [[ $beta != -0 ]] || beta=0
      noise=beta_$beta flags=" --beta $beta"
    fi
    if [[ $preset == n_steps && $n != 4 ]]; then
      flags+=" --n-steps $((8192 / n))" name+=_n_steps_$((8192 / n))
    elif ((epochs != 10)); then
      flags+=" --n-epochs $epochs" name+=_n_epochs_$epochs
    fi
    flags="--env-id $env$flags --n-envs $n --seed $seed --exp-name $name"
    [[ $env != dm_control/* ]] || flags+=" --no-bootstrap-timeouts"
    [[ -z ${seen[$flags]-} ]] || continue
    seen[$flags]=yes commands+=("$start$script $flags$end")
    folders+=("$runs_dir/$name/${env//\//_}/$noise/n_envs_$n/seed_$seed")
  done; done; done; done; done; done
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
  local i max size job ids='' n_left=0 starts=() load=0 weight
  local capacity=${option[--runs-per-task]:-4}
  max=$(scontrol show config | awk '$1 == "MaxArraySize" { print $3 }')
  [[ -n $max ]] || die "--slurm: scontrol does not tell MaxArraySize: is this a Slurm cluster?" 1
  for i in "${!folders[@]}"; do
    is_left "${folders[i]}" || continue
    n_left=$((n_left + 1)) weight=1
    [[ -n ${option[--runs-per-task]-} || ${commands[i]} != *" Ant"* ]] || weight=$capacity
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
    job=$(sbatch --parsable --job-name="$preset" --array="0-$((size - 1))" --requeue \
      --open-mode=append --signal=B:USR1@120 --output="$runs_dir/slurm/%A_%a.log" \
      ${option[--sbatch]-} --chdir="$PWD" <<END
#!/bin/bash
starts=(${starts[*]:i:max + 1} ${#folders[@]})
task=\${starts[SLURM_ARRAY_TASK_ID]}:\${starts[SLURM_ARRAY_TASK_ID + 1]}
exec env $(printf '%q ' "PYTHON=$python" bash "$0" "$1") --task \$task $(printf '%q ' "${@:2}")
END
    ) || die "sbatch refused; submitted so far: ${ids:-nothing}; later, the same command again" 1
    ids+=" ${job%%;*}"
  done
  echo "submitted as job$ids; to stop: scancel$ids; to go on: the same command"
}

main() {
  local python=${PYTHON:-python} scripts stopping='' folders=() commands=() text first count
  local -A option
  scripts=$(dirname "$0")
  parse_args "$@"
  runs_dir=${option[--runs-dir]%/} jobs=${option[-j]-}
  list_runs
  if [[ $mode == print ]]; then
    printf '%s\n' "${commands[@]}"
    exit # with printf's code
  elif [[ $mode == status ]]; then
    text=$(printf '%s\n' "${folders[@]}" |
      "$python" "$scripts/analysis.py" status - --name "$preset") && echo "$text"
    exit
  elif [[ $mode == task ]]; then
    first=${option[--task]%:*} count=$((${option[--task]#*:} - first))
    folders=("${folders[@]:first:count}") commands=("${commands[@]:first:count}")
    jobs=${SLURM_CPUS_PER_TASK:-1} retry_failed=''
  fi
  [[ -n ${option[--exp-name]-} || ${#run_flags[@]} == 0 ]] ||
    echo "run_sweep.sh: note: flags that change the result need an --exp-name of their own" >&2
  command -v flock >/dev/null || die "no flock here (on macOS: brew install flock)" 1
  jobs=${jobs:-$(env -u OMP_NUM_THREADS nproc 2>/dev/null)}
  [[ -n $jobs ]] || die "no nproc here: say with -j how many runs at a time" 1
  text=$("$python" "$scripts/ppo_colored_continuous.py" --help 2>&1 >/dev/null) ||
    die "$python cannot run the script: ${text##*$'\n'}; PYTHON=... names the interpreter" 1
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
