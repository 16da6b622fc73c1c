"""Division of exposures into the segments of analytic trails."""

import numpy as np
import pytest

from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.motion.segmentation import segment_times
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(1014, 760, 967.7425)


def rolling(t: np.ndarray, roll_rad: np.ndarray) -> Simulator:
    still = sky_over_adelaide(LENS)
    q = quaternion_from_euler(roll_rad, np.zeros_like(roll_rad), np.zeros_like(roll_rad))
    flight = Flight(AttitudeTrack.from_samples(NIGHT_UTC_S + t, q), PositionTrack.fixed(ADELAIDE))
    return Simulator.of(flight, still.sky, LENS, Mount(), still.sensor)


def cut(simulator: Simulator, opens_s: float, samples_s: np.ndarray) -> np.ndarray:
    """Return the ends of the segments of an exposure of 0.5 s, seconds after its start."""
    nodes_s = NIGHT_UTC_S + np.concatenate(
        [[opens_s], samples_s[(samples_s > opens_s) & (samples_s < opens_s + 0.5)], [opens_s + 0.5]]
    )
    times_s = segment_times(simulator.motion, nodes_s, LENS, 1.2)
    assert times_s is not None
    assert times_s[1::2] == pytest.approx((times_s[:-1:2] + times_s[2::2]) / 2, abs=1e-6)
    return times_s[::2] - nodes_s[0]


@pytest.mark.parametrize("deg_per_s", [10.0, 60.0, 100.0, 200.0, 300.0])
@pytest.mark.parametrize("samples", [3, 101, 801])
def test_a_uniform_rotation_has_equal_segments_at_any_log_rate(deg_per_s, samples):
    t = np.linspace(0.0, 1.0, samples)
    cuts_s = cut(rolling(t, np.deg2rad(deg_per_s) * t - 0.9), 0.21, t)
    parts = np.diff(cuts_s)
    if samples < 200:
        assert np.ptp(parts) < 1e-5
        assert len(parts) <= 2 + 0.08 * deg_per_s
    else:  # with more samples a segment that was just acceptable may be divided once more
        assert len(parts) <= 2 + 0.12 * deg_per_s


@pytest.mark.parametrize("periods", [1, 4, 8, 16])
def test_a_vibration_in_phase_with_the_exposure_has_two_segments_per_period(periods):
    """Too few evenly spaced samples would all fall on one phase, where the aircraft seems not to move."""
    t = np.linspace(0.0, 1.0, 401)
    shaking = rolling(t, np.deg2rad(0.5) * np.sin(2 * np.pi * 2 * periods * (t - 0.25)))
    assert len(cut(shaking, 0.25, t)) - 1 >= 2 * periods


def test_a_rotation_that_starts_at_a_sample_is_divided_there():
    t = np.array([0.0, 0.43, 1.0])
    cuts_s = cut(rolling(t, np.array([0.0, 0.0, np.deg2rad(30.0)])), 0.21, t)
    assert np.abs(cuts_s - 0.22).min() < 1e-6
    # Before that a single segment suffices.
    assert np.count_nonzero(cuts_s < 0.22 - 1e-6) == 1


@pytest.mark.parametrize("sample_s", [0.211, 0.709])
def test_a_rotation_that_slows_just_after_the_start_or_before_the_end_is_divided_there(sample_s):
    """Evenly spaced samples see nothing of such a part, which was too bright by as much as its rate is lower.

    At 10 deg/s a single segment would do for the rest of the exposure.
    """
    t = np.array([0.0, sample_s, 1.0])
    slower = np.deg2rad(10.0) * np.array([0.95, 1.0] if sample_s < 0.5 else [1.0, 0.95])
    cuts_s = cut(rolling(t, np.concatenate([[0.0], np.cumsum(slower * np.diff(t))])), 0.21, t)
    assert np.abs(cuts_s - (sample_s - 0.21)).min() < 1e-6
