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
#   --envs "A B"        environments: those below (cheetah-run is short for
#                       dm_control/cheetah-run-v0), or any id of the form NAME-v0 or MODULE:NAME
#   --betas "0 0.5"     noise colors; likewise --n-envs "4 8", --seeds "1 2 3", and, only in the
#                       preset n_epochs, --n-epochs "5 20"
#   --exp-name NAME     the experiment, a folder in the runs folder (ppo_colored_continuous; trpo,
#                       a2c, gsde). n_steps and n_epochs add _n_steps_1024 and the like to it.
#   --runs-dir FOLDER   where the runs are (runs); on a cluster, a folder that all nodes share
#   -- FLAGS            handed to every run as they are, as in "-- --device cpu". Flags that change
#                       the result, as in "-- --learning-rate 1e-4", need an --exp-name of their
#                       own: they do not show in the path.
# how to run it
#   -j N                N runs at a time on this machine (as many as it has cores)
#   --print             print one command per line and nothing else, for GNU parallel or a queue
#   --status            say how many are done, running, failed and to do, and the time left
#   --slurm             submit what is to do as job arrays
#   --sbatch "OPTIONS"  handed to sbatch: "--partition=cpu --time=12:00:00 --mem-per-cpu=2G"; with
#                       --cpus-per-task=8 a task does its runs 8 at a time
#   --runs-per-task K   runs in a task of the array (4; 1 for the ant, which takes over an hour)
#   --retry-failed      take up failed runs again, from their last checkpoint
#
# PYTHON names the interpreter (python), as in PYTHON=.venv/bin/python ./run_sweep.sh quick
# Stop it whenever you like (Ctrl-C, kill, scancel): the same command goes on where it was. The same
# command on a second machine with that runs folder shares the work. A run's output is in log.txt
# in its folder. A failed run has its exit code in the file "failed" there, and is not tried again
# without --retry-failed.
# Exit code: 0 all runs complete (or submitted), 1 some are not, 2 wrong usage, 130 or 143 stopped.

# shellcheck disable=SC2015,SC2086,SC2206,SC2317  # lists of words stand without quotes on purpose
((BASH_VERSINFO[0] * 10 + BASH_VERSINFO[1] >= 44)) || { echo "bash 4.4 is needed" >&2; exit 2; }
set -ufo pipefail # -f: words with * and ? stay as they are
unset LC_ALL
export LC_NUMERIC=C # a decimal point in numbers

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
    [--runs-dir]='[^-[:cntrl:]][^[:cntrl:]]*' [-j]=$n [--sbatch]='.*' [--runs-per-task]=$n)
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
        [[ $mode == local || --$mode == "$1" ]] && mode=${1#--} || die "$1 and --$mode: choose one"
        ;;
      --retry-failed) retry_failed=yes ;;
      -h | --help) usage ;;
      --) run_flags=("${@:2}") && break ;;
      *)
        [[ -n ${allowed[$1]-} ]] || die "unknown argument '$1' (--help; flags for runs follow --)"
        [[ ${2-} == *[^[:space:]]* ]] || die "$1 needs a value (--help)"
        if [[ $1 == *s ]]; then words=($2); else words=("$2"); fi # plurals are lists
        for word in "${words[@]}"; do
          [[ $word =~ ^(${allowed[$1]})$ ]] || die "$1: '$word' is not allowed here (--help)"
        done
        option[$1]=$2 && shift
        ;;
    esac
  done
  for word in "${run_flags[@]%%=*}"; do
    [[ ! $word =~ ^--(env-id|beta|vanilla|n-envs|seed|exp-name|runs-dir|resume|overwrite)$ &&
      $word != "--${preset/_/-}" ]] || die "$word is set by the sweep and cannot follow --"
  done
}

# All runs of the sweep: folders[i] and commands[i]. Seeds come outermost, so that a sweep cut short
# has whole grids.
list_runs() {
  local word envs='' exp_name=${option[--exp-name]-} start end
  local seed env n beta epochs method script name noise flags timeouts
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
      case $beta in
        vanilla) noise=vanilla flags=" --vanilla" ;;
        gsde) noise=gsde flags='' ;;
        *)
          printf -v beta %g "$beta"
          [[ $beta != -0 ]] || beta=0
          noise=beta_$beta flags=" --beta $beta"
          ;;
      esac
      if [[ $preset == n_steps && $n != 4 ]]; then
        flags+=" --n-steps $((8192 / n))" name+=_n_steps_$((8192 / n))
      elif ((epochs != 10)); then
        flags+=" --n-epochs $epochs" name+=_n_epochs_$epochs
      fi
      if [[ $env == dm_control/* ]]; then timeouts=" --no-bootstrap-timeouts"; else timeouts=''; fi
      word=$runs_dir/$name/${env//\//_}/$noise/n_envs_$n/seed_$seed
      [[ -z ${seen[$word]-} ]] || continue
      seen[$word]=yes folders+=("$word")
      flags="--env-id $env$flags --n-envs $n --seed $seed --exp-name $name$timeouts"
      commands+=("$start$script $flags$end")
    done
  done; done; done; done; done
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

can_write() { # whether the runs folder is there, takes a megabyte and has locks; else $problem
  local probe=$runs_dir/.probe_${HOSTNAME}_$BASHPID
  problem="the folder $runs_dir is gone"
  [[ -d $runs_dir ]] || return 1
  problem=$({ printf '%1048576s' '' >"$probe" && flock -s "$probe" true; } 2>&1)
  rm -f "$probe"
  [[ -z $problem ]] || problem="cannot write or lock files in $runs_dir: ${problem##*: }"
  [[ -z $problem ]]
}

halt() { # problem: ends a worker, and by it the whole sweep
  echo "run_sweep.sh: stopped: $1" >&2
  kill -USR2 $$
  exit
}

# There is no queue and no database: a run's state is what lies in its folder. summary.json: it is
# complete. failed: it failed. A flock on log.txt: a worker has it (the run's output goes there, so
# the lock lives as long as a process that writes to it). A flock on lock: a process trains. Each
# worker goes through the list and does what is free: two sweeps share the work as two workers do.
worker() { # does those of the runs `free` that are still free, one after the other
  local run folder try code reason
  trap 'stopping=yes' TERM
  for run in "${free[@]}"; do
    folder=${folders[run]}
    for try in 1 2 3 4 5; do
      [[ -z $stopping ]] && kill -0 $$ 2>/dev/null || exit # kill -9 may have ended the sweep
      is_left "$folder" || break
      can_write || halt "$problem"
      mkdir -p "$folder" && exec 9>>"$folder/log.txt" || halt "cannot write to $folder"
      flock -n 9 && ! is_locked "$folder/lock" && is_left "$folder" || break
      printf '\n== %(%F %T)T %s: %s\n' -1 "$HOSTNAME" "${commands[run]}" >&9
      { eval "${commands[run]}"; } </dev/null >&9 2>&1 9>&-
      code=$? reason=$(last_line "$folder")
      if [[ -e $folder/summary.json ]]; then
        echo "complete (run $((run + 1)) of ${#folders[@]}): $reason"
      elif [[ -n $stopping || $code == 3 ]]; then # 3: another process was faster
        break
      elif ! can_write; then
        halt "$problem"
      elif [[ $code =~ ^12[67]$ || $reason =~ No\ space\ left|[Qq]uota\ exceeded ]]; then
        halt "$folder: $reason"
      elif [[ -d $folder && (! $code =~ ^(129|130|137|143)$ || $try == 5) ]]; then
        echo "$code" >"$folder/failed"
        echo "failed: $folder: $reason"
      fi # else it was killed or its folder was removed: once more
    done
  done
}

work() { # starts workers until nothing is left; waits for runs of other processes: these may die
  local i n_left n_waiting='' free
  while [[ -z $stopping ]]; do
    n_left=0 free=()
    for i in "${!folders[@]}"; do
      is_left "${folders[i]}" && n_left=$((n_left + 1)) || continue
      is_locked "${folders[i]}/log.txt" || is_locked "${folders[i]}/lock" || free+=("$i")
    done
    set -m # workers in process groups of their own: Ctrl-C reaches the sweep alone, which tells
    # each run once. At a second signal a run ends without saving.
    for ((i = 0; i < jobs && i < ${#free[@]}; i++)); do [[ -n $stopping ]] || worker & done
    set +m
    until wait; do :; done # a signal ends a wait
    ((${#free[@]})) && continue
    [[ $n_left != 0 && $mode == local ]] || return
    [[ $n_waiting == "$n_left" ]] || echo "waiting for $n_left runs that other processes have taken"
    n_waiting=$n_left
    sleep 2
  done
}

stop() { # exit code: ends the runs, which save what they have; the second time without
  local group signal=TERM
  [[ -z $stopping ]] || signal=KILL
  stopping=$1
  for group in $(jobs -p); do kill -s "$signal" -- "-$group" 2>/dev/null; done
}

report() { # lists what failed, and counts; true where all runs are complete
  local folder complete=0 failed=0
  for folder in "${folders[@]}"; do
    [[ -e $folder/summary.json ]] && complete=$((complete + 1)) && continue
    [[ -e $folder/failed ]] && failed=$((failed + 1)) || continue
    echo "failed with exit code $(<"$folder/failed"): $folder: $(last_line "$folder")"
  done
  ((failed == 0)) || echo "all they said is in log.txt there; --retry-failed takes them up again"
  echo "$preset: $complete of ${#folders[@]} runs are complete, $failed failed"
  ((complete == ${#folders[@]}))
}

# Packs what is left into tasks, writes these to a file in the runs folder, and submits job arrays
submit() {
  local i dir batch job max first last weight load=0 task=-1 ids=''
  local capacity=${option[--runs-per-task]:-4}
  max=$(scontrol show config | awk '$1 == "MaxArraySize" { print $3 }')
  [[ -n $max ]] || die "--slurm: scontrol does not tell MaxArraySize: is this a Slurm cluster?" 1
  dir=$runs_dir/slurm/$(date +%Y%m%d_%H%M%S)_${preset}_$$
  mkdir -p "$dir" || exit 1
  for i in "${!folders[@]}"; do
    is_left "${folders[i]}" && weight=1 || continue
    [[ -n ${option[--runs-per-task]-} || ${commands[i]} != *" Ant"* ]] || weight=$capacity
    (((load += weight) <= capacity && task >= 0)) || task=$((task + 1)) load=$weight
    printf '%s\t%s\t%s\n' "$task" "${folders[i]}" "${commands[i]}"
  done >"$dir/tasks" || exit 1
  ((task >= 0)) || { echo "$preset: nothing to do" && return; }
  echo "$(wc -l <"$dir/tasks") runs in $((task + 1)) tasks; their messages: $dir" || exit 1
  printf -v batch '%q ' "PYTHON=$python" "$scripts/run_sweep.sh" --task "$runs_dir" "$dir/tasks"
  for ((first = 0; first <= task; first += max)); do
    last=$((task - first < max ? task - first : max - 1))
    # USR1 comes two minutes before the time limit: the task stops its runs and queues again
    job=$(echo "#!/bin/bash"$'\n'"exec env $batch \$(($first + SLURM_ARRAY_TASK_ID))" |
      sbatch --parsable --job-name="$preset" --array="0-$last" --requeue --open-mode=append \
        --signal=B:USR1@120 --output="$dir/%A_%a.log" ${option[--sbatch]-}) ||
      die "sbatch refused; submitted so far: ${ids:-nothing}; later, the same command again" 1
    ids+=" ${job%%;*}"
  done
  echo "submitted as job$ids; to stop: scancel$ids; to go on: the same command"
}

main() {
  local folder status error problem='' stopping='' folders=() commands=()
  local python=${PYTHON:-python} scripts
  local -A option=()
  scripts=$(dirname "$0")
  if [[ ${1-} == --task ]]; then # a task of submit(): --task RUNS_DIR FILE NUMBER
    mode=task preset="task $4" runs_dir=$2 jobs=${SLURM_CPUS_PER_TASK:-1} retry_failed=''
    mapfile -t folders < <(awk -F '\t' "\$1 == $4 { print \$2 }" "$3")
    mapfile -t commands < <(awk -F '\t' "\$1 == $4 { print \$3 }" "$3")
  else
    parse_args "$@"
    runs_dir=${option[--runs-dir]%/} jobs=${option[-j]-}
    [[ $mode == print || $mode == status ]] || mkdir -p "$runs_dir" || exit 1
    [[ $mode != slurm ]] || runs_dir=$(cd "$runs_dir" && pwd) scripts=$(cd "$scripts" && pwd)
    list_runs
    # What only prints must end here, also where nobody can read it
    [[ $mode != print ]] || { printf '%s\n' "${commands[@]}"; exit; }
    if [[ $mode == status ]]; then
      status=$(printf '%s\n' "${folders[@]}" |
        "$python" "$scripts/analysis.py" status - --name "$preset") && echo "$status"
      exit
    fi
    [[ -n ${option[--exp-name]-} || ${#run_flags[@]} == 0 ]] ||
      echo "run_sweep.sh: note: flags that change the result need an --exp-name of their own" >&2
  fi
  command -v flock >/dev/null || die "no flock here (on macOS: brew install flock)" 1
  jobs=${jobs:-$(env -u OMP_NUM_THREADS nproc 2>/dev/null)}
  [[ -n $jobs ]] || die "no nproc here: say with -j how many runs at a time" 1
  error=$("$python" "$scripts/ppo_colored_continuous.py" --help 2>&1 >/dev/null) ||
    die "$python cannot run the script: ${error##*$'\n'}; PYTHON=... names the interpreter" 1
  can_write || die "$problem" 1
  [[ -z $retry_failed ]] || for folder in "${folders[@]}"; do rm -f "$folder/failed"; done
  [[ $mode != slurm ]] || { submit; exit; }

  echo "$preset: ${#folders[@]} runs, $jobs at a time" || exit
  trap 'stop 130' INT
  trap 'stop 143' TERM HUP
  trap '[[ -n $stopping ]] || stop 1' USR2
  [[ $mode != task ]] || trap 'stop requeue' USR1
  work
  report && exit
  # The job id alone would be the whole array's, in its last task
  [[ $stopping != requeue ]] ||
    { scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"; exit; }
  [[ $mode == task ]] || echo "to go on:$(printf ' %q' ${PYTHON:+"PYTHON=$PYTHON"} "$0" "$@")"
  exit "${stopping:-1}"
}
main "$@"
