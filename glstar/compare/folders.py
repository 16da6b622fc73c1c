"""Comparison of two folders of images, real and simulated, without a flight.

Trails are detected in the simulated images.  If the simulated folder is an export of glstar, its truth identifies the
stars; otherwise they stay unidentified.
"""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.compare.comparison import Collector, ComparedImage, Comparison, rejection
from glstar.compare.detection import SubtractedImage, subtract_background
from glstar.compare.pairs import measure, pair_trails
from glstar.compare.prediction import Trails, trail_jacobian
from glstar.errors import ImagesError
from glstar.images import read_grey
from glstar.images.times import BESIDE, TABLES, TRUTH, json_lines, truth_files
from glstar.render.truth.frame import as_current_schema

# Detection thresholds in units of the noise: the peak of a trail, and its other pixels.
_PEAK_SIGNAL, _EDGE_SIGNAL = 6.0, 3.0
# Standard deviation of stars, px, because that of the folder is unknown: typical of well focused lenses.
_USUAL_SIGMA_PX = 1.3
_MIN_PIXELS = 5
# Number of points of a straight path.
_POINTS = 40
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


def paired_files(real: Sequence[Path], simulated: Sequence[Path]) -> tuple[list[tuple[Path, Path]], list[Path]]:
    """Return pairs of a real and a simulated image, and the real images without a simulated one.

    Two images are a pair if their names without suffix are equal, or else the last numbers in their names.
    """
    by_name = {path.stem: path for path in simulated}
    by_number: dict[int, list[Path]] = {}
    for path in simulated:
        number = _number(path)
        if number is not None:
            by_number.setdefault(number, []).append(path)
    pairs, alone = [], []
    for path in real:
        number = _number(path)
        same = by_number.get(number, []) if number is not None else []
        partner = by_name.get(path.stem) or (same[0] if len(same) == 1 else None)
        if partner is None:
            alone.append(path)
        else:
            pairs.append((path, partner))
    return pairs, alone


def compare_folders(
    real: Sequence[Path],
    simulated: Path,
    *,
    search_px: float = 20.0,
    least_signal: float = 10.0,
    most_stars: int = 60,
    on_step: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Compare real images with the simulated ones of a folder.

    `real`: image files; `simulated`: a folder; `search_px`: the largest shift of an image, px; `least_signal`: smallest
    signal-to-noise ratio of a whole trail; `most_stars`: largest number of stars per image; `on_step`: called with the
    number of images done, and of all.  Raises ImagesError if the folder holds no image, or no star could be paired.
    """
    report = on_step or (lambda *_: None)
    pairs, alone = paired_files(real, image_files(simulated))
    truth = _truth_of(simulated)
    collected = Collector()
    for path in alone:
        collected.reject(path.name, "without a counterpart", f"{simulated} holds no image of this name or number")
    for done, (path, counterpart) in enumerate(pairs):
        try:
            sky, drawn = _opened(path, counterpart)
        except ImagesError as error:
            collected.reject(path.name, "broken or not alike", str(error).removeprefix(f"{path}: "))
        else:
            trails = _trails_on(drawn, truth.get(counterpart.name), sky.usual_noise_dn, least_signal, most_stars)
            _compare_image(collected, path.name, sky, trails, search_px)
        report(done + 1, len(pairs))
    return collected.result(None, "not used; images paired by name or number", simulated)


def _compare_image(collected: Collector, name: str, sky: SubtractedImage, trails: Trails, search_px: float) -> None:
    """Find the simulated trails on a real image, and add its pairs or the reason why it cannot be compared."""
    pairing = pair_trails(sky, trails, search_px=min(search_px, 0.4 * min(sky.above_dn.shape)))
    reason = rejection(pairing, sky)
    if reason is not None:
        collected.reject(name, *reason)
        return
    found = len(pairing.found_indices)
    compared = ComparedImage(name, None, len(trails), found, pairing.astray, trails.blended, trails.cut_off, None)
    collected.add(compared, measure(name, sky, pairing))


def image_files(folder: Path) -> list[Path]:
    """Return the image files of a folder, sorted by name, without the noiseless images and the masks of an export.

    Raises ImagesError if there is no such folder, or no image in it.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file())
    except OSError as error:
        raise ImagesError(folder, f"is not a folder of images: {error.strerror or error}") from error
    files = [path for path in files if not BESIDE.search(path.name) and path.name not in (*TABLES, TRUTH)]
    if not files:
        raise ImagesError(folder, "holds no image; choose a folder of PNG, JPEG or TIFF files")
    return files


def _number(path: Path) -> int | None:
    digits = re.findall(r"\d+", path.stem)
    return int(digits[-1]) if digits else None


def _opened(real: Path, simulated: Path) -> tuple[SubtractedImage, SubtractedImage]:
    """Return a real and a simulated image without their backgrounds; raises ImagesError if size or depth differ."""
    first, second = read_grey(real), read_grey(simulated)
    if first.shape != second.shape:
        (h, w), (height, width) = first.shape, second.shape
        raise ImagesError(real, f"is {w} x {h} px and {simulated.name} {width} x {height} px")
    if first.dtype != second.dtype:
        bits, other_bits = first.dtype.itemsize * 8, second.dtype.itemsize * 8
        raise ImagesError(real, f"is of {bits} bits and {simulated.name} of {other_bits}")
    saturation_dn = float(np.iinfo(first.dtype).max)
    return (
        subtract_background(first, saturation_dn=saturation_dn),
        subtract_background(second, saturation_dn=saturation_dn),
    )


def _truth_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of an export's truth by file name, in the current schema; none without a truth file."""
    truth: dict[str, dict[str, Any]] = {}
    for path in truth_files(folder):
        with suppress(OSError, ValueError):
            for line in json_lines(path):
                with suppress(ValueError, KeyError, TypeError):
                    frame = as_current_schema(line)
                    truth[frame["file"]] = frame
    return truth


def _trails_on(
    drawn: SubtractedImage, truth: dict[str, Any] | None, noise_dn: float, least_signal: float, most: int
) -> Trails:
    """Return the trails detected on a simulated image, identified by its truth if there is one."""
    significance = drawn.significance(_USUAL_SIGMA_PX)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats((significance > _EDGE_SIGNAL).astype(np.uint8))
    height, width = significance.shape
    paths, signals = list[Float](), list[float]()
    cut_off = 0
    for label in range(1, count):
        left, top, wide, high, area = boxes[label]
        if area < _MIN_PIXELS:
            continue
        box = slice(top, top + high), slice(left, left + wide)
        inside = labels[box] == label
        if significance[box][inside].max() < _PEAK_SIGNAL:
            continue
        if left < 8 or top < 8 or left + wide > width - 8 or top + high > height - 8:
            cut_off += 1
            continue
        light = np.where(inside, drawn.above_dn[box], 0).clip(min=0).astype(np.float64)
        signals.append(float(np.sqrt(np.sum(light**2))) / noise_dn)
        paths.append(_line_through(light) + np.array([left, top]))
    signal = np.array(signals)
    order = np.argsort(-signal, kind="stable")
    order = order[signal[order] >= least_signal][:most]
    path = np.stack([paths[k] for k in order], axis=1) if len(order) else np.zeros((_POINTS, 0, 2))
    star_id, name, vmag = _named(path, truth["stars"] if truth else ())
    trails = Trails(
        catalogue=truth["catalogue"] if truth else "",
        star_id=star_id,
        name=name,
        vmag=vmag,
        path_px=path,
        signal_dn=drawn.above_dn,
        pixels_dn=drawn.above_dn,
        headroom_dn=float(drawn.above_dn[drawn.usable].max(initial=1.0)),
        sigma_px=_USUAL_SIGMA_PX,
        jacobian=np.zeros((len(order), 4, 3)),
        signal_to_noise=signal[order],
        cut_off=cut_off,
    )
    # The motions are a shift and a rotation about the centre.
    fields = np.zeros((*path.shape, 3))
    fields[..., 0, 0] = fields[..., 1, 1] = 1.0
    fields[..., 0, 2] = -(path[..., 1] - height / 2)
    fields[..., 1, 2] = path[..., 0] - width / 2
    return replace(trails, jacobian=trail_jacobian(fields, trails))


def _line_through(light: Float) -> Float:
    """Return the straight line with the centroid, direction and length of a signal, (n, 2) px."""
    rows, columns = np.indices(light.shape, dtype=np.float64)
    total = light.sum()
    middle = np.array([(columns * light).sum(), (rows * light).sum()]) / total
    x, y = columns - middle[0], rows - middle[1]
    xx, xy, yy = (x * x * light).sum(), (x * y * light).sum(), (y * y * light).sum()
    (across, along), axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]) / total)
    # A uniform line of length L has the variance L^2 / 12; the star's width adds to both directions.
    length = np.sqrt(12 * max(along - across, 0.0))
    return np.asarray(middle + np.linspace(-0.5, 0.5, _POINTS)[:, np.newaxis] * length * axes[:, 1])


def _named(path_px: Float, stars: Sequence[dict[str, Any]]) -> tuple[NDArray[np.int32], tuple[str, ...], Float]:
    """Return numbers, names and magnitudes of the brightest stars within 3 px of the centres of paths, (n, k, 2)."""
    count = path_px.shape[1]
    star_id, vmag = np.zeros(count, dtype=np.int32), np.full(count, np.nan)
    positions = np.array([[star["centroid_x_px"], star["centroid_y_px"]] for star in stars], dtype=np.float64)
    for k in range(count if len(positions) else 0):
        distance_px = np.linalg.norm(positions - path_px[:, k].mean(axis=0), axis=-1)
        near = np.flatnonzero(distance_px < 3.0)
        if near.size:
            star = min((stars[int(n)] for n in near), key=lambda star: star["vmag"])
            star_id[k] = star["star_id"]
            vmag[k] = star["vmag"]
    return star_id, ("",) * count, vmag
