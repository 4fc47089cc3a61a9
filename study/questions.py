"""Answers to the questions of results/plans.md, as their analyses were written there beforehand.

    python -m study.questions

prints them as Markdown tables, from the packed runs in results/.
"""

import functools
import inspect
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from study.runs import differences, load, published
from study.statistics import interval, interval_text, less_published, mean_interval
from study.tables import markdown

RESULTS = Path(__file__).parent.parent / "results"
STEPS = [204_800 * i for i in range(1, 11)]  # of the ten evaluations that all of these runs have
PENDULUM, CAR = "dm_control/pendulum-swingup-v0", "MountainCarContinuous-v0"


@functools.cache
def complete(*files):
    """All complete runs in these files of results/, whatever their settings, and their curves."""
    runs, curves = load([RESULTS / file for file in files])
    return runs[runs.status == "complete"], curves[runs.status == "complete"]


def long_runs(env_id, *files):
    """Those of an environment, of all steps; `performance` is that of the evaluations at STEPS."""
    runs, curves = complete(*files)
    runs = runs[(runs.env_id == env_id) & (runs.total_timesteps == STEPS[-1])]
    return runs.assign(performance=curves.loc[runs.index, STEPS].mean(axis=1, skipna=False))


def as_in_the_paper(runs):
    """Those with its batch size, length of sequences and treatment of time limits."""
    usual = (runs.batch_size == 128) & (runs.noise_seq_len == 1000)
    usual &= (runs.env_id == CAR) | ~runs.bootstrap_timeouts.astype(bool)
    return runs[usual].drop_duplicates(["method", "beta", "n_envs", "seed"])


def mean_text(values):
    return interval_text(*mean_interval(values), digits=0)


def difference_text(a, b):
    """Mean of a less that of b with Welch's interval, and p of Mann and Whitney's test."""
    ends = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
    p = stats.mannwhitneyu(a, b).pvalue
    return f"{interval_text(np.mean(a) - np.mean(b), *ends, digits=0)}, p = {p:.2g}"


def stable_baselines3():
    """Pendulum Swingup, white noise, n_envs 1: Stable-Baselines3 (SB3) beside this script."""
    theirs, ours = long_runs(PENDULUM, "sb3.csv"), long_runs(PENDULUM, "new_seeds.csv")
    ours = as_in_the_paper(ours).query("n_envs == 1 and beta == '0'")
    rows = [
        {
            "": column.replace("_", " "),
            f"this script, {len(ours)} runs": mean_text(ours[column]),
            f"SB3, {len(theirs)} runs": mean_text(theirs[column]),
            "SB3 less this script": difference_text(theirs[column], ours[column]),
            "published": paper,
        }
        for column, paper in (("final_return", "714.5"), ("performance", ""))
    ]
    return pd.DataFrame(rows)


def pendulum_order():
    """Pendulum Swingup, n_envs 1: performance by beta. In the paper 0 is best."""
    runs = as_in_the_paper(long_runs(PENDULUM, "new_seeds.csv", "study.csv"))
    runs = runs.query("n_envs == 1 and seed > 100 and beta in ['0', '0.5', '1']")
    white, rows = runs[runs.beta == "0"].performance, []
    for beta, values in runs.groupby("beta").performance:
        row = {"beta": beta, "runs": f"{len(values)}", "performance": mean_text(values)}
        row["beta 0 less this"] = "" if beta == "0" else difference_text(white, values)
        rows.append(row)
    return pd.DataFrame(rows)


def pendulum_beside_published():
    """Pendulum Swingup, n_envs 4: final returns of all runs, and how far off on average."""
    files = "reproduction.csv", "study.csv", "noise_length.csv", "new_seeds.csv"
    runs = as_in_the_paper(long_runs(PENDULUM, *files)).query("n_envs == 4")
    paper = published("final_return_per_beta").set_index(["environment", "n_envs", "beta"])
    paper = paper.final_return_mean["Pendulum Swingup", 4]
    rows = []
    for beta, values in runs.groupby("beta").final_return:
        row = {"beta": beta, "runs": f"{len(values)}", "final return": mean_text(values)}
        less = f"{values.mean() - paper[beta]:.0f}"
        rows.append(row | {"published": f"{paper[beta]}", "ours less the published": less})
    for name, part in (("average", runs), ("seeds above 100 alone", runs[runs.seed > 100])):
        cells = part.groupby(["environment", "beta"]).final_return.agg(["mean", "var", "size"])
        cells["paper"] = paper[cells.index.get_level_values("beta")].to_numpy()
        found = less_published(cells)
        p = 2 * stats.t.sf(abs(found["mean"]) / found["se"], found["df"])
        average = f"{interval_text(found['mean'], *interval(found), digits=0)}, p = {p:.2g}"
        rows.append({"beta": name, "runs": f"{len(part)}", "ours less the published": average})
    return pd.DataFrame(rows).fillna("")


def mountain_car():
    """Mountain Car, n_envs 4: runs that end at the goal; Fisher's test against the published."""
    runs = as_in_the_paper(long_runs(CAR, "study.csv")).query("n_envs == 4 and seed > 400")
    cells = {
        "beta 0.2, batch size 128, T = 1000": (runs[runs.beta == "0.2"], 5),
        "beta 0.2, batch size 64, T = 1024": (long_runs(CAR, "released_code.csv"), 5),
        "beta 0, batch size 128, T = 1000": (runs[runs.beta == "0"], 0),
    }
    rows, counts = [], []
    for name, (cell, paper) in cells.items():
        count, n = int((cell.final_return > 0).sum()), len(cell)
        counts.append([count, n - count])
        low, high = stats.binomtest(count, n).proportion_ci()
        row = {"": name, "end at the goal": f"{count} of {n}"}
        row["share, 95 % interval"] = f"{low:.2f} to {high:.2f}"
        p = stats.fisher_exact([counts[-1], [paper, 20 - paper]]).pvalue
        rows.append(row | {"published": f"{paper} of 20", "p": f"{p:.2g}"})
    p = stats.fisher_exact(counts[:2]).pvalue
    rows.append({"": "the first two against each other", "p": f"{p:.2g}"})
    return pd.DataFrame(rows).fillna("")


def gymnasium_scores(last=5, file="gymnasium.csv"):
    """Scores of the runs of `run_sweep.sh gymnasium`: {(task, n_envs, beta): (seeds,)}.

    The mean of a run's last evaluations; of all twenty it is the area under the curve.
    """
    runs, curves = complete(file)
    scores = curves.dropna(axis=1).iloc[:, -last:].mean(axis=1)
    return scores.groupby([runs.env_id, runs.n_envs, runs.beta]).apply(np.array).to_dict()


def lead(scores, task, n_envs, beta):
    """Lead of a beta over white noise in a task, its variance by seeds, and degrees of freedom.

    In standard deviations, pooled over the betas of the task with this n_envs.
    """
    cells = [x for (name, n, _), x in scores.items() if (name, n) == (task, n_envs)]
    ours, white = scores[task, n_envs, beta], scores[task, n_envs, "0"]
    df = sum(len(x) - 1 for x in cells)
    std = (sum(((x - x.mean()) ** 2).sum() for x in cells) / df) ** 0.5
    return (ours.mean() - white.mean()) / std, 1 / len(ours) + 1 / len(white), df


def student_text(mean, se, df, level=0.95):
    half = stats.t.ppf((1 + level) / 2, df) * se
    return interval_text(mean, mean - half, mean + half)


def gymnasium(last=5):
    """Gymnasium: leads over white noise in standard deviations. A: n_envs 1, B: n_envs 32.

    Intervals of single tasks are corrected for six tasks (99.2 %).
    """
    scores = gymnasium_scores(last)
    tasks = list(dict.fromkeys(task for task, _, _ in scores))
    columns = {
        f"{name}: {beta} over 0": np.array([lead(scores, task, n, beta) for task in tasks])
        for name, n in (("A", 1), ("B", 32))
        for beta in ("0.5", "1")
    }
    gain = columns["A: 1 over 0"] * [-1, 1, 1] + columns["B: 1 over 0"]
    columns["1 over 0: B less A"] = gain
    rows = ["average, these tasks, 95 %", "the same, 98.3 %", "average, tasks like these, 95 %"]
    table = pd.DataFrame({"task": [*tasks, *rows]})
    for name, found in columns.items():
        texts = [student_text(x, variance**0.5, df, 1 - 0.05 / 6) for x, variance, df in found]
        (leads, variances, df), n = found.T, len(tasks)
        by_seeds = leads.mean(), variances.sum() ** 0.5 / n, df.sum()
        by_tasks = leads.mean(), leads.std(ddof=1) / n**0.5, n - 1
        texts += [student_text(*by_seeds), student_text(*by_seeds, 1 - 0.05 / 3)]
        table[name] = [*texts, student_text(*by_tasks)]
    return table


def gymnasium_area():
    """Gymnasium: the same leads by the area under the curve, the mean of all twenty evaluations."""
    return gymnasium(last=20)


def gymnasium_baseline():
    """Gymnasium, white noise: our mean of the last five evaluations in A, beside published PPO.

    Of runs with another flag, made to find out why a task is low: each seed's.
    """
    scores, paper = gymnasium_scores(), published("gymnasium").set_index("task")
    column, tasks = "this script (v5)", dict.fromkeys(task for task, _, _ in scores)
    ours = [{"task": task, "flag": "", column: mean_text(scores[task, 1, "0"])} for task in tasks]
    runs, curves = complete("gymnasium_baseline.csv")
    runs = runs[runs.n_envs == 1]
    seeds = curves.iloc[:, -5:].mean(axis=1).map("{:.0f}".format)
    flags = differences(runs, ["env_kwargs", "gamma"])
    others = seeds.groupby([runs.env_id, flags]).agg(", ".join).rename_axis(["task", "flag"])
    table = pd.DataFrame(ours).join(paper, on="task")
    return pd.concat([table, others.reset_index(name=column)]).fillna("")


def gymnasium_ant():
    """Gymnasium, Ant-v5 in B: mean of the last five evaluations, of eight seeds."""
    usual, without = gymnasium_scores(), gymnasium_scores(file="gymnasium_baseline.csv")
    rows = []
    for name, scores in ("usual", usual), ("without contact forces", without):
        white, half = scores["Ant-v5", 32, "0"], scores["Ant-v5", 32, "0.5"]
        row = {"observation": name, "beta 0": mean_text(white), "beta 0.5": mean_text(half)}
        rows.append(row | {"0.5 less 0": difference_text(half, white)})
    return pd.DataFrame(rows)


QUESTIONS = [stable_baselines3, pendulum_order, pendulum_beside_published, mountain_car, gymnasium]
QUESTIONS += [gymnasium_area, gymnasium_baseline, gymnasium_ant]


def answers():
    """The answers, as Markdown."""
    return "\n".join(f"{inspect.getdoc(f)}\n\n{markdown(f())}" for f in QUESTIONS)


if __name__ == "__main__":
    print(answers())
