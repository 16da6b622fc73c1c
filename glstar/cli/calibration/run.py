"""The run of ``glstar calibrate``: read, detect, identify, fit and write, image by image.

The identification of the stars on photographs, and the readout time of their rolling shutter.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

import numpy as np

from glstar.calibrate import (
    Calibration,
    Channel,
    CombinedCalibration,
    Criterion,
    DetectedStars,
    GeometryCalibration,
    Label,
    LensChoice,
    Matches,
    Photograph,
    PlateSolution,
    ReferenceStars,
    SharedGeometry,
    SharedLensFit,
    above_air,
    above_air_together,
    calibrate,
    calibrate_geometry,
    combine,
    detect_stars,
    find_zenith,
    fit_gamma,
    fit_lens,
    fit_readout,
    fit_shared_lens,
    identify_by_labels,
    identify_lost,
    identify_near,
    linearised,
    prepare_to_draw,
    read_image,
    search_readout,
    share_geometry,
    with_point_spread,
)
from glstar.camera.model import Camera
from glstar.cli.calibration.inputs import (
    Reference,
    all_or_none,
    camera_of,
    exposure_s,
    exposures_of,
    read_labels,
    references,
    times_of,
)
from glstar.cli.calibration.output import files_of, files_of_all, write_camera, write_files
from glstar.cli.calibration.settings import CalibrateOptions
from glstar.cli.progress import progress_bar
from glstar.cli.verbosity import echo_note
from glstar.config import Config
from glstar.errors import CalibrationError

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


# Progress steps of an image: read, detected, identified, calibrated.
_STEPS: Final = 4


def calibrate_images(
    images: list[Path], options: CalibrateOptions, output: Path, camera_out: Path | None
) -> Calibration | CombinedCalibration | GeometryCalibration | SharedGeometry:
    """Calibrate one image, or several of one camera, and write the results.

    `output`: the TOML file; other files are written beside it; `camera_out`: a camera file to write as well.  Raises
    CalibrationError if an image cannot be calibrated; ConfigError if options contradict each other.
    """
    single = len(images) == 1
    steps = _STEPS * len(images) + (not single)
    with progress_bar("steps") as on_step, ThreadPoolExecutor(max_workers=1) as executor:
        on_step(0, steps)
        ready = executor.submit(prepare_to_draw)
        identified = _identified_images(images, options, lambda done: on_step(done, steps))
        identified = [with_zenith(part) for part in identified]
        shared: SharedLensFit | None = None
        if options.fit_lens:
            shared = _shared_lens(identified, options)
            identified = [replace(part, matches=m) for part, m in zip(identified, shared.matches, strict=True)]
        parts: list[Calibration | GeometryCalibration] = []
        for number, known in enumerate(identified):
            with naming(None if single else images[number]):
                parts.append(calibrated_image(known, options, single=single, lens_is_fitted=shared is not None))
            on_step(_STEPS * len(images) - len(identified) + number + 1, steps)
        ready.result()
        calibrations = tuple(part for part in parts if isinstance(part, Calibration))
        if not single and options.extinction != "none":
            calibrations = above_air_together(calibrations, _given_mag(options.extinction))
        for path, part in zip(images, calibrations or parts, strict=True):
            beside = output if single else output.with_name(f"{output.stem}.{path.stem}")
            write_files(beside, files_of(part, with_toml=single))
        combined: CombinedCalibration | SharedGeometry | None = None
        if not single:
            combined = _combined(parts, calibrations, shared)
            write_files(output, files_of_all(combined, output))
            on_step(steps, steps)
    if camera_out is not None:
        best = max(parts, key=lambda part: len(part.matches))
        write_camera(camera_out, best.geometry if isinstance(best, Calibration) else best)
    return combined or parts[0]


def _identified_images(
    images: list[Path], options: CalibrateOptions, on_step: Callable[[int], None]
) -> list[Identified]:
    """Return the images with their identified stars; their lens is not fitted yet."""
    settings = Config() if options.config is None else Config.load(options.config)
    attitude_deg, site_deg = all_or_none(options.attitude_deg), all_or_none(options.site_deg)
    exposures = exposures_of(options.exposures_s, len(images))
    times = times_of(options.utc, len(images))
    labels = None if options.labels is None else read_labels(options.labels)
    over = references(settings, times, site_deg, attitude_deg, options.flight, fit_readout=options.fit_readout)
    given = settings if options.config is not None else None
    focal_known = options.fov_deg is None and given is not None
    found: list[Identified] = []
    waiting: list[DetectedPhotograph] = []
    for number, path in enumerate(images):
        with naming(path if len(images) > 1 else None):
            image = _read(path, options)
            duration_s = 0.0 if options.geometry_only else exposure_s(exposures[number], image)
            camera = camera_of(image, given, options.fov_deg, known=labels is not None)
            on_step((_STEPS - 1) * number + 1)
            detected = detect_stars(image)
            on_step((_STEPS - 1) * number + 2)
            solution = given_solution(settings, over[number], camera)
            photograph = DetectedPhotograph(
                image, duration_s, detected, over[number], camera, solution, labels, focal_known
            )
            if options.fit_readout:
                waiting.append(photograph)
            else:
                found.append(photograph.identified())
            on_step((_STEPS - 1) * number + 3)
    if options.fit_readout:
        return identified_with_readout(waiting, cast("LensChoice", options.lens))
    return found


def _read(path: Path, options: CalibrateOptions) -> Photograph:
    """Return the light of a photograph."""
    image = read_image(path, channel=cast("Channel", options.channel), bit_depth=options.bit_depth)
    gamma = options.gamma or ("fit" if options.twin else "linear")
    if gamma != "fit":
        return linearised(image, gamma)
    found = fit_gamma(image, detect_stars(image))
    allowed = f"the noise of the sky allows gammas from {found.low:.2f} to {found.high:.2f}"
    if found.value != 1:
        echo_note(f"note: {allowed}; the least curve is taken, --gamma {found.value:.2f}")
        return linearised(image, f"{found.value:.2f}")
    if options.gamma == "fit":
        echo_note(f"note: {allowed}: the image is taken as linear; if it is processed, give --gamma srgb or 2.2")
    return image


def _combined(
    parts: list[Calibration | GeometryCalibration], calibrations: tuple[Calibration, ...], shared: SharedLensFit | None
) -> CombinedCalibration | SharedGeometry:
    geometries = tuple(part for part in parts if isinstance(part, GeometryCalibration))
    if shared is not None and geometries:
        return share_geometry(geometries, shared)
    return combine(calibrations, shared_lens=shared)


def _shared_lens(identified: list[Identified], options: CalibrateOptions) -> SharedLensFit:
    return fit_shared_lens(
        [part.image.path.name for part in identified],
        [part.detected for part in identified],
        [part.reference.stars for part in identified],
        [part.matches for part in identified],
        lens=cast("LensChoice", options.lens),
    )


def calibrated_image(
    part: Identified, options: CalibrateOptions, *, single: bool, lens_is_fitted: bool
) -> Calibration | GeometryCalibration:
    """Return the calibration of an image; of a single image without a usable sensor, the geometry and the reason.

    `single`: whether it is the only image; `lens_is_fitted`: whether the matches have the fitted lens already.
    """
    image, detected, reference, matches = part.image, part.detected, part.reference.stars, part.matches
    if not lens_is_fitted:
        matches = fit_lens(detected, reference, matches, lens=cast("LensChoice", options.lens))
    matches = replace(matches, notes=(*matches.notes, *part.reference.notes))
    geometry = calibrate_geometry(image, detected, reference, matches, method=part.method)
    if options.geometry_only:
        return geometry
    try:
        calibrated = calibrate(
            image,
            detected,
            reference,
            matches,
            method=part.method,
            exposure_s=part.exposure_s,
            criterion=cast("Criterion", options.criterion),
        )
        if single and options.extinction != "none":
            calibrated = above_air(calibrated, _given_mag(options.extinction))
        return with_point_spread(calibrated) if options.shape else calibrated
    except CalibrationError as error:
        if not single or options.extinction != "none":
            raise
        return replace(geometry, notes=(f"camera and attitude only, no sensor: {error}", *geometry.notes))


def _given_mag(extinction: str) -> float | None:
    """Return the given extinction per air mass, mag; None if it is to be fitted."""
    return None if extinction == "fit" else float(extinction)
