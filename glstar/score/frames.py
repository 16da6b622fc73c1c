"""The truth of one frame for scoring, and the errors of an answer against it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from math import asin, hypot, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import AttitudeError, Camera
from glstar.errors import AnswersError, reading
from glstar.export.truth.lines import has_truth, read_truth
from glstar.export.truth.overlays import camera_of
from glstar.rotation import euler_from_quaternion, fitted_rotation
from glstar.score.answers import Answer, ObservedStars
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.apparent import direction, proper_motion
from glstar.sky.place.site import Site, surface_offset_km
from glstar.sky.place.timescale import parse_utc

# Keys of a frame's truth that describe the light and the cloud under which it was taken.
CONDITIONS = (
    "cloud_transmission",
    "moon_altitude_deg",
    "moon_illuminated_fraction",
    "moon_separation_deg",
    "sun_altitude_deg",
    "sky_mag_arcsec2",
)

_TRUTH = "truth.jsonl"
_MANIFEST = "manifest.json"
_J2000_UTC_S = 946728000.0
_JULIAN_YEAR_S = 365.25 * 86400.0
# A rotation needs this many stars.
_LEAST_STARS = 3


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """The truth of one frame."""

    frame: int
    file: str
    utc_mid_s: float
    camera_utc_mid_s: float  # The same by the clock that stamps the frames for a navigator
    duration_s: float
    total_s: float  # From the first opening of the shutter to its last closing
    latitude_rad: float
    longitude_rad: float
    height_m: float
    yaw_rad: float  # Heading of the aircraft, mid-exposure, rad from north through east
    C_camera_icrs: Float  # (3, 3) mid-exposure
    camera: Camera
    catalogue: str
    star_id: NDArray[np.int64]  # (n,)
    # (n, 2) positions at ``start``, ``middle``, ``end`` and of the ``centroid``, px; NaN if unknown
    xy_px: dict[str, Float]
    # (n,) stars whose `snr` reaches the limit and that are on the image for half of the exposure
    is_detectable: NDArray[np.bool_]
    # Name of the flight and number of the sample, in a data set: frames of one run follow each other
    run: tuple[str, int] = ("", 0)
    settings: Mapping[str, Any] = field(default_factory=dict)  # Settings of the sample of a sweep, by dotted key
    # Keys of `CONDITIONS` that the truth has
    conditions: Mapping[str, float] = field(default_factory=dict)

    @property
    def trail_length_px(self) -> float:
        """Median length of the detectable stars' trails from start to end, px; 0 without stars."""
        length = np.linalg.norm(self.xy_px["end"] - self.xy_px["start"], axis=1)[self.is_detectable]
        return float(np.nanmedian(length)) if np.isfinite(length).any() else 0.0

    @property
    def rate_rad_per_s(self) -> float | None:
        """Mean rate of the camera's rotation over the exposure, rad/s; None with fewer than three stars."""
        start, end = self.attitude("start"), self.attitude("end")
        if start is None or end is None:
            return None
        # Of a rotation matrix R by the angle a, |R - 1| = 2 sqrt(2) sin(a / 2).
        half_sine = float(np.linalg.norm(end - start)) / (2 * sqrt(2))
        return 2 * asin(min(half_sine, 1.0)) / self.total_s

    def contradiction(self, answer: Answer) -> str | None:
        """Return how the file or the time of an answer contradicts this frame; None if neither does."""
        return answer.contradiction(self.frame, self.file, self.camera_utc_mid_s, self.total_s)

    def distance_from_trail(self, star: int, xy_px: Float) -> float:
        """Return the distance of a point, (2,) px, from the line through start, middle and end of a trail, px."""
        points = np.stack([self.xy_px[instant][star] for instant in ("start", "middle", "end")])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            return np.inf
        step = np.diff(points, axis=0, append=points[-1:])
        along = np.einsum("ij,ij->i", xy_px - points, step) / np.maximum(np.einsum("ij,ij->i", step, step), 1e-12)
        nearest = points + np.clip(along, 0.0, 1.0)[:, np.newaxis] * step
        return float(np.linalg.norm(xy_px - nearest, axis=1).min())

    def attitude(self, instant: str) -> Float | None:
        """Return the rotation from ICRS to the camera at ``start``, ``middle`` or ``end`` of the exposure, (3, 3).

        The truth has the attitude of mid-exposure.  Attitudes of start and end follow from the rotation of the stars'
        directions in the camera, in which refraction and aberration cancel except for their change; None for a frame
        with fewer than three stars.
        """
        if instant == "middle":
            return self.C_camera_icrs
        here, middle = self.directions(instant), self.directions("middle")
        both = np.isfinite(here).all(axis=1) & np.isfinite(middle).all(axis=1)
        if both.sum() < _LEAST_STARS:
            return None
        turned: Float = fitted_rotation(middle[both], here[both]) @ self.C_camera_icrs
        return turned

    def plain_fit(self, instant: str) -> Float | None:
        """Return the rotation that fits catalogue directions to the true pixels, without refraction or aberration.

        (3, 3), at ``start``, ``middle`` or ``end``; None if fewer than three detectable stars are on the image.
        """
        seen = self.directions(instant)
        used = self.is_detectable & np.isfinite(seen).all(axis=1)
        if used.sum() < _LEAST_STARS or not self.catalogue:
            return None
        return fitted_rotation(self._catalogue_directions()[used], seen[used])

    def directions(self, instant: str) -> Float:
        """Return the unit vectors in the camera frame of the stars' pixel positions, (n, 3)."""
        return self.camera.unit_vectors(self.xy_px[instant])

    def _catalogue_directions(self) -> Float:
        """Return ICRS unit vectors of the stars with proper motion to the frame's epoch, (n, 3)."""
        stars = _opened(self.catalogue).by_id(self.star_id.tolist())
        years = (self.utc_mid_s - _J2000_UTC_S) / _JULIAN_YEAR_S
        places = proper_motion(
            stars.ra_rad, stars.dec_rad, stars.pm_ra_cosdec_rad_per_yr, stars.pm_dec_rad_per_yr, years
        )
        order = {number: k for k, number in enumerate(stars.star_id.tolist())}
        ordered: Float = direction(*places)[[order[number] for number in self.star_id.tolist()]]
        return ordered


@cache
def _opened(catalogue: str) -> Any:
    return StarCatalogue.open(catalogue)


def read_frame_truths(directory: Path, *, least_snr: float) -> list[FrameTruth]:
    """Return the truth of an export: a directory with ``truth.jsonl`` and ``manifest.json``, or the truth file itself.

    A star is detectable from the signal-to-noise ratio `least_snr`, by the ``snr`` of the truth: with the shape of its
    trail and its point spread, and with cloud and lens.  Raises AnswersError if there is no truth, or an early version
    of glstar wrote it without ``snr``; ExportError if a line of the truth cannot be read.
    """
    truth = directory / _TRUTH if directory.is_dir() else directory
    if not truth.is_file() and not has_truth(truth.parent):
        raise AnswersError(truth, "there is no truth to score against; give the directory of an export")
    offset_s = clock_offset_s(truth.parent)
    with reading(truth, AnswersError, "has a damaged line", is_unchecked=True):
        try:
            frames = [_frame_truth(line, offset_s, least_snr) for line in read_truth(truth)]
        except KeyError as error:
            raise AnswersError(
                truth, f"has no {error.args[0]}, which a score needs; export the frames again with this version"
            ) from error
    if not frames:
        raise AnswersError(truth, "holds no frames")
    return frames


def clock_offset_s(export: Path) -> float:
    """Return the error of the navigator's clock that an export was made with, s."""
    try:
        return float(orjson.loads((export / _MANIFEST).read_bytes())["config"]["navigator"]["clock_offset_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0.0


def camera_utc_mid_s(line: Mapping[str, Any], offset_s: float) -> float:
    """Return the middle of a frame of truth by the clock that stamps it for a navigator, UTC seconds since 1970.

    `offset_s`: as of `clock_offset_s`, for a frame without a setting of a sweep.
    """
    offset_s = float(line.get("settings", {}).get("navigator.clock_offset_s", offset_s))
    return parse_utc(line.get("camera_utc_mid") or line["utc_mid"]) + offset_s


def _frame_truth(line: Mapping[str, Any], offset_s: float, least_snr: float) -> FrameTruth:
    stars = line["stars"]
    xy_px = {
        "middle": _positions([(star["x_px"], star["y_px"]) for star in stars]),
        "centroid": _positions([(star["centroid_x_px"], star["centroid_y_px"]) for star in stars]),
        "start": _positions([star["start"] or (None, None) for star in stars]),
        "end": _positions([star["end"] or (None, None) for star in stars]),
    }
    snr = np.array([star["snr"] for star in stars], dtype=np.float64)
    in_frame = np.array([star["in_frame"] for star in stars], dtype=np.float64)
    _, _, yaw_rad = euler_from_quaternion(line["q_body_ned"])
    site, settings = line["site"], dict(line.get("settings", {}))
    return FrameTruth(
        frame=int(line["frame"]),
        file=str(line["file"]),
        utc_mid_s=parse_utc(line["utc_mid"]),
        camera_utc_mid_s=camera_utc_mid_s(line, offset_s),
        duration_s=float(line["duration_s"]),
        total_s=float(line.get("total_s", line["duration_s"])),
        latitude_rad=float(np.deg2rad(site["latitude_deg"])),
        longitude_rad=float(np.deg2rad(site["longitude_deg"])),
        height_m=float(site["height_m"]),
        yaw_rad=float(yaw_rad),
        C_camera_icrs=np.array(line["C_camera_icrs"], dtype=np.float64).reshape(3, 3),
        camera=camera_of(line["camera"]),
        catalogue=str(line["catalogue"]),
        star_id=np.array([star["star_id"] for star in stars], dtype=np.int64),
        xy_px=xy_px,
        is_detectable=(snr >= least_snr) & (in_frame >= 0.5),
        run=(str(line.get("flight", "")), int(line.get("sample", 0))),
        settings=settings,
        conditions={key: float(line[key]) for key in CONDITIONS if line.get(key) is not None},
    )


def _positions(pairs: list[tuple[float | None, float | None]]) -> Float:
    return np.array(pairs, dtype=np.float64).reshape(-1, 2)


class Outcome(StrEnum):
    """The outcome of a frame.

    ``SOLVED``: all that was answered is right; ``FALSE``: something of it is not; ``REFUSED``: the navigator refused,
    or answered nothing.
    """

    SOLVED = "solved"
    REFUSED = "refused"
    FALSE = "false"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits beyond which an answer is false."""

    boresight_rad: float = float(np.deg2rad(1.0))  # Error of the optical axis, rad
    roll_rad: float = float(np.deg2rad(5.0))  # Error of the rotation about it, rad
    position_km: float = 200.0
    wrong_ids: float = 0.5  # Fraction of the identified stars that are wrong
    star_px: float = 3.0  # Distance within which an observed star is the true one, px


@dataclass(frozen=True, slots=True)
class PositionError:
    """The error of a position."""

    north_km: float
    east_km: float
    in_ellipse: bool | None  # Whether the stated error ellipse contains the truth; None without an ellipse

    @property
    def distance_km(self) -> float:
        """Distance along the surface, km."""
        return hypot(self.north_km, self.east_km)


@dataclass(frozen=True, slots=True)
class StarScore:
    """The score of identified and measured stars."""

    identified: int  # Stars with an identifier
    correct: int  # Stars with a correct identifier and position
    elsewhere: int  # Identified stars that are not on the trail of their star: their identifier is wrong
    detectable: int  # Detectable stars of the truth
    found: int  # Detectable stars that were identified correctly
    centroid_rms_px: float | None  # RMS position error of the correct stars, px


@dataclass(frozen=True, slots=True)
class FrameScore:
    """The score of one frame."""

    truth: FrameTruth
    answer: Answer | None
    outcome: Outcome
    attitude: AttitudeError | None = None
    # Error of a rotation fitted to the true pixels: that of a solver that ignores refraction and aberration
    floor: AttitudeError | None = None
    above_floor: AttitudeError | None = None  # Error of the answer against that fit
    position: PositionError | None = None
    stars: StarScore | None = None


def score_frame(truth: FrameTruth, answer: Answer | None, limits: Limits) -> FrameScore:
    """Return the score of an answer to one frame; None is no answer."""
    if answer is None or not answer.solved:
        return FrameScore(truth, answer, Outcome.REFUSED)
    attitude = floor = above_floor = None
    if answer.C_camera_icrs is not None and (true := truth.attitude(answer.instant)) is not None:
        attitude = AttitudeError.between(true, answer.C_camera_icrs)
        if (plain := truth.plain_fit(answer.instant)) is not None:
            floor = AttitudeError.between(true, plain)
            above_floor = AttitudeError.between(plain, answer.C_camera_icrs)
    position = _position_error(truth, answer)
    stars = None if answer.stars is None else _star_score(truth, answer.stars, limits.star_px)
    is_right = (
        (attitude is None or attitude.boresight_rad <= limits.boresight_rad)
        and (attitude is None or abs(attitude.roll_rad) <= limits.roll_rad)
        and (position is None or position.distance_km <= limits.position_km)
        and (stars is None or stars.elsewhere <= limits.wrong_ids * stars.identified)
    )
    return FrameScore(
        truth=truth,
        answer=answer,
        outcome=Outcome.SOLVED if is_right else Outcome.FALSE,
        attitude=attitude,
        floor=floor,
        above_floor=above_floor,
        position=position,
        stars=stars,
    )


def _position_error(truth: FrameTruth, answer: Answer) -> PositionError | None:
    """Return the error of a position."""
    if answer.latitude_rad is None or answer.longitude_rad is None:
        return None
    true_site = Site(truth.latitude_rad, truth.longitude_rad)
    north, east = surface_offset_km(true_site, answer.latitude_rad, answer.longitude_rad)
    inside = None if answer.ellipse is None else answer.ellipse.contains(north, east)
    return PositionError(north, east, inside)


def _star_score(truth: FrameTruth, observed: ObservedStars, star_px: float) -> StarScore:
    index = {number: k for k, number in enumerate(truth.star_id.tolist())}
    true_px = truth.xy_px[observed.at]
    squared_px2 = []
    identified = set()
    on_trail = 0
    for xy, number in zip(observed.xy_px, observed.star_id.tolist(), strict=True):
        k = index.get(number)
        if k is None:
            continue
        distance_px = float(np.hypot(*(xy - true_px[k])))
        on_trail += distance_px <= star_px or truth.distance_from_trail(k, xy) <= star_px
        if distance_px <= star_px:
            squared_px2.append(distance_px**2)
            identified.add(k)
    detectable = np.flatnonzero(truth.is_detectable)
    return StarScore(
        identified=int((observed.star_id >= 0).sum()),
        correct=len(squared_px2),
        elsewhere=int((observed.star_id >= 0).sum()) - on_trail,
        detectable=detectable.size,
        found=len(identified & set(detectable.tolist())),
        centroid_rms_px=float(np.sqrt(np.mean(squared_px2))) if squared_px2 else None,
    )
