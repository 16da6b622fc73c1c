"""Detected stars: which peaks are stars, hot pixels, at the edge or shapeless, on small drawn images."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.calibrate.photo import detection as module
from glstar.calibrate.photo.detection import (
    _CLIPPED_STD,
    Background,
    DetectedStars,
    SkyLevel,
    _classified,
    _clipped_moments,
    _lit_tiles,
    _peaks,
    detect_stars,
    tile_statistics,
)
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import draw_stars

SHAPE = (120, 200)


def stars_of(**more: object) -> DetectedStars:
    two = np.array([9.0, 4.0, 6.0])
    usual = {
        "xy_px": np.array([[1.0, 2], [3, 4], [5, 6]]), "peak_dn": 10 * two, "sigma_px": two, "noise_dn": two[::-1],
        "saturated": two > 5, "psf_sigma_px": 1.3, "background": None, "sky": SkyLevel(1.0, 2.0, 3.0, 4, 0.5),
        "drawn_out_px": 0.0, "saturated_fraction": 0.1, "hot_pixels": 1, "at_the_edge": 2, "shapeless": 3,
    }  # fmt: skip
    return DetectedStars(**usual | more)


def test_a_bright_or_a_trailed_image_is_remarked() -> None:
    assert stars_of().quality_note == ""
    assert stars_of(saturated_fraction=0.2).quality_note == ""
    bright = " (21% of the image is saturated: use a shorter exposure, under a dark sky)"
    assert stars_of(saturated_fraction=0.208, drawn_out_px=4.0).quality_note == bright
    trails = " (the stars are trails of about 7 px: use a shorter exposure, or hold the camera still)"
    assert stars_of(drawn_out_px=7.4).quality_note == trails


def test_stars_are_removed_from_all_lists() -> None:
    stars = stars_of()
    kept = stars.without(np.array([False, True, False]))
    assert (len(stars), len(kept)) == (3, 2)
    assert kept.xy_px.tolist() == [[1, 2], [5, 6]]
    for name in ("peak_dn", "sigma_px", "noise_dn", "saturated"):
        assert getattr(kept, name).tolist() == getattr(stars, name)[[0, 2]].tolist()
    assert (kept.psf_sigma_px, kept.hot_pixels, kept.sky) == (1.3, 1, stars.sky)
    np.testing.assert_allclose(stars.signal_to_noise, [90 / 6, 40 / 4, 60 / 9], rtol=1e-12)


def classified(
    sigma_px: float = 1.0, **changes: object
) -> tuple[list[bool], list[bool], list[bool], list[list[float]]]:
    """Classify one peak at (50, 40) and return whether it is hot, at the edge and shaped, and its position."""
    usual = {"x": 50.0, "y": 40.0, "peak": 100.0, "width": 1.0, "converged": True, "saturated": False, "noise": 2.0}
    one = SimpleNamespace(**usual | {"shift": (0.0, 0.0), "patch": ()} | changes)
    usable = np.ones(SHAPE, bool)
    for rows, columns in one.patch:
        usable[rows, columns] = False
    xy = np.array([[one.x, one.y]])
    fixed = SimpleNamespace(xy_px=xy + one.shift, peak_dn=np.array([one.peak]), converged=np.array([one.converged]))
    free = SimpleNamespace(sigma_px=np.array([one.width]))
    found = _classified(xy, free, fixed, usable, np.array([one.saturated]), np.array([one.noise]), sigma_px)
    position, hot, edge, shaped = (part.tolist()[0] for part in found)
    return hot, edge, shaped, position


def test_narrow_bright_peaks_are_hot_pixels() -> None:
    assert classified() == (False, False, True, [50.0, 40.0])
    # Half the usual width, and at least a quarter of a pixel.
    assert [classified(width=width)[0] for width in (0.49, 0.51)] == [True, False]
    assert [classified(0.4, width=width)[0] for width in (0.24, 0.26)] == [True, False]
    assert [classified(2.0, width=width)[0] for width in (0.98, 1.02)] == [True, False]
    # Of ten times the noise; saturated stars have no width.
    assert [classified(width=0.3, peak=peak)[0] for peak in (19.6, 20.4)] == [False, True]
    assert not classified(width=0.3, saturated=True)[0]


def test_peaks_within_two_widths_of_the_edge_are_left_out() -> None:
    margin = 2 * 1.5 + 0.5
    for x, y, inside in (
        (margin - 0.1, 40, False), (margin + 0.1, 40, True), (199 - margin + 0.1, 40, False),
        (199 - margin - 0.1, 40, True), (50, margin - 0.1, False), (50, margin + 0.1, True),
        (50, 119 - margin + 0.1, False), (50, 119 - margin - 0.1, True),
    ):  # fmt: skip
        assert classified(1.5, width=1.5, x=float(x), y=float(y))[1] is not inside


def test_a_star_has_a_converged_fit_near_its_peak_and_a_usual_width() -> None:
    assert [classified(**changes)[2] for changes in ({"converged": False}, {"peak": 0.0}, {"peak": -3.0})] == [
        False
    ] * 3
    assert [classified(width=width)[2] for width in (2.94, 3.06)] == [True, False]
    assert [classified(2.0, width=width)[2] for width in (5.88, 6.12)] == [True, False]
    # A width and a pixel and a half; four widths more for a saturated star.
    assert [classified(shift=(0.8 * r, 0.6 * r))[2] for r in (2.45, 2.55)] == [True, False]
    assert [classified(shift=(0.8 * r, 0.6 * r), saturated=True)[2] for r in (6.4, 6.6)] == [True, False]
    assert classified(2.0, shift=(3.4, 0.0), width=2.0)[2]
    assert classified(shift=(0.5, -0.25))[3] == [50.5, 39.75]
    assert classified(width=9.0, saturated=True)[2]
    # A very bright star has the position of its patch, if that is compact.
    star = {"saturated": True, "converged": False, "shift": (9.0, 9.0)}
    assert classified(**star, patch=[(slice(37, 44), slice(47, 54))]) == (False, False, True, [50.0, 40.0])
    assert classified(**star, patch=[(slice(39, 42), slice(40, 61))])[2] is False
    assert classified(**star)[2] is False


def background_of(noise_dn: float = 2.0) -> Background:
    ones = np.ones(SHAPE)
    lit = ones > 0
    lit[:, 180:] = False
    return Background(20 * ones, noise_dn * ones, lit, lit)


def test_peaks_are_significant_maxima_the_highest_first() -> None:
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 2.0, SHAPE)
    xy = np.array([[30.0, 30], [60, 80], [100, 40], [103, 40], [140, 60], [190, 60]])
    peak = np.array([60.0, 90, 200, 100, 30, 300])
    above = noise + draw_stars(SHAPE, xy, peak, 1.2)
    usable = np.ones(SHAPE, bool)
    found = _peaks(above, background_of(), usable, 1.2)
    # The neighbour three px away is on the slope of its star; where the lens casts no light only hot pixels are.
    smooth = cv2.GaussianBlur(above / 2.0, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
    significance = smooth / np.median(tile_statistics(smooth)[1])
    expected = []
    for y in range(SHAPE[0]):
        for x in range(180):
            near = significance[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            if significance[y, x] == near.max() and significance[y, x] > 5:
                expected.append((float(significance[y, x]), [float(x), float(y)]))
    assert found.tolist() == [at for _, at in sorted(expected, reverse=True)]
    assert found[0].tolist() in ([100, 40], [101, 40])
    assert [60.0, 80.0] in found.tolist()
    assert 4 <= len(found) <= 6
    # Wide stars hide wider surroundings; narrow ones at least a pixel.
    spots = np.zeros(SHAPE)
    spots[40, [40, 44, 60, 62]] = [900, 800, 700, 600]
    flat = replace(background_of(), is_lit=np.ones(SHAPE, bool))
    fine = spots + 0.01 * noise
    counts = {
        sigma: [[40, 40] in p, [44, 40] in p]
        for sigma in (0.4, 0.8)
        for p in [_peaks(fine, flat, usable, sigma).tolist()]
    }
    assert counts[0.4] == [True, True]
    # Of narrow stars the surroundings are the eight neighbours: all of a cross, two px from its middle, are found.
    cross = np.array([[60, 40], [60, 42], [60, 38], [62, 40], [58, 40]])
    spots = np.zeros(SHAPE)
    spots[cross[:, 0], cross[:, 1]] = [500, 900, 880, 860, 840]
    found = _peaks(spots + 0.01 * noise, flat, usable, 0.4).tolist()
    assert [[float(x), float(y)] in found for y, x in cross] == [True] * 5
    patch = np.zeros(SHAPE)
    patch[50:55, 70:75] = 500
    usable[50:55, 70:75] = False
    assert _peaks(patch + noise, flat, usable, 1.2)[0].tolist() == [72.0, 52.0]


def image_of(pixels: np.ndarray) -> Photograph:
    return Photograph(Path("a.png"), np.rint(np.clip(pixels, 0, 255)), 8, "grey", None)


def test_stars_are_detected_with_their_positions_widths_and_amplitudes() -> None:
    rng = np.random.default_rng(6)
    xy = np.array([(x, y) for x in range(20, 200, 30) for y in (20, 50, 80)], float) + rng.uniform(-3, 3, (18, 2))
    peak = np.linspace(60, 190, 18)[rng.permutation(18)]
    pixels = 20 + rng.normal(0, 2.0, SHAPE) + draw_stars(SHAPE, xy, peak, 1.4)
    pixels[105, [30, 90, 150]] += [180, 200, 220]  # hot pixels
    pixels += draw_stars(SHAPE, np.array([[1.0, 100.0]]), np.array([150.0]), 1.4)  # at the edge
    pixels += draw_stars(SHAPE, np.array([[120.0, 104.0], [180.0, 105.0]]), np.array([2000.0, 30.0]), 1.4)  # saturated
    found = detect_stars(image_of(pixels))
    assert (found.hot_pixels, found.at_the_edge) == (3, 1)
    assert len(found) == 20
    assert found.psf_sigma_px == pytest.approx(1.4, rel=0.03)
    assert found.saturated.tolist() == [True] + [False] * 19
    np.testing.assert_allclose(found.xy_px[0], [120, 104], rtol=0, atol=0.3)
    # The amplitude of a saturated star is a lower limit.
    assert found.peak_dn[0] == pytest.approx(255 - 20, abs=3)
    nearest = [int(np.hypot(*(xy - at).T).argmin()) for at in found.xy_px[1:19]]
    np.testing.assert_allclose(found.xy_px[1:19], xy[nearest], rtol=0, atol=0.15)
    assert set(nearest) == set(range(18))
    np.testing.assert_allclose(found.peak_dn[1:19], peak[nearest], rtol=0.06)
    assert (np.diff(found.peak_dn[1:]) <= 0).all()
    np.testing.assert_allclose(np.median(found.sigma_px[1:19]), 1.4, rtol=0.05)
    np.testing.assert_allclose(found.noise_dn, 2.0, rtol=0.2)
    np.testing.assert_allclose(found.signal_to_noise, found.peak_dn / found.noise_dn, rtol=1e-12)
    assert found.saturated_fraction == pytest.approx((np.rint(pixels) >= 0.98 * 255).mean())
    assert found.drawn_out_px == 0
    assert found.sky.mean_dn == pytest.approx(20, abs=0.4)
    assert found.sky.std_dn == pytest.approx(2.0, rel=0.1)
    assert found.sky.pixels < 0.97 * pixels.size
    assert found.background.level_dn.shape == SHAPE


def test_an_image_without_stars_has_its_sky() -> None:
    pixels = 20 + np.random.default_rng(8).normal(0, 2.0, SHAPE)
    pixels[:4] = 255
    found = detect_stars(image_of(pixels * (np.arange(200) >= 0)))
    nothing = detect_stars(image_of(20 + np.random.default_rng(8).normal(0, 2.0, SHAPE)))
    assert (len(nothing), nothing.xy_px.shape, nothing.psf_sigma_px) == (0, (0, 2), 1.0)
    assert nothing.saturated.dtype == np.bool_
    assert (nothing.hot_pixels, nothing.at_the_edge, nothing.shapeless, nothing.drawn_out_px) == (0, 0, 0, 0.0)
    assert nothing.saturated_fraction == 0.0
    assert 23500 < nothing.sky.pixels < 24000  # without three sigma and more
    assert (nothing.sky.mean_dn, nothing.sky.std_dn) == (pytest.approx(20, abs=0.1), pytest.approx(2, rel=0.03))
    assert found.saturated_fraction == pytest.approx(4 / 120)
    assert len(found) == 0


def test_the_elongation_of_a_field_is_that_of_its_bright_stars(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(9)
    xy = np.array([(x, y) for x in range(20, 200, 26) for y in (24, 54, 84)], float)
    peak = np.where(np.arange(21) % 3, 60.0 + 9 * np.arange(21)[::-1] % 100, 30.0)
    image = image_of(20 + rng.normal(0, 2.0, SHAPE) + draw_stars(SHAPE, xy, peak, 1.4))
    asked = []

    def drawn_out(above, usable, at, sigma_px):
        asked.append(at)
        return next(answers)

    monkeypatch.setattr(module, "drawn_out_px", drawn_out)
    # The stars decide; where they are too few, all peaks; 0 if these are too few, too.
    for given, expected, count in (([3.5], 3.5, 1), ([None, 2.5], 2.5, 2), ([None, None], 0.0, 2), ([0.0], 0.0, 1)):
        asked.clear()
        answers = iter(given)
        assert detect_stars(image).drawn_out_px == expected
        assert len(asked) == count
    # Those of twenty times the noise, the brightest first.
    nearest = [int(np.hypot(*(xy - at).T).argmin()) for at in asked[0]]
    assert set(nearest) == set(np.flatnonzero(np.arange(21) % 3).tolist())
    assert (np.diff(peak[nearest]) < 8).all()


def test_saturated_stars_are_sorted_by_the_size_of_their_patches() -> None:
    xy = np.array([[40.0, 60.0], [100.0, 60.0], [160.0, 60.0], [70.0, 22.0], [130.0, 98.0]])
    peak = np.array([900.0, 6000.0, 2500.0, 150.0, 200.0])
    pixels = 20 + np.random.default_rng(3).normal(0, 2.0, SHAPE) + draw_stars(SHAPE, xy, peak, 1.4)
    found = detect_stars(image_of(pixels))
    assert np.rint(found.xy_px / 10).astype(int).tolist() == [[10, 6], [16, 6], [4, 6], [13, 10], [7, 2]]
    assert found.saturated.tolist() == [True] * 3 + [False] * 2


def test_clipping_begins_with_the_quartiles_and_ends_after_five_rounds() -> None:
    values = np.sort(np.random.default_rng(2).exponential(10.0, 4000) ** 1.6).astype(np.float32)
    low, middle, high = np.quantile(values.astype(float), (0.25, 0.5, 0.75))
    mean, std, means = middle, (high - low) / 1.349, []
    for _ in range(6):
        kept = values[np.abs(values - mean) <= 3 * std].astype(float)
        mean, std = kept.mean(), kept.std() / _CLIPPED_STD
        means.append((mean, std))
    # It has not converged: one more round would change it.
    assert abs(means[5][0] - means[4][0]) > 0.02
    assert _clipped_moments(values) == pytest.approx(means[4], rel=1e-4)
    # The width of the Gaussian whose part within three sigma has the standard deviation of those kept.
    z = np.linspace(-3, 3, 200_001)
    weight = np.exp(-(z**2) / 2)
    assert pytest.approx(np.sqrt((weight * z**2).sum() / weight.sum()), rel=1e-4) == _CLIPPED_STD


def test_a_ring_and_three_dark_corners_are_no_image_circle() -> None:
    rows, columns = np.indices((24, 32))
    radius = np.hypot(rows - 11.5, columns - 15.5)
    noise = np.ones((24, 32))
    disc = np.where(radius < 11, 100.0, 2.0)
    assert not _lit_tiles(disc, noise).all()
    assert _lit_tiles(np.where(radius < 6, 2.0, disc), noise).all()
    for row in (0, -1):
        for column in (0, -1):
            lamp = disc.copy()
            lamp[row, column] = 60.0
            assert _lit_tiles(lamp, noise).all()
    # A rim of a fifth of the brightness is neither, and belongs to what a lens casts light on.
    rim = np.where((radius >= 11) & (radius < 12), 20.0, disc)
    np.testing.assert_array_equal(_lit_tiles(rim, noise), rim > 10)
    wide = np.where((radius >= 7) & (radius < 11), 20.0, disc)
    assert _lit_tiles(wide, noise).all()


def test_tiles_are_interpolated_after_a_median_of_three() -> None:
    tiles = np.array([[1.0, 2, 3, 4], [5, 90, 7, 8], [9, 10, 11, 12]])
    for count, filtered in ((3, True), (2, False)):
        some = tiles[:count]
        shape = (64 * count - 20, 64 * 4 - 9)
        spread = module._spread(some, shape)
        assert spread.shape == shape
        padded = np.pad(some, 1, mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(count, 4, 9)
        expected = np.median(around, axis=2) if filtered else some
        # Between the middles of two tiles it is their mean.
        assert spread[5, 63:65].mean() == pytest.approx(expected[0, :2].mean(), rel=1e-6)
        assert spread[63:65, 5].mean() == pytest.approx(expected[:2, 0].mean(), rel=1e-6)
        assert spread[5, 127:129].mean() == pytest.approx(expected[0, 1:3].mean(), rel=1e-6)
        assert spread[0, 0] == expected[0, 0]


def test_a_sky_is_cut_off_where_it_is_dark_and_many_pixels_are_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_clipped_gaussian", lambda image, starless: (0.25, 0.5))
    starless = np.ones(SHAPE, bool)
    starless[:, :100] = False

    def level(level_dn: float, zeros: int) -> SkyLevel:
        pixels = np.random.default_rng(1).normal(level_dn, 2.0, SHAPE)
        pixels = np.maximum(pixels, 0.5)
        pixels.ravel()[np.flatnonzero(starless)[:zeros]] = 0.0
        background = replace(background_of(), level_dn=np.full(SHAPE, level_dn))
        return module.sky_level(pixels, background, starless)

    # 12 000 pixels without stars: 0.5 % are 60.
    assert [level(7.0, zeros).mean_dn == 0.25 for zeros in (60, 61)] == [False, True]
    assert (level(7.0, 61).std_dn, level(7.0, 61).clipped_fraction) == (0.5, pytest.approx(61 / 12000))
    assert level(7.0, 61).pixels == 12000
    # Four standard deviations of 2 DN above 0.
    assert [level(one, 61).mean_dn == 0.25 for one in (7.8, 8.2)] == [True, False]
    assert level(8.2, 61).clipped_fraction == 0
    few = level(30.0, 0)
    assert few.mean_dn == pytest.approx(30, abs=0.1)
    assert few.std_dn == pytest.approx(np.sqrt(4 - 1 / 12), rel=0.03)
    assert few.unevenness_dn == 0
