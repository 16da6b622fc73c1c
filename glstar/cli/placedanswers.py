"""A navigator's answers with the times of their frames, for the viewer."""

from pathlib import Path

from glstar.errors import AnswersError
from glstar.export.readtruth import read_truth
from glstar.score.answers import Answer, read_answers
from glstar.sky.timescale import parse_utc
from glstar.viewer.belief import PlacedAnswer

__all__ = ["placed_answers"]


def placed_answers(answers: Path, export: Path) -> list[PlacedAnswer]:
    """Return the solved answers of a file, in the order of their times.

    Parameters
    ----------
    answers : Path
        As `glstar.score` reads them.
    export : Path
        The directory of the frames, with ``truth.jsonl``.

    Returns
    -------
    list of PlacedAnswer

    Raises
    ------
    AnswersError
        If a line is no answer, or is for no frame of the export.
    ExportError
        If there is no truth.
    """
    times_s: dict[int | str | None, tuple[float, float]] = {}
    for line in read_truth(export):
        times_s[line["frame"]] = times_s[line["file"]] = parse_utc(line["utc_start"]), parse_utc(line["utc_mid"])
    placed = []
    for answer in read_answers(answers):
        frame = answer.file if answer.frame is None else answer.frame
        if frame not in times_s:
            raise AnswersError(answers, f"line {answer.line} answers frame {frame}, which {export} does not have")
        if answer.solved:
            placed.append(_placed(answer, str(frame), *times_s[frame]))
    return sorted(placed, key=lambda answer: answer.utc_s)


def _placed(answer: Answer, frame: str, start_utc_s: float, mid_utc_s: float) -> PlacedAnswer:
    utc_s = {"start": start_utc_s, "middle": mid_utc_s, "end": 2 * mid_utc_s - start_utc_s}[answer.instant]
    latitude_rad, longitude_rad = answer.latitude_rad, answer.longitude_rad
    ellipse = answer.ellipse
    return PlacedAnswer(
        utc_s,
        frame,
        answer.C_camera_icrs,
        None if latitude_rad is None or longitude_rad is None else (latitude_rad, longitude_rad),
        None if ellipse is None else (ellipse.major_km, ellipse.minor_km, ellipse.azimuth_rad),
    )
