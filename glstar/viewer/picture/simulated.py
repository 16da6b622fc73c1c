"""The simulated image that the viewer shows, raw and as ``[output]`` processes it.

Its scene is composed on a thread of its own, and it is developed on the window's context.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.errors import ConfigError, GlstarError
from glstar.export.frame import frame_seed
from glstar.export.imagefiles.processing import CameraProcessing, process
from glstar.flight import Gap
from glstar.render.effects import light_keys
from glstar.render.opengl import GLRenderer, Texture
from glstar.render.opengl.targets import start_drawing, wait_until_drawn
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.viewer.frametimes import FrameTimes


def why_not_processed(scene: Scene) -> str:
    """Return why the image of a scene has no processed form, as a message; empty if ``[output]`` processes it."""
    try:
        is_active = CameraProcessing.of(scene.sensor).is_active
    except ConfigError as error:
        return str(error)
    if not is_active:
        return 'the camera writes the raw image; settings with [output] process = "isp" develop it'
    if scene.exposure.signal_factor > 1:
        return 'sums of raw images are not processed; exposure.stack = "mean" is'
    return ""


# Attributes of a Simulator on which the noiseless image depends, besides exposure and sensor.
_SIMULATOR_ATTRIBUTES = ("flight", "sky", "stars", "camera", "mount", "pressure_hpa", "temperature_c")
# A Sky compares by identity, because it holds arrays; two with these attributes equal give the same directions.
_SKY_ATTRIBUTES = ("catalogue", "astrometry", "dut1_s", "refraction")


# Longest wait of a frame for a scene that is being composed, s: a scene takes a few ms, one of 100,000 stars tens.
_COMPOSING_S = 0.01


class ImageRequest(NamedTuple):
    """All that an image depends on: equal requests give equal images."""

    exposure: Exposure
    # The number of the camera's exposure, which seeds the noise; None for an exposure that no camera records.
    number: int | None
    simulator: Simulator
    noiseless: bool = False  # Whether it is developed without noise


class _Drawing(NamedTuple):
    """An image that the GPU draws or has drawn, its scene, and whether it is developed or only exposed."""

    request: ImageRequest
    scene: Scene
    is_developed: bool


class SimulatedImage:
    """The simulated image shown at present; `renderer`: it stays the caller's."""

    def __init__(self, renderer: GLRenderer, times: FrameTimes) -> None:
        self.renderer = renderer
        self.scene: Scene | None = None  # The latest scene; None until there is one
        self.number: int | None = None  # Of the camera's exposure; None for an exposure that no camera records
        self.error = ""  # Why there is no newer image; empty if there is one
        # The gap of the attitude that the requested exposure touches.  There is no image then, because interpolating
        # the attitude across a gap would show a wrong sky.
        self.gap: Gap | None = None
        self.seed = 0  # Of the noise
        self._times = times
        self._composer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-compose")
        self._ahead: tuple[ImageRequest, Future[Scene]] | None = None
        self._developing: _Drawing | None = None
        self._drawn: ImageRequest | None = None
        # The image shown: one reference, because the composing thread reads it.
        self._shown: _Drawing | None = None
        self._texture: Texture | None = None
        # Whether the renderer has the image shown, and `_texture` an older one or none.
        self._unread = False
        self._pixels: tuple[Scene, NDArray[Any]] | None = None
        self._processed: tuple[NDArray[Any], NDArray[np.uint8]] | None = None
        self._saturated: NDArray[np.bool_] | None = None

    def update(self, request: ImageRequest, *, playing: bool) -> bool:
        """Draw the requested image, unless it is drawn already.

        `playing`: whether an image may be drawn while the one before it is shown: see `begin_next`; the image then lags
        a frame behind the request, and neither the threads nor the GPU wait for each other.  Returns whether the
        requested image was drawn in this call.
        """
        exposure = request.exposure
        self.gap = request.simulator.flight.attitude.gap_within(exposure.start_utc_s, exposure.stop_utc_s)
        if self.gap is not None:
            self._ahead = self._developing = self._drawn = None
            self.error = ""
            return False
        if playing:
            self._compose_ahead(request)
            return False
        self._ahead = None
        if self._developing is not None and self._developing.request == request:
            self._finish()
            return True
        if request != self._drawn or self._developing is not None:
            self._developing = None
            self._begin(request, lambda: self._scene_of(request))
            self._finish()
            return True
        return False

    def _compose_ahead(self, request: ImageRequest) -> None:
        """Show the image that was started after the last frame, and begin to compose the requested one."""
        self._finish()
        if self._ahead is None and request != self._drawn:
            self._ahead = request, self._composer.submit(self._scene_of, request)

    def begin_next(self) -> None:
        """Start to draw the image whose scene has been composed meanwhile, if any.

        To be called when a frame has been presented: a software driver then draws the image on its threads, while this
        one builds the panels of the next frame, and the frame presented did not wait for it.
        """
        if self._ahead is None:
            return
        ready, composed = self._ahead
        if self.has_image and not wait([composed], _COMPOSING_S).done:
            return
        self._ahead = None
        if not self._begin(ready, composed.result):
            self._finish()

    @property
    def has_image(self) -> bool:
        """Whether there is a developed image, perhaps an old one."""
        return self._unread or self._texture is not None

    @property
    def texture(self) -> Texture | None:
        """The developed image of `scene`; None if there is none.  Reading it waits until it has been drawn."""
        if self._unread:
            self._read()
        return self._texture

    def _read(self) -> None:
        self._unread = False
        assert self._shown is not None
        request, scene, is_developed = self._shown
        with self._times.span("drawing"):
            if not is_developed:
                wait_until_drawn(self.renderer.context)
                self._develop(request, scene)
            wait_until_drawn(self.renderer.context)
            self._texture = self.renderer.texture()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, px; of no image 0."""
        return (0, 0) if self.scene is None else (self.scene.camera.width_px, self.scene.camera.height_px)

    def _begin(self, request: ImageRequest, compose: Callable[[], Scene]) -> bool:
        """Start to draw an image; return whether the texture shown is still valid."""
        self._drawn = request
        if self._unread:
            self._read()  # before the renderer has another image
        try:
            scene = compose()
            with self._times.span("drawing"):
                # Developing would wait for the exposure on software OpenGL.
                later = self._can_develop_later(scene)
                if later:
                    self.renderer.expose(scene)
                else:
                    self._develop(request, scene)
                start_drawing()
        except GlstarError as error:
            self.error = str(error)
            return True
        self._developing = _Drawing(request, scene, not later)
        return self.renderer.holds(self._texture)

    def _can_develop_later(self, scene: Scene) -> bool:
        """Whether developing cannot fail, because the image shown was developed with the same sensor."""
        return self._shown is not None and self._shown.scene.sensor is scene.sensor and not scene.shorts

    def _develop(self, request: ImageRequest, scene: Scene) -> None:
        self.renderer.develop(scene, seed=frame_seed(self.seed, request.number or 0), noiseless=request.noiseless)

    def _finish(self) -> None:
        """Show the image that was started, if any."""
        if self._developing is None:
            return
        self._shown = self._developing
        self._developing = None
        request, scene, _ = self._shown
        self._unread = True
        stacked = self.renderer.stacked
        self._saturated = None if stacked is None else stacked.saturated
        self._times.new_image()
        self.scene = scene
        self.number = request.number
        self.error = ""

    def _scene_of(self, request: ImageRequest) -> Scene:
        """Return the scene; if only noise or quantisation changed, the last scene with the new sensor."""
        with self._times.span("simulation"):
            last, simulator = self._shown, request.simulator
            if last is not None and last.request.exposure == request.exposure:
                before = last.request.simulator
                same = all(
                    _are_equal(getattr(before, name), getattr(simulator, name)) for name in _SIMULATOR_ATTRIBUTES
                )
                if same and last.scene.sensor.leaves_same_signal(simulator.sensor, light_keys()):
                    return last.scene.with_sensor(simulator.sensor)
            return simulator.scene(request.exposure)

    @property
    def simulator(self) -> Simulator | None:
        """The simulator that composed `scene`."""
        return None if self._shown is None else self._shown.request.simulator

    @property
    def is_noiseless(self) -> bool:
        """Whether the image shown was developed without noise."""
        return self._shown is not None and self._shown.request.noiseless

    @property
    def pixels(self) -> NDArray[Any] | None:
        """The developed image, (height, width) uint8 or uint16, read back once; None if there is none or it is old.

        For overlays and readouts; drawing on the screen needs no transfer from the GPU.
        """
        if not self.has_image or self.scene is None or self.gap is not None or self.error:
            return None
        if self._pixels is None or self._pixels[0] is not self.scene:
            # From the texture: the renderer may be drawing the next image.
            texture = self.texture
            assert texture is not None
            width_px, height_px = texture.size
            read = np.frombuffer(texture.read(alignment=1), texture.dtype)
            self._pixels = self.scene, read.reshape(height_px, width_px)
        return self._pixels[1]

    @property
    def processed(self) -> NDArray[np.uint8] | None:
        """What ``[output]`` writes of `pixels` with 8 bits, (height, width, 3) uint8; None if it writes them raw.

        Red, green and blue are equal in a grey image.
        """
        pixels, scene = self.pixels, self.scene
        if pixels is None or scene is None or why_not_processed(scene):
            return None
        if self._processed is None or self._processed[0] is not pixels:
            image = np.asarray(process(pixels, scene.sensor, sixteen_bits=False), dtype=np.uint8)
            colours = np.repeat(image[..., np.newaxis], 3, axis=2) if image.ndim == 2 else image
            self._processed = pixels, np.ascontiguousarray(colours)
        return self._processed[1]

    @property
    def tested(self) -> NDArray[Any] | None:
        """What says where the image is saturated: `pixels`, or, (height, width) bool, where a short exposure is."""
        pixels = self.pixels
        return pixels if pixels is None or self._saturated is None else self._saturated

    def clear(self) -> None:
        """Show no image until the next one is drawn."""
        self._ahead = self._developing = self._drawn = self.gap = None
        self._texture = self.scene = self._shown = None
        self._unread = False
        self.error = ""

    def close(self) -> None:
        """End the thread; the renderer stays the caller's."""
        self._composer.shutdown(wait=True, cancel_futures=True)


def _are_equal(first: object, second: object) -> bool:
    if first is second or first == second:
        return True
    return all(
        hasattr(first, name) and hasattr(second, name) and getattr(first, name) == getattr(second, name)
        for name in _SKY_ATTRIBUTES
    )
