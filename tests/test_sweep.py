"""run_sweep.sh: the lists of runs, real sweeps of tiny runs that are killed in all ways, and a real Slurm.

The Slurm tests are skipped where no Slurm answers (tests/slurm.sh starts one), unless REQUIRE_SLURM=1.
"""

import contextlib
import fcntl
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SWEEP = str(ROOT / "run_sweep.sh")
ENV = {**os.environ, "PYTHON": sys.executable}
STEPS, EVAL_FREQ = 8192, 512
TINY = f"--n-steps 64 --n-epochs 1 --eval-freq {EVAL_FREQ} --eval-episodes 1 --no-compile --total-timesteps".split()
MOUNTAIN_CAR = "ppo_colored_continuous/MountainCarContinuous-v0"


started = []


@pytest.fixture(autouse=True)
def nothing_stays_behind():
    yield
    while started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pop().pid, signal.SIGKILL)


def sweep(*args):
    return subprocess.run([SWEEP, *args], capture_output=True, text=True, env=ENV, timeout=300)


def printed(*args):
    result = sweep(args[0], "--print", *args[1:])
    assert result.returncode == 0 and result.stderr == ""
    return result.stdout.splitlines()


class Tiny:
    """A sweep of tiny runs in a folder: quick, narrowed to the seeds, n at a time."""

    def __init__(self, runs, seeds="1", betas="0", steps=STEPS):
        self.runs, self.steps = runs, steps
        self.args = ["quick", "--seeds", seeds, "--betas", betas, "--runs-dir", str(runs)]
        self.folders = [
            runs / MOUNTAIN_CAR / f"beta_{b}/n_envs_4/seed_{s}"
            for s in seeds.split()
            for b in betas.split()
        ]

    def run(self, *args):
        return sweep(*self.args, *args, "--", *TINY, str(self.steps))

    def start(self, *args):
        command = [SWEEP, *self.args, *args, "--", *TINY, str(self.steps)]
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command,
            stdout=pipe,
            stderr=subprocess.STDOUT,
            text=True,
            env=ENV,
            start_new_session=True,
        )
        started.append(process)
        return process

    def status(self):
        return sweep(*self.args, "--status").stdout.splitlines()[0]

    def assert_complete(self):
        expected = [str(step) for step in range(EVAL_FREQ, self.steps + 1, EVAL_FREQ)]
        for folder in self.folders:
            assert (folder / "summary.json").exists()
            assert [line.split(",")[0] for line in evaluations(folder)] == expected


def evaluations(folder):
    file = folder / "evaluations.csv"
    return file.read_text().splitlines()[1:] if file.exists() else []


def starts(folder):
    return len(re.findall("^== ", (folder / "log.txt").read_text(), re.M))


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def is_locked(folder):
    with open(folder / "lock", "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def children(pid):
    return [int(x) for x in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


# ---- What is run


@pytest.mark.parametrize(
    ("preset", "runs", "envs"),
    [
        ("quick", 4, 1),
        ("main", 20480, 16),
        ("vanilla", 2560, 16),
        ("n_steps", 960, 16),
        ("n_epochs", 2880, 16),
    ]
    + [("complex", 640, 4)],
)
def test_preset_counts(preset, runs, envs):
    lines = printed(preset)
    assert len(lines) == runs
    assert len(set(lines)) == runs
    words = [shlex.split(line) for line in lines]
    assert len({w[w.index("--env-id") + 1] for w in words}) == envs
    # No two runs share a folder
    flags = ["--env-id", "--beta", "--n-envs", "--seed", "--exp-name"]
    assert (
        len({tuple(w[w.index(f) + 1] if f in w else "vanilla" for f in flags) for w in words})
        == runs
    )
    assert all("--resume" in w for w in words)


def test_n_steps_keeps_the_update_size():
    words = [shlex.split(line) for line in printed("n_steps", "--envs", "door", "--seeds", "1")]
    flags = [dict(zip(w[2::2], w[3::2], strict=False)) for w in words]
    pairs = [(int(f["--n-envs"]), int(f.get("--n-steps", 2048))) for f in flags]
    assert pairs == [(2, 4096), (4, 2048), (8, 1024)]
    # The default is the main study's run and is not repeated
    assert [f["--exp-name"][22:] for f in flags] == ["_n_steps_4096", "", "_n_steps_1024"]


def test_narrowing_and_quoting():
    narrowed = "main --envs 'dm_control/cheetah-run-v0 PointUMaze' --betas '0 0.50 -1 0' --n-envs 4 --seeds '3 1'"
    named = """--runs-dir 'my runs/a' --exp-name x -- --note "it's $HOME; a b" --no-compile"""
    lines = printed(*shlex.split(f"{narrowed} {named}"))
    words = [shlex.split(line) for line in lines]
    assert [w[2:10:2] for w in words] == [["--env-id", "--beta", "--n-envs", "--seed"]] * 12
    expected = [
        (env, beta, "4", seed)
        for seed in ["3", "1"]
        for env in ["dm_control/cheetah-run-v0", "PointUMaze-v1"]
        for beta in ["0", "0.5", "-1"]
    ]
    assert [tuple(w[3:10:2]) for w in words] == expected
    tail = [
        "--exp-name",
        "x",
        "--runs-dir",
        "my runs/a",
        "--resume",
        "--note",
        "it's $HOME; a b",
        "--no-compile",
    ]
    assert all(w[10:] == tail for w in words)


@pytest.mark.parametrize(
    "args",
    [
        "",
        "mane",
        "main --foo",
        "main --envs PontUMaze-v1",
        "main --betas 0,5",
        "main --betas",
        "main --seeds -1",
    ]
    + [
        "main --n-envs 0",
        "main --n-envs 1.5",
        "main -j 0",
        "main -j",
        "vanilla --betas 0",
        "main --n-epochs 5",
    ]
    + [
        "main --print --slurm",
        "main --exp-name a/b",
        "main --runs-per-task x",
        "n_steps --n-envs 3",
        "main 4",
    ]
    + ["main -- --seed 3", "main -- --overwrite", "n_steps -- --n-steps=5"],
)
def test_wrong_usage_is_one_line(args):
    result = sweep(*args.split(), *([] if "--print" in args or "-- " in args else ["--print"]))
    assert result.returncode == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1


def test_status_counts_and_time_left(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2", betas="0 0.5")
    done, running, failed, _ = tiny.folders
    for folder in (done, running, failed):
        folder.mkdir(parents=True)
        (folder / "lock").touch()
    (failed / "failed").write_text("1\n")
    assert (
        tiny.status()
        == "quick: 0 of 4 done, 0 running, 1 failed, 3 to do, time left: known when the first run is done"
    )
    (done / "summary.json").write_text(json.dumps({"steps": 8, "wall_seconds": 5400.0}, indent=2))
    assert tiny.status().endswith(
        "1 failed, 2 to do, nothing is running, work left: 3.0 h of one core"
    )
    (running / "config.json").write_text(json.dumps({"args": {"total_timesteps": 1000, "seed": 1}}))
    (running / "evaluations.csv").write_text(
        "step,return_mean,return_std,length_mean\n100,1,0,9\n600,1,0,9\n"
    )
    with open(running / "lock", "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        head, _, row = sweep(*tiny.args, "--status").stdout.splitlines()
    # 0.4 runs are left of the running one, 1 of the other, at 1.5 h each
    assert (
        head == "quick: 1 of 4 done, 1 running, 1 failed, 1 to do, 2.1 h left at the present rate"
    )
    assert row.split() == ["MountainCarContinuous-v0", "1", "1", "1", "1", "1.5", "h", "2.1", "h"]


# ---- Real sweeps


def test_complete_then_nothing_to_do(tmp_path):
    tiny = Tiny(tmp_path / "runs", betas="0 0.5", steps=1024)
    result = tiny.run("-j", "2")
    assert result.returncode == 0, result.stdout + result.stderr
    tiny.assert_complete()
    assert tiny.status() == "quick: 2 of 2 done, 0 running, 0 failed, 0 to do"
    before = {path: path.stat().st_mtime_ns for path in tiny.runs.rglob("*") if path.is_file()}
    assert tiny.run("-j", "2").returncode == 0
    assert {
        path: path.stat().st_mtime_ns for path in tiny.runs.rglob("*") if path.is_file()
    } == before
    # A printed command is a whole command
    command = sweep(*tiny.args, "--print", "--", *TINY, "1024").stdout.splitlines()[0]
    result = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0 and "complete" in result.stdout


def test_failed_run_does_not_stop_the_others(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2", steps=1024)
    bad, good = tiny.folders
    bad.mkdir(parents=True)
    (bad / "config.json").write_text("{")
    for attempt in range(2):  # the second sweep lists the failure again, and does not try again
        result = tiny.run("-j", "1")
        assert result.returncode == 1
        assert (good / "summary.json").exists()
        line = next(
            line
            for line in result.stdout.splitlines()
            if line.startswith("failed with exit code 1: ")
        )
        assert str(bad) in line and "config.json is damaged" in line
        assert starts(bad) == 1, attempt
    assert tiny.status() == "quick: 1 of 2 done, 0 running, 1 failed, 0 to do"
    (bad / "config.json").unlink()
    assert tiny.run("-j", "1", "--retry-failed").returncode == 0
    tiny.assert_complete()


def test_kill_9_of_children_and_sweeps(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3")
    rng = random.Random(1)
    for _ in range(3):
        process = tiny.start("-j", "2")
        for _ in range(2):
            time.sleep(rng.uniform(1, 4))
            for pid in rng.sample(children(process.pid), 1) if process.poll() is None else []:
                os.kill(pid, signal.SIGKILL)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    result = tiny.run("-j", "2")  # some children of the last one still run
    assert result.returncode == 0, result.stdout
    tiny.assert_complete()
    assert sum(starts(folder) for folder in tiny.folders) > 3  # something was killed


def test_two_sweeps_share_the_work(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3", steps=1024)
    processes = [tiny.start("-j", "1"), tiny.start("-j", "1")]
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    tiny.assert_complete()
    assert [starts(folder) for folder in tiny.folders] == [1, 1, 1]
    assert all("\ncomplete (" in output for output in outputs)  # each did a share


@pytest.mark.parametrize(
    "to, number", [("all", signal.SIGINT), ("runs", signal.SIGINT), ("sweep", signal.SIGTERM)]
)
def test_stopped_sweep_saves_and_tells_how_to_go_on(tmp_path, to, number):
    tiny = Tiny(tmp_path / "runs", betas="0 0.5", steps=2_048_000)
    process = tiny.start("-j", "2")
    wait_for(lambda: all(evaluations(folder) for folder in tiny.folders))
    assert tiny.status().startswith("quick: 0 of 2 done, 2 running, 0 failed, 0 to do")
    if to == "all":
        os.killpg(process.pid, number)  # Ctrl-C goes to the children as well
    else:  # bash can miss the Ctrl-C that ends its children
        for pid in children(process.pid) if to == "runs" else [process.pid]:
            os.kill(pid, number)
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 128 + number
    (command,) = re.findall("^to go on: (.*)", output, re.M)
    assert shlex.split(command) == [SWEEP, *tiny.args, "-j", "2", "--", *TINY, "2048000"]
    for folder in tiny.folders:
        assert not is_locked(folder)
        assert (folder / "checkpoint.pt").exists() and not (folder / "failed").exists()


def test_killed_run_is_continued_by_the_same_sweep(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    process = tiny.start("-j", "1")
    wait_for(lambda: evaluations(tiny.folders[0]))
    os.kill(children(process.pid)[0], signal.SIGKILL)
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    assert starts(tiny.folders[0]) == 2
    tiny.assert_complete()


def test_waits_for_a_run_that_another_process_has(tmp_path):
    tiny = Tiny(tmp_path / "runs", steps=1024)
    tiny.folders[0].mkdir(parents=True)
    with open(tiny.folders[0] / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        process = tiny.start()
        assert [process.stdout.readline() for _ in range(3)][-1].startswith("waiting for 1 runs")
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    tiny.assert_complete()


def test_missing_folder(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    process = tiny.start("-j", "1")
    wait_for(lambda: evaluations(tiny.folders[0]))
    tiny.runs.rename(tmp_path / "elsewhere")
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 1
    assert f"stopped: the folder {tiny.runs} is gone" in output and "to go on: " in output
    (tmp_path / "elsewhere").rename(tiny.runs)
    assert tiny.status().startswith("quick: 0 of 1 done, 0 running, 0 failed, 1 to do")


def test_full_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)], capture_output=True
    ).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        tiny = Tiny(disk / "runs")
        process = tiny.start("-j", "1")
        wait_for(lambda: evaluations(tiny.folders[0]))
        with pytest.raises(OSError), open(disk / "ballast", "wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        output = process.communicate(timeout=60)[0]
        assert process.returncode == 1
        assert "stopped: " in output and "No space left on device" in output, output
        assert tiny.status().startswith("quick: 0 of 1 done, 0 running, 0 failed, 1 to do")
        (disk / "ballast").unlink()
        assert tiny.run("-j", "1").returncode == 0
        tiny.assert_complete()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


# ---- A real Slurm


@pytest.fixture
def slurm():
    command = ["sinfo", "--noheader"]
    if shutil.which("sinfo") is None or subprocess.run(command, capture_output=True).returncode:
        assert os.environ.get("REQUIRE_SLURM") != "1", "REQUIRE_SLURM=1, but no Slurm answers"
        pytest.skip("no Slurm answers (tests/slurm.sh starts one)")


def submit(tiny, *args):
    """Submits, and returns the numbers of the jobs."""
    result = tiny.run("--slurm", *args)
    assert result.returncode == 0, result.stderr
    return re.search("as job ([0-9 ]+);", result.stdout)[1].split()


def queued(*jobs):
    return subprocess.run(
        ["squeue", "-h", "-j", ",".join(jobs)], capture_output=True, text=True
    ).stdout.strip()


def test_slurm_arrays_complete(slurm, tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3 4 5", steps=1024)
    config = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True).stdout
    max_array_size = int(re.search(r"MaxArraySize\s*= (\d+)", config)[1])
    jobs = submit(tiny, "--runs-per-task", "2")
    assert len(jobs) == -(-3 // max_array_size)
    wait_for(lambda: not queued(*jobs))
    tiny.assert_complete()
    assert [starts(folder) for folder in tiny.folders] == [1] * 5
    assert "nothing to do" in tiny.run("--slurm").stdout


def test_slurm_requeue_and_scancel(slurm, tmp_path):
    tiny = Tiny(tmp_path / "runs", betas="0 0.5", steps=12288)
    requeued, cancelled = tiny.folders
    (job,) = submit(tiny, "--runs-per-task", "1")
    wait_for(lambda: evaluations(requeued))
    config = (requeued / "config.json").stat().st_mtime_ns
    subprocess.run(["scontrol", "requeue", f"{job}_0"], check=True)
    wait_for(lambda: evaluations(cancelled))
    subprocess.run(["scancel", f"{job}_1"], check=True)
    wait_for(lambda: not queued(job), 300)
    assert (requeued / "summary.json").exists() and starts(requeued) == 2
    assert (
        requeued / "config.json"
    ).stat().st_mtime_ns == config  # it went on and did not start again
    assert tiny.status().startswith("quick: 1 of 2 done, 0 running, 0 failed, 1 to do")
    assert evaluations(cancelled)
    assert tiny.run("-j", "1").returncode == 0
    tiny.assert_complete()
