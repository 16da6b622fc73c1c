"""Tone curves as points: from a list, a text, or a file."""

import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from glstar.system.inputfile import read_text

__all__ = ["CurvePoints", "checked_points", "curve_text", "is_curve_text", "parse_curve", "read_curve"]

# (input, output) as fractions of full scale.
CurvePoints = tuple[tuple[float, float], ...]

_LARGEST_BYTES: Final = 2**24
# Key of libcamera's tuning files, whose list has inputs and outputs in turn, and their full scale.
_LIBCAMERA_KEY: Final = "gamma_curve"
_LIBCAMERA_FULL_SCALE: Final = 65535


def is_curve_text(text: str) -> bool:
    """Return whether a text holds points, ``"0,0;0.5,0.7;1,1"``, rather than the name of a file.

    Parameters
    ----------
    text : str

    Returns
    -------
    bool
    """
    return ";" in text


def curve_text(points: CurvePoints) -> str:
    """Return points as text.

    Parameters
    ----------
    points : tuple of (float, float)

    Returns
    -------
    str
        Such as ``"0,0;0.5,0.7;1,1"``, of eight digits.
    """
    return ";".join(f"{given:.8g},{toned:.8g}" for given, toned in points)


@lru_cache(maxsize=8)
def parse_curve(text: str) -> CurvePoints:
    """Return the points of a text.

    Parameters
    ----------
    text : str
        As `curve_text` writes it.

    Returns
    -------
    tuple of (float, float)

    Raises
    ------
    ValueError
        If they are no tone curve; the message continues "KEY: ".
    """
    return checked_points([row.split(",") for row in text.split(";") if row.strip()])


def read_curve(path: Path) -> CurvePoints:
    """Return the points of a file.

    Parameters
    ----------
    path : Path
        CSV with a column of inputs and one of outputs; JSON with a list of [input, output]; or a tuning file of
        libcamera, whose ``gamma_curve`` has inputs and outputs of 65535 in turn.

    Returns
    -------
    tuple of (float, float)

    Raises
    ------
    ValueError
        If it cannot be read, or holds no tone curve; the message continues "KEY: ".
    """
    try:
        text = read_text(path, _LARGEST_BYTES)
        return checked_points(_rows_of_json(text) if path.suffix.lower() == ".json" else _rows_of_csv(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def checked_points(rows: Sequence[Any]) -> CurvePoints:
    """Return rows of two numbers as points of a tone curve.

    Parameters
    ----------
    rows : sequence of [input, output]
        Fractions of full scale.

    Returns
    -------
    tuple of (float, float)

    Raises
    ------
    ValueError
        If one is no pair of fractions, there are fewer than two, or the curve falls; the message continues "KEY: ".
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
    return rows[1:] if rows and not _is_number(rows[0][0]) else rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
