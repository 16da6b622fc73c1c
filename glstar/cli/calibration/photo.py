"""The calibration that the window offers: what ``glstar camera calibrate`` does with one photograph."""

from pathlib import Path

import numpy as np

from glstar.calibrate import pipeline
from glstar.calibrate.geometry.camera import GeometryCalibration
from glstar.calibrate.identify.hints import identify_again
from glstar.calibrate.inputs import inputs_of
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.calibration import Calibration
from glstar.cli.calibration.output import report_lines, write_files
from glstar.sky.catalogue.reading import star_label
from glstar.viewer.picture.fitting import CalibratedPhoto, CalibrationProgress, CalibrationRequest

# A removed detection is at most this far from where the user saw it, px.
_SAME_PX = 0.5


def calibration_of(request: CalibrationRequest, progress: CalibrationProgress) -> CalibratedPhoto:
    """Calibrate a camera from a photograph; see `glstar.viewer.picture.fitting.CalibratePhoto`.

    Raises CalibrationError if the photograph cannot be calibrated; ConfigError if the inputs are not valid.
    """
    options = pipeline.CalibrationOptions(geometry_only=request.geometry_only)
    if request.before is None:
        photograph = _identified(request, options, progress)
    else:
        photograph = _identified_again(request.before, request.removed_px, progress)
    progress.begin("fitting lens and sensor", 3)
    photograph = photograph.with_zenith()
    return _result(photograph, photograph.calibrated(options))


def _identified(
    request: CalibrationRequest, options: pipeline.CalibrationOptions, progress: CalibrationProgress
) -> pipeline.IdentifiedPhotograph:
    """Read a photograph and identify its stars."""
    progress.begin("reading", 0)
    image = pipeline.read_light(request.path, options)
    progress.pixels, progress.white_dn = image.pixels_dn.astype(np.uint16), image.saturation_dn
    [inputs] = inputs_of(
        1,
        config=request.config,
        fov_deg=None if request.fov_rad is None else float(np.rad2deg(request.fov_rad)),
        exposure_s=request.exposure_s,
        utc=request.utc,
        site_deg=None if request.site_rad is None else np.rad2deg(request.site_rad).tolist(),
        exif=[image.exif],
    )
    exposure_s = 0.0 if options.geometry_only else inputs.exposure_s(image)
    camera = inputs.camera(image)
    progress.begin("detecting stars", 1)
    detected = detect_stars(image)
    progress.detected_px = detected.xy_px
    progress.begin("identifying stars", 2)
    return pipeline.DetectedPhotograph(image, exposure_s, camera, detected, inputs).identified()


def _identified_again(
    last: CalibratedPhoto, removed_px: tuple[tuple[float, float], ...], progress: CalibrationProgress
) -> pipeline.IdentifiedPhotograph:
    """Identify the stars of the last result again, without those that the user removed."""
    before, detected, solution = last.state
    removed = np.zeros(len(detected), dtype=bool)
    for position in removed_px:
        removed |= np.linalg.norm(detected.xy_px - position, axis=1) < _SAME_PX
    progress.begin("identifying stars", 2)
    kept = detected.without(removed)
    matches = identify_again(kept, before.reference.stars, solution)
    return pipeline.IdentifiedPhotograph(
        before.image, before.exposure_s, kept, before.reference, before.method, matches
    )


def _result(photograph: pipeline.IdentifiedPhotograph, result: Calibration | GeometryCalibration) -> CalibratedPhoto:
    matches, stars = result.matches, result.reference.stars
    names = [
        stars.name[star] or star_label(stars.catalogue, int(stars.star_id[star])) for star in matches.star.tolist()
    ]

    def save(path: Path) -> list[Path]:
        path = path.with_suffix(".toml")
        return write_files(path, pipeline.calibration_files(result, path.stem), [photograph.image.path])

    return CalibratedPhoto(
        name=tuple(names),
        vmag=stars.vmag[matches.star],
        xy_px=photograph.detected.xy_px[matches.detection],
        residual_px=matches.residual_px,
        report=tuple(report_lines(result)),
        notes=tuple(note.text for note in result.notes),
        toml=result.to_toml(),
        save=save,
        state=(photograph, photograph.detected, matches.solution),
    )
