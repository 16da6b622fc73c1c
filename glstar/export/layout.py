"""Names of the files and folders of an export."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "DATA_CARD",
    "NOISELESS_SUFFIX",
    "OURS",
    "SPLITS",
    "SPLIT_INDEX",
    "SUMMARIES",
    "TABLES",
    "frame_folder",
    "frame_folders",
    "frame_numbers",
    "is_folder_name",
    "output_files",
]

NOISELESS_SUFFIX: Final = ".light.tiff"

# Parquet tables of the truth, written for a complete export; the last two only if there are bodies or satellites.
TABLES: Final = ("frames.parquet", "stars.parquet", "bodies.parquet", "satellites.parquet")

# Splits for learning, the index that describes them, and the data card.
SPLITS: Final = ("train", "validation", "test")
SPLIT_INDEX: Final = "splits.json"
DATA_CARD: Final = "DATACARD.md"
# Files that describe all frames of a complete export; they are removed when frames are added.
SUMMARIES: Final = (*TABLES, SPLIT_INDEX, *(f"{split}.txt" for split in SPLITS), DATA_CARD)

# Matches the name of every file that an export writes.
OURS: Final = re.compile(
    r"frame_\d{6,}(\.(light|trails|saturated|cloud|flare|ground))?\.(png|tiff|fits|jpg)|manifest\.json"
    r"|nav\.jsonl(\.partial)?|truth\.jsonl(\.\w+-[0-9a-f]+)?(\.partial)?"
    r"|(frames|stars|bodies|satellites)\.parquet|splits\.json|(train|validation|test)\.txt|DATACARD\.md"
)

_FOLDER: Final = re.compile(r"frames_\d{6,}")
# Frames in the directory itself, then frames per folder: file managers are slow with very many files in one folder.
_FRAMES_WITHOUT_FOLDER: Final = 10_000
_FRAMES_PER_FOLDER: Final = 1000


def frame_folder(number: int) -> str:
    """Return the folder of a frame.  It depends on the number only, so files stay in place when an export grows.

    Parameters
    ----------
    number : int
        Frame number.

    Returns
    -------
    str
        Name of the folder; empty for the first 10,000 frames.
    """
    return "" if number < _FRAMES_WITHOUT_FOLDER else f"frames_{number - number % _FRAMES_PER_FOLDER:06d}"


def frame_folders(directory: Path) -> list[Path]:
    """Return the folders of frames in a directory, without symbolic links.

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
    """Return whether a name is that of a folder of frames.

    Parameters
    ----------
    name : str

    Returns
    -------
    bool
    """
    return _FOLDER.fullmatch(name) is not None


def output_files(directory: Path) -> Iterator[Path]:
    """Return the entries of a directory and of its folders of frames.

    Parameters
    ----------
    directory : Path

    Yields
    ------
    Path
    """
    for folder in (directory, *frame_folders(directory)):
        yield from folder.iterdir()


def frame_numbers(directory: Path, suffix: str) -> NDArray[np.int64]:
    """Return the frames that have a file.

    Parameters
    ----------
    directory : Path
    suffix : str
        Suffix of the name, such as ".png".

    Returns
    -------
    (n,) int64
        Increasing.
    """
    name = re.compile(rf"frame_(\d{{6,}}){re.escape(suffix)}")
    found = (match for path in output_files(directory) if (match := name.fullmatch(path.name)))
    return np.unique(np.fromiter((int(match[1]) for match in found), dtype=np.int64))
