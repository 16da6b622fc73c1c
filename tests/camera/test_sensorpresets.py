"""Sensors and their modes: sources, binning, bits, and the cameras that they make."""

import re
from pathlib import Path

import pytest

from glstar.camera.presets import camera_from_preset, is_sensor_mode, sensor_mode, sensor_presets
from glstar.config import Config
from glstar.errors import ConfigError

NAMES = (
    *("generic", "imx477", "imx219", "imx708", "imx296", "imx290", "imx327", "imx462", "imx378", "imx519"),
    *("ov5647", "ov9281", "imx283"),
)
KEYS = {
    *("pixel_um", "bit_depth", "gain_dn_per_e", "analogue_gain_max", "full_well_e", "black_level_dn"),
    *("read_noise_before_gain_e", "read_noise_after_gain_e", "dark_current_e_per_s", "quantum_efficiency"),
    *("photons_per_s_cm2", "hot_pixels_per_mpx"),
}


def test_every_number_of_every_sensor_has_a_source() -> None:
    assert tuple(sensor_presets()) == NAMES
    for sensor in sensor_presets().values():
        assert sensor.numbers.keys() == KEYS, sensor.name
        assert all(number.source for number in sensor.numbers.values()), sensor.name
        assert all(mode.source for mode in sensor.modes), sensor.name
        assert sensor.modes or sensor.name == "generic"


def test_a_binned_mode_counts_the_electrons_of_all_its_pixels() -> None:
    full, binned = sensor_mode("imx477").values, sensor_mode("imx477:2028x1520").values

    # Four pixels averaged: four times the electrons at the same digital number, and twice the read noise.
    assert binned["full_well_e"] == 4 * full["full_well_e"]
    assert binned["gain_dn_per_e"] * binned["full_well_e"] == pytest.approx(full["gain_dn_per_e"] * 8180.0)
    assert binned["read_noise_before_gain_e"] == 2 * full["read_noise_before_gain_e"]
    assert binned["dark_current_e_per_s"] == 4 * full["dark_current_e_per_s"]


@pytest.mark.parametrize("name", NAMES)
def test_the_full_well_and_the_converter_saturate_within_a_factor_of_each_other(name: str) -> None:
    # A wrong number of bits or a wrong gain would leave the well a small part of the range, or several times as large.
    values = sensor_presets()[name].values
    span_dn = 2 ** values["bit_depth"] - 1 - values["black_level_dn"]

    assert 0.9 < values["full_well_e"] * values["gain_dn_per_e"] / span_dn < 1.15


def test_a_mode_behind_a_lens_is_a_camera() -> None:
    camera = camera_from_preset("imx477:2028x1520", 6.0)

    assert (camera.width_px, camera.height_px) == (2028, 1520)
    # The field of view of the full resolution: 6 mm over 1.55 um.
    full = camera_from_preset("imx477", 6.0)
    assert full.fx_px == pytest.approx(3870.97, abs=0.01)
    assert camera.field_radius_rad == pytest.approx(full.field_radius_rad, abs=1e-6)
    assert camera.fx_px == camera.fy_px


@pytest.mark.parametrize(
    ("name", "rows", "line_us"),
    [("imx477", 3040, 28.571), ("imx477:2028x1080", 1080, 15.167), ("imx219", 2464, 18.904), ("imx378", 3040, 28.571)],
)
def test_the_readout_time_is_rows_times_line(name: str, rows: int, line_us: float) -> None:
    assert sensor_mode(name).readout_s == pytest.approx(rows * line_us * 1e-6, rel=1e-3)


@pytest.mark.parametrize("name", ["imx296", "ov9281"])
def test_a_global_shutter_has_no_readout_time(name: str) -> None:
    assert sensor_mode(name).readout_s == 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("imx47", 'there is no sensor "imx47" (did you mean "imx477"? There are'),
        ("imx477:10x10", 'has no mode "10x10" (its modes are 4056x3040, 2028x1520, 2028x1080, 1332x990)'),
        ("generic:10x10", 'has no mode "10x10" (it has no modes)'),
    ],
)
def test_an_unknown_mode_is_refused_with_those_that_there_are(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        sensor_mode(name)


def test_a_camera_has_its_lens_and_a_sensor_needs_one() -> None:
    assert is_sensor_mode("IMX477:2028x1520")
    assert not is_sensor_mode("picamhq-6mm")
    with pytest.raises(ConfigError, match="has a lens of its own"):
        camera_from_preset("picamhq-6mm", 6.0)
    with pytest.raises(ConfigError, match="focal length of the lens before imx477:4056x3040"):
        camera_from_preset("imx477")
    with pytest.raises(ConfigError, match="images of any size"):
        camera_from_preset("generic", 6.0)


USERS_SENSOR = """\
[AllSky]
description = "a camera of the user's"
pixel_um = { value = 2.4, source = "data sheet" }
bit_depth = { value = 12, source = "data sheet" }
gain_dn_per_e = { value = 0.25, source = "measured" }
analogue_gain_max = { value = 10.0, source = "data sheet" }
full_well_e = { value = 15000.0, source = "data sheet" }
black_level_dn = { value = 64.0, source = "measured" }
read_noise_before_gain_e = { value = 1.5, source = "data sheet" }
read_noise_after_gain_e = { value = 2.0, source = "data sheet" }
dark_current_e_per_s = { value = 0.1, source = "measured" }
hot_pixels_per_mpx = { value = 100.0, source = "measured" }
quantum_efficiency = { value = 0.8, source = "data sheet" }
photons_per_s_cm2 = { value = 1.0e6, source = "assumed" }
modes = [
    { size = [640, 480], binning = 1, readout_ms = 40.0, source = "data sheet" },
    { size = [320, 240], binning = 2, readout_ms = 20.0, source = "data sheet" },
]
"""


@pytest.fixture
def sensors(tmp_path: Path) -> str:
    """Return the path of a user's file of sensors."""
    (tmp_path / "sensors.toml").write_text(USERS_SENSOR, encoding="utf-8")
    return str(tmp_path / "sensors.toml")


def test_a_sensor_of_a_users_file_is_a_preset(sensors: str) -> None:
    mode = sensor_mode(f"{sensors}:allsky:320x240")

    assert is_sensor_mode(f"{sensors}:AllSky")
    assert (mode.name, mode.readout_s, mode.pixel_um) == (f"{sensors}:allsky:320x240", 0.02, 4.8)
    assert mode.values["full_well_e"] == 4 * 15000.0  # electrons of four pixels
    assert camera_from_preset(f"{sensors}:AllSky:320x240", 6.0).fx_px == pytest.approx(6000 / 4.8)
    assert camera_from_preset(f"{sensors}:AllSky", 6.0).width_px == 640


@pytest.mark.parametrize(
    ("change", "name", "message"),
    [
        (("", ""), "allsku", r'sensors.toml: there is no sensor "allsku" \(did you mean "allsky"\? There are allsky\)'),
        (("", ""), "allsky:1x1", r'no mode "1x1" \(its modes are 640x480, 320x240\)'),
        (("pixel_um", "pixel_mm"), "allsky", r"sensors.toml: \[AllSky\] is no sensor: pixel_um is missing"),
        (("description", "text"), "allsky", r"\[AllSky\] is no sensor: description is missing"),
        (
            ("value = 2.4", 'value = "wide"'),
            "allsky",
            r"\[AllSky\] is no sensor: pixel_um must be a number, not 'w",
        ),
        (("value = 2.4", "value = nan"), "allsky", r"\[AllSky\] is no sensor: pixel_um holds nan; it must be a finite"),
        (("value = 2.4", "value = 0"), "allsky", r"\[AllSky\] is no sensor: pixel_um must be a positive number, not 0"),
        (("value = 2.4", "text = 2.4"), "allsky", r"\[AllSky\] is no sensor: pixel_um has no value"),
        (("value = 12", "value = 1e9"), "allsky", r"bit_depth is 1e\+09; it must be a whole number from 1 to 16"),
        (("binning = 2", "binning = 0"), "allsky", r"\[AllSky\] is no sensor: binning is 0; it must be a whole number"),
        (("[640, 480]", '["a", 480]'), "allsky", r"\[AllSky\] is no sensor: size must be a number, not 'a'"),
        (("[640, 480]", "[640.5, 480]"), "allsky", r"\[AllSky\] is no sensor: size is 640\.5; the size of an image is"),
        (("[AllSky]", "x = 1\n[AllSky]"), "allsky", r"sensors.toml: \[x\] is no sensor: it must be a table"),
        (("[AllSky]", "[AllSky"), "allsky", r"sensors.toml cannot be read: .*line 1"),
    ],
)
def test_errors_of_a_users_file_name_it_and_the_sensor(
    sensors: str, change: tuple[str, str], name: str, message: str
) -> None:
    Path(sensors).write_text(USERS_SENSOR.replace(*change), encoding="utf-8")

    with pytest.raises(ConfigError, match=message):
        sensor_mode(f"{sensors}:{name}")


def test_a_users_file_that_is_missing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml cannot be read: there is no such file"):
        sensor_mode(f"{tmp_path / 'none.toml'}:allsky")


def test_a_config_finds_the_file_of_a_sensor_beside_it(sensors: str, tmp_path: Path) -> None:
    keys = 'preset = "sensors.toml:AllSky:320x240"\n'
    (tmp_path / "config.toml").write_text(f"[camera]\n{keys}lens_mm = 6.0\n[sensor]\n{keys}", encoding="utf-8")

    config = Config.load(tmp_path / "config.toml")

    assert (config.camera().width_px, config.exposure.readout_s) == (320, 0.02)
    assert config.sensor().electrons.full_well_e == 4 * 15000.0
    assert config.files == (Path(sensors),)
    (tmp_path / "written.toml").write_text(config.to_toml(), encoding="utf-8")
    assert Config.load(tmp_path / "written.toml").sensor() == config.sensor()


def test_a_preset_of_a_flag_is_relative_to_the_working_directory(
    sensors: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = {"camera.preset": "sensors.toml:AllSky", "sensor.preset": "sensors.toml:AllSky", "camera.lens_mm": 6.0}

    assert Config().override(**flags).files == (Path(sensors),)
