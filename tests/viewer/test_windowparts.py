"""Parts of the viewer that need no window: messages, memory, undo, videos, keys and profiles."""

from math import radians
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import map_coordinates
from scipy.stats import norm

from glstar.config import Config, ExposureSection
from glstar.errors import ConfigError
from glstar.viewer.flight.others import _notice
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState
from glstar.viewer.session.actions import _HEAD
from glstar.viewer.session.keys import Action
from glstar.viewer.session.memory import Notifications, Place, SettingsHistory, _degrees, _is_size
from glstar.viewer.session.recording import ScreenVideo, VideoRange
from glstar.viewer.session.state import _is_near
from glstar.viewer.skyobjects import ObjectPlace, Selection
from glstar.viewer.ui.panels.object import _bilinear, _straight_trail


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
    assert [video.utc_s(number) for number in (0, 1, 125)] == pytest.approx([1000.0, 1000.08, 1010.0])
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
