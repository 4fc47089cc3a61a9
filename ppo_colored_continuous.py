"""Proximal Policy Optimization (PPO) with colored noise, for continuous actions, in one file.

Hollenstein, Martius, Piater: "Colored Noise in PPO: Improved Exploration and Performance through
Correlated Action Sampling", AAAI 2024. PPO draws its actions as mean + std * eps with white noise
eps; here eps is temporally correlated 1/f^beta noise. Look for "These lines are the paper".
Everything else is PPO as Stable-Baselines3 has it.

    python ppo_colored_continuous.py --env-id MountainCarContinuous-v0 --beta 0.5

It needs colored_noise.py and the packages imported below. If the project's folder study/ is next
to it, that adds faster environments, the paper's environments, and normalization.
To change the method, edit this file. Start with main(), at its end.
"""

import argparse
import contextlib
import copy
import functools
import importlib.metadata
import importlib.util
import json
import math
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for these small networks more threads are slower

import filelock
import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from colored_noise import ColoredNoiseProcess, projected_beta

study = None
if importlib.util.find_spec("study"):
    from study import environments as study  # EnvPool, threads, normalization, the paper's tasks


def beta_or_auto(text):
    return text if text == "auto" else float(text)


def parse_args(argv=None, **defaults):
    """Reads the command line, or the list argv; `defaults` override those below."""
    flag = argparse.BooleanOptionalAction
    show_defaults = argparse.ArgumentDefaultsHelpFormatter
    parser = argparse.ArgumentParser(formatter_class=show_defaults, allow_abbrev=False)
    add = parser.add_argument_group("experiment").add_argument
    add("--env-id", default="MountainCarContinuous-v0", help="or dm_control/NAME-v0, MODULE:NAME")
    add("--seed", type=int, default=1, help="seed of all random numbers")
    add("--total-timesteps", type=int, default=2_048_000, help="steps of all environments together")
    add("--eval-freq", type=int, default=10_240, help="steps from one evaluation to the next")
    add("--eval-episodes", type=int, default=50, help="episodes per evaluation, in parallel")
    add("--eval-once-per-policy", action=flag, default=False, help="evaluate each policy only once")
    add = parser.add_argument_group("environment").add_argument
    add("--env-kwargs", type=json.loads, help="its keyword arguments, as in '{\"goal\": [3, 0]}'")
    add("--max-episode-steps", type=int, help="time limit in place of the environment's own")
    add("--rescale-actions", action=flag, default=False, help="map [-1, 1] to the action bounds")
    add("--normalize-obs", action=flag, default=False, help="by the mean and std up to now")
    add("--normalize-rewards", action=flag, default=False, help="by the std of returns up to now")
    add = parser.add_argument_group("colored noise").add_argument
    betas = "0 white, 1 pink, 2 red; one, or one per action dimension; auto: by n_envs * n_steps"
    add("--beta", type=beta_or_auto, nargs="+", default=[0.5], help=betas)
    add("--noise-seq-len", type=int, default=1000, help="T, steps until new sequences are drawn")
    add("--vanilla", action="store_true", help="white noise of torch.randn, as in ordinary PPO")
    add = parser.add_argument_group("PPO").add_argument
    add("--n-envs", type=int, default=4, help="number of parallel environments")
    add("--n-steps", type=int, default=2048, help="steps per environment and update")
    add("--batch-size", type=int, default=128, help="steps per minibatch")
    add("--n-epochs", type=int, default=10, help="passes over the data per update")
    add("--learning-rate", type=float, default=2.5e-4, help="of Adam")
    add("--anneal-lr", action=flag, default=False, help="lower the learning rate linearly to 0")
    add("--gamma", type=float, default=0.99, help="discount factor")
    add("--gae-lambda", type=float, default=0.95, help="of generalized advantage estimation")
    add("--clip-range", type=float, default=0.2, help="of the probability ratio around 1")
    add("--normalize-advantage", action=flag, default=True, help="to mean 0, std 1 per minibatch")
    add("--ent-coef", type=float, default=0.0, help="weight of the entropy bonus")
    add("--vf-coef", type=float, default=0.5, help="weight of the value loss")
    add("--max-grad-norm", type=float, default=0.5, help="longer gradients are scaled down to it")
    add("--bootstrap-timeouts", action=flag, default=True, help="add gamma * V(obs) at time limits")
    running = parser.add_argument_group("running")
    add = running.add_argument
    add("--envpool", action=flag, help="environments in C++; default: if EnvPool has the task")
    add("--threads", type=int, default=os.cpu_count(), help="threads that step environments")
    add("--compile", action=flag, help="compile the loss (10 to 40 s); default: from 100,000 steps")
    add("--device", default="cpu", help="torch device of the networks: cpu, cuda, cuda:1")
    add("--exp-name", default="ppo_colored_continuous", help="the experiment, a folder's name")
    add("--runs-dir", default="runs", help="folder of all runs")
    add("--track", action="store_true", help="log to Weights & Biases too (pip install wandb)")
    add = running.add_mutually_exclusive_group().add_argument
    add("--resume", action="store_true", help="continue the run from its last checkpoint")
    add("--overwrite", action="store_true", help="start again where the folder holds a run")
    parser.set_defaults(**{"method": "ppo", **defaults})  # other methods: study/methods.py
    args = parser.parse_args(argv)

    counts = args.total_timesteps, args.eval_freq, args.eval_episodes
    if min(*counts, args.n_envs, args.n_steps, args.batch_size) < 1:
        parser.error("numbers of steps, episodes and environments must be positive")
    last_evaluation = args.total_timesteps // args.eval_freq * args.eval_freq
    if last_evaluation < args.n_envs * args.n_steps:
        parser.error(f"no update before the last evaluation, at {last_evaluation}: lower --n-steps")
    if study is None and (args.envpool or args.normalize_obs or args.normalize_rewards):
        parser.error("--envpool and --normalize-* need the folder study/ beside this script")
    if args.envpool is None:
        args.envpool = study is not None and study.envpool_suits(args)
    if args.compile is None:
        args.compile = args.total_timesteps >= 100_000
    args.beta_auto = args.beta == ["auto"]
    if args.beta_auto:
        args.beta = [projected_beta(args.n_envs, args.n_steps, args.noise_seq_len)]
    elif "auto" in args.beta:
        parser.error("--beta auto is one value for all action dimensions")
    return args


# --- The networks
def layer_init(layer, gain=2**0.5):
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Separate actor and critic. All layers work but BatchNorm and Dropout, which act differently
    in training. Parameters with requires_grad=False are not learned. Rollout and evaluation call
    actor_mean, std and critic: an edit in forward alone changes no action.
    """

    def __init__(self, obs_dim, action_dim):
        super().__init__()
        self.actor_mean = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, action_dim), gain=0.01),  # first actions are near 0
        )
        self.critic = nn.Sequential(
            layer_init(nn.Linear(obs_dim, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 64)),
            nn.Tanh(),
            layer_init(nn.Linear(64, 1), gain=1.0),
        )
        self.log_std = nn.Parameter(torch.zeros(action_dim))

    def std(self):
        return self.log_std.exp()  # (action_dim,), the same in all states

    def forward(self, obs, actions):
        """obs (n, obs_dim), actions (n, action_dim) -> logprobs (n,), entropy (), values (n,)."""
        # The density of a single step, as if eps were white. Each eps is Gaussian by itself, and
        # PPO's objective is made of single steps. The paper does so, too (docs/lesson.md).
        policy = Normal(self.actor_mean(obs), self.std(), validate_args=False)
        logprobs, entropy = policy.log_prob(actions).sum(-1), policy.entropy().sum(-1).mean()
        return logprobs, entropy, self.critic(obs).squeeze(-1)


def numpy_policy(actor):
    """The module `actor` as a function from numpy to numpy: obs (n, obs_dim) -> (n, action_dim).

    This is for speed only: for networks this small numpy takes 6 us for 4 rows, torch 31. With
    other layers than those below the module itself is called, in eval mode. Either way the weights
    are copied, so call numpy_policy again when the module has learned.
    """
    known = {nn.Linear: lambda x, weight, bias=0: x @ weight + bias}
    known |= {nn.Tanh: np.tanh, nn.ReLU: lambda x: np.maximum(x, 0)}
    layers = list(actor) if type(actor) is nn.Sequential else [actor]
    # Hooks may change weights or outputs in each call, as spectral_norm's do
    hooks = any(m._forward_hooks or m._forward_pre_hooks for m in actor.modules())
    if hooks or not all(type(layer) in known for layer in layers):
        module, device = copy.deepcopy(actor).eval(), next(actor.parameters()).device
        return lambda obs: module(torch.as_tensor(obs, device=device)).detach().cpu().numpy()
    weights = [[p.detach().cpu().numpy().T.copy() for p in m.parameters()] for m in layers]

    def policy(x):
        for layer, parameters in zip(layers, weights, strict=True):
            x = known[type(layer)](x, *parameters)
        return x

    return policy


# --- The environments
def make_env(args, render_mode=None):
    """Makes one environment: obs (obs_dim,) float32, actions (action_dim,).

    Add your wrappers here. EnvPool's environments are not made here: use --no-envpool.
    """
    kwargs = dict(args.env_kwargs or {}) | ({"render_mode": render_mode} if render_mode else {})
    if args.env_id.startswith("dm_control/"):
        import shimmy  # noqa: F401  registers dm_control's ids

        if args.max_episode_steps:  # the task's own limit, in seconds, would come first
            kwargs["task_kwargs"] = {"time_limit": math.inf} | kwargs.get("task_kwargs", {})
    if os.getcwd() not in sys.path:  # where my_env.py of my_env:MyEnv-v0 may be
        sys.path.append(os.getcwd())
    # Gymnasium's checks of the first steps help authors of environments, but take time
    env = gym.make(args.env_id, args.max_episode_steps, disable_env_checker=True, **kwargs)
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or space.dtype.kind != "f":
        raise TypeError(f"{args.env_id} has actions {space}: a vector of real numbers is needed")
    space.seed(args.seed)  # some environments draw from it
    if args.rescale_actions:
        if not space.is_bounded():
            raise ValueError(f"--rescale-actions needs bounds, {args.env_id} has {space}")
        # Clipped, as rounding may leave the bounds
        env = gym.wrappers.TransformAction(env, lambda a: np.clip(a, space.low, space.high), space)
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    env = gym.wrappers.FlattenObservation(env)
    observations = gym.spaces.Box(-np.inf, np.inf, env.observation_space.shape)  # float32
    return gym.wrappers.TransformObservation(env, np.float32, observations)


def make_vector_env(args, n_envs):
    """Makes n_envs environments that step together: obs (n_envs, obs_dim), actions likewise.

    The step that ends an episode returns the first observation of the next one, and the last of the
    ended one in infos["final_obs"] (SAME_STEP). Gymnasium's default would insert a dummy step.
    """
    if args.envpool:
        return study.EnvPoolVectorEnv(args, n_envs)
    if study:
        return study.make_vector_env(args, n_envs, make_env)
    functions, mode = [lambda: make_env(args)] * n_envs, gym.vector.AutoresetMode.SAME_STEP
    # copy=False: obs is one array, overwritten by each step
    return gym.vector.SyncVectorEnv(functions, copy=False, autoreset_mode=mode)


# --- Collecting
def exploration(agent, noise, args):
    """Returns act(obs (n_envs, obs_dim), t) -> actions (n_envs, action_dim), for one rollout.

    You can replace the noise by another object. It needs sample(n_steps), which returns a tensor
    (n_steps, n_envs, action_dim) in which each value by itself is Gaussian with mean 0 and variance
    1 (ours: about 1), and, for checkpoints, state_dict() and load_state_dict(state).
    """
    mean, std = numpy_policy(agent.actor_mean), agent.std().detach().cpu().numpy()
    # These lines are the paper: noise that is correlated over time, in place of white noise (Eq. 2)
    eps = noise.sample(args.n_steps)
    eps = (torch.randn(eps.shape) if args.vanilla else eps).numpy()
    return lambda obs, t: mean(obs) + std * eps[t]


@torch.no_grad()
def collect(agent, act, envs, last_obs, so_far, args, bar):
    """Takes n_steps in each environment, starting from last_obs, and makes a batch of them.

    last_obs: (n_envs, obs_dim). so_far: (2, n_envs), return and length up to now of each
    environment's episode; it is updated. Returns the batch, (obs, actions, logprobs, advantages,
    returns, values), each of n_steps * n_envs rows; the new last_obs; and the (return, length) of
    every episode that ended.
    """
    space, shape, timeouts, episodes = envs.single_action_space, (args.n_steps, args.n_envs), [], []
    obs = np.zeros((args.n_steps + 1, *last_obs.shape), np.float32)
    actions = np.zeros((*shape, *space.shape), np.float32)
    rewards, dones = np.zeros(shape, np.float32), np.zeros(shape, bool)
    obs[0] = last_obs
    for t in range(args.n_steps):
        actions[t] = act(obs[t], t)
        # The environment gets the clipped action. We store the unclipped one: its log-probability
        # is a Gaussian's, that of the clipped one is not.
        clipped = np.clip(actions[t], space.low, space.high)
        obs[t + 1], rewards[t], terminated, truncated, infos = envs.step(clipped)
        dones[t] = terminated | truncated
        so_far[0] += infos.get("raw_rewards", rewards[t])  # before --normalize-rewards
        so_far[1] += 1
        for i in np.flatnonzero(dones[t]):
            episodes.append(so_far[:, i].tolist())
            so_far[:, i] = 0
            if not terminated[i]:
                timeouts.append((t, i, infos["final_obs"][i]))
        bar.update(args.n_envs)
    for name, array in {"observations": obs, "actions": actions, "rewards": rewards}.items():
        if not np.isfinite(array).all():
            raise FloatingPointError(f"{args.env_id}: {name} not finite, before step {bar.n}")

    # Only the mean action is needed to act. The log-probabilities and values are computed here, for
    # all steps in one go: much quicker than one by one, and the same, as nothing has learned since.
    tensor = functools.partial(torch.as_tensor, device=args.device)
    batch_obs, batch_actions = tensor(obs[:-1]).flatten(0, 1), tensor(actions).flatten(0, 1)
    logprobs, _, values = agent(batch_obs, batch_actions)
    last_values = agent.critic(tensor(obs[-1])).squeeze(-1).cpu().numpy()
    if args.bootstrap_timeouts and timeouts:
        # A time limit is not the end of the task: the episode would have gone on from its final
        # observation, and what would have followed is worth V(final observation).
        steps, indices, final_obs = zip(*timeouts, strict=True)
        final_values = agent.critic(tensor(np.stack(final_obs))).squeeze(-1).cpu().numpy()
        rewards[steps, indices] += args.gamma * final_values
    values_2d = values.view(rewards.shape).cpu().numpy()
    targets = compute_gae(rewards, values_2d, dones, last_values, args.gamma, args.gae_lambda)
    advantages, returns = (tensor(x).flatten() for x in targets)
    batch = batch_obs, batch_actions, logprobs, advantages, returns, values
    return batch, obs[-1], episodes


def compute_gae(rewards, values, dones, last_values, gamma, gae_lambda):
    """Generalized advantage estimation (Schulman et al. 2016).

    rewards, values, dones: (n_steps, n_envs), done where the step ended an episode. last_values:
    (n_envs,), of the observations after the last step. Returns advantages, returns: like rewards.
    """
    next_values = np.concatenate([values[1:], last_values[None]])
    goes_on = 1 - dones.astype(np.float32)
    deltas = rewards + gamma * goes_on * next_values - values
    decays = gamma * gae_lambda * goes_on
    advantages, advantage = np.empty_like(deltas), 0.0
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decays[t] * advantage
    return advantages, advantages + values


# --- Learning
def make_optimizer(agent, args):
    # With --resume its settings, also the learning rate, are those of the checkpoint
    return torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)


def ppo_loss(agent, minibatch, args):
    """PPO's clipped objective (Schulman et al. 2017).

    minibatch: obs (batch, obs_dim), actions (batch, action_dim), logprobs, advantages, returns and
    values (batch,). Returns the loss and a dict of metrics to log.
    """
    # The last, the old values, is not used: it is there for those who add value clipping
    obs, actions, old_logprobs, advantages, returns, _ = minibatch
    logprobs, entropy, values = agent(obs, actions)
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


def loss_backward(loss_function, agent, minibatch, args):
    """Adds the loss's gradients, scaled down to --max-grad-norm, to p.grad. Returns metrics to log.

    This is loss.backward() and clip_grad_norm_(), in a form of which torch.compile makes one graph,
    with the loss: a third of the time of --no-compile. A number in args may change during training.
    Make it a tensor: with a Python number each new value compiles the graph again, 10 seconds.
    """
    loss, metrics = loss_function(agent, minibatch, args)
    params = [p for p in agent.parameters() if p.requires_grad]
    # materialize_grads: zeros for parameters that the loss does not use
    grads = torch.autograd.grad(loss, params, materialize_grads=True)
    norm = sum(grad.square().sum() for grad in grads).sqrt()
    scale = (args.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
    for parameter, grad in zip(params, grads, strict=True):
        scaled = grad * scale
        parameter.grad = scaled if parameter.grad is None else parameter.grad + scaled
    return {name: value.detach() for name, value in metrics.items()}


def learn(agent, optimizer, batch, backward, args):
    """Several epochs of minibatches. Returns metrics to log, averaged over the minibatches."""
    all_metrics = []
    for _ in range(args.n_epochs):
        permutation = torch.randperm(len(batch[0])).to(args.device)
        shuffled = [x[permutation] for x in batch]
        for start in range(0, len(permutation), args.batch_size):
            minibatch = [x[start : start + args.batch_size] for x in shuffled]
            optimizer.zero_grad()
            all_metrics.append(backward(agent, minibatch, args))
            optimizer.step()
    return {name: torch.stack([m[name] for m in all_metrics]).mean() for name in all_metrics[0]}


def compiled(function):
    """torch.compile of a function as one graph; where that fails, the function as it is."""
    torch._dynamo.config.trace_autograd_ops = True  # autograd.grad inside of the graph
    # cpp_wrapper: kernels are called from C++, not from Python
    how = {"fullgraph": True, "dynamic": False, "options": {"cpp_wrapper": True}}
    graph = torch.compile(function, isolate_recompiles=True, **how)

    def call(*arguments):
        nonlocal graph
        try:
            return graph(*arguments)
        except Exception as error:  # no compiler, an edit that cannot be compiled, ...
            if graph is function:  # not the compiler's fault
                raise
            graph, reason = function, str(error).strip().split("\n")[0][:120]
            tqdm.write(f"note: no torch.compile, so updates are slow: {reason}", file=sys.stderr)
            return function(*arguments)

    return call


# --- Evaluating
@torch.random.fork_rng(devices=[])  # an environment that draws from torch must not change training
def evaluate(policy, envs, seeds, max_steps=1_000_000):
    """Plays one episode of the policy in each environment: returns and lengths, (n_envs,) each.

    Returns are undiscounted. Where an episode has ended, its environment keeps stepping until all
    have ended; what it does then is not counted.
    """
    space, (obs, _) = envs.single_action_space, envs.reset(seed=seeds)
    returns, lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs)
    unfinished = np.ones(envs.num_envs, dtype=bool)
    for _ in range(max_steps):
        actions = np.clip(policy(obs), space.low, space.high)
        obs, rewards, terminated, truncated, _ = envs.step(actions)
        returns += np.where(unfinished, rewards, 0)
        lengths += unfinished
        unfinished &= ~(terminated | truncated)
        if not unfinished.any():
            return returns, lengths
    raise RuntimeError(f"no end of an episode in {max_steps} steps: set --max-episode-steps")


def evaluate_due(run, acting, envs, global_step, args, bar):
    """Makes the evaluations that fall before the next update.

    An evaluation at step t is of the policy that acts at step t. With 8,192 steps per update, the
    policy of step 8,192 acts until step 16,383, so it is the one evaluated for step 10,240.
    """
    next_update = global_step + args.n_steps * args.n_envs
    first = len(run.rows) * args.eval_freq  # rows: the header, and one for each evaluation
    for step in range(first, min(next_update, args.total_timesteps + 1), args.eval_freq):
        if step == first or not args.eval_once_per_policy:
            seeds = make_seeds(args.eval_episodes, args.seed, 2, step)
            returns, lengths = evaluate(numpy_policy(acting["agent"].actor_mean), envs, seeds)
        run.add_evaluation(step, returns, lengths, acting)
        bar.set_postfix_str(f"last evaluation {returns.mean():.4g}", refresh=False)


# --- The run's folder
def run_path(args):
    """Path of a run's folder: it shows the experiment, environment, beta, n_envs and seed."""
    beta = "beta_" + ("auto" if args.beta_auto else "_".join(f"{b:g}" for b in args.beta))
    beta = "gsde" if args.method == "gsde" else "vanilla" if args.vanilla else beta
    path = Path(args.runs_dir) / args.exp_name / re.sub(r"[/:\\]", "_", args.env_id) / beta
    return path / f"n_envs_{args.n_envs}" / f"seed_{args.seed}"


def lock(path):
    """Makes the folder and locks it. Ends with exit code 3 if another process has it."""
    path.mkdir(parents=True, exist_ok=True)
    try:
        return filelock.FileLock(path / "lock", fallback_to_soft=False).acquire(timeout=0)
    except filelock.Timeout:
        print(f"another process works on {path}: choose another --seed or --exp-name")
        sys.exit(3)
    except OSError as error:
        raise OSError(f"cannot lock {path}: choose a --runs-dir that has locks") from error


def write_file(path, content):
    """Writes a text, or an object with torch.save. A file gets its name when it is complete."""
    temporary = path.with_name(path.name + ".tmp")
    if isinstance(content, str):
        temporary.write_text(content)
    else:
        torch.save(content, temporary)
    os.replace(temporary, path)


class Run:
    """The folder of a run: what it leaves behind, and what --resume continues from.

    Attributes: `complete`, whether there is nothing to do; `checkpoint`, the state to start from;
    `rows`, the lines of evaluations.csv. Resuming loads them from the checkpoint and changes no
    file: what was evaluated after the checkpoint is evaluated again.
    """

    def __init__(self, args):
        self.args, self.path, self.saved_time = args, run_path(args), 0.0
        if args.overwrite:
            for name in ("summary.json", "checkpoint.pt", "best.pt", "events.out.tfevents.*"):
                for file in self.path.glob(name):
                    file.unlink()
        config, checkpoint = self.path / "config.json", self.path / "checkpoint.pt"
        self.complete = (self.path / "summary.json").exists()
        if self.complete or checkpoint.exists():
            old = json.loads(config.read_text())["args"]
            # These do not change the result: they may differ between a run and its --resume
            free = {"resume", "overwrite", "runs_dir", "device", "compile", "threads", "track"}
            for name, value in vars(args).items():
                if old.get(name) != value and name not in free:
                    found = f"{self.path} holds a run with {name} {old.get(name)}, not {value}"
                    raise FileExistsError(f"{found}: choose another --exp-name, or --overwrite")
        if self.complete:
            print(f"nothing was run, {self.path} is complete: use --overwrite or --exp-name NAME")
            return
        self.checkpoint = {"global_step": 0, "wall_seconds": 0.0, "best_return": -math.inf}
        self.checkpoint["rows"] = ["step,return_mean,return_std,length_mean\n"]
        if not checkpoint.exists():  # a new run
            versions = {x.name: x.version for x in importlib.metadata.distributions()}
            git = "git describe --always --dirty --abbrev=40 --exclude='*'"  # -dirty: not committed
            how = {"shell": True, "cwd": Path(__file__).parent, "capture_output": True}
            commit = subprocess.run(git, **how, text=True).stdout.strip() or None  # no git: None
            content = {"args": vars(args), "git_commit": commit, "versions": versions}
            write_file(config, json.dumps(content, indent=2) + "\n")
            write_file(self.path / "evaluations.csv", "".join(self.checkpoint["rows"]))
        elif args.resume:
            self.checkpoint = torch.load(checkpoint, map_location="cpu", weights_only=True)
        else:
            raise FileExistsError(f"{self.path} is unfinished: use --resume or --overwrite")
        self.rows, self.best_return = self.checkpoint["rows"], self.checkpoint["best_return"]
        self.start_time = time.time() - self.checkpoint["wall_seconds"]  # it counts on
        if args.track:
            import wandb

            wandb.init(project="ppo_colored_noise", name=str(self.path), sync_tensorboard=True)
        # TensorBoard hides what an earlier process has logged from purge_step on
        self.writer = SummaryWriter(str(self.path), purge_step=self.checkpoint["global_step"])

    def add_evaluation(self, step, returns, lengths, acting):
        """Writes a row of evaluations.csv; and best.pt, the policy, if its return is the best."""
        mean, std, length = returns.mean(), returns.std(), lengths.mean()
        if not np.isfinite(mean):
            raise FloatingPointError(f"return {mean} in {self.args.env_id}, evaluated at {step}")
        self.rows.append(f"{step},{mean:.9g},{std:.9g},{length:.9g}\n")
        write_file(self.path / "evaluations.csv", "".join(self.rows))
        if mean > self.best_return:
            self.best_return = mean.item()
            best = {name: part.state_dict() for name, part in acting.items()}
            best |= {"step": step, "return_mean": self.best_return}
            write_file(self.path / "best.pt", best)
        for name, value in ("return_mean", mean), ("return_std", std), ("length_mean", length):
            self.writer.add_scalar(f"evaluation/{name}", value, step)

    def add_update(self, step, losses, episodes):
        """Logs an update: its losses, the speed, and the (return, length) means of episodes."""
        scalars = {f"losses/{name}": float(value) for name, value in losses.items()}
        scalars["time/steps_per_second"] = step / (time.time() - self.start_time)
        if episodes:
            means = np.mean(episodes, axis=0)
            scalars |= {"rollout/return_mean": means[0], "rollout/length_mean": means[1]}
        for tag, value in scalars.items():
            self.writer.add_scalar(tag, value, step)

    def save_checkpoint(self, parts, global_step):
        """Writes checkpoint.pt, all that --resume needs. parts: objects that have a state_dict."""
        self.writer.flush()
        state = {name: part.state_dict() for name, part in parts.items()}
        state |= {"global_step": global_step, "torch_rng": torch.get_rng_state()}
        state |= {"rows": self.rows, "best_return": self.best_return}
        state["wall_seconds"] = time.time() - self.start_time
        write_file(self.path / "checkpoint.pt", state)
        self.saved_time = time.time()

    def finish(self, steps):
        """Writes summary.json, which makes the run complete, and says what is in it."""
        self.writer.close()
        returns = [float(row.split(",")[1]) for row in self.rows[1:]]
        performance, seconds = sum(returns) / len(returns), time.time() - self.start_time
        summary = {"performance": performance, "final_return": returns[-1], "steps": steps}
        summary["wall_seconds"] = round(seconds, 1)
        write_file(self.path / "summary.json", json.dumps(summary, indent=2) + "\n")
        results = f"performance {performance:.4g}, final return {returns[-1]:.4g}"
        print(f"{results}, {seconds / 60:.1f} min: {self.path}")


# --- The whole run
def make_seeds(n, *key):
    """n independent seeds below 2^32, determined by the key: args.seed, a number for the purpose (0
    networks and noise, 1 environments, 2 evaluation), and the step."""
    return np.random.SeedSequence(key).generate_state(n).tolist()


def main(args, make_agent=Agent, exploration=exploration, loss=ppo_loss, learn=learn,
         make_optimizer=make_optimizer):  # fmt: skip
    """Trains and evaluates as `args` say. Other methods replace the other arguments."""
    torch.set_num_threads(1)
    random.seed(args.seed)  # some environments draw from these, also when they are made
    np.random.seed(args.seed)  # noqa: NPY002
    envs, eval_envs = make_vector_env(args, args.n_envs), make_vector_env(args, args.eval_episodes)
    with contextlib.closing(envs), contextlib.closing(eval_envs), lock(run_path(args)):
        obs_dim = envs.single_observation_space.shape[0]
        action_dim = envs.single_action_space.shape[0]
        init_seed, noise_seed = make_seeds(2, args.seed, 0)
        torch.manual_seed(init_seed)
        agent = make_agent(obs_dim, action_dim).to(args.device)
        optimizer = make_optimizer(agent, args)
        learning_rates = [group["lr"] for group in optimizer.param_groups]
        sizes = args.n_envs, action_dim, args.noise_seq_len
        noise = ColoredNoiseProcess(args.beta, *sizes, noise_seed)
        acting = {"agent": agent}  # all that acts, for best.pt
        if args.normalize_obs or args.normalize_rewards:
            envs = acting["normalization"] = study.NormalizedVectorEnv(envs, args)
            eval_envs = envs.frozen(eval_envs)
        saved = {**acting, "optimizer": optimizer, "noise": noise}  # for checkpoint.pt
        run = Run(args)
        if run.complete:
            return
        global_step = run.checkpoint["global_step"]
        if global_step:
            torch.set_rng_state(run.checkpoint["torch_rng"])
            for name, part in saved.items():
                part.load_state_dict(run.checkpoint[name])
        backward = functools.partial(loss_backward, loss)
        backward = compiled(backward) if args.compile else backward
        # The state of environments cannot be saved: after a resume they begin new episodes
        obs, _ = envs.reset(seed=make_seeds(args.n_envs, args.seed, 1, global_step))
        steps_per_update = args.n_steps * args.n_envs
        total = math.ceil(args.total_timesteps / steps_per_update) * steps_per_update
        log_every = math.ceil(total / steps_per_update / 1000)  # updates: 1000 points at most
        episodes, so_far = [], np.zeros((2, args.n_envs))

        made_by = "EnvPool: make_env() is not called" if args.envpool else "make_env()"
        print(f"{run.path}: environments are made by {made_by}. After Ctrl-C, --resume continues")
        bar = tqdm(total=total, initial=global_step, unit=" steps", unit_scale=True)
        bar.mininterval = 0.5 if sys.stderr.isatty() else 60  # seconds
        while True:
            evaluate_due(run, acting, eval_envs, global_step, args, bar)
            if global_step == total:
                break
            if args.anneal_lr:
                for group, rate in zip(optimizer.param_groups, learning_rates, strict=True):
                    group["lr"] = rate * (1 - global_step / total)
            act = exploration(agent, noise, args)
            batch, obs, ended = collect(agent, act, envs, obs, so_far, args, bar)
            losses = learn(agent, optimizer, batch, backward, args)
            global_step += steps_per_update
            if not nn.utils.parameters_to_vector(agent.parameters()).isfinite().all():
                raise FloatingPointError("training diverged: lower --learning-rate")

            episodes += ended
            if global_step // steps_per_update % log_every == 0:
                *_, returns, values = batch
                unexplained = (returns - values).var() / returns.var().clamp(min=1e-12)
                losses |= {"explained_variance": 1 - unexplained, "std": agent.std().mean().item()}
                losses["learning_rate"] = optimizer.param_groups[0]["lr"]
                run.add_update(global_step, losses, episodes)
                episodes = []
            if time.time() > run.saved_time + 5 or global_step == total:
                run.save_checkpoint(saved, global_step)
        bar.close()
        run.finish(global_step)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program at once
    main(parse_args())
