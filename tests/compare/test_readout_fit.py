"""The readout time of a rolling shutter, fitted to images of the bundled flight."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure, Readout
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import Alignment, FlightComparison, Search, flights
from glstar.compare.prediction import predicted_trails
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.images import ImageTime, RealImage, TimeReference
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.rotation import matrix_from_quaternion, quaternion_from_euler, quaternion_from_turn
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.system.resources import asset
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = Camera(380, 285, 363.0, 363.0, 189.5, 142.0)
SENSOR = Sensor(reference_peak_dn=300.0, sky_std_dn=1.5)
EXPOSURE_S = 0.2
READOUT_S = 0.0869
CLOCK_S = 0.020
TURN_DEG = np.array([-0.25, 0.15, 0.20])


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    with GLRenderer.headless() as drawing:
        yield drawing


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


def simulator(flight: Flight) -> Simulator:
    return Simulator.of(flight, Sky(StarCatalogue.open("bsc5").brighter_than(4.5)), LENS, Mount(), SENSOR)


@dataclass(frozen=True)
class Hidden:
    """What the camera of the images did, unknown to the fit."""

    readout_s: float = READOUT_S
    readout: Readout = "down"
    clock_s: float = 0.0
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # The fraction of an exposure, from first opening to last closing, before the instant that its time states.
    before: float = 0.0


def fitted(
    folder: Path,
    renderer: GLRenderer,
    simulated: Simulator,
    hidden: Hidden,
    starts_s: list[float],
    *,
    readout: Readout = "down",
    reference: TimeReference = TimeReference.START,
    fit_time: bool = True,
    fit_mount: bool = True,
) -> Alignment:
    """Draw images with hidden errors and fit them with a global shutter as given."""
    comparing = compared(folder, renderer, simulated, hidden, starts_s, readout=readout, reference=reference)
    alignment = comparing.align(fit_time=fit_time, fit_mount=fit_mount, fit_readout=True)
    assert alignment is not None
    return alignment


def compared(
    folder: Path,
    renderer: GLRenderer,
    simulated: Simulator,
    hidden: Hidden,
    starts_s: list[float],
    *,
    readout: Readout = "down",
    reference: TimeReference = TimeReference.START,
) -> FlightComparison:
    """Draw images with hidden errors, to be fitted with a global shutter as given."""
    rng = np.random.default_rng(7)
    C_turn = matrix_from_quaternion(quaternion_from_turn(np.deg2rad(hidden.turn_deg)))
    stars = simulated.stars
    real = replace(
        simulated,
        mount=Mount.from_matrix(C_turn @ Mount().C_camera_body),
        stars=replace(stars, vmag=stars.vmag + rng.normal(0, 0.2, len(stars))),
    )
    first_s, images = simulated.flight.attitude.first_s, []
    for number, start_s in enumerate(starts_s):
        exposure = Exposure(first_s + start_s, EXPOSURE_S, readout_s=hidden.readout_s, readout=hidden.readout)
        frame = renderer.render(real.scene(exposure), seed=500 + number)
        path = folder / f"image_{number:02d}.png"
        cv2.imwrite(str(path), frame.pixels)
        utc_s = exposure.start_utc_s + hidden.before * exposure.span_s + hidden.clock_s
        images.append(RealImage(path, ImageTime(utc_s, "a test", EXPOSURE_S)))
    return FlightComparison(
        simulated,
        renderer,
        images,
        Exposure(first_s, EXPOSURE_S, readout=readout),
        reference=reference,
        search=Search(most_stars=16, time_s=0.05),
    )


@pytest.mark.parametrize("reference", list(TimeReference))
def test_a_search_for_the_readout_keeps_the_middle_of_the_image_if_the_clock_is_unknown(
    tmp_path: Path, renderer: GLRenderer, flight: Flight, monkeypatch: pytest.MonkeyPatch, reference: TimeReference
) -> None:
    """And the delay that it starts from is the one of the readout that was found."""
    comparing = compared(tmp_path, renderer, simulator(flight), Hidden(), [5.0, 9.0], reference=reference)
    middles_s = []

    def likely_readout(images, simulated, *, exposure_at, **_):
        middles_s.extend(exposure_at(0, readout_s).mid_utc_s for readout_s in (0.0, 0.03, 0.1, -0.05))
        return np.zeros(3), 0.03

    monkeypatch.setattr(flights, "likely_start", lambda *_, **__: (np.zeros(3), 0.01))
    monkeypatch.setattr(flights, "likely_readout", likely_readout)
    _, delay_s, _ = comparing._start([0, 1], fit_time=True, fit_readout=True)

    assert middles_s == pytest.approx(middles_s[:1] * 4, rel=0, abs=1e-6)
    assert comparing._exposure_at(0, delay_s, 0.03).mid_utc_s == pytest.approx(middles_s[0], rel=0, abs=1e-6)
    _, delay_s, _ = comparing._start([0, 1], fit_time=False, fit_readout=True)
    assert delay_s == 0.01


def test_readout_clock_and_mount_are_recovered_together(tmp_path: Path, renderer: GLRenderer, flight: Flight) -> None:
    hidden = Hidden(clock_s=CLOCK_S, turn_deg=tuple(TURN_DEG))
    starts_s = np.linspace(5.0, 125.0, 30).tolist()

    found = fitted(tmp_path, renderer, simulator(flight), hidden, starts_s)

    assert found.fitted_readout
    assert found.readout_s == pytest.approx(READOUT_S, rel=0, abs=0.001)  # s
    assert -found.delay_s == pytest.approx(CLOCK_S, rel=0, abs=0.001)  # s
    assert np.rad2deg(found.turn_rad) == pytest.approx(TURN_DEG, rel=0, abs=0.02)  # deg
    assert found.readout_std_s < 0.001
    assert abs(found.readout_s - READOUT_S) < 4 * found.readout_std_s
    assert not found.opens_opposite


def test_a_global_shutter_has_a_readout_of_zero_within_its_error(
    tmp_path: Path, renderer: GLRenderer, flight: Flight
) -> None:
    hidden = Hidden(readout_s=0.0, clock_s=CLOCK_S, turn_deg=tuple(TURN_DEG))

    found = fitted(tmp_path, renderer, simulator(flight), hidden, np.linspace(5.0, 125.0, 6).tolist())

    assert abs(found.readout_s) < 3 * found.readout_std_s
    assert found.readout_std_s < 0.001
    assert not found.opens_opposite


@pytest.mark.parametrize("reference", [TimeReference.START, TimeReference.END])
@pytest.mark.parametrize("fit_time", [True, False])
def test_rows_that_open_in_the_opposite_direction_have_a_negative_readout(
    tmp_path: Path, renderer: GLRenderer, flight: Flight, reference: TimeReference, fit_time: bool
) -> None:
    before = {TimeReference.START: 0.0, TimeReference.END: 1.0}[reference]
    hidden = Hidden(readout="left", clock_s=CLOCK_S if fit_time else 0.0, before=before)

    found = fitted(
        tmp_path,
        renderer,
        simulator(flight),
        hidden,
        [17.0, 37.0, 77.0, 91.0],
        readout="right",
        reference=reference,
        fit_time=fit_time,
        fit_mount=False,
    )

    assert found.readout_s == pytest.approx(-READOUT_S, rel=0, abs=0.001)  # s
    assert -found.delay_s == pytest.approx(hidden.clock_s, rel=0, abs=0.001)  # s
    assert found.opens_opposite
    assert found.notes == ()


def test_a_given_clock_does_not_hold_the_fit_in_the_wrong_direction(tmp_path: Path, renderer: GLRenderer) -> None:
    # A turn too slow for the coarse search: the fit starts from a global shutter.
    t = np.arange(0.0, 12.0, 1 / 50)
    slow = AttitudeTrack(NIGHT_UTC_S + t, quaternion_from_euler(np.deg2rad(2.0) * t, 0 * t, 0 * t + 1.0))
    simulated = simulator(Flight(slow, PositionTrack.fixed(ADELAIDE)))

    found = fitted(
        tmp_path, renderer, simulated, Hidden(readout="up"), [1.0, 4.0, 8.0], fit_time=False, fit_mount=False
    )

    assert found.readout_s == pytest.approx(-READOUT_S, rel=0, abs=max(0.002, 4 * found.readout_std_s))  # s
    assert found.opens_opposite


def test_an_aircraft_that_does_not_turn_gives_no_readout(tmp_path: Path, renderer: GLRenderer) -> None:
    t = np.arange(0.0, 12.0, 1 / 50)
    still = AttitudeTrack(NIGHT_UTC_S + t, quaternion_from_euler(0 * t, 0 * t, 0 * t + 1.0))
    straight = simulator(Flight(still, PositionTrack.fixed(ADELAIDE)))
    hidden = Hidden(turn_deg=tuple(TURN_DEG))

    found = fitted(tmp_path, renderer, straight, hidden, [1.0, 8.0])

    assert not found.fitted_readout
    assert found.readout_s == 0
    assert np.isnan(found.readout_std_s)
    assert found.notes == (
        "the aircraft hardly turned during the exposures, so the trails do not determine the clock's offset or the"
        " readout time; take images from a turn",
    )
    assert np.rad2deg(found.turn_rad) == pytest.approx(TURN_DEG, rel=0, abs=0.05)  # deg


@pytest.mark.parametrize("readout", ["down", "left"])
def test_the_predicted_effect_of_a_longer_readout_is_that_of_drawing_with_it(
    renderer: GLRenderer, readout: Readout
) -> None:
    sensor = Sensor(reference_peak_dn=2000.0, bit_depth=16)
    turn = {"roll_rate_rad_per_s": np.deg2rad(20.0), "refraction": False}
    turning = sky_over_adelaide(camera(800, 600, 967.7425), sensor=sensor, vmag_limit=5.0, **turn)

    def trails(readout_s: float):
        scene = turning.scene(Exposure(NIGHT_UTC_S + 0.4, 0.1, trail="sprites", readout_s=readout_s, readout=readout))
        frame = renderer.render(scene, seed=1, light=True)
        return predicted_trails(scene, frame, noise_dn=3.0, least_signal=10.0, most=20)

    step_s = 0.004
    before, at, after = trails(0.087 - step_s), trails(0.087), trails(0.087 + step_s)
    common = [n for n in at.star_id.tolist() if n in before.star_id and n in after.star_id]
    assert len(common) >= 2
    for star_id in common:
        ends = [each.path_px[:, each.star_id == star_id][:, 0] for each in (before, after)]
        lengths = [np.hypot(*np.diff(path, axis=0).T).sum() for path in ends]
        shift = (ends[1].mean(axis=0) - ends[0].mean(axis=0)) / (2 * step_s)
        predicted = at.jacobian[at.star_id == star_id][0, :3, 4]
        assert tuple(predicted[:2]) == pytest.approx(tuple(shift), rel=0.01, abs=1.0)  # px/s
        assert predicted[2] == pytest.approx((lengths[1] / lengths[0] - 1) / (2 * step_s), rel=0.05, abs=0.02)  # 1/s
