"""The develop pass: from the noiseless signal to digital numbers."""

from contextlib import ExitStack
from typing import Any

import moderngl
import numpy as np

from glstar.camera.sensor import Sensor
from glstar.render.opengl.program import linked, set_uniforms

__all__ = ["DevelopPass"]


class DevelopPass:
    """Add sky and noise to the noiseless signal, and quantise it.

    Parameters
    ----------
    context : moderngl.Context
        The context to draw with, current on this thread.

    Raises
    ------
    ShaderError
        If the driver rejects a shader.

    Notes
    -----
    Teague & Chahl, eq. (40).  The image is drawn as texels of 16 bytes, each of them 16 pixels of 8 bits or 8 pixels
    of 16 bits side by side, because that takes half the time on software OpenGL.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._programs: dict[type[Any], tuple[moderngl.Program, moderngl.VertexArray]] = {}
        with ExitStack() as owned:
            for dtype in (np.uint8, np.uint16):
                program = linked(context, "develop.vert", "develop.frag", SIXTEEN_BITS=int(dtype is np.uint16))
                owned.callback(program.release)
                set_uniforms(program, light=0)
                whole_image = context.vertex_array(program, [])
                owned.callback(whole_image.release)
                self._programs[dtype] = program, whole_image
            self._owned = owned.pop_all()

    def draw(
        self,
        sensor: Sensor,
        light: moderngl.Texture,
        guard_band_px: int,
        image: moderngl.Framebuffer,
        dtype: type[np.uint8] | type[np.uint16],
        *,
        seed: int,
    ) -> None:
        """Develop an image.

        Parameters
        ----------
        sensor : Sensor
        light : moderngl.Texture
            The noiseless signal with its guard band, one float32 a texel, DN.
        guard_band_px : int
            Width of the guard band around the image, px.
        image : moderngl.Framebuffer
            Where to draw: four unsigned integers of 32 bits a texel.
        dtype : numpy.uint8 or numpy.uint16
            The type of the image's pixels.
        seed : int
            Seed of the noise, 0 to 2**32 - 1.
        """
        program, whole_image = self._programs[dtype]
        set_uniforms(
            program,
            apron_px=guard_band_px,
            seed=seed,
            sky_mean_dn=sensor.sky_mean_dn,
            sky_std_dn=sensor.sky_std_dn,
            saturation_dn=float(sensor.saturation_dn),
        )
        self._context.enable_only(moderngl.NOTHING)
        light.use(location=0)
        image.use()
        whole_image.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Release the programs."""
        self._owned.close()
