"""Where an object of the sky is with respect to the image, and when it enters the image."""

from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.flight import AttitudeTrack
from glstar.render.recordedpaths import recorded_positions
from glstar.render.scene import Scene
from glstar.render.simulator import Simulator
from glstar.sky.horizon import ned_to_azimuth_altitude_rad
from glstar.viewer.canvas import ned_to_camera_matrix

__all__ = ["ObjectPlace", "object_place", "time_in_image_s"]

Float = NDArray[np.float64]

# Interval at which a flight is searched for an object, s: a frame of 50 deg takes as long to pass at 200 deg/s.
_SEARCH_STEP_S: Final = 0.25
# Times per call, which must lie within minutes of each other.
_TIMES_AT_ONCE: Final = 400


@dataclass(frozen=True, slots=True)
class ObjectPlace:
    """An object with respect to one exposure.

    Attributes
    ----------
    altitude_rad, azimuth_rad : float
        Apparent direction in the middle of the exposure, with refraction; azimuth from north through east.
    x_px, y_px : float
        Position on the image in the middle of the exposure, with a rolling shutter of that of its own rows, px; NaN
        behind the camera.
    on_image : bool
        Whether it is on the image, above the horizon, at the middle of the exposure.
    right, down : float
        Unit vector in the image from its centre towards the object, also for an object behind the camera.
    from_axis_rad : float
        Angle from the optical axis, rad.
    """

    altitude_rad: float
    azimuth_rad: float
    x_px: float
    y_px: float
    on_image: bool
    right: float
    down: float
    from_axis_rad: float

    def message(self, name: str) -> str:
        """Return where the object is, in one line.

        Parameters
        ----------
        name : str
            Of the object.

        Returns
        -------
        str
            Such as ``"Sirius is outside the image, 34.2 deg to the left and 12.0 deg above"``.
        """
        if self.altitude_rad < 0:
            return f"{name} is {-degrees(self.altitude_rad):.1f} deg below the horizon"
        if self.on_image:
            return f"{name} is in the image at x {self.x_px:.1f}, y {self.y_px:.1f}"
        across, along = self.from_axis_rad * self.right, self.from_axis_rad * self.down
        parts = [
            f"{degrees(abs(angle)):.1f} deg {side}"
            for angle, side in (
                (across, "to the right" if across > 0 else "to the left"),
                (along, "below" if along > 0 else "above"),
            )
            if degrees(abs(angle)) >= 0.05
        ]
        return f"{name} is outside the image, {' and '.join(parts)}"


def object_place(scene: Scene, direction_eq: Float) -> ObjectPlace:
    """Return where an object is with respect to an exposure.

    Parameters
    ----------
    scene : Scene
    direction_eq : (3,) float64
        Apparent unit vector, true equator and equinox.

    Returns
    -------
    ObjectPlace
    """
    middle = scene.shutter[1:2]
    in_camera = middle.to_camera(direction_eq[np.newaxis], below_horizon=True)[0, 0]
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(in_camera @ ned_to_camera_matrix(middle))
    x_px, y_px = scene.camera.project(in_camera)
    if scene.exposure.readout_s and np.isfinite(x_px):
        recorded = recorded_positions(scene, direction_eq[np.newaxis], np.array([0.5]))[0, 0]
        x_px, y_px = recorded if np.isfinite(recorded).all() else (x_px, y_px)
    across, along, ahead = in_camera.tolist()
    bearing_rad = atan2(along, across)
    return ObjectPlace(
        altitude_rad=float(altitude_rad),
        azimuth_rad=float(azimuth_rad),
        x_px=float(x_px),
        y_px=float(y_px),
        on_image=bool(scene.camera.contains([x_px, y_px]) & (altitude_rad >= 0)),
        right=cos(bearing_rad),
        down=sin(bearing_rad),
        from_axis_rad=atan2(hypot(across, along), ahead),
    )


def time_in_image_s(simulator: Simulator, direction_eq: Float, after_utc_s: float) -> float | None:
    """Return when an object is on the image next, or first if it is not any more after a given time.

    Parameters
    ----------
    simulator : Simulator
    direction_eq : (3,) float64
        Apparent unit vector, true equator and equinox.
    after_utc_s : float
        UTC seconds since 1970.

    Returns
    -------
    float or None
        UTC seconds since 1970, to a quarter of a second; None if the object is never on the image.
    """
    attitude = simulator.flight.attitude
    times_s = np.arange(attitude.first_s, attitude.last_s, _SEARCH_STEP_S)
    later = np.flatnonzero(times_s > after_utc_s)
    first_later = int(later[0]) if later.size else len(times_s)
    return _first_in_image_s(simulator, attitude, direction_eq, times_s[first_later:]) or _first_in_image_s(
        simulator, attitude, direction_eq, times_s[:first_later]
    )


def _first_in_image_s(
    simulator: Simulator, attitude: AttitudeTrack, direction_eq: Float, times_s: Float
) -> float | None:
    for first in range(0, len(times_s), _TIMES_AT_ONCE):
        some_s = times_s[first : first + _TIMES_AT_ONCE]
        xy_px = simulator.camera.project(simulator.pointing(some_s).to_camera(direction_eq[np.newaxis]))[:, 0]
        for index in np.flatnonzero(simulator.camera.contains(xy_px)).tolist():
            if attitude.gap_within(some_s[index], some_s[index]) is None:
                return float(some_s[index])
    return None
