"""The timeline and its buttons, without a display: pixels, and the effects of mouse and keys."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import moderngl
import numpy as np
import pytest
from imgui_bundle import imgui, implot
from numpy.typing import NDArray

from glstar.config import Config, ExposureSection
from glstar.flight import DATA_GAP, AttitudeTrack, Flight, Gap
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.system.resources import asset
from glstar.telemetry import ScriptedFlight
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.ui.panels.playback import PlaybackControls
from glstar.viewer.ui.panels.timeline import Timeline

WIDTH, HEIGHT = 1000, 360
ADELAIDE = Site(np.deg2rad(-34.93), np.deg2rad(138.60), 50.0)
FIRST_UTC_S = 1710068400.0
LEFT, MIDDLE, RIGHT = 0, 2, 1
# Colours of the palette: red, green, blue.
YELLOW, RED, VIOLET = (255, 217, 77), (255, 0, 0), (230, 128, 255)

Pixels = NDArray[np.uint8]


class Screen:
    """A screen without a display: frames of imgui on an EGL context, and a mouse and a keyboard."""

    def __init__(self, context: moderngl.Context, draw: Callable[[], None]) -> None:
        self._draw = draw
        self._context = context
        self._texture = context.texture((WIDTH, HEIGHT), 4)
        self._target = context.framebuffer([self._texture])
        imgui.create_context()
        implot.create_context()
        self.io = imgui.get_io()
        self.io.set_ini_filename("")
        self.io.display_size = imgui.ImVec2(WIDTH, HEIGHT)
        self.io.delta_time = 1 / 60
        imgui.backends.opengl3_init("#version 330")

    def frames(self, n: int = 1) -> None:
        for _ in range(n):
            imgui.backends.opengl3_new_frame()
            imgui.new_frame()
            imgui.set_next_window_pos((0, 0))
            imgui.set_next_window_size((WIDTH, HEIGHT))
            imgui.begin("time", None, int(imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_move))
            self._draw()
            imgui.end()
            imgui.render()
            self._target.use()
            self._target.clear()
            imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())

    def pixels(self) -> Pixels:
        """Return the last frame, (height, width, 3)."""
        self._context.finish()
        return np.frombuffer(self._target.read(components=3), np.uint8).reshape(HEIGHT, WIDTH, 3)[::-1]

    def move(self, x_px: float, y_px: float) -> None:
        self.io.add_mouse_pos_event(x_px, y_px)
        self.frames(2)

    def button(self, which: int, *, down: bool) -> None:
        self.io.add_mouse_button_event(which, down)
        self.frames(2)

    def click(self, x_px: float, y_px: float) -> None:
        self.drag(LEFT, (x_px, y_px), (x_px, y_px))

    def drag(self, which: int, start: tuple[float, float], stop: tuple[float, float]) -> None:
        # After a pause, so that two clicks are not a double click.
        self.frames(25)
        self.move(*start)
        self.button(which, down=True)
        self.move(*stop)
        self.button(which, down=False)

    def wheel(self, notches: float) -> None:
        self.io.add_mouse_wheel_event(0, notches)
        self.frames(2)

    def type(self, text: str) -> None:
        self.io.add_input_characters_utf8(text)
        self.frames(2)
        for down in (True, False):
            self.io.add_key_event(imgui.Key.enter, down)
            self.frames(1)
        self.frames(2)

    def close(self) -> None:
        imgui.backends.opengl3_shutdown()
        implot.destroy_context()
        imgui.destroy_context()
        self._target.release()
        self._texture.release()


class Played:
    """A flight, its play head, and both panels on a screen."""

    def __init__(self, context: moderngl.Context, flight: Flight) -> None:
        self.night = False
        self.screen = Screen(context, self.draw)
        self.open(flight)

    def open(self, flight: Flight) -> None:
        self.head = PlayHead(flight.attitude.first_s, flight.attitude.last_s, ExposureSection())
        self.timeline, self.transport = Timeline(flight), PlaybackControls()
        # Imgui lays out what it has not seen before in two frames.
        self.screen.frames(3)

    def draw(self) -> None:
        self.transport.draw(self.head)
        self.timeline.draw(self.head, night=self.night)

    def column_of(self, colour: tuple[int, int, int]) -> float:
        """Return the middle of the columns that show a colour over much of their height, px."""
        seen = (np.abs(self.screen.pixels().astype(int) - colour).max(axis=-1) < 60).sum(axis=0) > HEIGHT / 4
        assert seen.any()
        return float(np.flatnonzero(seen).mean())

    def px_of(self, second: float) -> float:
        """Return the column of a time, found by drawing the play head there."""
        was_s = self.head.utc_s
        self.head.seek(self.head.first_s + second)
        follows, self.timeline.follow = self.timeline.follow, False
        self.screen.frames(2)
        column = self.column_of(RED if self.night else YELLOW)
        self.head.seek(was_s)
        self.screen.frames(2)
        self.timeline.follow = follows
        return column


# In the upper plot.
Y_PX = 140.0


@pytest.fixture
def play(context: moderngl.Context) -> Iterator[Callable[[Flight], Played]]:
    opened: list[Played] = []

    def open_(flight: Flight) -> Played:
        opened.append(Played(context, flight))
        return opened[-1]

    yield open_
    for played in opened:
        played.screen.close()


@pytest.fixture
def adelaide() -> Flight:
    return Config().open_flight(asset("adelaide.BIN"))


@pytest.fixture
def turning() -> Flight:
    """A hundred seconds of a level turn that passes south every 36 s."""
    return ScriptedFlight.steady(ADELAIDE, FIRST_UTC_S, duration_s=100.0, yaw_rate_rad_per_s=np.deg2rad(10.0)).flight()


@pytest.mark.parametrize("camera", list(Mode))
def test_a_click_and_a_drag_move_the_play_head_of_the_bundled_flight(
    play: Callable[[Flight], Played], adelaide: Flight, camera: Mode
) -> None:
    played = play(adelaide)
    played.head.mode = camera
    at_30, at_60 = played.px_of(30.0), played.px_of(60.0)
    second_px = (at_60 - at_30) / 30

    played.screen.click(at_60, Y_PX)
    assert played.head.second == pytest.approx(60.0, abs=1.5 / second_px)
    played.screen.drag(LEFT, (at_60, Y_PX), (at_30, Y_PX))
    assert played.head.second == pytest.approx(30.0, abs=1.5 / second_px)

    # After the button is released the mouse moves nothing; beyond the ends the head stays at the ends.
    played.screen.move(at_60, Y_PX)
    assert played.head.second == pytest.approx(30.0, abs=1.5 / second_px)
    played.screen.drag(LEFT, (at_60, Y_PX), (-500.0, Y_PX))
    assert played.head.utc_s == played.head.first_s


def test_a_drag_in_the_lower_plot_moves_the_play_head(play: Callable[[Flight], Played], adelaide: Flight) -> None:
    played = play(adelaide)
    at_60 = played.px_of(60.0)
    played.screen.click(at_60, HEIGHT - 80.0)

    assert played.head.second == pytest.approx(60.0, abs=0.5)


def test_the_wheel_zooms_where_the_mouse_is_and_a_double_click_shows_all(
    play: Callable[[Flight], Played], adelaide: Flight
) -> None:
    played = play(adelaide)
    played.timeline.follow = False
    at_60 = played.px_of(60.0)
    whole_s = played.timeline.axis.span_s
    played.screen.move(at_60, Y_PX)
    played.screen.wheel(4.0)

    assert played.timeline.axis.span_s == pytest.approx(whole_s / 1.25**4)
    assert played.px_of(60.0) == pytest.approx(at_60, abs=2.0)
    played.screen.wheel(-2.0)
    assert played.timeline.axis.span_s == pytest.approx(whole_s / 1.25**2)

    for down in (True, False, True, False):
        played.screen.io.add_mouse_button_event(LEFT, down)
        played.screen.frames(1)
    assert played.timeline.axis.span_s == pytest.approx(whole_s)


@pytest.mark.parametrize("which", [RIGHT, MIDDLE])
def test_the_other_buttons_pan(play: Callable[[Flight], Played], adelaide: Flight, which: int) -> None:
    played = play(adelaide)
    played.timeline.follow = False
    played.screen.move(500.0, Y_PX)
    played.screen.wheel(6.0)
    before = played.timeline.axis.start_s
    at_60, at_65 = played.px_of(60.0), played.px_of(65.0)
    played.screen.drag(which, (at_65, Y_PX), (at_60, Y_PX))

    assert played.timeline.axis.start_s - before == pytest.approx(5.0, abs=0.1)
    assert played.head.second == 0.0


def test_a_typed_time_is_used_and_a_wrong_one_refused_with_a_message(
    play: Callable[[Flight], Played], adelaide: Flight
) -> None:
    played = play(adelaide)
    # The time field is the first of the second row.
    box = (60.0, 42.0)
    played.screen.click(*box)
    assert played.screen.io.want_text_input
    played.screen.type("1:02.5")
    assert played.head.second == pytest.approx(62.5, abs=1e-6)
    assert not played.screen.io.want_text_input

    blank = played.screen.pixels()
    played.screen.click(*box)
    played.screen.type("noon")
    assert played.head.second == pytest.approx(62.5, abs=1e-6)
    assert played.transport.error is not None
    assert played.transport.error.startswith("'noon' is not a time; write seconds from the start (12.5)")
    assert (played.screen.pixels() != blank).any()

    played.screen.click(*box)
    played.screen.type("10")
    assert (played.transport.error, played.head.second) == (None, pytest.approx(10.0, abs=1e-6))


def test_every_button_performs_its_action(play: Callable[[Flight], Played], adelaide: Flight) -> None:
    played = play(adelaide)
    head, screen = played.head, played.screen
    y_px = 18.0
    buttons = {"first": 18.0, "back": 48.0, "play": 98.0, "on": 147.0, "last": 177.0, "reverse": 224.0}
    screen.click(buttons["last"], y_px)
    assert head.utc_s == head.last_s
    screen.click(buttons["first"], y_px)
    assert head.utc_s == head.first_s
    screen.click(buttons["on"], y_px)
    screen.click(buttons["on"], y_px)
    assert head.number == 2
    screen.click(buttons["back"], y_px)
    assert head.number == 1
    screen.click(buttons["reverse"], y_px)
    assert head.speed == -1.0
    screen.click(buttons["play"], y_px)
    assert head.playing
    screen.click(buttons["play"], y_px)
    assert not head.playing


def test_the_axis_follows_a_playing_play_head(play: Callable[[Flight], Played], turning: Flight) -> None:
    played = play(turning)
    axis = played.timeline.axis
    axis.zoom(0.0, 0.1)
    played.head.toggle()
    for _ in range(120):
        played.head.advance(0.5)
        played.screen.frames(1)
        assert axis.start_s <= played.head.second <= axis.stop_s


def test_a_line_that_wraps_at_180_degrees_does_not_cross_the_plot(
    play: Callable[[Flight], Played], turning: Flight
) -> None:
    played = play(turning)
    played.timeline.follow = False
    # At 18 s the turn passes south, away from the play head.
    column = round(played.px_of(18.0))
    blue = np.abs(played.screen.pixels().astype(int) - (115, 166, 255)).max(axis=-1) < 60
    upper = blue[: HEIGHT // 2, column - 3 : column + 4]

    assert blue[: HEIGHT // 2].any()
    # The steep line takes a few rows of a column; a line across the plot would take all of them.
    assert upper.sum(axis=0).max() < 15


def with_a_gap(flight: Flight, start_s: float, stop_s: float) -> Flight:
    track = flight.attitude
    second = track.utc_s - track.first_s
    kept = (second <= start_s) | (second >= stop_s)
    utc_s = track.utc_s[kept]
    gap = Gap(float(utc_s[second[kept] <= start_s][-1]), float(utc_s[second[kept] >= stop_s][0]), DATA_GAP)
    return replace(flight, attitude=AttitudeTrack(utc_s, track.q_body_ned[kept], (gap,)))


def test_a_gap_is_shaded_and_an_exposure_that_touches_it_is_red(
    play: Callable[[Flight], Played], turning: Flight
) -> None:
    played = play(with_a_gap(turning, 40.0, 50.0))
    played.head.mode, played.head.exposure_section = Mode.SLIDING, ExposureSection(duration_s=6.0)
    columns = {second: round(played.px_of(second)) for second in (17.0, 38.0, 48.0, 60.0)}

    def shade(second: float, head_s: float) -> NDArray[np.float64]:
        """Return the colour of the background at a time: red, green, blue."""
        played.head.seek(FIRST_UTC_S + head_s)
        played.screen.frames(2)
        pixels = played.screen.pixels()[100:160, columns[second] - 2 : columns[second] + 3]
        return np.median(pixels.astype(float), axis=(0, 1))

    plain, gap = shade(60.0, 20.0), shade(48.0, 20.0)
    assert gap[0] - gap[1] > plain[0] - plain[1] + 20
    # Yellow is red and green.
    valid, broken = shade(17.0, 20.0), shade(38.0, 41.0)
    assert min(valid[0], valid[1]) - valid[2] > 20
    assert broken[0] - broken[1] > 60


def test_markers_are_lines(play: Callable[[Flight], Played], turning: Flight) -> None:
    played = play(turning)
    at_30 = played.px_of(30.0)
    played.head.seek(FIRST_UTC_S + 30.0)
    played.head.add_marker()
    played.head.first()
    played.screen.frames(2)

    assert played.column_of(VIOLET) == pytest.approx(at_30, abs=2.0)


def test_at_night_the_plots_are_red(play: Callable[[Flight], Played], turning: Flight) -> None:
    played = play(turning)
    played.night = True
    played.screen.frames(2)
    plots = played.screen.pixels().astype(int)[90:, :]
    coloured = plots.max(axis=-1) - plots.min(axis=-1) > 60

    assert coloured.any()
    assert (plots[coloured][:, 0] > plots[coloured][:, 1:].max(axis=-1)).all()


def test_a_flight_of_a_hundred_thousand_samples_costs_no_more_than_a_short_one(
    play: Callable[[Flight], Played], turning: Flight
) -> None:
    # The cost of a frame is its vertices; a hundred times as many samples must not multiply them.
    played = play(turning)

    def vertices(samples: int) -> int:
        utc_s = FIRST_UTC_S + np.linspace(0.0, 100.0, samples)
        q = quaternion_from_euler(0.3 * np.sin(np.arange(samples)), 0.0, 0.0)
        played.open(replace(turning, attitude=AttitudeTrack(utc_s, q)))
        return imgui.get_draw_data().total_vtx_count

    assert vertices(100_000) < 3 * vertices(1_000)


def test_a_panel_too_short_for_two_plots_shows_one(play: Callable[[Flight], Played], turning: Flight) -> None:
    played = play(turning)
    tall = imgui.get_draw_data().total_vtx_count
    timeline, head = played.timeline, played.head

    def low() -> None:
        imgui.begin_child("low", (0, 150))
        timeline.draw(head)
        imgui.end_child()

    played.screen._draw = low
    played.screen.frames(3)

    assert 0 < imgui.get_draw_data().total_vtx_count < tall
