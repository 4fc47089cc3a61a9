"""The paper's other methods, run through ppo_colored_continuous.py: only what differs from it.

    python -m study.methods trpo --beta 0.5     Sec. A7: TRPO with colored noise
    python -m study.methods a2c --beta 0.5      Sec. A7: A2C with colored noise
    python -m study.methods gsde                Sec. A13: PPO with state-dependent exploration

All flags of the script hold (--help), but those that the method does not have. None of this is in
the paper's released code, and its text gives no hyperparameters, so the defaults are those of
Stable-Baselines3 (A2C, gSDE) and sb3-contrib (TRPO), with 4 environments.
"""

import argparse
import math
import sys

import torch
from torch import nn
from torch.func import functional_call

import ppo_colored_continuous as ppo

# --- A2C (Mnih et al. 2016): one step of the plain policy gradient for each short rollout


def a2c_loss(params, batch, agent, args):
    """The policy gradient's loss, as a function of the flat parameters; batch as in ppo_loss."""
    obs, actions, _, advantages, returns, _ = batch
    named = ppo.unflatten(params, agent)
    logprobs, entropy, values = functional_call(agent, named, (obs, actions))
    policy_loss = -(advantages * logprobs).mean()
    value_loss = ((returns - values) ** 2).mean()
    loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy
    return loss, {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}


def a2c_update(params, optimizer, batch, learning_rate, agent, args):
    """The gradient step on the whole batch, by RMSprop, whose eps stands outside of the root."""
    grads, metrics = torch.func.grad(a2c_loss, has_aux=True)(params, batch, agent, args)
    grads = grads * (args.max_grad_norm / (grads.norm() + 1e-6)).clamp(max=1.0)
    unused, square_avg, step = optimizer
    square_avg = 0.99 * square_avg + 0.01 * grads**2
    params = params - learning_rate * grads / (square_avg.sqrt() + 1e-5)
    return params, (unused, square_avg, step + 1), metrics


def a2c_learn(agent, optimizer, batch, learning_rate, update, args):
    """In place of ppo.learn: moves the agent's parameters; returns the optimizer and metrics."""
    params = nn.utils.parameters_to_vector(ppo.trainable(agent).values()).detach()
    learning_rate = torch.tensor(learning_rate, dtype=torch.float64, device=args.device)
    params, optimizer, metrics = update(params, optimizer, batch, learning_rate, agent, args)
    nn.utils.vector_to_parameters(params, ppo.trainable(agent).values())
    return optimizer, metrics


# --- TRPO (Schulman et al. 2015): the largest step along the natural gradient that keeps KL < 0.01

TARGET_KL, DAMPING, CG_STEPS, LINE_SEARCH_STEPS, SHRINK = 0.01, 0.1, 15, 10, 0.8


def surrogate(params, batch, agent):
    """Mean of advantage times probability ratio, as a function of the flat parameters."""
    obs, actions, old_logprobs, advantages, *_ = batch
    logprobs, *_ = functional_call(agent, ppo.unflatten(params, agent), (obs, actions))
    return (advantages * (logprobs - old_logprobs).exp()).mean()


def kl_divergence(params, old_params, obs, agent):
    """KL divergence of the policies N(mean, std) of two flat parameter vectors, new || old.

    The mean over observations and, as in sb3-contrib, action dimensions: that of a single one.
    """

    def mean_and_log_std(params):
        named = ppo.unflatten(params, agent)
        actor = {k.split(".", 1)[1]: p for k, p in named.items() if k.startswith("actor_mean.")}
        return functional_call(agent.actor_mean, actor, obs), named["log_std"]

    mean, log_std = mean_and_log_std(params)
    old_mean, old_log_std = mean_and_log_std(old_params)
    variance_ratio = (2 * (log_std - old_log_std)).exp()
    distance = ((mean - old_mean) / old_log_std.exp()) ** 2
    return 0.5 * (variance_ratio + distance - 1 - variance_ratio.log()).mean()


def conjugate_gradient(product, b):
    """An approximate solution x of A x = b, by CG_STEPS steps; product(v) is A v."""
    x, residual = torch.zeros_like(b), b.clone()
    direction, norm = b.clone(), b @ b
    for _ in range(CG_STEPS):
        if norm < 1e-10:
            break
        image = product(direction)
        alpha = norm / (direction @ image)
        x, residual = x + alpha * direction, residual - alpha * image
        norm, old_norm = residual @ residual, norm
        direction = residual + norm / old_norm * direction
    return x


def trpo_actor(params, batch, agent):
    """The actor's step. Returns the flat parameters, moved or as they were, and metrics."""
    obs = batch[0]

    def product(vector):  # of the Fisher matrix, the Hessian of the KL divergence, and a vector
        kl_gradient = torch.func.grad(lambda p: kl_divergence(p, params, obs, agent))
        return torch.func.jvp(kl_gradient, (params,), (vector,))[1] + DAMPING * vector

    gradient, before = torch.func.grad_and_value(surrogate)(params, batch, agent)
    direction = conjugate_gradient(product, gradient)
    longest = (2 * TARGET_KL / (direction @ product(direction))).sqrt()
    for i in range(LINE_SEARCH_STEPS):
        moved = params + SHRINK**i * longest * direction
        after, kl = surrogate(moved, batch, agent), kl_divergence(moved, params, obs, agent)
        if kl < TARGET_KL and after > before:
            return moved, {"policy_loss": -after, "approx_kl": kl, "line_search_steps": i + 1}
    return params, {"policy_loss": -before, "approx_kl": 0, "line_search_steps": LINE_SEARCH_STEPS}


def critic_loss(params, minibatch, agent):
    obs, actions, _, _, returns, _ = minibatch
    *_, values = functional_call(agent, ppo.unflatten(params, agent), (obs, actions))
    loss = ((returns - values) ** 2).mean()
    return loss, {"value_loss": loss}


def critic_update(params, optimizer, minibatch, learning_rate, agent, args):
    """A step of Adam on the value loss, whose gradient is zero for all but the critic."""
    grads, metrics = torch.func.grad(critic_loss, has_aux=True)(params, minibatch, agent)
    params, optimizer = ppo.adam(params, grads, optimizer, learning_rate)
    return params, optimizer, metrics


def trpo_learn(agent, optimizer, batch, learning_rate, update, args):
    """In place of ppo.learn: a step of the actor on the whole batch, then epochs of the critic."""
    obs, actions, logprobs, advantages, *rest = batch
    if args.normalize_advantage:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    batch = (obs, actions, logprobs, advantages, *rest)
    params = nn.utils.parameters_to_vector(ppo.trainable(agent).values()).detach()
    params, actor_metrics = trpo_actor(params, batch, agent)
    nn.utils.vector_to_parameters(params, ppo.trainable(agent).values())
    optimizer, metrics = ppo.learn(agent, optimizer, batch, learning_rate, update, args)
    return optimizer, metrics | actor_metrics


# --- gSDE (Raffin et al. 2021): noise that is a function of the state, the same for a whole rollout


class GSDEAgent(ppo.Agent):
    """Its noise is h(s) W, with h the actor's last hidden layer and W ~ N(0, exp(log_std)^2)."""

    def __init__(self, obs_dim, action_dim):
        super().__init__(obs_dim, action_dim)
        self.log_std = nn.Parameter(torch.zeros(self.actor_mean[-1].in_features, action_dim))

    def forward(self, obs, actions):
        """As in Agent; the density of an action is that over all W."""
        hidden = self.actor_mean[:-1](obs)
        mean = self.actor_mean[-1](hidden)
        variance = hidden.detach() ** 2 @ (2 * self.log_std).exp()  # the noise trains log_std only
        std = (variance + 1e-6).sqrt()
        z = (actions - mean) / std
        logprobs = (-0.5 * z**2 - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)
        entropy = (0.5 + 0.5 * math.log(2 * math.pi) + std.log()).sum(-1).mean()
        return logprobs, entropy, self.critic(obs).squeeze(-1)


def gsde_exploration(agent, noise, args):
    """In place of ppo.exploration: a matrix W, (64, action_dim), per environment and rollout."""
    weights = torch.randn(args.n_envs, *agent.log_std.shape) * agent.log_std.exp().detach().cpu()
    weights, policy = weights.numpy(), ppo.numpy_policy(agent.actor_mean)
    hidden = ppo.numpy_policy(agent.actor_mean[:-1])
    return lambda obs, t: policy(obs) + (hidden(obs)[:, None, :] @ weights)[:, 0]


# --- What each method replaces, its defaults, and the script's flags that it does not have

METHODS = {
    "a2c": dict(
        replaces=dict(learn=a2c_learn, update=a2c_update),
        defaults=dict(n_steps=5, learning_rate=7e-4, gae_lambda=1.0, normalize_advantage=False),
        lacks=["batch-size", "n-epochs", "clip-range", "normalize-advantage"],
    ),
    "trpo": dict(
        replaces=dict(learn=trpo_learn, update=critic_update),
        defaults=dict(learning_rate=1e-3),  # of the critic
        lacks=["clip-range", "ent-coef", "vf-coef", "max-grad-norm"],
    ),
    "gsde": dict(
        replaces=dict(make_agent=GSDEAgent, exploration=gsde_exploration),
        defaults={},
        lacks=["beta", "vanilla", "noise-seq-len"],
    ),
}


def main(argv):
    parser = argparse.ArgumentParser(
        usage="python -m study.methods METHOD [flags of ppo_colored_continuous.py]",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("method", choices=METHODS)
    name = parser.parse_args(argv[:1]).method
    method, flags = METHODS[name], argv[1:]
    for flag in method["lacks"]:
        if any(word.split("=")[0] in (f"--{flag}", f"--no-{flag}") for word in flags):
            parser.error(f"{name} has no --{flag}")
    args = ppo.parse_args(flags, method=name, exp_name=name, **method["defaults"])
    ppo.main(args, **method["replaces"])


if __name__ == "__main__":
    main(sys.argv[1:])
