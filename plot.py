"""Every figure of the study; its tables, from analysis.py, with the published numbers beside ours.

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
from pathlib import Path

import gymnasium as gym
import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, NullLocator
from scipy import stats
from tqdm import tqdm

import analysis
import claims
from analysis import CELL, STUDY_BETAS, Unusable, beta_text, comparable, need
from colored_noise import (
    ColoredNoiseProcess,
    autocovariance,
    colored_noise,
    expected_psd,
    marginal_variance,
    mean_std,
)
from environments import COMPLEX, NAMES, make_render_env, make_vector_env, silence
from ppo_colored_continuous import Agent
from run_files import fail, numpy_policy

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

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
METHOD_NAMES = {"ppo": "PPO", "trpo": "TRPO", "a2c": "A2C"}
METHOD_LOOK = {  # Okabe and Ito's colors, told apart by all
    "ppo": {"color": "#0072B2", "marker": "o"},
    "trpo": {"color": "#D55E00", "marker": "s", "ls": "--"},
    "a2c": {"color": "#000000", "marker": "^", "ls": ":"},
}
STANDARDIZED = "standardized performance\n(mean, 95 % BCa interval)"


def look(beta):
    """Color and marker of a beta in all figures: sequential, color-blind-safe, dark enough."""
    place = np.interp(beta, STUDY_BETAS, range(len(STUDY_BETAS)))
    other = "<>dp8+x"[round(10 * beta) % 7]  # its color may be another beta's
    marker = "v^osDPX*"[round(place)] if beta in STUDY_BETAS else other
    color = plt.get_cmap("plasma")(0.82 * place / (len(STUDY_BETAS) - 1))
    return {"color": color, "marker": marker}


def color(beta):
    return look(beta)["color"]


def extent(runs, of=None):
    """What a figure is made of, for its title; `of`: the runs that they were chosen from."""
    n_envs, count = sorted(runs.n_envs.unique()), runs.environment.nunique()
    text = f"{count} environment{'s'[: count > 1]}, n_envs {', '.join(map(str, n_envs))}"
    cells, left = runs.groupby(CELL).ngroups, 0 if of is None else len(of) - len(runs)
    text += f" ({cells} cells)" * (cells < count * len(n_envs)) + f", {len(runs)} runs"
    return text + f"\n(without {left} runs that lack a counterpart or a second seed)" * (left > 0)


def panels(count, xlabel="", ylabel="", width=2.5, height=1.9):
    """A figure with `count` axes in even rows of at most four, labelled at its left and below.

    Returns the figure and the list of axes.
    """
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
    ax.set_xticks(table.index, [f"{beta:g}" for beta in table.index])


def draw_grid(ax, sizes, title):
    """Markers at n_envs and beta, the area by sizes in [0, 1]; a ring for each n_envs's largest."""
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


def draw_noise(beta, *size):
    """Sequences (*size, 1000), the paper's length, from the same random numbers for each beta."""
    return colored_noise(beta, (*size, 1000), generator=torch.Generator().manual_seed(0))


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


def compare(runs, x, cells, by=None):
    """Performance over x, "beta", "n_envs" or "update_size", with a line per value of column `by`.

    Standardized within each environment, then averaged over seeds within `cells`, and over those
    cells that have all values of x and `by`, with two seeds of each if any has: environments, and
    n_envs (Sec. "Does Colored-Noise Affect the Performance") or betas ("How Does the Number of
    Parallel Collection Environments").
    """
    need(by or runs[x].nunique() > 1, f"at least two values of {x}")
    axes = [x, by] if by else [x]
    chosen = comparable(runs, axes, cells)
    chosen = chosen.assign(z=analysis.standardize(chosen))
    xlabel = {"beta": BETA_NAMED, "update_size": "update size n_envs \u00b7 n_steps"}.get(x, x)
    fig, [ax] = panels(1, xlabel, STANDARDIZED, height=3)
    lines, unknown = [], False
    for i, (value, group) in enumerate(chosen.groupby(by) if by else [("", chosen)]):
        gray = ["0.1", "0.65", "0.4", "0.75"][i % 4] if by else INK
        style = {"color": gray, "ls": ["-", "--", ":", "-."][i % 4], "lw": 1}
        table = analysis.cells_intervals(group, "z", x, cells)
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

    Beside them the ranks that are projected from the bias of the noise, by our best betas and,
    where the runs' protocol is the study's, by the paper's.
    """
    need(runs.beta.nunique() > 1, "at least two betas")
    grid, chosen = analysis.performance_grid(runs)
    lengths = chosen.noise_seq_len.unique()
    need(len(lengths) == 1, "one --noise-seq-len, of all environments: the projection goes by it")
    best = {"our": grid.idxmax()}
    if not analysis.differences(chosen).any():
        best["the paper's"] = (
            analysis.published("best_beta_per_n_envs").set_index("n_envs").best_beta
        )
    axes_of_grid = (grid.index, grid.columns, int(lengths[0]))
    ranks = {"rank of performance within n_envs": -grid}
    for whose, betas in best.items():
        title = f"rank projected from the bias,\nby {whose} best $\\beta$"
        ranks[title] = analysis.projected_ranks(betas, *axes_of_grid).where(grid.notna())
    fig, axes = panels(1 + len(ranks), "n_envs", BETA, width=2.9, height=3.1)
    low, high = np.nanmin(grid), np.nanmax(grid)
    draw_grid(axes[0], ((grid - low) / (high - low or 1)) ** 6, "performance, to the sixth power")
    for ax, (title, order) in zip(axes[1:], ranks.items(), strict=True):
        rank = order.rank()  # 1 the best, of as many betas as this n_envs has
        draw_grid(ax, 1 - (rank - 1) / (rank.count() - 1).clip(lower=1), title)
    title = f"larger is better, ring: best of each n_envs; {extent(chosen, runs)}"
    fig.suptitle(title, fontsize=9)
    return fig


def three_betas(runs):
    """The betas to draw curves of: more than three lines in a panel cannot be told apart."""
    there = sorted(runs.beta.unique())
    first = [beta for beta in (0, 0.5, 1) if beta in there]
    return sorted((first + [beta for beta in there if beta not in first])[:3])


def learning_curves(runs, curves, by):
    """Sec. A10: mean return over training, a panel per value of `by`, a line per beta.

    A band is its interval; open markers at the right end are the published final returns, where
    the runs' protocol is the study's.
    """
    paper = analysis.published("final_return_per_beta").set_index([*CELL, "beta"]).final_return_mean
    as_in_study = analysis.differences(runs) == ""
    fig, axes = panels(runs[by].nunique(), "environment steps", "mean return")
    for ax, (_, group) in zip(axes, runs.groupby(by), strict=True):
        environment, n_envs = group[CELL].iloc[0]
        lines = curves.loc[group.index].dropna(axis=1, how="all")
        end, every = lines.columns[-1], max(1, lines.shape[1] // 6)
        ax.axvline(end, color="0.8", lw=0.8)
        for i, (beta, seeds) in enumerate(group.groupby("beta")):
            line = lines.loc[seeds.index].dropna(axis=1)
            mean, low, high = analysis.mean_interval(line, n_resamples=1000)
            marks = {"markevery": (i * every // 3 % line.shape[1], every), "ms": 4}
            ax.plot(line.columns, mean, **look(beta), **marks)
            ax.fill_between(line.columns, low, high, color=color(beta), alpha=0.2, lw=0)
            if as_in_study[seeds.index].all():
                final = paper.get((environment, n_envs, beta_text(beta)), np.nan)
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
    need(set(methods) - {"ppo"}, "runs of `baselines.py trpo` or `a2c` with n_envs 4")
    groups = {name: runs[runs.method == name] for name in methods if name != "ppo"}
    if len(methods) > 1:
        shared = set.intersection(*(set(runs.beta[runs.method == name]) for name in methods))
        groups["overall"] = analysis.same_protocol(runs[runs.beta.isin(shared)])
    chosen = {}
    for name, group in groups.items():
        try:
            chosen[name] = comparable(group, ["method", "beta"], ["environment"])
        except Unusable:
            continue
    need(chosen, "an environment with all betas of a method")
    fig, axes = panels(len(chosen), BETA, STANDARDIZED, width=3.2, height=2.8)
    for ax, (name, group) in zip(axes, chosen.items(), strict=True):
        group = group.assign(z=analysis.standardize(group))
        for i, (method, part) in enumerate(group.groupby("method")):
            table = analysis.cells_intervals(part, "z", "beta", ["environment"])
            if name == "overall":
                draw_intervals(ax, table.index + 0.03 * (i - 1), table, **METHOD_LOOK[method])
            else:
                draw_betas(ax, table)
        betas = sorted(group.beta.unique())
        labels = betas if len(betas) < 5 else [-1, 0, 0.5, 1, 2]
        ax.set_xticks(labels, [f"{beta:g}" for beta in labels])
        n = group.environment.nunique()
        count = f"{n} environment{'s'[: n > 1]}, {len(group)} runs"
        ax.set_title(f"{name if name == 'overall' else METHOD_NAMES[name]}\n{count}")
    if "overall" in chosen:
        legend_above(fig, *((METHOD_NAMES[name], METHOD_LOOK[name]) for name in methods))
    return fig


def gsde_vs_beta(runs):
    """Sec. A13: gSDE, which has no beta, beside the betas of PPO with colored noise."""
    need((runs.method == "gsde").any(), "runs of `baselines.py gsde`")
    need(runs.beta.notna().any(), "runs with colored noise to compare gSDE with")
    noise = runs.beta.fillna(np.inf)  # inf: gSDE
    as_ppo = {*analysis.STUDY, "bootstrap_timeouts"} - {"method"}
    runs = analysis.same_protocol(runs, sorted(as_ppo)).assign(noise=noise)
    chosen = comparable(runs, ["noise"], CELL)
    chosen = chosen.assign(z=analysis.standardize(chosen))
    table = analysis.cells_intervals(chosen, "z", "noise", CELL)
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
        table = analysis.cells_intervals(group, "performance", "beta", ["n_envs"])
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
            # side by side
            x = cells.n_envs * 2 ** (0.5 * (betas.index(beta) + 0.5) / len(betas) - 0.25)
            open_marker = {"ms": 7, "mfc": "none", "marker": look(beta)["marker"]}
            ax.plot(x, cells.paper, color=color(beta), ls=":", lw=0.9, **open_marker)
            draw_intervals(ax, x, cells, **look(beta), ms=4)
        log2_ticks(ax, table.n_envs)
        ax.set(title=environment, xlim=(table.n_envs.min() / 1.5, table.n_envs.max() * 1.5))
    ours = ("ours, 95 % BCa interval", {"marker": "o", "ms": 4})
    paper = ("paper", {"ls": ":", "lw": 0.9, "marker": "o", "ms": 7, "mfc": "none"})
    legend_above(fig, ours, *[paper] * bool(table.paper.notna().any()), betas=betas)
    return fig


def beside_published(averages, runs):
    """Sec. A14: final returns beside the paper's, of each cell and averaged over environments.

    averages: of `average_final_returns`.
    """
    runs = analysis.on_published_scale(runs)
    cells = analysis.mean_intervals(runs, "final_return", [*CELL, "beta"])
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
        ax.plot(table.index, table.paper, color="0.7", ls=":", lw=0.9)
        for beta, paper in table.paper.items():
            ax.plot(beta, paper, **{**look(beta), "ms": 8, "mfc": "none"})
        draw_betas(ax, table)
        if len(table) > 4:  # or their labels would touch
            ax.set_xticks([-1, 0, 0.5, 1, 2], ["-1", "0", "0.5", "1", "2"])
        count = int(table.environments.iloc[0])
        ax.set_title(f"n_envs {n_envs}, {count} environment{'s'[: count > 1]}")
        ax.set_ylabel("averaged over environments")
    paper = ("paper", {"ls": ":", "lw": 0.9, "marker": "o", "ms": 8, "mfc": "none"})
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


def contact_sheet():
    """A frame of each of the paper's environments, in the order of its figure of them (Sec. A4)."""
    tasks = ["cartpole-balance_sparse", "cartpole-swingup_sparse", "ball_in_cup-catch"]
    tasks += ["hopper-hop", "cheetah-run", "walker-run", "reacher-hard", "pendulum-swingup"]
    ids = ["MountainCarContinuous-v0", *(f"dm_control/{task}-v0" for task in tasks), "door-v0"]
    ids += ["PointUMaze-v1", "AntUMaze-v1", "Point4Rooms-v1", "SwimmerUMaze-v1"]
    ids += ["Swimmer4Rooms-v1", "Ant4Rooms-v1", *COMPLEX]

    def first_frame(env_id):  # a function: this environment's renderer goes before the next one's
        env = make_render_env(env_id)
        env.reset(seed=1)
        frame = env.render()
        env.close()
        height, width, _ = frame.shape
        if env_id.startswith("dm_control/"):
            return frame[:, (width - height) // 2 : (width + height) // 2]
        margin = max(0, width - height) // 2  # Mountain Car's is wide: square with its own sky
        return np.pad(frame, ((margin, margin), (0, 0), (0, 0)), mode="edge")

    fig, axes = plt.subplots(4, 5, figsize=(12, 10.2))
    for ax, env_id in zip(axes.flat, ids, strict=True):
        ax.imshow(first_frame(env_id))
        ax.set(xticks=[], yticks=[])
        ax.set_title(NAMES[env_id], fontsize=12)
        ax.spines[:].set(visible=True, color="0.7")
    return fig


def untrained_positions(beta, n_cars=50, n_steps=999, seed=1):
    """Plays Mountain Car with a policy that has learned nothing, exploring as in training.

    Returns the positions of n_cars cars, (n_steps + 1, n_cars); at the goal they stay there.
    """
    torch.manual_seed(seed)
    policy = numpy_policy(Agent(2, 1).requires_grad_(False).actor_mean)  # its std is 1
    noise = ColoredNoiseProcess(beta, n_cars, 1, seed=seed).sample(n_steps).numpy()
    envs = make_vector_env("MountainCarContinuous-v0", n_cars)
    obs, _ = envs.reset(seed=[seed + i for i in range(n_cars)])
    positions, running = [obs[:, 0].copy()], np.ones(n_cars, bool)
    for eps in noise:
        obs, _, terminated, truncated, infos = envs.step(np.clip(policy(obs) + eps, -1, 1))
        ended = running & (terminated | truncated)
        running &= ~ended
        positions.append(np.where(running, obs[:, 0], positions[-1]))
        for i in np.flatnonzero(ended):
            positions[-1][i] = infos["final_obs"][i][0]
    return np.array(positions)


def animation(betas, n_frames=100, **cars):
    """`untrained_positions` of each beta on the hill, as frames over an episode of 999 steps."""
    goal, runs = 0.45, [untrained_positions(beta, **cars) for beta in betas]
    hill, n_steps = np.linspace(-1.2, 0.6, 200), len(runs[0]) - 1

    def height(x):
        return 0.45 * np.sin(3 * x) + 0.55

    rng = np.random.default_rng(0)
    lift = 0.04 + 0.14 * rng.random(runs[0].shape[1])  # apart from each other, to be seen
    fig, axes = plt.subplots(1, len(betas), figsize=(2.6 * len(betas), 2.1), squeeze=False)
    dots, titles = [], []
    for ax, beta in zip(axes[0], betas, strict=True):
        ax.fill_between(hill, height(hill), color="0.85", lw=0)
        ax.plot([goal] * 2, [0.99, 1.3], color=INK, lw=1.5)
        ax.fill([goal, goal, goal + 0.12], [1.3, 1.18, 1.24], color="#D55E00", lw=0)
        dots += ax.plot([], [], "o", color=color(beta), ms=3.5, alpha=0.7, mew=0)
        titles.append(ax.set_title("\n"))
        ax.set(xlim=(-1.2, 0.62), ylim=(0, 1.4), xticks=[], yticks=[])
        ax.spines[:].set_visible(False)

    def draw(frame):
        step = round(n_steps * frame / (n_frames - 1))
        for beta, positions, dot, title in zip(betas, runs, dots, titles, strict=True):
            x, there = positions[step], (positions[step] >= goal).sum()
            dot.set_data(x, height(x) + lift)
            name = {0: " (white)", 1: " (pink)", 2: " (red)"}.get(beta, "")
            name = f"$\\beta = {beta:g}${name}, step {step}"
            title.set_text(f"{name}\nat the goal: {there} of {len(x)}")

    pause = [n_frames - 1] * 25
    return FuncAnimation(fig, draw, [*range(n_frames), *pause])


# --- Output ---------------------------------------------------------------------------------------


def remove(out, names):
    """Removes figures and tables of these names: an earlier command made them, of other data."""
    for name in names:
        for suffix in ("png", "pdf", "csv", "md", "tex"):
            (out / f"{name}.{suffix}").unlink(missing_ok=True)


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
            remove(out, [name])
            continue
        if isinstance(made[name], pd.DataFrame):
            analysis.save_table(made[name], out, name)
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


def results(methods, curves, betas=None):
    """What `make_all` is to make of runs, from `select_methods`, and their curves.

    Of the first method, but Sec. A7 and A13. betas: to draw curves of, by default at most three.
    """
    runs = next(iter(methods.values()))
    grid, _ = analysis.main_grid(runs)
    studied = {name: analysis.main_grid(each)[0] for name, each in methods.items()}
    studied = {
        name: each[~each.env_id.isin(COMPLEX) & ~each.vanilla] for name, each in studied.items()
    }
    colored = grid[~grid.vanilla]
    study = colored[~colored.env_id.isin(COMPLEX)]  # what the paper averages over
    beyond = runs[~runs.env_id.isin(COMPLEX) & ~runs.vanilla]
    same_epochs = beyond[beyond.n_epochs.isin(grid.n_epochs[:1])]
    same_steps = beyond[beyond.n_steps.isin(grid.n_steps[:1])]
    three = pd.concat([each for name, each in studied.items() if name in METHOD_NAMES])
    with_gsde = pd.concat([each for name, each in studied.items() if name in ("ppo", "gsde")])
    betas = betas or three_betas(colored)
    todo = {
        "best_beta_per_env": (analysis.best_beta_per_env, study),
        "best_beta_per_n_envs": (analysis.best_beta_per_n_envs, study),
        "final_return_and_performance": (analysis.final_return_and_performance, colored),
        "final_returns": (analysis.final_returns, grid),
        "final_return_per_beta": (analysis.final_return_per_beta, "final_returns"),
        "average_final_returns": (analysis.average_final_returns, study),
        "robust_statistics": (analysis.robust_statistics, study),
        "performance_vs_beta": (compare, study, "beta", CELL),
        "performance_vs_n_envs": (compare, study, "n_envs", ["environment", "beta"]),
        "n_envs_beta_grids": (n_envs_beta_grids, study),
        "beta0_vs_vanilla": (beta0_vs_vanilla, grid[~grid.env_id.isin(COMPLEX)]),
        "n_envs_vs_n_steps": (n_envs_vs_n_steps, same_epochs),
        "n_epochs_vs_beta": (n_epochs_vs_beta, same_steps),
        "transfer": (transfer, three[three.n_envs == 4]),
        "complex_tasks": (complex_tasks, colored),
        "gsde_vs_beta": (gsde_vs_beta, with_gsde),
        "coverage": (claims.coverage, methods, curves),
        "final_return_vs_n_envs": (final_return_vs_n_envs, "final_returns", betas),
        "beside_published": (beside_published, "average_final_returns", study),
        "robust_performance": (robust_performance, "robust_statistics"),
    }
    lines = colored[colored.beta.isin(betas)]
    for n_envs, group in lines.groupby("n_envs"):
        todo[f"learning_curves_n_envs_{n_envs}"] = (learning_curves, group, curves, "environment")
    for environment, group in lines.groupby("environment"):
        if group.n_envs.nunique() > 1:
            name = environment.lower().replace(" ", "_")
            name = "".join(c for c in name if c.isalnum() or c == "_")
            todo[f"learning_curves_{name}"] = (learning_curves, group, curves, "n_envs")
    return todo


def parse_args():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    noise = commands.add_parser("noise", help="figures of the noise")
    results = commands.add_parser("results", help="figures and tables of runs")
    sheet = commands.add_parser("environments", help="a frame of each of the paper's environments")
    cars = commands.add_parser("animation", help="untrained policies in Mountain Car, a GIF")
    for each in (parser, noise, results, sheet, cars):
        each.error = lambda message: fail(f"{message} (--help lists the arguments)", code=2)
    analysis.add_runs(results)
    methods = {"default": "ppo", "choices": analysis.METHODS}
    results.add_argument("--method", **methods, help="which method's runs (default: ppo)")
    default = {"default": STUDY_BETAS, "help": "default: those of the study"}
    noise.add_argument("--beta", nargs="+", type=analysis.finite, **default)
    for command in (noise, results):
        folder = "for figures and tables; those of an earlier command are replaced or removed"
        command.add_argument("--out", type=Path, default=Path("figures"), help=f"folder {folder}")
    cars.add_argument("--beta", nargs="+", type=analysis.finite, default=[0.0, 0.5, 1.0])
    for command, name in ((sheet, "environments.png"), (cars, "animation.gif")):
        picture = {"default": Path("results") / name, "help": "the picture's file"}
        command.add_argument("--out", type=Path, **picture)
    return parser.parse_args()


def draw_results(args):
    """The command `results`: makes all, removes what earlier data left there, reports the rest."""
    report = {}
    runs, curves = analysis.load(args.paths, args.env, args.beta, args.n_envs)
    need(
        args.method != "gsde",
        "another --method: gSDE has no beta, and is drawn beside those of PPO",
    )
    methods, report["left out"] = analysis.select_methods(runs, args.method)
    runs = next(iter(methods.values()))
    need(len(runs) or args.method == "ppo", f"a complete run of the method {args.method}")
    others = [f"{name}: {len(each)} runs" for name, each in methods.items() if each is not runs]
    report["of other methods, only where these are compared"] = others
    grid, dropped = analysis.main_grid(runs)
    report["only where n_steps or n_epochs vary, in no other figure or table"] = dropped
    parts = [part for _, part in grid.groupby(grid.env_id.isin(COMPLEX))]
    report["missing from the grid of these runs"] = sum(map(analysis.missing, parts), [])
    mixed = analysis.mixed_evaluations(runs)
    report["averaged though evaluated differently (the mean is the same)"] = mixed
    asked = sorted(float(beta) for beta in set(args.beta or []) - {"vanilla"})
    betas = asked or three_betas(grid[~grid.vanilla])
    others = sorted(set(grid.beta.dropna()) - set(betas))
    others = [f"beta {b:g}" for b in others] + ["vanilla PPO, never"] * int(grid.vanilla.any())
    report["not among the learning curves (--beta chooses)"] = others
    todo = results(methods, curves, betas)
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / "report.txt"
    earlier = file.read_text().partition("\n")[0] if file.exists() else ""
    made, report["not made"] = make_all(todo, args.out)
    finals = made.get("final_returns")
    outside = [] if finals is None else [claims.outside(finals)[-1]]
    outside += claims.offset(grid) if "beside_published" in made else []
    report["final returns beside the published"] = outside
    if earlier.startswith("made: "):
        remove(args.out, set(earlier.removeprefix("made: ").split(", ")) - set(made))
    text = [f"made: {', '.join(made)}"]
    print(f"{args.out}: {', '.join(made)}")
    for title, lines in report.items():
        head, more = f"{title}: {len(lines)}", f"... and {len(lines) - 10} more, see {file}"
        text.append("\n  ".join([head, *lines]))
        print("\n  ".join([head, *lines[:10], *[more] * (len(lines) > 10)]))
    file.write_text("\n".join(text) + "\n")


def main():
    args = parse_args()
    if args.command == "results":
        draw_results(args)
    elif args.command == "noise":
        args.out.mkdir(parents=True, exist_ok=True)
        made, _ = make_all(noise(sorted({beta + 0.0 for beta in args.beta})), args.out)
        print(f"{args.out}: {', '.join(made)}")
    else:
        types = ["gif"] if args.command == "animation" else FigureCanvasBase.filetypes
        if args.out.suffix[1:] not in types or not args.out.parent.is_dir():
            ends = "in .gif " if args.command == "animation" else "as a picture's does "
            raise Unusable(f"--out {args.out} has to end {ends}and be in a folder that exists")
        silence()
        if args.command == "animation":
            animation(args.beta).save(args.out, PillowWriter(fps=15), dpi=100)
        else:
            contact_sheet().savefig(args.out, dpi=85)


if __name__ == "__main__":
    try:
        main()
    except (Unusable, OSError, gym.error.Error) as error:
        fail(error)
