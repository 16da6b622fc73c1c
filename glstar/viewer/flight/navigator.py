"""What a navigator believes beside the truth: the estimate of ``[navigator]``, and its answers for frames."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.config import Config
from glstar.export.navigator import LiveNavigator, Navigator
from glstar.flight import Flight
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.place.site import surface_offset_km
from glstar.sky.place.timescale import CLOCK_GRAIN_S
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.loaded import BEFORE_EXPOSURE_S, LoadedFlight
from glstar.viewer.flight.others import OtherLog, OtherLogs
from glstar.viewer.overlays.belief import Belief, PlacedAnswer

# Answers of a live link that are kept.
_MOST_ANSWERS = 1000


class NavigatorView:
    """Computes what the navigator believes at the image shown.

    `answers`: in the order of their times; `live`: the flight of a link; `others`: further logs of the same flight.
    """

    def __init__(self, others: OtherLogs | None = None) -> None:
        self.answers: Sequence[PlacedAnswer] = ()
        self.live: LiveFlight | None = None
        self.others = OtherLogs() if others is None else others
        self._others_of: tuple[OtherLog, ...] = ()
        self._navigator: tuple[Config, Flight, Navigator | None] | None = None
        self._live_navigator: tuple[Config, LiveNavigator] | None = None
        self._last: tuple[Scene, Sequence[PlacedAnswer], tuple[Belief, ...]] | None = None

    def add(self, answer: PlacedAnswer) -> None:
        """Add an answer of a live link; the oldest are dropped."""
        self.answers = sorted([*self.answers, answer], key=lambda each: each.utc_s)[-_MOST_ANSWERS:]

    def beliefs(
        self, loaded: LoadedFlight | None, simulator: Simulator | None, scene: Scene | None
    ) -> tuple[Belief, ...]:
        """Return the estimate, if it can differ from the truth, and the latest answer at the end of an exposure.

        `simulator`: that of the scene; `scene`: of the image shown.
        """
        if loaded is None or simulator is None or scene is None:
            return ()
        is_same = self._last is not None and self._last[0] is scene and self._last[1] is self.answers
        if self._last is not None and is_same and self._others_of == self.others.shown:
            return self._last[2]
        answers, beliefs = self.answers, list[Belief]()
        record = self._live_record(loaded, scene) if loaded.is_live else self._record(loaded, scene)
        if record is not None and record["q_body_ned"] is not None:
            C_camera_body = loaded.config.mount().C_camera_body
            beliefs.append(_estimate(record, C_camera_body, simulator, scene, has_position=loaded.is_live))
        times_s = [answer.utc_s for answer in answers]
        if (number := bisect_right(times_s, scene.exposure.stop_utc_s)) > 0:
            answer = answers[number - 1]
            if loaded.is_live and answer.utc_s < simulator.flight.attitude.first_s:
                simulator = simulator.with_flight(loaded.flight)  # the whole buffer of the link
            beliefs.append(_answered(answer, simulator, scene))
        C_camera_body = loaded.config.mount().C_camera_body
        beliefs += [_beside(each, C_camera_body, simulator, scene) for each in self.others.shown]
        self._others_of = self.others.shown
        self._last = scene, answers, tuple(beliefs)
        return self._last[2]

    def lacking(self, loaded: LoadedFlight | None) -> str:
        """Return why there is neither an estimate nor an answer to draw; empty if there is one."""
        if loaded is None or self.answers or self.others.shown or self._may_differ(loaded):
            return ""
        if loaded.is_live:
            return (
                "nothing to draw: the sky is that of the estimate, and there are no answers; see --truth sim_state,"
                " [navigator] and --answers"
            )
        return (
            "nothing to draw: the aircraft knows the truth, and there are no answers; give [navigator] errors, or view"
            " with --answers"
        )

    def _may_differ(self, loaded: LoadedFlight) -> bool:
        """Return whether the estimate can differ from the truth."""
        if loaded.is_live and self.live is not None and self.live.link.truth == "sim_state":
            return True
        return not loaded.config.navigator.is_perfect

    def _record(self, loaded: LoadedFlight, scene: Scene) -> dict[str, Any] | None:
        """Return what the navigator of a replayed flight knows; None if it knows the truth."""
        config, flight = loaded.config, loaded.flight
        if self._navigator is None or self._navigator[0] is not config or self._navigator[1] is not flight:
            draws = self._may_differ(loaded) and (config.navigator.attitude == "model") == (loaded.estimate is None)
            true_flight = loaded.simulator.flight
            navigator = Navigator.of(config, true_flight, estimate=loaded.estimate) if draws else None
            self._navigator = config, flight, navigator
        navigator = self._navigator[2]
        return None if navigator is None else navigator.record(scene.exposure, number=0, file="")

    def _live_record(self, loaded: LoadedFlight, scene: Scene) -> dict[str, Any] | None:
        """Return what the autopilot of a link knows; None if it knows the truth, or its samples do not cover this."""
        config, exposure = loaded.config, scene.exposure
        if self.live is None or not self._may_differ(loaded) or config.navigator.attitude != "model":
            return None
        samples = self.live.with_estimate(loaded.head.last_s - exposure.start_utc_s + BEFORE_EXPOSURE_S)
        if samples is None:
            return None
        flight, estimate = samples
        track = estimate.attitude
        is_covered = track.first_s <= exposure.start_utc_s and exposure.stop_utc_s <= track.last_s + CLOCK_GRAIN_S
        if not is_covered or track.gap_within(exposure.start_utc_s, exposure.stop_utc_s) is not None:
            return None
        if self._live_navigator is None or self._live_navigator[0] is not config:
            self._live_navigator = config, LiveNavigator(config, None)
        shown = config.gimbal.carried(flight)
        return self._live_navigator[1].record(estimate, exposure, number=0, file="", flight=shown)


def _beside(log: OtherLog, C_camera_body: Float, simulator: Simulator, scene: Scene) -> Belief:
    """Return what another log has in the middle of an exposure, as an estimate against the flight shown."""
    mid_s, attitude = scene.exposure.mid_utc_s, log.flight.attitude
    if not attitude.covers(mid_s):
        return Belief(log.name, lacking="nothing at this time")
    q_body_ned, at = attitude.at(np.array([mid_s]))[0], log.flight.position.at(mid_s)
    place_rad = at.latitude_rad, at.longitude_rad
    belief = _against_truth(log.name, q_body_ned, q_body_ned, C_camera_body, simulator, mid_s, place_rad)
    return replace(belief, has_ghost=True)


def _estimate(
    record: dict[str, Any], C_camera_body: Float, simulator: Simulator, scene: Scene, *, has_position: bool
) -> Belief:
    """Return an estimate against the truth in the middle of an exposure; its position only if it can differ."""
    q_platform = np.array(record["q_body_ned"]["middle"])
    q_aircraft = np.array(record["gimbal"]["q_aircraft_ned"]["middle"]) if "gimbal" in record else q_platform
    place, place_rad = record["position"], None
    if has_position and place is not None:
        latitude_rad, longitude_rad = np.deg2rad([place["latitude_deg"], place["longitude_deg"]]).tolist()
        place_rad = latitude_rad, longitude_rad
    mid_s = scene.exposure.mid_utc_s
    return _against_truth("estimate", q_platform, q_aircraft, C_camera_body, simulator, mid_s, place_rad)


def _against_truth(
    name: str,
    q_platform_ned: Float,
    q_aircraft_ned: Float,
    C_camera_body: Float,
    simulator: Simulator,
    utc_s: float,
    place_rad: tuple[float, float] | None,
) -> Belief:
    """Return an estimated attitude and place, latitude and longitude, against the truth at a time, UTC s."""
    roll, pitch, _ = euler_from_quaternion(q_aircraft_ned)
    C_estimated_ned = C_camera_body @ matrix_from_quaternion(q_platform_ned)
    q_body_ned = simulator.flight.attitude.at(np.array([utc_s]))[0]
    C_camera_estimated = simulator.mount.C_camera_body @ matrix_from_quaternion(q_body_ned) @ C_estimated_ned.T
    offset_km = None if place_rad is None else surface_offset_km(simulator.flight.position.at(utc_s), *place_rad)
    return Belief(name, C_camera_estimated, C_estimated_ned, float(roll), float(pitch), offset_km)


def _answered(answer: PlacedAnswer, simulator: Simulator, scene: Scene) -> Belief:
    """Return an answer against the truth of its own time."""
    name, attitude = f"answer {answer.frame}", simulator.flight.attitude
    if not attitude.covers(answer.utc_s):
        return Belief(name, lacking="no truth at its time")
    C_camera_estimated = offset_km = None
    if answer.C_camera_icrs is not None:
        C_camera_eq = simulator.pointing(np.array([answer.utc_s])).C_camera_eq[0]
        C_camera_estimated = C_camera_eq @ scene.stars.C_eq_icrs @ answer.C_camera_icrs.T
    if answer.position_rad is not None:
        offset_km = surface_offset_km(simulator.flight.position.at(answer.utc_s), *answer.position_rad)
    return Belief(name, C_camera_estimated, offset_km=offset_km, ellipse=answer.ellipse)
