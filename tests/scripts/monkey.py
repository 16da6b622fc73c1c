"""Random use of the window: ``python -m tests.scripts.monkey --minutes 10 --seed 1``.

A seeded monkey presses every key of the table, clicks, drags, turns the wheel and types anywhere in a window without a
display, and opens logs, half of them broken.  After each action it draws frames and checks that Python, imgui and
OpenGL raise no error, and that each broken log is reported.  At the end it prints how the memory of the process
changed; more than 60 MB after the first quarter is a fault.  ``--only open press`` does only these.
"""

import argparse
import gc
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
from imgui_bundle import imgui

from glstar.config import Config
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.session.keys import KEYS, Action
from glstar.viewer.ui.interface import parse_chord
from tests.support.windowinput import HELD_KEYS
from tests.viewer.conftest import write_flight

# Keys that end the viewer, or open dialogs of the system; those are tested on their own.
SKIPPED = {Action.QUIT, Action.OPEN, Action.OPEN_IMAGES, Action.OPEN_SETTINGS, Action.SAVE_SETTINGS}
CHORDS = [chord for key in KEYS if key.action not in SKIPPED for chord in key.chords] + ["Escape", "Enter", "Tab"]
WINDOW_PX = (900, 600)
# How often it does what.
CHANCES = {"press": 0.40, "click": 0.25, "drag": 0.12, "wheel": 0.08, "type": 0.10, "open": 0.05}
# Growth of the process after the first quarter that counts as a leak, bytes.
GROWTH = 60e6


class Monkey:
    """Uses a viewer at random.

    Parameters
    ----------
    viewer : Viewer
    folder : Path
        For the logs it opens.
    seed : int
    kinds : sequence of str
        What it does, of `CHANCES`.
    """

    def __init__(self, viewer: Viewer, folder: Path, seed: int, kinds: Sequence[str] = tuple(CHANCES)) -> None:
        self.viewer = viewer
        self._kinds = list(kinds)
        self.done: Counter[str] = Counter()
        self.reported = 0
        # How often a frame is drawn while a log is read is not the seed's: its times have a generator of their own.
        self._random, self._times = np.random.default_rng(seed), np.random.default_rng(seed)
        self._good, self._broken = flights(folder), broken_logs(folder)
        self._at = (0.0, 0.0)

    def act(self) -> str:
        """Do one thing, draw its frames, check them, and return what it was."""
        does = {
            "press": self._press,
            "click": self._click,
            "drag": self._drag,
            "wheel": self._wheel,
            "type": self._type,
            "open": self._open,
        }
        chances = np.array([CHANCES[kind] for kind in self._kinds])
        kind = self._kinds[int(self._random.choice(len(self._kinds), p=chances / chances.sum()))]
        what = does[kind]()
        self.done[what.split()[0]] += 1
        for _ in range(2):
            self._frame()
        assert self.viewer._surface.context.error == "GL_NO_ERROR", what
        return what

    def _frame(self) -> None:
        interface = self.viewer.interface
        interface.wants_to_quit = False
        self.viewer.frame(float(self._times.uniform(0.0, 0.1)))

    def _press(self) -> str:
        chord = str(self._random.choice(CHORDS))
        io, (code, modifiers) = imgui.get_io(), parse_chord(chord)
        held = [key for key in HELD_KEYS if modifiers & int(key)]
        for down in (True, False):
            for key in held:
                io.add_key_event(key, down)
                io.add_key_event(HELD_KEYS[key], down)
            io.add_key_event(code, down)
            self._frame()
        return f"press {chord}"

    def _move(self) -> tuple[float, float]:
        self._at = tuple(float(self._random.uniform(0, size)) for size in WINDOW_PX)  # type: ignore[assignment]
        imgui.get_io().add_mouse_pos_event(*self._at)
        return self._at

    def _click(self) -> str:
        x, y = self._move()
        button = int(self._random.choice([0, 0, 0, 1]))
        for _ in range(int(self._random.choice([1, 1, 2]))):
            for down in (True, False):
                self._frame()
                imgui.get_io().add_mouse_button_event(button, down)
        return f"click {x:.0f} {y:.0f} button {button}"

    def _drag(self) -> str:
        x, y = self._move()
        self._frame()
        imgui.get_io().add_mouse_button_event(0, True)
        self._frame()
        to_x, to_y = self._move()
        self._frame()
        imgui.get_io().add_mouse_button_event(0, False)
        return f"drag {x:.0f} {y:.0f} to {to_x:.0f} {to_y:.0f}"

    def _wheel(self) -> str:
        x, y = self._move()
        notches = float(self._random.choice([-3, -1, 1, 3]))
        imgui.get_io().add_mouse_wheel_event(0.0, notches)
        return f"wheel {notches:.0f} at {x:.0f} {y:.0f}"

    def _type(self) -> str:
        text = "".join(self._random.choice(list("0123456789.-+:eE sirus/\\é"), 4))
        for letter in text:
            imgui.get_io().add_input_character(ord(letter))
        return f"type {text!r}"

    def _open(self) -> str:
        session = self.viewer.session
        good = self._random.random() < 0.5
        path = Path(self._random.choice([str(path) for path in (self._good if good else self._broken)]))
        before = len(session.notifications.current)
        self.viewer.open(path)
        waited_until_s = time.monotonic() + 20
        while session.loader.is_busy and time.monotonic() < waited_until_s:
            self._frame()
        self._frame()
        if not good:
            shown = [each.message for each in session.notifications.current]
            assert len(shown) > before or session.missing is not None or path.name in " ".join(shown), path
            self.reported += 1
        if session.missing is not None:
            session.cancel_missing()
        return f"open {path.name}"


def flights(folder: Path) -> list[Path]:
    """Write five flights."""
    rates = (0.0, 1.0, 4.0, 20.0, 90.0)
    return [write_flight(folder / f"{rate:g}.csv", yaw_rate_deg_per_s=rate, gap=rate == 4.0) for rate in rates]


def broken_logs(folder: Path) -> list[Path]:
    """Write five logs that cannot be replayed."""
    whole = (folder / "0.csv").read_bytes()
    contents = {
        "empty.csv": b"",
        "header.csv": whole.split(b"\n")[0] + b"\n",
        "noise.bin": np.random.default_rng(0).bytes(5000),
        "text.ulg": b"this is no log\n" * 50,
        "columns.csv": whole.replace(b"roll_deg", b"something"),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in contents]


def viewer_of(surface: HeadlessSurface, folder: Path) -> Viewer:
    """Return a viewer of a small camera on one of the flights."""
    numbers = {"width_px": 254, "height_px": 190, "fx_px": 242.0, "fy_px": 242.0}
    config = Config().override(**{f"camera.{key}": value for key, value in numbers.items()})
    viewer = Viewer(surface, config, output=folder / "saved")
    viewer.open(write_flight(folder / "first.csv"))
    viewer.session.wait_for_flight()
    return viewer


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--minutes", type=float, default=10.0)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--only", nargs="+", choices=list(CHANCES), default=list(CHANCES), help="kinds of actions")
    asked = arguments.parse_args()
    process, sizes = psutil.Process(), []
    start_s = time.monotonic()
    latest: list[str] = []
    with TemporaryDirectory() as name:
        surface = HeadlessSurface(WINDOW_PX)
        with viewer_of(surface, Path(name)) as viewer:
            monkey = Monkey(viewer, Path(name), asked.seed, asked.only)
            try:
                while (elapsed_s := time.monotonic() - start_s) < 60 * asked.minutes:
                    latest = [*latest[-19:], monkey.act()]
                    if len(sizes) < elapsed_s / 5:
                        gc.collect()
                        sizes.append(process.memory_info().rss)
            except BaseException:
                print("the latest actions:", *latest, sep="\n  ")
                raise
            print(f"{sum(monkey.done.values())} actions: {dict(monkey.done)}; {monkey.reported} broken logs reported")
        surface.close()
    growth = max(sizes[-3:], default=0) - sizes[len(sizes) // 4] if sizes else 0
    quarters_mb = [f"{sizes[len(sizes) * k // 4 - (k == 4)] / 1e6:.0f}" for k in range(5)] if sizes else []
    print(f"memory at each quarter: {', '.join(quarters_mb)} MB; {growth / 1e6:+.0f} MB since the first")
    return int(growth > GROWTH)


if __name__ == "__main__":
    sys.exit(main())
