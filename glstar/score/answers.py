"""Answers of a navigator or star tracker: CSV or JSON lines, one answer per frame, with any subset of the fields.

================================  =====================================================================================
field                             meaning
================================  =====================================================================================
frame, or file                    the frame's number or its file name, as in the truth; required by ``glstar score``
utc                               UTC of the instant by the camera's clock, as in ``nav.jsonl``; for a live window
status                            ``solved`` (default) or ``refused``; what answers nothing counts as refused
replaces                          whether it takes the place of an earlier answer to the same frame; otherwise the first
                                  one counts
instant                           time of the attitude: ``start``, ``middle`` (default) or ``end`` of the exposure
qw, qx, qy, qz                    q_camera_icrs: rotates ICRS components to camera ones (right, down, along the axis)
or ra_deg, dec_deg, roll_deg      ICRS direction of the optical axis; position angle of the image's up, east of north
latitude_deg, longitude_deg       WGS84; longitudes are taken modulo 360 deg
ellipse_major_km,                 semi-axes of the stated error ellipse, and the azimuth of the major one, deg from
ellipse_minor_km,                 north through east; ellipse_confidence is its stated probability (0.95)
ellipse_azimuth_deg
time_ms                           run time of the solver
stars                             JSON only: a list of [x_px, y_px, star_id]; star_id null if it is not identified; of a
                                  star that is listed twice the first counts
stars_at                          points of the trails: flux ``centroid`` (default), ``start``, ``middle``, ``end``
================================  =====================================================================================

A line that is no valid answer is no answer: it is reported, and the others count.
"""

import csv
import io
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from math import hypot, inf, isfinite, log1p, radians, remainder, sqrt, tau
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import AnswersError, GlstarError
from glstar.rotation import about_y, about_z, matrix_from_quaternion
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import read_json_line, read_text, refuse_repeated

INSTANTS = ("start", "middle", "end")
_QUATERNION = ("qw", "qx", "qy", "qz")
_BORESIGHT = ("ra_deg", "dec_deg", "roll_deg")
_POSITION = ("latitude_deg", "longitude_deg")
_ELLIPSE = ("ellipse_major_km", "ellipse_minor_km", "ellipse_azimuth_deg")
_SINGLE = frozenset(
    {"frame", "file", "utc", "status", "instant", "replaces", "ellipse_confidence", "time_ms", "stars", "stars_at"}
)
_FIELDS = _SINGLE.union(_QUATERNION, _BORESIGHT, _POSITION, _ELLIPSE)
# Tolerance of a quaternion's length: its error if the components are rounded to four decimals.
_UNIT_TOLERANCE = 1e-3
_NO_FRAME = "does not say which frame it answers"
# Largest answer file, bytes: lists of stars for 100 000 frames; and the longest line, characters: 20 000 stars.
_MOST_BYTES = 2_000_000_000
MOST_CHARACTERS = 1_000_000
# Largest number of a frame or a star: that of a 64-bit integer.
_LARGEST = 2**63 - 1
# Larger numbers are no angle, pixel or run time, and their squares overflow.
_LARGEST_NUMBER = 1e12
# Largest semi-axis of an error ellipse, km: the Earth's circumference; and the least probability of one.
_LARGEST_AXIS_KM, _LEAST_CONFIDENCE = 40_000.0, 1e-4
# An answer may state the UTC of any instant of its exposure, by a clock that is off by no more than this, s.
_CLOCK_TOLERANCE_S = 1.0
# Longitudes beyond two turns are those of other units, deg.
_LARGEST_LONGITUDE_DEG = 720.0


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

    @property
    def identifies(self) -> bool:
        """Whether a star is identified."""
        return bool((self.star_id >= 0).any())


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A navigator's answer for one frame."""

    line: int  # Line of the file, from 1
    frame: int | None  # The frame's number; None if the answer names only its file, or its time
    file: str | None
    solved: bool  # False if the navigator refused to answer, or answered nothing
    instant: str  # {"start", "middle", "end"}: the time of the attitude
    C_camera_icrs: Float | None  # (3, 3) or None
    latitude_rad: float | None
    longitude_rad: float | None
    ellipse: ErrorEllipse | None
    stars: ObservedStars | None
    run_time_s: float | None
    utc_s: float | None = None  # UTC of the attitude by the camera's clock, seconds since 1970
    replaces: bool = False  # Whether it takes the place of an earlier answer to the same frame

    @property
    def of(self) -> int | str | None:
        """The number of its frame, or else the file; None if it states its time only."""
        return self.file if self.frame is None else self.frame

    def contradiction(self, frame: int, file: str, mid_s: float, total_s: float) -> str | None:
        """Return how its file or its UTC by the camera's clock contradicts a frame; None if neither does."""
        if self.file is not None and self.file != file:
            return f"frame {frame} is {file}, not {self.file}"
        return self.clock_objection(frame, mid_s, total_s)

    def clock_objection(self, frame: int | str, mid_s: float, total_s: float) -> str | None:
        """Return how its UTC contradicts a frame of these times by the camera's clock, s; None if it does not."""
        late_s = 0.0 if self.utc_s is None else self.utc_s - mid_s
        if abs(late_s) <= total_s / 2 + _CLOCK_TOLERANCE_S:
            return None
        return f"its utc is {late_s:+.1f} s from the middle of frame {frame} by the camera's clock"


@dataclass(frozen=True, slots=True, eq=False)
class AnswerFile:
    """The answers of a file."""

    path: Path
    answers: tuple[Answer, ...]  # In the order of their lines; see `FirstAnswers` for several of one frame
    faults: tuple[str, ...]  # What is wrong with each of the other lines


class FirstAnswers:
    """The answers that count: the first to each frame, unless a later one replaces it."""

    def __init__(self) -> None:
        self._lines: dict[Hashable, int] = {}

    def objection(self, answer: Answer, frame: Hashable) -> str | None:
        """Return why an answer to a frame does not count, because of an earlier one; None if it counts."""
        first = self._lines.setdefault(frame, answer.line)
        if first == answer.line or answer.replaces:
            return None
        return (
            f"line {answer.line} answers frame {answer.of} again; line {first} counts, unless a later one says"
            ' "replaces": true'
        )


def attitude_of_boresight(ra_rad: float, dec_rad: float, roll_rad: float) -> Float:
    """Return the rotation from ICRS to a camera, (3, 3), with the optical axis at an ICRS direction.

    `roll_rad` is the position angle of the image's up (minus y), rad from north through east.
    """
    # First the axes along the boresight, east and north, then the camera's right, down and forward.
    C_sight_icrs = about_y(-dec_rad) @ about_z(ra_rad)
    C_camera_sight = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    turned: Float = about_z(-roll_rad) @ C_camera_sight @ C_sight_icrs
    return turned


def read_answers(path: Path) -> AnswerFile:
    """Read a file of answers: CSV with a header, or JSON lines.

    Raises AnswersError if the file cannot be read, or no line is a valid answer; it names the first fault, and its line
    and field.
    """
    text = _content(path)
    is_json = text.lstrip()[:1] in {"{", "["}
    answers: list[Answer] = []
    faults: list[str] = []
    for line, row in _json_rows(text) if is_json else _csv_rows(path, text):
        try:
            answer = _answer(path, line, _json_row(path, line, row) if is_json else _csv_row(path, line, row))
        except AnswersError as error:
            faults.append(_without_path(path, str(error)))
            continue
        if answer.of is None:
            faults.append(f"line {line} {_NO_FRAME}: give frame or file")
        else:
            answers.append(answer)
    if not answers:
        raise AnswersError(path, faults[0] if faults else "holds no answers: write one line for each frame")
    return AnswerFile(path, tuple(answers), tuple(faults))


def parse_answer(source: Path, line: int, text: str) -> Answer:
    """Read one JSON line; raises AnswersError, which names the `source` and the number of the `line` from 1."""
    return _answer(source, line, _json_row(source, line, text))


def _without_path(path: Path, message: str) -> str:
    """Return the message of an AnswersError without the path in front of it."""
    return message.removeprefix(f"{path}: ")


def _content(path: Path) -> str:
    try:
        return read_text(path, _MOST_BYTES)
    except ValueError as error:
        raise AnswersError(path, _without_path(path, str(error))) from error


def _json_rows(text: str) -> Iterator[tuple[int, Any]]:
    return ((number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip())


def _json_row(path: Path, number: int, line: str) -> dict[str, Any]:
    if len(line) > MOST_CHARACTERS:
        raise AnswersError(path, f"line {number} has {len(line)} characters; at most {MOST_CHARACTERS} are read")
    try:
        row = read_json_line(line)
    except ValueError as error:
        raise AnswersError(path, f"line {number} is no JSON: {error}") from error
    if not isinstance(row, dict):
        raise AnswersError(path, f"line {number} holds no object; write one for each frame")
    return {key: value for key, value in row.items() if value is not None}


def _csv_rows(path: Path, text: str) -> Iterator[tuple[int, Any]]:
    reader = csv.DictReader(io.StringIO(text, newline=""))
    try:
        refuse_repeated(map(str.strip, reader.fieldnames or ()))
        for row in reader:
            yield reader.line_num, row
    except csv.Error as error:
        raise AnswersError(path, f"line {reader.line_num + 1} is no CSV: {error}") from error
    except ValueError as error:
        raise AnswersError(path, str(error)) from error


def _csv_row(path: Path, number: int, row: dict[Any, Any]) -> dict[str, Any]:
    if None in row:
        raise AnswersError(path, f"line {number} has more fields than the header")
    return {key.strip(): value.strip() for key, value in row.items() if value and value.strip()}


def _answer(path: Path, line: int, row: Mapping[str, Any]) -> Answer:
    """Return the answer of a row."""
    fields = _Row(path, line, row)
    if unknown := sorted(row.keys() - _FIELDS):
        names = ", ".join(sorted(_FIELDS))
        raise fields.error(f"{unknown[0]!r} is no field of an answer; fields are {names}")
    if not row.keys() & {"frame", "file", "utc"}:
        raise AnswersError(path, f"line {line} {_NO_FRAME}: give frame or file, or utc for a live window")
    latitude_rad, longitude_rad = _position(fields) or (None, None)
    attitude, stars = _attitude(fields), _stars(fields)
    says_solved = fields.choice("status", ("solved", "refused")) == "solved"
    answers_something = attitude is not None or latitude_rad is not None or (stars is not None and stars.identifies)
    if says_solved and "status" in row and not answers_something:
        raise fields.error("says solved, but has neither an attitude nor a position nor identified stars")
    return Answer(
        line,
        fields.whole_number("frame") if "frame" in row else None,
        str(row["file"]) if "file" in row else None,
        solved=says_solved and answers_something,
        instant=fields.choice("instant", ("middle", "start", "end")),
        C_camera_icrs=attitude,
        latitude_rad=latitude_rad,
        longitude_rad=longitude_rad,
        ellipse=_ellipse(fields),
        stars=stars,
        run_time_s=_run_time_s(fields),
        utc_s=fields.utc_s("utc") if "utc" in row else None,
        replaces=fields.flag("replaces"),
    )


class _Row:
    """The fields of one row, read with messages that name the line."""

    def __init__(self, path: Path, line: int, row: Mapping[str, Any]) -> None:
        self._path, self._line, self._row = path, line, row

    def has(self, name: str) -> bool:
        return name in self._row

    def error(self, message: str) -> AnswersError:
        return AnswersError(self._path, f"line {self._line}: {message}")

    def number(self, name: str, largest: float = _LARGEST_NUMBER) -> float:
        try:
            number = float(self._row[name])
        except (TypeError, ValueError, OverflowError):
            raise self.error(f"{name} is {self._shown(name)}, not a number") from None
        if not isfinite(number) or isinstance(self._row[name], bool):
            raise self.error(f"{name} is {self._shown(name)}, not a finite number")
        if abs(number) > largest:
            raise self.error(f"{name} is {self._shown(name)}, beyond {largest:g}")
        return number

    def whole_number(self, name: str) -> int:
        number = self.number(name, inf)
        if number != int(number) or not 0 <= number <= _LARGEST:
            raise self.error(f"{name} is {self._shown(name)}, not a whole number from 0")
        return int(number)

    def flag(self, name: str) -> bool:
        value = self._row.get(name, False)
        if str(value).lower() not in {"true", "false"}:
            raise self.error(f"{name} is {self._shown(name)}; it is true or false")
        return str(value).lower() == "true"

    def _shown(self, name: str) -> str:
        """Return a value for a message, at most 60 characters of it."""
        text = repr(self._row[name])
        return text if len(text) <= 60 else f"{text[:60]}..."

    def utc_s(self, name: str) -> float:
        try:
            return parse_utc(str(self._row[name]))
        except (ValueError, GlstarError):
            raise self.error(f"{name} is {self._shown(name)}, not a UTC such as 2024-03-10T11:00:00.25Z") from None

    def choice(self, name: str, choices: tuple[str, ...]) -> str:
        chosen = str(self._row.get(name, choices[0]))
        if chosen not in choices:
            raise self.error(f"{name} is {self._shown(name)}; it is one of {', '.join(sorted(choices))}")
        return chosen

    def listed(self, name: str) -> list[Any]:
        value = self._row[name]
        if not isinstance(value, list):
            raise self.error(f"{name} is {self._shown(name)}, not a list, which JSON lines can hold")
        return value

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


def _position(fields: _Row) -> tuple[float, float] | None:
    """Return latitude and longitude, rad; longitude from -pi to pi."""
    position_deg = fields.group(_POSITION)
    if position_deg is None:
        return None
    latitude_deg, longitude_deg = position_deg
    if abs(latitude_deg) > 90:
        swapped = "; are latitude and longitude exchanged?" if abs(longitude_deg) <= 90 else ""
        raise fields.error(f"latitude_deg is {latitude_deg:g}, beyond the pole{swapped}")
    if abs(longitude_deg) > _LARGEST_LONGITUDE_DEG:
        raise fields.error(f"longitude_deg is {longitude_deg:g}, which is no longitude in degrees")
    return radians(latitude_deg), remainder(radians(longitude_deg), tau)


def _run_time_s(fields: _Row) -> float | None:
    if not fields.has("time_ms"):
        return None
    time_ms = fields.number("time_ms")
    if time_ms < 0:
        raise fields.error(f"time_ms is {time_ms:g}; a run time is not negative")
    return time_ms / 1000


def _ellipse(fields: _Row) -> ErrorEllipse | None:
    axes = fields.group(_ELLIPSE)
    if axes is None:
        if fields.has("ellipse_confidence"):
            raise fields.error("ellipse_confidence stands without an ellipse")
        return None
    if not fields.has("latitude_deg"):
        raise fields.error("an error ellipse stands without a position")
    if not 0 < min(axes[:2]) <= max(axes[:2]) <= _LARGEST_AXIS_KM:
        raise fields.error(
            f"an error ellipse has semi-axes above 0 and up to {_LARGEST_AXIS_KM:g} km, not {axes[0]:g} and {axes[1]:g}"
        )
    confidence = fields.number("ellipse_confidence") if fields.has("ellipse_confidence") else 0.95
    if not _LEAST_CONFIDENCE <= confidence < 1:
        raise fields.error(f"ellipse_confidence is {confidence:g}, not from {_LEAST_CONFIDENCE:g} to below 1")
    return ErrorEllipse(axes[0], axes[1], float(np.deg2rad(axes[2])), confidence)


def _stars(fields: _Row) -> ObservedStars | None:
    """Return the observed stars, of each identified one the first."""
    if not fields.has("stars"):
        return None
    at = fields.choice("stars_at", ("centroid", *INSTANTS))
    rows = fields.listed("stars")
    is_table = all(isinstance(row, list) and len(row) == 3 for row in rows)
    if not is_table or not all(_is_number(x) and _is_number(y) for x, y, _ in rows):
        raise fields.error("stars are a list of [x_px, y_px, star_id], star_id null where unknown")
    wrong = [number for _, _, number in rows if not _is_star_id(number)]
    if wrong:
        raise fields.error(f"{str(wrong[0])[:60]} is no star_id, which is a whole number, or null where unknown")
    star_id = np.array([-1 if number is None else number for _, _, number in rows], dtype=np.int64)
    _, first = np.unique(star_id, return_index=True)
    is_counted = star_id < 0
    is_counted[first] = True
    xy_px = np.array([row[:2] for row in rows], dtype=np.float64).reshape(-1, 2)
    return ObservedStars(xy_px[is_counted], star_id[is_counted], at)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST_NUMBER


def _is_star_id(value: object) -> bool:
    return value is None or (isinstance(value, int) and not isinstance(value, bool) and -1 <= value <= _LARGEST)
