"""The report of ``glstar info``: what a log holds."""

import shlex
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import degrees, radians
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from glstar.errors import LogFormatError, TelemetryError, reading
from glstar.flight import ONLY_CAMERA, AttitudeTrack, ClockQuality, Flight, mean_rate_hz
from glstar.sky.air.skybrightness import light_name
from glstar.sky.observed.solarsystem import moon_over
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import format_utc
from glstar.telemetry.recordedlog import BootSummary, RecordedLog
from glstar.telemetry.recording import DEFAULT_OPTIONS, FlightOptions, Recording
from glstar.telemetry.source import AttitudeSamples, LogFacts, TelemetrySource, archive_and_member

# At a higher rate of the attitude, slerp between samples is accurate to a fraction of a pixel, Hz.
_SLERP_SUFFICES_HZ = 45.0

# Fewer unread bytes of a file, in bytes and as a fraction, are not reported: a truncated last message, single errors.
_UNREAD_BYTES = 65536
_UNREAD_FRACTION = 0.01


@dataclass(frozen=True, slots=True)
class AttitudeSurvey:
    """An attitude in a log."""

    name: str  # Value for ``attitude=``
    samples: int
    rate_hz: float  # Mean, without gaps
    duration_s: float  # From the first sample to the last
    gaps: int
    longest_gap_s: float
    largest_rate_deg_per_s: float  # Fastest turn between two samples, without gaps


@dataclass(frozen=True, slots=True)
class GapSurvey:
    """A gap in the attitude of the flight."""

    start_s: float  # Start, from the first attitude, and length
    duration_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class GyroSurvey:
    """The gyro rates in a log."""

    source: str
    rate_hz: float


@dataclass(frozen=True, slots=True)
class TriggerSurvey:
    """The triggers of a camera in a log."""

    camera: str  # Value for ``--at``
    source: str  # The message
    count: int
    first_s: float  # Time of the first and the last, s from the first attitude
    last_s: float


@dataclass(frozen=True, slots=True)
class Survey:
    """What a log holds, and the flight that glstar reads from it."""

    file: str
    file_bytes: int
    format: str
    vehicle: str | None  # None if the log does not name them
    firmware: str | None
    duration_s: float  # From the first attitude to the last
    utc_first: str | None  # UTC of both, ISO 8601; None for a log without UTC
    utc_last: str | None
    utc_source: str  # Where UTC comes from, or why there is none
    latitude_deg: float | None  # Position in the middle of the flight; None for a log without positions
    longitude_deg: float | None
    height_m: float | None
    position_source: str  # Where the position comes from, or why there is none
    sun_altitude_deg: float | None  # Altitude of the Sun in the middle of the flight
    light: str | None  # ``"day"``, ``"night"``, or which twilight
    attitude_source: str  # The attitude of the flight
    attitudes: tuple[AttitudeSurvey, ...]  # All attitudes in the log
    gaps: tuple[GapSurvey, ...]  # Gaps in the attitude of the flight
    gyros: GyroSurvey | None
    command: str  # A suggested command
    estimator: str | None = None  # The estimator whose attitude the autopilot used; None if the log does not name it
    boots: tuple[BootSummary, ...] = ()  # All boots, if there are several
    # Quality of UTC, for each boot of the flight; empty if the user gave UTC, or if it is the clock of the log.
    clocks: tuple[ClockQuality, ...] = ()
    notes: tuple[str, ...] = ()  # Remarks for the user on how the log was read
    triggers: tuple[TriggerSurvey, ...] = ()  # When each camera was triggered
    # Altitude of the Moon in the middle of the flight, and the lit fraction of its disc.
    moon_altitude_deg: float | None = None
    moon_illuminated_fraction: float | None = None

    @property
    def gap_counts(self) -> dict[str, int]:
        """Number of gaps by reason."""
        return dict(Counter(gap.reason for gap in self.gaps).most_common())


def survey(
    source: TelemetrySource,
    options: FlightOptions = DEFAULT_OPTIONS,
    *,
    flags: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Survey, Flight]:
    """Report what an open source holds, and return its flight; the source is not closed.

    A flight without UTC starts at 1970-01-01, one without position is at 0 N 0 E.  `flags`: the options as command-line
    flags, for the suggested command.  Raises LogFormatError if the log has no attitude.
    """
    with reading(source.name, LogFormatError):
        return _survey(source, options, flags)


def _survey(source: TelemetrySource, options: FlightOptions, flags: Mapping[str, object]) -> tuple[Survey, Flight]:
    log = RecordedLog.read(source)
    recordings = log.recordings_of_flight(options.position)
    recording = recordings[0]
    numbers = [boot.boot for boot in recordings]
    lacks_utc = options.utc_start is None and recording.utc_minus_clock_s is None
    lacks_position = options.position is None and not any(boot.position.clock_s.size for boot in recordings)
    lacks = {"lacks_utc": lacks_utc, "lacks_position": lacks_position}
    utc_start = 0.0 if lacks_utc else options.utc_start
    site = Site(0.0, 0.0) if lacks_position else options.site
    flight = log.flight(replace(options, utc_start=utc_start, site=site))
    track = flight.attitude
    has_several = len(log.boots) > 1
    facts = source.facts(numbers) if has_several else source.facts()
    report = Survey(
        file=source.name,
        file_bytes=_file_bytes(source.name),
        format=facts.format,
        vehicle=facts.vehicle,
        firmware=facts.firmware,
        duration_s=round(track.last_s - track.first_s, 3),
        **_position(flight, **lacks),
        **_sources(flight, recording, **lacks),
        attitude_source=flight.attitude_source,
        attitudes=tuple(_attitudes(source, numbers, options.max_gap_s)),
        gaps=_gaps(track),
        gyros=_gyros(recording),
        estimator=facts.estimator,
        boots=log.summaries(site=options.position) if has_several else (),
        clocks=flight.clocks,
        notes=(*flight.notes, *_unread(source.name, facts)),
        triggers=_triggers(flight),
        command=_command(source.name, _flags(recording, track, **lacks) | dict(flags)),
    )
    return report, flight


def _position(flight: Flight, *, lacks_utc: bool, lacks_position: bool) -> dict[str, Any]:
    """Return position, Sun and Moon in the middle of a flight, as fields of `Survey`."""
    middle_s = (flight.attitude.first_s + flight.attitude.last_s) / 2
    site = flight.position.at(middle_s)
    sun_deg = None if lacks_utc or lacks_position else degrees(sun_altitude_rad(middle_s, site))
    moon = None if sun_deg is None else moon_over(middle_s, site)
    return {
        "moon_altitude_deg": None if moon is None else round(degrees(moon.apparent_altitude_rad), 2),
        "moon_illuminated_fraction": None if moon is None else round(moon.illuminated_fraction, 3),
        "latitude_deg": None if lacks_position else round(degrees(site.latitude_rad), 6),
        "longitude_deg": None if lacks_position else round(degrees(site.longitude_rad), 6),
        "height_m": None if lacks_position else round(site.height_m, 1),
        "sun_altitude_deg": None if sun_deg is None else round(sun_deg, 2),
        "light": None if sun_deg is None else light_name(radians(sun_deg)),
    }


def _gaps(track: AttitudeTrack) -> tuple[GapSurvey, ...]:
    return tuple(
        GapSurvey(round(gap.start_utc_s - track.first_s, 3), round(gap.duration_s, 3), gap.reason) for gap in track.gaps
    )


def _sources(flight: Flight, recording: Recording, *, lacks_utc: bool, lacks_position: bool) -> dict[str, Any]:
    """Return first and last UTC, and where UTC and position come from or why there are none, as fields of `Survey`."""
    return {
        "utc_first": None if lacks_utc else format_utc(flight.attitude.first_s),
        "utc_last": None if lacks_utc else format_utc(flight.attitude.last_s),
        "utc_source": recording.clock.source if lacks_utc else flight.utc_source,
        "position_source": recording.position.source if lacks_position else flight.position_source,
    }


def _flags(recording: Recording, track: AttitudeTrack, *, lacks_utc: bool, lacks_position: bool) -> dict[str, object]:
    """Return flags for the suggested command: words in place of what the log lacks, and the advised interpolation."""
    return (
        ({"--utc-start": "UTC"} if lacks_utc else {})
        | ({"--lat": "LATITUDE", "--lon": "LONGITUDE"} if lacks_position else {})
        | _interpolation_advice(recording, track)
    )


def _unread(name: str, facts: LogFacts) -> tuple[str, ...]:
    """Return a remark if a large part of the file could not be read."""
    fraction = facts.unread_bytes / max(_file_bytes(name), 1)
    if facts.unread_bytes < _UNREAD_BYTES or fraction < _UNREAD_FRACTION:
        return ()
    return (
        f"{facts.unread_bytes / 1e6:.1f} MB of the file, {fraction:.0%}, could not be read:"
        f" damage, or part of a log of another format than {facts.format}",
    )


def _attitudes(source: TelemetrySource, boots: Collection[int], max_gap_s: float | None) -> list[AttitudeSurvey]:
    """Return all attitudes of some boots, merged by name."""
    by_name: defaultdict[str, list[AttitudeSurvey]] = defaultdict(list)
    for name, samples in source.attitudes():
        if samples.boot in boots and (attitude := _attitude(name, samples, max_gap_s)) is not None:
            by_name[name].append(attitude)
    return [_together(parts) for parts in by_name.values()]


def _together(parts: Sequence[AttitudeSurvey]) -> AttitudeSurvey:
    """Merge one attitude of several boots; the pauses between boots are no gaps."""
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


def _attitude(name: str, samples: AttitudeSamples, max_gap_s: float | None) -> AttitudeSurvey | None:
    """Return an attitude; None if it has fewer than two samples."""
    try:
        track = AttitudeTrack.from_samples(
            samples.clock_s,
            samples.q_body_ned,
            segment=samples.segment,
            break_reason=samples.break_reason,
            max_gap_s=max_gap_s,
        )
    except TelemetryError:
        return None
    return AttitudeSurvey(
        name=name,
        samples=track.utc_s.size,
        rate_hz=round(mean_rate_hz(track.utc_s), 2),
        duration_s=round(track.last_s - track.first_s, 3),
        gaps=len(track.gaps),
        longest_gap_s=round(max((gap.duration_s for gap in track.gaps), default=0.0), 3),
        largest_rate_deg_per_s=round(degrees(float(np.linalg.norm(track.rates()[1], axis=-1).max(initial=0.0))), 1),
    )


def _triggers(flight: Flight) -> tuple[TriggerSurvey, ...]:
    return tuple(
        TriggerSurvey(
            camera=triggers.camera if len(flight.triggers) > 1 else ONLY_CAMERA,
            source=triggers.source,
            count=triggers.utc_s.size,
            first_s=round(float(triggers.utc_s.min()) - flight.attitude.first_s, 3),
            last_s=round(float(triggers.utc_s.max()) - flight.attitude.first_s, 3),
        )
        for triggers in flight.triggers
    )


def _gyros(recording: Recording) -> GyroSurvey | None:
    clock_s = np.unique(recording.rates.clock_s)
    if clock_s.size < 2:
        return None
    return GyroSurvey(recording.rates.source, round(mean_rate_hz(clock_s), 2))


def _interpolation_advice(recording: Recording, track: AttitudeTrack) -> dict[str, object]:
    """Return the flag of a better interpolation; nothing if slerp suffices."""
    if track.interpolation != "slerp" or track.rate_hz > _SLERP_SUFFICES_HZ:
        return {}
    gyros = _gyros(recording)
    return {"--interpolation": "gyro" if gyros is not None and gyros.rate_hz > 2 * track.rate_hz else "spline"}


def _command(name: str, flags: Mapping[str, object]) -> str:
    arguments = ("glstar", "export", name, "-o", "frames", *chain.from_iterable(flags.items()))
    return shlex.join(map(str, arguments))


def _file_bytes(name: str) -> int:
    path = Path(archive_and_member(name)[0])
    # The directory of a ROS 2 bag is as large as its files.
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
