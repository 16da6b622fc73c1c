"""The play head: the time of a flight that is shown, the exposure that belongs to it, and times as users type them.

The play head has no clock of its own: `PlayHead.advance` takes the elapsed time.  All times are UTC seconds.
"""

import re
from bisect import bisect_left, bisect_right, insort
from dataclasses import replace
from enum import StrEnum
from math import ceil, copysign, floor, frexp, isfinite, isnan

from glstar.camera.exposure import Exposure
from glstar.config import ExposureSection
from glstar.errors import ConfigError, TelemetryError
from glstar.flight import AttitudeTrack, Gap
from glstar.sky.place.timescale import CLOCK_GRAIN_S, format_utc, parse_utc

_SECONDS = re.compile(r"(?P<seconds>\d+(\.\d*)?|\.\d+)\s*s?")
_MINUTES = re.compile(r"((?P<hours>\d+):(?=\d\d:))?(?P<minutes>\d+):(?P<seconds>[0-5]\d(\.\d*)?)")
_TIME_OF_DAY = re.compile(r"(?P<hours>[01]?\d|2[0-3]):(?P<minutes>[0-5]\d)(:(?P<seconds>[0-5]\d(\.\d*)?))?Z?")
_DAY_S = 86400.0


def parse_typed_time(text: str, *, origin_s: float, first_s: float, last_s: float, shown_s: float) -> float:
    """Return the time that a user typed, UTC seconds since 1970, perhaps outside the flight; see `PlayHead.seek_text`.

    `text`: without blanks around it.  All times are UTC seconds since 1970: `origin_s`: from which seconds are counted;
    `first_s`, `last_s`: the ends of the flight; `shown_s`: from which a number with a sign is counted.  Raises
    ConfigError if the text is not a time.
    """
    if text[:1] in {"+", "-"}:
        sign, rest = (1.0 if text[0] == "+" else -1.0), text[1:].strip()
        if match := _SECONDS.fullmatch(rest):
            return shown_s + sign * float(match["seconds"])
        if match := _MINUTES.fullmatch(rest):
            return shown_s + sign * _seconds_of(match)
    if match := _SECONDS.fullmatch(text):
        return origin_s + float(match["seconds"])
    readings = []
    if match := _MINUTES.fullmatch(text):
        readings.append(origin_s + _seconds_of(match))
    if match := _TIME_OF_DAY.fullmatch(text):
        # On the first day of the flight, unless that time was before its start.
        midnight_s = first_s // _DAY_S * _DAY_S
        times_s = [midnight_s + day * _DAY_S + _seconds_of(match) for day in (0, 1)]
        readings.append(next((utc_s for utc_s in times_s if utc_s >= first_s - CLOCK_GRAIN_S), times_s[-1]))
    if readings:
        inside = (utc_s for utc_s in readings if first_s <= utc_s <= last_s)
        return next(inside, readings[0])
    try:
        return parse_utc(text)
    except ConfigError:
        raise ConfigError(
            f"{text!r} is not a time; write seconds from the start (12.5) or from the time shown (+5, -0.1), minutes"
            " and seconds (1:02.5), or UTC (2024-03-10T11:00:00Z)"
        ) from None


def _seconds_of(match: re.Match[str]) -> float:
    """Return hours, minutes and seconds as seconds."""
    hours, minutes, seconds = (float(match[part] or 0) for part in ("hours", "minutes", "seconds"))
    return 3600 * hours + 60 * minutes + seconds


# Limits of the speed: seconds of flight per second of the clock.
SLOWEST = 0.125
FASTEST = 32.0


class Mode(StrEnum):
    """Which exposure is shown at a time."""

    CAMERA = "camera"  # one every interval, as a camera records them: the latest that has ended
    SLIDING = "sliding"  # the one that ends now


def no_exposure(gap: Gap, *, source: str = "log") -> str:
    """Return a message that says why there is no exposure.

    `gap`: the gap that the exposure touches; `source`: the source of the attitude: the log or the link.
    """
    return f"no exposure: the {source} has {gap.reason} of {gap.duration_s:.3f} s here"


def _ending_at(utc_s: float, first_s: float, last_s: float, section: ExposureSection) -> Exposure:
    """Return the exposure that ends at a time, or the flight's first, or all of a flight that is shorter than one."""
    if section.span_s <= last_s - first_s:
        return section.starting_at(max(first_s, utc_s - section.span_s))
    readout_s = min(section.readout_s, (last_s - first_s) / 2)
    return replace(section.starting_at(first_s, last_s - first_s - readout_s).first, readout_s=readout_s)


class PlayHead:
    """A time of a flight that plays forwards or backwards, and stays within the flight.

    A live flight grows at its end, while its beginning leaves the buffer; at its end the play head is live and stays at
    the end.  `first_s`, `last_s`: the ends of the flight, UTC seconds since 1970; `exposure`: duration, interval and
    rate of the exposures; `grows`: whether the flight is live.  Raises TelemetryError if the flight has no duration.
    """

    def __init__(self, first_s: float, last_s: float, exposure: ExposureSection, *, grows: bool = False) -> None:
        if not (isfinite(first_s) and isfinite(last_s) and first_s < last_s):
            raise TelemetryError(f"a flight that begins at {first_s} s and ends at {last_s} s cannot be played")
        # The part that can be shown, UTC seconds since 1970; `grow` moves its ends.
        self.first_s, self.last_s = first_s, last_s
        # The flight's first attitude, from which seconds and exposures are counted, UTC seconds since 1970.
        self.origin_s = first_s
        self.grows = grows
        self.live = grows  # Whether it stays at the end of a live flight
        self.playing = grows  # Whether it moves
        self.exposure_section = exposure  # May be replaced at any time
        self.mode = Mode.SLIDING if grows else Mode.CAMERA
        self.loop = False  # Whether the flight starts again at its end
        self.markers: list[float] = []  # UTC seconds since 1970, ascending
        # In and out points, UTC seconds since 1970: the part that loops, and that exports and videos begin with.
        self.in_s: float | None = None
        self.out_s: float | None = None
        self._utc_s = last_s if grows else first_s
        self._speed = 1.0

    # --- where it is ---

    @property
    def utc_s(self) -> float:
        """The time shown, UTC seconds since 1970; `seek` changes it."""
        return self._utc_s

    @property
    def second(self) -> float:
        """The time shown, s from the flight's first attitude."""
        return self._utc_s - self.origin_s

    @property
    def length_s(self) -> float:
        """Duration of the flight, s; of a live flight including what has left the buffer."""
        return self.last_s - self.origin_s

    def seek(self, utc_s: float) -> None:
        """Go to a time, limited to the flight; at the end of a live flight the play head is live.

        `utc_s`: UTC seconds since 1970.  Raises ConfigError if it is NaN.
        """
        if isnan(utc_s):
            raise ConfigError("the play head cannot go to the time nan")
        self._utc_s = min(max(utc_s, self.first_s), self.last_s)
        self.live = self.grows and self._utc_s == self.last_s
        if self.live:
            self.playing = True
            self._speed = abs(self._speed)

    def grow(self, first_s: float, last_s: float) -> None:
        """Set the ends of a live flight.

        `first_s`, `last_s`: the ends of the part that can be shown, UTC seconds since 1970.
        """
        self.first_s, self.last_s = first_s, max(first_s, last_s)
        self._utc_s = self.last_s if self.live else min(max(self._utc_s, first_s), self.last_s)

    def seek_by(self, seconds: float) -> None:
        """Move the play head by some seconds; `seconds`: s; negative to go back."""
        self.seek(self._utc_s + seconds)

    def seek_text(self, text: str) -> None:
        """Go to a time that the user typed.

        `text`: seconds from the flight's first attitude (``12.5``), minutes or hours of them (``1:02.5``, ``1:00:02``),
        or UTC, ISO 8601 (``2024-03-10T11:00:00Z``) or as the time axis shows it (``11:01:40``).  That is a time of day
        if the flight is not that long, and always with ``Z``.  With a sign, seconds or minutes count from the time
        shown (``+5``, ``-0.1``, ``-1:30``).  Raises ConfigError if it is none of these, or outside the flight.
        """
        utc_s = parse_typed_time(
            text.strip(), origin_s=self.origin_s, first_s=self.first_s, last_s=self.last_s, shown_s=self._utc_s
        )
        if not self.first_s - CLOCK_GRAIN_S <= utc_s <= self.last_s + CLOCK_GRAIN_S:
            raise ConfigError(
                f"{text.strip()} lies outside the flight, which lasts {self.length_s:.3f} s,"
                f" from {format_utc(self.first_s)} to {format_utc(self.last_s)}"
            )
        self.seek(utc_s)

    def first(self) -> None:
        """Go to the beginning of the flight."""
        self.seek(self.first_s)

    def last(self) -> None:
        """Go to the end of the flight; of a live flight, to the present."""
        self.seek(self.last_s)

    # --- how it moves ---

    @property
    def speed(self) -> float:
        """Seconds of flight per second of the clock, limited to 1/8 to 32; negative backwards."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if isnan(speed) or speed == 0:
            raise ConfigError(f"the speed must be 1/8 to 32, or -1/8 to -32 backwards, not {speed}")
        self._speed = copysign(min(max(abs(speed), SLOWEST), FASTEST), speed)
        self.live = self.live and speed > 0

    def faster(self) -> None:
        """Double the speed, up to 32; a speed between two powers of two becomes the next one."""
        self.speed = copysign(2.0 ** frexp(abs(self._speed))[1], self._speed)

    def slower(self) -> None:
        """Halve the speed, down to 1/8; a speed between two powers of two becomes the next one."""
        fraction, exponent = frexp(abs(self._speed))
        self.speed = copysign(2.0 ** (exponent - (2 if fraction == 0.5 else 1)), self._speed)

    def normal_speed(self) -> None:
        """Play at speed 1 in the same direction."""
        self.speed = copysign(1.0, self._speed)

    def reverse(self) -> None:
        """Reverse the direction."""
        self.speed = -self._speed

    def toggle(self) -> None:
        """Play or pause; at the end, play the flight again, or a live flight from the present."""
        self.playing = not self.playing
        self.live = False
        first_s, last_s = self._played
        start_s, end_s = (first_s, last_s) if self._speed > 0 else (last_s, first_s)
        if self.playing and abs(end_s - self._utc_s) <= CLOCK_GRAIN_S:
            self.seek(end_s if self.grows and self._speed > 0 else start_s)

    def advance(self, elapsed_s: float) -> None:
        """Advance by some time; at the end or at the out point, start again or pause, and follow a live flight.

        `elapsed_s`: elapsed time of the clock, s; nothing moves if it is not positive.
        """
        moved_s = self._utc_s + self._speed * elapsed_s
        if self.live or not (self.playing and elapsed_s > 0 and isfinite(moved_s)):
            return
        first_s, last_s = self._played
        inside = first_s <= moved_s <= last_s
        self.playing = inside or self.loop
        if not inside:
            looped_s = first_s + (moved_s - first_s) % (last_s - first_s)
            moved_s = looped_s if self.loop else min(max(moved_s, first_s), last_s)
        self.seek(moved_s)

    def step_exposures(self, n: int) -> None:
        """Pause at the end of another one of the camera's exposures, so that it is shown.

        `n`: number of exposures, negative to go back; limited to the first and the last one.
        """
        self.playing = self.live = False
        if n == 0 or not self._numbers:
            return
        # Between two exposures, the one before the play head is one step back.
        behind = n < 0 and self.number is None
        target = min(max(self._latest() + n + behind, self._numbers[0]), self._numbers[-1])
        stop_utc_s = self._nth(target).stop_utc_s
        if target != self.number and (stop_utc_s > self._utc_s) == (n > 0):
            self.seek(stop_utc_s)

    def step_sub_exposures(self, n: int) -> None:
        """Pause some sub-exposures away, at times evenly spaced from the end of the camera's exposure.

        `n`: number of sub-exposures, negative to go back.
        """
        self.playing = self.live = False
        exposure = self.exposure()
        tick_s = exposure.span_s / exposure.min_sub_exposures
        from_s = self._nth(self._latest()).stop_utc_s if self._numbers else self.first_s
        ticks, grain = (self._utc_s - from_s) / tick_s, CLOCK_GRAIN_S / tick_s
        at = floor(ticks + grain) if n > 0 else ceil(ticks - grain)
        if n != 0:
            self.seek(from_s + (at + n) * tick_s)

    # --- in and out points ---

    @property
    def part(self) -> tuple[float, float]:
        """The part between the in and out points, or of the complete flight, UTC seconds since 1970."""
        start_s = self.first_s if self.in_s is None else max(self.in_s, self.first_s)
        stop_s = self.last_s if self.out_s is None else min(self.out_s, self.last_s)
        return (start_s, stop_s) if start_s < stop_s else (self.first_s, self.last_s)

    @property
    def _played(self) -> tuple[float, float]:
        """The ends between which the play head moves: of the part if it is there, or of the flight."""
        start_s, stop_s = self.part
        is_inside = start_s - CLOCK_GRAIN_S <= self._utc_s <= stop_s + CLOCK_GRAIN_S
        return (start_s, stop_s) if is_inside else (self.first_s, self.last_s)

    def set_in(self) -> None:
        """Set the in point to the time shown; an out point that is not later is removed."""
        self.in_s = self._utc_s
        if self.out_s is not None and self.out_s <= self.in_s:
            self.out_s = None

    def set_out(self) -> None:
        """Set the out point to the time shown; an in point that is not earlier is removed."""
        self.out_s = self._utc_s
        if self.in_s is not None and self.in_s >= self.out_s:
            self.in_s = None

    def clear_part(self) -> None:
        """Remove the in and out points."""
        self.in_s = self.out_s = None

    # --- markers ---

    @property
    def marker(self) -> float | None:
        """The marker at the play head, UTC seconds since 1970; None if there is none."""
        at = bisect_left(self.markers, self._utc_s - CLOCK_GRAIN_S)
        near = self.markers[at : at + 1]
        return near[0] if near and near[0] <= self._utc_s + CLOCK_GRAIN_S else None

    def add_marker(self) -> None:
        """Add a marker at the play head, if there is none."""
        if self.marker is None:
            insort(self.markers, self._utc_s)

    def remove_marker(self, marker_s: float | None = None) -> None:
        """Remove a marker, if there is one.

        `marker_s`: the marker, UTC seconds since 1970; by default the one at the play head.
        """
        marker_s = self.marker if marker_s is None else marker_s
        if marker_s in self.markers:
            self.markers.remove(marker_s)

    def next_marker(self) -> None:
        """Go to the next marker, if there is one."""
        later = bisect_right(self.markers, self._utc_s + CLOCK_GRAIN_S)
        if later < len(self.markers):
            self.seek(self.markers[later])

    def previous_marker(self) -> None:
        """Go to the previous marker, if there is one."""
        earlier = bisect_left(self.markers, self._utc_s - CLOCK_GRAIN_S)
        if earlier:
            self.seek(self.markers[earlier - 1])

    # --- what is shown ---

    @property
    def count(self) -> int:
        """Number of exposures that the camera records on the flight; 0 if it is shorter than one."""
        return self.exposure_section.count_within(self.length_s)

    @property
    def number(self) -> int | None:
        """The number of the camera's exposure that is shown, as in an export of the complete flight.

        None for an exposure that no camera records: between two of them in sliding mode, and on a flight shorter than
        one.
        """
        if not self._numbers:
            return None
        latest = self._latest()
        shown = self.mode is Mode.CAMERA or self._utc_s <= self._nth(latest).stop_utc_s + CLOCK_GRAIN_S
        return latest if shown else None

    def exposure(self) -> Exposure:
        """Return the exposure to show, which is inside the flight.

        In camera mode it is the latest that has ended, or the first one if none has, with exactly the times of an
        export.  In sliding mode it is the one that ends at the play head, or that starts with the flight.  A flight
        that is shorter than an exposure is shown completely; see `status`.
        """
        section = self.exposure_section
        if (number := self.number) is not None:
            return self._nth(number)
        return _ending_at(self._utc_s, self.first_s, self.last_s, section)

    def gap(self, attitude: AttitudeTrack) -> Gap | None:
        """Return the longest gap of the log that the exposure shown touches; an export skips such an exposure."""
        exposure = self.exposure()
        return attitude.gap_within(exposure.start_utc_s, exposure.stop_utc_s)

    def status(self, attitude: AttitudeTrack) -> str | None:
        """Return a message about the exposure shown; None if an export of the same flight has the same exposure."""
        if (gap := self.gap(attitude)) is not None:
            return no_exposure(gap)
        if not self.count:
            return (
                f"the flight lasts {self.length_s:.3f} s, less than an exposure of"
                f" {self.exposure_section.duration_s:g} s: all of it is shown, and an export has no frame"
            )
        return None

    def _nth(self, number: int) -> Exposure:
        return self.exposure_section.nth(number, self.origin_s)

    @property
    def _numbers(self) -> range:
        """Numbers of the camera's exposures that can be shown: those still in the buffer of a live flight."""
        dropped_s = self.first_s - self.origin_s - CLOCK_GRAIN_S / 2
        return range(max(ceil(dropped_s / self.exposure_section.interval_s), 0), self.count)

    def _latest(self) -> int:
        """Return the number of the latest exposure that has ended; of the first that can be shown if none has."""
        return max(self.exposure_section.count_within(self._utc_s - self.origin_s) - 1, self._numbers[0])
