"""The panel Flight without a window: its figures, the part that the map shows, and the row below it."""

from dataclasses import replace
from math import radians
from types import SimpleNamespace

import numpy as np
import pytest
from imgui_bundle import ImVec2, implot

from glstar.sky.place.site import Site, geocentric_m
from glstar.viewer.flight import map as flightmap
from glstar.viewer.flight.map import AircraftState, Footprint, MapLimits
from glstar.viewer.overlays.belief import Belief
from glstar.viewer.ui.panels import flight as flightpanel
from glstar.viewer.ui.panels import settings as settingspanel
from tests.support.scriptedimgui import ScriptedImgui, scripted

SITE = Site(radians(-34.93), radians(138.6), 312.34)
# Metres of a degree of latitude and of longitude there, from the radii of WGS84.
NORTH_M, EAST_M = 110_930.0, 91_387.0


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    return scripted(monkeypatch, flightpanel, settingspanel)


def aircraft(**changes: object) -> AircraftState:
    values = {"roll_rad": radians(-12.345), "pitch_rad": radians(3.456), "yaw_rad": radians(60.0), "site": SITE}
    values |= {"ground_speed_m_per_s": 23.45, "climb_m_per_s": 1.28, "camera_azimuth_rad": radians(200.125)}
    values |= {"camera_altitude_rad": radians(-5.678), "lowest_altitude_rad": radians(-9.0)}
    values |= {"image_azimuths_rad": (radians(170.0), radians(61.5)), "C_camera_ned": np.eye(3)}
    return AircraftState(**values | changes)


def flight(*north_deg: float, live: bool = False) -> SimpleNamespace:
    """Return a flight from `SITE` to the north, one position a second, at heights of 300, 290, 280 ... m."""
    at_rad = SITE.latitude_rad + np.deg2rad(north_deg)

    def coordinates(utc_s: np.ndarray) -> tuple[np.ndarray, ...]:
        k = np.asarray(utc_s - 1000.0, dtype=int)
        return at_rad[k], np.full(len(k), SITE.longitude_rad), 300.0 - 10.0 * k

    position = SimpleNamespace(
        utc_s=1000.0 + np.arange(len(north_deg)),
        latitude_rad=at_rad,
        longitude_rad=np.full(len(north_deg), SITE.longitude_rad),
        height_m=300.0 - 10.0 * np.arange(len(north_deg)),
        coordinates=coordinates,
        at=lambda utc_s: Site(*(float(each[0]) for each in coordinates(np.array([utc_s])))),
    )
    simulator = SimpleNamespace(camera="camera")
    return SimpleNamespace(flight=SimpleNamespace(position=position), is_live=live, simulator=simulator)


def test_the_figures_of_the_flight_are_rows(drawn: ScriptedImgui) -> None:
    beliefs = (Belief("estimate", lacking="too early"), Belief("answer 7", offset_km=(3.0, 4.0)))
    flightpanel._draw_numbers(aircraft(), beliefs)
    assert drawn.take() == [
        *("(roll, pitch)", "-12.35°  +3.46°", "(latitude, longitude)", "-34.93000°  138.60000°", "(height)", "312.3 m"),
        *("(speed, climb)", "23.4 m/s  +1.3 m/s", "(camera alt, az)", "-5.68°  200.12°"),
        *("(image az)", "170.0° to 231.5°", "(estimate)", "too early", "(answer 7)", "5.0 km"),
        "the camera points below the horizon [unsaved_marker]",
    ]
    level = aircraft(ground_speed_m_per_s=np.nan, camera_altitude_rad=0.3, lowest_altitude_rad=0.1)
    flightpanel._draw_numbers(level, ())
    lines = drawn.take()
    assert lines[4:8] == ["(height)", "312.3 m", "(camera alt, az)", "+17.19°  200.12°"]
    assert len(lines) == 10


def test_the_panel_is_of_the_play_head_within_the_flight(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, shown = [], []
    attitude = SimpleNamespace(first_s=1000.0, last_s=1009.0, gap_within=lambda *ends: gaps.get(ends))
    gaps: dict[tuple[float, float], str] = {(1003.0, 1003.0): "gap"}
    simulator = SimpleNamespace(flight=SimpleNamespace(attitude=attitude))
    monkeypatch.setattr(flightpanel, "draw_attitude_controls", lambda _: None)
    monkeypatch.setattr(flightmap, "aircraft_state", lambda _, utc_s: asked.append(utc_s) or aircraft())
    monkeypatch.setattr(flightpanel, "_draw_horizon", lambda _, beliefs, night: shown.append((beliefs, night)))
    session = SimpleNamespace(
        loaded=SimpleNamespace(simulator=simulator),
        scene=None,
        head=SimpleNamespace(utc_s=1005.0),
        is_looking=False,
        night=True,
        image=SimpleNamespace(simulator="image's"),
        navigator=SimpleNamespace(beliefs=lambda loaded, own, scene: (Belief(f"of {own} {scene}"),)),
    )
    panel = flightpanel.FlightPanel()
    monkeypatch.setattr(panel._map, "draw", lambda *_, night: shown.append(night))
    panel.draw(session)
    assert drawn.take() == ["(no flight)"]
    session.scene = "scene"
    for utc_s in (1005.0, 999.0, 1010.0):
        session.head.utc_s = utc_s
        panel.draw(session)
        assert "(of image's scene)" in drawn.take()
    assert asked == [1005.0, 1000.0, 1009.0]
    assert shown[-1]
    session.is_looking = True
    panel.draw(session)
    assert "(of image's scene)" not in drawn.take()
    assert shown[-2] == ((), True)
    session.head.utc_s = 1003.0
    panel.draw(session)
    assert drawn.take() == ["(no attitude at this time: a gap of the log)"]


def test_the_map_has_room_around_its_points() -> None:
    shown = flightpanel.FlightMap()
    shown._track_m = np.zeros((2, 2))
    # 200 m across and 120 m along, and a margin of 12 % of the larger one on each side of a square.
    xy_m = np.array([[-50.0, 30.0], [150.0, np.nan], [20.0, -90.0], [np.nan, 10.0]])
    assert shown._fitted_limits(xy_m) == pytest.approx((50 - 124, 50 + 124, -30 - 124, -30 + 124))
    # At least 50 m of a flight that hardly moves; around a fixed position 1500 km, unless something else is shown.
    near = np.array([[10.0, 20.0], [12.0, 26.0]])
    assert shown._fitted_limits(near) == pytest.approx((11 - 31, 11 + 31, 23 - 31, 23 + 31))
    shown._track_m = np.zeros((1, 2))
    assert shown._fitted_limits(near) == pytest.approx((11 - 9.3e5, 11 + 9.3e5, 23 - 9.3e5, 23 + 9.3e5))
    assert shown._fitted_limits(near * 10) == pytest.approx((110 - 37.2, 110 + 37.2, 230 - 37.2, 230 + 37.2))


def test_the_map_is_around_the_first_position_until_the_aircraft_is_far(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(flightmap, "Coastlines", made.append)
    shown, first, live = flightpanel.FlightMap(), flight(0.0, 0.01, 0.02), flight(0.5, 0.51, live=True)
    shown._is_fitted, shown._typed_ground_m, shown._fits_footprint = False, 5.0, True
    shown._take(first, SITE)
    assert (shown._is_fitted, shown._typed_ground_m, shown._fits_footprint) == (True, None, False)
    assert (shown._lowest_m, shown._ground_m, len(made)) == (280.0, 280.0, 1)
    assert shown._origin == Site(SITE.latitude_rad, SITE.longitude_rad, 300.0)
    np.testing.assert_allclose(shown._track_m, [[0, 0], [0, 0.01 * NORTH_M], [0, 0.02 * NORTH_M]], rtol=1e-3, atol=0.1)
    # The same flight changes nothing, and keeps what the user has chosen.
    shown._is_fitted, shown._typed_ground_m, shown._lowest_m = False, 5.0, -1.0
    shown._graticule = "graticule"
    track_m = shown._track_m
    shown._take(first, replace(SITE, latitude_rad=SITE.latitude_rad + radians(8.9)))
    assert (shown._is_fitted, shown._ground_m, shown._lowest_m, len(made)) == (False, 5.0, -1.0, 1)
    assert shown._track_m is track_m
    # 1000 km are 9.014 deg of latitude there, 10.94 deg of longitude; the map then has another origin.
    far = replace(SITE, latitude_rad=SITE.latitude_rad + radians(9.1))
    shown._take(first, far)
    assert (shown._origin, len(made), shown._is_fitted, shown._ground_m) == (far, 2, False, 5.0)
    assert shown._graticule == (None, [])
    assert shown._track_m[0, 1] == pytest.approx(-9.1 * NORTH_M, rel=0.01)
    # A live flight grows.
    shown._take(live, SITE)
    origin = shown._origin
    assert np.rad2deg(origin.latitude_rad) == pytest.approx(-34.43)
    live.flight = flight(0.5, 0.51, 0.52).flight
    shown._take(live, SITE)
    assert (len(shown._track_m), shown._lowest_m, len(made)) == (3, 280.0, 3)


def footprint(**changes: object) -> Footprint:
    """Return the ground around a place 3 km north and 4 km east of the aircraft."""
    here = geocentric_m(SITE.latitude_rad + radians(3000 / NORTH_M), SITE.longitude_rad + radians(4000 / EAST_M), 0.0)
    values = {"border": np.stack([here, here + 10.0]), "horizon": np.full((2, 3), np.nan), "axis": here}
    return Footprint(**values | changes)


def test_the_row_below_the_map_says_where_the_axis_meets_the_ground(drawn: ScriptedImgui) -> None:
    shown = flightpanel.FlightMap()
    shown._lowest_m = 123.45
    shown._is_fitted = False
    about = (
        "? height of the ground above the WGS84 ellipsoid, for the footprint of the image;\n"
        "at first the lowest height of the flight.  Flat ground, no refraction."
    )
    latitude_deg, longitude_deg = -34.93 + 3000 / NORTH_M, 138.6 + 4000 / EAST_M
    shown._draw_footprint_row(footprint(), SITE)
    lines = drawn.take()
    assert lines[:4] == [
        *("ground, m: 123.5 by 10, 100", about, "<show it>"),
        "? zooms the map to the footprint; a double click returns to the track",
    ]
    assert lines[4] == f"the axis meets the ground at {latitude_deg:.5f}° {longitude_deg:.5f}°, 5.00 km away"
    assert not shown._is_fitted
    drawn.answers = {"ground, m": 56.7, "show it": True}
    near = geocentric_m(SITE.latitude_rad + radians(998.7 / NORTH_M), SITE.longitude_rad, 0.0)
    shown._draw_footprint_row(footprint(axis=near), SITE)
    assert drawn.take()[-1].endswith(", 999 m away")
    assert (shown._ground_m, shown._is_fitted, shown._fits_footprint) == (56.7, True, True)
    # Above the horizon nothing is said of the axis; below the ground the height can be typed.
    nowhere = np.full(3, np.nan)
    shown._draw_footprint_row(footprint(axis=nowhere), SITE)
    assert len(drawn.take()) == 4
    empty = footprint(axis=nowhere, border=np.full((2, 3), np.nan))
    shown._typed_ground_m = SITE.height_m
    shown._draw_footprint_row(empty, SITE)
    assert drawn.take()[2:] == ["no footprint: the aircraft is not above this ground; type the height of the ground"]
    shown._typed_ground_m = SITE.height_m - 0.1
    shown._draw_footprint_row(empty, SITE)
    assert len(drawn.take()) == 2


class Plot(ScriptedImgui):
    """Keeps the lines and points of a plot by their labels."""

    def __init__(self) -> None:
        super().__init__()
        self.plotted: dict[str, np.ndarray] = {}

    def plot_line(self, label: str, east_m: np.ndarray, north_m: np.ndarray, _: object) -> None:
        self.plotted[label] = np.column_stack([east_m, north_m])

    plot_scatter = plot_line

    def get_input_map(self) -> SimpleNamespace:
        return self.map

    map = SimpleNamespace(zoom_rate=0.1)


def test_the_map_shows_track_beliefs_and_footprint_and_is_moved_by_the_mouse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plot = Plot()
    scripted(monkeypatch, flightpanel, drawn=plot)
    seen = footprint(horizon=np.stack([geocentric_m(SITE.latitude_rad, SITE.longitude_rad, 9.0)] * 2))
    asked = []
    monkeypatch.setattr(flightmap, "ground_footprint", lambda *what: asked.append(what) or seen)
    monkeypatch.setattr(flightmap, "graticule", lambda *_: [])
    monkeypatch.setattr(
        flightmap, "Coastlines", lambda _: SimpleNamespace(within=lambda *what: asked.append(what) or [])
    )
    shown, loaded = flightpanel.FlightMap(), flight(0.0, 0.01)
    belief = Belief("answer", offset_km=(-2.0, 0.5), ellipse=(1.0, 0.5, 0.1))
    state = aircraft()
    plot.available = ImVec2(300.0, 400.0)
    shown.draw(loaded, state, (belief, Belief("none")), night=False)
    # Height: 400 px but for four lines of 16 px; limits: 2 km south of the aircraft to 1109 m north, and 500 m east.
    assert plot.named("begin_plot")[0][1] == (-1.0, 336.0)
    west, east, south, north, condition = plot.named("setup_axes_limits")[0]
    assert (north - south, east - west) == pytest.approx((1.24 * 3109.3, 1.24 * 3109.3), rel=1e-3)
    assert ((north + south) / 2, (east + west) / 2) == pytest.approx((-445.3, 250.0), abs=1.0)
    assert condition == int(implot.Cond_.always)
    assert asked[0][:2] == ("camera", state.C_camera_ned)
    assert asked[0][2:] == (SITE, 290.0)
    assert asked[1] == (MapLimits(-1000.0, 1000.0, -800.0, 800.0), 4.0)
    np.testing.assert_allclose(plot.plotted["answer"], [[500.0, -2000.0]], rtol=0, atol=0.2)
    np.testing.assert_allclose(plot.plotted["track"], [[0, 0], [0, 1109.3]], rtol=0, atol=0.5)
    # The pointers are 15 % of the map's extent of 2 km.
    assert np.linalg.norm(plot.plotted["heading"][1]) == pytest.approx(300.0)
    assert "none" not in plot.plotted
    assert plot.map.zoom_rate == 0.1
    np.testing.assert_allclose(plot.plotted["footprint"], [[4000.0, 3000.0]], rtol=2e-3)
    assert "the axis meets" in plot.take()[-1]
    # The wheel is the map's where the mouse is; the map then stays as it is.
    plot.io.mouse_wheel = 1.0
    shown.draw(loaded, state, (), night=False)
    plot.io.mouse_wheel = 0.0
    plot.hovered = True
    shown.draw(loaded, state, (), night=False)
    assert shown._is_fitted
    assert len(plot.named("set_key_owner")) == 1
    plot.take()
    plot.io.mouse_wheel = 1.0
    shown.draw(loaded, state, (), night=False)
    assert plot.named("setup_axes_limits")[0][4] == int(implot.Cond_.once)
    assert not shown._is_fitted
    plot.io.mouse_wheel, plot.pressed = 0.0, {"double 0"}
    shown._fits_footprint = True
    shown.draw(loaded, state, (), night=False)
    assert (shown._is_fitted, shown._fits_footprint) == (True, False)
    plot.pressed = {"drag 0"}
    shown.draw(loaded, state, (), night=False)
    assert not shown._is_fitted
    # On request it shows the footprint, too: 4 km east and 3 km north.
    plot.take()
    plot.hovered, shown._is_fitted, shown._fits_footprint = False, True, True
    shown.draw(loaded, state, (), night=False)
    west, east, south, north, _ = plot.named("setup_axes_limits")[0]
    assert ((east + west) / 2, east - west) == pytest.approx((2000, 1.24 * 4000), rel=5e-3)
    assert (north + south) / 2 == pytest.approx(1500, rel=5e-3)
    # Without a footprint the map has all of the height, up to 480 px and from 190 px on, on a usual screen.
    for room_px, high_px in ((900.0, 720.0), (700.0, 700.0), (200.0, 285.0)):
        plot.take()
        plot.plotted.clear()
        plot.available = ImVec2(300.0, room_px)
        shown.draw(loaded, aircraft(camera_altitude_rad=0.5, lowest_altitude_rad=0.1), (), night=True)
        assert plot.named("begin_plot")[0][1] == (-1.0, high_px)
        assert "footprint" not in plot.plotted
