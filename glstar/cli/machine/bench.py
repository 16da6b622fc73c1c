"""``glstar bench``: how fast this machine draws and writes frames."""

import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from glstar.cli.flightoptions import log_of
from glstar.config import Config
from glstar.system.process import exit_on_interrupt

if TYPE_CHECKING:
    from glstar.render.opengl import GLRenderer


# Widths of the images, px; height and focal length follow those of the bundled camera, 1014 x 760 and 967.7 px.
_WIDTHS_PX = (1014, 2028, 4056)


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
        rows = [_row(renderer, width_px, seconds, Path(folder)) for width_px in _WIDTHS_PX]
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
    console = Console(width=None if sys.stdout.isatty() else 120, highlight=False, markup=False)
    console.print(f"{driver}, {platform.machine()}")
    console.print(table)


def _row(renderer: "GLRenderer", width_px: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Return the rates of one image size."""
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
