"""Satellites on images: their trails by brute force in float64 along the places that skyfield gives."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.scene.clouds import horizontal_axes
from glstar.render.scene.satellites import _back, _turns
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.render.truth.mask import trail_mask
from glstar.rotation import matrix_from_quaternion
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.satellites import Satellites, lit_fraction, satellite_vmag
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.synthetic import ScriptedFlight
from tests.support.clouds import CLOUD
from tests.support.reference import profile
from tests.support.rollingshutter import open_fractions
from tests.support.satellites import PASS, dut1_s, elements, seen_by_skyfield
from tests.support.scenes import ADELAIDE, camera

HIGH_S = parse_utc("2024-03-18T10:37:30Z")
# In the penumbra from 10:37:48 to 10:37:57.
SHADOW_S, SHADOW_SPAN_S = parse_utc("2024-03-18T10:37:45Z"), 12.0
SENSOR = Sensor(psf_sigma_px=1.5, bit_depth=16, reference_peak_dn=2000.0)
EARTH_KM = 6371.0


def simulator_of(
    tmp_path: Path, *, yaw_deg: float = 320.0, turn_rad_per_s: float = 0.0, effects=None, lens=None, bits: int = 16
) -> Simulator:
    """Return a simulator of a camera towards the pass, without stars above the horizon."""
    path = tmp_path / "pass.tle"
    path.write_text(elements(PASS), encoding="utf-8")
    sky = Sky(StarCatalogue.open("bsc5").by_id([2061]), dut1_s=dut1_s(HIGH_S), refraction=False, dip=False)
    flight = ScriptedFlight.steady(
        ADELAIDE, HIGH_S - 20.0, duration_s=60.0, yaw_rad=np.deg2rad(yaw_deg), yaw_rate_rad_per_s=turn_rad_per_s
    ).flight()
    seen = camera(320, 240, 200.0)
    sensor = replace(SENSOR, effects=effects or {}, bit_depth=bits)
    made = Simulator.of(
        flight,
        replace(sky, satellites=Satellites.open(path, 4.0)),
        seen if lens is None else replace(seen, lens=lens),
        Mount(pitch_rad=np.deg2rad(55.0)),
        sensor,
    )
    return replace(made, stars=replace(made.stars, direction_eq=-made.pointing(np.array([HIGH_S])).zenith_eq))


def path_of(simulator: Simulator, utc_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the satellite is on the image, (n, 2) px, and how many DN it leaves a second, both in float64."""
    xy, dn = [], []
    for time_s in utc_s:
        ned_km = seen_by_skyfield(PASS, time_s, ADELAIDE)
        range_km = np.linalg.norm(ned_km)
        C_camera_ned = simulator.mount.C_camera_body @ matrix_from_quaternion(
            simulator.flight.attitude.at(np.array([time_s]))[0]
        )
        xy.append(simulator.camera.project((C_camera_ned @ ned_km / range_km)[np.newaxis])[0])
        C_ned_eq = simulator.sky.C_ned_eq([time_s], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
        (sun,) = observed_bodies(simulator.sky, HIGH_S, ADELAIDE, ("Sun",))
        direction_eq = C_ned_eq.T @ ned_km / range_km
        phase = np.arccos(-direction_eq @ sun.direction_eq)
        up = C_ned_eq.T @ [0.0, 0.0, -1.0]
        # The normal of the ellipsoid is 0.18 deg from the geocentric vertical here: 4 s of time at the shadow's edge.
        geocentric = _geocentric_km(simulator, time_s) + range_km * direction_eq
        assert abs(np.linalg.norm(up) - 1) < 1e-9
        lit = lit_fraction(geocentric, sun.direction_eq)
        dn.append(lit * simulator.sensor.flux_of_magnitude_dn(satellite_vmag(4.0, range_km, phase), 1.0))
    return np.array(xy), np.array(dn)


def _geocentric_km(simulator: Simulator, time_s: float) -> np.ndarray:
    """Return the site from the Earth's centre, true equator and equinox: geodetic to geocentric by WGS84."""
    a_km, f = 6378.137, 1 / 298.257223563
    phi, e2 = ADELAIDE.latitude_rad, f * (2 - f)
    n_km = a_km / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    C_ned_eq = simulator.sky.C_ned_eq([time_s], phi, ADELAIDE.longitude_rad)[0]
    out = -C_ned_eq[2]
    axis = np.array([0.0, 0.0, 1.0])
    outward = (out - np.sin(phi) * axis) / np.cos(phi)
    h_km = ADELAIDE.height_m / 1000
    return (n_km + h_km) * np.cos(phi) * outward + (n_km * (1 - e2) + h_km) * np.sin(phi) * axis


def brute_force(simulator: Simulator, exposure: Exposure, samples: int = 300) -> np.ndarray:
    """Return the light of the exposure as a sum over places along the path, DN."""
    span_s = exposure.span_s
    utc_s = exposure.start_utc_s + (np.arange(samples) + 0.5) / samples * span_s
    xy, dn_per_s = path_of(simulator, utc_s)
    rows, columns = np.arange(simulator.camera.height_px), np.arange(simulator.camera.width_px)
    is_open = np.ones((samples, len(rows)))
    if exposure.readout_s:
        is_open, _ = open_fractions(exposure, len(columns), len(rows), samples)
    light = np.zeros((len(rows), len(columns)))
    per_dn = simulator.sensor.flux_dn(1.0)
    for (x, y), dn, fraction in zip(xy, dn_per_s, is_open, strict=True):
        across, down = profile(columns - x, simulator.sensor), profile(rows - y, simulator.sensor)
        light += dn / per_dn * span_s / samples * np.outer(down * fraction, across)
    return light


@pytest.mark.parametrize(
    ("case", "trail"),
    [("still", "analytic"), ("turning", "analytic"), ("turning", "sprites"), ("shadow", "analytic"),
     ("shadow", "sprites"), ("rolling", "analytic")],
)  # fmt: skip
def test_a_satellites_trail_is_the_sum_over_its_places(
    renderer: GLRenderer, tmp_path: Path, case: str, trail: str
) -> None:
    turn_rad_per_s, yaw_deg = 0.1 if case in {"turning", "rolling"} else 0.0, 358.0 if case == "shadow" else 320.0
    simulator = simulator_of(tmp_path, turn_rad_per_s=turn_rad_per_s, yaw_deg=yaw_deg)
    start_s, duration_s = (SHADOW_S, SHADOW_SPAN_S) if case == "shadow" else (HIGH_S, 3.0)
    readout_s = 1.0 if case == "rolling" else 0.0
    exposure = Exposure(start_s, duration_s, trail=trail, readout_s=readout_s)

    scene = simulator.scene(exposure)
    light = renderer.render(scene, seed=0, light=True).light_dn
    expected = brute_force(simulator, exposure)

    assert len(scene.satellites) == 1
    assert np.abs(light - expected).max() < 5e-3 * expected.max()
    assert light.sum(dtype=float) == pytest.approx(expected.sum(), rel=3e-3)
    if case == "shadow":
        xy, dn = path_of(simulator, np.array([start_s, start_s + duration_s]))
        assert dn[1] == 0 < dn[0]
        assert light[tuple(np.rint(xy[1, ::-1]).astype(int))] < 1e-3 * light.max()


def test_truth_has_the_satellite_where_skyfield_sees_it(renderer: GLRenderer, tmp_path: Path) -> None:
    simulator, exposure = simulator_of(tmp_path, yaw_deg=358.0, turn_rad_per_s=0.02), Exposure(SHADOW_S, SHADOW_SPAN_S)
    scene = simulator.scene(exposure)
    frame = renderer.render(scene, seed=0, light=True)

    (line,) = json.loads(frame_truth(scene, frame, number=0, file="a"))["satellites"]

    xy, _ = path_of(simulator, exposure.start_utc_s + np.array([0.0, 0.5, 1.0]) * SHADOW_SPAN_S)
    for found, expected in zip((line["start"], [line["x_px"], line["y_px"]], line["end"]), xy, strict=True):
        assert found == pytest.approx(expected, rel=0, abs=0.01)
    ned_km = seen_by_skyfield(PASS, exposure.mid_utc_s, ADELAIDE)
    assert line["range_km"] == pytest.approx(np.linalg.norm(ned_km), rel=0, abs=0.01)
    assert line["altitude_deg"] == pytest.approx(
        np.rad2deg(np.arcsin(-ned_km[2] / np.linalg.norm(ned_km))), rel=0, abs=1e-3
    )
    assert (line["name"], line["satellite_number"]) == ("SATELLITE 1", 99001)
    # The flux is that of the brightest magnitude; `lit` of it arrives.
    assert line["flux_dn"] * line["lit"] == pytest.approx(frame.light_dn.sum(dtype=float), rel=3e-3)
    times_s = exposure.start_utc_s + (np.arange(400) + 0.5) / 400 * SHADOW_SPAN_S
    assert line["flux_dn"] * line["lit"] == pytest.approx(
        path_of(simulator, times_s)[1].mean() * SHADOW_SPAN_S, rel=3e-3
    )
    assert line["trail_peak_dn"] == pytest.approx(frame.light_dn.max(), rel=0.05)
    mask = trail_mask(scene)
    assert set(np.unique(mask)) == {0, 1}
    assert frame.light_dn[mask == 1].sum() > 0.95 * frame.light_dn.sum()


def test_each_short_exposure_of_a_stack_has_the_satellite_at_its_own_time(renderer: GLRenderer, tmp_path: Path) -> None:
    simulator = simulator_of(tmp_path, bits=12)
    stack = Exposure(HIGH_S, 0.5, trail="analytic", frames=3, gap_s=1.0)
    light = renderer.render(scene := simulator.scene(stack), seed=0, light=True).light_dn
    expected = sum(brute_force(simulator, Exposure(HIGH_S + 1.5 * k, 0.5), 60) for k in range(3))
    assert np.abs(light - expected).max() < 5e-3 * expected.max()
    assert len(scene.satellites) == 1


def test_a_lens_bends_the_trail_of_a_satellite(renderer: GLRenderer, tmp_path: Path) -> None:
    simulator = simulator_of(tmp_path, lens=Lens("plumb_bob", (-0.15, 0.02, 0.0, 0.0)))
    exposure = Exposure(HIGH_S, 3.0, trail="analytic")
    light = renderer.render(simulator.scene(exposure), seed=0, light=True).light_dn
    xy, dn_per_s = path_of(simulator, exposure.start_utc_s + (np.arange(300) + 0.5) / 100)
    rows, columns = np.indices(light.shape)
    centre = np.array([(light * grid).sum() for grid in (columns, rows)]) / light.sum()
    assert centre == pytest.approx((xy * dn_per_s[:, np.newaxis]).sum(axis=0) / dn_per_s.sum(), rel=0, abs=0.02)
    assert light.sum(dtype=float) == pytest.approx(dn_per_s.mean() * 3.0, rel=5e-3)


def test_cloud_covers_a_satellite_where_it_is_seen(renderer: GLRenderer, tmp_path: Path) -> None:
    """The azimuth of the satellite, not that of the source at rest, says which part of the cloud is in front of it."""
    exposure = Exposure(HIGH_S, 3.0, trail="analytic")
    cloudy, clear = (simulator_of(tmp_path, effects=effects) for effects in (CLOUD | {"cloud.seed": 1}, {}))
    (scene,) = cloudy.scene(exposure).satellites
    passed = renderer.render(cloudy.scene(exposure), seed=0, light=True).light_dn.sum(dtype=float)
    passed /= renderer.render(clear.scene(exposure), seed=0, light=True).light_dn.sum(dtype=float)

    # A star at rest where the satellite is, at each of some times.
    through = []
    for time_s in exposure.start_utc_s + (np.arange(60) + 0.5) / 20:
        pointing = cloudy.pointing(np.array([time_s]))
        ned_km = seen_by_skyfield(PASS, time_s, ADELAIDE)
        east_eq, north_eq = horizontal_axes(pointing.zenith_eq[0])
        axes = np.stack([north_eq, east_eq, -pointing.zenith_eq[0]])
        direction = (ned_km / np.linalg.norm(ned_km)) @ axes
        star = replace(cloudy.stars, direction_eq=direction[np.newaxis].copy())
        star = replace(star, vmag=np.array([1.0]))
        still = replace(cloudy, stars=star, sky=replace(cloudy.sky, satellites=None))
        listed = still.scene(Exposure(time_s - 0.005, 0.01, trail="analytic")).draw_list.passage
        through.append(float(listed.mean()))
    assert np.ptp(through) > 0.5
    assert passed == pytest.approx(np.mean(through), rel=0.02, abs=0)
    assert scene.draw_list.passage.mean() == pytest.approx(passed, rel=0.1)


def test_a_frame_that_follows_a_satellite_turns_by_the_shortest_rotation() -> None:
    first, *others = np.random.default_rng(3).normal(size=(6, 3))
    first, directions = first / np.linalg.norm(first), others / np.linalg.norm(others, axis=1)[:, np.newaxis]
    axis = np.cross(first, directions)
    angle_rad = np.arctan2(np.linalg.norm(axis, axis=1), directions @ first)
    unit = axis / np.linalg.norm(axis, axis=1)[:, np.newaxis]
    expected = Rotation.from_rotvec(angle_rad[:, np.newaxis] * unit)
    turn = _turns(first, directions)
    np.testing.assert_allclose(turn, expected.as_matrix(), rtol=0, atol=1e-12)
    vectors = np.random.default_rng(4).normal(size=(5, 3))
    np.testing.assert_allclose(_back(turn, vectors), expected.inv().apply(vectors), rtol=0, atol=1e-12)


def test_a_satellite_is_the_only_source_of_its_scene(tmp_path: Path) -> None:
    simulator = replace(simulator_of(tmp_path), bodies=True)
    scene = simulator.scene(Exposure(HIGH_S, 0.5))
    assert scene.bodies is not None
    (satellite,) = scene.satellites
    assert (satellite.bodies, satellite.satellites, len(satellite.stars)) == (None, (), 1)


def test_no_satellite_is_drawn_in_the_shadow_or_outside_of_the_image(tmp_path: Path) -> None:
    simulator = simulator_of(tmp_path, yaw_deg=358.0)
    assert len(simulator.scene(Exposure(SHADOW_S, 0.5)).satellites) == 1
    assert simulator.scene(Exposure(SHADOW_S + 14.0, 0.5)).satellites == ()
    away = replace(simulator, mount=Mount(pitch_rad=np.deg2rad(5.0), yaw_rad=np.pi))
    assert away.scene(Exposure(HIGH_S, 0.5)).satellites == ()
