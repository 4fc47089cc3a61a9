import os
import subprocess
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
if not os.environ.get("DISPLAY"):
    os.environ.setdefault(
        "MUJOCO_GL", "egl"
    )  # before any test file imports a package that chooses a renderer
ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

import pytest  # noqa: E402

SCRIPT = ROOT / "ppo_colored_continuous.py"
TINY = "--total-timesteps 4096 --n-envs 2 --n-steps 256 --eval-freq 512 --eval-episodes 2 --n-epochs 1 --no-compile"


@pytest.fixture
def train(tmp_path):
    """train("--beta 0", ...) runs the script to its end in tmp_path / "runs"; returns the completed process."""

    def run(flags="", env=None, timeout=120):
        command = [
            sys.executable,
            str(SCRIPT),
            "--runs-dir",
            str(tmp_path / "runs"),
            *flags.split(),
        ]
        variables = {k: v for k, v in {**os.environ, **(env or {})}.items() if v is not None}
        return subprocess.run(
            command, capture_output=True, text=True, env=variables, timeout=timeout
        )

    return run


@pytest.fixture
def tiny():
    """Flags of a run of 8 updates and 8 evaluations that takes a few seconds."""
    return TINY
