"""The enlarge pass: light drawn on wide pixels, added to a finer target by linear interpolation."""

from contextlib import ExitStack
from dataclasses import replace

import moderngl

from glstar.camera.model import Camera
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.targets import SignalTarget
from glstar.render.opengl.textures import ReadoutClock, StarTarget
from glstar.render.scene.reduction import reduced_camera

# Border of a reduced target around the image: interpolation reads half a pixel beyond it.
_GUARD_BAND_PX = 2


class EnlargePass:
    """Targets of wide pixels, and what copies their light to finer ones.

    Raises ShaderError if the driver rejects a shader.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._targets: dict[int, SignalTarget] = {}
        with ExitStack() as owned:
            self._program = linked(context, "whole_image.vert", "enlarge.frag")
            owned.callback(self._program.release)
            set_uniforms(self._program, reduced=0)
            self._vertices = context.vertex_array(self._program, [])
            owned.callback(self._vertices.release)
            owned.callback(self._drop_targets)
            self._owned = owned.pop_all()

    def target(self, full: StarTarget, camera: Camera, scale: int) -> StarTarget:
        """Return the target with pixels `scale` times as wide as the full target's, for a camera's image."""
        of_pixels = reduced_camera(camera, scale)
        size = of_pixels.width_px + 2 * _GUARD_BAND_PX, of_pixels.height_px + 2 * _GUARD_BAND_PX
        target = self._targets.get(scale)
        if target is None or target.light_texture.size != size:
            if target is not None:
                target.release()
            target = SignalTarget(self._context, of_pixels.width_px, of_pixels.height_px, _GUARD_BAND_PX)
            target.light_texture.filter = moderngl.LINEAR, moderngl.LINEAR
            target.light_texture.repeat_x = target.light_texture.repeat_y = False
            self._targets[scale] = target
        clock = _reduced_clock(full.clock, full.guard_band_px, scale)
        return StarTarget(target.light, _GUARD_BAND_PX, clock, full.lens, scale)

    def fill(self, target: StarTarget, reduced: StarTarget) -> None:
        """Replace the content of a target that is in use by the light of a reduced one."""
        texture = self._targets[reduced.pixel_width_px].light_texture
        ratio = target.pixel_width_px / reduced.pixel_width_px
        first_px = reduced.guard_band_px - ratio * target.guard_band_px
        width_px, height_px = texture.size
        set_uniforms(
            self._program,
            texels_per_px=(ratio / width_px, ratio / height_px),
            first=(first_px / width_px, first_px / height_px),
        )
        texture.use(0)
        self._context.enable_only(moderngl.NOTHING)
        # The guard band of the image is not read.
        light, border_px = target.light, target.guard_band_px if target.pixel_width_px == 1 else 0
        if border_px:
            light.clear()
        light.viewport = border_px, border_px, light.width - 2 * border_px, light.height - 2 * border_px
        self._vertices.render(moderngl.TRIANGLES, vertices=3)
        light.viewport = 0, 0, *light.size

    def _drop_targets(self) -> None:
        for target in self._targets.values():
            target.release()
        self._targets.clear()

    def release(self) -> None:
        """Release the targets and the program."""
        self._owned.close()


def _reduced_clock(clock: ReadoutClock, guard_band_px: int, scale: int) -> ReadoutClock:
    """Return when the pixels of a reduced target open, given the times of a target with some guard band."""
    per_column, per_row, first = clock.opening
    shift_px = guard_band_px - scale * _GUARD_BAND_PX
    return replace(clock, opening=(scale * per_column, scale * per_row, first + shift_px * (per_column + per_row)))
