"""README and docs: what they say can be run, is run here, shortened; what they link to is there."""

import os
import re
import shlex
import subprocess
import sys
import types

import numpy as np
import pytest
import torch
from conftest import ROOT
from scipy import stats
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution

import claims
import ppo_colored_continuous as ppo
from analysis import final_return_per_beta, final_returns, load, mean_interval, select_methods
from colored_noise import PUBLISHED_BEST_BETA, autocovariance, projected_beta

README = (ROOT / "README.md").read_text()
OWN = (ROOT / "docs" / "environments.md").read_text()
SWEEPS = (ROOT / "docs" / "sweeps.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "results" / "README.md", *(ROOT / "docs").glob("*.md")]
TRAINING = "--total-timesteps 2048 --eval-freq 1024 --eval-episodes 2 --n-steps 256 --no-compile"


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def section(text, heading):
    """The text under a heading of the second level."""
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def run(command, folder, **shorter):
    """Runs a command of a page in another folder than the repository's; shorter: old=new words."""
    for old, new in shorter.items():
        assert old in command
        command = command.replace(old, new)
    command = re.sub(r"(^|&& )python (\w+\.py)", rf"\1{sys.executable} {ROOT}/\2", command)
    command = re.sub(r"^\./run_sweep.sh", f"{ROOT}/run_sweep.sh", command)
    env = {**os.environ, "PYTHON": sys.executable}
    process = subprocess.run(
        ["bash", "-c", command], cwd=folder, env=env, capture_output=True, text=True
    )
    assert process.returncode == 0, (command, process.stdout, process.stderr)
    return process.stdout


def test_the_readme_is_short():
    assert len(README.split()) <= 1300


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


def test_commands_can_be_read():
    """Every command for the script has flags that there are; what is to be run long is not run."""
    found = 0
    for page in PAGES:
        for block in blocks(page.read_text(), "bash"):
            for line in block.replace("\\\n", "").splitlines():
                *_, flags = line.partition("python ppo_colored_continuous.py")
                if flags:
                    ppo.parse_args(shlex.split(flags, comments=True))
                    found += 1
    assert found >= 2


# --- The README, from top to bottom


def test_first_command(tmp_path):
    command = blocks(section(README, "Two commands"), "bash")[0].strip()
    install, train = command.split(" && ")
    assert install == "pip install -r requirements.txt"  # .ci/run does it
    assert "final return" in run(f"{train} {TRAINING}", tmp_path)
    assert (tmp_path / "runs/ppo_colored_continuous/MountainCarContinuous-v0/beta_0.5").is_dir()


def test_the_lines_that_are_the_paper_are_in_the_script():
    (code,) = blocks(section(README, "The lines that are the paper"), "python")
    text = (ROOT / "ppo_colored_continuous.py").read_text()
    assert "".join(f"    {line}\n" for line in code.splitlines()) in text


class CleanRLAgent(torch.nn.Module):
    """With the names of CleanRL's ppo_continuous_action.py, as far as the snippet meets them."""

    def __init__(self, line, names):
        super().__init__()
        self.actor_mean = torch.nn.Linear(3, 2)
        self.actor_logstd = torch.nn.Parameter(torch.full((1, 2), -1.0))
        self.line, self.names = line, names

    def get_action(self, x):
        action_mean = self.actor_mean(x)
        names = {"action_mean": action_mean, "action_std": self.actor_logstd.exp()}
        exec(self.line, self.names, names)
        return action_mean, names["action"]


def test_cleanrl():
    """The three lines, in what they find there: the noise in the actions is pink-ish and scaled."""
    own_ppo = section(README, "Put it into your own PPO")
    imports, make, draw = blocks(own_ppo, "python")[0].replace("\n\n", "\n").splitlines()

    args = types.SimpleNamespace(seed=1)
    names = {"args": args, "actions": torch.zeros(2048, 4, 2), "device": torch.device("cpu")}
    exec(f"{imports}\n{make}", names)
    agent = CleanRLAgent(draw, names).requires_grad_(False)
    steps = [agent.get_action(torch.randn(4, 3)) for _ in range(1000)]
    eps = torch.stack([action - mean for mean, action in steps]) / np.exp(-1)
    assert eps.shape == (1000, 4, 2)
    assert (eps[1:] * eps[:-1]).mean().item() == pytest.approx(
        autocovariance(0.5, 1000)[1].item(), abs=0.05
    )
    assert eps.var().item() == pytest.approx(1, abs=0.05)


def test_stable_baselines3(tmp_path, monkeypatch):
    """It learns from colored noise; what the text says on PPO.load and predict is so."""
    own_ppo = section(README, "Put it into your own PPO")
    code = blocks(own_ppo, "python")[1].replace("learn(100_000)", "learn(2048)")
    assert "learn(2048)" in code
    torch.manual_seed(0)
    names = {}
    exec(code, names)
    model = names["model"]
    actions = torch.as_tensor(model.rollout_buffer.actions).reshape(-1, 1)
    observations = torch.as_tensor(model.rollout_buffer.observations).reshape(-1, 2)
    assert len(actions) == 2048
    fresh = PPO("MlpPolicy", "MountainCarContinuous-v0", seed=0)
    eps = actions.flatten()  # the first mean actions are about 0, the std is 1
    mean = fresh.policy.get_distribution(observations).mode().abs().max().item()
    assert mean < 0.1
    lag_1 = (eps[1:] * eps[:-1]).mean().item()
    assert lag_1 == pytest.approx(autocovariance(0.5, 1000)[1].item(), abs=0.1)
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model")
    assert type(loaded.policy.action_dist) is DiagGaussianDistribution
    observation = np.zeros(2, np.float32)
    predicted = [model.predict(observation)[0] for _ in range(20)]  # n_envs is 1 here
    assert predicted[0].shape == (1,) and len(np.unique(predicted)) > 2  # some are clipped
    model.policy.action_dist = names["ColoredNoiseDistribution"](0.5, 4, action_dim=1)
    assert model.predict(observation, deterministic=True)[0].shape == (1,)
    with pytest.raises(ValueError, match="squeeze|reshape"):
        model.predict(observation)


def test_noise_on_a_gpu():
    own_ppo = section(README, "Put it into your own PPO")
    code = blocks(own_ppo, "python")[2]
    if not torch.cuda.is_available():
        code = code.replace('"cuda"', '"cpu"')
    names = {}
    exec(f"from colored_noise import ColoredNoiseProcess\n{code}", names)
    assert names["eps"].shape == (4096, 12)
    n_bytes = names["noise"].buffer.numel() * 4
    assert n_bytes == 4096 * 12 * 1000 * 4 and f"here {n_bytes / 1e6:.0f} MB" in own_ppo


def test_which_beta():
    text = section(README, "Which beta?")
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    n_envs, auto, published = ([float(x) for x in rows[i][1:]] for i in (0, 2, 3))
    assert auto == [round(projected_beta(int(n)), 2) for n in n_envs]
    assert dict(zip(n_envs, published, strict=True)) == PUBLISHED_BEST_BETA
    lags = torch.arange(200)
    for beta, T, said in ((1, 1000, 0.51), (1, 200, 0.31), (0, 1000, 0.07)):
        weights = (200 - lags) * torch.where(lags > 0, 2, 1) / 200**2  # of the mean of 200 steps
        std = (weights * autocovariance(beta, T)[:200]).sum().sqrt().item()
        assert round(std, 2) == said and f"{said}" in text


def say(*names):
    """Runs of files in results, by method, and what they say of the paper's claims."""
    loaded, curves = load([ROOT / "results" / name for name in names])
    methods, _ = select_methods(loaded)
    return methods, claims.coverage(methods, curves)


@pytest.fixture(scope="module")
def measured():
    """Our runs of the study's grid."""
    return say("reproduction.csv", "study.csv")


def test_the_claims_so_far_are_those_of_the_data(measured):
    """Every verdict that our runs have something to say on, and no other, in the table's order."""
    methods, coverage = measured
    text = (ROOT / "results" / "README.md").read_text()
    table = text.split("| so far | our runs |\n| --- | --- | --- | --- |\n")[1].split("\n\n")[0]
    about = coverage[coverage.verdict.ne("") & coverage.runs.ne("none needed")]
    about = about[about.data.str.contains(r"\d") & ~about.data.str.startswith("needs")]
    columns = ["where", "says", "verdict", "data"]
    assert table.splitlines() == [f"| {' | '.join(row)} |" for row in about[columns].to_numpy()]
    whole, tasks = claims.offset(methods["ppo"])
    assert whole.split(", where")[0] in text
    assert all(low in text for low in tasks.split(", ")[:2])


def test_the_slices_are_those_of_the_data():
    text = section((ROOT / "results" / "README.md").read_text(), "Slices of the appendix")
    methods, coverage = say("reproduction.csv", "study.csv", "slices.csv")
    about = coverage[coverage["where"].isin(["Fig. A6", "Fig. A8", "Fig. A11", "Fig. A12"])]
    assert len(about) == 5 and (about.verdict == "open").all()
    for row in about[["where", "says", "data"]].to_numpy():
        assert f"| {' | '.join(row)} |" in text
    runs = methods["ppo"]
    usual = (runs.n_envs == 4) & (runs.n_steps == 2048) & (runs.n_epochs == 10)
    half = runs.beta == 0.5
    columns = [usual & runs.vanilla, usual & (runs.beta == 0), usual & half]
    columns += [half & (runs.n_steps == n) for n in (4096, 1024)]
    columns += [half & (runs.n_epochs == n) for n in (5, 20)]
    for name in ("Mountain Car", "Pendulum Swingup", "Cartpole Balance", "Reacher Hard"):
        here = [runs[column & (runs.environment == name)].performance.mean() for column in columns]
        assert f"| {' | '.join([name, *(f'{x:z.1f}' for x in here)])} |" in text


@pytest.mark.parametrize(
    ("file", "varies"), [("noise_length.csv", "noise_seq_len"), ("new_seeds.csv", "batch_size")]
)
def test_new_seeds_are_those_of_the_data(file, varies):
    text = section((ROOT / "results" / "README.md").read_text(), "Where the numbers differ")
    runs, _ = load([ROOT / "results" / file])
    runs = runs[runs.status == "complete"]
    cell = ["env_id", "beta", "n_envs", varies, "bootstrap_timeouts", runs.seed // 100]
    groups = [x for _, x in runs.groupby(cell) if len(x) >= 10]
    assert len(groups) >= 4
    for group in groups:
        mean, low, high = mean_interval(group.final_return)
        assert f" {mean:z.1f} [{low:z.1f}, {high:z.1f}] |" in text
    usual = (runs.beta == "0") & (runs.batch_size == 128) & ~runs.bootstrap_timeouts.astype(bool)
    thirty = [x.final_return for _, x in runs[usual].groupby(["env_id", "n_envs"]) if len(x) == 30]
    assert len(thirty) == (2 if varies == "batch_size" else 0)
    for values in thirty:  # white noise in pendulum
        mean, low, high = mean_interval(values)
        assert f"at {mean:.0f} [{low:.0f}, {high:.0f}] (published" in text


def test_the_comparisons_of_new_seeds_are_those_of_the_data():
    text = section((ROOT / "results" / "README.md").read_text(), "Where the numbers differ")
    runs, _ = load([ROOT / "results" / "new_seeds.csv"])
    runs = runs[(runs.env_id == "dm_control/pendulum-swingup-v0") & (runs.status == "complete")]
    runs = runs.assign(default=runs.bootstrap_timeouts.astype(bool))

    def p(a, b, column="final_return"):
        return f"p = {stats.mannwhitneyu(a[column], b[column]).pvalue:.2f}"

    small, default, usual = {}, {}, {}
    for n_envs, group in runs.groupby("n_envs"):
        small[n_envs] = group[group.batch_size == 64]
        default[n_envs] = group[group.default]
        usual[n_envs] = group[(group.batch_size == 128) & ~group.default]
    means = [f"{x[1].performance.mean():.0f}" for x in (small, usual)]
    sooner = p(small[1], usual[1], "performance")
    assert f"(performance {means[0]}, these {means[1]}; Mann-Whitney, {sooner})" in text
    assert f"end where these do ({p(small[1], usual[1])})" in text
    assert f"does worse ({p(default[1], usual[1])})" in text
    same_seeds = usual[4][usual[4].seed.isin(small[4].seed)]
    assert f"n_envs 4: Mann-Whitney, {p(small[4], same_seeds)})" in text


def test_the_table_of_agreement_is_the_data(measured):
    text = section(README, "What agrees with the paper, and what does not")
    methods, coverage = measured
    table = final_return_per_beta(final_returns(methods["ppo"])).astype(str)
    cells = table.set_index(["environment", "n_envs"])
    for place, beta, numbers in (
        (("Pendulum Swingup", "4"), "beta 1", "103 [39, 126]"),
        (("Cartpole Swingup", "4"), "beta 1", "301 [95, 592]"),
        (("Reacher Hard", "4"), "beta 0", "535 [353, 603]"),
    ):
        measured = re.findall(r"[\d.]+", cells.loc[place, beta])
        said = re.findall(r"\d+", numbers)
        assert numbers in text and [f"{float(x):.0f}" for x in measured] == said
    pendulum = methods["ppo"].query("environment == 'Pendulum Swingup'")
    performance = pendulum.groupby(["beta", "n_envs"]).performance.mean().unstack()
    best = ", ".join(f"{beta:g}" for beta in performance.idxmax()[[1, 4, 32]])
    assert f"| Pendulum, β of best performance, n_envs 1, 4, 32 | {best} | 0, 0.5, 1 |" in text
    verdicts = coverage.set_index("says").data
    outside, of = re.match(r"(\d+) of (\d+)", verdicts["final returns"]).groups()
    expected = re.search(r"([\d.]+) expected", verdicts["final returns"])[1]
    assert f"| {of} cells: published mean outside our interval | {outside} |" in text
    assert f"{expected} expected" in text
    lead = re.search(
        r"over 0 (\S+ \[\S+, \S+\]) \((\d+)", verdicts["beta 0.5 outperforms white noise"]
    )
    standard_deviations = lead[1].replace(" ", " standard deviations ", 1)
    assert f"ahead of white, {lead[2]} environments | {standard_deviations} |" in text


def test_sweep_in_three_commands(tmp_path):
    sweep, status, plot = blocks(section(README, "Sweep"), "bash")[0].splitlines()
    shorter = {'"0 0.5 1"': '"0 0.5"', '"1 2 3 4 5"': '"1"', " cheetah-run": ""}
    said = run(f"{sweep} -- {TRAINING}", tmp_path, **shorter)
    assert "main: 2 of 2 runs are complete, 0 failed" in said
    assert "main: 2 of 2 done" in run(status, tmp_path, **shorter)
    run(plot, tmp_path)
    assert (tmp_path / "figures" / "learning_curves_n_envs_4.png").stat().st_size > 10_000


# --- docs


def test_an_environment_of_ones_own(tmp_path):
    """The page's environment and its commands, in the order of the page."""
    text = section(OWN, "Your own environment")
    (code,) = blocks(text, "python")
    assert len([line for line in code.splitlines() if line.strip()]) == 25
    (tmp_path / "my_env.py").write_text(code)
    train, sweep_and_plot, plays = blocks(text, "bash")
    sweep, plot = sweep_and_plot.splitlines()
    steps = {"--total-timesteps 100000 --eval-episodes 10": TRAINING}
    assert "FindPad-v0" in run(train.strip(), tmp_path, **steps)
    shorter = {'"0 0.5 1"': '"0 0.5"', '"1 2 3 4 5"': '"1"', **steps}
    assert "2 of 2 runs are complete" in run(sweep, tmp_path, **shorter)
    run(plot, tmp_path)
    assert "my_env:FindPad-v0" in (tmp_path / "figures" / "final_return_per_beta.md").read_text()
    for line in plays.splitlines():
        assert "mean return" in run(line, tmp_path)
    assert (tmp_path / "pad.mp4").exists()


def test_the_trained_policy_in_python(tmp_path, monkeypatch, train):
    (code,) = blocks(SWEEPS, "python")
    assert train(f"--beta 0.5 {TRAINING}").returncode == 0
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(code, names)
    assert names["agent"].actor_mean(torch.zeros(1, 2)).shape == (1, 1)


def test_every_flag_is_explained():
    """In the table of docs/sweeps.md, or in that of docs/environments.md."""
    explained = set(re.findall(r"--([a-z-]+)", section(SWEEPS, "Flags").replace("[no-]", "")))
    explained |= {flag.removeprefix("no-") for flag in explained}
    for name in vars(ppo.parse_args([])):
        if name not in ("method", "beta_auto"):
            assert name.replace("_", "-") in explained, name
