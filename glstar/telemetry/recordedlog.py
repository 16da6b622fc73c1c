"""All boots of a log, and their conversion to one flight, each boot by its own UTC."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Self

import numpy as np

from glstar.errors import LogFormatError, TelemetryError, reading
from glstar.flight import AttitudeTrack, CameraTriggers, Flight, FlightEvents, GimbalAttitude, PositionTrack
from glstar.sky.place.timescale import format_utc
from glstar.telemetry.recording import DEFAULT_OPTIONS, FlightOptions, Recording, given_utc
from glstar.telemetry.source import REBOOT, Boot, ClockSamples, Samples, TelemetrySource

# Boots separated by more than this are different flights, s; one export of both would skip days of frames.
_SAME_FLIGHT_S = 86400.0
# A boot without position uses that of another boot on the same clock within this time, s.
_POSITION_VALID_S = 3600.0


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
    log = RecordedLog.read(source)
    with reading(source.name, LogFormatError):
        return log.flight(options)


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
        """Read an open source to its end; it is not closed.  Raises LogFormatError if no boot has two attitudes."""
        # Numbers of damaged files overflow, or are signalling NaNs; samples that are not finite are left out.
        with reading(source.name, LogFormatError), np.errstate(over="ignore", invalid="ignore"):
            return cls._read(source)

    @classmethod
    def _read(cls, source: TelemetrySource) -> Self:
        batches: defaultdict[int, list[Samples]] = defaultdict(list)
        for batch in source.samples():
            batches[batch.boot].append(batch)
        name = source.name
        boots = {number: Recording.of(name, samples, number) for number, samples in sorted(batches.items())}
        if source.one_clock and boots:
            every = [batch for samples in batches.values() for batch in samples if isinstance(batch, ClockSamples)]
            clock = Recording.of(name, every).clock
            boots = {number: replace(boot, clock=clock) for number, boot in boots.items()}
        usable = {number: boot for number, boot in boots.items() if np.unique(boot.attitude.clock_s).size > 1}
        if not usable:
            most = max(boots.values(), key=lambda boot: boot.attitude.clock_s.size, default=Recording.of(name, ()))
            most.require_two_attitudes()
        return cls(name, source.boots(), usable, source.one_clock)

    @property
    def longest(self) -> Recording:
        """The boot with the longest attitude."""
        return max(self.recordings.values(), key=_length_s)

    def flight(self, options: FlightOptions = DEFAULT_OPTIONS) -> Flight:
        """Convert the samples to a flight: all boots within a day, each by its own UTC, with gaps between them.

        The notes of the flight say which boots are left out: boots without UTC if others have it, boots that overlap
        with a longer one, boots more than a day away from the longest sequence of boots.  Raises LogFormatError if
        there is no UTC or no position, or no rates for ``"gyro"``.
        """
        flight, left_out = self._flight_of_boots(options)
        return replace(flight, notes=(*flight.notes, *self._notes(left_out)))

    def recordings_of_flight(self, site: PositionTrack | None = None) -> list[Recording]:
        """Return the boots of the flight, sorted by time; `site`: the position that replaces the log's positions."""
        return [self.recordings[number] for number in self._boots_of_flight(site)[0]]

    def summaries(self, *, site: PositionTrack | None = None) -> tuple[BootSummary, ...]:
        """Return a summary of each boot; `site`: the position that replaces the log's positions."""
        _, left_out = self._boots_of_flight(site)
        return tuple(self._summary(boot, left_out) for boot in self.boots)

    def _summary(self, boot: Boot, left_out: Mapping[int, str]) -> BootSummary:
        recording = self.recordings.get(boot.number)
        if recording is None:
            return BootSummary(boot.number, 0.0, 0, None, None, "", "it has fewer than two attitudes")
        offset_s = recording.utc_minus_clock_s
        clock_s = np.unique(recording.attitude.clock_s)
        first_s, last_s = float(clock_s[0]), float(clock_s[-1])
        return BootSummary(
            number=boot.number,
            duration_s=round(last_s - first_s, 3),
            samples=clock_s.size,
            utc_first=None if offset_s is None else format_utc(first_s + offset_s),
            utc_last=None if offset_s is None else format_utc(last_s + offset_s),
            attitude_source=recording.attitude_source("slerp"),
            left_out=left_out.get(boot.number, ""),
        )

    def _boots_of_flight(self, site: PositionTrack | None) -> tuple[dict[int, float], dict[int, str]]:
        """Return UTC minus the clock of each boot of the flight, s, and why the other boots are left out."""
        recordings = self.recordings
        left_out: dict[int, str] = {
            boot.number: "it has fewer than two attitudes" for boot in self.boots if boot.number not in recordings
        }
        if self.one_clock and any(recording.utc_minus_clock_s is None for recording in recordings.values()):
            offset_s = dict.fromkeys(recordings, 0.0)
        else:
            offsets = {number: recording.utc_minus_clock_s for number, recording in recordings.items()}
            offset_s = {number: offset for number, offset in offsets.items() if offset is not None}
        if not offset_s:
            longest = max(recordings, key=lambda number: (_length_s(recordings[number]), -number))
            reason = f"without UTC its time relative to boot {longest} is not known"
            return {longest: 0.0}, left_out | {number: reason for number in recordings if number != longest}

        def leave_out(reasons: Mapping[int, str]) -> None:
            left_out.update(reasons)
            for number in reasons:
                offset_s.pop(number, None)

        leave_out({n: f"it has no UTC ({recordings[n].clock.source})" for n in recordings if n not in offset_s})
        if len(offset_s) > 1:
            leave_out({boot.number: boot.doubt for boot in self.boots if boot.doubt and boot.number in offset_s})
            leave_out(self._conflicting(offset_s))
        if site is None:
            leave_out(self._without_position(offset_s))
        return dict(sorted(offset_s.items(), key=lambda boot: self._span_utc_s(*boot)[0])), left_out

    def _span_utc_s(self, number: int, offset_s: float) -> tuple[float, float]:
        clock_s = self.recordings[number].attitude.clock_s
        return float(clock_s.min()) + offset_s, float(clock_s.max()) + offset_s

    def _conflicting(self, offset_s: Mapping[int, float]) -> dict[int, str]:
        """Return which boots overlap with others, or are on another day, with the reason for each."""
        spans = {number: self._span_utc_s(number, offset) for number, offset in offset_s.items()}
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
        """Return which boots have no position while another one has, with the reason for each."""
        spans = {number: self._span_utc_s(number, offset) for number, offset in offset_s.items()}
        with_position = {number: spans[number] for number in spans if self.recordings[number].position.clock_s.size}
        left_out: dict[int, str] = {}
        for number, (first_s, last_s) in spans.items() if with_position else ():
            near = any(
                first_s - _POSITION_VALID_S < stop and start < last_s + _POSITION_VALID_S
                for start, stop in with_position.values()
            )
            if number not in with_position and not (self.one_clock and near):
                left_out[number] = f"it has no position ({self.recordings[number].position.source})"
        return left_out

    def _flight_of_boots(self, options: FlightOptions) -> tuple[Flight, dict[int, str]]:
        """Return the flight, and why other boots are left out."""
        offset_s, left_out = self._boots_of_flight(options.position)
        if len(offset_s) == 1:
            return self.recordings[next(iter(offset_s))].flight(options), left_out
        with_position = [number for number in offset_s if self.recordings[number].position.clock_s.size]
        first = (with_position or list(offset_s))[0]
        self.recordings[first].require_utc_and_position(options.utc_start, options.position)
        earlier_s = 0.0
        if options.utc_start is not None:
            earlier_s = min(self._span_utc_s(*boot)[0] for boot in offset_s.items()) - options.utc_start
        shifts_s = {number: offset - earlier_s for number, offset in offset_s.items()}
        attitudes: dict[int, AttitudeTrack] = {}
        refusal: TelemetryError | None = None
        for number, shift_s in shifts_s.items():
            try:
                attitudes[number] = self.recordings[number].attitude_track(
                    shift_s, max_gap_s=options.max_gap_s, interpolation=options.interpolation
                )
            except TelemetryError as error:
                left_out[number] = str(error)
                refusal = error
        if not attitudes:
            raise LogFormatError(self.name, str(refusal)) from refusal
        return self._joined(attitudes, shifts_s, options), left_out

    def _joined(
        self,
        attitudes: Mapping[int, AttitudeTrack],
        shifts_s: Mapping[int, float],
        options: FlightOptions,
    ) -> Flight:
        """Return the flight of boots with some attitudes, by UTC minus the clock of each, s."""
        boots = {number: self.recordings[number] for number in attitudes}
        attitude = AttitudeTrack.joined(tuple(attitudes.values()), REBOOT)
        position, position_source = options.position, options.position_source
        if position is None:
            with_position = {number: boot for number, boot in boots.items() if boot.position.clock_s.size}
            tracks = [
                boot.position_track(shifts_s[number]).clipped(attitudes[number].first_s, attitudes[number].last_s)
                for number, boot in with_position.items()
            ]
            position = PositionTrack.joined(tracks)
            position_source = _per_boot({number: boot.position.source for number, boot in with_position.items()})
        utc_source = _per_boot({number: boot.clock.source for number, boot in boots.items()})
        clocks = tuple(dict.fromkeys(clock for boot in boots.values() for clock in boot.clock_quality))
        if options.utc_start is not None:
            utc_source, clocks = given_utc(options.utc_start), ()
        notes = _notes_per_boot({n: boot.remarks(options) for n, boot in boots.items()})
        triggers = [part for n, boot in boots.items() for part in boot.camera_triggers(shifts_s[n])]
        gimbals = [boot.gimbal.over_utc(shifts_s[number]) for number, boot in boots.items() if boot.gimbal is not None]
        return Flight(
            attitude=attitude,
            position=position,
            name=PurePath(self.name).name,
            attitude_source=_per_boot({n: boot.attitude_source(options.interpolation) for n, boot in boots.items()}),
            position_source=position_source,
            utc_source=utc_source,
            time_offset_s=options.time_offset_s,
            notes=(*notes, *options.notes(attitude, self.name)),
            gimbal=_gimbals(gimbals),
            events=FlightEvents.joined(
                events.over_utc(shifts_s[number]) for number, boot in boots.items() for events in boot.events
            ),
            triggers=CameraTriggers.joined(triggers),
            clocks=clocks,
        )

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


def _gimbals(parts: list[GimbalAttitude]) -> GimbalAttitude | None:
    """Return the attitude of a gimbal in several boots; None without any."""
    if not parts:
        return None
    return GimbalAttitude(
        np.concatenate([part.utc_s for part in parts]),
        np.concatenate([part.q_gimbal_reference for part in parts]),
        np.concatenate([part.is_earth for part in parts]),
        parts[0].source,
    )


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


def _notes_per_boot(notes: Mapping[int, tuple[str, ...]]) -> list[str]:
    """Return the remarks of all boots, each with its boot unless it is of every boot."""
    every = dict.fromkeys(note for of_boot in notes.values() for note in of_boot)
    shared = {note for note in every if all(note in of_boot for of_boot in notes.values())}
    of_one = [f"boot {number}: {note}" for number, part in notes.items() for note in part if note not in shared]
    return [*(note for note in every if note in shared), *of_one]
