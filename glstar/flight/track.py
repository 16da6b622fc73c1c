"""Where the aircraft was pointing, where it was, and when.

An autopilot logs attitude some 30 times a second; an exposure asks for it 200 times a second.  An `AttitudeTrack`
keeps the logged quaternions and answers for any time between the first and the last of them; a `PositionTrack`
does so for the place.  A `Flight` is the two together, with where each came from.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import TelemetryError, TrackRangeError
from glstar.flight.interpolation import RotationSpline, gyro_aided, unfelt_turns
from glstar.rotation import slerp, turn_between
from glstar.sky.site import Site
from glstar.sky.timescale import CLOCK_GRAIN_S

__all__ = ["JUMP", "SILENCE", "AttitudeTrack", "ClockQuality", "Flight", "Gap", "Interpolation", "PositionTrack"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# How to answer between two samples: at one rate; along a smooth curve; as the gyros felt it.
Interpolation = Literal["slerp", "spline", "gyro"]

# Why there is a gap.
SILENCE: Final = "a silence"
JUMP: Final = "a jump"

# A silence is a gap if it lasts longer than so many usual intervals, and than any jitter of a log.
_USUAL_INTERVALS: Final = 3
_LEAST_GAP_S: Final = 0.1

# No aircraft turns faster; an estimator that is reset does.  A degree of grace, for two samples may be stamped alike.
_FASTEST_RAD_PER_S: Final = np.deg2rad(3000.0)
_GRACE_RAD: Final = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True)
class Gap:
    """Where a record must not be interpolated.

    Attributes
    ----------
    start_utc_s, stop_utc_s : float
        The samples before and after it, UTC seconds since 1970.
    reason : str
        Why, in words: ``"a silence"``, ``"a jump"``, ``"a switch of the EKF lane"``.
    """

    start_utc_s: float
    stop_utc_s: float
    reason: str

    @property
    def duration_s(self) -> float:
        """How long it lasts, s."""
        return self.stop_utc_s - self.start_utc_s


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeTrack:
    """A recorded history of attitude.

    Attributes
    ----------
    utc_s : (n,) float64, n >= 2
        Sample times, UTC seconds since 1970, strictly increasing.
    q_body_ned : (n, 4) float64
        Unit quaternions (w, x, y, z) that turn NED components into body ones.
    gaps : tuple of Gap
        Where the record must not be interpolated, for it is silent too long or jumps; in order, none overlaps another.
    interpolation : {"slerp", "spline", "gyro"}
        What `at` says between two samples.  ``"slerp"``, the paper's: the aircraft turned at one rate.  ``"spline"``:
        its rate and angular acceleration were continuous (`RotationSpline`).  ``"gyro"``: as its
        gyros felt it (`gyro_aided`; `from_samples` does so).  Across a gap all of them turn at one rate.

    Raises
    ------
    TelemetryError
        If the times do not rise, or there are fewer than two of them.
    """

    utc_s: Float
    q_body_ned: Float
    gaps: tuple[Gap, ...] = ()
    interpolation: Interpolation = "slerp"
    _curve: RotationSpline | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.utc_s.ndim != 1 or self.q_body_ned.shape != (self.utc_s.size, 4):
            raise TelemetryError(
                "an attitude track pairs (n,) times with (n, 4) quaternions,"
                f" not {self.utc_s.shape} with {self.q_body_ned.shape}"
            )
        if self.utc_s.size < 2:
            raise TelemetryError(f"an attitude track needs two samples or more, not {self.utc_s.size}")
        if not np.all(np.diff(self.utc_s) > 0):
            raise TelemetryError("the times of an attitude track must rise")
        if self.interpolation != "slerp" and self._curve is None:
            curve = RotationSpline.through(self.utc_s, self.q_body_ned, broken=_broken(self.utc_s, self.gaps))
            object.__setattr__(self, "_curve", curve)
        _freeze(self.utc_s, self.q_body_ned)

    @classmethod
    def from_samples(
        cls,
        utc_s: ArrayLike,
        q_body_ned: ArrayLike,
        *,
        stretch: ArrayLike | None = None,
        break_reason: str = "a reset of the estimator",
        max_gap_s: float | None = None,
        interpolation: Interpolation = "slerp",
        rates: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> Self:
        """Return a track from samples as a log holds them: unsorted, repeated, rounded.

        Parameters
        ----------
        utc_s : (n,) array_like
            Sample times, UTC seconds since 1970, in any order; of equal times the first counts.
        q_body_ned : (n, 4) array_like
            Quaternions (w, x, y, z), NED to body, of any length but zero; samples that are not finite, or all zeros,
            are left out.
        stretch : (n,) array_like of int, optional
            Which unbroken stretch each belongs to; between two stretches is a gap.
        break_reason : str
            What a new stretch means, in words.
        max_gap_s : float, optional
            The longest silence to interpolate across, s.  By default three usual intervals, and 0.1 s at the least.
            It does not bridge what is no silence: another stretch, or a jump: a turn of more than 3000 deg/s, or one
            that no aircraft has made (`unfelt_turns`).
        interpolation : {"slerp", "spline", "gyro"}
            See `AttitudeTrack`.
        rates : ((m,) array_like, (m, 3) array_like), optional
            Readings of the gyros: UTC seconds since 1970, and turn rates about the body's axes forward, right, down,
            rad/s; see `gyro_aided`.  They tell jumps, and ``"gyro"`` needs them.

        Returns
        -------
        AttitudeTrack

        Raises
        ------
        TelemetryError
            If fewer than two samples remain, or ``"gyro"`` is given no rates.
        """
        if interpolation == "gyro" and rates is None:
            raise TelemetryError(
                'interpolation "gyro" needs the rates of gyros, and there are none; take "spline" (or "slerp")'
            )
        t, q = np.asarray(utc_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64).reshape(-1, 4)
        of = np.zeros(t.shape, dtype=np.int64) if stretch is None else np.asarray(stretch)
        if t.shape != q.shape[:1] or of.shape != t.shape:
            raise TelemetryError(f"an attitude track pairs times with quaternions, not {t.size} with {len(q)}")
        length = np.linalg.norm(q, axis=-1)
        whole = np.isfinite(t) & np.isfinite(length) & (length > 0)
        t, first = np.unique(t[whole], return_index=True)
        q, of = q[whole][first] / length[whole][first, np.newaxis], of[whole][first]
        if t.size < 2:
            raise TelemetryError(f"an attitude track needs two samples or more, not {t.size}")
        unfelt = unfelt_turns(t, q, *(rates or ()))
        gaps = tuple(_gaps(t, q, of, unfelt, break_reason, max_gap_s))
        if interpolation == "gyro" and rates is not None:
            curve = gyro_aided(t, q, *rates, broken=_broken(t, gaps))
            return cls(curve.t_s, curve.q_body_ned, gaps, interpolation, curve)
        return cls(t, q, gaps, interpolation)

    @classmethod
    def joined(cls, tracks: Sequence[Self], reason: str) -> Self:
        """Return tracks that follow each other as one, with a gap between each two.

        Parameters
        ----------
        tracks : sequence of AttitudeTrack
            One or more, of one kind of interpolation, in the order of time; none overlaps another.
        reason : str
            Why there is a gap between them, as a message.

        Returns
        -------
        AttitudeTrack
        """
        gaps = list(tracks[0].gaps)
        for before, after in pairwise(tracks):
            gaps += [Gap(before.last_s, after.first_s, reason), *after.gaps]
        curves = [curve for track in tracks if (curve := track._curve) is not None]  # noqa: SLF001 - of its own class
        return cls(
            np.concatenate([track.utc_s for track in tracks]),
            np.concatenate([track.q_body_ned for track in tracks]),
            tuple(gaps),
            tracks[0].interpolation,
            RotationSpline.joined(curves) if curves else None,
        )

    @property
    def first_s(self) -> float:
        """The first sample's time, UTC seconds since 1970."""
        return float(self.utc_s[0])

    @property
    def last_s(self) -> float:
        """The last sample's time, UTC seconds since 1970."""
        return float(self.utc_s[-1])

    @property
    def rate_hz(self) -> float:
        """The usual sample rate: one over the median interval, Hz."""
        return _rate_hz(self)

    def rates(self) -> tuple[Float, Float]:
        """Return how fast the aircraft turned from each sample to the next.

        Returns
        -------
        utc_s : (m,) float64
            The middles between samples, UTC seconds since 1970; gaps and samples stamped nearly alike are left out.
        rate_rad_per_s : (m, 3) float64
            Turn rates about the body's axes forward, right, down, rad/s.
        """
        step_s = np.diff(self.utc_s)
        sound = step_s > np.median(step_s) / 2
        sound[np.searchsorted(self.utc_s, [gap.start_utc_s for gap in self.gaps])] = False
        middle_s = self.utc_s[:-1] + step_s / 2
        return middle_s[sound], turn_between(self.q_body_ned[:-1], self.q_body_ned[1:])[sound] / step_s[
            sound, np.newaxis
        ]

    def at(self, utc_s: ArrayLike) -> Float:
        """Return the attitude at each of the given times.

        Parameters
        ----------
        utc_s : (m,) array_like
            Times, UTC seconds since 1970.

        Returns
        -------
        (m, 4) float64
            Unit quaternions (w, x, y, z), NED to body.

        Raises
        ------
        TrackRangeError
            If a time lies outside the track, by more than a microsecond: glstar never extrapolates.

        Notes
        -----
        Teague & Chahl, section 2.6, eq. (41), for ``"slerp"``.
        """
        t = np.asarray(utc_s, dtype=np.float64)
        inside = np.minimum(np.maximum(t, self.utc_s[0]), self.utc_s[-1])
        known = np.abs(t - inside) <= CLOCK_GRAIN_S
        if not known.all():
            raise TrackRangeError(float(t[~known][0]), self.first_s, self.last_s)
        t = inside
        if self._curve is not None:
            return self._curve.at(t)

        # The sample just after each time; the first one closes no segment.
        after = np.maximum(self.utc_s.searchsorted(t), 1)
        before = after - 1
        before_s = self.utc_s.take(before)
        u = (t - before_s) / (self.utc_s.take(after) - before_s)
        return slerp(self.q_body_ned.take(before, axis=0), self.q_body_ned.take(after, axis=0), u)

    def gap_within(self, start_utc_s: float, stop_utc_s: float) -> Gap | None:
        """Return the longest gap that a stretch of time touches; None where there is none.

        Parameters
        ----------
        start_utc_s, stop_utc_s : float
            The stretch, UTC seconds since 1970.

        Returns
        -------
        Gap or None
        """
        first = bisect_right(self.gaps, start_utc_s, key=lambda gap: gap.stop_utc_s)
        last = bisect_left(self.gaps, stop_utc_s, key=lambda gap: gap.start_utc_s)
        return max(self.gaps[first:last], key=lambda gap: gap.duration_s, default=None)

    def shifted(self, shift_s: float) -> Self:
        """Return the same turns at another time.

        Parameters
        ----------
        shift_s : float
            How much later, s.

        Returns
        -------
        AttitudeTrack
        """
        gaps = tuple(
            replace(g, start_utc_s=g.start_utc_s + shift_s, stop_utc_s=g.stop_utc_s + shift_s) for g in self.gaps
        )
        curve = None if self._curve is None else replace(self._curve, t_s=self._curve.t_s + shift_s)
        return replace(self, utc_s=self.utc_s + shift_s, gaps=gaps, _curve=curve)


# Each scene of a flight asks for the same track's.
@lru_cache(maxsize=4)
def _rate_hz(track: AttitudeTrack) -> float:
    return 1 / float(np.median(np.diff(track.utc_s)))


def _broken(t: Float, gaps: tuple[Gap, ...]) -> Mask:
    """Return between which samples there is a gap, (n - 1,)."""
    broken = np.zeros(t.size - 1, dtype=np.bool_)
    if gaps:
        starts, stops = (np.searchsorted(t, [getattr(g, end) for g in gaps]) for end in ("start_utc_s", "stop_utc_s"))
        for start, stop in zip(starts, stops, strict=True):
            broken[start:stop] = True
    return broken


def _gaps(
    t: Float, q: Float, stretch: NDArray[np.int64], unfelt: Mask, break_reason: str, max_gap_s: float | None
) -> Iterator[Gap]:
    """Yield the gaps of a clean record, in order."""
    step_s = np.diff(t)
    if max_gap_s is None:
        max_gap_s = max(_LEAST_GAP_S, _USUAL_INTERVALS * float(np.median(step_s)))
    turned_rad = np.linalg.norm(turn_between(q[:-1], q[1:]), axis=-1)
    breaks, silent = np.diff(stretch) != 0, step_s > max_gap_s
    jumps = unfelt | (turned_rad > _FASTEST_RAD_PER_S * step_s + _GRACE_RAD)
    for k in np.flatnonzero(breaks | silent | jumps):
        reason = break_reason if breaks[k] else SILENCE if silent[k] else JUMP
        yield Gap(float(t[k]), float(t[k + 1]), reason)


@dataclass(frozen=True, slots=True, eq=False)
class PositionTrack:
    """A recorded history of place.

    Attributes
    ----------
    utc_s : (n,) float64, n >= 1
        Sample times, UTC seconds since 1970, strictly increasing.
    latitude_rad, longitude_rad : (n,) float64
        WGS84 latitude, and longitude positive eastward, rad; east of the date line longitude goes on beyond pi.
    height_m : (n,) float64
        Height, m.

    Raises
    ------
    TelemetryError
        If there is no sample, or the times do not rise.
    """

    utc_s: Float
    latitude_rad: Float
    longitude_rad: Float
    height_m: Float

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.utc_s, self.latitude_rad, self.longitude_rad, self.height_m)}
        if len(shapes) != 1 or self.utc_s.ndim != 1 or self.utc_s.size < 1:
            raise TelemetryError(f"a position track needs four columns of one length, not {sorted(shapes)}")
        if not np.all(np.diff(self.utc_s) > 0):
            raise TelemetryError("the times of a position track must rise")
        # Continuous, so that a flight across the date line does not fly round the world between two samples.
        object.__setattr__(self, "longitude_rad", np.unwrap(self.longitude_rad))
        _freeze(self.utc_s, self.latitude_rad, self.longitude_rad, self.height_m)

    @classmethod
    def from_samples(
        cls, utc_s: ArrayLike, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike
    ) -> Self:
        """Return a track from samples as a log holds them: unsorted and repeated.

        Parameters
        ----------
        utc_s, latitude_rad, longitude_rad, height_m : (n,) array_like
            Sample times (UTC seconds since 1970) and places (rad, rad, m); samples that are not finite are left out.

        Returns
        -------
        PositionTrack

        Raises
        ------
        TelemetryError
            If no sample remains.
        """
        given = [np.asarray(column, dtype=np.float64) for column in (utc_s, latitude_rad, longitude_rad, height_m)]
        if len({column.shape for column in given}) != 1:
            raise TelemetryError(f"a position track needs four columns of one length, not {[c.size for c in given]}")
        columns = np.stack(given)
        columns = columns[:, np.isfinite(columns).all(axis=0)]
        _, first = np.unique(columns[0], return_index=True)
        return cls(*columns[:, first])

    @classmethod
    def joined(cls, tracks: Sequence[Self]) -> Self:
        """Return tracks that follow each other as one.

        Parameters
        ----------
        tracks : sequence of PositionTrack
            One or more, in the order of time; none overlaps another.

        Returns
        -------
        PositionTrack
        """
        columns = ("utc_s", "latitude_rad", "longitude_rad", "height_m")
        return cls(*(np.concatenate([getattr(track, column) for track in tracks]) for column in columns))

    def held(self, first_utc_s: float, last_utc_s: float) -> Self:
        """Return the same track within a time, at whose ends the nearest place is held.

        Parameters
        ----------
        first_utc_s, last_utc_s : float
            From when to when, UTC seconds since 1970.

        Returns
        -------
        PositionTrack
        """
        inside = self.utc_s[(self.utc_s > first_utc_s) & (self.utc_s < last_utc_s)]
        utc_s = np.concatenate([[first_utc_s], inside, [last_utc_s]])
        columns = (self.latitude_rad, self.longitude_rad, self.height_m)
        return type(self)(utc_s, *(np.interp(utc_s, self.utc_s, column) for column in columns))

    @classmethod
    def fixed(cls, site: Site) -> Self:
        """Return the track of somebody who does not move.

        Parameters
        ----------
        site : Site
            The place.

        Returns
        -------
        PositionTrack
        """
        return cls(*(np.array([x]) for x in (0.0, site.latitude_rad, site.longitude_rad, site.height_m)))

    def at(self, utc_s: float) -> Site:
        """Return the place at a time, in standard air.

        Before the first sample and after the last the nearest one is held: stars are so far away that a kilometre
        moves them by 32", and a receiver often finds its place later than the autopilot its attitude.

        Parameters
        ----------
        utc_s : float
            Time, UTC seconds since 1970.

        Returns
        -------
        Site
        """
        return Site(*(float(x) for x in self.coordinates(utc_s)))

    def coordinates(self, utc_s: ArrayLike) -> tuple[Float, Float, Float]:
        """Return latitude, longitude and height at each of the given times; see `at`.

        Parameters
        ----------
        utc_s : (m,) array_like
            Times, UTC seconds since 1970.

        Returns
        -------
        latitude_rad, longitude_rad, height_m : (m,) float64
            Longitude from -pi to pi.
        """
        t = np.asarray(utc_s, dtype=np.float64)
        longitude_rad = np.interp(t, self.utc_s, self.longitude_rad)
        return (
            np.interp(t, self.utc_s, self.latitude_rad),
            (longitude_rad + np.pi) % (2 * np.pi) - np.pi,
            np.interp(t, self.utc_s, self.height_m),
        )


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """How well the readings of UTC of a log agree, and when they were logged.

    Attributes
    ----------
    readings : int
        How many there are.
    spread_s : float
        95 % of them differ from their median by no more than this, s.
    largest_s : float
        The largest difference from their median, s.
    lag_s : float or None
        How long after the GPS sample its record is written, s, in the median; None where that does not matter.
    lag_is_measured : bool
        Whether the log says so itself; else it is the usual lag, assumed.
    """

    readings: int
    spread_s: float
    largest_s: float
    lag_s: float | None = None
    lag_is_measured: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """What glstar needs of a flight: attitude and place over UTC.

    Attributes
    ----------
    attitude : AttitudeTrack
    position : PositionTrack
    name : str
        What to call it: the log's file name.
    attitude_source, position_source, utc_source : str
        Where each came from, in words: ``"XKQ lane 0, 200.0 Hz"``.
    time_offset_s : float
        The camera's clock minus UTC, s.  It only names images: an image that the camera stamps t was taken at t -
        `time_offset_s`.
    notes : tuple of str
        What somebody who uses the flight should know of how the log was read, a message each.
    clocks : tuple of ClockQuality
        How well its UTC is known, for each boot; empty where UTC was given, or is the log's own clock.
    """

    attitude: AttitudeTrack
    position: PositionTrack
    name: str = "flight"
    attitude_source: str = "given"
    position_source: str = "given"
    utc_source: str = "given"
    time_offset_s: float = 0.0
    notes: tuple[str, ...] = ()
    clocks: tuple[ClockQuality, ...] = ()

    def shifted(self, shift_s: float) -> Self:
        """Return the same flight at another time.

        Parameters
        ----------
        shift_s : float
            How much later, s.

        Returns
        -------
        Flight
        """
        position = replace(self.position, utc_s=self.position.utc_s + shift_s)
        return replace(self, attitude=self.attitude.shifted(shift_s), position=position)


def _freeze(*arrays: Float) -> None:
    for array in arrays:
        array.flags.writeable = False
