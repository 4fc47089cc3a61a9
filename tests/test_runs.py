"""The script as a user runs it: its results, its files, being killed, and mistakes."""

import csv
import ctypes.util
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, SCRIPT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

# A larger learning rate than the paper's: with that, returns pass 90 at about 160,000 steps
FAST = "--learning-rate 1e-3 --total-timesteps 98304 --eval-freq 8192 --eval-episodes 10"
FILES = {"config.json", "evaluations.csv", "checkpoint.pt", "summary.json", "lock"}


def only_run(tmp_path):
    (config,) = (tmp_path / "runs").rglob("config.json")
    return config.parent


def read_evaluations(folder):
    with open(folder / "evaluations.csv") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def read_events(folder):
    """{tag: [(step, value), ...]} of all TensorBoard points, without its repair of restarts."""
    events = EventAccumulator(str(folder), purge_orphaned_data=False).Reload()
    return {
        tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }


def assert_complete_tiny_run(folder):
    steps = [row["step"] for row in read_evaluations(folder)]
    assert steps == list(range(512, 4097, 512))
    assert (
        (folder / "evaluations.csv")
        .read_text()
        .startswith("step,return_mean,return_std,length_mean\n")
    )
    events = read_events(folder)
    assert [step for step, _ in events["evaluation/return_mean"]] == steps
    assert [step for step, _ in events["losses/policy_loss"]] == list(range(512, 4097, 512))
    assert json.loads((folder / "summary.json").read_text())["steps"] == 4096
    assert not list(folder.glob("*.tmp"))


def assert_one_line_error(process, *words, code):
    assert process.returncode == code, process.stderr
    lines = process.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), process.stderr
    assert all(word in lines[0] for word in words), lines[0]
    assert process.stdout == ""


@pytest.mark.parametrize("beta, reached", [("0.5", True), ("0", False)])
def test_mountain_car_needs_colored_noise(train, tmp_path, beta, reached):
    process = train(f"{FAST} --beta {beta}")
    assert process.returncode == 0, process.stderr
    final_return = json.loads((only_run(tmp_path) / "summary.json").read_text())["final_return"]
    assert final_return > 90 if reached else final_return < 1


def test_files_of_a_run(train, tiny, tmp_path):
    process = train(f"{tiny} --beta 0.25 --seed 3 --exp-name test")
    assert process.returncode == 0, process.stderr
    folder = tmp_path / "runs/test/MountainCarContinuous-v0/beta_0.25/n_envs_2/seed_3"
    assert {path.name.split(".tfevents")[0] for path in folder.iterdir()} == FILES | {"events.out"}
    assert_complete_tiny_run(folder)

    config = json.loads((folder / "config.json").read_text())
    assert (
        config["args"]["beta"] == [0.25]
        and config["args"]["n_envs"] == 2
        and config["args"]["gamma"] == 0.99
    )
    assert config["versions"]["torch"].startswith("2.13.0") and config["resolved"] == {
        "obs_dim": 2,
        "action_dim": 1,
    }
    commit = subprocess.run(
        ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True
    )
    if commit.returncode == 0:
        assert config["git_commit"].startswith(commit.stdout.strip())

    rows, summary = read_evaluations(folder), json.loads((folder / "summary.json").read_text())
    assert summary["performance"] == pytest.approx(np.mean([row["return_mean"] for row in rows]))
    assert summary["final_return"] == rows[-1]["return_mean"] and summary["wall_seconds"] > 0
    assert all(-100 <= row["return_mean"] <= 100 and row["length_mean"] == 999 for row in rows)
    tags = set(read_events(folder))
    names = [
        "policy_loss",
        "value_loss",
        "entropy",
        "approx_kl",
        "clip_fraction",
        "explained_variance",
    ]
    assert tags >= {f"losses/{name}" for name in names} | {
        "rollout/std",
        "rollout/return_mean",
        "time/steps_per_second",
    }
    assert torch.load(folder / "checkpoint.pt", weights_only=True)["global_step"] == 4096
    # what the user sees: our bar on stderr, our closing line on stdout
    assert process.stdout.startswith("performance ") and str(folder) in process.stdout
    assert "last evaluation" in process.stderr and "Warning" not in process.stderr


def test_same_seed_same_evaluations(train, tiny, tmp_path):
    def evaluations(flags):
        assert train(f"{tiny} --overwrite {flags}").returncode == 0
        (path,) = (tmp_path / "runs").rglob(
            f"{'vanilla' if 'vanilla' in flags else 'beta_1'}/n_envs_2/seed_*/evaluations.csv"
        )
        text = path.read_text()
        path.unlink()
        return text

    assert (
        evaluations("--beta 1 --seed 5")
        == evaluations("--beta 1 --seed 5")
        != evaluations("--beta 1 --seed 6")
    )
    assert evaluations("--vanilla --beta 0 --seed 5") == evaluations("--vanilla --beta 2 --seed 5")


def test_evaluations_fall_on_their_steps_whatever_the_update_size(train, tmp_path):
    """More steps per update than between evaluations, and a total that is no multiple of either."""
    flags = "--total-timesteps 5000 --n-envs 3 --n-steps 500 --eval-freq 600 --eval-episodes 2 "
    flags += "--n-epochs 1 --no-compile"
    assert train(f"{flags} --env-id Pendulum-v1 --batch-size 1000").returncode == 0
    assert [row["step"] for row in read_evaluations(only_run(tmp_path))] == list(
        range(600, 5000, 600)
    )
    events = read_events(only_run(tmp_path))
    assert [step for step, _ in events["losses/value_loss"]] == [1500, 3000, 4500, 6000]
    # the policy that acts until the next update is the one evaluated: 600 and 1200 precede the first
    returns = [value for _, value in events["evaluation/return_mean"]]
    assert len(set(returns)) == 8


@pytest.mark.parametrize("beta", ["0.5", "0.5 1 0 0.2 -1 2"])
def test_dm_control_and_one_beta_per_action_dimension(train, tmp_path, beta):
    flags = "--total-timesteps 512 --n-steps 256 --n-envs 1 --eval-freq 256 --eval-episodes 1 "
    flags += "--n-epochs 1 --no-compile"
    process = train(f"--env-id dm_control/cheetah-run-v0 {flags} --beta {beta}")
    assert process.returncode == 0 and "Warning" not in process.stderr, process.stderr
    assert [row["length_mean"] for row in read_evaluations(only_run(tmp_path))] == [1000, 1000]
    assert only_run(tmp_path).parts[-3] == "beta_" + beta.replace(" ", "_")


def start(tmp_path, flags, **kwargs):
    command = [sys.executable, SCRIPT, "--runs-dir", tmp_path / "runs", *flags.split()]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **kwargs
    )


def wait_for_rows(tmp_path, n, process, timeout=60):
    """Waits until the run has made n evaluations."""
    end = time.time() + timeout
    while time.time() < end and process.poll() is None:
        paths = list((tmp_path / "runs").rglob("evaluations.csv"))
        if paths and paths[0].read_text().count("\n") > n:
            return
        time.sleep(0.01)


def test_kill_at_any_moment_and_resume(train, tiny, tmp_path):
    """SIGKILLs at random moments: in the end everything is there once."""
    rng = random.Random(1)
    flags = f"{tiny} --eval-episodes 20 --resume"
    reached = 0
    for kill_at in (1, 3, 5, 6):
        process = start(tmp_path, flags)
        wait_for_rows(tmp_path, kill_at, process)
        time.sleep(rng.random() * 0.3)
        process.kill()
        process.communicate()
        checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
        rows = len(read_evaluations(only_run(tmp_path)))
        assert checkpoint["global_step"] >= reached
        # evaluations precede their checkpoint; what is newer than it can be at most one update's
        assert 0 <= rows - (checkpoint["next_eval"] // 512 - 1) <= 1
        reached = checkpoint["global_step"]
    assert reached >= 2048
    assert train(flags).returncode == 0
    assert_complete_tiny_run(only_run(tmp_path))


def test_resume_goes_on_with_the_same_networks_noise_and_clock(train, tiny, tmp_path):
    """A resumed run has the same first evaluations, bit for bit, and goes on from there."""
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 4, process)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate()
    assert process.returncode == 143 and "--resume" in stderr and "Traceback" not in stderr
    folder = only_run(tmp_path)
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    done = checkpoint["next_eval"] // 512 - 1  # evaluations in the checkpoint
    before = (folder / "evaluations.csv").read_text().splitlines()[: done + 1]

    assert train(f"{tiny} --resume").returncode == 0
    after = (folder / "evaluations.csv").read_text().splitlines()
    assert after[: done + 1] == before and len(after) == 9
    final = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert final["optimizer"][2].item() == 8 * 4  # Adam steps: 8 updates of 512 / 128 minibatches
    assert final["wall_seconds"] > checkpoint["wall_seconds"]
    # the noise went on where it was: 8 x 256 steps of sequences of 1000
    assert final["noise"]["index"] == 8 * 256 - 2 * 1000

    (tmp_path / "runs").rename(tmp_path / "resumed")
    assert train(tiny).returncode == 0
    assert (only_run(tmp_path) / "evaluations.csv").read_text().splitlines()[: done + 1] == before


def test_ctrl_c(tiny, tmp_path):
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 2, process)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate()
    assert process.returncode == 130 and "--resume" in stderr and "Traceback" not in stderr
    assert torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)["global_step"] >= 512


def test_a_finished_run_is_not_run_again(train, tiny, tmp_path):
    assert train(tiny).returncode == 0
    files = {path: path.read_bytes() for path in only_run(tmp_path).iterdir()}
    for flags in ("", "--resume"):
        process = train(f"{tiny} {flags}")
        assert process.returncode == 0 and "complete" in process.stdout and process.stderr == ""
    assert {path: path.read_bytes() for path in only_run(tmp_path).iterdir()} == files
    # other settings in the same folder are another run: named, and refused
    assert_one_line_error(train(f"{tiny} --gamma 0.9"), "--gamma 0.99, not 0.9", code=2)
    assert {path: path.read_bytes() for path in only_run(tmp_path).iterdir()} == files
    assert train(f"{tiny} --gamma 0.9 --overwrite").returncode == 0
    assert_complete_tiny_run(only_run(tmp_path))


def test_an_unfinished_run_is_not_overwritten_unasked(train, tiny, tmp_path):
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 2, process)
    process.kill()
    process.communicate()
    files = {path: path.read_bytes() for path in only_run(tmp_path).iterdir()}
    assert_one_line_error(train(tiny), "--resume", "--overwrite", code=1)
    assert_one_line_error(train(f"{tiny} --resume --n-epochs 2"), "--n-epochs 1, not 2", code=2)
    assert {path: path.read_bytes() for path in only_run(tmp_path).iterdir()} == files
    assert train(f"{tiny} --overwrite").returncode == 0
    assert_complete_tiny_run(only_run(tmp_path))


def test_a_second_process_is_kept_out(train, tiny, tmp_path):
    first = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 1, first)
    first.send_signal(signal.SIGSTOP)
    for flags in ("", "--resume", "--overwrite"):
        assert_one_line_error(train(f"{tiny} {flags}"), "another process", code=3)
    first.send_signal(signal.SIGCONT)
    first.communicate()
    assert first.returncode == 0
    assert_complete_tiny_run(only_run(tmp_path))


@pytest.mark.parametrize("damage", ["cut", "garbage", "empty", "short csv"])
def test_damaged_checkpoint(train, tiny, tmp_path, damage):
    assert train(tiny).returncode == 0
    folder = only_run(tmp_path)
    (folder / "summary.json").unlink()  # now it looks like a run stopped after its last update
    path = folder / ("evaluations.csv" if damage == "short csv" else "checkpoint.pt")
    data = path.read_bytes()
    path.write_bytes(
        {"cut": data[:1000], "garbage": b"x" * 5000, "empty": b"", "short csv": data[:50]}[damage]
    )
    files = {path: path.read_bytes() for path in folder.iterdir()}
    assert_one_line_error(
        train(f"{tiny} --resume"), "checkpoint.pt is damaged", "--overwrite", code=1
    )
    assert {path: path.read_bytes() for path in folder.iterdir()} == files
    path.write_bytes(data)
    assert train(f"{tiny} --resume").returncode == 0
    assert_complete_tiny_run(folder)


@pytest.mark.parametrize(
    "flags, words",
    [
        ("--env-id MountainCarContinous-v0", ["unknown environment", "MountainCarContinuous-v0"]),
        (
            "--env-id dm_control/pendulum-swingupp-v0",
            ["unknown environment", "dm_control/pendulum-swingup-v0"],
        ),
        ("--env-id CartPole-v1", ["Discrete(2)", "Box"]),
        ("--beta nan", ["--beta", "nan is not a finite number"]),
        ("--beta 0 1", ["2 values", "1 action dimension"]),
        ("--n-envs 0", ["--n-envs", "positive"]),
        ("--n-steps -5", ["--n-steps", "positive"]),
        ("--batch-size 1.5", ["--batch-size", "whole number"]),
        ("--noise-seq-len 1", ["--noise-seq-len", ">= 2"]),
        ("--gamma 1.01", ["--gamma", "between 0 and 1"]),
        ("--seed -1", ["--seed", ">= 0"]),
        ("--eval-freq 1e7", ["--eval-freq", "--total-timesteps"]),
        ("--resume --overwrite", ["--resume", "--overwrite"]),
        ("--device abc", ["--device abc"]),
        ("--total-time 5", ["--total-time"]),
    ],
)
def test_mistakes_on_the_command_line(train, tmp_path, flags, words):
    assert_one_line_error(train(flags), *words, code=2)
    assert not (tmp_path / "runs").exists()


def test_unwritable_folder(train, tmp_path):
    (tmp_path / "runs").write_text("a file, where a folder is needed")
    assert_one_line_error(train(), "cannot write", "--runs-dir", code=1)


def test_full_disk_loses_nothing(train, tiny, tmp_path):
    """A limit on the size of files stands in for a full disk: both are an OSError in mid-write."""
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # noqa: E731  less than a checkpoint
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 3, process)
    process.kill()
    process.communicate()
    folder = only_run(tmp_path)
    checkpoint = (folder / "checkpoint.pt").read_bytes()
    process = start(
        tmp_path,
        f"{tiny} --resume",
        preexec_fn=full,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    _, stderr = process.communicate()
    assert process.returncode == 1 and "Traceback" not in stderr
    assert stderr.strip().splitlines()[-1].startswith("error: ") and "--resume" in stderr
    assert (folder / "checkpoint.pt").read_bytes() == checkpoint and not list(folder.glob("*.tmp"))
    assert train(f"{tiny} --resume").returncode == 0
    assert_complete_tiny_run(folder)


def test_without_a_compiler_it_says_so_once_and_goes_on(train, tiny, tmp_path):
    env = {"CXX": "/nonexistent", "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")}
    process = train(tiny.replace("--no-compile", ""), env=env)
    assert (
        process.returncode == 0
        and process.stderr.count("note:") == 1
        and "compile" in process.stderr
    )
    assert_complete_tiny_run(only_run(tmp_path))


@pytest.mark.parametrize(
    "env_id, n_frames",
    [("MountainCarContinuous-v0", 999), ("dm_control/pendulum-swingup-v0", 1000)],
)
def test_capture_video_without_a_display(train, tiny, tmp_path, env_id, n_frames):
    if env_id.startswith("dm_control") and not ctypes.util.find_library("EGL"):
        pytest.skip("no EGL here, see the README on videos")
    env = dict.fromkeys(
        ["DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "SDL_VIDEODRIVER"]
    )  # none of them set
    process = train(f"{tiny} --capture-video --eval-freq 400 --env-id {env_id}", env=env)
    assert process.returncode == 0 and "Traceback" not in process.stderr, process.stderr
    videos = only_run(tmp_path) / "videos"
    assert [path.name for path in videos.iterdir()] == [
        "step_4000.mp4"
    ]  # the tenth of 10, and the last
    import imageio

    video = imageio.get_reader(videos / "step_4000.mp4")
    assert video.count_frames() == n_frames and np.ptp(video.get_data(500)) > 100  # not blank


def test_track_without_wandb_is_one_line(train, tiny, tmp_path):
    (tmp_path / "wandb.py").write_text("raise ImportError")
    process = train(f"{tiny} --track", env={"PYTHONPATH": str(tmp_path)})
    assert_one_line_error(process, "pip install wandb", code=2)


def test_help_is_complete():
    process = subprocess.run([sys.executable, SCRIPT, "--help"], capture_output=True, text=True)
    assert process.returncode == 0
    for flag in [
        "env-id",
        "beta",
        "n-envs",
        "seed",
        "vanilla",
        "resume",
        "overwrite",
        "track",
        "no-compile",
    ]:
        assert f"--{flag}" in process.stdout
    assert Path(SCRIPT).read_text().count("\n") <= 425
