"""Everything that glstar refuses, and the words it uses.

::

    GlstarError                 one clear line: what was asked, what is true, what to do
    ├── ConfigError             a config file or a flag that cannot be meant
    │   └── FlightTooShortError a flight of a data set in which no exposure fits
    ├── CatalogueError          a star catalogue that is none, or holds no such star
    ├── CalibrationError        a camera or sensor calibration that cannot be used
    ├── TelemetryError          telemetry that cannot be replayed
    │   ├── LogFormatError      a file that is no log, or has no attitude, place or time
    │   ├── LinkError           a link that cannot be opened, or is gone
    │   └── LinkTimeoutError    a link on which nothing arrives
    ├── TrackRangeError         a time that the track does not cover
    ├── RenderError             a picture that cannot be drawn
    │   ├── ContextError        no OpenGL to draw with
    │   └── ShaderError         a shader that does not compile
    ├── ExportError             files that cannot be written, or would be overwritten
    ├── ImagesError             real images that cannot be compared with
    └── AnswersError            answers of a navigator that cannot be scored

Each carries, as attributes, the facts that its message tells.
"""

from collections.abc import Mapping
from os import PathLike
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
    """The base of all that glstar raises on purpose.

    The command line prints it as one line and exits with 1.
    """

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle by attributes: an error must come back whole from another process."""
        return _revived, (type(self), self.args, self.__dict__)


def _revived(kind: type[GlstarError], args: tuple[object, ...], facts: dict[str, object]) -> GlstarError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(facts)
    return error


class ConfigError(GlstarError, ValueError):
    """A setting that cannot be meant.

    Attributes
    ----------
    file : str or None
        The config file, None for the command line or the API.
    key : str or None
        The key at fault, dotted: ``exposure.duration_s``.
    """

    def __init__(self, message: str, *, file: str | PathLike[str] | None = None, key: str | None = None) -> None:
        where = ": ".join(str(part) for part in (file, key) if part is not None)
        super().__init__(f"{where}: {message}" if where else message)
        self.file = None if file is None else str(file)
        self.key = key


class FlightTooShortError(ConfigError):
    """A flight of a data set in which no exposure fits.

    Attributes
    ----------
    which : int
        Its place among the flights, from 0.
    """

    def __init__(self, which: int, message: str) -> None:
        super().__init__(message)
        self.which = which


class CatalogueError(GlstarError):
    """A star catalogue that cannot be opened, built or asked this.

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
        How many stars a fit had and how many it needs, where that is the reason.
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
        self.stars_used, self.stars_needed = stars_used, stars_needed


class TelemetryError(GlstarError):
    """Telemetry that cannot be replayed."""


class LogFormatError(TelemetryError, ValueError):
    """A file that is no flight log, or one without attitude, place or time.

    Attributes
    ----------
    path : str
        The log.
    offset : int or None
        Where reading stopped, bytes (or the line, for text) from the start.
    reason : str
        The message without the path.
    lacks : dict of {"UTC", "position"} to str
        What the log lacks and could be given, with the reason (it may be empty).  Empty if something else is wrong.
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
        self.path, self.offset, self.reason, self.lacks = str(path), offset, message, dict(lacks)


class LinkError(TelemetryError, OSError):
    """A telemetry link that cannot be opened, or is gone.

    Attributes
    ----------
    endpoint : str
        The link as the user named it.
    """

    def __init__(self, endpoint: str, message: str) -> None:
        super().__init__(f"{endpoint}: {message}")
        self.endpoint = endpoint


class LinkTimeoutError(TelemetryError, TimeoutError):
    """A link on which nothing arrives.

    Attributes
    ----------
    endpoint : str
        The link as the user named it.
    waited_s : float
        How long glstar listened.
    """

    def __init__(self, endpoint: str, waited_s: float) -> None:
        super().__init__(
            f"no packets on {endpoint} for {waited_s:.1f} s; is the vehicle on, and is no other program using the link?"
        )
        self.endpoint, self.waited_s = endpoint, waited_s


class TrackRangeError(GlstarError, ValueError):
    """A track was asked about a time that it does not cover.

    Attributes
    ----------
    asked_s, first_s, last_s : float
        The time asked for and the ends of the track, UTC seconds since 1970.
    """

    def __init__(self, asked_s: float, first_s: float, last_s: float) -> None:
        miss = (
            f"{first_s - asked_s:.3f} s before it starts"
            if asked_s < first_s
            else f"{asked_s - last_s:.3f} s after it ends"
        )
        super().__init__(
            f"the attitude track lasts {last_s - first_s:.3f} s and cannot answer for a time {miss};"
            " move the exposure inside the log"
        )
        self.asked_s, self.first_s, self.last_s = asked_s, first_s, last_s


class RenderError(GlstarError):
    """A picture that cannot be drawn."""


class ContextError(RenderError):
    """No OpenGL to draw with."""


class ShaderError(RenderError):
    """A shader that does not compile.

    Attributes
    ----------
    file : str
        The shader's file name.
    line : int or None
        The line that the driver names, if it names one.
    log : str
        The driver's own words.
    """

    def __init__(self, file: str, line: int | None, log: str) -> None:
        super().__init__(f"{file}{'' if line is None else f':{line}'}: the driver refuses the shader: {log.strip()}")
        self.file, self.line, self.log = file, line, log


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
    """Real images that cannot be compared with: no folder of them, no times, no such file.

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
