"""``[sweep]``: what varies over a data set."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from glstar.config import Config
from glstar.config.sweep import Axis, Sweep
from glstar.errors import ConfigError
from glstar.export.plan.dataset import DataSetFrames
from glstar.export.plan.frames import plan_frames
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.sky.place.site import Site
from glstar.system.resources import asset


def config_of(tmp_path, text):
    path = tmp_path / "sweep.toml"
    path.write_text(text, encoding="utf-8")
    return Config.load(path)


def samples_of(config):
    return [config.sweep.sample(number) for number in range(len(config.sweep))]


def test_a_config_without_a_sweep_has_one_sample_that_changes_nothing():
    sweep = Config().sweep

    assert not sweep
    assert (len(sweep), sweep.sample(0)) == (1, {})


def test_lists_give_every_combination_once(tmp_path):
    config = config_of(tmp_path, "[sweep]\nexposure.duration_s = [0.25, 0.5, 1]\nmount.yaw_deg = [-90, 90]\n")

    found = [(sample["exposure.duration_s"], sample["mount.yaw_deg"]) for sample in samples_of(config)]

    assert found == list(product([0.25, 0.5, 1], [-90, 90]))


RANGES = """
[sweep]
draws = {draws}
seed = {seed}
start_s = {{ min = 5, max = 9 }}
sky.vmag_limit = [4, 5]
sensor.sky_std_dn = {{ min = 0.1, max = 10, log = true }}
sensor.bit_depth = {{ min = 8, max = 10 }}
flight.utc_start = {{ min = 2024-01-01T00:00:00Z, max = "2024-01-02T00:00:00Z" }}
"""


def test_random_values_are_distributed_uniformly_in_their_range(tmp_path):
    samples = samples_of(config_of(tmp_path, RANGES.format(draws=500, seed=1)))

    assert len(samples) == 2 * 500
    start_s = np.array([sample["start_s"] for sample in samples])
    assert ((start_s >= 5) & (start_s <= 9)).all()
    assert abs(start_s.mean() - 7) < 4 * 4 / np.sqrt(12 * 1000)  # four sigma
    decades = np.log10([sample["sensor.sky_std_dn"] for sample in samples])
    assert abs(decades.mean()) < 4 * 2 / np.sqrt(12 * 1000)
    assert {sample["sensor.bit_depth"] for sample in samples} == {8, 9, 10}
    assert all("2024-01-01" <= sample["flight.utc_start"] < "2024-01-02T00:00:01" for sample in samples)


def test_the_sine_of_an_angle_is_uniform_between_its_bounds(tmp_path):
    latitudes = "flight.latitude_deg = { min = -30, max = 90, sine = true }\nflight.longitude_deg = [0]"
    config = config_of(tmp_path, f"[sweep]\ndraws = 4000\n{latitudes}\n")

    sines = np.sin(np.deg2rad(config.sweep.column("flight.latitude_deg")))

    # From -0.5 to 1: mean 0.25, and a quarter of the draws below -0.125 (7.2 deg south); 4 standard errors of 4000.
    assert -0.5 <= sines.min() < -0.49
    assert 0.99 < sines.max() <= 1
    assert np.mean(sines) == pytest.approx(0.25, rel=0, abs=4 * 1.5 / np.sqrt(12 * 4000))
    assert np.mean(sines < -0.125) == pytest.approx(0.25, rel=0, abs=4 * np.sqrt(0.25 * 0.75 / 4000))
    assert config.sweep.as_json()["varies"]["flight.latitude_deg"]["sine"] is True


def test_a_range_may_have_all_of_its_keys(tmp_path):
    every = "min = -30, max = 90, log = false, sine = true"
    config, short = (
        config_of(tmp_path, f"[sweep]\ndraws = 5\nflight.longitude_deg = [0]\nflight.latitude_deg = {{ {keys} }}\n")
        for keys in (every, "min = -30, max = 90, sine = true")
    )
    assert samples_of(config) == samples_of(short)


@pytest.mark.parametrize(
    "text",
    [
        "flight.latitude_deg = { min = -30, max = 91, sine = true }",
        "exposure.duration_s = { min = 0.1, max = 1, sine = true }",
        "flight.synthetic.heading_deg = { min = 0, max = 360, sine = true }",
        "mount.roll_deg = { min = 1, max = 20, sine = true, log = true }",
    ],
)
def test_a_sine_is_of_an_angle_within_a_quarter_turn(text, tmp_path):
    with pytest.raises(ConfigError, match=r"sine = true needs an angle|exclude each other"):
        config_of(tmp_path, f"[sweep]\n{text}\n")


def test_a_draw_depends_on_the_seed_and_its_index_only(tmp_path):
    few, many, other = (
        config_of(tmp_path, RANGES.format(draws=draws, seed=seed)).sweep for draws, seed in ((3, 1), (7, 1), (3, 2))
    )

    assert [few.sample(k) for k in range(3)] == [many.sample(k) for k in range(3)]
    assert few.sample(3) == many.sample(7)  # the first of the second combination
    assert few.sample(0) != other.sample(0)
    assert few.sample(0) != few.sample(0, salt=1)


def test_a_sample_becomes_a_config(tmp_path):
    config = config_of(
        tmp_path, "[sweep]\nexposure.duration_s = [0.25]\nflight.latitude_deg = [52]\nflight.longitude_deg = [13]\n"
    )

    chosen = config.at(config.sweep.sample(0))

    assert chosen.exposure.duration_s == 0.25
    assert chosen.flight.site is not None
    assert not chosen.sweep


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("exposure.duration = [1]", "sweep.exposure.duration: cannot vary (did you mean exposure.duration_s?)"),
        ("exposure.duration_s = []", "sweep.exposure.duration_s: must be a list, such as [1, 2], or a range"),
        ("exposure.duration_s = 3", "must be a list, such as [1, 2], or a range"),
        ("exposure.duration_s = { min = 2, max = 1 }", "max must be at least min"),
        ("exposure.duration_s = { min = 0, max = 1, log = true }", "positive numbers"),
        ("exposure.duration_s = { min = 1, max = 2, step = 1 }", "or a range"),
        ("mount.reading = { min = 0, max = 1 }", "is not a number and takes no range"),
        ("exposure.duration_s = [1, -1]", "[sweep] goes to where exposure.duration_s: must be a positive number"),
        ("sky.dut1_s = { min = -2, max = 0 }", "[sweep] goes to where sky.dut1_s"),
        ("flight.latitude_deg = [52]", "flight.longitude_deg: is missing from a place"),
        ('flight.attitude = ["ATT", "XKQ"]', "sweep.flight.attitude: cannot vary"),
        ("draws = 0", "sweep.draws: must be a whole number, 1 or more"),
        ("exposures = [1]", "sweep.exposures: cannot vary"),
    ],
)
def test_invalid_axes_are_reported_by_key(text, message, tmp_path):
    with pytest.raises(ConfigError) as caught:
        config_of(tmp_path, f"[sweep]\n{text}\n")

    assert message in str(caught.value)


def test_the_sweep_of_the_example_is_valid(tmp_path):
    page = asset("glstar.toml").read_text(encoding="utf-8")
    shown = page[page.index("# [sweep]") :]

    config = config_of(tmp_path, "\n".join(line.removeprefix("# ") for line in shown.splitlines()))

    assert len(config.sweep) > 1


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("draws = 1000000000\n", "sweep: has 1,000,000,000 samples; the limit is 10,000,000"),
        (f"draws = {10**14}\n", "has 100,000,000,000,000 samples"),
        (f"draws = {10**40}\n", "has too many samples"),
        (
            f"draws = 500\nmount.yaw_deg = {list(range(300))}\nmount.pitch_deg = {list(range(300))}\n",
            "has 45,000,000 samples",
        ),
        ('start_s = [1, "two"]\n', 'sweep.start_s: must be numbers of seconds, not "two"'),
    ],
)
def test_a_sweep_of_more_samples_than_can_be_planned_is_refused_at_once(text, words, tmp_path):
    with pytest.raises(ConfigError, match=words):
        config_of(tmp_path, f"[sweep]\nsky.vmag_limit = {{ min = 2, max = 4 }}\n{text}")


def test_paths_in_a_sweep_are_relative_to_the_config(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    camera = "[camera]\nwidth_px = {}\nheight_px = 10\nfx_px = 9\nfy_px = 9\n"
    for width_px in (20, 30):
        (tmp_path / f"{width_px}.toml").write_text(camera.format(width_px), encoding="utf-8")
    (tmp_path / "sensor.toml").write_text("[sensor]\nsky_std_dn = 1.0\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path / "elsewhere")

    config = config_of(tmp_path, '[sensor]\nfile = "sensor.toml"\n[sweep]\ncamera.file = ["20.toml", "30.toml"]\n')

    assert [config.at(sample).camera().width_px for sample in samples_of(config)] == [20, 30]
    assert [path.name for path in config.files] == ["20.toml", "30.toml", "sensor.toml"]
    assert {path.parent for path in config.files} == {tmp_path}


def frames_of(config, **settings):
    """The frames of a flight of ten seconds with two silences under a config, noise and stars aside."""
    still = np.tile([1.0, 0.0, 0.0, 0.0], (101, 1))
    utc_s = 1.7e9 + np.arange(101) / 10
    gaps = (Gap(utc_s[30], utc_s[40], "a data gap"), Gap(utc_s[80], utc_s[83], "a reset"))
    flight = Flight(
        name="flight", attitude=AttitudeTrack(utc_s, still, gaps=gaps), position=PositionTrack.fixed(Site(0.1, 0.2))
    )
    return DataSetFrames(config, (flight, flight), {}, "png", **settings)


@pytest.mark.slow
@pytest.mark.timeout(30)
def test_a_data_set_of_millions_of_frames_is_planned_or_refused_at_once(tmp_path):
    config = config_of(tmp_path, "[sweep]\ndraws = 2000000\nstart_s = { min = 0, max = 1 }\n")

    assert len(frames_of(config, frames=1).numbers) == 4_000_000
    with pytest.raises(ConfigError, match="2,000,000 samples of flight, of 3 to 4 frames each, make "):
        frames_of(config).numbers  # noqa: B018
    many = config_of(tmp_path, "[sweep]\ndraws = 6000000\nstart_s = { min = 0, max = 1 }\n")
    with pytest.raises(ConfigError, match="2 flights under 6,000,000 samples each are 12,000,000 samples"):
        frames_of(many, frames=1).numbers  # noqa: B018


def test_a_data_set_has_the_frames_of_each_sample_and_skips_those_across_gaps(tmp_path):
    text = "[sweep]\ndraws = 3\nstart_s = { min = 0, max = 4 }\nexposure.duration_s = [0.2, 0.5]\n"
    config = config_of(tmp_path, text + "exposure.interval_s = [0.3, 0.7]\n")
    frames = frames_of(config, stop_s=9.5, frames=20)
    left_out, first = [], 0
    for which in range(frames.samples):
        flight, sample = divmod(which, len(config.sweep))
        settings = config.sweep.sample(sample, salt=flight)
        start_s = settings["start_s"]
        exposure = config.at(settings).exposure
        plan = plan_frames(frames.flights[flight], exposure, start_s=start_s, stop_s=9.5, frames=20)
        left_out += [replace(frame, number=frame.number + first) for frame in plan.skipped]
        first += len(plan.frames) + len(plan.skipped)

    assert list(frames.skipped) == left_out
    assert len(left_out) > 20
    assert frames.numbers.tolist() == sorted(set(range(first)) - {frame.number for frame in left_out})


def test_the_extremes_have_every_value_of_a_list_and_both_bounds_of_a_range():
    sweep = Sweep(
        (Axis("a", values=(3, 1, 2)), Axis("b", least=-1.5, most=2.5), Axis("c", least=2, most=4, kind="int"))
    )

    first = {"a": 3, "b": -1.5, "c": 2}
    changed = ({"a": 3}, {"a": 1}, {"a": 2}, {"b": -1.5}, {"b": 2.5}, {"c": 2}, {"c": 4})
    assert list(sweep.extremes()) == [first | one for one in changed]
    assert list(Sweep((Axis("t", least=86400, most=90000, kind="utc"),)).extremes()) == [
        {"t": "1970-01-02T00:00:00.000000Z"}, {"t": "1970-01-02T01:00:00.000000Z"},
    ]  # fmt: skip


def test_random_numbers_become_values_of_each_kind():
    chance = np.array([0.0, 0.25, 0.5, 0.9999999])

    assert Axis("k", least=3, most=6, kind="int").drawn(chance) == [3, 4, 5, 6]
    np.testing.assert_allclose(Axis("k", least=-2, most=6).drawn(chance), [-2, 0, 2, 6], rtol=0, atol=1e-5)
    np.testing.assert_allclose(Axis("k", least=0.01, most=100, log=True).drawn(chance), [0.01, 0.1, 1, 100], rtol=1e-5)
    np.testing.assert_allclose(
        Axis("k", least=-90, most=90, sine=True).drawn(chance), [-90, -30, 0, 90], rtol=0, atol=0.06
    )
    times = Axis("k", least=86400, most=90000, kind="utc").drawn(chance[:3])
    assert times == ["1970-01-02T00:00:00.000000Z", "1970-01-02T00:15:00.000000Z", "1970-01-02T00:30:00.000000Z"]


def test_lists_turn_as_an_odometer_and_draws_turn_fastest():
    axes = Axis("a", values=(0, 1)), Axis("x", least=0, most=1), Axis("b", values=(0, 1, 2)), Axis("c", values=(0, 1))
    sweep = Sweep(axes, draws=3, seed=7)

    assert len(sweep) == 2 * 3 * 2 * 3
    samples = [sweep.sample(number) for number in range(len(sweep))]
    expected = [one for one in product((0, 1), (0, 1, 2), (0, 1)) for _ in range(3)]
    assert [(one["a"], one["b"], one["c"]) for one in samples] == expected
    assert len({one["x"] for one in samples}) == len(samples)
    for key in "axbc":
        assert sweep.column(key) == [one[key] for one in samples]
    assert sweep.column("x", salt=1) != sweep.column("x")
    assert sweep.as_json() == {
        "draws": 3, "seed": 7,
        "varies": {"a": [0, 1], "x": {"min": 0, "max": 1, "log": False}, "b": [0, 1, 2], "c": [0, 1]},
    }  # fmt: skip


def test_a_sweep_of_draws_alone_is_one():
    assert not Sweep()
    assert not Sweep(draws=1)
    assert Sweep(draws=2)
    assert Sweep((Axis("a", values=(1,)),))
