"""The frames of an export: which there are, and what each shows."""

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.export.plan import Plan, SkippedFrame
from glstar.render.scene import Scene
from glstar.render.simulator import Simulator

__all__ = ["ComposedFrame", "FlightFrames", "Frames"]


@dataclass(frozen=True, slots=True, eq=False)
class ComposedFrame:
    """A frame that can be drawn.

    Attributes
    ----------
    number : int
        Its place in the sequence.
    scene : Scene
    about : mapping
        What its line of truth says besides.
    """

    number: int
    scene: Scene
    about: Mapping[str, Any] = field(default_factory=dict)


class Frames(Protocol):
    """The frames of an export; they can be pickled, for other processes to draw them."""

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Their places in the sequence, (n,) int64, rising."""
        ...

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """What of the sequence cannot be drawn truly."""
        ...

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of their images."""
        ...

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are read again while frames are composed: all processes must find the same there."""
        ...

    def compose(self, number: int) -> ComposedFrame:
        """Return what a frame shows.

        Parameters
        ----------
        number : int
            One of `numbers`.

        Returns
        -------
        ComposedFrame
        """
        ...


@dataclass(frozen=True, eq=False)
class FlightFrames:
    """The frames of one flight, by one simulator.

    Attributes
    ----------
    simulator : Simulator
    plan : Plan
    """

    simulator: Simulator
    plan: Plan

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """The frames' places in the sequence, (n,) int64, rising."""
        return np.array([planned.number for planned in self.plan.frames], dtype=np.int64)

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """What of the sequence cannot be drawn truly."""
        return self.plan.skipped

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of their images."""
        return self.simulator.sensor.saturation_dn

    @property
    def files(self) -> tuple[Path, ...]:
        """None: the simulator holds all that it needs."""
        return ()

    def compose(self, number: int) -> ComposedFrame:
        """Return what a frame shows; see `Frames`."""
        planned = self.plan.frames[bisect_left(self.plan.frames, number, key=lambda frame: frame.number)]
        return ComposedFrame(number, self.simulator.scene(planned.exposure))
