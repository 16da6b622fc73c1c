"""A window that searches while the user types: Up and Down choose a match, Enter takes it, Escape closes the window."""

from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

from imgui_bundle import ImVec2, imgui

from glstar.viewer.ui.theme import scaled_across

__all__ = ["SearchWindow"]

T = TypeVar("T")

_FLAGS: Final = int(
    imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_collapse
    | imgui.WindowFlags_.always_auto_resize
)
_WIDTH: Final = 420.0
# Distance from the top of the window, screen px.
_TOP: Final = 60.0


class SearchWindow(Generic[T]):
    """A query and its matches.

    Parameters
    ----------
    title : str
    hint : str
        What can be typed, shown while the query is empty.
    nothing : str
        Shown when nothing matches.
    """

    def __init__(self, title: str, hint: str, nothing: str) -> None:
        self._title, self._hint, self._nothing = title, hint, nothing
        self._is_open = self._focus = False
        self._query = ""
        self._matches: list[T] = []
        self._chosen = 0

    def open(self, matches: Sequence[T] = ()) -> None:
        """Open the window with an empty query.

        Parameters
        ----------
        matches : sequence
            Listed until the user types.
        """
        self._is_open = self._focus = True
        self._query, self._matches, self._chosen = "", list(matches), 0

    def draw(self, search: Callable[[str], Sequence[T]], label: Callable[[T], str]) -> T | None:
        """Draw the window if it is open.

        Parameters
        ----------
        search : callable
            Query to matches, the best first.
        label : callable
            Match to its line in the list.

        Returns
        -------
        object or None
            The match that the user has taken in this frame.
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
            self._matches, self._chosen = list(search(self._query)), 0
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
