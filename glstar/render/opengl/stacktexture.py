"""A stacked image as a texture, for a window: its short exposures are added outside of the GPU."""

from collections.abc import Callable
from functools import partial
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.scene import Frame, Scene
from glstar.render.stacking import stacked_frame

__all__ = ["StackTexture"]


class StackTexture:
    """The stacked image that was developed last, and the texture that shows it.

    Parameters
    ----------
    context : moderngl.Context

    Attributes
    ----------
    frame : Frame or None
        The image; None if the one developed last is a single exposure.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self.frame: Frame | None = None
        self._context = context
        self._texture: moderngl.Texture | None = None

    def drawn(
        self, render: Callable[..., Frame], scene: Scene, *, seed: int, light: bool = False, noiseless: bool = False
    ) -> Frame:
        """Draw a stacked image.

        Parameters
        ----------
        render : callable
            Draws a single exposure: ``render(scene, seed=seed, light=light, noiseless=noiseless)``.
        scene : Scene
            With `Scene.shorts`.
        seed : int
        light, noiseless : bool
            For `render`.

        Returns
        -------
        Frame
            `frame`, from now on.
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
