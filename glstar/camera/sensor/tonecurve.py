"""Tone curves: by name, by a number, or as points from a list, a text or a file."""

import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.system.userinput import is_number, read_text

Float = NDArray[np.float64]

# Names of tone curves, the default first.
GAMMAS: Final = ("linear", "srgb", "rpi")
# Tone curve of the Raspberry Pi HQ camera: (input, output) of 65535, linear between; libcamera, tuning file of the
# IMX477 for the older processor (BSD-2-Clause).
_RPI_CURVE: Final = (
    *((0, 0), (1024, 5040), (2048, 9338), (3072, 12356), (4096, 15312), (5120, 18051), (6144, 20790), (7168, 23193)),
    *((8192, 25744), (9216, 27942), (10240, 30035), (11264, 32005), (12288, 33975), (13312, 35815), (14336, 37600)),
    *((15360, 39168), (16384, 40642), (18432, 43379), (20480, 45749), (22528, 47753), (24576, 49621), (26624, 51253)),
    *((28672, 52698), (30720, 53796), (32768, 54876), (36864, 57012), (40960, 58656), (45056, 59954), (49152, 61183)),
    *((53248, 62355), (57344, 63419), (61440, 64476), (65535, 65535)),
)
# Values that a tone curve is applied to at once: 256 kB of float64.
_BLOCK: Final = 1 << 15
# (input, output) as fractions of full scale.
CurvePoints = tuple[tuple[float, float], ...]

_LARGEST_BYTES: Final = 2**24
# Key of libcamera's tuning files, whose list has inputs and outputs in turn, and their full scale.
_LIBCAMERA_KEY: Final = "gamma_curve"
_LIBCAMERA_FULL_SCALE: Final = 65535


def recorded_by(light: NDArray[Any], gamma: str | float, points: str = "") -> Float:
    """Return values after a tone curve.

    `light`: from 0 to 1; `gamma` {"linear", "srgb", "rpi"} or float: the name of a curve, or g for the light to the
    power of 1 / g; `points`: points of a curve as `curve_text` writes them; empty for `gamma`.  Returns: from 0 to 1,
    of the shape of `light`.
    """
    if points:
        given, toned = np.transpose(parse_curve(points))
        return np.asarray(np.interp(light, given, toned))
    if not isinstance(gamma, str):
        return np.asarray(light, dtype=np.float64) ** (1 / gamma)
    return _interpolated(light, _named_curve(gamma))


def light_before(recorded: NDArray[Any], gamma: str | float) -> Float:
    """Return the light that a tone curve records as some values: the inverse of `recorded_by`.

    `recorded`: from 0 to 1; `gamma` {"linear", "srgb", "rpi"} or float.  Returns: from 0 to 1, of the shape of
    `recorded`.
    """
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
    flat, found = values.ravel(), np.empty(values.size)
    for first in range(0, flat.size, _BLOCK):
        given = flat[first : first + _BLOCK].astype(np.float64)
        at = np.minimum((given * last).astype(np.intp), last)
        found[first : first + _BLOCK] = slopes[at] * (given - inputs[at]) + table[at]
    return found.reshape(values.shape)


def _equidistant() -> Float:
    return np.linspace(0, 1, 65536)


@lru_cache(maxsize=len(GAMMAS))
def _named_curve(gamma: str) -> Float:
    """Return a tone curve at equidistant inputs from 0 to 1."""
    x = _equidistant()
    if gamma == "srgb":  # IEC 61966-2-1
        return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    if gamma == "rpi":
        given, toned = np.transpose(_RPI_CURVE)
        return np.asarray(np.interp(65535 * x, given, toned) / 65535)
    return x


def is_curve_text(text: str) -> bool:
    """Return whether a text holds points, ``"0,0;0.5,0.7;1,1"``, rather than the name of a file."""
    return ";" in text


def curve_text(points: CurvePoints) -> str:
    """Return points as text.

    `points` tuple of (float, float).  Returns: such as ``"0,0;0.5,0.7;1,1"``, of eight digits.
    """
    return ";".join(f"{given:.8g},{toned:.8g}" for given, toned in points)


@lru_cache(maxsize=8)
def parse_curve(text: str) -> CurvePoints:
    """Return the points of a text.

    `text`: as `curve_text` writes it.  Returns: tuple of (float, float).  Raises ValueError if they are no tone curve;
    the message continues "KEY: ".
    """
    return checked_points([row.split(",") for row in text.split(";") if row.strip()])


def read_curve(path: Path) -> CurvePoints:
    """Return the points of a file.

    `path`: CSV with a column of inputs and one of outputs; JSON with a list of [input, output]; or a tuning file of
    libcamera, whose ``gamma_curve`` has inputs and outputs of 65535 in turn.  Returns: tuple of (float, float).  Raises
    ValueError if it cannot be read, or holds no tone curve; the message continues "KEY: ".
    """
    try:
        text = read_text(path, _LARGEST_BYTES)
        return checked_points(_rows_of_json(text) if path.suffix.lower() == ".json" else _rows_of_csv(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def checked_points(rows: Sequence[Any]) -> CurvePoints:
    """Return rows of two numbers as points of a tone curve.

    `rows`: fractions of full scale.  Returns: tuple of (float, float).  Raises ValueError if one is no pair of
    fractions, there are fewer than two, or the curve falls; the message continues "KEY: ".
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
        given, toned = row
        point = float(given), float(toned)
    except (TypeError, ValueError):
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
    content = json.loads(text)
    for curve in _found(content):
        if not isinstance(curve, list) or len(curve) % 2:
            raise ValueError(f"its {_LIBCAMERA_KEY} is no list of inputs and outputs in turn")
        fractions = [value / _LIBCAMERA_FULL_SCALE for value in curve]
        return list(zip(fractions[::2], fractions[1::2], strict=True))
    if isinstance(content, list):
        return content
    raise ValueError("is no list of [input, output], and has no gamma_curve of libcamera")


def _found(content: Any) -> Iterator[Any]:
    """Yield the values of the key of libcamera's curve, at any depth."""
    if isinstance(content, dict) and _LIBCAMERA_KEY in content:
        yield content[_LIBCAMERA_KEY]
    inner = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    for value in inner:
        yield from _found(value)
