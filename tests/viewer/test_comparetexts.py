"""The panel Compare without a window: all that it writes, and what a user's input does."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.images.times import TimeReference
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture import fitting
from glstar.viewer.picture.comparison import ComparisonMode, ComparisonState
from glstar.viewer.ui.panels import compare
from tests.support.scriptedimgui import ScriptedImgui, scripted

UTC_S = 1710068404.678


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    return scripted(monkeypatch, compare)


def fitted(**changes: Any) -> fitting.FitResult:
    values: dict[str, Any] = {"clock_change_s": 0.5, "clock_std_s": 0.00123, "images": 12, "of": 17, "stars": 345}
    values |= {"mount_keys": {"mount.yaw_deg": 12.3456, "mount.roll_deg": -1.5}}
    values |= {
        "turn_rad": tuple(np.deg2rad([0.1, -0.2, 0.3])),
        "turn_std_rad": tuple(np.deg2rad([0.004, 0.006, 0.005])),
    }
    values |= {"centroid_mean_px": 0.456, "centroid_median_px": 0.321, "notes": ("one clock",)}
    return fitting.FitResult(**values | changes)


def test_a_fit_is_reported_and_applied(drawn: ScriptedImgui) -> None:
    lines = [
        *("camera clock - log clock -0.7500 s, to 0.0012 s", "mount yaw 12.346, roll -1.500 deg"),
        *("turned by +0.100, -0.200, +0.300 deg, to 0.006 deg", "12 of 17 images, 345 stars"),
        *("distance of centroids: mean 0.46 px, median 0.32 px", "one clock"),
    ]
    assert compare.fit_report(fitted(), -1.25) == lines
    assert compare.fit_report(fitted(clock_change_s=None, mount_keys={}), -1.25) == lines[3:]
    changed: list[Any] = []
    comparison = SimpleNamespace(images=[1], fit_images="fit", fit=None, ahead_s=-1.25, offset_s=0.125)
    session = SimpleNamespace(comparison=comparison, loaded="flight", change=lambda **keys: changed.append(keys))
    panel = compare.FitPanel()
    about = (
        *("[x] camera clock", "? fits camera clock - log clock, as glstar compare --fit-time-offset", "[x] mount"),
        "? fits yaw, pitch and roll of the camera on the aircraft, as glstar compare --fit-mount",
    )
    moves = "? moves star trails onto those of up to 48 images; nothing changes until Apply"
    panel.draw(session)
    assert drawn.take() == ["--- Fit to the images", *about, "<Fit>", moves]
    comparison.fit = SimpleNamespace(running=True, done=3, of=12, cancel=lambda: changed.append("cancel"))
    drawn.answers = {"Stop fitting": True}
    panel.draw(session)
    assert (drawn.take(), changed.pop()) == (
        ["--- Fit to the images", "25 % 3 of 12 images", "<Stop fitting>"],
        "cancel",
    )
    comparison.fit.of = 0
    panel.draw(session)
    assert drawn.take()[1] == "0 % 3 of 0 images"
    comparison.fit = SimpleNamespace(running=False, error="no stars", result=None)
    panel.draw(session)
    assert drawn.take()[-2:] == [moves, "no stars [unsaved_marker]"]
    comparison.fit = SimpleNamespace(running=False, error="", result=fitted())
    panel.draw(session)
    applies = ["<Apply>", "? takes the clock and the mount; Ctrl+Z takes back the mount", "<Discard>"]
    assert drawn.take()[7:] == [*lines, *applies]
    drawn.answers = {"Apply": True}
    panel.draw(session)
    assert (comparison.offset_s, comparison.fit) == (0.625, None)
    assert changed == [{"mount.yaw_deg": 12.3456, "mount.roll_deg": -1.5}]
    comparison.fit = SimpleNamespace(running=False, error="", result=fitted(clock_change_s=None, mount_keys={}))
    panel.draw(session)
    assert (comparison.offset_s, comparison.fit, len(changed)) == (0.625, None, 1)
    comparison.fit = SimpleNamespace(running=False, error="", result=fitted())
    drawn.take()
    drawn.answers = {"Discard": True}
    panel.draw(session)
    assert (comparison.offset_s, comparison.fit, len(changed)) == (0.625, None, 1)
    # With nothing to fit there is no fit; without images, a flight or a function that fits there is no panel.
    drawn.take()
    drawn.answers = {"camera clock": True}
    panel.draw(session)
    assert "<Fit>" in drawn.take()
    drawn.answers = {"mount": True}
    panel.draw(session)
    assert "<Fit> off" in drawn.take()
    for change in ({"images": None}, {"fit_images": None}):
        panel.draw(SimpleNamespace(comparison=SimpleNamespace(**vars(comparison) | change), loaded="flight"))
    panel.draw(SimpleNamespace(comparison=comparison, loaded=None))
    assert drawn.take() == []


def test_residuals_have_their_switch_and_figures(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[Any] = []
    monkeypatch.setattr(compare, "residuals_of", lambda _: answers[0])
    watch = SimpleNamespace(measure="measure", is_running=False)
    session = SimpleNamespace(
        comparison=SimpleNamespace(images=[1], residuals=watch), shown_overlays={Overlay.RESIDUALS}
    )
    about = "? measures each trail of the real image against the simulated one, as glstar compare"
    head = ["--- Residuals", "[x] arrows and figures", about]
    found = fitting.TrailResiduals(np.zeros((3, 2)), np.zeros((3, 2)), 7, (("mean", "0.5 px"), ("SSIM", "0.9")))
    for answer, running, lines in (
        (found, False, ["(3 of 7 trails found; simulated minus real)", "(mean)", "0.5 px", "(SSIM)", "0.9"]),
        ("no trail", True, ["no trail [unsaved_marker]"]),
        (None, True, ["(measuring ...)"]),
        (None, False, []),
    ):
        answers[:], watch.is_running = [answer], running
        compare.draw_residual_figures(session)
        assert drawn.take() == [*head, *lines]
    drawn.answers = {"arrows and figures": True}
    compare.draw_residual_figures(session)
    assert session.shown_overlays == set()
    drawn.take()
    compare.draw_residual_figures(session)
    assert drawn.take()[1] == "[ ] arrows and figures"
    watch.measure = None
    compare.draw_residual_figures(session)
    session.comparison.images, watch.measure = None, "measure"
    compare.draw_residual_figures(session)
    assert drawn.take() == []


class Images(list):
    """Real images, of which some files are not usable."""

    time_sources, problems = "times by names", ("a.txt: is no image",)


def test_the_panel_lists_its_images_and_their_figures(drawn: ScriptedImgui) -> None:
    images = Images(
        SimpleNamespace(
            path=Path(f"f/{name}.png"), time=SimpleNamespace(utc_s=UTC_S + s, source="name", exposure_s=length)
        )
        for name, s, length in (("a", 0.0, None), ("b", 3.0, 0.25), ("c", 66.0, None))
    )
    clipper = {"display_start": 1, "display_end": 3, "steps": iter((True, False)), "begin": lambda _: None}
    drawn.ListClipper = lambda: SimpleNamespace(**clipper, step=lambda: next(clipper["steps"]))
    state = ComparisonState(lambda: 50.0)
    state.images, state.mode, state.wipe, state.offset_s = images, ComparisonMode.WIPE, 0.25, 1.5
    state.flight_offset_s, state.real_gain = -0.25, 2.0
    panel = compare.ComparisonPanel(state)
    note = SimpleNamespace(note="scaled by 0.5")
    asked = panel.draw(UTC_S + 2.5, images[1], note, status="outside")
    assert asked == compare.PanelRequests()
    lines = drawn.take()
    references = "|".join(TimeReference)
    assert lines == [
        *("##folder: '' or 'folder of real images, or drop it here'", "<Open>", "times by names"),
        *("( ) off", "( ) blink", "(o) wipe", "( ) difference", "( ) side by side", "line: 0.250 from 0 to 1"),
        *("*    -0.750 s  b.png", "-   +62.250 s  c.png", "<< image>", "<image >>", "(2 of 3)"),
        *("b.png: 2024-03-10T11:00:07.678Z by name, 0.25 s long", "(0.750 s before the play head)", "scaled by 0.5"),
        *("outside [unsaved_marker]", "--- Camera clock - log clock", "s: 1.500 by 0.01, 1", "<0>"),
        *("##fine: +1.500 s from -5 to 5", "([flight] time_offset_s = 1.25)"),
        *(f"of exposure: {state.time_reference} of {references}",),
        *("? the instant of its exposure to which a real image's time stamp refers", "[x] simulate its exposure time"),
        *("--- Real image", "black: 0.0000 of white from 0 to 0.5", "gain: x 2.00 from 0.0625 to 256 log"),
        *("<Save this view>", "> 1 file not usable", "a.txt: is no image [unsaved_marker]"),
    ]
    state.images = None
    state.close()


def list_of(drawn: ScriptedImgui, *rows: int) -> Images:
    """Return three images, of which some rows are in view."""

    def clipper() -> SimpleNamespace:
        steps = iter((True, False))
        return SimpleNamespace(
            display_start=rows[0], display_end=rows[1], begin=lambda _: None, step=lambda: next(steps)
        )

    drawn.ListClipper = clipper
    return Images(
        SimpleNamespace(path=Path(f"{name}.png"), time=SimpleNamespace(utc_s=UTC_S + s, source="name", exposure_s=None))
        for name, s in (("a", 0.0), ("b", 3.0), ("c", 6.0))
    )


def test_an_image_is_chosen_in_the_list_or_beside_the_one_shown(drawn: ScriptedImgui) -> None:
    state = ComparisonState(lambda: 50.0)
    state.images, panel = list_of(drawn, 0, 3), compare.ComparisonPanel(state)
    drawn.set_scroll_from_pos_y = lambda y: drawn.calls.append(("scroll", y))
    # Three rows of 16 px and the padding of 7 px above and below; the list scrolls to another image, once.
    assert panel._draw_images(state.images, state.images[2], UTC_S) is None
    assert drawn.named("begin_child")[0][1] == (0.0, 3 * 16 + 14.0)
    assert drawn.named("scroll") == [[60 + 2.5 * 16]]
    panel._draw_images(state.images, state.images[2], UTC_S)
    assert len(drawn.named("scroll")) == 1
    drawn.take()
    assert panel._draw_images(state.images, None, UTC_S) is None
    assert drawn.named("scroll") == []
    lines = drawn.take()
    assert [line[0] for line in lines[:3]] == ["-"] * 3
    assert lines[-1] == "(3 images)"
    for shown, label, chosen in ((2, "image >", 0), (2, "< image", 1), (0, "< image", 2), (None, "image >", 1)):
        drawn.answers = {label: True}
        image = None if shown is None else state.images[shown]
        assert panel._draw_images(state.images, image, UTC_S) == UTC_S + 3.0 * chosen
        assert state.preferred is state.images[chosen]
        drawn.take()
    drawn.answers = {f"{'+3.000 s':>11}  b.png": True}
    assert panel._draw_images(state.images, None, UTC_S) == UTC_S + 3.0
    state.images = Images([*state.images, *state.images, *state.images])
    drawn.take()
    panel._draw_images(state.images, None, UTC_S)
    assert drawn.named("begin_child")[0][1] == (0.0, 6 * 16 + 14.0)
    state.images = None
    state.close()


def test_each_mode_has_its_controls_in_as_many_lines_as_it_needs(drawn: ScriptedImgui) -> None:
    state = ComparisonState(lambda: 50.0)
    panel = compare.ComparisonPanel(state)
    modes = {
        "wipe": ["line: 0.500 from 0 to 1"],
        "blink": ["period: 1.0 s from 0.2 to 5"],
        "off": [],
        "side by side": [],
    }
    modes["difference"] = ["real is brighter", "fainter"]
    for mode in ComparisonMode:
        state.mode = mode
        panel._draw_mode()
        lines = drawn.take()
        assert [line for line in lines[:5] if line.startswith("(o)")] == [f"(o) {mode}"]
        assert [line.partition(" [")[0] for line in lines[5:]] == modes[mode]
    drawn.answers = {"wipe": True}
    panel._draw_mode()
    assert state.mode is ComparisonMode.WIPE
    drawn.take()
    drawn.answers = {"wipe": True}
    panel._draw_mode()
    assert state.mode is ComparisonMode.WIPE
    # A button of five letters needs 40 px, 18 px for its circle and 5 px between them; the last one ends at 130 px.
    for right_px, lines in ((130 + 40 + 18 + 5 + 13.0, 0), (130 + 40 + 18 + 5 + 13.1, 1)):
        drawn.calls.clear()
        compare._same_line_if_it_fits("blink", right_px)
        assert len(drawn.named("same_line")) == lines
    state.close()


@pytest.mark.parametrize(
    ("behind_s", "text"),
    [
        (0.0004, None),
        (-0.0004, None),
        (0.0005, "(0.001 s before the play head)"),
        (-7200.0, "(2.0 h after the play head)"),
    ],
)
def test_it_is_said_how_far_an_image_is_from_the_play_head(
    drawn: ScriptedImgui, behind_s: float, text: str | None
) -> None:
    image = SimpleNamespace(path=Path("f/a.png"), time=SimpleNamespace(utc_s=UTC_S, source="EXIF", exposure_s=None))
    compare._draw_image(image, None, behind_s)
    first = "a.png: 2024-03-10T11:00:04.678Z by EXIF"
    assert [line.replace("0.000 s", "0.001 s") for line in drawn.take()] == [
        *(first, *([] if text is None else [text]), "(decoding ...)")
    ]


def test_residuals_are_of_the_image_and_the_settings_shown() -> None:
    asked: list[Any] = []
    residuals = SimpleNamespace(measure="measure", of=lambda request: asked.append(request) or "found")
    images = {5.0: "image"}
    comparison = SimpleNamespace(residuals=residuals, image_at=images.get, ahead_s=1.25, time_reference="middle")
    comparison.match_exposure = True
    loaded = SimpleNamespace(simulator="simulator", head=SimpleNamespace(utc_s=5.0))
    session = SimpleNamespace(comparison=comparison, loaded=loaded, shown_overlays={Overlay.RESIDUALS}, config=Config())
    assert compare.residuals_of(session) == "found"
    (request,) = asked
    assert (request.simulator, request.ahead_s, request.image, request.reference, request.own_length) == (
        *("simulator", 1.25, "image", "middle", True),
    )
    assert request.exposure == Config().exposure.starting_at(0.0)
    loaded.head.utc_s = 6.0
    assert compare.residuals_of(session) is None
    loaded.head.utc_s = 5.0
    for change in ({"shown_overlays": set()}, {"loaded": None}):
        assert compare.residuals_of(SimpleNamespace(**vars(session) | change)) is None
    residuals.measure = None
    assert compare.residuals_of(session) is None
    assert len(asked) == 1


def test_a_fit_begins_with_what_is_chosen(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "ImageFit", lambda *what: what)
    monkeypatch.setattr(compare, "replace", lambda flight, time_offset_s: (flight, time_offset_s))
    comparison = SimpleNamespace(images=["a", "b"], fit_images="fit", fit=None, ahead_s=-1.25, time_reference="end")
    comparison.match_exposure = False
    simulator = SimpleNamespace(flight="flight", with_flight=lambda flight: ("with", flight))
    session = SimpleNamespace(comparison=comparison, loaded=SimpleNamespace(simulator=simulator), config=Config())
    drawn.answers = {"Fit": True, "mount": True}
    compare.FitPanel().draw(session)
    request, fit = comparison.fit
    assert (request.simulator, request.images, request.reference, request.own_length, fit) == (
        *(("with", ("flight", -1.25)), ("a", "b"), "end", False, "fit"),
    )
    assert (request.fits_time, request.fits_mount) == (True, False)
    assert request.exposure == Config().exposure.starting_at(0.0)


def test_a_folder_is_typed_and_opened(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    state, opened = ComparisonState(lambda: 50.0), []
    monkeypatch.setattr(state, "open", opened.append)
    panel = compare.ComparisonPanel(state)
    # The field leaves room for the button of 32 + 18 px, and 13 px between them.
    assert panel.draw(UTC_S, None, None) == compare.PanelRequests()
    assert drawn.named("set_next_item_width") == [[-63.0]]
    for answers in ({"Open": True}, {"##folder": "  "}, {"##folder": " ~/f "}, {"Open": True}):
        drawn.answers = answers
        panel.draw(UTC_S, None, None)
        drawn.take()
    assert opened == [Path("~/f").expanduser()] * 2
    state.error = "no folder"
    panel.draw(UTC_S, None, None)
    assert drawn.take()[-1] == "no folder [unsaved_marker]"
    monkeypatch.setattr(ComparisonState, "opening", "folder")
    panel.draw(UTC_S, None, None)
    assert "(reading names and times ...)" in drawn.take()
    monkeypatch.undo()
    state.close()


def test_the_clock_s_offset_and_the_real_image_s_levels_are_changed(drawn: ScriptedImgui) -> None:
    state = ComparisonState(lambda: 50.0)
    panel = compare.ComparisonPanel(state)
    state.offset_s = 7.5
    drawn.answers = {"0": True, "of exposure": 2, "simulate its exposure time": True}
    panel._draw_clock()
    assert (state.offset_s, state.time_reference, state.match_exposure) == (0.0, list(TimeReference)[2], False)
    drawn.answers = {"s": 2.25, "black": 0.125, "gain": 4.0}
    panel._draw_clock()
    panel._draw_levels()
    assert (state.offset_s, state.real_black, state.real_gain) == (2.25, 0.125, 4.0)
    drawn.answers = {"##fine": -1.5}
    panel._draw_clock()
    assert state.offset_s == -1.5
    state.close()
