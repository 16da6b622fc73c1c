"""Power failures during and after an export: the remaining files, and the result of another run.

The suite takes a sample of the states that ``python -m tests.scripts.powerloss`` searches through.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import tifffile

from tests.scripts import kills
from tests.scripts.powerloss import CASES, Laboratory, search
from tests.support.exports import SETTINGS, assert_same, contents, done, table_of_a_flight

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="the recorder takes Linux")


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    with Laboratory(tmp_path_factory.mktemp("laboratory")) as opened:
        yield opened


# Not Dask, which takes long to start and writes like the others; the long search includes it.
@pytest.mark.parametrize("name", [name for name in CASES if "Dask" not in name])
def test_a_rerun_after_a_power_failure_at_any_time_ends_with_the_files_of_one_run(
    name: str, laboratory: Laboratory
) -> None:
    tried, wrong = search(laboratory, name, share=0.05, seed=1)

    assert wrong == []
    assert tried > 5


@pytest.mark.parametrize(("kind", "seed"), [("one process", 1), ("two workers", 2)])
def test_an_export_killed_at_random_times_ends_with_the_files_of_one_run(kind: str, seed: int, tmp_path: Path) -> None:
    """A sample of ``python -m tests.scripts.kills``."""
    assert kills.search(tmp_path, kind, rounds=1, seed=seed)[1] == []


# --- what earlier versions of glstar have left, which flushed nothing -------------------------------------------------


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    return "export", folder / "flight.csv", "--config", folder / "small.toml", "--frames", 4, "-o"


DAMAGES: tuple[Callable[[bytes], bytes], ...] = (
    lambda _: b"",
    lambda content: bytes(len(content)),
    lambda content: content[: len(content) // 2],
    lambda content: content[:-1],
)


@pytest.mark.parametrize("more", [(), ("--format", "tiff", "--light")])
def test_a_truncated_or_damaged_image_is_drawn_again(
    more: tuple[str, ...], words: tuple[object, ...], tmp_path: Path
) -> None:
    done(*words, tmp_path / "whole", *more)
    done(*words, tmp_path / "torn", *more)
    images = sorted((tmp_path / "torn").glob("frame_*"))
    for damage in DAMAGES:
        for image in (images[0], images[-1]):
            image.write_bytes(damage(image.read_bytes()))

        assert done(*words, tmp_path / "torn", *more).out.startswith("2 frames drawn")

        assert_same(tmp_path / "torn", tmp_path / "whole")


def test_an_export_whose_images_are_all_empty_is_drawn_again(words: tuple[object, ...], tmp_path: Path) -> None:
    done(*words, tmp_path / "whole")
    done(*words, tmp_path / "torn")
    for image in (tmp_path / "torn").glob("frame_*.png"):
        image.write_bytes(b"")

    assert done(*words, tmp_path / "torn").out.startswith("4 frames drawn")

    assert_same(tmp_path / "torn", tmp_path / "whole")


@pytest.mark.parametrize("left", [0, 10, -1])
def test_a_truth_that_ends_with_zeros_is_written_again(left: int, words: tuple[object, ...], tmp_path: Path) -> None:
    done(*words, tmp_path / "whole")
    done(*words, tmp_path / "torn")
    truth = tmp_path / "torn" / "truth.jsonl"
    whole = truth.read_bytes()
    truth.write_bytes(whole[:left] + bytes(len(whole[left:])))

    done(*words, tmp_path / "torn")

    assert_same(tmp_path / "torn", tmp_path / "whole")


def test_a_shard_with_a_truncated_image_is_not_joined(words: tuple[object, ...], tmp_path: Path) -> None:
    done(*words, tmp_path / "whole")
    shares = tmp_path / "shares"
    done(*words, shares, "--shard", "1/2")
    image = shares / "frame_000000.png"
    image.write_bytes(image.read_bytes()[:-20])

    assert "the other shards are not complete yet" in done(*words, shares, "--shard", "2/2").out
    assert "truth.jsonl" not in contents(shares)

    done(*words, shares, "--shard", "1/2")
    assert_same(shares, tmp_path / "whole")


def test_a_tiff_written_by_glstar_has_one_strip(words: tuple[object, ...], tmp_path: Path) -> None:
    """`find_damage` relies on it to find the end of the pixels without decoding them."""
    done(*words, tmp_path / "frames", "--format", "tiff", "--light")

    for path in (tmp_path / "frames").glob("*.tiff"):
        with tifffile.TiffFile(path) as file:
            [page] = file.pages
            assert len(page.dataoffsets) == 1
            assert page.dataoffsets[0] + page.databytecounts[0] == path.stat().st_size
