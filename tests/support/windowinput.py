"""The keyboard and the mouse of tests of the window, through ImGui."""

import numpy as np
from imgui_bundle import imgui

from glstar.viewer.ui.interface import parse_chord

HELD_KEYS = {imgui.Key.mod_ctrl: imgui.Key.left_ctrl, imgui.Key.mod_shift: imgui.Key.left_shift}


def press(viewer, chord: str) -> None:
    """Press a key as a keyboard does, and draw the two frames in which its effect must show."""
    io = imgui.get_io()
    code, modifiers = parse_chord(chord)
    held = [key for key in HELD_KEYS if modifiers & int(key)]
    for down in (True, False):
        for key in held:
            io.add_key_event(key, down)
            io.add_key_event(HELD_KEYS[key], down)
        io.add_key_event(code, down)
        viewer.frame(0.0)


def screen(viewer) -> np.ndarray:
    """Return what the window shows: (height, width, 3) uint8."""
    width, height = viewer._surface.size
    return np.frombuffer(viewer._surface.target.read(components=3), np.uint8).reshape(height, width, 3)


def type_text(viewer, text: str) -> None:
    """Type letters, each in a frame of its own, and draw the two frames in which their effect must show."""
    for letter in text:
        imgui.get_io().add_input_character(ord(letter))
        viewer.frame(0.0)
    viewer.frame(0.0)
    viewer.frame(0.0)


def click(viewer, x_px: float, y_px: float) -> None:
    """Click on a position of the image, which fills the window meanwhile."""
    press(viewer, "H")
    x, y = viewer.session.view.to_screen([x_px, y_px]).tolist()
    io = imgui.get_io()
    for event in (
        lambda: io.add_mouse_pos_event(x, y),
        lambda: io.add_mouse_button_event(0, True),
        lambda: io.add_mouse_button_event(0, False),
        lambda: io.add_mouse_pos_event(-1.0, -1.0),
    ):
        event()
        viewer.frame(0.0)
    press(viewer, "H")
