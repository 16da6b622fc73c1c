"""Where converted files go: a directory, or a prefix of an object store by fsspec (``s3://``, ``gs://``, ``memory://``)."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Protocol

from glstar.errors import ExportError
from glstar.export.convertedset import new_directory
from glstar.system.installation import install_command

__all__ = ["ObjectStore", "Target", "is_url", "opened_target"]


class Target(Protocol):
    """A place for whole files."""

    def put(self, name: str, content: bytes) -> None:
        """Write a file.

        Parameters
        ----------
        name : str
            With forward slashes between folders.
        content : bytes
        """
        ...


class _Directory:
    """A directory on a disk."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def put(self, name: str, content: bytes) -> None:
        path = self._directory / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


class ObjectStore:
    """A prefix of an object store.

    Beside each object lies its SHA-256, ``NAME.sha256``, which is sent after it.  An object with the same one is not
    sent again, so that an upload that was cut off goes on where it stopped.

    Parameters
    ----------
    url : str
        Such as ``s3://bucket/night-1``; the file system's own environment variables give keys and hosts.

    Raises
    ------
    ExportError
        If fsspec or the library of this kind of store is missing, or the store does not answer.
    """

    def __init__(self, url: str) -> None:
        self._url, self.sent = url, 0
        with self._explained():
            import fsspec  # noqa: PLC0415 - an extra

            self._files, self._prefix = fsspec.core.url_to_fs(url)

    def put(self, name: str, content: bytes) -> None:
        """Send a file, unless the same one is there."""
        digest = hashlib.sha256(content).hexdigest().encode()
        with self._explained():
            if self.read(f"{name}.sha256") == digest and self._files.exists(self._path(name)):
                return
            self.send(name, content)
            self.send(f"{name}.sha256", digest)
        self.sent += 1

    def send(self, name: str, content: bytes) -> None:
        """Send a file, in place of one of this name.

        Parameters
        ----------
        name : str
            With forward slashes between folders.
        content : bytes
        """
        self.send_all({name: content})

    def send_all(self, contents: Mapping[str, bytes]) -> None:
        """Send files, several at a time where the store can.

        Parameters
        ----------
        contents : mapping of str to bytes
            By name, as for `send`.
        """
        by_path = {self._path(name): content for name, content in contents.items()}
        with self._explained():
            self._make_folders(by_path)
            self._files.pipe(by_path)

    def join(self, name: str, parts: Sequence[str]) -> bool:
        """Make a file of others, one after the other, with one of them at a time in memory.

        Parameters
        ----------
        name : str
            Appears when it is complete.
        parts : sequence of str

        Returns
        -------
        bool
            False, and nothing is made, if one of the parts is missing.
        """
        path = self._path(name)
        with self._explained():
            self._make_folders([path])
            with self._files.open(path, "wb", autocommit=False) as whole:
                is_complete = all(_append(whole, self.read(part)) for part in parts)
            if is_complete:
                whole.commit()
            else:
                whole.discard()
        return is_complete

    def _make_folders(self, paths: Iterable[str]) -> None:
        """Make the folders of files on a disk; a store has none."""
        if "file" in self._files.protocol:
            for folder in {path.rpartition("/")[0] for path in paths}:
                self._files.makedirs(folder, exist_ok=True)

    def read(self, name: str) -> bytes | None:
        """Return a file; None if there is none.

        Parameters
        ----------
        name : str

        Returns
        -------
        bytes or None
        """
        with self._explained():
            try:
                return bytes(self._files.cat_file(self._path(name)))
            except FileNotFoundError:
                return None

    def names(self, beginning: str) -> list[str]:
        """Return the names of the files, outside of folders, that begin with some letters.

        Parameters
        ----------
        beginning : str

        Returns
        -------
        list of str
        """
        with self._explained():
            found = self._files.glob(self._path(f"{beginning}*"))
        return [str(path).rpartition("/")[2] for path in found]

    def remove(self, name: str) -> None:
        """Remove a file.

        Parameters
        ----------
        name : str
        """
        with self._explained():
            self._files.rm_file(self._path(name))

    def _path(self, name: str) -> str:
        return f"{self._prefix.rstrip('/')}/{name}"

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except ImportError as error:
            message = f"needs {error.name or error}: {install_command('storage')}, and the library of the store"
            raise ExportError(self._url, message) from error
        except ExportError:
            raise
        except Exception as error:  # each store has errors of its own
            summary = (str(error).splitlines() or [""])[0]
            hint = "; is there this bucket, and do the environment variables of the store name your keys and its host"
            example = " (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL)" * self._url.startswith("s3:")
            message = f"cannot be written ({type(error).__name__}: {summary}){hint}{example}?"
            raise ExportError(self._url, message) from error


def _append(file: IO[bytes], content: bytes | None) -> bool:
    """Append to a file; return whether there is a content."""
    if content is not None:
        file.write(content)
    return content is not None


def is_url(text: str) -> bool:
    """Return whether a text names an object store rather than a file.

    Parameters
    ----------
    text : str

    Returns
    -------
    bool
    """
    return "://" in text


@contextmanager
def opened_target(output: str) -> Iterator[Target]:
    """Open a new directory, which appears when it is complete, or a prefix of an object store.

    Parameters
    ----------
    output : str

    Yields
    ------
    Target

    Raises
    ------
    ExportError
        If the directory exists, or the store does not answer.
    """
    if is_url(output):
        yield ObjectStore(output)
    else:
        with new_directory(Path(output)) as folder:
            yield _Directory(folder)
