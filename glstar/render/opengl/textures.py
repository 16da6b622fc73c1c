"""What the passes read: stars as vertices and textures, times as a texture of orientations, cloud, and opening times.

`projection.glsl` reads five texels of four float32 per time.  `readout.glsl` reads when the pixels of a target open
under a rolling shutter.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.motion.pointing import Pointing
from glstar.render.opengl.drawnlens import PINHOLE, DrawnLens
from glstar.render.opengl.program import set_used_uniforms
from glstar.render.readout.openings import PixelOpenings
from glstar.render.scene.culling import DrawList
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.photometry import brightness_ratio

# Star fields that stay uploaded: the stars, which stay for a flight, and the bodies of a scene; and satellites.
_MOST_FIELDS = 2
_MOST_SINGLE_STARS = 8


class _Resource(Protocol):
    def release(self) -> object: ...


_Uploaded = TypeVar("_Uploaded", bound=_Resource)


class RecentFields(Generic[_Uploaded]):
    """What `upload` returns for those star fields that were drawn last."""

    def __init__(self, upload: Callable[[StarField], _Uploaded]) -> None:
        self._upload = upload
        # The one drawn longest ago first.
        self._uploaded: list[tuple[StarField, _Uploaded]] = []

    def of(self, stars: StarField) -> _Uploaded:
        """Return the resource of a field; it is valid until a few others have been used."""
        same = [number for number, (field, _) in enumerate(self._uploaded) if field is stars]
        if same:
            self._uploaded.append(self._uploaded.pop(same[0]))
            return self._uploaded[-1][1]
        is_single = len(stars) == 1
        alike = [number for number, (field, _) in enumerate(self._uploaded) if (len(field) == 1) == is_single]
        if len(alike) == (_MOST_SINGLE_STARS if is_single else _MOST_FIELDS):
            self._uploaded.pop(alike[0])[1].release()
        resource = self._upload(stars)
        self._uploaded.append((stars, resource))
        return resource

    def release(self) -> None:
        """Release the resources."""
        while self._uploaded:
            self._uploaded.pop()[1].release()


def packed_stars(stars: StarField, *, multiple: int = 1) -> NDArray[np.float32]:
    """Return directions and brightness of stars as the shaders read them, (rows, 4) float32.

    Each row is a geocentric apparent unit vector and 10^(-0.4 V).  The number of rows is rounded up to a multiple, at
    least one, with zeros after the last star.
    """
    rows = max(-(-len(stars) // multiple), 1) * multiple
    packed = np.zeros((rows, 4), np.float32)
    packed[: len(stars), :3] = stars.direction_eq
    packed[: len(stars), 3] = brightness_ratio(stars.camera_mag)
    return packed


class StarBuffers:
    """The vertex buffers of one star field, and the indices of those stars that the next image shows."""

    def __init__(self, context: moderngl.Context, stars: StarField) -> None:
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


# Columns of the texture of all stars.
STARS_PER_ROW = 1024


def star_texture(context: moderngl.Context, stars: StarField) -> moderngl.Texture:
    """Return directions and brightness of stars as a texture, in rows of `STARS_PER_ROW`."""
    packed = packed_stars(stars, multiple=STARS_PER_ROW)
    texture = context.texture((STARS_PER_ROW, len(packed) // STARS_PER_ROW), 4, packed, dtype="f4")
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture


# Columns of a list of numbers that is folded into a texture.
PASSAGE_COLUMNS = 1024


class PassageTexture:
    """A texture of one float32 per texel that grows with its content: the transmission of cloud for each star."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self.texture = self._created((1, 1))
        self.write_table(np.ones((1, 1), np.float32))

    def write_table(self, table: NDArray[np.float32]) -> None:
        """Make the texture exactly this table, (rows, columns)."""
        size = table.shape[1], table.shape[0]
        if size != self.texture.size:
            self.texture.release()
            self.texture = self._created(size)
        self.texture.write(np.ascontiguousarray(table, dtype=np.float32))

    def write(self, values: NDArray[np.float32]) -> None:
        """Fold a table, row after row, into `PASSAGE_COLUMNS` columns; an empty one changes nothing."""
        if not values.size:
            return
        rows = -(-values.size // PASSAGE_COLUMNS)
        folded = np.zeros(rows * PASSAGE_COLUMNS, np.float32)
        folded[: values.size] = values.ravel()
        self.write_table(folded.reshape(rows, PASSAGE_COLUMNS))

    def _created(self, size: tuple[int, int]) -> moderngl.Texture:
        texture = self._context.texture(size, 1, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def release(self) -> None:
        """Release the texture."""
        self.texture.release()


# The three rows of C_camera_eq, the zenith and the observer's velocity, each in the first three components of a texel.
TEXELS_PER_TIME = 5


def pointing_texels(pointing: Pointing, *, multiple: int = 1) -> NDArray[np.float32]:
    """Return a pointing at n times as texels, (rows, 5, 4) float32.

    The number of rows is rounded up to a multiple; rows of zeros are behind the camera.  The fourth components are 0
    and free for other data.
    """
    times = len(pointing)
    texels = np.zeros((-(-times // multiple) * multiple, TEXELS_PER_TIME, 4), np.float32)
    texels[:times, :3, :3] = pointing.C_camera_eq
    texels[:times, 3, :3] = pointing.zenith_eq
    texels[:times, 4, :3] = pointing.velocity_eq
    return texels


class ImageTexture:
    """A texture with the pixels of an array, which is uploaded again only if it is another array."""

    def __init__(self, context: moderngl.Context) -> None:
        self.texture: moderngl.Texture | None = None
        self._context = context
        self._pixels: NDArray[Any] | None = None

    def of(self, pixels: NDArray[Any]) -> moderngl.Texture:
        """Return the texture of (height, width) or (height, width, components) uint8 or uint16."""
        size = pixels.shape[1], pixels.shape[0]
        dtype = f"u{pixels.itemsize}"
        components = 1 if pixels.ndim == 2 else pixels.shape[2]
        texture = self.texture
        if texture is None or (texture.size, texture.dtype, texture.components) != (size, dtype, components):
            self.release()
            texture = self.texture = self._context.texture(size, components, dtype=dtype, alignment=1)
            texture.filter = moderngl.NEAREST, moderngl.NEAREST
            texture.repeat_x = texture.repeat_y = False
        if self._pixels is not pixels:
            texture.write(np.ascontiguousarray(pixels), alignment=1)
            self._pixels = pixels
        return texture

    def release(self) -> None:
        """Release the texture; a second call does nothing."""
        if self.texture is not None:
            self.texture.release()
        self.texture = None
        self._pixels = None


@dataclass(frozen=True, slots=True)
class ReadoutClock:
    """When the pixels of a target open."""

    rows: int = 0  # The constant ROWS of the shaders: 0 for a global shutter, 1 for a rolling one
    span: float = 1.0  # Time from the first opening to the last closing, in exposure times: 1 for a global shutter
    # Of a rolling shutter: coefficients of x, y (coordinates of gl_FragCoord) and 1, fractions of the span.
    opening: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def openings(self, guard_band_px: int) -> PixelOpenings | None:
        """Return when the pixels of the image open that the target is drawn for; None for a global shutter."""
        if not self.rows:
            return None
        offset, last = guard_band_px + 0.5, self.opening[2]
        per_px = np.array(self.opening[:2])
        return PixelOpenings(
            1 / self.span, float(np.hypot(*per_px)), lambda xy_px: np.asarray((xy_px + offset) @ per_px + last)
        )

    def bind(self, program: moderngl.Program) -> None:
        """Set those uniforms of readout.glsl that a program has."""
        if self.rows:
            set_used_uniforms(program, open_time=1 / self.span, opening=self.opening)


GLOBAL_SHUTTER = ReadoutClock()


class StarTarget(NamedTuple):
    """What stars are drawn to."""

    light: moderngl.Framebuffer  # one component of 32-bit float
    guard_band_px: int  # width of its border around the image, px
    clock: ReadoutClock  # when its pixels open
    lens: DrawnLens = PINHOLE  # of the camera
    pixel_width_px: int = 1  # width of its pixels: glstar/render/scene/reduction.py


def readout_clock(exposure: Exposure, camera: Camera, guard_band_px: int) -> ReadoutClock:
    """Return when the pixels of a target open, given the width of its guard band."""
    if exposure.readout_s == 0:
        return GLOBAL_SHUTTER
    per_column_s, per_row_s, first_s = exposure.opening_s(camera.width_px, camera.height_px)
    first_s -= (per_column_s + per_row_s) * (guard_band_px + 0.5)
    opening = per_column_s / exposure.span_s, per_row_s / exposure.span_s, first_s / exposure.span_s
    return ReadoutClock(1, exposure.span_s / exposure.duration_s, opening)
