"""Render targets: the noiseless signal with its guard band, and the developed image."""

from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.scene import Scene

__all__ = ["SignalTarget", "Targets"]


class SignalTarget:
    """A float32 target in which the flux of the stars is summed.

    A point whose centre lies outside the target is clipped entirely, so the target extends beyond the image by a guard
    band, from which stars contribute with a part of their sprite.  Half-float would lose single sub-exposures.

    Parameters
    ----------
    context : moderngl.Context
    width_px, height_px : int
        Size of the image.
    guard_band_px : int
        Width of the border around it.
    """

    def __init__(self, context: moderngl.Context, width_px: int, height_px: int, guard_band_px: int) -> None:
        # The scene whose signal it holds.
        self.scene: Scene | None = None
        self.guard_band_px = guard_band_px
        self.light_texture = context.texture(
            (width_px + 2 * guard_band_px, height_px + 2 * guard_band_px), 1, dtype="f4"
        )
        self.light_texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self.light = context.framebuffer([self.light_texture])

    def release(self) -> None:
        """Release the target."""
        self.light.release()
        self.light_texture.release()


class Targets(SignalTarget):
    """The signal target of an image, and the image that is developed from it.

    Parameters
    ----------
    context : moderngl.Context
    width_px, height_px : int
        Size of the image.
    guard_band_px : int
        Width of the signal's border around it.
    sixteen_bits : bool
        Whether the image has 16 bits per pixel instead of 8.
    """

    def __init__(
        self, context: moderngl.Context, width_px: int, height_px: int, guard_band_px: int, sixteen_bits: bool
    ) -> None:
        super().__init__(context, width_px, height_px, guard_band_px)
        self.key = (width_px, height_px, guard_band_px, sixteen_bits)
        # The seed that the scene was developed with; None before that.
        self.seed: int | None = None
        self.dtype: type[np.uint8] | type[np.uint16] = np.uint16 if sixteen_bits else np.uint8
        columns = -(-width_px // self._pixels_per_texel)
        self._image_texture = context.texture((columns, height_px), 4, dtype="u4")
        self.image = context.framebuffer([self._image_texture])
        self._display_texture: _DisplayTexture | None = None
        self._context = context
        self._size = width_px, height_px

    @property
    def _pixels_per_texel(self) -> int:
        return 16 // np.dtype(self.dtype).itemsize

    def padded(self) -> NDArray[Any]:
        """Return an array for the image as it lies in its target: rows padded to a multiple of 16 bytes."""
        columns, rows = self.image.size
        return np.empty((rows, self._pixels_per_texel * columns), self.dtype)

    def read_image_into(self, destination: NDArray[Any] | moderngl.Buffer) -> None:
        """Copy the padded image to an array or a buffer."""
        self.image.read_into(destination, components=4, dtype="u4")

    def cropped(self, padded: NDArray[Any]) -> NDArray[Any]:
        """Return the image without the padding of its rows: a view, because copying takes longer than reading."""
        return padded[:, : self._size[0]]

    def display_texture(self) -> moderngl.Texture:
        """Return the image as a texture with one integer per texel, for a window."""
        if self._display_texture is None:
            self._display_texture = _DisplayTexture(self._context, self._size, self.padded())
        self.read_image_into(self._display_texture.buffer)
        return self._display_texture.unpacked()

    def read_light(self) -> NDArray[np.float32]:
        """Return the noiseless signal without its guard band, (height, width), DN."""
        width_px, height_px = self.light.size
        with_guard_band = np.empty((height_px, width_px), np.float32)
        self.light.read_into(with_guard_band, components=1, dtype="f4")
        rows, columns = (slice(self.guard_band_px, side - self.guard_band_px) for side in with_guard_band.shape)
        return np.ascontiguousarray(with_guard_band[rows, columns])

    def release(self) -> None:
        """Release the targets."""
        for resource in (self._display_texture, self.image, self._image_texture):
            if resource is not None:
                resource.release()
        super().release()


class _DisplayTexture:
    """An image with one integer per texel, copied on the GPU from one with padded rows."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int], padded: NDArray[Any]) -> None:
        height_px, padded_px = padded.shape
        self._context = context
        self.buffer = context.buffer(reserve=padded.nbytes)
        textures = [context.texture(of, 1, dtype=f"u{padded.itemsize}") for of in ((padded_px, height_px), size)]
        self._padded, self._image = (context.framebuffer([texture]) for texture in textures)
        self._textures = textures
        textures[1].filter = moderngl.NEAREST, moderngl.NEAREST

    def unpacked(self) -> moderngl.Texture:
        """Return the texture with the content of `buffer`."""
        padded, image = self._textures
        padded.write(self.buffer)
        self._context.copy_framebuffer(self._image, self._padded)
        return image

    def release(self) -> None:
        """Release its resources."""
        for framebuffer in (self._padded, self._image):
            framebuffer.release()
        for texture in self._textures:
            texture.release()
        self.buffer.release()
