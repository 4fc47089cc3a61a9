"""--normalize-obs and --normalize-rewards against Stable-Baselines3's VecNormalize."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import ppo_colored_continuous as ppo
from study.normalization import NormalizedVectorEnv

BOTH = "--normalize-obs --normalize-rewards"


def make_pair(flags, n_envs):
    """A vector environment by these flags, and the same normalized."""
    args = ppo.parse_args(flags.split())
    plain, envs = (ppo.make_vector_env(args, n_envs) for _ in range(2))
    return plain, NormalizedVectorEnv(envs, args)


@pytest.mark.parametrize("env_id, limit", [("Pendulum-v1", 30), ("Hopper-v5", 40)])
def test_equals_vec_normalize(env_id, limit):
    """Step by step, over ends of episodes by time limit and (Hopper) by falling."""
    theirs = DummyVecEnv([lambda: gym.make(env_id, max_episode_steps=limit)] * 3)
    theirs = VecNormalize(theirs, gamma=0.9)
    theirs.seed(5)
    flags = f"--env-id {env_id} --max-episode-steps {limit} --gamma 0.9 {BOTH}"
    _, ours = make_pair(flags, 3)
    close = {"rtol": 1e-4, "atol": 1e-4}  # ours are float32, which a small std magnifies
    np.testing.assert_allclose(ours.reset(seed=[5, 6, 7])[0], theirs.reset(), **close)
    rng, ends = np.random.default_rng(0), set()
    space = ours.single_action_space
    for _ in range(100):
        actions = rng.uniform(space.low, space.high, (3, *space.shape)).astype(np.float32)
        obs, rewards, terminated, truncated, infos = ours.step(actions)
        their_obs, their_rewards, dones, their_infos = theirs.step(actions)
        np.testing.assert_allclose(obs, their_obs, **close)
        np.testing.assert_allclose(rewards, their_rewards, rtol=1e-5, atol=1e-6)
        original = theirs.get_original_reward()
        np.testing.assert_allclose(infos["raw_rewards"], original, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(terminated | truncated, dones)
        for i in np.flatnonzero(dones):
            final_obs = their_infos[i]["terminal_observation"]
            np.testing.assert_allclose(infos["final_obs"][i], final_obs, **close)
            ends.add("terminated" if terminated[i] else "truncated")
    assert ends == {"truncated"} if env_id == "Pendulum-v1" else "terminated" in ends


def test_clipped_at_10():
    _, envs = make_pair(f"--env-id Pendulum-v1 {BOTH}", 1)
    envs.load_state_dict({name: {"var": 1e-9} for name in ("obs", "returns")})
    assert set(envs.normalized(np.float32([[1, 0.5, -1]]))[0]) == {10, -10}
    envs.reset(seed=[0])
    assert envs.step(np.ones((1, 1), np.float32))[1] == -10


def test_frozen_in_evaluation():
    raw, envs = make_pair(f"--env-id Pendulum-v1 {BOTH}", 2)
    envs.reset(seed=[1, 2])
    for _ in range(20):
        envs.step(np.ones((2, 1), np.float32))
    before, (to_evaluate, _) = envs.state_dict(), make_pair("--env-id Pendulum-v1", 2)
    evaluation = envs.frozen(to_evaluate)
    obs, raw_obs = (env.reset(seed=[3, 4])[0].copy() for env in (evaluation, raw))
    np.testing.assert_array_equal(obs, envs.normalized(raw_obs))
    obs, rewards, *_ = evaluation.step(np.ones((2, 1), np.float32))
    raw_obs, raw_rewards, *_ = raw.step(np.ones((2, 1), np.float32))
    np.testing.assert_array_equal(obs, envs.normalized(raw_obs))
    np.testing.assert_array_equal(rewards, raw_rewards)
    assert envs.state_dict() == before
    envs.step(np.ones((2, 1), np.float32))  # and what training learns, evaluation has
    np.testing.assert_array_equal(evaluation.normalized(raw_obs), envs.normalized(raw_obs))


@pytest.mark.parametrize("flag, kept", [("--normalize-obs", 1), ("--normalize-rewards", 0)])
def test_one_without_the_other(flag, kept):
    """kept: what is not touched, 0 the observations or 1 the rewards."""
    plain, normalized = make_pair(f"--env-id Pendulum-v1 {flag}", 2)
    for envs in (plain, normalized):
        envs.reset(seed=[1, 2])
    actions = np.ones((2, 1), np.float32)
    raw, step = (envs.step(actions) for envs in (plain, normalized))
    np.testing.assert_array_equal(raw[kept], step[kept])
    assert not np.isclose(raw[1 - kept], step[1 - kept]).any()


def test_statistics_are_saved_and_restored(train):
    """A resumed run has the statistics of the checkpoint, not new ones."""
    flags = f"--env-id Pendulum-v1 --n-envs 2 --n-steps 64 --eval-freq 512 --eval-episodes 1 {BOTH}"
    folder = train(f"{flags} --total-timesteps 512")
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)["normalization"]
    assert saved["obs"]["count"] == pytest.approx(512 + 2) and len(saved["obs"]["mean"]) == 3
    assert saved["returns"]["count"] == pytest.approx(512)
    assert torch.load(folder / "best.pt", weights_only=True)["normalization"]["obs"]["count"] > 1
    # As if the run had been stopped before its last 128 of now 640 steps
    (folder / "summary.json").unlink()
    config = json.loads((folder / "config.json").read_text())
    config["args"]["total_timesteps"] = 640
    (folder / "config.json").write_text(json.dumps(config))
    train(f"{flags} --resume --total-timesteps 640")
    longer = torch.load(folder / "checkpoint.pt", weights_only=True)["normalization"]
    assert longer["obs"]["count"] == pytest.approx(640 + 4)  # 2 of each reset
