import os
import runpy
import subprocess
import sys
import time
import traceback
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # before any test file imports a package that asks
ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

import pytest  # noqa: E402

SCRIPT = ROOT / "ppo_colored_continuous.py"
TINY = "--total-timesteps 4096 --n-envs 2 --n-steps 256 --eval-freq 512 --eval-episodes 2 "
TINY += "--n-epochs 1 --no-compile"


def run_forked(script, argv, folder, timeout):
    """Runs a script as `python script argv` does, in a fork of this process: nothing is imported
    anew, which is most of the time of a short run. Returns the completed process."""
    import ppo_colored_continuous  # noqa: F401  so that the fork finds all imported

    out, err = folder / f"stdout_{time.time_ns()}", folder / f"stderr_{time.time_ns()}"
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            for fd, path in ((1, out), (2, err)):
                os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND), fd)
            sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
            sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
            sys.argv = [str(script), *argv]
            runpy.run_path(str(script), run_name="__main__")
            code = 0
        except SystemExit as error:
            code = error.code or 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    end = time.monotonic() + timeout
    while (ended := os.waitpid(pid, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.kill(pid, 9)
        time.sleep(0.005)
    texts = [path.read_text() for path in (out, err)]
    out.unlink()
    err.unlink()
    return subprocess.CompletedProcess(argv, os.waitstatus_to_exitcode(ended[1]), *texts)


@pytest.fixture
def train(tmp_path):
    """train("--beta 0", ...) runs the script to its end in tmp_path / "runs".

    Returns the completed process. With environment variables, `env`, it is a fresh Python.
    """

    def run(flags="", env=None, timeout=120):
        argv = ["--runs-dir", str(tmp_path / "runs"), *flags.split()]
        if env is None:
            return run_forked(SCRIPT, argv, tmp_path, timeout)
        variables = {k: v for k, v in {**os.environ, **env}.items() if v is not None}
        command = [sys.executable, str(SCRIPT), *argv]
        return subprocess.run(
            command, capture_output=True, text=True, env=variables, timeout=timeout
        )

    return run


@pytest.fixture
def tiny():
    """Flags of a run of 8 updates and 8 evaluations that takes a second."""
    return TINY


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With -n 2: the worker that is done first takes over tests of the other."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)
