"""The image panel without a window: what mouse and free camera do, and where the picture is."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imgui_bundle import ImVec2

from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.content import WindowPlace
from glstar.viewer.ui.panels import image as imagepanel
from glstar.viewer.ui.panels import imagelayers
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.support.viewerdoubles import image_panel as panel
from tests.support.viewerdoubles import image_session as session
from tests.support.viewerdoubles import placed

# A picture of 100 x 80 px in a panel of 400 x 300 at (40, 60), magnified 3.75 times.
CORNER = np.array([40.0, 60.0])
CLIP = (40.0, 60.0, 440.0, 360.0)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, imagepanel, imagelayers)
    drawn.drag = ImVec2(0.0, 0.0)
    drawn.get_mouse_drag_delta = lambda *_: drawn.drag
    drawn.get_clip_rect_min = lambda: ImVec2(41.0, 62.0)
    drawn.get_clip_rect_max = lambda: ImVec2(439.0, 357.0)
    drawn.get_font = lambda: SimpleNamespace(is_glyph_in_font=lambda _: True)
    return drawn


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list of the positions at which a star is selected."""
    positions: list[Any] = []
    monkeypatch.setattr(imagepanel, "_select_star", lambda _s, _o, at: positions.append(at.tolist()))
    return positions


def test_the_wheel_zooms_at_the_mouse_and_a_drag_moves_the_image(drawn: ScriptedImgui, chosen: list[Any]) -> None:
    shown, made = session(), panel()
    drawn.mouse, drawn.io.mouse_wheel = ImVec2(140.0, 210.0), 2.0
    before = shown.view.to_picture([100.0, 150.0])
    made._take_mouse(shown, CORNER, hovered=False)
    assert shown.view.zoom == 3.75
    made._take_mouse(shown, CORNER, hovered=True)
    assert shown.view.zoom == pytest.approx(3.75 * 1.44)
    np.testing.assert_allclose(shown.view.to_picture([100.0, 150.0]), before, rtol=0, atol=1e-9)
    drawn.io.mouse_wheel, drawn.io.mouse_delta, drawn.pressed = 0.0, ImVec2(27.0, -5.4), {"active", "drag 0"}
    x, y = shown.view.centre_px
    made._take_mouse(shown, CORNER, hovered=True)
    assert shown.view.centre_px == pytest.approx((x - 5.0, y + 1.0))
    drawn.pressed = {"double 0"}
    assert not shown.view.fitted
    made._take_mouse(shown, CORNER, hovered=False)
    assert not shown.view.fitted
    made._take_mouse(shown, CORNER, hovered=True)
    assert (shown.view.fitted, chosen) == (True, [])


def test_a_click_without_a_drag_selects_the_star_there(drawn: ScriptedImgui, chosen: list[Any]) -> None:
    shown, made = session(), panel()
    drawn.mouse, drawn.pressed = ImVec2(277.5, 210.0), {"release 0", "deactivated"}
    made._take_mouse(shown, CORNER, hovered=False)
    assert chosen == []
    for drag, count in ((ImVec2(1.9, -1.9), 1), (ImVec2(2.0, 0.0), 1), (ImVec2(0.0, -2.0), 1), (ImVec2(0.5, 0.0), 2)):
        drawn.drag = drag
        made._take_mouse(shown, CORNER, hovered=True)
        assert len(chosen) == count
    # 37.5 screen px right of the middle of the panel, 10 px of the image, whose middle is at (49.5, 39.5).
    assert chosen[0] == pytest.approx([59.5, 39.5])
    # A held button that has moved far enough is a drag, too; without a button the mouse only moves.
    drawn.drag = ImVec2(9.0, 9.0)
    for pressed, dragged in (({"active"}, True), ({"deactivated"}, True), (set(), False)):
        drawn.pressed = pressed
        assert imagepanel._is_dragged() == dragged
    drawn.drag, drawn.pressed = ImVec2(0.0, 0.0), {"active"}
    assert not imagepanel._is_dragged()


@pytest.mark.parametrize(("x", "wipe"), [(45.0, 0.0), (90.0, 0.1), (440.0, 1.0)])
def test_the_line_of_a_wipe_is_dragged(drawn: ScriptedImgui, x: float, wipe: float) -> None:
    # The image, 375 px wide, begins 12.5 px from the panel's left edge at 40 px.
    drawn.mouse, drawn.pressed = ImVec2(x, 90.0), {"active", "drag 0"}
    drawn.io.mouse_delta = ImVec2(5.0, 5.0)
    for mode, active, moved in (
        (ComparisonMode.WIPE, True, True),
        (ComparisonMode.BLINK, True, False),
        (ComparisonMode.WIPE, False, False),
    ):
        shown = session()
        shown.comparison = SimpleNamespace(active=active, mode=mode, wipe=0.5)
        panel()._take_mouse(shown, CORNER, hovered=True)
        assert shown.comparison.wipe == (pytest.approx(wipe) if moved else 0.5)
        assert shown.view.fitted == moved


def test_the_free_camera_is_turned_zoomed_and_pointed(drawn: ScriptedImgui, chosen: list[Any]) -> None:
    shown, made = session(is_looking=True), panel()
    shown.view.zoom_at([3.0, 4.0], 2.0)
    drawn.mouse, drawn.io.mouse_wheel = ImVec2(277.5, 210.0), -1.0
    drawn.pressed, drawn.activated = {"active", "drag 0"}, True

    def done(hovered: bool) -> list[Any]:
        shown.look.done = []
        made._take_mouse(shown, CORNER, hovered=hovered)
        return [(name, *np.ravel(what[0] if name == "look_at" else what).tolist()) for name, *what in shown.look.done]

    made._take_mouse(shown, CORNER, hovered=False)
    assert shown.view.fitted
    shown.view.resize(100, 80, 400.0, 300.0)
    at = (pytest.approx(59.5), pytest.approx(39.5))
    assert done(hovered=True) == [("zoom", pytest.approx(1 / 1.2)), ("drag", *at), ("grab", *at)]
    assert done(hovered=False) == [("drag", *at), ("grab", *at)]
    drawn.pressed, drawn.activated = {"double 0"}, False
    assert [name for name, *_ in done(hovered=True)] == ["zoom", "look_at"]
    assert done(hovered=True)[1] == ("look_at", *at)
    drawn.pressed = {"release 0"}
    assert (done(hovered=False), chosen) == ([], [])
    done(hovered=True)
    assert chosen == [list(at)]
    shown.scene, drawn.pressed = None, {"double 0"}
    assert [name for name, *_ in done(hovered=True)] == ["zoom"]


def test_the_texture_is_put_where_the_picture_is(drawn: ScriptedImgui) -> None:
    edges = np.array([[12.4, -30.0], [387.6, 290.2]])
    imagepanel._put(drawn, 7, edges, CORNER, (400, 300))
    ((_, low, high, uv, uv_to),) = drawn.named("add_image")
    assert (low, high) == ((52.0, 60.0), (428.0, 351.0))
    assert (uv, uv_to) == (pytest.approx((0.03, 0.0)), pytest.approx((0.97, 0.97)))
    for beside in ([[400.0, 0.0], [500.0, 100.0]], [[0.0, 310.0], [10.0, 320.0]], [[-9.0, 0.0], [-1.0, 9.0]]):
        imagepanel._put(drawn, 7, np.array(beside), CORNER, (400, 300))
    assert len(drawn.named("add_image")) == 1
    # The visible part, px of the framebuffer from the window's corner.
    assert imagepanel._visible(edges, CORNER, (400.0, 300.0)) == ((52, 60, 376, 290), (40, 60))
    lower = np.array([[12.0, 100.0], [387.0, 170.0]])
    assert imagepanel._visible(lower, CORNER, (400.0, 300.0)) == ((52, 160, 375, 70), (40, 60))
    assert imagepanel._visible(np.array([[400.0, 0.0], [500.0, 90.0]]), CORNER, (400.0, 300.0)) is None
    assert imagepanel._visible(np.array([[0.0, 300.0], [50.0, 390.0]]), CORNER, (400.0, 300.0)) is None
    assert imagepanel._place(CORNER, 2.0) == WindowPlace((80, 120), (82, 124, 878, 714))
    assert imagepanel._place(CORNER + 0.25, 2.0) is None
    assert imagepanel._place(CORNER + 0.5, 2.0) == WindowPlace((81, 121), (82, 124, 878, 714))
    made = panel()
    assert made.plain_picture() is None
    made._visible = (52, 65, 30, 20), (40, 60)
    made._picture.read = lambda: np.arange(300 * 400).reshape(300, 400)
    assert made.plain_picture().tolist() == made._picture.read()[5:25, 12:42].tolist()
    assert (made.visible_px, made.new_picture_px) == ((52, 65, 30, 20), None)
    made._picture.is_new, made._panel_px = True, (1, 2, 3, 4)
    assert made.new_picture_px == (1, 2, 3, 4)


def test_without_an_image_a_message_is_in_the_middle(drawn: ScriptedImgui) -> None:
    shown, made = session(shown=None), panel()
    made._visible = "before"
    for path, status, text in (
        (None, "", "drop a flight log here"),
        (Path("a/night.bin"), "", "reading night.bin ..."),
        (None, "no UTC", "no UTC"),
    ):
        shown.loader.path, shown.status = path, status
        made.draw(shown)
        ((_, size, at, colour, written, wrap_px),) = drawn.named("add_text")
        assert (written, colour, wrap_px, size) == (text, "text_disabled", 380.0, 10.0)
        assert at == (40 + (400 - 8 * len(text)) / 2, 60 + (300 - 10) / 2)
        assert made.visible_px is None
        drawn.take()
    drawn.available = ImVec2(0.3, 0.2)
    made.draw(shown)
    assert drawn.named("add_text")[0][5] == 1.0


def test_a_message_is_over_the_top_of_the_image(drawn: ScriptedImgui) -> None:
    imagepanel._banner(drawn, "bright twilight", CLIP)
    ((low, high, colour, rounding),) = drawn.named("add_rect_filled")
    assert (low, high) == ((50.0, 70.0), (50 + 15 * 8 + 20, 70 + 10 + 10))
    assert (colour, rounding) == (("popup_bg", 0.85), 4.0)
    assert drawn.named("set_cursor_screen_pos") == [[(60.0, 75.0)]]
    # The text wraps 40 px before the panel's width of 400 px, from the cursor on.
    assert drawn.named("push_text_wrap_pos") == [[40.0 + 360.0]]
    assert drawn.lines == ["bright twilight [unsaved_marker]"]


def test_the_free_camera_has_its_direction_and_the_border_of_the_aircraft_s_image(drawn: ScriptedImgui) -> None:
    outline = np.array(
        [[10.0, 20.0], [30.0, 20.0], [np.nan, 1.0], [50.0, 60.0], [50.0, 1e6], [70.0, 60.0], [90.0, 60.0]]
    )
    shown = session(is_looking=True, loaded=SimpleNamespace(simulator="aircraft's"))
    shown.look = SimpleNamespace(
        label="looking", outline_px=lambda *what: outline if what == ("aircraft's", "scene") else 0
    )
    imagepanel._draw_look(shown, drawn, CORNER, CLIP)
    screen = placed().to_screen(outline) + CORNER
    lines = [(low, high) for low, high, *_ in drawn.named("add_line")]
    expected = [(screen[0], screen[1]), (screen[5], screen[6])]
    np.testing.assert_allclose(lines, expected, rtol=0, atol=1e-3)
    assert drawn.named("push_clip_rect") == [[CLIP[:2], CLIP[2:], True]]
    texts = drawn.named("add_text")
    assert texts[-1] == [(50.0, 360.0 - 10 - 10), "text_link", "looking   Tab: the aircraft's camera"]
    drawn.take()
    for lacking in ({"scene": None}, {"loaded": None}):
        imagepanel._draw_look(SimpleNamespace(**vars(shown) | lacking), drawn, CORNER, CLIP)
        assert drawn.calls == []


@pytest.mark.parametrize(("zoom", "within_px"), [(0.5, 16.0), (2.0, 4.0), (3.75, 4.0)])
def test_the_star_within_eight_pixels_of_the_mouse_is_selected(
    monkeypatch: pytest.MonkeyPatch, zoom: float, within_px: float
) -> None:
    asked, selected, star = [], [], SimpleNamespace(star_id=17)
    monkeypatch.setattr(
        imagepanel, "star_at", lambda scene, *at, within_px: asked.append((scene, *at, within_px)) or star
    )
    monkeypatch.setattr(imagepanel, "select_object", lambda _s, _o, target: selected.append(target))
    search = SimpleNamespace(star=lambda star_id: f"star {star_id}")
    selection = SimpleNamespace(search=lambda catalogue: search if catalogue == "stars" else None)
    catalogue = SimpleNamespace(sky=SimpleNamespace(catalogue="stars"))
    shown = session(loaded=SimpleNamespace(simulator=catalogue), view=SimpleNamespace(zoom=zoom))
    imagepanel._select_star(shown, selection, np.array([3.0, 4.0]))
    assert (asked, selected) == ([("scene", 3.0, 4.0, within_px)], ["star 17"])
    monkeypatch.setattr(imagepanel, "star_at", lambda *_, **__: None)
    imagepanel._select_star(shown, selection, np.array([3.0, 4.0]))
    assert selected[1:] == [None]
    for lacking in ({"scene": None}, {"loaded": None}):
        imagepanel._select_star(SimpleNamespace(**vars(shown) | lacking), selection, np.zeros(2))
    assert len(selected) == 2
