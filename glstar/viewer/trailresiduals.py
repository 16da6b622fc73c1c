"""How far the simulated trails are from those of the real image shown, measured on a thread of its own.

The viewer does not know how images are compared: `glstar.cli` gives it the function.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.errors import GlstarError
from glstar.images import RealImage
from glstar.images.times import TimeReference
from glstar.render.simulator import Simulator

__all__ = ["MeasureImage", "ResidualRequest", "ResidualWatch", "TrailResiduals"]


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRequest:
    """What to measure in which image.

    Attributes
    ----------
    simulator : Simulator
    ahead_s : float
        Camera clock minus log clock, s.
    image : RealImage
    exposure : Exposure
        Of an image that does not state its exposure time; its start is ignored.
    reference : TimeReference
        The instant of its exposure to which the image's time stamp refers.
    own_length : bool
        Whether an exposure time that the image states is used.
    """

    simulator: Simulator
    ahead_s: float
    image: RealImage
    exposure: Exposure
    reference: TimeReference
    own_length: bool

    def is_like(self, other: "ResidualRequest | None") -> bool:
        """Return whether another request has the same answer.

        Parameters
        ----------
        other : ResidualRequest or None

        Returns
        -------
        bool
        """
        if other is None or self.simulator is not other.simulator:
            return False
        names = ("ahead_s", "image", "exposure", "reference", "own_length")
        return all(getattr(self, name) == getattr(other, name) for name in names)


@dataclass(frozen=True, slots=True, eq=False)
class TrailResiduals:
    """The trails of one real image beside the simulated ones.

    Attributes
    ----------
    real_px : (n, 2) float64
        The middles of the trails that were detected in the real image, px.
    shift_px : (n, 2) float64
        Simulated minus real, px.
    predicted : int
        Number of trails that were searched for.
    figures : tuple of (str, str)
        The paper's measures: what, and its value.
    """

    real_px: NDArray[np.float64]
    shift_px: NDArray[np.float64]
    predicted: int
    figures: tuple[tuple[str, str], ...]


# Raises GlstarError if no trail of the image is found.
MeasureImage = Callable[[ResidualRequest], TrailResiduals]


class ResidualWatch:
    """Measures the latest image that was asked for; one at a time.

    Attributes
    ----------
    measure : callable or None
        How to measure; None if the window cannot.
    """

    def __init__(self) -> None:
        self.measure: MeasureImage | None = None
        self._worker: ThreadPoolExecutor | None = None
        self._running: tuple[ResidualRequest, Future[TrailResiduals]] | None = None
        self._done: tuple[ResidualRequest, TrailResiduals | str] | None = None

    def of(self, request: ResidualRequest) -> TrailResiduals | str | None:
        """Return the residuals of an image, or why there are none; begin to measure it if that is not done.

        Parameters
        ----------
        request : ResidualRequest

        Returns
        -------
        TrailResiduals, str or None
            None while it is measured.
        """
        if self._running is not None and self._running[1].done():
            asked, future = self._running
            self._running, self._done = None, (asked, _outcome(future))
        if self._done is not None and request.is_like(self._done[0]):
            return self._done[1]
        if self._running is None and self.measure is not None:
            if self._worker is None:
                self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-residuals")
            self._running = request, self._worker.submit(self.measure, request)
        return None

    @property
    def is_running(self) -> bool:
        """Whether an image is being measured."""
        return self._running is not None

    def close(self) -> None:
        """Wait for the image that is being measured, and end the thread."""
        if self._worker is not None:
            self._worker.shutdown(wait=True, cancel_futures=True)
        self._worker = self._running = self._done = None


def _outcome(future: Future[TrailResiduals]) -> TrailResiduals | str:
    try:
        return future.result()
    except (GlstarError, OSError) as error:
        return str(error)
