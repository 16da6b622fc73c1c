"""Mounts by name: where each points, in files, on the command line, in messages, and beside angles."""

import json
import re
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.model import Mount
from glstar.camera.mounts import MOUNTS, mount_by_name, mount_label
from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.system.resources import manual_pages

C30, S30 = cos(radians(30)), sin(radians(30))
# Optical axis, right and bottom of the image, in body axes: forward, right, down.
FORWARD, RIGHT, DOWN = np.eye(3)
AXES = {
    "zenith": (-DOWN, FORWARD, -RIGHT),
    "down": (DOWN, RIGHT, -FORWARD),
    "nose": (FORWARD, RIGHT, DOWN),
    "right": (RIGHT, -FORWARD, DOWN),
    "left": (-RIGHT, FORWARD, DOWN),
    "tail": (-FORWARD, -RIGHT, DOWN),
    "forward-up-30": (C30 * FORWARD - S30 * DOWN, RIGHT, S30 * FORWARD + C30 * DOWN),
    "right-up-30": (C30 * RIGHT - S30 * DOWN, -FORWARD, S30 * RIGHT + C30 * DOWN),
    "left-up-30": (-C30 * RIGHT - S30 * DOWN, FORWARD, -S30 * RIGHT + C30 * DOWN),
    "back-up-30": (-C30 * FORWARD - S30 * DOWN, -RIGHT, -S30 * FORWARD + C30 * DOWN),
    "forward-down-30": (C30 * FORWARD + S30 * DOWN, RIGHT, -S30 * FORWARD + C30 * DOWN),
}


def config_of(tmp_path: Path, text: str) -> Config:
    path = tmp_path / "mount.toml"
    path.write_text(f"[mount]\n{text}\n", encoding="utf-8")
    return Config.load(path)


@pytest.mark.parametrize("name", AXES)
def test_a_named_mount_points_where_its_name_says(name: str) -> None:
    axis, right, bottom = AXES[name]

    mount = Config().override(**{"mount.preset": name}).mount()

    np.testing.assert_allclose(mount.C_camera_body, [right, bottom, axis], rtol=0, atol=1e-12)
    assert mount_label(mount) == f"{name} mount"


def test_every_name_is_tested_and_on_the_page_of_the_manual() -> None:
    assert set(AXES) == set(MOUNTS)
    page = manual_pages()["mounts"].read_text(encoding="utf-8")
    assert set(MOUNTS) <= set(re.findall(r"`([\w-]+)`", page))


def test_the_angle_of_a_name_may_be_any(tmp_path: Path) -> None:
    mount = config_of(tmp_path, 'preset = "left-up-22.5"').mount()

    np.testing.assert_allclose(
        mount.C_camera_body[2], [0, -cos(radians(22.5)), -sin(radians(22.5))], rtol=0, atol=1e-12
    )
    assert mount_label(mount) == "left-up-22.5 mount"
    assert mount_label(Mount(yaw_rad=radians(12), pitch_rad=radians(40))) == "mount of yaw 12, pitch 40, roll 0 deg"


@pytest.mark.parametrize("name", ["forward-up-0", "forward-up-90", "nose-up-10", "zenit", "up"])
def test_an_unknown_mount_is_refused_with_the_names(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"'{name}' is no mount.*mounts are zenith, down, nose"):
        Config().override(**{"mount.preset": name})


def test_a_name_beside_angles_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has preset and pitch_deg; give a preset or angles"):
        config_of(tmp_path, 'preset = "nose"\npitch_deg = 10')


def test_a_name_on_the_command_line_replaces_the_angles_of_the_file(tmp_path: Path) -> None:
    file = config_of(tmp_path, "yaw_deg = 0\npitch_deg = 10\ngimbal = 'level'")

    mount = file.override(**{"mount.preset": "left"})

    assert mount.resolved()["mount"]["pitch_deg"] == 0.0
    assert mount.resolved()["mount"]["gimbal"] == "level"
    assert mount_label(mount.mount()) == "left mount"


def test_an_angle_set_later_turns_the_camera_from_its_named_mount(tmp_path: Path) -> None:
    turned = config_of(tmp_path, 'preset = "forward-up-30"').override(**{"mount.yaw_deg": 5.0})

    keys = turned.resolved()["mount"]
    assert (keys["yaw_deg"], keys["pitch_deg"], keys["roll_deg"]) == (5.0, 30.0, 0.0)
    assert "preset" not in keys


def test_a_config_written_out_has_the_mount(tmp_path: Path) -> None:
    named = config_of(tmp_path, 'preset = "back-up-30"')
    again = tmp_path / "again.toml"
    again.write_text(named.to_toml(), encoding="utf-8")

    assert Config.load(again).mount() == named.mount()


def test_a_sweep_varies_the_mount(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text('[mount]\npitch_deg = 10\n[sweep]\nmount.preset = ["zenith", "left-up-30"]\n', encoding="utf-8")

    config = Config.load(path)

    labels = [mount_label(config.at({"mount.preset": name}).mount()) for name in ("zenith", "left-up-30")]
    assert labels == ["zenith mount", "left-up-30 mount"]


def test_config_shows_the_angles_and_their_origin() -> None:
    shown = CliRunner().invoke(app, ["config", "--mount", "nose", "--changed", "--json"])

    mount = json.loads(shown.stdout)["mount"]
    assert mount["pitch_deg"] == {"value": 0.0, "from": "--mount nose"}
    assert mount["preset"] == {"value": "nose", "from": "--mount"}


def test_the_warning_of_frames_of_the_ground_names_the_mount(tmp_path: Path) -> None:
    words = ["export", "demo", "--mount", "down", "-o", str(tmp_path / "frames"), "--frames", "1", "--dry-run"]

    noted = CliRunner().invoke(app, words).stderr

    assert "camera points below the horizon (down mount): --mount or [mount] says" in noted


@pytest.mark.parametrize(("side", "yaw_deg"), [("forward", 0.0), ("right", 90.0), ("left", -90.0), ("back", 180.0)])
@pytest.mark.parametrize(("sense", "sign"), [("up", 1), ("down", -1)])
def test_a_direction_with_an_elevation_is_a_mount(side: str, yaw_deg: float, sense: str, sign: int) -> None:
    named = mount_by_name(f"{side}-{sense}-89.5")
    assert (named.yaw_deg, named.pitch_deg, named.roll_deg) == (yaw_deg, sign * 89.5, 0)
    assert (named.points, named.image) == (f"{side}, 89.5 deg {sense}", "")
    mount = Mount(0.0, radians(sign * 12.5), radians(yaw_deg))
    assert mount_label(mount) == f"{side}-{sense}-12.5 mount"
    # A millionth of a degree is the same mount, and two are not.
    for off_deg, label in ((0.9e-6, f"{side}-{sense}-12.5 mount"), (1.2e-6, "mount of yaw")):
        turned = Mount(radians(off_deg), radians(sign * 12.5), radians(yaw_deg))
        assert mount_label(turned).startswith(label)


def test_the_label_of_a_literal_mount_has_its_angles() -> None:
    assert mount_label(Mount(0.0, 0.0, 0.0)) == "nose mount"
    assert mount_label(Mount(0.1, 0.2, -0.3, "literal")) == "mount of yaw -17.19, pitch 11.46, roll 5.73 deg"
    with pytest.raises(ConfigError) as caught:
        mount_by_name("zenit")
    assert str(caught.value) == (
        f"'zenit' is no mount (did you mean zenith?); mounts are {', '.join(MOUNTS)}, and forward, right, left or back"
        " with -up- or -down- and an angle of 0 to 90 deg"
    )
    with pytest.raises(ConfigError, match=r"^'q' is no mount; mounts are zenith"):
        mount_by_name("q")
