"""Exposures: when the shutter opens and closes, row by row, for one exposure or a stack of short ones."""

from dataclasses import dataclass, replace
from math import ceil, isfinite, sqrt
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError

# How trails are drawn: integrated analytically, summed from sub-exposures, or whichever of the two is cheaper.
Trail = Literal["auto", "analytic", "sprites"]

# The direction in which a rolling shutter proceeds over the image: "down" opens the top row first.
Readout = Literal["down", "up", "left", "right"]

OPPOSITE: dict[Readout, Readout] = {"down": "up", "up": "down", "left": "right", "right": "left"}

# How short exposures become one image.
Stack = Literal["sum", "mean"]

# What exposure control holds at its target: the mean of the image, or a percentile of its pixels.
Metering = Literal["mean", "percentile"]

Seconds = float | NDArray[np.float64]

# Largest number of short exposures in one image: all their scenes are held in memory together.
MAX_FRAMES = 1000
# Largest digital number of an image file: 16 bits.
MAX_DN = 65535


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure, or several short ones that are stacked into one image.

    Attributes
    ----------
    start_utc_s : float
        When the shutter opens, UTC seconds since 1970; with a rolling shutter, when the first row opens.
    duration_s : float
        Exposure time, s: of every row, and of each short exposure.
    rate_hz : float
        The minimum number of sub-exposures per second, for ``"sprites"``.
    trail : {"auto", "analytic", "sprites"}
        How trails are drawn.  ``"analytic"``, or ``"auto"``: integrated in closed form over a few segments per
        exposure, without sampling ripple at any turn rate.  ``"sprites"``: summed from sub-exposures during which the
        stars do not move, as in the paper.
    readout_s : float
        Readout time of a rolling shutter, s: from the opening of the first row to the opening of the last; 0 for a
        global shutter.
    readout : {"down", "up", "left", "right"}
        Direction in which the rolling shutter proceeds: with ``"down"`` the top row is the first, with ``"right"`` the
        left column.
    path_tolerance_px : float
        Largest distance between a star's interpolated and drawn positions at the same time, px, for analytic trails;
        0 makes them pass through every sample of the attitude log.  Truth does not depend on it.
    faintest_dn : float
        Analytic trails whose brightest pixel is fainter than this are left out, the faintest first and up to 0.05 % of
        the flux of all stars together, DN.  Truth lists them.
    frames : int
        Number of short exposures that are stacked into the image, each with its own noise; 1 to `MAX_FRAMES`.
    gap_s : float
        Time from the end of one short exposure to the start of the next, of each row of a rolling shutter, s.
    stack : {"sum", "mean"}
        Whether the digital numbers of the short exposures are added or averaged.

    Raises
    ------
    ConfigError
        If a number is out of its range, the trail, the direction or the stack is none of these, or a rolling shutter
        begins to read a short exposure before it has read the previous one.

    Notes
    -----
    Teague & Chahl, section 2.6; rolling shutter: Li, Wei, Li & Wang, Opt. Express 29 (2021) 15478.
    """

    start_utc_s: float
    duration_s: float
    rate_hz: float = 200.0
    trail: Trail = "auto"
    readout_s: float = 0.0
    readout: Readout = "down"
    path_tolerance_px: float = 0.01
    faintest_dn: float = 0.02
    frames: int = 1
    gap_s: float = 0.0
    stack: Stack = "sum"

    def __post_init__(self) -> None:
        if not isfinite(self.start_utc_s):
            raise ConfigError(f"must be a time, not {self.start_utc_s}", key="exposure.start_utc_s")
        for key in ("duration_s", "rate_hz"):
            value = getattr(self, key)
            if not (isfinite(value) and value > 0):
                raise ConfigError(f"must be a positive number, not {value}", key=f"exposure.{key}")
        for key in ("path_tolerance_px", "faintest_dn"):
            value = getattr(self, key)
            if not (isfinite(value) and value >= 0):
                raise ConfigError(f"must be a number, 0 or more, not {value}", key=f"exposure.{key}")
        if self.trail not in get_args(Trail):
            raise ConfigError(f"must be 'auto', 'analytic' or 'sprites', not {self.trail!r}", key="exposure.trail")
        if not (isfinite(self.readout_s) and self.readout_s >= 0):
            raise ConfigError(f"must be a number from 0, not {self.readout_s}", key="exposure.readout_s")
        if self.readout not in get_args(Readout):
            raise ConfigError(f"must be 'down', 'up', 'left' or 'right', not {self.readout!r}", key="exposure.readout")
        self._check_stack()

    def _check_stack(self) -> None:
        if self.frames not in range(1, MAX_FRAMES + 1):
            raise ConfigError(
                f"must be a whole number from 1 to {MAX_FRAMES}, not {self.frames}", key="exposure.frames"
            )
        if not (isfinite(self.gap_s) and self.gap_s >= 0):
            raise ConfigError(f"must be a number of seconds, 0 or more, not {self.gap_s}", key="exposure.gap_s")
        if self.stack not in get_args(Stack):
            raise ConfigError(f"must be 'sum' or 'mean', not {self.stack!r}", key="exposure.stack")
        check_readouts(self.duration_s, self.readout_s, self.frames, self.gap_s)

    def shortened(self, duration_s: float) -> Self:
        """Return the exposure with a shorter exposure time, s, and the same start.

        The short exposures of a stack follow each other as before: their gaps take up the rest.
        """
        return replace(self, duration_s=duration_s, gap_s=self.gap_s + max(self.duration_s - duration_s, 0.0))

    @property
    def span_s(self) -> float:
        """Time from the first opening to the last closing: of all rows and all short exposures, s."""
        return float(exposure_span_s(self.duration_s, self.readout_s, self.frames, self.gap_s))

    @property
    def signal_factor(self) -> int:
        """Ratio of the signals of the image and of one short exposure: `frames` of a sum, 1 of a mean."""
        return self.frames if self.stack == "sum" else 1

    @property
    def first(self) -> Self:
        """The first short exposure."""
        return replace(self, frames=1)

    def short_times_s(self) -> NDArray[np.float64]:
        """Return when the shutter opens and closes for each short exposure, (frames, 2), UTC seconds since 1970.

        Without a gap, each opens at exactly the time at which the one before it closes.  The first row of a rolling
        shutter opens and the last one closes at these times: the next short exposure begins in the first rows while the
        last rows are still open.
        """
        opens_s = self.start_utc_s + np.arange(self.frames) * (self.duration_s + self.gap_s)
        closes_s = opens_s + self.first.span_s
        if self.gap_s == 0 and self.readout_s == 0:
            closes_s[:-1] = opens_s[1:]
        closes_s[-1] = self.stop_utc_s
        return np.stack([opens_s, closes_s], axis=1)

    def short_exposures(self) -> tuple[Self, ...]:
        """Return the short exposures, each as an exposure of its own."""
        last_s = self.stop_utc_s - self.first.span_s  # so that the last one ends with the stack, to a rounding error
        starts_s = np.minimum(self.short_times_s()[:, 0], max(last_s, self.start_utc_s)).tolist()
        return tuple(replace(self.first, start_utc_s=start_s) for start_s in starts_s)

    def full_scale_dn(self, saturation_dn: int) -> int:
        """Return the largest digital number of the image.

        Parameters
        ----------
        saturation_dn : int
            The largest digital number of one short exposure.

        Returns
        -------
        int

        Raises
        ------
        ConfigError
            If the sum does not fit into 16 bits.
        """
        largest_dn = saturation_dn * self.signal_factor
        if largest_dn > MAX_DN:
            most_frames = MAX_DN // saturation_dn
            raise ConfigError(
                f"is {self.frames}, and the sum of {self.frames} exposures of up to {saturation_dn} DN reaches"
                f" {largest_dn} DN, more than 16 bits hold ({MAX_DN} DN); take at most {most_frames}, a smaller"
                ' sensor.bit_depth, or exposure.stack = "mean"',
                key="exposure.frames",
            )
        return largest_dn

    @property
    def mid_utc_s(self) -> float:
        """The middle of the exposure, of the middle row with a rolling shutter, UTC seconds since 1970."""
        return self.start_utc_s + self.span_s / 2

    @property
    def stop_utc_s(self) -> float:
        """When the shutter closes, a rolling one at its last row, UTC seconds since 1970."""
        return self.start_utc_s + self.span_s

    @property
    def min_sub_exposures(self) -> int:
        """The number of sub-exposures at ``rate_hz``: ceil(rate * time from the first opening to the last closing)."""
        # 0.07 s times 200 Hz is 14.000000000000002 in float64, which must not become 15.
        return max(1, ceil(self.rate_hz * self.span_s - 1e-9))

    def opening_s(self, width_px: int, height_px: int) -> tuple[float, float, float]:
        """Return how long after ``start_utc_s`` the pixels of an image open, as a linear function of their position.

        Parameters
        ----------
        width_px, height_px : int
            Size of the image.

        Returns
        -------
        per_column_s, per_row_s, first_s : float
            Pixel (x, y) opens at ``per_column_s * x + per_row_s * y + first_s``, s, and closes ``duration_s`` later.

        Notes
        -----
        tau = readout_s / (rows - 1) per row; an image of one row opens at once.
        """
        count = height_px if self.readout in {"down", "up"} else width_px
        step_s = self.readout_s / (count - 1) if count > 1 else 0.0
        per_s, first_s = (step_s, 0.0) if self.readout in {"down", "right"} else (-step_s, step_s * (count - 1))
        return (0.0, per_s, first_s) if self.readout in {"down", "up"} else (per_s, 0.0, first_s)

    def opening_at_s(self, xy_px: NDArray[np.float64], width_px: int, height_px: int) -> NDArray[np.float64]:
        """Return how long after ``start_utc_s`` the row at some positions opens; beside the image as on it.

        Parameters
        ----------
        xy_px : (..., 2) float64
            Positions, px.
        width_px, height_px : int
            Size of the image.

        Returns
        -------
        (...) float64
            See `opening_s`.
        """
        per_column_s, per_row_s, first_s = self.opening_s(width_px, height_px)
        return np.asarray(per_column_s * xy_px[..., 0] + per_row_s * xy_px[..., 1] + first_s)

    def with_readout_s(self, readout_s: float) -> "Exposure":
        """Return the exposure with another readout time and the same start.

        Parameters
        ----------
        readout_s : float
            Readout time, s; if it is negative, the rows open in the opposite direction.

        Returns
        -------
        Exposure
        """
        direction = self.readout if readout_s >= 0 else OPPOSITE[self.readout]
        return replace(self, readout_s=abs(readout_s), readout=direction)

    def sub_utc_s(self, n: int) -> NDArray[np.float64]:
        """Return the times of `n` sub-exposures: the midpoints of n equal parts.

        Parameters
        ----------
        n : int
            Number of sub-exposures, at least 1.

        Returns
        -------
        (n,) float64
            UTC seconds since 1970.

        Notes
        -----
        Departs from the paper's "200 dt attitudes at 5 ms from the beginning to the end".  At the starts of the parts,
        the centroid of a trail of length L would be wrong by L / 2n; with both ends included, the trail would be 1 %
        too long.
        """
        return self.start_utc_s + (np.arange(n, dtype=np.float64) + 0.5) * (self.span_s / n)


# One frame cannot ask for more than this factor: it may be black.
_LARGEST_STEP = 10.0
# A smaller relative change is not made; within the larger one the filter takes the square root of its speed.
_STABLE, _NEAR = 0.02, 0.2


@dataclass(frozen=True, slots=True)
class ExposureControl:
    """Automatic exposure: time and gain follow the level of earlier frames, as in the drivers of real cameras.

    The product of both goes to what would have brought a frame to the target, by a first-order filter; it is made of
    the exposure time first, up to its limit, then of the gain.  The filter, the largest step of a frame and the region
    without change are those of libcamera for the Raspberry Pi (``src/ipa/rpi/controller/rpi/agc_channel.cpp``), whose
    IMX477 has a target of 0.16, a speed of 0.2 and a delay of two frames.
    """

    metering: Metering
    target: float  # Wanted level, 0 to 1 between the black level and the full scale
    percentile: float  # Of the pixels, %, for ``"percentile"``
    limits_s: tuple[float, float]  # Shortest and longest exposure time, s
    gain_limits: tuple[float, float]  # Smallest and largest analogue gain
    delay_frames: int  # Frames after which a measured level is first used, 1 or more
    speed: float  # Fraction of the distance to the target that a frame makes up, above 0, at most 1

    def level(self, pixels_dn: NDArray[Any], black_dn: float, full_scale_dn: float) -> float:
        """Return the level of an image: 0 at its black level, 1 at its full scale, DN; noise may make it negative."""
        if self.metering == "mean":
            value_dn = float(pixels_dn.mean(dtype=np.float64))
        else:
            value_dn = float(np.percentile(pixels_dn, self.percentile, method="inverted_cdf"))
        return (value_dn - black_dn) / (full_scale_dn - black_dn)

    def product_after(self, product_s: float, measured_s: float, level: float) -> float:
        """Return the next product of exposure time and gain, s.

        `product_s`: the present one; `measured_s`: that of the measured frame, whose level is `level`.
        """
        factor = min(self.target / max(level, self.target / _LARGEST_STEP), _LARGEST_STEP)
        (shortest_s, longest_s), (least, most) = self.limits_s, self.gain_limits
        wanted_s = min(max(measured_s * factor, shortest_s * least), longest_s * most)
        if abs(wanted_s - product_s) < _STABLE * product_s:
            return product_s
        is_near = abs(product_s - wanted_s) < _NEAR * wanted_s
        return product_s + (sqrt(self.speed) if is_near else self.speed) * (wanted_s - product_s)

    def divided(self, product_s: float) -> tuple[float, float]:
        """Return the exposure time, whole microseconds in s, and the gain of a product of both, inside the limits."""
        (shortest_s, longest_s), (least, most) = self.limits_s, self.gain_limits
        duration_s = min(max(round(product_s / least, 6), shortest_s), longest_s)
        gain = least if duration_s < longest_s else min(max(round(product_s / longest_s, 4), least), most)
        return duration_s, gain


@dataclass(frozen=True, slots=True)
class ControlledExposure:
    """Exposure control between two frames."""

    control: ExposureControl
    product_s: float  # Exposure time times gain that the control has come to, s
    # Exposure time, s, and gain of the next frame, and of those after it that are decided already.
    queue: tuple[tuple[float, float], ...]

    @classmethod
    def begun(cls, control: ExposureControl, gain: float) -> Self:
        """Return the control before the first frame, which has the longest exposure time and the gain of the sensor."""
        duration_s, first_gain = control.limits_s[1], min(max(gain, control.gain_limits[0]), control.gain_limits[1])
        return cls(control, duration_s * first_gain, ((duration_s, first_gain),) * control.delay_frames)

    @property
    def settings(self) -> tuple[float, float]:
        """Exposure time, s, and gain of the next frame."""
        return self.queue[0]

    def after(self, level: float, measured_s: float | None = None) -> Self:
        """Return the control after the next frame has been taken and its level measured.

        `measured_s`: exposure time times gain of the frame that was measured, s; by default those of `settings`.
        """
        duration_s, gain = self.settings
        measured_s = duration_s * gain if measured_s is None else measured_s
        product_s = self.control.product_after(self.product_s, measured_s, level)
        return replace(self, product_s=product_s, queue=(*self.queue[1:], self.control.divided(product_s)))

    def unmeasured(self) -> Self:
        """Return the control after the next frame, which is not measured."""
        return replace(self, queue=(*self.queue[1:], self.queue[-1]))


def check_readouts(duration_s: float, readout_s: float, frames: float, gap_s: float) -> None:
    """Raise if a rolling shutter would begin to read a short exposure before it has read the one before it.

    Raises ConfigError if the readout time is longer than the time between two short exposures.
    """
    # A tolerance for sums such as 0.1 + 0.2.
    if frames > 1 and readout_s > (duration_s + gap_s) * (1 + 1e-9):
        raise ConfigError(
            f"is {gap_s:g}, so that short exposures follow every {duration_s + gap_s:g} s, but the rolling shutter"
            f" takes {readout_s:g} s to read one; take at least {ceil(1e6 * (readout_s - duration_s)) / 1e6:g}",
            key="exposure.gap_s",
        )


def exposure_span_s(
    duration_s: Seconds, readout_s: Seconds, frames: float | NDArray[np.float64], gap_s: Seconds
) -> Seconds:
    """Return the time from the first opening to the last closing of exposures, s.

    Every row is exposed `frames` times with gaps between; the last row is later than the first by the readout time.
    """
    return frames * duration_s + (frames - 1) * gap_s + readout_s
