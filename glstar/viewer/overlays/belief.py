"""What a navigator believes, with its errors, and the answers that it gives; loads no OpenCV and no imgui."""

from dataclasses import dataclass
from math import degrees, hypot

import numpy as np

from glstar.arrays import Float
from glstar.camera.model import AttitudeError

_ONE_DEGREE = float(np.deg2rad(1.0))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedAnswer:
    """A navigator's answer, with the time that it is for."""

    utc_s: float  # UTC seconds since 1970
    frame: str  # Number or file of the frame
    C_camera_icrs: Float | None = None  # (3, 3)
    position_rad: tuple[float, float] | None = None  # Latitude and longitude, WGS84
    # Semi-axes of the stated error ellipse, km, and the azimuth of the major one, rad.
    ellipse: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What a navigator believes at one time, with its errors."""

    name: str  # Such as ``"estimate"`` or ``"answer 12"``
    # (3, 3) rotation from the camera frame that the navigator believes in to the true one.
    C_camera_estimated: Float | None = None
    # (3, 3) rotation from north, east, down to the estimated camera frame; of the estimate only.
    C_estimated_ned: Float | None = None
    roll_rad: float | None = None  # Attitude of the aircraft, of the estimate only
    pitch_rad: float | None = None
    # Position minus the true one, north and east, along the surface.
    offset_km: tuple[float, float] | None = None
    ellipse: tuple[float, float, float] | None = None  # See `PlacedAnswer`
    has_ghost: bool = False  # Whether the stars are ringed where it has them
    lacking: str = ""  # Why there are no errors; empty if there are

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
    """Return an angle in degrees, or in minutes of arc below one."""
    return f"{degrees(angle_rad):.2f}\N{DEGREE SIGN}" if angle_rad >= _ONE_DEGREE else f"{60 * degrees(angle_rad):.1f}'"
