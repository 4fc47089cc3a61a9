"""analysis.py: reading runs, what may be averaged, statistics, published numbers, status."""

import fcntl
import gzip
import json
import runpy
import subprocess
import sys
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from scipy import stats

import analysis
from environments import COMPLEX, NAMES

PENDULUM, CAR, PUSH = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0", "PointPush-v1"
ARGS = dict(
    **dict(n_steps=2048, batch_size=128, n_epochs=10, learning_rate=2.5e-4, gamma=0.99),
    **dict(noise_seq_len=1000, eval_freq=10, eval_episodes=50, normalize_advantage=True),
    **dict(
        compile=True,
        device="cpu",
        exp_name="test",
        runs_dir="runs",
        resume=False,
        overwrite=False,
        track=False,
    ),
)


def write_run(root, env_id, beta, n_envs, seed, returns, **other):
    """A made-up complete run in the format of run_files.py; beta "vanilla" for --vanilla."""
    vanilla = beta == "vanilla"
    args = {
        **ARGS,
        "env_id": env_id,
        "beta": [0.5 if vanilla else beta],
        "vanilla": vanilla,
        "n_envs": n_envs,
    }
    args |= {"seed": seed, "total_timesteps": 10 * len(returns), **other}
    args.setdefault("bootstrap_timeouts", not env_id.startswith("dm_control/"))  # as in the study
    beta = "vanilla" if vanilla else f"beta_{beta:g}"
    folder = (
        root
        / args["exp_name"]
        / env_id.replace("/", "_")
        / beta
        / f"n_envs_{n_envs}"
        / f"seed_{seed}"
    )
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"args": args, "git_commit": "abc"}))
    rows = "".join(f"{10 * (i + 1)},{x:.9g},1,200\n" for i, x in enumerate(returns))
    (folder / "evaluations.csv").write_text("step,return_mean,return_std,length_mean\n" + rows)
    summary = {
        "performance": np.mean(returns),
        "final_return": returns[-1],
        "steps": 40,
        "wall_seconds": 1.5,
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def write_sweep(root, levels, n_envs=(4,), seeds=5, env_id=PENDULUM, spread=1.0):
    """Runs of 4 evaluations about levels[beta]; returns {(beta, n_envs): (seeds, 4) returns}."""
    rng, truth = np.random.default_rng(0), {}
    for beta, level in levels.items():
        for n in n_envs:
            truth[beta, n] = level + spread * rng.normal(size=(seeds, 4))
            for seed, returns in enumerate(truth[beta, n], start=1):
                write_run(root, env_id, beta, n, seed, returns)
    return truth


def select(*paths, **filters):
    return analysis.select(analysis.load(paths, **filters)[0])[0]


@pytest.fixture(name="run")
def run_file(monkeypatch, capsys):
    """run("plot.py results", ...) runs a file as a user does: exit code, stdout and stderr."""

    def run_as_user(command, *arguments):
        monkeypatch.setattr(sys, "argv", [*command.split(), *map(str, arguments)])
        code = 0
        try:
            runpy.run_path(str(ROOT / sys.argv[0]), run_name="__main__")
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run_as_user


def study(monkeypatch, evaluations):
    """As if the study had had so many evaluations, one after every 10 steps."""
    protocol = {"total_timesteps": 10 * evaluations, "eval_freq": 10}
    monkeypatch.setattr(analysis, "STUDY", analysis.STUDY | protocol)


def test_load_gives_settings_performance_and_curves(tmp_path):
    write_run(tmp_path, PENDULUM, -1, 4, 3, [1.0, 2.0, 6.0])
    write_run(tmp_path, "Unknown-v0", "vanilla", 2, 1, [5.0], exp_name="other")
    runs, curves = analysis.load([tmp_path])
    runs, curves = runs.set_index("environment"), curves.set_index(runs.environment)
    assert runs.performance.to_dict() == {"Pendulum Swingup": 3.0, "Unknown-v0": 5.0}
    assert runs.final_return.to_dict() == {"Pendulum Swingup": 6.0, "Unknown-v0": 5.0}
    assert runs.beta.to_dict() == {"Pendulum Swingup": "-1", "Unknown-v0": "vanilla"}
    assert curves.loc["Pendulum Swingup"].to_dict() == {10: 1.0, 20: 2.0, 30: 6.0}
    chosen = select(tmp_path).set_index("environment")
    assert chosen.beta["Pendulum Swingup"] == -1 and np.isnan(chosen.beta["Unknown-v0"])
    assert chosen.vanilla.to_dict() == {"Pendulum Swingup": False, "Unknown-v0": True}
    for name in ("pendulum-swingup", PENDULUM, "Pendulum Swingup", "Unknown", "Unknown-v0"):
        assert len(analysis.load([tmp_path], env=[name])[0]) == 1


def test_all_environments_of_the_paper_have_its_names():
    names, averaged = set(NAMES.values()), {NAMES[key] for key in NAMES if key not in COMPLEX}
    assert set(analysis.published("final_return_per_beta").environment) == averaged
    assert len(names) == 20 and len(averaged) == 16


def test_standardized_within_each_environment(tmp_path):
    # By hand: 0, 0, 4, 4 have mean 2 and standard deviation 2; a constant says nothing
    for seed in (1, 2):
        for beta, performance in ((0, 0.0), (1, 4.0)):
            write_run(tmp_path, PENDULUM, beta, 4, seed, [performance - 1, performance + 1])
            write_run(tmp_path, CAR, beta, 4, seed, [0.1, 0.1])
    runs = select(tmp_path)
    z = analysis.standardize(runs)
    assert z[(runs.env_id == PENDULUM) & (runs.beta == 0)].tolist() == [-1, -1]
    assert z[(runs.env_id == PENDULUM) & (runs.beta == 1)].tolist() == [1, 1]
    assert (z[runs.env_id == CAR] == 0).all()


def test_intervals_are_scipys_bca():
    values = np.random.default_rng(1).exponential(size=(7, 3))
    mean, low, high = analysis.mean_interval(values)
    for column in range(3):
        ci = stats.bootstrap(
            (values[:, column],),
            np.mean,
            method="BCa",
            n_resamples=9999,
            rng=np.random.default_rng(5),
        ).confidence_interval
        assert mean[column] == pytest.approx(values[:, column].mean())
        width = ci.high - ci.low
        assert (
            abs(low[column] - ci.low) < 0.05 * width and abs(high[column] - ci.high) < 0.05 * width
        )
        # BCa of a skewed sample is not symmetric, unlike a t interval
        assert (
            high[column] - mean[column] > 1.1 * (mean[column] - low[column])
            or stats.skew(values[:, column]) < 0.5
        )
    np.testing.assert_allclose(
        analysis.mean_interval(values[:, 1]), [mean[1], low[1], high[1]], rtol=0.02
    )


@pytest.mark.filterwarnings("error")
def test_intervals_of_degenerate_data():
    assert np.array_equal(analysis.mean_interval([2.0]), [2.0, np.nan, np.nan], equal_nan=True)
    assert analysis.mean_interval([0.0] * 5) == (0, 0, 0)
    mean, low, high = analysis.mean_interval([[1.0, 0.1], [2.0, 0.1], [4.0, 0.1]])
    assert low[0] < mean[0] < high[0] and low[1] == mean[1] == high[1]


@pytest.mark.filterwarnings("error")
def test_welch():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=20), 0.5 + 2 * rng.normal(size=7)
    assert analysis.welch(a, b) == pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue)
    t = (a.mean() - b.mean()) / np.sqrt(
        a.var(ddof=1) / 20 + b.var(ddof=1) / 7
    )  # Welch (1947), with his degrees of freedom
    va, vb = a.var(ddof=1) / 20, b.var(ddof=1) / 7
    df = (va + vb) ** 2 / (va**2 / 19 + vb**2 / 6)
    assert analysis.welch(a, b) == pytest.approx(2 * stats.t.sf(abs(t), df))
    assert np.isnan(analysis.welch([1.0], [1.0, 2.0]))
    assert analysis.welch([3.0, 3.0], [3.0, 3.0]) == 1
    assert analysis.welch([0.0, 0.0], [94.0, 93.9]) < 0.01
    # Weights: a run of weight 2 moves the mean like two, and all the same ones change nothing
    assert analysis.welch(a, b, [3] * 20, [0.1] * 7) == pytest.approx(analysis.welch(a, b))
    assert analysis.welch([0, 0.1, 5], [5, 5.1], [1, 1, 0.01], [1, 1]) < analysis.welch(
        [0, 0.1, 5], [5, 5.1]
    )


def test_best_beta_per_env(tmp_path, monkeypatch):
    study(monkeypatch, 4)
    truth = write_sweep(tmp_path, {0: 11.6, 0.2: 11, 0.5: 12, 1: 11}, n_envs=(4, 8), seeds=6)
    write_sweep(tmp_path, {0: 5, 0.5: 1}, env_id=CAR, seeds=1)
    table = analysis.best_beta_per_env(select(tmp_path)).set_index("environment")
    pooled = {
        beta: np.concatenate([truth[beta, n].mean(1) for n in (4, 8)]) for beta in (0, 0.2, 0.5, 1)
    }
    row = table.loc["Pendulum Swingup"]
    assert row.best_beta == 0.5 == max(pooled, key=lambda beta: pooled[beta].mean())
    for beta in (0, 1):
        p = stats.ttest_ind(pooled[0.5], pooled[beta], equal_var=False).pvalue
        assert row[f"p_{beta}.0"] == pytest.approx(p, rel=1e-5)
        assert row[f"beta_{beta}.0"] == ("outperformed" if p < 0.05 else "comparable")
    assert row[["beta_0.5", "beta_0.0", "beta_1.0"]].tolist() == [
        "comparable",
        "comparable",
        "outperformed",
    ]
    assert np.isnan(row["p_0.5"]) and 0.05 < row["p_0.0"] < 0.5
    # With one seed there is no test, so no verdict counts, not even that of the best itself
    verdicts = table.loc["Mountain Car", ["best_beta", "beta_0.0", "beta_0.5", "beta_1.0"]]
    assert verdicts.tolist() == [0, "", "", ""]
    assert table.loc["comparable in", "beta_0.0"] == "1/1"
    assert table.loc["comparable in", "beta_0.5"] == "1/1"
    assert table.loc[
        "Pendulum Swingup", ["paper_best_beta", "paper_beta_0.5", "paper_p_0.5"]
    ].tolist() == [
        0.75,
        "comparable",
        0.92,
    ]


def test_best_beta_per_n_envs(tmp_path, monkeypatch):
    study(monkeypatch, 4)
    write_sweep(tmp_path, {0: 4, 0.5: 5, 1: 3}, n_envs=(4,), spread=0.1)
    write_sweep(tmp_path, {0: 0, 0.5: 1, 1: 2}, n_envs=(32,), spread=0.1)
    runs = select(tmp_path)
    table = analysis.best_beta_per_n_envs(runs).set_index("n_envs")
    assert table.best_beta.to_dict() == {4: 0.5, 32: 1}
    z = (runs.performance - runs.performance.mean()) / runs.performance.std(ddof=0)
    assert table.standardized_performance[32] == pytest.approx(
        z[(runs.n_envs == 32) & (runs.beta == 1)].mean()
    )
    assert table.paper_best_beta.to_dict() == {4: 0.5, 32: 0.75}


def test_final_return_tables(tmp_path, monkeypatch):
    study(monkeypatch, 2)
    # Published for this cell is 677.5, a rounded number, which an interval of 677.54 still holds
    for seed in (1, 2):
        write_run(tmp_path, PENDULUM, 0, 4, seed, [0.0, 677.54])
        write_run(tmp_path, PENDULUM, 0.5, 4, seed, [1.0, 694.66])  # published: 694.6
        write_run(tmp_path, PENDULUM, "vanilla", 4, seed, [2.0, 3.0])
    write_run(tmp_path, PENDULUM, 1, 4, 1, [0.0, 403.1])  # one seed: no interval
    runs = select(tmp_path)
    table = analysis.final_returns(runs).set_index("beta")
    assert table["mean"].to_dict() == {"0": 677.54, "0.5": 694.66, "vanilla": 3, "1": 403.1}
    assert table.paper.to_dict() == {"0": 677.5, "0.5": 694.6, "vanilla": 733.1, "1": 403.1}
    inside = {"0": "yes", "0.5": "no", "vanilla": "no", "1": ""}
    assert table.in_interval.fillna("").to_dict() == inside
    wide = analysis.final_return_per_beta(table.reset_index())
    titles = "environment n_envs runs beta 0 paper, 0 beta 0.5 paper, 0.5 beta 1 paper, 1"
    assert " ".join(wide) == f"{titles} beta vanilla paper, vanilla"
    assert wide.iloc[0].tolist() == [
        *("Pendulum Swingup", 4, 7, "677.5 [677.5, 677.5]", "677.5", "694.7 [694.7, 694.7]"),
        *("694.6 (outside)", "403.1", "403.1", "3.0 [3.0, 3.0]", "733.1 (outside)"),
    ]
    other = table.reset_index().replace({"beta": {"0": "10", "0.5": "-2", "1": "-1"}})
    titles = " ".join(analysis.final_return_per_beta(other).filter(like="beta"))
    assert titles == "beta -2 beta -1 beta 10 beta vanilla"
    summary = analysis.final_return_and_performance(runs[~runs.vanilla]).iloc[0]
    assert summary.final_return_mean == pytest.approx((677.54 + 694.66 + 403.1) / 3)
    assert summary.performance_max == pytest.approx(347.83)
    assert summary.paper_performance_max == 678.91


def test_final_returns_on_the_published_scale(tmp_path, monkeypatch):
    """By hand: pendulum's published means go from 1.1 to 766.9, Mountain Car's from 0 to 96.7."""
    study(monkeypatch, evaluations=2)
    for seed, off in ((1, -10), (2, 10)):
        for beta, end in ((0, 1.1), (0.2, 766.9)):
            write_run(tmp_path, PENDULUM, beta, 4, seed, [0.0, end + off])
            write_run(tmp_path, CAR, beta, 4, seed, [0.0, 96.7 * beta])
    write_run(tmp_path, CAR, 0.2, 32, 1, [0.0, 0.0])
    write_run(tmp_path, CAR, 0.3, 4, 1, [0.0, 1.0])  # no such beta in the paper
    write_run(tmp_path / "b", CAR, 1, 4, 1, [0.0, 1.0], gamma=0.9)  # not its protocol
    runs = pd.concat([select(tmp_path / "test"), select(tmp_path / "b")], ignore_index=True)
    table = analysis.average_final_returns(runs)
    assert table[["n_envs", "beta", "runs", "environments"]].to_numpy().tolist() == [
        [4, 0, 4, 2],
        [4, 0.2, 4, 2],
        [32, 0.2, 1, 1],
    ]
    np.testing.assert_allclose(table["mean"], [0, (1 + 0.2) / 2, 0], atol=1e-9)
    paper = [(677.5 - 1.1) / 765.8 / 2, (1 + 23.4 / 96.7) / 2, 93.8 / 96.7]
    np.testing.assert_allclose(table.paper, paper)
    assert (table.high - table.low)[:2].between(0.005, 0.02).all() and np.isnan(table.low[2])
    with pytest.raises(analysis.Unusable, match="the study's protocol"):
        analysis.on_published_scale(select(tmp_path / "b"))


def test_published_tables_agree():
    """The mean over 8 betas and 8 n_envs, without vanilla, is the published mean to rounding."""
    cells = analysis.published("final_return_per_beta")
    summary = analysis.published("final_return_and_performance").set_index("environment")
    colored = cells[cells.beta != "vanilla"].groupby("environment").final_return_mean
    assert (colored.count() == 64).all() and len(summary) == 16
    # Cells are rounded to 0.1, so a mean of 64 is wrong by 0.0036 (one sigma), and itself to 0.01
    np.testing.assert_allclose(
        colored.mean(), summary.final_return_mean[colored.mean().index], rtol=0, atol=0.015
    )
    everything = cells.groupby("environment").final_return_mean.mean()
    assert (everything - summary.final_return_mean).abs().max() > 1
    best = analysis.published("best_beta_per_env")
    assert [(best[f"beta_{beta}_comparable"] == "yes").sum() for beta in ("0.5", "0.0", "1.0")] == [
        11,
        8,
        7,
    ]  # Table 1


def test_projected_ranks_from_the_published_best_betas():
    """By hand: sigma(beta) in closed form, written out again, then sigma*, E_ij and ranks."""
    T, betas, n_envs = 1000, [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2], [1, 2, 4, 8, 16, 32, 64, 128]

    def sigma(beta):
        f = np.arange(1, T // 2 + 1) / T
        w = f ** (-beta / 2)
        w[-1] /= 2
        # The DC bin is real, its std sqrt(2) s_1; divided by T in the inverse FFT, then by sigma
        return np.sqrt(2) * f[0] ** (-beta / 2) / T / (2 / T * np.sqrt((w**2).sum()))

    assert [round(sigma(beta), 4) for beta in (0, 0.5, 1, 2)] == [
        0.0316,
        0.1075,
        0.2713,
        0.5517,
    ]  # spec
    paper = analysis.published("best_beta_per_n_envs").set_index("n_envs").best_beta
    assert paper.to_dict() == {1: 0.2, 2: 0.5, 4: 0.5, 8: 0.75, 16: 0.75, 32: 0.75, 64: 0.5, 128: 2}
    star = sum(sigma(beta) / n**0.5 for n, beta in paper.items()) / 8
    ranks = analysis.projected_ranks(paper, betas, n_envs, T)
    for n in n_envs:
        E = [(star - sigma(beta) / n**0.5) ** 2 for beta in betas]
        assert ranks[n].tolist() == [1 + sum(other < e for other in E) for e in E]
    # The trend of the paper: more environments, more correlated noise.
    assert ranks.idxmin().tolist() == [0.2, 0.2, 0.5, 0.5, 0.75, 1, 1.25, 2]


def test_robust_statistics(tmp_path):
    levels = {0: 0.0, 0.5: 0.7, 1: 50.0}
    truth = write_sweep(tmp_path, levels, n_envs=(4, 8), seeds=8)
    runs = select(tmp_path)
    table = analysis.robust_statistics(runs).set_index("beta")
    z = analysis.standardize(runs)
    assert table.iqm[0.5] == pytest.approx(stats.trim_mean(z[runs.beta == 0.5], 0.25))
    a, b = ([truth[beta, n].mean(1) for n in (4, 8)] for beta in (0.5, 0))
    u = [stats.mannwhitneyu(x, y).statistic / 64 for x, y in zip(a, b, strict=True)]
    assert table.improvement[0.5] == pytest.approx(np.mean(u))
    assert table.improvement_low[0.5] < table.improvement[0.5] < table.improvement_high[0.5] < 1
    assert table.loc[1, ["improvement", "improvement_low", "improvement_high"]].tolist() == [
        1,
        1,
        1,
    ]
    assert np.isnan(table.improvement[0])
    # Stratified: cells that differ widely, but not within themselves, leave no uncertainty
    constant = runs.assign(performance=runs.n_envs + runs.beta)
    table = analysis.robust_statistics(constant).set_index("beta")
    np.testing.assert_allclose(table.iqm_low, table.iqm_high)


def test_missing_names_each_run_of_the_grid(tmp_path):
    write_sweep(tmp_path, {0: 1, 1: 1}, n_envs=(4,), seeds=3)
    write_sweep(tmp_path, {1: 1}, n_envs=(8,), seeds=2)
    lines = analysis.missing(select(tmp_path))
    assert lines == [
        "Pendulum Swingup, n_envs 8: beta 0, seeds 1 2 3",
        "Pendulum Swingup, n_envs 8: beta 1, seeds 3",
    ]


def test_packed_runs_are_read_like_a_folder(tmp_path, run):
    write_sweep(tmp_path / "runs", {0: 1, 0.5: 2, "vanilla": 1}, n_envs=(1, 4))
    folder = write_run(tmp_path / "runs", CAR, 0.5, 4, 1, [1.0, 2.0], envpool=True)
    (folder / "summary.json").unlink()
    _, stdout, stderr = run("analysis.py pack", tmp_path / "runs", tmp_path / "packed.csv")
    assert "31 runs" in stdout, stderr
    for filters in ({}, {"env": [PENDULUM], "beta": ["0", "vanilla"], "n_envs": [4]}):
        ours, curves = analysis.load([tmp_path / "runs"], **filters)
        packed, packed_curves = analysis.load([tmp_path / "packed.csv"], **filters)
        assert len(ours) == (10 if filters else 31)
        assert (ours.path == packed.path).all() and (ours.status == packed.status).all()
        np.testing.assert_array_equal(curves, packed_curves)
        (runs, left_out), (packed_runs, packed_left_out) = (
            analysis.select(ours),
            analysis.select(packed),
        )
        columns = [*analysis.AXES, "vanilla", "performance", "final_return", "learning_rate"]
        pd.testing.assert_frame_equal(runs[columns], packed_runs[columns])
        assert len(left_out) == len(packed_left_out) == (not filters)
    # Folders and files mix; a run that is in both counts once.
    assert len(select(tmp_path / "runs", tmp_path / "packed.csv")) == 30


# --- What may be averaged


def test_averages_are_of_comparable_cells_that_weigh_the_same(tmp_path):
    """The sweep `main` for beta 0 and 0.5, and `n_epochs`, which adds 0.2 and 0.75 at n_envs 4.

    n_envs 32 is easy, so that pooled over all runs beta 0.5 would look worse than 0.2 and 0.75.
    """
    write_sweep(tmp_path, {0: 1, 0.2: 2, 0.5: 4, 0.75: 3}, n_envs=(4,), spread=0.1)
    write_sweep(tmp_path, {0: -9, 0.5: -6}, n_envs=(32,), spread=0.1, seeds=2)
    runs = select(tmp_path)
    pooled = runs.groupby("beta").performance.mean()
    assert pooled.idxmax() != 0.5
    table = analysis.best_beta_per_env(runs).set_index("environment")
    row = table.loc["Pendulum Swingup", ["best_beta", "beta_0.5", "runs"]]
    assert row.tolist() == [0.5, "comparable", 20]
    robust = analysis.robust_statistics(runs).set_index("beta")
    assert robust.iqm.idxmax() == 0.5 and (robust.cells == 1).all() and robust.runs.sum() == 20
    # For each n_envs the betas that are there, and over n_envs the betas that both have
    assert analysis.best_beta_per_n_envs(runs).best_beta.tolist() == [0.5, 0.5]
    both = analysis.comparable(runs, ["n_envs"], ["environment", "beta"])
    assert sorted(both.beta.unique()) == [0, 0.5] and len(both) == 14
    with pytest.raises(analysis.Unusable, match="one environment with all 3 values of beta"):
        three = runs[(runs.n_envs == 4) & (runs.beta < 0.3)]
        other = runs[(runs.n_envs == 4) & (runs.beta == 0.5)].assign(environment="another")
        analysis.comparable(pd.concat([three, other]), ["beta"], ["environment"])


def test_cells_weigh_the_same_whatever_their_seeds(tmp_path):
    for seed in range(1, 10):
        write_run(tmp_path, PENDULUM, 0, 4, seed, [10.0 + seed % 2])
    for seed in (1, 2):
        write_run(tmp_path, PENDULUM, 0, 32, seed, [float(seed)])
    runs = select(tmp_path)
    cells = [runs[runs.n_envs == n].performance.to_numpy() for n in (4, 32)]
    mean, low, high = analysis.cells_interval(cells)
    assert mean == pytest.approx((np.mean(cells[0]) + 1.5) / 2) and low < mean < high
    # Drawn within cells: by hand, with the percentiles of as many resamples, further from the mean
    rng = np.random.default_rng(1)
    draws = [rng.choice(cell, (20000, len(cell))).mean(1) for cell in cells]
    draws = [
        cell.mean() + (draw - cell.mean()) * (len(cell) / (len(cell) - 1)) ** 0.5
        for cell, draw in zip(cells, draws, strict=True)
    ]
    assert [low, high] == pytest.approx(np.percentile(sum(draws) / 2, [2.5, 97.5]), abs=0.1)
    assert np.isnan(analysis.cells_interval([cells[0], [1.0]])[1:]).all()
    assert analysis.cells_interval([[1, 1], [2, 2]]) == (1.5, 1.5, 1.5)
    table = analysis.final_return_and_performance(runs).iloc[0]
    assert table.performance_mean == pytest.approx(mean) and table.cells == 2
    # One cell is the paper's interval of a mean, wider by the root of 9 / 8
    one = cells[0] + np.arange(9)
    mean, *ends = analysis.mean_interval(one)
    ends = mean + (np.array(ends) - mean) * (9 / 8) ** 0.5
    np.testing.assert_allclose(analysis.cells_interval([one]), [mean, *ends], atol=0.06)


def test_averages_of_cells_with_two_seeds_have_intervals_wide_enough():
    """Of five cells about 87 % hold the mean, in 200 studies, 78 without the factor."""
    rng, bootstrap, held = np.random.default_rng(0), stats.bootstrap, 0
    with mock.patch.object(
        stats, "bootstrap", lambda *a, **k: bootstrap(*a, **k | {"n_resamples": 999})
    ):
        for _ in range(200):
            _, low, high = analysis.cells_interval(rng.normal(size=(5, 2)))
            held += low < 0 < high
    assert 0.82 < held / 200 < 0.95


def test_interquartile_mean_weighs_cells(tmp_path):
    """Sixteen runs at 0 and two at 1 are as much as two and two: the middle half is 0.5."""
    rng = np.random.default_rng(0)
    for n_envs, seeds in ((4, 16), (32, 2)):
        for beta in (0, 1):
            for seed in range(seeds):
                returns = [float(n_envs == 32) + 1e-9 * rng.normal()]
                write_run(tmp_path, PENDULUM, beta, n_envs, seed, returns)
    runs = select(tmp_path)
    z = analysis.standardize(runs)
    middle = (z[runs.n_envs == 4].mean() + z[runs.n_envs == 32].mean()) / 2
    assert analysis.robust_statistics(runs).iqm.tolist() == pytest.approx([middle] * 2, abs=1e-3)


def test_ranks_are_of_the_betas_that_are_there(tmp_path):
    write_sweep(tmp_path, {0: 1, 0.5: 3, 1: 2}, n_envs=(4,), spread=0.1)
    write_sweep(tmp_path, {0: 1, 1: 2}, n_envs=(32,), spread=0.1)
    grid, runs = analysis.performance_grid(select(tmp_path))
    assert len(runs) == 25 and grid.notna().sum().tolist() == [3, 2]
    assert grid.idxmax().tolist() == [0.5, 1]


def test_arguments_of_the_environment_are_told_apart(tmp_path):
    """And packed as text; that a beta was found by --beta auto is no difference."""
    for seed, env_kwargs in enumerate([None, {"b": 2, "a": [3, 0]}, {"a": [3, 0], "b": 2}]):
        auto = {"beta_auto": seed == 2}
        write_run(tmp_path / "runs", PENDULUM, 0.304, 4, seed, [1.0], env_kwargs=env_kwargs, **auto)
    analysis.pack(*analysis.load([tmp_path / "runs"]), tmp_path / "packed.csv")
    for path in (tmp_path / "runs", tmp_path / "packed.csv"):
        runs, _ = analysis.load([path])
        assert sorted(runs.env_kwargs.dropna()) == ['{"a": [3, 0], "b": 2}'] * 2
        with pytest.raises(analysis.Unusable, match="--env-kwargs.* must not be averaged"):
            analysis.select(runs)
        assert len(analysis.select(runs[runs.env_kwargs.notna()])[0]) == 2


def test_evaluations_may_be_mixed_and_the_report_says_so(tmp_path):
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0, 2.0], eval_episodes=50)
    write_run(tmp_path, CAR, 0.5, 4, 2, [1.0, 2.0], eval_episodes=10, eval_once_per_policy=True)
    runs = select(tmp_path)
    assert len(runs) == 2
    assert analysis.mixed_evaluations(runs) == [
        "Mountain Car: --eval-episodes 10 (1 runs) and --eval-episodes 50 (1 runs)",
        "Mountain Car: --eval-once-per-policy (1 runs) and no --eval-once-per-policy (1 runs)",
    ]
    write_run(tmp_path, CAR, 0.5, 4, 3, [1.0, 2.0, 3.0])  # another number of evaluations
    with pytest.raises(analysis.Unusable, match="--total-timesteps"):
        select(tmp_path)


@pytest.mark.parametrize(
    "same, other",
    [
        ({"envpool": False}, {"envpool": True}),
        ({"anneal_lr": False}, {"anneal_lr": True}),
        ({"max_episode_steps": None}, {"max_episode_steps": 500}),
        ({"threads": 4}, {"gae_lambda": 0.9}),
        ({"method": "ppo"}, {"a_users_own": 5}),
    ],
)
def test_an_argument_that_older_runs_lack_has_its_default(tmp_path, same, other):
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0])
    write_run(tmp_path, CAR, 0.5, 4, 2, [1.0], **same)
    assert len(select(tmp_path)) == 2
    write_run(tmp_path, CAR, 0.5, 4, 3, [1.0], **other)
    with pytest.raises(analysis.Unusable, match=f"--{next(iter(other)).replace('_', '-')}"):
        select(tmp_path)
    analysis.pack(*analysis.load([tmp_path]), tmp_path / "packed.csv")
    with pytest.raises(analysis.Unusable, match=f"--{next(iter(other)).replace('_', '-')}"):
        select(tmp_path / "packed.csv")


def test_another_method_is_never_averaged_with_ppo(tmp_path):
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0])
    write_run(tmp_path, PENDULUM, 0.5, 4, 1, [1.0], method="a2c")  # in another environment, too
    chosen, left_out = analysis.select(analysis.load([tmp_path])[0])
    assert chosen.env_id.tolist() == [CAR]
    assert len(left_out) == 1 and left_out[0].endswith("another method, a2c")
    chosen, _ = analysis.select(analysis.load([tmp_path])[0], method="a2c")
    assert chosen.env_id.tolist() == [PENDULUM]


@pytest.mark.parametrize("packed", [False, True])
def test_runs_of_another_script_are_never_averaged(tmp_path, packed):
    """Nor does one of two runs of the same settings and seed count, in different experiments."""
    scripts = [{}, {"script": None}]  # older runs do not name it, nor those of `python -c`
    for name in ("ppo_colored_continuous.py", "my_ppo.py"):
        scripts.append({"script": {"name": name, "crc32": "0"}})
    for seed, script in enumerate(scripts, start=1):
        folder = write_run(tmp_path / "runs", CAR, 0.5, 4, seed, [1.0], exp_name=f"part {seed}")
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(config | script))
    path = tmp_path / "runs"
    if packed:
        analysis.pack(*analysis.load([path]), tmp_path / "packed.csv")
        path = tmp_path / "packed.csv"
    runs, _ = analysis.load([path])
    assert len(analysis.select(runs[runs.script != "my_ppo.py"])[0]) == 3
    with pytest.raises(analysis.Unusable, match="my_ppo.py and ppo_colored_continuous.py, which"):
        analysis.select(runs)
    twice = runs[:2].assign(seed=1)
    with pytest.raises(analysis.Unusable, match="--exp-name part 1 and --exp-name part 2, which"):
        analysis.select(twice)
    assert len(analysis.select(twice.assign(exp_name="one"))[0]) == 1


def test_main_grid_names_the_environments_that_it_drops(tmp_path):
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0])
    write_run(tmp_path, PENDULUM, 0.5, 2, 1, [1.0], n_steps=4096)
    grid, dropped = analysis.main_grid(select(tmp_path))
    assert grid.env_id.tolist() == [CAR]
    assert dropped == ["Pendulum Swingup: --n-steps 4096 --n-epochs 10, not (2048, 10)"]


@pytest.mark.parametrize(
    "other, flags",
    [
        ({}, ""),
        ({"gamma": 0.9}, "--gamma 0.9"),
        ({"total_timesteps": 20, "eval_freq": 5}, "--total-timesteps 20, --eval-freq 5"),
        ({"bootstrap_timeouts": True}, "--bootstrap-timeouts"),
        ({"noise_seq_len": 1024, "anneal_lr": True}, "--noise-seq-len 1024, --anneal-lr"),
        ({"env_kwargs": {"a": 1}}, '--env-kwargs {"a": 1}'),
        (
            dict.fromkeys(["rescale_actions", "normalize_obs", "normalize_rewards"], True),
            "--rescale-actions, --normalize-obs, --normalize-rewards",
        ),
    ],
)
def test_no_published_numbers_beside_another_protocol(tmp_path, monkeypatch, other, flags):
    study(monkeypatch, 4)
    for seed in (1, 2):
        for beta in (0, 0.5):
            write_run(tmp_path, PENDULUM, beta, 4, seed, [0.0, 1.0, 2.0, seed], **other)
    runs = select(tmp_path)
    returns = analysis.final_returns(runs)
    wide = analysis.final_return_per_beta(returns)
    tables = [returns, wide, analysis.final_return_and_performance(runs)]
    tables += [analysis.best_beta_per_env(runs).iloc[:1], analysis.best_beta_per_n_envs(runs)]
    for table in tables:
        paper = table.filter(regex="^paper|in_interval")
        assert (paper.notna() & (paper != "")).any(axis=None) == (not flags)
        assert set(table.get("differs", [""])) == {flags}
    assert ("(outside)" in wide.to_string()) == (not flags)


# --- Damage and mistakes


def test_betas_0_and_minus_0_are_one(tmp_path):
    folder = write_run(tmp_path, PENDULUM, 0, 4, 1, [1.0])
    write_run(tmp_path, PENDULUM, 0.0, 4, 2, [1.0], exp_name="float")
    write_run(tmp_path, PENDULUM, -0.0, 4, 3, [1.0], exp_name="minus")
    runs, curves = analysis.load([tmp_path])
    assert set(runs.beta) == {"0"} and folder.parent.parent.name == "beta_0"
    analysis.pack(runs, curves, tmp_path / "packed.csv")
    text = (tmp_path / "packed.csv").read_text()
    (tmp_path / "packed.csv").write_text(text.replace(f"{PENDULUM},0,", f"{PENDULUM},-0.0,", 1))
    assert set(analysis.load([tmp_path / "packed.csv"])[0].beta) == {"0"}


def deep(text):
    return "[" * 100_000 + text + "]" * 100_000


@pytest.mark.parametrize(
    "config",
    [
        deep(""),
        '{"args": ' + deep("") + "}",
        '{"args": {"gamma": NaN}}',
        '{"args": {"n_envs": 1e999}}',
        '{"args": {"n_envs": NaN}}',
        '{"args": {"beta": [NaN]}}',
        '{"args": {"beta": []}}',
        '{"args": {"n_envs": 1000000000000000000000000}}',
        '{"args": {"eval_freq": 0}}',
        '{"args": []}',
        "[]",
        "\0",
    ],
)
def test_a_damaged_config_is_one_line(tmp_path, config):
    write_run(tmp_path, PENDULUM, 0.5, 4, 1, [1.0, 2.0])
    folder = write_run(tmp_path, PENDULUM, 0.5, 4, 2, [1.0, 2.0])
    if config.startswith('{"args": {'):  # all else is in order
        whole = json.loads((folder / "config.json").read_text())
        args = json.dumps(whole["args"] | {"placeholder": 1})
        config = config.removeprefix('{"args": {').removesuffix("}}")
        config = f'{{"git_commit": "", "args": {args[:-1]}, {config}}}}}'
    (folder / "config.json").write_text(config)
    chosen, left_out = analysis.select(analysis.load([tmp_path])[0])
    assert len(chosen) == 1 and len(left_out) == 1
    assert left_out[0].startswith(f"{folder}: damaged: ") and "\n" not in left_out[0]


def test_a_packed_file_that_is_cut_or_damaged_is_noticed(tmp_path, run):
    write_sweep(tmp_path / "runs", {0: 600}, seeds=3)
    run("analysis.py pack", tmp_path / "runs", tmp_path / "packed.csv")
    whole = (tmp_path / "packed.csv").read_bytes()
    last_row = whole.rstrip(b"\n").rindex(b"\n") + 1
    for end in [*range(last_row + 1, len(whole), 5), len(whole) - 1, len(whole) - 2]:
        (tmp_path / "cut.csv").write_bytes(whole[:end])
        chosen, left_out = analysis.select(analysis.load([tmp_path / "cut.csv"])[0])
        assert len(chosen) == 2 and len(left_out) == 1 and "damaged" in left_out[0], whole[:end]
    # A hole, and a word for a number, in the first run
    first_row = whole.index(b"\n") + 1
    start = whole.rindex(b",", 0, whole.index(b"\n", first_row)) + 1
    for hole in (b"", b"many"):
        end = whole.index(b"\n", start)
        (tmp_path / "cut.csv").write_bytes(whole[:start] + hole + whole[end:])
        chosen, left_out = analysis.select(analysis.load([tmp_path / "cut.csv"])[0])
        assert len(chosen) == 2 and "damaged: 3 of 4 evaluations" in left_out[0]
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(whole)[:-20])
    (tmp_path / "no.csv.gz").write_bytes(whole)
    (tmp_path / "zeros.csv").write_bytes(bytes(1000))
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "header.csv").write_bytes(whole[: whole.index(b"total_timesteps")])
    (tmp_path / "no_run.csv").write_bytes(whole[:first_row])
    for name in ("cut.csv.gz", "no.csv.gz", "zeros.csv", "empty.csv", "header.csv", "no_run.csv"):
        code, _, stderr = run("plot.py results", tmp_path / name, "--out", tmp_path / "figures")
        assert code == 1 and stderr.startswith("error: ") and len(stderr.splitlines()) == 1
        assert f"{name} is not a file that `analysis.py pack` wrote, or damaged" in stderr


def test_intervals_do_not_depend_on_the_order_in_which_runs_are_read(tmp_path):
    returns = np.random.default_rng(0).exponential(size=(12, 3))
    for seed in range(1, 13):
        write_run(tmp_path / f"{seed % 2}", PENDULUM, 0, 4, seed, returns[seed - 1])
    first, second = (
        analysis.load([tmp_path / a, tmp_path / b])[0] for a, b in (("0", "1"), ("1", "0"))
    )
    assert list(first.seed) == list(second.seed) == list(range(1, 13))
    pd.testing.assert_frame_equal(
        analysis.mean_intervals(first, "performance", "beta"),
        analysis.mean_intervals(second, "performance", "beta"),
        check_exact=True,
    )


def test_pack_does_not_overwrite(tmp_path, run):
    write_sweep(tmp_path / "runs", {0: 1}, seeds=2)
    a, b = tmp_path / "a.csv", tmp_path / "b.csv.gz"
    for file in (a, b):
        assert run("analysis.py pack", tmp_path / "runs", file)[0] == 0
    before = a.read_bytes(), b.read_bytes()
    (tmp_path / "link.csv").symlink_to(a)
    for arguments, word in (
        ([a, b], "--overwrite"),
        ([a, a, "--overwrite"], "read here as well"),
        ([a, tmp_path / "link.csv", "--overwrite"], "read here as well"),
        ([tmp_path / "runs", tmp_path / "runs", "--overwrite"], "read here as well"),
        ([a, tmp_path, "--overwrite"], "exists"),
    ):
        code, stdout, stderr = run("analysis.py pack", *arguments)
        line = stderr.replace("\r", "\n").splitlines()[-1]
        assert (code, stdout) == (1, "") and line.startswith("error: ") and word in line
        assert (a.read_bytes(), b.read_bytes()) == before
    write_run(tmp_path / "runs", PENDULUM, 1, 2, 2**53 + 1, [1.0])
    filters = ["--beta", "1", "--n-envs", "4"]  # each is there, but no run has both
    code, _, stderr = run("analysis.py pack", tmp_path / "runs", a, "--overwrite", *filters)
    assert code == 1 and "error: needs runs that have all of --env" in stderr
    assert a.read_bytes() == before[0]
    (write_run(tmp_path / "runs", PENDULUM, 1, 4, 7, [1.0]) / "config.json").write_text("")
    assert run("analysis.py pack", tmp_path / "runs", b, "--overwrite")[0] == 0
    runs, _ = analysis.load([b])
    assert len(runs) == 4 and 2**53 + 1 in runs.seed.tolist()  # a gap in the column or not
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("a.csv", "b.csv.gz", "link.csv", "runs")
    ]


def test_a_filter_for_what_is_not_there_lists_what_is(tmp_path):
    for beta in (1, 0, "vanilla", 0.5):
        write_run(tmp_path, PENDULUM, beta, 4, 1, [1.0])
    for filters, words in (
        ({"env": ["Pendulum Swingup", "Cartpole"]}, "--env Cartpole; there are: Pendulum Swingup"),
        ({"beta": ["0", "0.7"]}, "--beta 0.7; there are: 0, 0.5, 1, vanilla"),
        ({"n_envs": [4, 5]}, "--n-envs 5; there are: 4"),
    ):
        with pytest.raises(analysis.Unusable, match=words):
            analysis.load([tmp_path], **filters)
    for version in (4, 5):
        write_run(tmp_path, f"HalfCheetah-v{version}", 0, 4, 1, [1.0])
    assert len(analysis.load([tmp_path], env=["HalfCheetah"])[0]) == 2


def test_linked_folders_are_read_once(tmp_path):
    write_run(tmp_path / "elsewhere", PENDULUM, 0, 4, 1, [1.0])
    write_run(tmp_path / "runs", PENDULUM, 0, 4, 2, [1.0])
    (tmp_path / "runs" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "runs" / "again").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "runs" / "test" / "circle").symlink_to(tmp_path / "runs")
    (tmp_path / "runs" / "dangling").symlink_to(tmp_path / "nowhere")
    runs, _ = analysis.load([tmp_path / "runs"])
    assert sorted(runs.seed) == [1, 2]


# --- Status


def test_status_of_any_folder(tmp_path, run):
    parts = [f"MountainCarContinuous-v0/beta_0/n_envs_4/seed_{seed}" for seed in (1, 2, 3, 4)]
    done, running, failed, todo = folders = [tmp_path / "runs/x" / part for part in parts]
    for folder in (done, running, failed):
        folder.mkdir(parents=True)
        (folder / "lock").touch()
    (failed / "failed").write_text("1\n")
    (done / "summary.json").write_text(json.dumps({"steps": 8, "wall_seconds": 5400.0}))
    (running / "config.json").write_text(json.dumps({"args": {"total_timesteps": 1000}}))
    (running / "evaluations.csv").write_text("step,return_mean\n100,1\n600,1\n")
    lines = run("analysis.py status", tmp_path / "runs")[1].splitlines()
    assert lines[0] == (
        f"{tmp_path}/runs: 1 of 3 done, 0 running, 1 failed, 1 to do, "
        "nothing is running, work left: 36 min of one core"
    )
    code = "import sys, analysis; analysis.main(); assert 'matplotlib' not in sys.modules"
    command = [sys.executable, "-c", code, "status", "-", "--name", "quick"]
    given = "\n".join(map(str, folders)) + "\n"
    with open(running / "lock", "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        how = {"cwd": ROOT, "capture_output": True, "text": True, "check": True}
        output = subprocess.run(command, input=given, **how)
    head, titles, row = output.stdout.splitlines()
    # 0.4 runs are left of the running one, 1 of the one that is not there, at 1.5 h each
    counts = "1 of 4 done, 1 running, 1 failed, 1 to do"
    assert head == f"quick: {counts}, 2.1 h left at the present rate"
    assert titles.split() == [
        *("environment", "done", "running", "failed", "to", "do", "per", "run", "left")
    ]
    assert row.split() == ["MountainCarContinuous-v0", "1", "1", "1", "1", "1.5", "h", "2.1", "h"]
    assert not todo.exists() and len(row) == len(titles) == 94
    # Damaged files do no harm, and nothing is made
    (done / "lock").unlink()
    (done / "summary.json").write_text("")
    (running / "evaluations.csv").write_bytes(b"\xff\n\xff")
    head = run("analysis.py status", tmp_path / "runs", "--name", "all")[1].splitlines()[0]
    words = "1 failed, 1 to do, time left: known when the first run is done"
    assert head == f"all: 1 of 3 done, 0 running, {words}"
    assert not (done / "lock").exists()


def test_other_methods_are_selected_apart(tmp_path, run):
    """gSDE has no beta, whatever its arguments say; the filter --beta does not concern it."""
    for seed in (1, 2):
        write_run(tmp_path, CAR, 0.5, 4, seed, [1.0, 2.0])
        write_run(tmp_path, CAR, 0.5, 4, seed, [5.0, 6.0], method="trpo", exp_name="trpo")
        write_run(tmp_path, CAR, 0.5, 4, seed, [5.0, 6.0], method="gsde", exp_name="gsde")
    unfinished = write_run(tmp_path, CAR, 0.5, 4, 3, [1.0], method="a2c", exp_name="a2c")
    (unfinished / "summary.json").unlink()
    packed = tmp_path / "packed.csv"
    assert run("analysis.py pack", tmp_path, packed)[0] == 0
    for path in (tmp_path / "test", tmp_path / "trpo", tmp_path / "gsde"), (packed,):
        methods, left_out = analysis.select_methods(analysis.load(path, beta=["0.5"])[0])
        assert {name: len(runs) for name, runs in methods.items()} == dict(ppo=2, trpo=2, gsde=2)
        assert methods["gsde"].beta.isna().all() and not methods["gsde"].vanilla.any()
    assert len(left_out) == 1 and "unfinished" in left_out[0]
    methods, _ = analysis.select_methods(analysis.load([tmp_path / "trpo"])[0])
    assert [*methods] == ["ppo", "trpo"] and methods["ppo"].empty
    methods, left_out = analysis.select_methods(analysis.load([packed])[0], "trpo")
    assert [*methods] == ["trpo", "ppo", "gsde"] and len(left_out) == 1
    runs = pd.concat(methods.values())
    with pytest.raises(analysis.Unusable, match="gamma 0.9"):
        analysis.same_protocol(runs.assign(gamma=np.where(runs.method == "trpo", 0.9, 0.99)))
    with pytest.raises(analysis.Unusable, match="--normalize-obs"):
        analysis.same_protocol(runs.assign(normalize_obs=runs.method == "trpo"))
    other = runs.assign(learning_rate=np.where(runs.method == "trpo", 1e-3, 2.5e-4))
    analysis.same_protocol(other)
    with pytest.raises(analysis.Unusable, match="--learning-rate"):
        analysis.same_protocol(other, ["learning_rate"])
