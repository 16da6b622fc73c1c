"""What every process needs to draw and write the frames of an export: a description that can be pickled."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import orjson

from glstar.export.exif import with_exif
from glstar.export.fitsfile import encode_fits
from glstar.export.frames import ComposedFrame, Frames
from glstar.export.images import SUFFIX, ImageFormat, encode, tiff
from glstar.export.layout import NOISELESS_SUFFIX, frame_folder
from glstar.export.lease import Lease
from glstar.export.links import make_folder
from glstar.export.masks import MASK_SUFFIXES, MaskKind, encoded_masks
from glstar.export.processing import CameraProcessing, process
from glstar.render.scene import Frame, Renderer, Scene
from glstar.render.truth import frame_truth
from glstar.system.durable import write_atomically

__all__ = ["EncodedFrame", "FrameTask", "frame_seed"]


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """A frame as the content of its files.

    Attributes
    ----------
    number : int
        Frame number.
    image : bytes
        The image file.
    noiseless : bytes or None
        The float32 TIFF of the signal before noise; None unless the task asks for it.
    truth : bytes
        The line of ``truth.jsonl``, with its newline.
    masks : mapping of str to bytes
        Its masks by kind.
    """

    number: int
    image: bytes
    noiseless: bytes | None
    truth: bytes
    masks: Mapping[MaskKind, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class FrameTask:
    """How to draw the frames of an export and where to write them.

    It holds no open file and no OpenGL object, so it can be pickled: another process draws the same bytes from it.

    Attributes
    ----------
    frames : Frames
    directory : Path
    image_format : {"png", "png16", "tiff", "fits", "jpeg"}
    noiseless : bool
        Whether to write the signal before noise beside each frame.
    seed : int
        The seed from which the noise seed of every frame is derived.
    lease : Lease or None
        The write permission of the run that distributes the task to other processes; None within one process.
    masks : tuple of {"trails", "saturated", "cloud", "flare", "ground"}
        The masks to write beside each frame.
    exif : bool
        Whether images have EXIF.
    """

    frames: Frames
    directory: Path
    image_format: ImageFormat
    noiseless: bool
    seed: int
    lease: Lease | None = None
    masks: tuple[MaskKind, ...] = ()
    exif: bool = False

    def begin(self, renderer: Renderer, composed: ComposedFrame) -> None:
        """Begin to draw a composed frame with its own noise; `Renderer.end_read` returns it.

        Parameters
        ----------
        renderer : Renderer
        composed : ComposedFrame
        """
        renderer.begin(composed.scene, seed=frame_seed(self.seed, composed.number), light=self.noiseless)

    def encode(
        self,
        composed: ComposedFrame,
        frame: Frame,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> EncodedFrame:
        """Return the content of a frame's files.

        Parameters
        ----------
        composed : ComposedFrame
        frame : Frame
            Drawn from ``composed.scene``.
        on_pixels : callable, optional
            Called with the pixels and the line of truth before the image is encoded, for a consumer that needs them
            with low latency.

        Returns
        -------
        EncodedFrame
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
        """Draw one frame and return the content of its files; nothing is written.

        Parameters
        ----------
        renderer : Renderer
        number : int
        on_pixels : callable, optional
            As for `encode`.

        Returns
        -------
        EncodedFrame
        """
        composed = self.frames.compose(number)
        self.begin(renderer, composed)
        return self.encode(composed, renderer.end_read(), on_pixels=on_pixels)

    def write(self, frame: EncodedFrame, write: Callable[[Path, bytes], None] = write_atomically) -> None:
        """Write the files of a frame, without its line of truth.

        Parameters
        ----------
        frame : EncodedFrame
        write : callable
            Called with the path and the content of each file.  The default writes the file atomically.

        Raises
        ------
        OSError
            If a file cannot be written.
        ExportError
            If another run has taken over the directory, or a link has the name of a folder.
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

        Returns
        -------
        context manager
            Entering it raises ExportError if another run has taken over the directory.
        """
        return nullcontext() if self.lease is None else self.lease.writing()

    def absolute(self) -> Self:
        """Return the task with absolute paths, for processes with another working directory.

        Returns
        -------
        FrameTask
        """
        return replace(self, directory=self.directory.absolute())

    def image_path(self, number: int) -> Path:
        """Return the path of a frame's image.

        Parameters
        ----------
        number : int

        Returns
        -------
        Path
            In the directory itself for the first 10,000 frames, then in folders of 1000: file managers are slow with a
            million files in one folder.
        """
        return self.directory / frame_folder(number) / f"frame_{number:06d}{SUFFIX[self.image_format]}"

    def noiseless_path(self, number: int) -> Path:
        """Return the path of the signal before noise of a frame.

        Parameters
        ----------
        number : int

        Returns
        -------
        Path
        """
        return self.directory / frame_folder(number) / f"frame_{number:06d}{NOISELESS_SUFFIX}"

    def mask_path(self, kind: MaskKind, number: int) -> Path:
        """Return the path of a mask of a frame.

        Parameters
        ----------
        kind : {"trails", "saturated", "cloud", "flare", "ground"}
        number : int

        Returns
        -------
        Path
        """
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


def frame_seed(seed: int, number: int) -> int:
    """Return the noise seed of a frame.

    Parameters
    ----------
    seed : int
        The seed of the export.
    number : int
        Frame number.

    Returns
    -------
    int
        0 to 2**32 - 1.
    """
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
