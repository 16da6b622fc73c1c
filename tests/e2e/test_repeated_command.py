"""The command in a manifest, run as it is printed, writes the same files."""

import shlex
from pathlib import Path

import pytest

from glstar.cli.concepts import CONCEPTS
from glstar.config import Config
from glstar.config.keys import KEY_FLAGS
from tests.support.exports import CAMERA, assert_same, done, manifest_of
from tests.support.triggers import dataflash

WATCHED = CAMERA + '[exposure]\nduration_s = 0.1\n[flight.synthetic]\npath = "orbit"\nradius_m = 300\n'
CALIBRATION = CAMERA.replace("150.0", "170.0")


@pytest.mark.parametrize(
    "words",
    [
        ("demo", "--camera", "small.toml", "--mount", "forward-up-30", "--navigator", "ATT", "--masks"),
        ("demo", "--camera", "imx296", "--lens-mm", 6, "--f-number", 2, "--gain", 4, "--exposure", 0.1),
        ("flight.BIN", "-c", "camera.toml", "--at", "camera", "--exif", "--time-offset", 0.5, "--height", 1000),
        ("-c", "watched.toml", "--mount", "back-up-30"),
        ("fly:orbit?radius_m=300", "-c", "camera.toml", "--format", "tiff", "--light", "--start", 1.5),
    ],
    ids=["a mount", "a lens", "a trigger", "a config's flight", "a described flight"],
)
def test_the_printed_command_writes_the_same_files(
    words: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(CALIBRATION, encoding="utf-8")
    Path("camera.toml").write_text(CAMERA, encoding="utf-8")
    Path("watched.toml").write_text(WATCHED, encoding="utf-8")
    dataflash(tmp_path / "flight.BIN")
    wanted = ("--lat", -34.93, "--lon", 138.6, "--frames", 1, "--workers", 1)
    done("export", *words, *(wanted if "flight.BIN" in words else wanted[4:]), "-o", "one")

    program, *printed = shlex.split(manifest_of(Path("one"))["command"])
    assert program == "glstar"
    done(*printed, "-o", "other")

    assert_same(Path("one"), Path("other"))


def test_every_flag_of_a_key_is_one_of_the_command_line() -> None:
    by_key = {concept.key: f"--{concept.flag}" for concept in CONCEPTS if concept.key}
    others = {"camera.file": "--camera", "navigator.attitude": "--navigator"}
    assert dict(KEY_FLAGS) == {key: (by_key | others)[key] for key in KEY_FLAGS}
    assert {key for key in by_key if key.partition(".")[0] in {"camera", "mount", "sensor"}} <= set(KEY_FLAGS)


def test_a_config_knows_which_values_are_not_those_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text('[mount]\npreset = "down"\n[exposure]\nduration_s = 1\n', encoding="utf-8")
    config = Config.load(tmp_path / "config.toml").override(**{"camera.preset": "imx296", "camera.lens_mm": 6})
    assert config.overridden == {"camera.preset": "imx296", "camera.lens_mm": 6}

    # Another camera replaces the lens too.
    again = config.override(**{"camera.preset": "picam2", "mount.preset": "zenith"})
    assert again.overridden == {"camera.preset": "picam2", "mount.preset": "zenith"}
    assert again.without("camera.preset").overridden == {"mount.preset": "zenith"}
