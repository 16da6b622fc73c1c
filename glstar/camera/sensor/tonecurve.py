"""Tone curves: by name, by a number, or as points from a list, a text or a file."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.system.userinput import is_number, read_json, read_text

# Names of tone curves, the default first.
GAMMAS = ("linear", "srgb", "rpi")
# Tone curve of the Raspberry Pi HQ camera, of 65535, linear between; libcamera, tuning file of the
# IMX477 for the older processor (BSD-2-Clause).
_RPI_INPUTS = (*range(0, 16384, 1024), *range(16384, 32768, 2048), *range(32768, 65535, 4096), 65535)
_RPI_OUTPUTS = (
    (0, 5040, 9338, 12356, 15312, 18051, 20790, 23193, 25744, 27942, 30035, 32005, 33975, 35815, 37600, 39168),
    (40642, 43379, 45749, 47753, 49621, 51253, 52698, 53796),
    (54876, 57012, 58656, 59954, 61183, 62355, 63419, 64476, 65535),
)
# Values that a tone curve is applied to at once: 256 kB of float64.
_BLOCK = 1 << 15
# (input, output) as fractions of full scale.
CurvePoints = tuple[tuple[float, float], ...]

_LARGEST_BYTES = 2**24
# Key of libcamera's tuning files, whose list has inputs and outputs in turn, and their full scale.
_LIBCAMERA_KEY = "gamma_curve"
_LIBCAMERA_FULL_SCALE = 65535


def recorded_by(light: NDArray[Any], gamma: str | float, points: str = "") -> Float:
    """Return values from 0 to 1, of any shape, after a tone curve, from 0 to 1.

    `gamma` is the name of a curve, or g for the light to the power of 1 / g; `points` of `curve_text` replace it.
    """
    if points:
        inputs, outputs = np.transpose(parse_curve(points))
        return np.asarray(np.interp(light, inputs, outputs))
    if not isinstance(gamma, str):
        return np.asarray(light, dtype=np.float64) ** (1 / gamma)
    return _interpolated(light, _named_curve(gamma))


def light_before(recorded: NDArray[Any], gamma: str | float) -> Float:
    """Return the light, from 0 to 1, that a tone curve records as some values: the inverse of `recorded_by`."""
    if not isinstance(gamma, str):
        return np.asarray(recorded, dtype=np.float64) ** gamma
    return np.asarray(np.interp(recorded, _named_curve(gamma), _equidistant()))


def _interpolated(values: NDArray[Any], table: Float) -> Float:
    """Return what `numpy.interp` does of values from 0 to 1 in a table at equidistant inputs, in a quarter of its time.

    An index replaces the binary search, in blocks that stay in the cache of the processor.  The product of a float32
    and the number of steps is exact in float64, so that the index is too.
    """
    last = len(table) - 1
    inputs = np.linspace(0, 1, len(table))
    slopes = np.append(np.diff(table) / np.diff(inputs), 0.0)
    flat = values.ravel()
    interpolated = np.empty(values.size)
    for first in range(0, flat.size, _BLOCK):
        block = flat[first : first + _BLOCK].astype(np.float64)
        at = np.minimum((block * last).astype(np.intp), last)
        interpolated[first : first + _BLOCK] = slopes[at] * (block - inputs[at]) + table[at]
    return interpolated.reshape(values.shape)


def _equidistant() -> Float:
    return np.linspace(0, 1, 65536)


@lru_cache(maxsize=len(GAMMAS))
def _named_curve(gamma: str) -> Float:
    """Return a tone curve at equidistant inputs from 0 to 1."""
    x = _equidistant()
    if gamma == "srgb":  # IEC 61966-2-1
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    if gamma == "rpi":
        return np.asarray(np.interp(65535 * x, _RPI_INPUTS, np.concatenate(_RPI_OUTPUTS)) / 65535)
    return x


def is_curve_text(text: str) -> bool:
    """Return whether a text holds points, ``"0,0;0.5,0.7;1,1"``, rather than the name of a file."""
    return ";" in text


def curve_text(points: CurvePoints) -> str:
    """Return points as text of eight digits, such as ``"0,0;0.5,0.7;1,1"``."""
    return ";".join(f"{x:.8g},{y:.8g}" for x, y in points)


@lru_cache(maxsize=8)
def parse_curve(text: str) -> CurvePoints:
    """Return the points of a text of `curve_text`.

    Raises ValueError if they are no tone curve; the message continues "KEY: ".
    """
    return checked_points([row.split(",") for row in text.split(";") if row.strip()])


def read_curve(path: Path) -> CurvePoints:
    """Return the points of a file.

    It is CSV with a column of inputs and one of outputs; JSON with a list of [input, output]; or a tuning file of
    libcamera, whose ``gamma_curve`` has inputs and outputs of 65535 in turn.  Raises ValueError if it cannot be read,
    or holds no tone curve; the message continues "KEY: ".
    """
    try:
        text = read_text(path, _LARGEST_BYTES)
        return checked_points(_rows_of_json(text) if path.suffix.lower() == ".json" else _rows_of_csv(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def checked_points(rows: Sequence[Any]) -> CurvePoints:
    """Return rows of two fractions of full scale as points of a tone curve.

    Raises ValueError if one is no pair of fractions, there are fewer than two, or the curve falls; the message
    continues "KEY: ".
    """
    points = tuple(map(_point, rows))
    if len(points) < 2:
        raise ValueError(f"needs two points or more, not {len(points)}")
    for before, point in pairwise(points):
        if point[0] <= before[0] or point[1] < before[1]:
            raise ValueError(
                f"inputs must increase and outputs must not decrease, but {_shown(point)} follows {_shown(before)}"
            )
    return points


def _point(row: Any) -> tuple[float, float]:
    try:
        x, y = row
        point = float(x), float(y)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{row!s:.40} is no pair of numbers, [input, output]") from None
    if not all(0 <= value <= 1 for value in point):
        raise ValueError(f"{_shown(point)} is no pair of fractions from 0 to 1: divide by full scale")
    return point


def _shown(point: tuple[float, float]) -> str:
    return f"[{point[0]:.8g}, {point[1]:.8g}]"


def _rows_of_csv(text: str) -> list[list[str]]:
    """Return the rows of a CSV file with commas, semicolons, tabs or spaces, without its header and comments."""
    rows = [line.replace(";", " ").replace(",", " ").split() for line in text.splitlines()]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    return rows[1:] if rows and not is_number(rows[0][0]) else rows


def _rows_of_json(text: str) -> list[Any]:
    content = read_json(text)
    for curve in _libcamera_curves(content):
        try:
            fractions = [value / _LIBCAMERA_FULL_SCALE for value in curve]
        except (TypeError, OverflowError):  # an integer of hundreds of digits is none of 16 bits
            fractions = [0.0]
        if len(fractions) % 2:
            raise ValueError(f"its {_LIBCAMERA_KEY} is no list of inputs and outputs in turn")
        return list(zip(fractions[::2], fractions[1::2], strict=True))
    if isinstance(content, list):
        return content
    raise ValueError("is no list of [input, output], and has no gamma_curve of libcamera")


def _libcamera_curves(content: Any) -> Iterator[Any]:
    """Yield the values of the key of libcamera's curve, at any depth."""
    if isinstance(content, dict) and _LIBCAMERA_KEY in content:
        yield content[_LIBCAMERA_KEY]
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    for value in inner:
        yield from _libcamera_curves(value)
