"""The noiseless signal, against NumPy and against the integral over pixels."""

from dataclasses import replace

import numpy as np
import orjson
import pytest
from scipy import special

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.truth.frame import frame_truth
from tests.support.reference import integrated_profile, light_of
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning

# Largest difference from the reference in any pixel, as a fraction of the star's peak.
PEAK_FRACTION = 1e-4
CELL_PX = 40
RATES_DEG_PER_S = [0.0, 2.0, 10.0, 200.0]


def sensors():
    return [
        pytest.param(Sensor(), id="integrated"),
        pytest.param(Sensor(pixel="sampled"), id="sampled"),
        pytest.param(Sensor(psf_sigma_px=0.4), id="erf"),
        pytest.param(Sensor(psf_sigma_px=0.9), id="widest of erf"),
        pytest.param(Sensor(psf_sigma_px=1.1), id="narrowest widened"),
        pytest.param(Sensor(psf_sigma_px=2.0, bit_depth=16, reference_peak_dn=30000.0), id="16 bits"),
    ]


def grid(sensor: Sensor, *, deg_per_s: float, n: int = 100, lens=None) -> tuple[Scene, np.ndarray]:
    """Return stars of all magnitudes, one per cell, at different sub-pixel phases, and the corners of the cells."""
    lens = lens or camera()
    corners = np.array([(x, y) for y in range(0, lens.height_px, CELL_PX) for x in range(0, lens.width_px, CELL_PX)])
    phase = np.random.default_rng(1).uniform(0, 1, corners.shape)
    vmag = np.linspace(-1.5, 8.0, len(corners))
    xy = corners + CELL_PX / 2 - 1 + phase
    return stars_at(xy, vmag, sensor=sensor, lens=lens, n=n, turn=turning(deg_per_s)), corners


def light(renderer: GLRenderer, scene: Scene) -> np.ndarray:
    drawn = renderer.render(scene, seed=0, light=True).light_dn
    assert drawn is not None
    return drawn.astype(np.float64)


@pytest.mark.parametrize("deg_per_s", [0.0, 4.0])
@pytest.mark.parametrize("sensor", sensors())
def test_every_pixel_of_every_star_equals_the_reference(renderer, sensor, deg_per_s):
    scene, corners = grid(sensor, deg_per_s=deg_per_s)
    difference = np.abs(light(renderer, scene) - light_of(scene))
    peak_dn = sensor.peak_dn(scene.stars.vmag, scene.exposure.duration_s)
    for (x, y), peak in zip(corners, peak_dn, strict=True):
        # The margin of a cell has flux of its neighbours, whose peaks may be higher.
        cell = difference[y + 8 : y + CELL_PX - 8, x + 8 : x + CELL_PX - 8]
        assert cell.max() <= PEAK_FRACTION * peak


def test_a_star_with_a_measured_magnitude_is_drawn_with_it(renderer):
    lens, sensor = camera(), Sensor()
    xy = [(80.3, 60.2), (240.1, 180.4)]
    plain = stars_at(xy, [3.0, 3.0], sensor=sensor, lens=lens)
    redder = replace(plain, stars=replace(plain.stars, measured_mag=np.array([2.0, 3.0])))
    before, after = light(renderer, plain), light(renderer, redder)
    assert after[40:80, 60:100].sum() == pytest.approx(10**0.4 * before[40:80, 60:100].sum(), rel=1e-5)
    np.testing.assert_array_equal(after[160:200, 220:260], before[160:200, 220:260])


@pytest.mark.parametrize("attitude", [{}, {"yaw_rate_rad_per_s": 0.17}, {"roll_rad": 1.0, "roll_rate_rad_per_s": 0.17}])
def test_a_real_sky_equals_the_reference(renderer, attitude):
    exposure = Exposure(NIGHT_UTC_S + 4, 0.1, trail="sprites")
    scene = sky_over_adelaide(camera(507, 380, 484.0), **attitude).scene(exposure)
    drawn, reference = light(renderer, scene), light_of(scene)
    assert np.abs(drawn - reference).max() <= PEAK_FRACTION * reference.max()
    assert drawn.sum() == pytest.approx(reference.sum(), rel=1e-3)


@pytest.mark.parametrize("deg_per_s", RATES_DEG_PER_S)
@pytest.mark.parametrize("sensor", sensors())
def test_flux_is_preserved_for_any_motion_and_brightness(renderer, sensor, deg_per_s):
    lens = camera(1014, 760, 967.7)
    n = 400 if deg_per_s > 100 else 100
    vmag = [-1.5, 1.0, 3.0, 5.0, 6.5, 8.0]
    for magnitude in vmag:
        scene = stars_at([[506.3, 379.8]], [magnitude], sensor=sensor, lens=lens, n=n, turn=turning(deg_per_s / 5))
        flux_dn = sensor.flux_dn(sensor.peak_dn(magnitude, scene.exposure.duration_s))
        assert light(renderer, scene).sum() == pytest.approx(float(flux_dn), rel=2e-3)


def test_a_trail_equals_that_of_continuous_integration(renderer):
    """L1 of 0.002 against 2000 sub-exposures integrated over the pixels, at 10 deg/s, sigma 1.2 px, 1014 x 760."""
    lens, sensor = camera(1014, 760, 967.7425), Sensor(psf_sigma_px=1.2)
    xy = np.array([(x, y) for x in (150.3, 420.8, 700.1, 860.4) for y in (120.6, 380.2, 640.9)])
    turn = turning(10.0)
    scene = stars_at(xy, np.linspace(0, 6, len(xy)), sensor=sensor, lens=lens, n=100, turn=turn)
    fine = stars_at(xy, scene.stars.vmag, sensor=sensor, lens=lens, n=2000, turn=turn)
    centres = lens.project(fine.trails.pointing.to_camera(fine.stars.direction_eq))
    drawn = light(renderer, scene)
    for k, peak_dn in enumerate(sensor.peak_dn(scene.stars.vmag, 0.5)):
        (left, top), (right, bottom) = centres[:, k].min(axis=0) - 12, centres[:, k].max(axis=0) + 12
        columns, rows = np.arange(int(left), int(right)), np.arange(int(top), int(bottom))
        across = integrated_profile(columns - centres[:, k, :1], 1.2)
        along = integrated_profile(rows - centres[:, k, 1:], 1.2)
        converged = peak_dn / 2000 * along.T @ across
        seen = drawn[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        assert np.abs(seen - converged).sum() / converged.sum() <= 0.002


@pytest.mark.parametrize("deg_per_s", [0.0, 4.0])
def test_the_centroid_of_the_signal_is_its_label(renderer, deg_per_s):
    scene, corners = grid(Sensor(), deg_per_s=deg_per_s)
    frame = renderer.render(scene, seed=0, light=True)
    labels = {
        star["star_id"]: star for star in orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
    }
    checked = 0
    for star_id, (x, y) in enumerate(corners, start=1):
        label = labels[star_id]
        if label["peak_dn"] > 250:  # the flux of brighter stars extends into their neighbours' cells
            continue
        cell = frame.light_dn[y : y + CELL_PX, x : x + CELL_PX].astype(np.float64)
        cell[cell < 1e-3 * cell.max()] = 0.0
        rows, columns = np.indices(cell.shape)
        measured = x + (columns * cell).sum() / cell.sum(), y + (rows * cell).sum() / cell.sum()
        assert measured == pytest.approx((label["centroid_x_px"], label["centroid_y_px"]), abs=0.003)
        checked += 1
    assert checked > 20


@pytest.mark.parametrize("deg_per_s", [0.0, 4.0])
def test_a_saturated_star_has_no_square_edge(renderer, deg_per_s):
    """Where the sprite ends, the flux of the exposure is below 0.02 DN, however bright the star."""
    for vmag in (-4.0, -1.46, 1.0):
        scene = stars_at([[160.4, 120.2]], [vmag], sensor=Sensor(), lens=camera(), turn=turning(deg_per_s))
        drawn = light(renderer, scene)
        assert light_of(scene)[drawn == 0].max() <= 0.02


@pytest.mark.parametrize("distance_px", [-6.0, -3.0, -1.0, -0.5, 0.0, 2.0])
def test_stars_at_the_border_are_drawn_to_its_last_pixel(renderer, distance_px):
    lens, sensor = camera(), Sensor()
    xy = [[distance_px, 60.3], [319 - distance_px, 120.7], [100.2, distance_px], [220.9, 239 - distance_px]]
    scene = stars_at(xy, [-1.0] * 4, sensor=sensor, lens=lens, turn=turning(1.0))
    reference = light_of(scene)
    peak_dn = float(sensor.peak_dn(-1.0, 0.5))
    assert np.abs(light(renderer, scene) - reference).max() <= PEAK_FRACTION * peak_dn
    assert reference.max() > 0


@pytest.mark.parametrize("beyond_px", [9.0, 10.5, 12.0])
def test_the_flux_of_a_wide_star_outside_the_border_extends_into_the_image(renderer, beyond_px):
    """A point whose centre lies outside the target is not drawn at all, so the target has a guard band."""
    lens, sensor = camera(), Sensor(psf_sigma_px=3.0)
    xy = [[-0.5 - beyond_px, 60.3], [319.5 + beyond_px, 120.7], [100.2, -0.5 - beyond_px], [220.9, 239.5 + beyond_px]]
    scene = stars_at(xy, [-1.0] * 4, sensor=sensor, lens=lens)

    drawn = light(renderer, scene)

    reference = light_of(scene)
    for x, y in np.clip(np.rint(xy).astype(int), 0, [319, 239]):
        assert reference[y, x] > 0.1
        assert drawn[y, x] == pytest.approx(reference[y, x], rel=0.02, abs=0.02)


def test_a_star_that_enters_during_the_exposure_is_drawn_from_the_border_on(renderer):
    lens, sensor = camera(), Sensor()
    scene = stars_at([[-1.0, 100.0], [321.0, 150.0]], [0.0, 0.0], sensor=sensor, lens=lens, turn=turning(8.0))
    peak_dn = float(sensor.peak_dn(0.0, 0.5))
    assert np.abs(light(renderer, scene) - light_of(scene)).max() <= PEAK_FRACTION * peak_dn


@pytest.mark.parametrize("n", [1, 2, 3, 5, 1023, 1025, 2050])
def test_any_number_of_sub_exposures_adds_up_to_one_exposure(renderer, n):
    scene = stars_at([[160.4, 120.2]], [2.0], sensor=Sensor(), lens=camera(), n=n, turn=turning(3.0))
    difference = np.abs(light(renderer, scene) - light_of(scene)).max()
    assert difference <= PEAK_FRACTION * float(Sensor().peak_dn(2.0, 0.5))


@pytest.mark.parametrize("rate_deg_per_s", [20.0, 60.0, 150.0])
def test_a_fast_trail_has_no_sampling_ripple(renderer, rate_deg_per_s):
    simulator = sky_over_adelaide(
        camera(507, 380, 484.0), vmag_limit=3.0, yaw_rate_rad_per_s=np.deg2rad(rate_deg_per_s)
    )
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.5, trail="sprites"))
    xy = simulator.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq[scene.visible]))
    on_image = simulator.camera.contains(xy)
    steps_px = np.linalg.norm(np.diff(xy, axis=0), axis=-1)[on_image[1:] & on_image[:-1]]
    assert steps_px.max() <= 1.001 * 1.5 * simulator.sensor.psf_sigma_px


def test_stars_below_the_apparent_horizon_are_not_drawn(renderer):
    """A camera pointed at the horizon sees only stars above it, including refraction."""
    simulator = sky_over_adelaide(camera(), pitch_rad=-np.pi / 2 + 0.2)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.05))
    drawn = light(renderer, scene)
    in_camera = scene.trails.pointing.to_camera(simulator.stars.direction_eq)[0]
    up = scene.trails.pointing.C_camera_eq[0] @ scene.trails.pointing.zenith_eq[0]
    altitude = np.arcsin(in_camera @ up / np.linalg.norm(in_camera, axis=-1))
    assert np.nanmin(altitude) >= -1e-12
    brightest_dn = simulator.sensor.peak_dn(simulator.stars.vmag[scene.visible], 0.05).max()
    assert np.abs(drawn - light_of(scene)).max() <= PEAK_FRACTION * brightest_dn


def test_an_empty_sky_is_dark(renderer):
    scene = sky_over_adelaide(camera(32, 24, 300000.0), vmag_limit=0.0).scene(Exposure(NIGHT_UTC_S + 4, 0.05))
    assert scene.visible.size == 0
    assert light(renderer, scene).max() == 0.0


@pytest.mark.parametrize("sigma_px", [0.3, 0.5, 0.69, 0.71, 0.9, 1.0, 1.09, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 8.0])
def test_at_most_a_thousandth_of_a_stars_flux_is_in_another_pixel(renderer, sigma_px):
    """The sum of differences from the exact integral over each pixel, over the flux, at random phases."""
    rng, spacing_px = np.random.default_rng(5), 12 * max(sigma_px, 1.0) + 12
    columns, rows = int(640 // spacing_px), int(480 // spacing_px)
    cells = np.array([(column, row) for row in range(rows) for column in range(columns)][:60])
    xy = (cells + 0.5) * spacing_px + rng.uniform(-0.5, 0.5, cells.shape)
    sensor = Sensor(psf_sigma_px=sigma_px, bit_depth=16, reference_peak_dn=30000.0)
    drawn = light(renderer, stars_at(xy, [3.0] * len(xy), sensor=sensor, lens=camera(640, 480)))

    def integral(size_px, centre_px):
        edges = np.arange(size_px + 1) - 0.5
        return np.diff(special.erf((edges - centre_px[:, np.newaxis]) / (np.sqrt(2) * sigma_px)) / 2)

    exact = integral(480, xy[:, 1]).T @ integral(640, xy[:, 0]) * 30000.0 * 2 * np.pi * sigma_px**2
    assert np.abs(drawn - exact).sum() <= 1e-3 * exact.sum()
