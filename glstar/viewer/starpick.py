"""The star whose trail is under the mouse."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.render.pointing import Pointing
from glstar.render.recordedpaths import recorded_positions
from glstar.render.scene import Scene
from glstar.viewer.objectplace import object_place

__all__ = ["StarUnderCursor", "star_at"]

Float = NDArray[np.float64]

# Sub-exposures of the coarse search, which selects the stars whose trails are then searched completely.
_COARSE_SAMPLES: Final = 8
# Samples along the part of a trail that a rolling shutter records.
_RECORDED_SAMPLES: Final = 33
# A magnitude counts as this fraction of the largest distance: of two stars near the mouse the brighter one is returned.
_DISTANCE_PER_MAGNITUDE: Final = 0.1


class StarUnderCursor(NamedTuple):
    """A star near the mouse.

    Attributes
    ----------
    catalogue : str
        The catalogue that numbers it.
    star_id : int
        Its number there.
    name : str
        Its name; empty if it has none.
    vmag : float
        Its magnitude.
    altitude_rad, azimuth_rad : float
        Its apparent direction in the middle of the exposure, with refraction; azimuth from north through east.
    x_px, y_px : float
        Its position on the image in the middle of the exposure, with a rolling shutter of that of its own rows, px; NaN
        if it is behind the camera or below the horizon then.
    """

    catalogue: str
    star_id: int
    name: str
    vmag: float
    altitude_rad: float
    azimuth_rad: float
    x_px: float
    y_px: float


def star_at(scene: Scene, x_px: float, y_px: float, *, within_px: float) -> StarUnderCursor | None:
    """Return the star whose trail passes near a position on the image.

    Parameters
    ----------
    scene : Scene
    x_px, y_px : float
        The position, px.
    within_px : float
        The largest distance of the trail, px.  Of several stars the nearest is returned; one magnitude counts as a
        tenth of this distance.

    Returns
    -------
    StarUnderCursor or None
    """
    position = np.array([x_px, y_px])
    # First a few sub-exposures, with a margin for the camera's rotation between them; then all, for the stars nearby.
    stride = max(1, len(scene.trails.pointing) // _COARSE_SAMPLES)
    coarse = scene.trails.pointing[::stride]
    xy = scene.camera.project(coarse.to_camera(scene.stars.direction_eq[scene.visible]))
    margin_px = _rotation_px(scene, coarse, stride)
    around = np.flatnonzero(_distance_to_trail_px(xy, position) <= within_px + margin_px + 1)
    nearest_px = np.full(len(around), np.inf)
    for block in scene.trails.pointing.blocks(len(around), overlap=1):
        xy = scene.camera.project(block.to_camera(scene.stars.direction_eq[scene.visible[around]]))
        nearest_px = np.fmin(nearest_px, _distance_to_trail_px(xy, position))
    near = np.flatnonzero(nearest_px <= within_px)
    if scene.exposure.readout_s and near.size:
        # Of the path over the whole readout, a star is recorded while its own rows are open.
        directions = scene.stars.direction_eq[scene.visible[around[near]]]
        recorded = recorded_positions(scene, directions, np.linspace(0, 1, _RECORDED_SAMPLES))
        nearest_px[near] = _distance_to_trail_px(recorded, position)
        near = near[nearest_px[near] <= within_px]
    if not near.size:
        return None
    stars = scene.visible[around[near]]
    cost = nearest_px[near] / max(within_px, 1e-9) + _DISTANCE_PER_MAGNITUDE * scene.stars.vmag[stars]
    star = stars[np.argmin(cost)]
    place = object_place(scene, scene.stars.direction_eq[star])
    has_risen = place.altitude_rad >= 0
    return StarUnderCursor(
        catalogue=scene.stars.catalogue,
        star_id=int(scene.stars.star_id[star]),
        name=scene.stars.name[star],
        vmag=float(scene.stars.vmag[star]),
        altitude_rad=place.altitude_rad,
        azimuth_rad=place.azimuth_rad,
        x_px=place.x_px if has_risen else np.nan,
        y_px=place.y_px if has_risen else np.nan,
    )


def _rotation_px(scene: Scene, coarse: Pointing, stride: int) -> float:
    """Return an upper bound of the distance that a star moves after a coarse sample and before the next, px."""
    C_camera_eq = scene.trails.pointing.C_camera_eq
    chord = C_camera_eq - np.repeat(coarse.C_camera_eq, stride, axis=0)[: len(C_camera_eq)]
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2).
    angle_rad = 2 * np.arcsin(np.clip(np.sqrt((chord**2).sum(axis=(1, 2)).max() / 8), 0, 1))
    return float(angle_rad * scene.camera.max_px_per_rad)


def _distance_to_trail_px(xy: Float, position: Float) -> Float:
    """Return the distances of a position (2,) from the trails (n, m, 2), (m,) px; NaN for stars off the image."""
    if len(xy) == 1:
        return np.asarray(np.hypot(*np.moveaxis(xy[0] - position, -1, 0)))
    step = np.diff(xy, axis=0)
    to_position = position - xy[:-1]
    length2 = np.maximum(np.sum(step * step, axis=-1), 1e-18)
    along = np.clip(np.sum(step * to_position, axis=-1) / length2, 0, 1)
    off = to_position - along[..., np.newaxis] * step
    return np.asarray(np.fmin.reduce(np.hypot(off[..., 0], off[..., 1]), axis=0))
