"""Regression test of what people read: outputs of commands, word for word, as once inspected.

``poe golden`` writes the files of ``texts`` again; read their difference.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import glstar
from glstar.cli import app
from tests.support.satellites import HIGHER, PASS, elements

HERE = Path(__file__).parent
AT = "--lat -34.93 --lon 138.6 --utc 2024-03-18T10:37:40Z --dut1 -0.009"
ORBIT = "fly:orbit?gusts=light&duration_s=20&utc_start=2024-03-10T11:00:00Z"
SPIN = "fly:spin?duration_s=5&utc_start=2025-06-02T21:05:00Z"
CAMERA = """image_width: 640
image_height: 400
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [412.5, 0.3, 318.25, 0, 410.75, 203.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.21, 0.04, 0.001, -0.002, 0.003]}
"""
# Commands, in their order, whose outputs make one text, by its name.
COMMANDS = {
    "flights": (f"info demo {ORBIT} {SPIN}", f"info {ORBIT}", "info demo", "info -c moonlit-town.toml --json"),
    "sky": (
        f"sky {AT} --vmag 1.2",
        f"sky {AT} --bodies",
        f"sky {AT} --satellites passes.tle",
        f"sky {AT} --star-id 2491 --star-id 424 --all --astrometry erfa --pressure 905 --temperature -3",
        f"sky {AT} --bodies --height 2300 --pressure 0",
    ),
    "settings": (
        "config -c moonlit-town.toml",
        "config --changed -c cloud-and-flare.toml",
        "camera presets",
        "camera show camera.yaml",
        "score --gate example",
    ),
    "sets": (
        "export -c compared.toml --frames 4 -o frames --masks --card --seed 3 --quiet",
        "convert frames -o yolo --to yolo",
        f"convert {SPIN} -o spin.csv",
        "score frames answers.jsonl",
        "score frames answers.jsonl --json",
        "info frames",
    ),
}
FILES = {"sets": ("frames/DATACARD.md", "yolo/data.yaml", "spin.csv")}
# Longest part of a file that is kept, characters.
LONGEST = 6000


def answers(truth: Path) -> str:
    """Return answers to frames, of which each has errors of its own."""
    lines = []
    for k, text in enumerate(truth.read_text(encoding="utf-8").splitlines()):
        frame = json.loads(text)
        C = np.array(frame["C_camera_icrs"])
        axis = C[2] + 2e-4 * k * C[0]
        answer = {
            "frame": frame["frame"],
            "ra_deg": float(np.rad2deg(np.arctan2(axis[1], axis[0]))),
            "dec_deg": float(np.rad2deg(np.arcsin(axis[2] / np.linalg.norm(axis)))),
            "roll_deg": float(np.rad2deg(np.arctan2(*up_and_east(C)))) + 0.05 * k,
            "latitude_deg": frame["site"]["latitude_deg"] + 0.01 * k,
            "longitude_deg": frame["site"]["longitude_deg"] - 0.02,
            "ellipse_major_km": 3.0,
            "ellipse_minor_km": 1.5,
            "ellipse_azimuth_deg": 20.0 * k,
            "time_ms": 12.5 * (k + 1),
            "stars": [
                [star["centroid_x_px"] + 0.3, star["centroid_y_px"] - 0.2 * k, star["star_id"] + (n == 3)]
                for n, star in enumerate(frame["stars"][: 9 - k])
            ],
        }
        lines.append(json.dumps(answer | ({"status": "refused"} if k == 3 else {})))
    return "\n".join(lines) + "\n"


def up_and_east(C_camera_icrs: np.ndarray) -> tuple[float, float]:
    """Return the components of the image's up along east and north, whose angle is the position angle."""
    x, y = C_camera_icrs[2, :2]
    east = np.array([-y, x, 0.0]) / np.hypot(x, y)
    north = np.cross(C_camera_icrs[2], east)
    return -C_camera_icrs[1] @ east, -C_camera_icrs[1] @ north


def read_text(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    return text if len(text) <= LONGEST else text[: LONGEST // 2] + "\n...\n" + text[-LONGEST // 2 :]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_says_what_was_inspected(name, request, tmp_path, monkeypatch):
    for path in (*HERE.glob("scenes/*.toml"), HERE / "compared.toml"):
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "passes.tle").write_text(elements(PASS, *HIGHER), encoding="utf-8")
    (tmp_path / "camera.yaml").write_text(CAMERA, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    said = []
    for command in COMMANDS[name]:
        if "answers.jsonl" in command:
            (tmp_path / "answers.jsonl").write_text(answers(tmp_path / "frames" / "truth.jsonl"), encoding="utf-8")
        result = CliRunner().invoke(app, command.split())
        said += [f"$ glstar {command}", *result.output.splitlines(), f"status {result.exit_code}", ""]
    for file in FILES.get(name, ()):
        said += [f"# {file}", *read_text(tmp_path / file).splitlines(), ""]
    text = "\n".join(line.rstrip() for line in said)
    for local, word in (
        (str(Path(glstar.__file__).parents[1]), "CHECKOUT"),
        (str(tmp_path), "FOLDER"),
        (glstar.__version__, "VERSION"),
    ):
        text = text.replace(local, word)
    text = re.sub(r"-?\d+\.\d{7,}(e-?\d+)?", lambda number: f"{round(float(number[0]), 9):.6g}", text)
    text = re.sub(r"drawn in \d+\.\d s", "drawn in N s", text)
    golden = HERE / "texts" / f"{name}.txt"
    if request.config.getoption("--regenerate-golden"):
        golden.write_text(text, encoding="utf-8", newline="\n")

    assert text.splitlines() == golden.read_text(encoding="utf-8").splitlines()
