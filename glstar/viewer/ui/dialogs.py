"""Dialogs: files and folders, a range to export or to record, missing inputs of a log, and telemetry links.

Files are chosen in the system's own dialog, or typed into a text field if there is none.
"""

import os
import shutil
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import degrees
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from imgui_bundle import imgui
from imgui_bundle import portable_file_dialogs as pfd

from glstar.errors import ConfigError
from glstar.export.imagefiles.formats import ImageFormat
from glstar.link import serial_ports
from glstar.sky.place.timescale import format_utc, parse_utc
from glstar.viewer.flight.loaded import SITE_FIELDS, SITE_KEYS, UTC_FIELD, InputField, MissingInputs, flight_keys
from glstar.viewer.session.actions import open_sky
from glstar.viewer.session.keys import shown_chord
from glstar.viewer.session.memory import Place
from glstar.viewer.session.recording import RangeVideo, VideoRange
from glstar.viewer.session.saving import SCREEN_FRAMES_PER_S, file_stem, save_range, unused_path
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import button_size, centre_next_window, draw_wrapped, error, scaled_across

Kind = Literal["open", "save", "folder"]

# A time, latitude, longitude and height.
_SKY_FIELDS = (UTC_FIELD._replace(label="UTC"), *SITE_FIELDS)
_AUTO = int(imgui.WindowFlags_.always_auto_resize)
_ENTER = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)
# Width of the widest field of a dialog, screen px.
_WIDTH = 440.0
# The programs that portable_file_dialogs uses on Linux; macOS and Windows have dialogs of their own.
_DIALOG_PROGRAMS = ("zenity", "matedialog", "qarma", "kdialog")


def has_native_dialogs() -> bool:
    """Return whether the system has file dialogs."""
    if sys.platform in {"darwin", "win32"}:
        return True
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return has_display and any(shutil.which(program) for program in _DIALOG_PROGRAMS)


class FileChooser:
    """Lets the user choose a path, one at a time.

    `native`: whether to open the system's dialogs; otherwise the path is typed into a text field.
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

        `kind` {"open", "save", "folder"}; `path`: the initial choice; `take`: called with the chosen path, in `draw`;
        not called if the user cancels.
        """
        if self._dialog is not None:
            return
        self._take = take
        if not self._native:
            self._title = title
            self._text = str(path)
            self._opening = True
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
        if not self._title or not imgui.begin_popup_modal(self._title, None, _AUTO)[0]:
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
        _draw_cancel()
        imgui.end_popup()

    def close(self) -> None:
        """Close a native dialog that is still open."""
        if self._dialog is not None:
            self._dialog.kill()
            self._dialog = None


def _draw_cancel() -> bool:
    """Draw the button Cancel beside the last one; return whether it, or Escape, has closed the dialog."""
    imgui.same_line()
    cancels = imgui.button("Cancel", button_size()) or imgui.is_key_pressed(imgui.Key.escape)
    if cancels:
        imgui.close_current_popup()
    return cancels


class RangeDialog(ABC):
    """Asks for a part of the flight, from the in to the out point unless others are typed.

    `start_s`, `stop_s`: the part, s after the first attitude; `path`: the file or folder to write.
    """

    title: ClassVar[str]
    action: ClassVar[str]

    def __init__(self) -> None:
        self._opening = False
        self.start_s = self.stop_s = 0.0
        self.path = ""

    def ask(self, session: Session) -> None:
        """Open the dialog for the part between the in and out points of the flight shown."""
        if session.head is None or session.flight is None or not self.prepare(session):
            return
        self.start_s, self.stop_s = (end_s - session.head.origin_s for end_s in session.head.part)
        self._opening = True

    def draw(self, session: Session) -> None:
        """Draw the dialog if it is open."""
        if self._opening:
            imgui.open_popup(self.title)
            self._opening = False
        centre_next_window()
        if imgui.begin_popup_modal(self.title, None, _AUTO)[0]:
            self._draw_fields(session)
            imgui.end_popup()

    @abstractmethod
    def prepare(self, session: Session) -> bool:
        """Set the path, and return whether the dialog can be opened."""

    @abstractmethod
    def draw_options(self) -> None:
        """Draw the fields between the range and the path."""

    @abstractmethod
    def draw_summary(self, session: Session) -> bool:
        """Draw what will be written, and return whether it can be."""

    @abstractmethod
    def accept(self, session: Session) -> None:
        """Start what the dialog asked for."""

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
        _draw_cancel()


class ExportDialog(RangeDialog):
    """Asks which part of the flight to export."""

    title: ClassVar = "Export a range"
    action: ClassVar = "Export"

    def __init__(self) -> None:
        super().__init__()
        self._format = 0
        self._noiseless = False

    def prepare(self, session: Session) -> bool:
        """Name the folder, unless one was typed before."""
        self.path = self.path or str(session.output / f"{file_stem(session)}-frames")
        return True

    def draw_options(self) -> None:
        """Draw the format of the frames."""
        formats = ["fits the sensor", *get_args(ImageFormat)]
        _, self._format = imgui.combo("format", self._format, formats)
        _, self._noiseless = imgui.checkbox("noiseless image too (float32 TIFF)", self._noiseless)

    def draw_summary(self, session: Session) -> bool:
        """Draw how many exposures the part has."""
        assert session.head is not None
        section = session.config.exposure
        count = section.count_within(max(min(self.stop_s, session.head.length_s) - max(self.start_s, 0.0), 0.0))
        imgui.text_disabled(f"{count} exposures of {section.duration_s:g} s, one every {section.interval_s:g} s")
        return count > 0

    def accept(self, session: Session) -> None:
        """Export the frames."""
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

    _TITLE = "Missing UTC or position"

    def __init__(self) -> None:
        self._missing: MissingInputs | None = None
        self._typed: dict[str, str] = {}
        self._error = ""
        self._focus = False

    def draw(self, session: Session) -> None:
        """Draw the dialog if something is missing."""
        missing = session.missing
        if missing is not self._missing:
            self._missing = missing
            self._error = ""
            if missing is not None:
                self._typed = dict(missing.typed)
                self._focus = True
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

    def _draw_fields(self, session: Session, missing: MissingInputs) -> None:
        width_px = scaled_across(_WIDTH)
        imgui.push_text_wrap_pos(width_px)
        imgui.text(missing.message)
        imgui.text_disabled(missing.note)
        imgui.pop_text_wrap_pos()
        before = dict(self._typed)
        entered = draw_fields(missing.fields, self._typed, width_px, focus=self._focus)
        self._focus = False
        if self._typed != before and not entered:
            self._error = ""
        if self._error:
            draw_wrapped(self._error, error(), wrap_px=width_px)
        if imgui.button("OK", button_size()) or entered:
            try:
                session.give(missing, self._typed)
            except ConfigError as refusal:
                self._error = str(refusal)
            else:
                imgui.close_current_popup()
        if _draw_cancel():
            session.cancel_missing()


class VideoDialog(RangeDialog):
    """Asks for the range, the speed and the frame rate of a video."""

    title: ClassVar = "Video of a range"
    action: ClassVar = "Record"

    def __init__(self) -> None:
        super().__init__()
        self._speed = 1.0
        self._frames_per_s = SCREEN_FRAMES_PER_S

    def prepare(self, session: Session) -> bool:
        """Name a new file; a video that is being recorded has to end first."""
        if session.video is not None:
            session.notify("a video is being recorded; end it first (Ctrl+R)", is_error=True)
            return False
        self.path = str(unused_path(session.output / f"{file_stem(session)}-range.webm"))
        return True

    def draw_options(self) -> None:
        """Draw the speed and the frame rate."""
        _, self._speed = imgui.input_double("times real time", self._speed, 0.0, 0.0, "%g")
        _, self._frames_per_s = imgui.input_double("frames/s", self._frames_per_s, 0.0, 0.0, "%g")

    def draw_summary(self, session: Session) -> bool:
        """Draw the length of the video, or why it cannot be made."""
        try:
            part = self._part(session)
            length_s = part.count / part.frames_per_s
        except ConfigError as refusal:
            imgui.text_colored(error(), str(refusal))
            return False
        imgui.text_disabled(f"{part.count} frames, {length_s:.1f} s; the picture as it is shown, with its overlays")
        return True

    def accept(self, session: Session) -> None:
        """Record the video."""
        path = Path(self.path.strip()).expanduser()
        session.video = RangeVideo(path if path.suffix else path.with_suffix(".webm"), self._part(session))

    def _part(self, session: Session) -> VideoRange:
        head = session.head
        assert head is not None
        start_s, stop_s = (
            min(max(head.origin_s + end_s, head.first_s), head.last_s) for end_s in (self.start_s, self.stop_s)
        )
        return VideoRange(start_s, stop_s, self._speed, self._frames_per_s)


class SkyDialog:
    """Asks for a place and a time, and shows their sky.

    `place`: typed last; None until then.
    """

    _TITLE = "Sky of a place and time"

    def __init__(self) -> None:
        self.place: Place | None = None
        self._opening = False
        self._typed: dict[str, str] = {}
        self._error = ""

    def show_now(self, session: Session) -> None:
        """Show the sky of now at the place typed last, or in the city of the time zone; ask if neither is known."""
        place = self.place or Place.of_time_zone()
        if place is None:
            self.ask(session)
            return
        if place.name:
            session.notify(f"{place.name}, by this computer's time zone; another place: {shown_chord('Ctrl+K')}")
        open_sky(session, place, time.time())

    def ask(self, _session: Session) -> None:
        """Open the dialog with the place typed last and the present time."""
        place = self.place or Place.of_time_zone()
        site = (
            {}
            if place is None
            else dict(
                zip(
                    SITE_KEYS,
                    (f"{each:g}" for each in (place.latitude_deg, place.longitude_deg, place.height_m)),
                    strict=True,
                )
            )
        )
        self._typed = {UTC_FIELD.key: f"{format_utc(time.time())[:19]}Z", **site}
        self._error = ""
        self._opening = True

    def draw(self, session: Session) -> None:
        """Draw the dialog if it is open."""
        if self._opening:
            imgui.open_popup(self._TITLE)
        centre_next_window()
        if not imgui.begin_popup_modal(self._TITLE, None, _AUTO)[0]:
            return
        width_px = scaled_across(_WIDTH)
        entered = draw_fields(_SKY_FIELDS, self._typed, width_px, focus=self._opening)
        self._opening = False
        if imgui.button("Now", button_size()):
            self._typed[UTC_FIELD.key] = f"{format_utc(time.time())[:19]}Z"
        if self._error:
            draw_wrapped(self._error, error(), wrap_px=width_px)
        if imgui.button("OK", button_size()) or entered:
            self._accept(session)
        _draw_cancel()
        imgui.end_popup()

    def _accept(self, session: Session) -> None:
        try:
            keys = flight_keys(_SKY_FIELDS, self._typed)
            site = session.config.override(**keys).flight.site
        except ConfigError as refusal:
            self._error = str(refusal)
            return
        assert site is not None
        imgui.close_current_popup()
        self.place = Place(degrees(site.latitude_rad), degrees(site.longitude_rad), site.height_m)
        open_sky(session, self.place, parse_utc(self._typed[UTC_FIELD.key]))


def draw_fields(fields: tuple[InputField, ...], typed: dict[str, str], width_px: float, *, focus: bool) -> bool:
    """Draw fields of text; return whether Enter was pressed in one.

    `typed`: their contents by key, which change; `focus`: whether to begin to type into the first.
    """
    entered = False
    for number, field in enumerate(fields):
        if focus and number == 0:
            imgui.set_keyboard_focus_here()
        imgui.set_next_item_width(0.5 * width_px)
        enter, typed[field.key] = imgui.input_text_with_hint(field.label, field.hint, typed.get(field.key, ""), _ENTER)
        entered |= enter
    return entered


_CONNECT_TITLE = "Connect to a telemetry link"
_LINK_WIDTH = 380.0
# Baud rates of telemetry radios and of autopilots' serial ports.
_BAUD_RATES = ("57600", "115200", "921600")
# Links to local programs, and what listens or sends there.
_EXAMPLES = (
    ("udpin:127.0.0.1:14550", "MAVProxy or QGroundControl forward to here"),
    ("tcp:127.0.0.1:5760", "an ArduPilot simulator"),
)


class ConnectDialog:
    """Lists serial ports, and takes any connection string."""

    def __init__(self) -> None:
        self._opening = False
        self._ports: list[tuple[str, str]] = []
        self._link = _EXAMPLES[0][0]
        self._baud_rate = 0

    def ask(self, session: Session) -> None:
        """Open the dialog, with the serial ports that are there now; a session has one link at most."""
        if session.live is not None:
            session.notify(f"{session.live.status.endpoint} is open already; start another glstar for a second link")
            return
        self._opening = True
        self._ports = [(port.device, port.description) for port in serial_ports()]

    def draw(self) -> str | None:
        """Draw the dialog if it is open.

        Returns the connection string that the user has given; None in all other frames.
        """
        if self._opening:
            self._opening = False
            imgui.open_popup(_CONNECT_TITLE)
        centre_next_window()
        link = None
        if imgui.begin_popup_modal(_CONNECT_TITLE, None, _AUTO)[0]:
            link = self._draw_fields()
            imgui.end_popup()
        return link

    def _draw_fields(self) -> str | None:
        width = scaled_across(_LINK_WIDTH)
        if self._ports:
            imgui.set_next_item_width(width / 3)
            _, self._baud_rate = imgui.combo("baud", self._baud_rate, list(_BAUD_RATES))
        else:
            imgui.text_disabled("no serial port: nothing is plugged in")
        offered = [(f"{device},{_BAUD_RATES[self._baud_rate]}", description) for device, description in self._ports]
        for link, description in (*offered, *_EXAMPLES):
            if imgui.selectable(
                f"{link}   {description}", link == self._link, imgui.SelectableFlags_.no_auto_close_popups
            )[0]:
                self._link = link
        imgui.set_next_item_width(width)
        entered, self._link = imgui.input_text("##link", self._link, _ENTER)
        connect = imgui.button("Connect", button_size()) or entered
        _draw_cancel()
        if connect and self._link.strip():
            imgui.close_current_popup()
            return self._link.strip()
        return None
