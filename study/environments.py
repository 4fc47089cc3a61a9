"""What the project adds to the environments of ppo_colored_continuous.py.

The paper's own tasks (importing this file registers them: ten mazes and the Adroit door), EnvPool's
C++ versions of ten tasks, and stepping by threads. The package behind an environment is imported
when one is made.
"""

import contextlib
import functools
import importlib.util
import io
import math
import os
import re
import sys
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space

from study.normalization import NormalizedVectorEnv  # noqa: F401  for the script
from study.protocol import NAMES

# --- The mazes and the Adroit door

for env_id in filter(re.compile("(Point|Ant|Swimmer).*-v1").fullmatch, NAMES):
    robot, maze = re.fullmatch("(Point|Ant|Swimmer)(.*)-v1", env_id).groups()
    gym.register(
        env_id,
        "study.mazes:MazeEnv",
        kwargs={"robot": robot.lower(), "maze": maze},
        max_episode_steps=1000,
        reward_threshold=0.9,
    )
gym.register("door-v0", "study.environments:make_door", max_episode_steps=200)


def make_door(**kwargs):
    """Makes D4RL's `door-v0` from gymnasium-robotics.

    Takes the arguments of the package's AdroitHandDoorEnv but reward_type.
    """
    return door_class()(**kwargs)


@functools.cache
def door_class():
    """The class of `door-v0`, inside a function since importing its base takes a second.

    The package's AdroitHandDoor-v1 rewards the distance between palm and handle with +0.1 per m,
    D4RL with -0.1.
    """
    with contextlib.redirect_stderr(io.StringIO()):  # importing the package prints a notice
        from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv
    import mujoco

    class AdroitDoor(AdroitHandDoorEnv):
        def __init__(self, render_mode=None, **kwargs):
            self._visible = render_mode is not None
            super().__init__(reward_type="dense", render_mode=render_mode, **kwargs)

        def _initialize_simulation(self):
            if self._visible:
                return super()._initialize_simulation()
            # Meshes and textures that are only seen take 6.7 of the model's 6.8 MB
            spec = mujoco.MjSpec.from_file(self.fullpath)
            spec.compiler.discardvisual = True
            model = spec.compile()
            return model, mujoco.MjData(model)

        def step(self, action):
            obs, reward, terminated, truncated, info = super().step(action)
            palm_to_handle = math.hypot(*obs[-4:-1])
            return obs, reward - 0.2 * palm_to_handle, terminated, truncated, info

    return AdroitDoor


# --- Less memory


def one_pixel_wide(xml):
    return re.sub(rb'(width|height)="\d+"', rb'\1="1"', xml)


@contextlib.contextmanager
def tiny_textures():
    """Makes the sky and the floor of dm_control's suite one pixel wide, in models made meanwhile.

    They take 12 MB of memory in each environment, and matter to pictures alone.
    """
    from dm_control.suite import common

    assets = dict(common.ASSETS)
    for file in ("./common/skybox.xml", "./common/materials.xml"):
        common.ASSETS[file] = one_pixel_wide(assets[file])
    try:
        yield
    finally:
        common.ASSETS.update(assets)


def quiet_packages():
    """Keeps messages of installed packages off the terminal, but not a user's own warnings."""
    gym.logger.min_level = gym.logger.ERROR
    warnings.filterwarnings("ignore", module="glfw|torch.jit")  # no DISPLAY; deprecations
    with contextlib.suppress(ImportError):
        import mujoco

        mujoco.set_mju_user_warning(lambda message: None)


def prepare_rendering():
    """Lets MuJoCo and pygame render without a display; call it before the environment is made."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in displays):
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # or pygame complains without sound


# --- Stepping by threads

# Environments that share nothing, and whose step is mostly MuJoCo's, so that other threads of
# Python run meanwhile. Measured with 50 environments, us a step with 1 and 2 threads: swimmer maze
# 36 and 21, but point maze 20 and 27. With EnvPool, cheetah 12.2 and 6.5, walker 101 and 66; no
# gain in pendulum, whose physics is too quick.
GAIN_BY_THREADS = {env_id for env_id in NAMES if env_id.startswith(("Ant", "Swimmer"))}
GAIN_BY_THREADS |= {"dm_control/cheetah-run-v0", "dm_control/walker-run-v0", "door-v0"}
GAIN_BY_THREADS |= {"dm_control/hopper-hop-v0", "dm_control/ball_in_cup-catch-v0"}


def make_vector_env(args, n_envs, make_env):
    """n_envs environments of make_env(args) that step together, with SAME_STEP autoreset.

    Where that helps they are stepped by args.threads threads, with the same results.
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


class ThreadedVectorEnv(VectorEnv):
    """Environments split among threads, each of which steps its part as a SyncVectorEnv.

    Results equal those of one SyncVectorEnv bit for bit, if the environments share no state. What
    an environment raises comes through with its traceback.
    """

    def __init__(self, envs, n_threads):
        self.envs, self.num_envs = envs, len(envs)
        n_parts = min(n_threads, len(envs))
        self._ends = [len(envs) * i // n_parts for i in range(n_parts + 1)]
        self._parts = [sync_vector_env(envs[i:j]) for i, j in self._slices()]
        self._pool = ThreadPoolExecutor(n_parts - 1)  # the caller's own thread steps the first part
        self.metadata, self.render_mode = self._parts[0].metadata, envs[0].render_mode
        self.single_observation_space = envs[0].observation_space
        self.single_action_space = envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def _slices(self):
        return zip(self._ends[:-1], self._ends[1:], strict=True)

    def _split(self, values):
        if len(values) != self.num_envs:
            raise ValueError(f"{len(values)} values for {self.num_envs} environments")
        return [values[i:j] for i, j in self._slices()]

    def _each(self, calls):
        futures = [self._pool.submit(call) for call in calls[1:]]
        try:
            first = calls[0]()
        finally:
            wait(futures)  # what comes next, be it an error, finds no environment in mid-step
        return zip(first, *(future.result() for future in futures), strict=True)

    def reset(self, *, seed=None, options=None):
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        calls = [
            functools.partial(part.reset, seed=part_seeds, options=options)
            for part, part_seeds in zip(self._parts, self._split(seed), strict=True)
        ]
        obs, _ = self._each(calls)  # FlatSpaces drops the infos
        return np.concatenate(obs), {}

    def step(self, actions):
        parts = zip(self._parts, self._split(actions), strict=True)
        calls = [functools.partial(part.step, part_actions) for part, part_actions in parts]
        *arrays, parts_infos = self._each(calls)
        infos = {}
        for (i, j), part_infos in zip(self._slices(), parts_infos, strict=True):
            if "final_obs" in part_infos:
                infos.setdefault("final_obs", np.full(self.num_envs, None))
                infos["final_obs"][i:j] = part_infos["final_obs"]
        return *map(np.concatenate, arrays), infos

    def close_extras(self, **kwargs):
        self._pool.shutdown()
        for part in self._parts:
            part.close()


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
    """Whether EnvPool is installed and has this task as the arguments say, without importing it."""
    has_task = args.env_id in ENVPOOL_TASKS and not changes_task(args)
    return has_task and importlib.util.find_spec("envpool") is not None


def changes_task(args):
    return args.max_episode_steps is not None or bool(args.env_kwargs)


class EnvPoolVectorEnv(VectorEnv):
    """The same tasks from EnvPool, in C++: what make_vector_env promises, but for the seeds."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, args, n_envs):
        if args.env_id not in ENVPOOL_TASKS or changes_task(args):
            raise ValueError(
                f"EnvPool does not have {args.env_id} with these flags: use --no-envpool (it has "
                f"{', '.join(ENVPOOL_TASKS)}, without --max-episode-steps and --env-kwargs)"
            )
        import envpool

        gym.logger.min_level = gym.logger.ERROR  # it has notices about its spaces
        env_id = args.env_id
        self._options = {"num_envs": n_envs, "num_threads": 1}
        if env_id in GAIN_BY_THREADS:
            self._options["num_threads"] = min(args.threads, n_envs)
        spec = envpool.make_spec(ENVPOOL_TASKS[env_id])
        self.env_id, self.num_envs, self._pool = env_id, n_envs, None
        obs_dim = spaces.flatdim(spec.gymnasium_observation_space)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        action_space = spec.gymnasium_action_space
        low, high = np.float32(action_space.low), np.float32(action_space.high)
        self.single_action_space = spaces.Box(low, high)
        self.observation_space = batch_space(self.single_observation_space, n_envs)
        self.action_space = batch_space(self.single_action_space, n_envs)
        self._indices, self._action_dtype = np.arange(n_envs, dtype=np.int32), action_space.dtype
        # "obs", or "obs:position" and so on; "reward", "done", "trunc"
        self._state_keys = spec._state_keys
        self._obs_keys = sorted(key for key in self._state_keys if key.split(":")[0] == "obs")

    def reset(self, *, seed=None, options=None):
        """Starts new episodes. Only the first reset heeds the seeds, n_envs integers below 2^32.

        An integer stands for seed, seed + 1 and so on, None for 0, 1 and so on. EnvPool takes its
        seeds when it is made, which takes seconds; the environments' generators run on afterwards.
        """
        if self._pool is None:
            if seed is None or isinstance(seed, int):
                seed = [(seed or 0) + i for i in range(self.num_envs)]
            self._pool = self._make_pool(np.array(seed, np.uint32).view(np.int32))
            self._fresh = np.zeros(self.num_envs, bool)
            self._obs = np.empty((self.num_envs, *self.single_observation_space.shape), np.float32)
        # The others have just been reset by step
        self._begin_episodes(np.flatnonzero(~self._fresh))
        return self._obs.copy(), {}

    def step(self, actions):
        # Actions of another shape would make the C++ read on past the end
        actions = np.reshape(actions, self.action_space.shape)
        actions = np.asarray(actions, self._action_dtype, order="C")
        # The two functions that EnvPool's step() calls; the rest of it takes as long as the physics
        # of four pendulums
        self._pool._send([self._indices, self._indices, actions])
        state = self._receive()
        self._obs, rewards, truncated = state["obs"], state["reward"], state["trunc"]
        terminated = state["done"] & ~truncated
        if self.env_id == "door-v0":  # EnvPool has the sign of the reaching term flipped as well
            rewards = rewards - 0.2 * np.linalg.norm(self._obs[:, -4:-1], axis=1)
        elif self.env_id == "dm_control/ball_in_cup-catch-v0":
            # EnvPool takes the radius of the cup's wall, 0.008, for the ball's, 0.025, and pays for
            # balls half outside. The observation begins with the positions (x, z) of cup and ball,
            # relative to (0, 0.6) and (0, 0.2).
            ball_to_target = self._obs[:, :2] - self._obs[:, 2:4] + (0, 0.6 - 0.05 - 0.2)
            rewards = (np.abs(ball_to_target) < 0.05 - 0.025).all(axis=1).astype(np.float32)
        infos = {}
        self._fresh = terminated | truncated
        if self._fresh.any():
            infos["final_obs"] = self._obs.copy()
            self._begin_episodes(np.flatnonzero(self._fresh))
        return self._obs, rewards, terminated, truncated, infos

    def _make_pool(self, seeds):
        """Makes EnvPool's environments from models without what only pictures show.

        With it each takes 13 MB of memory in dm_control's tasks instead of 1, and 8 in the door.
        seeds: (n_envs,) int32.
        """
        import envpool

        originals = Path(envpool.registration.base_path, "mujoco")
        with tempfile.TemporaryDirectory() as folder:
            for models in ("assets_dmc", "robotics/assets/adroit_hand"):
                for file in filter(Path.is_file, (originals / models).rglob("*")):
                    copy = Path(folder, "mujoco", file.relative_to(originals))
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    if file.name in ("skybox.xml", "materials.xml"):
                        copy.write_bytes(one_pixel_wide(file.read_bytes()))
                    elif file.name == "adroit_assets.xml":
                        lean = b'<compiler discardvisual="true" '
                        copy.write_bytes(file.read_bytes().replace(b"<compiler ", lean))
                    else:
                        copy.symlink_to(file)
            return envpool.make_gymnasium(
                ENVPOOL_TASKS[self.env_id], seed=seeds, base_path=folder, **self._options
            )

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
