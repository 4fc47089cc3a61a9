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
    """One of "done", "running" (a process holds the lock), "failed" or "to do"."""
    if (folder / "summary.json").exists():
        return "done"
    if is_locked(folder / "lock"):
        return "running"
    return "failed" if (folder / "failed").exists() else "to do"


def status(folders, name):
    """A line that says how far runs are.

    Hours left: of the runs to do and half of the running ones, at the mean time of those that are
    done (in the same environment where there are any), divided among the processes that run now.

    Args:
        folders: of the runs, .../ENVIRONMENT/BETA/N_ENVS/SEED, whether they exist or not.
        name: what the line calls them.
    """
    counts, hours, left = Counter(), defaultdict(list), Counter()
    for folder in map(Path, folders):
        state, environment = run_state(folder), folder.absolute().parts[-4]
        counts[state] += 1
        if state == "done":
            summary = json.loads((folder / "summary.json").read_text())
            hours[environment].append(summary["wall_seconds"] / 3600)
        else:
            left[environment] += {"running": 0.5, "failed": 0, "to do": 1}[state]
    line = f"{name}: {counts['done']} of {len(folders)} done"
    line += "".join(f", {counts[state]} {state}" for state in ("running", "failed", "to do"))
    every = sum(hours.values(), [])
    if every and any(left.values()):
        work = sum(n * fmean(hours.get(env, every)) for env, n in left.items())
        processes = max(counts["running"], 1)
        line += f", {work / processes:.1f} hours left with {processes} at a time"
    return line


def run_folders(root):
    """The folders of runs at and under `root`, in order; symbolic links are followed."""
    walk = os.walk(root, followlinks=True)
    return sorted(Path(folder) for folder, _, files in walk if "config.json" in files)


def main():
    parser = argparse.ArgumentParser(description="How far the runs in folders are.")
    parser.add_argument("folders", nargs="+")
    for folder in parser.parse_args().folders:
        print(status(run_folders(folder), folder))


if __name__ == "__main__":
    main()
