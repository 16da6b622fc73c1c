"""The frames of an export: their numbers, and the scene of each."""

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.export.plan import Plan, SkippedFrame
from glstar.render.scene import Scene
from glstar.render.simulator import Simulator

__all__ = ["ComposedFrame", "FlightFrames", "Frames", "Shot"]


@dataclass(frozen=True, slots=True, eq=False)
class ComposedFrame:
    """A frame that is ready to be drawn.

    Attributes
    ----------
    number : int
        Frame number.
    scene : Scene
    extra_truth : mapping
        Additional keys of its line of truth.
    """

    number: int
    scene: Scene
    extra_truth: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """When and how the camera exposes a frame.

    Attributes
    ----------
    simulator : Simulator
    exposure : Exposure
    flight : int
        Index of the flight in a data set.
    stream : int
        Index of the flight and the sample together: frames of one value belong to one flight.
    settings : mapping
        The settings of the sample, by dotted key.
    shift_s : float
        How much later than in its log the flight is, s.
    """

    simulator: Simulator
    exposure: Exposure
    flight: int = 0
    stream: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)
    shift_s: float = 0.0


class Frames(Protocol):
    """The frames of an export.  An instance can be pickled, so that other processes can draw its frames."""

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        ...

    @property
    def firsts(self) -> NDArray[np.int64]:
        """First frame number of each simulator, (m,) int64, increasing: frames between two of them share one."""
        ...

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        ...

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        ...

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that `compose` reads again; all processes must find the same content there."""
        ...

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame.

        Parameters
        ----------
        number : int
            One of `numbers`.

        Returns
        -------
        Shot
        """
        ...

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame.

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
    """The frames of one flight, composed by one simulator.

    Attributes
    ----------
    simulator : Simulator
    plan : Plan
    """

    simulator: Simulator
    plan: Plan

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Frame numbers, (n,) int64, increasing."""
        return np.array([planned.number for planned in self.plan.frames], dtype=np.int64)

    @property
    def firsts(self) -> NDArray[np.int64]:
        """Frame 0: one simulator has all frames."""
        return np.zeros(1, dtype=np.int64)

    @property
    def skipped(self) -> tuple[SkippedFrame, ...]:
        """Frames that are left out because their exposure spans a gap in the log."""
        return self.plan.skipped

    @property
    def saturation_dn(self) -> int:
        """The largest digital number of the images."""
        factors = [planned.exposure.signal_factor for planned in self.plan.frames[:1]]  # all have the same
        return self.simulator.sensor.saturation_dn * max(factors, default=1)

    @property
    def files(self) -> tuple[Path, ...]:
        """Empty: the simulator holds everything."""
        return ()

    def shot(self, number: int) -> Shot:
        """Return when and how the camera exposes a frame; see `Frames`."""
        planned = self.plan.frames[bisect_left(self.plan.frames, number, key=lambda frame: frame.number)]
        return Shot(self.simulator, planned.exposure)

    def compose(self, number: int) -> ComposedFrame:
        """Return the scene of a frame; see `Frames`."""
        return ComposedFrame(number, self.simulator.scene(self.shot(number).exposure))
