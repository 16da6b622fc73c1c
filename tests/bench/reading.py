"""Read one log and print the time, the peak memory and the number of samples: ``python -m tests.bench.reading``.

The time is that from file to flight, including imports of the reader, as a user experiences it.
"""

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np  # noqa: F401  # both readers use it: its import is not measured

MESSAGES = ["ATT", "XKQ", "POS", "GPS", "MSG", "EV", "IMU"]


def glstar(log: str) -> int:
    """Make a flight of a log, as `glstar export` does."""
    from glstar.sky.place.site import Site  # noqa: PLC0415
    from glstar.telemetry import open_flight  # noqa: PLC0415

    given = {"utc_start": 1.7e9, "site": Site(0.5, 0.5)} if log.endswith(".ulg") else {}
    return int(open_flight(log, **given).attitude.utc_s.size)


def pymavlink(log: str) -> int:
    """Read the messages of a DataFlash log that glstar uses."""
    from pymavlink.DFReader import DFReader_binary, DFReader_text  # noqa: PLC0415

    with (DFReader_text if log.endswith(".log") else DFReader_binary)(log) as source:
        return sum(1 for _ in iter(lambda: source.recv_match(type=MESSAGES, strict=True), None))


def pyulog(log: str) -> int:
    """Read a whole ULog."""
    from pyulog import ULog  # noqa: PLC0415

    return sum(len(topic.data["timestamp"]) for topic in ULog(log).data_list)


READERS: dict[str, Callable[[str], int]] = {"glstar": glstar, "pymavlink": pymavlink, "pyulog": pyulog}


def peak_mb() -> float:
    """Return the peak memory of this process including mapped files, MB."""
    status = Path("/proc/self/status")
    if status.exists():  # getrusage includes the process that started this one
        return float(status.read_text().partition("VmHWM:")[2].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    began_s = time.perf_counter()
    samples = READERS[sys.argv[1]](sys.argv[2])
    print(time.perf_counter() - began_s, peak_mb(), samples)
