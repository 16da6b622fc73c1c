"""Matches between catalogue stars and detections, and whether chance could explain them."""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.platesolution import PlateSolution
from glstar.calibrate.readouttime import ReadoutTime
from glstar.errors import CalibrationError

__all__ = ["MIN_STARS", "SIGNIFICANCE", "Matches", "is_significant", "orientation_notes", "require_significant"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# A plate solution needs at least this number of matches.
MIN_STARS: Final = 4


@dataclass(frozen=True, slots=True)
class _Significance:
    """Limits for accepting a plate solution."""

    # Expected number of wrong solutions with as many matches, over all solutions tried ...
    chance: float = 1e-9
    # ... if this fraction of the brightest predicted stars is matched as well.
    matched_fraction: float = 0.5
    # If a roof, a cloud or a lamp hides bright stars, a solution is accepted below this false-alarm probability.
    false_alarm: float = 1e-12


SIGNIFICANCE: Final = _Significance()


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Catalogue stars matched with detections.

    Attributes
    ----------
    solution : PlateSolution
        Refined on these matches.
    star : (k,) intp
        Indices into the reference stars, the brightest first.
    detection : (k,) intp
        Indices into the detected stars.
    residual_px : (k, 2) float64
        Detected minus predicted position, px.
    predicted : (m,) intp
        All reference stars predicted on the image.
    predicted_xy_px : (m, 2) float64
        Their predicted positions, px.
    chance : float
        Expected number of wrong solutions with as many matches, over all solutions tried.
    false_alarm : float
        Probability that any wrong solution matches as many stars, besides those of its pattern; from the density of
        detections around the stars.
    needed : int
        Number of matches at which the false-alarm probability is small enough; 0 if it was not computed.
    expected_by_chance : float
        Expected number of false matches, which are unrelated detections near a star.
    notes : tuple of str
        Remarks for the user: a mirrored image, an attitude far off.
    standard_error : dict of str to float
        Standard errors of ``fx_px``, ``cx_px``, ``cy_px`` and the lens's coefficients, of those that were fitted.
    readout : ReadoutTime or None
        The readout time of a rolling shutter, if it was fitted.
    """

    solution: PlateSolution
    star: Index
    detection: Index
    residual_px: Float
    predicted: Index
    predicted_xy_px: Float
    chance: float
    false_alarm: float = 1.0
    needed: int = 0
    expected_by_chance: float = 0.0
    notes: tuple[str, ...] = ()
    standard_error: dict[str, float] = field(default_factory=dict)
    readout: ReadoutTime | None = None

    def __len__(self) -> int:
        return len(self.star)

    @property
    def rms_px(self) -> float:
        """Root mean square distance between detected and predicted positions, px."""
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()))


def is_significant(matches: Matches) -> bool:
    """Return whether chance cannot explain the matches.

    Parameters
    ----------
    matches : Matches

    Returns
    -------
    bool
    """
    if len(matches) < MIN_STARS:
        return False
    # Among as many of the brightest predicted stars as were matched, most must be matched, ...
    bright = matches.predicted[: len(matches)]
    if matches.chance <= SIGNIFICANCE.chance and np.isin(bright, matches.star).mean() >= SIGNIFICANCE.matched_fraction:
        return True
    # ... unless part of the view is hidden; then the false-alarm probability must be lower.
    return matches.false_alarm <= SIGNIFICANCE.false_alarm


def require_significant(detected: DetectedStars, matches: Matches | None) -> Matches:
    """Return the matches with notes on the image's orientation, if chance cannot explain them.

    Parameters
    ----------
    detected : DetectedStars
    matches : Matches or None

    Returns
    -------
    Matches

    Raises
    ------
    CalibrationError
        If chance may explain the matches, or if bright stars are missing among them.
    """
    if matches is None or not is_significant(matches):
        matched = 0 if matches is None else len(matches)
        needed = max(MIN_STARS, 0 if matches is None else matches.needed)
        message = (
            f"{len(detected)} stars were found{detected.quality_note}, {matched} agree with the catalogue, and {needed}"
            " are needed to rule out chance; take a sharper image of a darker sky, or give time, site and attitude, or"
            " --labels"
        )
        raise CalibrationError(message, stars_used=matched, stars_needed=needed)
    return replace(matches, notes=orientation_notes(0, matches.solution.mirrored))


def orientation_notes(turned_rad: float, mirrored: bool) -> tuple[str, ...]:
    """Return notes for the user on an image that is turned or mirrored.

    Parameters
    ----------
    turned_rad : float
        Rotation against the given attitude and mount, rad; 0 for an upright image.
    mirrored : bool

    Returns
    -------
    tuple of str
        Empty for an upright, unmirrored image.
    """
    notes = []
    if mirrored:
        notes.append("the image is mirrored: left and right are exchanged")
    if turned_rad:
        notes.append(f"the image is turned by {np.rad2deg(turned_rad):.0f} deg against the given attitude and mount")
    return tuple(notes)
