"""Times of frames, by clocks that the test sets."""

import pytest

from glstar.viewer.frametimes import FrameTimes


class Clocks:
    """Wall-clock and processor time, s."""

    def __init__(self) -> None:
        self.wall_s = self.work_s = 0.0

    def go_on(self, wall_s: float, work_s: float) -> None:
        self.wall_s += wall_s
        self.work_s += work_s


def test_a_report_has_the_parts_and_the_rates_of_recorded_frames() -> None:
    clocks = Clocks()
    times = FrameTimes(lambda: clocks.wall_s, lambda: clocks.work_s)
    times.recording = True
    # The first frame, which opens the window, is left out of the report.
    for number, drawing_s in enumerate([3.0, 0.01, 0.02, 0.03, 0.04]):
        times.begin()
        clocks.go_on(0.05, 0.008)
        with times.span("drawing"):
            clocks.go_on(drawing_s, 0.004)
        with times.span("simulation"):
            clocks.go_on(0.5, 0.002)
        if number % 2:
            times.new_image()
        times.end()
    found = times.report()
    assert (found["frames"], found["images"]) == (4, 2)
    assert found["seconds"] == pytest.approx(4 * 0.55 + 0.1, rel=1e-9)
    assert found["frames_per_s"] == pytest.approx(4 / 2.3, rel=0, abs=0.005)
    assert found["images_per_s"] == pytest.approx(2 / 2.3, rel=0, abs=0.005)
    assert found["drawing_ms"] == pytest.approx({"median": 25.0, "p95": 38.5}, rel=1e-9)
    assert found["frame_ms"]["median"] == pytest.approx(575.0, rel=1e-9)
    # Processor time outside of the other parts, and that of the simulation.
    assert (found["python_ms"]["median"], found["simulation_ms"]["median"]) == (8.0, 2.0)
    assert found["presenting_ms"]["median"] == 0.0
    assert times.frames_per_s == pytest.approx(4 / 2.3, rel=1e-9)
    times.pause()
    assert times.frames_per_s == 0.0


def test_a_report_without_frames_has_no_rates() -> None:
    found = FrameTimes().report()
    assert (found["frames"], found["frames_per_s"], found["images_per_s"]) == (0, 0.0, 0.0)
