"""Plays a trained policy: return and length of some episodes, a window to watch it, or a video.

    python play.py runs/ppo_colored_continuous/MountainCarContinuous-v0/beta_0.5/n_envs_4/seed_1
    python play.py RUN --video car.mp4 --best
    python play.py RUN --window --beta 1      with the exploration noise, of any color

RUN is the folder of a run, finished or not, which has all that is needed. Played is Gymnasium's
environment, also where the run had EnvPool's.
"""

import argparse
import atexit
import contextlib
import json
import os
import signal
import types
from pathlib import Path

if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"  # for these small networks more threads are slower
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while loading: no traceback

import gymnasium as gym
import numpy as np
import torch

import baselines
import environments
import ppo_colored_continuous as ppo
import run_files
from colored_noise import ColoredNoiseProcess
from run_files import fail, stop_if_asked


def parse_args(argv=None):
    formatter = argparse.RawDescriptionHelpFormatter
    parser = run_files.ArgumentParser(description=__doc__, formatter_class=formatter)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run, with config.json and checkpoint.pt")
    add("--episodes", type="count", help="how many (10; 1 with --video)")
    add("--best", action="store_true", help="the policy that was evaluated best, not the last one")
    add("--beta", type="real", nargs="+", help="explore with noise of this color, or these; else "
        "it is the mean action")  # fmt: skip
    add("--seed", type="whole", default=1, help="of the environment and the noise (1)")
    shown = parser.add_mutually_exclusive_group().add_argument
    shown("--window", action="store_true", help="show it on the screen, at the speed of the task")
    shown("--video", type=Path, metavar="FILE", help="write it to this file, name.mp4")
    args = parser.parse_args(argv)
    if args.video and args.video.suffix != ".mp4":
        parser.error(f"--video {args.video} has to end in .mp4")
    args.episodes = args.episodes or (1 if args.video else 10)
    if args.seed + args.episodes > 2**32:  # dm_control's are 32 bits
        parser.error(f"--seed {args.seed} is too large")
    return args


def read_run(folder, best=False):
    """Reads the arguments of a run and its last policy, or the best.

    Returns its arguments (a namespace) and the dict of the policy: state_dicts "agent" and
    "normalization", and its "step".
    """
    file = folder / ("best.pt" if best else "checkpoint.pt")
    try:
        config = json.loads((folder / "config.json").read_text())
        args = run_files.ABSENT | config["args"]
        saved = torch.load(file, map_location="cpu", weights_only=True)
        acting = {"agent": saved["agent"], "normalization": saved.get("normalization", {})}
        acting["step"] = saved["step" if best else "global_step"]
        if args["method"] == "ppo":
            consequence = "with another network, this is another policy"
            run_files.note_other_script(config, ppo.__file__, consequence)
        return types.SimpleNamespace(**args), acting
    except (FileNotFoundError, NotADirectoryError) as error:
        if best and (folder / "checkpoint.pt").exists():
            fail(f"{folder} has no best.pt: it has not been evaluated, or is of an earlier version")
        example = "runs/ppo_colored_continuous/MountainCarContinuous-v0/beta_0.5/n_envs_4/seed_1"
        fail(f"no {error.filename}: give the folder of one run, such as {example}", 2)
    except Exception as error:  # torch.load raises nearly anything on a damaged file
        fail(f"{folder} cannot be read ({error!r:.100}): its config.json or {file.name} is damaged")


def make_env(run_args, state, args):
    """The environment as in training, its observations normalized by the run's statistics."""
    options = environments.env_options(run_args)
    if args.window and environments.is_headless():
        fail("--window: there is no display here; --video FILE writes a video", 2)
    make = environments.make_render_env if args.window or args.video else environments.make_env
    env = make(run_args.env_id, **options)
    if args.window:
        env.metadata = {**env.metadata, "render_fps": environments.frames_per_second(env)}
        env = gym.wrappers.HumanRendering(env)
    if run_args.normalize_obs:
        envs = environments.sync_vector_env([env])
        envs = environments.NormalizedVectorEnv(envs, True, run_args.normalize_rewards)
        envs.load_state_dict(state)
        env = envs.frozen_single(env)
    return env


def make_policy(acting, env, args, run_args):
    """Returns policy(obs (1, obs_dim)) -> actions (1, action_dim): the mean, or with noise."""
    action_dim = env.action_space.shape[0]
    gsde = run_args.method == "gsde"
    make_agent = baselines.GSDEAgent if gsde else ppo.Agent
    agent = make_agent(env.observation_space.shape[0], action_dim).requires_grad_(False)
    agent.load_state_dict(acting["agent"])
    policy = run_files.numpy_policy(agent.actor_mean)
    if not args.beta:
        return policy
    if gsde:
        fail("--beta: a gSDE policy has noise of its own, without a color", 2)
    if len(args.beta) not in (1, action_dim):
        fail(f"--beta has {len(args.beta)} values, the run {action_dim} action dimensions", 2)
    noise = ColoredNoiseProcess(args.beta, 1, action_dim, run_args.noise_seq_len, args.seed)
    std = agent.log_std.exp()
    return lambda obs: policy(obs) + (std * noise.sample()).numpy()


def play(env, policy, seed, video, max_steps):
    """Plays an episode. Returns (return, length)."""
    rewards = []
    for reward in environments.play(env, policy, seed, video):
        stop_if_asked()
        if len(rewards) == max_steps:
            fail(f"no end of an episode after {max_steps} steps")
        rewards.append(reward)
    return sum(rewards), len(rewards)


def main(args):
    run_files.prepare_torch()
    run_args, acting = read_run(args.run, args.best)
    with run_files.one_line_for(gym.error.Error):
        env = make_env(run_args, acting["normalization"], args)
    atexit.register(env.close)
    with run_files.one_line_for(RuntimeError, because=f"the policy in {args.run} does not fit: "):
        policy = make_policy(acting, env, args, run_args)
    noise = f"noise of beta {' '.join(f'{b:g}' for b in args.beta)}" if args.beta else "no noise"
    print(f"{run_args.env_id}, the policy after {acting['step']:,} steps, {noise}")
    results, max_steps = np.zeros((args.episodes, 2)), run_args.max_episode_steps or 10_000
    with contextlib.ExitStack() as stack:
        video = None
        if args.video:
            because = f"cannot write {args.video}: "
            stack.enter_context(run_files.one_line_for(OSError, because=because))
            video = stack.enter_context(environments.video_file(args.video, env))
        for i in range(args.episodes):
            results[i] = play(env, policy, args.seed + i, video, max_steps)
            print(f"episode {i + 1}: return {results[i, 0]:.4g}, length {results[i, 1]:.0f}")
    mean, std = results.mean(axis=0), results.std(axis=0)
    print(f"mean return {mean[0]:.4g} (std {std[0]:.2g}), mean length {mean[1]:.4g}")
    if args.video:
        print(f"wrote {args.video}")


if __name__ == "__main__":
    environments.silence()
    run_files.catch_signals()
    main(parse_args())
