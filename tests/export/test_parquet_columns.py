"""Columns of the Parquet tables that only some exports have."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.errors import ExportError
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

parquet = pytest.importorskip("pyarrow.parquet")
write_parquet = import_module("glstar.export.truth.parquet").write_parquet  # which needs pyarrow
ROLLING = {"mid_offset_s", "exposed_s", "light_dn"}
FRAMES_PER_GROUP = 256


def tables(directory: Path) -> list[Any]:
    return [parquet.read_table(path) for path in write_parquet(directory)]


@pytest.fixture(scope="module")
def plain_line() -> dict[str, Any]:
    simulator = sky_over_adelaide(camera(240, 180, 967.7425), vmag_limit=6.0)
    with GLRenderer.headless() as renderer:
        scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.4, 0.1))
        line: dict[str, Any] = orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="0.png"))
    assert len(line["stars"]) > 3
    return line


def write_lines(directory: Path, lines: list[dict[str, Any]]) -> None:
    directory.joinpath("truth.jsonl").write_bytes(b"".join(orjson.dumps(line) + b"\n" for line in lines))


@pytest.mark.parametrize("readouts_s", [(0.0, 0.03), (0.0, 0.0)])
def test_the_times_of_a_rolling_shutter_are_columns_if_any_frame_has_one(
    tmp_path: Path, readouts_s: tuple[float, float]
) -> None:
    simulator = sky_over_adelaide(camera(240, 180, 967.7425), vmag_limit=6.0, roll_rate_rad_per_s=np.deg2rad(5.0))
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.1)
    with GLRenderer.headless() as renderer, (tmp_path / "truth.jsonl").open("wb") as truth:
        for number, readout_s in enumerate(readouts_s):
            scene = simulator.scene(replace(exposure, readout_s=readout_s))
            truth.write(frame_truth(scene, renderer.render(scene, seed=0), number=number, file=f"{number}.png"))
    lines = [orjson.loads(line) for line in (tmp_path / "truth.jsonl").read_bytes().splitlines()]

    frames, stars = tables(tmp_path)

    is_rolling = max(readouts_s) > 0
    assert ROLLING.issubset(stars.column_names) == is_rolling
    assert {"readout_s", "readout", "rates_rad_per_s"}.issubset(frames.column_names) == is_rolling
    expected = [star for line in lines for star in line["stars"]]
    assert len(expected) > 0
    for name in ROLLING if is_rolling else ():
        assert stars[name].to_pylist() == [star.get(name) for star in expected]
        assert stars[name].null_count < len(expected)
    for name in ("readout_s", "readout", "rates_rad_per_s") if is_rolling else ():
        assert frames[name].to_pylist() == [line.get(name) for line in lines]


def test_every_key_of_the_truth_is_a_column(tmp_path: Path, plain_line: dict[str, Any]) -> None:
    sensor = {"noise": "electrons", "black_level_dn": 256, "gain": {"db": 3.5}}
    segments = [[[1.5, 2.5], None], [[3.5, 4.5], [5.5, 6.5]]]
    stars = [star | {"flux_e": 7.5, "segments": segments} for star in plain_line["stars"]]
    moon = {
        "name": "Moon",
        "vmag": -11.0,
        "x_px": 1.5,
        "y_px": None,
        "start": [1.0, 2.0],
        "end": None,
        "diameter_px": 9,
    }
    lines = [plain_line | {"frame": number} for number in range(FRAMES_PER_GROUP)]
    lines += [plain_line | {"frame": FRAMES_PER_GROUP, "stars": stars, "sensor": sensor, "sky_fraction": 1}]
    lines += [plain_line | {"frame": FRAMES_PER_GROUP + 1, "sky_fraction": 0.25, "bodies": [moon]}]
    write_lines(tmp_path, lines)

    frames, star_table, bodies = tables(tmp_path)

    last = frames.to_pylist()[-3:]
    assert [row["sky_fraction"] for row in last] == [None, 1.0, 0.25]
    assert [row["sensor_noise"] for row in last] == [None, "electrons", None]
    assert (last[1]["sensor_black_level_dn"], last[1]["sensor_gain_db"]) == (256, 3.5)
    assert frames.num_rows == len(lines)
    of_sensor = [row for row in star_table.to_pylist() if row["flux_e"] is not None]
    assert [row["segments"] for row in of_sensor] == [segments] * len(stars)
    assert {row["frame"] for row in of_sensor} == {FRAMES_PER_GROUP}
    assert star_table.num_rows == len(lines) * len(stars)
    (row,) = bodies.to_pylist()
    assert row == {
        "frame": FRAMES_PER_GROUP + 1,
        "name": "Moon",
        "x_px": 1.5,
        "y_px": None,
        "vmag": -11.0,
        "diameter_px": 9,
        "start_x_px": 1.0,
        "start_y_px": 2.0,
        "end_x_px": None,
        "end_y_px": None,
    }


def test_tables_of_bodies_that_are_no_longer_there_are_removed(tmp_path: Path, plain_line: dict[str, Any]) -> None:
    satellite = {"name": "ISS", "satellite_number": 25544, "start": None, "end": None, "x_px": None, "y_px": None}
    write_lines(tmp_path, [plain_line | {"satellites": [satellite]}])
    assert [path.name for path in write_parquet(tmp_path)] == ["frames.parquet", "stars.parquet", "satellites.parquet"]
    write_lines(tmp_path, [plain_line | {"satellites": []}])

    write_parquet(tmp_path)

    assert sorted(path.name for path in tmp_path.glob("*.parquet")) == ["frames.parquet", "stars.parquet"]


def test_values_without_a_common_type_are_refused(tmp_path: Path, plain_line: dict[str, Any]) -> None:
    write_lines(
        tmp_path, [plain_line | {"frame": k} for k in range(FRAMES_PER_GROUP)] + [plain_line | {"seed_of": [1]}]
    )
    lines = orjson.loads((tmp_path / "truth.jsonl").read_bytes().splitlines()[0]) | {"seed_of": "text"}
    text = orjson.dumps(lines) + b"\n" + (tmp_path / "truth.jsonl").read_bytes()
    (tmp_path / "truth.jsonl").write_bytes(text)

    with pytest.raises(ExportError, match="seed_of"):
        write_parquet(tmp_path)

    assert not list(tmp_path.glob("*.parquet"))
