"""The window Calibrate without a window: all that it writes, and what a user's input does."""

from concurrent.futures import Future
from math import radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imgui_bundle import ImVec2

from glstar.errors import ConfigError
from glstar.viewer.picture import fitting
from glstar.viewer.picture.view import ImageView
from glstar.viewer.ui import calibration
from glstar.viewer.ui.panels import compare
from tests.support.scriptedimgui import ScriptedImgui, scripted

UTC_S = 1710068404.678
GREY, RED = calibration._OTHER[0], calibration._RESIDUAL[0]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, calibration, compare)
    drawn.drag = ImVec2(0.0, 0.0)
    drawn.get_mouse_drag_delta = lambda *_: drawn.drag
    drawn.is_popup_open = lambda *_: "popup" in drawn.pressed
    return drawn


# --- the photograph ---


def photo_panel(monkeypatch: pytest.MonkeyPatch) -> calibration.PhotoPanel:
    """Return a panel of 400 x 300 px at (40, 60) with a photograph of 100 x 80 px, magnified 3.75 times."""
    panel = calibration.PhotoPanel(None)
    panel._texture = SimpleNamespace(size=(100, 80), release=lambda: None)
    monkeypatch.setattr(panel, "_picture", lambda size, *, night: 7)
    monkeypatch.setattr(calibration.imgui, "ImTextureRef", lambda name: name, raising=False)
    return panel


def result(**changes: Any) -> fitting.CalibratedPhoto:
    values = {
        "name": ("Vega", "HR 9", "Deneb"),
        "vmag": np.array([3.0, 1.25, 2.0]),
        "xy_px": np.array([[49.5, 39.5], [59.5, 39.5], [49.5, 29.5]]),
        "residual_px": np.array([[0.5, -0.25], [0.0, 0.0], [-1.0, 2.0]]),
        "report": ("f = 560.12 px", "12 stars"),
        "notes": ("few stars",),
        "toml": "[camera]",
        "save": lambda path: [path.with_suffix(".toml"), path],
        "state": None,
    }
    return fitting.CalibratedPhoto(**values | changes)


def test_the_photograph_has_its_stars_and_detections(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = calibration.PhotoPanel(None)
    assert panel.draw(None, [], night=False) is None
    assert drawn.take() == ["(reading ...)"]
    panel = photo_panel(monkeypatch)
    panel.detected_px = np.array([[49.5, 39.5]])
    assert panel.draw(result(), [(59.5, 29.5)], night=False) is None
    assert panel.corner.tolist() == [40.0, 60.0]
    assert drawn.named("add_image") == [[7, (40.0, 60.0), (440.0, 360.0)]]
    assert drawn.named("push_clip_rect") == [[(40.0, 60.0), (440.0, 360.0), True]]
    # The middle of the panel is (240, 210); a detection has a cross of 8 px, a removed one of 14 px.
    lines = drawn.named("add_line")
    assert lines[:2] == [[(236, 206), (244, 214), GREY], [(236, 214), (244, 206), GREY]]
    x, y = 240 + 37.5, 210 - 37.5
    assert lines[2:4] == [[(x - 7, y - 7), (x + 7, y + 7), RED], [(x - 7, y + 7), (x + 7, y - 7), RED]]
    assert [args[:2] for args in drawn.named("add_circle")] == [
        [(240, 210), 7.0], [(277.5, 210), 7.0], [(240, 172.5), 7.0]
    ]  # fmt: skip
    texts = {text: at for at, _, text in drawn.named("add_text")}
    assert texts["Deneb"] == (247.0, 172.5 - 5.0)
    assert list(texts)[:3] == ["HR 9", "Deneb", "Vega"]
    # Of 3.75 px a pixel, 30 px are 8 px: nine of ten residuals are shorter than 2.02 px, so they are drawn 2 times.
    label = "arrows 2 x: from the detected to the predicted position"
    assert texts[label] == (46.0, 64.0)
    shafts = [(low, high) for low, high, *_ in lines[4:6]]
    assert shafts[0] == ((240, 210), pytest.approx((240 - 2 * 0.5 * 3.75, 210 + 2 * 0.25 * 3.75)))
    assert shafts[1] == ((240, 172.5), pytest.approx((240 + 2 * 3.75, 172.5 - 4 * 3.75)))
    assert len(lines) == 4 + 6
    panel.draw(None, [], night=True)
    assert len(drawn.named("add_circle")) == 3


def test_a_click_on_a_star_chooses_it_for_removal(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = photo_panel(monkeypatch)
    drawn.hovered, drawn.pressed = True, {"release 0"}
    found = result()
    for mouse, star in (((286.0, 210.0), 1), ((240.0, 162.4), None), ((240.0, 162.6), 2), ((100.0, 100.0), None)):
        drawn.take()
        drawn.mouse = ImVec2(*mouse)
        expected = None if star is None else tuple(found.xy_px[star].tolist())
        assert panel.draw(found, [], night=False) == expected
        tooltip = [line for line in drawn.lines if line.startswith("? ")]
        about = {1: "? HR 9   V 1.25\nresidual +0.00, +0.00 px", 2: "? Deneb   V 2.00\nresidual -1.00, +2.00 px"}
        assert tooltip == ([] if star is None else [f"{about[star]}\nclick: remove it, and solve again"])
    drawn.mouse = ImVec2(286.0, 210.0)
    for pressed, drag, hovered in (
        (set(), (0, 0), True),
        ({"release 0"}, (3, 0), True),
        ({"release 0"}, (0, 0), False),
        ({"release 0", "double 0"}, (0, 0), True),
    ):
        drawn.pressed, drawn.drag, drawn.hovered = pressed, ImVec2(*drag), hovered
        assert panel.draw(found, [], night=False) is None
    drawn.pressed, drawn.drag, drawn.hovered = {"release 0"}, ImVec2(0, 0), True
    assert panel.draw(None, [], night=False) is None
    none = result(xy_px=np.empty((0, 2)), name=(), vmag=np.empty(0), residual_px=np.zeros((1, 2))[:0])
    monkeypatch.setattr(calibration, "residual_scale", lambda *_: 1.0)
    assert panel.draw(none, [], night=False) is None


def test_the_photograph_is_zoomed_and_moved(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = photo_panel(monkeypatch)
    panel._view = ImageView()
    panel._view.resize(100, 80, 400.0, 300.0)
    drawn.io.mouse_wheel, drawn.io.mouse_delta = 2.0, ImVec2(27.0, -5.4)
    panel._take_mouse(np.array([100.0, 150.0]), hovered=False)
    assert panel._view.zoom == 3.75
    panel._take_mouse(np.array([100.0, 150.0]), hovered=True)
    assert panel._view.zoom == pytest.approx(3.75 * 1.44)
    drawn.io.mouse_wheel = 0.0
    x, y = panel._view.centre_px
    for pressed in ({"active"}, {"drag 0"}):
        drawn.pressed = pressed
        panel._take_mouse(np.zeros(2), hovered=True)
        assert panel._view.centre_px == pytest.approx((x, y))
    drawn.pressed = {"active", "drag 0"}
    panel._take_mouse(np.zeros(2), hovered=True)
    assert panel._view.centre_px == pytest.approx((x - 5, y + 1))
    drawn.pressed = {"double 0"}
    panel._take_mouse(np.zeros(2), hovered=False)
    assert not panel._view.fitted
    panel._take_mouse(np.zeros(2), hovered=True)
    assert panel._view.fitted


# --- the window ---


class Run:
    """A calibration whose end the test decides."""

    def __init__(self, request: fitting.CalibrationRequest, _: object = None) -> None:
        self.request, self.running, self.result, self.error = request, True, None, ""
        self.progress = fitting.CalibrationProgress()
        self.done: list[str] = []

    def cancel(self) -> None:
        self.done.append("cancel")

    def close(self) -> None:
        self.done.append("close")


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(calibration.fitting, "CalibrationRun", Run)
    asked: list[Any] = []
    window = calibration.CalibrateWindow(None, SimpleNamespace(ask=lambda *what: asked.append(what)))
    window.asked = asked
    photo = {
        "detected_px": np.empty((0, 2)),
        "draw": lambda *what, night: asked.append((*what, night)) or window.clicked,
    }
    photo |= {"show": lambda *what: asked.append(("show", *what)), "close": lambda: None}
    window._photo, window.clicked = SimpleNamespace(**photo), None
    yield window
    window.close()


def calibrating(**changes: Any) -> SimpleNamespace:
    said: list[Any] = []
    notify = lambda text, *, is_error=False: said.append((text, is_error))  # noqa: E731 - a double of a method
    return SimpleNamespace(
        **{"config": "config", "night": False, "output": Path("out"), "said": said, "notify": notify} | changes
    )


def test_a_window_that_cannot_calibrate_says_so(window: Any) -> None:
    session = calibrating()
    window.open(session, Path("a.jpg"))
    assert session.said == [("this window cannot calibrate: use glstar view, or glstar camera calibrate", True)]
    assert (window.is_open, window.run) == (False, None)
    window.ask(session)
    window._path = Path("b/a.jpg")
    window.ask(session)
    assert [what[:3] for what in window.asked] == [
        ("open", "Open a photograph of the stars", Path.cwd()),
        ("open", "Open a photograph of the stars", Path("b/a.jpg")),
    ]


def test_the_window_has_the_inputs_progress_and_result(drawn: ScriptedImgui, window: Any) -> None:
    session = calibrating()
    window.draw(session)
    assert drawn.take() == []
    window.calibrate, window.result, window.removed_px = "calibrate", "old", [(1.0, 2.0)]
    window.open(session, Path("b/a.jpg"))
    run = window.run
    request = run.request
    assert (request.path, request.config) == (Path("b/a.jpg"), "config")
    assert (request.fov_rad, request.exposure_s, request.utc, request.site_rad) == (None, None, "", None)
    assert (request.geometry_only, request.before, request.removed_px) == (False, None, ())
    assert (window.result, window.removed_px, window.is_open, window.is_running) == (None, [], True, True)
    run.progress.begin("detecting", 1)
    window.draw(session)
    assert drawn.named("begin_child")[0][:2] == ["##controls", (510.0, 0.0)]
    assert drawn.named("set_next_window_size")[0][0] == (860.0, 540.0)
    inputs = [
        *("--- Photograph off", "(o) camera of the settings off"),
        "? the photograph is of the camera of [camera], perhaps binned or turned by 90 deg",
        *(
            "( ) another one, with a view of off",
            "deg wide: '' or '' off",
            "? width of the view, left to right, to 15 %",
        ),
        *("exposure, s: '' or 'as the file states' off", "? exposure time, s: the brightness depends on it"),
        *("UTC: '' or 'unknown' off", "? time at mid-exposure, ISO 8601; with the site it removes refraction"),
        *("latitude: '' or 'unknown' off", "? deg, north positive", "longitude: '' or 'unknown' off"),
        *("? deg, east positive", "[ ] camera only, no sensor off"),
        *("? for stars that are blurred or saturated; needs no exposure time",),
        *("<Calibrate> off", "<Other photograph> off"),
    ]
    assert drawn.named("progress_bar")[0][1] == (-1.0, 0.0)
    assert drawn.take() == ["=== Calibrate", "a.jpg", *inputs, "25 % detecting", "<Stop>"]
    drawn.answers = {"Stop": True}
    window.draw(session)
    assert run.done == ["cancel"]
    drawn.take()
    # The photograph is shown once when it has been read, its detections as soon as there are some.
    run.progress.pixels, run.progress.white_dn = np.zeros((2, 3), np.uint16), 255
    window.draw(session)
    window.draw(session)
    assert [what[0] for what in window.asked if what[0] == "show"] == ["show"]
    run.progress.detected_px = np.ones((4, 2))
    window.draw(session)
    assert len(window._photo.detected_px) == 4
    run.progress.detected_px = np.empty((0, 2))
    window.draw(session)
    assert len(window._photo.detected_px) == 4
    # A star that is clicked on while it runs is not removed.
    window.clicked = (5.0, 6.0)
    window.draw(session)
    assert window.removed_px == []
    run.running, run.error = False, "no stars"
    window.clicked = None
    drawn.take()
    window.draw(session)
    lines = drawn.take()
    # Now only the width of another camera's view cannot be typed.
    assert lines[2:-1] == [line if line.startswith("deg wide") else line.removesuffix(" off") for line in inputs]
    assert lines[-1] == "no stars [unsaved_marker]"
    run.error, run.result = "", result()
    window.draw(session)
    assert drawn.take()[-10:] == [
        *("<Other photograph>", "--- Result", "f = 560.12 px", "12 stars"),
        *("(click on a star that is wrong to remove it and solve again)", "<Save calibration.toml>"),
        *("? with the list of stars, a report and JSON beside it, as glstar camera calibrate", "<Apply to the camera>"),
        *("? takes [camera], and [sensor] if it was fitted, into the settings; Ctrl+Z takes it back", "few stars"),
    ]
    assert window._first is run.result
    # Removing a star solves again with the first result.
    first, window.clicked = run.result, (5.0, 6.0)
    window.draw(session)
    assert (window.removed_px, window.run.request.before, window.run.request.removed_px) == (
        [(5.0, 6.0)], first, ((5.0, 6.0),)
    )  # fmt: skip
    window.clicked = None
    window.run.running, window.run.result = False, result(report=("again",))
    window.draw(session)
    drawn.take()
    window.draw(session)
    lines = drawn.take()
    assert lines[lines.index("again") + 2 :][:2] == ["1 removed", "<Use all again>"]
    assert window._first is first
    drawn.answers = {"Use all again": True}
    window.draw(session)
    assert (window.removed_px, window.result, window.run) == ([], first, None)
    window.removed_px = [(5.0, 6.0)]
    drawn.answers = {"Calibrate": True, "Use all again": False, "camera only, no sensor": True}
    window.draw(session)
    assert (window.removed_px, window.result, window._first, window.run.request.geometry_only) == ([], None, None, True)


def test_typed_inputs_are_of_the_request_or_refused(drawn: ScriptedImgui, window: Any) -> None:
    session = calibrating()
    window.calibrate, window._path, window.is_open = "calibrate", Path("a.jpg"), True
    typed = {"deg wide": "62.5", "exposure, s": "0.25", "UTC": " 2024-03-10T11:00:00Z ", "latitude": "-34.9"}
    drawn.answers = {**typed, "longitude": "138.6", "another one, with a view of": True, "Calibrate": True}
    window.draw(session)
    request = window.run.request
    assert request.fov_rad == pytest.approx(radians(62.5))
    assert (request.exposure_s, request.utc) == (0.25, "2024-03-10T11:00:00Z")
    assert request.site_rad == pytest.approx((radians(-34.9), radians(138.6)))
    refused = "give the width of the view: 1 to 300 deg, left to right, right to 15 %"
    for changes, message in (
        ({"fov": ""}, refused),
        ({"fov": "0.99"}, refused),
        ({"fov": "300.1"}, refused),
        ({"exposure": " x "}, "exposure is no number: 'x'"),
        ({"latitude": ""}, "latitude and longitude belong together"),
        ({"longitude": ""}, "latitude and longitude belong together"),
    ):
        before, window.run = dict(window._typed), None
        window._typed |= changes
        window._start(session)
        assert (session.said.pop(), window.run) == ((message, True), None)
        window._typed = before
    window._typed |= {"fov": "1", "latitude": " ", "longitude": ""}
    window._start(session)
    assert (window.run.request.fov_rad, window.run.request.site_rad) == (pytest.approx(radians(1)), None)
    window._typed["fov"] = "300"
    window._start(session)
    assert window.run.request.fov_rad == pytest.approx(radians(300))
    drawn.answers = {"camera of the settings": True}
    window._draw_inputs()
    window._start(session)
    assert window.run.request.fov_rad is None


def test_the_window_closes_and_stops(drawn: ScriptedImgui, window: Any) -> None:
    session = calibrating()
    window.calibrate = "calibrate"
    for answers, pressed, is_open in (
        ({"Calibrate": None}, {"escape", "popup"}, True),
        ({}, {"escape"}, False),
        ({}, set(), True),
    ):
        window.open(session, Path("a.jpg"))
        drawn.answers, drawn.pressed = answers, pressed
        window.draw(session)
        assert (window.is_open, window.run.done) == (is_open, [] if is_open else ["cancel"])
    drawn.begin = lambda *_: (False, False)
    window.draw(session)
    assert not window.is_open
    run = window.run
    window.close_run()
    assert (run.done, window.run) == (["cancel", "close"], None)


def test_a_calibration_is_saved_and_applied(drawn: ScriptedImgui, window: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    session = calibrating(used=[])
    session.use = session.used.append
    monkeypatch.setattr(calibration.fitting, "with_calibration", lambda *what: what)
    drawn.answers = {"Apply to the camera": True, "Save calibration.toml": True}
    window._draw_result(session, result())
    assert session.used == [("config", "[camera]")]
    assert session.said.pop() == ("the settings have the calibration; Ctrl+Z takes it back", False)
    assert window.asked[-1][:3] == ("save", "Save the calibration", Path("out/calibration.toml"))

    def refuse(_: object) -> None:
        raise ConfigError("camera.fx_px: is negative")

    session.use = refuse
    calibration._apply(session, result())
    assert session.said.pop() == ("camera.fx_px: is negative", True)
    window._report_saved(session)
    window._saving = Future()
    window._report_saved(session)
    assert (session.said, window.is_running) == ([], True)
    window._saving.set_result([Path("a.toml"), Path("b"), Path("c")])
    window._report_saved(session)
    assert session.said.pop() == ("a.toml and 2 files beside it", False)
    window._saving = Future()
    window._saving.set_exception(OSError("disk full"))
    window._report_saved(session)
    assert (session.said.pop(), window.is_running) == (("disk full", True), False)


def test_the_photograph_is_drawn_again_when_something_has_changed(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[Any] = []
    monkeypatch.setattr(calibration.Picture, "of", lambda *what, scale, night: (what[3], scale, night))
    panel = calibration.PhotoPanel(None)
    panel._texture = SimpleNamespace(size=(100, 80), release=lambda: pictures.append("released"))
    panel._display = SimpleNamespace(draw=lambda picture: pictures.append(picture) or len(pictures), close=lambda: None)
    drawn.io.display_framebuffer_scale = ImVec2(2.0, 2.0)
    assert [panel._picture((400, 300), night=False) for _ in range(2)] == [1, 1]
    assert panel._picture((400, 300), night=True) == 2
    panel._view.one_to_one()
    panel._view.pan(3.0, 0.0)
    assert panel._picture((400, 301), night=True) == 3
    assert pictures == [((800, 600), 2.0, False), ((800, 600), 2.0, True), ((800, 602), 2.0, True)]
    panel.close()
    panel.close()
    assert pictures[3:] == ["released"]


def test_a_result_is_taken_when_its_run_has_ended(drawn: ScriptedImgui, window: Any) -> None:
    window.calibrate, before = "calibrate", result()
    window.open(calibrating(), Path("a.jpg"))
    window.result, window.run.result = before, result()
    window._take()
    assert window.result is before
    window.run.running, window.run.result = False, None
    window._take()
    assert window.result is before
    window.run.result = after = result()
    window._take()
    assert window.result is after
    assert drawn.lines == []
