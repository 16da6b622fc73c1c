"""Geometry of the overlays, against dense sampling and vector algebra written out."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.viewer.overlays import table
from glstar.viewer.overlays.canvas import (
    Canvas,
    arrow_strokes,
    ned_to_camera_matrix,
    residual_scale,
    round_stride,
    unit_by_larger_component,
)
from glstar.viewer.overlays.curves import (
    Crossings,
    Curves,
    Grids,
    ImageRegion,
    Polylines,
    _bend_px_per_rad2,
    _hours,
    compass_ned,
    cut,
    great_circle,
    horizon_curve,
    inside_region,
    max_step_rad,
    parallel,
    region_planes,
)
from glstar.viewer.ui.painting import Rect, _disjoint
from tests.support.scenes import camera, stars_at

LENS = camera(320, 240, 300.0)
FISHEYE = replace(camera(320, 240, 150.0), lens=Lens("fisheye", (0.02, 0.0, 0.0, 0.0)))
REGION = ImageRegion(20.0, 30.0, 250.0, 200.0)


def units(count: int, seed: int = 1) -> np.ndarray:
    v = np.random.default_rng(seed).normal(0, 1, (count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_regions_have_their_edges_and_what_they_share() -> None:
    assert ImageRegion.complete(LENS) == (-0.5, -0.5, 319.5, 239.5)
    xy = np.array([[20.0, 30], [250, 200], [19.9, 50], [250.1, 50], [50, 29.9], [50, 200.1], [np.nan, 50]])
    assert REGION.contains(xy).tolist() == [True, True, False, False, False, False, False]
    assert REGION.intersection(ImageRegion(0, 50, 100, 300)) == (20, 50, 100, 200)
    assert REGION.intersection(ImageRegion(300, 250, 400, 300)) == (300, 250, 300, 250)
    lines = Polylines(np.arange(20.0).reshape(10, 2), np.array([0, 3, 5, 8]), np.array([0, 2, 2, 3]))
    some = lines.of_curves(2, 3)
    assert (some.xy_px[:, 0].tolist(), some.starts.tolist(), some.curve.tolist()) == (
        [6, 8, 10, 12, 14],
        [0, 2],
        [2, 2],
    )
    assert len(lines.of_curves(1, 2).xy_px) == 0
    assert len(lines.of_curves(3, 9).xy_px) == 2
    crossings = Crossings(np.array([1, 2, 4, 2]), lines.xy_px[:4], lines.xy_px[:4])
    own = crossings.of_curves(2, 4)
    assert (own.curve.tolist(), own.xy_px[:, 0].tolist(), own.anchor[:, 1].tolist()) == ([0, 0], [2, 6], [3, 7])


def test_circles_have_vertices_at_every_step() -> None:
    for latitude, step in ((0.3, 0.02), (-1.2, 0.1), (0.0, 0.5)):
        chain = parallel(latitude, step)
        np.testing.assert_allclose(chain[:, 2], np.sin(latitude), rtol=0, atol=1e-12)
        longitude = np.unwrap(np.arctan2(chain[:, 1], chain[:, 0]))
        np.testing.assert_allclose(np.diff(longitude), 2 * np.pi / (len(chain) - 1), rtol=1e-7)
        assert (len(chain) - 1) % 72 == 0
        assert longitude[1] * np.cos(latitude) <= step
        assert len(chain) == 73 or 2 * np.pi * np.cos(latitude) / (len(chain) - 73) > step
    ends = units(3)
    chain = great_circle(ends, 0.1)
    row = 0
    for a, b in pairwise(ends):
        angle = np.arccos(a @ b)
        n = int(np.ceil(angle / 0.1))
        across = b - (a @ b) * a
        across /= np.linalg.norm(across)
        at = np.arange(n + 1)[:, np.newaxis] * angle / n
        np.testing.assert_allclose(chain[row : row + n + 1], np.cos(at) * a + np.sin(at) * across, rtol=0, atol=1e-9)
        row += n
    assert len(chain) == row + 1
    short = great_circle(np.array([[1.0, 0, 0], [np.cos(0.05), np.sin(0.05), 0]]), 0.1)
    np.testing.assert_allclose(short, [[1, 0, 0], [np.cos(0.05), np.sin(0.05), 0]], rtol=1e-7)


def test_chords_are_as_long_as_their_curves_allow_on_the_image() -> None:
    scale = LENS.max_px_per_rad
    for curvature in (0.5, 4.0):
        step = max_step_rad(LENS, curvature)
        assert step == pytest.approx(np.sqrt(8 * 0.2 / (scale * curvature)))
    assert max_step_rad(LENS, 0.0) == pytest.approx(np.deg2rad(5))
    assert max_step_rad(LENS, 1e6) == pytest.approx(np.deg2rad(0.2))
    skewed = replace(LENS, skew_px=60.0)
    assert max_step_rad(skewed, 4.0) == pytest.approx(np.sqrt(1.6 / (4.0 * skewed.max_px_per_rad * 1.2)))
    assert _bend_px_per_rad2(LENS) == 0
    # Second derivatives along random great circles through random points of the image.
    rng = np.random.default_rng(2)
    at = FISHEYE.unit_vectors(rng.uniform([-0.5, -0.5], [319.5, 239.5], (4000, 2)))
    along = np.cross(at, units(4000, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    h = 2e-3
    positions = [FISHEYE.project(at * np.cos(s) + along * np.sin(s)) for s in (-h, 0, h)]
    second = np.linalg.norm(positions[0] - 2 * positions[1] + positions[2], axis=1) / h**2
    assert _bend_px_per_rad2(FISHEYE) / 4 == pytest.approx(np.nanmax(second), rel=0.1)
    step = max_step_rad(FISHEYE, 0.0)
    expected = np.sqrt(1.6 / (FISHEYE.max_px_per_rad * 1e-9 + _bend_px_per_rad2(FISHEYE)))
    assert step == pytest.approx(expected)


def test_curves_near_a_cone_keep_every_chord_that_touches_it() -> None:
    chains = [great_circle(units(4, seed), 0.07) for seed in (1, 2, 3)]
    curves = Curves.of(chains)
    longest = max(np.arccos((c[1:] * c[:-1]).sum(axis=1)).max() for c in chains)
    assert (curves.count, curves.step_rad) == (3, pytest.approx(longest))
    axis, radius = units(1, 9)[0], 0.6
    vector, curve, joined = curves.near(axis, radius)
    kept = {tuple(v) for v in vector}
    for k, chain in enumerate(chains):
        for a, b in pairwise(chain):
            if max(a @ axis, b @ axis) > np.cos(radius):
                index = next(i for i, v in enumerate(vector) if (v == a).all() and curve[i] == k)
                assert joined[index]
                assert (vector[index + 1] == b).all()
                assert tuple(b) in kept
    assert (vector @ axis > np.cos(radius + longest) - 1e-12).all()
    assert not joined[-1]
    for i in np.flatnonzero(joined):
        assert curve[i] == curve[i + 1]
        assert np.arccos(min(vector[i] @ vector[i + 1], 1)) <= longest + 1e-9
    assert len(curves.near(axis, np.pi)[0]) == sum(map(len, chains))
    nothing = Curves.of([])
    assert (nothing.count, len(nothing.vector), nothing.step_rad) == (0, 0, 0.0)


def test_planes_bound_the_region_on_the_image() -> None:
    vectors = units(3000)
    inside = (vectors @ region_planes(LENS, REGION).T > 0).all(axis=1)
    xy = LENS.project(vectors)
    np.testing.assert_array_equal(inside, (vectors[:, 2] > 0) & REGION.contains(xy))
    edges = inside_region(np.array([[25.0, 45.0]]), REGION)
    assert edges.tolist() == [[5.0, 225.0, 15.0, 155.0]]


def test_chords_are_cut_where_they_cross_the_region() -> None:
    rng = np.random.default_rng(5)
    chains = [great_circle(LENS.unit_vectors(rng.uniform(-100, 420, (3, 2))), 0.08) for _ in range(30)]
    curves = Curves.of(chains)
    joined = np.append(np.diff(curves.curve) == 0, False)
    normals = region_planes(LENS, REGION)
    lines, crossings = cut(curves.vector, curves.vector @ normals.T, joined, curves.curve, LENS)
    for k, chain in enumerate(chains):
        own = lines.of_curves(k, k + 1)
        bounds = [*own.starts.tolist(), len(own.xy_px)]
        length = sum(np.linalg.norm(np.diff(own.xy_px[a:b], axis=0), axis=1).sum() for a, b in pairwise(bounds))
        u = np.linspace(0, 1, 2001)[:, np.newaxis]
        dense = np.vstack([LENS.project(a + u * (b - a)) for a, b in pairwise(chain)])
        steps, middles = np.diff(dense, axis=0), (dense[1:] + dense[:-1]) / 2
        expected = np.linalg.norm(steps, axis=1)[REGION.contains(middles)].sum()
        assert length == pytest.approx(expected, abs=0.5)
        entered = np.flatnonzero(np.diff(REGION.contains(dense).astype(int)))
        found = crossings.of_curves(k, k + 1)
        assert len(found.xy_px) == len(entered)
        for xy, anchor in zip(found.xy_px, found.anchor, strict=True):
            assert np.linalg.norm(dense[entered] - xy, axis=1).min() < 0.2
            edge = int(np.abs(inside_region(xy[np.newaxis], REGION)[0]).argmin())
            assert anchor.tolist() == [[0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]][edge]
        # Chords that continue each other are one line.
        assert len(own.starts) == (len(entered) + REGION.contains(dense[0]) + REGION.contains(dense[-1])) / 2
    horizon = np.column_stack([curves.vector @ normals.T, curves.vector[:, 1]])
    below, at_edge = cut(curves.vector, horizon, joined, curves.curve, LENS)
    assert below.xy_px[:, 1].min() >= 119.5 - 1e-6
    # Where a curve ends at the horizon there is no label of an edge.
    assert np.abs(inside_region(at_edge.xy_px, REGION)).min(axis=1).max() < 1e-6


def test_grids_and_horizon_are_where_their_labels_say() -> None:
    grids = Grids(LENS)
    # The half diagonal is 33 deg: lines every 10 deg and every hour.
    assert len(grids.altaz_labels) == grids.altaz.count == 8 + 36
    assert len(grids.equatorial_labels) == grids.equatorial.count == 17 + 24
    for label, axis, curves in ((("alt 20°"), -1.0, grids.altaz), ("+30°", 1.0, grids.equatorial)):
        labels = grids.altaz_labels if axis < 0 else grids.equatorial_labels
        chain = curves.vector[curves.curve == labels.index(label)]
        np.testing.assert_allclose(
            np.rad2deg(np.arcsin(axis * chain[:, 2])), float(label.strip("alt °")), rtol=0, atol=1e-9
        )
    east = grids.altaz.vector[grids.altaz.curve == grids.altaz_labels.index("az 90°")]
    np.testing.assert_allclose(east[:, 0], 0, rtol=0, atol=1e-12)
    assert (east[0].round(9).tolist(), east[-1].round(9).tolist()) == ([0, 1, 0], [0, 0, -1])
    ten = grids.altaz.vector[grids.altaz.curve == grids.altaz_labels.index("az 10°")]
    assert np.rad2deg(np.arcsin(-ten[-1, 2])) == pytest.approx(80)
    hour = grids.equatorial.vector[grids.equatorial.curve == grids.equatorial_labels.index("2h")]
    np.testing.assert_allclose(np.rad2deg(np.arctan2(hour[:, 1], hour[:, 0])), 30, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(np.arcsin(hour[[0, -1], 2])), [-80, 80], rtol=1e-7)
    assert len(Grids(camera(320, 240, 3000.0)).altaz_labels) == 44 + 180  # every 2 deg in a half diagonal of 3.8
    # Lines 1 deg and 5 minutes between neighbours in a narrower field, also if it is smaller than that.
    for focal_px in (10_000.0, 60_000.0):
        narrow = Grids(camera(320, 240, focal_px))
        assert (len(narrow.altaz_labels), len(narrow.equatorial_labels)) == (89 + 360, 179 + 288)
    assert [_hours(m) for m in (0, 60, 65, 90)] == ["0h", "1h", "1h05", "1h30"]
    horizon = horizon_curve(LENS, -0.02).vector
    np.testing.assert_allclose(horizon[:, 2], 0.02, rtol=0, atol=1e-12)
    compass = compass_ned(0.1)
    np.testing.assert_allclose(compass[:, 2], -0.1, rtol=1e-7)
    azimuths = np.rad2deg(np.arctan2(compass[:, 1], compass[:, 0])) % 360
    np.testing.assert_allclose(azimuths, np.arange(16) * 22.5, rtol=0, atol=1e-9)


def test_the_camera_sees_north_east_and_down() -> None:
    zenith, C = units(1, 4), np.linalg.qr(units(3, 5))[0]
    C *= np.sign(np.linalg.det(C))
    pointing = Pointing(C[np.newaxis], zenith, np.zeros((1, 3)), 0.0)
    found = ned_to_camera_matrix(pointing)
    east = np.cross([0, 0, 1.0], zenith[0])
    east /= np.linalg.norm(east)
    north = np.cross(zenith[0], east)
    np.testing.assert_allclose(found, C @ np.column_stack([north, east, -zenith[0]]), rtol=0, atol=1e-12)
    assert north[2] > 0
    pole = ned_to_camera_matrix(replace(pointing, zenith_eq=np.array([[0.0, 0, 1]])))
    np.testing.assert_allclose(pole @ pole.T, np.eye(3), rtol=0, atol=1e-12)


def test_directions_strides_and_arrows_of_labels() -> None:
    given = np.array([[3.0, -1.5], [0.2, 0.8], [-4, 4], [0, 0], [np.nan, 1], [1e-7, 0]])
    expected = [[1, -0.5], [0.25, 1], [-1, 1], [1, 0], [1, 0], [1, 0]]
    np.testing.assert_allclose(unit_by_larger_component(given), expected, rtol=1e-7)
    strides = {0.3: 1, 1: 1, 1.1: 2, 2: 2, 2.1: 5, 5.5: 10, 11: 20, 21: 50, 51: 100, 199: 200, 201: 500, 4e5: 500_000}
    assert {minimum: round_stride(minimum) for minimum in strides} == strides
    tails, tips = np.array([[0.0, 0], [10, 10]]), np.array([[10.0, 0], [10, 12]])
    strokes = arrow_strokes(tails, tips, 4.0)
    assert strokes.shape == (6, 2, 2)
    ends = {frozenset(map(tuple, stroke.round(9).tolist())) for stroke in strokes}
    # Shafts, and barbs half as wide as long, no longer than the arrow.
    first = [((0, 0), (10, 0)), ((10, 0), (6, 2)), ((10, 0), (6, -2))]
    second = [((10, 10), (10, 12)), ((10, 12), (9, 10)), ((10, 12), (11, 10))]
    assert ends == set(map(frozenset, first + second))
    # Nine of ten arrows are at most 60 screen px long: of 3 px, at half a px each, 10 times as long.
    shifts = np.array([[1.8, 2.4]] * 19 + [[90.0, 0]])
    assert [residual_scale(shifts, 0.5), residual_scale(shifts, 0.51, 58.8)] == [10, 5]
    assert [residual_scale(shifts, 0.5, long) for long in (29.9, 30.1, 12.1, 11.9, 1.0)] == [2, 5, 2, 1, 1]
    assert residual_scale(shifts * 1e-9, 1.0) == 500_000


def test_labels_move_into_the_region_and_keep_clear_of_each_other() -> None:
    scene = stars_at([[100.0, 100.0]], [100.0], sensor=Sensor(), lens=LENS)
    canvas = Canvas(scene, None, 2.0, 0.6)
    assert canvas.screen_px == 0.5
    canvas.current = "names"
    # Four letters are 15 px wide at a zoom of 2, with a gap of 3 px; a line is 8 px high.
    assert canvas.label("Vega", (100.0, 100.0), (0.0, 0.5))
    assert not canvas.label("Mars", (117.9, 100.0), (0.0, 0.5))
    assert canvas.label("Mars", (118.1, 100.0), (0.0, 0.5))
    assert not canvas.label("Alya", (100.0, 107.0), (0.0, 0.5))
    assert canvas.label("Alya", (100.0, 120.0), (0.0, 0.5))
    assert canvas.label("Edge", (319.0, 239.0), (0.0, 0.0))
    canvas.selected = "Deneb"
    assert not canvas.label("Deneb", (200.0, 200.0), (0.0, 0.5))
    (labels,) = canvas.shapes().labels
    assert (labels.overlay, labels.text) == ("names", ("Vega", "Mars", "Alya", "Edge"))
    np.testing.assert_allclose(labels.anchor[0], [0, 0.5], rtol=1e-7)
    # At the corner the text ends at the edges: (319 - 301.5) / 18 and (239 - 231.5) / 8.
    np.testing.assert_allclose(labels.anchor[3], [17.5 / 18, 7.5 / 8], rtol=1e-6)
    canvas.reserve(ImageRegion(0, 0, 60, 40))
    assert not canvas.label("Sol", (50.0, 30.0), (0.0, 0.5))
    assert canvas.label("Sol", (50.0, 60.0), (0.0, 0.5))
    assert canvas.label("two\nlines", (200.0, 150.0), (0.0, 0.0))
    assert not canvas.label("x", (205.0, 160.0), (0.0, 0.0))
    part = Canvas(scene, REGION, 1.0, 0.6)
    assert part.region == REGION
    part.mark("ring", np.array([[100.0, 100], [10, 100], [np.nan, 5]]))
    part.strokes(np.array([[[1.0, 2], [3, 4]], [[5, 6], [7, 8]]]))
    part.strokes(np.zeros((0, 2, 2)))
    shapes = part.shapes()
    assert shapes.marks[0].xy_px.tolist() == [[100, 100]]
    assert (len(shapes.lines), shapes.lines[0].starts.tolist()) == (1, [0, 2])


def test_painted_parts_are_disjoint_and_hold_all_that_changed() -> None:
    rng = np.random.default_rng(6)
    complete = Rect(0, 0, 60, 40)
    assert Rect(1, 2, 5, 9).common(Rect(3, 0, 8, 4)) == (3, 2, 5, 4)
    assert Rect(1, 2, 5, 9).around(Rect(3, 0, 8, 4)) == (1, 0, 8, 9)
    assert [Rect(*r).is_empty for r in ((0, 0, 1, 1), (1, 0, 1, 5), (0, 5, 5, 5), (3, 0, 2, 5))] == [
        False,
        True,
        True,
        True,
    ]
    for _ in range(40):
        corners = rng.integers(-10, 70, (6, 2, 2))
        rects = [Rect(*np.sort(c, axis=0).ravel().tolist()) for c in corners]
        parts = _disjoint(rects, complete)
        painted = np.zeros((40, 60), int)
        for part in parts:
            assert not part.is_empty
            painted[part.top : part.bottom, part.left : part.right] += 1
        assert painted.max(initial=0) <= 1
        for rect in rects:
            inside = rect.common(complete)
            assert inside.is_empty or (painted[inside.top : inside.bottom, inside.left : inside.right] == 1).all()


def test_a_curve_of_a_grid_is_labelled_once_where_there_is_room() -> None:
    asked = []

    def label(text: str, xy: list[float], anchor: list[float]) -> bool:
        asked.append((text, xy, anchor))
        return xy[0] > 1

    xy, anchor = np.array([[1.0, 5], [2, 5], [3, 5], [4, 5]]), np.array([[0.0, 0.5], [1, 0.5], [0, 0.5], [1, 0.5]])
    crossings = {"grid": Crossings(np.array([0, 0, 0, 1]), xy, anchor)}
    canvas = SimpleNamespace(current="grid", crossings=crossings, label=label)
    table._draw_edge_labels(canvas, ("one", "two"))
    # Without room at its first crossing, a curve is labelled at its second, and not again.
    assert asked == [("one", [1, 5], [0, 0.5]), ("one", [2, 5], [1, 0.5]), ("two", [4, 5], [1, 0.5])]


@pytest.mark.parametrize(("count", "marked"), [(10, 10), (2000, 2000), (2001, 1001), (5000, 1667)])
def test_at_most_two_thousand_saturated_pixels_are_marked(count: int, marked: int) -> None:
    pixels = np.zeros((80, 100), np.uint8)
    pixels.ravel()[:count] = 250
    pixels.ravel()[count:] = 249
    found = []
    canvas = SimpleNamespace(
        scene=SimpleNamespace(sensor=SimpleNamespace(saturation_dn=250)),
        region=ImageRegion(-0.5, -0.5, 99.5, 79.5),
        mark=lambda _, xy: found.extend(xy.tolist()),
    )
    table._draw_saturated(canvas, SimpleNamespace(pixels=pixels))
    assert len(found) == marked
    assert all(int(y) * 100 + int(x) < count for x, y in found)
