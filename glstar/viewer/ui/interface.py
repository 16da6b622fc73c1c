"""The interface: panels, menus and keys of a session, drawn on whatever OpenGL context is current."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from imgui_bundle import ImVec2, ImVec4, imgui, implot

from glstar.render.opengl.objects import Context, Framebuffer
from glstar.sky.timescale import format_utc
from glstar.viewer.actions import is_on, perform
from glstar.viewer.display import Display
from glstar.viewer.flightlines import FlightLines
from glstar.viewer.keys import KEYS, MENUS, Action, AnyAction
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.notifications import Notification
from glstar.viewer.playhead import PlayHead
from glstar.viewer.saving import save_comparison, save_settings, unused_path
from glstar.viewer.session import Session
from glstar.viewer.ui.comparisonpanel import ComparisonPanel
from glstar.viewer.ui.dialogs import ExportDialog, MissingDialog, PathDialog, draw_help
from glstar.viewer.ui.imagepanel import ImagePanel
from glstar.viewer.ui.linkpanel import LinkPanel, latency_words
from glstar.viewer.ui.settingspanel import draw_display, draw_settings
from glstar.viewer.ui.theme import accent, apply_theme, error, load_font
from glstar.viewer.ui.timeline import PlaybackControls, Timeline

__all__ = ["Interface"]

_INTERNAL = imgui.internal

_IMAGE, _TIMELINE, _LINK, _SETTINGS, _DISPLAY, _COMPARE = "Image", "Time", "Link", "Settings", "View", "Compare"

_BAR: Final = int(
    imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_scroll_with_mouse
)
_PLAIN: Final = int(imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_scroll_with_mouse)
_BARE: Final = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_bring_to_front_on_focus
)
_NOTICE: Final = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.always_auto_resize
)
_NOTICE_WIDTH: Final = 520.0
_DOCKING_FRAMES: Final = 3
# What the controls of the settings need in width, and those of time in height, px.
_RIGHT_PX: Final = 300.0
_BELOW_PX: Final = 230.0
_NOTHING: Final = (0.0, 0.0)

_KEY_NAMES: Final = {
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
_MODIFIERS: Final = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}


class Interface:
    """Draws a session and gives it what the user does.

    Parameters
    ----------
    session : Session
    context : Context
        The current one, the renderer's.
    layout : Path, optional
        Where the places of the panels are remembered; nowhere without it.
    scale : float
        Of the screen: 2 where it has twice the pixels.
    """

    def __init__(self, session: Session, context: Context, *, layout: Path | None = None, scale: float = 1.0) -> None:
        self.session = session
        self.wants_to_quit = False
        self.wants_full_screen = False
        self.screenshot: Path | None = None
        # What the last frame said: a paused window is drawn again when it should say something else.
        self.drawn_notices: list[Notification] = []
        self._context = context
        self._imgui = imgui.create_context()
        self._implot = implot.create_context()
        io = imgui.get_io()
        io.config_flags |= int(imgui.ConfigFlags_.docking_enable)
        io.set_ini_filename("" if layout is None else str(layout))
        io.config_windows_move_from_title_bar_only = True
        self._lays_out = layout is None or not layout.exists()
        # Number of frames in which the first of the panels in one place is brought to the front: docking a layout that
        # was remembered takes two.
        self._fronts = _DOCKING_FRAMES
        load_font(scale)
        imgui.backends.opengl3_init("#version 330")
        self._display = Display(context)
        self._image = ImagePanel(self._display)
        self._playback = PlaybackControls()
        self._timeline: Timeline | None = None
        self._timeline_of: PlayHead | None = None
        self._lines: FlightLines | None = None
        self._link = LinkPanel()
        self._compare = ComparisonPanel(session.comparison)
        self._paths, self._exports, self._missing = PathDialog(), ExportDialog(), MissingDialog()
        self._help = False
        self._hidden = False
        self._themed: bool | None = None
        self._docked: set[str] = set()
        self._modifiers_before = 0
        self._chords = [(key, [_chord(text) for text in key.chords]) for key in KEYS]
        self._codes = {code for _, chords in self._chords for code, _ in chords}

    # --- a frame ---

    def frame(self, new_platform_frame: Callable[[], None], elapsed_s: float) -> None:
        """Let time pass and build the interface; `paint` puts it onto a target.

        Parameters
        ----------
        new_platform_frame : callable
            Tells imgui the window's size, time and mouse.
        elapsed_s : float
            Since the last frame, s.
        """
        session = self.session
        if self._themed is not session.night:
            self._themed = session.night
            apply_theme(night=session.night)
        imgui.backends.opengl3_new_frame()
        new_platform_frame()
        imgui.new_frame()
        # Before time passes: what a key does is seen in this very frame.
        self._take_keys()
        session.update(elapsed_s)
        self._take_lines()
        if self._hidden:
            self._draw_image_alone()
        else:
            self._draw_menus()
            self._draw_status()
            self._draw_panels()
        self._draw_notices()
        self._paths.draw()
        self._exports.draw(session)
        self._missing.draw(session)
        self._help = draw_help(self._help)
        imgui.render()

    def _take_lines(self) -> None:
        """Let the timeline show the flight of now."""
        session = self.session
        if session.loaded is None or session.loaded.lines is self._lines:
            return
        head, lines = session.loaded.head, session.loaded.lines
        if head is not self._timeline_of or self._timeline is None:
            self._timeline, self._timeline_of = Timeline(session.loaded.flight, lines, grows=head.grows), head
        else:
            self._timeline.show(lines)
        self._lines = lines

    def paint(self, target: Framebuffer, size: tuple[int, int]) -> None:
        """Draw what `frame` built.

        Parameters
        ----------
        target : Framebuffer
        size : tuple of int
            Its width and height, px.
        """
        with self.session.times.span("presenting"):
            target.use()
            self._context.viewport = 0, 0, *size
            surface = imgui.get_style_color_vec4(imgui.Col_.window_bg)
            self._context.clear(surface.x, surface.y, surface.z, 1.0)
            imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())

    @property
    def is_typing(self) -> bool:
        """Whether the keys belong to a text that is being typed."""
        return bool(imgui.get_io().want_text_input)

    @property
    def has_input_left(self) -> bool:
        """Whether there are keys and clicks that no frame has taken yet: imgui gives each frame one change of a key."""
        return len(imgui.get_current_context().input_events_queue) > 0

    # --- keys and menus ---

    def _take_keys(self) -> None:
        popup = imgui.is_popup_open("", int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level))
        modifiers_now, before = imgui.get_io().key_mods, self._modifiers_before
        self._modifiers_before = modifiers_now
        # A quick hand has let go of Ctrl before a slow frame sees the letter; but where another modifier has joined, or
        # the chord before has just ended, it is the next chord's that are held.
        let_go, joined = before & ~modifiers_now, modifiers_now & ~before
        is_next = joined or (let_go and any(imgui.is_key_released(code) for code in self._codes))
        modifiers_here = modifiers_now if is_next else modifiers_now | let_go
        if popup and not self.is_typing and imgui.is_key_pressed(imgui.Key.escape, False):
            # Menus, too: imgui closes them by itself only where the keyboard moves through them.
            _INTERNAL.close_popup_to_level(0, True)
        if self.is_typing or popup:
            return
        for key, chords in self._chords:
            for code, modifiers in chords:
                held = modifiers_here if imgui.is_key_pressed(code, False) else modifiers_now
                if held == modifiers and imgui.is_key_pressed(code, key.repeats):
                    self.perform(key.action)

    def perform(self, action: AnyAction) -> None:
        """Do what a key or a menu entry asks for.

        Parameters
        ----------
        action : Action or Overlay
        """
        session = self.session
        if perform(action, session):
            return
        match action:
            case Action.OPEN:
                self._paths.ask("Open a flight log", session.loader.last_opened or Path.cwd(), session.open)
            case Action.OPEN_SETTINGS:
                self._paths.ask("Open settings", Path.cwd() / "glstar.toml", session.open_settings)
            case Action.OPEN_IMAGES:
                self._paths.ask("Open a folder of real images", Path.cwd(), session.open)
            case Action.SAVE_SETTINGS:
                self._paths.ask(
                    "Save the settings", session.output / "glstar.toml", lambda path: save_settings(session, path)
                )
            case Action.EXPORT:
                self._exports.ask(session)
            case Action.SCREENSHOT:
                self.screenshot = unused_path(session.output / "screenshot.png")
            case Action.QUIT:
                self.wants_to_quit = True
            case Action.HIDE:
                self._hidden = not self._hidden
            case Action.FULL_SCREEN:
                self.wants_full_screen = not self.wants_full_screen
            case Action.RESET_LAYOUT:
                self._lays_out = True
            case Action.HELP:
                self._help = not self._help

    def _draw_menus(self) -> None:
        if not imgui.begin_main_menu_bar():
            return
        for menu in MENUS:
            if imgui.begin_menu(menu):
                for key in (key for key in KEYS if key.menu == menu):
                    shortcut = key.chords[0] if key.chords else ""
                    if imgui.menu_item(key.label, shortcut, is_on(key.action, self.session))[0]:
                        self.perform(key.action)
                imgui.end_menu()
        flight = self.session.flight
        if flight is not None:
            words = f"{flight.name}   {flight.attitude_source}"
            room = imgui.get_content_region_avail().x - imgui.calc_text_size(words).x
            if room > 0:
                imgui.set_cursor_pos_x(imgui.get_cursor_pos_x() + room)
                imgui.text_disabled(words)
        imgui.end_main_menu_bar()

    # --- panels ---

    def _draw_panels(self) -> None:
        session = self.session
        # The window has been cleared to its colour: another layer of it is a tenth of a frame on software OpenGL.
        imgui.push_style_color(int(imgui.Col_.window_bg), (0.0, 0.0, 0.0, 0.0))
        dock = imgui.dock_space_over_viewport(flags=int(imgui.DockNodeFlags_.passthru_central_node))
        imgui.pop_style_color()
        if self._lays_out:
            _lay_out(dock)
            self._fronts = 1
        imgui.push_style_var(int(imgui.StyleVar_.window_padding), ImVec2(*_NOTHING))
        visible = imgui.begin(_IMAGE, None, _PLAIN | int(imgui.WindowFlags_.no_background))[0]
        imgui.pop_style_var()
        if visible:
            self._image.draw(session)
        imgui.end()
        if self._begin(_TIMELINE, _PLAIN) and session.head is not None and self._timeline is not None:
            self._playback.draw(session.head)
            if self._playback.error is not None:
                # A notice goes by itself.
                session.notify(self._playback.error, is_error=True)
                self._playback.error = None
            self._timeline.draw(session.head, night=session.night)
        imgui.end()
        live = session.live
        if live is not None:
            if self._begin(_LINK):
                self._link.draw(live)
            imgui.end()
        if self._begin(_SETTINGS):
            draw_settings(session)
        imgui.end()
        if self._begin(_DISPLAY):
            draw_display(session)
            self._draw_overlay_switches()
        imgui.end()
        if self._begin(_COMPARE) and session.head is not None:
            self._draw_comparison()
        imgui.end()
        if self._fronts:
            # Of panels in one place the first is in front, and at a later start too: the others may be empty then.
            imgui.set_window_focus(_SETTINGS if live is None else _LINK)
            self._fronts -= 1
        self._lays_out = False

    def _begin(self, name: str, flags: int = 0) -> bool:
        """Begin a panel; docked it needs no background, for the window has been cleared to its colour."""
        if name in self._docked:
            imgui.set_next_window_bg_alpha(0.0)
        visible = imgui.begin(name, None, flags)[0]
        (self._docked.add if imgui.is_window_docked() else self._docked.discard)(name)
        return visible

    def _draw_overlay_switches(self) -> None:
        imgui.separator_text("Overlays")
        for key in KEYS:
            if key.menu == "Overlays":
                changed, _ = imgui.checkbox(key.label, is_on(key.action, self.session))
                imgui.set_item_tooltip(f"key {key.chords[0]}")
                if changed:
                    self.perform(key.action)

    def _draw_comparison(self) -> None:
        session = self.session
        assert session.head is not None
        real = session.real
        image = session.comparison.image_at(session.head.utc_s)
        asked = self._compare.draw(
            session.head.utc_s,
            image,
            real[1] if real is not None and real[0] is image else None,
            trouble=session.status if image is not None else "",
        )
        if asked.seek_utc_s is not None:
            session.head.seek(asked.seek_utc_s)
        if asked.save_view:
            save_comparison(session)

    def _draw_image_alone(self) -> None:
        viewport = imgui.get_main_viewport()
        imgui.set_next_window_pos(viewport.pos)
        imgui.set_next_window_size(viewport.size)
        imgui.push_style_var(int(imgui.StyleVar_.window_padding), ImVec2(*_NOTHING))
        imgui.push_style_var(int(imgui.StyleVar_.window_border_size), 0.0)
        imgui.begin("##alone", None, _BARE)
        imgui.pop_style_var(2)
        self._image.draw(self.session)
        imgui.end()

    def _draw_status(self) -> None:
        height = imgui.get_frame_height()
        side = int(imgui.Dir.down)
        if _INTERNAL.begin_viewport_side_bar("##status", imgui.get_main_viewport(), imgui.Dir(side), height, _BAR):
            imgui.set_cursor_pos_y((height - imgui.get_text_line_height()) / 2)
            self._draw_status_words()
        imgui.end()

    def _draw_status_words(self) -> None:
        session = self.session
        head, scene = session.head, session.scene
        if session.live is not None:
            self._draw_link_words(session.live)
        if head is not None:
            imgui.text(f"{format_utc(head.utc_s)[:23]}Z")
            if session.flight is not None and session.flight.time_offset_s:
                _next(f"camera {format_utc(head.utc_s + session.flight.time_offset_s)[11:23]}Z")
            if not head.grows:
                _next(f"{head.second:.3f} / {head.length_s:.1f} s")
            if not head.live:
                _next(
                    f"x{head.speed:g}{'' if head.playing else ' paused'}",
                    None if head.playing else imgui.get_style_color_vec4(imgui.Col_.text_disabled),
                )
            if not head.live:
                _next(str(head.mode))
        if scene is not None:
            _next(
                f"{scene.exposure.duration_s:g} s in {len(scene.trails)} segments"
                if scene.exposure.trail == "analytic"
                else f"{scene.exposure.duration_s:g} s in {len(scene.trails.pointing)} sub-exposures"
            )
            _next(f"{scene.visible.size} stars")
            _next(f"{100 * session.view.zoom:.0f} %")
        if session.loader.path is not None:
            _next(f"reading {session.loader.path.name} ...", accent())
        if session.export is not None:
            self._draw_progress()
        rate = f"{session.times.frames_per_s:.0f} fps   " if head is not None and head.playing else ""
        right = rate + session.renderer.driver.split(" (")[0]
        room = imgui.get_content_region_avail().x - imgui.calc_text_size(right).x
        imgui.same_line()
        imgui.set_cursor_pos_x(
            max(imgui.get_cursor_pos_x() + 12, imgui.get_window_width() - imgui.calc_text_size(right).x - 12)
        )
        if room > 24:
            imgui.text_disabled(right)

    def _draw_link_words(self, live: LiveFlight) -> None:
        """Say how the link is, at the beginning of the status line."""
        head, status = self.session.head, live.status
        is_live = head is not None and head.live and self.session.stale_s is None
        badge = "LIVE" if is_live else f"link {status.state}" if status.state != "live" else "link"
        imgui.text_colored(accent() if is_live else error(), badge)
        _next(f"{status.rate_hz:.0f} Hz")
        _next(f"latency {latency_words(live)}")
        _next(f"{status.lost} lost")
        if status.age_s is not None:
            _next(f"{status.age_s:.1f} s old", error() if live.stale_s is not None else None)
        _next((status.utc_source or "no UTC").partition(",")[0], None if status.utc_source else error())
        if status.recorded_bytes:
            _next(f"{status.recorded_bytes / 1e6:.1f} MB recorded")
        imgui.same_line(0.0, 36.0)

    def _draw_progress(self) -> None:
        export = self.session.export
        assert export is not None
        share = export.done / export.of if export.of else 0.0
        imgui.same_line(0.0, 18.0)
        imgui.progress_bar(share, ImVec2(150, imgui.get_text_line_height()), f"{export.done} of {export.of} frames")
        imgui.same_line()
        if imgui.small_button("stop"):
            export.cancel()

    def _draw_notices(self) -> None:
        viewport = imgui.get_main_viewport()
        bottom = viewport.work_pos.y + viewport.work_size.y - 12.0
        self.drawn_notices = self.session.notifications.current
        for index, notice in enumerate(reversed(self.drawn_notices)):
            imgui.set_next_window_pos(
                ImVec2(viewport.work_pos.x + viewport.work_size.x - 12.0, bottom), 0, ImVec2(1.0, 1.0)
            )
            imgui.set_next_window_bg_alpha(0.95)
            imgui.begin(f"##notice{index}", None, _NOTICE)
            imgui.push_text_wrap_pos(_NOTICE_WIDTH)
            imgui.text_colored(
                error() if notice.is_error else imgui.get_style_color_vec4(imgui.Col_.text), notice.message
            )
            imgui.pop_text_wrap_pos()
            if imgui.is_window_hovered() and imgui.is_mouse_clicked(0):
                self.session.notifications.dismiss(notice)
            bottom -= imgui.get_window_height() + 8.0
            imgui.end()

    def close(self) -> None:
        """Give back what the interface holds on the GPU and in imgui; the session stays the caller's."""
        self._display.close()
        imgui.backends.opengl3_shutdown()
        implot.destroy_context(self._implot)
        imgui.destroy_context(self._imgui)


def _chord(text: str) -> tuple[imgui.Key, int]:
    """Return the key of a chord such as "Ctrl+Left", and its modifiers."""
    *modifiers, name = text.replace("++", "+=").split("+")
    code = getattr(imgui.Key, _KEY_NAMES.get(name, name.lower()))
    return code, sum(int(_MODIFIERS[modifier]) for modifier in modifiers)


def _next(words: str, colour: ImVec4 | None = None) -> None:
    """Write the next word of the status line."""
    imgui.same_line(0.0, 18.0)
    if colour is None:
        imgui.text(words)
    else:
        imgui.text_colored(colour, words)


def _lay_out(dock: int) -> None:
    """Dock the panels as they are at first: the image large, time below, settings to the right."""
    _INTERNAL.dock_builder_remove_node(dock)
    _INTERNAL.dock_builder_add_node(dock, int(_INTERNAL.DockNodeFlagsPrivate_.dock_space))
    _INTERNAL.dock_builder_set_node_size(dock, imgui.get_main_viewport().work_size)
    # A small window gives the panels what their controls need, and the image the rest.
    room, scale = imgui.get_main_viewport().work_size, imgui.get_style().font_scale_dpi
    across, down = (
        min(max(usual, needed_px * scale / px), 0.5)
        for usual, needed_px, px in ((0.26, _RIGHT_PX, room.x), (0.34, _BELOW_PX, room.y))
    )
    right = _INTERNAL.dock_builder_split_node(dock, imgui.Dir.right, across)
    below = _INTERNAL.dock_builder_split_node(right.id_at_opposite_dir, imgui.Dir.down, down)
    places = (
        (_IMAGE, below.id_at_opposite_dir),
        (_TIMELINE, below.id_at_dir),
        (_LINK, right.id_at_dir),
        (_SETTINGS, right.id_at_dir),
        (_DISPLAY, right.id_at_dir),
        (_COMPARE, right.id_at_dir),
    )
    for name, node in places:
        _INTERNAL.dock_builder_dock_window(name, node)
    _INTERNAL.dock_builder_finish(dock)
