"""How long a training step takes, and what it is made of: the script beside its peers.

    pip install -r requirements.txt -r tests/requirements.txt && python -m study.benchmark

Every contender trains with the paper's settings (4 environments, 8,192 steps per update) and
evaluates 50 episodes, in a process of its own. All are held on one core, since that is what a run
has in a sweep that keeps every core busy. They take turns: a round is one update and one evaluation
of each. The table has medians over rounds in microseconds per training step, evaluations weighted
as in the protocol (one per 10,240 steps). The first round is not counted: torch.compile is in it.
Start-up is the time until it begins. Policies are as they are after a few updates. "files" is
logging, evaluations.csv and a checkpoint (here in each round, in a run after 5 seconds). Bare
physics is the simulator alone, called from Python: as many control steps as the protocol has, with
random actions in training, none in evaluation.

More tables: the training alone by number of environments; a run by number of threads, no longer
held on one core; and the seconds that one waits before the first training step.
"""

import argparse
import collections
import functools
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

# A round of a contender: one update of n_envs * n_steps steps, and one evaluation
Size = collections.namedtuple("Size", "n_envs n_steps eval_episodes", defaults=(4, 2048, 50))
EVAL_FREQ, TOTAL_STEPS = 10_240, 2_048_000  # of the protocol
PHASES = ["rollout", "noise", "update", "files", "evaluation"]
DM_CONTROL = [f"dm_control/{t}-v0" for t in ("pendulum-swingup", "cheetah-run", "walker-run")]
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
PAPER, PHYSICS = "the paper's stack", "bare physics"
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

    def next_round(self):
        """Reports seconds and peak memory since the last call, waits, and begins a rollout."""
        self.switch(None)
        unit = 2**20 if sys.platform == "darwin" else 2**10
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        self.pipe.send({**{phase: self.seconds[phase] for phase in PHASES}, "peak MB": peak})
        if not self.pipe.recv():
            sys.exit()
        self.seconds.clear()
        self.phase, self.since = "rollout", time.perf_counter()


# --- The contenders: functions of a clock, an environment's id and a Size


def run_script(clock, env_id, size, flags="", evaluations=True):
    """The script itself, with timers around the functions that its loop calls."""
    import ppo_colored_continuous as ppo

    def exploration(*args):  # the first thing of a round
        clock.next_round()
        return ppo.exploration(*args)

    ppo.evaluate = clock.timed("evaluation", ppo.evaluate)
    ppo.ColoredNoiseProcess.sample = clock.timed("noise", ppo.ColoredNoiseProcess.sample)
    for name in ("add_evaluation", "add_update", "save_checkpoint"):
        setattr(ppo.Run, name, clock.timed("files", getattr(ppo.Run, name)))
    eval_freq = size.n_envs * size.n_steps if evaluations else TOTAL_STEPS
    episodes = size.eval_episodes if evaluations else 1
    with tempfile.TemporaryDirectory() as folder:
        settings = f"--env-id {env_id} --n-envs {size.n_envs} --n-steps {size.n_steps} {flags} "
        settings += f"--eval-freq {eval_freq} --eval-episodes {episodes} --runs-dir {folder}"
        args = ppo.parse_args(settings.split(), total_timesteps=TOTAL_STEPS)
        ppo.main(args, exploration=exploration, learn=clock.timed("update", ppo.learn))


def run_peer(clock, env_id, size, jax=False):
    """PPO of Stable-Baselines3 or SBX, noise of pink-noise-rl, evaluated in 10 environments."""
    import gymnasium as gym
    import numpy as np
    import shimmy  # noqa: F401  registers the dm_control ids
    import torch
    from pink import ColoredNoiseProcess
    from stable_baselines3.common import callbacks
    from stable_baselines3.common.env_util import make_vec_env

    if jax:
        from sbx import PPO  # pip install sbx-rl
    else:
        from stable_baselines3 import PPO

    torch.set_num_threads(1)
    flatten = gym.wrappers.FlattenObservation
    make = functools.partial(make_vec_env, env_id, seed=1, wrapper_class=flatten)
    settings = dict(n_steps=size.n_steps, batch_size=128, n_epochs=10, learning_rate=2.5e-4)
    model = PPO("MlpPolicy", make(n_envs=size.n_envs), seed=1, **settings)
    shape = (size.n_envs, model.action_space.shape[0], 1000)
    noise = ColoredNoiseProcess(0.5, shape, rng=np.random.default_rng(1))
    (color_jax if jax else color_torch)(model.policy, noise)
    model.train = clock.timed("update", model.train)
    callbacks.evaluate_policy = clock.timed("evaluation", callbacks.evaluate_policy)
    how = dict(n_eval_episodes=size.eval_episodes, eval_freq=size.n_steps, verbose=0)
    evaluation = callbacks.EvalCallback(make(n_envs=10), **how)
    while True:
        clock.next_round()
        model.learn(size.n_envs * size.n_steps, evaluation, reset_num_timesteps=False)


def color_torch(policy, noise):
    """Makes Stable-Baselines3's policy draw from the noise, as the paper's code does."""
    import torch
    from stable_baselines3.common.distributions import DiagGaussianDistribution

    class ColoredGaussian(DiagGaussianDistribution):
        def sample(self):
            eps = torch.as_tensor(noise.sample(), dtype=torch.float32)
            return self.distribution.mean + self.distribution.stddev * eps

    policy.action_dist = ColoredGaussian(policy.action_space.shape[0])


def color_jax(policy, noise):
    """The same for SBX, in its one compiled function that acts."""
    import jax

    @jax.jit
    def predict_all(actor_state, vf_state, obs, eps):
        dist = actor_state.apply_fn(actor_state.params, obs)
        actions = dist.mean() + dist.stddev() * eps
        values = vf_state.apply_fn(vf_state.params, obs).flatten()
        return actions, dist.log_prob(actions), values

    policy.predict_all = lambda obs, key: predict_all(
        policy.actor_state, policy.vf_state, obs, noise.sample().astype("float32")
    )


def run_physics(clock, env_id, size):
    """mj_step on a dm_control task's model, with its substeps; resets are not counted."""
    if not env_id.startswith("dm_control/"):
        raise ValueError("it knows only dm_control's models")
    import mujoco
    import numpy as np
    from dm_control import suite

    env = suite.load(*env_id.removeprefix("dm_control/").removesuffix("-v0").split("-"))
    model, data = env.physics.model.ptr, env.physics.data.ptr
    n_substeps = round(env.control_timestep() / model.opt.timestep)
    episode_length = round(env._step_limit)
    random = np.random.default_rng(1).normal(size=(episode_length, model.nu)).clip(-1, 1)

    def simulate(n_steps, actions):
        for t in range(n_steps):
            if t % episode_length == 0:
                clock.timed(None, env.reset)()
            data.ctrl[:] = actions[t % episode_length]
            mujoco.mj_step(model, data, n_substeps)

    while True:
        clock.next_round()
        simulate(size.n_envs * size.n_steps, random)
        clock.timed("evaluation", simulate)(size.eval_episodes * episode_length, 0 * random)


# --- Measuring


def contend(pipe, run, env_id, size):
    """What a contender's process does: runs, silently, and reports why where it cannot."""
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    try:
        run(Clock(pipe), env_id, size)
    except (Exception, SystemExit) as error:
        pipe.send(f"{type(error).__name__}: {error}")


def measure(env_id, contenders, n_rounds, size):
    """Lets contenders, {name: run}, play a round that is not counted and n_rounds, in turns.

    Returns a list of table rows, of those that can run.
    """

    def receive(name):
        try:
            result = pipes[name].recv()
        except EOFError:
            result = "its process has died: not enough memory?"
        if isinstance(result, str):
            print(f"note: nothing of {name} on {env_id} ({result})", file=sys.stderr)
            del pipes[name]
        return result

    context = multiprocessing.get_context("spawn")
    pipes, processes, startup, rounds = {}, {}, {}, collections.defaultdict(list)
    for name, run in contenders.items():
        pipes[name], pipe = context.Pipe()
        arguments = (pipe, run, env_id, size)
        processes[name] = context.Process(target=contend, args=arguments, daemon=True)
        start = time.perf_counter()
        processes[name].start()
        pipe.close()  # here: the process has its own, and its death ends recv
        receive(name)
        startup[name] = time.perf_counter() - start
    for _ in range(1 + n_rounds):
        for name in list(pipes):
            pipes[name].send(True)
            rounds[name].append(receive(name))
    for name, pipe in pipes.items():
        pipe.send(False)
        processes[name].join()
    rows = []
    for name in pipes:
        about = {"env_id": env_id, "contender": name, "n_envs": size.n_envs}
        medians = summary(rounds[name][1:], size)
        rows.append({**about, **medians, "start-up s": startup[name]})
    return rows


def summary(rounds, size):
    """A contender's medians over its rounds: microseconds per training step, peak memory."""
    import pandas as pd

    table, steps = pd.DataFrame(rounds), size.n_envs * size.n_steps
    table[PHASES] *= 1e6 / steps
    table["evaluation"] *= steps / EVAL_FREQ  # a round has one, the protocol one per EVAL_FREQ
    total = table[PHASES].sum(axis=1)
    return {**table.median(), "total us": total.median(), "from": total.min(), "to": total.max()}


# --- The tables: generators of lists of rows


def phases(args):
    """All contenders on each environment, with ratios of the totals."""
    script, other = functools.partial(run_script, flags="--threads 1"), "--threads 1 --no-envpool"
    contenders = {
        "this script": script,
        "this script, --no-envpool": functools.partial(run_script, flags=other),
        PAPER: run_peer,
        "SBX": functools.partial(run_peer, jax=True),
        PHYSICS: run_physics,
    }
    for env_id in args.env_ids or DM_CONTROL:
        rows = measure(env_id, contenders, args.rounds, args.size)
        totals = {row["contender"]: row["total us"] for row in rows}
        for row in rows:
            row["x faster"] = totals.get(PAPER, float("nan")) / row["total us"]
            row["x physics"] = row["total us"] / totals.get(PHYSICS, float("nan"))
        yield rows


def n_envs(args):
    """The script's training, without evaluations, with each number of environments."""
    for env_id in args.env_ids or DM_CONTROL[:1]:
        rows = []
        for n in (1, 4, 16, 64, 128):
            for name, flags in [("--threads 1", ""), ("--no-envpool", "--no-envpool")]:
                how = {"flags": f"--threads 1 {flags}", "evaluations": False}
                contender = {f"training, {name}": functools.partial(run_script, **how)}
                rows += measure(env_id, contender, 1, args.size._replace(n_envs=n))
        yield rows


def threads(args):
    """One run on one core and on all: the whole protocol's minutes, by its rounds."""
    for env_id in args.env_ids or [DM_CONTROL[-1], "AntUMaze-v1", "door-v0"]:
        rows = []
        for n in sorted({1, len(CORES)}):
            hold_on_cores(n)
            run = functools.partial(run_script, flags=f"--threads {n}")
            contender = {f"one run, {n} core{'s'[: n > 1]}": run}
            rows += measure(env_id, contender, args.rounds, args.size)
        yield [row | {"minutes": row["total us"] * TOTAL_STEPS / 60e6} for row in rows]


# A run that ends with its first minibatch, and the same with an edited loss
SCRIPT = "ppo_colored_continuous"
FIRST_STEP = f"{SCRIPT}.py --n-envs 4 --n-steps 32 --n-epochs 1 --total-timesteps 128 "
FIRST_STEP += "--eval-freq 128 --eval-episodes 1 --overwrite"
EDITED = f"""import sys, {SCRIPT} as ppo
def edited_loss(*args):
    loss, metrics = ppo.ppo_loss(*args)
    return 0.9 * loss, metrics
ppo.main(ppo.parse_args(sys.argv[2:]), loss=edited_loss)"""


def waiting(args):
    """Seconds until the first training step is done, and of what comes before it, on all cores."""
    import pandas as pd

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


TABLES = {table.__name__: table for table in (phases, n_envs, threads, waiting)}


def parse_args(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("--tables", nargs="+", choices=TABLES, default=TABLES, help="which to make")
    add("--env-ids", nargs="+", help="in place of those that each table has")
    add("--rounds", type=int, default=3, help="that count")
    add("--csv", type=Path, default="benchmark.csv", help="file for the rows of all tables")
    args = parser.parse_args(argv)
    args.size = Size()
    if not args.csv.absolute().parent.is_dir():
        parser.error(f"--csv {args.csv}: there is no such folder")
    return args


def main(args):
    import pandas as pd

    rows = []
    for name in args.tables:
        hold_on_cores(1)
        for table in filter(None, TABLES[name](args)):  # where it is empty, notes have said why
            rows += table
            pd.DataFrame(rows).round(3).to_csv(args.csv, index=False)
            shown = pd.DataFrame(table).to_string(index=False, float_format="{:.2f}".format)
            print(shown, end="\n\n", flush=True)


if __name__ == "__main__":
    main(parse_args())
