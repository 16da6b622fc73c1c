"""Labels of star trails for detectors: outline, bounding box and key points of each star and body on a frame.

Positions are those of COCO and YOLO: (0, 0) is the outer corner of the top left pixel, half a pixel from its centre.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import atan2, ceil, cos, hypot, pi, sin
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["CATEGORIES", "TrailLabel", "labels_of"]

Float = NDArray[np.float64]

CATEGORIES: Final = ("star", "planet", "moon", "sun")
# Half width of an outline, standard deviations of the point spread function: 95 % of the light of a long trail, 86 % of
# a point.
_HALF_WIDTH_SIGMA: Final = 2.0
# Variance of a square pixel, px^2: it widens the image of a star.
_PIXEL_VARIANCE_PX2: Final = 1 / 12
# Distance between points of an outline along the trail, px, and their greatest number.
_STEP_PX: Final = 8.0
_MOST_STEPS: Final = 32
# Points on each of the two half circles at the ends.
_CAP_POINTS: Final = 7
# A curve that turns by more than 45 degrees between two of its points turns back.
_SHARPEST_COSINE: Final = 0.707
# Such a curve is short up to this many half widths.
_SHORT_WIDTHS: Final = 4.0
# Shorter trails are drawn as circles, px.
_SHORTEST_PX: Final = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class TrailLabel:
    """The label of one star or body.

    Attributes
    ----------
    category : str
        One of `CATEGORIES`.
    entry : mapping
        Its entry in the truth.
    index : int
        Its place in the list of stars, followed by that of bodies, from 0.
    polygons : tuple of (n, 2) float64
        Outline inside the image, px; one for each short exposure of a stack.
    keypoints : (3, 2) float64
        Start, middle and end, px; NaN where unknown.
    size : (int, int)
        Width and height of the image, px.
    """

    category: str
    entry: Mapping[str, Any]
    index: int
    polygons: tuple[Float, ...]
    keypoints: Float
    size: tuple[int, int]

    @property
    def bbox(self) -> tuple[float, float, float, float]:
        """Left, top, width, height, px."""
        points = np.concatenate(self.polygons)
        low, high = points.min(axis=0), points.max(axis=0)
        return (*low.tolist(), *(high - low).tolist())

    @property
    def area_px2(self) -> float:
        """Area of the outline, px^2."""
        return sum(abs(_signed_area(polygon)) for polygon in self.polygons)

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Which of the key points lie on the image, (3,)."""
        return np.asarray(((self.keypoints >= 0) & (self.keypoints <= self.size)).all(axis=1))


def labels_of(line: Mapping[str, Any], *, psf_sigma_px: float, least_snr: float) -> Iterator[TrailLabel]:
    """Yield the labels of a frame.

    Parameters
    ----------
    line : mapping
        Its line of truth.
    psf_sigma_px : float
        Width of the point spread function where the line does not say it.
    least_snr : float
        Fainter stars have no label.  Bodies always have one.

    Yields
    ------
    TrailLabel
        In the order of the truth, if any part of the outline is on the image.
    """
    size = line["camera"]["width_px"], line["camera"]["height_px"]
    sigma_px = _frame_sigma_px(line, psf_sigma_px)
    stars, bodies = line["stars"], line.get("bodies", [])
    for index, entry in enumerate([*stars, *bodies]):
        is_star = index < len(stars)
        if is_star and entry.get("snr", np.inf) < least_snr:
            continue
        width_px = hypot(entry.get("psf_sigma_px", sigma_px), _PIXEL_VARIANCE_PX2**0.5) * _HALF_WIDTH_SIGMA
        keypoints = _keypoints(entry)
        outlines = (_clipped(one, size) for one in _outlines(entry, keypoints, width_px + _radius_px(entry)))
        polygons = tuple(polygon for polygon in outlines if len(polygon) > 2)
        if polygons:
            yield TrailLabel("star" if is_star else _kind(entry), entry, index, polygons, keypoints, size)


def _frame_sigma_px(line: Mapping[str, Any], given_px: float) -> float:
    """Return the width of the Gaussian with most of the flux of a star."""
    gaussians = line.get("psf", {}).get("gaussians") or [(1.0, line.get("settings", {}).get("sensor.psf_sigma_px"))]
    _, sigma_px = max(gaussians, key=lambda one: one[0])
    return given_px if sigma_px is None else float(sigma_px)


def _kind(body: Mapping[str, Any]) -> str:
    name = str(body["name"]).lower()
    return name if name in CATEGORIES else "planet"


def _radius_px(entry: Mapping[str, Any]) -> float:
    return float(entry.get("diameter_px") or 0.0) / 2


def _keypoints(entry: Mapping[str, Any]) -> Float:
    middle = (entry["x_px"], entry["y_px"])
    given = [entry["start"] or (None, None), middle, entry["end"] or (None, None)]
    return np.array(given, dtype=np.float64) + 0.5


def _outlines(entry: Mapping[str, Any], keypoints: Float, half_width_px: float) -> Iterator[Float]:
    """Yield the outlines of a trail, or of each short exposure of a stack."""
    segments = [np.array(one, dtype=np.float64) + 0.5 for one in entry.get("segments") or () if all(one)]
    for ends in segments:
        yield _capsule(ends, half_width_px)
    if segments:
        return
    known = keypoints[np.isfinite(keypoints).all(axis=1)]
    if len(known) == 3:
        yield from _along(_parabola(known), half_width_px)
    elif len(known):
        yield _capsule(known, half_width_px)
    elif entry["centroid_x_px"] is not None:
        yield _capsule(np.array([[entry["centroid_x_px"], entry["centroid_y_px"]]]) + 0.5, half_width_px)


def _along(curve: Float, half_width_px: float) -> Iterator[Float]:
    """Yield the outline of a curve; two if it is long and turns back, the hull if it is short and turns back."""
    unit = _unit(np.diff(curve, axis=0))
    turn = np.einsum("ij,ij->i", unit[1:], unit[:-1])
    if len(turn) == 0 or turn.min() > _SHARPEST_COSINE:
        yield _capsule(curve, half_width_px)
    elif np.ptp(curve, axis=0).max() < _SHORT_WIDTHS * half_width_px:
        discs = (curve[:, np.newaxis] + _circle(half_width_px)).reshape(-1, 2).astype(np.float32)
        yield np.asarray(cv2.convexHull(discs)[:, 0], dtype=np.float64)
    else:
        corner = int(turn.argmin()) + 1
        yield _capsule(curve[: corner + 1], half_width_px)
        yield _capsule(curve[corner:], half_width_px)


def _unit(vectors: Float) -> Float:
    unit: Float = vectors / np.maximum(np.hypot(vectors[:, 0], vectors[:, 1]), 1e-9)[:, np.newaxis]
    return unit


def _circle(radius_px: float) -> Float:
    angle = np.linspace(0, 2 * pi, 2 * _CAP_POINTS, endpoint=False)[:, np.newaxis]
    circle: Float = radius_px * np.hstack([np.cos(angle), np.sin(angle)])
    return circle


def _parabola(points: Float) -> Float:
    """Return points on the parabola through start, middle and end, (n, 2) px."""
    start, middle, end = points
    length_px = float(np.hypot(*(middle - start)) + np.hypot(*(end - middle)))
    t = np.linspace(0.0, 1.0, 2 + 2 * min(ceil(length_px / (2 * _STEP_PX)), _MOST_STEPS // 2) - 1)[:, np.newaxis]
    curve: Float = start * (1 - 2 * t) * (1 - t) + middle * 4 * t * (1 - t) + end * t * (2 * t - 1)
    return curve


def _capsule(points: Float, half_width_px: float) -> Float:
    """Return the outline of everything closer to a curve than its half width, (n, 2) px."""
    step = np.diff(points, axis=0)
    far = np.hypot(step[:, 0], step[:, 1]) > _SHORTEST_PX
    if not far.any():
        return np.asarray(points[0] + _circle(half_width_px))
    points = np.concatenate([points[:1], points[1:][far]])
    unit = _unit(np.diff(points, axis=0))
    mean = _unit(np.concatenate([unit[:1], unit[:-1] + unit[1:], unit[-1:]]))
    normal = np.column_stack([-mean[:, 1], mean[:, 0]]) * half_width_px
    around_end, around_start = _cap(points[-1], unit[-1], half_width_px), _cap(points[0], -unit[0], half_width_px)
    return np.concatenate([points + normal, around_end, (points - normal)[::-1], around_start])


def _cap(centre: Float, outwards: Float, radius_px: float) -> Float:
    """Return the half circle around the end of a trail, without its first and last point."""
    middle = atan2(outwards[1], outwards[0])
    angles = middle + pi / 2 - np.linspace(0.0, pi, _CAP_POINTS + 2)[1:-1]
    return np.array([(centre[0] + radius_px * cos(a), centre[1] + radius_px * sin(a)) for a in angles])


def _clipped(polygon: Float, size: Sequence[int]) -> Float:
    """Return the part of a polygon inside the image, after Sutherland and Hodgman (1974)."""
    for axis, limit, sign in ((0, 0.0, 1.0), (0, float(size[0]), -1.0), (1, 0.0, 1.0), (1, float(size[1]), -1.0)):
        inside = sign * (polygon[:, axis] - limit)
        if len(polygon) == 0 or (inside >= 0).all():
            continue
        kept: list[Float] = []
        for k, here in enumerate(polygon):
            before = polygon[k - 1]
            if (inside[k] >= 0) != (inside[k - 1] >= 0):
                crossing = before + (here - before) * (inside[k - 1] / (inside[k - 1] - inside[k]))
                crossing[axis] = limit
                kept.append(crossing)
            if inside[k] >= 0:
                kept.append(here)
        polygon = np.array(kept).reshape(-1, 2)
    return polygon


def _signed_area(polygon: Float) -> float:
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
