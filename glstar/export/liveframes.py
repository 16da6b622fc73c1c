"""Frames of a live link: each is drawn from the part of the flight that has arrived, with the truth of its exposure."""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from glstar.camera.exposure import ControlledExposure, Exposure
from glstar.config import Config
from glstar.export.frame import EncodedFrame, FrameTask
from glstar.export.imagefiles.formats import ImageFormat, fit_format
from glstar.export.navigator import LiveNavigator
from glstar.export.plan.frames import ControlledFrames, FlightFrames, Plan, PlannedFrame, SkippedFrame, level_of
from glstar.export.publish.outputs import FrameOutput
from glstar.flight import Flight, Gap
from glstar.link import Estimate, LatestAttitude, Link
from glstar.render.scene.scene import Renderer
from glstar.render.simulator import Simulator

# Part of the flight before the exposure that is read too, s: its median sample interval decides what counts as a gap.
CONTEXT_S = 5.0
# Exposures that answers may be for: an hour at ten frames a second, each twice.
_MOST_EXPOSURES = 72_000
# Time after which apparent star directions are computed again, s: they change by 0.03" per hour.
_STARS_VALID_S = 3600.0


class LiveFrames:
    """Draws the frames of a link, and counts those that cannot be drawn.

    The parameters are those of `glstar.export.live.LiveExport`.
    """

    def __init__(
        self,
        config: Config,
        link: Link,
        *,
        directory: Path | None,
        output: FrameOutput | None,
        image_format: ImageFormat | None,
        seed: int,
    ) -> None:
        self.config = self._begun = config
        self.seed = seed
        self.format, self.sensor = fit_format(image_format, config.sensor(), summed=config.exposure.signal_factor)
        self._settings: dict[str, float] = {}
        self.output = output
        # What the aircraft knows, where it is written or passed on.
        self.nav: LiveNavigator | None = None
        self.simulator: Simulator | None = None
        self.latest_exposure = config.exposure.starting_at(0.0)
        self.first_utc_s: float | None = None
        self.exposures: dict[int | str, Exposure] = {}
        self.skipped: list[SkippedFrame] = []
        self.latency_s: list[float] = []
        self._link = link
        self._directory = directory
        self._writes_nav = directory is not None and link.truth == "sim_state"
        self._control: ControlledExposure | None = None
        self._stars_utc_s = 0.0
        self._number = 0

    def use(self, settings: Mapping[str, float]) -> None:
        """Draw with other values of some keys of the config, whose images have the same format."""
        if settings == self._settings:
            return
        self._settings = dict(settings)
        self.config = self._begun.override(**settings)
        summed = self.config.exposure.signal_factor
        _, self.sensor = fit_format(self.format, self.config.sensor(), summed=summed)
        self.simulator = self._control = None

    def draw(
        self, renderer: Renderer, begins_s: float | None, latest: LatestAttitude, about: Mapping[str, Any]
    ) -> EncodedFrame | SkippedFrame | None:
        """Return a frame; None if the flight does not have its exposure.

        `begins_s`: start of the exposure, UTC s; None if it ends at the latest attitude; `about`: further keys of its
        truth.
        """
        exposed = self._exposed(begins_s, latest)
        if exposed is None:
            return None
        flight, estimate, start_s, gap = exposed
        if gap is not None:
            return self.skip(start_s, gap)
        self.first_utc_s = start_s if self.first_utc_s is None else self.first_utc_s
        number, self._number = self._number, self._number + 1
        self.simulator = self._simulator_of(flight)
        planned = PlannedFrame(number, self.config.exposure.starting_at(start_s), about)
        self.latest_exposure = planned.exposure
        task = self.task(planned)
        if self.config.exposure.exposure_control is not None:
            task = self._controlled(task, planned, None if begins_s is None else start_s)
        image = task.image_path(number)
        exposure = task.frames.shot(number).exposure
        record = self._record(task, number, flight, estimate)

        def publish(pixels: np.ndarray[Any, Any], truth: bytes) -> None:
            if self._control is not None:
                level = level_of(self._control.control, exposure, self.sensor, pixels)
                self._control = self._control.after(level)
            if self.output is not None:
                self.output.write(pixels, truth, record)
            self.latency_s.append(time.monotonic() - latest.arrival_s)

        self.exposures |= dict.fromkeys((number, image.name), exposure)
        while len(self.exposures) > _MOST_EXPOSURES:
            del self.exposures[next(iter(self.exposures))]
        frame = task.draw(renderer, number, on_pixels=publish)
        if self.nav is not None and self._writes_nav:
            self.nav.write(record)
        return frame

    def show(self, renderer: Renderer, latest: LatestAttitude, output: FrameOutput) -> bool:
        """Pass on a frame that ends at the latest attitude; it has no number of its own, and is not written.

        Returns whether it was drawn: not in a gap.
        """
        exposed = self._exposed(None, latest)
        if exposed is None or exposed[3] is not None:
            return False
        flight, estimate, start_s, _ = exposed
        self.simulator = self._simulator_of(flight)
        task = self.task(PlannedFrame(self._number, self.config.exposure.starting_at(start_s), {}))
        publish = partial(self._pass_on, output, self._record(task, self._number, flight, estimate))
        task.draw(renderer, self._number, on_pixels=publish)
        return True

    @staticmethod
    def _pass_on(output: FrameOutput, record: dict[str, Any], pixels: np.ndarray[Any, Any], truth: bytes) -> None:
        output.write(pixels, truth, record)

    def skip(self, start_s: float, gap: Gap) -> SkippedFrame:
        """Count an exposure that meets a gap; `start_s`: its start, UTC s."""
        number, self._number = self._number, self._number + 1
        self.first_utc_s = start_s if self.first_utc_s is None else self.first_utc_s
        skipped = SkippedFrame(number, round(start_s - self.first_utc_s, 6), gap.reason, round(gap.duration_s, 6))
        self.skipped.append(skipped)
        return skipped

    def task(self, *planned: PlannedFrame) -> FrameTask:
        """Return how planned frames are drawn and where they are written."""
        assert self.simulator is not None
        frames = FlightFrames(self.simulator, Plan(planned, ()), self.config.exposure.exposure_control)
        return FrameTask(frames, self._directory or Path(), self.format, noiseless=False, seed=self.seed)

    def _exposed(
        self, begins_s: float | None, latest: LatestAttitude
    ) -> tuple[Flight, Estimate | None, float, Gap | None] | None:
        """Return the flight of an exposure, what the autopilot estimates, its start, UTC s, and the gap that it meets.

        None if the flight does not have the exposure; the parameters are those of `draw`.
        """
        section = self.config.exposure
        back_s = section.span_s if begins_s is None else latest.utc_s - begins_s
        flight, estimate = self._link.flight_and_estimate(back_s + CONTEXT_S)
        if flight is None or (estimate is None and self.nav is not None and self._link.truth == "sim_state"):
            return None
        track = flight.attitude
        # With an exposure control, of its longest exposure.
        start_s = track.last_s - section.span_s if begins_s is None else begins_s
        stop_s = start_s + section.span_s
        if start_s < track.first_s or stop_s > track.last_s:
            return None
        gap = track.gap_within(start_s, stop_s)
        if gap is None and estimate is not None:
            if start_s < estimate.attitude.first_s:
                return None
            gap = estimate.attitude.gap_within(start_s, stop_s)
        return flight, estimate, start_s, gap

    def _record(self, task: FrameTask, number: int, flight: Flight, estimate: Estimate | None) -> dict[str, Any]:
        """Return the aircraft's knowledge of a frame; empty if no record of a navigator is made."""
        if self.nav is None:
            return {}
        assert self.simulator is not None
        # Without a simulator's state the flight itself is what the autopilot estimates.
        estimate = estimate or Estimate(flight.aircraft_attitude, flight.position, flight.attitude_source)
        shot = task.frames.shot(number)
        file = task.image_path(number).relative_to(task.directory).as_posix()
        shown = self.simulator.flight
        return self.nav.record(estimate, shot.exposure, number=number, file=file, flight=shown, gain=shot.gain)

    def _simulator_of(self, flight: Flight) -> Simulator:
        """Return a simulator of the flight, with the stars of an earlier one that is less than an hour old."""
        now_s = flight.attitude.last_s
        if self.simulator is None or abs(now_s - self._stars_utc_s) > _STARS_VALID_S:
            self._stars_utc_s = now_s
            return self.config.simulator(flight, sensor=self.sensor)
        return self.simulator.with_flight(flight)

    def _controlled(self, task: FrameTask, planned: PlannedFrame, begins_s: float | None) -> FrameTask:
        """Return the task with the exposure time and gain of the exposure control.

        `begins_s`: when the exposure begins, UTC s; None if it ends when the planned one does.
        """
        shot = task.frames.shot(planned.number)
        if self._control is None:
            assert shot.control is not None
            self._control = ControlledExposure.begun(shot.control, shot.sensor_gain)
        duration_s, gain = self._control.settings
        start_s = planned.exposure.stop_utc_s - shot.exposure.shortened(duration_s).span_s
        exposure = replace(planned.exposure, start_utc_s=start_s if begins_s is None else begins_s)
        task = self.task(replace(planned, exposure=exposure))
        return replace(task, frames=ControlledFrames(task.frames, {planned.number: (duration_s, gain)}))
