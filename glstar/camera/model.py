"""The camera: a pixel grid behind a pinhole or a lens, its mount on the aircraft, and errors of its attitude."""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, hypot, isfinite
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float, joined
from glstar.camera.distortion import Lens
from glstar.errors import CalibrationError
from glstar.rotation import matrix_from_euler

# Samples along each side of the image at which properties of a lens are evaluated.
_SAMPLES_PER_SIDE = 65

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
    def limit_rad(self) -> float:
        """The angle from the optical axis from which on directions have no position, rad: 90 deg, or that of the lens.

        A vector v has a position if v[2] > cos(limit_rad) * norm(v).
        """
        return np.pi / 2 if self.lens is None else self.lens.limit_rad

    @property
    def field_radius_rad(self) -> float:
        """The largest angle between the optical axis and a point of the image, rad."""
        return _pinhole_field_radius_rad(self) if self.lens is None else _lens_field_radius_rad(self)

    @property
    def horizontal_field_rad(self) -> float:
        """The horizontal field of view, rad: along the row through the principal point.

        If an end of the row lies outside the image circle, the field ends at the limit of the lens.
        """
        row = [[-0.5, self.cy_px], [self.width_px - 0.5, self.cy_px]]
        if self.lens is None:
            left_rad, right_rad = np.arctan(self.normalized(row)[:, 0])
        else:
            x, _, z = self.unit_vectors(row).T
            left_rad, right_rad = np.where(np.isnan(x), [-self.limit_rad, self.limit_rad], np.arctan2(x, z))
        return float(right_rad - left_rad)

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image scale anywhere on the image, px/rad."""
        if self.lens is None:
            return float(max(self.fx_px, self.fy_px) / np.cos(self.field_radius_rad) ** 2)
        return _lens_max_px_per_rad(self)

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
        if self.lens is not None:
            point = self.lens.project(direction)
            return self._pixels(point[..., 0], point[..., 1])
        x, y, _ = _tangents(direction)
        return self._pixels(x, y)

    def project_with_rates(self, direction_camera: ArrayLike, rate: ArrayLike) -> tuple[Float, Float]:
        """Return the pixel positions of directions and their rates.

        Parameters
        ----------
        direction_camera : (..., 3) array_like
            As for `project`.
        rate : (..., 3) array_like
            Derivatives of the vectors with respect to a parameter, such as time.

        Returns
        -------
        xy_px : (..., 2) float64
            As of `project`.
        rate_px : (..., 2) float64
            Derivatives of `xy_px`, px per unit of the parameter; NaN where `xy_px` is NaN.
        """
        direction, change = np.asarray(direction_camera, dtype=np.float64), np.asarray(rate, dtype=np.float64)
        if self.lens is not None:
            point, point_rate = self.lens.project_with_rates(direction, change)
            x, y, x_rate, y_rate = (one[..., k] for one in (point, point_rate) for k in range(2))
        else:
            x, y, z = _tangents(direction)
            x_rate, y_rate = (change[..., 0] - x * change[..., 2]) / z, (change[..., 1] - y * change[..., 2]) / z
        rate_px = joined(self.fx_px * x_rate + self.skew_px * y_rate, self.fy_px * y_rate)
        return np.broadcast_to(self._pixels(x, y), rate_px.shape), rate_px

    def px_per_rad(self, direction_camera: ArrayLike) -> Float:
        """Return the image scale at directions, along the radius and at right angles to it.

        Parameters
        ----------
        direction_camera : (..., 3) array_like
            Unit vectors in the camera frame.

        Returns
        -------
        (..., 2, 2) float64
            Derivatives of (x, y) with respect to an angle away from the optical axis, in the first column, and to an
            angle at right angles to it, clockwise on the image, in the second, px/rad.  On the axis itself the first is
            to the right.
        """
        direction = np.asarray(direction_camera, dtype=np.float64)
        x, y, z = np.moveaxis(direction, -1, 0)
        rho = np.hypot(x, y)
        out_x, out_y = np.where(rho > 0, x / np.where(rho > 0, rho, 1.0), 1.0), y / np.where(rho > 0, rho, 1.0)
        outwards = np.stack([z * out_x, z * out_y, -rho], axis=-1)
        around = np.stack([-out_y, out_x, np.zeros_like(rho)], axis=-1)
        return np.stack([self.project_with_rates(direction, turn)[1] for turn in (outwards, around)], axis=-1)

    def _pixels(self, x: Float, y: Float) -> Float:
        """Return the pixel positions of points of the normalized image plane."""
        # All x are contiguous, and all y, because most callers process one of them at a time.
        xy_px = np.empty((2, *np.shape(x)))
        x_px, y_px = xy_px[0, ...], xy_px[1, ...]
        np.multiply(x, self.fx_px, out=x_px)
        if self.skew_px:
            x_px += self.skew_px * y
        x_px += self.cx_px
        np.multiply(y, self.fy_px, out=y_px)
        y_px += self.cy_px
        return xy_px.transpose(*range(1, xy_px.ndim), 0)

    def normalized(self, xy_px: ArrayLike) -> Float:
        """Return the points of the normalized image plane: pixels multiplied by the inverse of the camera matrix.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (..., 2) float64
            Points behind the lens; for a pinhole, the tangents (X / Z, Y / Z) of directions.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        y = (xy[..., 1] - self.cy_px) / self.fy_px
        return joined((xy[..., 0] - self.cx_px - self.skew_px * y) / self.fx_px, y)

    def unit_vectors(self, xy_px: ArrayLike) -> Float:
        """Return the directions of pixel positions: the inverse of `project`.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (..., 3) float64
            Unit vectors in the camera frame; NaN for positions that no direction within `limit_rad` reaches.
        """
        points = self.normalized(xy_px)
        if self.lens is not None:
            return self.lens.unproject(points)
        rays = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
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


def _tangents(direction: Float) -> tuple[Float, Float, Float]:
    """Return x / z, y / z and z of vectors (..., 3); NaN for those that are not in front of the camera."""
    z = direction[..., 2]
    is_ahead = z > 1e-9
    if not is_ahead.all():
        z = np.where(is_ahead, z, np.nan)
    return direction[..., 0] / z, direction[..., 1] / z, z


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

    It is the largest angle of the border of the image, or the limit of the lens if a part of the border lies beyond it.
    """
    columns = np.linspace(-0.5, camera.width_px - 0.5, _SAMPLES_PER_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _SAMPLES_PER_SIDE)
    border = [[x, y] for x in columns for y in rows[[0, -1]]] + [[x, y] for x in columns[[0, -1]] for y in rows]
    x, y, z = camera.unit_vectors(border).T
    angle_rad = np.arctan2(np.hypot(x, y), z)
    return camera.limit_rad if np.isnan(angle_rad).any() else float(angle_rad.max())


@lru_cache(maxsize=64)
def _lens_max_px_per_rad(camera: Camera) -> float:
    """Return `Camera.max_px_per_rad` behind a lens: in all directions."""
    return float(np.linalg.svd(camera.px_per_rad(directions_seen(camera)), compute_uv=False).max())


def directions_seen(camera: Camera) -> Float:
    """Return the directions of a grid over the image, (n, 3) unit vectors, where it has one."""
    columns = np.linspace(-0.5, camera.width_px - 0.5, _SAMPLES_PER_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _SAMPLES_PER_SIDE)
    seen = camera.unit_vectors(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    return seen[np.isfinite(seen).all(axis=1)]


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
