"""Real flights for the benchmarks: logs that are not part of the repository.

Their folder is given by ``--logs`` or by the environment variable GLSTAR_BENCH_LOGS.
"""

import os
from argparse import ArgumentParser
from pathlib import Path
from typing import NamedTuple

__all__ = ["REAL_FLIGHTS", "RealFlight", "add_logs_option", "logs_of", "missing_logs"]

ENVIRONMENT = "GLSTAR_BENCH_LOGS"


class RealFlight(NamedTuple):
    """A log, and what it is."""

    file: str
    about: str


REAL_FLIGHTS = {
    "adelaide": RealFlight("plane_SITL_adelaide_200Hz.BIN", "ArduPlane's simulator, attitude at 200 Hz"),
    "skywalker": RealFlight("plane_skywalkerX8_TestLog2.reenc.BIN", "a real flying wing, attitude at 50 Hz"),
    "flt09": RealFlight("plane_Proto_FLT09.reenc.ulg", "a real fixed wing with PX4, attitude at 86 Hz"),
}


def add_logs_option(arguments: ArgumentParser) -> None:
    """Add ``--logs`` to an argument parser."""
    arguments.add_argument(
        "--logs",
        type=Path,
        default=os.environ.get(ENVIRONMENT) or None,
        help=f"folder of the real flights; {ENVIRONMENT}",
    )


def logs_of(folder: Path | None) -> dict[str, Path]:
    """Return the logs of the real flights that the folder has, by name."""
    if folder is None:
        return {}
    return {name: folder / flight.file for name, flight in REAL_FLIGHTS.items() if (folder / flight.file).is_file()}


def missing_logs(folder: Path | None) -> str:
    """Return a message on the real flights that are not measured; empty if all are there."""
    missing = [flight.file for name, flight in REAL_FLIGHTS.items() if name not in logs_of(folder)]
    if not missing:
        return ""
    where = "no folder of logs is given" if folder is None else f"{folder} lacks them"
    return f"NOT MEASURED, {where} (--logs or {ENVIRONMENT}): {', '.join(missing)}"
