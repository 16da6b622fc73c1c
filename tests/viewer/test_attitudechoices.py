"""Attitude source, interpolation and time offset, chosen in the window."""

import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imgui_bundle import imgui
from pymavlink import mavutil

from glstar.config import Config
from glstar.rotation import quaternion_from_euler
from glstar.system.resources import asset
from glstar.viewer.flight.loaded import AttitudeChoices, AttitudeFinder
from glstar.viewer.loop import Viewer
from glstar.viewer.ui.panels import settings as attitudecontrols
from tests.support.windowinput import press

DEG = np.pi / 180


class Chosen:
    """ImGui's controls, with which a user makes one choice."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, name: str = "", offset_s: float | None = None) -> None:
        self.offered: list[str] = []
        monkeypatch.setattr(attitudecontrols.imgui, "collapsing_header", lambda *_: True)
        monkeypatch.setattr(attitudecontrols.imgui, "begin_combo", lambda *_: True)
        monkeypatch.setattr(attitudecontrols.imgui, "end_combo", lambda: None)
        monkeypatch.setattr(attitudecontrols.imgui, "selectable", lambda item, _: self._selectable(item, name))
        if offset_s is not None:
            monkeypatch.setattr(attitudecontrols.imgui, "input_double", lambda *_: (True, offset_s))

    def _selectable(self, item: str, name: str) -> tuple[bool, bool]:
        self.offered.append(item)
        return item == name, item == name


def choose(viewer: Any, name: str = "", offset_s: float | None = None) -> list[str]:
    """Make a choice in the controls, wait until the log has been read, and return what was offered."""
    session = viewer.session
    until(viewer, lambda: session.loader.finder.of(session.loaded.path, session.loaded.config) is not None)
    imgui.new_frame()
    with pytest.MonkeyPatch.context() as patch:
        chosen = Chosen(patch, name, offset_s)
        imgui.begin("controls of a test")
        attitudecontrols.draw_attitude_controls(session)
        imgui.end()
    imgui.end_frame()
    until(viewer, lambda: not session.loader.is_busy)
    return chosen.offered


def until(viewer: Any, true: Any, patience_s: float = 30.0) -> None:
    end_s = time.monotonic() + patience_s
    while not true():
        viewer.frame(0.0)
        assert time.monotonic() < end_s
        time.sleep(0.01)  # the loader has the processor between frames, as in a window
    viewer.frame(0.0)


@pytest.fixture
def adelaide(make_viewer: Any) -> Viewer:
    viewer: Viewer = make_viewer(asset("adelaide.BIN"))
    return viewer


def test_another_source_gives_the_attitude_of_its_message_and_is_undone(adelaide: Any) -> None:
    session = adelaide.session
    session.head.seek(session.head.first_s + 60.0)
    before = session.loaded.flight

    offered = choose(adelaide, "ATT")

    flight = session.loaded.flight
    assert offered == ["auto", "ATT", "XKQ[0]", "slerp", "spline"]  # the log has no gyro rates
    assert flight.attitude_source.startswith("ATT, ")
    assert session.head.utc_s == pytest.approx(before.attitude.first_s + 60.0, abs=1e-6)
    # ATT as pymavlink reads it: its samples are on the track, in the order of the log.
    angles = []
    with closing(mavutil.mavlink_connection(str(asset("adelaide.BIN")))) as log:
        while (message := log.recv_match(type="ATT")) is not None:
            angles.append((message.TimeUS * 1e-6, message.Roll * DEG, message.Pitch * DEG, message.Yaw * DEG))
    clock_s, roll, pitch, yaw = np.array(angles[5:-5:40]).T
    utc_s = flight.attitude.first_s + clock_s - angles[0][0]
    cosine = np.abs(np.sum(flight.attitude.at(utc_s) * quaternion_from_euler(roll, pitch, yaw), axis=-1))
    assert np.all(2 * np.arccos(cosine.clip(max=1.0)) < 1e-4)

    press(adelaide, "Ctrl+Z")
    until(adelaide, lambda: not session.loader.is_busy)
    assert session.config.flight.attitude == "auto"
    np.testing.assert_array_equal(session.loaded.flight.attitude.q_body_ned, before.attitude.q_body_ned)


def test_interpolation_and_time_offset_hold_for_the_flight(adelaide: Any) -> None:
    choose(adelaide, "spline")
    choose(adelaide, offset_s=-0.1250004)
    flight = adelaide.session.loaded.flight
    assert flight.attitude.interpolation == "spline"
    assert flight.time_offset_s == adelaide.session.config.flight.time_offset_s == -0.125


def test_a_choice_that_cannot_be_read_changes_nothing(adelaide: Any) -> None:
    session = adelaide.session
    choose(adelaide, "ATT")
    shown, config = session.loaded, session.config

    session.change(**{"flight.attitude": "AHR2", "flight.interpolation": "spline", "flight.utc_start": "2024-03-10"})
    until(adelaide, lambda: not session.loader.is_busy)

    assert session.loaded is shown
    assert session.config.flight == config.flight
    assert not session.loader.is_busy
    assert any("AHR2" in message for message in session.notifications.errors)


def test_a_choice_taken_back_before_it_is_read_reads_nothing(adelaide: Any) -> None:
    session, shown = adelaide.session, adelaide.session.loaded
    session.change(**{"flight.attitude": "ATT"})
    session.change(**{"flight.attitude": "auto"})
    assert not session.loader.is_busy
    adelaide.frame(0.0)
    assert session.loaded is shown


def test_gyro_is_offered_only_if_the_log_has_rates_or_it_is_chosen() -> None:
    assert AttitudeChoices().interpolations("slerp") == ["slerp", "spline"]
    assert AttitudeChoices(has_gyros=True).interpolations("slerp") == ["slerp", "spline", "gyro"]
    assert AttitudeChoices().interpolations("gyro") == ["slerp", "spline", "gyro"]
    assert AttitudeChoices().sources("XKQ") == ["auto", "XKQ"]


def test_a_log_that_cannot_be_surveyed_offers_the_present_choice_and_says_why(tmp_path: Path) -> None:
    finder = AttitudeFinder()
    (tmp_path / "broken.BIN").write_bytes(b"no log")
    end_s = time.monotonic() + 30.0
    while (found := finder.of(tmp_path / "broken.BIN", Config())) is None:
        assert time.monotonic() < end_s
    finder.close()
    assert found.sources("ATT") == ["auto", "ATT"]
    assert "broken.BIN" in found.error
