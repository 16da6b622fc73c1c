"""The window's loop: a paused window without input shows changes from the background."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.images import Grey
from glstar.images import folder as folders
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.session.saving import save_comparison, save_frame
from tests.support.windowinput import screen
from tests.viewer.conftest import write_flight

# The flight begins at 11:00:00; the play head is at its beginning.
NAMES = ("20240310_110000.png", "20240310_110003.png")


class Untouched(HeadlessSurface):
    """A window without input: it closes when its loop has waited twice for an event."""

    def __init__(self) -> None:
        super().__init__((900, 600))
        self.polls = self.idle = 0
        self.on_wait: Callable[[], object] = lambda: None

    @property
    def should_close(self) -> bool:  # type: ignore[override]
        return self.idle > 1

    def wait(self, timeout_s: float) -> bool:
        if timeout_s > 0:
            self.idle += 1
        else:
            self.polls += 1
            assert self.polls < 1000, "the loop never comes to rest"
        self.on_wait()
        return False


@pytest.fixture
def window(small: Config, log: Path, tmp_path: Path) -> Iterator[Viewer]:
    surface = Untouched()
    with Viewer(surface, small, output=tmp_path / "saved") as viewer:
        viewer.open(log)
        viewer.session.wait_for_flight()
        viewer.run()
        assert viewer.session.scene is not None
        yield viewer
    surface.close()


@pytest.fixture
def decoder(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Let real images be decoded only while this event is set."""
    gate, read_grey = threading.Event(), folders.read_grey

    def slow(path: Path) -> Grey:
        assert gate.wait(60.0)
        return read_grey(path)

    monkeypatch.setattr(folders, "read_grey", slow)
    yield gate
    gate.set()


def folder_of(path: Path, grey: int) -> Path:
    path.mkdir()
    for name in NAMES:
        cv2.imwrite(str(path / name), np.full((190, 254), grey, np.uint8))
    return path


def run(viewer: Viewer, decoder: threading.Event, polls: int = 20) -> None:
    """Let the loop run; images are decoded after some polls, or once the loop waits for events."""
    surface = viewer._surface
    assert isinstance(surface, Untouched)
    surface.polls = surface.idle = 0
    decoder.clear()

    def release() -> None:
        if surface.idle or surface.polls >= polls:
            decoder.set()

    surface.on_wait = release
    viewer.run()


def compared(viewer: Viewer) -> tuple[str, str, int]:
    """Return the folder and the name of the real image shown, and the brightness of its half of the window."""
    real = viewer.session.real
    assert real is not None
    view = viewer.session.view
    # The panel begins below the menu; its own middle, on the right half of the picture.
    x, y = view.to_screen([254 + 127, 95]).astype(int)
    return real[0].path.parent.name, real[0].path.name, int(np.median(screen(viewer)[-y - 60 : -y - 40, x - 5 : x + 5]))


@pytest.fixture
def comparing(window: Viewer, decoder: threading.Event, tmp_path: Path) -> Viewer:
    """Compare with a folder of dark images, side by side, paused."""
    session = window.session
    session.stretch = session.stretch.__class__(session.stretch.kind, boost=1.0)
    session.shown_overlays = set()
    session.comparison.mode = ComparisonMode.SIDE_BY_SIDE
    session.open(folder_of(tmp_path / "dark", 40))
    run(window, decoder)
    assert compared(window)[:2] == ("dark", NAMES[0])
    assert not session.busy
    return window


def test_another_folder_is_shown_by_a_paused_window_without_input(
    comparing: Viewer, decoder: threading.Event, tmp_path: Path
) -> None:
    dark_dn = compared(comparing)[2]
    comparing.session.open(folder_of(tmp_path / "bright", 160))
    run(comparing, decoder)

    folder, name, grey_dn = compared(comparing)
    assert (folder, name) == ("bright", NAMES[0])
    assert grey_dn > dark_dn + 50


def test_another_image_is_shown_by_a_paused_window_without_input(comparing: Viewer, decoder: threading.Event) -> None:
    session = comparing.session
    assert session.comparison.images is not None
    session.comparison.images._decoded.clear()
    session.head.seek(session.head.first_s + 3.0)
    run(comparing, decoder)

    assert compared(comparing)[:2] == ("dark", NAMES[1])


def test_no_other_image_is_shown_while_one_is_decoded(comparing: Viewer, decoder: threading.Event) -> None:
    session = comparing.session
    assert session.comparison.images is not None
    session.comparison.images._decoded.clear()
    zoom = session.view.zoom
    decoder.clear()
    session.head.seek(session.head.first_s + 3.0)
    for _ in range(3):
        comparing.frame(0.0)

    assert session.real is None
    assert session.busy
    # The other half is empty until then, and the view stays as it is.
    assert session.view.zoom == zoom
    save_comparison(session)
    assert "still being decoded" in session.notifications.errors[-1]
    assert not session.output.exists()


def test_a_broken_image_leaves_the_list_of_a_paused_window(comparing: Viewer, decoder: threading.Event) -> None:
    session = comparing.session
    images = session.comparison.images
    assert images is not None
    images._decoded.clear()
    images[1].path.write_bytes(images[1].path.read_bytes()[:50])
    comparing.frame(0.0)
    run(comparing, decoder)

    assert len(images) == 1
    assert len(images.problems) == 1


def test_an_export_that_ends_is_reported_by_a_paused_window(window: Viewer, decoder: threading.Event) -> None:
    session = window.session
    save_frame(session)
    run(window, decoder)

    assert session.export is None
    assert [notice for notice in window.interface.drawn_notifications if "1 frame and the truth" in notice.message]


def test_a_log_that_was_read_is_shown_by_a_paused_window(
    window: Viewer, decoder: threading.Event, tmp_path: Path
) -> None:
    window.open(write_flight(tmp_path / "other.csv", seconds=5.0))
    run(window, decoder)

    assert window.session.flight is not None
    assert window.session.flight.name == "other.csv"
    assert window.session.scene.exposure.start_utc_s == window.session.flight.attitude.first_s


def test_a_notification_disappears_from_a_paused_window_when_it_expires(
    window: Viewer, decoder: threading.Event
) -> None:
    session, now_s = window.session, [100.0]
    session.notifications.clock = lambda: now_s[0]
    session.notify("a notice")
    window.frame(0.0)
    assert len(window.interface.drawn_notifications) == 1
    # It expires between the last frame and the loop's first wait.
    now_s[0] += 10.0
    surface = window._surface
    surface.polls = surface.idle = 0
    surface.on_wait = lambda: None
    assert window._sleep()
    run(window, decoder)

    assert window.interface.drawn_notifications == []


def test_a_notification_is_drawn_completely_in_a_paused_window(window: Viewer) -> None:
    """A window of imgui has its size only in the frame after it appears."""
    surface = window._surface
    assert isinstance(surface, Untouched)
    surface.polls = surface.idle = 0
    long = "a notice of several lines, " * 12
    said: list[str] = []

    def say_once() -> None:
        if surface.idle and not said:
            said.append(long)
            window.session.notify(long, is_error=True)

    surface.on_wait = say_once
    window.run()

    shown = imgui.internal.find_window_by_name("##notification0")
    assert not shown.hidden
    lines = imgui.calc_text_size(long, wrap_width=520.0).y
    assert shown.size.y > lines
    assert shown.pos.x + shown.size.x <= 900
    assert shown.pos.y + shown.size.y <= 600


@pytest.mark.parametrize("is_error", [False, True])
def test_a_message_lets_clicks_through_and_an_error_is_dismissed_by_one(
    window: Viewer, decoder: threading.Event, is_error: bool
) -> None:
    session, io = window.session, imgui.get_io()
    session.notify("a notice", is_error=is_error)
    for _ in range(2):
        window.frame(0.0)
    covering = imgui.internal.find_window_by_name("##notification0")
    below = []
    for event in (
        lambda: io.add_mouse_pos_event(covering.pos.x + 5.0, covering.pos.y + 5.0),
        lambda: io.add_mouse_button_event(0, True),
        lambda: io.add_mouse_button_event(0, False),
    ):
        event()
        window.frame(0.0)
        below.append(imgui.get_current_context().hovered_window)
    under_mouse = [hovered.name if hovered is not None else "" for hovered in below]
    assert ("##notification0" in under_mouse) == is_error
    assert bool(session.notifications.current) == (not is_error)


@pytest.mark.parametrize("polls", [1, 2])
def test_a_click_shows_although_the_button_is_released_while_the_window_comes_to_rest(
    window: Viewer, polls: int
) -> None:
    surface, io = window._surface, imgui.get_io()
    assert isinstance(surface, Untouched)
    window.interface.tour.ask()
    for _ in range(2):
        window.frame(0.0)
    # The buttons of the tour are on the left of the last row of its window.
    shown, style = imgui.internal.find_window_by_name("Tour"), imgui.get_style()
    x = shown.pos.x + style.window_padding.x + 12.0
    y = shown.pos.y + shown.size.y - style.window_padding.y - imgui.get_frame_height() / 2
    events: dict[int, Callable[[], None]] = {
        1: lambda: io.add_mouse_pos_event(x, y),
        2: lambda: io.add_mouse_button_event(0, True),
        2 + polls: lambda: io.add_mouse_button_event(0, False),
    }

    def move_and_click() -> None:
        if surface.polls in events:
            events.pop(surface.polls)()

    surface.polls = surface.idle = 0
    surface.on_wait = move_and_click
    window.run()

    assert not events
    assert window.interface.tour.step == 1
    left = screen(window).copy()
    window.frame(0.0)
    np.testing.assert_array_equal(left, screen(window))


def test_memory_of_a_flight_is_returned_when_another_replaces_it(window, tmp_path, monkeypatch):
    returned = []
    monkeypatch.setattr("glstar.viewer.loop.return_freed_memory", lambda: returned.append(window.session.loaded))
    window.frame(0.0)
    assert returned == []
    window.open(write_flight(tmp_path / "other.csv"))
    window.session.wait_for_flight()
    window.frame(0.0)
    window.frame(0.0)
    assert len(returned) == 1
