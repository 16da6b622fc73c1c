"""The directory of an export: names of its files and folders, its lock, its lease, and messages for errors of the disk.

Symbolic links below the directory are refused, so that an export writes to no other one; the directory itself may be a
link.

The processes of an export, on this machine or a cluster, may outlive the export that started them until they have drawn
their current frames. Each run keeps a lease file in the directory while it draws, and its processes hold a shared lock
on the file while they write. A later run takes an exclusive lock on the file, which waits for writes in progress, and
removes it: the processes of the earlier run then cannot write any more.
"""

import errno
import io
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from secrets import token_hex
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.system.files import TEMPORARY, flush_directory, lock_handle, temporary_path

NOISELESS_SUFFIX = ".light.tiff"

# Parquet tables of the truth, written for a complete export; the last two only if there are bodies or satellites.
TABLES = ("frames.parquet", "stars.parquet", "bodies.parquet", "satellites.parquet")

# Splits for learning, the index that describes them, and the data card.
SPLITS = ("train", "validation", "test")
SPLIT_INDEX = "splits.json"
DATA_CARD = "DATACARD.md"
# The page of a set. Other programs write files of this name: only those that begin as glstar's are ever removed.
REPORT = "index.html"
_REPORT_START = (
    b'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="generator" content="glstar">\n'
)
# Files that describe all frames of a complete export; they are removed when frames are added.
SUMMARIES = (*TABLES, SPLIT_INDEX, *(f"{split}.txt" for split in SPLITS), DATA_CARD, REPORT)

# Matches the name of every file that an export writes.
OURS = re.compile(
    r"frame_\d{6,}(\.(light|trails|saturated|cloud|flare|ground))?\.(png|tiff|fits|jpg)|manifest\.json"
    r"|nav\.jsonl(\.partial)?|truth\.jsonl(\.\w+-[0-9a-f]+)?(\.partial)?"
    r"|(frames|stars|bodies|satellites)\.parquet|splits\.json|(train|validation|test)\.txt|DATACARD\.md|index\.html"
)

_FOLDER = re.compile(r"frames_\d{6,}")
# Frames in the directory itself, then frames per folder: file managers are slow with very many files in one folder.
_FRAMES_WITHOUT_FOLDER = 10_000
_FRAMES_PER_FOLDER = 1000


def frame_folder(number: int) -> str:
    """Return the folder of a frame; empty for the first 10,000.

    It depends on the number only, so that files stay in place when an export grows.
    """
    return "" if number < _FRAMES_WITHOUT_FOLDER else f"frames_{number - number % _FRAMES_PER_FOLDER:06d}"


def frame_folders(directory: Path) -> list[Path]:
    """Return the folders of frames in a directory, without symbolic links."""
    named = (entry for entry in directory.iterdir() if is_folder_name(entry.name))
    return [entry for entry in named if entry.is_dir() and not entry.is_symlink()]


def is_folder_name(name: str) -> bool:
    """Return whether a folder with this name holds frames."""
    return _FOLDER.fullmatch(name) is not None


def output_files(directory: Path) -> Iterator[Path]:
    """Return the entries of a directory and of its folders of frames."""
    for folder in (directory, *frame_folders(directory)):
        yield from folder.iterdir()


def frame_numbers(directory: Path, suffix: str) -> NDArray[np.int64]:
    """Return the frames that have a file with a suffix such as ".png", (n,) increasing."""
    name = re.compile(rf"frame_(\d{{6,}}){re.escape(suffix)}")
    found = (match for path in output_files(directory) if (match := name.fullmatch(path.name)))
    return np.unique(np.fromiter((int(match[1]) for match in found), dtype=np.int64))


def is_own_report(path: Path) -> bool:
    """Return whether a file is a page that glstar wrote; raises OSError if it cannot be read."""
    with path.open("rb") as file:
        return file.read(len(_REPORT_START)) == _REPORT_START


def refuse_other_page(path: Path) -> None:
    """Raise ExportError if another program's page is where a page is to be written."""
    if path.exists() and not is_own_report(path):
        raise ExportError(path, "is a page that glstar did not write; move it, or choose another directory")


def remove_own_files(directory: Path) -> None:
    """Remove every file of an export, and its folders if nothing else is in them."""
    revoke_leases(directory)
    for entry in directory.iterdir():
        if is_folder_name(entry.name) and entry.is_symlink():
            entry.unlink()  # only the link, not its target
    for path in output_files(directory):
        is_ours = OURS.fullmatch(path.name) and (path.name != REPORT or is_own_report(path))
        if path.name.startswith(TEMPORARY) or is_ours:
            path.unlink(missing_ok=True)
    for folder in frame_folders(directory):
        flush_directory(folder)
        with suppress(OSError):  # it holds files that are not the export's
            folder.rmdir()
    # The old frames must be gone from the disk before a new manifest describes the directory.
    flush_directory(directory)


_NO_LINKS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_ADVICE = "glstar follows no links below its output directory; remove it, or choose another directory"


def refuse_links(directory: Path) -> None:
    """Refuse a directory where a name that an export uses belongs to a link, a pipe or another kind of file.

    The directory itself may be a link. Raises ExportError, which names the first one.
    """
    folders = [directory]
    for folder in folders:
        with os.scandir(folder) as entries:
            for entry in entries:
                if folder is directory and is_folder_name(entry.name):
                    _refuse(Path(entry.path), is_expected=entry.is_dir(follow_symlinks=False), expected="directory")
                    folders.append(Path(entry.path))
                elif OURS.fullmatch(entry.name) or entry.name.startswith(TEMPORARY):
                    _refuse(Path(entry.path), is_expected=entry.is_file(follow_symlinks=False), expected="regular file")


def image_path(directory: Path, line: Mapping[str, Any]) -> Path:
    """Return the path of the image of a line that `read_truth` gave.

    Raises ExportError if the line names none, or the image or its folder is a link.
    """
    if "file" not in line:
        raise ExportError(directory / "truth.jsonl", f"does not name the image of frame {line.get('frame')}")
    path = directory
    for part in PurePosixPath(line["file"]).parts:
        path /= part
        if path.is_symlink():
            raise ExportError(path, "is a symbolic link; glstar follows none below the directory of a set")
    return path


def refuse_link(path: Path) -> None:
    """Refuse an existing file of the output directory that is a link or no regular file: raises ExportError."""
    _refuse(path, is_expected=stat.S_ISREG(path.lstat().st_mode), expected="regular file")


def _refuse(path: Path, *, is_expected: bool, expected: str) -> None:
    # Another process may have removed it in the meantime.
    if not is_expected and os.path.lexists(path):
        what = "is a symbolic link" if path.is_symlink() else f"is no {expected}"
        raise ExportError(path, f"{what}; {_ADVICE}")


def make_folder(folder: Path) -> None:
    """Make a folder of frames, unless it exists; raises ExportError if a link or a file has its name."""
    try:
        folder.mkdir()
        flush_directory(folder.parent)
    except FileExistsError:
        _refuse(folder, is_expected=stat.S_ISDIR(folder.lstat().st_mode), expected="directory")


def create(path: Path) -> IO[bytes]:
    """Create a file and open it for writing; raises FileExistsError if the name exists, even as a broken link."""
    return path.open("xb")


def open_to_append(path: Path) -> IO[bytes]:
    """Open a file of the output directory for appending; create it if it does not exist.

    If the file has other hard links, as after ``cp -al``, it is copied first, so that the other names keep their
    content.  Raises ExportError if it is a symbolic link or no regular file; OSError if it cannot be opened.
    """
    try:
        file = io.open(path, "ab", opener=_without_links)  # noqa: SIM115, UP020 - pathlib's takes no opener, and tests record io's
    except OSError as error:
        if error.errno not in {errno.ELOOP, errno.EMLINK}:  # EMLINK: FreeBSD's ELOOP
            raise
        raise ExportError(path, f"is a symbolic link; {_ADVICE}") from error
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        file.close()
        _refuse(path, is_expected=False, expected="regular file")
    if status.st_nlink < 2:
        return file
    file.close()
    own = path.with_name(f"{TEMPORARY}{token_hex(4)}-{path.name}")
    try:
        with path.open("rb") as shared, create(own) as copy:
            shutil.copyfileobj(shared, copy)
        own.replace(path)
    finally:
        own.unlink(missing_ok=True)
    return path.open("ab")


def _without_links(path: str, flags: int) -> int:
    return os.open(path, flags | _NO_LINKS, 0o666)


@contextmanager
def directory_lock(directory: Path, *, shared: bool = False) -> Iterator[None]:
    """Lock a directory against other exports; the lock of a killed export is released.

    With `shared`, other exports may hold a shared lock at the same time: shards of one export, and verifications.
    Raises ExportError if another export holds a conflicting lock. On Windows, which locks no directories, and on file
    systems without locks, no export is excluded.
    """
    if sys.platform == "win32":
        yield
        return
    handle = os.open(directory, os.O_RDONLY)
    try:
        if not lock_handle(handle, shared=shared):
            message = "another glstar is writing here; wait for it, or choose another directory"
            raise ExportError(directory, message)
        yield
    finally:
        os.close(handle)


_PREFIX = f"{TEMPORARY}lease-"
# Time for a process of an earlier run to finish writing its frame, s.
_WRITE_TIMEOUT_S = 30.0
_POLL_INTERVAL_S = 0.02


@dataclass(frozen=True, slots=True)
class Lease:
    """Write permission of one run for a directory; its processes receive a copy."""

    path: Path  # The lease file

    @classmethod
    @contextmanager
    def taken(cls, directory: Path) -> Iterator[Self]:
        """Take a lease for the duration of the context."""
        lease = cls(directory / f"{_PREFIX}{token_hex(8)}")
        lease.path.touch(exist_ok=False)
        try:
            yield lease
        finally:
            with suppress(OSError):
                lease.path.unlink(missing_ok=True)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the permission while files are written in the context.

        Raises ExportError if the run has ended, or another run has taken over the directory.
        """
        try:
            handle = os.open(self.path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
        except FileNotFoundError:
            raise self._revoked_error() from None
        try:
            lock_handle(handle, shared=True, wait=True)
            if os.fstat(handle).st_nlink == 0:
                raise self._revoked_error()
            yield
        finally:
            os.close(handle)

    def _revoked_error(self) -> ExportError:
        message = "another run has taken this directory over, or the one that asked for these frames has ended"
        return ExportError(self.path.parent, message)


def revoke_leases(directory: Path) -> None:
    """Revoke the leases of all earlier runs, after their processes have finished writing.

    Raises ExportError if a process does not finish writing in time.
    """
    for path in directory.glob(f"{_PREFIX}*"):
        until_s = time.monotonic() + _WRITE_TIMEOUT_S
        while not _revoke(path):
            if time.monotonic() > until_s:
                message = f"a worker of an earlier export has been writing here for {_WRITE_TIMEOUT_S:.0f} s; stop it"
                raise ExportError(directory, message)
            time.sleep(_POLL_INTERVAL_S)


def _revoke(path: Path) -> bool:
    """Remove a lease file unless a process is writing under it; return whether it is gone."""
    try:
        handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        return True
    except OSError as error:
        if error.errno == errno.ELOOP:  # a symbolic link
            path.unlink()
            return True
        raise
    try:
        if not lock_handle(handle):
            return False
        if sys.platform != "win32":
            path.unlink(missing_ok=True)
    finally:
        os.close(handle)
    if sys.platform == "win32":
        try:  # Windows removes no file that a process has open, which serves as the lock there
            path.unlink(missing_ok=True)
        except PermissionError:
            return False
    return True


@contextmanager
def explain_disk_errors(path: Path) -> Iterator[None]:
    """Turn each OSError of the context into an ExportError with advice.

    The message names `path` if the operating system names no file, or one of glstar's temporary files.
    """
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        named = Path(os.fsdecode(error.filename)) if error.filename is not None else path
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            advice = "the disk is full; make room and run the same command again, it goes on where it stopped"
        elif error.errno in {errno.EACCES, errno.EPERM, errno.EROFS}:
            advice = f"cannot be written ({reason}); choose another directory"
        elif error.errno in {errno.EEXIST, errno.ENOTDIR}:
            advice = f"is no directory ({reason}); choose another"
        else:
            advice = f"cannot be written ({reason}); once it can, the same command goes on where it stopped"
        named = path if named.name.startswith(TEMPORARY) else named
        raise ExportError(named, advice) from error


@contextmanager
def new_directory(output: Path) -> Iterator[Path]:
    """Make a directory that appears under its name when it is complete; yields the one beside it that is to be filled.

    Raises ExportError if it exists, or the disk refuses.
    """
    if output.exists():
        raise ExportError(output, "exists already; name another directory, or remove it")
    with explain_disk_errors(output):
        output.absolute().parent.mkdir(parents=True, exist_ok=True)
        filling = temporary_path(output.absolute())
        assert filling.name.startswith(TEMPORARY)
        filling.mkdir()
        try:
            yield filling
            filling.replace(output)
        finally:
            shutil.rmtree(filling, ignore_errors=True)
