"""Flights in one line wherever a command takes a FLIGHT, and as tables by ``glstar convert``."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.support.exports import CAMERA, invoke

IN_ONE_LINE = "fly:orbit?radius_m=300&turns=0.2&wind_m_per_s=8&gusts=light&seed=3"


@pytest.fixture(autouse=True)
def _in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def export(flight: str, output: str, *more: str) -> SimpleNamespace:
    """Export a flight into a directory, by a small camera."""
    Path("small.toml").write_text(CAMERA, encoding="utf-8")
    return invoke("export", flight, "-o", output, "--config", "small.toml", *more)


def test_a_written_flight_and_its_description_give_the_same_frames(tmp_path: Path) -> None:
    flown = invoke("convert", IN_ONE_LINE, "-o", "orbit.csv")
    assert (flown.rc, flown.err) == (0, "")
    assert flown.out.startswith("orbit.csv: ")

    for flight, output in (("orbit.csv", "table"), (IN_ONE_LINE, "described")):
        exported = export(flight, output, "--every", "5", "--seed", "1")
        assert (exported.rc, exported.err) == (0, "")

    images = sorted((tmp_path / "table").glob("*.png"))
    assert len(images) > 3
    for image in images:
        assert image.read_bytes() == (tmp_path / "described" / image.name).read_bytes()
    manifest = json.loads((tmp_path / "described" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["flight"]["name"] == IN_ONE_LINE


def test_an_export_of_a_described_flight_is_continued_but_not_with_another_seed() -> None:
    described = "fly:hover?duration_s=3&gusts=moderate"
    for line in ("2 frames drawn", "0 frames drawn"):
        again = export(described, "out", "--every", "2")
        assert again.out.startswith(line)

    other = export(f"{described}&seed=1", "out", "--every", "2")
    assert other.rc == 1
    assert other.err.count("\n") == 1


def test_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "orbit.csv").write_text("mine", encoding="utf-8")

    refused = invoke("convert", "fly:orbit", "-o", "orbit.csv")
    assert (refused.rc, refused.out) == (1, "")
    assert "orbit.csv is there already" in refused.err
    assert (tmp_path / "orbit.csv").read_text(encoding="utf-8") == "mine"


def test_an_impossible_flight_is_refused_in_one_line(tmp_path: Path) -> None:
    for arguments in (
        ("convert", "fly:orbit?wind_m_per_s=30", "-o", "orbit.csv"),
        ("export", "fly:orbit?radius=3", "-o", "out"),
        ("info", "fly:loop"),
    ):
        refused = invoke(*arguments)
        assert refused.rc == 1
        assert refused.err.startswith("glstar: ")
        assert refused.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
