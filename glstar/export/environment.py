"""A flight in one process, step by step: each step takes one frame, what the navigator knows, and the truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite
from operator import index
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import orjson

from glstar.camera.exposure import ControlledExposure
from glstar.config import Config
from glstar.config.flight import SYNTHETIC
from glstar.errors import ConfigError
from glstar.export.frame import frame_seed
from glstar.export.navigator import Navigator
from glstar.export.plan.frames import Shot, level_of
from glstar.flight import AttitudeTrack, Flight, Pose, PositionTrack
from glstar.flight.navigator import EstimatedAttitude
from glstar.render.scene.scene import Frame, Renderer
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.system.installation import install_command
from glstar.system.resources import bundled_flight

if TYPE_CHECKING:
    import gymnasium

# With poses the end of the flight is unknown: the errors of the navigator are drawn for this time, s.
_HORIZON_S = 6 * 3600.0
_START_UTC_S = 1710068400.0


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
    truth : bool, default True
        Whether to compute the truth, which takes about as long as drawing the frame; otherwise it is empty.

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
        truth: bool = True,
    ) -> None:
        self._config = Config() if config is None else config
        if flight is not None and self._config.synthetic.path is not None:
            raise ConfigError("describes a flight, and another one is given; leave one of them out", key=SYNTHETIC)
        self._given = flight
        self._own_renderer = renderer is None
        self._renderer = _headless_renderer() if renderer is None else renderer
        self._has_truth = truth
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
        seed = index(seed)  # NumPy's numbers too
        if seed < 0:
            raise ConfigError(f"a seed must be 0 or more, not {seed}")
        seeds = {"navigator.seed": seed} | ({f"{SYNTHETIC}.seed": seed} if self._config.synthetic.path else {})
        config = self._config.override(**seeds)
        if pose is None:
            flight = self._flight(config)
            state: _Flown | _Followed = _Flown.begun(config, self._simulator(config, flight), flight)
        else:
            start_utc_s = _START_UTC_S if utc_s is None else utc_s
            still = _between(pose, pose, start_utc_s - config.exposure.span_s, start_utc_s)
            state = _Followed.begun(config, self._simulator(config, still, key="poses"), pose, start_utc_s)
        return self._observed(state, seed, 0)

    def step(self, action: Pose | float | None = None) -> Observation:
        """Take the next frame.

        Parameters
        ----------
        action : Pose or float, optional
            The pose at the end of the step, if `reset` got one.  Otherwise the time from the start of the last exposure
            to the start of the next, s; by default ``exposure.interval_s``.

        Returns
        -------
        Observation

        Raises
        ------
        ConfigError
            Before `reset`, or if the action is not of the kind of `reset`.
        TrackRangeError
            If the flight has ended: see `is_over`.  A step that raises changes nothing.
        """
        if self._state is None:
            raise ConfigError("the environment has no flight yet; call reset() first")
        return self._observed(self._state.after(action), self._seed, self._number)

    @property
    def is_over(self) -> bool:
        """Whether the flight ends before another step of ``exposure.interval_s``."""
        return self._state is not None and self._state.is_over

    @property
    def left_s(self) -> float | None:
        """The longest step that the flight still has room for, s; None of poses, and before `reset`."""
        return None if self._state is None else self._state.left_s

    @property
    def config(self) -> Config:
        """The settings, before the seeds of an episode."""
        return self._config

    def as_gymnasium(
        self,
        reward: Callable[[Observation, Any], float],
        *,
        pose: Pose | None = None,
        render_mode: str | None = None,
    ) -> "gymnasium.Env[dict[str, Any], Any]":
        """Return the environment as one of Gymnasium, with spaces, for its wrappers and vectors.

        Parameters
        ----------
        reward : callable
            Returns the reward of an `Observation` and the action that led to it.
        pose : Pose, optional
            To follow poses instead of a flight: the first of each episode.
        render_mode : {"rgb_array"}, optional
            What ``render()`` returns.

        Returns
        -------
        gymnasium.Env
            A `glstar.export.gymnasium.FlightEnv`, which describes its observations and actions.

        Raises
        ------
        ConfigError
            If Gymnasium is not installed.
        """
        try:
            from glstar.export.gymnasium import FlightEnv  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ConfigError(f"as_gymnasium needs Gymnasium: {install_command('gym')}") from error
        return FlightEnv(self, reward, pose=pose, render_mode=render_mode)

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

    def _observed(self, state: "_Flown | _Followed", seed: int, number: int) -> Observation:
        """Return what a state shows, and keep the state."""
        shot, navigator = state.shot()
        composed = shot.composed(number)
        frame = self._renderer.render(composed.scene, seed=frame_seed(seed, number))
        file = f"frame_{number:06d}"
        nav = navigator.record(shot.exposure, number=number, file=file, gain=shot.gain)
        truth = {}
        if self._has_truth:
            truth = orjson.loads(frame_truth(composed.scene, frame, number=number, file=file, about=shot.about))
        if state.control is not None:
            level = level_of(state.control.control, shot.exposure, shot.simulator.sensor, frame.pixels)
            state = replace(state, control=state.control.after(level))
        self._state, self._seed, self._number = state, seed, number + 1
        return Observation(frame, nav, truth)


def _control_of(config: Config, simulator: Simulator) -> ControlledExposure | None:
    """Return the exposure control before the first frame; None without."""
    shot = Shot(simulator, config.exposure.starting_at(0.0), control=config.exposure.exposure_control)
    return None if shot.control is None else ControlledExposure.begun(shot.control, shot.sensor_gain)


def _set(shot: Shot, control: ControlledExposure | None) -> Shot:
    """Return a shot with the exposure time and gain of the control."""
    return shot if control is None else shot.set_to(*control.settings)


@dataclass(frozen=True, slots=True, eq=False)
class _Flown:
    """The state of an environment that plays a flight."""

    config: Config
    simulator: Simulator
    navigator: Navigator
    start_utc_s: float  # Of the exposure, UTC seconds since 1970
    control: ControlledExposure | None

    @classmethod
    def begun(cls, config: Config, simulator: Simulator, flight: Flight) -> Self:
        navigator, control = Navigator.of(config, flight), _control_of(config, simulator)
        return cls(config, simulator, navigator, flight.attitude.first_s, control)

    def shot(self) -> tuple[Shot, Navigator]:
        shot = Shot(self.simulator, self.config.exposure.starting_at(self.start_utc_s))
        return _set(shot, self.control), self.navigator

    def after(self, action: Pose | float | None) -> Self:
        """Return the state after a step."""
        if isinstance(action, Pose):
            raise ConfigError("the environment plays a flight; give the first pose to reset() to follow poses")
        step_s = self.config.exposure.interval_s if action is None else float(action)
        if not (isfinite(step_s) and step_s > 0):
            raise ConfigError(f"a step must take more than 0 s, not {step_s:g}")
        return replace(self, start_utc_s=self.start_utc_s + step_s)

    @property
    def left_s(self) -> float:
        return self.simulator.flight.attitude.last_s - self.config.exposure.span_s - self.start_utc_s

    @property
    def is_over(self) -> bool:
        return self.config.exposure.interval_s > self.left_s


@dataclass(frozen=True, slots=True, eq=False)
class _Followed:
    """The state of an environment that follows poses."""

    config: Config
    simulator: Simulator
    navigator: Navigator
    flight: Flight  # From the previous pose to the present one
    pose: Pose
    control: ControlledExposure | None
    left_s: None = None

    @classmethod
    def begun(cls, config: Config, simulator: Simulator, pose: Pose, utc_s: float) -> Self:
        exposure = config.exposure
        if exposure.span_s > exposure.interval_s:
            raise ConfigError(
                f"is {exposure.duration_s:g} s, longer than a step of exposure.interval_s, {exposure.interval_s:g} s;"
                " an exposure is the end of a step",
                key="exposure.duration_s",
            )
        navigator = Navigator.of(config, simulator.flight, until_utc_s=utc_s + _HORIZON_S)
        return cls(config, simulator, navigator, simulator.flight, pose, _control_of(config, simulator))

    def after(self, action: Pose | float | None) -> Self:
        """Return the state after a step."""
        if not isinstance(action, Pose):
            raise ConfigError("the environment follows poses; give a Pose to step()")
        utc_s = self.flight.attitude.last_s
        flight = _between(self.pose, action, utc_s, utc_s + self.config.exposure.interval_s)
        return replace(self, flight=flight, pose=action)

    def shot(self) -> tuple[Shot, Navigator]:
        flight, utc_s = self.flight, self.flight.attitude.last_s
        shot = _set(Shot(self.simulator.with_flight(flight), self.config.exposure.starting_at(0.0)), self.control)
        duration_s, span_s = shot.exposure.duration_s, shot.exposure.span_s
        # The clock of float64 is 0.2 microseconds fine: an exposure never begins before its pose.
        start_utc_s = max(utc_s - span_s, flight.attitude.first_s)
        frames = shot.exposure.frames
        rest_s = span_s - frames * duration_s  # readout and gaps
        duration_s = min(duration_s, (utc_s - start_utc_s - rest_s) / frames)
        exposure = replace(shot.exposure, start_utc_s=start_utc_s, duration_s=duration_s)
        estimate = EstimatedAttitude(flight.attitude, self.navigator.attitude.errors)
        position = None if self.navigator.position is None else flight.position
        navigator = replace(self.navigator, attitude=estimate, position=position)
        return replace(shot, exposure=exposure), navigator

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
