"""The tables of the experiments page are those of the script, and an experiment's values lie within their spread."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scripts import reproduce
from tests.scripts.reproduce import EXPERIMENTS, PAGE, Figure, missing, reason, spread, tables

ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.read_text(encoding="utf-8").partition(reproduce.HEADING)[2].splitlines()
    if line.startswith("| ") and not line.startswith("| figure")
]


def masked(text: str) -> str:
    """Return a text without its numbers."""
    return re.sub(r"\d+(\.\d+)?", "#", text)


def test_the_page_has_every_figure_of_the_script() -> None:
    values = {
        name: {
            str(seed): {key: 1.0 for figure in of.figures for key in figure.key.split("|")}
            for seed in range(1 if of.most_seeds == 1 else 3)
        }
        for name, of in EXPERIMENTS.items()
    }
    made = [line.strip("|").split("|") for line in tables(values).splitlines() if line.startswith("| ")]
    expected = [[cell.strip() for cell in row] for row in made if row[0].strip() != "figure"]

    assert [[*row[:2], row[3]] for row in ROWS] == [[*row[:2], row[3]] for row in expected]
    assert [masked(row[5]) for row in ROWS] == [masked(row[5]) for row in expected]


@pytest.mark.slow
@pytest.mark.timeout(600)  # the machine may be shared
def test_an_experiment_gives_what_the_page_says(tmp_path: Path) -> None:
    reproduce.main(["--only", "mount2024", "wind2024", "--seeds", "2", "--workers", "1", "-o", str(tmp_path)])

    kept = json.loads((tmp_path / "values.json").read_text(encoding="utf-8"))
    assert {name: set(seeds) for name, seeds in kept.items()} == {"mount2024": {"0"}, "wind2024": {"0", "1"}}
    assert not list((tmp_path / "work").iterdir())
    figures = {figure.title: (name, figure) for name, of in EXPERIMENTS.items() for figure in of.figures}
    compared = 0
    for title, name, _, _, ours, _ in ROWS:
        if name.strip("`") in kept:
            found = np.array([values[figures[title][1].key] for values in kept[name.strip("`")].values()])
            median, *middle = map(float, re.findall(r"\d+\.\d+", ours))
            low, high = middle or (median - 0.005, median + 0.005)
            assert low <= np.median(found) <= high, title
            compared += 1
    assert compared == 5


def test_what_is_kept_is_not_measured_again() -> None:
    kept = {"wind2024": {"0": {"ratio": 1.0}}}

    assert list(missing(["mount2024", "wind2024"], 2, kept)) == [("mount2024", 0), ("wind2024", 1)]


def test_a_spread_counts_seeds_without_a_value() -> None:
    figure = Figure("a distance", "km", "1 km", "mean of ours {mean} km")

    assert spread([1.0, 2.0, 3.0], figure) == "2.0 km (1.2 to 2.8)"
    assert spread([1.0, 2.0, float("nan"), 3.0], figure) == "2.0 km (1.2 to 2.8), 3 of 4 seeds"
    assert spread([float("nan")], figure) == "no value"
    assert spread([1.0, 2.0, 3.0, 5.0], replace(figure, below=3.0)) == "50 % of orbits"
    assert reason([1.0, 2.0, float("nan"), 6.0], figure) == "mean of ours 3.0 km"
