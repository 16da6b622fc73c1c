"""The calibration that the window offers: what ``glstar calibrate`` does with one photograph."""

from pathlib import Path

import numpy as np

from glstar.calibrate import Calibration, GeometryCalibration, detect_stars, identify_again, read_image
from glstar.cli.calibration.inputs import camera_of, exposure_s, references
from glstar.cli.calibration.output import files_of, report_lines, write_files
from glstar.cli.calibration.run import DetectedPhotograph, Identified, calibrated_image, given_solution, with_zenith
from glstar.cli.calibration.settings import CalibrateOptions
from glstar.sky.catalogue.reading import star_label
from glstar.sky.place.timescale import parse_utc
from glstar.viewer.picture.fitting import CalibratedPhoto, CalibrationProgress, CalibrationRequest

# A removed detection is at most this far from where the user saw it, px.
_SAME_PX = 0.5


def calibration_of(request: CalibrationRequest, progress: CalibrationProgress) -> CalibratedPhoto:
    """Calibrate a camera from a photograph; see `glstar.viewer.picture.fitting.CalibratePhoto`.

    Raises CalibrationError if the photograph cannot be calibrated; ConfigError if the inputs are not valid.
    """
    options = CalibrateOptions(
        config=None,
        fov_deg=_fov_deg(request),
        exposures_s=None if request.exposure_s is None else [request.exposure_s],
        utc=[request.utc] if request.utc else None,
        site_deg={},
        attitude_deg={},
        flight=None,
        labels=None,
        channel="value",
        bit_depth=None,
        criterion="median",
        lens="auto",
        fit_lens=False,
        geometry_only=request.geometry_only,
        shape=False,
    )
    part = _first(request, progress) if request.before is None else _again(request, progress)
    progress.begin("fitting lens and sensor", 3)
    part = with_zenith(part)
    return _result(part, calibrated_image(part, options, single=True, lens_is_fitted=False))


def _fov_deg(request: CalibrationRequest) -> float | None:
    return None if request.fov_rad is None else float(np.rad2deg(request.fov_rad))


def _first(request: CalibrationRequest, progress: CalibrationProgress) -> Identified:
    """Read a photograph and identify its stars."""
    progress.begin("reading", 0)
    image = read_image(request.path)
    progress.pixels, progress.white_dn = image.pixels_dn.astype(np.uint16), image.saturation_dn
    duration_s = 0.0 if request.geometry_only else exposure_s(request.exposure_s, image)
    settings = request.config
    camera = camera_of(image, settings if request.fov_rad is None else None, _fov_deg(request), known=False)
    utc_s = parse_utc(request.utc) if request.utc else None
    site_deg = None if request.site_rad is None else tuple(np.rad2deg(request.site_rad).tolist())
    [reference] = references(settings, [utc_s], site_deg, None, None)
    progress.begin("detecting stars", 1)
    detected = detect_stars(image)
    progress.detected_px = detected.xy_px
    progress.begin("identifying stars", 2)
    focal_known = request.fov_rad is None
    solution = given_solution(settings, reference, camera)
    return DetectedPhotograph(image, duration_s, detected, reference, camera, solution, None, focal_known).identified()


def _again(request: CalibrationRequest, progress: CalibrationProgress) -> Identified:
    """Identify the stars of the last result again, without those that the user removed."""
    assert request.before is not None
    before, detected, solution = request.before.state
    removed = np.zeros(len(detected), dtype=bool)
    for position in request.removed_px:
        removed |= np.linalg.norm(detected.xy_px - position, axis=1) < _SAME_PX
    progress.begin("identifying stars", 2)
    kept = detected.without(removed)
    matches = identify_again(kept, before.reference.stars, solution)
    return Identified(before.image, before.exposure_s, kept, before.reference, before.method, matches)


def _result(part: Identified, result: Calibration | GeometryCalibration) -> CalibratedPhoto:

    matches, stars = result.matches, result.reference.stars
    named = [
        stars.name[star] or star_label(stars.catalogue, int(stars.star_id[star])) for star in matches.star.tolist()
    ]

    def save(path: Path) -> list[Path]:
        path = path.with_suffix(".toml")
        files = files_of(result, with_toml=True)
        write_files(path, files)
        return [path.with_suffix(suffix) for suffix in files]

    return CalibratedPhoto(
        tuple(named),
        stars.vmag[matches.star],
        part.detected.xy_px[matches.detection],
        matches.residual_px,
        tuple(report_lines(result)),
        result.notes,
        result.to_toml(),
        save,
        (part, part.detected, matches.solution),
    )
