"""Masks of a frame: which star each pixel shows, which pixels are saturated, and what cloud transmits."""

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal

import cv2
import numpy as np

from glstar.config import Config
from glstar.render.effects.cloudtexture import transmission_at
from glstar.render.scene import Frame, Scene
from glstar.render.trailmask import trail_mask
from glstar.system.png import encode_png

__all__ = ["MASK_KINDS", "MASK_SUFFIXES", "MaskKind", "cloud_mask", "encoded_masks", "masks_of", "saturated_mask"]

MaskKind = Literal["trails", "saturated", "cloud"]

# The kinds of masks, in the order of the manifest, with the type of their pixels.
MASK_KINDS: Final[Mapping[MaskKind, type]] = {"trails": np.uint16, "saturated": np.uint8, "cloud": np.uint8}
# The suffix of each kind's file, after the name of its frame.
MASK_SUFFIXES: Final[Mapping[MaskKind, str]] = {kind: f".{kind}.png" for kind in MASK_KINDS}
# Value of a saturated pixel.
_WHITE: Final = 255
# Distance of the pixels at which the transmission of cloud is computed, px.
_CLOUD_STEP_PX: Final = 4


def saturated_mask(scene: Scene, frame: Frame) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return where an image is saturated.

    Parameters
    ----------
    scene : Scene
    frame : Frame
        Its image, before the camera's processing.

    Returns
    -------
    (height, width) uint8
        255 where the digital number is the largest one (in a stacked image, in one of the short exposures), else 0.
    """
    saturated = frame.saturated
    if saturated is None:
        saturated = frame.pixels >= scene.sensor.saturation_dn
    return np.where(saturated, np.uint8(_WHITE), np.uint8(0))


def cloud_mask(scene: Scene) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return what cloud transmits of the light in the direction of each pixel, in the middle of the exposure.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    (height, width) uint8
        255 times the transmission, rounded: 255 where there is no cloud, below the horizon, and for a sheet below the
        aircraft.  It is computed every fourth pixel and interpolated.
    """
    camera = scene.camera
    sides = camera.width_px, camera.height_px
    columns, rows = (np.linspace(0, side - 1, max(2, -(-side // _CLOUD_STEP_PX))) for side in sides)
    nodes = transmission_at(scene, np.stack(np.meshgrid(columns, rows), axis=-1)).astype(np.float32)
    x, y = (
        np.broadcast_to(np.linspace(0, len(at) - 1, side, dtype=np.float32).reshape(shape), sides[::-1])
        for at, side, shape in ((columns, sides[0], (1, -1)), (rows, sides[1], (-1, 1)))
    )
    values = cv2.remap(nodes, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    return np.asarray(np.rint(_WHITE * values), dtype=np.uint8)


_DRAWN_BY: Final[Mapping[MaskKind, Callable[[Scene, Frame], np.ndarray[Any, Any]]]] = {
    "trails": lambda scene, _frame: trail_mask(scene),
    "saturated": saturated_mask,
    "cloud": lambda scene, _frame: cloud_mask(scene),
}


def encoded_masks(kinds: tuple[MaskKind, ...], scene: Scene, frame: Frame) -> dict[MaskKind, bytes]:
    """Return the masks of a frame as PNG files.

    Parameters
    ----------
    kinds : tuple of {"trails", "saturated", "cloud"}
    scene : Scene
    frame : Frame

    Returns
    -------
    dict of str to bytes
        By kind.
    """
    return {kind: encode_png(_DRAWN_BY[kind](scene, frame)) for kind in kinds}


def masks_of(config: Config, *, masks: bool) -> tuple[MaskKind, ...]:
    """Return the kinds of masks that an export writes.

    Parameters
    ----------
    config : Config
    masks : bool
        Whether masks were asked for.

    Returns
    -------
    tuple of {"trails", "saturated", "cloud"}
    """
    if not masks:
        return ()
    has_cloud = "cloud.coverage" in config.sensor().effects or any(
        axis.key.startswith("cloud.") for axis in config.sweep.axes
    )
    return ("trails", "saturated", *(("cloud",) if has_cloud else ()))
