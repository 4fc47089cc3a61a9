"""Normalization of observations and rewards: --normalize-obs and --normalize-rewards."""

import numpy as np
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers.utils import RunningMeanStd


class NormalizedVectorEnv(VectorWrapper):
    """Normalizes observations and rewards as VecNormalize of Stable-Baselines3 does.

    From observations the running mean is subtracted, and they are divided by the running std.
    Rewards are divided by the running std of the discounted return; no mean is subtracted. Both are
    clipped to [-10, 10]. The original rewards are in infos["raw_rewards"].
    """

    def __init__(self, env, args):
        super().__init__(env)
        self._args, self._training = args, True
        self._returns = np.zeros(self.num_envs)  # discounted, of each environment's episode
        self._statistics = {}
        if args.normalize_obs:
            self._statistics["obs"] = RunningMeanStd(shape=env.single_observation_space.shape)
        if args.normalize_rewards:
            self._statistics["returns"] = RunningMeanStd()

    def frozen(self, env):
        """Wraps env, to evaluate in: observations are normalized by the statistics of this one.

        They are not updated there, and rewards are not normalized.
        """
        other = NormalizedVectorEnv(env, self._args)
        other._training = False
        other._statistics = {k: v for k, v in self._statistics.items() if k == "obs"}
        return other

    def normalized(self, obs):
        statistics = self._statistics["obs"]
        obs = (obs - statistics.mean) / np.sqrt(statistics.var + 1e-8)
        return np.clip(obs, -10, 10).astype(np.float32)

    def reset(self, **kwargs):
        obs, infos = self.env.reset(**kwargs)
        self._returns[:] = 0
        return self._observed(obs), infos

    def step(self, actions):
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        done = terminated | truncated
        if "returns" in self._statistics:
            infos["raw_rewards"] = rewards
            self._returns = self._returns * self._args.gamma + rewards
            self._statistics["returns"].update(self._returns)
            std = np.sqrt(self._statistics["returns"].var + 1e-8)
            rewards = np.clip(rewards / std, -10, 10)
            self._returns[done] = 0
        if "obs" in self._statistics:
            obs = self._observed(obs)
            for i in np.flatnonzero(done):
                infos["final_obs"][i] = self.normalized(infos["final_obs"][i])
        return obs, rewards, terminated, truncated, infos

    def _observed(self, obs):
        if "obs" not in self._statistics:
            return obs
        if self._training:
            self._statistics["obs"].update(obs)
        return self.normalized(obs)

    def state_dict(self):
        """The statistics, as plain numbers and lists."""
        return {
            name: {key: np.asarray(value).tolist() for key, value in vars(statistics).items()}
            for name, statistics in self._statistics.items()
        }

    def load_state_dict(self, state):
        for name, values in state.items():
            for key, value in values.items():
                setattr(self._statistics[name], key, np.asarray(value))
