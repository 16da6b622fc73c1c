"""Stars behind a lens, against OpenCV and against the integral over each pixel's patch of the undistorted plane."""

from dataclasses import replace

import cv2
import numpy as np
import orjson
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene
from glstar.render.truth.frame import frame_truth
from tests.support.lenses import LENSES, camera_with
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning

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


def integrated(scene: Scene, star: int, rows: np.ndarray, columns: np.ndarray, samples: int = 8) -> np.ndarray:
    """Return a star's flux in some pixels, each sampled at 64 positions of its patch of the undistorted plane."""
    lens_camera, step = scene.camera, 1e-3
    inside = (np.arange(samples) + 0.5) / samples - 0.5
    xy = np.stack(np.meshgrid(columns[0][:, np.newaxis] + inside, rows[:, 0][:, np.newaxis] + inside), axis=-1)

    def undistorted(xy_px: np.ndarray) -> np.ndarray:
        return lens_camera.pinhole.project(lens_camera.unit_vectors(xy_px))

    along_x, along_y = step * np.eye(2)
    by_x = (undistorted(xy + along_x) - undistorted(xy - along_x)) / (2 * step)
    by_y = (undistorted(xy + along_y) - undistorted(xy - along_y)) / (2 * step)
    area = np.abs(by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0])
    centre = lens_camera.pinhole.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[0, star]
    peak_dn = scene.sensor.peak_dn(scene.stars.vmag[star], scene.exposure.duration_s)
    off2 = ((undistorted(xy) - centre) ** 2).sum(axis=-1)
    light = peak_dn * area * np.exp(-off2 / (2 * scene.sensor.psf_sigma_px**2))
    return light.reshape(len(rows), samples, columns.shape[1], samples).mean(axis=(1, 3))


@every_lens
def test_a_star_is_drawn_where_opencv_projects_it_to_the_corners(renderer, lens):
    scene = still_stars(lens, Sensor())
    direction = scene.trails.pointing.to_camera(scene.stars.direction_eq)[0]
    frame = renderer.render(scene, seed=0, light=True)
    labels = {
        star["star_id"]: star for star in orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
    }
    for star_id, (x, y) in enumerate(opencv_projects(scene.camera, direction), start=1):
        light, rows, columns = around(frame.light_dn, x, y)
        # Half of a star at the image's edge would be missing; 9.6 px are sufficient.
        assert (columns * light).sum() / light.sum() == pytest.approx(x, abs=0.02)
        assert (rows * light).sum() / light.sum() == pytest.approx(y, abs=0.02)
        assert [labels[star_id]["x_px"], labels[star_id]["y_px"]] == pytest.approx([x, y], abs=1e-5)
        assert [labels[star_id]["centroid_x_px"], labels[star_id]["centroid_y_px"]] == pytest.approx([x, y], abs=1e-5)


@pytest.mark.parametrize(
    "sensor", [Sensor(), Sensor(psf_sigma_px=0.8), Sensor(psf_sigma_px=2.0)], ids=["1.2", "0.8", "2"]
)
@every_lens
def test_every_pixel_integrates_its_patch_and_flux_is_preserved(renderer, lens, sensor):
    scene = still_stars(lens, sensor)
    frame = renderer.render(scene, seed=0, light=True)
    flux_dn = sensor.flux_dn(sensor.peak_dn(3.0, scene.exposure.duration_s))
    for star, (x, y) in enumerate(POSITIONS):
        light, rows, columns = around(frame.light_dn, x, y)
        reference = integrated(scene, star, rows, columns)
        assert np.abs(light - reference).max() <= 0.003 * reference.max()
        assert light.sum() == pytest.approx(reference.sum(), rel=2e-3)
        if sensor.psf_sigma_px < 2:  # all of it is on the image
            assert light.sum() == pytest.approx(flux_dn, rel=2e-3)


def test_a_star_behind_a_barrel_is_smaller_and_its_peak_higher_at_the_corner(renderer):
    scene = still_stars(LENSES["barrel"], Sensor())
    light = renderer.render(scene, seed=0, light=True).light_dn
    middle, corner = around(light, *POSITIONS[4])[0], around(light, *POSITIONS[0])[0]
    assert corner.max() > 1.3 * middle.max()
    assert corner.sum() == pytest.approx(middle.sum(), rel=2e-3)


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
        light, rows, columns = around(frame.light_dn, label["centroid_x_px"], label["centroid_y_px"], 45)
        assert (columns * light).sum() / light.sum() == pytest.approx(label["centroid_x_px"], abs=0.004)
        assert (rows * light).sum() / light.sum() == pytest.approx(label["centroid_y_px"], abs=0.004)
        assert light.sum() == pytest.approx(label["flux_dn"], rel=2e-3)


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
            simulator.camera.max_magnification
            * simulator.sensor.truncation_radius_px(simulator.sensor.peak_dn(scene.stars.vmag, 0.2)),
        ),
    )
    found = renderer.render(scene, seed=0, light=True).light_dn
    all_of_them = renderer.render(everything, seed=0, light=True).light_dn
    assert all_of_them.sum() > 1000
    assert np.abs(found - all_of_them).max() <= 0.05


def test_a_field_too_wide_for_a_plane_is_refused_with_a_message(renderer):
    wide = Camera(1014, 760, 330.0, 330.0, 506.5, 379.5, 0.0, Lens("fisheye", ()))
    message = r"the camera's fisheye lens sees \d+\.\d deg off its axis and glstar draws up to 70"
    with pytest.raises(RenderError, match=message):
        sky_over_adelaide(wide).scene(Exposure(NIGHT_UTC_S + 4, 0.2))
    with pytest.raises(RenderError, match=message):
        renderer.render(stars_at([[506.0, 380.0]], [0.0], sensor=Sensor(), lens=wide), seed=0)


def test_lens_and_pinhole_alternate_on_one_renderer(renderer):
    behind_lens = still_stars(LENSES["barrel"], Sensor())
    pinhole = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())
    first = [renderer.render(scene, seed=1).pixels for scene in (behind_lens, pinhole)]
    again = [renderer.render(scene, seed=1).pixels for scene in (behind_lens, pinhole)]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
