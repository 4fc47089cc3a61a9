"""Helpers of all tests: the script in this process, and what a run leaves behind."""

import csv
import importlib.util
import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # before any test file imports a package that asks
ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

import pytest  # noqa: E402

SCRIPT = ROOT / "ppo_colored_continuous.py"
SHORT = "--env-id Pendulum-v1 --n-envs 2 --n-steps 256 --eval-episodes 2 --n-epochs 1 "
TINY = f"{SHORT} --total-timesteps 4096 --eval-freq 512 --no-compile"
EDITED = f"{SHORT} --total-timesteps 2048 --eval-freq 1024 --learning-rate 1e-2"


@pytest.fixture
def tiny():
    """Flags of a run of 8 updates and 8 evaluations that takes a second."""
    return TINY


@pytest.fixture
def train(tmp_path):
    """train("--beta 0", ...) runs the script in this process; returns the run's folder."""
    import ppo_colored_continuous as ppo

    def run(flags="", **methods):
        args = ppo.parse_args([*flags.split(), "--runs-dir", str(tmp_path / "runs")])
        ppo.main(args, **methods)
        return ppo.run_path(args)

    return run


@pytest.fixture
def read_evaluations():
    """read_evaluations(folder): the rows of evaluations.csv, dicts of numbers."""

    def read(folder):
        with open(folder / "evaluations.csv") as file:
            return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]

    return read


@pytest.fixture
def read_events():
    """read_events(folder): {tag: [(step, value), ...]}, as TensorBoard shows them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    def read(folder):
        events = EventAccumulator(str(folder)).Reload()
        tags = events.Tags()["scalars"]
        return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in tags}

    return read


@pytest.fixture
def run_edited(tmp_path, read_events):
    """run_edited((old, new), ..., flags=...): runs a copy of the script with these edits.

    Returns the final agent, TensorBoard's points, and the module.
    """

    def run(*edits, flags="--no-compile", again="--overwrite", **methods):
        text = SCRIPT.read_text()
        for old, new in edits:
            assert old in text, f"the script has no longer: {old}"
            text = text.replace(old, new)
        path = tmp_path / "edited.py"
        path.write_text(text)
        spec = importlib.util.spec_from_file_location("edited", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        args = module.parse_args(
            [*f"{EDITED} {flags} {again}".split(), "--runs-dir", str(tmp_path / "runs")]
        )
        agents = []

        def make_agent(*sizes):
            agents.append(module.Agent(*sizes))
            return agents[-1]

        module.main(args, make_agent=make_agent, **methods)
        events = read_events(module.run_path(args))
        scalars = {tag: [value for _, value in points] for tag, points in events.items()}
        return agents[-1], scalars, module

    return run


@pytest.fixture
def fill_buffer():
    """fill_buffer(sb3, batch) puts a batch of ours into SB3's rollout buffer, in the same order."""

    def fill(sb3, batch):
        buffer = sb3.rollout_buffer
        buffer.reset()
        obs, actions, logprobs, advantages, returns, _ = (x.numpy() for x in batch)
        buffer.observations, buffer.actions, buffer.log_probs = obs, actions, logprobs[:, None]
        buffer.advantages, buffer.returns = advantages[:, None], returns[:, None]
        buffer.values = buffer.returns * 0
        buffer.full = buffer.generator_ready = True  # flattened already
        sb3._setup_learn(1)

    return fill


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With -n 2: the worker that is done first takes over tests of the other."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)
