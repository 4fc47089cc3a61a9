"""Proximal Policy Optimization (PPO) with colored noise, for continuous actions, in one file.

Hollenstein, Martius, Piater: "Colored Noise in PPO: Improved Exploration and Performance through
Correlated Action Sampling", AAAI 2024. PPO draws its actions as mean + std * eps with white noise
eps; here eps is temporally correlated 1/f^beta noise. Look for "These lines are the paper".
Everything else is PPO as Stable-Baselines3 has it.

    python ppo_colored_continuous.py --env-id MountainCarContinuous-v0 --beta 0.5

This file and colored_noise.py are all it takes (pip install torch gymnasium tensorboard tqdm
filelock). If the folder study/ of the project is beside them, it adds faster environments, those
of the paper and normalization. To change the method, edit this file. Its last function, main(),
reads as the method does.
"""

import argparse
import ast
import collections
import contextlib
import copy
import importlib.metadata
import json
import math
import os
import platform
import random
import re
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for networks this small more threads are slower

import filelock
import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from colored_noise import ColoredNoiseProcess, projected_beta

try:  # adds EnvPool, threads, normalization and the paper's own environments
    import study.environments as study
except ModuleNotFoundError as error:
    if error.name not in ("study", "study.environments"):
        raise
    study = None

sys.path.append(os.getcwd())  # for --env-id my_env:MyEnv-v0, with my_env.py in the current folder
# Arguments that do not change the result: they may differ between a run and its --resume
FREE_ARGUMENTS = {"resume", "overwrite", "runs_dir", "device", "compile", "threads", "track"}


def key_value(text):
    """The pair (key, value) of "key=value"; the value is a Python literal, or else text."""
    key, value = text.split("=", 1)
    value = {"true": "True", "false": "False", "null": "None"}.get(value, value)
    try:
        return key, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return key, value


def beta_or_auto(text):
    return text if text == "auto" else float(text)


def parse_args(argv=None, **defaults):
    """Reads the command line, or the list argv. `defaults` take the place of those below."""
    flag = argparse.BooleanOptionalAction
    show_defaults = argparse.ArgumentDefaultsHelpFormatter
    parser = argparse.ArgumentParser(
        description="PPO with colored noise.", formatter_class=show_defaults, allow_abbrev=False
    )
    add = parser.add_argument_group("experiment").add_argument
    add("--env-id", default="MountainCarContinuous-v0", help="such as dm_control/walker-run-v0, or "
        "my_env:MyEnv-v0, which my_env.py registers")  # fmt: skip
    add("--seed", type=int, default=1, help="of everything random")
    add("--total-timesteps", type=int, default=2_048_000, help="of all environments together")
    add("--eval-freq", type=int, default=10_240, help="environment steps between evaluations")
    add("--eval-episodes", type=int, default=50, help="episodes per evaluation, in parallel")
    add("--eval-once-per-policy", action=flag, default=False, help="evaluate each policy once; "
        "further evaluations that are due before the next update repeat the result")  # fmt: skip
    add = parser.add_argument_group("environment").add_argument
    add("--env-kwargs", type=key_value, nargs="+", action="extend", help="its arguments, key=value")
    add("--max-episode-steps", type=int, help="a time limit in place of the environment's own")
    add("--rescale-actions", action=flag, default=False, help="map [-1, 1] to the action bounds")
    add("--normalize-obs", action=flag, default=False, help="by their running mean and std")
    add("--normalize-rewards", action=flag, default=False, help="by the std of discounted returns")
    add = parser.add_argument_group("colored noise").add_argument
    add("--beta", type=beta_or_auto, nargs="+", default=[0.5], help="0 white, 1 pink, 2 red noise; "
        "one number, or one per action dimension; auto: by the size of a batch")  # fmt: skip
    add("--noise-seq-len", type=int, default=1000, help="T, steps until sequences are drawn anew")
    add("--vanilla", action="store_true", help="white noise from torch, as in ordinary PPO")
    add = parser.add_argument_group("PPO").add_argument
    add("--n-envs", type=int, default=4, help="parallel environments")
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
    add("--max-grad-norm", type=float, default=0.5, help="the gradient is scaled down to this norm")
    add("--bootstrap-timeouts", action=flag, default=True, help="add gamma * V(obs) at time limits")
    add = parser.add_argument_group("running").add_argument
    add("--envpool", action=flag, help="environments in C++; by default where EnvPool has the task")
    add("--threads", type=int, default=os.cpu_count(), help="that step environments, if study/ is "
        "there and they gain by it")  # fmt: skip
    add("--compile", action=flag, default=True, help="compile the update")
    add("--device", default="cpu", help="torch device of the networks: cpu, cuda, cuda:1")
    add("--exp-name", default="ppo_colored_continuous", help="the experiment, a folder's name")
    add("--runs-dir", default="runs", help="folder of all runs")
    add("--resume", action="store_true", help="continue the run from its last checkpoint")
    add("--overwrite", action="store_true", help="start again where the folder holds a run")
    add("--track", action="store_true", help="log to Weights & Biases too (pip install wandb)")
    parser.set_defaults(**{"method": "ppo", **defaults})  # study/methods.py has others
    args = parser.parse_args(argv)

    counts = ["total_timesteps", "eval_freq", "eval_episodes", "n_envs", "n_steps", "batch_size"]
    for name in [*counts, "n_epochs", "threads"]:
        if getattr(args, name) < 1:
            parser.error(f"--{name.replace('_', '-')} must be at least 1")
    last_evaluation = args.total_timesteps // args.eval_freq * args.eval_freq
    if args.n_envs * args.n_steps > max(last_evaluation, 0):
        parser.error(f"the last evaluation, at step {last_evaluation}, would come before the first "
                     f"update, which takes n_envs * n_steps = {args.n_envs * args.n_steps} steps: "
                     "lower --n-steps, or raise --total-timesteps")  # fmt: skip
    if args.resume and args.overwrite:
        parser.error("--resume continues a run and --overwrite starts it again: choose one")
    args.env_kwargs = dict(args.env_kwargs) if args.env_kwargs else None
    args.beta_auto = args.beta == ["auto"]
    if args.beta_auto:
        args.beta = [projected_beta(args.n_envs, args.n_steps, args.noise_seq_len)]
    elif "auto" in args.beta:
        parser.error("--beta auto is one number for all action dimensions")
    if study is None and (args.envpool or args.normalize_obs or args.normalize_rewards):
        parser.error("--envpool and --normalize-... need the project's folder study/ beside "
                     "this script")  # fmt: skip
    if args.envpool is None:
        args.envpool = study is not None and study.envpool_suits(args)
    return args


# --- The networks


def layer_init(layer, gain=2**0.5):
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Separate actor and critic, and a log std that is the same in all states.

    Any layers but BatchNorm will do. Parameters with requires_grad=False are not learned.
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

    def forward(self, obs, actions):
        """obs (batch, obs_dim), actions (batch, action_dim).

        Returns logprobs (batch,), entropy () and values (batch,).
        """
        # The density of a single step. That eps is correlated over time does not enter: each eps is
        # still Gaussian by itself, and PPO's objective is made of single steps (docs/lesson.md).
        z = (actions - self.actor_mean(obs)) / self.log_std.exp()
        logprobs = (-0.5 * z**2 - self.log_std - 0.5 * math.log(2 * math.pi)).sum(-1)
        entropy = (0.5 + 0.5 * math.log(2 * math.pi) + self.log_std).sum()
        return logprobs, entropy, self.critic(obs).squeeze(-1)


def numpy_policy(actor):
    """The module `actor` as a function from numpy to numpy: obs (n, obs_dim) -> (n, action_dim).

    The networks are so small that calling torch takes longer than computing: 31 us for 4 rows,
    numpy 6. Layers that are known here are computed in numpy; with any other the module is called,
    in eval mode. The weights are copied: make it anew when the module has learned.
    """
    activations = {nn.Tanh: np.tanh, nn.ReLU: lambda x: np.maximum(x, 0), nn.Identity: lambda x: x}
    modules = [actor, *actor] if type(actor) is nn.Sequential else [actor]
    functions = []
    for layer in modules[1:]:
        if type(layer) is nn.Linear and layer.bias is not None:
            weight, bias = (p.detach().cpu().numpy().T.copy() for p in (layer.weight, layer.bias))
            functions.append(lambda x, weight=weight, bias=bias: x @ weight + bias)
        elif type(layer) in activations:
            functions.append(activations[type(layer)])
    hooks = any(module._forward_hooks or module._forward_pre_hooks for module in modules)
    if hooks or len(functions) != len(modules) - 1 or len(modules) == 1:
        module, device = copy.deepcopy(actor).eval(), next(actor.parameters()).device
        return lambda obs: module(torch.as_tensor(obs, device=device)).detach().cpu().numpy()

    def policy(obs):
        for function in functions:
            obs = function(obs)
        return obs

    return policy


# --- The environments


class FlatEnv(gym.Wrapper):
    """Makes observations one float32 vector (a Dict in its order of keys), and actions one, too.

    With `rescale`, actions in [-1, 1] stand for those between the action bounds.
    """

    def __init__(self, env, rescale):
        super().__init__(env)
        self._space, actions = float32_space(env.observation_space), env.action_space
        self.observation_space = spaces.Box(-np.inf, np.inf, (spaces.flatdim(self._space),))
        low, high, dtype = actions.low.reshape(-1), actions.high.reshape(-1), actions.dtype
        self._bounds = (low, high) if rescale else None
        if rescale:
            low, high = np.full_like(low, -1), np.full_like(high, 1)
        self.action_space = spaces.Box(low, high, dtype=dtype)

    def reset(self, *, seed=None, options=None):
        if seed is not None:  # some environments draw from their spaces
            self.env.action_space.seed(seed)
            self.env.observation_space.seed(seed)
        obs, _ = self.env.reset(seed=seed, options=options)
        return spaces.flatten(self._space, obs), {}

    def step(self, action):
        if self._bounds:
            low, high = self._bounds
            action = np.clip(low + (action + 1) / 2 * (high - low), low, high).astype(low.dtype)
        action = action.reshape(self.env.action_space.shape)
        obs, reward, terminated, truncated, _ = self.env.step(action)
        return spaces.flatten(self._space, obs), reward, terminated, truncated, {}


def float32_space(space):
    """The space with each Box in float32: spaces.flatten casts observations to the space's type."""
    if isinstance(space, spaces.Dict):
        return spaces.Dict(
            collections.OrderedDict((key, float32_space(x)) for key, x in space.items())
        )
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([float32_space(x) for x in space])
    return spaces.Box(-np.inf, np.inf, space.shape) if isinstance(space, spaces.Box) else space


def make_env(args, render_mode=None):
    """Makes one environment: obs (obs_dim,) float32, actions (action_dim,).

    This is the place for a wrapper of yours. EnvPool's are not made here: --no-envpool.
    """
    kwargs = dict(args.env_kwargs or {})
    if args.env_id.startswith("dm_control/"):
        import shimmy  # noqa: F401  registers dm_control's ids

        if args.max_episode_steps:  # the task's own limit, in seconds, is inside of it
            kwargs["task_kwargs"] = {"time_limit": math.inf} | kwargs.get("task_kwargs", {})
    if render_mode:
        kwargs["render_mode"] = render_mode
    # Gymnasium's checks of the first steps are for who writes an environment; they take time
    env = gym.make(args.env_id, args.max_episode_steps, disable_env_checker=True, **kwargs)
    actions, observations = env.action_space, env.observation_space
    if not isinstance(actions, spaces.Box) or not np.issubdtype(actions.dtype, np.floating):
        raise TypeError(f"{args.env_id} has actions {actions}: colored noise needs real numbers")
    if not observations.is_np_flattenable:
        raise TypeError(f"{args.env_id} has observations {observations} of no fixed size")
    if args.rescale_actions and not actions.is_bounded():
        raise TypeError(f"--rescale-actions needs bounds, {args.env_id} has {actions}")
    return FlatEnv(env, args.rescale_actions)


def make_vector_env(args, n_envs):
    """Makes n_envs environments that step together: obs (n_envs, obs_dim), actions likewise.

    The step that ends an episode returns the first observation of the next one, and the last of the
    ended one in infos["final_obs"] (SAME_STEP). Gymnasium's default would insert a dummy step.
    """
    if args.envpool:
        return study.EnvPoolVectorEnv(args, n_envs)
    if study:
        return study.make_vector_env(args, n_envs, make_env)
    functions = [lambda: make_env(args)] * n_envs
    same_step = gym.vector.AutoresetMode.SAME_STEP
    return gym.vector.SyncVectorEnv(functions, copy=False, autoreset_mode=same_step)


def make_envs(args):
    """Returns the environments to train in and those to evaluate in, normalized as args say."""
    envs, eval_envs = make_vector_env(args, args.n_envs), make_vector_env(args, args.eval_episodes)
    if args.normalize_obs or args.normalize_rewards:
        envs = study.NormalizedVectorEnv(envs, args)
        eval_envs = envs.frozen(eval_envs)
    return envs, eval_envs


# --- Collecting


def exploration(agent, noise, args):
    """Returns act(obs (n_envs, obs_dim), t) -> actions (n_envs, action_dim), for one rollout.

    Another object can take the noise's place. It needs sample(n_steps), a tensor (n_steps, n_envs,
    action_dim) in which each value by itself is Gaussian with mean 0 and variance 1, and
    state_dict() and load_state_dict(state), for checkpoints.
    """
    mean, std = numpy_policy(agent.actor_mean), agent.log_std.exp().detach().cpu().numpy()
    shape = (args.n_steps, args.n_envs, len(std))
    # These lines are the paper: noise that is correlated over time, in place of white noise (Eq. 2)
    eps = (torch.randn(shape) if args.vanilla else noise.sample(args.n_steps)).numpy()
    return lambda obs, t: mean(obs) + std * eps[t]


@torch.no_grad()
def collect(agent, act, envs, storage, args, bar):
    """Takes n_steps in each environment, going on from the last obs, and makes a batch of them.

    storage: arrays obs (n_steps + 1, n_envs, obs_dim), actions (n_steps, n_envs, action_dim),
    rewards and dones (n_steps, n_envs), and so_far (2, n_envs), return and length up to now of each
    environment's episode. Returns the batch, (obs, actions, logprobs, advantages, returns, values),
    each of n_steps * n_envs rows, and the (return, length) of every episode that ended.
    """
    obs, actions, rewards, dones, so_far = storage
    space, timeouts, episodes = envs.single_action_space, [], []
    obs[0] = obs[-1]  # the observation after the last rollout's last step
    for t in range(args.n_steps):
        actions[t] = act(obs[t], t)
        # The environment gets the clipped action. The one stored, to learn from, is the unclipped:
        # its log-probability is a Gaussian's, that of the clipped one is not.
        clipped = np.clip(actions[t], space.low, space.high)
        obs[t + 1], rewards[t], terminated, truncated, infos = envs.step(clipped)
        dones[t] = terminated | truncated
        so_far[0] += infos.get("raw_rewards", rewards[t])
        so_far[1] += 1
        for i in np.flatnonzero(dones[t]):
            episodes.append(so_far[:, i].tolist())
            so_far[:, i] = 0
            if not terminated[i]:
                timeouts.append((t, i, infos["final_obs"][i]))
        bar.update(args.n_envs)
    for name, array in {"observation": obs, "action": actions, "reward": rewards}.items():
        if not np.isfinite(array).all():
            t, i, *_ = np.argwhere(~np.isfinite(array))[0]
            raise FloatingPointError(f"{name} {array[t, i]} in {args.env_id}, environment {i}, "
                f"{args.n_steps - t} steps before step {bar.n // args.n_envs} of it")  # fmt: skip

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
    goes_on = 1 - dones.astype(np.float32)
    deltas = rewards + gamma * goes_on * next_values - values
    decays = gamma * gae_lambda * goes_on
    advantages, advantage = np.empty_like(deltas), 0.0
    for t in reversed(range(len(deltas))):
        advantages[t] = advantage = deltas[t] + decays[t] * advantage
    return advantages, advantages + values


# --- Learning


def trainable(agent):
    """The parameters to learn, by name."""
    return {name: p for name, p in agent.named_parameters() if p.requires_grad}


def unflatten(params, agent):
    """Cuts the flat vector `params` into the agent's trainable parameters: {name: view}."""
    named = trainable(agent)
    pieces = params.split([p.numel() for p in named.values()])
    return {name: x.view(named[name].shape) for name, x in zip(named, pieces, strict=True)}


def ppo_loss(params, minibatch, agent, args):
    """PPO's clipped objective (Schulman et al. 2017), as a function of the flat parameter vector.

    minibatch: obs (batch, obs_dim), actions (batch, action_dim), logprobs, advantages, returns and
    values (batch,). Returns the loss and a dict of what is to be logged.
    """
    obs, actions, old_logprobs, advantages, returns, _ = minibatch  # no clipping of values
    named = unflatten(params, agent)
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


def compiled(update):
    """torch.compile of an update as one graph, or, where that fails, the update as it is."""
    # cpp_wrapper calls the kernels from C++ instead of Python: 13 % less time in an update
    how = {"fullgraph": True, "dynamic": False, "options": {"cpp_wrapper": True}}
    functions = [torch.compile(update, isolate_recompiles=True, **how)]

    def call(*arguments):
        try:
            return functions[0](*arguments)
        except Exception as error:  # no compiler, an edit that cannot be compiled, ...
            if functions[0] is update:
                raise
            reason = str(error).strip().split("\n")[0][:120]
            tqdm.write(f"note: going on without torch.compile, updates take 6 times as long "
                       f"({reason})", file=sys.stderr)  # fmt: skip
            functions[0] = update
            return update(*arguments)

    return call


def learn(agent, optimizer, batch, learning_rate, update, args):
    """Several epochs of minibatches; moves the agent's parameters.

    Returns the optimizer's new state, and the metrics averaged over the minibatches.
    """
    params = nn.utils.parameters_to_vector(trainable(agent).values()).detach()
    learning_rate = torch.tensor(learning_rate, dtype=torch.float64, device=args.device)
    all_metrics = []
    for _ in range(args.n_epochs):
        permutation = torch.randperm(len(batch[0])).to(args.device)
        shuffled = [x[permutation] for x in batch]
        for start in range(0, len(permutation), args.batch_size):
            minibatch = [x[start : start + args.batch_size] for x in shuffled]
            params, optimizer, metrics = update(
                params, optimizer, minibatch, learning_rate, agent, args
            )
            all_metrics.append(metrics)
    nn.utils.vector_to_parameters(params, trainable(agent).values())
    means = {name: torch.stack([m[name] for m in all_metrics]).mean() for name in all_metrics[0]}
    return optimizer, means


# --- Evaluating


@contextlib.contextmanager
def preserved_generators():
    """What is drawn inside from the global generators is not missing from them afterwards."""
    states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])


@preserved_generators()  # evaluations must not change what training draws
@torch.no_grad()
def evaluate(policy, envs, seeds, max_steps=100_000):
    """Plays one episode of the policy in each environment: returns and lengths, (n_envs,) each.

    Returns are undiscounted. An environment whose episode has ended steps on until the longest has:
    what it does then is not counted.
    """
    space, (obs, _) = envs.single_action_space, envs.reset(seed=seeds)
    returns, lengths = np.zeros(envs.num_envs), np.zeros(envs.num_envs)
    unfinished = np.ones(envs.num_envs, dtype=bool)
    for _ in range(max_steps):
        actions = np.clip(policy(obs), space.low, space.high)
        obs, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * unfinished
        lengths += unfinished
        unfinished &= ~(terminated | truncated)
        if not unfinished.any():
            return returns, lengths
    raise RuntimeError(f"an episode has not ended after {max_steps} steps: --max-episode-steps N "
                       "sets a limit")  # fmt: skip


def evaluate_due(run, agent, envs, eval_envs, global_step, args, bar):
    """Makes the evaluations that are due before the next update.

    The evaluation at step t is of the policy that acts at step t. With 8,192 steps per update and
    an evaluation every 10,240, the policy learned up to step 8,192 acts until 16,383, so it is the
    one evaluated for step 10,240.
    """
    next_update = global_step + args.n_steps * args.n_envs
    returns = None
    while run.next_eval < next_update and run.next_eval <= args.total_timesteps:
        if returns is None or not args.eval_once_per_policy:
            policy = numpy_policy(agent.actor_mean)
            seeds = make_seeds(args.eval_episodes, args.seed, 2, run.next_eval)
            returns, lengths = evaluate(policy, eval_envs, seeds)
        run.add_evaluation(returns, lengths, acting_state(agent, envs))
        bar.set_postfix_str(f"last evaluation {returns.mean():.4g}", refresh=False)


def acting_state(agent, envs):
    """All that a policy needs to act again: the networks, and statistics if it normalizes."""
    normalization = envs.state_dict() if hasattr(envs, "state_dict") else {}
    return {"agent": agent.state_dict(), "normalization": normalization}


# --- The run's folder


def run_path(args):
    """Path of a run's folder: it shows the experiment, environment, beta, n_envs and seed."""
    beta = "beta_" + ("auto" if args.beta_auto else "_".join(f"{b:g}" for b in args.beta))
    beta = "gsde" if args.method == "gsde" else "vanilla" if args.vanilla else beta
    path = Path(args.runs_dir) / args.exp_name / re.sub(r"[/:\\]", "_", args.env_id) / beta
    return path / f"n_envs_{args.n_envs}" / f"seed_{args.seed}"


@contextlib.contextmanager
def locked(path):
    """Makes the folder, which no other process can have meanwhile. Exit code 3 if one has it."""
    path.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(path / "lock", timeout=0, fallback_to_soft=False):
            yield
    except filelock.Timeout:
        print(f"another process works on {path}: wait for it, or choose another --seed or "
              "--exp-name", file=sys.stderr)  # fmt: skip
        sys.exit(3)


def replace_file(path, write):
    """Writes a file beside, by write(temporary path), then renames it: all of it, or nothing."""
    temporary = path.with_name(path.name + ".tmp")
    write(temporary)
    os.replace(temporary, path)


def write_json(path, value):
    replace_file(path, lambda file: file.write_text(json.dumps(value, indent=2) + "\n"))


class Run:
    """The folder of a run: what it leaves behind, and what --resume goes on from.

    Attributes: `complete`, whether there is nothing to do; `checkpoint`, a dict to go on from, or
    None; `next_eval`, the step of the next evaluation. Nothing is changed before start().
    """

    def __init__(self, args):
        self.args, self.path = args, run_path(args)
        self.checkpoint, self.next_eval, self.best = None, args.eval_freq, None
        self.start_time, self.saved_time, self.logged_step = time.time(), 0.0, 0
        self.complete = (self.path / "summary.json").exists() and not args.overwrite
        is_new = not any((self.path / name).exists() for name in ("config.json", "evaluations.csv"))
        if is_new or args.overwrite:
            return
        old = json.loads((self.path / "config.json").read_text())["args"]
        new = json.loads(json.dumps(vars(args)))
        for name in sorted(new.keys() - FREE_ARGUMENTS):
            if old.get(name) != new[name]:
                flag = f"--{name.replace('_', '-')}"
                raise FileExistsError(f"{self.path} holds a run with {flag} {old.get(name)}, not "
                    f"{new[name]}: choose another --exp-name, or --overwrite it")  # fmt: skip
        if not self.complete and not args.resume:
            raise FileExistsError(f"{self.path} holds an unfinished run: --resume continues it, "
                                  "--overwrite starts again")  # fmt: skip
        if not self.complete and (self.path / "checkpoint.pt").exists():
            self.checkpoint = torch.load(self.path / "checkpoint.pt", weights_only=True)
            self.next_eval, self.best = self.checkpoint["next_eval"], self.checkpoint["best"]
            self.start_time -= self.checkpoint["wall_seconds"]

    def start(self, **resolved):
        """Cuts the files back to the checkpoint, or clears the folder; opens TensorBoard's file."""
        table, step = self.path / "evaluations.csv", 0
        if self.checkpoint:
            step = self.logged_step = self.checkpoint["global_step"]
            n_rows = self.next_eval // self.args.eval_freq - 1
            rows = table.read_text().splitlines(keepends=True)[: 1 + n_rows]
            replace_file(table, lambda file: file.write_text("".join(rows)))
            if self.best:
                replace_file(self.path / "best.pt", lambda file: torch.save(self.best, file))
        else:
            files = [self.path / name for name in ("summary.json", "checkpoint.pt", "best.pt")]
            for file in [*files, *self.path.glob("events.out.tfevents.*")]:
                file.unlink(missing_ok=True)
            config = {"args": vars(self.args), "resolved": resolved, "versions": versions()}
            write_json(self.path / "config.json", config | {"git_commit": git_commit()})
            header = "step,return_mean,return_std,length_mean\n"
            replace_file(table, lambda file: file.write_text(header))
        if self.args.track:
            import wandb

            wandb.init(project="ppo_colored_noise", name=str(self.path), config=vars(self.args),
                       sync_tensorboard=True)  # fmt: skip
        # purge_step: TensorBoard hides what was logged after the checkpoint
        self.writer = SummaryWriter(str(self.path), purge_step=step + 1 if step else None)
        self.log_time = time.time()

    def log(self, step, scalars):
        """Adds {tag: number} to TensorBoard."""
        for tag, value in scalars.items():
            self.writer.add_scalar(tag, value, step)

    def add_evaluation(self, returns, lengths, acting):
        """Writes a row of evaluations.csv, for the step next_eval. returns, lengths: (n_episodes,).

        acting: state_dicts of all that acted. best.pt has those of the best mean return.
        """
        if not np.isfinite(returns).all():
            raise FloatingPointError(f"returns {returns} in {self.args.env_id} at step "
                                     f"{self.next_eval}: its rewards are not finite")  # fmt: skip
        mean, std, length = returns.mean(), returns.std(), lengths.mean()
        with open(self.path / "evaluations.csv", "a") as file:
            file.write(f"{self.next_eval},{mean:.9g},{std:.9g},{length:.9g}\n")
        if self.best is None or mean > self.best["return_mean"]:
            best = {**acting, "step": self.next_eval, "return_mean": mean.item()}
            self.best = copy.deepcopy(best)
            replace_file(self.path / "best.pt", lambda file: torch.save(self.best, file))
        scalars = {"return_mean": mean, "return_std": std, "length_mean": length}
        self.log(self.next_eval, {f"evaluation/{name}": x for name, x in scalars.items()})
        self.next_eval += self.args.eval_freq

    def log_update(self, step, metrics, episodes):
        """Logs an update's metrics, the speed, and the means of episodes: (return, length) each."""
        if episodes:
            means = np.mean(episodes, axis=0)
            metrics |= {"rollout/return_mean": means[0], "rollout/length_mean": means[1]}
        seconds, self.log_time = time.time() - self.log_time, time.time()
        metrics["time/steps_per_second"] = (step - self.logged_step) / seconds
        self.log(step, metrics)
        self.logged_step = step

    def save_checkpoint(self, **state):
        """Writes checkpoint.pt: tensors and plain values, all that --resume needs."""
        self.writer.flush()
        state |= {"next_eval": self.next_eval, "best": self.best}
        state["wall_seconds"] = time.time() - self.start_time
        replace_file(self.path / "checkpoint.pt", lambda file: torch.save(state, file))
        self.saved_time = time.time()

    def finish(self, steps):
        """Writes summary.json, which makes the run complete, and says what is in it."""
        self.writer.close()
        rows = (self.path / "evaluations.csv").read_text().splitlines()[1:]
        returns = [float(row.split(",")[1]) for row in rows]
        seconds = time.time() - self.start_time
        summary = {"performance": sum(returns) / len(returns), "final_return": returns[-1],
                   "steps": steps, "wall_seconds": round(seconds, 1)}  # fmt: skip
        write_json(self.path / "summary.json", summary)
        print(f"performance {summary['performance']:.4g}, final return {returns[-1]:.4g}, "
              f"{seconds / 60:.1f} min: {self.path}")  # fmt: skip


def versions():
    packages = ["torch", "numpy", "gymnasium", "mujoco", "dm-control", "shimmy"]
    found = {"python": platform.python_version()}
    for package in [*packages, "gymnasium-robotics", "envpool"]:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def git_commit():
    """Commit of this file, with "-dirty" where the checkout differs from it; None without git."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    how = {"cwd": Path(__file__).parent, "capture_output": True, "text": True, "check": True}
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        return subprocess.run(command, **how).stdout.strip()


# --- The whole run


def make_seeds(n, *key):
    """n independent seeds below 2^32, determined by the integers of the key."""
    return np.random.SeedSequence(key).generate_state(n).tolist()


def seed_global_generators(*key):
    """Some environments draw from these."""
    seeds = make_seeds(2, *key)
    random.seed(seeds[0])
    np.random.seed(seeds[1])  # noqa: NPY002


def main(args, make_agent=Agent, exploration=exploration, learn=learn, update=ppo_update):
    """Trains and evaluates as `args` say. The other arguments are what another method replaces."""
    torch.set_num_threads(1)
    seed_global_generators(args.seed, 3, 0)  # before environments are made: some draw then
    envs, eval_envs = make_envs(args)
    with contextlib.closing(envs), contextlib.closing(eval_envs), locked(run_path(args)):
        run = Run(args)
        if run.complete:
            print(f"nothing was run: {run.path} holds this run, complete. --overwrite runs it "
                  "again, --exp-name NAME keeps both")  # fmt: skip
            return
        obs_dim, action_dim = (
            math.prod(space.shape)
            for space in (envs.single_observation_space, envs.single_action_space)
        )
        init_seed, noise_seed = make_seeds(2, args.seed, 0)
        torch.manual_seed(init_seed)
        agent = make_agent(obs_dim, action_dim).to(args.device)
        noise = ColoredNoiseProcess(
            args.beta, args.n_envs, action_dim, args.noise_seq_len, noise_seed
        )
        params = nn.utils.parameters_to_vector(trainable(agent).values()).detach()
        step = torch.zeros((), dtype=torch.float64, device=args.device)
        optimizer = (torch.zeros_like(params), torch.zeros_like(params), step)
        update = compiled(update) if args.compile else update

        global_step = 0
        if run.checkpoint:
            global_step = run.checkpoint["global_step"]
            agent.load_state_dict(run.checkpoint["agent"])
            if run.checkpoint["normalization"]:
                envs.load_state_dict(run.checkpoint["normalization"])
            optimizer = tuple(x.to(args.device) for x in run.checkpoint["optimizer"])
            noise.load_state_dict(run.checkpoint["noise"])
            torch.set_rng_state(run.checkpoint["torch_rng"])
        # The state of environments cannot be saved: after a resume they begin new episodes
        seed_global_generators(args.seed, 3, global_step)
        shape = (args.n_steps, args.n_envs)
        obs = np.zeros((args.n_steps + 1, args.n_envs, obs_dim), np.float32)
        obs[-1], _ = envs.reset(seed=make_seeds(args.n_envs, args.seed, 1, global_step))
        actions = np.zeros((*shape, action_dim), np.float32)
        rewards, dones = np.zeros(shape, np.float32), np.zeros(shape, bool)
        storage = obs, actions, rewards, dones, np.zeros((2, args.n_envs))
        steps_per_update = args.n_steps * args.n_envs
        total = math.ceil(args.total_timesteps / steps_per_update) * steps_per_update
        episodes = []

        run.start(obs_dim=obs_dim, action_dim=action_dim)
        where = "EnvPool's, not from make_env()" if args.envpool else "from make_env()"
        print(f"{run.path}: environments are {where}; after Ctrl-C, --resume goes on")
        interval = 0.5 if sys.stderr.isatty() else 60
        with tqdm(total=total, initial=global_step, unit=" steps", unit_scale=True,
                  mininterval=interval) as bar:  # fmt: skip
            while True:
                evaluate_due(run, agent, envs, eval_envs, global_step, args, bar)
                if global_step == total:
                    break
                act = exploration(agent, noise, args)
                batch, ended = collect(agent, act, envs, storage, args, bar)
                learning_rate = args.learning_rate
                if args.anneal_lr:
                    learning_rate *= 1 - global_step / total
                optimizer, metrics = learn(agent, optimizer, batch, learning_rate, update, args)
                if not nn.utils.parameters_to_vector(agent.parameters()).isfinite().all():
                    raise FloatingPointError("training diverged, parameters are not finite: lower "
                                             "--learning-rate")  # fmt: skip
                global_step += steps_per_update

                episodes += ended
                if (global_step - run.logged_step) * 1000 >= args.total_timesteps:
                    *_, returns, values = batch
                    unexplained = (returns - values).var() / returns.var().clamp(min=1e-12)
                    metrics |= {"explained_variance": 1 - unexplained}
                    metrics |= {"learning_rate": learning_rate}
                    metrics = {f"losses/{name}": float(x) for name, x in metrics.items()}
                    metrics["rollout/std"] = agent.log_std.exp().mean().item()
                    run.log_update(global_step, metrics, episodes)
                    episodes = []
                if time.time() > run.saved_time + 5 or global_step == total:
                    state = {"optimizer": optimizer, "noise": noise.state_dict()}
                    state |= acting_state(agent, envs) | {"torch_rng": torch.get_rng_state()}
                    run.save_checkpoint(global_step=global_step, **state)
        run.finish(global_step)


if __name__ == "__main__":
    main(parse_args())
