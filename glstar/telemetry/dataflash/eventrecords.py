"""Flight modes and messages of a DataFlash log."""

from collections.abc import Iterator

import numpy as np

from glstar.flight import EventKind
from glstar.telemetry.dataflash.records import Records, stamped
from glstar.telemetry.flightmodes import ardupilot_mode
from glstar.telemetry.samplevalidation import valid_rare_times
from glstar.telemetry.source import EventSamples

__all__ = ["event_records"]


def event_records(log: Records, vehicle: str | None) -> Iterator[EventSamples]:
    """Yield the flight modes and the messages of a boot.

    Parameters
    ----------
    log : Records
    vehicle : str or None
        The firmware, whose modes these are.

    Yields
    ------
    EventSamples
    """
    for field in ("ModeNum", "Mode"):
        modes = stamped(log, "MODE", field)
        if modes is not None and modes[0].size and np.isfinite(modes[1][0]).any():
            clock_s, (number,) = modes
            named = valid_rare_times(clock_s) & np.isfinite(number)
            names = [ardupilot_mode(vehicle, int(one)) for one in number[named].tolist()]
            yield EventSamples.of(EventKind.MODE, clock_s[named], names)
            break
    messages = stamped(log, "MSG")
    texts = log.texts("MSG", "Message")
    if messages is not None and messages[0].size == len(texts) and texts:
        clock_s = np.where(valid_rare_times(messages[0]), messages[0], np.nan)
        yield EventSamples.of(EventKind.MESSAGE, clock_s, texts)
