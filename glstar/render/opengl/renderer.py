"""Scenes drawn with OpenGL: flux summed into a float target, then developed to digital numbers."""

from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from typing import Self

import moderngl

from glstar.errors import RenderError
from glstar.render.effects import EFFECTS, Effect, light_keys
from glstar.render.motion.trailmodels import AnalyticSegments, SubExposures
from glstar.render.opengl.context import headless_context
from glstar.render.opengl.drawnlens import DrawnLenses
from glstar.render.opengl.passes.develop import DevelopPass
from glstar.render.opengl.passes.enlarge import EnlargePass
from glstar.render.opengl.passes.path import drawn_together
from glstar.render.opengl.passes.subexposure import SubExposurePass, with_drawable_sprites
from glstar.render.opengl.passes.trail import DrawQueue, TrailPass
from glstar.render.opengl.targets import FrameReadback, GuardBands, Readback, Targets
from glstar.render.opengl.textures import ImageTexture, StarTarget, readout_clock
from glstar.render.readout.stacking import stacked_frame
from glstar.render.scene.reduction import reduced_scenes
from glstar.render.scene.scene import Frame, Scene
from glstar.render.scene.starcomponents import gaussian_scenes


class GLRenderer:
    """Draws scenes on one OpenGL context, on the thread that created it.

    `expose` sums the flux of the stars, `develop` converts it to digital numbers in a texture, `read` copies them to
    NumPy while further scenes are drawn; `render` does all three and waits.  A window shows `texture` and never reads.

    A `StarField` is uploaded once, and targets are created once per image size.  What changes from image to image is a
    small texture of orientations and the indices of the visible stars.

    Parameters
    ----------
    context : moderngl.Context
        The context to draw with, current on this thread.
    owns_context : bool
        Whether to release the context on close and to make it current for each call; otherwise the caller does.
    effects : sequence of Effect
        Sensor and sky effects of the develop pass.

    Attributes
    ----------
    driver : str
        Name and version of the driver.
    stacked : Frame or None
        The image that was developed last if it is stacked.

    Raises
    ------
    ShaderError
        If the driver rejects a shader.
    """

    def __init__(
        self, context: moderngl.Context, *, owns_context: bool = False, effects: Sequence[Effect] = EFFECTS
    ) -> None:
        self.context = context
        self.stacked: Frame | None = None
        self._owns_context = owns_context
        self._effects = tuple(effects)
        # The star passes read the keys of glstar's effects, whichever the develop pass has.
        self._light_keys = light_keys((*EFFECTS, *effects))
        # The caller's context is current already and must stay so: leaving it would make none current.
        self._current: AbstractContextManager[object] = context if owns_context else nullcontext()
        self._owned = ExitStack()
        self._targets: Targets | None = None
        self._closed = False
        try:
            with self._current:
                self._create_passes()
        except BaseException:
            self.close()
            raise

    def _create_passes(self) -> None:
        """Create what serves every scene."""
        context, owned = self.context, self._owned
        # The window's framebuffer, or an empty one: bound between images, because a bound target cannot be released.
        self._screen = context.detect_framebuffer(0)
        self._sub_exposure_pass = SubExposurePass(context)
        owned.callback(self._sub_exposure_pass.release)
        self._trail_pass = TrailPass(context)
        owned.callback(self._trail_pass.release)
        self._enlarge_pass = EnlargePass(context)
        owned.callback(self._enlarge_pass.release)
        self._develop_pass = DevelopPass(context, self._effects)
        owned.callback(self._develop_pass.release)
        self._readback = Readback(context, self._current)
        self._stack_texture = ImageTexture(context)
        owned.callback(self._stack_texture.release)
        owned.callback(self._drop_targets)
        owned.callback(self._readback.release)
        self._lenses = DrawnLenses(context)
        owned.callback(self._lenses.release)
        self._guard_bands = GuardBands(context)
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self.driver = f"{context.info['GL_RENDERER']}, {context.info['GL_VERSION']}"

    @classmethod
    def headless(cls, device_index: int | None = None, *, effects: Sequence[Effect] = EFFECTS) -> Self:
        """Return a renderer on a context of its own, which it releases on close.

        Parameters
        ----------
        device_index : int, optional
            Index of the EGL device; see `headless_context`.
        effects : sequence of Effect
            Sensor and sky effects of the develop pass.

        Returns
        -------
        GLRenderer

        Raises
        ------
        ContextError
            If there is no OpenGL 3.3.
        """
        return cls(headless_context(device_index), owns_context=True, effects=effects)

    def render(self, scene: Scene, *, seed: int, light: bool = False) -> Frame:
        """Draw a scene; the short exposures of a stacked image one after the other.

        Parameters
        ----------
        scene : Scene
        seed : int
            Seed of the noise, 0 to 2**32 - 1.
        light : bool
            Whether the frame includes its noiseless signal, `Frame.light_dn`.

        Returns
        -------
        Frame

        Raises
        ------
        RenderError
            If a star's sprite or the image is larger than the driver can draw, the seed is invalid, or the renderer is
            closed.
        """
        self.develop(scene, seed=seed, light=light)
        return self.stacked or self._frame()

    def expose(self, scene: Scene) -> None:
        """Sum the flux of all stars, unless the target holds it already.

        Parameters
        ----------
        scene : Scene
            A scene that differs from the last one only in its sky, its noise or the start of its exposure has the same
            flux and costs nothing.

        Raises
        ------
        RenderError
            If a star's sprite or the image is larger than the driver can draw, or the renderer is closed.
        """
        self._exposed(scene)

    def develop(self, scene: Scene, *, seed: int, light: bool = False, noiseless: bool = False) -> None:
        """Convert a scene's flux to digital numbers, after exposing it if necessary; a stacked image is drawn complete.

        On a GPU only a stacked image and blooming are waited for.

        Parameters
        ----------
        scene : Scene
        seed : int
            Seed of the noise, 0 to 2**32 - 1.
        light : bool
            Whether the frame that `read` returns includes its noiseless signal, `Frame.light_dn`.
        noiseless : bool
            Whether to leave out the effects of `Stage.SHOT_NOISE` and `Stage.NOISE`.

        Raises
        ------
        RenderError
            As `expose`, or if the seed is invalid.
        """
        if scene.shorts:
            draw = partial(self._drawn, light=light, noiseless=noiseless)
            self.stacked = stacked_frame(draw, scene, seed=seed)
            return
        if not 0 <= seed < 2**32:
            raise RenderError(f"a seed is a whole number from 0 to {2**32 - 1}, not {seed}")
        targets = self._exposed(scene)
        with self._current:
            self._develop_pass.draw(scene, targets, seed=seed, noiseless=noiseless)
            targets.seed = seed
            targets.reads_light = light
            self._screen.use()

    def _drawn(self, scene: Scene, *, seed: int, light: bool, noiseless: bool) -> Frame:
        self.develop(scene, seed=seed, light=light, noiseless=noiseless)
        return self._frame()

    def read(self) -> FrameReadback:
        """Start to copy the image that was developed last, without waiting for it.

        On a GPU drawing and copying continue in the background; each image that is being copied takes its size in
        memory.  The noiseless signal is copied at once.

        Returns
        -------
        FrameReadback
            Its `frame` waits for the image.

        Raises
        ------
        RenderError
            If nothing has been developed yet.
        """
        if self.stacked is not None and not self._closed:
            return FrameReadback(self._readback, self.stacked)
        targets = self._developed_last()
        with self._current:
            pending = self._readback.start(targets)
            self._screen.use()
        return pending

    def texture(self) -> moderngl.Texture:
        """Return the image that was developed last as a texture, after waiting for it.

        Returns
        -------
        moderngl.Texture
            One unsigned integer of 8 or 16 bits per pixel, row 0 its top.  The renderer owns it and overwrites it with
            the next image.

        Raises
        ------
        RenderError
            If nothing has been developed yet.
        """
        targets = None if self.stacked is not None and not self._closed else self._developed_last()
        with self._current:
            if targets is None:
                assert self.stacked is not None
                texture = self._stack_texture.of(self.stacked.pixels)
            else:
                texture = targets.display_texture()
            self._screen.use()
        return texture

    def holds(self, texture: moderngl.Texture | None) -> bool:
        """Return whether the `texture` of an earlier image still exists: until an image differs in size or type.

        Parameters
        ----------
        texture : moderngl.Texture or None

        Returns
        -------
        bool
            False for None.
        """
        if texture is None or self._targets is None:
            return False
        return texture is self._stack_texture.texture or self._targets.holds(texture)

    def _frame(self) -> Frame:
        """Return the image that was developed last, after waiting for it; it does not pass through a buffer."""
        targets = self._developed_last()
        with self._current:
            pixels = targets.padded()
            targets.read_image_into(pixels)
            frame = targets.frame(pixels, targets.read_light() if targets.reads_light else None)
            self._screen.use()
        return frame

    def _exposed(self, scene: Scene) -> Targets:
        _require_single(scene, is_closed=self._closed)
        self.stacked = None
        with self._current:
            targets = self._targets_for(scene)
            if targets.scene is None or not _have_same_light(scene, targets.scene, self._light_keys):
                self._expose_all(scene, targets)
            targets.scene = scene
            targets.seed = None
            self._screen.use()
        return targets

    def _developed_last(self) -> Targets:
        targets = self._targets
        if self._closed or targets is None or targets.scene is None or targets.seed is None:
            raise RenderError("nothing has been developed yet")
        return targets

    def _expose_all(self, scene: Scene, targets: Targets) -> None:
        """Sum the flux of a scene."""
        targets.scene = None  # until it is complete
        core_px = scene.sensor.core.psf_sigma_px
        gaussians = [
            with_drawable_sprites(gaussian, core_px, self._point_size_px, scene.sensor)
            for gaussian in gaussian_scenes(scene)
        ]
        clock = readout_clock(scene.exposure, scene.camera, targets.guard_band_px)
        full = StarTarget(targets.light, targets.guard_band_px, clock, self._lenses.of(scene.camera))
        divided = reduced_scenes(gaussians)
        wider: StarTarget | None = None
        for scale in sorted(divided.reduced, reverse=True):
            target = self._enlarge_pass.target(full, scene.camera, scale)
            self._sum(divided.reduced[scale], target, wider)
            wider = target
        self._sum(divided.full, full, wider)

    def _sum(self, gaussians: Sequence[Scene], target: StarTarget, wider: StarTarget | None) -> None:
        """Sum the flux of scenes in a target, and in a target of wider pixels."""
        first = target.light.clear if wider is None else partial(self._enlarge_pass.fill, target, wider)
        queue = DrawQueue(target, first)
        for scenes in drawn_together(gaussians, rolling=target.clock.rows > 0):
            self._add(scenes, queue)
        queue.run()

    def _add(self, scenes: Sequence[Scene], queue: DrawQueue) -> None:
        """Add the flux of scenes of `drawn_together`."""
        scene, *others = scenes
        match scene.trails:
            case AnalyticSegments() if others:
                self._trail_pass.draw_components(scenes, queue)
            case AnalyticSegments() as segments:
                self._trail_pass.draw(scene, segments, queue)
            case SubExposures() as sub_exposures:
                queue.run()
                self._sub_exposure_pass.draw(scene, sub_exposures, queue.target)
            case other:
                raise TypeError(f"no render pass draws {type(other).__name__}")

    def _targets_for(self, scene: Scene) -> Targets:
        camera, guard_band_px = scene.camera, self._guard_bands.of(scene)
        key = (camera.width_px, camera.height_px, guard_band_px, scene.sensor.bit_depth > 8)
        if self._targets is None or self._targets.key != key:
            self._drop_targets()
            self._targets = Targets(self.context, *key)
        return self._targets

    def _drop_targets(self) -> None:
        if self._targets is not None:
            self._targets.release()
            self._targets = None

    def close(self) -> None:
        """Release all resources; calling it again has no effect."""
        if self._closed:
            return
        self._closed = True
        with self._current:
            self._owned.close()
        if self._owns_context:
            self.context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _require_single(scene: Scene, *, is_closed: bool) -> None:
    """Raise if the renderer is closed, or a scene has several short exposures, which are drawn one at a time."""
    if is_closed:
        raise RenderError("this renderer is closed; make another")
    if scene.shorts:
        raise RenderError("a stacked image has no flux of its own; expose each of Scene.shorts, or call render")


def _have_same_light(one: Scene, other: Scene, light_keys: Collection[str]) -> bool:
    """Return whether two scenes have the same flux; a scene that changes has new arrays, so identity is sufficient."""
    if one is other:
        return True
    return (
        all(getattr(one, name) is getattr(other, name) for name in ("stars", "draw_list", "trails", "bodies"))
        and one.camera == other.camera
        and all(getattr(one.exposure, n) == getattr(other.exposure, n) for n in ("duration_s", "readout_s", "readout"))
        and one.sensor.leaves_same_signal(other.sensor, light_keys)
    )
