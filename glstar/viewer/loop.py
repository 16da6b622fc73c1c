"""The main loop of the viewer, scripts that run it without a user, and the surfaces that it draws on.

A surface is a window (`glstar.viewer.window`), or the framebuffer of a headless context for scripts and tests.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from glstar.config import Config
from glstar.errors import RenderError
from glstar.link import Endpoint, Link
from glstar.render.opengl import Context, Framebuffer, GLRenderer
from glstar.render.opengl.context import headless_context
from glstar.render.opengl.targets import wait_until_drawn
from glstar.sky.place.timescale import CLOCK_GRAIN_S
from glstar.system.process import return_freed_memory, share_one_heap
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.loaded import LoadedFlight
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.memory import WindowMemory
from glstar.viewer.session.saving import PictureAction, cut_picture, record, use_picture, write_picture
from glstar.viewer.session.state import Session
from glstar.viewer.ui.interface import Interface
from glstar.viewer.ui.theme import resized_text


class Surface(Protocol):
    """A framebuffer to draw on, with its events.

    `size`: width and height, px; `window_size`: width and height of the window when it does not fill the screen, screen
    units; `scale`: of the screen; `native_dialogs`: whether files are chosen in the system's dialogs.
    """

    context: Context  # Current on the thread that made the surface

    @property
    def scale(self) -> float: ...  # noqa: D102 - documented above

    @property
    def native_dialogs(self) -> bool: ...  # noqa: D102 - documented above

    @property
    def size(self) -> tuple[int, int]: ...  # noqa: D102 - documented above

    @property
    def window_size(self) -> tuple[int, int]: ...  # noqa: D102 - documented above

    @property
    def target(self) -> Framebuffer: ...  # noqa: D102 - documented above

    @property
    def should_close(self) -> bool: ...  # noqa: D102 - documented above

    def attach(self) -> None:
        """Connect the events to the current imgui context."""

    def new_frame(self) -> None:
        """Give imgui size, time, keys and mouse."""

    def wait(self, timeout_s: float) -> bool:
        """Process events, waiting for the first of them; return whether there was one."""
        ...

    def dropped(self) -> list[Path]:
        """Return the files dropped onto it since the last call."""
        ...

    def set_full_screen(self, full: bool) -> None:
        """Fill the screen, or stop filling it."""

    def set_title(self, title: str) -> None:
        """Set the text of the title bar."""

    def present(self) -> None:
        """Show the frame that was drawn."""

    def detach(self) -> None:
        """Disconnect from imgui, before its context is destroyed."""

    def close(self) -> None:
        """Release the context and its objects; a second call does nothing."""


# Shortest time between two frames, s.
_FRAME_S = 1 / 60
# Longest sleep of a window in which nothing changes, s; with a link, the displayed age of its data changes.
_SLEEP_S = 0.5
_LINK_SLEEP_S = 0.1
# Longest wait for the next attitude of a link, s.
_NEXT_ATTITUDE_S = 1 / 30
# Frames drawn after an event: the first shows its effect, and the layout of the panels is final in the second.
_SETTLING_FRAMES = 3
# Longest wait of a script for the first image of a link, s.
_TIMEOUT_S = 30.0
# Limit of the elapsed time of a frame, s: the machine may have slept, or the user may have dragged the window.
_MAX_ELAPSED_S = 0.5


@dataclass(frozen=True, slots=True)
class Script:
    """Options of a viewer that runs without a user."""

    at_s: float | None = None  # Initial position of the play head, s from the flight's first attitude
    mode: Mode | None = None
    overlays: frozenset[Overlay] | None = None  # What to draw over the image; None for the default
    # Where to save a picture of the window when the image has been drawn, or after playing.
    screenshot: Path | None = None
    play_s: float | None = None  # How long to play, s of the clock
    asks: bool = False  # Whether a user can enter the UTC and the site that a log lacks; otherwise that is an error


class Viewer:
    """A session with its interface on a surface.

    `surface`: it stays the caller's; `layout`: the file that stores the layout of the panels; `output`: where frames
    and pictures are saved; `memory`: what is remembered from one start to the next.
    """

    def __init__(
        self,
        surface: Surface,
        config: Config,
        *,
        layout: Path | None = None,
        output: Path | None = None,
        memory: WindowMemory | None = None,
    ) -> None:
        share_one_heap()  # before there are threads that read logs and write files
        self._surface = surface
        self._owned = ExitStack()
        try:
            renderer = GLRenderer(surface.context)
            self._owned.callback(renderer.close)
            self.session = Session(renderer, config, output=output)
            self._owned.callback(self.session.close)
            self.interface = Interface(
                self.session, surface.context, layout=layout, scale=surface.scale, native_dialogs=surface.native_dialogs
            )
            self._owned.callback(self.interface.close)
            surface.attach()
            self._owned.callback(surface.detach)
        except BaseException:
            self._owned.close()
            raise
        self._memory = WindowMemory() if memory is None else memory
        self._remembered: LoadedFlight | None = None
        self.session.night = self._memory.night
        if self._memory.overlays is not None:
            self.session.shown_overlays = set(self._memory.overlays)
        self.interface.recent = self._memory.recent
        self.interface.sky.place = self._memory.place
        self.interface.text_scale = resized_text(self._memory.text_scale, 0)
        if self._memory.file is not None and not self._memory.has_toured:
            self._memory.has_toured = True
            self.interface.tour.ask()
        self._last_frame_s = time.perf_counter()
        self._full_screen = False
        self._titled: str | None = None
        # The part of the window that the video shows: left, top, width, height, px.
        self._video_px: tuple[int, int, int, int] | None = None

    def open(self, path: Path) -> None:
        """Begin to read a flight."""
        self.session.open_flight(path)

    def follow(self, link: Link, *, on_event: Callable[[str], None] | None = None) -> None:
        """Show the flight that a link receives.

        `link`: open; it stays the caller's; `on_event`: called with the message of each of its events.
        """
        self.session.follow(LiveFlight(link, on_event=on_event))

    def frame(self, elapsed_s: float | None = None) -> None:
        """Draw one frame; `elapsed_s`: time since the last frame, s; by default measured."""
        now_s = time.perf_counter()
        if elapsed_s is None:
            elapsed_s = min(now_s - self._last_frame_s, _MAX_ELAPSED_S)
        self._last_frame_s = now_s
        surface, session, interface = self._surface, self.session, self.interface
        session.times.begin()
        for path in surface.dropped():
            interface.open_dropped(path)
        if session.video is not None and session.video.prepare(session.head):
            elapsed_s = 0.0
        interface.frame(surface.new_frame, elapsed_s)
        self._remember()
        if interface.wanted_link is not None:
            self._connect(interface.wanted_link)
        if session.flight is not None and session.flight.name != self._titled:
            self._titled = session.flight.name
            surface.set_title(f"{session.flight.name} - glstar")
        interface.paint(surface.target, surface.size)
        self._take_pictures()
        with session.times.span("presenting"):
            surface.present()
        session.image.begin_next()
        if session.live is not None:
            session.live.presented()
        session.times.end()
        if interface.wants_full_screen is not self._full_screen:
            self._full_screen = interface.wants_full_screen
            surface.set_full_screen(self._full_screen)

    def _remember(self) -> None:
        """Remember the flight shown, once, and return the memory of the one before."""
        loaded = self.session.loaded
        if loaded is not self._remembered:
            if self._remembered is not None:
                return_freed_memory()
            self._remembered = loaded
            if loaded is not None and loaded.path is not None:
                self._memory.opened(loaded.path)
                self.interface.recent = self._memory.recent

    def _connect(self, link: str) -> None:
        """Open a link and show its flight; it is closed with the viewer."""
        flight = self.session.config.flight
        with self.session.errors_reported():
            opened = Link(Endpoint.parse(link), flight.options, sysid=flight.sysid, retry=True)
            self._owned.enter_context(opened)
            self.follow(opened)

    def run(self) -> None:
        """Draw frames until the window is closed; while nothing changes, wait for events."""
        settling = _SETTLING_FRAMES
        while not self._is_closing:
            began_s = time.perf_counter()
            self.frame()
            settling = _SETTLING_FRAMES if self._has_changed() else max(settling - 1, 0)
            if settling or self.interface.keyboard.has_input_left:
                self.pace(began_s)
                self._surface.wait(0.0)
                if self.interface.keyboard.has_input_left:
                    settling = _SETTLING_FRAMES
            else:
                self.session.times.pause()
                if self._sleep():
                    settling = _SETTLING_FRAMES

    @property
    def _is_closing(self) -> bool:
        """Whether the user has closed the window."""
        return self._surface.should_close or self.interface.wants_to_quit

    def _paced_frame(self) -> None:
        """Draw a frame, wait until the next is due, and process events."""
        began_s = time.perf_counter()
        self.frame()
        self.pace(began_s)
        self._surface.wait(0.0)

    def _has_changed(self) -> bool:
        """Return whether the next frame may differ from the last one without any event."""
        interface = self.interface
        return (
            self.session.busy
            or self.session.notifications.current != interface.drawn_notifications
            or interface.files.is_answered
            or interface.calibration.is_running
        )

    def pace(self, began_s: float) -> None:
        """Wait until the next frame is due; live, also for the next attitude.

        `began_s`: when the last frame began, by `time.perf_counter`.
        """
        left_s = _FRAME_S - (time.perf_counter() - began_s)
        if left_s > 0:
            time.sleep(left_s)
        head, live = self.session.head, self.session.live
        latest = None if live is None or head is None or not head.live else live.link.latest()
        if live is not None and latest is not None:
            # A frame drawn directly after the arrival of an attitude has the smallest latency.
            live.link.wait_for(latest.utc_s + CLOCK_GRAIN_S, _NEXT_ATTITUDE_S)

    def _sleep(self) -> bool:
        """Wait until there is something to draw; return whether the layout of panels may change."""
        has_link = self.session.live is not None
        while True:
            event = self._surface.wait(_LINK_SLEEP_S if has_link else _SLEEP_S)
            if event or self._surface.should_close or self._has_changed():
                return True
            if has_link:
                return False

    def play(self, script: Script) -> dict[str, Any]:
        """Run a script, and return how long the frames took.

        Returns `FrameTimes.report`, and properties of the image.  Raises GlstarError if the flight cannot be replayed,
        the image cannot be drawn or the picture cannot be written.
        """
        session = self.session
        # Before any frame: a key may be pressed as soon as the flight has been read.
        session.loader.start_s = script.at_s
        self.frame(0.0)
        if script.overlays is not None:
            session.shown_overlays = set(script.overlays)
        if session.live is not None:
            return self._play_live(script, session.live)
        if script.asks:
            self._draw_until_answered()
        session.wait_for_flight()
        head = session.head
        if head is None and script.asks and not session.notifications.errors:
            return session.times.report()  # the user cancelled: the window stays empty
        if head is None:
            raise RenderError(session.status or "there is no flight to show")
        if script.mode is not None:
            head.mode = script.mode
        for _ in range(_SETTLING_FRAMES):
            self.frame(0.0)
        if session.image.error:
            raise RenderError(session.image.error)
        if script.play_s is not None:
            self._play_for(script.play_s)
        self._screenshot_for(script)
        return self._report()

    def _draw_until_answered(self) -> None:
        """Draw frames until the flight has been read and nothing is missing, or the window has been closed."""
        session = self.session
        while (session.loader.path is not None or session.loader.missing is not None) and not self._is_closing:
            self._paced_frame()

    def _play_live(self, script: Script, live: LiveFlight) -> dict[str, Any]:
        """Show a link, whether its sky can be drawn or not, and return the report."""
        session = self.session
        live.record()
        if script.play_s is not None:
            self._draw_for(script.play_s)
        else:
            until_s = time.perf_counter() + _TIMEOUT_S
            while session.image.texture is None and time.perf_counter() < until_s and not self._is_closing:
                self._draw_for(_LINK_SLEEP_S)
            if session.image.texture is None:
                raise RenderError(session.status or "the window was closed before the first image of the link")
        self._screenshot_for(script)
        return (session.times.report() if session.scene is None else self._report()) | {"link": live.report()}

    def _screenshot_for(self, script: Script) -> None:
        if script.screenshot is not None:
            self.interface.screenshot = script.screenshot
            self.frame(0.0)
            if self.session.notifications.errors:
                raise RenderError(self.session.notifications.errors[-1])

    def _play_for(self, play_s: float) -> None:
        session = self.session
        assert session.head is not None
        session.head.loop = session.head.playing = True
        self._draw_for(play_s)
        session.head.playing = False

    def _draw_for(self, seconds: float) -> None:
        """Draw frames for some seconds, or until the window has been closed."""
        end_s = time.perf_counter() + seconds
        self._last_frame_s = time.perf_counter()
        self.session.times.recording = True
        while time.perf_counter() < end_s and not self._is_closing:
            self._paced_frame()
        self.session.times.recording = False

    def _report(self) -> dict[str, Any]:
        session, scene = self.session, self.session.scene
        assert session.head is not None
        if scene is None:
            raise RenderError(session.status or "there is no image to show")
        return session.times.report() | {
            "mode": str(session.head.mode),
            "image": [scene.camera.width_px, scene.camera.height_px],
            "window": list(self._surface.size),
            "sub_exposures": len(scene.trails),
            "stars": int(scene.visible.size),
            "renderer": session.renderer.driver,
        }

    def _take_pictures(self) -> None:
        """Save the pictures that the user asked for, and add one to the video."""
        surface, session, interface = self._surface, self.session, self.interface
        if interface.screenshot is not None:
            path, interface.screenshot = interface.screenshot, None
            write_picture(session, path, cut_picture(surface.target, surface.size), "screenshot")
        if interface.picture is not None and not interface.covers_picture:
            action, interface.picture = interface.picture, None
            use_picture(session, action, self._picture(plain=action is PictureAction.SAVE_PLAIN))
        if session.video is None:
            self._video_px = None
        else:
            record(session, session.video, None if interface.covers_picture else self._video_picture())

    def _picture(self, *, plain: bool) -> NDArray[np.uint8] | None:
        visible_px = self.interface.visible_px
        if plain:
            picture = self.interface.plain_picture()
            return None if picture is None else picture[..., ::-1]
        return None if visible_px is None else cut_picture(self._surface.target, self._surface.size, visible_px)

    def _video_picture(self) -> NDArray[np.uint8] | None:
        """Return the part of the window that the picture covered when the video began."""
        if self._video_px is None:
            self._video_px = self.interface.visible_px
        return None if self._video_px is None else cut_picture(self._surface.target, self._surface.size, self._video_px)

    def close(self) -> None:
        """Stop exports and threads, store the window's state, and release all objects; a second call does nothing."""
        self._memory.night = self.session.night
        self._memory.overlays = frozenset(self.session.shown_overlays)
        self._memory.place = self.interface.sky.place
        self._memory.text_scale = self.interface.text_scale
        self._memory.save()
        self._owned.close()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class HeadlessSurface:
    """A surface that is not displayed; `size`: width and height, px."""

    scale = 1.0
    should_close = False
    native_dialogs = False

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = self.window_size = size
        self.context = headless_context()
        self._current = ExitStack()
        self._current.enter_context(self.context)
        self._texture = self.context.texture(size, 4)
        self.target: Framebuffer = self.context.framebuffer([self._texture])
        self._frame_s = time.monotonic()
        self._closed = False

    def attach(self) -> None:
        """Do nothing: there are no events to connect to imgui."""

    def new_frame(self) -> None:
        """Give imgui the size and the time."""
        io, now_s = imgui.get_io(), time.monotonic()
        io.display_size = imgui.ImVec2(*self.size)
        io.delta_time = max(now_s - self._frame_s, 1e-4)
        self._frame_s = now_s

    def wait(self, timeout_s: float) -> bool:
        """Sleep: there are no events."""
        time.sleep(timeout_s)
        return False

    def dropped(self) -> list[Path]:
        """Return an empty list: nothing can be dropped."""
        return []

    def set_full_screen(self, full: bool) -> None:
        """Do nothing: there is no screen."""

    def set_title(self, title: str) -> None:
        """Do nothing: there is no title bar."""

    def present(self) -> None:
        """Wait until the frame has been drawn."""
        wait_until_drawn(self.context)

    def detach(self) -> None:
        """Do nothing: nothing was attached."""

    def close(self) -> None:
        """Release the context and its objects; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self.context.detect_framebuffer(0).use()
        self.target.release()
        self._texture.release()
        self._current.close()
        self.context.release()
