"""One image from a pose, a time and a site, and the display of a frame."""

from datetime import UTC, datetime
from math import radians

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot as plt

import glstar as gs

ADELAIDE = {"utc": "2024-03-10T11:00:00Z", "latitude_deg": -34.93, "longitude_deg": 138.60}
SOUTH_POLE = np.array([[0.0, 0.0, -1.0]])


@pytest.fixture(scope="module")
def renderer():
    with gs.GLRenderer.headless() as renderer:
        yield renderer


@pytest.fixture(scope="module")
def frame(renderer):
    return gs.render_frame(**ADELAIDE, altitude_deg=40.0, azimuth_deg=180.0, renderer=renderer)


def pole_px(**pose):
    scene = gs.scene_at_pose(**ADELAIDE, config=gs.Config().override(**{"sky.refraction": False}), **pose)
    camera = scene.camera
    x_px, y_px = camera.project(scene.shutter.to_camera(SOUTH_POLE))[1, 0]
    return (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px


def test_the_celestial_pole_lies_below_the_axis_of_a_camera_that_points_above_it():
    # Diurnal aberration moves the pole by 0.3".
    assert pole_px(altitude_deg=40.0, azimuth_deg=180.0) == pytest.approx(
        (0.0, np.tan(radians(40.0 - 34.93))), rel=0, abs=2e-6
    )


def test_the_celestial_pole_lies_left_of_the_axis_of_a_camera_turned_to_the_west_of_it():
    x, _ = pole_px(altitude_deg=34.93, azimuth_deg=190.0)

    assert x < -0.1


def test_a_camera_rolled_clockwise_by_90_deg_sees_the_pole_below_its_axis_on_the_right():
    # The image rotates anticlockwise.
    down = np.tan(radians(40.0 - 34.93))

    assert pole_px(altitude_deg=40.0, azimuth_deg=180.0, roll_deg=90.0) == pytest.approx((down, 0.0), rel=0, abs=2e-6)


def test_the_quaternion_of_a_level_aircraft_points_to_the_zenith_with_the_default_mount():
    level = gs.scene_at_pose(**ADELAIDE, q_body_ned=(2.0, 0.0, 0.0, 0.0))
    zenith = gs.scene_at_pose(**ADELAIDE, azimuth_deg=-90.0)

    assert level.shutter.boresight_eq == pytest.approx(zenith.shutter.boresight_eq, rel=0, abs=1e-12)


def test_a_time_may_be_text_seconds_or_a_datetime():
    times = ["2024-03-10T11:00:00Z", 1710068400.0, datetime(2024, 3, 10, 11, tzinfo=UTC)]
    scenes = [gs.scene_at_pose(**ADELAIDE | {"utc": time}) for time in times]

    assert {scene.exposure.start_utc_s for scene in scenes} == {1710068400.0}


@pytest.mark.parametrize("q_body_ned", [(0, 0, 0, 0), (1, 0, 0), (float("nan"), 0, 0, 1)])
def test_a_quaternion_without_a_direction_is_refused(q_body_ned):
    with pytest.raises(gs.ConfigError, match="q_body_ned must be four finite numbers"):
        gs.scene_at_pose(**ADELAIDE, q_body_ned=q_body_ned)


def test_a_frame_without_a_renderer_is_the_same_frame(frame):
    again = gs.render_frame(**ADELAIDE, altitude_deg=40.0, azimuth_deg=180.0)

    assert np.array_equal(again.pixels, frame.pixels)


def test_a_saved_frame_holds_its_pixels(frame, tmp_path):
    frame.save(tmp_path / "frame.png")

    assert np.array_equal(cv2.imread(str(tmp_path / "frame.png"), cv2.IMREAD_UNCHANGED), frame.pixels)


def test_a_saved_frame_of_sixteen_bits_keeps_them(renderer, tmp_path):
    config = gs.Config().override(**{"sensor.bit_depth": 12})
    frame = gs.render_frame(**ADELAIDE, config=config, renderer=renderer)
    frame.save(tmp_path / "frame.png")

    assert frame.pixels.dtype == np.uint16
    assert np.array_equal(cv2.imread(str(tmp_path / "frame.png"), cv2.IMREAD_UNCHANGED), frame.pixels)


def test_a_frame_is_saved_as_png_only(frame, tmp_path):
    with pytest.raises(gs.ExportError, match=r"ends with \.png"):
        frame.save(tmp_path / "frame.jpg")
    with pytest.raises(gs.ExportError, match="cannot be written"):
        frame.save(tmp_path / "missing" / "frame.png")


def test_a_notebook_shows_a_frame_with_black_sky_and_white_stars(frame):
    shown = cv2.imdecode(np.frombuffer(frame._repr_png_(), np.uint8), cv2.IMREAD_UNCHANGED)

    assert shown.shape == frame.pixels.shape
    assert (shown.min(), shown.max()) == (0, 255)
    assert np.median(shown) == 0


def test_a_window_shows_a_frame_with_pixel_coordinates(frame, monkeypatch):
    mpl.use("agg")
    shown = []
    monkeypatch.setattr(plt, "show", lambda: shown.append(plt.gcf()))
    frame.show()

    (figure,) = shown
    assert figure.axes[0].get_xlim() == (-0.5, 1013.5)
    assert figure.axes[0].get_ylim() == (759.5, -0.5)
    plt.close(figure)
