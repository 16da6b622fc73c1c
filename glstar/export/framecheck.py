"""Comparison of a frame's files with the frame as it is drawn now."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.export.images import decode
from glstar.export.task import EncodedFrame, FrameTask

__all__ = ["CheckedFrame", "Finding", "check_files", "describe_pixels"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A difference between a directory and what its export would write.

    Attributes
    ----------
    file : str
        Path of the file, relative to the directory of the export.
    problem : str
        A message that continues "FILE: ".
    frame : int or None
        The frame of the file, if it belongs to one.
    """

    file: str
    problem: str
    frame: int | None = None


@dataclass(frozen=True, slots=True)
class CheckedFrame:
    """A frame whose image files have been compared with what is drawn.

    Attributes
    ----------
    number : int
    findings : tuple of Finding
        Differences of its files.
    truth : bytes
        The line of truth as it is drawn, which has not been compared yet.
    """

    number: int
    findings: tuple[Finding, ...]
    truth: bytes


def check_files(task: FrameTask, frame: EncodedFrame) -> CheckedFrame:
    """Compare the image files of a frame with the frame as it is drawn.

    Parameters
    ----------
    task : FrameTask
    frame : EncodedFrame

    Returns
    -------
    CheckedFrame
    """
    drawn = {task.image_path(frame.number): frame.image}
    if frame.noiseless is not None:
        drawn[task.noiseless_path(frame.number)] = frame.noiseless
    drawn |= {task.mask_path(kind, frame.number): mask for kind, mask in frame.masks.items()}
    findings = [
        Finding(path.relative_to(task.directory).as_posix(), problem, frame.number)
        for path, content in drawn.items()
        if (problem := _difference(path, content))
    ]
    return CheckedFrame(frame.number, tuple(findings), frame.truth)


def _difference(path: Path, drawn: bytes) -> str:
    """Return a message on how a file differs from what is drawn; empty if it does not."""
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
    expected = decode(drawn, path.suffix)
    if pixels.shape != expected.shape or pixels.dtype != expected.dtype:
        return f"is {describe_pixels(pixels)}, and {describe_pixels(expected)} are drawn"
    differ = np.abs(pixels.astype(np.float64) - expected)
    if not differ.any():
        return "has the pixels that are drawn, but other bytes"
    return (
        f"{np.count_nonzero(differ)} of {differ.size} pixels differ from what is drawn, by {differ.max():g} DN at most"
    )


def describe_pixels(pixels: NDArray[Any]) -> str:
    """Return the size and type of an image, for messages.

    Parameters
    ----------
    pixels : (height, width) array

    Returns
    -------
    str
        Such as "160 x 120 px of uint8".
    """
    return f"{pixels.shape[1]} x {pixels.shape[0]} px of {pixels.dtype}"
