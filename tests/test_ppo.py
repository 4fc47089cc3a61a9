"""The algorithm against Stable-Baselines3: same weights and data in, same numbers out."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.vec_env import DummyVecEnv

import ppo_colored_continuous as ppo
import run_files
from colored_noise import ColoredNoiseProcess
from environments import make_vector_env

N_STEPS, N_ENVS = 64, 3


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
        return (
            self._obs(),
            float(self.x.sum() + 0.1 * self.t),
            bool(abs(self.x).max() > 3),
            False,
            {},
        )

    def _obs(self):
        return np.array([*self.x, 0.1 * self.t], np.float32)


gym.register("Drift-v0", Drift, max_episode_steps=20)


def parse(flags=""):
    return ppo.parse_args(flags.split())


def layers(agent):
    return {
        f"{net}.{i}": getattr(agent, net)[i] for net in ("actor_mean", "critic") for i in (0, 2, 4)
    }


def sb3_layers(policy):
    actor, critic = policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net
    return dict(
        zip(
            layers(ppo.Agent(1, 1)),
            [*actor[::2], policy.action_net, *critic[::2], policy.value_net],
            strict=True,
        )
    )


def copy_weights(agent, policy):
    with torch.no_grad():
        for name, layer in sb3_layers(policy).items():
            layer.weight.copy_(layers(agent)[name].weight)
            layer.bias.copy_(layers(agent)[name].bias)
        policy.log_std.copy_(agent.log_std)


def make_pair(flags="", **sb3_settings):
    """Our agent and SB3's PPO with the same random weights, not the initial ones; our arguments."""
    args = parse(flags)
    settings = dict(
        learning_rate=args.learning_rate, n_steps=N_STEPS, batch_size=N_STEPS * N_ENVS, n_epochs=1
    )
    sb3 = PPO(
        "MlpPolicy",
        DummyVecEnv([lambda: gym.make("Drift-v0")] * N_ENVS),
        **{**settings, **sb3_settings},
        seed=1,
    )
    torch.manual_seed(0)
    agent = ppo.Agent(3, 2).requires_grad_(False)
    for p in agent.parameters():
        p += 0.1 * torch.randn_like(p)
    copy_weights(agent, sb3.policy)
    return agent, sb3, args


def random_minibatch(agent, n=N_STEPS * N_ENVS):
    torch.manual_seed(2)
    obs, actions = torch.randn(n, 3), torch.randn(n, 2)
    logprobs = agent(obs, actions)[0] + 0.3 * torch.randn(
        n
    )  # so that a good part of the ratios is clipped
    return obs, actions, logprobs, 2 * torch.randn(n) + 1, 3 * torch.randn(n), torch.randn(n)


def fill_buffer(sb3, minibatch):
    """Puts a minibatch into SB3's rollout buffer in the same order, flattened already."""
    buffer = sb3.rollout_buffer
    buffer.reset()
    obs, actions, logprobs, advantages, returns, _ = (x.numpy() for x in minibatch)
    buffer.observations, buffer.actions = obs, actions
    buffer.log_probs, buffer.advantages, buffer.returns = (
        logprobs[:, None],
        advantages[:, None],
        returns[:, None],
    )
    buffer.values = np.zeros_like(buffer.returns)
    buffer.full = buffer.generator_ready = True
    sb3._setup_learn(1)


def flat(agent, policy, get=lambda p: p):
    """SB3's parameters, or get(parameter) of each, in the order of our flat vector."""
    pairs = {
        f"{name}.{k}": p
        for name, layer in sb3_layers(policy).items()
        for k, p in layer.named_parameters()
    }
    pairs["log_std"] = policy.log_std
    return torch.cat(
        [get(pairs[name]).detach().reshape(-1) for name, _ in agent.named_parameters()]
    )


def initial_state(agent):
    params = torch.nn.utils.parameters_to_vector(agent.parameters()).clone()
    step = torch.zeros((), dtype=torch.float64)
    return params, (torch.zeros_like(params), torch.zeros_like(params), step)


def test_network_is_the_same():
    agent, sb3, _ = make_pair()
    obs, actions, *_ = random_minibatch(agent)
    logprobs, entropy, values = agent(obs, actions)
    with torch.no_grad():
        their_values, their_logprobs, their_entropy = sb3.policy.evaluate_actions(obs, actions)
        their_mean = sb3.policy.get_distribution(obs).distribution.mean
    torch.testing.assert_close(agent.actor_mean(obs), their_mean)
    torch.testing.assert_close(values, their_values.squeeze(-1))
    torch.testing.assert_close(logprobs, their_logprobs)
    torch.testing.assert_close(entropy.expand(len(obs)), their_entropy)


def test_initial_weights_have_the_same_law():
    """Orthogonal with the gains of SB3, zero biases, log std 0."""
    agent, sb3 = ppo.Agent(3, 2), PPO("MlpPolicy", gym.make("Drift-v0"), seed=1).policy
    for name, theirs in sb3_layers(sb3).items():
        ours = layers(agent)[name]
        torch.testing.assert_close(
            torch.linalg.svdvals(ours.weight), torch.linalg.svdvals(theirs.weight)
        )
        assert ours.weight.shape == theirs.weight.shape and not ours.bias.any()
    assert torch.equal(agent.log_std, sb3.log_std)


@pytest.mark.parametrize(
    "flags, settings",
    [
        ("--max-grad-norm 1e9", dict(max_grad_norm=1e9)),
        ("", {}),
        ("--no-normalize-advantage --ent-coef 0.03 --vf-coef 0.7 --clip-range 0.1",
         dict(normalize_advantage=False, ent_coef=0.03, vf_coef=0.7, clip_range=0.1)),
    ],
)  # fmt: skip
def test_loss_and_gradient(flags, settings):
    agent, sb3, args = make_pair(flags, **settings)
    minibatch = random_minibatch(agent)
    params, _ = initial_state(agent)
    loss_and_metrics = torch.func.grad(ppo.ppo_loss, has_aux=True)
    grads, metrics = loss_and_metrics(params, minibatch, agent, args)
    loss, _ = ppo.ppo_loss(params, minibatch, agent, args)

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

    grads = grads * min(1, args.max_grad_norm / (grads.norm().item() + 1e-6))
    theirs = flat(agent, sb3.policy, lambda p: p.grad)
    torch.testing.assert_close(grads, theirs, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("rates", [[1e-3] * 5, [1e-3, 8e-4, 5e-4, 2e-4, 1e-4]])
def test_parameters_after_clipped_adam_steps(rates):
    agent, sb3, args = make_pair("", n_epochs=1)
    minibatch, (params, optimizer) = random_minibatch(agent), initial_state(agent)
    before = flat(agent, sb3.policy)
    torch.testing.assert_close(params, before)
    for rate in rates:
        fill_buffer(sb3, minibatch)
        sb3.lr_schedule = lambda _, rate=rate: rate
        sb3.train()
        rate = torch.tensor(rate, dtype=torch.float64)
        params, optimizer, _ = ppo.ppo_update(params, optimizer, minibatch, rate, agent, args)
    after = flat(agent, sb3.policy)
    assert (after - before).abs().max() > 2e-3
    torch.testing.assert_close(params, after, rtol=1e-4, atol=2e-5)


def test_compiled_update_equals_eager(capsys):
    """Also where what was compiled first meets other sizes, rates, arguments and another agent."""
    agent, _, _ = make_pair()
    minibatch, compiled, eager = random_minibatch(agent), initial_state(agent), initial_state(agent)
    update = run_files.compiled(ppo.ppo_update)
    all_args = [parse(), parse("--ent-coef 0.1 --max-grad-norm 0.2")]
    for n, rate, args in [(192, 1e-3, 0), (192, 2e-3, 0), (7, 1e-3, 0), (192, 1e-3, 1)]:
        rate, args = torch.tensor(rate, dtype=torch.float64), all_args[args]
        rest = (tuple(x[:n] for x in minibatch), rate, agent, args)
        *compiled, metrics = update(*compiled, *rest)
        *eager, eager_metrics = ppo.ppo_update(*eager, *rest)
    assert "going on without" not in capsys.readouterr().err  # it did compile
    torch.testing.assert_close(compiled[0], eager[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(metrics, eager_metrics, rtol=1e-3, atol=1e-5)


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


class ColoredGaussian(DiagGaussianDistribution):
    """SB3's distribution with colored noise, as the paper has it."""

    def __init__(self, noise):
        super().__init__(noise.size[1])
        self.noise = noise

    def sample(self):
        return self.distribution.mean + self.distribution.stddev * self.noise.sample()


@pytest.mark.parametrize("bootstrap", ["", "--no-bootstrap-timeouts"])
def test_whole_rollout_against_sb3(monkeypatch, tmp_path, bootstrap):
    """The script's batches, with colored noise, clipped actions, ends, time limits, are SB3's.

    Three rollouts with the policy unchanged, so that noise and episodes run on across rollouts.
    """
    size, total = N_STEPS * N_ENVS, 3 * N_STEPS * N_ENVS
    flags = f"--env-id Drift-v0 --n-steps {N_STEPS} --n-envs {N_ENVS} --total-timesteps {total} "
    flags += f"--batch-size {size} --n-epochs 1 --eval-freq {total} --eval-episodes 1 --no-compile "
    args = parse(f"{flags} --noise-seq-len 50 --runs-dir {tmp_path} {bootstrap}")
    agents, batches = [], []

    def make_agent(*dims):
        agents.append(ppo.Agent(*dims))
        agents[0].critic[-1].bias.data += 5  # a value worth bootstrapping
        return agents[0]

    def learn(agent, optimizer, batch, *_):
        batches.append([x.clone() for x in batch])
        return optimizer, {}

    ppo.main(args, make_agent=make_agent, learn=learn)
    agent = agents[0]

    sb3 = PPO(
        "MlpPolicy", DummyVecEnv([lambda: gym.make("Drift-v0")] * N_ENVS), n_steps=N_STEPS, seed=1
    )
    copy_weights(agent, sb3.policy)
    sb3.policy.action_dist = ColoredGaussian(
        ColoredNoiseProcess(0.5, N_ENVS, 2, 50, run_files.make_seeds(2, 1, 0)[1])
    )
    if bootstrap:  # the paper's dm_control runs did not see that an end was a time limit
        step_wait = sb3.env.step_wait

        def without_time_limits():
            *rest, infos = step_wait()
            for info in infos:
                info.pop("TimeLimit.truncated", None)
            return *rest, infos

        monkeypatch.setattr(sb3.env, "step_wait", without_time_limits)
    _, callback = sb3._setup_learn(10**6)
    for batch in batches:
        sb3.collect_rollouts(sb3.env, callback, sb3.rollout_buffer, N_STEPS)
        buffer = sb3.rollout_buffer
        assert buffer.episode_starts.sum() > N_ENVS
        assert {x.dtype for x in batch} == {torch.float32}  # or it would be compiled anew
        theirs = (buffer.observations, buffer.actions, buffer.log_probs, buffer.advantages)
        theirs += (buffer.returns, buffer.values)
        for ours, their in zip(batch, theirs, strict=True):
            np.testing.assert_allclose(
                ours.numpy(), their.reshape(ours.shape), rtol=1e-3, atol=1e-4
            )
    assert len(batches) == 3


class Count(gym.Env):
    """Observation and reward are the time t. Terminates after `seed` steps, 5 by default."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed=None, options=None):
        self.t, self.length = 0, seed or 5
        return np.array([0.0]), {}

    def step(self, action):
        self.t += 1
        return np.array([float(self.t)]), float(self.t), self.t == self.length, False, {}


gym.register("CountTerminated-v0", Count)
gym.register("CountTruncated-v0", Count, max_episode_steps=5)


@pytest.mark.parametrize("env_id", ["CountTerminated-v0", "CountTruncated-v0"])
def test_autoreset_inserts_no_dummy_transition(env_id):
    envs = make_vector_env(env_id, 2)
    assert envs.autoreset_mode is AutoresetMode.SAME_STEP
    obs, _ = envs.reset(seed=[10, 10] if env_id == "CountTruncated-v0" else [5, 5])
    assert obs.dtype == np.float32 and obs.shape == (2, 1)
    seen, rewards = [obs[0, 0].item()], []
    for _ in range(10):
        envs.envs[0].unwrapped.length = 10 if env_id == "CountTruncated-v0" else 5
        obs, reward, terminated, truncated, infos = envs.step(np.zeros((2, 1), np.float32))
        seen.append(obs[0, 0].item())
        rewards.append(reward[0].item())
        if terminated[0] or truncated[0]:
            assert truncated[0] == (env_id == "CountTruncated-v0")
            assert infos["final_obs"][0].tolist() == [5.0]  # what is bootstrapped
    assert seen == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0]
    assert rewards == [1, 2, 3, 4, 5] * 2


def test_evaluation_counts_whole_episodes_once():
    envs = make_vector_env("CountTruncated-v0", 3)
    returns, lengths = ppo.evaluate(lambda obs: np.zeros((3, 1), np.float32), envs, [3, 10, 1])
    assert returns.tolist() == [6, 15, 1] and lengths.tolist() == [3, 5, 1]


def test_evaluation_is_seeded_and_leaves_all_generators_alone():
    envs = make_vector_env("dm_control/pendulum-swingup-v0", 2)
    policy = lambda obs: np.zeros((2, 1), np.float32)  # noqa: E731
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first, _ = ppo.evaluate(policy, envs, [1, 2])
    again, _ = ppo.evaluate(policy, envs, [1, 2])
    assert first.tolist() == again.tolist()
    assert torch.equal(torch.get_rng_state(), before)


def test_dict_observations_are_flattened_to_float32_in_order():
    envs = make_vector_env("dm_control/walker-run-v0", 1)
    obs, _ = envs.reset(seed=[3])
    raw = envs.envs[0].unwrapped._env.task.get_observation(envs.envs[0].unwrapped._env.physics)
    expected = np.concatenate([np.ravel(raw[key]) for key in sorted(raw)])
    assert obs.shape == (1, 24) and obs.dtype == np.float32
    np.testing.assert_allclose(obs[0], expected, rtol=1e-6)
