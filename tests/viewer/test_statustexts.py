"""What the status bar, the messages and the panel Link write: every value, in order, and what their buttons do."""

import time
from math import radians
from pathlib import Path
from types import SimpleNamespace

import pytest
from imgui_bundle import ImVec2, imgui

from glstar.link.status import LinkStatus
from glstar.viewer.session.keys import Action
from glstar.viewer.session.memory import Notifications
from glstar.viewer.ui import status
from tests.support.scriptedimgui import ScriptedImgui, scripted

# 2024-03-10T11:00:04.678Z
UTC_S = 1710068404.678
SPACED, GROUP = (0.0, 18.0), (0.0, 36.0)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    return scripted(monkeypatch, status)


def link_status(**changes: object) -> LinkStatus:
    values = {"endpoint": "udp:14550", "state": "live", "problem": None, "vehicle": "plane", "sysid": 3}
    values |= {"systems": (3, 7), "rate_hz": 48.76, "age_s": 0.234, "packets": 970, "lost": 30, "bad_bytes": 17}
    values |= {"utc_source": "GPS, with leap seconds", "position_source": "GLOBAL_POSITION_INT"}
    return LinkStatus(**{**values, "recorded_bytes": 2_345_678} | changes)


def live_flight(**changes: object) -> SimpleNamespace:
    events = [SimpleNamespace(utc_s=UTC_S + k, message=f"event {k}") for k in (0, 65)]
    recording = SimpleNamespace(path=Path("logs/link-1.tlog"))
    link = SimpleNamespace(recording=recording, use_computer_clock=lambda: link.done.append("clock"), done=[])
    return SimpleNamespace(status=link_status(**changes), link=link, events=events, latency_now_s=0.0876, stale_s=None)


def session_of(live: SimpleNamespace | None, **changes: object) -> SimpleNamespace:
    values = {"live": live, "loaded": None, "head": None, "scene": None, "conditions": None, "export": None}
    values |= {"video": None, "stale_s": None, "is_playing": False, "night": False, "status": ""}
    values["loader"] = SimpleNamespace(path=None, others=SimpleNamespace(reading=None))
    values["renderer"] = SimpleNamespace(driver="llvmpipe (LLVM 15.0, 256 bits)")
    values["times"] = SimpleNamespace(frames_per_s=23.6)
    values["comparison"] = SimpleNamespace(image_at=lambda _: None, ahead_s=-1.25)
    return SimpleNamespace(**values | changes)


def test_the_panel_of_a_link_has_all_of_its_state(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[object] = []
    monkeypatch.setattr(status, "is_on", lambda action, _: action is Action.RECORD_LINK)
    monkeypatch.setattr(status, "perform", lambda action, _: done.append(action))
    monkeypatch.setattr(status, "listen_to", lambda _, system: done.append(system))
    monkeypatch.setattr(time, "localtime", time.gmtime)
    live = live_flight()
    drawn.answers = {"system 3": True, "system 7": True, "Export frames": True}
    status.draw_link(session_of(live), live)
    about = "? MAVLink system whose sky is shown (glstar live --sysid, [flight] sysid)"
    assert drawn.take() == [
        "udp:14550: live",
        *("--- Vehicle", "(vehicle)", "plane, system 3", "(attitude)", "48.8 Hz", "(latest)", "0.23 s ago"),
        *("(UTC)", "GPS, with leap seconds", "(position)", "GLOBAL_POSITION_INT"),
        *("(listen to)", "(o) system 3", about, "( ) system 7", about),
        *("--- Link", "(latency)", "88 ms", "(packets)", "970", "(lost)", "30, 3.0 %", "(bad bytes)", "17"),
        *("(recorded)", "2345678 bytes", "(to)", "link-1.tlog"),
        *("<Stop recording>", "? Writes every packet to a .tlog (--record)", "<Export frames>"),
        "? Writes each exposure of the camera with its truth as it is exposed (--export)",
        *("<Disconnect>", "? Closes the link; the received part of the flight can be replayed"),
        *("--- Events", "(11:01:09)", "event 65", "(11:00:04)", "event 0"),
    ]
    assert done == [7, Action.EXPORT_LINK]


def test_the_panel_of_a_link_without_anything_offers_what_it_lacks(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status, "is_on", lambda action, _: action is Action.EXPORT_LINK)
    monkeypatch.setattr(status, "perform", lambda *_: None)
    nothing = {"vehicle": None, "sysid": None, "systems": (3,), "utc_source": None, "position_source": None}
    live = live_flight(**nothing, problem="no 100 % reply", state="timeout", lost=0, recorded_bytes=0)
    live.latency_now_s, live.link.recording.path, live.events = None, None, []
    asked: list[str] = []
    session = session_of(live, ask_for_site=lambda: asked.append("site"))
    drawn.answers = {"UTC: use this computer's clock": True, "Position: enter the site ...": True}
    status.draw_link(session, live)
    lines = drawn.take()
    assert lines[:15] == [
        *("udp:14550: timeout", "no 100 % reply [unsaved_marker]", "--- Vehicle", "(vehicle)", "none yet"),
        *("(attitude)", "48.8 Hz", "(latest)", "0.23 s ago", "(UTC)", "unknown", "(position)", "unknown"),
        *("--- Missing from the link", "<UTC: use this computer's clock>"),
    ]
    assert lines[15:18] == ["<Position: enter the site ...>", "--- Link", "(latency)"]
    assert lines[18:27] == [
        *("none yet", "(packets)", "970", "(lost)", "0", "(bad bytes)", "17", "(recorded)", "nothing")
    ]
    assert [line for line in lines if line.startswith("<")][2:] == ["<Record>", "<Stop export>", "<Disconnect>"]
    assert (live.link.done, asked) == (["clock"], ["site"])
    # Without an attitude nothing can be said to be missing; with one of the two, the other is.
    for changes, offered in (
        ({"age_s": None, "utc_source": None}, []),
        ({"utc_source": None}, ["<UTC: use this computer's clock>"]),
        ({"position_source": None}, ["<Position: enter the site ...>"]),
    ):
        live.status = link_status(**changes)
        status._draw_missing(session, live)
        assert [line for line in drawn.take() if line.startswith("<")] == offered
    live.status = link_status(age_s=None)
    status._draw_status(live)
    assert drawn.take()[6:8] == ["(latest)", "none yet"]


def loaded_flight(**changes: object) -> SimpleNamespace:
    head = {"utc_s": UTC_S, "playing": False, "second": 12.3456, "length_s": 607.89, "grows": False, "live": False}
    head |= {"speed": 2.0, "mode": "camera"}
    return SimpleNamespace(head=SimpleNamespace(**head | changes), flight=SimpleNamespace(time_offset_s=0.0))


def bar(session: SimpleNamespace, drawn: ScriptedImgui) -> list[str]:
    drawn.begin_viewport_side_bar = lambda *args: drawn.calls.append(("bar", *args)) or True
    status.draw_status_bar(session)
    return drawn.lines


def test_the_status_bar_has_times_exposure_stars_and_zoom(drawn: ScriptedImgui) -> None:
    loaded = loaded_flight()
    loaded.flight.time_offset_s = 1.5
    scene = SimpleNamespace(
        shorts=(1, 2, 3),
        trails=range(17),
        exposure=SimpleNamespace(trail="analytic", duration_s=0.25),
        visible=SimpleNamespace(size=432),
    )
    session = session_of(
        None,
        loaded=loaded,
        head=loaded.head,
        scene=scene,
        view=SimpleNamespace(zoom=2.347),
        export=SimpleNamespace(progress=(0.25, "3 of 12"), cancel=lambda: done.append("export")),
        video=SimpleNamespace(progress=(0.5, "6 s"), stop=lambda: done.append("video")),
    )
    session.loader = SimpleNamespace(path=Path("a/b.bin"), others=SimpleNamespace(reading=Path("c/d.ulg")))
    done: list[str] = []
    drawn.answers = {"stop##video": True}
    lines = bar(session, drawn)
    assert lines == [
        *("2024-03-10T11:00:04.678Z", "camera 11:00:06.178Z", "12.346 / 607.9 s", "x2 paused [text_disabled]"),
        "camera",
        *("3 x 0.25 s in 17 segments", "432 stars", "235 %", "reading b.bin ... [text_link]"),
        *("reading d.ulg ... [text_link]", "25 % 3 of 12", "<stop>", "50 % 6 s", "<stop>", "(llvmpipe)"),
    ]
    assert done == ["video"]
    # The bar is as high as a control, with its text in the middle; bars of progress are 150 px wide.
    assert drawn.named("bar")[0][0] == "##status"
    assert drawn.named("bar")[0][2:4] == [imgui.Dir.down, 18.0]
    assert drawn.named("set_cursor_pos_y") == [[4.0]]
    assert [size for _, size, _ in drawn.named("progress_bar")] == [(225.0, 10.0)] * 2
    # All items are 18 px from each other; the driver is at the right edge, as far from it as from what is before it.
    assert drawn.named("same_line") == [[0.0, 18.0]] * 10 + [[], [0.0, 18.0], [], [0.0, 12.0]]
    assert drawn.named("set_cursor_pos_x") == [[900.0 - 8 * 8 - 12.0]]
    drawn.take()
    drawn.answers = {"stop##export": True}
    bar(session, drawn)
    assert done == ["video", "export"]
    # Only times that can be read change while it plays; sub-exposures have another name; without room no driver.
    drawn.take()
    drawn.available = ImVec2(8.0 * (8 + 9) + 12.0, 20.0)
    scene.shorts, scene.exposure.trail = (), "sprites"
    loaded.head.playing, loaded.flight.time_offset_s, session.is_playing = True, 0.0, True
    lines = bar(session, drawn)
    assert lines[:5] == [*("2024-03-10T11:00:04.6Z", "12.3 / 607.9 s", "x2", "camera", "0.25 s in 17 sub-exposures")]
    assert "llvmpipe" not in lines[-1]
    drawn.available.x += 1.0
    drawn.take()
    assert bar(session, drawn)[-1] == "(24 fps   llvmpipe)"


def test_the_status_bar_has_the_real_image_s_time(drawn: ScriptedImgui) -> None:
    image = SimpleNamespace(path=Path("f/real.png"), time=SimpleNamespace(utc_s=UTC_S + 2, source="its name"))
    loaded = loaded_flight(grows=True, live=True)
    session = session_of(None, loaded=loaded, comparison=SimpleNamespace(image_at=lambda _: image, ahead_s=-1.25))
    assert bar(session, drawn)[:3] == [
        "2024-03-10T11:00:04.678Z",
        "real 11:00:06.678Z [text_link]",
        "? real.png: 2024-03-10T11:00:06.678Z by its name\ncamera clock - log clock = -1.250 s",
    ]


@pytest.mark.parametrize(
    ("room_px", "lines"),
    [
        (400.0, ["Sun 12 deg up, Moon 34 deg up", "stars to V 4.5"]),
        (8 * 29, ["Sun 12 deg up, Moon 34 deg up", "stars to V 4.5"]),
        (8 * 29 - 1, ["Sun -12, Moon 35 deg", "stars to V 4.5"]),
        (8 * 20 - 1, ["stars to V 4.5"]),
        (8 * 14 - 1, []),
    ],
)
def test_the_conditions_are_written_as_far_as_they_fit(drawn: ScriptedImgui, room_px: float, lines: list[str]) -> None:
    viewing = SimpleNamespace(
        sun_altitude_rad=radians(-12.3),
        moon_altitude_rad=radians(34.6),
        sun_and_moon="Sun 12 deg up, Moon 34 deg up",
        light="night",
    )
    drawn.available = ImVec2(room_px, 20.0)
    status._draw_conditions(SimpleNamespace(viewing=viewing, limit=SimpleNamespace(text="stars to V 4.5")))
    about = (
        "? night: Sun 12 deg up, Moon 34 deg up\nstars to V 4.5\n"
        "Stars on the optical axis with a signal-to-noise ratio of 5, above the air."
    )
    assert drawn.named("same_line") == [[0.0, 18.0]] * 2
    assert drawn.take() == [line for text in lines for line in (text, about)]
    status._draw_conditions(None)
    assert drawn.take() == []


@pytest.mark.parametrize(
    ("live", "stale_s", "state", "badge"),
    [
        (True, None, "live", "LIVE [text_link]"),
        (True, 2.5, "live", "link [unsaved_marker]"),
        (False, None, "live", "link [unsaved_marker]"),
        (False, None, "timeout", "link timeout [unsaved_marker]"),
    ],
)
def test_the_status_bar_says_how_the_link_is(
    drawn: ScriptedImgui, live: bool, stale_s: float | None, state: str, badge: str
) -> None:
    link = live_flight(state=state, age_s=2.54)
    link.stale_s = stale_s
    session = session_of(link, head=SimpleNamespace(live=live), stale_s=stale_s)
    mark = " [unsaved_marker]" if stale_s else ""
    assert bar(session, drawn)[:-1] == [
        *(badge, "49 Hz", "latency 88 ms", "30 lost", f"2.5 s old{mark}", "GPS", "2.3 MB recorded")
    ]
    assert drawn.named("same_line") == [[0.0, 18.0]] * 6 + [[0.0, 36.0], [0.0, 12.0]]
    drawn.take()
    link.status = link_status(age_s=None, utc_source=None, recorded_bytes=0)
    session.head = None
    assert bar(session, drawn)[:-1] == [
        *("link [unsaved_marker]", "49 Hz", "latency 88 ms", "30 lost", "no UTC [unsaved_marker]")
    ]


def test_messages_are_stacked_at_the_lower_right_and_errors_can_be_dismissed(drawn: ScriptedImgui) -> None:
    notifications = Notifications(lambda: 50.0)
    for text, is_error in (("first", False), ("in the image", True), ("second", True)):
        notifications.add(text, is_error=is_error)
    session = session_of(None, status="in the image", notifications=notifications)
    shown = status.draw_notifications(session)
    assert [each.message for each in shown] == ["first", "in the image", "second"]
    assert drawn.lines == ["=== ##notification0", "second [unsaved_marker]", "=== ##notification1", "first"]
    # 12 px from the corner of the window at (910, 620), the next one 8 px above one of 32 px.
    places = [(at, pivot) for at, _, pivot in drawn.named("set_next_window_pos")]
    assert places == [((898.0, 608.0), (1.0, 1.0)), ((898.0, 568.0), (1.0, 1.0))]
    lets_through = [bool(args[2] & int(imgui.WindowFlags_.no_mouse_inputs)) for args in drawn.named("begin")]
    assert lets_through == [False, True]
    # At most 520 px on a usual screen wide, and not wider than the window.
    assert drawn.named("push_text_wrap_pos") == [[780.0]] * 2
    for hovered, clicked, left in ((True, False, 3), (False, True, 3), (True, True, 1)):
        drawn.hovered, drawn.pressed = hovered, {"click 0"} if clicked else set()
        status.draw_notifications(session)
        assert len(notifications.current) == left
