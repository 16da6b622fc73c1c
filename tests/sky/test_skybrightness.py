"""Sky brightness, against published numbers, and the image that it makes."""

import tomllib
from dataclasses import replace

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.render.effects.naturalsky import NATURAL_SKY, sky_radiance_at
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.air.extinction import Extinction
from glstar.sky.air.skybrightness import (
    SkyLights,
    SkyState,
    SkyView,
    light_name,
    moonlight_nl,
    nanolamberts_to_mag,
    sky_radiance,
    twilight_mag,
)
from glstar.sky.place.horizon import dip_rad
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.synthetic import ScriptedFlight
from tests.support.scenes import ADELAIDE, camera, sky_over_adelaide

NATURAL = {"sky.brightness": "natural"}


def mass(zenith_deg: float) -> float:
    return float((1 - 0.96 * np.sin(np.deg2rad(zenith_deg)) ** 2) ** -0.5)


def zenith(
    *, sun_altitude_deg: float = -40.0, moon_altitude_deg: float = -40.0, height_m: float = 0.0, **lights: object
) -> float:
    """Return V of the zenith."""
    state = SkyState(
        Extinction(), height_m, np.deg2rad(sun_altitude_deg), np.deg2rad(moon_altitude_deg), moon_phase_angle_rad=0.5
    )
    view = SkyView(
        np.array([1.0]),
        np.array([0.0]),
        np.array([np.deg2rad(90 - moon_altitude_deg)]),
        np.array([np.deg2rad(90 - sun_altitude_deg)]),
    )
    return float(-2.5 * np.log10(sky_radiance(view, SkyLights(**lights), state)[0]))


def test_the_worked_example_of_a_moonlit_sky() -> None:
    # z 20, Moon z 70, separation 50, phase angle 45 deg, k 0.15: 19.855 by specsim's krisciunas_schaefer.
    light = moonlight_nl(np.deg2rad(50), mass(70), mass(20), np.deg2rad(45), 0.15)
    np.testing.assert_allclose(nanolamberts_to_mag(light), 19.855, rtol=0, atol=0.005)


def test_moonlight_is_continuous_towards_the_moon() -> None:
    separation_deg = np.linspace(1.0, 40.0, 4001)
    light = moonlight_nl(np.deg2rad(separation_deg), mass(60), mass(60), 0.3, 0.17)
    assert np.abs(np.diff(np.log(light))).max() < 0.02


@pytest.mark.parametrize(
    ("zenith_distance_deg", "mag"), [(95, 11.84), (98, 15.881), (100, 18.005), (104, 20.885), (105, 21.32)]
)
def test_twilight_at_the_zenith_is_that_of_patat(zenith_distance_deg: float, mag: float) -> None:
    # 11.84 + 1.518 (s - 95) - 0.057 (s - 95)^2.
    np.testing.assert_allclose(twilight_mag(np.deg2rad(90 - zenith_distance_deg)), mag, rtol=0, atol=1e-3)
    np.testing.assert_allclose(zenith(sun_altitude_deg=90 - zenith_distance_deg), mag, rtol=0, atol=0.01)


def test_the_sky_is_dark_at_night_and_bright_by_day() -> None:
    np.testing.assert_allclose(zenith(), 21.6, rtol=0, atol=1e-6)
    np.testing.assert_allclose(zenith(zenith_mag_arcsec2=22.0), 22.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(zenith(twilight=False, sun_altitude_deg=-5.0), 21.6, rtol=0, atol=1e-6)
    assert zenith(sun_altitude_deg=30.0) < 5
    by_town = -2.5 * np.log10(10**-6.8 + 10**-8.64)
    np.testing.assert_allclose(zenith(town_mag_arcsec2=17.0), by_town, rtol=0, atol=1e-6)


def test_moonlight_fades_with_height_and_as_the_moon_sets() -> None:
    full, high = (zenith(moon_altitude_deg=45.0, height_m=h) for h in (0.0, 3000.0))
    assert full < 19.5
    assert 0.3 < high - full < 1.2
    fading = [zenith(moon_altitude_deg=altitude) for altitude in (1.0, 0.0, -1.0, -4.0, -12.0)]
    assert np.all(np.diff(fading) > 0)
    np.testing.assert_allclose(fading[-1], 21.6, rtol=0, atol=0.01)


def test_the_horizon_of_a_banked_camera_is_straight_to_the_last_column() -> None:
    # 1014 columns are no multiple of the 16 pixels of a fragment.
    lens = camera(1014, 300, 900.0)
    simulator = sky_over_adelaide(lens, sensor=natural(), mount=Mount(np.deg2rad(10), 0.0, 0.0))
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
    with GLRenderer.headless() as renderer:
        frame = renderer.render(scene, seed=0, light=True)
    up = scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1]
    sky_dn = frame.pixels - frame.light_dn
    compared = 0
    for column in (3, 500, 1007, 1012, 1013):
        rays = lens.unit_vectors(np.stack([np.full(300, column), np.arange(300)], axis=1).astype(np.float64))
        is_sky = rays @ up > 0
        if is_sky.all() or not is_sky.any():
            continue
        row = int(np.argmin(is_sky)) if is_sky[0] else int(np.argmax(is_sky))
        step = int(np.abs(np.diff(sky_dn[:, column])).argmax()) + 1
        assert abs(step - row) <= 1
        compared += 1
    assert compared == 5


def scene_with(sensor: Sensor, utc: str, *, pitch_deg: float = 40.0, heading_deg: float = 345.0) -> Simulator:
    """Return a simulator of a steady flight over Adelaide whose camera points at some altitude and azimuth."""
    base = sky_over_adelaide(camera(320, 240, 300.0), sensor=sensor, mount=Mount(0.0, np.deg2rad(pitch_deg), 0.0))
    flight = ScriptedFlight.steady(ADELAIDE, parse_utc(utc), duration_s=5.0, yaw_rad=np.deg2rad(heading_deg)).flight()
    return Simulator.of(flight, base.sky, base.camera, base.mount, sensor)


def natural(**keys: object) -> Sensor:
    """Return a sensor of 16 bits without noise under a natural sky."""
    effects = {"sky.brightness": "natural"} | {f"sky.{key}": value for key, value in keys.items()}
    return Sensor(
        bit_depth=16, sky_mean_dn=0.0, sky_std_dn=0.0, reference_peak_dn=1e4, reference_vmag=3.0, effects=effects
    )


def test_the_image_has_the_sky_of_each_pixel() -> None:
    sensor = natural()
    simulator = scene_with(sensor, "2024-03-18T11:00:00Z", pitch_deg=60.0)
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
    with GLRenderer.headless() as renderer:
        frame = renderer.render(scene, seed=0, light=True)
    sky_dn = frame.pixels.astype(np.float64) - frame.light_dn
    rows, columns = (np.array(v) for v in zip(*[(20, 30), (120, 160), (200, 290), (5, 315), (238, 2)], strict=True))
    rays = simulator.camera.unit_vectors(np.stack([columns, rows], axis=1).astype(np.float64))
    # The solid angle of a pixel of a pinhole: cos^3 / f^2.
    cosine = 1 / np.linalg.norm(rays / rays[:, 2:], axis=1)
    arcsec2 = cosine**3 / 300.0**2 * 206264.806**2
    directions = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ scene.shutter.C_camera_eq[1]
    radiance = sky_radiance_at(NATURAL_SKY.values(sensor), scene, 1, directions)
    expected = sensor.flux_of_magnitude_dn(0.0, 0.5) * arcsec2 * radiance
    assert expected.min() > 100
    dark = frame.light_dn[rows, columns] < 0.01 * expected
    assert dark.sum() >= 3
    np.testing.assert_allclose(sky_dn[rows, columns][dark], expected[dark], rtol=0.015, atol=0.6)


def test_the_ground_is_below_the_horizon_and_darker() -> None:
    simulator = scene_with(natural(), "2024-03-18T15:30:00Z", pitch_deg=0.0)
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
    with GLRenderer.headless() as renderer:
        pixels = renderer.render(scene, seed=0).pixels.astype(np.float64)
    above, below = np.median(pixels[100:118], axis=1), np.median(pixels[122:140], axis=1)
    assert below.max() < 0.3 * above.min()
    assert np.abs(np.diff(pixels[110:130, 160])).argmax() == 9  # the horizon lies between the rows 119 and 120


def test_truth_says_what_lights_the_sky() -> None:
    simulator = scene_with(natural(), "2024-03-18T11:00:00Z", pitch_deg=24.68, heading_deg=345.3)
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
    with GLRenderer.headless() as renderer:
        line = orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a.png"))
    np.testing.assert_allclose(line["sun_altitude_deg"], -25.04, rtol=0, atol=0.02)
    np.testing.assert_allclose(line["moon_altitude_deg"], 24.68, rtol=0, atol=0.02)
    assert line["moon_separation_deg"] < 0.1
    np.testing.assert_allclose(line["moon_illuminated_fraction"], 0.627, rtol=0, atol=1e-3)
    assert line["sky_mag_arcsec2"] < 16
    keys = ("sun_altitude_deg", "moon_altitude_deg", "moon_illuminated_fraction", "sky_mag_arcsec2")
    assert all(line[key] == round(line[key], 4) != round(line[key], 3) for key in keys)


@pytest.mark.parametrize(("utc", "mag"), [("2024-03-18T09:30:00Z", 14.0), ("2024-03-18T02:00:00Z", 4.0)])
def test_truth_of_twilight_and_day(utc: str, mag: float) -> None:
    simulator = scene_with(natural(town_mag_arcsec2=18.0), utc, pitch_deg=60.0)
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
    with GLRenderer.headless() as renderer:
        line = orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a.png"))
    np.testing.assert_allclose(line["sky_mag_arcsec2"], mag, rtol=0, atol=1.5)


def test_a_preset_sets_the_keys_that_are_not_given() -> None:
    sky = Config().override(**{"sky.preset": "natural", "sky.bodies": False}).sky
    assert (sky.bodies, sky.extinction, sky.brightness) == (False, "standard", "natural")
    again = tomllib.loads(Config().override(**{"sky.preset": "natural"}).to_toml())["sky"]
    assert (again["bodies"], again["extinction"], again["brightness"]) == (True, "standard", "natural")
    with pytest.raises(ConfigError, match=r"sky\.brightness"):
        Config().override(**{"sky.brightness": "bright"})


def test_a_flat_sky_stays_the_default() -> None:
    assert Config().sensor() == replace(Sensor(), effects=Config().sensor().effects)
    assert not NATURAL_SKY.is_active(NATURAL_SKY.values(Config().sensor()))
    assert NATURAL_SKY.is_active(NATURAL_SKY.values(Config().override(**NATURAL).sensor()))


def test_stars_set_at_the_dip_of_the_horizon() -> None:
    np.testing.assert_allclose(np.rad2deg([dip_rad(0.0), dip_rad(3000.0)]), [0.0, 1.63], rtol=0, atol=0.005)
    site = replace(ADELAIDE, height_m=3000.0)
    flight = ScriptedFlight.steady(site, parse_utc("2024-03-18T11:00:00Z"), duration_s=5.0, yaw_rad=2.0).flight()
    lens = camera(320, 240, 300.0)
    level = Mount(0.0, 0.0, 0.0)
    base = sky_over_adelaide(lens, mount=level)
    for trail in ("analytic", "sprites"):
        lowest_deg, drawn = [], []
        for dip in (False, True):
            sky = replace(base.sky, dip=dip)
            simulator = Simulator.of(flight, sky, lens, level, Sensor(bit_depth=16))
            scene = simulator.scene(Exposure(flight.attitude.first_s + 1, 0.5, trail=trail))
            with GLRenderer.headless() as renderer:
                frame = renderer.render(scene, seed=0, light=True)
                line = orjson.loads(frame_truth(scene, frame, number=0, file="a.png"))
            up = np.array(line["up_camera"])
            rays = lens.unit_vectors(
                [(star["x_px"], star["y_px"]) for star in line["stars"] if star["x_px"] is not None]
            )
            lowest_deg.append(np.rad2deg(np.arcsin(rays @ up / np.linalg.norm(rays, axis=1))).min())
            drawn.append(frame.light_dn[125:128].sum())
        assert lowest_deg[0] > -0.01
        assert -1.64 < lowest_deg[1] < -0.3
        assert drawn[0] < 0.5 * drawn[1]


def test_the_natural_sky_replaces_the_uniform_one_of_the_electron_model() -> None:
    def sky_e_per_s(**keys: object) -> float:
        config = Config().override(**{"sensor.noise": "electrons"} | {k.replace("__", "."): v for k, v in keys.items()})
        return config.sensor().electrons.sky_e_per_s

    assert sky_e_per_s() > 0
    assert sky_e_per_s(sky__preset="natural") == 0
    assert sky_e_per_s(sky__preset="natural", sky__brightness="flat") > 0
    assert sky_e_per_s(sky__brightness="natural", sensor__sky_e_per_s=3.0) == 3


def test_the_electron_model_counts_the_natural_sky() -> None:
    config = Config().override(**{"sensor.noise": "electrons", "sky.brightness": "natural", "sensor.bit_depth": 12})
    sensor = config.sensor()
    simulator = scene_with(sensor, "2024-03-18T15:30:00Z", pitch_deg=60.0)
    scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 2.0))
    with GLRenderer.headless() as renderer:
        frame = renderer.render(scene, seed=5, light=True)
    block = np.s_[100:140, 140:180]
    radiance = sky_radiance_at(NATURAL_SKY.values(sensor), scene, 1, scene.shutter.boresight_eq[1])
    expected_dn = float(radiance) * sensor.flux_of_magnitude_dn(0.0, 2.0) / 300.0**2 * 206264.806**2
    above_dn = frame.pixels[block] - frame.light_dn[block] - sensor.electrons.black_level_dn
    dark_dn = sensor.electrons.dark_e_per_s * 2.0 * sensor.electrons.dn_per_e
    assert expected_dn > 10
    np.testing.assert_allclose(above_dn.mean() - dark_dn, expected_dn, rtol=0.03)


def test_space_light_replaces_its_share_of_the_dark_sky() -> None:
    def mag(**keys: bool) -> float:
        simulator = scene_with(natural(**keys), "2024-07-05T12:00:00Z", pitch_deg=80.0, heading_deg=180.0)
        scene = simulator.scene(Exposure(simulator.flight.attitude.first_s + 1, 0.5))
        return float(NATURAL_SKY.truth(NATURAL_SKY.values(scene.sensor), scene)["sky_mag_arcsec2"])

    dark, zodiacal, both = mag(), mag(zodiacal_light=True), mag(zodiacal_light=True, galaxy=True)
    assert 21.0 < both < zodiacal < dark + 0.1
    assert abs(zodiacal - dark) < 0.3


@pytest.mark.parametrize(
    ("zenith_distance_deg", "mag"),
    # The line of slope 1.518 mag a degree through 11.84 at 95 deg, to the Sun at the horizon, and 21.6 from 105.85 deg.
    [(94, 10.322), (91, 5.768), (90, 4.25), (89, 4.25), (30, 4.25), (105.8, 21.586), (105.9, 21.6), (130, 21.6)],
)
def test_twilight_before_and_after_patats_fit(zenith_distance_deg: float, mag: float) -> None:
    assert twilight_mag(np.deg2rad(90 - zenith_distance_deg)) == pytest.approx(mag, rel=0, abs=3e-3)


@pytest.mark.parametrize(("separation_deg", "phase_deg"), [(5.0, 0.0), (30.0, 90.0), (60.0, -90.0), (120.0, 30.0)])
def test_moonlight_is_that_of_krisciunas_and_schaefer(separation_deg: float, phase_deg: float) -> None:
    illuminance = 10 ** (-0.4 * (12.73 - 16.57 + 7.68 + 0.026 * abs(phase_deg) + 4e-9 * phase_deg**4))
    mie = 6.2e7 / separation_deg**2 if separation_deg < 8 else 10 ** (6.15 - separation_deg / 40)
    rayleigh = 229086.765 * (1.06 + np.cos(np.deg2rad(separation_deg)) ** 2)
    air = 10 ** (-0.4 * 0.2 * mass(50)) * (1 - 10 ** (-0.4 * 0.2 * mass(40)))
    found = [
        moonlight_nl(np.deg2rad(separation_deg), mass(50), mass(40), np.deg2rad(phase_deg), 0.2, **keys)
        for keys in ({}, {"rayleigh": 0.5, "aerosol": 2.0})
    ]
    expected = [(rayleigh + mie) * illuminance * air, (rayleigh / 2 + 2 * mie) * illuminance * air]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_the_moons_aureole_ends_a_quarter_of_a_degree_from_it() -> None:
    at = [float(moonlight_nl(np.deg2rad(deg), 1.0, 1.0, 0.0, 0.2)) for deg in (0.0, 0.2499, 0.26)]
    assert at[0] == at[1]
    assert at[1] / at[2] == pytest.approx(0.26**2 / 0.25**2, rel=0.002)


def towards(
    altitude_deg: float, *, azimuth_deg: float = 0.0, sun_separation_deg: float = 90.0, sun_deg: float = -40.0,
    moon_deg: float = -40.0, height_m: float = 0.0, air: Extinction | None = None, **lights: object,
) -> float:  # fmt: skip
    """Return the brightness of the sky in a direction over that of the dark zenith."""
    air = Extinction() if air is None else air
    state = SkyState(air, height_m, np.deg2rad(sun_deg), np.deg2rad(moon_deg), moon_phase_angle_rad=0.0)
    view = SkyView(*(np.deg2rad([v]) for v in (altitude_deg, azimuth_deg, 60.0, sun_separation_deg)))
    view = replace(view, sine_altitude=np.sin(view.sine_altitude))
    return float(sky_radiance(view, SkyLights(**lights), state)[0] * 10 ** (0.4 * 21.6))


def test_the_dark_sky_brightens_towards_the_horizon_as_benn_and_ellison_say() -> None:
    for altitude_deg in (60.0, 20.0, 3.0):
        x = mass(90 - altitude_deg)
        expected = (0.4 + 0.6 * x) * 10 ** (-0.4 * 0.2811 * (x - 1))
        assert towards(altitude_deg) == pytest.approx(expected, rel=1e-9)
    assert towards(-5.0) == towards(0.0)


def test_a_town_glows_ninefold_at_its_horizon_and_not_opposite() -> None:
    town = {"town_mag_arcsec2": 21.6, "town_azimuth_rad": np.deg2rad(70.0)}
    # 1 + 8 ((1 + cos a) / 2)^2 (1 - sin h)^3 for the azimuth a from the town and the altitude h.
    for altitude_deg, azimuth_deg, glow in ((0.0, 70.0, 9.0), (0.0, 160.0, 3.0), (0.0, 250.0, 1.0), (30.0, 70.0, 2.0)):
        lit = towards(altitude_deg, azimuth_deg=azimuth_deg, **town) - towards(altitude_deg)
        assert lit == pytest.approx(glow, rel=1e-9)
    around = towards(0.0, town_mag_arcsec2=21.6) - towards(0.0)
    assert around == pytest.approx(5.0, rel=1e-9)
    assert towards(45.0, town_mag_arcsec2=30.0) == towards(45.0)
    assert towards(45.0, town_mag_arcsec2=29.9) > towards(45.0)
    # At 3000 m the air above scatters less.
    scattered = [1 - 10 ** (-0.4 * Extinction().zenith_mag(h)) for h in (0.0, 3000.0)]
    high = towards(90.0, height_m=3000.0, **town) - towards(90.0, height_m=3000.0)
    assert high == pytest.approx(scattered[1] / scattered[0], rel=1e-9)


def test_twilight_is_brighter_towards_the_sun_and_the_horizon() -> None:
    def lit(altitude_deg: float, separation_deg: float, **keys: object) -> float:
        both = (towards(altitude_deg, sun_separation_deg=separation_deg, **keys, twilight=on) for on in (True, False))
        return next(both) - next(both)

    sun = {"sun_deg": -8.0}
    # As the inverse of the distance from the Sun, down to 5 deg.
    assert lit(30.0, 40.0, **sun) / lit(30.0, 80.0, **sun) == pytest.approx(2.0, rel=1e-9)
    assert lit(30.0, 2.0, **sun) == lit(30.0, 4.99, **sun)
    assert lit(30.0, 5.01, **sun) < lit(30.0, 4.99, **sun)
    # Schaefer 1993: 10^(0.4 z / (360 k)) at the zenith distance z, times the light scattered along the air mass.
    k = 0.2811
    scattered = (1 - 10 ** (-0.4 * k * mass(60))) / (1 - 10 ** (-0.4 * k))
    gradient = lit(30.0, 60.0, **sun) / lit(90.0, 60.0, **sun)
    assert gradient == pytest.approx(10 ** (0.4 * 60 / (360 * k)) * scattered, rel=1e-9)
    # The extinction in the gradient is at least 0.2 mag.
    clear = [Extinction(0.1, aerosol, ozone_mag=0.0) for aerosol in (0.0, 0.05)]
    slopes = []
    for air in clear:
        k = air.zenith_mag(0.0)
        scattered = (1 - 10 ** (-0.4 * k * mass(60))) / (1 - 10 ** (-0.4 * k))
        slopes.append(lit(30.0, 60.0, **sun, air=air) / lit(90.0, 60.0, **sun, air=air) / scattered)
    np.testing.assert_allclose(slopes, 10 ** (0.4 * 60 / (360 * 0.2)), rtol=1e-9)


def test_moonlight_fades_by_1_3_mag_a_degree_below_the_horizon() -> None:
    def lit(moon_deg: float) -> float:
        return towards(50.0, moon_deg=moon_deg) - towards(50.0, moon_deg=moon_deg, moonlight=False)

    ratios = [lit(0.0) / lit(-1.0), lit(-1.0) / lit(-2.5)]
    np.testing.assert_allclose(ratios, 10 ** (0.4 * 1.3 * np.array([1, 1.5])), rtol=1e-6)
    assert lit(10.0) > lit(0.0)


@pytest.mark.parametrize(
    ("sun_deg", "before", "after"),
    # Sunset is at -0.833 deg: 16 arcmin of the Sun's radius and 34 arcmin of refraction.
    [
        (-0.833, "day", "civil twilight"),
        (-6.0, "civil twilight", "nautical twilight"),
        (-12.0, "nautical twilight", "astronomical twilight"),
        (-18.0, "astronomical twilight", "night"),
    ],
)
def test_twilights_end_at_six_twelve_and_eighteen_degrees(sun_deg: float, before: str, after: str) -> None:
    assert [light_name(np.deg2rad(sun_deg + change)) for change in (1e-3, -1e-3)] == [before, after]
