"""Where the files of an export lie."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["LIGHT_SUFFIX", "OURS", "files_of", "folder_of", "folders_of", "numbers_of"]

LIGHT_SUFFIX: Final = ".light.tiff"

# Every name that an export gives to a file.
OURS: Final = re.compile(
    r"frame_\d{6,}(\.light)?\.(png|tiff)|manifest\.json|truth\.jsonl(\.\w+-[0-9a-f]+)?(\.partial)?|(frames|stars)\.parquet"
)

_FOLDER: Final = re.compile(r"frames_\d{6,}")
_FRAMES_WITHOUT_A_FOLDER: Final = 10_000
_FRAMES_A_FOLDER: Final = 1000


def folder_of(number: int) -> str:
    """Return the folder of a frame; it depends on nothing else, so that no frame moves when more are drawn.

    Parameters
    ----------
    number : int
        The frame's place in the sequence.

    Returns
    -------
    str
        Its name; nothing for the first ten thousand.
    """
    return "" if number < _FRAMES_WITHOUT_A_FOLDER else f"frames_{number - number % _FRAMES_A_FOLDER:06d}"


def folders_of(directory: Path) -> list[Path]:
    """Return the folders of frames in a directory.

    Parameters
    ----------
    directory : Path

    Returns
    -------
    list of Path
    """
    return [entry for entry in directory.iterdir() if _FOLDER.fullmatch(entry.name) and entry.is_dir()]


def files_of(directory: Path) -> Iterator[Path]:
    """Return what lies in a directory and in its folders of frames.

    Parameters
    ----------
    directory : Path

    Yields
    ------
    Path
    """
    for folder in (directory, *folders_of(directory)):
        yield from folder.iterdir()


def numbers_of(directory: Path, suffix: str) -> NDArray[np.int64]:
    """Return which frames have a file.

    Parameters
    ----------
    directory : Path
    suffix : str
        How its name ends.

    Returns
    -------
    (n,) int64
        Rising.
    """
    name = re.compile(rf"frame_(\d{{6,}}){re.escape(suffix)}")
    found = (match for path in files_of(directory) if (match := name.fullmatch(path.name)))
    return np.unique(np.fromiter((int(match[1]) for match in found), dtype=np.int64))
