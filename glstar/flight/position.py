"""The position of an aircraft over UTC."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import TelemetryError
from glstar.sky.place.site import Site


@dataclass(frozen=True, slots=True, eq=False)
class PositionTrack:
    """Recorded position over UTC.

    Attributes
    ----------
    utc_s : (n,) float64, n >= 1
        Sample times, UTC seconds since 1970, strictly increasing.
    latitude_rad, longitude_rad : (n,) float64
        WGS84 latitude, and longitude positive eastward, rad; continuous: beyond pi east of the date line.
    height_m : (n,) float64
        Height, m.

    Raises
    ------
    TelemetryError
        If there is no sample, or the times do not increase.
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
            raise TelemetryError("the times of a position track must increase")
        # Continuous, so that interpolation across the date line does not go around the world.
        object.__setattr__(self, "longitude_rad", np.unwrap(self.longitude_rad))
        for array in (self.utc_s, self.latitude_rad, self.longitude_rad, self.height_m):
            array.flags.writeable = False

    @classmethod
    def from_samples(
        cls, utc_s: ArrayLike, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike
    ) -> Self:
        """Return a track from samples as logged: unsorted and repeated.

        Parameters
        ----------
        utc_s, latitude_rad, longitude_rad, height_m : (n,) array_like
            Sample times (UTC seconds since 1970) and positions (rad, rad, m); samples that are not finite are dropped.

        Returns
        -------
        PositionTrack

        Raises
        ------
        TelemetryError
            If no sample remains.
        """
        arrays = [np.asarray(column, dtype=np.float64) for column in (utc_s, latitude_rad, longitude_rad, height_m)]
        if len({array.shape for array in arrays}) != 1:
            raise TelemetryError(f"a position track needs four columns of one length, not {[a.size for a in arrays]}")
        columns = np.stack(arrays)
        columns = columns[:, np.isfinite(columns).all(axis=0)]
        _, first = np.unique(columns[0], return_index=True)
        # Each column in consecutive memory: np.interp would copy the whole of it at every call.
        return cls(*(column[first] for column in columns))

    @classmethod
    def joined(cls, tracks: Sequence[Self]) -> Self:
        """Concatenate tracks.

        Parameters
        ----------
        tracks : sequence of PositionTrack
            One or more, sorted by time, without overlaps.

        Returns
        -------
        PositionTrack
        """
        columns = ("utc_s", "latitude_rad", "longitude_rad", "height_m")
        return cls(*(np.concatenate([getattr(track, column) for track in tracks]) for column in columns))

    def clipped(self, first_utc_s: float, last_utc_s: float) -> Self:
        """Return the part of the track within a time interval, with a sample at both of its ends.

        Parameters
        ----------
        first_utc_s, last_utc_s : float
            Ends of the interval, UTC seconds since 1970; outside the track the nearest sample is used.

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
        """Return the track of an observer at rest.

        Parameters
        ----------
        site : Site
            Where the observer is.

        Returns
        -------
        PositionTrack
        """
        return cls(*(np.array([x]) for x in (0.0, site.latitude_rad, site.longitude_rad, site.height_m)))

    def at(self, utc_s: float) -> Site:
        """Return the position at a time, in standard air.

        Before the first sample and after the last, the nearest sample is used: a GPS fix often comes later than the
        first attitude, and 1 km changes the altitudes of stars by only 32".

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
