"""Menus, keys, actions and the theme of the window without OpenGL."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from imgui_bundle import ImVec2, imgui

from glstar.config import Config
from glstar.viewer.session.keys import KEYS, MENUS, Action
from glstar.viewer.session.memory import SettingsHistory
from glstar.viewer.session.saving import PictureAction
from glstar.viewer.ui import interface, layout, theme
from glstar.viewer.ui.interface import Interface, Keyboard
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.support.viewerdoubles import Noting
from tests.support.viewerdoubles import window_session as session


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, layout, interface)
    drawn.docked = True
    drawn.is_window_docked = lambda: drawn.docked
    return drawn


@pytest.fixture
def window(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    made = Interface.__new__(Interface)
    made.session = Noting(**vars(session()), output=tmp_path, config=Config(), errors_reported=nullcontext, flight=None)
    made.session.loader = SimpleNamespace(last_opened=None)
    made.files, made.calibration = Noting(done=[]), Noting(done=[])
    made.wants_to_quit = made.wants_full_screen = made._hidden = made._help = False
    made.screenshot = made.picture = None
    made.text_scale = 1.0
    made._panels, made._manual = Noting(done=[]), SimpleNamespace(is_open=False)
    made._dialogs = {Action.FIND: Noting(done=[])}
    made._history, made._initial = SettingsHistory(), Config()
    monkeypatch.setattr(interface, "perform", lambda action, _: action is Action.NIGHT)
    monkeypatch.setattr(interface, "save_problem_report", lambda _: "report")
    return made


def test_an_action_of_the_window_has_its_effect(window: Any, drawn: ScriptedImgui, tmp_path: Path) -> None:
    def state() -> dict[str, Any]:
        names = ("wants_to_quit", "wants_full_screen", "screenshot", "picture", "text_scale", "_hidden", "_help")
        return {name: getattr(window, name) for name in names} | {"manual": window._manual.is_open}

    before = state()
    window.perform(Action.NIGHT)
    assert state() == before
    window.perform(Action.FIND)
    assert window._dialogs[Action.FIND].done == [("ask", window.session)]
    window.perform(Action.RESET_LAYOUT)
    assert window._panels.done == [("reset_layout",)]
    window.perform(Action.REPORT)
    assert drawn.named("set_clipboard_text") == [["report"]]
    assert state() == before
    for action, changes in (
        (Action.SAVE_PICTURE, {"picture": PictureAction.SAVE}),
        (Action.SAVE_PLAIN_PICTURE, {"picture": PictureAction.SAVE_PLAIN}),
        (Action.COPY_PICTURE, {"picture": PictureAction.COPY}),
        (Action.SCREENSHOT, {"screenshot": tmp_path / "screenshot.png"}),
        (Action.QUIT, {"wants_to_quit": True}),
        (Action.LARGER_TEXT, {"text_scale": 1.1}),
        (Action.SMALLER_TEXT, {"text_scale": 1.0}),
        (Action.SMALLER_TEXT, {"text_scale": 0.9}),
    ):
        before = state()
        window.perform(action)
        assert state() == before | changes
    for action, name in (
        *((Action.HIDE, "_hidden"), (Action.FULL_SCREEN, "wants_full_screen"), (Action.HELP, "_help")),
        (Action.MANUAL, "manual"),
    ):
        before = state()
        window.perform(action)
        assert state() == before | {name: True}
        window.perform(action)
        assert state() == before


def test_settings_are_undone_redone_and_reset(window: Any) -> None:
    used: list[Config] = []
    window.session.use = used.append
    window.perform(Action.UNDO)
    window.perform(Action.REDO)
    assert window.session.said == [("nothing to undo", False), ("nothing to redo", False)]
    first, second = Config(), Config().override(**{"exposure.duration_s": 0.25})
    for config in (first, second):
        window._history.observe(config, is_dragging=False)
    window.perform(Action.UNDO)
    window.perform(Action.REDO)
    window.perform(Action.RESET_SETTINGS)
    assert [each is config for each, config in zip(used, (first, second, window._initial), strict=True)] == [True] * 3


def test_paths_are_asked_for_by_their_actions(window: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shown, done = window.session, []
    shown.open, shown.open_settings = done.append, done.append
    monkeypatch.setattr(interface, "save_settings", lambda _, path: done.append(("save", path)))
    monkeypatch.setattr(interface, "open_beside", lambda _, path: done.append(("beside", path)))
    window.perform(Action.OPEN_BESIDE)
    shown.loaded = SimpleNamespace(is_live=True)
    window.perform(Action.OPEN_BESIDE)
    lacking = "open a log first (Ctrl+O): another one of the same flight is shown beside it"
    assert (shown.said, window.files.done) == ([(lacking, False)] * 2, [])
    shown.loaded.is_live = False
    for last in (None, Path("a/b.bin")):
        shown.loader.last_opened = last
        window.perform(Action.OPEN)
        window.perform(Action.OPEN_BESIDE)
    for action in (Action.OPEN_SETTINGS, Action.OPEN_IMAGES, Action.SAVE_SETTINGS):
        window.perform(action)
    assert [what[:4] for what in window.files.done] == [
        ("ask", "open", "Open a flight log", Path.cwd()),
        ("ask", "open", "Open another log", Path.cwd()),
        ("ask", "open", "Open a flight log", Path("a/b.bin")),
        ("ask", "open", "Open another log", Path("a/b.bin")),
        ("ask", "open", "Open settings", Path.cwd() / "glstar.toml"),
        ("ask", "folder", "Open a folder of real images", Path.cwd()),
        ("ask", "save", "Save the settings", tmp_path / "glstar.toml"),
    ]
    for what in window.files.done[2:]:
        what[4](Path("x"))
    assert done == [Path("x"), ("beside", Path("x")), Path("x"), Path("x"), ("save", Path("x"))]
    photo = tmp_path / "a.JPG"
    photo.touch()
    for dropped in (photo, tmp_path / "b.jpg", tmp_path / "c.bin"):
        window.open_dropped(dropped)
    assert (window.calibration.done, done[5:]) == ([("open", shown, photo)], [tmp_path / "b.jpg", tmp_path / "c.bin"])


def test_the_menus_have_all_actions_and_the_flight(
    window: Any, drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interface, "is_possible", lambda action, _: action is not Action.LIVE)
    monkeypatch.setattr(interface, "is_on", lambda action, _: action is Action.LOOP)
    done: list[Any] = []
    monkeypatch.setattr(window, "perform", done.append)
    window.session.flight = SimpleNamespace(name="night.bin", attitude_source="ATT")
    drawn.available = ImVec2(8.0 * 15 + 5.0, 20.0)
    drawn.answers = {"Loop": True}
    window._draw_menus()
    expected = []
    for menu in MENUS:
        expected.append(f"menu {menu}")
        for key in (key for key in KEYS if key.menu == menu):
            mark, off = "*" if key.action is Action.LOOP else "-", " off" if key.action is Action.LIVE else ""
            expected.append(f"{mark} {key.label} ({key.chords[0] if key.chords else ''}){off}")
    assert drawn.named("set_cursor_pos_x") == [[45.0]]
    assert drawn.take() == [*expected, "(night.bin   ATT)"]
    assert done == [Action.LOOP]
    # Without room for the flight it is left out; closed menus have no entries.
    drawn.available, drawn.closed = ImVec2(8.0 * 15, 20.0), {"File"}
    window._draw_menus()
    lines = drawn.take()
    assert lines[:2] == ["menu File", "menu Edit"]
    assert not lines[-1].startswith("(night")
    drawn.closed = {"begin_main_menu_bar"}
    window._draw_menus()
    assert drawn.take() == []


def poll(keyboard: Keyboard, drawn: ScriptedImgui, pressed: str = "", mods: int = 0, **changes: Any) -> list[Any]:
    """Return the actions of a frame; `pressed`: a key that is pressed in it."""
    held = changes.get("held", "")
    drawn.is_popup_open = lambda *_: changes.get("popup", False)
    drawn.is_key_released = lambda code: code.name == changes.get("released", "")
    drawn.is_key_pressed = lambda code, repeats=True: code.name == pressed or (repeats and code.name == held)
    drawn.io.key_mods, drawn.io.want_text_input = mods, changes.get("typing", False)
    done: list[Any] = []
    keyboard.poll(done.append)
    return done


def test_chords_are_recognised_with_their_modifiers_alone(drawn: ScriptedImgui) -> None:
    ctrl, shift = int(imgui.Key.mod_ctrl), int(imgui.Key.mod_shift)
    keyboard = Keyboard()
    assert poll(keyboard, drawn, "n") == [Action.NIGHT]
    assert poll(keyboard, drawn, "n", shift) == [Action.BLINK_NOISE]
    assert poll(keyboard, drawn, "s", ctrl) == [Action.SAVE_FRAME]
    assert poll(keyboard, drawn, "s", ctrl | shift) == [Action.SAVE_SETTINGS]
    assert poll(keyboard, drawn, mods=0) == []
    # Held keys repeat where that is useful.
    assert poll(keyboard, drawn, held="left_arrow") == [Action.EXPOSURE_BACK]
    assert poll(keyboard, drawn, held="n") == []
    # While something is typed, and over a menu or a dialog, letters are no keys; Escape closes what is open.
    assert poll(keyboard, drawn, "n", typing=True) == []
    assert poll(keyboard, drawn, "n", popup=True) == []
    assert drawn.named("close_popup_to_level") == []
    poll(keyboard, drawn, "escape", popup=True)
    assert drawn.named("close_popup_to_level") == [[0, True]]
    poll(keyboard, drawn, "escape", popup=True, typing=True)
    poll(keyboard, drawn, "escape")
    assert len(drawn.named("close_popup_to_level")) == 1
    # A modifier that is released in the frame of its letter counts, unless the chord before has just ended, or another
    # modifier has been pressed.
    poll(keyboard, drawn, mods=ctrl)
    assert poll(keyboard, drawn, "q") == [Action.QUIT]
    poll(keyboard, drawn, mods=ctrl)
    assert poll(keyboard, drawn, "n", released="s") == [Action.NIGHT]
    poll(keyboard, drawn, mods=ctrl)
    assert poll(keyboard, drawn, "n", mods=shift) == [Action.BLINK_NOISE]
    poll(keyboard, drawn, mods=0)


def test_queued_input_and_typing_are_known(drawn: ScriptedImgui) -> None:
    keyboard = Keyboard()
    for queue in ([], ["key"]):
        drawn.get_current_context = lambda queue=queue: SimpleNamespace(input_events_queue=queue)
        drawn.io.want_text_input = bool(queue)
        assert (keyboard.has_input_left, keyboard.is_typing) == (bool(queue), bool(queue))


def test_a_frame_draws_all_or_the_image_alone(
    window: Any, drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts: list[Any] = []
    for name in ("apply_theme", "draw_status_bar", "draw_welcome", "draw_notifications", "draw_help"):
        monkeypatch.setattr(interface, name, lambda *_, name=name, **keys: parts.append((name, *keys.values())))
    drawn.backends = SimpleNamespace(opengl3_new_frame=lambda: None)
    window.session.times, window.session.video = SimpleNamespace(frames_per_s=0.0), None
    window._themed, window.recent, window._image = None, [], SimpleNamespace(has_readout=None)
    window.keyboard, window.sky = SimpleNamespace(poll=lambda _: parts.append("keys")), Noting(done=parts)
    for name in ("_exports", "_videos", "_missing", "tour"):
        setattr(window, name, Noting(done=parts))
    window._manual, window._panels = Noting(done=parts), Noting(done=parts)
    window._find = SimpleNamespace(draw=lambda _: found[0])
    window._connect = SimpleNamespace(draw=lambda: "udp:1")
    window._palette = SimpleNamespace(draw=lambda: palette[0])
    monkeypatch.setattr(window, "_draw_menus", lambda: parts.append("menus"))
    monkeypatch.setattr(window, "perform", parts.append)
    found, palette = [False], [None]

    def frame() -> list[Any]:
        parts.clear()
        window.frame(lambda: None, 0.25)
        return [part if isinstance(part, str) else part[0] for part in parts]

    assert frame()[:6] == ["apply_theme", "keys", "menus", "draw_status_bar", "draw", "draw_welcome"]
    assert (window.wanted_link, window._image.has_readout, window.session.done[-1]) == ("udp:1", True, ("update", 0.25))
    # The colours change with the night alone; a picture or a video has no readout.
    assert "apply_theme" not in frame()
    window.session.night = True
    frame()
    assert parts[0] == ("apply_theme", True)
    for picture, video in (("picture", None), (None, "video"), ("picture", "video")):
        window.picture, window.session.video = picture, video
        frame()
        assert not window._image.has_readout
    window._hidden = True
    assert not {"menus", "draw_status_bar", "draw_welcome"} & set(frame())
    assert ("draw_image_alone",) in parts
    found[0], palette[0] = True, Action.LOOP
    frame()
    assert ("show", "Object") in parts
    assert Action.LOOP in parts
    drawn.is_popup_open = lambda *_: True
    assert window.covers_picture


def test_a_double_click_may_take_three_frames_more(drawn: ScriptedImgui) -> None:
    for frames_per_s, time_s in ((0.0, 0.3), (10.0, 0.6), (30.0, 0.4)):
        interface._allow_slow_frames(frames_per_s)
        assert drawn.io.mouse_double_click_time == pytest.approx(time_s)
        assert drawn.io.mouse_single_click_delay == pytest.approx(2 * time_s)


# --- the theme ---


@pytest.mark.parametrize(
    ("value", "logarithmic", "form", "fraction"),
    [
        (3.0, False, "%.2f s", 0.25),
        (0.5, False, "%.2f s", 0.0),
        (12.0, False, "%.2f s", 1.0),
        (3.0, True, "%.2f s", 0.477121),
        (4, False, "%d", 3 / 8),
    ],
)
def test_the_bar_of_a_slider_ends_at_its_value(
    drawn: ScriptedImgui, value: float, logarithmic: bool, form: str, fraction: float
) -> None:
    lowest, highest = (1.0, 10.0) if logarithmic else (1.0, 9.0)
    assert theme.draw_slider("x", value, lowest, highest, form, logarithmic=logarithmic) == (False, value)
    # A control of 200 px from (30, 70) on, 18 px high, whose knob of 12 px stays 2 px within it.
    x = 30 + 2 + 6 + fraction * (200 - 4 - 12)
    bar, end = drawn.named("add_rect_filled")
    assert bar[:3] == [(32.0, 85.5), (pytest.approx(x, abs=1e-3), 88.0), "slider_grab"]
    assert end[:2] == [(pytest.approx(x - 2.5, abs=1e-3), 83.0), (pytest.approx(x + 2.5, abs=1e-3), 88.0)]
    drawn.pressed = {"active"}
    theme.draw_slider("x", value, lowest, highest, form)
    assert drawn.named("add_rect_filled")[-1][2] == "slider_grab_active"


def test_a_logarithmic_slider_from_zero_begins_at_its_last_digit() -> None:
    for form, value, fraction in (("%.2f", 0.0, 0.0), ("%.2f", 0.1, 0.25), ("%.0f", 10.0, 0.5), ("%g", 10.0, 0.5)):
        assert theme._slider_fraction(value, 0.0, 100.0, form, logarithmic=True) == pytest.approx(fraction)


def test_dialogs_stay_in_the_window(drawn: ScriptedImgui) -> None:
    # 1.5 px a unit; the window has 900 x 600 px, of which 20 px at the sides and 30 px above and below stay free.
    assert theme.scaled(100.0) == 150.0
    assert (theme.scaled_across(100.0), theme.scaled_across(1000.0)) == (150.0, 860.0)
    size = theme.dialog_size(200.0, 300.0)
    assert (size.x, size.y) == (300.0, 450.0)
    size = theme.dialog_size(800.0, 500.0)
    assert (size.x, size.y) == (860.0, 540.0)
    assert theme.button_size().x == 135.0
    theme.centre_next_window()
    assert drawn.named("set_next_window_pos")[0][::2] == [(460.0, 320.0), (0.5, 0.5)]
    assert theme.draw_choice("a", "b", {"b": "", "c": "about"}, "b") is None
    assert drawn.take() == ["a: b", "* b", "- c", "? about"]
    drawn.closed = {"##rows"}
    theme.draw_rows("##rows", [("a", "b")])
