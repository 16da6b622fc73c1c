"""Videos: what is in the file, by the decoders of OpenCV and, where it is installed, of PyAV."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.errors import ExportError
from glstar.export.imagefiles import formats
from glstar.export.imagefiles.formats import VideoFile
from tests.support.exports import done

FRAMES = 7


def stars(number: int) -> np.ndarray:
    """Return a noisy frame whose stars move by 4 px a frame, (90, 121) uint8."""
    pixels = np.random.default_rng(number).normal(16.0, 3.0, (90, 121))
    for row, column in ((20, 15), (45, 60), (70, 30)):
        pixels[row - 1 : row + 2, column + 4 * number - 1 : column + 4 * number + 2] += 200.0
    return np.clip(pixels, 0, 255).astype(np.uint8)


def filmed(path: Path) -> Path:
    with VideoFile(path, 121, 90, 5.0) as video:
        for number in range(FRAMES):
            video.write(stars(number))
        video.finish()
    return path


def assert_shows_the_stars(path: Path, codecs: set[str]) -> None:
    """Read a video with OpenCV: codec, rate, number and content of the frames."""
    reader = cv2.VideoCapture(str(path))
    codec = int(reader.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    assert codec in codecs
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(5.0)
    for number in range(FRAMES):
        good, shown = reader.read()
        assert good
        assert shown.shape == (90, 120, 3)
        grey, expected = shown[..., 1].astype(float), stars(number)[:, :120]
        for row, column in ((20, 15), (45, 60), (70, 30)):
            assert grey[row, column + 4 * number] == pytest.approx(216, abs=40)
        assert cv2.PSNR(expected, shown[..., 1]) > 30  # dB; the noise has 3 DN, 38 dB
    assert not reader.read()[0]
    reader.release()


@pytest.mark.parametrize(("name", "codecs"), [("night.webm", {"VP90", "vp09"}), ("night.mp4", {"mp4v", "FMP4"})])
def test_opencv_alone_writes_vp9_and_mpeg_4(
    name: str, codecs: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(formats, "is_pyav_installed", lambda: False)

    assert_shows_the_stars(filmed(tmp_path / name), codecs)

    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("name", "codecs", "stream"),
    [("night.webm", {"VP90", "vp09"}, "vp9"), ("night.mp4", {"avc1", "h264", "H264"}, "h264")],
)
def test_pyav_writes_vp9_and_h264(name: str, codecs: set[str], stream: str, tmp_path: Path) -> None:
    av = pytest.importorskip("av")

    path = filmed(tmp_path / name)

    assert_shows_the_stars(path, codecs)
    with av.open(str(path)) as film:
        [video] = film.streams.video
        # What browsers play: 8 bits with halved colours.
        assert (video.codec_context.name.replace("libvpx-", ""), video.format.name) == (stream, "yuv420p")
        times_s = [float(frame.pts * frame.time_base) for frame in film.decode(video)]
    np.testing.assert_allclose(times_s, np.arange(FRAMES) / 5.0, rtol=0, atol=1e-3)
    if stream == "h264":
        content = path.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")  # it begins to play before it is loaded


def test_a_video_that_cannot_be_encoded_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"must end with \.webm or \.mp4"):
        VideoFile(tmp_path / "night.avi", 96, 64, 10.0)
    with VideoFile(tmp_path / "night.webm", 96, 64, 10.0) as video:
        video.write(np.zeros((64, 96), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_without_pyav_names_what_browsers_play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "is_pyav_installed", lambda: False)
    words = ("export", "fly:still", "-o", tmp_path / "set", "--frames", 2, "--video")

    assert "browsers and notebooks do not play; write a.webm" in done(*words, tmp_path / "a.mp4").err
    assert "browsers" not in done(*words, tmp_path / "a.webm").err
