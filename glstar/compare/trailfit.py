"""One trail found on a real image: the simulated light shifted, stretched, turned and dimmed until it fits."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from glstar.compare.backgroundsubtraction import SubtractedImage
from glstar.compare.predictedtrails import Stamp, deformation, offsets_and_directions, stamp_of

__all__ = ["FoundTrail", "find_trail"]

Float = NDArray[np.float64]

# Beyond the light's own pixels so many more tell the sky's level, and how far a fit may go before it is cut anew.
_MARGIN_PX: Final = 3
_ROUNDS: Final = 30
# Done when a round would gain no more than this in chi squared: a hundredth of a standard deviation.
_STILL: Final = 1e-4
_CUTS: Final = 4
_DARK_SHARE: Final = 0.02
_LEAST_PIXELS: Final = 12
# What is thought of a trail's stretch and turn (rad) before it is looked at: a faint one shall not run away.
_USUAL_BEND: Final = 0.3
_PRIOR: Final = np.array([0.0, 0.0, 0.0, 0.0, _USUAL_BEND**-2, _USUAL_BEND**-2])
_MOST_BEND: Final = 0.6
# A found trail's light stands this many standard deviations above nothing ...
_LEAST_SIGNAL: Final = 5.0
# ... and what the fit leaves of it, noise aside, is less than this share of its power.
_MOST_LEFT: Final = 0.6
# No fit is trusted to better than this, px: the interpolation's own error.
_FLOOR_PX: Final = 0.005

# The slope at a pixel from its four neighbours, right to the fourth order.
_SLOPE: Final = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]]) / 12


@dataclass(frozen=True, slots=True, eq=False)
class FoundTrail:
    """How a trail of the real image differs from the simulated one.

    Attributes
    ----------
    modes : (4,) float64
        Real minus simulated: shift along x and y, px; stretch, a share of the length; turn, rad, clockwise as seen.
    covariance : (4, 4) float64
        Of the modes; what was not fitted has none.
    bent : bool
        Whether stretch and turn were fitted.
    brightness : float
        Real light over simulated light, pixel for pixel: of the trails' peaks.
    brightness_std : float
    sky_dn : float
        The level that the background left under it, DN.
    saturated : bool
        Whether a pixel of it is at the sensor's limit.
    """

    modes: Float
    covariance: Float
    bent: bool
    brightness: float
    brightness_std: float
    sky_dn: float
    saturated: bool


def find_trail(
    sky: SubtractedImage,
    signal_dn: NDArray[np.float32],
    path_px: Float,
    half_width_px: float,
    *,
    expected_px: Float,
    window_px: float,
    bends: bool,
) -> FoundTrail | None:
    """Return one trail of a real image.

    Parameters
    ----------
    sky : SubtractedImage
    signal_dn : (height, width) float32
        The simulated light.
    path_px : (n, 2) float64
        Where the star is on the simulated image.
    half_width_px : float
        How far its light reaches, px.
    expected_px : (2,) float64
        By how much it is probably shifted, px.
    window_px : float
        How far from there to look, px.
    bends : bool
        Whether it is long enough to have a length and a direction.

    Returns
    -------
    FoundTrail or None
        None where it is not there: no light like it, or not in the window.

    Notes
    -----
    Levenberg-Marquardt on brightness, sky, shift, stretch and turn, by least squares over the pixels that are not
    saturated.
    """
    stamp = stamp_of(path_px, half_width_px, margin_px=_MARGIN_PX)
    if not stamp.inside(signal_dn.shape):
        return None
    offset = _brightest_offset(sky, stamp.of(signal_dn), stamp, expected_px, window_px)
    if offset is None:
        return None
    fit = _Fit(signal_dn, stamp, path_px, bends=bends)
    for _ in range(_CUTS):
        cut = Stamp(stamp.left + int(offset[0]), stamp.top + int(offset[1]), stamp.mask)
        if not cut.inside(sky.above_dn.shape) or not fit.to(sky, cut):
            return None
        step = np.rint(fit.modes[:2]).astype(int)
        if not step.any():
            break
        offset = offset + step
        fit.modes[:2] -= step
    found = fit.result(offset)
    astray_px = float(np.linalg.norm(found.modes[:2] - expected_px))
    limit_px = window_px + 2.0
    return found if fit.is_valid and astray_px <= limit_px else None


def _brightest_offset(
    sky: SubtractedImage, template: NDArray[np.float32], stamp: Stamp, expected_px: Float, window_px: float
) -> NDArray[np.intp] | None:
    """Return the whole-pixel shift at which a real image looks most like a template, near the expected one."""
    w = int(np.ceil(window_px))
    middle = np.rint(expected_px).astype(int)
    left, top = stamp.left + middle[0] - w, stamp.top + middle[1] - w
    height, width = template.shape
    right, bottom = left + width + 2 * w, top + height + 2 * w
    # At the image's edge the window is smaller.
    low = np.array([max(0, left), max(0, top)])
    high = np.array([min(sky.above_dn.shape[1], right), min(sky.above_dn.shape[0], bottom)])
    if (high - low < (width, height)).any():
        return None
    window = sky.above_dn[low[1] : high[1], low[0] : high[0]]
    likeness = cv2.matchTemplate(window, np.where(stamp.mask, template, 0).astype(np.float32), cv2.TM_CCORR)
    row, column = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    return np.array([low[0] + column - stamp.left, low[1] + row - stamp.top])


class _Fit:
    """The fit of one template to one cut of a real image after another."""

    def __init__(self, signal_dn: NDArray[np.float32], stamp: Stamp, path_px: Float, *, bends: bool) -> None:
        self.template = stamp.of(signal_dn).astype(np.float64)
        self._spline = spline_filter(self.template, order=3)
        self._centre = path_px.mean(axis=0) - (stamp.left, stamp.top)
        self._along = offsets_and_directions(path_px[:, np.newaxis])[1][0]
        self._bends = bends
        rows, columns = np.indices(self.template.shape, dtype=np.float64)
        self._columns, self._rows = columns - self._centre[0], rows - self._centre[1]
        # Around the trail only what is dark: another star's light there may be wrong by other than this one's.
        grown = cv2.dilate(stamp.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        dark = self.template < _DARK_SHARE * float(self.template[stamp.mask].max())
        self._counts = stamp.mask | (grown & dark)
        self.modes = np.zeros(4)
        self.brightness, self.sky_dn = 1.0, 0.0
        self.is_valid = False

    def to(self, sky: SubtractedImage, cut: Stamp) -> bool:
        """Fit one cut; False where it cannot be fitted."""
        usable = cut.of(sky.usable)
        self._saturated = bool((~usable & cut.mask).any())
        weight = (usable & self._counts) / cut.of(sky.noise_dn)
        self._inside = np.flatnonzero(weight)
        if len(self._inside) < _LEAST_PIXELS:
            return False
        real = cut.of(sky.above_dn).astype(np.float64)
        free = np.array([True, True, True, True, self._bends, self._bends])
        damping = 1e-4
        J, r = self._linear(real, weight)
        cost = self._cost(r)
        for _ in range(_ROUNDS):
            normal = (J.T @ J + np.diag(_PRIOR))[np.ix_(free, free)]
            gradient = (J.T @ r - _PRIOR * np.concatenate([np.zeros(4), self.modes[2:]]))[free]
            step = np.zeros(6)
            step[free] = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-12), gradient)
            # What the step would gain: in standard deviations, the square of how far the minimum is.
            if float(step[free] @ gradient) < _STILL:
                break
            step[2:4] = step[2:4].clip(-1.5, 1.5)
            before = self.brightness, self.sky_dn, self.modes
            self.brightness += float(step[0])
            self.sky_dn += float(step[1])
            self.modes = self.modes + step[2:]
            self.modes[2:] = self.modes[2:].clip(-_MOST_BEND, _MOST_BEND)
            J_new, r_new = self._linear(real, weight)
            cost_new = self._cost(r_new)
            if cost_new <= cost:
                J, r, cost, damping = J_new, r_new, cost_new, damping / 5
            else:
                self.brightness, self.sky_dn, self.modes = before
                damping = max(damping, 1e-3) * 10
            if np.abs(self.modes[:2]).max() > _MARGIN_PX or damping > 1e3:
                break
        return self._conclude(J, r, free, len(self._inside))

    def _cost(self, r: Float) -> float:
        return float(r @ r) + float(np.sum(self.modes[2:] ** 2)) / _USUAL_BEND**2

    def _linear(self, real: Float, weight: Float) -> tuple[Float, Float]:
        """Return the slopes (p, 6) and what is left (p,) of the model, weighted."""
        x, y = self._columns - self.modes[0], self._rows - self.modes[1]
        back = np.linalg.inv(deformation(self._along, self.modes))
        source = (
            back[1, 0] * x + back[1, 1] * y + self._centre[1],
            back[0, 0] * x + back[0, 1] * y + self._centre[0],
        )
        T = map_coordinates(self._spline, source, order=3, prefilter=False, mode="nearest")
        across = cv2.filter2D(T, -1, _SLOPE, borderType=cv2.BORDER_REPLICATE)
        down = cv2.filter2D(T, -1, _SLOPE.T, borderType=cv2.BORDER_REPLICATE)
        inside = self._inside
        T, across, down, x, y, w = (each.ravel()[inside] for each in (T, across, down, x, y, weight))
        u, a = self._along, self.brightness
        J = np.empty((len(T), 6))
        J[:, 0] = T
        J[:, 1] = 1.0
        J[:, 2] = -a * across
        J[:, 3] = -a * down
        J[:, 4] = -a * (x * u[0] + y * u[1]) * (across * u[0] + down * u[1])
        J[:, 5] = -a * (down * x - across * y)
        J *= w[:, np.newaxis]
        return J, (real.ravel()[inside] - a * T - self.sky_dn) * w

    def _conclude(self, J: Float, r: Float, free: NDArray[np.bool_], pixels: int) -> bool:
        normal = (J.T @ J + np.diag(_PRIOR))[np.ix_(free, free)]
        try:
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return False
        # Where the trail is not quite of the simulated shape, its place is as uncertain as what is left says.
        spare = max(1.0, float(r @ r) / max(1, pixels - int(free.sum())))
        whole = np.zeros((6, 6))
        whole[np.ix_(free, free)] = inverse * spare
        self._covariance = whole[2:, 2:] + np.diag([_FLOOR_PX**2, _FLOOR_PX**2, 0, 0])
        self._brightness_std = float(np.sqrt(whole[0, 0]))
        power = float(np.sum((self.brightness * J[:, 0]) ** 2))
        left = float(r @ r) - pixels
        self.is_valid = (
            self.brightness >= _LEAST_SIGNAL * float(np.sqrt(inverse[0, 0]))
            and left <= _MOST_LEFT * power
            and float(np.abs(self.modes[2:]).max()) < _MOST_BEND
        )
        return True

    def result(self, offset: NDArray[np.intp]) -> FoundTrail:
        modes = self.modes.copy()
        modes[:2] += offset
        return FoundTrail(
            modes, self._covariance, self._bends, self.brightness, self._brightness_std, self.sky_dn, self._saturated
        )
