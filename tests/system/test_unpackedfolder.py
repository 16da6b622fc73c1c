"""Directories of unpacked files: those of killed processes of this user are removed, and no others."""

import os
import time
from pathlib import Path

import pytest

from glstar.system import files
from glstar.system.files import UnpackedFolder, _abandoned


@pytest.fixture
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(files.tempfile, "gettempdir", lambda: str(tmp_path))
    return tmp_path


def test_a_folder_in_use_stays_and_is_removed_by_its_owner(parent: Path) -> None:
    with UnpackedFolder() as content:
        assert content.is_dir()
        assert content.parent.parent == parent
        assert list(_abandoned(parent)) == []
        with UnpackedFolder() as other:
            assert other != content
        assert content.is_dir()
    assert list(parent.iterdir()) == []
    folder = UnpackedFolder()
    folder.cleanup()
    folder.cleanup()
    assert list(parent.iterdir()) == []


def test_folders_with_a_free_lock_are_removed_and_others_stay(parent: Path) -> None:
    killed, foreign = parent / "glstar-unpacked-1", parent / "other-unpacked-1"
    for folder in (killed, foreign):
        (folder / "content").mkdir(parents=True)
        (folder / "lock").write_text("1")
    (parent / "glstar-unpacked-file").write_text("")
    (parent / "glstar-unpacked-link").symlink_to(foreign)
    assert list(_abandoned(parent)) == [killed]
    (killed / "lock").write_text("1")
    with UnpackedFolder():
        assert not killed.exists()
        assert foreign.is_dir()
        assert (parent / "glstar-unpacked-file").is_file()
        assert (parent / "glstar-unpacked-link").is_symlink()


@pytest.mark.parametrize(("age_s", "is_abandoned"), [(3500.0, False), (3700.0, True)])
def test_a_folder_without_a_lock_is_being_created_for_an_hour(parent: Path, age_s: float, is_abandoned: bool) -> None:
    folder = parent / "glstar-unpacked-1"
    folder.mkdir()
    created_s = time.time() - age_s
    os.utime(folder, (created_s, created_s))
    assert list(_abandoned(parent)) == [folder] * is_abandoned


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="only POSIX has numbers of users")
def test_folders_of_another_user_stay(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = parent / "glstar-unpacked-1"
    folder.mkdir()
    (folder / "lock").write_text("1")
    user = os.getuid()
    assert list(_abandoned(parent)) == [folder]
    (folder / "lock").write_text("1")  # free again
    monkeypatch.setattr(files.os, "getuid", lambda: user + 1)
    assert list(_abandoned(parent)) == []


def test_without_numbers_of_users_any_folder_counts(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = parent / "glstar-unpacked-1"
    folder.mkdir()
    os.utime(folder, (0.0, 0.0))
    monkeypatch.delattr(files.os, "getuid", raising=False)
    assert list(_abandoned(parent)) == [folder]
