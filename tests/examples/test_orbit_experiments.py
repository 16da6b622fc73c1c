"""The experiments page prints what it says, as a reader who pastes its blocks finds; and errors that orbits average."""

import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.examples import perfect_solver
from tests.support.exports import in_folder
from tests.support.manualblocks import ROOT, Block, blocks

PAGE = ROOT / "assets" / "manual" / "experiments.md"
# A number of the page, or one unit of its last digit: celestial fixes differ a little between OpenGL drivers.
NUMBER = re.compile(r"\d+(?:\.(\d+))?")


def run(*words: str | Path, folder: Path) -> str:
    """Run a program of the repository in a folder, and return what it prints."""
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(folder)}
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=folder,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
        timeout=550,
    )
    return done.stdout


def glstar(*words: str, folder: Path) -> str:
    """Run a command in a folder, and return what it prints."""
    done = in_folder(folder, *words)
    assert done.rc == 0, done.err
    return str(done.out)


def pasted(block: Block, folder: Path, *more: str) -> str:
    """Run a block as a reader pastes it; `more`: options of its export that shorten it."""
    if block.language == "toml":
        (folder / block.code.splitlines()[0].removeprefix("# ")).write_text(block.code, encoding="utf-8")
        return ""
    if block.language == "python":
        return run("-c", block.code, folder=folder)
    printed = []
    for program, *words in block.commands:
        if program == "glstar":
            printed.append(glstar(*words, *(more if words[0] == "export" else ()), folder=folder))
        else:
            printed.append(run(*words, folder=folder))
    return "".join(printed)


def sections() -> dict[str, tuple[list[Block], list[str]]]:
    """Return the blocks that run in each section of the page, and the lines that it prints, by its title."""
    text = PAGE.read_text(encoding="utf-8")
    starts = [match.start() for match in re.finditer(r"^## ", text, re.M)] + [len(text)]
    found = {}
    for start, stop in pairwise(starts):
        first, last = (text[:at].count("\n") + 1 for at in (start, stop))
        own = [block for block in blocks(PAGE) if first <= block.line <= last]
        lines = re.findall(r"^```text\n(.*?)^```$", text[start:stop], re.M | re.DOTALL)
        found[text[start:stop].splitlines()[0].removeprefix("## ")] = own, "".join(lines).splitlines()
    return found


def is_printed(line: str, printed: str) -> bool:
    """Return whether a program printed a line, but for spaces and one unit of the last digits."""
    words = NUMBER.sub("#", " ".join(line.split()))
    for other in printed.splitlines():
        if NUMBER.sub("#", " ".join(other.split())) == words and all(
            abs(float(a[0]) - float(b[0])) < 1.01 * 10.0 ** -len(a[1] or "")
            for a, b in zip(NUMBER.finditer(line), NUMBER.finditer(other), strict=True)
        ):
            return True
    return False


@pytest.mark.slow
@pytest.mark.timeout(600)  # the machine may be shared
@pytest.mark.parametrize("title", ["2024: orbits with a wrong mount", "2024: wind"])
def test_a_section_prints_what_the_page_says(title: str, tmp_path: Path) -> None:
    own, lines = sections()[title]

    printed = "".join(pasted(block, tmp_path) for block in own)

    assert len(lines) >= 5
    for line in lines:
        assert is_printed(line, printed), f"{line}\nis not in\n{printed}"


@pytest.mark.slow
@pytest.mark.timeout(600)  # the machine may be shared
def test_a_noisy_attitude_is_mended_as_the_page_says(tmp_path: Path) -> None:
    """Six frames instead of all, by --frames: the 3 sigma at most twice that of the page."""
    pytest.importorskip("tetra3rs")
    own, [line] = sections()["2023: a noisy attitude mended by trails"]

    printed = "".join(pasted(block, tmp_path, "--frames", "6") for block in own)

    [found] = [other for other in printed.splitlines() if other.startswith("3 sigma of 6 frames")]
    for stated_deg, found_deg, paper_deg in zip(
        *(map(float, re.findall(r"(\d\.\d+) deg", text)) for text in (line, found)), (0.13, 0.06, 0.06), strict=True
    ):
        assert found_deg < 2 * stated_deg < paper_deg  # of six frames it may be much smaller


def test_every_block_of_the_page_is_run_by_a_test() -> None:
    assert [len(own) for own, _ in sections().values()] == [4, 5, 3, 1]  # the last: test_reproduction.py


def test_numbers_of_the_page_are_compared_to_their_last_digit() -> None:
    assert is_printed("mean 2.57 km", "x\n mean   2.58  km")
    assert not is_printed("mean 2.57 km", "mean 2.59 km")
    assert not is_printed("mean 2.57 km", "median 2.57 km")


# An orbit of 600 m at 22 m/s; 0.4 deg on a sphere of 6371 km are 44.5 km.
ORBIT = """
[camera]
width_px = 64
height_px = 40
fx_px = 64.0
fy_px = 64.0

[sky]
vmag_limit = 2.0

[exposure]
duration_s = 0.05
interval_s = 4.0

[flight.synthetic]
path = "orbit"
radius_m = 600
airspeed_m_per_s = 22
rate_hz = 20
turns = 1.03

[navigator]
{errors}
"""
KM_PER_DEG = 6371 * np.pi / 180


def orbit_of(folder: Path, errors: str) -> dict[str, Any]:
    """Return the score of one orbit by the solver without image errors."""
    (folder / "orbit.toml").write_text(ORBIT.format(errors=errors), encoding="utf-8")
    glstar("export", "-c", "orbit.toml", "-o", "set", "--workers", "1", folder=folder)
    perfect_solver.main(folder / "set", folder / "answers.jsonl")
    [orbit] = json.loads(glstar("score", "set", "answers.jsonl", "--json", folder=folder))["orbits"]
    return orbit


@pytest.mark.parametrize(
    ("errors", "mean_deg", "radius_deg"),
    [
        # Fixed to the body: the fixes go round once, and their mean is the truth.
        ("pitch_bias_deg = 0.235", 0.0, 0.235),
        # A pitch error that turns once per revolution: half of it stays, the other half goes round twice.
        ("revolution_pitch_deg = 0.235\nrevolution_heading_deg = 70", 0.1175, 0.1175),
        # A platform that leans towards one side of the compass: every fix is off by all of it.
        ("revolution_pitch_deg = 0.3\nrevolution_roll_deg = 0.3", 0.3, 0.0),
        # Opposite signs go round twice, and an orbit averages them out.
        ("revolution_pitch_deg = 0.3\nrevolution_roll_deg = -0.3", 0.0, 0.3),
    ],
)
def test_the_mean_of_an_orbit_is_off_by_what_does_not_turn_with_the_body(
    errors: str, mean_deg: float, radius_deg: float, tmp_path: Path
) -> None:
    orbit = orbit_of(tmp_path, errors)

    # The weights by heading leave 0.3 % of the circle; the ellipsoid differs from the sphere by 0.3 %.
    slack_km = 0.005 * (mean_deg + radius_deg) * KM_PER_DEG
    assert orbit["weighted_mean_km"] == pytest.approx(mean_deg * KM_PER_DEG, abs=slack_km)
    assert orbit["radius_km"] == pytest.approx(radius_deg * KM_PER_DEG, abs=slack_km)
