"""From the noiseless signal to digital numbers: sky, noise, saturation, rounding."""

import numpy as np
import pytest

from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from tests.support.scenes import camera, stars_at


def dark(sensor: Sensor, lens=None, vmag: float = 30.0):
    """Return a scene with one star too faint to be visible."""
    return stars_at([[50.2, 40.7]], [vmag], sensor=sensor, lens=lens or camera(640, 480), n=4)


def test_the_noise_is_gaussian_with_the_sky_s_mean_and_deviation(renderer):
    pixels = renderer.render(dark(Sensor(sky_mean_dn=120.0, sky_std_dn=12.0)), seed=7).pixels.astype(float)
    n = pixels.size
    # Rounding adds a twelfth to the variance.
    deviation = np.sqrt(12.0**2 + 1 / 12)
    assert pixels.mean() == pytest.approx(120.0, abs=4 * deviation / np.sqrt(n))
    assert pixels.std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * n))
    standard = (pixels - pixels.mean()) / pixels.std()
    assert np.mean(standard**3) == pytest.approx(0.0, abs=4 * np.sqrt(6 / n))
    assert np.mean(standard**4) == pytest.approx(3.0, abs=4 * np.sqrt(24 / n))
    assert 4.0 < np.abs(standard).max() < 6.0  # the tails of a Gaussian, up to the maximum of 300 000 deviates


@pytest.mark.parametrize(("rows", "columns"), [(0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)])
def test_the_noise_of_neighbouring_pixels_is_uncorrelated(renderer, rows, columns):
    pixels = renderer.render(dark(Sensor(sky_mean_dn=120.0, sky_std_dn=12.0)), seed=7).pixels.astype(float)
    pixels -= pixels.mean()
    correlation = np.mean(pixels * np.roll(pixels, (rows, columns), (0, 1))) / pixels.var()
    assert abs(correlation) < 4 / np.sqrt(pixels.size)


def test_another_seed_gives_independent_noise(renderer):
    scene = dark(Sensor(sky_mean_dn=120.0, sky_std_dn=12.0))
    one, other = (renderer.render(scene, seed=seed).pixels.astype(float) for seed in (1, 2))
    correlation = np.corrcoef(one.ravel(), other.ravel())[0, 1]
    assert abs(correlation) < 4 / np.sqrt(one.size)


def test_the_same_seed_gives_the_same_bytes_on_another_context():
    scene = stars_at([[50.2, 40.7]], [0.0], sensor=Sensor(), lens=camera())
    images = []
    for _ in range(2):
        with GLRenderer.headless() as renderer:
            images.append(renderer.render(scene, seed=2**32 - 1).pixels.tobytes())
    assert images[0] == images[1]


def test_a_frame_does_not_depend_on_the_frames_before_it(renderer):
    first = stars_at([[50.2, 40.7], [90.1, 80.4]], [0.0, 2.0], sensor=Sensor(), lens=camera())
    other = stars_at([[99.2, 140.7]], [-1.0], sensor=Sensor(bit_depth=16), lens=camera(100, 80))
    alone = renderer.render(first, seed=3).pixels
    renderer.render(other, seed=4)
    np.testing.assert_array_equal(renderer.render(first, seed=3).pixels, alone)


def test_the_signal_is_rounded_to_the_nearest_digital_number(renderer):
    sensor = Sensor(sky_mean_dn=0.0, sky_std_dn=0.0)
    frame = renderer.render(stars_at([[50.2, 40.7]], [3.0], sensor=sensor, lens=camera()), seed=0, light=True)
    np.testing.assert_array_equal(frame.pixels, np.floor(frame.light_dn + 0.5).astype(np.uint8))


@pytest.mark.parametrize(
    ("bit_depth", "dtype", "limit"), [(8, np.uint8, 255), (12, np.uint16, 4095), (16, np.uint16, 65535)]
)
def test_a_bright_star_saturates_at_the_converter_s_limit(renderer, bit_depth, dtype, limit):
    sensor = Sensor(reference_peak_dn=1e6, bit_depth=bit_depth)
    pixels = renderer.render(stars_at([[50.2, 40.7]], [0.0], sensor=sensor, lens=camera()), seed=0).pixels
    assert pixels.dtype == dtype
    assert pixels.max() == limit
    assert pixels[41, 50] == limit


def test_row_0_is_the_top_and_column_0_the_left(renderer):
    sensor = Sensor(sky_std_dn=0.0)
    pixels = renderer.render(stars_at([[20.0, 10.0]], [4.0], sensor=sensor, lens=camera(100, 80)), seed=0).pixels
    assert pixels.shape == (80, 100)
    assert np.unravel_index(pixels.argmax(), pixels.shape) == (10, 20)


def test_no_two_rows_share_their_noise(renderer):
    """With a hash of x plus a hash of y, rows with similar hashes would have the same noise, shifted."""
    lens = camera(2000, 1500)
    pixels = renderer.render(dark(Sensor(sky_mean_dn=30000.0, sky_std_dn=3000.0, bit_depth=16), lens), seed=5).pixels
    # Four pixels in a row make one number: at most a few of three million of them are equal by chance.
    runs = np.lib.stride_tricks.sliding_window_view(pixels[:, :1984].astype(np.uint64), 4, axis=1)
    words = (runs * np.array([1, 65537, 65537**2 % 2**61, 65537**3 % 2**61], np.uint64)).sum(axis=-1).ravel()
    assert words.size - np.unique(words).size <= 3
