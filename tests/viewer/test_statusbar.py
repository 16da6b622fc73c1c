"""The status line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.sky.place.timescale import parse_utc
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.ui import status as statusbar
from tests.viewer.test_live import frames_until


def test_a_real_image_has_its_own_time_by_the_camera_s_clock(viewer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "photographs"
    folder.mkdir()
    cv2.imwrite(str(folder / "20240310_110006.png"), np.full((190, 254), 9, np.uint8))
    session = viewer.session
    session.open(folder)
    frames_until(viewer, lambda: session.comparison.images is not None)
    session.comparison.mode, session.comparison.offset_s = ComparisonMode.WIPE, 1.5
    session.head.seek(parse_utc("2024-03-10T11:00:04.5Z"))
    written: list[str] = []
    monkeypatch.setattr(statusbar, "_item", lambda text, *_: written.append(text))
    viewer.frame(0.0)
    assert "real 11:00:06.000Z" in written
    session.comparison.mode = ComparisonMode.OFF
    written.clear()
    viewer.frame(0.0)
    assert written
    assert not any(text.startswith("real") for text in written)
