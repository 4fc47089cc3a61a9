"""study/runs.py: reading runs, packing them, and which of them may be averaged."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from study import runs
from study.protocol import COMPLEX, NAMES
from study.runs import Unusable, load, select

PENDULUM, CAR = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0"


def test_load_gives_settings_performance_and_curves(tmp_path, write_run, selected):
    write_run(tmp_path, PENDULUM, -1, 4, 3, [1.0, 2.0, 6.0])
    write_run(tmp_path, "Unknown-v0", "vanilla", 2, 1, [5.0], exp_name="other")
    table, curves = load([tmp_path])
    table, curves = table.set_index("environment"), curves.set_index(table.environment)
    assert table.performance.to_dict() == {"Pendulum Swingup": 3.0, "Unknown-v0": 5.0}
    assert table.final_return.to_dict() == {"Pendulum Swingup": 6.0, "Unknown-v0": 5.0}
    assert table.beta.to_dict() == {"Pendulum Swingup": "-1", "Unknown-v0": "vanilla"}
    assert curves.loc["Pendulum Swingup"].to_dict() == {10: 1.0, 20: 2.0, 30: 6.0}
    chosen = selected(tmp_path).set_index("environment")
    assert chosen.beta["Pendulum Swingup"] == -1 and np.isnan(chosen.beta["Unknown-v0"])
    assert chosen.vanilla.to_dict() == {"Pendulum Swingup": False, "Unknown-v0": True}
    for name in ("pendulum-swingup", PENDULUM, "Pendulum Swingup", "Unknown", "Unknown-v0"):
        assert len(load([tmp_path], env=[name])[0]) == 1


def test_a_filter_for_what_is_not_there_lists_what_is(tmp_path, write_run):
    for beta in (1, 0, "vanilla", 0.5):
        write_run(tmp_path, PENDULUM, beta, 4, 1, [1.0])
    write_run(tmp_path, PENDULUM, 1, 2, 1, [1.0])
    assert len(load([tmp_path], beta=["0", "vanilla"], n_envs=[4])[0]) == 2
    for filters, words in (
        ({"env": [PENDULUM, "Cartpole"]}, rf"Cartpole; there are: \['{PENDULUM}'\]"),
        ({"beta": ["0", "0.7"]}, r"0.7; there are: \['0', '0.5', '1', 'vanilla'\]"),
        ({"n_envs": [4, 5]}, r"5; there are: \[2, 4\]"),
        ({"beta": ["0"], "n_envs": [2]}, r"2; there are: \[4\]"),
    ):
        with pytest.raises(Unusable, match=words):
            load([tmp_path], **filters)


def test_runs_that_are_not_complete_are_left_out_and_named(tmp_path, write_run):
    folders = [write_run(tmp_path, PENDULUM, 0.5, 4, seed, [1.0, 2.0]) for seed in range(4)]
    (folders[1] / "summary.json").unlink()
    table = (folders[2] / "evaluations.csv").read_text()
    (folders[2] / "evaluations.csv").write_text(table[: table.index("20,2") + 2])
    (folders[3] / "evaluations.csv").write_text(table.replace("20,2", "20,nan"))
    runs.pack(*load([tmp_path]), tmp_path / "packed.csv")
    for path in (tmp_path / "test", tmp_path / "packed.csv"):
        chosen, left_out = select(load([path])[0])
        assert chosen.seed.tolist() == [0]
        texts = [line.split("/")[-1] for line in left_out]
        assert texts == [f"seed_{i + 1}: unfinished: {n} evaluations" for i, n in enumerate("211")]
    (tmp_path / "empty").mkdir()
    with pytest.raises(Unusable, match="there are none in"):
        load([tmp_path, tmp_path / "empty"])


def test_one_beta_per_action_dimension_is_not_in_the_study(tmp_path, write_run):
    write_run(tmp_path, PENDULUM, -0.0, 4, 1, [1.0])
    config = write_run(tmp_path, PENDULUM, 0, 4, 2, [1.0]) / "config.json"
    config.write_text(config.read_text().replace('"beta": [0]', '"beta": [0.5, -0.0]'))
    table, _ = load([tmp_path])
    assert table.beta.tolist() == ["0", "0.5_0"]
    chosen, left_out = select(table)
    assert chosen.beta.tolist() == [0] and "one beta per action dimension" in left_out[0]


def test_packed_runs_are_read_like_a_folder(tmp_path, write_run, write_sweep, selected):
    folder = tmp_path / "runs"
    write_sweep(folder, {0: 1, 0.5: 2, "vanilla": 1}, n_envs=(1, 4), seeds=3)
    unfinished = write_run(folder, CAR, 0.5, 4, 1, [1.0, 2.0], envpool=True)
    (unfinished / "summary.json").unlink()
    for name in ("packed.csv", "packed.csv.gz"):
        (ours, curves), packed = load([folder]), tmp_path / name
        runs.pack(ours, curves, packed)
        again, curves_again = load([packed])
        assert (ours.path == again.path).all() and (ours.status == again.status).all()
        np.testing.assert_array_equal(curves, curves_again)
        (chosen, left_out), (chosen_again, left_out_again) = select(ours), select(again)
        columns = [*runs.AXES, "vanilla", "performance", "final_return", "learning_rate"]
        pd.testing.assert_frame_equal(chosen[columns], chosen_again[columns])
        assert len(left_out) == len(left_out_again) == 1
        assert len(selected(folder, packed)) == 18  # a run that is in both counts once


def test_the_command_packs_and_replaces_nothing_by_mistake(tmp_path, write_sweep):
    write_sweep(tmp_path / "runs", {0: 1, 1: 1}, seeds=2)
    file = tmp_path / "packed.csv"
    command = [sys.executable, "-m", "study.runs", "pack", tmp_path / "runs", file, "--beta", "0"]
    root = runs.__file__.removesuffix("study/runs.py")
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0 and "2 runs" in done.stdout, done.stderr
    with pytest.raises(FileExistsError):
        runs.pack(*load([tmp_path / "runs"]), file)
    assert len(load([file])[0]) == 2
    runs.pack(*load([tmp_path / "runs"]), file, overwrite=True)
    assert len(load([file])[0]) == 4


def test_runs_are_in_the_same_order_however_they_are_read(tmp_path, write_run):
    """So that bootstraps, which draw by position, give the same intervals."""
    for seed in range(1, 13):
        write_run(tmp_path / f"{seed % 2}", PENDULUM, 0, 4, seed, [float(seed)])
    first, second = (load([tmp_path / a, tmp_path / b])[0] for a, b in ("01", "10"))
    assert list(first.seed) == list(second.seed) == list(range(1, 13))


@pytest.mark.parametrize(
    "same, other",
    [
        ({"envpool": False}, {"envpool": True}),
        ({"anneal_lr": False}, {"anneal_lr": True}),
        ({"max_episode_steps": None}, {"max_episode_steps": 500}),
        ({"threads": 4, "capture_video": True}, {"gae_lambda": 0.9}),
        ({"method": "ppo", "beta_auto": True}, {"a_users_own": 5}),
        ({"env_kwargs": None}, {"env_kwargs": {"a": [3, 0]}}),
        ({"eval_episodes": 10}, {"total_timesteps": 10, "eval_freq": 5}),
    ],
)
def test_runs_with_other_settings_are_not_averaged(tmp_path, write_run, selected, same, other):
    """An argument that older runs do not have is what they did."""
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0])
    write_run(tmp_path, CAR, 0.5, 4, 2, [1.0], **same)
    assert len(selected(tmp_path)) == 2
    write_run(tmp_path, CAR, 0.5, 4, 3, [1.0] * (2 if "eval_freq" in other else 1), **other)
    runs.pack(*load([tmp_path]), tmp_path / "packed.csv")
    flag = f"--{list(other)[-1].replace('_', '-')}"
    for path in (tmp_path, tmp_path / "packed.csv"):
        with pytest.raises(Unusable, match=flag):
            selected(path)


def test_arguments_of_the_environment_are_the_same_in_any_order(tmp_path, write_run, selected):
    for seed, kwargs in enumerate([{"b": 2, "a": [3, 0]}, {"a": [3, 0], "b": 2}]):
        write_run(tmp_path, PENDULUM, 0.5, 4, seed, [1.0], env_kwargs=kwargs)
    runs.pack(*load([tmp_path]), tmp_path / "packed.csv")
    assert len(selected(tmp_path)) == len(selected(tmp_path / "packed.csv")) == 2


def test_a_run_that_is_in_two_experiments_is_not_averaged(tmp_path, write_run, selected):
    """In one of them the script may have been edited."""
    for name in ("one", "two"):
        write_run(tmp_path, CAR, 0.5, 4, 1, [1.0], exp_name=name)
    with pytest.raises(Unusable, match="--exp-name one and --exp-name two"):
        selected(tmp_path)
    assert len(selected(tmp_path / "one", tmp_path / "one")) == 1


def test_other_methods_are_selected_apart(tmp_path, write_run):
    """gSDE has no beta, whatever its arguments say; the filter by beta does not concern it."""
    for seed in (1, 2):
        write_run(tmp_path, CAR, 0.5, 4, seed, [1.0, 2.0])
        for name in ("gsde", "trpo", "my_own"):
            write_run(tmp_path, CAR, 0.5, 4, seed, [5.0, 6.0], method=name, exp_name=name)
    unfinished = write_run(tmp_path, CAR, 0.5, 4, 3, [1.0], method="a2c", exp_name="a2c")
    (unfinished / "summary.json").unlink()
    chosen, left_out = select(load([tmp_path], beta=["0.5"])[0])
    counts = chosen.method.value_counts().to_dict()
    assert counts == dict.fromkeys(["ppo", "trpo", "gsde", "my_own"], 2)
    gsde = chosen[chosen.method == "gsde"]
    assert gsde.beta.isna().all() and not gsde.vanilla.any()
    assert len(left_out) == 1 and "unfinished" in left_out[0]
    assert set(select(load([tmp_path / "trpo"])[0])[0].method) == {"trpo"}
    with pytest.raises(Unusable, match="unfinished"):
        select(load([tmp_path / "a2c"])[0])
    both = chosen[chosen.method.isin(["ppo", "trpo"])]
    runs.same_protocol(both.assign(learning_rate=np.where(both.method == "trpo", 1e-3, 2.5e-4)))
    with pytest.raises(Unusable, match="gamma 0.9"):
        runs.same_protocol(both.assign(gamma=np.where(both.method == "trpo", 0.9, 0.99)))


def test_main_grid(tmp_path, write_run, selected):
    """The study's settings, or else the most frequent ones, of each method."""
    write_run(tmp_path, CAR, 0.5, 4, 1, [1.0])
    for seed, n_steps in enumerate([4096, 4096, 512]):
        write_run(tmp_path, PENDULUM, 0.5, 2, seed, [1.0], n_steps=n_steps)
    every = selected(tmp_path)
    grid = runs.main_grid(every)
    assert grid.env_id.tolist() == [CAR]
    assert runs.main_grid(every[every.env_id == PENDULUM]).n_steps.tolist() == [4096, 4096]
    others = every.assign(method="a2c")[every.env_id == PENDULUM]
    assert len(runs.main_grid(pd.concat([every, others], ignore_index=True))) == 1 + 2
    assert runs.main_grid(grid[:0]).empty


def test_only_cells_that_have_all_values_are_comparable(made_up):
    few = {"envs": [PENDULUM], "seeds": 2}
    four = made_up(lambda *_: 0, betas=(0, 0.2, 0.5), n_envs=[4], **few)
    more = made_up(lambda *_: 0, betas=(0, 0.5), n_envs=[32], **few)
    table = pd.concat([four, more], ignore_index=True)
    assert set(runs.comparable(table, ["beta"], ["n_envs"]).n_envs) == {4}
    assert set(runs.comparable(table, ["n_envs"], ["beta"]).beta) == {0, 0.5}
    single = table[(table.n_envs == 4) | (table.seed == 0)]  # one seed with n_envs 32
    single = single[single.beta != 0.2]
    assert set(runs.comparable(single, ["beta"], ["n_envs"]).n_envs) == {4}
    with pytest.raises(Unusable, match="one environment with all 3 values of beta"):
        other = more.assign(environment="another")
        runs.comparable(pd.concat([four[four.beta < 0.3], other]), ["beta"], ["environment"])


@pytest.mark.parametrize(
    "other, flags",
    [
        ({}, ""),
        ({"gamma": 0.9}, "--gamma 0.9"),
        ({"total_timesteps": 20, "eval_freq": 5}, "--total-timesteps 20, --eval-freq 5"),
        ({"bootstrap_timeouts": True}, "--bootstrap-timeouts"),
        ({"noise_seq_len": 1024, "anneal_lr": True}, "--noise-seq-len 1024, --anneal-lr"),
        ({"env_kwargs": {"a": 1}}, '--env-kwargs {"a": 1}'),
    ],
)
def test_differences_from_the_study(tmp_path, write_run, selected, short_study, other, flags):
    short_study(4)
    write_run(tmp_path, PENDULUM, 0, 4, 1, [0.0, 1.0, 2.0, 3.0], **other)
    assert runs.differences(selected(tmp_path)).tolist() == [flags]


def test_published_tables_agree():
    """The mean over 8 betas and 8 n_envs, without vanilla, is the published mean to rounding."""
    cells = runs.published("final_return_per_beta")
    assert set(cells.environment) == {NAMES[key] for key in NAMES if key not in COMPLEX}
    summary = runs.published("final_return_and_performance").set_index("environment")
    colored = cells[cells.beta != "vanilla"].groupby("environment").final_return_mean
    assert (colored.count() == 64).all() and len(summary) == 16
    # Cells are rounded to 0.1, so a mean of 64 is wrong by 0.0036 (one sigma), and itself to 0.01
    wanted = summary.final_return_mean[colored.mean().index]
    np.testing.assert_allclose(colored.mean(), wanted, rtol=0, atol=0.015)
    best = runs.published("best_beta_per_env")
    counts = [(best[f"beta_{beta}_comparable"] == "yes").sum() for beta in ("0.5", "0.0", "1.0")]
    assert counts == [11, 8, 7]  # Table 1
