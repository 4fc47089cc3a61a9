"""Vector environments by id, with flat float32 observations.

They are Gymnasium's own, dm_control's through shimmy, EnvPool's, the mazes, the Adroit door and any
that a module registers. Importing this file is quick and silent: the package behind an environment
is imported when one is made.
"""

import contextlib
import difflib
import functools
import importlib.util
import io
import logging
import math
import os
import random
import re
import sys
import sysconfig
import tempfile
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.utils import RunningMeanStd


def silence():
    """Keeps the warnings and log lines of installed packages off the terminal, and those of ours.

    Those of a user's environment are shown. For a program, not for a library.
    """
    global silent
    silent = True
    gym.logger.min_level = gym.logger.ERROR + 1
    logging.getLogger("absl").setLevel(logging.ERROR)
    show, paths = warnings.showwarning, sysconfig.get_paths()
    ours = [str(Path(__file__).with_name(f"{name}.py")) for name in OURS]
    hidden = *ours, *(paths[kind] + os.sep for kind in ("stdlib", "purelib", "platlib"))

    def show_others(message, category, filename, *args, **kwargs):
        if not filename.startswith(("<", *hidden)):
            show(message, category, filename, *args, **kwargs)

    warnings.showwarning = show_others  # filters would not do: some packages set their own


silent = False
OURS = ["ppo_colored_continuous", "baselines", "play", "plot", "run_files", "environments", "mazes"]


def silence_mujoco():
    """Keeps MuJoCo's warnings off the terminal and out of the file MUJOCO_LOG.TXT.

    Not part of `silence`: MuJoCo chooses its renderer when it is imported, see make_render_env.
    """
    with contextlib.suppress(ImportError):
        import mujoco

        mujoco.set_mju_user_warning(lambda message: None)


def seed_global_generators(seeds):
    """Seeds `random` and `numpy.random`, which some environments draw from. seeds: two integers."""
    random.seed(seeds[0])
    np.random.seed(seeds[1])  # noqa: NPY002


@contextlib.contextmanager
def preserved_generators():
    """What is drawn within from the global generators is not missing from them afterwards."""
    torch = sys.modules.get("torch")
    states = random.getstate(), np.random.get_state()  # noqa: NPY002
    torch_state = torch and torch.get_rng_state()
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        if torch:
            torch.set_rng_state(torch_state)


# --- The mazes and the Adroit door
MAZE_IDS = ["PointUMaze-v1", "Point4Rooms-v1", "AntUMaze-v1", "Ant4Rooms-v1"]
MAZE_IDS += ["SwimmerUMaze-v1", "Swimmer4Rooms-v1"]
MAZE_IDS += ["PointPush-v1", "AntPush-v1", "PointPushMaze-v1", "AntPushMaze-v1"]
for env_id in MAZE_IDS:  # without Gymnasium's checks of the first step: the tests know more
    robot, maze = re.fullmatch("(Point|Ant|Swimmer)(.*)-v1", env_id).groups()
    kwargs = {"robot": robot.lower(), "maze": maze}
    options = {"max_episode_steps": 1000, "reward_threshold": 0.9, "disable_env_checker": True}
    gym.register(env_id, "mazes:MazeEnv", kwargs=kwargs, **options)
gym.register("door-v0", "environments:make_door", max_episode_steps=200, disable_env_checker=True)


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
            self._kwargs = {"render_mode": render_mode, **kwargs}
            super().__init__(reward_type="dense", **self._kwargs)

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

        # The package copies and pickles constructor arguments only; the episode would start anew
        def __reduce__(self):
            return functools.partial(make_door, **self._kwargs), (), self.__getstate__()

        def __getstate__(self):
            return {k: v for k, v in self.__dict__.items() if k != "mujoco_renderer"}

        def __setstate__(self, state):
            self.__dict__.update(state)
            self.mujoco_renderer.model, self.mujoco_renderer.data = self.model, self.data

    return AdroitDoor


class FlatSpaces(gym.Wrapper):
    """Makes observations (a Dict in its order of keys) and actions one vector; drops the infos."""

    def __init__(self, env):
        super().__init__(env)
        obs_dim, actions = spaces.flatdim(env.observation_space), env.action_space
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        low, high = actions.low.reshape(-1), actions.high.reshape(-1)
        self.action_space = spaces.Box(low, high, dtype=actions.dtype)

    def reset(self, **kwargs):
        obs, _ = self.env.reset(**kwargs)
        return self._flatten(obs), {}

    def step(self, action):
        action = action.reshape(self.env.action_space.shape)
        obs, reward, terminated, truncated, _ = self.env.step(action)
        return self._flatten(obs), reward, terminated, truncated, {}

    def _flatten(self, obs):
        return spaces.flatten(self.env.observation_space, obs).astype(np.float32)


def make_env(env_id, max_episode_steps=None, rescale_actions=False, env_kwargs=None, **kwargs):
    """Makes one environment with observations (obs_dim,) float32 and a Box action space.

    env_id is a registered id or "module:Id", whose module, in the current folder or installed,
    registers the Id. max_episode_steps takes the place of the task's own time limit (but not of
    those inside dm_control's locomotion and manipulation). With rescale_actions, actions in [-1, 1]
    stand for those between its bounds. env_kwargs: arguments of the environment, a dict.

    This is the place for a wrapper of every environment. EnvPool's are not made here: --no-envpool.

    Raises gymnasium.error.Error with a message for the user: unknown id (naming close matches), a
    package that is missing, actions that are not continuous, observations without a fixed size.
    What a user's module or environment raises comes through with its traceback, a gymnasium.error
    as the cause of a RuntimeError.
    """
    module, _, name = env_id.rpartition(":")
    if silent:
        silence_mujoco()
    if module:
        import_module_of(env_id, module)
    try:
        if name.startswith("dm_control/"):
            import shimmy  # noqa: F401  registers the dm_control ids
        if name and name not in gym.registry and not re.search(r"-v\d+$", name):
            raise gym.error.UnregisteredEnv  # Gymnasium would guess the version, EnvPool would not
        kwargs |= {"disable_env_checker": True, **(env_kwargs or {})}
        if max_episode_steps is not None and is_from_dm_control_suite(name):
            no_limit = {"time_limit": math.inf}  # s, its limit inside Gymnasium's
            kwargs["task_kwargs"] = no_limit | kwargs.get("task_kwargs", {})
        with contextlib.nullcontext() if "render_mode" in kwargs else tiny_textures():
            env = gym.make(name, max_episode_steps, **kwargs)
    except gym.error.Error as error:
        if module and name in gym.registry:  # then it is the environment's own error
            raise RuntimeError(f"{env_id} cannot be made") from error
        if isinstance(error, gym.error.UnregisteredEnv):
            raise gym.error.UnregisteredEnv(unknown_id_message(env_id, name)) from None
        raise
    except ImportError as error:
        if module:
            raise
        raise gym.error.DependencyNotInstalled(
            f"{env_id} needs a package that is not installed: {error}"
        ) from error
    except Exception as error:
        told = re.search("unexpected keyword argument|multiple values for", str(error))
        if not env_kwargs or (module and not told):
            raise
        raise gym.error.Error(f"{env_id} cannot be made with --env-kwargs: {error}") from error
    actions, observations = env.action_space, env.observation_space
    if not isinstance(actions, spaces.Box) or not np.issubdtype(actions.dtype, np.floating):
        raise gym.error.Error(
            f"{env_id} has actions {actions}; colored noise needs continuous ones (Box, floating)"
        )
    if not observations.is_np_flattenable:
        raise gym.error.Error(
            f"{env_id} has observations {observations}; the networks need a fixed number of values"
        )
    if rescale_actions:
        if not can_be_rescaled(actions):
            raise gym.error.Error(f"--rescale-actions needs bounds, {env_id} has {actions}")
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    return FlatSpaces(env)


def can_be_rescaled(actions):
    return actions.is_bounded() and (actions.low < actions.high).all()


def import_module_of(env_id, module):
    """Imports the module that registers an environment, from the current folder or installed."""
    if not all(map(str.isidentifier, module.split("."))) or module.endswith(".py"):
        raise gym.error.Error(
            f"{env_id}: {module} is not the name of a module (that of my_env.py is my_env)"
        )
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # behind all else: a file there must not hide a package
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # what the module itself imports
        raise gym.error.DependencyNotInstalled(
            f"{env_id}: there is no {module}.py in the current folder and no package {module}"
        ) from None


def unknown_id_message(env_id, name):
    with contextlib.suppress(ImportError):
        import shimmy  # noqa: F401  dm_control's ids may be meant
    matches = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.4)
    message = f"unknown environment {env_id}"
    if matches:
        module = env_id.removesuffix(name)  # with its colon, or nothing
        message += f"; did you mean {' or '.join(module + match for match in matches)}?"
    if name == env_id:
        message += f" (one that your my_env.py or a package registers: my_env:{name})"
    return message


def ids_named(word, ids):
    """Those of the ids that the word names, in full or short as cheetah-run."""
    pattern = rf"(dm_control/)?{re.escape(word)}(-v\d+)?"
    return [env_id for env_id in ids if re.fullmatch(pattern, env_id)]


def is_from_dm_control_suite(name):
    entry_point = getattr(gym.registry.get(name), "entry_point", None)
    return "domain_name" in getattr(entry_point, "keywords", {})


def one_pixel_wide(xml):
    return re.sub(rb'(width|height)="\d+"', rb'\1="1"', xml)


@contextlib.contextmanager
def tiny_textures():
    """Makes the sky and the floor of dm_control's suite one pixel wide, in models made meanwhile.

    They take 12 MB of memory in each environment, and matter to pictures alone.
    """
    common = sys.modules.get("dm_control.suite.common")
    assets = dict(common.ASSETS) if common else {}
    for file in assets.keys() & {"./common/skybox.xml", "./common/materials.xml"}:
        common.ASSETS[file] = one_pixel_wide(assets[file])
    try:
        yield
    finally:
        if common:
            common.ASSETS.update(assets)


def env_options(args):
    """What a run's arguments say on how each environment is made: keyword arguments of make_env."""
    names = ("max_episode_steps", "rescale_actions", "env_kwargs")
    return {name: getattr(args, name) for name in names}


def make_envs(args):
    """Makes a run's environments.

    Returns envs to train in, envs to evaluate in, an environment to film or None, and the
    normalization, of which the state_dict belongs to the policy. Raises as make_env does.
    """
    options = env_options(args)
    video_env = make_render_env(args.env_id, **options) if args.capture_video else None
    options |= {"envpool": args.envpool, "threads": args.threads}
    envs = make_vector_env(args.env_id, args.n_envs, **options)
    eval_envs = make_vector_env(args.env_id, args.eval_episodes, **options)
    note_on_bounds(args.env_id, envs.single_action_space)
    made = [env for env in (envs, eval_envs, video_env) if env is not None]
    envs = NormalizedVectorEnv(envs, args.normalize_obs, args.normalize_rewards, args.gamma)
    weakref.finalize(envs, close, made)  # when a run has ended, in whatever way
    if args.normalize_obs:
        eval_envs = envs.frozen(eval_envs)
        video_env = video_env and envs.frozen_single(video_env)
    return envs, eval_envs, video_env, envs


def close(envs):
    for env in envs:
        env.close()


def note_on_bounds(env_id, space):
    """Prints a line where PPO's first actions, about 0 with a std of 1, miss most of the space."""
    with np.errstate(invalid="ignore"):
        center, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    far = np.isfinite(half) & ((half > 4) | (half < 0.25) | (abs(center) > half / 2))
    if far.any() and env_id not in NAMES:  # the paper's are as the paper had them
        low, high = (x[np.argmax(far)] for x in (space.low, space.high))
        advice = ": --rescale-actions makes it [-1, 1]" if can_be_rescaled(space) else ""
        print(f"note: {env_id} has actions from {low:g} to {high:g}, and the policy begins with a "
              f"std of 1 around 0{advice}", file=sys.stderr)  # fmt: skip


class NormalizedVectorEnv(VectorWrapper):
    """Normalizes observations and rewards by running statistics, as VecNormalize does.

    That is Stable-Baselines3's. Observations are brought to mean 0 and std 1 of all so far. Rewards
    are divided by the std of the discounted return so far; their mean stays, it is part of the
    task; they are in infos["raw_rewards"] as they were. Both are clipped at 10.
    """

    def __init__(self, env, obs=False, rewards=False, gamma=0.99):
        super().__init__(env)
        self._gamma, self._returns, self._training = gamma, np.zeros(self.num_envs), True
        self._statistics = {}
        if obs:
            self._statistics["obs"] = RunningMeanStd(shape=env.single_observation_space.shape)
        if rewards:
            self._statistics["returns"] = RunningMeanStd()

    def frozen(self, env):
        """Another environment with observations normalized as here, which changes no statistics."""
        other = NormalizedVectorEnv(env)
        other._statistics, other._training = {"obs": self._statistics["obs"]}, False
        return other

    def frozen_single(self, env):
        """The same, for one environment that is no vector."""

        def normalized(obs):  # the wrapper makes a deep copy, of a method with all that is its own
            return self.normalized(obs)

        return gym.wrappers.TransformObservation(env, normalized, env.observation_space)

    def normalized(self, obs):
        statistics = self._statistics["obs"]
        obs = (obs - statistics.mean) / np.sqrt(statistics.var + 1e-8)
        return np.clip(obs, -10, 10).astype(np.float32)

    def reset(self, **kwargs):
        obs, infos = self.env.reset(**kwargs)
        self._returns[:] = 0
        return self._observed(obs), infos

    def step(self, actions):
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        done = terminated | truncated
        if "returns" in self._statistics:
            infos["raw_rewards"] = rewards
            self._returns = self._returns * self._gamma + rewards
            self._statistics["returns"].update(self._returns)
            std = np.sqrt(self._statistics["returns"].var + 1e-8)
            rewards = np.clip(rewards / std, -10, 10)
            self._returns[done] = 0
        if "obs" in self._statistics:
            obs = self._observed(obs)
            for i in np.flatnonzero(done):
                infos["final_obs"][i] = self.normalized(infos["final_obs"][i])
        return obs, rewards, terminated, truncated, infos

    def _observed(self, obs):
        if "obs" not in self._statistics:
            return obs
        if self._training:
            self._statistics["obs"].update(obs)
        return self.normalized(obs)

    def state_dict(self):
        """The statistics, as plain numbers and lists."""
        return {
            name: {key: np.asarray(value).tolist() for key, value in vars(statistics).items()}
            for name, statistics in self._statistics.items()
        }

    def load_state_dict(self, state):
        for name, values in state.items():
            for key, value in values.items():
                setattr(self._statistics[name], key, np.asarray(value))


def make_vector_env(env_id, n_envs, envpool=False, threads=1, **options):
    """Makes n_envs environments that step together, with SAME_STEP autoreset.

    Observations are (n_envs, obs_dim) float32 and overwritten by the next step. The step that ends
    an episode returns the next episode's first observation, and the ended one's last observation
    in infos["final_obs"]. Gymnasium's default, NEXT_STEP, inserts a dummy transition between
    episodes instead.

    With envpool they are EnvPool's. Up to `threads` threads step them where that helps, with the
    same results. options: as make_env has them. EnvPool's take none; their actions are scaled.
    Raises as make_env does.
    """
    if envpool:
        if changes_task(**options):
            raise gym.error.Error(
                f"EnvPool's {env_id} is as it is: --max-episode-steps and --env-kwargs need "
                "--no-envpool"
            )
        return EnvPoolVectorEnv(env_id, n_envs, threads)
    envs = [make_env(env_id, **options) for _ in range(n_envs)]
    if min(threads, n_envs) > 1 and gains_by_threads(envs[0].unwrapped):
        return ThreadedVectorEnv(envs, threads)
    return sync_vector_env(envs)


def gains_by_threads(env):
    """Whether most of a step is MuJoCo's: only there may Python's other threads run meanwhile.

    That is so where a step has several of the simulator's. Measured with 50 environments, us a step
    with 1 and 2 threads: swimmer maze 36 and 21, half cheetah 33 and 22, but point maze, whose step
    is one, 20 and 27. dm_control, whose model is not env.model, is mostly Python.
    """
    mujoco = sys.modules.get("mujoco")
    if mujoco is None or not isinstance(getattr(env, "model", None), mujoco.MjModel):
        return False
    return getattr(env, "frame_skip", getattr(env, "substeps", 1)) > 1


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


def changes_task(max_episode_steps=None, env_kwargs=None, **others):
    """Whether options of make_env make another task of it than EnvPool has."""
    return max_episode_steps is not None or bool(env_kwargs)


def envpool_suits(args):
    """Whether EnvPool is installed and has a run's task as its arguments say."""
    return envpool_has(args.env_id) and not changes_task(**env_options(args))


def envpool_has(env_id):
    """Whether EnvPool has this task and is installed, without importing it."""
    return env_id in ENVPOOL_TASKS and importlib.util.find_spec("envpool") is not None


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
# Two threads took the cheetah from 12.2 to 6.5 us a step, the walker from 101 to 66, and did not
# help the pendulum, whose physics is too quick. Those that take no less than the cheetah:
GAIN_BY_THREADS = {"dm_control/cheetah-run-v0", "dm_control/walker-run-v0", "door-v0"}
GAIN_BY_THREADS |= {"dm_control/hopper-hop-v0", "dm_control/ball_in_cup-catch-v0"}

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
    """The same tasks from EnvPool, in C++: what make_vector_env promises, but for the seeds.

    Raises gymnasium.error.Error, with a message for the user, for other tasks and where EnvPool is
    not installed.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env_id, n_envs, threads=1):
        if env_id not in ENVPOOL_TASKS:
            raise gym.error.Error(
                f"--envpool does not have {env_id}, only {', '.join(ENVPOOL_TASKS)}"
            )
        try:
            import envpool
        except ImportError as error:
            raise gym.error.DependencyNotInstalled(
                f"--envpool needs EnvPool (pip install envpool): {error}"
            ) from error
        self._options = {"num_envs": n_envs, "num_threads": 1}
        if env_id in GAIN_BY_THREADS:
            self._options["num_threads"] = min(threads, n_envs)
        spec = envpool.make_spec(ENVPOOL_TASKS[env_id])
        self.env_id, self.num_envs, self._pool = env_id, n_envs, None
        obs_dim = spaces.flatdim(spec.gymnasium_observation_space)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        action_space = spec.gymnasium_action_space
        self.single_action_space = spaces.Box(action_space.low, action_space.high, dtype=np.float32)
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


def is_headless():
    """Whether there is no display to show a window on."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform == "linux" and not any(os.environ.get(name) for name in displays)


def make_render_env(env_id, **options):
    """Makes one environment that renders frames without a display; options as make_env has them.

    Raises gymnasium.error.Error where it cannot, and otherwise as make_env does.
    """
    if is_headless():
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")  # or pygame complains without sound
    try:
        env = make_env(env_id, render_mode="rgb_array", **options)
    except TypeError as error:
        if "unexpected keyword argument 'render_mode'" not in str(error):
            raise
        raise gym.error.Error(
            f"cannot render {env_id}: it has to take the argument render_mode='rgb_array'"
        ) from error
    env.reset()
    try:
        frame = env.render()
    except Exception as error:  # each renderer fails in its own way
        if ":" in env_id:
            raise RuntimeError(f"cannot render {env_id}") from error
        raise gym.error.Error(
            f"cannot render {env_id} ({error}): install libegl1 and libgl1 and set MUJOCO_GL=egl, "
            "or MUJOCO_GL=osmesa"
        ) from error
    if not isinstance(frame, np.ndarray) or frame.ndim != 3:
        raise gym.error.Error(
            f"cannot render {env_id}: render() has to return a picture, an array (height, width, "
            f"3), not {f'shape {frame.shape}' if isinstance(frame, np.ndarray) else type(frame)}"
        )
    return env


def frames_per_second(env):
    """Of the simulated time, where the environment says how long a step is: `dt`, in s."""
    dt = getattr(env.unwrapped, "dt", None)
    return 1 / dt if dt else env.metadata.get("render_fps") or 30


def video_file(path, env):
    """Opens a new video at the speed of env's task; append_data(frame) adds to it."""
    import imageio

    return imageio.get_writer(path, fps=frames_per_second(env), macro_block_size=2)


def play(env, policy, seed, video=None):
    """Plays an episode of policy(obs (1, obs_dim)) -> actions (1, action_dim), and films it.

    Yields the reward of each step.
    """
    obs, _ = env.reset(seed=seed)
    done = False
    while not done:
        if video:
            video.append_data(env.render())
        action = np.clip(policy(obs[None])[0], env.action_space.low, env.action_space.high)
        obs, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        yield reward


@preserved_generators()
def record_video(env, policy, path, seed):
    """Plays an episode of the policy, as `play` has it, and saves a video of it."""
    path.parent.mkdir(exist_ok=True)
    with video_file(path, env) as video:
        for _ in play(env, policy, seed, video):
            pass
