"""The example navigator solves random frames; `tests.scripts.celestial_fix_rate` does so for hundreds."""

from pathlib import Path

import pytest

from tests.scripts.celestial_fix_rate import summary_of

pytest.importorskip("tetra3rs")


@pytest.mark.parametrize(("kind", "frames", "least"), [("static", 8, 8), ("turning", 10, 8)])
def test_most_random_frames_are_solved_and_none_wrongly(kind: str, frames: int, least: int, tmp_path: Path) -> None:
    found = summary_of(kind, frames, tmp_path)

    assert found["frames"] == frames
    assert found["false"] == 0
    assert found["solved"] >= least
    assert found["position_km"]["median"] < 1.852
    assert found["precision"] == 1.0
