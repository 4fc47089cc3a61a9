"""study.benchmark: contenders do a round's work, its time is in its phases, the tables add up."""

import os
import signal
import subprocess
import sys
import time
from unittest import mock

import pandas as pd
import pytest
from gymnasium.envs.classic_control.continuous_mountain_car import Continuous_MountainCarEnv

import ppo_colored_continuous as ppo
from study import benchmark
from study.benchmark import PHASES, Clock, Size

CAR, PENDULUM = "MountainCarContinuous-v0", "dm_control/pendulum-swingup-v0"


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    """The script as it was, after a contender has put its timers in. Nothing is compiled."""
    timed = [(ppo, "evaluate"), (ppo.ColoredNoiseProcess, "sample")]
    timed += [(ppo.Run, name) for name in ("add_evaluation", "add_update", "save_checkpoint")]
    for owner, name in timed:
        monkeypatch.setattr(owner, name, getattr(owner, name))
    monkeypatch.setattr(ppo, "compiled", lambda function: function)
    monkeypatch.setattr(ppo, "SummaryWriter", mock.MagicMock())  # its thread outlives a contender


class Pipe:
    """The benchmark's end of a pipe: lets a contender play n rounds, and keeps its reports."""

    def __init__(self, n):
        self.n, self.reports = n, []

    def send(self, report):
        self.reports.append(report)

    def recv(self):
        return len(self.reports) <= self.n


def test_clock(monkeypatch):
    """Time goes to the innermost phase, and none to the wait between rounds."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def wait(seconds):
        now[0] += seconds

    class SlowPipe(Pipe):
        def recv(self):
            wait(1000)
            return super().recv()

    clock = Clock(SlowPipe(n=1))
    wait(100)  # start-up
    clock.next_round()
    wait(1)
    clock.timed("update", lambda: (wait(2), clock.timed("files", wait)(4), wait(8)))()
    wait(16)
    with pytest.raises(SystemExit):
        clock.next_round()
    assert clock.pipe.reports[0]["rollout"] == 0
    report = clock.pipe.reports[1]
    expected = {"rollout": 17, "noise": 0, "update": 10, "files": 4, "evaluation": 0}
    assert {phase: report[phase] for phase in PHASES} == expected and report["peak MB"] > 50


@pytest.mark.parametrize(
    "run, phases, steps",
    [
        (lambda *how: benchmark.run_script(*how, "--no-envpool"), set(PHASES), 256 + 2 * 999),
        (lambda *how: benchmark.run_script(*how, "--envpool"), set(PHASES), 0),
        (lambda *how: benchmark.run_script(*how, "--no-envpool", evaluations=False),
         {"rollout", "noise", "update"}, 256),
        (benchmark.run_peer, {"rollout", "update", "evaluation"}, 256 + 10 * 999),
    ],
    ids=["script", "envpool", "training", "peer"],
)  # fmt: skip
def test_a_round(monkeypatch, run, phases, steps):
    """Which phases take time, and how often the car, which never reaches the goal, is stepped.

    The peer steps its 10 environments until the 2 episodes have ended.
    """
    taken, step = [0], Continuous_MountainCarEnv.step

    def counted(*args):
        taken[-1] += 1
        return step(*args)

    class CountingPipe(Pipe):
        def recv(self):
            taken.append(0)
            return super().recv()

    monkeypatch.setattr(Continuous_MountainCarEnv, "step", counted)
    pipe = CountingPipe(n=2)
    with pytest.raises(SystemExit):
        run(Clock(pipe), CAR, Size(n_envs=4, n_steps=64, eval_episodes=2))
    assert taken == [0, steps, steps, 0]
    for report in pipe.reports[2:]:  # in the first round there is a checkpoint in any case
        assert {phase for phase in PHASES if report[phase] > 0} == phases


def killed(clock, env_id, size):
    os.kill(os.getpid(), signal.SIGKILL)


def test_measure(capsys):
    """Processes of their own, in turns; those that cannot run are named."""
    size = Size(n_envs=4, n_steps=64, eval_episodes=1)
    contenders = {"physics": benchmark.run_physics, "killed": killed}
    (row,) = benchmark.measure(PENDULUM, contenders, 2, size)
    assert (row["env_id"], row["contender"], row["n_envs"]) == (PENDULUM, "physics", 4)
    assert row["rollout"] > 0 and row["evaluation"] > 0 and row["update"] == 0
    assert row["from"] <= row["total us"] <= row["to"] and row["start-up s"] > 0
    assert not benchmark.measure(CAR, {"physics": benchmark.run_physics}, 1, size)
    notes = capsys.readouterr().err
    assert f"nothing of killed on {PENDULUM} (its process has died" in notes
    assert f"nothing of physics on {CAR} (ValueError: it knows only dm_control's models)" in notes


def test_summary():
    """Medians per training step, with 8,192 / 10,240 of an evaluation."""
    rounds = [dict.fromkeys(PHASES, 0) | {"peak MB": 7} for _ in range(3)]
    for seconds, report in zip((0.2, 0.3, 0.4), rounds, strict=True):
        report |= {"update": seconds, "rollout": seconds / 10, "evaluation": seconds / 10}
    row, us = benchmark.summary(rounds, Size()), 1e6 / 8192
    assert row["update"] == pytest.approx(0.3 * us)
    assert row["evaluation"] == pytest.approx(0.03 * 0.8 * us)
    assert row["total us"] == pytest.approx((0.3 + 0.03 + 0.03 * 0.8) * us)
    assert row["from"] == pytest.approx(row["total us"] * 2 / 3) and row["peak MB"] == 7


def test_tables(tmp_path, monkeypatch, capsys):
    """All four, of made-up times, in one file and on the terminal."""

    def measure(env_id, contenders, n_rounds, size):
        about, names = {"env_id": env_id, "n_envs": size.n_envs}, list(contenders)
        return [{**about, "contender": c, "total us": 10.0 * (1 + names.index(c))} for c in names]

    def seconds(command, variables):  # the script's commands in this process
        python, *words = command
        if words[0] == "-c":
            monkeypatch.setattr(sys, "argv", words[1:])
            exec(words[1], {})
        elif "sweep" in python:
            subprocess.run(command, check=True, cwd=benchmark.ROOT, env=os.environ | variables)
        else:
            ppo.main(ppo.parse_args(words[1:]))
        return 3.0

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.setattr(benchmark, "seconds", seconds)
    monkeypatch.setattr(benchmark, "hold_on_cores", lambda n: None)
    monkeypatch.setattr(benchmark, "CORES", [0, 1])
    benchmark.main(benchmark.parse_args(["--rounds", "1", "--csv", str(tmp_path / "table.csv")]))
    table = pd.read_csv(tmp_path / "table.csv")
    assert len(table) == 3 * 5 + 5 * 2 + 3 * 2 + 7
    stack = table[table.contender == benchmark.PAPER]
    assert (stack["x faster"] == 1).all() and (stack["x physics"] == 3 / 5).all()
    assert (table[table.contender == "this script"]["x faster"] == 3).all()
    one_run = table[table.contender == "one run, 2 cores"]
    assert one_run.minutes.to_numpy() == pytest.approx(10e-6 * 2_048_000 / 60, rel=1e-3)
    assert (table.seconds == 3).sum() == 7
    shown = capsys.readouterr().out
    assert "first step, loss edited" in shown and "training, --no-envpool" in shown


def test_a_file_in_no_folder(capsys):
    with pytest.raises(SystemExit) as stopped:
        benchmark.parse_args(["--csv", "nosuch/table.csv"])
    assert stopped.value.code == 2 and "there is no such folder" in capsys.readouterr().err
