"""Runs the paper's grids: each run in a process of its own on one core, resumable, none repeated.

usage: run_sweep.sh PRESET [what to run] [how to run it] [-- FLAGS FOR EVERY RUN]

presets: the paper's experiments (its dm_control runs had no bootstrap at time limits)        runs
  quick     Mountain Car, beta 0 and 0.5, n_envs 4, seeds 1 and 2: minutes                       4
  main      the study: 16 environments x 8 betas x n_envs 1, 2, 4, ..., 128 x 20 seeds       20480
  vanilla   the Vanilla column: white noise from torch's own generator, else as main          2560
  n_steps   n_envs 2, 4, 8 with n_steps 4096, 2048, 1024 (update size 8192), beta 0.5          960
  n_epochs  5, 10 and 20 epochs, beta 0.2, 0.5 and 0.75, n_envs 4                             2880
  complex   PointPush, AntPush, PointPushMaze and AntPushMaze, 8 betas, n_envs 4               640
  transfer  TRPO and A2C, 16 environments, 8 betas, n_envs 4                                  5120
  gsde      gSDE in place of colored noise, 16 environments, n_envs 1 to 128                  2560
and one that is not the paper's
  gymnasium six MuJoCo tasks, betas 0, 0.5, 1, n_envs 1 and 32, usual settings, 8 seeds        288
what to run, lists in quotes in place of the preset's
  --envs "A B"        those below (or short: cheetah-run), or any id NAME-v0 or MODULE:NAME
  --betas "0 0.5"     noise colors, or auto: chosen by n_envs * n_steps
  --n-envs "4 8"      numbers of environments; likewise --seeds and --n-epochs
  --exp-name NAME     folder of the experiment (ppo_colored_continuous; trpo, a2c, gsde), to which
                      n_steps and n_epochs add _n_steps_1024 and the like
  --runs-dir FOLDER   where the experiments are (runs); on a cluster, all nodes must share it
  -- FLAGS            for every run, as in "-- --device cpu". Those that change the result need an
                      --exp-name of their own: a run's path does not show them.
how to run it
  -j N                N runs at a time on this machine (as many as it has cores)
  --print             print one command per line and nothing else, for GNU parallel or a queue
  --status            say how many are done, running, failed and to do, and the time left
  --retry-failed      continue failed runs from their last checkpoint
  --slurm N           submit a job array of N tasks, which share the runs
  --sbatch="OPTIONS"  for sbatch: "--partition=cpu --time=12:00:00 --mem-per-cpu=2G"; with
                      --cpus-per-task=8 a task does 8 runs at a time

PYTHON names the interpreter (python), as in PYTHON=.venv/bin/python ./run_sweep.sh quick
You can stop it at any time (Ctrl-C, kill, scancel): the same command continues. On a second
machine that sees the runs folder it shares the work. A run's output is in log.txt in its
folder. A failed run has its exit code and error in the file "failed" there.
Exit code: 0 all runs complete (or submitted), 1 some are not, 2 wrong usage, 130 or 143 stopped.
"""

# The text above is the help of run_sweep.sh, which passes its command line on to this file. The
# answer is a text for the user (--help, --print, --status), or else the list of runs, each a folder
# and a command, as assignments that bash evaluates.

import argparse
import itertools
import os
import re
import shlex
import sys
import textwrap
from pathlib import Path

from study.protocol import GRID, GYMNASIUM_FLAGS, NAMES, PRESETS, SETTINGS, bootstraps, ids_named
from study.status import status

ROOT = str(Path(__file__).resolve().parent.parent)
UPDATE_SIZE = 8192  # n_envs * n_steps, in the preset n_steps
SET_BY_THE_SWEEP = {"--env-id", "--beta", "--vanilla", "--n-envs", "--seed", "--exp-name"}
SET_BY_THE_SWEEP |= {"--runs-dir", "--resume", "--overwrite"}


def positive(text):  # argparse's messages show the names of its types
    if int(text) < 1:
        raise ValueError
    return int(text)


def words(text):
    if not text.split():
        raise argparse.ArgumentTypeError("the list is empty")
    return text.split()


def numbers(text):
    return [int(word) for word in words(text)]


def betas(text):
    """Noise colors: numbers, or auto. -0 is 0, which is not a second run."""
    return [word if word == "auto" else f"{float(word) + 0:g}" for word in words(text)]


def environments(text):
    """Ids: those behind short names such as cheetah-run, and any other id as it is."""
    found = [(ids_named(word) or [word])[0] for word in words(text)]
    for env_id in found:
        if not re.search(r":|-v[0-9]+$", env_id):
            raise argparse.ArgumentTypeError(f"'{env_id}' is not the id of an environment")
    return found


def parse_args(argv):
    """Reads the command line. The axes of the grid become lists, as given or the preset's."""
    ids = textwrap.fill(f"environments: {' '.join(NAMES)}", 100, break_on_hyphens=False)
    usage = "run_sweep.sh PRESET [options] [-- FLAGS FOR EVERY RUN] (--help tells all)"
    parser = argparse.ArgumentParser("run_sweep.sh", usage, allow_abbrev=False)
    parser.format_help = lambda: f"{__doc__}{ids}\n"
    add = parser.add_argument
    add("preset", choices=PRESETS)
    add("--envs", type=environments)
    add("--betas", type=betas)
    add("--n-envs", type=numbers)
    add("--seeds", type=numbers)
    add("--n-epochs", type=numbers)
    add("--exp-name")
    add("--runs-dir", default="runs")
    add("-j", type=positive, dest="jobs")
    add("--retry-failed", action="store_true")
    add("--sbatch")
    add = parser.add_mutually_exclusive_group().add_argument
    add("--print", action="store_true")
    add("--status", action="store_true")
    add("--slurm", type=positive)

    end = argv.index("--") if "--" in argv else len(argv)
    args = parser.parse_args(argv[:end])
    args.flags = argv[end + 1 :]
    if args.betas and args.preset in ("vanilla", "gsde"):
        parser.error(f"{args.preset} has no --betas")
    ours = SET_BY_THE_SWEEP | {"--" + args.preset.replace("_", "-")}  # such as --n-steps
    for flag in ours & {word.split("=")[0] for word in args.flags}:
        parser.error(f"{flag} is set by the sweep and cannot follow --")
    for axis, values in (GRID | PRESETS[args.preset]).items():
        setattr(args, axis, getattr(args, axis, None) or values)
    if args.preset == "gymnasium" and set(args.n_envs) - {*GYMNASIUM_FLAGS}:
        parser.error("gymnasium has --n-envs 1 and 32")
    return args


def run_folder(runs_dir, exp_name, env_id, beta, n_envs, seed):
    """Path of a run's folder, which is what the script's run_path makes of the run's arguments.

    beta: a number or "auto", or what is in place of colored noise: "vanilla" or "gsde".
    """
    env = re.sub(r"[/:\\]", "_", env_id)
    noise = beta if beta in ("vanilla", "gsde") else f"beta_{beta}"
    return Path(runs_dir, exp_name, env, noise, f"n_envs_{n_envs}", f"seed_{seed}")


def run(args, seed, env_id, n_envs, beta, n_epochs, method):
    """The folder and the command of a run: flags where it is not by the script's defaults."""
    python = os.environ.get("PYTHON") or "python"
    if method == "ppo":
        program = [python, f"{ROOT}/ppo_colored_continuous.py"]
        name = args.exp_name or "ppo_colored_continuous"
    else:
        path = f"PYTHONPATH={os.environ.get('PYTHONPATH', ROOT)}"  # and not the current folder:
        program = ["env", path, "PYTHONSAFEPATH=1", python, "-m", "study.methods", method]
        name = f"{args.exp_name}_{method}" if args.exp_name else method
    flags = {"vanilla": ["--vanilla"], "gsde": []}.get(beta, ["--beta", f"{beta}"])
    n_steps = UPDATE_SIZE // n_envs
    if args.preset == "n_steps" and n_steps != SETTINGS["n_steps"]:
        flags += ["--n-steps", str(n_steps)]
        name += f"_n_steps_{n_steps}"
    if n_epochs != SETTINGS["n_epochs"]:
        flags += ["--n-epochs", str(n_epochs)]
        name += f"_n_epochs_{n_epochs}"
    if args.preset == "gymnasium":
        flags += GYMNASIUM_FLAGS[n_envs]
        name = args.exp_name or "gymnasium"
    flags += ["--n-envs", str(n_envs), "--seed", str(seed), "--exp-name", name]
    if not bootstraps(env_id):
        flags += ["--no-bootstrap-timeouts"]
    flags += ["--runs-dir", args.runs_dir, "--threads", "1", "--resume", *args.flags]
    folder = run_folder(args.runs_dir, name, env_id, beta, n_envs, seed)
    return str(folder), shlex.join([*program, "--env-id", env_id, *flags])


def list_runs(args):
    """The runs of a sweep, none of them twice: a list of (folder, command).

    Seeds come outermost, so that a sweep cut short has whole grids.
    """
    combinations = itertools.product(*(getattr(args, axis) for axis in GRID))
    return list(dict.fromkeys(run(args, *values) for values in combinations))


def for_bash(args, runs):
    """Assignments: the sweep, for run_sweep.sh to evaluate."""
    on_linux = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if on_linux else os.cpu_count()
    args.jobs = args.jobs or (os.environ.get("SLURM_CPUS_PER_TASK", 1) if args.slurm else cores)
    names = ["preset", "runs_dir", "jobs", "retry_failed", "slurm", "sbatch"]
    lines = [f"{name}={shlex.quote(str(getattr(args, name) or ''))}" for name in names]
    lines += ["folders=(", *(shlex.quote(folder) for folder, _ in runs), ")"]
    return lines + ["commands=(", *(shlex.quote(command) for _, command in runs), ")"]


def main():
    args = parse_args(sys.argv[1:])
    runs = list_runs(args)
    if args.print:
        lines = [command for _, command in runs]
    elif args.status:
        lines = [status([folder for folder, _ in runs], args.preset)]
    else:
        lines = for_bash(args, runs)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
