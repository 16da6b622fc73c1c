"""An export: what is missing of a flight's frames is drawn and written."""

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.files import TEMPORARY, alone_in, words_for_the_disk, write_whole
from glstar.export.images import SUFFIX, ImageFormat, encode, tiff
from glstar.export.manifest import OURS, Request, claim, describe, refuse_others
from glstar.export.plan import Plan, PlannedFrame, SkippedFrame, plan_frames
from glstar.export.truthfile import TruthFile
from glstar.scene import Renderer
from glstar.sensor import Sensor
from glstar.simulator import Simulator
from glstar.track import Flight
from glstar.truth import frame_truth

__all__ = ["DrawnFrame", "Export", "ExportReport", "frame_seed", "prepare"]


@dataclass(frozen=True, slots=True)
class DrawnFrame:
    """A frame as its files' contents.

    Attributes
    ----------
    number : int
        Its place in the sequence.
    image : bytes
        The image file.
    light : bytes or None
        The float32 TIFF of the light before noise, if it was asked for.
    truth : bytes
        The line of ``truth.jsonl``.
    """

    number: int
    image: bytes
    light: bytes | None
    truth: bytes


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What an export did.

    Attributes
    ----------
    directory : Path
    drawn, there_already : int
        Frames made now, and frames that an earlier run had made.
    skipped : tuple of SkippedFrame
    """

    directory: Path
    drawn: int
    there_already: int
    skipped: tuple[SkippedFrame, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Export:
    """Frames of one flight, on their way to one directory; `prepare` makes it.

    Attributes
    ----------
    simulator : Simulator
    plan : Plan
    directory : Path
    manifest : dict
        What makes the frames, but for the renderer, ready to be written as JSON; an unfinished export goes on only
        if nothing in it differs.
    image_format : {"png", "png16", "tiff"}
    light : bool
        Whether to write the light before noise beside each frame.
    seed : int
        The seed from which every frame's own is derived.
    """

    simulator: Simulator
    plan: Plan
    directory: Path
    manifest: dict[str, Any]
    image_format: ImageFormat
    light: bool
    seed: int

    def run(
        self, renderer: Renderer, *, force: bool = False, on_frame: Callable[[int, int], None] | None = None
    ) -> ExportReport:
        """Draw and write what is missing.

        Parameters
        ----------
        renderer : Renderer
        force : bool
            Start over: remove what an earlier export left in the directory.
        on_frame : callable
            Called with the number of frames done and of all, after each.

        Returns
        -------
        ExportReport

        Raises
        ------
        ExportError
            If the directory cannot be written, the disk is full, or it holds frames made otherwise.
        """
        tell = on_frame or (lambda *_: None)
        manifest = self.manifest | {"renderer": renderer.driver}
        truth = TruthFile(self.directory)
        of = len(self.plan.frames)
        with words_for_the_disk(self.directory), ExitStack() as held:
            new = not self.directory.exists()
            if not new:
                held.enter_context(alone_in(self.directory))
            missing = list(self.plan.frames) if new or force else self._missing(manifest, truth)
            frames = (self.draw(renderer, planned) for planned in missing)
            # What cannot be drawn must leave no directory behind, nor clear one.
            first = list(islice(frames, 1))
            if new:
                self.directory.mkdir(parents=True, exist_ok=True)
                held.enter_context(alone_in(self.directory))
            self._clear(everything=force)
            claim(self.directory, manifest)
            done = there_already = of - len(missing)
            tell(done, of)
            if missing:
                with truth.growing() as lines:
                    for frame in chain(first, frames):
                        self._write_files(frame)
                        # Last, so that a line of truth says: all of this frame is there.
                        truth.append(lines, frame.number, frame.truth)
                        done += 1
                        tell(done, of)
            truth.finish([planned.number for planned in self.plan.frames])
        return ExportReport(self.directory, len(missing), there_already, self.plan.skipped)

    def draw(
        self,
        renderer: Renderer,
        planned: PlannedFrame,
        *,
        on_pixels: Callable[[np.ndarray[Any, Any], bytes], None] | None = None,
    ) -> DrawnFrame:
        """Return a frame with its files' contents, without writing anything.

        Parameters
        ----------
        renderer : Renderer
        planned : PlannedFrame
        on_pixels : callable
            Called with the pixels and the line of truth before the image becomes a file's content, for who is in haste.

        Returns
        -------
        DrawnFrame
        """
        scene = self.simulator.scene(planned.exposure)
        frame = renderer.render(scene, seed=frame_seed(self.seed, planned.number), light=self.light)
        truth = frame_truth(scene, frame, number=planned.number, file=self.image_path(planned.number).name)
        line = json.dumps(truth, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        if on_pixels is not None:
            on_pixels(frame.pixels, line)
        return DrawnFrame(
            number=planned.number,
            image=encode(frame.pixels, self.image_format),
            light=None if frame.light_dn is None else tiff(frame.light_dn),
            truth=line,
        )

    def image_path(self, number: int) -> Path:
        """Return where a frame's image lies.

        Parameters
        ----------
        number : int

        Returns
        -------
        Path
        """
        return self.directory / f"frame_{number:06d}{SUFFIX[self.image_format]}"

    def _light_path(self, number: int) -> Path:
        return self.directory / f"frame_{number:06d}.light.tiff"

    def _write_files(self, frame: DrawnFrame) -> None:
        write_whole(self.image_path(frame.number), frame.image)
        if frame.light is not None:
            write_whole(self._light_path(frame.number), frame.light)

    def _clear(self, *, everything: bool) -> None:
        """Remove what a killed run was writing, and with `everything` all that an export writes."""
        for path in self.directory.iterdir():
            if path.name.startswith(TEMPORARY) or (everything and OURS.fullmatch(path.name)):
                path.unlink()

    def _missing(self, manifest: dict[str, Any], truth: TruthFile) -> list[PlannedFrame]:
        """Return the frames that are not there with image, light and truth."""
        refuse_others(self.directory, manifest)
        truth.read()
        present = {entry.name for entry in self.directory.iterdir()}
        return [
            planned
            for planned in self.plan.frames
            if planned.number not in truth
            or self.image_path(planned.number).name not in present
            or (self.light and self._light_path(planned.number).name not in present)
        ]


def prepare(
    config: Config,
    flight_path: Path,
    directory: Path,
    *,
    flight: Flight | None = None,
    start_s: float = 0.0,
    stop_s: float | None = None,
    frames: int | None = None,
    image_format: ImageFormat | None = None,
    light: bool = False,
    seed: int = 0,
) -> Export:
    """Read a flight and plan its frames; nothing is drawn or written yet.

    Parameters
    ----------
    config : Config
    flight_path : Path
        The flight's log.
    directory : Path
        Where the frames shall lie.
    flight : Flight, optional
        What the log holds, where it has been read already.
    start_s, stop_s : float
        The part of the flight, s from its first attitude; all of it unless said otherwise.
    frames : int, optional
        No more than so many.
    image_format : {"png", "png16", "tiff"}, optional
        8-bit PNG unless the sensor has more bits.  A sensor of 8 bits in a file of 16 gets a converter of 16 bits:
        full scale stays full scale, and all DN of the truth follow.
    light : bool
        Write the light before noise beside each frame.
    seed : int
        The seed of all noise.

    Returns
    -------
    Export
        Exposures that span a gap of the log are not drawn but counted, in its plan.

    Raises
    ------
    ConfigError
        If no exposure fits into the flight, or the sensor's bits into the format.
    LogFormatError
        If the log cannot be replayed.
    CatalogueError
        If there is no such star catalogue.
    """
    flight = config.open_flight(flight_path) if flight is None else flight
    plan = plan_frames(flight, config.exposure, start_s=start_s, stop_s=stop_s, frames=frames)
    image_format, sensor = fitting(image_format, config.sensor())
    request = Request(start_s, stop_s, frames, image_format, light, seed)
    return Export(
        simulator=config.simulator(flight, sensor=sensor),
        plan=plan,
        directory=directory,
        manifest=describe(config, flight_path, flight, sensor, request, plan),
        image_format=image_format,
        light=light,
        seed=seed,
    )


def frame_seed(seed: int, number: int) -> int:
    """Return the seed of a frame's noise.

    Parameters
    ----------
    seed : int
        The export's.
    number : int
        The frame's place in the sequence.

    Returns
    -------
    int
        0 to 2**32 - 1.
    """
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def fitting(image_format: ImageFormat | None, sensor: Sensor) -> tuple[ImageFormat, Sensor]:
    """Return a format that holds the sensor's bits, and a sensor whose bits fill the format."""
    if image_format is None:
        return ("png" if sensor.bit_depth <= 8 else "png16"), sensor
    if image_format == "png" and sensor.bit_depth > 8:
        raise ConfigError(
            f"a sensor of {sensor.bit_depth} bits does not fit into 8-bit PNG; use --format png16 or tiff",
            key="sensor.bit_depth",
        )
    if image_format != "png" and sensor.bit_depth <= 8:
        return image_format, sensor.with_bit_depth(16)
    return image_format, sensor
