"""The command palette: every action of the menus, searched by its label."""

from typing import Final

from glstar.viewer.keys import KEYS, AnyAction, KeyBinding, shown_chord
from glstar.viewer.session import Session
from glstar.viewer.ui.searchwindow import SearchWindow

__all__ = ["CommandPalette", "matching_actions"]

# Most actions that are listed.
_ROWS: Final = 14


class CommandPalette:
    """Performs the action that the user finds."""

    def __init__(self) -> None:
        self._window = SearchWindow[KeyBinding]("Commands", "what do you want to do?", "no command has these words")

    def ask(self, _session: Session) -> None:
        """Open the window with the first actions of the menus."""
        self._window.open(KEYS[:_ROWS])

    def draw(self) -> AnyAction | None:
        """Draw the window if it is open.

        Returns
        -------
        Action or Overlay or None
            The action that the user has taken in this frame.
        """
        taken = self._window.draw(lambda query: matching_actions(query)[:_ROWS], _line)
        return None if taken is None else taken.action


def matching_actions(query: str) -> list[KeyBinding]:
    """Return the actions whose menu and label contain all words of a query.

    Parameters
    ----------
    query : str
        Words or their beginnings, in any order and case.

    Returns
    -------
    list of KeyBinding
        Those whose label begins with the query first, then in the order of the menus.
    """
    parts = query.casefold().split()
    found = [
        key
        for key in KEYS
        if all(any(word.startswith(part) for word in f"{key.menu} {key.label}".casefold().split()) for part in parts)
    ]
    return sorted(found, key=lambda key: not key.label.casefold().startswith(" ".join(parts)))


def _line(key: KeyBinding) -> str:
    return f"{key.menu}: {key.label}" + (f"   ({shown_chord(key.chords[0])})" if key.chords else "")
