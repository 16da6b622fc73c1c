"""The overlays, painted by imgui on a context without a window."""

from collections.abc import Iterator

import moderngl
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.viewer.overlays.canvas import Labels, Lines, Mark, Marks, Shapes
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.ui.panels.imagelayers import draw_shapes, overlay_colour

WIDTH, HEIGHT = 200, 150


@pytest.fixture
def paint(context: moderngl.Context) -> Iterator:
    """Paint shapes over black and return the picture, (height, width, 3) uint8, row 0 at the top."""
    texture = context.texture((WIDTH, HEIGHT), 4)
    picture = context.framebuffer([texture])
    imgui.create_context()
    io = imgui.get_io()
    io.set_ini_filename("")
    io.display_size = imgui.ImVec2(WIDTH, HEIGHT)
    io.delta_time = 1 / 60
    imgui.backends.opengl3_init("#version 330")

    def painted(shapes, to_screen=lambda xy: xy, clip=(0.0, 0.0, float(WIDTH), float(HEIGHT)), **options):
        imgui.backends.opengl3_new_frame()
        imgui.new_frame()
        draw_shapes(imgui.get_background_draw_list(), shapes, to_screen, clip, **options)
        imgui.render()
        picture.use()
        picture.clear(0.0, 0.0, 0.0, 1.0)
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())
        return np.frombuffer(picture.read(components=3), np.uint8).reshape(HEIGHT, WIDTH, 3)[::-1]

    yield painted
    imgui.backends.opengl3_shutdown()
    imgui.destroy_context()
    picture.release()
    texture.release()


def points(*xy):
    return np.array(xy, dtype=np.float32)


def two_lines(overlay=Overlay.HORIZON):
    return Lines(overlay, points((20, 30), (80, 30), (150, 30), (40, 60), (40, 140)), np.array([0, 3]))


def lit(picture):
    return picture.max(axis=2) > 40


def test_polylines_are_painted_separately(paint):
    picture = lit(paint(Shapes(lines=(two_lines(),))))
    assert picture[29:32, 25:145].any(axis=0).all()
    assert picture[65:135, 39:42].any(axis=1).all()
    # No line connects the end of the first to the start of the second.
    assert not picture[34:58].any()


def test_a_line_has_the_colour_of_its_overlay(paint):
    picture = paint(Shapes(lines=(two_lines(Overlay.AXIS),)))
    red, green, blue, _ = overlay_colour(Overlay.AXIS)
    brightest = picture[28:33, 100].max(axis=0).astype(float)
    assert brightest / brightest.max() == pytest.approx(np.array([red, green, blue]) / red, abs=0.03)


def test_shapes_are_drawn_at_the_position_of_the_panel(paint):
    picture = lit(paint(Shapes(lines=(two_lines(),)), to_screen=lambda xy: xy / 2 + [50.0, 40.0]))
    assert picture[54:57, 65:120].any(axis=0).all()
    assert not picture[:50].any()


def test_nothing_is_painted_outside_the_panel(paint):
    labels = Labels(Overlay.STAR_NAMES, ("Canopus",), points((95, 75)), points((0.0, 0.5)))
    marks = Marks(Overlay.CENTROIDS, Mark.CROSS, points((100, 100)))
    picture = lit(paint(Shapes((two_lines(),), (labels,), (marks,)), clip=(30.0, 20.0, 100.0, 100.0)))
    assert picture[20:100, 30:100].any()
    picture[20:100, 30:100] = False
    assert not picture.any()


def test_a_name_is_beside_its_star(paint):
    for anchor, column, row in (((0.0, 0.5), 1, 0), ((1.0, 0.5), -1, 0), ((0.5, 0.0), 0, 1), ((0.5, 1.0), 0, -1)):
        labels = Labels(Overlay.STAR_NAMES, ("Sirius",), points((100, 75)), points(anchor))
        rows, columns = np.nonzero(lit(paint(Shapes(labels=(labels,)))))
        assert rows.size > 20
        if column:
            assert ((columns - 100) * column).min() >= 4
            assert abs(rows.mean() - 75) < 4
        else:
            assert ((rows - 75) * row).min() >= 4
            assert abs(columns.mean() - 100) < 4


def test_a_name_keeps_clear_of_a_magnified_star(paint):
    labels = Labels(Overlay.STAR_NAMES, ("Sirius",), points((10, 7)), points((0.0, 0.5)), clear_px=2.5)
    _, columns = np.nonzero(lit(paint(Shapes(labels=(labels,)), to_screen=lambda xy: 10 * xy)))
    assert 100 + 25 + 4 <= columns.min() <= 100 + 25 + 10


def test_a_superscript_missing_from_the_font_becomes_a_digit(paint):
    pictures = [
        paint(Shapes(labels=(Labels(Overlay.STAR_NAMES, (text,), points((50, 75)), points((0.0, 0.5))),)))
        for text in ("51\u2074", "514")
    ]
    assert lit(pictures[0]).any()
    np.testing.assert_array_equal(*pictures)


def test_letters_have_a_dark_edge_that_separates_them_from_a_bright_star(paint):
    sky = Lines(Overlay.STAR_NAMES, points(*((x, y) for y in range(60, 90) for x in (20, 180))), np.arange(0, 60, 2))
    labels = Labels(Overlay.STAR_NAMES, ("Sirius",), points((60, 75)), points((0.0, 0.5)))
    bare = paint(Shapes(lines=(sky,))).astype(int)
    named = paint(Shapes(lines=(sky,), labels=(labels,))).astype(int)
    assert bare[70:80, 70:110].min() > 100
    assert named[70:80, 66:110].min() < 0.5 * bare[70:80, 66:110].min()


@pytest.mark.parametrize("mark", list(Mark))
def test_every_mark_is_drawn_around_its_position(paint, mark):
    rows, columns = np.nonzero(lit(paint(Shapes(marks=(Marks(Overlay.CENTROIDS, mark, points((100.5, 75.5))),)))))
    assert rows.size > 4
    assert rows.mean() == pytest.approx(75, abs=1)
    assert columns.mean() == pytest.approx(100, abs=1)


def test_a_saturated_pixel_is_framed_at_its_size_on_the_screen(paint):
    marks = Marks(Overlay.SATURATED, Mark.PIXEL, points((10, 7)))
    rows, columns = np.nonzero(lit(paint(Shapes(marks=(marks,)), to_screen=lambda xy: 10 * xy)))
    assert (columns.min(), columns.max()) == (95, 104)
    assert (rows.min(), rows.max()) == (65, 74)


def test_saturated_neighbours_share_a_frame_and_others_do_not(paint):
    marks = Marks(Overlay.SATURATED, Mark.PIXEL, points((3, 7), (4, 7), (5, 7), (9, 7), (4, 9)))
    picture = lit(paint(Shapes(marks=(marks,)), to_screen=lambda xy: 10 * xy))
    for left, right, top, bottom in ((25, 55, 65, 75), (85, 95, 65, 75), (35, 45, 85, 95)):
        assert picture[top, left + 1 : right - 1].all()
        assert not picture[top + 3 : bottom - 3, left + 3 : right - 3].any()
    assert not picture[68:72, 58:82].any()


@pytest.mark.parametrize("overlay", list(Overlay))
def test_at_night_all_overlays_are_red(paint, overlay):
    labels = Labels(overlay, ("Canopus",), points((95, 75)), points((0.0, 0.5)))
    marks = tuple(Marks(overlay, mark, points((100, 100))) for mark in Mark)
    picture = paint(Shapes((two_lines(overlay),), (labels,), marks), night=True)
    assert picture[..., 0].max() > 20
    assert picture[..., 1:].max() == 0
    label = paint(Shapes(labels=(labels,)), night=True)
    assert label[..., 0].max() > 170  # it can be read


def test_the_overlays_differ_in_colour():
    colours = np.array([overlay_colour(overlay)[:3] for overlay in Overlay], dtype=float)
    difference = np.linalg.norm(colours[:, np.newaxis] - colours, axis=2)
    assert difference[~np.eye(len(colours), dtype=bool)].min() > 60
