"""PNG files against OpenCV's decoder and against the entropy of their pixels."""

import cv2
import numpy as np
import pytest

from glstar.system.imagefiles import encode_png


def noise(mean_dn: float, sigma_dn: float, dtype: type = np.uint8) -> np.ndarray:
    drawn = np.random.default_rng(1).normal(mean_dn, sigma_dn, (300, 411))
    return np.rint(drawn).clip(0, np.iinfo(dtype).max).astype(dtype)


def entropy_bytes(pixels: np.ndarray) -> float:
    """Return Shannon's bound for pixels that are coded one by one."""
    probability = np.unique(pixels, return_counts=True)[1] / pixels.size
    return float(-(probability * np.log2(probability)).sum() * pixels.size / 8)


@pytest.mark.parametrize("sigma_dn", [0.0, 0.3, 0.5, 0.7, 3.0, 40.0])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_another_decoder_reads_the_same_pixels_with_and_without_runs(sigma_dn: float, dtype: type) -> None:
    pixels = noise(2.0, sigma_dn, dtype)
    read = cv2.imdecode(np.frombuffer(encode_png(pixels), np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == dtype
    assert np.array_equal(read, pixels)


@pytest.mark.parametrize("shape", [(1, 1), (1, 3), (2, 4), (5, 1), (70, 2)])
def test_the_smallest_images_are_read_back(shape: tuple[int, int]) -> None:
    pixels = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    assert np.array_equal(cv2.imdecode(np.frombuffer(encode_png(pixels), np.uint8), cv2.IMREAD_UNCHANGED), pixels)


def test_noise_takes_at_most_two_per_cent_more_than_its_entropy() -> None:
    pixels = noise(16.0, 3.0)
    assert entropy_bytes(pixels) < len(encode_png(pixels)) < 1.02 * entropy_bytes(pixels)


def test_an_image_without_noise_takes_a_hundredth_of_its_pixels() -> None:
    pixels = np.zeros((760, 1014), np.uint8)
    pixels[100:110, 200:210] = 200
    assert len(encode_png(pixels)) < pixels.size / 100


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_a_colour_image_is_read_back_as_red_green_and_blue(depth: type) -> None:
    pixels = np.random.default_rng(4).integers(0, np.iinfo(depth).max, (7, 5, 3)).astype(depth)
    read = cv2.imdecode(np.frombuffer(encode_png(pixels), np.uint8), cv2.IMREAD_UNCHANGED)
    assert read.dtype == depth
    assert np.array_equal(read, pixels[..., ::-1])
