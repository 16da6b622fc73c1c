"""Sets of strangers: nothing is converted but files below their directory."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ExportError
from glstar.export.truth.lines import is_inside, read_truth

RUNNER = CliRunner()
CONFIG = """
[camera]
width_px = 40
height_px = 30
fx_px = 40.0
fy_px = 40.0
[sky]
vmag_limit = 3.0
"""
# Of each format that reads images, where it goes.
TARGETS = {
    "coco": "c.json",
    "yolo": "yolo",
    "webdataset": "shards",
    "mcap": "set.mcap",
    "ros2": "bag",
    "png": "png",
    "jpeg": "jpeg",
}
OUTSIDE = [
    *("../secret.png", "/etc/hostname", "a/../../secret.png"),
    *("..\\secret.png", "C:\\secret.png", "C:x.png", "", "a\0b"),
]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strangers")
    (folder / "small.toml").write_text(CONFIG)
    words = ["export", "fly:still", "-c", str(folder / "small.toml"), "-o", str(folder / "set"), "--frames", "2"]
    made = RUNNER.invoke(app, [*words, "--masks", "--workers", "1"])
    assert made.exit_code == 0, made.output
    return folder / "set"


@pytest.fixture
def stranger(exported: Path, tmp_path: Path) -> Path:
    shutil.copytree(exported, tmp_path / "set")
    (tmp_path / "secret.png").write_bytes((exported / "frame_000000.png").read_bytes())
    return tmp_path / "set"


def named(stranger: Path, name: Any) -> None:
    """Let the second line of truth name another image."""
    first, second = (json.loads(line) for line in (stranger / "truth.jsonl").read_text().splitlines())
    (stranger / "truth.jsonl").write_text(json.dumps(first) + "\n" + json.dumps({**second, "file": name}) + "\n")


@pytest.mark.parametrize("kind", TARGETS)
@pytest.mark.parametrize("name", OUTSIDE[:3])
def test_an_image_outside_of_the_set_is_not_converted(kind: str, name: str, stranger: Path, tmp_path: Path) -> None:
    named(stranger, name)

    run = RUNNER.invoke(app, ["convert", str(stranger), "--to", kind, "-o", str(tmp_path / TARGETS[kind])])

    assert run.exit_code == 1
    assert "line 2 names the image" in run.output.replace("\n", " ")
    assert "which is not below its directory" in run.output.replace("\n", " ")


@pytest.mark.parametrize("name", [*OUTSIDE, 7, None, ["frame_000001.png"], True])
def test_a_truth_that_names_an_image_elsewhere_is_refused(name: Any, stranger: Path) -> None:
    named(stranger, name)

    with pytest.raises(ExportError, match=r"line 2 names the image .* which is not below its directory"):
        list(read_truth(stranger))


@pytest.mark.parametrize("name", ["frame_000001.png", "frames_010000/frame_010000.png", "a b/..c.png", "x..y"])
def test_names_below_the_directory_are_taken(name: str) -> None:
    assert is_inside(name)


@pytest.mark.parametrize("kind", TARGETS)
@pytest.mark.parametrize("link", ["frame_000001.png", "frame_000001.trails.png", "other.png"])
def test_a_link_in_place_of_a_file_is_not_followed(kind: str, link: str, stranger: Path, tmp_path: Path) -> None:
    if link == "other.png":
        named(stranger, link)
    (stranger / link).unlink(missing_ok=True)
    (stranger / link).symlink_to(tmp_path / "secret.png")

    run = RUNNER.invoke(app, ["convert", str(stranger), "--to", kind, "-o", str(tmp_path / TARGETS[kind])])

    assert run.exit_code == 1
    assert "is a symbolic link" in run.output.replace("\n", " ")


def test_what_a_navigator_does_to_its_images_leaves_those_of_the_truth_alone(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(CONFIG)
    words = ["export", "fly:still", "-c", str(tmp_path / "small.toml"), "-o", str(tmp_path / "set"), "--frames", "1"]
    made = RUNNER.invoke(app, [*words, "--blind", str(tmp_path / "truth"), "--workers", "1"])
    assert made.exit_code == 0, made.output
    before = (tmp_path / "truth" / "frame_000000.png").read_bytes()

    with (tmp_path / "set" / "frame_000000.png").open("r+b") as image:
        image.write(b"spoiled")

    assert (tmp_path / "truth" / "frame_000000.png").read_bytes() == before


@pytest.mark.parametrize("kind", ["csv", "coco", "yolo", "webdataset", "mcap", "png", "srt"])
@pytest.mark.parametrize("damage", ['"x_px"', '"duration_s": 0.5', '"vmag": '])
def test_a_truth_with_missing_or_odd_values_is_refused_in_one_line_or_converted(
    kind: str, damage: str, stranger: Path, tmp_path: Path
) -> None:
    truth = stranger / "truth.jsonl"
    text = truth.read_text()
    assert damage in text.replace('":', '": ') or damage in text
    odd = {'"x_px"': '"y_pixels"', '"duration_s": 0.5': '"duration_s": "long"', '"vmag": ': '"vmag": []+'}[damage]
    truth.write_text(text.replace(damage, odd).replace(damage.replace(": ", ":"), odd.replace(": ", ":")))
    target = tmp_path / (TARGETS | {"csv": "csv", "srt": "set.srt"})[kind]

    result = RUNNER.invoke(app, ["convert", str(stranger), "--to", kind, "-o", str(target)])

    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.exit_code in {0, 1}
    if result.exit_code:
        assert result.stderr.startswith(f"glstar: {stranger}")
        assert result.stderr.count("\n") == 1
