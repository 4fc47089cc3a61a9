"""The paper's tables of runs, with the published numbers beside ours.

`runs` are as of `study.runs.select`: a row per run.
"""

import contextlib

import numpy as np
import pandas as pd

from colored_noise import mean_std
from study.runs import CELL, Unusable, beside_paper, comparable, differences, need, published
from study.statistics import FEW, cells_intervals, mean_intervals, standardize, welch


def best_beta_per_env(runs):
    """Table 1: the beta of best mean performance, by Welch's t-test against 0.5, 0 and 1.

    Over all n_envs that have all the environment's betas, each weighing the same, and all seeds. A
    fixed beta is "outperformed" where p < 0.05, else "comparable"; blank where nothing is tested:
    fewer than two runs of it or of the best, or no other beta.
    """
    rows = []
    for environment, group in runs.groupby("environment"):
        row = {"environment": environment, "best_beta": np.nan}
        with contextlib.suppress(Unusable):
            row |= best_beside_fixed(comparable(group, ["beta"], ["n_envs"]))
        rows.append(row)
    need(any("runs" in row for row in rows), "one environment and n_envs with all its betas")
    paper = published("best_beta_per_env").set_index("environment")
    paper = paper.replace({"yes": "comparable", "no": "outperformed"})
    paper = paper.rename(columns=lambda name: "paper_" + name.removesuffix("_comparable"))
    table = beside_paper(pd.DataFrame(rows).set_index("environment"), runs, paper).reset_index()
    counts = {"environment": "comparable in"}
    for column in table.filter(regex="beta_[01]"):
        verdicts = table[column][table[column].isin(["comparable", "outperformed"])]
        counts[column] = f"{(verdicts == 'comparable').sum()}/{len(verdicts)}"
    return pd.concat([table, pd.DataFrame([counts])], ignore_index=True)


def best_beside_fixed(runs):
    """What a row of `best_beta_per_env` says of one environment's runs."""
    cells = runs.groupby(["n_envs", "beta"]).performance
    runs = runs.assign(weight=1 / cells.transform("size"))
    best = cells.mean().groupby("beta").mean().idxmax()
    sides = {beta: side for beta, side in runs.groupby("beta") if len(side) > 1}
    row = {"best_beta": best}
    for beta in (0.5, 0.0, 1.0):
        p, verdict = np.nan, ""
        if len(sides) > 1 and beta in sides and best in sides:
            if beta != best:
                both = [sides[best], sides[beta]]
                p = welch(*(side.performance for side in both), *(side.weight for side in both))
            verdict = "outperformed" if p < 0.05 else "comparable"
        row |= {f"beta_{beta}": verdict, f"p_{beta}": p}
    return row | {"runs": len(runs)}


def by_n_envs(runs):
    """Pairs of n_envs and its runs, in those environments that have all betas there."""
    found = []
    for n_envs, group in runs.groupby("n_envs"):
        with contextlib.suppress(Unusable):
            found.append((n_envs, comparable(group, ["beta"], ["environment"])))
    need(found, "an environment with all betas at one n_envs")
    return found


def best_beta_per_n_envs(runs):
    """Sec. A2: the beta of highest standardized performance for each n_envs.

    Averaged over the environments that have all betas there, and seeds. Zero is the mean of all
    the runs here, so the value, unlike the beta, is as in the paper only for the whole grid.
    """
    runs, rows = runs.assign(z=standardize(runs)), []
    for n_envs, group in by_n_envs(runs):
        table = cells_intervals(group, "z", "beta", ["environment"])
        best = table["mean"].idxmax()
        row = {"n_envs": n_envs, "best_beta": best, "environments": group.environment.nunique()}
        row |= table.loc[best].rename({"mean": "standardized_performance"}).to_dict()
        rows.append(row | {"runs": len(group)})
    paper = published("best_beta_per_n_envs").set_index("n_envs").add_prefix("paper_")
    return beside_paper(pd.DataFrame(rows).set_index("n_envs"), runs, paper).reset_index()


def rank_grids(runs):
    """Standardized performance, its ranks, and ranks projected from the bias of the noise.

    Averaged over the environments that have all combinations of beta and n_envs found, each
    weighing the same; projected from the best betas here. Returns three tables with a row per beta
    and a column per n_envs, 1 the best rank, NaN where there is none, and the runs that they are
    made of.
    """
    need(runs.beta.nunique() > 1, "at least two betas")
    runs = comparable(runs, ["n_envs", "beta"], ["environment"])
    lengths = runs.noise_seq_len.unique()
    need(len(lengths) == 1, "one --noise-seq-len, of all environments: the projection goes by it")
    cells = standardize(runs).groupby([runs.beta, runs.n_envs, runs.environment]).mean()
    grid = cells.groupby(["beta", "n_envs"]).mean().unstack()
    projected = projected_ranks(grid.idxmax(), grid.index, grid.columns, int(lengths[0]))
    return grid, (-grid).rank(), projected.where(grid.notna()).rank(), runs


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
    runs = runs.assign(beta=runs.beta.map("{:g}".format).mask(runs.vanilla, "vanilla"))
    paper = published("final_return_per_beta").set_index(cell)[["final_return_mean"]]
    table = mean_intervals(runs, "final_return", cell)
    table = beside_paper(table, runs, paper.set_axis(["paper"], axis=1))
    known = table.dropna(subset=["low", "paper"])
    holds = known.paper.between(known.low - 0.05, known.high + 0.05)
    return table.assign(in_interval=holds.map({True: "yes", False: "no"})).reset_index()


def final_return_per_beta(table):
    """The table of `final_returns` for readers, a row per environment and n_envs, rounded.

    Columns of each beta: "mean [low, high]" and the published mean, "(outside)" where our interval
    of FEW seeds or more does not hold it.
    """
    rows = []
    for key, cells in table.groupby(CELL):
        row = dict(zip(CELL, key, strict=True)) | {"runs": cells.runs.sum()}
        for cell in cells.to_dict("records"):
            missed = cell["in_interval"] == "no" and cell["runs"] >= FEW
            ours = "{mean:z.1f} [{low:z.1f}, {high:z.1f}]".format(**cell)
            row[f"beta {cell['beta']}"] = ours.removesuffix(" [nan, nan]")
            paper = f"{cell['paper']:z.1f}{' (outside)' * missed}"
            row[f"paper, {cell['beta']}"] = paper.replace("nan", "")
        if "differs" in cells:
            row["differs"] = "; ".join(sorted(set(cells.differs) - {""}))
        rows.append(row)
    betas = sorted(table.beta.unique(), key=lambda text: float(text.replace("vanilla", "inf")))
    columns = [f"{of} {beta}" for beta in betas for of in ("beta", "paper,")]
    differs = table.columns.intersection(["differs"])
    return pd.DataFrame(rows, columns=[*CELL, "runs", *columns, *differs])


def on_published_scale(runs):
    """Final returns with 0 for the environment's lowest published mean and 1 for its highest.

    Returns the runs with the study's settings whose cells are published: `final_return` on that
    scale, and so `paper`, the cell's published mean.
    """
    paper = published("final_return_per_beta").rename(columns={"final_return_mean": "paper"})
    paper = paper[paper.beta != "vanilla"].astype({"beta": float})
    ends = paper.groupby("environment").paper.agg(["min", "max"])
    runs = runs[differences(runs) == ""].merge(paper, on=[*CELL, "beta"])
    need(len(runs), "runs of the study's settings, n_envs and betas")
    low, high = (runs.environment.map(ends[end]) for end in ends)
    both = {column: (runs[column] - low) / (high - low) for column in ("final_return", "paper")}
    return runs.assign(**both)


def average_final_returns(runs):
    """Sec. A14 averaged over environments: ours beside the paper's, of the same environments.

    On the scale of `on_published_scale`. A row per n_envs and beta, of the environments that have
    all betas with that n_envs, and two seeds of each if any has.
    """
    tables = []
    for n_envs, group in by_n_envs(on_published_scale(runs)):
        table = cells_intervals(group, "final_return", "beta", ["environment"])
        cells = group.groupby(["beta", "environment"]).paper.first()
        table = table.assign(paper=cells.groupby("beta").mean()).reset_index()
        table.insert(0, "n_envs", n_envs)
        tables.append(table.assign(environments=group.environment.nunique()))
    return pd.concat(tables, ignore_index=True)


def markdown(table):
    """A table in Markdown. table: a DataFrame or a list of rows, dicts, of texts."""
    table = pd.DataFrame(table).astype(str)
    rows = [table.columns, ["---"] * table.shape[1], *table.to_numpy()]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def save_table(table, out, name):
    """Writes NAME.csv in full precision, NAME.md and NAME.tex rounded, to the folder `out`."""

    def text(value):
        if isinstance(value, str) or pd.isna(value):
            return value if isinstance(value, str) else ""
        return f"{round(float(value), 2):g}" if abs(value) >= 0.01 else f"{value:.2g}"

    shown = table.map(text)
    table.to_csv(out / f"{name}.csv", index=False)
    (out / f"{name}.md").write_text(markdown(shown))
    shown.to_latex(out / f"{name}.tex", index=False, escape=True)
