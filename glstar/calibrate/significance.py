"""Significance of matches between catalogue stars and detections, and the number that chance explains.

A faint catalogue star always has some detection near it: a hot pixel, a noise peak, a fainter star.  A match is kept
if it is much more probable that the detection is the star than that another detection is as close by chance.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["chance_pairs", "match_probability", "significant"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Smallest probability of a real match that is kept.
_LEAST_PROBABILITY: Final = 0.9
# Largest expected number of false matches among all kept ones, or their largest fraction if that is more.
_MOST_FALSE: Final = 0.5
_MOST_FALSE_FRACTION: Final = 0.005
# The fraction of stars detected is estimated from this number of stars just brighter and just fainter, each.
_NEIGHBOURS: Final = 12
# No star is certain to be detected, and none certain not to be.
_COMPLETENESS: Final = (0.005, 0.98)
# Positions of one star in ten scatter three times as much: neighbours, saturation, a lens not quite of the model.
_TAIL_FRACTION: Final = 0.1
_TAIL_SCALE: Final = 3.0


def chance_pairs(stars: int, detections: int, radius_px: float, area_px2: float) -> float:
    """Return the expected number of chance pairs of a catalogue star and a detection within a radius.

    Parameters
    ----------
    stars, detections : int
        Their numbers within the area.
    radius_px : float
    area_px2 : float

    Returns
    -------
    float
        Expected number of pairs.
    """
    return stars * detections * np.pi * radius_px**2 / area_px2


def match_probability(separation_px: Float, scatter_px: Float, density_per_px2: float, radius_px: float) -> Float:
    """Return the probability that each catalogue star's nearest detection is the star itself.

    Parameters
    ----------
    separation_px : (n,) float64
        Distance from each predicted star, the brightest first, to its match; infinite for a star without one.
    scatter_px : (n,) float64
        Standard deviation of a match's position in x and in y, if it is real.
    density_per_px2 : float
        Detections per square pixel.
    radius_px : float
        Matching radius, px.

    Returns
    -------
    (n,) float64
        0 for stars without a match.

    Notes
    -----
    Bayes' theorem: a real match has a Gaussian separation (with a tail), and a prior, the fraction of stars of this
    brightness that are matched in excess of chance; a chance match has a uniform position.
    """
    matched = np.isfinite(separation_px)
    prior = _completeness(matched, float(-np.expm1(-density_per_px2 * np.pi * radius_px**2)))
    square = np.where(matched, separation_px / scatter_px, 0.0) ** 2
    core = (1 - _TAIL_FRACTION) * np.exp(-square / 2)
    tail = _TAIL_FRACTION * np.exp(-square / (2 * _TAIL_SCALE**2)) / _TAIL_SCALE**2
    real = prior * (core + tail) / (2 * np.pi * scatter_px**2)
    chance = (1 - prior) * density_per_px2
    return np.where(matched, real / (real + chance), 0.0)


def significant(probability: Float) -> Mask:
    """Return which matches are kept: the most probable ones, with a bound on the number of false ones among them.

    Parameters
    ----------
    probability : (n,) float64
        From `match_probability`.

    Returns
    -------
    (n,) bool
    """
    order = np.argsort(-probability, kind="stable")
    false_so_far = np.cumsum(1 - probability[order])
    most = np.maximum(_MOST_FALSE, _MOST_FALSE_FRACTION * np.arange(1, len(order) + 1))
    kept = np.zeros(len(order), dtype=np.bool_)
    kept[order[(false_so_far <= most) & (probability[order] >= _LEAST_PROBABILITY)]] = True
    return kept


def _completeness(matched: Mask, chance: float) -> Float:
    """Return the detected fraction of stars of similar brightness, without the star itself.

    The estimate is conservative: the expected chance matches and one standard deviation of their number are subtracted.
    """
    count = len(matched)
    total = np.concatenate([[0], np.cumsum(matched)])
    rank = np.arange(count)
    first, last = np.maximum(rank - _NEIGHBOURS, 0), np.minimum(rank + _NEIGHBOURS + 1, count)
    others = last - first - 1
    seen = total[last] - total[first] - matched
    by_chance = chance * others
    fraction = (seen + 0.5 - by_chance - np.sqrt(by_chance)) / ((others + 1) * (1 - min(chance, 0.9)))
    return np.asarray(np.clip(fraction, *_COMPLETENESS))
