"""An environment of Gymnasium around `Environment`: spaces, seeds and wrappers as Gymnasium has them."""

from collections.abc import Callable
from operator import index
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.flight import Pose
from glstar.sky.place.site import HEIGHTS_M, Site
from glstar.sky.place.timescale import parse_utc

# Longest time from one exposure to the next that an action may ask for, in intervals of the config.
_LONGEST_INTERVALS = 10.0
# Seeds of episodes that Gymnasium's generator draws.
_SEEDS = 2**31
# The end of the year 9999, in which dates of ISO 8601 end, UTC seconds since 1970.
_LATEST_UTC_S = 253402300800.0

ObservationDict = dict[str, Any]


class Stepped(Protocol):
    """An `Environment`, as far as it is needed here; an observation has ``frame``, ``nav`` and ``truth``."""

    @property
    def config(self) -> Config: ...  # noqa: D102 - as of `Environment`

    @property
    def left_s(self) -> float | None: ...  # noqa: D102 - as of `Environment`

    @property
    def is_over(self) -> bool: ...  # noqa: D102 - as of `Environment`

    def reset(self, seed: int, *, pose: Pose | None = None, utc_s: float | None = None) -> Any: ...  # noqa: D102 - as of `Environment`

    def step(self, action: Pose | float | None) -> Any: ...  # noqa: D102 - as of `Environment`

    def close(self) -> None: ...  # noqa: D102 - as of `Environment`


class FlightEnv(gymnasium.Env[ObservationDict, Any]):
    """The frames of a flight as an environment of Gymnasium.

    The observation is a navigator's: ``pixels`` (height, width), and ``nav``.  ``nav`` has ``utc_s`` (3,),
    ``q_body_ned`` (3, 4) and ``up_camera`` (3, 3) at start, middle and end of the exposure, and ``rates_rad_per_s``
    (3,); zeros where the estimate has a gap.  Where GPS is known, it has ``position`` (latitude and longitude, deg,
    height, m).  The truth is in ``info``.  An action is the time to the next exposure, (1,) s; with a first `pose` it
    is the pose at the end of the step: ``q_body_ned`` (4,), normalised, and ``position`` (3,).
    """

    def __init__(
        self,
        environment: Stepped,
        reward: Callable[[Any, Any], float],
        *,
        pose: Pose | None = None,
        render_mode: str | None = None,
    ) -> None:
        config = environment.config
        interval_s = config.exposure.interval_s
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 1 / interval_s}
        if render_mode not in {None, *self.metadata["render_modes"]}:
            raise ConfigError(f"render_mode is rgb_array or None, not {render_mode!r}")
        self.render_mode = render_mode
        self.environment, self._reward, self._pose = environment, reward, pose
        self._observed: Any = None
        camera = config.camera()
        full_scale_dn = config.exposure.starting_at(0.0).full_scale_dn(config.sensor().saturation_dn)
        # A mean rate over an exposure is that of its shortest turn, of half a revolution at most.
        largest_rate = (1 + 1e-9) * np.pi / _shortest(config).span_s
        pixel_type = np.uint8 if full_scale_dn <= np.iinfo(np.uint8).max else np.uint16
        pixels = spaces.Box(0, np.iinfo(pixel_type).max, (camera.height_px, camera.width_px), pixel_type)
        nav: dict[str, spaces.Space[Any]] = {
            "utc_s": spaces.Box(0.0, _LATEST_UTC_S, (3,), np.float64),
            "q_body_ned": _unit(3, 4),
            "up_camera": _unit(3, 3),
            "rates_rad_per_s": spaces.Box(-largest_rate, largest_rate, (3,), np.float64),
        }
        if config.navigator.gps == "known":
            nav["position"] = _places()
        self.observation_space = spaces.Dict({"pixels": pixels, "nav": spaces.Dict(nav)})
        self.action_space = (
            spaces.Box(interval_s / _LONGEST_INTERVALS, interval_s * _LONGEST_INTERVALS, (1,), np.float64)
            if pose is None
            else spaces.Dict({"q_body_ned": _unit(4), "position": _places()})
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Begin again; without a seed the next episode is drawn from Gymnasium's generator.

        `options` are keyword arguments of `Environment.reset`: another first ``pose``, its ``utc_s``.
        """
        seed = None if seed is None else index(seed)  # NumPy's numbers too
        super().reset(seed=seed)
        episode = int(self.np_random.integers(_SEEDS)) if seed is None else seed
        given = ({} if self._pose is None else {"pose": self._pose}) | (options or {})
        self._observed = self.environment.reset(episode, **given)
        return self._results(self._observed)

    def step(self, action: Any) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Take the next frame; `action` as in `action_space`, a `Pose`, or None for ``exposure.interval_s``.

        ``terminated`` is always False: a flight has no goal of its own; ``truncated`` says whether the flight ends
        before another step.  A step beyond its end takes the last exposure of the flight.
        """
        taken = self._taken(action)
        self._observed = self.environment.step(taken)
        observation, info = self._results(self._observed)
        reward = float(self._reward(self._observed, action))
        return observation, reward, False, self.environment.is_over, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the latest frame, stretched for display, (height, width, 3); None without ``rgb_array``."""
        if self.render_mode is None or self._observed is None:
            return None
        return np.repeat(self._observed.frame.for_display()[..., np.newaxis], 3, axis=2)

    def close(self) -> None:
        """Release the renderer."""
        self.environment.close()

    def _taken(self, action: Any) -> Pose | float | None:
        """Return an action as `Environment.step` takes it."""
        if isinstance(action, dict):
            latitude_deg, longitude_deg, height_m = np.asarray(action["position"], dtype=np.float64).tolist()
            site = Site(float(np.deg2rad(latitude_deg)), float(np.deg2rad(longitude_deg)), height_m)
            return Pose(action["q_body_ned"], site)
        if action is None or isinstance(action, Pose):
            return action
        seconds = float(np.asarray(action, dtype=np.float64).reshape(()))
        left_s = self.environment.left_s
        return seconds if left_s is None or seconds <= 0 else min(seconds, left_s)

    def _results(self, observed: Any) -> tuple[ObservationDict, dict[str, Any]]:
        record = observed.nav
        nav = {"utc_s": np.array([parse_utc(utc) for utc in record["utc"].values()])}
        for name in ("q_body_ned", "up_camera"):
            known = record[name]
            shape = self.observation_space["nav"][name].shape  # type: ignore[index]
            nav[name] = np.zeros(shape) if known is None else np.array(list(known.values()))
        rates = record["rates_rad_per_s"]
        nav["rates_rad_per_s"] = np.zeros(3) if rates is None else np.array(rates)
        if record["position"] is not None:
            nav["position"] = np.array(list(record["position"].values()))
        return {"pixels": observed.frame.pixels, "nav": nav}, {"truth": observed.truth}


def _shortest(config: Config) -> Exposure:
    """Return the shortest exposure that a config allows."""
    exposure = config.exposure.starting_at(0.0)
    is_fixed = config.exposure.control == "none"
    return exposure if is_fixed else exposure.shortened(min(config.exposure.control_min_s, exposure.duration_s))


def _unit(*shape: int) -> spaces.Box:
    """Return the space of components of unit vectors and quaternions, with room for their rounding."""
    return spaces.Box(-1.0 - 1e-9, 1.0 + 1e-9, shape, np.float64)


def _places() -> spaces.Box:
    """Return the space of latitude and longitude, deg, and height, m."""
    return spaces.Box(np.array([-90.0, -180.0, HEIGHTS_M[0]]), np.array([90.0, 180.0, HEIGHTS_M[1]]), dtype=np.float64)
