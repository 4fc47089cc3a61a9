"""run_sweep.sh: lists of runs, sweeps of fake and of tiny runs, killed in all ways, a real Slurm.

The Slurm tests are skipped where no Slurm answers (tests/slurm.sh starts one), unless
REQUIRE_SLURM=1.
"""

import contextlib
import fcntl
import functools
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

import grids
import ppo_colored_continuous
import run_files

ROOT = Path(__file__).parent.parent
SWEEP = str(ROOT / "run_sweep.sh")
ENV = {**os.environ, "PYTHON": sys.executable}
STEPS, EVAL_FREQ = 8192, 512
TINY = f"--n-steps 64 --n-epochs 1 --eval-freq {EVAL_FREQ} --eval-episodes 1 --no-compile"
TINY = [*TINY.split(), "--total-timesteps"]
MOUNTAIN_CAR = "ppo_colored_continuous/MountainCarContinuous-v0"
FLAGS = ["--env-id", "--beta", "--n-envs", "--seed", "--exp-name"]
# Stands for python where only what the sweep makes of a run counts, so that this is quick
FAKE_PYTHON = f"""#!{sys.executable} -S
import os, sys, time
if sys.argv[1].endswith("grids.py"):
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
elif "--help" not in sys.argv:
    folder = os.path.dirname(os.readlink("/proc/self/fd/1"))
    exec(os.environ["FAKE_RUN"])
"""
# Is python, but for the sweep's question whether it can run the script: each takes three seconds
ASSURING_PYTHON = f"""#!/bin/sh
for word; do [ "$word" = --help ] && exit; done
exec {shlex.quote(sys.executable)} "$@"
"""
# What the second start of a run finishes, and the first one does not before there is a file "go"
ONCE_MORE = """
if open(folder + "/log.txt").read().count("== ") == 1:
    while not os.path.exists(folder + "/go"):
        time.sleep(0.1)
"""
FINISH = "print('{\"wall_seconds\": 9}', file=open(folder + '/summary.json', 'w'))"
# Makes stdin the terminal that Ctrl-C comes from, and becomes the command. A suite that was started
# in the background ignores Ctrl-C, and what it starts would, too.
ON_TERMINAL = """
import fcntl, os, signal, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.execv(sys.argv[1], sys.argv[1:])
"""

submitted = []  # Slurm jobs
started = []


@pytest.fixture(autouse=True)
def nothing_stays_behind():
    yield
    sessions = {started.pop().pid for _ in list(started)}
    for pid in [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]:
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(pid) in sessions:
                os.kill(pid, signal.SIGKILL)


def sweep(*args, env=ENV):
    return subprocess.run([SWEEP, *args], capture_output=True, text=True, env=env, timeout=300)


def printed(*args):
    result = sweep(args[0], "--print", *args[1:])
    assert result.returncode == 0 and result.stderr == ""
    return result.stdout.splitlines()


class Tiny:
    """A sweep of tiny runs in a folder: quick, narrowed to the seeds, n at a time."""

    def __init__(self, runs, seeds="1", betas="0", steps=STEPS):
        self.runs, self.steps, self.env = runs, steps, ENV
        self.use_python("assuring_python", ASSURING_PYTHON)
        self.args = ["quick", "--seeds", seeds, "--betas", betas, "--runs-dir", str(runs)]
        self.folders = [
            runs / MOUNTAIN_CAR / f"beta_{b}/n_envs_4/seed_{s}"
            for s in seeds.split()
            for b in betas.split()
        ]

    def use_python(self, name, text):
        python = self.runs.parent / name
        python.write_text(text)
        python.chmod(0o755)
        self.env = {**self.env, "PYTHON": str(python)}

    def fake(self, code):
        """Every run is this code instead of training."""
        self.use_python("fake_python", FAKE_PYTHON)
        self.env["FAKE_RUN"] = code

    def run(self, *args):
        return sweep(*self.args, *args, "--", *TINY, str(self.steps), env=self.env)

    def start(self, *args, terminal=None):
        """Starts the sweep; with its output in a pipe, or with a terminal of its own."""
        command = [SWEEP, *self.args, *args, "--", *TINY, str(self.steps)]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        if terminal is not None:
            command = [sys.executable, "-c", ON_TERMINAL, *command]
            streams = dict.fromkeys(["stdin", "stdout", "stderr"], terminal)
        process = subprocess.Popen(
            command, text=True, env=self.env, start_new_session=True, **streams
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
    try:
        return [int(x) for x in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def trainings(pid):
    """The training processes of a sweep: each is the child of a worker, which is the sweep's."""
    pids = [grandchild for child in children(pid) for grandchild in children(child)]
    return [x for x in pids if b"--resume" in Path(f"/proc/{x}/cmdline").read_bytes()]


# ---- What is run


PRESETS = {"quick": (4, 1), "main": (20480, 16), "vanilla": (2560, 16), "n_steps": (960, 16)}
PRESETS |= {"n_epochs": (2880, 16), "complex": (640, 4), "transfer": (5120, 16), "gsde": (2560, 16)}


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_counts(preset):
    runs, envs = PRESETS[preset]
    lines = printed(preset)
    assert len(lines) == runs
    assert len(set(lines)) == runs
    words = [line.split() for line in lines]
    assert len({w[w.index("--env-id") + 1] for w in words}) == envs
    # No two runs share a folder
    assert len({tuple(w[w.index(f) + 1] if f in w else "" for f in FLAGS) for w in words}) == runs
    assert all("--resume" in w for w in words)


def test_other_methods(tmp_path):
    narrowed = shlex.split("--envs door --seeds 1 --n-envs 4")
    lines = printed("transfer", *narrowed, "--betas", "0.5") + printed("gsde", *narrowed)
    lines += printed("transfer", *narrowed, "--betas", "0.5", "--exp-name", "x")
    words = [shlex.split(line.split(f" {ROOT}")[1]) for line in lines]  # behind the interpreter
    assert [w[:2] for w in words[:3]] == [["/baselines.py", m] for m in ("trpo", "a2c", "gsde")]
    names = [w[w.index("--exp-name") + 1] for w in words]
    assert names == ["trpo", "a2c", "gsde", "x_trpo", "x_a2c"]
    assert [w[w.index("--beta") + 1] if "--beta" in w else "" for w in words[:3]] == [
        "0.5",
        "0.5",
        "",
    ]
    # Where the sweep looks for them: gsde stands in place of the noise
    tiny = Tiny(tmp_path / "runs")
    tiny.fake(FINISH)
    for preset in ("transfer", "gsde"):
        args = [preset, *narrowed, "--runs-dir", str(tiny.runs)]
        args += ["--betas", "0.5"] if preset == "transfer" else []
        assert sweep(*args, env=tiny.env).returncode == 0
    folders = sorted(str(f.parent.relative_to(tiny.runs)) for f in tiny.runs.rglob("summary.json"))
    assert folders == [
        f"{x}/n_envs_4/seed_1"
        for x in ("a2c/door-v0/beta_0.5", "gsde/door-v0/gsde", "trpo/door-v0/beta_0.5")
    ]


def test_started_by_bash():
    command = ["bash", "run_sweep.sh", "quick", "--print", "--seeds", "1", "--betas", "0"]
    line = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=ENV).stdout
    assert line.split()[1] == "./ppo_colored_continuous.py"


def test_any_environment():
    envs = "cheetah-run dm_control/cheetah-run Ant4Rooms HalfCheetah-v5 my_env:Mine my_env:Mine-v0"
    words = [
        shlex.split(x) for x in printed("quick", "--envs", envs, "--betas", "0", "--seeds", "1")
    ]
    ids = ["dm_control/cheetah-run-v0", "Ant4Rooms-v1", "HalfCheetah-v5", "my_env:Mine"]
    assert [w[3] for w in words] == [*ids, "my_env:Mine-v0"]


def test_folders_are_those_of_the_runs():
    mix = "--envs 'door reacher-hard my:Env MyEnv-v0' --betas '-.50 -0 2.0' --exp-name x --seeds 0"
    sweeps = [f"{preset} {mix}" for preset in ("main", "n_steps", "n_epochs", "transfer")]
    for sweep_args in [*sweeps, "vanilla", "gsde", "quick --runs-dir '/a b/'"]:
        runs = grids.list_runs(grids.parse_args(shlex.split(sweep_args)))
        for folder, command in random.Random(1).sample(runs, k=4):
            _, script, *argv = shlex.split(command)
            parse = ppo_colored_continuous.parse_args
            if script.endswith("baselines.py"):
                parse = functools.partial(parse, method=argv.pop(0))
            assert folder == str(run_files.run_path(vars(parse(argv)))), command


def test_beta_auto():
    args = grids.parse_args(["quick", "--betas", "auto 0", "--seeds", "1"])
    (folder, command), _ = grids.list_runs(args)
    assert "/beta_auto/" in folder and " --beta auto " in command


def test_n_steps_keeps_the_update_size():
    words = [shlex.split(line) for line in printed("n_steps", "--envs", "door", "--seeds", "1")]
    flags = [dict(zip(w[2::2], w[3::2], strict=False)) for w in words]
    pairs = [(int(f["--n-envs"]), int(f.get("--n-steps", 2048))) for f in flags]
    assert pairs == [(2, 4096), (4, 2048), (8, 1024)]
    # The default is the main study's run and is not repeated
    assert [f["--exp-name"][22:] for f in flags] == ["_n_steps_4096", "", "_n_steps_1024"]


def test_narrowing_and_quoting():
    narrowed = "main --envs 'dm_control/cheetah-run-v0 PointUMaze' --betas '0 0.50 -1 -0'"
    narrowed += " --n-envs 4 --seeds '3 1'"
    named = """--runs-dir 'my runs/a' --exp-name x -- --note "it's $HOME; a b" --no-compile"""
    lines = printed(*shlex.split(f"{narrowed} {named}"))
    words = [shlex.split(line) for line in lines]
    assert [w[2:12:2] for w in words] == [FLAGS] * 12
    expected = [
        (env, beta, "4", seed)
        for seed in ["3", "1"]
        for env in ["dm_control/cheetah-run-v0", "PointUMaze-v1"]
        for beta in ["0", "0.5", "-1"]
    ]
    assert [tuple(w[3:10:2]) for w in words] == expected
    tail = shlex.split("--runs-dir 'my runs/a' --threads 1 --resume --note")
    tail += ["it's $HOME; a b", "--no-compile"]
    for w in words:  # the paper's dm_control runs had no bootstrap at time limits, the rest had
        dm_control = ["--no-bootstrap-timeouts"] if w[3].startswith("dm_control/") else []
        assert w[:2] == [sys.executable, str(ROOT / "ppo_colored_continuous.py")]
        assert w[10:] == ["--exp-name", "x", *dm_control, *tail]


WRONG = [
    "",
    "mane",
    "main --foo",
    "main --envs PontUMaze",
    "main --betas 0,5",
    "main --betas",
    "main 4",
]
WRONG += [
    "main --seeds -1",
    "main --n-envs 0",
    "main --n-envs 1.5",
    "main -j 0",
    "main -j",
    "gsde --betas 0",
]
WRONG += ["vanilla --betas 0", "main --n-epochs 5", "main --print --slurm", "main --exp-name a/b"]
WRONG += ["main --runs-per-task x", "n_steps --n-envs 3", "main -- --seed 3", "main -- --overwrite"]
WRONG += ["n_steps -- --n-steps=5", "main --betas 1.23456789"]


@pytest.mark.parametrize("args", WRONG)
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
    counts, left = tiny.status().split(", time left: ")
    assert counts == "quick: 0 of 4 done, 0 running, 1 failed, 3 to do"
    assert left == "known when the first run is done"
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


@pytest.mark.parametrize("args", ["--print", "--status", "--slurm", "--help"])
def test_output_that_cannot_be_written_is_an_error(tmp_path, args):
    tiny = Tiny(tmp_path / "runs")
    tiny.fake(FINISH)
    tools = tmp_path / "tools"
    tools.mkdir()
    for tool in ("sbatch", "scontrol"):
        says = f"touch {tmp_path}/submitted" if tool == "sbatch" else "echo MaxArraySize = 9"
        (tools / tool).write_text(f"#!/bin/sh\n{says}\n")
        (tools / tool).chmod(0o755)
    env = {**tiny.env, "PATH": f"{tools}:{os.environ['PATH']}"}
    env["PYTHON"] = sys.executable if args == "--status" else env["PYTHON"]
    with open("/dev/full", "w") as full:
        command = [SWEEP, *tiny.args, args]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=env)
    assert result.returncode not in (0, 2)
    assert len(result.stderr.splitlines()) == 1 and "No space left" in result.stderr
    assert not list(tiny.runs.rglob("log.txt")) and not (tmp_path / "submitted").exists()


def test_slurm_tasks_are_parts_of_the_list(tmp_path):
    """Without Slurm: what sbatch is given; the ant's runs have tasks of their own."""
    tiny = Tiny(tmp_path / "my runs")
    tiny.fake(FINISH)
    tools = tmp_path / "tools"
    tools.mkdir()
    sbatch = f"cat >{tmp_path}/batch.$(ls {tmp_path} | grep -c batch); echo 7"
    for tool, says in {"sbatch": sbatch, "scontrol": "echo MaxArraySize = 2"}.items():
        (tools / tool).write_text(f"#!/bin/sh\n{says}\n")
        (tools / tool).chmod(0o755)
    env = {**tiny.env, "PATH": f"{tools}:{os.environ['PATH']}"}
    args = ["main", "--envs", "AntUMaze door", "--betas", "0 1", "--n-envs", "4 8", "--seeds", "1"]
    args += ["--runs-dir", str(tiny.runs), "--retry-failed", "--slurm", "--", "--note", "it's"]
    result = sweep(*args, env=env)
    assert result.stdout.startswith("8 runs in 5 tasks; ") and "as job 7 7 7;" in result.stdout
    done = []
    for batch in (f"batch.{i}" for i in range(3)):
        for task in ("0", "1") if batch != "batch.2" else ("0",):
            how = {"env": {**env, "SLURM_ARRAY_TASK_ID": task}, "capture_output": True}
            assert subprocess.run(["bash", tmp_path / batch], **how).returncode == 0
            done.append(len(list(tiny.runs.rglob("summary.json"))))
    assert done == [1, 2, 3, 4, 8]
    assert "nothing to do" in sweep(*args, env=env).stdout


def test_interpreter_is_tried_before_anything_starts(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    tiny.fake(FINISH)
    Path(tiny.env["PYTHON"]).write_text("#!/bin/sh\necho 'No module named torch' >&2; exit 1\n")
    for python in (tiny.env["PYTHON"], "/nowhere/python"):
        tiny.env["PYTHON"] = python
        result = tiny.run()
        assert result.returncode == 1
        line = result.stderr.splitlines()[-1]
        assert python in line and ("No module named torch" in line or "No such file" in line)
        assert not list(tiny.runs.rglob("*/"))


@pytest.mark.parametrize("tool", ["nproc", "flock"])
def test_missing_tool_is_named(tmp_path, tool):
    for name in [
        "bash",
        "env",
        "dirname",
        "mkdir",
        "rm",
        "tail",
        "tr",
        "awk",
        "true",
        "nproc",
        "flock",
    ]:
        if name != tool:
            (tmp_path / name).symlink_to(shutil.which(name))
    tiny = Tiny(tmp_path / "runs")
    tiny.fake(FINISH)
    tiny.env["PATH"] = str(tmp_path)
    result = tiny.run()
    assert result.returncode == 1 and f"no {tool} here" in result.stderr.splitlines()[-1]
    assert len(result.stderr.splitlines()) == 2  # the other is the note about flags
    if tool == "nproc":
        assert tiny.run("-j", "1").returncode == 0


# ---- Sweeps of fake runs


def test_failed_run_does_not_stop_the_others(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2")
    # The error stands behind the progress bar, as it does where stderr is a file
    bars = r"\r  5%| 1k/2M\r  6%| 1.2k/2M [00:01]error: training diverged\n\n 6%|"
    tiny.fake(f"if 'seed_1' in folder: sys.exit('{bars}')\n{FINISH}")
    bad, good = tiny.folders
    for attempt in range(2):  # the second sweep lists the failure again, and does not try again
        result = tiny.run("-j", "1")
        assert result.returncode == 1
        assert (good / "summary.json").exists()
        line = f"failed: {bad}: exit code 1: error: training diverged"
        assert line in result.stdout.splitlines()
        assert starts(bad) == 1, attempt
    assert tiny.status() == "quick: 1 of 2 done, 0 running, 1 failed, 0 to do"
    tiny.fake(FINISH)
    assert tiny.run("-j", "1", "--retry-failed").returncode == 0


def test_killed_five_times_is_failed(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    tiny.fake("os.kill(os.getpid(), 9)")
    result = tiny.run("-j", "1")
    assert result.returncode == 1 and ": exit code 137: " in result.stdout
    assert starts(tiny.folders[0]) == 5


def test_what_hits_all_runs_stops_the_sweep(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3")
    tiny.fake("sys.exit(127)")
    result = tiny.run("-j", "1")
    assert result.returncode == 1 and "stopped: " in result.stderr
    assert "to go on: PYTHON=" in result.stdout
    assert [(folder / "log.txt").exists() for folder in tiny.folders] == [True, False, False]
    assert not (tiny.folders[0] / "failed").exists()


def test_workers_end_with_a_killed_sweep(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2")
    tiny.fake("time.sleep(1); " + FINISH)
    process = tiny.start("-j", "1")
    wait_for(lambda: trainings(process.pid))
    process.kill()
    process.wait()
    wait_for(lambda: (tiny.folders[0] / "summary.json").exists())
    time.sleep(0.5)
    assert not (tiny.folders[1] / "log.txt").exists()


def test_two_sweeps_share_the_work(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3 4 5 6")
    tiny.fake("time.sleep(0.5); " + FINISH)
    processes = [tiny.start("-j", "1"), tiny.start("-j", "1")]
    outputs = [process.communicate(timeout=60)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert [starts(folder) for folder in tiny.folders] == [1] * 6
    assert all("\ncomplete (" in output for output in outputs)  # each did a share


def test_waits_for_a_run_that_another_process_has(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    tiny.fake(FINISH)
    tiny.folders[0].mkdir(parents=True)
    with open(tiny.folders[0] / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        process = tiny.start()
        assert [process.stdout.readline() for _ in range(3)][-1].startswith("waiting for 1 runs")
    output = process.communicate(timeout=60)[0]
    assert process.returncode == 0, output
    assert starts(tiny.folders[0]) == 1


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


def test_kill_9_of_children_and_sweeps(tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2")
    rng = random.Random(1)
    for victim in ("run", "worker", "sweep"):
        process = tiny.start("-j", "2")
        wait_for(lambda: trainings(process.pid) or process.poll() is not None)  # noqa: B023
        time.sleep(rng.uniform(1, 4))
        pids = {"run": trainings, "worker": children, "sweep": lambda pid: [pid]}[victim](
            process.pid
        )
        if process.poll() is None and pids:
            os.kill(rng.choice(pids), signal.SIGKILL)
        process.kill()
        process.wait()
    result = tiny.run("-j", "2")  # some children of the last one still run
    assert result.returncode == 0, result.stdout
    tiny.assert_complete()
    assert sum(starts(folder) for folder in tiny.folders) > 2  # something was killed


@pytest.mark.parametrize("by, betas", [("Ctrl-C", "0 0.5"), ("SIGTERM", "0")])
def test_stopped_sweep_saves_and_tells_how_to_go_on(tmp_path, by, betas):
    tiny = Tiny(tmp_path / "runs", betas=betas, steps=2_048_000)
    terminal, theirs = os.openpty()
    process = tiny.start("-j", "2", terminal=theirs)
    os.close(theirs)
    wait_for(lambda: all(evaluations(folder) for folder in tiny.folders))
    n = len(tiny.folders)
    assert tiny.status().startswith(f"quick: 0 of {n} done, {n} running, 0 failed, 0 to do")
    if by == "Ctrl-C":
        os.write(terminal, b"\x03")
    else:
        process.terminate()
    process.wait(60)
    output = b""
    with contextlib.suppress(OSError):  # nothing is left, and nobody writes
        while said := os.read(terminal, 65536):  # one reading may give a part
            output += said
    os.close(terminal)
    assert process.returncode == {"Ctrl-C": 130, "SIGTERM": 143}[by], output
    (command,) = re.findall("^to go on: (.*)\r", output.decode(), re.M)
    python = f"PYTHON={tiny.env['PYTHON']}"
    assert shlex.split(command) == [python, SWEEP, *tiny.args, "-j", "2", "--", *TINY, "2048000"]
    for folder in tiny.folders:
        assert not is_locked(folder)
        assert (folder / "checkpoint.pt").exists() and not (folder / "failed").exists()
        # Each was told once: at a second signal a run may end without saving
        assert (folder / "log.txt").read_text().count("\nstopped: ") == 1


def test_killed_run_is_continued_by_the_same_sweep(tmp_path):
    tiny = Tiny(tmp_path / "runs")
    process = tiny.start("-j", "1")
    wait_for(lambda: evaluations(tiny.folders[0]))
    os.kill(trainings(process.pid)[0], signal.SIGKILL)
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    assert starts(tiny.folders[0]) == 2
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


@functools.cache  # where only the commands are there, sinfo waits for nine seconds
def slurm_answers():
    command = ["sinfo", "--noheader"]
    return shutil.which("sinfo") and not subprocess.run(command, capture_output=True).returncode


@pytest.fixture
def slurm():
    if not slurm_answers():
        assert os.environ.get("REQUIRE_SLURM") != "1", "REQUIRE_SLURM=1, but no Slurm answers"
        pytest.skip("no Slurm answers (tests/slurm.sh starts one)")
    # One test at a time: the node is too small for the tasks of two
    with open(Path(tempfile.gettempdir()) / "slurm_tests.lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
        subprocess.run(["scancel", *submitted], check=True)  # what a failed test has left
        submitted.clear()


def submit(tiny, *args):
    """Submits, and returns the numbers of the jobs."""
    result = tiny.run("--slurm", *args)
    assert result.returncode == 0, result.stderr
    submitted.extend(re.search("as job ([0-9 ]+);", result.stdout)[1].split())
    return list(submitted)


def queued(*jobs):
    return subprocess.run(
        ["squeue", "-h", "-j", ",".join(jobs)], capture_output=True, text=True
    ).stdout.strip()


def test_slurm_arrays_complete(slurm, tmp_path):
    tiny = Tiny(tmp_path / "runs", seeds="1 2 3 4 5")
    tiny.fake(FINISH)
    config = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True).stdout
    max_array_size = int(re.search(r"MaxArraySize\s*= (\d+)", config)[1])
    jobs = submit(tiny, "--runs-per-task", "2")
    assert len(jobs) == -(-3 // max_array_size)
    wait_for(lambda: not queued(*jobs))
    assert [starts(folder) for folder in tiny.folders] == [1] * 5
    assert tiny.status() == "quick: 5 of 5 done, 0 running, 0 failed, 0 to do"
    assert "nothing to do" in tiny.run("--slurm").stdout


def test_slurm_requeue_and_scancel(slurm, tmp_path):
    tiny = Tiny(tmp_path / "runs", betas="0 0.5")
    tiny.fake(ONCE_MORE + FINISH)
    requeued, cancelled = tiny.folders
    (job,) = submit(tiny, "--runs-per-task", "1")
    wait_for(lambda: all((folder / "log.txt").exists() for folder in tiny.folders))
    subprocess.run(["scontrol", "requeue", f"{job}_0"], check=True)
    subprocess.run(["scancel", f"{job}_1"], check=True)
    wait_for(lambda: not queued(job), 300)
    assert [starts(folder) for folder in tiny.folders] == [2, 1]
    assert tiny.status().startswith("quick: 1 of 2 done, 0 running, 0 failed, 1 to do")
    assert tiny.run("-j", "1").returncode == 0  # takes up the cancelled one


@pytest.mark.parametrize("task", [0, 1])
def test_slurm_time_limit_requeues_only_the_task(slurm, tmp_path, task):
    tiny = Tiny(tmp_path / "runs", betas="0 0.5")
    tiny.fake(ONCE_MORE + FINISH)
    signalled, other = tiny.folders[task], tiny.folders[1 - task]
    (job,) = submit(tiny, "--runs-per-task", "1")
    wait_for(lambda: all((folder / "log.txt").exists() for folder in tiny.folders))
    # What Slurm sends to the batch shell two minutes before the time limit. The last task of an
    # array has the array's own job id
    subprocess.run(["scancel", "--batch", "--signal=USR1", f"{job}_{task}"], check=True)
    wait_for(lambda: (signalled / "summary.json").exists())
    assert [starts(signalled), starts(other)] == [2, 1]
    (other / "go").touch()
    wait_for(lambda: not queued(job))
    assert tiny.status() == "quick: 2 of 2 done, 0 running, 0 failed, 0 to do"
    assert starts(other) == 1
