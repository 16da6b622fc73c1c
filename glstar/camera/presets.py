"""Cameras that ship with glstar."""

import tomllib
from functools import cache
from typing import Any

from glstar.camera.model import Camera
from glstar.camera.yamlvalues import label
from glstar.errors import ConfigError
from glstar.system.nearmiss import nearest_word
from glstar.system.resources import asset

__all__ = ["camera_from_preset", "camera_presets"]


def camera_from_preset(name: str) -> Camera:
    """Return a camera that ships with glstar.

    Parameters
    ----------
    name : str
        Such as ``"picamhq-6mm"``; `camera_presets` lists them.

    Returns
    -------
    Camera
        With its nominal focal length, px.

    Raises
    ------
    ConfigError
        If there is no such preset; the message lists all presets.
    """
    presets = _presets()
    if name not in presets:
        near = nearest_word(name.lower(), presets, cutoff=0.5)
        hint = "there" if near is None else f'did you mean "{near}"? There'
        raise ConfigError(f'there is no camera "{label(name)}" ({hint} are {", ".join(presets)})', key="camera.preset")
    preset = presets[name]
    if "binned" in preset:
        return _binned(camera_from_preset(preset["binned"]["of"]), preset["binned"]["by"])
    width_px, height_px, focal_px = preset["width_px"], preset["height_px"], preset["focal_px"]
    return Camera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)


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
