"""Every figure of the study. Its tables (study/tables.py) show the published numbers beside ours.

    python plot.py noise           what the noise looks like: nothing needs to be trained
    python plot.py results runs/   figures and tables of all complete runs, in folders or packed
    python plot.py environments    a frame of each of the paper's environments
    python plot.py animation       policies that have learned nothing, in Mountain Car: only the
                                   color of their noise differs

Sections named below are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI 2024,
with its appendix.
"""

import argparse
import math
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, NullLocator
from scipy import stats
from tqdm import tqdm

import ppo_colored_continuous as ppo
import study.runs
from colored_noise import autocovariance, colored_noise, expected_psd, marginal_variance, mean_std
from study import claims, tables
from study.environments import prepare_rendering
from study.protocol import BETAS, COMPLEX, NAMES, SETTINGS
from study.runs import CELL, Unusable, comparable, differences, need, published, same_protocol
from study.statistics import cells_intervals, mean_interval, mean_intervals, standardize

# --- Drawing --------------------------------------------------------------------------------------

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
PAPER = {"ls": ":", "lw": 0.9, "mfc": "none"}  # the published numbers: open markers
METHOD_LOOK = {  # Okabe and Ito's colors, which color-blind readers can tell apart
    "ppo": {"color": "#0072B2", "marker": "o"},
    "trpo": {"color": "#D55E00", "marker": "s", "ls": "--"},
    "a2c": {"color": "#000000", "marker": "^", "ls": ":"},
}
STANDARDIZED = "standardized performance\n(mean, 95 % BCa interval)"


def look(beta):
    """Color and marker of a beta in all figures: the lighter, the larger beta is."""
    place = np.interp(beta, BETAS, range(len(BETAS)))
    marker = "v^osDPX*"[round(place)] if beta in BETAS else "<>dp8+x"[round(10 * beta) % 7]
    return {"color": plt.get_cmap("plasma")(0.82 * place / (len(BETAS) - 1)), "marker": marker}


def color(beta):
    return look(beta)["color"]


def environments(count):
    return f"{count} environment{'s'[: count > 1]}"


def extent(runs, of=None):
    """What a figure is made of, for its title; `of`: the runs that they were chosen from."""
    n_envs, count = sorted(runs.n_envs.unique()), runs.environment.nunique()
    text = f"{environments(count)}, n_envs {', '.join(map(str, n_envs))}"
    cells, left = runs.groupby(CELL).ngroups, 0 if of is None else len(of) - len(runs)
    text += f" ({cells} cells)" * (cells < count * len(n_envs)) + f", {len(runs)} runs"
    return text + f"\n(without {left} runs that lack a counterpart or a second seed)" * (left > 0)


def panels(count, xlabel="", ylabel="", width=2.5, height=1.9):
    """A figure with a list of `count` axes, at most four in a row, labelled left and below."""
    rows = math.ceil(count / 4)
    columns = math.ceil(count / rows)
    size = max(width * columns, 5), height * rows + 0.5
    fig, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
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


def beta_ticks(ax, betas, few=False):
    """Ticks at the betas; with `few`, at five of the study's, where the labels would touch."""
    if few and len(betas) > 4:
        betas = [-1, 0, 0.5, 1, 2]
    ax.set_xticks(betas, [f"{beta:g}" for beta in betas])


def log2_ticks(ax, values):
    values = sorted(set(values))
    powers = max(values) > 1000 and all(math.log2(value).is_integer() for value in values)
    labels = [f"$2^{{{math.log2(value):g}}}$" if powers else f"{value:g}" for value in values]
    ax.set_xscale("log", base=2)
    ax.set_xticks(values, labels)
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
    beta_ticks(ax, table.index)


def draw_grid(ax, sizes, title):
    """Markers of the area `sizes`, in [0, 1], at n_envs and beta; a ring around the largest."""
    for column, n_envs in enumerate(sizes):
        for row, (beta, size) in enumerate(sizes[n_envs].items()):
            if not np.isnan(size):
                edge = "black" if size == sizes[n_envs].max() else "none"
                style = {"s": 8 + 200 * size, "color": color(beta), "edgecolor": edge}
                ax.scatter(column, row, linewidth=1.4, **style)
    ax.set_xticks(range(sizes.shape[1]), sizes.columns)
    ax.set_yticks(range(len(sizes)), [f"{beta:g}" for beta in sizes.index])
    ax.set(title=title, xlim=(-0.6, sizes.shape[1] - 0.4), ylim=(-0.6, len(sizes) - 0.4))


# --- Figures of the noise -------------------------------------------------------------------------


def draw_noise(beta, *size, seed=0):
    """Sequences (*size, 1000), the paper's length, from the same random numbers for each beta."""
    return colored_noise(beta, (*size, 1000), generator=torch.Generator().manual_seed(seed))


def random_walks(betas):
    """Fig. 1: two-dimensional random walks."""
    fig, axes = plt.subplots(2, len(betas), figsize=(1.45 * len(betas) + 0.5, 3.3), squeeze=False)
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
    """Sec. A1: subsequent values are correlated where beta > 0, as measured and in closed form."""
    labels = r"$\varepsilon_t$", r"$\varepsilon_{t+1}$"
    fig, axes = panels(len(betas), *labels, width=2.2, height=2.2)
    for ax, beta in zip(axes, betas, strict=True):
        noise, lags = draw_noise(beta, 2000).numpy(), autocovariance(beta, 1000)
        correlation = np.corrcoef(noise[:, :-1].ravel(), noise[:, 1:].ravel())[0, 1]
        ax.scatter(noise[:, 500], noise[:, 501], s=3, color=color(beta), alpha=0.5, lw=0)
        measured = f"correlation {correlation:z.2f}"
        ax.set_title(f"$\\beta = {beta:g}$, {measured}\n(closed form {lags[1] / lags[0]:z.2f})")
        ax.set(xlim=(-4.5, 4.5), ylim=(-4.5, 4.5), aspect="equal", xticks=[-4, -2, 0, 2, 4])
    return fig


def marginal_distribution(betas):
    """Sec. A1: each step's distribution is Gaussian, its variance near 1 for all beta."""
    fig, axes = panels(len(betas), r"$\varepsilon_t$", "density")
    x, line = np.linspace(-4.5, 4.5, 91), {"color": "black", "lw": 0.9}
    for ax, beta in zip(axes, betas, strict=True):
        noise, variance = draw_noise(beta, 5000), float(marginal_variance(beta, 1000))
        sample = noise[:, ::50].flatten().numpy()
        ax.hist(sample, bins=x, density=True, color=color(beta), alpha=0.6)
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
            violin.set(facecolor=color(beta), alpha=0.8)
        right.plot(beta, means.std(), **look(beta), ls="", zorder=3)
    curve = np.linspace(min(betas) - 0.1, max(betas) + 0.1, 200)
    right.plot(curve, mean_std(curve, 1000), color=INK, lw=1)
    left.set_xticks(range(len(betas)), [f"{beta:g}" for beta in betas])
    left.set_ylabel("mean of a sequence of 1000 steps")
    right.set_ylabel("standard deviation of the mean")
    legend_above(fig, ("measured", {"marker": "o", "ls": ""}), ("closed form", {"lw": 1}))
    return fig


# --- Figures of the results -----------------------------------------------------------------------


def standardized(runs, axes, cells):
    """The `comparable` runs, with their standardized performance as the column z."""
    chosen = comparable(runs, axes, cells)
    return chosen.assign(z=standardize(chosen))


def compare(runs, x, cells, by=None):
    """Performance over x: "beta", "n_envs" or "update_size". A line for each value of column `by`.

    Standardized within each environment, then averaged over seeds within `cells`, then over the
    cells that have all values of x and `by`. Cells are environments, and n_envs (Sec. "Does
    Colored-Noise Affect the Performance") or betas ("How Does the Number of Parallel Collection
    Environments").
    """
    need(by or runs[x].nunique() > 1, f"at least two values of {x}")
    chosen = standardized(runs, [x, by] if by else [x], cells)
    xlabel = {"beta": BETA_NAMED, "update_size": "update size n_envs \u00b7 n_steps"}.get(x, x)
    fig, [ax] = panels(1, xlabel, STANDARDIZED, height=3)
    lines, unknown = [], False
    for i, (value, group) in enumerate(chosen.groupby(by) if by else [("", chosen)]):
        gray = ["0.1", "0.65", "0.4", "0.75"][i % 4] if by else INK
        style = {"color": gray, "ls": ["-", "--", ":", "-."][i % 4], "lw": 1}
        table = cells_intervals(group, "z", x, cells)
        unknown |= table.low.isna().any()
        if x == "beta":
            draw_betas(ax, table, shift=0.006 * i, **style)
        else:
            style["marker"] = "os^D"[i % 4]
            draw_intervals(ax, table.index * 2 ** (0.08 * i), table, **style)
            log2_ticks(ax, chosen[x])
        lines.append((value if isinstance(value, str) else f"{by} = {value}", style))
    no_interval = "\n(no interval where a cell has one run)" * bool(unknown)
    ax.set_title(extent(chosen, runs) + no_interval)
    if by:
        legend_above(fig, *lines)
    return fig


def beta0_vs_vanilla(runs):
    """Sec. A6: beta 0 matches vanilla PPO. runs: with any beta, and vanilla."""
    runs = runs[(runs.beta == 0) | runs.vanilla]
    need(runs.vanilla.nunique() == 2, "runs with --beta 0 and runs with --vanilla")
    runs = runs.assign(algorithm=np.where(runs.vanilla, "vanilla PPO", r"$\beta = 0$"))
    return compare(runs, "n_envs", ["environment"], "algorithm")


def n_envs_vs_n_steps(runs):
    """Sec. A11: at beta 0.5, what matters is n_envs * n_steps. runs: with any n_steps."""
    runs = runs[runs.beta == 0.5]
    need(runs.n_steps.nunique() > 1, "runs with --beta 0.5 and at least two values of --n-steps")
    runs = runs.assign(update_size=runs.n_envs * runs.n_steps)
    return compare(runs, "update_size", ["environment"], "n_steps")


def n_epochs_vs_beta(runs):
    """Sec. A12: the preferred beta for each n_epochs. runs: with any n_epochs."""
    need(runs.n_epochs.nunique() > 1, "at least two values of --n-epochs")
    there = runs.groupby([*CELL, "beta"]).n_epochs.transform("nunique")
    return compare(runs[there == there.max()], "beta", CELL, "n_epochs")


def n_envs_beta_grids(runs):
    """Sec. "How Does the Number [...] and Noise Color Interact": marker size = performance^6, rank.

    Beside them are the ranks projected from the bias of the noise: by our best betas and, where
    the runs have the study's protocol, by the paper's.
    """
    need(runs.beta.nunique() > 1, "at least two betas")
    grid, chosen = tables.performance_grid(runs)
    lengths = chosen.noise_seq_len.unique()
    need(len(lengths) == 1, "one --noise-seq-len, of all environments: the projection goes by it")
    best = {"our": grid.idxmax()}
    if not differences(chosen).any():
        best["the paper's"] = published("best_beta_per_n_envs").set_index("n_envs").best_beta
    ranks = {"rank of performance within n_envs": -grid}
    for whose, betas in best.items():
        projected = tables.projected_ranks(betas, grid.index, grid.columns, int(lengths[0]))
        title = f"rank projected from the bias,\nby {whose} best $\\beta$"
        ranks[title] = projected.where(grid.notna())
    fig, axes = panels(1 + len(ranks), "n_envs", BETA, width=2.9, height=3.1)
    low, high = np.nanmin(grid), np.nanmax(grid)
    draw_grid(axes[0], ((grid - low) / (high - low or 1)) ** 6, "performance, to the sixth power")
    for ax, (title, order) in zip(axes[1:], ranks.items(), strict=True):
        rank = order.rank()  # 1 the best, of as many betas as this n_envs has
        draw_grid(ax, 1 - (rank - 1) / (rank.count() - 1).clip(lower=1), title)
    made_of = extent(chosen, runs)
    fig.suptitle(f"larger is better, ring: best of each n_envs; {made_of}", fontsize=9)
    return fig


def three_betas(runs):
    """The betas to draw curves of: more than three lines in a panel cannot be told apart."""
    there = sorted(runs.beta.unique())
    first = [beta for beta in (0, 0.5, 1) if beta in there]
    return sorted((first + [beta for beta in there if beta not in first])[:3])


def learning_curves(runs, curves, by):
    """Sec. A10: mean return over training, a panel per value of `by`, a line per beta.

    A band is a line's interval. Open markers at the right end are the published final returns,
    where the runs have the study's protocol.
    """
    paper = published("final_return_per_beta").set_index([*CELL, "beta"]).final_return_mean
    as_in_study = differences(runs) == ""
    fig, axes = panels(runs[by].nunique(), "environment steps", "mean return")
    for ax, (_, group) in zip(axes, runs.groupby(by), strict=True):
        environment, n_envs = group[CELL].iloc[0]
        lines = curves.loc[group.index].dropna(axis=1, how="all")
        end, every = lines.columns[-1], max(1, lines.shape[1] // 6)
        ax.axvline(end, color="0.8", lw=0.8)
        for i, (beta, seeds) in enumerate(group.groupby("beta")):
            line = lines.loc[seeds.index].dropna(axis=1)
            mean, low, high = mean_interval(line, n_resamples=1000)
            marks = {"markevery": (i * every // 3 % line.shape[1], every), "ms": 4}
            ax.plot(line.columns, mean, **look(beta), **marks)
            ax.fill_between(line.columns, low, high, color=color(beta), alpha=0.2, lw=0)
            if as_in_study[seeds.index].all():
                final = paper.get((environment, n_envs, f"{beta:g}"), np.nan)
                ax.plot(1.05 * end, final, mfc="none", **look(beta))
        ax.set_title(f"{environment}, n_envs {n_envs}")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    entries = [("95 % BCa interval", {"lw": 6, "alpha": 0.3})]
    entries += [("paper", {"marker": "o", "ls": "", "mfc": "none"})] * bool(as_in_study.any())
    legend_above(fig, *entries, betas=sorted(runs.beta.unique()))
    return fig


def transfer(runs):
    """Sec. A7: standardized performance against beta of (a) TRPO, (b) A2C, (c) all with PPO's.

    runs: of the three methods, n_envs 4. (a) and (b) are standardized over one method's runs in an
    environment, (c) over all; each over the environments that have all betas (of all methods).
    """
    methods = [method for method in METHOD_LOOK if (runs.method == method).any()]
    need(set(methods) - {"ppo"}, "runs of TRPO or A2C with n_envs 4")
    groups = {name.upper(): runs[runs.method == name] for name in methods if name != "ppo"}
    shared = set.intersection(*(set(runs.beta[runs.method == name]) for name in methods))
    if len(methods) > 1 and shared:
        groups["overall"] = same_protocol(runs[runs.beta.isin(shared)])
    for name, group in groups.items():
        groups[name] = standardized(group, ["method", "beta"], ["environment"])
    fig, axes = panels(len(groups), BETA, STANDARDIZED, width=3.2, height=2.8)
    for ax, (name, group) in zip(axes, groups.items(), strict=True):
        for i, (method, part) in enumerate(group.groupby("method")):
            table = cells_intervals(part, "z", "beta", ["environment"])
            if name == "overall":
                draw_intervals(ax, table.index + 0.03 * (i - 1), table, **METHOD_LOOK[method])
            else:
                draw_betas(ax, table)
        beta_ticks(ax, sorted(group.beta.unique()), few=True)
        ax.set_title(f"{name}\n{environments(group.environment.nunique())}, {len(group)} runs")
    if "overall" in groups:
        legend_above(fig, *((method.upper(), METHOD_LOOK[method]) for method in methods))
    return fig


def gsde_vs_beta(runs):
    """Sec. A13: gSDE, which has no beta, beside the betas of PPO with colored noise."""
    need(runs.method.nunique() > 1, "runs of gSDE and runs with colored noise")
    shared = [argument for argument in SETTINGS if argument != "method"]
    runs = same_protocol(runs, [*shared, "bootstrap_timeouts"])
    runs = runs.assign(noise=runs.beta.fillna(np.inf))  # inf: gSDE
    chosen = standardized(runs, ["noise"], CELL)
    table = cells_intervals(chosen, "z", "noise", CELL)
    betas, gsde = table.drop(np.inf), table.loc[[np.inf]]
    fig, [ax] = panels(1, BETA_NAMED, STANDARDIZED, height=3)
    x = betas.index.max() + 0.5
    ax.axhspan(*gsde[["low", "high"]].iloc[0], color=INK, alpha=0.12, lw=0)
    ax.axhline(gsde["mean"].iloc[0], color=INK, ls="--", lw=1)
    draw_betas(ax, betas)
    draw_intervals(ax, [x], gsde, color=INK, marker="h", ms=7)
    ax.set_xticks([*betas.index, x], [*(f"{beta:g}" for beta in betas.index), "gSDE"])
    ax.set_title(extent(chosen, runs))
    return fig


def complex_tasks(runs):
    """Sec. A8: performance per beta in each complex task."""
    runs = runs[runs.env_id.isin(COMPLEX)]
    need(len(runs), f"runs of {', '.join(COMPLEX)}")
    chosen = pd.concat(comparable(x, ["beta"], ["n_envs"]) for _, x in runs.groupby("environment"))
    ylabel = "performance\n(mean, 95 % BCa interval)"
    fig, axes = panels(chosen.environment.nunique(), BETA, ylabel)
    for ax, (environment, group) in zip(axes, chosen.groupby("environment"), strict=True):
        table = cells_intervals(group, "performance", "beta", ["n_envs"])
        draw_betas(ax, table)
        no_interval = "\n(one run each: no interval)" * bool(table.low.isna().any())
        ax.set_title(environment + no_interval)
        ax.set(xticks=[-1, 0, 1, 2], xticklabels=["-1", "0", "1", "2"])
    fig.suptitle(extent(chosen, runs), fontsize=9)
    return fig


def final_return_vs_n_envs(table, betas):
    """Final return against n_envs per beta, ours (filled) over the published (open).

    table: of `final_returns`; betas: those to draw.
    """
    table = table[table.beta != "vanilla"].astype({"beta": float})
    table = table[table.beta.isin(betas)]
    need(len(table), "runs with colored noise")
    fig, axes = panels(table.environment.nunique(), "n_envs", "final return")
    for ax, (environment, group) in zip(axes, table.groupby("environment"), strict=True):
        for beta, cells in group.groupby("beta"):
            # The betas of one n_envs stand side by side
            x = cells.n_envs * 2 ** (0.5 * (betas.index(beta) + 0.5) / len(betas) - 0.25)
            ax.plot(x, cells.paper, **look(beta), **PAPER, ms=7)
            draw_intervals(ax, x, cells, **look(beta), ms=4)
        log2_ticks(ax, table.n_envs)
        ax.set(title=environment, xlim=(table.n_envs.min() / 1.5, table.n_envs.max() * 1.5))
    ours = ("ours, 95 % BCa interval", {"marker": "o", "ms": 4})
    paper = ("paper", {**PAPER, "marker": "o", "ms": 7})
    legend_above(fig, ours, *[paper] * bool(table.paper.notna().any()), betas=betas)
    return fig


def beside_published(averages, runs):
    """Sec. A14: final returns beside the paper's, of each cell and averaged over environments.

    averages: the table of `average_final_returns`.
    """
    runs = tables.on_published_scale(runs)
    cells = mean_intervals(runs, "final_return", [*CELL, "beta"])
    cells["paper"] = runs.groupby([*CELL, "beta"]).paper.first()
    fig, axes = panels(1 + averages.n_envs.nunique(), BETA, height=2.6)
    axes[0].axline((0, 0), slope=1, color="0.6", lw=0.9)
    for beta, group in cells.groupby("beta"):
        draw_intervals(axes[0], group.paper, group, **look(beta), ls="", ms=4)
    axes[0].set_title(f"{len(cells)} cells")
    axes[0].set_ylabel("our final return\n(0 to 1: the paper's lowest to highest)")
    axes[0].set_xlabel("published final return")
    for ax, (n_envs, table) in zip(axes[1:], averages.groupby("n_envs"), strict=True):
        table = table.set_index("beta")
        ax.plot(table.index, table.paper, **PAPER, color="0.7")
        for beta, paper in table.paper.items():
            ax.plot(beta, paper, **look(beta), **PAPER, ms=8)
        draw_betas(ax, table)
        beta_ticks(ax, table.index, few=True)
        ax.set_title(f"n_envs {n_envs}, {environments(int(table.environments.iloc[0]))}")
        ax.set_ylabel("averaged over environments")
    paper = ("paper", {**PAPER, "marker": "o", "ms": 8})
    ours = ("ours, 95 % BCa interval", {"marker": "o"})
    legend_above(fig, ours, paper, betas=sorted(cells.index.unique("beta")))
    return fig


def robust_performance(table):
    """Beyond the paper: interquartile mean, probability of improvement, of `robust_statistics`."""
    need(table.improvement.notna().any(), "beta 0 and another beta in one environment and n_envs")
    fig, axes = panels(2, BETA_NAMED, width=5, height=2.8)
    for ax, name in zip(axes, ("iqm", "improvement"), strict=True):
        columns = {name: "mean", f"{name}_low": "low", f"{name}_high": "high"}
        draw_betas(ax, table.set_index("beta").rename(columns=columns).dropna(subset="mean"))
    axes[0].set_ylabel("standardized performance\n(interquartile mean)")
    axes[1].set_ylabel("probability of doing\nbetter than $\\beta = 0$")
    axes[1].axhline(0.5, color=INK, ls="--", lw=0.9)
    made_of = f"{table.cells.iloc[0]} cells of environment and n_envs, {table.runs.sum()} runs"
    fig.suptitle(f"95 % stratified bootstrap intervals, {made_of}", fontsize=9)
    return fig


# --- The environments -----------------------------------------------------------------------------


def first_frame(env_id):
    """A square picture of the environment's first state."""
    env = ppo.make_env(ppo.parse_args(["--env-id", env_id]), render_mode="rgb_array")
    env.reset(seed=1)
    frame = env.render()
    env.close()
    height, width, _ = frame.shape
    if env_id.startswith("dm_control/"):
        return frame[:, (width - height) // 2 : (width + height) // 2]
    margin = max(0, width - height) // 2  # Mountain Car's is wide: square with its own sky
    return np.pad(frame, ((margin, margin), (0, 0), (0, 0)), mode="edge")


def contact_sheet():
    """A frame of each of the paper's environments, in the order of its figure of them (Sec. A4)."""
    tasks = ["cartpole-balance_sparse", "cartpole-swingup_sparse", "ball_in_cup-catch"]
    tasks += ["hopper-hop", "cheetah-run", "walker-run", "reacher-hard", "pendulum-swingup"]
    ids = ["MountainCarContinuous-v0", *(f"dm_control/{task}-v0" for task in tasks), "door-v0"]
    ids += ["PointUMaze-v1", "AntUMaze-v1", "Point4Rooms-v1", "SwimmerUMaze-v1"]
    ids += ["Swimmer4Rooms-v1", "Ant4Rooms-v1", *COMPLEX]
    prepare_rendering()
    fig, axes = plt.subplots(4, 5, figsize=(12, 10.2))
    for ax, env_id in zip(axes.flat, ids, strict=True):
        ax.imshow(first_frame(env_id))
        ax.set(xticks=[], yticks=[])
        ax.set_title(NAMES[env_id], fontsize=12)
        ax.spines[:].set(visible=True, color="0.7")
    return fig


def untrained_positions(beta, n_cars=50, n_steps=999, seed=1):
    """Plays Mountain Car with a policy that has learned nothing, exploring as in training.

    Returns the positions of n_cars cars, (n_steps + 1, n_cars). A car at the goal stays there.
    """
    torch.manual_seed(seed)
    policy = ppo.numpy_policy(ppo.Agent(2, 1).actor_mean)
    env = ppo.make_env(ppo.parse_args(["--env-id", "MountainCarContinuous-v0"]))
    noise = draw_noise(beta, n_cars, seed=seed).numpy()
    positions = np.empty((n_steps + 1, n_cars))
    for car in range(n_cars):
        obs, _ = env.reset(seed=seed + car)
        positions[:, car] = obs[0]
        for step in range(n_steps):
            action = policy(obs[None])[0] + noise[car, step]  # its standard deviation is 1
            obs, _, terminated, _, _ = env.step(np.clip(action, -1, 1))
            positions[step + 1 :, car] = obs[0]
            if terminated:
                break
    return positions


def animation(betas, n_frames=100, **cars):
    """`untrained_positions` of each beta on the hill, as frames over an episode of 999 steps."""
    goal, positions = 0.45, [untrained_positions(beta, **cars) for beta in betas]
    hill, (n_steps, n_cars) = np.linspace(-1.2, 0.6, 200), positions[0].shape

    def height(x):
        return 0.45 * np.sin(3 * x) + 0.55

    rng = np.random.default_rng(0)
    lift = 0.04 + 0.14 * rng.random(n_cars)  # or cars at one place would hide each other
    fig, axes = plt.subplots(1, len(betas), figsize=(2.6 * len(betas), 2.1), squeeze=False)
    dots = []
    for ax, beta in zip(axes[0], betas, strict=True):
        ax.fill_between(hill, height(hill), color="0.85", lw=0)
        ax.plot([goal] * 2, [0.99, 1.3], color=INK, lw=1.5)
        ax.fill([goal, goal, goal + 0.12], [1.3, 1.18, 1.24], color="#D55E00", lw=0)
        dots += ax.plot([], [], "o", color=color(beta), ms=3.5, alpha=0.7, mew=0)
        ax.set(title="\n", xlim=(-1.2, 0.62), ylim=(0, 1.4), xticks=[], yticks=[])
        ax.spines[:].set_visible(False)

    def draw(frame):
        step = round((n_steps - 1) * frame / (n_frames - 1))
        for beta, each, dot in zip(betas, positions, dots, strict=True):
            x = each[step]
            dot.set_data(x, height(x) + lift)
            name = {0: " (white)", 1: " (pink)", 2: " (red)"}.get(beta, "")
            there = f"at the goal: {(x >= goal).sum()} of {n_cars}"
            dot.axes.set_title(f"$\\beta = {beta:g}${name}, step {step}\n{there}")

    pause = [n_frames - 1] * (n_frames // 4)
    return FuncAnimation(fig, draw, [*range(n_frames), *pause])


# --- Output ---------------------------------------------------------------------------------------


def make_all(todo, out):
    """Makes and writes figures (PNG, PDF) and tables (CSV, Markdown, LaTeX).

    todo: {name: (function, data, other arguments ...)}; data may be the name of an earlier table.
    Returns those made, by name, and a line for each that could not be made.
    """
    made, not_made = {}, []
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
            made[name].savefig(out / f"{name}.png", dpi=200)
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


def results(methods, curves, betas):
    """What `make_all` is to make of runs, as `select_methods` returns them, and of their curves.

    All is of the first method, except where methods are compared (Sec. A7, A13). betas: those
    that have learning curves.
    """

    def of(*names):  # runs of several methods
        grids = [study.runs.main_grid(methods[name])[0] for name in names if name in methods]
        return averaged(pd.concat(grids))

    runs = next(iter(methods.values()))
    grid, _ = study.runs.main_grid(runs)
    colored, main, every = grid[~grid.vanilla], averaged(grid), averaged(runs)
    same_epochs = every[every.n_epochs.isin(grid.n_epochs[:1])]
    same_steps = every[every.n_steps.isin(grid.n_steps[:1])]
    three = of("ppo", "trpo", "a2c")
    todo = {
        "best_beta_per_env": (tables.best_beta_per_env, main),
        "best_beta_per_n_envs": (tables.best_beta_per_n_envs, main),
        "final_return_and_performance": (tables.final_return_and_performance, colored),
        "final_returns": (tables.final_returns, grid),
        "final_return_per_beta": (tables.final_return_per_beta, "final_returns"),
        "average_final_returns": (tables.average_final_returns, main),
        "robust_statistics": (tables.robust_statistics, main),
        "performance_vs_beta": (compare, main, "beta", CELL),
        "performance_vs_n_envs": (compare, main, "n_envs", ["environment", "beta"]),
        "n_envs_beta_grids": (n_envs_beta_grids, main),
        "beta0_vs_vanilla": (beta0_vs_vanilla, grid[~grid.env_id.isin(COMPLEX)]),
        "n_envs_vs_n_steps": (n_envs_vs_n_steps, same_epochs),
        "n_epochs_vs_beta": (n_epochs_vs_beta, same_steps),
        "transfer": (transfer, three[three.n_envs == 4]),
        "complex_tasks": (complex_tasks, colored),
        "gsde_vs_beta": (gsde_vs_beta, of("ppo", "gsde")),
        "coverage": (claims.coverage, methods, curves),
        "final_return_vs_n_envs": (final_return_vs_n_envs, "final_returns", betas),
        "beside_published": (beside_published, "average_final_returns", main),
        "robust_performance": (robust_performance, "robust_statistics"),
    }
    lines = colored[colored.beta.isin(betas)]
    for n_envs, group in lines.groupby("n_envs"):
        todo[f"learning_curves_n_envs_{n_envs}"] = (learning_curves, group, curves, "environment")
    for environment, group in lines.groupby("environment"):
        if group.n_envs.nunique() > 1:
            name = re.sub(r"\W", "", environment.lower().replace(" ", "_"))
            todo[f"learning_curves_{name}"] = (learning_curves, group, curves, "n_envs")
    return todo


def remove_earlier(out):
    """Removes what an earlier command made in this folder, by its report: it is of other data."""
    report = out / "report.txt"
    first = report.read_text().partition("\n")[0] if report.exists() else ""
    if first.startswith("made: "):
        for name in first.removeprefix("made: ").split(", "):
            for suffix in ("png", "pdf", "csv", "md", "tex"):
                (out / f"{name}.{suffix}").unlink(missing_ok=True)


def draw_results(args):
    """The command `results`: makes all that the runs allow, and reports what is left out."""
    runs, curves = study.runs.load(args.paths, args.env, args.beta, args.n_envs)
    methods, left_out = study.runs.select_methods(runs, args.method)
    runs = methods.pop(args.method)
    need(len(runs) or args.method == "ppo", f"a complete run of the method {args.method}")
    others = [f"{name}: {len(each)} runs" for name, each in methods.items()]
    grid, dropped = study.runs.main_grid(runs)
    parts = [part for _, part in grid.groupby(grid.env_id.isin(COMPLEX))]
    asked = sorted(float(beta) for beta in set(args.beta or []) - {"vanilla"})
    betas = asked or three_betas(grid[~grid.vanilla])
    no_curves = [f"beta {beta:g}" for beta in sorted(set(grid.beta.dropna()) - set(betas))]
    no_curves += ["vanilla PPO, never"] * int(grid.vanilla.any())
    args.out.mkdir(parents=True, exist_ok=True)
    remove_earlier(args.out)
    made, not_made = make_all(results({args.method: runs, **methods}, curves, betas), args.out)
    beside = [claims.outside(made["final_returns"])[-1]] if "final_returns" in made else []
    beside += claims.offset(grid) if "beside_published" in made else []
    mixed = study.runs.mixed_evaluations(runs)
    report = {
        "left out": left_out,
        "of other methods, only where these are compared": others,
        "only where n_steps or n_epochs vary, in no other figure or table": dropped,
        "missing from the grid of these runs": sum(map(study.runs.missing, parts), []),
        "averaged though evaluated differently (the mean is the same)": mixed,
        "not among the learning curves (--beta chooses)": no_curves,
        "not made": not_made,
        "final returns beside the published": beside,
    }
    file, text = args.out / "report.txt", [f"made: {', '.join(made)}"]
    print(f"{args.out}: {', '.join(made)}")
    for title, lines in report.items():
        head, more = f"{title}: {len(lines)}", f"... and {len(lines) - 10} more, see {file}"
        text += ["\n  ".join([head, *lines])]
        print("\n  ".join([head, *lines[:10], *[more] * (len(lines) > 10)]))
    file.write_text("\n".join(text) + "\n")


def parse_args():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    noise = commands.add_parser("noise", help="figures of the noise")
    results = commands.add_parser("results", help="figures and tables of runs")
    sheet = commands.add_parser("environments", help="a frame of each of the paper's environments")
    cars = commands.add_parser("animation", help="untrained policies in Mountain Car, a GIF")
    study.runs.add_runs(results)
    methods = {"default": "ppo", "choices": list(METHOD_LOOK)}
    results.add_argument("--method", **methods, help="which method's runs (default: ppo)")
    noise.add_argument("--beta", nargs="+", type=float, default=BETAS, help="default: the study's")
    cars.add_argument("--beta", nargs="+", type=float, default=[0.0, 0.5, 1.0])
    for command, default, what in (
        (noise, "figures", "folder for figures"),
        (results, "figures", "folder for figures and tables; replaces those of earlier runs"),
        (sheet, "results/environments.png", "the picture's file"),
        (cars, "results/animation.gif", "the picture's file"),
    ):
        command.add_argument("--out", type=Path, default=Path(default), help=what)
    return parser.parse_args()


def main():
    args = parse_args()
    plt.switch_backend("Agg")  # figures are written to files, not shown
    if args.command == "results":
        draw_results(args)
    elif args.command == "noise":
        args.out.mkdir(parents=True, exist_ok=True)
        made, _ = make_all(noise(sorted(set(args.beta))), args.out)
        print(f"{args.out}: {', '.join(made)}")
    elif args.command == "environments":
        contact_sheet().savefig(args.out, dpi=85)
    else:
        animation(args.beta).save(args.out, PillowWriter(fps=15), dpi=100)


if __name__ == "__main__":
    main()
