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

``--against REV`` compares with another revision instead, checked out into a folder of its own: the glstar of either
draws the same frames in turns, spread evenly over each flight, and both draw each frame.  Of each step it prints the
processor time of both and their ratio, for the flights and for steps of `glstar.Environment` (``environment``), and of
the start of ``glstar export`` until its first frame is written.
"""

import argparse
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
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
from tests.bench.framesteps import ENVIRONMENT
from tests.bench.realflights import REAL_FLIGHTS, add_logs_option, logs_of, missing_logs
from tests.bench.revisions import HERE, Turns, checked_out

EVERY_S = 0.5


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--frames", type=int, default=120)
    arguments.add_argument("--preset", default="picamhq-6mm-binned4")
    names = ["bundled", "turn", *REAL_FLIGHTS]
    arguments.add_argument("--flights", nargs="*", choices=names, default=names)
    arguments.add_argument("--workers", type=int, nargs="*", default=[1, os.cpu_count() or 1])
    arguments.add_argument("--dask", type=int, nargs="*", default=[])
    arguments.add_argument("--against", metavar="REV", help="compare with another revision, or the folder of one")
    add_logs_option(arguments)
    asked = arguments.parse_args()
    console = Console(width=120)
    console.print(
        f"glstar {__version__}, Python {platform.python_version()}, {os.cpu_count()} processors,"
        f" load {os.getloadavg()[0]:.1f}"
    )
    flights = [name for name in asked.flights if name not in REAL_FLIGHTS or name in logs_of(asked.logs)]
    if asked.against:
        with nullcontext(Path(asked.against)) if Path(asked.against).is_dir() else checked_out(asked.against) as tree:
            _compare(flights, asked, {"this": HERE, asked.against: tree}, console)
    else:
        for name in flights:
            with TemporaryDirectory() as folder:
                console.rule(_ABOUT[name])
                _measure(_job(name, Path(folder), asked), asked.workers, asked.dask, console)
    if message := missing_logs(asked.logs):
        console.print(message, style="bold red")


_ABOUT = {
    "bundled": "the bundled flight",
    "turn": "a turn at 10 deg/s, logged at 50 Hz",
    **{name: flight.about for name, flight in REAL_FLIGHTS.items()},
}


def _job(name: str, folder: Path, asked: argparse.Namespace) -> Export:
    """Return the export of a flight."""
    settings = Config().override(**{"camera.preset": asked.preset, "exposure.interval_s": EVERY_S})
    directory = folder / "frames"
    if name in REAL_FLIGHTS:
        return _whole_flight(settings, logs_of(asked.logs)[name], directory, asked.frames)
    flight = None if name == "bundled" else turning(10.0, duration_s=EVERY_S * (asked.frames + 2))
    # The log names the flight, and is read where no other is given.
    return prepare_export(settings, asset("adelaide.BIN"), directory, ExportOptions(frames=asked.frames), flight=flight)


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
    numbers = export.numbers.tolist()
    with GLRenderer.headless() as renderer:
        console.print(renderer.driver)
        step = _Frame(export, renderer)
        for number in numbers[:: max(1, len(numbers) // 40)]:
            for name, ms in step(number).items():
                times.setdefault(name, []).append(ms)
    table = Table("step", "median ms", "mean ms", "fraction of the mean", title="processor time per frame")
    means = {step: statistics.fmean(values) for step, values in times.items()}
    total_ms = sum(means.values())
    for name, values in times.items():
        table.add_row(
            name, f"{statistics.median(values):.1f}", f"{means[name]:.1f}", f"{100 * means[name] / total_ms:.0f} %"
        )
    table.add_row("all", "", f"{total_ms:.1f}", "100 %")
    console.print(table)
    console.print(f"OpenCV's PNG of the same: {_opencv_ms(step.pixels):.1f} ms")
    return total_ms


class _Frame:
    """Draws frames of an export step by step, on one thread."""

    def __init__(self, export: Export, renderer: GLRenderer) -> None:
        self._task, self._renderer, self._path = export.task, renderer, export.directory.parent / "a.png"
        self._task.draw(renderer, int(export.numbers[0]))  # compiles the shaders
        self.pixels: NDArray[Any] = np.zeros((1, 1), np.uint8)

    def __call__(self, number: int) -> dict[str, float]:
        """Draw a frame, and return the processor time of each step, ms."""
        times: dict[str, float] = {}

        def timed(step: str, work: Callable[[], Any]) -> Any:
            began_s = time.process_time()
            result = work()
            times[step] = 1e3 * (time.process_time() - began_s)
            return result

        task = self._task
        composed = timed("scene", lambda: task.frames.compose(number))
        pending = timed("draw", lambda: task.begin(self._renderer, composed))
        frame = timed("read", pending.frame)
        line = timed("truth", lambda: frame_truth(composed.scene, frame, number=number, file="frame.png"))
        image = timed("PNG", lambda: encode(frame.pixels, "png"))
        timed("write", lambda: self._path.write_bytes(image + line))
        self.pixels = frame.pixels
        return times


def _compare(flights: list[str], asked: argparse.Namespace, trees: dict[str, Path], console: Console) -> None:
    """Print the processor time of each step with the glstar of two checkouts, in turns."""
    ours, theirs = trees
    table = Table("what", "step", theirs, ours, "ratio", title="processor time, ms, the mean of all frames")
    for name in [*flights, ENVIRONMENT]:
        logs = [] if asked.logs is None else ["--logs", str(asked.logs)]
        options = [name, "--frames", str(asked.frames), "--preset", asked.preset, *logs]
        with Turns(trees, "tests.bench.framesteps", *options) as turns:
            taken = [turns.take(step) for step in range(asked.frames)]
        for step in taken[-1][ours]:
            pair = [statistics.fmean(turn[tree][step] for turn in taken[1:]) for tree in (theirs, ours)]
            _add_ratio(table, name, step, *pair)
        totals = [
            [statistics.fmean(sum(turn[tree].get(step, 0.0) for step in of) for turn in taken[1:]) for tree in trees]
            for of in (["scene", "truth"], ["scene", "draw", "read", "truth", "PNG"])
        ]
        if name != ENVIRONMENT:
            for label, (our_ms, their_ms) in zip(("scene and truth", "all"), totals, strict=True):
                _add_ratio(table, name, label, their_ms, our_ms)
    starts: dict[str, list[float]] = {tree: [] for tree in trees}
    for _ in range(_STARTS):
        for tree, path in trees.items():
            starts[tree].append(_start_ms(path))
    _add_ratio(table, "glstar export", "first file", *(min(starts[tree]) for tree in (theirs, ours)))
    console.print(table)


_STARTS = 5


def _start_ms(tree: Path) -> float:
    """Return the processor time of ``glstar export`` of a single frame, ms."""
    with TemporaryDirectory() as folder:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [
                sys.executable,
                "-m",
                "glstar",
                "export",
                str(asset("adelaide.BIN")),
                "-o",
                f"{folder}/frames",
                "--frames",
                "1",
            ],
            env={**_without_choice_of_bytecode(), "PYTHONPATH": str(tree)},
            cwd=folder,
            check=True,
            capture_output=True,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1e3 * (after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime)


def _without_choice_of_bytecode() -> dict[str, str]:
    """Return the environment with which the second start finds compiled modules, as an installed glstar does."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def _add_ratio(table: Table, name: str, step: str, theirs: float, ours: float) -> None:
    table.add_row(name, step, f"{theirs:.2f}", f"{ours:.2f}", f"{ours / theirs:.2f}")


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
