"""The window's surface, by a double of GLFW: its sizes, events, full screen, and why there may be none."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.errors import ContextError, RenderError
from glstar.viewer import window
from glstar.viewer.window import WindowSurface

ALTERNATIVES = "glstar view --headless --screenshot FILE draws without a window, glstar export writes frames"


class Glfw:
    """Notes what is called; answers are set by name."""

    CONTEXT_VERSION_MAJOR, CONTEXT_VERSION_MINOR, OPENGL_PROFILE, OPENGL_FORWARD_COMPAT = range(4)
    OPENGL_CORE_PROFILE, VERSION_UNAVAILABLE, API_UNAVAILABLE = 32, 65, 66

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.answers: dict[str, Any] = {"init": True, "create_window": "window", "get_error": (0, None)}

    def __getattr__(self, name: str) -> Any:
        return lambda *what: self.done.append((name, *what)) or self.answers.get(name)


@pytest.fixture
def glfw(monkeypatch: pytest.MonkeyPatch) -> Glfw:
    glfw = Glfw()
    monkeypatch.setattr(window, "glfw", glfw)
    monkeypatch.setattr(
        window, "adopt_context", lambda: SimpleNamespace(release=lambda: glfw.done.append("released"), screen="screen")
    )
    return glfw


def test_a_window_has_a_core_context_and_is_closed_once(glfw: Glfw) -> None:
    surface = WindowSurface((900, 600))
    assert [what[1:] for what in glfw.done if what[0] == "window_hint"] == [(0, 3), (1, 3), (2, 32), (3, 1)]
    assert ("create_window", 900, 600, "glstar", None, None) in glfw.done
    assert ("swap_interval", 0) in glfw.done
    surface._drop(None, ["a", "b"])
    surface._drop(None, ["c"])
    assert [surface.dropped(), surface.dropped()] == [[Path("a"), Path("b"), Path("c")], []]
    glfw.answers |= {"get_framebuffer_size": (1800.0, 1200.0), "get_window_size": (900.0, 600.0)}
    glfw.answers |= {"get_window_content_scale": (3.0, 2.0), "window_should_close": 1}
    assert (surface.size, surface.window_size, surface.scale, surface.should_close) == (
        (1800, 1200),
        (900, 600),
        1.5,
        True,
    )
    assert surface.target == "screen"
    for _ in range(2):
        surface.close()
    assert glfw.done[-3:] == ["released", ("destroy_window", "window"), ("terminate",)]
    assert glfw.done.count(("terminate",)) == 1


def test_waiting_reports_whether_there_was_an_event(glfw: Glfw) -> None:
    surface = WindowSurface((900, 600))
    assert surface.wait(0.0)
    assert glfw.done[-1] == ("poll_events",)
    for waited_s, event in ((0.5, False), (0.48, False), (0.47, True)):
        times = iter((7.0, 7.0 + waited_s))
        glfw.get_time = lambda times=times: next(times)
        assert surface.wait(0.5) == event
        assert glfw.done[-1] == ("wait_events_timeout", 0.5)


def test_a_full_screen_returns_to_its_window(glfw: Glfw) -> None:
    surface = WindowSurface((900, 600))
    glfw.answers |= {"get_window_pos": (11, 22), "get_window_size": (900, 600), "get_primary_monitor": "monitor"}
    glfw.answers["get_video_mode"] = SimpleNamespace(size=(1920, 1080), refresh_rate=75)
    surface.set_full_screen(False)
    assert not [what for what in glfw.done if what[0] == "set_window_monitor"]
    surface.set_full_screen(True)
    assert glfw.done[-1] == ("set_window_monitor", "window", "monitor", 0, 0, 1920, 1080, 75)
    glfw.answers["get_window_size"] = (1920, 1080)
    assert surface.window_size == (900, 600)
    count = len(glfw.done)
    surface.set_full_screen(True)
    assert len(glfw.done) == count
    surface.set_full_screen(False)
    assert glfw.done[-1] == ("set_window_monitor", "window", None, 11, 22, 900, 600, 0)
    assert surface.window_size == (1920, 1080)


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"init": False, "get_error": (1, b"no X")}, f"no display to open a window on: no X. {ALTERNATIVES}"),
        ({"init": False}, f"no display to open a window on: the system does not say why. {ALTERNATIVES}"),
        (
            {"create_window": None, "get_error": (65, "3.1")},
            "this display's OpenGL is older than 3.3, which glstar needs: 3.1; 'glstar doctor' shows the driver",
        ),
        (
            {"create_window": None, "get_error": (66, "no GLX")},
            f"this display draws no OpenGL (X11 without GLX?): no GLX. {ALTERNATIVES}",
        ),
        ({"create_window": None, "get_error": (67, "x")}, f"no window: x. {ALTERNATIVES}"),
    ],
)
def test_it_is_said_why_there_is_no_window(glfw: Glfw, answers: dict[str, Any], message: str) -> None:
    glfw.answers |= answers
    with pytest.raises(ContextError) as caught:
        WindowSurface((900, 600))
    assert str(caught.value) == message
    assert (("terminate",) in glfw.done) == ("create_window" in answers)


def test_a_window_whose_context_is_refused_is_closed(glfw: Glfw, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise RenderError("too old")

    monkeypatch.setattr(window, "adopt_context", refuse)
    with pytest.raises(RenderError, match="too old"):
        WindowSurface((900, 600))
    assert glfw.done[-2:] == [("destroy_window", "window"), ("terminate",)]
