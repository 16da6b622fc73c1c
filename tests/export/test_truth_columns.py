"""The table of the truth's keys against exports with every setting that adds one."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import glstar as gs
from glstar.cli import app
from glstar.export.convert.labels import COPIED
from glstar.render.truth.columns import COLUMNS, columns_of
from glstar.score.frames import CONDITIONS
from tests.support.satellites import PASS, elements

# Over Adelaide, with the Moon and a satellite above the horizon; the camera sees half of the sky.
FLIGHT = """\
[flight.synthetic]
path = "hover"
utc_start = "2024-03-18T10:37:20Z"
latitude_deg = -34.93
longitude_deg = 138.6
duration_s = 40.0
[camera]
width_px = 300
height_px = 180
fx_px = 130.0
fy_px = 130.0
lens = "fisheye"
distortion = [0.0, 0.0, 0.0, 0.0]
max_angle_deg = 80.0
[mount]
pitch_deg = 90.0
"""
ELECTRONS = """\
gimbal = "level"
[exposure]
duration_s = 0.3
interval_s = 10.0
readout_s = 0.03
frames = 2
gap_s = 0.1
control = "mean"
[sensor]
noise = "electrons"
bit_depth = 12
band = "imx477"
mosaic = "rggb"
psf = "moffat"
psf_growth = 0.2
blooming = "columns"
hot_pixels_per_mpx = 200.0
[lens]
vignetting = "cos4"
[sky]
vmag_limit = 4.0
preset = "natural"
earthshine = true
scintillation = 0.38
horizon = "ridge.csv"
satellites = "pass.tle"
[cloud]
coverage = 0.5
optical_depth = 1.0
[flare]
scatter = 0.01
[output]
align = "high"
[sweep]
sensor.gain_dn_per_e = [0.1]
"""
MEASURED = """\
[exposure]
duration_s = 0.3
[sensor]
sky_map = "sky.tiff"
[output]
process = "isp"
"""
# Objects whose keys are those of a section of the config.
OBJECTS = {column.name for column in columns_of("frame") if column.kind == "object"}
OF_CONFIG = OBJECTS - {column.name.partition(".")[0] for column in COLUMNS if "." in column.name}


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    folder: Path = tmp_path_factory.mktemp("columns")
    (folder / "pass.tle").write_text(elements(PASS), encoding="utf-8")
    (folder / "ridge.csv").write_text("azimuth_deg,altitude_deg\n0,10\n180,10\n", encoding="utf-8")
    cv2.imwrite(str(folder / "sky.tiff"), np.ones((60, 80), np.float32))
    listed = []
    for name, settings in (("electrons", ELECTRONS), ("measured", MEASURED)):
        config, output = folder / f"{name}.toml", folder / name
        config.write_text(FLIGHT + settings, encoding="utf-8")
        command = ["export", "-o", str(output), "-c", str(config), "--frames", "1", "--start", "20", "--quiet"]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        listed += list(gs.read_truth(output))
    return listed


def keys_of_frame(line: dict[str, Any]) -> list[str]:
    keys = []
    for key, value in line.items():
        keys.append(key)
        if key in OBJECTS - OF_CONFIG:
            keys += [f"{key}.{name}" for name in value]
    return keys


def keys_by_kind(lines: list[dict[str, Any]]) -> dict[str, list[list[str]]]:
    return {
        "frame": [keys_of_frame(line) for line in lines],
        "star": [list(star) for line in lines for star in line["stars"]],
        "body": [list(body) for line in lines for body in line.get("bodies", ())],
        "satellite": [list(satellite) for line in lines for satellite in line.get("satellites", ())],
    }


@pytest.mark.parametrize("of", ["frame", "star", "body", "satellite"])
def test_exports_have_the_keys_of_the_table_in_its_order_and_no_others(lines: list[dict[str, Any]], of: str) -> None:
    # Of a live link, whose frames `tests/link/test_mavlinkcamera.py` reads.
    names = [column.name for column in columns_of(of) if "mavlink-camera" not in column.when]
    always = {column.name for column in columns_of(of) if not column.when}
    entries = keys_by_kind(lines)[of]
    assert set(names) == set().union(*entries)
    for keys in entries:
        assert always <= set(keys)
        assert keys == [name for name in names if name in keys]


def test_labels_and_scores_copy_keys_of_the_table() -> None:
    assert set(COPIED) <= {column.name for column in (*columns_of("star"), *columns_of("body"))}
    assert set(CONDITIONS) <= {column.name for column in columns_of("frame")}
