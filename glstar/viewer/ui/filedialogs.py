"""Choosing a file or a folder: the system's own dialog, or a text field if there is none."""

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal

from imgui_bundle import imgui
from imgui_bundle import portable_file_dialogs as pfd

from glstar.viewer.ui.theme import button_size, centre_next_window, scaled_across

__all__ = ["FileChooser", "has_native_dialogs"]

Kind = Literal["open", "save", "folder"]

_AUTO_SIZE: Final = int(imgui.WindowFlags_.always_auto_resize)
_ENTER: Final = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)
# Width of the text field, screen px.
_WIDTH: Final = 440.0
# The programs that portable_file_dialogs uses on Linux; macOS and Windows have dialogs of their own.
_DIALOG_PROGRAMS: Final = ("zenity", "matedialog", "qarma", "kdialog")


def has_native_dialogs() -> bool:
    """Return whether the system has file dialogs.

    Returns
    -------
    bool
    """
    if sys.platform in {"darwin", "win32"}:
        return True
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return has_display and any(shutil.which(program) for program in _DIALOG_PROGRAMS)


class FileChooser:
    """Lets the user choose a path, one at a time.

    Parameters
    ----------
    native : bool
        Whether to open the system's dialogs; otherwise the path is typed into a text field.
    """

    def __init__(self, *, native: bool = False) -> None:
        self._native = native
        self._dialog: Any = None
        self._title = ""
        self._text = ""
        self._take: Callable[[Path], None] = lambda _: None
        self._opening = False

    def ask(self, kind: Kind, title: str, path: Path, take: Callable[[Path], None]) -> None:
        """Open the dialog; does nothing while a native dialog is open.

        Parameters
        ----------
        kind : {"open", "save", "folder"}
        title : str
        path : Path
            The initial choice.
        take : callable
            Called with the chosen path, in `draw`; not called if the user cancels.
        """
        if self._dialog is not None:
            return
        self._take = take
        if not self._native:
            self._title, self._text, self._opening = title, str(path), True
        elif kind == "open":
            self._dialog = pfd.open_file(title, str(path))
        elif kind == "save":
            self._dialog = pfd.save_file(title, str(path))
        else:
            self._dialog = pfd.select_folder(title, str(path))

    @property
    def is_answered(self) -> bool:
        """Whether a native dialog has been closed, and `draw` will take its result."""
        return self._dialog is not None and bool(self._dialog.ready(0))

    def draw(self) -> None:
        """Draw the text field if it is open, and take the result of a native dialog that has been closed."""
        if self.is_answered:
            result, self._dialog = self._dialog.result(), None
            # Dialogs that open files return a list of paths, the others a path; both are empty after Cancel.
            chosen = result[0] if isinstance(result, list) and result else result
            if chosen:
                self._take(Path(chosen))
        self._draw_field()

    def _draw_field(self) -> None:
        if self._opening:
            imgui.open_popup(self._title)
        centre_next_window()
        if not self._title or not imgui.begin_popup_modal(self._title, None, _AUTO_SIZE)[0]:
            return
        if self._opening:
            imgui.set_keyboard_focus_here()
            self._opening = False
        imgui.set_next_item_width(scaled_across(_WIDTH))
        entered, self._text = imgui.input_text("##path", self._text, _ENTER)
        imgui.text_disabled("or drop it onto the window")
        if imgui.button("OK", button_size()) or entered:
            imgui.close_current_popup()
            if self._text.strip():
                self._take(Path(self._text.strip()).expanduser())
        imgui.same_line()
        if imgui.button("Cancel", button_size()) or imgui.is_key_pressed(imgui.Key.escape):
            imgui.close_current_popup()
        imgui.end_popup()

    def close(self) -> None:
        """Close a native dialog that is still open."""
        if self._dialog is not None:
            self._dialog.kill()
            self._dialog = None
