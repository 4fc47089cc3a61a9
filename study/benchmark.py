"""How long a training step takes, and what it is made of: the script beside the paper's own stack.

    pip install -r requirements.txt -r tests/requirements.txt && python -m study.benchmark

Every contender trains with the paper's settings (4 environments, 8,192 steps per update) and
evaluates 50 episodes, in a process of its own. All are held on one core, since that is what a run
has in a sweep that keeps every core busy. They take turns: a round is one update and one evaluation
of each. The table has medians over rounds in microseconds per training step, evaluations weighted
as in the protocol (one per 10,240 steps). The first round is not counted: torch.compile is in it.
Policies are as they are after a few updates. "files" is logging, evaluations.csv and a checkpoint
(here in each round, in a run every 5 seconds).

More tables: a run by number of threads, no longer held on one core; and the seconds that one waits
before the first training step.
"""

import argparse
import collections
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["TQDM_DISABLE"] = "1"

import pandas as pd

EVAL_FREQ, TOTAL_STEPS = 10_240, 2_048_000  # of the protocol
EACH_ROUND = "--eval-freq 8192"  # an evaluation after each update
PHASES = ["rollout", "noise", "update", "files", "evaluation"]
DM_CONTROL = [f"dm_control/{t}-v0" for t in ("pendulum-swingup", "cheetah-run", "walker-run")]
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
ROOT = Path(__file__).parent.parent


class Clock:
    """Measures how long a contender is in each phase, and keeps it waiting between rounds."""

    def __init__(self, pipe):
        self.pipe, self.seconds = pipe, collections.Counter()
        self.phase, self.since = None, time.perf_counter()

    def switch(self, phase):
        """The time from here on belongs to this phase; returns the one before."""
        now = time.perf_counter()
        self.seconds[self.phase] += now - self.since
        previous, self.phase, self.since = self.phase, phase, now
        return previous

    def timed(self, phase, function):
        """The same function; its time is this phase's, not that of the phase it is called in."""

        def timed_function(*args, **kwargs):
            previous = self.switch(phase)
            result = function(*args, **kwargs)
            self.switch(previous)
            return result

        return timed_function

    def next_round(self, args):
        """Reports microseconds per training step and peak memory, waits, and begins a rollout."""
        self.switch(None)
        row = {phase: 1e6 * self.seconds[phase] / (args.n_envs * args.n_steps) for phase in PHASES}
        row["evaluation"] = 1e6 * self.seconds["evaluation"] / EVAL_FREQ  # one in each round
        unit = 2**20 if sys.platform == "darwin" else 2**10
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        self.pipe.send(row | {"total us": sum(row.values()), "peak MB": peak})
        if not self.pipe.recv():
            sys.exit()
        self.seconds.clear()
        self.phase, self.since = "rollout", time.perf_counter()


# --- The contenders: functions of a clock and the script's flags


def run_script(clock, flags):
    """The script itself, with timers around the functions that its loop calls."""
    import ppo_colored_continuous as ppo

    args = ppo.parse_args(flags.split())

    def exploration(*arguments):  # called first in each round
        clock.next_round(args)
        return ppo.exploration(*arguments)

    ppo.evaluate = clock.timed("evaluation", ppo.evaluate)
    ppo.ColoredNoiseProcess.sample = clock.timed("noise", ppo.ColoredNoiseProcess.sample)
    for name in ("add_evaluation", "add_update", "save_checkpoint"):
        setattr(ppo.Run, name, clock.timed("files", getattr(ppo.Run, name)))
    with tempfile.TemporaryDirectory() as args.runs_dir:
        ppo.main(args, exploration=exploration, learn=clock.timed("update", ppo.learn))


def run_sb3(clock, flags):
    """The paper's stack: Stable-Baselines3 with pink-noise-rl, evaluated in 10 environments."""
    import torch

    from study import sb3

    torch.set_num_threads(1)
    args = sb3.parse_args(flags.split())
    model, eval_envs = sb3.make_model(args), sb3.make_envs(args, 10, seed=1)
    model.train = clock.timed("update", model.train)
    evaluate = clock.timed("evaluation", sb3.evaluate_policy)
    while True:
        clock.next_round(args)
        model.learn(args.n_envs * args.n_steps, reset_num_timesteps=False)
        evaluate(model, eval_envs, args.eval_episodes)


# --- Measuring


def contend(run, pipe, flags):
    """What a contender's process does."""
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    run(Clock(pipe), flags)


def measure(env_id, n_rounds, contenders):
    """Lets contenders, {name: (run, flags)}, play rounds in turns: one, then n_rounds that count.

    Returns a row for each: medians over rounds, and the smallest and largest total.
    """
    context, rounds = multiprocessing.get_context("spawn"), collections.defaultdict(list)
    pipes, processes = {}, []
    for name, (run, flags) in contenders.items():
        pipes[name], pipe = context.Pipe()
        arguments = run, pipe, f"--env-id {env_id} --n-envs 4 {flags}"
        processes.append(context.Process(target=contend, args=arguments, daemon=True))
        processes[-1].start()
        pipe.close()  # so that recv raises EOFError where the process has died
        pipes[name].recv()  # it has started
    for _ in range(1 + n_rounds):
        for name, pipe in pipes.items():
            pipe.send(True)
            rounds[name].append(pipe.recv())
    for pipe, process in zip(pipes.values(), processes, strict=True):
        pipe.send(False)
        process.join()
    rows = []
    for name, reports in rounds.items():
        table = pd.DataFrame(reports[1:])
        row = {"env_id": env_id, "contender": name, **table.median()}
        rows.append(row | {"from": table["total us"].min(), "to": table["total us"].max()})
    return rows


# --- The tables: generators of lists of rows


def phases(args):
    """The script and the paper's stack on each environment, with ratios of the totals."""
    contenders = {
        "this script": (run_script, f"{EACH_ROUND} --threads 1"),
        "this script, --no-envpool": (run_script, f"{EACH_ROUND} --threads 1 --no-envpool"),
        "the paper's stack": (run_sb3, EACH_ROUND),
    }
    for env_id in args.env_ids or DM_CONTROL:
        rows = measure(env_id, args.rounds, contenders)
        yield [row | {"x faster": rows[-1]["total us"] / row["total us"]} for row in rows]


def threads(args):
    """One run on one core and on all: the whole protocol's minutes, by its rounds."""
    for env_id in args.env_ids or [DM_CONTROL[-1], "AntUMaze-v1", "door-v0"]:
        rows = []
        for n in sorted({1, len(CORES)}):
            hold_on_cores(n)
            contender = {f"one run, --threads {n}": (run_script, f"{EACH_ROUND} --threads {n}")}
            rows += measure(env_id, args.rounds, contender)
        yield [row | {"minutes": row["total us"] * TOTAL_STEPS / 60e6} for row in rows]


# A run that ends with its first minibatch, and the same with an edited loss
SCRIPT = "ppo_colored_continuous"
FIRST_STEP = f"{SCRIPT}.py --n-envs 4 --n-steps 32 --n-epochs 1 --total-timesteps 128 "
FIRST_STEP += "--eval-freq 128 --eval-episodes 1 --overwrite --compile"
EDITED = f"""import sys, {SCRIPT} as ppo
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
            step = [*FIRST_STEP.split(), "--runs-dir", f"{folder}/runs"]
            commands = {  # in this order: the first fills the cache of compiled code
                "first step, new machine": [python, *step],
                "first step, compiled before": [python, *step],
                "first step, loss edited": [python, "-c", EDITED, *step],
                "first step, --no-compile": [python, *step, "--no-compile"],
                "import of the script": [python, "-c", f"import {SCRIPT}"],
                "import of torch alone": [python, "-c", "import torch"],
                "run_sweep.sh quick --status": ["./run_sweep.sh", "quick", "--status"],
            }
            variables = {"TORCHINDUCTOR_CACHE_DIR": f"{folder}/cache", "PYTHON": python}
            rounds.append({name: seconds(words, variables) for name, words in commands.items()})
    medians = pd.DataFrame(rounds).median()
    yield [{"contender": name, "seconds": value} for name, value in medians.items()]


def seconds(command, variables):
    """Time that a command takes in the project's folder; raises CalledProcessError if it fails."""
    start, environment = time.perf_counter(), os.environ | variables
    subprocess.run(command, check=True, cwd=ROOT, env=environment, capture_output=True)
    return time.perf_counter() - start


def hold_on_cores(n):
    """Holds this process, and those it starts from now on, on the last n of its cores."""
    if hasattr(os, "sched_setaffinity"):  # Linux
        os.sched_setaffinity(0, CORES[-n:])


TABLES = {table.__name__: table for table in (phases, threads, waiting)}


def parse_args(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("--tables", nargs="+", choices=TABLES, default=TABLES, help="tables to make")
    add("--env-ids", nargs="+", help="environments, in place of those of each table")
    add("--rounds", type=int, default=3, help="rounds that are counted")
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
