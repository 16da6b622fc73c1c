"""Which files of a folder are images, which of several paths are chosen, and how many decoded ones are kept."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError, ImagesError
from glstar.export.imagefiles.formats import fit_format
from glstar.images import RealImages
from glstar.images import folder as folderfile
from glstar.images.folder import choose_images, find_images


def write(path: Path, value: int = 7) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, np.full((6, 8), value, np.uint8))[1].tobytes())
    return path


def test_tables_and_files_beside_the_images_are_none(tmp_path: Path) -> None:
    for name in ("20190729_204726.png", "20190729_204727.trails.png", "20190729_204728.light.tiff", "noon.png"):
        write(tmp_path / name)
    for name in ("manifest.json", "nav.jsonl", "DATACARD.md", ".hidden.png"):
        (tmp_path / name).write_text("")
    table = tmp_path / "mine.csv"
    table.write_text("file,utc\nnoon.png,2019-07-29T12:00:00Z\ngone.png,2019-07-29T12:00:00Z\n")

    images, problems = find_images(tmp_path, table=table)

    assert [image.path.name for image in images] == ["20190729_204726.png", "noon.png"]
    assert [image.time.source for image in images] == ["name", "mine.csv"]
    assert problems == ["gone.png: mine.csv lists it, but the folder does not have it"]
    (tmp_path / "words.txt").write_text("words")
    _, problems = find_images(tmp_path)
    assert problems == [
        "mine.csv: is not an image that glstar reads",
        "noon.png: no time: no table, EXIF or file name gives one",
        "words.txt: is not an image that glstar reads",
    ]


def test_files_and_folders_are_chosen_once_in_the_order_of_their_times(tmp_path: Path) -> None:
    late, early = write(tmp_path / "a" / "20190729_204729.png"), write(tmp_path / "b" / "20190729_204726.png")
    other, middle = write(tmp_path / "b" / "20190729_204730.png"), write(tmp_path / "a" / "20190729_204727.png")
    untimed = write(tmp_path / "b" / "noon.png")

    def chosen(*paths: Path) -> tuple[list[Path], list[str]]:
        images, problems = choose_images(paths)
        return [image.path for image in images], problems

    nothing = "noon.png: no time: no table, EXIF or file name gives one"
    assert chosen(tmp_path / "a", early) == ([early, middle, late], [])
    assert chosen(early, other) == ([early, other], [])
    assert chosen(early, untimed) == ([early], [nothing])
    assert chosen(early, tmp_path / "b") == ([early, other], [nothing])
    assert chosen(tmp_path / "b", early) == ([early, other], [nothing])
    with pytest.raises(ImagesError):
        choose_images([tmp_path / "c"])


def test_two_decoded_images_are_kept_whatever_their_size_and_more_while_they_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for second in range(5):
        write(tmp_path / f"20190729_20472{second}.png")
    monkeypatch.setattr(folderfile, "_CACHE_BYTES", 3 * 48)
    with RealImages.open(tmp_path) as images:
        done: Any = SimpleNamespace(
            done=lambda: True, result=lambda: SimpleNamespace(pixels=np.zeros((6, 8), np.uint8))
        )
        for image in images:
            images._pending = image, 8, 6, done
            images.collect()
        kept = [path.name for path, *_ in images._decoded]
        assert kept == [f"20190729_20472{second}.png" for second in (2, 3, 4)]
        monkeypatch.setattr(folderfile, "_CACHE_BYTES", 1)
        images._pending = images[0], 8, 6, done
        images.collect()
        assert len(images._decoded) == 2


def test_a_sensor_of_up_to_eight_bits_has_sixteen_in_a_format_of_sixteen() -> None:
    for kind in ("png16", "tiff", "fits"):
        assert fit_format(kind, Sensor(bit_depth=8))[1].bit_depth == 16  # type: ignore[arg-type]
        assert fit_format(kind, Sensor(bit_depth=9))[1].bit_depth == 9  # type: ignore[arg-type]
    for kind in ("png", "jpeg"):
        assert fit_format(kind, Sensor(bit_depth=8))[1].bit_depth == 8  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=f"a sensor of 9 bits does not fit into 8-bit {kind.upper()}"):
            fit_format(kind, Sensor(bit_depth=9))  # type: ignore[arg-type]
    assert fit_format(None, Sensor(bit_depth=8))[0] == "png"
    assert fit_format(None, Sensor(bit_depth=9))[0] == "png16"
    assert fit_format(None, Sensor(bit_depth=8), summed=2) == ("png16", Sensor(bit_depth=8))
    with pytest.raises(ConfigError, match="adds 2 exposures, which do not fit into 8-bit PNG"):
        fit_format("png", Sensor(bit_depth=8), summed=2)
