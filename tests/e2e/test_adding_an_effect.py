"""An effect added as a module and one line of a list appears in commands, files and the viewer."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import glstar
from tests.examples import add_an_effect

CONFIG = """\
[camera]
width_px = 320
height_px = 240
fx_px = 150.0
fy_px = 150.0
[sensor]
sky_mean_dn = 50.0
sky_std_dn = 0.0
[vignetting]
strength = 0.5
[sweep.vignetting]
strength = [0.0, 1.0]
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of glstar with vignetting among its effects."""
    root, package = tmp_path_factory.mktemp("checkout"), Path(glstar.__file__).parent
    shutil.copytree(package, root / "glstar", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("shaders", "assets"):
        if not (root / "glstar" / folder).exists():
            (root / folder).symlink_to(package.parent / folder)
    effects = root / "glstar" / "render" / "effects"
    module, _, _ = Path(add_an_effect.__file__).read_text(encoding="utf-8").partition('if __name__ == "__main__":')
    module = module.replace("from glstar.render.effects import EFFECTS, ", "from glstar.render.effects.effect import ")
    (effects / "vignetting.py").write_text(module, encoding="utf-8")
    listed = (effects / "__init__.py").read_text(encoding="utf-8")
    listed = listed.replace("    QUANTISATION,\n", "    QUANTISATION,\n    VIGNETTING,\n")
    last_import = next(
        line + "\n" for line in listed.splitlines() if line.startswith("from glstar.render.effects.stars ")
    )
    listed = listed.replace(last_import, last_import + "from glstar.render.effects.vignetting import VIGNETTING\n")
    (effects / "__init__.py").write_text(listed, encoding="utf-8")
    return root


def python(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=checkout, capture_output=True, text=True, check=False)


def test_an_export_sweeps_the_new_key_and_writes_it_to_manifest_and_truth(checkout: Path) -> None:
    (checkout / "config.toml").write_text(CONFIG, encoding="utf-8")

    done = python(checkout, "-m", "glstar", "export", "--config", "config.toml", "--stop", "1", "-o", "swept")

    assert done.returncode == 0, done.stderr
    truth = [json.loads(line) for line in (checkout / "swept" / "truth.jsonl").read_text().splitlines()]
    assert [line.get("vignetting") for line in truth] == [None, {"strength": 1.0}]
    plain, vignetted = (cv2.imread(str(checkout / "swept" / line["file"]), cv2.IMREAD_UNCHANGED) for line in truth)
    # The sky is added after the transmission; only starlight is dimmed.
    assert np.median(plain) == np.median(vignetted) == 50
    assert plain.sum(dtype=float) > vignetted.sum(dtype=float)
    manifest = json.loads((checkout / "swept" / "manifest.json").read_text())
    assert manifest["config"]["vignetting"] == {"strength": 0.5}


def test_a_value_outside_the_declared_limits_is_refused_with_the_declared_message(checkout: Path) -> None:
    (checkout / "wrong.toml").write_text("[vignetting]\nstrength = 2.0\nstrenght = 1.0\n", encoding="utf-8")

    refused = python(checkout, "-m", "glstar", "export", "--config", "wrong.toml", "-o", "wrong")

    assert refused.returncode == 1
    message = " ".join(refused.stderr.split())
    assert "vignetting.strength: must be a number from 0 (off) to 1 (cos^4), not 2.0" in message
    assert "did you mean strength?" in message


def test_a_config_is_read_back_from_the_toml_that_it_writes(checkout: Path) -> None:
    code = (
        "from pathlib import Path\n"
        "from glstar.config import Config\n"
        "config = Config().override(**{'vignetting.strength': 0.25})\n"
        "Path('written.toml').write_text(config.to_toml())\n"
        "assert Config.load('written.toml') == config != Config() == Config.load('empty.toml')\n"
        "assert config.sensor().effects == {'vignetting.strength': 0.25}\n"
    )
    (checkout / "empty.toml").touch()
    done = python(checkout, "-c", code)

    assert done.returncode == 0, done.stderr
