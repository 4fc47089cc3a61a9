"""How long a training step takes: the script beside the paper's own stack.

    pip install -r requirements.txt -r tests/requirements.txt && python -m study.benchmark

Contenders are commands that train and evaluate by the paper's protocol: 4 environments, 50 episodes
every 10,240 steps. Only an update is larger, 10,240 steps in place of 8,192, so that an evaluation
follows each. All are held on one core, since that is what a run has in a sweep that keeps every
core busy, and they take turns. The table has microseconds per training step, from one evaluation to
the next by the clock in TensorBoard's files: median, smallest and largest. What comes before a
run's first evaluation is not counted: imports, making environments, compiling.

More tables: a run by number of threads, no longer held on one core; and the seconds that one waits
before the first training step.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

EVAL_FREQ, TOTAL_STEPS = 10_240, 2_048_000  # of the protocol
RUN = f"--n-envs 4 --n-steps 2560 --total-timesteps {3 * EVAL_FREQ}"
SCRIPT = "ppo_colored_continuous.py --compile"
CONTENDERS = {
    "this script": f"{SCRIPT} --threads 1",
    "this script, --no-envpool": f"{SCRIPT} --threads 1 --no-envpool",
    "the paper's stack": "-m study.sb3",
}
DM_CONTROL = [f"dm_control/{t}-v0" for t in ("pendulum-swingup", "cheetah-run", "walker-run")]
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
ROOT = Path(__file__).parent.parent


def hold_on_cores(n):
    """Holds this process, and those it starts from now on, on the last n of its cores."""
    if hasattr(os, "sched_setaffinity"):  # Linux
        os.sched_setaffinity(0, CORES[-n:])


def seconds(command, **variables):
    """Time that a command takes in the project's folder; raises CalledProcessError if it fails."""
    start, quiet = time.perf_counter(), {"TQDM_DISABLE": "1", "OMP_NUM_THREADS": "1"}
    how = {"cwd": ROOT, "env": os.environ | quiet | variables, "stdout": subprocess.DEVNULL}
    subprocess.run(command, check=True, **how)
    return time.perf_counter() - start


def step_times(contender, env_id):
    """Microseconds per training step of a new run, in each update but the first."""
    with tempfile.TemporaryDirectory() as folder:
        flags = f"{RUN} --env-id {env_id} --eval-freq {EVAL_FREQ} --runs-dir {folder}"
        seconds([sys.executable, *f"{contender} {flags}".split()])
        (file,) = Path(folder).rglob("events.out.*")
        events = EventAccumulator(str(file)).Reload().Scalars("evaluation/return_mean")
    return 1e6 * np.diff([event.wall_time for event in events]) / EVAL_FREQ


def measure(env_id, n_rounds, contenders):
    """Runs the contenders, {name: command}, n_rounds times in turns. Returns a row for each."""
    times = {name: [] for name in contenders}
    for _ in range(n_rounds):
        for name, contender in contenders.items():
            times[name] += [*step_times(contender, env_id)]
    return [
        {"env_id": env_id, "contender": name, "us": np.median(x), "from": min(x), "to": max(x)}
        for name, x in times.items()
    ]


# --- The tables: generators of lists of rows


def steps(args):
    """The script and the paper's stack on each environment, with ratios."""
    for env_id in args.env_ids or DM_CONTROL:
        rows = measure(env_id, args.rounds, CONTENDERS)
        yield [row | {"x faster": rows[-1]["us"] / row["us"]} for row in rows]


def threads(args):
    """One run on one core and on all, and the minutes of a whole run."""
    for env_id in args.env_ids or [DM_CONTROL[-1], "AntUMaze-v1", "door-v0"]:
        rows = []
        for n in sorted({1, len(CORES)}):
            hold_on_cores(n)
            contender = {f"one run, --threads {n}": f"{SCRIPT} --threads {n}"}
            rows += measure(env_id, args.rounds, contender)
        yield [row | {"minutes": row["us"] * TOTAL_STEPS / 60e6} for row in rows]


# A run that ends with its first minibatch, and the same with an edited loss
FIRST_STEP = f"{SCRIPT} --n-envs 4 --n-steps 32 --n-epochs 1 --total-timesteps 128 "
FIRST_STEP += "--eval-freq 128 --eval-episodes 1 --overwrite"
EDITED = """import sys, ppo_colored_continuous as ppo
def edited_loss(*args):
    loss, metrics = ppo.ppo_loss(*args)
    return 0.9 * loss, metrics
ppo.main(ppo.parse_args(sys.argv[2:]), loss=edited_loss)"""


def waiting(args):
    """Seconds until the first training step is done, and of what comes before it, on all cores."""
    hold_on_cores(len(CORES))
    python, rounds = sys.executable, []
    for _ in range(args.rounds):
        with tempfile.TemporaryDirectory() as folder:
            step = f"{FIRST_STEP} --runs-dir {folder}/runs".split()
            commands = {  # in this order: the first fills the cache of compiled code
                "first step, new machine": [python, *step],
                "first step, compiled before": [python, *step],
                "first step, loss edited": [python, "-c", EDITED, *step],
                "first step, --no-compile": [python, *step, "--no-compile"],
                "import of the script": [python, "-c", "import ppo_colored_continuous"],
                "import of torch alone": [python, "-c", "import torch"],
                "run_sweep.sh quick --status": ["./run_sweep.sh", "quick", "--status"],
            }
            variables = {"TORCHINDUCTOR_CACHE_DIR": f"{folder}/cache", "PYTHON": python}
            rounds.append({name: seconds(c, **variables) for name, c in commands.items()})
    medians = pd.DataFrame(rounds).median()
    yield [{"contender": name, "seconds": value} for name, value in medians.items()]


TABLES = {table.__name__: table for table in (steps, threads, waiting)}


def parse_args(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("--tables", nargs="+", choices=TABLES, default=TABLES, help="tables to make")
    add("--env-ids", nargs="+", help="environments, in place of those of each table")
    add("--rounds", type=int, default=3, help="runs of each contender")
    add("--csv", default="benchmark.csv", help="file for the rows of all tables")
    return parser.parse_args(argv)


def main(args):
    rows = []
    for name in args.tables:
        hold_on_cores(1)
        for table in TABLES[name](args):
            rows += table
            pd.DataFrame(rows).round(3).to_csv(args.csv, index=False)
            shown = pd.DataFrame(table).to_string(index=False, float_format="{:.2f}".format)
            print(shown, end="\n\n", flush=True)


if __name__ == "__main__":
    main(parse_args())
