"""Flare at single pixels against the laws of its parts, and when a source leaves none."""

import json
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.effects.lensflare import FLARE, flare_at_nodes, flare_dn, has_flare
from glstar.render.effects.sky import FINE_GRID, node_positions
from glstar.render.scene.scene import Scene
from glstar.rotation import matrix_from_quaternion
from glstar.sky.air.extinction import Extinction
from glstar.sky.place.horizon import ned_direction
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide

LENS = Camera(64, 48, 70.0, 50.0, 30.0, 25.5)
PIXELS = np.stack(np.meshgrid(np.arange(-40.0, 100.0, 3.0), np.arange(-30.0, 80.0, 2.0)), axis=-1)
LAMP = {"lamp_mag": -9.0, "lamp_azimuth_deg": 140.0, "lamp_altitude_deg": 75.0}
MOUNT = Mount(0.3, np.deg2rad(70.0), 0.2)


def scene_of(
    lens: Camera = LENS, *, utc_s: float = NIGHT_UTC_S, air: Extinction | None = None, cloud_depth: float = 0.0,
    **keys: float,
) -> Scene:  # fmt: skip
    """Return a scene of a camera that turns by 11 deg during its exposure, below a cloud without gaps or none."""
    effects = {f"flare.{key}": value for key, value in keys.items()}
    effects |= {"cloud.coverage": 1.0, "cloud.edge": 0.01, "cloud.optical_depth": cloud_depth}
    sensor = Sensor(reference_peak_dn=3e3, effects=effects)
    base = sky_over_adelaide(
        lens, sensor=sensor, mount=MOUNT, refraction=False, yaw_rad=1.1, vmag_limit=2.0, yaw_rate_rad_per_s=0.5
    )
    base = replace(base, extinction=air, flight=base.flight.shifted(utc_s - NIGHT_UTC_S))
    return base.scene(Exposure(utc_s + 2.0, 0.4))


def lamp_of(scene: Scene, *, azimuth_deg: float = 140.0, altitude_deg: float = 75.0) -> np.ndarray:
    """Return the direction of a lamp in the camera frame, through the attitude of the aircraft."""
    to_camera = scene.C_camera_body @ matrix_from_quaternion(scene.q_body_ned)
    return to_camera @ ned_direction(np.deg2rad(azimuth_deg), np.deg2rad(altitude_deg))


def entering_dn(scene: Scene, lamp: np.ndarray, mag: float = -9.0) -> float:
    return float(scene.sensor.flux_of_magnitude_dn(mag, 0.4)) * lamp[2]


def pixel_of(lamp: np.ndarray) -> np.ndarray:
    return np.array([30.0 + 70.0 * lamp[0] / lamp[2], 25.5 + 50.0 * lamp[1] / lamp[2]])


def test_scattered_light_follows_harvey_and_shack_at_each_pixel() -> None:
    scene = scene_of(scatter=0.03, scatter_deg=4.0, **LAMP)
    lamp = lamp_of(scene)
    x, y = (PIXELS[..., 0] - 30.0) / 70.0, (PIXELS[..., 1] - 25.5) / 50.0
    along = 1 / np.sqrt(1 + x * x + y * y)  # cosine of the angle from the axis
    cosine = (lamp[0] * x + lamp[1] * y + lamp[2]) * along
    shoulder = np.sin(np.deg2rad(4.0))
    # 1 / (1 + (sine / shoulder)^2), normalised over the hemisphere, times the projected solid angle of the pixel.
    normal = np.pi * shoulder**2 * np.log(1 + 1 / shoulder**2)
    law = 1 / (1 + np.where(cosine > 0, 1 - cosine**2, 1.0) / shoulder**2) / normal
    expected = 0.03 * entering_dn(scene, lamp) * law * along**4 / (70.0 * 50.0)
    found = flare_dn(scene, PIXELS)
    np.testing.assert_allclose(found, expected, rtol=2e-3)
    np.testing.assert_allclose(flare_dn(scene, PIXELS[3]), found[3], rtol=1e-12)


def test_scattered_light_behind_a_lens_has_its_solid_angles() -> None:
    lens = Camera(64, 48, 30.0, 24.0, 30.0, 25.5, 0.0, Lens("fisheye", (), np.deg2rad(70.0)))
    scene = scene_of(lens, scatter=0.03, scatter_deg=4.0, **LAMP)
    lamp = lamp_of(scene)
    x, y = (PIXELS[..., 0] - 30.0) / 30.0, (PIXELS[..., 1] - 25.5) / 24.0
    theta = np.hypot(x, y)
    across = np.sin(theta) / theta
    cosine = lamp[0] * x * across + lamp[1] * y * across + lamp[2] * np.cos(theta)
    shoulder = np.sin(np.deg2rad(4.0))
    law = 1 / (1 + np.where(cosine > 0, 1 - cosine**2, 1.0) / shoulder**2)
    law /= np.pi * shoulder**2 * np.log(1 + 1 / shoulder**2)
    # An equidistant lens: the solid angle is sin theta / theta over that on the axis; nothing beyond its limit.
    expected = 0.03 * entering_dn(scene, lamp) * law * across * np.cos(theta) / (30.0 * 24.0)
    found = flare_dn(scene, PIXELS)
    seen = theta < np.deg2rad(69.0)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=3e-3)
    assert not found[theta > np.deg2rad(71.0)].any()


def test_ghosts_are_soft_discs_on_the_line_through_source_and_axis() -> None:
    scene = scene_of(ghost_fraction=2e-3, ghosts=3, ghost_size=0.8, ghost_seed=5, **LAMP)
    lamp = lamp_of(scene)
    chance = np.random.default_rng(5)
    expected = np.zeros(PIXELS.shape[:2])
    for _ in range(3):
        place = -1.2 + 2.0 * chance.random()  # between 1.2 times the distance on the other side, and 0.8 on this one
        radius_px = (0.3 + 0.7 * chance.random()) * 0.8 * 24.0
        centre = [30.0, 25.5] + place * (pixel_of(lamp) - [30.0, 25.5])
        distance = np.hypot(*np.moveaxis(PIXELS - centre, -1, 0)) / radius_px
        # Its brightness falls along a line over 15 % of the radius; the flux is that of the integral over the disc.
        r = np.linspace(0, 1.1, 200_001)
        area = 2 * np.pi * np.trapezoid(r * np.clip((1.075 - r) / 0.15, 0, 1), r) * radius_px**2
        expected += 2e-3 * entering_dn(scene, lamp) * np.clip((1.075 - distance) / 0.15, 0, 1) / area
    found = flare_dn(scene, PIXELS)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4 * expected.max())
    assert np.count_nonzero(expected) > 100


def test_a_streak_is_lorentzian_along_and_gaussian_across() -> None:
    scene = scene_of(streak_fraction=4e-3, streak_deg=25.0, **LAMP)
    lamp = lamp_of(scene)
    x, y = np.moveaxis(PIXELS - pixel_of(lamp), -1, 0)
    along, across = (
        (x * np.cos(a) + y * np.sin(a)) / 48.0 for a in (np.deg2rad(25.0), np.deg2rad(115.0))
    )  # over the height of the image
    # Half of the maximum at 0.15 along and at 0.012 across.
    lorentzian = 0.15 / np.pi / (along**2 + 0.15**2) / 48.0
    sigma = 0.012 / np.sqrt(2 * np.log(2))
    gaussian = np.exp(-0.5 * (across / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma * 48.0)
    expected = 4e-3 * entering_dn(scene, lamp) * lorentzian * gaussian
    found = flare_dn(scene, PIXELS)
    near = np.abs(across) < 3 * sigma
    assert near.sum() > 20
    np.testing.assert_allclose(found[near], expected[near], rtol=0.02)
    assert not found[np.abs(across) > 8.2 * sigma].any()
    # Beyond 8 standard deviations it is cut off, with less than 1e-13 of its light.
    assert (found[np.abs(across) < 7.8 * sigma] > 0).all()


def test_the_parts_of_a_flare_add_up() -> None:
    parts = ({"scatter": 0.01}, {"ghost_fraction": 1e-3}, {"streak_fraction": 1e-3})
    each = [flare_dn(scene_of(**part, **LAMP), PIXELS) for part in parts]
    whole = flare_dn(scene_of(**parts[0], **parts[1], **parts[2], **LAMP), PIXELS)
    np.testing.assert_allclose(whole, sum(each), rtol=1e-9)
    assert all(one.max() > 0 for one in each)
    for part in parts:
        assert has_flare(scene_of(**part))
    none = scene_of(**LAMP)
    assert not has_flare(none)
    assert flare_dn(none, PIXELS).shape == PIXELS.shape[:2]
    assert not flare_dn(none, PIXELS).any()


def test_a_hood_and_a_faint_lamp_leave_no_flare() -> None:
    angle_deg = float(np.rad2deg(np.arccos(lamp_of(scene_of())[2])))
    assert 5 < angle_deg < 60
    for hood_deg, is_lit in ((angle_deg - 0.2, False), (angle_deg + 0.2, True)):
        assert flare_dn(scene_of(scatter=0.1, hood_deg=hood_deg, **LAMP), PIXELS).any() == is_lit
    # Behind the plane of the lens nothing enters, whatever the hood.
    behind = LAMP | {"lamp_altitude_deg": -75.0, "lamp_azimuth_deg": 320.0}
    assert not flare_dn(scene_of(scatter=0.1, **behind), PIXELS).any()
    # Left out below 1e-3 DN a pixel of the image.
    scene = scene_of(scatter=0.1)
    per_pixel = entering_dn(scene, lamp_of(scene), 0.0) / (64 * 48)
    for factor in (0.96, 1.04):
        mag = 2.5 * np.log10(per_pixel / (factor * 1e-3))
        assert flare_dn(scene_of(scatter=0.1, **LAMP | {"lamp_mag": mag}), PIXELS).any() == (factor > 1)
    # Of magnitude 30 it is none.
    bright = replace(scene.sensor, reference_vmag=3.0, reference_peak_dn=1e20, bit_depth=16)
    for mag, is_lit in ((30.0, False), (29.9, True)):
        effects = {f"flare.{key}": value for key, value in (LAMP | {"scatter": 0.1, "lamp_mag": mag}).items()}
        lit = replace(scene, sensor=replace(bright, effects=effects), observing_sky=None)
        assert flare_dn(lit, PIXELS).any() == is_lit


@pytest.mark.parametrize(("part", "is_lit"), [(0.97, True), (1.03, False)])
def test_ghosts_of_a_source_far_outside_the_image_are_left_out(part: float, is_lit: bool) -> None:
    # Farther from the axis than 1.5 half diagonals of the image.
    reach_px = part * 1.5 * np.hypot(64, 48) / 2
    scene = scene_of()
    up = lamp_of(scene, altitude_deg=90.0)
    to_ned = (scene.C_camera_body @ matrix_from_quaternion(scene.q_body_ned)).T
    ray = np.array([0.6 * reach_px / 70.0, 0.8 * reach_px / 50.0, 1.0])
    north, east, down = to_ned @ (ray / np.linalg.norm(ray))
    lamp = {
        "lamp_mag": -9.0,
        "lamp_azimuth_deg": float(np.rad2deg(np.arctan2(east, north))),
        "lamp_altitude_deg": float(np.rad2deg(np.arcsin(-down))),
    }
    assert up[2] > 0
    wide = np.stack(np.meshgrid(np.arange(-300.0, 300.0, 4.0), np.arange(-300.0, 300.0, 4.0)), axis=-1)
    assert flare_dn(scene_of(ghost_fraction=0.01, ghosts=20, ghost_size=2.0, **lamp), wide).any() == is_lit


@pytest.mark.parametrize(("air", "cloud_depth"), [(None, 0.0), (Extinction(aerosol_mag=0.3), 0.0), (None, 0.7)])
def test_the_moon_and_the_planets_flare_through_air_and_cloud(air: Extinction | None, cloud_depth: float) -> None:
    # 2024-03-18 10:30 UTC: Moon and Jupiter are up.
    scene = scene_of(utc_s=1710757800.0, air=air, cloud_depth=cloud_depth, scatter=0.02, scatter_deg=9.0)
    expected = np.zeros(PIXELS.shape[:2])
    rays = LENS.unit_vectors(PIXELS)
    shoulder = np.sin(np.deg2rad(9.0))
    names = []
    for body in scene.observed_bodies(("Sun", "Moon", "Venus", "Jupiter", "Mars")):
        if body.altitude_rad < 0 or body.name == "Mars":
            continue
        towards = scene.shutter[1:2].to_camera(body.direction_eq[np.newaxis])[0, 0]
        if towards[2] <= 0:
            continue
        names.append(body.name)
        mag = body.vmag
        if air is not None:
            sine = np.sin(body.apparent_altitude_rad)
            mag += air.zenith_mag(50.0) / (sine + 0.025 * np.exp(-11 * sine))
        # The impact parameter of the line of sight stays up to the sheet, 4 km up.
        sine_from_vertical = np.cos(body.apparent_altitude_rad) * (6371008.8 + 50.0) / (6371008.8 + 4000.0)
        mag += 2.5 * np.log10(np.e) * cloud_depth / np.sqrt(1 - sine_from_vertical**2)
        flux = float(scene.sensor.flux_of_magnitude_dn(mag, 0.4)) * towards[2]
        if flux < 1e-3 * 64 * 48:
            continue
        sine2 = 1 - np.minimum(rays @ towards, 1.0) ** 2
        law = 1 / (1 + np.where(rays @ towards > 0, sine2, 1.0) / shoulder**2)
        law /= np.pi * shoulder**2 * np.log(1 + 1 / shoulder**2)
        expected += 0.02 * flux * law * rays[..., 2] ** 4 / 3500.0
    assert {"Moon", "Jupiter"} >= set(names) >= {"Moon"}
    np.testing.assert_allclose(flare_dn(scene, PIXELS), expected, rtol=1e-3)


def test_a_texture_and_truth_have_the_flare_at_nodes() -> None:
    scene = scene_of(scatter=0.02, scatter_deg=9.0, **LAMP)
    positions = node_positions(LENS, FINE_GRID)
    at_nodes = flare_dn(scene, positions)
    np.testing.assert_allclose(flare_at_nodes(scene), at_nodes, rtol=1e-9)
    np.testing.assert_allclose(flare_at_nodes(scene, step=3), at_nodes[::3, ::3], rtol=1e-9)
    values = FLARE.values(scene.sensor)
    (texture,) = FLARE.textures
    assert (texture.sampler, texture.per_quad) == ("flare_signal", False)
    texels = texture.texels(values, scene)
    assert texels.dtype == np.float32
    np.testing.assert_allclose(texels[..., 0], at_nodes, rtol=1e-6)
    assert texels.shape == (145, 193, 4)
    assert not texels[..., 1:].any()
    truth = FLARE.truth(values, scene)
    coarse = at_nodes[::4, ::4]
    assert json.loads(json.dumps(truth)) == truth
    assert truth == {
        "flare_mean_dn": pytest.approx(coarse.mean(), rel=0, abs=5.1e-7),
        "flare_max_dn": pytest.approx(coarse.max(), rel=0, abs=5.1e-7),
    }
    assert all(round(number, 6) == number != round(number, 5) for number in truth.values())
    assert FLARE.uniforms(values, scene) == {}
    assert FLARE.options(values, scene) == {"FLARE_WITH_SKY": 0, "FLARE_BY_QUADS": 1}
    # Nodes are 16 px from each other in an image of 3072 columns.
    wide = replace(scene, camera=replace(LENS, width_px=3072))
    assert FLARE.options(values, wide) == {"FLARE_WITH_SKY": 0, "FLARE_BY_QUADS": 0}
    natural = replace(scene, sensor=replace(scene.sensor, effects={"sky.brightness": "natural"}))
    assert FLARE.options(values, natural) == {"FLARE_WITH_SKY": 1, "FLARE_BY_QUADS": 1}


def test_a_texture_is_computed_again_if_the_light_changes() -> None:
    (texture,) = FLARE.textures
    scene = scene_of(scatter=0.02, **LAMP)
    values = FLARE.values(scene.sensor)
    before = texture.depends_on(values, scene)
    assert texture.depends_on(values, scene_of(scatter=0.02, **LAMP)) == before
    longer = replace(scene, exposure=replace(scene.exposure, duration_s=0.8, start_utc_s=NIGHT_UTC_S + 1.8))
    others = (
        longer,
        replace(scene, camera=replace(LENS, fx_px=71.0)),
        replace(scene, extinction=Extinction()),
        replace(scene, site=replace(scene.site, height_m=51.0)),
        replace(scene, sensor=replace(scene.sensor, reference_peak_dn=2e3)),
    )
    assert len({before, *(texture.depends_on(values, other) for other in others)}) == 6
    assert texture.depends_on(values | {"scatter": 0.03}, scene) != before
