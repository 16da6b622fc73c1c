"""The report of ``glstar info`` on a log."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import glstar as gs
from glstar.config import Config
from glstar.flight import AttitudeTrack, mean_rate_hz
from glstar.rotation import euler_from_quaternion, quaternion_from_euler
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import (
    AttitudeSamples,
    ClockSamples,
    FlightOptions,
    LogFacts,
    PositionSamples,
    RateSamples,
    Samples,
    ScriptedFlight,
    TelemetrySource,
    survey,
)

LOGS = Path(__file__).parents[3] / "shared" / "logs"
DEG = np.pi / 180
ELEVEN_S = 1710068400.0  # 2024-03-10 11:00 UTC
ADELAIDE = Site(-34.93 * DEG, 138.60 * DEG, 48.0)
NONE = np.empty(0)


@dataclass
class GivenSource(TelemetrySource):
    """A source of given samples."""

    batches: list[Samples]
    name: str = "reported"

    def samples(self) -> Iterator[Samples]:
        yield from self.batches

    def facts(self) -> LogFacts:
        return LogFacts("a test", "ArduPlane", "ArduPlane V4.5.1")

    def close(self) -> None:
        pass


def turning(rate_deg_per_s: float = 30.0, segment: int = 0) -> AttitudeSamples:
    """Return two seconds at 50 Hz with a data gap from 1 to 1.5 s."""
    t = np.arange(0, 2, 0.02)
    t = t[(t <= 1.0) | (t >= 1.5)]
    q = quaternion_from_euler(0.0, 0.0, rate_deg_per_s * DEG * t)
    return AttitudeSamples(t, q, np.where(t < 1.8, 0, segment), "XKQ lane 0", "a switch of the EKF lane")


def test_the_survey_has_the_format_and_all_attitudes() -> None:
    clock = ClockSamples(np.array([0.0]), np.array([ELEVEN_S]), "GPS")
    place = PositionSamples(np.array([0.0]), np.array([-0.6]), np.array([2.4]), np.array([80.0]), "POS")
    gyros = RateSamples(np.arange(0, 2, 0.0025), np.zeros((800, 3)), "IMU 0")
    found, flight = survey(GivenSource([turning(segment=1), place, clock, gyros]))

    assert (found.format, found.vehicle, found.firmware) == ("a test", "ArduPlane", "ArduPlane V4.5.1")
    assert (found.utc_first, found.utc_last) == ("2024-03-10T11:00:00.000000Z", "2024-03-10T11:00:01.980000Z")
    assert (found.utc_source, found.position_source) == ("GPS", "POS")
    assert found.latitude_deg == pytest.approx(np.rad2deg(-0.6), abs=1e-6)
    assert found.gyros is not None
    assert found.gyros.rate_hz == pytest.approx(400.0)
    [attitude] = found.attitudes
    assert (attitude.rate_hz, attitude.gaps, attitude.longest_gap_s) == (50.0, 2, 0.5)
    assert attitude.largest_rate_deg_per_s == pytest.approx(30.0, abs=0.1)
    assert found.gap_counts == {"a data gap": 1, "a switch of the EKF lane": 1}
    assert [gap.start_s for gap in found.gaps] == [1.0, 1.78]
    assert found.light == "night"
    assert found.command == "glstar export reported -o frames"
    assert flight.attitude.first_s == ELEVEN_S


def test_the_survey_of_a_log_without_time_and_position_lists_the_missing_flags() -> None:
    nowhere = PositionSamples(NONE, NONE, NONE, NONE, "it has no GPS records")
    found, _ = survey(GivenSource([turning(), nowhere, ClockSamples(NONE, NONE, "its GPS never had a fix")]))

    assert (found.utc_first, found.utc_last, found.utc_source) == (None, None, "its GPS never had a fix")
    assert (found.latitude_deg, found.position_source) == (None, "it has no GPS records")
    assert (found.sun_altitude_deg, found.light) == (None, None)
    assert found.command.endswith("--utc-start UTC --lat LATITUDE --lon LONGITUDE")


def test_values_from_the_user_are_reported_as_given() -> None:
    found, _ = survey(GivenSource([turning()]), FlightOptions(utc_start=ELEVEN_S, site=ADELAIDE, max_gap_s=1.0))

    assert found.utc_source.startswith("given")
    assert found.gaps == ()
    assert found.sun_altitude_deg == pytest.approx(-22.7, abs=1.0)
    # New Moon was on 2024-03-10 at 09:00 UTC: the Moon is beside the Sun.
    assert found.moon_illuminated_fraction == pytest.approx(0.0, abs=0.01)
    assert found.moon_altitude_deg == pytest.approx(found.sun_altitude_deg, abs=6)


def test_the_altitude_of_the_sun_agrees_with_meeus() -> None:
    # Astronomical Algorithms, example 25.b: 1992 October 13 at 0 TD, apparent 198.378178, -7.783871 deg.  Over the
    # place of its culmination the altitude is 90 deg minus the difference of latitude and declination.
    utc_s = parse_utc("1992-10-12T23:59:00.816Z")
    at_greenwich = [sun_altitude_rad(utc_s, Site(0.0, lon * DEG)) for lon in np.arange(-180, 180, 0.25)]
    culminating = Site(-7.783871 * DEG, (-180 + 0.25 * int(np.argmax(at_greenwich))) * DEG)

    assert sun_altitude_rad(utc_s, culminating) == pytest.approx(90 * DEG, abs=0.14 * DEG)
    assert max(at_greenwich) == pytest.approx((90 - 7.783871) * DEG, abs=0.02 * DEG)


def test_euler_angles_come_back_from_their_quaternion() -> None:
    rng = np.random.default_rng(1)
    angles = rng.uniform(-1, 1, (3, 500)) * np.array([[np.pi], [1.55], [np.pi]])

    np.testing.assert_allclose(euler_from_quaternion(quaternion_from_euler(*angles)), angles, rtol=0, atol=1e-9)


def test_the_rates_of_a_track_are_body_rates() -> None:
    for axis, sign in ((0, 1.0), (1, 1.0), (2, -1.0)):
        t = np.arange(0, 1, 0.01)
        angles = np.zeros((3, t.size))
        angles[axis] = sign * 0.7 * t
        track = AttitudeTrack.from_samples(t, quaternion_from_euler(*angles))

        utc_s, rates = track.rates()

        expected = np.zeros(3)
        expected[axis] = sign * 0.7
        np.testing.assert_allclose(rates, np.broadcast_to(expected, rates.shape), rtol=0, atol=1e-9)
        np.testing.assert_allclose(utc_s, t[:-1] + 0.005, rtol=0, atol=1e-9)


def test_a_track_has_no_rates_across_its_gaps() -> None:
    track = ScriptedFlight.steady(ADELAIDE, ELEVEN_S, yaw_rate_rad_per_s=1.0).flight().attitude
    reported = turning(segment=1)
    broken = AttitudeTrack.from_samples(reported.clock_s, reported.q_body_ned, segment=reported.segment)

    assert len(track.rates()[0]) == track.utc_s.size - 1
    assert len(broken.rates()[0]) == reported.clock_s.size - 1 - 2


def test_the_command_for_sparse_attitude_has_a_better_interpolation() -> None:
    t = np.arange(0, 2, 0.1)
    rare = AttitudeSamples(t, quaternion_from_euler(0.0, 0.0, 0.1 * t), np.zeros(t.size, dtype=np.int64), "ATT")
    gyros = RateSamples(np.arange(0, 2, 0.0025), np.tile([0.0, 0.0, 0.1], (800, 1)), "IMU 0")

    plain, _ = survey(GivenSource([rare]), FlightOptions(utc_start=ELEVEN_S, site=ADELAIDE))
    measured, _ = survey(GivenSource([rare, gyros]), FlightOptions(utc_start=ELEVEN_S, site=ADELAIDE))
    chosen, _ = survey(
        GivenSource([rare, gyros]), FlightOptions(utc_start=ELEVEN_S, site=ADELAIDE, interpolation="gyro")
    )

    assert plain.command.endswith("--interpolation spline")
    assert measured.command.endswith("--interpolation gyro")
    assert chosen.command.endswith("-o frames")


def test_a_place_that_replaces_positions_of_the_log_is_noted() -> None:
    site = Site(latitude_rad=np.deg2rad(-30.0), longitude_rad=np.deg2rad(130.0), height_m=250.0)

    (note,) = gs.open_flight("demo", site=site).notes

    assert note == "the given place, at a height of 250 m, replaces the positions of the log (POS)"


def test_a_rate_is_the_mean_without_gaps() -> None:
    """A scheduler of 20 ms that sends 40 times a second: intervals of 20 and 40 ms, and a gap of 10 s."""
    steps_s = np.tile([0.02, 0.02, 0.02, 0.04], 500)  # 25 ms each, on average
    steps_s[1000] = 10.0
    times_s = np.concatenate(([0.0], np.cumsum(steps_s)))

    assert mean_rate_hz(times_s) == pytest.approx(40.0, rel=0, abs=0.01)
    assert mean_rate_hz(np.arange(1000) * 0.005) == pytest.approx(200.0, rel=0, abs=1e-6)


@pytest.mark.skipif(not LOGS.is_dir(), reason="needs the real logs of ../shared")
def test_the_rate_of_an_uneven_recording_is_its_samples_over_its_duration() -> None:
    found, _ = Config().survey_flight(LOGS / "plane_SITL_gnss_denied.tlog")

    rates = {attitude.name: (attitude.samples, attitude.rate_hz) for attitude in found.attitudes}
    assert rates["ATTITUDE_QUATERNION"] == (5958, pytest.approx(5957 / 148.919, rel=0, abs=0.02))
