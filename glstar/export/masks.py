"""Masks of a frame: which star each pixel shows, and which pixels are saturated."""

from collections.abc import Callable, Mapping
from typing import Any, Final, Literal

import numpy as np

from glstar.render.scene import Frame, Scene
from glstar.render.trailmask import trail_mask
from glstar.system.png import encode_png

__all__ = ["MASK_KINDS", "MASK_SUFFIXES", "MaskKind", "encoded_masks", "masks_of", "saturated_mask"]

MaskKind = Literal["trails", "saturated"]

# The kinds of masks, in the order of the manifest, with the type of their pixels.
MASK_KINDS: Final[Mapping[MaskKind, type]] = {"trails": np.uint16, "saturated": np.uint8}
# The suffix of each kind's file, after the name of its frame.
MASK_SUFFIXES: Final[Mapping[MaskKind, str]] = {kind: f".{kind}.png" for kind in MASK_KINDS}
# Value of a saturated pixel.
_WHITE: Final = 255


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


_DRAWN_BY: Final[Mapping[MaskKind, Callable[[Scene, Frame], np.ndarray[Any, Any]]]] = {
    "trails": lambda scene, _frame: trail_mask(scene),
    "saturated": saturated_mask,
}


def encoded_masks(kinds: tuple[MaskKind, ...], scene: Scene, frame: Frame) -> dict[MaskKind, bytes]:
    """Return the masks of a frame as PNG files.

    Parameters
    ----------
    kinds : tuple of {"trails", "saturated"}
    scene : Scene
    frame : Frame

    Returns
    -------
    dict of str to bytes
        By kind.
    """
    return {kind: encode_png(_DRAWN_BY[kind](scene, frame)) for kind in kinds}


def masks_of(*, masks: bool) -> tuple[MaskKind, ...]:
    """Return the kinds of masks that an export writes.

    Parameters
    ----------
    masks : bool
        Whether masks were asked for.

    Returns
    -------
    tuple of {"trails", "saturated"}
    """
    return tuple(MASK_KINDS) if masks else ()
