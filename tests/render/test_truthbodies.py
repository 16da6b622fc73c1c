"""The Moon, satellites and other keys of a frame in truth, by the angles and magnitudes of hand-made bodies."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.culling import DrawList, StarCuller
from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth import frame as frame_module
from glstar.sky.air.extinction import Extinction, air_mass
from tests.render.test_scenegeometry import body
from tests.support.scenes import camera, star_field, stars_at

LENS = camera(70, 50, 300.0)
SENSOR = Sensor(psf_sigma_px=1.6, sky_std_dn=3.0, bit_depth=12)


def with_moon(xy_px: tuple[float, float], **changed: object) -> tuple[Scene, object]:
    """Return a scene whose camera turns by 9 px, and the Moon at a pixel in its middle."""
    scene = stars_at([(30.0, 20.0)], [3.0], sensor=SENSOR, lens=LENS, n=60, turn=lambda u: (-0.03 * u, 0.0 * u))
    direction = LENS.unit_vectors(np.array([xy_px]))[0]
    moon = replace(
        body("Moon", radius_rad=0.01, phase_rad=1.2345678), direction_eq=direction, azimuth_rad=0.75, altitude_rad=0.5,
        apparent_altitude_rad=0.51, distance_km=384_000.12345, vmag=4.0,
    )  # fmt: skip
    scene = replace(scene, **changed)
    return scene, moon


def test_a_body_has_the_path_of_its_centre_and_its_own_angles() -> None:
    scene, moon = with_moon((40.0, 25.0))
    found = frame_module._body(scene, moon, saturated=True)
    ends = LENS.project(scene.shutter.to_camera(moon.direction_eq[np.newaxis]))[:, 0]
    path = LENS.project(scene.trails.pointing.to_camera(moon.direction_eq[np.newaxis]))[:, 0]
    np.testing.assert_allclose([found["start"], [found["x_px"], found["y_px"]], found["end"]], ends, rtol=0, atol=1e-6)
    np.testing.assert_allclose([found["centroid_x_px"], found["centroid_y_px"]], path.mean(axis=0), rtol=0, atol=1e-5)
    expected = {
        "name": "Moon", "vmag": 4.0, "in_frame": 1.0, "saturated": True, "azimuth_deg": round(np.rad2deg(0.75), 6),
        "altitude_deg": round(np.rad2deg(0.5), 6), "distance_km": 384_000.123,
        "phase_angle_deg": round(np.rad2deg(1.2345678), 6),
        "illuminated_fraction": round((1 + np.cos(1.2345678)) / 2, 6),
    }  # fmt: skip
    assert {key: found[key] for key in expected} == pytest.approx(expected, abs=1e-9)
    flux = 2 * np.pi * 1.6**2 * SENSOR.peak_dn(4.0, 0.5)
    assert found["flux_dn"] == pytest.approx(flux, abs=1e-6)
    # Twice the radius, at 300 px per radian.
    assert found["diameter_px"] == pytest.approx(2 * 300 * 0.01, rel=2e-3)
    assert found["bright_limb_deg"] == pytest.approx(0.0, abs=1.0)
    assert set(found) == {*expected, "x_px", "y_px", "centroid_x_px", "centroid_y_px", "start", "end", "flux_dn",
                          "diameter_px", "bright_limb_deg"}  # fmt: skip


def test_a_body_is_dimmed_by_the_air_and_a_stack_adds_its_light() -> None:
    air = Extinction()
    scene, moon = with_moon((40.0, 25.0), extinction=air, exposure=Exposure(0.0, 0.5, frames=3, trail="sprites"))
    moon = replace(moon, earthshine_vmag=6.123456789)
    found = frame_module._body(scene, moon, saturated=False)
    mag = air.zenith_mag(scene.site.height_m) * float(air_mass(np.sin(0.51)))
    assert found["extinction_mag"] == pytest.approx(mag, abs=1e-6)
    assert found["earthshine_vmag"] == 6.123457
    light = -2.5 * np.log10(10 ** (-0.4 * 4.0) + 10 ** (-0.4 * 6.123456789))
    flux = 3 * 2 * np.pi * 1.6**2 * SENSOR.peak_dn(light + mag, 0.5)
    assert found["flux_dn"] == pytest.approx(flux, abs=1e-5)
    assert found["saturated"] is False


def test_a_body_behind_the_camera_has_no_position() -> None:
    scene, moon = with_moon((40.0, 25.0))
    moon = replace(moon, direction_eq=np.array([0.0, 0.0, -1.0]))
    scene = replace(scene, shutter=replace(scene.shutter, sine_horizon=-2.0))
    found = frame_module._body(scene, moon, saturated=False)
    keys = ("x_px", "y_px", "centroid_x_px", "centroid_y_px", "start", "end", "diameter_px", "bright_limb_deg")
    assert [found[key] for key in keys] == [None] * 8
    assert found["in_frame"] == 0.0


def test_bodies_are_listed_whose_light_touches_the_image_with_their_saturation() -> None:
    scene, moon = with_moon((40.0, 25.0))
    far = LENS.unit_vectors([(400.0, 25.0)])[0]
    bodies = (replace(moon, name="Mars", direction_eq=far), moon, replace(moon, name="Jupiter"))
    directions = np.concatenate([[far], LENS.unit_vectors([(38.0, 25.0), (42.0, 25.0), (20.0, 10.0)])])
    field = replace(
        star_field(directions, np.full(4, 3.0)), star_id=np.array([0, 1, 1, 2], np.int32), catalogue="bodies"
    )
    sources = BodySources(bodies, field, DrawList(np.arange(4, dtype=np.int32), np.full(4, 5.0)))
    scene = replace(scene, bodies=sources, q_aircraft_ned=np.array([0.1, 0.2, 0.3, 0.4]), extinction=Extinction())
    pixels = np.zeros((50, 70), np.uint16)
    pixels[25, 42] = SENSOR.saturation_dn
    keys = frame_module._sky_keys(scene, pixels)
    assert list(keys) == ["gimbal", "zenith_extinction_mag", "bodies"]
    assert keys["gimbal"] == {"q_aircraft_ned": [0.1, 0.2, 0.3, 0.4]}
    assert keys["zenith_extinction_mag"] == round(Extinction().zenith_mag(scene.site.height_m), 6)
    assert [(each["name"], each["saturated"]) for each in keys["bodies"]] == [("Moon", True), ("Jupiter", False)]
    assert frame_module._sky_keys(stars_at([(3.0, 4.0)], [3.0], sensor=SENSOR, lens=LENS), pixels) == {}


def test_satellites_are_listed_with_their_range_and_light() -> None:
    scene, _ = with_moon((40.0, 25.0))
    frame = Frame(np.zeros((50, 70), np.uint16), scene.exposure, 0)
    assert frame_module._satellites(scene, frame) == {}
    seen_at = []

    def C_ned_eq(times: list[float], latitude: float, longitude: float) -> np.ndarray:
        seen_at.append((times, latitude, longitude))
        return np.array([[[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]])

    sky = SimpleNamespace(satellites=None, C_ned_eq=C_ned_eq)
    assert frame_module._satellites(replace(scene, observing_sky=sky), frame) == {}
    sky.satellites = object()
    direction = np.array([0.48, 0.6, 0.64])

    def seen(times: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(
            range_km=np.array([812.34567, 9.0]), direction_eq=direction[np.newaxis] + times[0] - 0.25
        )

    motion = SimpleNamespace(seen=seen, satellite=SimpleNamespace(name="One"))
    attenuation = SimpleNamespace(
        sunlight=SimpleNamespace(motion=motion, mean=0.123456789), steady_transmission=lambda _eq: None,
        cloud_transmission=lambda _eq: None, mean_scintillation=lambda _stars, _index: None,
    )  # fmt: skip
    alone = replace(scene, attenuation=attenuation, stars=replace(scene.stars, star_id=np.array([25544], np.int32)))
    found = frame_module._satellites(replace(scene, observing_sky=sky, satellites=(alone,)), frame)["satellites"]
    (row,) = json.loads(frame_module._stars(alone, frame))
    assert row.pop("star_id") == 25544
    # North 0.64, east 0.6, up 0.48.
    about = {
        "range_km": 812.346, "azimuth_deg": round(np.rad2deg(np.arctan2(0.6, 0.64)), 6),
        "altitude_deg": round(np.rad2deg(np.arcsin(0.48)), 6), "lit": 0.123457,
    }  # fmt: skip
    assert found == [{"name": "One", "satellite_number": 25544, **row, **about}]
    assert seen_at == [([0.25], scene.site.latitude_rad, scene.site.longitude_rad)]


@pytest.mark.parametrize("stars", [49_999, 50_001])
def test_the_cone_of_many_stars_holds_those_of_few(stars: int) -> None:
    """From 50 000 stars on they are found by cells of the sky, up to a cone of half a radian."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(stars, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scene, _ = with_moon((40.0, 25.0))
    culler = StarCuller(star_field(direction, np.ones(stars)), LENS, SENSOR)
    found = culler._within_cone(scene.trails.pointing)
    boresight = scene.trails.pointing.boresight_eq
    middle = boresight[30]
    swing = np.arccos(np.clip(boresight @ middle, -1, 1)).max()
    widest = np.arctan((8 * SENSOR.widest_sigma_px + 1) / 300)
    radius = LENS.field_radius_rad + widest + swing + np.deg2rad(1.0)
    inside = np.flatnonzero(np.arccos(np.clip(direction @ middle, -1, 1)) < radius)
    assert set(inside.tolist()) <= set(found.tolist())
    assert len(found) < len(inside) + (1 if stars < 50_000 else 400)
    turned = replace(scene.trails.pointing, C_camera_eq=np.stack([np.eye(3), np.diag([1.0, -1, -1])]),
                     zenith_eq=np.zeros((2, 3)), velocity_eq=np.zeros((2, 3)))  # fmt: skip
    assert len(culler._within_cone(turned)) == stars
