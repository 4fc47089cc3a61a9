"""Makes the figures of results/ and fills in the tables of its texts, from the CSV files there.

    results/make.sh            makes them
    results/make.sh --check    changes nothing; names what differs from the data, and exits with 1

A table stands in a text between <!-- table: NAME --> and <!-- end -->, and is made by the function
of that name here. Two pictures are the same if no pixel differs by more than TOLERANCE of 255:
only rounding may differ, since requirements.txt pins matplotlib, which brings its own fonts.
"""

import functools
import re
import shutil
import sys
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from PIL import Image
from scipy import stats

import plot
from study import claims, questions
from study.questions import RESULTS, complete, difference_text, mean_text
from study.runs import CELL, Unusable, comparable, differences, load, main_grid, published, select
from study.statistics import contrast, interval, interval_text, pooled_variances, standardize
from study.tables import final_return_per_beta, final_returns, markdown

ROOT = RESULTS.parent
PAGES = [ROOT / "README.md", ROOT / "docs/sweeps.md", RESULTS / "README.md", RESULTS / "notes.md"]
FILES = ["reproduction.csv", "study.csv", "study_n_envs.csv", "slices.csv", "methods.csv"]
FIGURES = [  # names as in plot.py, of these files
    *("claims", "performance_vs_beta", "n_envs_beta_grids", "beside_published", "beta0_vs_vanilla"),
    *("n_envs_vs_n_steps", "n_epochs_vs_beta", "complex_tasks", "transfer", "gsde_vs_beta"),
    *(f"learning_curves_n_envs_{n_envs}" for n_envs in (1, 4, 32)),
    "gymnasium",
]
TOLERANCE = 32
MARKED = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
BETAS = [0, 0.5, 1]


# --- Data -----------------------------------------------------------------------------------------


@functools.cache
def study_runs():
    """The runs of FILES, and their curves."""
    runs, curves = load([RESULTS / file for file in FILES])
    return select(runs)[0], curves


@functools.cache
def coverage():
    return claims.coverage(*study_runs())


def main_runs():
    """Those of PPO with colored noise that are averaged in the figures."""
    runs, _ = study_runs()
    return claims.of_most(plot.averaged(main_grid(runs[runs.method == "ppo"])))


def colored(n_envs):
    """Main runs with these n_envs and BETAS, of environments with two seeds in all these cells."""
    runs = main_runs().query("n_envs in @n_envs and beta in @BETAS")
    return comparable(runs, ["n_envs", "beta"], ["environment"])


def spread(values):
    """Text of whole numbers: "4" or "1 to 5"."""
    low, high = min(values), max(values)
    return f"{low}" if low == high else f"{low} to {high}"


# --- Tables ---------------------------------------------------------------------------------------


def runs():
    """What was run, a row for each of the first three FILES, and one for all other files."""
    others = {file.name for file in RESULTS.glob("*.csv")} - {*FILES[:3], "speed.csv"}
    rows = []
    for files in (*([file] for file in FILES[:3]), sorted(others)):
        (made, _), one = complete(*files), len(files) == 1
        seeds = made.groupby(["env_id", "beta", "n_envs"]).seed.nunique()
        row = {"file": f"`{files[0]}`" if one else "others: [notes](notes.md)"}
        row |= {"complete runs": f"{len(made)}", "environments": f"{made.env_id.nunique()}"}
        row["n_envs"] = ", ".join(map(str, sorted(made.n_envs.astype(int).unique())))
        row["seeds of a cell"] = spread(seeds) if one else ""
        row["episodes of an evaluation"] = spread(made.eval_episodes.astype(int))
        rows.append(row | {"core-hours": f"{made.wall_seconds.sum() / 3600:.1f}"})
    return markdown(rows)


def final_returns_of_four():
    """Our final returns beside the published, n_envs 4."""
    return markdown(final_return_per_beta(final_returns(colored([4]))).drop(columns="n_envs"))


def offset():
    """How far our final returns are from the published, and where most."""
    whole, tasks = claims.offset(main_runs())
    first, second, *_, last = tasks
    return f"{whole[0].upper()}{whole[1:]}. By task: from {first} and {second} to {last}.\n"


def counts():
    """How many claims hold, do not, and are open."""
    verdicts = coverage().verdict.tolist()
    holds, fails, unknown = map(verdicts.count, ("holds", "does not", "open"))
    n = holds + fails + unknown
    return f"Of {n} claims, {holds} hold, {fails} do not, {unknown} are open.\n"


def ahead():
    """In which environments beta 0.5 is ahead of white noise, and behind."""
    runs = main_runs()
    ahead, behind, found, _ = claims.ahead_in(runs.assign(z=standardize(runs)), 0.5)
    n_runs, rest = sum(x["runs"] for x in found.values()), len(found) - len(ahead) - len(behind)
    text = f"- In the paper's {len(found)} environments, {n_runs} runs, β = 0.5 learns more than "
    text += f"white noise in {len(ahead)} ({', '.join(ahead)}), less in {len(behind)} "
    return f"{text}({', '.join(behind)}); in {rest} these runs cannot tell.\n"


def goals():
    """How many runs of Mountain Car end at the goal, which gives 100 where all else costs."""
    made, _ = complete("reproduction.csv", "study.csv", "new_seeds.csv")
    made = made[(made.environment == "Mountain Car") & made.n_envs.isin([1, 4, 32])]
    cells = made[made.beta == "0.5"], made[made.beta == "0"]
    half, white = (f"{(x.final_return > 0).sum()} of {len(x)}" for x in cells)
    text = f"{half} runs with β = 0.5 end at its goal, {white} with white noise"
    return f"As in Mountain Car (n_envs 1, 4, 32): {text}.\n"


def our_lead(n_envs, but=()):
    """Our runs with these n_envs, the lead of 0.5 over white noise in them, and it as text.

    but: environments that are left out.
    """
    part, cells = colored(n_envs), CELL[: len(n_envs)]
    part, of = part[~part.environment.isin(but)], 16 - len(but)
    found = contrast(part.assign(z=standardize(part)), claims.HALF_OVER_WHITE, "beta", cells, of)
    return part, found, interval_text(found["mean"], *interval(found))


def published_cells():
    """The paper's mean final returns, named as if they were performances of runs."""
    paper = published("final_return_per_beta").query("beta != 'vanilla'").astype({"beta": float})
    return paper.rename(columns={"final_return_mean": "performance"}).assign(method="ppo")


# n_envs, and environments that are left out, in words and by name
LEADS = [([4], "", ()), ([1, 4, 32], "", ())]
LEADS += [([1, 4, 32], "without Mountain Car", ["Mountain Car"])]  # the largest lead: not planned
LEADS += [([1, 4, 32], "not looked at before the plan", claims.SEEN)]


def lead():
    """The lead of beta 0.5 over white noise, ours in performance, the paper's in final return."""
    paper, rows = published_cells().query("beta in [0, 0.5, 1]"), []
    for n_envs, which, but in LEADS:
        part, ours, text = our_lead(n_envs, but)
        row = {"n_envs": ", ".join(map(str, n_envs))}
        row["environments"] = f"{ours['environments']} {which}".strip()
        row["ours [95 % interval]"] = text
        theirs = paper[paper.n_envs.isin(n_envs)]
        theirs = theirs.assign(z=standardize(theirs))
        same = theirs[theirs.environment.isin(part.environment)]
        for name, cells in (("the same environments", same), ("all 16", theirs)):
            paper_lead = contrast(cells, claims.HALF_OVER_WHITE, "beta", CELL[: len(n_envs)])
            row[f"paper, {name}"] = f"{paper_lead['mean']:z.2f}"
        rows.append(row)
    return markdown(rows)


def leads():
    """The first three leads of `lead`, in a sentence."""
    four, whole, without = (our_lead(n_envs, but)[2] for n_envs, _, but in LEADS[:3])
    text = "Average lead of β = 0.5 over white noise in the paper's 16 tasks, in standard"
    text += f" deviations of runs: {whole}, without Mountain Car {without}, with n_envs 4 alone"
    return f"{text} {four} ([more](results/README.md#what-the-paper-claims)).\n"


def undecided():
    """How many runs it takes to find leads as small as the published ones."""
    paper, ours = published_cells(), main_runs().groupby(["environment", "beta", "n_envs"])
    variances, _ = pooled_variances(ours.final_return.agg(["var", "size"]))
    scatter = (variances / paper.groupby("environment").performance.var(ddof=0)).mean()
    z, rows = paper.assign(z=standardize(paper)), []
    pairs = (0.5, 0.2, "beta"), (4, 2, "n_envs"), (4, 8, "n_envs")
    for best, other, column in (*pairs, ((0.5, 4), (0.5, 8), ["beta", "n_envs"])):
        means = z.groupby(column).z.mean()
        row = {"": "beta, n_envs" if isinstance(column, list) else column}
        row |= {"best, as the paper says": f"{best}", "rival": f"{other}"}
        lead = means[best] - means[other]
        # Of a difference of two means of n / 2 runs; found with a power of 80 %
        n = 4 * scatter * ((stats.norm.ppf(0.975) + stats.norm.ppf(0.8)) / lead) ** 2
        rows.append(row | {"lead": f"{lead:z.2f}", "runs of these two": claims.rounded(n)})
    return markdown(rows)


def verdicts():
    """The claims of the paper that there are runs for."""
    table = coverage()
    table = table[plot.with_runs(table)]
    columns = {"where": "where", "says": "the paper says", "verdict": "so far", "data": "our runs"}
    columns["decides"] = "what would decide"
    return markdown(table[[*columns]].rename(columns=columns))


def settings():
    """New seeds beside the published means, and what a setting changes in the final return."""
    paper, rows = published("final_return_per_beta").set_index([*CELL, "beta"]), []
    for file in ("new_seeds.csv", "noise_length.csv"):
        made, _ = complete(file)
        made = made.assign(flag=differences(made, ["batch_size", "noise_seq_len"]))
        for (environment, n_envs, beta), cell in made.groupby([*CELL, "beta"]):
            usual = cell.final_return[cell.flag == ""]
            for flag, values in cell.groupby("flag").final_return:
                if len(values) > 1:
                    row = {"environment": environment, "n_envs": f"{n_envs:g}", "β": beta}
                    row |= {"setting": f"`{flag}`" if flag else "the paper's"}
                    row |= {"runs": f"{len(values)}", "final return": mean_text(values)}
                    row["less the paper's setting"] = difference_text(values, usual) if flag else ""
                    final = paper.final_return_mean[environment, int(n_envs), beta]
                    rows.append(row | {"published": f"{final:z.0f}"})
    return markdown(rows)


def sign(text):
    """Of a text "mean [low, high]": 1 if the interval is above 0, -1 if below, else 0."""
    low, high = map(float, text.split("[")[1].rstrip("]").split(", "))
    return (low > 0) - (high < 0)


def judged(leads, above="helps", below="hurts"):
    """The verdict on the average of leads over white noise, in the words of plans.md."""
    average, corrected, _ = leads.iloc[-3:]
    found = sign(average)
    if not found:
        upper = average.split()[-1].rstrip("]")
        return f"no difference found, a lead below {upper} is not excluded"
    also = "too" if sign(corrected) == found else "open"
    return f"it {above if found > 0 else below} (corrected for three tests: {also})"


def gymnasium():
    """What the runs of Gymnasium's tasks say, setting by setting."""
    table, lines, tasks = questions.gymnasium().set_index("task"), [], []
    for name, n_envs, n_steps in ("A", 1, 2048), ("B", 32, 128):
        half, pink = table[f"{name}: 0.5 over 0"], table[f"{name}: 1 over 0"].iloc[-3]
        text = f"- n_envs {n_envs}, n_steps {n_steps}, β = 0.5: {half.iloc[-3]}, {judged(half)}"
        lines.append(f"{text}; β = 1: {pink}.")
        signs = half.iloc[:-3].map(sign)
        tasks += [f"helps in {task} (n_envs {n_envs})" for task in signs.index[signs > 0]]
        tasks += [f"hurts in {task} (n_envs {n_envs})" for task in signs.index[signs < 0]]
    gain = table["1 over 0: B less A"]
    text = f"{gain.iloc[-3]}, {judged(gain, 'gains', 'loses')}"
    lines.append(f"- The lead of β = 1, second less first: {text}.")
    found = ", ".join(tasks) or "makes no difference that is found"
    lines.append(f"- β = 0.5 in single tasks (corrected for six): {found}.")
    return "\n".join([*lines, ""])


def friction():
    """How many runs of the point with white noise, n_envs 4, end at the goal (it gives 1)."""
    rows = []
    for name, file in (("with friction", "point_with_friction.csv"), ("without", "study.csv")):
        made, row = complete(file)[0].query("method == 'ppo' and beta == '0' and n_envs == 4"), {}
        for env_id in ("PointUMaze-v1", "Point4Rooms-v1"):
            runs = made[(made.env_id == env_id) & (made.batch_size == 128)]
            row[runs.environment.iloc[0]] = f"{(runs.final_return > 0.5).sum()} of {len(runs)}"
        rows.append({"": name} | row)
    return markdown(rows)


def speed():
    """Microseconds per training step of the script and the paper's stack, with evaluations."""
    table = pd.read_csv(RESULTS / "speed.csv")
    us = table.pivot_table("us", "env_id", "contender", sort=False)
    us = us[["this script", "this script, --no-envpool", "the paper's stack"]].dropna()
    faster = (us["the paper's stack"] / us["this script"]).map("{:.1f}".format)
    return markdown(
        us.map("{:.0f}".format).assign(**{"times faster": faster}).reset_index(names="environment")
    )


def waiting():
    """Seconds until the first training step is done, and of what comes before it."""
    table = pd.read_csv(RESULTS / "speed.csv").dropna(subset="seconds")
    parts = [f"{row.contender}: {row.seconds:.2g}" for row in table.itertuples()]
    return f"Seconds that one waits. {'; '.join(parts)}.\n"


def costs():
    """Median minutes of a run in each environment, and core-hours of the whole study."""
    made, _ = complete("study.csv", "study_n_envs.csv")
    minutes = made.groupby("environment").wall_seconds.median() / 60
    each = ", ".join(f"{name} {time:.0f}" for name, time in minutes.sort_values().items())
    hours = claims.rounded(20480 * minutes.mean() / 60)
    return f"Median minutes of a run: {each}. All 20,480: {hours} core-hours.\n"


TABLES = [runs, ahead, goals, leads, counts, lead, final_returns_of_four, offset, speed]
TABLES += [waiting, costs, verdicts, undecided, settings, friction, gymnasium]
TABLES = {make.__name__: make for make in TABLES} | {"planned": questions.answers}


# --- Output ---------------------------------------------------------------------------------------


def draw(folder):
    """Draws all figures to a folder; returns their paths."""
    todo = plot.results(*study_runs(), BETAS)
    runs, curves = complete("gymnasium.csv")
    runs = runs.assign(panel=runs.environment + runs.n_envs.map(" {:03}".format))
    runs = runs.astype({"beta": float})
    todo["gymnasium"] = (plot.learning_curves, runs, curves, "panel")
    tables = {todo[name][1] for name in FIGURES if isinstance(todo[name][1], str)}
    todo = {name: todo[name] for name in [*tables, *FIGURES]}
    todo["noise_random_walks"] = (plot.random_walks, BETAS)
    _, not_made = plot.make_all(todo, folder)
    if not_made:
        raise Unusable("; ".join(not_made))
    return sorted(folder.glob("*.png"))


def same_picture(a, b):
    """Whether two pictures show the same, see the top of this file."""
    if not (a.exists() and b.exists()):
        return False
    a, b = (np.asarray(Image.open(path).convert("RGB"), int) for path in (a, b))
    return a.shape == b.shape and np.abs(a - b).max() <= TOLERANCE


def pages_that_differ():
    """{path: text with its tables made from the data} of the pages that are otherwise."""

    def made(match):
        return match[1] + TABLES[match[2]]() + match[3]

    pages = {path: MARKED.sub(made, path.read_text()) for path in PAGES}
    return {path: text for path, text in pages.items() if text != path.read_text()}


def main():
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only say what differs")
    args = parser.parse_args()
    plt.switch_backend("Agg")
    pages = pages_that_differ()
    with tempfile.TemporaryDirectory() as folder:
        drawn = draw(Path(folder))
        pictures = [path for path in drawn if not same_picture(path, RESULTS / path.name)]
        if not args.check:
            for path, text in pages.items():
                path.write_text(text)
            for path in pictures:
                shutil.copy(path, RESULTS)
    changed = [*pages, *(RESULTS / path.name for path in pictures)]
    for path in changed:
        print(f"{'differs' if args.check else 'made'}: {path.relative_to(ROOT)}")
    print(f"{len(drawn)} figures and the tables of {len(PAGES)} texts, {len(changed)} differed")
    sys.exit(bool(args.check and changed))


if __name__ == "__main__":
    main()
