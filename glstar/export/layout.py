"""Where the files of an export lie."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["LIGHT_SUFFIX", "OURS", "TABLES", "files_of", "folder_of", "folders_of", "is_folder_name", "numbers_of"]

LIGHT_SUFFIX: Final = ".light.tiff"

# The truth as Parquet, of a complete export.
TABLES: Final = ("frames.parquet", "stars.parquet")

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
    """Return the folders of frames in a directory; a link to one elsewhere is none of them.

    Parameters
    ----------
    directory : Path

    Returns
    -------
    list of Path
    """
    named = (entry for entry in directory.iterdir() if is_folder_name(entry.name))
    return [entry for entry in named if entry.is_dir() and not entry.is_symlink()]


def is_folder_name(name: str) -> bool:
    """Say whether an export gives this name to a folder of frames.

    Parameters
    ----------
    name : str

    Returns
    -------
    bool
    """
    return _FOLDER.fullmatch(name) is not None


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
