"""Small files that a person names: regular ones up to a size are read, others refused."""

import os
from pathlib import Path

import pytest

from glstar.camera.camerafile import camera_from_file
from glstar.config import Config
from glstar.errors import GlstarError
from glstar.images.times import read_table
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.photometry import StarBrightness
from glstar.system.userinput import read_bytes, read_text

SECRET = "hunter2"


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "pipe.toml"
    os.mkfifo(path)
    return path


@pytest.mark.timeout(10)
@pytest.mark.parametrize("read", [Config.load, camera_from_file, StarBrightness.open, read_table, StarCatalogue.open])
def test_a_pipe_is_refused_at_once_by_everything_that_reads_a_small_file(read: object, pipe: Path) -> None:
    with pytest.raises(GlstarError, match=r"is a pipe|is no regular file"):
        read(pipe)  # type: ignore[operator]


@pytest.mark.parametrize(("path", "words"), [("/dev/zero", "is a device"), ("/", "is a directory")])
def test_a_device_and_a_directory_are_refused(path: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_bytes(path, 100)


def test_a_large_file_is_refused_and_not_read(tmp_path: Path) -> None:
    path = tmp_path / "log.BIN"
    with path.open("wb") as file:
        file.truncate(2**40)  # a terabyte of nothing

    with pytest.raises(ValueError, match="is larger than 1 MiB"):
        read_text(path, 2**20)


def test_a_link_to_a_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("text", encoding="utf-8-sig")
    (tmp_path / "link").symlink_to("file")

    assert read_text(tmp_path / "link", 100) == "text"


@pytest.mark.parametrize(
    "private",
    [
        f"password: {SECRET}\n",
        f"{SECRET}: 1\nb: 2\n" * 1,
        f"first: 1\n{SECRET}: 2\n",
        f"{SECRET}\nmore\n",
        f"- {SECRET}\n",
        f"a: *{SECRET}\n",
        f"a: !{SECRET} 1\n",
        f"root:{SECRET}:19000:0\nbin:*:1\n",
        f"a: [{SECRET}\n",
        f"a: 2001-99-99 {SECRET}\na: {{{SECRET}: 1}}: 2\n",
    ],
)
def test_the_content_of_a_private_file_given_as_a_camera_is_not_in_the_message(private: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(private, encoding="utf-8")

    with pytest.raises(GlstarError) as caught:
        camera_from_file(path)

    # The first key may be named if it resembles a key.
    if not private.startswith(f"{SECRET}: "):
        assert SECRET not in str(caught.value)
    assert len(str(caught.value)) < 350


def test_the_content_of_a_private_file_given_as_star_brightness_is_not_in_the_message(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"hr,vmag,camera_mag\n1,2,{SECRET}\n", encoding="utf-8")

    with pytest.raises(GlstarError, match="line 2") as caught:
        StarBrightness.open(path)

    assert SECRET not in str(caught.value)
