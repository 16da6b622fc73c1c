"""World coordinates of an image: a tangent plane with polynomial distortion (TAN-SIP), fitted to lens and refraction.

The fit relates pixels to astrometric directions: ICRS at the epoch of the image, as a catalogue gives them after proper
motion and parallax.  It contains the lens, refraction, annual and diurnal aberration, precession and nutation.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import erfa
import numpy as np
from numpy.typing import NDArray

from glstar.render.pointing import Pointing
from glstar.render.scene import Scene

__all__ = ["TanSip", "fit_tan_sip"]

Float = NDArray[np.float64]

# The polynomial has the lowest order whose largest error is below this, px; SIP allows orders up to 9.
_SUFFICIENT_PX: Final = 0.002
_ORDERS: Final = range(2, 10)
# Nodes per side of the fit (Chebyshev, so that errors at the border stay as small as inside) and of its validation.
_FIT_NODES: Final = 28
_VALIDATION_NODES: Final = 23
# The fit extends beyond the image by this fraction of its sides.
_MARGIN: Final = 0.01
# Newton steps from a pixel to the direction that refraction moves there; each gains at least a factor of 3, on the
# horizon, and 1000 in the upper sky.
_REFRACTION_STEPS: Final = 25
# Points that have not converged to this after the steps are left out, rad: 0.0002".
_CONVERGED_RAD: Final = 1e-9


@dataclass(frozen=True, eq=False)
class TanSip:
    """World coordinates of an image, in the terms of the SIP convention.

    Attributes
    ----------
    crpix_px : (2,) float64
        The reference pixel (x, y), counted from 0.
    crval_rad : (2,) float64
        Right ascension and declination (ICRS) of the reference pixel, rad.
    cd_rad : (2, 2) float64
        Matrix from pixels to the tangent plane, rad/px.
    a, b, ap, bp : (order + 1, order + 1) float64
        Coefficients of the forward and the inverse polynomial; ``a[i, j]`` belongs to u^i v^j.
    rms_px, max_px : float
        Error of the forward polynomial over the image above the horizon.
    inverse_max_px : float
        Largest error of the inverse polynomial.
    """

    crpix_px: Float
    crval_rad: Float
    cd_rad: Float
    a: Float
    b: Float
    ap: Float
    bp: Float
    rms_px: float
    max_px: float
    inverse_max_px: float

    @property
    def order(self) -> int:
        """The order of the polynomials."""
        return len(self.a) - 1


def fit_tan_sip(scene: Scene) -> TanSip | None:
    """Fit the world coordinates of an image in the middle of its exposure, of a rolling shutter that of each row.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    TanSip or None
        None if too little of the image lies above the horizon to fit a polynomial.

    Notes
    -----
    Shupe et al. 2005, *ASP Conf. Ser.* 347, 491 (SIP); Calabretta & Greisen 2002, *A&A* 395, 1077 (TAN).
    """
    sky = _SkyOfPixels(scene)
    nodes = _grid(scene, np.cos(np.pi * (np.arange(_FIT_NODES) + 0.5) / _FIT_NODES))
    tests = _grid(scene, np.linspace(-1, 1, _VALIDATION_NODES))
    nodes, plane = _above_horizon(nodes, sky.plane(nodes))
    tests, expected = _above_horizon(tests, sky.plane(tests))
    best: TanSip | None = None
    for order in _ORDERS:
        if len(nodes) < 4 * len(_exponents(order)) or not len(tests):
            break
        made = _fitted(order, nodes, plane, tests, expected, sky)
        if best is None or made.max_px < best.max_px:
            best = made
        if best.max_px < _SUFFICIENT_PX:
            break
    return best


class _SkyOfPixels:
    """The astrometric directions of the pixels of one scene, and their tangent plane."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        # Earth's barycentric velocity in units of the speed of light, ICRS; the stars are of this epoch.
        utc_jd = 2440587.5 + scene.stars.epoch_utc_s / 86400
        _, barycentric = erfa.epv00(2400000.5, utc_jd - 2400000.5)
        self._velocity = np.asarray(barycentric["v"], dtype=np.float64) * erfa.DAU / erfa.DAYSEC / erfa.CMPS
        pole = self._icrs(self._unrefracted(np.array([[scene.camera.cx_px, scene.camera.cy_px]]), 0))[0]
        self.crval_rad = np.array([np.arctan2(pole[1], pole[0]) % (2 * np.pi), np.arcsin(np.clip(pole[2], -1, 1))])

    @cached_property
    def _axes(self) -> Float:
        """Unit vectors to the east, the north and the reference point, (3, 3)."""
        ra, dec = self.crval_rad
        return np.array(
            [
                [-np.sin(ra), np.cos(ra), 0.0],
                [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)],
                [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)],
            ]
        )

    def plane(self, xy_px: Float) -> Float:
        """Return tangent-plane coordinates (xi to the east, eta to the north) of pixels, (n, 2) rad; NaN for no sky."""
        east, north, ahead = (self._icrs(self._unrefracted(xy_px, _REFRACTION_STEPS)) @ self._axes.T).T
        in_front = ahead > 0
        ahead = np.where(in_front, ahead, np.nan)
        return np.column_stack([east / ahead, north / ahead])

    def _unrefracted(self, xy_px: Float, steps: int) -> Float:
        """Return the geocentric apparent directions whose stars are drawn at pixels, (n, 3); NaN below the horizon."""
        seen = self._scene.camera.unit_vectors(xy_px)
        observer = self._observer(xy_px)
        direction = observer.to_sky(seen)
        for _ in range(steps):
            direction = direction + observer.to_sky(seen - observer.drawn(direction, below_horizon=True))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        if steps:
            drawn = observer.drawn(direction, below_horizon=False)
            direction[~(np.abs(drawn - seen).max(axis=1) < _CONVERGED_RAD)] = np.nan
        return direction

    def _observer(self, xy_px: Float) -> "_Observer":
        """Return the camera in the middle of the exposure, of a rolling shutter that of each pixel's row."""
        scene, exposure = self._scene, self._scene.exposure
        if exposure.readout_s == 0 or scene.motion is None:
            return _Observer(scene.shutter[1:2])
        opening_s = exposure.opening_at_s(xy_px, scene.camera.width_px, scene.camera.height_px)
        utc_s = exposure.mid_utc_s + opening_s - exposure.readout_s / 2
        # The fit extends a little beyond the first and the last row.
        (pointing,) = scene.motion.pointings(utc_s.clip(exposure.start_utc_s, exposure.stop_utc_s))
        return _Observer(pointing)

    def _icrs(self, direction_eq: Float) -> Float:
        """Return astrometric directions, (n, 3): without annual aberration, in the axes of ICRS."""
        proper: Float = direction_eq @ self._scene.stars.C_eq_icrs
        # The inverse of relativistic aberration is the aberration of the opposite velocity.
        velocity = -self._velocity
        inverse_gamma = np.sqrt(1 - velocity @ velocity)
        along = proper @ velocity
        moved = inverse_gamma * proper + (1 + along / (1 + inverse_gamma))[:, np.newaxis] * velocity
        return np.asarray(moved / (1 + along)[:, np.newaxis])


@dataclass(frozen=True, eq=False)
class _Observer:
    """The camera at the time of n pixels: one for all of them, or one for each."""

    pointing: Pointing

    def to_sky(self, seen: Float) -> Float:
        """Return vectors of the camera's axes, (n, 3), in those of the true equator and equinox."""
        C = self.pointing.C_camera_eq
        return np.asarray(seen @ C[0] if len(C) == 1 else np.einsum("ni,nij->nj", seen, C))

    def drawn(self, direction_eq: Float, *, below_horizon: bool) -> Float:
        """Return the unit vectors of the camera's axes, (n, 3), along which stars of some directions are drawn."""
        pointing = self.pointing
        if len(pointing) == 1:
            drawn = pointing.to_camera(direction_eq, below_horizon=below_horizon)[0]
        else:
            drawn = pointing.each_to_camera(direction_eq, below_horizon=below_horizon)
        return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def _grid(scene: Scene, nodes: Float) -> Float:
    """Return pixels on the nodes (-1 to 1) along both sides of an image and a margin, (n, 2) px."""
    camera = scene.camera
    sides = np.array([camera.width_px, camera.height_px])
    columns, rows = ((side - 1) / 2 + (0.5 + _MARGIN) * side * nodes for side in sides)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _above_horizon(xy_px: Float, plane_rad: Float) -> tuple[Float, Float]:
    seen = np.isfinite(plane_rad).all(axis=1)
    return xy_px[seen], plane_rad[seen]


def _exponents(order: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]


def _terms(points: Float, exponents: list[tuple[int, int]]) -> Float:
    """Return the monomials of points, (n, terms)."""
    powers = points[:, :, np.newaxis] ** np.arange(max(map(sum, exponents)) + 1)
    return np.stack([powers[:, 0, i] * powers[:, 1, j] for i, j in exponents], axis=1)


def _fitted(order: int, nodes: Float, plane: Float, tests: Float, expected: Float, sky: _SkyOfPixels) -> TanSip:
    """Fit polynomials of one order to pixels and tangent-plane coordinates, and measure their errors on others."""
    inverse = _Polynomial.fit(plane, nodes, _exponents(order))
    crpix_px = inverse(np.zeros((1, 2)))[0]
    without_constant = _exponents(order)[1:]
    forward = _Polynomial.fit(nodes - crpix_px, plane, without_constant)
    of = dict(zip(without_constant, forward.coefficients, strict=True))
    cd_rad = np.column_stack([of[1, 0], of[0, 1]])
    to_px = np.linalg.inv(cd_rad)
    a, b = _matrices(order, {key: to_px @ value for key, value in of.items() if sum(key) > 1})
    # From the linear estimate of the pixel offset to what the forward polynomial adds to it, inverted.
    linear, linear_tests = plane @ to_px.T, expected @ to_px.T
    back = _Polynomial.fit(linear, nodes - crpix_px - linear, _exponents(order))
    ap, bp = _matrices(order, dict(zip(_exponents(order), back.coefficients, strict=True)))
    # The error in the plane, in px by the forward polynomial's own local scale.
    wrong = forward(tests - crpix_px) - expected
    step = 0.5
    columns = [forward(tests + half - crpix_px) - forward(tests - half - crpix_px) for half in step * np.eye(2)]
    jacobian = np.stack(columns, axis=-1) / (2 * step)
    error_px = np.linalg.norm(np.linalg.solve(jacobian, wrong[..., np.newaxis])[..., 0], axis=1)
    inverse_px = np.linalg.norm(linear_tests + back(linear_tests) - (tests - crpix_px), axis=1)
    return TanSip(
        crpix_px,
        sky.crval_rad,
        cd_rad,
        a,
        b,
        ap,
        bp,
        rms_px=float(np.sqrt(np.mean(error_px**2))),
        max_px=float(error_px.max()),
        inverse_max_px=float(inverse_px.max()),
    )


@dataclass(frozen=True, eq=False)
class _Polynomial:
    """A polynomial of two variables with values in a plane."""

    exponents: list[tuple[int, int]]
    coefficients: Float  # (terms, 2)

    @classmethod
    def fit(cls, points: Float, values: Float, exponents: list[tuple[int, int]]) -> "_Polynomial":
        """Return the least-squares fit to values (n, 2) at points (n, 2), solved in points of unit size."""
        scale = np.abs(points).max()
        scaled, *_ = np.linalg.lstsq(_terms(points / scale, exponents), values, rcond=None)
        sizes = scale ** np.array([sum(one) for one in exponents], dtype=np.float64)
        return cls(exponents, scaled / sizes[:, np.newaxis])

    def __call__(self, points: Float) -> Float:
        return np.asarray(_terms(points, self.exponents) @ self.coefficients)


def _matrices(order: int, coefficients: dict[tuple[int, int], Float]) -> tuple[Float, Float]:
    """Return the coefficients of x and of y as matrices by exponent."""
    x, y = np.zeros((order + 1, order + 1)), np.zeros((order + 1, order + 1))
    for (i, j), (of_x, of_y) in coefficients.items():
        x[i, j], y[i, j] = of_x, of_y
    return x, y
