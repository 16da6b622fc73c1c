"""The interface: panels, menus and keys of a session, drawn with imgui on the current OpenGL context."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from imgui_bundle import imgui, implot
from numpy.typing import NDArray

from glstar.render.opengl import Context, Framebuffer
from glstar.viewer.picture.content import Display
from glstar.viewer.session.actions import is_on, is_possible, open_beside, perform
from glstar.viewer.session.keys import KEYS, MENUS, Action, AnyAction, shown_chord
from glstar.viewer.session.memory import Notification, SettingsHistory
from glstar.viewer.session.saving import PictureAction, save_problem_report, save_settings, unused_path
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import Selection
from glstar.viewer.ui.calibration import PHOTO_SUFFIXES, CalibrateWindow
from glstar.viewer.ui.dialogs import ConnectDialog, ExportDialog, FileChooser, MissingDialog, SkyDialog, VideoDialog
from glstar.viewer.ui.guide import ManualWindow, Tour, draw_help, draw_welcome
from glstar.viewer.ui.layout import OBJECT, Panels
from glstar.viewer.ui.painting import Rect, WindowCopy
from glstar.viewer.ui.panels.image import ImagePanel
from glstar.viewer.ui.search import CommandPalette, FindWindow
from glstar.viewer.ui.status import draw_notifications, draw_status_bar
from glstar.viewer.ui.theme import ANY_POPUP, apply_theme, load_font, resized_text

_KEY_NAMES = {
    "Left": "left_arrow",
    "Right": "right_arrow",
    "Up": "up_arrow",
    "Down": "down_arrow",
    "[": "left_bracket",
    "]": "right_bracket",
    ",": "comma",
    ".": "period",
    "/": "slash",
    "-": "minus",
    "=": "equal",
    "Page Up": "page_up",
    "Page Down": "page_down",
    **{str(digit): f"_{digit}" for digit in range(10)},
}
# Longest time between the clicks of a double click in a window of many frames a second, s.
_DOUBLE_CLICK_S = 0.3
# Any number that no control has.
_TAB_OWNER = 0x67_6C_73
_MODIFIERS = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}


def _allow_slow_frames(frames_per_s: float) -> None:
    """Lengthen the time of a double click by three frames: imgui gives each frame one change of a button."""
    io = imgui.get_io()
    io.mouse_double_click_time = _DOUBLE_CLICK_S + (3 / frames_per_s if frames_per_s else 0.0)
    io.mouse_single_click_delay = 2 * io.mouse_double_click_time  # imgui requires that it is longer


class Keyboard:
    """Finds the actions whose keys were pressed in this frame."""

    def __init__(self) -> None:
        self._chords = [(key, [parse_chord(text) for text in key.chords]) for key in KEYS]
        self._codes = {code for _, chords in self._chords for code, _ in chords}
        self._modifiers_before = 0

    @property
    def is_typing(self) -> bool:
        """Whether a text field takes the keys."""
        return bool(imgui.get_io().want_text_input)

    @property
    def has_input_left(self) -> bool:
        """Whether keys or clicks are queued for later frames: imgui gives each frame one change of a key."""
        return len(imgui.get_current_context().input_events_queue) > 0

    def poll(self, perform: Callable[[AnyAction], None]) -> None:
        """Perform the actions of the keys that are pressed; Escape closes menus and dialogs."""
        popup = imgui.is_popup_open("", ANY_POPUP)
        modifiers_now, before = imgui.get_io().key_mods, self._modifiers_before
        self._modifiers_before = modifiers_now
        # In a slow frame Ctrl may be up again before the letter is seen: a released modifier still counts.  It does
        # not if another modifier has been pressed, or if the chord before has just ended: the rest is the next chord.
        released, pressed = before & ~modifiers_now, modifiers_now & ~before
        is_next = pressed or (released and any(imgui.is_key_released(code) for code in self._codes))
        modifiers_here = modifiers_now if is_next else modifiers_now | released
        if popup and not self.is_typing and imgui.is_key_pressed(imgui.Key.escape, False):
            # imgui itself closes menus only with keyboard navigation.
            imgui.internal.close_popup_to_level(0, True)
        if self.is_typing or popup:
            return
        # Tab is an action here: imgui would begin to type into the next field.
        imgui.internal.set_key_owner(imgui.Key.tab, _TAB_OWNER)
        for key, chords in self._chords:
            for code, modifiers in chords:
                down = modifiers_here if imgui.is_key_pressed(code, False) else modifiers_now
                if down == modifiers and imgui.is_key_pressed(code, key.repeats):
                    perform(key.action)


def parse_chord(text: str) -> tuple[imgui.Key, int]:
    """Return the key and the modifiers of a chord; `text`: such as ``"Ctrl+Left"``."""
    *modifiers, name = text.replace("++", "+=").split("+")
    code = getattr(imgui.Key, _KEY_NAMES.get(name, name.lower()))
    return code, sum(int(_MODIFIERS[modifier]) for modifier in modifiers)


_Asks = FindWindow | ConnectDialog | ExportDialog | VideoDialog | CommandPalette | Tour | CalibrateWindow | SkyDialog


class Interface:
    """Draws a session, and performs the user's actions on it.

    `context`: the current one, the renderer's; `layout`: the file that stores the layout of the panels; without it the
    layout is not stored; `scale`: of the screen: 2 if it has twice the pixels; `native_dialogs`: whether files are
    chosen in the system's dialogs.
    """

    def __init__(
        self,
        session: Session,
        context: Context,
        *,
        layout: Path | None = None,
        scale: float = 1.0,
        native_dialogs: bool = False,
    ) -> None:
        self.session = session
        self.wants_to_quit = False
        self.wants_full_screen = False
        self.screenshot: Path | None = None  # Where to save a picture of the next frame
        self.picture: PictureAction | None = None  # What to do with a picture of the next frame
        self.wanted_link: str | None = None  # Connection string of a link that the user has requested
        self.recent: list[str] = []  # The flights opened last, the latest first
        self.text_scale = 1.0  # Size of the text that the user has chosen
        # Those of the last frame: a paused window is drawn again when they change.
        self.drawn_notifications: list[Notification] = []
        self._imgui = imgui.create_context()
        self._implot = implot.create_context()
        io = imgui.get_io()
        io.config_flags |= int(imgui.ConfigFlags_.docking_enable)
        io.set_ini_filename("" if layout is None else str(layout))
        io.config_windows_move_from_title_bar_only = True
        load_font(scale)
        imgui.backends.opengl3_init("#version 330")
        self._display = Display(context)
        self.window_copy = WindowCopy(context)
        self.selection = Selection()
        self._image = ImagePanel(self._display, self.selection)
        has_layout = layout is not None and layout.exists()
        self._panels = Panels(session, self._image, self.selection, self.perform, has_layout=has_layout)
        self.files = FileChooser(native=native_dialogs)
        self.keyboard = Keyboard()
        self.tour = Tour()
        self._exports = ExportDialog()
        self._missing = MissingDialog()
        self._manual = ManualWindow()
        self._videos = VideoDialog()
        self._find = FindWindow(self.selection)
        self._connect = ConnectDialog()
        self._palette = CommandPalette()
        self.sky = SkyDialog()
        self.calibration = CalibrateWindow(context, self.files)
        self._dialogs: dict[AnyAction, _Asks] = {
            Action.PALETTE: self._palette,
            Action.FIND: self._find,
            Action.CONNECT: self._connect,
            Action.SKY: self.sky,
            Action.EXPORT: self._exports,
            Action.VIDEO_OF_RANGE: self._videos,
            Action.TOUR: self.tour,
            Action.CALIBRATE: self.calibration,
        }
        self._history = SettingsHistory()
        self._initial = session.config
        self._help = False
        self._hidden = False
        self._themed: bool | None = None

    # --- a frame ---

    def frame(self, new_platform_frame: Callable[[], None], elapsed_s: float) -> None:
        """Advance time and build the interface; `paint` draws it onto a target.

        `new_platform_frame`: gives imgui the window's size, time and mouse; `elapsed_s`: time since the last frame, s.
        """
        session = self.session
        if self._themed is not session.night:
            self._themed = session.night
            apply_theme(night=session.night)
        imgui.get_style().font_scale_main = self.text_scale
        imgui.backends.opengl3_new_frame()
        new_platform_frame()
        _allow_slow_frames(session.times.frames_per_s)
        imgui.new_frame()
        # Before the session's update, so that this frame shows the effect of a key.
        self.keyboard.poll(self.perform)
        session.update(elapsed_s)
        self._image.has_readout = self.picture is None and session.video is None
        if self._hidden:
            self._panels.draw_image_alone()
        else:
            self._draw_menus()
            draw_status_bar(session)
            self._panels.draw()
            draw_welcome(session, self.recent, self.perform, self.sky.show_now)
        self.drawn_notifications = draw_notifications(session)
        self.files.draw()
        self._exports.draw(session)
        self._videos.draw(session)
        self._missing.draw(session)
        self.sky.draw(session)
        self._manual.draw()
        self.calibration.draw(session)
        self.tour.draw()
        if self._find.draw(session):
            self._panels.show(OBJECT)
        self._help = draw_help(self._help)
        self.wanted_link = self._connect.draw()
        if (action := self._palette.draw()) is not None:
            self.perform(action)
        self._history.observe(session.config, is_dragging=imgui.is_any_item_active())
        imgui.render()

    def paint(self, target: Framebuffer, size: tuple[int, int]) -> None:
        """Draw the interface that `frame` built; `size`: its width and height, px."""
        times = self.session.times
        surface = imgui.get_style_color_vec4(imgui.Col_.window_bg)
        colour = (surface.x, surface.y, surface.z)
        with times.span("presenting"):
            picture_px = self._image.new_picture_px
            copy = self.window_copy.begin(size, colour, None if picture_px is None else Rect(*picture_px))
        with times.span("drawing"):
            self._image.paint(copy, size, colour)
        with times.span("presenting"):
            self.window_copy.finish(target)

    @property
    def visible_px(self) -> tuple[int, int, int, int] | None:
        """Left, top, width and height of the visible part of the picture, px of the framebuffer."""
        return self._image.visible_px

    @property
    def covers_picture(self) -> bool:
        """Whether a menu or a dialog is open, which a picture or a video should not show."""
        return bool(imgui.is_popup_open("", ANY_POPUP))

    def plain_picture(self) -> NDArray[np.uint8] | None:
        """Return the visible part of the picture without overlays; see `ImagePanel.plain_picture`."""
        return self._image.plain_picture()

    def open_dropped(self, path: Path) -> None:
        """Open what the user has dropped onto the window: a photograph to calibrate from, or see `Session.open`."""
        if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file():
            self.calibration.open(self.session, path)
        else:
            self.session.open(path)

    # --- actions and menus ---

    def perform(self, action: AnyAction) -> None:
        """Perform the action of a key or a menu entry."""
        session = self.session
        if perform(action, session) or self._ask_for_path(action) or self._take_earlier_settings(action):
            return
        match action:
            case action if action in self._dialogs:
                self._dialogs[action].ask(session)
            case Action.SAVE_PICTURE | Action.SAVE_PLAIN_PICTURE | Action.COPY_PICTURE:
                self.picture = PictureAction(action)
            case Action.SCREENSHOT:
                self.screenshot = unused_path(session.output / "screenshot.png")
            case Action.QUIT:
                self.wants_to_quit = True
            case Action.HIDE:
                self._hidden = not self._hidden
            case Action.FULL_SCREEN:
                self.wants_full_screen = not self.wants_full_screen
            case Action.LARGER_TEXT | Action.SMALLER_TEXT:
                self.text_scale = resized_text(self.text_scale, 1 if action is Action.LARGER_TEXT else -1)
            case Action.RESET_LAYOUT:
                self._panels.reset_layout()
            case Action.HELP:
                self._help = not self._help
            case Action.REPORT:
                imgui.set_clipboard_text(save_problem_report(session))
            case Action.MANUAL:
                self._manual.is_open = not self._manual.is_open

    def _take_earlier_settings(self, action: AnyAction) -> bool:
        """Undo or redo a change of the settings, or undo all; return whether the action is one of these."""
        match action:
            case Action.UNDO:
                config = self._history.undo()
            case Action.REDO:
                config = self._history.redo()
            case Action.RESET_SETTINGS:
                config = self._initial
            case _:
                return False
        if config is None:
            self.session.notify(f"nothing to {action}")
            return True
        with self.session.errors_reported():
            self.session.use(config)
        return True

    def _ask_for_path(self, action: AnyAction) -> bool:
        """Open the file dialog of an action; return whether the action has one."""
        session, files = self.session, self.files
        match action:
            case Action.OPEN:
                files.ask("open", "Open a flight log", session.loader.last_opened or Path.cwd(), session.open)
            case Action.OPEN_BESIDE if session.loaded is None or session.loaded.is_live:
                session.notify("open a log first (Ctrl+O): another one of the same flight is shown beside it")
            case Action.OPEN_BESIDE:
                files.ask(
                    "open",
                    "Open another log",
                    session.loader.last_opened or Path.cwd(),
                    lambda path: open_beside(session, path),
                )
            case Action.OPEN_SETTINGS:
                files.ask("open", "Open settings", Path.cwd() / "glstar.toml", session.open_settings)
            case Action.OPEN_IMAGES:
                files.ask("folder", "Open a folder of real images", Path.cwd(), session.open)
            case Action.SAVE_SETTINGS:
                default = session.output / "glstar.toml"
                files.ask("save", "Save the settings", default, lambda path: save_settings(session, path))
            case _:
                return False
        return True

    def _draw_menus(self) -> None:
        if not imgui.begin_main_menu_bar():
            return
        for menu in MENUS:
            if imgui.begin_menu(menu):
                for key in (key for key in KEYS if key.menu == menu):
                    shortcut = shown_chord(key.chords[0]) if key.chords else ""
                    is_enabled = is_possible(key.action, self.session)
                    if imgui.menu_item(key.label, shortcut, is_on(key.action, self.session), is_enabled)[0]:
                        self.perform(key.action)
                imgui.end_menu()
        flight = self.session.flight
        if flight is not None:
            text = f"{flight.name}   {flight.attitude_source}"
            free_px = imgui.get_content_region_avail().x - imgui.calc_text_size(text).x
            if free_px > 0:
                imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + free_px)
                imgui.text_disabled(text)
        imgui.end_main_menu_bar()

    def close(self) -> None:
        """Release the interface's objects on the GPU and in imgui; the session stays the caller's."""
        self.files.close()
        self.calibration.close()
        self.window_copy.close()
        self._display.close()
        imgui.backends.opengl3_shutdown()
        implot.destroy_context(self._implot)
        imgui.destroy_context(self._imgui)
