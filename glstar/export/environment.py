"""A flight in one process, step by step: each step takes one frame, what the navigator knows, and the truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite
from os import PathLike
from typing import Any, NamedTuple, Self

import numpy as np
import orjson
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.config.flight import SYNTHETIC
from glstar.errors import ConfigError
from glstar.export.frame import frame_seed
from glstar.export.navigator import Navigator
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.flight.navigator import EstimatedAttitude
from glstar.render.scene.scene import Frame, Renderer
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.place.site import Site
from glstar.system.resources import bundled_flight

# With poses the end of the flight is unknown: the errors of the navigator are drawn for this time, s.
_HORIZON_S = 6 * 3600.0
_START_UTC_S = 1710068400.0


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Where an aircraft is at the end of a step.

    Attributes
    ----------
    q_body_ned : (4,) array_like
        Unit quaternion (w, x, y, z), NED to body.
    site : Site
    """

    q_body_ned: ArrayLike
    site: Site

    @property
    def unit(self) -> Float:
        """The quaternion, normalised, (4,) float64.

        Raises
        ------
        ConfigError
            If it is not four finite numbers, or all of them are 0.
        """
        q = np.asarray(self.q_body_ned, dtype=np.float64)
        length = float(np.linalg.norm(q))
        if q.shape != (4,) or not (isfinite(length) and length > 0):
            raise ConfigError(f"a pose's q_body_ned must be four finite numbers (w, x, y, z), not {self.q_body_ned!r}")
        unit: Float = q / length
        return unit


class Observation(NamedTuple):
    """The result of a step.

    Attributes
    ----------
    frame : Frame
    nav : dict
        What the aircraft knows: a line of ``nav.jsonl``.
    truth : dict
        A line of ``truth.jsonl``; never for the navigator.
    """

    frame: Frame
    nav: dict[str, Any]
    truth: dict[str, Any]


class Environment:
    """Frames of a flight, one for each step; the same seed and steps give the same bytes.

    Parameters
    ----------
    config : Config, optional
        Camera, sensor, sky, ``[exposure]``, ``[navigator]`` and ``[flight.synthetic]``.
    flight : Flight or path-like, optional
        A flight, a log or a description such as ``"fly:orbit"``.  By default ``[flight.synthetic]``, else the bundled
        log.
    renderer : Renderer, optional
        It stays open; by default an own one, which `close` releases.

    Notes
    -----
    `step` with a time takes the next exposure of `flight`.  `step` with a `Pose` follows another simulator in lockstep:
    it moves by ``exposure.interval_s`` to the pose, and the exposure is the last part of the step.
    """

    def __init__(
        self,
        config: Config | None = None,
        flight: Flight | str | PathLike[str] | None = None,
        *,
        renderer: Renderer | None = None,
    ) -> None:
        self._config = Config() if config is None else config
        if flight is not None and self._config.synthetic.path is not None:
            raise ConfigError("describes a flight, and another one is given; leave one of them out", key=SYNTHETIC)
        self._given = flight
        self._own_renderer = renderer is None
        self._renderer = _headless_renderer() if renderer is None else renderer
        self._simulators: dict[str, Simulator] = {}
        self._state: _Flown | _Followed | None = None
        self._seed = self._number = 0

    def reset(self, seed: int = 0, *, pose: Pose | None = None, utc_s: float | None = None) -> Observation:
        """Begin again, and return the first observation.

        Parameters
        ----------
        seed : int
            Of the image noise, the navigator's errors and the gusts of ``[flight.synthetic]``.
        pose : Pose, optional
            To follow poses instead of a flight: the first of them, at rest.
        utc_s : float, optional
            With a pose: when it is reached, UTC seconds since 1970; by default the night of the bundled flight.

        Returns
        -------
        Observation

        Raises
        ------
        ConfigError
            If the seed is negative, or a setting of the flight is impossible.
        """
        if seed < 0:
            raise ConfigError(f"a seed must be 0 or more, not {seed}")
        self._seed, self._number = seed, 0
        seeds = {"navigator.seed": seed} | ({f"{SYNTHETIC}.seed": seed} if self._config.synthetic.path else {})
        config = self._config.override(**seeds)
        if pose is None:
            flight = self._flight(config)
            self._state = _Flown(config, self._simulator(config, flight), flight)
        else:
            start_utc_s = _START_UTC_S if utc_s is None else utc_s
            still = _between(pose, pose, start_utc_s - config.exposure.span_s, start_utc_s)
            self._state = _Followed(config, self._simulator(config, still, key="poses"), pose, start_utc_s)
        return self._observed(self._state.first())

    def step(self, action: Pose | float | None = None) -> Observation:
        """Take the next frame.

        Parameters
        ----------
        action : Pose or float, optional
            The pose at the end of the step, if `reset` got one.  Otherwise the time from the start of the last exposure
            to that of the next, s; by default ``exposure.interval_s``.

        Returns
        -------
        Observation

        Raises
        ------
        ConfigError
            Before `reset`, or if the action is not of the kind of `reset`.
        TrackRangeError
            If the flight has ended: see `is_over`.
        """
        if self._state is None:
            raise ConfigError("the environment has no flight yet; call reset() first")
        return self._observed(self._state.next(action))

    @property
    def is_over(self) -> bool:
        """Whether the flight ends before another step of ``exposure.interval_s``."""
        return self._state is not None and self._state.is_over

    def as_gymnasium(self, reward: Callable[[Observation, Any], float]) -> "GymnasiumAdapter":
        """Return the environment with the methods of ``gymnasium.Env``.

        Parameters
        ----------
        reward : callable
            Returns the reward of an observation and the action that led to it.

        Returns
        -------
        GymnasiumAdapter
        """
        return GymnasiumAdapter(self, reward)

    def close(self) -> None:
        """Release the renderer, unless it was given."""
        if self._own_renderer:
            self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _flight(self, config: Config) -> Flight:
        if isinstance(self._given, Flight):
            return self._given
        return config.open_flight(config.synthetic.description or self._given or bundled_flight())

    def _simulator(self, config: Config, flight: Flight, *, key: str = "flight") -> Simulator:
        """Return a simulator, which keeps the star field of an earlier one of a flight at the same time."""
        simulator = self._simulators.get(key)
        if simulator is None or simulator.flight.attitude.first_s != flight.attitude.first_s:
            self._simulators[key] = config.simulator(flight)
        return self._simulators[key].with_flight(flight)

    def _observed(self, shot: "_Shot") -> Observation:
        scene = shot.simulator.scene(shot.exposure)
        frame = self._renderer.render(scene, seed=frame_seed(self._seed, self._number))
        file = f"frame_{self._number:06d}"
        nav = shot.navigator.record(shot.exposure, number=self._number, file=file)
        truth = orjson.loads(frame_truth(scene, frame, number=self._number, file=file))
        self._number += 1
        return Observation(frame, nav, truth)


class GymnasiumAdapter:
    """An `Environment` with the methods of ``gymnasium.Env``; Gymnasium itself is not needed.

    The observation is what a navigator has: ``{"pixels": ..., "nav": ...}``; the truth is in ``info``.  `reward`:
    returns the reward of an `Observation` and the action that led to it.
    """

    def __init__(self, environment: Environment, reward: Callable[[Observation, Any], float]) -> None:
        self.environment, self._reward = environment, reward

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin again; `options` are the keyword arguments of `Environment.reset`."""
        return _as_gymnasium(self.environment.reset(seed or 0, **(options or {})))

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Take the next frame.

        ``terminated`` is always False: a flight has no goal of its own; ``truncated`` says whether it ends before
        another step.
        """
        observed = self.environment.step(action)
        observation, info = _as_gymnasium(observed)
        return observation, self._reward(observed, action), False, self.environment.is_over, info

    def close(self) -> None:
        """Release the renderer."""
        self.environment.close()


def _as_gymnasium(found: Observation) -> tuple[dict[str, Any], dict[str, Any]]:
    return {"pixels": found.frame.pixels, "nav": found.nav}, {"truth": found.truth}


class _Shot(NamedTuple):
    """One exposure."""

    simulator: Simulator
    exposure: Exposure
    navigator: Navigator


class _Flown:
    """The state of an environment that plays a flight."""

    def __init__(self, config: Config, simulator: Simulator, flight: Flight) -> None:
        self._config, self._simulator, self._track = config, simulator, flight.attitude
        self._navigator = Navigator.of(config, flight)
        self._start_utc_s = flight.attitude.first_s

    def first(self) -> _Shot:
        exposure = self._config.exposure.starting_at(self._start_utc_s)
        return _Shot(self._simulator, exposure, self._navigator)

    def next(self, action: Pose | float | None) -> _Shot:
        if isinstance(action, Pose):
            raise ConfigError("the environment plays a flight; give the first pose to reset() to follow poses")
        step_s = self._config.exposure.interval_s if action is None else float(action)
        if not (isfinite(step_s) and step_s > 0):
            raise ConfigError(f"a step must take more than 0 s, not {step_s:g}")
        self._start_utc_s += step_s
        return self.first()

    @property
    def is_over(self) -> bool:
        exposure = self._config.exposure
        return self._start_utc_s + exposure.interval_s + exposure.span_s > self._track.last_s


class _Followed:
    """The state of an environment that follows poses."""

    def __init__(self, config: Config, simulator: Simulator, pose: Pose, utc_s: float) -> None:
        exposure = config.exposure
        if exposure.span_s > exposure.interval_s:
            raise ConfigError(
                f"is {exposure.duration_s:g} s, longer than a step of exposure.interval_s, {exposure.interval_s:g} s;"
                " an exposure is the end of a step",
                key="exposure.duration_s",
            )
        self._config, self._simulator, self._pose, self._utc_s = config, simulator, pose, utc_s
        self._navigator = Navigator.of(config, simulator.flight, until_utc_s=utc_s + _HORIZON_S)

    def first(self) -> _Shot:
        return self._shot(self._simulator.flight)

    def next(self, action: Pose | float | None) -> _Shot:
        if not isinstance(action, Pose):
            raise ConfigError("the environment follows poses; give a Pose to step()")
        before, self._pose = self._pose, action
        flight = _between(before, action, self._utc_s, self._utc_s + self._config.exposure.interval_s)
        self._utc_s = flight.attitude.last_s
        return self._shot(flight)

    def _shot(self, flight: Flight) -> _Shot:
        duration_s, span_s = self._config.exposure.duration_s, self._config.exposure.span_s
        # The clock of float64 is 0.2 microseconds fine: an exposure never begins before its pose.
        start_utc_s = max(self._utc_s - span_s, flight.attitude.first_s)
        frames = self._config.exposure.frames
        rest_s = span_s - frames * duration_s  # readout and gaps
        duration_s = min(duration_s, (self._utc_s - start_utc_s - rest_s) / frames)
        exposure = self._config.exposure.starting_at(start_utc_s, duration_s)
        estimate = EstimatedAttitude(flight.attitude, self._navigator.attitude.errors)
        position = None if self._navigator.position is None else flight.position
        navigator = replace(self._navigator, attitude=estimate, position=position)
        return _Shot(self._simulator.with_flight(flight), exposure, navigator)

    @property
    def is_over(self) -> bool:
        return False


def _headless_renderer() -> Renderer:
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - loads OpenGL, which an import does not need

    return GLRenderer.headless()


def _between(before: Pose, after: Pose, start_utc_s: float, stop_utc_s: float) -> Flight:
    """Return the flight from one pose to another."""
    utc_s = np.array([start_utc_s, stop_utc_s])
    sites = (before.site, after.site)
    longitude_rad = np.unwrap([site.longitude_rad for site in sites])
    position = PositionTrack(
        utc_s,
        np.array([site.latitude_rad for site in sites]),
        longitude_rad,
        np.array([site.height_m for site in sites]),
    )
    return Flight(AttitudeTrack(utc_s, np.stack([before.unit, after.unit])), position, "poses")
