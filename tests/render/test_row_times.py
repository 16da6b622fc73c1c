"""When a rolling shutter records each star, against 200 000 moments of which those with an open row count."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.readout.rows import OpenPath, _first_after, recorded_positions, recorded_times
from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth.frame import frame_truth
from tests.support.rollingshutter import star_positions
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, star_field
from tests.support.trails import vibrating

LENS = camera(320, 240, 967.7425)
SAMPLES = 20_000


def turning(deg_per_s: float, *, axis: str = "roll"):
    rate = {f"{axis}_rate_rad_per_s": np.deg2rad(deg_per_s)}
    return sky_over_adelaide(LENS, vmag_limit=6.0, sensor=Sensor(bit_depth=16), **rate)


def truth(scene: Scene) -> dict:
    pixels = np.zeros((LENS.height_px, LENS.width_px), np.uint16)
    return json.loads(frame_truth(scene, Frame(pixels, scene.exposure, 0), number=0, file="frame.png"))


def recorded_moments(simulator, exposure: Exposure, star: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the moments at which the row of a star's centre is open, where it is then, and their distance, s."""
    step_s = (exposure.duration_s + exposure.readout_s) / SAMPLES
    since_s = (np.arange(SAMPLES) + 0.5) * step_s
    xy = star_positions(simulator, star, exposure.start_utc_s + since_s)
    lens = simulator.camera
    axis, count = (1, lens.height_px) if exposure.readout in {"down", "up"} else (0, lens.width_px)
    order = (xy[:, axis] if exposure.readout in {"down", "right"} else count - 1 - xy[:, axis]).clip(0, count - 1)
    open_for_s = since_s - exposure.readout_s * order / (count - 1)
    is_open = (open_for_s >= 0) & (open_for_s <= exposure.duration_s)
    return since_s[is_open], xy[is_open], step_s


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
@pytest.mark.parametrize(("trail", "duration_s"), [("analytic", 0.3), ("analytic", 0.03), ("sprites", 0.3)])
def test_truth_has_the_times_and_positions_at_which_the_rows_of_a_star_are_open(readout, trail, duration_s):
    simulator = turning(20.0)
    exposure = Exposure(NIGHT_UTC_S + 0.4, duration_s, 200.0, trail, 0.087, readout)
    line = truth(simulator.scene(exposure))
    whole = [star for star in line["stars"] if star["in_frame"] == 1.0]
    assert len(whole) >= 2
    ids = simulator.stars.star_id
    for star in whole[:3]:
        index = int(np.flatnonzero(ids == star["star_id"])[0])
        since_s, xy, step_s = recorded_moments(simulator, exposure, index)
        middle_s = (since_s[0] + since_s[-1]) / 2
        assert star["exposed_s"] == pytest.approx(len(since_s) * step_s, rel=0, abs=2 * step_s)
        assert star["mid_offset_s"] == pytest.approx(middle_s - exposure.span_s / 2, rel=0, abs=2 * step_s)
        assert star["light_dn"] == pytest.approx(star["flux_dn"] * star["exposed_s"] / duration_s, rel=1e-6)
        at_middle = star_positions(simulator, index, np.array([exposure.mid_utc_s + star["mid_offset_s"]]))[0]
        centroid = star["centroid_x_px"], star["centroid_y_px"]
        assert (star["x_px"], star["y_px"]) == pytest.approx(tuple(at_middle), rel=0, abs=1e-3)
        assert centroid == pytest.approx(tuple(xy.mean(axis=0)), rel=0, abs=0.01)
        assert star["start"] == pytest.approx(list(xy[0]), rel=0, abs=0.01)
        assert star["end"] == pytest.approx(list(xy[-1]), rel=0, abs=0.01)


@pytest.mark.parametrize("readout", ["down", "left"])
def test_bodies_have_the_times_and_positions_at_which_the_row_of_their_centre_is_open(readout):
    """Jupiter on 2024-03-10, low in the north-west, from an aircraft that rolls at 20 deg/s."""
    mount = Mount(0.0, np.deg2rad(10.0), np.deg2rad(296.0))
    simulator = sky_over_adelaide(camera(), mount=mount, roll_rate_rad_per_s=np.deg2rad(20.0))
    simulator = replace(
        simulator, bodies=True, sensor=Sensor(bit_depth=16), sky=replace(simulator.sky, refraction=True)
    )
    exposure = Exposure(NIGHT_UTC_S + 0.1, 0.05, 200.0, "analytic", 0.2, readout)
    scene = simulator.scene(exposure)
    pixels = np.zeros((240, 320), np.uint16)
    line = json.loads(frame_truth(scene, Frame(pixels, exposure, 0), number=0, file="frame.png"))
    body = {body["name"]: body for body in line["bodies"]}["Jupiter"]
    (centre,) = (each.direction_eq for each in scene.bodies.bodies if each.name == "Jupiter")
    as_star = replace(simulator, camera=camera(), stars=star_field(centre[np.newaxis], np.zeros(1)))
    since_s, xy, step_s = recorded_moments(as_star, exposure, 0)
    middle_s = (since_s[0] + since_s[-1]) / 2
    assert abs(body["mid_offset_s"]) > 0.01
    assert body["mid_offset_s"] == pytest.approx(middle_s - exposure.span_s / 2, rel=0, abs=2 * step_s)
    assert body["exposed_s"] == pytest.approx(len(since_s) * step_s, rel=0, abs=2 * step_s)
    assert body["light_dn"] == pytest.approx(body["flux_dn"] * body["exposed_s"] / 0.05, rel=1e-6)
    at_middle = star_positions(as_star, 0, np.array([exposure.mid_utc_s + body["mid_offset_s"]]))[0]
    assert (body["x_px"], body["y_px"]) == pytest.approx(tuple(at_middle), rel=0, abs=0.01)
    assert (body["centroid_x_px"], body["centroid_y_px"]) == pytest.approx(tuple(xy.mean(axis=0)), rel=0, abs=0.01)
    assert body["start"] == pytest.approx(list(xy[0]), rel=0, abs=0.01)
    assert body["end"] == pytest.approx(list(xy[-1]), rel=0, abs=0.01)


def test_positions_at_fractions_of_a_stars_own_exposure_begin_and_end_with_its_row():
    simulator = turning(20.0)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.03, 200.0, "analytic", 0.087, "up")
    scene = simulator.scene(exposure)
    index = scene.visible[:5]
    found = recorded_positions(scene, scene.stars.direction_eq[index], np.array([0.0, 0.5, 1.0]))
    for star, xy_px in zip(index, np.swapaxes(found, 0, 1), strict=True):
        _, xy, _ = recorded_moments(simulator, exposure, int(star))
        np.testing.assert_allclose(xy_px[[0, 2]], xy[[0, -1]], rtol=0, atol=0.01)
        np.testing.assert_allclose(xy_px[1], xy[len(xy) // 2], rtol=0, atol=0.01)


def test_the_times_of_a_vibrating_camera_are_those_of_its_rows():
    simulator = replace(vibrating(20.0, 1.0), camera=LENS)
    exposure = Exposure(NIGHT_UTC_S + 0.7, 0.05, trail="analytic", readout_s=0.087)
    line = truth(simulator.scene(exposure))
    star = next(star for star in line["stars"] if star["in_frame"] == 1.0)
    index = int(np.flatnonzero(simulator.stars.star_id == star["star_id"])[0])
    since_s, xy, step_s = recorded_moments(simulator, exposure, index)
    assert star["exposed_s"] == pytest.approx(len(since_s) * step_s, rel=0, abs=2 * step_s)
    assert star["start"] == pytest.approx(list(xy[0]), rel=0, abs=0.01)
    assert (star["centroid_x_px"], star["centroid_y_px"]) == pytest.approx(tuple(xy.mean(axis=0)), rel=0, abs=0.01)


def test_the_attitude_and_its_rate_place_every_star_at_its_own_middle():
    simulator = turning(30.0, axis="pitch")
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.4, 0.05, readout_s=0.087, readout="up"))
    line = truth(scene)
    offsets_s = [star["mid_offset_s"] for star in line["stars"]]
    assert np.ptp(offsets_s) > 0.02
    directions = {int(k): d for k, d in zip(scene.stars.star_id, scene.stars.direction_eq, strict=True)}
    at_middle = scene.shutter[1:2].to_camera([directions[star["star_id"]] for star in line["stars"]])[0]
    for star, ray in zip(line["stars"], at_middle, strict=True):
        turned = Rotation.from_rotvec(-np.array(line["rates_rad_per_s"]) * star["mid_offset_s"]).apply(ray)
        if star["x_px"] is not None:
            assert tuple(LENS.project(turned)) == pytest.approx((star["x_px"], star["y_px"]), rel=0, abs=0.01)


@pytest.mark.parametrize("frames", [1, 3])
def test_the_rate_is_that_of_the_attitude_in_the_middle_of_the_exposure(frames):
    exposure = Exposure(
        NIGHT_UTC_S + 0.31, 0.08, readout_s=0.05, frames=frames, gap_s=0.02 if frames > 1 else 0.0, stack="mean"
    )
    simulator = replace(vibrating(20.0, 1.0), camera=LENS)
    before, after = simulator.pointing(exposure.mid_utc_s + np.array([-5e-4, 5e-4])).C_camera_eq
    # In the camera frame the stars turn in the opposite direction.
    expected = -Rotation.from_matrix(after @ before.T).as_rotvec() / 1e-3
    assert np.linalg.norm(expected) > 0.1
    # UTC in seconds is rounded to 2.4e-7 s: of a millisecond 5e-4.
    np.testing.assert_allclose(truth(simulator.scene(exposure))["rates_rad_per_s"], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
@pytest.mark.parametrize("duration_s", [0.3, 0.05])
def test_stars_beside_the_image_are_recorded_as_by_the_row_at_its_border(readout, duration_s):
    """Stars turn by 27 px: from 40 px beside the image they stay there, where the border row opens and closes."""
    simulator = turning(4.0, axis="pitch")
    exposure = Exposure(NIGHT_UTC_S + 0.4, duration_s, 200.0, "analytic", 0.1, readout)
    scene = simulator.scene(exposure)
    x_px, y_px = np.meshgrid([-40.0, 160.0, 360.0], [-40.0, 120.0, 280.0])
    rays = LENS.unit_vectors(np.stack([x_px, y_px], axis=-1).reshape(-1, 2))
    found = recorded_times(scene, rays @ scene.shutter.C_camera_eq[1])
    along = {"down": y_px, "up": 240 - y_px, "right": x_px, "left": 320 - x_px}[readout].ravel()
    assert (along < 0).sum() == (along > (240 if readout in {"down", "up"} else 320)).sum() == 3
    np.testing.assert_allclose(found.opens_s[along < 0], 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.closes_s[along < 0], duration_s, rtol=0, atol=1e-9)
    beyond = along > (240 if readout in {"down", "up"} else 320)
    np.testing.assert_allclose(found.opens_s[beyond], 0.1, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.closes_s[beyond], duration_s + 0.1, rtol=0, atol=1e-9)


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
def test_stars_that_move_on_lines_are_recorded_when_their_rows_meet_them(readout):
    """A star at row y + v t opens at t = tau (y + v t), and closes the exposure time later than its row opens."""
    exposure = Exposure(NIGHT_UTC_S, 0.05, 200.0, "analytic", 0.1, readout)
    at_start_px, px_per_s = np.array([[40.0, 100.0, 250.0], [30.0, 120.0, 200.0]]), np.array([[90.0], [-60.0]])
    times_s = np.array([0.0, 0.02, 0.07, 0.11, exposure.span_s])
    path_px = at_start_px[:, np.newaxis] + px_per_s[:, :, np.newaxis] * times_s[:, np.newaxis]
    found = OpenPath.along(path_px, times_s, exposure, LENS)
    axis, last = (1, 239) if readout in {"down", "up"} else (0, 319)
    is_back, tau_s = readout in {"up", "left"}, 0.1 / last
    row = last - at_start_px[axis] if is_back else at_start_px[axis]
    speed = -px_per_s[axis, 0] if is_back else px_per_s[axis, 0]
    for since_s, end_s, end_px in ((0.0, found.opens_s, found.first_px), (0.05, found.closes_s, found.last_px)):
        expected_s = (since_s + tau_s * row) / (1 - tau_s * speed)
        np.testing.assert_allclose(end_s, expected_s, rtol=0, atol=1e-12)
        np.testing.assert_allclose(end_px, at_start_px + px_per_s * expected_s, rtol=0, atol=1e-9)


def test_the_first_time_after_an_opening_and_a_closing_is_found_by_every_time() -> None:
    rng = np.random.default_rng(6)
    since_s = np.cumsum(rng.normal(0.1, 0.3, (9, 400)), axis=0) - rng.uniform(0, 1.5, 400)
    since_s[0, :5], since_s[-1, 5:10], since_s[3, 10:15], since_s[4, 15:20] = 0.0, 0.0, 0.0, 0.4
    found = _first_after(since_s, since_s[:, ::-1], 0.4)
    for star in range(400):
        column, other = since_s[:, star], since_s[::-1, ::-1][:, star]
        # Open at the last time or never; not closed at the first time or closed from before it.
        opening = next(k for k in range(9) if column[k] >= 0) if column[-1] >= 0 else 9
        closing = 9 - next(k for k in range(9) if other[k] <= 0.4) if other[-1] <= 0.4 else 0
        assert (found[0][star], found[1][star]) == (min(max(opening, 1), 8), min(max(closing, 1), 8))


def test_the_truth_of_a_global_shutter_has_no_rows():
    line = truth(turning(20.0).scene(Exposure(NIGHT_UTC_S + 0.4, 0.3)))
    assert "readout_s" not in line
    assert "mid_offset_s" not in line["stars"][0]


def test_no_star_has_no_times() -> None:
    scene = turning(20.0).scene(Exposure(NIGHT_UTC_S + 0.4, 0.1, 200.0, "analytic", 0.087, "down"))
    found = recorded_times(scene, np.zeros((0, 3)))
    assert found.positions.shape == (3, 0, 2)
    assert len(found.exposed_s) == len(found.mid_offset_s) == 0
