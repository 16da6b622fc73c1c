"""Stars behind cloud: flux against the integral of the transmission in float64, truth, and the light of the cloud."""

import json
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight.flight import PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.scene.clouds import cloud_sheet
from glstar.render.truth.frame import frame_truth
from tests.support.clouds import CLOUD
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, star_field

EARTH_M = 6371008.8
MOUNT = Mount(pitch_rad=np.deg2rad(60.0))


def simulator_of(effects, *, lens=None, turn_rad_per_s=0.02, sensor=None):
    """Return a simulator of one star in mid-image of a fast aircraft that climbs below the cloud."""
    seen = camera(240, 180, 200.0)
    seen = seen if lens is None else replace(seen, lens=lens)
    sensor = replace(sensor or Sensor(psf_sigma_px=1.5, bit_depth=16, reference_peak_dn=3e4), effects=effects)
    base = sky_over_adelaide(seen, sensor=sensor, mount=MOUNT, duration_s=20.0, yaw_rate_rad_per_s=turn_rad_per_s)
    t = np.linspace(0.0, 20.0, 21)
    track = PositionTrack(
        NIGHT_UTC_S + t,
        ADELAIDE.latitude_rad + 80.0 * t / EARTH_M,
        ADELAIDE.longitude_rad + 40.0 * t / EARTH_M,
        200.0 + 10.0 * t,
    )
    base = replace(base, flight=replace(base.flight, position=track), sky=replace(base.sky, refraction=False))
    pointing = base.pointing(np.array([NIGHT_UTC_S + 10.0]))
    return replace(base, stars=star_field(pointing.C_camera_eq[0, 2:], np.array([1.0])))


def transmission(simulator, utc_s):
    """Return what the cloud transmits of the star, by the intersection of a line and a sphere in float64 vectors."""
    sheet = cloud_sheet(simulator.sensor, simulator.motion)
    direction = simulator.stars.direction_eq[0]
    values = []
    for time_s in utc_s:
        pointing = simulator.pointing(np.array([time_s]))
        zenith = pointing.zenith_eq[0]
        latitude, longitude, height = (float(of[0]) for of in simulator.flight.position.coordinates(np.array([time_s])))
        start = (EARTH_M + height) * zenith
        b = start @ direction
        path = -b + np.sqrt(b * b - start @ start + (EARTH_M + sheet.height_m) ** 2)
        there = start + path * direction
        up = there / np.linalg.norm(there)
        north = np.array([0, 0, 1.0]) - zenith[2] * zenith
        north /= np.linalg.norm(north)
        east = np.cross(north, zenith)
        angle = np.arctan2(np.linalg.norm(np.cross(zenith, up)), zenith @ up)
        along = np.array([up @ east, up @ north])
        along *= EARTH_M * angle / np.linalg.norm(along)
        x = along[0] + EARTH_M * np.cos(sheet.latitude_rad) * (longitude - sheet.longitude_rad)
        y = along[1] + EARTH_M * (latitude - sheet.latitude_rad)
        values.append(np.exp(-sheet.depth_at(np.array([x]), np.array([y]), time_s)[0] / (up @ direction)))
    return np.array(values)


@pytest.mark.parametrize(
    ("case", "trail", "duration_s"),
    [("long", "analytic", 12.0), ("long", "sprites", 12.0), ("lens", "analytic", 12.0), ("still", "analytic", 12.0),
     ("short", "analytic", 0.5), ("wings", "analytic", 12.0), ("wings", "sprites", 12.0)],
)  # fmt: skip
def test_the_flux_of_a_star_behind_cloud_is_the_integral_of_its_transmission(
    renderer: GLRenderer, case: str, trail: str, duration_s: float
) -> None:
    lens = Lens("plumb_bob", (-0.05, 0.01, 0.0, 0.0)) if case == "lens" else None
    turn = 0.0 if case == "still" else 0.02
    exposure = Exposure(NIGHT_UTC_S + 10.0 - duration_s / 2, duration_s, trail=trail)
    wings = {"sensor.psf_wing_fraction": 0.9} if case == "wings" else {}
    clouded, clear = (simulator_of(one | wings, lens=lens, turn_rad_per_s=turn) for one in (CLOUD, {}))

    flux, above = (
        renderer.render(one.scene(exposure), seed=0, light=True).light_dn.sum(dtype=float) for one in (clouded, clear)
    )

    times_s = exposure.start_utc_s + (np.arange(1500) + 0.5) / 1500 * duration_s
    through = transmission(clouded, times_s)
    assert case == "short" or np.ptp(through) > 0.5
    assert flux / above == pytest.approx(through.mean(), rel=5e-3, abs=0)
    line = json.loads(frame_truth(scene := clouded.scene(exposure), renderer.render(scene, seed=0), number=0, file="a"))
    (star,) = line["stars"]
    assert star["cloud_transmission_mean"] == pytest.approx(through.mean(), rel=5e-3, abs=0)
    ends = transmission(clouded, [exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])
    np.testing.assert_allclose(
        [star[f"cloud_transmission_{k}"] for k in ("start", "mid", "end")], ends, rtol=0, atol=1e-2
    )


def test_a_trail_is_as_dark_as_the_cloud_in_front_of_each_of_its_parts(renderer: GLRenderer) -> None:
    exposure = Exposure(NIGHT_UTC_S + 4.0, 12.0, trail="analytic")
    clouded, clear = (simulator_of(effects, turn_rad_per_s=0.06) for effects in (CLOUD | {"cloud.seed": 2}, {}))
    one, other = (
        renderer.render(s.scene(exposure), seed=0, light=True).light_dn.astype(float) for s in (clouded, clear)
    )
    ratio = one.sum(axis=0) / np.maximum(other.sum(axis=0), 1e-9)
    bright = np.flatnonzero(other.sum(axis=0) > 0.5 * other.sum(axis=0).max())[3:-3]
    times_s = np.linspace(exposure.start_utc_s, exposure.stop_utc_s, 1201)
    scene = clear.scene(exposure)
    x_px = scene.positions(clear.stars.direction_eq, (times_s - times_s[0]) / 12.0)[:, 0, 0]
    profile = np.exp(-0.5 * ((bright[:, np.newaxis] - x_px) / clear.sensor.effective_sigma_px) ** 2)
    expected = profile @ transmission(clouded, times_s) / profile.sum(axis=1)
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(ratio[bright], expected, rtol=0, atol=0.03)


def test_a_sky_without_stars_has_clouds(renderer: GLRenderer) -> None:
    empty = replace(simulator_of(CLOUD), stars=star_field(np.zeros((0, 3)), np.zeros(0)))
    scene = empty.scene(Exposure(NIGHT_UTC_S + 4.0, 0.5))
    line = json.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a"))
    assert line["stars"] == []
    assert 0.1 < line["cloud_transmission"] < 1


def test_signal_to_noise_and_peak_are_those_of_the_dimmed_trail(renderer: GLRenderer) -> None:
    exposure = Exposure(NIGHT_UTC_S + 4.0, 12.0, trail="analytic")
    lines, peaks, norms = [], [], []
    for effects in (CLOUD, {}):
        scene = simulator_of(effects).scene(exposure)
        frame = renderer.render(scene, seed=0, light=True)
        (star,) = json.loads(frame_truth(scene, frame, number=0, file="a"))["stars"]
        lines.append(star)
        peaks.append(float(frame.light_dn.max()))
        norms.append(float(np.linalg.norm(frame.light_dn.astype(np.float64))))
    # Of a matched filter in uniform noise: the norm of the signal.
    assert lines[0]["snr"] / lines[1]["snr"] == pytest.approx(norms[0] / norms[1], rel=0.01)
    assert norms[0] < 0.9 * norms[1]
    assert lines[0]["flux_dn"] == lines[1]["flux_dn"]
    assert 0.97 * peaks[0] <= lines[0]["trail_peak_dn"] <= peaks[0] * 1.02
    assert lines[0]["trail_peak_dn"] < lines[1]["trail_peak_dn"]


def test_a_sheet_below_the_aircraft_hides_no_star(renderer: GLRenderer) -> None:
    exposure = Exposure(NIGHT_UTC_S + 9.0, 2.0, trail="analytic")
    images = [
        renderer.render(simulator_of(effects).scene(exposure), seed=0, light=True).light_dn
        for effects in (CLOUD | {"cloud.height_m": 100.0}, {})
    ]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5, atol=1e-4)
