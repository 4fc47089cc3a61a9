"""Vector environments by id: Gymnasium's own, and dm_control's through shimmy, with flat float32 observations.

Importing this file is quick and silent: the package behind an environment is imported when one is made.
"""

import difflib
import logging
import os
import warnings

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv


def silence():
    """Keeps the warnings and log lines of the packages used here off the terminal. For a program, not for a library."""
    gym.logger.min_level = gym.logger.ERROR + 1
    logging.getLogger("absl").setLevel(logging.ERROR)
    warnings.showwarning = lambda *args, **kwargs: None  # filters would not do: some packages set their own


class FlatObservations(gym.Wrapper):
    """Flattens observations of any space into one float32 vector (a Dict in its order of keys), and drops the infos."""

    def __init__(self, env):
        super().__init__(env)
        obs_dim = spaces.flatdim(env.observation_space)
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)

    def reset(self, **kwargs):
        obs, _ = self.env.reset(**kwargs)
        return self._flatten(obs), {}

    def step(self, action):
        obs, reward, terminated, truncated, _ = self.env.step(action)
        return self._flatten(obs), reward, terminated, truncated, {}

    def _flatten(self, obs):
        return spaces.flatten(self.env.observation_space, obs).astype(np.float32)


def make_env(env_id, **kwargs):
    """Makes one environment with observations (obs_dim,) float32 and a Box action space.

    Raises gymnasium.error.Error with a message for the user: unknown id (naming close matches), a package that is
    missing, or actions that are not continuous.
    """
    if env_id.startswith("dm_control/"):
        import shimmy  # noqa: F401  registers the dm_control ids
    try:
        env = gym.make(env_id, disable_env_checker=True, **kwargs)
    except gym.error.UnregisteredEnv:
        import shimmy  # noqa: F401, F811

        matches = difflib.get_close_matches(env_id, gym.registry, n=3, cutoff=0.4)
        raise gym.error.UnregisteredEnv(f"unknown environment {env_id}; did you mean {' or '.join(matches)}?") from None
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(f"{env_id} needs a package that is not installed: {error}") from error
    if not isinstance(env.action_space, spaces.Box):
        raise gym.error.Error(f"{env_id} has actions {env.action_space}; colored noise needs continuous ones (Box)")
    return FlatObservations(env)


def make_vector_env(env_id, n_envs):
    """Makes n_envs environments that step together: observations (n_envs, obs_dim) float32, SAME_STEP autoreset.

    The step that ends an episode returns the next episode's first observation, and the ended one's last observation in
    infos["final_obs"]. Gymnasium's default, NEXT_STEP, inserts a dummy transition between episodes instead.
    Observations are overwritten by the next step. Raises as make_env does.
    """
    return SyncVectorEnv([lambda: make_env(env_id)] * n_envs, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)


def make_render_env(env_id):
    """Makes one environment that renders frames without a display; raises gymnasium.error.Error where it cannot."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # or pygame complains on machines without sound
    try:
        env = make_env(env_id, render_mode="rgb_array")
        env.reset()
        env.render()
    except Exception as error:  # each renderer fails in its own way
        raise gym.error.Error(
            f"cannot render {env_id} ({error}): install libegl1 and libgl1 and set MUJOCO_GL=egl, or MUJOCO_GL=osmesa"
        ) from error
    return env


def record_video(env, policy, path, seed):
    """Plays one episode of policy(obs (1, obs_dim)) -> actions (1, action_dim) and saves it as a video (.mp4)."""
    import imageio

    path.parent.mkdir(exist_ok=True)
    fps = 1 / env.unwrapped.dt if hasattr(env.unwrapped, "dt") else env.metadata.get("render_fps", 30)
    obs, _ = env.reset(seed=seed)
    done = False
    with imageio.get_writer(path, fps=fps, macro_block_size=2) as video:
        while not done:
            video.append_data(env.render())
            obs, _, terminated, truncated, _ = env.step(policy(obs[None])[0])
            done = terminated or truncated
