"""The tour of the window, and keys as each system names them."""

import json
import re

import pytest
from imgui_bundle import imgui

from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.session.keys import KEYS, Action, shown_chord
from glstar.viewer.session.memory import WindowMemory
from glstar.viewer.ui.guide import STEPS
from tests.support.windowinput import press


def click_next(viewer: Viewer) -> None:
    """Click on the first button of the tour, which is in its lowest row."""
    window, padding = imgui.internal.find_window_by_name("Tour"), imgui.get_style().window_padding
    x = window.pos.x + padding.x + 12.0
    y = window.pos.y + window.size.y - padding.y - imgui.get_frame_height() / 2
    io = imgui.get_io()
    io.add_mouse_pos_event(x, y)
    for down in (True, False):
        io.add_mouse_button_event(0, down)
        viewer.frame(0.0)
    viewer.frame(0.0)


def test_the_first_start_leads_through_six_steps_and_the_second_does_not(small, tmp_path):
    file = tmp_path / "window.json"
    surface = HeadlessSurface((900, 600))
    with Viewer(surface, small, memory=WindowMemory.load(file)) as viewer:
        for step in range(6):
            for _ in range(2):
                viewer.frame(0.0)
            assert viewer.interface.tour.step == step
            press(viewer, "Shift+A")  # the window can be used meanwhile
            click_next(viewer)
        assert viewer.interface.tour.step is None
    surface.close()
    assert json.loads(file.read_text())["has_toured"] is True
    surface = HeadlessSurface((900, 600))
    with Viewer(surface, small, memory=WindowMemory.load(file)) as viewer:
        viewer.frame(0.0)
        assert viewer.interface.tour.step is None
        viewer.interface.perform(Action.TOUR)
        viewer.frame(0.0)
        assert viewer.interface.tour.step == 0
    surface.close()


def test_who_used_the_window_before_there_was_a_tour_is_not_led(tmp_path):
    file = tmp_path / "window.json"
    file.write_text(json.dumps({"night": True}))
    assert WindowMemory.load(file).has_toured


def test_the_keys_of_the_tour_exist():
    chords = {chord for key in KEYS for chord in key.chords}
    named = [chord for step in STEPS for chord in re.findall(r"\{([^}]+)\}", step.text)]
    assert len(STEPS) == 6
    assert len(named) > 10
    assert set(named) <= chords


@pytest.mark.parametrize(
    ("system", "shown"), [("darwin", "Cmd+Shift+Z"), ("linux", "Ctrl+Shift+Z"), ("win32", "Ctrl+Shift+Z")]
)
def test_the_command_key_is_named_on_macos(system, shown):
    assert shown_chord("Ctrl+Shift+Z", system) == shown
