"""Texts of the window: none covers another, in every panel, at a small and at a usual size, by day and by night."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.system.resources import bundled_flight
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.actions import is_possible, select_object
from glstar.viewer.session.keys import Action
from tests.support.windowinput import screen
from tests.support.windowtext import letters, overlaps

GOLDEN = Path(__file__).parents[1] / "golden"
# Golden pictures are half as large as the window: where texts and controls are, not their single pixels.
SHRUNK = 2
# Largest difference of a pixel, and how many may differ by more: less than two letters.
TOLERANCE, MOST = 24, 12
PANELS = ("Settings", "View", "Compare", "Object", "Flight")
# A camera at rest, whose rates are rounding errors.
AT_REST = Path("fly:still?utc_start=2024-03-25T13:00:00Z&latitude_deg=-34.9&longitude_deg=138.6&pitch_deg=-30")


@pytest.fixture(scope="module", params=[(1280, 800), (1920, 1080)], ids=["small", "usual"])
def window(request, tmp_path_factory) -> Iterator[Viewer]:
    """The bundled flight where the arrow towards Canopus is beside Sirius, and the heading beside the ladder's 20."""
    surface = HeadlessSurface(request.param)
    with Viewer(surface, Config(), output=tmp_path_factory.mktemp("saved")) as viewer:
        viewer.session.loader.start_s = 56.0
        viewer.open(bundled_flight())
        viewer.session.wait_for_flight()
        for _ in range(4):
            viewer.frame(0.0)
        selection, session = viewer.interface.selection, viewer.session
        (canopus,) = selection.search(session.loaded.simulator.sky.catalogue).matches("Canopus")
        select_object(session, selection, canopus)
        yield viewer
    surface.close()


def covered(viewer: Viewer, panel: str) -> dict[str, list[tuple[float, float]]]:
    """Return where letters cover others, by window, while a panel is in front."""
    for _ in range(4):
        viewer.frame(0.0)
        imgui.set_window_focus(panel)
    viewer.frame(0.0)
    lists = imgui.get_draw_data().cmd_lists
    assert sum(len(letters(each)) for each in lists) > 400
    return {each._owner_name: where for each in lists if (where := overlaps(each))}


def test_the_values_of_a_flight_at_rest_have_readable_axes(make_viewer):
    assert covered(make_viewer(AT_REST), "Settings") == {}


def test_without_a_link_its_entries_of_the_menu_are_grey(make_viewer):
    session = make_viewer(None).session
    for action in (Action.RECORD_LINK, Action.EXPORT_LINK, Action.DISCONNECT, Action.LIVE, Action.WIPE, Action.PLAY):
        assert not is_possible(action, session)
    assert is_possible(Action.OPEN, session)
    assert is_possible(Action.CONNECT, session)


def test_a_log_that_cannot_be_read_is_reported_once(make_viewer, tmp_path):
    """Without a flight the reason is written where the image would be."""
    broken = tmp_path / "broken.csv"
    broken.write_text("not a flight\n")
    viewer = make_viewer(None)
    viewer.open(broken)
    while viewer.session.loader.is_busy:
        viewer.frame(0.0)
    viewer.frame(0.0)
    assert "broken.csv" in viewer.session.status
    assert viewer.session.notifications.errors == [viewer.session.status]
    drawn = [each._owner_name for each in imgui.get_draw_data().cmd_lists]
    assert not [name for name in drawn if name.startswith("##notification")]


def test_with_a_flight_its_entries_of_the_menu_are_not_grey(viewer):
    for action in (Action.PLAY, Action.SAVE_FRAME, Action.EXPORT, Action.FIND):
        assert is_possible(action, viewer.session)
    assert not is_possible(Action.LIVE, viewer.session)


def assert_as_inspected(viewer: Viewer, panel: str, folder: Path, *, regenerate: bool) -> None:
    """Compare a panel, or the window around the image with the settings, with the picture that was inspected."""
    if "llvmpipe" not in viewer.session.renderer.driver:
        return  # golden pictures are llvmpipe's
    shown, width = screen(viewer)[::-1].copy(), viewer._surface.size[0]
    left, top, image_width, image_height = viewer.interface.visible_px
    shown[top : top + image_height, left : left + image_width] = 0
    # Only the right of the window differs between the panels.
    shown = shown if panel == PANELS[0] else shown[:, round(0.735 * width) // SHRUNK * SHRUNK :]
    picture = cv2.resize(shown[..., ::-1], None, fx=1 / SHRUNK, fy=1 / SHRUNK, interpolation=cv2.INTER_AREA)
    golden = GOLDEN / f"window-{width}-{panel.lower()}.png"
    if regenerate:
        cv2.imwrite(str(golden), picture)
    difference = np.abs(picture.astype(int) - cv2.imread(str(golden))).max(axis=2)
    if (different := int((difference > TOLERANCE).sum())) > MOST:
        cv2.imwrite(str(folder / golden.name), picture)
    assert different <= MOST, f"{different} pixels differ from {golden.name}; see {folder}"


@pytest.mark.parametrize("panel", PANELS)
def test_no_text_covers_another_by_day(window, panel, request, tmp_path):
    window.session.shown_overlays = {Overlay.STAR_NAMES}
    for notification in window.session.notifications.current:
        window.session.notifications.dismiss(notification)
    assert covered(window, panel) == {}
    assert_as_inspected(window, panel, tmp_path, regenerate=request.config.getoption("--regenerate-golden"))


def test_no_text_covers_another_with_all_overlays(window):
    window.session.shown_overlays = set(Overlay)
    assert covered(window, "Flight") == {}


@pytest.mark.parametrize("panel", PANELS)
def test_the_window_is_red_alone_by_night(window, panel, tmp_path):
    window.session.night = True
    try:
        assert covered(window, panel) == {}
        pixels = screen(window)
    finally:
        window.session.night = False
        window.frame(0.0)
    assert pixels[..., 0].max() > 150
    assert pixels[..., 1:].max() <= 8
