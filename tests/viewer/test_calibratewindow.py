"""The window that calibrates a camera: against the camera that drew the photograph, with mouse and keys."""

import time

import cv2
import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.cli.flights.windowoptions import calibrate_photo
from glstar.config import Config
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.prepare import prepare_export
from glstar.render.opengl import GLRenderer
from glstar.viewer.picture.fitting import with_calibration
from tests.support.windowinput import press
from tests.viewer.conftest import write_flight
from tests.viewer.test_fitpanel import pressing

FOCAL_PX = 560.0
DRAWN = {
    "camera.width_px": 640, "camera.height_px": 480, "camera.fx_px": FOCAL_PX, "camera.fy_px": FOCAL_PX,
    "sensor.reference_peak_dn": 900.0, "exposure.duration_s": 0.1, "sky.refraction": False,
}  # fmt: skip


@pytest.fixture
def photograph(tmp_path, kept_patterns):
    """Draw a photograph from an aircraft at rest."""
    log = write_flight(tmp_path / "still.csv", yaw_rate_deg_per_s=0.0)
    with GLRenderer.headless() as renderer:
        config = Config().override(**DRAWN)
        prepare_export(config, log, tmp_path / "set", ExportOptions(start_s=1.0, frames=1)).run(
            SerialExecutor(renderer)
        )
    return tmp_path / "set" / "frame_000000.png"


@pytest.fixture
def calibrating(make_viewer, small):
    """Return a viewer with another focal length, which can calibrate; it seeks no refraction, as none is drawn."""
    other = {"camera.width_px": 640, "camera.height_px": 480, "camera.fx_px": 555.0, "camera.fy_px": 555.0}
    other["sky.refraction"] = False
    viewer = make_viewer(config=small.override(**other))
    viewer.interface.calibration.calibrate = calibrate_photo
    return viewer


def finished(viewer):
    """Draw frames until the calibration has ended."""
    window, end_s = viewer.interface.calibration, time.monotonic() + 60
    while window.is_running:
        time.sleep(0.02)
        viewer.frame(0.0)
        assert time.monotonic() < end_s
    for _ in range(3):
        viewer.frame(0.0)
    return window


def click_at(viewer, x, y):
    io = imgui.get_io()
    for _ in range(3):
        io.add_mouse_pos_event(float(x), float(y))
        viewer.frame(0.0)
    for down in (True, False):
        io.add_mouse_button_event(0, down)
        viewer.frame(0.0)


def test_a_dropped_photograph_is_calibrated_corrected_saved_and_applied(photograph, calibrating, monkeypatch, tmp_path):
    session, window = calibrating.session, calibrating.interface.calibration
    window._typed["exposure"] = "0.1"
    calibrating.interface.open_dropped(photograph)

    finished(calibrating)

    assert window.run.error == ""
    first = window.result
    assert len(first.name) > 100
    assert np.linalg.norm(first.residual_px, axis=1).max() < 3
    assert "identified by their pattern" in first.report[0]

    # A click on a star removes it.
    star = int(first.vmag.argmin())
    photo = window._photo
    click_at(calibrating, *(photo._view.to_screen(first.xy_px[star]) + photo.corner))
    assert window.removed_px == [tuple(first.xy_px[star].tolist())]
    finished(calibrating)
    second = window.result
    assert second is not first
    assert len(second.name) >= len(first.name) - 5
    assert np.linalg.norm(second.xy_px - first.xy_px[star], axis=1).min() > 1

    window.save(second, tmp_path / "found" / "mine")
    finished(calibrating)
    assert "mine.toml and 3 files beside it" in session.notifications.current[-1].message
    written = {path.name for path in (tmp_path / "found").iterdir()}
    assert written == {"mine.toml", "mine.json", "mine.stars.csv", "mine.png"}
    calibrated = Config.load(tmp_path / "found" / "mine.toml")
    assert calibrated.camera().fx_px == pytest.approx(FOCAL_PX, rel=5e-4)

    before = session.config
    pressing(monkeypatch).add("Apply to the camera")
    calibrating.frame(0.0)
    calibrating.frame(0.0)
    assert session.config.camera() == calibrated.camera()
    assert session.config.sensor() == calibrated.sensor()
    press(calibrating, "Ctrl+Z")
    assert session.config == before
    press(calibrating, "Escape")
    assert not window.is_open


def test_an_image_without_stars_gets_the_line_of_the_command(calibrating, tmp_path):
    noise = np.random.default_rng(1).normal(20, 3, (480, 640)).clip(0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "cloud.png"), noise)
    window = calibrating.interface.calibration

    window.open(calibrating.session, tmp_path / "cloud.png")
    finished(calibrating)

    assert "does not state its exposure" in window.run.error
    assert "\n" not in window.run.error

    window._typed["exposure"], window._typed["latitude"] = "0.5", "12 N"
    before = window.run
    window._start(calibrating.session)
    assert window.run is before
    assert "latitude is no number: '12 N'" in calibrating.session.notifications.current[-1].message

    window._typed["latitude"], window._own_camera = "", False
    window._start(calibrating.session)
    assert "give the width of the view" in calibrating.session.notifications.current[-1].message
    window._typed["fov"] = "60"
    window._start(calibrating.session)
    finished(calibrating)
    assert "0 stars were found on the image and 4 are needed" in window.run.error
    assert window.result is None


def test_a_calibration_replaces_camera_and_sensor_and_nothing_else():
    config = Config().override(
        **{"camera.preset": "picamhq-6mm", "sensor.noise": "electrons", "exposure.duration_s": 2.0}
    )
    toml = "[camera]\nwidth_px = 320\nheight_px = 240\nfx_px = 300.0\nfy_px = 300.0\ncx_px = 159.5\ncy_px = 119.5\n"
    camera_only = with_calibration(config, toml)
    assert (camera_only.camera().width_px, camera_only.camera().fx_px) == (320, 300.0)
    assert camera_only.sensor().electrons is not None
    both = with_calibration(config, toml + "[sensor]\nreference_vmag = 4.0\nreference_peak_dn = 77.0\n")
    assert both.sensor().electrons is None
    assert both.sensor().reference_peak_dn == 77.0
    assert both.exposure.duration_s == 2.0
