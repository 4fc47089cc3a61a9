"""The script as a user runs it: its results, its files, being killed, and mistakes."""

import csv
import ctypes.util
import importlib.util
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import ROOT, SCRIPT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import environments
import ppo_colored_continuous as ppo
import run_files
from colored_noise import projected_beta

# A larger learning rate than the paper's: with that, returns pass 90 at about 160,000 steps
FAST = "--learning-rate 1e-3 --total-timesteps 98304 --eval-freq 8192 --eval-episodes 10"
FILES = {"config.json", "evaluations.csv", "checkpoint.pt", "best.pt", "summary.json", "lock"}


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
    # the policy that acts until the next update is evaluated: 600 and 1200 precede the first
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


def start(tmp_path, flags, script=SCRIPT, **kwargs):
    command = [sys.executable, script, *flags.split(), "--runs-dir", tmp_path / "runs"]
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
    process = start(tmp_path, f"{tiny} --overwrite")
    wait_for_rows(tmp_path, 2, process)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate()
    assert process.returncode == 130 and "Traceback" not in stderr
    assert "the same command with --resume in place of --overwrite goes on from here" in stderr
    assert torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)["global_step"] >= 512


@pytest.mark.parametrize("script", ["ppo_colored_continuous", "baselines", "play"])
def test_ctrl_c_while_loading(script, tmp_path):
    for package in ("gymnasium", "torch"):  # these are imported in place of the real ones
        code = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
        (tmp_path / f"{package}.py").write_text(code)
    process = subprocess.run(
        [sys.executable, ROOT / f"{script}.py"],
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert (process.returncode, process.stderr) == (-signal.SIGINT, b"")


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


def test_a_run_of_another_script_is_not_gone_on_with_in_silence(train, tiny, tmp_path):
    """Nor is it taken for one of this script, as sweeps and whoever has edited it might do."""
    assert train(tiny).returncode == 0
    config = only_run(tmp_path) / "config.json"
    ours = json.loads(config.read_text())["script"]
    config.write_text(config.read_text().replace(ours["crc32"], "an earlier one"))
    note = f"note: {ours['name']} made this run, and is not the {ours['name']} here: "
    assert train(tiny).stderr == f"{note}--overwrite runs it again\n"
    longer = tiny.replace("--total-timesteps 4096", "--total-timesteps 8192")
    process = train(f"{longer} --resume")
    assert process.returncode == 0 and process.stderr.startswith(f"{note}this one goes on\n")
    assert json.loads(config.read_text())["script"] == ours
    assert train(longer).stderr == ""


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
    size = 20_000  # less than a checkpoint
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))  # noqa: E731
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 3, process)
    process.kill()
    process.communicate()
    folder = only_run(tmp_path)
    checkpoint = (folder / "checkpoint.pt").read_bytes()
    for file in folder.glob("*.tmp"):  # where the kill came in mid-write
        file.unlink()
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


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "dm_control/pendulum-swingup-v0"])
def test_capture_video_without_a_display(train, tiny, tmp_path, env_id):
    if env_id.startswith("dm_control") and not ctypes.util.find_library("EGL"):
        pytest.skip("no EGL here, see docs/environments.md on videos")
    unset = dict.fromkeys(["DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "SDL_VIDEODRIVER"])
    flags = f"{tiny} --capture-video --eval-freq 400 --env-id {env_id} --max-episode-steps 100"
    process = train(flags, env=unset)
    assert process.returncode == 0 and "Traceback" not in process.stderr, process.stderr
    (path,) = (only_run(tmp_path) / "videos").iterdir()
    assert path.name == "step_4000.mp4"  # the tenth of 10, and the last
    import imageio

    video = imageio.get_reader(path)
    assert video.count_frames() == 100 and np.ptp(video.get_data(50)) > 100  # not blank


def test_track_without_wandb_is_one_line(train, tiny, tmp_path, monkeypatch):
    (tmp_path / "wandb.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path)
    process = train(f"{tiny} --track")
    assert_one_line_error(process, "pip install wandb", code=2)


def test_help_is_complete():
    process = subprocess.run([sys.executable, SCRIPT, "--help"], capture_output=True, text=True)
    assert process.returncode == 0
    flags = "env-id beta n-envs seed vanilla resume overwrite track no-compile no-envpool threads"
    for flag in flags.split():
        assert f"--{flag}" in process.stdout
    assert Path(SCRIPT).read_text().count("\n") <= 425


# ---- Nothing lost, nothing misleading

MY_ENV = '''
import os, random, signal, time, warnings
import gymnasium as gym, numpy as np

class Mine(gym.Env):
    """Ends after 50 steps; does something wrong in its 30th step, from its third episode on."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    episodes, signaled = 0, False

    def __init__(self, what=None):
        self.what = what
        if what == "warns":
            warnings.warn("not calibrated")
        if os.environ.get("BROKEN"):
            raise ZeroDivisionError("broken")

    def reset(self, seed=None, options=None):
        self.t, self.episodes = 0, self.episodes + 1
        return np.float32([random.random() + np.random.random()]), {}

    def step(self, action):
        self.t += 1
        x, reward = np.float32([self.t]), float(action[0])
        if self.t == 30 and self.episodes >= 3:
            if self.what == "observation":
                x = x * np.nan
            elif self.what == "reward":
                reward = -np.inf
            elif self.what == "OSError":
                open("/does/not/exist")
            elif self.what == "gym":
                raise gym.error.InvalidAction("mine")
            elif self.what == "signal" and not Mine.signaled:
                Mine.signaled = True
                try:  # as dm_control does, in a property lookup
                    os.kill(os.getpid(), signal.SIGTERM)
                    time.sleep(0.01)
                except BaseException:
                    pass
            elif self.what == "hang":
                print("hangs", flush=True)
                time.sleep(60)
        return x, reward, False, self.t == 50 and self.what != "endless", {}

    def close(self):
        with open(os.path.join(os.path.dirname(__file__), "closed"), "a") as file:
            file.write(self.what + " ")

for what in "observation reward OSError gym signal hang endless well warns".split():
    gym.register(f"Mine-{what}-v0", Mine, kwargs={"what": what})
'''


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Makes `mine_env:Mine-well-v0` and the like known."""
    (tmp_path / "mine_env.py").write_text(MY_ENV)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def files_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_overwrite_removes_nothing_before_the_new_run_can_start(
    train, tiny, tmp_path, mine, monkeypatch
):
    flags = f"{tiny} --env-id mine_env:Mine-well-v0"
    assert train(flags).returncode == 0
    before = files_of(tmp_path / "runs")
    (tmp_path / "wandb.py").write_text("raise ImportError")
    assert_one_line_error(train(f"{flags} --overwrite --track"), "wandb", code=2)
    process = train(f"{flags} --overwrite --noise-seq-len 1e12")
    assert_one_line_error(process, "memory", code=2)
    monkeypatch.setenv("BROKEN", "1")
    process = train(f"{flags} --overwrite")
    monkeypatch.delenv("BROKEN")
    assert process.returncode == 1 and "ZeroDivisionError: broken" in process.stderr
    assert files_of(tmp_path / "runs") == before
    # and a run that cannot start is none
    assert_one_line_error(train(f"{flags} --track --seed 2"), "wandb", code=2)
    assert train(f"{flags} --seed 2").returncode == 0


def test_a_deleted_tensorboard_file_is_a_note(train, tiny, tmp_path):
    process = start(tmp_path, tiny)
    wait_for_rows(tmp_path, 3, process)
    process.send_signal(signal.SIGTERM)
    process.communicate()
    (events,) = only_run(tmp_path).glob("events.*")
    events.unlink()
    process = train(f"{tiny} --resume")
    assert process.returncode == 0 and "note: events.out" in process.stderr
    steps = [row["step"] for row in read_evaluations(only_run(tmp_path))]
    assert steps == list(range(512, 4097, 512))


def test_environments_are_closed_and_their_warnings_shown(train, tiny, tmp_path, mine):
    """Whatever has ended the program: a simulator may be a process that would go on."""
    flags = f"{tiny} --env-id mine_env:Mine-warns-v0"
    assert train(flags).returncode == 0
    assert (tmp_path / "closed").read_text().split() == ["warns"] * 4
    process = start(tmp_path, f"{flags} --beta 0 1")
    said = process.communicate()[1]
    assert "UserWarning: not calibrated" in said and "--beta has 2 values" in said
    assert (tmp_path / "closed").read_text().split() == ["warns"] * 8


def test_no_time_limit(train, tiny, tmp_path, mine):
    flags = f"{tiny} --env-id mine_env:Mine-endless-v0"
    process = train(flags)
    assert process.returncode == 1
    last = process.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ") and "10000 steps: --max-episode-steps" in last
    assert not (only_run(tmp_path) / "summary.json").exists()
    process = train(f"{flags} --max-episode-steps 40 --overwrite")
    assert process.returncode == 0, process.stderr
    assert {row["length_mean"] for row in read_evaluations(only_run(tmp_path))} == {40}


@pytest.mark.parametrize("flags", ["", "--no-compile"])
def test_unwritable_compile_cache(train, tiny, flags):
    env = {"TORCHINDUCTOR_CACHE_DIR": "/proc/nope", "CXX": "/nonexistent"}  # it would take long
    process = train(f"{tiny.replace('--no-compile', '')} {flags}", env=env)
    assert process.returncode == 0 and "Traceback" not in process.stderr


@pytest.mark.parametrize("what", ["observation", "reward"])
def test_what_is_not_finite_is_named(train, tiny, tmp_path, mine, what):
    """With evaluations of one episode the third, with the fault, is one of training."""
    process = train(f"{tiny} --env-id mine_env:Mine-{what}-v0 --eval-freq 4096")
    assert process.returncode == 1 and "Traceback" not in process.stderr
    last = process.stderr.strip().splitlines()[-1]
    # the 30th step of the third episode, in both environments at once
    assert last.startswith(f"error: {what} ") and f"Mine-{what}-v0" in last
    assert "step 260" in last
    assert not (only_run(tmp_path) / "summary.json").exists()


@pytest.mark.parametrize("what, words", [("OSError", "/does/not/exist"), ("gym", "InvalidAction")])
def test_faults_of_the_environment_keep_their_traceback(train, tiny, mine, what, words):
    process = train(f"{tiny} --env-id mine_env:Mine-{what}-v0")
    assert process.returncode == 1 and "Traceback" in process.stderr and words in process.stderr
    assert "mine_env.py" in process.stderr and "--resume" not in process.stderr


@pytest.mark.parametrize("in_evaluation", [False, True])
def test_a_swallowed_signal_stops_all_the_same(train, tiny, tmp_path, mine, in_evaluation):
    flags = "--eval-freq 128" if in_evaluation else ""  # the second of the first policy
    process = train(f"{tiny} --env-id mine_env:Mine-signal-v0 {flags}")
    assert process.returncode == 143 and "--resume" in process.stderr
    assert "Traceback" not in process.stderr
    if in_evaluation:
        assert len(read_evaluations(only_run(tmp_path))) == 1
    else:
        checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
        assert checkpoint["global_step"] == 0


def test_a_second_signal_ends_at_once(tiny, tmp_path, mine):
    flags = f"{tiny} --env-id mine_env:Mine-hang-v0"
    process = start(tmp_path, flags)
    assert process.stdout.readline() == "hangs\n"
    process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(1)
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == -signal.SIGINT


def test_a_diverged_run_says_so_on_a_line_of_its_own(train, tiny):
    process = train(f"{tiny} --learning-rate 1e38")
    assert process.returncode == 1
    assert process.stderr.strip().splitlines()[-1].startswith("error: training diverged")


def test_numbers_as_people_write_them():
    def parse(*words):
        return vars(ppo.parse_args(list(words)))

    assert parse("--beta", "-1e-1", "-2E0")["beta"] == [-0.1, -2]
    assert parse("--ent-coef", "-1e-3")["ent_coef"] == -0.001
    assert parse("--seed", "9007199254740993")["seed"] == 9007199254740993
    assert parse("--n-steps", "1e3")["n_steps"] == 1000


def test_global_generators_are_seeded_and_evaluations_do_not_touch_them(
    train, tiny, tmp_path, mine
):
    def rollouts(flags):
        flags = f"{tiny} --env-id mine_env:Mine-well-v0 --overwrite {flags}"
        assert train(flags).returncode == 0
        (folder,) = {path.parent for path in (tmp_path / "runs").rglob("summary.json")}
        events = read_events(folder)
        (folder / "summary.json").unlink()
        return events["losses/value_loss"]  # depends on the observations after each reset

    first = rollouts("")
    assert first == rollouts("") == rollouts("--eval-episodes 5 --eval-freq 1024")
    assert first != rollouts("--seed 2")


def test_short_updates_write_few_checkpoints_and_points(tmp_path, monkeypatch):
    flags = "--n-steps 5 --n-envs 2 --total-timesteps 30000 --eval-freq 10000 --eval-episodes 1 "
    flags += (
        f"--max-episode-steps 20 --batch-size 10 --n-epochs 1 --no-compile --runs-dir {tmp_path}"
    )
    written = []
    write = run_files.RunFolder._write_checkpoint
    monkeypatch.setattr(run_files, "SECONDS_BETWEEN_CHECKPOINTS", 1e9)
    count = lambda run: (written.append(1), write(run))  # noqa: E731
    monkeypatch.setattr(run_files.RunFolder, "_write_checkpoint", count)
    ppo.main(
        ppo.parse_args(flags.split()),
        learn=lambda agent, optimizer, *_: (optimizer, {"policy_loss": 0}),
    )
    assert len(written) == 3 + 1  # evaluations, and the end
    (folder,) = {path.parent for path in tmp_path.rglob("summary.json")}
    assert len(read_events(folder)["losses/policy_loss"]) == 1000


def test_checkpoints_do_not_hold_the_noise_itself(train, tiny, tmp_path):
    assert train(f"{tiny} --noise-seq-len 100000").returncode == 0
    assert (only_run(tmp_path) / "checkpoint.pt").stat().st_size < 300_000


def test_eval_once_per_policy(train, tmp_path, tiny):
    flags = f"{tiny} --env-id Pendulum-v1 --n-steps 1024"  # 4 evaluations for each of 2 policies
    assert train(f"{flags} --eval-once-per-policy").returncode == 0
    returns = [row["return_mean"] for row in read_evaluations(only_run(tmp_path))]
    (tmp_path / "runs").rename(tmp_path / "once")
    assert train(flags).returncode == 0
    anew = [row["return_mean"] for row in read_evaluations(only_run(tmp_path))]
    assert len(set(anew)) == len(anew) == len(returns) == 8
    first_of_each_policy = [0, 3, 7]  # steps 512, 2048 and 4096
    assert [returns.index(x) for x in dict.fromkeys(returns)] == first_of_each_policy
    assert all(returns[i] == anew[i] for i in first_of_each_policy)


def test_envpool_is_the_default_and_a_resumed_run_keeps_it(train, tiny, tmp_path):
    def used():
        return json.loads((only_run(tmp_path) / "config.json").read_text())["args"]["envpool"]

    assert train(f"{tiny} --no-envpool").returncode == 0 and not used()
    assert "complete" in train(tiny).stdout and not used()
    assert_one_line_error(train(f"{tiny} --envpool"), "--envpool False, not True", code=2)
    (only_run(tmp_path) / "summary.json").unlink()
    assert train(f"{tiny} --resume").returncode == 0 and not used()
    assert train(f"{tiny} --overwrite").returncode == 0
    assert used() == (importlib.util.find_spec("envpool") is not None)


def test_runs_of_earlier_versions(train, tiny, tmp_path):
    """Arguments that they do not know had their defaults."""
    assert train(f"{tiny} --no-envpool").returncode == 0
    path = only_run(tmp_path) / "config.json"
    config = json.loads(path.read_text())
    for name in ("method", "anneal_lr", "max_episode_steps", "eval_once_per_policy", "threads"):
        del config["args"][name]
    path.write_text(json.dumps(config))
    assert "complete" in train(tiny).stdout
    assert_one_line_error(train(f"{tiny} --anneal-lr"), "--anneal-lr False, not True", code=2)
    (only_run(tmp_path) / "summary.json").unlink()
    checkpoint = torch.load(only_run(tmp_path) / "checkpoint.pt", weights_only=True)
    del checkpoint["agent"]
    torch.save(checkpoint, only_run(tmp_path) / "checkpoint.pt")
    assert_one_line_error(train(f"{tiny} --resume"), "earlier version", code=1)


def test_importing_has_no_effect_and_needs_nothing_of_unix():
    code = """
import os, sys
for name in ("fcntl", "resource", "termios", "pwd", "grp"):
    sys.modules[name] = None  # as on Windows
import torch
before = torch.get_num_threads(), dict(os.environ)
torch.set_num_threads(2)
import ppo_colored_continuous, analysis, mazes, plot
assert torch.get_num_threads() == 2 and "OMP_NUM_THREADS" not in os.environ
"""
    env = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=env, check=True)


def test_wandb_ids(monkeypatch, tmp_path):
    started = []
    wandb = types.SimpleNamespace(init=lambda **how: started.append(how), Settings=dict)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    flags = "--track --env-id mine_env:Mine-v0 --exp-name a:b --runs-dir"
    for runs_dir, more in [("a", ""), ("b", ""), ("a", ""), ("a", "--overwrite")]:
        args = vars(ppo.parse_args(f"{flags} {tmp_path / runs_dir} {more}".split()))
        run_files._start_wandb(run_files.run_path(args), args)
    ids = [how["id"] for how in started]
    assert ids[0] == ids[2] and len(set(ids)) == 3
    assert all(re.fullmatch(r"[\w.-]{8,128}", x) for x in ids)


def test_a_finished_run_can_be_trained_longer(train, tiny, tmp_path):
    """It goes on with the next evaluation, as one that was meant to be as long from the start."""
    assert train(tiny).returncode == 0
    folder = only_run(tmp_path)
    first = (folder / "evaluations.csv").read_bytes()
    longer = tiny.replace("4096", "8192")
    assert_one_line_error(train(longer), "4096, not 8192", "--resume to train it longer", code=2)
    assert (folder / "evaluations.csv").read_bytes() == first
    process = train(f"{longer} --resume")
    assert process.returncode == 0, process.stderr
    assert (folder / "evaluations.csv").read_bytes().startswith(first)
    assert [row["step"] for row in read_evaluations(folder)] == list(range(512, 8193, 512))
    assert json.loads((folder / "summary.json").read_text())["steps"] == 8192
    assert json.loads((folder / "config.json").read_text())["args"]["total_timesteps"] == 8192
    assert "complete" in train(f"{longer} --resume").stdout
    assert_one_line_error(train(f"{tiny} --resume"), "8192, not 4096", code=2)
    (folder / "checkpoint.pt").unlink()
    even_longer = tiny.replace("4096", "9216") + " --resume"
    assert_one_line_error(train(even_longer), "no checkpoint.pt", code=1)
    assert len(read_evaluations(folder)) == 16


def test_a_run_that_learned_beyond_its_end_cannot_be_trained_longer(train, tiny, tmp_path):
    """The policy to evaluate at 4000 is that of 3584, and the run has gone on to 4096."""
    uneven = tiny.replace("512", "500").replace("4096", "3600")
    assert train(uneven).returncode == 0
    files = {path: path.read_bytes() for path in only_run(tmp_path).iterdir()}
    longer = uneven.replace("3600", "8192") + " --resume"
    assert_one_line_error(train(longer), "cannot be trained longer", "step 4000", code=1)
    assert {path: path.read_bytes() for path in only_run(tmp_path).iterdir()} == files
    # Killed after its last update, before its summary, it is resumed to the same end
    (only_run(tmp_path) / "summary.json").unlink()
    process = train(f"{uneven} --resume")
    assert process.returncode == 0, process.stderr
    assert [row["step"] for row in read_evaluations(only_run(tmp_path))] == [*range(500, 3501, 500)]


@pytest.mark.parametrize(
    "name, text",
    [
        ("config.json", None),
        ("config.json", "[]"),
        ("config.json", '{"args": []}'),
        ("summary.json", "{}"),
        ("summary.json", "null"),
        ("summary.json", '{"final_return": "x"}'),
    ],
)
def test_a_run_without_its_settings_or_summary_is_not_erased(train, tiny, tmp_path, name, text):
    assert train(tiny).returncode == 0
    file = only_run(tmp_path) / name
    file.unlink() if text is None else file.write_text(text)
    files = {path: path.read_bytes() for path in file.parent.iterdir()}
    for flags in (tiny, f"{tiny} --resume"):
        code = 2 if text == '{"args": []}' else 1
        assert_one_line_error(train(flags), "--overwrite", code=code)
    assert {path: path.read_bytes() for path in file.parent.iterdir()} == files
    assert train(f"{tiny} --overwrite").returncode == 0


@pytest.mark.parametrize("old, new", [("\n", "\r\n"), (",", ";"), ("\n512,", "\n513,")])
def test_evaluations_that_were_edited_are_not_gone_on_with(train, tiny, tmp_path, old, new):
    assert train(tiny).returncode == 0
    file = only_run(tmp_path) / "evaluations.csv"
    file.write_bytes(file.read_bytes().replace(old.encode(), new.encode()))
    files = {path: path.read_bytes() for path in file.parent.iterdir()}
    longer = tiny.replace("4096", "8192") + " --resume"
    assert_one_line_error(train(longer), "evaluations.csv is not what it was", code=1)
    assert {path: path.read_bytes() for path in file.parent.iterdir()} == files


def test_a_user_without_a_name(monkeypatch):
    """As in a container that is started with another uid."""

    def getuser():
        raise KeyError("getpwuid(): uid not found: 1234")

    monkeypatch.setattr(run_files.getpass, "getuser", getuser)
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    assert run_files._compile_cache().endswith(f"torchinductor_{os.getuid()}")


def test_an_annealed_run_cannot_be_trained_longer(train, tiny, tmp_path):
    assert train(f"{tiny} --anneal-lr").returncode == 0
    longer = tiny.replace("4096", "8192") + " --anneal-lr --resume"
    assert_one_line_error(train(longer), "--anneal-lr", "4096", code=2)


def test_the_best_policy_is_kept(train, tiny, tmp_path):
    """best.pt holds what was evaluated best: the first of equals, and the right parameters."""
    flags = f"{tiny} --env-id Pendulum-v1 --learning-rate 0.05 --eval-episodes 5"
    assert train(flags).returncode == 0
    folder = only_run(tmp_path)
    rows = read_evaluations(folder)
    best_row = max(rows, key=lambda row: row["return_mean"])
    assert best_row is not rows[-1]  # or this shows nothing
    best = torch.load(folder / "best.pt", weights_only=True)
    assert best["step"] == best_row["step"]
    assert best["return_mean"] == pytest.approx(best_row["return_mean"], rel=1e-6)
    agent = ppo.Agent(3, 1).requires_grad_(False)
    agent.load_state_dict(best["agent"])
    envs = environments.make_vector_env("Pendulum-v1", 5)
    seeds = run_files.make_seeds(5, 1, 2, int(best["step"]))
    returns, _ = ppo.evaluate(run_files.numpy_policy(agent.actor_mean), envs, seeds)
    assert returns.mean() == pytest.approx(best["return_mean"], rel=1e-5)


def test_the_best_policy_after_a_kill(train, tiny, tmp_path):
    """One that was evaluated after the last checkpoint is lost with its evaluation."""
    assert train(tiny).returncode == 0
    folder = only_run(tmp_path)
    (folder / "summary.json").unlink()
    kept = torch.load(folder / "best.pt", weights_only=True)
    torch.save(kept | {"return_mean": 1e9, "step": 10**9}, folder / "best.pt")
    assert train(f"{tiny} --resume").returncode == 0
    assert torch.load(folder / "best.pt", weights_only=True)["step"] == kept["step"]


def test_beta_auto(train, tiny, tmp_path):
    process = train(f"{tiny} --beta auto --n-steps 1024")
    assert process.returncode == 0, process.stderr
    assert "--beta auto is 0.163 here" in process.stdout
    folder = only_run(tmp_path)
    assert folder.parts[-3:] == ("beta_auto", "n_envs_2", "seed_1")
    config = json.loads((folder / "config.json").read_text())["args"]
    assert config["beta"] == [projected_beta(2, 1024)] and config["beta_auto"]
    assert "complete" in train(f"{tiny} --beta auto --n-steps 1024").stdout
    assert_one_line_error(train(f"{tiny} --beta auto 1"), "--beta auto is one number", code=2)
