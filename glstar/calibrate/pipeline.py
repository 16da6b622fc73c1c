"""The calibration from image files to sensor and camera: read, detect, identify, fit, combine.

`calibrate_photographs` does all of it, for ``glstar camera calibrate`` and `glstar.calibrate_photographs`.  The
window runs the steps one by one, and solves again without the stars that the user removes.  Teague & Chahl, section
2.5.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from glstar.calibrate.geometry.camera import GeometryCalibration, SharedGeometry, calibrate_geometry, share_geometry
from glstar.calibrate.geometry.lenschoice import LensChoice
from glstar.calibrate.geometry.lensfit import SharedLensFit, fit_lens, fit_shared_lens
from glstar.calibrate.geometry.readout import fit_readout as fit_readout_time
from glstar.calibrate.geometry.readout import search_readout
from glstar.calibrate.geometry.zenith import find_zenith
from glstar.calibrate.identify.hints import identify_by_labels, identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.inputs import ImageReference, PhotographInputs, inputs_of
from glstar.calibrate.notes import Note, NoteKind, notes_without
from glstar.calibrate.photo.detection import DetectedStars, detect_stars
from glstar.calibrate.photo.photograph import Channel, Photograph, linearised, read_image
from glstar.calibrate.photo.sky import fit_gamma
from glstar.calibrate.sensor.brightness import above_air, above_air_together, with_air_noted
from glstar.calibrate.sensor.calibration import Calibration, calibrate, with_point_spread
from glstar.calibrate.sensor.combine import CombinedCalibration, combine, draw_combined
from glstar.calibrate.sensor.fit import Criterion
from glstar.calibrate.sensor.report import draw_geometry, draw_report
from glstar.camera.camerafile import camera_to_yaml
from glstar.camera.model import Camera
from glstar.camera.photofile import read_exif
from glstar.config import Config
from glstar.errors import CalibrationError, ConfigError

CalibrationResult: TypeAlias = Calibration | CombinedCalibration | GeometryCalibration | SharedGeometry

# A given attitude is reported as wrong if the optical axis is off by more than this, rad.
_ATTITUDE_TOLERANCE_RAD = np.deg2rad(0.02)
# Progress steps of an image: read, detected, identified, calibrated.
_STEPS = 4
# Suffix of the stars' measured brightness, beside the calibration of several photographs.
BRIGHTNESS_SUFFIX = ".brightness.csv"


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationOptions:
    """The measurements to make on photographs; see `calibrate_photographs`."""

    channel: Channel = "value"
    bit_depth: int | None = None
    gamma: str | None = "linear"
    criterion: Criterion = "median"
    lens: LensChoice = "auto"
    fit_lens: bool = False
    fit_readout: bool = False
    geometry_only: bool = False
    shape: bool = False
    extinction: str = "none"

    def require_consistent(self, images: int, *, has_times: bool, has_labels: bool) -> None:
        """Raise ConfigError if options contradict each other or the number of images.

        `has_times`: whether flight and times are given; `has_labels`: whether labels are.
        """
        if not images:
            raise ConfigError("a calibration needs a photograph, and there is none")
        if self.fit_readout and not has_times:
            raise ConfigError(
                "--fit-readout needs --flight and --utc: how the aircraft turned while the rows were read"
            )
        if self.extinction != "none":
            self._require_extinction()
        if images > 1:
            self._require_options_of_several(has_labels=has_labels)
        elif self.fit_lens:
            raise ConfigError("--fit-lens needs several images: the lens of a single one is always fitted, see --lens")

    def _require_extinction(self) -> None:
        if self.extinction != "fit":
            try:
                is_valid = 0 <= float(self.extinction) <= 10
            except ValueError:
                is_valid = False
            if not is_valid:
                raise ConfigError(
                    f"--extinction is none, fit or a magnitude per air mass from 0 to 10, not {self.extinction!r}"
                )
        if self.geometry_only:
            raise ConfigError(
                "--extinction belongs to the brightness of the stars: leave --twin and --geometry-only out"
            )

    def _require_options_of_several(self, *, has_labels: bool) -> None:
        if self.geometry_only and not self.fit_lens:
            raise ConfigError("--geometry-only of several images needs --fit-lens: one lens for all of them")
        if self.shape:
            raise ConfigError("--shape takes one image: calibrate the sharpest one with it")
        if self.gamma in (None, "fit"):
            raise ConfigError(
                "--gamma fit takes one image: fit it on that with the widest range of sky, and give the number"
            )
        if has_labels:
            raise ConfigError("--labels belong to one image: leave them out, or calibrate the images one by one")
        if self.criterion == "paper":
            raise ConfigError("--criterion paper, eq. (38), takes one image; several use the median of all their stars")

    @property
    def extinction_mag(self) -> float | None:
        """The given extinction per air mass, mag; None if it is fitted."""
        return None if self.extinction == "fit" else float(self.extinction)


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedPhotograph:
    """A photograph with identified stars."""

    image: Photograph
    exposure_s: float  # 0 if only the geometry is calibrated
    detected: DetectedStars
    reference: ImageReference
    method: str  # How the stars were identified
    matches: Matches

    def with_zenith(self) -> "IdentifiedPhotograph":
        """Return a photograph without time or site with the zenith that its refraction shows, if it shows one."""
        stars = find_zenith(
            self.detected, self.reference.stars, self.matches, refraction_scale=self.reference.refraction_scale
        )
        return replace(self, reference=replace(self.reference, stars=stars))

    def calibrated(
        self, options: CalibrationOptions, *, is_only: bool = True, lens_is_fitted: bool = False
    ) -> Calibration | GeometryCalibration:
        """Return the calibration; of a single photograph without a usable sensor, the geometry and the reason.

        `is_only`: whether it is the only photograph; `lens_is_fitted`: whether the matches have the fitted lens.
        """
        image, detected, stars, matches = self.image, self.detected, self.reference.stars, self.matches
        if not lens_is_fitted:
            matches = fit_lens(detected, stars, matches, lens=options.lens)
        matches = replace(matches, notes=(*matches.notes, *self.reference.notes))
        geometry = calibrate_geometry(image, detected, stars, matches, method=self.method)
        if options.geometry_only:
            return geometry
        try:
            calibration = calibrate(
                image,
                detected,
                stars,
                matches,
                method=self.method,
                exposure_s=self.exposure_s,
                criterion=options.criterion,
            )
            if is_only and options.extinction != "none":
                calibration = above_air(calibration, options.extinction_mag)
            elif options.extinction == "none":
                calibration = with_air_noted(calibration)
            return with_point_spread(calibration) if options.shape else calibration
        except CalibrationError as error:
            if not is_only or options.extinction != "none":
                raise
            reason = Note(NoteKind.SENSOR, f"camera and attitude only, no sensor: {error}")
            return replace(geometry, notes=(reason, *geometry.notes))


@dataclass(frozen=True, slots=True, eq=False)
class DetectedPhotograph:
    """A photograph with detected stars, and what is known to identify them."""

    image: Photograph
    exposure_s: float  # 0 if only the geometry is calibrated
    camera: Camera
    detected: DetectedStars
    inputs: PhotographInputs

    @property
    def _given(self) -> PlateSolution | None:
        """The solution by the given attitude; None without one, and with labels."""
        return None if self.inputs.labels is not None else self.inputs.solution(self.camera)

    def identified(self, readout_s: float | None = None) -> IdentifiedPhotograph:
        """Return the photograph with identified stars, with another readout time if one is given."""
        reference = self.inputs.reference
        try:
            return self._identified_among(reference, readout_s)
        except CalibrationError:
            if not reference.is_by_exif:
                raise
            return self._identified_among(reference.without_place(), readout_s)

    def _identified_among(self, reference: ImageReference, readout_s: float | None) -> IdentifiedPhotograph:
        rows = reference.stars.rows
        if readout_s is not None and rows is not None:
            reference = replace(reference, stars=replace(reference.stars, rows=rows.with_readout_s(readout_s)))
        detected, stars, given, camera = self.detected, reference.stars, self._given, self.camera
        focal_known, labels = self.inputs.focal_is_known, self.inputs.labels
        if labels is not None:
            method = "by labels"
            matches = identify_by_labels(detected, stars, labels, camera, focal_known=focal_known)
        elif given is None:
            method = "by their pattern"
            matches = identify_lost(detected, stars, reference.catalogue, camera)
        else:
            method = "by attitude"
            matches = identify_near(detected, stars, given, focal_known=focal_known)
        as_read = tuple(Note(NoteKind.CAMERA, text) for text in self.image.notes)
        matches = replace(matches, notes=(*matches.notes, *as_read, *self.attitude_notes(matches)))
        return IdentifiedPhotograph(self.image, self.exposure_s, detected, reference, method, matches)

    def attitude_notes(self, matches: Matches) -> tuple[Note, ...]:
        """Return a note on the error of the given attitude, if it is noticeable."""
        given = self._given
        if given is None:
            return ()
        cosine = float(np.clip(given.C_camera_eq[2] @ matches.solution.C_camera_eq[2], -1, 1))
        error_rad = float(np.arccos(cosine))
        if error_rad < _ATTITUDE_TOLERANCE_RAD:
            return ()
        text = f"the given attitude points {np.rad2deg(error_rad):.2f} deg away from the camera's direction"
        return (Note(NoteKind.ATTITUDE, text),)


def calibrate_photographs(
    images: str | Path | Sequence[str | Path],
    *,
    config: Config | str | Path | None = None,
    fov_deg: float | None = None,
    exposure_s: float | Sequence[float] | None = None,
    utc: str | Sequence[str] | None = None,
    site_deg: Sequence[float] | None = None,
    attitude_deg: Sequence[float] | None = None,
    flight: str | Path | None = None,
    labels: str | Path | None = None,
    channel: Channel = "value",
    bit_depth: int | None = None,
    gamma: str | None = "linear",
    criterion: Criterion = "median",
    lens: LensChoice = "auto",
    fit_lens: bool = False,
    fit_readout: bool = False,
    geometry_only: bool = False,
    shape: bool = False,
    extinction: str | float = "none",
    on_step: Callable[[int, int], None] | None = None,
    on_note: Callable[[str], None] | None = None,
) -> CalibrationResult:
    """Calibrate sensor and camera from photographs of the stars, as ``glstar camera calibrate`` does.

    The stars are identified by labels, if they are given; else by attitude, site and time, or a flight; else by their
    pattern, for which the tetra3rs library is needed.  Either `fov_deg` or `config` says how wide the view is.

    Parameters
    ----------
    images : path or sequence of paths
        Photographs by one camera: JPEG, PNG, TIFF, WebP, FITS, DNG and other raw files, or HEIC, as the sensor read
        them.  Several also measure the brightness of each star.
    config : Config or path, optional
        Settings whose camera took the photographs, and whose mount, catalogue and air apply.  Default: glstar's own
        settings, without their camera.
    fov_deg : float, optional
        Width of the view, deg, to 15 %.  Default: that of the config's camera.
    exposure_s : float or sequence of float, optional
        Exposure, s, once or once per image.  Default: as the files state.
    utc : str or sequence of str, optional
        Mid-exposure of each image, UTC, ISO 8601; with `flight`, by the camera's clock.  Default: that of EXIF, if its
        time zone is known.
    site_deg : sequence of two floats, optional
        Latitude (north positive) and longitude (east positive), deg.  Default: that of EXIF, with its time.
    attitude_deg : sequence of three floats, optional
        Yaw, pitch and roll of the aircraft, deg, right to some degrees.
    flight : path, optional
        A log with position and attitude at each time of `utc`.
    labels : path, optional
        A CSV file of known stars on a single image: ``x``, ``y``, ``star_id``; px.
    channel : {"value", "red", "green", "blue", "mean"}
        Channel of a colour image; ``"value"`` is the largest of the three.
    bit_depth : int, optional
        Bits of the converter, for raw images in 16 bits.  Default: detected.
    gamma : str or None
        Tone curve of processed images: ``"linear"``, ``"srgb"``, ``"rpi"``, a number such as ``"2.2"``, or ``"fit"``
        to the noise of the sky.  None fits too, and says nothing about an image that may be linear.
    criterion : {"median", "paper"}
        Reference brightness: the median of all stars, or the single star of the paper's eq. (38).
    lens : {"auto", "none", "plumb_bob", "rational", "fisheye"}
        OpenCV's lens model; ``"auto"`` chooses the one that the stars justify.
    fit_lens : bool
        Fit one lens to all images together, with an attitude for each.
    fit_readout : bool
        Fit the readout time of a rolling shutter; needs `flight`, `utc` and a turning aircraft.
    geometry_only : bool
        Camera and attitude without the sensor, for blurred or saturated stars; needs no exposure.
    shape : bool
        Fit wings, ellipticity and growth off axis of the stars of a single image.
    extinction : str or float
        ``"none"`` for a brightness below the air; above it, ``"fit"`` or the extinction, mag per air mass.
    on_step : callable, optional
        Called with the numbers of steps done and of all steps.
    on_note : callable, optional
        Called with remarks about the tone curve; all others are in the result's ``notes``.

    Returns
    -------
    Calibration, CombinedCalibration, GeometryCalibration or SharedGeometry
        The sensor and the camera of one photograph or of several; or the camera of one or of several, with
        `geometry_only` and where a single photograph does not show the sensor.  ``to_toml()`` is a config,
        ``to_json()`` has all numbers; `calibration_files` makes the files of the command.

    Raises
    ------
    CalibrationError
        An image cannot be read, or its stars cannot be identified or measured.
    ConfigError
        Inputs contradict each other; the message names the options of ``glstar camera calibrate``.

    References
    ----------
    Teague & Chahl, section 2.5.
    """
    paths = [Path(images)] if isinstance(images, str | Path) else [Path(image) for image in images]
    options = CalibrationOptions(
        channel=channel,
        bit_depth=bit_depth,
        gamma=gamma,
        criterion=criterion,
        lens=lens,
        fit_lens=fit_lens,
        fit_readout=fit_readout,
        geometry_only=geometry_only,
        shape=shape,
        extinction=str(extinction),
    )
    options.require_consistent(len(paths), has_times=flight is not None and bool(utc), has_labels=labels is not None)
    inputs = inputs_of(
        len(paths),
        config=Config.load(config) if isinstance(config, str | Path) else config,
        fov_deg=fov_deg,
        exposure_s=exposure_s,
        utc=utc,
        site_deg=site_deg,
        attitude_deg=attitude_deg,
        flight=flight,
        labels=labels,
        fit_readout=fit_readout,
        exif=[read_exif(path) for path in paths],
    )
    steps = _STEPS * len(paths) + (len(paths) > 1)
    step = (lambda done: on_step(done, steps)) if on_step is not None else _ignore
    identified = _identified(paths, inputs, options, step, on_note or _ignore)
    return _calibrated(identified, options, step)


def _ignore(_: object) -> None:
    """Do nothing with progress, or a remark, where the caller gave no function for it."""


def read_light(path: Path, options: CalibrationOptions, on_note: Callable[[str], None] = _ignore) -> Photograph:
    """Return the light of a photograph: as recorded, without its tone curve."""
    image = read_image(path, channel=options.channel, bit_depth=options.bit_depth)
    gamma = options.gamma
    if gamma not in (None, "fit"):
        return linearised(image, gamma)
    curve = fit_gamma(image, detect_stars(image))
    allowed = f"the noise of the sky allows gammas from {curve.low:.2f} to {curve.high:.2f}"
    if curve.value != 1:
        on_note(f"{allowed}; the least curve is taken, --gamma {curve.value:.2f}")
        return linearised(image, f"{curve.value:.2f}")
    if gamma == "fit":
        on_note(f"{allowed}: the image is taken as linear; if it is processed, give --gamma srgb or 2.2")
    return image


def _identified(
    paths: Sequence[Path],
    inputs: Sequence[PhotographInputs],
    options: CalibrationOptions,
    on_step: Callable[[int], None],
    on_note: Callable[[str], None],
) -> list[IdentifiedPhotograph]:
    """Return the photographs with identified stars; their lens is not fitted yet."""
    identified: list[IdentifiedPhotograph] = []
    photographs: list[DetectedPhotograph] = []
    on_step(0)
    for number, (path, given) in enumerate(zip(paths, inputs, strict=True)):
        with _naming(path, paths):
            image = read_light(path, options, on_note)
            duration_s = 0.0 if options.geometry_only else given.exposure_s(image)
            camera = given.camera(image)
            on_step((_STEPS - 1) * number + 1)
            photographs.append(DetectedPhotograph(image, duration_s, camera, detect_stars(image), given))
            on_step((_STEPS - 1) * number + 2)
            if not options.fit_readout:
                identified.append(photographs[-1].identified())
            on_step((_STEPS - 1) * number + 3)
    return identified_with_readout(photographs, options.lens) if options.fit_readout else identified


@contextmanager
def _naming(path: Path, paths: Sequence[Path]) -> Iterator[None]:
    """Name the image in errors, if there are several."""
    try:
        yield
    except CalibrationError as error:
        if len(paths) == 1 or error.path is not None:
            raise
        raise CalibrationError(
            str(error), path=path, stars_used=error.stars_used, stars_needed=error.stars_needed
        ) from error


def identified_with_readout(photographs: Sequence[DetectedPhotograph], lens: LensChoice) -> list[IdentifiedPhotograph]:
    """Return photographs with identified stars and the fitted readout time of their rolling shutter.

    A wrong readout time may leave the stars of an image unidentified: it is searched with the other images first.
    """
    paths = [photograph.image.path for photograph in photographs]
    with_given_time: list[IdentifiedPhotograph] = []
    for photograph in photographs:
        try:
            with _naming(photograph.image.path, paths):
                with_given_time.append(photograph.identified())
        except CalibrationError:
            if not with_given_time and photograph is photographs[-1]:
                raise
    readout_s = search_readout(*_stars_and_matches(with_given_time))
    identified = []
    for photograph in photographs:
        with _naming(photograph.image.path, paths):
            identified.append(photograph.identified(readout_s))
    fit = fit_readout_time([path.name for path in paths], *_stars_and_matches(identified), lens=lens)
    summary = Note(NoteKind.CAMERA, fit.time.summary)
    results = []
    for photograph, part, stars, matches in zip(photographs, identified, fit.reference, fit.matches, strict=True):
        reference = replace(part.reference, stars=stars, notes=(*part.reference.notes, summary))
        # The attitude was judged with another readout time.
        kept = notes_without(matches.notes, frozenset({NoteKind.ATTITUDE}))
        notes = (*kept, *photograph.attitude_notes(matches))
        results.append(replace(part, reference=reference, matches=replace(matches, notes=notes)))
    return results


def _stars_and_matches(
    photographs: Sequence[IdentifiedPhotograph],
) -> tuple[list[DetectedStars], list[ReferenceStars], list[Matches]]:
    detected = [photograph.detected for photograph in photographs]
    reference = [photograph.reference.stars for photograph in photographs]
    return detected, reference, [photograph.matches for photograph in photographs]


def _calibrated(
    identified: Sequence[IdentifiedPhotograph], options: CalibrationOptions, on_step: Callable[[int], None]
) -> CalibrationResult:
    """Return the calibration of photographs with identified stars."""
    identified = [photograph.with_zenith() for photograph in identified]
    paths = [photograph.image.path for photograph in identified]
    is_only = len(paths) == 1
    shared: SharedLensFit | None = None
    if options.fit_lens:
        shared = fit_shared_lens([path.name for path in paths], *_stars_and_matches(identified), lens=options.lens)
        identified = [replace(part, matches=m) for part, m in zip(identified, shared.matches, strict=True)]
    parts: list[Calibration | GeometryCalibration] = []
    for photograph in identified:
        with _naming(photograph.image.path, paths):
            parts.append(photograph.calibrated(options, is_only=is_only, lens_is_fitted=shared is not None))
        on_step((_STEPS - 1) * len(paths) + len(parts))
    if is_only:
        return parts[0]
    result: CombinedCalibration | SharedGeometry
    if shared is not None and options.geometry_only:
        geometries = tuple(part for part in parts if isinstance(part, GeometryCalibration))
        result = share_geometry(geometries, shared)
    else:
        calibrations = tuple(part for part in parts if isinstance(part, Calibration))
        if options.extinction != "none":
            calibrations = above_air_together(calibrations, options.extinction_mag)
        result = combine(calibrations, shared_lens=shared)
    on_step(_STEPS * len(paths) + 1)
    return result


def calibration_files(result: CalibrationResult, name: str) -> dict[str, bytes]:
    """Return the files of a calibration by file name: TOML, JSON, star list and report; of several, also of each.

    `name`: file name of the calibration without ``.toml``.
    """
    if isinstance(result, Calibration | GeometryCalibration):
        return {f"{name}.toml": result.to_toml().encode(), **image_files(result, name)}
    files: dict[str, bytes] = {}
    for part in result.parts:
        files |= image_files(part, f"{name}.{part.image.path.stem}")
    if isinstance(result, SharedGeometry):
        toml, drawn = result.to_toml(), draw_geometry(result.best)
    else:
        table = name + BRIGHTNESS_SUFFIX
        files[table] = result.table.to_csv().encode()
        toml, drawn = result.to_toml(table), draw_combined(result)
    return files | {f"{name}.toml": toml.encode(), f"{name}.json": to_json_file(result.to_json()), f"{name}.png": drawn}


def image_files(part: Calibration | GeometryCalibration, name: str) -> dict[str, bytes]:
    """Return the report, the star list and all numbers of one photograph, by file name."""
    return {
        f"{name}.json": to_json_file(part.to_json()),
        f"{name}.stars.csv": part.to_csv().encode(),
        f"{name}.png": draw_geometry(part) if isinstance(part, GeometryCalibration) else draw_report(part),
    }


def to_json_file(numbers: dict[str, object]) -> bytes:
    """Return the content of a JSON file."""
    return (json.dumps(numbers, indent=1) + "\n").encode()


def camera_file(result: CalibrationResult) -> str:
    """Return the camera of a calibration as YAML: of several photographs, that with the most identified stars."""
    parts = (result,) if isinstance(result, Calibration | GeometryCalibration) else result.parts
    best = max(parts, key=lambda part: len(part.matches))
    errors = ", ".join(f"{name} {error:.2g}" for name, error in best.matches.standard_error.items())
    comments = [f"From the stars of {best.image.path.name}.", *([f"Standard errors: {errors}."] if errors else [])]
    return camera_to_yaml(best.matches.solution.camera, *comments)
