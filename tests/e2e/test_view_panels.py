"""The panels of the real window, by mouse and keys, in a small and in a usual window and on a fine screen."""

import subprocess
from collections.abc import Callable

import numpy as np
import pytest

from glstar.system.resources import asset
from tests.support.realwindow import GLSTAR, TOP_PX, Places, RealWindow, differ, needs_xvfb, started


def open_bundled_flight(window: RealWindow, places: Places) -> np.ndarray:
    """Click on the welcome panel's button, the first of "Try"; return the screen with the flight."""
    button = places.middle, int(places.height * 0.36 + 115 * places.scale)

    def click() -> None:
        window.click(*button)
        window.away()

    window.until(lambda screen: np.ptp(screen[button[1] - 8 : button[1] + 8, places.middle - 60 :]) > 150, "a button")
    window.until(places.has_status, "the bundled flight", again=click)
    window.until(lambda screen: (places.image(screen).min(axis=2) > 200).sum() > 100, "stars")
    return window.still()


def open_tab(window: RealWindow, places: Places, x: int, holds: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Click on the tab of a panel; return the screen when it fulfils a condition."""

    def click() -> None:
        window.click(*places.tab(x))
        window.away()

    return window.until(holds, "the panel", again=click)


def find_and_command(window: RealWindow, places: Places, before: np.ndarray) -> None:
    """Find a constellation and click on it, and perform a command by its name."""

    def is_listed(screen: np.ndarray) -> bool:
        """Return whether the first match, which is highlighted, is where the click goes."""
        row = places.search(screen, 122, 132)
        return bool(np.median(row[..., 0] - row[..., 2]) > 12)

    def opens(screen: np.ndarray) -> bool:
        return differ(places.search(screen, 84, 110), places.search(before, 84, 110))

    def write() -> None:
        window.press("ctrl+a")
        window.write("crux")

    window.press("ctrl+f")
    window.until(opens, "the dialog that searches")
    window.until(is_listed, "the match", again=write)
    window.click(places.middle, int(127 * places.scale))
    window.away()
    window.until(lambda screen: differ(places.panel(screen), places.panel(before)), "the panel of the object")
    window.until(lambda screen: not opens(screen), "the end of the search")
    window.press("ctrl+p")
    window.until(opens, "the list of commands")
    window.write("night")
    window.press("Return")
    # Below the mouse, which the display's server draws in its own colours.
    window.until(lambda screen: screen[60:, :, :2].max() <= 8 and screen[60:, :, 2].max() > 100, "red")
    window.press("n")
    window.until(lambda screen: screen[60:, :, 0].max() > 100, "all colours")


def change_image(window: RealWindow, places: Places) -> None:
    """Fit the stretch, change the colours, magnify, and show the whole image again."""
    dark = places.image(window.screen()).mean()
    window.press("shift+a")
    window.until(lambda screen: places.image(screen).mean() > dark + 5, "a brighter background")
    window.press("shift+c")
    coloured = window.until(lambda screen: np.ptp(places.image(screen), axis=2).mean() > 20, "colours")
    window.wheel(places.middle, places.height // 3, 14)
    window.away()

    def is_magnified(screen: np.ndarray) -> bool:
        """Return whether a pixel of the frame covers several of the screen."""
        image = places.image(screen)
        return bool((image[:, 1:] == image[:, :-1]).all(axis=2).mean() > 0.7)

    window.until(is_magnified, "a magnified image")
    window.press("0")
    window.until(lambda screen: (places.image(screen) == places.image(coloured)).mean() > 0.9, "the whole image")


def drag_histogram(window: RealWindow, places: Places, settings: np.ndarray) -> None:
    """Drag black to the right, which darkens the background, also after a fit has put black elsewhere."""

    def handles(screen: np.ndarray) -> np.ndarray:
        """Return the columns of the lines "black" and "white", which have the accent colour from top to bottom."""
        strip = screen[75:122, places.right + 8 :].astype(int)
        return np.flatnonzero((strip[..., 0] - strip[..., 2] > 80).mean(axis=0) > 0.9)

    def is_view(screen: np.ndarray) -> bool:
        return differ(places.panel(screen), places.panel(settings)) and handles(screen).size > 0

    fitted = open_tab(window, places, 98, is_view)
    columns = handles(fitted)
    x, y = places.right + 8 + int(columns[columns < columns[0] + 6].mean()), 100
    window.drag((x, y), (x + 60, y))
    window.away()
    darker = places.image(fitted).mean() - 5
    window.until(lambda screen: places.image(screen).mean() < darker, "a darker background")
    window.press("shift+a")
    window.until(lambda screen: places.image(screen).mean() > darker, "the fitted background")


def undo_and_redo(window: RealWindow, places: Places, settings: np.ndarray) -> None:
    """Drag the exposure to a longer one, undo and redo it: the panel shows the same pixels again."""
    row = slice(int(80 * places.scale), int(106 * places.scale))  # of the exposure time

    def exposure(screen: np.ndarray) -> np.ndarray:
        return screen[row, places.right + 8 :]

    def is_former(screen: np.ndarray) -> bool:
        return np.array_equal(exposure(screen), exposure(settings))

    open_tab(window, places, 38, is_former)
    first, last = ((places.tab(x)[0], int(94 * places.scale)) for x in (98, 125))
    window.drag(first, last)
    hovered = window.until(lambda screen: not is_former(screen), "a longer exposure")
    red = (hovered[..., 2] > 150) & (hovered[..., :2].max(axis=2) < 60)
    assert not red[row].any()  # imgui frames controls in red whose identities collide
    window.away()
    window.press("ctrl+z")
    window.until(is_former, "the former exposure")
    window.press("ctrl+shift+z")
    window.until(lambda screen: not is_former(screen), "the longer exposure")
    window.press("ctrl+z")
    window.until(is_former, "the former exposure again")


@needs_xvfb
def test_every_panel_responds_to_mouse_and_keys_in_a_small_window(tmp_path, display):
    number, places = display(800, 600), Places(800, 600)
    with started("view", "--size", "800x600", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path)
        window.focus(child)
        opened = open_bundled_flight(window, places)
        find_and_command(window, places, opened)
        change_image(window, places)
        drag_histogram(window, places, opened)
        undo_and_redo(window, places, opened)
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert child.stderr.read() == b""


def read_manual(window: RealWindow, places: Places) -> None:
    """Open the manual, which covers most of the window, and close it."""
    before = window.still()

    def is_open(screen: np.ndarray) -> bool:
        return bool((screen != before).any(axis=2).mean() > 0.2)

    window.until(is_open, "the manual", again=lambda: window.press("shift+F1"))
    window.until(lambda screen: not is_open(screen), "the window below", again=lambda: window.press("shift+F1"))


def wipe(window: RealWindow, places: Places) -> None:
    """Wipe between the real and the simulated image, and drag the line between them to the left."""
    y = places.height // 4
    undivided = places.image(window.still())
    window.press("w")
    window.until(lambda screen: (places.image(screen) != undivided).any(), "the line between the images")
    divided = window.still()

    def moved(screen: np.ndarray) -> bool:
        """Return whether the label of the image on the right has moved with the line."""
        labels = np.s_[TOP_PX : TOP_PX + 30, places.middle // 2 : places.middle]
        return bool((screen[labels] != divided[labels]).any(axis=2).sum() > 40)

    def drag() -> None:
        window.drag((places.middle, y), (places.middle - 120, y))
        window.away()

    window.until(moved, "the line further left", again=drag)
    window.press("w")


def look_at_map(window: RealWindow, places: Places) -> None:
    """Show the map of the flight, and magnify it with the wheel."""
    settings = window.still()
    shown = open_tab(window, places, 279, lambda screen: differ(places.panel(screen), places.panel(settings)))
    map_px = places.right + (1280 - places.right) // 2, places.height // 2
    around = np.s_[map_px[1] - 60 : map_px[1] + 60, places.right + 8 :]

    def magnify() -> None:
        window.wheel(*map_px, 3)
        window.away()

    window.until(lambda screen: (screen[around] != shown[around]).any(axis=2).mean() > 0.005, "the map", again=magnify)


@needs_xvfb
def test_a_log_real_images_and_a_camera_are_dropped_and_compared(tmp_path, display):
    drag_onto_window = pytest.importorskip("tests.support.dragsource", reason="needs python-xlib").drag_onto_window
    number, places, log = display(1280, 800), Places(1280, 800), asset("adelaide.BIN")
    images, narrow = tmp_path / "real images", tmp_path / "a camera.toml"
    words = ["export", str(log), "--start", "0", "--frames", "1", "--exif", "-o", str(images)]
    subprocess.run([*GLSTAR, *words], check=True, capture_output=True, timeout=120)
    narrow.write_text("[camera]\nwidth_px = 640\nheight_px = 640\nfx_px = 900.0\nfy_px = 900.0\n", encoding="utf-8")
    with started("view", "--size", "1280x800", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path)
        window.focus(child)
        window.until(lambda screen: np.ptp(places.image(screen)) > 150, "the welcome panel")
        drag_onto_window(number, log, (300, 300))
        window.until(places.has_status, "the flight that was dropped")
        window.until(lambda screen: (places.image(screen).min(axis=2) > 200).sum() > 100, "stars")
        window.away()
        read_manual(window, places)
        drag_onto_window(number, images, (300, 300))
        window.away()
        blue = np.s_[-24:, : places.right]  # the status line names the time of the real image in the accent colour
        accent = lambda screen: screen[blue].astype(int)[..., 0] - screen[blue].astype(int)[..., 2]  # noqa: E731
        window.until(lambda screen: (accent(screen) > 80).sum() > 100, "the time of the real image")
        wipe(window, places)
        look_at_map(window, places)
        wide = window.still()
        drag_onto_window(number, narrow, (300, 300))
        # A square image: the background of the window begins further inwards.
        edge = np.s_[100:300, 200:204]
        assert np.ptp(wide[edge]) > 20
        window.until(lambda screen: np.ptp(screen[edge]) < 12, "the square image of the camera")
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert child.stderr.read() == b""


@needs_xvfb
def test_text_is_twice_as_large_on_a_screen_of_twice_the_resolution(tmp_path, display):
    number, places = display(2560, 1600), Places(2560, 1600, 2.0)
    words = ["xprop", "-display", number, "-root", "-f", "RESOURCE_MANAGER", "8s", "-set", "RESOURCE_MANAGER"]
    subprocess.run([*words, "Xft.dpi:\t192\n"], check=True, timeout=60)
    with started("view", "--size", "2560x1600", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path)
        window.focus(child)
        undo_and_redo(window, places, open_bundled_flight(window, places))
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert child.stderr.read() == b""
