"""play.py: what it plays is what was trained and evaluated."""

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
import types
from unittest import mock

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch
from conftest import ROOT, TINY

import baselines
import play as play_script
import ppo_colored_continuous as ppo
import run_files
from colored_noise import ColoredNoiseProcess

FLAGS = (
    "--noise-seq-len 40 --env-id Pendulum-v1 --normalize-obs --normalize-rewards --rescale-actions "
)
FLAGS += "--env-kwargs g=5 --max-episode-steps 30 --learning-rate 1e-2"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run that has everything that play.py must heed."""
    runs = tmp_path_factory.mktemp("runs")
    with mock.patch.object(sys, "argv", [ppo.__file__]):
        ppo.main(ppo.parse_args(f"{TINY} {FLAGS} --runs-dir {runs}".split()))
    (config,) = runs.rglob("config.json")
    return config.parent


def play(folder, flags=""):
    """Runs play.py in this process. Returns its exit code and what it wrote."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            play_script.main(play_script.parse_args([str(folder), *flags.split()]))
        except SystemExit as ended:
            code = ended.code
    return types.SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def test_a_run_of_another_script_is_named(trained, tmp_path):
    """Its network may have been another, with parameters of the same shapes."""
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    config = json.loads((folder / "config.json").read_text())
    for path, note in ((ppo.__file__, False), (__file__, True)):
        config["script"] = run_files.script(path)
        (folder / "config.json").write_text(json.dumps(config))
        assert ("note: test_play.py made this run" in play(folder).stderr) == note


def by_hand(folder, file="checkpoint.pt", beta=None, seed=1):
    """Return of an episode, with nothing of play.py or environments.py."""
    saved = torch.load(folder / file, weights_only=True)
    statistics = saved["normalization"]["obs"]
    mean, var = (np.array(statistics[name]) for name in ("mean", "var"))
    agent = ppo.Agent(3, 1).requires_grad_(False)
    agent.load_state_dict(saved["agent"])
    noise = beta and ColoredNoiseProcess([beta], 1, 1, seq_len=40, seed=seed)
    env, total = gym.make("Pendulum-v1", max_episode_steps=30, g=5), 0
    obs, _ = env.reset(seed=seed)
    for _ in range(30):
        obs = np.clip((obs - mean) / np.sqrt(var + 1e-8), -10, 10)
        action = agent.actor_mean(torch.as_tensor(obs, dtype=torch.float32))
        if noise:
            action = action + agent.log_std.exp() * noise.sample(1)[0, 0]
        obs, reward, *_ = env.step(2 * action.clip(-1, 1).numpy())  # its bounds are -2 and 2
        total += reward
    return total


def shown_returns(process):
    assert process.returncode == 0, process.stderr
    pattern = r"episode \d+: return (\S+), length 30\n"
    return [float(x) for x in re.findall(pattern, process.stdout)]


def test_the_last_policy_and_the_best(trained):
    for flags, file in [("", "checkpoint.pt"), ("--best", "best.pt")]:
        process = play(trained, f"--episodes 3 --seed 5 {flags}")
        returns = [by_hand(trained, file, seed=seed) for seed in (5, 6, 7)]
        assert shown_returns(process) == pytest.approx(returns, rel=1e-3)
        step = torch.load(trained / "best.pt", weights_only=True)["step"] if flags else 4096
        assert f"Pendulum-v1, the policy after {step:,} steps, no noise" in process.stdout
        assert f"mean return {np.mean(returns):.3g}"[:15] in process.stdout


def test_with_noise(trained):
    returns = shown_returns(play(trained, "--episodes 2 --beta 1 --seed 3"))
    assert returns[0] == pytest.approx(by_hand(trained, beta=1, seed=3), rel=1e-3)
    assert returns[0] != pytest.approx(by_hand(trained, seed=3), rel=1e-2)


def test_video(trained, tmp_path):
    process = play(trained, f"--video {tmp_path / 'pendulum.mp4'}")
    assert len(shown_returns(process)) == 1 and "pendulum.mp4" in process.stdout
    frames = imageio.v3.imread(tmp_path / "pendulum.mp4")
    assert len(frames) == 30 and frames[0].std() > 1 and (frames[0] != frames[-1]).any()


def test_window(trained, monkeypatch):
    """Where there is a display: SDL's that draws nowhere takes its place here."""
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    process = play(trained, "--window --episodes 1")
    assert shown_returns(process) == pytest.approx([by_hand(trained)], rel=1e-3)


def test_gsde(tmp_path):
    baselines.main(["gsde", *TINY.split(), "--runs-dir", str(tmp_path)])
    (config,) = tmp_path.rglob("config.json")
    command = [sys.executable, ROOT / "play.py", config.parent, "--episodes", "1"]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == 0 and "length 999" in process.stdout and process.stderr == ""
    assert "a gSDE policy has noise of its own" in play(config.parent, "--beta 1").stderr


@pytest.mark.parametrize(
    "flags, words",
    [("--beta 0 1", "--beta has 2 values, the run 1 action dimensions")]
    + [("--video x.avi", "has to end in .mp4"), ("--episodes 0", "--episodes")]
    + [("--video /no/such/x.mp4", "cannot write /no/such/x.mp4"), ("--bet 1", "--bet")],
)
def test_wrong_flags(trained, flags, words):
    process = play(trained, flags)
    assert process.returncode == 2 and words in process.stderr.splitlines()[-1]


def test_wrong_folders(trained, tmp_path):
    def error(folder, flags=""):
        process = play(folder, flags)
        assert process.returncode and process.stderr.count("\n") == 1, process.stderr
        return process.stderr

    assert "give the folder of one run, such as" in error(tmp_path)
    assert "give the folder of one run, such as" in error(tmp_path / "nowhere", "--best")
    assert "give the folder of one run, such as" in error(trained / "checkpoint.pt")
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    (copy / "best.pt").unlink()
    assert "has no best.pt" in error(copy, "--best")
    (copy / "checkpoint.pt").write_bytes((trained / "checkpoint.pt").read_bytes()[:5000])
    assert "checkpoint.pt is damaged" in error(copy)
    state = torch.load(trained / "checkpoint.pt", weights_only=True)
    del state["agent"]["actor_mean.0.bias"]
    torch.save(state, copy / "checkpoint.pt")
    assert "does not fit" in error(copy) and "actor_mean.0.bias" in error(copy)
    config = json.loads((copy / "config.json").read_text())
    config["args"]["env_id"] = "Pendulun-v1"
    (copy / "config.json").write_text(json.dumps(config))
    assert "Pendulun-v1" in error(copy)
    assert run_files.ABSENT.keys() <= config["args"].keys()


def test_noise_of_an_exponent_and_a_long_time_limit(trained, tmp_path):
    """As the script has them: -1e-1 is a number, and the run's own limit holds."""
    assert len(shown_returns(play(trained, "--episodes 1 --beta -1e-1"))) == 1
    copy = tmp_path / "copy"
    shutil.copytree(trained, copy)
    config = json.loads((copy / "config.json").read_text())
    config["args"]["max_episode_steps"] = 10_050
    (copy / "config.json").write_text(json.dumps(config))
    assert "length 10050\n" in play(copy, "--episodes 1").stdout
