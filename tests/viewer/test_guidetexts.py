"""Welcome, tour, manual and list of keys without a window: all that they write, and their effects."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from imgui_bundle import ImVec2

from glstar.system.resources import MANUAL_KINDS, bundled_flight
from glstar.viewer.session.keys import KEYS, MENUS, Action
from glstar.viewer.ui import dialogs, guide
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.support.viewerdoubles import dialog_session as session

UTC_S = 1710068404.678


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, dialogs, guide)
    monkeypatch.setattr(dialogs.time, "time", lambda: UTC_S)
    return drawn


def test_the_welcome_offers_what_there_is(drawn: ScriptedImgui) -> None:
    done: list[Any] = []
    shown = session(loaded=None)

    def draw(*clicked: str, recent: tuple[str, ...] = ()) -> list[str]:
        drawn.take()
        drawn.answers = dict.fromkeys(clicked, True)
        guide.draw_welcome(shown, list(recent), done.append, lambda _: done.append("now"))
        return drawn.lines

    lines = draw(recent=("/a/one.bin", "/b/50%.ulg"))
    assert lines == [
        *("=== ##welcome", "glstar [text_link]", "What a camera fixed to an aircraft records of the night sky."),
        *("--- Open", "<Open a flight log  (Ctrl+O)>", "<Connect to a telemetry link  (Ctrl+L)>"),
        *("(or drop a log onto the window)", "--- Sky", "<Here and now>", "<Of a place and time  (Ctrl+K)>"),
        *("--- Try", "<The bundled flight over Adelaide>", "<An orbit of 300 m radius in light gusts>"),
        *("--- Recent flights", "- one.bin", "? /a/one.bin", "- 50%.ulg", "? /b/50%%.ulg"),
    ]
    # The panels on the right need 300 px at 1.5 px a unit: the other 450 px have its middle; the text has 406 px.
    assert drawn.named("set_next_window_pos")[0][0] == (10 + 225, 20 + 216)
    assert {size for _, size in drawn.named("button")} == {(450 - 44.0, 0.0)}
    draw("Open a flight log  (Ctrl+O)", "Connect to a telemetry link  (Ctrl+L)", "Of a place and time  (Ctrl+K)")
    draw("Here and now")
    assert done == [Action.OPEN, Action.CONNECT, Action.SKY, "now"]
    draw("The bundled flight over Adelaide", "An orbit of 300 m radius in light gusts")
    draw("50%.ulg", recent=("/a/one.bin", "/b/50%.ulg"))
    assert shown.said == [bundled_flight(), Path("fly:orbit?radius_m=300&gusts=light"), Path("/b/50%.ulg")]
    drawn.take()
    for change in ({"loaded": 1}, {"live": 1}, {"loader": SimpleNamespace(is_busy=True)}, {"status": "broken"}):
        guide.draw_welcome(SimpleNamespace(**vars(shown) | change), [], done.append, done.append)
        assert drawn.take() == []


def test_the_tour_goes_on_and_back_and_ends(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn.find_window_by_name = lambda _: drawn.window
    drawn.window, drawn.hidden, drawn.pos, drawn.size, drawn.draw_list = (
        drawn,
        False,
        ImVec2(5, 6),
        ImVec2(70, 80),
        drawn,
    )
    tour = guide.Tour()
    tour.draw()
    assert drawn.lines == []
    tour.ask()
    shown = []
    for clicked in ("Back", "Next", "Next", "Back", "Next", "Next", "Next", "Next", "Done"):
        drawn.take()
        if clicked != "Back" or tour.step:
            drawn.answers = {clicked: True}
        tour.draw()
        lines = drawn.lines
        shown.append(int(lines[1].partition(" of 6: ")[0]))
        is_last = shown[-1] == 6
        buttons = [line for line in lines if line.startswith("<")]
        back = "<Back> off" if shown[-1] == 1 else "<Back>"
        assert buttons == (["<Done>", back] if is_last else ["<Next>", back, "<Skip the tour>"])
        # At the right edge, 12 px from it, above 82 % of the height; the panel has a frame.
        assert drawn.named("set_next_window_pos")[0][0] == (910 - 12.0, pytest.approx(20 + 0.82 * 600))
        assert drawn.named("add_rect")[0][:2] == [(5, 6), (75, 86)]
    assert shown == [1, 1, 2, 3, 2, 3, 4, 5, 6]
    assert tour.step is None
    for end in ({"Skip the tour": True}, {"Tour": "close"}):
        tour.ask()
        drawn.take()
        drawn.answers = end
        tour.draw()
        assert tour.step is None
    tour.ask()
    drawn.take()
    drawn.closed, drawn.hidden = {"Tour"}, True
    tour.draw()
    assert drawn.lines == ["=== Tour"]
    assert drawn.named("add_rect") == []
    drawn.window = None
    tour.draw()
    # The text wraps at 390 px from the window's edge, 350 px from the cursor on, and has the height of the longest.
    drawn.take()
    guide._draw_text("short", 390.0)
    longest = max(-(-8 * len(guide._with_keys(step.text)) // 350) for step in guide.STEPS)
    assert drawn.named("push_text_wrap_pos") == [[390.0]]
    assert drawn.named("dummy") == [[(0.0, 10.0 * longest - 18)]]
    monkeypatch.setattr(guide, "shown_chord", "[{}]".format)
    assert guide._with_keys("a {Ctrl+O}, {0} b") == "a [Ctrl+O], [0] b"


def test_the_manual_has_its_pages_and_their_blocks(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "a.md").write_text(
        "# Title *x*\n\nSome **bold** text\ngoes on.\n\n- item [one](b.md)\n  more\n2. two\n\n"
        "```\ncode *as is*\n  in\n```\n| a | b |\n|---|:-:|\n| `1` | 2 \\| 3 |\n<!-- gone -->\n"
    )
    monkeypatch.setattr(guide, "manual_pages", lambda: {"viewer": tmp_path / "a.md"})
    monkeypatch.setattr(guide, "MANUAL_KINDS", {"Start: here": ("viewer", "lens"), "More": ("sky",)})
    window = guide.ManualWindow()
    window.draw()
    assert drawn.lines == []
    window.is_open = True
    window.draw()
    assert drawn.lines == [
        *("=== Manual", "--- Start", "* viewer", "- lens", "--- More", "- sky", "Title x [text_link]"),
        *("Some bold text goes on.", "item one more", "2. two", "(code *as is*\n  in)", "a", "b", "1", "2 | 3"),
    ]
    assert drawn.named("begin_table")[0][:2] == ["##table5", 2]
    assert [len(drawn.named(name)) for name in ("bullet", "table_next_row", "table_next_column", "spacing")] == [
        2,
        2,
        4,
        7,
    ]
    # 900 x 680 px at 1.5 px a unit, at most the window less its margins.
    assert drawn.named("set_next_window_size")[0][0] == (860.0, 540.0)
    drawn.take()
    drawn.answers = {"lens": True}
    window.draw()
    assert drawn.lines[-1] == "- sky"
    drawn.take()
    drawn.answers = {"viewer": True}
    window.draw()
    assert "2. two" in drawn.lines
    for answers, pressed in (({"Manual": "close"}, set()), ({}, {"escape"})):
        drawn.take()
        drawn.answers, drawn.pressed, window.is_open = answers, pressed, True
        window.draw()
        assert not window.is_open
    drawn.pressed, drawn.closed, window.is_open = set(), {"Manual"}, True
    drawn.take()
    window.draw()
    assert drawn.lines == ["=== Manual"]
    assert set(MANUAL_KINDS) != {"Start: here", "More"}


def test_the_list_of_keys_has_two_columns_where_they_fit(drawn: ScriptedImgui) -> None:
    assert not guide.draw_help(is_open=False)
    assert drawn.lines == []
    drawn.get_column_index = lambda: len(drawn.named("next_column"))
    with_keys = [key for key in KEYS if key.chords]
    longest_px = 8 * max(len("  " + ", ".join(key.chords)) for key in with_keys) + 24
    column_px = longest_px + 8 * max(len(key.label) for key in with_keys) + 24
    for width_px, columns in ((2 * column_px + 48 + 36, 2), (2 * column_px + 48 + 35, 1)):
        drawn.take()
        drawn.get_main_viewport = lambda width_px=width_px: SimpleNamespace(
            size=ImVec2(width_px, 2000.0), get_center=lambda: ImVec2(0, 0)
        )
        assert guide.draw_help(is_open=True)
        assert drawn.named("columns") == [[columns, "##keys", False], [1]]
        assert drawn.named("set_next_window_size")[0][0] == (columns * column_px + 36, 1095.0)
        assert len(drawn.named("next_column")) == columns - 1
        assert [args for args in drawn.named("same_line") if args] == [[longest_px]] * len(with_keys)
    lines = drawn.take()
    assert [line.removesuffix(" [text_link]") for line in lines if line.endswith("[text_link]")] == list(MENUS)
    assert [line for line in lines if not line.startswith(("(", "=")) and "[text" not in line] == [
        key.label for menu in MENUS for key in with_keys if key.menu == menu
    ]
    # A menu begins the second column when three rows less than half of all are above it.
    at = {menu: k for k, menu in enumerate(MENUS)}
    rows = [sum(key.menu == menu for key in with_keys) + 1 for menu in MENUS]
    half = (len(KEYS) + len(MENUS)) // 2
    second = next(menu for menu in MENUS if sum(rows[: at[menu]]) >= half - 3)
    drawn.get_main_viewport = lambda: SimpleNamespace(size=ImVec2(9000.0, 2000.0), get_center=lambda: ImVec2(0, 0))
    guide.draw_help(is_open=True)
    number = next(k for k, call in enumerate(drawn.calls) if call[0] == "next_column")
    assert next(call for call in drawn.calls[number:] if call[0] == "text_colored")[2] == second
    drawn.pressed = {"escape"}
    assert not guide.draw_help(is_open=True)
    drawn.pressed, drawn.answers = set(), {"Keys": "close"}
    assert not guide.draw_help(is_open=True)
