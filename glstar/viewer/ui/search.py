"""Windows that search while the user types: for commands by their labels, and for objects of the sky by their names.

Up and Down choose a match, Enter takes it, Escape closes the window.
"""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from imgui_bundle import ImVec2, imgui

from glstar.viewer.session.actions import select_object
from glstar.viewer.session.keys import KEYS, AnyAction, KeyBinding, shown_chord
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import Selection, SkyObject
from glstar.viewer.ui.theme import DIALOG, scaled_across

T = TypeVar("T")

_FLAGS = DIALOG | int(imgui.WindowFlags_.always_auto_resize)
_WIDTH = 420.0
# Distance from the top of the window, screen px.
_TOP = 60.0


class SearchWindow(Generic[T]):
    """A query and its matches.

    `hint`: what can be typed, shown while the query is empty; `nothing`: shown when nothing matches.
    """

    def __init__(self, title: str, hint: str, nothing: str) -> None:
        self._title = title
        self._hint = hint
        self._nothing = nothing
        self._is_open = self._focus = False
        self._query = ""
        self._matches: list[T] = []
        self._chosen = 0

    def open(self, matches: Sequence[T] = ()) -> None:
        """Open the window with an empty query; `matches`: listed until the user types."""
        self._is_open = self._focus = True
        self._query = ""
        self._matches = list(matches)
        self._chosen = 0

    def draw(self, search: Callable[[str], Sequence[T]], label: Callable[[T], str]) -> T | None:
        """Draw the window if it is open.

        `search`: query to matches, the best first; `label`: match to its line in the list.  Returns the match that the
        user has taken in this frame.
        """
        if not self._is_open:
            return None
        viewport = imgui.get_main_viewport()
        top = ImVec2(viewport.pos.x + viewport.size.x / 2, viewport.pos.y + _TOP)
        imgui.set_next_window_pos(top, imgui.Cond_.appearing, ImVec2(0.5, 0.0))
        _, stays = imgui.begin(self._title, True, _FLAGS)
        imgui.set_next_item_width(scaled_across(_WIDTH))
        if self._focus:
            imgui.set_keyboard_focus_here()
            self._focus = False
        changed, self._query = imgui.input_text_with_hint("##query", self._hint, self._query)
        if changed:
            self._matches = list(search(self._query))
            self._chosen = 0
        taken = self._draw_matches(label)
        imgui.end()
        self._is_open = bool(stays) and taken is None and not imgui.is_key_pressed(imgui.Key.escape)
        return taken

    def _draw_matches(self, label: Callable[[T], str]) -> T | None:
        if not self._matches:
            if self._query.strip():
                imgui.text_disabled(self._nothing)
            return None
        for key, step in ((imgui.Key.down_arrow, 1), (imgui.Key.up_arrow, -1)):
            if imgui.is_key_pressed(key):
                self._chosen = (self._chosen + step) % len(self._matches)
        for row, match in enumerate(self._matches):
            if imgui.selectable(f"{label(match)}##{row}", row == self._chosen)[0]:
                return match
        entered = imgui.is_key_pressed(imgui.Key.enter, False) or imgui.is_key_pressed(imgui.Key.keypad_enter, False)
        return self._matches[self._chosen] if entered else None


# Most actions that are listed.
_ACTION_ROWS = 14


class CommandPalette:
    """Performs the action that the user finds."""

    def __init__(self) -> None:
        self._window = SearchWindow[KeyBinding]("Commands", "what do you want to do?", "no command has these words")

    def ask(self, _session: Session) -> None:
        """Open the window with the first actions of the menus."""
        self._window.open(KEYS[:_ACTION_ROWS])

    def draw(self) -> AnyAction | None:
        """Draw the window if it is open; return the action that the user has taken in this frame."""
        taken = self._window.draw(lambda query: matching_actions(query)[:_ACTION_ROWS], _action_line)
        return None if taken is None else taken.action


def matching_actions(query: str) -> list[KeyBinding]:
    """Return the actions whose menu and label contain all words of a query.

    Actions whose label begins with the query come first; the others follow in the order of the menus.  `query`: words
    or their beginnings, in any order and case.
    """
    parts = query.casefold().split()
    matches = [
        key
        for key in KEYS
        if all(any(word.startswith(part) for word in f"{key.menu} {key.label}".casefold().split()) for part in parts)
    ]
    return sorted(matches, key=lambda key: not key.label.casefold().startswith(" ".join(parts)))


def _action_line(key: KeyBinding) -> str:
    return f"{key.menu}: {key.label}" + (f"   ({shown_chord(key.chords[0])})" if key.chords else "")


# Most matches that are listed.
_OBJECT_ROWS = 10


class FindWindow:
    """Selects what the user finds."""

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._window = SearchWindow[SkyObject](
            "Find",
            "star, constellation, planet or catalogue number",
            "nothing of this name; stars fainter than the magnitude limit are not searched",
        )

    def ask(self, session: Session) -> None:
        """Open the window."""
        if session.loaded is None:
            session.notify("there is no sky to search yet: open a flight first (Ctrl+O)")
        else:
            self._window.open()

    def draw(self, session: Session) -> bool:
        """Draw the window if it is open; return whether the user has selected an object in this frame."""
        if session.loaded is None:
            return False
        catalogue = session.loaded.simulator.sky.catalogue
        target = self._window.draw(
            lambda query: self._selection.search(catalogue).matches(query, limit=_OBJECT_ROWS), _object_line
        )
        if target is not None:
            select_object(session, self._selection, target)
        return target is not None


def _object_line(target: SkyObject) -> str:
    return f"{target.label}   " + (f"V {target.vmag:.2f}" if target.star_id else target.kind.value)
