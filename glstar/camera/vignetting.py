"""Vignetting: what a lens transmits of stars and of the sky, which is not the same.

A pixel away from the optical axis receives less light of both through the tilted aperture.  It also sees a smaller
solid angle of the sky, which makes a surface fainter and leaves a star as it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.sensor.pixelpattern import read_map, smooth

VignettingModel = Literal["none", "cos4", "polynomial", "flat"]

VIGNETTINGS = ("none", "cos4", "polynomial", "flat")
# Terms of the polynomials that the shader evaluates: as many as the tolerance asks for.  With all, the largest relative
# errors of stars are 3e-5 up to 60 deg off the axis and 5e-4 up to 70 deg; those of the sky are 1e-4 behind a lens.
# Behind a pinhole cos^4 has three terms.
_TERMS = range(3, 9)
# Relative error up to which a polynomial has fewer terms.
_TOLERANCE = 5e-6
# Points of the image, along each side, that the polynomials are fitted to.
_POINTS = 65


@dataclass(frozen=True, slots=True)
class FalloffFit:
    """Transmission as polynomials of a function of the squared distance from the principal point."""

    # Coefficients of stars and of a uniform sky, ascending powers of w = (1 + b) u / (1 + b u), where u is q /
    # `largest_q` and b is `bend`.
    star: tuple[float, ...]
    sky: tuple[float, ...]
    largest_q: float  # Largest q on the image: x^2 + y^2 of the distorted point, squared tangents
    # 0: w is u; `largest_q`: w is proportional to the squared sine of the field angle of a pinhole, of which cos^4 is a
    # polynomial.
    bend: float
    # Upper bound of the second derivatives of both with respect to a coordinate of the distorted point.
    curvature: float


@dataclass(frozen=True, slots=True)
class Vignetting:
    """How light falls off towards the corners of the image.

    Horn, Robot Vision (1986), section 10.3: irradiance of a surface falls with cos^4: cos^3 is the solid angle of a
    pixel of a pinhole, and cos the projected aperture, which is all that a star loses.
    """

    # {"none", "cos4", "polynomial", "flat"}: ``"none"``: stars and sky are uniform; ``"cos4"``: an aperture without
    # mechanical vignetting; ``"polynomial"`` and ``"flat"``: a uniform sky falls off as the polynomial or the measured
    # flat field.
    vignetting: VignettingModel = "none"
    # Coefficients v of 1 + v2 r^2 + v4 r^4 + v6 r^6 with r = 1 at half the diagonal of the image.
    vignetting_r2: float = 0.0
    vignetting_r4: float = 0.0
    vignetting_r6: float = 0.0
    vignetting_file: str = ""  # File of the flat field for ``"flat"``

    @classmethod
    def of(cls, effects: Mapping[str, Any]) -> "Vignetting":
        """Return the vignetting that the keys of ``[lens]`` describe, given `Sensor.effects`; others have defaults."""
        return cls(**{name: effects[f"lens.{name}"] for name in cls.__slots__ if f"lens.{name}" in effects})

    def of_sky(self, camera: Camera, xy_px: ArrayLike) -> Float:
        """Return the brightness of a uniform sky over that on the axis, (...); 0 where the lens shows nothing."""
        xy = np.asarray(xy_px, dtype=np.float64)
        if self.vignetting == "cos4":
            return _cosine(camera, xy) * relative_solid_angle(camera, xy)
        if self.vignetting == "polynomial":
            half_diagonal_px = np.hypot(camera.width_px, camera.height_px) / 2
            q = ((xy[..., 0] - camera.cx_px) ** 2 + (xy[..., 1] - camera.cy_px) ** 2) / half_diagonal_px**2
            series = 1 + q * (self.vignetting_r2 + q * (self.vignetting_r4 + q * self.vignetting_r6))
            return np.asarray(np.maximum(series, 0.0))
        if self.vignetting == "flat":
            return self._flat_at(camera, xy)
        return np.ones(xy.shape[:-1])

    def of_stars(self, camera: Camera, xy_px: ArrayLike) -> Float:
        """Return the fraction of a star's light that arrives over that on the axis, (...): `of_sky` per solid angle."""
        if self.vignetting == "none":
            return np.ones(np.shape(xy_px)[:-1])
        solid_angle = relative_solid_angle(camera, xy_px)
        seen = solid_angle > 0
        return np.where(seen, self.of_sky(camera, xy_px) / np.where(seen, solid_angle, 1.0), 0.0)

    def fit(self, camera: Camera) -> FalloffFit:
        """Return polynomials of `of_stars` and `of_sky` over the image; for all but ``"flat"``."""
        return _fit(self, camera)

    def _flat_at(self, camera: Camera, xy: Float) -> Float:
        """Return the smoothed flat field over its value on the axis, to the nearest pixel."""
        flat = smooth(read_map(self.vignetting_file))
        most = np.array([camera.width_px - 1, camera.height_px - 1])
        column, row = np.moveaxis(np.clip(np.rint(xy), 0, most).astype(np.intp), -1, 0)
        axis_column, axis_row = np.clip(np.rint([camera.cx_px, camera.cy_px]), 0, most).astype(np.intp)
        return np.asarray(flat[row, column] / flat[axis_row, axis_column], dtype=np.float64)


def image_grid(camera: Camera, columns: int, rows: int) -> Float:
    """Return the middles of the cells that divide an image into columns and rows, (rows, columns, 2) px.

    The middles are the texel centres of a texture that covers the image.
    """
    x = (np.arange(columns) + 0.5) * camera.width_px / columns - 0.5
    y = (np.arange(rows) + 0.5) * camera.height_px / rows - 0.5
    return np.stack(np.meshgrid(x, y), axis=-1)


def relative_solid_angle(camera: Camera, xy_px: ArrayLike) -> Float:
    """Return the solid angle of pixels, (..., 2) px, in units of a pixel on the optical axis, (...).

    It is cos^3 of the field angle for a pinhole, and 0 where the lens shows nothing.
    """
    direction = camera.unit_vectors(xy_px)
    if camera.lens is None:
        return np.asarray(direction[..., 2] ** 3)
    per_pixel = px2_per_sr(camera, np.array([0.0, 0.0, 1.0])) / px2_per_sr(camera, direction)
    return np.asarray(np.where(np.isfinite(per_pixel), per_pixel, 0.0))


def px2_per_sr(camera: Camera, direction: Float) -> Float:
    """Return the pixels per solid angle at unit vectors, (...); NaN where the lens shows nothing."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(np.linalg.det(camera.px_per_rad(direction))))


def _cosine(camera: Camera, xy_px: Float) -> Float:
    """Return the cosine of the field angle; 0 where the lens shows nothing, and beyond 90 deg."""
    return np.maximum(np.nan_to_num(camera.unit_vectors(xy_px)[..., 2]), 0.0)


@lru_cache(maxsize=8)
def _fit(vignetting: Vignetting, camera: Camera) -> FalloffFit:
    # To the outer edges of the image, so that no pixel is beyond the largest q.
    x, y = (np.linspace(-0.5, length - 0.5, _POINTS) for length in (camera.width_px, camera.height_px))
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    q = (camera.normalized(xy) ** 2).sum(axis=-1).ravel()
    star = vignetting.of_stars(camera, xy).ravel()
    sky = vignetting.of_sky(camera, xy).ravel()
    seen = star > 0
    largest_q = float(q[seen].max())
    bend = largest_q if vignetting.vignetting == "cos4" else 0.0
    u = q[seen] / largest_q
    w = (1 + bend) * u / (1 + bend * u)
    transmission = np.stack([star[seen], sky[seen]], axis=1)
    for terms in _TERMS:
        powers = np.vander(w, terms, increasing=True)
        coefficients = np.asarray(np.linalg.lstsq(powers, transmission, rcond=None)[0], dtype=np.float64)
        if np.all(np.abs(powers @ coefficients - transmission) <= _TOLERANCE * transmission):
            break
    star_terms, sky_terms = (tuple(column.tolist()) for column in coefficients.T)
    return FalloffFit(star_terms, sky_terms, largest_q, bend, _curvature(coefficients, largest_q, bend))


def _curvature(coefficients: Float, largest_q: float, bend: float) -> float:
    """Return a bound of the second derivatives of polynomials of w with respect to x, where q is x^2 + y^2."""
    u = np.linspace(0.0, 1.0, _POINTS)
    along = np.polynomial.polynomial.polyval((1 + bend) * u / (1 + bend * u), coefficients)
    slope = np.gradient(along, u, axis=1, edge_order=2)
    bent = np.gradient(slope, u, axis=1, edge_order=2)
    return float(np.max(2 * np.abs(slope) + 4 * u * np.abs(bent)) / largest_q)
