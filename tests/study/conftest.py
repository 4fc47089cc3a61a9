"""Made-up runs, as files and as tables."""

import json

import numpy as np
import pandas as pd
import pytest

from study import protocol, runs

ARGS = {
    **{key: protocol.SETTINGS[key] for key in ("n_steps", "batch_size", "n_epochs", "gamma")},
    **{"learning_rate": 2.5e-4, "noise_seq_len": 1000, "normalize_advantage": True},
    **{"eval_freq": 10, "eval_episodes": 50, "compile": True, "device": "cpu", "runs_dir": "runs"},
}


def _write_run(root, env_id, beta, n_envs, seed, returns, exp_name="test", **other):
    vanilla = beta == "vanilla"
    args = {**ARGS, "env_id": env_id, "beta": [0.5 if vanilla else beta], "vanilla": vanilla}
    args |= {"n_envs": n_envs, "seed": seed, "total_timesteps": 10 * len(returns)}
    args |= {"exp_name": exp_name, "bootstrap_timeouts": protocol.bootstraps(env_id), **other}
    name = f"{beta}" if vanilla else f"beta_{beta:g}"
    folder = root / exp_name / env_id.replace("/", "_") / name / f"n_envs_{n_envs}" / f"seed_{seed}"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"args": args, "git_commit": "abc"}))
    rows = "".join(f"{10 * (i + 1)},{x:.9g},1,200\n" for i, x in enumerate(returns))
    (folder / "evaluations.csv").write_text("step,return_mean,return_std,length_mean\n" + rows)
    summary = {"performance": np.mean(returns), "final_return": returns[-1], "wall_seconds": 1.5}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture
def write_run():
    """write_run(root, env_id, beta, n_envs, seed, returns, ...) writes a complete run's folder.

    beta: a number, or "vanilla"; more arguments of the run by name. Returns the folder.
    """
    return _write_run


@pytest.fixture
def write_sweep():
    """write_sweep(root, {beta: level}, ...) writes runs of 4 evaluations about these levels.

    Returns {(beta, n_envs): returns, (seeds, 4)}.
    """

    def write(
        root, levels, n_envs=(4,), seeds=5, env_id="dm_control/pendulum-swingup-v0", spread=1
    ):
        rng, truth = np.random.default_rng(0), {}
        for beta, level in levels.items():
            for n in n_envs:
                truth[beta, n] = level + spread * rng.normal(size=(seeds, 4))
                for seed, returns in enumerate(truth[beta, n], start=1):
                    _write_run(root, env_id, beta, n, seed, returns)
        return truth

    return write


@pytest.fixture
def selected():
    """selected(paths ...): the runs to average in these folders or files."""
    return lambda *paths: runs.select(runs.load(paths)[0])[0]


@pytest.fixture
def short_study(monkeypatch):
    """short_study(4): as if the study's runs had had 4 evaluations, one after every 10 steps."""

    def shorten(evaluations):
        monkeypatch.setitem(protocol.SETTINGS, "total_timesteps", 10 * evaluations)
        monkeypatch.setitem(protocol.SETTINGS, "eval_freq", 10)

    return shorten


@pytest.fixture
def made_up():
    """made_up(level, ...): runs with the study's settings about level(env_id, beta, n_envs).

    A table as `select` gives it; more columns by name.
    """

    def make(level, envs=protocol.MAIN, betas=(0, 0.5, 1), n_envs=(1, 4, 32), seeds=5, **other):
        axes = {"env_id": envs, "beta": betas, "n_envs": n_envs, "seed": range(seeds)}
        rows = pd.MultiIndex.from_product(axes.values(), names=axes).to_frame(index=False)
        levels = [level(*row) for row in zip(rows.env_id, rows.beta, rows.n_envs, strict=True)]
        rows["performance"] = levels + 0.3 * np.random.default_rng(0).normal(size=len(rows))
        rows["environment"] = rows.env_id.map(protocol.NAMES)
        settings = protocol.SETTINGS | {"vanilla": rows.beta.isna(), **other}
        settings |= {"bootstrap_timeouts": rows.env_id.map(protocol.bootstraps)}
        return rows.assign(final_return=rows.performance, **settings)

    return make
