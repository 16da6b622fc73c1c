"""The display pass, against the same picture composed in NumPy."""

from collections.abc import Iterator

import moderngl
import numpy as np
import pytest

from glstar.images import FittedImage
from glstar.render.opengl.context import headless_context
from glstar.viewer.picture.comparison import ComparisonMode, compose
from glstar.viewer.picture.content import Display, PanelContent, Picture
from glstar.viewer.picture.view import ImageView, Stretch, StretchKind

RNG = np.random.default_rng(5)
SIMULATED = RNG.integers(0, 256, (38, 50)).astype(np.uint8)
REAL = FittedImage(RNG.integers(0, 65536, (38, 50)).astype(np.uint16), 5, 3, 46, 37)
LINEAR = Stretch(StretchKind.LINEAR)
ASINH = Stretch(StretchKind.ASINH, boost=4.0, black=0.06)


@pytest.fixture
def context() -> Iterator[moderngl.Context]:
    context = headless_context()
    with context:
        yield context
        assert context.error == "GL_NO_ERROR"
    context.release()


@pytest.fixture
def display(context: moderngl.Context) -> Iterator[Display]:
    display = Display(context)
    yield display
    display.close()


def shown(context: moderngl.Context, pixels=SIMULATED, **keys) -> PanelContent:
    size, dtype = pixels.shape[::-1], f"u{pixels.itemsize}"
    return PanelContent(context.texture(size, 1, pixels, dtype=dtype, alignment=1), np.iinfo(pixels.dtype).max, **keys)


def drawn(
    display: Display, what: PanelContent, stretch: Stretch, zoom: float = 1.0, *, night: bool = False
) -> np.ndarray:
    width, height = what.size_px
    size = round(width * zoom), round(height * zoom)
    view = ImageView()
    view.resize(width, height, *size)
    view.zoom_at(view.middle, zoom / view.zoom)
    display.draw(Picture.of(what, view, stretch, size, scale=1.0, night=night))
    picture = display.read().astype(int)
    what.image.release()
    return picture


@pytest.mark.parametrize("stretch", [LINEAR, ASINH], ids=["linear", "asinh"])
def test_at_1_to_1_the_screen_equals_the_composition_of_numpy(context, display, stretch):
    expected = compose(SIMULATED, None, ComparisonMode.OFF, stretch=stretch).astype(int)
    assert np.abs(drawn(display, shown(context), stretch) - expected).max() <= 1


@pytest.mark.parametrize("stretch", [LINEAR, ASINH], ids=["linear", "asinh"])
@pytest.mark.parametrize(
    ("mode", "keys"),
    [
        (ComparisonMode.BLINK, {"phase": 0.2}),
        (ComparisonMode.BLINK, {"phase": 0.7}),
        (ComparisonMode.WIPE, {"wipe": 0.3}),
        (ComparisonMode.DIFFERENCE, {}),
        (ComparisonMode.SIDE_BY_SIDE, {}),
    ],
)
def test_a_comparison_on_the_screen_is_the_one_that_is_saved(context, display, mode, keys, stretch):
    levels = {"real_black": 0.1, "real_gain": 1.5}
    expected = compose(SIMULATED, REAL, mode, stretch=stretch, **keys, **levels).astype(int)
    what = shown(context, real=REAL, comparison=mode, **keys, **levels)
    assert np.abs(drawn(display, what, stretch) - expected).max() <= 1


def test_sixteen_bits_are_scaled_by_their_white(context, display):
    pixels = RNG.integers(0, 65536, (20, 30)).astype(np.uint16)
    expected = np.rint(pixels / 257.0)[..., np.newaxis]
    assert np.abs(drawn(display, shown(context, pixels), LINEAR) - expected).max() <= 1


@pytest.mark.parametrize("zoom", [0.6, 0.5, 0.3, 0.1])
def test_a_faint_star_keeps_its_flux_when_the_picture_is_shrunk(context, display, zoom):
    """At a tenth of the size, sampling would lose nine stars in ten; averaging keeps the picture's mean."""
    pixels = np.zeros((400, 600), np.uint8)
    pixels[RNG.integers(60, 340, 300), RNG.integers(60, 540, 300)] = 255
    bright = Stretch(StretchKind.LINEAR, boost=1.0)
    picture = drawn(display, shown(context, pixels), bright, zoom)
    assert picture.mean() == pytest.approx(pixels.mean(), abs=0.5 + 0.02 * pixels.mean())
    if zoom == 0.5:
        expected = pixels.reshape(200, 2, 300, 2).mean(axis=(1, 3))
        assert np.abs(picture[..., 0] - expected).max() <= 1


def test_a_magnified_pixel_is_a_square(context, display):
    picture = drawn(display, shown(context), LINEAR, 4.0)[..., 0]
    assert np.abs(picture - np.kron(SIMULATED, np.ones((4, 4), int))).max() <= 1


def test_at_night_only_red_is_shown(context, display):
    picture = drawn(display, shown(context), LINEAR, night=True)
    assert np.abs(picture[..., 0] - SIMULATED).max() <= 1
    assert not picture[..., 1:].any()


def test_the_area_around_the_picture_is_empty(context, display):
    view = ImageView()
    view.resize(50, 38, 100, 100)
    view.zoom_at([50, 50], 1 / view.zoom)
    what = shown(context)
    display.draw(Picture.of(what, view, LINEAR, (100, 100), scale=1.0, night=False))
    picture = display.read()
    what.image.release()
    assert picture[:30].max() < 16
    np.testing.assert_array_equal(picture[31:69, 25:75, 0], SIMULATED)


def test_all_opengl_objects_are_released(context, monkeypatch):
    made = []
    for maker in ("program", "vertex_array", "texture", "framebuffer"):
        make = getattr(context, maker)

        def noted(*args, _make=make, **keys):
            made.append(_make(*args, **keys))
            return made[-1]

        monkeypatch.setattr(context, maker, noted, raising=False)
    display = Display(context)
    for zoom in (0.3, 0.7, 2.0):
        drawn(display, shown(context), LINEAR, zoom)
        drawn(display, shown(context, real=REAL, comparison=ComparisonMode.WIPE), LINEAR, zoom)
    display.close()
    display.close()
    assert len(made) > 12
    assert all(isinstance(resource.mglo, moderngl.mgl.InvalidObject) for resource in made)
