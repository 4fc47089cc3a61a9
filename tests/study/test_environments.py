"""The door, threads, small models; and environments of others, as the agent sees them."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ppo_colored_continuous as ppo
from study.environments import ThreadedVectorEnv

ROOT = Path(ppo.__file__).parent


def parse(flags):
    return ppo.parse_args(flags.split())


def make_envs(flags, n_envs):
    return ppo.make_vector_env(parse(f"{flags} --no-envpool"), n_envs)


# --- Environments of others, as the agent sees them


class Plain(gym.Env):
    """Its spaces and observations are set by the test. Asserts that actions are in its space."""

    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    observation = np.zeros(1, np.float32)

    def reset(self, seed=None, options=None):
        return self.observation, {}

    def step(self, action):
        assert self.action_space.contains(action), (action, self.action_space)
        self.last_action = action
        return self.observation, 0.0, False, False, {}


gym.register("Plain-v0", Plain, max_episode_steps=3)
BYTES, FLOATS = gym.spaces.Box(0, 255, (2, 2), np.uint8), gym.spaces.Box(-500, 500, (2,), float)
NESTED = gym.spaces.Tuple([BYTES, gym.spaces.Dict(b=gym.spaces.Discrete(3), a=FLOATS)])


def test_observations_are_one_float32_vector(monkeypatch):
    """Also those at a time limit, which the critic sees."""
    pixels, floats = np.array([[1, 2], [3, 255]], np.uint8), np.array([0.1, -300.7])
    monkeypatch.setattr(Plain, "observation_space", NESTED)
    monkeypatch.setattr(Plain, "observation", (pixels, {"b": 1, "a": floats}))
    envs = make_envs("--env-id Plain-v0", 1)
    seen = [envs.reset(seed=[0])[0][0].copy()]
    for _ in range(3):
        obs, *_, infos = envs.step(np.zeros((1, 1), np.float32))
        seen.append(obs[0].copy())
    for obs in [*seen, infos["final_obs"][0]]:
        assert obs.dtype == np.float32
        np.testing.assert_array_equal(obs, np.float32([1, 2, 3, 255, 0, 1, 0, *floats]))


def test_rescaled_actions_never_leave_the_bounds(monkeypatch):
    rng = np.random.default_rng(0)
    low, high = np.sort(rng.normal(size=(2, 2000)) * 10 ** rng.uniform(-2, 2, 2000), axis=0)
    space = gym.spaces.Box(np.float32(low), np.float32(high))
    monkeypatch.setattr(Plain, "action_space", space)
    env = ppo.make_env(parse("--env-id Plain-v0 --rescale-actions --no-envpool"))
    assert env.action_space == gym.spaces.Box(-1, 1, (2000,))
    for value in (-1, 0, 0.4, 1):
        env.reset(seed=0)
        env.step(np.full(2000, value, np.float32))
        expected = space.low + (value + 1) / 2 * (space.high - space.low)
        np.testing.assert_allclose(env.unwrapped.last_action, expected, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(Plain, "action_space", gym.spaces.Box(-np.inf, np.inf, (1,)))
    with pytest.raises(ValueError, match="--rescale-actions needs bounds"):
        ppo.make_env(parse("--env-id Plain-v0 --rescale-actions"))


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "PointUMaze-v1", "dm_control/reacher-hard-v0"])
def test_max_episode_steps_takes_the_place_of_the_limit(env_id):
    for limit in (3, 1002):
        envs = make_envs(f"--env-id {env_id} --max-episode-steps {limit}", 1)
        envs.reset(seed=[1])
        action = np.zeros(envs.action_space.shape, np.float32)
        ends = [bool(envs.step(action)[3][0]) for _ in range(limit)]
        assert ends == [False] * (limit - 1) + [True]


# --- Threads


def trajectory(envs, n_steps):
    """Copies of all that reset and step return, over more than one episode of some environments."""
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=[5, 1, 4, 2, 3])
    results = [obs.copy()]
    for _ in range(n_steps):
        actions = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        *arrays, infos = envs.step(actions)
        final_obs = infos.get("final_obs", [None] * 5)
        results += [a.copy() for a in arrays] + [f for f in final_obs if f is not None]
        results.append(np.array([f is not None for f in final_obs]))
    return [(a.shape, a.dtype, a.tobytes()) for a in results]


@pytest.mark.parametrize("env_id, threads", [("SwimmerUMaze-v1", 9), ("Hopper-v5", 3)])
def test_threads_change_nothing(env_id, threads, monkeypatch):
    """Hopper falls at another step in each environment; the maze's episodes end together."""
    monkeypatch.setattr("study.environments.GAIN_BY_THREADS", {"SwimmerUMaze-v1", "Hopper-v5"})
    flags = f"--env-id {env_id} --max-episode-steps 40 --threads"
    single, threaded = make_envs(f"{flags} 1", 5), make_envs(f"{flags} {threads}", 5)
    assert isinstance(threaded, ThreadedVectorEnv) and not isinstance(single, ThreadedVectorEnv)
    assert trajectory(single, 100) == trajectory(threaded, 100)
    threaded.close()


def test_threads_step_only_what_is_known_to_share_nothing():
    """An environment of a user may share a file, a simulator or a variable."""
    for env_id in ("Hopper-v5", "Plain-v0"):
        assert not isinstance(make_envs(f"--env-id {env_id} --threads 2", 4), ThreadedVectorEnv)


# --- Models without what is only seen


@pytest.mark.parametrize("task", ["cheetah-run", "ball_in_cup-catch"])
def test_models_without_textures_move_the_same(task):
    """Bit for bit, beside dm_control's own, whose textures are whole again afterwards."""
    flags = f"--env-id dm_control/{task}-v0"
    small, whole = make_envs(flags, 1).envs[0], ppo.make_env(parse(flags))
    assert small.unwrapped._env.physics.model.tex_data.nbytes < 1000
    assert whole.unwrapped._env.physics.model.tex_data.nbytes > 10_000_000
    rng = np.random.default_rng(0)
    assert small.reset(seed=3)[0].tobytes() == whole.reset(seed=3)[0].tobytes()
    for _ in range(200):
        action = rng.uniform(-1, 1, small.action_space.shape).astype(np.float32)
        (obs, reward, *_), (other_obs, other_reward, *_) = small.step(action), whole.step(action)
        assert obs.tobytes() == other_obs.tobytes() and reward == other_reward


# --- The door


def d4rl_reward(env):
    """D4RL's formula, from the simulator's state."""
    palm, handle = env.data.site("S_grasp").xpos, env.data.site("S_handle").xpos
    hinge = env.data.joint("door_hinge").qpos[0]
    reward = -0.1 * np.linalg.norm(palm - handle) - 0.1 * (hinge - 1.57) ** 2
    reward -= 1e-5 * np.sum(env.data.qvel**2)
    return reward + 2 * (hinge > 0.2) + 8 * (hinge > 1.0) + 10 * (hinge > 1.35)


@pytest.fixture(scope="module")
def door():
    return gym.make("door-v0").unwrapped


@pytest.mark.parametrize("hinge, bonus", [(0, 0), (0.3, 2), (1.1, 10), (1.5, 20)])
def test_reward_is_d4rls(door, hinge, bonus):
    """With the door in this position, in random steps."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        door.reset(seed=seed)
        state = door.get_env_state()
        state["qpos"] += 0.02 * rng.standard_normal(30)
        state["qpos"][28:] = hinge, 1.5  # the latch is turned
        door.set_env_state(state)
        for _ in range(5):
            obs, reward, terminated, truncated, info = door.step(rng.uniform(-1, 1, 28))
            assert reward == pytest.approx(d4rl_reward(door), rel=1e-12)
            assert bonus - 2 < reward < bonus  # the costs are small beside the bonus
            assert not terminated and not truncated and info["success"] == (bonus == 20)
            palm, handle = door.data.site("S_grasp").xpos, door.data.site("S_handle").xpos
            np.testing.assert_array_equal(obs[-4:-1], palm - handle)


@pytest.mark.filterwarnings("ignore")  # it recommends bounds
def test_gymnasium_checks_and_the_limit(door):
    check_env(door, skip_render_check=True)
    assert gym.spec("door-v0").max_episode_steps == 200 and door.observation_space.shape == (39,)
    assert door.action_space == gym.spaces.Box(-1, 1, (28,), np.float32)


# --- Imports and messages


def python(code, folder):
    """What this code writes, in a Python of its own."""
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); {code}"
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def test_importing_is_quick(tmp_path):
    slow = ["mujoco", "gymnasium_robotics", "dm_control", "shimmy", "torch", "envpool", "pandas"]
    code = f"import study.environments; print([x for x in {slow} if x in sys.modules])"
    assert python(code, tmp_path) == (0, "[]\n", "")


# HalfCheetah is first: importing dm_control puts a function of its own in place of ours
SILENT = """
import argparse, gymnasium as gym, numpy as np
from study.environments import make_vector_env
for env_id in ("HalfCheetah-v5", "door-v0", "dm_control/cheetah-run-v0"):
    if env_id.startswith("dm_control"):
        import shimmy
    args = argparse.Namespace(env_id=env_id, threads=1)
    envs = make_vector_env(args, 1, lambda args: gym.make(args.env_id, disable_env_checker=True))
    envs.reset(seed=[0])
    if env_id == "HalfCheetah-v5":
        envs.envs[0].unwrapped.data.qvel[:] = 1e20  # MuJoCo warns that it is unstable
    envs.step(np.zeros(envs.action_space.shape, np.float32))
"""


def test_no_message_of_a_package_reaches_the_terminal(tmp_path):
    assert python(SILENT, tmp_path) == (0, "", "")
    assert not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT
