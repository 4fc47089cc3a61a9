"""What an environment that is not the paper's may need: normalization, rescaling, arguments."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import TINY
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import environments
import ppo_colored_continuous as ppo
import run_files
from environments import NormalizedVectorEnv, make_env, make_vector_env


@pytest.mark.parametrize("env_id, limit", [("Pendulum-v1", 30), ("Hopper-v5", 40)])
def test_normalization_equals_vec_normalize(env_id, limit):
    """Step by step, over ends of episodes by time limit and (Hopper) by falling."""
    theirs = DummyVecEnv([lambda: gym.make(env_id, max_episode_steps=limit)] * 3)
    theirs = VecNormalize(theirs, gamma=0.9)
    theirs.seed(5)
    ours = make_vector_env(env_id, 3, max_episode_steps=limit)
    ours = NormalizedVectorEnv(ours, obs=True, rewards=True, gamma=0.9)
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


class Jump(gym.Env):
    """Observation and reward are the action."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = observation_space

    def reset(self, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return action, float(action[0]), False, False, {}


gym.register("Jump-v0", Jump)


def test_clipped_at_10():
    envs = NormalizedVectorEnv(make_vector_env("Jump-v0", 1), obs=True, rewards=True)
    envs.reset(seed=[0])
    for t in range(300):
        envs.step(np.full((1, 1), (-1) ** t, np.float32))
    for action, bound in [(1e3, 10), (-1e6, -10)]:
        obs, rewards, *_ = envs.step(np.full((1, 1), action, np.float32))
        assert obs[0, 0] == bound and rewards[0] == bound


def test_frozen_in_evaluation():
    envs = NormalizedVectorEnv(make_vector_env("Pendulum-v1", 2), obs=True, rewards=True)
    envs.reset(seed=[1, 2])
    for _ in range(20):
        envs.step(np.ones((2, 1), np.float32))
    before, raw = envs.state_dict(), make_vector_env("Pendulum-v1", 2)
    evaluation = envs.frozen(make_vector_env("Pendulum-v1", 2))
    obs, raw_obs = (env.reset(seed=[3, 4])[0].copy() for env in (evaluation, raw))
    np.testing.assert_array_equal(obs, envs.normalized(raw_obs))
    obs, rewards, *_ = evaluation.step(np.ones((2, 1), np.float32))
    raw_obs, raw_rewards, *_ = raw.step(np.ones((2, 1), np.float32))
    np.testing.assert_array_equal(obs, envs.normalized(raw_obs))
    np.testing.assert_array_equal(rewards, raw_rewards)
    assert envs.state_dict() == before
    envs.step(np.ones((2, 1), np.float32))  # and what training learns, evaluation has
    np.testing.assert_array_equal(evaluation.normalized(raw_obs), envs.normalized(raw_obs))


def test_without_flags_nothing_is_touched():
    plain, wrapped = (make_vector_env("Pendulum-v1", 2) for _ in range(2))
    wrapped = NormalizedVectorEnv(wrapped)
    reset, wrapped_reset = (env.reset(seed=[1, 2])[0] for env in (plain, wrapped))
    np.testing.assert_array_equal(reset, wrapped_reset)
    step, wrapped_step = (env.step(np.ones((2, 1), np.float32)) for env in (plain, wrapped))
    for a, b in zip(step, wrapped_step, strict=True):
        np.testing.assert_array_equal(a, b)
    assert wrapped.state_dict() == {}


def test_statistics_are_saved_and_restored(train, tmp_path):
    """A resumed run has the statistics of the checkpoint, not new ones."""
    flags = f"{TINY} --env-id Pendulum-v1 --normalize-obs --normalize-rewards"
    assert train(flags).returncode == 0
    (folder,) = (path.parent for path in tmp_path.rglob("checkpoint.pt"))
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)["normalization"]
    assert saved["obs"]["count"] == pytest.approx(4096 + 2) and len(saved["obs"]["mean"]) == 3
    assert saved["returns"]["count"] == pytest.approx(4096)
    assert torch.load(folder / "best.pt", weights_only=True)["normalization"]["obs"]["count"] > 1
    assert train(f"{flags.replace('4096', '4608')} --resume").returncode == 0
    longer = torch.load(folder / "checkpoint.pt", weights_only=True)["normalization"]
    assert longer["obs"]["count"] == pytest.approx(4608 + 4)  # 2 of each reset
    assert "--normalize-obs" in train(f"{TINY} --env-id Pendulum-v1").stderr


class Scaled(gym.Env):
    """Ten steps of guessing the observed number, given as scale * x, on actions low to high."""

    def __init__(self, scale=1.0, low=-1.0, high=1.0, name="", values=()):
        self.scale, self.low, self.high, self.name, self.values = scale, low, high, name, values
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = gym.spaces.Box(np.float32(low), np.float32(high), (1,))

    def _obs(self):
        self.x = self.np_random.uniform(-1, 1)
        return np.array([self.scale * self.x], np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._obs(), {}

    def step(self, action):
        target = self.low + (0.3 * self.x + 0.7) * (self.high - self.low)
        reward = -abs(float(action[0]) - target) / (self.high - self.low)
        self.t, self.last_action = self.t + 1, action
        return self._obs(), min(reward, 0) * 1.0, False, self.t == 10, {}


gym.register("Scaled-v0", Scaled)


def final_return(tmp_path, flags):
    """Of a short training on Scaled-v0: at best 0, and about -3 or less for what learns nothing."""
    base = f"--env-id Scaled-v0 --runs-dir {tmp_path} --overwrite --threads 1 --no-compile "
    base += "--n-steps 128 --batch-size 64 --learning-rate 3e-3 "
    base += "--total-timesteps 10000 --eval-freq 10000 "
    ppo.main(ppo.parse_args((base + flags).split()))
    (file,) = tmp_path.rglob("summary.json")
    return json.loads(file.read_text())["final_return"]


@pytest.mark.parametrize(
    "flags, remedy",
    [("low=0 high=1000", "--rescale-actions"), ("scale=1e4", "--normalize-obs")]
    + [("scale=1e-4", "--normalize-obs")],
)
def test_what_the_flags_are_for(tmp_path, flags, remedy):
    without = final_return(tmp_path, f"--env-kwargs {flags}")
    remedied = final_return(tmp_path, f"--env-kwargs {flags} {remedy}")
    assert remedied > -0.5 > 2 * without


def test_rescaled_actions():
    env = make_env("Scaled-v0", rescale_actions=True, env_kwargs={"low": 0, "high": 1000})
    assert env.action_space == gym.spaces.Box(-1, 1, (1,), np.float32)
    env.reset(seed=0)
    for action, meant in [(-1, 0), (0, 500), (0.4, 700), (1, 1000)]:
        env.step(np.array([action], np.float32))
        assert env.unwrapped.last_action == pytest.approx(meant)
    with pytest.raises(gym.error.Error, match="--rescale-actions needs bounds"):
        make_env("Scaled-v0", rescale_actions=True, env_kwargs={"high": float("inf")})


def test_an_action_without_a_choice_cannot_be_rescaled():
    """It would be NaN."""
    with pytest.raises(gym.error.Error, match="--rescale-actions needs bounds"):
        make_env("Scaled-v0", rescale_actions=True, env_kwargs={"low": 1, "high": 1})


@pytest.mark.parametrize("env_id", environments.ENVPOOL_TASKS)
def test_envpool_has_nothing_to_rescale(env_id):
    space = make_vector_env(env_id, 1, envpool=True, rescale_actions=True).single_action_space
    assert (space.low == -1).all() and (space.high == 1).all()


@pytest.mark.parametrize(
    "low, high, noticed",
    [(0, 1000, True), (-1, 1, False), (-2, 2, False), (-0.4, 0.4, False), (-30, 30, True)]
    + [(-0.01, 0.01, True), (1, 3, True), (-np.inf, np.inf, False), (0, np.inf, False)],
)
def test_notice_on_bounds(capsys, low, high, noticed):
    space = gym.spaces.Box(np.float32(low), np.float32(high), (2,))
    environments.note_on_bounds("Scaled-v0", space)
    assert ("--rescale-actions" in capsys.readouterr().err) == noticed
    half = gym.spaces.Box(np.float32([0, 0]), np.float32([1000, np.inf]))
    environments.note_on_bounds("Scaled-v0", half)  # what would be refused is not advised
    assert "--rescale" not in capsys.readouterr().err
    environments.note_on_bounds("AntUMaze-v1", space)  # the paper's are as the paper had them
    assert capsys.readouterr().err == ""


def test_arguments_of_the_environment(train, tmp_path, capsys):
    parse = run_files.key_value
    texts = ["a=1", "a=-2.5", "a=true", "a=False", "a=3,0", "a=pick-place-v3", 'a="1"', "a="]
    texts += ["a=x=y"]
    values = [parse(text)[1] for text in texts]
    assert values == [1, -2.5, True, False, [3, 0], "pick-place-v3", "1", "", "x=y"]
    flags = f"--runs-dir {tmp_path} --env-kwargs low=0 high=2 --env-kwargs".split()
    args = ppo.parse_args([*flags, "name=a b"])  # not in runs/, where the user's own may be
    assert args.env_kwargs == {"low": 0, "high": 2, "name": "a b"} and not args.envpool
    env = make_env("PointPushMaze-v1", env_kwargs=dict([parse("goal=3,-2")]))
    assert tuple(env.unwrapped.goal) == (3, -2)

    flags = f"{TINY} --env-id Pendulum-v1 --env-kwargs g=1.5"
    assert train(flags).returncode == 0
    process = train(f"{flags.replace('1.5', '2')} --resume")
    assert process.returncode == 2 and "--env-kwargs {'g': 1.5}, not {'g': 2}" in process.stderr
    for wrong, words in [("g", "g is not key=value"), ("f=1", "unexpected keyword argument 'f'")]:
        process = train(f"{TINY} --env-id Pendulum-v1 --seed 2 --env-kwargs {wrong}")
        assert process.returncode == 2 and process.stderr.count("\n") == 1
        assert words in process.stderr
    process = train("--env-kwargs goal_velocity=0.02 --envpool")
    assert process.returncode == 2 and "need --no-envpool" in process.stderr
