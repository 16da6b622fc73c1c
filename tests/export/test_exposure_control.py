"""Exposure control in flights through twilight and moonrise, and in exports of them."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import glstar as gs
from glstar.export.live import LiveExport
from glstar.sky.place.timescale import parse_utc
from tests.support.exports import assert_same, contents, done, image_of, refused, truth_of
from tests.support.links import ScriptedLink, flown
from tests.support.sender import UTC_S, Sender

SKY = {
    "camera.width_px": 80,
    "camera.height_px": 60,
    "camera.fx_px": 75.0,
    "camera.fy_px": 75.0,
    "sensor.noise": "electrons",
    "sensor.bit_depth": 12,
    "sky.brightness": "natural",
    "sky.vmag_limit": 4.0,
    "exposure.duration_s": 0.5,
    "exposure.interval_s": 20.0,
    "exposure.control": "mean",
    "exposure.control_speed": 0.6,
    "flight.synthetic.path": "still",
    "flight.synthetic.rate_hz": 1,
    "flight.synthetic.latitude_deg": -34.93,
    "flight.synthetic.longitude_deg": 138.6,
    "navigator.clock_offset_s": 0.01,
}
# After sunset, the Sun from -5 to -15 deg: the sky becomes 3000 times darker.
DUSK = SKY | {"flight.synthetic.utc_start": "2024-03-10T09:31:00Z", "flight.synthetic.duration_s": 3000}
# In astronomical night, the Moon from -3 to 9 deg.
MOONRISE = SKY | {
    "flight.synthetic.utc_start": "2024-03-29T10:20:00Z",
    "flight.synthetic.duration_s": 4200,
    "exposure.duration_s": 2.0,
    "exposure.interval_s": 60.0,
}


@pytest.fixture(scope="module")
def renderer() -> Iterator[gs.GLRenderer]:
    with gs.GLRenderer.headless() as shared:
        yield shared


def taken(settings: dict[str, Any], renderer: gs.GLRenderer) -> tuple[list[gs.Observation], np.ndarray]:
    """Return the observations of a flight, and exposure time, gain and level of each, (n, 3)."""
    with gs.Environment(gs.Config().override(**settings), renderer=renderer) as environment:
        seen = [environment.reset()]
        while not environment.is_over:
            seen.append(environment.step())
    rows = [
        (one.nav["duration_s"], one.nav["analogue_gain"], (one.frame.pixels.mean() - 256) / (4095 - 256))
        for one in seen
    ]
    return seen, np.array(rows)


def test_through_dusk_the_level_is_held_within_the_limits(renderer: gs.GLRenderer) -> None:
    seen, found = taken(DUSK, renderer)

    assert len(found) == 150
    duration_s, gain, level = found.T
    assert duration_s.min() >= 0.0001
    assert duration_s.max() <= 0.5
    assert gain.min() >= 1.0
    assert gain.max() <= 16.0
    # It begins saturated, at 3000 times the exposure: what is measured is then at most 6 times too much.
    assert level[0] > 0.99
    steady = int(np.argmax(np.abs(level / 0.16 - 1) < 0.25))
    assert steady <= 18
    # The sky darkens by 8 % a frame, and what is measured is used two frames later.
    assert (np.abs(level[steady:] / 0.16 - 1) < 0.25).all()
    # The night ends at the longest exposure, with gain.
    assert duration_s[-1] == 0.5
    assert gain[-1] > 1.1
    for one, (exposed_s, factor, _) in zip(seen, found, strict=True):
        assert (one.truth["duration_s"], one.truth["analogue_gain"]) == (exposed_s, factor)
        assert one.truth["sensor"]["dn_per_e"] == pytest.approx(0.47 * factor, rel=1e-9)


def test_moonrise_shortens_the_exposure(renderer: gs.GLRenderer) -> None:
    seen, found = taken(MOONRISE, renderer)

    duration_s, gain, level = found.T
    altitude_deg = np.array([one.truth["moon_altitude_deg"] for one in seen])
    assert altitude_deg[0] < -3
    assert altitude_deg[-1] > 8
    before, after = (duration_s * gain)[8], (duration_s * gain)[-1]
    brighter = 10 ** (0.4 * (seen[8].truth["sky_mag_arcsec2"] - seen[-1].truth["sky_mag_arcsec2"]))
    assert brighter > 2.5
    # Twice the 2 % that are left alone, and the dark current.
    assert before / after == pytest.approx(brighter, rel=0.12)
    assert (np.abs(level[8:] / 0.16 - 1) < 0.35).all()
    assert (np.abs(level[-10:] / 0.16 - 1) < 0.05).all()


def test_the_same_seed_gives_the_same_bytes_and_a_refused_step_changes_nothing(renderer: gs.GLRenderer) -> None:
    config = gs.Config().override(**DUSK | {"flight.synthetic.duration_s": 200})
    with gs.Environment(config, renderer=renderer) as environment:
        runs = []
        for _ in range(2):
            first = environment.reset(3)
            with pytest.raises(gs.ConfigError):
                environment.step(-1.0)
            runs.append([first, *(environment.step() for _ in range(6))])
    for one, same in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.frame.pixels, same.frame.pixels)
        assert (one.nav, one.truth) == (same.nav, same.truth)


def test_an_exposure_that_follows_poses_ends_with_its_step(renderer: gs.GLRenderer) -> None:
    keys = {key: value for key, value in DUSK.items() if not key.startswith("flight.synthetic")}
    pose = gs.Pose((1.0, 0.0, 0.0, 0.0), gs.Site(np.deg2rad(-34.93), np.deg2rad(138.6), 0.0))
    config = gs.Config().override(**keys | {"exposure.frames": 2, "exposure.stack": "mean", "exposure.readout_s": 0.3})
    utc_s = 1710063060.0  # 09:31 UTC
    with gs.Environment(config, renderer=renderer) as environment:
        seen = [environment.reset(pose=pose, utc_s=utc_s), *(environment.step(pose) for _ in range(12))]

    ends = [parse_utc(one.truth["utc_start"]) + one.truth["total_s"] for one in seen]
    np.testing.assert_allclose(ends, utc_s + 20.0 * np.arange(13), rtol=0, atol=2e-6)
    # Shorter than the readout, and the second short exposure still begins half a second after the first.
    assert seen[-1].truth["duration_s"] < 0.01
    for one in seen:
        assert one.truth["duration_s"] + one.truth["gap_s"] == pytest.approx(0.5, abs=2e-6)


def written(folder: Path, settings: dict[str, Any]) -> Path:
    """Write a config file."""
    path = folder / "night.toml"
    path.write_text(gs.Config().override(**settings).to_toml(), encoding="utf-8")
    return path


def test_an_export_is_the_flight_of_the_environment_with_any_number_of_workers(
    renderer: gs.GLRenderer, tmp_path: Path
) -> None:
    settings = DUSK | {"flight.synthetic.duration_s": 300}
    config = written(tmp_path, settings)
    done("export", "-c", config, "-o", tmp_path / "one", "--workers", 1)
    done("export", "-c", config, "-o", tmp_path / "two", "--workers", 2)

    assert_same(tmp_path / "two", tmp_path / "one")
    assert "byte for byte" in done("export", "-c", config, "-o", tmp_path / "one", "--verify").out
    seen, _ = taken(settings, renderer)
    lines = (tmp_path / "one" / "nav.jsonl").read_text(encoding="utf-8").splitlines()
    truth = truth_of(tmp_path / "one")
    assert len(truth) == len(seen) == 15
    for one, line, nav in zip(seen, truth, map(json.loads, lines), strict=True):
        assert nav["analogue_gain"] == one.nav["analogue_gain"] == line["analogue_gain"]
        assert nav["duration_s"] == one.nav["duration_s"] == line["duration_s"]
        np.testing.assert_array_equal(image_of(tmp_path / "one" / line["file"]), one.frame.pixels)


def test_an_export_that_was_cut_off_goes_on_with_the_same_exposures(tmp_path: Path) -> None:
    config = written(tmp_path, DUSK | {"flight.synthetic.duration_s": 200})
    done("export", "-c", config, "-o", tmp_path / "whole", "--workers", 1)
    done("export", "-c", config, "-o", tmp_path / "again", "--workers", 1)
    for name in ("frame_000003.png", "frame_000007.png"):
        (tmp_path / "again" / name).unlink()

    done("export", "-c", config, "-o", tmp_path / "again", "--workers", 1)

    assert_same(tmp_path / "again", tmp_path / "whole")


def test_each_sample_of_a_sweep_has_a_control_of_its_own(tmp_path: Path) -> None:
    config = written(tmp_path, DUSK | {"flight.synthetic.duration_s": 300, "exposure.control_speed": 1.0})
    with config.open("a", encoding="utf-8") as file:
        file.write("\n[sweep]\nexposure.control_target = [0.05, 0.3]\n")

    done("export", "-c", config, "-o", tmp_path / "set", "--workers", 1)

    truth = truth_of(tmp_path / "set")
    assert [line["duration_s"] for line in truth[:2]] == [line["duration_s"] for line in truth[15:17]] == [0.5, 0.5]
    for last, target in ((truth[14], 0.05), (truth[29], 0.3)):
        level = (image_of(tmp_path / "set" / last["file"]).mean() - 256) / (4095 - 256)
        assert level == pytest.approx(target, rel=0.25)
    assert "analogue_gain" in contents(tmp_path / "set")["truth.jsonl"].decode()


def test_without_control_nothing_is_added(tmp_path: Path) -> None:
    config = written(tmp_path, DUSK | {"exposure.control": "none", "flight.synthetic.duration_s": 30})
    done("export", "-c", config, "-o", tmp_path / "set", "--workers", 1)

    assert b"analogue_gain" not in contents(tmp_path / "set")["truth.jsonl"]
    assert b"analogue_gain" not in contents(tmp_path / "set")["nav.jsonl"]


def test_the_frames_of_a_link_are_controlled_and_end_at_the_latest_attitude(renderer: gs.GLRenderer) -> None:
    keys = {key: value for key, value in SKY.items() if not key.startswith("flight.synthetic")}
    # The link's flight is at night: the first exposure of 0.5 s is too dark, and gain follows.
    config = gs.Config().override(**keys | {"exposure.interval_s": 0.5, "exposure.control_min_gain": 2.0})
    link, exposures = ScriptedLink(list(flown(Sender(1), 100.0, 0.0, 10.0, UTC_S))), []
    live = LiveExport(config, link)

    report = live.run(renderer, on_frame=lambda _: exposures.append(list(live.exposures.values())[-1]))

    assert report.drawn >= 15
    stops_s = np.array([exposure.stop_utc_s for exposure in exposures])
    np.testing.assert_allclose(np.diff(stops_s), 0.5, rtol=0, atol=0.03)
    assert live._frames._control is not None
    assert live._frames._control.settings[1] > 2.0 or live._frames._control.settings[0] < 0.5


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("[exposure]\ncontrol = 'mean'\n", 'exposure.control: needs [sensor] noise = "electrons"'),
        (
            "[exposure]\ncontrol = 'mean'\nduration_s = 0.1\ncontrol_min_s = 0.2\n[sensor]\nnoise = 'electrons'\n",
            "exposure.control_min_s: is 0.2 s, longer than exposure.duration_s, 0.1 s",
        ),
        (
            "[exposure]\ncontrol = 'mean'\ncontrol_min_gain = 20.0\n[sensor]\nnoise = 'electrons'\n",
            "exposure.control_min_gain: is 20, more than control_max_gain, 16",
        ),
        ("[exposure]\ncontrol = 'median'\n", "exposure.control"),
    ],
)
def test_a_control_that_cannot_work_is_refused(settings: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(settings, encoding="utf-8")

    assert words in refused("export", "fly:still", "-c", tmp_path / "night.toml", "-o", tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_a_start_without_quotes_is_exported(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(
        "[flight.synthetic]\npath = 'still'\nduration_s = 2\nutc_start = 2024-03-10T09:25:00Z\n", encoding="utf-8"
    )

    done("export", "-c", tmp_path / "night.toml", "-o", tmp_path / "set", "--frames", 1)

    assert truth_of(tmp_path / "set")[0]["utc_start"].startswith("2024-03-10T09:25:00")
