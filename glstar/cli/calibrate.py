"""``glstar calibrate``: from photographs of the stars to the sensor that the simulator uses."""

import csv
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray

from glstar.camera.camerafile import camera_to_yaml
from glstar.camera.model import Camera
from glstar.cli.flightoptions import ConfigFile
from glstar.cli.progress import progress_bar
from glstar.config import Config
from glstar.errors import CalibrationError, ConfigError
from glstar.rotation import matrix_from_euler, matrix_from_quaternion
from glstar.sky.apparent import ASTROMETRY
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.timescale import parse_utc
from glstar.system.durable import write_atomically
from glstar.system.inputfile import read_text

if TYPE_CHECKING:
    from glstar.calibrate import (
        Calibration,
        CombinedCalibration,
        DetectedStars,
        GeometryCalibration,
        Label,
        Matches,
        PlateSolution,
        ReferenceStars,
        SkyImage,
    )

__all__ = ["calibrate"]

# Proper motion moves few stars by an arcsecond in years: for an image of which nobody knows when.
_ABOUT_UTC_S: Final = parse_utc("2020-01-01T00:00:00Z")
_ALL_STARS_VMAG: Final = 99.0
# Two cameras are one, binned, if their images' sides go together to this.
_SAME_SHAPE: Final = 0.01
# An image read, its stars found, recognised, and calibrated.
_STEPS: Final = 4
# Where the stars' own brightness lies, beside the calibration.
_TABLE: Final = ".brightness.csv"
_SAID_RAD: Final = np.deg2rad(0.02)
# Older files name the last column ``hr``.
_LABEL_COLUMNS: Final = ("x", "y", "star_id")
# A label takes some 30 bytes: more than this are not labels.
_LARGEST_LABELS_BYTES: Final = 2**20


class _Channel(StrEnum):
    value = "value"
    red = "red"
    green = "green"
    blue = "blue"
    mean = "mean"


class _Lens(StrEnum):
    auto = "auto"
    none = "none"
    plumb_bob = "plumb_bob"
    rational = "rational"
    fisheye = "fisheye"


class _Criterion(StrEnum):
    median = "median"
    paper = "paper"


def calibrate(
    images: Annotated[
        list[Path],
        typer.Argument(help="Photographs of the stars by one camera: JPEG, PNG or TIFF.", show_default=False),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The calibration to write; list, report and JSON go beside it.")
    ] = Path("calibration.toml"),
    config: ConfigFile = None,
    fov: Annotated[
        float | None,
        typer.Option(help="How wide the view is, deg, to 15 %.", min=1, max=180, show_default="the config's camera"),
    ] = None,
    exposure: Annotated[
        list[float] | None,
        typer.Option(
            help="How long the shutter was open, s; of several images once for all, or once each.",
            show_default="as the file says",
        ),
    ] = None,
    utc: Annotated[
        list[str] | None,
        typer.Option(
            help="When, in the exposure's middle, ISO 8601; of several images once each.", show_default="unknown"
        ),
    ] = None,
    lat: Annotated[
        float | None, typer.Option(help="Latitude, deg, north positive.", min=-90, max=90, show_default="unknown")
    ] = None,
    lon: Annotated[float | None, typer.Option(help="Longitude, deg, east positive.", show_default="unknown")] = None,
    yaw: Annotated[
        float | None, typer.Option(help="Attitude of the aircraft, deg, to some degrees.", show_default="unknown")
    ] = None,
    pitch: Annotated[float | None, typer.Option(help="Attitude, deg.", show_default="unknown")] = None,
    roll: Annotated[float | None, typer.Option(help="Attitude, deg.", show_default="unknown")] = None,
    flight: Annotated[
        Path | None, typer.Option(help="A log with place and attitude at each --utc.", show_default="none")
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(help="A CSV of x, y, star_id: stars that you know, by HR or HIP number.", show_default="none"),
    ] = None,
    channel: Annotated[_Channel, typer.Option(help="What to take of a colour image.")] = _Channel.value,
    bit_depth: Annotated[
        int | None,
        typer.Option(help="Bits of the converter, for raw images in 16 bits.", min=1, max=16, show_default="seen"),
    ] = None,
    criterion: Annotated[
        _Criterion, typer.Option(help="Reference brightness: the median of all stars, or the paper's one star.")
    ] = _Criterion.median,
    lens: Annotated[
        _Lens, typer.Option(help="OpenCV's lens model to fit to the stars; auto takes what they justify.")
    ] = _Lens.auto,
    geometry_only: Annotated[
        bool,
        typer.Option(
            "--geometry-only",
            help="Camera and attitude only, no sensor: for stars that are blurred or saturated; needs no --exposure.",
        ),
    ] = False,
    camera_out: Annotated[
        Path | None,
        typer.Option(help="Write the camera as a file too, for [camera] file, ROS and OpenCV.", show_default="none"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Calibrate the simulator's sensor from photographs of the stars: brightness, sharpness, sky and noise.

    The stars are recognised from the attitude (--utc, --lat, --lon, --yaw, --pitch, --roll, or --flight and --utc),
    from labels, or from their pattern alone.  Several images also tell how bright the camera sees each star.

    Try: glstar calibrate ground.jpg --fov 60 --exposure 0.5 -o calibration.toml
    """
    from glstar import calibrate as room  # noqa: PLC0415 - OpenCV, SciPy and matplotlib, when they are needed

    if output.suffix.lower() != ".toml":
        raise typer.BadParameter(f"{output} must end with .toml", param_hint="--output")
    settings = Config() if config is None else Config.load(config)
    attitude_deg = _all_or_none({"--yaw": yaw, "--pitch": pitch, "--roll": roll})
    place_deg = _all_or_none({"--lat": lat, "--lon": lon})
    _refuse_what_tells_of_one(labels, criterion, images, geometry_only=geometry_only)
    exposures = _one_each(exposure, len(images))
    times = _times(utc, len(images))
    named = None if labels is None else _labels(labels)
    skies = _skies(settings, times, place_deg, attitude_deg, flight)
    steps = _STEPS * len(images) + (len(images) > 1)
    parts: list[Calibration] = []
    only: GeometryCalibration | None = None
    with progress_bar("steps") as on_step, ThreadPoolExecutor(max_workers=1) as aside:
        on_step(0, steps)
        ready = aside.submit(room.prepare_to_draw)
        for number, image in enumerate(images):
            with _naming(image if len(images) > 1 else None):
                photograph = room.read_image(image, channel=channel.value, bit_depth=bit_depth)
                exposure_s = 0.0 if geometry_only else _exposure_s(exposures[number], photograph)
                camera = _camera(photograph, settings if config is not None else None, fov, known=named is not None)
                on_step(_STEPS * number + 1, steps)
                detected = room.detect_stars(photograph)
                on_step(_STEPS * number + 2, steps)
                focal_known = fov is None and config is not None
                reference, C_body_ned, catalogue = skies[number]
                method, matches = _identified(
                    settings, detected, reference, catalogue, camera, named, C_body_ned, focal_known=focal_known
                )
                matches = room.fit_lens(detected, reference, matches, lens=lens.value)
                on_step(_STEPS * number + 3, steps)
                geometry = room.calibrate_geometry(photograph, detected, reference, matches, method=method)
                alone = len(images) == 1
                part = geometry if geometry_only else _with_sensor(geometry, exposure_s, criterion, alone=alone)
            ready.result()
            _write(
                output if alone else output.with_name(f"{output.stem}.{image.stem}"), _files_of(part, with_toml=alone)
            )
            on_step(_STEPS * number + 4, steps)
            if isinstance(part, room.GeometryCalibration):
                only = part
            else:
                parts.append(part)
        combined = room.combine(tuple(parts)) if len(images) > 1 else None
        if combined is not None:
            _write(output, _files_of_all(combined, output))
            on_step(steps, steps)
    if camera_out is not None:
        _write_camera(camera_out, only or max(parts, key=lambda part: len(part.matches)).geometry)
    _say_result(only or combined or parts[0], output, as_json=as_json)


def _write_camera(path: Path, geometry: "GeometryCalibration") -> None:
    errors = ", ".join(f"{name} {error:.2g}" for name, error in geometry.matches.standard_error.items())
    comments = [f"From the stars of {geometry.image.path.name}.", *([f"Standard errors: {errors}."] if errors else [])]
    written = camera_to_yaml(geometry.matches.solution.camera, *comments)
    _write(path, {"": written.encode()})


def _say_result(
    result: "Calibration | CombinedCalibration | GeometryCalibration", output: Path, *, as_json: bool
) -> None:
    from glstar.calibrate import CombinedCalibration, GeometryCalibration  # noqa: PLC0415

    if as_json:
        typer.echo(json.dumps(result.to_json()))
    elif isinstance(result, GeometryCalibration):
        _say_geometry(result, output)
    elif isinstance(result, CombinedCalibration):
        _say_all(result, output)
    else:
        _say(result, output)


def _one_each(exposures_s: list[float] | None, images: int) -> list[float | None]:
    """Return the exposure of each image, None where nobody gave it."""
    given = exposures_s or []
    if len(given) not in (0, 1, images):
        raise ConfigError(f"--exposure is given {len(given)} times for {images} images: give it once, or once each")
    return [given[number % len(given)] if given else None for number in range(images)]


def _times(utc: list[str] | None, images: int) -> list[float | None]:
    """Return when each image was taken, UTC seconds, None where nobody said it."""
    if not utc:
        return [None] * images
    if len(utc) != images:
        raise ConfigError(f"--utc is given {len(utc)} times for {images} images: give it once each, or leave it out")
    return [parse_utc(text) for text in utc]


def _refuse_what_tells_of_one(
    labels: Path | None, criterion: _Criterion, images: list[Path], *, geometry_only: bool
) -> None:
    if len(images) == 1:
        return
    if geometry_only:
        raise ConfigError("--geometry-only takes one image: several are for the brightness of the stars")
    if labels is not None:
        raise ConfigError("--labels tells of one image: leave it out, or calibrate the images one by one")
    if criterion is _Criterion.paper:
        raise ConfigError("--criterion paper, eq. (38), knows one image; several take the median of all their stars")


@contextmanager
def _naming(image: Path | None) -> Iterator[None]:
    """Say of which image an error is, where there are several."""
    try:
        yield
    except CalibrationError as error:
        if image is None or error.path is not None:
            raise
        raise CalibrationError(
            str(error), path=image, stars_used=error.stars_used, stars_needed=error.stars_needed
        ) from error


def _with_sensor(
    geometry: "GeometryCalibration", exposure_s: float, criterion: _Criterion, *, alone: bool
) -> "Calibration | GeometryCalibration":
    """Return the calibration with its sensor; of a single image without one, the geometry and the reason."""
    from glstar.calibrate import calibrate as calibrate_sensor  # noqa: PLC0415

    image, detected, reference, matches = geometry.image, geometry.detected, geometry.reference, geometry.matches
    try:
        return calibrate_sensor(
            image,
            detected,
            reference,
            matches,
            method=geometry.method,
            exposure_s=exposure_s,
            criterion=criterion.value,
        )
    except CalibrationError as error:
        if not alone:
            raise
        return replace(geometry, notes=(f"camera and attitude only, no sensor: {error}", *geometry.notes))


def _files_of(part: "Calibration | GeometryCalibration", *, with_toml: bool) -> dict[str, bytes]:
    """Return what is written of one image, by suffix."""
    from glstar.calibrate import GeometryCalibration, draw_geometry, draw_report  # noqa: PLC0415

    files = {
        ".json": (json.dumps(part.to_json(), indent=1) + "\n").encode(),
        ".stars.csv": part.to_csv().encode(),
        ".png": draw_geometry(part) if isinstance(part, GeometryCalibration) else draw_report(part),
    }
    return {".toml": part.to_toml().encode()} | files if with_toml else files


def _files_of_all(combined: "CombinedCalibration", output: Path) -> dict[str, bytes]:
    """Return what is written of several images together, by suffix."""
    from glstar.calibrate import draw_combined  # noqa: PLC0415

    return {
        _TABLE: combined.table.to_csv().encode(),
        ".toml": combined.to_toml(output.with_suffix(_TABLE).name).encode(),
        ".json": (json.dumps(combined.to_json(), indent=1) + "\n").encode(),
        ".png": draw_combined(combined),
    }


def _write(output: Path, files: dict[str, bytes]) -> None:
    from glstar.export.diskerrors import explain_disk_errors  # noqa: PLC0415 - OpenCV again

    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        for suffix, content in files.items():
            # The image's name may hold dots: what follows the last is no suffix of ours.
            write_atomically(output.with_name(output.name.removesuffix(".toml") + suffix), content)


def _all_or_none(given: dict[str, float | None]) -> tuple[float, ...] | None:
    """Return the numbers, or None where none was given."""
    missing = [name for name, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise ConfigError(f"{' and '.join(missing)} missing; {', '.join(given)} go together")
    return None if missing else tuple(value for value in given.values() if value is not None)


def _exposure_s(given: float | None, photograph: "SkyImage") -> float:
    exposure_s = photograph.exposure_s if given is None else given
    if exposure_s is None:
        words = "does not say how long the shutter was open, and brightness means nothing without it; give --exposure S"
        raise CalibrationError(words, path=photograph.path)
    if not exposure_s > 0:
        raise ConfigError(f"--exposure must be a positive number of seconds, not {exposure_s}")
    return exposure_s


def _camera(photograph: "SkyImage", settings: Config | None, fov_deg: float | None, *, known: bool) -> Camera:
    """Return the camera of an image: about as wide as was said, or the config's, turned and binned as the image is."""
    height, width = photograph.pixels_dn.shape
    if fov_deg is None and settings is None and not known:
        words = "nobody says how wide its view is; give --fov DEG (left to right, to 15 %) or --config CAMERA.toml"
        raise CalibrationError(words, path=photograph.path)
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
    if abs(across / down - 1) > _SAME_SHAPE:
        raise CalibrationError(
            f"is {width} x {height} px and the config's camera {camera.width_px} x {camera.height_px}: not the same"
            " camera, nor the same binned; give --fov DEG instead",
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


def _skies(
    settings: Config,
    times_utc_s: list[float | None],
    place_deg: tuple[float, ...] | None,
    attitude_deg: tuple[float, ...] | None,
    log: Path | None,
) -> "list[tuple[ReferenceStars, NDArray[np.float64] | None, StarCatalogue]]":
    """Return the sky over each image, and the attitude if it is known."""
    from glstar.calibrate import ReferenceStars  # noqa: PLC0415

    catalogue = StarCatalogue.open(settings.sky.catalogue).brighter_than(_ALL_STARS_VMAG)
    sky = Sky(catalogue, ASTROMETRY[settings.sky.astrometry], settings.sky.dut1_s, settings.sky.refraction)
    air = {"pressure_hpa": settings.air.pressure_hpa, "temperature_c": settings.air.temperature_c}
    if log is not None and None in times_utc_s:
        raise ConfigError("--flight needs --utc: when in the flight was the photograph taken?")
    recorded = None if log is None else settings.open_flight(log)
    skies: list[tuple[ReferenceStars, NDArray[np.float64] | None, StarCatalogue]] = []
    # With a log, --utc is what the camera's clock showed.
    ahead_s = 0.0 if recorded is None else recorded.time_offset_s
    for camera_utc_s in times_utc_s:
        utc_s = None if camera_utc_s is None else camera_utc_s - ahead_s
        C_body_ned: NDArray[np.float64] | None = None
        site: Site | None = None
        if recorded is not None and utc_s is not None:
            C_body_ned = matrix_from_quaternion(recorded.attitude.at([utc_s]))[0]
            site = recorded.position.at(utc_s)
        if place_deg is not None:
            site = Site(float(np.deg2rad(place_deg[0])), float(np.deg2rad(place_deg[1])))
        if attitude_deg is not None:
            yaw, pitch, roll = np.deg2rad(attitude_deg)
            C_body_ned = matrix_from_euler(roll, pitch, yaw)
            if utc_s is None or site is None:
                raise ConfigError("an attitude needs --utc, --lat and --lon: the sky turns by 15 deg an hour")
        if utc_s is None and skies:
            skies.append(skies[0])  # nothing is known of this image either
        elif utc_s is None or site is None:
            skies.append((ReferenceStars.anywhere(sky, _ABOUT_UTC_S if utc_s is None else utc_s), None, catalogue))
        else:
            skies.append((ReferenceStars.over(sky, utc_s, replace(site, **air)), C_body_ned, catalogue))
    return skies


def _identified(
    settings: Config,
    detected: "DetectedStars",
    reference: "ReferenceStars",
    catalogue: StarCatalogue,
    camera: Camera,
    named: "list[Label] | None",
    C_body_ned: NDArray[np.float64] | None,
    *,
    focal_known: bool,
) -> "tuple[str, Matches]":
    from glstar.calibrate import PlateSolution, identify_by_labels, identify_lost, identify_near  # noqa: PLC0415

    if named is not None:
        return "by labels", identify_by_labels(detected, reference, named, camera, focal_known=focal_known)
    if C_body_ned is None or reference.C_ned_eq is None:
        return "by their pattern", identify_lost(detected, reference, catalogue, camera)
    given = PlateSolution(camera, settings.mount().C_camera_body @ C_body_ned @ reference.C_ned_eq)
    matches = identify_near(detected, reference, given, focal_known=focal_known)
    return "by attitude", replace(matches, notes=matches.notes + _how_far_off(given, matches))


def _how_far_off(given: "PlateSolution", matches: "Matches") -> tuple[str, ...]:
    """Return how far the attitude was from the stars', if it was."""
    cosine = float(np.clip(given.C_camera_eq[2] @ matches.solution.C_camera_eq[2], -1, 1))
    off_rad = float(np.arccos(cosine))
    if off_rad < _SAID_RAD:
        return ()
    return (f"the given attitude points {np.rad2deg(off_rad):.2f} deg away from where the camera looked",)


def _labels(path: Path) -> "list[Label]":
    from glstar.calibrate import Label  # noqa: PLC0415

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
            words = f"line {number} is no label; each line holds x, y and a star's number"
            raise CalibrationError(words, path=path) from error
    return found


def _say_all(combined: "CombinedCalibration", output: Path) -> None:
    """Tell a person what came out of several images."""
    for part in combined.parts:
        matches = part.matches
        typer.echo(
            f"{part.image.path.name}: {len(part.detected)} stars found, {len(matches)} of {len(matches.predicted)} in"
            f" the catalogue identified, {matches.expected_by_chance:.1f} expected by chance,"
            f" {matches.rms_px:.2f} px rms; f = {matches.solution.camera.fx_px:.1f} px; sky"
            f" {part.sensor.sky_mean_dn:.2f} ± {part.sensor.sky_std_dn:.2f} DN"
        )
    sensor = combined.sensor
    again = "" if np.isnan(combined.repeat_mag) else f", measured again to {combined.repeat_mag:.2f} mag"
    typer.echo(
        f"peak {sensor.reference_peak_dn:.1f} DN at {sensor.reference_vmag:.2f} mag in"
        f" {sensor.reference_exposure_s:g} s; sigma {sensor.psf_sigma_px:.3f} px; sky {sensor.sky_mean_dn:.2f} ±"
        f" {sensor.sky_std_dn:.2f} DN; {len(combined.table)} stars differ from V by {combined.spread_mag:.2f}"
        f" mag{again}"
    )
    for note in combined.notes:
        typer.echo(f"note: {note}", err=True)
    typer.echo(
        f"{output}; the stars' own brightness: {output.with_suffix(_TABLE)}; look at {output.with_suffix('.png')}"
    )


def _say(calibration: "Calibration", output: Path) -> None:
    """Print what came out."""
    sensor, fit = calibration.sensor, calibration.brightness
    _say_identification(calibration.geometry)
    typer.echo(
        f"peak {sensor.reference_peak_dn:.1f} ± {calibration.sensor_standard_error['reference_peak_dn']:.1f} DN at"
        f" {sensor.reference_vmag:.2f} mag in {sensor.reference_exposure_s:g} s ({int(fit.used.sum())} stars, scatter"
        f" {fit.scatter_mag:.2f} mag);"
        f" sigma {sensor.psf_sigma_px:.3f} ± {calibration.stars.psf_sigma_error_px:.3f} px; sky"
        f" {sensor.sky_mean_dn:.2f} DN with a noise of {sensor.sky_std_dn:.2f} DN"
    )
    _say_notes(calibration.notes, output)


def _say_geometry(geometry: "GeometryCalibration", output: Path) -> None:
    """Print what came out of an image without its sensor."""
    _say_identification(geometry)
    ra_deg, dec_deg = np.rad2deg(geometry.boresight_rad)
    typer.echo(f"the optical axis points at right ascension {ra_deg:.3f} deg, declination {dec_deg:+.3f} deg (ICRS)")
    _say_notes(geometry.notes, output)


def _say_identification(geometry: "GeometryCalibration") -> None:
    matches, camera = geometry.matches, geometry.matches.solution.camera
    focal_error_px = matches.standard_error.get("fx_px")
    focal = f"f = {camera.fx_px:.1f}" + ("" if focal_error_px is None else f" ± {focal_error_px:.1f}")
    typer.echo(
        f"{len(geometry.detected)} stars found, {len(matches)} of {len(matches.predicted)} in the catalogue"
        f" identified {geometry.method}, {matches.expected_by_chance:.1f} expected by chance,"
        f" {matches.rms_px:.2f} px rms; view {np.rad2deg(camera.across_rad):.2f} deg wide, {focal} px"
    )


def _say_notes(notes: tuple[str, ...], output: Path) -> None:
    for note in notes:
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"{output}; look at {output.with_suffix('.png')}")
