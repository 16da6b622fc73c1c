"""What the window remembers from one start to the next: recent flights, its size, night colours and overlays."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from glstar.system.durable import write_atomically
from glstar.viewer.overlays import Overlay

__all__ = ["WindowMemory"]

# Number of flights that are remembered.
_MAX_RECENT: Final = 10
# Valid sizes of a remembered window, screen px.
_SIZES: Final = (200, 20_000)


@dataclass(slots=True, eq=False)
class WindowMemory:
    """Settings of the window that are stored in a file; a damaged file counts as none.

    Attributes
    ----------
    file : Path or None
        None remembers nothing after the window is closed.
    recent : list of str
        Paths or descriptions of the flights opened last, the latest first.
    size : tuple of int or None
        Width and height of the window, screen px.
    night : bool
    overlays : frozenset of Overlay or None
        None for the default.
    text_scale : float
        Size of the text; 1 at first.
    has_toured : bool
        Whether the tour of the window has been shown.
    """

    file: Path | None = None
    recent: list[str] = field(default_factory=list)
    size: tuple[int, int] | None = None
    night: bool = False
    overlays: frozenset[Overlay] | None = None
    text_scale: float = 1.0
    has_toured: bool = False

    @classmethod
    def load(cls, file: Path) -> "WindowMemory":
        """Read the file; entries that are missing or not valid have their defaults.

        Parameters
        ----------
        file : Path

        Returns
        -------
        WindowMemory
        """
        try:
            stored: Any = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            stored = {}
        if not isinstance(stored, dict):
            stored = {}
        recent, size, overlays = stored.get("recent"), stored.get("size"), stored.get("overlays")
        text_scale = stored.get("text_scale")
        return cls(
            file,
            recent=[entry for entry in recent if isinstance(entry, str)] if isinstance(recent, list) else [],
            size=(size[0], size[1]) if _is_size(size) else None,
            night=stored.get("night") is True,
            overlays=_overlays(overlays) if isinstance(overlays, list) else None,
            text_scale=float(text_scale) if isinstance(text_scale, int | float) else 1.0,
            # Who has used the window before there was a tour needs none.
            has_toured=stored.get("has_toured", bool(stored)) is True,
        )

    def opened(self, flight: Path) -> None:
        """Remember that a flight has been opened.

        Parameters
        ----------
        flight : Path
            A log, or a flight described in one line.
        """
        entry = str(flight.resolve()) if flight.exists() else str(flight)
        self.recent = [entry, *(other for other in self.recent if other != entry)][:_MAX_RECENT]

    def save(self) -> None:
        """Write the file; a folder that cannot be written is no reason to disturb the user."""
        if self.file is None:
            return
        overlays = None if self.overlays is None else sorted(overlay.value for overlay in self.overlays)
        stored = {
            "recent": self.recent,
            "size": self.size,
            "night": self.night,
            "overlays": overlays,
            "text_scale": self.text_scale,
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


def _overlays(names: Iterable[object]) -> frozenset[Overlay]:
    known = {overlay.value: overlay for overlay in Overlay}
    return frozenset(known[name] for name in names if isinstance(name, str) and name in known)
