"""Tables fit the terminal: no word, number or mode is cut, whatever its width."""

import fcntl
import json
import os
import re
import struct
import subprocess
import sys
from functools import cache
from typing import Any

import pytest
from rich import box
from rich.table import Table

from glstar.camera.presets import sensor_presets
from glstar.cli import tables

pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")

PRESETS, SKY = ("camera", "presets"), ("sky", "--lat", "-34.93", "--lon", "138.60", "--utc", "2024-03-10T11:00:00Z")
LENS = ("config", "--camera", "imx477:2028x1520", "--lens-mm", "6")
BRIGHTEST = (*SKY, "--vmag", "-1")
# What is printed at each width, characters: by one process, because it takes a second to start.
AT_WIDTH: dict[int, tuple[tuple[str, ...], ...]] = {
    40: (BRIGHTEST,),
    50: (("info", "demo"), (*SKY, "--vmag", "1")),
    60: (PRESETS, LENS),
    80: (
        *(PRESETS, (*PRESETS, "imx477"), ("info", "demo"), LENS, (*SKY, "--vmag", "1"), (*SKY, "--bodies")),
        *(BRIGHTEST, (*BRIGHTEST, "--json")),
    ),
    120: (PRESETS,),
}
# Runs command lines one after the other, and ends what each prints with a form feed.
PRINTING = """
import json, sys
from glstar.cli import app

for words in json.loads(sys.argv[1]):
    try:
        app(words)
    except SystemExit as end:
        assert not end.code
    print(end=chr(12), flush=True)
"""


@cache
def printed(columns: int) -> dict[tuple[str, ...], list[str]]:
    """Return the lines that command lines print in a terminal of a width, without colours."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in {"COLUMNS", "LINES", "NO_COLOR"}}
    process = subprocess.Popen(
        [sys.executable, "-c", PRINTING, json.dumps(AT_WIDTH[columns])],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment | {"TERM": "xterm"},
    )
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(ours)
    assert process.wait(60) == 0, shown.decode()
    pages = re.sub(r"\x1b\[[0-9;]*m|\r", "", shown.decode()).split("\f")[:-1]
    return {words: page.splitlines() for words, page in zip(AT_WIDTH[columns], pages, strict=True)}


@pytest.mark.parametrize(
    ("columns", "words"), [(columns, words) for columns in (50, 60, 80) for words in AT_WIDTH[columns]]
)
def test_a_table_fits_the_terminal_and_cuts_nothing(columns: int, words: tuple[str, ...]) -> None:
    lines = printed(columns)[words]

    assert [line for line in lines if "…" in line] == []
    # What is copied, commands and settings, and paths are not wrapped.
    table = [line for line in lines if not re.search(r"glstar export|\[sensor\]|/", line)]
    assert max(map(len, table)) <= columns


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_every_mode_of_every_sensor_is_whole(columns: int) -> None:
    found = " ".join(printed(columns)[PRESETS]).split()

    modes = [mode.name.partition(":")[2] for preset in sensor_presets().values() for mode in preset.modes]
    assert {"2028x1520", "1332x990"} <= set(modes)
    assert set(modes) <= {word.strip(",") for word in found}


def test_a_star_keeps_all_its_decimals_at_80_columns() -> None:
    [sirius] = [line for line in printed(80)[BRIGHTEST] if "Sirius" in line]
    [row] = json.loads("\n".join(printed(80)[*BRIGHTEST, "--json"]))

    angles = ("ra_deg", "dec_deg", "azimuth_deg", "altitude_deg", "apparent_altitude_deg")
    assert sirius.split()[-5:] == [f"{row[angle]:.5f}" for angle in angles]


def test_a_narrow_terminal_gets_a_block_for_each_row() -> None:
    lines = printed(40)[BRIGHTEST]

    assert lines[0].startswith("The sky over")
    assert "HR 2491" in lines
    assert "  name Sirius, vmag -1.46, ra deg" in lines


WORDS = ("Sirius", "alpha Canis Majoris B", "天狼星", "ends with a space ", "", "two\nlines", "1.5")


@pytest.mark.parametrize("columns", [24, 30, 45, 60, 200])
@pytest.mark.parametrize("kind", [{}, {"box": None}, {"box": box.SIMPLE, "pad_edge": False}, {"show_header": False}])
def test_many_rows_are_printed_as_rich_prints_them(
    kind: dict[str, Any], columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    for limit in (10_000, 0):
        monkeypatch.setattr(tables, "_MANY_ROWS", limit)
        table = Table(title="The sky", caption="what is in it", **kind)
        table.add_column("star_name")
        for header in ("vmag", "azimuth_deg"):
            table.add_column(header, justify="right", no_wrap=True)
        for number in range(60):
            table.add_row(WORDS[number % len(WORDS)], f"{number / 7:.2f}", f"{number**3 / 11:.3f}")
        tables.print_table(table, pipe_columns=columns)
        written.append(capsys.readouterr().out)

    assert written[1] == written[0]
    assert written[0].count("天狼星") == 9
