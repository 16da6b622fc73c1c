"""How long frames take, and what of it goes where."""

import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

__all__ = ["FrameTimes"]

_LATEST: Final = 60


class FrameTimes:
    """A stopwatch with several hands.

    A frame is divided into *simulation* (where the camera looks, which stars it sees: NumPy), *drawing* (the orders to
    OpenGL: light, development, panel), *presenting* (the interface drawn, and the window's swap) and *python*, the rest
    of the work: events, play head, panels.  Waiting for the next frame is none of them.

    Parameters
    ----------
    clock : callable
        Seconds, from anywhere.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._spans: dict[str, float] = defaultdict(float)
        self._frames: list[dict[str, float]] = []
        self._ends: deque[float] = deque(maxlen=_LATEST)
        self._began_s = clock()
        self.recording = False

    @contextmanager
    def span(self, name: str) -> Iterator[None]:
        """Count the time inside as part of this frame.

        Parameters
        ----------
        name : str
            ``"simulation"``, ``"drawing"`` or ``"presenting"``.
        """
        began_s = self._clock()
        try:
            yield
        finally:
            self._spans[name] += self._clock() - began_s

    def begin(self) -> None:
        """Begin a frame's work."""
        self._began_s = self._clock()
        self._spans.clear()

    def end(self) -> None:
        """End a frame's work."""
        now_s = self._clock()
        if self.recording:
            worked_s = now_s - self._began_s
            between_s = now_s - self._ends[-1] if self._ends else worked_s
            parts = {name: self._spans[name] for name in ("simulation", "drawing", "presenting")}
            self._frames.append({"frame": between_s, "python": worked_s - sum(parts.values()), **parts})
        self._ends.append(now_s)

    def pause(self) -> None:
        """Forget the frame before: what follows is no frame's length."""
        self._ends.clear()

    @property
    def frames_per_s(self) -> float:
        """Of the last sixty frames; 0 before there are two."""
        if len(self._ends) < 2 or self._ends[-1] == self._ends[0]:
            return 0.0
        return (len(self._ends) - 1) / (self._ends[-1] - self._ends[0])

    def report(self) -> dict[str, Any]:
        """Return what was recorded, ready for JSON: milliseconds, median and 95th percentile of each part.

        Returns
        -------
        dict
        """
        frames = self._frames[1:] or self._frames
        parts: dict[str, Any] = {}
        for name in ("frame", "python", "simulation", "drawing", "presenting"):
            times_ms = 1e3 * np.array([frame[name] for frame in frames] or [0.0])
            parts[f"{name}_ms"] = {
                "median": round(float(np.median(times_ms)), 3),
                "p95": round(float(np.percentile(times_ms, 95)), 3),
            }
        total_s = sum(frame["frame"] for frame in frames)
        return {
            "frames": len(frames),
            "seconds": round(total_s, 3),
            "frames_per_s": round(len(frames) / total_s, 2) if total_s else 0.0,
            **parts,
            "load": [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else None,
            "processors": os.cpu_count(),
        }
