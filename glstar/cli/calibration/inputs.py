"""Inputs of ``glstar calibrate``: cameras, reference stars and attitudes, labels, times and exposures."""

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate import LONGEST_READOUT_S, Label, Photograph, ReferenceStars, RowTurns
from glstar.camera.model import Camera
from glstar.config import Config
from glstar.config.camera import ExposureSection
from glstar.errors import CalibrationError, ConfigError
from glstar.flight import AttitudeTrack
from glstar.rotation import matrix_from_euler, matrix_from_quaternion
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import read_text

# For images of unknown time: proper motion of most stars is below 1" in a few years.
_DEFAULT_UTC_S: Final = parse_utc("2020-01-01T00:00:00Z")
_ALL_STARS_VMAG: Final = 99.0
# An image is the config's camera, binned, if the ratios of its sides agree to this fraction.
_SAME_ASPECT: Final = 0.01
# Turns during the readout that are smaller than this, deg, are below half a pixel of most cameras.
_LEAST_TURN_DEG: Final = 0.01
# Older files name the last column ``hr``.
_LABEL_COLUMNS: Final = ("x", "y", "star_id")
# Largest label file, bytes; a label has about 30.
_LARGEST_LABELS_BYTES: Final = 2**20


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The stars over an image."""

    stars: ReferenceStars
    C_body_ned: NDArray[np.float64] | None  # (3, 3) or None: the given attitude; None if it is unknown
    catalogue: StarCatalogue
    notes: tuple[str, ...] = ()  # Remarks for the user: what the flight says that the calibration leaves out
    # Refraction of the config's air over that of standard air, for a zenith that only the photograph shows.
    refraction_scale: float = 0.0


def exposures_of(exposures: list[float] | None, images: int) -> list[float | None]:
    """Return the exposure of each image, s; None if it was not given."""
    given = exposures or []
    if len(given) not in (0, 1, images):
        raise ConfigError(f"--exposure is given {len(given)} times for {images} images: give it once, or once each")
    return [given[number % len(given)] if given else None for number in range(images)]


def times_of(utc: list[str] | None, images: int) -> list[float | None]:
    """Return the time of each image, UTC seconds; None if it was not given."""
    if not utc:
        return [None] * images
    if len(utc) != images:
        raise ConfigError(f"--utc is given {len(utc)} times for {images} images: give it once each, or leave it out")
    return [parse_utc(text) for text in utc]


def all_or_none(given: dict[str, float | None]) -> tuple[float, ...] | None:
    """Return the values of options that go together, or None if none was given."""
    missing = [name for name, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise ConfigError(f"{' and '.join(missing)} missing; {', '.join(given)} go together")
    return None if missing else tuple(value for value in given.values() if value is not None)


def exposure_s(given: float | None, photograph: Photograph) -> float:
    """Return the given exposure or the one stated in the file, s."""
    value = photograph.exposure_s if given is None else given
    if value is None:
        message = "does not state its exposure, which the brightness depends on; give --exposure S"
        raise CalibrationError(message, path=photograph.path)
    if not value > 0:
        raise ConfigError(f"--exposure must be a positive number of seconds, not {value}")
    return value


def camera_of(photograph: Photograph, settings: Config | None, fov_deg: float | None, *, known: bool) -> Camera:
    """Return the camera of an image: of the given field of view, or the config's, turned and binned like the image."""
    height, width = photograph.pixels_dn.shape
    if fov_deg is None and settings is None and not known:
        message = "has no known field of view; give --fov DEG (left to right, to 15 %) or --config CAMERA.toml"
        raise CalibrationError(message, path=photograph.path)
    if fov_deg is not None or settings is None:
        f_px = width / 2 / np.tan(np.deg2rad(fov_deg or 60.0) / 2)
        return Camera(width, height, float(f_px), float(f_px), (width - 1) / 2, (height - 1) / 2)
    camera = settings.camera()
    if (width > height) != (camera.width_px > camera.height_px):
        camera = Camera(
            camera.height_px,
            camera.width_px,
            camera.fy_px,
            camera.fx_px,
            camera.height_px - 1 - camera.cy_px,
            camera.cx_px,
            lens=None if camera.lens is None else camera.lens.rotated_by_quarter(),
        )
    across, down = width / camera.width_px, height / camera.height_px
    if abs(across / down - 1) > _SAME_ASPECT:
        raise CalibrationError(
            f"is {width} x {height} px and the config's camera {camera.width_px} x {camera.height_px}: not the same"
            " camera, even binned; give --fov DEG instead",
            path=photograph.path,
        )
    return Camera(
        width,
        height,
        camera.fx_px * across,
        camera.fy_px * down,
        (camera.cx_px + 0.5) * across - 0.5,
        (camera.cy_px + 0.5) * down - 0.5,
        camera.skew_px * across,
        camera.lens,
    )


def references(
    settings: Config,
    times_utc_s: list[float | None],
    site_deg: tuple[float, ...] | None,
    attitude_deg: tuple[float, ...] | None,
    log: Path | None,
    *,
    fit_readout: bool = False,
) -> list[Reference]:
    """Return the reference stars and the attitude of each image, with the turns of its rows if it has them."""
    catalogue = StarCatalogue.open(settings.sky.catalogue).brighter_than(_ALL_STARS_VMAG)
    sky = Sky(catalogue, ASTROMETRY[settings.sky.astrometry], settings.sky.dut1_s, settings.sky.refraction)
    air = {"pressure_hpa": settings.air.pressure_hpa, "temperature_c": settings.air.temperature_c}
    if log is not None and None in times_utc_s:
        raise ConfigError("--flight needs --utc, the time of the photograph")
    recorded = None if log is None else settings.open_flight(log)
    found: list[Reference] = []
    # With a log, --utc is the time by the camera's clock.
    ahead_s = 0.0 if recorded is None else recorded.time_offset_s
    for camera_utc_s in times_utc_s:
        utc_s = None if camera_utc_s is None else camera_utc_s - ahead_s
        C_body_ned: NDArray[np.float64] | None = None
        site: Site | None = None
        notes: tuple[str, ...] = ()
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
        if utc_s is None and found:
            found.append(found[0])  # this image has no inputs either
        elif utc_s is None or site is None:
            stars = ReferenceStars.anywhere(sky, _DEFAULT_UTC_S if utc_s is None else utc_s)
            scale = sky.refraction_scale(replace(Site(0.0, 0.0), **air))
            found.append(Reference(stars, None, catalogue, refraction_scale=scale))
        else:
            stars = ReferenceStars.over(sky, utc_s, replace(site, **air))
            if recorded is not None:
                stars, notes = _with_rows(stars, recorded.attitude, utc_s, settings.exposure, fit_readout=fit_readout)
            found.append(Reference(stars, C_body_ned, catalogue, notes))
    return found


def _with_rows(
    stars: ReferenceStars, attitude: AttitudeTrack, utc_s: float, exposure: ExposureSection, *, fit_readout: bool
) -> tuple[ReferenceStars, tuple[str, ...]]:
    """Return the stars with the turn of the aircraft while a rolling shutter reads the image, and a note on it."""
    if stars.C_ned_eq is None or not (exposure.readout_s or fit_readout):
        return stars, ()
    rows = RowTurns(attitude, utc_s, stars.C_ned_eq, exposure.readout_s, exposure.readout)
    rows.require_covered(LONGEST_READOUT_S if fit_readout else exposure.readout_s)
    turned = replace(stars, rows=rows)
    turn_deg = float(np.rad2deg(rows.rate_rad_per_s(rows.readout_s) * rows.readout_s)) if rows.readout_s else 0.0
    if fit_readout or turn_deg < _LEAST_TURN_DEG:
        return turned, ()
    return turned, (
        f"the aircraft turned by {turn_deg:.2f} deg while the rolling shutter read the image ({1e3 * rows.readout_s:g}"
        " ms), as the log says: camera and attitude are those of the middle row",
    )


def read_labels(path: Path) -> list[Label]:
    """Return the labelled stars of a CSV file with the columns x, y and star_id, in any order, or without a header."""
    try:
        rows = list(csv.reader(read_text(path, _LARGEST_LABELS_BYTES).splitlines()))
    except (ValueError, csv.Error) as error:
        raise CalibrationError(f"cannot be read as labels: {error}", path=path) from error
    rows = [[cell.strip() for cell in row] for row in rows if any(cell.strip() for cell in row)]
    header = [cell.lower().removesuffix("_px") for cell in rows[0]] if rows else []
    header = ["star_id" if cell == "hr" else cell for cell in header]
    columns = [header.index(name) for name in _LABEL_COLUMNS] if set(_LABEL_COLUMNS) <= set(header) else [0, 1, 2]
    found = []
    for number, row in enumerate(rows, start=1):
        if number == 1 and set(_LABEL_COLUMNS) <= set(header):
            continue
        try:
            x, y, star_id = (row[column] for column in columns)
            found.append(Label(float(x), float(y), int(star_id)))
        except (ValueError, IndexError) as error:
            message = f"line {number} is no label; each line holds x, y and a star's number"
            raise CalibrationError(message, path=path) from error
    return found
