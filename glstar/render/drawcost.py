"""Relative cost of the two trail models, with which ``trail = "auto"`` chooses one.

The cost is a fixed number, measured on software OpenGL, and not measured at run time: output must not depend on the
computer that draws it.
"""

from dataclasses import dataclass
from typing import Final

from glstar.render.trailmodels import SubExposureRule

__all__ = ["SUB_EXPOSURES_PER_SEGMENT", "SegmentLimit", "SpriteCost"]

# Cost of one analytic segment, in sub-exposures: 1.3 sprites of four sub-exposures each (Mesa llvmpipe, tests/bench).
SUB_EXPOSURES_PER_SEGMENT: Final = 4 * 1.3


@dataclass(frozen=True, slots=True)
class SpriteCost:
    """The cost of drawing an exposure as sub-exposures.

    Attributes
    ----------
    sub_exposures : SubExposureRule
        How many there are.
    sub_exposures_per_segment : float
        Cost of one analytic segment, in sub-exposures.
    """

    sub_exposures: SubExposureRule
    sub_exposures_per_segment: float

    def in_segments(self, trail_px: float) -> float:
        """Return the number of analytic segments that cost as much.

        Parameters
        ----------
        trail_px : float
            Length of the longest trail on the image, px.

        Returns
        -------
        float
        """
        return self.sub_exposures.count(trail_px) / self.sub_exposures_per_segment


@dataclass(frozen=True, slots=True)
class SegmentLimit:
    """A limit of the number of segments, whatever the trails.

    Attributes
    ----------
    count : int
    """

    count: int

    def in_segments(self, trail_px: float) -> float:  # noqa: ARG002 - as of `SpriteCost`
        """Return the limit; see `SpriteCost.in_segments`."""
        return self.count
