"""The play head stays inside the flight, and steps to the exposures of an export."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from glstar.config import ExposureSection
from glstar.errors import ConfigError, TelemetryError
from glstar.export.plan.frames import plan_frames
from glstar.flight import DATA_GAP, AttitudeTrack, Flight, Gap, PositionTrack
from glstar.sky.place.timescale import CLOCK_GRAIN_S, format_utc
from glstar.viewer.flight.playhead import FASTEST, SLOWEST, Mode, PlayHead

ADELAIDE_UTC_S = 1710068400.123456
# Today's UTC seconds that differ by two float64 steps are equal.
CLOCK_S = 5e-7

many = settings(deadline=None, max_examples=100)
sections = st.builds(
    ExposureSection,
    duration_s=st.floats(0.001, 100.0),
    interval_s=st.floats(0.001, 100.0),
    rate_hz=st.floats(0.5, 1000.0),
)
lengths_s = st.floats(0.01, 10_000.0)


def play_head(length_s: float = 60.0, *, mode: Mode = Mode.CAMERA, **exposure: float) -> PlayHead:
    head = PlayHead(ADELAIDE_UTC_S, ADELAIDE_UTC_S + length_s, ExposureSection(**exposure))
    head.mode = mode
    return head


def at(second: float, length_s: float = 60.0, *, mode: Mode = Mode.CAMERA, **exposure: float) -> PlayHead:
    head = play_head(length_s, mode=mode, **exposure)
    head.seek(ADELAIDE_UTC_S + second)
    return head


def attitude(length_s: float, *gaps: Gap) -> AttitudeTrack:
    utc_s = np.array([ADELAIDE_UTC_S, ADELAIDE_UTC_S + length_s])
    return AttitudeTrack(utc_s, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), gaps)


def starts_of_an_export(length_s: float, section: ExposureSection) -> list[float]:
    flight = Flight(attitude(length_s), PositionTrack(*(np.zeros(1) for _ in range(4))))
    plan = plan_frames(flight, section, start_s=0.0, stop_s=None, frames=None)
    return [planned.exposure.start_utc_s for planned in plan.frames]


# --- it plays ---


def test_a_paused_play_head_does_not_move() -> None:
    head = at(10.0)
    head.advance(1.0)

    assert head.second == pytest.approx(10.0, abs=CLOCK_S)


@pytest.mark.parametrize("speed", [SLOWEST, 0.5, 1.0, FASTEST, -SLOWEST, -1.0, -FASTEST])
def test_the_speed_is_seconds_of_flight_per_second(speed: float) -> None:
    head = at(50.0, 100.0)
    head.speed = speed
    head.toggle()
    for _ in range(60):
        head.advance(1 / 60)

    # A thousandth of a second of rounding in a minute would be too much.
    assert head.second == pytest.approx(50.0 + speed, abs=60 * CLOCK_S)


def test_speeds_double_from_an_eighth_to_32() -> None:
    head = play_head()
    head.speed = SLOWEST
    speeds = []
    for _ in range(10):
        speeds.append(head.speed)
        head.faster()

    assert speeds == [0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 32.0]
    for expected in [16.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.125]:
        head.slower()
        assert head.speed == expected


def test_a_speed_between_powers_of_two_steps_to_the_next_one() -> None:
    head = play_head()
    head.speed = -3.0
    head.faster()
    assert head.speed == -4.0
    head.speed = -3.0
    head.slower()
    assert head.speed == -2.0


def test_faster_and_normal_speed_keep_the_direction() -> None:
    head = play_head()
    head.reverse()
    head.faster()
    assert head.speed == -2.0
    head.normal_speed()
    assert head.speed == -1.0
    head.reverse()
    assert head.speed == 1.0


def test_a_speed_beyond_the_limits_is_clipped_and_zero_is_refused() -> None:
    head = play_head()
    head.speed = -math.inf
    assert head.speed == -FASTEST
    head.speed = 0.001
    assert head.speed == SLOWEST
    for none in (0.0, math.nan):
        with pytest.raises(ConfigError, match=r"1/8 to 32, or -1/8 to -32 backwards, not (0\.0|nan)"):
            head.speed = none


@pytest.mark.parametrize(("speed", "end_s"), [(1.0, 60.0), (-1.0, 0.0)])
def test_the_flight_pauses_at_its_end_and_plays_again_from_the_start(speed: float, end_s: float) -> None:
    head = at(30.0)
    head.speed = speed
    head.toggle()
    head.advance(100.0)

    assert (head.playing, head.second) == (False, pytest.approx(end_s, abs=CLOCK_S))
    head.toggle()
    assert (head.playing, head.second) == (True, pytest.approx(60.0 - end_s, abs=CLOCK_S))


@pytest.mark.parametrize(("speed", "expected_s"), [(1.0, 20.0), (-1.0, 40.0)])
def test_a_loop_continues_at_the_other_end(speed: float, expected_s: float) -> None:
    head = at(30.0)
    head.loop, head.speed = True, speed
    head.toggle()
    head.advance(50.0)

    assert head.playing
    assert head.second == pytest.approx(expected_s, abs=CLOCK_S)


@pytest.mark.parametrize("elapsed_s", [0.0, -1.0, math.nan, math.inf])
def test_a_clock_that_does_not_advance_moves_nothing(elapsed_s: float) -> None:
    head = at(30.0)
    head.toggle()
    head.advance(elapsed_s)

    assert (head.playing, head.second) == (True, pytest.approx(30.0, abs=CLOCK_S))


# --- it is sent somewhere ---


def test_a_time_outside_the_flight_is_clipped_to_the_nearer_end() -> None:
    head = play_head()
    head.seek(math.inf)
    assert head.utc_s == head.last_s
    head.seek_by(-1e9)
    assert head.utc_s == head.first_s
    head.last()
    assert head.utc_s == head.last_s
    head.first()
    assert head.utc_s == head.first_s


def test_the_play_head_refuses_nan() -> None:
    with pytest.raises(ConfigError, match="to the time nan"):
        play_head().seek(math.nan)


@pytest.mark.parametrize(
    ("text", "second"),
    [
        ("12.5", 12.5),
        (" 0 ", 0.0),
        (".5", 0.5),
        ("12.5 s", 12.5),
        ("7s", 7.0),
        ("1:02.5", 62.5),
        ("0:00", 0.0),
        ("90:00", 5400.0),
        ("1:00:02", 3602.0),
        ("2024-03-10T11:00:01.123456Z", 1.0),
        ("2024-03-10 11:01:00.123456", 60.0),
        ("2024-03-10T21:30:30.123456+10:30", 30.0),
        # The displayed time can be typed again.
        (format_utc(ADELAIDE_UTC_S), 0.0),
        (format_utc(ADELAIDE_UTC_S + 7200.0), 7200.0),
    ],
)
def test_a_time_can_be_typed(text: str, second: float) -> None:
    head = play_head(7200.0)
    head.seek_text(text)

    assert head.second == pytest.approx(second, abs=CLOCK_GRAIN_S)


@pytest.mark.parametrize(
    "text", ["", "noon", "1:60", "1:2", "1:02:3", "- x", "+", "--5", "+1:60", "1e3", "nan", "inf", "12,5", "1:2:3:4"]
)
def test_an_invalid_time_is_refused_with_examples_of_valid_ones(text: str) -> None:
    head = at(10.0)
    with pytest.raises(
        ConfigError, match=r"is not a time; write seconds .* \(1:02\.5\), or UTC \(2024-03-10T11:00:00Z\)"
    ):
        head.seek_text(text)

    assert head.second == pytest.approx(10.0, abs=CLOCK_S)


@pytest.mark.parametrize(
    ("text", "second"),
    [("+5", 25.0), ("-0.1", 19.9), ("+ 2.5 s", 22.5), ("-.5", 19.5), ("+1:00", 80.0), ("-0:20", 0.0), ("+0", 20.0)],
)
def test_a_number_with_a_sign_counts_from_the_time_shown(text: str, second: float) -> None:
    head = at(20.0, 120.0)
    head.seek_text(text)

    assert head.second == pytest.approx(second, rel=0, abs=CLOCK_GRAIN_S)


def with_points(in_s: float | None, out_s: float | None) -> PlayHead:
    """Return a play head with in and out points, at 12 s of a minute."""
    head = play_head()
    for second, set_point in ((in_s, head.set_in), (out_s, head.set_out)):
        if second is not None:
            head.seek(ADELAIDE_UTC_S + second)
            set_point()
    head.seek(ADELAIDE_UTC_S + 12.0)
    return head


@pytest.mark.parametrize("speed", [1.0, -1.0, 8.0])
@pytest.mark.parametrize(("in_s", "out_s"), [(10.0, 15.0), (None, 15.0), (10.0, None)])
def test_a_loop_stays_between_the_in_and_out_points(in_s: float | None, out_s: float | None, speed: float) -> None:
    head = with_points(in_s, out_s)
    head.loop, head.speed = True, speed
    head.toggle()
    low_s, high_s = (in_s or 0.0), (out_s or 60.0)
    seen = []
    for _ in range(1000):
        head.advance(0.1)
        seen.append(head.second)

    assert head.playing
    assert min(seen) >= low_s - CLOCK_S
    assert max(seen) <= high_s + CLOCK_S
    assert max(seen) - min(seen) >= high_s - low_s - 0.1 * abs(speed) - CLOCK_S


def test_playing_pauses_at_the_out_point_and_plays_the_part_again() -> None:
    head = with_points(10.0, 15.0)
    head.toggle()
    for _ in range(100):
        head.advance(0.1)
    assert not head.playing
    assert head.second == pytest.approx(15.0, rel=0, abs=CLOCK_S)

    head.toggle()
    assert head.second == pytest.approx(10.0, rel=0, abs=CLOCK_S)


def test_a_play_head_outside_the_points_plays_to_the_end_of_the_flight() -> None:
    head = with_points(10.0, 15.0)
    head.seek(ADELAIDE_UTC_S + 20.0)
    head.toggle()
    head.advance(30.0)

    assert head.second == pytest.approx(50.0, rel=0, abs=CLOCK_S)


def test_an_out_point_before_the_in_point_replaces_it() -> None:
    head = with_points(30.0, 15.0)
    assert head.part == pytest.approx((ADELAIDE_UTC_S, ADELAIDE_UTC_S + 15.0), rel=0, abs=CLOCK_S)
    head.clear_part()
    assert head.part == (head.first_s, head.last_s)


@pytest.mark.parametrize("text", ["60.1", "1:01", "2024-03-10T10:59:59Z", "1999-01-01", "9" * 5000, "9" * 5000 + ":00"])
def test_a_time_outside_the_flight_is_refused_with_its_ends(text: str) -> None:
    ends = r"lasts 60\.000 s, from 2024-03-10T11:00:00\.123456Z to 2024-03-10T11:01:00\.123456Z"
    with pytest.raises(ConfigError, match=ends):
        play_head().seek_text(text)


@pytest.mark.parametrize("text", ["11:00:40", "11:00:40Z", "11:00:40.0"])
def test_a_time_may_be_typed_as_the_utc_axis_shows_it(text: str) -> None:
    head = play_head()  # a minute from 11:00:00.123456
    head.seek_text(text)

    assert head.utc_s == pytest.approx(head.first_s + 39.876544, rel=0, abs=CLOCK_GRAIN_S)


def test_a_time_of_day_after_midnight_is_that_of_the_next_day() -> None:
    midnight_s = 1_710_115_200.0
    head = PlayHead(midnight_s - 100.0, midnight_s + 100.0, ExposureSection())
    for text, utc_s in (("00:00:50Z", midnight_s + 50.0), ("23:59:10Z", midnight_s - 50.0)):
        head.seek_text(text)
        assert head.utc_s == pytest.approx(utc_s, rel=0, abs=CLOCK_GRAIN_S)


def test_minutes_and_seconds_count_from_the_start_of_a_flight_of_that_length() -> None:
    """01:00:30 is an hour into a flight of two hours, though it is a time of day as well; Z says which."""
    first_s = 1_710_115_200.0 + 1800.0  # 00:30
    head = PlayHead(first_s, first_s + 7200.0, ExposureSection())
    head.seek_text("01:00:30")
    assert head.second == pytest.approx(3630.0, abs=CLOCK_GRAIN_S)
    head.seek_text("01:00:30Z")
    assert head.second == pytest.approx(1830.0, abs=CLOCK_GRAIN_S)


# --- it shows exposures ---


@many
@given(st.floats(0.5, 60.0), st.floats(0.01, 20.0), st.floats(0.4, 20.0), st.integers(1, 3))
def test_stepping_stops_at_every_exposure_of_an_export_exactly(
    length_s: float, duration_s: float, interval_s: float, stride: int
) -> None:
    section = ExposureSection(duration_s=min(duration_s, length_s), interval_s=interval_s)
    exported = starts_of_an_export(length_s, section)
    for mode in Mode:
        head = play_head(length_s, mode=mode)
        head.exposure_section = section
        forwards = [head.exposure().start_utc_s]
        for _ in exported[stride::stride]:
            head.step_exposures(stride)
            forwards.append(head.exposure().start_utc_s)
            assert head.number == (len(forwards) - 1) * stride
        assert forwards == exported[::stride]

        head.step_exposures(len(exported))
        backwards = [head.exposure().start_utc_s]
        for _ in exported[1:]:
            head.step_exposures(-1)
            backwards.append(head.exposure().start_utc_s)
        assert backwards == exported[::-1]


@many
@given(sections, lengths_s, st.floats(0.0, 1.0))
def test_camera_mode_shows_the_latest_exposure_that_has_ended(
    section: ExposureSection, length_s: float, share: float
) -> None:
    section = section.model_copy(update={"duration_s": min(section.duration_s, length_s)})
    head = at(share * length_s, length_s)
    head.exposure_section = section
    shown, number = head.exposure(), head.number

    assert number is not None
    assert shown == section.nth(number, head.first_s)
    assert number == 0 or shown.stop_utc_s <= head.utc_s + 2 * CLOCK_GRAIN_S
    following = section.nth(number + 1, head.first_s)
    assert number + 1 == head.count or following.stop_utc_s > head.utc_s - CLOCK_GRAIN_S


@many
@given(sections, lengths_s, st.floats(0.0, 1.0))
def test_a_sliding_exposure_ends_at_the_play_head_or_begins_with_the_flight(
    section: ExposureSection, length_s: float, share: float
) -> None:
    section = section.model_copy(update={"duration_s": min(section.duration_s, length_s)})
    head = at(share * length_s, length_s, mode=Mode.SLIDING)
    head.exposure_section = section
    shown = head.exposure()

    assert shown.duration_s == section.duration_s
    expected_s = max(head.utc_s, head.first_s + section.duration_s)
    assert shown.stop_utc_s == pytest.approx(expected_s, rel=0, abs=2 * CLOCK_GRAIN_S)


def test_between_two_exposures_one_step_reaches_the_next_or_the_previous() -> None:
    # They end at 0.5 s, 3.5 s, 6.5 s.
    head = at(5.0, mode=Mode.SLIDING)
    assert head.number is None
    head.step_exposures(-1)
    assert (head.number, head.second) == (1, pytest.approx(3.5, abs=CLOCK_S))

    head.seek(ADELAIDE_UTC_S + 5.0)
    head.step_exposures(1)
    assert (head.number, head.second) == (2, pytest.approx(6.5, abs=CLOCK_S))


def test_camera_mode_shows_another_exposure_after_a_step_back() -> None:
    head = at(5.0)
    assert head.number == 1
    head.step_exposures(-1)
    assert (head.number, head.second) == (0, pytest.approx(0.5, abs=CLOCK_S))


@pytest.mark.parametrize("mode", Mode)
def test_a_step_at_the_end_of_the_flight_changes_nothing(mode: Mode) -> None:
    head = at(59.9, mode=mode)
    head.step_exposures(1)
    assert head.second == pytest.approx(59.9, abs=CLOCK_S)

    head.first()
    head.step_exposures(-1)
    assert (head.number, head.utc_s) == (0, head.first_s)


def test_a_step_pauses_the_flight() -> None:
    for step in (PlayHead.step_exposures, PlayHead.step_sub_exposures):
        head = at(5.0)
        head.toggle()
        step(head, 1)
        assert not head.playing


def test_an_exposure_has_a_hundred_sub_exposures_of_five_milliseconds() -> None:
    head = at(0.5, duration_s=0.5, interval_s=0.5)
    head.step_sub_exposures(1)
    assert head.second == pytest.approx(0.505, abs=CLOCK_S)
    head.step_sub_exposures(-1)
    for _ in range(100):
        head.step_sub_exposures(1)

    assert head.number == 1
    assert head.second == pytest.approx(1.0, abs=CLOCK_S)


def test_a_step_by_a_sub_exposure_stops_at_the_next_mark() -> None:
    head = at(0.503)
    head.step_sub_exposures(1)
    assert head.second == pytest.approx(0.505, abs=CLOCK_S)
    head.seek(ADELAIDE_UTC_S + 0.503)
    head.step_sub_exposures(-1)
    assert head.second == pytest.approx(0.5, abs=CLOCK_S)


@many
@given(st.floats(0.001, 59.0), st.integers(1, 50))
def test_steps_by_sub_exposures_forwards_and_backwards_cancel(second: float, n: int) -> None:
    head = at(second, duration_s=0.5, interval_s=0.5)
    head.step_sub_exposures(1)
    before = head.second
    head.step_sub_exposures(n)
    assert head.second == pytest.approx(before + n * 0.005, abs=2 * CLOCK_S)
    head.step_sub_exposures(-n)
    assert head.second == pytest.approx(before, abs=2 * CLOCK_S)


def test_a_new_exposure_time_takes_effect_at_once() -> None:
    head = at(10.0)
    head.exposure_section = ExposureSection(duration_s=2.0, interval_s=4.0, rate_hz=50.0)

    shown = head.exposure()
    assert (shown.start_utc_s, shown.duration_s, shown.rate_hz) == (ADELAIDE_UTC_S + 8.0, 2.0, 50.0)
    assert head.utc_s == ADELAIDE_UTC_S + 10.0


# --- it says what cannot be shown ---


@pytest.mark.parametrize("mode", Mode)
def test_an_exposure_that_touches_a_gap_is_reported_as_missing(mode: Mode) -> None:
    gap = Gap(ADELAIDE_UTC_S + 3.2, ADELAIDE_UTC_S + 3.76, DATA_GAP)
    track = attitude(60.0, gap)
    head = at(3.5, mode=mode)

    assert head.gap(track) is gap
    assert head.status(track) == "no exposure: the log has a data gap of 0.560 s here"
    head.seek(ADELAIDE_UTC_S + 6.5)
    assert head.gap(track) is None
    assert head.status(track) is None


@pytest.mark.parametrize("mode", Mode)
def test_a_flight_shorter_than_an_exposure_is_shown_completely_with_a_message(mode: Mode) -> None:
    head = at(0.1, 0.3, mode=mode)

    shown = head.exposure()
    assert (shown.start_utc_s, shown.duration_s) == (head.first_s, head.length_s)
    assert (head.count, head.number) == (0, None)
    assert head.status(attitude(0.3)) == (
        "the flight lasts 0.300 s, less than an exposure of 0.5 s: all of it is shown, and an export has no frame"
    )
    head.step_exposures(1)
    assert head.second == pytest.approx(0.1, abs=CLOCK_S)
    # 60 sub-exposures of it.
    head.step_sub_exposures(1)
    assert head.second == pytest.approx(0.105, abs=CLOCK_S)


@pytest.mark.parametrize(
    "ends", [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.inf), (-math.inf, 1.0), (0.0, math.nan)]
)
def test_a_flight_without_duration_cannot_be_played(ends: tuple[float, float]) -> None:
    with pytest.raises(TelemetryError, match="cannot be played"):
        PlayHead(*ends, ExposureSection())


# --- markers ---


def test_markers_are_visited_in_order_of_time() -> None:
    head = play_head()
    for second in (30.0, 10.0, 20.0, 10.0):
        head.seek(ADELAIDE_UTC_S + second)
        head.add_marker()

    assert head.markers == [ADELAIDE_UTC_S + second for second in (10.0, 20.0, 30.0)]
    assert head.marker == ADELAIDE_UTC_S + 10.0
    head.first()
    assert head.marker is None
    visited = []
    for _ in range(4):
        head.next_marker()
        visited.append(round(head.second, 3))
    assert visited == [10.0, 20.0, 30.0, 30.0]
    head.previous_marker()
    head.previous_marker()
    head.previous_marker()
    assert head.second == pytest.approx(10.0, abs=CLOCK_S)


def test_a_marker_is_removed_at_the_play_head_or_by_its_time() -> None:
    head = play_head()
    for second in (10.0, 20.0):
        head.seek(ADELAIDE_UTC_S + second)
        head.add_marker()

    head.remove_marker()
    assert head.markers == [ADELAIDE_UTC_S + 10.0]
    head.remove_marker()
    assert head.markers == [ADELAIDE_UTC_S + 10.0]
    head.remove_marker(ADELAIDE_UTC_S + 10.0)
    assert head.markers == []


# --- whatever is done to it ---


class AnyoneAtTheKeyboard(RuleBasedStateMachine):
    """Press any keys in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.head = play_head(20.0)

    @rule(elapsed_s=st.one_of(st.floats(0.0, 0.1), st.floats(allow_nan=True)))
    def time_passes(self, elapsed_s: float) -> None:
        self.head.advance(elapsed_s)

    @rule(utc_s=st.one_of(st.floats(ADELAIDE_UTC_S - 1.0, ADELAIDE_UTC_S + 21.0), st.floats(allow_nan=False)))
    def seek(self, utc_s: float) -> None:
        self.head.seek(utc_s)

    @rule(
        name=st.sampled_from(
            [
                *("toggle", "faster", "slower", "normal_speed", "reverse", "first", "last"),
                *("add_marker", "remove_marker", "next_marker", "previous_marker"),
            ]
        )
    )
    def press(self, name: str) -> None:
        getattr(self.head, name)()

    @rule(name=st.sampled_from(["step_exposures", "step_sub_exposures", "seek_by"]), n=st.integers(-5000, 5000))
    def step(self, name: str, n: int) -> None:
        before_s = self.head.utc_s
        getattr(self.head, name)(n)
        assert (self.head.utc_s - before_s) * n >= 0

    @rule(mode=st.sampled_from(Mode), loop=st.booleans())
    def choose(self, mode: Mode, loop: bool) -> None:
        self.head.mode, self.head.loop = mode, loop

    @rule(section=sections)
    def settings_change(self, section: ExposureSection) -> None:
        self.head.exposure_section = section

    @precondition(lambda self: self.head.count)
    @rule()
    def the_number_names_the_exposure(self) -> None:
        head = self.head
        head.step_exposures(-1)
        if head.number is not None:
            assert head.exposure() == head.exposure_section.nth(head.number, head.first_s)

    @invariant()
    def the_play_head_is_inside_the_flight(self) -> None:
        assert self.head.first_s <= self.head.utc_s <= self.head.last_s

    @invariant()
    def the_exposure_is_inside_the_flight(self) -> None:
        shown = self.head.exposure()
        # Up to the end of the track.
        assert shown.start_utc_s >= self.head.first_s
        assert shown.stop_utc_s <= self.head.last_s + CLOCK_GRAIN_S

    @invariant()
    def the_speed_is_one_that_is_offered(self) -> None:
        assert SLOWEST <= abs(self.head.speed) <= FASTEST

    @invariant()
    def markers_are_in_order(self) -> None:
        assert self.head.markers == sorted(set(self.head.markers))


TestAnyoneAtTheKeyboard = AnyoneAtTheKeyboard.TestCase
TestAnyoneAtTheKeyboard.settings = settings(deadline=None, max_examples=40, stateful_step_count=30)


# --- a flight that is still going on ---


def growing() -> PlayHead:
    head = PlayHead(1000.0, 1010.0, ExposureSection(duration_s=0.5, interval_s=3.0), grows=True)
    head.grow(1000.0, 1020.0)
    return head


def test_the_play_head_stays_live_at_the_end_of_a_growing_flight() -> None:
    head = growing()
    assert (head.live, head.playing, head.utc_s, head.mode) == (True, True, 1020.0, Mode.SLIDING)
    head.advance(3.0)
    assert head.utc_s == 1020.0
    head.grow(1000.0, 1021.0)
    assert head.exposure().stop_utc_s == 1021.0


@pytest.mark.parametrize(
    "leave",
    [
        lambda head: head.seek_by(-2.0),
        PlayHead.toggle,
        PlayHead.reverse,
        PlayHead.first,
        lambda head: head.step_exposures(-1),
        lambda head: head.step_sub_exposures(-1),
    ],
)
def test_any_move_leaves_live_mode_and_the_end_key_returns_to_it(leave) -> None:
    head = growing()
    leave(head)
    then_s = head.utc_s
    head.grow(1000.0, 1030.0)
    assert not head.live
    assert head.utc_s == then_s
    head.last()
    assert (head.live, head.playing, head.speed, head.utc_s) == (True, True, 1.0, 1030.0)


def test_a_faster_play_head_is_live_again_when_it_catches_up() -> None:
    head = growing()
    head.seek_by(-4.0)
    head.speed = 4.0
    head.advance(0.5)
    assert not head.live
    head.advance(1.0)
    assert head.live
    head.toggle()
    assert not head.playing
    head.toggle()
    assert head.live


def test_exposures_keep_their_numbers_when_samples_are_dropped_from_the_buffer() -> None:
    head = growing()
    head.mode = Mode.CAMERA
    head.first()
    assert (head.number, head.exposure().start_utc_s) == (0, 1000.0)
    head.grow(1004.0, 1100.0)
    assert head.utc_s == 1004.0
    assert (head.number, head.exposure().start_utc_s) == (2, 1006.0)
    head.step_exposures(-5)
    assert head.exposure().start_utc_s == 1006.0
    head.seek(1099.0)
    assert (head.number, head.exposure().start_utc_s) == (32, 1096.0)
    assert head.second == 99.0


def test_typed_ends_of_a_flight_are_inside_and_a_thousandth_of_a_second_beyond_is_not() -> None:
    head = at(30.0)
    for text, second in (("60", 60.0), ("0", 0.0), ("60.0000005", 60.0)):
        head.seek_text(text)
        assert head.second == pytest.approx(second, abs=CLOCK_S)
    for text in ("60.001", "+0.001"):
        head.seek(head.last_s)
        with pytest.raises(ConfigError, match="outside the flight"):
            head.seek_text(text)
    head.first()
    with pytest.raises(ConfigError, match="outside the flight"):
        head.seek_text("-0.001")


def test_steps_of_many_exposures_end_at_the_first_and_the_last() -> None:
    head = at(30.0, duration_s=1.0, interval_s=2.0)
    head.step_exposures(1000)
    assert (head.number, head.second) == (29, pytest.approx(59.0, abs=CLOCK_S))
    head.step_exposures(-1000)
    assert (head.number, head.second) == (0, pytest.approx(1.0, abs=CLOCK_S))
    # Between exposures in sliding mode, the one before is a step back, and no step goes the other direction.
    head.mode = Mode.SLIDING
    head.seek(ADELAIDE_UTC_S + 10.5)
    assert head.number is None
    head.step_exposures(-1)
    assert (head.number, head.second) == (4, pytest.approx(9.0, abs=CLOCK_S))
    head.seek(ADELAIDE_UTC_S + 0.5)
    head.step_exposures(-1)
    assert head.second == pytest.approx(0.5, abs=CLOCK_S)
    head.seek(ADELAIDE_UTC_S + 59.5)
    head.step_exposures(1)
    assert head.second == pytest.approx(59.5, abs=CLOCK_S)


def test_seeking_the_end_of_a_growing_flight_plays_forwards() -> None:
    head = growing()
    head.seek_by(-5.0)
    head.speed = -4.0
    head.playing = False
    head.seek(head.last_s)
    assert (head.live, head.playing, head.speed) == (True, True, 4.0)
    # A flight that is complete is never live.
    complete = at(10.0)
    complete.seek(complete.last_s)
    assert (complete.live, complete.playing) == (False, False)
