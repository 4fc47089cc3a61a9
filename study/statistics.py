"""Statistics of runs: means and their intervals, tests, contrasts. Draws and reads nothing.

`runs` are as of `study.runs.select`: a row per run.
"""

import warnings

import numpy as np
import pandas as pd
from scipy import stats

CELL = ["method", "beta", "n_envs", "n_steps", "n_epochs"]  # within an environment
FEW = 5  # runs: the interval of fewer is made with a standard deviation pooled over cells


def standardize(runs):
    """Performance of the runs, standardized over all of them in the same environment: a Series.

    Sec. "Evaluation Details": "results are grouped by environment and standardized to zero mean and
    unit variance to control for the impact of the environments. We combine these standardized
    results by averaging across different environments and seeds." Each cell (method, beta, n_envs,
    n_steps, n_epochs) weighs the same, however many seeds it has. In an environment without
    variance all are 0.
    """
    keys = ["environment", *runs.columns.intersection(CELL)]
    weight = 1 / runs.groupby(keys, dropna=False).performance.transform("size")
    weight /= weight.groupby(runs.environment).transform("sum")
    mean = (weight * runs.performance).groupby(runs.environment).transform("sum")
    centered = runs.performance - mean
    std = (weight * centered**2).groupby(runs.environment).transform("sum") ** 0.5
    varies = runs.groupby("environment").performance.transform(np.ptp) > 0
    return (centered / std).where(varies, 0.0)


def mean_interval(values, n_resamples=9999):
    """Mean over the first axis, its 95 % BCa bootstrap interval as in all the paper's figures.

    values: (runs,) or (runs, steps). Returns mean, low, high. One run has no interval (NaN); of
    equal values the interval is that value.
    """
    values = np.asarray(values, float)
    mean = values.mean(axis=0)
    low, high = np.array(mean), np.array(mean)
    varies = np.ptp(values, axis=0) > 0  # BCa is not defined for equal values
    if len(values) < 2:
        low, high = low * np.nan, high * np.nan
    elif varies.any():
        how = {"n_resamples": n_resamples, "batch": 1000, "rng": np.random.default_rng(0)}
        result = stats.bootstrap([values.T[varies]], np.mean, axis=-1, method="BCa", **how)
        low[varies], high[varies] = result.confidence_interval
    return mean, low, high


def mean_intervals(runs, column, by):
    """Means of a column and their 95 % intervals in each group of runs.

    That of `mean_interval`; of fewer than five runs, Student's, with the standard deviation pooled
    over all groups of the same environment: two or three runs say too little of their own scatter.
    by: columns, `environment` among them. Returns a DataFrame of mean, low, high, runs.
    """
    groups = runs.groupby(by)[column]
    rows = [[*mean_interval(values), len(values)] for _, values in groups]
    table = pd.DataFrame(rows, groups.mean().index, columns=["mean", "low", "high", "runs"])
    variances, df = pooled_variances(groups.agg(["var", "size"]))
    pooled = pd.DataFrame({"var": variances, "df": df}).reindex(table.index, level="environment")
    half = stats.t.ppf(0.975, pooled.df) * (pooled["var"] / table.runs) ** 0.5
    few = table.runs < FEW
    table.loc[few, "low"], table.loc[few, "high"] = table["mean"] - half, table["mean"] + half
    return table


def cells_interval(samples):
    """Mean over cells of the mean over each cell's runs, with a 95 % BCa bootstrap interval.

    The seeds are drawn within cells: environments and n_envs are the study's choice, not chance.
    Each cell weighs the same, however many seeds it has. Drawing n of n seeds makes the variance of
    their mean too small, by (n - 1) / n; they are spread by the root of its inverse (as Rao and Wu
    1988), since cells of two or three seeds would have half of it.

    samples: arrays (runs,), one per cell. Returns mean, low, high; NaN where a cell has one run,
    whose scatter is not known.
    """

    def mean(*cells, axis=-1):
        return np.mean([np.mean(cell, axis=axis) for cell in cells], axis=0)

    samples = [np.asarray(cell, float) for cell in samples]
    center = mean(*samples)
    if min(map(len, samples)) < 2:
        return center, np.nan, np.nan
    if not any(np.ptp(cell) > 0 for cell in samples):
        return center, center, center
    samples = [x.mean() + (x - x.mean()) * (len(x) / (len(x) - 1)) ** 0.5 for x in samples]
    how = {"n_resamples": 9999, "batch": 500, "rng": np.random.default_rng(0), "vectorized": True}
    return center, *stats.bootstrap(samples, mean, method="BCa", **how).confidence_interval


def cells_intervals(runs, column, by, cells):
    """`cells_interval` in each group of runs: a DataFrame of mean, low, high, number of runs."""
    rows = {}
    for value, group in runs.groupby(by):
        samples = [values for _, values in group.groupby(cells)[column]]
        rows[value] = [*cells_interval(samples), len(group)]
    table = pd.DataFrame.from_dict(rows, "index", columns=["mean", "low", "high", "runs"])
    return table.rename_axis(by)


def welch(a, b, weights_a=None, weights_b=None):
    """p-value of Welch's t-test (Table 1), of weighted means where there are weights.

    A weighted sample counts as 1 / sum(weights^2) runs (Kish). NaN with fewer than two runs on a
    side, 1 where all values are the same.
    """
    if min(len(a), len(b)) < 2:
        return np.nan
    if np.ptp([*a, *b]) == 0:
        return 1.0

    def moments(x, weights):  # mean, standard deviation, size
        x, w = np.asarray(x, float), np.ones(len(x)) if weights is None else np.asarray(weights)
        w = w / w.sum()
        squares = (w**2).sum()
        return x @ w, ((x - x @ w) ** 2 @ w / (1 - squares)) ** 0.5, 1 / squares

    sides = [*moments(a, weights_a), *moments(b, weights_b)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scipy's, about values nearly the same
        return stats.ttest_ind_from_stats(*sides, equal_var=False).pvalue


# --- Contrasts: weighted sums of means, and how far chance may move them --------------------------


def summed(variances, df):
    """Standard error and degrees of freedom (Satterthwaite) of a sum of independent estimates."""
    total, squares = variances.sum(), (variances**2 / df).sum()
    return {"se": total**0.5, "df": total**2 / squares if squares != 0 else np.inf}


def pooled_variances(cells):
    """Variance of the seeds in each environment, pooled over its cells, and degrees of freedom.

    cells: DataFrame, its first index level `environment`, columns var and size. Returns two Series;
    environments with one seed in each cell are left out.
    """
    df = cells["size"] - 1
    squares = (cells["var"].fillna(0) * df).groupby("environment").sum()
    df = df.groupby("environment").sum()
    return (squares / df)[df > 0], df[df > 0]


def less_published(cells):
    """Mean of our means less the published ones, over cells that weigh the same, and its error.

    By seeds: their variance is that of `pooled_variances`, and the paper's 20 are taken to scatter
    as ours do. cells: as there, with columns mean (of our runs) and paper, too. Returns a dict of
    mean, se and df, for `interval`.
    """
    variances, df = pooled_variances(cells)
    weight = (1 / cells["size"] + 1 / 20).groupby("environment").sum()[df.index]
    return {"mean": (cells["mean"] - cells.paper).mean()} | summed(
        variances * weight / len(cells) ** 2, df
    )


def same_cells(index, of):
    """Cells such that each environment is averaged over the same values of the second level.

    These values are the ones that half of `of` environments have (else, that most have); the
    environments are those with all of these. index: MultiIndex, environment and the second level.
    Returns its part, and the values.
    """
    environment, second = (index.get_level_values(level) for level in (0, 1))
    shared = second.value_counts()
    shared = shared.index[shared >= min(of / 2, shared.max())]
    index, environment = index[second.isin(shared)], environment[second.isin(shared)]
    return index[(environment.value_counts()[environment] == len(shared)).to_numpy()], shared


def contrast(runs, weights, by, cells=("environment",), of=16):
    """A weighted sum of groups' means of `z`, averaged over cells and environments, and its error.

    In each cell with all groups: the sum of weight times mean over seeds; only where each has two
    seeds, if such cells are there; with a second column of cells, those of `same_cells`. Then over
    environments, each weighing the same. Seeds scatter in
    an environment with a standard deviation that is pooled over its cells and groups here.
    The E environments are taken for a sample of `of` (Cochran, Sampling Techniques, Sec. 10.3):
    with f = E / of the variance is (1 - f) s^2 / E between environments + f / E times the mean
    variance by seeds. So 16 of 16 are the study itself, where only seeds are chance.

    weights: {value: weight} of a column `by`, {(value, ...): weight} of a list of columns. cells:
    columns, `environment` first, and at most one more.

    Returns a dict, empty where no cell has all groups: environments; mean; se, NaN where all groups
    have one seed; df; by_seeds, the error that is left with all `of` environments; runs; made_of,
    in words; lacks, in words, "" where there is enough: half of the environments, and three values
    of the second column of cells, if any.
    """
    groups = runs.groupby([*cells, *([by] if isinstance(by, str) else by)]).z
    tables = groups.mean(), groups.var().fillna(0), groups.size()
    tables, weight = [table.unstack(by) for table in tables], pd.Series(weights, dtype=float)
    if not weights.keys() <= set(tables[0]):
        return {}
    tables = [table.iloc[:, table.columns.get_indexer(weight.index)] for table in tables]
    there, two = tables[2].notna().all(axis=1), (tables[2] > 1).all(axis=1)
    chosen, lacks, made_of = tables[2].index[two if two.any() else there], "", ""
    if len(cells) > 1:
        chosen, shared = same_cells(chosen, of)
        lacks = f"more of {cells[1]}" * (len(shared) < 3)
        made_of = f", {cells[1]} {', '.join(f'{value:g}' for value in sorted(shared))}"
    mean, variance, seeds = (table.loc[chosen] for table in tables)
    if mean.empty:
        return {}
    seeds_of = seeds.groupby("environment")
    df = (seeds - 1).groupby("environment").sum().sum(axis=1)
    squares = (variance * (seeds - 1)).groupby("environment").sum().sum(axis=1)
    pooled = squares / df.where(df > 0)  # NaN: one seed each
    each = (weight**2 / seeds).sum(axis=1).groupby("environment").sum() / seeds_of.size() ** 2
    by_environment = (mean * weight).sum(axis=1).groupby("environment").mean()
    known = pooled.notna() if pooled.notna().any() else pooled.isna()
    by_environment, within, df = by_environment[known], (pooled * each)[known], df[known]
    n = len(by_environment)
    f = min(n / of, 1)
    between = (1 - f) * by_environment.var() / n if f < 1 else 0.0
    found = {"mean": by_environment.mean(), "environments": n, "of": of}
    found |= summed(
        np.append(f * within / n**2, between), np.append(df.clip(lower=1), max(n - 1, 1))
    )
    found |= {"by_seeds": (within.mean() / max(of, n)) ** 0.5, "runs": int(seeds.to_numpy().sum())}
    if n < of / 2:
        lacks = f"{-(-of // 2) - n} environments more" + f" and {lacks}" * bool(lacks)
    return found | {"lacks": lacks, "made_of": f"{n} environment{'s'[: n > 1]}{made_of}"}


def interval(found, alpha=0.05):
    """Low and high end of the 1 - alpha interval of a `contrast`; NaN where it has none."""
    half = stats.t.ppf(1 - alpha / 2, found["df"]) * found["se"] if found["se"] else 0.0
    return found["mean"] - half, found["mean"] + half


def interval_text(mean, low, high, digits=2):
    return "{:z.{d}f} [{:z.{d}f}, {:z.{d}f}]".format(mean, low, high, d=digits)
