"""Makes the table of flags in ``assets/manual/commandline.md`` from the commands themselves.

``python -m tests.scripts.make_commandline_page`` writes the page; a test compares it.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any, Final

from typer.main import get_command

from glstar.cli import app

PAGE: Final = Path(__file__).parents[2] / "assets" / "manual" / "commandline.md"
_BEGIN, _END = "| flag | meaning | commands |\n|---|---|---|\n", "\n## Exit status"

# What a flag means in every command that has it.
MEANINGS: Final = {
    "--answers": "a navigator's answers: a file, `-`, or (`live`) `zmq://HOST:PORT`",
    "--attitude": "which attitude of the log",
    "--boot": "which boot of the log",
    "--camera": "a preset or a camera file; of `camera show`, a camera in a file",
    "--columns": "what the columns of a table mean, or the topics and frames of a bag",
    "--config": "a TOML file of settings (`-c`)",
    "--every": "time from one exposure to the next, s",
    "--exposure": "exposure time, s",
    "--fit-readout": "fit the readout time of a rolling shutter",
    "--f-number": "focal length over aperture",
    "--force": "replace what exists",
    "--format": "format of the files",
    "--video": "frames as a video: of an export as NAME.webm or NAME.mp4, live by RTP or as NAME.ts",
    "--video-fps": "frame rate of a video, 1/s",
    "--gain": "analogue gain of the sensor",
    "--headless": "no window",
    "--interpolation": "attitude between samples: slerp, spline or gyro",
    "--json": "the report as JSON",
    "--lat": "latitude, deg, north positive",
    "--latest-frame": "where frames go besides files: shared memory, ZeroMQ, a browser, a video device",
    "--lens": "lens model to fit",
    "--lens-mm": "focal length, mm",
    "--lon": "longitude, deg, east positive",
    "--max-gap": "longest gap to interpolate across, s",
    "--output": "what to write (`-o`)",
    "--pattern": "columns x rows of a board",
    "--position": "a track with the positions of the flight",
    "--quiet": "no progress and no notes on standard error (`-q`); also before the command",
    "--rate": "attitudes per second, Hz",
    "--screenshot": "a picture of the window",
    "--seed": "seed of random numbers",
    "--show": "overlays of the image",
    "--size": "size of the window, px",
    "--square": "side of a square of a board, mm",
    "--start": "start, s from the first attitude",
    "--stats": "frame times of the window, as JSON",
    "--sysid": "which vehicle of the log or link",
    "--time-offset": "the camera's clock minus the log's, s",
    "--utc": "a time, ISO 8601",
    "--utc-start": "UTC of the first attitude",
    "--vehicle": "which vehicle of the log, by name",
    "--verbose": "more on standard error: the driver, and progress without a terminal (`-v`); also before the command",
    "--with-truth": "send the truth with the frames of `zmq://`",
}
# `export` and `compare` take "camera", and `view` takes seconds.
EXCEPTIONS: Final = {"--at", "--help"}


def commands_by_flag() -> dict[str, list[str]]:
    """Return the commands of every flag that several commands have."""
    found: defaultdict[str, list[str]] = defaultdict(list)

    def collect(name: str, command: Any) -> None:
        for own, inner in getattr(command, "commands", {}).items():
            collect(f"{name} {own}".strip(), inner)
        if not hasattr(command, "commands"):
            for flag in (flag for parameter in command.params for flag in parameter.opts if flag.startswith("--")):
                found[flag].append(name)

    collect("", get_command(app))
    return {flag: names for flag, names in sorted(found.items()) if len(names) > 1 and flag not in EXCEPTIONS}


def page(text: str) -> str:
    """Return the page with the table of flags made again."""
    head, _, rest = text.partition(_BEGIN)
    _, _, tail = rest.partition(_END)
    rows = [f"| `{flag}` | {MEANINGS[flag]} | {', '.join(names)} |\n" for flag, names in commands_by_flag().items()]
    return head + _BEGIN + "".join(rows) + _END + tail


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
