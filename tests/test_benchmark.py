"""The benchmark: contenders do a round's work, its time is in its phases, the table adds up."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from conftest import ROOT, run_forked

from benchmark import PHASES, measure

# Plays small rounds, and prints of each: the report, the seconds it took, the car's steps
PLAY = """
import json, sys, time
from gymnasium.envs.classic_control.continuous_mountain_car import Continuous_MountainCarEnv as Car
import benchmark
import run_files

class Pipe:
    rounds = []
    def send(self, report):
        if self.rounds:
            start, steps = self.rounds.pop()
            wall, steps = time.perf_counter() - start, Car.steps - steps
            self.rounds.append(dict(report=report, wall=wall, steps=steps))
    def recv(self):
        self.rounds.append((time.perf_counter(), Car.steps))
        return len(self.rounds) <= 3

def step(self, action):
    Car.steps += 1
    return car_step(self, action)

car_step, Car.step, Car.steps = Car.step, step, 0
run_files.compiled = lambda update: update
benchmark.N_STEPS, benchmark.STEPS, benchmark.EVAL_EPISODES = 64, 256, 10
clock, car = benchmark.Clock(Pipe()), "MountainCarContinuous-v0"
try:
    eval(sys.argv[1])
except SystemExit:
    print(json.dumps(Pipe.rounds[:-1]))
"""


@pytest.mark.parametrize(
    "call, steps",
    [
        (
            "run_script(clock, car, '--no-envpool')",
            256 + 10 * 999,
        ),  # training, and evaluations, in which the car is not yet at the goal
        ("run_script(clock, car, flags='--envpool', n_envs=2, evaluations=False)", 0),
        ("run_peer(clock, car)", 256 + 10 * 999),
        ("run_peer(clock, car, jax=True)", 256 + 10 * 999),
        ("run_eager(clock, car)", 256 + 10 * 999),
        ("run_physics(clock, 'dm_control/pendulum-swingup-v0')", 0),
    ],
)
def test_a_round(call, steps):
    if "jax" in call:
        pytest.importorskip("sbx")
    process = subprocess.run(
        [sys.executable, "-c", PLAY, "benchmark." + call], cwd=ROOT, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    rounds = json.loads(process.stdout)
    assert len(rounds) == 3
    phases = {"rollout", "update", "evaluation"} | (
        {"noise", "files"} if "script" in call else set()
    )
    phases -= (
        {"update"}
        if "physics" in call
        else {"evaluation"}
        if "evaluations=False" in call
        else set()
    )
    for one in rounds:
        assert one["steps"] == steps
        assert {phase for phase in PHASES if one["report"][phase] > 0} == phases
        if "physics" not in call:  # which leaves its resets out
            assert sum(one["report"][phase] for phase in PHASES) == pytest.approx(
                one["wall"], rel=0.02, abs=0.01
            )


def slow_then_fast(clock, env_id):
    """A contender whose updates take 10, 20, 30, 40 ms, and the rest a tenth of that."""
    for ms in (10, 20, 30, 40):
        clock.next_round()
        clock.seconds.update(rollout=ms / 1e4, update=ms / 1e3, evaluation=ms / 1e4)
        clock.since = time.perf_counter() + 1e-9
    clock.next_round()


def broken(clock, env_id):
    raise ValueError(f"cannot run {env_id}")


def ended(clock, env_id):
    sys.exit(2)


def killed(clock, env_id):
    os.kill(os.getpid(), signal.SIGKILL)


def test_table(capsys):
    contenders = {"fake": slow_then_fast, "broken": broken, "ended": ended, "killed": killed}
    rows = measure("some-env", contenders, n_rounds=3)
    assert [row["contender"] for row in rows] == ["fake"]
    (row,) = rows
    ms_per_step = 1e3 / 8192  # of a round of a millisecond, in us per step
    assert row["update"] == pytest.approx(30 * ms_per_step, rel=1e-3)  # the median of 20, 30, 40
    assert row["evaluation"] == pytest.approx(3 * ms_per_step * 8192 / 10240, rel=1e-3)
    assert row["total us"] == pytest.approx((30 + 3 + 3 * 0.8) * ms_per_step, rel=1e-2)
    assert row["from"] == pytest.approx(row["total us"] * 2 / 3, rel=1e-2)
    assert row["peak MB"] > 5 and row["start-up s"] > 0
    notes = capsys.readouterr().err
    assert "nothing of broken on some-env (ValueError: cannot run some-env)" in notes
    assert "nothing of ended" in notes and "nothing of killed" in notes


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ("--env-ids nosuch-v0", "unknown environment nosuch-v0"),
        ("--csv /nosuch/table.csv", "--csv /nosuch/table.csv: there is no such folder"),
    ],
)
def test_mistakes_are_one_line(flags, words, tmp_path):
    process = run_forked(ROOT / "benchmark.py", flags.split(), tmp_path, timeout=60)
    assert process.returncode == 2 and process.stderr.count("\n") == 1
    assert words in process.stderr
