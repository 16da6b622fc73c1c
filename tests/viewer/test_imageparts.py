"""The image panel without a window: readout, parts of a frame, overlays, and the mark of the selected object."""

from math import radians
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imgui_bundle import ImVec2

from glstar.viewer.overlays.curves import ImageRegion
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.content import WindowPlace
from glstar.viewer.skyobjects import ObjectPlace
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


STAR = {"catalogue": "bsc5", "star_id": 2491, "name": "Sirius", "vmag": -1.456}
STAR |= {"altitude_rad": radians(12.345), "azimuth_rad": radians(234.567)}


def test_the_readout_has_pixel_electrons_and_star(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    star = SimpleNamespace(**STAR)
    monkeypatch.setattr(imagepanel, "star_at", lambda *what, within_px: asked.append((*what[1:], within_px)) or star)
    electrons = SimpleNamespace(pixel_electrons=lambda dn: (2 * dn + 0.25, 12.34))
    scene = SimpleNamespace(
        camera=SimpleNamespace(width_px=100, height_px=80), sensor=SimpleNamespace(electrons=electrons)
    )
    real = "image", SimpleNamespace(pixels=np.full((80, 100), 33, np.uint8))
    shown = session(scene=scene, real=real)
    imagepanel._draw_readout(shown, np.array([12.345, 6.789]))
    assert drawn.take() == [
        *("x 12.3  y 6.8   712 DN", "1424.2 e   SNR 12.3", "real 33 DN", "Sirius [text_link]", "HR 2491   V -1.46"),
        "altitude 12.35 deg   azimuth 234.57 deg",
    ]
    assert asked == [(12.345, 6.789, 4.0)]
    star.name, shown.real, scene.sensor.electrons = "", None, None
    imagepanel._draw_readout(shown, np.array([98.6, 79.4]))
    assert drawn.take()[:3] == ["x 98.6  y 79.4   7999 DN", "HR 2491 [text_link]", "V -1.46"]
    monkeypatch.setattr(imagepanel, "star_at", lambda *_, **__: None)
    imagepanel._draw_readout(shown, np.array([0.4, -0.4]))
    assert drawn.take() == ["x 0.4  y -0.4   0 DN"]
    # Outside of the image, without one, and where there can be no tooltip, nothing is read.
    for at in ([-0.6, 5.0], [99.6, 5.0], [5.0, -0.6], [5.0, 79.6]):
        imagepanel._draw_readout(shown, np.array(at))
    for lacking in ({"scene": None}, {"image": SimpleNamespace(pixels=None)}):
        imagepanel._draw_readout(SimpleNamespace(**vars(shown) | lacking), np.array([5.0, 5.0]))
    drawn.closed = {"begin_tooltip"}
    imagepanel._draw_readout(shown, np.array([5.0, 5.0]))
    assert drawn.take() == []


@pytest.fixture
def frame(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list of what the panel draws by other functions, in their order."""
    parts: list[Any] = []
    for name in ("draw_comparison_labels", "draw_pixel_grid", "_draw_look", "_draw_readout", "_banner"):
        monkeypatch.setattr(imagepanel, name, lambda *what, name=name: parts.append((name, *what[1:])))
    monkeypatch.setattr(imagepanel.Picture, "of", lambda *what, scale, night: ("picture", what[3], scale, night))
    return parts


def full_session(**changes: Any) -> SimpleNamespace:
    shown = session(loaded=None, scene=None, **changes)
    shown.image.number, shown.stretch, shown.view.pixel_grid = 5, "stretch", False
    shown.shown = SimpleNamespace(size_px=(100, 80), mode="", is_processed=True, real=None, wipe=0.25)
    return shown


def test_a_frame_has_its_parts_in_order(drawn: ScriptedImgui, frame: list[Any]) -> None:
    shown, made = full_session(), panel()
    made.draw(shown)
    assert made._panel_px == (40, 60, 440, 360)
    # From 52.5 to 427.5 px across.
    assert made.visible_px == (52, 60, 376, 300)
    assert drawn.named("invisible_button")[0][1] == (400.0, 300.0)
    assert shown.look.done == [("resize", 400.0, 300.0)]
    ((picture, inputs, place),) = made.shows
    assert picture == ("picture", (400, 300), 1.0, False)
    assert inputs == (None, 5, "stretch", True, False, (400, 300), (3.75, 49.5, 39.5), ())
    assert place is None
    assert len(drawn.named("add_image")) == 1
    assert [name for name, *_ in frame] == ["draw_comparison_labels"]
    # As the lowest part of the window, with a real image, at two px a unit; the picture is then drawn elsewhere.
    frame.clear()
    drawn.take()
    drawn.io.display_framebuffer_scale = ImVec2(2.0, 2.0)
    made.texture = None
    shown.shown.mode, shown.shown.real, shown.night = "wipe", "real", True
    shown.shown.real_black, shown.shown.real_gain = 0.125, 3.0
    made.draw(shown, labelled=False, is_lowest=True)
    assert made._panel_px == (80, 120, 880, 720)
    assert made.visible_px == (105, 120, 750, 600)
    picture, inputs, place = made.shows[-1]
    assert picture == ("picture", (800, 600), 2.0, True)
    assert inputs[5:] == ((800, 600), (3.75, 49.5, 39.5), ("real", "wipe", 0.25, 0.125, 3.0))
    assert place == WindowPlace((80, 120), (82, 124, 878, 714))
    assert (drawn.named("add_image"), frame) == ([], [])
    assert shown.look.done[-1] == ("resize", 800.0, 600.0)


def test_a_frame_shows_grid_veil_readout_and_messages_where_they_apply(drawn: ScriptedImgui, frame: list[Any]) -> None:
    shown, made = full_session(), panel()
    shown.view.pixel_grid, shown.stale_s, shown.status = True, 2.0, "no link"
    shown.conditions = SimpleNamespace(viewing=SimpleNamespace(warning="twilight"))
    drawn.hovered, drawn.mouse = True, ImVec2(277.5, 210.0)
    made.draw(shown)
    names = [name for name, *_ in frame]
    assert names == ["draw_comparison_labels", "draw_pixel_grid", "_draw_readout", "_banner"]
    assert frame[-1][1:] == ("no link\ntwilight", CLIP)
    assert frame[2][1].tolist() == pytest.approx([59.5, 39.5])
    ((low, high, colour),) = drawn.named("add_rect_filled")
    assert (low, high, colour) == (CLIP[:2], CLIP[2:], (0.45, 0.46, 0.48, 0.55))
    for change in ({"is_playing": True}, {"hovered": False}, {"active": True}, {"has_readout": False}):
        frame.clear()
        shown.is_playing = change.get("is_playing", False)
        drawn.hovered = change.get("hovered", True)
        drawn.pressed = {"active"} if "active" in change else set()
        made.has_readout = change.get("has_readout", True)
        made.draw(shown)
        assert "_draw_readout" not in [name for name, *_ in frame]
    shown.status, shown.conditions = "", None
    frame.clear()
    made.draw(shown)
    assert "_banner" not in [name for name, *_ in frame]


def test_overlays_leave_room_for_the_selected_name_and_the_free_camera_s_line(
    drawn: ScriptedImgui, frame: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    drawn.pressed = set()
    monkeypatch.setattr(imagepanel, "residuals_of", lambda _: "why not")
    monkeypatch.setattr(
        imagepanel,
        "draw_shapes",
        lambda _, shapes, to_screen, clip, night: asked.append(
            (shapes, to_screen([[49.5, 39.5]]).tolist(), clip, night)
        ),
    )

    def shapes(scene: Any, overlays: Any, **what: Any) -> str:
        asked.append(what)
        return "shapes"

    camera = SimpleNamespace(width_px=100, height_px=80)
    shown, made = full_session(), panel()
    shown.scene, shown.name_vmag_limit = SimpleNamespace(camera=camera), 4.5
    shown.loaded = SimpleNamespace(overlays=SimpleNamespace(shapes=shapes))
    shown.navigator = SimpleNamespace(beliefs=lambda *what: what)
    shown.image.tested = "tested"
    where = ObjectPlace(0.5, 0.0, 49.5, 39.5, on_image=True, right=1.0, down=0.0, from_axis_rad=0.1)
    made._selection = SimpleNamespace(selected=SimpleNamespace(name="Vega"), place=lambda *_: where)
    shown.is_looking = True
    shown.shown_overlays = {Overlay.STAR_NAMES, Overlay.SATURATED}
    made.draw(shown)
    what, (drawn_shapes, middle, clip, night) = asked
    assert (what["name_vmag_limit"], what["pixels"], what["zoom"], what["selected"]) == (4.5, "tested", 3.75, "Vega")
    assert (what["beliefs"], what["residuals"]) == ((), None)
    assert what["region"] == ImageRegion(-0.5, -0.5, 99.5, 79.5)
    name, line = what["reserved"]
    # The name, 32 x 10 px, is 14 px right of and below the middle; the line, 304 px wide, at the lower left.
    text_px = 8 * len("looking around: az 12.0   Tab: the aircraft's camera")
    assert name == pytest.approx([49.5 + 14 / 3.75, 39.5 + 14 / 3.75, 49.5 + 46 / 3.75, 39.5 + 24 / 3.75])
    expected = [49.5 - 200 / 3.75, 39.5 + 120 / 3.75, 49.5 + (text_px + 20 - 200) / 3.75, 39.5 + 150 / 3.75]
    assert line == pytest.approx(expected)
    assert (drawn_shapes, middle, night) == ("shapes", [[240.0, 210.0]], False)
    assert clip == pytest.approx((52.5, 60.0, 427.5, 360.0))
    assert "_draw_look" in [part for part, *_ in frame]
    # By the aircraft's camera, with the navigator's beliefs, no saturated pixels, and nothing reserved.
    asked.clear()
    shown.is_looking, shown.shown_overlays, made._selection = (
        False,
        {Overlay.STAR_NAMES},
        SimpleNamespace(selected=None),
    )
    made.draw(shown)
    assert (asked[0]["pixels"], asked[0]["reserved"], asked[0]["selected"]) == (None, (), "")
    assert asked[0]["beliefs"] == (shown.loaded, "own", shown.scene)
    # A magnified part, 50 x 37.5 px around the middle.
    asked.clear()
    shown.view.zoom_at([200.0, 150.0], 8.0 / 3.75)
    made.draw(shown)
    assert asked[0]["region"] == pytest.approx((49.5 - 25, 39.5 - 18.75, 49.5 + 25, 39.5 + 18.75))
    # Nothing is drawn outside of the image, and without overlays or a flight.
    asked.clear()
    shown.view.zoom_at([0.0, 0.0], 8.0)
    shown.view.centre_px = np.array([500.0, 40.0])
    made.draw(shown)
    shown.view.centre_px = np.array([50.0, -400.0])
    made.draw(shown)
    shown.view.fit()
    shown.shown_overlays = set()
    made.draw(shown)
    shown.shown_overlays, shown.loaded = {Overlay.STAR_NAMES}, None
    made.draw(shown)
    assert asked == []


@pytest.mark.parametrize(
    ("on_image", "x_px", "towards", "at", "corner"),
    [
        # A ring at a position, its name 14 px right of and below it; near the lower right corner it stays in the panel.
        (True, 49.5, (0.0, 1.0), (240.0, 210.0), (254.0, 224.0)),
        (True, 98.0, (0.0, 1.0), (421.875, 210.0), (408.0, 224.0)),
        # Towards a corner, and left: an arrow 14 px from the edge; the middle of its name is on the other side of it.
        (False, 0.0, (0.6, 0.8), (240 + 0.75 * 136, 210 + 136.0), (342 - 14.4 - 25.6, 346 - 19.2 - 9)),
        (False, 0.0, (-1.0, 0.0), (54.0, 210.0), (54 + 24.0, 205.0)),
        # In the image, but beyond the edge of the panel.
        (True, 149.5, (0.0, 1.0), (426.0, 210.0), (426 - 24 - 32.0, 205.0)),
    ],
)
def test_the_selected_object_is_marked_wherever_the_panel_is(
    drawn: ScriptedImgui,
    on_image: bool,
    x_px: float,
    towards: tuple[float, float],
    at: tuple[float, float],
    corner: tuple[float, float],
) -> None:
    right, down = towards
    where = ObjectPlace(0.5, 0.0, x_px, 39.5, on_image=on_image, right=right, down=down, from_axis_rad=0.1)
    selection = SimpleNamespace(selected=SimpleNamespace(name="Vega"), place=lambda *_: where)
    mark = imagepanel._SelectedMark.of(session(), selection, CORNER, CLIP, 340.0)
    assert (mark.at.tolist(), mark.corner.tolist()) == (pytest.approx(at), pytest.approx(corner))
    mark.draw(drawn)
    plate, texts = drawn.named("add_rect_filled")[0], drawn.named("add_text")
    assert plate[:2] == [pytest.approx((corner[0] - 2, corner[1] - 2)), pytest.approx((corner[0] + 34, corner[1] + 12))]
    assert texts[-1][0] == pytest.approx(corner)
    if mark.towards is None:
        assert drawn.named("add_circle")[0][:2] == [pytest.approx(at), 14.0]
    else:
        tip, *base = drawn.named("add_triangle_filled")[0][:3]
        assert tip == pytest.approx(at)
        np.testing.assert_allclose(np.mean(base, axis=0), mark.at - 14 * mark.towards, rtol=0, atol=1e-3)
        np.testing.assert_allclose(np.abs(np.subtract(*base)), 14 * np.abs(mark.towards[::-1]), rtol=0, atol=1e-3)
        assert np.subtract(*base) @ mark.towards == pytest.approx(0, abs=1e-3)
    x, y = (corner[0] - 240) / 3.75 + 49.5, (corner[1] - 210) / 3.75 + 39.5
    assert mark.region(placed(), CORNER) == pytest.approx((x, y, x + 32 / 3.75, y + 10 / 3.75))
    for lacking in ({"scene": None}, {"image": SimpleNamespace(simulator=None)}):
        assert imagepanel._SelectedMark.of(session(**lacking), selection, CORNER, CLIP, 340.0) is None
    selection.selected = None
    assert imagepanel._SelectedMark.of(session(), selection, CORNER, CLIP, 340.0) is None
