"""What a log says about the course of a flight: flight modes and messages of the autopilot."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np

from glstar.flight.timedrecord import TimedRecord

__all__ = ["EventKind", "FlightEvents"]


class EventKind(StrEnum):
    """A kind of event."""

    MODE = "mode"
    MESSAGE = "message"


@dataclass(frozen=True, slots=True, eq=False)
class FlightEvents(TimedRecord):
    """Flight modes and messages of an autopilot.

    Attributes
    ----------
    utc_s : (n,) float64
        UTC seconds since 1970, ascending.
    kinds : tuple of EventKind
        Of each event.
    texts : tuple of str
        The mode that begins (``"LOITER"``), or the message.
    """

    kinds: tuple[EventKind, ...]
    texts: tuple[str, ...]

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> Self | None:
        """Return the events of several parts of a flight in the order of time; None if there are none.

        Parameters
        ----------
        parts : iterable of FlightEvents

        Returns
        -------
        FlightEvents or None
        """
        found = [event for part in parts for event in zip(part.utc_s.tolist(), part.kinds, part.texts, strict=True)]
        if not found:
            return None
        times_s, kinds, texts = zip(*sorted(found, key=lambda event: event[0]), strict=True)
        return cls(np.array(times_s), kinds, texts)
