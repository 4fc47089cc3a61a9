"""Runs as tables: reads them, chooses those that may be averaged, adds the published numbers.

python -m study.runs pack runs/ results/sweep.csv

writes all runs of a folder to one small CSV, which `python plot.py results` reads like the folder.

Sections named in study/ are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI
2024, with its appendix.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

from study.protocol import METHODS, NAMES, SETTINGS, bootstraps, ids_named
from study.status import run_folders

# The study varies these. Runs that are equal in all of them are the same run.
AXES = ["environment", "beta", "n_envs", "n_steps", "n_epochs", "seed"]
CELL = ["environment", "n_envs"]
WHOLE = ["n_envs", "n_steps", "n_epochs", "seed"]  # whole numbers
# Other arguments must not vary within an environment, but these: EVALUATION changes how exactly a
# policy's mean return is measured; UNIMPORTANT changes no result, or is given by other columns.
EVALUATION = ["eval_episodes", "eval_once_per_policy"]
UNIMPORTANT = ["resume", "overwrite", "runs_dir", "device", "compile", "threads", "capture_video"]
UNIMPORTANT += ["track", "path", "source", "status", "git_commit", "wall_seconds", "performance"]
UNIMPORTANT += ["final_return", "exp_name", "env_id", "vanilla", "beta_auto"]
# What different methods must have in common to be compared
SHARED = ["total_timesteps", "eval_freq", "max_episode_steps", "noise_seq_len", "gamma"]
SHARED += ["anneal_lr", "bootstrap_timeouts", "env_kwargs", "rescale_actions", "normalize_obs"]
SHARED += ["normalize_rewards"]
# Older runs do not record these; so they ran
OLDER = {"method": "ppo", "script": "ppo_colored_continuous.py", "envpool": False}
OLDER |= {"anneal_lr": False, "eval_once_per_policy": False, "rescale_actions": False}
OLDER |= {"normalize_obs": False, "normalize_rewards": False}


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
    """Text of a run's noise: "0.5", "0.5_1" with one beta per action dimension, "vanilla", "gsde".

    Raises ValueError where it is none of these.
    """
    if text in ("vanilla", "gsde"):
        return text
    return "_".join(beta_text(float(part)) for part in text.split("_"))


def read_run(folder):
    """Reads one run's folder, whatever its state.

    Returns:
        run: dict of its arguments, with `beta` as text (see `betas_text`), and `status`:
            "complete", "unfinished: ..." without summary.json, or "damaged: ...".
        steps, returns: (n_evaluations,) environment step and mean return of each evaluation.
    """
    run, steps, returns = {}, np.zeros(0, int), np.zeros(0)
    try:
        config = json.loads((folder / "config.json").read_text())
        args, script = config["args"], config.get("script")
        beta = "vanilla" if args["vanilla"] else "_".join(map(str, args["beta"]))
        expected = args["total_timesteps"] // args["eval_freq"]
        run = {**args, "beta": betas_text(beta), "git_commit": config["git_commit"]}
        run["script"] = script["name"] if isinstance(script, dict) else script
        if args.get("env_kwargs") is not None:
            run["env_kwargs"] = json.dumps(args["env_kwargs"], sort_keys=True)
        rows = (folder / "evaluations.csv").read_text().splitlines()[1:]
        table = np.array([row.split(",")[:2] for row in rows], float).reshape(-1, 2)
        steps, returns = table[:, 0].astype(int), table[:, 1]
        run["status"] = f"unfinished: {len(steps)} evaluations, no summary.json"
        if (folder / "summary.json").exists():
            run["wall_seconds"] = json.loads((folder / "summary.json").read_text())["wall_seconds"]
            if np.isfinite(returns).sum() != expected:
                raise ValueError(f"{np.isfinite(returns).sum()} of {expected} evaluations")
            run["status"] = "complete"
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        run["status"] = f"damaged: {error!r}"
    return run, steps, returns


def read_folder(path):
    """Reads all runs under a folder: (runs, curves) as in `load`."""
    folders = run_folders(path)
    progress = tqdm(folders, desc=f"reading {path}", unit=" runs", mininterval=0.5)
    read = [read_run(folder) for folder in progress]
    runs = pd.DataFrame([run for run, _, _ in read])
    runs["path"] = [folder.relative_to(path).as_posix() for folder in folders]
    all_steps = np.unique(np.concatenate([np.zeros(0, int), *(steps for _, steps, _ in read)]))
    curves = np.full((len(read), len(all_steps)), np.nan)
    for row, (_, steps, returns) in zip(curves, read, strict=True):
        row[np.searchsorted(all_steps, steps)] = returns
    return runs, pd.DataFrame(curves, columns=all_steps)


def read_packed(path):
    """Reads a file that `pack` wrote: (runs, curves) as in `load`.

    Raises Unusable where it is no such file, or a complete run in it lacks evaluations.
    """
    text = dict.fromkeys(("beta", "env_id", "status", "path"), str)
    try:
        runs = pd.read_csv(path, dtype=text, index_col=False, low_memory=False)
        steps = [column for column in runs if column.isdecimal()]
        curves = runs[steps].astype(float).rename(columns=int)
        runs = runs.drop(columns=steps)
        runs["beta"] = runs.beta.map(betas_text, na_action="ignore")
        complete, found = runs.status == "complete", curves.notna().sum(axis=1)
        wrong = complete & (found != runs.total_timesteps // runs.eval_freq)
        wrong |= ~runs.status.str.match("complete$|unfinished:|damaged:", na=False)
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise Unusable(f"{path} is not a file that `study.runs pack` wrote: {error}") from error
    if wrong.any():
        raise Unusable(f"{path} is damaged: run {wrong.argmax() + 1} in it lacks evaluations")
    return runs, curves


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

    Raises Unusable where there is nothing to read or nothing of a kind that is asked for.
    """
    tables = []
    for path in map(Path, paths):
        runs, curves = read_folder(path) if path.is_dir() else read_packed(path)
        need(len(runs), f"runs: there are none in {path}")
        tables.append((runs.assign(source=str(path)), curves))
    runs, curves = (pd.concat(parts, ignore_index=True) for parts in zip(*tables, strict=True))
    runs = runs.reindex(columns=list(dict.fromkeys([*runs, "env_id", *AXES, *OLDER])))
    for argument, value in OLDER.items():
        runs[argument] = runs[argument].astype(object).where(runs[argument].notna(), value)
    # gSDE does not use the beta of its arguments
    runs["beta"] = runs.beta.astype(object).mask(runs.method == "gsde", "gsde")
    runs["environment"] = runs.env_id.replace(NAMES)
    # Sec. "Evaluation Details": performance is the mean over all evaluations, the area under the
    # learning curve
    curves = curves.sort_index(axis=1)
    runs["performance"] = curves.mean(axis=1).round(9)  # the digits behind depend on other rows
    runs["final_return"] = curves.ffill(axis=1).iloc[:, -1] if len(curves.columns) else np.nan
    # Bootstraps draw by position: in whatever order runs are read, their intervals are the same
    runs = runs[asked_for(runs, env, beta, n_envs)].sort_values(AXES, kind="stable")
    return runs, curves.loc[runs.index]


def asked_for(runs, env, beta, n_envs):
    """Which runs `load` keeps: a Series of bools. Runs of an unknown kind stay, to be listed."""
    ids = runs.env_id.dropna().unique()

    def meant(name):
        return ids_named(name, ids) or [i for i in ids if NAMES.get(i) == name] or [name]

    env = env and sum(map(meant, env), [])
    keep = pd.Series(True, runs.index)
    for column, wanted in (("env_id", env), ("beta", beta), ("n_envs", n_envs)):
        there = runs[column].dropna().unique()
        for value in (each for each in wanted or [] if each not in there):
            texts = ", ".join(value_text(each) for each in sorted(there) if each != "gsde")
            raise Unusable(f"no runs with {column} {value}; there are: {texts}")
        if wanted:
            keep &= runs[column].isin(wanted) | (column == "beta") & (runs.method == "gsde")
    need(keep.any(), "runs that match --env, --beta and --n-envs: there are none")
    return keep | runs.env_id.isna()


def pack(runs, curves, file, inputs=(), overwrite=False):
    """Writes runs, complete or not, to a CSV that `load` reads, compressed where it ends in .gz.

    A row per run with its settings and a column per step. Raises Unusable where the file exists
    without `overwrite`, or is one of the `inputs`.
    """
    file = Path(file)
    if file.exists() and (not overwrite or any(file.samefile(path) for path in inputs)):
        advice = "give the file to write last, and --overwrite to replace one that is not read here"
        raise Unusable(f"{file} exists: {advice}")
    derived = ["source", "environment", "performance", "final_return"]
    derived += ["runs_dir", "resume", "overwrite"]
    table = runs.drop(columns=derived, errors="ignore").dropna(axis=1, how="all")
    pd.concat([table, curves], axis=1).to_csv(file, index=False, float_format="%.9g")


# --- What may be averaged -------------------------------------------------------------------------


def value_text(value):
    """Text of an argument that is the same for 1, 1.0 and a 1 read from a CSV; "None" for NaN."""
    if isinstance(value, str | bool | np.bool_):
        return str(value)
    try:
        return "None" if value is None or math.isnan(value) else f"{value:.9g}"
    except TypeError:  # a list
        return str(value)


def flag_text(argument, text):
    """An argument as one types it: "--gamma 0.9", "--envpool", "no --envpool"; a script's name."""
    if argument == "script":
        return text
    flag = f"--{argument.replace('_', '-')}"
    return {"True": flag, "False": f"no {flag}", "None": f"no {flag}"}.get(text, f"{flag} {text}")


def varying(runs, arguments):
    """Each argument that varies within an environment: (environment, {flag's text: runs}) of it."""
    for environment, group in runs.groupby("environment"):
        for argument in group.columns.intersection(arguments):
            counts = group[argument].map(value_text).value_counts().sort_index()
            if len(counts) > 1:
                yield environment, {flag_text(argument, text): n for text, n in counts.items()}


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
    left_out = (places(runs) + status)[status != "complete"].tolist()
    chosen = runs[status == "complete"]
    if chosen.empty:
        what = f"no complete run of the method {method} matches --env, --beta, --n-envs"
        raise Unusable("; ".join([what, *left_out[:1]]))
    compared = complete.columns.difference([*AXES, *EVALUATION, *UNIMPORTANT])
    twice = complete[complete.duplicated(AXES, keep=False)]
    for environment, flags in [*varying(complete, compared), *varying(twice, ["exp_name"])]:
        what = f"{environment} has runs with {' and '.join(list(flags)[:3])}"
        advice = "give the folder of one experiment, or filter by --env, --beta, --n-envs"
        raise Unusable(f"{what}, which must not be averaged: {advice}")
    beta = pd.to_numeric(chosen.beta, errors="coerce")
    chosen = chosen.astype(dict.fromkeys(WHOLE, int))
    return chosen.assign(beta=beta, vanilla=chosen.beta == "vanilla"), left_out


def places(runs):
    return runs.source + "/" + runs.path + ": "


def select_methods(runs, method="ppo"):
    """`select` for each method, `method` first: they are compared, but never averaged.

    Returns a dict, method: its runs, the first `method` even if it has none, then those that have
    any; and the lines of all. Raises Unusable where no method has any.
    """
    none = runs[:0].astype({**dict.fromkeys(WHOLE, int), "beta": float})
    chosen, left_out = {method: none.assign(vanilla=np.zeros(0, bool))}, []
    for name in dict.fromkeys([method, *METHODS, *runs.method]):
        part = runs[runs.method == name]
        if (part.status == "complete").any():
            chosen[name], lines = select(part, name)
        else:
            lines = (places(part) + part.status).tolist()
        left_out += lines
    if not any(map(len, chosen.values())):
        what = "no complete run matches --env, --beta, --n-envs"
        raise Unusable("; ".join([what, *left_out[:1]]))
    return chosen, left_out


def same_protocol(runs, arguments=SHARED):
    """The runs; raises Unusable where methods to compare differ in what they share."""
    for environment, flags in varying(runs, arguments):
        flags = " and ".join(list(flags)[:3])
        raise Unusable(f"needs methods with the same protocol: {environment} has {flags}")
    return runs


def mixed_evaluations(runs):
    """A line for each environment whose runs were evaluated in different ways (EVALUATION)."""
    mixed = [
        f"{environment}: {' and '.join(f'{flag} ({n} runs)' for flag, n in sorted(flags.items()))}"
        for environment, flags in varying(runs, EVALUATION)
    ]
    return sorted(mixed)


def main_grid(runs):
    """The runs with the study's n_steps and n_epochs, 2048 and 10, or else the most frequent ones.

    Returns them, and a line for each environment that has no such runs.
    """
    if runs.empty:
        return runs, []
    settings = pd.Series(list(zip(runs.n_steps, runs.n_epochs, strict=True)), index=runs.index)
    usual = (SETTINGS["n_steps"], SETTINGS["n_epochs"])
    setting = usual if usual in set(settings) else settings.mode()[0]
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


# --- The paper beside -----------------------------------------------------------------------------


def published(name):
    """One of the paper's tables, results/published/NAME.csv."""
    return pd.read_csv(Path(__file__).parent.parent / "results" / "published" / f"{name}.csv")


def differences(runs, arguments=tuple(SETTINGS)):
    """Which flags differ from the study's settings: a Series like runs of text, "" where none.

    Of these arguments, and of `bootstrap_timeouts`.
    """
    flags = pd.Series("", index=runs.index)
    for argument in (name for name in SETTINGS if name in arguments and name in runs):
        texts = runs[argument].map(value_text)
        other = texts[texts != value_text(SETTINGS[argument])]
        flags[other.index] += [f"{flag_text(argument, text)}, " for text in other]
    if "bootstrap_timeouts" in runs:
        ours, paper = runs.bootstrap_timeouts.eq(True), runs.env_id.map(bootstraps)
        flags[ours & ~paper] += "--bootstrap-timeouts, "
        flags[paper & ~ours] += "--no-bootstrap-timeouts, "
    return flags.str.removesuffix(", ")


def beside_paper(table, runs, paper):
    """`table` with the columns of `paper` beside its own, both with the same index.

    Where the runs' settings are not the study's, they are blank and `differs` names the flags.
    """
    keys = [runs[key] for key in table.index.names]
    flags = differences(runs).groupby(keys).agg(lambda texts: "; ".join(sorted(set(texts) - {""})))
    table = table.join(paper).assign(differs=flags)
    table.loc[table.differs != "", paper.columns] = np.nan
    return table if table.differs.any() else table.drop(columns="differs")


# --- The command ----------------------------------------------------------------------------------


def add_runs(parser):
    """Adds the arguments that say which runs are meant, those of `load`."""

    def beta(text):
        return text if text == "vanilla" else beta_text(float(text))

    add = parser.add_argument
    add("paths", nargs="+", help="folders of runs, or files that `study.runs pack` wrote")
    add("--env", nargs="+", metavar="ENV", help="only these: ids, or names as in the paper")
    add("--beta", nargs="+", type=beta, metavar="BETA", help="only these; vanilla for vanilla PPO")
    add("--n-envs", nargs="+", type=int, metavar="N", help="only these")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    packing = parser.add_subparsers(required=True).add_parser("pack", help="write runs to one CSV")
    add_runs(packing)
    packing.add_argument("file", help="CSV to write, or .csv.gz")
    packing.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
    args = parser.parse_args()
    runs, curves = load(args.paths, args.env, args.beta, args.n_envs)
    pack(runs, curves, args.file, args.paths, args.overwrite)
    print(f"{args.file}: {len(runs)} runs, {Path(args.file).stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
