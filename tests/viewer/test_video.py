"""Videos and pictures of what is shown: their frames, their times and their pixels."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.errors import ConfigError, ExportError
from glstar.export.imagefiles.formats import VideoFile
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import Viewer
from glstar.viewer.session.keys import Action
from glstar.viewer.session.recording import RangeVideo, ScreenVideo, VideoRange


def frames_of(path: Path) -> list[np.ndarray]:
    reader = cv2.VideoCapture(str(path))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1])
    reader.release()
    return frames


def level(value: int) -> np.ndarray:
    return np.full((64, 96, 3), value, np.uint8)


@pytest.mark.parametrize(
    ("length_s", "speed", "frames_per_s", "count"),
    [(2.0, 1.0, 30.0, 61), (2.0, 2.0, 30.0, 31), (2.0, 0.5, 10.0, 41), (0.3, 1.0, 10.0, 4), (0.05, 1.0, 10.0, 1)],
)
def test_a_range_has_a_frame_at_both_ends(length_s: float, speed: float, frames_per_s: float, count: int) -> None:
    part = VideoRange(1e9, 1e9 + length_s, speed, frames_per_s)
    assert part.count == count
    assert part.utc_s(0) == 1e9
    assert part.utc_s(count - 1) <= part.stop_utc_s + 1e-6
    assert part.utc_s(count) > part.stop_utc_s


@pytest.mark.parametrize("values", [(0.0, 30.0), (float("nan"), 30.0), (1.0, 0.0), (1.0, 1e6), (-1.0, 30.0)])
def test_an_impossible_speed_or_rate_is_refused(values: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="a video needs"):
        VideoRange(0.0, 1.0, *values)
    with pytest.raises(ConfigError, match="end after its beginning"):
        VideoRange(1.0, 1.0)


def test_the_frame_rate_of_the_clock_is_kept_by_repeating_and_leaving_out_pictures(tmp_path: Path) -> None:
    now_s = [0.0]
    video = ScreenVideo(tmp_path / "v.mp4", 10.0, lambda: now_s[0])
    # A picture every 50 ms, then one of 400 ms, then one more.
    for number, at_s in enumerate([0.0, 0.05, 0.1, 0.15, 0.2, 0.6, 0.7]):
        now_s[0] = at_s + 1e-9
        video.add(level(30 * number))
    video.stop()
    assert video.is_done
    assert video.finish(None) == 8
    levels = [round(float(frame.mean()) / 30) for frame in frames_of(video.path)]
    assert levels == [0, 2, 4, 5, 5, 5, 5, 6]


def test_a_video_is_absent_until_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    with VideoFile(path, 96, 64, 10.0) as video:
        video.write(level(10))
        assert not path.exists()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ExportError, match=r"must end with \.webm or \.mp4"):
        VideoFile(tmp_path / "v.avi", 96, 64, 10.0)


def test_a_range_shows_the_flight_at_equal_steps_and_puts_the_play_head_back(
    make_viewer: Callable[..., Viewer], tmp_path: Path
) -> None:
    viewer = make_viewer()
    session, head = viewer.session, viewer.session.head
    head.mode = Mode.SLIDING
    head.seek(head.first_s + 8.0)
    path = tmp_path / "range.mp4"
    session.video = RangeVideo(path, VideoRange(head.first_s + 2.0, head.first_s + 3.0, 2.0, 10.0))
    shown = []
    while session.video is not None:
        viewer.frame()
        if not shown or shown[-1] != session.scene.exposure.stop_utc_s:
            shown.append(session.scene.exposure.stop_utc_s)

    assert np.array(shown[:6]) - head.first_s == pytest.approx(np.linspace(2.0, 3.0, 6), rel=0, abs=2e-6)
    assert head.second == pytest.approx(8.0, rel=0, abs=1e-6)
    pictures = frames_of(path)
    assert len(pictures) == 6
    _, _, width, height = viewer.interface.visible_px
    assert pictures[0].shape[:2] == (height - height % 2, width - width % 2)
    # The sky moves from frame to frame.
    assert min(np.abs(a.astype(int) - b).mean() for a, b in pairwise(pictures)) > 0.5
    assert str(path) in session.notifications.current[-1].message


def test_recording_can_be_stopped_and_begun_again(make_viewer: Callable[..., Viewer], tmp_path: Path) -> None:
    viewer = make_viewer()
    session, interface = viewer.session, viewer.interface
    for name in ("turning.mp4", "turning-2.mp4"):
        interface.perform(Action.VIDEO)
        for _ in range(4):
            viewer.frame()
        interface.perform(Action.VIDEO)
        viewer.frame()
        assert session.video is None
        assert frames_of(tmp_path / "saved" / name)


def test_a_video_that_cannot_be_written_says_so(make_viewer: Callable[..., Viewer], tmp_path: Path) -> None:
    viewer = make_viewer()
    (tmp_path / "saved").write_text("a file where the folder should be")
    viewer.interface.perform(Action.VIDEO)
    viewer.frame()
    assert viewer.session.video is None
    assert viewer.session.notifications.errors


def test_a_picture_is_saved_with_overlays_and_without(make_viewer: Callable[..., Viewer], tmp_path: Path) -> None:
    viewer = make_viewer()
    viewer.interface.perform(Action.SAVE_PICTURE)
    viewer.frame(0.0)
    viewer.interface.perform(Action.SAVE_PLAIN_PICTURE)
    viewer.frame(0.0)
    shown = cv2.imread(str(tmp_path / "saved" / "turning-picture.png"))
    plain = cv2.imread(str(tmp_path / "saved" / "turning-picture-2.png"))

    assert shown.shape == plain.shape
    # Without overlays every pixel is grey; names of stars have a colour.
    assert np.ptp(plain.astype(int), axis=2).max() == 0
    differs = np.abs(shown.astype(int) - plain).max(axis=2) > 2
    assert 0.001 < differs.mean() < 0.2
    assert np.ptp(shown.astype(int), axis=2).max() > 10


def test_a_copied_picture_is_the_one_that_is_shown(
    make_viewer: Callable[..., Viewer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied: list[bytes] = []
    monkeypatch.setattr("glstar.viewer.session.saving.copy_png", lambda content: copied.append(content) or "")
    viewer = make_viewer()
    viewer.interface.perform(Action.COPY_PICTURE)
    viewer.interface.screenshot = tmp_path / "window.png"
    viewer.frame(0.0)
    left, top, width, height = viewer.interface.visible_px
    window = cv2.imread(str(tmp_path / "window.png"))
    picture = cv2.imdecode(np.frombuffer(copied[0], np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(picture, window[top : top + height, left : left + width])
