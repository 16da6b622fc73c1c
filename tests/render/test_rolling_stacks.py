"""Stacked exposures of a rolling shutter: their images, and the times and places of their stars."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.readout.rows import recorded_times
from glstar.render.readout.stacking import short_seed
from glstar.render.truth.frame import frame_truth
from glstar.render.truth.mask import mask_threshold_dn, trail_mask
from tests.support.rollingshutter import recorded_span_s, rolling_light, star_positions
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, star_field
from tests.support.trails import BRIGHT, light, most_of_the_time_on_the_image

SMALL = camera(240, 180, 967.7425)
STACK = Exposure(NIGHT_UTC_S + 0.4, 0.1, frames=3, gap_s=0.03, readout_s=0.087)
# Of the brightest pixel of a trail, and of its flux.
FRACTION = 2e-3
SAMPLES = 20_000


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as one:
        yield one


@pytest.fixture(scope="module")
def simulator():
    turn = {"yaw_rate_rad_per_s": 0.15, "pitch_rate_rad_per_s": 0.1}
    return sky_over_adelaide(SMALL, vmag_limit=6.5, sensor=Sensor(bit_depth=12), **turn)


def truth_of(renderer, scene, seed=5):
    frame = renderer.render(scene, seed=seed, light=True)
    return orjson.loads(frame_truth(scene, frame, number=0, file="a.png")), frame


def with_only(simulator, star):
    """Return a simulator of a sky in which all other stars are too faint to be drawn."""
    is_other = np.arange(len(simulator.stars)) != star
    return replace(simulator, stars=replace(simulator.stars, vmag=np.where(is_other, 40.0, simulator.stars.vmag)))


def open_times(simulator, exposure, star):
    """Return the times at which the row of a star's centre is open, and how long it has been; brute force."""
    step_s = recorded_span_s(exposure) / SAMPLES
    since_s = (np.arange(SAMPLES) + 0.5) * step_s
    xy = star_positions(simulator, star, exposure.start_utc_s + since_s)
    axis, count = (1, SMALL.height_px) if exposure.readout in {"down", "up"} else (0, SMALL.width_px)
    order = (xy[:, axis] if exposure.readout in {"down", "right"} else count - 1 - xy[:, axis]).clip(0, count - 1)
    delay_s = exposure.readout_s * order / (count - 1)
    period_s = exposure.duration_s + exposure.gap_s
    number = np.floor((since_s - delay_s) / period_s)
    is_open = (number >= 0) & (number < exposure.frames)
    is_open &= since_s - delay_s - number * period_s <= exposure.duration_s
    return since_s[is_open], xy[is_open], number[is_open], step_s


@pytest.mark.parametrize("stack", ["sum", "mean"])
def test_a_stack_is_the_sum_or_the_mean_of_frames_that_are_drawn_alone(renderer, simulator, stack):
    frame = renderer.render(simulator.scene(replace(STACK, stack=stack)), seed=7)
    total = np.zeros((SMALL.height_px, SMALL.width_px), dtype=int)
    for number in range(3):
        alone = Exposure(STACK.start_utc_s + number * 0.13, 0.1, readout_s=0.087)
        total += renderer.render(simulator.scene(alone), seed=short_seed(7, number)).pixels
    np.testing.assert_array_equal(frame.pixels, total if stack == "sum" else np.floor(total / 3 + 0.5))


@pytest.mark.parametrize(
    ("deg_per_s", "readout", "duration_s", "gap_s"),
    [(10.0, "down", 0.1, 0.03), (10.0, "up", 0.1, 0.0), (40.0, "right", 0.02, 0.08), (0.0, "left", 0.1, 0.0)],
)
def test_every_row_is_exposed_several_times(renderer, deg_per_s, readout, duration_s, gap_s):
    turning = sky_over_adelaide(SMALL, vmag_limit=6.0, refraction=False, pitch_rate_rad_per_s=np.deg2rad(deg_per_s))
    turning = replace(turning, sensor=BRIGHT)
    exposure = Exposure(
        NIGHT_UTC_S + 0.4,
        duration_s,
        trail="analytic",
        readout_s=0.087,
        readout=readout,
        frames=3,
        gap_s=gap_s,
        stack="mean",
    )
    (star,) = most_of_the_time_on_the_image(turning.scene(exposure), 1)
    # Without other stars: brute force knows one.
    drawn = light(renderer, with_only(turning, int(star)).scene(exposure))
    expected = rolling_light(turning, exposure, int(star)) / exposure.frames
    assert expected.max() > 100
    assert np.abs(drawn - expected).max() <= FRACTION * expected.max()
    assert drawn.sum() == pytest.approx(expected.sum(), rel=FRACTION)


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
def test_truth_has_the_times_at_which_the_rows_of_a_star_are_open(renderer, simulator, readout):
    exposure = replace(STACK, readout=readout)
    line, frame = truth_of(renderer, simulator.scene(exposure))
    assert line["total_s"] == pytest.approx(3 * 0.1 + 2 * 0.03 + 0.087, rel=0, abs=1e-12)
    whole = [star for star in line["stars"] if star["in_frame"] == 1.0]
    for star in whole[:3]:
        index = int(np.flatnonzero(simulator.stars.star_id == star["star_id"])[0])
        since_s, xy, number, step_s = open_times(simulator, exposure, index)
        middle_s = (since_s[0] + since_s[-1]) / 2
        assert star["exposed_s"] == pytest.approx(len(since_s) * step_s, rel=0, abs=4 * step_s)
        assert star["mid_offset_s"] == pytest.approx(middle_s - recorded_span_s(exposure) / 2, rel=0, abs=2 * step_s)
        assert star["light_dn"] == pytest.approx(star["flux_dn"] * star["exposed_s"] / 0.3, rel=1e-6)
        at_middle = star_positions(simulator, index, np.array([exposure.mid_utc_s + star["mid_offset_s"]]))[0]
        assert [star["x_px"], star["y_px"]] == pytest.approx(list(at_middle), rel=0, abs=1e-3)
        centroid = [star["centroid_x_px"], star["centroid_y_px"]]
        assert centroid == pytest.approx(list(xy.mean(axis=0)), rel=0, abs=0.01)
        assert star["start"] == star["segments"][0][0]
        assert star["end"] == star["segments"][-1][1]
        for k, (start, end) in enumerate(star["segments"]):
            assert start == pytest.approx(list(xy[number == k][0]), rel=0, abs=0.02)
            assert end == pytest.approx(list(xy[number == k][-1]), rel=0, abs=0.02)
    on_image_dn = sum(star["light_dn"] * star["in_frame"] for star in line["stars"])
    assert frame.light_dn.sum(dtype=float) == pytest.approx(on_image_dn, rel=0.01)


def test_back_to_back_exposures_share_their_ends(renderer, simulator):
    line, _ = truth_of(renderer, simulator.scene(replace(STACK, gap_s=0.0, frames=4)))
    stars = [star for star in line["stars"] if star["x_px"] is not None]
    assert len(stars) > 5
    for star in stars:
        assert all(before[1] == after[0] for before, after in pairwise(star["segments"]))


@pytest.mark.parametrize("exposure", [STACK, replace(STACK, frames=1), replace(STACK, duration_s=0.02, gap_s=0.1)])
def test_the_expected_peak_of_a_trail_is_that_of_the_rows_that_are_open(renderer, simulator, exposure):
    """Not that of the longer path between the first opening and the last closing."""
    line, _ = truth_of(renderer, simulator.scene(exposure))
    inner = [s for s in line["stars"] if s["in_frame"] == 1 and 15 < s["x_px"] < 225 and 15 < s["y_px"] < 165]
    star = inner[0]
    index = int(np.flatnonzero(simulator.stars.star_id == star["star_id"])[0])
    drawn = light(renderer, with_only(simulator, index).scene(exposure))
    assert star["trail_peak_dn"] == pytest.approx(float(drawn.max()), rel=0.06)


def test_the_mask_of_a_trail_covers_what_is_drawn(renderer, simulator):
    scene = simulator.scene(STACK)
    _, frame = truth_of(renderer, scene)
    mean_dn, threshold_dn = frame.light_dn / 3, mask_threshold_dn(scene)
    is_marked = trail_mask(scene) > 0
    assert is_marked.sum() > 100
    # The stars of a trail and of all others differ where trails overlap, and ends by the rows that a pixel spans.
    assert is_marked[mean_dn > 1.2 * threshold_dn].mean() > 0.98
    assert (mean_dn[is_marked] > 0.8 * threshold_dn).mean() > 0.98


@pytest.mark.parametrize("exposure", [STACK, replace(STACK, frames=1, gap_s=0.0)])
def test_the_times_of_some_stars_are_chosen_from_those_of_all(simulator, exposure):
    scene = simulator.scene(exposure)
    direction_eq = scene.stars.direction_eq[scene.visible]
    some = np.arange(len(direction_eq))[5::3]
    chosen, alone = recorded_times(scene, direction_eq)[some], recorded_times(scene, direction_eq[some])
    for one, other in zip((chosen, *chosen.shorts), (alone, *alone.shorts), strict=True):
        for name, tolerance in (("opens_s", 1e-8), ("closes_s", 1e-8), ("exposed_s", 1e-8), ("positions", 1e-5)):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=tolerance)
        np.testing.assert_allclose(one.mid_offset_s, other.mid_offset_s, rtol=0, atol=1e-8)


def test_a_stack_without_stars_has_no_times(renderer, simulator):
    empty = replace(simulator, stars=star_field(np.zeros((0, 3)), np.zeros(0)))
    line, _ = truth_of(renderer, empty.scene(STACK))
    assert line["stars"] == []
    assert [len(one.opens_s) for one in recorded_times(empty.scene(STACK), np.zeros((0, 3))).shorts] == [0, 0, 0]
