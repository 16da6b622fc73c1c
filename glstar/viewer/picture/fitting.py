"""Work of the window on images, each on a thread of its own.

A fit of the camera clock's offset and the mount to real images; the residuals of the simulated trails against the
trails of the real image shown; and the calibration of a camera from one photograph of the stars.  `glstar.cli` gives
the window the functions that do it.
"""

import tomllib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.config.keys import SECTIONS
from glstar.errors import GlstarError
from glstar.images import RealImage
from glstar.images.times import TimeReference
from glstar.render.simulator import Simulator

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class FitRequest:
    """What to fit to which images."""

    simulator: Simulator  # It has the flight, with the initial offset of the camera clock
    images: tuple[RealImage, ...]
    exposure: Exposure  # For images that do not state their exposure time; its start is ignored
    reference: TimeReference  # The instant of its exposure to which an image's time stamp refers
    own_length: bool  # Whether an exposure time that an image states is used
    fits_time: bool
    fits_mount: bool


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What a fit found."""

    # Change of the camera clock's offset, and its standard error, s; None if it was not fitted.
    clock_change_s: float | None
    clock_std_s: float | None
    mount_keys: dict[str, float]  # The mount as settings, dotted keys, deg; empty if it was not fitted
    # Turn of the camera about its right, down and forward axes, and its standard errors, rad.
    turn_rad: tuple[float, ...]
    turn_std_rad: tuple[float, ...]
    images: int  # Number of images compared, of all images, and of stars
    of: int
    stars: int
    centroid_mean_px: float  # Distance of the centroids of real and simulated trails after the fit, px
    centroid_median_px: float
    notes: tuple[str, ...]


# Takes what to call with the number of images done, and of all; raises GlstarError if the images determine nothing.
FitImages = Callable[[FitRequest, Callable[[int, int], None]], FitResult]


class _CancelledError(Exception):
    """The user stopped a fit or a calibration."""


class BackgroundRun(Generic[T]):
    """Work on a thread of its own that is running, or has ended.

    `work`: raises `_CancelledError` once `cancelled` is set.  `result`: None while it is running, and if it failed;
    `error`: why it failed; empty if it did not.
    """

    # Longest time that closing the window waits for the thread, s.
    _JOIN_S = 30.0

    def __init__(self, name: str, work: Callable[[], T], cancelled: Event) -> None:
        self.result: T | None = None
        self.error = ""
        self._work = work
        self._cancelled = cancelled
        self._thread = Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.result = self._work()
        except _CancelledError:
            pass
        except (GlstarError, OSError) as error:
            self.error = str(error)

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Stop after the current image or step."""
        self._cancelled.set()

    def close(self) -> None:
        """Stop, and wait for the thread."""
        self.cancel()
        self._thread.join(self._JOIN_S)


class ImageFit(BackgroundRun[FitResult]):
    """A fit; `done`, `of`: images done; `of` is 0 if their number is not known yet."""

    def __init__(self, request: FitRequest, fit: FitImages) -> None:
        self.done = self.of = 0
        super().__init__("glstar-fit", lambda: fit(request, self._count), Event())

    def _count(self, done: int, of: int) -> None:
        self.done = done
        self.of = of
        if self._cancelled.is_set():
            raise _CancelledError


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRequest:
    """What to measure in which image."""

    simulator: Simulator
    ahead_s: float  # Camera clock minus log clock, s
    image: RealImage
    exposure: Exposure  # For an image that does not state its exposure time; its start is ignored
    reference: TimeReference  # The instant of its exposure to which the image's time stamp refers
    own_length: bool  # Whether an exposure time that the image states is used

    def is_like(self, other: "ResidualRequest | None") -> bool:
        """Return whether another request has the same answer."""
        if other is None or self.simulator is not other.simulator:
            return False
        names = ("ahead_s", "image", "exposure", "reference", "own_length")
        return all(getattr(self, name) == getattr(other, name) for name in names)


@dataclass(frozen=True, slots=True, eq=False)
class TrailResiduals:
    """The trails of one real image beside the simulated ones."""

    real_px: Float  # (n, 2) the middles of the trails that were detected in the real image, px
    shift_px: Float  # (n, 2) simulated minus real, px
    predicted: int  # Number of trails that were searched for
    figures: tuple[tuple[str, str], ...]  # The paper's measures: label and value


# Raises GlstarError if no trail of the image is found.
MeasureImage = Callable[[ResidualRequest], TrailResiduals]


class ResidualWatch:
    """Measures the residuals of the latest image requested, one at a time.

    `measure`: how to measure; None if the window cannot.
    """

    def __init__(self) -> None:
        self.measure: MeasureImage | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-residuals")
        self._running: tuple[ResidualRequest, Future[TrailResiduals]] | None = None
        self._done: tuple[ResidualRequest, TrailResiduals | str] | None = None

    def of(self, request: ResidualRequest) -> TrailResiduals | str | None:
        """Return the residuals of an image, or why there are none; None while it is measured, which begins here."""
        if self._running is not None and self._running[1].done():
            asked, future = self._running
            self._running = None
            self._done = (asked, _outcome(future))
        if self._done is not None and request.is_like(self._done[0]):
            return self._done[1]
        if self._running is None and self.measure is not None:
            self._running = request, self._worker.submit(self.measure, request)
        return None

    @property
    def is_running(self) -> bool:
        """Whether an image is being measured."""
        return self._running is not None

    def close(self) -> None:
        """Wait for the image that is being measured, and end the thread."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._running = self._done = None


def _outcome(future: Future[TrailResiduals]) -> TrailResiduals | str:
    try:
        return future.result()
    except (GlstarError, OSError) as error:
        return str(error)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRequest:
    """A photograph and what is known of it."""

    path: Path
    config: Config  # Its camera is that of the photograph, if `fov_rad` is None; its catalogue has the stars
    fov_rad: float | None = None  # Width of the view, to 15 %
    exposure_s: float | None = None  # None: as the file states
    utc: str = ""  # At mid-exposure; empty if it is not known
    site_rad: tuple[float, float] | None = None  # Latitude and longitude
    geometry_only: bool = False  # Whether the sensor is left out
    # The last result for this photograph, which is solved again without some of its stars.
    before: "CalibratedPhoto | None" = None
    # Positions of detections that are not to be used, px.
    removed_px: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedPhoto:
    """The result of a calibration."""

    name: tuple[str, ...]  # Names of the identified stars, or their numbers
    vmag: Float  # (n,)
    xy_px: Float  # (n, 2) where they were detected, px
    residual_px: Float  # (n, 2) detected minus predicted position, px
    report: tuple[str, ...]  # What was found, as lines
    notes: tuple[str, ...]  # Remarks for the user
    toml: str  # The calibration, for ``--config``
    # Writes it to a path, which gets the suffix ``.toml``, with star list and report beside it; returns the paths.
    save: Callable[[Path], list[Path]]
    state: Any  # What the function that calibrates needs to solve again


class CalibrationProgress:
    """What is known of a calibration while it runs.

    `pixels` (height, width) uint16 or None: the photograph; None until it has been read; `white_dn`: its largest
    digital number; `detected_px` (n, 2): detected stars; `step`: what is being done; `done`: number of steps done.
    """

    STEPS = 4

    def __init__(self) -> None:
        self.pixels: NDArray[np.uint16] | None = None
        self.white_dn = 1
        self.detected_px: Float = np.empty((0, 2))
        self.step, self.done = "", 0
        self.cancelled = Event()

    def begin(self, step: str, done: int) -> None:
        """Begin a step; `done`: number of steps done."""
        if self.cancelled.is_set():
            raise _CancelledError
        self.step, self.done = step, done


CalibratePhoto = Callable[[CalibrationRequest, CalibrationProgress], CalibratedPhoto]


class CalibrationRun(BackgroundRun[CalibratedPhoto]):
    """A calibration; `progress`: what is known of it while it runs."""

    def __init__(self, request: CalibrationRequest, calibrate: CalibratePhoto) -> None:
        self.request = request
        self.progress = CalibrationProgress()
        super().__init__("glstar-calibrate", lambda: calibrate(request, self.progress), self.progress.cancelled)


def with_calibration(config: Config, toml: str) -> Config:
    """Return settings with the camera of a calibration, and with its sensor if it has one.

    `toml`: the calibration.  Raises ConfigError if the other settings contradict it.
    """
    tables = tomllib.loads(toml)
    sections = [section for section in ("camera", "sensor") if section in tables]
    own = [f"{section}.{key}" for section in sections for key in SECTIONS[section].model_fields]
    keys = {f"{section}.{key}": value for section, values in tables.items() for key, value in values.items()}
    return config.without(*own).override(**keys)
