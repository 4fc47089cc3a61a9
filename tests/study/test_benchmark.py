"""study.benchmark: contenders do a round's work, its time is in its phases, the tables add up."""

import multiprocessing
import sys
import time
from types import SimpleNamespace
from unittest import mock

import pandas as pd
import pytest
from gymnasium.envs.classic_control.continuous_mountain_car import Continuous_MountainCarEnv
from stable_baselines3 import PPO

import ppo_colored_continuous as ppo
from study import benchmark
from study.benchmark import PHASES, Clock

CAR = "MountainCarContinuous-v0"
SMALL = "--n-steps 64 --eval-freq 256 --eval-episodes 2"


class Pipe:
    """The benchmark's end of a pipe: lets a contender play n rounds, and keeps its reports."""

    def __init__(self, n):
        self.n, self.reports = n, []

    def send(self, report):
        self.reports.append(report)

    def recv(self):
        return len(self.reports) <= self.n


def test_clock(monkeypatch):
    """Time goes to the innermost phase, per training step; an evaluation is for 10,240 steps.

    The wait between rounds is in no phase.
    """
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def wait(seconds):
        now[0] += seconds

    class SlowPipe(Pipe):
        def recv(self):
            wait(1000)
            return super().recv()

    clock, args = Clock(SlowPipe(n=1)), ppo.parse_args([])
    wait(100)  # start-up
    clock.next_round(args)
    wait(1)
    clock.timed("update", lambda: (wait(2), clock.timed("files", wait)(4), wait(8)))()
    wait(16)
    clock.timed("evaluation", wait)(32)
    with pytest.raises(SystemExit):
        clock.next_round(args)
    assert clock.pipe.reports[0]["rollout"] == 0
    report, per_step = clock.pipe.reports[1], 1e6 / 8192
    expected = {"rollout": 17, "noise": 0, "update": 10, "files": 4, "evaluation": 32 * 0.8}
    for phase in PHASES:
        assert report[phase] == pytest.approx(expected[phase] * per_step)
    assert report["total us"] == pytest.approx((31 + 32 * 0.8) * per_step)
    assert report["peak MB"] > 50


@pytest.mark.parametrize(
    "run, flags, phases, steps",
    [
        (benchmark.run_script, "--no-envpool", set(PHASES), 256 + 2 * 999),
        (benchmark.run_script, "--envpool", set(PHASES), 0),
        (benchmark.run_sb3, "", {"rollout", "update", "evaluation"}, 256 + 10 * 999),
    ],
    ids=["script", "envpool", "sb3"],
)
def test_a_round(monkeypatch, run, flags, phases, steps):
    """Which phases take time, and how often the car, which never reaches the goal, is stepped.

    Stable-Baselines3 steps its 10 environments until the 2 episodes have ended.
    """
    timed = [(ppo, "evaluate"), (ppo.ColoredNoiseProcess, "sample"), (PPO, "train")]
    timed += [(ppo.Run, name) for name in ("add_evaluation", "add_update", "save_checkpoint")]
    for owner, name in timed:  # to be restored at the end
        monkeypatch.setattr(owner, name, getattr(owner, name))
    taken, step = [0], Continuous_MountainCarEnv.step

    def counted(*args):
        taken[-1] += 1
        return step(*args)

    class CountingPipe(Pipe):
        def recv(self):
            taken.append(0)
            return super().recv()

    monkeypatch.setattr(ppo, "compiled", lambda function: function)
    monkeypatch.setattr(ppo, "SummaryWriter", mock.MagicMock())  # its thread outlives the folder
    monkeypatch.setattr(Continuous_MountainCarEnv, "step", counted)
    pipe = CountingPipe(n=2)
    with pytest.raises(SystemExit):
        run(Clock(pipe), f"--env-id {CAR} --n-envs 4 {SMALL} {flags}")
    assert taken == [0, steps, steps, 0]
    for report in pipe.reports[2:]:  # in the first round there is a checkpoint in any case
        assert {phase for phase in PHASES if report[phase] > 0} == phases


def contender(clock, flags):
    """Plays rounds of 1000 steps, whose updates are said to take 9000, 1000, 4000, 2000 seconds."""
    args = SimpleNamespace(n_envs=1, n_steps=1000)
    clock.next_round(args)
    for seconds in (9000, 1000, 4000, 2000):
        clock.seconds["update"] = seconds
        clock.next_round(args)


def test_measure(monkeypatch):
    """In processes of their own; medians over all rounds but the first."""
    fork = multiprocessing.get_context("fork")  # a new Python would import all of the above
    monkeypatch.setattr(multiprocessing, "get_context", lambda name: fork)
    rows = benchmark.measure(CAR, 3, {name: (contender, "") for name in ("one", "other")})
    for row, name in zip(rows, ("one", "other"), strict=True):
        assert (row["env_id"], row["contender"]) == (CAR, name)
        columns = [row[name] for name in ("update", "total us", "from", "to")]
        assert columns == pytest.approx([2e6, 2e6, 1e6, 4e6], rel=1e-3)


def test_tables(tmp_path, monkeypatch, capsys):
    """All three, of made-up times, in one file and on the terminal."""
    commands = []

    def measure(env_id, n_rounds, contenders):
        totals = enumerate(contenders, 1)
        return [{"env_id": env_id, "contender": c, "total us": 10.0 * i} for i, c in totals]

    def seconds(command, variables):
        commands.append(command)
        return 3.0

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.setattr(benchmark, "seconds", seconds)
    monkeypatch.setattr(benchmark, "hold_on_cores", lambda n: None)
    monkeypatch.setattr(benchmark, "CORES", [0, 1])
    benchmark.main(benchmark.parse_args(["--rounds", "1", "--csv", str(tmp_path / "table.csv")]))
    table = pd.read_csv(tmp_path / "table.csv")
    assert len(table) == 3 * 3 + 3 * 2 + 7
    assert (table[table.contender == "the paper's stack"]["x faster"] == 1).all()
    assert (table[table.contender == "this script"]["x faster"] == 3).all()
    one_run = table[table.contender == "one run, --threads 2"]
    assert one_run.minutes.to_numpy() == pytest.approx(10e-6 * 2_048_000 / 60, rel=1e-3)
    assert (table.seconds == 3).sum() == 7
    assert "first step, loss edited" in capsys.readouterr().out

    _, _, (python, _, code, *words), eager, *_ = commands  # see `waiting`
    assert ppo.parse_args(words[1:]).compile and not ppo.parse_args(eager[2:]).compile
    monkeypatch.setattr(sys, "argv", ["-c", *words, "--no-compile", "--runs-dir", str(tmp_path)])
    exec(code, {})
    assert next(tmp_path.rglob("summary.json"))
