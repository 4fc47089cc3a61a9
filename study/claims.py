"""What the paper claims, and what our runs say about it: holds, does not, or open.

`coverage` makes the table of all figures, tables and claims of "Colored Noise in PPO" (AAAI 2024)
that `python plot.py results` writes; `outside` counts published means that our intervals miss.

A claim "holds" only where a 95 % interval excludes the contrary, and "does not" only where it
excludes the claim; else it is "open". An average is always open with one seed, with less than half
of the environments it is about, or, where it is over n_envs or betas too, less than three of them.
That two are the same means that they differ by less than MARGIN; that something does not happen,
that it does in less than RARE of runs. The environments that are here count as a sample of the
paper's, see `contrast`, though it may be the cheap ones. Only runs with the study's settings count.

A test takes the runs of a claim, with standardized performance `z` (see `claim_runs`), and returns
the verdict and a text with the numbers behind it.
"""

import itertools
from functools import partial

import numpy as np
import pandas as pd
from scipy import stats

from colored_noise import autocovariance, mean_std
from study.protocol import BETAS, COMPLEX, N_ENVS, NAMES, SETTINGS
from study.runs import (
    AXES,
    CELL,
    SHARED,
    Unusable,
    comparable,
    differences,
    main_grid,
    need,
    value_text,
)
from study.statistics import contrast, interval, standardize, summed, weighted
from study.tables import best_beta_per_env, final_returns, on_published_scale, projected_ranks

# Chance that the 95 % BCa interval of so many seeds misses the mean of 20 others, as the published
# means are: 4000 normal samples each, numpy's generator with seed 0; interpolated in between. The
# true mean it misses with chance 0.28, 0.16, 0.09 and 0.06 for 3, 5, 10 and 20 seeds, not 0.05.
MISSES = {2: 0.507, 3: 0.302, 4: 0.240, 5: 0.191, 6: 0.186, 10: 0.164, 20: 0.176}
MARGIN = 0.25  # standard deviations of performance within which two are the same
NONE = "no runs that can be compared"
RARE = 0.1  # share of runs below which something never happens
OVER = ["environment", "beta"]  # cells of averages over the betas
LEAD = {"what": "lead of 0.5 over 0", "weights": {0.5: 1, 0.0: -1}, "by": "beta"}


# --- Beside the published means -------------------------------------------------------------------


def outside(table):
    """How many published means our intervals miss, how many chance would, and a line that says so.

    table: of `final_returns`. Only cells with an interval and a published mean count.
    """
    known = table[table.in_interval.isin(["yes", "no"])]
    missed = int((known.in_interval == "no").sum())
    chance = np.interp(known.runs.to_numpy(float), list(MISSES), list(MISSES.values())).sum()
    seeds = [f"{cells} of {n} seeds" for n, cells in known.runs.value_counts().sort_index().items()]
    line = f"{missed} of {len(known)} published means outside our 95 % intervals, "
    line += f"{chance:.1f} expected by chance ({', '.join(seeds) or 'no cells'})"
    return missed, chance, line


def offset(runs):
    """Lines that say how far our final returns are from the published means, and in what tasks.

    On the scale of `on_published_scale`, over cells of two seeds and more. The interval is by
    seeds, of which the paper's 20 are taken to scatter as ours do: too narrow where few seeds of an
    all-or-nothing task all end alike.
    """
    groups = on_published_scale(runs[~runs.vanilla]).groupby([*CELL, "beta"])
    returns = groups.final_return
    table = pd.DataFrame({"less": returns.mean() - groups.paper.first(), "variance": returns.var()})
    table = table.assign(seeds=groups.seed.nunique())
    table = table[table.seeds > 1]
    if table.empty:
        return ["ours less the published: no cell with two seeds"]
    by_cell = table.variance * (1 / table.seeds + 1 / 20) / len(table) ** 2
    mean = table.less.mean()
    low, high = interval({"mean": mean} | summed(by_cell, table.seeds - 1))
    line = f"ours less the published {mean:z.2f} [{low:z.2f}, {high:z.2f}] on average over "
    line += f"{len(table)} cells, where the paper's lowest is 0 and its highest 1"
    tasks = table.groupby("environment").less.agg(["mean", "size"]).sort_values("mean")
    each = [f"{name} {mean:z.2f} ({size} cells)" for name, mean, size in tasks.itertuples()]
    return [line, ", ".join(each)]


# --- Verdicts -------------------------------------------------------------------------------------


def words(what, found, alpha=0.05):
    low, high = interval(found, alpha)
    text = f"{what} {found['mean']:z.2f}"
    text += ", no interval" if np.isnan(low) else f" [{low:z.2f}, {high:z.2f}]"
    return f"{text} ({found['made_of']}{'' if found['enough'] else ': too few'})"


def judge(low, high, least=0.0, most=np.inf):
    """Verdict on "it is between least and most", of which low and high are the interval."""
    if low > least and high < most:
        return "holds"
    return "does not" if high < least or low > most else "open"


def between(runs, what, weights, by, cells=("environment",), least=0.0, most=np.inf):
    """Verdict on "the contrast is between least and most"; without these: it is positive."""
    found = contrast(runs, weights, by, cells)
    if not found["environments"]:
        return "open", NONE
    verdict = judge(*interval(found), least, most) if found["enough"] else "open"
    return verdict, words(what, found)


def same(runs, weights, by, cells=("environment",)):
    """Verdict on contrasts that the claim says are none. weights: a dict for each."""
    claims = [between(runs, "difference", w, by, cells, -MARGIN, MARGIN) for w in weights]
    return ("open", NONE) if ("open", NONE) in claims else both(*claims)


def both(*claims):
    """All claims (verdict, text) hold, or one does not, or it is open."""
    verdicts = {verdict for verdict, _ in claims}
    text = "; ".join(dict.fromkeys(text for _, text in claims))
    if "does not" in verdicts:
        return "does not", text
    return "holds" if verdicts == {"holds"} else "open", text


def best(runs, winner, rivals, by, **more):
    """Verdict on "winner has the highest mean": ahead of every rival, all of them there.

    It does not where it is behind one, by an interval as wide as the number of rivals asks for.
    """
    rivals = [rival for rival in rivals if rival != winner]
    leads = {rival: contrast(runs, {winner: 1, rival: -1}, by, **more) for rival in rivals}
    leads = {rival: found for rival, found in leads.items() if found["environments"]}
    if not leads:
        return "open", NONE
    second = min(leads, key=lambda rival: leads[rival]["mean"])
    enough = [found for found in leads.values() if found["enough"]]
    verdict = "open"
    if any(interval(found, 0.05 / len(leads))[1] < 0 for found in enough):
        verdict = "does not"
    elif len(enough) == len(rivals) and all(interval(found)[0] > 0 for found in enough):
        verdict = "holds"
    there = f" (of {len(leads)} of {len(rivals)} rivals)" * (len(leads) < len(rivals))
    what = f"lead of {value_text(winner)} over the next, {value_text(second)}{there}:"
    return verdict, words(what, leads[second])


def named(runs, *columns):
    """The runs with `cell`, text of the values of these columns, such as "0.5, 4"."""
    texts = [runs[column].map(value_text) for column in columns]
    return runs.assign(cell=[", ".join(each) for each in zip(*texts, strict=True)])


# --- Tests: what is compared for each claim -------------------------------------------------------


def rises(values, what):
    """Verdict on "it rises with beta". values: one for each of BETAS."""
    text = ", ".join(f"{beta:g}: {value:z.2f}" for beta, value in zip(BETAS, values, strict=True))
    return ("holds" if (np.diff(values) > 0).all() else "does not"), f"{what} at beta {text}"


def noise_is_correlated():
    """Closed forms. White noise's is 0, so where it rises it is positive for beta > 0."""
    lags = [autocovariance(beta, 1000) for beta in BETAS]
    return rises([float(lag[1] / lag[0]) for lag in lags], "two-step correlation")


def bias_spreads():
    std = mean_std(np.array(BETAS, float), 1000).numpy()
    return rises(std, "standard deviation of a sequence's mean")


def two_and_four_best(runs):
    rest = [n for n in N_ENVS if n not in (2, 4)]
    return both(*(best(runs, n, rest, "n_envs", cells=OVER) for n in (2, 4)))


def best_configuration(runs):
    cells = [f"{beta:g}, {n}" for beta in BETAS for n in N_ENVS]
    return best(named(runs, "beta", "n_envs"), "0.5, 4", cells, "cell")


def color_matters(runs):
    """Some beta does better than some other; the two furthest apart are shown.

    Their interval is as wide as the number of pairs asks for.
    """
    pairs = list(itertools.permutations(sorted(runs.beta.unique()), 2))
    found = {pair: contrast(runs, {pair[0]: 1, pair[1]: -1}, "beta", CELL) for pair in pairs}
    found = {pair: each for pair, each in found.items() if each["environments"]}
    if not found:
        return "open", NONE
    alpha = 0.1 / len(pairs)  # each pair is there in both orders
    apart = [each["enough"] and interval(each, alpha)[0] > 0 for each in found.values()]
    first, second = max(found, key=lambda pair: (found[pair]["enough"], found[pair]["mean"]))
    text = words(f"{first:g} over {second:g}", found[first, second], alpha)
    return ("holds" if any(apart) else "open"), text


def ahead_in(runs, beta):
    """In how many environments beta is ahead of white noise and behind it, of all tested."""
    found = [
        contrast(group, {beta: 1, 0.0: -1}, "beta", CELL, of=1)
        for _, group in runs.groupby("environment")
    ]
    ends = [interval(each, 0.05 / len(found)) for each in found if each["environments"]]
    ahead, behind = sum(low > 0 for low, _ in ends), sum(high < 0 for _, high in ends)
    where = f"in {ahead}, behind in {behind} of {len(ends)} environments"
    return ahead, behind, f"beta {beta:g} ahead of 0 {where}"


def best_beta_varies(runs):
    """In one environment pink noise does better than white, in another worse."""
    ahead, behind, text = ahead_in(runs, 1.0)
    return ("holds" if ahead and behind else "open"), text


def ahead_in_most(runs):
    """In more than half of the sixteen environments 0.5 does better than white noise."""
    ahead, behind, text = ahead_in(runs, 0.5)
    return ("holds" if ahead > 8 else "does not" if behind >= 8 else "open"), text


def comparable_counts(runs, draws=300):
    """Table 1: beta 0.5 is comparable with the best in more environments than 0 and 1 are.

    How often a test finds a difference depends on the number of seeds, so the counts, 11, 8 and 7
    of 16, are not compared, but their order is: by seeds drawn anew within cells, in all 16
    environments with at least three n_envs.
    """
    rng, betas, counts = np.random.default_rng(0), [0.5, 0.0, 1.0], np.zeros((draws, 3), int)
    table = best_beta_per_env(runs).iloc[-1]
    text = ", ".join(f"{beta:g}: {table[f'beta_{beta}']}" for beta in betas)
    text = f"comparable with the best {text} environments (paper 11, 8, 7 of 16)"
    for _, group in runs.groupby("environment"):
        cells = group.groupby(["beta", "n_envs"]).performance.apply(np.array).unstack()
        cells = cells.dropna(axis=1)
        cells = cells.loc[:, cells.map(len).min() > 1]
        if cells.shape[1] < 3 or not {*betas} <= {*cells.index} or runs.environment.nunique() < 16:
            return "open", text
        counts += comparable_in_draws(cells, betas, draws, rng)
    ends = np.percentile(counts[:, :1] - counts[:, 1:], [2.5, 97.5], axis=0).T
    return both(*((judge(*each), text) for each in ends))


def comparable_in_draws(cells, betas, draws, rng):
    """Whether each beta is comparable with the best, by Welch's test, in draws of the seeds.

    cells: of one environment, betas by n_envs, each the performance of its seeds, (seeds,).
    Returns (draws, betas).
    """
    sides = []
    for samples in cells.to_numpy():  # each beta's
        x = [s[rng.integers(len(s), size=(draws, len(s)))] for s in samples]
        x, w = np.hstack(x), np.repeat([1 / len(s) for s in samples], [len(s) for s in samples])
        sides.append(np.broadcast_arrays(*weighted(x, w)))
    sides = np.array(sides)  # (all betas, 3, draws): mean, standard deviation, size
    leader = sides[sides[:, 0].argmax(0), :, np.arange(draws)].T
    found = []
    for beta in betas:
        side = sides[cells.index.get_loc(beta)]
        with np.errstate(all="ignore"):
            p = stats.ttest_ind_from_stats(*leader, *side, equal_var=False).pvalue
        found.append(~(p < 0.05) | (leader[0] == side[0]))
    return np.stack(found, axis=1)


def drawn_grids(runs, draws=1000):
    """Sec. "[...] Interact": standardized performance by beta and n_envs, drawn anew.

    Environments, unless all 16 are there, and seeds within cells, one less than there are, which
    makes the variance right (Rao and Wu 1988). Of the n_envs with three betas that half of the
    environments have, and of the betas that all of these have. Returns the grid, (betas, n_envs),
    and the draws, (draws, betas, n_envs).
    """
    runs = runs[runs.groupby(["environment", "beta", "n_envs"]).z.transform("size") > 1]
    runs = runs[runs.groupby(["beta", "n_envs"]).environment.transform("nunique") >= 8]
    runs = runs[runs.groupby("n_envs").beta.transform("nunique") > 2]
    need(len(runs), "two seeds of three betas in eight environments")
    runs = runs[runs.groupby("beta").n_envs.transform("nunique") == runs.n_envs.nunique()]
    need(len(runs), "three betas at each of three n_envs")
    runs = comparable(runs, ["beta", "n_envs"], ["environment"])
    cells = runs.groupby(["environment", "beta", "n_envs"]).z.apply(np.array)
    E, grid = runs.environment.nunique(), cells.map(np.mean).groupby(level=[1, 2]).mean().unstack()
    need(grid.notna().all(axis=None) and min(grid.shape) > 2, "three betas at each of three n_envs")
    need(E >= 8, "eight environments with all betas and n_envs that eight have")
    rng = np.random.default_rng(0)
    z = [x[rng.integers(len(x), size=(draws, len(x) - 1))].mean(1) for x in cells]
    z = np.array(z).reshape(E, -1, draws)
    if E < 16:
        z = z[rng.integers(E, size=(E - 1, draws)), :, np.arange(draws)].transpose(0, 2, 1)
    return grid, z.mean(0).T.reshape(draws, *grid.shape)


def larger_n_envs_larger_beta(runs):
    """The best beta's slope over log2 n_envs is positive."""
    grid, drawn = drawn_grids(runs)
    slopes = slope_weights(grid.columns)
    slope = grid.idxmax().to_numpy() @ slopes
    ends = np.percentile(grid.index.to_numpy()[drawn.argmax(1)] @ slopes, [2.5, 97.5])
    ends = ends.round(9)  # 0 where the best beta is the same at all n_envs, not 1e-17
    found = ", ".join(f"{n}: {beta:g}" for n, beta in grid.idxmax().items())
    text = f"best beta per doubling {slope:z.2f} [{ends[0]:z.2f}, {ends[1]:z.2f}]"
    return judge(*ends), f"{text}; at n_envs {found}"


def slope_weights(n_envs):
    """Weights (n,) with which values at n_envs, summed, give their slope over log2 n_envs."""
    x = np.log2(np.asarray(n_envs))
    x = x - x.mean()
    return x / (x**2).sum()


def ranks_as_projected(runs):
    """Sec. "Why Do Larger beta Work Better": correlation of our ranks and the projected.

    Of how each beta's rank changes with n_envs: its mean rank is taken off both. A beta that is
    good with any n_envs would be projected to be good, too, whatever the bias does.
    """
    grid, drawn = drawn_grids(runs)
    grids, betas = np.concatenate([grid.to_numpy()[None], drawn]), grid.index.to_numpy()
    best, which = np.unique(grids.argmax(1), axis=0, return_inverse=True)
    best = [pd.Series(betas[each], grid.columns) for each in best]
    projected = np.array([projected_ranks(each, betas, grid.columns) for each in best])[which]
    a, b = (x - x.mean(2, keepdims=True) for x in (stats.rankdata(-grids, axis=1), projected))
    norm = np.sqrt((a**2).sum((1, 2)) * (b**2).sum((1, 2)))
    r = (a * b).sum((1, 2)) / np.where(norm > 0, norm, 1)  # 0 where no rank changes
    ends = np.percentile(r[1:], [2.5, 97.5])
    text = f"correlation of the changes of rank {r[0]:z.2f} [{ends[0]:z.2f}, {ends[1]:z.2f}]"
    return judge(*ends), text


def more_n_envs_worse(runs):
    """The slope of performance over log2 n_envs, from 4 on, is negative."""
    there = runs.groupby("n_envs").environment.nunique()
    n = there.index[(there >= 8) & (there.index >= 4)].to_numpy()
    if len(n) < 2:
        return "open", NONE
    what = f"loss per doubling, n_envs {', '.join(map(str, n))}:"
    return between(runs, what, dict(zip(n, -slope_weights(n), strict=True)), "n_envs", OVER)


def pink_gains_with_n_envs(runs):
    """Sec. A10: beta 1's lead over the mean of 0 and 0.5 has a positive slope over log2 n_envs."""
    sizes, shares = (1, 4, 32), {0: -0.5, 0.5: -0.5, 1: 1.0}
    slopes = dict(zip(sizes, slope_weights(sizes), strict=True))
    weights = {f"{b:g}, {n}": x * y for b, x in shares.items() for n, y in slopes.items()}
    return between(named(runs, "beta", "n_envs"), "gain per doubling", weights, "cell")


def less_in_a2c(runs):
    """Each method's performance is standardized by itself."""
    z = pd.concat([standardize(group) for _, group in runs.groupby("method")])
    runs = named(runs.assign(z=z), "method", "beta")
    weights = {"trpo, 0.5": 1, "trpo, 0": -1, "a2c, 0.5": -1, "a2c, 0": 1}
    return between(runs, "lead in TRPO less that in A2C", weights, "cell")


def a2c_learns_less(runs):
    """At the betas that both methods have."""
    weights = {name: {name: 1, "a2c": -1} for name in ("ppo", "trpo")}
    found = [between(runs, f"{name} over a2c", w, "method", OVER) for name, w in weights.items()]
    return both(*found)


def hardly_found(runs):
    """The goal gives 100, and all else costs: a run has found it if it ends above 0."""
    count, n = int((runs.final_return > 0).sum()), len(runs)
    low, high = stats.binomtest(count, n).proportion_ci()
    text = f"white noise finds the goal in {count} of {n} runs, share {low:.2f} to {high:.2f}"
    return judge(low, high, -1, RARE), text


def no_collapse(runs):
    """Fewer than RARE of the runs end below half of what they had gained.

    Of means over a tenth of the evaluations: the last one's, the best, and the first. It holds
    only with all betas of the study, as the reddest are the likeliest to.
    """
    lost = (runs["last"] < (runs["first"] + runs["top"]) / 2).astype(float)
    found = contrast(runs.assign(z=lost, every=1), {1: 1}, "every")
    low, high = interval(found)
    share = stats.binomtest(int(lost.sum()), len(lost)).proportion_ci()
    low, high = max(low, 0), max(high, share.high)
    verdict = judge(low, high, -1, RARE) if found["enough"] else "open"
    betas = sorted(runs.beta.unique())
    if verdict == "holds" and betas != sorted(BETAS):
        verdict = "open"
    text = f"half lost by {lost.sum():g} of {len(lost)} runs, share at most {high:.2f}"
    return verdict, f"{text} (beta {', '.join(f'{beta:g}' for beta in betas)})"


def pendulum(runs):
    found = []
    for n, beta in ((1, 0), (4, 0.5), (32, 1)):
        verdict, text = best(runs[runs.n_envs == n], beta, [0, 0.5, 1], "beta", of=1)
        found.append((verdict, f"n_envs {n}: {text}"))
    return both(*found)


def same_preference(runs):
    """The lead of 0.5 over the mean of 0.2 and 0.75 is the same with 5 and 20 epochs as with 10."""
    shares = {0.5: 1, 0.2: -0.5, 0.75: -0.5}
    weights = [
        {f"{b:g}, {n}": x * y for b, x in shares.items() for n, y in ((other, 1), (10, -1))}
        for other in (5, 20)
    ]
    return same(named(runs, "beta", "n_epochs"), weights, "cell")


def published_final_returns(runs):
    """More published means outside than chance would have in 97.5 % of cases: does not."""
    table = final_returns(runs)
    missed, chance, line = outside(table)
    n = int(table.in_interval.isin(["yes", "no"]).sum())
    return ("does not" if n and missed > stats.binom.ppf(0.975, n, chance / n) else "open"), line


# --- The table ------------------------------------------------------------------------------------


def usable_runs(methods, curves):
    """All methods' runs with the study's settings on its tasks: one table.

    methods, curves: of `select_methods` and `load`. Adds `noise`, text of beta or "gsde"; and
    `first`, `top` and `last` of `no_collapse`.
    """
    kept = []
    for name, runs in methods.items():
        own = SHARED if name in ("trpo", "a2c") else {*SETTINGS} - {"method", "n_steps", "n_epochs"}
        runs = runs if name == "ppo" else main_grid(runs)[0]
        kept.append(runs[(differences(runs, own) == "") & runs.env_id.isin(list(NAMES))])
    runs = pd.concat(kept)
    returns = curves.loc[runs.index].dropna(axis=1, how="all")
    returns = returns.T.rolling(max(1, returns.shape[1] // 10)).mean().dropna().T
    if returns.shape[1]:
        first, last = returns.iloc[:, 0], returns.iloc[:, -1]
        runs = runs.assign(first=first, top=returns.max(axis=1), last=last)
    return runs.assign(noise=runs.beta.map("{:g}".format).where(runs.method != "gsde", "gsde"))


def claim_runs(methods, curves):
    """The runs that each claim is about: {name: (runs, how many the paper has)}.

    Of `usable_runs`, with `z`, standardized performance: within each environment, over the runs of
    that name.
    """
    runs = usable_runs(methods, curves)
    hard, four = runs.env_id.isin(COMPLEX), runs.n_envs == 4
    ppo = (runs.method == "ppo") & runs.n_envs.isin(N_ENVS)
    usual = ppo & (runs.n_steps == 2048) & (runs.n_epochs == 10)
    colors = runs.beta.isin(BETAS) & ~runs.vanilla
    main, white = usual & colors & ~hard, usual & ~hard & (runs.vanilla | (runs.beta == 0))
    three = main & runs.beta.isin([0, 0.5, 1]) & runs.n_envs.isin([1, 4, 32])
    trpo, a2c = ((runs.method == name) & four & colors & ~hard for name in ("trpo", "a2c"))
    few = runs.beta.isin([0.2, 0.5, 0.75]) & runs.n_epochs.isin([5, 10, 20])
    size = ppo & colors & (runs.beta == 0.5) & (runs.n_epochs == 10) & runs.n_envs.isin([2, 4, 8])
    chosen = {
        "main": (main, 20480),
        "all": (usual & ~hard & (colors | runs.vanilla), 23040),
        "vanilla": (white, 5120),
        "car": (white & (runs.environment == "Mountain Car"), 320),
        "trpo": (trpo, 2560),
        "a2c": (a2c, 2560),
        "both": (trpo | a2c, 5120),
        "methods": (trpo | a2c | main & four, 7680),
        "complex": (usual & colors & hard & four, 640),
        "n_envs 4": (main & four, 2560),
        "pendulum": (three & (runs.environment == "Pendulum Swingup"), 180),
        "three": (three, 2880),
        "n_steps": (size & ~hard & (runs.n_envs * runs.n_steps == 8192), 960),
        "n_epochs": (ppo & colors & few & ~hard & four & (runs.n_steps == 2048), 2880),
        "gsde": (main | (runs.method == "gsde") & runs.n_envs.isin(N_ENVS) & ~hard, 23040),
    }
    parts = {name: (runs[mask], total) for name, (mask, total) in chosen.items()}
    return {name: (part.assign(z=standardize(part)), n) for name, (part, n) in parts.items()}


# fmt: off
CLAIMS = [  # where, what it shows or says, preset, file, name of its runs, test
    ("Fig. 1", "random walks", "noise", "noise_random_walks", None, None),
    ("Sec. Colored Noise", "expected PSD", "noise", "noise_psd", None, None),
    ("Fig. 2", "the environments", "environments", "results/environments.png", None, None),
    ("Introduction", "colored noise does better than white in most environments", "main",
     "best_beta_per_env", "main", ahead_in_most),
    ("Fig. 3", "the color of the noise affects performance", "main", "performance_vs_beta", "main",
     color_matters),
    ("Fig. 3", "beta 0.5 outperforms white noise", "main", "performance_vs_beta", "main",
     partial(between, **LEAD, cells=CELL)),
    ("Fig. 3, conclusion i", "beta 0.5 is best on average", "main", "performance_vs_beta", "main",
     partial(best, winner=0.5, rivals=BETAS, by="beta", cells=CELL)),
    ("Table 1", "the best beta depends on the environment", "main", "best_beta_per_env", "main",
     best_beta_varies),
    ("Table 1, conclusion ii", "0.5, 0, 1 comparable with the best in 11, 8, 7 of 16: in most for "
     "0.5", "main", "best_beta_per_env", "main", comparable_counts),
    ("Fig. 4, conclusion iii", "n_envs 4 is best on average", "main", "performance_vs_n_envs",
     "main", partial(best, winner=4, rivals=N_ENVS, by="n_envs", cells=OVER)),
    ("Conclusion iii", "n_envs 2 and 4 outperform all others", "main", "performance_vs_n_envs",
     "main", two_and_four_best),
    ("Fig. 4", "more environments than 4 do worse", "main", "performance_vs_n_envs", "main",
     more_n_envs_worse),
    ("Fig. 5, conclusion iv", "larger n_envs wants larger beta", "main", "n_envs_beta_grids",
     "main", larger_n_envs_larger_beta),
    ("Fig. 5", "beta 0.5 with n_envs 4 is the best configuration", "main", "n_envs_beta_grids",
     "main", best_configuration),
    ("Fig. 6", "a sequence's mean spreads more with larger beta", "noise", "noise_bias", None,
     bias_spreads),
    ("Fig. 7, conclusion v", "ranks follow those projected from the bias", "main",
     "n_envs_beta_grids", "main", ranks_as_projected),
    ("Fig. A1", "subsequent steps are correlated where beta > 0, more with larger beta", "noise",
     "noise_two_step", None, noise_is_correlated),
    ("Fig. A1", "each step is Gaussian", "noise", "noise_marginal", None, None),
    ("Table A2", "best beta per n_envs", "main", "best_beta_per_n_envs", "main", None),
    ("Fig. A6", "beta 0 matches vanilla PPO", "main, vanilla", "beta0_vs_vanilla", "vanilla",
     partial(same, weights=[{True: 1, False: -1}], by="vanilla", cells=CELL)),
    ("Fig. A7a", "beta 0.5 improves TRPO", "transfer", "transfer", "trpo",
     partial(between, **LEAD)),
    ("Fig. A7b", "beta 0.5 improves A2C", "transfer", "transfer", "a2c",
     partial(between, **LEAD)),
    ("Fig. A7", "the effect is less in A2C", "transfer", "transfer", "both", less_in_a2c),
    ("Fig. A7c", "A2C learns less than PPO and TRPO", "main, transfer", "transfer", "methods",
     a2c_learns_less),
    ("Fig. A8", "beta 0.5 is favored in complex tasks", "complex", "complex_tasks", "complex",
     partial(best, winner=0.5, rivals=BETAS, by="beta", of=4)),
    ("Table A9", "final return and performance, mean and maximum", "main",
     "final_return_and_performance", "main", None),
    ("Sec. A10", "learning Mountain Car requires correlated noise", "main, vanilla",
     "learning_curves_mountain_car", "car", hardly_found),
    ("Sec. A10", "policies do not collapse", "main", "learning_curves_n_envs_4", "n_envs 4",
     no_collapse),
    ("Sec. A10", "Pendulum Swingup: beta 0, 0.5, 1 best with n_envs 1, 4, 32", "main",
     "learning_curves_pendulum_swingup", "pendulum", pendulum),
    ("Sec. A10", "learning curves, beta 0, 0.5 and 1, n_envs 1, 4 and 32", "main",
     "learning_curves_n_envs_*", "three", None),
    ("Sec. A10", "beta 1 gains with larger n_envs", "main", "learning_curves_n_envs_*", "three",
     pink_gains_with_n_envs),
    ("Fig. A11", "n_envs and n_steps do not matter if their product stays", "main, n_steps",
     "n_envs_vs_n_steps", "n_steps", partial(same, by="n_steps", weights=[
         {4096: 1, 2048: -1}, {1024: 1, 2048: -1}, {4096: 1, 1024: -1}])),
    ("Fig. A12", "half the epochs do worse", "n_epochs", "n_epochs_vs_beta", "n_epochs",
     partial(between, what="10 epochs over 5", weights={10: 1, 5: -1}, by="n_epochs", cells=OVER)),
    ("Fig. A12", "the preference for 0.5 is the same with 5, 10 and 20 epochs", "n_epochs",
     "n_epochs_vs_beta", "n_epochs", same_preference),
    ("Fig. A13", "gSDE is like beta 1.25 to 2", "main, gsde", "gsde_vs_beta", "gsde",
     partial(same, weights=[{"gsde": 1, "1.25": -0.5, "2": -0.5}], by="noise", cells=CELL)),
    ("Table A14", "final returns", "main, vanilla", "final_return_per_beta", "all",
     published_final_returns),
]
# fmt: on


def coverage(methods, curves):
    """Every figure, table and claim of the paper: what makes it, how much is here, what that says.

    methods, curves: of `select_methods` and `load`. Returns a DataFrame with a row per claim of
    CLAIMS; `verdict` as at the top of this file, `data` the numbers behind it, `runs` how many
    there are, with 20 seeds a cell at most.
    """
    parts, table = claim_runs(methods, curves), []
    for where, says, presets, file, name, test in CLAIMS:
        runs, total = parts.get(name, (None, 0))
        verdict, data = tested(test, runs)
        command, count = f"python plot.py {presets}", "none needed"
        if name:
            cell = ["method", *AXES[:-1]]
            here = runs.groupby(cell, dropna=False).seed.nunique().clip(upper=20).sum()
            count = f"{here} of {total}"
            sweeps = [f"./run_sweep.sh {preset}" for preset in presets.split(", ")]
            command = "; ".join([*sweeps, "python plot.py results runs/"])
        table.append([where, says, verdict, data, count, command, file])
    columns = ["where", "says", "verdict", "data", "runs", "command", "file"]
    return pd.DataFrame(table, columns=columns)


def tested(test, runs):
    """Verdict and text of a claim's test; blank without one. runs: None where it needs none."""
    if test is None:
        return "", ""
    if runs is None:
        return test()
    if runs.empty:
        return "open", "no runs"
    try:
        return test(runs)
    except Unusable as error:
        return "open", str(error)
