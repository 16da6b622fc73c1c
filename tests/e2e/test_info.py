"""``glstar info`` as a user runs it."""

import json
import shlex
from itertools import pairwise
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from glstar.cli import app

SHARED = Path(__file__).parents[2].parent / "shared" / "logs"


def info(*words: object) -> str:
    result = CliRunner().invoke(app, ["info", *map(str, words)])
    assert result.exit_code == 0, result.output
    return result.output


def test_the_bundled_flight_is_described() -> None:
    text = info()

    for part in ("ArduPilot DataFlash", "34.8", "night: the Sun is", "the Moon, ", "XKQ", "Try: glstar export"):
        assert part in text


def test_json_has_the_same_facts_as_numbers() -> None:
    facts = json.loads(info("--json"))

    assert facts["utc_first"].startswith("2024-03-10T11:0")
    rates_hz = {one["name"]: one["rate_hz"] for one in facts["attitudes"]}
    assert rates_hz == {"ATT": pytest.approx(10, abs=0.5), "XKQ[0]": pytest.approx(100, abs=0.5)}
    assert facts["light"] == "night"
    assert facts["gaps"] == []


def test_the_suggested_command_repeats_the_options_of_this_one(tmp_path: Path) -> None:
    config = tmp_path / "my camera.toml"
    config.write_text("[exposure]\nduration_s = 0.2\n", encoding="utf-8")
    chosen = ("--config", config, "--lat", -33.5, "--lon", 138.0, "--attitude", "ATT", "--interpolation", "slerp")

    words = shlex.split(json.loads(info(*chosen, "--json"))["command"])

    assert words[:2] == ["glstar", "export"]
    assert set(pairwise(words[3:])) >= {
        ("-o", "frames"),
        *zip(map(str, chosen[::2]), map(str, chosen[1::2]), strict=True),
    }
    assert words.count("--interpolation") == 1
    assert CliRunner().invoke(app, [*words[1:4], str(tmp_path / "frames"), *words[5:], "--dry-run"]).exit_code == 0


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_plot_is_drawn_and_the_same_flight_is_the_same_picture(suffix: str, tmp_path: Path) -> None:
    first, second = tmp_path / f"one{suffix}", tmp_path / f"two{suffix}"
    info("--plot", first)
    info("--plot", second)

    assert first.read_bytes() == second.read_bytes()
    if suffix == ".png":
        image = cv2.imread(str(first))
        assert image.std() > 20  # lines on white


def test_a_plot_of_another_kind_is_refused_in_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["info", "--plot", str(tmp_path / "plot.xls")])

    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert ".png, .svg, .pdf" in result.output


# Rates, spans and sites of ../shared/README.md: Hz, s, deg, first characters of UTC.
LOGS = {
    "plane_SITL_adelaide_200Hz.BIN": (200, 134, (-34.81, 138.62), "2024-03-10T11:0", "night"),
    "plane_SITL_adelaide_100Hz.tlog": (100, 166, (-34.81, 138.62), "2024-03-10T11:0", "night"),
    "plane_skywalkerX8_TestLog2.reenc.BIN": (50, 613, (-37.96, 144.77), "2013-11-29T22:0", "day"),
    "plane_Proto_FLT09.reenc.ulg": (89.8, 530, (45.22, -93.14), "2017-04-17T21:0", "day"),
    "copter_pyulog_sample.ulg": (93.7, 69, None, None, None),
    "vtol_ground_pyulog_sample_log_small.ulg": (204, 6.5, (63.417, 10.408), "2021-04-21T06:30:58", "day"),
    "rov_ardusub_small.tlog": (20, 264, (48.386, -124.631), "2023-05-04T17:15", "day"),
}


@pytest.mark.parametrize("name", LOGS)
def test_rates_spans_and_sites_agree_with_the_list_of_sample_logs(name: str) -> None:
    if not (SHARED / name).exists():
        pytest.skip("needs ../shared/logs")
    rate_hz, duration_s, place, utc, light = LOGS[name]
    facts = json.loads(info(SHARED / name, "--json"))

    chosen = next(one for one in facts["attitudes"] if facts["attitude_source"].startswith(one["name"][:3]))
    assert chosen["rate_hz"] == pytest.approx(rate_hz, rel=0.01)
    assert facts["duration_s"] == pytest.approx(duration_s, abs=0.6)
    assert facts["light"] == light
    if place is None:
        assert facts["utc_first"] is facts["latitude_deg"] is None
    else:
        assert (facts["latitude_deg"], facts["longitude_deg"]) == pytest.approx(place, abs=0.02)
        assert facts["utc_first"].startswith(utc)
