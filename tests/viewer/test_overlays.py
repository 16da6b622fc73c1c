"""Overlays against ERFA, OpenCV and the angles of `glstar.sky.place.horizon`: positions of all overlays."""

from dataclasses import replace

import cv2
import erfa
import numpy as np
import orjson
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.scene.scene import Frame
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.air.refraction import refraction_scale, true_altitude_rad
from glstar.sky.catalogue.names import constellations
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import direction, right_ascension_declination
from glstar.sky.place.horizon import ned_direction, ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site
from glstar.telemetry.synthetic import ScriptedFlight
from glstar.viewer.overlays.canvas import Mark, Shapes
from glstar.viewer.overlays.curves import ImageRegion
from glstar.viewer.overlays.table import Overlay, Overlays
from glstar.viewer.skyobjects import star_at
from tests.support.reference import ReferenceRenderer
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning

UNIX_EPOCH_JD = 2440587.5
MID_UTC_S = NIGHT_UTC_S + 2.025
NOSE = Mount(0.0, 0.0, 0.0)
LENS = camera(1014, 760, 967.7425)

ATTITUDES = [
    pytest.param(0.0, 0.3, 0.0, id="climbing-north"),
    pytest.param(0.6, 0.2, 2.5, id="banked"),
    pytest.param(-1.1, 0.9, -1.0, id="steep"),
    pytest.param(3.0, 1.4, 0.7, id="inverted-near-the-zenith"),
]
attitudes = pytest.mark.parametrize(("roll_rad", "pitch_rad", "yaw_rad"), ATTITUDES)


def scene_from_the_nose(roll_rad=0.0, pitch_rad=0.3, yaw_rad=0.0, *, lens=LENS, refraction=True, vmag_limit=5.0):
    simulator = sky_over_adelaide(
        lens, mount=NOSE, vmag_limit=vmag_limit, refraction=refraction,
        roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=yaw_rad,
    )  # fmt: skip
    return simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.05))


def shapes_of(scene, *which, name_vmag_limit=3.0, **options) -> Shapes:
    overlays = Overlays(StarCatalogue.open("bsc5").brighter_than(7.0))
    return overlays.shapes(scene, set(which), name_vmag_limit=name_vmag_limit, **options)


def polylines(shapes, overlay):
    return [
        line.astype(np.float64)
        for lines in shapes.lines
        if lines.overlay is overlay
        for line in np.split(lines.xy_px, lines.starts[1:])
    ]


def labels_of(shapes, overlay):
    return {
        text: xy
        for labels in shapes.labels
        if labels.overlay is overlay
        for text, xy in zip(labels.text, labels.xy_px, strict=True)
    }


def distance_px(point, lines):
    """Return the distance of a point from the nearest chord of the lines."""
    nearest = np.inf
    for line in lines:
        a, chord = line[:-1], np.diff(line, axis=0)
        u = np.clip(((point - a) * chord).sum(axis=1) / np.maximum((chord**2).sum(axis=1), 1e-12), 0, 1)
        nearest = min(nearest, np.linalg.norm(point - a - u[:, np.newaxis] * chord, axis=1).min())
    return nearest


def along(lines):
    """Return points all along the drawn lines, four to a chord."""
    u = np.linspace(0, 1, 5)[:, np.newaxis, np.newaxis]
    return np.concatenate([(line[:-1] + u * np.diff(line, axis=0)).reshape(-1, 2) for line in lines])


def rays(xy, lens=LENS):
    """Return the directions of pixels, unit vectors in the camera frame."""
    return lens.unit_vectors(xy)


def C_camera_ned_of_opencv(roll_rad, pitch_rad, yaw_rad):
    """Return the rotation for a camera along the nose: OpenCV's active rotations, transposed."""
    C_body_ned = np.eye(3)
    for axis, angle in ((2, yaw_rad), (1, pitch_rad), (0, roll_rad)):
        C_body_ned = cv2.Rodrigues(np.eye(3)[axis] * angle)[0].T @ C_body_ned
    forward, right, down = C_body_ned
    return np.stack([right, down, forward])


def px_of_opencv(ned, attitude, lens=LENS):
    """Return OpenCV's pixel positions of directions north, east, down in front of the camera; NaN for the others."""
    C = C_camera_ned_of_opencv(*attitude)
    bent = None if lens.lens is None else np.array(lens.lens.coefficients)
    xy, _ = cv2.projectPoints(ned, cv2.Rodrigues(C)[0], np.zeros(3), lens.K, bent)
    return np.where((ned @ C[2] > 0.1)[:, np.newaxis], xy[:, 0], np.nan)


@pytest.mark.parametrize("refraction", [True, False])
@pytest.mark.parametrize(("roll_rad", "yaw_rad"), [(0.0, 0.0), (0.8, 2.0), (-2.5, -1.0)])
def test_the_horizon_line_is_at_apparent_altitude_zero(roll_rad, yaw_rad, refraction):
    """Stars whose refraction, by the angles of eqs (25)-(26), brings them to the horizon are on the line."""
    scene = scene_from_the_nose(roll_rad, 0.1, yaw_rad, refraction=refraction)
    drawn = polylines(shapes_of(scene, Overlay.HORIZON), Overlay.HORIZON)
    scale = refraction_scale(1010.0, 10.0) if refraction else 0.0
    azimuth = np.deg2rad(np.arange(0, 360, 0.5))
    altitude = true_altitude_rad(np.full_like(azimuth, 1e-6), scale)
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(1.0))
    C = sky.C_ned_eq([MID_UTC_S], scene.site.latitude_rad, scene.site.longitude_rad)[0]
    xy = LENS.project(scene.shutter[1:2].to_camera(ned_direction(azimuth, altitude) @ C)[0])
    on_image = xy[LENS.contains(xy)]
    assert len(on_image) > 60
    for point in on_image:
        assert distance_px(point, drawn) < 0.02


BARREL = replace(LENS, lens=Lens("plumb_bob", (-0.28, 0.07, 1e-3, -7e-4, 0.01)))


@pytest.mark.parametrize("lens", [LENS, BARREL], ids=["pinhole", "barrel"])
@attitudes
def test_the_nodes_of_the_altitude_azimuth_grid_equal_opencv_s_projection(roll_rad, pitch_rad, yaw_rad, lens):
    attitude = roll_rad, pitch_rad, yaw_rad
    scene = scene_from_the_nose(*attitude, lens=lens)
    vertices = np.concatenate(polylines(shapes_of(scene, Overlay.ALTAZ_GRID), Overlay.ALTAZ_GRID))
    azimuth, altitude = np.meshgrid(np.deg2rad(np.arange(0, 360, 10)), np.deg2rad(np.arange(10, 90, 10)))
    xy = px_of_opencv(ned_direction(azimuth.ravel(), altitude.ravel()), attitude, lens)
    on_image = xy[lens.contains(xy, -1.0)]
    assert len(on_image) > 8
    for node in on_image:
        assert np.linalg.norm(vertices - node, axis=1).min() < 0.05


@attitudes
def test_the_nodes_of_the_altitude_azimuth_grid_agree_with_stars_of_erfa(roll_rad, pitch_rad, yaw_rad):
    """A star that is at a node of the grid according to ERFA, without air, is drawn at that node."""
    scene = scene_from_the_nose(roll_rad, pitch_rad, yaw_rad, refraction=False)
    vertices = np.concatenate(polylines(shapes_of(scene, Overlay.ALTAZ_GRID), Overlay.ALTAZ_GRID))
    azimuth, altitude = (a.ravel() for a in np.meshgrid(np.arange(0, 360, 10.0), np.arange(10, 90, 10.0)))
    place = ADELAIDE.longitude_rad, ADELAIDE.latitude_rad, ADELAIDE.height_m
    day = UNIX_EPOCH_JD, MID_UTC_S / 86400
    ri, di = erfa.atoi13(
        "A", np.deg2rad(azimuth), np.deg2rad(90 - altitude), *day, 0.0, *place, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5
    )
    _, equation_of_origins = erfa.apco13(*day, 0.0, *place, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    xy = LENS.project(scene.shutter[1:2].to_camera(direction(ri - equation_of_origins, di))[0])
    on_image = xy[LENS.contains(xy, -1.0)]
    assert len(on_image) > 8
    for node in on_image:
        assert np.linalg.norm(vertices - node, axis=1).min() < 0.05


LENSES = [
    pytest.param(LENS, id="6mm"),
    pytest.param(camera(4056, 3040, 3870.97), id="6mm-full"),
    pytest.param(camera(640, 480, 120.0), id="wide"),
    pytest.param(camera(800, 800, 9000.0), id="narrow"),
    pytest.param(BARREL, id="barrel"),
    pytest.param(replace(camera(640, 480, 400.0), lens=Lens("fisheye", (-0.02, 0.003))), id="fisheye"),
]


@pytest.mark.parametrize("lens", LENSES)
@attitudes
def test_every_point_of_a_drawn_grid_is_on_the_grid(roll_rad, pitch_rad, yaw_rad, lens):
    """Back through the camera and the air: nothing wraps across the image, and no chord leaves its curve."""
    attitude = roll_rad, pitch_rad, yaw_rad
    scene = scene_from_the_nose(*attitude, lens=lens)
    shapes = shapes_of(scene, Overlay.ALTAZ_GRID, Overlay.EQUATORIAL_GRID)
    spacing_deg = 5 if lens.field_radius_rad < np.deg2rad(10) else 10
    spacing_deg = 2 if lens.field_radius_rad < np.deg2rad(5) else spacing_deg
    ra_spacing_deg = {10: 15, 5: 5, 2: 2.5}[spacing_deg]

    def off_px(ray, longitude_rad, latitude_rad, spacing_of_longitude_deg):
        def off(angle_rad, spacing):
            return np.abs((np.rad2deg(angle_rad) + spacing / 2) % spacing - spacing / 2)

        off_deg = np.minimum(
            off(latitude_rad, spacing_deg), off(longitude_rad, spacing_of_longitude_deg) * np.cos(latitude_rad)
        )
        return np.deg2rad(off_deg) * np.linalg.norm(lens.px_per_rad(ray), ord=2, axis=(1, 2))

    ray = rays(along(polylines(shapes, Overlay.ALTAZ_GRID)), lens)
    azimuth, altitude = ned_to_azimuth_altitude_rad(ray @ C_camera_ned_of_opencv(*attitude))
    assert off_px(ray, azimuth, altitude, spacing_deg).max() < 0.5
    assert altitude.min() > -1e-4

    ray = rays(along(polylines(shapes, Overlay.EQUATORIAL_GRID)), lens)
    azimuth, altitude = ned_to_azimuth_altitude_rad(ray @ C_camera_ned_of_opencv(*attitude))
    assert altitude.min() > -1e-4
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(1.0))
    C = sky.C_ned_eq([MID_UTC_S], scene.site.latitude_rad, scene.site.longitude_rad)[0]
    true = true_altitude_rad(altitude, refraction_scale(1010.0, 10.0))
    ra, dec = right_ascension_declination(ned_direction(azimuth, true) @ C)
    assert off_px(ray, ra, dec, ra_spacing_deg).max() < 0.5


def test_a_camera_pointed_at_the_ground_shows_no_line_of_the_sky():
    scene = scene_from_the_nose(0.4, -1.2, 1.0)
    shapes = shapes_of(
        scene, Overlay.HORIZON, Overlay.ALTAZ_GRID, Overlay.EQUATORIAL_GRID, Overlay.CONSTELLATIONS, Overlay.STAR_NAMES
    )
    assert shapes.lines == ()
    assert shapes.labels == ()


def test_the_compass_points_are_on_the_horizon_as_projected_by_opencv():
    attitude = 0.3, 0.1, np.pi / 4 + 0.2
    found = labels_of(shapes_of(scene_from_the_nose(*attitude), Overlay.HORIZON), Overlay.HORIZON)
    assert {"NE", "ENE"} <= set(found)
    for text, azimuth_deg in (("NE", 45.0), ("ENE", 67.5)):
        (xy,) = px_of_opencv(ned_direction(np.deg2rad([azimuth_deg]), 0.0), attitude)
        assert found[text] == pytest.approx(xy, abs=0.01)


@pytest.mark.parametrize("height_m", [0.0, 3000.0, 12000.0])
def test_from_a_height_the_horizon_is_as_low_as_the_dip(height_m):
    """The line, the compass points and the ends of the equatorial grid are at the altitude to which stars are drawn."""
    simulator = sky_over_adelaide(LENS, mount=NOSE, vmag_limit=3.0, pitch_rad=0.1)
    track = simulator.flight.position
    high = replace(track, height_m=np.full_like(track.height_m, height_m))
    simulator = replace(
        simulator, flight=replace(simulator.flight, position=high), sky=replace(simulator.sky, dip=True)
    )
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.05))
    # acos(R / (R + h)) with light bent by a seventh of the Earth's curvature.
    dip_rad = np.arccos(6371.0088e3 / (6371.0088e3 + height_m)) * np.sqrt(6 / 7)
    up = scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1]
    # Chords are within 0.2 px of their curves.
    chord_rad = 0.2 / LENS.fx_px

    shapes = shapes_of(scene, Overlay.HORIZON, Overlay.EQUATORIAL_GRID)
    line = rays(along(polylines(shapes, Overlay.HORIZON)[:1]))
    np.testing.assert_allclose(np.arcsin(line @ up), -dip_rad, rtol=0, atol=chord_rad)
    grid = np.concatenate([rays(xy) for xy in polylines(shapes, Overlay.EQUATORIAL_GRID)])
    assert np.arcsin(grid @ up).min() == pytest.approx(-dip_rad, rel=0, abs=chord_rad)
    for text, xy in labels_of(shapes, Overlay.HORIZON).items():
        assert len(text) <= 3
        assert np.arcsin(rays(np.array([xy]))[0] @ up) == pytest.approx(-dip_rad, rel=0, abs=1e-5)


def test_at_the_pole_the_horizon_is_still_drawn():
    """At a pole of the Earth azimuth is undefined, but circles of altitude are not."""
    flight = ScriptedFlight.steady(Site(np.pi / 2, 0.0), NIGHT_UTC_S, duration_s=10.0, pitch_rad=0.2).flight()
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(3.0))
    scene = Simulator.of(flight, sky, LENS, NOSE, Sensor()).scene(Exposure(NIGHT_UTC_S + 2, 0.05))
    ray = rays(along(polylines(shapes_of(scene, Overlay.HORIZON), Overlay.HORIZON)[:1]))
    up = scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1]
    assert np.abs(ray @ up).max() < 1e-6


def truth_of(scene):
    with ReferenceRenderer() as renderer:
        return orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file=""))["stars"]


@pytest.fixture(scope="module")
def yawing_scene():
    """The nose turns through Orion at 8 deg/s."""
    simulator = sky_over_adelaide(
        camera(640, 480, 600.0),
        mount=NOSE,
        vmag_limit=5.0,
        pitch_rad=0.9,
        yaw_rad=-0.5,
        yaw_rate_rad_per_s=np.deg2rad(8.0),
    )
    return simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.5))


def test_names_are_at_the_ends_of_the_trails_in_the_truth(yawing_scene):
    labels = labels_of(shapes_of(yawing_scene, Overlay.STAR_NAMES, name_vmag_limit=4.5), Overlay.STAR_NAMES)
    name = dict(zip(yawing_scene.stars.star_id.tolist(), yawing_scene.stars.name, strict=True))
    truth = {name[star["star_id"]]: star for star in truth_of(yawing_scene)}
    assert len(labels) > 5
    for text, xy in labels.items():
        star = truth[text]
        assert star["vmag"] <= 4.5
        places = [star["start"], star["end"], [star["x_px"], star["y_px"]]]
        at = next(place for place in places if place and -0.5 <= place[0] <= 639.5 and -0.5 <= place[1] <= 479.5)
        assert xy == pytest.approx(at, abs=1e-3)


def test_no_two_labels_overlap_and_none_leaves_the_window(yawing_scene):
    shapes = shapes_of(yawing_scene, *Overlay, name_vmag_limit=6.0)
    boxes = []
    for labels in shapes.labels:
        for text, (x, y), (across, down) in zip(labels.text, labels.xy_px, labels.anchor, strict=True):
            rows = text.split("\n")
            width, height = 7 * max(map(len, rows)), 14 * len(rows)
            boxes.append((x - across * width, y - down * height, width, height))
    assert len(boxes) > 20
    for i, (x, y, width, height) in enumerate(boxes):
        assert x > -2
        assert x + width < 642
        assert y > -2
        assert y + height < 482
        for u, v, w, h in boxes[:i]:
            assert x >= u + w or u >= x + width or y >= v + h or v >= y + height


@pytest.mark.parametrize(
    ("overlay", "name"),
    [(Overlay.STAR_NAMES, "Rigel"), (Overlay.CONSTELLATIONS, "Orion"), (Overlay.DEEP_SKY, "M42")],
)
def test_the_selected_object_has_no_label_beside_its_mark(yawing_scene, overlay, name):
    without = labels_of(shapes_of(yawing_scene, overlay, selected=name), overlay)
    labels = labels_of(shapes_of(yawing_scene, overlay), overlay)
    assert name in labels
    assert name not in without
    assert without.keys() >= labels.keys() - {name}


def test_centroid_marks_are_at_the_centroids_of_the_truth(yawing_scene):
    (marks,) = shapes_of(yawing_scene, Overlay.CENTROIDS, centroid_vmag_limit=4.0).marks
    truth = [star for star in truth_of(yawing_scene) if star["vmag"] <= 4.0]
    expected = np.array([(star["centroid_x_px"], star["centroid_y_px"]) for star in truth])
    expected = expected[((expected > -0.5) & (expected < (639.5, 479.5))).all(axis=1)]
    assert len(expected) > 3
    order = np.lexsort(expected.T), np.lexsort(marks.xy_px.T)
    np.testing.assert_allclose(marks.xy_px[order[1]], expected[order[0]], rtol=0, atol=1e-3)  # px


def test_the_lines_of_a_constellation_end_at_its_stars(yawing_scene):
    """Also at Alpha Centauri, which has moved by 90" since J2000."""
    simulator = sky_over_adelaide(LENS, mount=NOSE, pitch_rad=0.45, yaw_rad=2.6)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.05))
    vertices = np.concatenate(polylines(shapes_of(scene, Overlay.CONSTELLATIONS), Overlay.CONSTELLATIONS))
    stars = StarCatalogue.open("bsc5").brighter_than(6.5)
    ends = np.concatenate([direction(*line.T) for part in constellations() for line in part.lines_rad])
    numbers = set(stars.star_id[np.argmax(ends @ stars.direction.T, axis=1)].tolist())
    index = np.flatnonzero(np.isin(scene.stars.star_id, list(numbers)))
    xy = LENS.project(scene.shutter[1:2].to_camera(scene.stars.direction_eq[index])[0])
    on_image = LENS.contains(xy, -1.0)
    assert on_image.sum() > 20
    assert "Rigil Kentaurus" in {scene.stars.name[i] for i in index[on_image]}
    for end in xy[on_image]:
        assert np.linalg.norm(vertices - end, axis=1).min() < 0.02


def test_the_axis_label_gives_the_attitude_of_a_forward_looking_camera():
    attitude = np.deg2rad([12.5, 20.25, 75.75])
    scene = scene_from_the_nose(*attitude)
    shapes = shapes_of(scene, Overlay.AXIS)
    (label,) = labels_of(shapes, Overlay.AXIS)
    assert label == "alt 20.25°  az 75.75°\nroll +12.50°"
    (line,) = polylines(shapes, Overlay.AXIS)
    assert line[0] == pytest.approx((506.5, 379.5))
    (higher,) = px_of_opencv(ned_direction(attitude[2:], attitude[1:2] + 0.05), attitude)
    uphill, drawn = higher - line[0], line[1] - line[0]
    assert drawn / np.linalg.norm(drawn) == pytest.approx(uphill / np.linalg.norm(uphill), abs=1e-4)


def test_a_camera_pointed_straight_up_has_no_roll():
    ahead = np.tile([0.0, 0.0, 1.0], (3, 1))
    scene = stars_at([[10.0, 10.0]], [1.0], sensor=Sensor(), lens=camera())
    scene = replace(scene, shutter=Pointing(np.tile(np.eye(3), (3, 1, 1)), ahead, 0 * ahead, 0.0))
    (label,) = labels_of(shapes_of(scene, Overlay.AXIS), Overlay.AXIS)
    assert "roll" not in label


def test_ticks_cross_the_trail_at_sub_exposures():
    scene = stars_at([[160.0, 120.0]], [1.0], sensor=Sensor(), lens=camera(), turn=turning(30.0))
    n = len(scene.trails.pointing)
    ticks = np.array(polylines(shapes_of(scene, Overlay.TICKS), Overlay.TICKS))
    path = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[:, 0]
    trail_px = np.linalg.norm(path[-1] - path[0])
    stride = next(k for k in (1, 2, 5, 10, 20, 50) if k * trail_px / n >= 6)
    np.testing.assert_allclose(ticks.mean(axis=1), path[::stride], rtol=0, atol=1e-3)
    along_trail = (ticks[:, 1] - ticks[:, 0]) @ (path[-1] - path[0]) / trail_px
    assert np.abs(along_trail).max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(ticks[:, 1] - ticks[:, 0], axis=1), 2 * (3 + 2 * 1.2), rtol=0, atol=1e-3)


def test_under_a_rolling_shutter_names_and_ticks_are_where_the_rows_record_the_star():
    simulator = sky_over_adelaide(LENS, vmag_limit=3.0, roll_rate_rad_per_s=np.deg2rad(20.0))
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.1, 400.0, "sprites", readout_s=0.4))
    listed = orjson.loads(
        frame_truth(scene, Frame(np.zeros((760, 1014), np.uint8), scene.exposure, 0), number=0, file="")
    )
    recorded = [star for star in listed["stars"] if star["start"] and star["end"]]
    paths = np.array([(star["start"], star["end"]) for star in recorded])
    first = next(k for k, star in enumerate(recorded) if star["in_frame"] == 1.0 and star["exposed_s"] > 0.05)
    name = scene.stars.name[np.flatnonzero(scene.stars.star_id == recorded[first]["star_id"])[0]]
    shapes = shapes_of(scene, Overlay.TICKS, Overlay.STAR_NAMES)
    # Trails of a tenth of a second at their own time, nearly straight: far from those of the whole half second.
    middles = np.array(polylines(shapes, Overlay.TICKS)).mean(axis=1)
    distances = np.array([_from_line(middles, start, end) for start, end in paths])
    assert len(middles) > 4
    assert distances.min(axis=0).max() < 1.0
    at = np.array(labels_of(shapes, Overlay.STAR_NAMES)[name])
    assert np.linalg.norm(at - paths[first], axis=1).min() < 0.01


def _from_line(points, start, end):
    """Return the distances of points from a line between two others, px."""
    along = (end - start) / np.linalg.norm(end - start)
    s = ((points - start) @ along).clip(0.0, np.linalg.norm(end - start))
    return np.linalg.norm(points - start - s[:, np.newaxis] * along, axis=1)


def test_a_slow_star_has_ticks_only_when_zoomed_in():
    scene = stars_at([[160.0, 120.0]], [1.0], sensor=Sensor(), lens=camera(), turn=turning(1.0))
    assert shapes_of(scene, Overlay.TICKS).lines == ()
    close = ImageRegion(150.0, 110.0, 170.0, 130.0)
    assert len(polylines(shapes_of(scene, Overlay.TICKS, zoom=16.0, region=close), Overlay.TICKS)) >= 5


def test_saturated_pixels_are_found_in_the_image():
    scene = stars_at([[100.0, 80.0]], [0.0], sensor=Sensor(sky_std_dn=0.0), lens=camera())
    with ReferenceRenderer() as renderer:
        pixels = renderer.render(scene, seed=0).pixels
    (marks,) = shapes_of(scene, Overlay.SATURATED, pixels=pixels).marks
    assert marks.mark is Mark.PIXEL
    assert {(int(y), int(x)) for x, y in marks.xy_px} == set(map(tuple, np.argwhere(pixels == 255).tolist()))


@pytest.mark.parametrize("deg_per_s", [0.0, 3.0, 12.0])
def test_without_an_image_stars_that_saturate_are_marked(deg_per_s):
    """Within a quarter magnitude of the limit, saturation depends on the position within a pixel."""
    sensor = Sensor(sky_std_dn=0.0)
    vmag = np.arange(-1.0, 4.0, 0.5)
    xy = np.column_stack([np.full(len(vmag), 160.0), 20.0 + 22 * np.arange(len(vmag))])
    scene = stars_at(xy, vmag, sensor=sensor, lens=camera(), turn=lambda u: (np.deg2rad(deg_per_s) * 0.5 * u, 0 * u))
    shapes = shapes_of(scene, Overlay.SATURATED)
    marked = {round(float(y)) for marks in shapes.marks for _, y in marks.xy_px}
    saturated = {round(star["y_px"]) for star in truth_of(scene) if star["saturated"]}
    assert saturated
    assert saturated <= marked
    assert len(marked - saturated) <= 1


def test_lines_end_and_grids_are_labelled_at_the_edge_of_the_window(yawing_scene):
    region = ImageRegion(200.0, 100.0, 440.0, 300.0)
    shapes = shapes_of(yawing_scene, Overlay.ALTAZ_GRID, Overlay.EQUATORIAL_GRID, region=region, zoom=2.0)
    points = np.concatenate([lines.xy_px for lines in shapes.lines])
    assert points.min(axis=0) == pytest.approx((200.0, 100.0), abs=1e-3)
    assert points.max(axis=0) == pytest.approx((440.0, 300.0), abs=1e-3)
    for labels in shapes.labels:
        x, y = labels.xy_px.T.astype(np.float64)
        to_edge = np.minimum.reduce([x - 200, 440 - x, y - 100, 300 - y])
        np.testing.assert_allclose(to_edge, 0.0, rtol=0, atol=1e-3)


def test_with_distortion_lines_end_and_are_labelled_at_the_edge_of_the_window():
    scene = scene_from_the_nose(0.3, 0.4, 1.0, lens=BARREL)
    for region in (None, ImageRegion(200.0, 100.0, 440.0, 300.0)):
        shapes = shapes_of(scene, Overlay.ALTAZ_GRID, Overlay.EQUATORIAL_GRID, region=region, zoom=2.0)
        left, top, right, bottom = (
            (-0.5, -0.5, LENS.width_px - 0.5, LENS.height_px - 0.5) if region is None else (200.0, 100.0, 440.0, 300.0)
        )
        points = np.concatenate([lines.xy_px for lines in shapes.lines])
        assert points.min(axis=0) == pytest.approx((left, top), abs=0.05)
        assert points.max(axis=0) == pytest.approx((right, bottom), abs=0.05)
        for labels in shapes.labels:
            x, y = labels.xy_px.T.astype(np.float64)
            to_edge = np.minimum.reduce([x - left, right - x, y - top, bottom - y])
            np.testing.assert_allclose(to_edge, 0.0, rtol=0, atol=0.05)


def test_only_the_chosen_overlays_are_drawn(yawing_scene):
    nothing = shapes_of(yawing_scene)
    assert (nothing.lines, nothing.labels, nothing.marks) == ((), (), ())
    for overlay in Overlay:
        shapes = shapes_of(yawing_scene, overlay)
        assert {part.overlay for part in (*shapes.lines, *shapes.labels, *shapes.marks)} <= {overlay}


def test_the_shapes_of_a_paused_scene_are_computed_once(yawing_scene):
    overlays = Overlays(StarCatalogue.open("bsc5").brighter_than(5.0))
    once = overlays.shapes(yawing_scene, set(Overlay), name_vmag_limit=3.0)
    assert overlays.shapes(yawing_scene, set(Overlay), name_vmag_limit=3.0) is once
    assert overlays.shapes(yawing_scene, set(Overlay), name_vmag_limit=2.0) is not once
    assert overlays.shapes(replace(yawing_scene), set(Overlay), name_vmag_limit=3.0) is not once


def test_the_star_under_the_cursor_is_the_one_whose_trail_passes_there(yawing_scene):
    star = next(star for star in truth_of(yawing_scene) if star["in_frame"] == 1.0)
    for place in (star["start"], (star["x_px"], star["y_px"]), star["end"]):
        found = star_at(yawing_scene, *place, within_px=3.0)
        assert found.star_id == star["star_id"]
        assert (found.x_px, found.y_px) == pytest.approx((star["x_px"], star["y_px"]), abs=1e-5)
    start, end = np.array(star["start"]), np.array(star["end"])
    across = (end - start)[::-1] * [-1, 1] / np.linalg.norm(end - start)
    middle = np.array([star["x_px"], star["y_px"]])
    assert star_at(yawing_scene, *(middle + 2.5 * across), within_px=3.0) is not None
    assert star_at(yawing_scene, -500.0, -500.0, within_px=3.0) is None


def test_the_star_under_the_cursor_has_the_altitude_and_azimuth_of_the_tables():
    scene = scene_from_the_nose(0.2, 0.2, 0.4)
    places = Sky(StarCatalogue.open("bsc5").brighter_than(5.0)).observed_places(MID_UTC_S, replace(scene.site))
    xy = LENS.project(scene.shutter[1:2].to_camera(scene.stars.direction_eq)[0])
    on_image = np.flatnonzero(LENS.contains(xy))
    assert len(on_image) > 10
    for i in on_image:
        found = star_at(scene, *xy[i], within_px=0.5)
        row = list(places.stars.star_id).index(found.star_id)
        assert found.altitude_rad == pytest.approx(places.apparent_altitude_rad[row], abs=1e-6)
        assert found.azimuth_rad == pytest.approx(places.azimuth_rad[row], abs=1e-6)


def test_the_brighter_of_two_stars_at_equal_distance_is_selected():
    scene = stars_at([[100.0, 100.0], [104.0, 100.0]], [5.0, 1.0], sensor=Sensor(), lens=camera())
    assert star_at(scene, 102.0, 100.0, within_px=5.0).star_id == 2
    assert star_at(scene, 100.2, 100.0, within_px=5.0).star_id == 1


def test_a_star_on_a_shaky_trail_is_found_anywhere_along_it():
    scene = stars_at(
        [[160.0, 120.0]],
        [3.0],
        sensor=Sensor(),
        lens=camera(),
        n=240,
        turn=lambda u: (0.1 * np.sin(16 * np.pi * u), 0.05 * np.cos(16 * np.pi * u)),
    )
    path = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[:, 0]
    assert np.ptp(path[:, 0]) > 50
    for place in path[::7]:
        assert star_at(scene, *place, within_px=1.0) is not None


def test_the_star_under_the_cursor_is_where_its_own_rows_record_it():
    """Truth is computed from each star's own rows; before they open and after they close it is not there."""
    rates = {"roll_rate_rad_per_s": 0.3, "yaw_rate_rad_per_s": np.deg2rad(8.0)}
    simulator = sky_over_adelaide(
        camera(640, 480, 600.0), mount=NOSE, vmag_limit=5.0, pitch_rad=0.9, yaw_rad=-0.5, **rates
    )
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.02, readout_s=0.3))
    stars = [star for star in truth_of(scene) if star["in_frame"] == 1.0 and abs(star["mid_offset_s"]) > 0.08]
    assert len(stars) >= 3
    middles = scene.camera.project(scene.shutter[1:2].to_camera(scene.stars.direction_eq))[0]
    ids = scene.stars.star_id.tolist()
    for star in stars:
        found = star_at(scene, star["x_px"], star["y_px"], within_px=3.0)
        assert found is not None
        if found.star_id != star["star_id"]:
            continue  # a brighter one nearby
        assert (found.x_px, found.y_px) == pytest.approx((star["x_px"], star["y_px"]), abs=0.01)
        middle = middles[ids.index(star["star_id"])]
        if np.hypot(*(middle - [star["x_px"], star["y_px"]])) < 15:
            continue
        elsewhere = star_at(scene, *middle, within_px=3.0)
        assert elsewhere is None or elsewhere.star_id != star["star_id"]
