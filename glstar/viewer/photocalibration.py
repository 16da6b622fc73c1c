"""The calibration of a camera from one photograph of the stars, on a thread of its own.

`glstar.cli` gives the window the function that calibrates.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.config import Config
from glstar.config.sections import SECTIONS
from glstar.errors import GlstarError

__all__ = [
    "CalibratePhoto",
    "CalibratedPhoto",
    "CalibrationProgress",
    "CalibrationRequest",
    "CalibrationRun",
    "with_calibration",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRequest:
    """A photograph and what is known of it.

    Attributes
    ----------
    path : Path
    config : Config
        Its camera is that of the photograph, if `fov_rad` is None; its catalogue has the stars.
    fov_rad : float or None
        Width of the view, to 15 %.
    exposure_s : float or None
        None: as the file states.
    utc : str
        At mid-exposure; empty if it is not known.
    site_rad : (float, float) or None
        Latitude and longitude.
    geometry_only : bool
        Whether the sensor is left out.
    before : CalibratedPhoto or None
        The last result for this photograph, which is solved again without some of its stars.
    removed_px : tuple of (float, float)
        Positions of detections that are not to be used, px.
    """

    path: Path
    config: Config
    fov_rad: float | None = None
    exposure_s: float | None = None
    utc: str = ""
    site_rad: tuple[float, float] | None = None
    geometry_only: bool = False
    before: "CalibratedPhoto | None" = None
    removed_px: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedPhoto:
    """The result of a calibration.

    Attributes
    ----------
    name : tuple of str
        Names of the identified stars, or their numbers.
    vmag : (n,) float64
    xy_px : (n, 2) float64
        Where they were detected, px.
    residual_px : (n, 2) float64
        Detected minus predicted position, px.
    report : tuple of str
        What was found, as lines.
    notes : tuple of str
        Remarks for the user.
    toml : str
        The calibration, for ``--config``.
    save : callable
        Writes it with star list and report beside a path that ends with ``.toml``, and returns the paths.
    state : object
        What the function that calibrates needs to solve again.
    """

    name: tuple[str, ...]
    vmag: Float
    xy_px: Float
    residual_px: Float
    report: tuple[str, ...]
    notes: tuple[str, ...]
    toml: str
    save: Callable[[Path], list[Path]]
    state: Any


class CalibrationProgress:
    """What is known of a calibration while it runs.

    Attributes
    ----------
    pixels : (height, width) uint16 or None
        The photograph; None until it has been read.
    white_dn : int
        Its largest digital number.
    detected_px : (n, 2) float64
        Detected stars.
    step : str
        What is being done.
    done : int
        Number of steps done.
    """

    STEPS: Final = 4

    def __init__(self) -> None:
        self.pixels: NDArray[np.uint16] | None = None
        self.white_dn = 1
        self.detected_px: Float = np.empty((0, 2))
        self.step, self.done = "", 0
        self.cancelled = Event()

    def begin(self, step: str, done: int) -> None:
        """Begin a step.

        Parameters
        ----------
        step : str
        done : int
            Number of steps done.
        """
        if self.cancelled.is_set():
            raise _CancelledError
        self.step, self.done = step, done


CalibratePhoto = Callable[[CalibrationRequest, CalibrationProgress], CalibratedPhoto]


class CalibrationRun:
    """A calibration that is running, or has ended.

    Parameters
    ----------
    request : CalibrationRequest
    calibrate : callable

    Attributes
    ----------
    request : CalibrationRequest
    progress : CalibrationProgress
    result : CalibratedPhoto or None
        None while it is running, and if it failed.
    error : str
        Why it failed; empty if it did not.
    """

    # Longest time that closing the window waits for a step, s.
    _JOIN_S: Final = 30.0

    def __init__(self, request: CalibrationRequest, calibrate: CalibratePhoto) -> None:
        self.request, self.progress = request, CalibrationProgress()
        self.result: CalibratedPhoto | None = None
        self.error = ""
        self._calibrate = calibrate
        self._thread = Thread(target=self._run, name="glstar-calibrate", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.result = self._calibrate(self.request, self.progress)
        except _CancelledError:
            pass
        except (GlstarError, OSError) as error:
            self.error = str(error)

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Stop after the current step."""
        self.progress.cancelled.set()

    def close(self) -> None:
        """Stop, and wait for the thread."""
        self.cancel()
        self._thread.join(self._JOIN_S)


class _CancelledError(Exception):
    """The user stopped the calibration."""


def with_calibration(config: Config, toml: str) -> Config:
    """Return settings with the camera of a calibration, and with its sensor if it has one.

    Parameters
    ----------
    config : Config
    toml : str
        The calibration.

    Returns
    -------
    Config

    Raises
    ------
    ConfigError
        If the other settings contradict it.
    """
    tables = tomllib.loads(toml)
    own = [f"{section}.{key}" for section in ("camera", "sensor") if section in tables for key in _keys_of(section)]
    keys = {f"{section}.{key}": value for section, values in tables.items() for key, value in values.items()}
    return config.without(*own).override(**keys)


def _keys_of(section: str) -> list[str]:
    return list(SECTIONS[section].model_fields)
