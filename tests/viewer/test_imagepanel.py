"""The image panel: the position of each pixel, and the line of a wipe under the cursor."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui
from numpy.typing import NDArray

from glstar.camera.camerafile import camera_to_yaml
from glstar.viewer.loop import Viewer
from glstar.viewer.picture.comparison import ComparisonMode, compose
from glstar.viewer.picture.view import Stretch, StretchKind
from tests.support.windowinput import press, screen

WINDOW_PX = (900, 600)
WIDTH_PX, HEIGHT_PX = 254, 190


@pytest.fixture
def bare(viewer: Viewer) -> Viewer:
    """Show the image in the complete window, without overlays; noise makes its pixels distinguishable."""
    session = viewer.session
    session.change(**{"sensor.sky_mean_dn": 120.0, "sensor.sky_std_dn": 30.0})
    session.stretch = Stretch(StretchKind.LINEAR)
    session.shown_overlays = set()
    press(viewer, "H")
    return viewer


def window(viewer: Viewer) -> NDArray[np.int_]:
    """Return the current pixels of the window, top row first."""
    viewer.frame(0.0)
    return screen(viewer)[::-1].astype(int)


def expected(viewer: Viewer, picture: NDArray[np.uint8]) -> NDArray[np.int_]:
    """Return the picture's pixel under each pixel of the window; -1 around the picture."""
    places = viewer.session.view.to_picture(np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in WINDOW_PX)), axis=-1))
    columns, rows = np.floor(places + 0.5).astype(int).transpose(2, 0, 1)
    height, width = picture.shape[:2]
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    found = picture[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(int)
    return np.where(inside[..., np.newaxis], found, -1)


def check(viewer: Viewer, picture: NDArray[np.uint8]) -> None:
    shown, wanted = window(viewer), expected(viewer, picture)
    inside = wanted[..., 0] >= 0
    assert 10_000 < inside.sum() < inside.size
    np.testing.assert_allclose(shown[inside], wanted[inside], rtol=0, atol=1)
    # Around the picture the window has its background colour.
    around = shown[~inside]
    assert np.ptp(around, axis=0).max() <= 1


@pytest.mark.parametrize(
    "look",
    [
        lambda view: None,
        lambda view: view.zoom_at(view.middle, 2.0),
        lambda view: view.pan(-350.0, -240.0),
        lambda view: view.pan(350.0, 240.0),
    ],
    ids=["one to one", "magnified", "cut off left and above", "cut off right and below"],
)
def test_each_pixel_of_the_picture_is_drawn_at_the_position_of_the_view(
    bare: Viewer, look: Callable[..., None]
) -> None:
    session = bare.session
    press(bare, "1")
    look(session.view)
    bare.frame(0.0)
    check(bare, compose(session.image.pixels, None, ComparisonMode.OFF, stretch=session.stretch))


@pytest.fixture
def wiping(bare: Viewer, tmp_path: Path) -> Viewer:
    folder = tmp_path / "real"
    folder.mkdir()
    noise = np.random.default_rng(3).integers(0, 255, (HEIGHT_PX, WIDTH_PX)).astype(np.uint8)
    cv2.imwrite(str(folder / "20240310_110000.png"), noise)
    session = bare.session
    session.comparison.mode = ComparisonMode.WIPE
    session.open(folder)
    for _ in range(10_000):
        bare.frame(0.0)
        if session.real is not None:
            return bare
    pytest.fail("the real image is not decoded")


@pytest.mark.parametrize("zoom", [1.0, 2.0])
@pytest.mark.parametrize("column", [0, 100, WIDTH_PX])
def test_the_line_of_a_wipe_is_dragged_to_the_cursor(wiping: Viewer, column: int, zoom: float) -> None:
    session = wiping.session
    press(wiping, "1")
    session.view.zoom_at(session.view.middle, zoom)
    # The cursor goes to the left edge of a column.
    x, y = session.view.to_screen([column - 0.5, 90.0])
    io = imgui.get_io()
    io.add_mouse_pos_event(x + 40.0, y)
    wiping.frame(0.0)
    io.add_mouse_button_event(0, True)
    wiping.frame(0.0)
    io.add_mouse_pos_event(x, y)
    wiping.frame(0.0)
    wiping.frame(0.0)
    io.add_mouse_button_event(0, False)
    wiping.frame(0.0)
    io.add_mouse_pos_event(-1.0, -1.0)

    assert session.comparison.wipe == pytest.approx(column / WIDTH_PX, abs=1e-6)
    real = session.real[1].pixels
    picture = np.where(np.arange(WIDTH_PX) < column, session.image.pixels, real)
    check(wiping, compose(picture, None, ComparisonMode.OFF, stretch=session.stretch))


def test_the_sides_of_a_comparison_are_labelled_unless_all_is_hidden(wiping: Viewer) -> None:
    session = wiping.session
    session.comparison.wipe = 0.5
    hidden = window(wiping)
    press(wiping, "H")
    session.view.fit()
    shown = window(wiping)
    (left, top), (right, _) = session.view.to_screen([[0, 0], [WIDTH_PX - 1, 0]])
    # The labels' backgrounds are the darkest pixels of a bright sky: one at the left of each side.
    band = shown.sum(axis=-1)[int(top) + 45 : int(top) + 75]
    dark = np.flatnonzero((band < 120).any(axis=0))
    assert hidden.shape == shown.shape
    assert (dark < (left + right) / 2).sum() > 20
    assert (dark > (left + right) / 2).sum() > 10


def test_a_dropped_camera_file_is_the_camera(viewer: Viewer, tmp_path) -> None:
    camera = viewer.session.config.camera()
    file = tmp_path / "lens.yaml"
    file.write_text(camera_to_yaml(camera).replace("242.0", "300.0"), encoding="utf-8")
    viewer.session.open(file)
    assert viewer.session.config.camera().fx_px == 300.0
    (tmp_path / "broken.yaml").write_text("image_width: many\n", encoding="utf-8")
    viewer.session.open(tmp_path / "broken.yaml")
    assert viewer.session.config.camera().fx_px == 300.0
    assert any("broken.yaml" in each for each in viewer.session.notifications.errors)
