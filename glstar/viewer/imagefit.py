"""A fit of the camera clock's offset and the mount to real images, on a thread of its own.

The viewer does not know how images are compared: `glstar.cli` gives it the function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Thread
from typing import Final

from glstar.camera.exposure import Exposure
from glstar.errors import GlstarError
from glstar.images import RealImage
from glstar.images.times import TimeReference
from glstar.render.simulator import Simulator

__all__ = ["FitImages", "FitRequest", "FitResult", "ImageFit"]


@dataclass(frozen=True, slots=True, eq=False)
class FitRequest:
    """What to fit to which images.

    Attributes
    ----------
    simulator : Simulator
        Of the flight, with the offset of the camera clock to begin with.
    images : tuple of RealImage
    exposure : Exposure
        Of images that do not state their exposure time; its start is ignored.
    reference : TimeReference
        The instant of its exposure to which an image's time stamp refers.
    own_length : bool
        Whether an exposure time that an image states is used.
    fits_time, fits_mount : bool
    """

    simulator: Simulator
    images: tuple[RealImage, ...]
    exposure: Exposure
    reference: TimeReference
    own_length: bool
    fits_time: bool
    fits_mount: bool


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What a fit found.

    Attributes
    ----------
    clock_change_s, clock_std_s : float or None
        What is added to the camera clock's offset, and its standard error, s; None if it was not fitted.
    mount_keys : dict
        The mount as settings, dotted keys, deg; empty if it was not fitted.
    turn_rad, turn_std_rad : tuple of float
        Turn of the camera about its right, down and forward axes, and its standard errors, rad.
    images, of, stars : int
        Number of images compared, of all images, and of stars.
    centroid_mean_px, centroid_median_px : float
        Distance of the centroids of real and simulated trails after the fit, px.
    notes : tuple of str
    """

    clock_change_s: float | None
    clock_std_s: float | None
    mount_keys: dict[str, float]
    turn_rad: tuple[float, ...]
    turn_std_rad: tuple[float, ...]
    images: int
    of: int
    stars: int
    centroid_mean_px: float
    centroid_median_px: float
    notes: tuple[str, ...]


# Takes what to call with the number of images done, and of all; raises GlstarError if the images determine nothing.
FitImages = Callable[[FitRequest, Callable[[int, int], None]], FitResult]


class ImageFit:
    """A fit that is running, or has ended.

    Parameters
    ----------
    request : FitRequest
    fit : callable

    Attributes
    ----------
    done, of : int
        Images done; `of` is 0 if their number is not known yet.
    result : FitResult or None
        None while it is running, and if it failed.
    error : str
        Why it failed; empty if it did not.
    """

    # Longest time that closing the window waits for an image, s.
    _JOIN_S: Final = 30.0

    def __init__(self, request: FitRequest, fit: FitImages) -> None:
        self.done = self.of = 0
        self.result: FitResult | None = None
        self.error = ""
        self._request, self._fit = request, fit
        self._cancelled = Event()
        self._thread = Thread(target=self._run, name="glstar-fit", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.result = self._fit(self._request, self._count)
        except _CancelledError:
            pass
        except (GlstarError, OSError) as error:
            self.error = str(error)

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
