"""The clipboard, with a script in place of the desktop's program."""

import stat
import sys
from pathlib import Path

import pytest

from glstar.system.imagefiles import copy_png

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the programs of Linux desktops")


def program(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{text}\n")
    (folder / name).chmod(stat.S_IRWXU)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    return tmp_path


def test_the_image_goes_to_xclip_as_png(folder: Path) -> None:
    program(folder, "xclip", f'cat > "{folder}/copied"; echo "$@" > "{folder}/words"')
    assert copy_png(b"a picture") == ""
    assert (folder / "copied").read_bytes() == b"a picture"
    assert "image/png" in (folder / "words").read_text()


def test_wayland_has_its_own_program(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    program(folder, "xclip", "exit 1")
    program(folder, "wl-copy", f'cat > "{folder}/copied"')
    assert copy_png(b"a picture") == ""
    assert (folder / "copied").read_bytes() == b"a picture"


def test_a_failing_or_missing_program_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(folder, "xclip", "cat > /dev/null; exit 3")
    assert "xclip ended with 3" in copy_png(b"a picture")
    monkeypatch.setenv("PATH", str(folder / "nowhere"))
    assert "needs xclip" in copy_png(b"a picture")
