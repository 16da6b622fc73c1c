"""Images scaled to the size of the simulated one, and rectified: hand-made pixels, and the projection of the lens."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.errors import CalibrationError
from glstar.images.decoding import FittedImage, fit, rectify
from tests.support.scenes import camera


@pytest.mark.parametrize(
    ("size", "into", "covered"),  # (width, height) px; left, top, right, bottom
    [
        ((40, 30), (80, 60), (0, 0, 80, 60)),
        ((40, 30), (80, 70), (0, 5, 80, 65)),
        ((40, 30), (91, 60), (5, 0, 85, 60)),  # 11 px beside it: 5 to the left, 6 to the right
        ((40, 30), (20, 31), (0, 8, 20, 23)),
        ((400, 1), (40, 30), (0, 14, 40, 15)),  # a tenth of a row is one row
        ((1, 400), (30, 40), (14, 0, 15, 40)),
    ],
)
def test_an_image_is_scaled_to_the_largest_size_that_fits_and_centred(size, into, covered) -> None:
    width, height = size
    found = fit(np.full((height, width), 77, np.uint16), *into)
    assert (found.left, found.top, found.right, found.bottom) == covered
    expected = np.zeros(into[::-1], np.uint16)
    expected[covered[1] : covered[3], covered[0] : covered[2]] = 77
    np.testing.assert_array_equal(found.pixels, expected)
    assert not found.pixels.flags.writeable
    scale = min(into[0] / width, into[1] / height)
    assert found.note == f"{width} x {height} px, scaled by {scale:.4g} to fit {into[0]} x {into[1]} px, centred"


def test_shrinking_averages_over_areas_and_enlarging_interpolates_between_the_edges() -> None:
    star = np.zeros((30, 30), np.uint16)
    star[10, 16] = 9000
    shrunk = fit(star, 10, 10).pixels
    assert (shrunk[3, 5], np.count_nonzero(shrunk)) == (1000, 1)
    ramp = np.tile(np.arange(0, 400, 40, dtype=np.uint16), (10, 1))
    enlarged = fit(ramp, 20, 20).pixels
    # The edges of both images are at the same place: pixel k of the larger one is at k / 2 - 1/4 of the smaller.
    expected = np.clip(np.arange(20) / 2 - 0.25, 0, 9) * 40
    np.testing.assert_allclose(enlarged, np.tile(expected, (20, 1)), rtol=0, atol=0.5)


@pytest.mark.parametrize(
    ("dtype", "brightest_dn", "full_scale_dn", "white_dn"),
    [
        (np.uint16, 4095, 4095, 4095),
        (np.uint16, 4096, 4095, 65535),  # a pixel exceeds the full scale
        (np.uint16, 100, 255, 65535),  # a sensor of 8 bits
        (np.uint16, 100, 256, 256),
        (np.uint8, 100, 4095, 255),
    ],
)
def test_a_file_of_sixteen_bits_may_hold_fewer(dtype, brightest_dn, full_scale_dn, white_dn) -> None:
    image = FittedImage(np.array([[0, brightest_dn]], dtype), 0, 0, 2, 1)
    assert image.white_dn == np.iinfo(dtype).max
    assert image.with_full_scale(full_scale_dn).white_dn == white_dn


@pytest.mark.parametrize("lens", [Lens("plumb_bob", (-0.25, 0.05, 0.001, 0.0, 0.0)), Lens("fisheye", (0.02, 0, 0, 0))])
def test_a_rectified_image_has_at_each_pixel_what_the_lens_recorded_of_its_direction(lens: Lens) -> None:
    """A plane of numbers, which interpolation keeps, in more rows than are computed at once."""
    distorted = replace(camera(70, 530, 260.0), lens=lens)
    x, y = np.meshgrid(np.arange(70.0), np.arange(530.0))
    plane = (3 * x + 2 * y + 50).astype(np.float32)
    rectified, pinhole = rectify(plane, distorted)
    assert (pinhole.lens, pinhole.K.tolist()) == (None, distorted.K.tolist())
    rays = np.stack([(x - pinhole.cx_px) / 260, (y - pinhole.cy_px) / 260, np.ones_like(x)], axis=-1)
    at_x, at_y = np.moveaxis(distorted.project(rays), -1, 0)
    inside = (at_x > 1) & (at_x < 67) & (at_y > 1) & (at_y < 527)
    assert inside.mean() > 0.5
    # OpenCV's cubic (a = -0.75) is 0.05 px off on a plane, and has 32 positions a pixel; a pixel is 2 or 3.
    np.testing.assert_allclose(rectified[inside], (3 * at_x + 2 * at_y + 50)[inside], rtol=0, atol=0.3)
    beside = (at_x < -2) | (at_x > 71) | (at_y < -2) | (at_y > 531)
    assert (rectified[beside] == 0).all()


def test_pixels_that_the_lens_does_not_show_are_zero() -> None:
    """r = f (a - 0.3 a^3) ends at 60.4 deg, where a pinhole of f = 50 px has its pixels 88 px from the axis."""
    narrow = replace(camera(300, 300, 50.0), lens=Lens("fisheye", (-0.3, 0.0, 0.0, 0.0)))
    rectified, _ = rectify(np.full((300, 300), 200, np.uint8), narrow)
    x, y = np.meshgrid(np.arange(300.0), np.arange(300.0))
    angle_rad = np.arctan(np.hypot(x - 149.5, y - 149.5) / 50)
    assert (rectified[angle_rad > 1.07] == 0).all()
    assert (rectified[angle_rad < 1.03] == 200).all()


def test_an_image_that_cannot_be_rectified_is_named() -> None:
    lens = replace(camera(70, 53, 60.0), lens=Lens("plumb_bob", (-0.25, 0.05, 0.0, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match="the image is 53 x 70 px and the camera 70 x 53"):
        rectify(np.zeros((70, 53), np.uint8), lens)
    with pytest.raises(CalibrationError, match="the image holds int32; rectify images of uint8"):
        rectify(np.zeros((53, 70), np.int32), lens)
    image = np.zeros((53, 70, 3), np.int16)
    assert rectify(image, replace(lens, lens=None))[0] is image
    assert rectify(image, lens)[0].shape == image.shape
    for width, fits in ((32766, True), (32767, False)):
        wide = replace(camera(width, 1, 60.0), lens=lens.lens)
        if fits:
            assert rectify(np.zeros((1, width), np.uint8), wide)[0].shape == (1, width)
        else:
            with pytest.raises(CalibrationError, match="32767 x 1 px is too large to be rectified"):
                rectify(np.zeros((1, width), np.uint8), wide)
