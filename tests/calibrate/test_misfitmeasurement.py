"""Measurements of what a sensor model lacks, on drawn stars and on exact surfaces."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.sensor.fit import BrightnessFit, _blended, _refuse_shaken
from glstar.calibrate.sensor.misfitmeasurement import (
    _axis_px,
    _covers_corner,
    _fit_radial,
    _growth,
    _offsets,
    _star_profile,
    _weighted_median,
    measure_wings,
)
from glstar.errors import CalibrationError
from tests.support.handmade import Stars

SIDE = 420
# Distance of every fifth star in distances of the corner, stars, and whether they cover the corner.
LIMITS = [(0.59, 30, False), (0.61, 30, True), (0.61, 20, True), (0.61, 19, False)]
SIGMA_PX = 1.4
# Nine stars, far from each other.
CENTRES = np.array([(x + 0.2 * y / 70, y - 0.1 * x / 70) for x in (70, 210, 350) for y in (70, 210, 350)])


def gaussians(sigma_px: float, peak_dn: float) -> np.ndarray:
    """Return the stars as pixels record them: a pixel widens a Gaussian by a twelfth of a square pixel."""
    wide2 = sigma_px**2 + 1 / 12
    rows, columns = np.indices((SIDE, SIDE))
    total = np.zeros((SIDE, SIDE))
    for x, y in CENTRES:
        total += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * wide2))
    return peak_dn * sigma_px**2 / wide2 * total


def photo(above_dn: np.ndarray) -> tuple[Photograph, SimpleNamespace]:
    detected = SimpleNamespace(xy_px=CENTRES, background=SimpleNamespace(level_dn=np.full(above_dn.shape, 50.0)))
    return Photograph(Path("a.png"), above_dn + 50.0, 16, "grey", None), detected


@pytest.mark.parametrize("part", [0.0, 0.1])
def test_wings_are_the_flux_beyond_the_gaussian_between_three_and_eight_sigma(part: float) -> None:
    """A wide Gaussian with a tenth of the flux: part of it lies between the radii, over the sky of the next ring."""
    wide_px = 4.0
    flux = 2 * np.pi * SIGMA_PX**2 * 20000.0
    above = gaussians(SIGMA_PX, 20000.0) + part * gaussians(wide_px, flux / (2 * np.pi * wide_px**2))
    image, detected = photo(above)
    wings, stacked = measure_wings(image, detected, np.arange(9), SIGMA_PX, np.full(9, 50.0))
    # Radii are in sigma of the fit as recorded; the fit is hardly wider than the core.
    fitted2 = (1.45 if part else SIGMA_PX) ** 2 + 1 / 12

    def beyond(radius: float) -> float:
        return float(np.exp(-(radius**2) * fitted2 / (2 * (wide_px**2 + 1 / 12))))

    ring = (beyond(9) - beyond(12)) / (144 - 81) * (64 - 9)
    assert wings.value == pytest.approx(part * (beyond(3) - beyond(8) - ring), abs=0.006 + 0.12 * part)
    assert wings.standard_error < 0.01
    np.testing.assert_allclose(stacked.radius_sigma, 0.25 + 0.5 * np.arange(16), rtol=1e-12)
    if not part:
        expected = np.exp(-(stacked.radius_sigma**2) / 2)
        near = (stacked.radius_sigma > 0.5) & (stacked.radius_sigma < 6)  # few pixels are nearer
        np.testing.assert_allclose(stacked.brightness[near], expected[near], rtol=0, atol=0.03)
    # Eight stars are a typical shape, seven are not.
    assert measure_wings(image, detected, np.arange(8), SIGMA_PX, np.full(9, 50.0))[0] is not None
    assert measure_wings(image, detected, np.arange(7), SIGMA_PX, np.full(9, 50.0)) == (None, None)


def test_a_profile_needs_its_sky_ring_on_the_image_and_leaves_out_neighbours() -> None:
    above = np.random.default_rng(1).normal(0, 1, (80, 90))
    usable = np.ones(above.shape, bool)
    recorded_px = float(np.sqrt(SIGMA_PX**2 + 1 / 12))
    half = int(np.ceil(12 * recorded_px)) + 1  # 19 px
    for x, y, complete in (
        *((half, 40, True), (half - 1, 40, False), (89 - half, 40, True), (90 - half, 40, False)),
        *((40, half, True), (40, half - 1, False), (40, 79 - half, True), (40, 80 - half, False)),
    ):
        alone = np.array([[x, y]], float)
        assert (_star_profile(above, usable, alone, 0, SIGMA_PX, alone[0]) is not None) == complete
    centre = np.array([40.3, 39.8])
    rows, columns = np.indices(above.shape)
    distance = np.hypot(columns - centre[0], rows - centre[1]) / recorded_px
    for near in (None, [46.0, 44.0], [40.0, 63.0], [62.0, 63.0]):
        good = np.ones(above.shape, bool)
        xy = np.array([centre] if near is None else [centre, near])
        if near is not None:
            good = np.hypot(columns - near[0], rows - near[1]) > 5 * recorded_px
        radius, light, gaussian = _star_profile(above, usable, xy, 0, SIGMA_PX, centre)
        np.testing.assert_allclose(np.sort(radius), np.sort(distance[good & (distance < 8)]), rtol=1e-12)
        sky = above[good & (distance >= 9) & (distance < 12)].mean()
        assert light.sum() == pytest.approx((above[good & (distance < 8)] - sky).sum())
        np.testing.assert_allclose(gaussian, np.exp(-(radius**2) / 2) * SIGMA_PX**2 / recorded_px**2, rtol=0, atol=0.02)
    # Forty pixels of the ring are enough.
    ring = np.flatnonzero((distance >= 9) & (distance < 12))
    for count, enough in ((39, False), (40, True)):
        some = usable.copy()
        some.flat[ring[count:]] = False
        assert (_star_profile(above, some, centre[np.newaxis], 0, SIGMA_PX, centre) is not None) == enough


def test_a_weighted_median_is_the_median_of_repeated_values() -> None:
    rng = np.random.default_rng(3)
    values, counts = rng.normal(0, 1, 31), rng.integers(1, 60, 31)
    assert _weighted_median(values, np.ones(31)) == np.median(values)
    near = np.sort(values)
    repeated = np.median(np.repeat(values, counts))
    found = _weighted_median(values, counts.astype(float))
    assert abs(np.searchsorted(near, found) - np.searchsorted(near, repeated)) <= 1
    assert _weighted_median(np.array([1.0, 2.0]), np.array([1.0, 1.0])) == 1.5


def test_offsets_are_in_distances_of_the_farthest_corner() -> None:
    axis = np.array([30.0, 40.0])
    # The farthest corner of 101 x 81 px is (100, 0) or (100, 80), 80.6 px away.
    expected = np.array([[70.0, 40], [0, 0]]) / np.sqrt(6500)
    np.testing.assert_allclose(_offsets(np.array([[100.0, 80], [30, 40]]), (81, 101), axis), expected, rtol=1e-12)
    camera = SimpleNamespace(width_px=101, cx_px=30.0, cy_px=40.0)
    for mirrored, x in ((False, 30.0), (True, 70.0)):
        matches = SimpleNamespace(solution=SimpleNamespace(camera=camera, mirrored=mirrored))
        assert _axis_px(matches).tolist() == [x, 40.0]


def surface(count: int = 400):
    rng = np.random.default_rng(5)
    offset = rng.uniform(-0.7, 0.7, (count, 2))
    return rng, offset, (offset**2).sum(axis=1)


def test_a_radial_fit_has_the_errors_of_its_scatter() -> None:
    rng, offset, r2 = surface()
    found = []
    for _ in range(60):
        values = 2 + 0.3 * offset[:, 0] - 0.5 * offset[:, 1] + 0.4 * r2 + rng.normal(0, 0.1, len(r2))
        values[:8] += 5.0  # outliers
        found.append(_fit_radial(offset, values, rng.uniform(0.5, 1.5, len(r2))))
    p = np.array([one[0] for one in found])
    np.testing.assert_allclose(p.mean(axis=0), [2, 0.3, -0.5, 0.4], rtol=0, atol=0.02)
    std = np.sqrt(np.mean([np.diag(one[1]) for one in found], axis=0))
    np.testing.assert_allclose(std, p.std(axis=0), rtol=0.3)


@pytest.mark.parametrize("growth", [0.3, 0.0])
def test_the_growth_of_the_width_is_that_from_the_axis_to_the_corner(growth: float) -> None:
    rng, _, _ = surface()
    xy = rng.uniform(0, [639, 479], (300, 2))
    axis = np.array([319.5, 239.5])
    r2 = ((xy - axis) ** 2).sum(axis=1) / (319.5**2 + 239.5**2)
    stars = Stars(xy_px=xy, sigma_px=1.2 * (1 + growth * r2) + rng.normal(0, 0.02, 300))
    image = SimpleNamespace(pixels_dn=np.zeros((480, 640)))
    good = rng.random(300) > 0.3
    found, width = _growth(image, stars, good, np.full(300, 40.0), axis)
    assert found.value == pytest.approx(growth, abs=4 * found.standard_error)
    assert found.standard_error < 0.02
    expected = 1 + growth * r2
    np.testing.assert_allclose(width, expected / np.median(expected[good]), rtol=0.01)


@pytest.mark.parametrize(("scale", "count", "covers"), LIMITS)
def test_a_corner_is_measured_with_enough_stars_far_enough_from_the_axis(
    scale: float, count: int, covers: bool
) -> None:
    """A tenth of the stars must lie beyond the limit."""
    distance = np.where(np.arange(count) % 5 == 0, scale, 0.1)
    assert _covers_corner(np.column_stack([0.6 * distance, -0.8 * distance])) == covers


def test_stars_are_blended_with_near_ones_that_are_not_much_fainter() -> None:
    """Within 2 px and 4 sigma, and up to 3.5 mag fainter; unmatched stars of the catalogue count, too."""
    xy = np.array([[0.0, 0], [7.9, 0], [100, 0], [108.1, 0], [200, 0], [204, 0], [300, 0], [304, 0]])
    vmag = np.array([2.0, 3.0, 2.0, 3.0, 2.0, 5.49, 2.0, 5.51])
    reference = SimpleNamespace(stars=SimpleNamespace(vmag=vmag))

    class Matched(SimpleNamespace):
        def __len__(self) -> int:
            return len(self.star)

    star = np.array([6, 4, 0, 2, 5, 7])
    matches = Matched(star=star, predicted=np.arange(8), predicted_xy_px=xy)
    assert _blended(reference, matches, 1.5).tolist() == [False, True, True, False, True, True]


@pytest.mark.parametrize(("drawn_out_px", "refused"), [(1.35 * 5 + 2.4 * 1.5, False), (1.35 * 5 + 2.6 * 1.5, True)])
def test_trails_longer_than_the_sidereal_motion_are_of_a_moving_camera(drawn_out_px: float, refused: bool) -> None:
    trail_px = np.array([[3.0, 4.0], [0.0, 1.0], [-5.0, 12.0]])  # 5 px in the median
    detected = SimpleNamespace(drawn_out_px=drawn_out_px)
    if refused:
        with pytest.raises(CalibrationError, match=r"explains 5\.0 px: the camera moved"):
            _refuse_shaken(detected, trail_px, 1.5)
    else:
        _refuse_shaken(detected, trail_px, 1.5)


@pytest.mark.parametrize(
    ("low", "slope", "high", "linear"),
    [
        (-0.45, -0.43, -0.41, False),
        (-0.45, -0.43, -0.4, True),
        (-0.4, -0.37, -0.35, True),
        (-0.39, -0.379, -0.37, False),
        (-0.39, -0.381, -0.37, True),
        (-0.43, -0.419, -0.41, True),
        (-0.43, -0.421, -0.41, False),
    ],
)
def test_a_sensor_is_linear_if_its_slope_may_be_or_nearly_is(
    low: float, slope: float, high: float, linear: bool
) -> None:
    fit = BrightnessFit("median", 3.0, 500.0, np.ones(2, bool), 0.1, 0.01, slope, low, high)
    assert fit.linear == linear
    np.testing.assert_allclose(fit.peak_dn(np.array([3.0, 5.5, 0.5])), [500, 50, 5000], rtol=1e-12)
