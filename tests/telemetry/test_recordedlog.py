"""Samples in memory become a flight: boots, positions, clocks, remarks, and the report of ``glstar info``."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.flight import ClockQuality, EventKind, PositionTrack
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import format_utc
from glstar.telemetry import source, survey
from glstar.telemetry.recordedlog import BootSummary, RecordedLog
from glstar.telemetry.recording import FlightOptions, Recording
from glstar.telemetry.source import (
    AttitudeSamples,
    Boot,
    ClockSamples,
    EventSamples,
    GimbalSamples,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
    TriggerSamples,
)
from glstar.telemetry.survey import AttitudeSurvey, GapSurvey, GyroSurvey, TriggerSurvey
from glstar.telemetry.tracks import GivenTrack

UTC_S = 1710068400.0  # 2024-03-10 11:00:00
HOME = Site(latitude_rad=-0.6, longitude_rad=2.4, height_m=50.0)


class Script(TelemetrySource):
    """Batches of samples as a source."""

    name = "x/log.bin"

    def __init__(self, *batches: Samples, boots: tuple[Boot, ...] = (Boot(1),), one_clock: bool = False) -> None:
        self._batches, self._boots, self.one_clock = batches, boots, one_clock

    def samples(self) -> Iterator[Samples]:
        yield from self._batches

    def boots(self) -> tuple[Boot, ...]:
        return self._boots

    def facts(self, boots: object = ()) -> source.LogFacts:
        return source.LogFacts("a format", f"vehicle {list(boots)}", "fw", "EKF3", unread_bytes=0)

    def close(self) -> None:
        """Do nothing."""


def attitude(
    first_s: float = 30.0, count: int = 21, step_s: float = 0.5, boot: int = 1, deg_per_s: float = 4.0, **more: object
) -> AttitudeSamples:
    clock_s = first_s + step_s * np.arange(count)
    q = quaternion_from_euler(0.1 + 0 * clock_s, 0.2 + 0 * clock_s, np.deg2rad(deg_per_s) * clock_s)
    return AttitudeSamples(clock_s, q, np.zeros(count, dtype=np.int64), "att", boot=boot, **more)


def position(first_s: float = 30.0, count: int = 6, boot: int = 1, **more: object) -> PositionSamples:
    clock_s = first_s + 2.0 * np.arange(count)
    fields = {"latitude_rad": -0.6 + 1e-6 * np.arange(count), "longitude_rad": np.full(count, 2.4)}
    fields |= {"height_m": 50.0 + np.arange(count), "source": "pos"}
    return PositionSamples(clock_s, **fields | more, boot=boot)


def clock(off_s: float | Float = UTC_S - 30, first_s: float = 30.0, boot: int = 1, **more: object) -> ClockSamples:
    clock_s = first_s + np.arange(5.0)
    return ClockSamples(clock_s, clock_s + off_s, "gps", boot, **more)


def log(*batches: Samples, **more: object) -> RecordedLog:
    return RecordedLog.read(Script(*batches, **more))


# --- a recording ----------------------------------------------------------------------------------------------------
def test_a_recording_is_the_samples_of_a_boot_by_kind() -> None:
    trigger = TriggerSamples(np.array([31.0]), np.array([np.nan]), "CAM")
    gimbals = [
        GimbalSamples(np.array([31.0, 32.0]), np.tile([1.0, 0, 0, 0], (2, 1)), np.array([True, False]), name)
        for name in ("one", "two")
    ]
    events = EventSamples.of(EventKind.MESSAGE, np.array([33.0]), ["hello"])
    first, second = attitude(30.0, 3, notes=("a", "b")), attitude(40.0, 4, notes=("b", "c"))
    rates = RateSamples(np.array([30.0, 31.0]), np.array([[1.0, 2, 3], [4, 5, 6]]), "gyr")
    every = [first, second, position(), position(50.0, boot=2), clock(), clock(first_s=40.0), rates, trigger, *gimbals]
    of = Recording.of("log", [*every, events], 7)

    assert (of.name, of.boot) == ("log", 7)
    np.testing.assert_array_equal(of.attitude.clock_s, [*first.clock_s, *second.clock_s])
    np.testing.assert_array_equal(of.attitude.q_body_ned, [*first.q_body_ned, *second.q_body_ned])
    assert (of.attitude.segment.tolist(), of.attitude.notes) == ([0] * 7, ("a", "b", "c"))
    assert (of.attitude.source, of.attitude.break_reason) == ("att", "a reset of the estimator")
    assert of.position.clock_s.size == 12
    assert of.clock.clock_s.tolist() == [30, 31, 32, 33, 34, 40, 41, 42, 43, 44]
    np.testing.assert_array_equal(of.rates.rate_rad_per_s, rates.rate_rad_per_s)
    assert (of.triggers, of.gimbal, of.events) == ((trigger,), gimbals[0], (events,))
    assert [of.position.source, of.clock.source, of.rates.source] == ["pos", "gps", "gyr"]
    nothing = Recording.of("log", [])
    assert [nothing.attitude.q_body_ned.shape, nothing.rates.rate_rad_per_s.shape] == [(0, 4), (0, 3)]
    assert (nothing.attitude.source, nothing.position.source, nothing.gimbal) == ("", "", None)
    why = Recording.of("log", [source.no_clock_samples("none"), clock(), source.no_position_samples("no fix")])
    assert (why.clock.source, why.position.source) == ("gps", "no fix")


def test_a_flight_needs_two_attitudes() -> None:
    for count in (0, 1):
        with pytest.raises(LogFormatError) as caught:
            Recording.read(Script(attitude(count=count)))
        message = f"x/log.bin: a flight needs two attitude samples or more; this log has {count}"
        assert str(caught.value) == message
        with pytest.raises(LogFormatError) as caught:
            log(attitude(count=count), attitude(boot=2, count=0))
        assert str(caught.value) == message
    assert Recording.read(Script(attitude(count=2))).attitude.clock_s.size == 2
    with pytest.raises(LogFormatError, match="this log has 0"):
        log()


def test_positions_are_sorted_finite_and_flyable() -> None:
    place = position(30.0, 8)
    place.latitude_rad[3] += 0.1
    place.height_m[5] = np.nan
    late = position(20.0, 2, height_m=np.array([60.0, 61.0]))
    of = Recording.of("log", [place, late])
    assert of.position.clock_s.tolist() == [20, 22, 30, 32, 34, 38, 42, 44]
    assert of.position_notes == ("1 of 9 positions are too far from the others for an aircraft, and are left out",)
    lost = position(30.0, 6, height_m=np.array([500.0, 501, 0, 0, 504, 505]))
    of = Recording.of("log", [lost])
    np.testing.assert_allclose(of.position.height_m, [500, 501, 502, 503, 504, 505], rtol=1e-12)
    note = "2 of 6 heights are 0 m between others that are not: they are interpolated"
    assert of.position_notes == (note,)
    other = position(31.0, 6, latitude_rad=np.full(6, 0.5))
    two = Recording.of("log", [position(), other])
    assert two.position.clock_s.size == 0
    assert two.position.source.startswith("its positions are of two places, 6 at ")
    assert two.position_notes == ()


def test_utc_is_the_median_of_the_readings() -> None:
    off_s = np.array([5.0, 5.25, 90.0, 5.5, 5.125])
    of = Recording.of("log", [clock(off_s)])
    assert of.utc_minus_clock_s == 5.25
    assert of.clock_quality == (
        ClockQuality(5, round(float(np.percentile([0.25, 0, 84.75, 0.25, 0.125], 95)), 6), 84.75),
    )
    lagging = clock(off_s, lag_s=0.1234567, lag_is_measured=True, cut=3, notes=("n",), utc_minus_clock_s=7.5)
    of = Recording.of("log", [clock(6.0, cut=4, notes=("n", "m")), lagging])
    assert (of.utc_minus_clock_s, of.clock.cut, of.clock.notes) == (7.5, 7, ("n", "m"))
    [quality] = of.clock_quality
    assert (quality.lag_s, quality.lag_is_measured, quality.cut, quality.readings) == (0.123457, True, 7, 10)
    assert Recording.of("log", []).utc_minus_clock_s is None
    assert Recording.of("log", [clock(0.0)]).clock_quality == ()
    one = ClockSamples(np.array([3.0]), np.array([9.0]), "x")
    assert Recording.of("log", [one]).clock_quality == ()
    assert len(Recording.of("log", [one, one]).clock_quality) == 1


def test_a_flight_is_by_the_utc_of_the_log_or_of_the_user() -> None:
    trigger = TriggerSamples(np.array([31.0, 32.0]), np.array([np.nan, np.nan]), "CAM", notes=("of a trigger",))
    gyros = RateSamples(np.array([30.0, 30.25, 31.0]), np.zeros((3, 3)), "gyr")
    events = EventSamples.of(EventKind.MESSAGE, np.array([33.0]), ["hello"])
    of = Recording.of(
        "a/log.bin", [attitude(notes=("of att",)), position(), clock(notes=("of clock",)), trigger, gyros, events]
    )
    flight = of.flight()
    assert (flight.name, flight.attitude_source) == ("log.bin", "att, 2.0 Hz")
    assert (flight.position_source, flight.utc_source) == ("pos", "gps")
    assert (flight.attitude.first_s, flight.attitude.last_s) == (UTC_S, UTC_S + 10)
    assert flight.position.at(UTC_S + 4).height_m == pytest.approx(52.0, abs=1e-5)
    assert flight.triggers[0].utc_s.tolist() == [UTC_S + 1, UTC_S + 2]
    assert flight.events.utc_s.tolist() == [UTC_S + 3]
    assert flight.notes == ("of att", "of clock", "of a trigger")
    assert len(flight.clocks) == 1
    given = of.flight(FlightOptions(utc_start=UTC_S + 1000, time_offset_s=7.5))
    assert (given.attitude.first_s, given.time_offset_s, given.clocks) == (UTC_S + 1000, 7.5, ())
    assert given.utc_source == f"given: the first attitude at {format_utc(UTC_S + 1000)}"
    assert given.notes == ("of att", "of a trigger")
    assert given.triggers[0].utc_s.tolist() == [UTC_S + 1001, UTC_S + 1002]
    for site, height in ((HOME, "50 m"), (replace(HOME, height_m=0.0), "0 m (--height gives another)")):
        placed = of.flight(FlightOptions(site=site))
        assert placed.position_source == "given"
        replaced = f"the given place, at a height of {height}, replaces the positions of the log (pos)"
        assert placed.notes == ("of att", "of clock", replaced, "of a trigger")
        assert placed.position.at(UTC_S).height_m == site.height_m
    assert of.attitude_source("spline") == "att, 2.0 Hz, between samples by a spline"
    assert of.attitude_source("gyro") == "att, 2.0 Hz, between samples by the gyros (gyr, 2.0 Hz)"


def test_triggers_with_utc_of_their_own_keep_their_distance_from_the_attitude() -> None:
    trigger = TriggerSamples(np.array([31.0, 32.0]), np.array([UTC_S + 1.25, np.nan]), "CAM")
    of = Recording.of("log", [attitude(), position(), clock(), trigger])
    assert of.flight().triggers[0].utc_s.tolist() == [UTC_S + 1.25, UTC_S + 2]
    assert of.flight(FlightOptions(utc_start=UTC_S + 1000)).triggers[0].utc_s.tolist() == [
        UTC_S + 1001.25,
        UTC_S + 1002,
    ]
    without = Recording.of("log", [attitude(), position(), trigger])
    assert without.flight(FlightOptions(utc_start=UTC_S)).triggers[0].utc_s.tolist() == [UTC_S + 1, UTC_S + 2]


def test_remarks_on_positions_are_those_of_a_flight_that_uses_them() -> None:
    lost = position(30.0, 6, height_m=np.array([500.0, 501, 0, 0, 504, 505]))
    of = Recording.of("log", [attitude(), lost, clock()])
    assert of.flight().notes == ("2 of 6 heights are 0 m between others that are not: they are interpolated",)
    assert of.flight(given(*(UTC_S + np.arange(11.0)))).notes == ("own",)


def test_the_report_has_milliseconds_and_hundredths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(b"x")
    monkeypatch.setattr(Script, "name", str(path))
    one = attitude(count=12, step_s=0.12345678, deg_per_s=4.56)
    clock_s = one.clock_s + np.where(np.arange(12) >= 6, 3.14159265, 0.0)
    gyros = RateSamples(clock_s, np.zeros((12, 3)), "gyr")
    report, _ = survey(Script(replace(one, clock_s=clock_s), position(), clock(), gyros))
    assert report.duration_s == 4.5  # 1.35802458 + 3.14159265 = 4.49961723
    assert (report.gaps[0].start_s, report.gaps[0].duration_s) == (0.617, 3.265)
    [survey_of] = report.attitudes
    assert (survey_of.rate_hz, survey_of.duration_s, survey_of.longest_gap_s) == (8.1, 4.5, 3.265)
    assert survey_of.largest_rate_deg_per_s == 4.6
    assert report.gyros.rate_hz == 8.1
    # Positions are at 2 s: half of the flight is 1.12490431 of them.
    assert report.latitude_deg == round(np.rad2deg(-0.6 + 1.12490431e-6), 6)
    assert report.longitude_deg == 137.509871


GIVE_UTC = "give the UTC of its first attitude as utc_start (--utc-start)"
GIVE_PLACE = "its position as latitude_deg and longitude_deg (--lat, --lon)"


@pytest.mark.parametrize(
    ("batches", "options", "message"),
    [
        ([], FlightOptions(), f"no UTC and no position; {GIVE_UTC} and {GIVE_PLACE}"),
        ([source.no_clock_samples("why")], FlightOptions(site=HOME), f"no UTC (why); {GIVE_UTC}"),
        ([clock()], FlightOptions(), f"no position; give {GIVE_PLACE}"),
        ([source.no_position_samples("why")], FlightOptions(utc_start=5.0), f"no position (why); give {GIVE_PLACE}"),
    ],
)
def test_everything_that_is_missing_is_named(batches: list[Samples], options: FlightOptions, message: str) -> None:
    with pytest.raises(LogFormatError) as caught:
        Recording.of("log", [attitude(), *batches]).flight(options)
    assert str(caught.value) == f"log: the log has {message}"


# --- a track beside a log -------------------------------------------------------------------------------------------
def given(*utc_s: float) -> FlightOptions:
    times_s = np.array(utc_s)
    track = PositionTrack.from_samples(times_s, np.full(times_s.size, -0.6), np.full(times_s.size, 2.4), times_s * 0)
    return FlightOptions(track=GivenTrack(track, "t.gpx", times_s, ("own",)))


def notes(options: FlightOptions, duration_s: float = 1000.0) -> tuple[str, ...]:
    count = round(duration_s) + 1
    track = Recording.of("log", [attitude(count=count, step_s=1.0), clock()]).attitude_track(UTC_S - 30)
    return options.notes(track, "log")


def every(first_s: float, last_s: float, step_s: float) -> Float:
    return UTC_S + np.arange(first_s, last_s + step_s / 2, step_s)


@pytest.mark.parametrize(
    ("first_s", "last_s", "remark"),
    [
        (0.0, 1000.0, None),
        (4.9, 995.1, None),
        (5.1, 1000.0, "begins 5 s after the flight begins and ends 0 s before it ends"),
        (0.0, 994.9, "begins 0 s after the flight begins and ends 5 s before it ends"),
        (-50.0, 900.0, "begins 0 s after the flight begins and ends 100 s before it ends"),
    ],
)
def test_a_track_that_is_shorter_than_the_flight_is_reported(first_s: float, last_s: float, remark: str | None) -> None:
    said = notes(given(*np.linspace(UTC_S + first_s, UTC_S + last_s, 200)))
    assert said == ("own", *([f"the track t.gpx {remark}; there its nearest fix is used"] if remark else []))
    assert FlightOptions().notes(None, "log") == ()


@pytest.mark.parametrize(("gap_s", "is_reported"), [(290.0, False), (310.0, True)])
def test_a_track_with_a_gap_is_reported(gap_s: float, is_reported: bool) -> None:
    said = notes(given(*every(-5, 200, 5), *every(200 + gap_s, 1010, 5)))
    gap = "the track t.gpx has no fix for 5 min of the flight; there it is interpolated"
    assert said == ("own", *([gap] if is_reported else []))


def test_a_track_of_another_time_is_refused() -> None:
    flight = f"from {format_utc(UTC_S)} to {format_utc(UTC_S + 1000)}"
    weeks_s = 1024 * 7 * 86400.0
    for first_s, last_s, rolled in (
        (1000.5, 1100.0, ""),
        (-200.0, -0.5, ""),
        (5 - weeks_s, 1005 - weeks_s, "; its dates are 1024 weeks early, as of a receiver whose week has rolled over"),
        (-3000 - weeks_s, -1 - weeks_s, ""),
        (1001 - weeks_s, 3000 - weeks_s, ""),
    ):
        with pytest.raises(LogFormatError) as caught:
            notes(given(UTC_S + first_s, UTC_S + last_s))
        track = f"from {format_utc(UTC_S + first_s)} to {format_utc(UTC_S + last_s)}"
        assert str(caught.value) == f"log: the track t.gpx lies {track}, the flight {flight}{rolled}"
    assert notes(given(UTC_S - 200, UTC_S)) != ()
    hours_s = 4 * 3600.0
    with pytest.raises(LogFormatError) as caught:
        notes(given(UTC_S - 100, UTC_S + hours_s + 100))
    said = f"log: the track t.gpx has no fix during the flight {flight}, and for 4.1 h around it"
    assert str(caught.value) == said
    assert notes(given(UTC_S - 100, UTC_S + hours_s - 300))[0] == "own"
    assert notes(given(UTC_S - 100, UTC_S + 5, UTC_S + hours_s + 100))[0] == "own"


# --- several boots --------------------------------------------------------------------------------------------------
TWO = (Boot(1), Boot(2))
THREE = (Boot(1), Boot(2), Boot(3))
DAY_S = 86400.0


def boot_of(number: int, utc_s: float | None, count: int = 21, *, placed: bool = True) -> list[Samples]:
    """Return a boot whose clock begins at 30 s at some UTC, relative to the start."""
    parts: list[Samples] = [attitude(count=count, boot=number)]
    parts.append(source.no_clock_samples("no gps") if utc_s is None else clock(UTC_S + utc_s - 30, boot=number))
    parts[-1] = replace(parts[-1], boot=number)
    parts.append(position(boot=number) if placed else replace(source.no_position_samples("no fix"), boot=number))
    return parts


HOLDS = "the log holds {} boots of the autopilot; this flight is {} (--boot N takes one)"


def read(*boots: list[Samples], **more: object) -> tuple[list[float], tuple[str, ...]]:
    """Return when the parts of the flight begin, s after the start, and its notes."""
    numbers = tuple(Boot(k + 1) for k in range(len(boots)))
    flight = log(*(batch for boot in boots for batch in boot), **{"boots": numbers} | more).flight()
    begins = [flight.attitude.first_s, *(gap.start_utc_s + gap.duration_s for gap in flight.attitude.gaps)]
    return [round(begin - UTC_S, 3) for begin in begins], flight.notes


def test_two_boots_are_one_flight_with_a_gap() -> None:
    begins, said = read(boot_of(1, 0.0), boot_of(2, 100.0))
    assert (begins, said) == ([0, 100], (HOLDS.format(2, "boots 1 and 2"),))
    begins, said = read(boot_of(1, 100.0), boot_of(2, 0.0), boot_of(3, 50.0))
    assert (begins, said) == ([0, 50, 100], (HOLDS.format(3, "boots 1, 2 and 3"),))


@pytest.mark.parametrize(
    ("second", "why"),
    [
        (boot_of(2, 9.9, 5), "2.0 s, is left out: it is at the same time as boot 1; --boot 2"),
        (boot_of(2, 10.0, 5), "2.0 s, is left out: it is at the same time as boot 1; --boot 2"),
        (boot_of(2, -2.0, 5), "2.0 s, is left out: it is at the same time as boot 1; --boot 2"),
        (boot_of(2, DAY_S + 10.1, 5), "2.0 s, is left out: it is 1.0 days after boot 1; --boot 2"),
        (boot_of(2, -DAY_S - 2.1, 5), "2.0 s, is left out: it is 1.0 days before boot 1; --boot 2"),
        (boot_of(2, None, 5), "2.0 s, is left out: it has no UTC (no gps); --boot 2 --utc-start TIME"),
        (boot_of(2, 50.0, 5, placed=False), "2.0 s, is left out: it has no position (no fix); --boot 2"),
    ],
)
def test_why_a_boot_is_left_out(second: list[Samples], why: str) -> None:
    begins, said = read(boot_of(1, 0.0), second)
    assert (begins, said) == ([0], (HOLDS.format(2, "boot 1"), f"boot 2, {why} takes it"))


@pytest.mark.parametrize("utc_s", [10.1, DAY_S + 9.9, -2.1, -DAY_S - 1.9])
def test_boots_within_a_day_are_one_flight(utc_s: float) -> None:
    assert read(boot_of(1, 0.0), boot_of(2, utc_s, 5))[0] == sorted([0, utc_s])


def test_the_longest_boots_are_the_flight() -> None:
    begins, said = read(boot_of(1, 0.0, 5), boot_of(2, 1.0, 30))
    assert begins == [1]
    assert said[1] == "boot 1, 2.0 s, is left out: it is at the same time as boot 2; --boot 1 takes it"
    # Two shorter boots of one day are longer together.
    begins, said = read(boot_of(1, 0.0, 21), boot_of(2, 5 * DAY_S, 15), boot_of(3, 5 * DAY_S + 100, 15))
    assert begins == [5 * DAY_S, 5 * DAY_S + 100]
    assert said[1] == "boot 1, 10.0 s, is left out: it is 5.0 days before boot 2; --boot 1 takes it"
    only = log(*boot_of(1, None, 21), *boot_of(2, None, 31), boots=TWO)
    assert only.flight(FlightOptions(utc_start=UTC_S)).notes[1] == (
        "boot 1, 10.0 s, is left out: without UTC its time relative to boot 2 is not known; --boot 1 --utc-start TIME"
        " takes it"
    )
    assert only.longest.boot == 2
    equal = log(*boot_of(1, None), *boot_of(2, None), boots=TWO)
    assert [boot.boot for boot in equal.recordings_of_flight()] == [1]


def test_boots_in_doubt_and_without_attitude_are_left_out() -> None:
    boots = (Boot(1), Boot(2, doubt="a doubt"), Boot(3))
    begins, said = read(boot_of(1, 0.0), boot_of(2, 100.0), boot_of(3, 200.0, 1), boots=boots)
    assert (begins, said) == (
        [0],
        (
            HOLDS.format(3, "boot 1"),
            "boot 2, 10.0 s, is left out: a doubt; --boot 2 takes it",
            "boot 3 is left out: it has fewer than two attitudes",
        ),
    )
    assert read(boot_of(1, 0.0), boots=(Boot(1, doubt="a doubt"),))[1] == ()
    assert read([*boot_of(1, 0.0), *boot_of(2, 100.0)], boots=boots[:2])[0] == [0]


def test_boots_on_one_clock_share_utc_and_positions_within_an_hour() -> None:
    first = [attitude(), clock(), position()]
    for gap_s, begins in ((3590.0, [0, 3600]), (3610.0, [0])):
        second = attitude(40.0 + gap_s, 5, boot=2)
        assert read(first, [second], one_clock=True)[0] == begins
    assert read(first, [attitude(40.0 - 3600, 5, boot=2)], one_clock=True)[0] == [-3590, 0]
    flight = log(*first, attitude(60.0, 5, boot=2), boots=TWO, one_clock=True).flight(
        FlightOptions(utc_start=UTC_S + 5)
    )
    assert (flight.attitude.first_s, flight.attitude.last_s) == (UTC_S + 5, UTC_S + 37)
    assert flight.utc_source == f"given: the first attitude at {format_utc(UTC_S + 5)}"
    assert flight.clocks == ()
    without = log(attitude(), position(), attitude(60.0, 5, boot=2), boots=TWO, one_clock=True)
    flight = without.flight(FlightOptions(utc_start=UTC_S))
    assert (flight.attitude.first_s, flight.attitude.last_s) == (UTC_S, UTC_S + 32)


def test_sources_and_remarks_name_their_boot() -> None:
    one, two = boot_of(1, 0.0), boot_of(2, 100.0)
    two[1] = replace(two[1], source="other gps", notes=("shared", "of two"))
    one[1] = replace(one[1], notes=("shared",))
    trigger = TriggerSamples(np.array([31.0]), np.array([np.nan]), "CAM")
    gimbal = GimbalSamples(np.array([31.0, 32.0]), np.tile([1.0, 0, 0, 0], (2, 1)), np.array([True, False]), "mnt")
    events = EventSamples.of(EventKind.MESSAGE, np.array([33.0]), ["hello"])
    more = [replace(batch, boot=number) for number in (1, 2) for batch in (trigger, gimbal, events)]
    flight = log(*one, *two, *more, boots=TWO).flight()
    assert (flight.name, flight.position_source, flight.attitude_source) == ("log.bin", "pos", "att, 2.0 Hz")
    assert flight.utc_source == "boot 1: gps; boot 2: other gps"
    assert flight.notes == ("shared", "boot 2: of two", HOLDS.format(2, "boots 1 and 2"))
    assert [gap.reason for gap in flight.attitude.gaps] == ["a reboot of the autopilot"]
    assert flight.triggers[0].utc_s.tolist() == [UTC_S + 1, UTC_S + 101]
    assert flight.events.utc_s.tolist() == [UTC_S + 3, UTC_S + 103]
    np.testing.assert_array_equal(flight.gimbal.utc_s - UTC_S, [1, 2, 101, 102])
    assert (flight.gimbal.is_earth.tolist(), flight.gimbal.source) == ([True, False] * 2, "mnt")
    assert flight.position.at(UTC_S + 104).height_m == pytest.approx(52.0, abs=1e-5)
    placed = log(*one, *two, boots=TWO).flight(FlightOptions(site=HOME))
    assert placed.position_source == "given"


def test_the_summary_of_each_boot() -> None:
    of = log(*boot_of(1, 0.0), *boot_of(2, None, 5), *boot_of(3, 100.0, 1), boots=THREE)
    assert of.summaries() == (
        BootSummary(1, 10.0, 21, format_utc(UTC_S), format_utc(UTC_S + 10), "att, 2.0 Hz", ""),
        BootSummary(2, 2.0, 5, None, None, "att, 2.0 Hz", "it has no UTC (no gps)"),
        BootSummary(3, 0.0, 0, None, None, "", "it has fewer than two attitudes"),
    )
    lone = log(*boot_of(1, 0.0, placed=False), *boot_of(2, 100.0), boots=TWO)
    assert [one.left_out for one in lone.summaries()] == ["it has no position (no fix)", ""]
    assert [one.left_out for one in lone.summaries(site=PositionTrack.fixed(HOME))] == ["", ""]
    assert [boot.boot for boot in lone.recordings_of_flight(PositionTrack.fixed(HOME))] == [1, 2]


# --- the report -----------------------------------------------------------------------------------------------------
def test_the_report_of_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(b"x" * 1234)
    monkeypatch.setattr(Script, "name", str(path))
    gap = attitude(count=41, step_s=0.05)
    clock_s = np.concatenate([gap.clock_s, gap.clock_s + 12.0])
    q = quaternion_from_euler(0 * clock_s, 0 * clock_s, np.deg2rad(4.0) * (clock_s - 30))
    att = replace(gap, clock_s=clock_s, q_body_ned=q, segment=np.zeros(82, dtype=np.int64))
    triggers = TriggerSamples(np.array([31.0, 33.5]), np.full(2, np.nan), "CAM", camera="camera:2")
    gyros = RateSamples(30 + 0.01 * np.arange(100), np.zeros((100, 3)), "gyr")
    report, _ = survey(Script(att, position(), clock(), triggers, gyros), flags={"--a": 1})

    assert (report.file, report.file_bytes, report.format) == (str(path), 1234, "a format")
    assert (report.vehicle, report.firmware, report.estimator) == ("vehicle []", "fw", "EKF3")
    assert (report.duration_s, report.utc_first, report.utc_last) == (14.0, format_utc(UTC_S), format_utc(UTC_S + 14))
    assert (report.utc_source, report.position_source, report.attitude_source) == ("gps", "pos", "att, 20.0 Hz")
    assert (report.latitude_deg, report.longitude_deg) == (
        round(np.rad2deg(-0.6 + 3.5e-6), 6),
        round(np.rad2deg(2.4), 6),
    )
    assert report.height_m == 53.5
    assert report.attitudes == (AttitudeSurvey("att", 82, 20.0, 14.0, 1, 10.0, 4.0),)
    assert report.gaps == (GapSurvey(2.0, 10.0, report.gaps[0].reason),)
    assert report.gap_counts == {report.gaps[0].reason: 1}
    assert report.gyros == GyroSurvey("gyr", 100.0)
    assert report.triggers == (TriggerSurvey("camera", "CAM", 2, 1.0, 3.5),)
    assert report.boots == ()
    assert report.command == f"glstar export {path} -o frames --interpolation gyro --a 1"
    several, _ = survey(Script(*boot_of(1, 0.0), *boot_of(2, 100.0, 7), boots=TWO))
    assert several.vehicle == "vehicle [1, 2]"
    assert [boot.number for boot in several.boots] == [1, 2]
    assert several.attitudes == (AttitudeSurvey("att", 28, 2.0, 13.0, 0, 0.0, 4.0),)


@pytest.mark.parametrize(
    ("rate_hz", "gyro_hz", "advice"),
    [
        (40.0, 0.0, "spline"),
        (44.0, 84.0, "spline"),
        (44.0, 92.0, "gyro"),
        (46.0, 200.0, None),
    ],
)
def test_the_advice_of_a_better_interpolation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate_hz: float, gyro_hz: float, advice: str | None
) -> None:
    path = tmp_path / "log.bin"
    path.write_bytes(b"x")
    monkeypatch.setattr(Script, "name", str(path))
    rates = (
        RateSamples(30 + np.arange(200) / gyro_hz, np.zeros((200, 3)), "gyr")
        if gyro_hz
        else RateSamples(np.zeros(1), np.zeros((1, 3)), "x")
    )
    report, _ = survey(Script(attitude(count=201, step_s=1 / rate_hz), rates))
    lacks = "--utc-start UTC --lat LATITUDE --lon LONGITUDE"
    assert report.command == f"glstar export {path} -o frames {lacks}" + (
        f" --interpolation {advice}" if advice else ""
    )
    assert (report.utc_first, report.latitude_deg, report.sun_altitude_deg, report.light) == (None, None, None, None)


@pytest.mark.parametrize(
    ("unread", "size", "is_reported"),
    [(65_535, 100_000, False), (65_536, 100_000, True), (65_536, 6_600_000, False), (65_536, 6_500_000, True)],
)
def test_a_part_that_could_not_be_read_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unread: int, size: int, is_reported: bool
) -> None:
    path = tmp_path / "log.bin"
    with path.open("wb") as file:
        file.truncate(size)
    monkeypatch.setattr(Script, "name", str(path))
    monkeypatch.setattr(Script, "facts", lambda *_: source.LogFacts("a format", unread_bytes=unread))
    report, _ = survey(Script(attitude(), position(), clock()))
    said = f"0.1 MB of the file, {unread / size:.0%}, could not be read: damage, or part of a log of another format"
    assert report.notes == ((f"{said} than a format",) if is_reported else ())
