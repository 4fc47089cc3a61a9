"""What a run leaves behind, and what a program needs besides: nothing here is about learning.

A run may be killed at any moment. Whole files are replaced atomically: written beside, then
renamed. The growing ones (evaluations.csv and the TensorBoard events) are cut back on resume to the
length they had at the checkpoint, so that every evaluation and every point is there exactly once.
"""

import argparse
import contextlib
import copy
import getpass
import importlib.metadata
import io
import json
import math
import os
import platform
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from pathlib import Path

import filelock
import numpy as np
import torch
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from torch import nn
from tqdm import tqdm

PACKAGES = ["torch", "numpy", "gymnasium", "mujoco", "dm-control", "shimmy", "gymnasium-robotics"]
PACKAGES += ["envpool"]
# How a run is carried out, not what it computes: these may change between a run and its --resume.
FREE_ARGS = {"resume", "overwrite", "runs_dir", "device", "compile", "threads", "capture_video"}
FREE_ARGS |= {"track"}
# What runs did that are older than the argument
ABSENT = {"method": "ppo", "envpool": False, "anneal_lr": False, "max_episode_steps": None}
ABSENT |= {"eval_once_per_policy": False, "env_kwargs": None, "rescale_actions": False}
ABSENT |= {"normalize_obs": False, "normalize_rewards": False, "beta_auto": False}
SECONDS_BETWEEN_CHECKPOINTS = 5

# --- The end of a program: mistakes and signals

_open_bar = None


def fail(message, code=1):
    """Ends the program with one line on stderr. Codes: 1 failure, 2 wrong argument, 3 run taken."""
    if _open_bar is not None:
        _open_bar.close()  # or the line would be glued to the bar
    print("error: " + " ".join(str(message).split()), file=sys.stderr)
    sys.exit(code)


def progress_bar(total, initial):
    """tqdm's bar of environment steps; once a minute where nobody looks at a terminal."""
    global _open_bar
    interval = 0.5 if sys.stderr.isatty() else 60
    _open_bar = tqdm(
        total=total, initial=initial, unit=" steps", unit_scale=True, mininterval=interval
    )
    return _open_bar


class Stopped(SystemExit):
    """Ctrl-C or SIGTERM; its code is 130 or 143."""


_signals = []


def catch_signals():
    """From now on Ctrl-C and SIGTERM stop the program where it next calls stop_if_asked.

    An exception in the handler itself would come up in whatever Python happens to run, which may
    swallow it: dm_control does, in a property lookup. A second signal ends the program at once.
    """

    def handler(number, _):
        _signals.append(number)
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


def stop_if_asked():
    """Raises Stopped after a signal. The loops of rollout, update and evaluation call it."""
    if _signals:
        raise Stopped(128 + _signals[0])


# --- Arguments


def number(kind, valid, description):
    """An argparse type: a finite int (1e6 is one) or float for which valid(number) holds."""

    def parse(text):
        try:
            value = int(text) if kind is int and re.fullmatch(r"[+-]?\d+", text) else float(text)
            if math.isfinite(value) and kind(value) == value and valid(kind(value)):
                return kind(value)
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"{text} is not {description}")

    return parse


NUMBERS = {  # the types of arguments; 1e15: floats are exact up to there, and it is enough
    "count": number(int, lambda x: 1 <= x < 1e15, "a positive whole number"),
    "whole": number(int, lambda x: 0 <= x < 2**63, "a whole number >= 0 and < 2^63"),
    "at_least_2": number(int, lambda x: 2 <= x < 1e15, "a whole number >= 2"),
    "positive": number(float, lambda x: x > 0, "a positive number"),
    "fraction": number(float, lambda x: 0 <= x <= 1, "between 0 and 1"),
    "real": number(float, lambda x: True, "a finite number"),
}


def real_or_auto(text):
    return text if text == "auto" else NUMBERS["real"](text)


def key_value(text):
    """An argparse type: the pair (key, value) of "key=value".

    A value is a number, true, false or null, a list such as 3,0, any other JSON, or else text.
    """
    key, equals, value = text.partition("=")
    if not (equals and key.isidentifier()):
        raise argparse.ArgumentTypeError(f"{text} is not key=value")
    words = {"True": "true", "False": "false", "None": "null"}  # Python's would be text, and true
    try:
        values = json.loads(f"[{words.get(value, value)}]")
    except (ValueError, RecursionError):
        values = [value]
    if len(values) == 1:
        return key, values[0]
    return key, values or value


class Args:
    """Parsed arguments, read-only: compiled code takes them for constants, and config.json too."""

    def __init__(self, **arguments):
        self.__dict__.update(arguments)

    def __setattr__(self, name, value):
        raise AttributeError(
            f"args.{name} is read-only. What changes in training is a variable of its own, handed "
            "on as learning_rate is to learn(); another default belongs in parse_args()"
        )


class ArgumentParser(argparse.ArgumentParser):
    """Mistakes are one line; defaults are in the help; negative numbers may have exponents."""

    def __init__(self, **kwargs):
        formatter = argparse.ArgumentDefaultsHelpFormatter
        super().__init__(**{"formatter_class": formatter, "allow_abbrev": False, **kwargs})
        others = {"real_or_auto": real_or_auto, "key_value": key_value}
        for name, parse in {**NUMBERS, **others}.items():
            self.register("type", name, parse)
        self._negative_number_matcher = re.compile(
            r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.IGNORECASE
        )

    def error(self, message):
        fail(f"{message} (--help lists all arguments)", code=2)


def n_cores():
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def recorded(args, name, default):
    """The argument's value in the config.json of the run that is there already, or the default."""
    try:
        config = json.loads((run_path(vars(args)) / "config.json").read_text())
        return default if args.overwrite else (ABSENT | config["args"])[name]
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return default  # no run, or a damaged one, of which RunFolder speaks


def check_device(device):
    """Ends the program where tensors on this torch device cannot be made and read."""
    try:
        torch.zeros(1, dtype=torch.float64, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError, TypeError):
        fail(f"--device {device} is not available here", code=2)


# --- Helpers of the loop


def make_seeds(n, *key):
    """n independent seeds below 2^32, determined by the integers of the key."""
    return np.random.SeedSequence(key).generate_state(n).tolist()


def _compile_cache():
    """The folder where torch.compile keeps what it has compiled, by its own rule."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in a container this user may have no name
        user = os.getuid()
    default = f"{tempfile.gettempdir()}/torchinductor_{user}"
    return os.environ.get("TORCHINDUCTOR_CACHE_DIR", default)


def prepare_torch():
    """One thread, since more are slower for small networks; a compile cache that can be written."""
    torch.set_num_threads(1)
    try:
        os.makedirs(_compile_cache(), exist_ok=True)
        tempfile.TemporaryFile(dir=_compile_cache()).close()
    except OSError:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp()


def check_finite(args, step, **arrays):
    """Ends the program where an array, (n_steps, n_envs, ...), has a NaN or an infinite number.

    step: the environment step after the arrays' last row.
    """
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            t, env = np.argwhere(~np.isfinite(array))[0, :2]
            step -= (len(array) - t - 1) * args.n_envs
            fail(f"{name} {array[t, env]} in {args.env_id}, environment {env} of {args.n_envs}, at "
                 f"step {step}: not finite, so nothing can be learned from it")  # fmt: skip


def check_learned(agent):
    """Ends the program where a parameter has become NaN or infinite."""
    if not nn.utils.parameters_to_vector(agent.parameters()).isfinite().all():
        fail("training diverged, the parameters are not finite: lower --learning-rate")


@contextlib.contextmanager
def one_line_for(*errors, because=""):
    """Ends the program with one line, and no traceback, where one of these errors comes up."""
    try:
        yield
    except errors as error:
        fail(f"{because}{error}", code=2)


def learnable(agent):
    """The module `agent`, ready to be learned as one flat vector, without autograd.

    Ends the program for what that would get wrong in silence: a parameter that is to stay as it is,
    and one that has two names. A module in two places is one module.
    """
    names = {}
    for prefix, module in agent.named_modules():
        for name, parameter in module.named_parameters(
            prefix, recurse=False, remove_duplicate=False
        ):
            if not parameter.requires_grad:
                fail(f"{name} has requires_grad=False and would be learned all the same: "
                     "register_buffer keeps a value as it is")  # fmt: skip
            if id(parameter) in names:
                fail(f"{name} and {names[id(parameter)]} are one parameter: give it one name, or "
                     "use one module in both places")  # fmt: skip
            names[id(parameter)] = name
    return agent.requires_grad_(False)


def refilled(fresh, saved):
    """What was saved, tensors on the devices of the fresh ones. ValueError where shapes differ."""
    if list(map(np.shape, fresh)) != list(map(np.shape, saved)):
        raise ValueError("the optimizer's tensors have other shapes")
    pairs = zip(fresh, saved, strict=True)
    return tuple(y.to(x.device) if torch.is_tensor(x) else y for x, y in pairs)


def numpy_policy(actor):
    """The module `actor` as a function from numpy to numpy: obs (n, obs_dim) -> (n, action_dim).

    The networks are so small that calling torch takes longer than computing: 31 us for 4 rows,
    numpy 6. Layers that are known here are computed in numpy; with any other the module is called,
    in eval mode. The weights are copied: make it anew when the module has learned.
    """
    activations = {nn.Tanh: np.tanh, nn.ReLU: lambda x: np.maximum(x, 0), nn.Identity: lambda x: x}

    def has_hooks(module):
        return module._forward_hooks or module._forward_pre_hooks

    whole = type(actor) is not nn.Sequential or has_hooks(actor)
    functions = []
    for layer in [actor] if whole else actor:
        if type(layer) is nn.Linear and layer.bias is not None and not has_hooks(layer):
            weight, bias = (p.detach().cpu().numpy().T.copy() for p in (layer.weight, layer.bias))
            functions.append(lambda x, weight=weight, bias=bias: x @ weight + bias)
        elif type(layer) in activations and not has_hooks(layer):
            functions.append(activations[type(layer)])
        else:
            device, module = next(actor.parameters()).device, copy.deepcopy(actor).eval()
            return lambda obs: module(torch.as_tensor(obs, device=device)).cpu().numpy()

    def policy(obs):
        for function in functions:
            obs = function(obs)
        return obs

    return policy


def compiled(function):
    """torch.compile of a function of tensors, as one graph: no Python between its operations.

    Where that fails the function goes on as it is, with a notice; if it is at fault itself, its own
    exception comes then.
    """
    how = {"fullgraph": True, "dynamic": False, "isolate_recompiles": True}
    # cpp_wrapper calls the kernels from C++ instead of Python: 13 % less time in an update
    functions = [torch.compile(function, **how, options={"cpp_wrapper": True})]
    text = "compiling the update: a quarter of a minute, once per machine ..."
    seconds = 5 if os.path.isdir(_compile_cache()) and os.listdir(_compile_cache()) else 0
    wait = [threading.Timer(seconds, tqdm.write, [text])] if sys.stdout.isatty() else []

    def call(*args):
        if wait:
            wait[0].start()
        try:
            return functions[0](*args)
        except Exception as error:  # no compiler, no Python headers, an unsupported platform, ...
            if functions[0] is function:
                raise
            reason = str(error).strip().split("\n")[0][:120]
            note = "going on without torch.compile, about 6 times slower in the update"
            tqdm.write(f"note: {note} ({reason})", file=sys.stderr)
            functions[0] = function
            return function(*args)
        finally:
            if wait:
                wait.pop().cancel()

    return call


# --- The files of a run


def run_path(args):
    """Path of a run's folder: it shows the experiment, environment, beta, n_envs and seed."""
    beta = "beta_" + ("auto" if args["beta_auto"] else "_".join(f"{b:g}" for b in args["beta"]))
    beta = "gsde" if args["method"] == "gsde" else "vanilla" if args["vanilla"] else beta
    env = re.sub(r"[/:\\]", "_", args["env_id"])
    path = Path(args["runs_dir"]) / args["exp_name"] / env / beta
    return path / f"n_envs_{args['n_envs']}" / f"seed_{args['seed']}"


class RunFolder:
    """The folder of one run, locked until the process ends. Used as `with run:` after start().

    Attributes: `summary` is that of a complete run, else None; `checkpoint` is the state to go on
    from, else None. Ends the program with one line where the folder is taken, not writable,
    damaged, or holds another run. Nothing in it is changed before start().

    Args:
        args: the run's arguments.
    """

    def __init__(self, args):
        args = vars(args)
        self.path, self.checkpoint, self.summary = run_path(args), None, None
        self._args, self._wandb, self._state, self._best = args, None, None, None
        self._start_time, self._earlier_seconds, self._written = time.time(), 0.0, 0.0
        if args["track"]:
            with one_line_for(ImportError, because="--track needs pip install wandb: "):
                import wandb  # noqa: F401
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = filelock.FileLock(self.path / "lock", timeout=0)  # until the process ends
            self._lock.acquire()
        except filelock.Timeout:
            fail(f"another process works on {self.path}: wait for it, or choose another --seed "
                 "or --exp-name", code=3)  # fmt: skip
        except OSError as error:
            fail(f"cannot write to {self.path} ({error.strerror}): choose another --runs-dir")
        if args["overwrite"]:
            return
        if not (self.path / "config.json").exists():
            for name in ("summary.json", "checkpoint.pt", "evaluations.csv"):
                if (self.path / name).exists():
                    fail(f"{self.path} has {name} but no config.json: restore it, or start again "
                         "with --overwrite")  # fmt: skip
            return
        config = self._read_json("config.json", "args", dict)
        longer = self._check_same_run(config["args"])
        if (self.path / "summary.json").exists() and not longer:
            self.summary = self._read_json("summary.json", "final_return", float)
        elif not args["resume"]:
            fail(f"{self.path} holds an unfinished run: add --resume to continue it, or "
                 "--overwrite to start again")  # fmt: skip
        elif (self.path / "checkpoint.pt").exists():
            self.checkpoint = self._read_checkpoint()
        if self.summary or self.checkpoint:
            consequence = "this one goes on" if self.checkpoint else "--overwrite runs it again"
            note_other_script(config, sys.argv[0], consequence)

    def start(self, step, **resolved):
        """Makes the folder ready to go on from this step: cut back to the checkpoint, or cleared.

        resolved: recorded in config.json beside the arguments.
        """
        if self._args["track"]:
            self._wandb = _start_wandb(self.path, self._args)
        with self._one_line_errors():
            if self.checkpoint:
                self._earlier_seconds = self.checkpoint["wall_seconds"]
                (self.path / "summary.json").unlink(missing_ok=True)  # of a run trained longer
                config = self._read_json("config.json", "args", dict)
                config["args"]["total_timesteps"] = self._args["total_timesteps"]
                config["script"] = script(sys.argv[0])
                self._write_json("config.json", config)
                self._cut_back(self.checkpoint["file_sizes"])
                self._best = self.checkpoint.get("best")
                if self._best:
                    self._save("best.pt", self._best)
            else:
                self._clear()
                config = {"args": self._args, "resolved": resolved, "versions": _versions()}
                config |= {"git_commit": _git_commit(), "script": script(sys.argv[0])}
                self._write_json("config.json", config)
                self._append("evaluations.csv", b"step,return_mean,return_std,length_mean\n")
            self._open_events()
        self._last_log = time.time(), step

    def __enter__(self):
        return self

    def __exit__(self, kind, error, _):
        if kind and issubclass(kind, Stopped):
            if self._state:  # else it is stopped before anything was learned
                with self._one_line_errors():
                    self._write_checkpoint()
            resume = "--resume" + " in place of --overwrite" * self._args["overwrite"]
            print(f"stopped: the same command with {resume} goes on from here", file=sys.stderr)

    def seconds(self):
        """Wall-clock seconds that the run has taken, over all its processes."""
        return self._earlier_seconds + time.time() - self._start_time

    def log(self, step, scalars):
        """Adds {tag: number} to TensorBoard at this step, in the file from the next keep() on."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        event = Event(wall_time=time.time(), step=step, summary=Summary(value=values))
        self._records.write(event.SerializeToString())
        if self._wandb:
            self._wandb.log(scalars, step=step)

    def is_log_due(self, step):
        """Whether to log now: after every update, or as often as gives 1000 points in all."""
        return (step - self._last_log[1]) * 1000 >= self._args["total_timesteps"]

    def log_rollout(self, step, episodes, scalars):
        """Logs scalars, speed, and the means of the episodes, a list of (return, length)."""
        if episodes:
            means = np.mean(episodes, axis=0).tolist()
            scalars = scalars | {"return_mean": means[0], "length_mean": means[1]}
        speed = (step - self._last_log[1]) / (time.time() - self._last_log[0])
        self._last_log = time.time(), step
        scalars = {f"rollout/{name}": value for name, value in scalars.items()}
        self.log(step, scalars | {"time/steps_per_second": speed})

    def is_video_due(self, step):
        """Whether the evaluation at this step is a tenth one or the last."""
        freq = self._args["eval_freq"]
        return step // freq % 10 == 0 or step + freq > self._args["total_timesteps"]

    def add_evaluation(self, step, returns, lengths, acting):
        """Appends a row to evaluations.csv. returns, lengths: (eval_episodes,).

        acting: dict of state_dicts, of all that acted; kept in best.pt if its mean return is best.
        """
        if not np.isfinite(returns).all():
            episode = np.flatnonzero(~np.isfinite(returns))[0]
            fail(f"return {returns[episode]} in {self._args['env_id']}, episode {episode} of the "
                 f"evaluation at step {step}: not finite, so its rewards are not")  # fmt: skip
        row = f"{step},{returns.mean():.9g},{returns.std():.9g},{lengths.mean():.9g}\n"
        with self._one_line_errors():
            self._append("evaluations.csv", row.encode())
            if self._best is None or returns.mean() > self._best["return_mean"]:
                best = {**acting, "step": step, "return_mean": returns.mean().item()}
                self._best = copy.deepcopy(best)
                self._save("best.pt", self._best)
        scalars = {"return_mean": returns.mean(), "return_std": returns.std()}
        scalars["length_mean"] = lengths.mean()
        self.log(step, {f"evaluation/{name}": value for name, value in scalars.items()})

    def keep(self, state, step, write):
        """Keeps `state`, a dict of tensors and plain values, to resume from at this step.

        It is written to checkpoint.pt where `write` says so, every few seconds, and on a signal.
        """
        with self._one_line_errors():
            if self._buffer.tell():
                self._append(self._events_name, self._buffer.getvalue())
                self._buffer.seek(0)
                self._buffer.truncate()
            sizes = self._sizes.copy()
            self._state = {**state, "global_step": step, "file_sizes": sizes, "best": self._best}
            if write or time.time() > self._written + SECONDS_BETWEEN_CHECKPOINTS:
                self._write_checkpoint()

    def finish(self, steps):
        """Writes summary.json, which makes the run complete, and says what is in it."""
        rows = (self.path / "evaluations.csv").read_text().splitlines()[1:]
        if len(rows) != self._args["total_timesteps"] // self._args["eval_freq"]:
            fail(f"{self.path / 'evaluations.csv'} was changed during the run: {len(rows)} rows")
        returns = [float(row.split(",")[1]) for row in rows]
        summary = {
            "performance": sum(returns) / len(returns),
            "final_return": returns[-1],
            "steps": steps,
            "wall_seconds": round(self.seconds(), 1),
        }
        with self._one_line_errors():
            self._write_json("summary.json", summary)
        if self._wandb:
            self._wandb.summary.update(summary)
            self._wandb.finish()
        print(f"performance {summary['performance']:.4g}, "
              f"final return {summary['final_return']:.4g}, "
              f"{summary['wall_seconds'] / 60:.1f} min: {self.path}")  # fmt: skip

    @contextlib.contextmanager
    def _one_line_errors(self):
        """For our own files; the same exceptions of an environment keep their traceback."""
        try:
            yield
        except OSError as error:
            fail(f"{error}; when that is mended, continue with --resume")

    def _write_checkpoint(self):
        self._save("checkpoint.pt", {**self._state, "wall_seconds": self.seconds()})
        self._written = time.time()

    def _save(self, name, state):
        data = io.BytesIO()  # straight to the file, torch.save raises no OSError on a full disk
        torch.save(state, data)
        self._write(name, data.getvalue())

    def _event_files(self):
        return sorted(path.name for path in self.path.glob("events.out.tfevents.*"))

    def _clear(self):
        """Removes what a run has left, summary first: without it, the rest is an unfinished run."""
        files = ("summary.json", "checkpoint.pt", "best.pt", "evaluations.csv")
        files += tuple(self._event_files())
        for name in (*files, "config.json"):
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.path / "videos", ignore_errors=True)
        self._sizes = {}

    def _check_same_run(self, recorded):
        """Refuses to mix runs: what decides the result must be as in the arguments recorded.

        Returns whether this is the same run, but longer.
        """
        old = ABSENT | recorded
        args = json.loads(json.dumps(self._args))
        total, old_total = args["total_timesteps"], old.get("total_timesteps")
        could_be = isinstance(old_total, int) and total > old_total
        longer = could_be and args["resume"]
        if longer and args["anneal_lr"]:
            fail("with --anneal-lr a run cannot be trained longer: its learning rate is made for "
                 f"--total-timesteps {old_total}", 2)  # fmt: skip
        finished = (self.path / "summary.json").exists()
        if longer and finished and not (self.path / "checkpoint.pt").exists():
            fail(f"{self.path} has no checkpoint.pt from which to train longer")
        for name in sorted((old.keys() | args.keys()) - FREE_ARGS):
            if old.get(name) != args.get(name) and not (longer and name == "total_timesteps"):
                flag = "--" + name.replace("_", "-")
                advice = "or --overwrite to replace it"
                if name == "total_timesteps" and could_be:
                    advice = "--resume to train it longer, or --overwrite to replace it"
                fail(f"the run in {self.path} has {flag} {old.get(name)}, not {args.get(name)}: "
                     f"choose another --exp-name, {advice}", 2)  # fmt: skip
        return longer

    def _read_checkpoint(self):
        path = self.path / "checkpoint.pt"
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            size = checkpoint["file_sizes"]["evaluations.csv"]
            if not {"agent", "wall_seconds"} <= checkpoint.keys():
                raise ValueError("it is of an earlier version of this code")
            rows = (self.path / "evaluations.csv").read_bytes()[:size].decode().split("\n")
            steps = range(self._args["eval_freq"], checkpoint["next_eval"], self._args["eval_freq"])
            if [row.split(",")[0] for row in rows] != ["step", *map(str, steps), ""]:
                raise ValueError("evaluations.csv is not what it was")
        except Exception as error:  # torch.load raises nearly anything on a damaged file
            reason = str(error).split(". ")[0][:100]
            fail(f"{path} is damaged ({reason}): restore it, or start again with --overwrite")
        next_eval, total = checkpoint["next_eval"], self._args["total_timesteps"]
        if next_eval < checkpoint["global_step"] and next_eval <= total:
            fail(f"the run in {self.path} cannot be trained longer: the policy to evaluate at step "
                 f"{next_eval} is gone")  # fmt: skip
        return checkpoint

    @contextlib.contextmanager
    def one_line_if_it_does_not_fit(self):
        """Around the loading of a checkpoint, maybe of other networks or noise."""
        try:
            yield
        except (KeyError, ValueError, RuntimeError, AttributeError) as error:
            fail(f"{self.path / 'checkpoint.pt'} does not fit this script ({error!s:.200}): undo "
                 "the edit, or choose another --exp-name, or --overwrite")  # fmt: skip

    def _cut_back(self, sizes):
        self._sizes = sizes
        for name in {*sizes, *self._event_files()}:
            file, size = self.path / name, sizes.get(name)
            if size is None:
                file.unlink()
            elif file.exists() and file.stat().st_size >= size:
                os.truncate(file, size)
            else:  # the curves of TensorBoard have a gap, but the run itself does not
                print(f"note: {name} is not what it was, some of TensorBoard's points are lost",
                      file=sys.stderr)  # fmt: skip
                sizes[name] = 0

    def _open_events(self):
        """Starts a new TensorBoard file. Records gather in memory and are appended by keep()."""
        now, host = time.time_ns() // 1000, socket.gethostname()
        self._events_name = f"events.out.tfevents.{now}.{host}.{os.getpid()}"
        self._buffer = io.BytesIO()
        self._records = RecordWriter(self._buffer)
        first = Event(wall_time=time.time(), file_version="brain.Event:2")
        self._records.write(first.SerializeToString())

    def _append(self, name, data):
        with open(self.path / name, "ab") as file:
            file.write(data)
        self._sizes[name] = self._sizes.get(name, 0) + len(data)

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

    def _read_json(self, name, key, kind):
        """The dict in the file, with a value of this kind behind the key."""
        try:
            value = json.loads((self.path / name).read_text())
            return value | {key: kind(value[key])}
        except (ValueError, RecursionError, TypeError, KeyError):
            fail(f"{self.path / name} is damaged: restore it, or start again with --overwrite")


def _versions():
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions


def script(path):
    """Name and checksum of a script, as config.json has those of the one that made the run."""
    with contextlib.suppress(OSError):
        return {"name": Path(path).name, "crc32": f"{zlib.crc32(Path(path).read_bytes()):08x}"}


def note_other_script(config, path, consequence):
    """Prints a line where another script than the one at `path` made the run of this config.json.

    Another version of it is another script.
    """
    ours, made_by = script(path), config.get("script")
    if ours and isinstance(made_by, dict) and made_by.get("crc32") != ours["crc32"]:
        which = f"{made_by.get('name')} made this run, and is not the {ours['name']} here"
        print(f"note: {which}: {consequence}", file=sys.stderr)


def _git_commit():
    """Commit of this code, with "-dirty" where files differ from it; None outside a checkout."""
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    command = ["git", "-C", str(Path(__file__).parent), *describe]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _start_wandb(path, args):
    import wandb

    name = "/".join(path.parts[-5:])
    # runs of other folders, and the same run started again, are other runs for W&B
    unique = f"{path.resolve()}{time.time() if args['overwrite'] else ''}"
    run_id = f"{zlib.crc32(unique.encode()):08x}-" + re.sub(r"[^\w.-]", "-", name)
    return wandb.init(
        project="ppo_colored_noise",
        id=run_id[-100:],
        name=name,
        dir=path,
        config=args,
        resume="allow",
        settings=wandb.Settings(silent=True),
    )
