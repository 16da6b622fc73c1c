"""Export of frames from a live MAVLink link, as attitudes arrive."""

import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from math import ceil, floor, inf
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from glstar import __version__
from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.directory import (
    directory_lock,
    explain_disk_errors,
    image_path,
    refuse_links,
    remove_own_files,
)
from glstar.export.frame import EncodedFrame, FrameWriter
from glstar.export.imagefiles.formats import ImageFormat, find_damage
from glstar.export.liveframes import CONTEXT_S, LiveFrames
from glstar.export.navigator import LiveNavigator, finish_nav
from glstar.export.plan.frames import SkippedFrame
from glstar.export.plan.manifest import NAME, SCHEMA, described_brightness, holds_frames, read_manifest, write_manifest
from glstar.export.publish.outputs import FrameOutput
from glstar.export.run.export import remove_leftovers
from glstar.export.truth.lines import TruthFile, is_unfinished, parse_frame
from glstar.link import CapturedImage, LatestAttitude, Link
from glstar.link.camera import Capture
from glstar.render.scene.scene import Renderer
from glstar.render.simulator import Simulator
from glstar.render.truth.conditions import conditions_report
from glstar.rotation import matrix_from_quaternion, quaternion_from_matrix
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.timescale import described_earth_orientation, format_utc
from glstar.system.files import make_directory
from glstar.system.process import defer_interrupts

# Interval at which events of the link are reported while no exposure is due, s.
_POLL_INTERVAL_S = 0.1
# Time for site, UTC and attitude to arrive before missing ones are reported, s.
_REPORT_DELAY_S = 3.0
# Interval at which commands are looked for, s, and the longest time that the attitudes of an exposure may be late, s.
_COMMAND_POLL_S = 0.005
_LATE_ATTITUDE_S = 5.0
# Interval at which exposures that were left out are reported, s.
_LATE_REPORT_S = 10.0
# If the clock is set back by more than this, the sequence of exposures restarts at the current time, s.
_CLOCK_RESET_S = 1.0


@dataclass(frozen=True, slots=True)
class LiveReport:
    """The result of a live export."""

    directory: Path | None
    drawn: int  # Number of frames
    skipped: tuple[SkippedFrame, ...]  # Exposures that span a gap
    # For each frame, the time from the arrival of its latest attitude to its pixels and truth being ready, s.
    latency_s: tuple[float, ...] = field(repr=False)
    late: int = 0  # Exposures by the vehicle's clock that were left out, because frames were drawn too slowly

    def latency_quantile_s(self, fraction: float) -> float | None:
        """Return the latency that a fraction of the frames does not exceed, s; None without frames."""
        return float(np.quantile(self.latency_s, fraction)) if self.latency_s else None


class LiveExport:
    """Draws exposures that end at the latest attitude of a link, one per interval, or those that are commanded.

    `link`: an open link; the caller closes it; if it has a camera, exposures begin as commanded; if its sky is a
    simulator's truth, ``nav.jsonl`` has what the autopilot estimates; `directory`: the output directory; nothing is
    written if None; `output`: receives each frame; `preview`: between commanded pictures, receives a frame every
    interval, which is not written; the caller closes both; `image_format` {"png", "png16", "tiff",
    "fits", "jpeg"}, optional: none for 8-bit PNG, or 16-bit PNG if the sensor has more than 8 bits; `seed`: the seed
    from which the noise seed of every frame is derived; `command`: the command line, for the manifest.
    """

    def __init__(
        self,
        config: Config,
        link: Link,
        *,
        directory: Path | None = None,
        output: FrameOutput | None = None,
        preview: FrameOutput | None = None,
        image_format: ImageFormat | None = None,
        seed: int = 0,
        command: str = "glstar live",
    ) -> None:
        self._link = link
        self._directory = directory
        self._preview = preview
        self._command = command
        self._writes_nav = directory is not None and link.truth == "sim_state"
        self._frames = LiveFrames(
            config, link, directory=directory, output=output, image_format=image_format, seed=seed
        )
        self._stopping = Event()
        self._drawn: list[int] = []
        self._preview_due_s = -inf
        self._late = 0
        self._lacked, self._report_after_s = "", inf

    @property
    def exposures(self) -> dict[int | str, Exposure]:
        """The exposures of the latest frames, by number and by the name of the image."""
        return self._frames.exposures

    def run(
        self,
        renderer: Renderer,
        *,
        duration_s: float | None = None,
        force: bool = False,
        on_event: Callable[[str], None] | None = None,
        on_frame: Callable[[int], None] | None = None,
    ) -> LiveReport:
        """Draw for a time, s, until Ctrl-C or another signal of the end, or until `stop`.

        With `force` the files of an earlier export are removed from the directory. `on_event` is called with a message
        for each event of the link, and with the Sun, the Moon and the limiting magnitude of the first frame; `on_frame`
        with the number of frames after each frame. Raises ExportError if the directory cannot be written, or holds
        frames; ConfigError if ``[navigator]`` names a message of a log.
        """
        on_event, on_frame = on_event or (lambda _: None), on_frame or (lambda _: None)
        until_s = inf if duration_s is None else time.monotonic() + duration_s
        self._report_after_s = time.monotonic() + _REPORT_DELAY_S
        with ExitStack() as locked:
            directory = self._directory
            needs_nav = any(one is not None and one.needs_nav for one in (self._frames.output, self._preview))
            if self._writes_nav or needs_nav:
                self._frames.nav = locked.enter_context(
                    closing(LiveNavigator(self._frames.config, directory, duration_s))
                )
            truth = None
            with ExitStack() as writing:
                writer = None
                if directory is not None:
                    locked.enter_context(explain_disk_errors(directory))
                    truth = self._open(directory, locked, force=force)
                    lines = writing.enter_context(truth.open_for_append())
                    writer = writing.enter_context(FrameWriter(truth, lines, group_s=0.0))
                by_time = self._follow if self._link.clock == "arrival" else self._keep_time
                follow = by_time if self._link.camera is None else self._obey
                with suppress(KeyboardInterrupt):
                    follow(renderer, until_s, writer, on_event, on_frame)
                with defer_interrupts():
                    writing.close()
                    if directory is not None and truth is not None:
                        self._finish(directory, truth, renderer)
        return LiveReport(
            directory, len(self._drawn), tuple(self._frames.skipped), tuple(self._frames.latency_s), self._late
        )

    def _finish(self, directory: Path, truth: TruthFile, renderer: Renderer) -> None:
        """Complete the files of the directory."""
        self._drawn = truth.numbers.tolist()  # an interrupted frame may or may not have its line
        self._write_manifest(directory, renderer)
        if self._frames.nav is not None and self._writes_nav:
            self._frames.nav.finish(truth.numbers)
        truth.finish(truth.numbers)

    def stop(self) -> None:
        """End `run` after the current frame; another thread may call it."""
        self._stopping.set()

    def _turns(
        self, until_s: float, writer: FrameWriter | None, on_event: Callable[[str], None]
    ) -> Generator[float, None, None]:
        """Report events and complete files again and again; yield the time left, s, until it ends or is stopped."""
        last_event = 0
        while (left_s := until_s - time.monotonic()) > 0 and not self._stopping.is_set() and self._link.failure is None:
            for event in self._link.events(last_event):
                last_event = event.number
                on_event(event.message)
            if writer is not None:
                deque(writer.poll(), maxlen=0)
            yield left_s

    def _follow(
        self,
        renderer: Renderer,
        until_s: float,
        writer: FrameWriter | None,
        on_event: Callable[[str], None],
        on_frame: Callable[[int], None],
    ) -> None:
        every_s = self._frames.config.exposure.interval_s
        due_s, before = -inf, None
        for left_s in self._turns(until_s, writer, on_event):
            now = self._link.latest()
            if now is not None:
                # If UTC is set, the next exposure is due one interval after the previous one, not at the old UTC.
                due_s += 0.0 if before is None else now.utc_step_s(before)
                before = now
            latest = self._link.wait_for(due_s, min(_POLL_INTERVAL_S, left_s))
            if latest is None or (before is not None and abs(latest.utc_step_s(before)) > _CLOCK_RESET_S):
                if now is not None and now.utc_s < due_s - every_s - _CLOCK_RESET_S:
                    due_s = -inf
                self._report_lack(on_event)
                continue
            self._skip_missed(due_s, latest)
            frame = self._frames.draw(renderer, None, latest, {})
            if frame is None:
                due_s = latest.utc_s + _POLL_INTERVAL_S
                continue
            due_s = latest.utc_s if due_s == -inf else due_s
            # Exposures that could not be drawn in time are left out, so that a frame always shows the current sky.
            due_s += every_s * (1 + max(floor((latest.utc_s - due_s) / every_s), 0))
            if isinstance(frame, EncodedFrame):
                self._keep(frame, renderer, writer, on_event)
                on_frame(len(self._drawn))

    def _keep_time(
        self,
        renderer: Renderer,
        until_s: float,
        writer: FrameWriter | None,
        on_event: Callable[[str], None],
        on_frame: Callable[[int], None],
    ) -> None:
        """Draw exposures that end at whole multiples of the interval by the vehicle's time since boot.

        Of those that are due while another one is drawn the latest is drawn, and the others are counted.
        """
        section = self._frames.config.exposure
        boot, due, said, said_s = -1, 0, 0, time.monotonic()
        for left_s in self._turns(until_s, writer, on_event):
            now = self._link.latest()
            if now is None:
                self._report_lack(on_event)
                self._stopping.wait(min(_POLL_INTERVAL_S, left_s))
                continue
            if now.boot != boot:
                boot, due = now.boot, ceil(now.boot_s / section.interval_s)
            latest = self._link.wait_for(due * section.interval_s + now.utc_minus_boot_s, min(_POLL_INTERVAL_S, left_s))
            if latest is None or latest.boot != boot:
                continue
            newest = floor(latest.boot_s / section.interval_s)
            if newest > due:
                in_gaps = self._skip_missed(due * section.interval_s + latest.utc_minus_boot_s, latest)
                self._late += max(newest - due - in_gaps, 0)
                due = newest
            if self._late > said and time.monotonic() - said_s > _LATE_REPORT_S:
                said, said_s = self._late, time.monotonic()
                on_event(f"exposures left out: {said}; the vehicle's clock is faster than frames are drawn")
            stop_s = due * section.interval_s + latest.utc_minus_boot_s
            frame = self._frames.draw(renderer, stop_s - section.span_s, latest, {})
            due += 1
            if isinstance(frame, EncodedFrame):
                self._keep(frame, renderer, writer, on_event)
                on_frame(len(self._drawn))

    def _obey(
        self,
        renderer: Renderer,
        until_s: float,
        writer: FrameWriter | None,
        on_event: Callable[[str], None],
        on_frame: Callable[[int], None],
    ) -> None:
        """Draw the exposures that are commanded, each as soon as its attitudes have arrived."""
        camera = self._link.camera
        assert camera is not None
        for left_s in self._turns(until_s, writer, on_event):
            capture = camera.next()
            if capture is None:
                if not self._show(renderer):
                    self._stopping.wait(min(_COMMAND_POLL_S, left_s))
                continue
            self._frames.use(capture.settings)
            span_s = self._frames.config.exposure.span_s
            stop_s = capture.start_utc_s + span_s
            latest = self._link.wait_for(stop_s, min(span_s + _LATE_ATTITUDE_S, left_s))
            frame = None if latest is None else self._frames.draw(renderer, capture.start_utc_s, latest, capture.about)
            if not isinstance(frame, EncodedFrame):
                why = f"it meets {frame.reason}" if isinstance(frame, SkippedFrame) else "its attitude did not arrive"
                on_event(f"picture {capture.index} of {capture.command} was not taken: {why}")
                camera.captured(CapturedImage(capture))
                continue
            self._keep(frame, renderer, writer, on_event)
            if writer is not None:
                deque(writer.drain(), maxlen=0)  # a picture is reported once its file has its name
            assert self._frames.simulator is not None
            image = self._frames.task().image_path(frame.number)
            camera.captured(_captured_image(capture, self._frames.simulator, span_s, image))
            on_frame(len(self._drawn))

    def _show(self, renderer: Renderer) -> bool:
        """Draw what viewers see between the pictures, if it is due; return whether it was drawn."""
        latest, camera = self._link.latest(), self._link.camera
        if self._preview is None or latest is None or camera is None:
            return False
        self._frames.use(camera.settings)
        every_s = self._frames.config.exposure.interval_s
        late_s = latest.utc_s - self._preview_due_s
        if -every_s - _CLOCK_RESET_S <= late_s < 0:
            return False
        shown = self._frames.show(renderer, latest, self._preview)
        # On the grid of the intervals, unless it is late, or the clock was set back.
        on_time = shown and 0 <= late_s < every_s
        self._preview_due_s = (self._preview_due_s if on_time else latest.utc_s) + (
            every_s if shown else _POLL_INTERVAL_S
        )
        return shown

    def _keep(
        self,
        frame: EncodedFrame,
        renderer: Renderer,
        writer: FrameWriter | None,
        on_event: Callable[[str], None],
    ) -> None:
        """Write and count a frame."""
        if writer is not None and self._directory is not None:
            if not self._drawn:
                self._write_manifest(self._directory, renderer)
            self._frames.task().write(frame, partial(writer.stage, frame.number))
            deque(writer.add(frame.number, frame.truth), maxlen=0)
        if not self._drawn:
            assert self._frames.simulator is not None
            on_event(conditions_report(self._frames.simulator.scene(self._frames.latest_exposure)))
        self._drawn.append(frame.number)

    def _skip_missed(self, due_s: float, latest: LatestAttitude) -> int:
        """Count the exposures that were due in a data gap, but not those for which drawing was too slow.

        Returns their number.
        """
        section = self._frames.config.exposure
        missed = 0 if due_s == -inf else floor((latest.utc_s - due_s) / section.interval_s)
        flight = self._link.flight(latest.utc_s - due_s + section.span_s + CONTEXT_S) if missed > 0 else None
        if flight is None:
            return 0
        before = len(self._frames.skipped)
        for stop_s in due_s + section.interval_s * np.arange(missed):
            gap = flight.attitude.gap_within(stop_s - section.span_s, stop_s)
            if gap is not None:
                self._frames.skip(stop_s - section.span_s, gap)
        return len(self._frames.skipped) - before

    def _report_lack(self, on_event: Callable[[str], None]) -> None:
        """Report which data a frame lacks, once, and when it lacks none again; not while the link times out."""
        status = self._link.status()
        lacking = "; ".join(status.missing)
        if time.monotonic() > self._report_after_s and status.state == "live" and lacking != self._lacked:
            self._lacked = lacking
            on_event(lacking or "everything that a frame needs is known now")

    # --- the directory ------------------------------------------------------------------------------------------------

    def _open(self, directory: Path, locked: ExitStack, *, force: bool) -> TruthFile:
        make_directory(directory)
        locked.enter_context(directory_lock(directory))
        refuse_links(directory)
        if not force and holds_frames(directory):
            unfinished = "" if (directory / "truth.jsonl").exists() else f" (glstar export --recover {directory})"
            raise ExportError(
                directory,
                f"holds frames already{unfinished}; choose another directory for a live export, or start over with"
                " --force",
            )
        remove_own_files(directory)
        return TruthFile(directory)

    def _write_manifest(self, directory: Path, renderer: Renderer) -> None:
        """Write the manifest, with the keys of `manifest.describe`."""
        config, simulator = self._frames.config, self._frames.simulator
        flight: dict[str, Any] = {"name": self._link.endpoint.text, "vehicle": self._link.status().vehicle}
        if simulator is not None and self._frames.first_utc_s is not None:
            shown = simulator.flight
            flight |= {
                "first_utc": format_utc(self._frames.first_utc_s),
                "last_utc": format_utc(shown.attitude.last_s),
                "attitude": shown.attitude_source,
                "position": shown.position_source,
                "utc": shown.utc_source,
            }
        manifest = {
            "schema": SCHEMA,
            "glstar": __version__,
            "command": self._command,
            "flight": flight,
            "config": config.resolved(),
            "sensor": self._frames.sensor.keys,
            "catalogue": {"name": config.sky.catalogue, "sha256": StarCatalogue.open(config.sky.catalogue).sha256},
            **described_brightness(config),
            **(described_earth_orientation(self._frames.first_utc_s or 0.0) if config.sky.dut1_s is None else {}),
            "start_s": 0.0,
            "format": self._frames.format,
            "light": False,
            "seed": self._frames.seed,
            "frames": len(self._drawn),
            "skipped": [asdict(frame) for frame in self._frames.skipped],
            "renderer": renderer.driver,
        }
        write_manifest(directory, manifest)


@dataclass(frozen=True, slots=True)
class RecoveredExport:
    """What `recover` found."""

    directory: Path
    frames: int  # Frames of the completed export
    damaged: tuple[str, ...]  # Images with a line of truth that are missing or damaged, and are left out


def recover(directory: Path) -> RecoveredExport:
    """Complete an export that was not finished, live or of a log, with the frames that it has.

    Frames without an intact image are left out of the truth; an export that was finished stays as it is.  Raises
    ExportError if it has no frames, another glstar is writing there, or the directory cannot be written.
    """
    if not directory.is_dir():
        raise ExportError(directory, "is no directory of an export")
    with explain_disk_errors(directory), directory_lock(directory):
        refuse_links(directory)
        truth = TruthFile(directory)
        truth.read()
        if not is_unfinished(directory) and truth.numbers.size:
            return RecoveredExport(directory, len(truth.numbers), ())
        damaged = {}
        for number, line in zip(truth.numbers.tolist(), truth.lines(), strict=True):
            image = image_path(directory, parse_frame(directory, number, line))
            if not image.is_file() or find_damage(image):
                damaged[number] = image.relative_to(directory).as_posix()
        numbers = np.array([number for number in truth.numbers.tolist() if number not in damaged], dtype=np.int64)
        if not numbers.size:
            raise ExportError(directory, "has no finished frame to recover")
        remove_leftovers(directory)
        if (directory / NAME).exists():
            write_manifest(directory, read_manifest(directory / NAME) | {"frames": len(numbers)})
        finish_nav(directory, numbers)
        truth.finish(numbers)
    return RecoveredExport(directory, len(numbers), tuple(damaged.values()))


def _captured_image(capture: Capture, simulator: Simulator, span_s: float, image: Path) -> CapturedImage:
    """Return what the camera of a link reports of a picture that was drawn; `span_s`: duration of its exposure."""
    flight, mid_s = simulator.flight, capture.start_utc_s + span_s / 2
    site = flight.position.at(mid_s)
    C_camera_ned = simulator.mount.C_camera_body @ matrix_from_quaternion(flight.attitude.at(mid_s))
    # Forward, right, down of the camera are z, x, y of its image.
    w, x, y, z = quaternion_from_matrix(C_camera_ned[[2, 0, 1]].T).tolist()
    latitude_deg, longitude_deg = np.rad2deg([site.latitude_rad, site.longitude_rad]).tolist()
    return CapturedImage(capture, latitude_deg, longitude_deg, site.height_m, (w, x, y, z), image.absolute().as_uri())
