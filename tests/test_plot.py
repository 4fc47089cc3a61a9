"""plot.py: its statistics, the published numbers, every figure of a small real sweep, and incomplete data."""

import json
import runpy
import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT, SCRIPT
from PIL import Image
from scipy import stats

import plot

PENDULUM, CAR, PUSH = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0", "PointPush-v1"
ARGS = dict(
    **dict(
        total_timesteps=40,
        n_steps=2048,
        batch_size=128,
        n_epochs=10,
        learning_rate=2.5e-4,
        gamma=0.99,
    ),
    **dict(
        noise_seq_len=1000,
        eval_freq=10,
        eval_episodes=50,
        bootstrap_timeouts=True,
        normalize_advantage=True,
    ),
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
    args |= {"seed": seed, **other}
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
    """Made-up runs of 4 evaluations about levels[beta]; returns {(beta, n_envs): (seeds, 4) returns}."""
    rng, truth = np.random.default_rng(0), {}
    for beta, level in levels.items():
        for n in n_envs:
            truth[beta, n] = level + spread * rng.normal(size=(seeds, 4))
            for seed, returns in enumerate(truth[beta, n], start=1):
                write_run(root, env_id, beta, n, seed, returns)
    return truth


def select(*paths, **filters):
    return plot.select(plot.load(paths, **filters)[0])[0]


@pytest.fixture
def run_plot(monkeypatch, capsys):
    """run_plot("results", ...) runs plot.py as a user does; returns its exit code, stdout and stderr."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["plot.py", *map(str, arguments)])
        code = 0
        try:
            runpy.run_path(str(ROOT / "plot.py"), run_name="__main__")
        except SystemExit as stop:
            code = stop.code
        return code, *capsys.readouterr()

    return run


def test_load_gives_settings_performance_and_curves(tmp_path):
    write_run(tmp_path, PENDULUM, -1, 4, 3, [1.0, 2.0, 6.0])
    write_run(tmp_path, "Unknown-v0", "vanilla", 2, 1, [5.0], exp_name="other")
    runs, curves = plot.load([tmp_path])
    runs, curves = runs.set_index("environment"), curves.set_index(runs.environment)
    assert runs.performance.to_dict() == {"Pendulum Swingup": 3.0, "Unknown-v0": 5.0}
    assert runs.final_return.to_dict() == {"Pendulum Swingup": 6.0, "Unknown-v0": 5.0}
    assert runs.beta.to_dict() == {"Pendulum Swingup": "-1", "Unknown-v0": "vanilla"}
    assert curves.loc["Pendulum Swingup"].to_dict() == {10: 1.0, 20: 2.0, 30: 6.0}
    chosen = select(tmp_path).set_index("environment")
    assert chosen.beta["Pendulum Swingup"] == -1 and np.isnan(chosen.beta["Unknown-v0"])
    assert chosen.vanilla.to_dict() == {"Pendulum Swingup": False, "Unknown-v0": True}


def test_all_environments_of_the_paper_have_its_names():
    names = set(plot.NAMES.values())
    assert set(plot.published("final_return_per_beta").environment) == names - {
        plot.NAMES[key] for key in plot.COMPLEX
    }
    assert len(names) == 20


def test_standardized_within_each_environment(tmp_path):
    # By hand: performances 0, 0, 4, 4 have mean 2 and standard deviation 2; a constant environment says nothing.
    for seed in (1, 2):
        for beta, performance in ((0, 0.0), (1, 4.0)):
            write_run(tmp_path, PENDULUM, beta, 4, seed, [performance - 1, performance + 1])
            write_run(tmp_path, CAR, beta, 4, seed, [0.1, 0.1])
    runs = select(tmp_path)
    z = plot.standardize(runs)
    assert z[(runs.env_id == PENDULUM) & (runs.beta == 0)].tolist() == [-1, -1]
    assert z[(runs.env_id == PENDULUM) & (runs.beta == 1)].tolist() == [1, 1]
    assert (z[runs.env_id == CAR] == 0).all()


def test_intervals_are_scipys_bca():
    values = np.random.default_rng(1).exponential(size=(7, 3))
    mean, low, high = plot.mean_interval(values)
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
        plot.mean_interval(values[:, 1]), [mean[1], low[1], high[1]], rtol=0.02
    )


@pytest.mark.filterwarnings("error")
def test_intervals_of_degenerate_data():
    assert np.array_equal(plot.mean_interval([2.0]), [2.0, np.nan, np.nan], equal_nan=True)
    assert plot.mean_interval([0.0] * 5) == (0, 0, 0)
    mean, low, high = plot.mean_interval([[1.0, 0.1], [2.0, 0.1], [4.0, 0.1]])
    assert low[0] < mean[0] < high[0] and low[1] == mean[1] == high[1]


@pytest.mark.filterwarnings("error")
def test_welch():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=20), 0.5 + 2 * rng.normal(size=7)
    assert plot.welch(a, b) == stats.ttest_ind(a, b, equal_var=False).pvalue
    t = (a.mean() - b.mean()) / np.sqrt(
        a.var(ddof=1) / 20 + b.var(ddof=1) / 7
    )  # Welch (1947), with his degrees of freedom
    va, vb = a.var(ddof=1) / 20, b.var(ddof=1) / 7
    df = (va + vb) ** 2 / (va**2 / 19 + vb**2 / 6)
    assert plot.welch(a, b) == pytest.approx(2 * stats.t.sf(abs(t), df))
    assert np.isnan(plot.welch([1.0], [1.0, 2.0]))
    assert plot.welch([3.0, 3.0], [3.0, 3.0]) == 1
    assert plot.welch([0.0, 0.0], [94.0, 93.9]) < 0.01


def test_best_beta_per_env(tmp_path):
    truth = write_sweep(tmp_path, {0: 11.6, 0.2: 11, 0.5: 12, 1: 11}, n_envs=(4, 8), seeds=6)
    write_sweep(tmp_path, {0: 5, 0.5: 1}, env_id=CAR, seeds=1)
    table = plot.best_beta_per_env(select(tmp_path)).set_index("environment")
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
    # With one seed there is no test: only beta* itself is comparable, and beta 1 was not run.
    assert table.loc[
        "Mountain Car", ["best_beta", "beta_0.0", "beta_0.5", "beta_1.0"]
    ].tolist() == [
        0,
        "comparable",
        "",
        "",
    ]
    assert table.loc["comparable in", "beta_0.5"] == "1/1"
    assert table.loc[
        "Pendulum Swingup", ["paper_best_beta", "paper_beta_0.5", "paper_p_0.5"]
    ].tolist() == [
        0.75,
        "comparable",
        0.92,
    ]


def test_best_beta_per_n_envs(tmp_path):
    write_sweep(tmp_path, {0: 4, 0.5: 5, 1: 3}, n_envs=(4,), spread=0.1)
    write_sweep(tmp_path, {0: 0, 0.5: 1, 1: 2}, n_envs=(32,), spread=0.1)
    runs = select(tmp_path)
    table = plot.best_beta_per_n_envs(runs).set_index("n_envs")
    assert table.best_beta.to_dict() == {4: 0.5, 32: 1}
    z = (runs.performance - runs.performance.mean()) / runs.performance.std(ddof=0)
    assert table.standardized_performance[32] == pytest.approx(
        z[(runs.n_envs == 32) & (runs.beta == 1)].mean()
    )
    assert table.paper_best_beta.to_dict() == {4: 0.5, 32: 0.75}


def test_final_return_tables(tmp_path):
    # The published mean of this cell is 677.5, a rounded number: 677.54 as both ends of our interval still holds it.
    for seed in (1, 2):
        write_run(tmp_path, PENDULUM, 0, 4, seed, [0.0, 677.54])
        write_run(tmp_path, PENDULUM, 0.5, 4, seed, [1.0, 694.66])  # published: 694.6
        write_run(tmp_path, PENDULUM, "vanilla", 4, seed, [2.0, 3.0])
    write_run(tmp_path, PENDULUM, 1, 4, 1, [0.0, 403.1])  # one seed: no interval
    runs = select(tmp_path)
    table = plot.final_returns(runs).set_index("beta")
    assert table["mean"].to_dict() == {"0": 677.54, "0.5": 694.66, "vanilla": 3, "1": 403.1}
    assert table.paper.to_dict() == {"0": 677.5, "0.5": 694.6, "vanilla": 733.1, "1": 403.1}
    assert table.in_interval.fillna("").to_dict() == {
        "0": "yes",
        "0.5": "no",
        "vanilla": "no",
        "1": "",
    }
    wide = plot.final_return_per_beta(table.reset_index())
    assert " ".join(
        wide
    ) == "environment n_envs runs beta 0 paper, 0 beta 0.5 paper, 0.5 beta 1 paper, 1 " + (
        "beta vanilla paper, vanilla"
    )
    assert wide.iloc[0].tolist() == ["Pendulum Swingup", 4, 7, "677.5 [677.5, 677.5]", "677.5"] + [
        *[
            "694.7 [694.7, 694.7]",
            "694.6 (outside)",
            "403.1",
            "403.1",
            "3.0 [3.0, 3.0]",
            "733.1 (outside)",
        ]
    ]
    summary = plot.final_return_and_performance(runs[~runs.vanilla]).iloc[0]
    assert summary.final_return_mean == pytest.approx((2 * 677.54 + 2 * 694.66 + 403.1) / 5)
    assert summary.performance_max == pytest.approx(347.83)
    assert summary.paper_performance_max == 678.91


def test_published_tables_agree():
    """The mean over the 8 betas and 8 n_envs, without vanilla PPO, is the published mean final return to rounding."""
    cells = plot.published("final_return_per_beta")
    summary = plot.published("final_return_and_performance").set_index("environment")
    colored = cells[cells.beta != "vanilla"].groupby("environment").final_return_mean
    assert (colored.count() == 64).all() and len(summary) == 16
    # Cells are rounded to 0.1, so the error of a mean of 64 has a standard deviation of 0.0036; the mean to 0.01.
    np.testing.assert_allclose(
        colored.mean(), summary.final_return_mean[colored.mean().index], rtol=0, atol=0.015
    )
    everything = cells.groupby("environment").final_return_mean.mean()
    assert (everything - summary.final_return_mean).abs().max() > 1
    best = plot.published("best_beta_per_env")
    assert [(best[f"beta_{beta}_comparable"] == "yes").sum() for beta in ("0.5", "0.0", "1.0")] == [
        11,
        8,
        7,
    ]  # Table 1


def test_projected_ranks_from_the_published_best_betas():
    """By hand: sigma(beta) in closed form, written out again here, then sigma*, E_ij and ranks one by one."""
    T, betas, n_envs = 1000, [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2], [1, 2, 4, 8, 16, 32, 64, 128]

    def sigma(beta):
        f = np.arange(1, T // 2 + 1) / T
        w = f ** (-beta / 2)
        w[-1] /= 2
        # The DC bin is real with standard deviation sqrt(2) s_1; divided by T in the inverse FFT, then by sigma.
        return np.sqrt(2) * f[0] ** (-beta / 2) / T / (2 / T * np.sqrt((w**2).sum()))

    assert [round(sigma(beta), 4) for beta in (0, 0.5, 1, 2)] == [
        0.0316,
        0.1075,
        0.2713,
        0.5517,
    ]  # spec
    paper = plot.published("best_beta_per_n_envs").set_index("n_envs").best_beta
    assert paper.to_dict() == {1: 0.2, 2: 0.5, 4: 0.5, 8: 0.75, 16: 0.75, 32: 0.75, 64: 0.5, 128: 2}
    star = sum(sigma(beta) / n**0.5 for n, beta in paper.items()) / 8
    ranks = plot.projected_ranks(paper, betas, n_envs, T)
    for n in n_envs:
        E = [(star - sigma(beta) / n**0.5) ** 2 for beta in betas]
        assert ranks[n].tolist() == [1 + sum(other < e for other in E) for e in E]
    # The trend of the paper: more environments, more correlated noise.
    assert ranks.idxmin().tolist() == [0.2, 0.2, 0.5, 0.5, 0.75, 1, 1.25, 2]


def test_robust_statistics(tmp_path):
    levels = {0: 0.0, 0.5: 0.7, 1: 50.0}
    truth = write_sweep(tmp_path, levels, n_envs=(4, 8), seeds=8)
    runs = select(tmp_path)
    table = plot.robust_statistics(runs).set_index("beta")
    z = plot.standardize(runs)
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
    # Stratified: two cells that differ widely, with nothing to choose within them, leave no uncertainty.
    constant = runs.assign(performance=runs.n_envs + runs.beta)
    table = plot.robust_statistics(constant).set_index("beta")
    np.testing.assert_allclose(table.iqm_low, table.iqm_high)


def test_a_mix_that_would_be_averaged_is_an_error_that_names_the_flag(tmp_path, run_plot):
    write_run(tmp_path, PENDULUM, 0.5, 4, 1, [1.0, 2.0])
    write_run(tmp_path, PENDULUM, 0.5, 4, 2, [1.0, 2.0], exp_name="b", learning_rate=1e-3)
    code, _, stderr = run_plot("results", tmp_path, "--out", tmp_path / "figures")
    error = stderr.strip().splitlines()[-1]
    assert code == 1 and error.startswith("error: Pendulum Swingup")
    assert "--learning-rate 0.00025 and --learning-rate 0.001" in error
    assert len(select(tmp_path / "test")) == 1  # one experiment alone is fine
    # What cannot change a result may differ, n_epochs is one of the study's own axes, and older runs lack --envpool.
    write_run(tmp_path / "fine", PENDULUM, 0.5, 4, 1, [1.0, 2.0], device="cuda", compile=False)
    write_run(
        tmp_path / "fine", PENDULUM, 0.5, 4, 2, [1.0, 2.0], n_epochs=20, exp_name="c", envpool=False
    )
    assert len(select(tmp_path / "fine")) == 2
    write_run(tmp_path / "fine", PENDULUM, 0.5, 4, 3, [1.0, 2.0], envpool=True)
    with pytest.raises(plot.Unusable, match="--envpool"):
        select(tmp_path / "fine")


@pytest.mark.filterwarnings("error")
def test_runs_that_cannot_be_used_are_listed(tmp_path, run_plot):
    write_sweep(tmp_path, {0: 1, 0.5: 2, 1: 3})
    folders = sorted((tmp_path / "test").rglob("seed_*"))
    header = "step,return_mean,return_std,length_mean\n"
    (folders[0] / "summary.json").unlink()
    (folders[1] / "config.json").write_text('{"args": {"env_id"')
    (folders[2] / "evaluations.csv").write_text(header + "10,1,1,1\n20,")
    (folders[3] / "summary.json").write_text("")
    (folders[4] / "config.json").unlink()
    (folders[5] / "evaluations.csv").write_text(header + "10,inf,1,1\n")
    (folders[5] / "summary.json").write_text(
        '{"performance": Infinity, "final_return": Infinity, "wall_seconds": 1}'
    )
    (folders[6] / "summary.json").unlink()
    (folders[6] / "evaluations.csv").unlink()
    (folders[7] / "evaluations.csv").write_text(header + "10,2,1,1\n")  # not what summary.json says
    write_run(tmp_path, PENDULUM, 0.5, 4, 5, [2.0], exp_name="twice")
    code, stdout, stderr = run_plot("results", tmp_path, "--out", tmp_path / "figures")
    assert code == 0, stderr
    report = (tmp_path / "figures" / "report.txt").read_text()
    assert "left out: 9\n" in report and "left out: 9\n" in stdout
    for i, folder in enumerate(folders[:8]):
        (line,) = [line for line in report.splitlines() if f"{folder}: " in line]
        state = "unfinished: " if i in (0, 6) else "damaged: "
        assert line.removeprefix(f"  {folder}: ").startswith(state), line
    assert "unfinished: 4 evaluations, no summary.json" in report
    assert "the same settings and seed as another run" in report
    assert "Pendulum Swingup, n_envs 4: beta 0.5, seeds 1 2 3" in report
    assert "beta0_vs_vanilla: needs runs with --beta 0 and runs with --vanilla" in report
    figures = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    assert {"performance_vs_beta", "n_envs_beta_grids", "learning_curves_n_envs_4"} <= figures


def test_missing_names_each_run_of_the_grid(tmp_path):
    write_sweep(tmp_path, {0: 1, 1: 1}, n_envs=(4,), seeds=3)
    write_sweep(tmp_path, {1: 1}, n_envs=(8,), seeds=2)
    lines = plot.missing(select(tmp_path))
    assert lines == [
        "Pendulum Swingup, n_envs 8: beta 0, seeds 1 2 3",
        "Pendulum Swingup, n_envs 8: beta 1, seeds 3",
    ]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["results", "nowhere"], "nowhere"),
        (["results", "empty"], "no runs in empty"),
        (["results", "file.csv"], "not a file that `plot.py pack` wrote"),
        (["results", "image.png"], "not a file that `plot.py pack` wrote"),
        (["results", "runs", "--env", "Cartpole"], "no complete run"),
        (["results", "damaged"], "damaged"),
        (["results", "runs", "--beta", "pink"], "--beta"),
        (["pack", "runs", "nowhere/packed.csv"], "nowhere"),
        (["noise", "--beta", "nan"], "--beta"),
        (["noise", "--beta", "1", "--out", "file.csv/figures"], "file.csv"),
        ([], "command"),
    ],
)
def test_mistakes_give_one_line(tmp_path, monkeypatch, run_plot, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.csv").write_text("a,b\n1,2\n")
    (tmp_path / "image.png").write_bytes(bytes(range(256)))
    write_run(tmp_path / "runs", PENDULUM, 0.5, 4, 1, [1.0])
    (write_run(tmp_path / "damaged", PENDULUM, 0.5, 4, 1, [1.0]) / "config.json").write_text("")
    code, stdout, stderr = run_plot(*arguments)
    lines = [
        line for line in stderr.replace("\r", "\n").splitlines() if line and "runs/s" not in line
    ]
    assert (
        code in (1, 2) and len(lines) == 1 and lines[0].startswith("error: ") and words in lines[0]
    ), stderr
    assert stdout == ""


def test_packed_runs_are_read_like_a_folder(tmp_path, run_plot):
    write_sweep(tmp_path / "runs", {0: 1, 0.5: 2, "vanilla": 1}, n_envs=(1, 4))
    folder = write_run(tmp_path / "runs", CAR, 0.5, 4, 1, [1.0, 2.0], envpool=True)
    (folder / "summary.json").unlink()
    _, stdout, stderr = run_plot("pack", tmp_path / "runs", tmp_path / "packed.csv")
    assert "31 runs" in stdout, stderr
    for filters in ({}, {"env": [PENDULUM], "beta": ["0", "vanilla"], "n_envs": [4]}):
        ours, curves = plot.load([tmp_path / "runs"], **filters)
        packed, packed_curves = plot.load([tmp_path / "packed.csv"], **filters)
        assert len(ours) == (10 if filters else 31)
        assert (ours.path == packed.path).all() and (ours.status == packed.status).all()
        np.testing.assert_array_equal(curves, packed_curves)
        (runs, left_out), (packed_runs, packed_left_out) = plot.select(ours), plot.select(packed)
        columns = [*plot.AXES, "vanilla", "performance", "final_return", "learning_rate"]
        pd.testing.assert_frame_equal(runs[columns], packed_runs[columns])
        assert len(left_out) == len(packed_left_out) == (not filters)
    # Folders and files mix; a run that is in both counts once.
    assert len(select(tmp_path / "runs", tmp_path / "packed.csv")) == 30


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A small real sweep of everything the study varies, trained in one process by the script itself."""
    root = tmp_path_factory.mktemp("sweep")
    tiny = "--total-timesteps 64 --n-steps 16 --batch-size 16 --n-epochs 1 --eval-freq 32 --eval-episodes 1"
    cells = [
        f"--n-envs {n} {beta}" for n in (1, 2) for beta in ("--beta 0", "--beta 0.5", "--vanilla")
    ]
    cells += [
        "--n-envs 2 --n-steps 32 --exp-name n_steps",
        "--n-envs 2 --n-epochs 2 --exp-name n_epochs",
    ]
    cells += [f"--env-id {PUSH} --n-envs 2 --beta 0.5"]
    commands = [
        f"{tiny} --no-compile --runs-dir {root} {cell} --seed {seed}"
        for cell in cells
        for seed in (1, 2)
    ]
    code = """if True:
        import runpy, sys
        script, *commands = sys.argv[1:]
        sys.path.insert(0, script.rpartition("/")[0])
        for command in commands:
            sys.argv = [script, *command.split()]
            runpy.run_path(script, run_name="__main__")
    """
    subprocess.run(
        [sys.executable, "-c", code, str(SCRIPT), *commands], check=True, capture_output=True
    )
    assert len(list(root.rglob("summary.json"))) == len(commands)
    return root


NOISE = {"noise_random_walks", "noise_psd", "noise_two_step", "noise_marginal", "noise_bias"}
TABLES = {
    "best_beta_per_env",
    "best_beta_per_n_envs",
    "final_return_and_performance",
    "final_returns",
    "final_return_per_beta",
    "robust_statistics",
}
FIGURES = {
    "performance_vs_beta",
    "performance_vs_n_envs",
    "n_envs_beta_grids",
    "beta0_vs_vanilla",
    "n_envs_vs_n_steps",
}
FIGURES |= {
    "n_epochs_vs_beta",
    "complex_tasks",
    "final_return_vs_n_envs",
    "robust_performance",
    "learning_curves_n_envs_1",
}
FIGURES |= {"learning_curves_n_envs_2", "learning_curves_mountain_car"}


def check_figures(monkeypatch, tmp_path, todo, expected):
    """Makes all of todo; returns the figures' names, each labelled, not blank, without empty panels, none a copy."""
    close = plt.close

    def check_labels(fig):
        assert all(ax.has_data() and (ax.get_xlabel() or ax.get_title()) for ax in fig.axes)
        assert any(ax.get_xlabel() for ax in fig.axes) and any(ax.get_ylabel() for ax in fig.axes)
        checked.append(fig)
        close(fig)

    checked = []
    monkeypatch.setattr(plt, "close", check_labels)
    made, not_made = plot.make_all(todo, tmp_path)
    assert set(made) == expected and not_made == []
    figures = sorted(tmp_path.glob("*.png"))
    assert len(checked) == len(figures)
    pixels = {}
    for figure in figures:
        with Image.open(figure) as image:
            assert image.info["dpi"] == pytest.approx((200, 200), abs=0.1) and min(image.size) > 400
            pixels[figure.stem] = np.asarray(image.convert("L"))
        assert (pixels[figure.stem] < 200).mean() > 0.002, f"{figure} is blank"
        assert figure.with_suffix(".pdf").stat().st_size > 5000
    assert len({image.tobytes() for image in pixels.values()}) == len(figures)
    return {figure.stem for figure in figures}


@pytest.mark.filterwarnings("error")
def test_every_figure_and_table_of_a_real_sweep(monkeypatch, tmp_path, sweep):
    runs, curves = plot.load([sweep])
    runs, left_out = plot.select(runs)
    assert left_out == []
    assert (
        check_figures(monkeypatch, tmp_path, plot.results(runs, curves), FIGURES | TABLES)
        == FIGURES
    )
    for name in TABLES:
        table = pd.read_csv(tmp_path / f"{name}.csv")
        markdown = (tmp_path / f"{name}.md").read_text().splitlines()
        assert len(markdown) == len(table) + 2 and markdown[0].count("|") == table.shape[1] + 1
        latex = (tmp_path / f"{name}.tex").read_text()
        assert latex.startswith(r"\begin{longtable}") and latex.count("\\\\\n") >= len(table) + 1
    # One seed and nothing else: what cannot be made is said, the rest is there.
    few = runs[(runs.seed == 1) & (runs.beta == 0.5) & (runs.n_envs == 2) & (runs.env_id == CAR)]
    few = plot.main_grid(few)
    assert len(few) == 1
    (tmp_path / "few").mkdir()
    made, not_made = plot.make_all(plot.results(few, curves), tmp_path / "few")
    assert {"final_returns", "learning_curves_n_envs_2", "final_return_vs_n_envs"} <= set(made)
    assert [line.split(": needs ")[0] for line in not_made][:2] == [
        "performance_vs_beta",
        "performance_vs_n_envs",
    ]


@pytest.mark.filterwarnings("error")
def test_every_figure_of_the_noise(monkeypatch, tmp_path):
    betas = [0, 0.5, 1]
    assert check_figures(monkeypatch, tmp_path, plot.noise(betas), NOISE) == NOISE


def test_colors_get_lighter_with_beta_and_stay_dark_enough():
    """Sequential in gray, too, so that figures can be read in black-and-white print."""
    gray = [np.dot(plot.color(beta)[:3], [0.299, 0.587, 0.114]) for beta in np.linspace(-1, 2, 50)]
    assert (np.diff(gray) > 0).all() and gray[-1] < 0.75
    assert len({plot.look(beta)["marker"] for beta in plot.STUDY_BETAS}) == 8


@pytest.mark.parametrize(
    ("readme", "data"),
    [("README.md", "reproduction.csv"), ("results/README.md", "bootstrapped_timeouts.csv")],
)
def test_the_readmes_show_the_tables_of_the_data(tmp_path, readme, data):
    runs, _ = plot.select(plot.load([ROOT / "results" / data])[0])
    plot.save_table(plot.final_return_per_beta(plot.final_returns(runs)), tmp_path, "table")
    assert (tmp_path / "table.md").read_text() + "\n" in (ROOT / readme).read_text()
