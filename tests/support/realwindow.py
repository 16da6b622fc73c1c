"""A real window on a display of its own: keys and mouse through xdotool, and what the screen shows."""

import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

__all__ = ["RealWindow"]

# Longest wait for the screen, s: a fit in a window takes a minute on a busy machine.
_PATIENCE_S = 180.0
# The screen is still if it is the same for this time, s.
_STILL_S = 0.25
# Interval at which an action is repeated that the window may have missed, s.
_AGAIN_S = 5.0
# Size of a header of the X window dump format in 32 bit words.
_HEADER_WORDS = 25


class RealWindow:
    """Drives glstar's window, which fills the display.

    Parameters
    ----------
    display : str
    folder : Path
        In which the display's server stores its screen (``Xvfb -fbdir``).
    """

    def __init__(self, display: str, folder: Path) -> None:
        self._variables = {**os.environ, "DISPLAY": display}
        self._dump = folder / "Xvfb_screen0"

    def _do(self, *words: str) -> None:
        subprocess.run(["xdotool", *words], check=True, capture_output=True, env=self._variables, timeout=_PATIENCE_S)

    def focus(self) -> None:
        """Wait for the window and give it the focus."""
        end_s = time.monotonic() + _PATIENCE_S
        while True:
            try:
                self._do("search", "--sync", "--onlyvisible", "--name", "glstar", "windowfocus", "--sync")
            except subprocess.CalledProcessError:
                assert time.monotonic() < end_s, "no window"
                time.sleep(0.1)
            else:
                return

    def press(self, *chords: str) -> None:
        """Press keys."""
        self._do("key", *chords)

    def write(self, text: str) -> None:
        """Type text."""
        self._do("type", "--delay", "20", "--", text)

    def click(self, x: int, y: int) -> None:
        """Click with the left button, px of the screen; the button is down for some frames."""
        self._do("mousemove", str(x), str(y), "sleep", "0.05", "mousedown", "1", "sleep", "0.05", "mouseup", "1")

    def hover(self, x: int, y: int) -> None:
        """Move the mouse to a position."""
        self._do("mousemove", str(x), str(y))

    def control_click(self, x: int, y: int) -> None:
        """Click with the left button while Ctrl is down."""
        words = ["mousemove", str(x), str(y), "sleep", "0.05", "keydown", "ctrl", "sleep", "0.05", "mousedown", "1"]
        self._do(*words, "sleep", "0.05", "mouseup", "1", "sleep", "0.05", "keyup", "ctrl")

    def right_click(self, x: int, y: int) -> None:
        """Click with the right button."""
        self._do("mousemove", str(x), str(y), "sleep", "0.05", "mousedown", "3", "sleep", "0.05", "mouseup", "3")

    def drag(self, first: tuple[int, int], last: tuple[int, int]) -> None:
        """Drag with the left button from one position to another, and leave the mouse there."""
        middle = [(a + b) // 2 for a, b in zip(first, last, strict=True)]
        words = ["mousemove", *map(str, first), "sleep", "0.05", "mousedown", "1", "sleep", "0.05"]
        words += ["mousemove", *map(str, middle), "sleep", "0.05", "mousemove", *map(str, last), "sleep", "0.05"]
        self._do(*words, "mouseup", "1")

    def wheel(self, x: int, y: int, steps: int) -> None:
        """Turn the wheel at a position: away from the user, or towards for negative steps."""
        turn = ["click", "--repeat", str(abs(steps)), "--delay", "30", "4" if steps > 0 else "5"]
        self._do("mousemove", str(x), str(y), "sleep", "0.05", *turn)

    def away(self) -> None:
        """Move the mouse to the corner, where it highlights nothing; GLFW does not report (0, 0)."""
        self._do("mousemove", "2", "2")

    def screen(self) -> np.ndarray:
        """Return what the screen shows: (height, width, 3) uint8, BGR."""
        content = self._dump.read_bytes()
        header = np.frombuffer(content, ">u4", _HEADER_WORDS)
        width, height, stride, colours = (int(header[i]) for i in (4, 5, 12, 19))
        pixels = np.frombuffer(content, np.uint8, stride * height, int(header[0]) + 12 * colours)
        return pixels.reshape(height, stride // 4, 4)[:, :width, :3].copy()

    def still(self) -> np.ndarray:
        """Return the screen when it no longer changes; on a busy machine it may change later."""
        end_s, before, since_s = time.monotonic() + _PATIENCE_S, self.screen(), time.monotonic()
        while time.monotonic() - since_s < _STILL_S:
            assert time.monotonic() < end_s, "the screen keeps changing"
            time.sleep(0.05)
            now = self.screen()
            if not np.array_equal(now, before):
                before, since_s = now, time.monotonic()
        return before

    def until(
        self, holds: Callable[[np.ndarray], bool], what: str, *, again: Callable[[], object] | None = None
    ) -> np.ndarray:
        """Wait until the screen fulfils a condition, and return it.

        Parameters
        ----------
        holds : callable
            Takes the screen.
        what : str
            For the message of a failure.
        again : callable, optional
            An action that may be lost while the window is not ready: done at once, and again every few seconds.
        """
        end_s = again_s = time.monotonic()
        end_s += _PATIENCE_S
        while not holds(picture := self.screen()):
            now_s = time.monotonic()
            assert now_s < end_s, what
            if again is not None and now_s >= again_s:
                again()
                again_s = time.monotonic() + _AGAIN_S
            time.sleep(0.05)
        return picture
