"""Vector environments by id: Gymnasium's own, and dm_control's through shimmy, with flat float32 observations.

Importing this file is quick and silent: the package behind an environment is imported when one is made.
"""

import contextlib
import difflib
import functools
import io
import logging
import math
import os
import re
import warnings

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv


def silence():
    """Keeps the warnings and log lines of the packages used here off the terminal. For a program, not for a library."""
    gym.logger.min_level = gym.logger.ERROR + 1
    logging.getLogger("absl").setLevel(logging.ERROR)
    warnings.showwarning = lambda *args, **kwargs: None  # filters would not do: some packages set their own


# --- The mazes and the Adroit door
MAZE_IDS = ["PointUMaze-v1", "Point4Rooms-v1", "AntUMaze-v1", "Ant4Rooms-v1", "SwimmerUMaze-v1", "Swimmer4Rooms-v1"]
MAZE_IDS += ["PointPush-v1", "AntPush-v1", "PointPushMaze-v1", "AntPushMaze-v1"]
for env_id in MAZE_IDS:  # Gymnasium's checks of every step would cost more than the point's physics
    robot, maze = re.fullmatch("(Point|Ant|Swimmer)(.*)-v1", env_id).groups()
    kwargs = {"robot": robot.lower(), "maze": maze}
    gym.register(env_id, "mazes:MazeEnv", max_episode_steps=1000, disable_env_checker=True, kwargs=kwargs)
gym.register("door-v0", "environments:make_door", max_episode_steps=200, disable_env_checker=True)


def make_door(**kwargs):
    """Makes D4RL's `door-v0` from gymnasium-robotics; takes the arguments of its AdroitHandDoorEnv but reward_type.

    The package's AdroitHandDoor-v1 rewards the distance between palm and handle with +0.1 per m, D4RL with -0.1.
    """
    with contextlib.redirect_stderr(io.StringIO()):  # importing the package prints a notice
        from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv

    class AdroitDoor(AdroitHandDoorEnv):
        def step(self, action):
            obs, reward, terminated, truncated, info = super().step(action)
            palm_to_handle = math.hypot(*obs[-4:-1])
            return obs, reward - 0.2 * palm_to_handle, terminated, truncated, info

    return AdroitDoor(reward_type="dense", **kwargs)


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


def make_vector_env(env_id, n_envs, envpool=False):
    """Makes n_envs environments that step together: observations (n_envs, obs_dim) float32, SAME_STEP autoreset.

    The step that ends an episode returns the next episode's first observation, and the ended one's last observation in
    infos["final_obs"]. Gymnasium's default, NEXT_STEP, inserts a dummy transition between episodes instead.
    Observations are overwritten by the next step. Raises as make_env does. With envpool they are EnvPool's.
    """
    if envpool:
        return EnvPoolVectorEnv(env_id, n_envs)
    return SyncVectorEnv([lambda: make_env(env_id)] * n_envs, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)


ENVPOOL_TASKS = {
    "MountainCarContinuous-v0": "MountainCarContinuous-v0",
    "dm_control/ball_in_cup-catch-v0": "BallInCupCatch-v1",
    "dm_control/cartpole-balance_sparse-v0": "CartpoleBalanceSparse-v1",
    "dm_control/cartpole-swingup_sparse-v0": "CartpoleSwingupSparse-v1",
    "dm_control/cheetah-run-v0": "CheetahRun-v1",
    "dm_control/hopper-hop-v0": "HopperHop-v1",
    "dm_control/pendulum-swingup-v0": "PendulumSwingup-v1",
    "dm_control/reacher-hard-v0": "ReacherHard-v1",
    "dm_control/walker-run-v0": "WalkerRun-v1",
    "door-v0": "AdroitHandDoor-v1",
}

COMPLEX = MAZE_IDS[-4:]  # Sec. A8: not in the paper's averages
# fmt: off
NAMES = {  # environment id: its name in the paper (Sec. A4)
    "MountainCarContinuous-v0": "Mountain Car", "door-v0": "Door",
    "dm_control/ball_in_cup-catch-v0": "Ball in Cup (Catch)",
    "dm_control/cartpole-balance_sparse-v0": "Cartpole Balance",
    "dm_control/cartpole-swingup_sparse-v0": "Cartpole Swingup",
    "dm_control/cheetah-run-v0": "Cheetah Run", "dm_control/hopper-hop-v0": "Hopper Hop",
    "dm_control/pendulum-swingup-v0": "Pendulum Swingup",
    "dm_control/reacher-hard-v0": "Reacher Hard", "dm_control/walker-run-v0": "Walker Run",
    "PointUMaze-v1": "UMaze Point", "AntUMaze-v1": "UMaze Ant", "SwimmerUMaze-v1": "UMaze Swimmer",
    "Point4Rooms-v1": "4 Rooms Point", "Ant4Rooms-v1": "4 Rooms Ant",
    "Swimmer4Rooms-v1": "4 Rooms Swimmer", "PointPush-v1": "Point Push", "AntPush-v1": "Ant Push",
    "PointPushMaze-v1": "Point Push Maze", "AntPushMaze-v1": "Ant Push Maze",
}
# fmt: on


class EnvPoolVectorEnv(VectorEnv):
    """The same tasks from EnvPool, in C++: what make_vector_env promises, but for the seeds (see reset).

    Raises gymnasium.error.Error, with a message for the user, for other tasks and where EnvPool is not installed.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env_id, n_envs):
        if env_id not in ENVPOOL_TASKS:
            raise gym.error.Error(f"--envpool does not have {env_id}, only {', '.join(ENVPOOL_TASKS)}")
        try:
            import envpool
        except ImportError as error:
            raise gym.error.DependencyNotInstalled(f"--envpool needs EnvPool (pip install envpool): {error}") from error
        self._make = functools.partial(envpool.make_gymnasium, ENVPOOL_TASKS[env_id], num_envs=n_envs, num_threads=1)
        spec = envpool.make_spec(ENVPOOL_TASKS[env_id])
        self.env_id, self.num_envs, self._pool = env_id, n_envs, None
        obs_dim = spaces.flatdim(spec.gymnasium_observation_space)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        action_space = spec.gymnasium_action_space
        self.single_action_space = spaces.Box(action_space.low, action_space.high, dtype=np.float32)
        self._indices, self._action_dtype = np.arange(n_envs, dtype=np.int32), action_space.dtype
        self._state_keys = spec._state_keys  # "obs", or "obs:position" and so on; "reward", "done", "trunc"
        self._obs_keys = sorted(key for key in self._state_keys if key.split(":")[0] == "obs")

    def reset(self, *, seed=None, options=None):
        """Starts new episodes. Only the first reset heeds the seeds, a list of n_envs integers below 2^32.

        EnvPool takes its seeds when it is made, which takes seconds; the environments' generators run on afterwards.
        """
        if self._pool is None:
            seed = range(self.num_envs) if seed is None else seed
            self._pool = self._make(seed=np.array(seed, np.uint32).view(np.int32))  # EnvPool's seeds are int32
            self._fresh = np.zeros(self.num_envs, bool)
            self._obs = np.empty((self.num_envs, *self.single_observation_space.shape), np.float32)
        self._begin_episodes(np.flatnonzero(~self._fresh))  # the others have just been reset by step
        return self._obs.copy(), {}

    def step(self, actions):
        # The two functions that EnvPool's step() calls; the rest of it takes as long as the physics of four pendulums
        actions = np.reshape(actions, (self.num_envs, *self.single_action_space.shape))  # or C++ reads on past the end
        self._pool._send([self._indices, self._indices, np.asarray(actions, self._action_dtype, order="C")])
        state = self._receive()
        self._obs, rewards, truncated = state["obs"], state["reward"], state["trunc"]
        terminated = state["done"] & ~truncated
        if self.env_id == "door-v0":  # EnvPool has the sign of the reaching term flipped as well
            rewards = rewards - 0.2 * np.linalg.norm(self._obs[:, -4:-1], axis=1)
        elif self.env_id == "dm_control/ball_in_cup-catch-v0":
            # EnvPool takes the radius of the cup's wall, 0.008, for the ball's, 0.025, and pays for balls half outside.
            # The observation begins with the positions (x, z) of cup and ball, relative to (0, 0.6) and (0, 0.2).
            ball_to_target = self._obs[:, :2] - self._obs[:, 2:4] + (0, 0.6 - 0.05 - 0.2)
            rewards = (np.abs(ball_to_target) < 0.05 - 0.025).all(axis=1).astype(np.float32)
        infos = {}
        self._fresh = terminated | truncated
        if self._fresh.any():
            infos["final_obs"] = self._obs.copy()
            self._begin_episodes(np.flatnonzero(self._fresh))
        return self._obs, rewards, terminated, truncated, infos

    def _begin_episodes(self, indices):
        if len(indices):
            self._pool._reset(self._indices[indices])
            self._obs[indices] = self._receive()["obs"]
            self._fresh[indices] = True

    def _receive(self):
        state = dict(zip(self._state_keys, self._pool._recv(), strict=True))
        parts = [state[key].reshape(len(state["done"]), -1) for key in self._obs_keys]
        state["obs"] = np.concatenate(parts, axis=1, dtype=np.float32)
        return state


def make_render_env(env_id):
    """Makes one environment that renders frames without a display; raises gymnasium.error.Error where it cannot."""
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # or pygame complains on machines without sound
    env = make_env(env_id, render_mode="rgb_array")
    try:
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
