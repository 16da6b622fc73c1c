"""Tables fit the terminal: no word, number or mode is cut, whatever its width."""

import fcntl
import json
import os
import re
import struct
import subprocess
import sys

import pytest

from glstar.camera.presets import sensor_presets

pty = pytest.importorskip("pty")
termios = pytest.importorskip("termios")

SKY = ("sky", "--lat", "-34.93", "--lon", "138.60", "--utc", "2024-03-10T11:00:00Z")


def in_terminal(columns: int, *words: str) -> list[str]:
    """Return the lines that a command prints in a terminal of a width, without colours."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in {"COLUMNS", "LINES", "NO_COLOR"}}
    process = subprocess.Popen(
        [sys.executable, "-m", "glstar", *words],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment | {"TERM": "xterm"},
    )
    os.close(theirs)
    printed = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        printed += part
    os.close(ours)
    assert process.wait(60) == 0, printed.decode()
    return re.sub(r"\x1b\[[0-9;]*m|\r", "", printed.decode()).splitlines()


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (80, ("camera", "presets")),
        (60, ("camera", "presets")),
        (80, ("camera", "presets", "imx477")),
        (80, ("info", "demo")),
        (50, ("info", "demo")),
        (80, ("config", "--camera", "imx477:2028x1520", "--lens-mm", "6")),
        (60, ("config", "--camera", "imx477:2028x1520", "--lens-mm", "6")),
        (80, (*SKY, "--vmag", "1")),
        (80, (*SKY, "--bodies")),
        (50, (*SKY, "--vmag", "1")),
    ],
)
def test_a_table_fits_the_terminal_and_cuts_nothing(columns: int, words: tuple[str, ...]) -> None:
    lines = in_terminal(columns, *words)

    assert [line for line in lines if "…" in line] == []
    # What is copied, commands and settings, and paths are not wrapped.
    table = [line for line in lines if not re.search(r"glstar export|\[sensor\]|/", line)]
    assert max(map(len, table)) <= columns


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_every_mode_of_every_sensor_is_whole(columns: int) -> None:
    printed = " ".join(in_terminal(columns, "camera", "presets")).split()

    modes = [mode.name.partition(":")[2] for preset in sensor_presets().values() for mode in preset.modes]
    assert {"2028x1520", "1332x990"} <= set(modes)
    assert set(modes) <= {word.strip(",") for word in printed}


def test_a_star_keeps_all_its_decimals_at_80_columns() -> None:
    [sirius] = [line for line in in_terminal(80, *SKY, "--vmag", "-1") if "Sirius" in line]
    [row] = json.loads("\n".join(in_terminal(80, *SKY, "--vmag", "-1", "--json")))

    angles = ("ra_deg", "dec_deg", "azimuth_deg", "altitude_deg", "apparent_altitude_deg")
    assert sirius.split()[-5:] == [f"{row[angle]:.5f}" for angle in angles]


def test_a_narrow_terminal_gets_a_block_for_each_row() -> None:
    lines = in_terminal(40, *SKY, "--vmag", "-1")

    assert lines[0].startswith("The sky over")
    assert "HR 2491" in lines
    assert "  name Sirius, vmag -1.46, ra deg" in lines
