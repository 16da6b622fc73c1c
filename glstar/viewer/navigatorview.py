"""What a navigator believes beside the truth: the estimate of ``[navigator]``, and its answers for frames."""

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from glstar.config import Config
from glstar.export.navrecord import Navigator
from glstar.flight import Flight
from glstar.render.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.geodesy import surface_offset_km
from glstar.viewer.belief import Belief, PlacedAnswer
from glstar.viewer.loadedflight import LoadedFlight

__all__ = ["NavigatorView"]


class NavigatorView:
    """Computes what the navigator believes at the image shown.

    Attributes
    ----------
    answers : sequence of PlacedAnswer
        In the order of their times.
    """

    def __init__(self) -> None:
        self.answers: Sequence[PlacedAnswer] = ()
        self._navigator: tuple[Config, Flight, Navigator | None] | None = None
        self._last: tuple[Scene, Sequence[PlacedAnswer], tuple[Belief, ...]] | None = None

    def beliefs(
        self, loaded: LoadedFlight | None, simulator: Simulator | None, scene: Scene | None
    ) -> tuple[Belief, ...]:
        """Return the estimate, if ``[navigator]`` gives it errors, and the latest answer at the end of an exposure.

        Parameters
        ----------
        loaded : LoadedFlight or None
        simulator : Simulator or None
            That of the scene.
        scene : Scene or None
            Of the image shown.

        Returns
        -------
        tuple of Belief
        """
        if loaded is None or simulator is None or scene is None:
            return ()
        if self._last is not None and self._last[0] is scene and self._last[1] is self.answers:
            return self._last[2]
        found: list[Belief] = []
        if (navigator := self._navigator_of(loaded)) is not None:
            found.append(_estimate(navigator, simulator, scene))
        times_s = [answer.utc_s for answer in self.answers]
        if (number := bisect_right(times_s, scene.exposure.stop_utc_s)) > 0:
            found.append(_answered(self.answers[number - 1], simulator, scene))
        self._last = scene, self.answers, tuple(found)
        return self._last[2]

    def _navigator_of(self, loaded: LoadedFlight) -> Navigator | None:
        """Return the navigator of a replayed flight; None if it knows the truth, or another message is its estimate."""
        config, flight = loaded.config, loaded.flight
        if self._navigator is None or self._navigator[0] is not config or self._navigator[1] is not flight:
            section = config.navigator
            draws = not (loaded.is_live or section.is_perfect) and section.attitude == "model"
            self._navigator = config, flight, Navigator.of(config, loaded.simulator.flight) if draws else None
        return self._navigator[2]


def _estimate(navigator: Navigator, simulator: Simulator, scene: Scene) -> Belief:
    record = navigator.record(scene.exposure, number=0, file="")
    q_platform = np.array(record["q_body_ned"]["middle"])
    q_aircraft = np.array(record["gimbal"]["q_aircraft_ned"]["middle"]) if "gimbal" in record else q_platform
    roll, pitch, _ = euler_from_quaternion(q_aircraft)
    C_estimated_ned = navigator.C_camera_body @ matrix_from_quaternion(q_platform)
    q_body_ned = simulator.flight.attitude.at(np.array([scene.exposure.mid_utc_s]))[0]
    C_camera_estimated = simulator.mount.C_camera_body @ matrix_from_quaternion(q_body_ned) @ C_estimated_ned.T
    return Belief("estimate", C_camera_estimated, C_estimated_ned, float(roll), float(pitch))


def _answered(answer: PlacedAnswer, simulator: Simulator, scene: Scene) -> Belief:
    """Return an answer against the truth of its own time."""
    name, attitude = f"answer {answer.frame}", simulator.flight.attitude
    is_inside = attitude.first_s <= answer.utc_s <= attitude.last_s
    if not is_inside or attitude.gap_within(answer.utc_s, answer.utc_s) is not None:
        return Belief(f"{name} (no truth at its time)")
    C_camera_estimated = offset_km = None
    if answer.C_camera_icrs is not None:
        C_camera_eq = simulator.pointing(np.array([answer.utc_s])).C_camera_eq[0]
        C_camera_estimated = C_camera_eq @ scene.stars.C_eq_icrs @ answer.C_camera_icrs.T
    if answer.position_rad is not None:
        offset_km = surface_offset_km(simulator.flight.position.at(answer.utc_s), *answer.position_rad)
    return Belief(name, C_camera_estimated, offset_km=offset_km, ellipse=answer.ellipse)
