"""All boots that a log recorded, and how they become one flight: each boot by its own UTC."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import PurePath
from typing import Any, Final, Self

import numpy as np

from glstar.errors import LogFormatError, TelemetryError
from glstar.flight import AttitudeTrack, Flight, Interpolation, PositionTrack
from glstar.sky.site import Site
from glstar.sky.timescale import format_utc
from glstar.telemetry.recording import Recording, given_utc
from glstar.telemetry.source import REBOOT, Boot, Samples, TelemetrySource

__all__ = ["BootSummary", "RecordedLog", "read_flight"]

# A longer pause between boots separates flights: an export would skip days of frames.
_SAME_OUTING_S: Final = 86400.0
# A boot without a place takes that of another one, if the autopilot restarted within an hour on one clock.
_PLACE_KEEPS_S: Final = 3600.0


def read_flight(
    source: TelemetrySource,
    *,
    time_offset_s: float = 0.0,
    utc_start: float | None = None,
    site: Site | None = None,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "slerp",
) -> Flight:
    """Read a source to its end and return what it tells as one flight.

    Parameters
    ----------
    source : TelemetrySource
        An open source; it is read, not closed.
    time_offset_s, utc_start, site, max_gap_s, interpolation
        See `RecordedLog.flight`.

    Returns
    -------
    Flight

    Raises
    ------
    LogFormatError
        If there are fewer than two attitudes, or no UTC, or no place.
    """
    return RecordedLog.read(source).flight(
        time_offset_s=time_offset_s,
        utc_start=utc_start,
        site=site,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
    )


@dataclass(frozen=True, slots=True)
class BootSummary:
    """What a log holds of one boot.

    Attributes
    ----------
    number : int
        From 1, in the order of the file.
    duration_s : float
        From its first attitude to its last.
    samples : int
        Attitudes.
    utc_first, utc_last : str or None
        When that was, ISO 8601; None where its UTC is not known.
    attitude_source : str
        Empty where it has no attitude.
    left_out : str
        Why it is not part of the flight, as a message; empty if it is.
    """

    number: int
    duration_s: float
    samples: int
    utc_first: str | None
    utc_last: str | None
    attitude_source: str
    left_out: str


@dataclass(frozen=True, slots=True, eq=False)
class RecordedLog:
    """All samples of a source, boot by boot.

    Attributes
    ----------
    name : str
        The file or the endpoint.
    boots : tuple of Boot
        All that the source has, or the one that was asked for.
    recordings : dict of int to Recording
        The samples of each boot that has two attitudes or more, by its number.
    one_clock : bool
        Whether one clock runs through all boots.
    """

    name: str
    boots: tuple[Boot, ...]
    recordings: dict[int, Recording]
    one_clock: bool

    @classmethod
    def read(cls, source: TelemetrySource) -> Self:
        """Read a source to its end.

        Parameters
        ----------
        source : TelemetrySource
            An open source; it is read, not closed.

        Returns
        -------
        RecordedLog

        Raises
        ------
        LogFormatError
            If no boot has two attitudes.
        """
        batches: defaultdict[int, list[Samples]] = defaultdict(list)
        for batch in source.samples():
            batches[batch.boot].append(batch)
        found = {number: Recording.of(source.name, some, number) for number, some in sorted(batches.items())}
        if source.one_clock and found:
            clock = Recording.of(source.name, [batch for some in batches.values() for batch in some]).clock
            found = {number: replace(one, clock=clock) for number, one in found.items()}
        whole = {number: one for number, one in found.items() if np.unique(one.attitude.clock_s).size > 1}
        if not whole:
            most = max(found.values(), key=lambda one: one.attitude.clock_s.size, default=Recording.of(source.name, ()))
            most.require_two_attitudes()
        return cls(source.name, source.boots(), whole, source.one_clock)

    @property
    def longest(self) -> Recording:
        """The boot with the longest attitude."""
        return max(self.recordings.values(), key=_length_s)

    def flight(
        self,
        *,
        time_offset_s: float = 0.0,
        utc_start: float | None = None,
        site: Site | None = None,
        max_gap_s: float | None = None,
        interpolation: Interpolation = "slerp",
    ) -> Flight:
        """Return the samples as a flight: all boots of one outing, each by its own UTC, with gaps between them.

        Boots that do not fit in are left out, and the flight's notes say why: those without UTC where others have it,
        those at the same time as a longer one, those more than a day away from the longest outing.

        Parameters
        ----------
        time_offset_s : float
            Camera clock minus log clock, s: positive where the camera's clock is ahead of the log's.  The flight keeps
            the log's UTC; see `Flight`.
        utc_start : float, optional
            UTC of the first attitude sample, seconds since 1970; where given, it counts instead of the log's own UTC.
        site : Site, optional
            Where the flight was; where given, it counts instead of the log's own positions.
        max_gap_s : float, optional
            The longest silence to interpolate across, s; see `AttitudeTrack.from_samples`.
        interpolation : {"slerp", "spline", "gyro"}
            How the attitude goes between its samples; see `AttitudeTrack`.

        Returns
        -------
        Flight

        Raises
        ------
        LogFormatError
            If there is no UTC or no place, or no rates for ``"gyro"``.
        """
        flight, left_out = self._flight_of_chosen(_Request(time_offset_s, utc_start, site, max_gap_s, interpolation))
        return replace(flight, notes=(*flight.notes, *self._notes(left_out)))

    def recordings_of_flight(self, site: Site | None = None) -> list[Recording]:
        """Return the boots that the flight is made of, in the order of time.

        Parameters
        ----------
        site : Site, optional
            As for `flight`.

        Returns
        -------
        list of Recording
        """
        return [self.recordings[number] for number in self._chosen(site)[0]]

    def summaries(self, *, site: Site | None = None) -> tuple[BootSummary, ...]:
        """Return what the log holds of each boot.

        Parameters
        ----------
        site : Site, optional
            As for `flight`.

        Returns
        -------
        tuple of BootSummary
        """
        _, left_out = self._chosen(site)
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

    def _chosen(self, site: Site | None) -> tuple[dict[int, float], dict[int, str]]:
        """Return what to add to the clock of each boot of the flight, s, and why the other boots are left out."""
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
            left_out |= self._elsewhere(offset_s)
            offset_s = {number: one for number, one in offset_s.items() if number not in left_out}
        if site is None:
            placeless = self._without_place(offset_s)
            left_out |= placeless
            offset_s = {number: one for number, one in offset_s.items() if number not in placeless}
        return dict(sorted(offset_s.items(), key=lambda one: self._span_utc_s(*one)[0])), left_out

    def _span_utc_s(self, number: int, offset_s: float) -> tuple[float, float]:
        clock_s = self.recordings[number].attitude.clock_s
        return float(clock_s.min()) + offset_s, float(clock_s.max()) + offset_s

    def _elsewhere(self, offset_s: Mapping[int, float]) -> dict[int, str]:
        """Return which boots are at the same time as others, or on another day, and say so."""
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
        outings: list[list[int]] = []
        for number in sorted(kept, key=spans.__getitem__):
            if outings and spans[number][0] - spans[outings[-1][-1]][1] <= _SAME_OUTING_S:
                outings[-1].append(number)
            else:
                outings.append([number])
        longest = max(outings, key=lambda outing: sum(spans[n][1] - spans[n][0] for n in outing))
        for number in kept:
            if number not in longest:
                days = abs(spans[number][0] - spans[longest[0]][0]) / 86400
                side = "before" if spans[number][0] < spans[longest[0]][0] else "after"
                left_out[number] = f"it is {days:.1f} days {side} boot {longest[0]}"
        return left_out

    def _without_place(self, offset_s: Mapping[int, float]) -> dict[int, str]:
        """Return which boots never knew their place where another one did, and say so."""
        placed = {
            n: self._span_utc_s(n, one) for n, one in offset_s.items() if self.recordings[n].position.clock_s.size
        }
        left_out = {}
        for number, one in offset_s.items() if placed else ():
            first_s, last_s = self._span_utc_s(number, one)
            near = any(
                first_s - _PLACE_KEEPS_S < stop and start < last_s + _PLACE_KEEPS_S for start, stop in placed.values()
            )
            if number not in placed and not (self.one_clock and near):
                left_out[number] = f"it has no position ({self.recordings[number].position.source})"
        return left_out

    def _flight_of_chosen(self, request: "_Request") -> tuple[Flight, dict[int, str]]:
        offset_s, left_out = self._chosen(request.site)
        if len(offset_s) == 1:
            return self.recordings[next(iter(offset_s))].flight(**request.keywords()), left_out
        placed = [number for number in offset_s if self.recordings[number].position.clock_s.size]
        self.recordings[(placed or list(offset_s))[0]].require_utc_and_place(request.utc_start, request.site)
        earlier_s = 0.0
        if request.utc_start is not None:
            earlier_s = min(self._span_utc_s(*one)[0] for one in offset_s.items()) - request.utc_start
        attitudes, positions = {}, []
        for number, one in offset_s.items():
            recording, shift_s = self.recordings[number], one - earlier_s
            try:
                track = recording.attitude_track(
                    shift_s, max_gap_s=request.max_gap_s, interpolation=request.interpolation
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
        return Flight(
            attitude=AttitudeTrack.joined(tuple(attitudes.values()), REBOOT),
            position=PositionTrack.joined(positions) if request.site is None else PositionTrack.fixed(request.site),
            name=PurePath(self.name).name,
            attitude_source=_together({n: one.attitude_source(request.interpolation) for n, one in used.items()}),
            position_source=_together({n: o.position.source for n, o in used.items() if o.position.clock_s.size})
            if request.site is None
            else "given",
            utc_source=_together({n: one.clock.source for n, one in used.items()})
            if request.utc_start is None
            else given_utc(request.utc_start),
            time_offset_s=request.time_offset_s,
            notes=tuple(notes),
            clocks=tuple(dict.fromkeys(clock for one in used.values() for clock in one.clock_quality))
            if request.utc_start is None
            else (),
        ), left_out

    def _notes(self, left_out: Mapping[int, str]) -> tuple[str, ...]:
        """Return what there is to say about several boots: which of them the flight is, and why others are left out."""
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


@dataclass(frozen=True, slots=True)
class _Request:
    """How a log is to be read: what `RecordedLog.flight` takes."""

    time_offset_s: float
    utc_start: float | None
    site: Site | None
    max_gap_s: float | None
    interpolation: Interpolation

    def keywords(self) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(self)}


def _remedy(number: int, recording: Recording) -> str:
    lacking = "" if recording.clock.clock_s.size else " --utc-start TIME"
    return f"--boot {number}{lacking}"


def _length_s(recording: Recording) -> float:
    return float(np.ptp(recording.attitude.clock_s))


def _together(sources: Mapping[int, str]) -> str:
    """Return where each boot has something from, as one message."""
    if len(set(sources.values())) == 1:
        return next(iter(sources.values()))
    return "; ".join(f"boot {number}: {source}" for number, source in sources.items())
