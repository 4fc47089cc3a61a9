"""README and docs: what they say can be run, is run here, shortened; what they link to is there."""

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution
from torch.distributions import Normal

import ppo_colored_continuous as ppo
from colored_noise import PUBLISHED_BEST_BETA, autocovariance, projected_beta

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
OWN = (ROOT / "docs" / "environments.md").read_text()
SWEEPS = (ROOT / "docs" / "sweeps.md").read_text()
LESSON = (ROOT / "docs" / "lesson.md").read_text()
PAGES = [ROOT / "README.md", *(ROOT / "results").glob("*.md"), *(ROOT / "docs").glob("*.md")]
TRAINING = "--total-timesteps 2048 --eval-freq 1024 --eval-episodes 2 --n-steps 256 --no-compile"


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def section(text, heading):
    """The text under a heading of the second level."""
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def run(command, folder, old="", new=""):
    """Runs a command of a page in another folder than the repository's; returns what it says."""
    assert old in command
    command = command.replace(old, new) if old else command
    command = re.sub(r"(^|&& )python (\w+\.py)", rf"\1{sys.executable} {ROOT}/\2", command)
    command = re.sub(r"(^|&& )python -m", rf"\1{sys.executable} -m", command)
    how = {"cwd": folder, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    process = subprocess.run(["bash", "-c", command], capture_output=True, **how)
    assert process.returncode == 0, (command, process.stdout, process.stderr)
    return process.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links(page):
    """Files are there, and headings are."""
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        path = (page.parent / path).resolve() if path else page
        assert path.exists(), target
        headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE) if anchor else []
        slugs = [re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings]
        assert not anchor or anchor in slugs, target


def test_commands_have_flags_that_there_are():
    found = 0
    for page in PAGES:
        for line in "\n".join(blocks(page.read_text(), "bash")).replace("\\\n", "").splitlines():
            *_, flags = line.partition("python ppo_colored_continuous.py")
            if flags:
                ppo.parse_args(shlex.split(flags, comments=True))
                found += 1
    assert found >= 2


def test_the_lines_that_are_the_paper_are_in_the_script():
    (code,) = blocks(section(README, "The lines that are the paper"), "python")
    text = (ROOT / "ppo_colored_continuous.py").read_text()
    assert "".join(f"    {line}\n" for line in code.splitlines()) in text


def looks_colored(eps, atol=0.05):
    """eps (n_steps, ...) has the variance and the correlation of beta 0.5."""
    lag_1 = (eps[1:] * eps[:-1]).mean().item()
    return abs(eps.var().item() - 1) < atol and abs(lag_1 - autocovariance(0.5, 1000)[1]) < atol


def snippet(number):
    return blocks(section(README, "Put it into your own PPO"), "python")[number]


def test_cleanrl():
    """The three lines, with the names that they find in ppo_continuous_action.py."""
    imports, make, draw = snippet(0).replace("\n\n", "\n").splitlines()
    names = {"args": types.SimpleNamespace(seed=1), "device": torch.device("cpu")}
    names |= {"actions": torch.zeros(2048, 4, 2)}  # (num_steps, num_envs, action_dim)
    exec(f"{imports}\n{make}", names)
    eps = []
    for _ in range(1000):
        names |= {"action_mean": torch.randn(4, 2), "action_std": torch.full((1, 2), 0.4)}
        exec(draw, names)
        eps.append((names["action"] - names["action_mean"]) / 0.4)
    assert eps[0].shape == (4, 2) and looks_colored(torch.stack(eps))


def test_stable_baselines3(tmp_path):
    """It learns from colored noise; what the text says on PPO.load and predict is so."""
    code = snippet(1).replace("learn(100_000)", "learn(2048)")
    code = code.replace("action_dim=1)", "action_dim=1, seed=0)")
    torch.manual_seed(0)
    names = {}
    exec(code, names)
    model = names["model"]
    actions = torch.as_tensor(model.rollout_buffer.actions).flatten()
    assert len(actions) == 2048
    assert looks_colored(actions, atol=0.1)  # the first mean actions are about 0, the std is 1
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model")
    assert type(loaded.policy.action_dist) is DiagGaussianDistribution
    observation = np.zeros(2, np.float32)
    model.policy.action_dist = names["ColoredNoiseDistribution"](0.5, 4, action_dim=1)
    assert model.predict(observation, deterministic=True)[0].shape == (1,)
    with pytest.raises(ValueError, match="squeeze|reshape"):
        model.predict(observation)


@pytest.mark.parametrize(
    ("number", "module"), [(2, "rsl_rl.algorithms"), (3, "skrl.agents.torch.ppo")]
)
def test_rsl_rl_and_skrl(number, module, monkeypatch):
    """With stand-ins that have the names of rsl_rl 5.5.1 and skrl 2.1.1."""
    normal, space = Normal(torch.randn(64, 2), torch.full((64, 2), 0.4)), types.SimpleNamespace
    actor = {"output_mean": normal.mean, "output_std": normal.stddev}
    actor["get_output_log_prob"] = lambda actions: normal.log_prob(actions).sum(-1)
    stand_in = {"device": "cpu", "transition": space(), "actor": space(**actor)}
    stand_in["policy"] = space(distribution=lambda role: normal)
    stand_in["act"] = lambda self, obs: (normal.sample(), {})
    monkeypatch.setitem(sys.modules, module, space(PPO=type("PPO", (), stand_in)))
    names = {}
    exec(snippet(number), names)
    ppo, in_rsl_rl = names["ColoredNoisePPO"](), number == 2
    returned = [ppo.act(torch.zeros(64, 3)) for _ in range(1000)]
    actions = torch.stack(returned if in_rsl_rl else [each[0] for each in returned])
    log_prob = ppo.transition.actions_log_prob if in_rsl_rl else ppo._current_log_prob[:, 0]
    torch.testing.assert_close(log_prob, normal.log_prob(actions[-1]).sum(-1))
    assert looks_colored((actions - normal.mean) / 0.4)


def test_which_beta():
    text = section(README, "Should I use it, and with which beta?")
    found = re.findall(r"([\d.]+) for (\d+) · (\d+)(?: \((?:published best: )?([\d.]+)\))?", text)
    for beta, n_envs, n_steps, best in found:
        assert float(beta) == round(projected_beta(int(n_envs), int(n_steps)), 2)
        assert best == (str(PUBLISHED_BEST_BETA[int(n_envs)]) if n_steps == "2048" else "")
    assert len(found) == 5


# --- docs


def test_an_environment_of_ones_own(tmp_path):
    text = section(OWN, "Your own environment")
    (tmp_path / "my_env.py").write_text(blocks(text, "python")[0])
    train, _, plays = blocks(text, "bash")
    steps = "--total-timesteps 100000 --eval-episodes 10"
    assert "FindPad-v0" in run(train.strip(), tmp_path, steps, TRAINING)
    for line in plays.splitlines():
        assert "mean return" in run(line, tmp_path)
    assert (tmp_path / "pad.mp4").exists()


def test_the_trained_policy_in_python(tmp_path, monkeypatch, train):
    (code,) = blocks(SWEEPS, "python")
    train(f"--beta 0.5 {TRAINING}")
    monkeypatch.chdir(tmp_path)
    exec(code, {})


def test_every_flag_is_explained():
    """In the table of docs/sweeps.md, or in that of docs/environments.md."""
    explained = set(re.findall(r"--([a-z-]+)", section(SWEEPS, "Flags").replace("[no-]", "")))
    explained |= {flag.removeprefix("no-") for flag in explained}
    for name in vars(ppo.parse_args([])):
        if name not in ("method", "beta_auto"):
            assert name.replace("_", "-") in explained, name


# --- The lesson: its snippets print what it says, and its edits apply and do what it says


def printed(code):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(code, {})
    return out.getvalue()


def table(text):
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return rows[2:]


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


def test_the_first_rollout():
    """With one of the twenty seeds; then without the waves of a swing."""
    code, power, waves = blocks(section(LESSON, "3. The first rollout"), "python")
    code = code.replace("range(1, 21)", "range(1, 2)")
    waves = waves.replace("[:16] = waves[34:]", "[16:34]")
    filtered = re.sub(r".* noise = .*\n", lambda line: line[0] + waves, code)
    for each, goals in (code, "0111"), (filtered, "0001"):
        assert "".join(re.findall(r"goal in (\d)", printed(each))) == goals
    assert re.findall(r" (.+)", printed(power)) == ["1.0", "3.1", "5.3", "1.6"]


def test_short_episodes():
    """The std of the mean of 200 steps of pink noise, for T = 1000 and 200."""
    lags = torch.arange(200)
    weights = (200 - lags) * torch.where(lags > 0, 2, 1) / 200**2
    for T, said in ((1000, 0.51), (200, 0.31)):
        std = (weights * autocovariance(1, T)[:200]).sum().sqrt().item()
        assert round(std, 2) == said and f"{said}" in LESSON


def edit(*numbers):
    """Pairs of (old lines, new lines), from the lesson's diffs of these numbers."""
    for number in numbers:
        lines = blocks(LESSON, "diff")[number].splitlines()
        yield tuple("\n".join(x[1:] for x in lines if x[0] in f" {sign}") for sign in "-+")


def test_ornstein_uhlenbeck_noise(run_edited):
    agent, _, module = run_edited(*edit(0))
    args = module.parse_args(["--n-steps", "20000", "--n-envs", "2", "--total-timesteps", "100000"])
    agent.actor_mean[-1].weight.data.zero_()
    agent.actor_mean[-1].bias.data.zero_()
    agent.log_std.data.zero_()
    torch.manual_seed(0)
    noise, obs = module.ColoredNoiseProcess(1, 2, 1), np.zeros((2, 3), np.float32)
    act = module.exploration(agent, noise, args)
    eps = np.array([act(obs, t) for t in range(20_000)])
    assert eps.var() == pytest.approx(1, abs=0.06)
    for lag in (1, 5, 10):
        assert (eps[lag:] * eps[:-lag]).mean() == pytest.approx(0.9**lag, abs=0.07)


def test_restart_of_the_noise(run_edited):
    """At the end of an episode, and only from the next step on."""
    seen = []
    flags = "--no-compile --max-episode-steps 100 --total-timesteps 512 --eval-freq 512"
    *_, module = run_edited(*edit(2, 3), flags=flags)

    def spy(*arguments):
        act = module.exploration(*arguments)
        seen.append((act.eps, act.eps.copy()))
        return act

    run_edited(*edit(2, 3), flags=flags, exploration=spy)
    changed = np.not_equal(*seen[0]).all(axis=(1, 2))
    assert not changed[:100].any() and changed[100:].all()  # Pendulum's episodes end together


def test_more_noise_learning_rate_and_relu(run_edited, capsys):
    *_, module = run_edited(*edit(1))
    assert module.Agent(3, 1).std().item() == pytest.approx(np.e)
    run_edited(*edit(4))
    rates = [float(x) for x in re.findall(r"learning rate (\S+)", capsys.readouterr().out)]
    assert rates == pytest.approx([1e-2 * (1 - i / 4) for i in range(4)])
    agent, *_ = run_edited(*edit(5))
    assert [type(layer) for layer in agent.modules()].count(torch.nn.ReLU) == 4
