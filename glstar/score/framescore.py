"""The score of one frame: the errors of an answer against the truth."""

from dataclasses import dataclass
from enum import StrEnum
from math import hypot

import numpy as np
from numpy.typing import NDArray

from glstar.camera.attitudeerror import AttitudeError
from glstar.score.answers import Answer, ObservedStars
from glstar.score.frametruth import FrameTruth
from glstar.sky.geodesy import surface_offset_km
from glstar.sky.site import Site

__all__ = ["AttitudeError", "FrameScore", "Limits", "Outcome", "PositionError", "StarScore", "score_frame"]

Float = NDArray[np.float64]


class Outcome(StrEnum):
    """The outcome of a frame.

    ``SOLVED``: answered, within the limits; ``FALSE``: answered, with larger errors; ``REFUSED``: refused by the
    navigator, or without an answer in the file.
    """

    SOLVED = "solved"
    REFUSED = "refused"
    FALSE = "false"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits beyond which an answer is false.

    Attributes
    ----------
    boresight_rad : float
        Error of the optical axis, rad.
    position_km : float
    star_px : float
        Distance within which an observed star is the true one, px.
    """

    boresight_rad: float = float(np.deg2rad(1.0))
    position_km: float = 200.0
    star_px: float = 3.0


@dataclass(frozen=True, slots=True)
class PositionError:
    """The error of a position.

    Attributes
    ----------
    north_km, east_km : float
    in_ellipse : bool or None
        Whether the stated error ellipse contains the truth; None without an ellipse.
    """

    north_km: float
    east_km: float
    in_ellipse: bool | None

    @property
    def distance_km(self) -> float:
        """Distance along the surface, km."""
        return hypot(self.north_km, self.east_km)


@dataclass(frozen=True, slots=True)
class StarScore:
    """The score of identified and measured stars.

    Attributes
    ----------
    identified, correct : int
        Stars with an identifier, and those with a correct identifier and position.
    detectable, found : int
        Detectable stars of the truth, and those of them that were identified correctly.
    centroid_rms_px : float or None
        RMS position error of the correct stars, px.
    """

    identified: int
    correct: int
    detectable: int
    found: int
    centroid_rms_px: float | None


@dataclass(frozen=True, slots=True)
class FrameScore:
    """The score of one frame.

    Attributes
    ----------
    truth : FrameTruth
    answer : Answer or None
    outcome : Outcome
    attitude : AttitudeError or None
    floor : AttitudeError or None
        Error of a rotation fit to the true pixels, which is the error of a solver that ignores refraction and
        aberration.
    above_floor : AttitudeError or None
        Error of the answer against that fit.
    position : PositionError or None
    stars : StarScore or None
    """

    truth: FrameTruth
    answer: Answer | None
    outcome: Outcome
    attitude: AttitudeError | None = None
    floor: AttitudeError | None = None
    above_floor: AttitudeError | None = None
    position: PositionError | None = None
    stars: StarScore | None = None


def score_frame(truth: FrameTruth, answer: Answer | None, limits: Limits) -> FrameScore:
    """Return the score of an answer to one frame.

    Parameters
    ----------
    truth : FrameTruth
    answer : Answer or None
        None without an answer.
    limits : Limits

    Returns
    -------
    FrameScore
    """
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
    wrong = (
        (attitude is not None and attitude.boresight_rad > limits.boresight_rad)
        or (position is not None and position.distance_km > limits.position_km)
        or (attitude is None and position is None and stars is not None and stars.correct * 2 < stars.identified)
    )
    outcome = Outcome.FALSE if wrong else Outcome.SOLVED
    return FrameScore(truth, answer, outcome, attitude, floor, above_floor, position, stars)


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
    squared, found = [], set()
    for xy, number in zip(observed.xy_px, observed.star_id.tolist(), strict=True):
        k = index.get(number)
        if k is None:
            continue
        distance_px = float(np.hypot(*(xy - true_px[k])))
        if distance_px <= star_px:
            squared.append(distance_px**2)
            found.add(k)
    detectable = np.flatnonzero(truth.is_detectable)
    return StarScore(
        identified=int((observed.star_id >= 0).sum()),
        correct=len(squared),
        detectable=detectable.size,
        found=len(found & set(detectable.tolist())),
        centroid_rms_px=float(np.sqrt(np.mean(squared))) if squared else None,
    )
