"""The command palette finds every action of the menus, and the size of the text."""

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.viewer.session.keys import KEYS, Action
from glstar.viewer.session.memory import WindowMemory
from glstar.viewer.ui.search import matching_actions
from glstar.viewer.ui.theme import resized_text
from tests.support.windowinput import press, screen, type_text


def test_every_action_is_found_by_its_label():
    for key in KEYS:
        assert key in matching_actions(key.label)
        assert matching_actions(f"{key.menu} {key.label}".upper())[0].menu == key.menu


@pytest.mark.parametrize(
    ("query", "action"),
    [("play", Action.PLAY), ("night", Action.NIGHT), ("undo", Action.UNDO), ("side by", Action.SIDE_BY_SIDE)],
)
def test_the_first_match_is_the_expected_one(query, action):
    assert matching_actions(query)[0].action is action


def test_words_that_no_command_has_find_nothing():
    assert matching_actions("warp drive") == []


def test_a_command_is_performed_from_the_palette(viewer):
    press(viewer, "Ctrl+P")
    type_text(viewer, "night")
    press(viewer, "Enter")
    viewer.frame(0.0)
    assert viewer.session.night
    assert screen(viewer)[..., 1:].max() == 0


def test_escape_closes_the_palette_and_letters_are_not_keys(viewer):
    press(viewer, "Ctrl+P")
    type_text(viewer, "n")
    press(viewer, "Escape")
    assert not viewer.session.night
    press(viewer, "N")
    assert viewer.session.night


def test_text_grows_and_shrinks_within_limits(viewer):
    before = screen(viewer).copy()
    for _ in range(5):
        press(viewer, "Ctrl+Shift+=")
    assert viewer.interface.text_scale == pytest.approx(1.5)
    assert imgui.get_style().font_scale_main == pytest.approx(1.5)
    assert np.count_nonzero(screen(viewer) != before) > 1000
    press(viewer, "Ctrl+Shift+-")
    assert viewer.interface.text_scale == pytest.approx(1.4)
    assert resized_text(2.5, 1) == 2.5
    assert resized_text(0.7, -1) == 0.7


def test_the_size_of_the_text_is_remembered(tmp_path):
    memory = WindowMemory(tmp_path / "viewer.json", text_scale=1.3)
    memory.save()
    assert WindowMemory.load(memory.file).text_scale == 1.3
    memory.file.write_text('{"text_scale": "huge"}')
    assert WindowMemory.load(memory.file).text_scale == 1.0
