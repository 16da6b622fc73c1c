"""Dialogs: a range to export, the UTC and the site that a log or a link lacks; and the list of keys."""

from pathlib import Path
from typing import ClassVar, Final, get_args

from imgui_bundle import imgui

from glstar.errors import ConfigError
from glstar.export.images import ImageFormat
from glstar.viewer.keys import KEYS, MENUS, shown_chord
from glstar.viewer.missing import MissingFromLink, MissingFromLog
from glstar.viewer.saving import file_stem, save_range
from glstar.viewer.session import Session
from glstar.viewer.ui.rangedialog import RangeDialog
from glstar.viewer.ui.theme import accent, button_size, centre_next_window, dialog_size, error, scaled, scaled_across

__all__ = ["ExportDialog", "MissingDialog", "draw_help"]

_AUTO: Final = int(imgui.WindowFlags_.always_auto_resize)
_ENTER: Final = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)
# Width of the widest field, screen px.
_WIDTH: Final = 440.0
# Size of the list of keys, px.
_HELP_PX: Final = (880.0, 730.0)


class ExportDialog(RangeDialog):
    """Asks which part of the flight to export."""

    title: ClassVar = "Export a range"
    action: ClassVar = "Export"

    def __init__(self) -> None:
        super().__init__()
        self._format = 0
        self._noiseless = False

    def prepare(self, session: Session) -> bool:
        """Name the folder, unless one was typed before.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """
        self.path = self.path or str(session.output / f"{file_stem(session)}-frames")
        return True

    def draw_options(self) -> None:
        """Draw the format of the frames."""
        formats = ["fits the sensor", *get_args(ImageFormat)]
        _, self._format = imgui.combo("format", self._format, formats)
        _, self._noiseless = imgui.checkbox("noiseless image too (float32 TIFF)", self._noiseless)

    def draw_summary(self, session: Session) -> bool:
        """Draw how many exposures the part has.

        Parameters
        ----------
        session : Session

        Returns
        -------
        bool
        """
        assert session.head is not None
        section = session.config.exposure
        count = section.count_within(max(min(self.stop_s, session.head.length_s) - max(self.start_s, 0.0), 0.0))
        imgui.text_disabled(f"{count} exposures of {section.duration_s:g} s, one every {section.interval_s:g} s")
        return count > 0

    def accept(self, session: Session) -> None:
        """Export the frames.

        Parameters
        ----------
        session : Session
        """
        chosen: list[ImageFormat | None] = [None, *get_args(ImageFormat)]
        save_range(
            session,
            Path(self.path.strip()).expanduser(),
            start_s=self.start_s,
            stop_s=self.stop_s,
            image_format=chosen[self._format],
            noiseless=self._noiseless,
        )


class MissingDialog:
    """Asks for the UTC and the site that a log or a link lacks, as long as the session needs them."""

    _TITLE: Final = "Missing UTC or position"

    def __init__(self) -> None:
        self._missing: MissingFromLog | MissingFromLink | None = None
        self._typed: dict[str, str] = {}
        self._error = ""
        self._focus = False

    def draw(self, session: Session) -> None:
        """Draw the dialog if something is missing.

        Parameters
        ----------
        session : Session
        """
        missing = session.missing
        if missing is not self._missing:
            self._missing, self._error = missing, ""
            if missing is not None:
                self._typed, self._focus = dict(missing.typed), True
                imgui.open_popup(self._TITLE)
        centre_next_window()
        if imgui.begin_popup_modal(self._TITLE, None, _AUTO)[0]:
            if missing is None:
                imgui.close_current_popup()
            else:
                self._draw_fields(session, missing)
            imgui.end_popup()
        elif missing is not None:
            session.cancel_missing()  # closed with Escape

    def _draw_fields(self, session: Session, missing: MissingFromLog | MissingFromLink) -> None:
        width_px = scaled_across(_WIDTH)
        imgui.push_text_wrap_pos(width_px)
        imgui.text(missing.message)
        imgui.text_disabled(missing.note)
        imgui.pop_text_wrap_pos()
        entered = False
        for field in missing.fields:
            if self._focus:
                imgui.set_keyboard_focus_here()
                self._focus = False
            imgui.set_next_item_width(0.5 * width_px)
            typed = self._typed.get(field.key, "")
            enter, self._typed[field.key] = imgui.input_text_with_hint(field.label, field.hint, typed, _ENTER)
            if self._typed[field.key] != typed:
                self._error = ""
            entered |= enter
        if self._error:
            imgui.push_text_wrap_pos(width_px)
            imgui.text_colored(error(), self._error)
            imgui.pop_text_wrap_pos()
        if imgui.button("OK", button_size()) or entered:
            try:
                session.give(missing, self._typed)
            except ConfigError as refusal:
                self._error = str(refusal)
            else:
                imgui.close_current_popup()
        imgui.same_line()
        if imgui.button("Cancel", button_size()) or imgui.is_key_pressed(imgui.Key.escape):
            session.cancel_missing()
            imgui.close_current_popup()


def draw_help(is_open: bool) -> bool:
    """Draw the window with the table of keys.

    Parameters
    ----------
    is_open : bool

    Returns
    -------
    bool
        Whether it stays open.
    """
    if not is_open:
        return False
    centre_next_window()
    size = dialog_size(*_HELP_PX)
    imgui.set_next_window_size(size)
    flags = imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_collapse | imgui.WindowFlags_.no_saved_settings
    expanded, stays = imgui.begin("Keys", True, int(flags))
    if expanded:
        columns = 2 if size.x >= scaled(_HELP_PX[0]) - 1 else 1  # two in a narrow window would cut off the text
        imgui.columns(columns, "##keys", False)
        half = (len(KEYS) + len(MENUS)) // 2
        rows = 0
        for menu in MENUS:
            if rows >= half - 3 and imgui.get_column_index() < columns - 1:
                imgui.next_column()
            imgui.text_colored(accent(), menu)
            rows += 1
            for key in (key for key in KEYS if key.menu == menu and key.chords):
                imgui.text_disabled("  " + ", ".join(map(shown_chord, key.chords)))
                imgui.same_line(scaled(130.0))
                imgui.text(key.label)
                rows += 1
        imgui.columns(1)
    imgui.end()
    return bool(stays) and not imgui.is_key_pressed(imgui.Key.escape)
