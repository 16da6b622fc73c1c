"""Which of the two trail models ``trail = "auto"`` takes: the cost of segments against that of sub-exposures."""

import numpy as np
import pytest

from glstar.render.drawcost import SpriteCost
from glstar.render.trailmodels import SubExposureRule

# Of the 100 sub-exposures of half a second, and stars of 1.2 px.
COST = SpriteCost(SubExposureRule(100, 1.8), 4.2)


@pytest.mark.parametrize(
    ("trail_px", "segments"),
    [
        pytest.param(0.0, 100 / 4.2, id="stars that do not move"),
        pytest.param(90.0, (100 - 30) / 4.2, id="sub-exposures closer than they must be"),
        pytest.param(180.0, (100 - 60) / 4.2, id="just close enough"),
        pytest.param(720.0, (400 - 240) / 4.2, id="more sub-exposures for a long trail"),
    ],
)
def test_a_segment_costs_4_sub_exposures_and_its_length_six_tenths_of_those_along_it(trail_px, segments):
    assert COST.in_segments(trail_px) == pytest.approx(segments, rel=1e-12)


def test_no_trail_has_its_break_even_below_the_fewest_segments():
    least = min(COST.in_segments(trail_px) for trail_px in np.linspace(0.0, 2000.0, 100_001))

    assert COST.fewest_segments == pytest.approx(least, abs=0.01)
