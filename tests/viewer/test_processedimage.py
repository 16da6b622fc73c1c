"""The processed image in the window: the bytes that an export writes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.viewer.picture.simulated import why_not_processed
from glstar.viewer.session.actions import is_on
from glstar.viewer.session.keys import Action
from glstar.viewer.session.saving import save_frame
from tests.support.windowinput import press, screen

COLOUR = {
    "sensor.mosaic": "rggb",
    "sensor.band": "imx477",
    "sensor.bit_depth": 12,
    "sensor.sky_mean_dn": 200.0,
    "sensor.sky_std_dn": 60.0,
    "output.process": "isp",
    "output.demosaic": "bilinear",
    "output.tone_curve": "0,0;0.05,0.4;1,1",
}
GREY = {"output.process": "isp", "output.gamma": 2.2, "sensor.sky_std_dn": 9.0}


def exported(viewer) -> np.ndarray:
    """Return the PNG that the window saves of the image shown, as red, green and blue."""
    session = viewer.session
    save_frame(session)
    while session.export is not None:
        viewer.frame(0.01)
    (file,) = session.output.rglob("frame_*.png")
    return cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1]


def in_the_panel(viewer) -> np.ndarray:
    """Return the upper half of the picture, one screen pixel to one of the image; messages cover the lower one."""
    viewer.frame(0.0)
    height, width = viewer.session.image.pixels.shape
    left, top = np.rint(viewer.session.view.to_screen([-0.5, -0.5])).astype(int)
    return screen(viewer)[::-1][top : top + height // 2, left : left + width]


@pytest.mark.parametrize("settings", [COLOUR, GREY], ids=["colour", "grey"])
def test_the_window_shows_the_bytes_of_the_exported_png(make_viewer, small, settings):
    viewer = make_viewer(config=small.override(**settings))
    session = viewer.session
    session.shown_overlays = set()
    for chord in ("H", "1"):
        press(viewer, chord)
    raw = in_the_panel(viewer)
    press(viewer, "Shift+P")
    assert is_on(Action.PROCESSED, session)
    written = exported(viewer)
    np.testing.assert_array_equal(session.image.processed, written)
    np.testing.assert_array_equal(in_the_panel(viewer), written[: len(raw)])
    assert (in_the_panel(viewer) != raw).any()
    press(viewer, "Shift+P")
    np.testing.assert_array_equal(in_the_panel(viewer), raw)


def test_a_raw_image_has_no_processed_form_and_the_window_says_so(viewer):
    press(viewer, "Shift+P")
    assert any('process = "isp"' in each.message for each in viewer.session.notifications.current)
    assert not viewer.session.shown.is_processed
    assert viewer.session.image.processed is None


def test_what_cannot_be_processed_is_a_message(viewer):
    scene = viewer.session.scene
    demosaiced = scene.with_sensor(
        replace(scene.sensor, effects={"output.process": "isp", "output.demosaic": "bilinear"})
    )
    assert "needs a mosaic" in why_not_processed(demosaiced)
    developed = scene.with_sensor(replace(scene.sensor, effects={"output.process": "isp"}))
    assert why_not_processed(developed) == ""
    summed = replace(developed, exposure=Exposure(scene.exposure.start_utc_s, 0.1, frames=4, stack="sum"))
    assert "sums" in why_not_processed(summed)
