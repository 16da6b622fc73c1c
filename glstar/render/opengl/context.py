"""The one place where an OpenGL context is made or adopted."""

import os
import sys
from typing import TYPE_CHECKING, Any

from glstar.errors import ContextError

if TYPE_CHECKING:
    import moderngl

__all__ = ["REQUIRED_GL", "adopt_context", "headless_context"]

# OpenGL 3.3 core: all that macOS, Mesa's softpipe and every GPU of the last fifteen years have.
REQUIRED_GL = 330

_PACKAGES = "Debian and Ubuntu: sudo apt-get install libgl1 libegl1"


def headless_context(device_index: int | None = None) -> "moderngl.Context":
    """Return a new OpenGL context that needs no display.

    Parameters
    ----------
    device_index : int, optional
        Which EGL device, as ``glstar doctor`` numbers them.  The environment variable GLSTAR_DEVICE says the same;
        without either the driver chooses.

    Returns
    -------
    moderngl.Context
        The caller's to release.

    Raises
    ------
    ContextError
        If there is no OpenGL 3.3; the message says what to install.
    """
    import moderngl  # noqa: PLC0415 - importing glstar loads no OpenGL

    if device_index is None and "GLSTAR_DEVICE" in os.environ:
        device_index = _device_of_environment(os.environ["GLSTAR_DEVICE"])
    # EGL is how Linux draws without a display; macOS and Windows have one way only, which needs no naming.
    settings: dict[str, Any] = {"backend": "egl"} if sys.platform == "linux" else {}
    if device_index is not None:
        settings["device_index"] = device_index
    try:
        return moderngl.create_context(require=REQUIRED_GL, standalone=True, **settings)
    except Exception as error:  # moderngl raises bare exceptions and tells them apart by their words only
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
        raise ContextError(f"GLSTAR_DEVICE={text!r} is no number; 'glstar doctor' lists the devices") from None


def _advice(driver_words: str) -> str:
    """Return what the driver's words mean and what to do about them."""
    words = driver_words.strip()
    if "not loaded" in words or "not found" in words:
        return f"no OpenGL to draw with: {words}. {_PACKAGES}"
    if "requested device index" in words:
        return (
            f"no such EGL device: {words}; 'glstar doctor' lists them."
            " In a container of NVIDIA's: NVIDIA_DRIVER_CAPABILITIES=all"
        )
    if "eglCreateContext" in words:
        return f"this OpenGL is older than 3.3, which glstar needs: {words}; 'glstar doctor' shows the driver"
    return f"no OpenGL to draw with: {words}. {_PACKAGES}; 'glstar doctor' shows more"
