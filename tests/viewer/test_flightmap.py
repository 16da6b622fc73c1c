"""The map of the panel Flight: coast, graticule and footprint against closed forms, and the map in the window."""

from math import acos, cos, radians, sin, sqrt, tan

import numpy as np
import pytest
from imgui_bundle import ImVec2, imgui
from pyproj import Proj

from glstar.camera.model import Camera
from glstar.sky.place.site import Site, geodetic, local_ned_m
from glstar.system.resources import asset
from glstar.viewer.flight import map as flightmap
from glstar.viewer.flight.map import (
    _EARTH_M,
    Coastlines,
    GraticuleLine,
    MapLimits,
    _bounds_deg,
    _label,
    graticule,
    ground_footprint,
    image_border,
)
from glstar.viewer.ui.panels import flight as flightpanel
from tests.support.windowinput import press, screen
from tests.viewer.test_fitpanel import pressing
from tests.viewer.test_flightpanel import _pixels_of, _write

EQUATOR_M, E2 = 6378137.0, 0.00669437999014
CAMERA = Camera(width_px=400, height_px=300, fx_px=400.0, fy_px=400.0, cx_px=199.5, cy_px=149.5)
HEIGHT_M, GROUND_M = 1200.0, 200.0
# The side of the map in a window of 900 x 600, and colours of its lines by day.
COAST, FOOTPRINT = (0.50, 0.62, 0.50), (0.95, 0.55, 0.35)
MIDDLE = (780.0, 480.0)


def _pointing_east(depression_deg: float) -> np.ndarray:
    """Return the rotation from north, east, down of a camera that points east and down, its right to the south."""
    s, c = sin(radians(depression_deg)), cos(radians(depression_deg))
    return np.array([[-1.0, 0.0, 0.0], [0.0, -s, c], [0.0, c, s]])


def test_rays_meet_flat_ground_where_trigonometry_says():
    site = Site(radians(-35.0), radians(138.6), GROUND_M + 100.0)
    seen = ground_footprint(CAMERA, _pointing_east(90.0), site, GROUND_M)
    ned_m = local_ned_m(site, seen.border)
    np.testing.assert_allclose(ned_m[:, 2], 100.0, rtol=0, atol=0.01)
    # Half of the image is 200 px to the sides and 150 px along, at a focal length of 400 px.
    assert np.abs(ned_m[:, 0]).max() == pytest.approx(50.0, rel=0, abs=0.01)
    assert np.abs(ned_m[:, 1]).max() == pytest.approx(37.5, rel=0, abs=0.01)
    np.testing.assert_allclose(local_ned_m(site, seen.axis), [0, 0, 100.0], rtol=0, atol=0.01)
    assert not np.isfinite(seen.horizon).any()


@pytest.mark.parametrize("depression_deg", [1.5, 5.0, 30.0])
def test_along_the_equator_the_ground_is_a_circle(depression_deg):
    site = Site(0.0, radians(10.0), HEIGHT_M)
    seen = ground_footprint(CAMERA, _pointing_east(depression_deg), site, GROUND_M)
    latitude_rad, longitude_rad, height_m = geodetic(seen.axis)
    delta = radians(depression_deg)
    ratio = (EQUATOR_M + HEIGHT_M) / (EQUATOR_M + GROUND_M)
    expected_rad = acos(ratio * cos(delta)) - delta  # the law of sines in the triangle with the Earth's centre
    assert longitude_rad - radians(10.0) == pytest.approx(abs(expected_rad), rel=1e-8)
    assert latitude_rad == pytest.approx(0.0, abs=1e-12)
    assert height_m == pytest.approx(GROUND_M, abs=1e-3)


def test_the_footprint_ends_at_the_horizon():
    site = Site(0.0, radians(10.0), HEIGHT_M)
    seen = ground_footprint(CAMERA, _pointing_east(0.0), site, GROUND_M)
    assert not np.isfinite(seen.axis).any()  # the horizon is 1 deg below the horizontal
    on_horizon = seen.horizon[np.isfinite(seen.horizon).all(axis=1)]
    _, east_m, _ = local_ned_m(site, on_horizon).T
    # The tangent from outside of a circle; to the sides the camera sees 26.6 deg.
    radius_m = EQUATOR_M + GROUND_M
    farthest_m = sqrt((EQUATOR_M + HEIGHT_M) ** 2 - radius_m**2)
    assert east_m.max() == pytest.approx(farthest_m, rel=1e-3)
    assert east_m.min() == pytest.approx(farthest_m * cos(radians(26.57)), rel=0.02)
    border_m = local_ned_m(site, seen.border[np.isfinite(seen.border).all(axis=1)])
    # The lower edge of the image is 20.56 deg down: 1000 m / tan.
    assert border_m[:, 1].min() == pytest.approx((HEIGHT_M - GROUND_M) / tan(radians(20.556)), rel=2e-3)


def test_the_sky_and_the_ground_itself_have_no_footprint():
    up = ground_footprint(CAMERA, _pointing_east(-40.0), Site(0.5, 0.1, HEIGHT_M), 0.0)
    below = ground_footprint(CAMERA, _pointing_east(40.0), Site(0.5, 0.1, 10.0), GROUND_M)
    assert up.is_empty
    assert below.is_empty


# Capes by their coordinates in gazetteers, deg.
CAPES = {
    "Cape of Good Hope": (-34.357, 18.472),
    "Cabo da Roca": (38.781, -9.500),
    "Cape Byron": (-28.638, 153.636),
    "Point Barrow": (71.388, -156.479),
    "Cape Reinga": (-34.427, 172.681),
}


@pytest.mark.parametrize("cape", CAPES)
def test_the_coast_passes_a_cape_and_is_drawn_only_near(cape):
    coast = Coastlines(Site(*np.deg2rad(CAPES[cape])))
    near_m = coast.within(MapLimits(-2e5, 2e5, -2e5, 2e5), 1.0)
    assert np.nanmin(np.hypot(*near_m.T)) < 8000
    assert len(near_m) < 3000


@pytest.mark.parametrize("place", [(-23.7, 133.9), (0.0, -150.0), (40.0, -35.0)])
def test_there_is_no_coast_inland_and_at_sea(place):
    coast = Coastlines(Site(*np.deg2rad(place)))
    assert not (np.hypot(*coast.within(MapLimits(-3e5, 3e5, -3e5, 3e5), 1.0).T) < 3e5).any()


def test_the_coast_of_half_of_the_earth_is_drawn_coarsely():
    coast = Coastlines(Site(0.2, 0.3))
    whole_m = coast.within(MapLimits(-7e6, 7e6, -7e6, 7e6), 50_000.0)
    assert len(whole_m) < 12_000
    assert np.nanmax(np.hypot(*whole_m.T)) < 1.001 * EQUATOR_M
    assert asset("coastlines.npz").stat().st_size < 100_000


def test_the_graticule_lies_where_the_ellipsoid_has_it():
    lines = {line.label: line for line in graticule(Site(0.0, radians(10.0)), MapLimits(-4e5, 4e5, -4e5, 4e5))}
    assert {"2\N{DEGREE SIGN}N", "2\N{DEGREE SIGN}S", "8\N{DEGREE SIGN}E", "12\N{DEGREE SIGN}E"} <= set(lines)
    meridian = lines["12\N{DEGREE SIGN}E"].xy_m
    crossing = np.abs(meridian[:, 1]).argmin()
    assert meridian[crossing, 0] == pytest.approx(EQUATOR_M * sin(radians(2.0)), rel=1e-5)
    parallel = lines["2\N{DEGREE SIGN}N"].xy_m
    middle = np.abs(parallel[:, 0]).argmin()
    across_m = EQUATOR_M / sqrt(1 - E2 * sin(radians(2.0)) ** 2)
    assert parallel[middle, 1] == pytest.approx(across_m * (1 - E2) * sin(radians(2.0)), rel=1e-5)


@pytest.mark.parametrize(
    ("origin_deg", "half_m", "wanted"),
    [
        ((89.99, 20.0), 5000.0, {"150\N{DEGREE SIGN}W", "30\N{DEGREE SIGN}E", "180\N{DEGREE SIGN}"}),
        ((0.0, 179.9999), 5000.0, {"180.00\N{DEGREE SIGN}", "179.95\N{DEGREE SIGN}W", "179.95\N{DEGREE SIGN}E"}),
        ((-34.93, 138.6), 500.0, {"34.930\N{DEGREE SIGN}S", "138.600\N{DEGREE SIGN}E"}),
        ((-34.93, 138.6), 7e6, {"0\N{DEGREE SIGN}", "30\N{DEGREE SIGN}S", "150\N{DEGREE SIGN}E"}),
    ],
)
def test_the_graticule_has_a_few_lines_anywhere(origin_deg, half_m, wanted):
    lines = graticule(Site(*np.deg2rad(origin_deg)), MapLimits(-half_m, half_m, -half_m, half_m))
    labels = {(line.label, line.is_parallel) for line in lines}
    assert wanted <= {label for label, _ in labels}
    assert len(lines) == len(labels) <= 20


def _frames(viewer, count=3):
    for _ in range(count):
        viewer.frame(0.0)
    return screen(viewer)[::-1].astype(int)


def _show_flight(viewer):
    imgui.set_window_focus("Flight")
    return _frames(viewer, 4)


@pytest.mark.parametrize("origin_deg", [(-35.0, 138.6), (0.0, 179.9), (62.0, -10.0), (-89.0, 20.0), (89.9, 0.0)])
@pytest.mark.parametrize("half_m", [300.0, 2e4, 1e6])
def test_the_graticule_reaches_a_sixteenth_beyond_the_map(origin_deg, half_m):
    """Every point of a part of the map, which lies south-east of its origin, on PROJ's orthographic map of a sphere."""
    origin = Site(radians(origin_deg[0]), radians(origin_deg[1]))
    limits = MapLimits(-half_m, 3 * half_m, -2 * half_m, half_m)
    south, north, west, east = _bounds_deg(origin, limits)
    ortho = Proj(proj="ortho", lat_0=origin_deg[0], lon_0=origin_deg[1], R=_EARTH_M)
    x_m, y_m = np.meshgrid(np.linspace(-half_m, 3 * half_m, 401), np.linspace(-2 * half_m, half_m, 401))
    longitude_deg, latitude_deg = ortho(x_m, y_m, inverse=True)
    margin_deg = np.rad2deg(max(4, 3) * half_m / _EARTH_M) / 16
    x_pole_m, y_pole_m = ortho(0.0, np.copysign(90.0, origin_deg[0]))
    if abs(x_pole_m) < half_m and -2 * half_m < y_pole_m < half_m:
        assert (east - west, (north, -south)[origin_deg[0] < 0]) == (360.0, 90.0)
    else:
        off_deg = (longitude_deg - origin_deg[1] + 180) % 360 - 180 + origin_deg[1]
        wide_deg = margin_deg / max(cos(origin.latitude_rad), 0.02)
        assert west == pytest.approx(off_deg.min() - wide_deg, rel=0, abs=0.01 * wide_deg)
        assert east == pytest.approx(off_deg.max() + wide_deg, rel=0, abs=0.01 * wide_deg)
    if north < 90:
        assert north == pytest.approx(latitude_deg.max() + margin_deg, rel=0, abs=0.01 * margin_deg)
    if south > -90:
        assert south == pytest.approx(latitude_deg.min() - margin_deg, rel=0, abs=0.01 * margin_deg)
    assert -90 <= south < north <= 90


@pytest.mark.parametrize(
    ("value_deg", "step_deg", "sides", "label"),
    [
        (138.6, 0.1, "EW", "138.6°E"),
        (-138.6, 0.2, "EW", "138.6°W"),
        (-34.925, 0.005, "NS", "34.925°S"),
        (30.0, 10.0, "NS", "30°N"),
        (0.0, 0.01, "NS", "0.00°"),
        (180.0, 1.0, "EW", "180°"),
        (-180.0, 1.0, "EW", "180°"),
        (-179.0, 1.0, "EW", "179°W"),
        (0.1, 0.1, "EW", "0.1°E"),
    ],
)
def test_lines_of_the_graticule_have_the_digits_of_their_step(value_deg, step_deg, sides, label):
    assert _label(value_deg, step_deg, sides) == label


class _PlotOfText:
    """A plot of 400 x 300 px at (100, 50), 1 px a metre, north up, and text of 40 x 10 px: records labels."""

    def __init__(self):
        self.labels = []

    def plot_to_pixels(self, east_m, north_m):
        return ImVec2(100.0 + east_m, 350.0 - north_m)

    def get_plot_pos(self):
        return ImVec2(100.0, 50.0)

    def get_plot_size(self):
        return ImVec2(400.0, 300.0)

    def calc_text_size(self, _text):
        return ImVec2(40.0, 10.0)

    def get_color_u32(self, _colour):
        return 0

    def get_plot_draw_list(self):
        return self

    def add_text(self, corner, _colour, text):
        self.labels.append((text, corner.x, corner.y))


@pytest.mark.parametrize(
    ("is_parallel", "xy_m", "expected"),
    [
        # Above the left end of a parallel, inside the plot, but not on the lowest lines of text nor above the plot.
        (True, [(-50.0, 150.0), (20.0, 150.0), (390.0, 150.0)], (103.0, 190.0)),
        (True, [(0.0, 35.0), (400.0, 35.0)], (103.0, 305.0)),
        (True, [(0.0, 15.0), (400.0, 15.0)], None),
        (True, [(0.0, 295.0), (400.0, 295.0)], None),
        (True, [(0.0, 310.0), (400.0, 310.0)], None),
        # In the middle below a meridian's lower end, moved into the plot.
        (False, [(200.0, -10.0), (200.0, 5.0), (200.0, 290.0)], (280.0, 333.0)),
        (False, [(1.0, 0.0), (1.0, 290.0)], (103.0, 338.0)),
        (False, [(399.0, 0.0), (399.0, 290.0)], (457.0, 338.0)),
        (False, [(np.nan, np.nan), (401.0, 0.0)], None),
    ],
)
def test_a_line_of_the_graticule_is_labelled_at_its_end_in_the_plot(monkeypatch, is_parallel, xy_m, expected):
    plot = _PlotOfText()
    monkeypatch.setattr(flightpanel, "implot", plot)
    monkeypatch.setattr(flightpanel, "imgui", plot)
    line = GraticuleLine("label", is_parallel, np.array(xy_m))
    flightpanel._draw_label(line, MapLimits(0.0, 400.0, 0.0, 300.0), (1.0, 1.0, 1.0, 1.0))
    assert plot.labels == ([] if expected is None else [("label", *expected)])


def test_the_wheel_zooms_out_to_the_coast_and_a_double_click_returns(make_viewer, tmp_path):
    viewer = make_viewer(_write(tmp_path / "north.csv", north_deg_per_s=1e-4))
    first = _show_flight(viewer)
    assert len(_pixels_of(first, COAST)[0]) == 0
    io = imgui.get_io()
    io.add_mouse_pos_event(*MIDDLE)
    _frames(viewer)  # as a hand moves the mouse
    for _ in range(30):
        io.add_mouse_wheel_event(0.0, -1.0)
        viewer.frame(0.0)
    assert len(_pixels_of(_frames(viewer), COAST)[0]) > 30
    for down in (True, False, True, False):
        io.add_mouse_button_event(0, down)
        viewer.frame(0.0)
    io.add_mouse_pos_event(2.0, 2.0)
    again = _frames(viewer)
    assert len(_pixels_of(again, COAST)[0]) == 0
    np.testing.assert_array_equal(again[400:580, 680:], first[400:580, 680:])


def test_a_camera_that_points_down_shows_its_footprint(make_viewer, small, tmp_path):
    log = _write(tmp_path / "climbing.csv", north_deg_per_s=1e-4, climb=10.0)
    viewer = make_viewer(log, config=small.override(**{"mount.pitch_deg": -90.0}))
    viewer.session.head.seek(viewer.session.head.first_s + 8.0)
    seen = _show_flight(viewer)
    assert len(_pixels_of(seen, FOOTPRINT)[0]) > 10
    press(viewer, "N")
    assert _frames(viewer)[..., 1:].max() == 0


def test_a_footprint_as_far_as_the_horizon_is_shown_on_demand(make_viewer, small, tmp_path, monkeypatch):
    log = _write(tmp_path / "high.csv", north_deg_per_s=1e-4, climb=200.0)
    viewer = make_viewer(log, config=small.override(**{"mount.yaw_deg": 0.0, "mount.pitch_deg": -3.0}))
    viewer.session.head.seek(viewer.session.head.first_s + 8.0)
    legend_px = len(_pixels_of(_show_flight(viewer), FOOTPRINT)[0])
    pressing(monkeypatch).add("show it")
    assert len(_pixels_of(_frames(viewer), FOOTPRINT)[0]) > legend_px + 10


def test_a_fixed_position_is_shown_with_its_coast(make_viewer, tmp_path):
    path = tmp_path / "fixed.csv"
    path.write_text("utc_s,roll_deg,pitch_deg,yaw_deg\n" + "".join(f"{1710068400 + t},0,0,{t}\n" for t in range(10)))
    viewer = make_viewer(None)
    viewer.session.change(**{"flight.latitude_deg": -34.93, "flight.longitude_deg": 138.6})
    viewer.open(path)
    viewer.session.wait_for_flight()
    _frames(viewer)
    assert len(_pixels_of(_show_flight(viewer), COAST)[0]) > 30


def test_the_border_of_an_image_is_closed_and_runs_along_its_edges():
    xy_px = CAMERA.project(image_border(CAMERA))
    np.testing.assert_allclose(xy_px[0], xy_px[-1], rtol=0, atol=1e-9)
    # 128 points on each side, clockwise from the top left corner.
    corners = [[-0.5, -0.5], [399.5, -0.5], [399.5, 299.5], [-0.5, 299.5], [-0.5, -0.5]]
    np.testing.assert_allclose(xy_px[::128], corners, rtol=0, atol=1e-9)
    off_px = np.abs(xy_px[:, np.newaxis] - [[-0.5, -0.5], [399.5, 299.5]]).min(axis=(1, 2))
    np.testing.assert_allclose(off_px, 0, rtol=0, atol=1e-9)
    assert np.linalg.norm(np.diff(xy_px, axis=0), axis=1).max() < 3.2


def test_the_coast_is_that_of_its_asset(monkeypatch):
    """Two lines, the first longer than a part: 70 points along a parallel, and two along a meridian."""
    steps = np.array([[100, 200], *[[0, 1]] * 69, [5000, -300], [1, 0]])
    stored = {"latitude_steps": steps[:, 0], "longitude_steps": steps[:, 1], "points": np.array([70, 2])}

    class _Asset(dict):
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

    monkeypatch.setattr(flightmap.np, "load", lambda _: _Asset(stored))
    latitude_rad, longitude_rad, starts = flightmap._coast.__wrapped__()
    # A part of 64 points, one of the other 7 that begins with the last of the first, and the second line.
    assert starts.tolist() == [0, 65, 73]
    first = 2 + np.arange(70) / 100
    expected = [*first[:64], np.nan, *first[63:], np.nan, -3.0, -3.0, np.nan]
    np.testing.assert_allclose(np.rad2deg(longitude_rad), expected, rtol=0, atol=1e-9)
    assert np.rad2deg(latitude_rad[[0, 71, 73, 74]]) == pytest.approx([1.0, 1.0, 50.0, 50.01])


def test_points_in_the_same_pixel_are_left_out_and_gaps_stay(monkeypatch):
    east_deg = np.array([0.0, 0.001, 0.002, 0.011, np.nan, 1.0, 1.1, np.nan])
    coast = np.deg2rad(np.where(np.isnan(east_deg), np.nan, 0.0)), np.deg2rad(east_deg), np.array([0, 5])
    monkeypatch.setattr(flightmap, "_coast", lambda: coast)
    lines = Coastlines(Site(0.0, 0.0))
    near_m = lines.within(MapLimits(-100.0, 5000.0, -10.0, 10.0), 1000.0)
    # 0, 111, 223 and 1224 m east of the origin; the second line, 111 km away, is not on this part.
    np.testing.assert_allclose(near_m[:, 0], [0.0, 1224.5, np.nan], rtol=0, atol=0.1)
    assert len(lines.within(MapLimits(-100.0, 5000.0, -10.0, 10.0), 100.0)) == 5
    assert len(lines.within(MapLimits(-100.0, 2e5, -10.0, 10.0), 1000.0)) == 6
    # Beside a line on every side.
    for limits in ((-2e3, -1e3, -10, 10), (2e5, 3e5, -10, 10), (-100, 5e3, 1, 10), (-100, 5e3, -10, -1)):
        assert len(lines.within(MapLimits(*map(float, limits)), 100.0)) == 0


def test_a_map_beside_the_earth_has_all_of_it_as_bounds():
    far_m = 2 * EQUATOR_M
    assert _bounds_deg(Site(0.5, 0.1), MapLimits(far_m, far_m + 1e5, -5e4, 5e4)) == (-90.0, 90.0, -180.0, 180.0)
