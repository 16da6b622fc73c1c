"""``[camera] camera``: one camera of a file with several."""

from pathlib import Path

import pytest

from glstar.camera.camerafile import camera_from_file
from glstar.config import Config
from glstar.errors import ConfigError

CAMCHAIN = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [900.0, 900.0, 399.5, 299.5]
  resolution: [800, 600]
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [700.0, 700.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def loaded(folder: Path, *lines: str) -> Config:
    (folder / "camchain.yaml").write_text(CAMCHAIN, encoding="utf-8")
    (folder / "c.toml").write_text("\n".join(["[camera]", *lines]), encoding="utf-8")
    return Config.load(folder / "c.toml")


def test_a_camera_of_a_file_with_several_is_named_in_the_config(tmp_path: Path) -> None:
    config = loaded(tmp_path, 'file = "camchain.yaml"', 'camera = "cam1"')

    assert config.camera() == camera_from_file(tmp_path / "camchain.yaml", "cam1")
    assert config.camera().fx_px == 700.0


def test_a_saved_config_has_the_numbers_and_the_name_as_a_comment(tmp_path: Path) -> None:
    config = loaded(tmp_path, 'file = "camchain.yaml"', 'camera = "cam1"')
    (tmp_path / "elsewhere").mkdir()
    saved = tmp_path / "elsewhere" / "saved.toml"

    saved.write_text(config.to_toml(), encoding="utf-8")

    assert '# from camera = "cam1"' in saved.read_text(encoding="utf-8")
    assert Config.load(saved).camera() == config.camera()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (('camera = "cam1"',), "give camera.file too"),
        (('file = "other.toml"', 'camera = "cam1"'), "give camera.file too"),
        (('file = "camchain.yaml"', 'camera = "cam7"'), "holds cam0, cam1, and no camera named"),
        (('file = "camchain.yaml"',), 'set camera = "cam0" beside file'),
    ],
)
def test_a_name_without_its_camera_is_refused(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(tmp_path, *lines)
