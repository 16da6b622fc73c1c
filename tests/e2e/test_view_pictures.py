"""Pictures and videos from the real window, by keys and mouse."""

import os
import stat
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.links import soon
from tests.support.realwindow import environment, needs_xvfb, press_keys, started, until

FRAMES_PER_S = 30.0


def frame_count(path: Path) -> int:
    reader = cv2.VideoCapture(str(path))
    count = 0
    while reader.grab():
        count += 1
    reader.release()
    return count


@needs_xvfb
def test_keys_record_videos_set_the_range_save_and_copy_pictures(
    tmp_path: Path,
    xvfb: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    display = xvfb()
    program = tmp_path / "xclip"
    program.write_text(f'#!/bin/sh\ncat > "{tmp_path}/copied.png"\n')
    program.chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    press = partial(press_keys, environment(display, tmp_path))
    with started("view", "--start", "20", display=display, home=tmp_path) as window:
        saved = tmp_path / "glstar-saved"
        until(lambda: press("shift+s") or soon((saved / "adelaide-picture.png").exists, 1.0), "a picture")
        picture = cv2.imread(str(saved / "adelaide-picture.png"))
        assert picture.mean() > 2
        assert np.ptp(picture.astype(int), axis=2).max() > 10  # names of stars in colour

        press("ctrl+c")
        until((tmp_path / "copied.png").exists, "a copied picture")
        press("alt+s")
        until((saved / "adelaide-picture-2.png").exists, "a picture without overlays")
        plain = cv2.imread(str(saved / "adelaide-picture-2.png"))
        assert np.ptp(plain.astype(int), axis=2).max() == 0

        # What is shown, while it plays.
        press("space", "ctrl+r")
        soon(lambda: False, 1.5)
        press("ctrl+r", "space")
        until((saved / "adelaide.mp4").exists, "a video")
        assert frame_count(saved / "adelaide.mp4") > 5

        # A range of a second between the in and out points.
        press("shift+i", "shift+Right", "shift+o", "ctrl+shift+r")
        until(lambda: press("Return") or soon((saved / "adelaide-range.webm").exists, 3.0), "a video of a range")
        assert frame_count(saved / "adelaide-range.webm") == FRAMES_PER_S + 1
        press("s")
        until((saved / "screenshot.png").exists, "a screenshot")
        press("ctrl+q")
        assert window.wait(90) == 0
        assert window.stderr.read() == b""
