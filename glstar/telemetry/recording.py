"""The samples of one boot, and their conversion to a flight: the median UTC reading converts the clock to UTC."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Literal, Self

import numpy as np

from glstar.arrays import Float
from glstar.errors import LogFormatError, TelemetryError
from glstar.flight import (
    AttitudeTrack,
    CameraTriggers,
    ClockQuality,
    Flight,
    FlightEvents,
    Interpolation,
    PositionTrack,
    mean_rate_hz,
)
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import ROLLOVER_WEEKS, WEEK_S, format_utc
from glstar.telemetry.source import (
    AttitudeSamples,
    ClockSamples,
    EventSamples,
    GimbalSamples,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
    TriggerSamples,
    flyable,
    is_missing_height,
    no_position_samples,
    two_places,
)
from glstar.telemetry.tracks import BETWEEN_FLIGHTS_S, GivenTrack

# A track that is shorter than the flight by less than this is not reported, s.
_TRACK_ENDS_S = 5.0
# A longer time without a fix is reported, s.
_TRACK_GAP_S = 300.0


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """How the samples of a log become a flight."""

    # Camera clock minus log clock, s: positive if the camera's clock is ahead; the flight keeps the UTC of the log.
    time_offset_s: float = 0.0
    # UTC of the first attitude sample, seconds since 1970; it replaces the UTC of the log.
    utc_start: float | None = None
    site: Site | None = None  # Position of the flight; it replaces the positions of the log
    max_gap_s: float | None = None  # Longest data gap to interpolate across, s; see `AttitudeTrack.from_samples`
    interpolation: Interpolation = "slerp"  # How attitude is interpolated between samples; see `AttitudeTrack`
    track: GivenTrack | None = None  # Positions of the flight from another file; they replace the positions of the log

    @property
    def position(self) -> PositionTrack | None:
        """The position that replaces the log's positions; None without one."""
        if self.track is not None:
            return self.track.track
        return None if self.site is None else PositionTrack.fixed(self.site)

    @property
    def position_source(self) -> str:
        """Where the position that replaces the log's comes from, for messages."""
        return "given" if self.track is None else self.track.source

    def notes(self, attitude: AttitudeTrack, name: str) -> tuple[str, ...]:
        """Return remarks on a track that does not cover the whole attitude of a flight from the log `name`.

        Raises LogFormatError if the track has no fix during the flight.
        """
        if self.track is None:
            return ()
        utc_s, source = self.track.fix_utc_s, self.track.source
        first_s, last_s = float(utc_s[0]), float(utc_s[-1])
        flight = f"from {format_utc(attitude.first_s)} to {format_utc(attitude.last_s)}"
        if first_s > attitude.last_s or last_s < attitude.first_s:
            track = f"from {format_utc(first_s)} to {format_utc(last_s)}"
            weeks = ROLLOVER_WEEKS * WEEK_S
            is_rolled = first_s + weeks <= attitude.last_s and last_s + weeks >= attitude.first_s
            rolled = f"; its dates are {ROLLOVER_WEEKS} weeks early, as of a receiver whose week has rolled over"
            raise LogFormatError(name, f"the track {source} lies {track}, the flight {flight}{rolled * is_rolled}")
        notes = list(self.track.notes)
        outside_s = max(first_s - attitude.first_s, 0.0), max(attitude.last_s - last_s, 0.0)
        if max(outside_s) >= _TRACK_ENDS_S:
            ends = f"{outside_s[0]:.0f} s after the flight begins and ends {outside_s[1]:.0f} s before it ends"
            notes.append(f"the track {source} begins {ends}; there its nearest fix is used")
        meets = (utc_s[:-1] < attitude.last_s) & (utc_s[1:] > attitude.first_s)
        gap_s = float(np.diff(utc_s)[meets].max(initial=0.0))
        if gap_s > BETWEEN_FLIGHTS_S and not ((utc_s >= attitude.first_s) & (utc_s <= attitude.last_s)).any():
            hours = f"for {gap_s / 3600:.1f} h around it"
            raise LogFormatError(name, f"the track {source} has no fix during the flight {flight}, and {hours}")
        within_s = np.clip(utc_s, attitude.first_s, attitude.last_s)
        if (gap_s := float(np.diff(within_s).max(initial=0.0))) > _TRACK_GAP_S:
            notes.append(
                f"the track {source} has no fix for {gap_s / 60:.0f} min of the flight; there it is interpolated"
            )
        return tuple(notes)


DEFAULT_OPTIONS = FlightOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The samples of one boot, by kind, timed by the clock of that boot."""

    name: str  # The log
    attitude: AttitudeSamples
    position: PositionSamples  # Empty if there is none; `source` then says why
    clock: ClockSamples  # Empty if there is none; `source` then says why
    rates: RateSamples  # Empty if there is none
    boot: int = 1  # Number of the boot, from 1
    triggers: tuple[TriggerSamples, ...] = ()
    gimbal: GimbalSamples | None = None  # None if the log has none
    events: tuple[EventSamples, ...] = ()
    position_notes: tuple[str, ...] = ()  # Remarks on positions that were left out

    @classmethod
    def read(cls, source: TelemetrySource) -> Self:
        """Read all samples of an open source with a single boot; it is not closed.

        Raises LogFormatError if there are fewer than two attitudes.
        """
        recording = cls.of(source.name, list(source.samples()))
        recording.require_two_attitudes()
        return recording

    @classmethod
    def of(cls, name: str, batches: Iterable[Samples], boot: int = 1) -> Self:
        """Sort batches of samples of one boot of a log by kind."""
        every = list(batches)
        position, position_notes = _position([batch for batch in every if isinstance(batch, PositionSamples)])
        return cls(
            name=name,
            attitude=_attitude([batch for batch in every if isinstance(batch, AttitudeSamples)]),
            position=position,
            position_notes=position_notes,
            clock=_clock([batch for batch in every if isinstance(batch, ClockSamples)]),
            rates=_rates([batch for batch in every if isinstance(batch, RateSamples)]),
            boot=boot,
            triggers=tuple(batch for batch in every if isinstance(batch, TriggerSamples)),
            gimbal=next((batch for batch in every if isinstance(batch, GimbalSamples)), None),
            events=tuple(batch for batch in every if isinstance(batch, EventSamples)),
        )

    def require_two_attitudes(self) -> None:
        """Raise LogFormatError if there are fewer than two attitudes."""
        if (count := np.unique(self.attitude.clock_s).size) < 2:
            raise LogFormatError(self.name, f"a flight needs two attitude samples or more; this log has {count}")

    @property
    def utc_minus_clock_s(self) -> float | None:
        """UTC minus the clock of the boot by its own readings, s; None if it has none."""
        if not self.clock.clock_s.size:
            return None
        if self.clock.utc_minus_clock_s is not None:
            return self.clock.utc_minus_clock_s
        # The median ignores single late or wrong readings; the first readings of a receiver often are.
        return float(np.median(self.clock.utc_s - self.clock.clock_s))

    @property
    def clock_quality(self) -> tuple[ClockQuality, ...]:
        """Agreement of its UTC readings: one entry; none for a single reading, or if the clock itself is UTC."""
        off_s = self.clock.utc_s - self.clock.clock_s
        if off_s.size < 2 or not off_s.any():
            return ()
        off_s = np.abs(off_s - np.median(off_s))
        quality = ClockQuality(
            readings=off_s.size,
            spread_s=round(float(np.percentile(off_s, 95)), 6),
            largest_s=round(float(off_s.max()), 6),
            lag_s=None if self.clock.lag_s is None else round(self.clock.lag_s, 6),
            lag_is_measured=self.clock.lag_is_measured,
            cut=self.clock.cut,
        )
        return (quality,)

    def flight(self, options: FlightOptions = DEFAULT_OPTIONS) -> Flight:
        """Convert the samples to a flight.

        Raises LogFormatError if there is no UTC or no position, or no rates for ``"gyro"``.
        """
        utc_start, position, interpolation = options.utc_start, options.position, options.interpolation
        self.require_utc_and_position(utc_start, position)
        if utc_start is not None:
            shift_s = utc_start - float(self.attitude.clock_s.min())
        else:
            shift_s = self.utc_minus_clock_s or 0.0
        try:
            attitude = self.attitude_track(shift_s, max_gap_s=options.max_gap_s, interpolation=interpolation)
            track = self.position_track(shift_s) if position is None else position
        except TelemetryError as error:
            raise LogFormatError(self.name, str(error)) from error
        return Flight(
            attitude=attitude,
            position=track,
            name=PurePath(self.name).name,
            attitude_source=self.attitude_source(interpolation),
            position_source=self.position.source if position is None else options.position_source,
            utc_source=self.clock.source if utc_start is None else given_utc(utc_start),
            time_offset_s=options.time_offset_s,
            notes=(*self.remarks(options), *options.notes(attitude, self.name)),
            clocks=self.clock_quality if utc_start is None else (),
            triggers=self.camera_triggers(shift_s),
            gimbal=None if self.gimbal is None else self.gimbal.over_utc(shift_s),
            events=FlightEvents.joined(part.over_utc(shift_s) for part in self.events),
        )

    def remarks(self, options: FlightOptions) -> tuple[str, ...]:
        """Return remarks for the user on how the samples that are used with some options were read."""
        of_clock = self.clock.notes if options.utc_start is None else ()
        of_positions = self.position_notes if options.position is None else ()
        if options.site is not None and options.track is None and self.position.clock_s.size:
            height = f"{options.site.height_m:g} m" + ("" if options.site.height_m else " (--height gives another)")
            place = f"the given place, at a height of {height},"
            of_positions = (f"{place} replaces the positions of the log ({self.position.source})",)
        of_triggers = [note for part in self.triggers for note in part.remarks(self.utc_minus_clock_s)]
        return tuple(dict.fromkeys((*self.attitude.notes, *of_clock, *of_positions, *of_triggers)))

    def camera_triggers(self, utc_minus_clock_s: float) -> tuple[CameraTriggers, ...]:
        """Return when each camera was triggered; see `TriggerSamples.over_utc`."""
        own_s = self.utc_minus_clock_s
        # Triggers with UTC of their own keep their distance from the attitude if the user gives another UTC.
        by_log_s, by_log = (utc_minus_clock_s, False) if own_s is None else (own_s, True)
        parts = [samples.over_utc(by_log_s, by_log=by_log) for samples in self.triggers]
        return CameraTriggers.joined(part.shifted(utc_minus_clock_s - by_log_s) for part in parts if part is not None)

    def attitude_track(
        self,
        utc_minus_clock_s: float,
        *,
        max_gap_s: float | None = None,
        interpolation: Interpolation = "slerp",
    ) -> AttitudeTrack:
        """Return the attitude over UTC; see `FlightOptions`.

        Raises TelemetryError if fewer than two samples are valid, or there are no rates for ``"gyro"``.
        """
        return AttitudeTrack.from_samples(
            self.attitude.clock_s + utc_minus_clock_s,
            self.attitude.q_body_ned,
            segment=self.attitude.segment,
            break_reason=self.attitude.break_reason,
            max_gap_s=max_gap_s,
            interpolation=interpolation,
            rates=(self.rates.clock_s + utc_minus_clock_s, self.rates.rate_rad_per_s) if self._has_rates else None,
        )

    @property
    def _has_rates(self) -> bool:
        return self.rates.clock_s.size > 1

    def attitude_source(self, interpolation: Interpolation) -> str:
        """Return where the attitude comes from, and how it is interpolated, for messages."""
        source = f"{self.attitude.source}, {_rate_hz(self.attitude.clock_s):.1f} Hz"
        if interpolation == "gyro":
            gyros = f"{self.rates.source}, {_rate_hz(self.rates.clock_s):.1f} Hz"
            return f"{source}, between samples by the gyros ({gyros})"
        return source if interpolation == "slerp" else f"{source}, between samples by a {interpolation}"

    def position_track(self, utc_minus_clock_s: float) -> PositionTrack:
        """Return the position over UTC; raises TelemetryError if no sample is valid."""
        samples = self.position
        return PositionTrack.from_samples(
            samples.clock_s + utc_minus_clock_s, samples.latitude_rad, samples.longitude_rad, samples.height_m
        )

    def require_utc_and_position(self, utc_start: float | None, position: PositionTrack | None) -> None:
        """Raise one LogFormatError for everything that neither the log nor the user provides."""
        lacks: dict[Literal["UTC", "position"], str] = {}
        needed: list[str] = []
        if utc_start is None and not self.clock.clock_s.size:
            lacks["UTC"] = self.clock.source
            needed.append("the UTC of its first attitude as utc_start (--utc-start)")
        if position is None and not self.position.clock_s.size:
            lacks["position"] = self.position.source
            needed.append("its position as latitude_deg and longitude_deg (--lat, --lon)")
        if lacks:
            lacking = [f"no {kind} ({reason})" if reason else f"no {kind}" for kind, reason in lacks.items()]
            message = f"the log has {' and '.join(lacking)}; give {' and '.join(needed)}"
            raise LogFormatError(self.name, message, lacks=lacks)


def _rate_hz(clock_s: Float) -> float:
    """Return the mean rate of samples in any order, Hz."""
    return mean_rate_hz(np.unique(clock_s[np.isfinite(clock_s)]))


def given_utc(utc_start: float) -> str:
    """Return the UTC source, for messages, if the user gives the UTC of the first attitude, seconds since 1970."""
    return f"given: the first attitude at {format_utc(utc_start)}"


def _attitude(batches: list[AttitudeSamples]) -> AttitudeSamples:
    if len(batches) == 1:
        return batches[0]
    return AttitudeSamples(
        _joined(b.clock_s for b in batches),
        _joined(b.q_body_ned for b in batches).reshape(-1, 4),
        np.concatenate([np.zeros(0, dtype=np.int64), *(b.segment for b in batches)]),
        batches[0].source if batches else "",
        batches[0].break_reason if batches else "",
        notes=tuple(dict.fromkeys(note for batch in batches for note in batch.notes)),
    )


def _position(batches: list[PositionSamples]) -> tuple[PositionSamples, tuple[str, ...]]:
    """Return the positions of all batches that an aircraft can fly, and a remark on the others."""
    columns = np.stack(
        [
            _joined(b.clock_s for b in batches),
            _joined(b.latitude_rad for b in batches),
            _joined(b.longitude_rad for b in batches),
            _joined(b.height_m for b in batches),
        ]
    )
    columns = columns[:, np.isfinite(columns).all(axis=0)]
    columns = columns[:, np.argsort(columns[0], kind="stable")]
    clock_s, _, _, height_m = columns
    missing = is_missing_height(clock_s, height_m)
    if missing.any():
        height_m[missing] = np.interp(clock_s[missing], clock_s[~missing], height_m[~missing])
    reachable = flyable(*columns)
    if where := two_places(reachable, *columns):
        return no_position_samples(where), ()
    notes = {
        f"{np.count_nonzero(~reachable)} of {clock_s.size} positions are too far from the others for an aircraft, and"
        " are left out": ~reachable,
        f"{np.count_nonzero(missing)} of {clock_s.size} heights are 0 m between others that are not: they are"
        " interpolated": missing,
    }
    clock_s, latitude_rad, longitude_rad, height_m = columns[:, reachable]
    kept = PositionSamples(clock_s, latitude_rad, longitude_rad, height_m, _source(batches))
    return kept, tuple(note for note, which in notes.items() if which.any())


def _clock(batches: list[ClockSamples]) -> ClockSamples:
    lagging = next((b for b in batches if b.lag_s is not None), None)
    offset_s = next((b.utc_minus_clock_s for b in batches if b.utc_minus_clock_s is not None), None)
    return ClockSamples(
        _joined(b.clock_s for b in batches),
        _joined(b.utc_s for b in batches),
        _source(batches),
        lag_s=None if lagging is None else lagging.lag_s,
        lag_is_measured=lagging is not None and lagging.lag_is_measured,
        notes=tuple(dict.fromkeys(note for batch in batches for note in batch.notes)),
        utc_minus_clock_s=offset_s,
        cut=sum(b.cut for b in batches),
    )


def _rates(batches: list[RateSamples]) -> RateSamples:
    return RateSamples(
        _joined(b.clock_s for b in batches), _joined(b.rate_rad_per_s for b in batches).reshape(-1, 3), _source(batches)
    )


def _joined(arrays: Iterable[Float]) -> Float:
    """Concatenate arrays; none gives an empty array."""
    parts = list(arrays)
    return np.concatenate(parts) if parts else np.empty(0)


def _source(batches: list[PositionSamples] | list[ClockSamples] | list[RateSamples]) -> str:
    """Return the source of the first batch with samples; if all are empty, why there are none."""
    return next((b.source for b in (*(b for b in batches if b.clock_s.size), *batches)), "")
