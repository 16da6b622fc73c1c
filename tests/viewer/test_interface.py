"""The interface without a display: keys pressed through imgui, and what they do."""

import gc
import tracemalloc

import moderngl
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar import __version__
from glstar.config import Config
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.keys import KEYS, Action
from glstar.viewer.session.saving import unused_path
from glstar.viewer.ui.interface import Interface, parse_chord
from glstar.viewer.window import text_scale
from tests.scripts.monkey import WINDOW_PX, Monkey, viewer_of
from tests.support.windowinput import HELD_KEYS, press, screen
from tests.viewer.conftest import write_flight


def test_every_key_of_the_table_exists_on_the_keyboard():
    for key in KEYS:
        for chord in key.chords:
            assert isinstance(parse_chord(chord)[0], imgui.Key)


def test_space_plays_and_pauses(viewer):
    press(viewer, "Space")
    assert viewer.session.head.playing
    press(viewer, "Space")
    assert not viewer.session.head.playing


@pytest.mark.parametrize(
    ("chord", "from_s", "to_s"),
    [
        ("Right", 0.5, 3.5),
        ("Left", 6.5, 3.5),
        ("Shift+Right", 2.0, 3.0),
        ("Shift+Left", 2.0, 1.0),
        ("Ctrl+Right", 1.0, 11.0),
        ("Ctrl+Left", 11.0, 1.0),
        ("Home", 5.0, 0.0),
        ("End", 5.0, 12.0),
        (".", 3.5, 3.505),
        (",", 3.5, 3.495),
    ],
)
def test_the_time_keys_move_the_play_head(viewer, chord, from_s, to_s):
    head = viewer.session.head
    head.seek(head.first_s + from_s)
    viewer.frame(0.0)
    press(viewer, chord)
    assert head.second == pytest.approx(to_s, abs=1e-3)


def test_the_speed_keys_change_the_speed(viewer):
    head = viewer.session.head
    for chord, speed in (("]", 2.0), ("=", 4.0), ("[", 2.0), ("R", -2.0), ("Backspace", -1.0), ("R", 1.0), ("-", 0.5)):
        press(viewer, chord)
        assert head.speed == speed


def test_the_keys_of_modes_and_markers_have_their_effect(viewer):
    head = viewer.session.head
    press(viewer, "T")
    assert head.mode is Mode.SLIDING
    press(viewer, "L")
    assert head.loop
    head.seek_by(2.0)
    press(viewer, "M")
    press(viewer, "Home")
    press(viewer, "Page Down")
    assert head.second == pytest.approx(2.0)
    press(viewer, "End")
    press(viewer, "Page Up")
    assert head.second == pytest.approx(2.0)


# Residuals need a real image: test_trailresiduals.py.
_DRAWN = [key for key in KEYS if key.menu == "Overlays" and key.action is not Overlay.RESIDUALS]


@pytest.mark.parametrize("key", _DRAWN, ids=lambda key: key.action.value)
def test_an_overlay_s_key_shows_and_hides_it(viewer, key):
    session = viewer.session
    session.change(**{"sensor.reference_peak_dn": 2000.0, "exposure.duration_s": 2.0, "mount.pitch_deg": 10.0})
    session.change(**{"navigator.roll_bias_deg": 2.0})  # an estimate to draw
    session.name_vmag_limit = 4.0
    session.shown_overlays = set()
    viewer.frame(0.0)
    viewer.frame(0.0)
    press(viewer, "H")  # only the image changes
    without = screen(viewer).copy()
    press(viewer, key.chords[0])
    assert (screen(viewer) != without).any()
    press(viewer, key.chords[0])
    np.testing.assert_array_equal(screen(viewer), without)


def test_the_view_keys_change_the_view(viewer):
    session = viewer.session
    boost, kind = session.stretch.boost, session.stretch.kind
    press(viewer, "Up")
    assert session.stretch.boost == 2 * boost
    press(viewer, "Down")
    assert session.stretch.boost == boost
    press(viewer, "I")
    assert session.stretch.kind is not kind
    press(viewer, "1")
    assert session.view.zoom == 1.0
    press(viewer, "Ctrl+=")
    assert session.view.zoom > 1.0
    press(viewer, "0")
    assert session.view.fitted


def test_at_night_nothing_on_the_screen_is_green_or_blue(viewer):
    for key in KEYS:
        if key.menu == "Overlays" and key.action is not Overlay.STAR_NAMES:
            press(viewer, key.chords[0])
    press(viewer, "F1")
    press(viewer, "N")
    viewer.frame(0.0)
    picture = screen(viewer)
    assert picture[..., 0].max() > 100
    assert picture[..., 1:].max() <= 8


def test_f1_opens_the_list_of_keys_and_escape_closes_only_it(viewer):
    interface: Interface = viewer.interface
    press(viewer, "F1")
    assert interface._help
    imgui.get_io().add_key_event(imgui.Key.escape, True)
    viewer.frame(0.0)
    imgui.get_io().add_key_event(imgui.Key.escape, False)
    viewer.frame(0.0)
    assert not interface._help
    assert not interface.wants_to_quit
    press(viewer, "Shift+/")
    assert interface._help


def test_keys_enter_letters_while_a_text_field_is_active(viewer):
    press(viewer, "Ctrl+O")
    viewer.frame(0.0)
    assert viewer.interface.keyboard.is_typing
    for chord in ("Space", "N", "L"):
        press(viewer, chord)
    assert not viewer.session.head.playing
    assert not viewer.session.night
    imgui.get_io().add_key_event(imgui.Key.escape, True)
    viewer.frame(0.0)
    imgui.get_io().add_key_event(imgui.Key.escape, False)
    viewer.frame(0.0)
    viewer.frame(0.0)
    assert not viewer.interface.keyboard.is_typing
    press(viewer, "N")
    assert viewer.session.night


def test_a_chord_released_within_a_frame_is_recognised(viewer):
    """Ctrl pressed in one frame, then the letter pressed and Ctrl released before the next is drawn."""
    io = imgui.get_io()
    for key in (imgui.Key.mod_ctrl, imgui.Key.left_ctrl):
        io.add_key_event(key, True)
    viewer.frame(0.0)
    io.add_key_event(imgui.Key.q, True)
    for key in (imgui.Key.mod_ctrl, imgui.Key.left_ctrl):
        io.add_key_event(key, False)
    viewer.frame(0.0)
    viewer.frame(0.0)
    assert viewer.interface.wants_to_quit


@pytest.mark.parametrize(("first", "then"), [("Shift+Left", "Ctrl+S"), ("Ctrl+Shift+S", "N"), ("Shift+Right", "Space")])
def test_two_chords_pressed_within_a_frame_are_both_recognised(viewer, monkeypatch, first, then):
    """Both chords are pressed and released within one slow frame."""
    io, done = imgui.get_io(), []
    monkeypatch.setattr(viewer.interface, "perform", done.append)
    for chord in (first, then):
        code, modifiers = parse_chord(chord)
        held = [key for key in HELD_KEYS if modifiers & int(key)]
        for key in held:
            io.add_key_event(key, True)
            io.add_key_event(HELD_KEYS[key], True)
        io.add_key_event(code, True)
        io.add_key_event(code, False)
        for key in held:
            io.add_key_event(key, False)
            io.add_key_event(HELD_KEYS[key], False)
    for _ in range(6):
        viewer.frame(0.0)
    assert done == [key.action for chord in (first, then) for key in KEYS if chord in key.chords]


def test_the_wheel_zooms_at_the_cursor(viewer):
    io, view = imgui.get_io(), viewer.session.view
    press(viewer, "H")
    io.add_mouse_pos_event(600.0, 200.0)
    viewer.frame(0.0)
    held = view.to_picture([600.0, 200.0])
    io.add_mouse_wheel_event(0.0, 2.0)
    viewer.frame(0.0)
    assert view.zoom > 900 / 254 * 1.2 / 2
    assert not view.fitted
    np.testing.assert_allclose(view.to_picture([600.0, 200.0]), held, rtol=0, atol=0.1)


def test_ctrl_q_quits(viewer):
    press(viewer, "Ctrl+Q")
    assert viewer.interface.wants_to_quit


def test_a_screenshot_equals_the_window(viewer, tmp_path):
    import cv2  # noqa: PLC0415

    viewer.interface.screenshot = tmp_path / "shot.png"
    viewer.frame(0.0)
    read = cv2.imread(str(tmp_path / "shot.png"))
    assert read.shape == (600, 900, 3)
    np.testing.assert_array_equal(read[::-1, :, ::-1], screen_before_notice(viewer, read))


def screen_before_notice(viewer, read: np.ndarray) -> np.ndarray:
    """Return the current screen; the message about the screenshot is drawn a frame later."""
    picture = screen(viewer)
    assert picture.shape == read.shape
    return picture


def test_every_panel_and_dialog_is_drawn_without_an_opengl_error(viewer):
    for chord in ("Ctrl+E", "Ctrl+Shift+S"):
        press(viewer, chord)
        viewer.frame(0.0)
        assert viewer._surface.context.error == "GL_NO_ERROR"
        imgui.get_io().add_key_event(imgui.Key.escape, True)
        viewer.frame(0.0)
        imgui.get_io().add_key_event(imgui.Key.escape, False)
        viewer.frame(0.0)
    for action in Action:
        if action not in {Action.QUIT, Action.OPEN, Action.OPEN_IMAGES, Action.OPEN_SETTINGS}:
            viewer.interface.perform(action)
            viewer.frame(0.01)
    assert viewer._surface.context.error == "GL_NO_ERROR"


def test_a_closed_viewer_leaves_nothing_on_the_gpu(make_viewer, monkeypatch):
    made = []
    for maker in ("program", "vertex_array", "buffer", "texture", "framebuffer"):
        make = getattr(moderngl.Context, maker)

        def noted(self, *args, _make=make, **keys):
            made.append(_make(self, *args, **keys))
            return made[-1]

        monkeypatch.setattr(moderngl.Context, maker, noted)
    viewer = make_viewer()
    own = {id(viewer._surface.target), id(viewer._surface._texture)}
    viewer.session.change(**{"sensor.bit_depth": 12, "sensor.psf_sigma_px": 0.5})
    viewer.frame(0.0)
    viewer.close()
    viewer.close()
    left = [thing for thing in made if id(thing) not in own]
    assert len(left) > 15
    assert all(isinstance(thing.mglo, moderngl.mgl.InvalidObject) for thing in left)


def test_memory_is_flat_while_flights_play_and_are_opened_in_turn(viewer, tmp_path):
    session = viewer.session
    logs = [write_flight(tmp_path / f"{rate}.csv", yaw_rate_deg_per_s=rate) for rate in (1.0, 9.0)]

    def round_() -> int:
        for log in logs:
            viewer.open(log)
            session.wait_for_flight()
            session.head.mode = Mode.SLIDING
            session.head.toggle()
            for _ in range(5):
                viewer.frame(0.04)
            session.head.toggle()
            for chord in ("Right", "Home", "V", "V"):
                press(viewer, chord)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    round_()
    tracemalloc.start()
    try:
        first = round_()
        for _ in range(2):
            round_()
        last = round_()
    finally:
        tracemalloc.stop()
    # A log of 300 samples, its plots and its stars are 2 MB: a leak of one in each of three rounds would be 12 MB.
    assert last - first < 2e6


def test_random_use_raises_no_error(tmp_path):
    surface = HeadlessSurface(WINDOW_PX)
    with viewer_of(surface, tmp_path) as viewer:
        monkey = Monkey(viewer, tmp_path, seed=11)
        for _ in range(60):
            monkey.act()
    surface.close()
    assert monkey.reported > 0
    assert monkey.done["press"] > 20


def test_a_problem_report_has_versions_flight_messages_and_settings(viewer, tmp_path):
    session = viewer.session
    session.change(**{"exposure.duration_s": 0.75})
    session.notify("something went wrong", is_error=True)
    viewer.interface.perform(Action.REPORT)
    report = imgui.get_clipboard_text()
    assert report == (session.output / "problem-report.md").read_text(encoding="utf-8")
    assert f"| glstar | {__version__} |" in report
    assert viewer._surface.context.info["GL_RENDERER"] in report
    assert f"| flight | {session.flight.attitude_source}, 12.0 s, 301 attitudes |" in report
    assert "| message | something went wrong |" in report
    settings = tmp_path / "settings.toml"
    settings.write_text(report.split("```toml\n")[1].split("```")[0], encoding="utf-8")
    assert Config.load(settings).exposure.duration_s == 0.75


def front_tabs(viewer) -> set[str]:
    """Return which of the docked panels are in front."""
    internal = imgui.internal
    names = ("Settings", "View", "Compare")
    return {name for name in names if not internal.find_window_by_name(name).hidden}


def test_a_second_start_has_the_settings_panel_in_front(small, log, tmp_path):
    layout = tmp_path / "viewer.ini"
    for _ in range(2):
        surface = HeadlessSurface((900, 600))
        with Viewer(surface, small, layout=layout, output=tmp_path / "saved") as viewer:
            viewer.open(log)
            viewer.session.wait_for_flight()
            for _ in range(6):
                viewer.frame(0.0)
            assert front_tabs(viewer) == {"Settings"}
            # At the end of the first start another panel is in front.
            imgui.set_window_focus("Compare")
            for _ in range(3):
                viewer.frame(0.0)
            assert front_tabs(viewer) == {"Compare"}
            imgui.save_ini_settings_to_disk(str(layout))
        surface.close()
    assert "Compare" in layout.read_text()


def test_escape_closes_a_menu(viewer):
    io = imgui.get_io()
    io.add_mouse_pos_event(20.0, 10.0)
    viewer.frame(0.0)
    for down in (True, False):
        io.add_mouse_button_event(0, down)
        viewer.frame(0.0)
    flags = int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)
    assert imgui.is_popup_open("", flags)
    for down in (True, False):
        io.add_key_event(imgui.Key.escape, down)
        viewer.frame(0.0)
    viewer.frame(0.0)
    assert not imgui.is_popup_open("", flags)
    press(viewer, "Space")
    assert viewer.session.head.playing


@pytest.mark.parametrize("scale", [1.0, 1.5, 2.0])
def test_the_list_of_keys_grows_with_the_text_and_cuts_none(small, tmp_path, scale):
    class Scaled(HeadlessSurface):
        pass

    Scaled.scale = scale
    surface = Scaled((2400, 1800))
    with Viewer(surface, small, output=tmp_path / "saved") as viewer:
        viewer.frame(0.0)
        viewer.interface.perform(Action.HELP)
        viewer.frame(0.0)
        viewer.frame(0.0)
        size = imgui.internal.find_window_by_name("Keys").size
        labels_px, chords_px = (
            max(imgui.calc_text_size(text).x for text in texts)
            for texts in zip(*((key.label, ", ".join(key.chords)) for key in KEYS if key.chords), strict=True)
        )
        assert size.x > 2 * scale * (labels_px + chords_px) > 800 * scale  # outside a frame sizes are those of scale 1
        assert size.y == pytest.approx(730.0 * scale)
    surface.close()


@pytest.mark.parametrize(
    ("content_scale", "framebuffer_px", "window_units", "scale"),
    [
        (1.5, 1280, 1280, 1.5),  # X11 and Windows
        (2.0, 2560, 1280, 1.0),  # Retina, Wayland
        (1.5, 1920, 1280, 1.0),
        (1.0, 1280, 1280, 1.0),
        (2.0, 0, 0, 2.0),  # minimised
    ],
)
def test_text_is_scaled_only_once(content_scale, framebuffer_px, window_units, scale):
    assert text_scale(content_scale, framebuffer_px, window_units) == pytest.approx(scale)


@pytest.mark.parametrize(
    ("size", "scale", "text"),
    [
        ((800, 600), 1.0, 1.0),
        ((1280, 800), 1.0, 1.0),
        ((1920, 1200), 1.5, 1.0),
        ((800, 600), 1.0, 0.7),
        ((1280, 800), 1.0, 1.6),
    ],
)
def test_no_control_is_cut_off(small, log, tmp_path, size, scale, text):
    class Scaled(HeadlessSurface):
        pass

    Scaled.scale = scale
    surface = Scaled(size)
    with Viewer(surface, small, output=tmp_path / "saved") as viewer:
        viewer.interface.text_scale = text
        viewer.open(log)
        viewer.session.wait_for_flight()
        for _ in range(4):
            viewer.frame(0.0)
        for name in ("Time", "Settings"):
            panel = imgui.internal.find_window_by_name(name)
            # A panel's text may be wider, and wraps or is cut off; panels scroll vertically, except that of the time.
            room = panel.size.x - 2 * imgui.get_style().window_padding.x - panel.scrollbar_sizes.x
            assert panel.content_size.x <= room + 1, name
        panel = imgui.internal.find_window_by_name("Time")
        assert panel.content_size.y <= panel.size.y
    surface.close()


@pytest.mark.parametrize(
    ("name", "second"),
    [
        ("problem-report.md", "problem-report-2.md"),
        ("link-20240310.tlog", "link-20240310-2.tlog"),
        ("adelaide-12.5s", "adelaide-12.5s-2"),
    ],
)
def test_a_second_file_of_the_same_name_keeps_its_suffix(tmp_path, name, second):
    assert unused_path(tmp_path / name) == tmp_path / name
    (tmp_path / name).touch()
    assert unused_path(tmp_path / name) == tmp_path / second
