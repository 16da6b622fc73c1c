"""A session of work in one real window, by mouse and keys: each step is checked by what it writes, or by the screen."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.config import Config
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from tests.support.dataflash import dataflash
from tests.support.realwindow import GLSTAR, Places, RealWindow, Work, changed, needs_xvfb, started, until

pytest.importorskip("Xlib", reason="needs python-xlib")
from tests.support.dragsource import drag_onto_window

PLACES = Places(1280, 800)
# Parts of the window: the tour, the times below the timeline, the menus, the image, and the panel on the right.
TOUR, TIMES, MENUS = np.s_[482:660, 1004:1266], np.s_[748:764, 60:880], np.s_[2:22, :600]
IMAGE, RIGHT, PHOTO = np.s_[60:490, 160:780], np.s_[60:780, 960:1270], np.s_[140:680, 460:1170]
# Colours of arrows of residuals, of rings around identified stars, and of highlights: blue, green, red.
ARROW, RING, ACCENT = (242, 217, 51), (168, 224, 97), (237, 168, 107)


def count(part: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Return how many pixels have about this colour."""
    least, most = ([each + by for each in colour] for by in (-13, 13))
    return int(cv2.countNonZero(cv2.inRange(np.ascontiguousarray(part), np.array(least), np.array(most))))


def follow_tour(work: Work) -> None:
    """Go a step on in the tour of the first start, and end it."""
    window = work.window
    first = window.until(lambda screen: count(screen[TOUR], ACCENT) > 60, "the tour")
    window.until(
        lambda screen: changed(screen[TOUR], first[TOUR]) > 400, "a step", again=lambda: window.click(1035, 636)
    )
    window.until(
        lambda screen: count(screen[TOUR], ACCENT) < 20, "the end of the tour", again=lambda: window.click(1155, 636)
    )
    window.away()


def change_time(work: Work) -> None:
    """Type a time, and export what is between the in and out points."""
    window = work.window
    first = window.still()

    def type_time() -> None:
        window.click(60, 577)
        window.press("ctrl+a")
        window.write("12.6")
        window.press("Return")
        window.away()

    window.until(lambda screen: changed(screen[IMAGE], first[IMAGE]) > 2000, "the sky at 12.6 s", again=type_time)
    assert work.truth()["frame"] == 4  # one every 3 s
    window.press("shift+i", *2 * ["shift+Right"], "shift+o")
    work.until_changed(RIGHT, "ctrl+e", "the dialog of the export", 10000)
    exported = work.until_saved("adelaide-frames/truth.jsonl", lambda: window.press("Return"))
    [only] = map(json.loads, exported.read_text().splitlines())
    # Exposures are counted from the in point.
    begins_s = Config().open_flight(asset("adelaide.BIN")).attitude.first_s + 12.6
    assert parse_utc(only["utc_start"]) == pytest.approx(begins_s, abs=2e-6)


def zoom_timeline(work: Work) -> None:
    """Zoom the timeline at the cursor, and show the whole flight again by its button."""
    window = work.window
    whole = window.still()

    def zoom() -> None:
        window.wheel(400, 655, 6)
        window.away()

    def fit() -> None:
        window.click(178, 604)
        window.away()

    window.until(lambda screen: changed(screen[TIMES], whole[TIMES]) > 100, "other times", again=zoom)
    window.until(lambda screen: changed(screen[TIMES], whole[TIMES]) == 0, "all times", again=fit)


def change_window(work: Work) -> None:
    """Enlarge the text and back, move the border of a panel, and reset the layout."""
    window = work.window
    before = window.still()

    def menu_px(screen: np.ndarray) -> int:
        """Return where the last menu ends."""
        return int(np.flatnonzero(screen[MENUS].max(axis=(0, 2)) > 150).max())

    usual_px = menu_px(before)
    window.press(*3 * ["ctrl+shift+equal"])
    window.until(lambda screen: menu_px(screen) > 1.2 * usual_px, "larger text")
    window.press(*3 * ["ctrl+shift+minus"])
    window.until(lambda screen: changed(screen[MENUS], before[MENUS]) == 0, "the usual text")

    def move() -> None:
        window.drag((944, 300), (800, 300))
        window.away()

    # Above the notices of what was saved, which end meanwhile.
    panel = np.s_[60:560, 960:1270]
    window.until(lambda screen: changed(screen[panel], before[panel]) > 2000, "a wider panel", again=move)
    work.command("panels as")
    window.until(lambda screen: changed(screen[panel], before[panel]) < 200, "the first layout")


def change_setting(work: Work) -> None:
    """Read the tooltip of the exposure time, type another, and take the default back by a right click."""
    window, below = work.window, np.s_[110:170, 1050:1270]
    before = window.still()
    window.until(
        lambda screen: changed(screen[below], before[below]) > 2000, "the tooltip", again=lambda: window.hover(1035, 94)
    )

    window.away()
    number = np.s_[88:102, 1005:1065]
    window.until(lambda screen: changed(screen[number], before[number]) == 0, "no tooltip")

    def type_time() -> None:
        window.control_click(1035, 94)
        window.still()
        window.press("ctrl+a")
        window.write("0.25")
        window.press("Return")
        window.away()

    window.until(lambda screen: changed(screen[number], before[number]) > 20, "the number", again=type_time)
    window.still()
    assert work.truth()["duration_s"] == 0.25

    def reset() -> None:
        window.right_click(1035, 94)
        window.away()

    window.until(lambda screen: changed(screen[number], before[number]) == 0, "the default", again=reset)
    assert work.truth()["duration_s"] == 0.5


def fit_mount(work: Work) -> None:
    """Fit the mount to the real images, apply it, and take it back."""
    window, fitted_lines = work.window, np.s_[674:750, 957:1240]

    def text(part: np.ndarray) -> int:
        return int((part.min(axis=2) > 150).sum())

    def mount_deg() -> tuple[float, float]:
        report = work.until_saved("problem-report*.md", lambda: work.command("report"))
        lines = report.read_text().split("[mount]")[1].splitlines()
        yaw, roll = (next(one for one in lines if one.startswith(f"{key}_deg")) for key in ("yaw", "roll"))
        return float(yaw.split("=")[1]), float(roll.split("=")[1])

    before = mount_deg()

    def fit() -> None:
        # The tab of the panel, then its button.
        window.click(1106, 35)
        window.still()
        window.click(971, 657)
        window.away()

    def applied() -> bool:
        window.wheel(1100, 640, -20)
        window.away()
        window.still()
        window.click(980, 757)
        window.away()
        return mount_deg() != before

    window.until(lambda screen: text(screen[fitted_lines]) > 1500, "what was fitted", again=fit)
    until(applied, "the applied mount")
    fitted = mount_deg()
    # Towards the zenith yaw and roll turn about the same axis.
    difference_deg = np.subtract(*fitted) - np.subtract(*before)
    assert abs((difference_deg + 180) % 360 - 180) < 0.05
    window.press("ctrl+z")
    assert mount_deg() == before


def compare(work: Work, number: str, images: Path) -> None:
    """Drop a folder of real images, show the residuals, and click on the brightest star."""
    window = work.window
    window.press("Home", "v")
    drag_onto_window(number, images, (300, 300))
    window.away()
    blue = np.s_[776:, :940]  # the status line names the time of the real image
    window.until(lambda screen: count(screen[blue], ACCENT) > 30, "the time of the real image")
    window.until(
        lambda screen: count(screen[IMAGE], ARROW) > 150, "the residuals", again=lambda: window.press("shift+r")
    )
    window.press("shift+r", "x")
    window.until(lambda screen: count(screen[IMAGE], ARROW) == 0, "no residuals")
    window.away()
    light = cv2.blur(window.still()[IMAGE].min(axis=2), (7, 7))
    down, across = np.unravel_index(np.argmax(light), light.shape)
    x, y = int(across) + IMAGE[1].start, int(down) + IMAGE[0].start
    around = np.s_[y - 20 : y + 20, x - 20 : x + 20]

    def click() -> None:
        window.click(x, y)
        window.away()

    window.until(lambda screen: count(screen[around], ACCENT) > 20, "a ring around the star", again=click)


def calibrate(work: Work, number: str, photograph: Path) -> None:
    """Drop a photograph, apply its calibration to the camera, and take it back."""
    window = work.window

    def focal_length_px() -> float:
        report = work.until_saved("problem-report*.md", lambda: work.command("report"))
        [line] = (line for line in report.read_text().splitlines() if line.startswith("fx_px"))
        return float(line.split("=")[1])

    first_px = focal_length_px()
    drag_onto_window(number, photograph, (300, 300))
    window.away()
    window.until(lambda screen: count(screen[PHOTO], RING) > 1000, "the identified stars")
    window.still()
    window.click(315, 552)
    window.still()
    window.press("Escape")
    window.until(lambda screen: count(screen[PHOTO], RING) < 100, "the window below")
    window.away()
    fitted_px = focal_length_px()
    assert fitted_px == pytest.approx(first_px, rel=1e-3)
    assert fitted_px != first_px
    window.press("ctrl+z")
    assert focal_length_px() == first_px


def answer_questions(work: Work, number: str, log: Path) -> None:
    """Drop a log without UTC and position, and type both."""
    window = work.window
    before = window.still()
    drag_onto_window(number, log, (300, 300))
    window.until(lambda screen: changed(screen[RIGHT], before[RIGHT]) > 10000, "the questions")
    for answer in ("2024-03-10T11:00:07.5Z", "-34.93", "138.6", "48"):
        window.write(answer)
        window.still()
        window.press("Tab" if answer != "48" else "Return")
        window.still()
    window.until(lambda screen: changed(screen[TIMES], before[TIMES]) > 100, "the timeline of the other flight")
    window.still()
    assert parse_utc(work.truth()["utc_start"]) == pytest.approx(parse_utc("2024-03-10T11:00:07.5Z"), abs=2e-6)


@needs_xvfb
@pytest.mark.timeout(900)
def test_a_session_of_work_in_one_window(tmp_path: Path, display: Callable[[int, int], str]) -> None:
    number, log = display(1280, 800), asset("adelaide.BIN")
    images = tmp_path / "real images"
    words = ["export", str(log), "--start", "0", "--frames", "2", "--exif", "-o", str(images)]
    subprocess.run([*GLSTAR, *words], check=True, capture_output=True, timeout=120)
    with started("view", str(log), "--size", "1280x800", display=number, home=tmp_path) as child:
        window = RealWindow(number, tmp_path)
        window.focus(child)
        work = Work(window, tmp_path / "glstar-saved")
        follow_tour(work)
        window.until(lambda screen: (PLACES.image(screen).min(axis=2) > 200).sum() > 100, "stars")
        zoom_timeline(work)
        change_time(work)
        change_setting(work)
        change_window(work)
        compare(work, number, images)
        fit_mount(work)
        calibrate(work, number, images / "frame_000000.png")
        answer_questions(work, number, dataflash(tmp_path / "bare.BIN"))
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert child.stderr is not None
        assert child.stderr.read() == b""
