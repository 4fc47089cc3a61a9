"""Proximal Policy Optimization (PPO) with colored noise, for continuous actions, in one file.

Hollenstein, Martius, Piater: "Colored Noise in PPO: Improved Exploration and Performance through Correlated Action
Sampling", AAAI 2024. PPO draws its actions as mean + std * eps with white noise eps; here eps is temporally correlated
1/f^beta noise. Look for "This line is the paper". Everything else is PPO as Stable-Baselines3 has it.

    python ppo_colored_continuous.py --env-id MountainCarContinuous-v0 --beta 0.5
"""

import argparse
import math
import os
import signal
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"  # for these small networks more threads are slower

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from colored_noise import ColoredNoiseProcess
from environments import make_render_env, make_vector_env, record_video, silence
from run_files import RunFolder, fail

torch.set_num_threads(1)


def number(kind, valid, description):
    """An argparse type: a finite int (1e6 is one) or float for which valid(number) holds."""

    def parse(text):
        try:
            value = kind(float(text))
            if value == float(text) and math.isfinite(value) and valid(value):
                return value
        except (ValueError, OverflowError):
            pass
        raise argparse.ArgumentTypeError(f"{text} is not {description}")

    return parse


def parse_args():
    count = number(int, lambda x: x >= 1, "a positive whole number")
    positive = number(float, lambda x: x > 0, "a positive number")
    fraction = number(float, lambda x: 0 <= x <= 1, "between 0 and 1")
    real = number(float, lambda x: True, "a finite number")
    flag = argparse.BooleanOptionalAction
    parser = argparse.ArgumentParser(
        description="PPO with colored noise. The defaults are the paper's.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        allow_abbrev=False,
    )
    parser.error = lambda message: fail(f"{message} (--help lists all arguments)", code=2)

    add = parser.add_argument_group("experiment").add_argument
    add("--env-id", default="MountainCarContinuous-v0", help="environment, such as dm_control/pendulum-swingup-v0")
    add("--seed", type=number(int, lambda x: x >= 0, "a whole number >= 0"), default=1, help="seeds everything random")
    add("--total-timesteps", type=count, default=2_048_000, help="environment steps of training, over all environments")
    add("--eval-freq", type=count, default=10_240, help="environment steps between evaluations")
    add("--eval-episodes", type=count, default=50, help="episodes per evaluation, one in each of as many environments")
    add = parser.add_argument_group("colored noise").add_argument
    add("--beta", type=real, nargs="+", default=[0.5], help="0 white, 1 pink, 2 red; one, or one per action dimension")
    add("--noise-seq-len", type=number(int, lambda x: x >= 2, "a whole number >= 2"), default=1000,
        help="T, steps until new noise sequences are drawn")  # fmt: skip
    add("--vanilla", action="store_true", help="white noise from torch's own generator, as in ordinary PPO")
    add = parser.add_argument_group("PPO").add_argument
    add("--n-envs", type=count, default=4, help="parallel environments")
    add("--n-steps", type=count, default=2048, help="steps per environment and update")
    add("--batch-size", type=count, default=128, help="steps per minibatch")
    add("--n-epochs", type=count, default=10, help="passes over the data per update")
    add("--learning-rate", type=positive, default=2.5e-4, help="of Adam, constant")
    add("--gamma", type=fraction, default=0.99, help="discount factor")
    add("--gae-lambda", type=fraction, default=0.95, help="lambda of generalized advantage estimation")
    add("--clip-range", type=positive, default=0.2, help="bound on the change of the probability ratio")
    add("--normalize-advantage", action=flag, default=True, help="to mean 0 and std 1 in each minibatch")
    add("--ent-coef", type=real, default=0.0, help="weight of the entropy bonus")
    add("--vf-coef", type=real, default=0.5, help="weight of the value loss")
    add("--max-grad-norm", type=positive, default=0.5, help="bound on the global norm of the gradient")
    add("--bootstrap-timeouts", action=flag, default=True, help="add gamma * V(final observation) at time limits")
    add = parser.add_argument_group("running").add_argument
    add("--envpool", action="store_true", help="take the environments from EnvPool, in C++, where it has them")
    add("--compile", action=flag, default=True, help="compile the update; takes half a minute, once per machine")
    add("--device", default="cpu", help="torch device of the networks: cpu, cuda, cuda:1")
    add("--exp-name", default="ppo_colored_continuous", help="name of the experiment, a folder in --runs-dir")
    add("--runs-dir", default="runs", help="folder of all runs")
    add("--resume", action="store_true", help="continue the run from its last checkpoint, if it has one")
    add("--overwrite", action="store_true", help="start again where the run's folder holds a run")
    add("--capture-video", action="store_true", help="record an episode at every tenth evaluation and at the last")
    add("--track", action="store_true", help="log to Weights & Biases as well (pip install wandb)")
    args = parser.parse_args()

    if args.eval_freq > args.total_timesteps:
        parser.error(f"no evaluation: --eval-freq {args.eval_freq} is over --total-timesteps {args.total_timesteps}")
    if args.resume and args.overwrite:
        parser.error("--resume continues a run and --overwrite starts it again: choose one")
    try:
        torch.zeros(1, device=args.device).cpu()
    except (RuntimeError, AssertionError):
        parser.error(f"--device {args.device} is not available here")
    return args


def layer_init(layer, gain=2**0.5):
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Separate actor and critic of 64-64 tanh units, and a log std that does not depend on the state."""

    def __init__(self, obs_dim, action_dim):
        super().__init__()

        def mlp(out_dim, gain):
            return nn.Sequential(
                *(layer_init(nn.Linear(obs_dim, 64)), nn.Tanh()),
                *(layer_init(nn.Linear(64, 64)), nn.Tanh()),
                layer_init(nn.Linear(64, out_dim), gain),
            )

        self.actor_mean = mlp(action_dim, gain=0.01)
        self.critic = mlp(1, gain=1.0)
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(self, obs, actions):
        """obs (batch, obs_dim), actions (batch, action_dim) -> logprobs (batch,), entropy (), values (batch,)."""
        # The density of the single step. That eps is correlated over time does not enter: see the README's questions.
        z = (actions - self.actor_mean(obs)) / self.log_std.exp()
        logprobs = (-0.5 * z**2 - self.log_std - 0.5 * math.log(2 * math.pi)).sum(-1)
        entropy = (0.5 + 0.5 * math.log(2 * math.pi) + self.log_std).sum()
        return logprobs, entropy, self.critic(obs).squeeze(-1)


def compute_gae(rewards, values, dones, last_values, gamma, gae_lambda):
    """Generalized advantage estimation (Schulman et al. 2016).

    rewards, values, dones: (n_steps, n_envs), done where the step ended an episode. last_values: (n_envs,), of the
    observations after the last step. Returns advantages and returns, (n_steps, n_envs).
    """
    next_values = np.concatenate([values[1:], last_values[None]])
    running = 1 - dones.astype(np.float32)
    deltas = rewards + gamma * running * next_values - values
    decays = gamma * gae_lambda * running
    advantages, advantage = np.empty_like(deltas), 0.0
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decays[t] * advantage
    return advantages, advantages + values


def ppo_loss(params, minibatch, agent, args):
    """PPO's clipped objective, as a function of the flat parameter vector.

    minibatch: obs (batch, obs_dim), actions (batch, action_dim), logprobs, advantages, returns (batch,).
    Returns the loss and (policy loss, value loss, entropy, approximate KL, clip fraction).
    """
    named = dict(agent.named_parameters())
    pieces = params.split([p.numel() for p in named.values()])
    named = {name: piece.view(p.shape) for (name, p), piece in zip(named.items(), pieces, strict=True)}

    obs, actions, old_logprobs, advantages, returns = minibatch
    logprobs, entropy, values = torch.func.functional_call(agent, named, (obs, actions))
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
    return loss, torch.stack([policy_loss, value_loss, entropy, approx_kl, clip_fraction])


def make_update(agent, args):
    """Returns update(optimizer, minibatch) -> (optimizer, metrics): one clipped Adam step, free of side effects.

    optimizer: (params, exp_avg, exp_avg_sq, step), three flat vectors and a scalar. As one function of tensors it
    compiles to one graph, without Python between the operations.
    """

    def update(optimizer, minibatch):
        params, exp_avg, exp_avg_sq, step = optimizer
        grads, metrics = torch.func.grad(ppo_loss, has_aux=True)(params, minibatch, agent, args)
        grads = grads * (args.max_grad_norm / (grads.norm() + 1e-6)).clamp(max=1.0)
        # Adam (Kingma & Ba 2015), with PyTorch's place for eps
        step = step + 1
        exp_avg = 0.9 * exp_avg + 0.1 * grads
        exp_avg_sq = 0.999 * exp_avg_sq + 0.001 * grads**2
        denominator = (exp_avg_sq / (1 - 0.999**step)).sqrt() + 1e-5
        params = params - args.learning_rate * (exp_avg / (1 - 0.9**step)) / denominator
        return (params, exp_avg, exp_avg_sq, step), metrics

    return update


def compile_update(update, example):
    """Compiles `update` and tries it on example arguments; returns it as it is, with a notice, where that fails."""
    try:
        # cpp_wrapper calls the kernels from C++ instead of Python: 13 % less time in an update. Without the guards on
        # everything but tensors it is another 12 %; compiled code is then not to be shared with other updates.
        options = {"cpp_wrapper": True, "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe}
        compiled = torch.compile(update, fullgraph=True, dynamic=False, isolate_recompiles=True, options=options)
        compiled(*example)
        return compiled
    except Exception as error:  # no compiler, no Python headers, an unsupported platform, ...
        reason = str(error).strip().split("\n")[0][:120]
        print(f"note: going on without torch.compile, about 6 times slower in the update ({reason})", file=sys.stderr)
        return update


def evaluate(policy, envs, seeds):
    """Plays one episode of the policy in each environment; returns undiscounted returns and lengths, (n_envs,) each.

    An environment whose episode has ended steps on until the longest has: what it does then is not counted.
    """
    obs, _ = envs.reset(seed=seeds)
    returns, lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs)
    running = np.ones(envs.num_envs, dtype=bool)
    while running.any():
        obs, rewards, terminated, truncated, _ = envs.step(policy(obs))
        returns += rewards * running
        lengths += running
        running &= ~(terminated | truncated)
    return returns, lengths


def make_seeds(n, *key):
    """n independent seeds, determined by the integers of the key."""
    return np.random.SeedSequence(key).generate_state(n).tolist()


def main():
    args = parse_args()
    video_env = make_render_env(args.env_id) if args.capture_video else None  # first, as it chooses MuJoCo's renderer
    envs = make_vector_env(args.env_id, args.n_envs, args.envpool)
    obs_dim, action_space = envs.single_observation_space.shape[0], envs.single_action_space
    action_dim = int(np.prod(action_space.shape))
    low, high = action_space.low.reshape(-1), action_space.high.reshape(-1)
    if len(args.beta) not in (1, action_dim):
        fail(f"--beta has {len(args.beta)} values, but {args.env_id} has {action_dim} action dimensions", code=2)
    run = RunFolder(vars(args), {"obs_dim": obs_dim, "action_dim": action_dim})
    if run.summary:
        print(f"complete: final return {run.summary['final_return']:.4g} in {run.path} (--overwrite runs it again)")
        return
    eval_envs = make_vector_env(args.env_id, args.eval_episodes, args.envpool)

    init_seed, noise_seed = make_seeds(2, args.seed, 0)
    torch.manual_seed(init_seed)
    noise = ColoredNoiseProcess(args.beta, args.n_envs, action_dim, args.noise_seq_len, noise_seed)
    agent = Agent(obs_dim, action_dim).to(args.device).requires_grad_(False)
    params = nn.utils.parameters_to_vector(agent.parameters())
    optimizer = (params, torch.zeros_like(params), torch.zeros_like(params), params.new_zeros((), dtype=torch.float64))
    global_step, next_eval, earlier_seconds = 0, args.eval_freq, 0.0
    if run.checkpoint:
        optimizer = tuple(x.to(args.device) for x in run.checkpoint["optimizer"])
        noise.load_state_dict(run.checkpoint["noise"])
        torch.set_rng_state(run.checkpoint["torch_rng"])
        global_step, next_eval = run.checkpoint["global_step"], run.checkpoint["next_eval"]
        earlier_seconds = run.checkpoint["wall_seconds"]
    nn.utils.vector_to_parameters(optimizer[0], agent.parameters())

    def to_tensor(array):
        return torch.as_tensor(array, device=args.device)

    def mean_action(obs):  # (n, obs_dim) -> (n, action_dim); numpy takes a fourth of torch's time for so few rows
        for weight, bias in actor_layers[:-1]:
            obs = np.tanh(obs @ weight + bias)
        return obs @ actor_layers[-1][0] + actor_layers[-1][1]

    def to_env(actions):  # (n, action_dim) -> (n, *shape of the action space), clipped to its bounds
        return np.clip(actions, low, high).reshape(-1, *action_space.shape)

    def policy(obs):  # the deterministic policy that is evaluated
        return to_env(mean_action(obs))

    start_time = update_time = time.time()
    steps_per_update = args.n_steps * args.n_envs
    update = make_update(agent, args)
    if args.compile:
        rows = min(args.batch_size, steps_per_update)
        shapes = [(rows, obs_dim), (rows, action_dim), (rows,), (rows,), (rows,)]
        example = tuple(to_tensor(np.zeros(shape, np.float32)) for shape in shapes)
        update = compile_update(update, (optimizer, example))

    obs = np.zeros((args.n_steps, args.n_envs, obs_dim), np.float32)
    actions = np.zeros((args.n_steps, args.n_envs, action_dim), np.float32)
    rewards = np.zeros((args.n_steps, args.n_envs), np.float32)
    dones = np.zeros((args.n_steps, args.n_envs), bool)
    next_obs, _ = envs.reset(seed=make_seeds(args.n_envs, args.seed, 1, global_step))
    episode_return, episode_length = np.zeros(args.n_envs), np.zeros(args.n_envs)
    total = math.ceil(args.total_timesteps / steps_per_update) * steps_per_update
    interval = 0.5 if sys.stderr.isatty() else 60

    with tqdm(total=total, initial=global_step, unit=" steps", unit_scale=True, mininterval=interval) as bar:
        while True:
            actor_layers = [[p.cpu().numpy().T.copy() for p in layer.parameters()] for layer in agent.actor_mean[::2]]

            # Evaluate at every multiple of eval_freq at which this policy is the one that acts
            while next_eval <= min(global_step + steps_per_update - 1, args.total_timesteps):
                seeds = make_seeds(args.eval_episodes, args.seed, 2, next_eval)
                returns, lengths = evaluate(policy, eval_envs, seeds)
                run.add_evaluation(next_eval, returns, lengths)
                bar.set_postfix_str(f"last evaluation {returns.mean():.4g}", refresh=False)
                is_last = next_eval + args.eval_freq > args.total_timesteps
                if video_env and (is_last or next_eval // args.eval_freq % 10 == 0):
                    record_video(video_env, policy, run.path / "videos" / f"step_{next_eval}.mp4", seeds[0])
                next_eval += args.eval_freq
            wall_seconds = earlier_seconds + time.time() - start_time
            counters = dict(global_step=global_step, next_eval=next_eval, wall_seconds=wall_seconds)
            random_state = dict(noise=noise.state_dict(), torch_rng=torch.get_rng_state())
            run.save_checkpoint({"optimizer": optimizer, **counters, **random_state})
            if global_step >= args.total_timesteps:
                break

            # Collect n_steps in each environment
            shape = (args.n_steps, args.n_envs, action_dim)
            # This line is the paper: noise that is correlated over time, in place of white noise
            eps = torch.randn(shape) if args.vanilla else noise.sample(args.n_steps)
            eps, std = eps.numpy(), agent.log_std.exp().cpu().numpy()
            timeouts, episodes = [], []
            for t in range(args.n_steps):
                obs[t] = next_obs
                actions[t] = mean_action(next_obs) + std * eps[t]  # Eq. 2
                next_obs, rewards[t], terminated, truncated, infos = envs.step(to_env(actions[t]))
                dones[t] = terminated | truncated
                episode_return += rewards[t]
                episode_length += 1
                for i in np.flatnonzero(dones[t]):
                    if not terminated[i]:
                        timeouts.append((t, i, infos["final_obs"][i]))
                    episodes.append((episode_return[i], episode_length[i]))
                    episode_return[i] = episode_length[i] = 0
                bar.update(args.n_envs)
            global_step += steps_per_update

            # Values, log-probabilities and advantages, for the whole batch at once
            batch_obs, batch_actions = to_tensor(obs.reshape(-1, obs_dim)), to_tensor(actions.reshape(-1, action_dim))
            logprobs, _, values = agent(batch_obs, batch_actions)
            if args.bootstrap_timeouts and timeouts:
                # A time limit is not the end of the task: what would have followed is worth V(final observation)
                steps, indices, final_obs = zip(*timeouts, strict=True)
                final_values = agent.critic(to_tensor(np.stack(final_obs))).squeeze(-1).cpu().numpy()
                rewards[steps, indices] += args.gamma * final_values
            last_values = agent.critic(to_tensor(next_obs)).squeeze(-1).cpu().numpy()
            advantages, returns = compute_gae(
                rewards, values.view(rewards.shape).cpu().numpy(), dones, last_values, args.gamma, args.gae_lambda
            )
            advantages, returns = to_tensor(advantages.reshape(-1)), to_tensor(returns.reshape(-1))

            # Several epochs of minibatches
            batch = (batch_obs, batch_actions, logprobs, advantages, returns)
            metrics = []
            for _ in range(args.n_epochs):
                permutation = torch.randperm(steps_per_update).to(args.device)
                for minibatch in zip(*(x[permutation].split(args.batch_size) for x in batch), strict=True):
                    optimizer, minibatch_metrics = update(optimizer, minibatch)
                    metrics.append(minibatch_metrics)
            if not optimizer[0].isfinite().all():
                fail(f"training diverged before step {global_step}, parameters are not finite: lower --learning-rate")
            nn.utils.vector_to_parameters(optimizer[0], agent.parameters())

            names = ["policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction"]
            scalars = {f"losses/{k}": v for k, v in zip(names, torch.stack(metrics).mean(0).tolist(), strict=True)}
            unexplained = (returns - values).var() / returns.var().clamp(min=1e-12)
            scalars["losses/explained_variance"] = 1 - unexplained.item()
            scalars["rollout/std"] = float(std.mean())
            if episodes:
                scalars["rollout/return_mean"], scalars["rollout/length_mean"] = np.mean(episodes, axis=0).tolist()
            scalars["time/steps_per_second"] = steps_per_update / (time.time() - update_time)
            update_time = time.time()
            run.log(global_step, scalars)

    summary = run.finish(global_step, wall_seconds)
    print(f"performance {summary['performance']:.4g}, final return {summary['final_return']:.4g}, "
          f"{global_step:,} steps in {wall_seconds / 60:.1f} min: {run.path}")  # fmt: skip


def stop(number, _):
    print("\nstopped: the same command with --resume goes on from the last update", file=sys.stderr)
    sys.exit(128 + number)  # 130 after Ctrl-C, 143 after SIGTERM


if __name__ == "__main__":
    silence()
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    try:
        main()
    except gym.error.Error as error:
        fail(error, code=2)
    except OSError as error:
        fail(f"{error}; when that is mended, continue with --resume")
