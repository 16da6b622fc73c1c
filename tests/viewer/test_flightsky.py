"""The sky along a flight, its curves, and the horizon on the map, against values worked out for small inputs."""

from math import atan2, cos, pi, radians, sin
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config, ExposureSection
from glstar.errors import RenderError
from glstar.flight import AttitudeTrack, Gap
from glstar.rotation import quaternion_from_euler
from glstar.sky.air.skybrightness import LIGHT_LEVELS
from glstar.sky.place.site import Site
from glstar.viewer.flight import map as flightmap
from glstar.viewer.flight import sky as flightsky
from glstar.viewer.flight.lookaround import LookAround
from glstar.viewer.flight.others import OtherLog
from glstar.viewer.flight.sky import CurrentConditions, SkySampler, SkySamples, light_intervals
from glstar.viewer.flight.traces import FlightLines, TimelineCurve, Trace, motion_traces
from glstar.viewer.overlays.canvas import ned_to_camera_matrix
from glstar.viewer.skyobjects import _normalized, _rank

SECTION = ExposureSection(duration_s=0.5, interval_s=3.0)


# --- samples of the sky ---


class Simulator(SimpleNamespace):
    """Has as many stars as seconds of the exposure's start; a flight of 24.5 s with a gap from 10 to 12 s."""

    def __init__(self, **changes: Any) -> None:
        def gap_within(start_s: float, stop_s: float) -> str | None:
            return "gap" if start_s < 1012.0 and stop_s > 1010.0 else None

        attitude = SimpleNamespace(first_s=1000.0, last_s=1024.5, gap_within=gap_within)
        super().__init__(**{"flight": SimpleNamespace(attitude=attitude), "composed": []} | changes)

    def scene(self, exposure: Any) -> SimpleNamespace:
        second = exposure.start_utc_s - 1000.0
        self.composed.append(round(second, 3))
        if second == 5.0:
            raise RenderError("too many stars")
        return SimpleNamespace(visible=SimpleNamespace(size=second))


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flightsky, "_PAUSE_S", 0.0)
    limit = lambda scene: SimpleNamespace(at_rest_mag=scene.visible.size + 0.25, trail_mag=scene.visible.size - 0.5)  # noqa: E731
    monkeypatch.setattr(flightsky, "limiting_magnitude", limit)
    monkeypatch.setattr(flightsky, "star_signal_to_noise", lambda scene, star_id: scene.visible.size + star_id)


@pytest.mark.usefixtures("limits")
def test_samples_are_taken_coarsely_first_and_not_across_gaps() -> None:
    simulator = Simulator()
    samples = SkySamples(flightsky._Wanted(simulator, SECTION, 7000))
    samples.compute()
    # 241 exposures in 24 s are 0.1 s from each other; first every 16th, then those halfway, and so on.
    assert simulator.composed[:4] == [0.0, 1.6, 3.2, 4.8]
    assert simulator.composed[14:17] == [0.8, 2.4, 4.0]
    assert len(simulator.composed) == len(set(simulator.composed)) == 241 - 24
    np.testing.assert_allclose(samples.second, 0.25 + 0.1 * np.arange(241), rtol=0, atol=1e-9)
    ((second, stars),) = samples.lines(TimelineCurve.STARS)
    assert samples.known.all()
    in_gap = np.isnan(stars)
    in_gap[50] = False  # that one cannot be composed
    assert np.flatnonzero(in_gap).tolist() == list(range(96, 120))
    assert np.isnan(stars[50])
    at_rest, trail = samples.lines(TimelineCurve.LIMIT)
    ((_, snr),) = samples.lines(TimelineCurve.SNR)
    assert (second[30], stars[30], at_rest[1][30], trail[1][30], snr[30]) == pytest.approx(
        (3.25, 3.0, 3.25, 2.5, 7003.0)
    )
    # Without a star there is no ratio; a flight shorter than an exposure has no sample.
    alone = SkySamples(flightsky._Wanted(simulator, SECTION, None))
    alone.compute()
    assert np.isnan(alone.values[3]).all()
    simulator.flight.attitude.last_s = 1000.3
    short = SkySamples(flightsky._Wanted(simulator, SECTION, None))
    short.compute()
    assert np.isnan(short.values).all()
    cancelled = SkySamples(flightsky._Wanted(simulator, SECTION, None))
    cancelled.cancelled.set()
    cancelled.compute()
    assert cancelled.known.sum() == 1


@pytest.mark.usefixtures("limits")
def test_samples_go_on_for_the_same_flight_section_and_star() -> None:
    sampler, simulator = SkySampler(), Simulator()
    assert not sampler.is_busy
    sampler.wait()
    first = sampler.of(simulator, SECTION, 7)
    assert sampler.of(simulator, ExposureSection(duration_s=0.5, interval_s=3.0), 7) is first
    before = first
    for own, section, star_id in (
        (simulator, SECTION, 8),
        (simulator, ExposureSection(duration_s=0.25), 8),
        (Simulator(), ExposureSection(duration_s=0.25), 8),
    ):
        samples = sampler.of(own, section, star_id)
        assert samples is not before
        assert before.cancelled.is_set()
        before = samples
    sampler.wait()
    assert (sampler.is_busy, before.known.all()) == (False, True)
    sampler.close()
    assert before.cancelled.is_set()


# --- day and twilight ---


def test_light_is_between_the_crossings_of_the_sun(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    # From 10 deg above to 22 deg below the horizon at 1 deg in 100 s.
    monkeypatch.setattr(
        flightsky, "sun_altitude_rad", lambda utc_s, site: asked.append(utc_s) or radians(10.0 - (utc_s - site) / 100)
    )
    position = SimpleNamespace(at=lambda _: 5000.0)
    intervals = light_intervals(position, 5000.0, 8200.0)
    edges_s = [5000.0, *(5000.0 + 100 * (10.0 - np.rad2deg(least)) for _, least in LIGHT_LEVELS[:-1])]
    assert list(intervals) == [name for name, _ in LIGHT_LEVELS[:-1]]
    for (name, _), start_s, stop_s in zip(LIGHT_LEVELS[:-1], edges_s, edges_s[1:], strict=False):
        np.testing.assert_allclose(intervals[name], [[start_s, stop_s]], rtol=0, atol=1e-6)
    # Every 300 s at most, and both ends.
    assert len(asked) == 12
    assert (asked[0], asked[-1]) == (5000.0, 8200.0)
    # A night has none; a day that comes and goes has two.
    monkeypatch.setattr(flightsky, "sun_altitude_rad", lambda *_: radians(-30.0))
    assert light_intervals(position, 5000.0, 5001.0) == {}
    monkeypatch.setattr(flightsky, "sun_altitude_rad", lambda utc_s, _: radians(abs(utc_s - 6000.0) / 100 - 4.0))
    found = light_intervals(position, 5000.0, 7000.0)
    day, least = LIGHT_LEVELS[0]
    half_s = 100 * (4.0 + np.rad2deg(least))
    np.testing.assert_allclose(found[day], [[5000.0, 6000 - half_s], [6000 + half_s, 7000.0]], rtol=0, atol=40.0)
    asked.clear()
    monkeypatch.setattr(flightsky, "sun_altitude_rad", lambda utc_s, _: asked.append(utc_s) or 1.0)
    light_intervals(position, 0.0, 10 * 86400.0)
    assert len(asked) == 301


def test_conditions_are_computed_for_a_new_image_and_twice_a_second_while_it_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, made = [100.0], []
    monkeypatch.setattr(flightsky, "viewing_conditions", lambda scene: made.append(scene.name) or scene.name)
    monkeypatch.setattr(flightsky, "limiting_magnitude", lambda scene: f"limit of {scene.name}")
    current = CurrentConditions(lambda: now_s[0])

    def scene(name: str, sky: str | None = "sky") -> SimpleNamespace:
        return SimpleNamespace(name=name, observing_sky=sky)

    def head(*, playing: bool = False, live: bool = False) -> SimpleNamespace:
        return SimpleNamespace(playing=playing, live=live)

    assert current.of(None, None) is None
    assert current.of(scene("x", None), head()) is None
    first = scene("a")
    found = current.of(first, None)
    assert (found.viewing, found.limit) == ("a", "limit of a")
    assert current.of(first, head()) is found
    assert current.of(scene("b"), head()).viewing == "b"
    assert current.of(scene("c"), head(playing=True)).viewing == "b"
    now_s[0] += 0.49
    assert current.of(scene("d"), head(live=True)).viewing == "b"
    now_s[0] += 0.02
    assert current.of(scene("e"), head(live=True)).viewing == "e"
    assert current.of(scene("f"), None).viewing == "f"
    assert made == ["a", "b", "e", "f"]


# --- curves ---


def test_a_line_is_thinned_to_the_ends_and_extrema_of_its_groups() -> None:
    x = np.arange(16.0)
    y = np.array([3.0, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8, 9, 7, 9, 3])
    line = Trace(x, y, np.zeros(15, dtype=bool))
    # 16 samples on 4 px: groups of four, whose extremes are in the order of their first and last sample.
    shown_x, shown_y = line.thinned(-1.0, 16.0, 4)
    assert shown_x.tolist() == [0, 3, 4, 7, 8, 11, 12, 15]
    assert shown_y.tolist() == [4, 1, 2, 9, 3, 8, 9, 3]
    # 16 on 11 px are 1.45 samples a column: groups of two; on 12 px, 1.33, the samples themselves.
    assert line.thinned(-1.0, 16.0, 11)[0].tolist() == x.tolist()
    assert line.thinned(-1.0, 16.0, 11)[1][:4].tolist() == [3, 1, 4, 1]
    assert line.thinned(-1.0, 16.0, 12)[1].tolist() == y.tolist()
    # One group and a break more than the part to either side.
    assert line.thinned(6.5, 9.5, 100)[0].tolist() == [4, 5, 6, 7, 8, 9, 10, 11, 12]
    broken = np.zeros(15, dtype=bool)
    broken[6] = True
    parts_x, parts_y = Trace(x, y, broken).thinned(-1.0, 16.0, 4)
    assert parts_x.tolist() == [0, 3, 4, 6, 7, 7, 7, 8, 11, 12, 15]
    assert np.flatnonzero(np.isnan(parts_y)).tolist() == [4]
    assert parts_y[[2, 3, 5, 6]].tolist() == [9, 2, 6, 6]


def test_the_lines_of_a_flight_are_broken_at_gaps_and_at_180_degrees() -> None:
    utc_s = np.array([1000.0, 1001, 1002, 1003, 1010, 1011, 1012])
    yaw_deg = np.array([170.0, 175, 180.5, 186, 190, 195, 200])
    q = np.stack([quaternion_from_euler(0.0, 0.0, radians(deg)) for deg in yaw_deg])
    lines = FlightLines.of(AttitudeTrack(utc_s, q, (Gap(1003.0, 1010.0, "a data gap"),)), 990.0)
    assert lines.second.tolist() == [10, 11, 12, 13, 20, 21, 22]
    np.testing.assert_allclose(lines.gaps_s, [[13.0, 20.0]], rtol=0, atol=1e-6)
    x, y = lines.angles[2].thinned(0.0, 100.0, 1000)
    assert np.flatnonzero(np.isnan(y)).tolist() == [2, 5]
    np.testing.assert_allclose(y[~np.isnan(y)], (yaw_deg + 180) % 360 - 180, rtol=0, atol=1e-9)
    assert np.isfinite(lines.angles[0].thinned(0.0, 100.0, 1000)[1]).sum() == 7
    # A rate belongs to the middle of two samples; across the gap there is none.
    x, y = lines.rates[2].thinned(0.0, 100.0, 1000)
    assert x[np.isfinite(y)].tolist() == [10.5, 11.5, 12.5, 20.5, 21.5]
    np.testing.assert_allclose(y[np.isfinite(y)], [5.0, 5.5, 5.5, 5.0, 5.0], rtol=0, atol=1e-6)
    assert np.flatnonzero(np.isnan(y)).tolist() == [3]


def test_a_fixed_position_has_a_height_and_no_speed() -> None:
    position = SimpleNamespace(utc_s=np.array([1000.0]), height_m=np.array([312.5]))
    attitude = SimpleNamespace(first_s=1000.0, last_s=1012.5)
    traces = motion_traces(SimpleNamespace(position=position, attitude=attitude), 990.0)
    x, y = traces[TimelineCurve.HEIGHT][0].thinned(0.0, 100.0, 1000)
    assert (x.tolist(), y.tolist()) == ([10.0, 22.5], [312.5, 312.5])
    assert traces[TimelineCurve.SPEED] == ()


# --- the ground and the map ---


def test_the_horizon_is_where_tangents_touch_the_sphere() -> None:
    for eye in (np.array([1.2, -0.3, 0.4]), np.array([0.0, 0.1, 3.0])):
        points = flightmap._tangent_points(eye)
        assert points.shape == (721, 3)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, rtol=1e-12)
        np.testing.assert_allclose(((eye - points) * points).sum(axis=1), 0.0, rtol=0, atol=1e-12)
        # Around it once, in equal steps of half a degree.
        np.testing.assert_allclose(points[0], points[-1], rtol=0, atol=1e-12)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        radius = np.sqrt(1 - 1 / (eye @ eye))
        np.testing.assert_allclose(steps, 2 * radius * sin(pi / 720), rtol=1e-9)
        assert np.linalg.norm(points[:-1].mean(axis=0) - eye / (eye @ eye)) < 1e-9
    for inside in (np.array([0.3, 0.4, 0.5]), np.array([0.0, 1.0, 0.0])):
        assert np.isnan(flightmap._tangent_points(inside)).all()


def test_rays_meet_the_sphere_at_the_nearer_point() -> None:
    eye = np.array([0.0, 0.0, 2.0])
    rays = np.array([[0.0, 0.0, -3.0], [0.1, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    hits = flightmap._first_hits(eye, rays)
    np.testing.assert_allclose(hits[0], [0, 0, 1], rtol=0, atol=1e-12)
    assert np.linalg.norm(hits[1]) == pytest.approx(1.0)
    along = (hits[1] - eye) / [0.1, 1.0, -1.0]
    assert along[0] == pytest.approx(along[2])
    assert hits[1][2] > 0
    assert np.isnan(hits[2:]).all()
    assert np.isnan(flightmap._first_hits(eye / 4, rays)).all()


@pytest.mark.parametrize("latitude_deg", [89.9, -89.9])
def test_near_a_pole_the_map_has_all_longitudes(latitude_deg: float) -> None:
    """The pole is 0.1 deg, 11.1 km, from the origin: within 12 km of it, not within 10 km."""
    origin = Site(radians(latitude_deg), radians(20.0))
    for half_m, has_pole in ((12_000.0, True), (10_000.0, False)):
        south, north, west, east = flightmap._bounds_deg(origin, flightmap.MapLimits(-half_m, half_m, -half_m, half_m))
        assert (east - west == 360.0) == has_pole
        assert (north if latitude_deg > 0 else -south) == 90.0
        assert (south > 89.0) == (latitude_deg > 0)
        assert (north < -89.0) == (latitude_deg < 0)


# --- looking around and searching ---


@pytest.mark.parametrize(("altitude_deg", "down_px"), [(0.0, 120.0), (-20.0, -90.0)])
def test_a_drag_turns_the_camera_with_the_mouse(altitude_deg: float, down_px: float) -> None:
    look = LookAround(azimuth_rad=1.0, altitude_rad=radians(altitude_deg))
    width, height = look.size_px
    middle = (width - 1) / 2, (height - 1) / 2
    look.grab(*middle)
    look.drag(middle[0], middle[1] + down_px)
    # Of a stereographic lens, r = 2 f tan(theta / 2).
    focal_px = width / 2 / np.tan(look.field_rad / 4)
    angle_rad = 2 * atan2(down_px, focal_px)
    assert look.altitude_rad - radians(altitude_deg) == pytest.approx(angle_rad, rel=1e-6)
    assert look.azimuth_rad == pytest.approx(1.0)
    look.resize(0.2, 99_999.0)
    assert look.size_px[0] >= 1
    look.zoom(1e9)
    narrowest = look.field_rad
    look.zoom(1e-9)
    assert (np.rad2deg(narrowest), np.rad2deg(look.field_rad)) == pytest.approx((2.0, 180.0))


def test_names_match_by_beginnings_of_words_in_their_order() -> None:
    names = ("\u03b1\u00b2 CVn", "M\u00e9nkar", "  HR  2491 ")
    assert [_normalized(name) for name in names] == ["alpha2 cvn", "menkar", "hr 2491"]
    for key, query, rank in (
        ("alpha cma", "alpha cma", 0), ("alpha cma", "alpha c", 1), ("alpha cma", "alp cm", 2), ("alpha cma", "cma", 2),
        ("alpha cma", "cma alpha", 4), ("alpha cma", "lph", 3), ("alpha cma", "ph", 4), ("alpha cma", "x", 4),
    ):  # fmt: skip
        assert _rank(key, query) == rank


def test_the_free_camera_is_level_and_stands_still_beside_the_aircraft(small: Config, log: Path) -> None:
    flight = small.open_flight(log)
    simulator, start_s = small.simulator(flight), flight.attitude.first_s
    look = LookAround(azimuth_rad=2.0, altitude_rad=0.4, field_rad=1.2, size_px=(300, 200))
    own = look.of(simulator)
    assert look.of(simulator) is own
    scene = own.scene(small.exposure.starting_at(start_s + 1.0))
    C_camera_ned = ned_to_camera_matrix(scene.shutter[1:2])
    # Right is level; ahead is at the azimuth and the altitude.
    expected = [
        [-sin(2.0), cos(2.0), 0.0],
        [sin(0.4) * cos(2.0), sin(0.4) * sin(2.0), cos(0.4)],
        [cos(0.4) * cos(2.0), cos(0.4) * sin(2.0), -sin(0.4)],
    ]
    np.testing.assert_allclose(C_camera_ned, expected, rtol=0, atol=3e-6)
    assert look.label == "looking around: az 114.6°, alt 22.9°, 68.8° wide"
    camera = look.camera
    assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (300, 200, 149.5, 99.5)
    # Of a stereographic lens, half of the width is 2 f tan(field / 4).
    assert camera.fx_px == camera.fy_px == pytest.approx(150 / np.tan(0.3))
    half_rad = np.arccos(camera.unit_vectors([[149.5, 99.5]])[0] @ camera.unit_vectors([[299.5, 99.5]])[0])
    assert half_rad == pytest.approx(0.6, rel=1e-6)
    # Its flight is made once for a direction; the same camera is another one of another size.
    flown = own.flight
    look.size_px = (310, 200)
    other = look.of(simulator)
    assert other is not own
    assert other.flight is flown
    look.azimuth_rad = 2.1
    assert look.of(simulator).flight is not flown
    # It turns to a position of the image, and does not turn to one that has no direction.
    look.azimuth_rad, look.altitude_rad = 2.0, 0.4
    look.look_at(np.array([149.5, 99.5]), scene)
    assert (look.azimuth_rad, look.altitude_rad) == pytest.approx((2.0, 0.4), abs=3e-6)
    nowhere = SimpleNamespace(camera=SimpleNamespace(unit_vectors=lambda _: np.full(3, np.nan)))
    look.look_at(np.zeros(2), nowhere)
    assert look.azimuth_rad == pytest.approx(2.0, abs=3e-6)
    # It begins with the aircraft's camera, and the border of its image is around its axis.
    aircraft = simulator.scene(small.exposure.starting_at(start_s + 1.0))
    look.begin(None)
    assert (look.is_on, look.azimuth_rad) == (True, pytest.approx(2.0, abs=3e-6))
    look.field_rad = 2.0
    look.begin(aircraft)
    assert look.field_rad == LookAround().field_rad
    axis = ned_to_camera_matrix(aircraft.shutter[1:2])[2]
    assert np.arcsin(-axis[2]) == pytest.approx(look.altitude_rad)
    assert np.arctan2(axis[1], axis[0]) % (2 * pi) == pytest.approx(look.azimuth_rad % (2 * pi))
    seen = look.of(simulator).scene(small.exposure.starting_at(start_s + 1.0))
    outline = look.outline_px(simulator, seen)
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    np.testing.assert_allclose(middle, [154.5, 99.5], rtol=0, atol=12.0)
    late = SimpleNamespace(exposure=SimpleNamespace(mid_utc_s=start_s + 99.0))
    assert look.outline_px(simulator, late).shape == (0, 2)


def test_another_log_has_angles_where_it_has_an_attitude() -> None:
    q = np.stack([quaternion_from_euler(0.1, -0.2, 0.3)] * 2)
    track = AttitudeTrack(np.array([1000.0, 1001.0]), q)
    log = OtherLog("other", SimpleNamespace(aircraft_attitude=track), {})
    assert log.angles_rad(1000.5) == pytest.approx((0.1, -0.2, 0.3))
    assert log.angles_rad(1002.0) is None
