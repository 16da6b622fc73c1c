"""A fit of the camera clock's offset and the mount to real images, on a thread of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import degrees, radians
from threading import Event, Thread
from typing import TYPE_CHECKING, Any, Final

from glstar.camera.exposure import Exposure
from glstar.errors import GlstarError
from glstar.images import RealImage
from glstar.images.times import TimeReference
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator

if TYPE_CHECKING:  # SciPy
    from glstar.compare import Alignment, FlightComparison

__all__ = ["FitResult", "ImageFit"]

# A mount with a larger standard error is not determined, rad.
_LARGEST_ERROR_RAD: Final = radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What a fit found.

    Attributes
    ----------
    alignment : Alignment
    summary : dict
        The numbers of the comparison with the fitted values; see `glstar.compare.summarize`.
    images, of : int
        Number of images compared, and of all.
    """

    alignment: "Alignment"
    summary: dict[str, Any]
    images: int
    of: int


class ImageFit:
    """A fit that is running, or has ended.

    Parameters
    ----------
    simulator : Simulator
        Of the flight, with the offset of the camera clock to begin with.
    images : sequence of RealImage
    exposure : Exposure
        As for `glstar.compare.FlightComparison`.
    reference : TimeReference
    own_length, fit_time, fit_mount : bool
    seed : int

    Attributes
    ----------
    done, of : int
        Steps of the fit; `of` is 0 if their number is not known yet.
    result : FitResult or None
        None while it is running, and if it failed.
    error : str
        Why it failed; empty if it did not.
    """

    # Longest time that closing the window waits for an image, s.
    _JOIN_S: Final = 30.0

    def __init__(
        self,
        simulator: Simulator,
        images: Sequence[RealImage],
        exposure: Exposure,
        *,
        reference: TimeReference,
        own_length: bool,
        fit_time: bool,
        fit_mount: bool,
        seed: int = 0,
    ) -> None:
        self.done = self.of = 0
        self.result: FitResult | None = None
        self.error = ""
        self._of_comparison = simulator, tuple(images), exposure, reference, own_length, seed
        self._fitted = {"fit_time": fit_time, "fit_mount": fit_mount}
        self._cancelled = Event()
        self._thread = Thread(target=self._run, name="glstar-fit", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            with GLRenderer.headless() as renderer:
                self.result = self._fit(renderer)
        except _CancelledError:
            pass
        except (GlstarError, OSError) as error:
            self.error = str(error)

    def _fit(self, renderer: GLRenderer) -> FitResult | None:
        job = self._comparison(renderer)
        alignment = job.align(**self._fitted, on_step=self._count)
        if alignment is None:
            self.error = "no image shows the trails that the flight predicts; set the clock or the mount by hand first"
            return None
        if not (alignment.fitted_time or alignment.fitted_mount):
            self.error = "; ".join(alignment.notes) or "the images determine neither the clock nor the mount"
            return None
        turn_std_rad = float(alignment.turn_std_rad.max()) if alignment.fitted_mount else 0.0
        if turn_std_rad > _LARGEST_ERROR_RAD:
            self.error = (
                f"{alignment.stars} stars in {alignment.images} images determine the mount only to"
                f" {degrees(turn_std_rad):.1f} deg: other stars, by chance; set the clock or the mount by hand first"
            )
            return None
        comparison = job.run(alignment, on_step=self._count)
        return FitResult(alignment, comparison.summary, len(comparison.images), len(self._of_comparison[1]))

    def _comparison(self, renderer: GLRenderer) -> "FlightComparison":
        from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy, only when images are fitted

        simulator, images, exposure, reference, own_length, seed = self._of_comparison
        single = replace(exposure, start_utc_s=0.0)
        return FlightComparison(
            simulator, renderer, images, single, reference=reference, own_length=own_length, seed=seed
        )

    def _count(self, done: int, of: int) -> None:
        self.done, self.of = done, of
        if self._cancelled.is_set():
            raise _CancelledError

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Stop after the current image."""
        self._cancelled.set()

    def close(self) -> None:
        """Stop, and wait for the thread."""
        self.cancel()
        self._thread.join(self._JOIN_S)


class _CancelledError(Exception):
    """The user stopped the fit."""
