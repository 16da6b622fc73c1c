"""The example navigator solves random frames; `tests.scripts.celestial_fix_rate` does so for hundreds."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import glstar as gs
from tests.examples import celestial_fix
from tests.scripts.celestial_fix_rate import summary_of, summary_of_accelerated

pytest.importorskip("tetra3rs")


@pytest.mark.parametrize(("kind", "frames", "least"), [("static", 8, 8), ("turning", 10, 8)])
def test_most_random_frames_are_solved_and_none_wrongly(kind: str, frames: int, least: int, tmp_path: Path) -> None:
    found = summary_of(kind, frames, tmp_path)

    assert found["frames"] == frames
    assert found["false"] == 0
    assert found["solved"] >= least
    assert found["position_km"]["median"] < 1.852
    assert found["precision"] == 1.0


def test_frames_whose_rate_changes_are_refused(tmp_path: Path) -> None:
    # The second turns back; the last has a constant rate.
    found = summary_of_accelerated([(0.0, 20.0), (-10.0, 10.0), (10.0, 10.0)], tmp_path)

    assert (found["solved"], found["refused"], found["false"]) == (1, 2, 0)
    assert found["position_km"]["median"] < 1.852


def test_a_vertical_that_puts_the_image_below_the_horizon_is_refused() -> None:
    """A vertical that was 180 deg off, of a simulator that lay on its back, ended the solver with a traceback."""
    catalogue = gs.StarCatalogue.open("bsc5").brighter_than(celestial_fix.FAINTEST_VMAG)
    camera, middle_px = gs.Camera(640, 480, 600.0, 600.0, 319.5, 239.5), np.full((12, 2), 100.0)
    u_gcrs, rough = celestial_fix.apparent_directions(catalogue, 1.7e9), np.eye(3)

    assert celestial_fix.attitude(middle_px, camera, rough, catalogue, u_gcrs, np.array([0.0, 0.0, -1.0])) is None


@pytest.mark.slow
def test_the_workflow_draws_solves_and_keeps_its_limits(tmp_path: Path) -> None:
    examples = Path(__file__).parent
    shutil.copytree(examples / "gate", tmp_path / "repository")
    shutil.copyfile(examples / "celestial_fix.py", tmp_path / "repository" / "solver.py")
    (job,) = yaml.safe_load((examples / "gate" / "score.yml").read_text(encoding="utf-8"))["jobs"].values()
    commands = [shlex.split(step["run"]) for step in job["steps"] if step.get("name") in {"Draw", "Solve", "Score"}]
    assert len(commands) == 3

    for command in commands:
        program = ["-m", "glstar"] if command[0] == "glstar" else []
        done = subprocess.run(
            [sys.executable, *program, *command[1:]],
            check=False,
            cwd=tmp_path / "repository",
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr

    verdicts = json.loads((tmp_path / "repository" / "score" / "score.json").read_text())["gate"]["verdicts"]
    assert [verdict["passed"] for verdict in verdicts] == [True] * 4
