"""Stars with wings, halo, growth and ellipticity, against the profiles themselves summed in float64."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.errors import RenderError
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import gaussian_scenes
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, with_stars_at

SIGMA_PX = 1.4
# Points of a pixel, along each side, at which profiles are evaluated.
PARTS = 5


def sensor_with(sigma_px: float = SIGMA_PX, **psf: float | str) -> Sensor:
    effects = {f"sensor.{key}": value for key, value in psf.items()}
    return Sensor(reference_peak_dn=30_000.0, psf_sigma_px=sigma_px, bit_depth=16, effects=effects)


def gaussian(x, y, sigma_px):
    return np.exp(-(x * x + y * y) / (2 * sigma_px**2)) / (2 * np.pi * sigma_px**2)


def moffat(x, y, sigma_px, beta):
    alpha2 = (2.354820045 * sigma_px / 2) ** 2 / (2 ** (1 / beta) - 1)
    return (beta - 1) / (np.pi * alpha2) * (1 + (x * x + y * y) / alpha2) ** -beta


def elliptical(x, y, sigma_px, ellipticity, angle_deg):
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    along, across, ratio = c * x + s * y, c * y - s * x, 1 - ellipticity
    return np.exp(-(along**2 * ratio + across**2 / ratio) / (2 * sigma_px**2)) / (2 * np.pi * sigma_px**2)


def summed(profile, shape, path_px):
    """Return the sum of a profile along a path, integrated over each pixel; its flux is 1."""
    rows, columns = shape
    inside = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    x = (np.arange(columns)[:, np.newaxis] + inside).ravel()
    y = (np.arange(rows)[:, np.newaxis] + inside).ravel()
    image = np.zeros((rows * PARTS, columns * PARTS))
    for x_px, y_px in path_px:
        image += profile(*np.meshgrid(x - x_px, y - y_px))
    return image.reshape(rows, PARTS, columns, PARTS).mean(axis=(1, 3)) / len(path_px)


def light(renderer: GLRenderer, scene: Scene) -> np.ndarray:
    drawn = renderer.render(scene, seed=0, light=True).light_dn
    assert drawn is not None
    return drawn.astype(np.float64)


def flux_dn(scene: Scene) -> float:
    peak_dn = scene.sensor.peak_dn(scene.stars.camera_mag, scene.exposure.duration_s)
    return float(scene.sensor.flux_dn(peak_dn).sum())


def encircled(image: np.ndarray, x_y: tuple[float, float]) -> np.ndarray:
    """Return the flux within the pixels of an image sorted by their distance from a point."""
    rows, columns = np.indices(image.shape)
    return np.cumsum(image.ravel()[np.argsort(np.hypot(columns - x_y[0], rows - x_y[1]).ravel(), kind="stable")])


@pytest.mark.parametrize("beta", [2.0, 2.5, 3.5, 5.0])
def test_the_encircled_energy_of_a_moffat_star_is_the_profiles_within_half_a_percent(renderer, beta):
    sensor, x_y = sensor_with(psf="moffat", psf_beta=beta), (80.2, 80.4)
    scene = stars_at([x_y], [3.0], sensor=sensor, lens=camera(161, 161), n=4)
    drawn = light(renderer, scene)
    expected = summed(lambda x, y: moffat(x, y, SIGMA_PX, beta), drawn.shape, [x_y])
    wrong = encircled(drawn, x_y) / flux_dn(scene) - encircled(expected, x_y)
    assert np.abs(wrong).max() < 5e-3


PROFILES = {
    "wings": (
        {"psf_wing_fraction": 0.25, "psf_wing_sigma_px": 4.5},
        lambda x, y: 0.75 * gaussian(x, y, SIGMA_PX) + 0.25 * gaussian(x, y, 4.5),
    ),
    "ellipse": (
        {"psf_ellipticity": 0.25, "psf_angle_deg": 30.0},
        lambda x, y: elliptical(x, y, SIGMA_PX, 0.25, 30.0),
    ),
    "narrow ellipse with wings": (
        {"psf_ellipticity": 0.15, "psf_angle_deg": -70.0, "psf_wing_fraction": 0.1, "psf_wing_sigma_px": 6.0},
        lambda x, y: 0.9 * elliptical(x, y, SIGMA_PX, 0.15, -70.0) + 0.1 * gaussian(x, y, 6.0),
    ),
}


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
@pytest.mark.parametrize("name", PROFILES)
def test_a_trail_is_that_of_its_profile_within_a_500th_of_its_peak(renderer, name, trail):
    psf, profile = PROFILES[name]
    simulator = sky_over_adelaide(camera(96, 72), yaw_rate_rad_per_s=np.deg2rad(60), roll_rate_rad_per_s=0.1)
    simulator = replace(simulator, sensor=sensor_with(**psf))
    simulator = with_stars_at(simulator, [(62.3, 30.6)], [1.0], NIGHT_UTC_S + 1.1)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 1, 0.25, 2000.0, trail=trail))
    path_px = scene.positions(scene.stars.direction_eq, (np.arange(300) + 0.5) / 300)[:, 0]
    assert np.linalg.norm(path_px[-1] - path_px[0]) > 4  # sigma 1.4: a trail

    drawn = light(renderer, scene)

    expected = flux_dn(scene) * summed(profile, drawn.shape, path_px)
    assert np.abs(drawn - expected).max() < 2e-3 * expected.max()


def test_a_moving_star_with_all_of_it_behind_a_lens_keeps_its_flux(renderer):
    lens = replace(camera(240, 180, 200.0), lens=Lens("plumb_bob", (-0.15, 0.0, 0.0, 0.0, 0.0)))
    psf = {"psf": "moffat", "psf_ellipticity": 0.2, "psf_growth": 0.4, "psf_halo_fraction": 0.01}
    sensor = sensor_with(psf_halo_radius_px=8.0, **psf)
    scene = stars_at([(150.0, 70.0)], [3.0], sensor=sensor, lens=lens, turn=lambda u: (0.05 * u, 0 * u))
    assert light(renderer, scene).sum() == pytest.approx(flux_dn(scene), rel=5e-3, abs=0)


def test_widths_grow_with_the_square_of_the_distance_from_the_principal_point(renderer):
    lens, growth = camera(320, 240), 0.6
    x_y = np.array([(159.5, 119.5), (240.0, 180.0), (300.0, 222.0)])
    for at in x_y:
        scene = stars_at([at], [1.0], sensor=sensor_with(psf_growth=growth), lens=lens, n=4)
        drawn = light(renderer, scene)
        columns = np.arange(drawn.shape[1])
        variance = ((columns - at[0]) ** 2 * drawn).sum() / drawn.sum() - 1 / 12
        scale = 1 + growth * ((at - (159.5, 119.5)) ** 2).sum() / (160**2 + 120**2)
        assert np.sqrt(variance) == pytest.approx(SIGMA_PX * scale, rel=0.012, abs=0)
        assert drawn.sum() == pytest.approx(flux_dn(scene), rel=1e-3, abs=0)


def second_moment_px(drawn: np.ndarray, x_px: float) -> float:
    """Return the standard deviation of the light along x, without that of a pixel."""
    columns = np.arange(drawn.shape[1])
    return float(np.sqrt(((columns - x_px) ** 2 * drawn).sum() / drawn.sum() - 1 / 12))


@pytest.mark.parametrize(("at", "bv"), [((159.5, 119.5), 0.65), ((280.0, 180.0), 0.65), ((60.0, 40.0), 1.4)])
def test_widths_follow_the_tilt_of_the_sensor_and_the_colour_of_the_star(renderer, at, bv):
    tilted = sensor_with(psf_tilt=0.4, psf_tilt_angle_deg=30.0, psf_colour_growth=0.2)
    scene = stars_at([at], [1.0], sensor=tilted, lens=camera(320, 240), n=4)
    scene = replace(scene, stars=replace(scene.stars, bv=np.array([bv])))
    drawn = light(renderer, scene)
    x, y = (at[0] - 159.5) / 200, (at[1] - 119.5) / 200
    scale = 1 + 0.4 * (x * np.cos(np.pi / 6) + y * np.sin(np.pi / 6)) + 0.2 * (bv - 0.65)
    assert second_moment_px(drawn, at[0]) == pytest.approx(SIGMA_PX * scale, rel=0.012, abs=0)
    assert drawn.sum() == pytest.approx(flux_dn(scene), rel=1e-3, abs=0)


@pytest.mark.parametrize("at", [(100.0, 80.0), (61.37, 45.81)])
def test_a_star_that_is_mostly_pixel_is_integrated_behind_a_lens(renderer, at):
    # Without distortion, so that the sum over pixels of the star itself is known.
    lens = replace(camera(200, 160, 300.0), lens=Lens("plumb_bob", (1e-9, 0.0, 0.0, 0.0, 0.0)))
    psf = {"psf_wing_fraction": 0.3, "psf_wing_sigma_px": 1.5}
    scene = stars_at([at], [3.0], sensor=sensor_with(0.15, **psf), lens=lens, n=4)
    drawn = light(renderer, scene) / flux_dn(scene)

    def pixels(sigma_px):
        axes = []
        for centre, count in zip(at, (200, 160), strict=True):
            edges = (np.arange(count + 1) - 0.5 - centre) / (np.sqrt(2) * sigma_px)
            axes.append(np.diff(erf(edges)) / 2)
        return np.outer(axes[1], axes[0])

    expected = 0.7 * pixels(0.15) + 0.3 * pixels(1.5)
    assert drawn.sum() == pytest.approx(1, rel=2e-3, abs=0)
    assert np.abs(drawn - expected).max() < 4e-3 * expected.max()


def test_wings_wider_than_a_sprite_keep_their_light_but_for_a_thousandth(renderer):
    lens = replace(camera(400, 320, 300.0), lens=Lens("plumb_bob", (1e-9, 0.0, 0.0, 0.0, 0.0)))
    # 6 px of the undistorted signal in each pixel, and wings of 27 px: they would be drawn up to 130 px.
    sensor = sensor_with(0.2, psf_wing_fraction=0.5, psf_wing_sigma_px=4.5)
    scene = stars_at([(200.0, 160.0)], [-3.0], sensor=sensor, lens=lens, n=1)
    assert light(renderer, scene).sum() == pytest.approx(flux_dn(scene), rel=2e-3, abs=0)


def test_the_surface_brightness_of_a_halo_falls_with_the_square_of_the_distance(renderer):
    sensor = sensor_with(1.0, psf_halo_fraction=0.3, psf_halo_radius_px=32.0)
    scene = stars_at([(100.0, 100.0)], [-4.0], sensor=sensor, lens=camera(201, 201), n=4)
    drawn = light(renderer, scene)
    at = {radius_px: drawn[100, 100 + radius_px] for radius_px in (8, 12, 16, 24)}
    for radius_px, value in at.items():
        assert value == pytest.approx(at[12] * (12 / radius_px) ** 2, rel=0.15, abs=0)


def test_a_changed_point_spread_draws_the_stars_again(renderer):
    plain = stars_at([(80.0, 60.0)], [3.0], sensor=sensor_with(), lens=camera(160, 120), n=4)
    winged = replace(plain, sensor=sensor_with(psf_wing_fraction=0.3))
    before, after = light(renderer, plain), light(renderer, winged)
    assert after[60, 88] > 10 * before[60, 88]
    assert np.array_equal(light(renderer, plain), before)


def test_wings_of_a_sensor_that_counts_electrons_keep_the_flux(renderer):
    sensor = replace(sensor_with(psf="moffat", psf_wing_fraction=0.2), electrons=ElectronModel())
    scene = stars_at([(80.0, 60.0)], [3.0], sensor=sensor, lens=camera(161, 121), n=4)
    expected_dn = 0.47 * 90_000 * 0.5 * 10 ** (-0.4 * 3)
    assert flux_dn(scene) == pytest.approx(expected_dn, rel=1e-9, abs=0)
    assert light(renderer, scene).sum() == pytest.approx(expected_dn, rel=5e-3, abs=0)


def test_wide_gaussians_take_fewer_sub_exposures_of_the_same_path():
    simulator = sky_over_adelaide(camera(96, 72), yaw_rate_rad_per_s=np.deg2rad(60))
    simulator = with_stars_at(simulator, [(62.3, 30.6)], [1.0], NIGHT_UTC_S + 1.1)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 1, 0.25, 400.0, trail="sprites"))
    path_px = scene.trails.positions(scene.camera, scene.stars.direction_eq, (np.arange(100) + 0.5) / 100)[:, 0]
    fewer = scene.trails.for_sigma(scene.camera, 4.0)
    count = len(fewer)
    assert len(scene.trails) == 100
    assert 1 < count < 50
    found_px = fewer.positions(scene.camera, scene.stars.direction_eq, (np.arange(count) + 0.5) / count)[:, 0]
    assert np.linalg.norm(np.diff(found_px, axis=0), axis=1).max() <= 1.5 * 4.0
    assert np.allclose(found_px, path_px.reshape(count, -1, 2).mean(axis=1), rtol=0, atol=0.01)


@pytest.mark.parametrize("readout_s", [0.0, 0.05])
@pytest.mark.parametrize("mosaic", ["none", "rggb"])
@pytest.mark.parametrize("sigma_px", [1.0, 1.4])  # the core is narrower than a pixel kernel, and wider
def test_gaussians_that_are_drawn_together_leave_the_light_that_they_leave_one_by_one(
    renderer, sigma_px, mosaic, readout_s
):
    effects = {"sensor.psf": "moffat", "sensor.psf_wing_fraction": 0.02, "sensor.psf_growth": 0.3}
    if mosaic != "none":
        effects |= {"sensor.mosaic": mosaic, "sensor.band": "imx477"}
    sensor = Sensor(reference_peak_dn=3000.0, psf_sigma_px=sigma_px, bit_depth=16, effects=effects)
    simulator = replace(sky_over_adelaide(camera(322, 240)), sensor=sensor)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 1, 0.25, readout_s=readout_s, trail="analytic"))
    gaussians = gaussian_scenes(scene)
    assert len(gaussians) > 4

    drawn, one_by_one = light(renderer, scene), sum(light(renderer, one) for one in gaussians)

    # Alone, each is drawn as two during a segment, and with another guard band a sprite may be a pixel wider.
    inside = np.s_[40:-40, 40:-40]
    assert one_by_one[inside].max() > 100
    np.testing.assert_allclose(drawn[inside], one_by_one[inside], rtol=3e-4, atol=TRUNCATION_DN)


def test_a_faint_star_whose_wings_are_cut_keeps_its_flux(renderer):
    sensor = sensor_with(psf="moffat")
    simulator = replace(sky_over_adelaide(camera(161, 161)), sensor=sensor)
    simulator = with_stars_at(simulator, [(80.2, 80.4)], [12.5], NIGHT_UTC_S + 1)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 1, 0.25, trail="analytic"))
    assert 1 < scene.sensor.peak_dn(12.5, 0.25) < 5
    assert light(renderer, scene).sum() == pytest.approx(flux_dn(scene), rel=3e-3, abs=0)


def pixels_of(sigma_px, x_y, shape):
    """Return a Gaussian of flux 1, integrated over the pixels exactly."""
    axes = []
    for side, at in zip(shape, x_y[::-1], strict=True):
        edges = erf((np.arange(side + 1) - 0.5 - at) / (np.sqrt(2) * sigma_px)) / 2
        axes.append(np.diff(edges))
    return np.outer(*axes)


@pytest.mark.parametrize("moves", [False, True])
def test_wide_wings_of_a_narrow_star_behind_a_lens_are_drawn(renderer, moves):
    # A fit once wrote such stars: narrow ones are drawn at many times the resolution, where wings fill 300 px.
    lens = replace(camera(161, 121, 400.0), lens=Lens("plumb_bob", (1e-7,)))
    sensor, x_y = sensor_with(0.2, psf_wing_fraction=0.3, psf_wing_sigma_px=6.0), (80.2, 60.4)
    turn = {"turn": lambda u: (0.004 * u, 0 * u), "n": 400} if moves else {"n": 4}
    scene = stars_at([x_y], [3.0], sensor=sensor, lens=lens, **turn)
    drawn = light(renderer, scene)
    path_px = scene.positions(scene.stars.direction_eq, (np.arange(300) + 0.5) / 300)[:, 0]
    expected = np.mean(
        [0.7 * pixels_of(0.2, one, drawn.shape) + 0.3 * pixels_of(6.0, one, drawn.shape) for one in path_px], axis=0
    )
    wrong = drawn / flux_dn(scene) - expected
    assert drawn.sum() == pytest.approx(flux_dn(scene), rel=2e-3, abs=0)
    assert np.abs(wrong).max() < 0.06 * expected.max()
    wings = np.hypot(*(np.indices(drawn.shape)[::-1] - np.array(x_y)[:, np.newaxis, np.newaxis])) > 5
    assert np.abs(wrong[wings]).max() < 1e-4 * expected.max()


def test_wings_too_wide_to_be_drawn_are_refused_by_the_name_of_their_key(context, renderer):
    if context.info["GL_POINT_SIZE_RANGE"][1] > 300:
        pytest.skip("this driver draws sprites of more than 300 px")
    lens = replace(camera(161, 121, 400.0), lens=Lens("plumb_bob", (1e-7,)))
    sensor = sensor_with(0.2, psf_wing_fraction=0.3, psf_wing_sigma_px=40.0)
    scene = stars_at([(80.2, 60.4)], [3.0], sensor=sensor, lens=lens, n=4)
    with pytest.raises(RenderError, match=r"sensor.psf_wing_sigma_px = 40 requires sprites of \d+ px .*it may be 36.4"):
        renderer.render(scene, seed=0)
    allowed = replace(scene, sensor=sensor_with(0.2, psf_wing_fraction=0.3, psf_wing_sigma_px=36.4))
    assert renderer.render(allowed, seed=0).pixels.max() > 1000
