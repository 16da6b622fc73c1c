"""Where the directions of a camera's image meet the ground."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.sky.geodesy import geocentric_m, semi_axes_m
from glstar.sky.horizon import C_ned_eq
from glstar.sky.site import Site
from glstar.viewer.imageazimuths import image_border

__all__ = ["Footprint", "ground_footprint"]

Float = NDArray[np.float64]

# Points around the horizon.
_HORIZON_POINTS: Final = 721


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The ground that an image shows: geocentric positions in ITRS, m, NaN where there is none.

    Attributes
    ----------
    border : (n, 3) float64
        Along the border of the image, in order.
    horizon : (m, 3) float64
        Around the horizon of the ground: NaN where it is not in the image.
    axis : (3,) float64
        Where the optical axis meets the ground.
    """

    border: Float
    horizon: Float
    axis: Float

    @property
    def is_empty(self) -> bool:
        """Whether the image shows no ground."""
        return not (np.isfinite(self.border).any() or np.isfinite(self.horizon).any() or np.isfinite(self.axis).any())


def ground_footprint(camera: Camera, C_camera_ned: Float, site: Site, ground_m: float) -> Footprint:
    """Return where the rays of an image meet the ground, without refraction and without terrain.

    Parameters
    ----------
    camera : Camera
    C_camera_ned : (3, 3) array_like
        Rotation from north, east, down to the camera frame.
    site : Site
        Of the camera, above the ground.
    ground_m : float
        Height of the ground above the WGS84 ellipsoid, m: an ellipsoid whose semi-axes are longer by that.

    Returns
    -------
    Footprint
        Empty if the site is not above the ground.
    """
    axes_m = semi_axes_m() + ground_m
    eye_m = geocentric_m(site.latitude_rad, site.longitude_rad, site.height_m)
    C_camera_itrs = C_camera_ned @ C_ned_eq(site.latitude_rad, site.longitude_rad)
    rays = np.vstack([image_border(camera), [0.0, 0.0, 1.0]]) @ C_camera_itrs
    ground = _first_hits(eye_m / axes_m, rays / axes_m) * axes_m
    horizon = _tangent_points(eye_m / axes_m) * axes_m
    in_camera = (horizon - eye_m) @ C_camera_itrs.T
    with np.errstate(invalid="ignore"):
        seen = camera.contains(camera.project(in_camera)) & (in_camera[:, 2] > 0)
    horizon[~seen] = np.nan
    return Footprint(ground[:-1], horizon, ground[-1])


def _first_hits(eye: Float, rays: Float) -> Float:
    """Return where rays from a point outside of the unit sphere first meet it: (n, 3), NaN where they do not."""
    squared, along = np.sum(rays**2, axis=1), rays @ eye
    height = eye @ eye - 1
    with np.errstate(invalid="ignore"):
        root = np.sqrt(along**2 - squared * height)
        # The product of both roots is height / squared: the nearer one without cancellation.
        distance = np.where((along < 0) & (height > 0), height / (root - along), np.nan)
    return np.asarray(eye + distance[:, np.newaxis] * rays)


def _tangent_points(eye: Float) -> Float:
    """Return the points around the horizon of a point outside of the unit sphere: (n, 3), NaN if it is inside."""
    squared = float(eye @ eye)
    if squared <= 1:
        return np.full((_HORIZON_POINTS, 3), np.nan)
    outwards = eye / np.sqrt(squared)
    first = np.cross(outwards, np.eye(3)[np.abs(outwards).argmin()])
    first /= np.linalg.norm(first)
    angle = np.linspace(0.0, 2 * np.pi, _HORIZON_POINTS)[:, np.newaxis]
    around = np.cos(angle) * first + np.sin(angle) * np.cross(outwards, first)
    return np.asarray(eye / squared + np.sqrt(1 - 1 / squared) * around)
