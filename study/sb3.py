"""PPO of Stable-Baselines3: the paper's own stack, in today's versions, to compare results with.

    pip install -r requirements.txt -r tests/requirements.txt
    python -m study.sb3 --env-id dm_control/pendulum-swingup-v0 --vanilla --n-envs 1 \
        --no-bootstrap-timeouts --eval-freq 204800 --eval-episodes 10

The flags are those of ppo_colored_continuous.py, as far as they apply, and so are the files of a
run but for checkpoint.pt: a run that was stopped starts again. Environments, networks, rollout,
update and evaluation are those of Gymnasium and Stable-Baselines3, the noise is pink-noise-rl's.
"""

import sys

import gymnasium as gym
import numpy as np
import shimmy  # noqa: F401  registers dm_control's ids
import torch
from pink import ColoredNoiseProcess
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import ppo_colored_continuous as ppo
from study import environments

SETTINGS = ["n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda"]
SETTINGS += ["clip_range", "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm", "seed"]
# The other flags that have an effect here
USED = {*SETTINGS, "env_id", "n_envs", "bootstrap_timeouts", "vanilla", "beta", "noise_seq_len"}
USED |= {"total_timesteps", "eval_freq", "eval_episodes", "exp_name", "runs_dir", "overwrite"}


class ColoredGaussian(DiagGaussianDistribution):
    """Draws its actions from the noise, as the paper's code does."""

    def __init__(self, noise, action_dim):
        super().__init__(action_dim)
        self.noise = noise

    def sample(self):
        eps = torch.as_tensor(self.noise.sample(), dtype=torch.float32)
        return self.distribution.mean + self.distribution.stddev * eps


class EndAtTimeLimit(gym.Wrapper):
    """A time limit is the end of the task, as in the paper's dm_control: no bootstrap there."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or truncated, False, info


def make_envs(args, n_envs, seed=None):
    def wrap(env):
        env = gym.wrappers.FlattenObservation(env)
        return env if args.bootstrap_timeouts else EndAtTimeLimit(env)

    return make_vec_env(args.env_id, n_envs, seed=seed, wrapper_class=wrap)


def make_model(args):
    """Stable-Baselines3's PPO with its environments. It draws white noise if args.vanilla."""
    settings = {name: getattr(args, name) for name in SETTINGS}
    # PPO seeds the environments, with `seed`, `seed` + 1, ...
    model = PPO("MlpPolicy", make_envs(args, args.n_envs), device="cpu", **settings)
    if not args.vanilla:
        [beta], action_dim = args.beta, model.action_space.shape[0]
        rng = np.random.default_rng([args.seed, 0])
        noise = ColoredNoiseProcess(beta, (args.n_envs, action_dim, args.noise_seq_len), rng=rng)
        model.policy.action_dist = ColoredGaussian(noise, action_dim)
    return model


def parse_args(argv):
    defaults = {"method": "sb3", "exp_name": "sb3", "envpool": False, "compile": False}
    args = ppo.parse_args(argv, **defaults)
    for name, value in vars(ppo.parse_args([], **defaults)).items():
        if name not in USED and getattr(args, name) != value:
            sys.exit(f"--{name.replace('_', '-')} has no effect in study.sb3: leave it out")
    if args.eval_freq % (args.n_envs * args.n_steps):
        sys.exit("--eval-freq must be a multiple of n_envs * n_steps, the steps of an update")
    return args


def main(args):
    torch.set_num_threads(1)
    environments.quiet_packages()
    with ppo.lock(ppo.run_path(args)):
        run = ppo.Run(args)
        if run.complete:
            return
        _, eval_seed = ppo.make_seeds(2, args.seed, 5)
        model, eval_envs = make_model(args), make_envs(args, args.eval_episodes, eval_seed)
        how = {"n_eval_episodes": args.eval_episodes, "return_episode_rewards": True}
        for step in range(args.eval_freq, args.total_timesteps + 1, args.eval_freq):
            model.learn(args.eval_freq, reset_num_timesteps=False)
            returns, lengths = map(np.array, evaluate_policy(model, eval_envs, **how))
            run.add_evaluation(step, returns, lengths, {"agent": model.policy})
        run.finish(model.num_timesteps)


if __name__ == "__main__":
    main(parse_args(sys.argv[1:]))
