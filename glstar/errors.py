"""The exceptions of glstar.

::

    GlstarError                 base class; the message is one line that says what is wrong and what to do
    ├── ConfigError             a setting of a config file or a flag that is not valid
    │   └── FlightTooShortError a flight of a data set that is shorter than one exposure
    ├── CatalogueError          a star catalogue that cannot be opened or built, or lacks a star
    ├── CalibrationError        a camera or sensor calibration that cannot be used
    ├── TelemetryError          telemetry that cannot be replayed
    │   ├── LogFormatError      a file that is not a log, or has no attitude, position or time
    │   ├── LinkError           a link that cannot be opened, or was closed
    │   └── LinkTimeoutError    a link without packets
    ├── TrackRangeError         a time outside the track
    ├── RenderError             an image that cannot be rendered
    │   ├── ContextError        OpenGL is not available
    │   └── ShaderError         a shader that does not compile
    ├── ExportError             files that cannot be written, or would be overwritten
    ├── ImagesError             real images that cannot be used for a comparison
    └── AnswersError            answers of a navigator that cannot be scored

The facts in a message are also attributes of the exception.

Libraries that read files of others raise whatever comes to them of a damaged one.  `reading` is the boundary: what
leaves it is a GlstarError.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from traceback import FrameSummary, extract_tb
from types import MappingProxyType
from typing import Literal

__all__ = [
    "AnswersError",
    "CalibrationError",
    "CatalogueError",
    "ConfigError",
    "ContextError",
    "ExportError",
    "FlightTooShortError",
    "GlstarError",
    "ImagesError",
    "LinkError",
    "LinkTimeoutError",
    "LogFormatError",
    "RenderError",
    "ShaderError",
    "TelemetryError",
    "TrackRangeError",
]


class GlstarError(Exception):
    """Base class of the exceptions of glstar.

    The command line prints the message as one line and exits with 1.
    """

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle by attributes, so that an exception of another process keeps them."""
        return _restored, (type(self), self.args, self.__dict__)


def _restored(kind: type[GlstarError], args: tuple[object, ...], facts: dict[str, object]) -> GlstarError:
    """Return an exception without calling its constructor, whose parameters are not known."""
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(facts)
    return error


class ConfigError(GlstarError, ValueError):
    """A setting that is not valid.

    Attributes
    ----------
    file : str or None
        The config file; None for the command line or the API.
    key : str or None
        The dotted key with the error, such as ``exposure.duration_s``.
    """

    def __init__(self, message: str, *, file: str | PathLike[str] | None = None, key: str | None = None) -> None:
        where = ": ".join(str(part) for part in (file, key) if part is not None)
        super().__init__(f"{where}: {message}" if where else message)
        self.file = None if file is None else str(file)
        self.key = key


class FlightTooShortError(ConfigError):
    """A flight of a data set that is shorter than one exposure.

    Attributes
    ----------
    which : int
        Index of the flight, from 0.
    """

    def __init__(self, which: int, message: str) -> None:
        super().__init__(message)
        self.which = which


class CatalogueError(GlstarError):
    """A star catalogue that cannot be opened or built, or lacks a star.

    Attributes
    ----------
    path : str
        The catalogue file.
    """

    def __init__(self, path: str | PathLike[str], message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = str(path)


class CalibrationError(GlstarError):
    """A camera or sensor calibration that cannot be used.

    Attributes
    ----------
    path : str or None
        The calibration file, if there is one.
    stars_used, stars_needed : int or None
        The number of stars of a fit and the number it needs, if there were too few.
    """

    def __init__(
        self,
        message: str,
        *,
        path: str | PathLike[str] | None = None,
        stars_used: int | None = None,
        stars_needed: int | None = None,
    ) -> None:
        super().__init__(message if path is None else f"{path}: {message}")
        self.path = None if path is None else str(path)
        self.stars_used = stars_used
        self.stars_needed = stars_needed


class TelemetryError(GlstarError):
    """Telemetry that cannot be replayed."""


class LogFormatError(TelemetryError, ValueError):
    """A file that is not a flight log, or a log without attitude, position or time.

    Attributes
    ----------
    path : str
        The log.
    offset : int or None
        Where reading stopped, bytes (or the line, for text) from the start.
    reason : str
        The message without the path.
    lacks : dict of {"UTC", "position"} to str
        What the log lacks and the user can provide, each with the reason, which may be empty.  Empty for other errors.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        message: str,
        *,
        offset: int | None = None,
        lacks: Mapping[Literal["UTC", "position"], str] = MappingProxyType({}),
    ) -> None:
        super().__init__(f"{path}: {message}")
        self.path = str(path)
        self.offset = offset
        self.reason = message
        self.lacks = dict(lacks)


class LinkError(TelemetryError, OSError):
    """A telemetry link that cannot be opened, or was closed.

    Attributes
    ----------
    endpoint : str
        The link as the user named it.
    """

    def __init__(self, endpoint: str, message: str) -> None:
        super().__init__(f"{endpoint}: {message}")
        self.endpoint = endpoint


class LinkTimeoutError(TelemetryError, TimeoutError):
    """A telemetry link without packets.

    Attributes
    ----------
    endpoint : str
        The link as the user named it.
    waited_s : float
        The time that glstar waited, s.
    """

    def __init__(self, endpoint: str, waited_s: float) -> None:
        super().__init__(
            f"no packets on {endpoint} for {waited_s:.1f} s; is the vehicle on, and is no other program using the link?"
        )
        self.endpoint = endpoint
        self.waited_s = waited_s


class TrackRangeError(GlstarError, ValueError):
    """A time outside the track.

    Attributes
    ----------
    asked_s, first_s, last_s : float
        The requested time, and start and end of the track, UTC seconds since 1970.
    """

    def __init__(self, asked_s: float, first_s: float, last_s: float) -> None:
        before, after = f"{first_s - asked_s:.3f} s before it starts", f"{asked_s - last_s:.3f} s after it ends"
        miss = before if asked_s < first_s else after
        super().__init__(
            f"the attitude track lasts {last_s - first_s:.3f} s and cannot answer for a time {miss};"
            " move the exposure inside the log"
        )
        self.asked_s = asked_s
        self.first_s = first_s
        self.last_s = last_s


class RenderError(GlstarError):
    """An image that cannot be rendered."""


class ContextError(RenderError):
    """OpenGL is not available."""


class ShaderError(RenderError):
    """A shader that does not compile.

    Attributes
    ----------
    file : str
        The shader's file name.
    line : int or None
        The line number in the driver's message, if there is one.
    log : str
        The driver's message.
    """

    def __init__(self, file: str, line: int | None, log: str) -> None:
        super().__init__(f"{file}{'' if line is None else f':{line}'}: the driver refuses the shader: {log.strip()}")
        self.file = file
        self.line = line
        self.log = log


class ExportError(GlstarError):
    """Files that cannot be written, or that would be overwritten.

    Attributes
    ----------
    path : str
        The file or directory.
    """

    def __init__(self, path: str | PathLike[str], message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = str(path)


class ImagesError(GlstarError):
    """Real images that cannot be used for a comparison: not a folder of images, no times, a missing file.

    Attributes
    ----------
    path : str
        The folder, table or image.
    """

    def __init__(self, path: str | PathLike[str], message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = str(path)


class AnswersError(GlstarError, ValueError):
    """A file of answers that cannot be scored.

    Attributes
    ----------
    path : str
        The file.
    """

    def __init__(self, path: str | PathLike[str], message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = str(path)


# Set by developers and the tests: mistakes of glstar's own code are then not taken for damage of a file.
_DEVELOPMENT = "GLSTAR_DEVELOPMENT"
_PACKAGE = str(Path(__file__).parent)
_LONGEST_REASON = 300
_Refusal = Callable[..., GlstarError]


@contextmanager
def reading(
    path: str | PathLike[str], refusal: _Refusal, cannot: str = "cannot be read", *, is_unchecked: bool = False
) -> Iterator[None]:
    """Turn whatever a reader raises over a damaged file into one line that names the file and the reason.

    `refusal`: the class of the error, or a function of path and message; `cannot`: its words before the reason of a
    library.  A GlstarError passes unchanged; the message of a ValueError that glstar raises continues "FILE: ".  With
    the environment variable GLSTAR_DEVELOPMENT, a mistake of glstar's own code passes too, unless `is_unchecked`: the
    block takes keys and types of JSON as they are.
    """
    try:
        yield
    except GlstarError:
        raise
    except Exception as error:
        if os.environ.get(_DEVELOPMENT) and _is_mistake(error) and not is_unchecked:
            raise
        is_own_message = isinstance(error, ValueError) and _is_own(error) and not is_unchecked
        message = reason_of(error) if is_own_message else f"{cannot}: {reason_of(error)}"
        if refusal is ConfigError:
            raise ConfigError(message, file=path) from error
        if refusal is CalibrationError:
            raise CalibrationError(message, path=path) from error
        raise refusal(path, message) from error


def reason_of(error: BaseException) -> str:
    """Return what an exception says in one line, for a message after the name of a file."""
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, KeyError):
        return f"it has no {error.args[0] if error.args else 'key'}"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(str(text).split())[:_LONGEST_REASON] or type(error).__name__


def _is_mistake(error: Exception) -> bool:
    """Return whether a line of glstar raised an exception of Python, not by a statement ``raise``.

    Libraries raise exceptions of their own, or in lines of their own.
    """
    is_foreign = type(error).__module__ != "builtins" or isinstance(error, OSError | MemoryError | RecursionError)
    return not is_foreign and _is_own(error) and not _line_of(error).startswith("raise ")


def _is_own(error: Exception) -> bool:
    return _last_call(error).filename.startswith(_PACKAGE)


def _line_of(error: Exception) -> str:
    return _last_call(error).line or ""


def _last_call(error: Exception) -> FrameSummary:
    return extract_tb(error.__traceback__)[-1]
