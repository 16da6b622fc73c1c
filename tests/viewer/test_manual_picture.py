"""The manual's picture of the viewer equals the one that its command draws."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
from typer.testing import CliRunner

from glstar.cli import app
from glstar.render.opengl import GLRenderer

MANUAL = Path(__file__).parents[2] / "assets" / "manual"


def test_the_manual_s_command_draws_the_manual_s_picture(tmp_path):
    page = (MANUAL / "viewer.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^glstar (view --headless .*)$", page, re.MULTILINE)
    words = shlex.split(command)
    picture = words[words.index("--screenshot") + 1]
    assert f"]({picture})" in page
    words[words.index("--screenshot") + 1] = str(tmp_path / "again.png")

    result = CliRunner().invoke(app, words)

    assert result.exit_code == 0, result.output
    again, there = cv2.imread(str(tmp_path / "again.png")), cv2.imread(str(MANUAL / picture))
    assert again.shape == there.shape
    with GLRenderer.headless() as renderer:
        software = "llvmpipe" in renderer.driver
    if software:  # the picture shows the name of the driver, and another driver's noise differs in the last bit
        assert np.abs(again.astype(int) - there).mean() < 0.5
