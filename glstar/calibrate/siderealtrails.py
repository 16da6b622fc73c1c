"""Sidereal trails: the motion of stars over the image of a camera at rest on the ground."""

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.platesolution import PlateSolution
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.observed import SIDEREAL_RAD_PER_S

__all__ = ["sidereal_trails"]

Float = NDArray[np.float64]


def sidereal_trails(solution: PlateSolution, xy_px: Float, exposure_s: float) -> Float:
    """Return the sidereal motion of stars over the image of a camera at rest on the ground.

    Parameters
    ----------
    solution : PlateSolution
        The camera and attitude at mid-exposure.
    xy_px : (n, 2) float64
        Positions at mid-exposure.
    exposure_s : float
        Exposure, s.

    Returns
    -------
    (n, 2) float64
        From the start of each trail to its end, px; zeros outside the lens's domain.
    """
    camera = solution.camera
    x = camera.width_px - 1 - xy_px[:, 0] if solution.mirrored else xy_px[:, 0]
    rays = camera.unproject(np.column_stack([x, xy_px[:, 1]]))
    pole = solution.C_camera_eq[:, 2]
    half = SIDEREAL_RAD_PER_S * exposure_s / 2
    # Stars move from east to west, against the sense of right ascension.
    before, after = (matrix_from_quaternion(quaternion_from_turn(sign * half * pole)) for sign in (-1.0, 1.0))
    return np.nan_to_num(solution.project(rays @ after.T) - solution.project(rays @ before.T))
