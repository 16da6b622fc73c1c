"""Flights in one line wherever a command takes a FLIGHT, and as tables by ``glstar convert``."""

import json
import subprocess
import sys
from pathlib import Path

IN_ONE_LINE = "fly:orbit?radius_m=300&turns=0.2&wind_m_per_s=8&gusts=light&seed=3"


def glstar(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "glstar", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )


def test_a_written_flight_and_its_description_give_the_same_frames(tmp_path: Path) -> None:
    flown = glstar("convert", IN_ONE_LINE, "-o", "orbit.csv", folder=tmp_path)
    assert (flown.returncode, flown.stderr) == (0, "")
    assert flown.stdout.startswith("orbit.csv: ")

    for flight, output in (("orbit.csv", "table"), (IN_ONE_LINE, "described")):
        exported = glstar("export", flight, "-o", output, "--every", "5", "--seed", "1", folder=tmp_path)
        assert (exported.returncode, exported.stderr) == (0, "")

    images = sorted((tmp_path / "table").glob("*.png"))
    assert len(images) > 3
    for image in images:
        assert image.read_bytes() == (tmp_path / "described" / image.name).read_bytes()
    manifest = json.loads((tmp_path / "described" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["flight"]["name"] == IN_ONE_LINE


def test_an_export_of_a_described_flight_is_continued_but_not_with_another_seed(tmp_path: Path) -> None:
    described = "fly:hover?duration_s=3&gusts=moderate"
    for line in ("2 frames drawn", "0 frames drawn"):
        again = glstar("export", described, "-o", "out", "--every", "2", folder=tmp_path)
        assert again.stdout.startswith(line)

    other = glstar("export", f"{described}&seed=1", "-o", "out", "--every", "2", folder=tmp_path)
    assert other.returncode == 1
    assert other.stderr.count("\n") == 1


def test_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "orbit.csv").write_text("mine", encoding="utf-8")

    refused = glstar("convert", "fly:orbit", "-o", "orbit.csv", folder=tmp_path)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "orbit.csv is there already" in refused.stderr
    assert (tmp_path / "orbit.csv").read_text(encoding="utf-8") == "mine"


def test_an_impossible_flight_is_refused_in_one_line(tmp_path: Path) -> None:
    for arguments in (
        ("convert", "fly:orbit?wind_m_per_s=30", "-o", "orbit.csv"),
        ("export", "fly:orbit?radius=3", "-o", "out"),
        ("info", "fly:loop"),
    ):
        refused = glstar(*arguments, folder=tmp_path)
        assert refused.returncode == 1
        assert refused.stderr.startswith("glstar: ")
        assert refused.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
