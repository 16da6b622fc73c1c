"""Export of frames from a live MAVLink link, as attitudes arrive."""

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from math import floor, inf
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from glstar import __version__
from glstar.camera.exposure import ControlledExposure, Exposure
from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.directory import OURS, directory_lock, explain_disk_errors, output_files, refuse_links, revoke_leases
from glstar.export.frame import EncodedFrame, FrameTask, FrameWriter
from glstar.export.imagefiles.formats import ImageFormat, fit_format
from glstar.export.navigator import LiveNavigator
from glstar.export.plan.frames import ControlledFrames, FlightFrames, Plan, PlannedFrame, SkippedFrame, level_of
from glstar.export.plan.manifest import SCHEMA, described_brightness, write_manifest
from glstar.export.publish.outputs import FrameOutput
from glstar.export.publish.stream import FrameStream
from glstar.export.truth.lines import TruthFile
from glstar.flight import Flight, Gap
from glstar.link import Estimate, LatestAttitude, Link
from glstar.render.scene.scene import Renderer
from glstar.render.simulator import Simulator
from glstar.render.truth.conditions import conditions_report
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.timescale import described_earth_orientation, format_utc
from glstar.system.files import TEMPORARY, flush_directory, make_directory

# Part of the flight before the exposure that is read too, s: its median sample interval decides what counts as a gap.
_CONTEXT_S = 5.0
# Interval at which events of the link are reported while no exposure is due, s.
_POLL_INTERVAL_S = 0.1
# Time for site, UTC and attitude to arrive before missing ones are reported, s.
_REPORT_DELAY_S = 3.0
# If the clock is set back by more than this, the sequence of exposures restarts at the current time, s.
_CLOCK_RESET_S = 1.0
# Exposures that answers may be for: an hour at ten frames a second, each twice.
_MOST_EXPOSURES = 72_000
# Time after which apparent star directions are computed again, s: they change by 0.03" per hour.
_STARS_VALID_S = 3600.0


@dataclass(frozen=True, slots=True)
class LiveReport:
    """The result of a live export."""

    directory: Path | None
    drawn: int  # Number of frames
    skipped: tuple[SkippedFrame, ...]  # Exposures that span a gap
    # For each frame, the time from the arrival of its latest attitude to its pixels and truth being ready, s.
    latency_s: tuple[float, ...] = field(repr=False)

    def latency_quantile_s(self, fraction: float) -> float | None:
        """Return the latency that a fraction of the frames does not exceed, s; None without frames."""
        return float(np.quantile(self.latency_s, fraction)) if self.latency_s else None


class LiveExport:
    """Draws exposures that end at the latest attitude of a link, one per interval.

    `link`: an open link; the caller closes it; if its sky is a simulator's truth, ``nav.jsonl`` has what the autopilot
    estimates; `directory`: the output directory; nothing is written if None; `output`: receives each frame; the caller
    closes it; `image_format` {"png", "png16", "tiff", "fits", "jpeg"}, optional: none for 8-bit PNG, or 16-bit PNG if
    the sensor has more than 8 bits; `seed`: the seed from which the noise seed of every frame is derived; `command`:
    the command line, for the manifest.  `exposures`: of the latest frames, by number and by the name of the image.
    """

    def __init__(
        self,
        config: Config,
        link: Link,
        *,
        directory: Path | None = None,
        output: FrameOutput | None = None,
        image_format: ImageFormat | None = None,
        seed: int = 0,
        command: str = "glstar live",
    ) -> None:
        self._config = config
        self._link = link
        self._directory = directory
        self._output = output
        self._seed = seed
        self._command = command
        self._writes_nav = directory is not None and link.truth == "sim_state"
        self._format, self._sensor = fit_format(image_format, config.sensor(), summed=config.exposure.signal_factor)
        self._nav: LiveNavigator | None = None
        self._simulator: Simulator | None = None
        self._control: ControlledExposure | None = None
        self._stars_utc_s = 0.0
        self.exposures: dict[int | str, Exposure] = {}
        self._stopping = Event()
        self._number = 0
        self._drawn: list[int] = []
        self._skipped: list[SkippedFrame] = []
        self._latency_s: list[float] = []
        self._first_utc_s: float | None = None

    def run(
        self,
        renderer: Renderer,
        *,
        duration_s: float | None = None,
        force: bool = False,
        on_event: Callable[[str], None] | None = None,
        on_frame: Callable[[int], None] | None = None,
    ) -> LiveReport:
        """Draw for a time, s, until Ctrl-C or until `stop`.

        With `force` the files of an earlier export are removed from the directory. `on_event` is called with a message
        for each event of the link, and with the Sun, the Moon and the limiting magnitude of the first frame; `on_frame`
        with the number of frames after each frame. Raises ExportError if the directory cannot be written, or holds
        frames; ConfigError if ``[navigator]`` names a message of a log.
        """
        on_event, on_frame = on_event or (lambda _: None), on_frame or (lambda _: None)
        until_s = inf if duration_s is None else time.monotonic() + duration_s
        with ExitStack() as locked:
            directory = self._directory
            if self._writes_nav or isinstance(self._output, FrameStream):
                self._nav = locked.enter_context(closing(LiveNavigator(self._config, directory, duration_s)))
            truth = None
            with ExitStack() as writing:
                writer = None
                if directory is not None:
                    locked.enter_context(explain_disk_errors(directory))
                    truth = self._open(directory, locked, force=force)
                    lines = writing.enter_context(truth.open_for_append())
                    writer = writing.enter_context(FrameWriter(truth, lines, group_s=0.0))
                with suppress(KeyboardInterrupt):
                    self._follow(renderer, until_s, writer, on_event, on_frame)
            if directory is not None and truth is not None:
                self._drawn = truth.numbers.tolist()  # an interrupted frame may or may not have its line
                self._write_manifest(directory, renderer)
                if self._nav is not None and self._writes_nav:
                    self._nav.finish(truth.numbers)
                truth.finish(truth.numbers)
        return LiveReport(directory, len(self._drawn), tuple(self._skipped), tuple(self._latency_s))

    def stop(self) -> None:
        """End `run` after the current frame; another thread may call it."""
        self._stopping.set()

    def _follow(
        self,
        renderer: Renderer,
        until_s: float,
        writer: FrameWriter | None,
        on_event: Callable[[str], None],
        on_frame: Callable[[int], None],
    ) -> None:
        every_s = self._config.exposure.interval_s
        last_event, lacked, due_s = 0, "", -inf
        before: LatestAttitude | None = None
        report_after_s = time.monotonic() + _REPORT_DELAY_S
        while (left_s := until_s - time.monotonic()) > 0 and not self._stopping.is_set() and self._link.failure is None:
            for event in self._link.events(last_event):
                last_event = event.number
                on_event(event.message)
            if writer is not None:
                deque(writer.poll(), maxlen=0)
            now = self._link.latest()
            if now is not None:
                # If UTC is set, the next exposure is due one interval after the previous one, not at the old UTC.
                due_s += 0.0 if before is None else now.utc_step_s(before)
                before = now
            latest = self._link.wait_for(due_s, min(_POLL_INTERVAL_S, left_s))
            if latest is None or (before is not None and abs(latest.utc_step_s(before)) > _CLOCK_RESET_S):
                if now is not None and now.utc_s < due_s - every_s - _CLOCK_RESET_S:
                    due_s = -inf
                lacking = self._lacking()
                if time.monotonic() > report_after_s and lacking is not None and lacking != lacked:
                    lacked = lacking
                    on_event(lacking or "everything that a frame needs is known now")
                continue
            self._skip_missed(due_s, latest)
            frame = self._draw_latest(renderer, latest)
            if frame is None:
                due_s = latest.utc_s + _POLL_INTERVAL_S
                continue
            due_s = latest.utc_s if due_s == -inf else due_s
            # Exposures that could not be drawn in time are left out, so that a frame always shows the current sky.
            due_s += every_s * (1 + max(floor((latest.utc_s - due_s) / every_s), 0))
            if isinstance(frame, EncodedFrame):
                if writer is not None and self._directory is not None:
                    if not self._drawn:
                        self._write_manifest(self._directory, renderer)
                    self._task().write(frame, partial(writer.stage, frame.number))
                    deque(writer.add(frame.number, frame.truth), maxlen=0)
                if not self._drawn:
                    on_event(self._conditions())
                self._drawn.append(frame.number)
                on_frame(len(self._drawn))

    def _conditions(self) -> str:
        """Return the Sun, the Moon and the limiting magnitude of the exposure that was drawn last."""
        assert self._simulator is not None
        section = self._config.exposure
        start_s = self._simulator.flight.attitude.last_s - section.span_s
        return conditions_report(self._simulator.scene(section.starting_at(start_s)))

    def _skip_missed(self, due_s: float, latest: LatestAttitude) -> None:
        """Count the exposures that were due in a data gap, but not those for which drawing was too slow."""
        section = self._config.exposure
        missed = 0 if due_s == -inf else floor((latest.utc_s - due_s) / section.interval_s)
        flight = self._link.flight(latest.utc_s - due_s + section.span_s + _CONTEXT_S) if missed > 0 else None
        if flight is None:
            return
        for stop_s in due_s + section.interval_s * np.arange(missed):
            gap = flight.attitude.gap_within(stop_s - section.span_s, stop_s)
            if gap is not None:
                self._skip(stop_s - section.span_s, gap)

    def _skip(self, start_s: float, gap: Gap) -> SkippedFrame:
        number, self._number = self._number, self._number + 1
        self._first_utc_s = start_s if self._first_utc_s is None else self._first_utc_s
        skipped = SkippedFrame(number, round(start_s - self._first_utc_s, 6), gap.reason, round(gap.duration_s, 6))
        self._skipped.append(skipped)
        return skipped

    def _draw_latest(self, renderer: Renderer, latest: LatestAttitude) -> EncodedFrame | SkippedFrame | None:
        """Return the frame that ends at the latest attitude; None if the flight is shorter than the exposure."""
        section = self._config.exposure
        flight, estimate = self._link.flight_and_estimate(section.span_s + _CONTEXT_S)
        if flight is None or (estimate is None and self._nav is not None and self._link.truth == "sim_state"):
            return None
        track = flight.attitude
        start_s = track.last_s - section.span_s  # of the longest exposure of a control
        if start_s < track.first_s:
            return None
        gap = track.gap_within(start_s, track.last_s)
        if gap is None and estimate is not None:
            if start_s < estimate.attitude.first_s:
                return None
            gap = estimate.attitude.gap_within(start_s, track.last_s)
        if gap is not None:
            return self._skip(start_s, gap)
        self._first_utc_s = start_s if self._first_utc_s is None else self._first_utc_s
        number, self._number = self._number, self._number + 1
        self._simulator = self._simulator_of(flight)
        task = self._task(PlannedFrame(number, section.starting_at(start_s)))
        if section.exposure_control is not None:
            task = self._controlled(task, number, track.last_s)
        shot = task.frames.shot(number)
        image = task.image_path(number)
        record: dict[str, Any] = {}
        if self._nav is not None:
            # Without a simulator's state the flight itself is what the autopilot estimates.
            estimate = estimate or Estimate(flight.aircraft_attitude, flight.position, flight.attitude_source)
            file = image.relative_to(task.directory).as_posix()
            shown = self._simulator.flight
            record = self._nav.record(estimate, shot.exposure, number=number, file=file, flight=shown, gain=shot.gain)

        def publish(pixels: np.ndarray[Any, Any], truth: bytes) -> None:
            if self._control is not None:
                level = level_of(self._control.control, shot.exposure, self._sensor, pixels)
                self._control = self._control.after(level)
            if self._output is not None:
                self._output.write(pixels, truth, record)
            self._latency_s.append(time.monotonic() - latest.arrival_s)

        self.exposures |= dict.fromkeys((number, image.name), shot.exposure)
        while len(self.exposures) > _MOST_EXPOSURES:
            del self.exposures[next(iter(self.exposures))]
        frame = task.draw(renderer, number, on_pixels=publish)
        if self._nav is not None and self._writes_nav:
            self._nav.write(record)
        return frame

    def _simulator_of(self, flight: Flight) -> Simulator:
        """Return a simulator of the flight, with the stars of an earlier one that is less than an hour old."""
        now_s = flight.attitude.last_s
        if self._simulator is None or abs(now_s - self._stars_utc_s) > _STARS_VALID_S:
            self._stars_utc_s = now_s
            return self._config.simulator(flight, sensor=self._sensor)
        return self._simulator.with_flight(flight)

    def _task(self, *planned: PlannedFrame) -> FrameTask:
        assert self._simulator is not None
        frames = FlightFrames(self._simulator, Plan(planned, ()), self._config.exposure.exposure_control)
        return FrameTask(frames, self._directory or Path(), self._format, noiseless=False, seed=self._seed)

    def _controlled(self, task: FrameTask, number: int, stop_utc_s: float) -> FrameTask:
        """Return the task with the exposure time and gain of the exposure control; it ends at a time as well."""
        shot = task.frames.shot(number)
        if self._control is None:
            assert shot.control is not None
            self._control = ControlledExposure.begun(shot.control, shot.sensor_gain)
        duration_s, gain = self._control.settings
        start_s = stop_utc_s - shot.exposure.shortened(duration_s).span_s
        task = self._task(PlannedFrame(number, replace(shot.exposure, start_utc_s=start_s)))
        return replace(task, frames=ControlledFrames(task.frames, {number: (duration_s, gain)}))

    def _lacking(self) -> str | None:
        """Return what is missing to draw a frame, empty if nothing is; None while the link has timed out."""
        status = self._link.status()
        return "; ".join(status.missing) if status.state == "live" else None

    # --- the directory ------------------------------------------------------------------------------------------------

    def _open(self, directory: Path, locked: ExitStack, *, force: bool) -> TruthFile:
        make_directory(directory)
        locked.enter_context(directory_lock(directory))
        refuse_links(directory)
        entries = list(output_files(directory))
        existing = [path for path in entries if OURS.fullmatch(path.name) or path.name.startswith(TEMPORARY)]
        if existing and not force:
            message = "holds frames already; choose another directory for a live export, or start over with --force"
            raise ExportError(directory, message)
        revoke_leases(directory)
        for path in existing:
            path.unlink(missing_ok=True)
        flush_directory(directory)
        return TruthFile(directory)

    def _write_manifest(self, directory: Path, renderer: Renderer) -> None:
        """Write the manifest, with the keys of `manifest.describe`."""
        config, simulator = self._config, self._simulator
        flight: dict[str, Any] = {"name": self._link.endpoint.text, "vehicle": self._link.status().vehicle}
        if simulator is not None and self._first_utc_s is not None:
            shown = simulator.flight
            flight |= {
                "first_utc": format_utc(self._first_utc_s),
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
            "sensor": self._sensor.keys,
            "catalogue": {"name": config.sky.catalogue, "sha256": StarCatalogue.open(config.sky.catalogue).sha256},
            **described_brightness(config),
            **(described_earth_orientation(self._first_utc_s or 0.0) if config.sky.dut1_s is None else {}),
            "start_s": 0.0,
            "format": self._format,
            "light": False,
            "seed": self._seed,
            "frames": len(self._drawn),
            "skipped": [asdict(frame) for frame in self._skipped],
            "renderer": renderer.driver,
        }
        write_manifest(directory, manifest)
