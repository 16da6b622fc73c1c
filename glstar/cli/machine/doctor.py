"""``glstar doctor``: check OpenGL, libraries and catalogues on this machine."""

import json
import os
import platform
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.errors import GlstarError
from glstar.sky.catalogue.reading import NAMES, StarCatalogue
from glstar.system.installation import broken_libraries, library_versions, missing_library

# Names of Mesa's software renderers.
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software")


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False) -> None:
    """Show OpenGL, devices, libraries and catalogues, and their problems.

    Exits with 1 if glstar cannot render.
    """
    opengl, devices, amiss = _opengl()
    libraries = library_versions()
    amiss += [missing_library(name) for name, found in libraries.items() if not found] + broken_libraries()
    facts = {
        "glstar": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        "opengl": opengl,
        "egl_devices": devices,
        "libraries": libraries,
        "catalogues": {name: _catalogue(name) for name in NAMES},
        "amiss": amiss,
    }
    if as_json:
        typer.echo(json.dumps(facts, indent=1))
    else:
        _print(facts)
    if "error" in opengl:
        raise typer.Exit(1)


def machine_lines() -> list[str]:
    """Return Python, the system and the OpenGL driver, in lines, for a report of a problem."""
    from glstar.render.opengl.context import headless_context  # noqa: PLC0415 - OpenGL, when it is needed

    try:
        context = headless_context()
    except GlstarError as error:
        driver = f"none: {error}"
    else:
        with context:
            driver = ", ".join(str(context.info[name]) for name in ("GL_RENDERER", "GL_VENDOR", "GL_VERSION"))
        context.release()
    return [f"Python {platform.python_version()}, {platform.system()} {platform.machine()}", f"OpenGL {driver}"]


def _opengl() -> tuple[dict[str, Any], list[dict[str, Any]], list[str]]:
    """Return the properties of OpenGL, its devices, and messages about problems."""
    from glstar.render.opengl.context import egl_devices, headless_context  # noqa: PLC0415 - OpenGL

    amiss: list[str] = []
    try:
        devices = [asdict(device) for device in egl_devices()]
    except GlstarError as error:
        devices = []
        amiss.append(str(error))
    try:
        context = headless_context()
    except GlstarError as error:
        return {"error": str(error)}, devices, [*amiss, str(error)]
    with context:
        info = context.info
        opengl = {
            "renderer": info["GL_RENDERER"],
            "vendor": info["GL_VENDOR"],
            "version": info["GL_VERSION"],
            "largest_texture_px": info["GL_MAX_TEXTURE_SIZE"],
            "largest_sprite_px": info["GL_POINT_SIZE_RANGE"][1],
        }
    context.release()
    if any(word in opengl["renderer"].lower() for word in _SOFTWARE):
        others = [device["index"] for device in devices if not device["software"]]
        remedy = f"try GLSTAR_DEVICE={others[0]}" if others else "no device with a GPU answers; see its driver"
        amiss.append(f"{opengl['renderer']} draws in software: right, but 10 to 100 times slower than a GPU; {remedy}")
    return opengl, devices, amiss


def _catalogue(name: str) -> str:
    try:
        stars = StarCatalogue.open(name)
    except GlstarError as error:
        return str(error)
    return f"{stars.count} stars, {stars.path}" + (f"; {stars.note}" if stars.note else "")


def _print(facts: dict[str, Any]) -> None:
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("glstar", facts["glstar"])
    table.add_row("Python", facts["python"])
    table.add_row("system", facts["system"])
    for key, value in facts["opengl"].items():
        table.add_row(f"OpenGL {key.replace('_', ' ')}", str(value))
    for device in facts["egl_devices"]:
        kind = "software" if device["software"] else "GPU"
        cuda = "" if device["cuda"] is None else f", CUDA {device['cuda']}"
        table.add_row(f"EGL device {device['index']}", f"{device['vendor']}, {kind}, {device['drm'] or 'no DRM'}{cuda}")
    for name, found in facts["libraries"].items():
        table.add_row(name, found or "not installed")
    for name, found in facts["catalogues"].items():
        table.add_row(f"catalogue {name}", found)
    console = Console(soft_wrap=True, highlight=False)
    console.print(table)
    for sentence in facts["amiss"]:
        console.print(f"! {sentence}", markup=False)
    if not facts["amiss"]:
        console.print("all is well")
