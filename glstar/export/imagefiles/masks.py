"""Masks of a frame: the star of each pixel, saturated pixels, what cloud transmits, the flare, and the ground."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.config import Config
from glstar.config.sky import HORIZONS
from glstar.render.effects import active_effects
from glstar.render.effects.cloud import transmission_at
from glstar.render.effects.lensflare import flare_dn
from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth.mask import trail_mask
from glstar.system.imagefiles import encode_png

MaskKind = Literal["trails", "saturated", "cloud", "flare", "ground"]

# The kinds of masks, in the order of the manifest, with the type of their pixels.
MASK_KINDS: Mapping[MaskKind, type] = {
    "trails": np.uint16,
    "saturated": np.uint8,
    "cloud": np.uint8,
    "flare": np.uint16,
    "ground": np.uint8,
}
# The suffix of each kind's file, after the name of its frame.
MASK_SUFFIXES: Mapping[MaskKind, str] = {kind: f".{kind}.png" for kind in MASK_KINDS}
# Value of a saturated pixel.
_WHITE = 255
# Distance of the pixels at which the transmission of cloud and the height above the horizon are computed, px.
_STEP_PX = 4
# Values of the mask of flare per DN.
_FLARE_STEPS_PER_DN = 16


def saturated_mask(scene: Scene, frame: Frame) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return where an image is saturated before the camera's processing, (height, width) uint8: 255 there, else 0.

    A saturated pixel is full or has the largest digital number, of a stacked image in one of the short exposures.
    """
    saturated = frame.saturated
    if saturated is None:
        saturated = frame.pixels >= scene.sensor.full_dn
    return np.where(saturated, np.uint8(_WHITE), np.uint8(0))


def cloud_mask(scene: Scene) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return what cloud transmits of the light in the direction of each pixel, in the middle of the exposure.

    Returns (height, width) uint8: 255 times the transmission, rounded: 255 where there is no cloud, below the horizon,
    and for a sheet below the aircraft; it is computed every fourth pixel and interpolated.
    """
    return np.asarray(
        np.rint(_WHITE * _interpolated(scene, lambda xy_px: transmission_at(scene, xy_px))), dtype=np.uint8
    )


def ground_mask(scene: Scene) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return which pixels show the ground, in the middle of the exposure.

    Returns (height, width) uint8: 255 below the horizon, else 0; the height above it is computed every fourth pixel and
    interpolated.
    """

    def above(xy_px: Float) -> Float:
        return scene.above_horizon(scene.camera.unit_vectors(xy_px) @ scene.shutter.C_camera_eq[1])

    return np.where(_interpolated(scene, above) < 0, np.uint8(_WHITE), np.uint8(0))


def _interpolated(scene: Scene, values_at: Callable[[Float], Float]) -> NDArray[np.float32]:
    """Return values in all pixels, (height, width), that are computed at some of them and bilinear between."""
    sides = scene.camera.width_px, scene.camera.height_px
    columns, rows = (np.linspace(0, side - 1, max(2, -(-side // _STEP_PX))) for side in sides)
    nodes = values_at(np.stack(np.meshgrid(columns, rows), axis=-1)).astype(np.float32)
    x, y = (
        np.broadcast_to(np.linspace(0, len(at) - 1, side, dtype=np.float32).reshape(shape), sides[::-1])
        for at, side, shape in ((columns, sides[0], (1, -1)), (rows, sides[1], (-1, 1)))
    )
    return np.asarray(cv2.remap(nodes, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR))


def flare_mask(scene: Scene) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Return the flare of the lens in each pixel.

    Returns (height, width) uint16: 16 times its signal in DN, rounded, at most 65535; of one short exposure of a
    stacked image.
    """
    camera = scene.camera
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    values = flare_dn(scene, np.stack([x, y], axis=-1))
    return np.asarray(np.rint(np.minimum(_FLARE_STEPS_PER_DN * values, 65535)), dtype=np.uint16)


_DRAWN_BY: Mapping[MaskKind, Callable[[Scene, Frame], np.ndarray[Any, Any]]] = {
    "trails": lambda scene, _frame: trail_mask(scene),
    "saturated": saturated_mask,
    "cloud": lambda scene, _frame: cloud_mask(scene),
    "flare": lambda scene, _frame: flare_mask(scene),
    "ground": lambda scene, _frame: ground_mask(scene),
}


def encoded_masks(kinds: tuple[MaskKind, ...], scene: Scene, frame: Frame) -> dict[MaskKind, bytes]:
    """Return the masks of a frame as PNG files; returns: by kind."""
    return {kind: encode_png(_DRAWN_BY[kind](scene, frame)) for kind in kinds}


def masks_of(config: Config, *, masks: bool) -> tuple[MaskKind, ...]:
    """Return the kinds of masks that an export writes, if `masks` were requested."""
    if not masks:
        return ()
    active = {effect.name for effect in active_effects(config.sensor())}
    active |= {axis.key.partition(".")[0] for axis in config.sweep.axes}
    if config.sky.horizon not in HORIZONS or any(axis.key == "sky.horizon" for axis in config.sweep.axes):
        active.add("ground")
    optional: tuple[MaskKind, ...] = ("cloud", "flare", "ground")
    return ("trails", "saturated", *(kind for kind in optional if kind in active))
