"""The window's comparison equals the file's: display.frag against NumPy, within one digital number."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import moderngl
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.images import FittedImage, RealImages, fit
from glstar.render.opengl import GLRenderer
from glstar.system.resources import asset
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState, compose
from glstar.viewer.picture.content import Display, PanelContent, Picture
from glstar.viewer.picture.view import ImageView, Stretch, StretchKind

WIDTH_PX, HEIGHT_PX = 61, 40
STRETCH_BY_NAME = {
    "linear": Stretch(StretchKind.LINEAR),
    "four times as bright": Stretch(StretchKind.LINEAR, boost=4.0, black=0.02),
    "asinh": Stretch(StretchKind.ASINH, boost=2.5, black=0.01),
}


def night(seed: int, width_px: int, height_px: int, dtype: type[np.unsignedinteger]) -> np.ndarray:
    """Return a dark sky with stars of every brightness, some saturated."""
    rng = np.random.default_rng(seed)
    white = np.iinfo(dtype).max
    sky = rng.normal(0.06, 0.02, (height_px, width_px))
    stars = rng.random(sky.shape) < 0.15
    return np.clip((sky + stars * rng.random(sky.shape) * 1.2) * white, 0, white).astype(dtype)


@pytest.fixture
def display(context: moderngl.Context) -> Iterator[Display]:
    display = Display(context)
    yield display
    display.close()


@pytest.fixture
def textures(context: moderngl.Context) -> Iterator[list[moderngl.Texture]]:
    """Return a list of textures to be released at the end."""
    textures: list[moderngl.Texture] = []
    yield textures
    for texture in textures:
        texture.release()


def shown_pixels(
    context: moderngl.Context,
    display: Display,
    textures: list[moderngl.Texture],
    simulated: np.ndarray,
    real: FittedImage | None,
    mode: ComparisonMode,
    stretch: Stretch,
    *,
    night: bool = False,
    **settings: float,
) -> np.ndarray:
    """Return what the window shows at 1:1, (height, width, 3)."""
    size = simulated.shape[1], simulated.shape[0]
    texture = context.texture(size, 1, simulated.tobytes(), dtype=f"u{simulated.itemsize}", alignment=1)
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    textures.append(texture)
    saturation_dn = settings.pop("saturation_dn", np.iinfo(simulated.dtype).max)
    shown = PanelContent(texture, int(saturation_dn), real, mode, **settings)
    view = ImageView()
    view.resize(*shown.size_px, *shown.size_px)
    assert view.zoom == 1.0
    display.draw(Picture.of(shown, view, stretch, shown.size_px, scale=1.0, night=night))
    return display.read()


def within_one_dn(window: np.ndarray, file: np.ndarray) -> bool:
    assert window.shape == file.shape
    return int(np.abs(window.astype(int) - file.astype(int)).max()) <= 1


@pytest.mark.parametrize("stretch", STRETCH_BY_NAME.values(), ids=STRETCH_BY_NAME)
@pytest.mark.parametrize("mode", ComparisonMode)
def test_the_window_shows_what_the_file_holds(
    context, display, textures, mode: ComparisonMode, stretch: Stretch
) -> None:
    simulated, real = (
        night(1, WIDTH_PX, HEIGHT_PX, np.uint8),
        fit(night(2, WIDTH_PX, HEIGHT_PX, np.uint8), WIDTH_PX, HEIGHT_PX),
    )

    for phase, wipe in ((0.2, 0.0), (0.7, 0.37), (0.5, 1.0)):
        window = shown_pixels(context, display, textures, simulated, real, mode, stretch, phase=phase, wipe=wipe)

        assert within_one_dn(window, compose(simulated, real, mode, stretch=stretch, phase=phase, wipe=wipe))


@pytest.mark.parametrize("mode", ComparisonMode)
def test_images_of_other_depths_and_sizes_are_compared(context, display, textures, mode: ComparisonMode) -> None:
    twelve_bits = night(3, WIDTH_PX, HEIGHT_PX, np.uint16) >> 4
    # Taller than the simulated one: it does not reach the left and right edges.
    real = fit(night(4, 70, 80, np.uint16), WIDTH_PX, HEIGHT_PX)
    assert 0 < real.left < real.right < WIDTH_PX
    settings = {"phase": 0.6, "wipe": 0.5, "saturation_dn": 4095, "real_black": 0.03, "real_gain": 1.7}

    window = shown_pixels(context, display, textures, twelve_bits, real, mode, STRETCH_BY_NAME["asinh"], **settings)

    assert within_one_dn(window, compose(twelve_bits, real, mode, stretch=STRETCH_BY_NAME["asinh"], **settings))


def test_the_current_real_image_is_shown(context, display, textures) -> None:
    simulated = night(5, WIDTH_PX, HEIGHT_PX, np.uint8)

    for seed, dtype in ((6, np.uint8), (7, np.uint8), (8, np.uint16), (6, np.uint8)):
        real = fit(night(seed, WIDTH_PX, HEIGHT_PX, dtype), WIDTH_PX, HEIGHT_PX)
        window = shown_pixels(
            context, display, textures, simulated, real, ComparisonMode.BLINK, STRETCH_BY_NAME["linear"], phase=0.5
        )

        assert within_one_dn(window, compose(simulated, real, ComparisonMode.BLINK, phase=0.5))


def test_without_a_real_image_the_simulated_one_is_shown(context, display, textures) -> None:
    simulated = night(9, WIDTH_PX, HEIGHT_PX, np.uint8)

    window = shown_pixels(
        context, display, textures, simulated, None, ComparisonMode.SIDE_BY_SIDE, STRETCH_BY_NAME["linear"]
    )

    assert within_one_dn(window, compose(simulated, None, ComparisonMode.OFF))


def test_at_night_a_difference_keeps_its_magnitude_but_not_its_sign(context, display, textures) -> None:
    simulated, real = (
        night(10, WIDTH_PX, HEIGHT_PX, np.uint8),
        fit(night(11, WIDTH_PX, HEIGHT_PX, np.uint8), WIDTH_PX, HEIGHT_PX),
    )
    by_day = compose(simulated, real, ComparisonMode.DIFFERENCE)

    window = shown_pixels(
        context, display, textures, simulated, real, ComparisonMode.DIFFERENCE, STRETCH_BY_NAME["linear"], night=True
    )

    assert within_one_dn(window[..., 0], by_day.max(axis=-1))
    assert not window[..., 1:].any()


def test_the_difference_vanishes_at_the_right_offset_of_the_clocks(renderer: GLRenderer, tmp_path: Path) -> None:
    # A "real" night: frames of the bundled flight, by a camera whose clock is 1.25 s ahead of the log's.
    config = Config()
    flight = config.open_flight(asset("adelaide.BIN"))
    simulator = config.simulator(flight)
    ahead_s = 1.25
    for start_s in (60.0, 63.0):
        exposure = Exposure(round(flight.attitude.first_s + start_s, 3), 0.25)
        frame = renderer.render(simulator.scene(exposure), seed=0)
        cv2.imwrite(str(tmp_path / f"{round((exposure.start_utc_s + ahead_s) * 1000)}.png"), frame.pixels)
    state = ComparisonState()
    state.mode, state.images = ComparisonMode.DIFFERENCE, RealImages.open(tmp_path)

    residual_dn = {}
    for offset_s in (0.0, ahead_s - 0.05, ahead_s, ahead_s + 0.05):
        state.offset_s = offset_s
        image = state.image_at(flight.attitude.first_s + 60.5)
        assert image is not None
        simulated = renderer.render(simulator.scene(state.exposure(image, Exposure(0.0, 0.25))), seed=0).pixels
        real = state.images.read(image, simulated.shape[1], simulated.shape[0])
        residual_dn[offset_s] = int(compose(simulated, real, ComparisonMode.DIFFERENCE).max())
    state.close()

    assert residual_dn[ahead_s] <= 1
    assert min(dn for offset_s, dn in residual_dn.items() if offset_s != ahead_s) > 10
