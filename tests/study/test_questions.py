"""study/questions.py on made-up runs, beside numbers that were put in."""

import functools
import re

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from study import questions
from study.protocol import GYMNASIUM

approx = functools.partial(pytest.approx, abs=0.005)


def numbers(text):
    """The three of "mean [low, high]"."""
    return list(map(float, re.findall(r"[-\d.]+", text)))


def test_leads_in_gymnasium_are_those_put_in(monkeypatch):
    """0.5 is ahead by one standard deviation in each task and setting, 1 behind by half in B."""
    rng, scores = np.random.default_rng(0), {}
    for scale, task in enumerate(GYMNASIUM, start=1):
        for n_envs in (1, 32):
            for beta, lead in (("0", 0), ("0.5", 1), ("1", -0.5 * (n_envs == 32))):
                x = rng.normal(size=8)
                scores[task, n_envs, beta] = 10**scale * ((x - x.mean()) / x.std(ddof=1) + lead)
    monkeypatch.setattr(questions, "gymnasium_scores", lambda last=5: scores)
    table = questions.gymnasium().set_index("task")
    own = stats.t.ppf(1 - 0.05 / 6 / 2, 21) * (2 / 8) ** 0.5
    for task in GYMNASIUM:
        assert numbers(table["A: 0.5 over 0"][task]) == approx([1, 1 - own, 1 + own])
    means = [numbers(text)[0] for text in table.loc["average, these tasks, 95 %"]]
    assert means == [1, 0, 1, -0.5, -0.5]
    half = stats.t.ppf(0.975, 6 * 21) * (2 / 8 / 6) ** 0.5
    average = numbers(table["A: 0.5 over 0"]["average, these tasks, 95 %"])
    assert average == approx([1, 1 - half, 1 + half])
    assert table["A: 0.5 over 0"]["average, tasks like these, 95 %"] == "1.00 [1.00, 1.00]"
    baseline = questions.gymnasium_baseline().set_index("task")
    assert baseline["SB3 zoo (v3)"]["Hopper-v5"] == "one tuned run 2410"
    made = pd.read_csv(questions.RESULTS / "gymnasium_baseline.csv").set_index("env_id")
    last_five = made.iloc[:, -5:].mean(axis=1)
    for task, flag in ("Ant-v5", "include_cfrc_ext"), ("Swimmer-v5", "--gamma 0.9999"):
        other = baseline[baseline.flag != ""].loc[task]
        assert other["SB3 zoo (v3)"] == "" and flag in other.flag
        in_a = last_five[made.n_envs == 1].loc[task]
        assert numbers(other["this script (v5)"]) == list(in_a.round())
    mean, low, high = numbers(baseline["this script (v5)"]["Hopper-v5"])
    assert mean == 0 and -80 < low < -50 and 50 < high < 80  # of 8 with standard deviation 100


def test_the_ants_lead_without_contact_forces():
    made = pd.read_csv(questions.RESULTS / "gymnasium_baseline.csv").query("n_envs == 32")
    last_five = made.iloc[:, -5:].mean(axis=1)
    white, half = (last_five[made.beta == beta] for beta in (0, 0.5))
    assert len(white) == len(half) == 8
    less = stats.ttest_ind(half, white, equal_var=False).confidence_interval()
    check = questions.gymnasium_ant()["0.5 less 0"].iloc[-1].split(", p")[0]
    assert numbers(check) == [round(half.mean() - white.mean()), *(round(x) for x in less)]


def test_the_interval_of_these_tasks_holds_what_it_should(monkeypatch):
    """Of 200 made-up studies, whose tasks differ."""
    rng, held, tasks = np.random.default_rng(0), 0, GYMNASIUM
    leads = rng.normal(size=len(tasks))
    cells = {(i, n, beta) for i in range(len(tasks)) for n in (1, 32) for beta in ("0", "0.5", "1")}
    for _ in range(200):
        scores = {
            (tasks[i], n, beta): rng.normal(leads[i] * (beta == "0.5"), size=8)
            for i, n, beta in sorted(cells)
        }
        monkeypatch.setattr(questions, "gymnasium_scores", lambda last, made=scores: made)
        table = questions.gymnasium().set_index("task")["A: 0.5 over 0"]
        _, low, high = numbers(table["average, these tasks, 95 %"])
        held += low < leads.mean() < high
    assert 0.9 <= held / 200 <= 0.99


def test_welchs_interval_and_the_order():
    text = questions.difference_text(np.arange(10.0) + 100, np.arange(10.0))
    assert text == "100 [97, 103], p = 0.00018"


@pytest.mark.parametrize("question", questions.QUESTIONS, ids=lambda question: question.__name__)
def test_answers_are_tables_of_text(question):
    """Of the runs in results/."""
    assert question().map(lambda cell: isinstance(cell, str)).all(axis=None)
