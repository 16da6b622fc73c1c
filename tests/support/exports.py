"""The command line in this process or another one, and the files of small exports."""

import json
import os
import subprocess
import sys
import time
from contextlib import chdir
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from typer.testing import CliRunner

from glstar.cli import app

FIRST_UTC_S = 1710068400.0  # 2024-03-10T11:00:00Z, a night over Adelaide


FLIGHT_S, ATTITUDE_HZ = 12.5, 50


FRAMES = 25  # consecutive, of half a second each
IN_PROGRESS = (os.cpu_count() or 1) + 3  # maximum number of images without a line of truth
CAMERA = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n"
SETTINGS = CAMERA + "[exposure]\nduration_s = 0.5\ninterval_s = 0.5\n[sky]\nvmag_limit = 4.0\n"
# Runs the command line, and stops it (SIGSTOP) when the directory has its nth image.
PAUSING = """
import os, signal, sys
from pathlib import Path
left = int(sys.argv.pop(1))
replace = Path.replace

def pausing_replace(path, target):
    global left
    result = replace(path, target)
    left -= Path(target).suffix == ".png"
    if not left:
        left = -1
        os.kill(os.getpid(), signal.SIGSTOP)
    return result

Path.replace = pausing_replace
from glstar.cli import main
main()
"""


Truth = list[dict[str, Any]]


def table_of_a_flight(*, silent: tuple[float, float] = (0.0, 0.0), yaw_deg_per_s: float = 2.0) -> str:
    """Return a CSV of a level aircraft that turns slowly, with a data gap between two times."""
    rows = ["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"]
    for k in range(round(FLIGHT_S * ATTITUDE_HZ) + 1):
        t_s = k / ATTITUDE_HZ
        if not silent[0] < t_s < silent[1]:
            rows.append(f"{FIRST_UTC_S + t_s:.2f},{0.5 * t_s:.3f},0,{yaw_deg_per_s * t_s:.3f},-34.93,138.60,100")
    return "\n".join(rows) + "\n"


def invoke(*words: object) -> SimpleNamespace:
    """Run the command line in this process, and return its status and output; it must not raise."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return SimpleNamespace(rc=result.exit_code, out=result.stdout, err=result.stderr)


def in_folder(folder: Path, *words: object) -> SimpleNamespace:
    """Run the command line in this process, with a folder as the working directory."""
    with chdir(folder):
        return invoke(*words)


def done(*words: object) -> SimpleNamespace:
    """Run the command line in this process; it must succeed."""
    result = invoke(*words)
    assert result.rc == 0, result.err
    return result


def refused(*words: object) -> str:
    """Run the command line in this process and return its one line of error."""
    result = invoke(*words)
    assert result.rc == 1
    [line] = result.err.splitlines()
    assert line.startswith("glstar: ")
    return line


def start(*words: object, **settings: Any) -> subprocess.Popen[str]:
    """Start the command line in a process of its own."""
    command = [sys.executable, "-m", "glstar", *map(str, words)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | settings
    return subprocess.Popen(command, text=True, **streams)


def paused(count: int, *words: object) -> subprocess.Popen[str]:
    """Start the command line in a process of its own, and return it stopped at its nth image."""
    command = [sys.executable, "-c", PAUSING, str(count), *map(str, words)]
    process = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    _, status = os.waitpid(process.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status), "it ended before it had that many frames"
    return process


def wait_for_frames(process: subprocess.Popen[str], directory: Path, count: int) -> None:
    """Return as soon as the directory has that many frames."""
    until_s = time.monotonic() + 60
    while sum(1 for _ in directory.glob("frame_*.png")) < count:
        assert process.poll() is None, "it ended before it had that many frames"
        assert time.monotonic() < until_s
        time.sleep(0.01)


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


def assert_same(directory: Path, one_run: Path) -> None:
    """Assert that two directories are equal, byte for byte."""
    found, expected = contents(directory), contents(one_run)
    assert sorted(found) == sorted(expected)
    assert [name for name in expected if found[name] != expected[name]] == []


def truth_of(directory: Path) -> Truth:
    return [json.loads(line) for line in (directory / "truth.jsonl").read_text(encoding="utf-8").splitlines()]


def manifest_of(directory: Path) -> dict[str, Any]:
    manifest: dict[str, Any] = json.loads((directory / "manifest.json").read_text(encoding="utf-8"))
    return manifest


def image_of(path: Path) -> np.ndarray[Any, Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image
