"""The fit of clock and mount in the window: against the values that the real images were drawn with."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from imgui_bundle import imgui

from glstar.cli.flights.view import fit_images
from glstar.config import Config
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.prepare import prepare_export
from glstar.render.opengl import GLRenderer
from glstar.viewer.loop import Viewer

# What the real images are drawn with; the window begins with a mount of whole degrees and a clock without an offset.
CLOCK_S = 0.06
BEGUN = {"mount.yaw_deg": 20.0, "mount.pitch_deg": 60.0, "mount.roll_deg": 10.0}
DRAWN = {"mount.yaw_deg": 20.3, "mount.pitch_deg": 60.2, "mount.roll_deg": 9.8}


@pytest.fixture
def photographs(small: Config, log: Path, tmp_path: Path) -> Path:
    """Draw five images with another mount, by a camera whose clock is ahead."""
    folder = tmp_path / "photographs"
    real = small.override(
        **{"flight.time_offset_s": CLOCK_S} | DRAWN,
        **{"exposure.duration_s": 0.4, "exposure.interval_s": 1.2, "sensor.reference_peak_dn": 2000.0},
    )
    with GLRenderer.headless() as renderer:
        prepare_export(real, log, folder, ExportOptions(start_s=1.0, frames=5)).run(SerialExecutor(renderer))
    return folder


def pressing(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Return a set of labels of buttons: each is pressed once."""
    pressed, button = set[str](), imgui.button

    def clicked(label: str, *rest: object) -> bool:
        button(label, *rest)
        if label in pressed:
            pressed.remove(label)
            return True
        return False

    monkeypatch.setattr(imgui, "button", clicked)
    return pressed


def frames_until(viewer: Viewer, is_so: Callable[[], object]) -> None:
    end_s = time.monotonic() + 60
    while not is_so():
        viewer.frame(0.0)
        assert time.monotonic() < end_s
        time.sleep(0.02)  # the fit has the processor between frames, as in a window


def test_clock_and_mount_are_fitted_and_applied(
    make_viewer: Callable[..., Viewer], photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = make_viewer()
    session, comparison = viewer.session, viewer.session.comparison
    session.change(**{"exposure.duration_s": 0.4, "sensor.reference_peak_dn": 2000.0} | BEGUN)
    comparison.fit_images = fit_images
    comparison.open(photographs)
    frames_until(viewer, lambda: comparison.images)
    # The folder has its truth, whose times are the camera's own.
    viewer.interface._panels.show("Compare")
    pressed = pressing(monkeypatch)

    pressed.add("Fit")
    frames_until(viewer, lambda: comparison.fit is not None and not comparison.fit.running)

    fit = comparison.fit
    assert fit is not None
    assert fit.error == ""
    assert fit.result is not None
    assert comparison.offset_s == 0.0
    assert session.config.mount() == session.config.override(**BEGUN).mount()
    assert (fit.result.images, fit.result.of) == (5, 5)
    assert fit.result.centroid_median_px < 0.3

    pressed.add("Apply")
    frames_until(viewer, lambda: comparison.fit is None)

    assert comparison.ahead_s == pytest.approx(CLOCK_S, rel=0, abs=0.003)
    drawn = session.config.override(**DRAWN).mount()
    assert session.config.mount().C_camera_body == pytest.approx(drawn.C_camera_body, rel=0, abs=0.0015)


def test_images_of_another_sky_are_an_error_and_change_nothing(
    make_viewer: Callable[..., Viewer], photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = make_viewer()
    session, comparison = viewer.session, viewer.session.comparison
    session.change(**BEGUN | {"mount.yaw_deg": 110.0})
    comparison.fit_images = fit_images
    comparison.open(photographs)
    frames_until(viewer, lambda: comparison.images)
    viewer.interface._panels.show("Compare")
    pressed = pressing(monkeypatch)

    pressed.add("Fit")
    frames_until(viewer, lambda: comparison.fit is not None and not comparison.fit.running)

    assert comparison.fit is not None
    assert comparison.fit.result is None
    assert "set clock or mount by hand first" in comparison.fit.error
    assert comparison.offset_s == 0.0
