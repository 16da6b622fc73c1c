"""The link panel: choosing the vehicle, recording, exporting and disconnecting with the mouse."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.flight import Flight
from glstar.link import Endpoint, Link
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from glstar.viewer.loop import HeadlessSurface, Viewer
from tests.support.links import farthest_rad, free_port, playing

DEG = np.pi / 180
# Where the buttons and the second vehicle are across the window, and the heights between which they are, px.
RECORD_X, EXPORT_X, DISCONNECT_X, BUTTONS_Y = 630.0, 745.0, 820.0, range(330, 430, 10)
SECOND_X, VEHICLES_Y = 775.0, range(190, 240, 10)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


@pytest.fixture
def connected(small: Config, tmp_path: Path, flight: Flight) -> Iterator[tuple[Viewer, int]]:
    """A window that has been connected to a link, on which one vehicle flies; and the link's port."""
    port = free_port()
    with ExitStack() as held:
        surface = HeadlessSurface((900, 600))
        held.callback(surface.close)
        viewer = held.enter_context(Viewer(surface, small, output=tmp_path / "saved"))
        held.enter_context(playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0))
        viewer._connect(f"udpin:127.0.0.1:{port}")
        frames_until(viewer, lambda: viewer.session.scene is not None)
        yield viewer, port


def frames_until(viewer: Viewer, true: Callable[[], Any], patience_s: float = 20.0) -> Any:
    end_s = time.monotonic() + patience_s
    while not (found := true()):
        viewer.frame()
        assert time.monotonic() < end_s, viewer.session.status
        time.sleep(0.01)  # the link has the processor between frames, as in a window
    return found


def click(viewer: Viewer, x: float, heights: range, done: Callable[[], bool]) -> None:
    """Click at increasing heights until a control has had an effect."""
    io = imgui.get_io()
    for y in heights:
        io.add_mouse_pos_event(x, float(y))
        for down in (True, False):
            io.add_mouse_button_event(0, down)
            viewer.frame(0.0)
        if done():
            io.add_mouse_pos_event(-1.0, -1.0)
            viewer.frame(0.0)
            return
    pytest.fail("no control")


def test_a_recording_and_an_export_begun_and_ended_with_the_mouse_are_of_the_flight(connected, flight) -> None:
    viewer, _ = connected
    session = viewer.session
    session.change(**{"exposure.interval_s": 0.5})
    recording = session.live.link.recording
    click(viewer, RECORD_X, BUTTONS_Y, lambda: recording.path is not None)
    log = recording.path
    click(viewer, EXPORT_X, BUTTONS_Y, lambda: session.export is not None)
    job = session.export
    frames_until(viewer, lambda: job.done >= 2)
    click(viewer, EXPORT_X, BUTTONS_Y, job._job._stopping.is_set)
    frames_until(viewer, lambda: session.export is None)
    click(viewer, RECORD_X, BUTTONS_Y, lambda: recording.path is None)
    size = log.stat().st_size
    for _ in range(5):
        viewer.frame()
    assert log.stat().st_size == size == session.live.link.status().recorded_bytes
    recorded = Config().open_flight(log)
    assert farthest_rad(recorded.attitude, flight.attitude) < 0.001 * DEG
    assert job.error == ""
    lines = [json.loads(line) for line in (job.directory / "truth.jsonl").read_text().splitlines()]
    assert len(lines) >= 2
    for line in lines:
        expected_q = flight.attitude.at(parse_utc(line["utc_mid"]))
        assert abs(expected_q @ line["q_body_ned"]) > 1 - 1e-9


def test_the_flight_of_the_chosen_vehicle_is_shown(connected, flight) -> None:
    viewer, port = connected
    session = viewer.session
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=70.0, sysid=2):
        frames_until(viewer, lambda: session.live.status.systems == (1, 2))
        packets = session.live.status.packets
        click(viewer, SECOND_X, VEHICLES_Y, lambda: session.live.link.status().sysid == 2)
        frames_until(viewer, lambda: session.loaded is not None and session.scene is not None)
        received = frames_until(viewer, session.live.link.flight)
    assert session.live.link.status().packets > packets
    # Nothing of the first vehicle, which flies 50 s behind, is left.
    assert received.attitude.first_s > flight.attitude.first_s + 69.0
    assert session.head.first_s > flight.attitude.first_s + 69.0
    assert farthest_rad(received.attitude, flight.attitude) < 0.001 * DEG


def test_a_closed_link_leaves_its_flight_and_frees_its_port(connected) -> None:
    viewer, port = connected
    session = viewer.session
    thread = session.live.link._thread
    frames_until(viewer, lambda: session.head.last_s - session.head.first_s > 1.2)
    click(viewer, DISCONNECT_X, BUTTONS_Y, lambda: session.live is None)
    thread.join(10.0)
    assert not thread.is_alive()
    last_s = session.head.last_s
    assert not session.head.live
    session.head.seek(session.head.first_s + 0.6)
    frames_until(viewer, lambda: session.scene is not None and not session.image.error)
    session.head.toggle()
    viewer.frame(0.2)
    assert session.head.utc_s == pytest.approx(session.head.first_s + 0.8, rel=0, abs=1e-3)
    assert session.head.last_s == last_s
    with Link(Endpoint.parse(f"udpin:127.0.0.1:{port}")) as again:
        assert again.status().problem is None
