"""Environments that threads step against the same ones without, and other arguments."""

import traceback

import gymnasium as gym
import numpy as np
import pytest

from environments import ThreadedVectorEnv, make_env, make_vector_env, sync_vector_env


def trajectory(envs, n_steps, scale=1.0):
    """Copies of all that reset and step return, over more than one episode of some environments."""
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=[5, 1, 4, 2, 3])
    results = [obs.copy()]
    for _ in range(n_steps):
        actions = scale * rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        *arrays, infos = envs.step(actions)
        final_obs = infos.get("final_obs", [])
        results += [a.copy() for a in arrays] + [f for f in final_obs if f is not None]
        results.append(np.array([f is not None for f in final_obs]))
    return [(a.shape, a.dtype, a.tobytes()) for a in results]


@pytest.mark.parametrize("env_id", ["SwimmerUMaze-v1", "Hopper-v5"])
@pytest.mark.parametrize("threads", [2, 3, 9])
def test_threads_change_nothing(env_id, threads):
    """Hopper falls at another step in each environment; the maze's episodes end together."""
    single = make_vector_env(env_id, 5, max_episode_steps=40)
    threaded = make_vector_env(env_id, 5, threads=threads, max_episode_steps=40)
    assert isinstance(threaded, ThreadedVectorEnv) and not isinstance(single, ThreadedVectorEnv)
    for name in ("observation_space", "single_observation_space", "single_action_space"):
        assert getattr(threaded, name) == getattr(single, name)
    assert threaded.metadata["autoreset_mode"] == single.metadata["autoreset_mode"]
    assert trajectory(single, 100) == trajectory(threaded, 100)
    assert single.reset(seed=7)[0].tobytes() == threaded.reset(seed=7)[0].tobytes()
    assert single.reset()[0].tobytes() == threaded.reset()[0].tobytes()
    threaded.close()


def test_wrong_numbers_of_actions_and_seeds_are_refused():
    envs = make_vector_env("SwimmerUMaze-v1", 4, threads=2)
    for n in (3, 5):
        with pytest.raises(ValueError, match=f"{n} values for 4 environments"):
            envs.reset(seed=list(range(n)))
        with pytest.raises(ValueError, match=f"{n} values for 4 environments"):
            envs.step(np.zeros((n, 2), np.float32))


def test_only_what_gains_is_threaded():
    for env_id in ("Pendulum-v1", "dm_control/pendulum-swingup-v0", "PointUMaze-v1"):
        assert not isinstance(make_vector_env(env_id, 4, threads=2), ThreadedVectorEnv)
    assert not isinstance(make_vector_env("SwimmerUMaze-v1", 1, threads=2), ThreadedVectorEnv)


class Fault(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 1 / float(action[0]), False, False, {}


gym.register("Fault-v0", Fault)


@pytest.mark.parametrize("faulty", [0, 1, 4])
def test_errors_come_through_with_their_traceback(faulty):
    envs = ThreadedVectorEnv([make_env("Fault-v0") for _ in range(5)], 3)
    envs.reset(seed=0)
    actions = np.ones((5, 1), np.float32)
    actions[faulty] = 0
    with pytest.raises(ZeroDivisionError) as caught:
        envs.step(actions)
    assert "1 / float(action[0])" in "".join(traceback.format_exception(caught.value))
    assert envs.step(np.ones((5, 1), np.float32))[1].tolist() == [1] * 5  # usable afterwards


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "PointUMaze-v1"])
def test_max_episode_steps_takes_the_place_of_the_limit(env_id):
    for limit in (3, 1002):
        envs = make_vector_env(env_id, 1, max_episode_steps=limit)
        envs.reset(seed=[1])
        action = np.zeros(envs.action_space.shape, np.float32)
        ends = [bool(envs.step(action)[3][0]) for _ in range(limit)]
        assert ends == [False] * (limit - 1) + [True]


def test_sync_vector_env_keeps_each_environment_once():
    envs = [make_env("Pendulum-v1") for _ in range(3)]
    assert sync_vector_env(envs).envs == envs
