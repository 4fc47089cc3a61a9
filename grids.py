"""Runs the paper's grids: each run in a process of its own on one core, resumable, none done twice.

usage: run_sweep.sh PRESET [what to run] [how to run it] [-- FLAGS FOR EVERY RUN]

presets, each the paper's experiment as it was (dm_control without bootstrap at time limits)  runs
  quick     Mountain Car, beta 0 and 0.5, n_envs 4, seeds 1 and 2: minutes                       4
  main      the study: 16 environments x 8 betas x n_envs 1, 2, 4, ..., 128 x 20 seeds       20480
  vanilla   the Vanilla column: white noise from torch's own generator, else as main          2560
  n_steps   n_envs 2, 4, 8 with n_steps 4096, 2048, 1024 (update size 8192), beta 0.5          960
  n_epochs  5, 10 and 20 epochs, beta 0.2, 0.5 and 0.75, n_envs 4                             2880
  complex   PointPush, AntPush, PointPushMaze and AntPushMaze, 8 betas, n_envs 4               640
  transfer  TRPO and A2C (baselines.py), 16 environments, 8 betas, n_envs 4                   5120
  gsde      gSDE (baselines.py) in place of colored noise, 16 environments, n_envs 1 to 128   2560
what to run, quoted lists in place of the preset's
  --envs "A B"        those below (or short: cheetah-run), or any id NAME-v0 or MODULE:NAME
  --betas "0 0.5"     noise colors, or auto, which goes by n_envs
  --n-envs "4 8"      numbers of environments; likewise --seeds; in n_epochs --n-epochs "5 20"
  --exp-name NAME     folder of the experiment (ppo_colored_continuous; trpo, a2c, gsde), to which
                      n_steps and n_epochs add _n_steps_1024 and the like
  --runs-dir FOLDER   where the experiments are (runs); on a cluster, all nodes must share it
  -- FLAGS            for every run, as in "-- --device cpu". Those that change the result need an
                      --exp-name of their own: a run's path does not show them.
how to run it
  -j N                N runs at a time on this machine (as many as it has cores)
  --print             print one command per line and nothing else, for GNU parallel or a queue
  --status            say how many are done, running, failed and to do, and the time left
  --retry-failed      take up failed runs again, from their last checkpoint
  --slurm             submit what is to do as job arrays
  --sbatch "OPTIONS"  for sbatch: "--partition=cpu --time=12:00:00 --mem-per-cpu=2G"; with
                      --cpus-per-task=8 a task does its runs 8 at a time
  --runs-per-task K   runs in a task of the array (4; 1 for the ant, which takes longest)

PYTHON names the interpreter (python), as in PYTHON=.venv/bin/python ./run_sweep.sh quick
Stop it whenever you like (Ctrl-C, kill, scancel): the same command goes on where it was. On a
second machine that sees the runs folder it shares the work. A run's output is in log.txt in its
folder. A failed run has its exit code and error in the file "failed" there; it is not tried again
without --retry-failed.
Exit code: 0 all runs complete (or submitted), 1 some are not, 2 wrong usage, 130 or 143 stopped.
"""

# The text above is the help of run_sweep.sh. What there is to run stands here: the paper's
# experiments as lists of runs, each a folder and a command. How they are carried out stands there:
# run_sweep.sh hands its command line on to this file, and shows its answer to the user (--help,
# --print, --status) or works on the list that it is.

import argparse
import itertools
import os
import re
import shlex
import sys
import textwrap

from environments import COMPLEX, NAMES, ids_named

GRID = {  # a run for each combination, and what its words are where the preset says nothing else
    "seeds": [str(seed) for seed in range(1, 21)],
    "envs": [env_id for env_id in NAMES if env_id not in COMPLEX],
    "n_envs": ["4"],
    "betas": ["-1", "0", "0.2", "0.5", "0.75", "1", "1.25", "2"],
    "n_epochs": ["10"],
    "methods": ["ppo"],
}
ALL_N_ENVS = ["1", "2", "4", "8", "16", "32", "64", "128"]
PRESETS = {
    "quick": {"envs": ["MountainCarContinuous-v0"], "betas": ["0", "0.5"], "seeds": ["1", "2"]},
    "main": {"n_envs": ALL_N_ENVS},
    "vanilla": {"n_envs": ALL_N_ENVS, "betas": ["vanilla"]},
    "n_steps": {"n_envs": ["2", "4", "8"], "betas": ["0.5"]},
    "n_epochs": {"n_epochs": ["5", "10", "20"], "betas": ["0.2", "0.5", "0.75"]},
    "complex": {"envs": COMPLEX},
    "transfer": {"methods": ["trpo", "a2c"]},
    "gsde": {"n_envs": ALL_N_ENVS, "betas": ["gsde"], "methods": ["gsde"]},
}
SET_BY_THE_SWEEP = ["--env-id", "--beta", "--vanilla", "--n-envs", "--seed", "--exp-name"]
SET_BY_THE_SWEEP += ["--runs-dir", "--resume", "--overwrite"]


def matching(pattern):
    """An argparse type: text that is all of this pattern."""

    def parse(text):
        if not re.fullmatch(pattern, text):
            raise argparse.ArgumentTypeError(f"'{text}' is not allowed here")
        return text

    return parse


def words(parse):
    """An argparse type: a list of words, as parse(word) returns each."""
    return lambda text: [parse(word) for word in text.split() or [""]]


def full_id(word):
    """The id behind a short name such as cheetah-run, and any other id as it is."""
    if known := ids_named(word, NAMES):
        return known[0]
    if not re.search(r":|-v[0-9]+$", word):
        raise argparse.ArgumentTypeError(f"'{word}' is no environment")
    return matching("[A-Za-z0-9_./:-]+")(word)


def noise_color(word):
    """A beta as it is written in commands and folders: 0.50 is 0.5, and -0 is 0."""
    matching(r"auto|-?([0-9]+\.?[0-9]*|\.[0-9]+)")(word)
    if word == "auto":
        return word
    beta = f"{float(word) + 0:g}"
    if float(beta) != float(word):
        raise argparse.ArgumentTypeError(
            f"'{word}' has more than six digits, which no folder's name shows"
        )
    return beta


def parse_args(argv):
    """Reads the command line. The axes of the grid become lists of words, given or the preset's."""
    ids = textwrap.fill(f"environments: {' '.join(NAMES)}", 100, break_on_hyphens=False)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.format_help = lambda: f"{__doc__}{ids}\n"
    parser.error = lambda message: parser.exit(2, f"{message} (--help)\n")
    count = matching("[1-9][0-9]{0,8}")
    parser.add_argument("preset", choices=PRESETS, metavar="PRESET")
    parser.add_argument("--envs", type=words(full_id))
    parser.add_argument("--betas", type=words(noise_color))
    parser.add_argument("--n-envs", type=words(count))
    parser.add_argument("--seeds", type=words(matching("0|[1-9][0-9]{0,8}")))
    parser.add_argument("--n-epochs", type=words(count))
    parser.add_argument("--exp-name", type=matching("[A-Za-z0-9_][A-Za-z0-9._-]*"))
    parser.add_argument("--runs-dir", type=matching("(?!-)[^\x00-\x1f\x7f]+"), default="runs")
    parser.add_argument("-j", type=count, dest="jobs")
    mode = parser.add_mutually_exclusive_group()
    for name in ("print", "status", "slurm"):
        mode.add_argument(f"--{name}", dest="mode", action="store_const", const=name)
    parser.add_argument("--retry-failed", action="store_const", const="yes")
    parser.add_argument("--sbatch", type=matching(".+"))
    parser.add_argument("--runs-per-task", type=count)
    parser.add_argument("--task", type=matching("[0-9]+:[0-9]+"))  # of Slurm: a part of the list
    parser.set_defaults(mode="local")

    end = argv.index("--") if "--" in argv else len(argv)
    own, flags = argv[:end], argv[end + 1 :]
    # argparse would take the -1. of --betas -1. for a flag, and what stands behind --sbatch too
    own = re.sub("\0(--betas|--sbatch)\0", "\0\\1=", "\0".join(["", *own])).split("\0")[1:]
    args = parser.parse_args(own)
    grid = GRID | PRESETS[args.preset]
    if args.betas and grid["betas"] == [args.preset]:
        parser.error(f"{args.preset} has no --betas")
    if args.preset != "n_epochs" and args.n_epochs not in (None, ["10"]):
        parser.error("--n-epochs is for the preset n_epochs")
    if args.preset == "n_steps" and not set(args.n_envs or []) <= set(ALL_N_ENVS):
        parser.error(f"in n_steps --n-envs is one of {' '.join(ALL_N_ENVS)}")
    ours = {*SET_BY_THE_SWEEP, "--" + args.preset.replace("_", "-")}  # such as --n-steps
    for flag in ours & {word.split("=")[0] for word in flags}:
        parser.error(f"{flag} is set by the sweep and cannot follow --")
    for axis, values in grid.items():
        setattr(args, axis, getattr(args, axis, None) or values)
    args.flags, args.runs_dir = flags, args.runs_dir.removesuffix("/")
    args.mode = "task" if args.task else args.mode
    return args


def quoted(*arguments):
    """Arguments as bash reads them, on one line."""
    return shlex.join(arguments).replace("\n", "'$'\\n''")


def run(args, seed, env_id, n_envs, beta, n_epochs, method):
    """The folder and the command of a run. The folder is as run_files.run_path has it."""
    script, name = ["ppo_colored_continuous.py"], args.exp_name or "ppo_colored_continuous"
    if method != "ppo":
        script = ["baselines.py", method]
        name = f"{args.exp_name}_{method}" if args.exp_name else method
    noise, flags = f"beta_{beta}", ["--beta", beta]
    if beta in ("vanilla", "gsde"):
        noise, flags = beta, ["--vanilla"] if beta == "vanilla" else []
    n_steps = 8192 // int(n_envs)  # the update keeps its size
    if args.preset == "n_steps" and n_steps != 2048:
        flags += ["--n-steps", str(n_steps)]
        name += f"_n_steps_{n_steps}"
    if n_epochs != "10":
        flags += ["--n-epochs", n_epochs]
        name += f"_n_epochs_{n_epochs}"
    flags += ["--n-envs", n_envs, "--seed", seed, "--exp-name", name]
    if env_id.startswith("dm_control/"):
        flags += ["--no-bootstrap-timeouts"]
    flags += ["--runs-dir", args.runs_dir, "--threads", "1", "--resume", *args.flags]
    python = os.environ.get("PYTHON") or "python"
    script[0] = os.path.join(os.path.dirname(sys.argv[0]), script[0])
    environment = re.sub(r"[/:\\]", "_", env_id)
    folder = f"{args.runs_dir}/{name}/{environment}/{noise}/n_envs_{n_envs}/seed_{seed}"
    return folder, quoted(python, *script, "--env-id", env_id, *flags)


def list_runs(args):
    """The runs of a sweep, none of them twice: a list of (folder, command).

    Seeds come outermost, so that a sweep cut short has whole grids.
    """
    combinations = itertools.product(*(getattr(args, axis) for axis in GRID))
    runs = list(dict.fromkeys(run(args, *values) for values in combinations))
    first, last = map(int, args.task.split(":")) if args.task else (0, len(runs))
    return runs[first:last]


def for_bash(args, runs):
    """Lines of assignments: the sweep, for run_sweep.sh to evaluate."""
    names = ["mode", "preset", "runs_dir", "jobs", "retry_failed", "sbatch", "runs_per_task"]
    lines = [f"{name}={quoted(getattr(args, name) or '')}" for name in names]
    lines += ["folders=(", *(quoted(folder) for folder, _ in runs), ")"]
    return lines + ["commands=(", *(quoted(command) for _, command in runs), ")"]


def main():
    args = parse_args(sys.argv[1:])
    runs = list_runs(args)
    if args.mode == "print":
        lines = [command for _, command in runs]
    elif args.mode == "status":
        import analysis  # a second, which the others need not wait

        lines = analysis.status([folder for folder, _ in runs], args.preset)
    else:
        lines = for_bash(args, runs)
        if args.flags and not args.exp_name:
            note = "flags that change the result need an --exp-name of their own"
            print(f"run_sweep.sh: note: {note}", file=sys.stderr)
    sys.stdout.reconfigure(errors="surrogateescape")  # names of files may be any bytes
    print("\n".join(lines))


if __name__ == "__main__":
    main()
