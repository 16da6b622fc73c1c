"""Scenes drawn with OpenGL: point sprites summed into a float target, then developed to digital numbers."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.errors import RenderError
from glstar.render.effects import EFFECTS, Effect
from glstar.render.opengl.context import headless_context
from glstar.render.opengl.developpass import DevelopPass
from glstar.render.opengl.distortionpass import PinholeLight, Warp
from glstar.render.opengl.program import linked, set_uniforms
from glstar.render.opengl.trailpass import SweptTrails
from glstar.render.scene import Frame, Pointing, Scene
from glstar.sky.magnitudes import brightness_ratio
from glstar.sky.starfield import StarField

__all__ = ["GLRenderer"]

# What star.vert takes at once, and how many numbers it reads of each.
_SUB_EXPOSURES_A_SPRITE: Final = 4
_TEXELS_A_SUB_EXPOSURE: Final = 5
# More sub-exposures than this are drawn in several calls: a texture has so many rows on any driver.
_SUB_EXPOSURES_A_CALL: Final = 1024


class GLRenderer:
    """Draws scenes on one OpenGL context, on the thread that made it.

    `expose` sums light, `develop` turns it into digital numbers in a texture, `read` brings them to NumPy; `render` is
    the three in a row.  A window shows the texture and never reads.  Between `begin_read` and `end_read` the next scene
    can be drawn, and who draws many goes from `begin` to `end_read`.

    Stars go up once a `StarField`, targets are made once an image size; what changes from image to image is one small
    buffer of matrices and the indices of the stars in view.

    Parameters
    ----------
    context : moderngl.Context
        The context to draw with, current on this thread.
    owns_context : bool
        Whether to release it when closed, and to make it current before each call; otherwise it stays the caller's.
    effects : sequence of Effect
        Sensor and sky effects of the develop pass.

    Attributes
    ----------
    driver : str
        The driver's name and version.

    Raises
    ------
    ShaderError
        If the driver refuses a shader.
    """

    def __init__(
        self, context: moderngl.Context, *, owns_context: bool = False, effects: Sequence[Effect] = EFFECTS
    ) -> None:
        self.context = context
        self._owns_context = owns_context
        self._effects = tuple(effects)
        # The caller's context is current already and must stay so: leaving it would make none current.
        self._current: AbstractContextManager[object] = context if owns_context else nullcontext()
        self._owned = ExitStack()
        self._uploaded: _UploadedStars | None = None
        self._targets: _Targets | None = None
        # Images on their way, the oldest first, and buffers that wait for the next.
        self._begun: deque[_Reading] = deque()
        self._idle: list[moderngl.Buffer] = []
        self._warp: Warp | None = None
        self._closed = False
        try:
            with self._current:
                self._make()
        except BaseException:
            self.close()
            raise

    def _make(self) -> None:
        """Make what serves every scene."""
        context, owned = self.context, self._owned
        # The window, or nothing at all: what is bound between two images, for a bound target cannot be released.
        self._screen = context.detect_framebuffer(0)
        self._gaussian = linked(context, "star.vert", "star.frag")
        owned.callback(self._gaussian.release)
        self._erf = linked(context, "star.vert", "star_erf.frag")
        owned.callback(self._erf.release)
        self._swept = SweptTrails(context)
        owned.callback(self._swept.release)
        self._develop_pass = DevelopPass(context, self._effects)
        owned.callback(self._develop_pass.release)
        self._sub_exposures = context.texture((_TEXELS_A_SUB_EXPOSURE, _SUB_EXPOSURES_A_CALL), 4, dtype="f4")
        owned.callback(self._sub_exposures.release)
        self._sub_exposures.filter = moderngl.NEAREST, moderngl.NEAREST
        owned.callback(self._drop_uploaded)
        owned.callback(self._drop_targets)
        owned.callback(self._drop_readings)
        owned.callback(self._drop_warp)
        self._point_size_px = float(context.info["GL_POINT_SIZE_RANGE"][1])
        self._texture_size_px = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self.driver = f"{context.info['GL_RENDERER']}, {context.info['GL_VERSION']}"

    @classmethod
    def headless(cls, device_index: int | None = None, *, effects: Sequence[Effect] = EFFECTS) -> Self:
        """Return a renderer on a context of its own, which it releases when closed.

        Parameters
        ----------
        device_index : int, optional
            Which EGL device; see `headless_context`.
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
        """Draw a scene.

        Parameters
        ----------
        scene : Scene
        seed : int
            Seed of the noise, 0 to 2**32 - 1.
        light : bool
            Whether the frame shall carry its `light_dn`.

        Returns
        -------
        Frame

        Raises
        ------
        RenderError
            If a star's sprite or the image is larger than the driver can draw, the seed is none, or the renderer is
            closed.

        Notes
        -----
        Teague & Chahl, section 2.6.  Departs from the paper, which centres its kernel on whole pixels: up to 0.7 px
        off; sprites stand at the sub-pixel position.
        """
        self._developed(scene, seed)
        return self.read(light=light)

    def begin(self, scene: Scene, *, seed: int, light: bool = False) -> None:
        """Begin to draw a scene, and do not wait for it; `end_read` returns the frame.

        Parameters
        ----------
        scene, seed, light
            As for `render`.

        Raises
        ------
        RenderError
            As `render`.
        """
        self._developed(scene, seed)
        self.begin_read(light=light)

    def expose(self, scene: Scene) -> None:
        """Sum the light of every star in every sub-exposure, unless it is the light that is there.

        Parameters
        ----------
        scene : Scene
            A scene that differs from the last one in its sky, its noise or its exposure's start alone has the same
            light, and costs nothing.

        Raises
        ------
        RenderError
            If a star's sprite or the image is larger than the driver can draw, or the renderer is closed.
        """
        self._exposed(scene)

    def develop(self, scene: Scene, *, seed: int) -> moderngl.Texture:
        """Turn a scene's light into digital numbers, after exposing it where that has not been done.

        Parameters
        ----------
        scene : Scene
        seed : int
            Seed of the noise, 0 to 2**32 - 1.

        Returns
        -------
        moderngl.Texture
            The image, one unsigned whole number a pixel, 8 or 16 bits, row 0 its top.  It stays the renderer's, and
            holds this image until the next is developed.

        Raises
        ------
        RenderError
            As `expose`, or if the seed is none.
        """
        targets = self._developed(scene, seed)
        with self._current:
            texture = targets.shown()
            self._screen.use()
            return texture

    def _developed(self, scene: Scene, seed: int) -> "_Targets":
        if not 0 <= seed < 2**32:
            raise RenderError(f"a seed is a whole number from 0 to {2**32 - 1}, not {seed}")
        targets = self._exposed(scene)
        with self._current:
            self._develop_pass.draw(
                scene, targets.light_texture, targets.apron_px, targets.image, targets.dtype, seed=seed
            )
            targets.seed = seed
            self._screen.use()
        return targets

    def _exposed(self, scene: Scene) -> "_Targets":
        if self._closed:
            raise RenderError("this renderer is closed; make another")
        with self._current:
            targets = self._targets_for(scene)
            if targets.scene is None or not _same_light(scene, targets.scene):
                if scene.camera.lens is None:
                    self._expose(scene, targets)
                else:
                    self._expose_behind_lens(scene, targets)
            targets.scene, targets.seed = scene, None
            self._screen.use()
        return targets

    def read(self, *, light: bool = False) -> Frame:
        """Return the image that was developed last.

        Parameters
        ----------
        light : bool
            Whether the frame shall carry its `light_dn`.

        Returns
        -------
        Frame

        Raises
        ------
        RenderError
            If nothing has been developed yet.
        """
        targets = self._developed_last()
        assert targets.scene is not None
        assert targets.seed is not None
        with self._current:
            pixels = targets.packed()
            targets.read_image_into(pixels)
            light_dn = targets.read_light() if light else None
            self._screen.use()
            return Frame(targets.cropped(pixels), targets.scene.exposure, targets.seed, light_dn)

    def begin_read(self, *, light: bool = False) -> None:
        """Have the image that was developed last copied, and do not wait for it.

        The next scenes can be rendered at once; `end_read` returns the frames in the order in which they were begun.
        On a GPU drawing and copying go on while the caller does something else.  Each image between the two takes its
        size in memory.

        Parameters
        ----------
        light : bool
            Whether the frame shall carry its `light_dn`; that is waited for.

        Raises
        ------
        RenderError
            If nothing has been developed yet.
        """
        targets = self._developed_last()
        assert targets.scene is not None
        assert targets.seed is not None
        with self._current:
            size = targets.packed().nbytes
            held = next((buffer for buffer in self._idle if buffer.size == size), None)
            if held is None:
                while self._idle:  # of another image size
                    self._idle.pop().release()
                held = self.context.buffer(reserve=size)
            else:
                self._idle.remove(held)
            targets.read_image_into(held)
            light_dn = targets.read_light() if light else None
            self._screen.use()
        exposure, seed = targets.scene.exposure, targets.seed
        self._begun.append(_Reading(held, targets.packed, targets.cropped, exposure, seed, light_dn))

    def end_read(self) -> Frame:
        """Return the first image that `begin_read` was called for and that has not been returned.

        Returns
        -------
        Frame

        Raises
        ------
        RenderError
            If there is none.
        """
        if not self._begun:
            raise RenderError("no image is being read: call begin_read first")
        reading = self._begun.popleft()
        with self._current:
            pixels = reading.packed()
            reading.buffer.read_into(pixels)
        self._idle.append(reading.buffer)
        return Frame(reading.cropped(pixels), reading.exposure, reading.seed, reading.light_dn)

    def forget(self) -> None:
        """Let go of the images that were begun and that nobody will ask for."""
        while self._begun:
            self._idle.append(self._begun.popleft().buffer)

    def _developed_last(self) -> "_Targets":
        targets = self._targets
        if self._closed or targets is None or targets.scene is None or targets.seed is None:
            raise RenderError("nothing has been developed yet")
        return targets

    def _expose_behind_lens(self, scene: Scene, targets: "_Targets") -> None:
        targets.scene = None  # until it is whole
        warp = self._warp_for(scene)
        straight = warp.straight(scene)
        self._expose(straight, warp.light_for(straight, self._apron_px(straight)))
        warp.gather(scene, targets.light)

    def _expose(self, scene: Scene, targets: "_Targets | PinholeLight") -> None:
        targets.scene = None  # until it is whole
        targets.light.use()
        targets.light.clear()
        if not scene.visible.size:
            return
        if scene.exposure.trail == "analytic":
            self._swept.draw(scene, targets.light, targets.apron_px)
        else:
            self._draw_sprites(scene, targets)

    def _draw_sprites(self, scene: Scene, targets: "_Targets | PinholeLight") -> None:
        sensor = scene.sensor
        program = self._erf if sensor.needs_erf else self._gaussian
        camera = scene.camera
        vmag_0_peak_dn = float(sensor.peak_dn(0.0, scene.exposure.duration_s))
        if not sensor.needs_erf:
            vmag_0_peak_dn *= sensor.drawn_peak
        set_uniforms(
            program,
            sub_exposures=0,
            refraction_scale=scene.pointing.refraction_scale,
            focal_px=(camera.fx_px, camera.fy_px),
            principal_px=(camera.cx_px, camera.cy_px),
            skew_px=camera.skew_px,
            apron_px=targets.apron_px,
            target_px=targets.light.size,
            vmag_0_peak_dn=vmag_0_peak_dn / len(scene.pointing),
        )
        if sensor.needs_erf:
            set_uniforms(program, psf_sigma_px=sensor.psf_sigma_px)
        else:
            set_uniforms(program, falloff_per_px2=1 / (2 * np.log(2) * sensor.drawn_sigma_px**2))

        stars = self._uploaded_for(scene)
        vertices = stars.vertices(program)
        self._sub_exposures.use(location=0)
        self.context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self.context.blend_func = moderngl.ONE, moderngl.ONE
        texels = _texels(scene.pointing)
        for first in range(0, len(texels), _SUB_EXPOSURES_A_CALL):
            rows = texels[first : first + _SUB_EXPOSURES_A_CALL]
            self._sub_exposures.write(rows, viewport=(0, 0, _TEXELS_A_SUB_EXPOSURE, len(rows)))
            instances = len(rows) // _SUB_EXPOSURES_A_SPRITE
            vertices.render(moderngl.POINTS, vertices=scene.visible.size, instances=instances)
        self.context.enable_only(moderngl.NOTHING)

    def _uploaded_for(self, scene: Scene) -> "_UploadedStars":
        if self._uploaded is None or self._uploaded.stars is not scene.stars:
            self._drop_uploaded()
            self._uploaded = _UploadedStars(self.context, scene.stars)
        self._uploaded.choose(scene.visible, scene.reach_px)
        return self._uploaded

    def _targets_for(self, scene: Scene) -> "_Targets":
        camera = scene.camera
        if camera.lens is None:
            apron_px = self._apron_px(scene)
        else:
            # The pinhole's light has the apron; what is gathered from it is the image and no more.
            self._apron_px(self._warp_for(scene).straight(scene))
            apron_px = 0
        wanted = (camera.width_px, camera.height_px, apron_px, scene.sensor.bit_depth > 8)
        if self._targets is None or self._targets.key != wanted:
            self._drop_targets()
            self._targets = _Targets(self.context, *wanted)
        return self._targets

    def _apron_px(self, scene: Scene) -> int:
        """Return by how much the light of a pinhole's scene must be larger than its image; refuse what is too large."""
        camera, sensor = scene.camera, scene.sensor
        reach_px = float(scene.reach_px.max(initial=0.0))
        # Wide enough for all of a sprite's sub-exposures, 1.5 sigma apart.
        sprite_px = 2 * reach_px + 1.5 * _SUB_EXPOSURES_A_SPRITE * sensor.psf_sigma_px
        if sprite_px > self._point_size_px:
            raise RenderError(
                f"psf_sigma_px = {sensor.psf_sigma_px:g} asks for sprites of {sprite_px:.0f} px"
                f" and this driver draws {self._point_size_px:.0f} px at most;"
                f" sigma may be {sensor.psf_sigma_px * self._point_size_px / sprite_px:.1f} px"
            )
        # As the brightest of all stars asks for, in sight or not, in steps of 8 px: neither playing nor a slider makes
        # new targets all the time.
        brightest_dn = sensor.peak_dn(scene.stars.camera_mag.min(initial=np.inf), scene.exposure.duration_s)
        apron_px = 8 * int(np.ceil((max(reach_px, float(sensor.reach_px(brightest_dn))) + 1) / 8))
        if max(camera.width_px, camera.height_px) + 2 * apron_px > self._texture_size_px:
            raise RenderError(
                f"an image of {camera.width_px} x {camera.height_px} px is larger than this driver draws:"
                f" {self._texture_size_px - 2 * apron_px} px a side at most"
            )
        return apron_px

    def _warp_for(self, scene: Scene) -> Warp:
        if self._warp is None or self._warp.camera != scene.camera:
            self._drop_warp()
            self._warp = Warp(self.context, scene.camera)
        return self._warp

    def _drop_warp(self) -> None:
        if self._warp is not None:
            self._warp.release()
            self._warp = None

    def _drop_uploaded(self) -> None:
        if self._uploaded is not None:
            self._uploaded.release()
            self._uploaded = None

    def _drop_readings(self) -> None:
        for buffer in [*self._idle, *(reading.buffer for reading in self._begun)]:
            buffer.release()
        self._idle.clear()
        self._begun.clear()

    def _drop_targets(self) -> None:
        if self._targets is not None:
            self._targets.release()
            self._targets = None

    def close(self) -> None:
        """Give back all that the renderer holds; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        with self._current:
            self._owned.close()
        if self._owns_context:
            self.context.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Reading(NamedTuple):
    """An image on its way."""

    buffer: moderngl.Buffer
    packed: Callable[[], NDArray[Any]]
    cropped: Callable[[NDArray[Any]], NDArray[Any]]
    exposure: Exposure
    seed: int
    light_dn: NDArray[np.float32] | None


class _UploadedStars:
    """One star field on the GPU."""

    def __init__(self, context: moderngl.Context, stars: StarField) -> None:
        self.stars = stars
        self._context = context
        packed = np.empty((len(stars), 4), np.float32)
        packed[:, :3] = stars.direction_eq
        packed[:, 3] = brightness_ratio(stars.camera_mag)
        self._stars = context.buffer(packed)
        self._reach_px = np.ones(len(stars), np.float32)
        self._reach = context.buffer(self._reach_px, dynamic=True)
        self._visible = context.buffer(reserve=4 * len(stars), dynamic=True)
        self._vertices: dict[moderngl.Program, moderngl.VertexArray] = {}

    def choose(self, visible: NDArray[np.int32], reach_px: NDArray[np.float64]) -> None:
        """Say which stars the next image shows, and how far each is drawn."""
        self._reach_px[visible] = reach_px
        self._reach.write(self._reach_px)
        self._visible.write(np.ascontiguousarray(visible))

    def vertices(self, program: moderngl.Program) -> moderngl.VertexArray:
        """Return the chosen stars as vertices for a program."""
        if program not in self._vertices:
            content = [(self._stars, "3f 1f", "direction_eq", "brightness"), (self._reach, "1f", "reach_px")]
            self._vertices[program] = self._context.vertex_array(program, content, index_buffer=self._visible)
        return self._vertices[program]

    def release(self) -> None:
        """Give all of it back."""
        for vertices in self._vertices.values():
            vertices.release()
        self._vertices.clear()
        for buffer in (self._visible, self._reach, self._stars):
            buffer.release()


class _Targets:
    """Where light is summed, and where the image is developed."""

    def __init__(
        self, context: moderngl.Context, width_px: int, height_px: int, apron_px: int, sixteen_bits: bool
    ) -> None:
        self.key = (width_px, height_px, apron_px, sixteen_bits)
        # What lies in them: the scene whose light it is, and the seed that it was developed with.
        self.scene: Scene | None = None
        self.seed: int | None = None
        self.apron_px = apron_px
        self.dtype: type[np.uint8] | type[np.uint16] = np.uint16 if sixteen_bits else np.uint8
        # A point whose centre lies outside the target is clipped whole: the apron lets stars come in gently.
        # 32 bits, for a half-float target loses the light of a single sub-exposure.
        size = width_px + 2 * apron_px, height_px + 2 * apron_px
        self.light_texture = context.texture(size, 1, dtype="f4")
        self.light_texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self.light = context.framebuffer([self.light_texture])
        columns = -(-width_px // self._pixels_a_texel)
        self._image_texture = context.texture((columns, height_px), 4, dtype="u4")
        self.image = context.framebuffer([self._image_texture])
        self._shown: _Shown | None = None
        self._context = context
        self._size = width_px, height_px

    @property
    def _pixels_a_texel(self) -> int:
        return 16 // np.dtype(self.dtype).itemsize

    def packed(self) -> NDArray[Any]:
        """Return an array for the image as it lies in its target: rows of a multiple of 16 bytes."""
        columns, rows = self.image.size
        return np.empty((rows, self._pixels_a_texel * columns), self.dtype)

    def read_image_into(self, place: NDArray[Any] | moderngl.Buffer) -> None:
        """Copy the image as it lies in its target."""
        self.image.read_into(place, components=4, dtype="u4")

    def cropped(self, packed: NDArray[Any]) -> NDArray[Any]:
        """Return the image without what fills its rows up: a view, for copying megabytes takes longer than reading."""
        return packed[:, : self._size[0]]

    def shown(self) -> moderngl.Texture:
        """Return the image as a texture of one number a texel, for a window."""
        if self._shown is None:
            self._shown = _Shown(self._context, self._size, self.packed())
        self.read_image_into(self._shown.buffer)
        return self._shown.unpacked()

    def read_light(self) -> NDArray[np.float32]:
        """Return the light without its apron, (height, width), DN."""
        width_px, height_px = self.light.size
        whole = np.empty((height_px, width_px), np.float32)
        self.light.read_into(whole, components=1, dtype="f4")
        rows, columns = (slice(self.apron_px, side - self.apron_px) for side in whole.shape)
        return np.ascontiguousarray(whole[rows, columns])

    def release(self) -> None:
        """Give all of it back."""
        for resource in (self._shown, self.image, self._image_texture, self.light, self.light_texture):
            if resource is not None:
                resource.release()


class _Shown:
    """An image with one number a texel, from one whose rows are filled up; nothing of it leaves the driver."""

    def __init__(self, context: moderngl.Context, size: tuple[int, int], packed: NDArray[Any]) -> None:
        height_px, filled_px = packed.shape
        self._context = context
        self.buffer = context.buffer(reserve=packed.nbytes)
        textures = [context.texture(of, 1, dtype=f"u{packed.itemsize}") for of in ((filled_px, height_px), size)]
        self._filled, self._image = (context.framebuffer([texture]) for texture in textures)
        self._textures = textures
        textures[1].filter = moderngl.NEAREST, moderngl.NEAREST

    def unpacked(self) -> moderngl.Texture:
        """Return the texture after taking over what lies in `buffer`."""
        filled, image = self._textures
        filled.write(self.buffer)
        self._context.copy_framebuffer(self._image, self._filled)
        return image

    def release(self) -> None:
        """Give all of it back."""
        for framebuffer in (self._filled, self._image):
            framebuffer.release()
        for texture in self._textures:
            texture.release()
        self.buffer.release()


def _same_light(one: Scene, other: Scene) -> bool:
    """Say whether two scenes leave the same light; whatever moves makes its arrays anew, so that identity will do."""
    if one is other:
        return True
    same = all(getattr(one, name) is getattr(other, name) for name in ("stars", "visible", "reach_px", "pointing"))
    return (
        same
        and one.camera == other.camera
        and one.exposure.duration_s == other.exposure.duration_s
        and one.sensor.same_light(other.sensor)
    )


def _texels(pointing: Pointing) -> NDArray[np.float32]:
    """Return the texture that star.vert reads, (n, 5, 4) float32, its last sprite filled up with zeros: no light."""
    n = len(pointing)
    filled = -(-n // _SUB_EXPOSURES_A_SPRITE) * _SUB_EXPOSURES_A_SPRITE
    texels = np.zeros((filled, _TEXELS_A_SUB_EXPOSURE, 4), np.float32)
    texels[:n, :3, :3] = pointing.C_camera_eq
    texels[:n, 3, :3] = pointing.zenith_eq
    texels[:n, 4, :3] = pointing.velocity_eq
    return texels
