"""The identification of the stars on photographs, and the readout time of their rolling shutter."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from glstar.calibrate import (
    DetectedStars,
    Label,
    LensChoice,
    Matches,
    Photograph,
    PlateSolution,
    ReferenceStars,
    find_zenith,
    fit_readout,
    identify_by_labels,
    identify_lost,
    identify_near,
    search_readout,
)
from glstar.camera.model import Camera
from glstar.cli.calibrateinputs import Reference
from glstar.config import Config
from glstar.errors import CalibrationError

__all__ = ["DetectedPhotograph", "Identified", "given_solution", "identified_with_readout", "naming", "with_zenith"]

# A given attitude is reported as wrong if the optical axis is off by more than this, rad.
_ATTITUDE_TOLERANCE_RAD: Final = np.deg2rad(0.02)


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """An image with identified stars; `exposure_s` is 0 if only the geometry is calibrated."""

    image: Photograph
    exposure_s: float
    detected: DetectedStars
    reference: Reference
    method: str
    matches: Matches


@dataclass(frozen=True, slots=True, eq=False)
class DetectedPhotograph:
    """An image with detected stars, and what is known to identify them.

    `exposure_s` is 0 if only the geometry is calibrated, `given` the solution by the given attitude, if there is one.
    """

    image: Photograph
    exposure_s: float
    detected: DetectedStars
    reference: Reference
    camera: Camera
    given: PlateSolution | None
    labels: list[Label] | None
    focal_known: bool

    def identified(self, readout_s: float | None = None) -> Identified:
        """Return the image with identified stars, with another readout time if one is given."""
        reference, rows = self.reference, self.reference.stars.rows
        if readout_s is not None and rows is not None:
            stars = replace(reference.stars, rows=rows.with_readout_s(readout_s))
            reference = replace(reference, stars=stars)
        method, matches = self._identify(reference)
        matches = replace(matches, notes=(*matches.notes, *self.attitude_notes(matches)))
        return Identified(self.image, self.exposure_s, self.detected, reference, method, matches)

    def _identify(self, reference: Reference) -> tuple[str, Matches]:
        """Return how the stars were identified, and the matches."""
        detected, stars, known = self.detected, reference.stars, self.focal_known
        if self.labels is not None:
            return "by labels", identify_by_labels(detected, stars, self.labels, self.camera, focal_known=known)
        if self.given is None:
            return "by their pattern", identify_lost(detected, stars, reference.catalogue, self.camera)
        return "by attitude", identify_near(detected, stars, self.given, focal_known=known)

    def attitude_notes(self, matches: Matches) -> tuple[str, ...]:
        """Return a note on the error of the given attitude, if it is noticeable."""
        if self.given is None or self.labels is not None:
            return ()
        cosine = float(np.clip(self.given.C_camera_eq[2] @ matches.solution.C_camera_eq[2], -1, 1))
        off_rad = float(np.arccos(cosine))
        if off_rad < _ATTITUDE_TOLERANCE_RAD:
            return ()
        return (f"the given attitude points {np.rad2deg(off_rad):.2f} deg away from the camera's direction",)


def with_zenith(part: Identified) -> Identified:
    """Return an image without time or site with the zenith that its refraction shows, if it shows one."""
    stars = find_zenith(
        part.detected, part.reference.stars, part.matches, refraction_scale=part.reference.refraction_scale
    )
    return replace(part, reference=replace(part.reference, stars=stars))


def given_solution(settings: Config, reference: Reference, camera: Camera) -> PlateSolution | None:
    """Return the plate solution by the given attitude, mount and camera; None without an attitude."""
    C_ned_eq = reference.stars.C_ned_eq
    if reference.C_body_ned is None or C_ned_eq is None:
        return None
    return PlateSolution(camera, settings.mount().C_camera_body @ reference.C_body_ned @ C_ned_eq)


@contextmanager
def naming(image: Path | None) -> Iterator[None]:
    """Name the image in errors, if there are several."""
    try:
        yield
    except CalibrationError as error:
        if image is None or error.path is not None:
            raise
        raise CalibrationError(
            str(error), path=image, stars_used=error.stars_used, stars_needed=error.stars_needed
        ) from error


def identified_with_readout(photographs: Sequence[DetectedPhotograph], lens: LensChoice) -> list[Identified]:
    """Return the images with identified stars and the fitted readout time of their rolling shutter.

    A wrong readout time may leave the stars of an image unidentified: it is searched with the other images first.
    """
    several = len(photographs) > 1
    first: list[Identified] = []
    for one in photographs:
        try:
            with naming(one.image.path if several else None):
                first.append(one.identified())
        except CalibrationError:
            if not first and one is photographs[-1]:
                raise
    readout_s = search_readout(*_parts(first))
    found = []
    for one in photographs:
        with naming(one.image.path if several else None):
            found.append(one.identified(readout_s))
    fitted = fit_readout([part.image.path.name for part in found], *_parts(found), lens=lens)
    results = []
    for one, part, stars, matches in zip(photographs, found, fitted.reference, fitted.matches, strict=True):
        reference = replace(part.reference, stars=stars, notes=(*part.reference.notes, fitted.time.summary))
        # The attitude was judged with another readout time.
        judged = one.attitude_notes(part.matches)
        notes = (*(note for note in matches.notes if note not in judged), *one.attitude_notes(matches))
        results.append(replace(part, reference=reference, matches=replace(matches, notes=notes)))
    return results


def _parts(found: Sequence[Identified]) -> tuple[list[DetectedStars], list[ReferenceStars], list[Matches]]:
    detected = [part.detected for part in found]
    return detected, [part.reference.stars for part in found], [part.matches for part in found]
