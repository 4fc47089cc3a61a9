"""What a run leaves behind: its folder, lock, configuration, evaluations, TensorBoard events, checkpoint and summary.

A run may be killed at any moment. Whole files are replaced atomically: written beside, then renamed. The growing ones
(evaluations.csv and the TensorBoard events) are cut back on resume to the length they had at the checkpoint, so that
every evaluation and every point is there exactly once.
"""

import contextlib
import fcntl
import importlib.metadata
import io
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import torch
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

PACKAGES = ["torch", "numpy", "gymnasium", "mujoco", "dm-control", "shimmy", "gymnasium-robotics", "envpool"]
# How a run is carried out, not what it computes: these arguments may change between a run and its --resume.
FREE_ARGS = {"resume", "overwrite", "runs_dir", "device", "compile", "capture_video", "track"}


def fail(message, code=1):
    """Ends the program with one line on stderr. Exit codes: 1 failure, 2 wrong argument, 3 the run is taken."""
    print("error: " + " ".join(str(message).split()), file=sys.stderr)
    sys.exit(code)


def run_path(args):
    """Path of a run's folder: it shows the experiment, environment, beta (or vanilla), n_envs and seed."""
    beta = "vanilla" if args["vanilla"] else "beta_" + "_".join(f"{b:g}" for b in args["beta"])
    path = Path(args["runs_dir"]) / args["exp_name"] / args["env_id"].replace("/", "_")
    return path / beta / f"n_envs_{args['n_envs']}" / f"seed_{args['seed']}"


class RunFolder:
    """The folder of one run, locked until the process ends.

    Attributes: `summary` is that of a complete run, else None; `checkpoint` is the state to go on from, else None.
    Ends the program with one line where the folder is taken, not writable, damaged, or holds another run.

    Args:
        args: the run's arguments, a dict.
        resolved: what else config.json is to record, a dict.
    """

    def __init__(self, args, resolved):
        self.path, self.checkpoint, self.summary = run_path(args), None, None
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.path / "lock", "a")  # noqa: SIM115  held until the process ends
        except OSError as error:
            fail(f"cannot write to {self.path} ({error.strerror}): choose another --runs-dir")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fail(f"another process works on {self.path}: wait for it, or choose another --seed or --exp-name", code=3)

        if args["overwrite"]:
            self._clear()
        elif (self.path / "config.json").exists():
            self._check_same_run(args)
            if (self.path / "summary.json").exists():
                self.summary = self._read_json("summary.json")
                return
            if not args["resume"]:
                fail(f"{self.path} holds an unfinished run: add --resume to continue it, or --overwrite to start again")
            self._load_checkpoint()
        if self.checkpoint is None:
            self._clear()
            versions = {"python": platform.python_version()}
            for package in PACKAGES:
                with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                    versions[package] = importlib.metadata.version(package)
            config = {"args": args, "resolved": resolved, "versions": versions, "git_commit": _git_commit()}
            self._write_json("config.json", config)
            self._append("evaluations.csv", b"step,return_mean,return_std,length_mean\n")
        self._open_events()
        self._wandb = _start_wandb(self.path, args) if args["track"] else None

    def log(self, step, scalars):
        """Adds {tag: number} to TensorBoard at this step; the points reach the file with the next checkpoint."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        event = Event(wall_time=time.time(), step=step, summary=Summary(value=values))
        self._records.write(event.SerializeToString())
        if self._wandb:
            self._wandb.log(scalars, step=step)

    def add_evaluation(self, step, returns, lengths):
        """Appends a row to evaluations.csv. returns, lengths: (eval_episodes,)."""
        row = f"{step},{returns.mean():.9g},{returns.std():.9g},{lengths.mean():.9g}\n"
        self._append("evaluations.csv", row.encode())
        scalars = {"return_mean": returns.mean(), "return_std": returns.std(), "length_mean": lengths.mean()}
        self.log(step, {f"evaluation/{name}": value for name, value in scalars.items()})

    def save_checkpoint(self, state):
        """Replaces checkpoint.pt by `state`, a dict of tensors and plain values."""
        self._append(self._events_name, self._buffer.getvalue())
        self._buffer.seek(0)
        self._buffer.truncate()
        sizes = {name: (self.path / name).stat().st_size for name in ("evaluations.csv", *self._event_files())}
        data = io.BytesIO()  # straight to the file, torch.save would not raise an OSError on a full disk
        torch.save({**state, "file_sizes": sizes}, data)
        self._write("checkpoint.pt", data.getvalue())

    def finish(self, steps, wall_seconds):
        """Writes summary.json, which makes the run complete, and returns it."""
        rows = (self.path / "evaluations.csv").read_text().splitlines()[1:]
        returns = [float(row.split(",")[1]) for row in rows]
        summary = {
            "performance": sum(returns) / len(returns),
            "final_return": returns[-1],
            "steps": steps,
            "wall_seconds": round(wall_seconds, 1),
        }
        self._write_json("summary.json", summary)
        if self._wandb:
            self._wandb.summary.update(summary)
            self._wandb.finish()
        return summary

    def _event_files(self):
        return sorted(path.name for path in self.path.glob("events.out.tfevents.*"))

    def _clear(self):
        """Removes what a run has left here, summary first: without it, a half-cleared folder is an unfinished run."""
        for name in ("summary.json", "checkpoint.pt", "evaluations.csv", *self._event_files(), "config.json"):
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.path / "videos", ignore_errors=True)

    def _check_same_run(self, args):
        """Refuses to mix runs: what decides the result must be the same as in the folder's config.json."""
        old = self._read_json("config.json").get("args", {})
        args = json.loads(json.dumps(args))
        for name in sorted((old.keys() | args.keys()) - FREE_ARGS):
            if old.get(name) != args.get(name):
                flag = "--" + name.replace("_", "-")
                change = f"{flag} {old.get(name)}, not {args.get(name)}"
                fail(f"the run in {self.path} has {change}: choose another --exp-name, or --overwrite to replace it", 2)

    def _load_checkpoint(self):
        path = self.path / "checkpoint.pt"
        if not path.exists():
            return
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            sizes = checkpoint["file_sizes"]
            if any((self.path / name).stat().st_size < size for name, size in sizes.items()):
                raise ValueError("evaluations.csv or a TensorBoard file is shorter than it was")
        except Exception as error:  # torch.load raises nearly anything on a damaged file
            reason = str(error).split(". ")[0][:100]
            fail(f"{path} is damaged ({reason}): restore it, or start this run again with --overwrite")
        for name in ("evaluations.csv", *self._event_files()):
            if name in sizes:
                os.truncate(self.path / name, sizes[name])
            else:
                (self.path / name).unlink()
        self.checkpoint = checkpoint

    def _open_events(self):
        """Starts a new TensorBoard file. Records are gathered in memory, and appended with each checkpoint."""
        self._events_name = f"events.out.tfevents.{time.time_ns() // 1000}.{socket.gethostname()}.{os.getpid()}"
        self._buffer = io.BytesIO()
        self._records = RecordWriter(self._buffer)
        self._records.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())

    def _append(self, name, data):
        with open(self.path / name, "ab") as file:
            file.write(data)

    def _write(self, name, data):
        temporary = self.path / f"{name}.tmp"
        try:
            temporary.write_bytes(data)
            os.replace(temporary, self.path / name)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def _write_json(self, name, value):
        self._write(name, (json.dumps(value, indent=2) + "\n").encode())

    def _read_json(self, name):
        try:
            return json.loads((self.path / name).read_text())
        except ValueError:
            fail(f"{self.path / name} is damaged: restore it, or start this run again with --overwrite")


def _git_commit():
    """Commit of this code, with "-dirty" where tracked files differ from it; None outside a git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _start_wandb(path, args):
    try:
        import wandb
    except ImportError:
        fail("--track needs Weights & Biases: pip install wandb", code=2)
    name = "/".join(path.parts[-5:])
    run_id = name.replace("/", "-")
    settings = wandb.Settings(silent=True)
    return wandb.init(
        project="ppo_colored_noise", id=run_id, name=name, dir=path, config=args, resume="allow", settings=settings
    )
