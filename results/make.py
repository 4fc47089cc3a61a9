"""Makes the figures of results/ and fills in the tables of its texts, from the CSV files there.

    results/make.sh            makes all anew
    results/make.sh --check    changes nothing; names what differs from the data, and exits with 1

A table stands in a text between <!-- table: NAME --> and <!-- end -->, and is made by the function
of that name here. Two pictures are the same if no pixel differs by more than TOLERANCE of 255:
only rounding may differ, since requirements.txt pins matplotlib, which brings its own fonts.
"""

import argparse
import functools
import re
import shutil
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from PIL import Image

import plot
from study import claims, questions
from study.protocol import SETTINGS
from study.runs import differences, load, main_grid, published, select_methods
from study.statistics import FEW, contrast, interval, mean_interval, standardize
from study.tables import final_return_per_beta, final_returns, markdown

RESULTS = Path(__file__).parent
PAGES = [RESULTS / "README.md", RESULTS / "notes.md", RESULTS.parent / "README.md"]
STUDY = "reproduction.csv", "study.csv"
SLICES = *STUDY, "slices.csv"
METHODS = "reproduction.csv", "methods.csv"
FIGURES = {  # picture: the files that it is made of, its name in plot.py
    "claims": (STUDY, "claims"),
    "learning_curves": (STUDY, "learning_curves_n_envs_4"),
    "learning_curves_n_envs_1": (STUDY, "learning_curves_n_envs_1"),
    "learning_curves_n_envs_32": (STUDY, "learning_curves_n_envs_32"),
    "performance_vs_beta": (STUDY, "performance_vs_beta"),
    "beside_published": (STUDY, "beside_published"),
    "n_envs_beta_grids": (STUDY, "n_envs_beta_grids"),
    "beta0_vs_vanilla": (SLICES, "beta0_vs_vanilla"),
    "n_envs_vs_n_steps": (SLICES, "n_envs_vs_n_steps"),
    "n_epochs_vs_beta": (SLICES, "n_epochs_vs_beta"),
    "complex_tasks": (SLICES, "complex_tasks"),
    "transfer": (METHODS, "transfer"),
    "gsde_vs_beta": (METHODS, "gsde_vs_beta"),
}
TOLERANCE = 32
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
QUESTIONS = ["sb3", "new_seeds", "released_code", "noise_length", "variants"]
QUESTIONS += ["bootstrapped_timeouts"]
BETAS = [0, 0.5, 1]


# --- Data -----------------------------------------------------------------------------------------


@functools.cache
def runs_of(*files):
    """Runs of files in results/: by method, and their curves."""
    runs, curves = load([RESULTS / file for file in files])
    return select_methods(runs)[0], curves


@functools.cache
def coverage(*files):
    return claims.coverage(*runs_of(*files))


@functools.cache
def complete(file):
    """All complete runs of a file, whatever their settings."""
    runs, _ = load([RESULTS / file])
    return runs[runs.status == "complete"]


def rows(columns, *texts):
    """A table in Markdown."""
    return markdown(pd.DataFrame(texts, columns=columns))


def spread(values):
    """Text of whole numbers: "4" or "1 to 5"."""
    low, high = min(values), max(values)
    return f"{low}" if low == high else f"{low} to {high}"


# --- Tables ---------------------------------------------------------------------------------------


def runs():
    """What was run, a row for the reproduction, the rest of the study, and all other files."""
    others = [file.name for file in sorted(RESULTS.glob("*.csv")) if file.name not in STUDY]
    others = [file for file in others if file != "benchmark.csv"]
    groups = {f"`{file}`": [file] for file in STUDY} | {"others: [notes](notes.md)": others}
    texts = []
    for name, files in groups.items():
        made = pd.concat([complete(file) for file in files], ignore_index=True)
        seeds = made.groupby(["env_id", "beta", "n_envs"]).seed.nunique()
        episodes = spread(made.eval_episodes.astype(int))
        n_envs = ", ".join(map(str, sorted(made.n_envs.astype(int).unique())))
        hours = f"{made.wall_seconds.sum() / 3600:.1f}"
        texts.append([name, f"{len(made)}", f"{made.env_id.nunique()}", n_envs])
        texts[-1] += [spread(seeds) if files != others else "", episodes, hours]
    columns = ["file", "complete runs", "environments", "n_envs", "seeds of a cell"]
    return rows([*columns, "episodes of an evaluation", "core-hours"], *texts)


def final_returns_of_four():
    """Our final returns beside the published, n_envs 4."""
    ppo = runs_of(*STUDY)[0]["ppo"]
    table = final_return_per_beta(final_returns(ppo[(ppo.n_envs == 4) & ppo.beta.isin(BETAS)]))
    return markdown(table.drop(columns="n_envs").astype(str))


def offset():
    """How far our final returns are from the published, and where most."""
    whole, tasks = claims.offset(runs_of(*STUDY)[0]["ppo"])
    first, second, *_, last = tasks.split(", ")
    return f"{whole[0].upper()}{whole[1:]}. By task: from {first} and {second} to {last}.\n"


def counts():
    """How many claims hold, do not, and are open."""
    table = coverage(*STUDY)
    n = table.verdict[table.verdict != ""].value_counts()
    words = [f"{n.get('holds', 0)} hold", f"{n.get('does not', 0)} do not"]
    return f"Of {n.sum()} claims, {', '.join(words)}, {n.get('open', 0)} are open.\n"


def verdicts():
    """The claims of the paper that there are runs for."""
    table = coverage(*STUDY)
    known = (table.verdict != "") & (table.runs != "none needed")
    return claims_of(table[known & ~table.data.str.fullmatch("no runs[^;]*")])


def lead():
    """The lead of beta 0.5 over white noise, ours in performance, the paper's in final return."""
    ppo, paper = runs_of(*STUDY)[0]["ppo"], published("final_return_per_beta")
    paper = paper[paper.beta.isin(["0", "0.5", "1"])].astype({"beta": float})
    texts = []
    for n_envs in ([4], [1, 4, 32]):
        part = ppo[ppo.n_envs.isin(n_envs) & ppo.beta.isin(BETAS)]
        part = part[part.groupby("environment").n_envs.transform("nunique") == len(n_envs)]
        cells = ["environment", "n_envs"][: len(n_envs)]
        found = contrast(part.assign(z=standardize(part)), {0.5: 1, 0: -1}, "beta", cells)
        low, high = interval(found)
        of = paper[paper.n_envs.isin(n_envs)].assign(method="ppo")
        of = of.assign(z=standardize(of.rename(columns={"final_return_mean": "performance"})))
        leads = of.pivot_table("z", "environment", "beta")
        leads = leads[0.5] - leads[0]
        texts.append([", ".join(map(str, n_envs)), f"{found['environments']}"])
        texts[-1].append(f"{found['mean']:z.2f} [{low:z.2f}, {high:z.2f}]")
        texts[-1] += [f"{leads[part.environment.unique()].mean():z.2f}", f"{leads.mean():z.2f}"]
    columns = ["n_envs", "environments", "ours [95 % interval]", "paper, the same environments"]
    return rows([*columns, "paper, all 16"], *texts)


def settings():
    """Pendulum and Cartpole: what a setting changes, and how far off the paper's results are."""
    new, length = complete("new_seeds.csv"), complete("noise_length.csv")
    new = new[(new.environment == "Pendulum Swingup") & (new.beta == "0")]
    ends = new.bootstrap_timeouts.astype(bool)
    paper = published("final_return_per_beta").set_index(["environment", "n_envs", "beta"])
    pairs = []
    for n in (4, 1):
        usual = (new.n_envs == n) & (new.batch_size == 128) & ~ends
        small = new[(new.n_envs == n) & (new.batch_size == 64)]
        pairs += [("batch size 64 less 128", small, new[usual])]
        pairs += [("bootstrap at time limits less none", new[(new.n_envs == n) & ends], new[usual])]
    for _, group in length.groupby("environment"):
        both = [group[group.noise_seq_len == steps] for steps in (1024, 1000)]
        pairs += [("T = 1024 less 1000", *both)]
    texts = []
    for what, changed, usual in pairs:
        environment, n, beta = usual[["environment", "n_envs", "beta"]].iloc[0]
        off = paper.final_return_mean[environment, int(n), beta] - usual.final_return.mean()
        texts.append([environment, f"{n:g}", beta, what, f"{len(changed)}, {len(usual)}"])
        texts[-1] += [questions.difference_text(changed.final_return, usual.final_return)]
        texts[-1] += [f"{off:.0f}"]
    columns = ["environment", "n_envs", "β", "final return of", "runs", "difference [95 %], p"]
    return rows([*columns, "paper less ours"], *texts)


def claims_of(table):
    """Rows of `coverage` for readers."""
    columns = {"where": "where", "says": "the paper says", "verdict": "so far", "data": "our runs"}
    columns |= {"decides": "what would decide"}
    return markdown(table[list(columns)].fillna("").rename(columns=columns))


def slices_claims():
    table = coverage(*SLICES)
    return claims_of(table[table["where"].isin(["Fig. A6", "Fig. A8", "Fig. A11", "Fig. A12"])])


def methods_claims():
    table = coverage(*METHODS)
    return claims_of(table[table["where"].str.match("Fig. A7|Fig. A13")])


def slices():
    """Performance of vanilla PPO, and of beta 0.5 with other n_steps and n_epochs."""
    ppo = runs_of(*SLICES)[0]["ppo"]
    size = ppo.n_envs * ppo.n_steps
    usual = (ppo.n_envs == 4) & (ppo.n_steps == 2048) & (ppo.n_epochs == 10)
    half = (ppo.beta == 0.5) & (ppo.n_envs.isin([2, 4, 8])) & (size == 8192)
    columns = {"vanilla PPO": usual & ppo.vanilla, "β = 0": usual & (ppo.beta == 0)}
    columns |= {"β = 0.5": usual & half, "2 · 4096": half & (ppo.n_steps == 4096)}
    columns |= {"8 · 1024": half & (ppo.n_steps == 1024), "5 epochs": half & (ppo.n_epochs == 5)}
    columns |= {"20 epochs": half & (ppo.n_epochs == 20)}
    means = {
        name: ppo[mask].groupby("environment").performance.mean() for name, mask in columns.items()
    }
    table = pd.DataFrame(means).dropna()
    return markdown(table.map("{:z.1f}".format).reset_index())


def methods():
    """Final returns of the other methods, n_envs 4."""
    means = {}
    for name, group in runs_of(*METHODS)[0].items():
        group = main_grid(group)[0]
        for beta, part in group[group.n_envs == 4].groupby("beta", dropna=False):
            title = name.upper() if name != "gsde" else "gSDE"
            title += f", {beta:g}" * (name != "gsde")
            means[title] = part.groupby("environment").final_return.mean()
    table = pd.DataFrame(means).dropna()
    return markdown(table.map("{:z.1f}".format).reset_index())


def single_questions():
    """Final returns and performance of the runs that were made for single questions."""
    paper = published("final_return_per_beta").set_index(["environment", "n_envs", "beta"])
    settings, texts = {*SETTINGS} - {"eval_freq", "method"}, []
    for name in (name for name in QUESTIONS if (RESULTS / f"{name}.csv").exists()):
        table = complete(f"{name}.csv")
        what = differences(table, settings)
        what += table.script.where(table.script != "ppo_colored_continuous.py", "")
        cells = table.assign(what=what).groupby(["environment", "n_envs", "beta", "what"])
        for (environment, n_envs, beta, what), group in cells:
            final = paper.final_return_mean.get((environment, int(n_envs), str(beta)), np.nan)
            text = [name, environment, f"{n_envs:g}", str(beta), f"`{what}`" * bool(what)]
            text.append(f"{len(group)}")
            for column in ("final_return", "performance"):
                mean, low, high = mean_interval(group[column])
                text.append(f"{mean:z.1f}" + f" [{low:z.1f}, {high:z.1f}]" * (len(group) >= FEW))
            texts.append([*text, "" if np.isnan(final) else f"{final:z.1f}"])
    columns = ["file", "environment", "n_envs", "β", "what differs", "runs", "final return"]
    return rows([*columns, "performance", "paper, final return"], *texts)


def planned():
    """The answers to the questions of plans.md that there are runs for."""
    found = [(question.__doc__, question()) for question in questions.QUESTIONS]
    parts = [f"{doc}\n\n{markdown(table)}" for doc, table in found if table is not None]
    return "\n".join(parts) or "No runs yet.\n"


def friction():
    """How many runs of the point with white noise, n_envs 4, end at the goal (it gives 1)."""
    texts = []
    for name, file in (("with friction", "point_with_friction.csv"), ("without", "study.csv")):
        made = complete(file)
        made = made[(made.method == "ppo") & (made.beta == "0") & (made.n_envs == 4)]
        made = made[made.batch_size == 128]
        text = [name]
        for env_id in ("PointUMaze-v1", "Point4Rooms-v1"):
            ends = made[made.env_id == env_id].final_return
            text.append(f"{(ends > 0.5).sum()} of {len(ends)}")
        texts.append(text)
    return rows(["", "UMaze Point", "4 Rooms Point"], *texts)


def speed():
    """Microseconds per training step of the script and its peers, evaluations included."""
    table = pd.read_csv(RESULTS / "benchmark.csv")
    us = table.pivot_table("total us", "env_id", "contender", sort=False)
    us = us.rename(columns={"this script, --no-envpool": "--no-envpool"})
    us = us[["this script", "--no-envpool", "the paper's stack", "SBX", "bare physics"]].dropna()
    faster = us["the paper's stack"] / us["this script"]
    texts = [[name, *(f"{x:.0f}" for x in each)] for name, each in us.iterrows()]
    texts = [[*text, f"{x:.1f}"] for text, x in zip(texts, faster, strict=True)]
    return rows(["environment", *us.columns, "times faster than the paper's stack"], *texts)


TABLES = [runs, final_returns_of_four, offset, counts, lead, verdicts, settings, slices]
TABLES += [slices_claims, methods, methods_claims, single_questions, planned, friction, speed]
TABLES = {make.__name__: make for make in TABLES}


# --- Output ---------------------------------------------------------------------------------------


def filled(text):
    """The text with each of its tables made anew."""

    def fill(match):
        return f"{match[1]}{TABLES[match[2]]()}{match[3]}"

    return MARKED.sub(fill, text)


def draw(folder):
    """Draws all figures to a folder."""
    for files in dict.fromkeys(files for files, _ in FIGURES.values()):
        methods, curves = runs_of(*files)
        todo = plot.results(methods, curves, BETAS)
        made = {"coverage": coverage(*files)}
        for picture in [name for name, (of, _) in FIGURES.items() if of == files]:
            make, data, *rest = todo[FIGURES[picture][1]]
            if isinstance(data, str) and data not in made:
                source, *more = todo[data]
                made[data] = source(*more)
            fig = make(made[data] if isinstance(data, str) else data, *rest)
            fig.savefig(folder / f"{picture}.png", dpi=150)
            plt.close(fig)
    fig = plot.random_walks(BETAS)
    fig.savefig(folder / "noise_random_walks.png", dpi=200)
    plt.close(fig)


def same_picture(a, b):
    """Whether two pictures show the same, see the top of this file."""
    if not (a.exists() and b.exists()):
        return False
    a, b = (np.asarray(Image.open(path).convert("RGB"), int) for path in (a, b))
    return a.shape == b.shape and np.abs(a - b).max() <= TOLERANCE


def pages_that_differ():
    return [
        page for page in PAGES if page.exists() and filled(page.read_text()) != page.read_text()
    ]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only say what differs")
    args = parser.parse_args()
    plt.switch_backend("Agg")
    changed = pages_that_differ()
    with tempfile.TemporaryDirectory() as folder:
        draw(Path(folder))
        pictures = sorted(Path(folder).iterdir())
        for picture in pictures:
            if not same_picture(picture, RESULTS / picture.name):
                changed.append(RESULTS / picture.name)
                if not args.check:
                    shutil.copy(picture, RESULTS)
    for path in changed:
        print(f"{'differs' if args.check else 'made'}: {path.relative_to(RESULTS.parent)}")
        if not args.check and path.suffix == ".md":
            path.write_text(filled(path.read_text()))
    print(f"{len(pictures)} figures and the tables of {len(PAGES)} texts, {len(changed)} differed")
    sys.exit(bool(args.check and changed))


if __name__ == "__main__":
    main()
