"""Exposure times."""

from dataclasses import dataclass, replace
from math import ceil, isfinite
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError

__all__ = ["Exposure", "Readout", "Trail"]

# How trails are drawn: integrated analytically, summed from sub-exposures, or whichever of the two is cheaper.
Trail = Literal["auto", "analytic", "sprites"]

# The direction in which a rolling shutter proceeds over the image: "down" opens the top row first.
Readout = Literal["down", "up", "left", "right"]

_OPPOSITE: Final[dict[Readout, Readout]] = {"down": "up", "up": "down", "left": "right", "right": "left"}


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure.

    Attributes
    ----------
    start_utc_s : float
        When the shutter opens, UTC seconds since 1970; with a rolling shutter, when the first row opens.
    duration_s : float
        Exposure time, s: of every row.
    rate_hz : float
        The minimum number of sub-exposures per second, for ``"sprites"``.
    trail : {"auto", "analytic", "sprites"}
        How trails are drawn.  ``"analytic"``: integrated in closed form over a few segments per exposure, without
        sampling ripple at any turn rate.  ``"sprites"``: summed from sub-exposures during which the stars do not move,
        as in the paper.  ``"auto"``: analytic, unless the attitude log is so noisy that sprites are cheaper; see
        `glstar.render.segmentation.segment_times`.
    readout_s : float
        Readout time of a rolling shutter, s: from the opening of the first row to that of the last; 0 for a global
        shutter.
    readout : {"down", "up", "left", "right"}
        Direction in which the rolling shutter proceeds: with ``"down"`` the top row is the first, with ``"right"`` the
        left column.
    path_tolerance_px : float
        Largest distance between a star's interpolated and drawn positions at the same time, px, for analytic trails;
        0 makes them pass through every sample of the attitude log.  Truth does not depend on it.
    faintest_dn : float
        Analytic trails whose brightest pixel is fainter than this are left out, the faintest first and up to 0.05 % of
        the flux of all stars together, DN.  Truth lists them.

    Raises
    ------
    ConfigError
        If the duration or the rate is not a positive number, the readout time, the tolerance or the faintest signal is
        negative, or the trail or the direction is none of these.

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

    @property
    def span_s(self) -> float:
        """Time from the opening of the first row to the closing of the last, s."""
        return self.duration_s + self.readout_s

    @property
    def mid_utc_s(self) -> float:
        """The middle of the exposure, of a rolling shutter that of the middle row, UTC seconds since 1970."""
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
        direction = self.readout if readout_s >= 0 else _OPPOSITE[self.readout]
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
