"""Logs that are made of another file in a temporary directory: unpacked, or completed."""

import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from glstar.errors import LogFormatError
from glstar.telemetry.source import AttitudeSamples, Boot, LogFacts, Samples, TelemetrySource

__all__ = ["UnpackedSource"]

Unpack = Callable[[str], tuple["tempfile.TemporaryDirectory[str]", Path]]


class UnpackedSource(TelemetrySource):
    """A log in a temporary directory as a telemetry source, under the name of the file that it was made from.

    Parameters
    ----------
    name : str
        The archive.
    unpack : callable
        Writes its log into a temporary directory: ``folder, path = unpack(name)``.
    opener : callable
        Opens that log: ``opener(path)``.

    Raises
    ------
    LogFormatError
        If the archive cannot be unpacked, or its log cannot be read.
    """

    def __init__(self, name: str, unpack: Unpack, opener: Callable[[str], TelemetrySource]) -> None:
        self.name = name
        self._folder, path = unpack(name)
        self._inside = str(path)
        try:
            with self._named():
                self._source = opener(self._inside)
        except BaseException:
            self._folder.cleanup()
            raise
        self.one_clock = self._source.one_clock

    def samples(self) -> Iterator[Samples]:
        """Yield the samples of the log."""
        with self._named():
            yield from self._source.samples()

    def facts(self, boots: Collection[int] = ()) -> LogFacts:
        """Return facts about the log and its vehicle."""
        with self._named():
            return self._source.facts(boots)

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the log."""
        with self._named():
            return self._source.boots()

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield the name and the samples of every attitude of the log."""
        with self._named():
            yield from self._source.attitudes()

    def close(self) -> None:
        """Close the log and remove the unpacked files."""
        self._source.close()
        self._folder.cleanup()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the archive in errors, in place of the temporary file."""
        try:
            yield
        except LogFormatError as error:
            reason = f"{Path(self._inside).name}: {error.reason}".replace(self._inside, Path(self._inside).name)
            raise LogFormatError(self.name, reason, offset=error.offset, lacks=error.lacks) from error
