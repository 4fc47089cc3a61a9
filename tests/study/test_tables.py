"""study/tables.py: the paper's tables of made-up runs, and the published numbers beside them."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from study import tables
from study.runs import Unusable, published

PENDULUM, CAR = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0"


def test_best_beta_per_env(made_up):
    levels = {0: 11.6, 0.2: 11, 0.5: 12, 1: 11}
    few = {"betas": [*levels], "n_envs": (4, 8), "seeds": 6}
    two = made_up(lambda e, beta, n: levels[beta], envs=[PENDULUM], **few)
    two["performance"] += np.random.default_rng(1).normal(size=len(two)) * 0.4
    one = made_up(lambda e, beta, n: -beta, envs=[CAR], betas=(0, 0.5), n_envs=[4], seeds=1)
    both = pd.concat([two, one], ignore_index=True)
    table = tables.best_beta_per_env(both).set_index("environment")
    pooled = {beta: group.performance for beta, group in two.groupby("beta")}
    row = table.loc["Pendulum Swingup"]
    assert row.best_beta == 0.5 == max(pooled, key=lambda beta: pooled[beta].mean())
    p = [stats.ttest_ind(pooled[0.5], pooled[b], equal_var=False).pvalue for b in (0, 1)]
    assert p[1] < 0.05 and [row["p_0.0"], row["p_1.0"]] == pytest.approx(p)
    verdicts = row[["beta_0.5", "beta_0.0", "beta_1.0"]].tolist()
    white = "outperformed" if p[0] < 0.05 else "comparable"
    assert verdicts == ["comparable", white, "outperformed"] and np.isnan(row["p_0.5"])
    # With one seed there is no test, so no verdict counts, not even that of the best itself
    alone = table.loc["Mountain Car", ["best_beta", "beta_0.0", "beta_0.5", "beta_1.0"]]
    assert alone.tolist() == [0, "", "", ""]
    assert table.loc["comparable in", ["beta_0.5", "beta_1.0"]].tolist() == ["1/1", "0/1"]
    paper = row[["paper_best_beta", "paper_beta_0.5", "paper_p_0.5"]].tolist()
    assert paper == [0.75, "comparable", 0.92]


def test_best_beta_per_n_envs(made_up):
    levels = {4: {0: 4, 0.5: 5, 1: 3}, 32: {0: 0, 0.5: 1, 1: 2}}
    runs = made_up(lambda e, beta, n: levels[n][beta], envs=[PENDULUM], n_envs=(4, 32))
    table = tables.best_beta_per_n_envs(runs).set_index("n_envs")
    assert table.best_beta.to_dict() == {4: 0.5, 32: 1}
    z = (runs.performance - runs.performance.mean()) / runs.performance.std(ddof=0)
    best = z[(runs.n_envs == 32) & (runs.beta == 1)].mean()
    assert table.standardized_performance[32] == pytest.approx(best)
    assert table.paper_best_beta.to_dict() == {4: 0.5, 32: 0.75}


def test_averages_are_of_comparable_cells_that_weigh_the_same(made_up):
    """n_envs 32 is hard: pooled over all runs beta 0.5, which is there, too, would look bad."""
    levels = {0: 1, 0.2: 2, 0.5: 4, 0.75: 3}
    four = made_up(lambda e, beta, n: levels[beta], [PENDULUM], [*levels], [4])
    more = made_up(lambda e, beta, n: -9 + 6 * beta, [PENDULUM], [0, 0.5], [32], seeds=2)
    runs = pd.concat([four, more], ignore_index=True)
    assert runs.groupby("beta").performance.mean().idxmax() != 0.5
    row = tables.best_beta_per_env(runs).iloc[0]
    assert row[["best_beta", "beta_0.5", "runs"]].tolist() == [0.5, "comparable", 20]
    assert tables.best_beta_per_n_envs(runs).best_beta.tolist() == [0.5, 0.5]
    grid, _, _, shown = tables.rank_grids(runs)
    assert len(shown) == 24 and grid.notna().sum().tolist() == [4, 2]
    assert grid.idxmax().tolist() == [0.5, 0.5]
    table = tables.final_return_and_performance(runs).iloc[0]
    cells = runs.groupby(["n_envs", "beta"]).performance.mean()
    assert table.performance_mean == pytest.approx(cells.mean()) and table.cells == 6


def test_final_return_tables(tmp_path, write_run, selected, short_study):
    short_study(2)
    # Published for this cell is 677.5, a rounded number, which an interval of 677.54 still holds
    for seed in range(1, 6):
        write_run(tmp_path, PENDULUM, 0, 4, seed, [0.0, 677.54])
        write_run(tmp_path, PENDULUM, 0.5, 4, seed, [1.0, 694.66])  # published: 694.6
    for seed in (1, 2):
        write_run(tmp_path, PENDULUM, "vanilla", 4, seed, [2.0, 3.0])
    write_run(tmp_path, PENDULUM, 1, 4, 1, [0.0, 403.1])
    runs = selected(tmp_path)
    table = tables.final_returns(runs).set_index("beta")
    assert table["mean"].to_dict() == {"0": 677.54, "0.5": 694.66, "vanilla": 3, "1": 403.1}
    assert table.paper.to_dict() == {"0": 677.5, "0.5": 694.6, "vanilla": 733.1, "1": 403.1}
    assert table.in_interval.to_dict() == {"0": "yes", "0.5": "no", "vanilla": "no", "1": "yes"}
    wide = tables.final_return_per_beta(table.reset_index())
    assert wide.iloc[0].tolist() == [  # outside is said of five seeds and more only
        *("Pendulum Swingup", 4, 13, "677.5 [677.5, 677.5]", "677.5", "694.7 [694.7, 694.7]"),
        *("694.6 (outside)", "403.1 [403.1, 403.1]", "403.1", "3.0 [3.0, 3.0]", "733.1"),
    ]
    summary = tables.final_return_and_performance(runs[~runs.vanilla]).iloc[0]
    assert summary.final_return_mean == pytest.approx((677.54 + 694.66 + 403.1) / 3)
    assert summary.paper_performance_max == 678.91


@pytest.mark.parametrize("gamma", [0.99, 0.9])
def test_no_published_numbers_beside_other_settings(made_up, gamma):
    runs = made_up(lambda *_: 0, [PENDULUM], (0, 0.5), (4,), gamma=gamma)
    returns = tables.final_returns(runs)
    wide = tables.final_return_per_beta(returns)
    made = [returns, wide, tables.final_return_and_performance(runs)]
    made += [tables.best_beta_per_env(runs).iloc[:1], tables.best_beta_per_n_envs(runs)]
    for table in made:
        paper = table.filter(regex="^paper|in_interval")
        assert (paper.notna() & (paper != "")).any(axis=None) == (gamma == 0.99)
        assert set(table.get("differs", [""])) == {"" if gamma == 0.99 else "--gamma 0.9"}
    assert ("(outside)" in wide.to_string()) == (gamma == 0.99)


def test_final_returns_on_the_published_scale(made_up):
    """By hand: pendulum's published means go from 1.1 to 766.9, Mountain Car's from 0 to 96.7."""
    ends = {(PENDULUM, 0): 1.1, (PENDULUM, 0.2): 766.9, (CAR, 0): 0, (CAR, 0.2): 96.7 * 0.2}
    runs = made_up(lambda *_: 0, [PENDULUM, CAR], (0, 0.2), (4,), seeds=2)
    off = np.where(runs.env_id == CAR, 0, 20.0 * runs.seed - 10)
    keys = zip(runs.env_id, runs.beta, strict=True)
    runs["final_return"] = np.array([ends[key] for key in keys]) + off
    one = runs[(runs.env_id == CAR) & (runs.beta == 0.2) & (runs.seed == 0)]
    other = one.assign(beta=1.0, gamma=0.9)  # not the paper's settings, and no beta of it:
    more = [one.assign(n_envs=32, final_return=0.0), one.assign(beta=0.3), other]
    table = tables.average_final_returns(pd.concat([runs, *more], ignore_index=True))
    counts = table[["n_envs", "beta", "runs", "environments"]].to_numpy().tolist()
    assert counts == [[4, 0, 4, 2], [4, 0.2, 4, 2], [32, 0.2, 1, 1]]
    np.testing.assert_allclose(table["mean"], [0, (1 + 0.2) / 2, 0], atol=1e-9)
    paper = [(677.5 - 1.1) / 765.8 / 2, (1 + 23.4 / 96.7) / 2, 93.8 / 96.7]
    np.testing.assert_allclose(table.paper, paper)
    assert (table.high - table.low)[:2].between(0.005, 0.02).all() and np.isnan(table.low[2])
    with pytest.raises(Unusable, match="the study's settings"):
        tables.on_published_scale(other)


def test_projected_ranks_from_the_published_best_betas():
    """By hand: sigma(beta) in closed form, written out again, then sigma*, E_ij and ranks."""
    T, betas, n_envs = 1000, [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2], [1, 2, 4, 8, 16, 32, 64, 128]

    def sigma(beta):
        f = np.arange(1, T // 2 + 1) / T
        w = f ** (-beta / 2)
        w[-1] /= 2
        # The DC bin is real, its std sqrt(2) s_1; divided by T in the inverse FFT, then by sigma
        return np.sqrt(2) * f[0] ** (-beta / 2) / T / (2 / T * np.sqrt((w**2).sum()))

    assert [round(sigma(b), 4) for b in (0, 0.5, 1, 2)] == [0.0316, 0.1075, 0.2713, 0.5517]
    paper = published("best_beta_per_n_envs").set_index("n_envs").best_beta
    star = sum(sigma(beta) / n**0.5 for n, beta in paper.items()) / 8
    ranks = tables.projected_ranks(paper, betas, n_envs, T)
    for n in n_envs:
        E = [(star - sigma(beta) / n**0.5) ** 2 for beta in betas]
        assert ranks[n].tolist() == [1 + sum(other < e for other in E) for e in E]


def test_saved_tables(tmp_path):
    table = pd.DataFrame({"environment": ["A_b"], "p": [0.00123], "runs": [3], "x": [np.nan]})
    tables.save_table(table.assign(mean=1.23456), tmp_path, "t")
    assert (tmp_path / "t.csv").read_text().splitlines()[1] == "A_b,0.00123,3,,1.23456"
    assert (tmp_path / "t.md").read_text().splitlines()[2] == "| A_b | 0.0012 | 3 |  | 1.23 |"
    assert r"A\_b & 0.0012 & 3 &  & 1.23" in (tmp_path / "t.tex").read_text()
