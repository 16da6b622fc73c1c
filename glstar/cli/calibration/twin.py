"""``glstar calibrate --twin``: the model of one photograph, the image that it makes, and how the two differ."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import typer

from glstar.calibrate import (
    Calibration,
    CombinedCalibration,
    GeometryCalibration,
    PhotographModel,
    Twin,
    compare_twin,
    draw_twin,
    measure_photograph,
    recorded_again,
    render_twin,
)
from glstar.cli.calibration.output import files_of, print_result, write_files
from glstar.cli.verbosity import echo_note
from glstar.config import Config
from glstar.errors import CalibrationError
from glstar.render.opengl import GLRenderer


@dataclass(frozen=True, slots=True, eq=False)
class TwinResult:
    """A calibration with its twin."""

    calibration: Calibration
    model: PhotographModel
    twin: Twin

    def to_json(self) -> dict[str, object]:
        """Return all numbers as JSON-serialisable values."""
        facts = self.calibration.to_json()
        facts |= {"sensor": self.model.calibration.sensor.keys}
        return facts | {"photograph": self.model.to_json(), "twin": self.twin.figures.to_json()}


def write_twin(calibration: Calibration, output: Path) -> TwinResult:
    """Measure a photograph, write its model, its twin and their comparison.

    `output`: the TOML file; the map of the sky (``.sky.tiff``), the hot pixels (``.hot.tiff``), the twin
    (``.twin.png``) and the comparison (``.pair.png``) lie beside it.  Raises CalibrationError if the photograph has too
    few stars or too little sky.
    """
    model = measure_photograph(calibration)
    name = output.name.removesuffix(".toml")
    toml = model.to_toml(f"{name}.sky.tiff", f"{name}.hot.tiff", f"{name}.brightness.csv")
    files = {".brightness.csv": model.brightness.to_csv().encode(), ".toml": toml.encode()}
    if model.has_map:
        files = {".sky.tiff": _encoded(".tiff", model.sky_texels)} | files
    if model.dark_frame is not None:
        files = {".hot.tiff": _encoded(".tiff", model.dark_frame)} | files
    write_files(output, files)
    # The twin is made from what was written.
    with GLRenderer.headless() as renderer:
        config = Config.load(output)
        pixels = render_twin(model, config, renderer)
        again = render_twin(model, config, renderer, seed=2)
        of_catalogue = render_twin(model, config, renderer, catalogue_brightness=True)
    calibration = replace(calibration, notes=model.calibration.notes)
    result = TwinResult(calibration, model, compare_twin(model, pixels, again, of_catalogue))
    rest = files_of(calibration, with_toml=False)
    rest |= {
        ".json": (json.dumps(result.to_json(), indent=1) + "\n").encode(),
        ".twin.png": _encoded(".png", recorded_again(calibration.image, pixels)),
        ".pair.png": draw_twin(model, result.twin),
    }
    write_files(output, rest)
    return result


def _encoded(suffix: str, pixels: object) -> bytes:
    _, content = cv2.imencode(suffix, np.asarray(pixels))
    return content.tobytes()


def write_twin_of(
    result: Calibration | CombinedCalibration | GeometryCalibration, output: Path, *, as_json: bool
) -> None:
    """Write the twin of a calibration and report; raises CalibrationError if the photograph does not show a sensor."""
    if not isinstance(result, Calibration):
        notes = result.notes[0] if result.notes else "no sensor"
        raise CalibrationError(f"has no twin: {notes}")
    made = write_twin(result, output)
    if as_json:
        typer.echo(json.dumps(made.to_json()))
    else:
        print_result(made.calibration, output, as_json=False)
        _print_twin(made, output)


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
