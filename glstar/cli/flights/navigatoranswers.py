"""A navigator's answers, read while it writes them.

A navigator's answers as position fixes for the autopilot.
"""

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import Event, Thread
from typing import IO, Final, Self

from glstar.camera.exposure import Exposure
from glstar.errors import AnswersError
from glstar.export.publish.stream import STREAM, AnswerReceiver
from glstar.link import Injector, PositionFix
from glstar.score.answers import Answer, parse_answer

# Name of the standard input.
STDIN: Final = Path("-")
# Interval at which a file of answers is read, s.
_POLL_S: Final = 0.02


class IncomingAnswers(ABC):
    """Answers that a navigator writes now; a context manager with a thread that reads them.

    `source`: ``zmq://HOST:PORT``, where `glstar answer` and other programs send them; or a file that the navigator
    appends JSON lines to, as `glstar.score` reads them; ``-`` is the standard input; lines that are in the file already
    are skipped: they are of an earlier run; `report`: called with a message for each answer that is not valid.  Raises
    AnswersError if the source is a directory; ConfigError if the address is not valid or in use, or pyzmq is not
    installed.
    """

    def __init__(self, source: str | Path, report: Callable[[str], None]) -> None:
        self._receiver = AnswerReceiver(source) if isinstance(source, str) and source.startswith(STREAM) else None
        source = Path(source)
        self._source, self._report = source, report
        self._ending, self._number = Event(), 0
        self._start = source.stat().st_size if source != STDIN and source.is_file() else 0
        if source != STDIN and source.exists() and not source.is_file():
            raise AnswersError(source, "is no file; pipe answers into --answers -")
        self._thread = Thread(target=self._run, name="glstar answers", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        if self._source != STDIN:
            self._thread.join()  # a read of the standard input cannot be interrupted

    @abstractmethod
    def take(self, answer: Answer) -> None:
        """Use an answer; called on the thread; raises AnswersError if it cannot be used; the error is reported."""

    def _run(self) -> None:
        try:
            for line in self._lines():
                self._number += 1
                if line.strip():
                    self._process(line)
        except (OSError, ValueError) as error:
            self._report(f"answers: {error}")

    def _lines(self) -> Iterator[str]:
        if self._receiver is not None:
            return self._received(self._receiver)
        return _stdin_lines() if self._source == STDIN else self._file_lines()

    def _received(self, receiver: AnswerReceiver) -> Iterator[str]:
        """Yield the lines that arrive, and close the receiver at the end."""
        while not self._ending.is_set():
            yield from receiver.lines(_POLL_S)
        receiver.close()

    def _file_lines(self) -> Iterator[str]:
        """Yield the complete lines of the file as they are appended."""
        while not self._source.exists():
            if self._ending.wait(_POLL_S):
                return
        with self._source.open(encoding="utf-8") as file:
            file.seek(self._start)
            yield from self._appended(file)

    def _appended(self, file: IO[str]) -> Iterator[str]:
        begun = ""
        while True:
            is_over = self._ending.is_set()
            while part := file.readline():
                begun += part
                if begun.endswith("\n"):
                    yield begun
                    begun = ""
            if is_over:
                return
            time.sleep(_POLL_S)

    def _process(self, line: str) -> None:
        try:
            self.take(parse_answer(self._source, self._number, line))
        except AnswersError as error:
            self._report(str(error))


def _stdin_lines() -> Iterator[str]:
    yield from sys.stdin


class InjectedAnswers(IncomingAnswers):
    """Answers that are sent to the autopilot.

    `source`: as for `IncomingAnswers`; `exposures`: of the frames that were drawn, by number and by file name;
    `report`: called with a message for each answer that cannot be sent.
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
        """Send the position of an answer, if it has one; raises AnswersError if it is for no frame that was drawn."""
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
