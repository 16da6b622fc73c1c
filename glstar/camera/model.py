"""The camera: a pixel grid behind a pinhole or a lens, its mount on the aircraft, and errors of its attitude."""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, hypot, isfinite
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.camera.distortion import Lens
from glstar.errors import CalibrationError, RenderError
from glstar.rotation import matrix_from_euler

# Samples along each side of the image at which properties of a lens are evaluated.
_SAMPLES_PER_SIDE = 65
# Largest field angle that is drawn behind a lens: at 70 deg the undistorted plane is 2.7 focal lengths high.
_MAX_DRAWN_RAD = np.deg2rad(70.0)
# Step of finite differences in the undistorted plane, for first and second derivatives of the distortion.
_STEP = 1e-6
_SECOND_STEP = 1e-3

# From axes forward (along the boresight), right, down to the camera's right, down, forward.
_CAMERA_FRD = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera: x to the right, y down, z along the optical axis.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    fx_px, fy_px : float
        Focal lengths, px.
    cx_px, cy_px : float
        The principal point, px.  Pixel (0, 0) is the CENTRE of the top-left pixel, so the middle of an image is
        ((width - 1) / 2, (height - 1) / 2).
    skew_px : float
        Skew of the pixel axes, px.
    lens : Lens or None
        Its distortion; None for a pinhole.

    Raises
    ------
    CalibrationError
        If a size or a focal length is not positive, or a number is not finite.

    Notes
    -----
    Teague & Chahl, eq. (33).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0
    lens: Lens | None = None

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise CalibrationError(f"an image of {self.width_px} x {self.height_px} px has no pixels")
        for key in ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px"):
            if not isfinite(getattr(self, key)):
                raise CalibrationError(
                    f"the camera matrix has {key} = {getattr(self, key)}; it must be a finite number"
                )
        for key in ("fx_px", "fy_px"):
            if getattr(self, key) <= 0:
                raise CalibrationError(
                    f"the camera matrix has {key} = {getattr(self, key)}; a focal length is a positive number of pixels"
                )

    @property
    def K(self) -> Float:
        """The intrinsic matrix of eq. (33), (3, 3) float64, px."""
        return np.array([[self.fx_px, self.skew_px, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    @property
    def pinhole(self) -> "Camera":
        """The same camera without its lens."""
        return self if self.lens is None else replace(self, lens=None)

    @property
    def field_radius_rad(self) -> float:
        """The largest angle between the optical axis and a point of the image, rad."""
        return _pinhole_field_radius_rad(self) if self.lens is None else _lens_field_radius_rad(self)

    @property
    def horizontal_field_rad(self) -> float:
        """The horizontal field of view, rad: along the row through the principal point.

        If an end of the row lies outside the image circle, the field ends at the limit of the lens.
        """
        ends = self.unproject([[-0.5, self.cy_px], [self.width_px - 0.5, self.cy_px]])[:, 0]
        if self.lens is not None:
            ends = np.where(np.isnan(ends), [-self.lens.limit, self.lens.limit], ends)
        return float(np.arctan(ends[1]) - np.arctan(ends[0]))

    @property
    def is_drawable(self) -> bool:
        """Whether the field is narrow enough to draw: behind a lens, up to 70 deg from the optical axis."""
        return self.lens is None or self.field_radius_rad <= _MAX_DRAWN_RAD

    @property
    def max_magnification(self) -> float:
        """Largest length of a short line anywhere on the image, over its length behind a pinhole; at least 1."""
        return 1.0 if self.lens is None else _max_magnification(self)

    @property
    def max_curvature(self) -> float:
        """Largest second derivative of the distortion over the image: how sharply it curves straight lines."""
        return 0.0 if self.lens is None else _max_curvature(self)

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image scale anywhere on the image, px/rad."""
        return float(max(self.fx_px, self.fy_px) * self.max_magnification / np.cos(self.field_radius_rad) ** 2)

    def require_drawable(self) -> None:
        """Reject a lens whose field is too wide to be drawn on a plane.

        Raises
        ------
        RenderError
            If a point of the image is more than 70 deg from the optical axis.
        """
        if not self.is_drawable:
            assert self.lens is not None
            raise RenderError(
                f"the camera's {self.lens.model} lens sees {np.rad2deg(self.field_radius_rad):.1f} deg off its axis and"
                f" glstar draws up to {np.rad2deg(_MAX_DRAWN_RAD):.0f}, because it draws an undistorted image first;"
                " give the camera of a smaller part of the image (width_px, height_px, cx_px, cy_px)"
            )

    def project(self, direction_camera: ArrayLike) -> Float:
        """Return the pixel positions of directions.

        Parameters
        ----------
        direction_camera : (..., 3) array_like
            Vectors in the camera frame (right, down, along the optical axis), of any length.

        Returns
        -------
        (..., 2) float64
            Positions (x, y), px; NaN for directions that are not in front of the camera or beyond the limit of the
            lens.

        Notes
        -----
        Teague & Chahl, eqs (34), (35), with the distortion between them.  Departs from eq. (34), which drops z < 0:
        z = 0 is dropped too.
        """
        direction = np.asarray(direction_camera, dtype=np.float64)
        z = np.where(direction[..., 2] > 1e-9, direction[..., 2], np.nan)
        # All x are contiguous, and all y, because the code below and most callers process one of them at a time.
        xy_px = np.empty((2, *z.shape))
        x, y = xy_px[0, ...], xy_px[1, ...]
        np.divide(direction[..., 0], z, out=x)
        np.divide(direction[..., 1], z, out=y)
        if self.lens is not None:
            x[...], y[...] = np.moveaxis(self.lens.distort(np.stack([x, y], axis=-1)), -1, 0)
        x *= self.fx_px
        if self.skew_px:
            x += self.skew_px * y
        x += self.cx_px
        y *= self.fy_px
        y += self.cy_px
        return xy_px.transpose(*range(1, xy_px.ndim), 0)

    def unproject(self, xy_px: ArrayLike) -> Float:
        """Return the directions of pixel positions: the inverse of `project`.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (..., 3) float64
            Vectors (x, y, 1) in the camera frame; NaN for positions that no direction within the lens's limit reaches.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        y = (xy[..., 1] - self.cy_px) / self.fy_px
        x = (xy[..., 0] - self.cx_px - self.skew_px * y) / self.fx_px
        if self.lens is not None:
            x, y = np.moveaxis(self.lens.undistort(np.stack([x, y], axis=-1)), -1, 0)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def unit_vectors(self, xy_px: ArrayLike) -> Float:
        """Return the directions of pixel positions as unit vectors.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (..., 3) float64
            In the camera frame; NaN as of `unproject`.
        """
        rays = self.unproject(xy_px)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def contains(self, xy_px: ArrayLike, margin_px: ArrayLike = 0.0) -> NDArray[np.bool_]:
        """Return which positions are on the image, or within a margin around it.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px; NaN is not on the image.
        margin_px : (...) array_like
            Margins, px.

        Returns
        -------
        (...) bool
        """
        return np.asarray(self.distance_outside_px(xy_px) < np.asarray(margin_px, dtype=np.float64))

    def distance_outside_px(self, xy_px: ArrayLike) -> Float:
        """Return the distances of positions from the border of the image, along the axis where they are larger.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (...) float64
            px, negative on the image; NaN for NaN.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        beside_px = np.abs(xy[..., 0] - (self.width_px - 1) / 2) - self.width_px / 2
        above_px = np.abs(xy[..., 1] - (self.height_px - 1) / 2) - self.height_px / 2
        return np.maximum(beside_px, above_px)


# These are evaluated for every scene.
@lru_cache(maxsize=64)
def _pinhole_field_radius_rad(camera: Camera) -> float:
    """Return `Camera.field_radius_rad` of a pinhole."""
    corners = np.array([[x, y, 1.0] for x in (-0.5, camera.width_px - 0.5) for y in (-0.5, camera.height_px - 0.5)])
    rays = np.linalg.solve(camera.K, corners.T)
    return float(np.arctan(np.hypot(rays[0], rays[1])).max())


@lru_cache(maxsize=64)
def _lens_field_radius_rad(camera: Camera) -> float:
    """Return `Camera.field_radius_rad` behind a lens.

    It is that of the border of the image, or the limit of the lens if a part of the border lies beyond it.
    """
    columns = np.linspace(-0.5, camera.width_px - 0.5, _SAMPLES_PER_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _SAMPLES_PER_SIDE)
    border = [[x, y] for x in columns for y in rows[[0, -1]]] + [[x, y] for x in columns[[0, -1]] for y in rows]
    tangent = np.hypot(*np.moveaxis(camera.unproject(border)[:, :2], -1, 0))
    assert camera.lens is not None
    widest = camera.lens.limit if np.isnan(tangent).any() else float(tangent.max())
    return float(np.arctan(widest))


@lru_cache(maxsize=64)
def _max_magnification(camera: Camera) -> float:
    """Return the largest singular value of the Jacobian of the distortion over the image, at least 1."""
    plane = _plane(camera)
    lens = camera.lens
    assert lens is not None
    steps = _STEP * np.eye(2)[:, np.newaxis]
    jacobian = np.moveaxis(lens.distort(plane + steps) - lens.distort(plane - steps), 0, -1) / (2 * _STEP)
    jacobian = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]
    return float(np.linalg.norm(jacobian, ord=2, axis=(1, 2)).max(initial=1.0))


@lru_cache(maxsize=64)
def _max_curvature(camera: Camera) -> float:
    """Return the largest second derivative of the distortion over the image and over twelve directions."""
    plane = _plane(camera)
    lens = camera.lens
    assert lens is not None
    largest = 0.0
    for angle_rad in np.arange(12) * np.pi / 12:
        step = _SECOND_STEP * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        second = lens.distort(plane + step) - 2 * lens.distort(plane) + lens.distort(plane - step)
        largest = max(largest, float(np.nanmax(np.hypot(second[:, 0], second[:, 1]))) / _SECOND_STEP**2)
    return largest


def _plane(camera: Camera) -> Float:
    """Return undistorted points of a grid over the image, (n, 2)."""
    columns = np.linspace(-0.5, camera.width_px - 0.5, _SAMPLES_PER_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _SAMPLES_PER_SIDE)
    points = camera.unproject(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))[:, :2]
    return points[np.isfinite(points).all(axis=1)]


@dataclass(frozen=True, slots=True)
class Mount:
    """The orientation of the camera on the aircraft.

    Attributes
    ----------
    roll_rad, pitch_rad, yaw_rad : float
        The angles of eq. (31), rad.  The default is the paper's mount: the boresight points at the zenith of a level
        aircraft, image right is forward and image down is the left wing.
    reading : {"body", "literal"}
        What the angles rotate.  ``"body"``: a camera whose boresight initially points along the nose; its axes
        forward, right, down are rotated and become boresight, right, down.  ``"literal"``: eq. (31) as printed, which
        rotates a camera that initially points down, with image right along the nose.

    Notes
    -----
    Teague & Chahl, eq. (31).  Departs from eq. (31): with ``"literal"``, a camera at the paper's angles
    (-90, 90, 0) deg points along the left wing, while the paper's figures show the zenith, as with ``"body"``.
    """

    roll_rad: float = 0.0
    pitch_rad: float = np.pi / 2
    yaw_rad: float = -np.pi / 2
    reading: Literal["body", "literal"] = "body"

    @property
    def C_camera_body(self) -> Float:
        """Rotation from body to camera components, (3, 3) float64, read-only."""
        return _camera_body(self)

    @classmethod
    def from_matrix(cls, C_camera_body: ArrayLike, *, reading: Literal["body", "literal"] = "body") -> Self:
        """Return the mount with a given rotation matrix.

        Parameters
        ----------
        C_camera_body : (3, 3) array_like
            Rotation from body to camera components.
        reading : {"body", "literal"}
            As for `Mount`.

        Returns
        -------
        Mount
            Roll and yaw from -pi to pi, pitch from -pi/2 to pi/2; roll is 0 in gimbal lock.
        """
        C = np.asarray(C_camera_body, dtype=np.float64)
        rotated = C if reading == "literal" else _CAMERA_FRD.T @ C
        cosine = float(np.hypot(rotated[0, 0], rotated[0, 1]))
        pitch_rad = float(np.arctan2(-rotated[0, 2], cosine))
        if cosine < 1e-12:
            return cls(0.0, pitch_rad, float(np.arctan2(-rotated[1, 0], rotated[1, 1])), reading)
        roll_rad = float(np.arctan2(rotated[1, 2], rotated[2, 2]))
        return cls(roll_rad, pitch_rad, float(np.arctan2(rotated[0, 1], rotated[0, 0])), reading)


# Evaluated for every scene.
@lru_cache(maxsize=64)
def _camera_body(mount: Mount) -> Float:
    rotated = matrix_from_euler(mount.roll_rad, mount.pitch_rad, mount.yaw_rad)
    C = rotated if mount.reading == "literal" else _CAMERA_FRD @ rotated
    C.flags.writeable = False
    return C


@dataclass(frozen=True, slots=True)
class AttitudeError:
    """The error of an attitude: the rotation from the true camera frame to the answered one.

    It is one of the optical axis, along the great circle, and one about it: together exact up to 180 deg.
    """

    # Angle from the true to the answered optical axis, rad, and its parts to the right and down in the true image.
    right_rad: float
    down_rad: float
    roll_rad: float  # Rotation about the optical axis that remains, rad, -pi to pi

    @property
    def boresight_rad(self) -> float:
        """Angle between the two optical axes, rad."""
        return hypot(self.right_rad, self.down_rad)

    @classmethod
    def between(cls, C_camera_icrs: Float, C_answered_icrs: Float) -> Self:
        """Return the error of an answered rotation from ICRS, or another frame, to the camera, (3, 3)."""
        turn = C_answered_icrs @ C_camera_icrs.T
        right, down, ahead = (float(component) for component in turn[2])  # the answered axis in the true camera
        across = hypot(right, down)
        angle = atan2(across, ahead)
        # Opposite axes: every direction leads there.
        scale = angle / across if across > 0 else 1.0
        shift = (angle, 0.0) if across == 0 and ahead < 0 else (right * scale, down * scale)
        return cls(*shift, atan2(float(turn[0, 1] - turn[1, 0]), float(turn[0, 0] + turn[1, 1])))
