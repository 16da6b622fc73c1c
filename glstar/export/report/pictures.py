"""One frame on a page: its image as a small JPEG, and the truth that is drawn over it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Index
from glstar.errors import ExportError
from glstar.export.directory import image_path
from glstar.export.imagefiles.formats import decode
from glstar.export.imagefiles.processing import encode_jpeg
from glstar.export.truth.lines import DETECTABLE_SNR
from glstar.sky.catalogue.names import proper_names
from glstar.sky.catalogue.reading import star_label

# Most frames with an image on a page.
MOST_FRAMES = 100
# All JPEGs of a page, and the largest one, bytes: with base64 and the truth a page stays below 5 MB.
_ALL_BYTES, _MOST_BYTES = 2_400_000, 200_000
# Largest side of an image on a page, px.
_MOST_PX = 1600
# Fraction of the size and quality of a JPEG, best first.
_QUALITIES = (
    (1.0, 85), (1.0, 70), (1.0, 50), (0.75, 60), (0.6, 60), (0.6, 45), (0.45, 50), (0.35, 50), (0.25, 40),
)  # fmt: skip
# Stars that are drawn over an image; of these, the ones with a name beside them.
_MOST_STARS, _MOST_NAMES = 150, 20
# Radius of the circle about a star, px.
_CIRCLE_PX = 6.0
# The display is linear up to this many standard deviations of the sky; white is at the brightest pixels, but at least
# this many standard deviations above the sky.
_LINEAR_SIGMA, _WHITE_SIGMA = 3.0, 30.0


@dataclass(frozen=True, slots=True)
class Picture:
    """The image of a frame on a page."""

    jpeg: bytes
    sky_dn: float  # Median of the image, DN


def picture_of(directory: Path, line: Mapping[str, Any], frames: int) -> Picture:
    """Return the image of a line of truth, stretched, as a JPEG small enough for a page of `frames` frames.

    Raises ExportError if there is no such image, or it is damaged.
    """
    path = image_path(directory, line)
    try:
        pixels = decode(path.read_bytes(), path.suffix)
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise ExportError(path, f"cannot be shown on a page: {why}") from error
    levels, _, counts = _levels_of(pixels)
    jpeg = _compressed(stretched(pixels), min(_ALL_BYTES // frames, _MOST_BYTES))
    return Picture(jpeg, _quantile(levels, counts, 0.5))


def stretched(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image as 8 bits of each channel on an asinh scale: the median is black, the brightest pixels white."""
    levels, level_of, counts = _levels_of(pixels)
    sky = _quantile(levels, counts, 0.5)
    sigma = max(1.4826 * _quantile(np.abs(levels - sky), counts, 0.5), 0.5)
    white = max(_quantile(levels, counts, 0.9999) - sky, _WHITE_SIGMA * sigma)
    soft = _LINEAR_SIGMA * sigma
    shown = np.arcsinh(np.maximum(levels - sky, 0) / soft) / np.arcsinh(white / soft)
    return np.asarray((np.minimum(shown, 1.0) * 255 + 0.5).astype(np.uint8)[level_of])


def _levels_of(pixels: NDArray[Any]) -> tuple[Float, NDArray[Any], Index]:
    """Return the levels of an image (n,), the index of the level of each pixel, and the pixels at each level (n,).

    Quantiles of a frame's few levels take a tenth of the time of those of its pixels.
    """
    if pixels.dtype.kind == "u":
        counts = np.bincount(pixels.ravel())
        return np.arange(len(counts), dtype=np.float64), pixels, counts
    levels, level_of, counts = np.unique(pixels, return_inverse=True, return_counts=True)
    return levels.astype(np.float64), level_of.reshape(pixels.shape), counts


def _quantile(levels: Float, counts: Index, fraction: float) -> float:
    """Return the quantile of pixels by the number of them at each level, as np.quantile interpolates it."""
    order = np.argsort(levels, kind="stable")
    last = np.cumsum(counts[order])
    place = fraction * (last[-1] - 1)
    either = np.searchsorted(last, [np.floor(place), min(np.floor(place) + 1, last[-1] - 1)], side="right")
    low, high = levels[order[either]]
    return float(low + (place - np.floor(place)) * (high - low))


def _compressed(shown: NDArray[np.uint8], most_bytes: int) -> bytes:
    """Return the best JPEG of at most this size, or the smallest one."""
    jpeg = b""
    fitting = min(1.0, _MOST_PX / max(shown.shape[:2]))
    for fraction, quality in _QUALITIES:
        height, width = (max(1, round(side * fraction * fitting)) for side in shown.shape[:2])
        smaller = (
            shown if (height, width) == shown.shape[:2] else cv2.resize(shown, (width, height), 0, 0, 0, cv2.INTER_AREA)
        )
        jpeg = encode_jpeg(smaller, quality)
        if len(jpeg) <= most_bytes:
            break
    return jpeg


def drawing_of(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page's script draws over an image: the brightest stars, bodies and satellites of a line of truth.

    Each mark is [name, whether it is detectable, [x, y] of its middle or null, radius, trails], in px from the centre
    of the top left pixel; a trail is x and y in turn.
    """
    marks = []
    for number, star in enumerate(line["stars"][:_MOST_STARS]):
        name = _name_of(str(line.get("catalogue", "")), star["star_id"]) if number < _MOST_NAMES else ""
        is_detectable = star.get("snr", 0.0) >= DETECTABLE_SNR
        marks.append(_mark(star, name, is_detectable=is_detectable, radius_px=_CIRCLE_PX))
    for other in (*line.get("bodies", ()), *line.get("satellites", ())):
        radius_px = _CIRCLE_PX + float(other.get("diameter_px", 0.0)) / 2
        marks.append(_mark(other, str(other["name"]), is_detectable=True, radius_px=radius_px))
    return {
        "file": str(line.get("file", "")),
        "frame": int(line["frame"]),
        "utc": str(line["utc_mid"]),
        "w": int(line["camera"]["width_px"]),
        "h": int(line["camera"]["height_px"]),
        "marks": marks,
    }


def _mark(one: Mapping[str, Any], name: str, *, is_detectable: bool, radius_px: float) -> list[Any]:
    middle = None if one["x_px"] is None else [_tenths(one["x_px"]), _tenths(one["y_px"])]
    stacked = [[start, end] for start, end in one.get("segments", ())]
    trails = [
        [_tenths(value) for point in trail if point is not None for value in point]
        for trail in stacked or [[one["start"], middle, one["end"]]]
    ]
    return [name, int(is_detectable), middle, _tenths(radius_px), [trail for trail in trails if len(trail) > 2]]


def _tenths(value: float) -> float:
    return round(float(value), 1)


@cache
def _names(column: str) -> dict[int, str]:
    return {getattr(one, column): one.name for one in proper_names() if getattr(one, column) is not None}


def _name_of(catalogue: str, star_id: int) -> str:
    """Return the proper name of a star, or else its designation by its number."""
    column = {"bsc5": "hr", "hipparcos": "hip"}.get(catalogue)
    proper = None if column is None else _names(column).get(star_id)
    return proper or star_label(catalogue, star_id)
