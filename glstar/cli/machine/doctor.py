"""Tools for the machine: ``doctor`` checks OpenGL, libraries and catalogues, ``doctor bench`` its speed."""

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.cli.tables import print_table
from glstar.errors import GlstarError
from glstar.sky.catalogue.reading import NAMES, StarCatalogue
from glstar.system.installation import broken_libraries, library_versions, missing_library
from glstar.system.process import exit_on_interrupt

if TYPE_CHECKING:
    from glstar.render.opengl import GLRenderer

# Widths of the images, px; height and focal length follow those of the bundled camera, 1014 x 760 and 967.7 px.
_WIDTHS_PX = (1014, 2028, 4056)
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


def bench(
    seconds: Annotated[
        float, typer.Option(help="Time for each measurement, s.", min=0.1, max=60, show_default="3")
    ] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Measure how many frames a second this machine draws, and draws and writes as PNG, by image size.

    A half-second exposure of the bundled flight with all stars to 6.5 mag, one process.  Figures of a machine with
    other work on it are too low.
    """
    with exit_on_interrupt():
        from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only when needed
    with GLRenderer.headless() as renderer, tempfile.TemporaryDirectory(prefix="glstar-bench-") as folder:
        driver = renderer.driver
        rows = [_rates_of(renderer, width_px, seconds, Path(folder)) for width_px in _WIDTHS_PX]
    if as_json:
        typer.echo(json.dumps({"machine": platform.machine(), "driver": str(driver), "rates": rows}))
        return
    table = Table("image, px", "drawn, 1/s", "drawn and written, 1/s", box=None)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(
            f"{row['width_px']} x {row['height_px']}", f"{row['drawn_per_s']:.1f}", f"{row['written_per_s']:.1f}"
        )
    typer.echo(f"{driver}, {platform.machine()}")
    print_table(table)


def _rates_of(renderer: "GLRenderer", width_px: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Return the rates of one image size."""
    from glstar.cli.flightoptions import log_of  # noqa: PLC0415 - doctor needs no config
    from glstar.config import Config  # noqa: PLC0415 - the same
    from glstar.export.plan.frames import ExportOptions  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.prepare import prepare_export  # noqa: PLC0415

    height_px = width_px * 760 // 1014
    size = {"width_px": width_px, "height_px": height_px}
    focal_px = 967.7425 * width_px / 1014
    numbers = {f"camera.{key}": value for key, value in {**size, "fx_px": focal_px, "fy_px": focal_px}.items()}
    job = prepare_export(Config().override(**numbers), log_of(None), folder / str(width_px), ExportOptions())
    count = len(job.numbers)

    def draw(number: int) -> object:
        return renderer.render(job.task.frames.compose(number).scene, seed=number)

    def write(number: int) -> object:
        frame = job.task.draw(renderer, number)
        return (folder / "frame").write_bytes(frame.image)

    draw(0)  # the first frame also compiles shaders
    return {**size, "drawn_per_s": _rate(draw, count, seconds), "written_per_s": _rate(write, count, seconds)}


def _rate(work: Callable[[int], object], count: int, seconds: float) -> float:
    """Return how often a second something can be done, after doing it once."""
    work(0)
    began_s, done = time.perf_counter(), 0
    while (elapsed_s := time.perf_counter() - began_s) < seconds:
        work(done % count)
        done += 1
    return round(done / elapsed_s, 2)
