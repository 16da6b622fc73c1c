"""The viewer on a telemetry link: the present sky, earlier times, missing inputs and messages."""

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.prepare import prepare_export
from glstar.flight import Flight
from glstar.link import Endpoint, LatestAttitude, Link, Recorder, open_transport
from glstar.link.packets import dialect
from glstar.link.transport import _TcpClient
from glstar.render.opengl import GLRenderer
from glstar.system.resources import asset
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.session.saving import save_frame
from tests.support.links import ScriptedLink, flown, free_port, playing
from tests.support.sender import UTC_S, Sender
from tests.support.windowinput import press, screen
from tests.viewer.test_missing import type_text

DEG = np.pi / 180


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


@pytest.fixture
def watch(small: Config, tmp_path: Path) -> Iterator[Callable[..., tuple[Viewer, Link]]]:
    with ExitStack() as held:

        def begin(endpoint: str, **options: Any) -> tuple[Viewer, Link]:
            link = held.enter_context(Link(Endpoint.parse(endpoint), rate_hz=50, **options))
            surface = HeadlessSurface((900, 600))
            held.callback(surface.close)
            viewer = held.enter_context(Viewer(surface, small, output=tmp_path / "saved"))
            viewer.follow(link)
            return viewer, link

        yield begin


def frames_until(viewer: Viewer, true: Callable[[], Any], patience_s: float = 20.0) -> Any:
    end_s = time.monotonic() + patience_s
    while not (found := true()):
        viewer.frame()
        assert time.monotonic() < end_s, viewer.session.status
        time.sleep(0.01)  # the link has the processor between frames, as in a window
    return found


def whole_flight(link: Link) -> Flight | None:
    """Return the link's flight if its last second has no gap: on a busy machine the vehicle may pause."""
    flight = link.flight()
    if flight is None or flight.attitude.last_s - flight.attitude.first_s < 1.0:
        return None
    last_s = flight.attitude.last_s
    return None if flight.attitude.gap_within(last_s - 1.0, last_s) is not None else flight


def has_all_samples(viewer: Viewer, stop_utc_s: float) -> bool:
    """Return whether the link received all of an exposure; on a busy machine the vehicle may pause."""
    sample_s = viewer.session.live.last(10.0).attitude.utc_s
    # A gap may have begun before the exposure, or continue after its end.
    first, last = np.searchsorted(sample_s, [stop_utc_s - 0.6, stop_utc_s - 1e-6])
    return first > 0 and last < sample_s.size and np.diff(sample_s[first - 1 : last + 1]).max() < 0.05


@contextmanager
def live(watch: Callable[..., tuple[Viewer, Link]], flight: Flight, **options: Any) -> Iterator[tuple[Viewer, Link]]:
    """Show a link on which a flight is played, from its first complete exposure."""
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0, **options):
        viewer, link = watch(f"udpin:127.0.0.1:{port}")
        session = viewer.session
        frames_until(viewer, lambda: session.scene is not None and session.scene.exposure.duration_s == 0.5)
        yield viewer, link


def test_every_live_image_ends_at_the_latest_attitude_and_has_the_log_s_attitude(watch, flight, small) -> None:
    with live(watch, flight) as (viewer, _):
        session = viewer.session
        seen = {}
        until_s = time.monotonic() + 20.0
        while len(seen) < 12 and time.monotonic() < until_s:
            viewer.frame()
            newest_s = session.head.last_s
            assert session.head.live
            assert session.head.utc_s == newest_s
            if session.shown is not None and has_all_samples(viewer, newest_s):
                exposure = session.scene.exposure
                assert exposure.stop_utc_s == pytest.approx(newest_s, abs=2e-6)
                seen[exposure.stop_utc_s] = session.scene

    # From the log: the boresight when the shutter opens, in the middle, and when it closes.
    log = small.simulator(flight)
    assert len(seen) > 3
    for scene in seen.values():
        exposure = scene.exposure
        shutter_s = np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])
        turn = np.einsum("nij,nij->n", log.pointing(shutter_s).C_camera_eq, scene.shutter.C_camera_eq).clip(max=3.0)
        assert np.arccos((turn.min() - 1) / 2) < 0.1 * DEG
    assert 0 < session.live.latency_now_s < 5.0


def test_an_earlier_time_stays_shown_while_the_link_continues(watch, flight) -> None:
    with live(watch, flight) as (viewer, link):
        session, head = viewer.session, viewer.session.head
        frames_until(viewer, lambda: head.length_s > 2.0)
        press(viewer, "Shift+Left")
        press(viewer, "Space")
        assert not head.live
        assert not head.playing
        then_s, scene, packets, last_s = head.utc_s, session.scene, link.status().packets, head.last_s
        # A busy machine lets the vehicle drop packets: count them.
        frames_until(viewer, lambda: head.last_s > last_s + 1.0 and link.status().packets > packets + 40)
        assert head.utc_s == then_s
        assert session.scene is scene
        # Any time within the buffer can be shown.
        for back_s in (1.7, 0.9, 2.2):
            frames_until(viewer, lambda: has_all_samples(viewer, head.last_s - back_s))  # noqa: B023
            head.seek(head.last_s - back_s)
            viewer.frame(0.0)
            exposure = session.scene.exposure
            assert exposure.stop_utc_s == pytest.approx(head.utc_s, abs=2e-6)
            expected = flight.attitude.at(exposure.mid_utc_s)
            assert 2 * np.arccos(min(abs(expected @ session.scene.q_body_ned), 1.0)) < 0.1 * DEG
        for chord in ("F", "End"):
            head.seek(head.last_s - 1.0)
            viewer.frame(0.0)
            assert not head.live
            press(viewer, chord)
            assert head.live
            assert head.utc_s == head.last_s


def test_the_play_head_is_live_again_when_it_catches_up_with_the_link(watch, flight) -> None:
    with live(watch, flight) as (viewer, _):
        head = viewer.session.head
        frames_until(viewer, lambda: head.length_s > 1.5)
        head.seek(head.last_s - 1.0)
        assert head.playing
        viewer.frame()
        assert not head.live
        head.speed = 8.0
        frames_until(viewer, lambda: head.live)
        assert head.playing


def test_samples_older_than_the_buffer_are_dropped(watch, flight) -> None:
    port = free_port()
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0):
        viewer, _ = watch(f"udpin:127.0.0.1:{port}", keep_s=1.5)
        session = viewer.session
        frames_until(viewer, lambda: session.head is not None)
        session.head.toggle()
        then_s = session.head.utc_s
        frames_until(viewer, lambda: session.head.first_s > then_s + 0.3)
        assert session.head.utc_s == session.head.first_s
        # The timeline is as long as the buffer, whenever it is read.
        remembered = session.flight.attitude
        assert 1.0 < remembered.last_s - remembered.first_s <= 1.5 + 1e-6
        # On a busy machine the vehicle may pause: the exposure at the beginning may touch a gap, but not for long.
        frames_until(viewer, lambda: session.status == "" and session.shown is not None)
        press(viewer, "Home")
        assert session.head.second == pytest.approx(session.head.first_s - session.head.origin_s, abs=2e-6)


def test_the_camera_s_own_exposures_can_be_watched_live(watch, flight) -> None:
    with live(watch, flight) as (viewer, _):
        session, head = viewer.session, viewer.session.head
        session.change(**{"exposure.interval_s": 0.7})
        head.mode = Mode.CAMERA
        starts, first_s = set(), head.last_s
        until_s = time.monotonic() + 20.0
        while len(starts) < 3 and time.monotonic() < until_s:
            viewer.frame()
            assert head.live
            # On a busy machine the vehicle may pause, and no image spans a gap.
            if session.shown is not None:
                starts.add(round(session.scene.exposure.start_utc_s - head.origin_s, 3))
        assert len(starts) == 3
        assert all(abs(start / 0.7 - round(start / 0.7)) < 0.01 for start in starts)
        # One after the other, not all at once.
        assert head.last_s - first_s > 0.6


def test_an_outdated_sky_is_grey_and_labelled(watch, flight, monkeypatch) -> None:
    port = free_port()
    viewer, link = watch(f"udpin:127.0.0.1:{port}")
    session = viewer.session
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0):
        frames_until(viewer, lambda: session.image.texture is not None and session.scene.exposure.duration_s == 0.5)
        whole = frames_until(viewer, lambda: whole_flight(link))
    # From now on no packet arrives, and the latest attitude has the age that the test sets.
    age_s, status = [0.9], link.status
    newest = LatestAttitude(whole.attitude.last_s, time.monotonic(), link.latest().utc_minus_boot_s)
    monkeypatch.setattr(link, "status", lambda: replace(status(), age_s=age_s[0]))
    monkeypatch.setattr(link, "latest", lambda: newest)
    monkeypatch.setattr(link, "flight", lambda *_: whole)
    session.loaded.simulator = session.loaded.simulator.with_flight(whole)
    viewer.frame(0.0)
    viewer.frame(0.0)
    assert session.scene.exposure.stop_utc_s == pytest.approx(newest.utc_s, rel=0, abs=2e-6)
    assert session.stale_s is None
    assert session.status == ""
    fresh = screen(viewer)[100:300, 100:500].mean()
    scene = session.scene
    age_s[0] = 1.4
    viewer.frame(0.0)

    assert "no attitude for 1 s" in session.status
    assert session.scene is scene
    assert screen(viewer)[100:300, 100:500].mean() > fresh + 10
    assert not session.busy
    # An earlier time is shown without the veil.
    session.head.seek_by(-0.01)
    viewer.frame(0.0)
    assert session.stale_s is None
    assert screen(viewer)[100:300, 100:500].mean() < fresh + 5


def test_before_the_first_packet_the_panel_names_the_missing_inputs(watch) -> None:
    viewer, link = watch(f"udpin:127.0.0.1:{free_port()}")
    viewer.frame()
    assert "waiting for an autopilot" in viewer.session.status
    frames_until(viewer, lambda: link.status().problem)
    viewer.frame()
    assert "QGroundControl" in viewer.session.status
    assert viewer.session.image.texture is None
    save_frame(viewer.session)
    (error,) = viewer.session.notifications.errors
    assert error.startswith("no image to save: ")
    assert "QGroundControl" in error


def test_a_link_without_utc_and_position_gets_them_from_the_user(watch) -> None:
    port, mavlink = free_port(), dialect()
    viewer, link = watch(f"udpin:127.0.0.1:{port}")
    session = viewer.session
    with open_transport(Endpoint.parse(f"udpout:127.0.0.1:{port}")) as plane:
        sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        began_s = time.monotonic()

        def fly() -> None:
            boot_ms = round((time.monotonic() - began_s) * 1000)
            plane.write(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3).pack(sender))
            plane.write(mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, 0.3, 0, 0, 0).pack(sender))
            plane.write(mavlink.MAVLink_system_time_message(0, boot_ms).pack(sender))

        def flying(true: Callable[[], Any]) -> Callable[[], Any]:
            return lambda: fly() or true()

        frames_until(viewer, flying(lambda: "no UTC yet" in session.status))
        assert "--utc-now" in session.status
        assert "no position yet (--lat, --lon)" in session.status
        click(viewer, lambda: link.status().utc_source is not None)
        click(viewer, lambda: session.missing is not None)
        assert [field.key for field in session.missing.fields] == ["latitude_deg", "longitude_deg", "height_m"]
        for text, key in (("-34.93", "Tab"), ("138.6", "Tab"), ("", "Enter")):
            type_text(viewer, text)
            press(viewer, key)
        assert session.missing is None
        frames_until(viewer, flying(lambda: session.image.texture is not None))

    assert link.status().utc_source == "the computer's clock"
    assert link.status().position_source == "given"
    assert session.head.utc_s == pytest.approx(time.time(), abs=5.0)
    site = session.flight.position.at(session.head.utc_s)
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([-34.93, 138.6])


def click(viewer: Viewer, done: Callable[[], bool]) -> None:
    """Click at increasing heights of the link panel until a button has had an effect."""
    io = imgui.get_io()
    for y in range(150, 560, 8):
        io.add_mouse_pos_event(720.0, float(y))
        for down in (True, False):
            io.add_mouse_button_event(0, down)
            viewer.frame(0.0)
        if done():
            io.add_mouse_pos_event(-1.0, -1.0)
            for _ in range(3):
                viewer.frame(0.0)
            return
    pytest.fail("no button")


def test_a_vehicle_that_restarts_begins_a_new_flight(watch, flight) -> None:
    port = free_port()
    viewer, _ = watch(f"udpin:127.0.0.1:{port}")
    session = viewer.session
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0, speed=8.0):
        frames_until(viewer, lambda: session.head is not None and session.head.length_s > 6.0)
        before = session.head
    with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=5.0):
        frames_until(viewer, lambda: session.head is not before and session.head.length_s > 0.6)
        assert session.head.live
        assert session.head.utc_s < flight.attitude.first_s + 10.0
        assert any("restarted" in event.message for event in session.live.events)
        assert any("restarted" in notice.message for notice in session.notifications.current)


def test_a_reboot_in_flight_is_a_gap_and_the_buffer_stays(small, tmp_path, monkeypatch) -> None:
    """The autopilot is off from 8 to 9 s and restarts with its clock at zero, at first without UTC."""
    monkeypatch.setattr("glstar.viewer.flight.live._REFRESH_S", 0.0)
    script = [*flown(Sender(1), 100.0, 0.0, 8.0, UTC_S), *flown(Sender(1), 0.5, 9.0, 12.0, None)]
    link = ScriptedLink(script)
    with ExitStack() as held:
        surface = HeadlessSurface((900, 600))
        held.callback(surface.close)
        viewer = held.enter_context(Viewer(surface, small, output=tmp_path / "saved"))
        viewer.follow(link)
        session = viewer.session

        def play_until(end_s: float) -> None:
            while link.now_s < end_s:
                link.wait_for(np.inf, 0.1)
                viewer.frame(0.1)

        play_until(1.0)
        frames_until(viewer, lambda: session.head is not None)
        play_until(7.5)
        before = session.head
        play_until(11.5)
        frames_until(viewer, lambda: session.flight.attitude.last_s > UTC_S + 11.0)
        assert session.head is before
        assert any("restarted" in event.message for event in session.live.events)
        assert session.flight.attitude.first_s == pytest.approx(UTC_S, rel=0, abs=0.01)
        assert [gap.reason for gap in session.flight.attitude.gaps] == ["a reboot of the autopilot"]
        # Exposures before the gap can still be shown; one that spans it is not drawn.
        session.head.toggle()
        session.head.seek(UTC_S + 3.0)
        viewer.frame(0.0)
        assert session.scene.exposure.stop_utc_s == pytest.approx(UTC_S + 3.0, rel=0, abs=1e-5)
        session.head.seek(UTC_S + 9.2)
        viewer.frame(0.0)
        assert session.shown is None
        assert "reboot" in session.status


def test_a_log_can_be_replayed_and_a_key_returns_to_the_link(watch, flight, log) -> None:
    with live(watch, flight) as (viewer, _):
        session = viewer.session
        session.open(log)
        frames_until(viewer, lambda: session.flight is not None and session.flight.name == "turning.csv")
        assert not session.head.grows
        viewer.frame()
        assert session.image.number == 0
        press(viewer, "F")
        frames_until(
            viewer, lambda: session.head is not None and session.head.live and session.image.texture is not None
        )
        assert session.loaded.path is None


def test_a_frame_saved_live_is_reproduced_by_its_manifest_s_command(watch, flight, tmp_path) -> None:
    with live(watch, flight) as (viewer, _):
        session = viewer.session
        # On a busy machine the vehicle may pause, and no image spans a gap.
        frames_until(viewer, lambda: session.shown is not None)
        press(viewer, "Space")
        viewer.frame(0.0)
        shown = session.image.pixels.copy()
        save_frame(session)
        frames_until(viewer, lambda: session.export is None, 60.0)
        (saved,) = (path for path in session.output.iterdir() if path.is_dir())
        settings = Config.load(saved.with_name(f"{saved.name}.toml"))
        manifest = json.loads((saved / "manifest.json").read_text())
        table = saved.with_name(f"{saved.name}.csv")
        assert manifest["flight"]["name"] == table.name
        options = ExportOptions(start_s=manifest["start_s"], frames=1)
        job = prepare_export(settings, table, tmp_path / "again", options)
        with GLRenderer.headless() as renderer:
            job.run(SerialExecutor(renderer))

    name = "frame_000000.png"
    assert (saved / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    difference = cv2.imread(str(saved / name), cv2.IMREAD_UNCHANGED).astype(int) - shown.astype(int)
    assert np.abs(difference).max() <= 1


def test_a_recording_replays_the_same_frames(watch, flight, small, tmp_path) -> None:
    log = tmp_path / "flight.tlog"
    seen = {}
    with Recorder(log) as recorder:
        port = free_port()
        with playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0):
            viewer, _ = watch(f"udpin:127.0.0.1:{port}", recorder=recorder)
            session = viewer.session
            frames_until(viewer, lambda: session.scene is not None and session.scene.exposure.duration_s == 0.5)
            until_s = time.monotonic() + 20.0
            while len(seen) < 12 and time.monotonic() < until_s:
                viewer.frame()
                if session.shown is not None:
                    seen[session.scene.exposure.stop_utc_s] = session.image.pixels.copy()
            frames_until(viewer, lambda: session.head.length_s > 2.0)
            newest_s = session.head.last_s
    session.open(log)
    frames_until(viewer, lambda: session.loaded.path == log)
    assert session.flight.attitude.last_s >= newest_s - 1e-6
    session.head.mode = Mode.SLIDING
    session.head.playing = False

    others = []
    for stop_utc_s, pixels in seen.items():
        session.head.seek(stop_utc_s)
        # Each frame of the camera has its own noise; these two have the same seed.
        session.image.clear()
        viewer.frame(0.0)
        assert session.scene.exposure.stop_utc_s == pytest.approx(stop_utc_s, abs=3e-6)
        others.append(np.abs(pixels.astype(int) - session.image.pixels.astype(int)))
    # Exposures are named to the microsecond from the flight's first attitude, which differs; and the position
    # of the last fifth of a second is not known yet in a live flight: a few pixels round to another DN.
    assert len(seen) > 5
    assert max(difference.max() for difference in others) <= 1
    assert max(np.count_nonzero(difference) for difference in others) <= 20


def test_the_window_never_waits_for_the_link(watch, monkeypatch) -> None:
    """Frames are drawn while the link's thread waits for a peer that never answers."""
    reading, drawn = threading.Event(), threading.Event()
    waited = []

    def read(_: _TcpClient, timeout_s: float) -> bytes:
        reading.set()
        waited.append(drawn.wait(60.0))
        return b""

    monkeypatch.setattr(_TcpClient, "read", read)
    with socket.create_server(("127.0.0.1", 0)) as server:
        viewer, _ = watch(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        assert reading.wait(60.0)
        for _ in range(5):
            viewer.frame()
        assert waited == []
        drawn.set()
        assert "waiting for an autopilot" in viewer.session.status
