"""The result of a comparison: the images, the paired stars, and the images that were left out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from glstar.compare.alignment import Alignment
from glstar.compare.backgroundsubtraction import SubtractedImage
from glstar.compare.pairs import Cutouts, Measures, Pair, Pairing
from glstar.compare.summary import by_star, summarize
from glstar.errors import ImagesError

__all__ = ["Collector", "ComparedImage", "Comparison", "RejectedImage", "chance", "rejection"]

# Number of best and of worst pairs that are kept with their cutouts.
_SHOWN_PAIRS: Final = 8
# An image counts as identified if 3 of its predicted stars and a tenth of them are found, or half of fewer than 6: a
# single match among many predictions is chance.
# Trails found by chance: at most this fraction of those predicted, and at least this scatter about a common motion, px.
_MOST_BY_CHANCE, _CHANCE_SCATTER_PX = 0.5, 1.2
_MANY_PREDICTED, _MIN_FOUND, _MIN_FOUND_FRACTION = 6, 3, 0.1
# An image without found stars is reported as saturated above this fraction of saturated pixels.
_SATURATED_FRACTION: Final = 0.3


@dataclass(frozen=True, slots=True)
class RejectedImage:
    """An image that could not be compared.

    Attributes
    ----------
    file : str
    reason : str
        Why it could not be compared, as a sentence.
    kind : str
        A short form of the reason, for counts.
    """

    file: str
    reason: str
    kind: str


@dataclass(frozen=True, slots=True)
class ComparedImage:
    """The result for one real image.

    Attributes
    ----------
    file : str
    start_utc_s : float or None
        Start of the simulated exposure on the flight's clock, UTC seconds since 1970; None without a flight.
    predicted, found, astray, blended, cut_off : int
        Number of trails that were predicted, found, and found but rejected as outliers of the common motion; number of
        stars that were not searched for because they overlap another star or leave the image.
    turn_rad : tuple of float or None
        Small motion of the camera from the given attitude that fits the trails: rotations about its right, down and
        forward axes, rad; None without a flight.
    """

    file: str
    start_utc_s: float | None
    predicted: int
    found: int
    astray: int
    blended: int
    cut_off: int
    turn_rad: tuple[float, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """The result of a comparison.

    Attributes
    ----------
    images : tuple of ComparedImage
    left_out : tuple of RejectedImage
    pairs : tuple of Pair
    best, worst : tuple of (Pair, Cutouts)
        The pairs with the smallest centroid distance, and those with the largest one beyond the noise.
    alignment : Alignment or None
        The clock offset and mount that were fitted first.
    time_sources : str
        Where the times of the images come from, or how the images were paired.
    """

    images: tuple[ComparedImage, ...]
    left_out: tuple[RejectedImage, ...]
    pairs: tuple[Pair, ...]
    best: tuple[tuple[Pair, Cutouts], ...]
    worst: tuple[tuple[Pair, Cutouts], ...]
    alignment: Alignment | None
    time_sources: str

    @property
    def summary(self) -> dict[str, Any]:
        """The paper's numbers over all pairs; see `summarize`."""
        return summarize(self.pairs)

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
        """Add the result of an image.

        Parameters
        ----------
        image : ComparedImage
        measures : Measures
        """
        self.images.append(image)
        self.pairs.extend(measures.pairs)
        own = list(zip(measures.pairs, measures.pictures, strict=True))
        self._best = sorted(self._best + own, key=lambda one: one[0].centroid_px)[:_SHOWN_PAIRS]
        self._worst = sorted(self._worst + own, key=lambda one: -one[0].beyond_noise_px)[:_SHOWN_PAIRS]

    def reject(self, file: str, kind: str, reason: str) -> None:
        """Add an image that cannot be compared.

        Parameters
        ----------
        file, kind, reason : str
            The attributes of `RejectedImage`.
        """
        self.left_out.append(RejectedImage(file, reason, kind))

    def result(self, alignment: Alignment | None, time_sources: str, folder: Path) -> Comparison:
        """Return the comparison.

        Parameters
        ----------
        alignment : Alignment or None
        time_sources : str
        folder : Path
            The folder of the images, for the error message.

        Returns
        -------
        Comparison

        Raises
        ------
        ImagesError
            If no star was paired.
        """
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
        )


def _nothing_paired(left_out: Sequence[RejectedImage]) -> str:
    kinds = Counter(one.kind for one in left_out)
    counted = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    first = next((one for one in left_out if one.kind == kinds.most_common(1)[0][0]), None) if left_out else None
    return f"no star of any image could be paired: {counted}; {first.file}: {first.reason}" if first else "no image"


def chance(pairing: Pairing) -> tuple[str, str] | None:
    """Return why the trails that were found in an image are no evidence of its stars.

    Parameters
    ----------
    pairing : Pairing

    Returns
    -------
    (str, str) or None
        Kind and reason, as in `RejectedImage`; None if the trails move together, or most of them were found.

    Notes
    -----
    Other stars in the search windows scatter over these: by 1.3 to 2.8 px per axis in images of another part of the
    sky, where up to 36 % of the windows had one.  The same stars scatter by less than 0.1 px if attitude and lens are
    right.
    """
    predicted, found = len(pairing.trails), len(pairing.found_indices)
    if found >= _MOST_BY_CHANCE * predicted or not pairing.scatter_px > _CHANCE_SCATTER_PX:
        return None
    return "without a star found", (
        f"of {predicted} predicted trails {found} could be found, and these scatter by {pairing.scatter_px:.1f} px:"
        " other stars, by chance; another time, or a camera that points elsewhere (--search-angle)"
    )


def rejection(pairing: Pairing, sky: SubtractedImage) -> tuple[str, str] | None:
    """Return why an image cannot be compared.

    Parameters
    ----------
    pairing : Pairing
    sky : SubtractedImage

    Returns
    -------
    (str, str) or None
        Kind and reason, as in `RejectedImage`; None if enough of its stars were found.
    """
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
