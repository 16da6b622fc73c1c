"""A star field on the GPU, as vertices of the sub-exposure pass."""

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.culling import DrawList
from glstar.sky.magnitudes import brightness_ratio
from glstar.sky.starfield import StarField

__all__ = ["StarBuffers", "packed_stars", "superseded_field"]

# Star fields that stay uploaded: the stars, which stay for a flight, and the bodies of a scene; and satellites.
_MOST_FIELDS, _MOST_SINGLE_STARS = 2, 8


def superseded_field(uploaded: Sequence[StarField], stars: StarField) -> int | None:
    """Return which of the uploaded fields makes place for another.

    Parameters
    ----------
    uploaded : sequence of StarField
        The one drawn longest ago first.
    stars : StarField
        The other one.

    Returns
    -------
    int or None
        Its index; None if none has to.
    """
    alike = [number for number, field in enumerate(uploaded) if (len(field) == 1) == (len(stars) == 1)]
    most = _MOST_SINGLE_STARS if len(stars) == 1 else _MOST_FIELDS
    return alike[0] if len(alike) == most else None


def packed_stars(stars: StarField, *, multiple: int = 1) -> NDArray[np.float32]:
    """Return directions and brightness of stars, as the shaders read them.

    Parameters
    ----------
    stars : StarField
    multiple : int
        The number of rows is rounded up to a multiple of this, and at least this.

    Returns
    -------
    (rows, 4) float32
        Geocentric apparent unit vector, and 10^(-0.4 V); zeros after the last star.
    """
    rows = max(-(-len(stars) // multiple), 1) * multiple
    packed = np.zeros((rows, 4), np.float32)
    packed[: len(stars), :3] = stars.direction_eq
    packed[: len(stars), 3] = brightness_ratio(stars.camera_mag)
    return packed


class StarBuffers:
    """The vertex buffers of one star field, and the indices of those stars that the next image shows.

    Parameters
    ----------
    context : moderngl.Context
    stars : StarField
    """

    def __init__(self, context: moderngl.Context, stars: StarField) -> None:
        self.stars = stars
        self._context = context
        self._stars = context.buffer(packed_stars(stars))
        # Truncation radius, px, transmission of the air, and number among the stars that are drawn.
        self._of_scene = np.ones((len(stars), 3), np.float32)
        self._of_scene_buffer = context.buffer(self._of_scene, dynamic=True)
        self._index = context.buffer(reserve=4 * len(stars), dynamic=True)
        # Colours in the cells of a mosaic.
        self._tints: moderngl.Buffer | None = None
        self._vertices: dict[moderngl.Program, moderngl.VertexArray] = {}

    def choose(self, draw_list: DrawList, tints: NDArray[np.float32] | None = None) -> None:
        """Upload which stars the next image shows, how far each is drawn, and the colours of all in a mosaic."""
        self._of_scene[draw_list.index, 0] = draw_list.truncation_radius_px
        self._of_scene[draw_list.index, 1] = draw_list.transmission
        self._of_scene[draw_list.index, 2] = np.arange(len(draw_list))
        self._of_scene_buffer.write(self._of_scene)
        self._index.write(np.ascontiguousarray(draw_list.index))
        if tints is not None:
            if self._tints is None:
                self._tints = self._context.buffer(reserve=tints.nbytes, dynamic=True)
            self._tints.write(tints)

    def vertices(self, program: moderngl.Program) -> moderngl.VertexArray:
        """Return the chosen stars as the vertices of a program."""
        if program not in self._vertices:
            content: list[tuple[Any, ...]] = [
                (self._stars, "3f 1f", "direction_eq", "brightness"),
                (self._of_scene_buffer, "1f 1f 1f", "truncation_radius_px", "transmission", "passage_column"),
            ]
            if self._tints is not None and "tints_of_star" in program:
                content.append((self._tints, "4f", "tints_of_star"))
            self._vertices[program] = self._context.vertex_array(program, content, index_buffer=self._index)
        return self._vertices[program]

    def release(self) -> None:
        """Release the buffers."""
        for vertices in self._vertices.values():
            vertices.release()
        self._vertices.clear()
        for buffer in (self._index, self._of_scene_buffer, self._stars, self._tints):
            if buffer is not None:
                buffer.release()
