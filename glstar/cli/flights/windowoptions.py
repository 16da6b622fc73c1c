"""Options of the commands that open the viewer's window, and the calibration that the window offers."""

import json
import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from glstar.errors import ContextError
from glstar.system.files import write_atomically
from glstar.system.installation import OPENGL_ON_LINUX, missing_library
from glstar.system.userinput import did_you_mean

if TYPE_CHECKING:
    from glstar.viewer.loop import Surface
    from glstar.viewer.overlays.table import Overlay
    from glstar.viewer.picture.fitting import CalibratedPhoto, CalibrationProgress, CalibrationRequest
    from glstar.viewer.session.memory import WindowMemory


_DEFAULT_SIZE = (1280, 800)

Show = Annotated[
    str | None,
    typer.Option(
        help="Overlays of the image, as in the menu Overlays, separated by commas: names of stars, constellations,"
        " ... or nothing.",
        show_default="star names",
    ),
]
Size = Annotated[
    str | None,
    typer.Option(help="Width and height of the window, px.", show_default="as last time, at first 1280x800"),
]
Screenshot = Annotated[Path | None, typer.Option(help="Write a picture of the window (PNG).", show_default=False)]
Stats = Annotated[
    Path | None, typer.Option(help="Write how long the frames took while playing, as JSON.", show_default=False)
]
Headless = Annotated[
    bool, typer.Option("--headless", help="Open no window: for --screenshot and --stats without a display.")
]


def size_of(text: str | None, memory: "WindowMemory | None" = None) -> tuple[int, int]:
    """Parse the size of a window, such as ``"1280x800"``; the default is the size of the last window in `memory`."""
    if text is None:
        return (memory.size if memory is not None else None) or _DEFAULT_SIZE
    match = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    if not match:
        raise typer.BadParameter(f"{text!r} is not a size; write 1280x800", param_hint="--size")
    return int(match[1]), int(match[2])


def overlays_of(text: str | None) -> "frozenset[Overlay] | None":
    """Parse a list of overlays, separated by commas; None, the default overlays, without one."""
    if text is None:
        return None
    from glstar.viewer.overlays.table import Overlay  # noqa: PLC0415 - only if a command opens a window

    overlays = {overlay.value: overlay for overlay in Overlay} | Overlay.named()
    names = {name.strip().lower() for name in text.split(",")} - {"", "nothing"}
    unknown = names - overlays.keys()
    if unknown:
        listed, near = ", ".join(Overlay.named()), did_you_mean(min(unknown), overlays, or_else="")
        raise typer.BadParameter(f"{min(unknown)!r}{near} is none of {listed}", param_hint="--show")
    return frozenset(overlays[name] for name in names)


def require_window_libraries() -> None:
    """Import the libraries of the window, which not every system has.

    Raises ContextError if one is missing or cannot be loaded.
    """
    try:
        # Only if a window is opened; before glfw: the two then share one library.
        import_module("imgui_bundle")
        import_module("glfw")
    except ImportError as error:
        package = {"imgui_bundle": "imgui-bundle", "glfw": "glfw"}.get(error.name or "")
        if isinstance(error, ModuleNotFoundError) and package is not None:
            reason = missing_library(package)
        else:
            remedy = OPENGL_ON_LINUX if ".so" in str(error) else "'glstar doctor' shows more"
            reason = f"{error}; {remedy}"
        raise ContextError(f"the window cannot be opened: {reason}. export, compare and calibrate need none") from error


def surface_of(size: tuple[int, int], *, headless: bool) -> "Surface":
    """Return the surface, of a size in px, on which the viewer draws: a window or offscreen; the caller closes it."""
    if headless:
        from glstar.viewer.loop import HeadlessSurface  # noqa: PLC0415 - imgui

        return HeadlessSurface(size)
    from glstar.viewer.window import WindowSurface  # noqa: PLC0415 - GLFW

    return WindowSurface(size)


def memory_of(name: str) -> "WindowMemory":
    """Return the memory of the last window of a command."""
    from platformdirs import user_config_path  # noqa: PLC0415 - only if a command opens a window

    from glstar.viewer.session.memory import WindowMemory  # noqa: PLC0415 - imgui, only if a command opens a window

    return WindowMemory.load(user_config_path("glstar") / f"{name}.json")


def layout_of(name: str) -> Path:
    """Return the file that stores the layout of the panels of a command."""
    from platformdirs import user_config_path  # noqa: PLC0415 - only if a command opens a window

    return user_config_path("glstar", ensure_exists=True) / f"{name}.ini"


def write_stats(path: Path, report: Mapping[str, Any]) -> None:
    """Write a report as JSON; raises ExportError if it cannot be written."""
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV

    with explain_disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (json.dumps(report, indent=1) + "\n").encode())


def calibrate_photo(request: "CalibrationRequest", progress: "CalibrationProgress") -> "CalibratedPhoto":
    """Calibrate a camera from a photograph; see `glstar.viewer.picture.fitting.CalibratePhoto`.

    Raises CalibrationError if the photograph cannot be calibrated; ConfigError if the inputs are not valid.
    """
    from glstar.cli.calibration.photo import calibration_of  # noqa: PLC0415 - SciPy, matplotlib

    return calibration_of(request, progress)
