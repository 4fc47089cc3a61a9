"""How far runs are: how many are done, running, failed and to do, and how long the rest takes.

python -m study.status runs/        of all runs in a folder
./run_sweep.sh PRESET --status      of the runs of a sweep, also those that have no folder yet
"""

import argparse
import fcntl
import json
import os
from collections import Counter, defaultdict
from pathlib import Path
from statistics import fmean


def is_locked(file):
    """Whether a live process holds the flock on a file."""
    try:
        with open(file) as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        pass
    return False


def run_state(folder):
    """The state of a run, and its hours if it is done, else the share of it that is left.

    "done": summary.json is there; "running": a process holds the lock; "failed": run_sweep.sh has
    left a file of that name; else "to do".
    """
    folder = Path(folder)
    if (folder / "summary.json").exists():
        summary = json.loads((folder / "summary.json").read_text())
        return "done", summary["wall_seconds"] / 3600
    state = "running" if is_locked(folder / "lock") else "to do"
    if state == "to do" and (folder / "failed").exists():
        return "failed", 0
    try:
        step = (folder / "evaluations.csv").read_text().splitlines()[-1].split(",")[0]
        config = json.loads((folder / "config.json").read_text())
        return state, 1 - int(step) / config["args"]["total_timesteps"]
    except (OSError, ValueError, LookupError):  # nothing is evaluated yet
        return state, 1


def duration(hours):
    if hours < 1:
        return f"{60 * hours:.0f} min"
    return f"{hours:.1f} h" if hours < 48 else f"{hours / 24:.1f} days"


def status(folders, name):
    """Lines that say how far runs are: one for all of them, and a row per environment.

    Time left: what is left of the runs, at the mean time of those that are done (in the same
    environment where there are any), divided among as many processes as are running now.

    Args:
        folders: of the runs, .../ENVIRONMENT/BETA/N_ENVS/SEED, whether they exist or not.
        name: what the first line calls them.
    """
    counts, hours, left = defaultdict(Counter), defaultdict(list), defaultdict(float)
    for folder in folders:
        state, number = run_state(folder)
        environment = os.path.abspath(folder).split(os.sep)[-4]
        counts[environment][state] += 1
        if state == "done":
            hours[environment].append(number)
        else:
            left[environment] += number
    total = sum(counts.values(), Counter())
    every = [hour for of_env in hours.values() for hour in of_env]
    work = {env: left[env] * fmean(hours[env] or every) if every else None for env in counts}
    states = "done", "running", "failed", "to do"
    head = f"{name}: {total['done']} of {total.total()} done"
    head += "".join(f", {total[state]} {state}" for state in states[1:])
    if every and total["running"]:
        head += f", {duration(sum(work.values()) / total['running'])} left at the present rate"
    elif every and total["to do"]:
        head += f", {duration(sum(work.values()))} of one core left"
    row = "{:<40} {:>6} {:>8} {:>7} {:>7} {:>10} {:>14}".format
    lines = [head, row("environment", *states, "per run", "left, one core")]
    for env, count in counts.items():
        per_run = duration(fmean(hours[env])) if hours[env] else "?"
        rest = duration(work[env]) if every else "?"
        lines.append(row(env, *(count[state] for state in states), per_run, rest))
    return lines


def run_folders(root):
    """The folders of runs at and under `root`, in order; symbolic links are followed."""
    walk = os.walk(root, followlinks=True)
    return sorted(Path(folder) for folder, _, files in walk if "config.json" in files)


def main():
    parser = argparse.ArgumentParser(description="How far the runs in folders are.")
    parser.add_argument("folders", nargs="+")
    args = parser.parse_args()
    for folder in args.folders:
        print("\n".join(status(run_folders(folder), folder)))


if __name__ == "__main__":
    main()
