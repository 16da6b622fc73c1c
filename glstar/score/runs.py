"""Runs of a solver on a set: its command for each part, its answers, and their score as one result."""

import json
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from glstar import __version__
from glstar.errors import AnswersError, ExportError, GlstarError
from glstar.export.truth.lines import DETECTABLE_SNR
from glstar.score.frames import FrameScore, Limits, read_frame_truths, score_frame
from glstar.score.metrics import BINS, summarized
from glstar.score.scoring import matched_answers
from glstar.score.sets import FRAMES, TRUTH, MadeSet
from glstar.system.files import write_atomically

SCHEMA = "glstar-bench-1"
RESULT_FILE = "result.json"
_PARTS = "part"
# Keys of a result that tables read.
_KEYS: Final[Mapping[str, set[str]]] = {
    "solver": {"name", "version"},
    "set": {"set", "size", "pixels_sha256"},
    "summary": {"frames", "solved", "refused", "false", "boresight_arcsec", "roll_arcsec", "position_km", "run_time_s"},
    "by": set(),
}


@dataclass(frozen=True, slots=True)
class Solver:
    """A program that answers the frames of a directory."""

    command: tuple[str, ...]  # Its words; the directory of frames and the file of answers are appended
    name: str
    version: str  # As its user states it; empty if unknown

    def answer(self, frames: Path, answers: Path, log: Path, timeout_s: float) -> str | None:
        """Run the program on the frames of one part; return why it failed, or None.

        What it prints goes to a file. Answers that it wrote before it failed count.
        """
        words = [*self.command, str(frames.resolve()), str(answers.resolve())]
        with log.open("wb") as output:
            try:
                status = subprocess.run(  # noqa: S603 - the user's own program
                    words, stdout=output, stderr=subprocess.STDOUT, timeout=timeout_s, check=False
                ).returncode
            except subprocess.TimeoutExpired:
                return f"was stopped after {timeout_s:g} s"
            except OSError as error:
                return f"cannot be started ({error.strerror})"
        if status == 0:
            return None
        last = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        return f"ended with status {status}" + (f": {last[-1].strip()}" if last else "")


def run_solver(
    solver: Solver,
    made: MadeSet,
    output: Path,
    *,
    timeout_s: float,
    on_part: Callable[[str], None],
) -> tuple[dict[str, Any], dict[str, str]]:
    """Run a solver on each part of a set and score its answers.

    Writes ``PART.jsonl``, ``PART.log`` and ``result.json`` into `output`. `on_part` is called with the name of each
    part that begins. Returns the result, and why the solver failed on each part where it did. Raises ExportError if
    the program does not exist.
    """
    if shutil.which(solver.command[0]) is None:
        raise ExportError(solver.command[0], "is no program; give the command as you would type it, in quotes")
    output.mkdir(parents=True, exist_ok=True)
    failures: dict[str, str] = {}
    scores: dict[str, list[FrameScore]] = {}
    invalid = 0
    seconds: dict[str, float] = {}
    for part in made.parts:
        on_part(part)
        answers = output / f"{part}.jsonl"
        answers.unlink(missing_ok=True)
        began_s = time.monotonic()
        failure = solver.answer(made.directory / FRAMES / part, answers, output / f"{part}.log", timeout_s)
        seconds[part] = round(time.monotonic() - began_s, 1)
        scores[part], faults, unread = _scored(made.directory / TRUTH / part, answers)
        invalid += len(faults)
        if failure or unread:
            failures[part] = failure or str(unread)
    result = _result(solver, made, scores, seconds, failures, invalid)
    write_atomically(output / RESULT_FILE, (json.dumps(result, indent=1) + "\n").encode())
    return result, failures


def _scored(truth: Path, answers: Path) -> tuple[list[FrameScore], Sequence[str], str | None]:
    """Return the scores of a part, the faults of its answers, and why none could be read.

    Frames without an answer are refused.
    """
    truths = read_frame_truths(truth, least_snr=DETECTABLE_SNR)
    try:
        matched, faults = matched_answers(answers, truths) if answers.exists() else ({}, ())
        unread = None if answers.exists() else "wrote no answers"
    except AnswersError as error:
        matched, faults, unread = {}, (), f"wrote no valid answer ({error})"
    return [score_frame(one, matched.get(one.frame), Limits()) for one in truths], faults, unread


def _result(
    solver: Solver,
    made: MadeSet,
    scores: Mapping[str, Sequence[FrameScore]],
    seconds: Mapping[str, float],
    failures: Mapping[str, str],
    invalid: int,
) -> dict[str, Any]:
    frames = [one for part in scores.values() for one in part]
    bins = {one.name: [(label, summarized(inside)) for label, inside in one.grouped(frames)] for one in BINS}
    groups = {_PARTS: [(part, summarized(inside)) for part, inside in scores.items()]}
    groups |= {name: found for name, found in bins.items() if len(found) > 1}
    return {
        "schema": SCHEMA,
        "solver": {"name": solver.name, "version": solver.version, "command": list(solver.command)},
        "set": {key: value for key, value in made.json.items() if key not in {"schema", "parts"}}
        | {"pixels_sha256": {part: sums.pixels_sha256 for part, sums in made.parts.items()}},
        "glstar": __version__,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": platform.machine(),
        "seconds": dict(seconds),
        "failures": dict(failures),
        "invalid_lines": invalid,
        "summary": summarized(frames).json,
        "by": {name: {label: summary.json for label, summary in found} for name, found in groups.items()},
    }


def read_result(path: Path) -> dict[str, Any]:
    """Return a result from its file or directory; raises GlstarError if it is none."""
    file = path / RESULT_FILE if path.is_dir() else path
    try:
        result: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        is_known = result["schema"] == SCHEMA
        is_complete = all(keys <= result[part].keys() for part, keys in _KEYS.items())
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise GlstarError(f"{file} is no result of glstar bench run ({reason})") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        is_known = is_complete = False
    if not is_known or not is_complete:
        raise GlstarError(f"{file} is no result of glstar bench run, or of another version")
    return result
