"""What all pairs say together: the paper's numbers, over all and star by star."""

from collections import defaultdict
from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.compare.pairs import Pair
from glstar.photometry import magnitude_difference

__all__ = ["by_star", "percentage_errors", "summarize"]

Float = NDArray[np.float64]


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
        # Eq. (36) of the error, as the paper turns 47.4 % into 0.42 mag.
        "magnitude_error": float(-magnitude_difference(np.array([1 + percent / 100]))[0]),
        "magnitude_difference_mean": float(off_mag.mean()),
        "magnitude_difference_std": float(off_mag.std(ddof=1)) if len(off_mag) > 1 else None,
    }


def summarize(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return the paper's numbers over all pairs.

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
    Teague & Chahl, section 3.  Saturated trails do not count among intensities.
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
            # Root mean square, once what noise adds to it on average is taken off.
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
    """Return what is said of each star over the images, the one found most often first.

    Parameters
    ----------
    pairs : sequence of Pair

    Returns
    -------
    list of dict
        Ready for JSON; stars that nobody could name are left out.
    """
    of: dict[int, list[Pair]] = defaultdict(list)
    for pair in pairs:
        if pair.hr:
            of[pair.hr].append(pair)
    stars = []
    for hr, own in of.items():
        lone = [pair for pair in own if not pair.saturated]
        stars.append(
            {
                "hr": hr,
                "name": own[0].name,
                "vmag": own[0].vmag,
                "found": len(own),
                "peak": intensity(column(lone, "peak_real_dn"), column(lone, "peak_simulated_dn")),
                "centroid_mean_px": float(column(own, "centroid_px").mean()),
                "centroid_median_px": float(np.median(column(own, "centroid_px"))),
            }
        )
    return sorted(stars, key=lambda star: (-star["found"], star["vmag"], star["hr"]))
