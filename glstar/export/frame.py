"""Drawing and writing of the frames of an export, and their comparison with the files of a directory.

`FrameTask` is a description that can be pickled: every process draws from it. `FrameWriter` writes so that frames
survive a power failure, in an order that is safe on every file system:

1. the files of a frame are written under temporary names,
2. flushed, together with the files of other frames, on a background thread,
3. renamed, so that a file with its final name is complete,
4. the line of truth is appended.

A power failure may lose any steps that have not been flushed. If a frame has its files and its line afterwards, they
are complete; any other frame is drawn again. The flush of the next group makes the names and lines of the previous one
durable.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.export.directory import NOISELESS_SUFFIX, Lease, frame_folder, make_folder
from glstar.export.imagefiles.exif import with_exif
from glstar.export.imagefiles.fits import encode_fits
from glstar.export.imagefiles.formats import SUFFIX, ImageFormat, decode, encode, tiff
from glstar.export.imagefiles.masks import MASK_SUFFIXES, MaskKind, encoded_masks
from glstar.export.imagefiles.processing import CameraProcessing, process
from glstar.export.plan.frames import ComposedFrame, Frames
from glstar.export.truth.lines import TruthFile
from glstar.render.scene.scene import Frame, PendingFrame, Renderer, Scene
from glstar.render.truth.frame import frame_truth
from glstar.system.files import StagedFile, flush, flush_directory, flush_handle, write_atomically


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """A frame as the content of its files."""

    number: int  # Frame number
    image: bytes  # The image file
    noiseless: bytes | None  # The float32 TIFF of the signal before noise; None unless the task asks for it
    truth: bytes  # The line of ``truth.jsonl``, with its newline
    masks: Mapping[MaskKind, bytes] = field(default_factory=dict)  # Its masks by kind


@dataclass(frozen=True, slots=True, eq=False)
class FrameTask:
    """How to draw the frames of an export and where to write them.

    It holds no open file and no OpenGL object, so it can be pickled: another process draws the same bytes from it.
    """

    frames: Frames
    directory: Path
    image_format: ImageFormat  # {"png", "png16", "tiff", "fits", "jpeg"}
    noiseless: bool  # Whether to write the signal before noise beside each frame
    seed: int  # The seed from which the noise seed of every frame is derived
    # The write permission of the run that distributes the task to other processes; None within one process.
    lease: Lease | None = None
    masks: tuple[MaskKind, ...] = ()  # The masks to write beside each frame
    exif: bool = False  # Whether images have EXIF

    def begin(self, renderer: Renderer, composed: ComposedFrame) -> PendingFrame:
        """Begin to draw a composed frame with its own noise."""
        renderer.develop(composed.scene, seed=frame_seed(self.seed, composed.number), light=self.noiseless)
        return renderer.read()

    def encode(
        self,
        composed: ComposedFrame,
        frame: Frame,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> EncodedFrame:
        """Return the content of the files of a frame drawn from ``composed.scene``.

        `on_pixels` is called with the pixels and the line of truth before the image is encoded, for a consumer that
        needs them with low latency.
        """
        number = composed.number
        file = self.image_path(number).relative_to(self.directory).as_posix()
        line = frame_truth(composed.scene, frame, number=number, file=file, about=composed.extra_truth)
        if on_pixels is not None:
            on_pixels(frame.pixels, line)
        if self.image_format == "fits":
            image = encode_fits(composed.scene, frame, number=number, shift_bits=_shift_bits(composed.scene))
        else:
            image = self._encoded(composed.scene, frame.pixels)
        if self.exif:
            image = with_exif(image, SUFFIX[self.image_format], orjson.loads(line))
        return EncodedFrame(
            number=number,
            image=image,
            noiseless=None if frame.light_dn is None else tiff(frame.light_dn),
            truth=line,
            masks=encoded_masks(self.masks, composed.scene, frame),
        )

    def _encoded(self, scene: Scene, pixels: np.ndarray[Any, Any]) -> bytes:
        """Return an image as the bytes of its file, after the camera's processing."""
        processing = CameraProcessing.of(scene.sensor)
        if processing.is_active:
            pixels = process(pixels, scene.sensor, sixteen_bits=self.image_format in {"png16", "tiff"})
        quality = processing.jpeg_quality
        return encode(pixels, self.image_format, jpeg_quality=quality, shift_bits=_shift_bits(scene))

    def draw(
        self,
        renderer: Renderer,
        number: int,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> EncodedFrame:
        """Draw one frame and return the content of its files; nothing is written. `on_pixels` is that of `encode`."""
        composed = self.frames.compose(number)
        return self.encode(composed, self.begin(renderer, composed).frame(), on_pixels=on_pixels)

    def write(self, frame: EncodedFrame, write: Callable[[Path, bytes], None] = write_atomically) -> None:
        """Write the files of a frame, without its line of truth.

        `write` is called with the path and the content of each file; the default writes the file atomically. Raises
        OSError if a file cannot be written; ExportError if another run has taken over the directory, or a link has the
        name of a folder.
        """
        path = self.image_path(frame.number)
        if path.parent != self.directory:
            with self.writing():
                make_folder(path.parent)
        write(path, frame.image)
        if frame.noiseless is not None:
            write(self.noiseless_path(frame.number), frame.noiseless)
        for kind, mask in frame.masks.items():
            write(self.mask_path(kind, frame.number), mask)

    def writing(self) -> AbstractContextManager[None]:
        """Return a context in which this run may write to the directory.

        Entering it raises ExportError if another run has taken over the directory.
        """
        return nullcontext() if self.lease is None else self.lease.writing()

    def absolute(self) -> Self:
        """Return the task with absolute paths, for processes with another working directory."""
        return replace(self, directory=self.directory.absolute())

    def image_path(self, number: int) -> Path:
        """Return the path of a frame's image.

        The first 10,000 frames are in the directory itself, others in folders of 1000: file managers are slow with a
        million files in one folder.
        """
        return self.directory / frame_folder(number) / f"frame_{number:06d}{SUFFIX[self.image_format]}"

    def noiseless_path(self, number: int) -> Path:
        """Return the path of the signal before noise of a frame."""
        return self.directory / frame_folder(number) / f"frame_{number:06d}{NOISELESS_SUFFIX}"

    def mask_path(self, kind: MaskKind, number: int) -> Path:
        """Return the path of a mask of a frame; `kind` {"trails", "saturated", "cloud", "flare", "ground"}."""
        return self.directory / frame_folder(number) / f"frame_{number:06d}{MASK_SUFFIXES[kind]}"

    @property
    def file_kinds(self) -> dict[str, Callable[[int], Path]]:
        """For each file of a frame: the suffix of its name, and the function that returns its path."""
        kinds: dict[str, Callable[[int], Path]] = {SUFFIX[self.image_format]: self.image_path}
        if self.noiseless:
            kinds[NOISELESS_SUFFIX] = self.noiseless_path
        for kind in self.masks:
            kinds[MASK_SUFFIXES[kind]] = partial(self.mask_path, kind)
        return kinds


def _shift_bits(scene: Scene) -> int:
    """Return by how many bits the numbers of a frame are shifted up in its file."""
    full_scale_dn = scene.exposure.full_scale_dn(scene.sensor.saturation_dn)
    return CameraProcessing.of(scene.sensor).shift_bits(full_scale_dn)


def frame_seed(seed: int, number: int, *others: int) -> int:
    """Return the noise seed of a frame, 0 to 2**32 - 1, from the seed of the export and the frame's number.

    `others`: numbers that make it another one.
    """
    return int(np.random.SeedSequence([seed, number, *others]).generate_state(1)[0])


# Minimum interval between the flushes of two groups, s, unless the group is large.  No process can create or rename
# files while ext4 commits its journal.  Groups take 0.2 to 0.7 ms per frame on ext4, single frames 3.4 ms.
_GROUP_INTERVAL_S = 0.5
# A smaller group waits up to the same time for more frames.
_GROUP_FRAMES = 8
# A group of this size is flushed at once: it limits the dirty memory, and the frames that a kill can lose.
_MAX_GROUP_FRAMES = 64
_MAX_GROUP_BYTES = 1 << 26


class FrameWriter:
    """Writes frames and their truth in an order that survives a power failure; a context manager.

    Leaving the context writes the frames that have been added and removes other staged files. `stage` may be called
    from any thread, all other methods from one thread. `lines` is that of `TruthFile.open_for_append`, `group_s` the
    minimum interval between flushes, s, and `writing` `FrameTask.writing`.
    """

    def __init__(
        self,
        truth: TruthFile,
        lines: IO[bytes],
        *,
        group_s: float = _GROUP_INTERVAL_S,
        writing: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self._truth, self._lines, self._group_s, self._writing = truth, lines, group_s, writing
        self._lock = Lock()
        self._staged: dict[int, list[StagedFile]] = {}  # by frame number
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._waiting_since_s = 0.0
        self._waiting_bytes = 0
        self._flushed_at_s = -inf
        self._group: deque[tuple[int, bytes]] = deque()  # being flushed, or flushed and not renamed yet
        self._flushed: Future[None] | None = None
        self._directories: set[Path] = set()  # with new names that have not been flushed
        self._flusher = ThreadPoolExecutor(1, "glstar-flush")
        self._helpers = ThreadPoolExecutor(_GROUP_FRAMES, "glstar-flush-file")

    def stage(self, number: int, path: Path, content: bytes) -> None:
        """Write a file of a frame under a temporary name; raises OSError if it cannot be written."""
        staged = StagedFile.beside(path)
        with self._lock:
            self._staged.setdefault(number, []).append(staged)
            self._waiting_bytes += len(content)
        with self._writing():
            staged.write(content)

    def add(self, number: int, line: bytes) -> Iterator[int]:
        """Add a frame whose files have been staged, and its line of truth; yield complete frames as `poll` does.

        Raises OSError if a frame cannot be written.
        """
        if not self._waiting:
            self._waiting_since_s = time.monotonic()
        self._waiting.append((number, line))
        yield from self.poll()

    def poll(self) -> Iterator[int]:
        """Rename the files that have been flushed, and flush the next group if it is due.

        Yields the frames whose files are renamed and whose line of truth is appended, in the order of `add`. Raises
        OSError if a frame cannot be written.
        """
        is_large = len(self._waiting) >= _MAX_GROUP_FRAMES or self._waiting_bytes >= _MAX_GROUP_BYTES
        if self._flushed is not None and (self._flushed.done() or is_large):
            yield from self._commit()
        if self._flushed is None and self._waiting and (is_large or self._is_due()):
            self._begin_flush()

    def _is_due(self) -> bool:
        now_s = time.monotonic()
        since_s = self._waiting_since_s if len(self._waiting) < _GROUP_FRAMES else self._flushed_at_s
        return now_s - since_s >= self._group_s

    def drain(self) -> Iterator[int]:
        """Write all frames that have been added, and yield them as `poll` does; raises OSError if it cannot."""
        while self._flushed is not None or self._waiting:
            if self._flushed is None:
                self._begin_flush()
            yield from self._commit()

    def _begin_flush(self) -> None:
        self._group, self._waiting = self._waiting, deque()
        self._flushed_at_s = time.monotonic()
        with self._lock:
            self._waiting_bytes = 0
            temporaries = [staged.temporary for number, _ in self._group for staged in self._staged.get(number, ())]
        directories, self._directories = self._directories, set()
        self._flushed = self._flusher.submit(self._flush, temporaries, directories)

    def _flush(self, temporaries: list[Path], directories: set[Path]) -> None:
        flush(temporaries, executor=self._helpers)
        if directories:  # names and lines of the previous group
            of_lines = self._helpers.submit(flush_handle, self._lines.fileno())
            deque(self._helpers.map(flush_directory, directories), maxlen=0)
            of_lines.result()

    def _commit(self) -> Iterator[int]:
        """Rename the files of the flushed group, and append the line of truth of each frame after its files."""
        assert self._flushed is not None
        self._flushed.result()
        while self._group:
            number, line = self._group.popleft()
            with self._lock:
                files = self._staged.pop(number, [])
            try:
                with self._writing():
                    for file in files:
                        file.rename()
                        self._directories.add(file.path.parent)
                    self._truth.append(self._lines, number, line)
            except BaseException:
                for file in files:
                    file.discard()
                raise
            yield number
        self._flushed = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                deque(self.drain(), maxlen=0)
            else:
                with suppress(Exception):  # report the first error
                    deque(self.drain(), maxlen=0)
        finally:
            self._flusher.shutdown()
            self._helpers.shutdown()
            for files in self._staged.values():
                for file in files:
                    file.discard()


@dataclass(frozen=True, slots=True)
class Finding:
    """A difference between a directory and what its export would write."""

    file: str  # Path of the file, relative to the directory of the export
    problem: str  # A message that continues "FILE: "
    frame: int | None = None  # The frame of the file, if it belongs to one


@dataclass(frozen=True, slots=True)
class CheckedFrame:
    """A frame whose image files have been compared with what is drawn."""

    number: int
    findings: tuple[Finding, ...]  # Differences of its files
    truth: bytes  # The line of truth as it is drawn, which has not been compared yet


def check_files(task: FrameTask, frame: EncodedFrame) -> CheckedFrame:
    """Compare the image files of a frame with the frame as it is drawn."""
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
    """Return the size and type of an image for messages, such as "160 x 120 px of uint8"."""
    return f"{pixels.shape[1]} x {pixels.shape[0]} px of {pixels.dtype}"
