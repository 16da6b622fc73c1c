"""Keys of the real window: what it shows, saves, copies and records, and how little it works while it is paused."""

import json
import os
import stat
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.links import soon
from tests.support.realwindow import SETTINGS, Places, RealWindow, changed, needs_xvfb, started, until

FRAMES_PER_S = 30.0
PLACES = Places(1280, 800)


def frame_count(path: Path) -> int:
    reader = cv2.VideoCapture(str(path))
    count = 0
    while reader.grab():
        count += 1
    reader.release()
    return count


def worked_s(pid: int) -> float:
    """Return the processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def processor_fraction(pid: int) -> float:
    """Return the fraction of two seconds that a process uses a processor, after a second of rest."""
    time.sleep(1.0)
    began_s, worked_before_s = time.monotonic(), worked_s(pid)
    time.sleep(2.0)
    return (worked_s(pid) - worked_before_s) / (time.monotonic() - began_s)


def is_red(path: Path) -> bool:
    picture = cv2.imread(str(path))
    return picture[..., :2].max() <= 8 and picture[..., 2].max() > 100


def save(window: RealWindow, key: str, path: Path) -> np.ndarray:
    """Press a key once, and return the picture that it saves, height, width, blue, green, red."""
    window.press(key)
    until(path.exists, path.name)
    return cv2.imread(str(path))


def show_and_save(window: RealWindow, saved: Path) -> None:
    """Save the window by day and by night, and a frame with its truth."""
    day = save(window, "s", saved / "screenshot.png")
    assert day.shape == (800, 1280, 3)
    assert day[..., 0].max() > 100  # blue
    window.press("n")
    window.until(lambda screen: screen[60:, :, :2].max() <= 8, "red")
    save(window, "s", saved / "screenshot-2.png")
    assert is_red(saved / "screenshot-2.png")
    window.press("n")
    window.until(lambda screen: screen[60:, :, 0].max() > 100, "all colours")
    window.press("ctrl+s")
    until(lambda: list(saved.glob("adelaide-*/truth.jsonl")), "a frame")
    (truth,) = saved.glob("adelaide-*/truth.jsonl")
    assert json.loads(truth.read_text())["frame"] == 6


def rest_and_play(window: RealWindow, pid: int) -> None:
    """Paused and without input it waits for events, and uses a fraction of the processor time of playing."""
    window.press("space")
    playing = processor_fraction(pid)
    window.press("space")
    # The machine may be busy, and what was saved last may still be written.
    until(lambda: processor_fraction(pid) < 0.3 * playing, "a window at rest")


def copy_and_record(window: RealWindow, folder: Path, saved: Path) -> None:
    """Save and copy the picture, and record what is shown, and a range."""
    picture = save(window, "shift+s", saved / "adelaide-picture.png")
    assert picture.mean() > 2
    assert np.ptp(picture.astype(int), axis=2).max() > 10  # names of stars in colour
    window.press("ctrl+c")
    until((folder / "copied.png").exists, "a copied picture")
    plain = save(window, "alt+s", saved / "adelaide-picture-2.png")
    assert np.ptp(plain.astype(int), axis=2).max() == 0

    # What is shown, while it plays.
    window.press("space", "ctrl+r")
    soon(lambda: False, 1.5)
    window.press("ctrl+r", "space")
    until((saved / "adelaide.mp4").exists, "a video")
    assert frame_count(saved / "adelaide.mp4") > 5

    # A range of a second between the in and out points.
    window.press("shift+i", "shift+Right", "shift+o")
    before, middle = window.still(), np.s_[300:500, 400:880]
    window.press("ctrl+shift+r")
    window.until(lambda screen: changed(screen[middle], before[middle]) > 5000, "the dialog of the range")
    window.still()
    window.press("Return")
    until((saved / "adelaide-range.webm").exists, "a video of a range")
    assert frame_count(saved / "adelaide-range.webm") == FRAMES_PER_S + 1


@needs_xvfb
def test_keys_show_save_copy_and_record(
    tmp_path: Path, display: Callable[[int, int], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "xclip"
    program.write_text(f'#!/bin/sh\ncat > "{tmp_path}/copied.png"\n')
    program.chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    number, saved = display(1280, 800), tmp_path / "glstar-saved"
    with started("view", "--start", "20", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path)
        window.focus(child)
        window.until(lambda screen: (PLACES.image(screen).min(axis=2) > 200).sum() > 100, "stars")
        window.away()
        show_and_save(window, saved)
        rest_and_play(window, child.pid)
        copy_and_record(window, tmp_path, saved)
        window.press("Escape")
        time.sleep(0.3)
        assert child.poll() is None
        window.press("ctrl+q")
        assert child.wait(90) == 0
        assert child.stderr is not None
        assert child.stderr.read() == b""
        assert (tmp_path / SETTINGS / "glstar" / "viewer.ini").is_file()
