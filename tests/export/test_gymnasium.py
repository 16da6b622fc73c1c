"""Spaces, actions and observations of the environment of Gymnasium, around one made by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import glstar as gs
from glstar.errors import ConfigError
from glstar.export.gymnasium import FlightEnv

UTC = {"start": "2024-03-10T11:00:01.000000Z", "middle": "2024-03-10T11:00:01.250000Z"}
UTC |= {"end": "2024-03-10T11:00:01.500000Z"}
START_S = 1710068401.0
POSITION = {"latitude_deg": -34.5, "longitude_deg": 138.25, "height_m": 312.5}
QUATERNIONS = {"start": [0.1, 0.2, 0.3, 0.4], "middle": [0.5, 0.6, 0.7, 0.8], "end": [-0.1, -0.2, -0.3, -0.4]}
SETTINGS = {
    "camera.width_px": 37,
    "camera.height_px": 23,
    "camera.fx_px": 40.0,
    "camera.fy_px": 41.0,
    "exposure.duration_s": 0.2,
    "exposure.interval_s": 0.8,
    "exposure.readout_s": 0.05,
}


class Stepped:
    """An environment that records its calls."""

    def __init__(self, **settings: Any) -> None:
        self.config = gs.Config().override(**(SETTINGS | settings))
        self.left_s: float | None = None
        self.is_over, self.calls = False, list[Any]()
        self.nav: dict[str, Any] = {
            "utc": UTC,
            "q_body_ned": QUATERNIONS,
            "up_camera": {name: q[1:] for name, q in QUATERNIONS.items()},
            "rates_rad_per_s": [0.5, -0.25, 2.0],
            "position": None,
        }

    def _observed(self) -> SimpleNamespace:
        shown = np.arange(6, dtype=np.uint8).reshape(2, 3)
        frame = SimpleNamespace(pixels=np.array([[len(self.calls)]]), for_display=lambda: shown)
        return SimpleNamespace(frame=frame, nav=self.nav, truth={"calls": len(self.calls)})

    def reset(self, seed: int, **options: Any) -> SimpleNamespace:
        self.calls.append((seed, options))
        return self._observed()

    def step(self, action: Any) -> SimpleNamespace:
        self.calls.append(action)
        return self._observed()

    def close(self) -> None:
        self.calls.append("closed")


def box(space: spaces.Space[Any]) -> tuple[Any, ...]:
    assert isinstance(space, spaces.Box)
    return space.low.tolist(), space.high.tolist(), space.shape, space.dtype


@pytest.mark.parametrize(
    ("settings", "shortest_s"),
    [
        ({}, 0.25),
        (
            {
                "exposure.control": "mean",
                "exposure.control_min_s": 0.03,
                "sensor.noise": "electrons",
                "sensor.bit_depth": 8,
                "sensor.black_level_dn": 9.0,
            },
            0.08,
        ),
    ],
)
def test_spaces_hold_pixels_times_unit_vectors_rates_and_steps(settings: dict[str, Any], shortest_s: float) -> None:
    env = FlightEnv(Stepped(**settings), lambda *_: 0.0)

    pixels, nav = env.observation_space["pixels"], env.observation_space["nav"]
    assert isinstance(nav, spaces.Dict)
    assert (pixels.shape, pixels.dtype, pixels.low.min(), pixels.high.max()) == ((23, 37), np.uint8, 0, 255)
    assert list(nav) == ["q_body_ned", "rates_rad_per_s", "up_camera", "utc_s"]
    # 9999-12-31T24:00:00Z, by date(1).
    assert box(nav["utc_s"]) == ([0.0] * 3, [253402300800.0] * 3, (3,), np.float64)
    for name, shape in (("q_body_ned", (3, 4)), ("up_camera", (3, 3))):
        np.testing.assert_array_equal(nav[name].low, np.full(shape, -1.000000001))
        np.testing.assert_array_equal(nav[name].high, np.full(shape, 1.000000001))
    assert nav["rates_rad_per_s"].high == pytest.approx([np.pi / shortest_s] * 3, rel=1.1e-9)
    assert nav["rates_rad_per_s"].high[0] > np.pi / shortest_s  # with room for its rounding
    np.testing.assert_array_equal(nav["rates_rad_per_s"].low, -nav["rates_rad_per_s"].high)
    assert box(env.action_space) == (pytest.approx([0.08]), [8.0], (1,), np.float64)
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 1.25}


def test_spaces_have_places_where_gps_is_known_or_poses_are_actions() -> None:
    pose = gs.Pose(np.array([1.0, 0, 0, 0]), gs.Site(0.1, 0.2, 30.0))
    env = FlightEnv(Stepped(**{"navigator.gps": "known", "sensor.bit_depth": 12}), lambda *_: 0.0, pose=pose)

    places = ([-90.0, -180.0, -1000.0], [90.0, 180.0, 100_000.0], (3,), np.float64)
    assert box(env.observation_space["nav"]["position"]) == places
    assert isinstance(env.action_space, spaces.Dict)
    assert box(env.action_space["position"]) == places
    assert box(env.action_space["q_body_ned"]) == ([-1.000000001] * 4, [1.000000001] * 4, (4,), np.float64)
    pixels = env.observation_space["pixels"]
    assert (pixels.dtype, pixels.high.max()) == (np.uint16, 65535)


def test_a_reset_has_the_seed_the_first_pose_and_the_options() -> None:
    first, other = (gs.Pose(np.array([1.0, 0, 0, 0]), gs.Site(0.1, 0.2, height_m)) for height_m in (30.0, 40.0))
    plain, posed = Stepped(), Stepped()
    FlightEnv(plain, lambda *_: 0.0).reset(seed=7, options={"utc_s": START_S})
    env = FlightEnv(posed, lambda *_: 0.0, pose=first)
    env.reset(seed=8)
    env.reset(seed=9, options={"pose": other})
    env.reset()

    assert plain.calls == [(7, {"utc_s": START_S})]
    assert posed.calls[:2] == [(8, {"pose": first}), (9, {"pose": other})]
    # Gymnasium's generator of the seed 9.
    drawn = int(np.random.default_rng(9).integers(2**31))
    assert posed.calls[2] == (drawn, {"pose": first})


def test_a_step_gives_the_record_as_arrays_and_the_truth_in_info() -> None:
    stepped = Stepped()
    rewarded: list[Any] = []
    env = FlightEnv(stepped, lambda observed, action: rewarded.append((observed.truth, action)) or 2.5)

    env.reset(seed=1)
    observation, reward, terminated, truncated, info = env.step([1.5])

    nav = observation["nav"]
    assert list(nav) == ["utc_s", "q_body_ned", "up_camera", "rates_rad_per_s"]
    np.testing.assert_array_equal(nav["utc_s"], [START_S, START_S + 0.25, START_S + 0.5])
    np.testing.assert_array_equal(nav["q_body_ned"], list(QUATERNIONS.values()))
    np.testing.assert_array_equal(nav["up_camera"], [q[1:] for q in QUATERNIONS.values()])
    np.testing.assert_array_equal(nav["rates_rad_per_s"], [0.5, -0.25, 2.0])
    assert observation["pixels"].tolist() == [[2]]
    assert (reward, terminated, truncated, info) == (2.5, False, False, {"truth": {"calls": 2}})
    assert rewarded == [({"calls": 2}, [1.5])]
    stepped.is_over = True
    assert env.step(None)[3] is True
    env.close()
    assert stepped.calls == [(1, {}), 1.5, None, "closed"]


def test_gaps_are_zeros_and_a_known_place_is_an_array() -> None:
    stepped = Stepped(**{"navigator.gps": "known"})
    stepped.nav |= {"q_body_ned": None, "up_camera": None, "rates_rad_per_s": None, "position": POSITION}

    observation, _ = FlightEnv(stepped, lambda *_: 0.0).reset(seed=1)

    nav = observation["nav"]
    for name, shape in (("q_body_ned", (3, 4)), ("up_camera", (3, 3)), ("rates_rad_per_s", (3,))):
        np.testing.assert_array_equal(nav[name], np.zeros(shape), strict=True)
    np.testing.assert_array_equal(nav["position"], [-34.5, 138.25, 312.5])


@pytest.mark.parametrize(
    ("left_s", "seconds", "taken_s"),
    [(None, 1.5, 1.5), (2.0, 1.5, 1.5), (1.25, 1.5, 1.25), (1.25, -0.5, -0.5), (-0.25, 0.0, 0.0), (None, -0.5, -0.5)],
)
def test_a_step_of_seconds_ends_with_the_flight(left_s: float | None, seconds: float, taken_s: float) -> None:
    stepped = Stepped()
    stepped.left_s = left_s

    FlightEnv(stepped, lambda *_: 0.0).step(np.array([seconds]))

    assert stepped.calls == [taken_s]


def test_a_step_to_a_place_is_a_pose() -> None:
    stepped = Stepped()
    env = FlightEnv(stepped, lambda *_: 0.0)
    pose = gs.Pose(np.array([1.0, 0, 0, 0]), gs.Site(0.1, 0.2, 30.0))

    env.step(pose)
    env.step({"q_body_ned": np.array([0.0, 0.6, 0.8, 0.0]), "position": np.array([-34.5, 138.25, 312.5])})

    assert stepped.calls[0] is pose
    taken = stepped.calls[1]
    np.testing.assert_allclose(taken.q_body_ned, [0.0, 0.6, 0.8, 0.0], rtol=0, atol=1e-12)
    site = (taken.site.latitude_rad, taken.site.longitude_rad, taken.site.height_m)
    assert site == pytest.approx((-34.5 * np.pi / 180, 138.25 * np.pi / 180, 312.5))


def test_a_picture_needs_its_mode_and_a_frame() -> None:
    env = FlightEnv(Stepped(), lambda *_: 0.0, render_mode="rgb_array")
    blind = FlightEnv(Stepped(), lambda *_: 0.0)

    assert env.render() is None
    env.reset(seed=1)
    blind.reset(seed=1)
    np.testing.assert_array_equal(env.render(), [[[k] * 3 for k in row] for row in ((0, 1, 2), (3, 4, 5))])
    assert blind.render() is None
    with pytest.raises(ConfigError, match="render_mode is rgb_array or None, not 'human'"):
        FlightEnv(Stepped(), lambda *_: 0.0, render_mode="human")
