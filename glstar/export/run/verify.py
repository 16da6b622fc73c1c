"""``glstar export --verify``: comparison of a directory with what an export would write, frame by frame."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.export.directory import NOISELESS_SUFFIX, directory_lock, explain_disk_errors, output_files
from glstar.export.frame import CheckedFrame, Finding, FrameTask, describe_pixels
from glstar.export.imagefiles.formats import decode
from glstar.export.imagefiles.masks import MASK_KINDS, MASK_SUFFIXES
from glstar.export.plan.manifest import NAME, refuse_other_settings, to_json
from glstar.export.run.executors import Checker
from glstar.export.run.export import ALL_FRAMES, Export, Shard
from glstar.export.truth.lines import TruthFile
from glstar.system.files import TEMPORARY
from glstar.system.userinput import read_json, read_whole

_TRUTH = "truth.jsonl"
_FRAME = re.compile(r"frame_\d{6,}(\.(light|trails|saturated|cloud|flare|ground))?\.(png|tiff|fits|jpg)")
_PIXEL_TYPES = {"png": np.uint8, "png16": np.uint16, "tiff": np.uint16, "fits": np.uint16, "jpeg": np.uint8}
# Of the files beside an image, by the suffix of their names.
_OTHER_TYPES: dict[str, type] = {
    NOISELESS_SUFFIX: np.float32,
    **{MASK_SUFFIXES[kind]: pixel_type for kind, pixel_type in MASK_KINDS.items()},
}


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of a verification."""

    directory: Path
    frames: int  # Number of frames checked
    findings: tuple[Finding, ...]  # In the order of the frames; those that belong to no frame come last
    drawn_by: str  # The OpenGL driver that drew the frames in the directory
    # Whether each frame was drawn again and compared byte by byte; false if the OpenGL driver is another one, which
    # draws other bytes.
    is_redrawn: bool


def verify(
    export: Export,
    checker: Checker,
    *,
    shard: Shard = ALL_FRAMES,
    on_frame: Callable[[int, int], None] | None = None,
) -> Verification:
    """Compare a directory with what an export would write there; nothing is written.

    If the OpenGL driver of the checker, a `SerialExecutor` or `ProcessExecutor`, is the one that drew the directory,
    each frame is drawn again, and its files and its line of truth are compared byte by byte. With another driver the
    images are decoded and compared with their lines of truth. `on_frame` is called with the number of checked frames
    and of all frames, after each frame. Raises ExportError if the directory holds no export or one of other settings,
    or is being written.
    """
    task, directory, numbers = export.task, export.directory, shard.select(export.numbers)
    report_progress = on_frame or (lambda *_: None)
    if not directory.is_dir():
        raise ExportError(directory, "is not there, so there is nothing to verify; run the command without --verify")
    with explain_disk_errors(directory), ExitStack() as locked:
        locked.enter_context(directory_lock(directory, shared=True))
        drawn_by = _driver_of(directory)
        manifest = export.manifest | {"renderer": drawn_by}
        refuse_other_settings(directory, manifest)
        truth = TruthFile(directory)
        truth.read()
        is_redrawn = drawn_by == checker.driver
        findings: list[Finding] = []
        checked = checker.check(task, numbers) if is_redrawn and len(numbers) else _decoded(task, numbers, truth)
        for done, frame in enumerate(checked, start=1):
            findings += frame.findings
            findings += _check_line(frame.number, truth.line(frame.number), frame.truth if is_redrawn else None)
            report_progress(done, len(numbers))
        if shard.is_all:
            findings += _check_directory(task, manifest, truth)
    order = np.argsort([np.inf if one.frame is None else one.frame for one in findings], kind="stable")
    return Verification(directory, len(numbers), tuple(findings[which] for which in order), drawn_by, is_redrawn)


def _check_line(number: int, line: bytes | None, drawn: bytes | None) -> list[Finding]:
    """Compare the line of truth of a frame with the one that is drawn, unless that is None."""
    if line is None:
        return [Finding(_TRUTH, f"frame {number} has no complete line", number)]
    if drawn is None or line == drawn:
        return []
    written, expected = orjson.loads(line), orjson.loads(drawn)
    keys = [key for key in expected if written.get(key) != expected[key]] or ["its spelling"]
    return [Finding(_TRUTH, f"the line of frame {number} differs from what is drawn, in {', '.join(keys)}", number)]


def _check_directory(task: FrameTask, manifest: dict[str, Any], truth: TruthFile) -> Iterator[Finding]:
    """Check the manifest, the order of the truth, and files that belong to no frame."""
    if (task.directory / NAME).read_bytes() != to_json(manifest):
        yield Finding(NAME, "differs from what this command writes")
    numbers = task.frames.numbers
    if not (task.directory / _TRUTH).exists():
        yield Finding(_TRUTH, "is missing: the export has not ended")
    elif not truth.is_finished(numbers) and not np.setdiff1d(numbers, truth.numbers).size:
        yield Finding(_TRUTH, "has damaged lines, lines twice or in another order, or lines of no frame")
    expected = {path_of(number) for path_of in task.file_kinds.values() for number in numbers.tolist()}
    for path in sorted(output_files(task.directory)):
        name = path.relative_to(task.directory).as_posix()
        if path.name.startswith(TEMPORARY) or path.name.endswith(".partial"):
            yield Finding(name, "is left of a run that was cut off; the next run removes it")
        elif _FRAME.fullmatch(path.name) and path not in expected:
            yield Finding(name, "belongs to no frame of this export")


# --- without drawing --------------------------------------------------------------------------------------------------


def _decoded(task: FrameTask, numbers: NDArray[np.int64], truth: TruthFile) -> Iterator[CheckedFrame]:
    """Decode the images of frames and compare them with their lines of truth."""
    for number in numbers.tolist():
        line = truth.line(number)
        camera = orjson.loads(line)["camera"] if line is not None else None
        types: dict[Path, type] = {
            path_of(number): _OTHER_TYPES.get(suffix, _PIXEL_TYPES[task.image_format])
            for suffix, path_of in task.file_kinds.items()
        }
        findings = [
            Finding(path.relative_to(task.directory).as_posix(), problem, number)
            for path, pixel_type in types.items()
            if (problem := _mismatch(path, pixel_type, camera))
        ]
        yield CheckedFrame(number, tuple(findings), b"")


def _mismatch(path: Path, pixel_type: type, camera: dict[str, Any] | None) -> str:
    """Return a message on how an image is damaged or differs from its line of truth; empty if it does not."""
    try:
        pixels = decode(path.read_bytes(), path.suffix)
    except FileNotFoundError:
        return "is missing"
    except ValueError as error:
        return str(error)
    if pixels.dtype != pixel_type:
        return f"is {describe_pixels(pixels)}, not of {np.dtype(pixel_type)}"
    if camera is not None and pixels.shape[:2] != (camera["height_px"], camera["width_px"]):
        size = f"{camera['width_px']} x {camera['height_px']} px"
        return f"is {describe_pixels(pixels)}, and its line of truth says {size}"
    return ""


def _driver_of(directory: Path) -> str:
    """Return the OpenGL driver in the manifest; empty if there is no manifest."""
    try:
        return str(read_json(read_whole(directory / NAME))["renderer"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
