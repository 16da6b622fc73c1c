"""Relative cost of the two trail models, with which ``trail = "auto"`` chooses one.

The cost is a fixed number, measured on software OpenGL, and not measured at run time: output must not depend on the
computer that draws it.
"""

from dataclasses import dataclass
from typing import Final

from glstar.render.trailmodels import SubExposureRule

__all__ = ["SUB_EXPOSURES_PER_SEGMENT", "SUB_EXPOSURES_PER_SPACING", "SpriteCost"]

# Cost of analytic trails, in sub-exposures: of each segment, and of a length of trail equal to the maximum distance
# between sub-exposures.  Fitted to the processor time of some hundred exposures of three real flights of
# tests/bench/realflights.py (0.5 s, 1014x760, Mesa llvmpipe): half of them within 10 %, nine tenths within 21 %.
SUB_EXPOSURES_PER_SEGMENT: Final = 4.2
SUB_EXPOSURES_PER_SPACING: Final = 0.6


@dataclass(frozen=True, slots=True)
class SpriteCost:
    """The cost of drawing an exposure as sub-exposures.

    Attributes
    ----------
    sub_exposures : SubExposureRule
        How many there are.
    sub_exposures_per_segment : float
        Cost of one analytic segment, in sub-exposures, without its length.
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
        rule = self.sub_exposures
        for_length = SUB_EXPOSURES_PER_SPACING * trail_px / rule.spacing_px
        return (rule.count(trail_px) - for_length) / self.sub_exposures_per_segment

    @property
    def fewest_segments(self) -> float:
        """The number of analytic segments that cost as much, for the least favourable length of trails."""
        rule = self.sub_exposures
        return self.in_segments(rule.min_count * rule.spacing_px)
