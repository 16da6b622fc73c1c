"""The fixed pattern of a sensor: what a camera's seed decides, and measured maps."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from glstar.camera.sensor.pixelpattern import PixelPattern, read_map
from glstar.errors import ConfigError
from tests.support.photofiles import packed_tiff

SIZE_PX = (1000, 500)
PATTERN = PixelPattern(camera_seed=3, hot_pixels_per_mpx=2000.0, stuck_fraction=0.4, dead_pixels_per_mpx=100.0)


def test_a_camera_has_its_density_of_defects_at_distinct_pixels() -> None:
    defects = PATTERN.defects(*SIZE_PX)

    assert len(defects.x_px) == 1050
    assert defects.is_dead.sum() == 50
    assert len(set(zip(defects.x_px.tolist(), defects.y_px.tolist(), strict=True))) == 1050
    stuck = defects.offset_e > 0
    assert not (stuck & defects.is_dead).any()
    assert stuck.sum() / 1000 == pytest.approx(0.4, abs=0.05)
    hot = defects.dark_factor[defects.dark_factor > 1]
    assert len(hot) + stuck.sum() == 1000
    assert hot.min() >= 10
    assert hot.max() <= 1000
    # Density falling with the square between 10 and 1000: half of them are below 1 / (0.1 - 0.0495) = 19.8.
    assert np.median(hot) == pytest.approx(19.8, rel=0.1)


def test_a_camera_keeps_its_defects_and_another_has_others() -> None:
    one, again, other = (
        replace(PATTERN, camera_seed=seed, dsnu_fraction=0.3).dark_e(*SIZE_PX, 10.0) for seed in (3, 3, 4)
    )

    np.testing.assert_array_equal(one, again)
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.01


def test_dark_current_is_log_normal_with_its_mean() -> None:
    above = PixelPattern(dsnu_fraction=0.3).dark_e(*SIZE_PX, 10.0)

    assert above.mean() == pytest.approx(0.0, abs=4 * 3 / np.sqrt(above.size))
    # Variance of a log-normal distribution of mean 1: exp(s^2) - 1.
    assert above.std() == pytest.approx(10 * np.sqrt(np.expm1(0.09)), rel=0.01)


def test_hot_pixels_grow_with_the_dark_current_and_stuck_ones_do_not() -> None:
    defects = PATTERN.defects(*SIZE_PX)
    cold, warm = (PATTERN.dark_e(*SIZE_PX, dark_e)[defects.y_px, defects.x_px] for dark_e in (1.0, 3.0))
    stuck = defects.offset_e > 0

    np.testing.assert_allclose(warm[stuck], cold[stuck], rtol=1e-6)
    np.testing.assert_allclose(warm[~stuck], 3 * cold[~stuck], rtol=1e-6)


def test_the_response_scatters_and_dead_pixels_have_none() -> None:
    pattern = replace(PATTERN, prnu_fraction=0.008)
    deviation = pattern.response(*SIZE_PX)
    defects = pattern.defects(*SIZE_PX)

    assert (deviation[defects.y_px[defects.is_dead], defects.x_px[defects.is_dead]] == -1).all()
    assert (deviation == -1).sum() == 50
    assert deviation[deviation > -1].std() == pytest.approx(0.008, rel=0.01)


def test_maps_of_every_format_are_read(tmp_path: Path) -> None:
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    np.save(tmp_path / "map.npy", pixels)
    tifffile.imwrite(tmp_path / "map.tiff", pixels)
    cv2.imwrite(str(tmp_path / "map.png"), pixels)
    fits = pytest.importorskip("astropy.io.fits")
    fits.writeto(tmp_path / "map.fits", pixels)

    for file in tmp_path.iterdir():
        np.testing.assert_array_equal(read_map(str(file)), pixels)


@pytest.mark.parametrize("seed", range(4))
def test_a_map_of_packed_samples_has_the_digital_numbers_of_the_sensor(tmp_path: Path, seed: int) -> None:
    case = packed_tiff(np.random.default_rng(seed))
    (tmp_path / "dark.tiff").write_bytes(case.content)

    np.testing.assert_array_equal(read_map(str(tmp_path / "dark.tiff")), case.grey)


@pytest.mark.parametrize("photometric", ["minisblack", "miniswhite"])
def test_a_map_of_single_bits_is_read(tmp_path: Path, photometric: str) -> None:
    is_dead = np.zeros((64, 96), np.bool_)
    is_dead[3, 4] = True
    stored = is_dead if photometric == "minisblack" else ~is_dead
    tifffile.imwrite(tmp_path / "dead.tiff", stored, photometric=photometric)

    np.testing.assert_array_equal(read_map(str(tmp_path / "dead.tiff")) != 0, is_dead)


def test_a_map_of_floating_point_keeps_its_numbers(tmp_path: Path) -> None:
    pixels = np.linspace(-1.5, 70000.25, 12, dtype=np.float32).reshape(3, 4)
    cv2.imwrite(str(tmp_path / "hot.tiff"), pixels)

    np.testing.assert_array_equal(read_map(str(tmp_path / "hot.tiff")), pixels)


@pytest.mark.parametrize("name", ["dark.npy", "dark.png", "dark.tiff", "dark.fits"])
def test_an_empty_map_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()

    with pytest.raises(ConfigError, match=f"cannot be used: .*{name}: "):
        PixelPattern(dark_frame=str(tmp_path / name)).require_size(*SIZE_PX)


def test_a_flat_field_gives_the_response_of_each_pixel_without_its_vignetting(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 300))
    response = 1 + 0.01 * np.random.default_rng(0).standard_normal(x.shape)
    np.save(tmp_path / "flat.npy", 20000 * (1 - 0.2 * (x**2 + y**2)) * response)

    deviation = PixelPattern(flat_field=str(tmp_path / "flat.npy")).response(400, 300)

    inside = (slice(40, -40), slice(40, -40))
    np.testing.assert_allclose(deviation[inside], (response - 1)[inside], rtol=0, atol=0.003)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (np.zeros((3, 4)), "has 4 x 3 px and the camera 1000 x 500"),
        (np.zeros(3), "one channel"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(tmp_path: Path, content: np.ndarray | None, message: str) -> None:
    file = tmp_path / "map.npy"
    if content is not None:
        np.save(file, content)

    with pytest.raises(ConfigError, match=message) as refused:
        PixelPattern(dark_frame=str(file)).require_size(*SIZE_PX)

    assert refused.value.key == "sensor.dark_frame"


def test_dead_pixels_lie_anywhere_among_the_defects() -> None:
    # With as many defects as pixels, the places of the dead ones are a random half: 500 +- 9 on average.
    every = PixelPattern(camera_seed=1, hot_pixels_per_mpx=5e5, dead_pixels_per_mpx=5e5).defects(1000, 1)
    assert sorted(every.x_px.tolist()) == list(range(1000))
    assert every.x_px[every.is_dead].mean() == pytest.approx(499.5, rel=0, abs=60)
