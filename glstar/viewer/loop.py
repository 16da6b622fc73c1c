"""The loop: events, time, interface, screen."""

import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from glstar.config import Config
from glstar.errors import GlstarError, RenderError
from glstar.export import words_for_the_disk, write_whole
from glstar.gl import GLRenderer
from glstar.viewer.interface import Interface
from glstar.viewer.overlays import Overlay
from glstar.viewer.playhead import Mode
from glstar.viewer.session import Session
from glstar.viewer.surface import Surface

__all__ = ["Script", "Viewer"]

_FRAME_S: Final = 1 / 60
# How long a window that shows nothing new sleeps, unless something happens to it.
_SLEEP_S: Final = 0.5
# What an event changes is seen in the first frame after it; panels settle in the second.
_SETTLING_FRAMES: Final = 3
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
    """

    at_s: float | None = None
    mode: Mode | None = None
    overlays: frozenset[Overlay] | None = None
    screenshot: Path | None = None
    play_s: float | None = None


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
        self._titled: object = None

    def open(self, path: Path) -> None:
        """Begin to read a flight.

        Parameters
        ----------
        path : Path
        """
        self.session.open_flight(path)

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
        if session.flight is not self._titled and session.flight is not None:
            self._titled = session.flight
            surface.set_title(f"{session.flight.name} - glstar")
        interface.paint(surface.target, surface.size)
        if interface.screenshot is not None:
            path, interface.screenshot = interface.screenshot, None
            self._shoot(path)
        with session.times.span("presenting"):
            surface.present()
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
            settling = max(settling - 1, 0)
            if self.session.busy or settling or self.interface.has_input_left:
                left_s = _FRAME_S - (time.perf_counter() - began_s)
                if left_s > 0:
                    time.sleep(left_s)
                self._surface.wait(0.0)
            else:
                self.session.times.pause()
                if self._sleep():
                    settling = _SETTLING_FRAMES

    def _sleep(self) -> bool:
        """Wait until there is something to draw; return whether something happened to the window."""
        while True:
            notices = len(self.session.notices)
            if self._surface.wait(_SLEEP_S) or self._surface.should_close:
                return True
            if self.session.busy or len(self.session.notices) != notices:
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
        session.wait_for_flight()
        head = session.head
        if head is None:
            raise RenderError(session.trouble or "there is no flight to show")
        if script.mode is not None:
            head.mode = script.mode
        if script.overlays is not None:
            session.shown_overlays = set(script.overlays)
        if script.at_s is not None:
            head.seek(head.first_s + script.at_s)
        for _ in range(_SETTLING_FRAMES):
            self.frame(0.0)
        if session.trouble:
            raise RenderError(session.trouble)
        if script.play_s is not None:
            self._play_for(script.play_s)
        if script.screenshot is not None:
            self.interface.screenshot = script.screenshot
            self.frame(0.0)
            if session.errors:
                raise RenderError(session.errors[-1])
        return self._report()

    def _play_for(self, play_s: float) -> None:
        session = self.session
        assert session.head is not None
        session.head.loop = session.head.playing = True
        end_s = time.perf_counter() + play_s
        self._then_s = time.perf_counter()
        session.times.recording = True
        while time.perf_counter() < end_s and not self._surface.should_close:
            began_s = time.perf_counter()
            self.frame()
            time.sleep(max(_FRAME_S - (time.perf_counter() - began_s), 0.0))
            self._surface.wait(0.0)
        session.times.recording = False
        session.head.playing = False

    def _report(self) -> dict[str, Any]:
        session, scene = self.session, self.session.scene
        assert session.head is not None
        if scene is None:
            raise RenderError(session.notice or "there is no image to show")
        return session.times.report() | {
            "mode": str(session.head.mode),
            "image": [scene.camera.width_px, scene.camera.height_px],
            "window": list(self._surface.size),
            "sub_exposures": len(scene.pointing),
            "stars": int(scene.visible.size),
            "renderer": session.renderer.driver,
        }

    def _shoot(self, path: Path) -> None:
        width, height = self._surface.size
        read = self._surface.target.read(viewport=(0, 0, width, height), components=3, alignment=1)
        picture = np.frombuffer(read, np.uint8).reshape(height, width, 3)[::-1, :, ::-1]
        _, encoded = cv2.imencode(".png", picture)
        try:
            with words_for_the_disk(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(path, encoded.tobytes())
        except GlstarError as error:
            self.session.say(str(error), is_error=True)
        else:
            self.session.say(f"screenshot: {path}")

    def close(self) -> None:
        """End what is under way and give all of it back; a second call does nothing."""
        self._owned.close()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
