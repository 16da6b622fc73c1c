"""What dialogs that ask for a part of the flight have in common."""

from abc import ABC, abstractmethod
from typing import ClassVar, Final

from imgui_bundle import imgui

from glstar.viewer.session import Session
from glstar.viewer.ui.theme import button_size, centre_next_window, scaled_across

__all__ = ["RangeDialog"]

_AUTO: Final = int(imgui.WindowFlags_.always_auto_resize)
# Width of the widest field, screen px.
_WIDTH: Final = 440.0


class RangeDialog(ABC):
    """Asks for a part of the flight, from the in to the out point unless others are typed.

    Attributes
    ----------
    start_s, stop_s : float
        The part, s after the first attitude.
    path : str
        The file or folder to write.
    """

    title: ClassVar[str]
    action: ClassVar[str]

    def __init__(self) -> None:
        self._opening = False
        self.start_s = self.stop_s = 0.0
        self.path = ""

    def ask(self, session: Session) -> None:
        """Open the dialog for the part between the in and out points of the flight shown.

        Parameters
        ----------
        session : Session
        """
        if session.head is None or session.flight is None or not self.prepare(session):
            return
        self.start_s, self.stop_s = (end_s - session.head.origin_s for end_s in session.head.part)
        self._opening = True

    def draw(self, session: Session) -> None:
        """Draw the dialog if it is open.

        Parameters
        ----------
        session : Session
        """
        if self._opening:
            imgui.open_popup(self.title)
            self._opening = False
        centre_next_window()
        if imgui.begin_popup_modal(self.title, None, _AUTO)[0]:
            self._draw_fields(session)
            imgui.end_popup()

    @abstractmethod
    def prepare(self, session: Session) -> bool:
        """Set the path, and return whether the dialog can be opened.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """

    @abstractmethod
    def draw_options(self) -> None:
        """Draw the fields between the range and the path."""

    @abstractmethod
    def draw_summary(self, session: Session) -> bool:
        """Draw what will be written, and return whether it can be.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """

    @abstractmethod
    def accept(self, session: Session) -> None:
        """Start what the dialog asked for.

        Parameters
        ----------
        session : Session
        """

    def _draw_fields(self, session: Session) -> None:
        imgui.push_item_width(scaled_across(_WIDTH) * 0.45)
        _, self.start_s = imgui.input_double("from, s", self.start_s, 1.0, 10.0, "%.3f")
        _, self.stop_s = imgui.input_double("to, s", self.stop_s, 1.0, 10.0, "%.3f")
        self.draw_options()
        imgui.pop_item_width()
        imgui.set_next_item_width(scaled_across(_WIDTH))
        _, self.path = imgui.input_text("##path", self.path)
        possible = self.draw_summary(session) and bool(self.path.strip())
        imgui.begin_disabled(not possible)
        entered = imgui.is_key_pressed(imgui.Key.enter) and not imgui.is_any_item_active()
        if imgui.button(self.action, button_size()) or (entered and possible):
            imgui.close_current_popup()
            self.accept(session)
        imgui.end_disabled()
        imgui.same_line()
        if imgui.button("Cancel", button_size()) or imgui.is_key_pressed(imgui.Key.escape):
            imgui.close_current_popup()
