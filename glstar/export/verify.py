"""``glstar export --verify``: whether a directory holds what an export would write, frame by frame."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.directorylock import directory_lock
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.images import decode
from glstar.export.layout import files_of
from glstar.export.manifest import NAME, refuse_other_settings, written
from glstar.export.shard import WHOLE, Shard
from glstar.export.truthfile import TruthFile
from glstar.system.durable import TEMPORARY

if TYPE_CHECKING:
    from glstar.export.executors import Checker
    from glstar.export.run import EncodedFrame, Export

__all__ = ["CheckedFrame", "Finding", "Verification", "check_files", "verify"]


_TRUTH: Final = "truth.jsonl"
_FRAME: Final = re.compile(r"frame_\d{6,}(\.light)?\.(png|tiff)")
_BITS: Final = {"png": np.uint8, "png16": np.uint16, "tiff": np.uint16}


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong.

    Attributes
    ----------
    file : str
        Its name, from the directory of the export.
    problem : str
        What is wrong with it.
    frame : int or None
        The frame that it belongs to.
    """

    file: str
    problem: str
    frame: int | None = None


@dataclass(frozen=True, slots=True)
class CheckedFrame:
    """A frame whose files have been compared with what is drawn.

    Attributes
    ----------
    number : int
    findings : tuple of Finding
        What is wrong with its files.
    truth : bytes
        The line of truth that is drawn; it has yet to be compared.
    """

    number: int
    findings: tuple[Finding, ...]
    truth: bytes


@dataclass(frozen=True, slots=True)
class Verification:
    """What a verification found.

    Attributes
    ----------
    directory : Path
    frames : int
        How many were checked.
    findings : tuple of Finding
    drawn_by : str
        The OpenGL driver of the directory's frames.
    is_redrawn : bool
        Whether each frame was drawn again and compared byte by byte; not with another driver, whose bytes differ.
    """

    directory: Path
    frames: int
    findings: tuple[Finding, ...]
    drawn_by: str
    is_redrawn: bool


def verify(
    export: "Export",
    crew: "Checker",
    *,
    shard: Shard = WHOLE,
    on_frame: Callable[[int, int], None] | None = None,
) -> Verification:
    """Compare a directory with what an export would write there; nothing is written.

    Parameters
    ----------
    export : Export
    crew : Executor
        Who draws.  With the driver that drew the directory's frames each of them is drawn again, and image, light and
        line of truth are compared byte by byte.  With another driver the images are decoded, and matched with the
        lines.
    shard : Shard
        The share to check.
    on_frame : callable
        Called with the number of frames checked and of all, after each.

    Returns
    -------
    Verification

    Raises
    ------
    ExportError
        If there is no export in the directory, one of other settings, or one that is being written.
    """
    directory, numbers = export.directory, shard.share(export.frames.numbers)
    tell = on_frame or (lambda *_: None)
    if not directory.is_dir():
        raise ExportError(directory, "is not there, so there is nothing to verify; run the command without --verify")
    with explain_disk_errors(directory), ExitStack() as held:
        held.enter_context(directory_lock(directory, shared=True))
        drawn_by = _driver_of(directory)
        manifest = export.manifest | {"renderer": drawn_by}
        refuse_other_settings(directory, manifest)
        truth = TruthFile(directory)
        truth.read()
        is_redrawn = drawn_by == crew.driver
        findings: list[Finding] = []
        checked = crew.check(export, numbers) if is_redrawn and len(numbers) else _decoded(export, numbers, truth)
        for done, frame in enumerate(checked, start=1):
            findings += frame.findings
            findings += _check_line(frame.number, truth.line(frame.number), frame.truth if is_redrawn else None)
            tell(done, len(numbers))
        if shard.is_whole:
            findings += _check_rest(export, manifest, truth)
    order = np.argsort([np.inf if one.frame is None else one.frame for one in findings], kind="stable")
    return Verification(directory, len(numbers), tuple(findings[which] for which in order), drawn_by, is_redrawn)


def check_files(export: "Export", frame: "EncodedFrame") -> CheckedFrame:
    """Compare a frame's image and light with what has been drawn.

    Parameters
    ----------
    export : Export
    frame : EncodedFrame

    Returns
    -------
    CheckedFrame
    """
    drawn = {export.image_path(frame.number): frame.image}
    if frame.light is not None:
        drawn[export.light_path(frame.number)] = frame.light
    findings = [
        Finding(path.relative_to(export.directory).as_posix(), problem, frame.number)
        for path, content in drawn.items()
        if (problem := _difference(path, content))
    ]
    return CheckedFrame(frame.number, tuple(findings), frame.truth)


def _difference(path: Path, drawn: bytes) -> str:
    """Say how a file differs from what is drawn; nothing if it does not."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return "is missing"
    if content == drawn:
        return ""
    try:
        pixels = decode(content, path.suffix)
    except ValueError as error:
        return str(error)
    wanted = decode(drawn, path.suffix)
    if pixels.shape != wanted.shape or pixels.dtype != wanted.dtype:
        return f"is {_described(pixels)}, and {_described(wanted)} are drawn"
    differ = np.abs(pixels.astype(np.float64) - wanted)
    if not differ.any():
        return "has the pixels that are drawn, but other bytes"
    return (
        f"{np.count_nonzero(differ)} of {differ.size} pixels differ from what is drawn, by {differ.max():g} DN at most"
    )


def _described(pixels: NDArray[Any]) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]} px of {pixels.dtype}"


def _check_line(number: int, line: bytes | None, drawn: bytes | None) -> list[Finding]:
    """Compare a frame's line of truth with what is drawn, if it is."""
    if line is None:
        return [Finding(_TRUTH, f"frame {number} has no whole line", number)]
    if drawn is None or line == drawn:
        return []
    there, wanted = orjson.loads(line), orjson.loads(drawn)
    keys = [key for key in wanted if there.get(key) != wanted[key]] or ["its spelling"]
    return [Finding(_TRUTH, f"the line of frame {number} differs from what is drawn, in {', '.join(keys)}", number)]


def _check_rest(export: "Export", manifest: dict[str, Any], truth: TruthFile) -> Iterator[Finding]:
    """Check what belongs to no frame: the manifest, the truth as a whole, and files that should not be there."""
    if (export.directory / NAME).read_bytes() != written(manifest):
        yield Finding(NAME, "differs from what this command writes")
    numbers = export.frames.numbers
    if not (export.directory / _TRUTH).exists():
        yield Finding(_TRUTH, "is missing: the export has not ended")
    elif not truth.is_finished(numbers) and not np.setdiff1d(numbers, truth.numbers).size:
        yield Finding(_TRUTH, "has damaged lines, lines twice or in another order, or lines of no frame")
    paths = [export.image_path] + [export.light_path] * export.light
    ours = {path(number) for path in paths for number in numbers.tolist()}
    for path in sorted(files_of(export.directory)):
        name = path.relative_to(export.directory).as_posix()
        if path.name.startswith(TEMPORARY) or path.name.endswith(".partial"):
            yield Finding(name, "is left of a run that was cut off; the next run removes it")
        elif _FRAME.fullmatch(path.name) and path not in ours:
            yield Finding(name, "belongs to no frame of this export")


# --- without drawing --------------------------------------------------------------------------------------------------


def _decoded(export: "Export", numbers: NDArray[np.int64], truth: TruthFile) -> Iterator[CheckedFrame]:
    """Decode the images of frames, and match them with their lines of truth."""
    for number in numbers.tolist():
        line = truth.line(number)
        camera = orjson.loads(line)["camera"] if line is not None else None
        kinds: dict[Path, type] = {export.image_path(number): _BITS[export.image_format]}
        if export.light:
            kinds[export.light_path(number)] = np.float32
        findings = [
            Finding(path.relative_to(export.directory).as_posix(), problem, number)
            for path, kind in kinds.items()
            if (problem := _mismatch(path, kind, camera))
        ]
        yield CheckedFrame(number, tuple(findings), b"")


def _mismatch(path: Path, kind: type, camera: dict[str, Any] | None) -> str:
    """Say what is wrong with an image, or how it differs from what its line of truth says."""
    try:
        pixels = decode(path.read_bytes(), path.suffix)
    except FileNotFoundError:
        return "is missing"
    except ValueError as error:
        return str(error)
    if pixels.dtype != kind:
        return f"is {_described(pixels)}, not of {np.dtype(kind)}"
    if camera is not None and pixels.shape != (camera["height_px"], camera["width_px"]):
        return f"is {_described(pixels)}, and its line of truth says {camera['width_px']} x {camera['height_px']} px"
    return ""


def _driver_of(directory: Path) -> str:
    """Return the OpenGL driver that a manifest names; nothing where there is none."""
    try:
        return str(json.loads((directory / NAME).read_bytes())["renderer"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
