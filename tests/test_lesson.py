"""docs/lesson.md: its snippets print what it says, and its edits apply and do what it says."""

import contextlib
import io
import re

import numpy as np
import pytest
import torch
from conftest import ROOT
from test_docs import blocks, section
from test_edits import edit, run

LESSON = (ROOT / "docs" / "lesson.md").read_text()
EDITS = blocks(LESSON, "diff")


def printed(code):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(code, {})
    return out.getvalue()


def table(text):
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return rows[2:]


def test_the_parts_take_90_minutes():
    rows = table(LESSON.split("\n## ")[0])
    assert sum(float(row[1]) for row in rows) == 90 and len(rows) == LESSON.count("\n## ")


def test_look_at_noise():
    """What is measured, the closed form, and the table in the text are the same."""
    text = section(LESSON, "1. Look at noise")
    lines = printed(blocks(text, "python")[0]).splitlines()
    measured, closed_form = (
        [[float(x) for x in re.findall(r"-?\d+\.\d\d", line)] for line in lines[i::2]]
        for i in (0, 1)
    )
    said = [[float(x) for x in row[1:]] for row in table(text)]
    np.testing.assert_allclose(closed_form, said, atol=1e-9)
    np.testing.assert_allclose(measured, said, atol=0.011)


def test_why_it_works():
    """With three of the twenty seeds."""
    text = section(LESSON, "3. Why it works")
    code, spectrum = blocks(text, "python")
    lines = printed(code.replace("range(1, 21)", "range(1, 4)")).splitlines()
    assert [int(re.search(r"found in (\d+)", line)[1]) for line in lines] == [0, 3, 3, 3]
    power = [float(line.split()[1]) for line in printed(spectrum).splitlines()]
    assert power == [1.0, 3.1, 5.3, 1.6] and "White 1.0, then 3.1, pink 5.3, red 1.6" in text


def hunks(diff):
    """Pairs of (old lines, new lines)."""
    for hunk in re.split(r"\n\n", diff.rstrip("\n")):
        lines = hunk.split("\n")
        yield tuple("\n".join(line[1:] for line in lines if line[0] == sign) for sign in "-+")


@pytest.fixture
def edited(tmp_path):
    """edited(n) runs the script with the lesson's n-th edit."""

    def run_edited(n):
        return run(edit(tmp_path, *hunks(EDITS[n - 1])), tmp_path)

    return run_edited


def test_there_are_five_edits():
    assert len(EDITS) == 5 and [f"**Edit {n}" in LESSON for n in range(1, 7)] == [True] * 5 + [
        False
    ]


def test_edit_1_anneals_the_learning_rate(edited, capsys):
    *_, scalars = edited(1)
    rates = [float(x) for x in re.findall(r"learning rate (\S+)", capsys.readouterr().out)]
    assert rates == pytest.approx([1e-2 * (1 - i / 4) for i in range(4)])
    assert scalars["losses/learning_rate"][-1] == pytest.approx(rates[-1])


def test_edit_2_relu(edited):
    agent, *_ = edited(2)
    assert sum(isinstance(layer, torch.nn.ReLU) for layer in agent.modules()) == 4


def test_edit_3_logs_the_norm_of_the_gradient(edited, tmp_path):
    """Compiled, too, as tests/test_edits.py shows."""
    _, final_return, scalars = edited(3)
    assert min(scalars["losses/grad_norm"]) > 0.5  # before clipping
    assert run(edit(tmp_path), tmp_path)[1] == final_return


def rollout_noise(module, n_steps):
    args = module.parse_args(f"--n-steps {n_steps} --n-envs 2".split())
    agent = module.Agent(3, 1).requires_grad_(False)
    agent.actor_mean[-1].weight.zero_()
    noise = module.ColoredNoiseProcess(args.beta, 2, 1, seed=0)
    return args, module.exploration(agent, noise, args)


def test_edit_4_ornstein_uhlenbeck_noise(edited, tmp_path):
    module = edit(tmp_path, *hunks(EDITS[3]))
    torch.manual_seed(0)
    _, act = rollout_noise(module, 20_000)
    obs = np.zeros((2, 3), np.float32)
    eps = np.array([act(obs, t) for t in range(20_000)])
    assert eps.var() == pytest.approx(1, abs=0.06)
    for lag in (1, 5, 10):
        assert (eps[lag:] * eps[:-lag]).mean() == pytest.approx(0.9**lag, abs=0.07)
    edited(4)


def test_edit_5_restarts_the_noise(edited, tmp_path):
    """At the end of an episode, in this environment alone, and only from the next step on."""
    module = edit(tmp_path, *hunks(EDITS[4]))
    seen = []
    exploration = module.exploration

    def spy(*args):
        act = exploration(*args)
        seen.append((act.eps, act.eps.copy()))
        return act

    flags = "--no-compile --max-episode-steps 100 --total-timesteps 512 --eval-freq 512"
    run(module, tmp_path, flags, exploration=spy)
    after, before = seen[0]
    changed = (after != before).all(axis=(1, 2))
    assert not changed[:100].any() and changed[100:].all()  # Pendulum's episodes end together
    edited(5)
