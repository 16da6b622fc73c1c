"""Where each value of a config comes from, and `glstar config`, which shows it."""

import json
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.config.config import origins

RUNNER = CliRunner()


@pytest.fixture
def night(tmp_path: Path) -> Path:
    path = tmp_path / "night.toml"
    path.write_text('[camera]\npreset = "picamhq-6mm"\n[exposure]\nduration_s = 1.5\n[flight]\nattitude = "XKQ"\n')
    return path


def test_a_value_comes_from_a_flag_the_file_a_preset_or_the_default(night: Path) -> None:
    config = Config.load(night).override(**{"flight.attitude": "ATT"})

    found = origins(config, {"flight.attitude": "--attitude"})

    assert found["flight"]["attitude"] == ("ATT", "--attitude")
    assert found["exposure"]["duration_s"] == (1.5, "night.toml")
    assert found["exposure"]["interval_s"] == (3.0, "default")
    assert found["camera"]["preset"] == ("picamhq-6mm", "night.toml")
    assert found["camera"]["width_px"][1] == "preset picamhq-6mm"
    assert {section: set(values) for section, values in found.items()} == {
        section: set(values) for section, values in config.resolved().items()
    }


def test_a_preset_is_the_origin_of_what_it_changes(tmp_path: Path) -> None:
    path = tmp_path / "hq.toml"
    path.write_text(
        '[camera]\npreset = "imx477:2028x1520"\nlens_mm = 6.0\n[sensor]\npreset = "imx477:2028x1520"\nband = "imx477"\n'
        '[sky]\npreset = "full"\nvmag_limit = 5.0\n'
    )

    found = origins(Config.load(path), {})

    mode = "preset imx477:2028x1520"
    assert found["exposure"]["readout_s"] == (0.02305, mode)
    assert {found["sensor"][key][1] for key in ("noise", "bit_depth", "full_well_e", "black_level_dn")} == {mode}
    assert {found["sensor"][key][1] for key in ("mosaic", "psf_halo_radius_px", "sky_map")} == {"default"}
    assert found["sensor"]["band"] == ("imx477", "hq.toml")
    assert {key: found["sky"][key][1] for key in ("bodies", "vmag_limit", "refraction")} == {
        "bodies": "preset full",
        "vmag_limit": "hq.toml",
        "refraction": "default",
    }


def rows_of(*words: str) -> dict[str, list[str]]:
    shown = RUNNER.invoke(app, ["config", "--changed", *words])
    assert shown.exit_code == 0, shown.output
    return {line.split()[0]: line.split()[1:] for line in shown.output.splitlines()[1:]}


def test_the_flags_of_a_camera_are_the_origin_of_what_they_bring(night: Path) -> None:
    words = ["--camera", "imx477:2028x1520", "--lens-mm", "6", "--f-number", "1.2", "--gain", "4"]
    mode = ["--camera", "imx477:2028x1520"]

    for rows in (rows_of(*words), rows_of("-c", str(night), *words)):
        assert rows["camera.preset"] == ['"imx477:2028x1520"', "--camera"]
        assert rows["camera.lens_mm"] == ["6.0", "--lens-mm"]
        assert rows["camera.f_number"] == ["1.2", "--f-number"]
        assert rows["sensor.analogue_gain"] == ["4.0", "--gain"]
        assert rows["camera.width_px"] == ["2028", *mode]
        assert rows["sensor.full_well_e"] == ["32720.0", *mode]
        assert rows["exposure.readout_s"] == ["0.02305", *mode]
        assert rows["lens.vignetting"] == ['"cos4"', *mode]


def test_a_calibration_file_of_a_flag_is_the_origin_of_its_numbers(tmp_path: Path) -> None:
    path = tmp_path / "lens.toml"
    path.write_text("[camera]\nwidth_px = 800\nheight_px = 600\nfx_px = 900.0\nfy_px = 900.0\n")

    rows = rows_of("--camera", str(path))

    assert rows["camera.width_px"][:2] == ["800", "--camera"]
    assert not any(key.startswith("sensor.") for key in rows)


@pytest.mark.parametrize(
    ("keys", "brings_the_sensor"),
    [
        ("", True),
        ("[sensor]\npsf_sigma_px = 2.0\n", True),
        ("[sensor]\nanalogue_gain = 8.0\n", True),
        ('[sensor]\npreset = "imx477:2028x1520"\n', True),
        ('[sensor]\nnoise = "paper"\n', False),
        ("[sensor]\nsky_mean_dn = 20.0\n", False),
        ('[sensor]\npreset = "generic"\n', False),
    ],
)
def test_the_mode_of_a_sensor_in_a_file_means_what_the_flag_means(
    tmp_path: Path, keys: str, brings_the_sensor: bool
) -> None:
    path = tmp_path / "hq.toml"
    path.write_text('[camera]\npreset = "imx477:2028x1520"\nlens_mm = 6.0\nf_number = 1.2\n' + keys)
    by_flag = Config().override(
        **{"camera.preset": "imx477:2028x1520", "sensor.preset": "imx477:2028x1520"},
        **{"camera.lens_mm": 6.0, "camera.f_number": 1.2},
    )

    config = Config.load(path)

    assert config.exposure.readout_s == by_flag.exposure.readout_s
    assert (config.sensor().electrons is not None) == (brings_the_sensor or "generic" in keys)
    if brings_the_sensor and not keys:
        assert config == by_flag
    effects = config.sensor().effects
    assert effects.get("lens.vignetting", "none") == ("cos4" if brings_the_sensor else "none")


def test_the_vignetting_that_a_file_gives_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "hq.toml"
    path.write_text('[camera]\npreset = "imx477:2028x1520"\nlens_mm = 6.0\n[lens]\nvignetting = "none"\n')

    assert "lens.vignetting" not in Config.load(path).sensor().effects


def test_without_a_file_all_is_default() -> None:
    assert {origin for values in origins(Config(), {}).values() for _, origin in values.values()} == {"default"}


def test_the_command_shows_what_differs(night: Path) -> None:
    shown = RUNNER.invoke(app, ["config", "-c", str(night), "--attitude", "ATT", "--changed"])
    report = RUNNER.invoke(app, ["config", "-c", str(night), "--lat", "-34", "--lon", "138", "--json"])

    assert shown.exit_code == 0, shown.output
    rows = {line.split()[0]: line.split()[1:] for line in shown.output.splitlines()[1:]}
    assert rows["exposure.duration_s"] == ["1.5", "night.toml"]
    assert rows["flight.attitude"] == ['"ATT"', "--attitude"]
    assert "exposure.interval_s" not in rows
    assert json.loads(report.output)["flight"]["latitude_deg"] == {"value": -34.0, "from": "--lat"}


def test_the_template_is_the_default_and_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "template.toml"

    written = RUNNER.invoke(app, ["config", "--template", str(path)])
    again = RUNNER.invoke(app, ["config", "--template", str(path)])
    elsewhere = RUNNER.invoke(app, ["config", "--template", str(tmp_path / "template.yaml")])

    assert written.exit_code == 0, written.output
    assert Config.load(path) == Config()
    assert set(tomllib.loads(path.read_text())) >= {"camera", "exposure", "sensor", "sky", "flight"}
    assert again.exit_code == 1
    assert "exists already" in again.output
    assert elsewhere.exit_code == 1
    assert "a config is a .toml file" in elsewhere.output


def test_the_rates_of_a_machine_are_measured() -> None:
    result = RUNNER.invoke(app, ["doctor", "bench", "--seconds", "0.1", "--json"])

    assert result.exit_code == 0, result.output
    report = json.loads(result.output)
    assert [row["width_px"] for row in report["rates"]] == [1014, 2028, 4056]
    assert all(row["drawn_per_s"] > 0 and row["written_per_s"] > 0 for row in report["rates"])
    assert report["driver"]
