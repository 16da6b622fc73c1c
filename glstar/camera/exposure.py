"""Exposure times."""

from dataclasses import dataclass
from math import ceil, isfinite
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError

__all__ = ["Exposure", "Trail"]

# How trails are drawn: integrated analytically, summed from sub-exposures, or whichever of the two is cheaper.
Trail = Literal["auto", "analytic", "sprites"]


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure.

    Attributes
    ----------
    start_utc_s : float
        When the shutter opens, UTC seconds since 1970.
    duration_s : float
        Exposure time, s.
    rate_hz : float
        The minimum number of sub-exposures per second, for ``"sprites"``.
    trail : {"auto", "analytic", "sprites"}
        How trails are drawn.  ``"analytic"``: integrated in closed form over a few segments per exposure, without
        sampling ripple at any turn rate.  ``"sprites"``: summed from sub-exposures during which the stars do not move,
        as in the paper.  ``"auto"``: analytic, unless the attitude log is so noisy that sprites are cheaper; see
        `glstar.render.segmentation.segment_times`.

    Raises
    ------
    ConfigError
        If the duration or the rate is not a positive number, or the trail is none of these.

    Notes
    -----
    Teague & Chahl, section 2.6.
    """

    start_utc_s: float
    duration_s: float
    rate_hz: float = 200.0
    trail: Trail = "auto"

    def __post_init__(self) -> None:
        if not isfinite(self.start_utc_s):
            raise ConfigError(f"must be a time, not {self.start_utc_s}", key="exposure.start_utc_s")
        for key in ("duration_s", "rate_hz"):
            value = getattr(self, key)
            if not (isfinite(value) and value > 0):
                raise ConfigError(f"must be a positive number, not {value}", key=f"exposure.{key}")
        if self.trail not in get_args(Trail):
            raise ConfigError(f"must be 'auto', 'analytic' or 'sprites', not {self.trail!r}", key="exposure.trail")

    @property
    def mid_utc_s(self) -> float:
        """The middle of the exposure, UTC seconds since 1970."""
        return self.start_utc_s + self.duration_s / 2

    @property
    def stop_utc_s(self) -> float:
        """When the shutter closes, UTC seconds since 1970."""
        return self.start_utc_s + self.duration_s

    @property
    def min_sub_exposures(self) -> int:
        """The number of sub-exposures at ``rate_hz``: ceil(rate * duration)."""
        # 0.07 s times 200 Hz is 14.000000000000002 in float64, which must not become 15.
        return max(1, ceil(self.rate_hz * self.duration_s - 1e-9))

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
        return self.start_utc_s + (np.arange(n, dtype=np.float64) + 0.5) * (self.duration_s / n)
