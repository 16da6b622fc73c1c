"""The mosaic pass: the signals of the colours are combined into one image, each in its own pixels."""

import moderngl

from glstar.camera.colourband import Channel, ColourBand
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.targets import SignalTarget

__all__ = ["MosaicPass"]


class MosaicPass:
    """Collects the pixels of each colour.

    Parameters
    ----------
    context : moderngl.Context

    Raises
    ------
    ShaderError
        If the driver rejects the shader.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._program = linked(context, "develop.vert", "mosaic.frag")
        self._whole_image = context.vertex_array(self._program, [])
        self._texture: moderngl.Texture | None = None
        self._collected: moderngl.Framebuffer | None = None

    def keep(self, target: SignalTarget, colour: ColourBand, channel: Channel) -> None:
        """Collect the pixels of one colour from a target that holds the signal of that colour in all pixels.

        Parameters
        ----------
        target : SignalTarget
        colour : ColourBand
            With a mosaic.
        channel : {"r", "g", "b"}
        """
        kept = tuple(int(colour.channel_at(column, row) == channel) for row in (0, 1) for column in (0, 1))
        set_uniforms(self._program, signal=0, guard_band_px=target.guard_band_px, is_kept=kept)
        target.light_texture.use(location=0)
        self._context.enable_only(moderngl.NOTHING)
        self._collected_of(target).use()
        self._whole_image.render(moderngl.TRIANGLES, vertices=3)

    def finish(self, target: SignalTarget) -> None:
        """Copy what has been collected to a target.

        Parameters
        ----------
        target : SignalTarget
        """
        self._context.copy_framebuffer(target.light, self._collected_of(target))

    def _collected_of(self, target: SignalTarget) -> moderngl.Framebuffer:
        if self._collected is None or self._collected.size != target.light.size:
            self._drop()
            self._texture = self._context.texture(target.light.size, 1, dtype="f4")
            self._collected = self._context.framebuffer([self._texture])
        return self._collected

    def _drop(self) -> None:
        for resource in (self._collected, self._texture):
            if resource is not None:
                resource.release()
        self._collected = self._texture = None

    def release(self) -> None:
        """Release the program and the target."""
        self._drop()
        self._whole_image.release()
        self._program.release()
