"""The curves and the events of the timeline, computed and in the window."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config, ExposureSection
from glstar.flight import CameraTriggers, EventKind, FlightEvents
from glstar.render.truth.conditions import limiting_magnitude
from glstar.viewer.flight.sky import SkySampler
from glstar.viewer.flight.traces import TimeAxis, TimelineCurve, motion_traces
from glstar.viewer.ui.panels.timeline import TimelineEvents
from tests.support.windowinput import screen

START_S = 1710068400.0


def _climbing(path, *, north_deg_per_s=3e-4, climb=2.5):
    rows = [
        f"{START_S + t:.2f},0,0,{t},{-34.93 + north_deg_per_s * t:.9f},138.6,{300 + climb * t:.3f}"
        for t in np.arange(0.0, 20.01, 0.2)
    ]
    head = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


def test_height_and_speed_are_those_flown(tmp_path):
    flight = Config().open_flight(_climbing(tmp_path / "climb.csv"))
    traces = motion_traces(flight, START_S)
    second, height_m = traces[TimelineCurve.HEIGHT][0].thinned(0.0, 20.0, 10_000)
    np.testing.assert_allclose(height_m, 300 + 2.5 * second, rtol=0, atol=2e-3)
    a_m, e2, phi = 6378137.0, 0.00669437999014, radians(34.93)
    meridian_m = a_m * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5 + 325
    ground, climb = (trace.thinned(0.0, 20.0, 10_000)[1] for trace in traces[TimelineCurve.SPEED])
    np.testing.assert_allclose(ground, meridian_m * radians(3e-4), rtol=1e-4, atol=0)
    np.testing.assert_allclose(climb, 2.5, rtol=0, atol=5e-3)


def test_samples_are_those_of_the_exposures_there(tmp_path, small):
    flight = small.open_flight(_climbing(tmp_path / "climb.csv"))
    simulator, section = small.simulator(flight), ExposureSection()
    scene = simulator.scene(section.starting_at(START_S))
    star_id = int(scene.stars.star_id[scene.visible][np.argmin(scene.stars.vmag[scene.visible])])
    sampler = SkySampler()
    samples = sampler.of(simulator, section, star_id)
    sampler.wait()
    assert sampler.of(simulator, section, star_id) is samples
    assert samples.known.all()
    ((second, stars),) = samples.lines(TimelineCurve.STARS)
    at_rest, trail = samples.lines(TimelineCurve.LIMIT)
    for k in (0, 97, 240):
        there = simulator.scene(section.starting_at(START_S + second[k] - section.duration_s / 2))
        assert stars[k] == pytest.approx(there.visible.size, abs=1)
        limit = limiting_magnitude(there)
        assert at_rest[1][k] == pytest.approx(limit.at_rest_mag, abs=1e-3)
        assert trail[1][k] == pytest.approx(limit.trail_mag, abs=1e-3)
    assert samples.lines(TimelineCurve.SNR)[0][1][0] > 5
    sampler.close()


def test_events_are_found_near_the_mouse(tmp_path):
    flight = Config().open_flight(_climbing(tmp_path / "climb.csv"))
    events = FlightEvents(
        START_S + np.array([1.0, 5.0, 9.0]), (EventKind.MODE, EventKind.MESSAGE, EventKind.MODE), ("AUTO", "hi", "RTL")
    )
    flight = replace(flight, events=events, triggers=(CameraTriggers(START_S + np.array([5.01, 12.0]), "CAM"),))
    marks, axis = TimelineEvents(flight, START_S), TimeAxis(20.0)
    assert marks.count == 5
    assert marks.near(0.5, 800, axis) == []
    assert marks.near(5.0, 800, axis) == ["mode AUTO", "hi", "CAM 1: 5.010 s"]
    assert marks.near(12.1, 800, axis) == ["mode RTL", "CAM 2: 12.000 s"]


def _click(viewer, x, y):
    io = imgui.get_io()
    for event in (
        lambda: io.add_mouse_pos_event(x, y),
        lambda: io.add_mouse_button_event(0, True),
        lambda: io.add_mouse_button_event(0, False),
        lambda: io.add_mouse_pos_event(x, y),
    ):
        event()
        viewer.frame(0.0)


def _placed(draw, places):
    """Return a function that draws a control and notes where."""

    def noted(label, *state):
        result = draw(label, *state)
        low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
        places[label] = ((low.x + high.x) / 2, (low.y + high.y) / 2)
        return result

    return noted


def test_a_curve_is_chosen_in_the_window(make_viewer, tmp_path, monkeypatch):
    viewer = make_viewer(_climbing(tmp_path / "climb.csv"))
    places = {}
    for name in ("small_button", "checkbox"):
        monkeypatch.setattr(imgui, name, _placed(getattr(imgui, name), places))
    viewer.frame(0.0)
    _click(viewer, *places["curves"])
    for curve in (TimelineCurve.ATTITUDE, TimelineCurve.STARS):
        _click(viewer, *places[curve.spec.label])
    timeline = viewer.interface._panels._timeline
    assert timeline.curves == {TimelineCurve.RATES, TimelineCurve.STARS}
    assert viewer.session.busy
    viewer.session.loader.sampler.wait()
    assert viewer.session.loader.sampler._samples.known.all()
    before = screen(viewer).copy()
    _click(viewer, *places[TimelineCurve.STARS.spec.label])
    assert timeline.curves == {TimelineCurve.RATES}
    assert (screen(viewer) != before).any()
