"""The Adroit door against D4RL's reward, written out here, from the simulator's state."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import environments  # noqa: F401  registers the id

ROOT = Path(__file__).parent.parent


def d4rl_reward(env):
    palm, handle = env.data.site("S_grasp").xpos, env.data.site("S_handle").xpos
    hinge = env.data.joint("door_hinge").qpos[0]
    reward = (
        -0.1 * np.linalg.norm(palm - handle)
        - 0.1 * (hinge - 1.57) ** 2
        - 1e-5 * np.sum(env.data.qvel**2)
    )
    return (
        reward + (2 if hinge > 0.2 else 0) + (8 if hinge > 1.0 else 0) + (10 if hinge > 1.35 else 0)
    )


@pytest.fixture(scope="module")
def door():
    return gym.make("door-v0").unwrapped


def test_reward_is_d4rls_at_random_states(door):
    rng = np.random.default_rng(0)
    for seed in range(3):
        door.reset(seed=seed)
        for _ in range(40):
            obs, reward, terminated, truncated, _ = door.step(rng.uniform(-1, 1, 28))
            assert (
                reward == pytest.approx(d4rl_reward(door), rel=1e-12)
                and not terminated
                and not truncated
            )
            palm, handle = door.data.site("S_grasp").xpos, door.data.site("S_handle").xpos
            np.testing.assert_array_equal(obs[-4:-1], palm - handle)


@pytest.mark.parametrize("hinge, bonus", [(0.1, 0), (0.3, 2), (1.1, 10), (1.5, 20)])
def test_reward_is_d4rls_at_open_doors(door, hinge, bonus):
    rng = np.random.default_rng(0)
    for seed in range(3):
        door.reset(seed=seed)
        state = door.get_env_state()
        state["qpos"] += 0.02 * rng.standard_normal(30)
        state["qpos"][28:] = hinge, 1.5  # the latch is turned
        door.set_env_state(state)
        reward, info = door.step(rng.uniform(-1, 1, 28))[1::3]
        assert reward == pytest.approx(d4rl_reward(door), rel=1e-12)
        assert bonus - 2 < reward < bonus  # the costs are small beside the bonus
        assert info["success"] == (bonus == 20)


def test_the_packages_reward_differs(door):
    import gymnasium_robotics  # noqa: F401  registers the package's id

    package = gym.make("AdroitHandDoor-v1").unwrapped
    for env in (door, package):
        env.reset(seed=5)
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 28)):
        (obs, reward, *_), (package_obs, package_reward, *_) = (
            door.step(action),
            package.step(action),
        )
        np.testing.assert_array_equal(obs, package_obs)
        distance = np.linalg.norm(obs[-4:-1])
        assert distance > 0.1 and package_reward - reward == pytest.approx(0.2 * distance, rel=1e-9)


def test_episodes_last_200_steps_and_depend_on_the_seed_only():
    def episode(seed):
        env = gym.make("door-v0")
        obs, _ = env.reset(seed=seed)
        trajectory, ends = [obs], []
        for action in np.random.default_rng(0).uniform(-1, 1, (200, 28)):
            obs, reward, terminated, truncated, _ = env.step(action)
            trajectory.append([*obs[:-1], reward])
            ends.append(truncated)
            assert not terminated
        assert ends == [False] * 199 + [True]
        return np.array(trajectory)

    assert episode(1).tobytes() == episode(1).tobytes()
    assert abs(episode(1) - episode(2)).max() > 0.01


@pytest.mark.filterwarnings("ignore")  # it recommends bounds
def test_gymnasium_checks(door):
    check_env(door, skip_render_check=True)
    assert door.observation_space.shape == (39,) and door.action_space == gym.spaces.Box(
        -1, 1, (28,), np.float32
    )
    envs = gym.make_vec("door-v0", num_envs=2, vectorization_mode="sync")
    assert envs.reset(seed=0)[0].shape == (2, 39)


def python(code):
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)


def test_importing_is_quick_and_making_a_door_silent():
    slow = ["mujoco", "gymnasium_robotics", "dm_control", "shimmy", "torch", "envpool"]
    done = python(
        f"import sys, environments; print([name for name in {slow} if name in sys.modules])"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "[]\n", "")
    done = python("import environments, gymnasium; gymnasium.make('door-v0').reset()")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
