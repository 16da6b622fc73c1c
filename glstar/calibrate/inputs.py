"""Facts about photographs before their stars are identified: camera, time, site, attitude, exposure, labels."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.geometry.readout import LONGEST_READOUT_S
from glstar.calibrate.identify.hints import Label
from glstar.calibrate.identify.platesolution import PlateSolution, ReferenceStars, nominal_camera
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.model import Camera
from glstar.camera.photofile import Exif
from glstar.config import Config
from glstar.config.camera import ExposureSection
from glstar.errors import CalibrationError, ConfigError, reading
from glstar.flight import AttitudeTrack
from glstar.rotation import matrix_from_euler, matrix_from_quaternion
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import format_utc, parse_utc
from glstar.system.userinput import read_text, refuse_repeated

# For images of unknown time: proper motion of most stars is below 1" in a few years.
_DEFAULT_UTC_S = parse_utc("2020-01-01T00:00:00Z")
_ALL_STARS_VMAG = 99.0
# Width of the view of a camera of which only labels are known, deg.
_UNKNOWN_FOV_DEG = 60.0
# An image is the config's camera, binned, if the ratios of its sides agree to this fraction.
_SAME_ASPECT = 0.01
# Turns during the readout that are smaller than this, deg, are below half a pixel of most cameras.
_LEAST_TURN_DEG = 0.01
# Older files name the last column ``hr``.
_LABEL_COLUMNS = ("x", "y", "star_id")
# Largest label file, bytes; a label has about 30.
_LARGEST_LABELS_BYTES = 2**20


@dataclass(frozen=True, slots=True, eq=False)
class ImageReference:
    """The stars over an image, and the attitude that is given for it."""

    stars: ReferenceStars
    C_body_ned: NDArray[np.float64] | None  # (3, 3); None if it is unknown
    catalogue: StarCatalogue
    notes: tuple[Note, ...] = ()  # What the flight says that the calibration leaves out
    # Refraction of the config's air over that of standard air, for a zenith that only the photograph shows.
    refraction_scale: float = 0.0
    # Whether time and place are those of EXIF only, and may be wrong.
    is_by_exif: bool = field(kw_only=True)

    def without_place(self) -> "ImageReference":
        """Return the same stars of the whole sphere, for a photograph whose EXIF is wrong."""
        nowhere = replace(
            self.stars, zenith_eq=np.zeros(3), velocity_eq=np.zeros(3), refraction_scale=0.0, C_ned_eq=None
        )
        text = "the stars are not those over the time and place of its EXIF, which are not used: is its clock right?"
        notes = (Note(NoteKind.CAMERA, text),)
        return ImageReference(nowhere, None, self.catalogue, notes, self.stars.refraction_scale, is_by_exif=False)


@dataclass(frozen=True, slots=True, eq=False)
class PhotographInputs:
    """What is known of one photograph; see `glstar.calibrate.pipeline.calibrate_photographs`."""

    config: Config
    has_camera: bool  # Whether the config's camera took the photograph
    reference: ImageReference
    given_exposure_s: float | None
    fov_deg: float | None
    labels: list[Label] | None

    @property
    def focal_is_known(self) -> bool:
        """Whether the focal length is right to 1 %; otherwise to 15 %."""
        return self.has_camera and self.fov_deg is None

    def exposure_s(self, photograph: Photograph) -> float:
        """Return the given exposure or the one stated in the file, s."""
        value = photograph.exposure_s if self.given_exposure_s is None else self.given_exposure_s
        if value is None:
            message = "does not state its exposure, which the brightness depends on; give --exposure S"
            raise CalibrationError(message, path=photograph.path)
        if not value > 0:
            raise ConfigError(f"--exposure must be a positive number of seconds, not {value}")
        return value

    def camera(self, photograph: Photograph) -> Camera:
        """Return the camera of the given field of view, or the config's, turned and binned like the photograph."""
        height, width = photograph.pixels_dn.shape
        if self.focal_is_known:
            return _binned(_oriented(self.config.camera(), is_wide=width > height), photograph)
        if self.fov_deg is None and self.labels is None:
            message = "has no known field of view; give --fov DEG (left to right, to 15 %) or --config CAMERA.toml"
            raise CalibrationError(message, path=photograph.path)
        return nominal_camera(width, height, float(np.deg2rad(self.fov_deg or _UNKNOWN_FOV_DEG)))

    def solution(self, camera: Camera) -> PlateSolution | None:
        """Return the plate solution by the given attitude, mount and camera; None without an attitude."""
        C_body_ned, C_ned_eq = self.reference.C_body_ned, self.reference.stars.C_ned_eq
        if C_body_ned is None or C_ned_eq is None:
            return None
        return PlateSolution(camera, self.config.mount().C_camera_body @ C_body_ned @ C_ned_eq)


def inputs_of(
    images: int,
    *,
    config: Config | None = None,
    fov_deg: float | None = None,
    exposure_s: float | Sequence[float] | None = None,
    utc: str | Sequence[str] | None = None,
    site_deg: Sequence[float] | None = None,
    attitude_deg: Sequence[float] | None = None,
    flight: str | Path | None = None,
    labels: str | Path | None = None,
    fit_readout: bool = False,
    exif: Sequence[Exif] = (),
) -> list[PhotographInputs]:
    """Return what is known of each of some photographs.

    The parameters are those of `glstar.calibrate.pipeline.calibrate_photographs`, and `exif`, of each photograph:
    without `utc` its time is that of its EXIF, and without `site_deg` its place.  Raises CalibrationError if the labels
    cannot be read, and ConfigError if the inputs contradict each other.
    """
    settings = Config() if config is None else config
    exposures_s = _exposures(exposure_s, images)
    times_utc_s = _times(utc, images)
    known_labels = None if labels is None else read_labels(Path(labels))
    own = list(exif) if exif and not utc else [Exif()] * images
    if site_deg is not None or flight is not None:
        own = [replace(known, site_deg=None) for known in own]
    moments = [_Moment.of(*known) for known in zip(times_utc_s, own, exposures_s, strict=True)]
    references = _references(settings, moments, site_deg, attitude_deg, flight, fit_readout=fit_readout)
    return [
        PhotographInputs(
            config=settings,
            has_camera=config is not None,
            reference=reference,
            given_exposure_s=duration_s,
            fov_deg=fov_deg,
            labels=known_labels,
        )
        for reference, duration_s in zip(references, exposures_s, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class _Moment:
    """When and where a photograph was taken, as far as it is known."""

    utc_s: float | None  # The middle of the exposure
    site_deg: tuple[float, float] | None = None  # By EXIF, if nothing else states the place
    is_exif: bool = False
    notes: tuple[Note, ...] = ()

    @classmethod
    def of(cls, utc_s: float | None, exif: Exif, exposure_s: float | None) -> "_Moment":
        """Return the given time, or the time and place of EXIF whose time zone is known."""
        if utc_s is not None or exif.utc_s is None:
            return cls(utc_s)
        if exif.zone is None:
            text = "its EXIF has a time without a zone, which is not used; give --utc, and --lat and --lon"
            return cls(None, notes=(Note(NoteKind.CAMERA, text),))
        # The clock of a camera is read as the shutter opens.
        middle_s = exif.utc_s + (exposure_s or exif.exposure_s or 0.0) / 2
        text = f"time by EXIF, {exif.zone}: {format_utc(middle_s)}"
        if exif.site_deg is not None:
            text += f"; place by EXIF: {exif.site_deg[0]:.4f}, {exif.site_deg[1]:.4f} deg"
        return cls(middle_s, exif.site_deg, is_exif=True, notes=(Note(NoteKind.CAMERA, text),))


def _exposures(exposure_s: float | Sequence[float] | None, images: int) -> list[float | None]:
    """Return the exposure of each image, s; None if it was not given."""
    if exposure_s is None:
        return [None] * images
    given = [exposure_s] if isinstance(exposure_s, int | float) else list(exposure_s)
    if len(given) not in (0, 1, images):
        raise ConfigError(f"--exposure is given {len(given)} times for {images} images: give it once, or once each")
    return [given[number % len(given)] if given else None for number in range(images)]


def _times(utc: str | Sequence[str] | None, images: int) -> list[float | None]:
    """Return the time of each image, UTC seconds; None if it was not given."""
    if not utc:
        return [None] * images
    given = [utc] if isinstance(utc, str) else utc
    if len(given) != images:
        raise ConfigError(f"--utc is given {len(given)} times for {images} images: give it once each, or leave it out")
    return [parse_utc(text) for text in given]


def _oriented(camera: Camera, *, is_wide: bool) -> Camera:
    """Return a camera turned by a quarter if only one of it and the image is in portrait format."""
    if is_wide == (camera.width_px > camera.height_px):
        return camera
    return Camera(
        width_px=camera.height_px,
        height_px=camera.width_px,
        fx_px=camera.fy_px,
        fy_px=camera.fx_px,
        cx_px=camera.height_px - 1 - camera.cy_px,
        cy_px=camera.cx_px,
        lens=None if camera.lens is None else camera.lens.rotated_by_quarter(),
    )


def _binned(camera: Camera, photograph: Photograph) -> Camera:
    """Return a camera binned to the size of a photograph."""
    height, width = photograph.pixels_dn.shape
    across, down = width / camera.width_px, height / camera.height_px
    if abs(across / down - 1) > _SAME_ASPECT:
        raise CalibrationError(
            f"is {width} x {height} px and the config's camera {camera.width_px} x {camera.height_px}: not the same"
            " camera, even binned; give --fov DEG instead",
            path=photograph.path,
        )
    return Camera(
        width_px=width,
        height_px=height,
        fx_px=camera.fx_px * across,
        fy_px=camera.fy_px * down,
        cx_px=(camera.cx_px + 0.5) * across - 0.5,
        cy_px=(camera.cy_px + 0.5) * down - 0.5,
        skew_px=camera.skew_px * across,
        lens=camera.lens,
    )


def _references(
    config: Config,
    moments: Sequence[_Moment],
    site_deg: Sequence[float] | None,
    attitude_deg: Sequence[float] | None,
    flight: str | Path | None,
    *,
    fit_readout: bool,
) -> list[ImageReference]:
    """Return the reference stars and the attitude of each image, with the turns of its rows if it has them."""
    catalogue = StarCatalogue.open(config.sky.catalogue).brighter_than(_ALL_STARS_VMAG)
    sky = Sky(catalogue, ASTROMETRY[config.sky.astrometry], config.sky.dut1_s, config.sky.refraction)
    air = {"pressure_hpa": config.air.pressure_hpa, "temperature_c": config.air.temperature_c}
    if flight is not None and any(moment.utc_s is None for moment in moments):
        raise ConfigError("--flight needs --utc, the time of the photograph")
    recorded = None if flight is None else config.open_flight(flight)
    references: list[ImageReference] = []
    # With a log, the times are those of the camera's clock.
    clock_offset_s = 0.0 if recorded is None else recorded.time_offset_s
    without_inputs: ImageReference | None = None
    for moment in moments:
        utc_s = None if moment.utc_s is None else moment.utc_s - clock_offset_s
        C_body_ned: NDArray[np.float64] | None = None
        site: Site | None = None
        notes = moment.notes
        if moment.site_deg is not None:
            site = Site(float(np.deg2rad(moment.site_deg[0])), float(np.deg2rad(moment.site_deg[1])))
        if recorded is not None and utc_s is not None:
            C_body_ned = matrix_from_quaternion(recorded.attitude.at([utc_s]))[0]
            site = recorded.position.at(utc_s)
        if site_deg is not None:
            site = Site(float(np.deg2rad(site_deg[0])), float(np.deg2rad(site_deg[1])))
        if attitude_deg is not None:
            yaw, pitch, roll = np.deg2rad(attitude_deg)
            C_body_ned = matrix_from_euler(roll, pitch, yaw)
            if utc_s is None or site is None:
                raise ConfigError("an attitude needs --utc, --lat and --lon: the sky turns by 15 deg an hour")
        if utc_s is None and without_inputs is not None:
            shares_notes = notes == without_inputs.notes
            references.append(without_inputs if shares_notes else replace(without_inputs, notes=notes))
        elif utc_s is None or site is None:
            stars = ReferenceStars.anywhere(sky, _DEFAULT_UTC_S if utc_s is None else utc_s)
            scale = sky.refraction_scale(replace(Site(0.0, 0.0), **air))
            references.append(ImageReference(stars, None, catalogue, notes, scale, is_by_exif=False))
            without_inputs = references[-1] if utc_s is None else without_inputs
        else:
            stars = ReferenceStars.over(sky, utc_s, replace(site, **air))
            if recorded is not None:
                stars, rolling = _with_rows(stars, recorded.attitude, utc_s, config.exposure, fit_readout=fit_readout)
                notes = (*notes, *rolling)
            is_by_exif = moment.is_exif and C_body_ned is None
            references.append(ImageReference(stars, C_body_ned, catalogue, notes, is_by_exif=is_by_exif))
    return references


def _with_rows(
    stars: ReferenceStars, attitude: AttitudeTrack, utc_s: float, exposure: ExposureSection, *, fit_readout: bool
) -> tuple[ReferenceStars, tuple[Note, ...]]:
    """Return the stars with the turn of the aircraft while a rolling shutter reads the image, and a note on it."""
    if stars.C_ned_eq is None or not (exposure.readout_s or fit_readout):
        return stars, ()
    rows = RowTurns(attitude, utc_s, stars.C_ned_eq, exposure.readout_s, exposure.readout)
    rows.require_covered(LONGEST_READOUT_S if fit_readout else exposure.readout_s)
    stars = replace(stars, rows=rows)
    turn_deg = float(np.rad2deg(rows.rate_rad_per_s(rows.readout_s) * rows.readout_s)) if rows.readout_s else 0.0
    if fit_readout or turn_deg < _LEAST_TURN_DEG:
        return stars, ()
    text = (
        f"the aircraft turned by {turn_deg:.2f} deg while the rolling shutter read the image ({1e3 * rows.readout_s:g}"
        " ms), as the log says: camera and attitude are those of the middle row"
    )
    return stars, (Note(NoteKind.CAMERA, text),)


def read_labels(path: Path) -> list[Label]:
    """Return the labelled stars of a CSV file with the columns x, y and star_id, in any order, or without a header."""
    with reading(path, CalibrationError, "cannot be read as labels"):
        return _read_labels(path)


def _read_labels(path: Path) -> list[Label]:
    rows = list(csv.reader(read_text(path, _LARGEST_LABELS_BYTES).splitlines()))
    rows = [[cell.strip() for cell in row] for row in rows if any(cell.strip() for cell in row)]
    header = [cell.lower().removesuffix("_px") for cell in rows[0]] if rows else []
    header = ["star_id" if cell == "hr" else cell for cell in header]
    has_header = set(_LABEL_COLUMNS) <= set(header)
    if has_header:
        refuse_repeated(header, _LABEL_COLUMNS)
    columns = [header.index(name) for name in _LABEL_COLUMNS] if has_header else [0, 1, 2]
    labels = []
    for number, row in enumerate(rows[has_header:], start=1 + has_header):
        try:
            x, y, star_id = (row[column] for column in columns)
            labels.append(Label(float(x), float(y), int(star_id)))
        except (ValueError, IndexError) as error:
            message = f"line {number} is no label; each line holds x, y and a star's number"
            raise CalibrationError(message, path=path) from error
    return labels
