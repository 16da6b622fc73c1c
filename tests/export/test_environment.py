"""The environment: frames of a flight in lockstep, deterministic, for solvers and learning."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit

import glstar as gs
from glstar.rotation import quaternion_from_euler, turn_between
from glstar.sky.place.timescale import parse_utc

SMALL = {"camera.width_px": 160, "camera.height_px": 120, "camera.fx_px": 150.0, "camera.fy_px": 150.0}
SETTINGS = SMALL | {
    "exposure.duration_s": 0.1,
    "exposure.interval_s": 0.5,
    "flight.synthetic.path": "orbit",
    "flight.synthetic.gusts": "light",
    "flight.synthetic.turns": 0.05,
    "navigator.drift_sigma_deg": 0.2,
}


def pose(yaw_rad: float = 0.0, latitude_deg: float = -34.93) -> gs.Pose:
    site = gs.Site(np.deg2rad(latitude_deg), np.deg2rad(138.6), 300.0)
    return gs.Pose(quaternion_from_euler(0.0, 0.0, yaw_rad), site)


LEVEL = pose()


@pytest.fixture(scope="module")
def renderer():
    with gs.GLRenderer.headless() as shared:
        yield shared


@pytest.fixture
def environment(renderer):
    with gs.Environment(gs.Config().override(**SETTINGS), renderer=renderer) as environment:
        yield environment


def test_the_same_seed_and_steps_give_the_same_bytes_and_another_seed_does_not(environment):
    runs = []
    for seed in (3, 3, 4):
        first = environment.reset(seed)
        runs.append((first, environment.step(), environment.step(0.25)))

    for one, same, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.frame.pixels, same.frame.pixels)
        assert (one.nav, one.truth) == (same.nav, same.truth)
        assert (one.frame.pixels != other.frame.pixels).any()
        assert one.nav["q_body_ned"] != other.nav["q_body_ned"]
        assert one.truth["q_body_ned"] != other.truth["q_body_ned"]


def test_a_step_moves_the_exposure_by_the_interval_or_the_given_time(environment):
    first, second, third = environment.reset(), environment.step(), environment.step(0.25)

    starts_s = [parse_utc(one.truth["utc_start"]) for one in (first, second, third)]
    np.testing.assert_allclose(np.diff(starts_s), [0.5, 0.25], rtol=0, atol=1e-6)


def test_a_flight_is_over_when_no_step_fits_into_it(environment):
    environment.reset()
    steps = 0
    while not environment.is_over:
        environment.step()
        steps += 1

    # A twentieth of an orbit takes 2 pi 150 / 18 / 20 = 2.618 s: exposures start at 0, 0.5, ... 2.5 s.
    assert steps == 5
    with pytest.raises(gs.TrackRangeError):
        environment.step()


def test_poses_are_reached_at_the_end_of_their_step(renderer):
    config = gs.Config().override(**SMALL, **{"exposure.duration_s": 0.1, "exposure.interval_s": 0.1})
    poses = [pose(0.02 * k, -34.93 + 1e-5 * k) for k in (1, 2, 3)]
    with gs.Environment(config, renderer=renderer) as environment:
        still = environment.reset(pose=LEVEL, utc_s=1710068400.0)
        moved = [environment.step(pose) for pose in poses]

    assert parse_utc(moved[-1].truth["utc_start"]) == pytest.approx(1710068400.2, rel=0, abs=2e-6)
    # The middle of each exposure lies halfway between two poses.
    for k, one in enumerate(moved):
        expected = quaternion_from_euler(0.0, 0.0, 0.02 * (k + 0.5))
        np.testing.assert_allclose(turn_between(one.truth["q_body_ned"], expected), 0, rtol=0, atol=1e-8)
        assert one.truth["site"]["latitude_deg"] == pytest.approx(-34.93 + 1e-5 * (k + 0.5), rel=0, abs=1e-9)
    # A camera at rest has round stars; one that yaws by 0.02 rad has trails of up to 2 px.
    lengths_px = [
        max(np.hypot(*np.subtract(star["end"], star["start"])) for star in one.truth["stars"])
        for one in (still, moved[0])
    ]
    assert lengths_px[0] < 0.01
    assert 1.0 < lengths_px[1] < 3.0


def test_a_rolling_shutter_closes_at_the_pose(renderer):
    keys = {"exposure.duration_s": 0.1, "exposure.interval_s": 0.25, "exposure.readout_s": 0.1}
    with gs.Environment(gs.Config().override(**SMALL, **keys), renderer=renderer) as environment:
        environment.reset(pose=LEVEL, utc_s=1710068400.0)
        turned = environment.step(pose(0.05))

    # The pose is reached at 0.25 s: the first row opens at 0.05 s, and the rate is 0.05 rad in 0.25 s.
    assert parse_utc(turned.truth["utc_start"]) == pytest.approx(1710068400.05, rel=0, abs=2e-6)
    assert turned.nav["readout_s"] == 0.1
    np.testing.assert_allclose(turned.nav["rates_rad_per_s"], [0, 0, 0.2], rtol=0, atol=1e-5)


def test_a_description_and_the_section_of_the_config_fly_the_same(renderer):
    keys = SMALL | {"exposure.duration_s": 0.1, "exposure.interval_s": 0.5}
    with gs.Environment(
        gs.Config().override(**keys), "fly:orbit?gusts=light&turns=0.05&seed=7", renderer=renderer
    ) as described:
        one = described.reset(7)
    config = gs.Config().override(**{key: value for key, value in SETTINGS.items() if "navigator" not in key})
    with gs.Environment(config, renderer=renderer) as written:
        other = written.reset(7)

    np.testing.assert_array_equal(one.frame.pixels, other.frame.pixels)
    assert one.truth == other.truth


def number_of_stars(found: gs.Observation, _: object) -> float:
    return float(len(found.truth["stars"]))


def test_gymnasiums_five_results_have_the_truth_in_info_only(environment):
    adapter = environment.as_gymnasium(lambda found, action: -len(found.truth["stars"]))

    observation, info = adapter.reset(seed=1)
    after, reward, terminated, truncated, info_after = adapter.step(None)

    assert observation.keys() == after.keys() == {"pixels", "nav"}
    assert info.keys() == info_after.keys() == {"truth"}
    assert (reward, terminated, truncated) == (-len(info_after["truth"]["stars"]), False, False)
    # The numbers of the record.
    environment.reset(1)
    record = environment.step().nav
    np.testing.assert_array_equal(after["nav"]["q_body_ned"][1], record["q_body_ned"]["middle"])
    np.testing.assert_array_equal(after["nav"]["up_camera"][2], record["up_camera"]["end"])
    assert after["nav"]["utc_s"][0] == parse_utc(record["utc"]["start"])


@pytest.mark.parametrize(
    ("keys", "first"),
    [
        ({}, None),
        ({"navigator.gps": "known", "sensor.bit_depth": 12}, None),
        ({"sensor.noise": "electrons", "exposure.control": "mean", "exposure.control_min_s": 1e-3}, None),
        ({"flight.synthetic.path": None}, LEVEL),
    ],
)
# Actions are seconds, where Gymnasium recommends numbers from 0 to 1; `gymnasium.make` knows no flight.
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes:UserWarning")
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")
def test_gymnasiums_own_checker_finds_nothing(keys: dict, first: gs.Pose | None, renderer) -> None:
    settings = SETTINGS | {"flight.synthetic.turns": 2.0} | keys
    settings = {key: value for key, value in settings.items() if value is not None}
    if first is not None:
        settings = {key: value for key, value in settings.items() if not key.startswith("flight")}
    with gs.Environment(gs.Config().override(**settings), renderer=renderer) as environment:
        env = environment.as_gymnasium(number_of_stars, pose=first, render_mode="rgb_array")
        check_env(env, skip_render_check=False)

        env.action_space.seed(5)
        env.reset(seed=5)
        observation, *_ = env.step(env.action_space.sample())
        assert observation in env.observation_space
        spaces = env.observation_space["nav"]
        shortest_s = settings.get("exposure.control_min_s", 0.1)
        assert spaces["rates_rad_per_s"].high[0] == pytest.approx(np.pi / shortest_s, rel=1e-6)
        assert all(np.isfinite(each.high).all() for each in spaces.values())
        picture = env.render()
    assert picture.shape == (120, 160, 3)
    assert picture.max() == 255


def test_gymnasiums_wrappers_and_vectors_take_it() -> None:
    settings = gs.Config().override(**SETTINGS)

    def made() -> gymnasium.Env:
        return TimeLimit(gs.Environment(settings).as_gymnasium(number_of_stars), 3)

    with made() as env:
        env.reset(seed=2)
        assert [env.step(None)[3] for _ in range(3)] == [False, False, True]
    vector = SyncVectorEnv([made, made])
    observations, _ = vector.reset(seed=[2, 3])
    assert observations["pixels"].shape == (2, 120, 160)
    observations, rewards, _, _, infos = vector.step(np.full((2, 1), 0.5))
    assert rewards.shape == (2,)
    assert len(infos["truth"]) > 0
    vector.close()


def test_without_a_seed_each_episode_is_another_and_gymnasiums_seed_decides_all_of_them(environment) -> None:
    env = environment.as_gymnasium(number_of_stars)

    runs = []
    for seed in (7, 7, 8):
        env.reset(seed=seed)
        runs.append([env.reset()[1]["truth"]["seed"] for _ in range(3)])

    assert runs[0] == runs[1]
    assert len({*runs[0], *runs[2]}) == 6
    np.testing.assert_array_equal(env.reset(seed=np.int64(3))[0]["pixels"], environment.reset(np.uint8(3)).frame.pixels)


def test_a_step_beyond_the_flight_takes_its_last_exposure(environment) -> None:
    env = environment.as_gymnasium(number_of_stars)
    env.reset(seed=0)

    _, _, terminated, truncated, info = env.step(np.array([5.0]))

    assert (terminated, truncated) == (False, True)
    # A twentieth of an orbit takes 2.618 s at 200 Hz: the last attitude is at 2.615 or 2.62 s.
    late_s = parse_utc(info["truth"]["utc_start"]) - 1710068400.0
    assert late_s == pytest.approx(2.6175 - 0.1, rel=0, abs=3e-3)


@pytest.mark.parametrize("wrong", [-1.0, float("nan"), 1e6, LEVEL])
def test_a_refused_step_changes_nothing(wrong: object, environment) -> None:
    environment.reset(3)
    environment.step()
    expected = environment.step()

    environment.reset(3)
    environment.step()
    with pytest.raises((gs.ConfigError, gs.TrackRangeError)):
        environment.step(wrong)
    after = environment.step()

    assert (after.nav, after.truth) == (expected.nav, expected.truth)
    np.testing.assert_array_equal(after.frame.pixels, expected.frame.pixels)


def test_the_truth_is_left_out_on_request(renderer) -> None:
    settings = gs.Config().override(**SETTINGS)
    with (
        gs.Environment(settings, renderer=renderer) as full,
        gs.Environment(settings, renderer=renderer, truth=False) as bare,
    ):
        one, other = full.reset(4), bare.reset(4)

    np.testing.assert_array_equal(one.frame.pixels, other.frame.pixels)
    assert one.truth["stars"]
    assert other.truth == {}


def test_wrong_steps_are_refused(environment, renderer):
    with pytest.raises(gs.ConfigError, match=r"call reset\(\) first"):
        gs.Environment(renderer=renderer).step()
    with pytest.raises(gs.ConfigError, match="leave one of them out"):
        gs.Environment(gs.Config().override(**SETTINGS), "fly:hover", renderer=renderer)
    environment.reset()
    with pytest.raises(gs.ConfigError, match="more than 0 s, not -1"):
        environment.step(-1.0)
    with pytest.raises(gs.ConfigError, match="give the first pose to reset"):
        environment.step(LEVEL)
    with pytest.raises(gs.ConfigError, match="four finite numbers"):
        environment.reset(pose=gs.Pose([0, 0, 0, 0], LEVEL.site))
    environment.reset(pose=LEVEL)
    with pytest.raises(gs.ConfigError, match="give a Pose"):
        environment.step(0.5)
    with pytest.raises(gs.ConfigError, match="seed must be 0 or more"):
        environment.reset(-1)
