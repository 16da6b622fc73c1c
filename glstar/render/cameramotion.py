"""Motion of the camera over a flight: attitude, position, mount and sky combined into camera orientations."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Mount
from glstar.flight import Flight
from glstar.render.pointing import Pointing
from glstar.rotation import matrix_from_quaternion
from glstar.sky.horizon import diurnal_aberration_rad
from glstar.sky.observed import Sky
from glstar.sky.site import Site

__all__ = ["CameraMotion", "MotionSamples"]

Float = NDArray[np.float64]


class MotionSamples(NamedTuple):
    """The camera at n times.

    Attributes
    ----------
    pointing : Pointing
        The camera's orientation with respect to the sky, n times.
    q_body_ned : (n, 4) float64
        Attitudes (w, x, y, z), NED to body.
    site : Site
        The aircraft's position at the middle time.
    """

    pointing: Pointing
    q_body_ned: Float
    site: Site


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """The camera's orientation with respect to the sky as a function of time.

    Attributes
    ----------
    flight : Flight
    sky : Sky
    mount : Mount
    pressure_hpa, temperature_c : float
        The air at the aircraft.
    """

    flight: Flight
    sky: Sky
    mount: Mount
    pressure_hpa: float
    temperature_c: float

    def pointings(self, *utc_s: Float) -> list[Pointing]:
        """Return the camera's orientation for several arrays of times; one call takes little longer than one array.

        Parameters
        ----------
        *utc_s : (n,) float64
            UTC seconds since 1970, all within minutes of each other.

        Returns
        -------
        list of Pointing

        Raises
        ------
        TrackRangeError
            If a time lies outside the flight.
        """
        return [samples.pointing for samples in self.at(*utc_s)]

    def at(self, *utc_s: Float) -> list[MotionSamples]:
        """Return orientation, attitude and site for several arrays of times.

        Parameters
        ----------
        *utc_s : (n,) float64
            UTC seconds since 1970, all within minutes of each other.

        Returns
        -------
        list of MotionSamples

        Raises
        ------
        TrackRangeError
            If a time lies outside the flight.

        Notes
        -----
        Teague & Chahl, eqs (22), (30)-(32), composed in float64.
        """
        all_s = np.concatenate(utc_s)
        latitude_rad, longitude_rad, height_m = self.flight.position.coordinates(all_s)
        C_ned_eq = self.sky.C_ned_eq(all_s, latitude_rad, longitude_rad)
        q_body_ned = self.flight.attitude.at(all_s)
        C_camera_eq = self.mount.C_camera_body @ matrix_from_quaternion(q_body_ned) @ C_ned_eq
        samples = []
        first = 0
        for times_s in utc_s:
            these, middle = slice(first, first + len(times_s)), first + len(times_s) // 2
            latitude, longitude, height = (float(of[middle]) for of in (latitude_rad, longitude_rad, height_m))
            site = Site(latitude, longitude, height, self.pressure_hpa, self.temperature_c)
            pointing = Pointing(
                C_camera_eq=C_camera_eq[these],
                zenith_eq=-C_ned_eq[these, 2],
                velocity_eq=diurnal_aberration_rad(latitude, height) * C_ned_eq[these, 1],
                refraction_scale=self.sky.refraction_scale(site),
                sine_horizon=self.sky.sine_horizon(height),
                profile=self.sky.profile,
            )
            samples.append(MotionSamples(pointing, q_body_ned[these], site))
            first = these.stop
        return samples
