"""Creation and adoption of OpenGL contexts; nothing else in glstar creates one."""

import os
import sys
from typing import TYPE_CHECKING, Any

from glstar.errors import ContextError
from glstar.system.heap import keep_freed_memory
from glstar.system.installation import OPENGL_ON_LINUX

if TYPE_CHECKING:
    import moderngl

__all__ = ["REQUIRED_GL", "adopt_context", "headless_context"]

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
    """Return a new OpenGL context that needs no display.

    Parameters
    ----------
    device_index : int, optional
        Index of the EGL device, as listed by ``glstar doctor``; by default that of the environment variable
        GLSTAR_DEVICE, or else the driver's choice.

    Returns
    -------
    moderngl.Context
        Owned by the caller.

    Raises
    ------
    ContextError
        If there is no OpenGL 3.3; the message names what to install.
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

    Returns
    -------
    moderngl.Context

    Raises
    ------
    ContextError
        If none is current, or it is older than OpenGL 3.3.
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
