"""Speed of the window: ``poe bench window``, or ``python -m tests.bench.window``.

Plays the bundled flight without a display, with sliding exposures and the panels of the first start, in a window of
1280 x 800.  Prints for each camera

images a second    of the window, wall time
window             processor time of all threads for one image in the window, ms
alone              the same for composing and developing the same exposures alone, as exports do, in the same rounds
ratio              of the two: what the window adds, which other load on the machine hardly changes
start              processor time from the start of Python to a picture of the window, whole process, s

Rounds alternate between the window and the images alone.
"""

import argparse
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.config import Config
from glstar.system.resources import asset
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import HeadlessSurface, Viewer

PRESETS = ("picamhq-6mm-binned4", "picamhq-6mm")
WINDOW_PX = (1280, 800)
START_S, FRAME_S = 20.0, 0.02
IMAGES = 20


def main() -> None:
    """Measure, and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--rounds", type=int, default=5, help="rounds of twenty images [5]")
    arguments.add_argument("--presets", nargs="+", default=PRESETS, help="cameras")
    asked = arguments.parse_args()
    console = Console(width=120)
    console.print(
        f"glstar {__version__}, Python {platform.python_version()}, {os.cpu_count()} processors,"
        f" load {os.getloadavg()[0]:.1f}"
    )
    table = Table("image", "images a second", "window, ms", "alone, ms", "ratio", title="The bundled flight, sliding")
    for preset in asked.presets:
        table.add_row(*_measured(preset, asked.rounds))
    console.print(table)
    console.print(f"start: {_start_s():.2f} s of processor time")


def _measured(preset: str, rounds: int) -> list[str]:
    surface = HeadlessSurface(WINDOW_PX)
    with Viewer(surface, Config().override(**{"camera.preset": preset})) as viewer:
        session = viewer.session
        session.loader.start_s = START_S
        viewer.open(asset("adelaide.BIN"))
        session.wait_for_flight()
        viewer.frame(0.0)
        assert session.head is not None
        session.head.mode, session.head.loop, session.head.playing = Mode.SLIDING, True, True
        for _ in range(IMAGES):
            viewer.frame(FRAME_S)
        window, alone = [], []
        for _ in range(rounds):
            window.append(_cost(lambda: viewer.frame(FRAME_S)))
            alone.append(_cost(_drawn_alone(viewer)))
        assert session.scene is not None
        camera = session.scene.camera
    surface.close()
    wall_ms, window_ms = (statistics.median(each) for each in zip(*window, strict=True))
    alone_ms = statistics.median(processor_ms for _, processor_ms in alone)
    numbers = f"{1e3 / wall_ms:.1f}", f"{window_ms:.1f}", f"{alone_ms:.1f}", f"{window_ms / alone_ms:.2f}"
    return [f"{camera.width_px} x {camera.height_px}", *numbers]


def _drawn_alone(viewer: Viewer) -> Callable[[], object]:
    """Return what composes and develops the next image of the flight each time it is called."""
    session = viewer.session
    scene, simulator = session.scene, session.image.simulator
    assert scene is not None
    assert simulator is not None
    exposures = iter(
        [replace(scene.exposure, start_utc_s=scene.exposure.start_utc_s + k * FRAME_S) for k in range(1, IMAGES + 1)]
    )

    def draw() -> None:
        session.renderer.develop(simulator.scene(next(exposures)), seed=0)
        session.renderer.texture()
        session.renderer.context.finish()

    return draw


def _cost(work: Callable[[], object]) -> tuple[float, float]:
    """Return wall time and processor time of one image, ms: the means of some."""
    began_s, worked_s = time.perf_counter(), time.process_time()
    for _ in range(IMAGES):
        work()
    return 1e3 * (time.perf_counter() - began_s) / IMAGES, 1e3 * (time.process_time() - worked_s) / IMAGES


def _start_s() -> float:
    """Return the processor time of a process that shows the flight and saves a picture, s: the least of three."""
    import resource  # noqa: PLC0415 - not on Windows

    def spent_s() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    took_s = []
    with tempfile.TemporaryDirectory() as folder:
        picture = str(Path(folder) / "window.png")
        command = [
            sys.executable,
            "-m",
            "glstar",
            "view",
            "--headless",
            "--start",
            str(START_S),
            "--screenshot",
            picture,
        ]
        for _ in range(3):
            before_s = spent_s()
            subprocess.run([*command, "--exit", str(asset("adelaide.BIN"))], check=True, capture_output=True)
            took_s.append(spent_s() - before_s)
    return min(took_s)


if __name__ == "__main__":
    main()
