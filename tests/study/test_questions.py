"""study/questions.py on made-up runs, beside numbers that were put in."""

import numpy as np
import pytest

from study import questions
from study.protocol import GYMNASIUM


def test_leads_in_gymnasium_are_those_put_in(monkeypatch):
    """0.5 is ahead by one standard deviation in each task and setting, 1 behind by half in B."""
    rng, scores = np.random.default_rng(0), {}
    for scale, task in enumerate(GYMNASIUM, start=1):
        for n_envs in (1, 32):
            for beta, lead in (("0", 0), ("0.5", 1), ("1", -0.5 * (n_envs == 32))):
                x = rng.normal(size=400)
                scores[task, n_envs, beta] = 10**scale * ((x - x.mean()) / x.std(ddof=1) + lead)
    monkeypatch.setattr(questions, "gymnasium_scores", lambda measure: scores)
    table = questions.gymnasium(draws=500).set_index("task")
    assert (table["A: 0.5 over 0"][GYMNASIUM].astype(float) == 1).all()
    assert table.loc["average"].astype(float).tolist() == [1, 0, 1, -0.5, -0.5]
    # The error of a mean of six tasks by 400 seeds, and of tasks that are all the same
    low, high = map(float, table["A: 0.5 over 0"]["95 %, by seeds"].split(" to "))
    assert (high - low) / 2 == pytest.approx(1.96 * (2 / 400 / 6) ** 0.5, abs=0.015)
    wider = table["A: 0.5 over 0"]["95 %, by tasks and seeds"].split(" to ")
    assert float(wider[1]) - float(wider[0]) > high - low


def test_welchs_interval_and_the_order():
    text = questions.difference_text(np.arange(10.0) + 100, np.arange(10.0))
    assert text == "100 [97, 103], p = 0.00"


@pytest.mark.parametrize("question", questions.QUESTIONS, ids=lambda question: question.__name__)
def test_answers_are_tables_of_text(question):
    """Of the runs in results/, as far as they are there."""
    table = question()
    assert table is None or table.map(lambda cell: isinstance(cell, str)).all(axis=None)
