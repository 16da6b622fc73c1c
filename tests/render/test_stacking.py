"""Stacked exposures: their times, trails and truth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.errors import ConfigError
from glstar.render.effects import scaled_keys
from glstar.render.opengl import GLRenderer
from glstar.render.readout.stacking import short_seed, union
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

SMALL = camera(240, 180, 400.0)
STACK = Exposure(NIGHT_UTC_S + 0.4, 0.05, frames=4, gap_s=0.03)


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as one:
        yield one


@pytest.fixture(scope="module")
def simulator():
    return sky_over_adelaide(SMALL, vmag_limit=6.0, yaw_rate_rad_per_s=0.3, pitch_rate_rad_per_s=0.2)


def truth_of(renderer, scene, seed=5):
    line = orjson.loads(frame_truth(scene, renderer.render(scene, seed=seed), number=0, file="a.png"))
    return line, {star["star_id"]: star for star in line["stars"]}


@pytest.mark.parametrize("stack", ["sum", "mean"])
def test_a_stack_is_the_sum_or_the_mean_of_its_short_exposures(renderer, simulator, stack):
    exposure = replace(STACK, stack=stack)
    frame = renderer.render(simulator.scene(exposure), seed=7, light=True)
    starts_s = STACK.start_utc_s + np.array([0.0, 0.08, 0.16, 0.24])
    single = [
        renderer.render(simulator.scene(Exposure(start_s, 0.05)), seed=short_seed(7, k), light=True)
        for k, start_s in enumerate(starts_s)
    ]
    total = np.sum([one.pixels.astype(int) for one in single], axis=0)
    light = np.sum([one.light_dn.astype(float) for one in single], axis=0)
    expected = total if stack == "sum" else np.floor(total / 4 + 0.5)
    np.testing.assert_array_equal(frame.pixels, expected)
    assert frame.pixels.dtype == (np.uint16 if stack == "sum" else np.uint8)
    np.testing.assert_allclose(frame.light_dn, light if stack == "sum" else light / 4, rtol=1e-6, atol=1e-6)


def test_begun_stacks_and_single_exposures_are_returned_in_order(renderer, simulator):
    scenes = [simulator.scene(Exposure(STACK.start_utc_s, 0.05)), simulator.scene(STACK)]
    scenes.append(scenes[0])
    pending = []
    for seed, scene in enumerate(scenes):
        renderer.develop(scene, seed=seed)
        pending.append(renderer.read())
    for seed, scene in enumerate(scenes):
        np.testing.assert_array_equal(pending[seed].frame().pixels, renderer.render(scene, seed=seed).pixels)


def test_the_noise_of_a_sum_adds_in_variance_and_that_of_a_mean_falls(renderer, simulator):
    # Far above 0 DN, so that nothing is cut off; rounding adds 1/12 DN^2 to each frame, and once more to a mean.
    dark = replace(simulator, sensor=replace(simulator.sensor, sky_mean_dn=60.0, sky_std_dn=4.0, reference_vmag=-9.0))
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.02, frames=9)
    one_dn2 = 16.0 + 1 / 12
    for stack, expected_dn2, mean_dn in (("sum", 9 * one_dn2, 540.0), ("mean", one_dn2 / 9 + 1 / 12, 60.0)):
        pixels = renderer.render(dark.scene(replace(exposure, stack=stack)), seed=3).pixels.astype(float)
        # The standard error of a variance of n samples is sqrt(2 / n): 0.7 % of 43,200 pixels.
        assert pixels.var() == pytest.approx(expected_dn2, rel=0.03, abs=0)
        assert pixels.mean() == pytest.approx(mean_dn, rel=0, abs=0.1)


def test_short_exposures_without_a_gap_share_their_ends(renderer, simulator):
    _, stars = truth_of(renderer, simulator.scene(replace(STACK, gap_s=0.0)))
    assert stars
    for star in stars.values():
        segments = star["segments"]
        assert len(segments) == 4
        assert all(before[1] == after[0] for before, after in pairwise(segments))
        assert segments[0][0] == star["start"]
        assert segments[-1][1] == star["end"]


def test_the_truth_of_a_stack_joins_that_of_its_short_exposures(renderer, simulator):
    line, stars = truth_of(renderer, simulator.scene(STACK))
    shorts = [truth_of(renderer, simulator.scene(short))[1] for short in STACK.short_exposures()]
    assert set(stars) == set().union(*shorts)
    assert (line["frames"], line["gap_s"], line["stack"], line["duration_s"]) == (4, 0.03, "sum", 0.05)
    assert line["total_s"] == pytest.approx(4 * 0.05 + 3 * 0.03, rel=0, abs=1e-12)
    for number, star in stars.items():
        own = [short.get(number) for short in shorts]
        for segment, one in zip(star["segments"], own, strict=True):
            if one is not None:
                np.testing.assert_allclose(segment, [one["start"], one["end"]], rtol=0, atol=1e-3)
        assert star["in_frame"] == pytest.approx(
            np.mean([0.0 if one is None else one["in_frame"] for one in own]), abs=1e-5
        )
        known = [one for one in own if one is not None]
        assert star["flux_dn"] == pytest.approx(4 * known[0]["flux_dn"], rel=1e-6)
        if len(known) == 4 and star["in_frame"] == 1:
            centroid = np.mean([[one["centroid_x_px"], one["centroid_y_px"]] for one in own], axis=0)
            np.testing.assert_allclose([star["centroid_x_px"], star["centroid_y_px"]], centroid, rtol=0, atol=2e-3)


def test_the_flux_of_truth_is_on_the_image(renderer, simulator):
    scene = simulator.scene(STACK)
    _, stars = truth_of(renderer, scene)
    light_dn = renderer.render(scene, seed=0, light=True).light_dn.sum(dtype=float)
    listed_dn = sum(star["flux_dn"] * star["in_frame"] for star in stars.values())
    assert light_dn == pytest.approx(listed_dn, rel=0.01)


@pytest.mark.parametrize("stack", ["sum", "mean"])
def test_the_peak_of_a_star_at_rest_is_that_of_all_short_exposures(renderer, stack):
    still = sky_over_adelaide(SMALL, vmag_limit=6.0)
    exposure = replace(STACK, gap_s=0.0, frames=8, stack=stack)
    scene = still.scene(exposure)
    _, stars = truth_of(renderer, scene)
    _, long_stars = truth_of(renderer, still.scene(Exposure(STACK.start_utc_s, 0.4)))
    factor = 1 if stack == "sum" else 8
    bright = next(number for number, star in stars.items() if star["in_frame"] == 1)
    one, long = stars[bright], long_stars[bright]
    assert one["trail_peak_dn"] * factor == pytest.approx(long["trail_peak_dn"], rel=1e-3)
    assert one["peak_dn"] * factor == pytest.approx(long["peak_dn"], rel=1e-6)
    # Eight times the flux and sqrt(8) times the noise of one; one long exposure has the noise of one.
    assert one["snr"] * np.sqrt(8) == pytest.approx(long["snr"], rel=1e-3)


def test_a_star_that_saturates_a_short_exposure_is_saturated_in_truth(renderer):
    still = sky_over_adelaide(SMALL, vmag_limit=6.0)
    bright = replace(still, sensor=replace(still.sensor, reference_peak_dn=30_000.0))
    for stack in ("sum", "mean"):
        _, stars = truth_of(renderer, bright.scene(replace(STACK, stack=stack)))
        saturated = {number for number, star in stars.items() if star["saturated"]}
        _, single = truth_of(renderer, bright.scene(STACK.first), seed=short_seed(5, 0))
        assert saturated
        assert saturated >= {number for number, star in single.items() if star["saturated"]}


def test_a_sum_that_does_not_fit_into_16_bits_is_refused(simulator):
    twelve = replace(simulator, sensor=simulator.sensor.with_bit_depth(12, scaled_keys()))
    assert len(twelve.scene(replace(STACK, frames=16, gap_s=0.0, duration_s=0.01)).shorts) == 16
    with pytest.raises(ConfigError, match=r"take at most 16.*mean") as error:
        twelve.scene(replace(STACK, frames=17))
    assert error.value.key == "exposure.frames"


def test_a_rolling_shutter_reads_an_exposure_before_the_next():
    replace(STACK, readout_s=0.08)
    replace(STACK, duration_s=0.1, gap_s=0.2, readout_s=0.1 + 0.2)
    with pytest.raises(ConfigError, match=r"every 0.08 s.*takes 0.087 s.*at least 0.037") as error:
        replace(STACK, readout_s=0.087)
    assert error.value.key == "exposure.gap_s"


@pytest.mark.parametrize("stack", ["sum", "mean"])
def test_a_stack_is_developed_into_one_texture(renderer, simulator, stack):
    scene, single = simulator.scene(replace(STACK, stack=stack)), simulator.scene(STACK.first)
    expected = renderer.render(scene, seed=3).pixels
    with renderer.context, GLRenderer(renderer.context) as other:
        other.develop(scene, seed=3)
        texture = other.texture()
        shown = np.frombuffer(texture.read(alignment=1), texture.dtype).reshape(expected.shape)
        np.testing.assert_array_equal(other.read().frame().pixels, expected)
        np.testing.assert_array_equal(other.stacked.pixels, expected)
        other.develop(single, seed=3)
        assert other.stacked is None
        assert other.read().frame().pixels.dtype == np.uint8
        other.develop(scene, seed=3)
        again = other.texture().read(alignment=1)
    np.testing.assert_array_equal(shown, expected)
    assert again == expected.tobytes()


def test_a_star_of_several_draw_lists_is_listed_once(simulator):
    lists = [short.listed for short in simulator.scene(STACK).shorts]
    joined = union(lists)
    assert joined.index.tolist() == sorted(set(np.concatenate([one.index for one in lists]).tolist()))
    assert len(joined) > len(lists[0])
