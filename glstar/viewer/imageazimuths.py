"""The azimuths that a camera's image covers."""

from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.sky.horizon import ned_to_azimuth_altitude_rad

__all__ = ["image_azimuths_rad", "image_border"]

Float = NDArray[np.float64]

# Points on each side of the image's border: near the zenith, azimuths change fast from point to point.
_POINTS: Final = 128
_UP_AND_DOWN_NED: Final = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])


def image_azimuths_rad(camera: Camera, C_camera_ned: Float) -> tuple[float, float]:
    """Return the azimuths between which all directions of an image lie, without refraction.

    Parameters
    ----------
    camera : Camera
    C_camera_ned : (3, 3) array_like
        Rotation from north, east, down to the camera frame.

    Returns
    -------
    first_rad : float
        Azimuth from north through east, 0 to 2 pi.  NaN, as the extent, if a part of the image's border is beyond the
        limit of the lens.
    extent_rad : float
        Clockwise from there, seen from above; 2 pi if the zenith or the nadir is in the image.
    """
    directions = image_border(camera) @ C_camera_ned
    if not np.isfinite(directions).all():
        return np.nan, np.nan
    if camera.contains(camera.project(_UP_AND_DOWN_NED @ C_camera_ned.T)).any():
        return 0.0, 2 * np.pi
    azimuth_rad = np.unwrap(ned_to_azimuth_altitude_rad(directions)[0])
    first_rad, last_rad = float(azimuth_rad.min()), float(azimuth_rad.max())
    return first_rad % (2 * np.pi), min(last_rad - first_rad, 2 * np.pi)


@lru_cache(maxsize=2)
def image_border(camera: Camera) -> Float:
    """Return directions along the border of an image.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    (n, 3) float64
        Vectors in the camera frame, in order; NaN beyond the limit of the lens.
    """
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    along = np.linspace(0.0, 1.0, _POINTS, endpoint=False)[:, np.newaxis]
    sides = [start + along * (end - start) for start, end in pairwise(corners)]
    return camera.unproject(np.concatenate(sides))
