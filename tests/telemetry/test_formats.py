"""The table of log formats, and the texts that repeat it where the table cannot be imported: help and the manual."""

import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer

from glstar.cli import app
from glstar.config.flight import FlightSection
from glstar.errors import LogFormatError
from glstar.system.resources import asset
from glstar.telemetry import LOG_FORMATS, LOG_SUFFIXES, open_flight
from glstar.telemetry.tracks import TRACK_FORMATS


def helps(command: click.Command) -> Iterator[str]:
    """Yield the help of the parameters of a command and of its subcommands."""
    for parameter in command.params:
        yield getattr(parameter, "help", None) or ""
    for subcommand in getattr(command, "commands", {}).values():
        yield from helps(subcommand)


@pytest.fixture(scope="module")
def texts() -> set[str]:
    """Return all help texts of parameters."""
    return set(helps(typer.main.get_command(app)))


def test_the_help_of_logs_names_suffixes_of_the_table(texts: set[str]) -> None:
    of_logs = [text for text in texts if ".tlog)" in text and ".ulg)" in text]

    assert len(of_logs) >= 3
    for text in of_logs:
        assert {suffix.lower() for suffix in re.findall(r"\.[A-Za-z]\w*", text)} - {".gz", ".zip"} <= {*LOG_SUFFIXES}
        # "ArduPilot (.BIN, .log), MAVLink (.tlog)".
        named = re.findall(r"([A-Z]\w+) \(([^)]*\.\w[^)]*)\)", text)
        assert len(named) >= 3
        for program, suffixes in named:
            for suffix in suffixes.split(", "):
                assert any(suffix in entry.suffixes and entry.name.startswith(program) for entry in LOG_FORMATS)


def test_the_manual_names_every_format_of_the_table() -> None:
    page = asset("manual/logs.md").read_text(encoding="utf-8")
    rows = page[page.index("| log |") : page.index("Each log may be gzipped")]

    for entry in LOG_FORMATS:
        for suffix in entry.suffixes:
            assert (entry.name.split(" ")[0] if entry.is_table else f"`{suffix}`") in rows


def test_every_list_of_track_formats_is_the_same(texts: set[str]) -> None:
    fields = [field.description or "" for field in FlightSection.model_fields.values()]
    page = asset("manual/logs.md").read_text(encoding="utf-8")
    [row] = [line for line in page.splitlines() if line.startswith("| `--position`")]
    lists = [text for text in (*texts, *fields, row, open_flight.__doc__ or "") if "KML" in text]

    assert len(lists) == 4
    assert all(TRACK_FORMATS in text for text in lists)


@pytest.mark.parametrize("head", [b"PK\x03\x04....[Content_Types].xml", b"\x1f\x8b", b"\xa3\x95\x80"])
def test_only_a_zip_archive_has_members(tmp_path: Path, head: bytes) -> None:
    (tmp_path / "flight").write_bytes(head)

    with pytest.raises(LogFormatError, match=r"flight::member: only a zip archive has members$"):
        open_flight(f"{tmp_path / 'flight'}::member")


def test_demo_is_the_bundled_flight_unless_a_file_is_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bundled = open_flight("demo")

    (tmp_path / "demo").write_bytes(b"nothing that glstar knows")

    assert bundled.attitude.utc_s.size == open_flight(asset("adelaide.BIN")).attitude.utc_s.size
    with pytest.raises(LogFormatError, match="demo: line 1: no table of a flight"):
        open_flight("demo")


@pytest.mark.parametrize("link", ["tcp:127.0.0.1:5760", "udpin:0.0.0.0:14550", "/dev/ttyUSB7,57600", "COM14,57600"])
def test_a_link_in_place_of_a_log_is_named(link: str) -> None:
    with pytest.raises(LogFormatError, match=f"is a link, not a file; glstar live {link} shows"):
        open_flight(link)
