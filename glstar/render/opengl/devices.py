"""The EGL devices of this machine."""

import ctypes
import ctypes.util
import sys
from dataclasses import dataclass
from typing import Any, Final

from glstar.errors import ContextError
from glstar.system.installation import OPENGL_ON_LINUX

__all__ = ["EGLDevice", "egl_devices"]

# Names from eglext.h.
_EGL_VENDOR: Final = 0x3053
_EGL_EXTENSIONS: Final = 0x3055
_EGL_DRM_DEVICE_FILE_EXT: Final = 0x3233
_EGL_CUDA_DEVICE_NV: Final = 0x323A
_EGL_PLATFORM_DEVICE_EXT: Final = 0x313F


@dataclass(frozen=True, slots=True)
class EGLDevice:
    """One device that EGL can draw with.

    Attributes
    ----------
    index : int
        Its value of GLSTAR_DEVICE.
    vendor : str
    drm : str or None
        Path of its device file.
    cuda : int or None
        Its CUDA device number, which may differ from its index.
    software : bool
        Whether it is a software renderer.
    """

    index: int
    vendor: str
    drm: str | None
    cuda: int | None
    software: bool


def egl_devices() -> list[EGLDevice]:
    """Return the EGL devices of this machine.

    Returns
    -------
    list of EGLDevice
        Empty if EGL does not support device enumeration, and on macOS and Windows, whose OpenGL does not use EGL.

    Raises
    ------
    ContextError
        If the EGL library is missing.
    """
    if sys.platform in {"darwin", "win32"}:
        return []
    name = ctypes.util.find_library("EGL")
    if name is None:
        raise ContextError(f"libEGL is not installed. {OPENGL_ON_LINUX}")
    egl = ctypes.CDLL(name)
    egl.eglQueryString.restype = ctypes.c_char_p
    egl.eglQueryString.argtypes = [ctypes.c_void_p, ctypes.c_int]
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    if b"EGL_EXT_device_enumeration" not in (egl.eglQueryString(None, _EGL_EXTENSIONS) or b"") and (
        b"EGL_EXT_device_base" not in (egl.eglQueryString(None, _EGL_EXTENSIONS) or b"")
    ):
        return []
    query_devices = _function(
        egl, "eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
    )
    count = ctypes.c_int()
    query_devices(0, None, ctypes.byref(count))
    handles = (ctypes.c_void_p * max(count.value, 1))()
    query_devices(count.value, handles, ctypes.byref(count))
    return [_device(egl, index, handles[index]) for index in range(count.value)]


def _function(egl: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Any:
    """Return a function of an extension, which libEGL does not export by name."""
    return ctypes.CFUNCTYPE(result, *arguments)(egl.eglGetProcAddress(name.encode()))


def _device(egl: ctypes.CDLL, index: int, handle: int | None) -> EGLDevice:
    query_string = _function(egl, "eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)
    query_attribute = _function(
        egl, "eglQueryDeviceAttribEXT", ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_ssize_t)
    )
    extensions = query_string(handle, _EGL_EXTENSIONS) or b""
    drm = query_string(handle, _EGL_DRM_DEVICE_FILE_EXT) if b"EGL_EXT_device_drm" in extensions else None
    cuda = ctypes.c_ssize_t(-1)
    if b"EGL_NV_device_cuda" in extensions:
        query_attribute(handle, _EGL_CUDA_DEVICE_NV, ctypes.byref(cuda))
    return EGLDevice(
        index=index,
        vendor=_vendor(egl, handle),
        drm=None if drm is None else drm.decode(),
        cuda=None if cuda.value < 0 else cuda.value,
        software=b"EGL_MESA_device_software" in extensions,
    )


def _vendor(egl: ctypes.CDLL, handle: int | None) -> str:
    get_display = _function(
        egl, "eglGetPlatformDisplayEXT", ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p
    )
    egl.eglInitialize.argtypes = [ctypes.c_void_p] * 3
    egl.eglTerminate.argtypes = [ctypes.c_void_p]
    display = get_display(_EGL_PLATFORM_DEVICE_EXT, handle, None)
    if not egl.eglInitialize(display, None, None):
        return "does not start"
    try:
        return (egl.eglQueryString(display, _EGL_VENDOR) or b"unknown").decode()
    finally:
        egl.eglTerminate(display)
