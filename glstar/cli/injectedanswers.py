"""A navigator's answers as position fixes for the autopilot."""

from collections.abc import Callable, Mapping
from pathlib import Path

from glstar.camera.exposure import Exposure
from glstar.cli.incominganswers import IncomingAnswers
from glstar.errors import AnswersError
from glstar.link import Injector, PositionFix
from glstar.score.answers import Answer

__all__ = ["InjectedAnswers"]


class InjectedAnswers(IncomingAnswers):
    """Answers that are sent to the autopilot.

    Parameters
    ----------
    source : str or Path
        As for `IncomingAnswers`.
    injector : Injector
    exposures : mapping of int or str to Exposure
        Of the frames that were drawn, by number and by file name.
    report : callable
        Called with a message for each answer that cannot be sent.
    """

    def __init__(
        self,
        source: str | Path,
        injector: Injector,
        exposures: Mapping[int | str, Exposure],
        report: Callable[[str], None],
    ) -> None:
        super().__init__(source, report)
        self._injector, self._exposures = injector, exposures

    def take(self, answer: Answer) -> None:
        """Send the position of an answer, if it has one.

        Parameters
        ----------
        answer : Answer

        Raises
        ------
        AnswersError
            If it is for no frame that was drawn.
        """
        fix = self._fix(answer)
        if fix is not None:
            self._injector.add(fix)

    def _fix(self, answer: Answer) -> PositionFix | None:
        """Return the position of an answer; None if it has none."""
        if not answer.solved or answer.latitude_rad is None or answer.longitude_rad is None:
            return None
        frame = answer.file if answer.frame is None else answer.frame
        if frame is None:
            raise AnswersError(self._source, f"line {answer.line} has no frame; give the frame that it answers")
        exposure = self._exposures.get(frame)
        if exposure is None:
            raise AnswersError(self._source, f"line {answer.line} answers frame {frame}, which was not drawn; not sent")
        utc_s = {"start": exposure.start_utc_s, "middle": exposure.mid_utc_s, "end": exposure.stop_utc_s}
        sigma_m = None if answer.ellipse is None else 1000 * answer.ellipse.sigma_km
        return PositionFix(answer.latitude_rad, answer.longitude_rad, utc_s[answer.instant], sigma_m)
