"""Plays a trained policy: return and length of some episodes, a window to watch it, or a video.

    python -m study.play RUN --episodes 10
    python -m study.play RUN --video car.mp4 --best
    python -m study.play RUN --window --beta 1      with the exploration noise, of any color

RUN is the folder of a run, finished or not, such as
runs/ppo_colored_continuous/MountainCarContinuous-v0/beta_0.5/n_envs_4/seed_1. Its policy is played
in Gymnasium's environment, even if it was trained in EnvPool's.

In Python, `load_policy(RUN)` gives the policy and an environment to play it in.
"""

import contextlib
import json
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import ppo_colored_continuous as ppo
from colored_noise import ColoredNoiseProcess
from study import environments, methods
from study.normalization import NormalizedVectorEnv


def parse_args(argv=None):
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="folder of a run")
    add("--episodes", type=int, help="number of episodes (10; 1 with --video)")
    add("--best", action="store_true", help="play the policy of the best evaluation, not the last")
    add("--beta", type=float, nargs="+", help="add exploration noise: one beta, or one per action "
        "dimension; without it the mean action is played")  # fmt: skip
    add("--seed", type=int, default=1, help="of the environment and the noise (1)")
    shown = parser.add_mutually_exclusive_group().add_argument
    shown("--window", action="store_true", help="show the episodes in a window")
    shown("--video", type=Path, metavar="FILE", help="write a video to this file, name.mp4")
    args = parser.parse_args(argv)
    args.episodes = args.episodes or (1 if args.video else 10)
    return args


def load_policy(run, best=False, beta=None, seed=1, render_mode=None):
    """Loads the policy of a run and makes an environment to play it in.

        env, policy, _ = load_policy(RUN)
        returns, lengths = ppo_colored_continuous.evaluate(policy, env, seeds=[1])

    Args:
        run: folder of the run.
        best: load the policy of the best evaluation, not the last one.
        beta: of exploration noise to add, a number or one per action dimension. None: no noise.
        seed: of the noise.
        render_mode: None, "rgb_array" for pictures, "human" for a window.

    Returns:
        env: a vector of one environment, with the run's settings. It normalizes observations and
            rescales actions if the run did.
        policy: function from env's observations (1, obs_dim) to its actions (1, action_dim).
        step: the environment step of the run at which the policy was saved.
    """
    recorded = json.loads((Path(run) / "config.json").read_text())["args"]
    # Arguments that an older version of the script did not have get their defaults
    run_args = Namespace(**{**vars(ppo.parse_args([])), **recorded})
    saved = torch.load(Path(run) / ("best.pt" if best else "checkpoint.pt"), weights_only=True)
    env = make_env(run_args, saved.get("normalization"), render_mode)
    space = env.single_action_space
    make_agent = methods.GSDEAgent if run_args.method == "gsde" else ppo.Agent
    agent = make_agent(env.single_observation_space.shape[0], space.shape[0])
    agent.load_state_dict(saved["agent"])
    mean, std = ppo.numpy_policy(agent.actor_mean), agent.std().detach()
    if beta is not None:
        if run_args.method == "gsde":
            raise ValueError("gSDE has its own noise, which has no beta")
        noise = ColoredNoiseProcess(beta, 1, len(std), run_args.noise_seq_len, seed)

    def policy(obs):
        actions = mean(obs)
        if beta is not None:
            actions = actions + (std * noise.sample()).numpy()
        return np.clip(actions, space.low, space.high)

    return env, policy, saved["step" if best else "global_step"]


def make_env(run_args, normalization, render_mode):
    """A vector of one environment, as in the run; `normalization`: the state to normalize by."""
    if render_mode == "rgb_array":
        environments.prepare_rendering()
    environments.quiet_packages()
    env = ppo.make_env(run_args, "rgb_array" if render_mode else None)
    if render_mode == "human":
        env = gym.wrappers.HumanRendering(env)
    env = environments.sync_vector_env([env])
    if run_args.normalize_obs:
        training_env = NormalizedVectorEnv(env, run_args)
        training_env.load_state_dict(normalization)
        env = training_env.frozen(env)
    return env


def open_video(file, env):
    """A writer of pictures of env, at the speed of the task."""
    import imageio

    one = env.unwrapped.envs[0]
    dt = getattr(one.unwrapped, "dt", None)  # seconds of simulated time per step
    fps = 1 / dt if dt else one.metadata.get("render_fps") or 30
    return imageio.get_writer(file, fps=fps, macro_block_size=2)


def main(args):
    render_mode = "rgb_array" if args.video else "human" if args.window else None
    env, policy, step = load_policy(args.run, args.best, args.beta, args.seed, render_mode)
    noise = f"noise of beta {' '.join(f'{b:g}' for b in args.beta)}" if args.beta else "no noise"
    print(f"{args.run}: the policy after {step:,} steps, {noise}")
    results = np.zeros((args.episodes, 2))
    with contextlib.closing(env), contextlib.ExitStack() as stack:
        video = stack.enter_context(open_video(args.video, env)) if args.video else None

        def act(obs):
            if video:
                video.append_data(env.render()[0])
            return policy(obs)

        for i in range(args.episodes):
            results[i] = np.ravel(ppo.evaluate(act, env, [args.seed + i]))
            print(f"episode {i + 1}: return {results[i, 0]:.4g}, length {results[i, 1]:.0f}")
    mean, std = results.mean(axis=0), results.std(axis=0)
    print(f"mean return {mean[0]:.4g} (std {std[0]:.2g}), mean length {mean[1]:.4g}")


if __name__ == "__main__":
    main(parse_args())
