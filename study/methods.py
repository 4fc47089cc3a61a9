"""The paper's other methods, run through ppo_colored_continuous.py: only what differs from it.

    python -m study.methods trpo --beta 0.5     Sec. A7: TRPO with colored noise
    python -m study.methods a2c --beta 0.5      Sec. A7: A2C with colored noise
    python -m study.methods gsde                Sec. A13: PPO with state-dependent exploration

The flags are those of ppo_colored_continuous.py, except a few that do not apply. The paper gives no
hyperparameters for these methods, and its released code does not have them. The defaults are those
of Stable-Baselines3 (A2C, gSDE) and sb3-contrib (TRPO), with 4 environments.
"""

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter

import torch
from torch import nn
from torch.distributions import Normal, kl_divergence

import ppo_colored_continuous as ppo

# --- A2C (Mnih et al. 2016): one step of the plain policy gradient for each short rollout


def a2c_loss(agent, batch, args):
    """The policy gradient's loss; batch as in ppo_loss."""
    obs, actions, _, advantages, returns, _ = batch
    logprobs, entropy, values = agent(obs, actions)
    policy_loss = -(advantages * logprobs).mean()
    value_loss = ((returns - values) ** 2).mean()
    loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy
    return loss, {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}


def a2c_optimizer(agent, args):
    return torch.optim.RMSprop(agent.parameters(), args.learning_rate, alpha=0.99, eps=1e-5)


# --- TRPO (Schulman et al. 2015): the largest step along the natural gradient that keeps KL < 0.01

TARGET_KL, DAMPING, CG_STEPS, LINE_SEARCH_STEPS, SHRINK = 0.01, 0.1, 15, 10, 0.8


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


def flat_gradient(value, params, **kwargs):  # one vector, like parameters_to_vector's
    return torch.cat([g.reshape(-1) for g in torch.autograd.grad(value, params, **kwargs)])


def trpo_actor(agent, batch):
    """The actor's step: changes its parameters, unless no step is accepted. Returns metrics to log.

    The KL divergence is KL(new policy || old policy), averaged over observations and, as in
    sb3-contrib, over action dimensions.
    """
    obs, actions, old_logprobs, advantages, *_ = batch
    params = [p for p in (*agent.actor_mean.parameters(), agent.log_std) if p.requires_grad]
    old_params = nn.utils.parameters_to_vector(params).detach()

    with torch.no_grad():
        old_policy = Normal(agent.actor_mean(obs), agent.std())

    def surrogate_and_kl():
        policy = Normal(agent.actor_mean(obs), agent.std())
        ratio = (policy.log_prob(actions).sum(-1) - old_logprobs).exp()
        return (advantages * ratio).mean(), kl_divergence(policy, old_policy).mean()

    before, kl = surrogate_and_kl()
    gradient = flat_gradient(before, params, retain_graph=True)
    kl_gradient = flat_gradient(kl, params, create_graph=True)

    def product(vector):  # of the Fisher matrix, the Hessian of the KL divergence, and a vector
        return flat_gradient(kl_gradient @ vector, params, retain_graph=True) + DAMPING * vector

    direction = conjugate_gradient(product, gradient)
    longest = (2 * TARGET_KL / (direction @ product(direction))).sqrt()
    with torch.no_grad():
        for i in range(LINE_SEARCH_STEPS):
            step = SHRINK**i * longest * direction
            nn.utils.vector_to_parameters(old_params + step, params)
            after, kl = surrogate_and_kl()
            if kl < TARGET_KL and after > before:
                return {"policy_loss": -after, "approx_kl": kl, "line_search_steps": i + 1}
        nn.utils.vector_to_parameters(old_params, params)
    return {"policy_loss": -before.detach(), "approx_kl": 0, "line_search_steps": LINE_SEARCH_STEPS}


def critic_loss(agent, minibatch, args):
    """The loss of the critic alone. Other parameters get zero gradients, so Adam keeps them."""
    obs, _, _, _, returns, _ = minibatch
    loss = ((returns - agent.critic(obs).squeeze(-1)) ** 2).mean()
    return loss, {"value_loss": loss}


def trpo_learn(agent, optimizer, batch, backward, args):
    """In place of ppo.learn: a step of the actor on the whole batch, then epochs of the critic."""
    obs, actions, logprobs, advantages, *rest = batch
    if args.normalize_advantage:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    metrics = trpo_actor(agent, (obs, actions, logprobs, advantages, *rest))
    return ppo.learn(agent, optimizer, batch, backward, args) | metrics


# --- gSDE (Raffin et al. 2021): noise that is a function of the state, one function per rollout


class GSDEAgent(ppo.Agent):
    """Its noise is h(s) W, with h the actor's last hidden layer and W ~ N(0, exp(log_std)^2)."""

    def __init__(self, obs_dim, action_dim):
        super().__init__(obs_dim, action_dim)
        self.log_std = nn.Parameter(torch.zeros(self.actor_mean[-1].in_features, action_dim))

    def forward(self, obs, actions):
        """As in Agent. The density is that of actions in this state, over all W."""
        hidden = self.actor_mean[:-1](obs)
        mean = self.actor_mean[-1](hidden)
        variance = hidden.detach() ** 2 @ self.std() ** 2  # detach: it trains log_std only
        policy = Normal(mean, (variance + 1e-6).sqrt(), validate_args=False)
        logprobs, entropy = policy.log_prob(actions).sum(-1), policy.entropy().sum(-1).mean()
        return logprobs, entropy, self.critic(obs).squeeze(-1)


def gsde_exploration(agent, noise, args):
    """In place of ppo.exploration: a matrix W, (64, action_dim), per environment and rollout."""
    weights = torch.randn(args.n_envs, *agent.log_std.shape) * agent.std().detach().cpu()
    weights, hidden = weights.numpy(), ppo.numpy_policy(agent.actor_mean[:-1])
    mean = ppo.numpy_policy(agent.actor_mean[-1:])  # of the hidden layer

    def act(obs, t):
        h = hidden(obs)
        return mean(h) + (h[:, None, :] @ weights)[:, 0]

    return act


# --- What each method replaces, its defaults, and the script's flags that do not apply

METHODS = {
    "a2c": dict(
        replaces=dict(loss=a2c_loss, make_optimizer=a2c_optimizer),
        defaults=dict(
            n_steps=5, learning_rate=7e-4, gae_lambda=1.0, normalize_advantage=False, n_epochs=1
        ),
        lacks=["batch-size", "n-epochs", "clip-range", "normalize-advantage"],
    ),
    "trpo": dict(
        replaces=dict(learn=trpo_learn, loss=critic_loss),
        defaults=dict(learning_rate=1e-3, max_grad_norm=1e9),  # of the critic: no clipping
        lacks=["clip-range", "ent-coef", "vf-coef", "max-grad-norm"],
    ),
    "gsde": dict(
        replaces=dict(make_agent=GSDEAgent, exploration=gsde_exploration),
        defaults={},
        lacks=["beta", "vanilla", "noise-seq-len"],
    ),
}


def main(argv):
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.usage = "python -m study.methods METHOD [flags of ppo_colored_continuous.py]"
    parser.add_argument("method", choices=METHODS)
    name = parser.parse_args(argv[:1]).method
    method, flags = METHODS[name], argv[1:]
    for flag in method["lacks"]:
        if any(word.split("=")[0] in (f"--{flag}", f"--no-{flag}") for word in flags):
            parser.error(f"{name} has no --{flag}")
    args = ppo.parse_args(flags, method=name, exp_name=name, **method["defaults"])
    if name == "a2c":
        args.batch_size = args.n_envs * args.n_steps  # one step on the whole batch
    ppo.main(args, **method["replaces"])


if __name__ == "__main__":
    main(sys.argv[1:])
