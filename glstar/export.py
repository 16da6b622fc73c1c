"""Frames of a flight written to disk, with the truth beside them.

A directory of an export holds ``frame_000000.png`` and so on, ``truth.jsonl`` (one line a frame) and
``manifest.json`` (what made them).  Files appear whole: each is written under another name and renamed.  While an
export runs its truth grows in ``truth.jsonl.partial``; an export that was killed goes on where it stopped, and the
directory is then byte for byte what one run would have left.
"""

import errno
import hashlib
import json
import os
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from io import BytesIO
from itertools import chain, islice
from math import floor, isnan
from pathlib import Path
from typing import IO, Any, Final, Literal

import cv2
import numpy as np
import tifffile

from glstar import __version__
from glstar.catalogue import StarCatalogue
from glstar.config import Config, ExposureSection
from glstar.errors import ConfigError, ExportError
from glstar.exposure import Exposure
from glstar.scene import Renderer
from glstar.simulator import Simulator
from glstar.timescale import format_utc
from glstar.track import Flight
from glstar.truth import frame_truth

__all__ = [
    "DrawnFrame",
    "Export",
    "ExportReport",
    "ImageFormat",
    "Plan",
    "PlannedFrame",
    "SkippedFrame",
    "encode",
    "prepare",
    "write_video",
    "write_whole",
]

ImageFormat = Literal["png", "png16", "tiff"]

_SUFFIX: Final[dict[ImageFormat, str]] = {"png": ".png", "png16": ".png", "tiff": ".tiff"}
MANIFEST_SCHEMA: Final = "glstar-manifest-1"
_MANIFEST = "manifest.json"
# What of a manifest may grow from one run to the next.
_EXTENT: Final = {"frames", "skipped", "command"}
_ELSEWHERE: Final = "choose another directory, or start over with --force"
_TRUTH = "truth.jsonl"
_TRUTH_PARTIAL = "truth.jsonl.partial"
_TEMPORARY = ".glstar-writing-"
_OURS = re.compile(r"frame_\d{6,}(\.light)?\.(png|tiff)|manifest\.json|truth\.jsonl(\.partial)?")

# A million exposures of a day's flight; more is a slip of the finger in --every.
_MOST_FRAMES = 10_000_000


@dataclass(frozen=True, slots=True)
class PlannedFrame:
    """A frame to be drawn.

    Attributes
    ----------
    number : int
        Its place in the sequence, which names its file.
    exposure : Exposure
    """

    number: int
    exposure: Exposure


@dataclass(frozen=True, slots=True)
class SkippedFrame:
    """A frame that cannot be drawn truly.

    Attributes
    ----------
    number : int
        Its place in the sequence.
    start_s : float
        When its exposure begins, s from the flight's first attitude.
    reason : str
        Why it is left out, in words.
    """

    number: int
    start_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class Plan:
    """Which frames an export makes.

    Attributes
    ----------
    frames : tuple of PlannedFrame
    skipped : tuple of SkippedFrame
    """

    frames: tuple[PlannedFrame, ...]
    skipped: tuple[SkippedFrame, ...]


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
    _truth_lines: dict[int, tuple[int, int]] = field(default_factory=dict, init=False)

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
        of = len(self.plan.frames)
        with _words_for_the_disk(self.directory):
            missing = list(self.plan.frames) if force else self._missing(manifest)
            frames = (self.draw(renderer, planned) for planned in missing)
            # What cannot be drawn must leave no directory behind, nor clear one.
            first = list(islice(frames, 1))
            self.directory.mkdir(parents=True, exist_ok=True)
            self._clear(everything=force)
            self._claim(manifest)
            done = there_already = of - len(missing)
            tell(done, of)
            if missing:
                with self._growing_truth() as truth:
                    for frame in chain(first, frames):
                        self._write_frame(frame, truth)
                        done += 1
                        tell(done, of)
            self._finish_truth()
        return ExportReport(self.directory, len(missing), there_already, self.plan.skipped)

    def draw(self, renderer: Renderer, planned: PlannedFrame) -> "DrawnFrame":
        """Return a frame with its files' contents, without writing anything.

        Parameters
        ----------
        renderer : Renderer
        planned : PlannedFrame

        Returns
        -------
        DrawnFrame
        """
        scene = self.simulator.scene(planned.exposure)
        seed = int(np.random.SeedSequence([self.seed, planned.number]).generate_state(1)[0])
        frame = renderer.render(scene, seed=seed, light=self.light)
        truth = frame_truth(scene, frame, number=planned.number, file=self.image_path(planned.number).name)
        return DrawnFrame(
            number=planned.number,
            image=encode(frame.pixels, self.image_format),
            light=None if frame.light_dn is None else _tiff(frame.light_dn),
            truth=json.dumps(truth, separators=(",", ":"), allow_nan=False).encode() + b"\n",
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
        return self.directory / f"frame_{number:06d}{_SUFFIX[self.image_format]}"

    def _light_path(self, number: int) -> Path:
        return self.directory / f"frame_{number:06d}.light.tiff"

    def _write_frame(self, frame: "DrawnFrame", truth: IO[bytes]) -> None:
        write_whole(self.image_path(frame.number), frame.image)
        if frame.light is not None:
            write_whole(self._light_path(frame.number), frame.light)
        # Last, so that a line of truth says: all of this frame is there.
        self._truth_lines[frame.number] = truth.tell(), len(frame.truth)
        truth.write(frame.truth)
        truth.flush()

    def _clear(self, *, everything: bool) -> None:
        """Remove what a killed run was writing, and with `everything` all that an export writes."""
        for path in self.directory.iterdir():
            if path.name.startswith(_TEMPORARY) or (everything and _OURS.fullmatch(path.name)):
                path.unlink()

    def _claim(self, manifest: dict[str, Any]) -> None:
        """Write the manifest, unless it is there."""
        path = self.directory / _MANIFEST
        if not path.exists() or _manifest_of(path) != manifest:
            write_whole(path, json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False).encode() + b"\n")

    def _refuse_others(self, manifest: dict[str, Any]) -> None:
        """Refuse a directory that holds frames made otherwise."""
        path = self.directory / _MANIFEST
        if not path.exists():
            if any(_OURS.fullmatch(entry.name) for entry in self.directory.iterdir()):
                raise ExportError(self.directory, f"holds frames but no manifest; {_ELSEWHERE}")
            return
        there = _manifest_of(path)
        differing = _differences(there, manifest, ignore=_EXTENT)
        if differing:
            raise ExportError(self.directory, f"holds frames made otherwise ({'; '.join(differing)}); {_ELSEWHERE}")
        if there["frames"] > manifest["frames"]:
            raise ExportError(
                self.directory,
                f"holds {there['frames']} frames of this export and {manifest['frames']} were asked for; {_ELSEWHERE}",
            )

    def _missing(self, manifest: dict[str, Any]) -> list[PlannedFrame]:
        """Return the frames that are not there with image, light and truth."""
        if not self.directory.exists():
            return list(self.plan.frames)
        self._refuse_others(manifest)
        final, partial = self.directory / _TRUTH, self.directory / _TRUTH_PARTIAL
        self._truth_lines.clear()
        self._truth_lines.update(_index_of_truth(final if final.exists() else partial))
        present = {entry.name for entry in self.directory.iterdir()}
        return [
            planned
            for planned in self.plan.frames
            if planned.number not in self._truth_lines
            or self.image_path(planned.number).name not in present
            or (self.light and self._light_path(planned.number).name not in present)
        ]

    @contextmanager
    def _growing_truth(self) -> Iterator[IO[bytes]]:
        """Open the truth at the end of its last whole line; it loses its final name until all frames are there."""
        final, partial = self.directory / _TRUTH, self.directory / _TRUTH_PARTIAL
        if final.exists():
            final.replace(partial)
        with partial.open("ab") as truth:
            truth.truncate(max((offset + length for offset, length in self._truth_lines.values()), default=0))
            truth.seek(0, os.SEEK_END)
            yield truth

    def _finish_truth(self) -> None:
        """Give the truth its final name, its lines in the order of the frames."""
        final, partial = self.directory / _TRUTH, self.directory / _TRUTH_PARTIAL
        if not partial.exists():
            if not final.exists():
                write_whole(final, b"")
            return
        if final.exists():
            partial.unlink()
            return
        spans = [self._truth_lines[planned.number] for planned in self.plan.frames]
        in_order = sum(length for _, length in spans) == partial.stat().st_size and spans == sorted(spans)
        if not in_order:
            temporary = self.directory / f"{_TEMPORARY}{_TRUTH}"
            with partial.open("rb") as lines, temporary.open("wb") as sorted_lines:
                for offset, length in spans:
                    lines.seek(offset)
                    sorted_lines.write(lines.read(length))
            temporary.replace(partial)
        partial.replace(final)


def prepare(
    config: Config,
    flight_path: Path,
    directory: Path,
    *,
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
    flight = config.open_flight(flight_path)
    plan = _plan(flight, config.exposure, start_s=start_s, stop_s=stop_s, frames=frames)
    sensor = config.sensor()
    if image_format is None:
        image_format = "png" if sensor.bit_depth <= 8 else "png16"
    elif image_format == "png" and sensor.bit_depth > 8:
        raise ConfigError(
            f"a sensor of {sensor.bit_depth} bits does not fit into 8-bit PNG; use --format png16 or tiff",
            key="sensor.bit_depth",
        )
    elif image_format != "png" and sensor.bit_depth <= 8:
        sensor = sensor.with_bit_depth(16)
    stars = StarCatalogue.open(config.sky.catalogue)
    manifest = {
        "schema": MANIFEST_SCHEMA,
        "glstar": __version__,
        "command": _command(config, flight_path, start_s, stop_s, frames, image_format, light, seed),
        "flight": {
            "name": flight.name,
            "sha256": _sha256(flight_path),
            "first_utc": format_utc(flight.attitude.first_s),
            "last_utc": format_utc(flight.attitude.last_s),
            "attitude": flight.attitude_source,
            "position": flight.position_source,
            "utc": flight.utc_source,
        },
        "config": config.resolved(),
        "sensor": asdict(sensor),
        "catalogue": {"name": config.sky.catalogue, "sha256": stars.sha256},
        "start_s": start_s,
        "format": image_format,
        "light": light,
        "seed": seed,
        "frames": len(plan.frames),
        "skipped": [asdict(frame) for frame in plan.skipped],
    }
    return Export(
        simulator=config.simulator(flight, sensor=sensor),
        plan=plan,
        directory=directory,
        manifest=manifest,
        image_format=image_format,
        light=light,
        seed=seed,
    )


def _plan(
    flight: Flight, exposure: ExposureSection, *, start_s: float, stop_s: float | None, frames: int | None
) -> Plan:
    """Return the frames of a flight: an exposure every interval, as long as the flight lasts."""
    for flag, value in (("--start", start_s), ("--stop", stop_s)):
        if value is not None and isnan(value):
            raise ConfigError(f"{flag} {value} is no time; give seconds from the flight's first attitude")
    attitude = flight.attitude
    length_s = attitude.last_s - attitude.first_s
    if start_s < 0:
        raise ConfigError(f"--start {start_s:g} s lies before the flight, whose seconds count from its first attitude")
    if frames is not None and frames < 1:
        raise ConfigError(f"--frames {frames} asks for nothing; it must be 1 or more")
    stop_s = length_s if stop_s is None else min(stop_s, length_s)
    # A nanosecond of grace: times of 1.7e9 s are exact to a quarter of a microsecond.
    room_s = stop_s - start_s - exposure.duration_s + 1e-6
    if room_s < 0:
        raise ConfigError(
            f"no exposure of {exposure.duration_s:g} s fits between {start_s:g} s and {stop_s:.3f} s of {flight.name},"
            f" whose attitude lasts {length_s:.3f} s; take a shorter exposure or another part of the flight"
        )
    if room_s / exposure.interval_s >= _MOST_FRAMES:
        raise ConfigError(
            f"--every {exposure.interval_s:g} s asks for {room_s / exposure.interval_s:.3g} frames;"
            " take a longer interval"
        )
    count = floor(room_s / exposure.interval_s) + 1
    chosen: list[PlannedFrame] = []
    skipped: list[SkippedFrame] = []
    for number in range(count if frames is None else min(count, frames)):
        begin_s = start_s + number * exposure.interval_s
        first_utc_s = attitude.first_s + begin_s
        # The last exposure may end on the last sample, and must not be rounded past it.
        shutter = Exposure(
            min(first_utc_s, attitude.last_s - exposure.duration_s), exposure.duration_s, exposure.rate_hz
        )
        gap_s = attitude.gap_within(shutter.start_utc_s, shutter.stop_utc_s)
        if gap_s > 0:
            skipped.append(SkippedFrame(number, begin_s, f"the log is silent for {gap_s:.3f} s during the exposure"))
        else:
            chosen.append(PlannedFrame(number, shutter))
    return Plan(tuple(chosen), tuple(skipped))


def _command(
    config: Config,
    flight_path: Path,
    start_s: float,
    stop_s: float | None,
    frames: int | None,
    image_format: ImageFormat,
    light: bool,
    seed: int,
) -> str:
    """Return the command that draws these frames; without the directory, so that equal frames have equal manifests."""
    words: list[object] = ["glstar", "export", flight_path.name]
    if config.file is not None:
        words += ["--config", config.file.name]
    words += ["--exposure", config.exposure.duration_s, "--every", config.exposure.interval_s, "--start", start_s]
    for flag, value in (("--stop", stop_s), ("--frames", frames)):
        words += [] if value is None else [flag, value]
    words += ["--format", image_format, "--seed", seed]
    words += ["--light"] if light else []
    return shlex.join(str(word) for word in words)


def encode(pixels: np.ndarray[Any, Any], image_format: ImageFormat) -> bytes:
    """Return an image as the bytes of its file.

    Parameters
    ----------
    pixels : (height, width) uint8 or uint16
        Digital numbers.
    image_format : {"png", "png16", "tiff"}
        8-bit PNG, 16-bit PNG, or TIFF of 16 bits; always without loss.

    Returns
    -------
    bytes
    """
    if image_format == "tiff":
        return _tiff(pixels.astype(np.uint16, copy=False))
    wanted = np.uint16 if image_format == "png16" else np.uint8
    _, encoded = cv2.imencode(".png", pixels.astype(wanted, copy=False))
    return encoded.tobytes()


def write_video(images: list[Path], path: Path, *, frames_per_s: float, saturation_dn: int) -> None:
    """Write images as an MPEG-4 video, whole or not at all.

    Parameters
    ----------
    images : list of Path
        Image files of one size, in order.
    path : Path
        Where to; its name must end with .mp4.
    frames_per_s : float
        Frames a second.
    saturation_dn : int
        The value shown as white.

    Raises
    ------
    ExportError
        If the video cannot be written.
    """
    if not images:
        raise ExportError(path, "no frame was drawn, and a video needs one")
    temporary = path.with_name(f"{_TEMPORARY}{path.name}")
    with _words_for_the_disk(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(b"")  # a directory that cannot be written has no words of the codec's
            _encode_video(images, temporary, frames_per_s, saturation_dn)
            if _count_frames(temporary) != len(images):
                raise ExportError(path, "could not be written whole; is the disk full?")
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def _encode_video(images: list[Path], path: Path, frames_per_s: float, saturation_dn: int) -> None:
    # The codec wants even sides: an odd one loses its last row or column, in the video only.
    height_px, width_px = (side - side % 2 for side in _eight_bits(images[0], saturation_dn).shape)
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, frames_per_s, (width_px, height_px), isColor=True)
    try:
        for image in images:
            grey = _eight_bits(image, saturation_dn)[:height_px, :width_px]
            writer.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    finally:
        writer.release()


def _count_frames(path: Path) -> int:
    """Return how many frames of a video can be read back; the codec reports no error of its own."""
    reader = cv2.VideoCapture(str(path))
    try:
        count = 0
        while reader.grab():
            count += 1
        return count
    finally:
        reader.release()


def _eight_bits(path: Path, saturation_dn: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ExportError(path, "is no image that can be read back for the video")
    return np.asarray(np.minimum(pixels * (255.0 / saturation_dn) + 0.5, 255), dtype=np.uint8)


def _tiff(pixels: np.ndarray[Any, Any]) -> bytes:
    """Return an array as a plain TIFF; without a date, so that the same pixels are the same bytes."""
    target = BytesIO()
    tifffile.imwrite(target, pixels, photometric="minisblack", metadata=None, software="glstar")
    return target.getvalue()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all.

    Parameters
    ----------
    path : Path
    content : bytes

    Raises
    ------
    OSError
        If it cannot be written; what was there before is there still.
    """
    temporary = path.with_name(f"{_TEMPORARY}{path.name}")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


@contextmanager
def _words_for_the_disk(path: Path) -> Iterator[None]:
    """Turn what the operating system says of a file into what the user can do."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        blamed = Path(os.fsdecode(error.filename)) if error.filename is not None else path
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            advice = "the disk is full; make room and run the same command again, it goes on where it stopped"
        elif error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
            advice = f"cannot be written ({reason}); choose another directory"
        elif error.errno in {errno.EEXIST, errno.ENOTDIR}:
            advice = f"is no directory ({reason}); choose another"
        else:
            advice = f"cannot be written ({reason}); once it can, the same command goes on where it stopped"
        blamed = path if blamed.name.startswith(_TEMPORARY) else blamed
        raise ExportError(blamed, advice) from error


def _manifest_of(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_bytes())
    except ValueError:
        manifest = None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("frames"), int):
        raise ExportError(path, "is no manifest of glstar; " + _ELSEWHERE)
    return manifest


def _differences(there: Any, wanted: Any, ignore: set[str], at: str = "") -> list[str]:
    """Return where two manifests differ, in words, the first few."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        found: list[str] = []
        for key in sorted((there.keys() | wanted.keys()) - ignore):
            dotted = f"{at}.{key}" if at else key
            found += _differences(there.get(key), wanted.get(key), set(), dotted)
        return [*found[:3], "..."] if len(found) > 4 else found
    return [] if there == wanted else [f"{at} was {there}, is {wanted}"]


def _index_of_truth(path: Path) -> dict[int, tuple[int, int]]:
    """Return where each frame's line stands, (offset, length), up to the last whole one."""
    lines: dict[int, tuple[int, int]] = {}
    with suppress(FileNotFoundError), path.open("rb") as truth:
        offset = 0
        for line in truth:
            number = _frame_number(line)
            if number is None:
                break
            lines[number] = offset, len(line)
            offset += len(line)
    return lines


def _frame_number(line: bytes) -> int | None:
    """Return the frame that a line of truth is about, or None for a line that was cut off."""
    if not line.endswith(b"}\n"):
        return None
    found = re.match(rb'\{"schema":"[^"]*","frame":(\d+),', line)
    return None if found is None else int(found.group(1))


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
