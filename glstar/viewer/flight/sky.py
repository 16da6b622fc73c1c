"""The sky along a flight, for the timeline, and the conditions of the image shown.

Number of stars, limiting magnitude and signal-to-noise ratio are sampled on a thread of its own.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil
from threading import Event
from typing import NamedTuple

import numpy as np

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.config import ExposureSection
from glstar.errors import GlstarError
from glstar.flight import PositionTrack
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.conditions import LimitingMagnitude, ViewingConditions, limiting_magnitude, viewing_conditions
from glstar.sky.air.skybrightness import LIGHT_LEVELS
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.viewer.flight.playhead import PlayHead
from glstar.viewer.flight.traces import TimelineCurve
from glstar.viewer.skyobjects import star_signal_to_noise

# Number of exposures along the flight, and the strides in which they are composed: coarse first.
_COUNT = 241
_STRIDES = (16, 8, 4, 2, 1)
# Pause after each exposure, s, so that the window's thread is not kept waiting.
_PAUSE_S = 0.002


class _Wanted(NamedTuple):
    """What samples depend on."""

    simulator: Simulator
    section: ExposureSection
    star_id: int | None


class SkySamples:
    """Values along a flight, of which more and more are known; `wanted`: what they are computed for."""

    def __init__(self, wanted: _Wanted) -> None:
        self.wanted = wanted
        # (n,) the middle of each exposure, s from the flight's first attitude.
        self.second = np.full(_COUNT, np.nan)
        # (4, n) number of stars, limiting magnitude at rest and as a trail, signal-to-noise ratio of the star; NaN
        # without an exposure or a star.
        self.values = np.full((4, _COUNT), np.nan)
        self.known = np.zeros(_COUNT, dtype=np.bool_)  # (n,) which exposures have been composed
        self.cancelled = Event()

    def lines(self, curve: TimelineCurve) -> list[tuple[Float, Float]]:
        """Return the lines of a curve as far as they are known: a list of (second, value), (m,) each."""
        composed = np.flatnonzero(self.known)
        rows = {TimelineCurve.STARS: (0,), TimelineCurve.LIMIT: (1, 2), TimelineCurve.SNR: (3,)}[curve]
        return [(self.second[composed], self.values[row, composed]) for row in rows]

    def compute(self) -> None:
        """Compose the exposures, coarse first, until all are known or it is cancelled."""
        simulator, section, star_id = self.wanted
        attitude = simulator.flight.attitude
        starts_s = np.linspace(attitude.first_s, max(attitude.last_s - section.span_s, attitude.first_s), _COUNT)
        for stride in _STRIDES:
            for k in range(0, _COUNT, stride):
                if self.known[k]:
                    continue
                exposure = section.starting_at(float(starts_s[k]))
                self.second[k] = exposure.mid_utc_s - attitude.first_s
                inside = exposure.stop_utc_s <= attitude.last_s
                if inside and attitude.gap_within(exposure.start_utc_s, exposure.stop_utc_s) is None:
                    self.values[:, k] = _sampled(simulator, exposure.first, star_id)
                self.known[k] = True
                if self.cancelled.wait(_PAUSE_S):
                    return


class SkySampler:
    """Computes samples of one flight at a time, and again when its settings or the selected star change."""

    def __init__(self) -> None:
        self._samples: SkySamples | None = None
        self._future: Future[None] | None = None
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-samples")

    @property
    def is_busy(self) -> bool:
        """Whether samples are being computed."""
        return self._future is not None and not self._future.done()

    def of(self, simulator: Simulator, section: ExposureSection, star_id: int | None) -> SkySamples:
        """Return the samples of a flight, which go on to be computed.

        `star_id`: the star whose signal-to-noise ratio is computed.
        """
        wanted = _Wanted(simulator, section, star_id)
        before = self._samples
        if before is not None and before.wanted[0] is simulator and before.wanted[1:] == wanted[1:]:
            return before
        if before is not None:
            before.cancelled.set()
        self._samples = SkySamples(wanted)
        self._future = self._thread.submit(self._samples.compute)
        return self._samples

    def wait(self) -> None:
        """Wait until all samples are known: for scripts."""
        if self._future is not None:
            self._future.result()

    def close(self) -> None:
        """Stop, and end the thread."""
        if self._samples is not None:
            self._samples.cancelled.set()
        self._thread.shutdown(wait=True, cancel_futures=True)


def _sampled(simulator: Simulator, exposure: Exposure, star_id: int | None) -> tuple[float, float, float, float]:
    """Return number of stars, limiting magnitude at rest and as a trail, signal-to-noise ratio of a star."""
    try:
        scene = simulator.scene(exposure)
        limit = limiting_magnitude(scene)
    except GlstarError:
        return np.nan, np.nan, np.nan, np.nan
    snr = np.nan if star_id is None else star_signal_to_noise(scene, star_id)
    return float(scene.visible.size), limit.at_rest_mag, limit.trail_mag, snr


# Interval of the times for which the Sun is computed, s: between them its altitude is a line to 0.004 deg.
_STEP_S = 300.0
# Largest number of those times: 0.1 deg for a flight of four days.
_MOST_TIMES = 300


def light_intervals(position: PositionTrack, first_s: float, last_s: float) -> dict[str, Float]:
    """Return when it is day and when twilight: (n, 2) start and end of each interval, UTC seconds since 1970.

    Intervals are listed by the names of `LIGHT_LEVELS` without night, if they occur.  `position`: of the aircraft;
    `first_s`, `last_s`: UTC seconds since 1970.
    """
    count = min(max(ceil((last_s - first_s) / _STEP_S), 1), _MOST_TIMES) + 1
    times_s = np.linspace(first_s, last_s, count)
    altitude_rad = np.array([sun_altitude_rad(float(utc_s), position.at(float(utc_s))) for utc_s in times_s])
    edges_rad = np.array([least_rad for _, least_rad in LIGHT_LEVELS[:-1]])
    crossings = [first_s, last_s]
    for edge_rad in edges_rad:
        above = altitude_rad - edge_rad
        (before,) = np.nonzero((above[1:] > 0) != (above[:-1] > 0))
        fraction = above[before] / (above[before] - above[before + 1])
        crossings += (times_s[before] + fraction * (times_s[before + 1] - times_s[before])).tolist()
    ends_s = np.unique(crossings)
    middle_rad = np.interp((ends_s[1:] + ends_s[:-1]) / 2, times_s, altitude_rad)
    level = (middle_rad[:, np.newaxis] <= edges_rad).sum(axis=1)
    spans_s = np.stack([ends_s[:-1], ends_s[1:]], axis=1)
    intervals = {name: spans_s[level == k] for k, (name, _) in enumerate(LIGHT_LEVELS[:-1])}
    return {name: spans for name, spans in intervals.items() if len(spans)}


# Interval at which they are computed while the flight plays, s: a computation takes about 1 ms.
_INTERVAL_S = 0.5


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions of one image."""

    viewing: ViewingConditions
    limit: LimitingMagnitude


class CurrentConditions:
    """Computes the conditions of the image shown when it changes, and while the flight plays twice a second.

    `clock`: returns seconds from any origin.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._scene: Scene | None = None
        self._conditions: Conditions | None = None
        self._computed_s = 0.0

    def of(self, scene: Scene | None, head: PlayHead | None) -> Conditions | None:
        """Return the conditions of a scene; None without a scene, and for a scene that does not know its sky.

        `head`: while it moves, the conditions of a scene of the last half second are returned.
        """
        if scene is None or scene.observing_sky is None:
            return None
        if scene is not self._scene:
            now_s = self._clock()
            moves = head is not None and (head.playing or head.live)
            if self._conditions is None or not moves or now_s - self._computed_s >= _INTERVAL_S:
                self._conditions = Conditions(viewing_conditions(scene), limiting_magnitude(scene))
                self._scene, self._computed_s = scene, now_s
        return self._conditions
