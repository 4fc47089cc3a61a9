"""PPO of Stable-Baselines3, the paper's own stack on today's versions, to compare results with.

    pip install -r requirements.txt -r tests/requirements.txt
    python -m study.sb3 --env-id dm_control/pendulum-swingup-v0 --vanilla --no-bootstrap-timeouts

Task and settings are given by the flags of ppo_colored_continuous.py, and the run's folder has the
same files. Nothing else of the script takes part: environments, networks, rollout, update and
evaluation are those of Gymnasium and Stable-Baselines3. A run that was stopped starts again.
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from pink import ColoredNoiseProcess
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import ppo_colored_continuous as ppo

SETTINGS = ["n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda"]
SETTINGS += ["clip_range", "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm"]
# The other flags that take effect here; the rest must keep their defaults
USED = {*SETTINGS, "env_id", "seed", "total_timesteps", "eval_freq", "eval_episodes", "beta"}
USED |= {"noise_seq_len", "vanilla", "n_envs", "bootstrap_timeouts", "exp_name", "runs_dir"}
USED |= {"overwrite", "method"}


class ColoredGaussian(DiagGaussianDistribution):
    """Draws its actions from the noise, as the paper's code does."""

    def __init__(self, noise, action_dim):
        super().__init__(action_dim)
        self.noise = noise

    def sample(self):
        eps = torch.as_tensor(self.noise.sample(), dtype=torch.float32)
        return self.distribution.mean + self.distribution.stddev * eps


class EndAtTimeLimit(gym.Wrapper):
    """A time limit is an ordinary end, as in the paper's dm_control: no bootstrap."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or truncated, False, info


def make_model(args):
    """Stable-Baselines3's PPO, with white noise of its own if args.vanilla; and its environments.

    Returns the model and as many environments for evaluation as there are episodes in one.
    """
    if args.env_id.startswith("dm_control/"):
        import shimmy  # noqa: F401  registers the ids

    def wrap(env):
        env = gym.wrappers.FlattenObservation(env)
        return env if args.bootstrap_timeouts else EndAtTimeLimit(env)

    env_seed, eval_seed, noise_seed = ppo.make_seeds(3, args.seed, 5)
    envs = make_vec_env(args.env_id, args.n_envs, seed=env_seed, wrapper_class=wrap)
    eval_envs = make_vec_env(args.env_id, args.eval_episodes, seed=eval_seed, wrapper_class=wrap)
    settings = {name: getattr(args, name) for name in SETTINGS}
    model = PPO("MlpPolicy", envs, seed=args.seed, device="cpu", **settings)
    if not args.vanilla:
        action_dim, [beta] = model.action_space.shape[0], args.beta
        shape, rng = (
            (args.n_envs, action_dim, args.noise_seq_len),
            np.random.default_rng(noise_seed),
        )
        noise = ColoredNoiseProcess(beta, shape, rng=rng)
        model.policy.action_dist = ColoredGaussian(noise, action_dim)
    return model, eval_envs


def parse_args(argv):
    defaults = {"method": "sb3", "exp_name": "sb3", "envpool": False, "compile": False}
    args = ppo.parse_args(argv, **defaults)
    for name, value in vars(ppo.parse_args([], **defaults)).items():
        if name not in USED and getattr(args, name) != value:
            sys.exit(f"study.sb3 has no --{name.replace('_', '-')}")
    if args.eval_freq % (args.n_envs * args.n_steps):
        sys.exit("study.sb3 evaluates after updates: --eval-freq must be a multiple of their steps")
    return args


def main(args):
    torch.set_num_threads(1)
    with ppo.lock(ppo.run_path(args)):
        run = ppo.Run(args)
        if run.complete:
            print(f"nothing was run, {run.path} is complete: use --overwrite or --exp-name NAME")
            return
        model, eval_envs = make_model(args)
        run.start()
        for step in range(args.eval_freq, args.total_timesteps + 1, args.eval_freq):
            model.learn(args.eval_freq, reset_num_timesteps=False)
            how = {"n_eval_episodes": args.eval_episodes, "return_episode_rewards": True}
            returns, lengths = map(np.array, evaluate_policy(model, eval_envs, **how, warn=False))
            run.add_evaluation(step, returns, lengths, {"agent": model.policy})
        run.finish(model.num_timesteps)


if __name__ == "__main__":
    main(parse_args(sys.argv[1:]))
