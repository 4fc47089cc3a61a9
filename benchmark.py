"""How long a training step takes, and what it is made of: this script beside its peers.

    pip install -r requirements.txt -r tests/requirements.txt && python benchmark.py

Every contender trains with the paper's settings (4 environments, 8,192 steps per update) and
evaluates 50 episodes, in a process of its own. All are held on one core, since that is what a run
has in a sweep that keeps every core busy. They take turns: a round is one update and one evaluation
of each. The table has medians over rounds in microseconds per training step, evaluations weighted
as in the protocol (one per 10,240 steps). The first round is not counted: torch.compile is in it.
Start-up is the time until it begins. Policies are as they are after a few updates. "files" is
logging, evaluations.csv and checkpoints. Bare physics is the simulator alone, called from Python:
as many control steps as the protocol has, with random actions in training, none in evaluation.

A second table has the training alone by number of environments, a third one run by number of
threads, no longer held on one core.
"""

import argparse
import functools
import importlib.util
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import defaultdict

os.environ["OMP_NUM_THREADS"] = "1"

N_ENVS, N_STEPS, STEPS = 4, 2048, 8192  # environments, steps in each per update, steps per round
EVAL_FREQ, EVAL_EPISODES = 10_240, 50
LEARNING_RATE, GAMMA, GAE_LAMBDA, CLIP_RANGE, BATCH_SIZE, N_EPOCHS = (
    2.5e-4,
    0.99,
    0.95,
    0.2,
    128,
    10,
)
PHASES = ["rollout", "noise", "update", "files", "evaluation"]
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
PAPER, PHYSICS = "the paper's stack", "bare physics"


class Clock:
    """Measures how long a contender is in each phase, and keeps it waiting between rounds."""

    def __init__(self, pipe):
        self.pipe, self.seconds = pipe, defaultdict(float)
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
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
            2**20 if sys.platform == "darwin" else 2**10
        )
        self.pipe.send({**{phase: self.seconds[phase] for phase in PHASES}, "peak MB": peak})
        if not self.pipe.recv():
            sys.exit()
        self.seconds.clear()
        self.phase, self.since = "rollout", time.perf_counter()


def run_script(clock, env_id, flags="", n_envs=N_ENVS, evaluations=True):
    """ppo_colored_continuous.py itself, with timers around the functions that its loop calls."""
    import ppo_colored_continuous as ppo

    def keep(*args, **kwargs):  # the last thing before the next rollout
        timed_keep(*args, **kwargs)
        clock.next_round()

    ppo.environments.silence()
    ppo.evaluate = clock.timed("evaluation", ppo.evaluate)
    ppo.ColoredNoiseProcess.sample = clock.timed("noise", ppo.ColoredNoiseProcess.sample)
    for name in ("log", "log_rollout", "add_evaluation"):
        setattr(ppo.RunFolder, name, clock.timed("files", getattr(ppo.RunFolder, name)))
    timed_keep = clock.timed("files", ppo.RunFolder.keep)
    ppo.RunFolder.keep = keep
    with tempfile.TemporaryDirectory() as folder:
        settings = f"--env-id {env_id} --n-envs {n_envs} --n-steps {N_STEPS} --runs-dir {folder} "
        settings += f"--eval-freq {STEPS if evaluations else 2_048_000} "
        settings += f"--eval-episodes {EVAL_EPISODES if evaluations else 1} {flags}"
        ppo.main(ppo.parse_args(settings.split()), learn=clock.timed("update", ppo.learn))


def run_peer(clock, env_id, jax=False):
    """PPO of Stable-Baselines3 or SBX, noise of pink-noise-rl, evaluated in 10 environments."""
    import gymnasium as gym
    import numpy as np
    import shimmy  # noqa: F401  registers the dm_control ids
    import torch
    from pink import ColoredNoiseProcess
    from stable_baselines3.common import callbacks
    from stable_baselines3.common.env_util import make_vec_env

    if jax:
        from sbx import PPO
    else:
        from stable_baselines3 import PPO

    torch.set_num_threads(1)
    flatten = gym.wrappers.FlattenObservation
    make = functools.partial(make_vec_env, env_id, seed=1, wrapper_class=flatten)
    settings = dict(n_steps=N_STEPS, batch_size=BATCH_SIZE, n_epochs=N_EPOCHS, seed=1)
    model = PPO("MlpPolicy", make(n_envs=N_ENVS), learning_rate=LEARNING_RATE, **settings)
    shape = (N_ENVS, model.action_space.shape[0], 1000)
    noise = ColoredNoiseProcess(0.5, shape, rng=np.random.default_rng(1))
    (color_jax if jax else color_torch)(model.policy, noise)
    model.train = clock.timed("update", model.train)
    callbacks.evaluate_policy = clock.timed("evaluation", callbacks.evaluate_policy)
    how = dict(n_eval_episodes=EVAL_EPISODES, eval_freq=N_STEPS, verbose=0)
    evaluation = callbacks.EvalCallback(make(n_envs=10), **how)
    while True:
        clock.next_round()
        model.learn(STEPS, evaluation, reset_num_timesteps=False)


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


def run_eager(clock, env_id):
    """PPO as CleanRL writes it: tensors step by step, autograd and Adam. Evaluated as here."""
    import numpy as np
    import torch
    from torch.distributions import Normal

    from environments import make_vector_env
    from ppo_colored_continuous import Agent, evaluate

    envs, eval_envs = make_vector_env(env_id, N_ENVS), make_vector_env(env_id, EVAL_EPISODES)
    obs_dim, action_dim = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    low, high = envs.single_action_space.low, envs.single_action_space.high
    agent = Agent(obs_dim, action_dim)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    obs, actions = torch.zeros(N_STEPS, N_ENVS, obs_dim), torch.zeros(N_STEPS, N_ENVS, action_dim)
    logprobs, rewards, dones, values = (torch.zeros(N_STEPS, N_ENVS) for _ in range(4))

    def get_action_and_value(x, action=None):
        mean = agent.actor_mean(x)
        probs = Normal(mean, agent.log_std.expand_as(mean).exp())
        action = probs.sample() if action is None else action
        return (
            action,
            probs.log_prob(action).sum(1),
            probs.entropy().sum(1),
            agent.critic(x).view(-1),
        )

    @torch.no_grad()
    def policy(x):
        return np.clip(agent.actor_mean(torch.tensor(x)).numpy(), low, high)

    @torch.no_grad()
    def collect(next_obs, next_done):
        for t in range(N_STEPS):
            obs[t], dones[t] = next_obs, next_done
            actions[t], logprobs[t], _, values[t] = get_action_and_value(next_obs)
            next_obs, reward, terminated, truncated, _ = envs.step(
                np.clip(actions[t].numpy(), low, high)
            )
            next_obs, rewards[t] = torch.tensor(next_obs), torch.tensor(reward)
            next_done = torch.tensor(terminated | truncated, dtype=torch.float32)
        advantages, last, value, done = (
            torch.zeros_like(rewards),
            0,
            agent.critic(next_obs).view(-1),
            next_done,
        )
        for t in reversed(range(N_STEPS)):
            delta = rewards[t] + GAMMA * value * (1 - done) - values[t]
            advantages[t] = last = delta + GAMMA * GAE_LAMBDA * (1 - done) * last
            value, done = values[t], dones[t]
        batch = [x.flatten(0, 1) for x in (obs, actions, logprobs, advantages, advantages + values)]
        return batch, next_obs, next_done

    def update(batch):
        indices, clip_fractions = np.arange(STEPS), []
        for _ in range(N_EPOCHS):
            np.random.default_rng().shuffle(indices)
            for start in range(0, STEPS, BATCH_SIZE):
                minibatch = (x[indices[start : start + BATCH_SIZE]] for x in batch)
                mb_obs, mb_actions, mb_logprobs, mb_advantages, mb_returns = minibatch
                _, new_logprobs, _, new_values = get_action_and_value(mb_obs, mb_actions)
                ratio = (new_logprobs - mb_logprobs).exp()
                clip_fractions.append(((ratio - 1).abs() > CLIP_RANGE).float().mean().item())
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (
                    mb_advantages.std() + 1e-8
                )
                clipped_ratio = torch.clamp(ratio, 1 - CLIP_RANGE, 1 + CLIP_RANGE)
                policy_loss = torch.max(
                    -mb_advantages * ratio, -mb_advantages * clipped_ratio
                ).mean()
                optimizer.zero_grad()
                (policy_loss + 0.5 * ((new_values - mb_returns) ** 2).mean()).backward()
                torch.nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()

    next_obs, next_done = torch.tensor(envs.reset(seed=1)[0]), torch.zeros(N_ENVS)
    while True:
        clock.next_round()
        batch, next_obs, next_done = collect(next_obs, next_done)
        clock.timed("update", update)(batch)
        clock.timed("evaluation", evaluate)(policy, eval_envs, 1)


def run_physics(clock, env_id):
    """mj_step on a dm_control task's model, with its substeps; resets are not counted."""
    import mujoco
    import numpy as np
    from dm_control import suite

    if not env_id.startswith("dm_control/"):
        raise ValueError("it knows only dm_control's models")
    env = suite.load(*env_id.removeprefix("dm_control/").removesuffix("-v0").split("-"))
    model, data = env.physics.model.ptr, env.physics.data.ptr
    n_substeps, episode_length = (
        round(env.control_timestep() / model.opt.timestep),
        round(env._step_limit),
    )
    random = np.random.default_rng(1).normal(size=(episode_length, model.nu)).clip(-1, 1)

    def simulate(n_steps, actions):
        for t in range(n_steps):
            if t % episode_length == 0:
                clock.timed(None, env.reset)()
            data.ctrl[:] = actions[t % episode_length]
            mujoco.mj_step(model, data, n_substeps)

    while True:
        clock.next_round()
        simulate(STEPS, random)
        clock.timed("evaluation", simulate)(EVAL_EPISODES * episode_length, 0 * random)


def contend(pipe, run, env_id):
    """What a contender's process does: runs, silently, and reports why where it cannot."""
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    try:
        run(Clock(pipe), env_id)
    except (Exception, SystemExit) as error:
        pipe.send(f"{type(error).__name__}: {error}")


def measure(env_id, contenders, n_rounds, n_envs=N_ENVS):
    """Lets contenders, {name: run}, play a round that is not counted and n_rounds, in turns.

    Returns a list of table rows, of those that can run.
    """
    import pandas as pd

    def receive(name):
        try:
            result = pipes[name].recv()
        except EOFError:
            result = "its process has died: not enough memory?"
        if isinstance(result, str):
            print(f"note: nothing of {name} on {env_id} ({result})", file=sys.stderr)
            del pipes[name]
        return result

    context, pipes, processes, startup, rounds = (
        multiprocessing.get_context("spawn"),
        {},
        {},
        {},
        defaultdict(list),
    )
    for name, run in contenders.items():
        pipes[name], pipe = context.Pipe()
        processes[name] = context.Process(target=contend, args=(pipe, run, env_id), daemon=True)
        start = time.perf_counter()
        processes[name].start()
        pipe.close()  # here: the process has its own, and its death ends recv
        receive(name)
        startup[name] = time.perf_counter() - start
    for _ in range(1 + n_rounds):
        for name in list(pipes):
            pipes[name].send(True)
            rounds[name].append(receive(name))
    rows = []
    for name, pipe in pipes.items():
        pipe.send(False)
        processes[name].join()
        table = pd.DataFrame(rounds[name][1:])
        table[PHASES] *= 1e6 / (n_envs * N_STEPS)
        table["evaluation"] *= STEPS / EVAL_FREQ
        total = table[PHASES].sum(axis=1)
        summary = {
            "total us": total.median(),
            "from": total.min(),
            "to": total.max(),
            "start-up s": startup[name],
        }
        rows.append(
            {"env_id": env_id, "contender": name, "n_envs": n_envs, **table.median(), **summary}
        )
    return rows


def compare(env_id, n_rounds):
    """All contenders on one environment. Returns the table's rows, with ratios of the totals."""
    ours = {"this script": functools.partial(run_script, flags="--threads 1")}
    flags = "--threads 1 --no-envpool"
    ours["this script, --no-envpool"] = functools.partial(run_script, flags=flags)
    others = {PAPER: run_peer, "SBX": functools.partial(run_peer, jax=True)}
    others |= {"eager PPO": run_eager, PHYSICS: run_physics}
    if importlib.util.find_spec("sbx") is None:
        print("note: without SBX (pip install sbx-rl)", file=sys.stderr)
        del others["SBX"]
    rows = measure(env_id, ours | others, n_rounds)
    totals = {row["contender"]: row["total us"] for row in rows}
    for row in rows:
        row["x faster"] = totals.get(PAPER, float("nan")) / row["total us"]
        row["x physics"] = row["total us"] / totals.get(PHYSICS, float("nan"))
    return rows


def compare_n_envs(env_id, all_n_envs):
    """This script's training, without evaluations, with each number of environments."""
    rows = []
    for n_envs in all_n_envs:
        for flags in ("--threads 1", "--threads 1 --no-envpool"):
            how = dict(flags=flags, n_envs=n_envs, evaluations=False)
            contender = f"training, {flags}".replace("training, --threads 1 ", "training, ")
            run = functools.partial(run_script, **how)
            rows += measure(env_id, {contender: run}, 1, n_envs)
    return rows


def compare_threads(env_ids, n_cores, n_rounds):
    """One run on one core and on all: the whole protocol's minutes, by its rounds."""
    rows = []
    for env_id in env_ids:
        for n in sorted({1, n_cores}):
            hold_on_cores(n)
            run = functools.partial(run_script, flags=f"--threads {n}")
            rows += measure(env_id, {f"one run, {n} core{'s'[: n > 1]}": run}, n_rounds)
    return [row | {"minutes": row["total us"] * 2.048 / 60} for row in rows]


def hold_on_cores(n):
    """Holds this process, and those it starts from now on, on the last n of its cores."""
    if hasattr(os, "sched_setaffinity"):  # Linux
        os.sched_setaffinity(0, CORES[-n:])


def main():
    import gymnasium as gym
    import pandas as pd

    import environments
    from run_files import fail, one_line_for

    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    dm_control = [f"dm_control/{t}-v0" for t in ("pendulum-swingup", "cheetah-run", "walker-run")]
    parser.add_argument("--env-ids", nargs="+", default=dm_control)
    parser.add_argument("--rounds", type=int, default=3, help="that count, after one that does not")
    parser.add_argument("--n-envs", type=int, nargs="*", default=[1, 4, 16, 64, 128],
                        help="compared on the first id")  # fmt: skip
    threads = ["dm_control/walker-run-v0", "AntUMaze-v1", "door-v0"]
    parser.add_argument("--thread-env-ids", nargs="*", default=threads, help="of the third table")
    parser.add_argument("--csv", default="benchmark.csv", help="file for the table")
    args = parser.parse_args()
    environments.silence()
    if not os.path.isdir(os.path.dirname(os.path.abspath(args.csv))):
        fail(f"--csv {args.csv}: there is no such folder", 2)
    for env_id in dict.fromkeys([*args.env_ids, *args.thread_env_ids]):
        with one_line_for(gym.error.Error):
            environments.make_env(env_id).close()

    hold_on_cores(1)
    tables = [functools.partial(compare, env_id, args.rounds) for env_id in args.env_ids]
    if args.n_envs:
        tables.append(functools.partial(compare_n_envs, args.env_ids[0], args.n_envs))
    if args.thread_env_ids:
        how = (args.thread_env_ids, len(CORES), args.rounds)
        tables.append(functools.partial(compare_threads, *how))
    rows = []
    for make_rows in tables:
        if not (table := make_rows()):  # its notes have said why
            continue
        rows += table
        pd.DataFrame(rows).round(3).to_csv(args.csv, index=False)
        table = pd.DataFrame(table).set_index(["env_id", "contender", "n_envs"])
        digits = {
            column: "{:.2f}".format if column.startswith("x ") else "{:.1f}".format
            for column in table
        }
        print(table.to_string(formatters=digits), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
