"""Scores of data sets: the spread over runs, and frames grouped by the settings of a sweep."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from glstar.errors import AnswersError
from glstar.render.truth.frame import KEYS
from glstar.rotation import about_y, quaternion_from_euler, quaternion_from_matrix
from glstar.score.metrics import MOST_VALUES
from glstar.score.scoring import Run, Score, orbits_by_setting, score

ARCSEC = np.pi / 180 / 3600
KM_PER_DEG = 6378.137 * np.pi / 180
Row = dict[str, Any]


def line(frame: int, *, run: int, wind: float, yaw_rad: float) -> Row:
    """Return a line of truth over the equator with three stars, which cannot be detected."""
    stars = [
        {"star_id": k, "vmag": 4.0, "camera_mag": 4.0, "x_px": 10.0 * k, "y_px": 5.0 * k * k, "centroid_x_px": 10.0 * k}
        | {"centroid_y_px": 5.0 * k * k, "start": [10.0 * k, 5.0 * k * k], "end": [10.0 * k, 5.0 * k * k]}
        | {"peak_dn": 90.0, "flux_dn": 900.0, "in_frame": 1.0, "saturated": False, "snr": 9.0}
        for k in (1, 2, 3)
    ]
    values: Row = dict.fromkeys(KEYS) | {
        "schema": "glstar-truth-2",
        "frame": frame,
        "file": f"frame_{frame:06d}.png",
        "utc_mid": f"2024-03-10T11:{frame // 60:02d}:{frame % 60:02d}.000000Z",
        "duration_s": 0.5,
        "site": {"latitude_deg": 0.0, "longitude_deg": 20.0, "height_m": 0.0},
        "q_body_ned": quaternion_from_euler(0.0, 0.0, yaw_rad).tolist(),
        "C_camera_icrs": np.eye(3).tolist(),
        "camera": {"K": [[100, 0, 50], [0, 100, 50], [0, 0, 1]], "width_px": 101, "height_px": 101, "lens": "none"},
        "catalogue": "bsc5",
        "stars": stars,
        "flight": f"flight {run}",
        "sample": run,
        "settings": {"flight.synthetic.wind_m_per_s": wind, "flight.synthetic.seed": run},
    }
    return values


@pytest.fixture(scope="module")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of an orbit with eight frames each, the last run in wind."""
    folder = tmp_path_factory.mktemp("set")
    rows = [
        line(9 * run + k, run=run, wind=5.0 * (run == 2), yaw_rad=2 * np.pi * k / 8)
        for run in range(3)
        for k in range(9)
    ]
    (folder / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    manifest = {"sensor": {"psf_sigma_px": 1.2, "sky_std_dn": 3.0}}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    return folder


def scored(data_set: Path, answer: Callable[[int, int], Row], folder: Path) -> Score:
    """Return the score of answers, given the run and the frame within it."""
    path = folder / "answers.jsonl"
    rows = [{"frame": frame, **answer(*divmod(frame, 9))} for frame in range(27)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return score(data_set, path)


def test_the_spread_of_three_runs_is_that_of_their_medians(data_set: Path, tmp_path: Path) -> None:
    errors_arcsec = (30.0, 60.0, 90.0)

    def answer(run: int, k: int) -> Row:
        if k == 8 and run == 0:
            return {"status": "refused"}
        q = quaternion_from_matrix(about_y(errors_arcsec[run] * ARCSEC))
        return dict(zip(("qw", "qx", "qy", "qz"), q.tolist(), strict=True))

    found = scored(data_set, answer, tmp_path)

    spread = found.spread
    assert found.json["runs"]["spread"]["runs"] == 3
    boresight = spread["boresight_arcsec"]
    np.testing.assert_allclose(
        (boresight.median, boresight.rms, boresight.p90),
        (60.0, np.sqrt((30**2 + 60**2 + 90**2) / 3), 90.0),
        rtol=0,
        atol=1e-6,
    )
    assert spread["solved_fraction"].count == 3
    assert spread["solved_fraction"].median == 1.0
    bins = dict(found.bins)["flight.synthetic.wind_m_per_s"]
    assert [(label, one.frames) for label, one in bins] == [("0.0", 18), ("5.0", 9)]
    assert "flight.synthetic.seed" not in dict(found.bins)
    assert found.json["runs"]["each"][2]["settings"]["flight.synthetic.seed"] == 2


def test_orbits_belong_to_their_run(data_set: Path, tmp_path: Path) -> None:
    """A circle of 20 km around 3 km north, from eight headings of each run."""

    def answer(run: int, k: int) -> Row:
        heading = 2 * np.pi * k / 8
        north_km, east_km = 3.0 * (run + 1) + 20 * np.cos(heading), 20 * np.sin(heading)
        # The Earth's radius of curvature along the meridian at the equator is 6335.439 km.
        return {"latitude_deg": np.rad2deg(north_km / 6335.439), "longitude_deg": 20.0 + east_km / KM_PER_DEG}

    found = scored(data_set, answer, tmp_path)

    assert [len(run.orbits) for run in found.runs] == [1, 1, 1]
    for run, orbit in enumerate(found.orbits):
        assert orbit.radius_km == pytest.approx(20.0, rel=0, abs=0.02)
        assert orbit.circle_km == pytest.approx(3.0 * (run + 1), rel=0, abs=0.02)
        assert orbit.mean_km == pytest.approx(3.0 * (run + 1), rel=0, abs=0.02)
    assert found.spread["orbit_circle_km"].median == pytest.approx(6.0, rel=0, abs=0.02)


def test_wrong_stars_count_twice_in_kelvins_and_spoil_a_frame_for_lost(data_set: Path, tmp_path: Path) -> None:
    def answer(run: int, _: int) -> Row:
        right = [[10.0, 5.0, 1], [20.0, 20.0, 2]]
        return {"stars": right if run == 0 else [*right, [80.0, 80.0, 3]] if run == 1 else [*right, [30.0, 45.0, None]]}

    found = score(data_set, scored_path(data_set, answer, tmp_path), least_snr=1.0).summary

    # 27 frames: 2/3, (2 - 2)/3 and 2/3 of three detectable stars.
    assert found.number("kelvins") == pytest.approx((2 / 3 + 0 + 2 / 3) / 3, rel=0, abs=1e-12)
    assert found.number("lost_rate") == pytest.approx(2 / 3, rel=0, abs=1e-12)


def scored_path(data_set: Path, answer: Callable[[int, int], Row], folder: Path) -> Path:
    scored(data_set, answer, folder)
    return folder / "answers.jsonl"


def test_an_answer_to_a_frame_of_another_set_is_refused_in_one_line(data_set: Path, tmp_path: Path) -> None:
    (tmp_path / "answers.csv").write_text("frame,qw,qx,qy,qz\n99,1,0,0,0\n", encoding="utf-8")

    with pytest.raises(AnswersError, match="answers frame 99; the truth has 27"):
        score(data_set, tmp_path / "answers.csv")


@pytest.mark.parametrize(
    ("values", "is_grouped"), [(1, False), (2, True), (MOST_VALUES, True), (MOST_VALUES + 1, False)]
)
def test_orbits_are_grouped_by_a_setting_of_few_values(values: int, is_grouped: bool) -> None:
    runs = [
        Run("", k, {"mount.yaw_deg": k, "flight.synthetic.seed": k}, None, (f"orbit {k}",))  # type: ignore[arg-type]
        for k in range(values)
    ]

    grouped = orbits_by_setting(runs)

    expected = {"mount.yaw_deg": {str(k): [f"orbit {k}"] for k in range(values)}} if is_grouped else {}
    assert grouped == expected
