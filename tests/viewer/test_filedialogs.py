"""Choosing files: the system's dialogs if there are any, a text field otherwise."""

from typing import Any

import pytest

from glstar.viewer.ui import dialogs as filedialogs
from glstar.viewer.ui.dialogs import FileChooser, has_native_dialogs
from glstar.viewer.ui.guide import blocks_of
from tests.support.windowinput import press


class Dialog:
    """A system dialog that is answered by the test."""

    def __init__(self, title: str, default_path: str) -> None:
        self.asked = title, default_path
        self.answer: Any = None
        self.killed = False
        opened.append(self)

    def ready(self, _timeout_ms: int) -> bool:
        return self.answer is not None

    def result(self) -> Any:
        return self.answer

    def kill(self) -> None:
        self.killed = True


opened: list[Dialog] = []


@pytest.fixture
def native(viewer, monkeypatch):
    """Return a viewer whose system has dialogs."""
    opened.clear()
    for kind in ("open_file", "save_file", "select_folder"):
        monkeypatch.setattr(filedialogs.pfd, kind, Dialog)
    viewer.interface.files = FileChooser(native=True)
    return viewer


def test_a_log_is_opened_in_the_system_s_dialog(native, log):
    session = native.session
    press(native, "Ctrl+O")
    press(native, "Ctrl+O")  # there is one dialog at a time
    (dialog,) = opened
    assert dialog.asked == ("Open a flight log", str(log))
    native.frame(0.0)
    assert session.loader.path is None
    assert not native._has_changed()

    dialog.answer = [str(log)]
    assert native._has_changed()
    native.frame(0.0)
    assert session.loader.path == log
    session.wait_for_flight()


def test_settings_are_saved_in_the_system_s_dialog(native, tmp_path):
    press(native, "Ctrl+Shift+S")
    opened[0].answer = str(tmp_path / "mine.toml")
    native.frame(0.0)

    assert "[camera]" in (tmp_path / "mine.toml").read_text()


@pytest.mark.parametrize("nothing", [[], ""])
def test_a_cancelled_system_dialog_changes_nothing(native, nothing):
    flight = native.session.flight
    press(native, "Ctrl+I")
    opened[0].answer = nothing
    native.frame(0.0)

    assert native.session.flight is flight
    assert native.session.comparison.opening is None
    press(native, "Ctrl+O")
    assert len(opened) == 2


def test_a_dialog_that_is_open_when_the_viewer_closes_is_closed(native):
    press(native, "Ctrl+O")
    native.close()

    assert opened[0].killed


def test_on_linux_there_are_dialogs_with_a_display_and_a_dialog_program(monkeypatch):
    monkeypatch.setattr(filedialogs.sys, "platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(filedialogs.shutil, "which", lambda name: "/usr/bin/zenity" if name == "zenity" else None)
    assert has_native_dialogs()
    monkeypatch.delenv("DISPLAY")
    assert not has_native_dialogs()
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(filedialogs.shutil, "which", lambda _: None)
    assert not has_native_dialogs()


def test_without_a_display_a_path_is_typed_into_a_field(viewer):
    press(viewer, "Ctrl+O")
    viewer.frame(0.0)

    assert viewer.interface.keyboard.is_typing
    press(viewer, "Escape")


def test_the_help_menu_opens_the_manual(viewer):
    press(viewer, "Shift+F1")
    viewer.frame(0.0)
    window = viewer.interface._manual
    assert window.is_open
    assert window._blocks[0] == ("heading", "The viewer")
    press(viewer, "Escape")
    assert not window.is_open


def test_the_manual_s_markdown_is_split_into_blocks():
    paragraph, item = "One *line*\nand `two`.\n\n", "- an [item](x.md)\n  goes on\n\n"
    code, table = "```sh\na\n\nb\n```\n\n", "| k | v |\n|---|---|\n| 1 | 2 |\n"
    page = f"# Title\n\n{paragraph}{item}{code}{table}"
    assert blocks_of(page) == [
        ("heading", "Title"),
        ("paragraph", "One line and two."),
        ("item", "an item goes on"),
        ("code", "a\n\nb\n"),
        ("table", "| k | v |\n|---|---|\n| 1 | 2 |"),
    ]
