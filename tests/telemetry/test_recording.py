"""Conversion of samples to a flight: one shift for all times of a clock."""

import numpy as np
import pytest

from glstar.flight.gyroaided import gyro_aided
from glstar.rotation import conjugate, multiply, quaternion_from_euler, turn_from_quaternion
from glstar.telemetry import FlightOptions, Recording
from glstar.telemetry.source import AttitudeSamples, ClockSamples, PositionSamples, RateSamples

UTC_MINUS_CLOCK_S = 1_710_068_370.0


def manoeuvre(t: np.ndarray) -> np.ndarray:
    """Return attitudes of rolls, pitches and turns up to 45 deg/s."""
    return quaternion_from_euler(0.6 * np.sin(1.3 * t), 0.15 * np.sin(0.7 * t + 1), 0.3 * t)


def measured(t: np.ndarray) -> np.ndarray:
    """Return the body rates of the manoeuvre, rad/s: central differences over 20 us."""
    after, before = manoeuvre(t + 1e-5), manoeuvre(t - 1e-5)
    return turn_from_quaternion(multiply(after, conjugate(before))) / 2e-5


@pytest.fixture
def recording() -> Recording:
    """Return attitude at 5 Hz, gyro rates at 200 Hz and a fix a second; the clock is 30 s at 11:00 UTC."""
    t, rate_t, fixes = np.arange(30.0, 40.0, 0.2), np.arange(30.0, 40.0, 0.005), np.arange(30.0, 40.0)
    return Recording(
        name="log",
        attitude=AttitudeSamples(t, manoeuvre(t), np.zeros(t.size, dtype=np.int64), "attitude"),
        position=PositionSamples(fixes, np.full(10, -0.6), np.full(10, 2.4), 10 * fixes, "position"),
        clock=ClockSamples(fixes, fixes + UTC_MINUS_CLOCK_S, "clock"),
        rates=RateSamples(rate_t, measured(rate_t), "gyros"),
    )


def test_attitude_and_position_are_converted_to_utc_together(recording: Recording) -> None:
    flight = recording.flight()

    utc_s = UTC_MINUS_CLOCK_S + 35.0
    np.testing.assert_allclose(flight.attitude.at([utc_s])[0], manoeuvre(np.array(35.0)), rtol=0, atol=1e-6)
    assert flight.position.at(utc_s).height_m == pytest.approx(350.0, abs=1e-5)


def test_gyro_rates_are_converted_to_utc_with_the_attitude(recording: Recording) -> None:
    """At 5 Hz, attitude interpolated without gyro rates has errors of degrees."""
    clock_s = np.arange(30.5, 39.0, 0.013)

    aided = recording.flight(FlightOptions(interpolation="gyro")).attitude.at(clock_s + UTC_MINUS_CLOCK_S)

    expected = gyro_aided(
        recording.attitude.clock_s,
        recording.attitude.q_body_ned,
        recording.rates.clock_s,
        recording.rates.rate_rad_per_s,
    ).at(clock_s)
    error_rad = np.linalg.norm(turn_from_quaternion(multiply(aided, conjugate(expected))), axis=-1)
    # UTC in float64 is rounded to a microsecond; the turn rate is 45 deg/s.
    assert error_rad.max() < 2e-6
    truth_rad = np.linalg.norm(turn_from_quaternion(multiply(aided, conjugate(manoeuvre(clock_s)))), axis=-1)
    assert truth_rad.max() < 1e-5


def test_one_wrong_reading_of_utc_changes_nothing(recording: Recording) -> None:
    recording.clock.utc_s[3] += 3600.0

    assert recording.utc_minus_clock_s == pytest.approx(UTC_MINUS_CLOCK_S, abs=1e-6)
