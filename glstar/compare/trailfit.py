"""The fit of one simulated trail to a real image: shift, stretch, turn and brightness."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from glstar.arrays import Float
from glstar.compare.detection import SubtractedImage
from glstar.compare.prediction import Stamp, deformation, offsets_and_directions, stamp_of

# Pixels around the trail that give the background level, and the largest shift before the cutout is moved, px.
_MARGIN_PX = 3
_MAX_ITERATIONS = 30
# Converged when an iteration lowers chi squared by less than this: a hundredth of a standard deviation.
_CONVERGED = 1e-4
# Number of cutouts that a fit may move through.
_CUTS = 4
# Pixels below this fraction of the template's peak count as background.
_DARK_FRACTION = 0.02
# Smallest number of pixels in a fit: twice its parameters.
_MIN_PIXELS = 12
# Prior standard deviation of stretch (a fraction) and turn (rad): it keeps the fit of faint trails bounded.
_PRIOR_STD = 0.3
_PRIOR = np.array([0.0, 0.0, 0.0, 0.0, _PRIOR_STD**-2, _PRIOR_STD**-2])
_MAX_DEFORMATION = 0.6
# A trail counts as found if its brightness is at least this many standard deviations above zero, ...
_MIN_SIGNAL = 5.0
# ... and the residuals beyond the noise have less than this fraction of its power.
_MAX_RESIDUAL = 0.6
# Error of the interpolation, px: the smallest standard deviation of a position.
_FLOOR_PX = 0.005

# The derivative at a pixel from its four neighbours, accurate to the fourth order.
_SLOPE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]]) / 12


@dataclass(frozen=True, slots=True, eq=False)
class FoundTrail:
    """How a trail of the real image differs from the simulated one."""

    # (4,) real minus simulated: shift along x and y, px; stretch, a fraction of the length; turn, rad, clockwise.
    modes: Float
    covariance: Float  # (4, 4) covariance of the modes; zero for modes that were not fitted
    bent: bool  # whether stretch and turn were fitted
    brightness: float  # ratio of the real signal to the simulated one, per pixel
    brightness_std: float
    sky_dn: float  # residual background level under the trail
    saturated: bool  # whether it has saturated pixels


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
    """Find one trail in a real image.

    `signal_dn` (height, width): the simulated noiseless signal; `path_px` (n, 2): the star path on the simulated image;
    `half_width_px`: half the width of the aperture along the path; `expected_px` (2,): expected shift; `window_px`:
    half the size of the search window around it; `bends`: whether stretch and turn are fitted.  Returns None if no
    matching signal is in the window.

    Levenberg-Marquardt fit of brightness, sky, shift, stretch and turn, by least squares over unsaturated pixels.
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
    deviation_px = float(np.linalg.norm(found.modes[:2] - expected_px))
    limit_px = window_px + 2.0
    return found if fit.is_valid and deviation_px <= limit_px else None


def _brightest_offset(
    sky: SubtractedImage, template: NDArray[np.float32], stamp: Stamp, expected_px: Float, window_px: float
) -> NDArray[np.intp] | None:
    """Return the whole-pixel shift of the largest correlation with a template, near the expected one."""
    margin_px = int(np.ceil(window_px))
    middle = np.rint(expected_px).astype(int)
    left, top = stamp.left + middle[0] - margin_px, stamp.top + middle[1] - margin_px
    height, width = template.shape
    right, bottom = left + width + 2 * margin_px, top + height + 2 * margin_px
    # The window is smaller at the edges of the image.
    low = np.array([max(0, left), max(0, top)])
    high = np.array([min(sky.above_dn.shape[1], right), min(sky.above_dn.shape[0], bottom)])
    if (high - low < (width, height)).any():
        return None
    window = sky.above_dn[low[1] : high[1], low[0] : high[0]]
    correlation = cv2.matchTemplate(window, np.where(stamp.mask, template, 0).astype(np.float32), cv2.TM_CCORR)
    row, column = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    return np.array([low[0] + column - stamp.left, low[1] + row - stamp.top])


class _Fit:
    """The fit of one template to successive cutouts of a real image."""

    def __init__(self, signal_dn: NDArray[np.float32], stamp: Stamp, path_px: Float, *, bends: bool) -> None:
        self.template = stamp.of(signal_dn).astype(np.float64)
        self._spline = spline_filter(self.template, order=3)
        self._centre = path_px.mean(axis=0) - (stamp.left, stamp.top)
        self._along = offsets_and_directions(path_px[:, np.newaxis])[1][0]
        self._bends = bends
        rows, columns = np.indices(self.template.shape, dtype=np.float64)
        self._columns = columns - self._centre[0]
        self._rows = rows - self._centre[1]
        # Around the trail only dark pixels count: other stars there may have another brightness error.
        grown = cv2.dilate(stamp.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        dark = self.template < _DARK_FRACTION * float(self.template[stamp.mask].max())
        self._counts = stamp.mask | (grown & dark)
        self.modes = np.zeros(4)
        self.brightness = 1.0
        self.sky_dn = 0.0
        self.is_valid = False

    def to(self, sky: SubtractedImage, cut: Stamp) -> bool:
        """Fit one cutout; return False if it cannot be fitted."""
        usable = cut.of(sky.usable)
        self._saturated = bool((~usable & cut.mask).any())
        weight = (usable & self._counts) / cut.of(sky.noise_dn)
        self._inside = np.flatnonzero(weight)
        if len(self._inside) < _MIN_PIXELS:
            return False
        real = cut.of(sky.above_dn).astype(np.float64)
        free = np.array([True, True, True, True, self._bends, self._bends])
        damping = 1e-4
        jacobian, residual = self._linear(real, weight)
        cost = self._cost(residual)
        for _ in range(_MAX_ITERATIONS):
            normal = (jacobian.T @ jacobian + np.diag(_PRIOR))[np.ix_(free, free)]
            gradient = (jacobian.T @ residual - _PRIOR * np.concatenate([np.zeros(4), self.modes[2:]]))[free]
            step = np.zeros(6)
            step[free] = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-12), gradient)
            # The expected decrease of chi squared: the squared distance to the minimum in standard deviations.
            if float(step[free] @ gradient) < _CONVERGED:
                break
            step[2:4] = step[2:4].clip(-1.5, 1.5)
            before = self.brightness, self.sky_dn, self.modes
            self.brightness += float(step[0])
            self.sky_dn += float(step[1])
            self.modes = self.modes + step[2:]
            self.modes[2:] = self.modes[2:].clip(-_MAX_DEFORMATION, _MAX_DEFORMATION)
            new_jacobian, new_residual = self._linear(real, weight)
            new_cost = self._cost(new_residual)
            if new_cost <= cost:
                jacobian, residual, cost = new_jacobian, new_residual, new_cost
                damping /= 5
            else:
                self.brightness, self.sky_dn, self.modes = before
                damping = max(damping, 1e-3) * 10
            if np.abs(self.modes[:2]).max() > _MARGIN_PX or damping > 1e3:
                break
        return self._conclude(jacobian, residual, free)

    def _cost(self, residual: Float) -> float:
        return float(residual @ residual) + float(np.sum(self.modes[2:] ** 2)) / _PRIOR_STD**2

    def _linear(self, real: Float, weight: Float) -> tuple[Float, Float]:
        """Return the weighted Jacobian (p, 6) and residuals (p,) of the model."""
        x, y = self._columns - self.modes[0], self._rows - self.modes[1]
        back = np.linalg.inv(deformation(self._along, self.modes))
        source_x = back[0, 0] * x + back[0, 1] * y + self._centre[0]
        source_y = back[1, 0] * x + back[1, 1] * y + self._centre[1]
        model = map_coordinates(self._spline, (source_y, source_x), order=3, prefilter=False, mode="nearest")
        across = cv2.filter2D(model, -1, _SLOPE, borderType=cv2.BORDER_REPLICATE)
        down = cv2.filter2D(model, -1, _SLOPE.T, borderType=cv2.BORDER_REPLICATE)
        model, across, down, x, y, weight, real = (
            image.ravel()[self._inside] for image in (model, across, down, x, y, weight, real)
        )
        # The trail is stretched by 1 + s along its own direction, which has turned with it.
        u = deformation(self._along, np.array([0.0, 0.0, 0.0, self.modes[3]])) @ self._along
        longer, brightness = 1 + self.modes[2], self.brightness
        jacobian = np.empty((len(model), 6))
        jacobian[:, 0] = model
        jacobian[:, 1] = 1.0
        jacobian[:, 2] = -brightness * across
        jacobian[:, 3] = -brightness * down
        jacobian[:, 4] = -brightness / longer * (x * u[0] + y * u[1]) * (across * u[0] + down * u[1])
        jacobian[:, 5] = -brightness * (down * x - across * y)
        jacobian *= weight[:, np.newaxis]
        return jacobian, (real - brightness * model - self.sky_dn) * weight

    def _conclude(self, jacobian: Float, residual: Float, free: NDArray[np.bool_]) -> bool:
        """Set the covariance of the modes and whether the fit is valid; return False if it has no covariance."""
        normal = (jacobian.T @ jacobian + np.diag(_PRIOR))[np.ix_(free, free)]
        try:
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return False
        # Residuals above the noise widen the covariance: the trail then differs from the simulated shape.
        chi_squared = float(residual @ residual)
        reduced = max(1.0, chi_squared / max(1, len(residual) - int(free.sum())))
        covariance = np.zeros((6, 6))
        covariance[np.ix_(free, free)] = inverse * reduced
        self._covariance = covariance[2:, 2:] + np.diag([_FLOOR_PX**2, _FLOOR_PX**2, 0, 0])
        self._brightness_std = float(np.sqrt(covariance[0, 0]))
        power = float(np.sum((self.brightness * jacobian[:, 0]) ** 2))
        excess = chi_squared - len(residual)
        self.is_valid = (
            self.brightness >= _MIN_SIGNAL * float(np.sqrt(inverse[0, 0]))
            and excess <= _MAX_RESIDUAL * power
            and float(np.abs(self.modes[2:]).max()) < _MAX_DEFORMATION
        )
        return True

    def result(self, offset: NDArray[np.intp]) -> FoundTrail:
        """Return the fitted trail, if the last cutout was shifted by `offset`, (2,) px."""
        modes = self.modes.copy()
        modes[:2] += offset
        return FoundTrail(
            modes, self._covariance, self._bends, self.brightness, self._brightness_std, self.sky_dn, self._saturated
        )
