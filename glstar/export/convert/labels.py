"""Labels of star trails for detectors, for each star and body on a frame: COCO's JSON, or the directory of YOLO.

Positions are those of COCO and YOLO: (0, 0) is the outer corner of the top left pixel, half a pixel from its centre. A
label has an outline, a bounding box and three key points. With trail masks (``glstar export --masks``) the segmentation
of COCO holds the pixels of the mask, as run lengths down the columns, and the box is theirs. Without masks, and of a
star that dominates no pixel, it is the outline of `labels_of`.
"""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import atan2, ceil, cos, hypot, pi, sin
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import orjson
from numpy.typing import NDArray

from glstar import __version__
from glstar.arrays import Float
from glstar.errors import ExportError
from glstar.export.directory import explain_disk_errors, image_path, new_directory
from glstar.export.imagefiles.formats import decode
from glstar.export.imagefiles.masks import MASK_SUFFIXES
from glstar.export.truth.splits import NO_SPLIT, ConvertedSet
from glstar.system.files import publish, temporary_path

CATEGORIES = ("star", "planet", "moon", "sun")
# Half width of an outline, standard deviations of the point spread function: 95 % of the light of a long trail, 86 % of
# a point.
_HALF_WIDTH_SIGMA = 2.0
# Variance of a square pixel, px^2: it widens the image of a star.
_PIXEL_VARIANCE_PX2 = 1 / 12
# Distance between points of an outline along the trail, px, and their greatest number.
_STEP_PX = 8.0
_MOST_STEPS = 32
# Points on each of the two half circles at the ends.
_CAP_POINTS = 7
# A curve that turns by more than 45 degrees between two of its points turns back.
_SHARPEST_COSINE = 0.707
# Such a curve is short up to this many half widths.
_SHORT_WIDTHS = 4.0
# Shorter trails are drawn as circles, px.
_SHORTEST_PX = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class TrailLabel:
    """The label of one star or body."""

    category: str  # One of `CATEGORIES`
    entry: Mapping[str, Any]  # Its entry in the truth
    index: int  # Its place in the list of stars, followed by that of bodies, from 0
    # Tuple of (n, 2) float64: outline inside the image, px; one for each short exposure of a stack.
    polygons: tuple[Float, ...]
    keypoints: Float  # (3, 2) start, middle and end, px; NaN where unknown
    size: tuple[int, int]  # (int, int) width and height of the image, px

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
    """Yield the labels of a line of truth, in its order, if any part of the outline is on the image.

    `psf_sigma_px` is the width of the point spread function where the line does not say it. Stars fainter than
    `least_snr` have no label; bodies always have one.
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
    points = [entry["start"] or (None, None), middle, entry["end"] or (None, None)]
    return np.array(points, dtype=np.float64) + 0.5


def _outlines(entry: Mapping[str, Any], keypoints: Float, half_width_px: float) -> Iterator[Float]:
    """Yield the outlines of a trail, or of each short exposure of a stack."""
    segments = [np.array(one, dtype=np.float64) + 0.5 for one in entry.get("segments") or () if all(one)]
    for ends in segments:
        yield _capsule(ends, half_width_px)
    if segments:
        return
    finite = keypoints[np.isfinite(keypoints).all(axis=1)]
    if len(finite) == 3:
        yield from _along(_parabola(finite), half_width_px)
    elif len(finite):
        yield _capsule(finite, half_width_px)
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


_SUFFIX = MASK_SUFFIXES["trails"]


@dataclass(frozen=True, slots=True, eq=False)
class MaskRuns:
    """The pixels of each star in the trail mask of a frame."""

    shape: tuple[int, int]  # (int, int) rows and columns
    # (n,) int64: pixels of all stars, counted down the columns, sorted by star and then by position.
    pixels: NDArray[np.int64]
    firsts: NDArray[np.int64]  # (k,) int64: where the pixels of each value of the mask begin, from 0, followed by n

    @classmethod
    def of(cls, mask: NDArray[Any]) -> "MaskRuns":
        """Return the runs of a mask; `mask` (rows, columns) uint16: as ``glstar export --masks`` writes it."""
        down = mask.ravel(order="F")
        lit = np.flatnonzero(down)
        pixels = lit[np.argsort(down[lit], kind="stable")]
        firsts = np.searchsorted(down[pixels], np.arange(int(mask.max(initial=0)) + 2))
        return cls((mask.shape[0], mask.shape[1]), pixels, firsts)

    @classmethod
    def beside(cls, image: Path) -> "MaskRuns | None":
        """Return the runs of the mask beside an image; None without one; raises ExportError if it cannot be read."""
        path = image.with_name(f"{image.name.split('.')[0]}{_SUFFIX}")
        if not path.is_file():
            return None
        try:
            return cls.of(decode(path.read_bytes(), path.suffix))
        except (OSError, ValueError) as error:
            raise ExportError(path, f"cannot be read ({error}); run glstar export again") from error

    def _of(self, index: int) -> NDArray[np.int64]:
        """Return the pixels of a star, by its place in the truth from 0."""
        value = index + 1
        return (
            self.pixels[self.firsts[value] : self.firsts[value + 1]]
            if value + 1 < len(self.firsts)
            else self.pixels[:0]
        )

    def annotation(self, index: int) -> dict[str, Any]:
        """Return ``segmentation``, ``bbox`` and ``area`` by `TrailLabel.index`; empty if no pixel shows it."""
        pixels = self._of(index)
        if not pixels.size:
            return {}
        starts = np.flatnonzero(np.diff(pixels, prepend=-2) != 1)
        begin, end = pixels[starts], pixels[np.append(starts[1:], len(pixels)) - 1] + 1
        # Alternating numbers of other pixels and of the star's, from the first pixel to the last.
        bounds = np.column_stack([begin, end]).ravel()
        counts = np.diff(np.concatenate([[0], bounds, [self.shape[0] * self.shape[1]]]))
        column, row = np.divmod(pixels, self.shape[0])
        left, top = int(column.min()), int(row.min())
        return {
            "segmentation": {"counts": counts.tolist(), "size": list(self.shape)},
            "bbox": [left, top, int(column.max()) + 1 - left, int(row.max()) + 1 - top],
            "area": len(pixels),
        }


_OF_CATEGORY = {
    "supercategory": "sky",
    "keypoints": ["start", "middle", "end"],
    "skeleton": [[1, 2], [2, 3]],
}
_DIGITS = 3
# Keys of the truth that an annotation has besides those of COCO.
COPIED = ("star_id", "name", "vmag", "camera_mag", "snr", "flux_dn", "saturated", "in_frame")


def write_coco(source: ConvertedSet, output: Path, *, least_snr: float) -> tuple[Path, ...]:
    """Write the labels of an export as COCO: ``NAME.json``, or with splits ``NAME-train.json`` and so on.

    Stars have a label from the signal-to-noise ratio `least_snr`. Raises ExportError if a file exists, or the export
    cannot be read.
    """
    paths = {
        split: output if split == NO_SPLIT else output.with_name(f"{output.stem}-{split}{output.suffix}")
        for split in source.splits
    }
    if existing := next((path for path in paths.values() if path.exists()), None):
        raise ExportError(existing, "exists already; name another file, or remove it")
    with explain_disk_errors(output), ExitStack() as opened:
        files = {split: opened.enter_context(_CocoFile(path)) for split, path in paths.items()}
        for split, line in source.frames():
            labels = list(labels_of(line, psf_sigma_px=source.psf_sigma_px, least_snr=least_snr))
            files[split].add(line, labels, MaskRuns.beside(image_path(source.directory, line)))
        for file in files.values():
            file.finish()
    return tuple(paths.values())


class _CocoFile:
    """One file; images and annotations are written as they come, and joined at the end."""

    def __init__(self, path: Path) -> None:
        self._path, self._frames, self._annotation = path, 0, 0
        self._images_path, self._annotations_path = temporary_path(path), temporary_path(path)
        self._images: IO[bytes] = self._images_path.open("wb")
        self._annotations: IO[bytes] = self._annotations_path.open("wb")

    def __enter__(self) -> "_CocoFile":
        return self

    def __exit__(self, *_: object) -> None:
        for file, path in ((self._images, self._images_path), (self._annotations, self._annotations_path)):
            file.close()
            path.unlink(missing_ok=True)

    def add(self, line: dict[str, Any], labels: list[TrailLabel], runs: MaskRuns | None) -> None:
        """Write a frame and its labels, with the pixels of its mask where they are known."""
        image = {
            "id": line["frame"],
            "file_name": line["file"],
            "width": line["camera"]["width_px"],
            "height": line["camera"]["height_px"],
            "date_captured": line["utc_mid"],
        }
        _append(self._images, image, is_first=self._frames == 0)
        self._frames += 1
        for label in labels:
            self._annotation += 1
            pixels = {} if runs is None else runs.annotation(label.index)
            annotation = _annotation(label, self._annotation, line["frame"]) | pixels
            _append(self._annotations, annotation, is_first=self._annotation == 1)

    def finish(self) -> None:
        """Join the parts and publish the file."""
        head = {
            "info": {"description": "star trails with exact truth, drawn by glstar", "version": __version__},
            "licenses": [],
            "categories": [{"id": k + 1, "name": name, **_OF_CATEGORY} for k, name in enumerate(CATEGORIES)],
        }
        self._images.write(b'\n],\n"annotations": [\n')
        self._annotations.write(b"\n]}\n")
        self._annotations.close()
        self._images.close()
        joined = temporary_path(self._path)
        try:
            with joined.open("wb") as file:
                file.write(orjson.dumps(head)[:-1] + b',\n"images": [\n')
                for part in (self._images_path, self._annotations_path):
                    with part.open("rb") as content:
                        shutil.copyfileobj(content, file, 1 << 20)
            publish(joined, self._path)
        finally:
            joined.unlink(missing_ok=True)


def _append(file: IO[bytes], record: dict[str, Any], *, is_first: bool) -> None:
    file.write((b"" if is_first else b",\n") + orjson.dumps(record))


def _annotation(label: TrailLabel, number: int, frame: int) -> dict[str, Any]:
    keypoints: list[float] = []
    for (x, y), is_visible in zip(label.keypoints.tolist(), label.visible.tolist(), strict=True):
        keypoints += [round(x, _DIGITS), round(y, _DIGITS), 2] if is_visible else [0, 0, 0]
    return {
        "id": number,
        "image_id": frame,
        "category_id": CATEGORIES.index(label.category) + 1,
        "bbox": [round(value, _DIGITS) for value in label.bbox],
        "area": round(label.area_px2, _DIGITS),
        "iscrowd": 0,
        "segmentation": [polygon.round(_DIGITS).ravel().tolist() for polygon in label.polygons],
        "keypoints": keypoints,
        "num_keypoints": int(label.visible.sum()),
        **{key: label.entry[key] for key in COPIED if key in label.entry},
    }


def write_yolo(source: ConvertedSet, output: Path, *, least_snr: float) -> int:
    """Write the images and labels of an export for YOLO, and return the number of frames.

    `output` is a new directory with ``images/SPLIT``, ``labels/SPLIT`` and ``data.yaml``; images are hard links where
    the file system has them, else copies. Stars have a label from the signal-to-noise ratio `least_snr`. Raises
    ExportError if the directory exists, or the export cannot be read.
    """
    count = 0
    with new_directory(output) as folder:
        for split in source.splits:
            for kind in ("images", "labels"):
                (folder / kind / split).mkdir(parents=True)
        for split, line in source.frames():
            image = source.image(line)
            _link(image, folder / "images" / split / image.name)
            labels = labels_of(line, psf_sigma_px=source.psf_sigma_px, least_snr=least_snr)
            rows = "".join(f"{_row(label)}\n" for label in labels)
            (folder / "labels" / split / f"{image.stem}.txt").write_text(rows, encoding="utf-8", newline="\n")
            count += 1
        (folder / "data.yaml").write_text(_index(source.splits), encoding="utf-8", newline="\n")
    return count


def _row(label: TrailLabel) -> str:
    """Return class, centre, width and height, in fractions of the image."""
    left, top, width, height = label.bbox
    columns, rows = label.size
    numbers = ((left + width / 2) / columns, (top + height / 2) / rows, width / columns, height / rows)
    return " ".join([str(CATEGORIES.index(label.category)), *(f"{number:.6f}" for number in numbers)])


def yolo_folders(splits: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the folder of each key of ``data.yaml``, and why it is not the folder of its split; empty if it is.

    Ultralytics needs ``train`` and ``val``, whatever the shares of the splits are.
    """
    own = {"train": "train", "val": "validation", "test": "test"}
    if NO_SPLIT in splits:
        return {"train": (NO_SPLIT, ""), "val": (NO_SPLIT, "the export is not split: do not choose a model by it")}
    found = {key: (split, "") for key, split in own.items() if split in splits}
    for key in ("train", "val"):
        if key not in found:
            other = next(split for split in ("test", "train", "validation") if split in splits)
            found[key] = other, f"there are no frames for {own[key]}: these are those of {other}"
    return {key: found[key] for key in own if key in found}


def _index(splits: Sequence[str]) -> str:
    lines = [
        f"{key}: images/{split}" + (f"  # {why}" if why else "") for key, (split, why) in yolo_folders(splits).items()
    ]
    return "\n".join([*lines, "names:", *(f"  {k}: {name}" for k, name in enumerate(CATEGORIES))]) + "\n"


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
