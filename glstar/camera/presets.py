"""Cameras that ship with glstar."""

import tomllib
from functools import cache
from typing import Any

from glstar.camera.model import Camera
from glstar.camera.sensorpresets import is_sensor_mode, sensor_mode
from glstar.camera.yamlvalues import label
from glstar.errors import ConfigError
from glstar.system.nearmiss import nearest_word
from glstar.system.resources import asset

__all__ = ["camera_from_preset", "camera_presets"]


def camera_from_preset(name: str, lens_mm: float | None = None) -> Camera:
    """Return a camera that ships with glstar.

    Parameters
    ----------
    name : str
        A camera such as ``"picamhq-6mm"``; `camera_presets` lists them.  Or the mode of a sensor, such as
        ``"imx477:2028x1520"``; see `glstar.camera.sensorpresets`.
    lens_mm : float, optional
        Focal length of the lens before a sensor, mm; a camera has a lens of its own.

    Returns
    -------
    Camera
        With its nominal focal length, px.

    Raises
    ------
    ConfigError
        If there is no such preset, the message lists all presets; or if the lens is missing, or one too many.
    """
    presets = _presets()
    if is_sensor_mode(name):
        return _behind_a_lens(name, lens_mm)
    if lens_mm is not None and name in presets:
        raise ConfigError(f'the camera "{name}" has a lens of its own; leave lens_mm out', key="camera.lens_mm")
    if name not in presets:
        near = nearest_word(name.lower(), presets, cutoff=0.5)
        hint = "there" if near is None else f'did you mean "{near}"? There'
        there = f"{', '.join(presets)}, and the sensors that glstar camera presets lists"
        raise ConfigError(f'there is no camera "{label(name)}" ({hint} are {there})', key="camera.preset")
    preset = presets[name]
    if "binned" in preset:
        return _binned(camera_from_preset(preset["binned"]["of"]), preset["binned"]["by"])
    width_px, height_px, focal_px = preset["width_px"], preset["height_px"], preset["focal_px"]
    return Camera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)


def _behind_a_lens(name: str, lens_mm: float | None) -> Camera:
    """Return the camera of a sensor's mode behind a lens."""
    try:
        mode = sensor_mode(name)
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("preset: "), key="camera.preset") from None
    if mode is None:
        raise ConfigError(f'the sensor "{name}" has images of any size; give those of a camera', key="camera.preset")
    if lens_mm is None:
        raise ConfigError(f"is missing: the focal length of the lens before {mode.name}, mm", key="camera.lens_mm")
    return mode.camera(lens_mm)


def camera_presets() -> dict[str, str]:
    """Return the presets: name to description, one line each."""
    return {name: preset["description"] for name, preset in _presets().items()}


@cache
def _presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads(asset("cameras.toml").read_text(encoding="utf-8"))


def _binned(camera: Camera, by: int) -> Camera:
    """Return a camera with pixels binned `by` times `by`."""
    # Pixel centres have integer coordinates, so the corner of the image is at -0.5; binning leaves it there.
    return Camera(
        camera.width_px // by,
        camera.height_px // by,
        camera.fx_px / by,
        camera.fy_px / by,
        (camera.cx_px + 0.5) / by - 0.5,
        (camera.cy_px + 0.5) / by - 0.5,
        camera.skew_px / by,
    )
