"""The discs of the Moon and the Sun, against direct integration in float64, earthshine, and bodies in truth."""

from dataclasses import replace

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.render.opengl import GLRenderer
from glstar.render.scene.bodies import BodySources, body_field, disc_sources, star_sigma_rad
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.solarsystem import Body
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import ScriptedFlight
from tests.scripts.random_moons import differences, random_trial
from tests.support.scenes import camera, sky_over_adelaide, stars_at

LENS = camera(64, 56, 3000.0)
SENSOR = Sensor(bit_depth=16)
POINTS_ACROSS = 200


def moon(*, radius_px: float, phase_deg: float, name: str = "Moon") -> Body:
    """Return a body at the zenith, on the optical axis of `LENS`, lit from the lower right."""
    phase_rad = np.deg2rad(phase_deg)
    across = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    return Body(
        name=name,
        direction_eq=np.array([0.0, 0.0, 1.0]),
        sun_direction_eq=np.sin(phase_rad) * across + np.cos(phase_rad) * np.array([0.0, 0.0, -1.0]),
        azimuth_rad=0.0,
        altitude_rad=np.pi / 2,
        apparent_altitude_rad=np.pi / 2,
        distance_km=384400.0,
        angular_radius_rad=radius_px / LENS.fx_px,
        phase_angle_rad=phase_rad,
        bright_limb_rad=None if name == "Sun" else 0.0,
        vmag=-2.0,
    )


def scene_of(body: Body, **turn: object) -> Scene:
    """Return a scene with one body and no other star."""
    scene = stars_at([[31.5, 27.5]], [30.0], sensor=SENSOR, lens=LENS, **turn)
    sigma_rad = SENSOR.effective_sigma_px / LENS.fx_px
    field = body_field((body,), scene.stars, sigma_rad, np.ones(1, dtype=np.bool_))
    radius_px = SENSOR.truncation_radius_px(SENSOR.peak_dn(field.camera_mag, scene.exposure.duration_s))
    drawn = DrawList(np.arange(len(field), dtype=np.int32), radius_px)
    return replace(scene, bodies=BodySources((body,), field, drawn))


def supersampled(body: Body, scene: Scene) -> np.ndarray:
    """Return the noiseless image of a disc of many points, normalised to a sum of 1."""
    along = (np.arange(POINTS_ACROSS) + 0.5) / POINTS_ACROSS * 2 - 1
    x, y = (grid.ravel() for grid in np.meshgrid(along, along))
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0.0))
    if body.name == "Sun":
        light = np.where(z > 0, 1 - 0.6 * (1 - z), 0.0)
    else:
        mu0 = np.maximum(x * np.sin(body.phase_angle_rad) + z * np.cos(body.phase_angle_rad), 0.0)
        light = np.where(z > 0, mu0 / np.maximum(mu0 + z, 1e-12), 0.0)
    x, y, light = x[light > 0], y[light > 0], light[light > 0]
    across, up = np.array([np.cos(0.6), np.sin(0.6), 0.0]), np.array([-np.sin(0.6), np.cos(0.6), 0.0])
    if body.name != "Sun":
        assert across @ body.sun_direction_eq >= 0
    radius_rad = body.angular_radius_rad
    directions = np.array([0.0, 0.0, 1.0]) + radius_rad * (x[:, np.newaxis] * across + y[:, np.newaxis] * up)
    image = np.zeros((LENS.height_px, LENS.width_px))
    sigma_px = SENSOR.effective_sigma_px
    for k in range(len(scene.trails)):
        xy = LENS.project(scene.trails.pointing[k : k + 1].to_camera(directions))[0]
        gx, gy = (
            np.exp(-0.5 * ((np.arange(size)[np.newaxis] - xy[:, [axis]]) / sigma_px) ** 2)
            for axis, size in enumerate((LENS.width_px, LENS.height_px))
        )
        image += (light[:, np.newaxis] * gy).T @ gx
    return image / image.sum()


@pytest.mark.parametrize(
    ("name", "radius_px", "phase_deg"),
    [("Moon", 17.5, 0.0), ("Moon", 17.5, 75.0), ("Moon", 17.5, 140.0), ("Moon", 4.3, 60.0), ("Sun", 12.0, 0.0)],
)
def test_a_disc_is_within_two_percent_of_a_supersampled_one(
    renderer: GLRenderer, name: str, radius_px: float, phase_deg: float
) -> None:
    body = moon(name=name, radius_px=radius_px, phase_deg=phase_deg)
    scene = scene_of(body, n=4)
    drawn = renderer.render(scene, seed=0, light=True).light_dn.astype(np.float64)
    expected = supersampled(body, scene)
    np.testing.assert_allclose(drawn.sum(), SENSOR.flux_of_magnitude_dn(-2.0, 0.5), rtol=2e-3)
    assert np.abs(drawn / drawn.sum() - expected).max() < 0.02 * expected.max()


def test_the_trail_of_a_disc_is_within_two_percent_of_a_supersampled_one(renderer: GLRenderer) -> None:
    body = moon(radius_px=9.0, phase_deg=60.0)
    scene = scene_of(body, n=16, turn=lambda u: (0.006 * u, 0.003 * u + 0.002 * u * u))
    drawn = renderer.render(scene, seed=0, light=True).light_dn.astype(np.float64)
    expected = supersampled(body, scene)
    assert np.abs(drawn / drawn.sum() - expected).max() < 0.02 * expected.max()


@pytest.mark.parametrize("seed", range(4))
def test_moons_of_any_phase_size_and_motion_are_within_a_percent_of_direct_integration(
    renderer: GLRenderer, seed: int
) -> None:
    pixel, light = differences(renderer, random_trial(seed))
    assert pixel < 0.01
    assert light < 0.001


@pytest.mark.parametrize("phase_deg", [0.0, 90.0, 143.0, 160.0, 175.0, 179.9])
@pytest.mark.parametrize("radius_px", [0.05, 0.5, 9.0, 30.0])
def test_a_disc_has_the_light_the_centroid_and_the_width_of_its_lit_part(radius_px: float, phase_deg: float) -> None:
    body = moon(radius_px=radius_px, phase_deg=phase_deg)
    directions, vmag = disc_sources(body, 1.2 / LENS.fx_px)
    light, of_light = 10 ** (-0.4 * vmag), moments_of_the_lit_part(np.deg2rad(phase_deg))
    np.testing.assert_allclose(light.sum(), 10 ** (0.4 * 2.0), rtol=1e-9)
    across, up = np.array([np.cos(0.6), np.sin(0.6), 0.0]), np.array([-np.sin(0.6), np.cos(0.6), 0.0])
    x, y = (directions[:, :2] / directions[:, 2:] @ axis[:2] / np.tan(radius_px / LENS.fx_px) for axis in (across, up))
    found = [np.average(values, weights=light) for values in (x, y, x * x, y * y)]
    np.testing.assert_allclose(found, of_light, rtol=0, atol=0.03 if radius_px < 1 else 2e-3)


def moments_of_the_lit_part(phase_rad: float) -> list[float]:
    """Return the means of x, y, x^2 and y^2 over the light of a disc of radius 1, by quadrature in longitude.

    Of Lommel and Seeliger's law the light of a longitude is the same at every latitude, but for its cosine's square.
    """
    longitude = np.linspace(phase_rad - np.pi / 2, np.pi / 2, 200_001)[1:-1]
    mu, mu0 = np.cos(longitude), np.cos(longitude - phase_rad)
    light = mu0 * mu / (mu0 + mu)
    sine, square = (np.average(np.sin(longitude) ** power, weights=light) for power in (1, 2))
    return [8 / (3 * np.pi) * sine, 0.0, 0.75 * square, 0.25]


def test_sources_are_as_close_as_the_image_is_large_where_a_body_crosses_it() -> None:
    wide = camera(2000, 2000, 600.0)
    off_axis_rad = np.deg2rad([[0.0, 50.0], [20.0, 49.0]])
    found = star_sigma_rad(wide, 1.2, off_axis_rad)
    np.testing.assert_allclose(found, 1.2 / 600 * np.cos(np.deg2rad([20.0, 50.0])) ** 2, rtol=1e-5)


def test_a_new_moon_is_drawn_in_the_light_of_the_earth(renderer: GLRenderer) -> None:
    """Beside the crescent the disc is as bright everywhere: 2.5 log(area) fainter per pixel than all of it."""
    body = replace(moon(radius_px=17.5, phase_deg=170.0), earthshine_vmag=-1.0)
    lit, dark = (
        renderer.render(scene_of(of, n=4), seed=0, light=True).light_dn.astype(np.float64)
        for of in (body, replace(body, earthshine_vmag=None))
    )
    flux_dn = SENSOR.flux_of_magnitude_dn(np.array([-2.0, -1.0]), 0.5)
    np.testing.assert_allclose([dark.sum(), lit.sum() - dark.sum()], flux_dn, rtol=2e-3)
    earthlit = (lit - dark)[27 - 8 : 29 + 8, 31 - 8 : 33 + 8]
    np.testing.assert_allclose(earthlit, flux_dn[1] / (np.pi * 17.5**2), rtol=5e-3)
    line = orjson.loads(
        frame_truth(scene_of(body, n=4), renderer.render(scene_of(body), seed=0), number=0, file="a.png")
    )
    (found,) = line["bodies"]
    assert (found["vmag"], found["earthshine_vmag"]) == (-2.0, -1.0)
    np.testing.assert_allclose(found["flux_dn"], flux_dn.sum(), rtol=1e-6)


def test_sources_of_a_disc_add_up_to_its_magnitude() -> None:
    for radius_px in (0.1, 1.0, 30.0, 400.0):
        directions, vmag = disc_sources(moon(radius_px=radius_px, phase_deg=90.0), 1.2 / LENS.fx_px)
        np.testing.assert_allclose(-2.5 * np.log10(np.sum(10 ** (-0.4 * vmag))), -2.0, rtol=0, atol=1e-9)
        assert len(vmag) < 4.2 * (1 + radius_px / 1.2) ** 2
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=0, atol=1e-12)


def test_a_disc_whose_image_would_show_its_sources_is_refused() -> None:
    sigma_rad = 1.2 / LENS.fx_px
    assert len(disc_sources(moon(radius_px=480 * 1.2, phase_deg=60.0), sigma_rad)[1]) > 7e5
    with pytest.raises(
        ConfigError, match=r"^sky\.bodies: the disc of the Moon is 1200 sigma wide, of at most 980; give"
    ):
        disc_sources(moon(radius_px=600 * 1.2, phase_deg=60.0), sigma_rad)


def towards_jupiter(*, bodies: bool) -> Scene:
    """Return the sky over Adelaide on 2024-03-10 towards Jupiter, low in the north-west."""
    simulator = sky_over_adelaide(camera(), mount=Mount(0.0, np.deg2rad(10), np.deg2rad(296)))
    return replace(simulator, bodies=bodies).scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))


def test_planets_are_bodies_in_truth_and_never_stars(renderer: GLRenderer) -> None:
    lit, dark = (towards_jupiter(bodies=bodies) for bodies in (True, False))
    frame, without = (renderer.render(scene, seed=3) for scene in (lit, dark))
    truth, plain = (
        orjson.loads(frame_truth(scene, image, number=0, file="a.png"))
        for scene, image in ((lit, frame), (dark, without))
    )
    assert "bodies" not in plain
    assert truth["stars"] == plain["stars"]
    jupiter = {body["name"]: body for body in truth["bodies"]}["Jupiter"]
    column, row = round(jupiter["x_px"]), round(jupiter["y_px"])
    window = np.s_[row - 2 : row + 3, column - 2 : column + 3]
    assert jupiter["saturated"]
    assert frame.pixels[window].max() == 255
    assert without.pixels[window].max() < 100
    assert jupiter["in_frame"] == 1.0
    np.testing.assert_allclose(jupiter["diameter_px"], 35.5 / 206265 * 300, rtol=0.1)


def test_the_limb_and_the_size_of_the_moon_are_in_truth(renderer: GLRenderer) -> None:
    body = moon(radius_px=9.0, phase_deg=60.0)
    scene = scene_of(body, n=4)
    line = orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a.png"))
    (found,) = line["bodies"]
    np.testing.assert_allclose(found["bright_limb_deg"], np.rad2deg(0.6), rtol=0, atol=0.01)
    np.testing.assert_allclose(found["diameter_px"], 18.0, rtol=1e-4)
    np.testing.assert_allclose([found["x_px"], found["centroid_x_px"]], 31.5, rtol=0, atol=1e-5)
    assert [star["star_id"] for star in line["stars"]] == [1]


def test_the_limb_of_the_moon_behind_a_rolling_shutter_is_that_of_its_row(renderer: GLRenderer) -> None:
    """A spin of 60 deg/s under a half Moon near the zenith turns the limb by 2.5 deg in twice the offset of its row."""
    begin_s, site = parse_utc("2024-03-18T10:37:30Z"), Site(*np.deg2rad([28.0, 120.0]))
    flight = ScriptedFlight.steady(site, begin_s, duration_s=4.0, yaw_rate_rad_per_s=np.deg2rad(60.0)).flight()
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(1.0))
    upwards = Simulator.of(flight, sky, camera(640, 480, 600.0), Mount(0.0, np.pi / 2, 0.0), SENSOR)

    def truth_of_moon(exposure: Exposure) -> dict[str, float]:
        scene = replace(upwards, bodies=True).scene(exposure)
        line = orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a.png"))
        return {body["name"]: body for body in line["bodies"]}["Moon"]

    rolling = Exposure(begin_s + 1.0, 0.02, readout_s=0.5)
    found = truth_of_moon(rolling)
    middle_s = rolling.mid_utc_s + found["mid_offset_s"]
    expected = truth_of_moon(Exposure(middle_s - 1e-4, 2e-4))

    assert abs(found["mid_offset_s"]) > 0.02
    for name, tolerance in (("bright_limb_deg", 1e-3), ("diameter_px", 1e-4), ("x_px", 1e-3), ("y_px", 1e-3)):
        assert found[name] == pytest.approx(expected[name], rel=0, abs=tolerance)
