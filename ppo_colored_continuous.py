"""Proximal Policy Optimization (PPO) with colored noise, for continuous actions, in one file.

Hollenstein, Martius, Piater: "Colored Noise in PPO: Improved Exploration and Performance through
Correlated Action Sampling", AAAI 2024. PPO draws its actions as mean + std * eps with white noise
eps; here eps is temporally correlated 1/f^beta noise. Look for "These lines are the paper".
Everything else is PPO as Stable-Baselines3 has it.

    python ppo_colored_continuous.py --env-id MountainCarContinuous-v0 --beta 0.5

To change the method, edit this file. main() at its end reads as the method does.
"""

import argparse
import math
import os
import signal
import sys

if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"  # for these small networks more threads are slower
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while loading: no traceback
    if sys.stdout.isatty():
        print("loading PyTorch and the environments ...")

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import environments
import run_files
from colored_noise import ColoredNoiseProcess, projected_beta
from run_files import RunFolder, fail, make_seeds, stop_if_asked


def parse_args(argv=None, **defaults):
    """Reads the command line, or the list argv. The result is read-only, see run_files.Args."""
    flag = argparse.BooleanOptionalAction
    parser = run_files.ArgumentParser(description="PPO with colored noise, as in the paper.")
    add = parser.add_argument_group("experiment").add_argument
    add("--env-id", default="MountainCarContinuous-v0", help="such as dm_control/walker-run-v0")
    add("--seed", type="whole", default=1, help="seeds everything random")
    add("--total-timesteps", type="count", default=2_048_000, help="of all environments together")
    add("--eval-freq", type="count", default=10_240, help="environment steps between evaluations")
    add("--eval-episodes", type="count", default=50, help="episodes per evaluation, in parallel")
    add("--eval-once-per-policy", action=flag, default=False, help="one policy is not played anew")
    add = parser.add_argument_group("environment").add_argument
    add("--env-kwargs", type="key_value", nargs="+", action="extend", help="key=value of its own")
    add("--max-episode-steps", type="count", help="a time limit in place of the environment's own")
    add("--rescale-actions", action=flag, default=False, help="[-1, 1] stands for its bounds")
    add("--normalize-obs", action=flag, default=False, help="by their running mean and std")
    add("--normalize-rewards", action=flag, default=False, help="by the std of discounted returns")
    add = parser.add_argument_group("colored noise").add_argument
    add("--beta", type="real_or_auto", nargs="+", default=[0.5], help="0 white, 1 pink, 2 red; one "
        "number for all action dimensions, or one for each; auto: from n_envs")  # fmt: skip
    add("--noise-seq-len", type="at_least_2", default=1000, help="T, steps until new sequences")
    add("--vanilla", action="store_true", help="white noise from torch, as in ordinary PPO")
    add = parser.add_argument_group("PPO").add_argument
    add("--n-envs", type="count", default=4, help="parallel environments")
    add("--n-steps", type="count", default=2048, help="steps per environment and update")
    add("--batch-size", type="count", default=128, help="steps per minibatch")
    add("--n-epochs", type="count", default=10, help="passes over the data per update")
    add("--learning-rate", type="positive", default=2.5e-4, help="of Adam")
    add("--anneal-lr", action=flag, default=False, help="lower the learning rate linearly to 0")
    add("--gamma", type="fraction", default=0.99, help="discount factor")
    add("--gae-lambda", type="fraction", default=0.95, help="of generalized advantage estimation")
    add("--clip-range", type="positive", default=0.2, help="bound on the ratio's change")
    add("--normalize-advantage", action=flag, default=True, help="to mean 0, std 1 per minibatch")
    add("--ent-coef", type="real", default=0.0, help="weight of the entropy bonus")
    add("--vf-coef", type="real", default=0.5, help="weight of the value loss")
    add("--max-grad-norm", type="positive", default=0.5, help="bound on the norm of the gradient")
    add("--bootstrap-timeouts", action=flag, default=True, help="add gamma * V(obs) at time limits")
    add = parser.add_argument_group("running").add_argument
    add("--envpool", action=flag, help="environments in C++; by default where EnvPool has the task")
    add("--threads", type="count", default=run_files.n_cores(), help="of evaluation and EnvPool")
    add("--compile", action=flag, default=True, help="compile the update: 15 seconds, once")
    add("--device", default="cpu", help="torch device of the networks: cpu, cuda, cuda:1")
    add("--exp-name", default="ppo_colored_continuous", help="the experiment, a folder's name")
    add("--runs-dir", default="runs", help="folder of all runs")
    add("--resume", action="store_true", help="continue the run from its last checkpoint")
    add("--overwrite", action="store_true", help="start again where the folder holds a run")
    add("--capture-video", action="store_true", help="of every tenth evaluation and the last")
    add("--track", action="store_true", help="log to Weights & Biases too (pip install wandb)")
    parser.set_defaults(**{"method": "ppo", **defaults})
    args = parser.parse_args(argv)

    if args.eval_freq > args.total_timesteps:
        parser.error(f"no evaluation: --eval-freq {args.eval_freq} is over --total-timesteps")
    if args.resume and args.overwrite:
        parser.error("--resume continues a run and --overwrite starts it again: choose one")
    args.env_kwargs = dict(args.env_kwargs) if args.env_kwargs else None
    args.beta_auto = args.beta == ["auto"]
    if args.beta_auto:
        args.beta = [projected_beta(args.n_envs, args.n_steps, args.noise_seq_len)]
        print(f"--beta auto is {args.beta[0]:.3g} here")
    if "auto" in args.beta:
        parser.error("--beta auto is one number for all action dimensions")
    if args.envpool is None:  # a run that is there keeps what it has
        args.envpool = run_files.recorded(args, "envpool", environments.envpool_suits(args))
    run_files.check_device(args.device)
    return run_files.Args(**vars(args))


# --- The networks


def layer_init(layer, gain=2**0.5):
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Separate actor and critic of 64-64 tanh units, and a log std that is the same in all states.

    Any layers but BatchNorm will do. actor_mean and log_std alone act; forward() is for learning.
    """

    def __init__(self, obs_dim, action_dim):
        super().__init__()

        def mlp(out_dim, gain):
            return nn.Sequential(
                *(layer_init(nn.Linear(obs_dim, 64)), nn.Tanh()),
                *(layer_init(nn.Linear(64, 64)), nn.Tanh()),
                layer_init(nn.Linear(64, out_dim), gain),
            )

        self.actor_mean = mlp(action_dim, gain=0.01)  # first actions near 0, whatever is observed
        self.critic = mlp(1, gain=1.0)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, obs, actions):
        """obs (batch, obs_dim), actions (batch, action_dim).

        Returns logprobs (batch,), entropy () and values (batch,).
        """
        # The density of a single step. That eps is correlated over time does not enter: each eps is
        # still Gaussian by itself, and PPO's objective is made of single steps (docs/lesson.md).
        # Mean and std are those of exploration(): what changes them here has to change them there.
        z = (actions - self.actor_mean(obs)) / self.log_std.exp()
        logprobs = (-0.5 * z**2 - self.log_std - 0.5 * math.log(2 * math.pi)).sum(-1)
        entropy = (0.5 + 0.5 * math.log(2 * math.pi) + self.log_std).sum()
        return logprobs, entropy, self.critic(obs).squeeze(-1)

    def unflatten(self, params):
        """Parameters by name, views of the flat `params`; a shared one once: tie_weights=False."""
        named = dict(self.named_parameters())
        pieces = params.split([p.numel() for p in named.values()])
        return {name: x.view(named[name].shape) for name, x in zip(named, pieces, strict=True)}


# --- Collecting


def exploration(agent, noise, args):
    """Returns act(obs (n_envs, obs_dim), t) -> actions (n_envs, action_dim), for one rollout."""
    policy = run_files.numpy_policy(agent.actor_mean)
    std = agent.log_std.exp().cpu().numpy()
    shape = (args.n_steps, args.n_envs, len(std))
    # These lines are the paper: noise that is correlated over time, in place of white noise (Eq. 2)
    eps = (torch.randn(shape) if args.vanilla else noise.sample(args.n_steps)).numpy()
    return lambda obs, t: policy(obs) + std * eps[t]


def collect(agent, act, envs, storage, running, args, bar):
    """Takes n_steps in each environment, going on from the last obs, and makes a batch of them.

    storage: arrays obs (n_steps + 1, n_envs, obs_dim), actions (n_steps, n_envs, action_dim),
    rewards and dones (n_steps, n_envs). running: (2, n_envs), return and length so far of each
    environment's episode. Both are brought up to date. Returns the batch, (obs, actions, logprobs,
    advantages, returns, values), each of n_steps * n_envs rows, and the (return, length) of every
    episode that ended.
    """
    obs, actions, rewards, dones = storage
    space, timeouts, episodes = envs.single_action_space, [], []
    obs[0] = obs[-1]
    for t in range(args.n_steps):
        stop_if_asked()
        actions[t] = act(obs[t], t)
        # The environment gets the clipped action. The one stored, to learn from, is the unclipped:
        # its log-probability is a Gaussian's, that of the clipped one is not.
        clipped = np.clip(actions[t], space.low, space.high)
        obs[t + 1], rewards[t], terminated, truncated, infos = envs.step(clipped)
        dones[t] = terminated | truncated
        running[0] += infos.get("raw_rewards", rewards[t])
        running[1] += 1
        for i in np.flatnonzero(dones[t]):
            episodes.append(running[:, i].tolist())
            running[:, i] = 0
            if not terminated[i]:
                timeouts.append((t, i, infos["final_obs"][i]))
        bar.update(args.n_envs)
    run_files.check_finite(args, bar.n, observation=obs[1:], action=actions, reward=rewards)

    # Only the mean action is needed to act. The log-probabilities and values are computed here, for
    # all steps in one go: much quicker than one by one, and the same, as nothing has learned since.
    batch_obs = torch.as_tensor(obs[:-1], device=args.device).flatten(0, 1)
    batch_actions = torch.as_tensor(actions, device=args.device).flatten(0, 1)
    logprobs, _, values = agent(batch_obs, batch_actions)
    last_obs = torch.as_tensor(obs[-1], device=args.device)
    last_values = agent.critic(last_obs).squeeze(-1).cpu().numpy()
    if args.bootstrap_timeouts and timeouts:
        # A time limit is not the end of the task: the episode would have gone on from its final
        # observation, and what would have followed is worth V(final observation).
        steps, indices, final_obs = zip(*timeouts, strict=True)
        final_obs = torch.as_tensor(np.stack(final_obs), device=args.device)
        rewards[steps, indices] += args.gamma * agent.critic(final_obs).squeeze(-1).cpu().numpy()
    values_2d = values.view(rewards.shape).cpu().numpy()
    targets = compute_gae(rewards, values_2d, dones, last_values, args.gamma, args.gae_lambda)
    advantages, returns = (torch.as_tensor(x, device=args.device).flatten() for x in targets)
    return (batch_obs, batch_actions, logprobs, advantages, returns, values), episodes


def compute_gae(rewards, values, dones, last_values, gamma, gae_lambda):
    """Generalized advantage estimation (Schulman et al. 2016).

    rewards, values, dones: (n_steps, n_envs), done where the step ended an episode. last_values:
    (n_envs,), of the observations after the last step. Returns advantages, returns: like rewards.
    """
    next_values = np.concatenate([values[1:], last_values[None]])
    running = 1 - dones.astype(np.float32)
    deltas = rewards + gamma * running * next_values - values
    decays = gamma * gae_lambda * running
    advantages, advantage = np.empty_like(deltas), 0.0
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decays[t] * advantage
    return advantages, advantages + values


# --- Learning


def ppo_loss(params, minibatch, agent, args):
    """PPO's clipped objective (Schulman et al. 2017), as a function of the flat parameter vector.

    minibatch: obs (batch, obs_dim), actions (batch, action_dim), logprobs, advantages, returns and
    values (batch,). Returns the loss and a dict of what is to be logged.
    """
    obs, actions, old_logprobs, advantages, returns, _ = minibatch
    call, named = torch.func.functional_call, agent.unflatten(params)
    logprobs, entropy, values = call(agent, named, (obs, actions), tie_weights=False)
    if args.normalize_advantage and len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    log_ratio = logprobs - old_logprobs
    ratio = log_ratio.exp()
    clipped_ratio = ratio.clamp(1 - args.clip_range, 1 + args.clip_range)
    policy_loss = -torch.min(advantages * ratio, advantages * clipped_ratio).mean()
    value_loss = ((returns - values) ** 2).mean()
    loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy

    approx_kl = (ratio - 1 - log_ratio).mean()  # http://joschu.net/blog/kl-approx.html
    clip_fraction = ((ratio - 1).abs() > args.clip_range).float().mean()
    metrics = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    return loss, metrics | {"approx_kl": approx_kl, "clip_fraction": clip_fraction}


def adam(params, grads, optimizer, learning_rate):
    """A step of Adam (Kingma & Ba 2015), with PyTorch's place for eps. Returns params, optimizer.

    params, grads: flat vectors. optimizer: (exp_avg, exp_avg_sq, step), two vectors and a scalar.
    """
    exp_avg, exp_avg_sq, step = optimizer
    step = step + 1
    exp_avg = 0.9 * exp_avg + 0.1 * grads
    exp_avg_sq = 0.999 * exp_avg_sq + 0.001 * grads**2
    denominator = (exp_avg_sq / (1 - 0.999**step)).sqrt() + 1e-5
    params = params - learning_rate * (exp_avg / (1 - 0.9**step)) / denominator
    return params, (exp_avg, exp_avg_sq, step)


def ppo_update(params, optimizer, minibatch, learning_rate, agent, args):
    """One minibatch's step. Returns params, optimizer and metrics; changes nothing in place.

    What may change during training has to be an argument and a tensor: other values are constants
    of the compiled graph, and new ones mean compiling anew. All parameters are one flat vector:
    clipping and Adam then are a few operations in all, not a few for each of 13 parameters.
    """
    grads, metrics = torch.func.grad(ppo_loss, has_aux=True)(params, minibatch, agent, args)
    grads = grads * (args.max_grad_norm / (grads.norm() + 1e-6)).clamp(max=1.0)
    params, optimizer = adam(params, grads, optimizer, learning_rate)
    return params, optimizer, metrics


def learn(agent, optimizer, batch, learning_rate, update, args):
    """Several epochs of minibatches; moves the agent's parameters.

    Returns the optimizer's new state, and the metrics averaged over the minibatches.
    """
    params = nn.utils.parameters_to_vector(agent.parameters())
    learning_rate = torch.tensor(learning_rate, dtype=torch.float64, device=args.device)
    all_metrics = []
    for _ in range(args.n_epochs):
        permutation = torch.randperm(len(batch[0])).to(args.device)
        for minibatch in zip(*(x[permutation].split(args.batch_size) for x in batch), strict=True):
            stop_if_asked()
            params, optimizer, metrics = update(
                params, optimizer, minibatch, learning_rate, agent, args
            )
            all_metrics.append(metrics)
    nn.utils.vector_to_parameters(params, agent.parameters())
    means = {name: torch.stack([m[name] for m in all_metrics]).mean() for name in all_metrics[0]}
    return optimizer, means


# --- Evaluating


@environments.preserved_generators()  # evaluations must not change what training draws
def evaluate(policy, envs, seeds, max_steps=10_000):
    """Plays one episode of the policy in each environment: returns and lengths, (n_envs,) each.

    Returns are undiscounted. An environment whose episode has ended steps on until the longest has:
    what it does then is not counted. Gives up where an episode takes more than max_steps.
    """
    space, (obs, _) = envs.single_action_space, envs.reset(seed=seeds)
    returns, lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs)
    running = np.ones(envs.num_envs, dtype=bool)
    for _ in range(max_steps):
        stop_if_asked()
        actions = np.clip(policy(obs), space.low, space.high)
        obs, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * running
        lengths += running
        running &= ~(terminated | truncated)
        if not running.any():
            return returns, lengths
    fail(f"no end of an episode after {max_steps} steps: --max-episode-steps N sets the limit")


# --- The whole run


def main(args, make_agent=Agent, exploration=exploration, learn=learn, update=ppo_update):
    """Trains and evaluates as `args` say. The other arguments are what another method replaces."""
    run_files.prepare_torch()
    # Everything that can fail comes first, before run.start() touches anything of an earlier run
    with run_files.one_line_for(gym.error.Error):
        envs, eval_envs, video_env, normalization = environments.make_envs(args)
    obs_dim = envs.single_observation_space.shape[0]
    action_dim = math.prod(envs.single_action_space.shape)
    if len(args.beta) not in (1, action_dim):
        fail(f"--beta has {len(args.beta)} values, {args.env_id} {action_dim} action dimensions", 2)
    run = RunFolder(args)
    if run.summary:
        return print(f"complete: final return {run.summary['final_return']:.4g} in {run.path} "
                     "(--overwrite runs it again)")  # fmt: skip
    init_seed, noise_seed = make_seeds(2, args.seed, 0)
    torch.manual_seed(init_seed)
    agent = run_files.learnable(make_agent(obs_dim, action_dim)).to(args.device)
    with run_files.one_line_for(MemoryError, RuntimeError, because="not enough memory: "):
        size, shape = (args.n_envs, action_dim, args.noise_seq_len), (args.n_steps, args.n_envs)
        noise = ColoredNoiseProcess(args.beta, *size, noise_seed)
        obs = np.zeros((args.n_steps + 1, args.n_envs, obs_dim), np.float32)  # and the next one
        actions = np.zeros((*shape, action_dim), np.float32)
        storage = obs, actions, np.zeros(shape, np.float32), np.zeros(shape, bool)
    params = nn.utils.parameters_to_vector(agent.parameters())
    step = torch.zeros((), dtype=torch.float64, device=args.device)
    optimizer = (torch.zeros_like(params), torch.zeros_like(params), step)
    update = run_files.compiled(update) if args.compile else update

    global_step, next_eval, episodes = 0, args.eval_freq, []
    if run.checkpoint:
        with run.one_line_if_it_does_not_fit():  # after an edit, say
            agent.load_state_dict(run.checkpoint["agent"])
            normalization.load_state_dict(run.checkpoint.get("normalization", {}))
            optimizer = run_files.refilled(optimizer, run.checkpoint["optimizer"])
            noise.load_state_dict(run.checkpoint["noise"])
            torch.set_rng_state(run.checkpoint["torch_rng"])
        global_step, next_eval = run.checkpoint["global_step"], run.checkpoint["next_eval"]
    # The state of environments cannot be saved in general: after a resume they begin new episodes
    environments.seed_global_generators(make_seeds(2, args.seed, 3, global_step))
    obs[-1], _ = envs.reset(seed=make_seeds(args.n_envs, args.seed, 1, global_step))
    running, limit = np.zeros((2, args.n_envs)), args.max_episode_steps or 10_000
    steps_per_update = args.n_steps * args.n_envs
    total = math.ceil(args.total_timesteps / steps_per_update) * steps_per_update
    run.start(global_step, obs_dim=obs_dim, action_dim=action_dim)

    with run, run_files.progress_bar(total, global_step) as bar:
        while True:
            # Evaluate at every multiple of eval_freq at which this policy is the one that acts
            returns = None
            acting = {"agent": agent.state_dict(), "normalization": normalization.state_dict()}
            while next_eval <= min(global_step + steps_per_update - 1, args.total_timesteps):
                if returns is None or not args.eval_once_per_policy:
                    policy = run_files.numpy_policy(agent.actor_mean)
                    seeds = make_seeds(args.eval_episodes, args.seed, 2, next_eval)
                    returns, lengths = evaluate(policy, eval_envs, seeds, limit)
                run.add_evaluation(next_eval, returns, lengths, acting)
                bar.set_postfix_str(f"last evaluation {returns.mean():.4g}", refresh=False)
                if video_env and run.is_video_due(next_eval):
                    path = run.path / "videos" / f"step_{next_eval}.mp4"
                    environments.record_video(video_env, policy, path, seeds[0])
                next_eval += args.eval_freq
            state = {**acting, "optimizer": optimizer, "next_eval": next_eval}
            state |= {"noise": noise.state_dict(), "torch_rng": torch.get_rng_state()}
            run.keep(state, global_step, write=returns is not None or global_step == total)
            if global_step == total:
                break

            # Collect a batch, and learn from it
            act = exploration(agent, noise, args)
            batch, ended = collect(agent, act, envs, storage, running, args, bar)
            learning_rate = args.learning_rate * (1 - global_step / total if args.anneal_lr else 1)
            optimizer, metrics = learn(agent, optimizer, batch, learning_rate, update, args)
            run_files.check_learned(agent)
            global_step += steps_per_update

            # Write it down
            episodes += ended
            if run.is_log_due(global_step):
                *_, returns, values = batch
                unexplained = (returns - values).var() / returns.var().clamp(min=1e-12)
                metrics |= {"explained_variance": 1 - unexplained, "learning_rate": learning_rate}
                run.log(global_step, {f"losses/{name}": float(x) for name, x in metrics.items()})
                run.log_rollout(global_step, episodes, {"std": agent.log_std.exp().mean().item()})
                episodes = []

    run.finish(global_step)


if __name__ == "__main__":
    environments.silence()
    run_files.catch_signals()
    main(parse_args())
