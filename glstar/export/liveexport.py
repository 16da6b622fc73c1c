"""Frames of a flight that is still going on, drawn as its attitudes come."""

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from math import floor, inf
from pathlib import Path
from typing import Any, Final

import numpy as np

from glstar import __version__
from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.directorylock import directory_lock
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.frames import FlightFrames
from glstar.export.framewriter import FrameWriter
from glstar.export.images import ImageFormat, fit_format
from glstar.export.latestframe import LatestFrameWriter
from glstar.export.layout import OURS, output_files
from glstar.export.lease import revoke_leases
from glstar.export.links import refuse_links
from glstar.export.manifest import SCHEMA, described_brightness, write_manifest
from glstar.export.plan import Plan, PlannedFrame, SkippedFrame
from glstar.export.task import EncodedFrame, FrameTask
from glstar.export.truthfile import TruthFile
from glstar.flight import Flight, Gap
from glstar.link import LatestAttitude, Link
from glstar.render.scene import Renderer
from glstar.render.simulator import Simulator
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.earthorientation import described_earth_orientation
from glstar.sky.timescale import format_utc
from glstar.system.durable import TEMPORARY, flush_directory, make_directory

__all__ = ["LiveExport", "LiveReport"]

# Of the flight so much is looked at beyond the exposure, s: its usual interval tells what is a gap.
_BEFORE_S: Final = 5.0
_GLANCE_S: Final = 0.1
# What is lacking is not told before it had time to come, s.
_PATIENCE_S: Final = 3.0
# A clock that was set back by more than this begins anew, s.
_SET_BACK_S: Final = 1.0
# Star directions are found anew after so long: they age by 0.03" an hour.
_STARS_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class LiveReport:
    """What a live export did.

    Attributes
    ----------
    directory : Path or None
    drawn : int
        Frames.
    skipped : tuple of SkippedFrame
        Exposures that met a gap.
    latency_s : tuple of float
        Of each frame, from the arrival of the newest attitude in it to its pixels and truth being ready, s.
    """

    directory: Path | None
    drawn: int
    skipped: tuple[SkippedFrame, ...]
    latency_s: tuple[float, ...] = field(repr=False)

    def latency_quantile_s(self, share: float) -> float | None:
        """Return the latency that a share of the frames do not exceed, s; None without frames."""
        return float(np.quantile(self.latency_s, share)) if self.latency_s else None


class LiveExport:
    """Draws what a link tells: exposures that end at the newest attitude, one every interval.

    Parameters
    ----------
    config : Config
    link : Link
        Open; it is used, not closed.
    directory : Path, optional
        Where frames, truth and manifest shall lie.
    latest : LatestFrameWriter, optional
        Who is handed each frame; it is used, not closed.
    image_format : {"png", "png16", "tiff"}, optional
        8-bit PNG unless the sensor has more bits.
    seed : int
        The seed from which every frame's own is derived.
    command : str
        What was asked for, for the manifest.
    """

    def __init__(
        self,
        config: Config,
        link: Link,
        *,
        directory: Path | None = None,
        latest: LatestFrameWriter | None = None,
        image_format: ImageFormat | None = None,
        seed: int = 0,
        command: str = "glstar live",
    ) -> None:
        self._config, self._link = config, link
        self._directory, self._latest, self._seed, self._command = directory, latest, seed, command
        self._format, self._sensor = fit_format(image_format, config.sensor())
        self._simulator: Simulator | None = None
        self._stars_utc_s = 0.0
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
        tell: Callable[[str], None] | None = None,
        on_frame: Callable[[int], None] | None = None,
    ) -> LiveReport:
        """Draw until the time is over, or Ctrl-C.

        Parameters
        ----------
        renderer : Renderer
        duration_s : float, optional
            How long, s; until interrupted unless said otherwise.
        force : bool
            Remove what an earlier export left in the directory.
        tell : callable, optional
            Called with what happens on the link, in words.
        on_frame : callable, optional
            Called with the number of frames, after each.

        Returns
        -------
        LiveReport

        Raises
        ------
        ExportError
            If the directory cannot be written, or holds frames.
        """
        tell, on_frame = tell or (lambda _: None), on_frame or (lambda _: None)
        until_s = inf if duration_s is None else time.monotonic() + duration_s
        with ExitStack() as held:
            directory = self._directory
            truth = None
            with ExitStack() as writing:
                writer = None
                if directory is not None:
                    held.enter_context(explain_disk_errors(directory))
                    truth = self._begin(directory, held, force=force)
                    lines = writing.enter_context(truth.open_for_append())
                    writer = writing.enter_context(FrameWriter(truth, lines, group_s=0.0))
                with suppress(KeyboardInterrupt):
                    self._watch(renderer, until_s, writer, tell, on_frame)
            if directory is not None and truth is not None:
                self._drawn = truth.numbers.tolist()  # an interrupted one may have its line already, or not yet
                self._write_manifest(directory, renderer)
                truth.finish(truth.numbers)
        return LiveReport(directory, len(self._drawn), tuple(self._skipped), tuple(self._latency_s))

    def _watch(
        self,
        renderer: Renderer,
        until_s: float,
        writer: FrameWriter | None,
        tell: Callable[[str], None],
        on_frame: Callable[[int], None],
    ) -> None:
        every_s = self._config.exposure.interval_s
        told, lacked, due_s = 0, "", -inf
        before: LatestAttitude | None = None
        patient_until_s = time.monotonic() + _PATIENCE_S
        while (left_s := until_s - time.monotonic()) > 0:
            for event in self._link.events(told):
                told = event.number
                tell(event.message)
            if writer is not None:
                deque(writer.poll(), maxlen=0)
            now = self._link.latest()
            if now is not None:
                # Where UTC is set, the next exposure is due one interval after the last one, not at the old UTC.
                due_s += 0.0 if before is None else now.utc_step_s(before)
                before = now
            newest = self._link.wait_for(due_s, min(_GLANCE_S, left_s))
            if newest is None or (before is not None and abs(newest.utc_step_s(before)) > _SET_BACK_S):
                if now is not None and now.utc_s < due_s - every_s - _SET_BACK_S:
                    due_s = -inf
                lacking = self._lacking()
                if time.monotonic() > patient_until_s and lacking is not None and lacking != lacked:
                    lacked = lacking
                    tell(lacking or "all is known that a frame needs")
                continue
            self._skip_missed(due_s, newest)
            frame = self._take(renderer, newest)
            if frame is None:
                due_s = newest.utc_s + _GLANCE_S
                continue
            due_s = newest.utc_s if due_s == -inf else due_s
            # What could not be drawn in time is left out: a frame shows the sky of now.
            due_s += every_s * (1 + max(floor((newest.utc_s - due_s) / every_s), 0))
            if isinstance(frame, EncodedFrame):
                if writer is not None and self._directory is not None:
                    if not self._drawn:
                        self._write_manifest(self._directory, renderer)
                    self._task().write(frame, partial(writer.stage, frame.number))
                    deque(writer.add(frame.number, frame.truth), maxlen=0)
                self._drawn.append(frame.number)
                on_frame(len(self._drawn))

    def _skip_missed(self, due_s: float, newest: LatestAttitude) -> None:
        """Count the exposures that were due while no attitude came, but not those that drawing was too slow for."""
        section = self._config.exposure
        missed = 0 if due_s == -inf else floor((newest.utc_s - due_s) / section.interval_s)
        flight = self._link.flight(newest.utc_s - due_s + section.duration_s + _BEFORE_S) if missed > 0 else None
        if flight is None:
            return
        for stop_s in due_s + section.interval_s * np.arange(missed):
            gap = flight.attitude.gap_within(stop_s - section.duration_s, stop_s)
            if gap is not None:
                self._skip(stop_s - section.duration_s, gap)

    def _skip(self, start_s: float, gap: Gap) -> SkippedFrame:
        number, self._number = self._number, self._number + 1
        self._first_utc_s = start_s if self._first_utc_s is None else self._first_utc_s
        skipped = SkippedFrame(number, round(start_s - self._first_utc_s, 6), gap.reason, round(gap.duration_s, 6))
        self._skipped.append(skipped)
        return skipped

    def _take(self, renderer: Renderer, newest: LatestAttitude) -> EncodedFrame | SkippedFrame | None:
        """Return the frame that ends now; None where the flight is too young for one."""
        section = self._config.exposure
        flight = self._link.flight(section.duration_s + _BEFORE_S)
        if flight is None:
            return None
        track = flight.attitude
        start_s = track.last_s - section.duration_s
        if start_s < track.first_s:
            return None
        gap = track.gap_within(start_s, track.last_s)
        if gap is not None:
            return self._skip(start_s, gap)
        self._first_utc_s = start_s if self._first_utc_s is None else self._first_utc_s
        number, self._number = self._number, self._number + 1
        self._simulator = self._following(flight)
        planned = PlannedFrame(number, Exposure(start_s, section.duration_s, section.rate_hz, section.trail))

        def hand_over(pixels: np.ndarray[Any, Any], truth: bytes) -> None:
            if self._latest is not None:
                self._latest.write(pixels, truth)
            self._latency_s.append(time.monotonic() - newest.arrival_s)

        return self._task(planned).draw(renderer, number, on_pixels=hand_over)

    def _following(self, flight: Flight) -> Simulator:
        """Return a simulator of the flight; the stars of an earlier one serve for an hour."""
        now_s = flight.attitude.last_s
        if self._simulator is None or abs(now_s - self._stars_utc_s) > _STARS_S:
            self._stars_utc_s = now_s
            return self._config.simulator(flight, sensor=self._sensor)
        return self._simulator.with_flight(flight)

    def _task(self, *planned: PlannedFrame) -> FrameTask:
        assert self._simulator is not None
        frames = FlightFrames(self._simulator, Plan(planned, ()))
        return FrameTask(frames, self._directory or Path(), self._format, noiseless=False, seed=self._seed)

    def _lacking(self) -> str | None:
        """Return what is still to be known before a frame can be drawn, and what to do; None while the link is dead."""
        status = self._link.status()
        return "; ".join(status.missing) if status.state == "live" else None

    # --- the directory ------------------------------------------------------------------------------------------------

    def _begin(self, directory: Path, held: ExitStack, *, force: bool) -> TruthFile:
        make_directory(directory)
        held.enter_context(directory_lock(directory))
        refuse_links(directory)
        entries = list(output_files(directory))
        there = [path for path in entries if OURS.fullmatch(path.name) or path.name.startswith(TEMPORARY)]
        if there and not force:
            words = (
                "holds frames already; what is live comes once: choose another directory, or start over with --force"
            )
            raise ExportError(directory, words)
        revoke_leases(directory)
        for path in there:
            path.unlink(missing_ok=True)
        flush_directory(directory)
        return TruthFile(directory)

    def _write_manifest(self, directory: Path, renderer: Renderer) -> None:
        """Write what made the frames; in the words of `manifest.describe`."""
        config, simulator = self._config, self._simulator
        flight: dict[str, Any] = {"name": self._link.endpoint.text, "vehicle": self._link.status().vehicle}
        if simulator is not None and self._first_utc_s is not None:
            told = simulator.flight
            flight |= {
                "first_utc": format_utc(self._first_utc_s),
                "last_utc": format_utc(told.attitude.last_s),
                "attitude": told.attitude_source,
                "position": told.position_source,
                "utc": told.utc_source,
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
