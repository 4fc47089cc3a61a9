"""EnvPool's tasks against Gymnasium's and dm_control's, step by step."""

import math
import sys
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from scipy import stats

import ppo_colored_continuous as ppo
from study.environments import ENVPOOL_TASKS, EnvPoolVectorEnv, envpool_suits

pytest.importorskip("envpool")  # has no wheels for some platforms

CAR, CHEETAH = "MountainCarContinuous-v0", "dm_control/cheetah-run-v0"
# The seed of each task's policy, one that earns rewards: a test that compares zeros proves little
POLICY_SEEDS = {
    CAR: 30,
    "dm_control/ball_in_cup-catch-v0": 38,
    "dm_control/cartpole-balance_sparse-v0": 2,
    "dm_control/cartpole-swingup_sparse-v0": 21,
    CHEETAH: 49,
    "dm_control/hopper-hop-v0": 8,
    "dm_control/pendulum-swingup-v0": 11,
    "dm_control/reacher-hard-v0": 43,
    "dm_control/walker-run-v0": 8,
    "door-v0": 1,
}


def make_pool(env_id, n_envs, flags=""):
    return EnvPoolVectorEnv(ppo.parse_args(["--env-id", env_id, *flags.split()]), n_envs)


def make_single(env_id):
    return ppo.make_env(ppo.parse_args(["--env-id", env_id]))


def play_episode(pool, env_id, n_envs):
    """An episode in each environment, by a linear policy that has nothing symmetric, with noise.

    Returns obs, actions, rewards and next obs, (n_steps, n_envs, ...) each.
    """
    dims = pool.single_observation_space.shape[0], pool.single_action_space.shape[0]
    rng = np.random.default_rng(POLICY_SEEDS[env_id])
    weights, bias = rng.normal(size=dims), 0.3 * rng.normal(size=dims[1])
    noise = 0.3 * rng.normal(size=(1000, 1, dims[1]))
    obs, _ = pool.reset(seed=list(range(n_envs)))
    steps, ended = [], np.zeros(n_envs, bool)
    while not ended.any():
        actions = np.clip(obs @ weights + bias + noise[len(steps)], -1, 1).astype(np.float32)
        before = obs.copy()
        obs, rewards, terminated, ended, infos = pool.step(actions)
        next_obs = infos["final_obs"] if ended.any() else obs.copy()
        steps.append((before, actions, rewards, next_obs))
        assert not terminated.any()  # none of these policies reaches the car's goal
    assert ended.all()  # all at the limit
    return [np.stack(x) for x in zip(*steps, strict=True)]


def set_state(env, obs):
    """Puts a Gymnasium environment into the state that this observation shows.

    In the door, at an episode's start.
    """
    env, obs = env.unwrapped, obs.astype(float)
    if env.spec.id == CAR:
        env.state = obs.astype(np.float32)
        return
    if env.spec.id == "door-v0":
        env.model.body_pos[env.door_body_id] += obs[32:35] - env.data.site_xpos[env.handle_site_id]
        mujoco.mj_forward(env.model, env.data)
        return
    physics, domain = env._env.physics, env.spec.id.split("/")[1].split("-")[0]
    with physics.reset_context():
        qpos, qvel = physics.data.qpos, physics.data.qvel
        qvel[:] = obs[-len(qvel) :]
        if domain == "pendulum":
            qpos[0] = math.atan2(obs[1], obs[0])
        elif domain == "cartpole":
            qpos[:] = obs[0], math.atan2(obs[2], obs[1])
        elif domain in ("cheetah", "hopper"):  # the horizontal position changes nothing
            qpos[:] = 0, *obs[: len(qpos) - 1]
        elif domain == "walker":
            # Angles to the vertical of torso; right thigh, leg, foot; left thigh, leg, foot
            angles = np.arctan2(obs[2:15:2], obs[1:15:2])
            joints = angles[[0, 1, 2, 0, 4, 5]] - angles[1:]
            qpos[:] = obs[0] - 1.3, 0, angles[0], *((joints + np.pi) % (2 * np.pi) - np.pi)
        else:
            qpos[:] = obs[: len(qpos)]
    if domain == "reacher":
        finger, model = physics.named.data.geom_xpos["finger", :2].copy(), physics.named.model
        with physics.reset_context():
            qpos[:], qvel[:] = obs[:2], obs[4:]
            model.geom_pos["target", :2] = finger + obs[2:4]


@pytest.mark.parametrize("env_id", ENVPOOL_TASKS)
def test_each_step_is_the_same(env_id):
    """From the same state with the same action: the same next observation and the same reward.

    On 300 transitions of EnvPool's episodes, half of them such that earn a reward, where there are
    as many. The door does not show its whole state: it is compared over the first 25 steps of
    episodes that start in the same state.
    """
    n_envs, pool, env = 4, make_pool(env_id, 4), make_single(env_id)
    assert pool.single_observation_space == env.observation_space
    actions = pool.single_action_space
    assert actions == gym.spaces.Box(env.action_space.low, env.action_space.high)  # float32
    assert pool.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    all_obs, all_actions, all_rewards, all_next_obs = play_episode(pool, env_id, n_envs)
    n_steps = {CAR: 999, "door-v0": 200}.get(env_id, 1000)
    assert len(all_obs) == n_steps and all_obs.dtype == np.float32
    rng = np.random.default_rng(0)
    if env_id == "door-v0":
        sample = [(t, i) for i in range(n_envs) for t in range(25)]
    else:
        rewarded = rng.permutation(np.argwhere(all_rewards))[:150].tolist()
        sample = rewarded + rng.integers((n_steps, n_envs), size=(150, 2)).tolist()
    assert np.ptp([all_rewards[t, i] for t, i in sample]) > 0
    env.reset(seed=0)
    for t, i in sample:
        if env_id != "door-v0":
            set_state(env, all_obs[t, i])
        elif t == 0:
            env.reset(seed=0)
            set_state(env, all_obs[t, i])
        obs, reward, *_ = env.step(all_actions[t, i])
        np.testing.assert_allclose(all_next_obs[t, i], obs, atol=2e-4)
        assert all_rewards[t, i] == pytest.approx(reward, abs=1e-4)


@pytest.mark.parametrize("env_id", ENVPOOL_TASKS)
def test_episodes_start_the_same_way(env_id):
    """Kolmogorov-Smirnov test of each dimension of 50 first observations."""
    starts, _ = make_pool(env_id, 50).reset(seed=list(range(50)))
    env = make_single(env_id)
    theirs = [env.reset(seed=i)[0] for i in range(50)]
    for x, y in zip(np.round(starts, 5).T, np.round(theirs, 5).T, strict=True):
        assert stats.ks_2samp(x, y).pvalue > 1e-4


def test_ends_of_episodes():
    """Goals and time limits at different steps; the last observation is in infos.

    The step that ends an episode returns the next one's first: no dummy transition.
    """
    pool, env = make_pool(CAR, 3), make_single(CAR)
    env.reset()
    obs, _ = pool.reset(seed=[1, 2, 2**32 - 1])
    assert len(np.unique(obs[:, 0])) == 3
    ends = [[], [], []]
    for t in range(1100):
        actions = np.sign(obs[:, 1:] + 1e-6)  # reaches the goal in about 110 steps
        actions[0] = 0  # never does
        before = obs.copy()
        obs, rewards, terminated, truncated, infos = pool.step(actions)
        for i in range(3):
            set_state(env, before[i])
            last = obs[i]
            if terminated[i] or truncated[i]:
                ends[i].append((t + 1, terminated[i], truncated[i]))
                last = infos["final_obs"][i]
                assert -0.6 <= obs[i, 0] <= -0.4 and obs[i, 1] == 0
            expected, reward, goal, _, _ = env.step(actions[i])
            np.testing.assert_allclose(last, expected, atol=1e-6)
            assert rewards[i] == pytest.approx(reward, abs=1e-5) and terminated[i] == goal
    assert ends[0] == [(999, False, True)]
    assert all(len(e) >= 8 and all(goal and not limit for _, goal, limit in e) for e in ends[1:])


def test_a_reset_starts_new_episodes_once():
    """Also in mid-episode; environments that an end has just reset are as good as new."""
    pool = make_pool(CAR, 2)
    first, _ = pool.reset(seed=[1, 2])
    again, _ = pool.reset(seed=[1, 2])
    assert np.array_equal(first, again)
    other, _ = make_pool(CAR, 2).reset(seed=[1, 3])
    assert other[0, 0] == first[0, 0] and other[1, 0] != first[1, 0]
    pool.step(np.ones((2, 1), np.float32))
    new, _ = pool.reset(seed=[1, 2])
    assert (new[:, 1] == 0).all() and (new[:, 0] != first[:, 0]).all()


def test_threads_change_nothing():
    def trajectory(threads):
        pool = make_pool(CHEETAH, 3, f"--threads {threads}")
        rng, steps = np.random.default_rng(0), [pool.reset(seed=[3, 1, 4])[0]]
        for _ in range(1010):  # over the end of the episodes
            obs, rewards, _, truncated, infos = pool.step(rng.uniform(-1, 1, (3, 6)))
            steps += [obs.copy(), rewards, truncated, infos["final_obs"]]
        return b"".join(x.tobytes() for x in steps)

    assert trajectory(1) == trajectory(2)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("env_id", [CHEETAH, "door-v0"])
def test_an_environment_takes_little_memory(env_id):
    """31 of them; they took 380 and 240 MB with what only pictures show."""

    def resident():  # MB
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    pool, before = make_pool(env_id, 31, "--threads 1"), resident()
    pool.reset(seed=list(range(31)))
    assert resident() - before < 100


def test_whether_envpool_has_a_task(monkeypatch):
    """It is the default where it has the task as the flags say."""

    def suits(*flags):
        args = ppo.parse_args(flags)
        assert args.envpool == envpool_suits(args)
        return args.envpool

    assert suits("--env-id", CHEETAH) and not suits("--env-id", "HalfCheetah-v5")
    assert not suits("--max-episode-steps", "100")
    assert not suits("--env-kwargs", '{"goal_velocity": 0.02}')
    with pytest.raises(ValueError, match="use --no-envpool"):
        make_pool(CAR, 1, "--max-episode-steps 10")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)  # as if not installed
    assert not suits("--env-id", CHEETAH)


def test_actions_of_a_wrong_shape_are_refused():
    """EnvPool itself would read on past the end of the array."""
    pool = make_pool(CHEETAH, 2)
    pool.reset(seed=[1, 2])
    for shape in [(1, 6), (2, 5), (2, 7)]:
        with pytest.raises(ValueError, match="reshape"):
            pool.step(np.zeros(shape, np.float32))
