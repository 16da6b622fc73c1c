"""Options of the commands that draw images: which camera takes them."""

from typing import Annotated

import typer

from glstar.camera.sensorpresets import is_sensor_mode, sensor_mode
from glstar.cli.completion import camera_names
from glstar.config.sections import is_file_name

__all__ = ["AnalogueGain", "CameraName", "FNumber", "LensMm", "camera_settings"]

CameraName = Annotated[
    str | None,
    typer.Option(
        "--camera",
        help="A preset of glstar camera presets, the mode of a sensor such as imx477:2028x1520, or a calibration file.",
        show_default="the config's",
        autocompletion=camera_names,
    ),
]
LensMm = Annotated[
    float | None, typer.Option("--lens-mm", help="Focal length of the lens before --camera's sensor, mm.", min=0.01)
]
FNumber = Annotated[
    float | None, typer.Option("--f-number", help="Focal length over aperture of that lens.", min=0.1, max=100)
]
AnalogueGain = Annotated[float | None, typer.Option("--gain", help="Analogue gain of --camera's sensor.", min=0.001)]


def camera_settings(
    camera: str | None, lens_mm: float | None, f_number: float | None, gain: float | None = None
) -> dict[str, object]:
    """Return the keys of the config that the options set.

    Parameters
    ----------
    camera : str or None
        With the mode of a sensor, the sensor counts electrons as that mode does, its rows are read out
        as fast, and the lens has vignetting.
    lens_mm, f_number : float or None
        The lens before the sensor.
    gain : float or None
        Analogue gain of the sensor.

    Returns
    -------
    dict of str to object
        By dotted key; None for what the options leave as it is.
    """
    lens: dict[str, object] = {
        "camera.lens_mm": lens_mm,
        "camera.f_number": f_number,
        "sensor.analogue_gain": gain,
    }
    if camera is None:
        return lens
    if is_sensor_mode(camera):
        mode = sensor_mode(camera) if lens_mm is not None else None
        # The config refuses a missing lens and an unknown mode.
        readout_s = None if mode is None else mode.readout_s
        keys = {"camera.preset": camera, "sensor.preset": camera, "lens.vignetting": "cos4"}
        return {**keys, "exposure.readout_s": readout_s, **lens}
    return {"camera.file" if is_file_name(camera) else "camera.preset": camera, **lens}
