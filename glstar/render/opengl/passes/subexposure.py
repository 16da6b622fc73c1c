"""The sub-exposure pass: stars that do not move during each of many sub-exposures, as point sprites."""

from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import moderngl
import numpy as np

from glstar.camera.sensor.pointspread import PLAIN
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import RenderError
from glstar.render.motion.trailmodels import SAMPLE_SPACING_SIGMA, SubExposures
from glstar.render.opengl import textures
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import cell_tints

# Sub-exposures that one point sprite draws: software OpenGL needs half the time of one per sprite.
SUB_EXPOSURES_PER_SPRITE = 4
# Rows of the texture of orientations, which every driver supports; longer exposures take several draw calls.
_SUB_EXPOSURES_PER_CALL = 1024


class SubExposurePass:
    """Adds the flux of `SubExposures` to a target.

    Raises ShaderError if the driver rejects a shader.  Teague & Chahl, section 2.6.  Departs from the paper, which
    centres its kernel on whole pixels, with errors up to 0.7 px: sprites are drawn at sub-pixel positions.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._stars = textures.RecentFields(partial(textures.StarBuffers, context))
        with ExitStack() as owned:
            # By fragment shader, ROWS of readout.glsl, LENS of lens.glsl, and whether there is a mosaic.
            self._programs: dict[tuple[str, int, int, bool], moderngl.Program] = {}
            owned.callback(self._release_programs)
            for fragments in ("star.frag", "star_erf.frag"):
                self._linked(fragments, rows=0, lens=0, mosaic=False)
            self._pointing = context.texture((textures.TEXELS_PER_TIME, _SUB_EXPOSURES_PER_CALL), 4, dtype="f4")
            owned.callback(self._pointing.release)
            self._pointing.filter = moderngl.NEAREST, moderngl.NEAREST
            owned.callback(self._stars.release)
            self._passage = textures.PassageTexture(context)
            owned.callback(self._passage.release)
            self._owned = owned.pop_all()

    def _linked(self, fragments: str, rows: int, lens: int, *, mosaic: bool) -> moderngl.Program:
        """Return the program of a fragment shader for values of ROWS and LENS, with or without a mosaic."""
        key = fragments, rows, lens, mosaic
        if key not in self._programs:
            self._programs[key] = linked(
                self._context,
                "star.vert",
                fragments,
                SUB_EXPOSURES_PER_SPRITE=SUB_EXPOSURES_PER_SPRITE,
                ROWS=rows,
                LENS=lens,
                MOSAIC=int(mosaic),
                PASSAGE_COLUMNS=textures.PASSAGE_COLUMNS,
            )
        return self._programs[key]

    def _release_programs(self) -> None:
        for program in self._programs.values():
            program.release()
        self._programs.clear()

    def draw(self, scene: Scene, trails: SubExposures, target: textures.StarTarget) -> None:
        """Add the flux of a scene's stars to a target that is in use."""
        program = self._program_for(scene, trails, target)
        stars = self._stars.of(scene.stars)
        stars.choose(scene.draw_list, cell_tints(scene, target.guard_band_px))
        vertices = stars.vertices(program)
        self._pointing.use(location=0)
        groups = scene.draw_list.passage_of_groups(SUB_EXPOSURES_PER_SPRITE)
        self._passage.write(groups)
        self._passage.texture.use(location=1)
        set_uniforms(program, passage=1, passage_instances=groups.shape[1])
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        texels = textures.pointing_texels(trails.pointing, multiple=SUB_EXPOSURES_PER_SPRITE)
        for first in range(0, len(texels), _SUB_EXPOSURES_PER_CALL):
            rows = texels[first : first + _SUB_EXPOSURES_PER_CALL]
            self._pointing.write(rows, viewport=(0, 0, textures.TEXELS_PER_TIME, len(rows)))
            if target.clock.rows:
                set_uniforms(program, first_instance=first // SUB_EXPOSURES_PER_SPRITE)
            set_uniforms(program, passage_first=first // SUB_EXPOSURES_PER_SPRITE)
            instances = len(rows) // SUB_EXPOSURES_PER_SPRITE
            vertices.render(moderngl.POINTS, vertices=len(scene.draw_list), instances=instances)
        self._context.enable_only(moderngl.NOTHING)

    def _program_for(self, scene: Scene, trails: SubExposures, target: textures.StarTarget) -> moderngl.Program:
        """Return the program for the sensor's point spread function, with its uniforms set."""
        sensor, clock = scene.sensor, target.clock
        fragments = "star_erf.frag" if sensor.needs_erf else "star.frag"
        program = self._linked(fragments, clock.rows, target.lens.kind, mosaic=sensor.colour.mosaic != "none")
        vmag_0_peak_dn = float(sensor.peak_dn(0.0, scene.exposure.duration_s)) * clock.span
        if not sensor.needs_erf:
            vmag_0_peak_dn *= sensor.effective_peak
        set_uniforms(
            program,
            pointing=0,
            refraction_scale=trails.pointing.refraction_scale,
            sine_horizon=trails.pointing.sine_horizon,
            target_px=target.light.size,
            vmag_0_peak_dn=vmag_0_peak_dn / len(trails),
        )
        if clock.rows:
            set_uniforms(program, sub_time=1 / len(trails))
        clock.bind(program)
        target.lens.bind(program, scene.camera, target.guard_band_px)
        if sensor.needs_erf:
            set_uniforms(program, psf_sigma_px=sensor.psf_sigma_px)
        else:
            set_uniforms(program, falloff_per_px2=1 / (2 * np.log(2) * sensor.effective_sigma_px**2))
        return program

    def release(self) -> None:
        """Release programs and buffers."""
        self._owned.close()


def sprite_px(sigma_px: float, core_sigma_px: float) -> float:
    """Return the side of the smallest sprites of moving stars of some width, px; `core_sigma_px`: the narrowest."""
    return 2 * PLAIN.min_sigma * sigma_px + SAMPLE_SPACING_SIGMA * SUB_EXPOSURES_PER_SPRITE * core_sigma_px


def with_drawable_sprites(scene: Scene, core_sigma_px: float, point_size_px: float, whole: Sensor) -> Scene:
    """Return a scene of plain Gaussians whose sprites are not larger than a driver draws.

    If necessary its truncation radii are smaller, 3.5 sigma or more.  The width of the narrowest Gaussian of the whole
    point spread function decides the distance of sub-exposures.  Raises RenderError if such sprites are too large; it
    names the key of `whole`, the sensor as the user gave it.
    """
    sensor, draw_list = scene.sensor, scene.draw_list
    moves = isinstance(scene.trails, SubExposures) and len(scene.trails) > 1
    extent_px = sprite_px(0.0, core_sigma_px) if moves else 0.0
    largest_px = 2 * float(draw_list.truncation_radius_px.max(initial=0.0)) + extent_px
    if largest_px <= point_size_px:
        return scene
    fitting_px = (point_size_px - extent_px) / 2
    least_px = PLAIN.min_sigma * sensor.effective_sigma_px
    if fitting_px < least_px:
        key, value_px, _ = whole.point_spread.widest(whole.psf_sigma_px)
        raise RenderError(
            f"sensor.{key} = {value_px:g} requires sprites of {2 * least_px + extent_px:.0f} px"
            f" and this driver draws at most {point_size_px:.0f} px; it may be"
            f" {np.floor(10 * value_px * fitting_px / least_px) / 10:g} px"
        )
    radii_px = np.minimum(draw_list.truncation_radius_px, fitting_px)
    return replace(scene, draw_list=replace(draw_list, truncation_radius_px=radii_px))
