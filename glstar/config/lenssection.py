"""``[lens]``: the checks of its vignetting that concern several keys, or a file."""

from pathlib import Path
from typing import Any

from glstar.camera.model import Camera
from glstar.camera.pixelpattern import read_map

__all__ = ["checked_lens"]


def checked_lens(values: dict[str, Any], camera: Camera, folder: Path, faults: list[tuple[str, str]]) -> dict[str, Any]:
    """Return the values of ``[lens]`` with the absolute path of its flat field.

    Parameters
    ----------
    values : dict of str to object
        The section, each key checked on its own.
    camera : Camera
        The flat field must have its size.
    folder : Path
        The folder that the path is relative to.
    faults : list of (key, message)
        Errors are appended.

    Returns
    -------
    dict of str to object
    """
    file = values["vignetting_file"]
    if values["vignetting"] != "flat":
        if file:
            faults.append(("lens.vignetting_file", 'needs vignetting = "flat"'))
        return values
    if not file:
        faults.append(("lens.vignetting_file", 'is missing from vignetting = "flat"'))
        return values
    path = str((folder / file).absolute())
    try:
        height_px, width_px = read_map(path).shape
    except (OSError, ValueError) as error:
        faults.append(("lens.vignetting_file", f"cannot be used: {path}: {error}"))
        return values
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        size = f"{width_px} x {height_px} px and the camera {camera.width_px} x {camera.height_px}"
        faults.append(("lens.vignetting_file", f"{path} has {size}"))
    return {**values, "vignetting_file": path}
