"""OpenGL contexts, which nothing else in glstar creates, and the EGL devices of this machine."""

import ctypes.util
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from glstar.errors import ContextError
from glstar.system.installation import OPENGL_ON_LINUX
from glstar.system.process import keep_freed_memory

if TYPE_CHECKING:
    import moderngl


# OpenGL 3.3 core, which macOS, Mesa's software drivers and every GPU of the last fifteen years support.
REQUIRED_GL = 330

# How to get OpenGL, by the system.
_REMEDIES = {
    "darwin": "macOS has OpenGL of its own, but a session without a screen, such as ssh, may have none",
    "win32": (
        "install the driver of the GPU, or set GLCONTEXT_WIN_LIBGL to the opengl32.dll of Mesa for Windows,"
        " which draws in software"
    ),
    "linux": OPENGL_ON_LINUX,
}
# What to do on a GPU without OpenGL 3.3, such as that of a Raspberry Pi 5.
_SOFTWARE = "LIBGL_ALWAYS_SOFTWARE=1 draws with Mesa's software renderer instead"


def headless_context(device_index: int | None = None) -> "moderngl.Context":
    """Return a new OpenGL context, which needs no display and belongs to the caller.

    `device_index` of an EGL device is as listed by ``glstar doctor``; by default the device of the environment variable
    GLSTAR_DEVICE, or else the driver's choice.  Raises ContextError if there is no OpenGL 3.3; the message names what
    to install.
    """
    import moderngl  # noqa: PLC0415 - importing glstar loads no OpenGL

    if device_index is None and "GLSTAR_DEVICE" in os.environ:
        device_index = _device_of_environment(os.environ["GLSTAR_DEVICE"])
    # Linux needs EGL to draw without a display; macOS and Windows have a single backend.
    settings: dict[str, Any] = {"backend": "egl"} if sys.platform == "linux" else {}
    if device_index is not None:
        settings["device_index"] = device_index
    keep_freed_memory()  # software OpenGL allocates and frees tens of megabytes per frame
    try:
        return moderngl.create_context(require=REQUIRED_GL, standalone=True, **settings)
    except Exception as error:  # moderngl raises bare exceptions, which differ only in their messages
        raise ContextError(_advice(str(error))) from error


def adopt_context() -> "moderngl.Context":
    """Return the OpenGL context that is current on this thread: a window's.

    Raises ContextError if none is current, or it is older than OpenGL 3.3.
    """
    import moderngl  # noqa: PLC0415 - importing glstar loads no OpenGL

    try:
        return moderngl.create_context(require=REQUIRED_GL)
    except Exception as error:  # as above
        raise ContextError(_advice(str(error))) from error


def _device_of_environment(text: str) -> int:
    try:
        return int(text.split(",", maxsplit=1)[0])  # a list is for several workers
    except ValueError:
        raise ContextError(f"GLSTAR_DEVICE={text!r} is not a number; 'glstar doctor' lists the devices") from None


def _advice(driver_message: str) -> str:
    """Return an explanation of the driver's message and a remedy."""
    message = driver_message.strip()
    remedy = _REMEDIES.get(sys.platform, _REMEDIES["linux"])
    if "not loaded" in message or "not found" in message:
        return f"no OpenGL to draw with: {message}. {remedy}"
    if "requested device index" in message:
        return (
            f"no such EGL device: {message}; 'glstar doctor' lists them."
            " In a container of NVIDIA's: NVIDIA_DRIVER_CAPABILITIES=all"
        )
    if "eglCreateContext" in message:
        instead = remedy if sys.platform in {"darwin", "win32"} else _SOFTWARE
        return f"this OpenGL is older than 3.3, which glstar needs: {message}; {instead}; 'glstar doctor' shows more"
    return f"no OpenGL to draw with: {message}. {remedy}; 'glstar doctor' shows more"


# Names from eglext.h.
_EGL_VENDOR = 0x3053
_EGL_EXTENSIONS = 0x3055
_EGL_DRM_DEVICE_FILE_EXT = 0x3233
_EGL_CUDA_DEVICE_NV = 0x323A
_EGL_PLATFORM_DEVICE_EXT = 0x313F


@dataclass(frozen=True, slots=True)
class EGLDevice:
    """One device that EGL can draw with."""

    index: int  # Its value of GLSTAR_DEVICE
    vendor: str
    drm: str | None  # Path of its device file
    cuda: int | None  # Its CUDA device number, which may differ from its index
    software: bool  # Whether it is a software renderer


def egl_devices() -> list[EGLDevice]:
    """Return the EGL devices of this machine; none if EGL cannot enumerate them, and on macOS and Windows.

    Raises ContextError if the EGL library is missing.
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
