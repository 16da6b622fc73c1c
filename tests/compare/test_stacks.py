"""Comparison with real images that are stacks of short exposures: trails with gaps."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure, Stack
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import FlightComparison, Search
from glstar.compare.flights import _sensor_of
from glstar.compare.prediction import predicted_trails
from glstar.config import Config
from glstar.errors import ConfigError, ImagesError
from glstar.images import ImageTime, RealImage
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.system.resources import asset

LENS = Camera(380, 285, 363.0, 363.0, 189.5, 142.0)
SENSOR = Sensor(reference_peak_dn=600.0, sky_std_dn=1.0)
CLOCK_S = 0.020
TURN_DEG = np.array([-0.25, 0.15, 0.20])


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    with GLRenderer.headless() as drawing:
        yield drawing


@pytest.fixture(scope="module")
def simulated() -> Simulator:
    flight = Config().open_flight(asset("adelaide.BIN"))
    return Simulator.of(flight, Sky(StarCatalogue.open("bsc5").brighter_than(4.5)), LENS, Mount(), SENSOR)


def stacked(stack: Stack = "sum", readout_s: float = 0.0) -> Exposure:
    return Exposure(0.0, 0.06, frames=4, gap_s=0.05, stack=stack, readout_s=readout_s)


@pytest.mark.parametrize(("stack", "readout_s"), [("sum", 0.0), ("mean", 0.0), ("sum", 0.0869)])
def test_clock_and_mount_are_recovered_from_stacks(
    stack: Stack, readout_s: float, tmp_path: Path, renderer: GLRenderer, simulated: Simulator
) -> None:
    """Images with a clock 20 ms ahead and a turned camera; their stars differ from the catalogue by 0.2 mag."""
    C_turn = matrix_from_quaternion(quaternion_from_turn(np.deg2rad(TURN_DEG)))
    rng, stars = np.random.default_rng(7), simulated.stars
    real = replace(
        simulated,
        mount=Mount.from_matrix(C_turn @ Mount().C_camera_body),
        stars=replace(stars, vmag=stars.vmag + rng.normal(0, 0.2, len(stars))),
    )
    images = []
    for number, start_s in enumerate([19.0, 31.0, 43.0, 62.0, 92.5, 120.0]):
        start_utc_s = simulated.flight.attitude.first_s + start_s
        exposure = replace(stacked(stack, readout_s), start_utc_s=start_utc_s)
        path = tmp_path / f"image_{number}.png"
        cv2.imwrite(str(path), renderer.render(real.scene(exposure), seed=500 + number).pixels)
        images.append(RealImage(path, ImageTime(start_utc_s + CLOCK_S, "a test", 0.06)))
    comparing = FlightComparison(
        simulated, renderer, images, stacked(stack, readout_s), search=Search(most_stars=16, time_s=0.05)
    )
    found = comparing.align(fit_time=True, fit_mount=True)
    assert found is not None
    assert -found.delay_s == pytest.approx(CLOCK_S, rel=0, abs=0.001)  # s
    assert np.rad2deg(found.turn_rad) == pytest.approx(TURN_DEG, rel=0, abs=0.02)  # deg
    pairs = comparing.run(found).pairs
    assert len(pairs) >= 20
    assert np.median([pair.centroid_px for pair in pairs]) < 0.3
    ratio = np.median([np.log(pair.peak_real_dn / pair.peak_simulated_dn) for pair in pairs if not pair.saturated])
    assert abs(ratio) < 0.15


@pytest.mark.parametrize("readout_s", [0.0, 0.0869])
def test_the_predicted_effect_of_a_delay_is_that_of_drawing_later(
    readout_s: float, renderer: GLRenderer, simulated: Simulator
) -> None:
    first_s, step_s = simulated.flight.attitude.first_s + 31.0, 0.004

    def trails(delay_s: float):
        exposure = replace(stacked(readout_s=readout_s), start_utc_s=first_s + delay_s, trail="sprites")
        scene = simulated.scene(exposure)
        return predicted_trails(
            scene, renderer.render(scene, seed=1, light=True), noise_dn=2.0, least_signal=10.0, most=20
        )

    before, at, after = trails(-step_s), trails(0.0), trails(step_s)
    common = [n for n in at.star_id.tolist() if n in before.star_id and n in after.star_id]
    assert len(common) >= 3
    for star_id in common:
        ends = [each.path_px[:, each.star_id == star_id][:, 0].mean(axis=0) for each in (before, after)]
        predicted = at.jacobian[at.star_id == star_id][0, :2, 3]
        assert tuple(predicted) == pytest.approx(tuple((ends[1] - ends[0]) / (2 * step_s)), rel=0.02, abs=1.0)  # px/s


def test_the_readout_time_of_stacks_is_not_fitted(renderer: GLRenderer, simulated: Simulator) -> None:
    comparing = FlightComparison(simulated, renderer, [], stacked())
    with pytest.raises(ConfigError, match="the readout time is fitted to single exposures") as error:
        comparing.align(fit_time=False, fit_mount=False, fit_readout=True)
    assert error.value.key == "exposure.frames"


@pytest.mark.parametrize(("over_dn", "is_refused"), [(0, False), (1, True)])
def test_a_stack_may_be_saturated_in_every_exposure_but_not_beyond(over_dn: int, is_refused: bool) -> None:
    sensor, exposure = Sensor(reference_vmag=3.0, reference_peak_dn=150.0, psf_sigma_px=1.2), stacked()
    pixels = np.zeros((4, 4), np.uint16)
    pixels[1, 2] = exposure.frames * sensor.saturation_dn + over_dn
    if is_refused:
        with pytest.raises(ImagesError, match=rf"has {pixels.max()} DN, and the sum of {exposure.frames} exposures"):
            _sensor_of(pixels, sensor, Path("a.png"), exposure)
    else:
        assert _sensor_of(pixels, sensor, Path("a.png"), exposure) is sensor


def test_a_stack_without_measurable_stars_has_no_trails(renderer: GLRenderer, simulated: Simulator) -> None:
    scene = simulated.scene(replace(stacked(), start_utc_s=simulated.flight.attitude.first_s + 31.0))
    frame = renderer.render(scene, seed=1, light=True)
    assert len(predicted_trails(scene, frame, noise_dn=1e5, least_signal=10.0, most=20)) == 0
