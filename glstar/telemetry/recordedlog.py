"""All boots of a log, and their conversion to one flight, each boot by its own UTC."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Final, Self

import numpy as np

from glstar.errors import LogFormatError, TelemetryError
from glstar.flight import AttitudeTrack, CameraTriggers, Flight, FlightEvents, GimbalAttitude, PositionTrack
from glstar.sky.place.timescale import format_utc
from glstar.telemetry.recording import DEFAULT_OPTIONS, FlightOptions, Recording, given_utc
from glstar.telemetry.source import REBOOT, Boot, Samples, TelemetrySource

# Boots separated by more than this are different flights, s; one export of both would skip days of frames.
_SAME_FLIGHT_S: Final = 86400.0
# A boot without position uses that of another boot on the same clock within this time, s.
_POSITION_VALID_S: Final = 3600.0


def read_flight(source: TelemetrySource, options: FlightOptions = DEFAULT_OPTIONS) -> Flight:
    """Read a source to its end and convert its samples to one flight.

    Parameters
    ----------
    source : TelemetrySource
        An open source; it is not closed.
    options : FlightOptions, optional

    Returns
    -------
    Flight

    Raises
    ------
    LogFormatError
        If there are fewer than two attitudes, no UTC or no position, or no rates for ``"gyro"``.
    """
    return RecordedLog.read(source).flight(options)


@dataclass(frozen=True, slots=True)
class BootSummary:
    """Summary of one boot of a log."""

    number: int  # From 1, in the order of the file
    duration_s: float  # From the first attitude to the last
    samples: int  # Number of attitudes
    utc_first: str | None  # UTC of the first and the last attitude, ISO 8601; None if unknown
    utc_last: str | None
    attitude_source: str  # Empty if there is no attitude
    left_out: str  # Why it is not part of the flight; empty if it is


@dataclass(frozen=True, slots=True, eq=False)
class RecordedLog:
    """All samples of a source, boot by boot."""

    name: str  # The log
    boots: tuple[Boot, ...]  # All boots of the source, or the requested one
    recordings: dict[int, Recording]  # The samples of each boot with two attitudes or more, by its number
    one_clock: bool  # Whether the clock continues through all boots

    @classmethod
    def read(cls, source: TelemetrySource) -> Self:
        """Read a source to its end.

        `source`: an open source; it is not closed.  Raises LogFormatError if no boot has two attitudes.
        """
        batches: defaultdict[int, list[Samples]] = defaultdict(list)
        for batch in source.samples():
            batches[batch.boot].append(batch)
        found = {number: Recording.of(source.name, some, number) for number, some in sorted(batches.items())}
        if source.one_clock and found:
            clock = Recording.of(source.name, [batch for some in batches.values() for batch in some]).clock
            found = {number: replace(one, clock=clock) for number, one in found.items()}
        usable = {number: one for number, one in found.items() if np.unique(one.attitude.clock_s).size > 1}
        if not usable:
            most = max(found.values(), key=lambda one: one.attitude.clock_s.size, default=Recording.of(source.name, ()))
            most.require_two_attitudes()
        return cls(source.name, source.boots(), usable, source.one_clock)

    @property
    def longest(self) -> Recording:
        """The boot with the longest attitude."""
        return max(self.recordings.values(), key=_length_s)

    def flight(self, options: FlightOptions = DEFAULT_OPTIONS) -> Flight:
        """Convert the samples to a flight: all boots within a day, each by its own UTC, with gaps between them.

        Boots that do not fit are left out, with a remark in the notes of the flight: boots without UTC if others have
        it, boots that overlap with a longer one, boots more than a day away from the longest sequence of boots.
        Raises LogFormatError if there is no UTC or no position, or no rates for ``"gyro"``.
        """
        flight, left_out = self._flight_of_boots(options)
        return replace(flight, notes=(*flight.notes, *self._notes(left_out)))

    def recordings_of_flight(self, site: PositionTrack | None = None) -> list[Recording]:
        """Return the boots of the flight, sorted by time; `site`: the given position."""
        return [self.recordings[number] for number in self._boots_of_flight(site)[0]]

    def summaries(self, *, site: PositionTrack | None = None) -> tuple[BootSummary, ...]:
        """Return a summary of each boot; `site`: the given position."""
        _, left_out = self._boots_of_flight(site)
        return tuple(self._summary(boot, left_out) for boot in self.boots)

    def _summary(self, boot: Boot, left_out: Mapping[int, str]) -> BootSummary:
        recording = self.recordings.get(boot.number)
        if recording is None:
            return BootSummary(boot.number, 0.0, 0, None, None, "", "it has fewer than two attitudes")
        offset_s = recording.utc_minus_clock_s
        first_s, last_s = (float(end) for end in (recording.attitude.clock_s.min(), recording.attitude.clock_s.max()))
        utc = (None, None) if offset_s is None else (first_s + offset_s, last_s + offset_s)
        return BootSummary(
            number=boot.number,
            duration_s=round(last_s - first_s, 3),
            samples=int(np.unique(recording.attitude.clock_s).size),
            utc_first=None if utc[0] is None else format_utc(utc[0]),
            utc_last=None if utc[1] is None else format_utc(utc[1]),
            attitude_source=recording.attitude_source("slerp"),
            left_out=left_out.get(boot.number, ""),
        )

    def _boots_of_flight(self, site: PositionTrack | None) -> tuple[dict[int, float], dict[int, str]]:
        """Return UTC minus the clock of each boot of the flight, s, and why the other boots are left out."""
        recordings = self.recordings
        left_out: dict[int, str] = {
            boot.number: "it has fewer than two attitudes" for boot in self.boots if boot.number not in recordings
        }
        known = {number: one.utc_minus_clock_s for number, one in recordings.items()}
        if self.one_clock and None in known.values():
            known = dict.fromkeys(known, 0.0)
        elif not any(offset_s is not None for offset_s in known.values()):
            longest = max(recordings, key=lambda number: (_length_s(recordings[number]), -number))
            others = {
                n: f"without UTC its time relative to boot {longest} is not known" for n in recordings if n != longest
            }
            return {longest: 0.0}, left_out | others
        offset_s = {number: one for number, one in known.items() if one is not None}
        left_out |= {n: f"it has no UTC ({recordings[n].clock.source})" for n in recordings if n not in offset_s}
        if len(offset_s) > 1:
            doubted = {boot.number: boot.doubt for boot in self.boots if boot.doubt and boot.number in offset_s}
            left_out |= doubted
            offset_s = {number: one for number, one in offset_s.items() if number not in doubted}
            left_out |= self._conflicting(offset_s)
            offset_s = {number: one for number, one in offset_s.items() if number not in left_out}
        if site is None:
            without_position = self._without_position(offset_s)
            left_out |= without_position
            offset_s = {number: one for number, one in offset_s.items() if number not in without_position}
        return dict(sorted(offset_s.items(), key=lambda one: self._span_utc_s(*one)[0])), left_out

    def _span_utc_s(self, number: int, offset_s: float) -> tuple[float, float]:
        clock_s = self.recordings[number].attitude.clock_s
        return float(clock_s.min()) + offset_s, float(clock_s.max()) + offset_s

    def _conflicting(self, offset_s: Mapping[int, float]) -> dict[int, str]:
        """Return which boots overlap with others, or are on another day, with a message each."""
        spans = {number: self._span_utc_s(number, one) for number, one in offset_s.items()}
        by_length = sorted(spans, key=lambda number: (spans[number][0] - spans[number][1], number))
        left_out: dict[int, str] = {}
        kept: list[int] = []
        for number in by_length:
            first_s, last_s = spans[number]
            other = next((k for k in kept if first_s <= spans[k][1] and spans[k][0] <= last_s), None)
            if other is None:
                kept.append(number)
            else:
                left_out[number] = f"it is at the same time as boot {other}"
        groups: list[list[int]] = []
        for number in sorted(kept, key=spans.__getitem__):
            if groups and spans[number][0] - spans[groups[-1][-1]][1] <= _SAME_FLIGHT_S:
                groups[-1].append(number)
            else:
                groups.append([number])
        longest = max(groups, key=lambda group: sum(spans[n][1] - spans[n][0] for n in group))
        for number in kept:
            if number not in longest:
                days = abs(spans[number][0] - spans[longest[0]][0]) / 86400
                side = "before" if spans[number][0] < spans[longest[0]][0] else "after"
                left_out[number] = f"it is {days:.1f} days {side} boot {longest[0]}"
        return left_out

    def _without_position(self, offset_s: Mapping[int, float]) -> dict[int, str]:
        """Return which boots have no position while another one has, with a message each."""
        with_position = {
            n: self._span_utc_s(n, one) for n, one in offset_s.items() if self.recordings[n].position.clock_s.size
        }
        left_out = {}
        for number, one in offset_s.items() if with_position else ():
            first_s, last_s = self._span_utc_s(number, one)
            near = any(
                first_s - _POSITION_VALID_S < stop and start < last_s + _POSITION_VALID_S
                for start, stop in with_position.values()
            )
            if number not in with_position and not (self.one_clock and near):
                left_out[number] = f"it has no position ({self.recordings[number].position.source})"
        return left_out

    def _flight_of_boots(self, options: FlightOptions) -> tuple[Flight, dict[int, str]]:
        given = options.position
        offset_s, left_out = self._boots_of_flight(given)
        if len(offset_s) == 1:
            return self.recordings[next(iter(offset_s))].flight(options), left_out
        with_position = [number for number in offset_s if self.recordings[number].position.clock_s.size]
        self.recordings[(with_position or list(offset_s))[0]].require_utc_and_position(options.utc_start, given)
        earlier_s = 0.0
        if options.utc_start is not None:
            earlier_s = min(self._span_utc_s(*one)[0] for one in offset_s.items()) - options.utc_start
        attitudes, positions = {}, []
        for number, one in offset_s.items():
            recording, shift_s = self.recordings[number], one - earlier_s
            try:
                track = recording.attitude_track(
                    shift_s, max_gap_s=options.max_gap_s, interpolation=options.interpolation
                )
            except TelemetryError as error:
                left_out[number], refusal = str(error), error
                continue
            attitudes[number] = track
            if recording.position.clock_s.size:
                positions.append(recording.position_track(shift_s).clipped(track.first_s, track.last_s))
        if not attitudes:
            raise LogFormatError(self.name, str(refusal)) from refusal
        used = {number: self.recordings[number] for number in attitudes}
        notes = [f"boot {number}: {note}" for number, one in used.items() for note in one.attitude.notes]
        attitude = AttitudeTrack.joined(tuple(attitudes.values()), REBOOT)
        return Flight(
            attitude=attitude,
            position=PositionTrack.joined(positions) if given is None else given,
            name=PurePath(self.name).name,
            attitude_source=_per_boot({n: one.attitude_source(options.interpolation) for n, one in used.items()}),
            position_source=_per_boot({n: o.position.source for n, o in used.items() if o.position.clock_s.size})
            if given is None
            else options.position_source,
            utc_source=_per_boot({n: one.clock.source for n, one in used.items()})
            if options.utc_start is None
            else given_utc(options.utc_start),
            time_offset_s=options.time_offset_s,
            notes=(*notes, *options.notes(attitude, self.name)),
            gimbal=_gimbals(
                [known.over_utc(offset_s[n] - earlier_s) for n in used if (known := used[n].gimbal) is not None]
            ),
            events=FlightEvents.joined(
                e.over_utc(offset_s[n] - earlier_s) for n, one in used.items() for e in one.events
            ),
            triggers=_triggers([used[n].camera_triggers(offset_s[n] - earlier_s, by_log=not earlier_s) for n in used]),
            clocks=tuple(dict.fromkeys(clock for one in used.values() for clock in one.clock_quality))
            if options.utc_start is None
            else (),
        ), left_out

    def _notes(self, left_out: Mapping[int, str]) -> tuple[str, ...]:
        """Return remarks about several boots: which are in the flight, and why others are left out."""
        if len(self.boots) < 2:
            return ()
        used = [str(boot.number) for boot in self.boots if boot.number not in left_out]
        taken = f"boot {used[0]}" if len(used) == 1 else f"boots {', '.join(used[:-1])} and {used[-1]}"
        notes = [f"the log holds {len(self.boots)} boots of the autopilot; this flight is {taken} (--boot N takes one)"]
        for number, why in sorted(left_out.items()):
            recording = self.recordings.get(number)
            if recording is None:
                notes.append(f"boot {number} is left out: {why}")
            else:
                remedy = _remedy(number, recording)
                notes.append(f"boot {number}, {_length_s(recording):.1f} s, is left out: {why}; {remedy} takes it")
        return tuple(notes)


def _triggers(parts: list[CameraTriggers | None]) -> CameraTriggers | None:
    """Return the triggers of several boots."""
    found = [part for part in parts if part is not None]
    return CameraTriggers(np.concatenate([part.utc_s for part in found]), found[0].source) if found else None


def _gimbals(found: list[GimbalAttitude]) -> GimbalAttitude | None:
    """Return the attitude of a gimbal in several boots."""
    if not found:
        return None
    utc_s, q, is_earth = (
        np.concatenate(columns)
        for columns in zip(*((one.utc_s, one.q_gimbal_reference, one.is_earth) for one in found), strict=True)
    )
    return GimbalAttitude(utc_s, q, is_earth, found[0].source)


def _remedy(number: int, recording: Recording) -> str:
    lacking = "" if recording.clock.clock_s.size else " --utc-start TIME"
    return f"--boot {number}{lacking}"


def _length_s(recording: Recording) -> float:
    return float(np.ptp(recording.attitude.clock_s))


def _per_boot(sources: Mapping[int, str]) -> str:
    """Return the sources of all boots as one message."""
    if len(set(sources.values())) == 1:
        return next(iter(sources.values()))
    return "; ".join(f"boot {number}: {source}" for number, source in sources.items())
