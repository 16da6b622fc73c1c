"""The example navigator solves random frames; `tests.scripts.celestial_fix_rate` does so for hundreds."""

from pathlib import Path

import pytest

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
