"""Columns of the Parquet tables that only some exports have."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.render.opengl import GLRenderer
from glstar.render.truth import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

parquet = pytest.importorskip("pyarrow.parquet")
write_parquet = import_module("glstar.export.parquet").write_parquet  # which needs pyarrow
ROLLING = {"mid_offset_s", "exposed_s", "light_dn"}


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

    frames, stars = (parquet.read_table(path) for path in write_parquet(tmp_path))

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
