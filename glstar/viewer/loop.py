"""The loop: events, time, interface, screen."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from glstar.config import Config
from glstar.errors import GlstarError, RenderError
from glstar.export.diskerrors import explain_disk_errors
from glstar.link import Link
from glstar.render.opengl import GLRenderer
from glstar.sky.timescale import CLOCK_GRAIN_S
from glstar.system.durable import write_atomically
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.overlays import Overlay
from glstar.viewer.playhead import Mode
from glstar.viewer.session import Session
from glstar.viewer.surface import Surface
from glstar.viewer.ui.interface import Interface

__all__ = ["Script", "Viewer"]

_FRAME_S: Final = 1 / 60
# How long a window that shows nothing new sleeps, unless something happens to it; with a link, its age grows.
_SLEEP_S: Final = 0.5
_LINK_SLEEP_S: Final = 0.1
# How long to wait for the next attitude, s.
_NEWER_S: Final = 1 / 30
# What an event changes is seen in the first frame after it; panels settle in the second.
_SETTLING_FRAMES: Final = 3
# A script that is told no time waits so long for the first image of a link, s.
_PATIENCE_S: Final = 30.0
# More is no frame's length: the machine slept, or somebody held the window.
_LONGEST_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Script:
    """What to do without a user.

    Attributes
    ----------
    at_s : float or None
        Where to begin, s from the flight's first attitude.
    mode : Mode or None
    overlays : frozenset of Overlay or None
        What to draw over the image; what is drawn at first without it.
    screenshot : Path or None
        A picture of the window, once the image is there, or after playing.
    play_s : float or None
        How long to play, s of the clock.
    asks : bool
        Somebody is at the window to give the UTC and place that a log lacks; without it that is an error.
    """

    at_s: float | None = None
    mode: Mode | None = None
    overlays: frozenset[Overlay] | None = None
    screenshot: Path | None = None
    play_s: float | None = None
    asks: bool = False


class Viewer:
    """A session, its interface and what it is shown on.

    Parameters
    ----------
    surface : Surface
        It stays the caller's.
    config : Config
    layout : Path, optional
        Where the places of the panels are remembered.
    output : Path, optional
        Where frames and pictures are saved.

    Attributes
    ----------
    session : Session
    interface : Interface
    """

    def __init__(
        self, surface: Surface, config: Config, *, layout: Path | None = None, output: Path | None = None
    ) -> None:
        self._surface = surface
        self._owned = ExitStack()
        try:
            renderer = GLRenderer(surface.context)
            self._owned.callback(renderer.close)
            self.session = Session(renderer, config, output=output)
            self._owned.callback(self.session.close)
            self.interface = Interface(self.session, surface.context, layout=layout, scale=surface.scale)
            self._owned.callback(self.interface.close)
            surface.attach()
            self._owned.callback(surface.detach)
        except BaseException:
            self._owned.close()
            raise
        self._then_s = time.perf_counter()
        self._full_screen = False
        self._titled: str | None = None

    def open(self, path: Path) -> None:
        """Begin to read a flight.

        Parameters
        ----------
        path : Path
        """
        self.session.open_flight(path)

    def follow(self, link: Link, *, tell: Callable[[str], None] | None = None) -> None:
        """Show what comes from a link.

        Parameters
        ----------
        link : Link
            Open; it stays the caller's.
        tell : callable, optional
            Called with what happens on it, in words.
        """
        self.session.follow(LiveFlight(link, tell=tell))

    def frame(self, elapsed_s: float | None = None) -> None:
        """Draw one frame.

        Parameters
        ----------
        elapsed_s : float, optional
            How much time passes, s; the clock's without it.
        """
        now_s = time.perf_counter()
        if elapsed_s is None:
            elapsed_s = min(now_s - self._then_s, _LONGEST_S)
        self._then_s = now_s
        surface, session, interface = self._surface, self.session, self.interface
        session.times.begin()
        for path in surface.dropped():
            session.open(path)
        interface.frame(surface.new_frame, elapsed_s)
        if session.flight is not None and session.flight.name != self._titled:
            self._titled = session.flight.name
            surface.set_title(f"{session.flight.name} - glstar")
        interface.paint(surface.target, surface.size)
        if interface.screenshot is not None:
            path, interface.screenshot = interface.screenshot, None
            self._shoot(path)
        with session.times.span("presenting"):
            surface.present()
        if session.live is not None:
            session.live.presented()
        session.times.end()
        if interface.wants_full_screen is not self._full_screen:
            self._full_screen = interface.wants_full_screen
            surface.set_full_screen(self._full_screen)

    def run(self) -> None:
        """Show the session until its window is closed.

        While nothing moves nothing is drawn: a paused window waits for events.
        """
        settling = _SETTLING_FRAMES
        while not (self._surface.should_close or self.interface.wants_to_quit):
            began_s = time.perf_counter()
            self.frame()
            # What changed last, a notice too, has its size only in the frame after.
            settling = _SETTLING_FRAMES if self._has_changed() else max(settling - 1, 0)
            if settling or self.interface.has_input_left:
                self.pace(began_s)
                self._surface.wait(0.0)
            else:
                self.session.times.pause()
                if self._sleep():
                    settling = _SETTLING_FRAMES

    def _has_changed(self) -> bool:
        """Return whether the picture changes by itself, or a notice came or went since it was drawn."""
        return self.session.busy or self.session.notifications.current != self.interface.drawn_notices

    def pace(self, began_s: float) -> None:
        """Wait for the next frame's time; live, also for the next attitude.

        Parameters
        ----------
        began_s : float
            When the last frame began, by `time.perf_counter`.
        """
        left_s = _FRAME_S - (time.perf_counter() - began_s)
        if left_s > 0:
            time.sleep(left_s)
        head, live = self.session.head, self.session.live
        newest = None if live is None or head is None or not head.live else live.link.latest()
        if live is not None and newest is not None:
            # One that has just come: what is drawn of it is older by the drawing alone.
            live.link.wait_for(newest.utc_s + CLOCK_GRAIN_S, _NEWER_S)

    def _sleep(self) -> bool:
        """Wait until there is something to draw; return whether panels may change with it and have to settle."""
        has_link = self.session.live is not None
        while True:
            event = self._surface.wait(_LINK_SLEEP_S if has_link else _SLEEP_S)
            if event or self._surface.should_close or self._has_changed():
                return True
            if has_link:
                return False

    def play(self, script: Script) -> dict[str, Any]:
        """Do what a script says, and return how long the frames took.

        Parameters
        ----------
        script : Script

        Returns
        -------
        dict
            `FrameTimes.report`, and what was drawn.

        Raises
        ------
        GlstarError
            If the flight cannot be replayed, the image not drawn or the picture not written.
        """
        session = self.session
        self.frame(0.0)
        if script.overlays is not None:
            session.shown_overlays = set(script.overlays)
        if session.live is not None:
            return self._play_live(script, session.live)
        if script.asks:
            self._frames_until_answered()
        session.wait_for_flight()
        head = session.head
        if head is None and script.asks and not session.errors:
            return session.times.report()  # cancelled: the window stays empty
        if head is None:
            raise RenderError(session.status or "there is no flight to show")
        if script.mode is not None:
            head.mode = script.mode
        if script.at_s is not None:
            head.seek(head.first_s + script.at_s)
        for _ in range(_SETTLING_FRAMES):
            self.frame(0.0)
        if session.image.error:
            raise RenderError(session.image.error)
        if script.play_s is not None:
            self._play_for(script.play_s)
        self._shoot_for(script)
        return self._report()

    def _frames_until_answered(self) -> None:
        """Draw frames until the flight has been read and nothing is missing, or the window is closed."""
        session = self.session
        while session.loader.path is not None or session.loader.missing is not None:
            if self._surface.should_close or self.interface.wants_to_quit:
                return
            began_s = time.perf_counter()
            self.frame()
            self.pace(began_s)
            self._surface.wait(0.0)

    def _play_live(self, script: Script, live: LiveFlight) -> dict[str, Any]:
        """Show what comes, whether the sky can be drawn or not, and return how it went."""
        session = self.session
        live.record()
        if script.play_s is not None:
            self._frames_for(script.play_s)
        else:
            until_s = time.perf_counter() + _PATIENCE_S
            while session.image.texture is None and time.perf_counter() < until_s:
                self._frames_for(_LINK_SLEEP_S)
            if session.image.texture is None:
                raise RenderError(session.status)
        self._shoot_for(script)
        return (session.times.report() if session.scene is None else self._report()) | {"link": live.report()}

    def _shoot_for(self, script: Script) -> None:
        if script.screenshot is not None:
            self.interface.screenshot = script.screenshot
            self.frame(0.0)
            if self.session.errors:
                raise RenderError(self.session.errors[-1])

    def _play_for(self, play_s: float) -> None:
        session = self.session
        assert session.head is not None
        session.head.loop = session.head.playing = True
        self._frames_for(play_s)
        session.head.playing = False

    def _frames_for(self, seconds: float) -> None:
        """Draw frames for some seconds, or until the window is closed."""
        end_s = time.perf_counter() + seconds
        self._then_s = time.perf_counter()
        self.session.times.recording = True
        while time.perf_counter() < end_s and not (self._surface.should_close or self.interface.wants_to_quit):
            began_s = time.perf_counter()
            self.frame()
            self.pace(began_s)
            self._surface.wait(0.0)
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

    def _shoot(self, path: Path) -> None:
        width, height = self._surface.size
        read = self._surface.target.read(viewport=(0, 0, width, height), components=3, alignment=1)
        picture = np.frombuffer(read, np.uint8).reshape(height, width, 3)[::-1, :, ::-1]
        _, encoded = cv2.imencode(".png", picture)
        try:
            with explain_disk_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, encoded.tobytes())
        except GlstarError as error:
            self.session.notify(str(error), is_error=True)
        else:
            self.session.notify(f"screenshot: {path}")

    def close(self) -> None:
        """End what is under way and give all of it back; a second call does nothing."""
        self._owned.close()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
