"""Statistics of all pairs: the paper's measures, in total and per star."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.compare.pairs import Pair
from glstar.sky.magnitudes import magnitude_difference

__all__ = ["ShiftGrid", "by_star", "percentage_errors", "shift_grid", "summarize"]

Float = NDArray[np.float64]

# Number of cells along the longer side of the field, for 20 pairs per cell on average.
_MIN_CELLS, _MAX_CELLS = 3, 8
_PAIRS_A_CELL: Final = 20
# Smallest extent of the field, px, for one or two pairs.
_MIN_FIELD_PX: Final = 40.0
# Weights grow up to this signal-to-noise ratio: beyond it, model errors exceed the noise.
_MAX_SIGNAL: Final = 100.0


def column(pairs: Sequence[Pair], name: str) -> Float:
    """Return one measure of all pairs, (n,) float64."""
    return np.array([getattr(pair, name) for pair in pairs], dtype=np.float64)


def percentage_errors(real_dn: Float, simulated_dn: Float) -> Float:
    """Return simulated minus real intensities, in percent of the real ones.

    Parameters
    ----------
    real_dn, simulated_dn : (n,) float64

    Returns
    -------
    (n,) float64
    """
    return np.asarray(100 * (simulated_dn - real_dn) / real_dn)


def intensity(real_dn: Float, simulated_dn: Float) -> dict[str, Any]:
    """Return the paper's figures of peak intensities, and the scatter in magnitudes."""
    if not len(real_dn):
        return {"pairs": 0}
    percent = float(np.abs(percentage_errors(real_dn, simulated_dn)).mean())
    off_mag = magnitude_difference(simulated_dn / real_dn)
    return {
        "pairs": len(real_dn),
        "mean_error_dn": float((simulated_dn - real_dn).mean()),
        "mean_absolute_percentage_error": percent,
        # The error in magnitudes by eq. (36), as in the paper: 47.4 % are 0.42 mag.
        "magnitude_error": float(-magnitude_difference(np.array([1 + percent / 100]))[0]),
        "magnitude_difference_mean": float(off_mag.mean()),
        "magnitude_difference_std": float(off_mag.std(ddof=1)) if len(off_mag) > 1 else None,
    }


@dataclass(frozen=True, slots=True, eq=False)
class ShiftGrid:
    """Shifts of pairs, averaged over the cells of a grid.

    Attributes
    ----------
    middle_px : (n, 2) float64
        Weighted mean position of each cell's pairs, (x, y).
    shift_px : (n, 2) float64
        Weighted mean shift, simulated minus real.
    std_px : (n,) float64
        Standard error of the mean, RMS of both axes, by the scatter of the pairs; NaN for a single pair.
    pairs : (n,) int
        Number of pairs in each cell.
    cell_px : float
        Size of a cell, px.
    """

    middle_px: Float
    shift_px: Float
    std_px: Float
    pairs: NDArray[np.intp]
    cell_px: float

    @property
    def clear(self) -> NDArray[np.bool_]:
        """Mask of mean shifts beyond 2.45 standard errors, (n,) bool: 5 % of random ones are."""
        # NaN is not clear.
        return np.asarray(np.linalg.norm(self.shift_px, axis=1) > 2.45 * self.std_px)


def shift_grid(pairs: Sequence[Pair]) -> ShiftGrid:
    """Return the shifts of pairs over a grid, each pair weighted by its signal-to-noise ratio squared.

    Parameters
    ----------
    pairs : sequence of Pair
        At least one.

    Returns
    -------
    ShiftGrid
        Cells without pairs are omitted.
    """
    position = np.column_stack([column(pairs, "x_px"), column(pairs, "y_px")])
    shift = np.column_stack([column(pairs, "shift_x_px"), column(pairs, "shift_y_px")])
    # The variance of a position is inversely proportional to the squared signal-to-noise ratio.
    weight = np.minimum(column(pairs, "signal_to_noise"), _MAX_SIGNAL) ** 2
    low, size = position.min(axis=0), np.maximum(np.ptp(position, axis=0), _MIN_FIELD_PX)
    cells = float(np.clip(np.sqrt(len(pairs) / _PAIRS_A_CELL * size.max() / size.min()), _MIN_CELLS, _MAX_CELLS))
    cell_px = float(size.max()) / round(cells)
    # The outermost pair belongs to the last cell.
    number = np.minimum((position - low) / cell_px, np.ceil(size / cell_px) - 1).astype(np.intp)
    _, which, count = np.unique(number, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()

    def mean(values: Float) -> Float:
        sums = [np.bincount(which, weight * axis) for axis in values.T]
        return np.column_stack(sums) / np.bincount(which, weight)[:, np.newaxis]

    mean_px = mean(shift)
    squares = np.bincount(which, weight**2 * np.mean((shift - mean_px[which]) ** 2, axis=1))
    several = np.where(count > 1, count, np.nan)
    std_px = np.sqrt(squares * several / (several - 1)) / np.bincount(which, weight)
    return ShiftGrid(mean(position), mean_px, np.asarray(std_px), count, cell_px)


def summarize(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return the paper's measures over all pairs.

    Parameters
    ----------
    pairs : sequence of Pair
        At least one.

    Returns
    -------
    dict
        Ready for JSON.  Differences are simulated minus real.

    Notes
    -----
    Teague & Chahl, section 3.  Intensities exclude saturated trails.
    """
    lone = [pair for pair in pairs if not pair.saturated]
    long = [pair for pair in pairs if isfinite(pair.length_difference_px)]
    centroid, shape, baseline = (column(pairs, f"{name}_px") for name in ("centroid", "shape", "baseline"))
    noise = column(pairs, "noise_px")
    length, turn = column(long, "length_difference_px"), np.rad2deg(column(long, "direction_difference_rad"))
    shift = np.hypot(column(pairs, "shift_x_px"), column(pairs, "shift_y_px"))
    return {
        "peak": intensity(column(lone, "peak_real_dn"), column(lone, "peak_simulated_dn")),
        "brightest_pixel": intensity(column(lone, "pixel_real_dn"), column(lone, "pixel_simulated_dn")),
        "saturated_pairs": len(pairs) - len(lone),
        "centroid": {
            "pairs": len(pairs),
            "mean_px": float(centroid.mean()),
            "median_px": float(np.median(centroid)),
            "noise_px": float(np.median(noise)),
            # RMS minus the mean contribution of the noise.
            "beyond_noise_px": float(np.sqrt(max(float((centroid**2 - noise**2).mean()), 0.0))),
        },
        "centroid_in_own_region": {
            "mean_px": float(shape.mean()),
            "median_px": float(np.median(shape)),
            "baseline_mean_px": float(baseline.mean()),
            "baseline_median_px": float(np.median(baseline)),
            "reduction_percent": float(100 * (1 - shape.mean() / baseline.mean())),
        },
        "shift": {
            "mean_px": float(shift.mean()),
            "median_px": float(np.median(shift)),
            "x_px": float(column(pairs, "shift_x_px").mean()),
            "y_px": float(column(pairs, "shift_y_px").mean()),
        },
        "trail": {
            "pairs": len(long),
            "length_difference_px": _spread(length),
            "length_difference_percent": _spread(100 * length / column(long, "length_px")),
            "direction_difference_deg": _spread(turn),
        },
    }


def _spread(values: Float) -> dict[str, float | None]:
    if not len(values):
        return {"mean": None, "median": None, "mean_absolute": None}
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "mean_absolute": float(np.abs(values).mean()),
    }


def by_star(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Return statistics of each star over the images, the one found most often first.

    Parameters
    ----------
    pairs : sequence of Pair

    Returns
    -------
    list of dict
        Ready for JSON; unidentified stars are omitted.
    """
    of: dict[tuple[str, int], list[Pair]] = defaultdict(list)
    for pair in pairs:
        if pair.star_id:
            of[pair.catalogue, pair.star_id].append(pair)
    stars = []
    for (catalogue, star_id), own in of.items():
        lone = [pair for pair in own if not pair.saturated]
        stars.append(
            {
                "catalogue": catalogue,
                "star_id": star_id,
                "name": own[0].name,
                "vmag": own[0].vmag,
                "found": len(own),
                "peak": intensity(column(lone, "peak_real_dn"), column(lone, "peak_simulated_dn")),
                "centroid_mean_px": float(column(own, "centroid_px").mean()),
                "centroid_median_px": float(np.median(column(own, "centroid_px"))),
            }
        )
    return sorted(stars, key=lambda star: (-star["found"], star["vmag"], star["star_id"]))
