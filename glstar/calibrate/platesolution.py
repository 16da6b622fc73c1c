"""Plate solutions: the camera and the attitude that map the sky to an image."""

import itertools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.referencestars import ReferenceStars
from glstar.calibrate.rowturns import RowTurns
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera

__all__ = ["CENTRAL_RADIUS_RAD", "PlateSolution", "exceeds_pinhole", "wide_angle_cameras"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# Lenses to try for wide fields of view with an unknown lens.  Most wide-angle lenses are nearly equidistant (the
# distance from the principal point is proportional to the angle from the axis), whatever their calibrated model.
_WIDE_LENSES: Final = (Lens("fisheye", ()), Lens("fisheye", (1 / 6,)))
# Smallest horizontal field of view that counts as wide.
_WIDE_RAD: Final = np.deg2rad(35.0)
# Largest horizontal field of view of a pinhole; wider ones need a fisheye.
_WIDEST_PINHOLE_RAD: Final = np.deg2rad(140.5)
# Within this angle of the axis each lens of `_WIDE_LENSES` is right to 1 %.
CENTRAL_RADIUS_RAD: Final = np.deg2rad(20.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlateSolution:
    """The camera and the attitude that map the sky to an image.

    Attributes
    ----------
    camera : Camera
    C_camera_eq : (3, 3) float64
        Rotation from the true equator and equinox of date to the camera frame.
    mirrored : bool
        Whether left and right are exchanged on the image.
    k1 : float
        Radial distortion of the lowest order in addition to the camera's lens, as OpenCV's k1.
    prior_camera : Camera or None
        The camera before refinement, if there was one: parameters that the stars do not determine stay at its values.
    """

    camera: Camera
    C_camera_eq: Float
    mirrored: bool = False
    k1: float = 0.0
    prior_camera: Camera | None = None

    def project(self, direction_camera: Float) -> Float:
        """Return the pixel positions of directions in the camera frame.

        Parameters
        ----------
        direction_camera : (n, 3) float64

        Returns
        -------
        (n, 2) float64
            px; NaN behind the camera.
        """
        camera = self.camera
        centre = np.array([camera.cx_px, camera.cy_px])
        undistorted = camera.project(direction_camera) - centre
        square = (undistorted[:, 0] / camera.fx_px) ** 2 + (undistorted[:, 1] / camera.fy_px) ** 2
        # Beyond the image a negative k1 would turn back and bring stars from outside into the image.
        square = np.minimum(square, 1.5 * np.tan(camera.field_radius_rad) ** 2)
        xy = centre + undistorted * (1 + self.k1 * square)[:, np.newaxis]
        if self.mirrored:
            xy[:, 0] = camera.width_px - 1 - xy[:, 0]
        return np.asarray(xy)

    def predicted(self, reference: ReferenceStars) -> Float:
        """Return where catalogue stars are on the image, of a rolling shutter each in its own row.

        Parameters
        ----------
        reference : ReferenceStars

        Returns
        -------
        (n, 2) float64
            px; NaN behind the camera and below the horizon.
        """
        if reference.rows is None:
            return self.project(reference.to_camera(self.C_camera_eq))
        return self.placed(reference.to_camera(np.eye(3)), reference.rows)

    def placed(self, apparent: Float, rows: RowTurns | None) -> Float:
        """Return where apparent directions are on the image, of a rolling shutter each in its own row.

        Parameters
        ----------
        apparent : (n, 3) float64
            True equator and equinox of date.
        rows : RowTurns or None

        Returns
        -------
        (n, 2) float64
            px; NaN behind the camera.
        """

        def project(apparent: Float) -> Float:
            return self.project(apparent @ self.C_camera_eq.T)

        return project(apparent) if rows is None else rows.positions(project, apparent, self.camera)

    def stars_on_image(self, reference: ReferenceStars) -> tuple[Index, Float]:
        """Return the catalogue stars predicted on the image.

        Parameters
        ----------
        reference : ReferenceStars

        Returns
        -------
        index : (k,) intp
            Into `reference.stars`, the brightest first.
        xy_px : (k, 2) float64
            Predicted positions, px.
        """
        xy = self.predicted(reference)
        on_image = np.flatnonzero(self.camera.contains(xy))
        return on_image, xy[on_image]


def wide_angle_cameras(camera: Camera) -> tuple[Camera, ...]:
    """Return cameras with typical wide-angle lenses and the horizontal field of view of a given pinhole camera.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    tuple of Camera
        Empty for a camera with a known lens and for a narrow field of view.  For a field too wide for a pinhole it
        includes cameras whose image circle fits the shorter side of the image.
    """
    tangent = camera.width_px / 2 / camera.fx_px
    if camera.lens is not None or 2 * np.arctan(tangent) < _WIDE_RAD:
        return ()
    sides_px = [camera.width_px]
    if exceeds_pinhole(camera) and camera.height_px < camera.width_px:
        sides_px.append(camera.height_px)
    wide = []
    for side_px, lens in itertools.product(sides_px, _WIDE_LENSES):
        f_px = side_px / 2 / float(lens.distort([tangent, 0.0])[0])
        wide.append(replace(camera, fx_px=f_px, fy_px=f_px * camera.fy_px / camera.fx_px, lens=lens))
    return tuple(wide)


def exceeds_pinhole(camera: Camera) -> bool:
    """Return whether the horizontal field of view of a camera without a lens needs a fisheye."""
    return camera.lens is None and 2 * np.arctan(camera.width_px / 2 / camera.fx_px) > _WIDEST_PINHOLE_RAD
