"""The sub-exposure pass: stars that do not move during each of many sub-exposures, as point sprites.

Sprites of stars that a driver draws: each covers several sub-exposures of one Gaussian.
"""

from contextlib import ExitStack
from dataclasses import replace
from typing import Final

import moderngl
import numpy as np

from glstar.camera.sensor.pointspread import PLAIN
from glstar.errors import RenderError
from glstar.render.motion.trailmodels import SAMPLE_SPACING_SIGMA, SubExposures
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.textures import (
    GLOBAL_SHUTTER,
    PASSAGE_COLUMNS,
    TEXELS_PER_TIME,
    PassageTexture,
    ReadoutClock,
    StarBuffers,
    pointing_texels,
    projection_uniforms,
    superseded_field,
)
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import cell_tints

# Sub-exposures that one point sprite draws: software OpenGL needs half the time of one per sprite.
SUB_EXPOSURES_PER_SPRITE: Final = 4
# Rows of the texture of orientations, which every driver supports; longer exposures take several draw calls.
_SUB_EXPOSURES_PER_CALL: Final = 1024


class SubExposurePass:
    """Adds the flux of `SubExposures` to a target.

    Raises ShaderError if the driver rejects a shader.  Teague & Chahl, section 2.6.  Departs from the paper, which
    centres its kernel on whole pixels, with errors up to 0.7 px: sprites are drawn at sub-pixel positions.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        # The fields that were drawn last: the stars, which stay for a flight, and the bodies of a scene.
        self._uploaded: list[StarBuffers] = []
        with ExitStack() as owned:
            # By fragment shader, ROWS of readout.glsl, and whether there is a mosaic.
            self._programs: dict[tuple[str, int, bool], moderngl.Program] = {}
            owned.callback(self._release_programs)
            for fragments in ("star.frag", "star_erf.frag"):
                self._linked(fragments, rows=0, mosaic=False)
            self._pointing = context.texture((TEXELS_PER_TIME, _SUB_EXPOSURES_PER_CALL), 4, dtype="f4")
            owned.callback(self._pointing.release)
            self._pointing.filter = moderngl.NEAREST, moderngl.NEAREST
            owned.callback(self._drop_stars)
            self._passage = PassageTexture(context)
            owned.callback(self._passage.release)
            self._owned = owned.pop_all()

    def _linked(self, fragments: str, rows: int, *, mosaic: bool) -> moderngl.Program:
        """Return the program of a fragment shader for one value of ROWS, with or without a mosaic."""
        key = fragments, rows, mosaic
        if key not in self._programs:
            self._programs[key] = linked(
                self._context,
                "star.vert",
                fragments,
                SUB_EXPOSURES_PER_SPRITE=SUB_EXPOSURES_PER_SPRITE,
                ROWS=rows,
                MOSAIC=int(mosaic),
                PASSAGE_COLUMNS=PASSAGE_COLUMNS,
            )
        return self._programs[key]

    def _release_programs(self) -> None:
        for program in self._programs.values():
            program.release()
        self._programs.clear()

    def draw(
        self,
        scene: Scene,
        trails: SubExposures,
        light: moderngl.Framebuffer,
        guard_band_px: int,
        clock: ReadoutClock = GLOBAL_SHUTTER,
    ) -> None:
        """Add the flux of a scene's stars to a target.

        `trails`: the scene's; `light`: in use; 32-bit float; `guard_band_px`: width of its border around the image;
        `clock`: when the pixels of the target open.
        """
        program = self._program_for(scene, trails, light, guard_band_px, clock)
        vertices = self._stars_of(scene, guard_band_px).vertices(program)
        self._pointing.use(location=0)
        groups = scene.draw_list.passage_of_groups(SUB_EXPOSURES_PER_SPRITE)
        self._passage.write(groups)
        self._passage.texture.use(location=1)
        set_uniforms(program, passage=1, passage_instances=groups.shape[1])
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        texels = pointing_texels(trails.pointing, multiple=SUB_EXPOSURES_PER_SPRITE)
        for first in range(0, len(texels), _SUB_EXPOSURES_PER_CALL):
            rows = texels[first : first + _SUB_EXPOSURES_PER_CALL]
            self._pointing.write(rows, viewport=(0, 0, TEXELS_PER_TIME, len(rows)))
            if clock.rows:
                set_uniforms(program, first_instance=first // SUB_EXPOSURES_PER_SPRITE)
            set_uniforms(program, passage_first=first // SUB_EXPOSURES_PER_SPRITE)
            instances = len(rows) // SUB_EXPOSURES_PER_SPRITE
            vertices.render(moderngl.POINTS, vertices=len(scene.draw_list), instances=instances)
        self._context.enable_only(moderngl.NOTHING)

    def _program_for(
        self,
        scene: Scene,
        trails: SubExposures,
        light: moderngl.Framebuffer,
        guard_band_px: int,
        clock: ReadoutClock,
    ) -> moderngl.Program:
        """Return the program for the sensor's point spread function, with its uniforms set."""
        sensor = scene.sensor
        fragments, has_mosaic = "star_erf.frag" if sensor.needs_erf else "star.frag", sensor.colour.mosaic != "none"
        program = self._linked(fragments, clock.rows, mosaic=has_mosaic)
        vmag_0_peak_dn = float(sensor.peak_dn(0.0, scene.exposure.duration_s)) * clock.span
        if not sensor.needs_erf:
            vmag_0_peak_dn *= sensor.effective_peak
        set_uniforms(
            program,
            pointing=0,
            **projection_uniforms(scene.camera, trails.pointing, guard_band_px),
            sine_horizon=trails.pointing.sine_horizon,
            target_px=light.size,
            vmag_0_peak_dn=vmag_0_peak_dn / len(trails),
        )
        if clock.rows:
            set_uniforms(program, sub_time=1 / len(trails))
        clock.bind(program, sensor.effective_sigma_px)
        if sensor.needs_erf:
            set_uniforms(program, psf_sigma_px=sensor.psf_sigma_px)
        else:
            set_uniforms(program, falloff_per_px2=1 / (2 * np.log(2) * sensor.effective_sigma_px**2))
        return program

    def _stars_of(self, scene: Scene, guard_band_px: int) -> StarBuffers:
        known = [number for number, buffers in enumerate(self._uploaded) if buffers.stars is scene.stars]
        if known:
            self._uploaded.append(self._uploaded.pop(known[0]))
        else:
            oldest = superseded_field([buffers.stars for buffers in self._uploaded], scene.stars)
            if oldest is not None:
                self._uploaded.pop(oldest).release()
            self._uploaded.append(StarBuffers(self._context, scene.stars))
        self._uploaded[-1].choose(scene.draw_list, cell_tints(scene, guard_band_px))
        return self._uploaded[-1]

    def _drop_stars(self) -> None:
        while self._uploaded:
            self._uploaded.pop().release()

    def release(self) -> None:
        """Release programs and buffers."""
        self._owned.close()


def with_drawable_sprites(scene: Scene, core_sigma_px: float, point_size_px: float) -> Scene:
    """Return a scene of plain Gaussians whose sprites are not larger than a driver draws.

    `core_sigma_px`: the narrowest Gaussian of the whole point spread function, which decides the distance of
    sub-exposures, px; `point_size_px`: the largest sprite of the driver, px.  Returns: with smaller truncation radii if
    necessary, of 3.5 sigma or more.  Raises RenderError if such sprites are too large.
    """
    sensor, draw_list = scene.sensor, scene.draw_list
    moves = isinstance(scene.trails, SubExposures) and len(scene.trails) > 1
    extent_px = SAMPLE_SPACING_SIGMA * SUB_EXPOSURES_PER_SPRITE * core_sigma_px if moves else 0.0
    sprite_px = 2 * float(draw_list.truncation_radius_px.max(initial=0.0)) + extent_px
    if sprite_px <= point_size_px:
        return scene
    fitting_px = (point_size_px - extent_px) / 2
    if fitting_px < PLAIN.min_sigma * sensor.effective_sigma_px:
        raise RenderError(
            f"psf_sigma_px = {sensor.psf_sigma_px:g} requires sprites of {sprite_px:.0f} px"
            f" and this driver draws at most {point_size_px:.0f} px;"
            f" sigma may be {sensor.psf_sigma_px * point_size_px / sprite_px:.1f} px"
        )
    radii_px = np.minimum(draw_list.truncation_radius_px, fitting_px)
    return replace(scene, draw_list=replace(draw_list, truncation_radius_px=radii_px))
