"""Files and messages of ``glstar calibrate``."""

import json
from pathlib import Path
from typing import Final

import numpy as np
import typer

from glstar.calibrate import (
    Calibration,
    CombinedCalibration,
    GeometryCalibration,
    SharedGeometry,
    draw_combined,
    draw_geometry,
    draw_report,
)
from glstar.camera.camerafile import camera_to_yaml
from glstar.cli.verbosity import echo_note
from glstar.export.directory import explain_disk_errors
from glstar.system.files import write_atomically

# The suffix of the stars' measured brightness, beside the calibration.
_TABLE: Final = ".brightness.csv"


def write_files(output: Path, files: dict[str, bytes]) -> None:
    """Write files beside each other, by suffix."""
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        for suffix, content in files.items():
            # The name of an image may contain dots: only .toml is a suffix.
            write_atomically(output.with_name(output.name.removesuffix(".toml") + suffix), content)


def write_camera(path: Path, geometry: GeometryCalibration) -> None:
    """Write the camera of an image as a camera file."""
    errors = ", ".join(f"{name} {error:.2g}" for name, error in geometry.matches.standard_error.items())
    comments = [f"From the stars of {geometry.image.path.name}.", *([f"Standard errors: {errors}."] if errors else [])]
    written = camera_to_yaml(geometry.matches.solution.camera, *comments)
    write_files(path, {"": written.encode()})


def files_of(part: Calibration | GeometryCalibration, *, with_toml: bool) -> dict[str, bytes]:
    """Return the files of one image, by suffix."""
    files = {
        ".json": (json.dumps(part.to_json(), indent=1) + "\n").encode(),
        ".stars.csv": part.to_csv().encode(),
        ".png": draw_geometry(part) if isinstance(part, GeometryCalibration) else draw_report(part),
    }
    return {".toml": part.to_toml().encode()} | files if with_toml else files


def files_of_all(combined: CombinedCalibration | SharedGeometry, output: Path) -> dict[str, bytes]:
    """Return the files of several images together, by suffix."""
    if isinstance(combined, SharedGeometry):
        return {
            ".toml": combined.to_toml().encode(),
            ".json": (json.dumps(combined.to_json(), indent=1) + "\n").encode(),
            ".png": draw_geometry(combined.best),
        }
    return {
        _TABLE: combined.table.to_csv().encode(),
        ".toml": combined.to_toml(output.with_suffix(_TABLE).name).encode(),
        ".json": (json.dumps(combined.to_json(), indent=1) + "\n").encode(),
        ".png": draw_combined(combined),
    }


def print_result(
    result: Calibration | CombinedCalibration | GeometryCalibration | SharedGeometry, output: Path, *, as_json: bool
) -> None:
    """Print a result, as messages or as JSON."""
    if as_json:
        typer.echo(json.dumps(result.to_json()))
    elif isinstance(result, GeometryCalibration):
        _print_geometry(result, output)
    elif isinstance(result, SharedGeometry):
        _print_shared_geometry(result, output)
    elif isinstance(result, CombinedCalibration):
        _print_combined(result, output)
    else:
        _print_calibration(result, output)


def _print_shared_geometry(shared: SharedGeometry, output: Path) -> None:
    """Print the camera of several images."""
    for part in shared.parts:
        typer.echo(f"{part.image.path.name}: {len(part.matches)} stars identified, {part.matches.rms_px:.2f} px rms")
    _print_notes(shared.notes, output)


def _print_combined(combined: CombinedCalibration, output: Path) -> None:
    """Print the result of several images."""
    for part in combined.parts:
        matches = part.matches
        typer.echo(
            f"{part.image.path.name}: {len(part.detected)} stars found, {len(matches)} of {len(matches.predicted)} in"
            f" the catalogue identified, {matches.expected_by_chance:.1f} expected by chance,"
            f" {matches.rms_px:.2f} px rms; f = {matches.solution.camera.fx_px:.1f} px; sky"
            f" {part.sensor.sky_mean_dn:.2f} ± {part.sensor.sky_std_dn:.2f} DN"
        )
    sensor = combined.sensor
    repeat = "" if np.isnan(combined.repeat_mag) else f", repeatable to {combined.repeat_mag:.2f} mag"
    typer.echo(
        f"peak {sensor.reference_peak_dn:.1f} DN at {sensor.reference_vmag:.2f} mag in"
        f" {sensor.reference_exposure_s:g} s; sigma {sensor.psf_sigma_px:.3f} px; sky {sensor.sky_mean_dn:.2f} ±"
        f" {sensor.sky_std_dn:.2f} DN; {len(combined.table)} stars differ from V by {combined.spread_mag:.2f}"
        f" mag{repeat}"
    )
    for note in combined.notes:
        echo_note(f"note: {note}")
    typer.echo(f"{output}; brightness of the stars: {output.with_suffix(_TABLE)}; report: {output.with_suffix('.png')}")


def _print_calibration(calibration: Calibration, output: Path) -> None:
    """Print the result of one image."""
    for line in report_lines(calibration):
        typer.echo(line)
    _print_notes(calibration.notes, output)


def _print_geometry(geometry: GeometryCalibration, output: Path) -> None:
    """Print the result of an image without a sensor."""
    for line in report_lines(geometry):
        typer.echo(line)
    _print_notes(geometry.notes, output)


def report_lines(result: Calibration | GeometryCalibration) -> list[str]:
    """Return what was found in one image; returns: lines, without the notes."""
    if isinstance(result, GeometryCalibration):
        ra_deg, dec_deg = np.rad2deg(result.boresight_rad)
        pointing = f"right ascension {ra_deg:.3f} deg, declination {dec_deg:+.3f} deg (ICRS)"
        return [_identification(result), f"the optical axis points at {pointing}"]
    sensor, fit = result.sensor, result.brightness
    return [
        _identification(result.geometry),
        f"peak {sensor.reference_peak_dn:.1f} ± {result.sensor_standard_error['reference_peak_dn']:.1f} DN at"
        f" {sensor.reference_vmag:.2f} mag in {sensor.reference_exposure_s:g} s ({int(fit.used.sum())} stars, scatter"
        f" {fit.scatter_mag:.2f} mag);"
        f" sigma {sensor.psf_sigma_px:.3f} ± {result.stars.psf_sigma_error_px:.3f} px; sky"
        f" {sensor.sky_mean_dn:.2f} DN with a noise of {sensor.sky_std_dn:.2f} DN",
    ]


def _identification(geometry: GeometryCalibration) -> str:
    matches, camera = geometry.matches, geometry.matches.solution.camera
    focal_error_px = matches.standard_error.get("fx_px")
    focal = f"f = {camera.fx_px:.1f}" + ("" if focal_error_px is None else f" ± {focal_error_px:.1f}")
    return (
        f"{len(geometry.detected)} stars found, {len(matches)} of {len(matches.predicted)} in the catalogue"
        f" identified {geometry.method}, {matches.expected_by_chance:.1f} expected by chance,"
        f" {matches.rms_px:.2f} px rms; view {np.rad2deg(camera.horizontal_field_rad):.2f} deg wide, {focal} px"
    )


def _print_notes(notes: tuple[str, ...], output: Path) -> None:
    for note in notes:
        echo_note(f"note: {note}")
    typer.echo(f"{output}; report: {output.with_suffix('.png')}")
