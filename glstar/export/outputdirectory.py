"""The files of an export in its directory: which frames are complete, and the removal of files."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.export.images import find_damage
from glstar.export.layout import OURS, frame_folders, frame_numbers, is_folder_name, output_files
from glstar.export.lease import revoke_leases
from glstar.export.links import refuse_links
from glstar.export.manifest import refuse_other_settings
from glstar.export.task import FrameTask
from glstar.export.truthfile import TruthFile
from glstar.system.durable import TEMPORARY, flush_directory

__all__ = ["intact_frames", "missing_frames", "remove_all", "remove_leftovers", "remove_staged_files"]

Numbers = NDArray[np.int64]

# The temporary name of a `StagedFile`.
_STAGED: Final = re.compile(re.escape(TEMPORARY) + r"[0-9a-f]{8}-.+")


def missing_frames(task: FrameTask, manifest: dict[str, Any], truth: TruthFile, wanted: Numbers) -> Numbers:
    """Return the frames that have no intact files or no line of truth.

    Parameters
    ----------
    task : FrameTask
    manifest : dict
        The manifest that the export would write.
    truth : TruthFile
        Read by this function.
    wanted : (n,) int64
        Increasing.

    Returns
    -------
    (m,) int64

    Raises
    ------
    ExportError
        If the directory holds frames of other settings, or links.
    """
    refuse_links(task.directory)
    refuse_other_settings(task.directory, manifest)
    truth.read()
    with_truth = np.intersect1d(wanted, truth.numbers, assume_unique=True)
    return np.setdiff1d(wanted, intact_frames(task, with_truth), assume_unique=True)


def intact_frames(task: FrameTask, numbers: Numbers) -> Numbers:
    """Return the frames whose files exist and are neither truncated nor damaged.

    Parameters
    ----------
    task : FrameTask
    numbers : (n,) int64

    Returns
    -------
    (m,) int64
    """
    kinds = task.file_kinds
    for suffix in kinds:
        numbers = np.intersect1d(numbers, frame_numbers(task.directory, suffix))
    intact = [n for n in numbers.tolist() if not any(find_damage(path_of(n)) for path_of in kinds.values())]
    return np.array(intact, dtype=np.int64)


def remove_leftovers(directory: Path) -> None:
    """Remove the unfinished files of runs that were killed, after their workers have stopped writing.

    Parameters
    ----------
    directory : Path
    """
    revoke_leases(directory)
    for path in output_files(directory):
        if path.name.startswith(TEMPORARY):
            path.unlink()


def remove_all(directory: Path) -> None:
    """Remove every file of an export, and its folders if nothing else is in them.

    Parameters
    ----------
    directory : Path
    """
    revoke_leases(directory)
    for entry in directory.iterdir():
        if is_folder_name(entry.name) and entry.is_symlink():
            entry.unlink()  # only the link, not its target
    for path in output_files(directory):
        if path.name.startswith(TEMPORARY) or OURS.fullmatch(path.name):
            path.unlink()
    for folder in frame_folders(directory):
        flush_directory(folder)
        with suppress(OSError):  # it holds files that are not the export's
            folder.rmdir()
    # The old frames must be gone from the disk before a new manifest describes the directory.
    flush_directory(directory)


def remove_staged_files(directory: Path) -> None:
    """Remove files that workers staged before they died; no worker may be running.

    Parameters
    ----------
    directory : Path
    """
    for path in output_files(directory):
        if _STAGED.fullmatch(path.name):
            path.unlink(missing_ok=True)
