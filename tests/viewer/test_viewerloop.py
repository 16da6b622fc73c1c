"""The main loop without a window: how long it waits, what a script does, and which pictures are taken."""

from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import RenderError
from glstar.viewer import loop
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import Script, Viewer
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.memory import Place, WindowMemory
from glstar.viewer.session.saving import PictureAction
from tests.support.viewerdoubles import Noting


class Clock:
    now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a viewer whose frames are counted in `frames`, and whose clock a frame moves by 0.02 s."""
    made, clock = Viewer.__new__(Viewer), Clock()
    monkeypatch.setattr(loop.time, "perf_counter", clock)
    monkeypatch.setattr(loop.time, "sleep", lambda seconds: setattr(clock, "now_s", clock.now_s + seconds))
    made.clock, made.frames, made.ends = clock, [], 1000

    def frame(elapsed_s: float | None = None) -> None:
        made.frames.append(elapsed_s)
        clock.now_s += 0.02
        made._surface.should_close = len(made.frames) >= made.ends

    made.frame = frame
    made._surface = Noting(should_close=False, size=(900, 600), done=[], target="target")
    made._surface.wait = lambda timeout_s: (
        made._surface.done.append(timeout_s) or (made.events.pop(0) if made.events else False)
    )
    made.events = []
    head = SimpleNamespace(mode=Mode.CAMERA, live=False, loop=False, playing=False)
    notifications = SimpleNamespace(current=[], errors=[])
    scene = SimpleNamespace(camera=SimpleNamespace(width_px=320, height_px=240), trails=range(7))
    scene.visible = SimpleNamespace(size=43)
    times = SimpleNamespace(report=lambda: {"frames": 3}, pause=lambda: made.frames.append("pause"), recording=False)
    made.session = Noting(
        head=head, live=None, busy=False, notifications=notifications, times=times, scene=scene, status="", done=[],
        loader=SimpleNamespace(start_s=None, path=None, missing=None), image=SimpleNamespace(error="", texture=1),
        shown_overlays={Overlay.HORIZON}, renderer=SimpleNamespace(driver="llvmpipe"), loaded=None,
    )  # fmt: skip
    made.interface = SimpleNamespace(
        keyboard=SimpleNamespace(has_input_left=False), drawn_notifications=[], wants_to_quit=False, screenshot=None,
        files=SimpleNamespace(is_answered=False), calibration=SimpleNamespace(is_running=False), picture=None,
        covers_picture=False, visible_px=(1, 2, 3, 4), plain_picture=lambda: np.arange(12).reshape(2, 2, 3), recent=[],
    )  # fmt: skip
    return made


# --- waiting ---


def test_a_window_at_rest_draws_three_frames_and_waits_for_an_event(viewer: Any) -> None:
    viewer.ends, viewer.events = 7, [False, False, False, False, True]
    viewer.run()
    # After three frames it sleeps, for half a second at a time, until an event.
    assert viewer.frames == [None, None, None, "pause"] * 2
    assert viewer._surface.done[:5] == [0.0, 0.0, 0.5, 0.5, 0.5]


def test_a_window_that_changes_is_drawn_at_most_sixty_times_a_second(viewer: Any) -> None:
    viewer.session.busy, viewer.ends = True, 5
    viewer.run()
    assert viewer.frames == [None] * 5
    assert viewer._surface.done == [0.0] * 5
    # Keys that are left in the queue keep it awake.
    viewer.frames, viewer.ends, viewer.session.busy = [], 6, False
    viewer._surface.should_close, viewer.interface.keyboard.has_input_left = False, True
    viewer.run()
    assert viewer.frames == [None] * 6


@pytest.mark.parametrize("change", ["busy", "notification", "answered", "calibrating", "close"])
def test_what_changes_ends_the_sleep(viewer: Any, change: str) -> None:
    assert not viewer._has_changed()
    waits = viewer._surface.wait

    def wait(timeout_s: float) -> bool:
        if len(viewer._surface.done) == 2:
            viewer.session.busy = change == "busy"
            viewer.session.notifications.current = ["new"] if change == "notification" else []
            viewer.interface.files.is_answered = change == "answered"
            viewer.interface.calibration.is_running = change == "calibrating"
            viewer._surface.should_close = change == "close"
        return waits(timeout_s)

    viewer._surface.wait = wait
    assert viewer._sleep()
    assert viewer._surface.done == [0.5] * 3
    assert viewer._has_changed() == (change != "close")


def test_with_a_link_the_window_sleeps_for_a_tenth_of_a_second(viewer: Any) -> None:
    viewer.session.live = "live"
    assert not viewer._sleep()
    viewer.events.append(True)
    assert viewer._sleep()
    assert viewer._surface.done == [0.1, 0.1]
    assert not viewer._is_closing
    viewer.interface.wants_to_quit = True
    assert viewer._is_closing


# --- scripts ---


def test_a_script_shows_a_flight_and_reports_its_frames(viewer: Any) -> None:
    script = Script(at_s=12.5, mode=Mode.SLIDING, overlays=frozenset({Overlay.STAR_NAMES}))
    report = viewer.play(script)
    assert viewer.session.loader.start_s == 12.5
    assert viewer.session.shown_overlays == set(script.overlays)
    assert (viewer.session.head.mode, viewer.frames) == (Mode.SLIDING, [0.0] * 4)
    assert report == {
        "frames": 3,
        "mode": "sliding",
        "image": [320, 240],
        "window": [900, 600],
        "sub_exposures": 7,
        "stars": 43,
        "renderer": "llvmpipe",
    }
    viewer.frames.clear()
    draw, recorded = viewer.frame, []
    viewer.frame = lambda elapsed_s=None: recorded.append(viewer.session.times.recording) or draw(elapsed_s)
    viewer.play(Script(play_s=0.099))
    assert recorded == [False] * 4 + [True] * 5
    # Frames of 20 ms, and a sleep of none: five of them play.
    assert viewer.frames == [0.0] * 4 + [None] * 5
    assert (viewer.session.head.loop, viewer.session.head.playing) == (True, False)
    assert (viewer.session.head.mode, viewer.session.times.recording) == (Mode.SLIDING, False)
    viewer.frames.clear()
    viewer.play(Script(screenshot=Path("a.png")))
    assert (viewer.interface.screenshot, viewer.frames) == (Path("a.png"), [0.0] * 5)
    viewer.session.notifications.errors = ["first", "disk full"]
    with pytest.raises(RenderError, match="disk full"):
        viewer.play(Script(screenshot=Path("a.png")))
    viewer.play(Script())


def test_a_script_without_a_flight_or_an_image_is_an_error_or_the_user_s_choice(viewer: Any) -> None:
    session = viewer.session
    session.image.error = "too many stars"
    with pytest.raises(RenderError, match="too many stars"):
        viewer.play(Script())
    session.image.error, session.scene = "", None
    with pytest.raises(RenderError, match="there is no image to show"):
        viewer.play(Script())
    session.head, session.status = None, "no UTC"
    with pytest.raises(RenderError, match="no UTC"):
        viewer.play(Script())
    session.status = ""
    with pytest.raises(RenderError, match="there is no flight to show"):
        viewer.play(Script())
    assert viewer.play(Script(asks=True)) == {"frames": 3}
    session.notifications.errors = ["broken"]
    with pytest.raises(RenderError, match="there is no flight to show"):
        viewer.play(Script(asks=True))


def test_a_script_that_asks_draws_until_it_is_answered(viewer: Any) -> None:
    loader = viewer.session.loader
    states = [("a.bin", None), ("a.bin", "missing"), (None, "missing"), (None, None)]
    draw = viewer.frame

    def frame(elapsed_s: float | None = None) -> None:
        draw(elapsed_s)
        if elapsed_s is None:
            loader.path, loader.missing = states.pop(0)

    viewer.frame, (loader.path, loader.missing) = frame, states.pop(0)
    viewer.play(Script(asks=True))
    assert (viewer.frames, states) == ([0.0, None, None, None, 0.0, 0.0, 0.0], [])
    loader.path, viewer.ends, viewer.frames = "b.bin", 2, []
    viewer._surface.should_close = False
    states[:] = [("b.bin", None)] * 5
    viewer._draw_until_answered()
    assert len(viewer.frames) == 2


def test_a_link_is_shown_for_some_time_or_until_its_first_image(viewer: Any) -> None:
    live = Noting(done=[], report=lambda: {"latency": 7})
    viewer.session.live = live
    report = viewer.play(Script(play_s=0.05))
    assert (live.done, viewer.frames) == ([("record",)], [0.0, None, None, None])
    assert report["link"] == {"latency": 7}
    assert report["stars"] == 43
    viewer.session.scene = None
    assert viewer.play(Script(play_s=0.05)) == {"frames": 3, "link": {"latency": 7}}
    viewer.frames.clear()
    viewer.session.image.texture = None
    draw = viewer.frame

    def frame(elapsed_s: float | None = None) -> None:
        draw(elapsed_s)
        viewer.session.image.texture = 1 if len(viewer.frames) > 7 else None

    viewer.frame = frame
    viewer.play(Script())
    # A tenth of a second at a time.
    assert 8 <= len(viewer.frames) <= 1 + 2 * 5
    viewer.session.image.texture, viewer.session.status, viewer.frame = None, "no packets", draw
    before_s, viewer.ends = viewer.clock.now_s, 9999
    with pytest.raises(RenderError, match="no packets"):
        viewer.play(Script())
    assert viewer.clock.now_s - before_s == pytest.approx(30.0, abs=0.2)
    # A window that is closed waits no longer.
    viewer.session.status, viewer.ends, viewer.frames = "", 4, []
    with pytest.raises(RenderError, match="the window was closed before the first image"):
        viewer.play(Script())
    assert len(viewer.frames) == 4


# --- pictures and memory ---


def test_the_pictures_that_the_user_wants_are_taken(viewer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []
    monkeypatch.setattr(loop, "cut_picture", lambda *what: what[1:])
    monkeypatch.setattr(loop, "write_picture", lambda _, *what: done.append(what))
    monkeypatch.setattr(loop, "use_picture", lambda _, action, picture: done.append((action, picture)))
    monkeypatch.setattr(loop, "record", lambda _, video, picture: done.append((video, picture)))
    viewer.session.video, viewer._video_px = None, "before"
    viewer._take_pictures()
    assert (done, viewer._video_px) == ([], None)
    viewer.interface.screenshot, viewer.interface.picture = Path("a.png"), PictureAction.COPY
    viewer._take_pictures()
    assert done == [(Path("a.png"), ((900, 600),), "screenshot"), (PictureAction.COPY, ((900, 600), (1, 2, 3, 4)))]
    assert (viewer.interface.screenshot, viewer.interface.picture) == (None, None)
    done.clear()
    viewer.interface.picture, viewer.interface.covers_picture = PictureAction.SAVE_PLAIN, True
    viewer._take_pictures()
    assert (done, viewer.interface.picture) == ([], PictureAction.SAVE_PLAIN)
    viewer.interface.covers_picture = False
    viewer._take_pictures()
    ((action, picture),) = done
    assert (action, picture[1, 0].tolist()) == (PictureAction.SAVE_PLAIN, [8, 7, 6])
    viewer.interface.plain_picture = lambda: None
    assert viewer._picture(plain=True) is None
    viewer.interface.visible_px = None
    assert viewer._picture(plain=False) is None
    # A video keeps the part of the window that it began with; nothing is added while a dialog covers the picture.
    done.clear()
    viewer.session.video = "video"
    viewer._take_pictures()
    for visible_px, covers in (((5, 6, 7, 8), False), ((9, 9, 9, 9), False), ((9, 9, 9, 9), True)):
        viewer.interface.visible_px, viewer.interface.covers_picture = visible_px, covers
        viewer._take_pictures()
    assert done == [("video", None), *[("video", ((900, 600), (5, 6, 7, 8)))] * 2, ("video", None)]


def test_an_opened_flight_is_remembered_once(viewer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    freed: list[int] = []
    monkeypatch.setattr(loop, "return_freed_memory", lambda: freed.append(1))
    viewer._memory, viewer._remembered = WindowMemory(), None
    viewer._remember()
    viewer.session.loaded = SimpleNamespace(path=Path("fly:still"))
    for _ in range(2):
        viewer._remember()
    assert (viewer.interface.recent, freed) == (["fly:still"], [])
    viewer.session.loaded = SimpleNamespace(path=None)
    viewer._remember()
    assert (viewer.interface.recent, freed) == (["fly:still"], [1])
    viewer.session.loaded = None
    viewer._remember()
    viewer.session.loaded = SimpleNamespace(path=Path("fly:orbit"))
    viewer._remember()
    assert (viewer.interface.recent, freed) == (["fly:orbit", "fly:still"], [1, 1])


def test_a_frame_measures_its_time_and_presents_what_is_drawn(viewer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[Any] = []
    session, surface, interface = viewer.session, viewer._surface, viewer.interface
    session.times = SimpleNamespace(
        begin=lambda: events.append("begin"), end=lambda: events.append("end"), span=lambda _: nullcontext()
    )
    session.flight, session.video, session.image = None, None, Noting(done=events)
    surface.dropped = lambda: [Path("a"), Path("b")]
    surface.new_frame, surface.done = "new frame", events
    interface.open_dropped, interface.wanted_link, interface.wants_full_screen = events.append, None, False
    interface.frame = lambda new_frame, elapsed_s: events.append((new_frame, round(elapsed_s, 6)))
    interface.paint = lambda *what: events.append(what)
    viewer._remember, viewer._take_pictures = (lambda: None), (lambda: events.append("pictures"))
    viewer._titled, viewer._full_screen, viewer._last_frame_s = None, False, 49.9
    frame = Viewer.frame
    frame(viewer)
    assert events == [
        *("begin", Path("a"), Path("b"), ("new frame", 0.1), ("target", (900, 600)), "pictures", ("present",)),
        *(("begin_next",), "end"),
    ]
    surface.dropped = list
    viewer.clock.now_s = 51.0
    for elapsed_s, given in ((0.5, None), (0.0, None), (0.25, 0.25)):
        events.clear()
        frame(viewer, given)
        assert ("new frame", elapsed_s) in events
    # While a range is recorded no time passes by itself.
    events.clear()
    session.video = SimpleNamespace(prepare=lambda head: events.append(("prepare", head)) or True)
    frame(viewer, 0.25)
    assert events[1:3] == [("prepare", session.head), ("new frame", 0.0)]
    session.video = SimpleNamespace(prepare=lambda _: False)
    events.clear()
    frame(viewer, 0.25)
    assert ("new frame", 0.25) in events
    # Title, full screen and link are changed once.
    session.flight, session.video = SimpleNamespace(name="night.bin"), None
    interface.wants_full_screen, interface.wanted_link = True, "udp:1"
    viewer._connect = lambda link: events.append(("connect", link))
    session.live = SimpleNamespace(presented=lambda: events.append("presented"))
    events.clear()
    frame(viewer, 0.25)
    assert ("connect", "udp:1") in events
    assert ("set_title", "night.bin - glstar") in events
    assert events[-3:] == ["presented", "end", ("set_full_screen", True)]
    interface.wanted_link = None
    events.clear()
    frame(viewer, 0.25)
    assert [event for event in events if event[0] in {"set_title", "set_full_screen", "connect"}] == []
    interface.wants_full_screen = False
    frame(viewer, 0.25)
    assert events[-1] == ("set_full_screen", False)


def test_a_link_that_the_user_has_given_is_opened_and_closed_with_the_window(
    viewer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []

    class Opened:
        def __init__(self, *what: Any, **keys: Any) -> None:
            opened.append((*what, keys))

        def __enter__(self) -> "Opened":
            return self

        def __exit__(self, *_: object) -> None:
            opened.append("closed")

    monkeypatch.setattr(loop, "Link", Opened)
    viewer._owned = ExitStack()
    viewer.session.config = Config().override(**{"flight.sysid": 3})
    viewer.session.errors_reported = nullcontext
    monkeypatch.setattr(viewer, "follow", lambda link: opened.append(type(link)), raising=False)
    viewer._connect("udpin:127.0.0.1:14550")
    endpoint, options, keys = opened[0]
    assert (endpoint.text, options) == ("udpin:127.0.0.1:14550", viewer.session.config.flight.options)
    assert keys == {"sysid": 3, "retry": True}
    assert opened[1:] == [Opened]
    viewer._owned.close()
    assert opened[2:] == ["closed"]


def test_the_state_of_the_window_is_remembered_when_it_closes(viewer: Any, tmp_path: Path) -> None:
    viewer._memory, viewer._owned = WindowMemory(tmp_path / "memory.json"), ExitStack()
    viewer.session.night, viewer.interface.text_scale = True, 1.3
    viewer.interface.sky = SimpleNamespace(place=Place(-34.9, 138.6, 50.0))
    viewer.close()
    stored = WindowMemory.load(tmp_path / "memory.json")
    assert (stored.night, stored.overlays, stored.text_scale) == (True, frozenset({Overlay.HORIZON}), 1.3)
    assert stored.place == Place(-34.9, 138.6, 50.0)
