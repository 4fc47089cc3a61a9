"""study.benchmark: contenders train and evaluate, their times are read, the tables add up."""

import sys

import pandas as pd
import pytest
from torch.utils.tensorboard import SummaryWriter

import ppo_colored_continuous as ppo
from study import benchmark, sb3

CAR = "MountainCarContinuous-v0"


def test_times_are_those_between_evaluations(monkeypatch):
    """Not that before the first one."""

    def run(command):
        folder = command[command.index("--runs-dir") + 1]
        with SummaryWriter(folder) as writer:
            writer.add_scalar("losses/value_loss", 0, 10_240, walltime=1000)
            for i, clock in enumerate([2000, 2010.24, 2030.72], start=1):
                writer.add_scalar("evaluation/return_mean", 0, 10_240 * i, walltime=clock)

    monkeypatch.setattr(benchmark, "seconds", run)
    assert benchmark.step_times("", CAR) == pytest.approx([1000, 2000])


def test_contenders_train_by_the_protocol(monkeypatch):
    flags = f"{benchmark.RUN} --eval-freq {benchmark.EVAL_FREQ}"
    *script, theirs = (f"{words} {flags}".split() for words in benchmark.CONTENDERS.values())
    ours = [ppo.parse_args(words[1:]) for words in script]
    for args in (*ours, sb3.parse_args(theirs[2:])):
        assert (args.n_envs, args.eval_freq, args.eval_episodes) == (4, 10_240, 50)
        assert args.n_envs * args.n_steps == args.eval_freq  # an update between two evaluations
        assert (args.batch_size, args.n_epochs) == (128, 10)
    assert [(args.compile, args.envpool) for args in ours] == [(True, True), (True, False)]


def test_measure(monkeypatch):
    """With the real programs, and short runs."""
    short = "--n-envs 1 --n-steps 64 --n-epochs 1 --eval-episodes 1 --total-timesteps 192"
    monkeypatch.setattr(benchmark, "RUN", short)
    monkeypatch.setattr(benchmark, "EVAL_FREQ", 64)
    contenders = {"ours": "ppo_colored_continuous.py --vanilla", "theirs": "-m study.sb3"}
    rows = benchmark.measure("Pendulum-v1", 1, contenders)
    assert [(row["env_id"], row["contender"]) for row in rows] == [
        ("Pendulum-v1", "ours"),
        ("Pendulum-v1", "theirs"),
    ]
    assert all(0 < row["from"] < row["us"] < row["to"] for row in rows)


def test_tables(tmp_path, monkeypatch, capsys):
    """All three, of made-up times, in one file and on the terminal."""
    commands, turns = [], []

    def step_times(contender, env_id):
        turns.append((contender, env_id))
        return [30.0, 10.0, 20.0] if "study.sb3" in contender else [5.0, 15.0, 10.0]

    def seconds(command, **variables):
        commands.append(command)
        return 3.0

    monkeypatch.setattr(benchmark, "step_times", step_times)
    monkeypatch.setattr(benchmark, "seconds", seconds)
    monkeypatch.setattr(benchmark, "hold_on_cores", lambda n: None)
    monkeypatch.setattr(benchmark, "CORES", [0, 1])
    benchmark.main(benchmark.parse_args(["--rounds", "2", "--csv", str(tmp_path / "table.csv")]))
    first = [(words, benchmark.DM_CONTROL[0]) for words in benchmark.CONTENDERS.values()]
    assert turns[:6] == first * 2
    table = pd.read_csv(tmp_path / "table.csv")
    assert len(table) == 3 * 3 + 3 * 2 + 7
    ours, theirs = (table[table.contender == name] for name in [*benchmark.CONTENDERS][::2])
    assert ours[["us", "from", "to", "x faster"]].to_numpy().tolist() == [[10, 5, 15, 2]] * 3
    assert (theirs["x faster"] == 1).all()
    one_run = table[table.contender == "one run, --threads 2"]
    assert one_run.minutes.to_numpy() == pytest.approx(10e-6 * 2_048_000 / 60, rel=1e-3)
    assert (table.seconds == 3).sum() == 7
    assert "first step, loss edited" in capsys.readouterr().out

    _, _, (python, _, code, *words), eager, *_ = commands  # see `waiting`
    assert ppo.parse_args(words[1:]).compile and not ppo.parse_args(eager[2:]).compile
    monkeypatch.setattr(sys, "argv", ["-c", *words, "--no-compile", "--runs-dir", str(tmp_path)])
    exec(code, {})
    assert next(tmp_path.rglob("summary.json"))
