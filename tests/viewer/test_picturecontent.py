"""What the image panel shows and how, work on images on threads of its own, and the times of frames, without OpenGL."""

from concurrent.futures import Future
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.errors import RenderError
from glstar.images import FittedImage
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.picture import content, fitting
from glstar.viewer.picture.comparison import LESS_RGB, MORE_RGB, ComparisonMode, ComparisonState, _written
from glstar.viewer.picture.content import PanelContent, PanelPicture, Picture, WindowPlace
from glstar.viewer.picture.simulated import SimulatedImage
from glstar.viewer.picture.view import ColourMap, ImageView, Stretch, StretchKind
from tests.support.viewerdoubles import Clock

REAL = FittedImage(np.zeros((80, 100), np.uint8), 3, 4, 95, 71)


class Image(SimulatedImage):
    """A simulated image of 100 x 80 px."""

    def __init__(self, texture: Any = "texture", processed: Any = "processed") -> None:
        self.made = texture, processed

    texture = property(lambda self: self.made[0])
    processed = property(lambda self: self.made[1])
    size = property(lambda _: (100, 80))


@pytest.mark.parametrize(
    ("mode", "phase", "number", "width_px"),
    [
        (ComparisonMode.OFF, 0.7, 0, 100),
        (ComparisonMode.BLINK, 0.49, 0, 100),
        (ComparisonMode.BLINK, 0.5, 1, 100),
        (ComparisonMode.BLINK, 1.25, 0, 100),
        (ComparisonMode.WIPE, 0.7, 2, 100),
        (ComparisonMode.DIFFERENCE, 0.7, 3, 100),
        (ComparisonMode.SIDE_BY_SIDE, 0.7, 4, 200),
    ],
)
def test_each_mode_has_its_number_in_the_shader(mode: ComparisonMode, phase: float, number: int, width_px: int) -> None:
    shown = PanelContent(Image(), 255, REAL, mode, 0.25, phase, 0.125, 3.0)
    assert (shown.mode, shown.size_px) == (number, (width_px, 80))
    compared = content._compared(shown)
    if number == 0:
        assert compared is None
    else:
        assert (compared.pixels is REAL.pixels, compared.white_dn, compared.covered_px) == (True, 255, (3, 4, 95, 71))
        assert (compared.mode, compared.wipe, compared.black, compared.gain) == (number, 0.25, 0.125, 3.0)
        assert (compared.more_rgb, compared.less_rgb) == (MORE_RGB, LESS_RGB)
    alone = PanelContent(Image(), 255, None, mode, phase=phase)
    assert (alone.mode, alone.size_px, content._compared(alone)) == (0, (100, 80), None)


def test_the_content_is_of_the_scene_and_the_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = [""]
    monkeypatch.setattr(content, "why_not_processed", lambda _: reason[0])
    scene = SimpleNamespace(white_dn=1023, camera=SimpleNamespace(width_px=100, height_px=80))
    state = ComparisonState(lambda: 50.25)
    state.mode, state.wipe, state.real_black, state.real_gain = ComparisonMode.WIPE, 0.25, 0.125, 3.0
    state._blinks_from_s = 50.0
    image = Image()
    shown = PanelContent.of(image, scene, REAL, state, is_processed=True)
    assert (shown.image, shown.white_dn, shown.real, shown.comparison) == (image, 1023, REAL, ComparisonMode.WIPE)
    assert (shown.wipe, shown.phase, shown.real_black, shown.real_gain, shown.is_processed) == (
        0.25,
        0.25,
        0.125,
        3.0,
        False,
    )
    assert PanelContent.of(image, scene, None, state, is_processed=True).is_processed
    assert not PanelContent.of(image, scene, None, state).is_processed
    reason[0] = "raw"
    assert not PanelContent.of(image, scene, None, state, is_processed=True).is_processed
    # While an image is decoded, its half of the picture is empty; without images there is one half.
    state.mode, state.images = ComparisonMode.SIDE_BY_SIDE, None
    assert PanelContent.of(image, scene, None, state).real is None
    state.images = [1]
    blank = PanelContent.of(image, scene, None, state).real
    assert (blank.pixels.shape, blank.left, blank.top, blank.right, blank.bottom) == ((80, 100), 0, 0, 0, 0)
    assert not blank.pixels.any()
    state.mode = ComparisonMode.WIPE
    assert PanelContent.of(image, scene, None, state).real is None
    state.images = None
    state.close()


def test_a_picture_may_be_processed_or_not_there_any_more() -> None:
    for shown, picture in (
        (PanelContent(Image(), 255, is_processed=True), "processed"),
        (PanelContent(Image(), 255), "texture"),
        (PanelContent(Image(processed=None), 255, is_processed=True), "texture"),
        (PanelContent("plain", 255, is_processed=True), "plain"),
    ):
        assert (shown.picture, shown.is_there) == (picture, True)
    assert not PanelContent(Image(None), 255).is_there


def test_a_picture_is_placed_and_coloured_as_the_view_shows_it() -> None:
    view = ImageView()
    view.resize(100, 80, 400.0, 300.0)
    stretch = Stretch(StretchKind.ASINH, 5.0, 0.125, ColourMap.INFERNO)
    made = Picture.of(PanelContent(Image(), 255), view, stretch, (800, 600), scale=2.0, night=False)
    # 375 x 300 screen px in the middle of 400 x 300, at two px a unit.
    assert made.placement.size == (800, 600)
    assert made.placement.scissor == (25, 0, 750, 600)
    assert made.placement.corner_px == pytest.approx((-12.5 / 3.75, 0.0))
    assert made.placement.image_px_per_screen_px == pytest.approx(1 / 7.5)
    assert (made.tone.black, made.tone.boost, made.tone.softening) == (0.125, 5.0, 8.0)
    np.testing.assert_array_equal(made.tone.colours, ColourMap.INFERNO.colours)
    for colours, night in ((ColourMap.INFERNO, True), (ColourMap.GREY, False)):
        plain = Stretch(StretchKind.LINEAR, colours=colours)
        made = Picture.of(PanelContent(Image(), 255), view, plain, (0, 0), scale=1.0, night=night)
        assert (made.tone.colours, made.tone.softening, made.placement.size) == (None, 0.0, (1, 1))
    view.zoom_at(view.middle, 4.0)
    view.centre_px = np.array([0.0, 79.0])
    # The picture begins half a pixel of 15 px left of the middle, and ends so below it.
    assert content._covered(view, (100, 80), (400, 300), 1.0) == (192, 0, 208, 158)
    view.centre_px = np.array([-100.0, 0.0])
    assert content._covered(view, (100, 80), (400, 300), 1.0)[2] == 0


class Shown:
    """The display; notes what it draws."""

    def __init__(self) -> None:
        self.done: list[Any] = []

    def texture(self, size: tuple[int, int]) -> int:
        return sum(size)

    def draw(self, picture: Any) -> None:
        self.done.append(("texture", picture.name))

    def draw_onto(self, part: Any, picture: Any) -> None:
        self.done.append(("window", picture.name, part.corner_px if hasattr(part, "corner_px") else part))

    def read(self) -> str:
        return "pixels"


def test_a_picture_that_changes_twice_is_drawn_onto_the_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "WindowPart", lambda *what: SimpleNamespace(corner_px=what[2]))
    display, is_there = Shown(), SimpleNamespace(is_there=True)
    panel = PanelPicture(display)
    place = WindowPlace((3, 4), (5, 6, 7, 8))

    def frame(name: str, where: WindowPlace | None = place) -> list[Any]:
        """Return the texture of a frame, whether it is new, and what is drawn."""
        display.done = []
        picture = SimpleNamespace(name=name, content=is_there, placement=SimpleNamespace(size=(30, 20)))
        texture, is_new = panel.show(picture, (name,), where), panel.is_new
        panel.paint("target", (900, 600), (0.0, 0.0, 0.0))
        assert not panel.is_new
        panel.paint("target", (900, 600), (0.0, 0.0, 0.0))
        return [texture, is_new, *display.done]

    panel.paint("target", (900, 600), (0.0, 0.0, 0.0))
    assert (display.done, panel.is_new) == ([], False)
    assert frame("a") == [50, True, ("texture", "a")]
    assert frame("b") == [None, True, ("window", "b", (3, 4))]
    assert frame("c", None) == [50, True, ("texture", "c")]
    assert frame("d") == [None, True, ("window", "d", (3, 4))]
    assert frame("d") == [50, True, ("texture", "d")]
    assert frame("d") == [50, False]
    assert frame("e") == [50, True, ("texture", "e")]
    is_there.is_there = False
    assert frame("f") == [None, True]
    assert panel.read() == "pixels"
    assert display.done == [("texture", "f")]
    panel.read()
    assert len(display.done) == 1


# --- work on threads ---


def request(**changes: Any) -> fitting.ResidualRequest:
    values = {"simulator": SIMULATOR, "ahead_s": 1.25, "image": "a", "exposure": 0.5, "reference": "end"}
    return fitting.ResidualRequest(**{**values, "own_length": True} | changes)


SIMULATOR = object()


def test_residuals_are_measured_once_for_each_request() -> None:
    assert request().is_like(request())
    assert not request().is_like(None)
    others = [{"simulator": object()}, {"ahead_s": 1.5}, {"image": "b"}, {"exposure": 1.0}, {"reference": "start"}]
    for changes in (*others, {"own_length": False}):
        assert not request().is_like(request(**changes))
    watch, measured = fitting.ResidualWatch(), []
    assert (watch.of(request()), watch.is_running) == (None, False)

    def measure(asked: fitting.ResidualRequest) -> str:
        measured.append(asked.image)
        if asked.image == "broken":
            raise RenderError("no trail")
        return f"of {asked.image}"

    watch.measure = measure
    for image, answer in (("a", "of a"), ("broken", "no trail"), ("b", "of b")):
        assert watch.of(request(image=image)) is None
        assert watch.is_running
        watch._running[1].exception()
        assert [watch.of(request(image=image)) for _ in range(2)] == [answer] * 2
        assert not watch.is_running
    assert measured == ["a", "broken", "b"]
    # One at a time: another request waits for the one that is measured.
    watch._running = request(image="c"), Future()
    assert watch.of(request(image="d")) is None
    assert len(measured) == 3
    watch._running[1].set_exception(OSError("gone"))
    assert watch.of(request(image="c")) == "gone"
    watch.close()


def test_a_fit_counts_its_images_and_can_be_stopped() -> None:
    goes_on, counted = Event(), Event()

    def fit(asked: str, count: Any) -> str:
        count(3, 12)
        counted.set()
        goes_on.wait(10)
        count(4, 12)
        return asked

    for cancels, result in ((False, "asked"), (True, None)):
        goes_on.clear()
        counted.clear()
        run = fitting.ImageFit("asked", fit)
        assert counted.wait(10)
        assert (run.done, run.of, run.running) == (3, 12, True)
        if cancels:
            run.cancel()
        goes_on.set()
        run._thread.join(10)
        assert (run.done, run.result, run.error, run.running) == (4, result, "", False)

    def fail(*_: object) -> None:
        raise OSError("disk full")

    run = fitting.ImageFit("asked", fail)
    run.close()
    assert run._cancelled.is_set()
    assert (run.result, run.error) == (None, "disk full")
    progress = fitting.CalibrationProgress()
    assert (progress.pixels, progress.detected_px.shape, progress.step, progress.done) == (None, (0, 2), "", 0)
    progress.begin("reading", 2)
    assert (progress.step, progress.done) == ("reading", 2)
    progress.cancelled.set()
    with pytest.raises(fitting._CancelledError):
        progress.begin("solving", 3)
    assert progress.done == 2


# --- comparisons ---


class Images(list):
    folder, is_decoding, closed = Path("f"), False, False

    def close(self) -> None:
        self.closed = True

    def collect(self) -> None:
        self.collected = True

    def nearest(self, utc_s: float) -> Any:
        return min(self, key=lambda image: abs(image.time.utc_s - utc_s), default=None)

    def fitted(self, image: Any, width_px: int, height_px: int) -> Any:
        pixels = np.full((height_px, width_px), 9, np.uint16)
        return FittedImage(pixels, 0, 0, width_px, height_px) if image.fitted else None


def image(utc_s: float, name: str = "a", *, fitted: bool = True) -> SimpleNamespace:
    return SimpleNamespace(time=SimpleNamespace(utc_s=utc_s), name=name, fitted=fitted)


def test_the_nearest_image_is_compared_or_the_preferred_of_the_same_time() -> None:
    state = ComparisonState(lambda: 50.0)
    first, second, same = image(100.0), image(103.0), image(103.0, "b")
    state.images = Images([first, second, same])
    camera = SimpleNamespace(width_px=4, height_px=3)
    assert state.image_at(100.0) is None
    assert (state.waiting, state.is_blinking) == (False, False)
    state.toggle(ComparisonMode.WIPE)
    state.flight_offset_s, state.offset_s = 2.0, 0.5
    assert (state.image_at(98.9), state.image_at(99.1)) == (first, second)
    state.preferred = same
    assert (state.image_at(98.9), state.image_at(99.1)) == (first, same)
    state.images.remove(same)
    assert state.image_at(99.1) is second
    state.images.clear()
    assert (state.image_at(99.1), state.active) == (None, False)
    state.images.append(second)
    found, pixels = state.decoded_at(99.1, camera, 1023)
    assert (found, pixels.white_dn, pixels.pixels.shape) == (second, 1023, (3, 4))
    second.fitted = False
    assert state.decoded_at(99.1, camera, 1023) is None
    state.images.is_decoding = True
    assert state.waiting
    state.images.is_decoding = False
    state.fit = SimpleNamespace(running=True, close=lambda: None)
    assert state.waiting
    state.fit.running = False
    assert not state.waiting
    state._opening = Path("g"), Future()
    assert (state.waiting, state.opening) == (True, Path("g"))
    state.poll()
    assert state.images.collected
    # The folder that has been opened replaces the one before, and keeps a mode that is on.
    before, opened = state.images, Images([first])
    state._opening[1].set_result(opened)
    state.poll()
    assert (state.images, before.closed, state.mode, state.opening, state.fit) == (
        *(opened, True, ComparisonMode.WIPE, None, None),
    )
    state._opening = Path("h"), Future()
    state._opening[1].set_exception(OSError("gone"))
    state.poll()
    assert (state.images, state.error) == (opened, "gone")
    state.toggle(ComparisonMode.BLINK)
    assert state.is_blinking
    state.images.clear()
    assert not state.is_blinking
    state.toggle_noise()
    assert (state.is_blinking, state.mode) == (True, ComparisonMode.OFF)
    # A folder that is opened too late is closed.
    late, future = Images(), Future()
    state._opening = Path("i"), future
    state.close()
    future.set_result(late)
    assert (late.closed, opened.closed) == (True, True)


def test_a_caption_is_grey_and_wraps_nothing() -> None:
    written = _written("simulated: 2024\nreal", 320)
    assert (written.dtype, written.shape[1], written.shape[2]) == (np.uint8, 320, 3)
    # Grey: the same red, green and blue, at most 220.
    assert (written == written[..., :1]).all()
    assert written.max() == 220
    lines = written.max(axis=(1, 2)) > 100
    assert np.count_nonzero(np.diff(lines.astype(int)) == 1) >= 2


# --- times ---


def test_the_times_of_frames_are_reported_without_the_first() -> None:
    clock, work = Clock(), Clock()
    times = FrameTimes(clock, work)
    times.recording = True
    # Of each frame: its time, that of drawing and its own work, that of the simulation, and whether the image is new.
    for frame_s, drawing_s, work_s, simulation_s, is_new in (
        *((9.0, 1.0, 5.0, 3.0, True), (0.04, 0.01, 0.03, 0.005, True), (0.02, 0.006, 0.012, 0.001, False)),
        (0.06, 0.02, 0.05, 0.002, True),
    ):
        times.begin()
        with times.span("drawing"):
            clock.now_s += drawing_s
            work.now_s += 0.001
        with times.span("simulation"):
            work.now_s += simulation_s
        if is_new:
            times.new_image()
        work.now_s += work_s
        clock.now_s += frame_s - drawing_s
        times.end()
    report = times.report()
    assert (report["frames"], report["seconds"], report["frames_per_s"]) == (3, 0.12, 25.0)
    assert (report["images"], report["images_per_s"]) == (2, 16.67)
    assert report["frame_ms"] == {"median": 40.0, "p95": 58.0}
    assert report["drawing_ms"] == {"median": 10.0, "p95": 19.0}
    assert report["simulation_ms"] == {"median": 2.0, "p95": 4.7}
    assert report["presenting_ms"] == {"median": 0.0, "p95": 0.0}
    assert report["python_ms"] == {"median": 30.0, "p95": 48.0}
    assert times.frames_per_s == pytest.approx(3 / 0.12)
    times.pause()
    assert times.frames_per_s == 0.0
    empty = FrameTimes(clock, work).report()
    assert (empty["frames"], empty["frames_per_s"], empty["images_per_s"], empty["frame_ms"]["median"]) == (
        0,
        0.0,
        0.0,
        0.0,
    )
    single = FrameTimes(clock, work)
    single.recording = True
    single.begin()
    clock.now_s += 0.5
    single.end()
    assert single.report()["frames"] == 1
    assert single.frames_per_s == 0.0
