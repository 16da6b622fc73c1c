"""Stars behind a lens, against OpenCV, and against a Gaussian of constant width that moves on the sensor."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import orjson
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from tests.support.lenses import LENSES, camera_with
from tests.support.reference import profile
from tests.support.rollingshutter import rolling_light, star_positions
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning, with_stars_at
from tests.support.trails import light

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
# Centre, edges and corners, at different sub-pixel phases.
POSITIONS = np.array([(x, y) for x in (10.3, 200.75, 396.2) for y in (9.6, 150.1, 290.45)])


def still_stars(lens: Lens, sensor: Sensor, vmag: float = 3.0) -> Scene:
    return stars_at(POSITIONS, np.full(len(POSITIONS), vmag), sensor=sensor, lens=camera_with(lens), n=4)


def around(image: np.ndarray, x: float, y: float, radius_px: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels around a position, their rows and their columns."""
    window = np.s_[
        max(0, round(y) - radius_px) : round(y) + radius_px + 1, max(0, round(x) - radius_px) : round(x) + radius_px + 1
    ]
    rows, columns = np.indices(image.shape)
    return image[window].astype(np.float64), rows[window], columns[window]


def opencv_projects(lens_camera: Camera, direction: np.ndarray) -> np.ndarray:
    assert lens_camera.lens is not None
    zero, coefficients = np.zeros(3), np.array(lens_camera.lens.coefficients)
    if lens_camera.lens.model == "fisheye":
        found, _ = cv2.fisheye.projectPoints(direction[:, np.newaxis], zero, zero, lens_camera.K, coefficients)
    else:
        found, _ = cv2.projectPoints(direction, zero, zero, lens_camera.K, coefficients)
    return found.reshape(-1, 2)


def spread_on_the_sensor(scene: Scene, star: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return a star's flux in some pixels: the same Gaussian on the sensor, wherever the star is."""
    (x, y) = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[0, star]
    peak_dn = scene.sensor.peak_dn(scene.stars.vmag[star], scene.exposure.duration_s)
    return peak_dn * np.outer(profile(rows[:, 0] - y, scene.sensor), profile(columns[0] - x, scene.sensor))


@every_lens
def test_a_star_is_drawn_where_opencv_projects_it_to_the_corners(renderer, lens):
    scene = still_stars(lens, Sensor())
    direction = scene.trails.pointing.to_camera(scene.stars.direction_eq)[0]
    frame = renderer.render(scene, seed=0, light=True)
    labels = {
        star["star_id"]: star for star in orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
    }
    for star_id, (x, y) in enumerate(opencv_projects(scene.camera, direction), start=1):
        light_dn, rows, columns = around(frame.light_dn, x, y)
        # Half of a star at the image's edge would be missing; 9.6 px are sufficient.
        assert (columns * light_dn).sum() / light_dn.sum() == pytest.approx(x, abs=0.02)
        assert (rows * light_dn).sum() / light_dn.sum() == pytest.approx(y, abs=0.02)
        assert [labels[star_id]["x_px"], labels[star_id]["y_px"]] == pytest.approx([x, y], abs=1e-5)
        assert [labels[star_id]["centroid_x_px"], labels[star_id]["centroid_y_px"]] == pytest.approx([x, y], abs=1e-5)


@pytest.mark.parametrize("sigma_px", [0.5, 1.2, 2.0])
@every_lens
def test_a_star_is_as_wide_on_the_sensor_wherever_it_is(renderer, lens, sigma_px):
    sensor = Sensor(psf_sigma_px=sigma_px)
    scene = still_stars(lens, sensor)
    frame = renderer.render(scene, seed=0, light=True)
    for star, (x, y) in enumerate(POSITIONS):
        light_dn, rows, columns = around(frame.light_dn, x, y)
        expected = spread_on_the_sensor(scene, star, rows, columns)
        assert np.abs(light_dn - expected).max() <= 2e-3 * expected.max()
        assert light_dn.sum() == pytest.approx(expected.sum(), rel=2e-3)


def part_of(f_px: float, lens: Lens, off_axis_deg: float, size_px: tuple[int, int] = (160, 120)) -> Camera:
    """Return the camera of a small part of an image whose corner is at an angle from the axis."""
    middle_px = Camera(*size_px, f_px, f_px, 0.0, 0.0, 0.0, lens).project(
        [
            0.8 * np.sin(np.deg2rad(off_axis_deg)),
            0.6 * np.sin(np.deg2rad(off_axis_deg)),
            np.cos(np.deg2rad(off_axis_deg)),
        ]
    )
    cx_px, cy_px = np.array(size_px) - 1.0 - middle_px
    return Camera(*size_px, f_px, f_px, float(cx_px), float(cy_px), 0.0, lens)


BARREL = Lens("plumb_bob", (-0.28, 0.09, 8e-4, -5e-4))
EQUIDISTANT = Lens("fisheye", ())
PARTS = {
    "barrel": part_of(700.0, BARREL, 47.0),
    "rational": part_of(500.0, Lens("rational", (0.3, 0.08, 6e-4, -4e-4, 0.01, 0.62, 0.18, 0.02)), 60.0),
    "prism": part_of(
        500.0, Lens("rational", (-0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2e-3, 0, -1e-3, 0, 0.02, 0.03)), 40.0
    ),
    "fisheye": part_of(390.0, Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)), 89.0),
    "beyond": part_of(370.0, EQUIDISTANT, 105.0),
    "omni": part_of(500.0, Lens("omni", (1.2, -0.1, 0.02, 1e-3, -1e-3)), 89.0),
    "double sphere": part_of(300.0, Lens("double_sphere", (-0.2, 0.6)), 95.0),
}


def looking_up(lens_camera: Camera, **settings: Any) -> Simulator:
    """Return the view of a level aircraft whose zenith is in the middle of the image."""
    (ray,) = lens_camera.unit_vectors([[lens_camera.width_px / 2, lens_camera.height_px / 2]])
    turn, _ = Rotation.align_vectors(ray[np.newaxis], [[0.0, 0.0, 1.0]])
    return sky_over_adelaide(lens_camera, mount=Mount.from_matrix(turn.as_matrix() @ Mount().C_camera_body), **settings)


def worst_of_a_trail(renderer, lens_camera: Camera, sensor: Sensor, exposure: Exposure, **rates: float):
    """Return errors of the trail of a star: the largest of a pixel over its peak, and that of the flux."""
    attitude = {f"{axis}_rate_rad_per_s": np.deg2rad(rate) for axis, rate in rates.items()}
    still = looking_up(lens_camera, sensor=sensor, refraction=False, **attitude)
    middle_px = [lens_camera.width_px / 2 + 3.3, lens_camera.height_px / 2 + 1.6]
    simulator = with_stars_at(still, [middle_px], [0.0], exposure.mid_utc_s)
    scene = simulator.scene(exposure)
    expected = rolling_light(simulator, exposure, 0, 4000)
    drawn = light(renderer, scene)
    assert expected.max() > 100
    return np.abs(drawn - expected).max() / expected.max(), abs(drawn.sum() / expected.sum() - 1)


@pytest.mark.parametrize(("sigma_px", "deg_per_s"), [(0.5, 10.0), (1.2, 60.0), (3.0, 200.0)])
@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_a_trail_is_a_gaussian_moved_on_the_sensor(renderer, part, sigma_px, deg_per_s):
    sensor = Sensor(reference_peak_dn=1e5, psf_sigma_px=sigma_px, bit_depth=16)
    exposure = Exposure(NIGHT_UTC_S + 0.4, min(0.5, 10 / deg_per_s), trail="analytic")
    worst, flux = worst_of_a_trail(renderer, part, sensor, exposure, roll=0.8 * deg_per_s, yaw=0.6 * deg_per_s)
    assert worst <= 4e-3
    assert flux <= 2e-3


@pytest.mark.parametrize(("sigma_px", "deg_per_s"), [(0.5, 10.0), (1.2, 60.0), (3.0, 30.0)])
@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_truth_knows_the_brightest_point_and_the_noise_of_a_trail_behind_a_lens(renderer, part, sigma_px, deg_per_s):
    sensor = Sensor(reference_peak_dn=1e5, psf_sigma_px=sigma_px, bit_depth=16)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 4 / deg_per_s, trail="analytic")
    rates = {"roll_rate_rad_per_s": np.deg2rad(0.8 * deg_per_s), "yaw_rate_rad_per_s": np.deg2rad(0.6 * deg_per_s)}
    still = looking_up(part, sensor=sensor, refraction=False, **rates)
    simulator = with_stars_at(still, [[part.width_px / 2, part.height_px / 2]], [0.0], exposure.mid_utc_s)
    scene = simulator.scene(exposure)
    frame = renderer.render(scene, seed=0, light=True)
    (star,) = orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
    assert star["in_frame"] == 1.0
    # The signal at 500 points of the path, of 4000 positions.
    path_px = star_positions(simulator, 0, exposure.start_utc_s + (np.arange(4000) + 0.5) / 4000 * exposure.duration_s)
    off_px2 = ((path_px[::8, np.newaxis] - path_px) ** 2).sum(axis=-1)
    width_px2 = sensor.effective_sigma_px**2
    brightest = (np.exp(-off_px2 / (2 * width_px2)).mean(axis=1) / (2 * np.pi * width_px2)).max()
    assert star["trail_peak_dn"] == pytest.approx(star["flux_dn"] * brightest, rel=0.02)
    light_dn = frame.light_dn.astype(np.float64)
    noise_dn = np.hypot(sensor.sky_std_dn, 12**-0.5)
    # Of a star narrower than a pixel it depends on where between the pixels the trail lies.
    within = 0.02 if sigma_px > 0.6 else 0.03
    assert star["snr"] == pytest.approx(np.sqrt((light_dn**2).sum()) / noise_dn, rel=within)


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
@pytest.mark.parametrize("name", ["barrel", "beyond"])
def test_a_rolling_shutter_behind_a_lens_opens_rows_of_the_sensor(renderer, name, readout):
    sensor = Sensor(reference_peak_dn=1e5, psf_sigma_px=1.2, bit_depth=16)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.1, trail="analytic", readout_s=0.03, readout=readout)
    assert max(worst_of_a_trail(renderer, PARTS[name], sensor, exposure, roll=40.0, yaw=30.0)) <= 4e-3


@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_a_stack_behind_a_lens_is_that_of_its_short_exposures(renderer, name):
    sensor = Sensor(reference_peak_dn=1e4, psf_sigma_px=1.2, bit_depth=12)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.1, trail="analytic", frames=3, gap_s=0.02)
    assert max(worst_of_a_trail(renderer, PARTS[name], sensor, exposure, roll=20.0, yaw=15.0)) <= 4e-3


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_sprites_behind_a_lens_are_gaussians_on_the_sensor(renderer, readout_s):
    sensor = Sensor(reference_peak_dn=1e5, psf_sigma_px=1.2, bit_depth=16)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.2, rate_hz=2000.0, trail="sprites", readout_s=readout_s)
    assert max(worst_of_a_trail(renderer, PARTS["beyond"], sensor, exposure, roll=20.0, yaw=15.0)) <= 4e-3


CIRCLES = {
    "turning back": Camera(160, 120, 300.0, 300.0, -170.0, 60.0, 0.0, Lens("fisheye", (-0.2,))),
    "cut off": Camera(160, 120, 300.0, 300.0, -228.0, 60.0, 0.0, Lens("fisheye", (), np.deg2rad(60.0))),
}


@pytest.mark.parametrize("deg_per_s", [5.0, 60.0])
@pytest.mark.parametrize("circle", CIRCLES.values(), ids=CIRCLES)
def test_a_trail_ends_where_the_lens_ends_on_the_image(renderer, circle, deg_per_s):
    """Segments with one end beyond the limit must not be dropped."""
    assert np.isnan(circle.unit_vectors([[159.0, 60.0]])).all()
    sensor = Sensor(reference_peak_dn=1e5, psf_sigma_px=1.2, bit_depth=16)
    rates = {f"{axis}_rate_rad_per_s": np.deg2rad(deg_per_s) for axis in ("roll", "pitch")}
    still = sky_over_adelaide(circle, sensor=sensor, refraction=False, **rates)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.5, trail="analytic")
    crossing = 0
    for x_px, y_px in ((80.0, 40.0), (84.0, 60.0), (75.0, 90.0)):
        simulator = with_stars_at(still, [[x_px, y_px]], [0.0], exposure.mid_utc_s)
        xy = star_positions(simulator, 0, np.linspace(exposure.start_utc_s, exposure.stop_utc_s, 100))
        crossing += int(np.isnan(xy).any())
        expected, drawn = rolling_light(simulator, exposure, 0, 4000), light(renderer, simulator.scene(exposure))
        assert drawn.sum() == pytest.approx(expected.sum(), rel=0.02)
        assert np.abs(drawn - expected).max() <= 0.02 * expected.max()
    assert crossing or deg_per_s < 10


def test_a_lens_without_distortion_equals_a_pinhole(renderer):
    scene = still_stars(Lens("plumb_bob", (1e-12,)), Sensor())
    behind_lens = renderer.render(scene, seed=0, light=True).light_dn
    pinhole = renderer.render(replace(scene, camera=scene.camera.pinhole), seed=0, light=True).light_dn
    assert np.abs(behind_lens - pinhole).max() <= 0.005 * pinhole.max()


def test_a_trail_behind_a_lens_has_the_centroid_and_the_flux_of_its_label(renderer):
    sensor = Sensor()
    for x, y in ([60.3, 60.8], [340.2, 240.5], [200.0, 40.6]):
        scene = stars_at([[x, y]], [2.0], sensor=sensor, lens=camera_with(LENSES["barrel"]), turn=turning(8.0))
        frame = renderer.render(scene, seed=0, light=True)
        [label] = orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
        light_dn, rows, columns = around(frame.light_dn, label["centroid_x_px"], label["centroid_y_px"], 45)
        assert (columns * light_dn).sum() / light_dn.sum() == pytest.approx(label["centroid_x_px"], abs=0.004)
        assert (rows * light_dn).sum() / light_dn.sum() == pytest.approx(label["centroid_y_px"], abs=0.004)
        assert light_dn.sum() == pytest.approx(label["flux_dn"], rel=2e-3)


def test_no_ghost_is_drawn_from_beyond_the_maximum_of_the_polynomial(renderer):
    # The image ends at r = 0.6, the polynomial turns at 0.96, and at 1.5 it is back at 0.29.
    lens_camera = Camera(407, 301, 388.0, 388.0, 203.0, 150.0, 0.0, Lens("plumb_bob", (-0.36, 0.0, 0.0, 0.0)))
    ghost = np.array([[1.5, 0.3, 1.0]])
    assert lens_camera.contains(opencv_projects(lens_camera, ghost)).all()
    scene = stars_at([[200.0, 150.0]], [-1.0], sensor=Sensor(), lens=lens_camera)
    scene = replace(scene, stars=replace(scene.stars, direction_eq=ghost))
    assert renderer.render(scene, seed=0, light=True).light_dn.max() == 0
    assert np.isnan(lens_camera.project(ghost)).all()


@pytest.mark.parametrize("lens", [LENSES["barrel"], LENSES["fisheye"]], ids=["barrel", "fisheye"])
def test_no_star_with_flux_on_the_image_is_culled_behind_a_lens(renderer, lens):
    simulator = sky_over_adelaide(camera_with(lens), yaw_rate_rad_per_s=0.1)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.2))
    everything = replace(
        scene,
        draw_list=DrawList(
            np.arange(len(scene.stars), dtype=np.int32),
            simulator.sensor.truncation_radius_px(simulator.sensor.peak_dn(scene.stars.vmag, 0.2)),
        ),
    )
    found = renderer.render(scene, seed=0, light=True).light_dn
    all_of_them = renderer.render(everything, seed=0, light=True).light_dn
    assert all_of_them.sum() > 1000
    assert np.abs(found - all_of_them).max() <= 0.05


def test_lens_and_pinhole_alternate_on_one_renderer(renderer):
    behind_lens = still_stars(LENSES["barrel"], Sensor())
    pinhole = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())
    first = [renderer.render(scene, seed=1).pixels for scene in (behind_lens, pinhole)]
    again = [renderer.render(scene, seed=1).pixels for scene in (behind_lens, pinhole)]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
