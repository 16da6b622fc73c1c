"""Photon transfer by hand: each number and limit from both sides, on small images."""

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.sensor.photontransfer import (
    PhotonTransfer,
    _gain,
    _half_variance,
    _prnu,
    images_in,
    measure_darks,
    photon_transfer,
)
from glstar.errors import CalibrationError


def photographs(images: list[np.ndarray]) -> list[Photograph]:
    return [Photograph(Path(f"{k}.png"), image.astype(float), 12, "grey", None) for k, image in enumerate(images)]


def transfer(**given: object) -> PhotonTransfer:
    """Return measured numbers, all of them different."""
    numbers = {
        "bit_depth": 12,
        "black_level_dn": 250.0,
        "read_noise_dn": 6.0,
        "dn_per_e": 1.5,
        "dn_per_e_error": 0.02,
        "dark_frame_dn": np.full((3, 4), 250.5, np.float32),
        "flat_field": np.full((3, 4), 0.75, np.float32),
        "is_dead": np.arange(12).reshape(3, 4) == 6,
        "hot": 17,
        "prnu_fraction": 0.008,
        "dark_frames": 8,
        "flat_fields": 6,
    }
    return PhotonTransfer(**numbers | given)


def test_the_keys_of_a_sensor_follow_from_the_measured_numbers() -> None:
    found = transfer()
    keys = {
        "noise": "electrons",
        "bit_depth": 12,
        "black_level_dn": 250.0,
        "dark_current_e_per_s": 0.0,
        "hot_pixels_per_mpx": 0.0,
        "gain_dn_per_e": 1.5,
        "analogue_gain": 1.0,
        "full_well_e": (4095 - 250) / 1.5,
        "read_noise_before_gain_e": 4.0,
        "read_noise_after_gain_e": 0.0,
    }
    assert found.keys == keys
    assert found.read_noise_e == 4.0
    maps = {"dark_frame": "s.dark.tiff", "flat_field": "s.flat.tiff", "defect_map": "s.defects.png"}
    assert found.to_json("s") == {
        **keys,
        "dn_per_e_error": 0.02,
        "read_noise_dn": 6.0,
        "prnu_fraction": 0.008,
        "hot_pixels": 17,
        "dead_pixels": 1,
        "dark_frames": 8,
        "flat_fields": 6,
        **maps,
    }
    files = found.files("s")
    assert set(files) == {"s.toml", *maps.values()}
    text = files["s.toml"].decode()
    assert text.startswith("# From dark frames and flat fields by glstar camera calibrate.\n[sensor]\n")
    assert tomllib.loads(text)["sensor"] == keys | maps
    assert text.endswith("\n")
    decoded = cv2.imdecode(np.frombuffer(files["s.defects.png"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded.tolist() == [[0] * 4, [0, 0, 255, 0], [0] * 4]
    flat = cv2.imdecode(np.frombuffer(files["s.flat.tiff"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert (flat.dtype, flat.tolist()) == (np.float32, [[0.75] * 4] * 3)
    bare = transfer(dn_per_e=None, flat_field=None, is_dead=np.zeros((3, 4), bool))
    assert (bare.read_noise_e, bare.keys) == (None, dict(list(keys.items())[:5]))
    assert set(bare.files("t")) == {"t.toml", "t.dark.tiff"}


def test_half_the_variance_of_a_difference_leaves_out_far_values() -> None:
    values = np.array([[3.0, 5.0, 4.0, 8.0], [1.0, 3.5, 2.5, 6.0]])
    assert _half_variance(values) == pytest.approx(np.var(values) / 2, rel=1e-12)
    usable = np.array([[True] * 4, [False, True, True, True]])
    assert _half_variance(values, usable) == pytest.approx(np.var(values[usable]) / 2, rel=1e-12)
    # Values beyond six standard deviations and one DN of the mean do not count.
    rng = np.random.default_rng(1)
    noise = rng.choice([-1.0, 1.0], 400)
    for far_dn, counts in ((6.9, True), (8.2, False)):
        every = np.append(noise, far_dn)
        assert (abs(far_dn - every.mean()) < 6 * every.std() + 1) == counts
        assert _half_variance(every) == pytest.approx((np.var(every) if counts else np.var(noise)) / 2, rel=1e-12)


def test_the_gain_is_the_weighted_slope_of_variance_over_mean() -> None:
    rng = np.random.default_rng(2)
    dark = rng.normal(100, 5, (60, 80))
    usable = np.ones(dark.shape, bool)
    usable[3, 4] = False
    variance_dark = 9.0
    # Three pairs at different levels, in no order, one of unequal brightness and one too bright.
    levels = [400.0, 1600.0, 404.0, 1000.0, 1590.0, 1004.0, 2200.0, 2246.0, 3200.0, 3210.0]
    flats = photographs([dark + level + rng.normal(0, np.sqrt(1.2 * level + 9), dark.shape) for level in levels])
    flats[0].pixels_dn[3, 4] = 1e5
    gain, error = _gain(flats, dark, variance_dark, usable)
    x, y = [], []
    for one, other in ((2, 0), (3, 5), (4, 1)):  # a bright pixel sorts the first after the third
        first, second = flats[one].pixels_dn[usable], flats[other].pixels_dn[usable]
        black = dark[usable]
        a, b = first.mean() - black.mean(), second.mean() - black.mean()
        x.append((a + b) / 2)
        y.append(np.var((first - black) - (second - black) * a / b) / 2 - variance_dark)
    x, y = np.array(x), np.array(y)
    slope = np.linalg.lstsq((x / (y + 9))[:, np.newaxis], y / (y + 9), rcond=None)[0][0]
    assert gain == pytest.approx(slope, rel=1e-4)
    assert gain == pytest.approx(1.2, rel=0.05)
    assert error == pytest.approx(np.sqrt(2 / usable.sum()) / np.sqrt(np.sum((x / (y + 9)) ** 2)), rel=1e-4)


@pytest.mark.parametrize(("other_dn", "used"), [(1000 * 0.981, True), (1000 * 0.979, False)])
def test_flat_fields_that_differ_by_two_percent_are_no_pair(other_dn: float, used: bool) -> None:
    rng = np.random.default_rng(3)
    flats = photographs([level + rng.normal(0, 30, (40, 50)) for level in (1000.0, other_dn)])
    for flat, level in zip(flats, (1000.0, other_dn), strict=True):
        flat.pixels_dn[:] += level - flat.pixels_dn.mean()
    given = flats, np.zeros((40, 50)), 0.5, np.ones((40, 50), bool)
    if used:
        assert _gain(*given)[0] > 0
    else:
        with pytest.raises(CalibrationError, match="no two flat fields have the same brightness below 80 %"):
            _gain(*given)


@pytest.mark.parametrize(("level_dn", "used"), [(0.79, True), (0.81, False)])
def test_flat_fields_above_four_fifths_of_the_range_are_not_used(level_dn: float, used: bool) -> None:
    rng = np.random.default_rng(4)
    dark = np.full((40, 50), 500.0)
    flats = photographs([dark + level_dn * (4095 - 500) + rng.normal(0, 30, dark.shape) for _ in range(2)])
    if used:
        assert _gain(flats, dark, 0.5, dark > 0)[0] > 0
    else:
        with pytest.raises(CalibrationError, match="no two flat fields have the same brightness below 80 %"):
            _gain(flats, dark, 0.5, dark > 0)


def test_flat_fields_without_further_noise_have_no_gain() -> None:
    rng = np.random.default_rng(5)
    flats = photographs([1000 + rng.normal(0, 3, (40, 50)) for _ in range(2)])
    with pytest.raises(CalibrationError, match="the flat fields are no brighter than the dark frames, or have no more"):
        _gain(flats, np.zeros((40, 50)), 20.0, np.ones((40, 50), bool))


def test_the_scatter_of_the_response_is_that_beyond_the_noise_of_the_mean_flat_field() -> None:
    rng = np.random.default_rng(6)
    response, above = 1 + 0.05 * rng.standard_normal((50, 60)), rng.uniform(800, 1000, (50, 60))
    usable = rng.random((50, 60)) < 0.9
    mean = above[usable].mean()
    noise2 = (1.5 * mean + 6.0**2) / 4 / mean**2
    expected = np.sqrt(np.var(response[usable]) - noise2)
    assert _prnu(response, above, 1.5, 4, usable, 6.0) == pytest.approx(expected, rel=1e-12)
    assert _prnu(np.ones((50, 60)), above, 1.5, 4, usable, 6.0) == 0.0


@pytest.mark.parametrize(("deviation_dn", "limit_dn"), [(0.2, 4.0), (0.8, 8 * 1.4826)])
def test_a_pixel_is_hot_ten_deviations_and_4_dn_above_the_median(deviation_dn: float, limit_dn: float) -> None:
    """Ordinary pixels scatter by the median deviation times 1.4826."""
    level = 100 + deviation_dn * np.resize([-1.5, -1.0, 0.0, 1.0, 1.5], (40, 50))
    level[5, 6], level[7, 8] = 100 + 0.97 * limit_dn, 100 + 1.03 * limit_dn
    if limit_dn == 4:
        level[5, 6] = 104.0
    found = photon_transfer(photographs([level, level, level]))
    assert (found.hot, found.black_level_dn, found.read_noise_dn) == (1, 100.0, 0.0)
    assert (found.flat_field, found.prnu_fraction, found.flat_fields, found.dark_frames) == (None, None, 0, 3)
    assert not found.is_dead.any()
    np.testing.assert_array_equal(found.dark_frame_dn, level.astype(np.float32))


def test_dark_frames_may_differ_by_their_read_noise_or_2_dn() -> None:
    rng = np.random.default_rng(7)
    for read_dn, limit_dn in ((0.5, 2.0), (5.0, 5.0)):
        frame = 200 + read_dn * rng.standard_normal((2, 200, 250))
        frame -= np.median(frame, axis=(1, 2), keepdims=True) - 200
        for drift, refused in ((0.96, False), (1.0, False), (1.04, True)):
            darks = photographs([frame[0], frame[1] + drift * limit_dn])
            if refused:
                with pytest.raises(CalibrationError, match=r"level of 0\.png is 200 DN, and that of 1\.png is"):
                    photon_transfer(darks)
            else:
                assert photon_transfer(darks).read_noise_dn == pytest.approx(
                    np.sqrt(max(read_dn**2 - 1 / 12, 0)), rel=0.02
                )


def test_images_of_a_folder_are_read_in_order_and_counted(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    for name, level, noise, count in (("d", 200.0, 40.0, 3), ("f", 1200.0, 60.0, 2)):
        (tmp_path / name).mkdir()
        for k in range(count):
            image = np.rint(level + noise * rng.standard_normal((80, 90))).astype(np.uint16)
            cv2.imwrite(str(tmp_path / name / f"{9 - k}.PNG"), image)
        (tmp_path / name / "notes.txt").write_text("none")
    assert [path.name for path in images_in(tmp_path / "d")] == ["7.PNG", "8.PNG", "9.PNG"]
    seen: list[tuple[int, int]] = []
    folders = tmp_path / "d", tmp_path / "f"
    found = measure_darks(*folders, bit_depth=12, on_image=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 5), (2, 5), (3, 5), (4, 5), (5, 5)]
    assert (found.dark_frames, found.flat_fields, found.bit_depth) == (3, 2, 12)
    # The variance grows from 1600 to 3600 DN^2 over 1000 DN.
    assert found.dn_per_e == pytest.approx(2.0, rel=0.1)
    assert found.read_noise_dn == pytest.approx(40.0, rel=0.03)
    assert measure_darks(tmp_path / "d", bit_depth=12).flat_fields == 0
    (tmp_path / "empty").mkdir()
    with pytest.raises(CalibrationError, match=r"empty: has no image: \.dng, \.fit, "):
        images_in(tmp_path / "empty")
    with pytest.raises(CalibrationError, match=r"notes\.txt: is no directory of images"):
        images_in(tmp_path / "d" / "notes.txt")


def test_images_of_different_depths_need_the_depth(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    for k, largest in enumerate((1023, 4095)):
        image = np.full((80, 90), 200, np.uint16)
        image[3, 4] = largest
        cv2.imwrite(str(tmp_path / "d" / f"{k}.png"), image)
    with pytest.raises(CalibrationError, match="the images have 10 and 12 bits; give --bit-depth"):
        measure_darks(tmp_path / "d")
    assert measure_darks(tmp_path / "d", bit_depth=12).bit_depth == 12
    image[3, 4] = 4095
    cv2.imwrite(str(tmp_path / "d" / "0.png"), image)
    assert measure_darks(tmp_path / "d").bit_depth == 12


def test_dark_frames_of_one_stated_exposure_are_used() -> None:
    darks = [replace(dark, exposure_s=0.5) for dark in photographs([even(200.0, 1), even(200.0, 2)])]
    assert photon_transfer(darks).dark_frames == 2
    assert photon_transfer([darks[0], replace(darks[1], exposure_s=None)]).dark_frames == 2


def test_a_flat_field_is_the_mean_above_the_dark_frame_over_its_mean() -> None:
    """A pixel is dead below half of the response of its surroundings; hot and dead pixels are not in the scatter."""
    rng = np.random.default_rng(9)
    dark = 150 + np.zeros((70, 80))
    dark[10, 11] = 400.0
    response = 1 + 0.02 * rng.choice([-1.0, 1.0], (70, 80))
    response[20, 30], response[40, 50] = 0.48, 0.52
    darks = photographs([dark + 3 * rng.standard_normal(dark.shape) for _ in range(2)])
    light = 1200 * response
    flats = photographs([dark + light + np.sqrt(1.5 * light) * rng.standard_normal(dark.shape) for _ in range(4)])
    found = photon_transfer(darks, flats)
    mean_dark = np.mean([one.pixels_dn for one in darks], axis=0)
    above = np.mean([one.pixels_dn for one in flats], axis=0) - mean_dark
    not_hot = np.ones(dark.shape, bool)
    not_hot[10, 11] = False
    np.testing.assert_allclose(found.flat_field, above / above[not_hot].mean(), rtol=1e-6)
    assert np.argwhere(found.is_dead).tolist() == [[20, 30]]
    assert (found.hot, found.dark_frames, found.flat_fields) == (1, 2, 4)
    assert found.dn_per_e == pytest.approx(1.5, rel=0.05)
    assert found.prnu_fraction == pytest.approx(np.std(response[not_hot & ~found.is_dead]), rel=0.06)
    assert found.read_noise_dn == pytest.approx(np.sqrt(9 - 1 / 12), rel=0.03)


def even(level: float, seed: int) -> np.ndarray:
    """Return whole numbers whose mean is exactly a level."""
    rng = np.random.default_rng(seed)
    half = rng.integers(-60, 61, 1000)
    return level + np.concatenate([half, -half]).reshape(40, 50)


@pytest.mark.parametrize(
    ("levels", "dark_dn", "used"),
    [
        ((1000.0, 980.0), 0.0, True),  # 2 % exactly
        ((3295.0, 3295.0), 95.0, False),  # 80 % of the range of 4000 DN exactly
        ((3294.0, 3294.0), 95.0, True),
        ((95.0, 95.0), 95.0, False),  # no light
    ],
)
def test_limits_of_flat_fields_are_exact(levels: tuple[float, float], dark_dn: float, used: bool) -> None:
    given = photographs([even(level, k) for k, level in enumerate(levels)]), np.full((40, 50), dark_dn), 0.5
    if used:
        assert _gain(*given, np.ones((40, 50), bool))[0] > 0
    else:
        with pytest.raises(CalibrationError, match="no two flat fields have the same brightness below 80 %"):
            _gain(*given, np.ones((40, 50), bool))


def test_a_gain_of_zero_is_refused() -> None:
    one, other = even(1000.0, 1), even(1000.0, 2)
    with pytest.raises(CalibrationError, match="the flat fields are no brighter than the dark frames"):
        _gain(photographs([one, other]), np.zeros((40, 50)), _half_variance(one - other), np.ones((40, 50), bool))
