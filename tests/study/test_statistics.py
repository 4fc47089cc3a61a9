"""study/statistics.py beside scipy, values computed by hand, and simulations."""

from unittest import mock

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from study import statistics


def test_standardized_within_each_environment():
    """By hand: 0, 0, 4, 4 have mean 2 and standard deviation 2; a constant says nothing."""
    runs = pd.DataFrame({"environment": list("AABABABB"), "performance": [0, 0, 1, 4, 1, 4, 1, 1]})
    z = statistics.standardize(runs)
    assert z[runs.environment == "A"].tolist() == [-1, -1, 1, 1]
    assert (z[runs.environment == "B"] == 0).all()
    # Cells weigh the same: more runs of the one beta move nothing
    runs = pd.DataFrame({"environment": "A", "beta": [0, 0, 1, 1], "performance": [0, 2, 4, 6]})
    more = pd.concat([runs, runs[:2], runs[:2]], ignore_index=True)
    assert statistics.standardize(runs).std(ddof=0) == pytest.approx(1)
    np.testing.assert_allclose(statistics.standardize(more)[:4], statistics.standardize(runs))


def test_intervals_are_scipys_bca():
    values = np.random.default_rng(1).exponential(size=(7, 3))
    mean, low, high = statistics.mean_interval(values)
    for column, x in enumerate(values.T):
        how = {"method": "BCa", "n_resamples": 9999, "rng": np.random.default_rng(5)}
        ci = stats.bootstrap((x,), np.mean, **how).confidence_interval
        assert mean[column] == pytest.approx(x.mean())
        near = 0.05 * (ci.high - ci.low)
        assert abs(low[column] - ci.low) < near and abs(high[column] - ci.high) < near
    alone = statistics.mean_interval(values[:, 1])
    np.testing.assert_allclose(alone, [mean[1], low[1], high[1]], rtol=0.02)


@pytest.mark.filterwarnings("error")
def test_intervals_of_degenerate_data():
    assert np.array_equal(statistics.mean_interval([2.0]), [2.0, np.nan, np.nan], equal_nan=True)
    assert statistics.mean_interval([0.0] * 5) == (0, 0, 0)
    mean, low, high = statistics.mean_interval([[1.0, 0.1], [2.0, 0.1], [4.0, 0.1]])
    assert low[0] < mean[0] < high[0] and low[1] == mean[1] == high[1]
    assert np.isnan(statistics.cells_interval([[1.0, 2.0], [1.0]])[1:]).all()
    assert statistics.cells_interval([[1, 1], [2, 2]]) == (1.5, 1.5, 1.5)


def test_intervals_of_few_runs_pool_the_scatter_of_their_environment():
    """Student's interval with the variance that scipy's ANOVA of the environment's groups has."""
    rng = np.random.default_rng(0)
    runs = pd.DataFrame({"environment": [*"AAAAAAAAAAAA", *"BB"], "beta": [*"00111222222222"]})
    runs["x"] = rng.normal(size=len(runs))
    table = statistics.mean_intervals(runs, "x", ["environment", "beta"])
    groups = [x for _, x in runs[runs.environment == "A"].groupby("beta").x]
    squares = sum(((x - x.mean()) ** 2).sum() for x in groups)
    half = stats.t.ppf(0.975, 9) * (squares / 9 / 3) ** 0.5
    three, seven = table.loc["A", "1"], table.loc["A", "2"]
    assert [three.low, three.high] == pytest.approx([three["mean"] - half, three["mean"] + half])
    assert seven.tolist() == [*statistics.mean_interval(groups[2]), 7]
    alone = statistics.mean_intervals(runs[:1], "x", ["environment", "beta"])
    assert alone.low.isna().all() and table.loc["B", "2"].low < table.loc["B", "2"]["mean"]


def test_cells_weigh_the_same_whatever_their_seeds():
    cells = [10.0 + np.arange(9) % 2, np.array([1.0, 2.0])]
    mean, low, high = statistics.cells_interval(cells)
    assert mean == pytest.approx((cells[0].mean() + 1.5) / 2) and low < mean < high
    # Drawn within cells: by hand, with the percentiles of as many resamples, further from the mean
    rng, draws = np.random.default_rng(1), 0
    for cell in cells:
        drawn = rng.choice(cell, (20000, len(cell))).mean(1) - cell.mean()
        draws += cell.mean() + drawn * (len(cell) / (len(cell) - 1)) ** 0.5
    assert [low, high] == pytest.approx(np.percentile(draws / 2, [2.5, 97.5]), abs=0.1)
    # One cell is the paper's interval of a mean, wider by the root of 9 / 8
    one = cells[0] + np.arange(9)
    mean, *ends = statistics.mean_interval(one)
    ends = mean + (np.array(ends) - mean) * (9 / 8) ** 0.5
    np.testing.assert_allclose(statistics.cells_interval([one]), [mean, *ends], atol=0.06)


def test_averages_of_cells_with_two_seeds_have_intervals_wide_enough():
    """Of five cells about 87 % hold the mean, in 200 studies, 78 without the factor."""
    rng, bootstrap, held = np.random.default_rng(0), stats.bootstrap, 0

    def fast(*args, **how):
        return bootstrap(*args, **how | {"n_resamples": 999})

    with mock.patch.object(stats, "bootstrap", fast):
        for _ in range(200):
            _, low, high = statistics.cells_interval(rng.normal(size=(5, 2)))
            held += low < 0 < high
    assert 0.82 < held / 200 < 0.95


@pytest.mark.filterwarnings("error")
def test_welch():
    rng, welch = np.random.default_rng(0), statistics.welch
    a, b = rng.normal(size=20), 0.5 + 2 * rng.normal(size=7)
    assert welch(a, b) == pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue)
    assert np.isnan(welch([1.0], [1.0, 2.0]))
    assert welch([3.0, 3.0], [3.0, 3.0]) == 1
    assert welch([0.0, 0.0], [94.0, 93.9]) < 0.01
    # Weights that are all the same change nothing; a run that hardly weighs hardly counts
    assert welch(a, b, [3] * 20, [0.1] * 7) == pytest.approx(welch(a, b))
    without = welch([0, 0.1, 0.2], [5, 5.1])
    light = welch([0, 0.1, 0.2, 5], [5, 5.1], [1, 1, 1, 1e-9], [1, 1])
    assert light == pytest.approx(without, rel=1e-4)


def test_contrast_is_students_interval_where_the_environment_is_all_there_is():
    rng, weights = np.random.default_rng(1), {1.0: 1, 0.0: -1}
    runs = pd.DataFrame({"environment": "A", "beta": [0.0] * 5 + [1.0] * 4})
    runs["z"] = rng.normal(size=9)
    found = statistics.contrast(runs, weights, "beta", of=1)
    test = stats.ttest_ind(runs.z[5:], runs.z[:5]).confidence_interval()
    assert statistics.interval(found) == pytest.approx((test.low, test.high))
    assert found["by_seeds"] == pytest.approx(found["se"]) and found["runs"] == 9
    # A single seed takes its scatter from the others; equal values leave a point
    single = statistics.contrast(runs[4:], weights, "beta", of=1)
    test = stats.ttest_ind(runs.z[5:], runs.z[4:5]).confidence_interval()
    assert statistics.interval(single) == pytest.approx((test.low, test.high))
    alone = statistics.contrast(runs[4:6], weights, "beta", of=1)
    assert np.isnan(statistics.interval(alone)[0])
    same = statistics.contrast(runs.assign(z=runs.beta), weights, "beta", of=1)
    assert statistics.interval(same) == (1, 1)
    assert statistics.contrast(runs, {1.0: 1, 2.0: -1}, "beta") == {}
    assert statistics.contrast(runs, weights, "beta")["lacks"] == "7 environments more"


def test_contrasts_of_few_seeds_hold_the_mean_as_often_as_they_say():
    """Of sixteen environments' mean, of which eight are seen, or all."""
    rng, held = np.random.default_rng(0), 0
    for study in range(100):
        leads = rng.normal(size=16)
        shown = rng.permutation(16)[: 8 * (1 + study % 2)]
        index = pd.MultiIndex.from_product([shown, [0.0, 1.0], range(3)])
        runs = index.to_frame(index=False, name=["environment", "beta", "seed"])
        runs["z"] = leads[runs.environment] * runs.beta + rng.normal(size=len(runs))
        found = statistics.contrast(runs, {1.0: 1, 0.0: -1}, "beta")
        low, high = statistics.interval(found)
        held += low < leads.mean() < high
    assert 0.85 < held / 100 < 1
