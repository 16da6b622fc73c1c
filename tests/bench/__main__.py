"""How long a frame takes: ``poe bench``, or ``python -m tests.bench``.

Prints the machine, then for each image size the median and the best of some rounds of

scene       where the camera looks in each sub-exposure, and which stars it sees (`Simulator.scene`)
frame       from the scene to an array of 8-bit pixels (`GLRenderer.render`)
reference   the same in plain NumPy (`ReferenceRenderer`), once, where it takes less than a minute
export      scene, frame, PNG and truth, in memory (`Export.draw`)

over Adelaide at night: the bright stars to 6.5, rolling at 10 deg/s, sigma 1.2 px, half a second; in a field with as
many stars as the sky has on average, and in one full of the Milky Way.
"""

import argparse
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.export import Export, FlightFrames, Plan, PlannedFrame
from glstar.exposure import Exposure
from glstar.gl import GLRenderer
from tests.reference import ReferenceRenderer
from tests.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

# Width, height, focal length (px), sub-exposures a second, and whether NumPy is waited for.
SIZES = ((1014, 760, 967.7425, 200.0, True), (2028, 1520, 1935.485, 400.0, False), (4056, 3040, 3870.97, 800.0, False))

# The bank at which the camera, looking out of the aircraft's top, sees such a field.
FIELDS = {"average": np.deg2rad(-50.0), "Milky Way": 0.0}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--rounds", type=int, default=30)
    arguments.add_argument("--deg-per-s", type=float, default=10.0)
    asked = arguments.parse_args()

    console = Console(width=140)
    with GLRenderer.headless() as renderer:
        console.print(f"glstar {__version__}, Python {platform.python_version()}, NumPy {np.__version__}")
        console.print(f"{platform.machine()}, {os.cpu_count()} processors; {renderer.driver}")
        table = Table(title="milliseconds: median (best)")
        for column in (
            "image",
            "field",
            "stars",
            "sub-exposures",
            "scene",
            "frame",
            "reference",
            "times faster",
            "export",
        ):
            table.add_column(column, justify="right")
        for field, roll_rad in FIELDS.items():
            for size in SIZES:
                row = _row(renderer, *size, roll_rad=roll_rad, deg_per_s=asked.deg_per_s, rounds=asked.rounds)
                table.add_row(row[0], field, *row[1:])
        console.print(table)
    console.print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def _row(
    renderer: GLRenderer,
    width_px: int,
    height_px: int,
    f_px: float,
    rate_hz: float,
    waits_for_numpy: bool,
    *,
    roll_rad: float,
    deg_per_s: float,
    rounds: int,
) -> list[str]:
    simulator = sky_over_adelaide(
        camera(width_px, height_px, f_px), roll_rad=roll_rad, roll_rate_rad_per_s=np.deg2rad(deg_per_s)
    )
    exposure = Exposure(NIGHT_UTC_S + 0.2, 0.5, rate_hz)
    scene = simulator.scene(exposure)
    planned = PlannedFrame(0, exposure)
    job = Export(FlightFrames(simulator, Plan((planned,), ())), Path(), {}, "png", light=False, seed=0)
    frame_ms = _milliseconds(lambda: renderer.render(scene, seed=0), rounds)
    reference_ms = _milliseconds(lambda: ReferenceRenderer().render(scene, seed=0), 1) if waits_for_numpy else None
    return [
        f"{width_px} x {height_px}",
        str(scene.visible.size),
        str(len(scene.pointing)),
        _told(_milliseconds(lambda: simulator.scene(exposure), rounds)),
        _told(frame_ms),
        "" if reference_ms is None else f"{reference_ms[0]:.0f}",
        "" if reference_ms is None else f"{reference_ms[0] / statistics.median(frame_ms):.0f}",
        _told(_milliseconds(lambda: job.draw(renderer, 0), max(3, rounds // 3))),
    ]


def _milliseconds(work: Callable[[], object], rounds: int) -> list[float]:
    if rounds > 1:
        work()  # the first round compiles shaders and makes targets
    times = []
    for _ in range(rounds):
        began_s = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - began_s))
    return times


def _told(times_ms: list[float]) -> str:
    return f"{statistics.median(times_ms):.1f} ({min(times_ms):.1f})"


if __name__ == "__main__":
    main()
