"""Render targets: the noiseless signal with its guard band, and the developed image.

Widths of the border around an image from which stars contribute with a part of their sprite.

A stacked image as a texture, for a window: its short exposures are added outside of the GPU.

Reading images back from the GPU without waiting: one buffer per image that has been started.

Waiting for the GPU without keeping Python's other threads from running.
"""

import ctypes
import sys
from collections import deque
from collections.abc import Callable
from functools import cache, partial
from typing import Any, Final, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.readout.stacking import stacked_frame
from glstar.render.scene.scene import Frame, Scene


class SignalTarget:
    """A float32 target in which the flux of the stars is summed.

    A point whose centre lies outside the target is clipped entirely, so the target extends beyond the image by a guard
    band, from which stars contribute with a part of their sprite.  Half-float would lose single sub-exposures.
    `width_px`, `height_px`: size of the image; `guard_band_px`: width of the border around it.
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

    `width_px`, `height_px`: size of the image; `guard_band_px`: width of the signal's border around it; `sixteen_bits`:
    whether the image has 16 bits per pixel instead of 8.
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


class GuardBands:
    """Widths of guard bands; that of the previous scene is kept, because a flight's scenes have the same sensor.

    `context`: its driver limits the size of images.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._texture_size_px = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self._last: _Known | None = None

    def of(self, scene: Scene) -> int:
        """Return the width of the guard band around a pinhole's image.

        Returns: px, for the brightest star, whether visible or not.  Raises RenderError if the image is larger than the
        driver draws.
        """
        largest = _largest(scene)
        known = self._last
        if (
            known is None
            or known.sensor is not scene.sensor
            or known.depends_on != (scene.exposure.duration_s, *largest)
        ):
            depends_on = scene.exposure.duration_s, *largest
            self._last = known = _Known(scene.sensor, depends_on, _wide_guard_band_px(scene, *largest))
        _refuse_large_image(scene.camera, known.guard_band_px, self._texture_size_px)
        return known.guard_band_px


class _Known(NamedTuple):
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

    It is a multiple of 8 px: neither playback nor a slider creates new targets for every image.
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


class StackTexture:
    """The stacked image that was developed last, and the texture that shows it.

    `frame`: the image; None if the one developed last is a single exposure.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self.frame: Frame | None = None
        self._context = context
        self._texture: moderngl.Texture | None = None

    def drawn(
        self, render: Callable[..., Frame], scene: Scene, *, seed: int, light: bool = False, noiseless: bool = False
    ) -> Frame:
        """Draw a stacked image.

        `render`: draws a single exposure: ``render(scene, seed=seed, light=light, noiseless=noiseless)``; `scene`: with
        `Scene.shorts`; `light`, `noiseless`: for `render`.  Returns `frame`, from now on.
        """
        self.frame = stacked = stacked_frame(partial(render, light=light, noiseless=noiseless), scene, seed=seed)
        return stacked

    def uploaded(self) -> moderngl.Texture:
        """Return `frame` as a texture with one integer per texel; that of the previous image is overwritten."""
        assert self.frame is not None
        pixels: NDArray[Any] = np.ascontiguousarray(self.frame.pixels)
        size, dtype = pixels.shape[::-1], f"u{pixels.itemsize}"
        if self._texture is None or (self._texture.size, self._texture.dtype) != (size, dtype):
            self.release()
            self._texture = self._context.texture(size, 1, dtype=dtype, alignment=1)
            self._texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self._texture.write(pixels, alignment=1)
        return self._texture

    def release(self) -> None:
        """Release the texture."""
        if self._texture is not None:
            self._texture.release()
        self._texture = None


class _Pending(NamedTuple):
    """An image that is being copied."""

    buffer: moderngl.Buffer
    targets: Targets
    exposure: Exposure
    seed: int
    light_dn: NDArray[np.float32] | None


class Readback:
    """Images that are being copied to buffers, in the order in which they were started."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._pending: deque[_Pending | Frame] = deque()
        self._idle: list[moderngl.Buffer] = []

    def begin(self, targets: Targets, *, light: bool) -> None:
        """Start to copy a developed image; the noiseless signal is copied at once.

        `targets`: with a scene and a seed; `light`: whether to copy the noiseless signal too.
        """
        assert targets.scene is not None
        assert targets.seed is not None
        buffer = self._buffer_of(targets.padded().nbytes)
        targets.read_image_into(buffer)
        light_dn = targets.read_light() if light else None
        self._pending.append(_Pending(buffer, targets, targets.scene.exposure, targets.seed, light_dn))

    def add(self, frame: Frame) -> None:
        """Add an image that has been read already, in the order of those that were started."""
        self._pending.append(frame)

    def end(self) -> Frame:
        """Return the earliest image that was started and not yet returned; raises RenderError if there is none."""
        if not self._pending:
            raise RenderError("no image is being read: call begin_read first")
        pending = self._pending.popleft()
        if isinstance(pending, Frame):
            return pending
        pixels = pending.targets.padded()
        pending.buffer.read_into(pixels)
        self._idle.append(pending.buffer)
        return Frame(pending.targets.cropped(pixels), pending.exposure, pending.seed, pending.light_dn)

    def forget(self) -> None:
        """Discard all images that were started."""
        while self._pending:
            pending = self._pending.popleft()
            if not isinstance(pending, Frame):
                self._idle.append(pending.buffer)

    def _buffer_of(self, size: int) -> moderngl.Buffer:
        buffer = next((buffer for buffer in self._idle if buffer.size == size), None)
        if buffer is not None:
            self._idle.remove(buffer)
            return buffer
        while self._idle:  # of another image size
            self._idle.pop().release()
        return self._context.buffer(reserve=size)

    def release(self) -> None:
        """Release all buffers."""
        self.forget()
        for buffer in self._idle:
            buffer.release()
        self._idle.clear()


# Where the system has glFinish for the current context, whichever library made it.
_LIBRARIES: Final = {
    "linux": ("libOpenGL.so.0", "libGL.so.1"),
    "darwin": ("/System/Library/Frameworks/OpenGL.framework/OpenGL",),
    "win32": ("opengl32",),
}


def wait_until_drawn(context: moderngl.Context) -> None:
    """Wait until everything that was drawn on the current context is complete.

    ModernGL holds Python's lock while it waits, so that a scene could not be composed meanwhile; a function that is
    called through ctypes does not.  `context`: the current one.
    """
    library = _library()
    if library is None:
        context.finish()
    else:
        library.glFinish()


def start_drawing() -> None:
    """Let the driver start what was drawn on the current context, without waiting; a GPU would start by itself."""
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
            function.restype, function.argtypes = None, []
        return library
    return None
