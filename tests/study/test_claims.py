"""study/claims.py: what the data say about each of the paper's claims; verdicts flip with them."""

import re
from functools import partial

import numpy as np
import pandas as pd
import pytest

from study import claims
from study.protocol import BETAS, COMPLEX, MAIN, N_ENVS, NAMES
from study.runs import published
from study.statistics import mean_interval, standardize

PENDULUM, CAR = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0"


@pytest.fixture
def coverage(monkeypatch):
    """coverage(claims, ppo=runs, ...): the table of these claims, by what they say."""
    every = claims.CLAIMS

    def table(says, **methods):
        monkeypatch.setattr(claims, "CLAIMS", [row for row in every if row[1] in says])
        assert len(claims.CLAIMS) == len(says)
        runs = pd.concat(methods.values(), ignore_index=True)
        curves = pd.DataFrame({10: 0.0, 20: runs.final_return, 30: runs.final_return}, runs.index)
        return claims.coverage(runs, curves).set_index("says")

    return table


@pytest.fixture
def verdicts(coverage):
    """verdicts(claims, ppo=runs, ...): the verdicts, in the order of these claims."""
    return lambda says, **methods: coverage(says, **methods).verdict[says].tolist()


def test_every_claim_has_a_row():
    """Whatever the runs."""
    axes = {"method": [], "environment": [], "beta": 0.0, "n_envs": 0, "n_steps": 0, "n_epochs": 0}
    runs = pd.DataFrame({**axes, "seed": 0, "vanilla": False, "env_id": [], "performance": 0.0})
    table = claims.coverage(runs, pd.DataFrame()).set_index("says")
    assert len(table) == len(claims.CLAIMS) == 36
    assert (table.verdict == "open").sum() == 27 == (table.data == "no runs").sum()
    assert table.runs["final returns"] == "0 of 23040"
    assert table.command["final returns"].startswith("./run_sweep.sh main; ./run_sweep.sh vanilla;")


def test_claims_on_noise_flip_with_the_data(made_up, coverage):
    """White noise behind 0.5, pink in between; then the same turned over; then no difference."""

    def level(env_id, beta, n):
        best = 0 if n == 1 else 0.5 if n == 4 else 1
        return -3 * abs(beta - best) - 2 * (n == 32) + beta * (env_id == CAR) * 40

    says = ["larger n_envs wants larger beta", "ranks follow those projected from the bias"]
    says += ["beta 1 gains with larger n_envs", "more environments than 4 do worse"]
    says += ["Pendulum Swingup: beta 0, 0.5, 1 best with n_envs 1, 4, 32"]
    table = coverage(says, ppo=made_up(level))
    turned = coverage(says, ppo=made_up(lambda *of: -level(*of)))
    flat = coverage(says, ppo=made_up(lambda *of: 0))
    assert set(table.verdict) == {"holds"} and set(turned.verdict) == {"does not"}
    assert set(flat.verdict) <= {"open", "does not"}
    assert table.runs[says[0]] == "720 of 20480"


def test_the_best_beta_and_the_rule(made_up, coverage, verdicts):
    def level(env_id, beta, n):
        return -abs(beta - 0.5) * (1 if env_id != MAIN[0] else -1) - abs(np.log2(n) - 2)

    says = ["beta 0.5 is best on average", "beta 0.5 outperforms white noise"]
    color, few = "the color of the noise affects performance", [0, 0.5, 1]
    whole = made_up(level, betas=BETAS, seeds=3)
    assert verdicts(says, ppo=whole) == ["holds", "holds"]
    # Not "best" while rivals are missing, yet not best where one is ahead
    assert verdicts([*says, color], ppo=whole[whole.beta.isin(few)]) == ["open", "holds", "holds"]
    behind = whole[whole.beta.isin([0, 0.5])].assign(beta=lambda x: 0.5 - x.beta)
    assert verdicts(says, ppo=behind) == ["does not", "does not"]
    # One seed, too few environments, too few n_envs, another setting: open, with the number
    seven = whole[whole.env_id.isin(MAIN[:7])]
    cases = [(whole[whole.seed == 0], 384), (seven, 504), (whole[whole.n_envs == 4], 384)]
    for runs, count in [*cases, (whole.assign(gamma=0.9), 0)]:
        table = coverage(says, ppo=runs)
        assert set(table.verdict) == {"open"} and set(table.runs) == {f"{count} of 20480"}
    # An environment with one seed more, or with more betas, takes nothing away
    first = whole.env_id == MAIN[3]
    rest = whole[~first & whole.beta.isin(few)]
    more = whole[first & ((whole.seed == 0) | (whole.beta == 0.5))]
    for runs in (rest, pd.concat([rest, more])):
        assert verdicts(says, ppo=runs) == ["open", "holds"]
    # A cell counts no more than the paper's twenty seeds
    many = made_up(level, envs=[CAR], betas=[0], n_envs=[4], seeds=30)
    assert coverage(says, ppo=many).runs[says[0]] == "20 of 20480"


def test_the_best_n_envs(made_up, verdicts):
    says = ["n_envs 4 is best on average", "n_envs 2 and 4 outperform all others"]
    runs = made_up(lambda e, b, n: -abs(np.log2(n) - 2), MAIN[:8], (0, 0.5, 1), N_ENVS)
    assert verdicts(says, ppo=runs) == ["holds", "open"]  # 2 is as good as 8
    runs = made_up(lambda e, b, n: -abs(np.log2(n) - 1.5), MAIN[:8], (0, 0.5, 1), N_ENVS)
    assert verdicts(says, ppo=runs) == ["open", "holds"]


def test_the_best_beta_depends_on_the_environment(made_up):
    def claim(of, says=claims.best_beta_varies):
        runs = made_up(lambda e, beta, n: beta * of.get(e, 0), n_envs=[4])
        found = says(runs.assign(z=standardize(runs)))
        return found.verdict, found.data

    verdict, text = claim({CAR: 3, PENDULUM: -3})
    assert verdict == "holds" and "0 in 1 (Mountain Car), behind in 1 (Pendulum" in text
    assert claim({CAR: 3})[0] == "open" and claim({})[0] == "open"
    # And 0.5 is ahead in most environments: in nine, not in eight; behind in eight
    for count, sign, verdict in ((9, 1, "holds"), (8, 1, "open"), (8, -1, "does not")):
        leads = dict.fromkeys(MAIN[:count], sign * 6)
        assert claim(leads, claims.ahead_in_most)[0] == verdict


def test_averages_are_of_the_same_cells_in_every_environment(made_up, coverage):
    """0.5 leads by 1 with n_envs 4 and is behind by 0.75 else: behind on average, not ahead."""

    def level(env_id, beta, n):
        return (beta == 0.5) * (1 if n == 4 else -0.75)

    claim = "beta 0.5 outperforms white noise"
    whole = made_up(level, betas=(0, 0.5), seeds=10)
    assert coverage([claim], ppo=whole).verdict[claim] == "does not"
    for there, verdict, text in (
        (8, "does not", "(8 environments, n_envs 1, 4, 32)"),
        (7, "open", "(16 environments, n_envs 4: too few)"),
    ):
        runs = whole[(whole.n_envs == 4) | whole.env_id.isin(MAIN[:there])]
        row = coverage([claim], ppo=runs).loc[claim]
        assert row.verdict == verdict and text in row.data


def test_a_best_beta_that_is_the_same_everywhere_is_no_trend(made_up):
    """With any n_envs: neither larger with more of them, nor as the bias projects."""
    runs = made_up(lambda e, beta, n: -3 * abs(beta - 0.5))
    runs = runs.assign(z=standardize(runs))
    for weights in (claims.larger_n_envs_larger_beta, claims.ranks_as_projected):
        found = claims.unseen(runs, "", weights)
        assert found.verdict == "open" and found.low < 0 < found.high


def test_trends_are_decided_by_environments_that_were_not_seen_before(made_up):
    """They rise in those that had been seen, and fall in the others."""

    def level(env_id, beta, n):
        return beta * np.log2(n) * (1 if NAMES[env_id] in claims.SEEN else -1)

    runs = made_up(level)
    runs = runs.assign(z=standardize(runs))
    claim = partial(claims.unseen, what="", weights_of=claims.larger_n_envs_larger_beta)
    assert claim(runs).verdict == "does not"
    few = runs[runs.environment.isin(claims.SEEN)]
    found = claim(few)
    assert found.verdict == "open" and found.decides == "the other 7 environments"
    weak = made_up(lambda e, beta, n: 0.01 * beta * np.log2(n))
    found = claim(weak.assign(z=standardize(weak)))
    assert found.verdict == "open" and re.match(r"[\d,]+ runs more, if", found.decides)


def test_runs_of_a_few_environments_change_no_verdict_on_all(made_up, coverage):
    """Another beta in three environments, and another n_envs: the same numbers."""
    says = ["beta 0.5 outperforms white noise", "the color of the noise affects performance"]
    says += ["colored noise does better than white in most environments"]
    runs = made_up(lambda e, beta, n: 0.1 * beta)
    more = [made_up(lambda *of: 9, MAIN[:3], betas=[2], seeds=2)]
    more += [made_up(lambda *of: -9, MAIN[:3], n_envs=[8], seeds=2)]
    before, after = coverage(says, ppo=runs), coverage(says, ppo=pd.concat([runs, *more]))
    columns = ["verdict", "data", "mean", "low", "high", "decides"]
    pd.testing.assert_frame_equal(before[columns], after[columns])


def test_what_would_decide(made_up):
    """With as many runs as it says, of the same scatter, the interval just excludes nothing."""
    runs = made_up(lambda e, beta, n: 0.05 * (beta == 0.5), betas=(0, 0.5), n_envs=[4])
    runs = runs.assign(z=standardize(runs))
    weights = {0.5: 1, 0.0: -1}
    found = claims.between(runs, "", weights, "beta")
    assert found.verdict == "open" and found.low < 0 < found.mean
    more = int(re.search(r"([\d,]+) runs more, if", found.decides)[1].replace(",", ""))
    times = round((len(runs) + more) / len(runs))
    many = pd.concat([runs] * times)
    low = claims.between(many, "", weights, "beta").low
    assert 0 < low < found.mean / 3 or -found.mean / 3 < low < 0
    few = claims.between(runs[runs.env_id.isin(MAIN[:5])], "", weights, "beta")
    assert few.decides == "3 environments more"


def test_claims_that_two_are_the_same(made_up, verdicts):
    """They hold within a quarter of a standard deviation, and fail beyond."""
    spread = {env_id: i for i, env_id in enumerate(MAIN)}

    def vanilla(change):
        levels = lambda e, beta, n: 2 * (n == 1) + spread[e] + change * np.isnan(beta)  # noqa: E731
        return made_up(levels, betas=(0, np.nan), seeds=10)

    claim = ["beta 0 matches vanilla PPO"]
    assert verdicts(claim, ppo=vanilla(0)) == ["holds"]
    assert verdicts(claim, ppo=vanilla(1)) == ["does not"]
    few = vanilla(0)
    assert verdicts(claim, ppo=few[few.seed < 1]) == ["open"]

    def sizes(change):
        steps, few = {2: 4096, 4: 2048, 8: 1024}, {"betas": [0.5], "seeds": 20}
        runs = [
            made_up(lambda e, beta, n: change * (n == 8), n_envs=[n], n_steps=steps[n], **few)
            for n in steps
        ]
        return pd.concat(runs)

    claim = ["n_envs and n_steps do not matter if their product stays"]
    assert verdicts(claim, ppo=sizes(0)) != ["does not"]
    assert verdicts(claim, ppo=sizes(1)) == ["does not"]


def test_claims_on_epochs_and_complex_tasks(made_up, verdicts):
    def epochs(loss, turn):
        few = {"betas": (0.2, 0.5, 0.75), "n_envs": [4], "seeds": 10}
        runs = [
            made_up(lambda e, beta, n: -abs(beta - 0.5), **few, n_epochs=10),
            made_up(lambda e, beta, n: -loss - abs(beta - 0.5), **few, n_epochs=5),
            made_up(lambda e, beta, n: -turn * abs(beta - 0.5), **few, n_epochs=20),
        ]
        return pd.concat(runs)

    worse = ["half the epochs do worse"]
    assert verdicts(worse, ppo=epochs(1, 1)) == ["holds"]
    assert verdicts(worse, ppo=epochs(-1, 1)) == ["does not"]
    same = ["the preference for 0.5 is the same with 5, 10 and 20 epochs"]
    assert verdicts(same, ppo=epochs(4, 1)) == ["holds"]
    assert verdicts(same, ppo=epochs(0, -3)) == ["does not"]

    favored = ["beta 0.5 is favored in complex tasks"]
    runs = made_up(lambda e, beta, n: -3 * abs(beta - 0.5), COMPLEX, BETAS, [4])
    assert verdicts(favored, ppo=runs) == ["holds"]
    assert verdicts(favored, ppo=runs[runs.seed == 0]) == ["open"]
    assert verdicts(favored, ppo=runs.assign(performance=-runs.performance)) == ["does not"]


def test_claims_on_trpo_and_a2c(made_up, coverage, verdicts):
    says = ["beta 0.5 improves TRPO", "beta 0.5 improves A2C", "the effect is less in A2C"]
    says += ["A2C learns less than PPO and TRPO"]

    def runs(trpo, a2c, behind):
        levels = {"ppo": (3, 1), "trpo": (3, trpo), "a2c": (3 - behind, a2c)}
        return {
            name: made_up(lambda e, beta, n, m=m, s=s: m + s * beta, n_envs=[4], method=name)
            for name, (m, s) in levels.items()
        }

    table = coverage(says, **runs(2, 0.5, 3))
    assert set(table.verdict) == {"holds"}
    assert table.runs[says[3]] == "720 of 7680" and table.runs[says[0]] == "240 of 2560"
    opposite = ["does not", "holds", "does not", "does not"]
    assert verdicts(says, **runs(-0.5, 2, -3)) == opposite
    few = made_up(lambda e, beta, n: beta, MAIN[:7], n_envs=[4], method="trpo")
    assert verdicts(says[:1], trpo=few) == ["open"]  # less than half of the environments
    # Methods are compared at the betas that both have: PPO's redder noise, bad here, counts not
    ppo = made_up(lambda e, beta, n: -5 * (beta > 1), n_envs=[4], betas=(0, 0.5, 1, 1.25, 2))
    row = coverage(says[3:], **runs(0, 0, 3) | {"ppo": ppo.assign(performance=ppo.performance + 3)})
    assert row.verdict.tolist() == ["holds"] and "beta 0, 0.5, 1)" in row.data.iloc[0]


def test_gsde_is_compared_with_red_noise(made_up, verdicts):
    runs = made_up(lambda e, beta, n: -2 * beta, betas=(0.5, 1.25, 2), seeds=10)
    for level, verdict in ((-3.25, "holds"), (0, "does not")):
        how = {"betas": [np.nan], "method": "gsde", "vanilla": False, "seeds": 10}
        gsde = made_up(lambda *of, level=level: level, **how)
        assert verdicts(["gSDE is like beta 1.25 to 2"], ppo=runs, gsde=gsde) == [verdict]


def test_white_noise_hardly_finds_the_goal():
    """Of n runs: the interval of the share is below a tenth, or above, or neither."""
    for n, found, verdict in (
        (5, 0, "open"),
        (40, 0, "holds"),
        (40, 1, "open"),
        (40, 12, "does not"),
    ):
        runs = pd.DataFrame({"final_return": [94.0] * found + [-1e-5] * (n - found)})
        assert claims.hardly_found(runs).verdict == verdict


def test_policies_that_collapse_are_counted(made_up):
    every = made_up(lambda *of: 5, n_envs=[4], betas=BETAS)
    few = every[every.beta <= 1]
    for runs, share, verdict in ((every, 0, "holds"), (few, 0, "open"), (few, 0.5, "does not")):
        curves = pd.DataFrame({10: 0.0, 20: 5.0, 30: 5.0}, runs.index)
        curves.loc[runs.seed < 5 * share, 30] = 1.0
        parts = claims.claim_runs(runs, curves)
        assert claims.no_collapse(parts["n_envs 4"][0]).verdict == verdict


def test_cells_outside_are_compared_with_chance():
    """MISSES, here checked for five seeds by simulation; of three, in a pooled interval, exact."""
    rng = np.random.default_rng(3)
    samples, means = rng.normal(size=(200, 5)), rng.normal(size=200) / 20**0.5
    ends = [mean_interval(sample, 999)[1:] for sample in samples]
    missed = [not low < mean < high for (low, high), mean in zip(ends, means, strict=True)]
    assert np.mean(missed) == pytest.approx(claims.MISSES[5], abs=0.07)
    table = pd.DataFrame(
        {"in_interval": ["yes", "no", "yes", np.nan, "no"], "runs": [5, 5, 3, 1, 5]}
    )
    table = table.assign(low=0, high=[1, 1, 1, np.nan, 0])  # the last without scatter
    count, n, chance, line = claims.outside(table)
    assert count == 1 and n == 3 and chance == pytest.approx(2 * 0.191 + 0.0675, abs=1e-3)
    assert line.startswith("1 of 3 published means outside")


def test_how_far_from_the_published_on_average(made_up):
    """The interval of many made-up studies holds what was added to the published means."""
    cells = published("final_return_per_beta").set_index(["environment", "n_envs", "beta"])
    top = published("final_return_per_beta").query("beta != 'vanilla'")
    top = top.groupby("environment").final_return_mean.agg(np.ptp)
    rng, held = np.random.default_rng(0), []
    for _ in range(30):
        runs = made_up(lambda *_: 0, MAIN[:8], n_envs=[4])
        key = [runs.environment, runs.n_envs, runs.beta.map("{:g}".format)]
        paper = cells.final_return_mean[list(zip(*key, strict=True))].to_numpy()
        sampled = runs.groupby(["environment", "beta"]).seed.transform(lambda s: rng.normal())
        noise = rng.normal(size=len(runs)) + sampled / 20**0.5
        runs["final_return"] = paper + runs.environment.map(top) * (0.1 + 0.3 * noise)
        line, tasks = claims.offset(runs)
        low, high = (float(x) for x in re.search(r"\[(\S+), (\S+)\]", line).groups())
        held.append(low - 0.005 <= 0.1 <= high + 0.005)
    assert "on average over 24 cells" in line and np.mean(held) >= 0.85
    # The tasks are in order, and their average is the whole
    each = [float(x) for x in re.findall(r" (-?[\d.]+) \(3 cells\)", ", ".join(tasks))]
    whole = float(re.search(r"published (\S+)", line)[1])
    assert len(each) == 8 and each == sorted(each)
    assert np.mean(each) == pytest.approx(whole, abs=0.011)


def test_published_means_far_off_are_more_than_chance(made_up):
    table = published("final_return_per_beta")
    mean = table[table.n_envs == 4].set_index(["environment", "beta"]).final_return_mean

    def claim(off):
        few = {"betas": [0, 0.5], "n_envs": [4], "envs": MAIN[:6]}
        runs = made_up(lambda e, beta, n: off + mean[NAMES[e], f"{beta:g}"], **few)
        return claims.published_final_returns(runs)

    assert claim(0).verdict == "open" and claim(3).verdict == "does not"
    assert claim(3).data.startswith("12 of 12 published means outside")
