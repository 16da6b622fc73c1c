"""What the manual's page *extending* adds passes the project's checks and works, in a copy of the checkout."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support import extensions

CONFIG = """\
[camera]
width_px = 320
height_px = 240
fx_px = 150.0
fy_px = 150.0
[sensor]
sky_mean_dn = 50.0
sky_std_dn = 0.0
[pane]
refractive_index = 1.5
[sweep.pane]
refractive_index = [1.0, 2.0]
"""
QUADLOG = "QUADLOG 1710068400.0 -34.93 138.60 300.0\n" + "".join(f"{t / 25:.2f},0.0,2.0,{t / 5}\n" for t in range(250))
# Tests of the tables that the page adds to, and of the shape of the code.
TESTS = (
    *("tests/project/test_house.py", "tests/project/test_architecture_page.py"),
    *("tests/viewer/test_keys.py", "tests/config/test_config_page.py", "tests/score/test_metrics.py"),
)


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a copy of the checkout with everything on the page, and the paths of the Python files that it changed."""
    root = extensions.copy_of_checkout(tmp_path_factory.mktemp("checkout"))
    changed = extensions.extend(root)
    python(root, "-m", "tests.scripts.make_config_page")
    return root, changed


@pytest.fixture(scope="module")
def checkout(added: tuple[Path, list[str]]) -> Path:
    return added[0]


def python(checkout: Path, *arguments: str) -> str:
    """Run Python in the copy and return what it prints; a failure is an error."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "COLUMNS": "200"}
    process = subprocess.run(
        [sys.executable, *arguments], cwd=checkout, env=environment, capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stdout[-4000:] + process.stderr[-4000:]
    return process.stdout


def test_the_page_adds_an_effect_a_log_format_an_overlay_a_lens_and_a_metric(
    added: tuple[Path, list[str]],
) -> None:
    _, changed = added

    assert changed == [
        "glstar/camera/distortion.py",
        "glstar/render/effects/__init__.py",
        "glstar/render/effects/pane.py",
        "glstar/score/metrics.py",
        "glstar/telemetry/formats.py",
        "glstar/telemetry/quadlog.py",
        "glstar/viewer/overlays/table.py",
        "glstar/viewer/overlays/zenith.py",
    ]


def test_the_code_passes_the_linter_and_the_formatter(added: tuple[Path, list[str]]) -> None:
    root, changed = added

    python(root, "-m", "ruff", "check", *changed)
    python(root, "-m", "ruff", "format", "--check", *changed)


@pytest.mark.timeout(600)
def test_the_code_passes_the_type_checker(added: tuple[Path, list[str]]) -> None:
    root, changed = added
    if (extensions.ROOT / ".mypy_cache").is_dir():  # saves a minute
        shutil.copytree(extensions.ROOT / ".mypy_cache", root / ".mypy_cache", dirs_exist_ok=True)

    # Without the packages of pyproject.toml: only these files are reported.
    settings = (root / "pyproject.toml").read_text(encoding="utf-8").replace('packages = ["glstar"]\n', "")
    (root / "pyproject.toml").write_text(settings, encoding="utf-8")
    python(root, "-m", "mypy", "--follow-imports=silent", *changed)


def test_the_tests_of_the_tables_and_of_the_layers_pass(checkout: Path) -> None:
    # The limit of all modules is one of glstar's own, not of those that are added to it.
    python(checkout, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "not whole_package", *TESTS)
    assert "0 broken" in python(checkout, "-c", "from importlinter.cli import lint_imports_command as run; run()")


def test_an_export_sweeps_the_key_of_the_effect_and_writes_it_to_manifest_and_truth(checkout: Path) -> None:
    (checkout / "config.toml").write_text(CONFIG, encoding="utf-8")

    python(checkout, "-m", "glstar", "export", "--config", "config.toml", "--stop", "1", "-o", "swept")

    truth = [json.loads(line) for line in (checkout / "swept" / "truth.jsonl").read_text().splitlines()]
    assert [line.get("pane") for line in truth] == [None, {"refractive_index": 2.0}]
    plain, behind = (cv2.imread(str(checkout / "swept" / line["file"]), cv2.IMREAD_UNCHANGED) for line in truth)
    # The sky is added after the transmission; only starlight is dimmed.
    assert np.median(plain) == np.median(behind) == 50
    assert plain.sum(dtype=float) > behind.sum(dtype=float)
    manifest = json.loads((checkout / "swept" / "manifest.json").read_text())
    assert manifest["config"]["pane"] == {"refractive_index": 1.5}


def test_a_value_of_the_effect_outside_its_limits_is_refused_with_its_message(checkout: Path) -> None:
    (checkout / "wrong.toml").write_text("[pane]\nrefractive_index = 9.0\nrefractive_idnex = 1.0\n", encoding="utf-8")

    code = (
        "import glstar as gs\ntry:\n    gs.Config.load('wrong.toml')\nexcept gs.ConfigError as error:\n    print(error)"
    )
    message = python(checkout, "-c", code)

    assert "pane.refractive_index: must be a number from 1 (no pane) to 3, not 9.0" in message
    assert "did you mean refractive_index?" in message


def test_a_config_with_the_effect_is_read_back_from_the_toml_that_it_writes(checkout: Path) -> None:
    python(
        checkout,
        "-c",
        "from pathlib import Path\n"
        "from glstar.config import Config\n"
        "config = Config().override(**{'pane.refractive_index': 1.25})\n"
        "Path('written.toml').write_text(config.to_toml())\n"
        "Path('empty.toml').touch()\n"
        "assert Config.load('written.toml') == config != Config() == Config.load('empty.toml')\n"
        "assert config.sensor().effects == {'pane.refractive_index': 1.25}\n",
    )


def test_a_log_of_the_format_is_described_and_a_damaged_one_is_refused(checkout: Path) -> None:
    (checkout / "flight.quadlog").write_text(QUADLOG, encoding="utf-8")
    (checkout / "damaged.quadlog").write_text(QUADLOG + "10.0,0.0,two\n", encoding="utf-8")

    facts = json.loads(python(checkout, "-m", "glstar", "info", "flight.quadlog", "--json"))

    assert (facts["format"], facts["attitude_source"]) == ("Quadlog", "QUADLOG, 25.0 Hz")
    code = (
        "import glstar as gs\n"
        "try:\n    gs.Config().open_flight('damaged.quadlog')\n"
        "except gs.LogFormatError as error:\n    print(error)"
    )
    assert "damaged.quadlog: is a damaged Quadlog: " in python(checkout, "-c", code)


def test_the_overlay_is_drawn_in_the_window(checkout: Path) -> None:
    """In the first seconds of the bundled flight the aircraft is level, and its camera points at the zenith."""
    pictures = []
    for show in ("zenith", "nothing"):
        picture = str(checkout / f"{show}.png")
        view = ["view", "--headless", "--start", "5", "--show", show, "--screenshot", picture, "--exit"]
        python(checkout, "-m", "glstar", *view)
        pictures.append(cv2.imread(picture).astype(int))

    with_zenith, without = pictures
    blue, green, red = np.moveaxis(with_zenith - without, -1, 0)
    assert 50 < np.count_nonzero((blue > 60) & (green > 50) & (red > 40)) < 5000  # pixels of the ring and the word


def test_the_lens_model_is_valid_in_a_config_and_draws(checkout: Path) -> None:
    camera = '[camera]\nwidth_px = 320\nheight_px = 240\nfx_px = 150.0\nfy_px = 150.0\nlens = "stereographic"\n'
    (checkout / "lens.toml").write_text(camera, encoding="utf-8")

    code = (
        "from glstar.config import Config\n"
        "x_px, y_px = Config.load('lens.toml').camera().project([1.0, 0.0, 1.0])\nprint(float(x_px), float(y_px))"
    )
    x_px, y_px = map(float, python(checkout, "-c", code).split())
    python(checkout, "-m", "glstar", "export", "-c", "lens.toml", "--frames", "1", "-o", "stereographic")

    assert (x_px, y_px) == pytest.approx((159.5 + 300 * np.tan(np.pi / 8), 119.5))
    truth = json.loads((checkout / "stereographic" / "truth.jsonl").read_text())
    assert truth["camera"]["lens"] == "stereographic"
    assert truth["stars"]


def test_the_sensor_is_a_preset_once_it_is_appended_to_those_of_glstar(checkout: Path) -> None:
    page = extensions.PAGE.read_text(encoding="utf-8")
    table = re.search(r"^```toml\n# sensors.toml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert table is not None
    with (checkout / "assets" / "sensors.toml").open("a", encoding="utf-8") as file:
        file.write("\n" + table[1])

    assert "ZWO ASI178MM" in python(checkout, "-m", "glstar", "camera", "presets", "asi178:1548x1040")


def test_the_metric_is_part_of_every_summary(checkout: Path) -> None:
    code = (
        "from types import SimpleNamespace as Of\n"
        "from glstar.score.metrics import METRICS, Group\n"
        "metric = next(one for one in METRICS if one.json_key == 'wrong_stars')\n"
        "scores = [Of(stars=Of(identified=number, correct=3)) for number in (3, 8)]\n"
        "print(metric.summarized(Group([], scores)), metric.summarized(Group([], [])))"
    )

    assert python(checkout, "-c", code).split() == ["2.5", "None"]
