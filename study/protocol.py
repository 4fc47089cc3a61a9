"""The study of "Colored Noise in PPO" (AAAI 2024): its environments, axes, settings and presets.

Everything else in study/ takes them from here. Importing this file imports no package.
"""

import re

COMPLEX = ["PointPush-v1", "AntPush-v1", "PointPushMaze-v1", "AntPushMaze-v1"]  # Sec. A8
NAMES = {  # environment id: its name in the paper (Sec. A4)
    "MountainCarContinuous-v0": "Mountain Car",
    "door-v0": "Door",
    "dm_control/ball_in_cup-catch-v0": "Ball in Cup (Catch)",
    "dm_control/cartpole-balance_sparse-v0": "Cartpole Balance",
    "dm_control/cartpole-swingup_sparse-v0": "Cartpole Swingup",
    "dm_control/cheetah-run-v0": "Cheetah Run",
    "dm_control/hopper-hop-v0": "Hopper Hop",
    "dm_control/pendulum-swingup-v0": "Pendulum Swingup",
    "dm_control/reacher-hard-v0": "Reacher Hard",
    "dm_control/walker-run-v0": "Walker Run",
    "PointUMaze-v1": "UMaze Point",
    "AntUMaze-v1": "UMaze Ant",
    "SwimmerUMaze-v1": "UMaze Swimmer",
    "Point4Rooms-v1": "4 Rooms Point",
    "Ant4Rooms-v1": "4 Rooms Ant",
    "Swimmer4Rooms-v1": "4 Rooms Swimmer",
    **dict(
        zip(COMPLEX, ["Point Push", "Ant Push", "Point Push Maze", "Ant Push Maze"], strict=True)
    ),
}
MAIN = [env_id for env_id in NAMES if env_id not in COMPLEX]  # those of the paper's averages
BETAS = [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2]
N_ENVS = [1, 2, 4, 8, 16, 32, 64, 128]
SEEDS = list(range(1, 21))
METHODS = ["ppo", "trpo", "a2c", "gsde"]  # Sec. A7, A13

# The settings of every run (Sec. A5), where a preset does not vary them. The paper's dm_control
# runs had no bootstrap at time limits, the others had: see `bootstraps`.
SETTINGS = {
    "method": "ppo",
    "total_timesteps": 2_048_000,
    "eval_freq": 10_240,
    "max_episode_steps": None,
    "noise_seq_len": 1000,
    "n_steps": 2048,
    "batch_size": 128,
    "n_epochs": 10,
    "gamma": 0.99,
    "learning_rate": 2.5e-4,
    "anneal_lr": False,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "normalize_advantage": True,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "env_kwargs": None,
    "rescale_actions": False,
    "normalize_obs": False,
    "normalize_rewards": False,
}

# Gymnasium's MuJoCo tasks with the settings that are usual there (results/plans.md): CleanRL's with
# one environment, and many environments with short rollouts, as on GPUs
GYMNASIUM = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Swimmer-v5", "Humanoid-v5"]
USUAL = "--total-timesteps 1000000 --eval-freq 50000 --eval-episodes 10 --learning-rate 3e-4 "
USUAL += "--anneal-lr --normalize-obs --normalize-rewards"
GYMNASIUM_FLAGS = {  # by n_envs
    1: f"{USUAL} --n-steps 2048 --batch-size 64".split(),
    32: f"{USUAL} --n-steps 128 --batch-size 512".split(),
}

# What run_sweep.sh varies: the values of each axis that a preset does not give otherwise
GRID = {"seeds": SEEDS, "envs": MAIN, "n_envs": [4], "betas": BETAS}
GRID |= {"n_epochs": [10], "methods": ["ppo"]}
PRESETS = {
    "quick": {"envs": ["MountainCarContinuous-v0"], "betas": [0, 0.5], "seeds": [1, 2]},
    "main": {"n_envs": N_ENVS},
    "vanilla": {"n_envs": N_ENVS, "betas": ["vanilla"]},
    "n_steps": {"n_envs": [2, 4, 8], "betas": [0.5]},
    "n_epochs": {"n_epochs": [5, 10, 20], "betas": [0.2, 0.5, 0.75]},
    "complex": {"envs": COMPLEX},
    "transfer": {"methods": ["trpo", "a2c"]},
    "gymnasium": {"envs": GYMNASIUM, "betas": [0, 0.5, 1], "n_envs": [1, 32], "seeds": SEEDS[:8]},
    "gsde": {"n_envs": N_ENVS, "betas": ["gsde"], "methods": ["gsde"]},
}


def bootstraps(env_id):
    """Whether the paper's runs of this environment added gamma * V(obs) at time limits."""
    return not env_id.startswith("dm_control/")


def ids_named(word, names=NAMES):
    """Those of the ids that the word names: in full, short as cheetah-run, or as in the paper."""
    pattern = rf"(dm_control/)?{re.escape(word)}(-v\d+)?"
    return [i for i, name in names.items() if re.fullmatch(pattern, i) or name == word]
