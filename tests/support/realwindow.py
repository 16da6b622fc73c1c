"""A real window on a display of its own: its process, keys and mouse through xdotool, and what the screen shows."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support import links
from tests.support.links import soon

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
    size : (int, int), optional
        Of the window, px, if it does not fill the display.
    """

    def __init__(self, display: str, folder: Path, *, size: tuple[int, int] | None = None) -> None:
        self._size = size
        self._variables = {**os.environ, "DISPLAY": display}
        self._dump = folder / "Xvfb_screen0"

    def _do(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[bytes]:
        command = ["xdotool", *words]
        return subprocess.run(command, check=check, capture_output=True, env=self._variables, timeout=_PATIENCE_S)

    def focus(self, process: subprocess.Popen[bytes]) -> None:
        """Wait for a process's window and give it the focus, again and again: one that just appears may refuse it."""
        end_s = time.monotonic() + _PATIENCE_S
        while not self._has_focus():
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end_s, "no window has the focus"
            self._do("search", "--onlyvisible", "--name", "glstar", "windowfocus", check=False)
            time.sleep(0.1)

    def _has_focus(self) -> bool:
        return b"glstar" in self._do("getwindowfocus", "getwindowname", check=False).stdout

    def press(self, *chords: str) -> None:
        """Press keys."""
        self._do("key", *chords)

    def write(self, text: str) -> None:
        """Type text."""
        self._do("type", "--delay", "20", "--", text)

    def click(self, x: int, y: int) -> None:
        """Click with the left button, px of the screen; the button is down for some frames."""
        self._do("mousemove", str(x), str(y), "sleep", "0.05", "mousedown", "1", "sleep", "0.05", "mouseup", "1")

    def double_click(self, x: int, y: int) -> None:
        """Click twice with the left button; the button is down for some frames."""
        click = ["mousedown", "1", "sleep", "0.05", "mouseup", "1", "sleep", "0.05"]
        self._do("mousemove", str(x), str(y), "sleep", "0.05", *click, *click)

    def resize(self, width: int, height: int) -> None:
        """Give the window another size, px."""
        self._do("search", "--onlyvisible", "--name", "glstar", "windowsize", str(width), str(height))
        self._size = width, height

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
        width, height_shown = self._size or (width, height)
        return pixels.reshape(height, stride // 4, 4)[:height_shown, :width, :3].copy()

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

    def at_rest(self) -> np.ndarray:
        """Return the screen when it has been the same for a second: notices have gone or are there to stay."""
        while True:
            before = self.still()
            time.sleep(1.0)
            if np.array_equal(self.screen(), before):
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


MISSING = [name for name in ("Xvfb", "xdotool") if shutil.which(name) is None]


needs_xvfb = pytest.mark.skipif(bool(MISSING), reason=f"{' and '.join(MISSING)} are not installed")


GLSTAR = [sys.executable, "-m", "glstar"]
PATIENCE_S = 90.0
# Not the working folder: ``python -m`` would take what the window stores there, ``glstar/``, for the package.
SETTINGS = "settings"


def environment(display: str | None, home: Path, **more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    return kept | {"XDG_CONFIG_HOME": str(home / SETTINGS)} | ({} if display is None else {"DISPLAY": display}) | more


until = partial(links.until, patience_s=PATIENCE_S)


@contextmanager
def started(*words: str, display: str, home: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start ``glstar`` with a window; its processes are ended in any case."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*GLSTAR, *words], cwd=home, env=environment(display, home), **pipes) as window:
        try:
            yield window
        finally:
            window.kill()


def press_keys(variables: dict[str, str], *chords: str) -> None:
    """Press keys in glstar's window; it must be visible to have the focus."""
    words = ["xdotool", "search", "--sync", "--name", "glstar", "windowfocus", "key", *chords]
    keys = {"env": variables, "timeout": PATIENCE_S}
    until(lambda: subprocess.run(words, check=False, capture_output=True, **keys).returncode == 0, "a window")


TOP_PX, TABS_PX = 46, 35


class Places:
    """Where the panels of a window of a size are, px."""

    def __init__(self, width: int, height: int, scale: float = 1.0) -> None:
        self.right = int(width - max(0.26 * width, 300 * scale))
        self.middle, self.height, self.scale = self.right // 2, height, scale

    def image(self, screen: np.ndarray) -> np.ndarray:
        top = int(TOP_PX * self.scale)
        return screen[top : self.height // 2, : self.right - 8].astype(int)

    def panel(self, screen: np.ndarray) -> np.ndarray:
        """Return the panel in front on the right, below all dialogs."""
        return screen[self.height // 3 : self.height // 2 - 8, self.right + 8 :].astype(int)

    def search(self, screen: np.ndarray, first_px: int, last_px: int) -> np.ndarray:
        """Return some rows of the dialogs that search, in the middle."""
        columns = self.middle + np.array([-40, 40]) * self.scale
        rows = np.array([first_px, last_px]) * self.scale
        return screen[slice(*rows.astype(int)), slice(*columns.astype(int))].astype(int)

    def tab(self, x: int) -> tuple[int, int]:
        return self.right + int(x * self.scale), int(TABS_PX * self.scale)

    def has_status(self, screen: np.ndarray) -> bool:
        """Return whether the status line has a time, as with a flight."""
        return bool(screen[-int(20 * self.scale) :, : self.middle].max() > 150)


def differ(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether more than a notification or the mouse differs."""
    return bool((first != second).any(axis=2).mean() > 0.02)


def changed(first: np.ndarray, second: np.ndarray) -> int:
    """Return how many pixels differ."""
    return int((first != second).any(axis=2).sum())


def count(part: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Return how many pixels have about this colour: blue, green, red."""
    return int((np.abs(part.astype(int) - colour).max(axis=2) <= 13).sum())


class Work:
    """A window, and what is saved from it.

    Parameters
    ----------
    window : RealWindow
    saved : Path
        The folder of what it saves.
    """

    def __init__(self, window: RealWindow, saved: Path) -> None:
        self.window, self.saved = window, saved

    def until_changed(self, part: Any, press: str, what: str, pixels: int = 100) -> np.ndarray:
        """Press keys until a part of the screen differs, and return the screen."""
        before = self.window.still()
        return self.window.until(
            lambda screen: changed(screen[part], before[part]) > pixels, what, again=lambda: self.window.press(press)
        )

    def command(self, name: str) -> None:
        """Perform a command by its name in the palette."""
        self.until_changed(np.s_[60:200, 300:700], "ctrl+p", "the list of commands", 1000)
        self.window.still()
        self.window.write(name)
        self.window.still()
        self.window.press("Return")

    def type_path(self, press: str, path: Path) -> None:
        """Open the dialog of a path by its keys, and type one."""
        self.until_changed(np.s_[350:450, 400:880], press, "the dialog", 1000)
        self.window.still()
        self.window.press("ctrl+a")
        self.window.write(str(path))
        self.window.still()
        self.window.press("Return")

    def until_saved(self, pattern: str, act: Callable[[], None]) -> Path:
        """Do something until there is a new file that ends with a line, and return its path."""
        before = set(self.saved.glob(pattern))

        def new() -> list[Path]:
            return [path for path in set(self.saved.glob(pattern)) - before if path.read_text().endswith("\n")]

        until(lambda: act() or soon(new, 8.0), pattern)
        return new()[0]

    def truth(self) -> dict[str, Any]:
        """Save the frame shown, and return its truth."""
        truth = self.until_saved("*/truth.jsonl", lambda: self.window.press("ctrl+s"))
        return dict(json.loads(truth.read_text()))
