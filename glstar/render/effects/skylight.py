"""The Sun, the Moon and the planets as lights of a scene.

Nodes over the image at which light of the sky and of the lens is computed, and linear between them.
"""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.scene.scene import Scene
from glstar.sky.observed.solarsystem import Body, observed_bodies


# The sky and the flare of a scene ask several times for each texture and for truth.
@lru_cache(maxsize=8)
def bodies_of(scene: Scene, names: tuple[str, ...]) -> tuple[Body, ...]:
    """Return some bodies in the middle of the exposure of a scene.

    `names`: of `glstar.sky.observed.solarsystem.BODIES`.  Returns: in the order of `names`; empty in a scene that does
    not know its sky.
    """
    if scene.observing_sky is None:
        return ()
    # Those that are drawn are known; those of a stack are at the middle of one of its short exposures.
    if scene.bodies is not None and not scene.shorts:
        drawn = {body.name: body for body in scene.bodies.bodies}
        if drawn.keys() >= set(names):
            return tuple(drawn[name] for name in names)
    return observed_bodies(scene.observing_sky, scene.exposure.mid_utc_s, scene.site, names)


Float = NDArray[np.float64]

# Columns and rows for the smooth sky: at most 1.5 % off beyond 3 deg of the Moon.
SMOOTH_GRID: Final = (97, 73)
# For edges of cloud and for flare: every second node is one of the smooth sky.
FINE_GRID: Final = (193, 145)
# Pixels of a fragment of the develop pass, at most: develop.frag.
_SPAN_PX: Final = 16.0


def interpolates_by_quads(camera: Camera, grid: tuple[int, int]) -> bool:
    """Return whether nodes are too near each other to be read only at the ends of a fragment's pixels.

    `grid`: columns and rows.
    """
    return camera.width_px / (grid[0] - 1) < _SPAN_PX


@lru_cache(maxsize=8)
def node_positions(camera: Camera, grid: tuple[int, int]) -> Float:
    """Return the positions of nodes from edge to edge of the image.

    `grid`: columns and rows.  Returns (rows, columns, 2) px.
    """
    columns, rows = grid
    x = np.linspace(-0.5, camera.width_px - 0.5, columns)
    y = np.linspace(-0.5, camera.height_px - 0.5, rows)
    return np.stack(np.meshgrid(x, y), axis=-1)


@lru_cache(maxsize=8)
def node_rays(camera: Camera, grid: tuple[int, int]) -> Float:
    """Return the directions of nodes in the camera frame.

    `grid`: columns and rows.  Returns (rows, columns, 3) unit vectors.
    """
    return camera.unit_vectors(node_positions(camera, grid))


def with_halfway_nodes(nodes: Float) -> Float:
    """Return values at nodes and halfway between them, where they are the mean.

    `nodes` (r, c).  Returns (2 r - 1, 2 c - 1).
    """
    for axis in (0, 1):
        nodes = np.moveaxis(nodes, axis, 0)
        finer = np.empty((2 * len(nodes) - 1, *nodes.shape[1:]))
        finer[::2], finer[1::2] = nodes, (nodes[1:] + nodes[:-1]) / 2
        nodes = np.moveaxis(finer, 0, axis)
    return nodes


def softened(nodes: Float) -> Float:
    """Return values at nodes whose edges do not show the grid.

    `nodes` (r, c).  Returns (r, c) weighted means with the neighbours, 1 : 2 : 1 along both axes; the sum stays but for
    the border.
    """
    for axis in (0, 1):
        nodes = np.moveaxis(nodes, axis, 0)
        wider = np.concatenate([nodes[:1], nodes, nodes[-1:]])
        nodes = np.moveaxis((wider[:-2] + 2 * nodes + wider[2:]) / 4, 0, axis)
    return nodes
