"""study.play: what it plays is what was trained and evaluated."""

import re

import gymnasium as gym
import imageio
import numpy as np
import pytest
import torch

import ppo_colored_continuous as ppo
from colored_noise import ColoredNoiseProcess
from study import methods, play
from study.play import load_policy

FLAGS = "--total-timesteps 4096 --n-envs 2 --n-steps 256 --eval-freq 512 --eval-episodes 2 "
FLAGS += "--n-epochs 1 --no-compile "
# All that the policy must be played with
TASK = '--env-id Pendulum-v1 --env-kwargs {"g":5} --max-episode-steps 30 --noise-seq-len 40 '
TASK += "--normalize-obs --normalize-rewards --rescale-actions --learning-rate 1e-2"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a run whose policy was best before it ended."""
    args = ppo.parse_args([*FLAGS.split(), *TASK.split()])
    args.runs_dir = str(tmp_path_factory.mktemp("runs"))
    ppo.main(args)
    folder = ppo.run_path(args)
    assert torch.load(folder / "best.pt", weights_only=True)["step"] < 4096
    return folder


@pytest.fixture
def played(capsys):
    """played(folder, "--best"): returns and lengths of episodes that study.play writes."""

    def run(folder, flags=""):
        play.main(play.parse_args([str(folder), *flags.split()]))
        lines = re.findall(r"episode \d+: return (\S+), length (\d+)\n", capsys.readouterr().out)
        return [float(total) for total, _ in lines], [int(length) for _, length in lines]

    return run


def by_hand(folder, file="checkpoint.pt", beta=None, seed=1):
    """Return of an episode, with nothing of study/, and of the script the network alone."""
    saved = torch.load(folder / file, weights_only=True)
    statistics = saved["normalization"]["obs"]
    mean, var = (np.array(statistics[name]) for name in ("mean", "var"))
    agent = ppo.Agent(3, 1).requires_grad_(False)
    agent.load_state_dict(saved["agent"])
    noise = beta is not None and ColoredNoiseProcess(beta, 1, 1, seq_len=40, seed=seed)
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


@pytest.mark.parametrize("best", [False, True])
def test_the_policy_as_it_acts(trained, played, best):
    """The lines in the documentation, the program, and the same by hand: one return."""
    env, policy, step = load_policy(trained, best)
    returns, lengths = ppo.evaluate(policy, env, seeds=[1])
    expected = by_hand(trained, "best.pt" if best else "checkpoint.pt")
    assert returns == pytest.approx(expected, rel=1e-4) and lengths == 30
    shown, lengths = played(trained, "--episodes 2" + " --best" * best)
    assert shown[0] == pytest.approx(expected, rel=1e-3) and lengths == [30, 30]
    assert shown[1] != pytest.approx(shown[0], rel=1e-3)  # of the next seed
    assert (step < 4096) if best else (step == 4096)
    assert by_hand(trained, "best.pt") != pytest.approx(by_hand(trained), rel=1e-2)


def evaluated_again(folder, best=False):
    """Mean return of the policy in the episodes of its own evaluation."""
    env, policy, step = load_policy(folder, best)
    seeds = ppo.make_seeds(2, 1, 2, step)
    return np.mean([ppo.evaluate(policy, env, [seed])[0] for seed in seeds])


def test_the_evaluated_return(trained, read_evaluations):
    returns = [row["return_mean"] for row in read_evaluations(trained)]
    assert evaluated_again(trained) == pytest.approx(returns[-1], rel=1e-5)
    assert evaluated_again(trained, best=True) == pytest.approx(max(returns), rel=1e-5)


def test_noise(trained, played):
    (first, second), _ = played(trained, "--episodes 2 --beta 1 --seed 3")
    assert first == pytest.approx(by_hand(trained, beta=1, seed=3), rel=1e-3)
    assert first != pytest.approx(by_hand(trained, seed=3), rel=1e-2) and second != first


def test_video_and_window(trained, played, tmp_path, monkeypatch):
    file = tmp_path / "pendulum.mp4"
    returns, _ = played(trained, f"--video {file}")
    assert returns == pytest.approx([by_hand(trained)], rel=1e-3)
    frames = imageio.v3.imread(file)
    assert len(frames) == 30 and frames[0].std() > 1 and (frames[0] != frames[-1]).any()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # in place of a display: draws nowhere
    assert played(trained, "--window --episodes 1")[0] == returns


def test_gsde(tmp_path, read_evaluations):
    """Its mean action is evaluated and played."""
    methods.main(["gsde", *FLAGS.split(), "--env-id", "Pendulum-v1", "--runs-dir", str(tmp_path)])
    folder = next(tmp_path.rglob("config.json")).parent
    assert evaluated_again(folder) == pytest.approx(read_evaluations(folder)[-1]["return_mean"])
    with pytest.raises(ValueError, match="gSDE has its own noise"):
        load_policy(folder, beta=1)
