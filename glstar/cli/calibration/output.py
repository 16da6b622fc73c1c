"""Files and messages of ``glstar camera calibrate``, which writes and prints what `glstar.calibrate` measures."""

import json
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import typer

from glstar.calibrate import pipeline
from glstar.calibrate.geometry.camera import GeometryCalibration, SharedGeometry
from glstar.calibrate.notes import Note
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.combine import CombinedCalibration
from glstar.calibrate.sensor.photographmodel import measure_photograph
from glstar.calibrate.sensor.photontransfer import PhotonTransfer, measure_darks
from glstar.calibrate.sensor.report import prepare_to_draw
from glstar.calibrate.twin import TwinResult, make_twin, model_files
from glstar.cli.reporting import echo_note, progress_bar
from glstar.config import Config
from glstar.errors import CalibrationError
from glstar.export.directory import explain_disk_errors
from glstar.system.files import write_atomically

# A larger fraction of hot pixels is reported: real sensors have some hundred in a million.
_MANY_HOT = 0.01


@contextmanager
def showing_progress() -> Iterator[tuple[Callable[[int, int], None], Callable[[str], None]]]:
    """Show a progress bar, and yield functions for its steps and for notes; load matplotlib meanwhile."""
    with progress_bar("steps") as on_step, ThreadPoolExecutor(max_workers=1) as executor:
        executor.submit(prepare_to_draw)
        yield on_step, lambda text: echo_note(f"note: {text}")


def write_files(output: Path, files: dict[str, bytes], inputs: Collection[Path] = ()) -> list[Path]:
    """Write files beside an output, by file name, and return their paths; that of its stem as the output itself.

    Raises CalibrationError, and writes nothing, if one of them would replace an input.
    """
    paths = [output if name == f"{output.stem}.toml" else output.with_name(name) for name in files]
    for given in inputs:
        if any(path.exists() and path.samefile(given) for path in paths if path.suffix != ".toml"):
            raise CalibrationError(f"would be replaced by the report of {output}; give -o another name", path=given)
    for path, content in zip(paths, files.values(), strict=True):
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
    return paths


def write_and_print(
    result: pipeline.CalibrationResult,
    output: Path,
    camera_out: Path | None,
    inputs: Collection[Path],
    *,
    twin: bool,
    as_json: bool,
) -> None:
    """Write the files of a calibration, with the twin of its photograph if that is requested, and print the result."""
    write_files(output, pipeline.calibration_files(result, output.stem), inputs)
    if camera_out is not None:
        write_files(camera_out, {camera_out.name: pipeline.camera_file(result).encode()})
    if twin:
        _write_and_print_twin(result, output, as_json=as_json)
    else:
        print_result(result, output, as_json=as_json)


def print_result(result: pipeline.CalibrationResult, output: Path, *, as_json: bool) -> None:
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
    table = output.with_suffix(pipeline.BRIGHTNESS_SUFFIX)
    typer.echo(f"{output}; brightness of the stars: {table}; report: {output.with_suffix('.png')}")


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
    """Return lines about the result of one image, without its notes."""
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


def _print_notes(notes: tuple[Note, ...], output: Path) -> None:
    for note in notes:
        echo_note(f"note: {note}")
    typer.echo(f"{output}; report: {output.with_suffix('.png')}")


def _write_and_print_twin(result: pipeline.CalibrationResult, output: Path, *, as_json: bool) -> None:
    """Write the twin of a photograph, and print how the two differ."""
    if not isinstance(result, Calibration):
        reason = result.notes[0] if result.notes else "no sensor"
        raise CalibrationError(f"has no twin: {reason}")
    twin = write_twin(result, output)
    if as_json:
        typer.echo(json.dumps(twin.to_json()))
    else:
        print_result(twin.calibration, output, as_json=False)
        _print_twin(twin, output)


def write_twin(calibration: Calibration, output: Path) -> TwinResult:
    """Measure a photograph, and write its model, its twin and their comparison beside the TOML file.

    Raises CalibrationError if the photograph has too few stars or too little sky.
    """
    model = measure_photograph(calibration)
    write_files(output, model_files(model, output.stem))
    # The twin is made from what was written.
    twin = make_twin(calibration, model, Config.load(output))
    write_files(output, pipeline.image_files(twin.calibration, output.stem) | twin.files(output.stem))
    return twin


def _print_twin(result: TwinResult, output: Path) -> None:
    """Print what was measured and how the twin differs."""
    model, figures = result.model, result.twin.figures
    sensor = model.calibration.sensor
    errors = model.standard_error
    values = {**sensor.keys, **{key.partition(".")[2]: value for key, value in sensor.effects.items()}}
    typer.echo(", ".join(f"{key} {values[key]:.4g} ± {errors[key]:.2g}" for key in errors if key in values))
    slope = model.terms.magnitude_slope
    if slope is not None:
        typer.echo(
            f"recorded light grows as its power {1 + slope.value:.3f} ± {slope.standard_error:.3f} (1: a linear sensor)"
        )
    if model.dark_frame is not None:
        typer.echo(f"{len(model.hot)} hot pixels: {output.with_suffix('.hot.tiff')}")
    for reason in model.refused:
        echo_note(f"note: {reason}")
    noise = "" if figures.noise_error is None else f"; noise against level {100 * figures.noise_error:.1f} % off"
    typer.echo(
        f"twin: sky {figures.sky_ks:.3f} (Kolmogorov-Smirnov){noise}; peaks of {figures.stars} stars"
        f" {100 * figures.peak_error:.0f} % off, of which noise makes {100 * figures.peak_noise:.0f} %"
        f" ({100 * figures.catalogue_peak_error:.0f} % with the brightness of the catalogue); widths"
        f" {figures.width_ratio:.3f}; profiles {100 * figures.profile_error:.0f} % off"
    )
    typer.echo(f"{output}; twin: {output.with_suffix('.twin.png')}; comparison: {output.with_suffix('.pair.png')}")


def calibrate_from_darks(
    darks: Path, flats: Path | None, output: Path, bit_depth: int | None, *, as_json: bool
) -> None:
    """Measure a sensor from directories of dark frames and flat fields, write its keys and maps, and report.

    `bit_depth`: bits of the images; None to find them.  Raises CalibrationError if the images cannot be used.
    """
    with progress_bar("images") as on_image:
        transfer = measure_darks(darks, flats, bit_depth=bit_depth, on_image=on_image)
    write_files(output, transfer.files(output.stem))
    hot_fraction = transfer.hot / transfer.dark_frame_dn.size
    if hot_fraction > _MANY_HOT:
        echo_note(f"note: {100 * hot_fraction:.1f} % of the pixels are hot: is the lens capped, and the sensor cool?")
    if as_json:
        typer.echo(json.dumps(transfer.to_json(output.stem)))
    else:
        _print_transfer(transfer, output)


def _print_transfer(transfer: PhotonTransfer, output: Path) -> None:
    typer.echo(
        f"{transfer.dark_frames} dark frames: black level {transfer.black_level_dn:.2f} DN, read noise"
        f" {transfer.read_noise_dn:.3f} DN, {transfer.hot} hot pixels"
    )
    if transfer.dn_per_e is not None and transfer.prnu_fraction is not None:
        typer.echo(
            f"{transfer.flat_fields} flat fields: {transfer.dn_per_e:.4f} ± {transfer.dn_per_e_error:.4f} DN/e, so a"
            f" read noise of {transfer.read_noise_e:.2f} e; response {100 * transfer.prnu_fraction:.2f} % rms;"
            f" {int(transfer.is_dead.sum())} dead pixels"
        )
    else:
        typer.echo(
            "without flat fields (--flats) the gain in DN per electron is not known, and the read noise in DN only"
        )
    typer.echo(f"{output}: use it with [sensor] file, or copy its keys")
