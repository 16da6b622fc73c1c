"""Devices of EGL, by a library with three of them."""

import ctypes.util
import sys
from typing import Any

import pytest

from glstar.errors import ContextError
from glstar.render.opengl import context as contexts
from glstar.render.opengl.context import EGLDevice, egl_devices

LINUX = "Debian and Ubuntu: sudo apt-get install libgl1 libegl1"


class EGL:
    """A library with two devices: a GPU with a device file and CUDA's number, and a software renderer."""

    def __init__(self, extensions: bytes | None) -> None:
        self.extensions = extensions
        self.terminated: list[int] = []
        self.eglQueryString = self._query(lambda display, name: self.extensions if name == 0x3055 else VENDORS[display])
        self.eglGetProcAddress = self._query(lambda name: name)
        self.eglInitialize = self._query(lambda display, _major, _minor: display != 103)
        self.eglTerminate = self._query(self.terminated.append)

    @staticmethod
    def _query(function: Any) -> Any:
        def call(*arguments: Any) -> Any:
            return function(*arguments)

        return call


VENDORS = {101: b"NVIDIA", 102: None, 103: b"never"}
DEVICES = {11: b"EGL_EXT_device_drm EGL_NV_device_cuda", 12: b"EGL_MESA_device_software EGL_NV_device_cuda", 13: None}


def extension_function(_egl: Any, name: str, _result: Any, *arguments: Any) -> Any:
    """Return a function of EGL's extensions for these devices."""

    def devices(most: int, handles: Any, count: Any) -> None:
        count._obj.value = len(DEVICES)
        if handles is not None:
            assert most == len(DEVICES)
            handles[: len(DEVICES)] = list(DEVICES)

    def text(handle: int, name: int) -> bytes | None:
        return DEVICES[handle] if name == 0x3055 else {0x3233: b"/dev/dri/card1"}[name]

    def attribute(handle: int, name: int, value: Any) -> None:
        if handle == 11 and name == 0x323A:
            value._obj.value = 0

    def display(platform: int, handle: int, _settings: None) -> int:
        assert platform == 0x313F
        return handle + 90

    functions = {
        "eglQueryDevicesEXT": (devices, 3), "eglQueryDeviceStringEXT": (text, 2),
        "eglQueryDeviceAttribEXT": (attribute, 3), "eglGetPlatformDisplayEXT": (display, 3),
    }  # fmt: skip
    function, count = functions[name]
    assert len(arguments) == count
    return function


@pytest.mark.parametrize(
    ("extensions", "are_listed"),
    [
        (b"EGL_EXT_device_enumeration", True),
        (b"x EGL_EXT_device_base y", True),
        (b"EGL_EXT_other", False),
        (None, False),
    ],
)
def test_the_devices_of_egl_are_listed(
    monkeypatch: pytest.MonkeyPatch, extensions: bytes | None, are_listed: bool
) -> None:
    egl = EGL(extensions)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: {"EGL": "libEGL.so.1"}[name])
    monkeypatch.setattr(contexts.ctypes, "CDLL", lambda name: {"libEGL.so.1": egl}[name])
    monkeypatch.setattr(contexts, "_function", extension_function)
    found = egl_devices()
    expected = [
        EGLDevice(0, "NVIDIA", "/dev/dri/card1", 0, software=False),
        EGLDevice(1, "unknown", None, None, software=True),
        EGLDevice(2, "does not start", None, None, software=False),
    ]
    assert found == (expected if are_listed else [])
    assert egl.terminated == ([101, 102] if are_listed else [])
    monkeypatch.setattr(ctypes.util, "find_library", lambda _name: None)
    with pytest.raises(ContextError) as refused:
        egl_devices()
    assert str(refused.value) == f"libEGL is not installed. {LINUX}"
    for system in ("darwin", "win32"):
        monkeypatch.setattr(sys, "platform", system)
        assert egl_devices() == []
