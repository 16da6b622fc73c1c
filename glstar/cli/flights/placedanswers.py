"""A navigator's answers with the times of their frames, for the viewer."""

from collections.abc import Callable
from pathlib import Path

from glstar.cli.flights.navigatoranswers import IncomingAnswers
from glstar.config import Config
from glstar.errors import AnswersError, ExportError
from glstar.export.truth.lines import read_truth
from glstar.score.answers import Answer, read_answers
from glstar.sky.place.timescale import format_utc, parse_utc
from glstar.viewer.overlays.belief import PlacedAnswer


def placed_answers(answers: Path, export: Path) -> list[PlacedAnswer]:
    """Return the solved answers of a file, in the order of their times.

    `answers`: as `glstar.score` reads them; `export`: the directory of the frames, with ``truth.jsonl``.  Raises
    AnswersError if a line is no answer, or is for no frame of the export; ExportError if there is no truth, as in the
    directory that ``--blind`` leaves to the navigator.
    """
    from glstar.export.navigator import NAV  # noqa: PLC0415 - OpenCV

    if not (export / "truth.jsonl").is_file() and (export / NAV).is_file():
        raise ExportError(export, "is for a navigator and has no truth.jsonl; name the directory of --blind")
    times_s: dict[int | str | None, dict[str, float]] = {}
    for line in read_truth(export):
        start_s, middle_s = parse_utc(line["utc_start"]), parse_utc(line["utc_mid"])
        instants_s = {"start": start_s, "middle": middle_s, "end": 2 * middle_s - start_s}
        times_s[line["frame"]] = times_s[line["file"]] = instants_s
    placed = []
    for answer in read_answers(answers):
        frame = answer.file if answer.frame is None else answer.frame
        if frame not in times_s:
            raise AnswersError(answers, f"line {answer.line} answers frame {frame}, which {export} does not have")
        if answer.solved:
            placed.append(_placed(answer, str(frame), times_s[frame][answer.instant]))
    return sorted(placed, key=lambda answer: answer.utc_s)


class ShownAnswers(IncomingAnswers):
    """Answers that are shown in the window of a live link, at the UTC that they state.

    `source`: as for `IncomingAnswers`; `config`: its clocks relate the UTC of the camera to that of the link; `show`:
    takes a `PlacedAnswer`; called on the thread; `report`: called with a message for each answer that cannot be shown.
    """

    def __init__(
        self, source: str | Path, config: Config, show: Callable[[PlacedAnswer], None], report: Callable[[str], None]
    ) -> None:
        super().__init__(source, report)
        self._clock_offset_s = config.flight.time_offset_s + config.navigator.clock_offset_s
        self._show = show

    def take(self, answer: Answer) -> None:
        """Show an answer; raises AnswersError if it states no UTC: the window knows no frames of other programs."""
        if answer.utc_s is None:
            raise AnswersError(
                self._source, f"line {answer.line} has no utc, by which a live window places it; not shown"
            )
        if answer.solved:
            utc_s = answer.utc_s - self._clock_offset_s
            self._show(_placed(answer, f"of {format_utc(utc_s)[11:21]}", utc_s))


def _placed(answer: Answer, frame: str, utc_s: float) -> PlacedAnswer:
    latitude_rad, longitude_rad = answer.latitude_rad, answer.longitude_rad
    ellipse = answer.ellipse
    return PlacedAnswer(
        utc_s,
        frame,
        answer.C_camera_icrs,
        None if latitude_rad is None or longitude_rad is None else (latitude_rad, longitude_rad),
        None if ellipse is None else (ellipse.major_km, ellipse.minor_km, ellipse.azimuth_rad),
    )
