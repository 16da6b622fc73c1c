"""Stamps of trails and their centroids, against closed forms, every pixel and random noise."""

import numpy as np
import pytest

from glstar.compare.pairs import _centroid, _clipped, _middle
from glstar.compare.prediction import Stamp, stamp_of


def on_canvas(stamp: Stamp) -> np.ndarray:
    """Return the mask on a canvas of 80 x 60 px that begins 20 px left of the image and 20 px above it."""
    canvas = np.zeros((60, 80), dtype=bool)
    height, width = stamp.mask.shape
    canvas[stamp.top + 20 : stamp.top + 20 + height, stamp.left + 20 : stamp.left + 20 + width] = stamp.mask
    return canvas


@pytest.mark.parametrize("half_width_px", [2.0, 3.5])
@pytest.mark.parametrize("margin_px", [0, 4])
def test_a_stamp_holds_the_pixels_near_a_path(half_width_px: float, margin_px: int) -> None:
    start, end = np.array([-3.3, 4.7]), np.array([14.6, 10.2])
    stamp = stamp_of(np.array([start, end]), half_width_px, margin_px=margin_px)
    x_px, y_px = np.meshgrid(np.arange(-20, 60), np.arange(-20, 40))
    points = np.stack([x_px, y_px], axis=-1)
    along = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
    distance_px = np.linalg.norm(points - start - along[..., np.newaxis] * (end - start), axis=-1)
    canvas = on_canvas(stamp)
    # OpenCV draws lines of a whole number of pixels.
    assert canvas[distance_px < half_width_px - 0.75].all()
    assert not canvas[distance_px > half_width_px + 1.3].any()
    # The smallest rectangle besides the margin.
    assert (stamp.left, stamp.top) == (
        np.floor(-3.3 - half_width_px) - margin_px,
        np.floor(4.7 - half_width_px) - margin_px,
    )
    right, bottom = np.ceil(14.6 + half_width_px) + margin_px, np.ceil(10.2 + half_width_px) + margin_px
    assert stamp.mask.shape == (bottom - stamp.top + 1, right - stamp.left + 1)


@pytest.mark.parametrize(("left", "top"), [(3, 4), (-3, 4), (3, -4), (15, 4), (3, 11), (-2, -2)])
def test_a_stamp_is_clipped_to_the_image(left: int, top: int) -> None:
    mask = np.random.default_rng(1).random((12, 10)) < 0.6
    whole = Stamp(left, top, mask)
    clipped = _clipped(whole, (15, 20))
    is_image = np.zeros((60, 80), dtype=bool)
    is_image[20:35, 20:40] = True
    np.testing.assert_array_equal(on_canvas(clipped), on_canvas(whole) & is_image)
    assert clipped.inside((15, 20))
    is_inside = left >= 0 and top >= 0 and left + 10 <= 20 and top + 12 <= 15
    assert whole.inside((15, 20)) == is_inside
    image = np.arange(15 * 20).reshape(15, 20)
    rows, columns = np.nonzero(on_canvas(clipped))
    np.testing.assert_array_equal(clipped.of(image)[clipped.mask], image[rows - 20, columns - 20])


def test_the_middle_of_a_path_is_that_of_its_bounding_box() -> None:
    np.testing.assert_allclose(_middle(np.array([[1.0, 9.0], [2.0, 5.0], [7.0, 6.0]])), [4.0, 7.0], rtol=0, atol=1e-12)


def test_a_centroid_and_its_noise_are_those_of_noisy_stamps() -> None:
    rng = np.random.default_rng(2)
    stamp = Stamp(100, 50, np.hypot(*(np.indices((15, 25)) - np.array([[[7]], [[12]]]))) < 6.5)
    y_px, x_px = np.indices((15, 25))
    light = np.exp(-((x_px - 11.0) ** 2 + (y_px - 7.5) ** 2) / 8) * stamp.mask
    centre, noise_px = _centroid(light, stamp, 0.003)
    total = light.sum()
    expected = np.array([(light * x_px).sum(), (light * y_px).sum()]) / total + [100, 50]
    np.testing.assert_allclose(centre, expected, rtol=0, atol=1e-12)
    noisy = [_centroid(light + rng.normal(0, 0.003, light.shape) * stamp.mask, stamp, 0.0)[0] for _ in range(4000)]
    assert noise_px == pytest.approx(np.sqrt(np.sum((noisy - centre) ** 2, axis=1).mean()), rel=0.04)
