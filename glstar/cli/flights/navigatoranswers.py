"""A navigator's answers: read while it writes them, sent to the autopilot as position fixes, or shown in a window."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from threading import Event, Thread
from typing import IO, TYPE_CHECKING, Self

from glstar.camera.exposure import Exposure
from glstar.cli.reporting import echo_note
from glstar.config import Config
from glstar.errors import AnswersError, ExportError
from glstar.export.publish.stream import STREAM, AnswerReceiver
from glstar.link import Injector, PositionFix
from glstar.score.answers import MOST_CHARACTERS, Answer, FirstAnswers, parse_answer, read_answers
from glstar.score.frames import camera_utc_mid_s, clock_offset_s
from glstar.sky.place.timescale import format_utc, parse_utc

if TYPE_CHECKING:
    from glstar.viewer.overlays.belief import PlacedAnswer

# Name of the standard input.
STDIN = Path("-")
# Interval at which a file of answers is read, s.
_POLL_S = 0.02
# Lines that cannot be used of which each is reported.
_REPORTED = 20


class IncomingAnswers(ABC):
    """Answers that a navigator writes now; a context manager with a thread that reads them.

    `source`: ``zmq://HOST:PORT``, to which `glstar live answer` and other programs send them; a file to which the
    navigator appends JSON lines, as `glstar.score` reads them; or ``-``, the standard input. Lines that are in the
    file already are of an earlier run, and are skipped. `report`: called with a message for each answer that is not
    valid;
    `on_failure`: called if the source cannot be read any more, which `__exit__` then raises as AnswersError.  Raises
    AnswersError if the source is a directory; ConfigError if the address is not valid or in use, or pyzmq is not
    installed.
    """

    def __init__(
        self, source: str | Path, report: Callable[[str], None], on_failure: Callable[[], None] | None = None
    ) -> None:
        self._receiver = AnswerReceiver(source) if isinstance(source, str) and source.startswith(STREAM) else None
        source = Path(source)
        self._source = source
        self._report = report
        self._on_failure = on_failure
        self._failure: Exception | None = None
        self._ending = Event()
        self._number = self._faults = 0
        self._start = source.stat().st_size if source != STDIN and source.is_file() else 0
        if source != STDIN and source.exists() and not source.is_file():
            raise AnswersError(source, "is no file; pipe answers into --answers -")
        self._thread = Thread(target=self._run, name="glstar answers", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._ending.set()
        if self._source != STDIN:
            self._thread.join()  # a read of the standard input cannot be interrupted
        if self._failure is not None and kind is None:
            raise AnswersError(self._source, f"could not be read to the end: {self._failure}") from self._failure

    @abstractmethod
    def take(self, answer: Answer) -> None:
        """Use an answer, on the thread; raises AnswersError, which is reported, if it cannot be used."""

    def _run(self) -> None:
        try:
            for line in self._lines():
                self._number += 1
                if line.strip():
                    self._process(line)
        except Exception as error:
            self._failure = error
            self._report(f"{self._source} cannot be read any more: {error!r}")
            if self._on_failure is not None:
                self._on_failure()

    def _lines(self) -> Iterator[str]:
        if self._receiver is not None:
            return self._received(self._receiver)
        return _complete_lines(sys.stdin.buffer) if self._source == STDIN else self._file_lines()

    def _received(self, receiver: AnswerReceiver) -> Iterator[str]:
        """Yield the lines that arrive, and close the receiver at the end."""
        with closing(receiver):
            while not self._ending.is_set():
                for line in receiver.lines(_POLL_S):
                    yield line
                    if self._ending.is_set():
                        return

    def _file_lines(self) -> Iterator[str]:
        """Yield the complete lines of the file as they are appended."""
        while not self._source.exists():
            if self._ending.wait(_POLL_S):
                return
        with self._source.open("rb") as file:
            file.seek(self._start)
            yield from _complete_lines(file, self._has_more)

    def _has_more(self) -> bool:
        """Wait for more of the file; return False once no more will be written."""
        return not self._ending.wait(_POLL_S)

    def _process(self, line: str) -> None:
        try:
            self.take(parse_answer(self._source, self._number, line))
        except AnswersError as error:
            self._faults += 1
            # Of a flood of them, fewer and fewer.
            if self._faults <= _REPORTED:
                self._report(str(error))
            elif self._faults.bit_count() == 1:
                self._report(f"{error} ({self._faults} lines cannot be used)")


def _complete_lines(file: IO[bytes], has_more: Callable[[], bool] | None = None) -> Iterator[str]:
    """Yield the lines of a file, and of one that is too long what is enough to refuse it.

    At the end of the file `has_more` says whether to read on; without it the rest of the file is a line.
    """
    line, is_over = b"", False
    while True:
        while part := file.readline(MOST_CHARACTERS + 2):
            line = (line + part)[: MOST_CHARACTERS + 2]
            if part.endswith(b"\n"):
                yield line.decode("utf-8", errors="replace")
                line = b""
        if is_over or has_more is None:
            break
        is_over = not has_more()
    if has_more is None and line:
        yield line.decode("utf-8", errors="replace")


def _camera_clock_offset_s(config: Config) -> float:
    """Return the clock that stamps the frames for a navigator minus UTC, s."""
    return config.flight.time_offset_s + config.navigator.clock_offset_s


class InjectedAnswers(IncomingAnswers):
    """Answers that are sent to the autopilot.

    `source`: as for `IncomingAnswers`; `exposures`: exposures of the frames that were drawn, by number and by file
    name; `config`: its clocks relate the camera's UTC to the link's; `report`: called with a message for each answer
    that cannot be sent.
    """

    def __init__(
        self,
        source: str | Path,
        injector: Injector,
        exposures: Mapping[int | str, Exposure],
        config: Config,
        report: Callable[[str], None],
        on_failure: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(source, report, on_failure)
        self._injector = injector
        self._exposures = exposures
        self._clock_offset_s = _camera_clock_offset_s(config)
        self._first = FirstAnswers()

    def take(self, answer: Answer) -> None:
        """Send the position of an answer, if it has one; raises AnswersError if it is for no frame that was drawn."""
        fix = self._fix(answer)
        if fix is not None:
            self._injector.add(fix)

    def _fix(self, answer: Answer) -> PositionFix | None:
        """Return the position of an answer; None if it has none."""
        if not answer.solved or answer.latitude_rad is None or answer.longitude_rad is None:
            return None
        if answer.of is None:
            raise AnswersError(self._source, f"line {answer.line} has no frame; give the frame that it answers")
        exposure = self._exposures.get(answer.of)
        if exposure is None:
            raise AnswersError(
                self._source, f"line {answer.line} answers frame {answer.of}, which was not drawn; not sent"
            )
        contradiction = answer.clock_objection(answer.of, exposure.mid_utc_s + self._clock_offset_s, exposure.span_s)
        if answer.file is not None and self._exposures.get(answer.file) != exposure:
            contradiction = f"frame {answer.frame} is not {answer.file}"
        if contradiction is not None:
            raise AnswersError(self._source, f"line {answer.line} contradicts itself: {contradiction}; not sent")
        objection = self._first.objection(answer, exposure.start_utc_s)
        if objection is not None:
            raise AnswersError(self._source, f"{objection}; not sent")
        utc_s = {"start": exposure.start_utc_s, "middle": exposure.mid_utc_s, "end": exposure.stop_utc_s}
        sigma_m = None if answer.ellipse is None else 1000 * answer.ellipse.sigma_km
        return PositionFix(answer.latitude_rad, answer.longitude_rad, utc_s[answer.instant], sigma_m)


def placed_answers(answers: Path, export: Path) -> "list[PlacedAnswer]":
    """Return the solved answers of a file, in the order of their times.

    `answers`: a file as `glstar.score` reads it; `export`: the directory of the frames, with ``truth.jsonl``.  Raises
    AnswersError if no line is an answer, or one is for no frame of the export; ExportError if there is no truth, as in
    the directory for the navigator that ``--blind`` leaves.
    """
    from glstar.export.navigator import NAV  # noqa: PLC0415 - OpenCV
    from glstar.export.truth.lines import read_truth  # noqa: PLC0415 - only for a replay

    if not (export / "truth.jsonl").is_file() and (export / NAV).is_file():
        raise ExportError(export, "is for a navigator and has no truth.jsonl; name the directory of --blind")
    # By number and by file: number, file, middle by the camera's clock and length of each frame, and its instants.
    frames: dict[int | str | None, tuple[tuple[int, str, float, float], dict[str, float]]] = {}
    offset_s = clock_offset_s(export)
    for line in read_truth(export):
        start_s, middle_s = parse_utc(line["utc_start"]), parse_utc(line["utc_mid"])
        instants_s = {"start": start_s, "middle": middle_s, "end": 2 * middle_s - start_s}
        stamp = line["frame"], line["file"], camera_utc_mid_s(line, offset_s), 2 * (middle_s - start_s)
        frames[line["frame"]] = frames[line["file"]] = stamp, instants_s
    given, first = read_answers(answers), FirstAnswers()
    faults, counted = list(given.faults), dict[int, Answer]()
    for answer in given.answers:
        if answer.of not in frames:
            raise AnswersError(answers, f"line {answer.line} answers frame {answer.of}, which {export} does not have")
        stamp, _ = frames[answer.of]
        if contradiction := answer.contradiction(*stamp):
            faults.append(f"line {answer.line} contradicts itself: {contradiction}")
        elif objection := first.objection(answer, stamp[0]):
            faults.append(objection)
        else:
            counted[stamp[0]] = answer
    for fault in faults:
        echo_note(f"{answers}: {fault}; not shown")
    placed = [
        _placed(answer, str(answer.of), frames[number][1][answer.instant])
        for number, answer in counted.items()
        if answer.solved
    ]
    return sorted(placed, key=lambda answer: answer.utc_s)


class ShownAnswers(IncomingAnswers):
    """Answers that are shown in the window of a live link, at the UTC that they state.

    `source`: as for `IncomingAnswers`; `config`: its clocks relate the camera's UTC to the link's; `show`:
    called on the thread with a `PlacedAnswer`; `report`: called with a message for each answer that cannot be shown.
    """

    def __init__(
        self, source: str | Path, config: Config, show: "Callable[[PlacedAnswer], None]", report: Callable[[str], None]
    ) -> None:
        super().__init__(source, report)
        self._clock_offset_s = _camera_clock_offset_s(config)
        self._show = show

    def take(self, answer: Answer) -> None:
        """Show an answer; raises AnswersError if it has no UTC, because the window has no frames of other programs."""
        if answer.utc_s is None:
            raise AnswersError(
                self._source, f"line {answer.line} has no utc, by which a live window places it; not shown"
            )
        if answer.solved:
            utc_s = answer.utc_s - self._clock_offset_s
            self._show(_placed(answer, f"of {format_utc(utc_s)[11:21]}", utc_s))


def _placed(answer: Answer, frame: str, utc_s: float) -> "PlacedAnswer":
    from glstar.viewer.overlays.belief import PlacedAnswer  # noqa: PLC0415 - the viewer, only for a window

    latitude_rad, longitude_rad = answer.latitude_rad, answer.longitude_rad
    ellipse = answer.ellipse
    return PlacedAnswer(
        utc_s,
        frame,
        answer.C_camera_icrs,
        None if latitude_rad is None or longitude_rad is None else (latitude_rad, longitude_rad),
        None if ellipse is None else (ellipse.major_km, ellipse.minor_km, ellipse.azimuth_rad),
    )
