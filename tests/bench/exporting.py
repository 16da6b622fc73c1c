"""How fast frames get to the disk: ``poe bench export``, or ``python -m tests.bench.exporting``.

Draws exposures of half a second with noise and truth: one every half second of the bundled flight, which turns fast and
is logged roughly, and of a steady turn at 10 deg/s; and frames spread evenly over real flights, if their logs are given
by ``--logs`` or GLSTAR_BENCH_LOGS.  Of each it prints

stages      processor time per frame of each step, one after the other on one thread: the scene, drawing,
            reading, truth, the image as a PNG, writing the files
rates       frames per second of `Export.run`: one process (steps overlap on threads), 1, 2, ... processes, and Dask;
            and the time a frame takes against the stages' sum divided by the processors: 1 where all of them are
            busy with nothing else

The start of the workers is not measured, as in an export of more than a minute.
"""

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.config import Config
from glstar.export.imagefiles.formats import encode
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import Executor, SerialExecutor
from glstar.export.run.export import Export
from glstar.export.run.prepare import prepare_export
from glstar.export.run.processes import ProcessExecutor
from glstar.flight import Flight
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from glstar.telemetry import ScriptedFlight
from tests.bench.realflights import REAL_FLIGHTS, add_logs_option, logs_of, missing_logs

EVERY_S = 0.5


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--frames", type=int, default=120)
    arguments.add_argument("--preset", default="picamhq-6mm-binned4")
    names = ["bundled", "turn", *REAL_FLIGHTS]
    arguments.add_argument("--flights", nargs="*", choices=names, default=names)
    arguments.add_argument("--workers", type=int, nargs="*", default=[1, os.cpu_count() or 1])
    arguments.add_argument("--dask", type=int, nargs="*", default=[])
    add_logs_option(arguments)
    asked = arguments.parse_args()
    console = Console(width=120)
    console.print(
        f"glstar {__version__}, Python {platform.python_version()}, {os.cpu_count()} processors,"
        f" load {os.getloadavg()[0]:.1f}"
    )
    settings = Config().override(**{"camera.preset": asked.preset, "exposure.interval_s": EVERY_S})
    logs = logs_of(asked.logs)
    for name in asked.flights:
        with TemporaryDirectory() as folder:
            directory = Path(folder) / "frames"
            if name in REAL_FLIGHTS:
                if name not in logs:
                    continue
                console.rule(REAL_FLIGHTS[name].about)
                job = _whole_flight(settings, logs[name], directory, asked.frames)
            else:
                flight = None if name == "bundled" else turning(10.0, duration_s=EVERY_S * (asked.frames + 2))
                console.rule("the bundled flight" if flight is None else "a turn at 10 deg/s, logged at 50 Hz")
                # The log names the flight, and is read where no other is given.
                options = ExportOptions(frames=asked.frames)
                job = prepare_export(settings, asset("adelaide.BIN"), directory, options, flight=flight)
            _measure(job, asked.workers, asked.dask, console)
    if message := missing_logs(asked.logs):
        console.print(message, style="bold red")


def _whole_flight(settings: Config, log: Path, directory: Path, frames: int) -> Export:
    """Return an export of some frames spread evenly over a flight."""
    flight = settings.open_flight(log)
    attitude = flight.attitude
    every_s = (attitude.last_s - attitude.first_s - settings.exposure.duration_s) / frames
    spread = settings.override(**{"exposure.interval_s": round(every_s, 3)})
    return prepare_export(spread, log, directory, ExportOptions(frames=frames), flight=flight)


def turning(deg_per_s: float, *, duration_s: float) -> Flight:
    """Return a flight that yaws at one rate, banked by 10 deg."""

    def script(t_s: np.ndarray) -> np.ndarray:
        return quaternion_from_euler(np.deg2rad(10.0), 0.0, np.deg2rad(deg_per_s) * t_s)

    site = Site(np.deg2rad(-34.93), np.deg2rad(138.60), 50.0)
    start_utc_s = parse_utc("2024-03-10T11:00:00Z")
    return ScriptedFlight(script, site, start_utc_s, duration_s, rate_hz=50.0).flight()


def _measure(export: Export, workers: list[int], dask: list[int], console: Console) -> None:
    total_ms = _stages(export, console)
    against = "against processor time / processors"
    table = Table("drawn by", "frames/s", "ms per frame", "of processors, ms", against, title="rates")
    with GLRenderer.headless() as renderer:
        _rate(table, "one process", export, SerialExecutor(renderer), total_ms)
    for count in workers:
        with ProcessExecutor(count) as executor:
            _rate(table, f"{count} workers", export, executor, total_ms)
    for count in dask:
        with _dask(count, export) as executor:
            _rate(table, f"{count} Dask workers", export, executor, total_ms)
    console.print(table)


def _stages(export: Export, console: Console) -> float:
    """Print the processor time of each step; return the sum, ms."""
    times: dict[str, list[float]] = {}

    def timed(step: str, work: Callable[[], object]) -> object:
        began_s = time.process_time()
        result = work()
        times.setdefault(step, []).append(1e3 * (time.process_time() - began_s))
        return result

    path = export.directory.parent / "a.png"
    task, numbers = export.task, export.numbers.tolist()
    with GLRenderer.headless() as renderer:
        console.print(renderer.driver)
        task.draw(renderer, numbers[0])  # compiles the shaders
        for number in numbers[:: max(1, len(numbers) // 40)]:
            composed = timed("scene", lambda number=number: task.frames.compose(number))
            pending = timed("draw", lambda composed=composed: task.begin(renderer, composed))
            frame = timed("read", pending.frame)
            line = timed(
                "truth", lambda c=composed, f=frame: frame_truth(c.scene, f, number=c.number, file="frame.png")
            )
            image = timed("PNG", lambda frame=frame: encode(frame.pixels, "png"))
            timed("write", lambda content=image + line: path.write_bytes(content))
    table = Table("step", "median ms", "mean ms", "fraction of the mean", title="processor time per frame")
    means = {step: statistics.fmean(values) for step, values in times.items()}
    total_ms = sum(means.values())
    for step, values in times.items():
        table.add_row(
            step, f"{statistics.median(values):.1f}", f"{means[step]:.1f}", f"{100 * means[step] / total_ms:.0f} %"
        )
    table.add_row("all", "", f"{total_ms:.1f}", "100 %")
    console.print(table)
    console.print(f"OpenCV's PNG of the same: {_opencv_ms(frame.pixels):.1f} ms")
    return total_ms


def _opencv_ms(pixels: NDArray[Any]) -> float:
    """Return the processor time of OpenCV's PNG of an image, ms."""
    times = []
    for _ in range(10):
        began_s = time.process_time()
        cv2.imencode(".png", pixels)
        times.append(1e3 * (time.process_time() - began_s))
    return statistics.median(times)


def _moved(export: Export, name: str) -> Export:
    """Return the same export into a directory of its own."""
    return export.into(export.directory.parent / name.replace(" ", "-"))


def _rate(table: Table, name: str, export: Export, executor: Executor, total_ms: float) -> None:
    fresh = _moved(export, name)
    assert executor.driver
    executor.preflight(fresh.task, int(fresh.numbers[0]))
    began_s, used_s = time.perf_counter(), _processor_s()
    report = fresh.run(executor)
    frame_ms = 1e3 * (time.perf_counter() - began_s) / report.drawn
    used_ms = 1e3 * (_processor_s() - used_s) / report.drawn
    against = frame_ms / (total_ms / (os.cpu_count() or 1))
    table.add_row(name, f"{1e3 / frame_ms:.1f}", f"{frame_ms:.1f}", f"{used_ms:.1f}", f"{against:.2f}")


def _processor_s() -> float:
    """Return the processor time of this process and all its descendants, s."""
    parents: dict[int, int] = {}
    ticks: dict[int, int] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            parents[int(process.name)], ticks[int(process.name)] = int(fields[1]), int(fields[11]) + int(fields[12])
    ours = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in ours} - ours:
        ours |= more
    return sum(ticks.get(process, 0) for process in ours) / os.sysconf("SC_CLK_TCK")


@contextmanager
def _dask(count: int, export: Export) -> Iterator[Executor]:
    from distributed import LocalCluster  # noqa: PLC0415 - an extra

    from glstar.export.run.cluster import DaskExecutor  # noqa: PLC0415 - an extra

    moved = _moved(export, f"{count} Dask workers")
    with (
        LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        DaskExecutor(cluster.scheduler_address, moved.task) as executor,
    ):
        yield executor


if __name__ == "__main__":
    main()
