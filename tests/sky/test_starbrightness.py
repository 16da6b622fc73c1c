"""What a camera sees of each star: from a table to the simulator, the truth and the manifest."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.sensor.colourband import ColourBand
from glstar.cli import app
from glstar.config import Config
from glstar.errors import CalibrationError, ConfigError
from glstar.render.scene.starcomponents import in_band
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.photometry import StarBrightness
from glstar.system.resources import asset

# Sirius, Canopus and Rigil Kentaurus, the second half a magnitude brighter to the camera.
TABLE = "star_id,name,vmag,camera_mag\n2491,Sirius,-1.46,-1.46\n2326,Canopus,-0.72,-1.22\n5459,,-0.01,0.20\n"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.brightness.csv"
    path.write_text(TABLE, encoding="utf-8")
    return path


def test_stars_of_the_table_have_its_magnitudes_and_others_the_catalogues(table: Path) -> None:
    brightness = StarBrightness.open(table)
    magnitudes = brightness.magnitudes(
        "bsc5", np.array([5459, 7001, 2326], dtype=np.int32), np.array([-0.01, 0.03, -0.72])
    )
    np.testing.assert_array_equal(magnitudes, [0.20, 0.03, -1.22])
    assert brightness == StarBrightness.open(table)


def test_stars_that_are_not_in_the_table_have_the_band_of_the_camera(table: Path) -> None:
    stars = StarField(
        catalogue="bsc5",
        star_id=np.array([5459, 7001, 2326], dtype=np.int32),
        name=("", "", ""),
        vmag=np.array([-0.01, 0.03, -0.72]),
        direction_eq=np.eye(3),
        epoch_utc_s=0.0,
        C_eq_icrs=np.eye(3),
        bv=np.array([0.71, 1.0, 0.15]),
    )
    bare = ColourBand(band="bare")
    drawn = in_band(StarBrightness.open(table).applied(stars), bare)
    np.testing.assert_allclose(drawn.camera_mag, [0.20, 0.03 - 0.8 * 1.0, -1.22], rtol=0, atol=1e-12)


def test_the_stars_of_another_catalogue_are_refused(table: Path) -> None:
    with pytest.raises(CalibrationError, match="3 of its 3 stars have other magnitudes there"):
        StarBrightness.open(table).magnitudes(
            "bsc5", np.array([2491, 2326, 5459], dtype=np.int32), np.array([7.0, 8.1, 9.3])
        )


def test_a_table_of_an_older_version_has_hr_as_star_id(table: Path) -> None:
    now = StarBrightness.open(table)
    table.write_text(TABLE.replace("star_id", "hr"), encoding="utf-8")
    np.testing.assert_array_equal(StarBrightness.open(table).star_id, now.star_id)


def test_a_table_names_its_catalogue_and_refuses_another(table: Path) -> None:
    rows = TABLE.splitlines()
    named = [f"catalogue,{rows[0]}", *(f"bsc5,{row}" for row in rows[1:])]
    table.write_text("\n".join(named), encoding="utf-8")
    brightness = StarBrightness.open(table)
    unknown = np.array([1], dtype=np.int32), np.array([3.0])
    np.testing.assert_array_equal(brightness.magnitudes("bsc5", *unknown), [3.0])
    with pytest.raises(CalibrationError, match="is of the catalogue bsc5, and the simulation uses hipparcos"):
        brightness.magnitudes("hipparcos", *unknown)

    table.write_text("\n".join([*named[:2], named[2].replace("bsc5", "hipparcos")]), encoding="utf-8")
    with pytest.raises(CalibrationError, match="several catalogues"):
        StarBrightness.open(table)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no column star_id, vmag, camera_mag"),
        ("star_id,vmag\n1,2\n", "no column camera_mag"),
        ("star_id,vmag,camera_mag\n1,2,x\n", "line 2 has a value that is not a number"),
        ("star_id,vmag,camera_mag\n1,2\n", "is no table"),
        ("star_id,vmag,camera_mag\n1,2,nan\n", "no number"),
        ("star_id,vmag,camera_mag\n1,2,2\n1,3,3\n", "a star twice"),
    ],
)
def test_an_invalid_table_is_refused(table: Path, text: str, words: str) -> None:
    table.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=words):
        StarBrightness.open(table)
    (table.parent / "glstar.toml").write_text(f'[sensor]\nstar_brightness = "{table.name}"\n')
    with pytest.raises(ConfigError, match=r"sensor\.star_brightness"):
        Config.load(table.parent / "glstar.toml")


def test_the_path_of_a_table_is_relative_to_the_sensor_file(table: Path, monkeypatch) -> None:
    rig = table.parent / "rig"
    rig.mkdir()
    (table.parent / "calibration.toml").write_text(f'[sensor]\nsky_mean_dn = 9.0\nstar_brightness = "{table.name}"\n')
    (rig / "glstar.toml").write_text('[sensor]\nfile = "../calibration.toml"\n')
    config = Config.load(rig / "glstar.toml")
    assert config.star_brightness() == StarBrightness.open(table)
    assert config.sensor().sky_mean_dn == 9.0
    # Overriding a number keeps the table; a config written to TOML is self-contained.
    assert config.override(**{"sensor.sky_mean_dn": 10.0}).star_brightness() is not None
    (table.parent / "alone.toml").write_text(config.to_toml(), encoding="utf-8")
    monkeypatch.chdir(rig)
    assert Config.load("../alone.toml").star_brightness() == config.star_brightness()
    assert Config().star_brightness() is None


def test_frames_truth_and_manifest_use_the_table(table: Path) -> None:
    settings = table.parent / "glstar.toml"
    settings.write_text(
        "[camera]\nwidth_px = 320\nheight_px = 240\nfx_px = 160\nfy_px = 160\n"
        f'[sensor]\nstar_brightness = "{table.name}"\n'
    )
    frames = table.parent / "frames"
    arguments = ["export", asset("adelaide.BIN"), "-o", frames, "-c", settings, "--start", "40", "--frames", "1"]
    drawn = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert drawn.exit_code == 0, drawn.output

    truth = json.loads((frames / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    stars = {star["star_id"]: star for star in truth["stars"]}
    assert (stars[2326]["vmag"], stars[2326]["camera_mag"]) == (-0.72, -1.22)
    other = next(star for star in truth["stars"] if star["star_id"] not in (2491, 2326, 5459))
    assert other["camera_mag"] == other["vmag"]
    ratio = stars[2326]["peak_dn"] / other["peak_dn"]
    assert ratio == pytest.approx(10 ** (-0.4 * (-1.22 - other["vmag"])))
    manifest = json.loads((frames / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["star_brightness"]["sha256"] == StarBrightness.open(table).sha256
    assert manifest["star_brightness"]["stars"] == 3
