"""The error of a camera's attitude, as a viewer of its image sees it."""

from dataclasses import dataclass
from math import hypot
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.rotation import turn_from_matrix

__all__ = ["AttitudeError"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AttitudeError:
    """The error of an attitude: the rotation from the true camera frame to the answered one.

    Attributes
    ----------
    right_rad, down_rad : float
        Error of the answered optical axis to the right and down in the image, rad.
    roll_rad : float
        Rotation about the optical axis, rad.
    """

    right_rad: float
    down_rad: float
    roll_rad: float

    @property
    def boresight_rad(self) -> float:
        """Angle between the two optical axes, rad."""
        return hypot(self.right_rad, self.down_rad)

    @classmethod
    def between(cls, C_camera_icrs: Float, C_answered_icrs: Float) -> Self:
        """Return the error of a rotation from ICRS, or another frame, to the camera.

        Parameters
        ----------
        C_camera_icrs, C_answered_icrs : (3, 3) float64
            The true one and the other one.

        Returns
        -------
        AttitudeError
        """
        turn = turn_from_matrix(C_answered_icrs @ C_camera_icrs.T)
        # The optical axis turns about the image's right axis downwards, about its down axis to the left.
        return cls(float(turn[1]), float(-turn[0]), float(turn[2]))
