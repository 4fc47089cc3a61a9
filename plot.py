"""Every figure and table of the study, with the published numbers beside ours.

    python plot.py noise                           what the noise looks like: nothing needs to be trained
    python plot.py results runs/                   figures and tables of all complete runs in a folder
    python plot.py pack runs/ results/sweep.csv    a folder of runs as one small CSV, which `results` reads as well

Sections named below are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI 2024, with its appendix.
"""

import argparse
import json
import math
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, NullLocator
from scipy import stats
from tqdm import tqdm

from colored_noise import autocovariance, colored_noise, expected_psd, marginal_variance, mean_std
from run_files import FREE_ARGS, fail

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

STUDY_BETAS = [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2]
COMPLEX = [
    "PointPush-v1",
    "AntPush-v1",
    "PointPushMaze-v1",
    "AntPushMaze-v1",
]  # Sec. A8: not in the averages
# fmt: off
NAMES = {  # environment id: its name in the paper (Sec. A4)
    "MountainCarContinuous-v0": "Mountain Car", "dm_control/ball_in_cup-catch-v0": "Ball in Cup (Catch)",
    "dm_control/cartpole-balance_sparse-v0": "Cartpole Balance", "dm_control/cheetah-run-v0": "Cheetah Run",
    "dm_control/cartpole-swingup_sparse-v0": "Cartpole Swingup", "dm_control/hopper-hop-v0": "Hopper Hop",
    "dm_control/pendulum-swingup-v0": "Pendulum Swingup", "dm_control/reacher-hard-v0": "Reacher Hard",
    "dm_control/walker-run-v0": "Walker Run", "door-v0": "Door",
    "PointUMaze-v1": "UMaze Point", "AntUMaze-v1": "UMaze Ant", "SwimmerUMaze-v1": "UMaze Swimmer",
    "Point4Rooms-v1": "4 Rooms Point", "Ant4Rooms-v1": "4 Rooms Ant", "Swimmer4Rooms-v1": "4 Rooms Swimmer",
    "PointPush-v1": "Point Push", "AntPush-v1": "Ant Push",
    "PointPushMaze-v1": "Point Push Maze", "AntPushMaze-v1": "Ant Push Maze",
}
# fmt: on
# The study varies AXES. Other arguments must not vary within an environment, but FREE_ARGS and NOT_ARGUMENTS.
AXES = ["environment", "beta", "n_envs", "n_steps", "n_epochs", "seed"]
CELL = ["environment", "n_envs"]
NOT_ARGUMENTS = [
    "path",
    "source",
    "status",
    "git_commit",
    "wall_seconds",
    "performance",
    "final_return",
]
NOT_ARGUMENTS += ["exp_name", "env_id", "vanilla"]  # or shown by others


class Unusable(Exception):
    """These runs cannot be plotted, or a figure cannot be made of them; the message says why."""


# --- Reading runs -----------------------------------------------------------------------------------------------------


def read_run(folder):
    """Reads one run's folder, whatever its state.

    Returns:
        run: dict of its arguments, with `beta` as text ("0.5", "vanilla", or "0.5_1" for one per action dimension), and
            `status`: "complete", "unfinished: ..." without summary.json, or "damaged: ...".
        steps, returns: (n_evaluations,) the environment step and the mean return of each evaluation.
    """
    run, steps, returns = {}, np.zeros(0, int), np.zeros(0)
    complete = (folder / "summary.json").exists()
    try:
        config = json.loads((folder / "config.json").read_text())
        args = config["args"]
        beta = "vanilla" if args["vanilla"] else "_".join(f"{beta:g}" for beta in args["beta"])
        whole = {key: int(args[key]) for key in ("n_envs", "n_steps", "n_epochs", "seed")}
        run = {
            **args,
            **whole,
            "env_id": str(args["env_id"]),
            "beta": beta,
            "git_commit": config["git_commit"],
        }
        rows = (folder / "evaluations.csv").read_text().splitlines()[1:]
        table = np.array([row.split(",")[:2] for row in rows], float).reshape(-1, 2)
        steps, returns = table[:, 0].astype(int), table[:, 1]
        run["status"] = f"unfinished: {len(steps)} evaluations, no summary.json"
        if complete:
            summary = json.loads((folder / "summary.json").read_text())
            run |= {"status": "complete", "wall_seconds": float(summary["wall_seconds"])}
            if len(returns) == 0 or not np.isfinite(returns).all() or (np.diff(steps) <= 0).any():
                raise ValueError("evaluations.csv is not a series of finite returns")
            measured = [returns.mean(), returns[-1]]
            if not np.allclose(
                [summary["performance"], summary["final_return"]], measured, rtol=1e-4, atol=1e-4
            ):
                raise ValueError("summary.json does not agree with evaluations.csv")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        run["status"] = f"{'unfinished' if run and not complete else 'damaged'}: {error!r}"
    return run, steps, returns


def read_folder(path):
    """Reads all runs under a folder: (runs, curves) as in `load`."""
    names = ("config.json", "evaluations.csv")
    folders = sorted({file.parent for name in names for file in path.rglob(name)})
    read = [
        read_run(folder)
        for folder in tqdm(folders, desc=f"reading {path}", unit=" runs", mininterval=0.5)
    ]
    runs = pd.DataFrame([run for run, _, _ in read])
    runs["path"] = [folder.relative_to(path).as_posix() for folder in folders]
    all_steps = np.unique(np.concatenate([np.zeros(0, int), *(steps for _, steps, _ in read)]))
    curves = np.full((len(read), len(all_steps)), np.nan)
    for row, (_, steps, returns) in zip(curves, read, strict=True):
        row[np.searchsorted(all_steps, steps)] = returns
    return runs, pd.DataFrame(curves, columns=all_steps)


def load(paths, env=None, beta=None, n_envs=None):
    """Reads the runs in folders, and in files that `pack` wrote; keeps those of some environments, betas and n_envs.

    env, beta, n_envs: lists, or None for all: ids or names in the paper, beta as text ("vanilla" for vanilla PPO).

    Returns:
        runs: a row per run, whatever its state; columns as in `read_run`, `source` and `path` (where it was found),
            `environment` (its name in the paper), `performance` and `final_return`.
        curves: rows with the index of `runs`, a column per environment step: the mean return evaluated there, or NaN.

    Raises Unusable where there is nothing to read, OSError where it cannot be read.
    """
    tables = []
    for path in map(Path, paths):
        if path.is_dir():
            runs, curves = read_folder(path)
        else:
            try:
                runs = pd.read_csv(path, dtype={"beta": str})
                runs[["path", "status", "env_id", "beta"]]
            except (ValueError, KeyError) as error:
                raise Unusable(f"{path} is not a file that `plot.py pack` wrote: {error}") from None
            steps = [column for column in runs if column.isdigit()]
            runs, curves = runs.drop(columns=steps), runs[steps].rename(columns=int)
        if runs.empty:
            raise Unusable(
                f"no runs in {path}: ppo_colored_continuous.py and run_sweep.sh make them"
            )
        tables.append((runs.assign(source=str(path)), curves))
    runs, curves = (pd.concat(parts, ignore_index=True) for parts in zip(*tables, strict=True))
    runs = runs.reindex(columns=runs.columns.union(["env_id", *AXES], sort=False))
    runs["environment"] = runs.env_id.map(
        lambda env_id: NAMES.get(env_id, env_id), na_action="ignore"
    )
    # Sec. "Evaluation Details": performance is the mean over all evaluations, the area under the learning curve.
    curves = curves.sort_index(axis=1)
    runs["performance"] = curves.mean(axis=1)
    runs["final_return"] = curves.ffill(axis=1).iloc[:, -1] if len(curves.columns) else np.nan
    for columns, wanted in (
        (["environment", "env_id"], env),
        (["beta"], beta),
        (["n_envs"], n_envs),
    ):
        if wanted:
            runs = runs[
                runs[columns].isin(wanted).any(axis=1) | runs.env_id.isna()
            ]  # damaged ones stay, to be listed
    return runs, curves.loc[runs.index]


def pack(runs, curves, file):
    """Writes runs, complete or not, to a CSV that `load` reads: a row per run with its settings and a column per step.

    It is compressed where its name ends in .gz.
    """
    derived = [
        "source",
        "environment",
        "performance",
        "final_return",
        "runs_dir",
        "resume",
        "overwrite",
    ]
    table = runs.drop(columns=derived, errors="ignore").dropna(axis=1, how="all")
    pd.concat([table, curves], axis=1).to_csv(file, index=False, float_format="%.9g")


def select(runs):
    """Chooses the runs to plot: those that are complete, each setting and seed once.

    Returns them, with `beta` a number (NaN for vanilla PPO), and a line for each run that is left out.
    Raises Unusable where there are none, or where another argument than AXES varies within an environment.
    """
    complete = runs[runs.status == "complete"]
    status = runs.status.copy()
    status[complete.index[complete.duplicated(AXES)]] = "the same settings and seed as another run"
    status[complete.index[complete.beta.astype(str).str.contains("_")]] = (
        "one beta per action dimension is not in the study"
    )
    left_out = (runs.source + "/" + runs.path + ": " + status)[status != "complete"].tolist()
    chosen = runs[status == "complete"]
    if chosen.empty:
        raise Unusable(
            "no complete run of these environments, betas and n_envs"
            + "; ".join(["", *left_out[:1]])
        )
    if "envpool" in complete:
        complete = complete.assign(envpool=complete.envpool.eq(True))  # older runs do not have it
    for environment, group in complete.groupby("environment"):
        for argument in group.columns.difference([*AXES, *FREE_ARGS, *NOT_ARGUMENTS]):
            values = sorted(group[argument].dropna().astype(str).unique())
            if len(values) > 1:
                mix = " and ".join(
                    f"--{argument.replace('_', '-')} {value}" for value in values[:3]
                )
                advice = "give the folder of one experiment, or filter by --env, --beta, --n-envs"
                raise Unusable(
                    f"{environment} has runs with {mix}, which must not be averaged: {advice}"
                )
    chosen = chosen.astype({key: int for key in ("n_envs", "n_steps", "n_epochs", "seed")})
    return chosen.assign(
        beta=pd.to_numeric(chosen.beta, errors="coerce"), vanilla=chosen.beta == "vanilla"
    ), left_out


def main_grid(runs):
    """The runs with the study's n_steps 2048 and n_epochs 10, or, where there are none, with the most frequent ones."""
    settings = pd.Series(list(zip(runs.n_steps, runs.n_epochs, strict=True)), index=runs.index)
    setting = (2048, 10) if (2048, 10) in set(settings) else settings.mode()[0]
    return runs[settings == setting]


def missing(runs):
    """Lines for the runs that are not there of the grid they span: every environment x n_envs x beta x seed found."""
    axes = ["environment", "n_envs", "beta", "seed"]
    runs = runs.assign(beta=runs.beta.map(beta_text))[axes]
    grid = pd.MultiIndex.from_product([sorted(runs[axis].unique()) for axis in axes], names=axes)
    lacking = grid.difference(pd.MultiIndex.from_frame(runs)).to_frame(index=False)
    seeds = (
        lacking.groupby(axes[:3]).seed.agg(lambda seeds: " ".join(map(str, seeds))).reset_index()
    )
    betas = seeds.groupby(["environment", "n_envs", "seed"]).beta.agg(" ".join)
    return [
        f"{env}, n_envs {n_envs}: beta {beta}, seeds {seeds}"
        for (env, n_envs, seeds), beta in betas.items()
    ]


def published(name):
    """One of the paper's tables, results/published/NAME.csv."""
    return pd.read_csv(Path(__file__).parent / "results" / "published" / f"{name}.csv")


# --- Statistics -------------------------------------------------------------------------------------------------------


def standardize(runs):
    """Performance of the runs, standardized over all of them in the same environment: a Series like runs.

    Sec. "Evaluation Details": "results are grouped by environment and standardized to zero mean and unit variance to
    control for the impact of the environments. We combine these standardized results by averaging across different
    environments and seeds." In an environment without variance all are 0.
    """

    def z(x):
        return (x - x.mean()) / x.std(ddof=0) if np.ptp(x) > 0 else 0 * x

    return runs.groupby("environment").performance.transform(z)


def mean_interval(values, n_resamples=9999):
    """Mean over the first axis and its 95 % BCa bootstrap interval, as in all the paper's figures: mean, low, high.

    values: (runs,) or (runs, steps). One run has no interval (NaN); of equal values the interval is that value.
    """
    values = np.asarray(values, float)
    mean = values.mean(axis=0)
    low, high = np.array(mean), np.array(mean)
    varies = np.ptp(values, axis=0) > 0  # BCa is not defined for equal values
    if len(values) < 2:
        low, high = low * np.nan, high * np.nan
    elif varies.any():
        how = {
            "n_resamples": n_resamples,
            "batch": 1000,
            "method": "BCa",
            "rng": np.random.default_rng(0),
        }
        low[varies], high[varies] = stats.bootstrap(
            [values.T[varies]], np.mean, axis=-1, **how
        ).confidence_interval
    return mean, low, high


def mean_intervals(runs, column, by):
    """`mean_interval` of a column of runs in each of their groups: a DataFrame of mean, low, high, number of runs."""
    groups = runs.groupby(by)[column]
    rows = [[*mean_interval(values), len(values)] for _, values in groups]
    return pd.DataFrame(rows, index=groups.mean().index, columns=["mean", "low", "high", "runs"])


def welch(a, b):
    """p-value of Welch's t-test (Table 1): NaN with fewer than two runs on a side, 1 where all values are the same."""
    if min(len(a), len(b)) < 2:
        return np.nan
    if np.ptp([*a, *b]) == 0:
        return 1.0
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # scipy's, about values that are nearly the same
        return stats.ttest_ind(a, b, equal_var=False).pvalue


def best_beta_per_env(runs):
    """Table 1: the beta of highest mean performance over all n_envs and seeds, by Welch's t-test against 0.5, 0 and 1.

    A fixed beta is "outperformed" where p < 0.05, else "comparable"; blank where it has fewer than two runs.
    """
    rows = []
    for environment, group in runs.groupby("environment"):
        performance = {
            beta: values.to_numpy() for beta, values in group.groupby("beta").performance
        }
        best = max(performance, key=lambda beta: performance[beta].mean())
        row = {"environment": environment, "best_beta": best}
        for beta in (0.5, 0.0, 1.0):
            p = welch(performance[best], performance.get(beta, [])) if beta != best else np.nan
            row[f"beta_{beta}"] = (
                "outperformed" if p < 0.05 else "comparable" if p >= 0.05 or beta == best else ""
            )
            row[f"p_{beta}"] = p
        rows.append(row)
    paper = (
        published("best_beta_per_env")
        .set_index("environment")
        .replace({"yes": "comparable", "no": "outperformed"})
    )
    paper = paper.rename(columns=lambda name: "paper_" + name.removesuffix("_comparable"))
    table = pd.DataFrame(rows).join(paper, on="environment")
    counts = {"environment": "comparable in"}
    for column in table.filter(regex="beta_[01]"):
        verdicts = table[column][table[column].isin(["comparable", "outperformed"])]
        counts[column] = f"{(verdicts == 'comparable').sum()}/{len(verdicts)}"
    return pd.concat([table, pd.DataFrame([counts])], ignore_index=True)


def best_beta_per_n_envs(runs):
    """Sec. A2: the beta of highest standardized performance for each n_envs, averaged over environments and seeds."""
    table = mean_intervals(runs.assign(z=standardize(runs)), "z", ["n_envs", "beta"])
    best = table.loc[table.groupby("n_envs")["mean"].idxmax()].reset_index()
    best = best.rename(columns={"beta": "best_beta", "mean": "standardized_performance"})
    return best.join(
        published("best_beta_per_n_envs").set_index("n_envs").add_prefix("paper_"), on="n_envs"
    )


def projected_ranks(best, betas, n_envs, seq_len=1000):
    """Ranks of the betas for each n_envs as projected from the bias of the noise, 1 the best.

    Sec. "Why Do Larger beta Work Better for Larger n_envs": the mean of a sequence has the standard deviation
    sigma(beta), that of N pooled sequences sigma_hat = sigma(beta) / sqrt(N). Its optimum sigma* is the average for
    the best beta of each n_envs; E_ij = (sigma* - sigma_hat(beta_i, N_j))^2 is ranked within each N_j.

    best: Series of the best beta, its index n_envs. Returns a DataFrame, a row per beta and a column per n_envs.
    """

    def sigma_hat(beta, n):
        return mean_std(np.array(beta, float), seq_len).numpy() / np.sqrt(n)

    sigma_star = sigma_hat(best, best.index.to_numpy()).mean()
    E = (sigma_star - sigma_hat(np.array(betas)[:, None], np.array(n_envs))) ** 2  # (betas, n_envs)
    return pd.DataFrame(E, index=betas, columns=n_envs).rank()


def final_return_and_performance(runs):
    """Sec. A9: mean and maximum over all betas, n_envs and seeds, without vanilla PPO."""
    table = runs.groupby("environment")[["final_return", "performance"]].agg(["mean", "max"])
    table.columns = ["_".join(column) for column in table.columns]
    paper = published("final_return_and_performance").set_index("environment").add_prefix("paper_")
    return table.join(paper).reset_index()


def final_returns(runs):
    """Sec. A14: final return per environment, n_envs and beta, ours beside the published mean.

    `in_interval`: whether our interval holds the published mean, which is rounded to one decimal.
    """
    cell = [*CELL, "beta"]
    table = mean_intervals(runs.assign(beta=runs.beta.map(beta_text)), "final_return", cell)
    table = table.join(
        published("final_return_per_beta").set_index(cell).final_return_mean.rename("paper")
    )
    known = table.dropna(subset=["low", "paper"])
    holds = known.paper.between(known.low - 0.05, known.high + 0.05)
    return table.assign(in_interval=holds.map({True: "yes", False: "no"})).reset_index()


def final_return_per_beta(table):
    """The table of `final_returns` for readers, a row per environment and n_envs, rounded like the published one.

    Columns of each beta: "mean [low, high]" and the published mean, "(outside)" where our interval does not hold it.
    """
    rows = []
    for key, cells in table.groupby(CELL):
        row = dict(zip(CELL, key, strict=True)) | {"runs": cells.runs.sum()}
        for cell in cells.to_dict("records"):
            interval = "" if pd.isna(cell["low"]) else " [{low:z.1f}, {high:z.1f}]".format(**cell)
            outside = " (outside)" if cell["in_interval"] == "no" else ""
            row[f"beta {cell['beta']}"] = f"{cell['mean']:z.1f}{interval}"
            row[f"paper, {cell['beta']}"] = (
                "" if pd.isna(cell["paper"]) else f"{cell['paper']:z.1f}{outside}"
            )
        rows.append(row)
    betas = sorted(table.beta.unique())
    return pd.DataFrame(
        rows,
        columns=[*CELL, "runs", *(f"{of} {beta}" for beta in betas for of in ("beta", "paper,"))],
    )


def robust_statistics(runs):
    """Beyond the paper, because seeds are few (Agarwal et al. 2021): per beta, with 95 % bootstrap intervals,

    - `iqm`: interquartile mean of the standardized performance, its mean without the lowest and the highest quarter;
    - `improvement`: probability that a run does better than one with beta 0, averaged over environments and n_envs.

    The bootstrap is stratified: runs are drawn within each environment and n_envs, where there are two or more in all.
    """

    def iqm(*cells, axis=-1):
        return stats.trim_mean(np.concatenate(cells, axis=-1), 0.25, axis=-1)

    def improvement(*cells, axis=-1):  # Mann-Whitney's statistic: a tie is half an improvement
        pairs = zip(cells[: len(cells) // 2], cells[len(cells) // 2 :], strict=True)
        signs = [np.sign(x[..., :, None] - y[..., None, :]).mean((-2, -1)) for x, y in pairs]
        return 0.5 + 0.5 * np.mean(signs, axis=0)

    cells = {
        key: z.to_numpy() for key, z in runs.assign(z=standardize(runs)).groupby(["beta", *CELL]).z
    }
    rows = []
    for beta in sorted(runs.beta.unique()):
        ours = {key[1:]: z for key, z in cells.items() if key[0] == beta}
        both = [key for key in ours if beta != 0 and (0, *key) in cells]
        pairs = [ours[key] for key in both] + [cells[0, *key] for key in both]
        row = {"beta": beta, "runs": sum(map(len, ours.values()))}
        for statistic, samples in ((iqm, list(ours.values())), (improvement, pairs)):
            name, low, high = statistic.__name__, np.nan, np.nan
            if samples and min(map(len, samples)) > 1:
                how = {
                    "n_resamples": 2000,
                    "batch": 200,
                    "method": "percentile",
                    "rng": np.random.default_rng(0),
                }
                low, high = stats.bootstrap(
                    samples, statistic, vectorized=True, **how
                ).confidence_interval
            mean = statistic(*samples) if samples else np.nan
            row |= {name: mean, f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)


# --- Drawing ----------------------------------------------------------------------------------------------------------

plt.rc("figure.constrained_layout", use=True)
plt.rc("font", size=9)
plt.rc("axes", titlesize=9, grid=True, axisbelow=True)
plt.rc("axes.spines", top=False, right=False)
plt.rc("grid", color="0.92")
plt.rc("legend", fontsize=8, frameon=False)
plt.rc("lines", linewidth=1.3, markersize=5)
INK = "0.25"  # what is not about one beta
BETA = r"noise color $\beta$"
STANDARDIZED = "standardized performance\n(mean, 95 % BCa interval)"


def look(beta):
    """Color and marker of a beta in all figures: a sequential, color-blind-safe map, nowhere too pale for print."""
    place = np.interp(beta, STUDY_BETAS, range(len(STUDY_BETAS)))
    return {
        "color": plt.get_cmap("plasma")(0.82 * place / (len(STUDY_BETAS) - 1)),
        "marker": "v^osDPX*"[round(place)],
    }


def color(beta):
    return look(beta)["color"]


def beta_text(beta):
    return "vanilla" if np.isnan(beta) else f"{beta:g}"


def extent(runs):
    """What a figure is made of, for its title."""
    n_envs, count = ", ".join(map(str, sorted(runs.n_envs.unique()))), runs.environment.nunique()
    return f"{count} environment{'s'[: count > 1]}, n_envs {n_envs}, {len(runs)} runs"


def need(condition, what):
    if not condition:
        raise Unusable(f"needs {what}")


def panels(count, xlabel="", ylabel="", width=2.5, height=1.9):
    """A figure with `count` axes in even rows of at most four, labelled at its left and below: figure, list of axes."""
    rows = math.ceil(count / 4)
    columns = math.ceil(count / rows)
    fig, axes = plt.subplots(
        rows, columns, figsize=(max(width * columns, 5), height * rows + 0.5), squeeze=False
    )
    for ax in axes.flat[count:]:
        ax.remove()
    axes = list(axes.flat[:count])
    for ax in axes[::columns]:
        ax.set_ylabel(ylabel)
    for ax in axes[-columns:]:
        ax.set_xlabel(xlabel)
    return fig, axes


def legend_above(fig, *entries, betas=()):
    """A legend over the panels: a marker per beta, then entries (label, style)."""
    handles = [Line2D([], [], **look(b), ls="", label=rf"$\beta = {b:g}$") for b in betas]
    handles += [Line2D([], [], **{"color": INK, **style}, label=label) for label, style in entries]
    rows = -(-len(handles) // int(fig.get_figwidth() / 1.1))
    fig.legend(handles=handles, loc="outside upper center", ncols=-(-len(handles) // rows))


def log2_ticks(ax, values):
    values = sorted(set(values))
    ax.set_xscale("log", base=2)
    ax.set_xticks(values, [f"{value:g}" for value in values])
    ax.xaxis.set_minor_locator(NullLocator())


def draw_intervals(ax, x, table, **style):
    """Means at x with their intervals as bars; table has the columns mean, low, high."""
    (line,) = ax.plot(x, table["mean"], **{"marker": "o", **style})
    ax.vlines(x, table.low, table.high, color=line.get_color(), lw=1.1)


def draw_betas(ax, table, shift=0, **style):
    """Means with intervals over beta, the index of table, each in its color."""
    ax.plot(table.index + shift, table["mean"], **{"color": "0.7", "zorder": 1, **style})
    for beta in table.index:
        draw_intervals(ax, [beta + shift], table.loc[[beta]], **look(beta))
    names = {-1: "\nblue", 0: "\nwhite", 1: "\npink", 2: "\nred"}
    ax.set_xticks(table.index, [f"{beta:g}{names.get(beta, '')}" for beta in table.index])


def draw_grid(ax, sizes, title):
    """Markers at n_envs and beta with an area proportional to sizes in [0, 1]; the largest of each n_envs is ringed."""
    for column, n_envs in enumerate(sizes):
        for row, (beta, size) in enumerate(sizes[n_envs].dropna().items()):
            edge = "black" if size == sizes[n_envs].max() else "none"
            ax.scatter(
                column, row, s=8 + 200 * size, color=color(beta), edgecolor=edge, linewidth=1.4
            )
    ax.set_xticks(range(sizes.shape[1]), sizes.columns)
    ax.set_yticks(range(len(sizes)), [f"{beta:g}" for beta in sizes.index])
    ax.set(title=title, xlim=(-0.6, sizes.shape[1] - 0.4), ylim=(-0.6, len(sizes) - 0.4))


# --- Figures of the noise ---------------------------------------------------------------------------------------------


def draw_noise(beta, *size):
    """Sequences of 1000 steps, the paper's length, from the same random numbers for each beta: (*size, 1000)."""
    return colored_noise(beta, (*size, 1000), generator=torch.Generator().manual_seed(0))


def random_walks(betas):
    """Fig. 1: two-dimensional random walks."""
    fig, axes = plt.subplots(2, len(betas), figsize=(1.45 * len(betas) + 0.5, 3.7), squeeze=False)
    walks = [draw_noise(beta, 4, 2).cumsum(-1).numpy() for beta in betas]  # each (walks, xy, steps)
    for beta, column, walk in zip(betas, axes.T, walks, strict=True):
        for ax, shown in zip(column, (walks, walk), strict=True):
            limit = 1.05 * np.abs(shown).max()
            for (x, y), alpha in zip(walk, (1, 0.75, 0.55, 0.4), strict=True):
                ax.plot(x, y, color=color(beta), lw=0.6, alpha=alpha)
            ax.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
            ax.locator_params(nbins=3)
            ax.tick_params(labelsize=7)
        column[0].set_title(rf"$\beta = {beta:g}$")
        column[1].set_xlabel(r"$\sum_t \varepsilon_t^x$")
    for ax, scale in zip(axes[:, 0], ("same scale", "own scale"), strict=True):
        ax.set_ylabel(f"{scale}\n" + r"$\sum_t \varepsilon_t^y$")
    return fig


def power_spectral_density(betas):
    """Sec. "Colored Noise": the expected PSD, measured over 1000 sequences and in closed form."""
    ylabel = r"expected PSD, $\mathrm{E}\,|\mathcal{F}(\varepsilon)|^2$"
    fig, [ax] = panels(1, "frequency f (cycles per step)", ylabel, height=3.4)
    f = np.fft.rfftfreq(1000)[1:]
    for beta in betas:
        psd = torch.fft.rfft(draw_noise(beta, 1000).double()).abs().square().mean(0)[1:]
        ax.loglog(f, psd, color=color(beta), lw=3, alpha=0.4)
        ax.loglog(f, expected_psd(beta, 1000)[1:], color=color(beta), lw=1)
        ax.plot(f[0], psd[0], **look(beta))
    entries = [("measured", {"lw": 3, "alpha": 0.4}), (r"closed form, $f^{-\beta}$", {"lw": 1})]
    legend_above(fig, *entries, betas=betas)
    return fig


def two_step_scatter(betas):
    """Sec. A1: subsequent values are correlated where beta > 0; their correlation measured and in closed form."""
    fig, axes = panels(
        len(betas), r"$\varepsilon_t$", r"$\varepsilon_{t+1}$", width=2.2, height=2.2
    )
    for ax, beta in zip(axes, betas, strict=True):
        noise, lags = draw_noise(beta, 2000).numpy(), autocovariance(beta, 1000)
        correlation = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
        ax.scatter(noise[:, 500], noise[:, 501], s=3, color=color(beta), alpha=0.5, lw=0)
        closed_form = float(lags[1] / lags[0])
        ax.set_title(
            f"$\\beta = {beta:g}$, correlation {correlation:z.2f}\n(closed form {closed_form:z.2f})"
        )
        ax.set(xlim=(-4.5, 4.5), ylim=(-4.5, 4.5), aspect="equal", xticks=[-4, -2, 0, 2, 4])
    return fig


def marginal_distribution(betas):
    """Sec. A1: each step's distribution is Gaussian, its variance near 1 for all beta."""
    fig, axes = panels(len(betas), r"$\varepsilon_t$", "density")
    x = np.linspace(-4.5, 4.5, 91)
    for ax, beta in zip(axes, betas, strict=True):
        noise, variance = draw_noise(beta, 5000), float(marginal_variance(beta, 1000))
        ax.hist(
            noise[:, ::50].flatten().numpy(), bins=x, density=True, color=color(beta), alpha=0.6
        )
        ax.plot(x, stats.norm.pdf(x, scale=variance**0.5), color="black", lw=0.9)
        ax.set_title(rf"$\beta = {beta:g}$, variance {noise.var():.2f} ({variance:.2f})")
        ax.set(ylim=(0, 0.45), xticks=[-4, -2, 0, 2, 4])
    legend_above(
        fig, ("normal distribution of the (closed-form) variance", {"color": "black", "lw": 0.9})
    )
    return fig


def bias(betas):
    """Sec. "Why Do Larger beta Work Better": the mean of a sequence, its standard deviation against the closed form."""
    fig, (left, right) = panels(2, BETA, width=3.6, height=2.7)
    for position, beta in enumerate(betas):
        means = draw_noise(beta, 5000).double().mean(1).numpy()
        for violin in left.violinplot(means, [position], widths=0.85, showextrema=False)["bodies"]:
            violin.set(facecolor=color(beta), alpha=0.8)
        right.plot(beta, means.std(), **look(beta), ls="", zorder=3)
    curve = np.linspace(min(betas) - 0.1, max(betas) + 0.1, 200)
    right.plot(curve, mean_std(curve, 1000), color=INK, lw=1)
    left.set_xticks(range(len(betas)), [f"{beta:g}" for beta in betas])
    left.set_ylabel("mean of a sequence of 1000 steps")
    right.set_ylabel("standard deviation of the mean")
    legend_above(fig, ("measured", {"marker": "o", "ls": ""}), ("closed form", {"lw": 1}))
    return fig


# --- Figures of the results -------------------------------------------------------------------------------------------


def compare(runs, x, by=None):
    """Performance over x, "beta", "n_envs" or "update_size", with a line per value of the column `by`.

    Standardized within each environment, then averaged over all else: environments, seeds, n_envs (Sec. "Does
    Colored-Noise Affect the Performance") or betas ("How Does the Number of Parallel Collection Environments").
    """
    need(len(runs) and (by or runs[x].nunique() > 1), f"at least two values of {x}")
    runs = runs.assign(z=standardize(runs))
    xlabel = {"beta": BETA, "update_size": "update size n_envs \u00b7 n_steps"}.get(x, x)
    fig, [ax] = panels(1, xlabel, STANDARDIZED, height=3)
    lines = []
    for i, (value, group) in enumerate(runs.groupby(by) if by else [("", runs)]):
        style = {
            "color": ["0.1", "0.65", "0.4", "0.75"][i % 4] if by else INK,
            "ls": ["-", "--", ":", "-."][i % 4],
            "lw": 1,
        }
        table = mean_intervals(group, "z", x)
        if x == "beta":
            draw_betas(ax, table, shift=0.006 * i, **style)
        else:
            style["marker"] = "os^D"[i % 4]
            draw_intervals(ax, table.index * 2 ** (0.08 * i), table, **style)
            log2_ticks(ax, runs[x])
        lines.append((value if isinstance(value, str) else f"{by} = {value}", style))
    ax.set_title(extent(runs))
    if by:
        legend_above(fig, *lines)
    return fig


def beta0_vs_vanilla(runs):
    """Sec. A6: beta 0 matches vanilla PPO, where there are both. runs: with any beta, and vanilla."""
    runs = runs[(runs.beta == 0) | runs.vanilla]
    runs = runs[runs.groupby(CELL).vanilla.transform("nunique") == 2]
    need(len(runs), "runs with --beta 0 and runs with --vanilla")
    return compare(
        runs.assign(algorithm=np.where(runs.vanilla, "vanilla PPO", r"$\beta = 0$")),
        "n_envs",
        "algorithm",
    )


def n_envs_vs_n_steps(runs):
    """Sec. A11: at beta 0.5, what matters is the update size n_envs * n_steps. runs: with any n_steps."""
    runs = runs[runs.beta == 0.5]
    need(runs.n_steps.nunique() > 1, "runs with --beta 0.5 and at least two values of --n-steps")
    return compare(runs.assign(update_size=runs.n_envs * runs.n_steps), "update_size", "n_steps")


def n_epochs_vs_beta(runs):
    """Sec. A12: the preferred beta for each n_epochs, where there are all. runs: with any n_epochs."""
    need(runs.n_epochs.nunique() > 1, "at least two values of --n-epochs")
    there = runs.groupby([*CELL, "beta"]).n_epochs.transform("nunique")
    return compare(runs[there == there.max()], "beta", "n_epochs")


def n_envs_beta_grids(runs):
    """Sec. "How Does the Number [...] and Noise Color Interact": marker size = performance to the sixth power, = rank.

    Beside them the ranks that are projected from the bias of the noise, by our and by the paper's best betas.
    """
    need(runs.beta.nunique() > 1, "at least two betas")
    grid = runs.assign(z=standardize(runs)).pivot_table(index="beta", columns="n_envs", values="z")
    paper = published("best_beta_per_n_envs").set_index("n_envs").best_beta
    axes_of_grid = (grid.index, grid.columns, int(runs.noise_seq_len.iloc[0]))
    ranks = {
        "rank of performance within n_envs": grid.rank(ascending=False),
        "rank projected from the bias,\nby our best $\\beta$": projected_ranks(
            grid.idxmax(), *axes_of_grid
        ),
        "rank projected from the bias,\nby the paper's best $\\beta$": projected_ranks(
            paper, *axes_of_grid
        ),
    }
    fig, axes = panels(4, "n_envs", BETA, width=2.9, height=3.1)
    low, high = np.nanmin(grid), np.nanmax(grid)
    draw_grid(axes[0], ((grid - low) / (high - low or 1)) ** 6, "performance, to the sixth power")
    for ax, (title, rank) in zip(axes[1:], ranks.items(), strict=True):
        draw_grid(ax, 1 - (rank - 1) / (len(rank) - 1), title)
    fig.suptitle(f"{extent(runs)}; larger is better, ring: best of each n_envs", fontsize=9)
    return fig


def learning_curves(runs, curves, by):
    """Sec. A10: mean return over training, its interval as a band, a panel per value of `by`, a line per beta.

    Open markers at the right end are the published final returns.
    """
    paper = published("final_return_per_beta").set_index([*CELL, "beta"]).final_return_mean
    fig, axes = panels(runs[by].nunique(), "environment steps", "mean return")
    for ax, (_, group) in zip(axes, runs.groupby(by), strict=True):
        environment, n_envs = group[CELL].iloc[0]
        lines = curves.loc[group.index].dropna(axis=1, how="all")
        end = lines.columns[-1]
        ax.axvline(end, color="0.8", lw=0.8)
        for beta, seeds in group.groupby("beta"):
            line = lines.loc[seeds.index].dropna(axis=1)
            mean, low, high = mean_interval(line, n_resamples=1000)
            ax.plot(line.columns, mean, color=color(beta))
            ax.fill_between(line.columns, low, high, color=color(beta), alpha=0.2, lw=0)
            final = paper.get((environment, n_envs, beta_text(beta)), np.nan)
            ax.plot(1.05 * end, final, mfc="none", **look(beta))
        ax.set_title(f"{environment}, n_envs {n_envs}")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    band, paper = (
        ("95 % BCa interval", {"lw": 6, "alpha": 0.3}),
        ("paper", {"marker": "o", "ls": "", "mfc": "none"}),
    )
    legend_above(fig, band, paper, betas=sorted(runs.beta.unique()))
    return fig


def complex_tasks(runs):
    """Sec. A8: performance per beta in each complex task."""
    runs = runs[runs.env_id.isin(COMPLEX)]
    need(len(runs), f"runs of {', '.join(COMPLEX)}")
    fig, axes = panels(runs.environment.nunique(), BETA, "performance\n(mean, 95 % BCa interval)")
    for ax, (environment, group) in zip(axes, runs.groupby("environment"), strict=True):
        draw_betas(ax, mean_intervals(group, "performance", "beta"))
        ax.set(title=environment, xticks=[-1, 0, 1, 2], xticklabels=["-1", "0", "1", "2"])
    fig.suptitle(extent(runs), fontsize=9)
    return fig


def final_return_vs_n_envs(table):
    """Final return against n_envs per beta, ours (filled) over the published (open). table: of `final_returns`."""
    table = table[table.beta != "vanilla"].astype({"beta": float})
    betas = sorted(table.beta.unique())
    fig, axes = panels(table.environment.nunique(), "n_envs", "final return")
    for ax, (environment, group) in zip(axes, table.groupby("environment"), strict=True):
        for beta, cells in group.groupby("beta"):
            x = cells.n_envs * 2 ** (
                0.5 * (betas.index(beta) + 0.5) / len(betas) - 0.25
            )  # side by side
            ax.plot(
                x,
                cells.paper,
                color=color(beta),
                ls=":",
                lw=0.9,
                ms=7,
                mfc="none",
                marker=look(beta)["marker"],
            )
            draw_intervals(ax, x, cells, **look(beta), ms=4)
        log2_ticks(ax, table.n_envs)
        ax.set(title=environment, xlim=(table.n_envs.min() / 1.5, table.n_envs.max() * 1.5))
    paper = ("paper", {"ls": ":", "lw": 0.9, "marker": "o", "ms": 7, "mfc": "none"})
    legend_above(fig, ("ours, 95 % BCa interval", {"marker": "o", "ms": 4}), paper, betas=betas)
    return fig


def robust_performance(table):
    """Beyond the paper: interquartile mean and probability of improvement. table: of `robust_statistics`."""
    need(table.improvement.notna().any(), "beta 0 and another beta in one environment and n_envs")
    fig, axes = panels(2, BETA, width=4.2, height=2.8)
    for ax, name in zip(axes, ("iqm", "improvement"), strict=True):
        columns = {name: "mean", f"{name}_low": "low", f"{name}_high": "high"}
        draw_betas(ax, table.set_index("beta").rename(columns=columns).dropna(subset="mean"))
    axes[0].set_ylabel("standardized performance\n(interquartile mean)")
    axes[1].set_ylabel("probability of doing\nbetter than $\\beta = 0$")
    axes[1].axhline(0.5, color=INK, ls="--", lw=0.9)
    fig.suptitle(f"95 % stratified bootstrap intervals, {table.runs.sum()} runs", fontsize=9)
    return fig


# --- Output -----------------------------------------------------------------------------------------------------------


def save_table(table, out, name):
    """Writes NAME.csv in full precision, NAME.md and NAME.tex rounded for readers, to the folder `out`."""

    def text(column, value):
        if isinstance(value, str) or pd.isna(value):
            return value if isinstance(value, str) else ""
        if column.startswith("p_") and value < 0.01:
            return "<0.01"
        return (
            f"{value:g}" if column.endswith("beta") or isinstance(value, int) else f"{value:z.2f}"
        )

    shown = pd.DataFrame(
        {column: [text(column, value) for value in table[column].tolist()] for column in table}
    )
    rows = [shown.columns, ["---"] * shown.shape[1], *shown.to_numpy()]
    table.to_csv(out / f"{name}.csv", index=False)
    (out / f"{name}.md").write_text("".join(f"| {' | '.join(row)} |\n" for row in rows))
    (out / f"{name}.tex").write_text(
        shown.to_latex(index=False, escape=True, longtable=True).replace("<", "$<$")
    )


def make_all(todo, out):
    """Makes and writes figures (PNG, PDF) and tables (CSV, Markdown, LaTeX).

    todo: {name: (function, data, other arguments ...)}, where data may be the name of a table made before.
    Returns the names of the tables and figures made, and a line for each that could not be made.
    """
    made, not_made = {}, []
    for name, (make, data, *rest) in tqdm(todo.items(), desc="tables and figures", unit=""):
        data = made.get(data, ()) if isinstance(data, str) else data
        try:
            need(len(data), "runs with colored noise on tasks of the study")
            made[name] = make(data, *rest)
        except Unusable as error:
            not_made.append(f"{name}: {error}")
            continue
        if isinstance(made[name], pd.DataFrame):
            save_table(made[name], out, name)
        else:
            made[name].savefig(out / f"{name}.png", dpi=200)
            made[name].savefig(out / f"{name}.pdf")
            plt.close(made[name])
    return list(made), not_made


def noise(betas):
    """What `make_all` is to make of the noise."""
    return {
        "noise_random_walks": (random_walks, betas),
        "noise_psd": (power_spectral_density, betas),
        "noise_two_step": (
            two_step_scatter,
            [beta for beta in betas if beta in (0, 0.5, 1)] or betas,
        ),
        "noise_marginal": (marginal_distribution, betas),
        "noise_bias": (bias, betas),
    }


def results(runs, curves):
    """What `make_all` is to make of runs, from `select`, and their curves."""
    grid = main_grid(runs)
    colored = grid[~grid.vanilla]
    study = colored[~colored.env_id.isin(COMPLEX)]  # what the paper averages over
    beyond = runs[~runs.env_id.isin(COMPLEX) & ~runs.vanilla]
    todo = {
        "best_beta_per_env": (best_beta_per_env, study),
        "best_beta_per_n_envs": (best_beta_per_n_envs, study),
        "final_return_and_performance": (final_return_and_performance, colored),
        "final_returns": (final_returns, grid),
        "final_return_per_beta": (final_return_per_beta, "final_returns"),
        "robust_statistics": (robust_statistics, study),
        "performance_vs_beta": (compare, study, "beta"),
        "performance_vs_n_envs": (compare, study, "n_envs"),
        "n_envs_beta_grids": (n_envs_beta_grids, study),
        "beta0_vs_vanilla": (beta0_vs_vanilla, grid[~grid.env_id.isin(COMPLEX)]),
        "n_envs_vs_n_steps": (n_envs_vs_n_steps, beyond[beyond.n_epochs == grid.n_epochs.iloc[0]]),
        "n_epochs_vs_beta": (n_epochs_vs_beta, beyond[beyond.n_steps == grid.n_steps.iloc[0]]),
        "complex_tasks": (complex_tasks, colored),
        "final_return_vs_n_envs": (final_return_vs_n_envs, "final_returns"),
        "robust_performance": (robust_performance, "robust_statistics"),
    }
    for n_envs, group in colored.groupby("n_envs"):
        todo[f"learning_curves_n_envs_{n_envs}"] = (learning_curves, group, curves, "environment")
    for environment, group in colored.groupby("environment"):
        if group.n_envs.nunique() > 1:
            name = "".join(
                c for c in environment.lower().replace(" ", "_") if c.isalnum() or c == "_"
            )
            todo[f"learning_curves_{name}"] = (learning_curves, group, curves, "n_envs")
    return todo


def parse_args():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    noise = commands.add_parser("noise", help="figures of the noise")
    results = commands.add_parser("results", help="figures and tables of runs")
    packing = commands.add_parser("pack", help="all runs of a folder in one small CSV")

    for each in (parser, noise, results, packing):
        each.error = lambda message: fail(f"{message} (--help lists the arguments)", code=2)

    def number(text):
        if not np.isfinite(float(text)):
            raise argparse.ArgumentTypeError(f"{text} is not finite")
        return float(text)

    def beta(text):
        return text if text == "vanilla" else beta_text(number(text))

    for command in (results, packing):
        command.add_argument("paths", nargs="+", help="folders of runs, or files that `pack` wrote")
        command.add_argument(
            "--env", nargs="+", metavar="ENV", help="only these: ids, or names as in the paper"
        )
        command.add_argument(
            "--beta",
            nargs="+",
            type=beta,
            metavar="BETA",
            help="only these; vanilla for vanilla PPO",
        )
        command.add_argument("--n-envs", nargs="+", type=int, metavar="N", help="only these")
    packing.add_argument("file", help="CSV to write, or .csv.gz")
    noise.add_argument(
        "--beta", nargs="+", type=number, default=STUDY_BETAS, help="default: those of the study"
    )
    for command in (noise, results):
        command.add_argument(
            "--out", type=Path, default=Path("figures"), help="folder for figures and tables"
        )
    return parser.parse_args()


def main():
    args = parse_args()
    report = {}
    if args.command == "noise":
        todo = noise(sorted(set(args.beta)))
    else:
        runs, curves = load(args.paths, args.env, args.beta, args.n_envs)
        if args.command == "pack":
            pack(runs, curves, args.file)
            print(f"{args.file}: {len(runs)} runs, {Path(args.file).stat().st_size / 1e6:.2f} MB")
            return
        runs, report["left out"] = select(runs)
        grids = main_grid(runs).groupby(runs.env_id.isin(COMPLEX))
        lines = [line for _, grid in grids for line in missing(grid)]
        report["missing from the grid of these runs (averages are of what is there)"] = lines
        todo = results(runs, curves)
    args.out.mkdir(parents=True, exist_ok=True)
    made, report["not made"] = make_all(todo, args.out)
    print(f"{args.out}: {', '.join(made)}")
    with open(args.out / "report.txt", "w") as file:
        for title, lines in report.items():
            file.write("\n  ".join([f"{title}: {len(lines)}", *lines]) + "\n")
            more = [f"... and {len(lines) - 10} more, see {file.name}"] if len(lines) > 10 else []
            print("\n  ".join([f"{title}: {len(lines)}", *lines[:10], *more]))


if __name__ == "__main__":
    try:
        main()
    except (Unusable, OSError) as error:
        fail(error)
