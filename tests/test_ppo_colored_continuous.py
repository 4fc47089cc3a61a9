"""The script: against Stable-Baselines3, as a user runs it, and as a student edits it."""

import errno
import fcntl
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import types

import filelock
import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

import colored_noise
import ppo_colored_continuous as ppo
from colored_noise import ColoredNoiseProcess, projected_beta
from study.sb3 import ColoredGaussian, EndAtTimeLimit

N_STEPS, N_ENVS = 64, 3

# --- Same weights and data as Stable-Baselines3, same numbers out


class Drift(gym.Env):
    """A point pushed by two actions; an episode ends far away, or at a time limit of 20 steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(np.array([-1, -0.5], np.float32), np.array([1, 0.5], np.float32))

    def reset(self, seed=None, options=None):
        self.x, self.t = np.zeros(2, np.float32), 0
        return self._obs(), {}

    def step(self, action):
        assert self.action_space.contains(action)  # actions arrive clipped
        self.x, self.t = self.x + action, self.t + 1
        reward = float(self.x.sum() + 0.1 * self.t)
        return self._obs(), reward, bool(abs(self.x).max() > 3), False, {}

    def _obs(self):
        return np.array([*self.x, 0.1 * self.t], np.float32)


gym.register("Drift-v0", Drift, max_episode_steps=20)


def parse(flags="--compile"):
    return ppo.parse_args(flags.split())


def as_agent(policy):
    """SB3's policy as an Agent: the same layers and parameters."""
    agent, nets = ppo.Agent(3, 2), policy.mlp_extractor
    agent.actor_mean = nn.Sequential(*nets.policy_net, policy.action_net)
    agent.critic = nn.Sequential(*nets.value_net, policy.value_net)
    agent.log_std = policy.log_std
    return agent


def drift_envs(wrapper=gym.Wrapper):
    return DummyVecEnv([lambda: wrapper(gym.make("Drift-v0"))] * N_ENVS)


def make_pair(flags="", **sb3_settings):
    """Our agent and SB3's PPO with the same random weights, not the initial ones; our arguments."""
    args = parse(flags)
    settings = dict(learning_rate=args.learning_rate, n_steps=N_STEPS, n_epochs=1)
    settings |= dict(batch_size=N_STEPS * N_ENVS, seed=1)
    sb3 = PPO("MlpPolicy", drift_envs(), **{**settings, **sb3_settings})
    torch.manual_seed(0)
    agent = ppo.Agent(3, 2)
    for p in agent.parameters():
        p.data += 0.1 * torch.randn_like(p)
    as_agent(sb3.policy).load_state_dict(agent.state_dict())
    return agent, sb3, args


def random_minibatch(agent, n=N_STEPS * N_ENVS):
    torch.manual_seed(2)
    obs, actions = torch.randn(n, 3), torch.randn(n, 2)
    with torch.no_grad():  # the noise: so that a good part of the ratios is clipped
        logprobs = agent(obs, actions)[0] + 0.3 * torch.randn(n)
    return obs, actions, logprobs, 2 * torch.randn(n) + 1, 3 * torch.randn(n), torch.randn(n)


def parameters(agent):
    return nn.utils.parameters_to_vector(agent.parameters()).detach()


def test_initial_weights_have_the_same_law():
    """Orthogonal with the gains of SB3, zero biases, log std 0."""
    sb3 = PPO("MlpPolicy", gym.make("Drift-v0"), seed=1)
    theirs = as_agent(sb3.policy).state_dict()
    for name, ours in ppo.Agent(3, 2).state_dict().items():
        if name.endswith("weight"):
            pair = torch.linalg.svdvals(ours), torch.linalg.svdvals(theirs[name])
            torch.testing.assert_close(*pair)
        assert ours.shape == theirs[name].shape
        assert name.endswith("weight") or torch.equal(ours, theirs[name])


@pytest.mark.parametrize(
    "flags, settings",
    [
        ("--max-grad-norm 1e9", dict(max_grad_norm=1e9)),
        ("", {}),
        ("--no-normalize-advantage --ent-coef 0.03 --vf-coef 0.7 --clip-range 0.1",
         dict(normalize_advantage=False, ent_coef=0.03, vf_coef=0.7, clip_range=0.1)),
    ],
)  # fmt: skip
def test_loss_and_gradient(fill_buffer, flags, settings):
    agent, sb3, args = make_pair(flags, **settings)
    minibatch = random_minibatch(agent)
    loss, _ = ppo.ppo_loss(agent, minibatch, args)
    metrics = ppo.loss_backward(ppo.ppo_loss, agent, minibatch, args)
    fill_buffer(sb3, minibatch)
    sb3.train()
    logged = sb3.logger.name_to_value
    assert loss.item() == pytest.approx(logged["train/loss"], rel=1e-4)
    ours = {name: value.item() for name, value in metrics.items()}
    assert ours["policy_loss"] == pytest.approx(logged["train/policy_gradient_loss"], abs=1e-5)
    assert ours["value_loss"] == pytest.approx(logged["train/value_loss"], rel=1e-5)
    assert -ours["entropy"] == pytest.approx(logged["train/entropy_loss"], rel=1e-5)
    assert ours["approx_kl"] == pytest.approx(logged["train/approx_kl"], rel=1e-4)
    assert ours["clip_fraction"] == pytest.approx(logged["train/clip_fraction"])
    assert 0.2 < ours["clip_fraction"] < 0.8
    theirs = [p.grad for p in as_agent(sb3.policy).parameters()]
    torch.testing.assert_close([p.grad for p in agent.parameters()], theirs, rtol=1e-3, atol=1e-6)


def test_gradients_are_added_as_backward_adds_them():
    agent, _, args = make_pair()
    minibatch = random_minibatch(agent)
    ppo.loss_backward(ppo.ppo_loss, agent, minibatch, args)
    once = [p.grad.clone() for p in agent.parameters()]
    ppo.loss_backward(ppo.ppo_loss, agent, minibatch, args)
    torch.testing.assert_close([p.grad for p in agent.parameters()], [2 * grad for grad in once])


@pytest.mark.parametrize("compile", [False, True])
def test_parameters_after_steps_of_adam(fill_buffer, compile, capsys):
    """At falling rates, eager and compiled; eager, the last of a smaller minibatch."""
    agent, sb3, args = make_pair()
    optimizer = ppo.make_optimizer(agent, args)
    backward = ppo.functools.partial(ppo.loss_backward, ppo.ppo_loss)
    backward = ppo.compiled(backward) if compile else backward
    minibatch, before = random_minibatch(agent), parameters(agent)
    args.n_epochs, args.batch_size = 1, N_STEPS * N_ENVS
    for rate, n in [(1e-3, 192), (8e-4, 192), (5e-4, 192), (2e-4, 192 if compile else 96)]:
        part = tuple(x[:n] for x in minibatch)
        fill_buffer(sb3, part)
        sb3.rollout_buffer.buffer_size, sb3.rollout_buffer.n_envs = n, 1
        sb3.lr_schedule = lambda _, rate=rate: rate
        sb3.train()
        optimizer.param_groups[0]["lr"] = rate
        ppo.learn(agent, optimizer, part, backward, args)
    after = parameters(as_agent(sb3.policy))
    assert (after - before).abs().max() > 2e-3
    torch.testing.assert_close(parameters(agent), after, rtol=1e-4, atol=2e-5)
    assert "no torch.compile" not in capsys.readouterr().err  # it did compile


@pytest.mark.parametrize("gamma, gae_lambda", [(0.99, 0.95), (1.0, 0.0), (0.9, 1.0)])
def test_gae_against_the_rollout_buffer(gamma, gae_lambda):
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, N_STEPS, N_ENVS)).astype(np.float32)
    dones = rng.random((N_STEPS, N_ENVS)) < 0.1
    last_values = rng.normal(size=N_ENVS).astype(np.float32)
    space = gym.spaces.Box(-1, 1, (1,))
    buffer = RolloutBuffer(N_STEPS, space, space, "cpu", gae_lambda, gamma, N_ENVS)
    buffer.rewards, buffer.values = rewards.copy(), values.copy()
    buffer.episode_starts = np.concatenate([np.ones((1, N_ENVS)), dones[:-1]])
    buffer.compute_returns_and_advantage(torch.tensor(last_values), dones[-1])
    advantages, returns = ppo.compute_gae(rewards, values, dones, last_values, gamma, gae_lambda)
    np.testing.assert_allclose(advantages, buffer.advantages, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(returns, buffer.returns, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("alone", [False, True])
def test_whole_rollout_against_sb3(monkeypatch, train, alone):
    """The script's batches, with colored noise, clipped actions, ends, time limits, are SB3's.

    Three rollouts with the policy unchanged, so that noise and episodes run on across rollouts.
    Once without the folder study/, and without a bootstrap at time limits.
    """
    if alone:
        monkeypatch.setattr(ppo, "study", None)
    total, agents, batches = 3 * N_STEPS * N_ENVS, [], []
    flags = f"--env-id Drift-v0 --n-steps {N_STEPS} --n-envs {N_ENVS} --total-timesteps {total} "
    flags += f"--eval-freq {total} --eval-episodes 1 --no-compile --noise-seq-len 50 "
    flags += "--no-bootstrap-timeouts" * alone

    def make_agent(*dims):
        agents.append(ppo.Agent(*dims))
        agents[0].critic[-1].bias.data += 5  # a value worth bootstrapping
        return agents[0]

    def learn(agent, optimizer, batch, *_):
        batches.append([x.clone() for x in batch])
        return {}

    train(flags, make_agent=make_agent, learn=learn)
    envs = drift_envs(EndAtTimeLimit if alone else gym.Wrapper)
    sb3 = PPO("MlpPolicy", envs, n_steps=N_STEPS, seed=1)
    as_agent(sb3.policy).load_state_dict(agents[0].state_dict())
    noise = ColoredNoiseProcess(0.5, N_ENVS, 2, 50, ppo.make_seeds(2, 1, 0)[1])
    sb3.policy.action_dist = ColoredGaussian(noise, 2)
    _, callback = sb3._setup_learn(10**6)
    for batch in batches:
        sb3.collect_rollouts(sb3.env, callback, sb3.rollout_buffer, N_STEPS)
        buffer = sb3.rollout_buffer
        assert buffer.episode_starts.sum() > N_ENVS
        theirs = (buffer.observations, buffer.actions, buffer.log_probs, buffer.advantages)
        for ours, their in zip(batch, (*theirs, buffer.returns, buffer.values), strict=True):
            their = their.reshape(ours.shape)
            np.testing.assert_allclose(ours.numpy(), their, rtol=1e-3, atol=1e-4)
    assert len(batches) == 3


# --- Environments and evaluation


class Count(gym.Env):
    """Observation and reward are the time t. Terminates after `seed` steps."""

    observation_space = gym.spaces.Box(0, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        self.t, self.length = 0, seed
        return np.array([0.0]), {}

    def step(self, action):
        self.t += 1
        return np.array([float(self.t)]), float(self.t), self.t == self.length, False, {}


gym.register("Count-v0", Count)


def test_evaluation_counts_whole_episodes_once():
    """However long they are."""
    envs = ppo.make_vector_env(parse("--env-id Count-v0"), 3)
    returns, lengths = ppo.evaluate(lambda obs: np.zeros((3, 1), np.float32), envs, [3, 20_000, 1])
    assert returns.tolist() == [6, 20_000 * 20_001 / 2, 1] and lengths.tolist() == [3, 20_000, 1]


class Draws(gym.Env):
    """Draws from all generators that an environment may use, also when it is made."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self):
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.made = np.random.normal() + random.random()  # noqa: NPY002

    def reset(self, seed=None, options=None):
        drawn = np.random.normal() + random.random() + torch.randn(()).item()  # noqa: NPY002
        return np.float32([drawn + self.made + self.action_space.sample()[0]]), {}

    def step(self, action):
        obs, _ = self.reset()
        return obs, obs[0].item(), False, False, {}


gym.register("Draws-v0", Draws, max_episode_steps=10)


def test_same_seed_same_evaluations_whatever_an_environment_draws_from(train, tiny):
    def evaluations(flags):
        random.seed(time.time())
        np.random.seed(time.time_ns() % 2**32)  # noqa: NPY002
        flags += " --total-timesteps 1536 --env-id Draws-v0 --overwrite"
        folder = train(f"{tiny} {flags}")
        return (folder / "evaluations.csv").read_text()

    first = evaluations("--seed 5")
    assert first == evaluations("--seed 5") != evaluations("--seed 6")
    white = evaluations("--vanilla --beta 0")
    assert white == evaluations("--vanilla --beta 2")


# --- The script as a user runs it


def assert_complete_tiny_run(folder, read_evaluations, read_events, restarts=0):
    steps = [row["step"] for row in read_evaluations(folder)]
    assert steps == list(range(512, 4097, 512))
    events = read_events(folder)
    assert [step for step, _ in events["evaluation/return_mean"]] == steps
    lost = set(steps) - {step for step, _ in events["losses/policy_loss"]}
    assert len(lost) <= restarts  # the last update before a restart is hidden
    assert json.loads((folder / "summary.json").read_text())["steps"] == 4096


def test_mountain_car_is_solved(train):
    """With larger learning rate and minibatches than the paper's, in 65,536 steps."""
    flags = "--learning-rate 3e-3 --batch-size 512 --total-timesteps 65536 --eval-freq 65536 "
    folder = train(f"{flags} --eval-episodes 5")
    assert json.loads((folder / "summary.json").read_text())["final_return"] > 85


def test_files_of_a_run(train, tiny, tmp_path, read_evaluations, read_events, capsys):
    """A finished run is not run again, but with --overwrite."""
    flags = f"{tiny} --beta 0.25 --seed 3 --exp-name test"
    folder = train(flags)
    assert folder == tmp_path / "runs/test/Pendulum-v1/beta_0.25/n_envs_2/seed_3"
    assert_complete_tiny_run(folder, read_evaluations, read_events)
    config = json.loads((folder / "config.json").read_text())
    assert config["args"]["beta"] == [0.25] and config["versions"]["torch"].startswith("2.13.0")
    rows, summary = read_evaluations(folder), json.loads((folder / "summary.json").read_text())
    assert summary["performance"] == pytest.approx(np.mean([row["return_mean"] for row in rows]))
    assert summary["final_return"] == rows[-1]["return_mean"] and summary["wall_seconds"] > 0
    assert all(row["length_mean"] == 200 for row in rows)
    best = torch.load(folder / "best.pt", weights_only=True)
    returns = {row["step"]: row["return_mean"] for row in rows}
    assert best["return_mean"] == pytest.approx(max(returns.values()))
    assert returns[best["step"]] == pytest.approx(best["return_mean"])
    assert str(folder) in capsys.readouterr().out

    before = {file: file.stat().st_mtime_ns for file in folder.iterdir() if file.name != "lock"}
    train(f"{flags} --resume")
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert capsys.readouterr().out.startswith("nothing was run")
    train(f"{flags} --overwrite --gamma 0.9")
    assert read_evaluations(folder) != rows
    assert_complete_tiny_run(folder, read_evaluations, read_events)


@pytest.mark.parametrize("flag", ["", "--eval-once-per-policy"])
def test_evaluations_fall_on_their_steps(train, read_evaluations, read_events, flag):
    """More steps per update than between evaluations, and a total that is no multiple of either."""
    flags = "--total-timesteps 5000 --n-envs 3 --n-steps 500 --eval-freq 600 --eval-episodes 2 "
    flags += f"--n-epochs 1 --no-compile --env-id Pendulum-v1 --batch-size 1000 {flag}"
    folder = train(flags)
    rows = read_evaluations(folder)
    assert [row["step"] for row in rows] == list(range(600, 5000, 600))
    returns = [row["return_mean"] for row in rows]
    assert len(set(returns)) == (4 if flag else 8)  # policies act until 1500, 3000, 4500, 6000
    losses = read_events(folder)["losses/value_loss"]
    assert [step for step, _ in losses] == [1500, 3000, 4500, 6000]


def test_dm_control_and_one_beta_per_action_dimension(train, read_evaluations):
    flags = "--total-timesteps 512 --n-steps 256 --n-envs 1 --eval-freq 512 --eval-episodes 1 "
    flags += "--n-epochs 1 --no-compile --no-envpool --beta 0.5 1 0 0.2 -1 2"
    folder = train(f"--env-id dm_control/cheetah-run-v0 {flags}")
    assert [row["length_mean"] for row in read_evaluations(folder)] == [1000]
    assert folder.parts[-3] == "beta_0.5_1_0_0.2_-1_2"


def test_beta_auto():
    args = parse("--beta auto --n-envs 2 --n-steps 256")
    assert args.beta == [projected_beta(2, 256, 1000)]
    assert ppo.run_path(args).parts[-3] == "beta_auto"


def test_kill_at_any_moment_and_resume(train, tiny, tmp_path, read_evaluations, read_events):
    """In the end everything is there once, and the noise went on where it was."""
    flags = f"{tiny} --resume"
    args = parse(f"{flags} --runs-dir {tmp_path}/runs")
    folder, reached = ppo.run_path(args), 0
    table, checkpoint = folder / "evaluations.csv", folder / "checkpoint.pt"

    def rows():
        return table.read_text().count("\n") - 1 if table.exists() else 0

    server = multiprocessing.get_context("forkserver")  # imports the script once for both
    server.set_forkserver_preload([ppo.__name__])
    for kill_at in (2, 5):
        process = server.Process(target=ppo.main, args=(args,))
        process.start()
        while process.is_alive() and rows() < kill_at:
            time.sleep(0.01)
        process.kill()
        process.join()
        step = torch.load(checkpoint, weights_only=True)["global_step"]
        assert step > reached and process.exitcode == -signal.SIGKILL
        reached = step
        time.sleep(1)  # TensorBoard sorts its files by the second in which they were made
    assert train(flags) == folder
    assert_complete_tiny_run(folder, read_evaluations, read_events, restarts=2)
    final = torch.load(checkpoint, weights_only=True)
    # steps of Adam: 8 updates of 512 / 128 minibatches; noise: 8 x 256 steps of sequences of 1000
    assert final["optimizer"]["state"][0]["step"].item() == 8 * 4
    assert final["noise"]["index"] == 8 * 256 - 2 * 1000


def interrupted(train, flags, n):
    """Runs until the update n + 1 and stops in it, with a checkpoint of each update."""
    calls = []

    def learn(agent, *rest):
        if len(calls) == n:
            raise KeyboardInterrupt
        calls.append(agent)
        return ppo.learn(agent, *rest)

    with pytest.MonkeyPatch.context() as patch:
        ticks = iter(range(10**6, 10**9, 10))  # ten seconds later at each look
        patch.setattr(ppo, "time", types.SimpleNamespace(time=ticks.__next__))
        with pytest.raises(KeyboardInterrupt):
            train(flags, learn=learn)
    return calls[-1]


def test_resume_goes_on_from_the_checkpoint(train, tiny, tmp_path, read_evaluations, read_events):
    """Earlier evaluations stay, bit for bit, and the policy is the one that was saved."""
    agent = interrupted(train, tiny, 5)
    folder = next((tmp_path / "runs").rglob("config.json")).parent
    before, first = (folder / "evaluations.csv").read_text(), []
    assert before.count("\n") == 6

    def learn(agent, *rest):
        first.append(parameters(agent))
        return ppo.learn(agent, *rest)

    with pytest.raises(FileExistsError, match="unfinished: use --resume or --overwrite"):
        train(tiny)
    with pytest.raises(FileExistsError, match="gamma 0.99, not 0.9: choose another --exp-name"):
        train(f"{tiny} --gamma 0.9 --resume")
    train(f"{tiny} --resume", learn=learn)
    assert torch.equal(first[0], parameters(agent)) and len(first) == 3
    assert (folder / "evaluations.csv").read_text().startswith(before)
    assert_complete_tiny_run(folder, read_evaluations, read_events, restarts=1)


def test_a_second_process_is_kept_out_and_the_lock_goes_with_the_run(train, tiny, tmp_path):
    path = ppo.run_path(parse(f"{tiny} --runs-dir {tmp_path}/runs"))
    path.mkdir(parents=True)
    with filelock.FileLock(path / "lock"), pytest.raises(SystemExit) as ended:
        train(tiny)
    assert ended.value.code == 3
    interrupted(train, tiny, 1)  # in a notebook, say
    assert train(f"{tiny} --resume") == path


def test_without_flock_there_is_no_lock_by_existence(train, tiny, tmp_path, monkeypatch):
    """Such a lock would stay behind a killed process for ever."""

    def no_flock(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", no_flock)
    with pytest.raises(OSError, match="cannot lock .* choose a --runs-dir"):
        train(tiny)


@pytest.mark.parametrize(
    "flags, words",
    [
        ("--n-envs 0", "must be positive"),
        ("--beta 0.5 auto", "auto is one value"),
        ("--resume --overwrite", "not allowed with"),
        ("--n-envs 64 --total-timesteps 100000", "no update before the last evaluation"),
        ("--env-kwargs goal=3", "env-kwargs"),
    ],
)
def test_a_wrong_flag_is_told_by_argparse(flags, words, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(flags)
    assert ended.value.code == 2 and words in capsys.readouterr().err


@pytest.mark.parametrize(
    "obs, reward, what", [(np.nan, 0.0, "observations"), (0.0, np.inf, "rewards")]
)
def test_what_is_not_finite_is_named(train, tiny, monkeypatch, obs, reward, what):
    result = np.full(3, obs, np.float32), reward, False, False, {}
    monkeypatch.setattr(Drift, "step", lambda self, action: result)
    with pytest.raises(FloatingPointError, match=f"Drift-v0: {what} not finite"):
        train(f"{tiny} --env-id Drift-v0")


def test_a_diverged_run_says_so(train, tiny):
    with pytest.raises(FloatingPointError, match="diverged: lower --learning-rate"):
        train(f"{tiny} --learning-rate 1e30")


def test_discrete_actions_are_refused(train, tiny):
    with pytest.raises(TypeError, match="CartPole-v1 has actions Discrete"):
        train(f"{tiny} --env-id CartPole-v1")


MODULE = """import gymnasium as gym
gym.register("MyEnv-v0", "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=7)
"""


def test_two_files_alone(tmp_path, read_evaluations):
    """In an empty folder: Gymnasium's, dm_control's and one's own tasks; and --resume."""
    for module in (ppo, colored_noise):
        shutil.copy(module.__file__, tmp_path)
    (tmp_path / "my_env.py").write_text(MODULE)
    code = """
import ppo_colored_continuous as ppo
assert ppo.study is None
tiny = "--total-timesteps 512 --n-envs 2 --n-steps 128 --eval-freq 256 --eval-episodes 1 "
tiny += "--no-compile --env-id "
for env_id in ("Pendulum-v1", "dm_control/pendulum-swingup-v0", "my_env:MyEnv-v0"):
    args = ppo.parse_args((tiny + env_id).split())
    ppo.main(args)
folder = ppo.run_path(args)
(folder / "summary.json").unlink()
args.resume = True
ppo.main(args)
assert (folder / "summary.json").exists()
for flag in ("--normalize-obs", "--envpool"):
    try:
        ppo.parse_args([flag])
    except SystemExit as error:
        assert error.code == 2
    else:
        raise AssertionError(flag)
ppo.main(ppo.parse_args(["--env-id", "PointUMaze-v1"]))
"""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    how = {"cwd": tmp_path, "env": env, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", code], **how)
    assert done.returncode == 1 and "PointUMaze" in done.stderr.splitlines()[-1], done.stderr
    tables = list(tmp_path.rglob("evaluations.csv"))
    assert len(tables) == 3 and all(len(read_evaluations(table.parent)) == 2 for table in tables)


# --- Edits that students make, each in a copy of the script: they take effect, or fail loudly

LOOP = "            act = exploration(agent, noise, args)\n"


@pytest.mark.parametrize("flags", ["--no-compile", "--compile"])
def test_a_learning_rate_and_a_clip_range_set_in_the_loop(run_edited, flags):
    rate = '            optimizer.param_groups[0]["lr"] = 1e-2 * (1 - global_step / total)\n'
    agent, scalars, _ = run_edited((LOOP, LOOP + rate), flags=flags)
    constant, *_ = run_edited(flags=flags)
    annealed, *_ = run_edited(flags=f"{flags} --anneal-lr")
    assert torch.equal(parameters(agent), parameters(annealed))
    assert (parameters(agent) - parameters(constant)).abs().max() > 1e-3
    np.testing.assert_allclose(scalars["losses/learning_rate"], [1e-2, 7.5e-3, 5e-3, 2.5e-3])
    clip = "            args.clip_range = 0.0 if global_step else 0.2\n"
    clipped, scalars, _ = run_edited((LOOP, LOOP + clip), flags=flags)
    assert scalars["losses/clip_fraction"][0] < 0.5 < min(scalars["losses/clip_fraction"][1:])


HIDDEN = """            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
"""


@pytest.mark.parametrize(
    "edits",
    [
        [("nn.Tanh()", "nn.ReLU()")],
        [(HIDDEN, f"{HIDDEN}            nn.LayerNorm(64),\n{HIDDEN}")],
    ],
    ids=["ReLU", "third hidden layer and LayerNorm"],
)
def test_layers(run_edited, edits):
    """What is evaluated and acts is the module that learns."""
    agent, scalars, module = run_edited(*edits)
    original, others, _ = run_edited()

    def mean_action(obs):
        return agent.actor_mean(torch.tensor(obs)).detach().numpy()

    envs = module.make_vector_env(parse("--env-id Pendulum-v1"), 2)
    returns, _ = module.evaluate(mean_action, envs, ppo.make_seeds(2, 1, 2, 2048))
    assert returns.mean() == pytest.approx(scalars["evaluation/return_mean"][-1], rel=1e-3)
    assert returns.mean() != pytest.approx(others["evaluation/return_mean"][-1], rel=1e-3)


LOG_STD = "self.log_std = nn.Parameter(torch.zeros(action_dim))"


def test_frozen_and_shared_parameters(run_edited):
    """Compiled as well as eager."""
    edit = LOG_STD[:-1] + ", requires_grad=False)\n        self.critic[0] = self.actor_mean[0]"
    agent, scalars, _ = run_edited((LOG_STD, edit), flags="--compile")
    eager, *_ = run_edited((LOG_STD, edit))
    assert scalars["losses/std"] == [1.0] * 4 and agent.log_std.item() == 0
    assert agent.critic[0] is agent.actor_mean[0]
    torch.testing.assert_close(parameters(agent), parameters(eager), rtol=1e-3, atol=1e-3)


def test_a_parameter_frozen_in_the_loop(run_edited):
    freeze = "            agent.log_std.requires_grad_(global_step < 1024)\n"
    _, scalars, _ = run_edited((LOOP, freeze + LOOP))
    first, *others = scalars["losses/std"]
    assert first != others[0] and others == [others[0]] * 3


def test_another_optimizer(run_edited):
    agent, *_ = run_edited()
    edit = "Adam(agent.parameters()", "AdamW(agent.parameters(), weight_decay=10.0"
    decayed, *_ = run_edited(edit)
    assert parameters(decayed).norm() < 0.6 * parameters(agent).norm()


def test_another_noise_and_an_agent_changed_in_the_loop(run_edited):
    """Each takes effect in the next rollout; with noise that is 1, actions are mean + std."""
    change = "            agent.actor_mean[-1].bias.data += 1.7\n"
    change += "            agent.log_std.data -= 1\n"
    batches = []

    def learn(agent, optimizer, batch, *_):
        batches.append((batch[1].clone(), agent.actor_mean(batch[0]), agent.std()))
        return {}

    ones = "noise.sample(args.n_steps)", "torch.ones(args.n_steps, args.n_envs, 1)"
    run_edited((LOOP, change + LOOP), ones, learn=learn)
    for i, (actions, means, std) in enumerate(batches):
        assert means.mean() > 1.5 * (i + 1) and std.item() == pytest.approx(np.exp(-i - 1))
        torch.testing.assert_close(actions, means + std)


@pytest.mark.parametrize("scheduler", [True, False])
def test_a_learning_rate_that_falls_goes_on_after_a_resume(run_edited, scheduler):
    """Each is computed from the one before, by a saved scheduler of torch or in the loop."""
    optimizer = "        optimizer = make_optimizer(agent, args)\n"
    update = "            losses = learn(agent, optimizer, batch, backward, args)\n"
    make = "        scheduler = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)\n"
    edits = [(optimizer, optimizer + make), (update, f"{update}            scheduler.step()\n")]
    edits.append(('"noise": noise}', '"noise": noise, "scheduler": scheduler}'))
    if not scheduler:
        edits = [(update, f'{update}            optimizer.param_groups[0]["lr"] *= 0.5\n')]
    calls = []

    def learn(*arguments):
        if calls:
            raise KeyboardInterrupt
        calls.append(arguments)
        return ppo.learn(*arguments)

    with pytest.raises(KeyboardInterrupt):
        run_edited(*edits, learn=learn)
    _, scalars, _ = run_edited(*edits, again="--resume")
    assert scalars["losses/learning_rate"][-1] == pytest.approx(1e-2 * 0.5**4)


def test_learning_rates_of_the_actor_and_the_critic_are_both_annealed(run_edited):
    groups = """[
        {"params": [*agent.actor_mean.parameters(), agent.log_std], "lr": 0.0},
        {"params": agent.critic.parameters(), "lr": 1e-2},
    ]"""
    start, *_ = run_edited(learn=lambda *_: {})
    agent, *_ = run_edited(("Adam(agent.parameters()", f"Adam({groups}"), flags="--anneal-lr")
    change = [
        (a - b).abs().max() for a, b in zip(agent.parameters(), start.parameters(), strict=True)
    ]
    assert max(change[:7]) == 0 and min(change[7:]) > 1e-3


@pytest.mark.parametrize("flags", ["", "--vanilla"])
def test_one_std_for_all_action_dimensions(flags):
    agent, args = ppo.Agent(3, 2), parse(flags)
    agent.log_std = nn.Parameter(torch.zeros(1))
    act = ppo.exploration(agent, ColoredNoiseProcess(0.5, 4, 2), args)
    actions = act(np.zeros((4, 3), np.float32), 0)
    assert len(np.unique(actions)) == 8


def test_hooks_and_dropout_in_the_policy():
    actor = nn.Sequential(nn.Linear(3, 64), nn.Dropout(), nn.Linear(64, 1))
    policy, obs = ppo.numpy_policy(actor), np.ones((1, 3), np.float32)
    assert policy(obs) == policy(obs) and actor.training
    actor = nn.Sequential(nn.Linear(3, 1))
    actor[0].register_forward_hook(lambda module, inputs, output: 0 * output + 1.5)
    assert ppo.numpy_policy(actor)(obs) == 1.5


@pytest.mark.parametrize("flags", ["--no-compile", "--compile"])
def test_print_and_mistakes_in_the_loss(run_edited, capsys, flags):
    line = "    ratio = log_ratio.exp()\n"
    run_edited((line, f'{line}    print("ratio", ratio.mean())\n'), flags=flags)
    out, err = capsys.readouterr()
    assert out.count("ratio") >= 16  # 4 updates of 4 minibatches
    assert ("no torch.compile" in err) == (flags == "--compile")
    with pytest.raises(AttributeError, match="expp"):
        run_edited((line, line.replace("exp", "expp")), flags=flags)


def test_an_edit_that_does_not_fit_the_checkpoint(run_edited, train, tiny, tmp_path):
    """--resume says so, and loses nothing of the run that is there."""
    interrupted(train, f"{tiny} --learning-rate 1e-2", 3)  # as run_edited has it
    folder = next((tmp_path / "runs").rglob("config.json")).parent
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "lock"}
    edit = (HIDDEN, f"            nn.LayerNorm(64),\n{HIDDEN}")
    with pytest.raises(RuntimeError, match="Missing key"):
        run_edited(edit, flags=tiny, again="--resume")
    assert {name: (folder / name).read_bytes() for name in before} == before
