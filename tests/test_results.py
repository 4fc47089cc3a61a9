"""What stands in results/ is what its CSV files say."""

import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from results import make
from study import sweep

RESULTS = Path(make.__file__).parent


def test_the_tables_are_those_of_the_data():
    """As `results/make.sh --check` says, which checks the figures, too."""
    text = "".join(page.read_text() for page in make.PAGES)
    assert set(make.TABLES) == {match[2] for match in make.MARKED.finditer(text)}
    assert make.pages_that_differ() == {}


def test_a_change_of_a_table_is_found(monkeypatch, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("above\n<!-- table: counts -->\n6 hold\n<!-- end -->\nbelow\n")
    monkeypatch.setattr(make, "PAGES", [page])
    monkeypatch.setitem(make.TABLES, "counts", lambda: "7 hold\n")
    assert make.pages_that_differ() == {page: page.read_text().replace("6", "7")}


def test_every_figure_is_shown_and_made():
    """Those that no data make are rendered, or moving."""
    shown = {path.stem for path in RESULTS.iterdir() if path.suffix in (".png", ".gif")}
    assert shown == {*make.FIGURES, "noise_random_walks", "environments", "animation"}


def test_leads_are_of_environments_with_all_cells(monkeypatch):
    cells = [(name, n, beta) for name in "AB" for n in (1, 4, 32) for beta in (0, 0.5, 1)]
    made = pd.DataFrame([*cells, *cells[:-1]], columns=["environment", "n_envs", "beta"])
    made["seed"] = made.groupby([*made]).cumcount()
    monkeypatch.setattr(make, "main_runs", lambda: made)
    assert set(make.colored([4]).environment) == {"A", "B"}
    assert set(make.colored([1, 4, 32]).environment) == {"A"}  # one seed of 1 with 32 in B


@pytest.mark.parametrize(
    ("leads", "verdict", "gain", "in_tasks"),
    [  # in Ant-v5; averages at 95 %, at 98.3 % and for tasks like these
        (
            ["0.9 [0.1, 1.7]", "0.3 [0.01, 0.6]", "0.3 [-0.1, 0.6]", "0.3 [-0.9, 1.5]"],
            *(
                ", it helps (corrected for three tests: open);",
                ", it gains (corrected for three tests: open).",
            ),
            "helps in Ant-v5 (n_envs 32).",
        ),
        (
            ["-2 [-3, -1]", "-0.4 [-0.7, -0.1]", "-0.4 [-0.7, -0.06]", "-0.4 [-0.8, 0.01]"],
            *(
                ", it hurts (corrected for three tests: too);",
                ", it loses (corrected for three tests: too).",
            ),
            "hurts in Ant-v5 (n_envs 32).",
        ),
        (
            ["0.9 [-0.1, 1.9]", "-0.2 [-0.5, 0.1]", "-0.2 [-0.5, 0.2]", "-0.2 [-0.9, 0.7]"],
            ", no difference found, a lead below 0.1 is not excluded;",
            ", no difference found, a lead below 0.1 is not excluded.",
            "no difference that is found.",
        ),
    ],
)
def test_gymnasium_is_judged_as_planned(monkeypatch, leads, verdict, gain, in_tasks):
    columns = ["A: 0.5 over 0", "A: 1 over 0", "B: 0.5 over 0", "B: 1 over 0", "1 over 0: B less A"]
    rows = {"task": ["Ant-v5", "these tasks, 95 %", "98.3 %", "tasks like these, 95 %"]}
    table = pd.DataFrame(rows | dict.fromkeys(columns, leads))
    monkeypatch.setattr(make.questions, "gymnasium", lambda: table)
    *_, first, second, less, last = make.gymnasium().splitlines()
    assert f"β = 0.5: {leads[1]}{verdict}" in first
    assert f"β = 0.5: {leads[1]}{verdict}" in second
    assert less.endswith(f"{leads[1]}{gain}") and last.endswith(in_tasks)


@pytest.mark.parametrize(("change", "same"), [(2, True), (200, False)])
def test_pictures_are_compared_by_their_pixels(tmp_path, change, same):
    pixels = np.full((20, 30, 3), 50, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    pixels[3, 4] += np.uint8(change)
    Image.fromarray(pixels).save(tmp_path / "b.png")
    Image.fromarray(pixels[1:]).save(tmp_path / "c.png")
    assert make.same_picture(tmp_path / "a.png", tmp_path / "b.png") == same
    assert not make.same_picture(tmp_path / "a.png", tmp_path / "c.png")
    assert not make.same_picture(tmp_path / "a.png", tmp_path / "none.png")


def test_every_run_is_of_a_command():
    """Of the lines in results/sweeps.sh between that which packs its file and the one before."""
    listed, found = set(), {}
    for line in (RESULTS / "sweeps.sh").read_text().splitlines():
        if line.startswith("./run_sweep.sh"):
            words = subprocess.run(["bash", "-c", f"printf '%s\\n' {line}"], capture_output=True)
            args = sweep.parse_args(words.stdout.decode().splitlines()[1:])
            listed |= {Path(folder).parts[-4:] for folder, _ in sweep.list_runs(args)}
        elif " pack " in line:
            found[line.split("results/")[1].split()[0]], listed = listed, set()
    for file, listed in found.items():
        if listed:
            runs = {Path(path).parts[-4:] for path in make.complete(file)[0].path}
            assert runs and not runs - listed, file
    others = {path.name for path in RESULTS.glob("*.csv")} - {*found}
    # speed.csv has no runs; those of the other are by the same commands, as the notes say
    assert others == {"speed.csv", "point_with_friction.csv"}
