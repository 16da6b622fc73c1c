"""Orientation of the camera with respect to the sky and the zenith.

`Pointing` holds it at several times; `CameraMotion` composes it from attitude, position, mount and sky; `MotionTable`
interpolates it during one exposure, for many times that are different for every star.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight
from glstar.render.motion.starpaths import times_per_block
from glstar.rotation import matrix_from_quaternion, turn_from_matrix
from glstar.sky.air.refraction import LOWEST_ALTITUDE_RAD, refraction_displacement
from glstar.sky.observed.stars import Sky
from glstar.sky.place.horizon import HorizonProfile, diurnal_aberration_rad
from glstar.sky.place.site import Site


@dataclass(frozen=True, slots=True, eq=False)
class Pointing:
    """Camera orientation, zenith and observer velocity at each of n times: all that maps a star to the image."""

    C_camera_eq: Float  # (n, 3, 3) rotation matrices from the true equator and equinox to the camera frame
    zenith_eq: Float  # (n, 3) unit vectors to the zenith, true equator and equinox
    # (n, 3) velocity of the observer due to the Earth's rotation, in units of the speed of light, for diurnal
    # aberration.
    velocity_eq: Float
    # Refraction relative to standard air: see `glstar.sky.air.refraction.refraction_scale`; 0 for no refraction.
    refraction_scale: float
    # Sine of the apparent altitude of the horizon, below which no star is seen; of a profile a bound.
    sine_horizon: float = 0.0
    profile: HorizonProfile | None = None  # The horizon by azimuth; None for one of equal altitude all around
    # (n, 3) or None: unit vectors to the celestial pole in a frame that turns with a satellite; None for (0, 0, 1).
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

        `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.  Returns (n, m, 3) vectors
        right, down and along the optical axis, of nearly unit length; NaN below the apparent horizon unless
        `below_horizon`, for lines that are clipped there later.

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
        """Return the sines of the altitudes of stars with refraction, (n, m); `direction_eq` as for `to_camera`."""
        s = self.zenith_eq @ np.asarray(direction_eq, dtype=np.float64).T
        return _sine_apparent(s, refraction_displacement(s, self.refraction_scale))

    def clearance(self, direction_eq: ArrayLike) -> Float:
        """Return how far stars are above the horizon, with its profile.

        `direction_eq` as for `to_camera`.  Returns (n, m) sines of their apparent altitudes less the sines of the
        horizon's altitude below them; positive where a star is seen.
        """
        direction = np.asarray(direction_eq, dtype=np.float64)
        pole = None if self.pole_eq is None else self.pole_eq[:, np.newaxis]
        sine = self.sine_apparent_altitude(direction)
        return self.above_horizon(direction, self.zenith_eq[:, np.newaxis], sine, pole)

    def above_horizon(self, direction_eq: Float, zenith_eq: Float, sine: Float, pole_eq: Float | None = None) -> Float:
        """Return how far directions are above the horizon, with its profile.

        `direction_eq`, `zenith_eq` (..., 3): unit vectors, true equator and equinox; `sine` (...): sines of the
        directions' apparent altitudes; `pole_eq` (..., 3) or None: see the attribute.  Returns (...) sines of altitudes
        less the sines of the horizon's altitude below them.
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

        `direction_eq` as for `to_camera`.  Returns (n, m) approximately sines; negative where `to_camera` returns NaN,
        but for a profile.
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

        `direction_eq` (n, 3): geocentric apparent unit vectors, true equator and equinox, one per time.  Returns (n, 3)
        vectors right, down and along the optical axis; NaN below the apparent horizon unless `below_horizon`.
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

        Consecutive blocks share `overlap` times.
        """
        block = times_per_block(star_count)
        for first in range(0, max(1, len(self) - overlap), block):
            yield self[first : first + block + overlap]


def _sine_apparent(sine_altitude: Float, displacement: Float) -> Float:
    """Return the sines of altitudes with refraction, given `refraction_displacement`."""
    s, q = sine_altitude, displacement
    return np.asarray((s + q) / np.sqrt(1 + q * (2 * s + q)))


class MotionSamples(NamedTuple):
    """The camera at n times."""

    pointing: Pointing  # The camera's orientation with respect to the sky, n times
    q_body_ned: Float  # (n, 4) attitudes (w, x, y, z), NED to body
    site: Site  # The aircraft's position at the middle time


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """The camera's orientation with respect to the sky as a function of time."""

    flight: Flight
    sky: Sky
    mount: Mount
    pressure_hpa: float  # The air at the aircraft
    temperature_c: float

    def pointings(self, *utc_s: Float) -> list[Pointing]:
        """Return the camera's orientation for several arrays of times: see `at`."""
        return [samples.pointing for samples in self.at(*utc_s)]

    def at(self, *utc_s: Float) -> list[MotionSamples]:
        """Return orientation, attitude and site for several arrays of times; one call costs little more than one array.

        `*utc_s` (n,): UTC seconds since 1970, all within minutes of each other.  Raises TrackRangeError if a time lies
        outside the flight.  Teague & Chahl, eqs (22), (30)-(32), composed in float64.
        """
        all_s = np.concatenate(utc_s)
        latitude_rad, longitude_rad, height_m = self.flight.position.coordinates(all_s)
        C_ned_eq = self.sky.C_ned_eq(all_s, latitude_rad, longitude_rad)
        q_body_ned = self.flight.attitude.at(all_s)
        C_camera_eq = self.mount.C_camera_body @ matrix_from_quaternion(q_body_ned) @ C_ned_eq
        samples = []
        first = 0
        for times_s in utc_s:
            times, middle = slice(first, first + len(times_s)), first + len(times_s) // 2
            latitude, longitude, height = (float(of[middle]) for of in (latitude_rad, longitude_rad, height_m))
            site = Site(latitude, longitude, height, self.pressure_hpa, self.temperature_c)
            pointing = Pointing(
                C_camera_eq=C_camera_eq[times],
                zenith_eq=-C_ned_eq[times, 2],
                velocity_eq=diurnal_aberration_rad(latitude, height) * C_ned_eq[times, 1],
                refraction_scale=self.sky.refraction_scale(site),
                sine_horizon=self.sky.sine_horizon(height),
                profile=self.sky.profile,
            )
            samples.append(MotionSamples(pointing, q_body_ned[times], site))
            first = times.stop
        return samples


# Largest rotation in a part of an exposure, rad: there the third-order term, which a quadratic lacks, is 3e-7 rad.
_STEP_RAD = 0.033
# Longest part between the samples of a spline, whose rate varies between them, s.
_SPLINE_STEP_S = 5e-3
# Exposures of more samples of the log would spend more time on the table than it saves.
_MAX_PARTS = 2000
# Half the time over which the angular rate of the camera is measured, s.
_RATE_STEP_S = 5e-4


@dataclass(frozen=True, eq=False)
class MotionTable:
    """The camera's orientation in n parts of an exposure: between samples of the log, or of halves along a spline."""

    ends_s: Float  # (n + 1,) where parts begin and end, s after the start of the exposure
    # At the start, the middle and the end of the first part, which is the start of the second, and so on: 2 n + 1
    # times.
    pointing: Pointing

    @classmethod
    def of(cls, motion: CameraMotion, exposure: Exposure) -> Self | None:
        """Return the table of an exposure; None of one that has too many parts."""
        attitude = motion.flight.attitude
        first, last = np.searchsorted(attitude.utc_s, [exposure.start_utc_s, exposure.stop_utc_s])
        step_s = _STEP_RAD / max(_fastest_rad_per_s(attitude, first, last), _STEP_RAD)
        if attitude.interpolation != "slerp":
            step_s = min(step_s, _SPLINE_STEP_S)
        steps = np.arange(1, np.ceil(exposure.span_s / step_s)) * step_s
        if last - first + len(steps) > _MAX_PARTS:
            return None
        inside_s = np.append(attitude.utc_s[first:last] - exposure.start_utc_s, steps)
        ends_s = np.unique(np.concatenate([[0.0], inside_s.clip(0.0, exposure.span_s), [exposure.span_s]]))
        if attitude.interpolation != "slerp":
            ends_s = np.sort(np.append(ends_s, (ends_s[1:] + ends_s[:-1]) / 2))
        times_s = np.empty(2 * len(ends_s) - 1)
        times_s[::2] = ends_s
        times_s[1::2] = (ends_s[1:] + ends_s[:-1]) / 2
        (pointing,) = motion.pointings(np.minimum(exposure.start_utc_s + times_s, exposure.stop_utc_s))
        return cls(ends_s, pointing)

    @cached_property
    def _coefficients(self) -> Float:
        """Coefficients of 1, u and u^2 in each part, (3, n, w): all numbers of an orientation side by side."""
        own, times = self.pointing, len(self.pointing)
        vectors = (own.zenith_eq, own.velocity_eq, *([] if own.pole_eq is None else [own.pole_eq]))
        values = np.concatenate([own.C_camera_eq.reshape(times, 9), *vectors], axis=1)
        start, middle, end = values[:-2:2], values[1::2], values[2::2]
        return np.stack([start, 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)])

    def at(self, since_s: Float) -> Pointing:
        """Return the orientation at some times after the start of the exposure, (k,) s: k times."""
        part = (np.searchsorted(self.ends_s, since_s, side="right") - 1).clip(0, len(self.ends_s) - 2)
        u = ((since_s - self.ends_s[part]) / (self.ends_s[part + 1] - self.ends_s[part]))[:, np.newaxis]
        constant, linear, quadratic = self._coefficients
        values = quadratic.take(part, axis=0)
        values *= u
        values += linear.take(part, axis=0)
        values *= u
        values += constant.take(part, axis=0)
        return replace(
            self.pointing,
            C_camera_eq=values[:, :9].reshape(-1, 3, 3),
            zenith_eq=values[:, 9:12],
            velocity_eq=values[:, 12:15],
            pole_eq=None if self.pointing.pole_eq is None else values[:, 15:],
        )


def rates_rad_per_s(motion: CameraMotion, exposure: Exposure) -> Float:
    """Return the camera's angular rate with respect to the stars in the middle of an exposure, (3,) rad/s.

    About its right, down and forward axes.
    """
    step_s = min(_RATE_STEP_S, exposure.span_s / 2)
    times_s = np.array([exposure.mid_utc_s - step_s, exposure.mid_utc_s + step_s])
    before, after = motion.pointings(times_s)[0].C_camera_eq
    return np.asarray(turn_from_matrix(after @ before.T) / (times_s[1] - times_s[0]))


def _fastest_rad_per_s(attitude: AttitudeTrack, first: int, last: int) -> float:
    """Return the largest turn rate between samples, from the one before the first to the last."""
    samples = slice(max(first - 1, 0), last + 1)
    q = attitude.q_body_ned[samples]
    half_rad = np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", q[1:], q[:-1])), 1.0))
    return float((2 * half_rad / np.diff(attitude.utc_s[samples])).max(initial=0.0))
