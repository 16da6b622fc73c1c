"""The azimuths of an image against those of all its pixels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.model import Camera
from glstar.config import Config
from glstar.viewer.flight.map import image_azimuths_rad

CAMERA = Camera(width_px=120, height_px=90, fx_px=114.0, fy_px=114.0, cx_px=59.5, cy_px=44.5)


def _rotation(azimuth_deg, altitude_deg, roll_deg):
    """Return C_camera_ned of a camera (x right, y down, z forward) that points somewhere: (3, 3)."""
    level_north = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # rows: right is east, down is down
    turns = Rotation.from_euler("ZYX", [azimuth_deg, altitude_deg, roll_deg], degrees=True).as_matrix()
    return level_north @ turns.T


@pytest.mark.parametrize(
    ("azimuth_deg", "altitude_deg", "roll_deg"),
    [(0.0, 0.0, 0.0), (90.0, 20.0, 0.0), (200.0, 50.0, 40.0), (355.0, -35.0, 170.0), (310.0, 58.0, 90.0)],
)
def test_the_sector_holds_the_azimuths_of_all_pixels_and_is_no_larger(azimuth_deg, altitude_deg, roll_deg):
    rotation = _rotation(azimuth_deg, altitude_deg, roll_deg)
    first_rad, extent_rad = image_azimuths_rad(CAMERA, rotation)

    # Every pixel and its edges, by the pinhole itself; the image spans less than a half turn around its axis.
    x, y = np.meshgrid(np.arange(-0.5, 120.0, 0.5), np.arange(-0.5, 90.0, 0.5))
    rays = np.stack([(x - 59.5) / 114.0, (y - 44.5) / 114.0, np.ones_like(x)], axis=-1) @ rotation
    off_axis_deg = (np.rad2deg(np.arctan2(rays[..., 1], rays[..., 0])) - azimuth_deg + 180.0) % 360.0 - 180.0
    lowest_deg = (np.rad2deg(first_rad) - azimuth_deg + 180.0) % 360.0 - 180.0

    assert lowest_deg == pytest.approx(off_axis_deg.min(), abs=0.02)
    assert lowest_deg + np.rad2deg(extent_rad) == pytest.approx(off_axis_deg.max(), abs=0.02)
    assert 0.0 <= first_rad < 2 * np.pi


@pytest.mark.parametrize("altitude_deg", [90.0, 75.0, -80.0])
def test_all_azimuths_are_in_an_image_with_zenith_or_nadir(altitude_deg):
    assert image_azimuths_rad(CAMERA, _rotation(30.0, altitude_deg, 10.0))[1] == 2 * np.pi


def test_the_azimuths_are_not_known_if_the_lens_does_not_reach_the_border():
    lens = {"lens": "fisheye", "distortion": [0.0, 0.0, 0.0, 0.0]}
    numbers = {"width_px": 254, "height_px": 190, "fx_px": 40.0, "fy_px": 40.0}
    config = Config().override(**{f"camera.{key}": value for key, value in (numbers | lens).items()})
    assert np.isnan(image_azimuths_rad(config.camera(), _rotation(0.0, 0.0, 0.0))).all()
