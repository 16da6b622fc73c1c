"""Before there is a flight: the welcome panel, a link opened from the window, and what is remembered."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.system.resources import bundled_flight
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.memory import WindowMemory
from glstar.viewer.ui import dialogs as connectdialog
from glstar.viewer.ui import guide as welcome
from tests.support.links import free_port, playing
from tests.support.windowinput import press
from tests.viewer.test_live import frames_until


@pytest.fixture
def memory(tmp_path) -> WindowMemory:
    return WindowMemory(tmp_path / "config" / "viewer.json")


@pytest.fixture
def empty(small: Config, tmp_path: Path, memory: WindowMemory) -> Iterator[Viewer]:
    surface = HeadlessSurface((900, 600))
    with Viewer(surface, small, output=tmp_path / "saved", memory=memory) as viewer:
        viewer.frame(0.0)
        yield viewer
    surface.close()


def _click_button(viewer, monkeypatch, module, beginning: str) -> list[str]:
    """Draw a frame in which a button is clicked; return the labels of all buttons."""
    labels: list[str] = []

    def clicked(label, _size=None):
        labels.append(label)
        return label.startswith(beginning)

    with monkeypatch.context() as patched:
        patched.setattr(module.imgui, "button", clicked)
        viewer.frame(0.0)
    return labels


@pytest.mark.parametrize(("beginning", "name"), [("The bundled", "adelaide"), ("An orbit", "orbit")])
def test_a_flight_to_try_is_one_click_away(empty, monkeypatch, beginning, name):
    _click_button(empty, monkeypatch, welcome, beginning)
    empty.session.wait_for_flight()
    empty.frame(0.0)
    assert name in empty.session.flight.name
    assert empty.session.scene is not None
    labels = _click_button(empty, monkeypatch, welcome, "no button")
    assert not any(label.startswith("The bundled") for label in labels)  # the panel is gone


def test_a_damaged_log_leaves_its_message_instead_of_the_panel(empty, tmp_path, monkeypatch):
    (tmp_path / "broken.BIN").write_bytes(b"not a log")
    empty.open(tmp_path / "broken.BIN")
    frames_until(empty, lambda: not empty.session.loader.is_busy)
    empty.frame(0.0)
    assert "broken.BIN" in empty.session.status
    assert _click_button(empty, monkeypatch, welcome, "no button")[:1] != ["Open a flight log  (Ctrl+O)"]


def test_opened_flights_are_remembered_the_latest_first(empty, memory, tmp_path):
    for flight in (Path("fly:hover"), bundled_flight()):
        empty.open(flight)
        empty.session.wait_for_flight()
        empty.frame(0.0)
    empty.session.night = True
    empty.session.shown_overlays = {Overlay.HORIZON}
    memory.size = 1000, 700
    empty.close()
    again = WindowMemory.load(memory.file)
    assert again.recent == [str(bundled_flight().resolve()), "fly:hover"]
    assert (again.night, again.overlays, again.size) == (True, {Overlay.HORIZON}, (1000, 700))


def test_the_next_window_has_the_colours_and_overlays_of_the_last(small, tmp_path):
    surface = HeadlessSurface((900, 600))
    remembered = WindowMemory(night=True, overlays=frozenset({Overlay.AXIS}))
    with Viewer(surface, small, output=tmp_path, memory=remembered) as viewer:
        assert viewer.session.night
        assert viewer.session.shown_overlays == {Overlay.AXIS}
    surface.close()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"recent": 3, "size": [1, 2], "night": "yes", "overlays": ["no such overlay", 4]}',
        '{"recent": [1, null], "size": ["a", "b"]}',
    ],
)
def test_a_damaged_memory_counts_as_none(tmp_path, text):
    file = tmp_path / "viewer.json"
    file.write_text(text)
    memory = WindowMemory.load(file)
    assert memory.recent == []
    assert memory.size is None
    assert not memory.night
    assert not memory.overlays


def test_at_most_ten_flights_are_remembered_each_once(memory):
    for number in range(15):
        memory.opened(Path(f"{number}.BIN"))
    memory.opened(Path("12.BIN"))
    assert memory.recent[:3] == ["12.BIN", "14.BIN", "13.BIN"]
    assert len(memory.recent) == 10
    memory.save()
    assert json.loads(memory.file.read_text())["recent"] == memory.recent


def test_a_folder_that_cannot_be_written_disturbs_nobody(tmp_path):
    (tmp_path / "file").write_text("")
    WindowMemory(tmp_path / "file" / "viewer.json").save()


def test_a_link_is_opened_from_the_window(empty, monkeypatch, small):
    port = free_port()
    empty.interface._connect._link = f"udpin:127.0.0.1:{port}"
    press(empty, "Ctrl+L")
    _click_button(empty, monkeypatch, connectdialog, "Connect")
    assert empty.session.live is not None
    flight = Config().open_flight(bundled_flight())
    with playing(flight, f"udpout:127.0.0.1:{port}"):
        frames_until(empty, lambda: empty.session.live.status.packets > 20)
    # A second link is refused with its reason.
    press(empty, "Ctrl+L")
    assert any("already" in each.message for each in empty.session.notifications.current)


def test_a_link_that_is_not_valid_is_reported(empty, monkeypatch):
    empty.interface._connect._link = "no link"
    press(empty, "Ctrl+L")
    _click_button(empty, monkeypatch, connectdialog, "Connect")
    empty.frame(0.0)
    assert empty.session.live is None
    assert empty.session.notifications.errors


def test_settings_are_undone_and_redone(viewer):
    session = viewer.session
    first = session.config
    for duration_s in (1.0, 2.0, 0.25):
        session.change(**{"exposure.duration_s": duration_s})
        viewer.frame(0.0)
    press(viewer, "Ctrl+Z")
    assert session.config.exposure.duration_s == 2.0
    assert session.scene.exposure.duration_s == 2.0
    press(viewer, "Ctrl+Z")
    press(viewer, "Ctrl+Z")
    assert session.config == first
    press(viewer, "Ctrl+Z")
    assert session.notifications.current[-1].message == "nothing to undo"
    press(viewer, "Ctrl+Shift+Z")
    press(viewer, "Ctrl+Y")
    assert session.config.exposure.duration_s == 2.0
    # A new change ends what can be redone.
    session.change(**{"sensor.sky_mean_dn": 40.0})
    viewer.frame(0.0)
    press(viewer, "Ctrl+Y")
    assert session.config.exposure.duration_s == 2.0
    assert session.config.sensor().sky_mean_dn == 40.0


def test_a_dragged_control_is_one_change(viewer, monkeypatch):
    session, before = viewer.session, viewer.session.config
    with monkeypatch.context() as patched:
        patched.setattr(imgui, "is_any_item_active", lambda: True)
        for sky_dn in (20.0, 30.0, 40.0):
            session.change(**{"sensor.sky_mean_dn": sky_dn})
            viewer.frame(0.0)
    viewer.frame(0.0)
    press(viewer, "Ctrl+Z")
    assert session.config == before


def test_settings_are_reset_in_one_step_that_can_be_undone(viewer):
    session, before = viewer.session, viewer.session.config
    session.change(**{"sensor.sky_mean_dn": 40.0})
    viewer.frame(0.0)
    viewer.interface.perform(welcome.Action.RESET_SETTINGS)
    viewer.frame(0.0)
    assert session.config == before
    press(viewer, "Ctrl+Z")
    assert session.config.sensor().sky_mean_dn == 40.0
