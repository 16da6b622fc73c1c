"""What a navigator believes, with its errors."""

from dataclasses import dataclass
from math import degrees, hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.attitudeerror import AttitudeError

__all__ = ["Belief", "PlacedAnswer", "angle_label"]

Float = NDArray[np.float64]

_ONE_DEGREE: Final = float(np.deg2rad(1.0))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedAnswer:
    """A navigator's answer, with the time that it is for.

    Attributes
    ----------
    utc_s : float
        UTC seconds since 1970.
    frame : str
        The frame's number or file.
    C_camera_icrs : (3, 3) float64 or None
    position_rad : (float, float) or None
        Latitude and longitude, WGS84, rad.
    ellipse : (float, float, float) or None
        Semi-axes of the stated error ellipse, km, and the azimuth of the major one, rad.
    """

    utc_s: float
    frame: str
    C_camera_icrs: Float | None = None
    position_rad: tuple[float, float] | None = None
    ellipse: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What a navigator believes at one time, with its errors.

    Attributes
    ----------
    name : str
        Such as ``"estimate"`` or ``"answer 12"``.
    C_camera_estimated : (3, 3) float64 or None
        From the camera frame that the navigator believes in to the true one.
    C_estimated_ned : (3, 3) float64 or None
        From north, east, down to the estimated camera frame; of the estimate only.
    roll_rad, pitch_rad : float or None
        Attitude of the aircraft, of the estimate only.
    offset_km : (float, float) or None
        Position minus the true one, north and east, along the surface.
    ellipse : (float, float, float) or None
        See `PlacedAnswer`.
    lacking : str
        Why there are no errors; empty if there are.
    """

    name: str
    C_camera_estimated: Float | None = None
    C_estimated_ned: Float | None = None
    roll_rad: float | None = None
    pitch_rad: float | None = None
    offset_km: tuple[float, float] | None = None
    ellipse: tuple[float, float, float] | None = None
    lacking: str = ""

    @property
    def error(self) -> AttitudeError | None:
        """The error of the attitude."""
        if self.C_camera_estimated is None:
            return None
        return AttitudeError.between(np.eye(3), self.C_camera_estimated.T)

    @property
    def figures(self) -> str:
        """The errors in one line, such as ``"24.0' across, roll +0.10 deg, 44.5 km"``, or why there are none."""
        parts = []
        if (error := self.error) is not None:
            parts += [f"{angle_label(error.boresight_rad)} across, roll {degrees(error.roll_rad):+.2f}\N{DEGREE SIGN}"]
        if self.offset_km is not None:
            parts.append(f"{hypot(*self.offset_km):.1f} km")
        return ", ".join(parts) or self.lacking or "no attitude and no position"


def angle_label(angle_rad: float) -> str:
    """Return an angle in degrees, or in minutes of arc below one.

    Parameters
    ----------
    angle_rad : float

    Returns
    -------
    str
    """
    return f"{degrees(angle_rad):.2f}\N{DEGREE SIGN}" if angle_rad >= _ONE_DEGREE else f"{60 * degrees(angle_rad):.1f}'"
