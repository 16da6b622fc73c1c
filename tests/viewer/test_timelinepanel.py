"""The timeline without a window: its plots, boxes, marks, names and ticks, and what the mouse does to it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imgui_bundle import ImVec2, implot

from glstar.config import Config, ExposureSection
from glstar.flight import CameraTriggers, EventKind, Flight, FlightEvents
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.flight.traces import TimeAxis, TimelineCurve
from glstar.viewer.ui.panels import timeline
from glstar.viewer.ui.panels.timeline import Bands, Timeline, TimelineEvents
from glstar.viewer.ui.theme import DAY_PALETTE, NIGHT_PALETTE
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.viewer.conftest import write_flight

START_S = 1710068400.0
SECTION = ExposureSection(duration_s=0.5, interval_s=3.0)
PALETTES = {"day": DAY_PALETTE, "night": NIGHT_PALETTE}


class Plots(ScriptedImgui):
    """Keeps what each plot draws: (kind, label, numbers ...)."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn: list[tuple[Any, ...]] = []

    def plot_line(self, label: str, x: np.ndarray, y: np.ndarray, style: Any) -> None:
        self.drawn.append(("line", label, x, y, style))

    def plot_shaded(self, label: str, x: np.ndarray, y: np.ndarray, low: float, style: Any) -> None:
        self.drawn.append(("boxes", label, x.tolist(), y.tolist(), style))

    def plot_scatter(self, label: str, x: np.ndarray, y: np.ndarray, style: Any) -> None:
        self.drawn.append(("marks", label, x.tolist(), y.tolist(), style))

    def plot_inf_lines(self, label: str, x: np.ndarray, style: Any) -> None:
        self.drawn.append(("verticals", label, x.tolist(), style))

    def plot_text(self, text: str, x: float, y: float) -> None:
        self.drawn.append(("text", text, x, y))

    def of(self, label: str) -> tuple[Any, ...]:
        """Return the last drawing of a label."""
        return [each for each in self.drawn if each[1] == label][-1]

    def labels(self) -> list[str]:
        return [each[1] for each in self.drawn]

    def begin_aligned_plots(self, _: str) -> bool:
        return True

    def get_plot_mouse_pos(self, *_: int) -> SimpleNamespace:
        return SimpleNamespace(x=self.at_s, y=0.0)

    at_s = 0.0


@pytest.fixture
def plots(monkeypatch: pytest.MonkeyPatch) -> Plots:
    drawn = Plots()
    drawn.closed = {"##curves"}
    drawn.available = ImVec2(600.0, 200.0)
    drawn.plot_limits = (0.0, 12.0, -10.0, 30.0)
    scripted(monkeypatch, timeline, drawn=drawn)
    return drawn


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Return a flight of 12 s with a gap from 6 to 8 s, with two modes, a message and two cameras."""
    read = Config().open_flight(write_flight(tmp_path_factory.mktemp("flight") / "gap.csv", gap=True))
    events = FlightEvents(
        START_S + np.array([-1.0, 4.0, 5.0]),
        (EventKind.MODE, EventKind.MESSAGE, EventKind.MODE),
        ("AUTO", "hi %", "RTL"),
    )
    triggers = (
        CameraTriggers(START_S + np.array([2.0, 11.0]), "left log", "left"),
        CameraTriggers(START_S + np.array([3.0]), "right log", "right"),
    )
    return replace(read, events=events, triggers=triggers)


def head_of(flight: Flight, **changes: Any) -> PlayHead:
    head = PlayHead(flight.attitude.first_s, flight.attitude.last_s, SECTION)
    head.seek(START_S + 3.75)
    for name, value in changes.items():
        setattr(head, name, value)
    return head


@pytest.mark.parametrize("which", ["day", "night"])
def test_the_plots_have_curves_boxes_and_marks_in_their_order(plots: Plots, flight: Flight, which: str) -> None:
    shown, head, palette = Timeline(flight), head_of(flight), PALETTES[which]
    shown.draw(head, night=which == "night", images_s=np.array([1.0, 7.5, 99.0]))
    assert plots.named("begin_plot") == [
        ["##attitude", (-(7 * 8 + 6.0), 100.0), timeline._PLOT],
        ["##rates", (-(7 * 8 + 6.0), -1.0), timeline._PLOT],
    ]
    lines = plots.take()
    hides = "? a click hides or shows this line"
    assert lines[:7] == [
        *("[x] follow", "[ ] UTC", "<whole flight>", "<curves>", "? choose what is plotted over time", "[x] events"),
        "? flight modes, messages, triggers of the camera and real images",
    ]
    names = [line.partition(" [")[0] for line in lines[7:]]
    assert names == [
        *("plot ##attitude", "roll", hides, "pitch", hides, "yaw", hides),
        *("plot ##rates", "forward", hides, "right", hides, "down", hides),
    ]
    labels = plots.labels()
    assert labels[: labels.index("##head") + 1] == [
        *("##gaps", "##exposures", "##shown", "##modes", "##messages", "##triggers", "##images"),
        *("AUTO", "RTL", "roll", "pitch", "yaw", "##head"),
    ]
    # Only the first plot has the events.
    assert labels[labels.index("##head") + 1 :] == [
        *("##gaps", "##exposures", "##shown", "forward", "right", "down", "##head")
    ]
    box = [0.0, 1.0, 1.0, 0.0]
    _, _, gap_s, height, style = plots.of("##gaps")
    assert (gap_s, height) == (pytest.approx([6.0, 6.0, 8.0, 8.0], abs=0.041), box)
    assert style is palette.gap
    # Exposures of half a second, one every three seconds, of which the second is shown.
    starts_s = [0.0, 3.0, 6.0, 9.0]
    expected = [s + at for s in starts_s for at in (0.0, 0.0, 0.5, 0.5)]
    assert plots.of("##exposures")[2:4] == (pytest.approx(expected, abs=1e-6), box * 4)
    assert plots.of("##exposures")[4] is palette.exposures
    assert plots.of("##shown")[2:4] == (pytest.approx([3.0, 3.0, 3.5, 3.5], abs=1e-6), box)
    assert plots.of("##shown")[4] is palette.shown
    assert plots.of("##head")[2] == pytest.approx([3.75], abs=1e-6)
    assert plots.of("##modes")[2] == pytest.approx([-1.0, 5.0])
    assert plots.of("##messages")[2:] == (pytest.approx([4.0]), [0.93], palette.message)
    assert plots.of("##triggers")[2:] == (pytest.approx([2.0, 11.0, 3.0]), [0.04] * 3, palette.trigger)
    assert plots.of("##images")[2:] == (pytest.approx([1.0, 7.5]), [0.12] * 2, palette.image)
    # From the left edge, and from its beginning: half of the text and of its gap of 8 px to the right.
    px_s = 12.12 / 500
    assert plots.of("AUTO")[2:] == (pytest.approx(-0.06 + 20 * px_s, abs=1e-4), 0.82)
    assert plots.of("RTL")[2:] == (pytest.approx(5.0 + 16 * px_s, abs=1e-4), 0.82)
    yaw = plots.of("yaw")
    assert yaw[3][np.flatnonzero(yaw[2] == 3.0)] == pytest.approx(12.0, abs=0.01)
    assert yaw[4] is palette.lines[2]


def test_points_markers_and_a_missing_exposure_are_boxes_and_lines(plots: Plots, flight: Flight) -> None:
    shown = Timeline(flight)
    head = head_of(flight, mode=Mode.SLIDING, in_s=START_S + 2.5, out_s=None)
    head.seek(START_S + 7.0)
    head.add_marker()
    shown.draw(head)
    assert "##exposures" not in plots.labels()
    assert plots.of("##part")[2] == pytest.approx([2.5, 2.5, 12.0, 12.0], abs=1e-6)
    assert plots.of("##markers")[2] == pytest.approx([7.0], abs=1e-6)
    assert plots.of("##shown")[2] == pytest.approx([6.5, 6.5, 7.0, 7.0], abs=1e-6)
    assert plots.of("##shown")[4] is DAY_PALETTE.missing
    head.in_s, head.out_s = None, START_S + 9.5
    shown.draw(head)
    assert plots.of("##part")[2] == pytest.approx([0.0, 0.0, 9.5, 9.5], abs=1e-6)
    # While it plays, the play head goes from pixel to pixel: 12.12 s on 500 px.
    head.playing = True
    head.seek(START_S + 7.01)
    shown.draw(head)
    pixel_s = 12.12 / 500
    assert plots.of("##head")[2] == pytest.approx([round(7.01 / pixel_s) * pixel_s], abs=1e-6)
    assert plots.of("##head")[2] != pytest.approx([7.01], abs=1e-3)


def test_the_axes_have_units_ticks_and_limits(plots: Plots, flight: Flight) -> None:
    shown, head = Timeline(flight), head_of(flight)
    shown.draw(head)
    axes = {(args[0], args[1]) for args in plots.named("setup_axis")}
    y, y2 = int(implot.ImAxis_.y1), int(implot.ImAxis_.y2)
    assert {(y, "deg"), (y, "deg/s"), (y2, None)} <= axes
    x_flags = [args[2] for args in plots.named("setup_axis") if args[0] == int(implot.ImAxis_.x1)]
    assert [bool(each & int(implot.AxisFlags_.no_tick_labels)) for each in x_flags] == [True, False]
    assert plots.named("setup_axis_limits")[0][1:3] == pytest.approx([-0.06, 12.06])
    assert plots.named("setup_axis_limits")[1][1:3] == [0.0, 1.0]
    assert shown._per_px[TimelineCurve.ATTITUDE] == pytest.approx(40 / 400)
    # The ticks of the values are known when the plot has been drawn: 40 units on 400 px have room for one each 10 px.
    assert [args[0] for args in plots.named("setup_axis_ticks")] == [int(implot.ImAxis_.x1)] * 2
    plots.take()
    shown.draw(head)
    values = plots.named("setup_axis_ticks")[0]
    assert values[:2] == [y, [float(k) for k in range(-10, 31)]]
    assert values[2][:3] == ["-10", "-9", "-8"]
    # In a low panel there is one plot without labels of its values, and with times of the day.
    plots.take()
    plots.available = ImVec2(600.0, 67.4)
    plots.answers = {"UTC": True}
    shown.draw(head)
    assert [args[0] for args in plots.named("begin_plot")] == ["##attitude"]
    assert (y, "") in {(args[0], args[1]) for args in plots.named("setup_axis")}
    ((_, _, labels),) = plots.named("setup_axis_ticks")
    assert labels[0].startswith("11:00:0")


@pytest.mark.parametrize(
    ("limits", "height_px", "ticks"),
    [
        # Of 10 px a text, at least 9 px for a step: 36 units on 400 px are 0.81 units, 3.3 of 360 on 100 px are 32.4.
        ((-4.5, 4.5), 100.0, [-4, -3, -2, -1, 0, 1, 2, 3, 4]),
        ((0.0, 22.0), 100.0, [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22]),
        ((-180.0, 180.0), 100.0, [-150, -100, -50, 0, 50, 100, 150]),
        ((99.98, 100.05), 80.0, [99.98, 99.99, 100.0, 100.01, 100.02, 100.03, 100.04, 100.05]),
        ((0.0, 60.0), 0.5, [0.0]),
    ],
)
def test_ticks_of_values_are_round_and_have_room(
    plots: Plots, flight: Flight, limits: tuple[float, float], height_px: float, ticks: list[float]
) -> None:
    shown = Timeline(flight)
    assert shown._value_ticks("##attitude") == []
    shown._values["##attitude"] = (*limits, height_px)
    assert shown._value_ticks("##attitude") == ticks


@pytest.mark.parametrize(
    ("deeds", "expected"),
    [
        ({"pressed": {"click 0"}}, {"second": 8.5, "scrubbing": True}),
        ({"pressed": {"double 0"}}, {"axis": (-0.06, 12.06)}),
        ({"pressed": {"down 1"}, "delta": 25.0}, {"axis": (2.9, 4.9)}),
        ({"pressed": {"down 2"}, "delta": -25.0}, {"axis": (3.1, 5.1)}),
        ({"wheel": 1.0}, {"axis": (8.5 - 5.5 / 1.25, 8.5 - 3.5 / 1.25)}),
        ({"wheel_h": 2.0}, {"axis": (2.6, 4.6)}),
        ({"hovered": False, "pressed": {"click 0"}}, {}),
    ],
)
def test_the_mouse_moves_head_and_axis(
    plots: Plots, flight: Flight, deeds: dict[str, Any], expected: dict[str, Any]
) -> None:
    shown, head = Timeline(flight), head_of(flight)
    shown._width_px = 500.0
    shown.axis.start_s, shown.axis.stop_s = 3.0, 5.0
    plots.hovered, plots.at_s = deeds.get("hovered", True), 8.5
    plots.pressed = deeds.get("pressed", set())
    plots.io.mouse_delta = ImVec2(deeds.get("delta", 0.0), 3.0)
    plots.io.mouse_wheel, plots.io.mouse_wheel_h = deeds.get("wheel", 0.0), deeds.get("wheel_h", 0.0)
    shown._take_mouse(head)
    assert head.second == pytest.approx(expected.get("second", 3.75), abs=1e-6)
    assert (shown.axis.start_s, shown.axis.stop_s) == pytest.approx(expected.get("axis", (3.0, 5.0)), abs=1e-6)
    assert shown._scrubbing == expected.get("scrubbing", False)


def test_a_drag_moves_the_head_wherever_the_mouse_is_and_ends_with_its_button(plots: Plots, flight: Flight) -> None:
    shown, head = Timeline(flight), head_of(flight)
    shown._scrubbing, plots.at_s, plots.pressed = True, 9.25, {"down 0"}
    shown.axis.zoom(3.0, 0.1)
    before = shown.axis.start_s
    shown.draw(head)
    assert head.second == pytest.approx(9.25, abs=1e-6)
    # The axis stays while the head is dragged, and follows it otherwise, unless that is switched off.
    assert shown.axis.start_s == before
    plots.pressed = set()
    shown.draw(head)
    assert not shown._scrubbing
    head.seek(START_S + 1.0)
    shown.draw(head)
    assert shown.axis.start_s < 1.0 < shown.axis.stop_s
    before = shown.axis.start_s
    plots.answers = {"follow": True}
    head.seek(START_S + 11.0)
    shown.draw(head)
    assert shown.axis.start_s == before
    plots.answers = {"whole flight": True}
    shown.draw(head)
    assert shown.axis.stop_s == pytest.approx(12.06)


@pytest.mark.parametrize(
    ("second", "tooltip"),
    [
        (
            3.0,
            "3.000 s\nroll 0.28 deg\npitch 3.00 deg\nyaw 12.00 deg\nother: 1.00  2.00  3.00\nmode AUTO\n"
            "right 1: 3.000 s",
        ),
        (4.0, "4.000 s\nroll -1.51 deg\npitch 3.00 deg\nyaw 16.00 deg\nother: no attitude\nmode AUTO\nhi %%"),
        (7.0, "7.000 s\nno attitude of 2.000 s"),
        (12.5, None),
        (-0.5, None),
    ],
)
def test_under_the_mouse_are_the_sample_and_what_happened(
    plots: Plots, flight: Flight, second: float, tooltip: str | None
) -> None:
    shown = Timeline(flight)
    other = {START_S + 3.0: np.deg2rad([1.0, 2.0, 3.0])}
    shown._others = (SimpleNamespace(name="other", angles_rad=lambda utc_s: other.get(round(utc_s, 3))),)
    shown._show_sample(second)
    lines = plots.take()
    if second == 7.0:
        assert lines[0].startswith("? 7.000 s\n")
        assert lines[0].endswith(" s")
        assert "deg" not in lines[0]
    else:
        assert lines == ([] if tooltip is None else [f"? {tooltip}"])
    shown.shows_events = False
    shown._show_sample(second)
    assert not any("mode" in line for line in plots.take())


def test_other_logs_are_faint_behind_and_lines_can_be_hidden(plots: Plots, flight: Flight) -> None:
    shown, head = Timeline(flight), head_of(flight)
    later = SimpleNamespace(attitude=SimpleNamespace(first_s=START_S + 2.0))
    traces = {TimelineCurve.ATTITUDE: shown._lines.angles[:2]}
    log = SimpleNamespace(name="sim", flight=later, traces=traces, angles_rad=lambda _: None)
    shown._hidden = {"pitch"}
    shown.draw(head, others=(log,))
    lines = plots.take()
    assert "(faint: sim)" in lines
    assert plots.labels().index("roll##sim") < plots.labels().index("roll")
    assert not {"pitch", "pitch##sim", "yaw##sim"} & set(plots.labels())
    np.testing.assert_allclose(plots.of("roll##sim")[2][:3], 2.0 + plots.of("roll")[2][:3], rtol=0, atol=1e-6)
    assert plots.of("roll##sim")[4] is DAY_PALETTE.faint[0]
    # The name of a hidden line is faint; a click shows or hides it.
    opacity = {line.partition(" [")[0]: float(line.rpartition(", ")[2].rstrip(")]")) for line in lines if " [(" in line}
    assert (opacity["pitch"], opacity["roll"]) == (0.4, 1.0)
    plots.answers = {"item": True}
    shown.draw(head)
    assert shown._hidden == {"roll", "yaw", "forward", "right", "down"}


def test_curves_are_chosen_in_their_menu_and_one_always_stays(plots: Plots, flight: Flight) -> None:
    shown, head = Timeline(flight), head_of(flight)
    plots.closed = set()
    plots.answers = {"Height": True, "Attitude": True}
    shown.draw(head)
    assert shown.curves == {TimelineCurve.RATES, TimelineCurve.HEIGHT}
    lines = plots.take()
    assert lines[lines.index("[x] Angular rates") + 1] == "? about the forward, right and down axes of the body"
    plots.answers = {"Angular rates": True, "Height": True}
    shown._draw_controls()
    assert shown.curves == {TimelineCurve.HEIGHT}
    plots.take()
    plots.drawn.clear()
    shown.draw(head)
    assert plots.of("height")[3] == pytest.approx(300.0)
    plots.answers = {"events": True}
    shown.draw(head)
    assert plots.labels()[-5:] == ["##gaps", "##exposures", "##shown", "height", "##head"]
    # Curves of simulated exposures are drawn as far as they are known.
    plots.answers = {"Number of stars": True}
    shown._draw_controls()
    plots.take()
    samples = SimpleNamespace(lines=lambda curve: [(np.array([1.0, 2.0]), np.array([30.0, 40.0]))])
    shown.draw(head, samples=samples)
    assert plots.of("stars")[3].tolist() == [30.0, 40.0]
    plots.drawn.clear()
    shown.draw(head)
    assert "stars" not in plots.labels()
    # As many plots as have 60 px of the panel's height.
    for room_px, count in ((119.0, 1), (120.0, 2), (30.0, 1)):
        plots.available = ImVec2(600.0, room_px)
        assert len(shown._plots(None)) == count


@pytest.mark.parametrize(
    ("axis", "width_px", "section", "expected"),
    [
        # Those in view, and the one before the left edge, which may still be exposed there.
        ((6.4, 9.0), 500.0, SECTION, [(3.0, 3.5), (6.0, 6.5), (9.0, 9.5)]),
        ((6.6, 8.9), 500.0, SECTION, [(6.0, 6.5)]),
        # 3 s are 3.9 px of 400 s on 520 px, and 4.1 px of 400 s on 547 px.
        ((-3.0, 397.0), 520.0, SECTION, [(0.0, 9.5)]),
        ((-3.0, 397.0), 547.0, SECTION, [(0.0, 0.5), (3.0, 3.5), (6.0, 6.5), (9.0, 9.5)]),
        # Exposures without a pause between them, and a flight without any.
        ((-3.0, 15.0), 500.0, ExposureSection(duration_s=3.0, interval_s=3.0), [(0.0, 12.0)]),
        ((-3.0, 15.0), 500.0, ExposureSection(duration_s=20.0, interval_s=30.0), []),
    ],
)
def test_exposures_are_boxes_in_view_or_one_box(
    plots: Plots,
    flight: Flight,
    axis: tuple[float, float],
    width_px: float,
    section: ExposureSection,
    expected: list[tuple[float, float]],
) -> None:
    shown, head = Timeline(flight), head_of(flight, exposure_section=section)
    shown.axis, shown._width_px = TimeAxis(600.0), width_px
    shown.axis.start_s, shown.axis.stop_s = axis
    boxes = shown._camera_exposures(head)
    assert boxes.x.reshape(-1, 4)[:, 1:3] == pytest.approx(np.reshape(expected, (-1, 2)), abs=1e-6)
    assert shown._camera_exposures(head) is boxes
    head.exposure_section = section.model_copy(update={"interval_s": section.interval_s + 0.1})
    assert shown._camera_exposures(head) is not boxes


def test_names_of_modes_are_written_where_they_fit(plots: Plots, flight: Flight) -> None:
    events = TimelineEvents(flight, START_S)
    axis = TimeAxis(12.0)
    axis.start_s, axis.stop_s = 0.0, 10.0
    # AUTO needs 40 px of the 5 s until RTL, which needs 32 px of 5 s until the right edge.
    for width_px, names in ((81.0, ["AUTO", "RTL"]), (79.0, ["RTL"]), (63.0, [])):
        plots.drawn.clear()
        events._draw_names(axis, width_px)
        assert plots.labels() == names
    assert events.count == 6
    assert events.near(11.0, 500.0, axis) == ["mode RTL", "left 2: 11.000 s"]
    single = replace(flight, events=None, triggers=flight.triggers[1:])
    assert TimelineEvents(single, START_S).near(3.0, 500.0, axis) == ["right log 1: 3.000 s"]


def test_day_and_twilight_are_computed_once_and_ahead_of_a_live_flight(
    plots: Plots, flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def light(_: object, first_s: float, last_s: float) -> dict[str, np.ndarray]:
        asked.append((first_s - START_S, last_s - START_S))
        return {"civil twilight": np.array([[START_S + 1.0, START_S + 4.0]])}

    monkeypatch.setattr(timeline, "light_intervals", light)
    for grows, ends in ((False, [12.0, 13.0]), (True, [612.0])):
        asked.clear()
        shown = Timeline(flight, grows=grows)
        for last_s in (12.0, 11.0, 13.0):
            light_s = shown._light_until(START_S + last_s)
        assert [last_s for _, last_s in asked] == pytest.approx(ends, abs=1e-6)
        assert asked[0][0] == pytest.approx(0.0, abs=1e-6)
        assert light_s["civil twilight"].x.tolist() == pytest.approx([1.0, 1.0, 4.0, 4.0])
    shown.draw(head_of(flight))
    assert plots.of("##civil twilight")[4] is DAY_PALETTE.light["civil twilight"]
    assert shown.axis.span_s == pytest.approx(12.12)
    assert Bands.of(np.empty(0), np.empty(0)).x.size == 0
