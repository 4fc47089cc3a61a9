"""A2C, TRPO and gSDE against Stable-Baselines3 and sb3-contrib: same weights and batch."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import ROOT, TINY, run_forked
from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from test_ppo import N_ENVS, N_STEPS, copy_weights, fill_buffer, flat, initial_state
from test_runs import only_run, read_evaluations, read_events, start, wait_for_rows

import baselines
import ppo_colored_continuous as ppo
import run_files
from environments import make_vector_env

SIZE = N_STEPS * N_ENVS


def make_pair(algorithm, method, noise=0.1, seed=0, **settings):
    """Our agent and theirs with the same random weights, and the method's arguments."""
    envs = DummyVecEnv([lambda: gym.make("Drift-v0")] * N_ENVS)
    theirs = algorithm("MlpPolicy", envs, n_steps=N_STEPS, seed=1, **settings)
    torch.manual_seed(seed)
    agent_class = baselines.METHODS[method]["replaces"].get("make_agent", ppo.Agent)
    agent = agent_class(3, 2).requires_grad_(False)
    for p in agent.parameters():
        p += noise * torch.randn_like(p)
    copy_weights(agent, theirs.policy)
    defaults = baselines.METHODS[method]["defaults"]
    return agent, theirs, ppo.parse_args([], method=method, **defaults)


def random_batch(agent, seed=2):
    torch.manual_seed(seed)
    obs = torch.randn(SIZE, 3)
    actions = agent.actor_mean(obs) + torch.randn(SIZE, 2)
    logprobs = agent(obs, actions)[0]
    return obs, actions, logprobs, 2 * torch.randn(SIZE) + 1, torch.randn(SIZE), torch.randn(SIZE)


def test_a2c_after_five_updates():
    agent, theirs, args = make_pair(A2C, "a2c")
    _, optimizer = initial_state(agent)
    before = flat(agent, theirs.policy)
    for seed in range(5):
        batch = random_batch(agent, seed)
        fill_buffer(theirs, batch)
        theirs.train()
        update = baselines.a2c_update
        optimizer, _ = baselines.a2c_learn(agent, optimizer, batch, 7e-4, update, args)
    after = flat(agent, theirs.policy)
    ours = torch.nn.utils.parameters_to_vector(agent.parameters())
    assert (after - before).abs().max() > 1e-2
    torch.testing.assert_close(ours, after, rtol=1e-3, atol=2e-5)


def test_a2c_compiles():
    agent, _, args = make_pair(A2C, "a2c")
    batch, (params, optimizer) = random_batch(agent), initial_state(agent)
    rate = torch.tensor(7e-4, dtype=torch.float64)
    compiled = torch.compile(baselines.a2c_update, fullgraph=True, dynamic=False, backend="eager")
    ours = compiled(params, optimizer, batch, rate, agent, args)[0]
    eager = baselines.a2c_update(params, optimizer, batch, rate, agent, args)[0]
    torch.testing.assert_close(ours, eager)


@pytest.mark.parametrize(
    "noise, seed, damping, shrink, steps",
    [(0.1, 0, 0.1, 0.8, 1), (0.3, 1, 0.01, 0.8, 2), (0.3, 1, 0.01, 1.0, 10)],
    ids=["accepted", "shrunk", "refused"],
)
def test_trpo(monkeypatch, noise, seed, damping, shrink, steps):
    """The actor's step and line search, and ten of the critic's."""
    settings = dict(batch_size=SIZE, line_search_shrinking_factor=shrink, cg_damping=damping)
    agent, theirs, args = make_pair(TRPO, "trpo", noise, seed, **settings)
    batch = random_batch(agent)
    params, optimizer = initial_state(agent)
    fill_buffer(theirs, batch)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)  # where their solver begins
    monkeypatch.setattr(baselines, "SHRINK", shrink)
    monkeypatch.setattr(baselines, "DAMPING", damping)
    theirs.train()
    args = ppo.parse_args(["--batch-size", str(SIZE)], method="trpo")
    update = baselines.critic_update
    _, metrics = baselines.trpo_learn(agent, optimizer, batch, 1e-3, update, args)
    assert metrics["line_search_steps"] == steps
    logged = theirs.logger.name_to_value
    assert logged["train/is_line_search_success"] == (steps < 10)
    assert float(metrics["approx_kl"]) == pytest.approx(
        logged["train/kl_divergence_loss"], rel=0.02
    )
    assert -float(metrics["policy_loss"]) == pytest.approx(
        logged["train/policy_objective"], rel=0.01, abs=1e-6
    )
    assert float(metrics["value_loss"]) == pytest.approx(logged["train/value_loss"], rel=1e-4)
    after = flat(agent, theirs.policy)
    ours = torch.nn.utils.parameters_to_vector(agent.parameters())
    torch.testing.assert_close(ours, after, rtol=2e-2, atol=3e-4)  # 15 steps of float32
    moved = (after - params).abs()
    actor = torch.cat(
        [torch.full((p.numel(),), "critic" not in name) for name, p in agent.named_parameters()]
    )
    assert moved[~actor].max() > 5e-3 and (moved[actor].max() > 5e-3) == (steps < 10)


def test_trpo_search_direction(monkeypatch):
    """x of F x = g, where their Fisher-vector products are by double backward."""
    from sb3_contrib.common.utils import conjugate_gradient_solver

    agent, *_ = make_pair(TRPO, "trpo")
    batch = random_batch(agent)
    params, _ = initial_state(agent)

    def product(vector):
        kl = lambda p: baselines.kl_divergence(p, params, batch[0], agent)  # noqa: E731
        return torch.autograd.functional.hvp(kl, params, vector)[1] + 0.1 * vector

    gradient = torch.func.grad(baselines.surrogate)(params, batch, agent)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)
    theirs = conjugate_gradient_solver(product, gradient, max_iter=15)
    ours = baselines.conjugate_gradient(product, gradient)
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)
    assert torch.cosine_similarity(product(ours), gradient, dim=0) > 0.99


def gsde_pair():
    agent, theirs, args = make_pair(PPO, "gsde", use_sde=True, batch_size=SIZE, n_epochs=1)
    with torch.no_grad():
        agent.log_std -= 0.5
        theirs.policy.log_std.copy_(agent.log_std)
    return agent, theirs, args


def test_gsde_density_entropy_and_gradient():
    agent, theirs, args = gsde_pair()
    obs, actions, logprobs, *rest = random_batch(agent)
    batch = (obs, actions, logprobs + 0.3 * torch.randn(SIZE), *rest)
    with torch.no_grad():
        their_values, their_logprobs, their_entropy = theirs.policy.evaluate_actions(obs, actions)
    logprobs, entropy, values = agent(obs, actions)
    torch.testing.assert_close(logprobs, their_logprobs, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(entropy, their_entropy.mean(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(values, their_values.squeeze(-1))
    params, _ = initial_state(agent)
    args = ppo.parse_args(["--ent-coef", "0.01"], method="gsde")
    grads, _ = torch.func.grad(ppo.ppo_loss, has_aux=True)(params, batch, agent, args)
    grads = grads * min(1, 0.5 / (grads.norm().item() + 1e-6))
    theirs.ent_coef = 0.01
    fill_buffer(theirs, batch)
    theirs.train()
    their_grads = flat(agent, theirs.policy, lambda p: p.grad)
    torch.testing.assert_close(grads, their_grads, rtol=2e-3, atol=2e-6)


def test_gsde_noise():
    """A matrix per environment and rollout, with the variance that the density has."""
    agent, theirs, _ = gsde_pair()
    args = ppo.parse_args(["--n-envs", "20000", "--n-steps", "8"], method="gsde")
    policy = run_files.numpy_policy(agent.actor_mean)
    torch.manual_seed(0)
    obs = np.tile(np.float32([[0.3, -1, 2]]), (20000, 1))
    act = baselines.gsde_exploration(agent, None, args)
    noise = act(obs, 0) - policy(obs)
    assert np.array_equal(act(obs, 7) - policy(obs), noise)  # the same in the whole rollout
    other = baselines.gsde_exploration(agent, None, args)(obs, 0) - policy(obs)
    for a, b in [
        (noise[:, 0], other[:, 0]),
        (noise[:-1, 0], noise[1:, 0]),
        (noise[:, 0], noise[:, 1]),
    ]:
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.03  # next rollout, next environment, next action
    with torch.no_grad():
        std = theirs.policy.get_distribution(torch.tensor(obs[:1])).distribution.stddev[0].numpy()
    np.testing.assert_allclose(noise.std(0), std, rtol=0.02)
    # of the state, and linear in the hidden layer: the negated hidden layer has the negated noise
    assert not np.allclose(act(-obs, 0) - policy(-obs), noise)


def test_the_evaluated_policy_of_gsde_has_no_noise(tmp_path):
    flags = "--env-id Pendulum-v1 --n-steps 256 --total-timesteps 1024 --eval-freq 1024 "
    flags += f"--eval-episodes 2 --no-compile --n-epochs 1 --runs-dir {tmp_path / 'runs'}"
    baselines.main(["gsde", *flags.split()])
    folder = only_run(tmp_path)
    assert folder.parts[-5:-2] == ("gsde", "Pendulum-v1", "gsde")
    agent = baselines.GSDEAgent(3, 1).requires_grad_(False)
    agent.load_state_dict(torch.load(folder / "checkpoint.pt", weights_only=True)["agent"])
    envs = make_vector_env("Pendulum-v1", 2)
    mean = lambda obs: agent.actor_mean(torch.tensor(obs)).numpy()  # noqa: E731
    returns, _ = ppo.evaluate(mean, envs, run_files.make_seeds(2, 1, 2, 1024))
    assert read_evaluations(folder)[0]["return_mean"] == pytest.approx(returns.mean(), rel=1e-3)


@pytest.mark.parametrize("method", ["a2c", "trpo", "gsde"])
def test_kill_and_resume(tmp_path, method):
    flags = f"{method} --n-envs 2 --n-steps 64 --total-timesteps 8192 --eval-freq 1024 "
    flags += "--eval-episodes 2 --no-compile --env-id Pendulum-v1"
    process = start(tmp_path, flags, script=ROOT / "baselines.py")
    wait_for_rows(tmp_path, 3, process)
    process.kill()
    process.communicate()
    argv = [*flags.split(), "--resume", "--runs-dir", str(tmp_path / "runs")]
    process = run_forked(ROOT / "baselines.py", argv, tmp_path, 60)
    assert process.returncode == 0, process.stderr
    folder = only_run(tmp_path)
    steps = [row["step"] for row in read_evaluations(folder)]
    assert steps == list(range(1024, 8193, 1024))
    assert [step for step, _ in read_events(folder)["evaluation/return_mean"]] == steps
    optimizer = torch.load(folder / "checkpoint.pt", weights_only=True)["optimizer"]
    updates = 8192 / 128
    assert optimizer[2] == updates * {"a2c": 1, "trpo": 10, "gsde": 10}[method]


def test_a_diverged_a2c_is_called_so(tmp_path):
    flags = TINY.replace("--n-epochs 1", f"--env-id Pendulum-v1 --runs-dir {tmp_path}")
    flags = f"a2c --learning-rate 1e38 {flags}"
    process = run_forked(ROOT / "baselines.py", flags.split(), tmp_path, 60)
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1].startswith("error: training diverged")


@pytest.mark.parametrize(
    "argv, words",
    [("", "give a method"), ("ppo", "give a method"), ("a2c --clip-range 0.1", "no --clip-range"),
     ("gsde --beta 1", "no --beta"), ("trpo --ent-coef=0.1", "no --ent-coef")],
)  # fmt: skip
def test_mistakes(capsys, argv, words):
    with pytest.raises(SystemExit) as stopped:
        baselines.main(argv.split())
    assert stopped.value.code == 2 and words in capsys.readouterr().err
