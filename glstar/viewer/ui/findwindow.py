"""The window that searches stars, constellations and bodies by name."""

from typing import Final

from glstar.viewer.actions import select_object
from glstar.viewer.selection import Selection
from glstar.viewer.session import Session
from glstar.viewer.skysearch import SkyObject
from glstar.viewer.ui.searchwindow import SearchWindow

__all__ = ["FindWindow"]

# Most matches that are listed.
_ROWS: Final = 10


class FindWindow:
    """Selects what the user finds.

    Parameters
    ----------
    selection : Selection
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._window = SearchWindow[SkyObject](
            "Find",
            "star, constellation, planet or catalogue number",
            "nothing of this name; stars fainter than the magnitude limit are not searched",
        )

    def ask(self, session: Session) -> None:
        """Open the window.

        Parameters
        ----------
        session : Session
        """
        if session.loaded is None:
            session.notify("there is no sky to search yet: open a flight first (Ctrl+O)")
        else:
            self._window.open()

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
        if session.loaded is None:
            return False
        catalogue = session.loaded.simulator.sky.catalogue
        found = self._window.draw(lambda query: self._selection.search(catalogue).matches(query, limit=_ROWS), _line)
        if found is not None:
            select_object(session, self._selection, found)
        return found is not None


def _line(found: SkyObject) -> str:
    return f"{found.label}   " + (f"V {found.vmag:.2f}" if found.star_id else found.kind)
