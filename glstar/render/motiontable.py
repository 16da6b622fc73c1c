"""The camera's orientation during one exposure in a table, for many times that are different for every star."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.render.cameramotion import CameraMotion
from glstar.render.pointing import Pointing

__all__ = ["MotionTable"]

Float = NDArray[np.float64]

# Longest part of an exposure in which the orientation is a quadratic function of time, s: of a rotation by 381 deg/s
# the third-order term is 3e-7 rad.
_STEP_S: Final = 5e-3
# Exposures of more samples of the log would spend more time on the table than it saves.
_MAX_PARTS: Final = 2000


@dataclass(frozen=True, eq=False)
class MotionTable:
    """The camera's orientation in n parts of an exposure: between samples of the log, or of halves along a spline.

    Attributes
    ----------
    ends_s : (n + 1,) float64
        Where parts begin and end, s after the start of the exposure.
    pointing : Pointing
        At the start, the middle and the end of the first part, which is the start of the second, and so on: 2 n + 1
        times.
    """

    ends_s: Float
    pointing: Pointing

    @classmethod
    def of(cls, motion: CameraMotion, exposure: Exposure) -> Self | None:
        """Return the table of an exposure; None of one that has too many parts."""
        samples_s = motion.flight.attitude.utc_s
        first, last = np.searchsorted(samples_s, [exposure.start_utc_s, exposure.stop_utc_s])
        steps = np.arange(1, np.ceil(exposure.span_s / _STEP_S)) * _STEP_S
        if last - first + len(steps) > _MAX_PARTS:
            return None
        inside_s = np.append(samples_s[first:last] - exposure.start_utc_s, steps)
        ends_s = np.unique(np.concatenate([[0.0], inside_s.clip(0.0, exposure.span_s), [exposure.span_s]]))
        if motion.flight.attitude.interpolation != "slerp":
            ends_s = np.sort(np.append(ends_s, (ends_s[1:] + ends_s[:-1]) / 2))
        times_s = np.empty(2 * len(ends_s) - 1)
        times_s[::2], times_s[1::2] = ends_s, (ends_s[1:] + ends_s[:-1]) / 2
        (pointing,) = motion.pointings(np.minimum(exposure.start_utc_s + times_s, exposure.stop_utc_s))
        return cls(ends_s, pointing)

    @cached_property
    def _coefficients(self) -> Float:
        """Coefficients of 1, u and u^2 in each part, (3, n, w): all numbers of an orientation side by side."""
        own, times = self.pointing, len(self.pointing)
        vectors = (own.zenith_eq, own.velocity_eq, *([] if own.pole_eq is None else [own.pole_eq]))
        values = np.concatenate([own.C_camera_eq.reshape(times, 9), *vectors], axis=1)
        start, middle, end = values[:-2:2], values[1::2], values[2::2]
        return np.stack([start, 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)])

    def at(self, since_s: Float) -> Pointing:
        """Return the orientation at some times after the start of the exposure, (k,) s: k times."""
        part = (np.searchsorted(self.ends_s, since_s, side="right") - 1).clip(0, len(self.ends_s) - 2)
        u = ((since_s - self.ends_s[part]) / (self.ends_s[part + 1] - self.ends_s[part]))[:, np.newaxis]
        constant, linear, quadratic = self._coefficients
        values = quadratic.take(part, axis=0)
        values *= u
        values += linear.take(part, axis=0)
        values *= u
        values += constant.take(part, axis=0)
        return replace(
            self.pointing,
            C_camera_eq=values[:, :9].reshape(-1, 3, 3),
            zenith_eq=values[:, 9:12],
            velocity_eq=values[:, 12:15],
            pole_eq=None if self.pointing.pole_eq is None else values[:, 15:],
        )
