"""The window is painted where it has changed, with the pixels that painting all of it gives."""

import random

import numpy as np
from imgui_bundle import imgui

from glstar.viewer.flight.playhead import Mode
from glstar.viewer.ui.painting import Rect


def shown(viewer) -> np.ndarray:
    width, height = viewer._surface.size
    return np.frombuffer(viewer._surface.target.read(components=3), np.uint8).reshape(height, width, 3)


def settle(viewer) -> None:
    for _ in range(4):
        viewer.frame(0.0)


def painted_completely(viewer) -> np.ndarray:
    """Return the window with the frame drawn last, painted completely."""
    picture = viewer.interface._image._picture
    viewer.interface.window_copy._inputs = ()
    picture._is_shown = picture._picture is not None
    viewer.interface.paint(viewer._surface.target, viewer._surface.size)
    return shown(viewer)


def test_what_has_not_changed_is_not_painted_again(viewer):
    settle(viewer)
    before = shown(viewer)
    viewer.frame(0.0)
    assert viewer.interface.window_copy.painted == []
    np.testing.assert_array_equal(shown(viewer), before)


def test_a_step_of_the_play_head_paints_image_and_timeline_and_not_the_settings(viewer):
    settle(viewer)
    settings = next(each for each in viewer.interface.window_copy._windows if each.name == "Settings").rect
    viewer.session.head.step_exposures(1)
    viewer.frame(0.0)
    painted = viewer.interface.window_copy.painted
    assert painted
    assert not any(rect.meets(settings) for rect in painted)
    np.testing.assert_array_equal(shown(viewer), painted_completely(viewer))


def test_painted_parts_give_the_pixels_of_the_complete_window(viewer):
    """Mouse, keys, messages, playing and night mode in any order."""
    rng, session = random.Random(5), viewer.session
    io, parts = imgui.get_io(), 0
    actions = (
        session.head.toggle,
        lambda: setattr(session.head, "mode", rng.choice(list(Mode))),
        lambda: io.add_mouse_pos_event(rng.uniform(0, 900), rng.uniform(0, 600)),
        lambda: io.add_mouse_wheel_event(0, rng.choice([-1, 1])),
        lambda: session.notify(f"message {rng.random()}"),
        lambda: setattr(session, "night", not session.night),
        lambda: setattr(session, "stretch", session.stretch.brighter(1.2)),
        lambda: imgui.set_window_focus(rng.choice(["Settings", "View", "Flight", "Object"])),
    )
    for _ in range(80):
        rng.choice(actions)()
        viewer.frame(0.02)
        parts += viewer.interface.window_copy.painted not in ([], [(0, 0, 900, 600)])
        frame = shown(viewer)
        np.testing.assert_array_equal(frame, painted_completely(viewer))
    assert parts > 5


def test_rectangles_meet_where_they_share_a_pixel():
    assert Rect(0, 0, 10, 10).meets(Rect(9, 9, 12, 12))
    assert not Rect(0, 0, 10, 10).meets(Rect(10, 0, 12, 10))
    assert Rect(0, 0, 2, 2).around(Rect(5, 6, 7, 8)) == (0, 0, 7, 8)
