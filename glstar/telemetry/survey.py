"""What a log holds, told before anything is drawn of it."""

import shlex
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from math import degrees
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import TelemetryError
from glstar.flight import AttitudeTrack, ClockQuality, Flight, Interpolation
from glstar.sky.observed import sun_altitude_rad
from glstar.sky.site import Site
from glstar.sky.timescale import format_utc
from glstar.telemetry.recordedlog import BootSummary, RecordedLog
from glstar.telemetry.recording import Recording
from glstar.telemetry.source import AttitudeSamples, TelemetrySource

__all__ = ["AttitudeSurvey", "GapSurvey", "GyroSurvey", "Survey", "survey"]

Float = NDArray[np.float64]

# Attitude that comes more often than this is known between its samples to a fraction of a pixel by slerp too.
_OFTEN_HZ: Final = 45.0

# The Sun's altitude, deg, above which it is what; below all of them it is night.
_LIGHT: Final = (
    (-0.833, "day"),
    (-6.0, "civil twilight"),
    (-12.0, "nautical twilight"),
    (-18.0, "astronomical twilight"),
)


@dataclass(frozen=True, slots=True)
class AttitudeSurvey:
    """One of the attitudes that a log has.

    Attributes
    ----------
    name : str
        What ``attitude=`` takes.
    samples : int
    rate_hz : float
        One over the usual interval.
    duration_s : float
        From the first sample to the last.
    gaps : int
    longest_gap_s : float
    largest_rate_deg_per_s : float
        The fastest turn between two samples, gaps aside.
    """

    name: str
    samples: int
    rate_hz: float
    duration_s: float
    gaps: int
    longest_gap_s: float
    largest_rate_deg_per_s: float


@dataclass(frozen=True, slots=True)
class GapSurvey:
    """A gap of the attitude that is used.

    Attributes
    ----------
    start_s, duration_s : float
        Seconds from the first attitude; for how long.
    reason : str
    """

    start_s: float
    duration_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class GyroSurvey:
    """The gyros that a log has.

    Attributes
    ----------
    source : str
    rate_hz : float
    """

    source: str
    rate_hz: float


@dataclass(frozen=True, slots=True)
class Survey:
    """What a log holds, and what glstar would make of it.

    Attributes
    ----------
    file : str
    file_bytes : int
    format : str
    vehicle, firmware : str or None
        As far as the log tells.
    duration_s : float
        From the first attitude to the last.
    utc_first, utc_last : str or None
        When that was, ISO 8601; None for a log without UTC.
    utc_source : str
        Where UTC comes from; or why there is none.
    latitude_deg, longitude_deg, height_m : float or None
        The place in the middle of the flight; None for a log without positions.
    position_source : str
        Where it comes from; or why there is none.
    sun_altitude_deg : float or None
        Of the Sun, in the middle of the flight.
    light : str or None
        Day, night, or which twilight that is.
    attitude_source : str
        The attitude that is used.
    attitudes : tuple of AttitudeSurvey
        All that can be asked for.
    gaps : tuple of GapSurvey
        Of the attitude that is used.
    gyros : GyroSurvey or None
    command : str
        What to try next.
    estimator : str or None
        By whose attitude the autopilot flew, as far as the log tells.
    boots : tuple of BootSummary
        Of a log of several boots of the autopilot: all of them.
    clocks : tuple of ClockQuality
        How well UTC is known, for each boot of the flight; empty where it was given, or is the log's own clock.
    notes : tuple of str
        What somebody who uses the flight should know of how the log was read, a message each.
    """

    file: str
    file_bytes: int
    format: str
    vehicle: str | None
    firmware: str | None
    duration_s: float
    utc_first: str | None
    utc_last: str | None
    utc_source: str
    latitude_deg: float | None
    longitude_deg: float | None
    height_m: float | None
    position_source: str
    sun_altitude_deg: float | None
    light: str | None
    attitude_source: str
    attitudes: tuple[AttitudeSurvey, ...]
    gaps: tuple[GapSurvey, ...]
    gyros: GyroSurvey | None
    command: str
    estimator: str | None = None
    boots: tuple[BootSummary, ...] = ()
    clocks: tuple[ClockQuality, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def gap_counts(self) -> dict[str, int]:
        """How many gaps there are, by reason."""
        return dict(Counter(gap.reason for gap in self.gaps).most_common())


def survey(
    source: TelemetrySource,
    *,
    time_offset_s: float = 0.0,
    utc_start: float | None = None,
    site: Site | None = None,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "slerp",
    flags: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Survey, Flight]:
    """Return what a log holds, and its flight; where it lacks UTC or place, the flight is at 1970 or at 0 N 0 E.

    Parameters
    ----------
    source : TelemetrySource
        An open source; it is read, not closed.
    time_offset_s, utc_start, site, max_gap_s, interpolation
        See `RecordedLog.flight`.
    flags : mapping of str to object
        How the command line spells that, by flag: the command to try makes of the log what was asked for here.

    Returns
    -------
    Survey
    Flight

    Raises
    ------
    LogFormatError
        If the log has no attitude.
    """
    log = RecordedLog.read(source)
    recordings = log.recordings_of_flight(site)
    recording = recordings[0]
    lacks_utc = utc_start is None and recording.utc_minus_clock_s is None
    lacks_place = site is None and not any(one.position.clock_s.size for one in recordings)
    flight = log.flight(
        time_offset_s=time_offset_s,
        utc_start=0.0 if lacks_utc else utc_start,
        site=Site(0.0, 0.0) if lacks_place else site,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
    )
    track = flight.attitude
    middle_s = (track.first_s + track.last_s) / 2
    place = flight.position.at(middle_s)
    sun_deg = None if lacks_utc or lacks_place else degrees(sun_altitude_rad(middle_s, place))
    facts = source.facts([one.boot for one in recordings]) if len(log.boots) > 1 else source.facts()
    found = Survey(
        file=source.name,
        file_bytes=_file_bytes(source.name),
        format=facts.format,
        vehicle=facts.vehicle,
        firmware=facts.firmware,
        duration_s=round(track.last_s - track.first_s, 3),
        utc_first=None if lacks_utc else format_utc(track.first_s),
        utc_last=None if lacks_utc else format_utc(track.last_s),
        utc_source=recording.clock.source if lacks_utc else flight.utc_source,
        latitude_deg=None if lacks_place else round(degrees(place.latitude_rad), 6),
        longitude_deg=None if lacks_place else round(degrees(place.longitude_rad), 6),
        height_m=None if lacks_place else round(place.height_m, 1),
        position_source=recording.position.source if lacks_place else flight.position_source,
        sun_altitude_deg=None if sun_deg is None else round(sun_deg, 2),
        light=None if sun_deg is None else _light(sun_deg),
        attitude_source=flight.attitude_source,
        attitudes=tuple(_attitudes(source, {one.boot for one in recordings}, max_gap_s)),
        gaps=tuple(
            GapSurvey(round(gap.start_utc_s - track.first_s, 3), round(gap.duration_s, 3), gap.reason)
            for gap in track.gaps
        ),
        gyros=_gyros(recording),
        estimator=facts.estimator,
        boots=log.summaries(site=site) if len(log.boots) > 1 else (),
        clocks=flight.clocks,
        notes=flight.notes,
        command=_command(
            source.name,
            ({"--utc-start": "2024-03-10T11:00:00Z"} if lacks_utc else {})
            | ({"--lat": -34.93, "--lon": 138.60} if lacks_place else {})
            | _advice(recording, track)
            | dict(flags),
        ),
    )
    return found, flight


def _attitudes(source: TelemetrySource, boots: Collection[int], max_gap_s: float | None) -> "list[AttitudeSurvey]":
    """Return all attitudes of some boots, those of one name together."""
    found: defaultdict[str, list[AttitudeSurvey]] = defaultdict(list)
    for name, told in source.attitudes():
        if told.boot in boots and (one := _attitude(name, told, max_gap_s)) is not None:
            found[name].append(one)
    return [_together(parts) for parts in found.values()]


def _together(parts: "Sequence[AttitudeSurvey]") -> AttitudeSurvey:
    """Return one attitude of several boots as one; where each ends is no gap."""
    if len(parts) == 1:
        return parts[0]
    return AttitudeSurvey(
        name=parts[0].name,
        samples=sum(part.samples for part in parts),
        rate_hz=max(parts, key=lambda part: part.samples).rate_hz,
        duration_s=round(sum(part.duration_s for part in parts), 3),
        gaps=sum(part.gaps for part in parts),
        longest_gap_s=max(part.longest_gap_s for part in parts),
        largest_rate_deg_per_s=max(part.largest_rate_deg_per_s for part in parts),
    )


def _attitude(name: str, told: AttitudeSamples, max_gap_s: float | None) -> AttitudeSurvey | None:
    """Return one attitude; None where it has fewer than two samples."""
    try:
        track = AttitudeTrack.from_samples(
            told.clock_s, told.q_body_ned, segment=told.segment, break_reason=told.break_reason, max_gap_s=max_gap_s
        )
    except TelemetryError:
        return None
    return AttitudeSurvey(
        name=name,
        samples=track.utc_s.size,
        rate_hz=round(track.rate_hz, 2),
        duration_s=round(track.last_s - track.first_s, 3),
        gaps=len(track.gaps),
        longest_gap_s=round(max((gap.duration_s for gap in track.gaps), default=0.0), 3),
        largest_rate_deg_per_s=round(degrees(float(np.linalg.norm(track.rates()[1], axis=-1).max(initial=0.0))), 1),
    )


def _gyros(recording: Recording) -> GyroSurvey | None:
    clock_s = np.unique(recording.rates.clock_s)
    if clock_s.size < 2:
        return None
    return GyroSurvey(recording.rates.source, round(1 / float(np.median(np.diff(clock_s))), 2))


def _light(sun_altitude_deg: float) -> str:
    return next((name for least_deg, name in _LIGHT if sun_altitude_deg > least_deg), "night")


def _advice(recording: Recording, track: AttitudeTrack) -> dict[str, object]:
    """Return the interpolation that pays, nothing where slerp is as good."""
    if track.interpolation != "slerp" or track.rate_hz > _OFTEN_HZ:
        return {}
    gyros = _gyros(recording)
    return {"--interpolation": "gyro" if gyros is not None and gyros.rate_hz > 2 * track.rate_hz else "spline"}


def _command(name: str, flags: Mapping[str, object]) -> str:
    words = ("glstar", "export", name, "-o", "frames", *chain.from_iterable(flags.items()))
    return shlex.join(str(word) for word in words)


def _file_bytes(name: str) -> int:
    path = Path(name)
    return path.stat().st_size if path.is_file() else 0
