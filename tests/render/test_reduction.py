"""Cameras, sensors and segments of wide pixels, by the light and the paths that they keep."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene import reduction
from glstar.render.scene.culling import DrawList
from glstar.render.scene.reduction import drawn_variance_px2, reduced_camera
from glstar.render.scene.scene import Scene
from tests.support.scenes import camera, stars_at

LENS = Camera(321, 243, 310.0, 290.0, 150.0, 118.0, 2.5, Lens("plumb_bob", (-0.05, 0.01, 0.0, 0.0)))


@pytest.mark.parametrize("scale", [2, 4])
def test_a_wide_pixel_covers_as_many_pixels_along_each_side_from_the_corner_on(scale: int) -> None:
    wide = reduced_camera(LENS, scale)
    assert (wide.width_px, wide.height_px) == (-(-321 // scale), -(-243 // scale))
    rays = LENS.unit_vectors([(10.0, 20.0), (300.0, 40.0), (150.0, 230.0)])
    np.testing.assert_allclose(scale * (wide.project(rays) + 0.5), LENS.project(rays) + 0.5, rtol=0, atol=1e-9)
    assert wide.lens is LENS.lens


@pytest.mark.parametrize(("sigma_px", "scale", "variance"), [
    (1.5, 2, 2.25 - 1.6 / 6), (1.4, 2, 1.96 - 1.6 / 6), (1.2, 2, 1.4), (3.0, 4, 9 - 6.4 / 6), (2.5, 4, 5.6),
])  # fmt: skip
def test_stars_are_drawn_narrower_by_interpolation_but_as_wide_as_their_samples_demand(
    sigma_px: float, scale: int, variance: float
) -> None:
    assert drawn_variance_px2(sigma_px, scale) == pytest.approx(variance, rel=1e-12)


@pytest.mark.parametrize("scale", [2, 4])
def test_the_light_of_a_pixel_of_the_image_is_that_of_a_wide_one(scale: int) -> None:
    sensor = Sensor(psf_sigma_px=1.6, effects={"sensor.psf_wing_fraction": 0.0})
    wide = reduction._reduced_sensor(sensor, scale)
    assert wide.pixel == "sampled"
    assert wide.psf_sigma_px == pytest.approx(np.sqrt(drawn_variance_px2(sensor.effective_sigma_px, scale)) / scale)
    flux = [each.flux_dn(each.peak_dn(2.0, 0.5)) for each in (sensor, wide)]
    assert flux[1] * scale**2 == pytest.approx(float(flux[0]), rel=1e-9)


@pytest.mark.parametrize(("scale", "sigma_sizes", "errors"), [
    (2, (0.25, 0.31, 0.375, 0.5, 0.62, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 4.0),
     (0.67, 0.59, 0.50, 0.34, 0.20, 0.12, 0.065, 0.041, 0.028, 0.016, 0.010, 0.004)),
    (4, (0.25, 0.31, 0.375, 0.5, 0.62, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 4.0),
     (0.70, 0.62, 0.55, 0.39, 0.25, 0.16, 0.090, 0.056, 0.039, 0.022, 0.014, 0.0055)),
])  # fmt: skip
def test_errors_are_those_of_the_table_between_and_beyond_its_widths(
    monkeypatch: pytest.MonkeyPatch, scale: int, sigma_sizes: tuple[float, ...], errors: tuple[float, ...]
) -> None:
    monkeypatch.setattr(reduction, "drawn_peak_dn", lambda scene: scene.peak_dn)

    def widest(sigma_px: float, peak_dn: float) -> int:
        count = 100 if scale == 4 else 99
        sensor = SimpleNamespace(
            colour=SimpleNamespace(mosaic="none"), effective_sigma_px=sigma_px, max_trail_peak_dn=lambda peak, _: peak
        )
        drawn = DrawList(np.arange(count, dtype=np.int32), np.ones(count), np.full(count, 1e3))
        scene = SimpleNamespace(
            draw_list=drawn, sensor=sensor, stars=SimpleNamespace(catalogue="bsc5"), peak_dn=np.full(count, peak_dn),
            trails=AnalyticSegments(None, np.ones(1)), camera=camera(),
        )  # fmt: skip
        return int(reduction._pixel_widths(scene).max())

    at = [*sigma_sizes, (sigma_sizes[3] + sigma_sizes[4]) / 2, 9.0]
    expected = [*errors, (errors[3] + errors[4]) / 2, errors[-1]]
    for size, error in zip(at, expected, strict=True):
        # 0.02 DN over the error.
        assert widest(scale * size, 0.02 / error * 0.99) >= scale
        assert widest(scale * size, 0.02 / error * 1.01) < scale
    assert widest(scale * 0.249, 1e-9) < scale


def turning(times: np.ndarray, shake_rad: float = 0.0) -> Pointing:
    turns = np.column_stack([0.05 * times, -0.02 * times, shake_rad * np.sin(2 * np.pi * 3 * times)])
    zenith = np.column_stack([0.1 * times, 0 * times, 1 + 0 * times])
    return Pointing(Rotation.from_rotvec(turns).as_matrix(), zenith, np.zeros((len(times), 3)), 0.0)


def segments(count: int, shake_rad: float = 0.0) -> AnalyticSegments:
    return AnalyticSegments(turning(np.arange(2 * count + 1) / (2 * count), shake_rad), np.full(count, 1 / count))


def test_trails_have_half_of_the_segments_where_their_paths_stay() -> None:
    trails = segments(7)
    fewer = reduction._in_fewer_segments(trails, 300.0, 2)
    np.testing.assert_allclose(fewer.time_fraction, np.full(4, 0.25), rtol=1e-12)
    expected = turning(np.arange(9) / 8)
    np.testing.assert_allclose(fewer.pointing.C_camera_eq, expected.C_camera_eq, rtol=0, atol=1e-7)
    np.testing.assert_allclose(fewer.pointing.zenith_eq, expected.zenith_eq, rtol=0, atol=1e-12)
    assert reduction._in_fewer_segments(trails, 300.0, 1) is trails
    one = segments(1)
    assert reduction._in_fewer_segments(one, 300.0, 2) is one
    # Of a camera that shakes the largest angle between both decides: a twentieth of a wide pixel.
    rough = segments(8, 0.01)
    half = AnalyticSegments(turning(np.arange(9) / 8, 0.01), np.full(4, 0.25))
    quarters = turning((np.arange(8) + 0.5) / 8, 0.01)
    off_rad = reduction._distance_rad(half, quarters)
    assert off_rad > 1e-4
    assert reduction._in_fewer_segments(rough, 0.048 / off_rad, 2) is not rough
    assert reduction._in_fewer_segments(rough, 0.052 / off_rad, 2) is rough


def test_the_distance_of_paths_is_the_largest_angle_after_quarters_of_segments() -> None:
    trails = segments(2)
    at = np.array([0.125, 0.375, 0.625, 0.875])
    exact = turning(at)
    assert reduction._distance_rad(trails, exact) < 1e-6
    for k in range(4):
        C = exact.C_camera_eq.copy()
        C[k] = Rotation.from_rotvec([3e-3, -4e-3, 0.0]).as_matrix() @ C[k]
        assert reduction._distance_rad(trails, replace(exact, C_camera_eq=C)) == pytest.approx(5e-3, rel=1e-3)
    scaled = replace(exact, C_camera_eq=exact.C_camera_eq * np.array([1.1, 0.9, 2.0, 1.0])[:, np.newaxis, np.newaxis])
    np.testing.assert_allclose(reduction._upright(scaled).C_camera_eq, exact.C_camera_eq, rtol=0, atol=1e-12)


def analytic_scene() -> Scene:
    scene = stars_at([(40.0, 30.0), (70.0, 50.0), (90.0, 60.0)], [5.0, 6.0, 7.0], sensor=Sensor(psf_sigma_px=1.6),
                     lens=camera(120, 90, 300.0), n=1)  # fmt: skip
    drawn = replace(scene.draw_list, min_trail_px=np.array([10.0, 20.0, 30.0]))
    return replace(scene, trails=segments(6), draw_list=drawn)


@pytest.mark.parametrize("scale", [2, 4])
@pytest.mark.parametrize("has_cloud", [False, True])
def test_stars_on_wide_pixels_have_their_camera_sensor_trails_and_radius(scale: int, has_cloud: bool) -> None:
    scene = analytic_scene()
    if has_cloud:
        scene = replace(scene, draw_list=replace(scene.draw_list, passage=np.ones((3, 6), np.float32)))
    chosen = np.array([True, False, True])
    found = reduction._of_stars(scene, chosen, scale)
    assert found.camera == reduced_camera(scene.camera, scale)
    assert found.draw_list.index.tolist() == [0, 2]
    np.testing.assert_allclose(found.draw_list.min_trail_px, np.array([10.0, 30.0]) / scale, rtol=1e-12)
    assert len(found.trails) == (6 if scale == 2 or has_cloud else 3)
    assert (found.trails is scene.trails) == (scale == 2 or has_cloud)
    sensor = found.sensor
    peak = sensor.peak_dn(scene.stars.vmag[chosen], 0.5)
    radius = sensor.truncation_radius_px(peak, found.draw_list.min_trail_px, renormalized=True)
    np.testing.assert_allclose(found.draw_list.truncation_radius_px, radius, rtol=1e-12)
    same = reduction._of_stars(scene, chosen, 1)
    assert same.draw_list.index.tolist() == [0, 2]
    assert (same.camera is scene.camera, same.sensor is scene.sensor, same.trails is scene.trails) == (True,) * 3


def test_scenes_are_divided_by_the_width_of_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = analytic_scene()
    widths = iter([np.array([1, 2, 4], np.int8), np.array([2, 1, 2], np.int8)])
    monkeypatch.setattr(reduction, "_pixel_widths", lambda _scene: next(widths))
    monkeypatch.setattr(reduction, "_are_worth_reducing", lambda _scenes, of: len(of) == 2)
    full, reduced = reduction.reduced_scenes([scene, scene])
    assert [part.draw_list.index.tolist() for part in full] == [[0], [1]]
    assert {width: [part.draw_list.index.tolist() for part in parts] for width, parts in reduced.items()} == {
        2: [[1], [0, 2]], 4: [[2]],
    }  # fmt: skip
    widths = iter([np.array([2, 2, 2], np.int8)])
    monkeypatch.setattr(reduction, "_pixel_widths", lambda _scene: next(widths))
    monkeypatch.setattr(reduction, "_are_worth_reducing", lambda _scenes, _of: False)
    full, reduced = reduction.reduced_scenes([scene])
    assert (full, reduced) == ((scene,), {})
