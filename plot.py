"""Every figure of the study. Its tables (study/tables.py) show the published numbers beside ours.

    python plot.py noise           what the noise looks like: nothing needs to be trained
    python plot.py results runs/   figures and tables of all complete runs, in folders or packed
    python plot.py environments    a frame of each of the paper's environments
    python plot.py animation       policies that have learned nothing, in Mountain Car: only the
                                   color of their noise differs

Sections named below are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI 2024,
with its appendix.
"""

import math
import re
import textwrap
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter
from scipy import stats
from tqdm import tqdm

import colored_noise
import ppo_colored_continuous as ppo
import study.runs
from study import claims, tables
from study.environments import prepare_rendering
from study.protocol import BETAS, COMPLEX, METHODS, NAMES, SETTINGS
from study.runs import CELL, Unusable, comparable, differences, need, published, same_protocol
from study.statistics import FEW, cells_intervals, mean_interval, standardize

# --- Drawing --------------------------------------------------------------------------------------

plt.rc("figure", dpi=150, labelsize="medium")
plt.rc("figure.constrained_layout", use=True)
plt.rc("font", size=9)
plt.rc("axes", titlesize=9, grid=True, axisbelow=True)
plt.rc("axes.spines", top=False, right=False)
plt.rc("grid", color="0.92")
plt.rc("legend", fontsize=8, frameon=False)
plt.rc("lines", linewidth=1.3, markersize=5)
plt.rc("pdf", fonttype=42)  # TrueType: journals refuse Type 3 fonts
INK = "0.25"  # what is not about one beta
BETA = r"noise color $\beta$"
BETA_NAMED = f"{BETA} (-1 blue, 0 white, 1 pink, 2 red)"
LINES = [  # Okabe and Ito's colors, which color-blind readers can tell apart
    {"color": "#0072B2", "marker": "o"},
    {"color": "#D55E00", "marker": "s", "ls": "--"},
    {"color": "#000000", "marker": "^", "ls": ":"},
    {"color": "#009E73", "marker": "D", "ls": "-."},
]
VERDICT_LOOK = {
    "holds": {"color": "#009E73", "marker": "o"},
    "does not": {"color": "#D55E00", "marker": "X"},
    "open": {"color": "0.4", "marker": "o", "mfc": "white"},
}
GOAL = 0.45  # of Mountain Car
INTERVAL = "(mean, 95 % interval if two seeds)"


def look(beta):
    """Color and marker of a beta in all figures: the lighter, the larger beta is."""
    place = np.interp(beta, BETAS, range(len(BETAS)))
    marker = "v^osDPX*"[round(place)] if beta in BETAS else "<>dp8+x"[round(10 * beta) % 7]
    return {"color": plt.get_cmap("plasma")(0.82 * place / (len(BETAS) - 1)), "marker": marker}


def extent(runs):
    """What a figure is made of, for its title."""
    there = runs.groupby("environment").n_envs.agg(lambda n: ", ".join(map(str, sorted(set(n)))))
    counts = there.value_counts().sort_index()
    parts = [f"n_envs {n} in {count} environment{'s'[: count > 1]}" for n, count in counts.items()]
    return textwrap.fill("; ".join([*parts, f"{len(runs)} runs"]), 62)


def panels(count, xlabel="", ylabel="", width=2.5, height=1.9, sharey=False):
    """A figure with a list of `count` axes, at most four in a row; labels are of all together."""
    rows = math.ceil(count / 4)
    columns = math.ceil(count / rows)
    size = max(width * columns, 5), height * rows + 0.5
    fig, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, sharey=sharey)
    for ax in axes.flat[count:]:
        ax.remove()
    fig.supxlabel(xlabel)
    fig.supylabel(ylabel, multialignment="center")
    return fig, list(axes.flat[:count])


def legend_above(fig, *entries, betas=(), paper=False):
    """A legend over the panels: a marker per beta, then entries (label, style).

    paper: whether the open markers of all betas are in it, which stand for the published numbers.
    """
    keys = {rf"$\beta = {beta:g}$": [look(beta) | {"ls": ""}] for beta in betas}
    keys |= {"paper": [look(beta) | {"ls": "", "mfc": "none"} for beta in betas]} if paper else {}
    keys |= {label: [{"color": INK, **style}] for label, style in entries}
    handles = [tuple(Line2D([], [], **style) for style in styles) for styles in keys.values()]
    rows = math.ceil(len(handles) / int(fig.get_figwidth() / 1.1))
    how = {"ncols": math.ceil(len(handles) / rows), "handler_map": {tuple: HandlerTuple(None)}}
    fig.legend(handles, list(keys), loc="outside upper center", handlelength=3, **how)


def beta_ticks(ax, betas, most=8):
    """Ticks at the betas; at five of the study's, where the labels of more than `most` touch."""
    betas = betas if len(betas) <= most else [-1, 0, 0.5, 1, 2]
    ax.set_xticks(betas, [f"{beta:g}" for beta in betas])


def draw_intervals(ax, x, table, **style):
    """Means at x with their intervals as bars; table has the columns mean, low, high."""
    (line,) = ax.plot(x, table["mean"], **{"marker": "o", **style})
    ax.vlines(x, table.low, table.high, color=line.get_color(), lw=1.1)


def draw_betas(ax, table, most=8):
    """Means with intervals over beta, the index of table, each in its color, and `beta_ticks`."""
    ax.plot(table.index, table["mean"], color="0.7", zorder=1)
    for beta in table.index:
        draw_intervals(ax, [beta], table.loc[[beta]], **look(beta))
    beta_ticks(ax, table.index, most)


def draw_grid(ax, sizes, title):
    """Markers of the area `sizes`, in [0, 1], at n_envs and beta; a ring around the largest."""
    for column, n_envs in enumerate(sizes):
        for row, (beta, size) in enumerate(sizes[n_envs].items()):
            if not np.isnan(size):
                edge = "black" if size == sizes[n_envs].max() else "none"
                style = {"s": 8 + 200 * size, "color": look(beta)["color"], "edgecolor": edge}
                ax.scatter(column, row, linewidth=1.4, **style)
    ax.set_xticks(range(sizes.shape[1]), sizes.columns)
    ax.set_yticks(range(len(sizes)), [f"{beta:g}" for beta in sizes.index])
    ax.set(title=title, xlim=(-0.6, sizes.shape[1] - 0.4), ylim=(-0.6, len(sizes) - 0.4))


# --- Figures of the noise -------------------------------------------------------------------------


def draw_noise(beta, *size):
    """Sequences (*size, 1000), the paper's length, from the same random numbers for each beta."""
    generator = torch.Generator().manual_seed(0)
    return colored_noise.colored_noise(beta, (*size, 1000), generator=generator)


def random_walks(betas):
    """Fig. 1: two-dimensional random walks."""
    size = {"figsize": (1.45 * len(betas) + 0.5, 3.3), "dpi": 200}
    fig, axes = plt.subplots(2, len(betas), squeeze=False, **size)
    walks = [draw_noise(beta, 4, 2).cumsum(-1).numpy() for beta in betas]  # each (walks, xy, steps)
    for beta, column, walk in zip(betas, axes.T, walks, strict=True):
        for ax, shown in zip(column, (walks, walk), strict=True):
            limit = 1.05 * np.abs(shown).max()
            for (x, y), alpha in zip(walk, (1, 0.75, 0.55, 0.4), strict=True):
                ax.plot(x, y, color=look(beta)["color"], lw=0.6, alpha=alpha)
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
        ax.loglog(f, psd, color=look(beta)["color"], lw=3, alpha=0.4)
        ax.loglog(f, colored_noise.expected_psd(beta, 1000)[1:], color=look(beta)["color"], lw=1)
        ax.plot(f[0], psd[0], **look(beta))
    entries = [("measured", {"lw": 3, "alpha": 0.4}), (r"closed form, $f^{-\beta}$", {"lw": 1})]
    legend_above(fig, *entries, betas=betas)
    return fig


def two_step_scatter(betas):
    """Sec. A1: subsequent values are correlated where beta > 0, as measured and in closed form."""
    labels = r"$\varepsilon_t$", r"$\varepsilon_{t+1}$"
    fig, axes = panels(len(betas), *labels, width=2.2, height=2.2)
    for ax, beta in zip(axes, betas, strict=True):
        noise, lags = draw_noise(beta, 2000).numpy(), colored_noise.autocovariance(beta, 1000)
        correlation = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
        ax.scatter(noise[:, 500], noise[:, 501], s=3, color=look(beta)["color"], alpha=0.5, lw=0)
        measured = f"correlation {correlation:z.2f}"
        ax.set_title(f"$\\beta = {beta:g}$, {measured}\n(closed form {lags[1] / lags[0]:z.2f})")
        ax.set(xlim=(-4.5, 4.5), ylim=(-4.5, 4.5), aspect="equal", xticks=[-4, -2, 0, 2, 4])
    return fig


def marginal_distribution(betas):
    """Sec. A1: each step's distribution is Gaussian, its variance near 1 for all beta."""
    fig, axes = panels(len(betas), r"$\varepsilon_t$", "density")
    x, line = np.linspace(-4.5, 4.5, 91), {"color": "black", "lw": 0.9}
    for ax, beta in zip(axes, betas, strict=True):
        noise, variance = draw_noise(beta, 5000), colored_noise.marginal_variance(beta, 1000).item()
        sample = noise[:, ::50].flatten().numpy()
        ax.hist(sample, bins=x, density=True, color=look(beta)["color"], alpha=0.6)
        ax.plot(x, stats.norm.pdf(x, scale=variance**0.5), **line)
        ax.set_title(rf"$\beta = {beta:g}$, variance {noise.var():.2f} ({variance:.2f})")
        ax.set(ylim=(0, 0.45), xticks=[-4, -2, 0, 2, 4])
    legend_above(fig, ("normal distribution of the (closed-form) variance", line))
    return fig


def bias(betas):
    """Sec. "Why Do Larger beta Work Better": the mean of a sequence, its standard deviation."""
    fig, (left, right) = panels(2, BETA, width=3.6, height=2.7)
    for position, beta in enumerate(betas):
        means = draw_noise(beta, 5000).double().mean(1).numpy()
        for violin in left.violinplot(means, [position], widths=0.85, showextrema=False)["bodies"]:
            violin.set(facecolor=look(beta)["color"], alpha=0.8)
        right.plot(beta, means.std(), **look(beta), ls="", zorder=3)
    curve = np.linspace(min(betas) - 0.1, max(betas) + 0.1, 200)
    right.plot(curve, colored_noise.mean_std(curve, 1000), color=INK, lw=1)
    left.set_xticks(range(len(betas)), [f"{beta:g}" for beta in betas])
    left.set_ylabel("mean of a sequence of 1000 steps")
    right.set_ylabel("standard deviation of the mean")
    legend_above(fig, ("measured", {"marker": "o", "ls": ""}), ("closed form", {"lw": 1}))
    return fig


# --- Figures of the results -----------------------------------------------------------------------


def compare(runs, x, cells, by=None):
    """Performance over x: "beta", "n_envs" or "update_size". A line for each value of column `by`.

    Standardized within each environment, then averaged over seeds within `cells`, then over the
    cells that have all values of x and `by`. Cells are environments, and n_envs (Sec. "Does
    Colored-Noise Affect the Performance") or betas ("How Does the Number of Parallel Collection
    Environments").
    """
    need(runs[by or x].nunique() > 1, f"at least two values of {by or x}")
    chosen = comparable(runs, [x, by] if by else [x], cells)
    chosen = chosen.assign(z=standardize(chosen))
    xlabel = {"beta": BETA_NAMED, "update_size": "update size n_envs \u00b7 n_steps"}.get(x, x)
    fig, [ax] = panels(1, xlabel, f"standardized performance\n{INTERVAL}", height=3)
    lines = []
    for i, (value, group) in enumerate(chosen.groupby(by) if by else [("", chosen)]):
        style = LINES[i % 4] if by else {"color": INK}
        table = cells_intervals(group, "z", x, cells)
        if x == "beta" and not by:
            draw_betas(ax, table)
        else:  # lines stand beside each other, so that their intervals can be seen
            shifted = table.index + 0.01 * i if x == "beta" else table.index * 2 ** (0.08 * i)
            draw_intervals(ax, shifted, table, **style)
        lines.append((value if isinstance(value, str) else f"{by} = {value}", style))
    values = sorted(chosen[x].unique())
    if x == "beta":
        beta_ticks(ax, values)
    else:
        ax.set_xscale("log", base=2)
        ax.set_xticks(values, values)
        ax.minorticks_off()
    ax.set_title(extent(chosen))
    if by:
        legend_above(fig, *lines)
    return fig


def n_envs_beta_grids(runs):
    """Sec. "How Does the Number [...] and Noise Color Interact": of `rank_grids`, larger is better.

    The first panel's markers show the performance to the sixth power, the others' ranks.
    """
    grid, ranks, projected, chosen = tables.rank_grids(runs)
    fig, axes = panels(3, "n_envs", BETA, width=2.9, height=3.1)
    low, high = np.nanmin(grid), np.nanmax(grid)
    draw_grid(axes[0], ((grid - low) / (high - low or 1)) ** 6, "performance, to the sixth power")
    titles = "rank of performance", "rank projected from the bias"
    for ax, rank, title in zip(axes[1:], (ranks, projected), titles, strict=True):
        worst = (rank.max() - 1).clip(lower=1)
        draw_grid(ax, 1 - (rank - 1) / worst, title)
    what = "larger is better; ranks and rings, around the best, are of each n_envs"
    fig.suptitle(f"{what}\n{extent(chosen)}", fontsize=9)
    return fig


def learning_curves(runs, curves, by):
    """Sec. A10: mean return over training, a panel per value of `by`, a line per beta.

    A band is a line's interval; with fewer seeds than FEW it would be too narrow, and the
    runs are drawn instead. Open markers at the right end are the published final returns, where the
    runs have the study's protocol.
    """
    paper = published("final_return_per_beta").set_index([*CELL, "beta"]).final_return_mean
    as_in_study, one_task = differences(runs) == "", by == "n_envs"
    labels = "environment steps", "mean return"
    fig, axes = panels(runs[by].nunique(), *labels, height=2, sharey=one_task)
    for ax, (_, group) in zip(axes, runs.groupby(by), strict=True):
        environment, n_envs = group[CELL].iloc[0]
        lines = curves.loc[group.index].dropna(axis=1, how="all")
        end, every = lines.columns[-1], max(1, lines.shape[1] // 6)
        ax.axvline(end, color="0.8", lw=0.8)
        for i, (beta, seeds) in enumerate(group.groupby("beta")):
            line = lines.loc[seeds.index].dropna(axis=1)
            marks = {"markevery": (i * every // 3 % line.shape[1], every), "ms": 4}
            ax.plot(line.columns, line.mean(), **look(beta), **marks)
            if len(line) < FEW:
                ax.plot(line.columns, line.T, color=look(beta)["color"], alpha=0.4, lw=0.5)
            else:
                _, low, high = mean_interval(line, n_resamples=1000)
                ax.fill_between(line.columns, low, high, color=look(beta)["color"], alpha=0.2, lw=0)
            if as_in_study[seeds.index].all():
                final = paper.get((environment, n_envs, f"{beta:g}"), np.nan)
                ax.plot(1.05 * end, final, mfc="none", **look(beta))
        counts = sorted(set(group.groupby("beta").size()))
        seeds = " or ".join(map(str, counts))
        ax.set_title(f"{environment}\nn_envs {n_envs}, seeds: {seeds}")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    sizes = runs.groupby([by, "beta"]).size()
    entries = [("95 % BCa interval", {"lw": 6, "alpha": 0.3})] * int(sizes.max() >= FEW)
    entries += [(f"runs, if fewer than {FEW}", {"lw": 0.5, "alpha": 0.6})] * int(sizes.min() < FEW)
    legend_above(fig, *entries, betas=sorted(runs.beta.unique()), paper=as_in_study.any())
    return fig


def transfer(runs):
    """Sec. A7: performance of TRPO and A2C against beta, with PPO's, at the betas that all have."""
    counts = runs.groupby("beta").method.transform("nunique")
    shared = same_protocol(runs[counts == runs.method.nunique()])
    shared = shared.assign(method=shared.method.str.upper())
    return compare(shared, "beta", ["environment"], "method")


def gsde_vs_beta(runs):
    """Sec. A13: gSDE, which has no beta, beside the betas of PPO with colored noise."""
    need(runs.method.nunique() > 1, "runs of gSDE and runs with colored noise")
    runs = same_protocol(runs, [*SETTINGS.keys() - {"method"}, "bootstrap_timeouts"])
    right = runs.beta.max() + 0.5
    algorithm = runs.method.map({"ppo": "PPO with colored noise", "gsde": "gSDE"})
    runs = runs.assign(beta=runs.beta.fillna(right), algorithm=algorithm)
    fig = compare(runs, "beta", CELL, "algorithm")
    [ax] = fig.axes
    ax.axhline(ax.lines[-1].get_ydata()[0], color=INK, ls=":", lw=1)
    betas = ax.lines[0].get_xdata()
    ax.set_xticks([*betas, right], [*(f"{beta:g}" for beta in betas), "gSDE"])
    return fig


def complex_tasks(runs):
    """Sec. A8: performance per beta in each complex task."""
    runs = runs[runs.env_id.isin(COMPLEX)]
    need(len(runs), f"runs of {', '.join(COMPLEX)}")
    chosen = pd.concat(comparable(x, ["beta"], ["n_envs"]) for _, x in runs.groupby("environment"))
    fig, axes = panels(chosen.environment.nunique(), BETA, f"performance\n{INTERVAL}", height=2.2)
    for ax, (environment, group) in zip(axes, chosen.groupby("environment"), strict=True):
        draw_betas(ax, cells_intervals(group, "performance", "beta", ["n_envs"]), most=3)
        ax.set_title(environment)
        ax.update_datalim([(0, 0), (0, 1)])  # 0, and 1 for the goal, are in sight
        ax.autoscale_view()
    fig.suptitle(extent(chosen), fontsize=9)
    return fig


def beside_published(averages, runs):
    """Sec. A14: final returns beside the paper's, of each cell and averaged over environments.

    averages: the table of `average_final_returns`.
    """
    runs = tables.on_published_scale(runs)
    cells = runs.groupby([*CELL, "beta"])[["final_return", "paper"]].mean()
    scale = "0 is the environment's lowest published mean, 1 its highest"
    how = {"height": 2.6, "sharey": True}
    fig, axes = panels(1 + averages.n_envs.nunique(), scale, "our final return", **how)
    axes[0].axline((0, 0), slope=1, color="0.6", lw=0.9)
    for beta, group in cells.groupby("beta"):
        axes[0].plot(group.paper, group.final_return, **look(beta), ls="", ms=4, alpha=0.8)
    axes[0].set(title=f"{len(cells)} cells", xlabel="published final return")
    for ax, (n_envs, table) in zip(axes[1:], averages.groupby("n_envs"), strict=True):
        table = table.set_index("beta")
        ax.plot(table.index, table.paper, color="0.7", ls=":", lw=0.9)
        for beta, paper in table.paper.items():
            ax.plot(beta, paper, **look(beta), mfc="none", ms=8)
        draw_betas(ax, table, most=4)
        title = f"n_envs {n_envs}, environments: {table.environments.iloc[0]}"
        ax.set(title=title, xlabel=BETA)
    interval = ("95 % BCa interval", {"lw": 1.1})
    legend_above(fig, interval, betas=sorted(cells.index.unique("beta")), paper=True)
    return fig


def with_runs(table):
    """Which rows of `coverage` are of a claim that there are runs for."""
    return (table.verdict != "") & ~table.data.str.fullmatch("no runs[^;]*")


def verdicts(table):
    """What the runs say of each claim: its interval, what it must be between, the verdict in words.

    table: of `study.claims.coverage`. Claims of one unit share an axis, at whose ends much longer
    intervals than the others are cut. Where there is none, the text says why. Left out are claims
    that nothing is tested for, and those that there are no runs for.
    """
    table, tested = table[with_runs(table)], (table.verdict != "").sum()
    need(len(table), "runs of a claim")
    units = {unit: rows for unit, rows in table.groupby("unit", sort=False)}
    counts = [len(rows) for rows in units.values()]
    size = 10, 0.22 * sum(counts) + 0.6 * len(units) + 0.4
    fig, axes = plt.subplots(len(units), figsize=size, squeeze=False, height_ratios=counts)
    for ax, (unit, rows) in zip(axes[:, 0], units.items(), strict=True):
        length = rows.high - rows.low
        seen = rows[~(length > 2 * length.median())]
        left, right = np.nan_to_num([seen.low.min(), seen.high.max()])
        pad = 0.05 * (right - left) or 1
        ends = ax.set_xlim(min(left, 0) - pad, max(right, 0) + pad)
        for place, row in enumerate(rows.itertuples()):
            style, where = VERDICT_LOOK[row.verdict], {"transform": ax.get_yaxis_transform()}
            if np.isnan(row.low):
                text = textwrap.fill(textwrap.shorten(row.data, 130, placeholder=" ..."), 68)
                ax.text(0.01, place, text, va="center", color="0.4", size=6, **where)
            else:
                must = np.clip([row.least, row.most], *ends)
                ax.fill_betweenx([place - 0.4, place + 0.4], *must, color="0.92", lw=0)
                ax.plot([row.low, row.high], [place, place], color=style["color"])
                ax.plot(row.mean, place, **style)
            ax.text(1.01, place, row.verdict, va="center", color=style["color"], **where)
        ax.set_yticks(range(len(rows)), [f"{row.where}: {row.says}" for row in rows.itertuples()])
        ax.set(xlabel=unit, ylim=(len(rows) - 0.5, -0.5))
        ax.grid(visible=False, axis="y")
    title = "95 % intervals, longer where several are compared. A claim can hold only in the gray"
    fig.suptitle(f"{title}\n(those of {tested} that there are runs for)", fontsize=9)
    return fig


# --- The environments -----------------------------------------------------------------------------


def contact_sheet():
    """The first state of each of the paper's environments, in squares."""
    prepare_rendering()
    fig, axes = plt.subplots(4, 5, figsize=(12, 10.2))
    for ax, env_id in zip(axes.flat, NAMES, strict=True):
        env = ppo.make_env(ppo.parse_args(["--env-id", env_id]), render_mode="rgb_array")
        env.reset(seed=1)
        frame = env.render()
        env.close()
        ax.imshow(frame)
        height, width, _ = frame.shape
        half = (height if env_id.startswith("dm_control/") else width) / 2  # all of Mountain Car's
        x, y = (width - 1) / 2, (height - 1) / 2
        ax.set(xlim=(x - half, x + half), ylim=(y + half, y - half), xticks=[], yticks=[])
        ax.set_title(NAMES[env_id], fontsize=12)
        ax.spines[:].set(visible=True, color="0.7")
    return fig


def untrained_positions(beta, n_cars=50, n_steps=999, seed=1):
    """Plays Mountain Car with a policy that has learned nothing, exploring as in training.

    Returns the positions of n_cars cars, (n_steps + 1, n_cars). A car at the goal stays there.
    """
    torch.manual_seed(seed)
    limit = ["--max-episode-steps", f"{n_steps + 1}", "--n-steps", f"{n_steps}", "--no-envpool"]
    args = ppo.parse_args(["--env-id", "MountainCarContinuous-v0", "--n-envs", f"{n_cars}", *limit])
    envs = ppo.make_vector_env(args, n_cars)
    noise = colored_noise.ColoredNoiseProcess(beta, n_cars, 1, seed=seed)
    act, there = ppo.exploration(ppo.Agent(2, 1), noise, args), np.zeros(n_cars, bool)
    obs, _ = envs.reset(seed=seed)
    positions = [obs[:, 0].copy()]  # the environments write into obs again
    for step in range(n_steps):
        obs, _, terminated, _, _ = envs.step(np.clip(act(obs, step), -1, 1))
        there |= terminated
        positions.append(np.where(there, GOAL, obs[:, 0]))
    return np.array(positions)


def animation(betas, n_frames=100, **cars):
    """`untrained_positions` of each beta on the hill, as frames over an episode of 999 steps."""
    positions = [untrained_positions(beta, **cars) for beta in betas]
    hill, (n_steps, n_cars) = np.linspace(-1.2, 0.6, 200), positions[0].shape
    # Cars are lifted a little, each by its own height, or those at one place would hide each other
    lift = 0.59 + 0.14 * np.random.default_rng(0).random(n_cars)
    fig, axes = plt.subplots(1, len(betas), figsize=(2.6 * len(betas), 2.1), squeeze=False)
    dots = []
    for ax, beta in zip(axes[0], betas, strict=True):
        ax.fill_between(hill, 0.45 * np.sin(3 * hill) + 0.55, color="0.85", lw=0)
        ax.plot([GOAL] * 2, [0.99, 1.3], color=INK, lw=1.5)
        ax.fill([GOAL, GOAL, GOAL + 0.12], [1.3, 1.18, 1.24], color="#D55E00", lw=0)
        dots += ax.plot([], [], "o", color=look(beta)["color"], ms=3.5, alpha=0.7, mew=0)
        ax.set(title="\n", xlim=(-1.2, 0.62), ylim=(0, 1.4), xticks=[], yticks=[])
        ax.spines[:].set_visible(False)

    def draw(frame):
        step = round((n_steps - 1) * min(frame / (n_frames - 1), 1))
        for beta, x, dot in zip(betas, (each[step] for each in positions), dots, strict=True):
            dot.set_data(x, 0.45 * np.sin(3 * x) + lift)
            name = {0: " (white)", 1: " (pink)", 2: " (red)"}.get(beta, "")
            there = f"at the goal: {(x >= GOAL).sum()} of {n_cars}"
            dot.axes.set_title(f"$\\beta = {beta:g}${name}, step {step}\n{there}")

    return FuncAnimation(fig, draw, n_frames * 5 // 4)  # the last frame stays for a while


# --- Output ---------------------------------------------------------------------------------------


def make_all(todo, out):
    """Makes and writes figures (PNG, PDF) and tables (CSV, Markdown, LaTeX).

    todo: {name: (function, data, other arguments ...)}; data may be the name of an earlier table.
    Removes those of earlier data. Returns those made, by name, and lines: what could not be made,
    and why.
    """
    made, not_made = {}, []
    out.mkdir(parents=True, exist_ok=True)
    for suffix in ("png", "pdf", "csv", "md", "tex"):
        for path in out.glob(f"*.{suffix}"):
            if path.stem in todo or path.match("learning_curves_*.p??"):
                path.unlink()  # of earlier data
    for name, (make, data, *rest) in tqdm(todo.items(), desc="tables and figures", unit=""):
        try:
            if isinstance(data, str):
                need(data in made, f"the table {data}")
                data = made[data]
            need(len(data), "runs with colored noise on tasks of the study")
            made[name] = make(data, *rest)
        except Unusable as error:
            not_made.append(f"{name}: {error}")
            continue
        if isinstance(made[name], pd.DataFrame):
            tables.save_table(made[name], out, name)
        else:
            made[name].savefig(out / f"{name}.png")
            made[name].savefig(out / f"{name}.pdf")
            plt.close(made[name])
    return made, not_made


def noise(betas):
    """What `make_all` is to make of the noise."""
    return {
        "noise_random_walks": (random_walks, betas),
        "noise_psd": (power_spectral_density, betas),
        "noise_two_step": (two_step_scatter, [b for b in betas if b in (0, 0.5, 1)] or betas),
        "noise_marginal": (marginal_distribution, betas),
        "noise_bias": (bias, betas),
    }


def averaged(runs):
    """The runs that the paper averages over: with colored noise, and not of a complex task."""
    return runs[~runs.env_id.isin(COMPLEX) & ~runs.vanilla]


def results(runs, curves, betas):
    """What `make_all` is to make of runs, as `select` returns them, and of their curves.

    All is of the first method that has runs, except where methods are compared (Sec. A7, A13).
    betas: those that have learning curves.
    """
    of_all, grids = runs, averaged(study.runs.main_grid(runs))
    four = grids.n_envs == 4
    first = next(name for name in [*METHODS, *runs.method] if name in set(runs.method))
    runs = runs[runs.method == first]
    grid = study.runs.main_grid(runs)
    colored, every, main = grid[~grid.vanilla], averaged(runs), claims.of_most(averaged(grid))
    white = grid[((grid.beta == 0) | grid.vanilla) & ~grid.env_id.isin(COMPLEX)]
    white = white.assign(algorithm=np.where(white.vanilla, "vanilla PPO", r"$\beta = 0$"))
    half = every[(every.beta == 0.5) & every.n_epochs.isin(grid.n_epochs[:1])]
    half = half.assign(update_size=half.n_envs * half.n_steps)
    epochs = every[every.n_steps.isin(grid.n_steps[:1])]
    counts = epochs.groupby([*CELL, "beta"]).n_epochs.transform("nunique")
    todo = {
        "best_beta_per_env": (tables.best_beta_per_env, averaged(grid)),
        "best_beta_per_n_envs": (tables.best_beta_per_n_envs, main),
        "final_return_and_performance": (tables.final_return_and_performance, colored),
        "final_returns": (tables.final_returns, grid),
        "final_return_per_beta": (tables.final_return_per_beta, "final_returns"),
        "average_final_returns": (tables.average_final_returns, main),
        "performance_vs_beta": (compare, main, "beta", CELL),
        "performance_vs_n_envs": (compare, main, "n_envs", ["environment", "beta"]),
        "n_envs_beta_grids": (n_envs_beta_grids, main),
        # Sec. A6: beta 0 matches vanilla PPO
        "beta0_vs_vanilla": (compare, white, "n_envs", ["environment"], "algorithm"),
        # Sec. A11: at beta 0.5, what matters is n_envs * n_steps
        "n_envs_vs_n_steps": (compare, half, "update_size", ["environment"], "n_steps"),
        # Sec. A12: the preferred beta for each n_epochs, of the betas that have all of these
        "n_epochs_vs_beta": (compare, epochs[counts == counts.max()], "beta", CELL, "n_epochs"),
        "transfer": (transfer, grids[grids.method.isin(["ppo", "trpo", "a2c"]) & four]),
        "complex_tasks": (complex_tasks, colored),
        "gsde_vs_beta": (gsde_vs_beta, grids[grids.method.isin(["ppo", "gsde"])]),
        "coverage": (claims.coverage, of_all, curves),
        "claims": (verdicts, "coverage"),
        "beside_published": (beside_published, "average_final_returns", main),
    }
    lines = colored[colored.beta.isin(betas)]
    for n_envs, group in averaged(lines).groupby("n_envs"):
        todo[f"learning_curves_n_envs_{n_envs}"] = (learning_curves, group, curves, "environment")
    for environment, group in lines.groupby("environment"):
        if group.n_envs.nunique() > 1 or group.env_id.iloc[0] in COMPLEX:
            name = re.sub(r"\W", "", environment.lower().replace(" ", "_"))
            todo[f"learning_curves_{name}"] = (learning_curves, group, curves, "n_envs")
    return todo


def parse_args():
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    add = parser.add_subparsers(dest="command", required=True).add_parser
    commands = {
        "noise": (add("noise", help="figures of the noise"), "figures"),
        "results": (add("results", help="figures and tables of runs"), "figures"),
        "environments": (add("environments", help="a frame of each"), "results/environments.png"),
        "animation": (add("animation", help="untrained policies, a GIF"), "results/animation.gif"),
    }
    study.runs.add_runs(commands["results"][0])
    for name, betas in {"noise": BETAS, "animation": [0.0, 0.5, 1.0]}.items():
        commands[name][0].add_argument("--beta", nargs="+", type=float, default=betas)
    for command, out in commands.values():
        note = f"default: {out}; earlier ones are replaced"
        command.add_argument("--out", type=Path, default=Path(out), help=note)
    return parser.parse_args()


def main():
    args = parse_args()
    plt.switch_backend("Agg")  # figures are written to files, not shown
    if args.command == "results":  # all that the runs allow
        runs, curves = study.runs.load(args.paths, args.env, args.beta, args.n_envs)
        runs, left_out = study.runs.select(runs)
        asked = [float(beta) for beta in args.beta or [] if beta != "vanilla"]
        made, not_made = make_all(results(runs, curves, asked or [0, 0.5, 1]), args.out)
        for title, lines in {"runs left out": left_out, "not made": not_made}.items():
            print("\n  ".join([f"{title}: {len(lines)}", *lines]))
        print(f"{args.out}: {', '.join(made)}")
    elif args.command == "noise":
        made, _ = make_all(noise(sorted(set(args.beta))), args.out)
        print(f"{args.out}: {', '.join(made)}")
    elif args.command == "environments":
        contact_sheet().savefig(args.out, dpi=85)
    else:
        animation(args.beta).save(args.out, PillowWriter(fps=15), dpi=100)


if __name__ == "__main__":
    main()
