"""plot.py: every figure of a small real sweep, and what it does with incomplete data."""

import argparse
import re
import subprocess
import sys

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from conftest import ROOT, SCRIPT
from PIL import Image
from test_analysis import CAR, PENDULUM, PUSH, select, study, write_run, write_sweep
from test_analysis import run_file as run_file  # the fixture `run`
from test_claims import made_up

import analysis
import plot
import ppo_colored_continuous as ppo
from colored_noise import ColoredNoiseProcess
from environments import NAMES

NOISE = {"noise_random_walks", "noise_psd", "noise_two_step", "noise_marginal", "noise_bias"}
TABLES = {
    "best_beta_per_env",
    "best_beta_per_n_envs",
    "final_return_and_performance",
    "final_returns",
    "final_return_per_beta",
    "robust_statistics",
    "coverage",
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
    "transfer",
    "gsde_vs_beta",
}
FIGURES |= {"learning_curves_n_envs_2", "learning_curves_mountain_car"}


def test_a_mix_that_would_be_averaged_is_an_error_that_names_the_flag(tmp_path, run):
    write_run(tmp_path, PENDULUM, 0.5, 4, 1, [1.0, 2.0])
    write_run(tmp_path, PENDULUM, 0.5, 4, 2, [1.0, 2.0], exp_name="b", learning_rate=1e-3)
    code, _, stderr = run("plot.py results", tmp_path, "--out", tmp_path / "figures")
    error = stderr.strip().splitlines()[-1]
    assert code == 1 and error.startswith("error: Pendulum Swingup")
    assert "--learning-rate 0.00025 and --learning-rate 0.001" in error
    assert len(select(tmp_path / "test")) == 1  # one experiment alone is fine
    # What cannot change a result may differ; n_epochs is one of the study's own axes
    write_run(tmp_path / "fine", PENDULUM, 0.5, 4, 1, [1.0, 2.0], device="cuda", compile=False)
    write_run(
        tmp_path / "fine", PENDULUM, 0.5, 4, 2, [1.0, 2.0], n_epochs=20, exp_name="c", envpool=False
    )
    assert len(select(tmp_path / "fine")) == 2
    write_run(tmp_path / "fine", PENDULUM, 0.5, 4, 3, [1.0, 2.0], envpool=True)
    with pytest.raises(analysis.Unusable, match="--envpool"):
        select(tmp_path / "fine")


@pytest.mark.filterwarnings("error")
def test_runs_that_cannot_be_used_are_listed(tmp_path, run):
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
    write_run(tmp_path / "again", PENDULUM, 0.5, 4, 5, [2.0] * 4)
    code, stdout, stderr = run("plot.py results", tmp_path, "--out", tmp_path / "figures")
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


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["plot.py results", "nowhere"], "nowhere"),
        (["plot.py results", "empty"], "no runs in empty"),
        (["plot.py results", "file.csv"], "not a file that `analysis.py pack` wrote"),
        (["plot.py results", "image.png"], "not a file that `analysis.py pack` wrote"),
        (
            ["plot.py results", "runs", "--env", "Cartpole"],
            "no runs with --env Cartpole; there are: Pendulum Swingup",
        ),
        (["plot.py results", "damaged"], "damaged"),
        (["plot.py results", "runs", "--beta", "pink"], "--beta"),
        (["analysis.py pack", "runs", "nowhere/packed.csv"], "nowhere"),
        (["plot.py noise", "--beta", "nan"], "--beta"),
        (["plot.py noise", "--beta", "1", "--out", "file.csv/figures"], "file.csv"),
        (["plot.py environments", "--out", "picture.xyz"], "picture.xyz"),
        (["plot.py environments", "--out", "nowhere/picture.png"], "nowhere/picture.png"),
        (["plot.py"], "command"),
        (["analysis.py"], "command"),
        (["analysis.py status", "nowhere"], "nowhere"),
        (["analysis.py status", "empty"], "no runs in empty"),
    ],
)
def test_mistakes_give_one_line(tmp_path, monkeypatch, run, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.csv").write_text("a,b\n1,2\n")
    (tmp_path / "image.png").write_bytes(bytes(range(256)))
    write_run(tmp_path / "runs", PENDULUM, 0.5, 4, 1, [1.0])
    (write_run(tmp_path / "damaged", PENDULUM, 0.5, 4, 1, [1.0]) / "config.json").write_text("")
    code, stdout, stderr = run(*arguments)
    lines = [
        line for line in stderr.replace("\r", "\n").splitlines() if line and "runs/s" not in line
    ]
    assert (
        code in (1, 2) and len(lines) == 1 and lines[0].startswith("error: ") and words in lines[0]
    ), stderr
    assert stdout == ""


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A small real sweep of all that the study varies, trained in one process by the script."""
    root = tmp_path_factory.mktemp("sweep")
    tiny = "--total-timesteps 64 --n-steps 16 --batch-size 16 --n-epochs 1"
    tiny += " --eval-freq 32 --eval-episodes 1"
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


def other_methods(runs):
    """The same runs as if of other methods, with n_envs 4, and one seed of gSDE."""
    colored = runs[~runs.vanilla & (runs.n_epochs == 1) & (runs.n_steps == 16)]
    four = colored[colored.n_envs == 2].assign(n_envs=4)
    gsde = colored[(colored.beta == 0.5) & (colored.seed == 1)].assign(beta=np.nan, method="gsde")
    return {"trpo": four.assign(method="trpo"), "a2c": four.assign(method="a2c"), "gsde": gsde}


def check_ticks(fig, gap=2):
    """No two labels of an axis are nearer than `gap` points, nor do titles touch a neighbor's."""
    renderer = fig.canvas.get_renderer()
    for ax in fig.axes:
        for axis in (ax.xaxis, ax.yaxis):
            (low, high), labels = sorted(axis.get_view_interval()), axis.get_ticklabels()
            shown = [t for t in labels if low <= t.get_position()[axis is ax.yaxis] <= high]
            boxes = [label.get_window_extent(renderer) for label in shown if label.get_text()]
            for i, box in enumerate(boxes):
                pad = gap / 2 * fig.dpi / 72
                for other in boxes[:i]:
                    assert not box.padded(pad).overlaps(other.padded(pad)), (ax, box, other)
    titles = [ax.title.get_window_extent(renderer) for ax in fig.axes if ax.get_title()]
    assert not any(a.overlaps(b) for i, a in enumerate(titles) for b in titles[:i])


def check_figures(monkeypatch, tmp_path, todo, expected):
    """Makes all of todo; returns the figures' names.

    Each is labelled, not blank, without empty panels or labels that touch, and none is a copy.
    """
    close = plt.close

    def check_labels(fig):
        assert all(ax.has_data() and (ax.get_xlabel() or ax.get_title()) for ax in fig.axes)
        assert any(ax.get_xlabel() for ax in fig.axes) and any(ax.get_ylabel() for ax in fig.axes)
        check_ticks(fig)
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
        pdf = figure.with_suffix(".pdf").read_bytes()
        assert len(pdf) > 5000 and b"/Type3" not in pdf and b"/FontFile2" in pdf
    assert len({image.tobytes() for image in pixels.values()}) == len(figures)
    return {figure.stem for figure in figures}


@pytest.mark.filterwarnings("error")
def test_every_figure_and_table_of_a_real_sweep(monkeypatch, tmp_path, sweep):
    runs, curves = analysis.load([sweep])
    runs, left_out = analysis.select(runs)
    assert left_out == []
    methods = {"ppo": runs} | other_methods(runs)
    todo = plot.results(methods, curves)
    for name in ("average_final_returns", "beside_published"):
        del todo[name]  # only of runs with the study's protocol: they have tests of their own
    assert check_figures(monkeypatch, tmp_path, todo, FIGURES | TABLES) == FIGURES
    for name in TABLES:
        table = pd.read_csv(tmp_path / f"{name}.csv")
        markdown = (tmp_path / f"{name}.md").read_text().splitlines()
        assert len(markdown) == len(table) + 2 and markdown[0].count("|") == table.shape[1] + 1
        latex = (tmp_path / f"{name}.tex").read_text()
        assert latex.startswith(r"\begin{longtable}") and latex.count("\\\\\n") >= len(table) + 1
    # One seed and nothing else: what cannot be made is said, the rest is there.
    few = runs[(runs.seed == 1) & (runs.beta == 0.5) & (runs.n_envs == 2) & (runs.env_id == CAR)]
    few, _ = analysis.main_grid(few)
    assert len(few) == 1
    (tmp_path / "few").mkdir()
    made, not_made = plot.make_all(plot.results({"ppo": few}, curves), tmp_path / "few")
    assert {"final_returns", "learning_curves_n_envs_2", "final_return_vs_n_envs"} <= set(made)
    assert [line.split(": needs ")[0] for line in not_made][:3] == [
        "average_final_returns",
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
    assert len({plot.look(beta)["marker"] for beta in analysis.STUDY_BETAS}) == 8
    others = [-2, -1, 0.2, 0.3, 0.4, 2, 2.5, 3, 4]
    assert len({str(plot.look(beta)) for beta in others}) == len(others)


@pytest.mark.parametrize("data", ["reproduction.csv", "study.csv", "bootstrapped_timeouts.csv"])
def test_the_evidence_shows_the_tables_of_the_data(tmp_path, data):
    runs, _ = analysis.select(analysis.load([ROOT / "results" / data])[0])
    analysis.save_table(
        analysis.final_return_per_beta(analysis.final_returns(runs)), tmp_path, "table"
    )
    text = (ROOT / "results" / "README.md").read_text()
    assert (tmp_path / "table.md").read_text() + "\n" in text


@pytest.mark.filterwarnings("error")
def test_labels_of_the_whole_grid_do_not_touch(tmp_path, monkeypatch):
    """Eight betas, eight n_envs, and n_steps: the axes as full as the study fills them."""
    n_envs = [1, 2, 4, 8, 16, 32, 64, 128]
    write_sweep(tmp_path, dict.fromkeys(analysis.STUDY_BETAS, 1), n_envs, seeds=2)
    study(monkeypatch, evaluations=4)
    for n, n_steps in ((2, 4096), (8, 1024)):
        write_run(tmp_path, PENDULUM, 0.5, n, 1, [1.0] * 4, n_steps=n_steps, exp_name=f"n{n}")
    runs, curves = analysis.load([tmp_path])
    runs, _ = analysis.select(runs)
    todo = plot.results({"ppo": runs}, curves)
    names = ["performance_vs_beta", "performance_vs_n_envs", "n_envs_vs_n_steps"]
    names += ["n_envs_beta_grids", "final_return_vs_n_envs", "robust_performance"]
    names += ["beside_published"]
    made = {"final_returns": analysis.final_returns(runs[runs.n_steps == 2048])}
    made["average_final_returns"] = analysis.average_final_returns(runs[runs.n_steps == 2048])
    made["robust_statistics"] = analysis.robust_statistics(runs[runs.n_steps == 2048])
    for name in names:
        make, data, *rest = todo[name]
        fig = make(made[data] if isinstance(data, str) else data, *rest)
        fig.canvas.draw()
        check_ticks(fig)
        plt.close(fig)


@pytest.mark.filterwarnings("error")
def test_final_returns_beside_the_published():
    """A cell's marker is where paper and we are; an open one is the paper's average."""
    runs = made_up(lambda *_: 300, [PENDULUM], n_envs=[1, 4])
    fig = plot.beside_published(analysis.average_final_returns(runs), runs)
    scatter, one, four = fig.axes
    x, y = scatter.lines[2].get_data()  # after the diagonal and beta 0
    np.testing.assert_allclose(x, [(521.1 - 1.1) / 765.8, (694.6 - 1.1) / 765.8])
    np.testing.assert_allclose(y, [(300 - 1.1) / 765.8] * 2, atol=0.001)
    assert one.get_title() == "n_envs 1, 1 environment"
    assert four.lines[0].get_ydata()[2] == pytest.approx((403.1 - 1.1) / 765.8)
    assert four.get_title().startswith("n_envs 4")
    plt.close(fig)
    one_cell = runs[(runs.n_envs == 4) & (runs.beta == 0)]
    plt.close(plot.beside_published(analysis.average_final_returns(one_cell), one_cell))


def test_three_betas_by_default_and_their_lines_carry_markers(tmp_path, run):
    write_sweep(tmp_path, dict.fromkeys(analysis.STUDY_BETAS, 1), seeds=2)
    runs, curves = analysis.load([tmp_path])
    runs, _ = analysis.select(runs)
    for betas, shown in ((None, [0, 0.5, 1]), ([-1.0, 2.0], [-1, 2])):
        make, data, *rest = plot.results({"ppo": runs}, curves, betas)["learning_curves_n_envs_4"]
        fig = make(data, *rest)
        lines = [line for line in fig.axes[0].lines if len(line.get_xdata()) == 4]
        assert [line.get_marker() for line in lines] == [plot.look(b)["marker"] for b in shown]
        plt.close(fig)
    _, stdout, _ = run("plot.py results", tmp_path, "--out", tmp_path / "figures")
    assert "not among the learning curves (--beta chooses): 5\n  beta -1\n" in stdout
    write_sweep(tmp_path, {"vanilla": 1}, seeds=2)
    _, stdout, _ = run(
        "plot.py results", tmp_path, "--beta", "0", "vanilla", "--out", tmp_path / "figures"
    )
    assert "not among the learning curves (--beta chooses): 1\n  vanilla PPO, never\n" in stdout
    assert plot.three_betas(runs[runs.beta.isin([-1, 0.2, 0.5, 2])]) == [-1, 0.2, 0.5]


def test_averages_say_what_they_are_made_of(tmp_path):
    """The README's own data once compared eight environments with one, as "8 environments"."""
    write_sweep(tmp_path, {0: 1, 0.5: 2}, n_envs=(4, 32))
    write_sweep(tmp_path, {0: 9, 0.5: 5}, n_envs=(4,), env_id=CAR)
    runs = select(tmp_path)
    fig = plot.compare(runs, "n_envs", ["environment", "beta"])
    title = "1 environment, n_envs 4, 32, 20 runs\n"
    title += "(without 10 runs that lack a counterpart or a second seed)"
    assert fig.axes[0].get_title() == title
    fig = plot.compare(runs, "beta", ["environment", "n_envs"])
    assert fig.axes[0].get_title() == "2 environments, n_envs 4, 32 (3 cells), 30 runs"
    fewer = runs[(runs.env_id != CAR) | (runs.seed == 1)]
    two = plot.compare(fewer, "beta", ["environment", "n_envs"])  # without the cell of one seed
    assert two.axes[0].get_title() == title.replace("10 runs", "2 runs")
    assert two.axes[0].collections[0].get_segments()[0][:, 1].std() > 0  # an interval
    one = plot.compare(runs[runs.seed == 1], "beta", ["environment", "n_envs"])
    assert one.axes[0].get_title().endswith("\n(no interval where a cell has one run)")
    means = fig.axes[0].lines[0].get_ydata()
    z = runs.assign(z=analysis.standardize(runs)).groupby(["beta", "environment", "n_envs"]).z
    assert means == pytest.approx(z.mean().groupby("beta").mean().to_numpy())
    plt.close("all")


def test_a_complex_task_with_one_seed_is_drawn_beside_one_with_two(tmp_path):
    write_sweep(tmp_path, {0: 1, 0.5: 2}, seeds=2, env_id=PUSH)
    write_sweep(tmp_path, {0: 1, 0.5: 2}, seeds=1, env_id="AntPush-v1")
    fig = plot.complex_tasks(select(tmp_path))
    assert [ax.get_title() for ax in fig.axes] == [
        "Ant Push\n(one run each: no interval)",
        "Point Push",
    ]
    assert "without" not in fig.get_suptitle()
    plt.close(fig)


def test_figures_that_runs_do_not_allow_say_why(tmp_path, run):
    """Short runs have no published numbers beside them; a projection goes by one T; no TRPO."""
    for n_envs in (1, 4):
        for env_id, T in ((CAR, 1000), (PENDULUM, 200)):
            for beta in (0, 0.5):
                write_run(tmp_path / "runs", env_id, beta, n_envs, 1, [1.0], noise_seq_len=T)
    out = ["--out", tmp_path / "figures"]
    assert run("plot.py results", tmp_path / "runs", *out)[0] == 0
    report = (tmp_path / "figures" / "report.txt").read_text()
    assert "beside_published: needs the table average_final_returns" in report
    assert "n_envs_beta_grids: needs one --noise-seq-len" in report
    code, _, stderr = run("plot.py results", tmp_path / "runs", "--method", "trpo", *out)
    assert code == 1 and "error: needs a complete run of the method trpo" in stderr


def test_grid_markers_stand_at_their_betas():
    sizes = pd.DataFrame({4: [0.5, 1.0, 0.2], 32: [np.nan, 0.5, 1.0]}, index=[0, 0.5, 1])
    fig, ax = plt.subplots()
    plot.draw_grid(ax, sizes, "")
    places = [tuple(dots.get_offsets()[0]) for dots in ax.collections]
    assert places == [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2)]
    plt.close(fig)


def test_ranks_use_each_columns_own_count(tmp_path, monkeypatch):
    write_sweep(tmp_path, {0: 1, 0.5: 3, 1: 2}, n_envs=(4,), spread=0.1)
    write_sweep(tmp_path, {0.5: 1, 1: 2}, n_envs=(32,), spread=0.1)
    drawn = []
    monkeypatch.setattr(plot, "draw_grid", lambda ax, sizes, title: drawn.append(sizes))
    plt.close(plot.n_envs_beta_grids(select(tmp_path)))
    assert drawn[1][4].tolist() == [0, 1, 0.5]
    assert drawn[1][32].tolist()[1:] == [0, 1] and np.isnan(drawn[1][32][0])
    for sizes in drawn[2:]:  # projected: the same places, from 0 to 1
        assert sizes.isna().sum().tolist() == [0, 1]
        assert sizes.min().tolist() == [0, 0] and sizes.max().tolist() == [1, 1]


def test_figures_of_earlier_data_do_not_stay(tmp_path, run):
    write_sweep(tmp_path / "a", {0: 1, 0.5: 2, "vanilla": 1}, n_envs=(1, 4), seeds=2)
    write_run(tmp_path / "b", CAR, 0.5, 2, 1, [1.0])
    out = tmp_path / "figures"
    assert run("plot.py results", tmp_path / "a", "--out", out)[0] == 0
    for name in (
        "beta0_vs_vanilla",
        "learning_curves_n_envs_4",
        "learning_curves_pendulum_swingup",
    ):
        assert (out / f"{name}.png").exists() and (out / f"{name}.pdf").exists()
    for name in ("mine.png", "learning_curves_mine.png", "notes.csv"):
        (out / name).write_text("the user's own")
    _, stdout, _ = run("plot.py results", tmp_path / "b", "--out", out)
    made = stdout.splitlines()[0].partition(": ")[2].split(", ")
    assert "final_returns" in made and "performance_vs_beta" not in made
    left = {path.name for path in out.iterdir()}
    assert {"mine.png", "learning_curves_mine.png", "notes.csv"} <= left
    left -= {"mine.png", "learning_curves_mine.png", "notes.csv", "report.txt"}
    assert {name.rpartition(".")[0] for name in left} == set(made)


@pytest.mark.filterwarnings("error")
def test_vanilla_alone(tmp_path, run):
    write_sweep(tmp_path / "runs", {0: 1, "vanilla": 1}, seeds=2)
    out = tmp_path / "figures"
    code, stdout, stderr = run(
        "plot.py results", tmp_path / "runs", "--beta", "vanilla", "--out", out
    )
    assert code == 0, stderr
    assert stdout.startswith(f"{out}: final_returns, final_return_per_beta, coverage\n")
    report = (out / "report.txt").read_text()
    assert "final_return_vs_n_envs: needs runs with colored noise" in report


def test_the_report_names_what_is_dropped_and_mixed(tmp_path, run):
    write_run(tmp_path / "runs", PENDULUM, 0.5, 4, 1, [1.0], eval_episodes=50)
    write_run(tmp_path / "runs", PENDULUM, 0.5, 4, 2, [1.0], eval_episodes=10)
    write_run(tmp_path / "runs", CAR, 0.5, 2, 1, [1.0], n_steps=4096)
    write_run(tmp_path / "runs", CAR, 0.5, 4, 1, [1.0], method="trpo")
    out = tmp_path / "figures"
    _, stdout, _ = run("plot.py results", tmp_path / "runs", "--out", out)
    for text in (stdout, (out / "report.txt").read_text()):
        assert "Mountain Car: --n-steps 4096 --n-epochs 10, not (2048, 10)" in text
        assert "--eval-episodes 10 (1 runs) and --eval-episodes 50 (1 runs)" in text
        assert "only where these are compared: 1\n  trpo: 1 runs" in text
    assert run("plot.py results", tmp_path / "runs", "--method", "trpo", "--out", out)[0] == 0


def test_the_environments_picture(monkeypatch):
    """Titles stand above square pictures, also where a frame is wide."""

    class Env:
        def reset(self, seed): ...
        def close(self): ...
        def render(self):
            return np.full((400, 600, 3), 255, np.uint8)

    monkeypatch.setattr(plot, "make_render_env", lambda env_id: Env())
    fig = plot.contact_sheet()
    fig.canvas.draw()
    assert {ax.get_title() for ax in fig.axes} == set(NAMES.values())
    for ax in fig.axes:
        height, width, _ = ax.images[0].get_array().shape
        assert height == width
        picture = ax.images[0].get_window_extent()
        assert ax.title.get_window_extent().y0 >= picture.y1
    plt.close(fig)


@pytest.mark.filterwarnings("error")
def test_other_methods_beside_ppo(tmp_path, run, monkeypatch):
    """Panels of TRPO and A2C are standardized by themselves, the third over all methods."""
    for i, method in enumerate(("ppo", "trpo", "a2c", "gsde")):
        for beta in (0, 0.5) if method != "gsde" else (0.5,):
            for seed in (1, 2):
                more = {"method": method, "exp_name": method}
                write_run(tmp_path, CAR, beta, 4, seed, [10 * i + beta + 0.01 * seed], **more)
    methods, _ = analysis.select_methods(analysis.load([tmp_path])[0])
    three = pd.concat([methods[name] for name in ("ppo", "trpo", "a2c")])
    fig = plot.transfer(three)
    trpo, a2c, overall = fig.axes
    for ax in (trpo, a2c):
        assert ax.lines[0].get_ydata() == pytest.approx([-1, 1], abs=0.01)
    z = analysis.standardize(three).groupby([three.method, three.beta]).mean()
    for line, method in zip(overall.lines, ("a2c", "ppo", "trpo"), strict=True):
        assert line.get_ydata() == pytest.approx(z[method].to_numpy())
        assert line.get_color() == plot.METHOD_LOOK[method]["color"]
    assert trpo.get_title().startswith("TRPO") and a2c.get_title().startswith("A2C")
    plt.close(fig)
    both = pd.concat([methods["ppo"], methods["gsde"]])
    fig = plot.gsde_vs_beta(both)
    assert fig.axes[0].get_xticklabels()[-1].get_text() == "gSDE"
    z = analysis.standardize(both)[both.method == "gsde"].mean()
    assert fig.axes[0].lines[0].get_ydata() == pytest.approx([z, z])
    plt.close(fig)
    # A user's command: all of it, what lacks said, and never an average over methods
    out = tmp_path / "figures"
    _, stdout, _ = run("plot.py results", tmp_path, "--out", out)
    made = stdout.splitlines()[0].partition(": ")[2].split(", ")
    assert {"transfer", "gsde_vs_beta", "coverage"} <= set(made)
    title = "of other methods, only where these are compared: 3"
    assert f"{title}\n  trpo: 4 runs\n  a2c: 4 runs\n  gsde: 2 runs\n" in stdout
    assert "final returns beside the published: 1\n  0 of 0 published means outside" in stdout
    table = pd.read_csv(out / "final_returns.csv")
    assert table["mean"].tolist() == pytest.approx([0.015, 0.515])
    _, stdout, _ = run("plot.py results", tmp_path / "ppo", "--out", out)
    assert "transfer: needs runs of `baselines.py trpo` or `a2c` with n_envs 4" in stdout
    assert "gsde_vs_beta: needs runs of `baselines.py gsde`" in stdout
    # Without PPO's runs there is panel (a); another protocol is not compared
    code, stdout, stderr = run("plot.py results", tmp_path / "trpo", "--out", out)
    assert code == 0 and stdout.startswith(f"{out}: transfer, coverage\n"), stderr
    code, _, stderr = run("plot.py results", tmp_path, "--method", "gsde", "--out", out)
    assert code == 1 and "gSDE has no beta" in stderr
    with pytest.raises(analysis.Unusable, match="same protocol"):
        plot.transfer(three.assign(gamma=np.where(three.method == "trpo", 0.9, 0.99)))


def test_the_coverage_of_the_measured_results(tmp_path, run):
    """Each row of the table names a command that is there, and a file or figure it makes."""
    out = tmp_path / "figures"
    assert run("plot.py results", ROOT / "results" / "reproduction.csv", "--out", out)[0] == 0
    table = pd.read_csv(out / "coverage.csv").fillna("")
    assert set(table.verdict) <= {"holds", "does not", "open", ""}
    assert table.runs.str.fullmatch(r"\d+ of \d+|none needed").all()
    presets = set(" ".join(table.command).replace(";", "").split("run_sweep.sh "))
    presets = {command.split()[0] for command in presets if "python plot.py results" in command}
    help_text = (ROOT / "grids.py").read_text()
    known = plot.results(dict(ppo=select(ROOT / "results" / "reproduction.csv")), None)
    known = {*known, *NOISE, "results/environments.png", "learning_curves_n_envs_*"}
    known |= {"learning_curves_mountain_car"}
    assert set(table.file) <= known
    for preset in presets:
        assert f"\n  {preset} " in help_text, preset
    said = table.set_index("says")
    assert (
        said.runs["beta 0.5 is best on average"]
        == f"{len(select(ROOT / 'results' / 'reproduction.csv'))} of 20480"
    )


def test_untrained_cars_are_those_of_a_first_rollout():
    """Stepped by hand in Gymnasium, with the script's own exploration(); at the goal they stay."""
    positions = plot.untrained_positions(0.5, n_cars=3, n_steps=200, seed=4)
    torch.manual_seed(4)
    agent = ppo.Agent(2, 1).requires_grad_(False)
    args = argparse.Namespace(n_steps=200, n_envs=3, vanilla=False)
    noise = ColoredNoiseProcess(0.5, 3, 1, seed=4)
    act = ppo.exploration(agent, noise, args)
    envs = [gym.make("MountainCarContinuous-v0") for _ in range(3)]
    obs = np.array([env.reset(seed=4 + i)[0] for i, env in enumerate(envs)])
    for t in range(200):
        np.testing.assert_allclose(positions[t], obs[:, 0], atol=1e-6)
        actions = np.clip(act(obs, t), -1, 1)
        obs = np.array([env.step(a)[0] for env, a in zip(envs, actions, strict=True)])
    assert positions.shape == (201, 3)
    positions = plot.untrained_positions(1, n_cars=20)
    there = positions >= 0.45
    assert there.any() and (np.diff(there.astype(int), axis=0) >= 0).all()


def test_the_animation(tmp_path):
    """What results/animation.gif shows, and that it plays on and on."""
    with Image.open(ROOT / "results" / "animation.gif") as gif:
        assert gif.n_frames == 100 and gif.info["loop"] == 0
        assert sum(gif.seek(i) or gif.info["duration"] for i in range(100)) < 10_000  # ms
    assert (ROOT / "results" / "animation.gif").stat().st_size < 1e6
    movie = plot.animation([0, 1], n_frames=3)
    movie.save(tmp_path / "x.gif", plot.PillowWriter(fps=15))
    white, pink = (ax.get_title() for ax in movie._fig.axes)
    assert re.search(r"\(white\), step 999\nat the goal: [0-4] of 50", white)  # 1 in the README
    assert re.search(r"\(pink\), step 999\nat the goal: (3\d|4[0-8]) of 50", pink)  # 39
    plt.close(movie._fig)
