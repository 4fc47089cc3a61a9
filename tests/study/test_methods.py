"""A2C, TRPO and gSDE against Stable-Baselines3 and sb3-contrib: same weights and batch."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

import ppo_colored_continuous as ppo
from study import methods

N_STEPS, N_ENVS = 64, 3
SIZE = N_STEPS * N_ENVS


class Plane(gym.Env):
    """Nothing but its spaces: 3 observations, 2 actions."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None, options=None):
        return np.zeros(3, np.float32), {}


def pairs(agent, policy):
    """Our parameters, each with that of Stable-Baselines3's policy, in our order."""
    actor, critic = policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net
    theirs = [*actor[::2], policy.action_net, *critic[::2], policy.value_net]
    ours = [*agent.actor_mean[::2], *agent.critic[::2]]
    assert next(agent.parameters()) is agent.log_std  # the order of agent.parameters()
    yield agent.log_std, policy.log_std
    for our_layer, their_layer in zip(ours, theirs, strict=True):
        yield our_layer.weight, their_layer.weight
        yield our_layer.bias, their_layer.bias


def flat(tensors):
    return torch.cat([x.detach().reshape(-1) for x in tensors])


def assert_same_parameters(agent, theirs, **tolerance):
    ours, others = zip(*pairs(agent, theirs.policy), strict=True)
    torch.testing.assert_close(flat(ours), flat(others), **tolerance)


def make_pair(algorithm, method, noise=0.1, seed=0, **settings):
    """Our agent and their algorithm with the same random weights, and the method's arguments."""
    envs = DummyVecEnv([Plane] * N_ENVS)
    theirs = algorithm("MlpPolicy", envs, n_steps=N_STEPS, seed=1, **settings)
    torch.manual_seed(seed)
    agent = methods.METHODS[method]["replaces"].get("make_agent", ppo.Agent)(3, 2)
    for our, their in pairs(agent, theirs.policy):
        our.data += noise * torch.randn_like(our)
        their.data.copy_(our.data)
    defaults = methods.METHODS[method]["defaults"]
    args = ppo.parse_args(["--n-epochs", "1"], method=method, **defaults)
    args.batch_size = SIZE
    return agent, theirs, args


def random_batch(agent, seed=2):
    torch.manual_seed(seed)
    obs = torch.randn(SIZE, 3)
    with torch.no_grad():
        actions = agent.actor_mean(obs) + torch.randn(SIZE, 2)
        logprobs = agent(obs, actions)[0]
    return obs, actions, logprobs, 2 * torch.randn(SIZE) + 1, torch.randn(SIZE), torch.randn(SIZE)


def learn(method, agent, optimizer, batch, args):
    """An update, as ppo.main makes it with what the method replaces."""
    replaces = {"loss": ppo.ppo_loss, "learn": ppo.learn} | methods.METHODS[method]["replaces"]
    backward = functools.partial(ppo.loss_backward, replaces["loss"])
    return replaces["learn"](agent, optimizer, batch, backward, args)


def test_a2c_after_five_updates(fill_buffer):
    agent, theirs, args = make_pair(A2C, "a2c")
    optimizer, before = methods.a2c_optimizer(agent, args), flat(agent.parameters())
    for seed in range(5):
        batch = random_batch(agent, seed)
        fill_buffer(theirs, batch)
        theirs.train()
        learn("a2c", agent, optimizer, batch, args)
    assert (flat(agent.parameters()) - before).abs().max() > 1e-2
    assert_same_parameters(agent, theirs, rtol=1e-3, atol=2e-5)


@pytest.mark.parametrize(
    "noise, seed, damping, shrink, steps",
    [(0.1, 0, 0.1, 0.8, 1), (0.3, 1, 0.01, 0.8, 2), (0.3, 1, 0.01, 1.0, 10)],
    ids=["accepted", "shrunk", "refused"],
)
def test_trpo(monkeypatch, fill_buffer, noise, seed, damping, shrink, steps):
    """The actor's step and line search, and ten of the critic's."""
    settings = dict(batch_size=SIZE, line_search_shrinking_factor=shrink, cg_damping=damping)
    agent, theirs, args = make_pair(TRPO, "trpo", noise, seed, **settings)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)  # where their solver begins
    monkeypatch.setattr(methods, "SHRINK", shrink)
    monkeypatch.setattr(methods, "DAMPING", damping)
    args.n_epochs, batch, before = 10, random_batch(agent), flat(agent.parameters())
    fill_buffer(theirs, batch)
    theirs.train()
    metrics = learn("trpo", agent, ppo.make_optimizer(agent, args), batch, args)
    logged, ours = theirs.logger.name_to_value, {k: float(v) for k, v in metrics.items()}
    assert ours["line_search_steps"] == steps
    assert logged["train/is_line_search_success"] == (steps < 10)
    assert ours["approx_kl"] == pytest.approx(logged["train/kl_divergence_loss"], rel=0.02)
    objective = logged["train/policy_objective"]
    assert -ours["policy_loss"] == pytest.approx(objective, rel=0.01, abs=1e-6)
    assert ours["value_loss"] == pytest.approx(logged["train/value_loss"], rel=1e-4)
    assert_same_parameters(agent, theirs, rtol=2e-2, atol=3e-4)  # 15 steps of float32
    moved = (flat(agent.parameters()) - before).abs()
    n_critic = sum(p.numel() for p in agent.critic.parameters())  # they come last
    assert moved[-n_critic:].max() > 5e-3 and (moved[:-n_critic].max() > 5e-3) == (steps < 10)


def gsde_pair():
    agent, theirs, args = make_pair(PPO, "gsde", use_sde=True, batch_size=SIZE, n_epochs=1)
    for log_std in (agent.log_std, theirs.policy.log_std):
        log_std.data -= 0.5
    return agent, theirs, args


def test_gsde_density_entropy_and_gradient(fill_buffer):
    agent, theirs, args = gsde_pair()
    obs, actions, logprobs, *rest = random_batch(agent)
    batch = (obs, actions, logprobs + 0.3 * torch.randn(SIZE), *rest)
    their_values, their_logprobs, their_entropy = theirs.policy.evaluate_actions(obs, actions)
    logprobs, entropy, values = agent(obs, actions)
    torch.testing.assert_close(logprobs, their_logprobs, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(entropy, their_entropy.mean(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values, their_values.squeeze(-1))
    args.ent_coef = theirs.ent_coef = 0.01
    ppo.loss_backward(ppo.ppo_loss, agent, batch, args)
    fill_buffer(theirs, batch)
    theirs.train()
    grads = [(ours.grad, their.grad) for ours, their in pairs(agent, theirs.policy)]
    ours, their = map(flat, zip(*grads, strict=True))
    torch.testing.assert_close(ours, their, rtol=2e-3, atol=2e-6)


def test_gsde_noise():
    """A matrix per environment and rollout, with the variance that the density has."""
    agent, theirs, args = gsde_pair()
    policy, args.n_envs = ppo.numpy_policy(agent.actor_mean), 20_000
    torch.manual_seed(0)
    obs = np.tile(np.float32([[0.3, -1, 2]]), (args.n_envs, 1))
    act = methods.gsde_exploration(agent, None, args)
    noise = act(obs, 0) - policy(obs)
    assert np.array_equal(act(obs, 7) - policy(obs), noise)  # the same in the whole rollout
    other = methods.gsde_exploration(agent, None, args)(obs, 0) - policy(obs)
    for a, b in [(noise, other), (noise[:-1], noise[1:]), (noise[:, :1], noise[:, 1:])]:
        correlation = np.corrcoef(a[:, 0], b[:, 0])[0, 1]
        assert abs(correlation) < 0.03  # with the next rollout, environment, action
    std = theirs.policy.get_distribution(torch.tensor(obs[:1])).distribution.stddev
    np.testing.assert_allclose(noise.std(0), std[0].detach(), rtol=0.02)
    # It is of the state, and linear in the hidden layer, which ends with an odd function
    assert not np.allclose(act(-obs, 0) - policy(-obs), noise, atol=0.01)
    for layer in agent.actor_mean[:-1:2]:
        nn.init.zeros_(layer.bias)
    act = methods.gsde_exploration(agent, None, args)
    noises = [act(x, 0) - ppo.numpy_policy(agent.actor_mean)(x) for x in (obs, -obs)]
    np.testing.assert_allclose(noises[0], -noises[1], atol=1e-5)


@pytest.mark.parametrize("method, steps", [("a2c", 8), ("trpo", 80), ("gsde", 80)])
def test_a_run(tmp_path, read_evaluations, method, steps):
    flags = f"{method} --env-id Pendulum-v1 --n-envs 2 --n-steps 64 --total-timesteps 1024 "
    methods.main(f"{flags} --eval-freq 256 --eval-episodes 2 --runs-dir {tmp_path}".split())
    (folder,) = (file.parent for file in tmp_path.rglob("summary.json"))
    assert folder.parts[-5] == method and (folder.parts[-3] == "gsde") == (method == "gsde")
    assert [row["step"] for row in read_evaluations(folder)] == [256, 512, 768, 1024]
    optimizer = torch.load(folder / "checkpoint.pt", weights_only=True)["optimizer"]
    assert optimizer["state"][0]["step"] == steps


@pytest.mark.parametrize(
    "argv, words",
    [("", "required: method"), ("ppo", "invalid choice: 'ppo'"), ("gsde --beta 1", "no --beta"),
     ("a2c --clip-range 0.1", "no --clip-range"), ("trpo --ent-coef=0.1", "no --ent-coef"),
     ("a2c --no-normalize-advantage", "no --normalize-advantage")],
)  # fmt: skip
def test_a_flag_that_the_method_does_not_have(capsys, argv, words):
    with pytest.raises(SystemExit) as stopped:
        methods.main(argv.split())
    assert stopped.value.code == 2 and words in capsys.readouterr().err
