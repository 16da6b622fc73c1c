"""The camera's orientation during one exposure in a table, for many times that are different for every star."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.flight import AttitudeTrack
from glstar.render.cameramotion import CameraMotion
from glstar.render.pointing import Pointing
from glstar.rotation import turn_from_matrix

__all__ = ["MotionTable", "rates_rad_per_s"]

Float = NDArray[np.float64]

# Largest rotation in a part of an exposure, rad: there the third-order term, which a quadratic lacks, is 3e-7 rad.
_STEP_RAD: Final = 0.033
# Longest part between the samples of a spline, whose rate varies between them, s.
_SPLINE_STEP_S: Final = 5e-3
# Exposures of more samples of the log would spend more time on the table than it saves.
_MAX_PARTS: Final = 2000
# Half the time over which the angular rate of the camera is measured, s.
_RATE_STEP_S: Final = 5e-4


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
    rates_rad_per_s : (3,) float64 or None
        The angular rate of the camera in the middle of the exposure: see `rates_rad_per_s`.
    """

    ends_s: Float
    pointing: Pointing
    rates_rad_per_s: Float | None = None

    @classmethod
    def of(cls, motion: CameraMotion, exposure: Exposure) -> Self | None:
        """Return the table of an exposure; None of one that has too many parts."""
        attitude = motion.flight.attitude
        first, last = np.searchsorted(attitude.utc_s, [exposure.start_utc_s, exposure.stop_utc_s])
        step_s = _STEP_RAD / max(_fastest_rad_per_s(attitude, first, last), _STEP_RAD)
        if attitude.interpolation != "slerp":
            step_s = min(step_s, _SPLINE_STEP_S)
        steps = np.arange(1, np.ceil(exposure.span_s / step_s)) * step_s
        if last - first + len(steps) > _MAX_PARTS:
            return None
        inside_s = np.append(attitude.utc_s[first:last] - exposure.start_utc_s, steps)
        ends_s = np.unique(np.concatenate([[0.0], inside_s.clip(0.0, exposure.span_s), [exposure.span_s]]))
        if attitude.interpolation != "slerp":
            ends_s = np.sort(np.append(ends_s, (ends_s[1:] + ends_s[:-1]) / 2))
        times_s = np.empty(2 * len(ends_s) - 1)
        times_s[::2], times_s[1::2] = ends_s, (ends_s[1:] + ends_s[:-1]) / 2
        around_s = _around_middle_s(exposure)
        times_s = np.minimum(exposure.start_utc_s + times_s, exposure.stop_utc_s)
        pointing, around = motion.pointings(times_s, around_s)
        return cls(ends_s, pointing, _rates_rad_per_s(around, around_s))

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


def rates_rad_per_s(motion: CameraMotion, exposure: Exposure) -> Float:
    """Return the angular rate of the camera in the middle of an exposure, with respect to the stars.

    Parameters
    ----------
    motion : CameraMotion
    exposure : Exposure

    Returns
    -------
    (3,) float64
        About its right, down and forward axes, rad/s.
    """
    around_s = _around_middle_s(exposure)
    return _rates_rad_per_s(motion.pointings(around_s)[0], around_s)


def _around_middle_s(exposure: Exposure) -> Float:
    """Return two times around the middle of an exposure, UTC seconds since 1970."""
    step_s = min(_RATE_STEP_S, exposure.span_s / 2)
    return np.array([exposure.mid_utc_s - step_s, exposure.mid_utc_s + step_s])


def _rates_rad_per_s(around: Pointing, times_s: Float) -> Float:
    before, after = around.C_camera_eq
    return np.asarray(turn_from_matrix(after @ before.T) / (times_s[1] - times_s[0]))


def _fastest_rad_per_s(attitude: AttitudeTrack, first: int, last: int) -> float:
    """Return the largest turn rate between samples, from the one before the first to the last."""
    some = slice(max(first - 1, 0), last + 1)
    q = attitude.q_body_ned[some]
    half_rad = np.arccos(np.minimum(np.abs(np.einsum("ni,ni->n", q[1:], q[:-1])), 1.0))
    return float((2 * half_rad / np.diff(attitude.utc_s[some])).max(initial=0.0))
