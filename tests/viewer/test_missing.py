"""A log without UTC or position: the window asks for them, for this log only, and saves them."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError, RenderError
from glstar.sky.place.timescale import parse_utc
from glstar.viewer.loop import HeadlessSurface, Script, Viewer
from glstar.viewer.session.saving import save_frame, save_range, save_settings
from tests.support.dataflash import ELEVEN_S, dataflash
from tests.support.windowinput import press, screen, type_text
from tests.viewer.conftest import write_flight
from tests.viewer.test_session import exported, finish

UTC = "2024-03-10T11:00:07.5Z"
TYPED = {"utc_start": UTC, "latitude_deg": "-34.93", "longitude_deg": "138.6000001", "height_m": "48"}
KEYS = {"utc_start": UTC, "latitude_deg": -34.93, "longitude_deg": 138.6000001, "height_m": 48.0}


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Return a log without UTC and position."""
    return dataflash(tmp_path / "bare.BIN")


def read(viewer: Viewer) -> None:
    """Draw frames until no log is being read, and two more."""
    end_s = time.monotonic() + 60
    while viewer.session.loader.path is not None:
        viewer.frame(0.0)
        time.sleep(0.005)
        assert time.monotonic() < end_s
    for _ in range(3):
        viewer.frame(0.0)


def drop(viewer: Viewer, path: Path) -> None:
    viewer.session.open(path)
    read(viewer)


def give(viewer: Viewer, **typed: str) -> None:
    missing = viewer.session.missing
    assert missing is not None
    viewer.session.give(missing, TYPED | typed)
    read(viewer)


def given(config: Config) -> dict:
    return {key: getattr(config.flight, key) for key in KEYS}


@pytest.mark.parametrize(
    ("has", "lacks", "asked"),
    [
        ({}, {"UTC", "position"}, ["utc_start", "latitude_deg", "longitude_deg", "height_m"]),
        ({"pos": True}, {"UTC"}, ["utc_start"]),
    ],
)
def test_the_window_asks_only_for_missing_inputs_of_a_log(make_viewer, tmp_path, has, lacks, asked):
    path = dataflash(tmp_path / "some.BIN", **has)
    with pytest.raises(LogFormatError) as caught:
        Config().open_flight(path)
    assert caught.value.lacks.keys() == lacks

    viewer = make_viewer(None)
    drop(viewer, path)
    missing = viewer.session.missing
    assert missing.path == path
    assert [field.key for field in missing.fields] == asked
    assert "some.BIN has no UTC (it has no GPS records)" in missing.message
    assert not viewer.session.notifications.current


def test_an_empty_log_opens_no_dialog(make_viewer, tmp_path):
    path = tmp_path / "empty.BIN"
    path.write_bytes(b"")
    viewer = make_viewer(None)
    drop(viewer, path)
    assert viewer.session.missing is None
    assert viewer.session.notifications.errors


def test_the_flight_opens_with_utc_and_position_from_the_dialog(make_viewer, bare):
    viewer = make_viewer(None)
    drop(viewer, bare)
    for field in viewer.session.missing.fields:
        type_text(viewer, TYPED[field.key])
        press(viewer, "Tab") if field.key != "height_m" else press(viewer, "Enter")
    read(viewer)
    session = viewer.session
    assert session.missing is None
    assert session.flight.attitude.first_s == parse_utc(UTC)
    assert session.flight.position_source == "given"
    assert given(session.config) == KEYS
    assert not imgui.is_popup_open("", int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level))


@pytest.mark.parametrize("key", ["utc_start", "latitude_deg"])
def test_the_dialog_reports_invalid_values_and_stays_open(make_viewer, bare, key):
    viewer = make_viewer(None)
    drop(viewer, bare)
    if key == "latitude_deg":
        type_text(viewer, UTC)
    press(viewer, "Enter")
    assert viewer.session.loader.path is None
    assert viewer.session.missing is not None
    said = {"utc_start": "UTC of the first attitude is missing", "latitude_deg": "latitude, deg is missing"}[key]
    assert said in viewer.interface._missing._error
    assert not viewer.interface.keyboard.is_typing
    press(viewer, "Escape")
    viewer.frame(0.0)
    assert viewer.session.missing is None


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ({"utc_start": "10.03.2024 11:00"}, "ISO 8601"),
        ({"utc_start": "1024-03-10T11:00:00Z"}, "1800 to 2200"),
        ({"latitude_deg": "-34,93"}, "with a point"),
        ({"latitude_deg": "95"}, "-90 to 90"),
        ({"longitude_deg": "nan"}, "longitude_deg"),
        ({"height_m": "1e9"}, "-1000 to 100000"),
        ({"longitude_deg": " "}, "longitude, deg is missing"),
    ],
)
def test_invalid_values_change_nothing(make_viewer, bare, typed, said):
    session = make_viewer(None).session
    session.open(bare)
    with pytest.raises(LogFormatError):
        session.wait_for_flight()
    before = session.config
    with pytest.raises(ConfigError, match=said):
        session.give(session.missing, TYPED | typed)
    assert session.loader.path is None
    assert session.config is before


def test_escape_cancels_and_keeps_the_previous_flight(viewer, bare):
    session = viewer.session
    flight, config = session.flight, session.config
    drop(viewer, bare)
    assert session.missing is not None
    press(viewer, "Escape")
    viewer.frame(0.0)
    assert session.missing is None
    assert session.flight is flight
    assert session.config is config
    press(viewer, "Space")
    assert session.head.playing


def test_after_cancelling_without_a_flight_the_window_names_the_missing_inputs(make_viewer, bare):
    viewer = make_viewer(None)
    drop(viewer, bare)
    press(viewer, "Escape")
    for _ in range(3):
        viewer.frame(0.0)
    assert viewer.session.missing is None
    assert "bare.BIN has no UTC" in viewer.session.status
    assert "Ctrl+O" in viewer.session.status
    press(viewer, "Ctrl+O")
    viewer.frame(0.0)
    assert viewer.interface.files._text == str(bare)
    press(viewer, "Enter")
    read(viewer)
    assert viewer.session.missing is not None
    press(viewer, "Escape")

    viewer.session.image.error = "a message that is far wider than the panel of the image " * 4
    for _ in range(2):
        viewer.frame(0.0)
    picture = screen(viewer)[::-1]
    panel = picture[60:250, :600]
    assert np.ptp(panel[:, 100:500].astype(int), axis=(0, 1)).max() > 30
    assert np.ptp(panel[:, :6].astype(int), axis=(0, 1)).max() == 0


def test_the_given_inputs_apply_to_that_log_only(viewer, bare, tmp_path):
    session = viewer.session
    own = session.config
    drop(viewer, bare)
    give(viewer)
    assert session.flight.attitude.first_s == parse_utc(UTC)
    session.change(**{"exposure.duration_s": 0.8})
    assert given(session.config) == KEYS

    drop(viewer, write_flight(tmp_path / "other.csv"))
    assert session.flight.name == "other.csv"
    assert session.flight.attitude.first_s == ELEVEN_S
    assert given(session.config) == given(own) == dict.fromkeys(KEYS)
    assert session.config.exposure.duration_s == 0.8

    drop(viewer, dataflash(tmp_path / "third.BIN"))
    assert session.missing.typed == {"utc_start": "", **{key: TYPED[key] for key in TYPED if key != "utc_start"}}
    drop(viewer, bare)
    assert session.missing.typed == TYPED


def test_a_log_dropped_while_the_dialog_is_open_is_shown_instead(viewer, bare, log):
    drop(viewer, bare)
    drop(viewer, log)
    assert viewer.session.missing is None
    assert viewer.session.loaded.path == log
    press(viewer, "Space")
    assert viewer.session.head.playing


def test_export_reproduces_a_saved_frame_from_saved_settings(make_viewer, bare, tmp_path):
    viewer = make_viewer(None)
    session = viewer.session
    drop(viewer, bare)
    give(viewer)
    save_frame(session)
    finish(viewer)
    assert not session.notifications.errors
    (saved,) = (path for path in session.output.iterdir() if path.is_dir())
    settings = Config.load(saved.with_name(f"{saved.name}.toml"))
    assert given(settings) == KEYS
    save_settings(session, tmp_path / "mine.toml")
    assert given(Config.load(tmp_path / "mine.toml")) == KEYS
    manifest = json.loads((saved / "manifest.json").read_text())
    assert {key: manifest["config"]["flight"][key] for key in KEYS} == KEYS

    again = exported(settings, bare, tmp_path / "again", frames=1)
    for path in saved.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name


def test_export_reproduces_the_bytes_of_an_exported_range(make_viewer, bare, tmp_path):
    viewer = make_viewer(None)
    session = viewer.session
    drop(viewer, bare)
    give(viewer)
    asked = {"start_s": 0.0, "stop_s": 4.0, "image_format": None, "noiseless": False}
    save_range(session, tmp_path / "range", **asked)
    finish(viewer)
    again = exported(Config.load(tmp_path / "range.toml"), bare, tmp_path / "again", **asked)
    names = sorted(path.name for path in again.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "range").iterdir())
    assert all((tmp_path / "range" / name).read_bytes() == (again / name).read_bytes() for name in names)


def test_other_settings_keep_the_given_inputs_unless_they_have_their_own(make_viewer, small, bare, log, tmp_path):
    viewer = make_viewer(None)
    session = viewer.session
    drop(viewer, bare)
    give(viewer)
    path = tmp_path / "other.toml"
    path.write_text(small.override(**{"exposure.duration_s": 0.7}).to_toml())
    session.open_settings(path)
    read(viewer)
    assert session.config.exposure.duration_s == 0.7
    assert given(session.config) == KEYS

    path.write_text(small.override(**{"flight.utc_start": "2024-03-10T12:00:00Z"}).to_toml())
    session.open_settings(path)
    read(viewer)
    assert session.flight.attitude.first_s == ELEVEN_S + 3600
    assert given(session.config) == KEYS | {"utc_start": "2024-03-10T12:00:00Z"}

    drop(viewer, log)
    assert given(session.config) == dict.fromkeys(KEYS) | {"utc_start": "2024-03-10T12:00:00Z"}


def test_settings_that_remove_the_site_ask_for_it_and_keep_utc(make_viewer, small, tmp_path):
    place = {f"flight.{key}": value for key, value in KEYS.items() if key != "utc_start"}
    path = dataflash(tmp_path / "bare.BIN")
    viewer = make_viewer(None, config=small.override(**place))
    session = viewer.session
    drop(viewer, path)
    assert [field.key for field in session.missing.fields] == ["utc_start"]
    give(viewer)
    (tmp_path / "other.toml").write_text(small.to_toml())
    session.open_settings(tmp_path / "other.toml")
    read(viewer)
    assert [field.key for field in session.missing.fields] == ["latitude_deg", "longitude_deg", "height_m"]
    give(viewer)
    assert session.missing is None
    assert given(session.config) == KEYS


def test_without_a_user_a_log_with_missing_inputs_is_refused(make_viewer, bare):
    viewer = make_viewer(None)
    viewer.open(bare)
    with pytest.raises((LogFormatError, RenderError), match="--utc-start"):
        viewer.play(Script(at_s=1.0))


class Answering(HeadlessSurface):
    """A window whose user types the missing inputs of the log."""

    viewer: Viewer | None = None

    def wait(self, timeout_s: float) -> bool:
        if self.viewer is not None and self.viewer.session.missing is not None:
            self.viewer.session.give(self.viewer.session.missing, TYPED)
        return False


def test_a_log_of_the_command_line_starts_at_the_given_time_once_its_utc_is_known(small, bare, tmp_path):
    surface = Answering((900, 600))
    with Viewer(surface, small, output=tmp_path / "saved") as viewer:
        surface.viewer = viewer
        viewer.open(bare)
        viewer.play(Script(at_s=2.0, asks=True))
        assert viewer.session.head.second == pytest.approx(2.0)
    surface.close()
