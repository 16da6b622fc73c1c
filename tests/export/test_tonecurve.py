"""Tone curves given as a number, as points and as files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.sensor.sensor import Sensor
from glstar.camera.sensor.tonecurve import curve_text, parse_curve, read_curve
from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.imagefiles.processing import process

RAMP = np.arange(4096, dtype=np.uint16).reshape(64, 64)
POINTS = [[0.02, 0.0], [0.05, 0.3], [0.2, 0.6], [0.9, 1.0]]


def processed(**output) -> np.ndarray:
    """Return all numbers of 12 bits after processing, as fractions of full scale."""
    effects = {"output.process": "isp"} | {f"output.{key}": value for key, value in output.items()}
    return process(RAMP, replace(Sensor(bit_depth=12), effects=effects), sixteen_bits=True) / 65535


def config_of(folder, lines) -> Config:
    (folder / "c.toml").write_text(f'[output]\nprocess = "isp"\n{lines}\n')
    return Config.load(folder / "c.toml")


def curve_of(folder, value) -> list:
    """Return the points that a config makes of a value."""
    text = config_of(folder, f"tone_curve = {value}").sensor().effects["output.tone_curve"]
    return [list(point) for point in parse_curve(text)]


@pytest.mark.parametrize("gamma", [0.5, 2.2, 3.0])
def test_a_gamma_is_the_inverse_of_the_exponent(gamma):
    assert np.abs(processed(gamma=gamma) - (RAMP / 4095) ** (1 / gamma)).max() < 1 / 65535


def test_points_are_interpolated_as_numpy_does():
    given, toned = np.transpose(POINTS)
    expected = np.interp(RAMP / 4095, given, toned)
    assert np.abs(processed(tone_curve=curve_text(POINTS)) - expected).max() < 1 / 65535


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", "input,output\n" + "\n".join(f"{x},{y}" for x, y in POINTS)),
        ("b.csv", "# measured\n\n" + "\n".join(f"{x}; {y}" for x, y in POINTS)),
        ("c.txt", "\n".join(f"{x}\t{y}" for x, y in POINTS)),
        ("d.json", json.dumps(POINTS)),
        (
            "e.json",
            json.dumps({"algorithms": [{"rpi.contrast": {"gamma_curve": (65535 * np.ravel(POINTS)).tolist()}}]}),
        ),
    ],
)
def test_files_hold_points(name, content, tmp_path):
    (tmp_path / name).write_text(content)
    assert np.allclose(curve_of(tmp_path, f'"{name}"'), POINTS, rtol=0, atol=1e-7)


def test_a_list_and_its_text_are_the_same_curve(tmp_path):
    assert curve_of(tmp_path, POINTS) == curve_of(tmp_path, '"0.02,0;0.05,0.3;0.2,0.6;0.9,1"') == POINTS


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("tone_curve = [[0, 0], [0.5, 0.6], [0.4, 1]]", "[0.4, 1] follows [0.5, 0.6]"),
        ("tone_curve = [[0, 0.2], [1, 0.1]]", "outputs must not decrease"),
        ("tone_curve = [[0, 0]]", "two points or more, not 1"),
        ("tone_curve = [[0, 0], [255, 1]]", "divide by full scale"),
        ("tone_curve = [0, 1]", "0 is no pair of numbers"),
        (f"tone_curve = [[0, 0], [1, {10**400}]]", "is no pair of numbers"),
        ('tone_curve = "none.csv"', "none.csv: there is no such file"),
        ('tone_curve = "c.toml"', "c.toml: "),
        ('tone_curve = [[0, 0], [1, 1]]\ngamma = "srgb"', "leave one out"),
        ("gamma = 20", "a number from 0.1 to 10, not 20"),
        ('gamma = "sgrb"', 'did you mean "srgb"'),
    ],
)
def test_a_wrong_curve_is_one_line(lines, message, tmp_path):
    with pytest.raises(ConfigError) as error:
        config_of(tmp_path, lines)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_json_file_without_a_curve_is_refused(tmp_path):
    huge = 10**400
    wrong = ("[0]", "3", "null", "[0, 0, 65535, [1, 2]]", '[0, 0, 65535, "1"]', '"ab"', f"[0, 0, 65535, {huge}]")
    for content in ("{}", *(f'{{"gamma_curve": {curve}}}' for curve in wrong)):
        (tmp_path / "a.json").write_text(content)
        with pytest.raises(ValueError, match=r"a\.json: .*gamma_curve"):
            read_curve(tmp_path / "a.json")


def test_the_config_and_the_truth_hold_the_points_of_a_file(tmp_path):
    (tmp_path / "curve.csv").write_text("\n".join(f"{x},{y}" for x, y in POINTS))
    config = config_of(tmp_path, 'tone_curve = "curve.csv"')
    assert config.files == (tmp_path / "curve.csv",)
    (tmp_path / "again.toml").write_text(config.to_toml())
    assert Config.load(tmp_path / "again.toml").sensor().effects == config.sensor().effects
    size = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n"
    (tmp_path / "c.toml").write_text((tmp_path / "c.toml").read_text() + size)
    command = ["export", "-o", str(tmp_path / "d"), "-c", str(tmp_path / "c.toml"), "--frames", "1"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "d" / "truth.jsonl").read_text())["output"]["tone_curve"] == POINTS


def test_a_gamma_varies_in_a_range(tmp_path):
    (tmp_path / "c.toml").write_text("[sweep]\ndraws = 3\noutput.gamma = { min = 1.8, max = 2.4 }\n")
    config = Config.load(tmp_path / "c.toml")
    drawn = [config.at(config.sweep.sample(k)).sensor().effects["output.gamma"] for k in range(3)]
    assert len(set(drawn)) == 3
    assert all(1.8 <= gamma <= 2.4 for gamma in drawn)
