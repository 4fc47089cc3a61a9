"""Runs as numbers: reading them, choosing what may be averaged, statistics, tables. Draws nothing.

    python analysis.py status runs/                    how far the runs in a folder are
    python analysis.py pack runs/ results/sweep.csv    a folder of runs as one small CSV, which
                                                       `plot.py results` reads like the folder

Sections named below are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI 2024,
with its appendix.
"""

import argparse
import gzip
import io
import json
import math
import os
import re
import sys
import warnings
from collections import Counter, defaultdict
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats
from tqdm import tqdm

from colored_noise import mean_std
from environments import NAMES, ids_named
from run_files import ABSENT, FREE_ARGS, fail

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

STUDY_BETAS = [-1, 0, 0.2, 0.5, 0.75, 1, 1.25, 2]
STUDY_N_ENVS = [1, 2, 4, 8, 16, 32, 64, 128]
METHODS = ["ppo", "trpo", "a2c", "gsde"]  # Sec. A7, A13
# The study's protocol (Sec. A5); also, bootstrap_timeouts is off for dm_control and on for the rest
# fmt: off
STUDY = {
    "method": "ppo", "total_timesteps": 2_048_000, "eval_freq": 10_240, "max_episode_steps": None,
    "noise_seq_len": 1000, "n_steps": 2048, "batch_size": 128, "n_epochs": 10, "gamma": 0.99,
    "learning_rate": 2.5e-4, "anneal_lr": False, "gae_lambda": 0.95, "clip_range": 0.2,
    "normalize_advantage": True, "ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5,
    "env_kwargs": None, "rescale_actions": False, "normalize_obs": False,
    "normalize_rewards": False,
}
# fmt: on
# What methods have in common that are compared
SHARED = ["total_timesteps", "eval_freq", "max_episode_steps", "noise_seq_len", "gamma"]
SHARED += ["anneal_lr", "bootstrap_timeouts", "env_kwargs", "rescale_actions", "normalize_obs"]
SHARED += ["normalize_rewards"]
# The study varies AXES. Other arguments must not vary within an environment, but these: EVALUATION
# changes how closely a policy's return is measured, and not what its mean is; FREE_ARGS change
# nothing; NOT_ARGUMENTS are no arguments, or shown by others.
AXES = ["environment", "beta", "n_envs", "n_steps", "n_epochs", "seed"]
EVALUATION = ["eval_episodes", "eval_once_per_policy"]
NOT_ARGUMENTS = ["path", "source", "status", "git_commit", "wall_seconds", "performance"]
NOT_ARGUMENTS += ["final_return", "exp_name", "env_id", "vanilla", "threads", "beta_auto"]
WHOLE = ["n_envs", "n_steps", "n_epochs", "seed"]
CELL = ["environment", "n_envs"]


class Unusable(Exception):
    """These runs cannot be used, or nothing can be made of them; the message says why."""


def need(condition, what):
    if not condition:
        raise Unusable(f"needs {what}")


# --- Reading runs ---------------------------------------------------------------------------------


def beta_text(beta):
    """Text of one beta: "0.5"; "0" for -0.0; "vanilla" for NaN, which stands for vanilla PPO."""
    return "vanilla" if np.isnan(beta) else f"{beta + 0.0:g}"


def betas_text(text):
    """Canonical text of a run's noise: "vanilla", "0.5", or "0.5_1" for one per action dimension.

    "gsde" stands for gSDE, which has no beta. Raises ValueError where a number is not one, or not
    finite.
    """
    betas = [] if text in ("vanilla", "gsde") else [float(part) for part in text.split("_")]
    if not all(map(math.isfinite, betas)):
        raise ValueError(f"beta {text} is not finite")
    return "_".join(map(beta_text, betas)) or text


def by_beta(texts):
    """Texts as of `betas_text` in the order of their (first) betas, "vanilla" last."""
    return sorted(texts, key=lambda text: float(text.replace("vanilla", "inf").split("_")[0]))


def run_folders(root, marks):
    """The folders at and under `root` that hold a file of a name in `marks`, in order.

    Symbolic links are followed, and each folder is visited once, so that they may form circles.
    """
    found, seen = [], set()
    for folder, folders, files in os.walk(root, followlinks=True):
        info = os.stat(folder)
        if (info.st_dev, info.st_ino) in seen:
            folders.clear()
            continue
        seen.add((info.st_dev, info.st_ino))
        folders.sort()
        if not marks.isdisjoint(files):
            found.append(Path(folder))
    return found


def read_run(folder):
    """Reads one run's folder, whatever its state.

    Returns:
        run: dict of its arguments, with `beta` as text (see `betas_text`), and `status`:
            "complete", "unfinished: ..." without summary.json, or "damaged: ...".
        steps, returns: (n_evaluations,) environment step and mean return of each evaluation.
    """
    run, steps, returns = {}, np.zeros(0, int), np.zeros(0)
    complete = (folder / "summary.json").exists()
    try:
        config = json.loads((folder / "config.json").read_text())
        args = config["args"]
        if any(isinstance(value, float) and not math.isfinite(value) for value in args.values()):
            raise ValueError("config.json has a number that is not finite")
        whole = {key: int(args[key]) for key in WHOLE}
        if not all((key != "seed") <= value < 2**63 for key, value in whole.items()):
            raise ValueError("config.json has a whole number that is too large or too small")
        beta = "vanilla" if args["vanilla"] else "_".join(map(str, args["beta"]))
        known = {"env_id": str(args["env_id"]), "beta": betas_text(beta)}
        expected = int(args["total_timesteps"]) // int(args["eval_freq"])
        run = {**args, **whole, **known, "git_commit": config["git_commit"]}
        run["script"] = (config.get("script") or {}).get("name")
        if args.get("env_kwargs") is not None:
            run["env_kwargs"] = json.dumps(args["env_kwargs"], sort_keys=True)
        rows = (folder / "evaluations.csv").read_text().splitlines()[1:]
        table = np.array([row.split(",")[:2] for row in rows], float).reshape(-1, 2)
        steps, returns = table[:, 0].astype(int), table[:, 1]
        run["status"] = f"unfinished: {len(steps)} evaluations, no summary.json"
        if complete:
            summary = json.loads((folder / "summary.json").read_text())
            run |= {"status": "complete", "wall_seconds": float(summary["wall_seconds"])}
            if not np.isfinite(returns).all() or (np.diff(steps) <= 0).any():
                raise ValueError("evaluations.csv is not a series of finite returns")
            if len(returns) != expected or not expected:
                raise ValueError(f"{len(returns)} of {expected} evaluations")
            said = [summary["performance"], summary["final_return"]]
            if not np.allclose(said, [returns.mean(), returns[-1]], rtol=1e-4, atol=1e-4):
                raise ValueError("summary.json does not agree with evaluations.csv")
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        run["status"] = f"{'unfinished' if run and not complete else 'damaged'}: {error!r}"
    except (ArithmeticError, RecursionError) as error:  # of JSON that is nested, or infinite
        run["status"] = f"damaged: {error!r}"
    return run, steps, returns


def read_folder(path):
    """Reads all runs under a folder: (runs, curves) as in `load`."""
    folders = run_folders(path, {"config.json", "evaluations.csv", "summary.json"})
    progress = tqdm(folders, desc=f"reading {path}", unit=" runs", mininterval=0.5)
    read = [read_run(folder) for folder in progress]
    runs = pd.DataFrame([run for run, _, _ in read])
    seeds = [run.get("seed", np.nan) for run, _, _ in read]
    runs["seed"] = pd.Series(seeds, dtype=object)  # where one is missing, large ones stay exact
    runs["path"] = [folder.relative_to(path).as_posix() for folder in folders]
    all_steps = np.unique(np.concatenate([np.zeros(0, int), *(steps for _, steps, _ in read)]))
    curves = np.full((len(read), len(all_steps)), np.nan)
    for row, (_, steps, returns) in zip(curves, read, strict=True):
        row[np.searchsorted(all_steps, steps)] = returns
    return runs, pd.DataFrame(curves, columns=all_steps)


def read_packed(path):
    """Reads a file that `pack` wrote: (runs, curves) as in `load`; a row cut short is "damaged"."""
    with open(path, "rb") as file:
        data = file.read()
    try:
        data = gzip.decompress(data) if path.suffix == ".gz" else data
        text = dict.fromkeys(("seed", "beta", "env_id", "status", "path"), str)
        runs = pd.read_csv(io.BytesIO(data), dtype=text, index_col=False, low_memory=False)
        columns = [column for column in runs if column.isdecimal()]
        numbers = runs[[*WHOLE, "total_timesteps", "eval_freq"]]
        runs[[*text]]
        if runs.empty:
            raise ValueError("no run in it")
    except Exception as error:  # pandas and gzip raise nearly anything on what is not theirs
        reason = f"not a file that `analysis.py pack` wrote, or damaged: {error}"
        raise Unusable(f"{path} is {reason}") from None
    curves = runs[columns].apply(pd.to_numeric, errors="coerce").rename(columns=int)
    runs = runs.drop(columns=columns)
    numbers = numbers.apply(pd.to_numeric, errors="coerce")
    seeds = [
        int(text) if str(text).isdecimal() else number
        for text, number in zip(runs.seed, numbers.seed, strict=True)
    ]
    runs[WHOLE] = numbers[WHOLE]
    runs["seed"] = pd.Series(seeds, runs.index, object)

    found, expected = np.isfinite(curves).sum(axis=1), numbers.total_timesteps // numbers.eval_freq
    lines = [f"{n} of {m:g} evaluations" for n, m in zip(found, expected, strict=True)]
    damaged = pd.Series(lines, runs.index).where(found != expected, "")
    damaged[numbers.isna().any(axis=1) | runs.env_id.isna() | runs.beta.isna()] = "settings"
    for row, beta in runs.beta.dropna().items():
        try:
            runs.loc[row, "beta"] = betas_text(beta)
        except ValueError:
            damaged[row] = f"beta {beta}"
    if not data.endswith(b"\n"):  # the last number may lack digits
        damaged.iloc[-1] = f"cut off in evaluation {found.iloc[-1]}"
    cut = ~runs.status.str.match("complete$|unfinished:|damaged:", na=False)
    runs.loc[cut | (runs.status == "complete") & (damaged != ""), "status"] = "damaged: " + damaged
    return runs.assign(path=runs.path.fillna("(cut off)")), curves


def load(paths, env=None, beta=None, n_envs=None):
    """Reads the runs in folders and in files that `pack` wrote; keeps those that are asked for.

    env, beta, n_envs: lists, or None for all: ids, short as in cheetah-run or not, or names in the
        paper; beta as text.

    Returns:
        runs: a row per run, whatever its state; columns as in `read_run`, `source` and `path`
            (where it was found), `environment` (its name in the paper), `performance` and
            `final_return`.
        curves: rows with the index of `runs`, a column per environment step: the mean return
            evaluated there, or NaN.
        Both are ordered by environment, beta, n_envs, n_steps, n_epochs and seed.

    Raises Unusable where there is nothing to read or nothing of a kind that is asked for, OSError
    where it cannot be read.
    """
    tables = []
    for path in map(Path, paths):
        runs, curves = read_folder(path) if path.is_dir() else read_packed(path)
        if runs.empty:
            made_by = "ppo_colored_continuous.py and run_sweep.sh make them"
            failed = "`analysis.py status` lists those that failed at once"
            raise Unusable(f"no runs in {path}: {made_by}, {failed}")
        tables.append((runs.assign(source=str(path)), curves))
    runs, curves = (pd.concat(parts, ignore_index=True) for parts in zip(*tables, strict=True))
    needed = ["env_id", "script", *AXES, *ABSENT]
    runs = runs.reindex(columns=runs.columns.union(needed, sort=False))
    for argument, value in ABSENT.items():
        runs[argument] = runs[argument].astype(object).where(runs[argument].notna(), value)
    usual = runs.method.map({"ppo": "ppo_colored_continuous.py"}).fillna("baselines.py")
    runs["script"] = runs.script.astype(object).fillna(usual)  # older runs do not say
    # gSDE does not use the beta of its arguments
    runs["beta"] = runs.beta.astype(object).mask(runs.method == "gsde", "gsde")
    names = runs.env_id.map(lambda env_id: NAMES.get(env_id, env_id), na_action="ignore")
    runs["environment"] = names
    # Sec. "Evaluation Details": performance is the mean over all evaluations, the area under the
    # learning curve
    curves = curves.sort_index(axis=1)
    runs["performance"] = curves.mean(axis=1).round(9)  # the digits behind depend on other rows
    runs["final_return"] = curves.ffill(axis=1).iloc[:, -1] if len(curves.columns) else np.nan
    ids = runs.env_id.dropna().unique()
    env = env and [env_id for value in env for env_id in ids_named(value, ids) or [value]]
    keep = pd.Series(True, runs.index)
    for flag, wanted in (("env", env), ("beta", beta), ("n_envs", n_envs)):
        columns = ["environment", "env_id"] if flag == "env" else [flag]
        for value in wanted or []:
            if not (runs[columns] == value).any(axis=None):
                there = ", ".join(f"{x:g}" if flag == "n_envs" else x for x in present(runs, flag))
                flag = flag.replace("_", "-")
                raise Unusable(f"no runs with --{flag} {value}; there are: {there or 'none'}")
        asked = runs[columns].isin(wanted or []).any(axis=1) | (not wanted)
        keep &= asked | (flag == "beta") & (runs.method == "gsde")  # which has no beta
    need(keep.any(), "runs that have all of --env, --beta and --n-envs: there are none")
    keep |= runs.env_id.isna()  # damaged ones stay, to be listed
    # Bootstraps draw by position: in whatever order runs are read, their intervals are the same
    numbers = runs[keep][AXES[2:]].apply(pd.to_numeric, errors="coerce")
    order = runs[AXES[:2]].astype(str).join(numbers, how="right").sort_values(AXES, kind="stable")
    return runs.loc[order.index], curves.loc[order.index]


def present(runs, flag):
    """The values that a filter may have."""
    values = runs[{"env": "environment"}.get(flag, flag)].dropna().unique()
    if flag != "beta":
        return sorted(values)
    return by_beta([text for text in values if text != "gsde"])


def pack(runs, curves, file, inputs=(), overwrite=False):
    """Writes runs, complete or not, to a CSV that `load` reads, compressed where it ends in .gz.

    A row per run with its settings and a column per step. The file is replaced at once, or not at
    all. Raises Unusable where it exists without `overwrite`, or is one of the `inputs`.
    """
    file = Path(file)
    if file.exists():
        if any(os.path.samefile(file, path) for path in inputs):
            raise Unusable(f"{file} is read here as well: give the file to write last")
        if file.is_dir() or not overwrite:
            advice = "give the file to write last, or --overwrite to replace it"
            raise Unusable(f"{file} exists: {advice}")
    derived = ["source", "environment", "performance", "final_return"]
    derived += ["runs_dir", "resume", "overwrite"]
    table = runs.drop(columns=derived, errors="ignore").dropna(axis=1, how="all")
    text = pd.concat([table, curves], axis=1).to_csv(index=False, float_format="%.9g").encode()
    temporary = file.with_name(f"{file.name}.tmp")
    try:
        temporary.write_bytes(gzip.compress(text, mtime=0) if file.suffix == ".gz" else text)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


# --- What may be averaged -------------------------------------------------------------------------


def value_text(value):
    """Text of an argument that is the same for 1, 1.0 and a 1 read from a CSV."""
    if isinstance(value, str | bool | np.bool_) or value is None:
        return str(value)
    try:
        number = float(value)
    except (TypeError, ValueError):
        return str(value)
    if math.isnan(number):
        return "None"
    return f"{number:.9g}" if number % 1 else str(int(number))


def flag_text(argument, text):
    """An argument as one types it: "--gamma 0.9", "--envpool", "no --envpool"; a script's name."""
    if argument == "script":
        return text
    flag = f"--{argument.replace('_', '-')}"
    return {"True": flag, "False": f"no {flag}", "None": f"no {flag}"}.get(text, f"{flag} {text}")


def select(runs, method="ppo"):
    """Chooses the runs to average: complete, of one method, each setting and seed once.

    Returns them, with `beta` a number (NaN for vanilla PPO), and a line for each that is left out.
    Raises Unusable where there are none, or where the script or another argument than those that
    are listed at the top of this file varies within an environment, or the same settings and seed
    are in two experiments: of one of them the script may have been edited.
    """
    status = runs.status.copy()
    other = (status == "complete") & (runs.method != method)
    status[other] = "another method, " + runs.method.astype(str)
    complete = runs[status == "complete"]
    per_dimension = complete.beta.astype(str).str.contains("_")
    status[complete.index[complete.duplicated(AXES)]] = "the same settings and seed as another run"
    status[complete.index[per_dimension]] = "one beta per action dimension is not in the study"
    places = runs.source + "/" + runs.path + ": "
    left_out = (places + status)[status != "complete"].tolist()
    chosen = runs[status == "complete"]
    if chosen.empty:
        what = f"no complete run of these environments, betas and n_envs with the method {method}"
        raise Unusable("; ".join([what, *left_out[:1]]))
    compared = complete.columns.difference([*AXES, *EVALUATION, *FREE_ARGS, *NOT_ARGUMENTS])
    twice = complete[complete.duplicated(AXES, keep=False)]
    for part, arguments in ((complete, compared), (twice, ["exp_name"])):
        for (environment, group), argument in product(part.groupby("environment"), arguments):
            values = sorted(set(map(value_text, group[argument])))
            if len(values) > 1:
                mix = " and ".join(flag_text(argument, value) for value in values[:3])
                advice = "give the folder of one experiment, or filter by --env, --beta, --n-envs"
                what = f"{environment} has runs with {mix}, which must not be averaged"
                raise Unusable(f"{what}: {advice}")
    beta = pd.to_numeric(chosen.beta, errors="coerce")
    chosen = chosen.astype(dict.fromkeys(WHOLE, int))
    return chosen.assign(beta=beta, vanilla=chosen.beta == "vanilla"), left_out


def select_methods(runs, method="ppo"):
    """`select` for a method, and for the paper's other methods, never averaged with it.

    Returns a dict, method: its runs, the first `method` even if it has none, then those that have
    any; and the lines of all. Raises Unusable where no method has any.
    """
    none = runs[:0].astype({**dict.fromkeys(WHOLE, int), "beta": float})
    chosen, left_out = {method: none.assign(vanilla=np.zeros(0, bool))}, []
    complete = set(runs.method[runs.status == "complete"])
    for name in dict.fromkeys([method, *METHODS]):
        apart = set(METHODS) - {method} if name == method else set(runs.method) - {name}
        part = runs[~runs.method.isin(apart)]
        if name in complete or name == method and not complete & set(METHODS):
            chosen[name], lines = select(part, name)
        else:
            lines = (part.source + "/" + part.path + ": " + part.status).tolist()
        left_out += lines
    return chosen, left_out


def same_protocol(runs, arguments=SHARED):
    """The runs; raises Unusable where methods to compare differ in what they share."""
    for environment, group in runs.groupby("environment"):
        for argument in arguments:
            texts = sorted(set(group[argument].map(value_text))) if argument in group else []
            if len(texts) > 1:
                flags = " and ".join(flag_text(argument, text) for text in texts[:3])
                raise Unusable(f"needs methods with the same protocol: {environment} has {flags}")
    return runs


def mixed_evaluations(runs):
    """A line for each environment whose runs were evaluated in different ways (EVALUATION)."""
    lines = []
    for environment, group in runs.groupby("environment"):
        for argument in set(EVALUATION) & set(group):
            counts = Counter(map(value_text, group[argument]))
            if len(counts) > 1:
                parts = [f"{flag_text(argument, key)} ({n} runs)" for key, n in counts.items()]
                lines.append(f"{environment}: {' and '.join(sorted(parts))}")
    return sorted(lines)


def main_grid(runs):
    """The runs with the study's n_steps and n_epochs, 2048 and 10, or else the most frequent ones.

    Returns them, and a line for each environment that has no such runs.
    """
    if runs.empty:
        return runs, []
    settings = pd.Series(list(zip(runs.n_steps, runs.n_epochs, strict=True)), index=runs.index)
    setting = (2048, 10) if (2048, 10) in set(settings) else settings.mode()[0]
    grid, dropped = runs[settings == setting], []
    for environment, group in settings.groupby(runs.environment):
        if setting not in set(group):
            flags = [f"--n-steps {steps} --n-epochs {epochs}" for steps, epochs in set(group)]
            dropped.append(f"{environment}: {', '.join(sorted(flags))}, not {setting}")
    return grid, dropped


def missing(runs):
    """Lines for the runs that are not there of the grid they span.

    That is every environment x n_envs x beta x seed found.
    """
    axes = ["environment", "n_envs", "beta", "seed"]
    runs = runs.assign(beta=runs.beta.map(beta_text))[axes]
    grid = pd.MultiIndex.from_product([sorted(runs[axis].unique()) for axis in axes], names=axes)
    lacking = grid.difference(pd.MultiIndex.from_frame(runs)).to_frame(index=False)
    seeds = lacking.groupby(axes[:3]).seed.agg(lambda seeds: " ".join(map(str, seeds)))
    betas = seeds.reset_index().groupby(["environment", "n_envs", "seed"]).beta.agg(" ".join)
    return [f"{env}, n_envs {n}: beta {b}, seeds {seeds}" for (env, n, seeds), b in betas.items()]


def comparable(runs, axes, cells):
    """The runs of the cells that have all values of `axes` which occur in these runs.

    An average over cells compares values of an axis only where each is of the same cells. If cells
    are there with two seeds of each value, only those: a single run has no scatter, and one such
    cell would leave an average without an interval. axes, cells: lists of columns. Raises Unusable
    where no cell has all.
    """
    values = runs.groupby(axes).ngroup()
    there = values.groupby([runs[column] for column in cells]).transform("nunique")
    chosen, n = runs[there == values.nunique()], values.nunique()
    what = f"one {' and '.join(cells)} with all {n} values of {' and '.join(axes)}"
    need(len(chosen), f"{what}: filter by --env, --beta, --n-envs")
    seeds = chosen.groupby([*cells, *axes]).seed.transform("nunique")
    two = seeds.groupby([chosen[column] for column in cells]).transform("min") > 1
    return chosen[two] if two.any() else chosen


def published(name):
    """One of the paper's tables, results/published/NAME.csv."""
    return pd.read_csv(Path(__file__).parent / "results" / "published" / f"{name}.csv")


def differences(runs, arguments=tuple(STUDY)):
    """Which flags differ from the study's protocol: a Series like runs of text, "" where none."""
    flags = pd.Series("", index=runs.index)
    for argument in [argument for argument in STUDY if argument in arguments and argument in runs]:
        texts = runs[argument].map(value_text)
        other = texts[texts != value_text(STUDY[argument])]
        flags[other.index] += [f"{flag_text(argument, text)}, " for text in other]
    if "bootstrap_timeouts" in runs:
        off = runs.env_id.str.startswith("dm_control/")
        wrong = runs.bootstrap_timeouts.eq(True) == off
        flags[wrong & off] += "--bootstrap-timeouts, "
        flags[wrong & ~off] += "--no-bootstrap-timeouts, "
    return flags.str.removesuffix(", ")


def beside_paper(table, runs, paper):
    """`table` with the columns of `paper` beside its own, both with the same index.

    Where the runs' protocol is not the study's, they are blank and `differs` names the flags.
    """
    keys = [runs[key] for key in table.index.names]
    flags = differences(runs).groupby(keys).agg(lambda texts: "; ".join(sorted(set(texts) - {""})))
    table = table.join(paper).assign(differs=flags)
    table.loc[table.differs != "", paper.columns] = np.nan
    return table if table.differs.any() else table.drop(columns="differs")


# --- Statistics -----------------------------------------------------------------------------------


def standardize(runs):
    """Performance of the runs, standardized over all of them in the same environment: a Series.

    Sec. "Evaluation Details": "results are grouped by environment and standardized to zero mean and
    unit variance to control for the impact of the environments. We combine these standardized
    results by averaging across different environments and seeds." In an environment without
    variance all are 0.
    """

    def z(x):
        return (x - x.mean()) / x.std(ddof=0) if np.ptp(x) > 0 else 0 * x

    return runs.groupby("environment").performance.transform(z)


def mean_interval(values, n_resamples=9999):
    """Mean over the first axis, its 95 % BCa bootstrap interval as in all the paper's figures.

    values: (runs,) or (runs, steps). Returns mean, low, high. One run has no interval (NaN); of
    equal values the interval is that value.
    """
    values = np.asarray(values, float)
    mean = values.mean(axis=0)
    low, high = np.array(mean), np.array(mean)
    varies = np.ptp(values, axis=0) > 0  # BCa is not defined for equal values
    if len(values) < 2:
        low, high = low * np.nan, high * np.nan
    elif varies.any():
        how = {"n_resamples": n_resamples, "batch": 1000, "rng": np.random.default_rng(0)}
        result = stats.bootstrap([values.T[varies]], np.mean, axis=-1, method="BCa", **how)
        low[varies], high[varies] = result.confidence_interval
    return mean, low, high


def mean_intervals(runs, column, by):
    """`mean_interval` of a column in each group of runs: a DataFrame of mean, low, high, runs."""
    groups = runs.groupby(by)[column]
    rows = [[*mean_interval(values), len(values)] for _, values in groups]
    return pd.DataFrame(rows, groups.mean().index, columns=["mean", "low", "high", "runs"])


def cells_interval(samples):
    """Mean over cells of the mean over each cell's runs, with a 95 % BCa bootstrap interval.

    The seeds are drawn within cells: environments and n_envs are the study's choice, not chance.
    Each cell weighs the same, however many seeds it has. Drawing n of n seeds makes the variance of
    their mean too small, by (n - 1) / n; they are spread by the root of its inverse (as Rao and Wu
    1988), since cells of two or three seeds would have half of it. samples: arrays (runs,), one per
    cell. Returns mean, low, high; NaN where a cell has one run, whose scatter is not known.
    """

    def mean(*cells, axis=-1):
        return np.mean([np.mean(cell, axis=axis) for cell in cells], axis=0)

    samples = [np.asarray(cell, float) for cell in samples]
    center = mean(*samples)
    if min(map(len, samples)) < 2:
        return center, np.nan, np.nan
    if not any(np.ptp(cell) > 0 for cell in samples):
        return center, center, center
    samples = [x.mean() + (x - x.mean()) * (len(x) / (len(x) - 1)) ** 0.5 for x in samples]
    how = {"n_resamples": 9999, "batch": 500, "rng": np.random.default_rng(0), "vectorized": True}
    return center, *stats.bootstrap(samples, mean, method="BCa", **how).confidence_interval


def cells_intervals(runs, column, by, cells):
    """`cells_interval` in each group of runs: a DataFrame of mean, low, high, number of runs."""
    rows = {}
    for value, group in runs.groupby(by):
        samples = [values for _, values in group.groupby(cells)[column]]
        rows[value] = [*cells_interval(samples), len(group)]
    table = pd.DataFrame.from_dict(rows, "index", columns=["mean", "low", "high", "runs"])
    return table.rename_axis(by)


def weighted(x, weights=None):
    """Mean, standard deviation and size of a sample, (runs,) or (samples, runs), for `welch`.

    A weighted sample counts as 1 / sum(weights^2) runs (Kish).
    """
    x = np.asarray(x, float)
    w = np.ones(x.shape[-1]) if weights is None else np.asarray(weights, float)
    w = w / w.sum()
    mean, squares = x @ w, (w**2).sum()
    variance = (x - mean[..., None]) ** 2 @ w / (1 - squares)
    return mean, variance**0.5, 1 / squares


def welch(a, b, weights_a=None, weights_b=None):
    """p-value of Welch's t-test (Table 1), of weighted means where there are weights.

    NaN with fewer than two runs on a side, 1 where all values are the same.
    """
    if min(len(a), len(b)) < 2:
        return np.nan
    if np.ptp([*a, *b]) == 0:
        return 1.0
    sides = [*weighted(a, weights_a), *weighted(b, weights_b)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scipy's, about values nearly the same
        return stats.ttest_ind_from_stats(*sides, equal_var=False).pvalue


# --- Tables ---------------------------------------------------------------------------------------


def best_beta_per_env(runs):
    """Table 1: the beta of best mean performance, by Welch's t-test against 0.5, 0 and 1.

    Over all n_envs that have all the environment's betas, each weighing the same, and all seeds. A
    fixed beta is "outperformed" where p < 0.05, else "comparable"; blank where nothing is tested:
    fewer than two runs of it or of the best, or no other beta.
    """
    rows = []
    for environment, group in runs.groupby("environment"):
        try:
            group = comparable(group, ["beta"], ["n_envs"])
        except Unusable:
            rows.append({"environment": environment, "best_beta": np.nan})
            continue
        cells = group.groupby(["n_envs", "beta"]).performance
        group = group.assign(weight=1 / cells.transform("size"))
        means = cells.mean().groupby("beta").mean()
        best = means.idxmax()
        sides = {beta: side for beta, side in group.groupby("beta") if len(side) > 1}
        row = {"environment": environment, "best_beta": best}
        for beta in (0.5, 0.0, 1.0):
            p, verdict = np.nan, ""
            if len(sides) > 1 and beta in sides and best in sides:
                if beta != best:
                    both = [sides[best], sides[beta]]
                    p = welch(*(side.performance for side in both), *(side.weight for side in both))
                verdict = "outperformed" if p < 0.05 else "comparable"
            row |= {f"beta_{beta}": verdict, f"p_{beta}": p}
        rows.append(row | {"runs": len(group)})
    paper = published("best_beta_per_env").set_index("environment")
    paper = paper.replace({"yes": "comparable", "no": "outperformed"})
    paper = paper.rename(columns=lambda name: "paper_" + name.removesuffix("_comparable"))
    table = beside_paper(pd.DataFrame(rows).set_index("environment"), runs, paper).reset_index()
    counts = {"environment": "comparable in"}
    for column in table.filter(regex="beta_[01]"):
        verdicts = table[column][table[column].isin(["comparable", "outperformed"])]
        counts[column] = f"{(verdicts == 'comparable').sum()}/{len(verdicts)}"
    return pd.concat([table, pd.DataFrame([counts])], ignore_index=True)


def best_beta_per_n_envs(runs):
    """Sec. A2: the beta of highest standardized performance for each n_envs.

    Averaged over the environments that have all betas there, and seeds. Zero is the mean of all
    the runs here, so the value, unlike the beta, is as in the paper only for the whole grid.
    """
    runs, rows = runs.assign(z=standardize(runs)), []
    for n_envs, group in runs.groupby("n_envs"):
        try:
            group = comparable(group, ["beta"], ["environment"])
        except Unusable:
            continue
        table = cells_intervals(group, "z", "beta", ["environment"])
        best = table["mean"].idxmax()
        row = {"n_envs": n_envs, "best_beta": best, "environments": group.environment.nunique()}
        row |= table.loc[best].rename({"mean": "standardized_performance"}).to_dict()
        rows.append(row | {"runs": len(group)})
    need(rows, "an environment with all betas at one n_envs")
    paper = published("best_beta_per_n_envs").set_index("n_envs").add_prefix("paper_")
    return beside_paper(pd.DataFrame(rows).set_index("n_envs"), runs, paper).reset_index()


def performance_grid(runs):
    """Standardized performance, a row per beta and a column per n_envs; NaN where there is none.

    Averaged over the environments that have all the combinations found, each weighing the same.
    Returns the grid and the runs that it is made of.
    """
    runs = comparable(runs, ["n_envs", "beta"], ["environment"])
    runs = runs.assign(z=standardize(runs))
    cells = runs.groupby(["beta", "n_envs", "environment"]).z.mean()
    return cells.groupby(["beta", "n_envs"]).mean().unstack(), runs


def projected_ranks(best, betas, n_envs, seq_len=1000):
    """Ranks of the betas for each n_envs as projected from the bias of the noise, 1 the best.

    Sec. "Why Do Larger beta Work Better for Larger n_envs": the mean of a sequence has the standard
    deviation sigma(beta), that of N pooled sequences sigma_hat = sigma(beta) / sqrt(N). Its optimum
    sigma* is the average for the best beta of each n_envs; E_ij = (sigma* - sigma_hat(beta_i,
    N_j))^2 is ranked within each N_j.

    best: Series of the best beta, its index n_envs. Returns a DataFrame, betas by n_envs.
    """

    def sigma_hat(beta, n):
        return mean_std(np.array(beta, float), seq_len).numpy() / np.sqrt(n)

    sigma_star = sigma_hat(best, best.index.to_numpy()).mean()
    E = (sigma_star - sigma_hat(np.array(betas)[:, None], np.array(n_envs))) ** 2
    return pd.DataFrame(E, index=betas, columns=n_envs).rank()


def final_return_and_performance(runs):
    """Sec. A9: mean and maximum over all betas, n_envs and seeds, without vanilla PPO.

    `cells`: how many of beta and n_envs there are, 64 in the paper; all weigh the same in the mean.
    """
    keys, measures = [*CELL, "beta"], ["final_return", "performance"]
    cells = runs.groupby(keys)[measures].mean().groupby("environment")
    means, largest = cells.mean(), runs.groupby("environment")[measures].max()
    table = pd.DataFrame(index=means.index)
    for measure in measures:
        table[f"{measure}_mean"], table[f"{measure}_max"] = means[measure], largest[measure]
    table["cells"] = cells.size()
    paper = published("final_return_and_performance").set_index("environment").add_prefix("paper_")
    return beside_paper(table, runs, paper).reset_index()


def final_returns(runs):
    """Sec. A14: final return per environment, n_envs and beta, ours beside the published mean.

    `in_interval`: whether our interval holds the published mean, which is rounded to one decimal.
    """
    cell = [*CELL, "beta"]
    runs = runs.assign(beta=runs.beta.map(beta_text))
    paper = published("final_return_per_beta").set_index(cell)[["final_return_mean"]]
    table = mean_intervals(runs, "final_return", cell)
    table = beside_paper(table, runs, paper.set_axis(["paper"], axis=1))
    known = table.dropna(subset=["low", "paper"])
    holds = known.paper.between(known.low - 0.05, known.high + 0.05)
    return table.assign(in_interval=holds.map({True: "yes", False: "no"})).reset_index()


def final_return_per_beta(table):
    """The table of `final_returns` for readers, a row per environment and n_envs, rounded.

    Columns of each beta: "mean [low, high]" and the published mean, "(outside)" where our interval
    does not hold it.
    """
    rows = []
    for key, cells in table.groupby(CELL):
        row = dict(zip(CELL, key, strict=True)) | {"runs": cells.runs.sum()}
        for cell in cells.to_dict("records"):
            interval = "" if pd.isna(cell["low"]) else " [{low:z.1f}, {high:z.1f}]".format(**cell)
            outside = " (outside)" if cell["in_interval"] == "no" else ""
            paper = "" if pd.isna(cell["paper"]) else f"{cell['paper']:z.1f}{outside}"
            row[f"beta {cell['beta']}"] = f"{cell['mean']:z.1f}{interval}"
            row[f"paper, {cell['beta']}"] = paper
        if "differs" in cells:
            row["differs"] = "; ".join(sorted(set(cells.differs) - {""}))
        rows.append(row)
    columns = [f"{of} {beta}" for beta in by_beta(table.beta.unique()) for of in ("beta", "paper,")]
    differs = ["differs"] if "differs" in table else []
    return pd.DataFrame(rows, columns=[*CELL, "runs", *columns, *differs])


def on_published_scale(runs):
    """Final returns with 0 for the environment's lowest published mean and 1 for its highest.

    Returns the runs with the study's protocol whose cells are published: `final_return` on that
    scale, and so `paper`, the cell's published mean.
    """
    paper = published("final_return_per_beta").rename(columns={"final_return_mean": "paper"})
    paper = paper[paper.beta != "vanilla"].astype({"beta": float})
    ends = paper.groupby("environment").paper.agg(["min", "max"])
    runs = runs[differences(runs) == ""].merge(paper, on=[*CELL, "beta"])
    need(len(runs), "runs of the study's protocol, n_envs and betas")
    low, high = (runs.environment.map(ends[end]) for end in ends)
    both = {column: (runs[column] - low) / (high - low) for column in ("final_return", "paper")}
    return runs.assign(**both)


def average_final_returns(runs):
    """Sec. A14 averaged over environments: ours beside the paper's, of the same environments.

    On the scale of `on_published_scale`. A row per n_envs and beta, of the environments that have
    all betas with that n_envs, and two seeds of each if any has.
    """
    tables = []
    for n_envs, group in on_published_scale(runs).groupby("n_envs"):
        try:
            group = comparable(group, ["beta"], ["environment"])
        except Unusable:
            continue
        table = cells_intervals(group, "final_return", "beta", ["environment"])
        cells = group.groupby(["beta", "environment"]).paper.first()
        table = table.assign(paper=cells.groupby("beta").mean()).reset_index()
        table.insert(0, "n_envs", n_envs)
        tables.append(table.assign(environments=group.environment.nunique()))
    need(tables, "an environment with all betas at one n_envs")
    return pd.concat(tables, ignore_index=True)


def robust_statistics(runs):
    """Beyond the paper, because seeds are few (Agarwal et al. 2021), per beta, with intervals:

    - `iqm`: interquartile mean of the standardized performance, its mean without the lowest and the
      highest quarter, cells weighing the same;
    - `improvement`: probability that a run does better than one with beta 0, averaged over cells.

    Cells are the environments and n_envs that have all betas. The 95 % bootstrap is stratified:
    runs are drawn within each cell, where there are two or more in all.
    """

    def iqm(*cells, axis=-1):
        z = np.concatenate(cells, axis=-1)
        weights = np.repeat([1 / x.shape[-1] for x in cells], [x.shape[-1] for x in cells])
        order = z.argsort(axis=-1)
        places = np.cumsum(weights[order], axis=-1) / len(cells)
        kept = np.diff(np.clip(places, 0.25, 0.75), prepend=0.25, axis=-1)
        return 2 * (kept * np.take_along_axis(z, order, axis=-1)).sum(-1)

    def improvement(*cells, axis=-1):  # Mann-Whitney's statistic: a tie is half an improvement
        pairs = zip(cells[: len(cells) // 2], cells[len(cells) // 2 :], strict=True)
        signs = [np.sign(x[..., :, None] - y[..., None, :]).mean((-2, -1)) for x, y in pairs]
        return 0.5 + 0.5 * np.mean(signs, axis=0)

    runs = comparable(runs, ["beta"], CELL)
    groups = runs.assign(z=standardize(runs)).groupby(["beta", *CELL]).z
    cells, rows = {key: z.to_numpy() for key, z in groups}, []
    for beta in sorted(runs.beta.unique()):
        ours = {key[1:]: z for key, z in cells.items() if key[0] == beta}
        both = [key for key in ours if beta != 0 and (0, *key) in cells]
        pairs = [ours[key] for key in both] + [cells[0, *key] for key in both]
        row = {"beta": beta, "runs": sum(map(len, ours.values())), "cells": len(ours)}
        for statistic, samples in ((iqm, list(ours.values())), (improvement, pairs)):
            name, low, high = statistic.__name__, np.nan, np.nan
            if samples and min(map(len, samples)) > 1:
                how = {"n_resamples": 2000, "batch": 200, "rng": np.random.default_rng(0)}
                how |= {"method": "percentile", "vectorized": True}
                low, high = stats.bootstrap(samples, statistic, **how).confidence_interval
            mean = statistic(*samples) if samples else np.nan
            row |= {name: mean, f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)


def save_table(table, out, name):
    """Writes NAME.csv in full precision, NAME.md and NAME.tex rounded, to the folder `out`."""

    def text(column, value):
        if isinstance(value, str) or pd.isna(value):
            return value if isinstance(value, str) else ""
        if column.startswith("p_") and value < 0.01:
            return "<0.01"
        whole = isinstance(value, int) or column in ("runs", "environments", "cells")
        return f"{value:g}" if column.endswith("beta") or whole else f"{value:z.2f}"

    columns = {column: [text(column, x) for x in table[column].tolist()] for column in table}
    shown = pd.DataFrame(columns)
    rows = [shown.columns, ["---"] * shown.shape[1], *shown.to_numpy()]
    long = [shown[column].map(len).max() > 40 for column in shown]
    how = {"escape": True, "longtable": True}
    how["column_format"] = "".join("p{5cm}" if each else "l" for each in long)
    latex = shown.to_latex(index=False, **how).replace("<", "$<$")
    table.to_csv(out / f"{name}.csv", index=False)
    (out / f"{name}.md").write_text("".join(f"| {' | '.join(row)} |\n" for row in rows))
    (out / f"{name}.tex").write_text(latex)


# --- How far a sweep is ---------------------------------------------------------------------------


def is_locked(file):
    """Whether a live process holds the lock of a run. Does not make the file."""
    try:
        lock = open(file, "rb" if fcntl else "r+b")  # noqa: SIM115
    except OSError:
        return False
    with lock:
        try:
            if fcntl:  # shared, so that two who look do not see each other
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            else:
                import msvcrt

                msvcrt.locking(lock.fileno(), msvcrt.LK_NBLCK, 1)
                msvcrt.locking(lock.fileno(), msvcrt.LK_UNLCK, 1)
        except OSError:
            return True
    return False


def run_state(folder):
    """State of a run, and its hours when "done", or the share that is left of it, for status().

    A run is "done" exactly when summary.json exists, "running" when a process holds its lock,
    "failed" when a sweep has left the exit code in the file `failed`, else it is "todo".
    """

    def number(name, key):  # of a JSON file, which may be damaged
        try:
            with open(f"{folder}/{name}") as file:
                found = re.search(rf'"{key}": *([0-9.]+)', file.read())
            return float(found[1]) if found else None
        except (OSError, ValueError):
            return None

    if os.path.exists(f"{folder}/summary.json"):
        seconds = number("summary.json", "wall_seconds")
        return "done", np.nan if seconds is None else seconds / 3600
    state = "running" if is_locked(f"{folder}/lock") else "todo"
    if state == "todo" and os.path.exists(f"{folder}/failed"):
        return "failed", 0
    try:
        with open(f"{folder}/evaluations.csv") as file:
            step = float(file.read().splitlines()[-1].split(",")[0])
        return state, 1 - step / number("config.json", "total_timesteps")
    except (OSError, ValueError, LookupError, TypeError, ZeroDivisionError):
        return state, 1


def duration(hours):
    if hours < 1:
        return f"{60 * hours:.0f} min"
    return f"{hours:.1f} h" if hours < 48 else f"{hours / 24:.1f} days"


def status(folders, name):
    """Lines that say how far runs are: one for all of them, and a row per environment.

    Time left: the runs that are left times the mean time of those done, in the same environment
    where there are any, divided by the number of runs that are running now.

    folders: of runs, .../ENVIRONMENT/BETA/N_ENVS/SEED, whether they exist or not.
    """
    counts, hours, left = defaultdict(Counter), defaultdict(list), defaultdict(float)
    for folder in folders:
        state, number = run_state(folder)
        environment = os.path.abspath(folder).split(os.sep)[-4:][0]
        counts[environment][state] += 1
        if state == "done":
            hours[environment] += [] if np.isnan(number) else [number]
        else:
            left[environment] += number
    total = sum(counts.values(), Counter())
    done, running, failed, todo = (total[key] for key in ("done", "running", "failed", "todo"))
    every = [hour for of_env in hours.values() for hour in of_env]
    work = {env: left[env] * np.mean(hours[env] or every) if every else np.nan for env in counts}
    counted = f"{done} of {total.total()} done, {running} running, {failed} failed, {todo} to do"
    head = f"{name}: {counted}"
    if running + todo and not every:
        head += ", time left: known when the first run is done"
    elif running:
        head += f", {duration(sum(work.values()) / running)} left at the present rate"
    elif todo:
        head += f", nothing is running, work left: {duration(sum(work.values()))} of one core"
    row = "{:<40} {:>6} {:>8} {:>7} {:>7} {:>10} {:>10}".format
    lines = [head, row("environment", "done", "running", "failed", "to do", "per run", "left")]
    for env, count in counts.items():
        rest = "-" if not left[env] else duration(work[env] / running) if every and running else "?"
        per_run = duration(np.mean(hours[env])) if hours[env] else "?"
        states = [count[key] for key in ("done", "running", "failed", "todo")]
        lines.append(row(env, *states, per_run, rest))
    return lines


# --- The commands ---------------------------------------------------------------------------------


def finite(text):
    """An argparse type."""
    if not math.isfinite(float(text)):
        raise argparse.ArgumentTypeError(f"{text} is not finite")
    return float(text)


def add_runs(parser):
    """Adds the arguments that say which runs are meant, those of `load`."""

    def beta(text):
        return text if text == "vanilla" else beta_text(finite(text))

    add = parser.add_argument
    add("paths", nargs="+", help="folders of runs, or files that `analysis.py pack` wrote")
    add("--env", nargs="+", metavar="ENV", help="only these: ids, or names as in the paper")
    add("--beta", nargs="+", type=beta, metavar="BETA", help="only these; vanilla for vanilla PPO")
    add("--n-envs", nargs="+", type=int, metavar="N", help="only these")


def parse_args():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    how_far = commands.add_parser("status", help="how far the runs of a folder are")
    how_far.add_argument("paths", nargs="+", help="folders; - for run folders from standard input")
    how_far.add_argument("--name", help="what the first line calls them (default: the paths)")
    packing = commands.add_parser("pack", help="all runs of a folder in one small CSV")
    add_runs(packing)
    packing.add_argument("file", help="CSV to write, or .csv.gz")
    packing.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
    for each in (parser, how_far, packing):
        each.error = lambda message: fail(f"{message} (--help lists the arguments)", code=2)
    return parser.parse_args()


def main():
    args = parse_args()
    if args.command == "pack":
        runs, curves = load(args.paths, args.env, args.beta, args.n_envs)
        pack(runs, curves, args.file, args.paths, args.overwrite)
        print(f"{args.file}: {len(runs)} runs, {Path(args.file).stat().st_size / 1e6:.2f} MB")
        return
    folders = []
    for path in args.paths:
        if path == "-":
            folders += filter(None, map(str.strip, sys.stdin))
            continue
        marks = {"config.json", "evaluations.csv", "summary.json", "failed", "lock", "log.txt"}
        found = run_folders(path, marks)
        if not found:
            raise Unusable(f"no runs in {path}" if os.path.isdir(path) else f"{path} is no folder")
        folders += found
    print("\n".join(status(folders, args.name or " ".join(args.paths))))


if __name__ == "__main__":
    try:
        main()
    except (Unusable, OSError) as error:
        fail(error)
