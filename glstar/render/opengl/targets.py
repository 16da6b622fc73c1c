"""Render targets and readback: the noiseless signal with its guard band, the developed image, and copies of it.

Images are copied to NumPy through one buffer per image in progress; a stacked image is added outside of the GPU and
uploaded for a window.  Waiting for the GPU does not keep Python's other threads from running.
"""

import ctypes
import sys
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.scene.scene import Frame, Scene


class SignalTarget:
    """A float32 target in which the flux of the stars is summed.

    A point whose centre lies outside the target is clipped entirely, so the target extends beyond the image by a guard
    band, from which stars contribute with a part of their sprite.  Half-float would lose single sub-exposures.
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
    """The signal target of an image, and the image that is developed from it, with 8 or 16 bits per pixel."""

    def __init__(
        self, context: moderngl.Context, width_px: int, height_px: int, guard_band_px: int, sixteen_bits: bool
    ) -> None:
        super().__init__(context, width_px, height_px, guard_band_px)
        self.key = (width_px, height_px, guard_band_px, sixteen_bits)
        # The seed that the scene was developed with; None before that.
        self.seed: int | None = None
        # Whether frames include the noiseless signal.
        self.reads_light = False
        self.dtype: type[np.uint8] | type[np.uint16] = np.uint16 if sixteen_bits else np.uint8
        columns = -(-width_px // self.pixels_per_texel)
        self._image_texture = context.texture((columns, height_px), 4, dtype="u4")
        self.image = context.framebuffer([self._image_texture])
        self._display_texture: _DisplayTexture | None = None
        self._context = context
        self._size = width_px, height_px

    @property
    def pixels_per_texel(self) -> int:
        """Number of pixels side by side in a texel of 16 bytes."""
        return 16 // np.dtype(self.dtype).itemsize

    def padded(self) -> NDArray[Any]:
        """Return an array for the image as it lies in its target: rows padded to a multiple of 16 bytes."""
        columns, rows = self.image.size
        return np.empty((rows, self.pixels_per_texel * columns), self.dtype)

    def read_image_into(self, destination: NDArray[Any] | moderngl.Buffer) -> None:
        """Copy the padded image to an array or a buffer."""
        self.image.read_into(destination, components=4, dtype="u4")

    def frame(self, padded: NDArray[Any], light_dn: NDArray[np.float32] | None) -> Frame:
        """Return the frame that was developed last, given the padded image and its noiseless signal.

        Its pixels are a view without the padding, because copying takes longer than reading.
        """
        assert self.scene is not None
        assert self.seed is not None
        return Frame(padded[:, : self._size[0]], self.scene.exposure, self.seed, light_dn)

    def display_texture(self) -> moderngl.Texture:
        """Return the image as a texture with one integer per texel, for a window."""
        if self._display_texture is None:
            self._display_texture = _DisplayTexture(self._context, self._size, self.padded())
        self.read_image_into(self._display_texture.buffer)
        return self._display_texture.unpacked()

    def holds(self, texture: moderngl.Texture) -> bool:
        """Return whether a texture is what `display_texture` returns."""
        return self._display_texture is not None and texture is self._display_texture.image

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
        self.image = textures[1]
        textures[1].filter = moderngl.NEAREST, moderngl.NEAREST

    def unpacked(self) -> moderngl.Texture:
        """Return the texture with the content of `buffer`."""
        self._textures[0].write(self.buffer)
        self._context.copy_framebuffer(self._image, self._padded)
        return self.image

    def release(self) -> None:
        """Release its resources."""
        for framebuffer in (self._padded, self._image):
            framebuffer.release()
        for texture in self._textures:
            texture.release()
        self.buffer.release()


class GuardBands:
    """Widths of guard bands; that of the previous scene is kept, because a flight's scenes have the same sensor."""

    def __init__(self, context: moderngl.Context) -> None:
        self._texture_size_px = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self._last: _GuardBand | None = None

    def of(self, scene: Scene) -> int:
        """Return the width of the guard band around a pinhole's image, px, for the brightest star, visible or not.

        Raises RenderError if the image is larger than the driver draws.
        """
        largest = _largest(scene)
        depends_on = scene.exposure.duration_s, *largest
        last = self._last
        if last is None or last.sensor is not scene.sensor or last.depends_on != depends_on:
            self._last = last = _GuardBand(scene.sensor, depends_on, _wide_guard_band_px(scene, *largest))
        _refuse_large_image(scene.camera, last.guard_band_px, self._texture_size_px)
        return last.guard_band_px


class _GuardBand(NamedTuple):
    """The guard band of a sensor; it depends on the exposure time and on what `_largest` returns."""

    sensor: Sensor
    depends_on: tuple[float, float, float]
    guard_band_px: int


def _largest(scene: Scene) -> tuple[float, float]:
    """Return the largest truncation radius, px, and the brightest magnitude of all that a scene draws."""
    fields = [scene, *([] if scene.body_scene is None else [scene.body_scene]), *scene.satellites]
    radius_px = max(float(field.draw_list.truncation_radius_px.max(initial=0.0)) for field in fields)
    return radius_px, min(float(field.stars.camera_mag.min(initial=np.inf)) for field in fields)


def _wide_guard_band_px(scene: Scene, radius_px: float, brightest_mag: float) -> int:
    """Return a width for the brightest star, whether visible or not.

    It is a multiple of 8 px, so that neither playback nor a slider creates new targets for every image.
    """
    brightest_dn = scene.sensor.peak_dn(brightest_mag, scene.exposure.duration_s)
    return 8 * int(np.ceil((max(radius_px, float(scene.sensor.truncation_radius_px(brightest_dn))) + 1) / 8))


def _refuse_large_image(camera: Camera, guard_band_px: int, texture_size_px: int) -> None:
    """Raise if an image with its guard band is larger than the driver draws."""
    if max(camera.width_px, camera.height_px) + 2 * guard_band_px > texture_size_px:
        raise RenderError(
            f"an image of {camera.width_px} x {camera.height_px} px is larger than this driver draws:"
            f" at most {texture_size_px - 2 * guard_band_px} px per side"
        )


class FrameReadback:
    """A frame whose pixels are copied from the GPU while further scenes are drawn.

    The pixels are a view of `padded`, whose content is in `buffer`; without these, `frame` is complete.
    """

    def __init__(
        self,
        readback: "Readback",
        frame: Frame,
        padded: NDArray[Any] | None = None,
        buffer: moderngl.Buffer | None = None,
    ) -> None:
        self._readback = readback
        self._frame: Frame | None = frame
        self._padded = padded
        self._buffer = buffer

    def frame(self) -> Frame:
        """Return the frame, after waiting for it; raises RenderError if it was discarded."""
        if self._frame is None:
            raise RenderError("this frame has been discarded")
        if self._buffer is not None and self._padded is not None:
            self._readback.copy_into(self._padded, self._buffer)
            self._buffer = None
        return self._frame

    def discard(self) -> None:
        """Give up the frame without waiting for it."""
        if self._buffer is not None:
            self._readback.recycle(self._buffer)
        self._buffer = None
        self._frame = None


class Readback:
    """Buffers that images are copied to in the background; `current` makes the context current."""

    def __init__(self, context: moderngl.Context, current: AbstractContextManager[object]) -> None:
        self._context = context
        self._current = current
        self._busy: list[moderngl.Buffer] = []
        self._idle: list[moderngl.Buffer] = []

    def start(self, targets: Targets) -> FrameReadback:
        """Start to copy a developed image; the noiseless signal is copied at once."""
        padded = targets.padded()
        buffer = self._buffer_of(padded.nbytes)
        targets.read_image_into(buffer)
        frame = targets.frame(padded, targets.read_light() if targets.reads_light else None)
        return FrameReadback(self, frame, padded, buffer)

    def copy_into(self, padded: NDArray[Any], buffer: moderngl.Buffer) -> None:
        """Wait for the image in a buffer, and copy it to an array."""
        if buffer not in self._busy:
            raise RenderError("this renderer is closed; make another")
        with self._current:
            buffer.read_into(padded)
        self.recycle(buffer)

    def recycle(self, buffer: moderngl.Buffer) -> None:
        """Keep the buffer of a frame for another one."""
        if buffer in self._busy:
            self._busy.remove(buffer)
            self._idle.append(buffer)

    def _buffer_of(self, size: int) -> moderngl.Buffer:
        buffer = next((buffer for buffer in self._idle if buffer.size == size), None)
        if buffer is None:
            while self._idle:  # of another image size
                self._idle.pop().release()
            buffer = self._context.buffer(reserve=size)
        else:
            self._idle.remove(buffer)
        self._busy.append(buffer)
        return buffer

    def release(self) -> None:
        """Release all buffers."""
        for buffer in (*self._busy, *self._idle):
            buffer.release()
        self._busy.clear()
        self._idle.clear()


# Where the system has glFinish for the current context, whichever library made it.
_LIBRARIES = {
    "linux": ("libOpenGL.so.0", "libGL.so.1"),
    "darwin": ("/System/Library/Frameworks/OpenGL.framework/OpenGL",),
    "win32": ("opengl32",),
}


def wait_until_drawn(context: moderngl.Context) -> None:
    """Wait until everything that was drawn on the current context is complete.

    ModernGL holds Python's lock while it waits, so that a scene could not be composed meanwhile; a function that is
    called through ctypes does not.
    """
    library = _library()
    if library is None:
        context.finish()
    else:
        library.glFinish()


def start_drawing() -> None:
    """Let the driver start the queued drawing of the current context, without waiting; a GPU starts by itself."""
    library = _library()
    if library is not None:
        library.glFlush()


@cache
def _library() -> ctypes.CDLL | None:
    """Return the system's library with glFinish and glFlush; None if it has another name here."""
    for name in _LIBRARIES.get(sys.platform, ()):
        try:
            library = ctypes.CDLL(name)
            functions = library.glFinish, library.glFlush
        except (OSError, AttributeError):
            continue
        for function in functions:
            function.restype = None
            function.argtypes = []
        return library
    return None
