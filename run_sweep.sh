#!/usr/bin/env bash
# Grids of runs of ppo_colored_continuous.py, on local cores or on a Slurm cluster; usage() says how to use it.
#
# There is no queue and no database: a run's state is what lies in its folder. summary.json: it is complete. failed: it
# failed, with this exit code. A flock on log.txt: a sweep has taken it (the run's output goes there, so the lock lives
# exactly as long as a process that writes to it). A flock on lock: a training process works on it.
((BASH_VERSINFO[0] * 100 + BASH_VERSINFO[1] >= 404)) || { echo "run_sweep.sh needs bash 4.4 or newer" >&2 && exit 2; }
set -ufo pipefail
unset LC_ALL
export LC_NUMERIC=C OMP_NUM_THREADS=1

STUDY_ENVS=(MountainCarContinuous-v0 dm_control/cartpole-balance_sparse-v0 dm_control/cartpole-swingup_sparse-v0
  dm_control/ball_in_cup-catch-v0 dm_control/hopper-hop-v0 dm_control/cheetah-run-v0 dm_control/walker-run-v0
  dm_control/reacher-hard-v0 dm_control/pendulum-swingup-v0 door-v0 PointUMaze-v1 AntUMaze-v1 Point4Rooms-v1
  SwimmerUMaze-v1 Swimmer4Rooms-v1 Ant4Rooms-v1)
COMPLEX_ENVS=(PointPush-v1 AntPush-v1 PointPushMaze-v1 AntPushMaze-v1)
OTHER_ENVS=() # your own, for --envs

usage() {
  cat <<'END'
Runs the paper's grids: each run in a process of its own on one core, resumable, none done twice.

usage: run_sweep.sh PRESET [what to run] [how to run it] [-- FLAGS FOR EVERY RUN]

presets                                                                                     runs
  quick      MountainCar, beta 0 and 0.5, n_envs 4, seeds 1 and 2: minutes                     4
  main       the study: 16 environments x 8 betas x n_envs 1, 2, 4, ..., 128 x 20 seeds    20480
  vanilla    the Vanilla column: white noise from torch's own generator, else as main       2560
  n_steps    n_envs 2, 4, 8 with n_steps 4096, 2048, 1024 (update size 8192), beta 0.5       960
  n_epochs   5, 10 and 20 epochs, beta 0.2, 0.5 and 0.75, n_envs 4                          2880
  complex    PointPush, AntPush, PointPushMaze and AntPushMaze, 8 betas, n_envs 4            640

what to run: quoted lists in place of the preset's
  --envs "A B"         environments, listed below; cheetah-run is short for dm_control/cheetah-run-v0
  --betas "0 0.5"      noise colors
  --n-envs "4 8"       numbers of parallel environments
  --seeds "1 2 3"      seeds
  --n-epochs "5 20"    epochs (only in the preset n_epochs)
  --exp-name NAME      the experiment, a folder in the runs folder (ppo_colored_continuous). The presets n_steps and
                       n_epochs add _n_steps_1024 and the like to it where they leave the default.
  --runs-dir FOLDER    where the runs are (runs); on a cluster, a folder that all nodes share
  -- FLAGS             handed to every run as they are, as in "-- --device cpu". Flags that change the result, as in
                       "-- --learning-rate 1e-4", need an --exp-name of their own: they do not show in the path.

how to run it
  -j N                 N runs at a time on this machine (as many as it has cores)
  --print              print one command per line and nothing else, for GNU parallel, a queue, a pod per line
  --status             say how many are done, running, failed and to do, and how long the rest takes
  --slurm              submit what is to do as job arrays
  --sbatch "OPTIONS"   handed to sbatch, as in --sbatch "--partition=cpu --time=12:00:00 --mem-per-cpu=2G";
                       with --cpus-per-task=8 a task does its runs 8 at a time
  --runs-per-task K    runs in a task of the array (4; 1 for the ant, whose runs take over an hour)
  --retry-failed       take up failed runs again, from their last checkpoint
  --help

PYTHON names the interpreter (python), as in PYTHON=.venv/bin/python ./run_sweep.sh quick

Stop it whenever you like (Ctrl-C, kill, scancel): the same command goes on where it was. The same command on a second
machine with the same runs folder shares the work. A run's output is in log.txt in its folder. A failed run has its
exit code in the file "failed" there, and is not tried again without --retry-failed.
Exit code: 0 all runs are complete (or submitted), 1 some are not, 2 wrong usage, 130 or 143 stopped.

END
  echo "environments: ${STUDY_ENVS[*]} ${COMPLEX_ENVS[*]} ${OTHER_ENVS[*]}" | fold -sw 120
}

die() { # message, exit code (2: wrong usage)
  echo "run_sweep.sh: $1" >&2
  exit "${2:-2}"
}

quote() { # the words as a shell takes them, each with a space before it
  local word
  for word; do
    [[ $word =~ ^[A-Za-z0-9_./:=,+@%-]+$ ]] || word=${word@Q}
    printf ' %s' "$word"
  done
}

read_list() { # array, pattern: the words of $value, checked and without repetitions, into the array
  local -n list=$1
  local word id
  local -A seen=()
  list=()
  for word in $value; do
    [[ $word =~ ^($2)$ ]] || die "$flag: '$word' is not allowed here (--help)"
    if [[ $1 == betas ]]; then
      printf -v word %g "$word"
      [[ $word != -0 ]] || word=0
    elif [[ $1 == envs ]]; then
      for id in "${STUDY_ENVS[@]}" "${COMPLEX_ENVS[@]}" "${OTHER_ENVS[@]}" ''; do
        [[ $id == "$word" || ${id#dm_control/} == "$word" || ${id#dm_control/} == "$word"-v? ]] && break
      done
      [[ -n $id ]] || die "$flag: unknown environment '$word' (--help lists them; add yours to OTHER_ENVS here)"
      word=$id
    fi
    [[ -n ${seen[$word]-} ]] || list+=("$word")
    seen[$word]=1
  done
  ((${#list[@]})) || die "$flag needs a list in quotes, as in $flag \"A B\""
}

parse_args() {
  local flag value count='[1-9][0-9]{0,8}'
  preset=${1-} mode=local jobs=$(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc)
  runs_dir=runs exp_name=ppo_colored_continuous sbatch_options=() runs_per_task='' retry_failed='' run_flags=()
  envs=("${STUDY_ENVS[@]}") betas=(-1 0 0.2 0.5 0.75 1 1.25 2) n_envs=(4) seeds=({1..20}) n_epochs=(10)
  case $preset in
    quick) envs=(MountainCarContinuous-v0) betas=(0 0.5) seeds=(1 2) ;;
    main) n_envs=(1 2 4 8 16 32 64 128) ;;
    vanilla) n_envs=(1 2 4 8 16 32 64 128) betas=(vanilla) ;;
    n_steps) n_envs=(2 4 8) betas=(0.5) ;;
    n_epochs) n_epochs=(5 10 20) betas=(0.2 0.5 0.75) ;;
    complex) envs=("${COMPLEX_ENVS[@]}") ;;
    -h | --help) usage && exit ;;
    *) die "give a preset: quick, main, vanilla, n_steps, n_epochs or complex, not '$preset' (--help)" ;;
  esac
  shift
  while (($#)); do
    flag=$1 value=${2-}
    shift
    case $flag in
      --print | --status | --slurm)
        [[ $mode == local || --$mode == "$flag" ]] || die "choose one of --print, --status and --slurm"
        mode=${flag#--} && continue
        ;;
      --retry-failed) retry_failed=yes && continue ;;
      -h | --help) usage && exit ;;
      --) run_flags=("$@") && break ;;
      --envs) read_list envs '.*' ;;
      --betas) read_list betas '-?([0-9]+\.?[0-9]*|\.[0-9]+)' ;;
      --n-envs) read_list n_envs "$count" ;;
      --seeds) read_list seeds "0|$count" ;;
      --n-epochs) read_list n_epochs "$count" ;;
      --exp-name) exp_name=$value ;;
      --runs-dir) runs_dir=${value%/} ;;
      --sbatch) read -ra sbatch_options <<<"$value" ;;
      -j) jobs=$value ;;
      --runs-per-task) runs_per_task=$value ;;
      *) die "unknown argument '$flag' (--help lists them; flags for the runs follow --)" ;;
    esac
    (($#)) || die "$flag needs a value (--help)"
    shift
  done
  [[ $preset != vanilla || ${betas[*]} == vanilla ]] || die "--betas: the preset vanilla has no beta"
  [[ $preset == n_epochs || ${n_epochs[*]} == 10 ]] || die "--n-epochs: only the preset n_epochs varies it"
  [[ $exp_name =~ ^[A-Za-z0-9_][A-Za-z0-9._-]*$ ]] || die "--exp-name: '$exp_name' is not a plain folder name"
  [[ -n $runs_dir && $runs_dir != -* ]] || die "--runs-dir: '$runs_dir' is not a folder"
  [[ $jobs =~ ^$count$ ]] || die "-j: '$jobs' is not a positive whole number"
  [[ ${runs_per_task:-1} =~ ^$count$ ]] || die "--runs-per-task: '$runs_per_task' is not a positive whole number"
  for flag in "${run_flags[@]}"; do
    [[ " --env-id --beta --vanilla --n-envs --seed --exp-name --runs-dir --resume --overwrite --${preset/_/-} " != \
      *" ${flag%%=*} "* ]] || die "${flag%%=*} is set by the sweep and cannot follow -- (--help)"
  done
}

# All runs of the sweep: folders[i] and commands[i]. Seeds come outermost, so that a sweep cut short has whole grids
list_runs() {
  local command end seed env n beta epochs name noise flags
  command=$(quote "${PYTHON:-python}" "$script") end=$(quote --runs-dir "$runs_dir" --resume "${run_flags[@]}")
  folders=() commands=()
  for seed in "${seeds[@]}"; do for env in "${envs[@]}"; do for n in "${n_envs[@]}"; do
    for beta in "${betas[@]}"; do for epochs in "${n_epochs[@]}"; do
      name=$exp_name noise=beta_$beta flags="--beta $beta"
      [[ $beta != vanilla ]] || noise=vanilla flags=--vanilla
      if [[ $preset == n_steps ]] && ((n != 4)); then
        ((8192 % n == 0)) || die "--n-envs: $n does not divide the update size 8192"
        flags+=" --n-steps $((8192 / n))" name+=_n_steps_$((8192 / n))
      elif ((epochs != 10)); then
        flags+=" --n-epochs $epochs" name+=_n_epochs_$epochs
      fi
      folders+=("$runs_dir/$name/${env//\//_}/$noise/n_envs_$n/seed_$seed")
      commands+=("${command# } --env-id $env $flags --n-envs $n --seed $seed --exp-name $name$end")
    done; done
  done; done; done
}

is_complete() { [[ -e ${folders[$1]}/summary.json ]]; }
has_failed() { [[ -e ${folders[$1]}/failed ]]; }
is_running() { [[ -e ${folders[$1]}/lock ]] && ! flock -sn "${folders[$1]}/lock" true; }

last_line() { # of what run $1 said since its last start; its error where there is one
  tail -c 4096 "${folders[$1]}/log.txt" 2>/dev/null | tr '\r' '\n' | awk '
    /^== / { error = last = ""; next }
    /^error: / { error = $0 }
    NF { last = $0 }
    END { print error ? error : last ? last : "(it said nothing)" }'
}

# One line for all runs and one per environment. Time left: the runs that are left times the mean time of those done (in
# the same environment where there are any), divided by the number of runs that are running now
status() {
  local i state
  for i in "${!folders[@]}"; do
    if is_complete "$i"; then state="done"; elif is_running "$i"; then state=running; else state=todo; fi
    if [[ $state == todo ]] && has_failed "$i"; then state=failed; fi
    printf '%s\t%s\n' "$state" "${folders[i]}"
  done | awk -F '\t' -v preset="$preset" '
    function number(file, name,    line, found) { # the value of "name" in a JSON file
      while ((getline line < file) > 0)
        if (match(line, "\"" name "\": *[0-9.]+")) { found = substr(line, RSTART, RLENGTH); sub(/.*: */, "", found) }
      close(file)
      return found
    }
    function done_share(folder,    line, total) { # of an unfinished run, by its last evaluation
      while ((getline line < (folder "/evaluations.csv")) > 0);
      close(folder "/evaluations.csv")
      if (line + 0 > 0) total = number(folder "/config.json", "total_timesteps")
      return total > 0 ? line / total : 0
    }
    function duration(h) {
      return h < 1 ? sprintf("%.0f min", 60 * h) : h < 48 ? sprintf("%.1f h", h) : sprintf("%.1f days", h / 24)
    }
    {
      n = split($2, part, "/"); env = part[n - 3]
      if (!(env in left)) { envs[++n_envs] = env; left[env] = 0 }
      count[env, $1]++; count["", $1]++
      if ($1 == "done") { h = number($2 "/summary.json", "wall_seconds") / 3600; hours[env] += h; hours[""] += h }
      if ($1 == "running" || $1 == "todo") left[env] += 1 - done_share($2)
    }
    END {
      finished = count["", "done"]; running = count["", "running"]
      for (i = 1; i <= n_envs; i++) {
        env = count[envs[i], "done"] ? envs[i] : "" # whose mean time is taken
        if (finished) work[i] = left[envs[i]] * hours[env] / count[env, "done"]
        all_work += work[i]
      }
      failed = count["", "failed"]; todo = count["", "todo"]
      printf "%s: %d of %d done, %d running, %d failed, %d to do", preset, finished, NR, running, failed, todo
      if (!running && !todo) print ""
      else if (!finished) print ", time left: known when the first run is done"
      else if (!running) print ", nothing is running, work left: " duration(all_work) " of one core"
      else print ", " duration(all_work / running) " left at the present rate"
      printf "%-40s %6s %8s %7s %7s %10s %10s\n", "environment", "done", "running", "failed", "to do", "per run", "left"
      for (i = 1; i <= n_envs; i++) {
        env = envs[i]; n = count[env, "done"]
        printf "%-40s %6d %8d %7d %7d", env, n, count[env, "running"], count[env, "failed"], count[env, "todo"]
        rest = !left[env] ? "-" : finished && running ? duration(work[i] / running) : "?"
        printf " %10s %10s\n", n ? duration(hours[env] / n) : "?", rest
      }
    }'
}

# Whether the runs folder is there, takes a megabyte and has locks; else `problem` says what is wrong
can_write() {
  local probe=$runs_dir/.probe_${HOSTNAME}_$$
  problem="the folder $runs_dir is gone"
  [[ -d $runs_dir ]] || return 1
  problem=$({ printf '%1048576s' '' >"$probe" && flock -s "$probe" true; } 2>&1)
  rm -f "$probe"
  [[ -z $problem ]] || problem="cannot write or lock files in $runs_dir: ${problem##*: }"
  [[ -z $problem ]]
}

stop() { # exit code. Ends the children with SIGTERM, the second time with SIGKILL; work() waits for them
  local signal=TERM
  [[ -z $stopping ]] || signal=KILL
  stopping=$1
  ((${#running[@]} == 0)) || kill -"$signal" "${!running[@]}" 2>/dev/null
}

start() { # Takes run $1 and starts it, unless somebody else has it
  local folder=${folders[$1]}
  if is_complete "$1" || has_failed "$1"; then return; fi
  can_write || { stop 1 && return; }
  mkdir -p "$folder" || { problem="cannot make $folder" && stop 1 && return; }
  {
    if ! flock -n 9 || is_running "$1"; then
      held+=("$1")
    elif ! is_complete "$1"; then # it may have become so a moment ago
      [[ ! -s $folder/log.txt ]] || echo >&9 # the progress bar of a killed run has no end
      printf '== %(%F %T)T %s: %s\n' -1 "$HOSTNAME" "${commands[$1]}" >&9
      eval "exec ${commands[$1]}" </dev/null >&9 2>&9 9>&- &
      running[$!]=$1
      tries[$1]=$((${tries[$1]-0} + 1))
      [[ -z $stopping ]] || kill "$!" # a signal came before the child was in the list
    fi
  } 9>>"$folder/log.txt"
}

ended() { # Run $1 ended with exit code $2
  local folder=${folders[$1]}
  if is_complete "$1"; then
    echo "complete ($((++n_complete)) of ${#folders[@]}): $folder"
  elif [[ -n $stopping ]]; then
    return
  elif [[ $2 == 130 ]]; then # Ctrl-C; seldom, on a busy machine, it reaches the runs and not the trap below
    stop 130
  elif ! can_write; then
    stop 1
  elif [[ $2 =~ ^12[67]$ || $(last_line "$1") =~ No\ space\ left|[Qq]uota\ exceeded ]]; then # 127: no python here
    problem="$folder: $(last_line "$1")" && stop 1
  elif [[ -d $folder && ! $2 =~ ^(0|3|129|137|143)$ ]]; then
    echo "$2" >"$folder/failed"
    echo "failed: $folder: $(last_line "$1")"
  elif ((tries[$1] < 5)); then # killed, its folder removed, or somebody else was faster: try again at the end
    queue+=("$1")
  else
    echo "given up after 5 tries, left for the next sweep: $folder: $(last_line "$1")"
  fi
}

work() { # Does the runs of `queue`, `jobs` at a time
  local next=0 pid code run waiting=0
  while :; do
    if [[ -z $stopping ]] && ((next < ${#queue[@]} && ${#running[@]} < jobs)); then
      start "${queue[next++]}"
    elif ((${#running[@]})); then
      wait -n 2>/dev/null # bash tells of killed children here
      for pid in "${!running[@]}"; do
        kill -0 "$pid" 2>/dev/null && continue
        wait "$pid" 2>/dev/null
        code=$? run=${running[$pid]}
        unset "running[$pid]"
        ended "$run" "$code"
      done
    elif [[ -z $stopping && $mode == local ]] && ((${#held[@]})); then # whoever has them may die
      ((waiting == ${#held[@]})) || echo "waiting for ${#held[@]} runs that other processes have taken"
      waiting=${#held[@]} queue=("${held[@]}") held=() next=0
      sleep 2 >/dev/null 2>&1 &
      wait "$!"
    else
      return
    fi
  done
}

# Counts, and the failed runs with the last lines of their logs. True where this process has nothing left to do
report() {
  local i failures=() n_complete=0
  for i in "${!folders[@]}"; do
    if is_complete "$i"; then n_complete=$((n_complete + 1)); elif has_failed "$i"; then failures+=("$i"); fi
  done
  for i in "${failures[@]}"; do
    echo "failed with exit code $(<"${folders[i]}/failed"): ${folders[i]}: $(last_line "$i")"
  done
  ((${#failures[@]} == 0)) || echo "the reasons are in log.txt there; --retry-failed takes these runs up again"
  i=$((${#folders[@]} - n_complete - ${#failures[@]}))
  echo "$preset: $n_complete of ${#folders[@]} runs are complete, ${#failures[@]} failed, $i to do"
  [[ -z $stopping || $i == 0 ]] && ((${#failures[@]} == 0 && i <= ${#held[@]}))
}

# Packs the runs of `queue` into tasks, writes these to a file in the runs folder, and submits them as job arrays
submit() {
  local run folder batch job max first last load=0 weight task=-1 capacity=${runs_per_task:-4} arrays=()
  ((${#queue[@]})) || { echo "$preset: nothing to do" && return; }
  max=$(scontrol show config | awk '$1 == "MaxArraySize" { print $3 }')
  [[ $max =~ ^[1-9][0-9]*$ ]] || die "--slurm: scontrol does not tell MaxArraySize: is this a Slurm cluster?" 1
  folder=$runs_dir/slurm/$(date +%Y%m%d_%H%M%S)_${preset}_$$
  mkdir -p "$folder" || die "cannot write in $runs_dir" 1
  for run in "${queue[@]}"; do
    weight=1
    [[ -n $runs_per_task || ${commands[run]} != *" Ant"* ]] || weight=$capacity
    if ((task < 0 || load + weight > capacity)); then task=$((task + 1)) load=0; fi
    load=$((load + weight))
    printf '%s\t%s\t%s\n' "$task" "${folders[run]}" "${commands[run]}"
  done >"$folder/tasks" || die "cannot write in $folder" 1
  batch=$(quote bash "$here/run_sweep.sh" --task "$runs_dir" "$folder/tasks")
  for ((first = 0; first <= task; first += max)); do
    last=$((task - first < max ? task - first : max - 1))
    # USR1 comes two minutes before the time limit: the task stops its runs and puts itself into the queue again
    job=$(printf '#!/bin/bash\nexec%s\n' "$batch \$(($first + SLURM_ARRAY_TASK_ID))" |
      sbatch --parsable --job-name="$preset" --array="0-$last" --requeue --open-mode=append --signal=B:USR1@120 \
        --output="$folder/%A_%a.log" "${sbatch_options[@]}") ||
      die "sbatch refused; submitted so far: ${arrays[*]:-nothing}. The same command later submits what is left" 1
    arrays+=("${job%%;*}")
  done
  echo "submitted ${#queue[@]} runs in $((task + 1)) tasks, as job ${arrays[*]}; their messages are in $folder"
  echo "how far it is: --status. To stop it: scancel ${arrays[*]}. To go on: the same command"
}

main() {
  local i number folder command problem='' stopping='' n_complete=0 queue=() held=() running=() tries=()
  here=$(cd "$(dirname "$0")" && pwd) script=$(dirname "$0")/ppo_colored_continuous.py
  if [[ ${1-} == --task ]]; then # a task of submit(): --task RUNS_DIR FILE NUMBER
    mode=task preset="task $4" runs_dir=$2 jobs=${SLURM_CPUS_PER_TASK:-1} retry_failed='' folders=() commands=()
    while IFS=$'\t' read -r number folder command; do
      if [[ $number == "$4" ]]; then folders+=("$folder") commands+=("$command"); fi
    done <"$3"
  else
    parse_args "$@"
    if [[ $mode == local || $mode == slurm ]]; then
      command -v "${PYTHON:-python}" >/dev/null || die "no ${PYTHON:-python} here: PYTHON=... names the interpreter"
      mkdir -p "$runs_dir" 2>/dev/null || die "cannot make the folder $runs_dir" 1
      [[ $exp_name != ppo_colored_continuous ]] || ((${#run_flags[@]} == 0)) ||
        echo "run_sweep.sh: note: flags that change the result need an --exp-name of their own" >&2
    fi
    [[ $mode != slurm ]] || script=$here/ppo_colored_continuous.py runs_dir=$(cd "$runs_dir" && pwd)
    list_runs
    if [[ $mode == print ]]; then printf '%s\n' "${commands[@]}" && exit; fi
    if [[ $mode == status ]]; then status && exit; fi
  fi
  can_write || die "$problem" 1
  for i in "${!folders[@]}"; do
    if is_complete "$i"; then
      n_complete=$((n_complete + 1))
    elif ! has_failed "$i" || { [[ -n $retry_failed ]] && rm "${folders[i]}/failed"; }; then
      queue+=("$i")
    fi
  done
  if [[ $mode == slurm ]]; then submit && exit; fi

  echo "$preset: ${#folders[@]} runs, $n_complete of them complete, ${#queue[@]} to do, $jobs at a time"
  trap 'stop 130' INT
  trap 'stop 143' TERM HUP
  trap 'stop requeue' USR1
  work
  report && exit
  [[ -z $problem ]] || echo "run_sweep.sh: stopped: $problem" >&2
  if [[ $stopping == requeue ]]; then scontrol requeue "$SLURM_JOB_ID" && exit; fi
  [[ $mode == task ]] || echo "to go on:$(quote "$0" "$@")"
  exit "${stopping:-1}"
}
main "$@"
