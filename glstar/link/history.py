"""The last minutes of a link: attitudes and places as they came, ready to be a flight at any moment."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import TelemetryError
from glstar.flight import AttitudeTrack, Flight, Interpolation, PositionTrack
from glstar.sky.site import Site

__all__ = ["History", "Memory", "Rows"]

Float = NDArray[np.float64]

# So many attitudes are kept at the most, however long is asked for: ten minutes at 200 Hz, ten megabytes.
_MOST_ATTITUDES: Final = 120_000
_MOST_POSITIONS: Final = 12_000
# Boots before the present one that are kept: more within some minutes are no flight.
_MOST_BOOTS: Final = 8
_REBOOT: Final = "a reboot of the autopilot"
# There is room for so many rows at first.
_FIRST_ROWS: Final = 4096


class Rows:
    """Rows of numbers, of which the latest are kept.

    Parameters
    ----------
    columns : int
    most : int
        How many are kept.
    reach : float
        How far the first column of those that are kept may lie behind the newest one's; others go when room is needed.
    """

    def __init__(self, columns: int, most: int, reach: float = np.inf) -> None:
        # At least twice the room that is needed: the rows move to the front only once in as many times.
        self._room = np.empty((min(_FIRST_ROWS, 2 * most), columns))
        self._most, self._reach, self._start, self._stop = most, reach, 0, 0

    def __len__(self) -> int:
        return self._stop - self._start

    def append(self, row: tuple[float, ...]) -> None:
        """Add a row; the oldest makes room for it."""
        if self._stop == len(self._room):
            kept = self.latest(row[0] - self._reach)
            if len(kept) > len(self._room) // 2:
                self._room = np.empty((min(2 * len(self._room), 2 * self._most), kept.shape[1]))
            self._start, self._stop = 0, len(kept)
            self._room[: self._stop] = kept
        self._room[self._stop] = row
        self._stop += 1
        self._start = max(self._start, self._stop - self._most)

    def latest(self, first_column_from: float) -> Float:
        """Return a copy of the rows whose first column is not below a number."""
        rows = self._room[self._start : self._stop]
        return rows[rows[:, 0] >= first_column_from].copy()

    def clear(self) -> None:
        """Forget all rows."""
        self._start = self._stop = 0


@dataclass(frozen=True, slots=True)
class PastBoot:
    """What came before a reboot, at the UTC of then.

    Attributes
    ----------
    attitudes : (n, 5) float64
        UTC seconds since 1970, and q_body_ned.
    positions : (m, 4) float64
        UTC seconds since 1970, latitude and longitude, rad, and height, m.
    """

    attitudes: Float
    positions: Float

    def latest(self, first_utc_s: float) -> "PastBoot":
        """Return the part that is not older than a time, UTC seconds since 1970; positions all."""
        return PastBoot(self.attitudes[self.attitudes[:, 0] >= first_utc_s], self.positions)


@dataclass(frozen=True, slots=True)
class Memory:
    """What a history held at one moment; the flight is made of it while the history goes on.

    Attributes
    ----------
    attitudes : (n, 5) float64
        Time since boot, s, and q_body_ned, as they came.
    positions : (m, 4) float64
        Time since boot, s, latitude and longitude, rad, and height, m.
    past : tuple of PastBoot
        Earlier boots, oldest first.
    last_s : float
        How much of the flight is wanted, s up to the newest attitude.
    """

    attitudes: Float
    positions: Float
    past: tuple[PastBoot, ...] = ()
    last_s: float = np.inf

    def flight(
        self,
        utc_minus_boot_s: float,
        *,
        name: str,
        attitude_source: str,
        position_source: str,
        utc_source: str,
        site: Site | None,
        interpolation: Interpolation = "slerp",
        max_gap_s: float | None = None,
        time_offset_s: float = 0.0,
    ) -> Flight | None:
        """Return what is remembered as a flight.

        Parameters
        ----------
        utc_minus_boot_s : float
            What to add to the time since boot, s.
        name, attitude_source, position_source, utc_source : str
            What the flight is called, and where it comes from.
        site : Site or None
            The place, where it is given: it counts instead of what was told.
        interpolation : {"slerp", "spline"}
            See `AttitudeTrack`.
        max_gap_s : float or None
            The longest silence to interpolate across, s.
        time_offset_s : float
            The camera's clock minus UTC, s.

        Returns
        -------
        Flight or None
            None where there are not two attitudes, or no place.
        """
        boots = self._boots(utc_minus_boot_s)
        attitudes, positions = (np.concatenate(rows) for rows in zip(*boots, strict=True))
        if not len(self.attitudes) or (site is None and not len(positions)):
            return None
        try:
            attitude = AttitudeTrack.from_samples(
                attitudes[:, 0],
                attitudes[:, 1:],
                segment=np.repeat(np.arange(len(boots)), [len(rows) for rows, _ in boots]),
                break_reason=_REBOOT,
                max_gap_s=max_gap_s,
                interpolation=interpolation,
            )
        except TelemetryError:
            return None
        position = PositionTrack.fixed(site) if site is not None else PositionTrack.from_samples(*positions.T)
        return Flight(
            attitude=attitude,
            position=position,
            name=name,
            attitude_source=f"{attitude_source}, {attitude.rate_hz:.1f} Hz",
            position_source=position_source,
            utc_source=utc_source,
            time_offset_s=time_offset_s,
        )

    def _boots(self, utc_minus_boot_s: float) -> list[tuple[Float, Float]]:
        """Return attitudes and positions over UTC, of each boot, oldest first."""
        shift = np.array([utc_minus_boot_s, 0.0, 0.0, 0.0, 0.0])
        boots = [(self.attitudes + shift, self.positions + shift[:4])]
        times_s = boots[0][0][:, 0]
        if not times_s.size:
            return boots
        first_utc_s, before_s = float(times_s.max()) - self.last_s, float(times_s.min())
        for past in reversed(self.past):
            kept = past.latest(first_utc_s)
            # A clock that was set back since then: what was before has no place any more.
            if not len(kept.attitudes) or kept.attitudes[:, 0].max() >= before_s:
                break
            boots.insert(0, (kept.attitudes, kept.positions))
            before_s = float(kept.attitudes[:, 0].min())
        return boots


class History:
    """The last minutes of one autopilot, over its reboots.

    Parameters
    ----------
    keep_s : float
        How much is remembered, s; of attitudes that come faster than 200 Hz less.
    """

    def __init__(self, keep_s: float = 600.0) -> None:
        self._keep_s = keep_s
        # Of both: time since boot, s; then q, or latitude and longitude, rad, and height, m.
        self._attitudes = Rows(5, _MOST_ATTITUDES, keep_s)
        self._positions = Rows(4, _MOST_POSITIONS, keep_s)
        self._newest_boot_s: float | None = None
        self._past: deque[PastBoot] = deque(maxlen=_MOST_BOOTS)

    def add_attitude(self, boot_s: float, q_body_ned: Float) -> None:
        """Add an attitude.

        Parameters
        ----------
        boot_s : float
            Its time since boot, s.
        q_body_ned : (4,) float64
        """
        self._attitudes.append((boot_s, *q_body_ned))
        self._newest_boot_s = boot_s if self._newest_boot_s is None else max(boot_s, self._newest_boot_s)

    def add_position(self, boot_s: float, latitude_rad: float, longitude_rad: float, height_m: float) -> None:
        """Add a place.

        Parameters
        ----------
        boot_s : float
            Its time since boot, s.
        latitude_rad, longitude_rad, height_m : float
        """
        self._positions.append((boot_s, latitude_rad, longitude_rad, height_m))

    @property
    def newest_boot_s(self) -> float | None:
        """The newest attitude's time since boot, s; None where there is none."""
        return self._newest_boot_s

    @property
    def has_position(self) -> bool:
        """Whether a position was received, in this boot or before."""
        return bool(len(self._positions)) or any(len(past.positions) for past in self._past)

    def begin_boot(self, utc_minus_boot_s: float | None) -> None:
        """Begin a new boot; samples from before the reboot are kept at their UTC.

        Parameters
        ----------
        utc_minus_boot_s : float or None
            UTC minus the time since the boot that has ended, s; None where UTC was not known: then it is forgotten.
        """
        if utc_minus_boot_s is not None and self._newest_boot_s is not None:
            first_utc_s = self._newest_boot_s + utc_minus_boot_s - self._keep_s
            shift = np.array([utc_minus_boot_s, 0.0, 0.0, 0.0, 0.0])
            ended = PastBoot(self._attitudes.latest(-np.inf) + shift, self._positions.latest(-np.inf) + shift[:4])
            kept = [past for past in (*self._past, ended) if (past.attitudes[:, 0] >= first_utc_s).any()]
            self._past = deque((past.latest(first_utc_s) for past in kept), maxlen=_MOST_BOOTS)
        self._attitudes.clear()
        self._newest_boot_s = None
        self._positions.clear()

    def memory(self, last_s: float = np.inf) -> Memory:
        """Return a copy of what is remembered.

        Parameters
        ----------
        last_s : float
            How much of it, s, up to the newest attitude; places all.

        Returns
        -------
        Memory
        """
        last_s = min(last_s, self._keep_s)
        from_s = -np.inf if self._newest_boot_s is None else self._newest_boot_s - last_s
        return Memory(self._attitudes.latest(from_s), self._positions.latest(-np.inf), tuple(self._past), last_s)
