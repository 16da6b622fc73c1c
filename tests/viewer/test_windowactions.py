"""Panels of the window without OpenGL: which are drawn, and where."""

from types import SimpleNamespace
from typing import Any

import pytest
from imgui_bundle import ImVec2, imgui

from glstar.viewer.flight.traces import TimelineCurve
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.keys import KEYS
from glstar.viewer.skyobjects import ObjectKind, SkyObject
from glstar.viewer.ui import interface, layout
from glstar.viewer.ui.layout import Panels
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.support.viewerdoubles import Noting
from tests.support.viewerdoubles import window_session as session


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, layout, interface)
    drawn.docked = True
    drawn.is_window_docked = lambda: drawn.docked
    return drawn


# --- panels ---


@pytest.fixture
def panels(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> Panels:
    """Return the panels with a list of what they draw in `parts`."""
    parts: list[Any] = []
    for name in ("draw_settings", "draw_object", "draw_link", "draw_residual_figures", "save_comparison"):
        monkeypatch.setattr(layout, name, lambda *_, name=name: parts.append(name))
    image = SimpleNamespace(draw=lambda _, labelled=True, is_lowest=False: parts.append(("image", labelled, is_lowest)))
    shown = session()
    shown.comparison = SimpleNamespace(images=None, image_at=lambda _: None)
    made = Panels(shown, image, SimpleNamespace(selected=None), parts.append, has_layout=True)
    made.parts = parts
    made._flight = SimpleNamespace(draw=lambda _: parts.append("flight"))
    made._display_settings = SimpleNamespace(draw=lambda _: parts.append("display"))
    made._right["Compare"] = lambda: parts.append("compare")
    drawn.dock_builder_get_node = lambda _: None
    return made


def titles(drawn: ScriptedImgui) -> list[str]:
    return [args[0] for args in drawn.named("begin")]


def test_the_panels_are_drawn_and_the_first_is_in_front_at_first(panels: Panels, drawn: ScriptedImgui) -> None:
    panels.draw()
    assert titles(drawn) == ["Image", "Time", "Settings", "View", "Compare", "Object", "Flight"]
    assert [part for part in panels.parts if isinstance(part, str)] == [
        *("draw_settings", "display", "compare", "draw_object", "flight")
    ]
    assert drawn.named("set_window_focus") == [["Settings"]]
    # Docked panels have no background of their own from their second frame on.
    assert drawn.named("set_next_window_bg_alpha") == []
    drawn.take()
    panels._session.live = "live"
    panels.draw()
    assert titles(drawn)[2] == "Link"
    assert drawn.named("set_window_focus") == [["Link"]]
    assert drawn.named("set_next_window_bg_alpha") == [[0.0]] * 6
    drawn.docked = False
    panels.draw()
    drawn.take()
    panels.draw()
    assert drawn.named("set_window_focus") + drawn.named("set_next_window_bg_alpha") == []
    # A panel that is closed or behind another one is not filled.
    panels.parts.clear()
    drawn.closed = {"Settings", "Image", "Time", "Link"}
    panels.draw()
    assert panels.parts == ["display", "compare", "draw_object", "flight"]
    panels._draw_link()
    assert panels.parts[-1] == "draw_link"
    panels._session.live = None
    panels._draw_link()
    assert panels.parts.count("draw_link") == 1
    panels.draw_image_alone()
    assert panels.parts[-1] == ("image", False, True)
    assert drawn.named("set_next_window_size")[-1][0] == (900.0, 600.0)


def test_a_reset_lays_the_panels_out_in_one_frame(
    panels: Panels, drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    laid: list[Any] = []
    monkeypatch.setattr(layout, "_lay_out", lambda dock, right: laid.append(right))
    for _ in range(3):
        panels.draw()
    drawn.take()
    panels.reset_layout()
    panels.draw()
    assert laid == [["Link", "Settings", "View", "Compare", "Object", "Flight"]]
    assert drawn.named("set_window_focus") == [["Settings"]]
    drawn.take()
    panels.draw()
    assert (len(laid), drawn.named("set_window_focus")) == (1, [])


@pytest.mark.parametrize(
    ("size", "across", "down"),
    # 300 and 230 px at 1.5 px a unit, at least 26 % of the width and 34 % of the height, at most half.
    [((2000.0, 1500.0), 0.26, 0.34), ((1200.0, 1000.0), 0.375, 0.345), ((600.0, 400.0), 0.5, 0.5)],
)
def test_the_layout_leaves_room_for_the_controls(
    drawn: ScriptedImgui, size: tuple[float, float], across: float, down: float
) -> None:
    splits: list[Any] = []

    def split(node: str, direction: imgui.Dir, fraction: float) -> SimpleNamespace:
        splits.append((node, direction, fraction))
        return SimpleNamespace(id_at_dir=f"{node} {direction.name}", id_at_opposite_dir=f"{node} rest")

    drawn.dock_builder_split_node = split
    drawn.get_main_viewport = lambda: SimpleNamespace(work_size=ImVec2(*size))
    layout._lay_out("dock", ["A", "B"])
    assert splits == [
        ("dock", imgui.Dir.right, pytest.approx(across)),
        ("dock rest", imgui.Dir.down, pytest.approx(down)),
    ]
    assert drawn.named("dock_builder_dock_window") == [
        *(["Image", "dock rest rest"], ["Time", "dock rest down"], ["A", "dock right"], ["B", "dock right"])
    ]


def test_the_timeline_is_of_the_flight_shown(
    panels: Panels, drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Line(Noting):
        def __init__(self, *what: Any, grows: bool) -> None:
            super().__init__(made=(*what, grows), done=[], curves={TimelineCurve.RATES})

    monkeypatch.setattr(layout, "Timeline", Line)
    head = SimpleNamespace(grows=True, origin_s=1000.0)
    loaded = SimpleNamespace(flight="flight", lines="lines", head=head)
    panels._session.loaded = loaded
    panels.draw()
    first = panels._timeline
    assert first.made == ("flight", "lines", True)
    panels.draw()
    assert (panels._timeline, first.done) == (first, [])
    loaded.lines = "newer"
    panels.draw()
    assert (panels._timeline, first.done) == (first, [("show", "newer"), ("show_flight", "flight")])
    loaded.lines, loaded.head = "other", SimpleNamespace(grows=False)
    panels.draw()
    assert panels._timeline.made == ("flight", "other", False)
    # Its contents: errors of the typed time are messages.
    shown = panels._session
    panels._playback = SimpleNamespace(draw=lambda _: None, error="no time")
    shown.head, shown.night, shown.loader = head, True, SimpleNamespace(others=SimpleNamespace(shown=("log",)))
    loaded.is_live = True
    panels._draw_time()
    assert (shown.said, panels._playback.error) == ([("no time", True)], None)
    ((name, at, *keys),) = panels._timeline.done
    assert (name, at, dict(keys)["night"], dict(keys)["samples"], dict(keys)["others"]) == (
        "draw",
        head,
        True,
        None,
        ("log",),
    )
    assert dict(keys)["images_s"].size == 0


def test_samples_are_computed_for_curves_of_logs_that_need_them(panels: Panels) -> None:
    asked: list[Any] = []
    shown = panels._session
    shown.loader = SimpleNamespace(sampler=SimpleNamespace(of=lambda *what: asked.append(what) or "samples"))
    star, body = SkyObject(ObjectKind.STAR, "Vega", star_id=7001), SkyObject(ObjectKind.BODY, "Moon")
    line = SimpleNamespace(curves={TimelineCurve.STARS, TimelineCurve.RATES})
    loaded = SimpleNamespace(is_live=False, simulator="simulator", head=SimpleNamespace(exposure_section="section"))
    assert panels._samples(line) is None
    shown.loaded, panels._selection.selected = loaded, star
    assert panels._samples(line) == "samples"
    line.curves = {TimelineCurve.SNR}
    panels._samples(line)
    panels._selection.selected = body
    panels._samples(line)
    panels._selection.selected = None
    panels._samples(line)
    assert asked == [("simulator", "section", star_id) for star_id in (None, 7001, None, None)]
    loaded.is_live = True
    assert panels._samples(line) is None
    loaded.is_live, line.curves = False, {TimelineCurve.RATES, TimelineCurve.HEIGHT}
    assert panels._samples(line) is None


def test_the_times_of_real_images_are_those_of_the_log_s_clock(panels: Panels) -> None:
    shown = panels._session
    assert panels._images_s().size == 0
    asked: list[Any] = []
    shown.comparison = SimpleNamespace(
        images=[1.0, 4.0], ahead_s=0.5, log_utc_s=lambda image: asked.append(image) or 1000 + image
    )
    assert panels._images_s().size == 0
    shown.head = SimpleNamespace(origin_s=990.0)
    assert panels._images_s().tolist() == [11.0, 14.0]
    panels._images_s()
    assert len(asked) == 2
    shown.comparison.ahead_s = 0.75
    panels._images_s()
    assert len(asked) == 4
    shown.comparison.images = None
    assert panels._images_s().size == 0


def test_overlays_are_switched_in_the_panel(panels: Panels, drawn: ScriptedImgui) -> None:
    keys = [key for key in KEYS if key.menu == "Overlays"]
    panels._draw_overlay_switches()
    lines = drawn.take()
    assert lines[0] == "--- Overlays"
    assert len(lines) == 1 + 2 * len(keys)
    for key, control, about in zip(keys, lines[1::2], lines[2::2], strict=True):
        label, _, details = key.label.partition(": ")
        assert control == f"[{'x' if key.action is Overlay.HORIZON else ' '}] {label}"
        assert about == f"? {details + chr(10) if details else ''}key {key.chords[0]}"
    assert any(": " in key.label for key in keys)
    drawn.answers = {keys[1].label.partition(": ")[0]: True}
    panels._draw_overlay_switches()
    assert panels.parts == [keys[1].action]


def test_the_panel_compare_is_of_the_image_at_the_play_head(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts: list[Any] = []
    for name in ("draw_residual_figures", "save_comparison"):
        monkeypatch.setattr(layout, name, lambda *_, name=name: parts.append(name))
    made = Panels.__new__(Panels)
    sought: list[float] = []
    head = SimpleNamespace(utc_s=5.0, seek=sought.append)
    made._session = shown = session(status="why")
    made._compare = SimpleNamespace(draw=lambda *what, status: parts.append((*what, status)) or requests)
    made._fit = SimpleNamespace(draw=lambda _: parts.append("fit"))
    requests = SimpleNamespace(seek_utc_s=None, save_view=False)
    made._draw_comparison()
    assert parts == []
    shown.head, shown.real = head, None
    made._draw_comparison()
    assert parts == [(5.0, None, None, ""), "draw_residual_figures", "fit"]
    parts.clear()
    images = {5.0: "image at 5.0"}
    shown.comparison = SimpleNamespace(image_at=images.get)
    shown.real, requests.seek_utc_s, requests.save_view = (images[5.0], "pixels"), 7.5, True
    made._draw_comparison()
    assert parts[:2] == [(5.0, "image at 5.0", "pixels", "why"), "save_comparison"]
    assert sought == [7.5]
    parts.clear()
    shown.real = ("another", "pixels")
    made._draw_comparison()
    assert parts[0] == (5.0, "image at 5.0", None, "why")


def test_a_panel_is_docked_in_the_window_s_dock_alone(drawn: ScriptedImgui) -> None:
    drawn.dock_builder_get_node = lambda _: "node"
    drawn.dock_node_get_root_node = lambda _: SimpleNamespace(id_=17)
    assert [layout._is_docked_in(dock) for dock in (17, 18)] == [True, False]
    drawn.docked = False
    assert not layout._is_docked_in(17)
    drawn.docked, drawn.dock_builder_get_node = True, lambda _: None
    assert not layout._is_docked_in(17)
