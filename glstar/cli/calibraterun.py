"""The run of ``glstar calibrate``: read, detect, identify, fit and write, image by image."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Final, cast

from glstar.calibrate import (
    Calibration,
    Channel,
    CombinedCalibration,
    Criterion,
    GeometryCalibration,
    LensChoice,
    Photograph,
    SharedGeometry,
    SharedLensFit,
    above_air,
    above_air_together,
    calibrate,
    calibrate_geometry,
    combine,
    detect_stars,
    fit_gamma,
    fit_lens,
    fit_shared_lens,
    linearised,
    prepare_to_draw,
    read_image,
    share_geometry,
    with_point_spread,
)
from glstar.cli.calibrateidentify import (
    DetectedPhotograph,
    Identified,
    given_solution,
    identified_with_readout,
    naming,
    with_zenith,
)
from glstar.cli.calibrateinputs import (
    all_or_none,
    camera_of,
    exposure_s,
    exposures_of,
    read_labels,
    references,
    times_of,
)
from glstar.cli.calibrateoptions import CalibrateOptions
from glstar.cli.calibrateoutput import files_of, files_of_all, write_camera, write_files
from glstar.cli.progress import progress_bar
from glstar.cli.verbosity import echo_note
from glstar.config import Config
from glstar.errors import CalibrationError

__all__ = ["calibrate_images", "calibrated_image"]

# Progress steps of an image: read, detected, identified, calibrated.
_STEPS: Final = 4


def calibrate_images(
    images: list[Path], options: CalibrateOptions, output: Path, camera_out: Path | None
) -> Calibration | CombinedCalibration | GeometryCalibration | SharedGeometry:
    """Calibrate one image, or several of one camera, and write the results.

    Parameters
    ----------
    images : list of Path
    options : CalibrateOptions
    output : Path
        The TOML file; other files are written beside it.
    camera_out : Path or None
        A camera file to write as well.

    Returns
    -------
    Calibration, CombinedCalibration, GeometryCalibration or SharedGeometry

    Raises
    ------
    CalibrationError
        If an image cannot be calibrated.
    ConfigError
        If options contradict each other.
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

    Parameters
    ----------
    part : Identified
    options : CalibrateOptions
    single : bool
        Whether it is the only image.
    lens_is_fitted : bool
        Whether the matches have the fitted lens already.

    Returns
    -------
    Calibration or GeometryCalibration
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
