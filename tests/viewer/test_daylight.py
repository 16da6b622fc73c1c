"""Day and twilight in the viewer: intervals of the timeline, the status bar, the message over the image."""

from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from glstar.flight import PositionTrack
from glstar.render.truth.conditions import limiting_magnitude, viewing_conditions
from glstar.sky.air.skybrightness import LIGHT_LEVELS, light_name
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.sky.place.timescale import parse_utc
from glstar.viewer.flight import sky as currentconditions
from glstar.viewer.flight.sky import CurrentConditions, light_intervals
from tests.support.scenes import ADELAIDE
from tests.support.windowinput import press, screen
from tests.viewer.conftest import write_flight

POSITION = PositionTrack.from_samples([0.0], [ADELAIDE.latitude_rad], [ADELAIDE.longitude_rad], [ADELAIDE.height_m])


def sun_deg(utc_s: float) -> float:
    return float(np.rad2deg(sun_altitude_rad(utc_s, ADELAIDE)))


@pytest.mark.parametrize("hours", [3.0, 30.0])
def test_the_ends_of_the_intervals_are_where_the_sun_crosses_the_levels(hours: float) -> None:
    first_s = parse_utc("2024-03-18T08:00:00Z")
    last_s = first_s + 3600 * hours
    found = light_intervals(POSITION, first_s, last_s)

    assert list(found) == [name for name, _ in LIGHT_LEVELS[:-1]]
    edges = {
        name: (np.rad2deg(least), most)
        for (name, least), most in zip(LIGHT_LEVELS, [inf, -0.833, -6, -12], strict=False)
    }
    for name, spans_s in found.items():
        for end_s in set(spans_s.ravel().tolist()) - {first_s, last_s}:
            assert min(abs(sun_deg(end_s) - edge) for edge in edges[name]) < 0.02
        for start_s, stop_s in spans_s:
            assert light_name(np.deg2rad(sun_deg((start_s + stop_s) / 2))) == name
    covered = sum(float(np.diff(spans_s).sum()) for spans_s in found.values())
    night = np.mean([light_name(np.deg2rad(sun_deg(t))) == "night" for t in np.linspace(first_s, last_s, 2001)])
    assert 1 - covered / (last_s - first_s) == pytest.approx(night, abs=1e-3)


def test_a_flight_by_night_has_no_interval_and_one_by_day_a_single_one() -> None:
    night_s, day_s = parse_utc("2024-03-10T11:00:00Z"), parse_utc("2024-03-10T03:00:00Z")
    assert light_intervals(POSITION, night_s, night_s + 12) == {}
    found = light_intervals(POSITION, day_s, day_s + 12)
    assert list(found) == ["day"]
    assert found["day"].tolist() == [[day_s, day_s + 12]]


@pytest.fixture
def day_log(tmp_path: Path) -> Path:
    """Return a flight of 12 s at 03:00 UTC, at noon in Adelaide."""
    text = write_flight(tmp_path / "night.csv").read_text(encoding="utf-8")
    head, *rows = text.splitlines()
    moved = [f"{float(row.partition(',')[0]) - 8 * 3600:.3f},{row.partition(',')[2]}" for row in rows]
    path = tmp_path / "day.csv"
    path.write_text("\n".join([head, *moved]) + "\n", encoding="utf-8")
    return path


def test_the_conditions_of_the_window_are_those_of_its_scene(viewer) -> None:
    session = viewer.session
    assert session.conditions.viewing == viewing_conditions(session.scene)
    assert session.conditions.limit == limiting_magnitude(session.scene)
    assert session.conditions.viewing.warning == ""


def test_while_a_flight_plays_the_conditions_are_computed_twice_a_second(viewer, monkeypatch) -> None:
    session, now_s, count = viewer.session, [0.0], [0]

    def counted(scene):
        count[0] += 1
        return limiting_magnitude(scene)

    monkeypatch.setattr(currentconditions, "limiting_magnitude", counted)
    current = CurrentConditions(lambda: now_s[0])
    session.head.playing = True
    for frame in range(20):
        now_s[0] = 0.1 * frame
        current.of(replace(session.scene), session.head)
    assert count[0] in {4, 5}
    session.head.playing = False
    current.of(replace(session.scene), session.head)
    assert count[0] in {5, 6}


def test_the_image_carries_a_message_by_day_and_the_timeline_is_shaded(viewer, day_log: Path) -> None:
    by_night = screen(viewer).astype(int)
    viewer.open(day_log)
    viewer.session.wait_for_flight()
    for _ in range(3):
        viewer.frame(0.0)
    by_day = screen(viewer).astype(int)
    assert viewer.session.conditions.viewing.warning.startswith("day: the Sun is 5")
    # Light yellow behind the curves: more red than blue where it was grey.
    # The plot in a window of 900 x 600 px, whose first row is the lowest.
    plots = (slice(60, 98), slice(80, 500))
    warm = [np.median(picture[plots][..., 0] - picture[plots][..., 2]) for picture in (by_night, by_day)]
    assert warm[1] - warm[0] > 8
    press(viewer, "N")
    viewer.frame(0.0)
    assert screen(viewer)[..., 1:].max() <= 8
