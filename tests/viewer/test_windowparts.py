"""Parts of the viewer that need no window: messages, memory, undo, videos, keys and profiles."""

from math import radians
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from imgui_bundle import ImVec2
from scipy.integrate import quad
from scipy.ndimage import map_coordinates
from scipy.stats import norm

from glstar.config import Config, ExposureSection
from glstar.errors import ConfigError
from glstar.flight import EventKind
from glstar.viewer import loop
from glstar.viewer.flight.others import _notice
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.flight.traces import TimeAxis
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState
from glstar.viewer.session import state
from glstar.viewer.session.actions import _HEAD
from glstar.viewer.session.keys import Action
from glstar.viewer.session.memory import Notifications, Place, SettingsHistory, _degrees, _is_size
from glstar.viewer.session.recording import ScreenVideo, VideoRange
from glstar.viewer.session.state import _is_near
from glstar.viewer.skyobjects import ObjectKind, ObjectPlace, Selection, SkyObject
from glstar.viewer.ui import search as searching
from glstar.viewer.ui.panels import timeline
from glstar.viewer.ui.panels.object import _bilinear, _straight_trail
from glstar.viewer.ui.panels.timeline import TimelineEvents
from glstar.viewer.ui.theme import resized_text
from glstar.viewer.window import text_scale


class Clock:
    now_s = 1000.25

    def __call__(self) -> float:
        return self.now_s


def test_messages_expire_and_errors_stay_longer() -> None:
    clock = Clock()
    shown = Notifications(clock)
    shown.add("saved")
    shown.add("no log", is_error=True)
    clock.now_s += 5.9
    assert [one.message for one in shown.current] == ["saved", "no log"]
    clock.now_s += 0.2
    assert [one.message for one in shown.current] == ["no log"]
    clock.now_s += 13.8
    assert shown.errors == ["no log"]
    clock.now_s += 0.2
    assert shown.current == []


def test_at_most_four_messages_are_shown_and_a_repeated_one_once() -> None:
    shown = Notifications(Clock())
    for message in ("a", "b", "c", "b", "d", "e"):
        shown.add(message, is_error=message == "d")
    assert [one.message for one in shown.current] == ["c", "b", "d", "e"]
    assert shown.errors == ["d"]
    shown.dismiss(shown.current[1])
    assert [one.message for one in shown.current] == ["c", "d", "e"]


def test_two_hundred_changes_can_be_undone_and_a_drag_is_one_of_them() -> None:
    history = SettingsHistory()
    configs = [Config().override(**{"exposure.duration_s": 0.1 + 0.01 * k}) for k in range(205)]
    for config in configs:
        history.observe(config, is_dragging=False)
    undone = [history.undo() for _ in range(201)]
    assert undone == [*configs[-2:-202:-1], None]
    assert [history.redo(), history.redo()] == configs[5:7]
    # Of a drag the settings before it are kept; what had been undone is gone.
    history.observe(configs[20], is_dragging=True)
    history.observe(configs[30], is_dragging=True)
    history.observe(configs[30], is_dragging=False)
    assert history.redo() is None
    assert history.undo() is configs[6]


@pytest.mark.parametrize(
    ("stored", "is_valid"),
    [
        ([90, 180, 100_000], True),
        ([-90, -180, -100_000], True),
        ([90.001, 0, 0], False),
        ([0, 180.001, 0], False),
        ([0, 0, 100_001], False),
        ([0, 0], False),
        ([0, 0, "high"], False),
        ("0, 0, 0", False),
    ],
)
def test_a_stored_place_is_on_the_earth(stored: object, is_valid: bool) -> None:
    place = Place.stored(stored)
    assert (place is not None) == is_valid
    if place is not None:
        assert [place.latitude_deg, place.longitude_deg, place.height_m] == stored


def test_angles_of_the_table_of_time_zones_have_degrees_minutes_and_seconds() -> None:
    """As zone.tab has those of Adelaide, New York and Honolulu."""
    assert [_degrees(text) for text in ("-3455", "+13835")] == pytest.approx([-(34 + 55 / 60), 138 + 35 / 60])
    assert [_degrees(text) for text in ("+404251", "-0740023")] == pytest.approx(
        [40 + 42 / 60 + 51 / 3600, -(74 + 23 / 3600)]
    )


def test_the_size_of_a_window_is_two_whole_numbers() -> None:
    assert _is_size([900, 600])
    for wrong in ([900], [900, 600, 3], [900, 6.5], [1, 600], [900, 10**6], "900x600", None):
        assert not _is_size(wrong)


@pytest.mark.parametrize(
    ("values", "is_valid"),
    [
        ({"speed": 1e-3}, True),
        ({"speed": 0.99e-3}, False),
        ({"speed": 1e3}, True),
        ({"speed": 1001.0}, False),
        ({"frames_per_s": 1.0}, True),
        ({"frames_per_s": 0.99}, False),
        ({"frames_per_s": 240.0}, True),
        ({"frames_per_s": 241.0}, False),
        ({"speed": np.nan}, False),
        ({"stop_utc_s": 1000.0}, False),
    ],
)
def test_a_video_has_a_speed_and_a_rate_within_limits(values: dict[str, float], is_valid: bool) -> None:
    keys = {"start_utc_s": 1000.0, "stop_utc_s": 1010.0} | values
    if is_valid:
        VideoRange(**keys)
    else:
        with pytest.raises(ConfigError):
            VideoRange(**keys)


def test_the_frames_of_a_video_are_evenly_spaced_and_include_both_ends() -> None:
    video = VideoRange(1000.0, 1010.0, speed=2.0, frames_per_s=25.0)
    # Five seconds of video.
    assert video.count == 126
    assert [video.utc_s(number) for number in (0, 1, 125)] == pytest.approx([1000.0, 1000.08, 1010.0], rel=0, abs=1e-9)
    assert VideoRange(0.0, 0.01).count == 1


def test_a_video_of_the_screen_repeats_pictures_by_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, written = Clock(), []
    video = ScreenVideo(Path("none.mp4"), 30.0, clock)
    monkeypatch.setattr(video, "_write", lambda _, times: written.append(times))
    picture = np.zeros((2, 2, 3), np.uint8)
    for step_s in (0.0, 0.02, 0.02, 0.1, 0.001, 20.0, 0.04):
        clock.now_s += step_s
        video.add(picture)
    # Frames are due at 0, 1/30 s ...; of a window that stalls for 20 s one picture is repeated 300 times at most.
    assert written == [1, 1, 3, 300, 1]
    assert video.progress == (0.0, "20 s recorded")


def test_blinking_begins_with_the_image_as_it_is() -> None:
    clock = Clock()
    state = ComparisonState(clock)
    state.blink_period_s = 2.0
    state.mode = ComparisonMode.WIPE
    state.toggle_noise()
    assert (state.mode, state.is_blinking, state.phase, state.is_noiseless) == (ComparisonMode.OFF, True, 0.0, False)
    clock.now_s += 0.99
    assert not state.is_noiseless
    clock.now_s += 0.01
    assert (state.phase, state.is_noiseless) == (0.5, True)
    clock.now_s += 1.25
    assert (state.phase, state.is_noiseless) == (0.125, False)
    state.toggle(ComparisonMode.BLINK)
    assert (state.phase, state.blinks_noise, state.active) == (0.0, False, False)
    state.close()


def test_another_image_is_near_if_the_same_sensor_exposed_it_as_long_half_a_second_before() -> None:
    sensor = object()

    def scene(start_utc_s: float, duration_s: float = 0.1, own: object = sensor) -> SimpleNamespace:
        return SimpleNamespace(sensor=own, exposure=SimpleNamespace(start_utc_s=start_utc_s, duration_s=duration_s))

    first = scene(100.0)
    assert [_is_near(first, scene(utc_s)) for utc_s in (100.49, 99.51, 100.5, 99.5)] == [True, True, False, False]
    assert not _is_near(first, scene(100.0, 0.2))
    assert not _is_near(first, scene(100.0, own=object()))


def test_keys_move_the_play_head_by_their_steps() -> None:
    def moved_s(action: Action) -> float:
        head = PlayHead(1000.0, 1060.0, ExposureSection(duration_s=0.5, interval_s=3.0))
        head.seek(1030.5)
        _HEAD[action](head)
        return head.second - 30.5

    steps = {Action.SECOND_BACK: -1, Action.SECOND_ON: 1, Action.TEN_BACK: -10, Action.TEN_ON: 10}
    # Exposures end at 30.5 s and 3 s before and after; sub-exposures are 5 ms.
    steps |= {Action.EXPOSURE_BACK: -3, Action.EXPOSURE_ON: 3, Action.SUB_BACK: -0.005, Action.SUB_ON: 0.005}
    steps |= {Action.FIRST: -30.5, Action.LAST: 29.5}
    assert {action: moved_s(action) for action in steps} == pytest.approx(steps, abs=1e-6)
    head = PlayHead(1000.0, 1060.0, ExposureSection())
    assert (head.mode, head.loop) == (Mode.CAMERA, False)
    _HEAD[Action.MODE](head)
    _HEAD[Action.LOOP](head)
    assert (head.mode, head.loop) == (Mode.SLIDING, True)
    _HEAD[Action.MODE](head)
    _HEAD[Action.LOOP](head)
    assert (head.mode, head.loop) == (Mode.CAMERA, False)


@pytest.mark.parametrize(
    ("first_s", "last_s", "text"),
    [
        (150.0, 250.0, "other.csv beside the flight"),
        (200.0, 250.0, "other.csv beside the flight"),
        (230.0, 250.0, "other.csv is 30 s after the flight shown"),
        (10.0, 60.0, "other.csv is 40 s before the flight shown"),
        (10.0, 100.0, "other.csv beside the flight"),
    ],
)
def test_a_log_of_another_time_is_said_to_be_before_or_after(first_s: float, last_s: float, text: str) -> None:
    def flight(first_s: float, last_s: float) -> SimpleNamespace:
        return SimpleNamespace(attitude=SimpleNamespace(first_s=first_s, last_s=last_s))

    assert _notice(Path("logs/other.csv"), flight(first_s, last_s), flight(100.0, 200.0)).startswith(text)


def place(**changes: float) -> ObjectPlace:
    values = {"altitude_rad": 0.5, "azimuth_rad": 0.0, "x_px": 12.34, "y_px": 5.0, "on_image": False}
    return ObjectPlace(**values | {"right": 0.6, "down": -0.8, "from_axis_rad": radians(50.0)} | changes)


def test_a_message_says_where_an_object_is() -> None:
    assert place().message("Vega") == "Vega is outside the image, 30.0 deg to the right and 40.0 deg above"
    assert place(right=-0.6, down=0.8).message("Vega").endswith("30.0 deg to the left and 40.0 deg below")
    # A side of less than 0.05 deg is left out.
    assert place(right=1.0, down=0.0009).message("Vega").endswith("image, 50.0 deg to the right")
    assert place(right=1.0, down=0.0011).message("Vega").endswith("and 0.1 deg below")
    assert place(on_image=True).message("Vega") == "Vega is in the image at x 12.3, y 5.0"
    assert place(altitude_rad=radians(-2.5), on_image=True).message("Vega") == "Vega is 2.5 deg below the horizon"


def test_of_more_than_four_pinned_objects_the_oldest_is_dropped() -> None:
    selection = Selection()
    for name in "abcde":
        selection.pin(name)
    assert selection.pinned == [*"bcde"]
    selection.pin("c")
    assert selection.pinned == [*"bde"]


@pytest.mark.parametrize(("trail_px", "sigma_px"), [(0.0, 1.2), (3.0, 1.2), (25.0, 0.8)])
def test_a_straight_trail_is_a_gaussian_that_moves_evenly(trail_px: float, sigma_px: float) -> None:
    middle_px, across = np.array([9.3, 7.6]), np.array([-0.28, 0.96])
    along = np.array([across[1], -across[0]])
    found = _straight_trail((16, 20), middle_px, across, trail_px, sigma_px)
    for row, column in ((7, 9), (8, 10), (6, 12), (9, 3), (8, 18), (12, 9)):
        off_px = np.array([column, row]) - middle_px

        def at(s: float, off_px: np.ndarray = off_px) -> float:
            x, y = off_px - s * trail_px * along
            return float(norm.pdf(x, scale=sigma_px) * norm.pdf(y, scale=sigma_px))

        expected = quad(at, -0.5, 0.5, limit=200)[0]
        assert found[row, column] == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_an_image_is_interpolated_between_its_pixels_and_unknown_beyond_them() -> None:
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0, 9, (5, 7))
    inside = rng.uniform([0, 0], [6, 4], (50, 2))
    expected = map_coordinates(pixels, inside.T[::-1], order=1)
    np.testing.assert_allclose(_bilinear(pixels, inside), expected, rtol=0, atol=1e-12)
    beyond = np.array([[-0.01, 2.0], [2.0, -0.01], [6.0, 2.0], [2.0, 4.0]])
    assert np.isnan(_bilinear(pixels, beyond)).all()
    assert np.isfinite(_bilinear(pixels, np.array([[0.0, 0.0], [5.99, 3.99]]))).all()


def test_the_frame_rate_is_that_between_the_ends_of_frames() -> None:
    clock = Clock()
    times = FrameTimes(clock, clock)
    rates = []
    for _ in range(3):
        times.begin()
        clock.now_s += 0.25
        times.end()
        rates.append(times.frames_per_s)
    assert rates == [0.0, 4.0, 4.0]


class Events:
    """Keys of imgui as a test presses them, for windows that search; text is not drawn."""

    def __init__(self) -> None:
        self.pressed: set[str] = set()
        self.typed: str | None = None
        self.listed: list[tuple[str, bool]] = []
        self.clicked = ""
        self.notes: list[str] = []
        self.Key = SimpleNamespace(
            down_arrow="down", up_arrow="up", enter="enter", keypad_enter="keypad", escape="escape"
        )
        self.Cond_ = SimpleNamespace(appearing=1)

    def get_main_viewport(self) -> SimpleNamespace:
        return SimpleNamespace(pos=SimpleNamespace(x=10.0, y=20.0), size=SimpleNamespace(x=900.0, y=600.0))

    def set_next_window_pos(self, at: ImVec2, _: int, pivot: ImVec2) -> None:
        self.place = at.x, at.y, pivot.x, pivot.y

    def begin(self, *_: object) -> tuple[bool, bool]:
        return True, self.clicked != "close"

    def input_text_with_hint(self, _: str, __: str, query: str) -> tuple[bool, str]:
        return (False, query) if self.typed is None else (True, self.typed)

    def is_key_pressed(self, key: str, _: bool = True) -> bool:
        return key in self.pressed

    def selectable(self, label: str, is_chosen: bool) -> tuple[bool, bool]:
        name = label.partition("##")[0]
        self.listed.append((name, is_chosen))
        return name == self.clicked, is_chosen

    def text_disabled(self, text: str) -> None:
        self.notes.append(text)

    def set_next_item_width(self, _: float) -> None:
        pass

    def set_keyboard_focus_here(self) -> None:
        pass

    def end(self) -> None:
        pass


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> Events:
    events = Events()
    monkeypatch.setattr(searching, "imgui", events)
    monkeypatch.setattr(searching, "scaled_across", lambda px: px)
    return events


def shown(window: searching.SearchWindow[str], events: Events, *keys: str, typed: str | None = None) -> str | None:
    """Draw a frame of the window with keys pressed."""
    events.pressed, events.typed = set(keys), typed
    events.listed, events.notes = [], []
    return window.draw(lambda query: [f"{query}{k}" for k in range(3)] if query != "x" else [], str.upper)


def test_keys_choose_a_match_and_take_it(events: Events) -> None:
    window = searching.SearchWindow[str]("Find", "a name", "nothing")
    assert shown(window, events, "enter") is None
    assert events.listed == []
    window.open(["p", "q"])
    assert shown(window, events) is None
    assert events.listed == [("P", True), ("Q", False)]
    # In the middle of the window, 60 px from its top.
    assert events.place == (10 + 450, 20 + 60, 0.5, 0.0)
    shown(window, events, typed="a")
    assert events.listed == [("A0", True), ("A1", False), ("A2", False)]
    for key, chosen in (("down", "A1"), ("down", "A2"), ("down", "A0"), ("up", "A2"), ("up", "A1")):
        shown(window, events, key)
        assert [name for name, is_chosen in events.listed if is_chosen] == [chosen]
    # Another query begins at its best match again.
    shown(window, events, typed="b")
    assert events.listed[0] == ("B0", True)
    shown(window, events, "down")
    assert shown(window, events, "enter") == "b1"
    # It has closed; when it is opened again it is empty.
    assert shown(window, events, "enter") is None
    window.open()
    assert shown(window, events, "enter") is None
    assert (events.listed, events.notes) == ([], [])
    shown(window, events, typed="x")
    assert events.notes == ["nothing"]
    shown(window, events, typed="c")
    assert shown(window, events, "keypad") == "c0"


@pytest.mark.parametrize("how", ["escape", "close"])
def test_a_search_is_closed_without_a_result(events: Events, how: str) -> None:
    window = searching.SearchWindow[str]("Find", "a name", "nothing")
    window.open(["p"])
    events.clicked = how if how == "close" else ""
    assert shown(window, events, *([] if how == "close" else ["escape"])) is None
    events.clicked = ""
    assert shown(window, events, "enter") is None
    window.open(["p", "q"])
    events.clicked = "Q"
    assert shown(window, events) == "q"


def test_lines_of_the_search_have_magnitudes_of_stars_and_kinds_of_others() -> None:
    star = SkyObject(ObjectKind.STAR, "Sirius", star_id=2491, vmag=-1.456)
    assert searching._object_line(star).endswith("   V -1.46")
    planet = SkyObject(ObjectKind.CONSTELLATION, "Orion")
    assert searching._object_line(planet).endswith(f"   {ObjectKind.CONSTELLATION.value}")


def timeline_events(*messages_s: float) -> TimelineEvents:
    """Return a mode from 10 s and from 20 s on, messages, and triggers at 30 and 31 s."""
    kinds = [EventKind.MODE, EventKind.MODE, *[EventKind.MESSAGE] * len(messages_s)]
    texts = ["AUTO", "LOITER", *(f"at {second:g}" for second in messages_s)]
    events = SimpleNamespace(
        utc_s=np.array([1010.0, 1020.0, *(1000 + s for s in messages_s)]), kinds=kinds, texts=texts
    )
    triggers = SimpleNamespace(source="CAM", camera="camera 1", utc_s=np.array([1030.0, 1031.0]))
    return TimelineEvents(SimpleNamespace(events=events, triggers=(triggers,)), 1000.0)


def test_events_are_near_within_six_pixels() -> None:
    found, axis = timeline_events(15.0), TimeAxis(100.0)
    axis.start_s, axis.stop_s = 0.0, 100.0
    assert found.count == 5
    # A pixel is 0.1 s.
    near = {second: found.near(second, 1000.0, axis) for second in (9.9, 10.0, 15.59, 15.61, 14.41, 29.5, 30.5)}
    assert near == {
        9.9: [],
        10.0: ["mode AUTO"],
        15.59: ["mode AUTO", "at 15"],
        15.61: ["mode AUTO"],
        14.41: ["mode AUTO", "at 15"],
        29.5: ["mode LOITER", "CAM 1: 30.000 s"],
        30.5: ["mode LOITER", "CAM 1: 30.000 s", "CAM 2: 31.000 s"],
    }
    # Six lines at most, and how many more there are.
    many = timeline_events(*([15.0] * 5)).near(15.0, 1000.0, axis)
    assert many == ["mode AUTO", *["at 15"] * 5]
    many = timeline_events(*([15.0] * 7)).near(15.0, 1000.0, axis)
    assert many == ["mode AUTO", *["at 15"] * 5, "and 2 more"]


def test_day_and_twilight_of_a_live_flight_are_computed_ten_minutes_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def intervals(_: object, first_s: float, last_s: float) -> dict[str, np.ndarray]:
        asked.append((first_s, last_s))
        return {"day": np.array([[first_s + 1, first_s + 2]])}

    monkeypatch.setattr(timeline, "light_intervals", intervals)
    for grows, expected in ((True, [700.0, 1301.0]), (False, [100.0, 101.0, 700.0, 701.0])):
        asked.clear()
        panel = SimpleNamespace(_lit_until_s=-np.inf, grows=grows, _position=None, _origin_s=50.0, _light={})
        for last_s in (100.0, 101.0, 700.0, 701.0):
            assert list(timeline.Timeline._light_until(panel, last_s)) == ["day"]
        assert asked == [(50.0, last_s) for last_s in expected]


@pytest.mark.parametrize("is_live", [False, True])
def test_a_frame_waits_for_a_sixtieth_of_a_second_and_live_for_the_next_attitude(
    is_live: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept, waited = [], []
    monkeypatch.setattr(loop.time, "perf_counter", lambda: 50.0)
    monkeypatch.setattr(loop.time, "sleep", slept.append)
    link = SimpleNamespace(
        latest=lambda: SimpleNamespace(utc_s=1000.0), wait_for=lambda utc_s, most_s: waited.append((utc_s, most_s))
    )
    session = SimpleNamespace(head=SimpleNamespace(live=is_live), live=SimpleNamespace(link=link))
    for began_s in (49.99, 49.98):
        loop.Viewer.pace(SimpleNamespace(session=session), began_s)
    # 16.7 ms after the frame began, and 10 ms have passed; after 20 ms it is late.
    assert slept == [pytest.approx(1 / 60 - 0.01, abs=1e-9)]
    # Just after the latest attitude, for 33 ms at most.
    after = [(pytest.approx(1000.000001, rel=0, abs=1e-7), pytest.approx(1 / 30))] * 2
    assert waited == (after if is_live else [])
    loop.Viewer.pace(SimpleNamespace(session=SimpleNamespace(head=None, live=session.live)), 49.98)
    loop.Viewer.pace(SimpleNamespace(session=SimpleNamespace(head=session.head, live=None)), 49.98)
    assert len(waited) == (2 if is_live else 0)


def test_the_text_of_a_window_grows_in_tenths_and_with_the_units_of_the_screen() -> None:
    assert [resized_text(scale, steps) for scale, steps in ((1.0, 1), (1.0, -1), (0.7, -1), (2.5, 1), (1.26, 0))] == [
        *(1.1, 0.9, 0.7, 2.5, 1.3)
    ]
    # Two pixels a unit at a content scale of 2, as on macOS, and one pixel a unit, as on Windows.
    assert [text_scale(2.0, 1800, 900), text_scale(2.0, 900, 900), text_scale(1.5, 0, 900)] == [1.0, 2.0, 1.5]


@pytest.mark.parametrize("has_latest", [True, False])
@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize(("playing", "live"), [(True, True), (True, False), (False, False)])
def test_a_live_image_that_is_drawn_is_timed_and_a_flight_that_plays_may_show_the_last_one(
    playing: bool, live: bool, drawn: bool, has_latest: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    timed, asked, advanced = [], [], []
    monkeypatch.setattr(state, "_exposure_to_show", lambda *_: (object(), 3))
    monkeypatch.setattr(state, "_follow_image", lambda _: None)
    monkeypatch.setattr(state, "Shot", lambda *_, **__: SimpleNamespace(exposure=None, simulator=None))
    head = SimpleNamespace(playing=playing, live=live, advance=advanced.append)
    session = SimpleNamespace(
        _poll=lambda: None,
        _poll_link=lambda _: None,
        _measure=lambda: None,
        _exposed=lambda shot: shot,
        _shows_link=False,
        _latest="attitude" if has_latest else None,
        live=SimpleNamespace(drew=lambda *what: timed.append(what)),
        loaded=SimpleNamespace(head=head, simulator=None),
        is_looking=False,
        comparison=SimpleNamespace(is_noiseless=False),
        config=Config(),
        scene="scene",
        image=SimpleNamespace(update=lambda _, playing: (asked.append(playing), drawn)[1]),
    )
    state.Session.update(session, 0.25)
    assert advanced == [0.25]
    # The image of the exposure before may be shown while a log plays, not while a link is live.
    assert asked == [playing and not live]
    is_timed = drawn and live and has_latest
    assert timed == ([("attitude", "scene", Config().exposure.duration_s)] if is_timed else [])
