"""What the study adds to the environments of ppo_colored_continuous.py.

The paper's own tasks, ten mazes and the Adroit door (importing this file registers their ids);
EnvPool's C++ versions of ten tasks; and threads that step environments. Packages with environments
are imported when an environment is made.
"""

import contextlib
import importlib.util
import io
import logging
import math
import os
import re
import sys
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from study.normalization import NormalizedVectorEnv  # noqa: F401  for the script
from study.protocol import NAMES

# --- The mazes and the Adroit door

for env_id in NAMES:
    if task := re.fullmatch("(Point|Ant|Swimmer)(.*)-v1", env_id):
        kwargs = {"robot": task[1].lower(), "maze": task[2]}
        limits = {"max_episode_steps": 1000, "reward_threshold": 0.9}
        gym.register(env_id, "study.mazes:MazeEnv", kwargs=kwargs, **limits)
gym.register("door-v0", "study.environments:make_door", max_episode_steps=200)


def make_door(**kwargs):
    """Makes D4RL's `door-v0` from AdroitHandDoor-v1 of gymnasium-robotics; kwargs are its.

    That rewards the distance between palm and handle with +0.1 per m, D4RL with -0.1.
    """
    with contextlib.redirect_stderr(io.StringIO()):  # importing the package prints a notice
        from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv

    class AdroitDoor(AdroitHandDoorEnv):
        def step(self, action):
            obs, reward, terminated, truncated, info = super().step(action)
            palm_to_handle = math.hypot(*obs[-4:-1])
            return obs, reward - 0.2 * palm_to_handle, terminated, truncated, info

    return AdroitDoor(reward_type="dense", **kwargs)


# --- Pictures and messages


def prepare_rendering():
    """Lets MuJoCo and pygame render without a display; call it before the environment is made."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not display:
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # or pygame complains without sound


def quiet_packages():
    """Keeps messages of installed packages off the terminal, but not a user's own warnings."""
    gym.logger.min_level = gym.logger.ERROR
    logging.getLogger("absl").setLevel(logging.ERROR)  # dm_control's
    warnings.filterwarnings("ignore", module="glfw|torch.jit")  # no DISPLAY; deprecations
    with contextlib.suppress(ImportError):
        import mujoco

        mujoco.set_mju_user_warning(lambda message: None)


@contextlib.contextmanager
def tiny_textures():
    """Tasks of dm_control that are made in this context have a sky and a floor of few pixels.

    These take 12 MB of memory in each environment, and only pictures need them.
    """
    from dm_control.suite import common

    assets = dict(common.ASSETS)
    for file in ("./common/skybox.xml", "./common/materials.xml"):
        common.ASSETS[file] = one_pixel_wide(assets[file])
    try:
        yield
    finally:
        common.ASSETS.update(assets)


def one_pixel_wide(xml):
    return re.sub(rb'(width|height)="\d+"', rb'\1="1"', xml)


# --- Environments of Gymnasium, stepped by threads where that helps

# Tasks whose environments share no state, and whose step is mostly MuJoCo's, which runs in parallel
# with other threads. Microseconds per step with 1 and 2 threads, of 50 environments: swimmer maze
# 36 and 21, but point maze 20 and 27. With EnvPool: cheetah 12.2 and 6.5, walker 101 and 66, but
# no gain in pendulum, whose physics is too quick.
GAIN_BY_THREADS = {env_id for env_id in NAMES if env_id.startswith(("Ant", "Swimmer"))}
GAIN_BY_THREADS |= {"dm_control/cheetah-run-v0", "dm_control/walker-run-v0", "door-v0"}
GAIN_BY_THREADS |= {"dm_control/hopper-hop-v0", "dm_control/ball_in_cup-catch-v0"}


def make_vector_env(args, n_envs, make_env):
    """Makes n_envs environments by make_env(args), with SAME_STEP autoreset.

    They are stepped by args.threads threads if the task gains by it.
    """
    quiet_packages()
    is_suite = args.env_id.startswith("dm_control/")
    with tiny_textures() if is_suite else contextlib.nullcontext():
        envs = [make_env(args) for _ in range(n_envs)]
    if min(args.threads, n_envs) > 1 and args.env_id in GAIN_BY_THREADS and not is_suite:
        return ThreadedVectorEnv(envs, args.threads)
    return sync_vector_env(envs)


def sync_vector_env(envs):
    functions = [lambda env=env: env for env in envs]
    return SyncVectorEnv(functions, copy=False, autoreset_mode=AutoresetMode.SAME_STEP)


class ThreadedVectorEnv(VectorWrapper):
    """A SyncVectorEnv, except that n_threads threads step it, each a part of the environments.

    Results are the same bit for bit if the environments share no state.
    """

    def __init__(self, envs, n_threads):
        super().__init__(sync_vector_env(envs))
        groups = np.array_split(np.arange(len(envs)), min(n_threads, len(envs)))
        self._parts = [sync_vector_env([envs[i] for i in group]) for group in groups]
        self._pool = ThreadPoolExecutor(len(groups))

    def step(self, actions):
        parts_actions = np.array_split(actions, len(self._parts))
        results = self._pool.map(SyncVectorEnv.step, self._parts, parts_actions)
        *arrays, parts_infos = zip(*results, strict=True)
        final_obs = []
        for part, infos in zip(self._parts, parts_infos, strict=True):
            final_obs += list(infos.get("final_obs", [None] * part.num_envs))
        return *map(np.concatenate, arrays), {"final_obs": final_obs}

    def close(self, **kwargs):
        self._pool.shutdown()  # waits for steps that are under way
        super().close(**kwargs)


# --- EnvPool

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


def envpool_suits(args):
    """Whether EnvPool is installed and has the task with these arguments. Does not import it."""
    changed = args.max_episode_steps is not None or args.env_kwargs
    has_task = args.env_id in ENVPOOL_TASKS and not changed
    return has_task and importlib.util.find_spec("envpool") is not None


class EnvPoolVectorEnv(VectorEnv):
    """The same tasks from EnvPool, in C++, as a vector environment with SAME_STEP autoreset.

    The same seed does not give the same episodes as in Gymnasium's environments.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, args, n_envs):
        if not envpool_suits(args):
            raise ValueError(
                f"EnvPool is not installed, or does not have {args.env_id}, or not with "
                "--max-episode-steps or --env-kwargs: use --no-envpool"
            )
        import envpool

        gym.logger.min_level = gym.logger.ERROR  # hides notices about EnvPool's spaces
        self._args, self.num_envs, self._pool = args, n_envs, None
        spec = envpool.make_spec(ENVPOOL_TASKS[args.env_id])
        obs_dim = spaces.flatdim(spec.gymnasium_observation_space)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        actions = spec.gymnasium_action_space
        self.single_action_space = spaces.Box(np.float32(actions.low), np.float32(actions.high))
        self.observation_space = batch_space(self.single_observation_space, n_envs)
        self.action_space = batch_space(self.single_action_space, n_envs)
        self._indices, self._action_dtype = np.arange(n_envs, dtype=np.int32), actions.dtype
        # "obs", or "obs:position" and so on; "reward", "done", "trunc"
        self._state_keys = spec._state_keys
        self._obs_keys = sorted(key for key in self._state_keys if key.split(":")[0] == "obs")

    def reset(self, *, seed=None, options=None):
        """Starts new episodes. Only the first reset uses seeds, n_envs integers below 2^32.

        EnvPool takes seeds only when it makes its environments, and that takes seconds.
        """
        if self._pool is None:
            self._pool = self._make_pool(np.array(seed, np.uint32).view(np.int32))
            self._fresh = np.zeros(self.num_envs, bool)
            self._obs = np.empty(self.observation_space.shape, np.float32)
        self._begin_episodes(~self._fresh)  # the last step has just reset the others
        return self._obs.copy(), {}

    def step(self, actions):
        # EnvPool does not check the shape, and would read other memory
        actions = np.asarray(actions, self._action_dtype, "C").reshape(self.action_space.shape)
        # These two functions are what EnvPool's step() calls. The rest of step() takes as long as
        # the physics of four pendulums.
        self._pool._send([self._indices, self._indices, actions])
        state = self._receive()
        self._obs, rewards, truncated = state["obs"], state["reward"], state["trunc"]
        terminated = state["done"] & ~truncated
        if self._args.env_id == "door-v0":
            # As gymnasium-robotics, EnvPool rewards the distance between palm and handle
            rewards = rewards - 0.2 * np.linalg.norm(self._obs[:, -4:-1], axis=1)
        elif self._args.env_id == "dm_control/ball_in_cup-catch-v0":
            # EnvPool takes the radius of the cup's wall, 0.008, for the ball's, 0.025, and pays for
            # balls half outside. The observation begins with the positions (x, z) of cup and ball,
            # relative to (0, 0.6) and (0, 0.2).
            ball_to_target = self._obs[:, :2] - self._obs[:, 2:4] + (0, 0.6 - 0.05 - 0.2)
            rewards = (np.abs(ball_to_target) < 0.05 - 0.025).all(axis=1).astype(np.float32)
        final_obs, self._fresh = self._obs.copy(), terminated | truncated
        self._begin_episodes(self._fresh)
        return self._obs, rewards, terminated, truncated, {"final_obs": final_obs}

    def _make_pool(self, seeds):
        """Makes EnvPool's environments, from models without what only pictures need.

        This saves 12 MB of memory per environment in dm_control's tasks, 7 in the door.
        seeds: (n_envs,) int32.
        """
        import envpool

        n_threads = self._args.threads if self._args.env_id in GAIN_BY_THREADS else 1
        options = {"num_envs": self.num_envs, "num_threads": min(n_threads, self.num_envs)}
        originals = Path(envpool.registration.base_path, "mujoco")
        with tempfile.TemporaryDirectory() as folder:
            for models in ("assets_dmc", "robotics/assets/adroit_hand"):
                for file in filter(Path.is_file, (originals / models).rglob("*")):
                    copy = Path(folder, "mujoco", file.relative_to(originals))
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    if file.name in ("skybox.xml", "materials.xml"):
                        copy.write_bytes(one_pixel_wide(file.read_bytes()))
                    elif file.name == "adroit_assets.xml":  # of the door
                        lean = b'<compiler discardvisual="true" '
                        copy.write_bytes(file.read_bytes().replace(b"<compiler ", lean))
                    else:
                        copy.symlink_to(file)
            task = ENVPOOL_TASKS[self._args.env_id]
            return envpool.make_gymnasium(task, seed=seeds, base_path=folder, **options)

    def _begin_episodes(self, chosen):
        """Resets the chosen environments, (n_envs,) bool."""
        if chosen.any():
            self._pool._reset(self._indices[chosen])
            self._obs[chosen] = self._receive()["obs"]
            self._fresh = self._fresh | chosen

    def _receive(self):
        state = dict(zip(self._state_keys, self._pool._recv(), strict=True))
        parts = [state[key].reshape(len(state["done"]), -1) for key in self._obs_keys]
        state["obs"] = np.concatenate(parts, axis=1, dtype=np.float32)
        return state
