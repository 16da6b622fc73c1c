"""Identification of stars with an approximate attitude, by votes for a shift and a roll, or from labels."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from glstar.arrays import Float
from glstar.calibrate.identify.matching import refine, refine_outwards
from glstar.calibrate.identify.platesolution import (
    MIN_STARS,
    Matches,
    PlateSolution,
    ReferenceStars,
    exceeds_pinhole,
    is_significant,
    nominal_camera,
    orientation_notes,
    require_significant,
    wide_angle_cameras,
)
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import about_z, fitted_rotation, matrix_from_quaternion, quaternion_from_turn
from glstar.sky.catalogue.reading import star_label

# Largest error of the given attitude: of the optical axis, and of the roll.
_ATTITUDE_ERROR_RAD = np.deg2rad(10.0)
_ROLL_ERROR_RAD = np.deg2rad(8.0)
# Number of predicted and of detected stars that vote.
_VOTERS = (40, 80)
_MOST_VOTERS = 400
# Factors of the focal length to try if it is known to 15 % only. Larger steps would spread the votes over several bins.
_ROUGH_FOCALS = tuple(np.exp(k * 0.02) for k in sorted(range(-8, 9), key=abs))
_BIN_FRACTION = 0.008
_MIN_BIN_PX = 6.0
# Number of candidate orientations that are refined.
_MOST_CANDIDATES = 12
# Orientations of the image against the given attitude: rotation, deg, and whether it is mirrored.
_ORIENTATIONS = (
    (0, False), (180, False), (0, True), (180, True), (90, False), (270, False), (90, True), (270, True),
)  # fmt: skip


def identify_near(
    detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution, *, focal_known: bool = True
) -> Matches:
    """Identify stars with an attitude that is right to 10 degrees.

    `solution`: the given attitude, right to 10 deg, and the camera; upright and unmirrored; `focal_known`: whether the
    focal length is right to 1 %; otherwise it may be off by 15 %.  Notes report a mirrored or rotated image.  Raises
    CalibrationError if the stars of that part of the sky are not on the image.  The brightest predicted and detected
    stars vote for a shift and a roll, and the winner is refined.  If that fails and the field of view is wide, the vote
    is repeated with typical wide-angle lenses.
    """
    pinholes = () if exceeds_pinhole(solution.camera) else (solution,)
    best = _best_orientation(detected, reference, pinholes, refine, focal_known=focal_known)
    if best is None or not is_significant(best):
        wide = tuple(replace(solution, camera=camera) for camera in wide_angle_cameras(solution.camera))
        best = _best_orientation(detected, reference, wide, refine_outwards, focal_known=focal_known) or best
    if best is not None and is_significant(best):
        return best
    needed = MIN_STARS if best is None else max(MIN_STARS, best.needed)
    raise CalibrationError(
        f"{len(detected)} stars were found{detected.quality_note}, but those of the catalogue within"
        f" {np.rad2deg(_ATTITUDE_ERROR_RAD):.0f} deg of the given attitude are not among them"
        f" ({0 if best is None else len(best)} agree, {needed} are needed); check time, place,"
        " attitude, mount and camera, or leave the attitude out to search the whole sky",
        stars_used=0 if best is None else len(best),
        stars_needed=needed,
    )


def identify_again(detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution) -> Matches:
    """Identify the stars of an image that has been solved before, with other detections.

    `solution`: that of the image.  Raises CalibrationError if chance may explain the matches.
    """
    return require_significant(detected, refine(detected, reference, solution))


def _best_orientation(
    detected: DetectedStars,
    reference: ReferenceStars,
    solutions: tuple[PlateSolution, ...],
    refine_with: Callable[[DetectedStars, ReferenceStars, PlateSolution], Matches | None],
    *,
    focal_known: bool,
) -> Matches | None:
    """Return the matches of the first significant orientation of the image, else of the best one, if any."""
    candidates = []
    focals = (1.0,) if focal_known else _ROUGH_FOCALS
    for solution, scale, (turned_deg, mirrored) in itertools.product(solutions, focals, _ORIENTATIONS):
        camera = replace(solution.camera, fx_px=solution.camera.fx_px * scale, fy_px=solution.camera.fy_px * scale)
        turned = PlateSolution(camera, about_z(np.deg2rad(turned_deg)) @ solution.C_camera_eq, mirrored)
        excess, guess = _by_votes(detected, reference, turned)
        if guess is not None:
            candidates.append((excess, guess, orientation_notes(float(np.deg2rad(turned_deg)), mirrored)))
    best: Matches | None = None
    # The true orientation usually has by far the most votes; with few stars it may be one of the next.
    for _, guess, notes in sorted(candidates, key=lambda candidate: -candidate[0])[:_MOST_CANDIDATES]:
        refined = refine_with(detected, reference, guess)
        if refined is not None and (best is None or len(refined) > len(best)):
            best = replace(refined, notes=notes)
        if best is not None and is_significant(best):
            break
    return best


def _by_votes(
    detected: DetectedStars, reference: ReferenceStars, solution: PlateSolution
) -> tuple[float, PlateSolution | None]:
    """Return the solution with the shift and roll that most pairs of a predicted and a detected star agree on.

    Also the excess of its votes over those expected by chance, in standard deviations.
    """
    camera = solution.camera
    f, centre = camera.fx_px, np.array([camera.cx_px, camera.cy_px])
    far_px = f * np.tan(_ATTITUDE_ERROR_RAD)
    predictions, bright = _VOTERS
    xy = solution.predicted(reference)
    # The number of voters grows with the allowed error, because most of these stars are not on the image.
    area_ratio = (camera.width_px + 2 * far_px) * (camera.height_px + 2 * far_px) / (camera.width_px * camera.height_px)
    near = np.flatnonzero(camera.contains(xy, far_px))[: min(round(predictions * area_ratio), _MOST_VOTERS)]
    if len(near) < 3 or len(detected) < 3:
        return 0.0, None
    bright_px = detected.xy_px[:bright]
    bin_px = max(_BIN_FRACTION * camera.width_px, _MIN_BIN_PX)
    bins = int(np.ceil(2 * far_px / bin_px)) + 1
    best, excess, shift, rolled = 0.0, 0.0, np.zeros(2), 0.0
    for roll_rad in _rolls(camera, bin_px):
        c, s = np.cos(roll_rad), np.sin(roll_rad)
        turned = (xy[near] - centre) @ np.array([[c, s], [-s, c]]) + centre
        offset = (bright_px[np.newaxis] - turned[:, np.newaxis]).reshape(-1, 2)
        offset = offset[(np.abs(offset) < far_px).all(axis=1)]
        column, row = ((offset + far_px) / bin_px).astype(np.intp).T
        votes = np.bincount(column * bins + row, minlength=bins * bins).reshape(bins, bins)
        # Votes for a shift near the edge of a bin are in two bins, so squares of two by two bins are summed.
        squares = votes[:-1, :-1] + votes[1:, :-1] + votes[:-1, 1:] + votes[1:, 1:]
        if squares.max() > best:
            best = float(squares.max())
            usual = 4 * len(offset) / bins**2
            excess = (best - usual) / np.sqrt(usual + 1)
            k = np.array(np.unravel_index(int(squares.argmax()), squares.shape))
            inside = (np.abs(offset - ((k + 1) * bin_px - far_px)) <= bin_px).all(axis=1)
            shift, rolled = np.median(offset[inside], axis=0), roll_rad
    if best < 3:
        return 0.0, None
    sign = -1.0 if solution.mirrored else 1.0
    # The roll of a mirrored image has the opposite sign.
    C = about_z(-sign * rolled) @ solution.C_camera_eq
    aside_rad = np.array([np.arctan(shift[1] / camera.fy_px), -sign * np.arctan(shift[0] / f), 0.0])
    return excess, replace(solution, C_camera_eq=matrix_from_quaternion(quaternion_from_turn(aside_rad)) @ C)


def _rolls(camera: Camera, bin_px: float) -> Iterator[float]:
    """Yield rolls to try, rad, the small ones first, in steps that move a corner by one bin."""
    step = 2 * bin_px / np.hypot(camera.width_px, camera.height_px)
    count = int(np.ceil(_ROLL_ERROR_RAD / step))
    yield from sorted(np.arange(-count, count + 1) * step, key=abs)


# A label belongs to the nearest detection within this distance, px.
_LABEL_RADIUS_PX = 8.0
# Three directions determine an attitude and whether the image is mirrored.
_MIN_LABELS = 3
# Fields of view to try if the focal length is unknown, rad.
_FOVS_TRIED_RAD = np.deg2rad(np.geomspace(2.0, 220.0, 222))


@dataclass(frozen=True, slots=True)
class Label:
    """A star that the user has labelled on an image."""

    x_px: float  # Its position to a few pixels, px
    y_px: float
    star_id: int  # Its number in the catalogue


def identify_by_labels(
    detected: DetectedStars, reference: ReferenceStars, labels: Sequence[Label], camera: Camera, *, focal_known: bool
) -> Matches:
    """Identify all stars of an image from a few labelled ones.

    `labels`: three or more; `camera`: its size and, if `focal_known`, its focal length; `focal_known`: whether the
    camera's focal length is approximately known; otherwise it is searched for.  Raises CalibrationError if there are
    fewer than three labels, if they contradict each other, or if the catalogue lacks their stars.
    """
    star = _labelled_stars(reference, labels)
    xy = np.array([[label.x_px, label.y_px] for label in labels])
    if len(detected):
        distance_px, nearest = KDTree(detected.xy_px).query(xy)
        xy = np.where((distance_px < _LABEL_RADIUS_PX)[:, np.newaxis], detected.xy_px[nearest], xy)
    direction = reference.stars.direction_eq[star]
    cameras = [camera]
    if not focal_known:
        cameras = [nominal_camera(camera.width_px, camera.height_px, fov_rad) for fov_rad in _FOVS_TRIED_RAD.tolist()]
    solutions = [
        _labelled_by_attitude(xy, direction, one, mirrored=mirrored) for one in cameras for mirrored in (False, True)
    ]
    off_px = [np.median(np.linalg.norm(s.project(direction @ s.C_camera_eq.T) - xy, axis=1)) for s in solutions]
    matches = refine(detected, reference, solutions[int(np.nanargmin(off_px))])
    if matches is None or not is_significant(matches):
        matched = 0 if matches is None else len(matches)
        raise CalibrationError(
            f"the labels contradict each other: with the best attitude their median error is {min(off_px):.1f} px, and"
            f" {matched} stars of the catalogue match the {len(detected)} detected stars{detected.quality_note};"
            " check numbers and positions (x to the right and y down from the top-left pixel)",
            stars_used=matched,
            stars_needed=MIN_STARS,
        )
    identified = {int(reference.stars.star_id[s]) for s in matches.star}
    lost = [star_label(reference.stars.catalogue, label.star_id) for label in labels if label.star_id not in identified]
    notes = orientation_notes(0, matches.solution.mirrored)
    if lost:
        text = f"no star was found at the labels of {', '.join(lost)}"
        notes = (*notes, Note(NoteKind.IDENTIFICATION, text))
    return replace(matches, notes=notes)


def _labelled_stars(reference: ReferenceStars, labels: Sequence[Label]) -> NDArray[np.intp]:
    """Return the indices of labelled stars into the reference stars."""
    if len(labels) < _MIN_LABELS:
        message = f"{len(labels)} labels were given, and an attitude needs {_MIN_LABELS}"
        raise CalibrationError(message, stars_used=len(labels), stars_needed=_MIN_LABELS)
    index = {int(star_id): k for k, star_id in enumerate(reference.stars.star_id)}
    missing = [label.star_id for label in labels if label.star_id not in index]
    if missing:
        names = ", ".join(star_label(reference.stars.catalogue, star_id) for star_id in missing[:5])
        message = f"the labels name {names}, which the catalogue lacks"
        raise CalibrationError(message, stars_used=len(labels) - len(missing), stars_needed=_MIN_LABELS)
    return np.array([index[label.star_id] for label in labels])


def _labelled_by_attitude(xy: Float, direction_eq: Float, camera: Camera, *, mirrored: bool) -> PlateSolution:
    """Return the solution whose attitude best rotates directions to the rays of pixels (Wahba's problem)."""
    x = camera.width_px - 1 - xy[:, 0] if mirrored else xy[:, 0]
    rays = camera.unit_vectors(np.column_stack([x, xy[:, 1]]))
    valid = np.isfinite(rays).all(axis=1)
    return PlateSolution(camera, fitted_rotation(direction_eq[valid], rays[valid]), mirrored)
