"""The window that searches stars, constellations and bodies by name."""

from typing import Final

from imgui_bundle import ImVec2, imgui

from glstar.viewer.actions import select_object
from glstar.viewer.selection import Selection
from glstar.viewer.session import Session
from glstar.viewer.skysearch import SkyObject

__all__ = ["FindWindow"]

_TITLE: Final = "Find"
_FLAGS: Final = int(
    imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_collapse
    | imgui.WindowFlags_.always_auto_resize
)
_WIDTH: Final = 380.0
# Most matches that are listed.
_ROWS: Final = 10


class FindWindow:
    """Searches while the user types; Up and Down choose a match, Enter selects it, Escape closes the window.

    Parameters
    ----------
    selection : Selection
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._is_open = self._focus = False
        self._query = ""
        self._matches: list[SkyObject] = []
        self._chosen = 0

    def ask(self, session: Session) -> None:
        """Open the window with an empty query.

        Parameters
        ----------
        session : Session
        """
        if session.loaded is None:
            session.notify("there is no sky to search yet: open a flight first (Ctrl+O)")
            return
        self._is_open = self._focus = True
        self._query, self._matches, self._chosen = "", [], 0

    def draw(self, session: Session) -> bool:
        """Draw the window if it is open.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
            Whether the user has selected an object in this frame.
        """
        if not self._is_open or session.loaded is None:
            return False
        viewport = imgui.get_main_viewport()
        centre_x = viewport.pos.x + viewport.size.x / 2
        imgui.set_next_window_pos(ImVec2(centre_x, viewport.pos.y + 60), imgui.Cond_.appearing, ImVec2(0.5, 0.0))
        _, stays = imgui.begin(_TITLE, True, _FLAGS)
        imgui.set_next_item_width(_WIDTH * imgui.get_style().font_scale_dpi)
        if self._focus:
            imgui.set_keyboard_focus_here()
            self._focus = False
        changed, self._query = imgui.input_text_with_hint(
            "##query", "star, constellation, planet or catalogue number", self._query
        )
        if changed:
            search = self._selection.search(session.loaded.simulator.sky.catalogue)
            self._matches, self._chosen = search.matches(self._query, limit=_ROWS), 0
        chosen = self._draw_matches()
        imgui.end()
        if chosen is not None:
            select_object(session, self._selection, chosen)
        self._is_open = bool(stays) and chosen is None and not imgui.is_key_pressed(imgui.Key.escape)
        return chosen is not None

    def _draw_matches(self) -> SkyObject | None:
        """Draw the list of matches; return the one that the user selects."""
        if self._query.strip() and not self._matches:
            imgui.text_disabled("nothing of this name; stars fainter than the magnitude limit are not searched")
            return None
        for key, step in ((imgui.Key.down_arrow, 1), (imgui.Key.up_arrow, -1)):
            if self._matches and imgui.is_key_pressed(key):
                self._chosen = (self._chosen + step) % len(self._matches)
        for row, match in enumerate(self._matches):
            magnitude = f"   V {match.vmag:.2f}" if match.star_id else f"   {match.kind}"
            if imgui.selectable(f"{match.label}{magnitude}##{row}", row == self._chosen)[0]:
                return match
        if self._matches and (
            imgui.is_key_pressed(imgui.Key.enter, False) or imgui.is_key_pressed(imgui.Key.keypad_enter, False)
        ):
            return self._matches[self._chosen]
        return None
