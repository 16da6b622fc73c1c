"""``glstar camera``: calibrate cameras with stars or boards, show camera files and presets, rectify images."""

import json
import re
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich import box
from rich.table import Table

from glstar.camera.camerafile import camera_from_file, camera_to_yaml, camera_warnings, read_camera_file
from glstar.camera.model import Camera
from glstar.camera.presets import SensorPreset, camera_presets, sensor_mode, sensor_preset, sensor_presets
from glstar.cli.calibration.calibrate import calibrate
from glstar.cli.flightoptions import sensor_names
from glstar.cli.reporting import echo_note, progress_bar
from glstar.cli.tables import print_table
from glstar.errors import CalibrationError, reading
from glstar.system.files import write_atomically
from glstar.system.userinput import read_whole

if TYPE_CHECKING:
    from glstar.calibrate.geometry.boards import CharucoBoard, Chessboard


app = typer.Typer(
    help="Calibrate camera and sensor from photographs of the stars or of boards; camera files, presets.",
    no_args_is_help=True,
)
app.command()(calibrate)


class _Lens(StrEnum):
    plumb_bob = "plumb_bob"
    rational = "rational"
    fisheye = "fisheye"


Images = Annotated[list[Path], typer.Argument(help="Images of the board, ten or more.", show_default=False)]
Square = Annotated[float, typer.Option(help="Side of a square, mm.", show_default=False)]
Model = Annotated[_Lens, typer.Option("--lens", help="OpenCV's lens model.")]
Output = Annotated[Path, typer.Option("-o", "--output", help="The camera file to write: [camera] file, ROS, OpenCV.")]
Json = Annotated[bool, typer.Option("--json", help="Report as JSON.")]


@app.command()
def chessboard(
    images: Images,
    pattern: Annotated[str, typer.Option(help="Inner corners, columns x rows: 9x6.", show_default=False)],
    square: Square,
    lens: Model = _Lens.plumb_bob,
    output: Output = Path("camera.yaml"),
    as_json: Json = False,
) -> None:
    """Calibrate a camera from images of a chessboard.

    Try: glstar camera chessboard boards/*.jpg --pattern 9x6 --square 25 -o camera.yaml
    """
    from glstar.calibrate.geometry.boards import Chessboard  # noqa: PLC0415 - OpenCV, when it is needed

    _from_boards(images, Chessboard(*_pattern(pattern), square), lens, output, as_json=as_json)


@app.command()
def charuco(
    images: Images,
    pattern: Annotated[str, typer.Option(help="Squares, columns x rows: 8x6.", show_default=False)],
    square: Square,
    marker: Annotated[float, typer.Option(help="Side of a marker, mm.", show_default=False)],
    dictionary: Annotated[str, typer.Option(help="OpenCV's name of the markers' dictionary.")] = "DICT_4X4_50",
    lens: Model = _Lens.plumb_bob,
    output: Output = Path("camera.yaml"),
    as_json: Json = False,
) -> None:
    """Calibrate a camera from images of a ChArUco board, which may be partly visible.

    Try: glstar camera charuco boards/*.jpg --pattern 8x6 --square 30 --marker 22 -o camera.yaml
    """
    from glstar.calibrate.geometry.boards import CharucoBoard  # noqa: PLC0415 - OpenCV, when it is needed

    _from_boards(images, CharucoBoard(*_pattern(pattern), square, marker, dictionary), lens, output, as_json=as_json)


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="A camera file.", show_default=False)],
    camera: Annotated[
        str | None, typer.Option(help="Name of the camera in a file with several: cam1.", show_default="the only one")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write it to a separate camera file.", show_default="none")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show a camera file: the matrix, the lens and the fields of view."""
    read = read_camera_file(file, camera)
    shown = read.camera
    if as_json:
        typer.echo(json.dumps(_facts(shown) | ({"notes": read.notes} if read.notes else {})))
    for note in read.notes:
        echo_note(f"note: {note}")
    for line in _description(shown) if not as_json else ():
        typer.echo(line)
    _warn(shown)
    if output is not None:
        _write_yaml(output, shown, f"From {file.name}{'' if camera is None else f', {camera}'}.", named=not as_json)


@app.command()
def presets(
    sensor: Annotated[
        str | None,
        typer.Argument(
            help="A sensor, or FILE.toml:NAME: its modes, and its numbers with the source of each.",
            show_default="all",
            autocompletion=sensor_names,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the cameras and sensors that glstar knows, for [camera] preset, [sensor] preset and --camera.

    Try: glstar camera presets imx477
    """
    if sensor is not None:
        sensor_mode(sensor)  # refuses an unknown name
        preset = sensor_preset(sensor)
        if as_json:
            typer.echo(json.dumps(asdict(preset), ensure_ascii=False))
        else:
            _show_sensor(preset)
        return
    if as_json:
        known = {name: asdict(preset) for name, preset in sensor_presets().items()}
        typer.echo(json.dumps({"cameras": camera_presets(), "sensors": known}, ensure_ascii=False))
        return
    cameras = Table("camera", "", box=box.SIMPLE)
    for name, description in camera_presets().items():
        cameras.add_row(name, description)
    sensors = Table("sensor", "", "modes", "pixel, um", "full well, e", "read noise, e", "band", box=box.SIMPLE)
    for preset in sensor_presets().values():
        number = {key: entry.value for key, entry in preset.numbers.items()}
        noise = np.hypot(number["read_noise_before_gain_e"], number["read_noise_after_gain_e"])
        lowest = np.hypot(
            number["read_noise_before_gain_e"], number["read_noise_after_gain_e"] / number["analogue_gain_max"]
        )
        # A mode is what one has to type: each is on a line of its own.
        modes = "\n".join(mode.name.partition(":")[2] for mode in preset.modes) or "any size"
        cells = (
            f"{number['pixel_um']:g}",
            f"{number['full_well_e']:.0f}",
            f"{noise:.1f} to {lowest:.1f}",
            preset.band or "v",
        )
        sensors.add_row(preset.name, preset.description, modes, *cells)
    print_table(cameras)
    typer.echo()
    print_table(sensors)
    typer.echo("glstar export FLIGHT -o DIR --camera imx477:2028x1520 --lens-mm 6 --f-number 1.2")


def _show_sensor(preset: SensorPreset) -> None:
    typer.echo(f"{preset.name}: {preset.description}")
    numbers = Table("per pixel, 12 bits, gain 1", "", "source", box=box.SIMPLE)
    for key, number in preset.numbers.items():
        numbers.add_row(key, f"{number.value:g}", number.source)
    modes = Table("mode", "binning", "bits", "readout, ms", "source", box=box.SIMPLE)
    for mode in preset.modes:
        binning = f"{mode.binning} x {mode.binning}"
        modes.add_row(mode.name, binning, str(mode.bit_depth), f"{1000 * mode.readout_s:.2f}", mode.source)
    print_table(numbers)
    if preset.modes:
        print_table(modes)
    if preset.band is None:
        typer.echo("glstar does not have its filters: stars have their V magnitudes")
    else:
        typer.echo(
            f'its filters: [sensor] band = "{preset.band}"; with mosaic = "rggb" (or another order) in every pixel'
        )


def _warn(camera: Camera) -> None:
    for warning in camera_warnings(camera):
        typer.echo(f"warning: {warning}", err=True)


def _write_yaml(output: Path, camera: Camera, comment: str, *, named: bool) -> None:
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV

    if output.suffix.lower() not in {".yaml", ".yml"}:
        raise typer.BadParameter(f"{output} must end with .yaml", param_hint="--output")
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, camera_to_yaml(camera, comment).encode())
    if named:
        typer.echo(f"{output}")


@app.command()
def rectify(
    image: Annotated[Path, typer.Argument(help="An image as recorded by the camera.", show_default=False)],
    camera: Annotated[Path, typer.Option("-c", "--camera", help="Its camera file, with the lens.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The image to write: PNG or TIFF.", show_default=False)
    ],
    as_json: Json = False,
) -> None:
    """Write an image as a pinhole of the same focal length would have recorded it."""
    from glstar.calibrate.photo.photograph import encoded_image  # noqa: PLC0415 - OpenCV again
    from glstar.camera.photofile import decode_photo  # noqa: PLC0415
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV again
    from glstar.images.decoding import rectify as rectified  # noqa: PLC0415

    if output.suffix.lower() not in {".png", ".tif", ".tiff"}:
        raise typer.BadParameter(f"{output} must end with .png or .tiff", param_hint="--output")
    behind = camera_from_file(camera)
    with reading(image, CalibrationError):
        photo = decode_photo(read_whole(image), floats=True)
    pixels = photo.pixels
    undistorted, _ = rectified(pixels, behind)
    suffix = output.suffix.lower()
    # A PNG of other types has 8 bits.
    if suffix == ".png" and pixels.dtype not in (np.uint8, np.uint16) and not 0 <= pixels.min() <= pixels.max() <= 255:
        raise CalibrationError(
            f"holds {pixels.dtype} from {pixels.min():g} to {pixels.max():g}, which a PNG cannot; write a .tiff",
            path=image,
        )
    for note in photo.notes:
        echo_note(f"note: {note}")
    encoded = encoded_image(suffix, undistorted)
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, encoded)
    if as_json:
        typer.echo(json.dumps({"image": str(output), **_facts(behind)}))
        return
    lens = "no lens: the image is unchanged" if behind.lens is None else f"without its lens ({behind.lens})"
    typer.echo(f"{output}: {behind.width_px} x {behind.height_px} px, {lens}")


def _from_boards(
    images: list[Path], board: "Chessboard | CharucoBoard", lens: _Lens, output: Path, *, as_json: bool
) -> None:
    from glstar.calibrate.geometry.boards import camera_from_boards  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV again

    if output.suffix.lower() not in {".yaml", ".yml"}:
        raise typer.BadParameter(f"{output} must end with .yaml", param_hint="--output")
    with progress_bar("images") as on_image:
        fit = camera_from_boards(images, board, model=lens.value, on_image=on_image)
    used = sum(view.rms_px is not None for view in fit.views)
    errors = ", ".join(f"{name} {error:.2g}" for name, error in fit.standard_error.items())
    text = f"From {used} images of a board by glstar, {fit.rms_px:.3f} px rms.  Standard errors: {errors}."
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, camera_to_yaml(fit.camera, text).encode())
    if as_json:
        views = [
            {"file": view.path.name, "corners": view.corners, "rms_px": view.rms_px, "refused": view.refused}
            for view in fit.views
        ]
        report = {"camera_file": str(output), "rms_px": fit.rms_px, "standard_errors": dict(fit.standard_error)}
        typer.echo(json.dumps({**report, "images": views, **_facts(fit.camera)}))
        _warn(fit.camera)
        return
    table = Table("image", "corners", "off, px rms", box=box.SIMPLE)
    for view in fit.views:
        error = f"not used: {view.refused}" if view.rms_px is None else f"{view.rms_px:.3f}"
        table.add_row(view.path.name, str(view.corners), error)
    print_table(table)
    for line in _description(fit.camera):
        typer.echo(line)
    typer.echo(f"standard errors: {errors}")
    _warn(fit.camera)
    typer.echo(f"{output}: {fit.rms_px:.3f} px rms over {used} of {len(fit.views)} images")


def _facts(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON: sizes, px, and the coefficients of its lens by name."""
    numbers = {name: getattr(camera, name) for name in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")}
    return {**numbers, "skew_px": camera.skew_px, "lens": None if camera.lens is None else str(camera.lens)}


def _description(camera: Camera) -> list[str]:
    """Return the description of a camera, in lines."""
    middle_x, middle_y = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    sides = {
        "across": ([-0.5, middle_y], [right, middle_y]),
        "down": ([middle_x, -0.5], [middle_x, bottom]),
        "corner to corner": ([-0.5, -0.5], [right, bottom]),
    }
    views = []
    for name, ends in sides.items():
        a, middle, b = camera.unit_vectors([ends[0], (middle_x, middle_y), ends[1]])
        view_rad = np.arccos(np.clip([a @ middle, middle @ b], -1.0, 1.0)).sum()  # beyond 180 deg too
        views.append(f"{np.rad2deg(view_rad):.2f} deg {name}" if np.isfinite(view_rad) else f"dark {name}")
    if camera.lens is not None:
        views.append(f"up to {np.rad2deg(camera.field_radius_rad):.2f} deg off the axis")
    return [
        f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:.2f}, {camera.fy_px:.2f} px,"
        f" principal point ({camera.cx_px:.2f}, {camera.cy_px:.2f})"
        + (f", skew {camera.skew_px:g}" if camera.skew_px else ""),
        "a pinhole" if camera.lens is None else f"lens {camera.lens}",
        "view " + ", ".join(views),
    ]


def _pattern(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"\s*(\d{1,4})\s*[x,]\s*(\d{1,4})\s*", text)
    if found is None:
        raise typer.BadParameter(f"{text!r} is no pattern; write columns x rows, such as 9x6", param_hint="--pattern")
    return int(found[1]), int(found[2])
