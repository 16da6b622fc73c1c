"""Answers of a navigator or star tracker: CSV or JSON lines, one answer per frame, with any subset of the fields.

================================  =====================================================================================
field                             meaning
================================  =====================================================================================
frame, or file                    the frame's number or its file name, as in the truth; required by ``glstar score``
utc                               UTC of the instant by the camera's clock, as in ``nav.jsonl``; for a live window
status                            ``solved`` (default) or ``refused``
instant                           time of the attitude: ``start``, ``middle`` (default) or ``end`` of the exposure
qw, qx, qy, qz                    q_camera_icrs: rotates ICRS components to camera ones (right, down, along the axis)
or ra_deg, dec_deg, roll_deg      ICRS direction of the optical axis; position angle of the image's up, east of north
latitude_deg, longitude_deg       WGS84
ellipse_major_km,                 semi-axes of the stated error ellipse, and the azimuth of the major one, deg from
ellipse_minor_km,                 north through east; ellipse_confidence is its stated probability (0.95)
ellipse_azimuth_deg
time_ms                           run time of the solver
stars                             JSON only: a list of [x_px, y_px, star_id]; star_id null if it is not identified
stars_at                          points of the trails: flux ``centroid`` (default), ``start``, ``middle``, ``end``
================================  =====================================================================================
"""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import hypot, isfinite, log1p, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import AnswersError, GlstarError
from glstar.rotation import about_y, about_z, matrix_from_quaternion
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import read_text

INSTANTS = ("start", "middle", "end")
_QUATERNION = ("qw", "qx", "qy", "qz")
_BORESIGHT = ("ra_deg", "dec_deg", "roll_deg")
_POSITION = ("latitude_deg", "longitude_deg")
_ELLIPSE = ("ellipse_major_km", "ellipse_minor_km", "ellipse_azimuth_deg")
_SINGLE = frozenset({"frame", "file", "utc", "status", "instant", "ellipse_confidence", "time_ms", "stars", "stars_at"})
_FIELDS = _SINGLE.union(_QUATERNION, _BORESIGHT, _POSITION, _ELLIPSE)
# Tolerance of a quaternion's length: its error if the components are rounded to four decimals.
_UNIT_TOLERANCE = 1e-3
_NO_FRAME = "does not say which frame it answers"
# Largest answer file, bytes: lists of stars for 100 000 frames.
_MOST_BYTES = 2_000_000_000


@dataclass(frozen=True, slots=True)
class ErrorEllipse:
    """The error ellipse that a navigator states for a position."""

    major_km: float  # Semi-axis
    minor_km: float  # Semi-axis
    azimuth_rad: float  # Of the major axis, rad from north through east
    confidence: float  # Probability that the ellipse states, 0 to 1

    @property
    def sigma_km(self) -> float:
        """Standard deviation of each component of a normal distribution, km: the root mean square of both axes.

        The ellipse of probability p has semi-axes of sqrt(-2 ln(1 - p)) standard deviations.
        """
        return hypot(self.major_km, self.minor_km) / sqrt(2) / sqrt(-2 * log1p(-self.confidence))

    def contains(self, north_km: float, east_km: float) -> bool:
        """Whether an error lies inside."""
        along = north_km * np.cos(self.azimuth_rad) + east_km * np.sin(self.azimuth_rad)
        across = -north_km * np.sin(self.azimuth_rad) + east_km * np.cos(self.azimuth_rad)
        return bool(hypot(along / self.major_km, across / self.minor_km) <= 1)


@dataclass(frozen=True, slots=True, eq=False)
class ObservedStars:
    """Stars that a navigator found on an image."""

    xy_px: Float  # (n, 2) positions (x, y), px
    star_id: NDArray[np.int64]  # (n,) int64: numbers in the catalogue of the truth; -1 if a star is not identified
    at: str  # {"centroid", "start", "middle", "end"}: the point of the star trails that the positions refer to


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A navigator's answer for one frame."""

    line: int  # Line of the file, from 1
    frame: int | None  # The frame's number; None if the answer names its file instead
    file: str | None
    solved: bool  # False if the navigator refused to answer
    instant: str  # {"start", "middle", "end"}: the time of the attitude
    C_camera_icrs: Float | None  # (3, 3) or None
    latitude_rad: float | None
    longitude_rad: float | None
    ellipse: ErrorEllipse | None
    stars: ObservedStars | None
    run_time_s: float | None
    utc_s: float | None = None  # UTC of the attitude by the camera's clock, seconds since 1970


def attitude_of_boresight(ra_rad: float, dec_rad: float, roll_rad: float) -> Float:
    """Return the rotation from ICRS to a camera, (3, 3), with the optical axis at an ICRS direction.

    `roll_rad` is the position angle of the image's up (minus y), rad from north through east.
    """
    # First the axes along the boresight, east and north, then the camera's right, down and forward.
    C_sight_icrs = about_y(-dec_rad) @ about_z(ra_rad)
    C_camera_sight = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    turned: Float = about_z(-roll_rad) @ C_camera_sight @ C_sight_icrs
    return turned


def read_answers(path: Path) -> list[Answer]:
    """Read a file of answers: CSV with a header, or JSON lines.

    Raises AnswersError if the file cannot be read, or a line is not a valid answer; it names the line and the field.
    """
    text = _content(path)
    rows = _json_rows(path, text) if text.lstrip()[:1] in {"{", "["} else _csv_rows(path, text)
    answers = [_answer(path, line, row) for line, row in rows]
    if not answers:
        raise AnswersError(path, "holds no answers: write one line for each frame")
    seen: dict[int | str | None, int] = {}
    for answer in answers:
        key = answer.file if answer.frame is None else answer.frame
        if key is None:
            raise AnswersError(path, f"line {answer.line} {_NO_FRAME}: give frame or file")
        if key in seen:
            raise AnswersError(path, f"answers frame {key} twice, in lines {seen[key]} and {answer.line}")
        seen[key] = answer.line
    return answers


def parse_answer(source: Path, line: int, text: str) -> Answer:
    """Read one JSON line; raises AnswersError, which names the `source` and the number of the `line` from 1."""
    return _answer(source, line, _json_row(source, line, text))


def _content(path: Path) -> str:
    try:
        return read_text(path, _MOST_BYTES)
    except ValueError as error:
        raise AnswersError(path, str(error).removeprefix(f"{path}: ")) from error


def _json_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        yield number, _json_row(path, number, line)


def _json_row(path: Path, number: int, line: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except ValueError as error:
        raise AnswersError(path, f"line {number} is no JSON: {error}") from error
    if not isinstance(row, dict):
        raise AnswersError(path, f"line {number} holds no object; write one for each frame")
    return {key: value for key, value in row.items() if value is not None}


def _csv_rows(path: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text))
    for row in reader:
        if None in row:
            raise AnswersError(path, f"line {reader.line_num} has more fields than the header")
        yield reader.line_num, {key.strip(): value.strip() for key, value in row.items() if value and value.strip()}


def _answer(path: Path, line: int, row: Mapping[str, Any]) -> Answer:
    """Return the answer of a row."""
    fields = _Row(path, line, row)
    if unknown := sorted(row.keys() - _FIELDS):
        names = ", ".join(sorted(_FIELDS))
        raise AnswersError(path, f"line {line}: {unknown[0]!r} is no field of an answer; fields are {names}")
    if not row.keys() & {"frame", "file", "utc"}:
        raise AnswersError(path, f"line {line} {_NO_FRAME}: give frame or file, or utc for a live window")
    latitude, longitude = fields.group(_POSITION) or (None, None)
    stars = row.get("stars")
    return Answer(
        line,
        fields.whole_number("frame") if "frame" in row else None,
        str(row["file"]) if "file" in row and "frame" not in row else None,
        solved=fields.choice("status", ("solved", "refused")) == "solved",
        instant=fields.choice("instant", ("middle", "start", "end")),
        C_camera_icrs=_attitude(fields),
        latitude_rad=None if latitude is None else float(np.deg2rad(latitude)),
        longitude_rad=None if longitude is None else float(np.deg2rad(longitude)),
        ellipse=_ellipse(fields),
        stars=None if stars is None else _stars(fields, stars),
        run_time_s=fields.number("time_ms") / 1000 if "time_ms" in row else None,
        utc_s=fields.utc_s("utc") if "utc" in row else None,
    )


class _Row:
    """The fields of one row, read with messages that name the line."""

    def __init__(self, path: Path, line: int, row: Mapping[str, Any]) -> None:
        self._path, self._line, self._row = path, line, row

    def has(self, name: str) -> bool:
        return name in self._row

    def error(self, message: str) -> AnswersError:
        return AnswersError(self._path, f"line {self._line}: {message}")

    def number(self, name: str) -> float:
        try:
            number = float(self._row[name])
        except (TypeError, ValueError):
            raise self.error(f"{name} is {self._row[name]!r}, not a number") from None
        if not isfinite(number):
            raise self.error(f"{name} is {self._row[name]!r}, not a finite number")
        return number

    def whole_number(self, name: str) -> int:
        number = self.number(name)
        if number != int(number) or number < 0:
            raise self.error(f"{name} is {self._row[name]!r}, not a whole number from 0")
        return int(number)

    def utc_s(self, name: str) -> float:
        try:
            return parse_utc(str(self._row[name]))
        except (ValueError, GlstarError):
            raise self.error(f"{name} is {self._row[name]!r}, not a UTC such as 2024-03-10T11:00:00.25Z") from None

    def choice(self, name: str, choices: tuple[str, ...]) -> str:
        chosen = str(self._row.get(name, choices[0]))
        if chosen not in choices:
            raise self.error(f"{name} is {chosen!r}; it is one of {', '.join(sorted(choices))}")
        return chosen

    def group(self, names: tuple[str, ...]) -> list[float] | None:
        """Return a group of numbers; None if all of them are missing."""
        missing = [name for name in names if name not in self._row]
        if len(missing) == len(names):
            return None
        if missing:
            raise self.error(f"{missing[0]} is missing beside {next(n for n in names if n in self._row)}")
        return [self.number(name) for name in names]


def _attitude(fields: _Row) -> Float | None:
    quaternion, boresight = fields.group(_QUATERNION), fields.group(_BORESIGHT)
    if quaternion and boresight:
        raise fields.error("gives the attitude twice: a quaternion and a boresight; leave one of them out")
    if quaternion:
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1) > _UNIT_TOLERANCE:
            raise fields.error(f"the quaternion has length {length:.4f}, not 1")
        return matrix_from_quaternion(np.array(quaternion) / length)
    if boresight:
        if abs(boresight[1]) > 90:
            raise fields.error(f"dec_deg is {boresight[1]:g}, beyond the pole")
        return attitude_of_boresight(*(float(angle) for angle in np.deg2rad(boresight)))
    return None


def _ellipse(fields: _Row) -> ErrorEllipse | None:
    axes = fields.group(_ELLIPSE)
    if axes is None:
        return None
    if min(axes[:2]) <= 0:
        raise fields.error(f"an error ellipse has semi-axes above 0 km, not {axes[0]:g} and {axes[1]:g}")
    confidence = fields.number("ellipse_confidence") if fields.has("ellipse_confidence") else 0.95
    if not 0 < confidence < 1:
        raise fields.error(f"ellipse_confidence is {confidence:g}, not between 0 and 1")
    return ErrorEllipse(axes[0], axes[1], float(np.deg2rad(axes[2])), confidence)


def _stars(fields: _Row, stars: object) -> ObservedStars:
    at = fields.choice("stars_at", ("centroid", *INSTANTS))
    try:
        rows = [(float(x), float(y), -1 if star_id is None else int(star_id)) for x, y, star_id in stars]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise fields.error("stars are a list of [x_px, y_px, star_id], star_id null where unknown") from None
    table = np.array([row[:2] for row in rows], dtype=np.float64).reshape(-1, 2)
    return ObservedStars(table, np.array([row[2] for row in rows], dtype=np.int64), at)
