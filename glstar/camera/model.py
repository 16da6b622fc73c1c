"""The camera: a pixel grid behind a pinhole or a lens, and how it is bolted to the aircraft."""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import isfinite
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.distortion import Lens
from glstar.errors import CalibrationError, RenderError
from glstar.rotation import matrix_from_euler

__all__ = ["Camera", "Mount"]

Float = NDArray[np.float64]

# Where a lens is asked what it does: so many places along each side of the image, and inside it.
_PLACES_A_SIDE = 65
# Behind a lens no wider field is drawn: the plane is 2.7 focal lengths high there, and grows without bound.
_WIDEST_DRAWN_RAD = np.deg2rad(70.0)
# A step in the pinhole's plane over which a lens is straight.
_STEP = 1e-6
# One over which it is not.
_LONG_STEP = 1e-3

# A camera-like frame x forward (along the boresight), y right, z down, to x right, y down, z forward.
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
        The principal point, px; pixel (0, 0) is the CENTRE of the top-left pixel, so that the middle of an image
        is ((width - 1) / 2, (height - 1) / 2).
    skew_px : float
        Skew of the pixel axes, px.
    lens : Lens or None
        How its lens bends straight lines; None for a pinhole.

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
            raise CalibrationError(f"an image of {self.width_px} x {self.height_px} px holds no pixel")
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
    def reach_rad(self) -> float:
        """The angle from the optical axis to the farthest place of the image, rad."""
        return _pinhole_reach_rad(self) if self.lens is None else _lens_reach_rad(self)

    @property
    def across_rad(self) -> float:
        """The angle between what the ends of the row through the principal point see, rad.

        Where an end lies outside the image circle, the lens's own limit counts.
        """
        ends = self.unproject([[-0.5, self.cy_px], [self.width_px - 0.5, self.cy_px]])[:, 0]
        if self.lens is not None:
            ends = np.where(np.isnan(ends), [-self.lens.limit, self.lens.limit], ends)
        return float(np.arctan(ends[1]) - np.arctan(ends[0]))

    @property
    def can_be_drawn(self) -> bool:
        """Whether the lens's field is narrow enough to draw: up to 70 deg off the optical axis."""
        return self.lens is None or self.reach_rad <= _WIDEST_DRAWN_RAD

    @property
    def stretch(self) -> float:
        """How many times as long as in a pinhole's image a short line can be, anywhere on the image and 1 at least."""
        return 1.0 if self.lens is None else _lens_stretch(self)

    @property
    def bend(self) -> float:
        """How sharply the lens bends straight lines at the most: its largest second derivative over the image."""
        return 0.0 if self.lens is None else _lens_bend(self)

    @property
    def most_px_per_rad(self) -> float:
        """A bound on how many pixels a small angle takes anywhere on the image, px/rad."""
        return float(max(self.fx_px, self.fy_px) * self.stretch / np.cos(self.reach_rad) ** 2)

    def check_field(self) -> None:
        """Refuse a lens that sees so wide a field that no plane holds it.

        Raises
        ------
        RenderError
            If a place on the image looks farther than 70 deg off the optical axis.
        """
        if not self.can_be_drawn:
            assert self.lens is not None
            raise RenderError(
                f"the camera's {self.lens.model} lens sees {np.rad2deg(self.reach_rad):.1f} deg off its axis and"
                f" glstar draws {np.rad2deg(_WIDEST_DRAWN_RAD):.0f}, for behind a lens light is drawn on a plane first;"
                " give the camera of a smaller part of the image (width_px, height_px, cx_px, cy_px)"
            )

    def project(self, direction_camera: ArrayLike) -> Float:
        """Return where directions fall on the image.

        Parameters
        ----------
        direction_camera : (..., 3) array_like
            Vectors in the camera frame (right, down, along the optical axis), of any length.

        Returns
        -------
        (..., 2) float64
            Positions (x, y), px; NaN for directions that do not point ahead of the camera, and for those from which
            the lens lets no light in.

        Notes
        -----
        Teague & Chahl, eqs (34), (35), and between them the lens.  Departs from eq. (34), which drops z < 0: z = 0 is
        dropped too.
        """
        direction = np.asarray(direction_camera, dtype=np.float64)
        z = np.where(direction[..., 2] > 1e-9, direction[..., 2], np.nan)
        # All columns lie together, and all rows: what comes after looks at one of them at a time.
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
        """Return from where light falls on places of the image: the inverse of `project`.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (..., 3) float64
            Vectors (x, y, 1) in the camera frame; NaN where no light arrives through the lens.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        y = (xy[..., 1] - self.cy_px) / self.fy_px
        x = (xy[..., 0] - self.cx_px - self.skew_px * y) / self.fx_px
        if self.lens is not None:
            x, y = np.moveaxis(self.lens.undistort(np.stack([x, y], axis=-1)), -1, 0)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def contains(self, xy_px: ArrayLike, margin_px: ArrayLike = 0.0) -> NDArray[np.bool_]:
        """Return which positions lie on the image, or within a margin around it.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px; NaN is nowhere.
        margin_px : (...) array_like
            Margins, px.

        Returns
        -------
        (...) bool
        """
        return np.asarray(self.beyond_px(xy_px) < np.asarray(margin_px, dtype=np.float64))

    def beyond_px(self, xy_px: ArrayLike) -> Float:
        """Return how wide a margin around the image would just reach positions.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            Positions (x, y), px.

        Returns
        -------
        (...) float64
            px, less than nothing on the image; NaN for NaN.
        """
        xy = np.asarray(xy_px, dtype=np.float64)
        beside_px = np.abs(xy[..., 0] - (self.width_px - 1) / 2) - self.width_px / 2
        above_px = np.abs(xy[..., 1] - (self.height_px - 1) / 2) - self.height_px / 2
        return np.maximum(beside_px, above_px)


# A scene asks for these again and again.
@lru_cache(maxsize=64)
def _pinhole_reach_rad(camera: Camera) -> float:
    """Return `Camera.reach_rad` of a pinhole."""
    corners = np.array([[x, y, 1.0] for x in (-0.5, camera.width_px - 0.5) for y in (-0.5, camera.height_px - 0.5)])
    rays = np.linalg.solve(camera.K, corners.T)
    return float(np.arctan(np.hypot(rays[0], rays[1])).max())


@lru_cache(maxsize=64)
def _lens_reach_rad(camera: Camera) -> float:
    """Return `Camera.reach_rad` behind a lens: of the image's border, where every place has a ray, else the lens's."""
    columns = np.linspace(-0.5, camera.width_px - 0.5, _PLACES_A_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _PLACES_A_SIDE)
    border = [[x, y] for x in columns for y in rows[[0, -1]]] + [[x, y] for x in columns[[0, -1]] for y in rows]
    tangent = np.hypot(*np.moveaxis(camera.unproject(border)[:, :2], -1, 0))
    assert camera.lens is not None
    widest = camera.lens.limit if np.isnan(tangent).any() else float(tangent.max())
    return float(np.arctan(widest))


@lru_cache(maxsize=64)
def _lens_stretch(camera: Camera) -> float:
    """Return `Camera.stretch` behind a lens: the largest singular value of its slope over the image."""
    plane = _plane(camera)
    lens = camera.lens
    assert lens is not None
    steps = _STEP * np.eye(2)[:, np.newaxis]
    slope = np.moveaxis(lens.distort(plane + steps) - lens.distort(plane - steps), 0, -1) / (2 * _STEP)
    slope = slope[np.isfinite(slope).all(axis=(1, 2))]
    return float(np.linalg.norm(slope, ord=2, axis=(1, 2)).max(initial=1.0))


@lru_cache(maxsize=64)
def _lens_bend(camera: Camera) -> float:
    """Return `Camera.bend` behind a lens, over twelve directions."""
    plane = _plane(camera)
    lens = camera.lens
    assert lens is not None
    largest = 0.0
    for angle_rad in np.arange(12) * np.pi / 12:
        step = _LONG_STEP * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        second = lens.distort(plane + step) - 2 * lens.distort(plane) + lens.distort(plane - step)
        largest = max(largest, float(np.nanmax(np.hypot(second[:, 0], second[:, 1]))) / _LONG_STEP**2)
    return largest


def _plane(camera: Camera) -> Float:
    """Return places all over the image, in the pinhole's plane, (n, 2)."""
    columns = np.linspace(-0.5, camera.width_px - 0.5, _PLACES_A_SIDE)
    rows = np.linspace(-0.5, camera.height_px - 0.5, _PLACES_A_SIDE)
    places = camera.unproject(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))[:, :2]
    return places[np.isfinite(places).all(axis=1)]


@dataclass(frozen=True, slots=True)
class Mount:
    """How the camera is bolted to the aircraft.

    Attributes
    ----------
    roll_rad, pitch_rad, yaw_rad : float
        The angles of eq. (31), rad.  The default is the paper's mount: it looks at the zenith of a level aircraft,
        image right is forward and image down is the left wing.
    reading : {"body", "literal"}
        What the angles turn.  ``"body"``: a camera whose boresight starts along the aircraft's nose; its forward,
        right, down axes are turned, then renamed right, down, boresight.  ``"literal"``: eq. (31) as printed, whose
        angles turn a camera that starts by looking down through the floor, image right along the nose.

    Notes
    -----
    Teague & Chahl, eq. (31).  Departs from eq. (31): with ``"literal"`` the paper's angles (-90, 90, 0) deg look out
    of the left wing, where the paper's own figures show the zenith; ``"body"`` is what they mean.
    """

    roll_rad: float = 0.0
    pitch_rad: float = np.pi / 2
    yaw_rad: float = -np.pi / 2
    reading: Literal["body", "literal"] = "body"

    @property
    def C_camera_body(self) -> Float:
        """Body components to camera ones, (3, 3) float64, read-only."""
        return _camera_body(self)

    @classmethod
    def from_matrix(cls, C_camera_body: ArrayLike, *, reading: Literal["body", "literal"] = "body") -> Self:
        """Return the mount whose angles make a matrix.

        Parameters
        ----------
        C_camera_body : (3, 3) array_like
            Body components to camera ones.
        reading : {"body", "literal"}
            How the angles shall be read.

        Returns
        -------
        Mount
            Roll and yaw from -pi to pi, pitch from -pi/2 to pi/2; where roll and yaw are one, roll is 0.
        """
        C = np.asarray(C_camera_body, dtype=np.float64)
        turned = C if reading == "literal" else _CAMERA_FRD.T @ C
        cosine = float(np.hypot(turned[0, 0], turned[0, 1]))
        pitch_rad = float(np.arctan2(-turned[0, 2], cosine))
        if cosine < 1e-12:
            return cls(0.0, pitch_rad, float(np.arctan2(-turned[1, 0], turned[1, 1])), reading)
        roll_rad = float(np.arctan2(turned[1, 2], turned[2, 2]))
        return cls(roll_rad, pitch_rad, float(np.arctan2(turned[0, 1], turned[0, 0])), reading)


# A scene asks for it again and again.
@lru_cache(maxsize=64)
def _camera_body(mount: Mount) -> Float:
    turned = matrix_from_euler(mount.roll_rad, mount.pitch_rad, mount.yaw_rad)
    C = turned if mount.reading == "literal" else _CAMERA_FRD @ turned
    C.flags.writeable = False
    return C
