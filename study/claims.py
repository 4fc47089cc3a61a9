"""What the paper claims, and what our runs say about it: holds, does not, or open.

`coverage` makes the table of all figures, tables and claims of "Colored Noise in PPO" (AAAI 2024)
that `python plot.py results` writes; `outside` counts published means that our intervals miss.

A claim is that a number lies between `least` and `most`: a difference above 0, or, where two are
said to be the same, within MARGIN. It "holds" only where the number's 95 % interval is between
them, "does not" only where it is outside, and else is "open"; then `decides` says what would
decide it. An average is always open with one seed, with less than half of the environments it is
about, or, where it is over n_envs or betas too, less than three of them. The environments that are
here count as a sample of the paper's, see `contrast`, though it may be the cheap ones. Only runs
with the study's settings count, and of its grid only what half of the environments have, or else
most: runs of a few environments neither support nor weaken what is said of all.

A test takes the runs of a claim, with standardized performance `z` (see `claim_runs`), and returns
a Finding.
"""

import dataclasses
import itertools
from functools import partial

import numpy as np
import pandas as pd
from scipy import stats

from study.protocol import BETAS, COMPLEX, N_ENVS, NAMES, SETTINGS
from study.runs import AXES, CELL, SHARED, Unusable, differences, main_grid, published, value_text
from study.statistics import contrast, interval, interval_text, less_published, standardize
from study.tables import best_beta_per_env, final_returns, on_published_scale, projected_ranks

# Chance that the 95 % BCa interval of so many seeds misses the mean of 20 others, as the published
# means are: 4000 normal samples each, numpy's generator with seed 0; interpolated in between. The
# true mean it misses with chance 0.16, 0.09 and 0.06 for 5, 10 and 20 seeds, not 0.05. Of fewer and
# of more seeds, whose intervals are nearly exact: see `outside`.
MISSES = {5: 0.191, 6: 0.186, 10: 0.164, 20: 0.176}
MARGIN = 0.25  # standard deviations of performance within which two are the same
RARE = 0.1  # share of runs below which something never happens
OVER = ["environment", "beta"]  # cells of averages over the betas
# How betas fare with n_envs had been looked at in these environments before the tests of Fig. 5, 7
# and A10 took their form: the others decide
SEEN = ["4 Rooms Point", "Cartpole Balance", "Cartpole Swingup", "Cheetah Run", "Hopper Hop"]
SEEN += ["Mountain Car", "Pendulum Swingup", "Reacher Hard", "UMaze Point"]
HALF_OVER_WHITE = {0.5: 1, 0.0: -1}
OVER_0_2_AND_0_75 = {0.5: 1, 0.2: -0.5, 0.75: -0.5}
CONFIGURATIONS = list(itertools.product(BETAS, N_ENVS))
LEAD = {"what": "lead of 0.5 over 0", "weights": HALF_OVER_WHITE, "by": "beta"}


# --- Beside the published means -------------------------------------------------------------------


def outside(table):
    """How many published means our intervals miss, of how many, how many chance would, and a line.

    table: of `final_returns`. Only cells with a published mean and some scatter count: where all
    runs end alike, as at the largest return that there is, nothing is expected by chance.
    """
    known = table[table.in_interval.isin(["yes", "no"]) & (table.high > table.low)]
    missed = int((known.in_interval == "no").sum())
    n = known.runs.to_numpy(float)
    exact = 2 * stats.norm.sf(1.96 * (20 / (20 + n)) ** 0.5)
    some = (n >= min(MISSES)) & (n <= max(MISSES))
    chance = np.where(some, np.interp(n, list(MISSES), list(MISSES.values())), exact).sum()
    line = f"{missed} of {len(known)} published means outside our 95 % intervals, "
    return missed, len(known), chance, line + f"{chance:.1f} expected by chance"


def offset(runs):
    """A line that says how far our final returns are from the published means, and one per task.

    On the scale of `on_published_scale`, as of `less_published`.
    """
    groups = on_published_scale(runs[~runs.vanilla]).groupby([*CELL, "beta"])
    cells = groups.final_return.agg(["mean", "var", "size"]).assign(paper=groups.paper.first())
    found = less_published(cells)
    line = f"ours less the published {interval_text(found['mean'], *interval(found))} on average "
    line += f"over {len(cells)} cells, where the paper's lowest is 0 and its highest 1"
    tasks = (cells["mean"] - cells.paper).groupby("environment").agg(["mean", "size"])
    tasks = tasks.sort_values("mean").itertuples()
    return line, [f"{name} {less:z.2f} ({n} cells)" for name, less, n in tasks]


# --- Verdicts -------------------------------------------------------------------------------------


@dataclasses.dataclass
class Finding:
    """What the runs say of a claim: a verdict, and in `data` the numbers behind it, in words.

    The claim is that a number is between least and most; low to high is its 95 % interval. They are
    NaN where the claim is not about one number. `decides`: what would decide it if it is open.
    """

    verdict: str
    data: str
    mean: float = np.nan
    low: float = np.nan
    high: float = np.nan
    least: float = 0.0
    most: float = np.inf
    unit: str = "standard deviations"
    decides: str = ""

    def __post_init__(self):
        self.decides *= self.verdict == "open"


def words(what, found, alpha=0.05):
    text = f"{what} {interval_text(found['mean'], *interval(found, alpha))}"
    text = text.replace(" [nan, nan]", ", no interval")
    level = f", {100 * (1 - alpha):.3g} % interval" * (alpha != 0.05)
    return f"{text} ({found['made_of']}{': too few' if found['lacks'] else ''}{level})"


def judge(low, high, least=0.0, most=np.inf):
    """Verdict on "it is between least and most", of which low and high are the interval."""
    if low > least and high < most:
        return "holds"
    return "does not" if high < least or low > most else "open"


def rounded(number):
    """Text of a number of runs, with two digits that count."""
    digits = 10 ** max(0, len(str(int(number))) - 2)
    return f"{round(number / digits) * digits:,}"


def deciding(found, least=0.0, most=np.inf):
    """What would decide an open contrast: what lacks, or so many runs, if its mean stays."""
    if found["lacks"]:
        return found["lacks"]
    n, of = found["environments"], found["of"]
    more, runs = f"{of - n} environments more" * (n < of), found["runs"] * of / n
    distance = min(abs(found["mean"] - bound) for bound in (least, most))
    needed = (stats.t.ppf(0.975, found["df"]) * found["by_seeds"] / max(distance, 1e-9)) ** 2
    if needed > 1:
        many = f"{rounded(runs * needed - found['runs'])} runs more"
        more = f"{more}, {many} in all" if more else many
    return f"{more}, if the mean stays {found['mean']:z.2f}"


def between(runs, what, weights, by, cells=("environment",), least=0.0, most=np.inf, **how):
    """Finding on "the contrast is between least and most"; without these: it is positive."""
    found = contrast(runs, weights, by, cells, **how)
    if not found:
        missing = [value for value in weights if value not in runs.groupby(by).groups]
        return lacking(by, missing) if missing else lacking(by, weights, "together")
    return finding(found, what, least, most)


def finding(found, what, least=0.0, most=np.inf):
    low, high = interval(found)
    verdict = "open" if found["lacks"] else judge(low, high, least, most)
    numbers, decides = (found["mean"], low, high, least, most), deciding(found, least, most)
    return Finding(verdict, words(what, found), *numbers, decides=decides)


def lacking(what, values=(), how=""):
    named = f"{len(values)} more combinations"
    if isinstance(what, str):
        named = f"{what} {', '.join(map(value_text, values))} {how}".strip()
    return Finding("open", "no runs that can be compared", decides=f"runs with {named}")


def same(runs, weights, by, cells=("environment",)):
    """Finding on contrasts that the claim says are none. weights: a dict for each."""
    return both(*(between(runs, "difference", w, by, cells, -MARGIN, MARGIN) for w in weights))


def both(*findings):
    """All findings hold, or one does not, or it is open. The numbers are of the least certain."""
    verdicts = [each.verdict for each in findings]
    verdict = next(each for each in ("does not", "open", "holds") if each in verdicts)
    shown = [each for each in findings if each.verdict == verdict]
    shown = min(shown, key=lambda x: np.nan_to_num(min(x.low - x.least, x.most - x.high), nan=-9))
    data = "; ".join(dict.fromkeys(each.data for each in findings))
    decides = "; ".join(dict.fromkeys(filter(None, (each.decides for each in findings))))
    return dataclasses.replace(shown, data=data, decides=decides)


def best(runs, winner, rivals, by, **more):
    """Finding on "winner has the highest mean": ahead of every rival, all of them there.

    It does not where it is behind one, by an interval as wide as the number of rivals asks for.
    """
    rivals = [rival for rival in rivals if rival != winner]
    leads = {rival: contrast(runs, {winner: 1, rival: -1}, by, **more) for rival in rivals}
    leads = {rival: found for rival, found in leads.items() if found}
    missing = len(rivals) - len(leads)
    if not leads:
        return lacking(by, [winner, *rivals])
    second = min(leads, key=lambda rival: leads[rival]["mean"])
    there = f" (of {len(leads)} of {len(rivals)} rivals)" * bool(missing)
    one, other = (", ".join(map(value_text, np.ravel(value))) for value in (winner, second))
    what = f"lead of {one} over the next, {other}{there}:"
    shown, verdict = finding(leads[second], what), "open"
    enough = [found for found in leads.values() if not found["lacks"]]
    if any(interval(found, 0.05 / len(leads))[1] < 0 for found in enough):
        verdict = "does not"
    elif len(enough) == len(rivals) and all(interval(found)[0] > 0 for found in enough):
        verdict = "holds"
    of = by if isinstance(by, str) else "combinations"
    decides = f"runs with the other {missing} {of}" if missing else deciding(leads[second])
    return dataclasses.replace(shown, verdict=verdict, decides=decides)


def crossed(rows, columns):
    """{(row, column): weight}, the products of the weights of rows and of columns."""
    return {(a, b): x * y for a, x in rows.items() for b, y in columns.items()}


def slope(values, scale=np.asarray):
    """{value: weight} with which their results, summed, give the slope over scale(values)."""
    x = scale(values) - np.mean(scale(values))
    return dict(zip(values, x / (x**2).sum(), strict=True))


# --- Tests: what is compared for each claim -------------------------------------------------------


def two_and_four_best(runs):
    rest = [n for n in N_ENVS if n not in (2, 4)]
    return both(*(best(runs, n, rest, "n_envs", cells=OVER) for n in (2, 4)))


def color_matters(runs):
    """Some beta does better than some other; the two furthest apart are shown.

    Their interval is as wide as the number of pairs asks for.
    """
    pairs = itertools.permutations(sorted(runs.beta.unique()), 2)
    found = {pair: contrast(runs, {pair[0]: 1, pair[1]: -1}, "beta", CELL) for pair in pairs}
    found = {pair: each for pair, each in found.items() if each}
    if not found:
        return lacking("beta", BETAS)
    enough = {pair: each for pair, each in found.items() if not each["lacks"]} or found
    first, second = max(enough, key=lambda pair: enough[pair]["mean"])
    shown, alpha = found[first, second], 0.1 / len(enough)  # each pair is there in both orders
    low, high = interval(shown, alpha)
    verdict = "holds" if low > 0 and not shown["lacks"] else "open"
    text = words(f"{first:g} over {second:g}", shown, alpha)
    return Finding(verdict, text, shown["mean"], low, high, decides=deciding(shown))


def ahead_in(runs, beta):
    """Where beta is ahead of white noise and where behind: environments, and a line that says it.

    Each interval is as wide as the number of environments asks for. Returns names of environments
    ahead and behind, the contrast of each, and the line.
    """
    groups = runs.groupby("environment")
    found = {n: contrast(x, {beta: 1, 0.0: -1}, "beta", CELL, of=1) for n, x in groups}
    found = {name: each for name, each in found.items() if each}
    alpha = 0.05 / max(len(found), 1)
    ends = {name: interval(each, alpha) for name, each in found.items()}
    ahead = [name for name, (low, _) in ends.items() if low > 0]
    behind = [name for name, (_, high) in ends.items() if high < 0]
    parts = [f"{len(x)}{' (' * bool(x)}{', '.join(x)}{')' * bool(x)}" for x in (ahead, behind)]
    line = f"beta {beta:g} ahead of 0 in {parts[0]}, behind in {parts[1]} of {len(found)} "
    return ahead, behind, found, f"{line}environments, {100 * (1 - alpha):.3g} % intervals"


def best_beta_varies(runs):
    """In one environment pink noise does better than white, in another worse."""
    ahead, behind, _, text = ahead_in(runs, 1.0)
    decides = "an environment in which 1 is apart from 0 on the other side"
    return Finding("holds" if ahead and behind else "open", text, decides=decides)


def ahead_in_most(runs):
    """In more than half of the sixteen environments 0.5 does better than white noise."""
    ahead, behind, found, text = ahead_in(runs, 0.5)
    if len(ahead) > 8 or len(behind) >= 8:
        return Finding("holds" if len(ahead) > 8 else "does not", text)
    leads = [each for each in found.values() if each["mean"] > 0]
    decides = f"nothing at these means: 0.5 is ahead in {len(leads)}"
    if len(leads) > 8:
        t = stats.t.ppf(1 - 0.025 / 16, np.inf)
        times = sorted((t * each["se"] / each["mean"]) ** 2 for each in leads)[8]
        total = sum(each["runs"] for each in found.values()) * max(times, 1)
        decides = f"{rounded(total)} runs, if the means stay (ahead in {len(leads)})"
    return Finding("open", text, decides=decides)


def comparable_counts(runs):
    """Table 1: 0.5 is comparable with the best in most environments, and in more than 0 and 1 are.

    How often a test finds a difference depends on the number of seeds: only the paper's number says
    anything about its counts.
    """
    table = best_beta_per_env(runs).iloc[-1]
    counts = [table[f"beta_{beta}"] for beta in (0.5, 0.0, 1.0)]
    text = "comparable with the best 0.5: {}, 0: {}, 1: {} environments".format(*counts)
    if len(runs) < 20480:
        return Finding("open", text, decides="all 20,480 runs: with fewer, fewer differ")
    half, white, pink = (int(count.partition("/")[0]) for count in counts)
    return Finding("holds" if half > max(8, white, pink) else "does not", text)


def larger_n_envs_larger_beta(betas, n_envs):
    """The slope of performance over beta has a positive slope over log2 n_envs."""
    return crossed(slope(betas), slope(n_envs, np.log2))


def pink_gains_with_n_envs(_, n_envs):
    """Sec. A10: beta 1's lead over the mean of 0 and 0.5 has a positive slope over log2 n_envs."""
    return crossed({0: -0.5, 0.5: -0.5, 1: 1.0}, slope(n_envs, np.log2))


def ranks_as_projected(betas, n_envs):
    """Sec. "Why Do Larger beta Work Better": what is projected to be better is better.

    The slope of performance over the rank of a beta as it is projected for each n_envs from the
    published best betas. Means over betas and over n_envs are taken off: a beta that is good with
    any n_envs would be projected to be good, too, whatever the bias does.
    """
    paper = published("best_beta_per_n_envs").set_index("n_envs").best_beta
    ranks = -projected_ranks(paper, betas, n_envs)  # 1, the best, becomes the highest
    ranks = ranks.sub(ranks.mean(1), axis=0).sub(ranks.mean(0), axis=1) + ranks.to_numpy().mean()
    return (ranks / (ranks**2).to_numpy().sum()).stack().to_dict()


def unseen(runs, what, weights_of):
    """Finding on "the contrast is positive", decided by environments that are not in SEEN.

    weights_of: one of the three functions above.
    """
    there = runs.groupby(["beta", "n_envs"]).size().unstack()
    there = there.loc[:, there.count() > 2].dropna()  # of its rows and columns all combinations
    betas, n_envs = there.index.tolist(), there.columns.tolist()
    if min(len(betas), len(n_envs)) < 3:
        return lacking("three betas at each of three n_envs")
    weights, by, before = weights_of(betas, n_envs), ["beta", "n_envs"], runs.environment.isin(SEEN)
    found = between(runs[~before], what, weights, by, of=16 - len(SEEN))
    seen = contrast(runs[before], weights, by, of=len(SEEN))
    if not seen:
        return found
    data = f"{found.data}; {words('seen before the test was chosen:', seen)}"
    decides = f"the other {16 - len(SEEN)} environments" if before.all() else found.decides
    return dataclasses.replace(found, data=data, decides=decides)


def more_n_envs_worse(runs):
    """The slope of performance over log2 n_envs, from 4 on, is negative."""
    n = sorted(n for n in runs.n_envs.unique() if n >= 4)
    if len(n) < 2:
        return lacking("n_envs 4 and more")
    loss = {value: -weight for value, weight in slope(n, np.log2).items()}
    what = f"loss per doubling, n_envs {', '.join(map(str, n))}:"
    return between(runs, what, loss, "n_envs", OVER)


def less_in_a2c(runs):
    """Each method's performance is standardized by itself."""
    z = pd.concat([standardize(group) for _, group in runs.groupby("method")])
    weights = crossed({"trpo": 1, "a2c": -1}, {0.5: 1, 0: -1})
    return between(runs.assign(z=z), "lead in TRPO less that in A2C", weights, ["method", "beta"])


def a2c_learns_less(runs):
    """At the betas that both methods have."""
    weights = {name: {name: 1, "a2c": -1} for name in ("ppo", "trpo")}
    return both(*(between(runs, f"{x} over a2c", w, "method", OVER) for x, w in weights.items()))


def hardly_found(runs):
    """Less than RARE of runs end at the goal, which gives 100, and all else costs: above 0.

    The interval is Clopper and Pearson's.
    """
    count, n = int((runs.final_return > 0).sum()), len(runs)
    (low, high), more = stats.binomtest(count, n).proportion_ci(), 0
    verdict = judge(low, high, -1, RARE)
    while stats.binomtest(count, n + more).proportion_ci().high >= RARE:
        more += 1
    text = f"white noise ends at the goal in {count} of {n} runs, share {low:.2f} to {high:.2f}"
    decides = f"{more} runs more, if none of them ends there"
    return Finding(verdict, text, count / n, low, high, -1, RARE, "share of runs", decides)


def no_collapse(runs):
    """Fewer than RARE of the runs end below half of what they had gained.

    Of means over a tenth of the evaluations: the last one's, the best, and the first. It holds
    only with all betas of the study, as the reddest are the likeliest to.
    """
    lost = runs["last"] < (runs["first"] + runs["top"]) / 2
    what = f"with n_envs 4 half lost by {lost.sum()} of {len(lost)} runs, share"
    found = contrast(runs.assign(z=lost.astype(float), every=1), {1: 1}, "every", OVER)
    if not found:
        return lacking("n_envs 4")
    shown = dataclasses.replace(finding(found, what, -1, RARE), unit="share of runs")
    if shown.verdict == "holds" and set(runs.beta) != set(BETAS):
        return dataclasses.replace(shown, verdict="open", decides="runs with all eight betas")
    return shown


def pendulum(runs):
    found = []
    for n, beta in ((1, 0), (4, 0.5), (32, 1)):
        each = best(runs[runs.n_envs == n], beta, [0, 0.5, 1], "beta", of=1)
        texts = {"data": f"n_envs {n}: {each.data}", "decides": f"n_envs {n}: {each.decides}"}
        found.append(dataclasses.replace(each, **texts))
    return both(*found)


def published_final_returns(runs):
    """More published means outside than chance would have in 97.5 % of cases: does not."""
    missed, n, chance, line = outside(final_returns(runs))
    if n and missed > stats.binom.ppf(0.975, n, chance / n):
        return Finding("does not", line)
    return Finding("open", line, decides="nothing: that all are the same cannot be shown")


# --- The table ------------------------------------------------------------------------------------


def usable_runs(runs, curves):
    """Those with the study's settings on its tasks; of PPO with any n_steps and n_epochs.

    runs, curves: of `select` and `load`. Adds `noise`, text of beta or "gsde"; and `first`, `top`
    and `last` of `no_collapse`.
    """
    runs = runs[(runs.method == "ppo") | runs.index.isin(main_grid(runs).index)]
    differ = differences(runs, {*SETTINGS} - {"method", "n_steps", "n_epochs"})
    differ = differ.where(~runs.method.isin(["trpo", "a2c"]), differences(runs, SHARED))
    runs = runs[(differ == "") & runs.env_id.isin(list(NAMES))]
    returns = curves.loc[runs.index].dropna(axis=1, how="all")
    returns = returns.T.rolling(max(1, returns.shape[1] // 10)).mean().dropna().T
    if returns.shape[1]:
        first, last = returns.iloc[:, 0], returns.iloc[:, -1]
        runs = runs.assign(first=first, top=returns.max(axis=1), last=last)
    return runs.assign(noise=runs.beta.map("{:g}".format).where(runs.method != "gsde", "gsde"))


def of_most(runs, of=16):
    """The runs with those betas and n_envs that half of the environments have, or else most."""
    there = runs.groupby(["beta", "n_envs"]).environment.transform("nunique")
    return runs[there >= min(of / 2, there.max())] if len(runs) else runs


def claim_runs(runs, curves):
    """The runs that each claim is about: {name: (runs, how many the paper has, their presets)}.

    Of `usable_runs`, with `z`, standardized performance: within each environment, over the runs of
    that name.
    """
    runs = usable_runs(runs, curves)
    hard, four = runs.env_id.isin(COMPLEX), runs.n_envs == 4
    ppo = (runs.method == "ppo") & runs.n_envs.isin(N_ENVS)
    usual = ppo & (runs.n_steps == 2048) & (runs.n_epochs == 10)
    colors = runs.beta.isin(BETAS) & ~runs.vanilla
    main, white = usual & colors & ~hard, usual & ~hard & (runs.vanilla | (runs.beta == 0))
    three = main & runs.beta.isin([0, 0.5, 1]) & runs.n_envs.isin([1, 4, 32])
    trpo, a2c = ((runs.method == name) & four & colors & ~hard for name in ("trpo", "a2c"))
    few = runs.beta.isin([0.2, 0.5, 0.75]) & runs.n_epochs.isin([5, 10, 20])
    gsde = (runs.method == "gsde") & runs.n_envs.isin(N_ENVS) & ~hard
    size = ppo & colors & (runs.beta == 0.5) & (runs.n_epochs == 10) & runs.n_envs.isin([2, 4, 8])
    chosen = {
        "main": (main, 20480, "main"),
        "all": (usual & ~hard & (colors | runs.vanilla), 23040, "main, vanilla"),
        "vanilla": (white, 5120, "main, vanilla"),
        "car": (white & (runs.environment == "Mountain Car"), 320, "main, vanilla"),
        "trpo": (trpo, 2560, "transfer"),
        "a2c": (a2c, 2560, "transfer"),
        "both": (trpo | a2c, 5120, "transfer"),
        "methods": (trpo | a2c | main & four, 7680, "main, transfer"),
        "complex": (usual & colors & hard & four, 640, "complex"),
        "n_envs 4": (main & four, 2560, "main"),
        "pendulum": (three & (runs.environment == "Pendulum Swingup"), 180, "main"),
        "three": (three, 2880, "main"),
        "n_steps": (size & ~hard & (runs.n_envs * runs.n_steps == 8192), 960, "main, n_steps"),
        "n_epochs": (ppo & colors & few & ~hard & four & (runs.n_steps == 2048), 2880, "n_epochs"),
        "gsde": (main | gsde, 23040, "main, gsde"),
    }
    parts = {}
    for name, (mask, total, presets) in chosen.items():
        part = of_most(runs[mask]) if name in ("main", "n_envs 4") else runs[mask]
        parts[name] = part.assign(z=standardize(part)), total, presets
    return parts


# fmt: off
CLAIMS = [  # where, what it shows or says, name of its runs or command, file, test
    ("Fig. 1", "random walks", "noise", "noise_random_walks", None),
    ("Sec. Colored Noise", "expected PSD", "noise", "noise_psd", None),
    ("Fig. 2", "the environments", "environments", "results/environments.png", None),
    ("Introduction", "colored noise does better than white in most environments", "main",
     "best_beta_per_env", ahead_in_most),
    ("Fig. 3", "the color of the noise affects performance", "main", "performance_vs_beta",
     color_matters),
    ("Fig. 3", "beta 0.5 outperforms white noise", "main", "performance_vs_beta",
     partial(between, **LEAD, cells=CELL)),
    ("Fig. 3, conclusion i", "beta 0.5 is best on average", "main", "performance_vs_beta",
     partial(best, winner=0.5, rivals=BETAS, by="beta", cells=CELL)),
    ("Table 1", "the best beta depends on the environment", "main", "best_beta_per_env",
     best_beta_varies),
    ("Table 1, conclusion ii",
     "0.5, 0, 1 comparable with the best in 11, 8, 7 of 16: in most for 0.5", "main",
     "best_beta_per_env", comparable_counts),
    ("Fig. 4, conclusion iii", "n_envs 4 is best on average", "main", "performance_vs_n_envs",
     partial(best, winner=4, rivals=N_ENVS, by="n_envs", cells=OVER)),
    ("Conclusion iii", "n_envs 2 and 4 outperform all others", "main", "performance_vs_n_envs",
     two_and_four_best),
    ("Fig. 4", "more environments than 4 do worse", "main", "performance_vs_n_envs",
     more_n_envs_worse),
    ("Fig. 5, conclusion iv", "larger n_envs wants larger beta", "main", "n_envs_beta_grids",
     partial(unseen, what="gain per beta and doubling", weights_of=larger_n_envs_larger_beta)),
    ("Fig. 5", "beta 0.5 with n_envs 4 is the best configuration", "main", "n_envs_beta_grids",
     partial(best, winner=(0.5, 4), rivals=CONFIGURATIONS, by=["beta", "n_envs"])),
    ("Fig. 6", "a sequence's mean spreads more with larger beta", "noise", "noise_bias", None),
    ("Fig. 7, conclusion v", "ranks follow those projected from the bias", "main",
     "n_envs_beta_grids",
     partial(unseen, what="gain per projected rank", weights_of=ranks_as_projected)),
    ("Fig. A1", "subsequent steps are correlated where beta > 0, more with larger beta", "noise",
     "noise_two_step", None),
    ("Fig. A1", "each step is Gaussian", "noise", "noise_marginal", None),
    ("Table A2", "best beta per n_envs", "main", "best_beta_per_n_envs", None),
    ("Fig. A6", "beta 0 matches vanilla PPO", "vanilla", "beta0_vs_vanilla",
     partial(same, weights=[{True: 1, False: -1}], by="vanilla", cells=CELL)),
    ("Fig. A7a", "beta 0.5 improves TRPO", "trpo", "transfer", partial(between, **LEAD)),
    ("Fig. A7b", "beta 0.5 improves A2C", "a2c", "transfer", partial(between, **LEAD)),
    ("Fig. A7", "the effect is less in A2C", "both", "transfer", less_in_a2c),
    ("Fig. A7c", "A2C learns less than PPO and TRPO", "methods", "transfer", a2c_learns_less),
    ("Fig. A8", "beta 0.5 is favored in complex tasks", "complex", "complex_tasks",
     partial(best, winner=0.5, rivals=BETAS, by="beta", of=4)),
    ("Table A9", "final return and performance, mean and maximum", "main",
     "final_return_and_performance", None),
    ("Sec. A10", "learning Mountain Car requires correlated noise", "car",
     "learning_curves_mountain_car", hardly_found),
    ("Sec. A10", "policies do not collapse", "n_envs 4", "learning_curves_n_envs_4", no_collapse),
    ("Sec. A10", "Pendulum Swingup: beta 0, 0.5, 1 best with n_envs 1, 4, 32", "pendulum",
     "learning_curves_pendulum_swingup", pendulum),
    ("Sec. A10", "learning curves, beta 0, 0.5 and 1, n_envs 1, 4 and 32", "three",
     "learning_curves_n_envs_*", None),
    ("Sec. A10", "beta 1 gains with larger n_envs", "three", "learning_curves_n_envs_*",
     partial(unseen, what="gain per doubling", weights_of=pink_gains_with_n_envs)),
    ("Fig. A11", "n_envs and n_steps do not matter if their product stays", "n_steps",
     "n_envs_vs_n_steps", partial(same, by="n_steps", weights=[
         {4096: 1, 2048: -1}, {1024: 1, 2048: -1}, {4096: 1, 1024: -1}])),
    ("Fig. A12", "half the epochs do worse", "n_epochs", "n_epochs_vs_beta",
     partial(between, what="10 epochs over 5", weights={10: 1, 5: -1}, by="n_epochs", cells=OVER)),
    ("Fig. A12", "the preference for 0.5 is the same with 5, 10 and 20 epochs", "n_epochs",
     "n_epochs_vs_beta", partial(same, by=["beta", "n_epochs"], weights=[
         crossed(OVER_0_2_AND_0_75, {5: 1, 10: -1}), crossed(OVER_0_2_AND_0_75, {20: 1, 10: -1})])),
    ("Fig. A13", "gSDE is like beta 1.25 to 2", "gsde", "gsde_vs_beta",
     partial(same, weights=[{"gsde": 1, "1.25": -0.5, "2": -0.5}], by="noise", cells=CELL)),
    ("Table A14", "final returns", "all", "final_return_per_beta", published_final_returns),
]
# fmt: on


def coverage(runs, curves):
    """Every figure, table and claim of the paper: what makes it, how much is here, what that says.

    runs, curves: of `select` and `load`. Returns a DataFrame with a row per claim of CLAIMS: what
    `Finding` has, blank without a test; `runs`, how many there are, with 20 seeds a cell at most;
    the command and the file that show it.
    """
    parts, table = claim_runs(runs, curves), []
    for where, says, name, file, test in CLAIMS:
        found, command, count = Finding("", ""), f"python plot.py {name}", "none needed"
        if name in parts:
            runs, total, presets = parts[name]
            found = tested(test, runs) if test else found
            cell = ["method", *AXES[:-1]]
            here = runs.groupby(cell, dropna=False).seed.nunique().clip(upper=20).sum()
            count = f"{here} of {total}"
            sweeps = [f"./run_sweep.sh {preset}" for preset in presets.split(", ")]
            command = "; ".join([*sweeps, "python plot.py results runs/"])
        row = {"where": where, "says": says, **dataclasses.asdict(found), "runs": count}
        table.append(row | {"command": command, "file": file})
    return pd.DataFrame(table)


def tested(test, runs):
    """The Finding of a claim's test."""
    if runs.empty:
        return Finding("open", "no runs", decides="runs")
    try:
        return test(runs)
    except Unusable as error:
        return Finding("open", str(error), decides="runs")
