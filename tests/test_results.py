"""results/README.md and the README's table of agreement say what the data in results/ say."""

import re
from pathlib import Path

import pytest
from scipy import stats

from study import claims
from study.runs import load, select_methods
from study.statistics import mean_interval
from study.tables import final_return_per_beta, final_returns

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
RESULTS = (ROOT / "results" / "README.md").read_text()


def section(text, heading):
    """The text under a heading of the second level."""
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def say(*names):
    """Runs of files in results, by method, and what they say of the paper's claims."""
    loaded, curves = load([ROOT / "results" / name for name in names])
    methods, _ = select_methods(loaded)
    return methods, claims.coverage(methods, curves)


@pytest.fixture(scope="module")
def measured():
    """Our runs of the study's grid."""
    return say("reproduction.csv", "study.csv")


def test_the_claims_so_far_are_those_of_the_data(measured):
    """Every verdict that our runs have something to say on, and no other, in the table's order."""
    methods, coverage = measured
    table = RESULTS.split("| so far | our runs |\n| --- | --- | --- | --- |\n")[1].split("\n\n")[0]
    about = coverage[coverage.verdict.ne("") & coverage.runs.ne("none needed")]
    about = about[about.data.str.contains(r"\d") & ~about.data.str.startswith("needs")]
    columns = ["where", "says", "verdict", "data"]
    assert table.splitlines() == [f"| {' | '.join(row)} |" for row in about[columns].to_numpy()]
    whole, tasks = claims.offset(methods["ppo"])
    assert whole.split(", where")[0] in RESULTS
    assert all(low in RESULTS for low in tasks.split(", ")[:2])


def test_the_slices_are_those_of_the_data():
    text = section(RESULTS, "Slices of the appendix")
    methods, coverage = say("reproduction.csv", "study.csv", "slices.csv")
    about = coverage[coverage["where"].isin(["Fig. A6", "Fig. A8", "Fig. A11", "Fig. A12"])]
    assert len(about) == 5 and (about.verdict == "open").all()
    for row in about[["where", "says", "data"]].to_numpy():
        assert f"| {' | '.join(row)} |" in text
    runs = methods["ppo"]
    usual = (runs.n_envs == 4) & (runs.n_steps == 2048) & (runs.n_epochs == 10)
    half = runs.beta == 0.5
    columns = [usual & runs.vanilla, usual & (runs.beta == 0), usual & half]
    columns += [half & (runs.n_steps == n) for n in (4096, 1024)]
    columns += [half & (runs.n_epochs == n) for n in (5, 20)]
    for name in ("Mountain Car", "Pendulum Swingup", "Cartpole Balance", "Reacher Hard"):
        here = [runs[column & (runs.environment == name)].performance.mean() for column in columns]
        assert f"| {' | '.join([name, *(f'{x:z.1f}' for x in here)])} |" in text


@pytest.mark.parametrize(
    ("file", "varies"), [("noise_length.csv", "noise_seq_len"), ("new_seeds.csv", "batch_size")]
)
def test_new_seeds_are_those_of_the_data(file, varies):
    text = section(RESULTS, "Where the numbers differ")
    runs, _ = load([ROOT / "results" / file])
    runs = runs[runs.status == "complete"]
    cell = ["env_id", "beta", "n_envs", varies, "bootstrap_timeouts", runs.seed // 100]
    groups = [x for _, x in runs.groupby(cell) if len(x) >= 10]
    assert len(groups) >= 4
    for group in groups:
        mean, low, high = mean_interval(group.final_return)
        assert f" {mean:z.1f} [{low:z.1f}, {high:z.1f}] |" in text
    usual = (runs.beta == "0") & (runs.batch_size == 128) & ~runs.bootstrap_timeouts.astype(bool)
    thirty = [x.final_return for _, x in runs[usual].groupby(["env_id", "n_envs"]) if len(x) == 30]
    assert len(thirty) == (2 if varies == "batch_size" else 0)
    for values in thirty:  # white noise in pendulum
        mean, low, high = mean_interval(values)
        assert f"at {mean:.0f} [{low:.0f}, {high:.0f}] (published" in text


def test_the_comparisons_of_new_seeds_are_those_of_the_data():
    text = section(RESULTS, "Where the numbers differ")
    runs, _ = load([ROOT / "results" / "new_seeds.csv"])
    runs = runs[(runs.env_id == "dm_control/pendulum-swingup-v0") & (runs.status == "complete")]
    runs = runs.assign(default=runs.bootstrap_timeouts.astype(bool))

    def p(a, b, column="final_return"):
        return f"p = {stats.mannwhitneyu(a[column], b[column]).pvalue:.2f}"

    small, default, usual = {}, {}, {}
    for n_envs, group in runs.groupby("n_envs"):
        small[n_envs] = group[group.batch_size == 64]
        default[n_envs] = group[group.default]
        usual[n_envs] = group[(group.batch_size == 128) & ~group.default]
    means = [f"{x[1].performance.mean():.0f}" for x in (small, usual)]
    sooner = p(small[1], usual[1], "performance")
    assert f"(performance {means[0]}, these {means[1]}; Mann-Whitney, {sooner})" in text
    assert f"end where these do ({p(small[1], usual[1])})" in text
    assert f"does worse ({p(default[1], usual[1])})" in text
    same_seeds = usual[4][usual[4].seed.isin(small[4].seed)]
    assert f"n_envs 4: Mann-Whitney, {p(small[4], same_seeds)})" in text


def test_the_table_of_agreement_is_the_data(measured):
    text = section(README, "What agrees with the paper, and what does not")
    methods, coverage = measured
    table = final_return_per_beta(final_returns(methods["ppo"])).astype(str)
    cells = table.set_index(["environment", "n_envs"])
    for place, beta, numbers in (
        (("Pendulum Swingup", "4"), "beta 1", "103 [39, 126]"),
        (("Cartpole Swingup", "4"), "beta 1", "301 [95, 592]"),
        (("Reacher Hard", "4"), "beta 0", "535 [353, 603]"),
    ):
        measured = re.findall(r"[\d.]+", cells.loc[place, beta])
        said = re.findall(r"\d+", numbers)
        assert numbers in text and [f"{float(x):.0f}" for x in measured] == said
    pendulum = methods["ppo"].query("environment == 'Pendulum Swingup'")
    performance = pendulum.groupby(["beta", "n_envs"]).performance.mean().unstack()
    best = ", ".join(f"{beta:g}" for beta in performance.idxmax()[[1, 4, 32]])
    assert f"| Pendulum, β of best performance, n_envs 1, 4, 32 | {best} | 0, 0.5, 1 |" in text
    verdicts = coverage.set_index("says").data
    outside, of = re.match(r"(\d+) of (\d+)", verdicts["final returns"]).groups()
    expected = re.search(r"([\d.]+) expected", verdicts["final returns"])[1]
    assert f"| {of} cells: published mean outside our interval | {outside} |" in text
    assert f"{expected} expected" in text
    lead = re.search(
        r"over 0 (\S+ \[\S+, \S+\]) \((\d+)", verdicts["beta 0.5 outperforms white noise"]
    )
    standard_deviations = lead[1].replace(" ", " standard deviations ", 1)
    assert f"ahead of white, {lead[2]} environments | {standard_deviations} |" in text
