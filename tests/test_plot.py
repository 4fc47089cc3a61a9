"""plot.py: figures show the numbers of the runs; what cannot be made has a reason."""

import argparse
import sys
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch

import plot
import ppo_colored_continuous as ppo
from colored_noise import ColoredNoiseProcess, autocovariance, expected_psd, mean_std
from study import claims, tables
from study.protocol import BETAS, COMPLEX, N_ENVS, NAMES, SETTINGS
from study.runs import CELL
from study.statistics import cells_interval, mean_interval

pytestmark = pytest.mark.filterwarnings("error")
RESULTS = Path(plot.__file__).parent / "results"
CAR, PENDULUM = "MountainCarContinuous-v0", "dm_control/pendulum-swingup-v0"
POINT, ANT = COMPLEX[:2]
FOUND = {"where": "Fig. 3", "says": "it is so", "verdict": "holds", "data": "0.2", "mean": 0.2}
FOUND |= {"low": 0.1, "high": 0.3, "least": 0.0, "most": np.inf, "unit": "deviations", "runs": "3"}
NO_NUMBER = FOUND | {"mean": np.nan, "low": np.nan, "high": np.nan}
COVERAGE = [FOUND, FOUND | {"verdict": "open", "unit": "share of runs", "most": 0.1}]
COVERAGE += [NO_NUMBER | {"data": "in 3 of 4"}, NO_NUMBER | {"verdict": "open", "data": "no runs"}]


def made_up(level, envs=(PENDULUM,), betas=(0, 0.5, 1), n_envs=(4,), seeds=2, **other):
    """Runs of the study's protocol about level(env_id, beta, n_envs), as `select` gives them.

    A beta of NaN stands for vanilla PPO.
    """
    axes = {"env_id": envs, "beta": map(float, betas), "n_envs": n_envs, "seed": range(seeds)}
    runs = pd.MultiIndex.from_product(axes.values(), names=axes).to_frame(index=False)
    levels = [level(*each) for each in zip(runs.env_id, runs.beta, runs.n_envs, strict=True)]
    runs["performance"] = levels + 0.3 * np.random.default_rng(0).normal(size=len(runs))
    settings = SETTINGS | {"environment": runs.env_id.map(NAMES), "vanilla": runs.beta.isna()}
    settings |= {"bootstrap_timeouts": ~runs.env_id.str.startswith("dm_control/")} | other
    return runs.assign(final_return=runs.performance + 1, **settings)


def made_up_curves(runs):
    """Learning curves whose means are the performance, and whose ends are the final returns."""
    shape = np.linspace(-1, 1, 5)
    return pd.DataFrame(runs.performance.to_numpy()[:, None] + shape, runs.index, range(10, 60, 10))


def together(*parts):
    return pd.concat(parts, ignore_index=True)


def z_scores(runs):
    groups = runs.groupby("environment").performance
    return (runs.performance - groups.transform("mean")) / groups.transform("std", ddof=0)


def level(env_id, beta, n_envs):
    return (-1 if env_id == CAR else 3) * np.nan_to_num(beta) + n_envs


def texts(artists):
    return [artist.get_text() for artist in artists]


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def check_labels(fig):
    """Panels are labelled and not empty. No labels are nearer than 2 points, no titles touch."""
    fig.set_dpi(60)
    fig.canvas.draw()
    assert all(ax.has_data() for ax in fig.axes)
    assert all(fig.get_supxlabel() or ax.get_xlabel() or ax.get_title() for ax in fig.axes)
    groups = [[ax.title for ax in fig.axes]]
    for ax in fig.axes:
        for axis in (ax.xaxis, ax.yaxis):
            (low, high), labels = sorted(axis.get_view_interval()), axis.get_ticklabels()
            groups += [[t for t in labels if low <= t.get_position()[axis is ax.yaxis] <= high]]
    renderer = fig.canvas.get_renderer()
    for group in groups:
        boxes = [text.get_window_extent(renderer) for text in group if text.get_text()]
        boxes = [box.padded(fig.dpi / 72) for box in boxes]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_every_figure_and_table_of_the_study(monkeypatch, tmp_path):
    """Of runs of all that the study varies: each figure is labelled, and no copy of another."""
    both = [CAR, PENDULUM]
    parts = [made_up(level, [*both, POINT], [0, 0.5, 1, np.nan], [1, 4])]
    parts += [made_up(level, both, [0.5], [2], n_steps=n_steps) for n_steps in (2048, 4096)]
    parts += [made_up(level, both, n_epochs=20)]
    parts += [made_up(level, [CAR], method=method) for method in ("trpo", "a2c")]
    parts += [made_up(lambda *_: 2, both, [np.nan], [1, 4], method="gsde", vanilla=False)]
    runs, pictures = together(*parts), {}

    def save(fig, path, dpi=None):  # writing files would take most of the time
        if path.suffix == ".png":
            check_labels(fig)
            pictures[path.stem] = bytes(fig.canvas.buffer_rgba())

    monkeypatch.setattr(plt.Figure, "savefig", save)
    todo = plot.results(runs, made_up_curves(runs), [0, 0.5, 1])
    known = {*todo, *plot.noise([]), "", "learning_curves_n_envs_*", "results/environments.png"}
    # The table of the paper's claims names figures and tables that are made
    assert {claim[3] for claim in claims.CLAIMS} <= known
    for of in ("n_envs_1", "n_envs_2", "pendulum_swingup", "point_push"):
        del todo[f"learning_curves_{of}"]
    # Eight betas and eight n_envs: axes as full as the study fills them
    full = made_up(level, [PENDULUM], BETAS, N_ENVS, seeds=1)
    todo |= {"all betas": (plot.compare, full, "beta", CELL), "all": (plot.n_envs_beta_grids, full)}
    todo["coverage"] = (pd.DataFrame, COVERAGE)
    made, not_made = plot.make_all(todo, tmp_path)
    assert set(made) == set(todo) and not_made == []
    assert len(set(pictures.values())) == len(pictures) == len(todo) - 7
    tables_made = set(made) - set(pictures)
    files = {f"{name}.{suffix}" for name in tables_made for suffix in ("csv", "md", "tex")}
    assert {path.name for path in tmp_path.iterdir()} == files


def test_what_cannot_be_made_has_a_reason(monkeypatch, tmp_path):
    monkeypatch.setattr(plt.Figure, "savefig", lambda *_, **__: None)
    runs = made_up(level, [CAR], [0.5], seeds=1)
    todo = plot.results(runs, made_up_curves(runs), [0.5])
    del todo["coverage"]
    made, not_made = plot.make_all(todo, tmp_path)
    reasons = dict(line.split(": needs ") for line in not_made)
    assert set(made) | set(reasons) == set(todo) and not set(made) & set(reasons)
    assert reasons["performance_vs_beta"] == "at least two values of beta"
    assert reasons["claims"] == "the table coverage"


def test_averages_are_of_comparable_cells_and_say_of_which():
    runs = together(
        made_up(lambda _, beta, n: 2 * beta, n_envs=(4, 32), seeds=5),
        made_up(lambda _, beta, n: -beta, [CAR], seeds=5),
    )
    ax = plot.compare(runs, "beta", ["environment", "n_envs"]).axes[0]
    made_of = "n_envs 4 in 1 environment; n_envs 4, 32 in 1 environment; 45 runs"
    assert ax.get_title().replace("\n", " ") == made_of
    cells = z_scores(runs).groupby([runs.beta, runs.environment, runs.n_envs])
    expected = cells.mean().groupby("beta").mean()
    assert ax.lines[0].get_ydata() == pytest.approx(expected.to_numpy())
    _, low, high = cells_interval([z for (beta, *_), z in cells if beta == 0.5])
    [bar] = ax.collections[1].get_segments()  # the second beta's interval
    assert bar.ravel() == pytest.approx([0.5, low, 0.5, high])
    # Mountain Car lacks n_envs 32, so that an average over n_envs is without it
    ax = plot.compare(runs, "n_envs", ["environment", "beta"]).axes[0]
    assert ax.get_title() == "n_envs 4, 32 in 1 environment; 30 runs"
    # A beta that only one of them has changes no average
    more = together(runs, made_up(level, [CAR], [0.2]))
    data = plot.results(more, made_up_curves(more), [])["performance_vs_beta"][1]
    assert set(data.beta) == {0, 0.5, 1} and set(data.environment) == set(runs.environment)


def check_lines(fig, runs, by, x):
    """A line per value of `by`, of the means over x of these runs, which are of one environment."""
    lines, expected = fig.axes[0].lines, z_scores(runs).groupby([runs[by], runs[x]]).mean()
    values = expected.index.unique(by)
    for line, key, value in zip(lines, fig.legends[0].get_lines(), values, strict=True):
        assert line.get_ydata() == pytest.approx(expected[value].to_numpy())
        # Lines stand beside each other, so that their intervals can be seen
        assert line.get_xdata() == pytest.approx(list(expected[value].index), rel=0.1, abs=0.1)
        assert key.get_marker() == line.get_marker() and key.get_color() == line.get_color()


def test_a_line_per_algorithm_n_steps_and_n_epochs():
    white = made_up(level, [CAR], [0, 0.5, np.nan], [1, 4])
    sizes = [(1, 4096), (2, 4096), (2, 2048), (4, 2048)]
    steps = together(*(made_up(level, betas=[0.2, 0.5], n_envs=[n], n_steps=t) for n, t in sizes))
    steps["update_size"] = steps.n_envs * steps.n_steps
    parts = [made_up(lambda _, beta, n, e=e: beta * e, n_epochs=e) for e in (10, 20)]
    epochs = together(*parts, made_up(level, betas=[2]))  # of this beta only one n_epochs
    for name, runs, left_out, by, x in (
        ("beta0_vs_vanilla", white, 0.5, "vanilla", "n_envs"),
        ("n_envs_vs_n_steps", steps, 0.2, "n_steps", "update_size"),
        ("n_epochs_vs_beta", epochs, 2, "n_epochs", "beta"),
    ):
        make, *arguments = plot.results(runs, made_up_curves(runs), [])[name]
        check_lines(make(*arguments), runs[runs.beta != left_out], by, x)


def test_grids_show_performance_and_ranks_within_each_n_envs():
    runs = together(
        made_up(lambda _, beta, n: {0: 1, 0.5: 30, 1: 20}[beta]),
        made_up(lambda _, beta, n: 10 * beta, betas=[0.5, 1], n_envs=[32]),
    )
    means = z_scores(runs).groupby([runs.n_envs, runs.beta]).mean()
    share = (means - means.min()) / (means.max() - means.min())
    sizes = []
    for ax in plot.n_envs_beta_grids(runs).axes:
        places = [dots.get_offsets()[0].tolist() for dots in ax.collections]
        assert places == [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2]]  # none at n_envs 32, beta 0
        sizes += [[(dots.get_sizes()[0] - 8) / 200 for dots in ax.collections]]
    performance, ranks, projected = sizes
    assert performance == pytest.approx((share**6).tolist())
    assert ranks == pytest.approx([0, 1, 0.5, 0, 1])
    order = tables.projected_ranks(pd.Series({4: 0.5, 32: 1}), [0, 0.5, 1], [4, 32])
    expected = [*(3 - order[4]) / 2, *(order[32].iloc[1:].rank(ascending=False) - 1)]
    assert projected == pytest.approx(expected)


def test_learning_curves_are_means_over_seeds_beside_the_published_end():
    """Of five seeds the band is their interval; fewer are drawn one by one."""
    runs = made_up(lambda *_: 300, betas=[0, 0.5], seeds=5)
    runs = runs[(runs.beta == 0) | (runs.seed < 2)]
    curves = made_up_curves(runs)
    fig = plot.learning_curves(runs, curves, "environment")
    [ax] = fig.axes
    assert ax.get_title() == "Pendulum Swingup\nn_envs 4, seeds: 2 or 5"
    lines = [line.get_ydata() for line in ax.lines if len(line.get_xdata()) == 5]
    white, half = (curves[runs.beta == beta] for beta in (0, 0.5))
    np.testing.assert_allclose(lines, [white.mean(), half.mean(), *half.to_numpy()])
    _, low, high = mean_interval(white, n_resamples=1000)
    heights = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((low.min(), high.max()))
    ends = [line.get_ydata()[0] for line in ax.lines if len(line.get_xdata()) == 1]
    assert ends == [677.5, 694.6]  # the paper's table of Sec. A14
    keys = texts(fig.legends[0].get_texts())[2:]
    assert keys == ["paper", "95 % BCa interval", "runs, if fewer than 5"]
    two = made_up(lambda _, beta, n: n, n_envs=[1, 32])
    one, many = plot.learning_curves(two, made_up_curves(two), "n_envs").axes
    assert one.get_ylim() == many.get_ylim()


def test_final_returns_stand_beside_the_published():
    runs = made_up(lambda *_: 300, n_envs=[1, 4])
    scatter, _, four = plot.beside_published(tables.average_final_returns(runs), runs).axes
    ours = runs.groupby(["beta", "n_envs"]).final_return.mean()
    x, y = scatter.lines[2].get_data()  # after the diagonal and beta 0
    np.testing.assert_allclose(x, [(521.1 - 1.1) / 765.8, (694.6 - 1.1) / 765.8])
    np.testing.assert_allclose(y, (ours[0.5] - 1.1) / 765.8)
    assert four.lines[0].get_ydata()[2] == pytest.approx((403.1 - 1.1) / 765.8)
    assert scatter.get_ylim() == four.get_ylim() and scatter.get_title() == "6 cells"


def test_verdicts_show_the_interval_and_where_it_must_lie():
    fig = plot.verdicts(pd.DataFrame(COVERAGE))
    above, below = fig.axes
    assert texts(above.get_yticklabels()) == ["Fig. 3: it is so"] * 2
    assert texts(above.texts) == ["holds", "in 3 of 4", "holds"] and texts(below.texts) == ["open"]
    assert [list(line.get_xdata()) for line in above.lines] == [[0.1, 0.3], [0.2]]
    ends = [ax.collections[0].get_paths()[0].get_extents().intervalx for ax in (above, below)]
    assert ends[0].tolist() == [0, above.get_xlim()[1]] and ends[1][1] == 0.1
    assert "those of 4" in fig.get_suptitle()


def test_other_methods_beside_ppo():
    """All are standardized together, at the betas that all have."""
    parts = [made_up(level, [CAR], method=method) for method in ("ppo", "trpo", "a2c")]
    runs = together(*parts)
    fig = plot.transfer(together(runs, made_up(level, [CAR], [2])))
    check_lines(fig, runs, "method", "beta")
    assert texts(fig.legends[0].get_texts()) == ["A2C", "PPO", "TRPO"]
    both = together(parts[0], made_up(lambda *_: 3, [CAR], [np.nan], method="gsde", vanilla=False))
    ax = plot.gsde_vs_beta(both).axes[0]
    assert texts(ax.get_xticklabels()) == ["0", "0.5", "1", "gSDE"]
    z = z_scores(both)[both.method == "gsde"].mean()
    colored, gsde, level_line = (line.get_ydata() for line in ax.lines)
    assert [*gsde, *level_line] == pytest.approx([z] * 3) and len(colored) == 3


def test_complex_tasks_have_a_panel_each():
    """A task with one seed is drawn beside one with two. Small differences do not look large."""
    tasks = made_up(lambda _, beta, n: beta, [POINT]), made_up(lambda *_: 0.5, [ANT], seeds=1)
    fig = plot.complex_tasks(together(*tasks, made_up(level)))
    assert [ax.get_title() for ax in fig.axes] == ["Ant Push", "Point Push"]
    for ax, runs in zip(fig.axes, tasks[::-1], strict=True):
        means = runs.groupby("beta").performance.mean()
        assert ax.lines[0].get_ydata() == pytest.approx(means.to_numpy())
        assert ax.get_ylim()[0] < 0 and ax.get_ylim()[1] > 1


def test_noise_is_beside_its_closed_forms():
    betas = np.array([0, 0.5, 1])
    figures = {name: make(list(data)) for name, (make, data) in plot.noise([0, 0.5, 1]).items()}
    for fig in figures.values():
        check_labels(fig)
    psd = figures["noise_psd"].axes[0].lines
    lags = autocovariance(betas, 1000)
    correlations = (lags[..., 1] / lags[..., 0]).tolist()
    for i, beta in enumerate(betas):
        measured, closed = psd[3 * i].get_ydata(), psd[3 * i + 1].get_ydata()
        np.testing.assert_allclose(closed, expected_psd(beta, 1000)[1:])
        np.testing.assert_allclose(measured, closed, rtol=0.25)
        ax = figures["noise_two_step"].axes[i]
        assert f"closed form {correlations[i]:z.2f}" in ax.get_title()
    measured = [line.get_ydata()[0] for line in figures["noise_bias"].axes[1].lines[:3]]
    np.testing.assert_allclose(measured, mean_std(betas, 1000), rtol=0.05)


def test_the_command_replaces_earlier_figures_and_says_what_is_left_out(
    monkeypatch, tmp_path, capsys
):
    def command(*arguments):
        argv = ["plot.py", "results", *map(str, arguments), "--out", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", argv)
        plot.main()
        return capsys.readouterr().out

    quick = ["final_returns", "final_return_per_beta", "transfer", "n_epochs_vs_beta"]
    results = plot.results
    monkeypatch.setattr(plot, "results", lambda *data: {k: results(*data)[k] for k in quick})
    files = RESULTS / "reproduction.csv", RESULTS / "methods.csv"
    first = command(*files, "--env", "MountainCarContinuous")
    assert first.endswith(f"{tmp_path}: final_returns, final_return_per_beta, transfer\n")
    assert "not made: 1\n  n_epochs_vs_beta: needs at least two values of n_epochs\n" in first
    pdf = (tmp_path / "transfer.pdf").read_bytes()
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf  # journals refuse Type 3 fonts
    (tmp_path / "transfer_mine.png").write_text("the user's own")
    command(files[0], "--env", "pendulum-swingup", "--beta", "0", "1", "--n-envs", "4")
    names = {"final_returns", "final_return_per_beta", "transfer_mine"}
    assert {path.stem for path in tmp_path.iterdir()} == names
    table = pd.read_csv(tmp_path / "final_returns.csv")
    assert set(table.environment) == {"Pendulum Swingup"} and table.beta.tolist() == [0, 1]
    assert "runs left out: 1\n  " in command(RESULTS / "slices.csv", "--env", "AntPush")


def test_untrained_cars_are_those_of_a_first_rollout():
    """Stepped by hand in Gymnasium, with the script's own exploration()."""
    positions = plot.untrained_positions(0.5, n_cars=3, n_steps=200, seed=4)
    torch.manual_seed(4)
    args = argparse.Namespace(n_steps=200, n_envs=3, vanilla=False)
    act = ppo.exploration(ppo.Agent(2, 1), ColoredNoiseProcess(0.5, 3, 1, seed=4), args)
    envs = [gym.make(CAR) for _ in range(3)]
    obs = np.array([env.reset(seed=4 + i)[0] for i, env in enumerate(envs)])
    for t in range(200):
        np.testing.assert_allclose(positions[t], obs[:, 0], atol=1e-6)
        actions = np.clip(act(obs, t), -1, 1)
        obs = np.array([env.step(a)[0] for env, a in zip(envs, actions, strict=True)])


def test_the_animation(monkeypatch, tmp_path):
    """Cars are where they are on the hill, and those at the goal are counted."""
    cars = {0: np.array([[-0.5, -0.6], [-0.4, 0.2]]), 1: np.array([[-0.5, -0.6], [0.46, 0.1]])}
    monkeypatch.setattr(plot, "untrained_positions", cars.get)
    movie = plot.animation([0, 1], n_frames=2)
    movie.save(tmp_path / "animation.gif", plot.PillowWriter(fps=15), dpi=20)
    _, pink = movie._fig.axes
    assert pink.get_title().endswith("(pink), step 1\nat the goal: 1 of 2")
    x, y = pink.lines[-1].get_data()
    assert list(x) == [0.46, 0.1]
    assert np.array(y) - 0.45 * np.sin(3 * x) == pytest.approx([0.66, 0.66], abs=0.08)
