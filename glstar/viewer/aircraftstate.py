"""Where the aircraft is at a time, how it flies and where its camera points; its ground track as a map shows it."""

from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.flight import Flight
from glstar.render.simulator import Simulator
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.geodesy import north_east_down_m
from glstar.sky.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.site import Site
from glstar.viewer.imageazimuths import image_azimuths_rad

__all__ = ["AircraftState", "aircraft_state", "ground_track_m"]

Float = NDArray[np.float64]

# Interval over which speeds are measured, s: GPS positions come five times a second at most.
_SPEED_INTERVAL_S: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class AircraftState:
    """The aircraft at one time.

    Attributes
    ----------
    roll_rad, pitch_rad, yaw_rad : float
        Euler angles of the body.
    site : Site
        Its position.
    ground_speed_m_per_s, climb_m_per_s : float
        Horizontal and upward speed, averaged over a second; NaN for a flight with a single position.
    camera_azimuth_rad, camera_altitude_rad : float
        Direction of the optical axis.
    lowest_altitude_rad : float
        Altitude of the lowest corner of the image, without refraction.
    image_azimuths_rad : tuple of float
        Azimuths that the image covers: the first, and the extent clockwise; see `image_azimuths_rad`.
    C_camera_ned : (3, 3) float64
        Rotation from north, east, down to the camera frame.
    """

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    site: Site
    ground_speed_m_per_s: float
    climb_m_per_s: float
    camera_azimuth_rad: float
    camera_altitude_rad: float
    lowest_altitude_rad: float
    image_azimuths_rad: tuple[float, float]
    C_camera_ned: Float

    @property
    def view(self) -> str:
        """A message if the camera sees the ground, else empty."""
        if self.camera_altitude_rad < 0:
            return "the camera points below the horizon"
        return "a part of the image is below the horizon" if self.lowest_altitude_rad < 0 else ""


def aircraft_state(simulator: Simulator, utc_s: float) -> AircraftState:
    """Return the state of the aircraft at a time.

    Parameters
    ----------
    simulator : Simulator
        Its flight, mount and camera.
    utc_s : float
        UTC seconds since 1970, inside the flight.

    Returns
    -------
    AircraftState
    """
    flight, camera = simulator.flight, simulator.camera
    roll, pitch, yaw = (float(angle) for angle in euler_from_quaternion(flight.aircraft_attitude.at(utc_s)))
    q_body_ned = flight.attitude.at(np.array([utc_s]))
    C_camera_ned = simulator.mount.C_camera_body @ matrix_from_quaternion(q_body_ned)[0]
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(C_camera_ned[2])
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = camera.unproject([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])
    _, corner_rad = ned_to_azimuth_altitude_rad(corners @ C_camera_ned)
    ground_speed, climb = _speeds_m_per_s(flight, utc_s)
    return AircraftState(
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        site=flight.position.at(utc_s),
        ground_speed_m_per_s=ground_speed,
        climb_m_per_s=climb,
        camera_azimuth_rad=float(azimuth_rad),
        camera_altitude_rad=float(altitude_rad),
        lowest_altitude_rad=float(np.fmin.reduce(corner_rad)),
        image_azimuths_rad=image_azimuths_rad(camera, C_camera_ned),
        C_camera_ned=C_camera_ned,
    )


def ground_track_m(flight: Flight, origin: Site, points: int = 2000) -> Float:
    """Return the ground track of a flight around a site.

    Parameters
    ----------
    flight : Flight
    origin : Site
    points : int
        Largest number of points.

    Returns
    -------
    (n, 2) float64
        East and north of the origin, m.
    """
    position = flight.position
    stride = max(1, -(-len(position.utc_s) // points))
    chosen = np.append(np.arange(0, len(position.utc_s) - 1, stride), len(position.utc_s) - 1)
    ned_m = north_east_down_m(
        origin, position.latitude_rad[chosen], position.longitude_rad[chosen], position.height_m[chosen]
    )
    return ned_m[:, 1::-1]


def _speeds_m_per_s(flight: Flight, utc_s: float) -> tuple[float, float]:
    """Return horizontal and upward speed around a time."""
    position = flight.position
    if len(position.utc_s) < 2:
        return float("nan"), float("nan")
    times_s = np.clip(utc_s + np.array([-0.5, 0.5]) * _SPEED_INTERVAL_S, position.utc_s[0], position.utc_s[-1])
    if times_s[1] <= times_s[0]:
        return float("nan"), float("nan")
    north, east, down = np.diff(north_east_down_m(position.at(utc_s), *position.coordinates(times_s)), axis=0)[0]
    interval_s = times_s[1] - times_s[0]
    return hypot(north, east) / interval_s, -down / interval_s
