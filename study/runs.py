"""Runs as tables: reads them, chooses those that may be averaged, adds the published numbers.

python -m study.runs pack runs/ results/sweep.csv

writes all runs of a folder to one small CSV, which `python plot.py results` reads like the folder.

Sections named in study/ are those of Hollenstein, Martius, Piater: "Colored Noise in PPO", AAAI
2024, with its appendix.
"""

import argparse
import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

from study.protocol import NAMES, SETTINGS, bootstraps, ids_named
from study.status import run_folders

# The study varies these. Runs that are equal in all of them are the same run.
AXES = ["environment", "beta", "n_envs", "n_steps", "n_epochs", "seed"]
CELL = ["environment", "n_envs"]
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


def read_run(folder):
    """A dict of a run's arguments, its `status`, and the mean return of each step evaluated.

    `beta` is a text: "0.5", "0.5_1" with one per action dimension, "vanilla" or "gsde".
    """
    config = json.loads((folder / "config.json").read_text())
    run = OLDER | config["args"] | {"git_commit": config["git_commit"], "status": "unfinished"}
    run["beta"] = "vanilla" if run["vanilla"] else "_".join(map(beta_text, run["beta"]))
    if run["method"] == "gsde":  # it does not use the beta of its arguments
        run["beta"] = "gsde"
    if run.get("env_kwargs") is not None:
        run["env_kwargs"] = json.dumps(run["env_kwargs"], sort_keys=True)
    if (folder / "summary.json").exists():
        summary = json.loads((folder / "summary.json").read_text())
        run |= {"status": "complete", "wall_seconds": summary["wall_seconds"]}
    with open(folder / "evaluations.csv") as file:
        rows = csv.DictReader(file)
        return run | {int(row["step"]): float(row["return_mean"] or "nan") for row in rows}


def read(path):
    """The runs in a folder, or in a file that `pack` wrote: a row each, as of `read_run`."""
    if path.is_dir():
        folders = run_folders(path)
        progress = tqdm(folders, desc=f"reading {path}", unit=" runs", mininterval=0.5)
        table = pd.DataFrame(map(read_run, progress))
        table["path"] = [folder.relative_to(path).as_posix() for folder in folders]
    else:
        table = pd.read_csv(path, dtype={"beta": str}, low_memory=False)
        table = table.rename(columns=lambda name: int(name) if name.isdecimal() else name)
    need(len(table), f"runs: there are none in {path}")
    older = {name: value for name, value in OLDER.items() if name not in table}
    return table.assign(source=str(path), **older)


def load(paths, env=None, beta=None, n_envs=None):
    """Reads the runs in folders and in files that `pack` wrote; keeps those that are asked for.

    env, beta, n_envs: lists, or None for all: ids, short as in cheetah-run or not, or names in the
        paper; beta as text.

    Returns:
        runs: a row per run, whatever its state: its arguments, `status` ("complete" or
            "unfinished: ..."), `source` and `path` (where it was found), `environment` (its name in
            the paper), `performance` and `final_return`.
        curves: rows with the index of `runs`, a column per environment step: the mean return
            evaluated there, or NaN.
        Both are ordered by environment, beta, n_envs, n_steps, n_epochs and seed.

    Raises Unusable where there is nothing to read or nothing of a kind that is asked for.
    """
    table = pd.concat([read(Path(path)) for path in paths], ignore_index=True)
    steps = sorted(column for column in table if isinstance(column, int))
    need(steps, "runs with an evaluation: there are none yet")
    runs, curves = table.drop(columns=steps), table[steps].astype(float).set_axis(steps, axis=1)
    n_found = curves.notna().sum(axis=1)
    complete = (runs.status == "complete") & (n_found == runs.total_timesteps // runs.eval_freq)
    unfinished = "unfinished: " + n_found.astype(str) + " evaluations"
    runs["status"] = unfinished.mask(complete, "complete")
    runs["environment"] = runs.env_id.replace(NAMES)
    # Sec. "Evaluation Details": performance is the mean over all evaluations, the area under the
    # learning curve
    runs["performance"] = curves.mean(axis=1).round(9)  # the digits behind depend on other rows
    runs["final_return"] = curves.ffill(axis=1).iloc[:, -1]
    names = dict(zip(runs.env_id, runs.environment, strict=True))
    env = env and [env_id for name in env for env_id in ids_named(name, names) or [name]]
    for column, wanted in (("env_id", env), ("beta", beta), ("n_envs", n_envs)):
        there = sorted(runs[column].unique().tolist())
        for value in wanted or []:
            need(value in there, f"runs with {column} {value}; there are: {there}")
        if wanted:  # runs with gSDE have no beta to go by
            runs = runs[runs[column].isin([*wanted, "gsde"])]
    # Bootstraps draw by position: in whatever order runs are read, their intervals are the same
    runs = runs.sort_values(AXES, kind="stable")
    return runs, curves.loc[runs.index]


def pack(runs, curves, file, overwrite=False):
    """Writes runs, complete or not, to a CSV that `load` reads, compressed where it ends in .gz.

    A row per run with its arguments and a column per step. Without `overwrite` the file must not
    exist.
    """
    no_setting = ["source", "environment", "performance", "final_return", "runs_dir", "resume"]
    table = runs.drop(columns=[*no_setting, "overwrite"], errors="ignore").dropna(axis=1, how="all")
    mode = "w" if overwrite else "x"
    pd.concat([table, curves], axis=1).to_csv(file, mode=mode, index=False, float_format="%.9g")


# --- What may be averaged -------------------------------------------------------------------------


def value_text(value):
    """Text of an argument that is the same for 1, 1.0 and a 1 read from a CSV; "None" for NaN."""
    if value is None or value != value:
        return "None"
    return str(value) if isinstance(value, str | bool | np.bool_ | list) else f"{value:.9g}"


def flag_text(argument, text):
    """An argument as one types it: "--gamma 0.9", "--envpool", "no --envpool"."""
    flag = f"--{argument.replace('_', '-')}"
    return {"True": flag, "False": f"no {flag}", "None": f"no {flag}"}.get(text, f"{flag} {text}")


def same_protocol(runs, arguments=SHARED):
    """The runs; raises Unusable where one of the arguments varies within an environment."""
    for environment, group in runs.groupby("environment"):
        for argument in group.columns.intersection(arguments):
            texts = sorted(group[argument].map(value_text).unique())
            flags = " and ".join(flag_text(argument, text) for text in texts[:3])
            what = f"runs with the same settings, but {environment} has runs with {flags}"
            advice = "give the folder of one experiment, or filter by --env, --beta, --n-envs"
            need(len(texts) == 1, f"{what}: {advice}")
    return runs


def select(runs):
    """Chooses the runs to average: complete, each method, setting and seed once.

    Returns them, with `beta` a number (NaN for vanilla PPO and gSDE), and a line for each run that
    is left out. Raises Unusable where there is none; where another argument than those that are
    listed at the top of this file varies within a method and environment; or where the same
    settings and seed are in two experiments: of one of them the script may have been edited.
    """
    complete = runs[runs.status == "complete"]
    for _, group in complete.groupby("method"):
        same_protocol(group, group.columns.difference([*AXES, *EVALUATION, *UNIMPORTANT]))
        same_protocol(group[group.duplicated(AXES, keep=False)], ["exp_name"])
    again, per_dimension = complete.duplicated(["method", *AXES]), complete.beta.str.contains("_")
    status = runs.status.copy()
    status[complete.index[again]] = "the same settings and seed as another run"
    status[complete.index[per_dimension]] = "one beta per action dimension is not in the study"
    left_out = (runs.source + "/" + runs.path + ": " + status)[status != "complete"].tolist()
    chosen = runs[status == "complete"]
    need(len(chosen), "; ".join(["a complete run", *left_out[:1]]))
    beta = pd.to_numeric(chosen.beta, errors="coerce").astype(float)
    return chosen.assign(beta=beta, vanilla=chosen.beta == "vanilla"), left_out


def main_grid(runs):
    """The runs with the study's n_steps and n_epochs, or else their method's most frequent ones."""
    settings = runs.n_steps.map("{:g}, ".format) + runs.n_epochs.map("{:g}".format)
    usual = "{n_steps:g}, {n_epochs:g}".format(**SETTINGS)
    chosen = settings.groupby(runs.method).transform(
        lambda group: usual if usual in set(group) else group.mode()[0]
    )
    return runs[settings == chosen]


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
    pack(runs, curves, args.file, args.overwrite)
    print(f"{args.file}: {len(runs)} runs, {Path(args.file).stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
