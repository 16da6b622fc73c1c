"""The result of a comparison: compared and rejected images, pairs of stars, and the paper's measures of the pairs.

Measures are over all pairs and per star: Teague & Chahl, section 3.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.compare.alignment import Alignment
from glstar.compare.detection import SubtractedImage
from glstar.compare.pairs import Cutouts, Measures, Pair, Pairing
from glstar.errors import ImagesError
from glstar.sky.photometry import magnitude_difference

# Number of cells along the longer side of the field, for 20 pairs per cell on average.
_MIN_CELLS, _MAX_CELLS = 3, 8
_PAIRS_A_CELL = 20
# Smallest extent of the field, px, for one or two pairs.
_MIN_FIELD_PX = 40.0
# Weights grow up to this signal-to-noise ratio: beyond it, model errors exceed the noise.
_MAX_SIGNAL = 100.0
# Number of best and of worst pairs that are kept with their cutouts.
_SHOWN_PAIRS = 8
# An image counts as identified if 3 of its predicted stars and a tenth of them are found, or half of fewer than 6: a
# single match among many predictions is chance.
_MANY_PREDICTED, _MIN_FOUND, _MIN_FOUND_FRACTION = 6, 3, 0.1
# Trails found by chance: at most this fraction of those predicted, and at least this scatter about a common motion, px.
_MOST_BY_CHANCE, _CHANCE_SCATTER_PX = 0.5, 1.2
# An image without found stars is reported as saturated above this fraction of saturated pixels.
_SATURATED_FRACTION = 0.3


def column(pairs: Sequence[Pair], name: str) -> Float:
    """Return one measure of all pairs, (n,) float64."""
    return np.array([getattr(pair, name) for pair in pairs], dtype=np.float64)


def percentage_errors(real_dn: Float, simulated_dn: Float) -> Float:
    """Return simulated minus real intensities, (n,), in percent of the real ones."""
    return np.asarray(100 * (simulated_dn - real_dn) / real_dn)


def intensity(real_dn: Float, simulated_dn: Float) -> dict[str, Any]:
    """Return the paper's figures of peak intensities, and the scatter in magnitudes."""
    if not len(real_dn):
        return {"pairs": 0}
    percent = float(np.abs(percentage_errors(real_dn, simulated_dn)).mean())
    error_mag = magnitude_difference(simulated_dn / real_dn)
    return {
        "pairs": len(real_dn),
        "mean_error_dn": float((simulated_dn - real_dn).mean()),
        "mean_absolute_percentage_error": percent,
        # The error in magnitudes by eq. (36), as in the paper: 47.4 % are 0.42 mag.
        "magnitude_error": float(-magnitude_difference(np.array([1 + percent / 100]))[0]),
        "magnitude_difference_mean": float(error_mag.mean()),
        "magnitude_difference_std": float(error_mag.std(ddof=1)) if len(error_mag) > 1 else None,
    }


@dataclass(frozen=True, slots=True, eq=False)
class ShiftGrid:
    """Shifts of pairs, averaged over the cells of a grid."""

    middle_px: Float  # (n, 2) weighted mean position of each cell's pairs, (x, y)
    shift_px: Float  # (n, 2) weighted mean shift, simulated minus real
    # (n,) standard error of the mean, RMS of both axes, by the scatter of the pairs; NaN for a single pair.
    std_px: Float
    pairs: NDArray[np.intp]  # (n,) int: number of pairs in each cell
    cell_px: float  # Size of a cell, px

    @property
    def clear(self) -> NDArray[np.bool_]:
        """Mask of mean shifts beyond 2.45 standard errors, (n,) bool: 5 % of random ones are."""
        # NaN is not clear.
        return np.asarray(np.linalg.norm(self.shift_px, axis=1) > 2.45 * self.std_px)


def shift_grid(pairs: Sequence[Pair]) -> ShiftGrid:
    """Return the shifts of pairs over a grid, weighted by their squared signal-to-noise ratios.

    `pairs`: at least one.  Cells without pairs are omitted.
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
    """Return the paper's measures over all pairs, ready for JSON: Teague & Chahl, section 3.

    `pairs`: at least one.  Differences are simulated minus real; intensities exclude saturated trails.
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


def figures(summary: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return labels and values of the paper's measures for a person; differences are simulated minus real."""
    centroid, own, shift, trail = (summary[key] for key in ("centroid", "centroid_in_own_region", "shift", "trail"))
    rows = [
        ("centroid distance", _mean_and_median(centroid)),
        ("of it noise", f"{centroid['noise_px']:.3f} px"),
        ("each in its own region", _mean_and_median(own)),
        ("a straight line there", f"mean {own['baseline_mean_px']:.3f}, median {own['baseline_median_px']:.3f} px"),
        ("shift", f"{shift['x_px']:+.3f}, {shift['y_px']:+.3f} px in the mean"),
    ]
    for label, key in (("peak intensity", "peak"), ("brightest pixel", "brightest_pixel")):
        measured = summary[key]
        if measured["pairs"]:
            error = f"{measured['mean_error_dn']:+.1f} DN, absolute {measured['mean_absolute_percentage_error']:.1f} %"
            rows.append((label, f"{error}, {measured['magnitude_error']:.2f} mag"))
    if summary["saturated_pairs"]:
        rows.append(("saturated, not in these", f"{summary['saturated_pairs']}"))
    if trail["pairs"]:
        length_px, percent = trail["length_difference_px"]["mean"], trail["length_difference_percent"]["mean"]
        rows.append(("length", f"{length_px:+.2f} px, {percent:+.1f} %"))
        rows.append(("direction", f"{trail['direction_difference_deg']['mean']:+.2f}\N{DEGREE SIGN}"))
    return tuple(rows)


def _mean_and_median(measured: dict[str, float]) -> str:
    return f"mean {measured['mean_px']:.3f}, median {measured['median_px']:.3f} px"


def _spread(values: Float) -> dict[str, float | None]:
    if not len(values):
        return {"mean": None, "median": None, "mean_absolute": None}
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "mean_absolute": float(np.abs(values).mean()),
    }


def by_star(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Return statistics of each identified star over the images, ready for JSON, the star found most often first."""
    pairs_of: dict[tuple[str, int], list[Pair]] = defaultdict(list)
    for pair in pairs:
        if pair.star_id:
            pairs_of[pair.catalogue, pair.star_id].append(pair)
    stars = []
    for (catalogue, star_id), own in pairs_of.items():
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


@dataclass(frozen=True, slots=True)
class RejectedImage:
    """An image that could not be compared."""

    file: str
    reason: str  # why it could not be compared, as a sentence
    kind: str  # a short form of the reason, for counts


@dataclass(frozen=True, slots=True)
class ComparedImage:
    """The result for one real image."""

    file: str
    # Start of the simulated exposure on the flight's clock, UTC seconds since 1970; None without a flight.
    start_utc_s: float | None
    predicted: int  # trails that were searched for
    found: int  # trails that were found
    astray: int  # trails that were found but are outliers of the common motion
    blended: int  # stars that were not searched for because they overlap another star
    cut_off: int  # stars that were not searched for because they leave the image
    # Small motion of the camera from the given attitude that fits the trails: rotations about its right, down and
    # forward axes, rad; None without a flight.
    turn_rad: tuple[float, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The result of a comparison."""

    images: tuple[ComparedImage, ...]
    left_out: tuple[RejectedImage, ...]
    pairs: tuple[Pair, ...]
    best: tuple[tuple[Pair, Cutouts], ...]  # the pairs with the smallest centroid distances
    worst: tuple[tuple[Pair, Cutouts], ...]  # the pairs with the largest centroid distances beyond the noise
    alignment: Alignment | None  # the clock offset and mount that were fitted first
    time_sources: str  # where the times of the images come from, or how the images were paired
    notes: tuple[str, ...] = ()  # for the user: what the times leave open

    @property
    def summary(self) -> dict[str, Any]:
        """The paper's numbers over all pairs; see `summarize`."""
        return summarize(self.pairs)

    @property
    def figures(self) -> tuple[tuple[str, str], ...]:
        """The paper's measures as labels and values; see `figures`."""
        return figures(self.summary)

    @property
    def stars(self) -> list[dict[str, Any]]:
        """Statistics of each star; see `by_star`."""
        return by_star(self.pairs)


class Collector:
    """Collects the pairs of all images, with cutouts of the best and the worst ones."""

    def __init__(self) -> None:
        self.images: list[ComparedImage] = []
        self.left_out: list[RejectedImage] = []
        self.pairs: list[Pair] = []
        self._best: list[tuple[Pair, Cutouts]] = []
        self._worst: list[tuple[Pair, Cutouts]] = []

    def add(self, image: ComparedImage, measures: Measures) -> None:
        """Add the result of an image."""
        self.images.append(image)
        self.pairs.extend(measures.pairs)
        own = list(zip(measures.pairs, measures.pictures, strict=True))
        self._best = sorted(self._best + own, key=lambda shown: shown[0].centroid_px)[:_SHOWN_PAIRS]
        self._worst = sorted(self._worst + own, key=lambda shown: -shown[0].beyond_noise_px)[:_SHOWN_PAIRS]

    def reject(self, file: str, kind: str, reason: str) -> None:
        """Add an image that cannot be compared; `file`, `kind`, `reason`: the attributes of `RejectedImage`."""
        self.left_out.append(RejectedImage(file, reason, kind))

    def result(
        self, alignment: Alignment | None, time_sources: str, folder: Path, notes: tuple[str, ...] = ()
    ) -> Comparison:
        """Return the comparison of the images in a folder; raises ImagesError if no star was paired."""
        if not self.pairs:
            raise ImagesError(folder, _nothing_paired(self.left_out))
        return Comparison(
            tuple(self.images),
            tuple(self.left_out),
            tuple(self.pairs),
            tuple(self._best),
            tuple(self._worst),
            alignment,
            time_sources,
            notes,
        )


def _nothing_paired(left_out: Sequence[RejectedImage]) -> str:
    if not left_out:
        return "no image"
    kinds = Counter(image.kind for image in left_out).most_common()
    counted = ", ".join(f"{count} {kind}" for kind, count in kinds)
    first = next(image for image in left_out if image.kind == kinds[0][0])
    return f"no star of any image could be paired: {counted}; {first.file}: {first.reason}"


def chance(pairing: Pairing) -> tuple[str, str] | None:
    """Return why the trails that were found may be other stars, as kind and reason; None if they are evidence.

    Trails are evidence if they move together or most were found.  In images of another part of the sky, up to 36 % of
    the search windows had a star, and the stars found scattered by 1.3 to 2.8 px per axis.  The right stars scatter by
    less than 0.1 px if attitude and lens are right.
    """
    predicted, found = len(pairing.trails), len(pairing.found_indices)
    if found >= _MOST_BY_CHANCE * predicted or not pairing.scatter_px > _CHANCE_SCATTER_PX:
        return None
    return "without a star found", (
        f"of {predicted} predicted trails {found} could be found, and these scatter by {pairing.scatter_px:.1f} px:"
        " other stars, by chance; another time, or a camera that points elsewhere (--search-angle)"
    )


def rejection(pairing: Pairing, sky: SubtractedImage) -> tuple[str, str] | None:
    """Return why an image cannot be compared, as kind and reason; None if enough of its stars were found."""
    predicted, found = len(pairing.trails), len(pairing.found_indices)
    if not predicted:
        if sky.saturated_fraction > _SATURATED_FRACTION:
            return "saturated", f"{sky.saturated_fraction:.0%} of its pixels are at the sensor's limit"
        return "without a predicted star", (
            f"no predicted star is isolated, inside the image and above the noise ({sky.usual_noise_dn:.1f} DN)"
        )
    enough = max(_MIN_FOUND, _MIN_FOUND_FRACTION * predicted) if predicted >= _MANY_PREDICTED else predicted / 2
    if found >= enough:
        return None
    if sky.saturated_fraction > _SATURATED_FRACTION:
        return "saturated", f"{sky.saturated_fraction:.0%} of its pixels are at the sensor's limit"
    return "without a star found", (
        f"of {predicted} predicted trails {found or 'none'} could be found: cloud, another time, or a camera"
        " that points elsewhere (--search-angle)"
    )
