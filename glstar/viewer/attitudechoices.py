"""What a user can choose for the attitude of a log, found on a thread of its own."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from glstar.config import Config
from glstar.config.sections import FlightSection
from glstar.errors import GlstarError
from glstar.flight import Interpolation
from glstar.telemetry import Survey

__all__ = ["AttitudeChoices", "AttitudeFinder"]

# Keys of [flight] among whose values a user chooses: they do not change the choice.
_CHOSEN: Final = {"attitude": "auto", "interpolation": "slerp", "time_offset_s": 0.0}


@dataclass(frozen=True, slots=True)
class AttitudeChoices:
    """The attitudes of a log, and the interpolations that it allows.

    Attributes
    ----------
    attitudes : mapping of str to str
        Description by value of ``flight.attitude``, without ``"auto"``.
    has_gyros : bool
        Whether the log has the gyro rates that the interpolation ``"gyro"`` needs.
    error : str
        The reason why they are not known; empty if they are.
    """

    attitudes: Mapping[str, str] = field(default_factory=dict)
    has_gyros: bool = False
    error: str = ""

    @classmethod
    def of(cls, survey: Survey) -> "AttitudeChoices":
        """Return the choices in a log.

        Parameters
        ----------
        survey : Survey

        Returns
        -------
        AttitudeChoices
        """
        described = {
            one.name: f"{one.samples} samples, {one.rate_hz:.4g} Hz, {one.duration_s:.1f} s, {one.gaps} gaps"
            for one in survey.attitudes
        }
        return cls(described, survey.gyros is not None)

    def sources(self, chosen: str) -> list[str]:
        """Return the values of ``flight.attitude`` to offer.

        Parameters
        ----------
        chosen : str
            The present value, which is always among them.

        Returns
        -------
        list of str
            ``"auto"`` first.
        """
        return list(dict.fromkeys(("auto", *self.attitudes, chosen)))

    def interpolations(self, chosen: Interpolation) -> list[Interpolation]:
        """Return the interpolations to offer.

        Parameters
        ----------
        chosen : {"slerp", "spline", "gyro"}
            The present one, which is always among them.

        Returns
        -------
        list of {"slerp", "spline", "gyro"}
        """
        every: tuple[Interpolation, ...] = ("slerp", "spline", "gyro")
        return [one for one in every if one != "gyro" or self.has_gyros or one == chosen]


class AttitudeFinder:
    """Surveys the log shown, from the first call of `of` on."""

    def __init__(self) -> None:
        self._thread: ThreadPoolExecutor | None = None
        self._wanted: tuple[Path, FlightSection] | None = None
        self._future: Future[AttitudeChoices] | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a log is being surveyed."""
        return self._future is not None and not self._future.done()

    def of(self, path: Path, config: Config) -> AttitudeChoices | None:
        """Return the choices in a log; its survey begins with the first call.

        Parameters
        ----------
        path : Path
        config : Config
            With which the log was read.

        Returns
        -------
        AttitudeChoices or None
            None until they are known.
        """
        wanted = path, config.flight.model_copy(update=_CHOSEN)
        if self._future is None or wanted != self._wanted:
            if self._thread is None:
                self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-attitudes")
            if self._future is not None:
                self._future.cancel()
            self._wanted, self._future = wanted, self._thread.submit(_find, path, config)
        return self._future.result() if self._future.done() else None

    def close(self) -> None:
        """End the thread."""
        if self._thread is not None:
            self._thread.shutdown(wait=True, cancel_futures=True)


def _find(path: Path, config: Config) -> AttitudeChoices:
    try:
        return AttitudeChoices.of(config.survey_flight(path)[0])
    except (GlstarError, OSError, MemoryError) as error:
        return AttitudeChoices(error=str(error))
