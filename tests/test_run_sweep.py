"""run_sweep.sh: nothing is done twice and nothing is lost, whatever is killed; a real Slurm.

The sweeps run in a copy whose training script is a stand-in of a few lines, but for one of them.
The last test is skipped where no Slurm answers (tests/slurm.sh starts one), unless
REQUIRE_SLURM=1.
"""

import fcntl
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from study.status import is_locked

ROOT = Path(__file__).parent.parent
STAND_IN = """
import argparse, fcntl, os, signal, sys, time
from study.sweep import run_folder
parser = argparse.ArgumentParser()
for flag in ("runs-dir", "exp-name", "env-id", "beta", "n-envs", "seed"):
    parser.add_argument("--" + flag, default="gsde")
args = parser.parse_known_args()[0]
args.beta = "vanilla" if "--vanilla" in sys.argv else args.beta
folder = run_folder(**vars(args))
folder.mkdir(parents=True, exist_ok=True)
lock = open(folder / "lock", "w")
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
except BlockingIOError:
    sys.exit(3)
exec(os.environ["RUN"])
(folder / "summary.json").write_text('{"wall_seconds": 9}')
print("done")
"""
# Stands still until the test says so, but when it is started a second time
FIRST_TIME_WAIT = """
if (folder / "log.txt").read_text().count("== ") == 1:
    while not os.path.exists(folder / "go"):
        time.sleep(0.02)
"""


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def starts(folder):
    log = folder / "log.txt"
    return len(re.findall("^== ", log.read_text(), re.M)) if log.exists() else 0


def is_running(folder):
    return is_locked(folder / "lock")


def is_complete(folder):
    return (folder / "summary.json").exists()


class Sweep:
    """A sweep of stand-ins in a copy: quick, narrowed; run is what a run does before it ends."""

    def __init__(self, folder):
        self.folder, self.copy, self.runs = folder, folder / "the copy", folder / "my runs"
        (self.copy / "study").mkdir(parents=True)
        shutil.copy(ROOT / "run_sweep.sh", self.copy)
        for name in ("__init__", "protocol", "status", "sweep"):
            shutil.copy(ROOT / "study" / f"{name}.py", self.copy / "study")
        for name in ("ppo_colored_continuous.py", "study/methods.py"):
            (self.copy / name).write_text(STAND_IN)
        self.env = {**os.environ, "PYTHON": sys.executable}
        self.processes = []

    def prepare(self, run, seeds="1", betas="0"):
        self.env["RUN"] = run
        self.args = ["quick", "--seeds", seeds, "--betas", betas, "--runs-dir", str(self.runs)]
        car = self.runs / "ppo_colored_continuous/MountainCarContinuous-v0"
        self.folders = [
            car / f"beta_{b}/n_envs_4/seed_{s}" for s in seeds.split() for b in betas.split()
        ]

    def start(self, *args):
        how = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        how |= {"cwd": self.folder, "env": self.env, "start_new_session": True}
        # A suite in the background ignores Ctrl-C, and so would what it starts
        how["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
        process = subprocess.Popen([self.copy / "run_sweep.sh", *(args or self.args)], **how)
        self.processes.append(process)
        return process

    def run(self, *args):
        """Runs the sweep, or one of other arguments. Returns its exit code and output."""
        process = self.start(*args)
        output = process.communicate(timeout=60)[0]
        return process.returncode, output

    def status(self):
        return self.run(*self.args, "--status")[1].splitlines()[0]

    def clear(self):
        """Ends all that is left of a failed test."""
        for process in self.processes:
            process.kill()
        for folder in self.runs.glob("*/*/*/*/*"):
            (folder / "go").touch()


@pytest.fixture
def sweep(tmp_path):
    sweep = Sweep(tmp_path)
    yield sweep
    sweep.clear()


def test_the_real_script(tmp_path):
    args = [ROOT / "run_sweep.sh", "quick", "--betas", "0.5", "--seeds", "1", "--"]
    flags = "--total-timesteps 512 --n-steps 64 --n-epochs 1 --eval-freq 512 --eval-episodes 1 "
    flags += "--no-compile --no-envpool"
    env = {**os.environ, "PYTHON": sys.executable}
    done = subprocess.run([*args, *flags.split()], cwd=tmp_path, env=env)
    assert done.returncode == 0
    assert len(list(tmp_path.glob("runs/*/MountainCarContinuous-v0/*/*/*/summary.json"))) == 1


@pytest.mark.parametrize("preset", ["n_steps", "vanilla", "gsde"])
def test_printed_commands_run(sweep, preset):
    """From another folder than the scripts', which has another study; a sweep finds them done."""
    sweep.prepare("")
    (sweep.folder / "study").mkdir()
    (sweep.folder / "study/__init__.py").write_text("raise ImportError('another study')")
    sweep.env["PYTHONPATH"] = "/of the user"
    args = [preset, "--envs", "door", "--n-envs", "2", "--seeds", "1", "--runs-dir", "it's here"]
    code, output = sweep.run(*args, "--print", "--", "--note", "a  b")
    for command in output.splitlines():
        how = {"cwd": sweep.folder, "env": sweep.env}
        assert subprocess.run(["sh", "-c", command], **how).returncode == 0
    code, output = sweep.run(*args)
    assert code == 0, output
    assert not list(sweep.folder.rglob("log.txt"))


def test_failed_run_does_not_stop_the_others(sweep):
    error = r"print('  5%|\r 6%|\nTraceback (most recent call last):\nValueError: diverged\n')"
    sweep.prepare(f"if 'seed_1' in str(folder): {error}; sys.exit(1)", seeds="1 2")
    bad, good = sweep.folders
    for _ in range(2):  # the second sweep lists the failure again, and does not try again
        code, output = sweep.run()
        assert code == 1 and is_complete(good)
        assert f"failed: {bad}: exit code 1: ValueError: diverged" in output.splitlines()
        assert starts(bad) == 1
    assert sweep.status() == "quick: 1 of 2 done, 0 running, 1 failed, 0 to do"
    sweep.env["RUN"] = ""
    assert sweep.run(*sweep.args, "--retry-failed")[0] == 0
    assert [starts(bad), starts(good)] == [2, 1]


def test_interpreter_is_tried_before_anything_starts(sweep):
    sweep.prepare("")
    (sweep.copy / "ppo_colored_continuous.py").write_text("import no_torch")
    code, output = sweep.run()
    assert code == 1 and "No module named 'no_torch'" in output
    assert not sweep.runs.exists()


@pytest.mark.parametrize("by, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_sweep_ends_its_runs_and_tells_how_to_go_on(sweep, by, code):
    sweep.prepare(FIRST_TIME_WAIT, betas="0 0.5")
    process = sweep.start(*sweep.args, "-j", "2")
    wait_for(lambda: all(is_running(folder) for folder in sweep.folders))
    assert sweep.status() == "quick: 0 of 2 done, 2 running, 0 failed, 0 to do"
    os.killpg(process.pid, by)  # as a terminal does
    output = process.communicate(timeout=10)[0]
    assert process.returncode == code
    wait_for(lambda: not any(is_running(folder) for folder in sweep.folders), seconds=5)
    assert sweep.status() == "quick: 0 of 2 done, 0 running, 0 failed, 2 to do"
    go_on = output.splitlines()[-1].removeprefix("stopped; to go on: ")
    assert shlex.split(go_on)[2:] == [*sweep.args, "-j", "2"]
    how = {"cwd": sweep.folder, "env": sweep.env, "timeout": 60}
    assert subprocess.run(["bash", "-c", go_on], **how).returncode == 0
    assert [starts(folder) for folder in sweep.folders] == [2, 2]


def test_killed_run_is_taken_up_by_the_same_sweep(sweep):
    sweep.prepare(FIRST_TIME_WAIT)
    process = sweep.start()
    wait_for(lambda: is_running(sweep.folders[0]))
    pid = process.pid
    for _ in range(2):  # the sweep's child is a shell, and the shell's the run
        pid = int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])
    os.kill(pid, signal.SIGKILL)
    assert process.wait(60) == 0
    assert starts(sweep.folders[0]) == 2


def test_killed_sweep(sweep):
    """Its runs live on, and those that are not started are not. Another sweep waits for them."""
    sweep.prepare(FIRST_TIME_WAIT, seeds="1 2 3")
    process = sweep.start(*sweep.args, "-j", "2")
    wait_for(lambda: all(is_running(folder) for folder in sweep.folders[:2]))
    process.kill()
    (sweep.folders[0] / "go").touch()
    wait_for(lambda: is_complete(sweep.folders[0]))
    (sweep.folders[2] / "go").mkdir(parents=True)
    other = sweep.start()
    lines = iter(other.stdout)
    assert f"waiting for {sweep.folders[1]}\n" in lines
    (sweep.folders[1] / "go").touch()
    assert other.wait(60) == 0
    assert [starts(folder) for folder in sweep.folders] == [1, 1, 1]


def test_two_sweeps_share_the_work_and_a_third_has_nothing_to_do(sweep):
    sweep.prepare("time.sleep(0.1)", seeds=" ".join(map(str, range(12))))
    processes = [sweep.start(*sweep.args, "-j", "2") for _ in range(2)]
    outputs = [process.communicate(timeout=60)[0] for process in processes]
    assert all("\ncomplete (" in output for output in outputs)  # each did a share
    outputs.append(sweep.run()[1])
    assert all(out.endswith("quick: 12 of 12 runs are complete, 0 failed\n") for out in outputs)
    assert [process.returncode for process in sweep.processes] == [0, 0, 0]
    assert [starts(folder) for folder in sweep.folders] == [1] * 12
    assert sweep.status() == "quick: 12 of 12 done, 0 running, 0 failed, 0 to do"


def test_run_that_was_started_by_hand_is_left_alone(sweep):
    sweep.prepare("", seeds="1 2")
    sweep.folders[0].mkdir(parents=True)
    with open(sweep.folders[0] / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        code, output = sweep.run()
    assert code == 1 and output.endswith("quick: 1 of 2 runs are complete, 0 failed\n"), output
    assert sweep.run()[0] == 0


# --- Slurm


def test_slurm_tasks_share_what_is_left(sweep):
    """Without Slurm: what sbatch is given, run as Slurm would."""
    sweep.prepare("time.sleep(0.1)", seeds="1 2 3 4 5 6")
    tools, batch, options = (sweep.folder / name for name in ("tools", "batch", "options"))
    tools.mkdir()
    (tools / "sbatch").write_text(f"#!/bin/sh\ncat >{batch}; echo $* >{options}; echo 7\n")
    (tools / "sbatch").chmod(0o755)
    sweep.env["PATH"] = f"{tools}:{os.environ['PATH']}"
    done, failed, *left = sweep.folders
    for folder, file in (done, "summary.json"), (failed, "failed"):
        folder.mkdir(parents=True)
        (folder / file).touch()
    args = [*sweep.args, "--slurm", "2", "--sbatch=--time=1:00 --mem=2G", "--", "--note", "it's"]
    code, output = sweep.run(*args)
    assert code == 0 and output.startswith("4 runs in 2 tasks, submitted as job 7;"), output
    assert "--array=1-2 " in options.read_text() and "--time=1:00 --mem=2G" in options.read_text()
    how = {"cwd": sweep.folder, "stdout": subprocess.PIPE, "text": True}
    tasks = [
        subprocess.Popen(["bash", batch], env={**sweep.env, "SLURM_ARRAY_TASK_ID": task}, **how)
        for task in "12"
    ]
    outputs = [task.communicate(timeout=60)[0] for task in tasks]
    assert [task.returncode for task in tasks] == [0, 0]
    assert all("\ncomplete (" in output for output in outputs)  # each did a share
    assert [starts(folder) for folder in sweep.folders] == [0, 0, 1, 1, 1, 1]
    assert "nothing to do" in sweep.run(*args)[1]


def test_slurm_requeues_one_task_of_an_array(sweep):
    """After the death of its node, or at its time limit; the other goes on."""
    if not shutil.which("sinfo") or subprocess.run(["sinfo"], capture_output=True).returncode:
        assert os.environ.get("REQUIRE_SLURM") != "1", "REQUIRE_SLURM=1, but no Slurm answers"
        pytest.skip("no Slurm answers (tests/slurm.sh starts one)")
    sweep.prepare(FIRST_TIME_WAIT, seeds="1 2")
    code, output = sweep.run(*sweep.args, "--slurm", "2")
    assert code == 0, output
    job = re.search("as job ([0-9]+);", output)[1]
    try:
        wait_for(lambda: all(is_running(folder) for folder in sweep.folders))
        subprocess.run(["scontrol", "requeue", f"{job}_1"], check=True)
        wait_for(lambda: any(is_complete(folder) for folder in sweep.folders))
        assert any(is_running(folder) for folder in sweep.folders)
        # What Slurm sends to the batch shell a minute before the time limit; here to the last task
        # of the array, which has the array's own job id
        subprocess.run(["scancel", "--batch", "--signal=USR1", f"{job}_2"], check=True)
        wait_for(lambda: all(is_complete(folder) for folder in sweep.folders))
    finally:
        subprocess.run(["scancel", job], check=True)
    assert [starts(folder) for folder in sweep.folders] == [2, 2]
    assert "nothing to do" in sweep.run(*sweep.args, "--slurm", "2")[1]
