"""The texture, the truth and the options of the natural sky, against the brightness of the sky in each direction."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.effects.lensflare import flare_dn
from glstar.render.effects.naturalsky import NATURAL_SKY, natural_sky_dn, sky_radiance_at
from glstar.render.effects.sky import FINE_GRID, SMOOTH_GRID, node_positions
from glstar.render.scene.scene import Scene
from glstar.sky.air.clouds import CloudLights, SheetCrossing, cloud_from_above, cloud_from_below
from glstar.sky.air.extinction import Extinction
from glstar.sky.air.skybrightness import SkyLights, SkyState, SkyView, beyond_the_air_s10, sky_radiance
from glstar.sky.place.apparent import right_ascension_declination
from glstar.sky.place.horizon import C_ned_eq, HorizonProfile, ned_to_azimuth_altitude_rad
from glstar.sky.place.timescale import parse_utc
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide

LENS = Camera(64, 48, 70.0, 50.0, 30.0, 25.5)
AIR = Extinction(aerosol_mag=0.2)
# The Sun is 8 deg below the horizon; then 25 deg, and the Moon 25 deg above it.
DUSK_UTC_S = parse_utc("2024-03-18T09:30:00Z")
MOONLIT_UTC_S = parse_utc("2024-03-18T11:00:00Z")
TOWN = {"town_mag_arcsec2": 18.0, "town_azimuth_deg": 70.0, "zenith_mag_arcsec2": 20.9, "ground_fraction": 0.3}
LIGHTS = SkyLights(20.9, town_mag_arcsec2=18.0, town_azimuth_rad=np.deg2rad(70.0), ground_fraction=0.3)
ALL_AROUND = np.array([[np.cos(a), np.sin(a)] for a in np.deg2rad(15.0 * np.arange(24))])


def scene_of(
    lens: Camera = LENS, *, pitch_deg: float = 20.0, turn_rad_per_s: float = 0.5, utc_s: float = MOONLIT_UTC_S,
    air: Extinction | None = AIR, bit_depth: int = 16, others: dict[str, float] | None = None, **keys: object,
) -> Scene:  # fmt: skip
    effects = {"sky.brightness": "natural"} | {f"sky.{key}": value for key, value in keys.items()} | (others or {})
    sensor = Sensor(bit_depth=bit_depth, reference_peak_dn=2e3, effects=effects)
    mount = Mount(0.3, np.deg2rad(pitch_deg), 0.2)
    base = sky_over_adelaide(
        lens,
        sensor=sensor,
        mount=mount,
        yaw_rad=1.1,
        vmag_limit=2.0,
        yaw_rate_rad_per_s=turn_rad_per_s,
        roll_rate_rad_per_s=0.1 * turn_rad_per_s,
    )
    base = replace(base, extinction=air, flight=base.flight.shifted(utc_s - NIGHT_UTC_S))
    return base.scene(Exposure(utc_s + 2.0, 0.4))


def horizontal(scene: Scene, time: int, direction_eq: np.ndarray) -> np.ndarray:
    """Return directions north, east, down: the zenith's right ascension is the sidereal time."""
    sidereal_rad, latitude_rad = right_ascension_declination(scene.shutter.zenith_eq[time])
    return direction_eq @ C_ned_eq(float(latitude_rad), float(sidereal_rad)).T


def separation_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.linalg.norm(one - other / np.linalg.norm(other), axis=-1) / 2)


def radiance(
    scene: Scene, time: int, direction_eq: np.ndarray, lights: SkyLights = LIGHTS, air: Extinction = AIR
) -> np.ndarray:
    sun, moon = scene.observed_bodies(("Sun", "Moon"))
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(horizontal(scene, time, direction_eq))
    separations = (separation_rad(direction_eq, body.direction_eq) for body in (moon, sun))
    state = SkyState(air, 50.0, sun.altitude_rad, moon.apparent_altitude_rad, moon.phase_angle_rad)
    return sky_radiance(SkyView(np.sin(altitude_rad), azimuth_rad, *separations), lights, state)


def ring(scene: Scene, time: int, sine: float) -> np.ndarray:
    """Return directions all around at the sine of an altitude, with azimuths from north."""
    ned = np.column_stack([np.sqrt(1 - sine**2) * ALL_AROUND, np.full(24, -sine)])
    sidereal_rad, latitude_rad = right_ascension_declination(scene.shutter.zenith_eq[time])
    return ned @ C_ned_eq(float(latitude_rad), float(sidereal_rad))


def per_radiance(scene: Scene, rays: np.ndarray) -> np.ndarray:
    """Return the signal of a pixel of a pinhole, DN over the flux per square arcsecond."""
    arcsec2 = rays[..., 2] ** 3 / (70.0 * 50.0) * 206264.806247**2
    return arcsec2 * float(scene.sensor.flux_of_magnitude_dn(0.0, 0.4))


def texels_of(scene: Scene, number: int = 0) -> np.ndarray:
    texels = NATURAL_SKY.textures[number].texels(NATURAL_SKY.values(scene.sensor), scene)
    assert texels.dtype == np.float32
    return texels


@pytest.mark.parametrize("utc_s", [DUSK_UTC_S, MOONLIT_UTC_S])
def test_the_sky_has_the_brightness_of_its_directions_over_the_exposure(utc_s: float) -> None:
    scene = scene_of(utc_s=utc_s, **TOWN)
    rays = LENS.unit_vectors(node_positions(LENS, SMOOTH_GRID))
    sky, ground = np.zeros((2, *rays.shape[:2]))
    for time, weight in enumerate((1, 4, 1)):
        direction = rays @ scene.shutter.C_camera_eq[time]
        sky += weight / 6 * radiance(scene, time, direction)
        ground += weight / 6 * 0.3 * radiance(scene, time, ring(scene, time, 0.0)).mean()
    texels = texels_of(scene)
    assert texels.shape == (73, 97, 4)
    per_pixel = per_radiance(scene, rays)
    np.testing.assert_allclose(texels[..., 0], per_pixel * sky, rtol=2e-3)
    np.testing.assert_allclose(texels[..., 1], per_pixel * ground, rtol=5e-3)
    up = -horizontal(scene, 1, rays @ scene.shutter.C_camera_eq[1])[..., 2]
    np.testing.assert_allclose(texels[..., 2], up, rtol=0, atol=1e-6)
    assert up.min() < -0.05 < 0.3 < up.max()
    assert not texels[..., 3].any()
    # In the middle of the exposure, on the optical axis.
    axis = radiance(scene, 1, scene.shutter.boresight_eq[1])
    dn = float(axis) * float(per_radiance(scene, np.array([0.0, 0.0, 1.0])))
    assert natural_sky_dn(scene) == pytest.approx(dn, rel=1e-4)
    flat = replace(scene, sensor=replace(scene.sensor, effects={}))
    assert natural_sky_dn(flat) == 0.0
    down = scene_of(pitch_deg=-30.0, **TOWN)
    ground_dn = 0.3 * radiance(down, 1, ring(down, 1, 0.0)).mean() * float(per_radiance(down, np.array([0.0, 0, 1])))
    assert natural_sky_dn(down) == pytest.approx(ground_dn, rel=1e-3)


@pytest.mark.parametrize("turn_deg", [0.48, 0.52])
def test_a_camera_that_turns_by_half_a_degree_blurs_the_sky(turn_deg: float) -> None:
    scene = scene_of(pitch_deg=50.0, turn_rad_per_s=0.0, **TOWN)
    pointing = scene.shutter
    turn = np.deg2rad(turn_deg) / 2
    C = pointing.C_camera_eq.copy()
    for time, angle in ((0, turn), (2, -turn)):
        C[time] = np.array(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        ) @ C[1]  # fmt: skip
    # Of a sky that changes only from start to end.
    night = replace(scene, shutter=replace(pointing, C_camera_eq=C, zenith_eq=pointing.zenith_eq[[0, 1, 0]]))
    blurred = texels_of(night)[..., 0] != texels_of(scene)[..., 0]
    assert blurred.any() == (turn_deg > 0.5)


def test_space_light_comes_with_less_airglow() -> None:
    k = AIR.zenith_mag(50.0)
    s10 = 10 ** (-0.4 * 27.7815)
    for keys, usual_s10 in (
        ({"zodiacal_light": True}, 60.0), ({"galaxy": True}, 15.0), ({"zodiacal_light": True, "galaxy": True}, 75.0),
    ):  # fmt: skip
        scene = scene_of(**TOWN, **keys)
        direction = LENS.unit_vectors(np.array([[3.0, 2.0], [60.0, 4.0]])) @ scene.shutter.C_camera_eq[1]
        up = -horizontal(scene, 1, direction)[:, 2]
        through = 10 ** (-0.4 * 0.75 * k / (up + 0.025 * np.exp(-11 * up)))
        sun = scene.observed_bodies(("Sun",))[0].direction_eq
        to_icrs = scene.stars.C_eq_icrs
        chosen = {"zodiacal": "zodiacal_light" in keys, "galaxy": "galaxy" in keys}
        beyond = beyond_the_air_s10(direction @ to_icrs, sun @ to_icrs, **chosen, drawn_mag=2.0)
        dark = 10 ** (-0.4 * 20.9) - usual_s10 * 10 ** (-0.4 * 0.75 * k) * s10
        lights = replace(LIGHTS, zenith_mag_arcsec2=-2.5 * np.log10(dark))
        expected = radiance(scene, 1, direction, lights) + beyond * through * s10
        found = sky_radiance_at(NATURAL_SKY.values(scene.sensor), scene, 1, direction)
        np.testing.assert_allclose(found, expected, rtol=1e-4)
    # Airglow is at least 30 % of the dark sky.
    scene = scene_of(zodiacal_light=True, galaxy=True, zenith_mag_arcsec2=23.3, twilight=False, moonlight=False)
    beyond = beyond_the_air_s10(direction @ to_icrs, sun @ to_icrs, zodiacal=True, galaxy=True, drawn_mag=2.0)
    dark = SkyLights(23.3 - 2.5 * np.log10(0.3), moonlight=False, twilight=False)
    found = sky_radiance_at(NATURAL_SKY.values(scene.sensor), scene, 1, direction)
    np.testing.assert_allclose(found, radiance(scene, 1, direction, dark) + beyond * through * s10, rtol=1e-3)


@pytest.mark.parametrize(
    ("catalogue", "faintest", "drawn"),
    [("bsc5", 5.1, 5.1), ("bsc5", 8.0, 6.5), ("hipparcos", 12.0, 7.5), ("gaia", 12.0, 10.0), ("tycho2", 12.0, 11.0),
     ("other", 12.0, 12.0)],
)  # fmt: skip
def test_the_galaxy_lacks_the_stars_that_a_catalogue_has_completely(
    catalogue: str, faintest: float, drawn: float
) -> None:
    scene = scene_of(galaxy=True)
    vmag = np.linspace(1.0, faintest, len(scene.stars))
    scene = replace(scene, stars=replace(scene.stars, catalogue=catalogue, vmag=vmag))
    of_texture = NATURAL_SKY.textures[0].depends_on(NATURAL_SKY.values(scene.sensor), scene)
    assert drawn in of_texture
    assert faintest == drawn or faintest not in of_texture
    values = NATURAL_SKY.values(scene.sensor) | {"galaxy": False}
    assert drawn not in NATURAL_SKY.textures[0].depends_on(values, scene)


def test_a_sky_without_extinction_is_that_of_usual_air() -> None:
    scene = scene_of(air=None, town_azimuth_deg=0.0, **{k: TOWN[k] for k in ("town_mag_arcsec2", "ground_fraction")})
    direction = LENS.unit_vectors(np.array([[3.0, 2.0], [60.0, 4.0]])) @ scene.shutter.C_camera_eq[1]
    found = sky_radiance_at(NATURAL_SKY.values(scene.sensor), scene, 1, direction)
    north = SkyLights(town_mag_arcsec2=18.0, town_azimuth_rad=0.0)
    np.testing.assert_allclose(found, radiance(scene, 1, direction, north, Extinction()), rtol=1e-4)
    around = scene_of(air=None, town_azimuth_deg=-0.5, town_mag_arcsec2=18.0)
    found = sky_radiance_at(NATURAL_SKY.values(around.sensor), around, 1, direction)
    everywhere = SkyLights(town_mag_arcsec2=18.0)
    np.testing.assert_allclose(found, radiance(scene, 1, direction, everywhere, Extinction()), rtol=1e-4)
    with pytest.raises(RenderError, match="needs a scene of a simulator, which knows where the Sun is"):
        sky_radiance_at(NATURAL_SKY.values(scene.sensor), replace(scene, observing_sky=None), 1, direction)


@pytest.mark.parametrize(
    ("height_m", "town", "moonlight"),
    [(4000.0, TOWN, True), (4000.0, {}, True), (4000.0, TOWN, False), (20.0, TOWN, True)],
)
def test_cloud_without_gaps_is_lit_from_all_sides(height_m: float, town: dict[str, float], moonlight: bool) -> None:
    sheet = {"cloud.coverage": 1.0, "cloud.edge": 0.01, "cloud.optical_depth": 0.7, "cloud.height_m": height_m}
    pitch_deg = 40.0 if height_m > 50 else 0.0
    scene = scene_of(pitch_deg=pitch_deg, turn_rad_per_s=0.0, others=sheet, moonlight=moonlight, **town)
    lights = replace(LIGHTS if town else SkyLights(), moonlight=moonlight)
    texels = texels_of(scene)
    assert texels.shape == (145, 193, 4)
    rays = LENS.unit_vectors(node_positions(LENS, FINE_GRID))
    direction = rays @ scene.shutter.C_camera_eq[1]
    up = -horizontal(scene, 1, direction)[..., 2]
    dark = replace(lights, town_mag_arcsec2=30.0)
    moon = scene.observed_bodies(("Moon",))[0]
    sine_moon = np.sin(moon.apparent_altitude_rad)
    moon_mag = moon.vmag + AIR.zenith_mag(50.0) / (sine_moon + 0.025 * np.exp(-11 * sine_moon))
    mean_sky = radiance(scene, 1, ring(scene, 1, 0.5), dark).mean()
    of_cloud = CloudLights(10 ** (-0.4 * moon_mag) if moonlight else 0.0, float(sine_moon), float(mean_sky))
    impact = np.sqrt(1 - up**2) * (6371008.8 + 50.0) / (6371008.8 + height_m)
    crossing = SheetCrossing(np.full_like(up, 0.7), 1 / np.sqrt(np.maximum(1 - impact**2, 1e-9)))
    ground = lights.ground_fraction * radiance(scene, 1, ring(scene, 1, 0.0), lights).mean()
    sky, below = radiance(scene, 1, direction, dark), np.full_like(up, ground)
    glow = radiance(scene, 1, direction, lights) - sky
    if height_m > 50:
        sky = cloud_from_below(crossing, np.cos(separation_rad(direction, moon.direction_eq)), sky, glow, of_cloud)
    else:
        sky, below = sky + glow, cloud_from_above(crossing, float(ground), of_cloud)
    seen, lower = up > 0.05, up < -0.05
    per_pixel = per_radiance(scene, rays)
    np.testing.assert_allclose(texels[seen, 0], (per_pixel * sky)[seen], rtol=5e-3)
    assert lower.any() == (height_m < 50)
    np.testing.assert_allclose(texels[lower, 1], (per_pixel * below)[lower], rtol=5e-3)


def test_flare_is_added_at_the_nodes() -> None:
    lamp = {
        "flare.scatter": 0.02,
        "flare.lamp_mag": -12.0,
        "flare.lamp_azimuth_deg": 70.0,
        "flare.lamp_altitude_deg": 30,
    }
    scene = scene_of(pitch_deg=50.0, others=lamp, **TOWN)
    texels = texels_of(scene)
    assert texels.shape == (145, 193, 4)
    np.testing.assert_allclose(texels[..., 3], flare_dn(scene, node_positions(LENS, FINE_GRID)), rtol=1e-6)
    plain = texels_of(scene_of(pitch_deg=50.0, **TOWN))
    np.testing.assert_allclose(texels[::2, ::2, :3], plain[..., :3], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(texels[1::2, ::2, 0] * 2, texels[:-1:2, ::2, 0] + texels[2::2, ::2, 0], rtol=2e-3)


@pytest.mark.parametrize(("width_px", "halvings"), [(1152, 0), (1153, 1), (2304, 1), (2305, 2)])
def test_a_ridge_has_nodes_at_most_twelve_pixels_from_each_other(width_px: int, halvings: int) -> None:
    lens = Camera(width_px, 48, 900.0, 900.0, width_px / 2, 25.5)
    scene = scene_of(lens, turn_rad_per_s=0.0)
    profile = HorizonProfile((0.1, 2.0, 4.0), (0.05, 0.1, 0.02))
    ridge = replace(scene, shutter=replace(scene.shutter, profile=profile))
    coarse, fine = texels_of(scene), texels_of(ridge)
    step = 2**halvings
    assert fine.shape == (72 * step + 1, 96 * step + 1, 4)
    np.testing.assert_allclose(fine[::step, ::step, 0], coarse[..., 0], rtol=1e-4)
    rays = lens.unit_vectors(node_positions(lens, (96 * step + 1, 72 * step + 1)))
    ned = horizontal(scene, 1, rays @ scene.shutter.C_camera_eq[1])
    azimuth_rad = np.arctan2(ned[..., 1], ned[..., 0])
    above = -ned[..., 2] - np.sin(profile.altitude_rad(azimuth_rad))
    np.testing.assert_allclose(fine[..., 2], above, rtol=0, atol=1e-5)
    assert NATURAL_SKY.options(NATURAL_SKY.values(scene.sensor), ridge)["SKY_SPAN_PX"] == 0


FLARE = {"flare.scatter": 0.02, "flare.lamp_mag": -12.0, "flare.lamp_altitude_deg": 40.0}


@pytest.mark.parametrize(
    ("width_px", "bit_depth", "pitch_deg", "others", "options"),
    [
        (3071, 8, 60.0, FLARE, (1, 4)),
        (3072, 8, 60.0, FLARE, (0, 16)),
        (3072, 9, 60.0, FLARE, (0, 8)),
        (3071, 8, 0.0, FLARE, (1, 0)),
        (3072, 8, 0.0, FLARE, (0, 0)),
        (3071, 8, 60.0, {}, (0, 0)),
        (64, 16, 60.0, {"cloud.coverage": 0.5}, (1, 4)),
    ],
)
def test_spans_are_as_wide_as_fragments_and_ground_has_none(
    width_px: int, bit_depth: int, pitch_deg: float, others: dict[str, float], options: tuple[int, int]
) -> None:
    lens = Camera(width_px, 48, 1.5 * width_px, 1.5 * width_px, width_px / 2, 25.5)
    scene = scene_of(lens, pitch_deg=pitch_deg, bit_depth=bit_depth, others=others)
    found = NATURAL_SKY.options(NATURAL_SKY.values(scene.sensor), scene)
    assert found == {"SKY_BY_QUADS": options[0], "SKY_SPAN_PX": options[1]}


def test_spans_have_the_sky_at_their_first_columns() -> None:
    lens = Camera(62, 48, 90.0, 80.0, 30.0, 25.5)
    scene = scene_of(lens, pitch_deg=60.0, others=FLARE, **TOWN)
    nodes, spans = texels_of(scene), texels_of(scene, 1)
    assert [texture.sampler for texture in NATURAL_SKY.textures] == ["sky_signal", "sky_of_spans"]
    assert spans.shape == (145, 16, 4)
    at = np.linspace(-0.5, 61.5, 193)
    for row in (0, 70, 144):
        for component, first in ((0, 0), (3, 2)):
            line = nodes[row, :, component].astype(float)
            begins = np.interp(np.arange(0, 62, 4), at, line)
            np.testing.assert_allclose(spans[row, :, first], begins, rtol=1e-5)
            # The last span goes on as a line to its end at the border of the image.
            ends = np.append(np.interp(np.arange(4, 62, 4), at, line), begins[-1] + 4 / 1.5 * (line[-1] - begins[-1]))
            np.testing.assert_allclose(spans[row, :, first + 1], ends, rtol=1e-4)


def test_nodes_beyond_a_lens_have_the_solid_angle_near_its_limit() -> None:
    limit_rad = np.deg2rad(40.0)
    lens = Camera(160, 48, 90.0, 80.0, 70.0, 25.5, 0.0, Lens("fisheye", (), limit_rad))
    scene = scene_of(lens, pitch_deg=60.0, turn_rad_per_s=0.0, twilight=False, moonlight=False)
    positions = node_positions(lens, SMOOTH_GRID)
    x, y = (positions[..., 0] - 70.0) / 90.0, (positions[..., 1] - 25.5) / 80.0
    theta = np.hypot(x, y)
    beyond = theta > limit_rad + 0.5 / 80.0
    inside = theta < limit_rad - 0.5 / 80.0
    assert beyond.any()
    bounded = np.where(beyond, 0.99 * limit_rad, theta)
    arcsec2 = np.sin(bounded) / bounded / (90.0 * 80.0) * 206264.806247**2
    direction = np.minimum(theta, limit_rad)
    rays = np.stack([np.sin(direction) * x / theta, np.sin(direction) * y / theta, np.cos(direction)], axis=-1)
    sky = radiance(scene, 1, rays @ scene.shutter.C_camera_eq[1], SkyLights(moonlight=False, twilight=False))
    expected = arcsec2 * sky * float(scene.sensor.flux_of_magnitude_dn(0.0, 0.4))
    known = inside | beyond
    np.testing.assert_allclose(texels_of(scene)[known, 0], expected[known], rtol=1e-3)


def test_truth_has_sun_moon_and_the_sky_on_the_axis() -> None:
    scene = scene_of(pitch_deg=35.0, **TOWN)
    sun, moon = scene.observed_bodies(("Sun", "Moon"))
    axis = scene.shutter.boresight_eq[1]
    truth = NATURAL_SKY.truth(NATURAL_SKY.values(scene.sensor), scene)
    assert json.loads(json.dumps(truth)) == truth
    expected = {
        "sky_mag_arcsec2": -2.5 * np.log10(float(radiance(scene, 1, axis))),
        "sun_altitude_deg": np.rad2deg(sun.altitude_rad),
        "moon_altitude_deg": np.rad2deg(moon.apparent_altitude_rad),
        "moon_separation_deg": np.rad2deg(float(separation_rad(axis, moon.direction_eq))),
        "moon_illuminated_fraction": (1 + np.cos(moon.phase_angle_rad)) / 2,
    }
    assert truth == {key: pytest.approx(number, rel=0, abs=6e-5) for key, number in expected.items()}
    assert all(round(number, 4) == number != round(number, 3) for number in truth.values())


def test_a_texture_is_computed_again_if_the_sky_changes() -> None:
    scene = scene_of(**TOWN)
    values = NATURAL_SKY.values(scene.sensor)
    depends_on: Callable[..., object] = NATURAL_SKY.textures[0].depends_on
    before = depends_on(values, scene)
    assert depends_on(NATURAL_SKY.values(scene.sensor), scene_of(**TOWN)) == before
    changed = (
        replace(scene, exposure=replace(scene.exposure, start_utc_s=MOONLIT_UTC_S + 1.9, duration_s=0.6)),
        replace(scene, site=replace(scene.site, height_m=51.0)),
        replace(scene, extinction=Extinction()),
        replace(scene, camera=replace(LENS, fx_px=71.0)),
        replace(scene, sensor=replace(scene.sensor, reference_peak_dn=3e3)),
        replace(scene, sensor=replace(scene.sensor, effects=scene.sensor.effects | {"flare.scatter": 0.01})),
        replace(scene, shutter=replace(scene.shutter, sine_horizon=-0.01)),
    )
    assert len({before, *(depends_on(values, other) for other in changed)}) == 8
    assert depends_on(values | {"twilight": False}, scene) != before
    assert NATURAL_SKY.textures[1].depends_on is NATURAL_SKY.textures[0].depends_on
    assert [NATURAL_SKY.is_active({"brightness": b}) for b in ("flat", "natural")] == [False, True]
