"""The sky in one real window: a place and a time, the Moon, a free camera, pinned objects, a second log, two sizes."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from glstar.config import Config
from glstar.rotation import euler_from_quaternion
from glstar.system.resources import asset
from tests.support.realwindow import SETTINGS, Places, RealWindow, Work, changed, count, needs_xvfb, started

# The full Moon of March 2024, 6 hours later, high in the north of Adelaide.
MOONLIT = ("2024-03-25T13:00:00Z", "-34.9", "138.6", "50")
# Blue, green, red of a selected object and of the line of the free camera, and of what another log has.
ACCENT, OTHER = (237, 168, 107), (64, 196, 255)
# Where the tabs of the panels on the right are, px from their left edge.
TABS = (38, 98, 160, 225, 279)


def line_of(places: Places) -> tuple[slice, slice]:
    """Return the part of the image in which the free camera says where it points."""
    bottom = int(0.627 * places.height)
    return np.s_[bottom - 28 : bottom - 6, 5:300]


def points_freely(screen: np.ndarray, places: Places) -> bool:
    return count(screen[line_of(places)], ACCENT) > 60


def light_centre(screen: np.ndarray, places: Places) -> np.ndarray:
    """Return the centre of the largest bright area of the image, x and y, px of the screen."""
    image = places.image(screen).min(axis=2)
    bright = cv2.morphologyEx((image > 180).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, _, areas, centres = cv2.connectedComponentsWithStats(bright)
    assert len(areas) > 1, "no Moon"
    return centres[1 + np.argmax(areas[1:, cv2.CC_STAT_AREA])] + [0, 46]


def rows_of_text(screen: np.ndarray, places: Places) -> int:
    """Return how many lines of text the panel on the right has."""
    lit = (screen[48:-30, places.right + 12 : places.right + 130].max(axis=2) > 110).any(axis=1)
    return int((np.diff(lit.astype(int)) == 1).sum())


def find(window: RealWindow, places: Places, name: str) -> np.ndarray:
    """Select an object by its name; return the screen with its panel."""
    before = window.still()

    def opens(screen: np.ndarray) -> bool:
        return changed(places.search(screen, 84, 110), places.search(before, 84, 110)) > 100

    window.until(opens, "the dialog that searches", again=lambda: opens(window.screen()) or window.press("ctrl+f"))
    window.write(name)
    # The highlighted match.
    row = lambda screen: places.search(screen, 122, 132)  # noqa: E731
    window.until(lambda screen: np.median(row(screen)[..., 0] - row(screen)[..., 2]) > 12, "the match")
    window.still()

    def choose() -> None:
        """Press Return while the dialog is open: a window that is busy may lose it."""
        if opens(window.screen()):
            window.press("Return")

    is_shown = lambda screen: not opens(screen) and rows_of_text(screen, places) > 5  # noqa: E731
    return window.until(is_shown, "the object", again=choose)


def ask_for_sky(window: RealWindow, places: Places) -> None:
    """Type a place and a time; the sky moves from then on, until it is paused."""
    window.until(lambda screen: np.ptp(places.image(screen)) > 150, "the welcome panel")
    welcome, middle = window.still(), np.s_[300:500, 400:880]
    opened = lambda screen: changed(screen[middle], welcome[middle]) > 5000  # noqa: E731
    window.until(opened, "the dialog", again=lambda: opened(window.screen()) or window.press("ctrl+k"))
    for answer in MOONLIT:
        window.still()
        window.press("ctrl+a")
        window.write(answer)
        window.still()
        window.press("Tab" if answer != MOONLIT[-1] else "Return")
    window.until(lambda screen: points_freely(screen, places), "the sky")
    window.away()
    window.until(lambda screen: (places.image(screen).min(axis=2) > 180).sum() > 500, "the Moon")
    window.press("space")


def look_around(window: RealWindow, places: Places) -> None:
    """Centre the Moon, drag it to and fro, centre it again, and zoom."""
    before = window.still()
    # The sky under a bright Moon is not white.
    assert np.median(places.image(before)) < 90
    middle = np.array([places.middle - 4, (46 + 0.627 * places.height) / 2])

    def is_at(screen: np.ndarray, at: np.ndarray) -> bool:
        return bool(np.hypot(*(light_centre(screen, places) - at)) < 12)

    def centre() -> None:
        x, y = light_centre(window.still(), places).astype(int).tolist()
        window.double_click(x, y)
        window.away()
        window.until(lambda screen: is_at(screen, middle), "the Moon in the middle")

    centre()
    x, y = middle.astype(int).tolist()
    at = x, y
    # Far from the middle too, from corner to corner.
    for to in (x + 60, y - 30), (x - 300, y - 160), (x + 280, y + 90):
        window.drag(at, to)
        window.away()
        window.until(lambda screen, to=to: is_at(screen, np.array(to)), f"the Moon under the mouse at {to}")
        at = to
    centre()
    label = window.still()[line_of(places)]
    window.wheel(x, y, 8)
    window.away()
    window.until(lambda screen: changed(screen[line_of(places)], label) > 20, "a narrower field")
    assert points_freely(window.still(), places)


def pin(window: RealWindow, places: Places) -> None:
    """Show the Moon and a star, and pin both: their table is above the object."""
    star_rows = rows_of_text(find(window, places, "sirius"), places)
    # Phase, distance, diameter and illuminated part.
    moon = find(window, places, "moon")
    window.until(lambda screen: rows_of_text(screen, places) >= star_rows + 2, "the rows of the Moon")
    rows = rows_of_text(window.still(), places)
    assert count(moon[50:75, places.right :], ACCENT) > 20  # the name

    def click_pin() -> None:
        """Click on the button behind the name: with objects pinned it is further down."""
        screen = window.screen()
        named = np.argwhere(np.abs(screen[48:-30, places.right :].astype(int) - ACCENT).max(axis=2) < 14)
        top = named[:, 0].min()
        bottom, right = named[named[:, 0] < top + 14].max(axis=0)
        window.click(places.right + int(right) + 24, 48 + int(top + bottom) // 2)
        window.away()

    click_pin()
    window.until(lambda screen: rows_of_text(screen, places) > rows, "the pinned Moon")
    find(window, places, "sirius")
    one = window.still()
    click_pin()
    table = np.s_[48:200, places.right :]
    window.until(lambda screen: changed(screen[table], one[table]) > 200, "two pinned")
    # The columns are beside each other: in either half of the table.
    figures = window.at_rest()[100:210, places.right + 100 : 1275].max(axis=2) > 110
    assert figures[:, :110].sum() > 100
    assert figures[:, 110:].sum() > 100


def return_to_aircraft(window: RealWindow, work: Work, places: Places) -> np.ndarray:
    """Open the bundled flight; Tab turns to its own camera, away from it, and back to the same picture."""
    sky, times = window.still(), np.s_[-20:, :300]
    work.type_path("ctrl+o", asset("adelaide.BIN"))
    window.until(lambda screen: changed(screen[times], sky[times]) > 20, "the time of the flight")
    window.still()
    window.press("Tab")
    window.until(lambda screen: not points_freely(screen, places), "the aircraft's camera")
    own = window.at_rest()
    window.press("Tab")
    window.until(lambda screen: points_freely(screen, places), "the free camera")
    window.press("Tab")
    return window.until(lambda screen: np.array_equal(places.image(screen), places.image(own)), "the same picture")


def other_log(path: Path) -> Path:
    """Write the bundled flight with 3 deg more yaw, ten times a second."""
    flight = Config().open_flight(asset("adelaide.BIN"))
    utc_s = np.arange(flight.attitude.first_s, flight.attitude.last_s, 0.1)
    angles = np.rad2deg(np.stack(euler_from_quaternion(flight.attitude.at(utc_s)), axis=1)) + np.array([0, 0, 3])
    rows = [
        f"{t:.3f},{roll:.4f},{pitch:.4f},{yaw:.4f},-34.81,138.62,80"
        for t, (roll, pitch, yaw) in zip(utc_s, angles, strict=True)
    ]
    head = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


def put_beside(window: RealWindow, work: Work, places: Places, log: Path) -> None:
    """Show another log beside the flight: an arrow, rings, faint curves; and close it."""
    alone = window.at_rest()
    curves = np.s_[625:745, 82:875]
    work.type_path("ctrl+b", log)
    window.until(lambda screen: count(places.image(screen), OTHER) > 150, "the arrow and the rings")
    assert changed(window.at_rest()[curves], alone[curves]) > 300
    work.command("close the other")
    window.until(lambda screen: count(places.image(screen), OTHER) == 0, "the flight as it was")
    window.until(lambda screen: changed(screen[curves], alone[curves]) == 0, "its curves")


def show_panels(window: RealWindow, places: Places) -> None:
    """Click on each tab: each panel is another one."""
    shown = [window.still()]
    for x in TABS:

        def click(x: int = x) -> None:
            window.click(*places.tab(x))
            window.away()

        is_new = lambda screen: changed(places.panel(screen), places.panel(shown[-1])) > 300  # noqa: E731
        window.until(is_new, f"the panel of the tab at {x} px", again=click)
        shown.append(window.still())


@needs_xvfb
def test_the_sky_is_shown_turned_pinned_and_compared(tmp_path: Path, display: Callable[[int, int], str]) -> None:
    number, places, usual = display(1920, 1080), Places(1280, 800), Places(1920, 1080)
    settings, memory = tmp_path / "moonlit.toml", tmp_path / SETTINGS / "glstar" / "viewer.json"
    settings.write_text('[sky]\npreset = "natural"\n[exposure]\nduration_s = 0.05\n', encoding="utf-8")
    memory.parent.mkdir(parents=True)
    memory.write_text('{"has_toured": true}', encoding="utf-8")
    with started("view", "-c", str(settings), "--size", "1280x800", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path, size=(1280, 800))
        window.focus(child)
        work = Work(window, tmp_path / "glstar-saved")
        ask_for_sky(window, places)
        look_around(window, places)
        pin(window, places)
        return_to_aircraft(window, work, places)
        put_beside(window, work, places, other_log(tmp_path / "other.csv"))
        show_panels(window, places)
        window.resize(1920, 1080)
        usual.right = 1920 - 1280 + places.right  # the panels keep their width
        window.until(usual.has_status, "the larger window")
        show_panels(window, usual)
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert child.stderr is not None
        assert child.stderr.read() == b""
