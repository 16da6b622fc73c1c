"""Orientation of the camera with respect to the sky, and of the air above it, at several times."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.render.starpaths import times_per_block
from glstar.rotation import turn_from_matrix
from glstar.sky.horizon import LOWEST_ALTITUDE_RAD, refraction_displacement
from glstar.sky.horizonprofile import HorizonProfile

__all__ = ["Pointing"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pointing:
    """Camera orientation, zenith and observer velocity at each of n times: all that maps a star to the image.

    Attributes
    ----------
    C_camera_eq : (n, 3, 3) float64
        Rotation matrices from the true equator and equinox to the camera frame.
    zenith_eq : (n, 3) float64
        Unit vectors to the zenith, true equator and equinox.
    velocity_eq : (n, 3) float64
        Velocity of the observer due to the Earth's rotation, in units of the speed of light, for diurnal aberration.
    refraction_scale : float
        Refraction relative to standard air: see `horizon.refraction_scale`; 0 for no refraction.
    sine_horizon : float
        Sine of the apparent altitude of the horizon, below which no star is seen; of a profile a bound.
    profile : HorizonProfile or None
        The horizon by azimuth; None for one of equal altitude all around.
    pole_eq : (n, 3) float64 or None
        Unit vectors to the celestial pole in a frame that turns with a satellite; None for (0, 0, 1).
    """

    C_camera_eq: Float
    zenith_eq: Float
    velocity_eq: Float
    refraction_scale: float
    sine_horizon: float = 0.0
    profile: HorizonProfile | None = None
    pole_eq: Float | None = None

    def __len__(self) -> int:
        return len(self.C_camera_eq)

    def __getitem__(self, times: slice | NDArray[np.intp]) -> "Pointing":
        return replace(
            self,
            C_camera_eq=self.C_camera_eq[times],
            zenith_eq=self.zenith_eq[times],
            velocity_eq=self.velocity_eq[times],
            pole_eq=None if self.pole_eq is None else self.pole_eq[times],
        )

    @property
    def boresight_eq(self) -> Float:
        """The optical axis at each time, (n, 3) unit vectors, true equator and equinox."""
        return self.C_camera_eq[:, 2]

    @property
    def rotation_rad(self) -> Float:
        """By how much the camera turns from each time to the next, (n - 1,) rad."""
        C = self.C_camera_eq
        return np.asarray(np.linalg.norm(turn_from_matrix(C[1:] @ np.swapaxes(C[:-1], 1, 2)), axis=1))

    def to_camera(self, direction_eq: ArrayLike, *, below_horizon: bool = False) -> Float:
        """Return the observed directions of stars in the camera frame, as `projection.glsl` does in float32.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        below_horizon : bool
            Whether directions below the apparent horizon are returned too, for lines that are clipped there later.

        Returns
        -------
        (n, m, 3) float64
            Vectors right, down and along the optical axis, of nearly unit length; NaN below the apparent horizon
            unless `below_horizon`.

        Notes
        -----
        Teague & Chahl, eqs (22)-(32), without trigonometric functions: diurnal aberration, refraction towards the
        zenith, rotation.  Departs from the paper, which also draws stars below the horizon.
        """
        direction = np.asarray(direction_eq, dtype=np.float64)
        sine_altitude = self._sine_altitude(direction)
        refraction = refraction_displacement(sine_altitude, self.refraction_scale)
        if not below_horizon and sine_altitude.min(initial=0.0) < self.sine_horizon:  # refraction is positive
            refraction[self._height(sine_altitude, refraction) < 0] = np.nan
        if not below_horizon and self.profile is not None:
            refraction[self.clearance(direction) < 0] = np.nan
        # One matrix product for all times and no second array of its size: every frame waits for this.
        n = len(self)
        rows = np.swapaxes(self.C_camera_eq, 0, 1).reshape(3 * n, 3)
        in_camera = (rows @ direction.T).reshape(3, n, len(direction))
        velocity = self.C_camera_eq @ self.velocity_eq[:, :, np.newaxis]
        zenith = self.C_camera_eq @ self.zenith_eq[:, :, np.newaxis]
        displacement = np.empty_like(refraction)
        for axis in range(3):
            np.multiply(refraction, zenith[:, axis], out=displacement)
            displacement += velocity[:, axis]
            in_camera[axis] += displacement
        return in_camera.transpose(1, 2, 0)

    def sine_apparent_altitude(self, direction_eq: ArrayLike) -> Float:
        """Return the sines of the altitudes of stars, with refraction.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.

        Returns
        -------
        (n, m) float64
        """
        s = self.zenith_eq @ np.asarray(direction_eq, dtype=np.float64).T
        return _sine_apparent(s, refraction_displacement(s, self.refraction_scale))

    def clearance(self, direction_eq: ArrayLike) -> Float:
        """Return how far stars are above the horizon, with its profile.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.

        Returns
        -------
        (n, m) float64
            Sines of their apparent altitudes less those of the horizon below them; positive where a star is seen.
        """
        direction = np.asarray(direction_eq, dtype=np.float64)
        pole = None if self.pole_eq is None else self.pole_eq[:, np.newaxis]
        sine = self.sine_apparent_altitude(direction)
        return self.above_horizon(direction, self.zenith_eq[:, np.newaxis], sine, pole)

    def above_horizon(self, direction_eq: Float, zenith_eq: Float, sine: Float, pole_eq: Float | None = None) -> Float:
        """Return how far directions are above the horizon, with its profile.

        Parameters
        ----------
        direction_eq, zenith_eq : (..., 3) float64
            Unit vectors, true equator and equinox.
        sine : (...) float64
            Sines of the apparent altitudes of the directions.
        pole_eq : (..., 3) float64 or None
            As of the attribute.

        Returns
        -------
        (...) float64
            Sines of altitudes less those of the horizon below them.
        """
        if self.profile is None:
            return sine - self.sine_horizon
        if pole_eq is not None:
            north = pole_eq - np.sum(pole_eq * zenith_eq, axis=-1, keepdims=True) * zenith_eq
            east = np.cross(north, zenith_eq)
            azimuth_rad = np.arctan2(np.sum(direction_eq * east, axis=-1), np.sum(direction_eq * north, axis=-1))
            return np.asarray(sine - np.sin(self.profile.altitude_rad(azimuth_rad)))
        x, y, z = np.moveaxis(direction_eq, -1, 0)
        zenith_x, zenith_y, zenith_z = np.moveaxis(zenith_eq, -1, 0)
        # East and north of the zenith, of equal length: the pole is (0, 0, 1).
        east = y * zenith_x - x * zenith_y
        north = z - zenith_z * (x * zenith_x + y * zenith_y + z * zenith_z)
        return np.asarray(sine - np.sin(self.profile.altitude_rad(np.arctan2(east, north))))

    def heights(self, direction_eq: ArrayLike) -> Float:
        """Return how high stars are above the apparent horizon, or above the bound of its profile.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.

        Returns
        -------
        (n, m) float64
            Approximately sines; negative where `to_camera` returns NaN, but for a profile.
        """
        sine_altitude = self._sine_altitude(np.asarray(direction_eq, dtype=np.float64))
        return self._height(sine_altitude, refraction_displacement(sine_altitude, self.refraction_scale))

    def _sine_altitude(self, direction: Float) -> Float:
        """Return the sines of the altitudes of stars, (n, m), with aberration and without refraction."""
        aberration = np.sum(self.zenith_eq * self.velocity_eq, axis=1, keepdims=True)
        return np.asarray(self.zenith_eq @ direction.T + aberration)

    def _height(self, sine_altitude: Float, refraction: Float) -> Float:
        """Return `heights`, given the sines of altitudes without refraction and the refraction."""
        height = sine_altitude + refraction - self.sine_horizon
        # No refraction lifts a star above the horizon from 1 deg below it.
        above_lowest = sine_altitude - (np.sin(LOWEST_ALTITUDE_RAD) + self.sine_horizon)
        return np.where(above_lowest < 0, np.minimum(height, above_lowest), height)

    def each_to_camera(self, direction_eq: ArrayLike, *, below_horizon: bool = False) -> Float:
        """Return the observed direction of each of n stars at one of the n times, as `to_camera` does.

        Parameters
        ----------
        direction_eq : (n, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox: one per time.
        below_horizon : bool
            Whether directions below the apparent horizon are returned too.

        Returns
        -------
        (n, 3) float64
            Vectors right, down and along the optical axis; NaN below the apparent horizon unless `below_horizon`.
        """
        direction = np.asarray(direction_eq, dtype=np.float64) + self.velocity_eq
        sine_altitude = np.einsum("ni,ni->n", self.zenith_eq, direction)
        refraction = refraction_displacement(sine_altitude, self.refraction_scale)
        if not below_horizon:
            refraction = np.where(self._height(sine_altitude, refraction) < 0, np.nan, refraction)
        if not below_horizon and self.profile is not None:
            sine = _sine_apparent(sine_altitude, refraction)
            above = self.above_horizon(direction, self.zenith_eq, sine, self.pole_eq)
            refraction = np.where(above < 0, np.nan, refraction)
        observed = direction + refraction[:, np.newaxis] * self.zenith_eq
        return np.asarray(np.einsum("nij,nj->ni", self.C_camera_eq, observed))

    def blocks(self, star_count: int, *, overlap: int = 0) -> Iterator["Pointing"]:
        """Yield a few times at a time, to bound the memory that a long exposure of many stars takes.

        Parameters
        ----------
        star_count : int
            Number of stars that are evaluated at each time.
        overlap : int
            Number of times that consecutive blocks share.

        Yields
        ------
        Pointing
        """
        block = times_per_block(star_count)
        for first in range(0, max(1, len(self) - overlap), block):
            yield self[first : first + block + overlap]


def _sine_apparent(sine_altitude: Float, displacement: Float) -> Float:
    """Return the sines of altitudes with refraction, given `refraction_displacement`."""
    s, q = sine_altitude, displacement
    return np.asarray((s + q) / np.sqrt(1 + q * (2 * s + q)))
