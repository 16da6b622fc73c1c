"""Several logs at once: a table of them, and an export that leaves out unreadable ones."""

import json
from pathlib import Path

import pytest

from glstar.system.resources import asset
from tests.support.dataflash import Log, times
from tests.support.exports import in_folder

DEMO = asset("adelaide.BIN")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """A folder with a flight, a short flight, an unreadable log, and a text file."""
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "a.BIN").write_bytes(DEMO.read_bytes())
    short = Log()
    for t in times():
        short.att(t)
        short.pos(t)
        short.gps(t)
    short.save(folder / "b.bin")
    (folder / "c.BIN").write_bytes(b"\xa3\x95\x80" + bytes(1000))
    (folder / "notes.txt").write_text("flown at night")
    return folder


def test_a_folder_is_surveyed_with_a_line_for_each_log(logs: Path) -> None:
    result = in_folder(logs, "info", logs)

    assert result.rc == 0
    rows = {line.split()[0]: line for line in result.out.splitlines() if line.strip()}
    assert set(rows) == {"log", "a.BIN", "b.bin", "c.BIN"}
    assert "2024-03-10T11:00:34" in rows["a.BIN"]
    assert "134.5" in rows["a.BIN"]
    assert "ATT, 25.0 Hz" in rows["b.bin"]
    assert "cannot be read" in rows["c.BIN"]
    assert result.err.startswith("c.BIN: no whole record in 1003 bytes")


def test_a_survey_of_several_logs_as_json_includes_errors(logs: Path) -> None:
    result = in_folder(logs, "info", "a.BIN", "c.BIN", "--json")

    first, second = json.loads(result.out)
    assert (first["file"], first["duration_s"]) == ("a.BIN", 134.47)
    assert second["file"] == "c.BIN"
    assert second["error"].startswith("no whole record")
    assert in_folder(logs, "info", "c.BIN", "c.BIN").rc == 1
    assert in_folder(logs, "info", "a.BIN", "b.bin", "--plot", "x.png").rc == 2


def test_an_export_of_several_logs_leaves_out_and_reports_unreadable_ones(logs: Path) -> None:
    arguments = ("export", "a.BIN", "b.bin", "c.BIN", "--frames", "1", "--exposure", "5", "--every", "60")
    done = in_folder(logs, *arguments, "-o", "frames", "--json")

    assert done.rc == 0
    report = json.loads(done.out)
    manifest = json.loads((logs / "frames" / "manifest.json").read_text())
    assert report["drawn"] == 1
    assert [flight["name"] for flight in manifest["flights"]] == ["a.BIN"]
    reasons = {one["log"]: one["reason"] for one in report["left_out"]}
    assert reasons == {one["name"]: one["reason"] for one in manifest["left_out"]}
    assert reasons.keys() == {"b.bin", "c.BIN"}
    assert "no exposure of 5 s fits" in reasons["b.bin"]
    assert "left out: c.BIN: no whole record in 1003 bytes" in done.err

    strict = in_folder(logs, *arguments, "-o", "others", "--strict")
    assert strict.rc == 1
    assert "c.BIN: no whole record in 1003 bytes" in strict.err
    assert not (logs / "others").exists()


def test_an_export_of_unreadable_logs_only_is_refused(logs: Path) -> None:
    done = in_folder(logs, "export", "c.BIN", "c.BIN", "-o", "frames")

    assert done.rc == 1
    assert "no whole record" in done.err
    assert not (logs / "frames").exists()
