"""What the window remembers: its state from one start to the next, settings to undo, and messages for some seconds."""

import json
import os
import re
import time
import zoneinfo
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from glstar.config import Config
from glstar.sky.place.timescale import format_utc
from glstar.system.files import write_atomically
from glstar.system.userinput import read_json
from glstar.viewer.overlays.table import Overlay

# Number of flights that are remembered.
_MAX_RECENT = 10
# How long the sky of a place lasts, s, and the greatest height of a place, m.
_SKY_S = 6 * 3600.0
_HIGHEST_M = 100_000.0
# Valid sizes of a remembered window, screen px.
_SIZES = (200, 20_000)


@dataclass(frozen=True, slots=True)
class Place:
    """A place on the Earth."""

    latitude_deg: float  # WGS84
    longitude_deg: float  # Positive eastward
    height_m: float = 0.0
    name: str = ""  # Of the city of a time zone; empty for a place that the user has typed

    @classmethod
    def stored(cls, stored: object) -> "Place | None":
        """Return a place from latitude, longitude and height as stored; None if they are not valid."""
        if not isinstance(stored, list) or len(stored) != 3:
            return None
        if not all(isinstance(each, int | float) for each in stored):
            return None
        latitude_deg, longitude_deg, height_m = map(float, stored)
        is_valid = abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180 and abs(height_m) <= _HIGHEST_M
        return cls(latitude_deg, longitude_deg, height_m) if is_valid else None

    @classmethod
    def of_time_zone(cls) -> "Place | None":
        """Return the city of this computer's time zone, as the system's table has it; None if it names none."""
        zone = os.environ.get("TZ", "").removeprefix(":") or str(Path("/etc/localtime").resolve())
        for folder in zoneinfo.TZPATH:
            try:
                lines = Path(folder, "zone.tab").read_text(encoding="utf-8").splitlines()
            except OSError:
                continue
            for line in lines:
                match line.split("\t"):
                    case [_, at, name, *_] if not line.startswith("#") and zone.endswith(name):
                        latitude_deg, longitude_deg = map(_degrees, re.findall(r"[+-]\d+", at))
                        return cls(latitude_deg, longitude_deg, name=name.rpartition("/")[2].replace("_", " "))
        return None

    def sky(self, utc_s: float) -> Path:
        """Return a flight at rest here for some hours from a time on, UTC seconds since 1970."""
        at = f"latitude_deg={self.latitude_deg:g}&longitude_deg={self.longitude_deg:g}&height_m={self.height_m:g}"
        return Path(f"fly:still?utc_start={format_utc(utc_s)}&{at}&duration_s={_SKY_S:g}&rate_hz=1")


def _degrees(text: str) -> float:
    """Return an angle of the table of time zones, such as ``"-3455"`` and ``"+1383500"``, deg."""
    digits = text[1:]
    whole = 3 if len(digits) in {5, 7} else 2
    seconds = int(digits[whole + 2 :] or 0)
    return float(f"{text[0]}1") * (int(digits[:whole]) + int(digits[whole : whole + 2]) / 60 + seconds / 3600)


@dataclass(slots=True, eq=False)
class WindowMemory:
    """Settings of the window that are stored in a file; a damaged file counts as none."""

    file: Path | None = None  # None remembers nothing after the window is closed
    # Paths or descriptions of the flights opened last, the latest first.
    recent: list[str] = field(default_factory=list)
    size: tuple[int, int] | None = None  # Width and height of the window, screen px
    night: bool = False
    overlays: frozenset[Overlay] | None = None  # None for the default
    text_scale: float = 1.0  # Size of the text; 1 at first
    place: Place | None = None  # The place typed last
    has_toured: bool = False  # Whether the tour of the window has been shown

    @classmethod
    def load(cls, file: Path) -> "WindowMemory":
        """Read the file; entries that are missing or not valid have their defaults."""
        try:
            stored: Any = read_json(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            stored = {}
        if not isinstance(stored, dict):
            stored = {}
        recent, size = stored.get("recent"), stored.get("size")
        overlays, text_scale = stored.get("overlays"), stored.get("text_scale")
        return cls(
            file,
            recent=[entry for entry in recent if isinstance(entry, str)] if isinstance(recent, list) else [],
            size=(size[0], size[1]) if _is_size(size) else None,
            night=stored.get("night") is True,
            overlays=_overlays(overlays) if isinstance(overlays, list) else None,
            text_scale=float(text_scale) if isinstance(text_scale, int | float) else 1.0,
            place=Place.stored(stored.get("place")),
            # Who has used the window before there was a tour needs none.
            has_toured=stored.get("has_toured", bool(stored)) is True,
        )

    def opened(self, flight: Path) -> None:
        """Remember that a flight has been opened; `flight`: a log, or a flight described in one line."""
        entry = str(flight.resolve()) if flight.exists() else str(flight)
        self.recent = [entry, *(other for other in self.recent if other != entry)][:_MAX_RECENT]

    def save(self) -> None:
        """Write the file; a folder that cannot be written is no reason to disturb the user."""
        if self.file is None:
            return
        place = self.place
        overlays = None if self.overlays is None else sorted(overlay.value for overlay in self.overlays)
        stored = {
            "recent": self.recent,
            "size": self.size,
            "night": self.night,
            "overlays": overlays,
            "text_scale": self.text_scale,
            "place": None if place is None else [place.latitude_deg, place.longitude_deg, place.height_m],
            "has_toured": self.has_toured,
        }
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self.file, (json.dumps(stored, indent=1) + "\n").encode())
        except OSError:
            pass


def _is_size(size: object) -> bool:
    return (
        isinstance(size, list)
        and len(size) == 2
        and all(isinstance(n, int) and _SIZES[0] <= n <= _SIZES[1] for n in size)
    )


def _overlays(names: list[object]) -> frozenset[Overlay]:
    return frozenset(overlay for overlay in Overlay if overlay.value in names)


# Number of settings that can be undone.
_LENGTH = 200


class SettingsHistory:
    """The settings before and after the present ones.

    `observe` is called in every frame; while a control is dragged, only the settings before and after are kept.
    """

    def __init__(self) -> None:
        self._past: list[Config] = []
        self._future: list[Config] = []
        self._present: Config | None = None
        self._before_drag: Config | None = None

    def observe(self, config: Config, *, is_dragging: bool) -> None:
        """Record the present settings if they have changed; `is_dragging`: whether the user holds a control."""
        if self._present is None:
            self._present = config
        if config is not self._present:
            if self._before_drag is None:
                self._before_drag = self._present
            self._present = config
        if self._before_drag is not None and not is_dragging:
            if config != self._before_drag:
                self._past = [*self._past, self._before_drag][-_LENGTH:]
                self._future = []
            self._before_drag = None

    def undo(self) -> Config | None:
        """Return the settings before the last change, and make them the present ones; None if there are none."""
        return self._move(self._past, self._future)

    def redo(self) -> Config | None:
        """Return the settings that were undone last, and make them the present ones; None if there are none."""
        return self._move(self._future, self._past)

    def _move(self, source: list[Config], target: list[Config]) -> Config | None:
        if not source or self._present is None:
            return None
        target.append(self._present)
        self._present = source.pop()
        self._before_drag = None
        return self._present


# How long a message and an error stay, s: an error has to be read to its end.
_MESSAGE_S = 6.0
_ERROR_S = 20.0
# Messages shown at the same time: more would cover the image.
_MAX_SHOWN = 4


@dataclass(frozen=True, slots=True)
class Notification:
    """A message to the user."""

    message: str
    is_error: bool
    expires_s: float  # When it disappears, by the clock of its `Notifications`


class Notifications:
    """The messages shown at present; `clock`: returns seconds from any origin."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._shown: list[Notification] = []

    def add(self, message: str, *, is_error: bool = False) -> None:
        """Show a message; the same message shown again replaces the first; `is_error`: errors stay longer."""
        expires_s = self.clock() + (_ERROR_S if is_error else _MESSAGE_S)
        others = [shown for shown in self._shown if shown.message != message]
        self._shown = [*others, Notification(message, is_error, expires_s)][-_MAX_SHOWN:]

    @property
    def current(self) -> list[Notification]:
        """The messages that have not expired, oldest first."""
        now_s = self.clock()
        self._shown = [shown for shown in self._shown if shown.expires_s > now_s]
        return self._shown

    @property
    def errors(self) -> list[str]:
        """The messages of the errors that have not expired, oldest first."""
        return [shown.message for shown in self.current if shown.is_error]

    def dismiss(self, notification: Notification) -> None:
        """Remove a message before it expires."""
        self._shown = [shown for shown in self._shown if shown is not notification]
