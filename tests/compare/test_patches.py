"""Detection of trails step by step: patches, points, strips along trails, and the fit of their ends."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import erf

from glstar.compare import detection
from glstar.compare.detection import (
    DetectedTrails,
    SubtractedImage,
    _followed,
    _measured,
    _point,
    _Strip,
    _Trail,
    _without_repeats,
    detect_trails,
)

SIGMA_PX = 1.4
# A window of 1.5 sigma across a Gaussian keeps this part of it.
KEPT = 1 / np.sqrt(1 + 1 / 1.5**2)


def sky(above_dn: np.ndarray, noise_dn: float = 2.0) -> SubtractedImage:
    above = above_dn.astype(np.float32)
    return SubtractedImage(above, np.full_like(above, noise_dn), np.ones(above.shape, bool))


def star(x: float, y: float, flux_dn: float, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    rows, columns = np.indices(shape)
    return flux_dn / (2 * np.pi * SIGMA_PX**2) * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * SIGMA_PX**2))


def test_a_point_has_the_place_and_the_flux_of_its_star() -> None:
    noisy = sky(star(30.3, 24.8, 5000.0))
    noisy.noise_dn[25, 30] = 3.5  # the noise at its place counts
    found = _point(noisy, np.array([31.5, 23.5]), SIGMA_PX)
    np.testing.assert_allclose(found.middle, [30.3, 24.8], rtol=0, atol=2e-3)
    np.testing.assert_array_equal(found.ends, [found.middle, found.middle])
    np.testing.assert_array_equal(found.centroid, found.middle)
    assert (found.flux, found.at_edge) == (pytest.approx(5000, rel=2e-3), False)
    # The noise under a star of this shape: sqrt(4 pi) sigma pixels.
    assert found.snr == pytest.approx(5000 / (3.5 * np.sqrt(4 * np.pi) * SIGMA_PX), rel=2e-3)


@pytest.mark.parametrize(
    ("x", "y", "is_found"),
    [
        *[(6.0, 30.0, True), (5.0, 30.0, False), (73.0, 30.0, True), (74.0, 30.0, False)],
        *[(40.0, 6.0, True), (40.0, 5.0, False), (40.0, 53.0, True), (40.0, 54.0, False)],
    ],
)
def test_a_point_lies_four_sigma_inside_of_the_image(x: float, y: float, is_found: bool) -> None:
    assert (_point(sky(star(x, y, 5000.0)), np.array([x, y]), SIGMA_PX) is not None) == is_found


def test_a_point_is_near_its_patch_and_bright() -> None:
    # At most two sigma and a pixel: 3.8 px.
    for off_px, is_found in ((3.6, True), (4.0, False)):
        image = sky(star(40.0, 30.0, 5000.0))
        assert (_point(image, np.array([40.0 + off_px * 0.6, 30.0 - off_px * 0.8]), SIGMA_PX) is not None) == is_found
    assert _point(sky(-star(40.0, 30.0, 5000.0)), np.array([40.0, 30.0]), SIGMA_PX) is None


def trail(flux: float, x: float, length_px: float = 0.0) -> _Trail:
    middle = np.array([x, 7.0])
    return _Trail(np.array([[x, 7], [x, 7 + length_px]]), middle, middle, flux, 1.0, at_edge=False)


def test_of_pieces_near_each_other_the_brightest_is_kept() -> None:
    bright, same, other = trail(50.0, 10.0), trail(40.0, 10 + 3 * SIGMA_PX), trail(30.0, 10 + 3 * SIGMA_PX + 0.1)
    assert _without_repeats([other, same, bright], SIGMA_PX) == [bright, other]
    # A tenth of the length of the fainter one is added.
    long, longer = trail(20.0, 10 + 3 * SIGMA_PX + 3.1, 30.0), trail(20.0, 10 + 3 * SIGMA_PX + 3.1, 32.0)
    assert _without_repeats([bright, long], SIGMA_PX) == [bright, long]
    assert _without_repeats([bright, longer], SIGMA_PX) == [bright]


def measured(monkeypatch: pytest.MonkeyPatch, rows: np.ndarray, columns: np.ndarray, weight) -> tuple | None:
    """Return what is done with a patch, and with which centre, axes and extent."""
    image = sky(np.zeros((70, 2100)))
    image.above_dn[rows, columns] = weight
    monkeypatch.setattr(detection, "_point", lambda _, centre, sigma_px: ("point", centre, sigma_px))
    monkeypatch.setattr(detection, "_followed", lambda _, *values: ("trail", *values))
    return _measured(image, columns.astype(float), rows.astype(float), SIGMA_PX)


def patch(length: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = (each.ravel() for each in np.indices((width, length)))
    return rows + 8, columns + 5


def test_a_patch_is_a_point_or_a_trail_by_its_extent_and_width(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, columns = np.array([10, 12, 14, 16, 18, 20, 22]), np.array([20, 23, 26, 29, 32, 35, 38])
    weight = np.array([1.0, 4, 2, 3, 5, 2, -7])
    kind, centre, axes, known_px, sigma_px = measured(monkeypatch, rows, columns, weight)
    points, light = np.column_stack([columns, rows]), np.maximum(weight, 0)
    np.testing.assert_allclose(centre, (light @ points) / light.sum(), rtol=0, atol=1e-9)
    along = (points - centre) @ axes[:, 1]
    np.testing.assert_allclose(np.abs(axes[:, 1]), np.array([3, 2]) / np.sqrt(13), rtol=0, atol=1e-3)
    assert (kind, sigma_px, known_px) == ("trail", SIGMA_PX, (pytest.approx(along.min()), pytest.approx(along.max())))
    # Six sigma and two widths of the smoothing are 11.4 px, from the first pixel to the last.
    for length, expected in ((12, "point"), (13, "trail")):
        assert measured(monkeypatch, *patch(length, 1), 1.0)[0] == expected
    # A point is passed with its centre.
    kind, centre, sigma_px = measured(monkeypatch, *patch(5, 3), 1.0)
    assert (kind, centre.tolist(), sigma_px) == ("point", [7.0, 9.0], SIGMA_PX)
    # The standard deviation across is at most three sigma, and more for a longer patch: 39 px have 0.38 px.
    for width, expected in ((15, "trail"), (16, None)):
        deviation = np.sqrt((width**2 - 1) / 12)
        assert (deviation < 3 * SIGMA_PX + 39**2 / 4000) == (expected is not None)
        found = measured(monkeypatch, *patch(40, width), 1.0)
        assert (found and found[0]) == expected
    for length, expected in ((2001, "trail"), (2002, None)):
        found = measured(monkeypatch, *patch(length, 1), 1.0)
        assert (found and found[0]) == expected
    assert measured(monkeypatch, *patch(20, 1), -1.0) is None
    assert measured(monkeypatch, *patch(20, 1), 0.0) is None


def followed(monkeypatch: pytest.MonkeyPatch, *fits: tuple | None, known_px=(-10.0, 12.0)) -> tuple:
    """Return the trail that is followed by given fits, and the extents with which strips were made."""
    asked, rest = [], list(fits)

    def around(_, centre, along, across, known_px, sigma_px):
        asked.append(known_px)
        assert (centre, along.tolist(), across.tolist(), sigma_px) == ("centre", [2.0, 4.0], [1.0, 3.0], SIGMA_PX)
        fitted = rest.pop(0) if len(rest) > 1 else rest[0]
        if fitted == "none":
            return None
        return SimpleNamespace(fitted=lambda _: fitted, trail=lambda one: ("trail", one))

    monkeypatch.setattr(_Strip, "around", around)
    monkeypatch.setattr(detection, "_point", lambda _, centre, __: ("point", centre))
    return _followed(None, "centre", np.array([[1.0, 2.0], [3.0, 4.0]]), known_px, SIGMA_PX), asked


def test_a_trail_is_followed_while_it_continues(monkeypatch: pytest.MonkeyPatch) -> None:
    # 2.8 px beyond the known ends it continues.
    near = -12.7, 14.7, 5.0
    assert followed(monkeypatch, near) == (("trail", near), [(-10.0, 12.0)])
    longer, last = (-12.9, 11.0, 5.0), (-14.0, 15.0, 6.0)
    found, asked = followed(monkeypatch, longer, last, last)
    assert (found, asked) == (("trail", last), [(-10.0, 12.0), (-12.9, 12.0), (-14.0, 15.0)])
    for side in (-1, 1):
        endless = (-200.0, 12.0, 5.0) if side < 0 else (-10.0, 200.0, 5.0)
        _, asked = followed(monkeypatch, endless, (-11.0, 13.0, 5.0))
        assert asked == [(-10.0, 12.0), endless[:2]]
    # At most twelve times.
    found, asked = followed(monkeypatch, *((-10.0 - 5 * k, 12.0, k) for k in range(1, 30)))
    assert (found, len(asked)) == (("trail", (-70.0, 12.0, 12)), 12)
    assert followed(monkeypatch, None)[0] is None
    assert followed(monkeypatch, "none")[0] is None
    assert followed(monkeypatch, longer, None)[0] is None
    # Shorter than three sigma, it is a point.
    assert followed(monkeypatch, (0.0, 4.1, 5.0))[0] == ("point", "centre")
    assert followed(monkeypatch, (0.0, 4.3, 5.0))[0] == ("trail", (0.0, 4.3, 5.0))


CENTRE, ALONG, ACROSS = np.array([60.3, 52.6]), np.array([0.8, 0.6]), np.array([-0.6, 0.8])
BEND = (0.004, 0.03, -0.7)


def bent_image(first_px: float, last_px: float, flux_dn: float, shape: tuple[int, int] = (110, 130)) -> np.ndarray:
    """Return a uniform line along a parabola, drawn with a Gaussian at each of many points of equal length along."""
    s = first_px + (np.arange(800) + 0.5) / 800 * (last_px - first_px)
    path = CENTRE + s[:, np.newaxis] * ALONG + np.polyval(BEND, s)[:, np.newaxis] * ACROSS
    down, across = (
        np.exp(-((np.arange(n) - path[:, k, np.newaxis]) ** 2) / (2 * SIGMA_PX**2))
        for n, k in zip(shape, (1, 0), strict=True)
    )
    return flux_dn / 800 / (2 * np.pi * SIGMA_PX**2) * (down.T @ across)


def test_a_strip_has_the_profile_and_the_bend_of_its_trail() -> None:
    image = sky(bent_image(-25.0, 28.0, 53_000.0))
    image.noise_dn[53, 60] = 1.7  # at the centre
    strip = _Strip.around(image, CENTRE, ALONG, ACROSS, (-23.5, 27.2), SIGMA_PX)

    # Eight sigma, 11.2 px, beyond both ends.
    assert strip.along_px.tolist() == list(np.arange(-35.0, 40.0))
    np.testing.assert_allclose(strip.bend, BEND, rtol=0.03, atol=0.01)
    inside = np.abs(strip.along_px) < 20
    # 1000 DN for each px of length, in the window across; interpolation widens the trail a little.
    np.testing.assert_allclose(strip.profile_dn[inside], 1000 * KEPT, rtol=0.03)
    assert np.abs(strip.profile_dn[strip.along_px < -31]).max() < 5
    window = np.exp(-(np.arange(-5, 6) ** 2) / (2 * (1.5 * SIGMA_PX) ** 2))
    assert strip.noise_dn == pytest.approx(1.7 * np.sqrt((window**2).sum()))
    np.testing.assert_array_equal((strip.centre, strip.along_axis, strip.across_axis), (CENTRE, ALONG, ACROSS))
    assert not strip.at_edge
    first, last, level = strip.fitted(SIGMA_PX)
    assert (first, last, level) == (
        pytest.approx(-25, abs=0.1),
        pytest.approx(28, abs=0.1),
        pytest.approx(832, rel=0.03),
    )
    # Fewer than four values inside are too few, and a strip beyond the image is at its edge.
    assert _Strip.around(image, CENTRE, ALONG, ACROSS, (-3.0, 3.4), SIGMA_PX) is None
    assert _Strip.around(image, CENTRE, ALONG, ACROSS, (-3.0, 3.5), SIGMA_PX) is not None
    for part, at_edge in ((np.s_[:85, :], False), (np.s_[:80, :], True), (np.s_[:, :93], False), (np.s_[:, :87], True)):
        cut = _Strip.around(sky(image.above_dn[part].copy()), CENTRE, ALONG, ACROSS, (-23.5, 27.2), SIGMA_PX)
        assert cut.at_edge == at_edge


def strip_of(profile_dn: np.ndarray, along_px: np.ndarray) -> _Strip:
    return _Strip(CENTRE, ALONG, ACROSS, along_px, profile_dn, np.array(BEND), 2.5, at_edge=True)


def test_the_ends_of_a_box_are_fitted_to_a_profile() -> None:
    along = np.arange(-30.0, 41.0)
    root = np.sqrt(2) * SIGMA_PX
    profile = 150 * (erf((along + 12.3) / root) - erf((along - 21.7) / root))
    assert strip_of(profile, along).fitted(SIGMA_PX) == pytest.approx((-12.3, 21.7, 300.0), abs=1e-4)
    # A bright pixel hardly counts.
    profile[40] *= 4
    first, last, level = strip_of(profile, along).fitted(SIGMA_PX)
    assert (first, last) == pytest.approx((-12.3, 21.7), abs=0.2)
    assert level == pytest.approx(300.0, rel=0.05)

    found = strip_of(profile, along).trail((-12.3, 21.7, 300.0))

    def at(s: float) -> np.ndarray:
        return CENTRE + s * ALONG + (BEND[0] * s**2 + BEND[1] * s + BEND[2]) * ACROSS

    np.testing.assert_allclose(found.ends, [at(-12.3), at(21.7)], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.middle, at(4.7), rtol=0, atol=1e-9)
    # The mean of the parabola is its value in the middle plus L^2 / 12 times the coefficient.
    np.testing.assert_allclose(found.centroid, at(4.7) + BEND[0] * 34**2 / 12 * ACROSS, rtol=0, atol=0.02)
    assert found.flux == pytest.approx(300 / KEPT * 34)
    assert (found.snr, found.at_edge) == (pytest.approx(300 * np.sqrt(34) / 2.5), True)


def test_patches_are_bright_and_of_five_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    significance = np.zeros((30, 40), np.float32)
    significance[3, 4:9], significance[3, 6] = 3.1, 5.5  # just enough
    significance[8, 4:8] = 9.0  # four pixels
    significance[12, 4:12], significance[12, 5] = 3.1, 5.4  # too faint
    significance[16, 4:20] = 3.0  # not above the limit
    significance[20:26, 30:36] = 4.0
    significance[22, 33] = 7.0
    significance[21, 31] = 0.0  # a hole
    asked, given = [], []

    def subtract(pixels, *, saturation_dn):
        asked.append(saturation_dn)
        return SimpleNamespace(significance=lambda sigma_px: significance if sigma_px == 1.5 else None)

    def measure(_, x, y, sigma_px):
        given.append((sorted(zip(x.tolist(), y.tolist(), strict=True)), sigma_px))
        return trail(float(len(x)), float(x[0]), 6.0)

    monkeypatch.setattr(detection, "subtract_background", subtract)
    monkeypatch.setattr(detection, "_measured", measure)
    found = detect_trails(np.zeros((30, 40), np.uint8))

    square = sorted((float(x), float(y)) for x in range(30, 36) for y in range(20, 26) if (x, y) != (31, 21))
    assert given == [([(x, 3.0) for x in range(4, 9)], 1.2), (square, 1.2)]
    assert (len(found), found.flux_dn.tolist(), found.length_px.tolist()) == (2, [35.0, 5.0], [6.0, 6.0])
    assert found.ends_px.tolist() == [[[30, 7], [30, 13]], [[4, 7], [4, 13]]]
    assert found.middle_px.tolist() == found.centroid_px.tolist() == [[30, 7], [4, 7]]
    assert (found.snr.tolist(), found.at_edge.tolist()) == ([1, 1], [False, False])
    detect_trails(np.zeros((30, 40), np.uint16), psf_sigma_px=2.0)
    detect_trails(np.zeros((30, 40), np.float32))
    detect_trails(np.zeros((30, 40), np.uint16), saturation_dn=4095.0)
    assert asked == [255, 65535, np.inf, 4095]
    assert given[2][1] == 2.0
    significance[:] = 0
    none = detect_trails(np.zeros((30, 40), np.uint8))
    shapes = none.ends_px.shape, none.middle_px.shape, none.centroid_px.shape, none.length_px.shape
    assert (len(none), shapes) == (0, ((0, 2, 2), (0, 2), (0, 2), (0,)))
    assert isinstance(none, DetectedTrails)


def level_image(first_px: float, last_px: float) -> np.ndarray:
    """Return a straight trail along row 20, 2000 DN for each px of length."""
    column = np.arange(120)[:, np.newaxis]
    s = np.linspace(first_px, last_px, 1600)
    along = np.exp(-((column - s) ** 2) / (2 * SIGMA_PX**2)).mean(axis=1)
    across = np.exp(-((np.arange(40) - 20.0) ** 2) / (2 * SIGMA_PX**2))
    return 2000 * (last_px - first_px) / (2 * np.pi * SIGMA_PX**2) * np.outer(across, along)


@pytest.mark.parametrize(
    ("centre_px", "part", "at_edge"),
    [
        *[(49.4, np.s_[:, :], False), (31.1, np.s_[:, :], False), (30.9, np.s_[:, :], True)],
        *[(50.0, np.s_[:, :82], False), (50.0, np.s_[:, :81], True), (50.0, np.s_[:21], False)],
    ],
)
def test_a_strip_ends_eight_sigma_beyond_its_patch(centre_px: float, part: tuple, at_edge: bool) -> None:
    # From -31 to 31 px about the centre: 19.8 px and eight times 1.4 px.
    image = sky(level_image(centre_px - 21, centre_px + 21)[part].copy())
    strip = _Strip.around(
        image, np.array([centre_px, 20.0]), np.array([1.0, 0]), np.array([0, 1.0]), (-19.8, 19.8), SIGMA_PX
    )
    assert strip.along_px[[0, -1]].tolist() == [-31, 31]
    assert strip.at_edge == at_edge


@pytest.mark.parametrize(("last_px", "is_bent"), [(7.5, False), (8.5, True)])
def test_a_strip_of_more_than_twelve_values_may_be_bent(last_px: float, is_bent: bool) -> None:
    # Inside are the values from -5 px on: twelve up to 6 px.
    image = sky(bent_image(-25.0, 28.0, 53_000.0))
    strip = _Strip.around(image, CENTRE, ALONG, ACROSS, (-6.6, last_px), SIGMA_PX)
    assert (strip.bend[0] != 0) == is_bent
    assert strip.bend[1:] == pytest.approx(BEND[1:], abs=0.1)


@pytest.mark.parametrize(("x", "y", "row", "column"), [(79.6, 30.0, 30, 79), (40.0, 59.7, 59, 40), (-0.7, 30.0, 30, 0)])
def test_the_noise_of_a_strip_is_that_at_its_centre_on_the_image(x: float, y: float, row: int, column: int) -> None:
    image = sky(np.full((60, 80), 50.0))
    image.noise_dn[:] = 1 + np.arange(80) + 100 * np.arange(60)[:, np.newaxis]
    strip = _Strip.around(image, np.array([x, y]), np.array([0.6, 0.8]), np.array([-0.8, 0.6]), (-20.0, 20.0), 1.3)
    # Three sigma are 3.9 px.
    window = np.exp(-(np.arange(-4, 5) ** 2) / (2 * (1.5 * 1.3) ** 2))
    assert strip.noise_dn == pytest.approx((1 + column + 100 * row) * np.sqrt((window**2).sum()))


def test_significance_is_smoothed_in_units_of_the_noise_at_each_pixel() -> None:
    rng = np.random.default_rng(2)
    noise = np.where(np.arange(90) < 45, 2.0, 8.0) * np.ones((75, 1))
    white = rng.normal(0, 1, (75, 90))
    image = SubtractedImage((white * noise).astype(np.float32), noise.astype(np.float32), np.ones((75, 90), bool))
    same = SubtractedImage(white.astype(np.float32), np.ones((75, 90), np.float32), image.usable)
    np.testing.assert_allclose(image.significance(1.5), same.significance(1.5), rtol=0, atol=1e-4)
    found = image.significance(1.5)
    # The median of absolute values of a normal distribution is 0.6745, here over every third row and column.
    assert np.median(np.abs(found[::3, ::3])) == pytest.approx(0.6745, rel=1e-5)
    # Of every eighth pixel, half are on either side.
    assert image.usual_noise_dn == 5.0
