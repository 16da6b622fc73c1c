"""What a flight records beside its attitude: rates, positions, poses, events, triggers; and shifts of all its times."""

from dataclasses import fields, replace

import numpy as np
import pytest

from glstar.errors import ConfigError, TelemetryError
from glstar.flight.attitude import AttitudeTrack, Gap, mean_rate_hz
from glstar.flight.flight import (
    CameraTriggers,
    ClockQuality,
    EventKind,
    Flight,
    FlightEvents,
    GimbalAttitude,
    Pose,
    PositionTrack,
)
from glstar.rotation import quaternion_from_turn
from glstar.sky.place.site import Site

MODE, MESSAGE = EventKind.MODE, EventKind.MESSAGE


def turning(times_s: list[float], rates: list[float], **changes) -> AttitudeTrack:
    """Return a track that turns about the body's right axis at a rate in each interval."""
    angles = np.concatenate([[0.3], 0.3 + np.cumsum(np.diff(times_s) * rates)])
    q = quaternion_from_turn(angles[:, np.newaxis] * np.array([0.0, 1.0, 0.0]))
    return AttitudeTrack(np.array(times_s), q, **changes)


def test_rates_are_those_between_samples_without_gaps_and_short_intervals() -> None:
    times_s = [1000.0, 1000.25, 1000.5, 1000.625, 1000.75, 1002.0, 1002.25]
    rates = [0.5, 0.25, -0.5, 0.75, 0.125, 1.0]
    # The median interval is 0.25 s: one of 0.125 s is not longer than half of it.
    found_s, found = turning(times_s, rates, gaps=(Gap(1000.75, 1002.0, "a data gap"),)).rates()
    assert found_s.tolist() == [1000.125, 1000.375, 1002.125]
    np.testing.assert_allclose(found, [[0, rate, 0] for rate in (0.5, 0.25, 1.0)], rtol=0, atol=1e-9)
    short_s = [0.0, 0.2, 0.4, 0.49, 0.7, 0.9, 1.02]
    found_s, _ = turning(short_s, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).rates()
    np.testing.assert_allclose(found_s, [0.1, 0.3, 0.595, 0.8, 0.96], rtol=0, atol=1e-9)


def test_the_mean_rate_is_without_long_pauses() -> None:
    # Alternating intervals of 20 and 30 ms; pauses of more than 0.1 s do not count, unless slower samples are usual.
    steps_s = np.array([0.02, 0.03, 0.02, 0.03, 0.099, 0.02, 0.104])
    assert mean_rate_hz(np.cumsum(steps_s)) == pytest.approx(5 / (0.03 + 0.02 + 0.03 + 0.099 + 0.02))
    slow_s = np.array([0.0, 1.0, 1.0, 2.9, 3.1, 1.0])
    assert mean_rate_hz(5 + np.cumsum(slow_s)) == pytest.approx(4 / 5.9)


def position() -> PositionTrack:
    return PositionTrack(
        np.array([10.0, 20.0, 40.0]), np.array([0.1, 0.2, 0.5]), np.array([3.1, -3.1, -3.0]), np.array([5.0, 25.0, 0.0])
    )


def test_a_clipped_track_has_samples_at_both_ends() -> None:
    part = position().clipped(15.0, 30.0)
    west = 2 * np.pi - 3.1
    assert part.utc_s.tolist() == [15, 20, 30]
    np.testing.assert_allclose(part.latitude_rad, [0.15, 0.2, 0.35], rtol=0, atol=1e-12)
    np.testing.assert_allclose(part.longitude_rad, [(3.1 + west) / 2, west, west + 0.05], rtol=0, atol=1e-12)
    np.testing.assert_allclose(part.height_m, [15, 25, 12.5], rtol=0, atol=1e-12)
    assert position().clipped(10.0, 40.0).utc_s.tolist() == [10, 20, 40]
    assert position().clipped(0.0, 10.0).height_m.tolist() == [5, 5]


def test_tracks_of_positions_are_joined_and_cannot_be_changed() -> None:
    later = PositionTrack.joined([position(), replace(position(), utc_s=np.array([50.0, 60.0, 70.0]))])
    assert later.utc_s.tolist() == [10, 20, 40, 50, 60, 70]
    assert later.height_m.tolist() == [5, 25, 0] * 2
    for field in fields(PositionTrack):
        with pytest.raises(ValueError, match="read-only"):
            getattr(position(), field.name)[0] = 1.0
    with pytest.raises(TelemetryError) as caught:
        PositionTrack(np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(2))
    assert str(caught.value) == "a position track needs four columns of one length, not [(2,), (3,)]"
    with pytest.raises(TelemetryError) as caught:
        PositionTrack(*[np.zeros((1, 2))] * 4)
    assert str(caught.value) == "a position track needs four columns of one length, not [(1, 2)]"
    with pytest.raises(TelemetryError) as caught:
        PositionTrack.from_samples([1, 2], [1, 2], [1, 2, 3], [1, 2])
    assert str(caught.value) == "a position track needs four columns of one length, not [2, 2, 3, 2]"


def test_a_pose_has_a_unit_quaternion() -> None:
    site = Site(0.1, 0.2)
    np.testing.assert_allclose(Pose([2.0, -2.0, 4.0, -1.0], site).unit, [0.4, -0.4, 0.8, -0.2], rtol=0, atol=1e-15)
    for q in ([0.0, 0, 0, 0], [1.0, 0, 0], [[1.0, 0, 0, 0]], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]):
        with pytest.raises(ConfigError) as caught:
            _ = Pose(q, site).unit
        assert str(caught.value) == f"a pose's q_body_ned must be four finite numbers (w, x, y, z), not {q!r}"


def test_events_of_parts_are_joined_in_the_order_of_time() -> None:
    first = FlightEvents(np.array([1.0, 5.0]), (MODE, MESSAGE), ("LOITER", "hot"))
    second = FlightEvents(np.array([3.0, 5.0]), (MESSAGE, MODE), ("cold", "RTL"))
    joined = FlightEvents.joined([first, second])
    assert joined.utc_s.tolist() == [1, 3, 5, 5]
    assert joined.kinds == (MODE, MESSAGE, MESSAGE, MODE)
    assert joined.texts == ("LOITER", "cold", "hot", "RTL")
    assert FlightEvents.joined([]) is None
    assert FlightEvents.joined([replace(first, utc_s=np.zeros(0), kinds=(), texts=())]) is None


def test_triggers_of_parts_are_joined_by_camera_and_keep_numbers_that_are_unique() -> None:
    left = CameraTriggers(np.array([1.0, 2.0]), "CAM", "camera:1", np.array([4, 6]))
    right = CameraTriggers(np.array([1.5]), "TRIG", "camera:2", np.array([4]))
    later = replace(left, utc_s=np.array([8.0, 9.0, 9.5]), number=np.array([7, 9, 10]))
    joined = CameraTriggers.joined([left, right, later])
    assert [(one.camera, one.source, one.utc_s.tolist(), one.numbers.tolist()) for one in joined] == [
        ("camera:1", "CAM", [1, 2, 8, 9, 9.5], [4, 6, 7, 9, 10]),
        ("camera:2", "TRIG", [1.5], [4]),
    ]
    # Without a number in one part, or with one number twice, the order numbers the images.
    for other in (replace(later, number=None), replace(later, number=np.array([7, 6, 10]))):
        for parts in ([left, other], [other, left]):
            (one,) = CameraTriggers.joined(parts)
            assert (one.number, one.numbers.tolist()) == (None, [0, 1, 2, 3, 4])
    (none,) = CameraTriggers.joined([replace(left, number=None), replace(left, number=None)])
    assert none.number is None
    assert CameraTriggers.joined([]) == ()


def flight(*cameras: CameraTriggers, **changes) -> Flight:
    track = turning([10.0, 10.5, 11.0], [0.1, 0.2], gaps=(Gap(10.5, 11.0, "a jump"),))
    return Flight(track, position(), "log.bin", triggers=cameras, **changes)


def test_a_camera_is_chosen_by_its_name_or_as_the_only_one() -> None:
    one = CameraTriggers(np.arange(3.0), "CAM", "camera:1")
    two = CameraTriggers(np.arange(2.0), "TRIG", "camera:2")
    three = CameraTriggers(np.arange(4.0), "TRIG")
    assert flight(one).triggers_of("camera") is one
    assert flight(three).triggers_of("camera") is three
    assert flight(two, one).triggers_of("camera:1") is one
    cases = [
        (
            (),
            "camera",
            "log.bin does not say when a camera was triggered (CAM, TRIG, CAMERA_FEEDBACK, camera_capture,"
            " CameraInfo); leave out --at camera",
        ),
        (
            (one, two),
            "camera",
            "log.bin has triggers of 2 cameras; give one to --at: camera:1 (3 triggers), camera:2 (2 triggers)",
        ),
        (
            (three, two),
            "camera",
            "log.bin has triggers of 2 cameras; give one to --at: camera (4 triggers), camera:2 (2 triggers)",
        ),
        ((one,), "camera:7", "log.bin has no triggers of 'camera:7' (--at); it has camera:1 (3 triggers)"),
    ]
    for cameras, asked, message in cases:
        with pytest.raises(ConfigError) as caught:
            flight(*cameras).triggers_of(asked)
        assert str(caught.value) == message


def test_a_shift_moves_all_times_of_a_flight() -> None:
    triggers = CameraTriggers(np.array([1.0, 2.0]), "CAM", number=np.array([3, 4]))
    gimbal = GimbalAttitude(np.array([5.0]), np.array([[1.0, 0, 0, 0]]), np.array([True]), "GIMBAL")
    events = FlightEvents(np.array([7.0]), (MODE,), ("RTL",))
    own = turning([10.0, 12.0], [0.3], interpolation="spline")
    whole = flight(triggers, gimbal=gimbal, events=events, own_attitude=own, clocks=(ClockQuality(3, 0.1, 0.2),))

    later = whole.shifted(2.5)

    assert later.attitude.utc_s.tolist() == [12.5, 13, 13.5]
    assert later.attitude.gaps == (Gap(13.0, 13.5, "a jump"),)
    assert later.position.utc_s.tolist() == [12.5, 22.5, 42.5]
    assert (later.triggers[0].utc_s.tolist(), later.triggers[0].numbers.tolist()) == ([3.5, 4.5], [3, 4])
    assert (later.gimbal.utc_s.tolist(), later.events.utc_s.tolist()) == ([7.5], [9.5])
    assert later.own_attitude.utc_s.tolist() == [12.5, 14.5]
    np.testing.assert_allclose(later.own_attitude.at([13.1]), own.at([10.6]), rtol=0, atol=1e-12)
    assert (later.name, later.clocks, whole.position.utc_s.tolist()) == ("log.bin", whole.clocks, [10, 20, 40])
    assert later.aircraft_attitude is later.own_attitude
    plain = flight().shifted(1.0)
    assert (plain.gimbal, plain.own_attitude, plain.events, plain.aircraft_attitude) == (
        None,
        None,
        None,
        plain.attitude,
    )


def test_usual_values_of_a_flight_and_a_clock() -> None:
    plain = flight()
    sources = (
        plain.attitude_source,
        plain.position_source,
        plain.utc_source,
        Flight(plain.attitude, plain.position).name,
    )
    assert sources == ("given", "given", "given", "flight")
    assert (plain.time_offset_s, plain.notes, plain.clocks, plain.triggers) == (0.0, (), (), ())
    clock = ClockQuality(3, 0.1, 0.2)
    assert (clock.lag_s, clock.lag_is_measured, clock.cut) == (None, False, 0)


def test_a_track_without_a_spline_has_no_curve() -> None:
    assert turning([0.0, 1.0, 2.0], [0.1, 0.2])._curve is None
    bent = turning([0.0, 1.0, 2.0, 3.0], [0.1, 0.5, 0.1], interpolation="spline")
    assert bent._curve is not None
