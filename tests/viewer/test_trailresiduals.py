"""The residuals in the window: against a known turn of the camera, and as arrows over the image."""

from concurrent.futures import wait

import numpy as np
import pytest

from glstar.cli.flights.view import measure_image
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.prepare import prepare_export
from glstar.render.opengl import GLRenderer
from glstar.viewer.overlays.canvas import arrow_strokes, residual_scale
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.fitting import TrailResiduals
from glstar.viewer.ui.panels.compare import residuals_of
from tests.support.windowinput import press, screen
from tests.viewer.test_fitpanel import frames_until

MOUNT = {"mount.yaw_deg": 20.0, "mount.pitch_deg": 60.0, "mount.roll_deg": 10.0}
DRAWN = {"mount.yaw_deg": 20.3, "mount.pitch_deg": 60.2, "mount.roll_deg": 9.8}
EXPOSED = {"exposure.duration_s": 0.4, "exposure.interval_s": 1.2, "sensor.reference_peak_dn": 2000.0}


@pytest.fixture
def compared(make_viewer, small, log, tmp_path):
    """Return a viewer beside two images of a camera that is turned against its own."""
    with GLRenderer.headless() as renderer:
        options = ExportOptions(start_s=1.0, frames=2)
        prepare_export(small.override(**DRAWN | EXPOSED), log, tmp_path / "real", options).run(SerialExecutor(renderer))
    viewer = make_viewer(config=small.override(**MOUNT | EXPOSED))
    comparison = viewer.session.comparison
    comparison.residuals.measure = measure_image
    comparison.open(tmp_path / "real")
    frames_until(viewer, lambda: comparison.images)
    viewer.session.head.seek(comparison.log_utc_s(comparison.images[0]))
    return viewer


def measured(viewer):
    assert residuals_of(viewer.session) is None
    wait([viewer.session.comparison.residuals._running[1]], 60)
    return residuals_of(viewer.session)


def test_the_shifts_are_those_of_a_turned_camera_in_each_image(compared):
    session = compared.session
    assert residuals_of(session) is None  # not shown
    press(compared, "Shift+R")

    residuals = measured(compared)

    assert isinstance(residuals, TrailResiduals)
    camera = session.scene.camera
    here, real = (session.config.override(**mount).mount().C_camera_body for mount in (MOUNT, DRAWN))
    expected = camera.project(camera.unit_vectors(residuals.real_px) @ (here @ real.T).T) - residuals.real_px
    assert len(expected) > 10
    assert np.median(np.linalg.norm(expected, axis=1)) > 0.7
    off_px = np.linalg.norm(residuals.shift_px - expected, axis=1)
    assert np.median(off_px) < 0.1
    session.comparison.toggle(ComparisonMode.WIPE)  # which stays as it is, unlike blinking
    compared.frame(0.0)
    shown = screen(compared).copy()
    press(compared, "Shift+R")
    assert (screen(compared) != shown).any()
    press(compared, "Shift+R")
    assert (screen(compared) == shown).all()
    figures = dict(residuals.figures)
    assert figures["shift"] == "{:+.3f}, {:+.3f} px in the mean".format(*residuals.shift_px.mean(axis=0))
    assert "peak intensity" in figures

    # Another image and another setting are measured again.
    session.head.seek(session.comparison.log_utc_s(session.comparison.images[1]))
    compared.frame(0.0)
    second = measured(compared)
    assert second is not residuals
    assert second.real_px.shape != residuals.real_px.shape or (second.real_px != residuals.real_px).any()

    session.change(**DRAWN)
    compared.frame(0.0)
    aligned = measured(compared)
    assert np.median(np.linalg.norm(aligned.shift_px, axis=1)) < 0.15

    session.comparison.toggle(ComparisonMode.DIFFERENCE)
    assert residuals_of(session) is aligned  # measured once
    session.change(**{"mount.yaw_deg": 110.0})
    compared.frame(0.0)
    assert "no star of any image could be paired" in measured(compared)


def test_arrows_lead_from_the_real_trail_towards_the_simulated_one(viewer):
    real_px, shift_px = np.array([[60.0, 90.0], [150.0, 40.0]]), np.array([[0.5, 0.0], [0.0, -0.3]])
    residuals = TrailResiduals(real_px, shift_px, 2, ())
    session = viewer.session
    shapes = session.loaded.overlays.shapes(
        session.scene, {Overlay.RESIDUALS}, name_vmag_limit=0.0, residuals=residuals
    )
    # Nine of ten are 0.48 px long; 60 px of the screen are 125 times as much.
    [label] = shapes.labels
    assert label.text == ("arrows 100 x: from the detected to the simulated trail",)
    [marks], [lines] = shapes.marks, shapes.lines
    np.testing.assert_allclose(marks.xy_px, real_px, rtol=0, atol=1e-5)
    shafts = lines.xy_px.reshape(-1, 2, 2)[:2]
    np.testing.assert_allclose(shafts[:, 0], real_px, rtol=0, atol=1e-4)
    np.testing.assert_allclose(shafts[:, 1], [[110.0, 90.0], [150.0, 10.0]], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("shift", "screen_px", "scale"), [(0.3, 1.0, 200.0), (0.3, 0.25, 50.0), (30.0, 1.0, 2.0), (500.0, 1.0, 1.0)]
)
def test_the_scale_is_a_round_number(shift, screen_px, scale):
    assert residual_scale(np.array([[0.0, shift]] * 5), screen_px) == scale


def test_the_barbs_of_an_arrow_end_at_its_tip():
    strokes = arrow_strokes(np.array([[0.0, 0.0]]), np.array([[10.0, 0.0]]), 4.0)
    np.testing.assert_allclose(strokes, [[[0, 0], [10, 0]], [[6, -2], [10, 0]], [[6, 2], [10, 0]]], rtol=0, atol=1e-12)


def test_without_a_real_image_the_key_says_what_is_lacking(viewer):
    press(viewer, "Shift+R")
    assert "no residuals: compare a real image" in viewer.session.notifications.current[-1].message
