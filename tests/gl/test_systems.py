"""Advice about OpenGL that applies to the system at hand."""

import pytest

from glstar.errors import ContextError
from glstar.render.opengl import context
from glstar.render.opengl import context as devices


@pytest.mark.parametrize(
    ("system", "words", "others"),
    [
        ("linux", "apt-get install libgl1 libegl1", "macOS"),
        ("win32", "GLCONTEXT_WIN_LIBGL", "apt-get"),
        ("darwin", "macOS has OpenGL of its own", "apt-get"),
    ],
)
def test_advice_names_what_the_system_has(
    monkeypatch: pytest.MonkeyPatch, system: str, words: str, others: str
) -> None:
    monkeypatch.setattr(context.sys, "platform", system)

    for message in ("libGL.so not loaded", "cannot create context"):
        advice = context._advice(message)
        assert words in advice
        assert others not in advice


@pytest.mark.parametrize(
    ("system", "words"), [("linux", "LIBGL_ALWAYS_SOFTWARE=1"), ("win32", "GLCONTEXT_WIN_LIBGL"), ("darwin", "macOS")]
)
def test_an_old_gpu_is_offered_software(monkeypatch: pytest.MonkeyPatch, system: str, words: str) -> None:
    monkeypatch.setattr(context.sys, "platform", system)

    advice = context._advice("eglCreateContext failed (0x3009)")

    assert "older than 3.3" in advice
    assert words in advice


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_systems_without_egl_have_no_egl_devices_and_no_fault(monkeypatch: pytest.MonkeyPatch, system: str) -> None:
    monkeypatch.setattr(devices.ctypes.util, "find_library", lambda name: None)
    with pytest.raises(ContextError, match="libEGL"):
        devices.egl_devices()

    monkeypatch.setattr(devices.sys, "platform", system)

    assert devices.egl_devices() == []
