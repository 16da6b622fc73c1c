"""Identification of stars from a few that the user has labelled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.matches import MIN_STARS, Matches, is_significant, orientation_notes
from glstar.calibrate.matching import refine
from glstar.calibrate.platesolution import PlateSolution
from glstar.calibrate.referencestars import ReferenceStars
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import fitted_rotation
from glstar.sky.catalogue import star_label

__all__ = ["Label", "identify_by_labels"]

Float = NDArray[np.float64]

# A label belongs to the nearest detection within this distance, px.
_LABEL_RADIUS_PX: Final = 8.0
# Three directions determine an attitude and whether the image is mirrored.
_MIN_LABELS: Final = 3
# Fields of view to try if the focal length is unknown, rad.
_FOVS_TRIED_RAD: Final = np.deg2rad(np.geomspace(2.0, 140.0, 200))


@dataclass(frozen=True, slots=True)
class Label:
    """A star that the user has labelled on an image.

    Attributes
    ----------
    x_px, y_px : float
        Its position to a few pixels, px.
    star_id : int
        Its number in the catalogue.
    """

    x_px: float
    y_px: float
    star_id: int


def identify_by_labels(
    detected: DetectedStars, reference: ReferenceStars, labels: Sequence[Label], camera: Camera, *, focal_known: bool
) -> Matches:
    """Identify all stars of an image from a few labelled ones.

    Parameters
    ----------
    detected : DetectedStars
    reference : ReferenceStars
    labels : sequence of Label
        Three or more.
    camera : Camera
        Its size and, if `focal_known`, its focal length.
    focal_known : bool
        Whether the camera's focal length is approximately known; otherwise it is searched for.

    Returns
    -------
    Matches

    Raises
    ------
    CalibrationError
        If there are fewer than three labels, if they contradict each other, or if the catalogue lacks their stars.
    """
    star = _labelled_stars(reference, labels)
    xy = np.array([[label.x_px, label.y_px] for label in labels])
    if len(detected):
        distance_px, nearest = KDTree(detected.xy_px).query(xy)
        xy = np.where((distance_px < _LABEL_RADIUS_PX)[:, np.newaxis], detected.xy_px[nearest], xy)
    direction = reference.stars.direction_eq[star]
    focals = [camera.fx_px] if focal_known else list(camera.width_px / 2 / np.tan(_FOVS_TRIED_RAD / 2))
    solutions = [
        _by_attitude(xy, direction, camera, f, mirrored=mirrored) for f in focals for mirrored in (False, True)
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
        notes = (*notes, f"no star was found at the labels of {', '.join(lost)}")
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


def _by_attitude(xy: Float, direction_eq: Float, camera: Camera, f_px: float, *, mirrored: bool) -> PlateSolution:
    """Return the solution whose attitude best rotates directions to the rays of pixels (Wahba's problem)."""
    scaled = replace(camera, fx_px=f_px, fy_px=f_px * camera.fy_px / camera.fx_px)
    x = camera.width_px - 1 - xy[:, 0] if mirrored else xy[:, 0]
    rays = scaled.unit_vectors(np.column_stack([x, xy[:, 1]]))
    valid = np.isfinite(rays).all(axis=1)
    return PlateSolution(scaled, fitted_rotation(direction_eq[valid], rays[valid]), mirrored)
