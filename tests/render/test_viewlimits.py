"""Up to which angles from the axis stars are drawn behind a lens, and the view with a margin around the image."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.render.motion.starpaths import view_limit_rad, view_radius_rad
from tests.support.scenes import camera

# r = f a, for any angle.
EQUIDISTANT = Lens("fisheye", (0.0, 0.0, 0.0, 0.0))


def behind(lens: Lens, side_px: int, f_px: float = 300.0) -> Camera:
    return replace(camera(side_px, side_px, f_px), lens=lens)


@pytest.mark.parametrize(
    ("seen", "limit_rad"),
    [
        (camera(), np.pi / 2),
        # Four times the distance of the farthest corner, half a pixel beyond the last: 50.5 px times sqrt(2).
        (behind(EQUIDISTANT, 100), 4 * 50.5 * np.sqrt(2) / 300),
        (behind(EQUIDISTANT, 200), 4 * 100.5 * np.sqrt(2) / 300),
        # Beyond 176 deg the antipode is near.
        (behind(EQUIDISTANT, 1000), np.deg2rad(176.0)),
        # The largest distance from the axis: where 1 - 0.9 a^2 is 0.
        (behind(Lens("fisheye", (-0.3, 0.0, 0.0, 0.0)), 1000), np.sqrt(1 / 0.9)),
        # Tangents have no position at 90 deg.
        (behind(Lens("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)), 1000), np.deg2rad(89.5)),
    ],
)
def test_stars_are_drawn_up_to_the_limit_of_the_lens_or_far_outside(seen: Camera, limit_rad: float) -> None:
    assert view_limit_rad(seen) == pytest.approx(limit_rad, rel=1e-3)


@pytest.mark.parametrize("margin_px", [1.0, 7.9, 8.1, 16.0, 17.0, 31.0])
def test_the_view_with_a_margin_holds_it_and_hardly_more(margin_px: float) -> None:
    corner_px = 100 * np.sqrt(2)
    seen = behind(EQUIDISTANT, 200)
    # Rounded up to 8 px, so that few cameras are computed.
    least, most = (corner_px + np.sqrt(2) * px for px in (margin_px, margin_px + 8))
    assert least / 300 - 1e-6 <= view_radius_rad(seen, margin_px) <= most / 300
    pinhole = camera(200, 200, 300.0)
    angle_rad = np.arctan(corner_px / 300) + np.arctan(margin_px / 300)
    assert view_radius_rad(pinhole, margin_px) == pytest.approx(angle_rad, rel=1e-9)
    oblong = replace(pinhole, fx_px=250.0)
    corner_rad = np.arctan(np.hypot(100 / 250, 100 / 300))
    assert view_radius_rad(oblong, margin_px) == pytest.approx(corner_rad + np.arctan(margin_px / 250), rel=1e-9)
