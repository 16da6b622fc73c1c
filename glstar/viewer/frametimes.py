"""Durations of frames and of their parts."""

import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import get_ident
from typing import Any

import numpy as np

# Number of frames in the frame rate.
_LATEST = 60


class FrameTimes:
    """Measures frames and their parts.

    A frame consists of *drawing* (OpenGL calls: stars, development, image panel), *presenting* (drawing the interface,
    and swapping the window's buffers) and *python*, the rest of its thread's work: events, play head, panels.
    *Simulation* (attitude, culling of stars: NumPy) runs on another thread while the flight plays.  Python and
    simulation are measured in processor time, which other programs do not lengthen; the rest in wall-clock time,
    because OpenGL has threads of its own.

    `clock`: returns seconds from any origin; `work_clock`: returns the processor time of the calling thread, s.
    """

    def __init__(
        self, clock: Callable[[], float] = time.perf_counter, work_clock: Callable[[], float] = time.thread_time
    ) -> None:
        self._clock, self._work_clock = clock, work_clock
        self._thread = get_ident()
        self._not_python_s = 0.0
        self._spans: dict[str, float] = defaultdict(float)
        self._frames: list[dict[str, float]] = []
        self._ends: deque[float] = deque(maxlen=_LATEST)
        self._began_s, self._worked_s = clock(), work_clock()
        self.recording = False

    @contextmanager
    def span(self, name: str) -> Iterator[None]:
        """Measure the time inside as a part of this frame.

        `name`: ``"simulation"``, ``"drawing"`` or ``"presenting"``.
        """
        clock = self._work_clock if name == "simulation" else self._clock
        began_s, worked_s = clock(), self._work_clock()
        try:
            yield
        finally:
            self._spans[name] += clock() - began_s
            if get_ident() == self._thread:
                self._not_python_s += self._work_clock() - worked_s

    def new_image(self) -> None:
        """Count a new image of the sky in this frame."""
        self._spans["images"] = 1.0

    def begin(self) -> None:
        """Begin a frame's work."""
        self._began_s, self._worked_s = self._clock(), self._work_clock()
        self._not_python_s = 0.0
        self._spans.clear()

    def end(self) -> None:
        """End a frame's work."""
        now_s = self._clock()
        if self.recording:
            between_s = now_s - (self._ends[-1] if self._ends else self._began_s)
            parts = {name: self._spans[name] for name in ("simulation", "drawing", "presenting", "images")}
            python_s = self._work_clock() - self._worked_s - self._not_python_s
            self._frames.append({"frame": between_s, "python": python_s, **parts})
        self._ends.append(now_s)

    def pause(self) -> None:
        """Ignore the time until the next frame: the window sleeps."""
        self._ends.clear()

    @property
    def frames_per_s(self) -> float:
        """Frame rate of the last sixty frames, 1/s; 0 before there are two."""
        if len(self._ends) < 2 or self._ends[-1] == self._ends[0]:
            return 0.0
        return (len(self._ends) - 1) / (self._ends[-1] - self._ends[0])

    def report(self) -> dict[str, Any]:
        """Return the recorded times: milliseconds, median and 95th percentile of each part, for JSON."""
        frames = self._frames[1:] or self._frames
        parts: dict[str, Any] = {}
        for name in ("frame", "python", "simulation", "drawing", "presenting"):
            times_ms = 1e3 * np.array([frame[name] for frame in frames] or [0.0])
            parts[f"{name}_ms"] = {
                "median": round(float(np.median(times_ms)), 3),
                "p95": round(float(np.percentile(times_ms, 95)), 3),
            }
        total_s = sum(frame["frame"] for frame in frames)
        images = int(sum(frame["images"] for frame in frames))
        return {
            "frames": len(frames),
            "seconds": round(total_s, 3),
            "frames_per_s": round(len(frames) / total_s, 2) if total_s else 0.0,
            "images": images,
            "images_per_s": round(images / total_s, 2) if total_s else 0.0,
            **parts,
            "load": [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else None,
            "processors": os.cpu_count(),
        }
