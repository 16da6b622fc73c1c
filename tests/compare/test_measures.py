"""Measures of pairs, against their definitions, and the limits that reject an image."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.compare.comparison import (
    Collector,
    ComparedImage,
    _nothing_paired,
    by_star,
    chance,
    figures,
    intensity,
    percentage_errors,
    rejection,
    shift_grid,
    summarize,
)
from glstar.compare.pairs import Measures
from glstar.errors import ImagesError
from tests.compare.test_shifts import ANY_PAIR

NAN = float("nan")
IMAGE = ComparedImage("a.png", None, 5, 4, 0, 0, 0, None)


def test_intensities_have_the_measures_of_the_paper() -> None:
    real, simulated = np.array([100.0, 200.0, 50.0]), np.array([150.0, 190.0, 50.0])
    measured = intensity(real, simulated)

    assert tuple(percentage_errors(real, simulated)) == pytest.approx((50, -5, 0))
    error_mag = -2.5 * np.log10(simulated / real)
    assert measured["pairs"] == 3
    assert measured["mean_error_dn"] == pytest.approx(40 / 3)
    assert measured["mean_absolute_percentage_error"] == pytest.approx(55 / 3)
    assert measured["magnitude_error"] == pytest.approx(2.5 * np.log10(1 + 55 / 300))
    assert measured["magnitude_difference_mean"] == pytest.approx(error_mag.mean())
    assert measured["magnitude_difference_std"] == pytest.approx(
        np.sqrt(((error_mag - error_mag.mean()) ** 2).sum() / 2)
    )
    # Teague & Chahl: 47.4 % are 0.42 mag.
    assert intensity(np.array([100.0]), np.array([147.4]))["magnitude_error"] == pytest.approx(0.42, abs=0.005)
    assert intensity(np.array([100.0]), np.array([147.4]))["magnitude_difference_std"] is None
    assert intensity(np.array([100.0, 100]), np.array([110.0, 110]))["magnitude_difference_std"] == pytest.approx(0)
    assert intensity(np.zeros(0), np.zeros(0)) == {"pairs": 0}


def test_the_summary_of_pairs_follows_its_definitions() -> None:
    pairs = [
        replace(
            ANY_PAIR,
            centroid_px=0.5,
            shape_px=0.1,
            baseline_px=0.4,
            noise_px=0.3,
            peak_real_dn=100.0,
            peak_simulated_dn=130.0,
            pixel_real_dn=50.0,
            pixel_simulated_dn=45.0,
            shift_x_px=0.3,
            shift_y_px=-0.4,
            length_px=40.0,
            length_difference_px=2.0,
            direction_difference_rad=0.02,
        ),
        replace(
            ANY_PAIR,
            centroid_px=0.7,
            shape_px=0.2,
            baseline_px=0.6,
            noise_px=0.1,
            saturated=True,
            peak_real_dn=1.0,
            peak_simulated_dn=1e6,
            shift_x_px=0.6,
            shift_y_px=0.8,
            length_px=2.0,
            length_difference_px=NAN,
            direction_difference_rad=NAN,
        ),
        replace(
            ANY_PAIR,
            centroid_px=0.9,
            shape_px=0.6,
            baseline_px=0.5,
            noise_px=0.2,
            peak_real_dn=100.0,
            peak_simulated_dn=90.0,
            pixel_real_dn=50.0,
            pixel_simulated_dn=40.0,
            length_px=10.0,
            length_difference_px=-1.0,
            direction_difference_rad=-0.04,
        ),
    ]
    summary = summarize(pairs)

    assert summary["peak"]["mean_error_dn"] == pytest.approx(10)
    assert summary["brightest_pixel"]["mean_absolute_percentage_error"] == pytest.approx(15)
    assert (summary["saturated_pairs"], summary["peak"]["pairs"], summary["centroid"]["pairs"]) == (1, 2, 3)
    beyond = np.sqrt((0.25 + 0.49 + 0.81 - 0.09 - 0.01 - 0.04) / 3)
    assert summary["centroid"] == pytest.approx(
        {"pairs": 3, "mean_px": 0.7, "median_px": 0.7, "noise_px": 0.2, "beyond_noise_px": beyond}
    )
    assert summary["centroid_in_own_region"] == pytest.approx(
        {"mean_px": 0.3, "median_px": 0.2, "baseline_mean_px": 0.5, "baseline_median_px": 0.5, "reduction_percent": 40}
    )
    assert summary["shift"] == pytest.approx({"mean_px": 0.5, "median_px": 0.5, "x_px": 0.3, "y_px": 0.4 / 3})
    trail = summary["trail"]
    assert trail["pairs"] == 2
    assert trail["length_difference_px"] == pytest.approx({"mean": 0.5, "median": 0.5, "mean_absolute": 1.5})
    assert trail["length_difference_percent"] == pytest.approx({"mean": -2.5, "median": -2.5, "mean_absolute": 7.5})
    assert trail["direction_difference_deg"]["mean"] == pytest.approx(np.rad2deg(-0.01))
    assert ("saturated, not in these", "1") in figures(summary)

    # Noise above the distances leaves nothing, and short trails have no length.
    short = summarize([replace(pairs[1], noise_px=1.0)])
    assert short["centroid"]["beyond_noise_px"] == 0
    assert short["trail"]["length_difference_px"] == {"mean": None, "median": None, "mean_absolute": None}


def test_stars_are_listed_by_how_often_they_were_found_then_by_magnitude() -> None:
    def pair(star_id: int, vmag: float, centroid_px: float, *, saturated: bool = False):
        peaks = {"peak_real_dn": 100.0, "peak_simulated_dn": 400.0 if saturated else 120.0}
        named = {"star_id": star_id, "name": f"{star_id}", "vmag": vmag, "saturated": saturated}
        return replace(ANY_PAIR, centroid_px=centroid_px, **named, **peaks)

    pairs = [pair(0, 0.0, 9.0), pair(7, 3.0, 1.0), pair(5, 2.0, 1.0), pair(3, 2.0, 2.0)]
    pairs += [pair(7, 3.0, 2.0, saturated=True), pair(7, 3.0, 6.0)]
    stars = by_star(pairs)

    assert [(star["star_id"], star["found"], star["name"]) for star in stars] == [(7, 3, "7"), (3, 1, "3"), (5, 1, "5")]
    assert (stars[0]["centroid_mean_px"], stars[0]["centroid_median_px"], stars[0]["vmag"]) == (3.0, 2.0, 3.0)
    assert stars[0]["peak"]["pairs"] == 2
    assert stars[0]["peak"]["mean_error_dn"] == pytest.approx(20)


@pytest.mark.parametrize(
    ("count", "size_px", "cell_px"),
    [
        (182, (1000.0, 300.0), 1000 / 6),  # the square root of 182 / 20 * 1000 / 300 is 5.51
        (30, (300.0, 1000.0), 1000 / 3),  # and at least 3 cells
        (2000, (1000.0, 900.0), 1000 / 8),  # at most 8
        (12, (30.0, 20.0), 40 / 3),  # of a field of 40 px or more
    ],
)
def test_the_means_of_cells_are_those_of_their_pairs(count: int, size_px: tuple[float, float], cell_px: float) -> None:
    rng = np.random.default_rng(3)
    at = np.array([70, 90]) + np.vstack([[0, 0], size_px, rng.uniform(0, size_px, (count - 2, 2))])
    shift, signal = rng.normal(0, 1, (count, 2)), rng.uniform(10, 150, count)
    grid = shift_grid(
        [
            replace(ANY_PAIR, x_px=x, y_px=y, shift_x_px=u, shift_y_px=v, signal_to_noise=s)
            for (x, y), (u, v), s in zip(at.tolist(), shift.tolist(), signal.tolist(), strict=True)
        ]
    )

    assert grid.cell_px == pytest.approx(cell_px)
    # The pair at the far corner belongs to the last cell.
    cells = np.floor((at - [70, 90]) / cell_px - [[1e-9 * (k == 1)] * 2 for k in range(count)])
    expected = []
    for cell in np.unique(cells, axis=0):
        own = (cells == cell).all(axis=1)
        weight = np.minimum(signal[own], 100.0) ** 2
        mean = weight @ shift[own] / weight.sum()
        square = ((shift[own] - mean) ** 2).sum(axis=1) / 2
        n = own.sum()
        std = np.sqrt((weight**2 * square).sum() * n / (n - 1)) / weight.sum() if n > 1 else np.nan
        expected.append([n, *(weight @ at[own] / weight.sum()), *mean, std, np.linalg.norm(mean) > 2.45 * std])
    found = np.column_stack([grid.pairs, grid.middle_px, grid.shift_px, grid.std_px, grid.clear])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_shift_is_clear_beyond_2_45_standard_errors() -> None:
    """The chi squared of two degrees of freedom exceeds 6.0, the square of 2.45, in 5 % of the cases."""
    rng = np.random.default_rng(5)
    pairs = [
        replace(ANY_PAIR, x_px=30 * i, y_px=30 * j, shift_x_px=i + d, shift_y_px=0, signal_to_noise=9.0)
        for i, j, d in [(i, j, d) for i in range(3) for j in range(3) for d in rng.permutation([-3.0, 0, 3.0])]
    ]
    grid = shift_grid(pairs)
    # The standard error of each cell is that of -3, 0 and 3 on one axis, RMS of both: sqrt(9 / 3 / 2).
    assert tuple(grid.std_px) == pytest.approx((np.sqrt(1.5),) * 9)
    assert not grid.clear.any()
    at_limit = replace(grid, shift_px=np.array([[2.44, 0], [0, 2.46], [-2.46, 0]]), std_px=np.ones(3))
    assert at_limit.clear.tolist() == [False, True, True]
    assert not replace(grid, shift_px=np.array([[2.45, 0]]), std_px=np.ones(1)).clear.any()


def pairing(predicted: int, found: int, scatter_px: float = NAN):
    return SimpleNamespace(trails=range(predicted), found_indices=range(found), scatter_px=scatter_px)


@pytest.mark.parametrize(
    ("predicted", "found", "scatter_px", "is_chance"),
    [(10, 5, 2.0, False), (10, 4, 1.2, False), (10, 4, 1.21, True), (11, 5, 1.3, True), (10, 4, NAN, False)],
)
def test_scattered_trails_below_half_of_the_predicted_ones_are_chance(predicted, found, scatter_px, is_chance) -> None:
    assert (chance(pairing(predicted, found, scatter_px)) is not None) == is_chance


@pytest.mark.parametrize(
    ("predicted", "found", "saturated_fraction", "kind"),
    [
        *[(4, 2, 0.9, None), (4, 1, 0.3, "without a star found"), (4, 1, 0.31, "saturated")],
        *[
            (5, 3, 0.0, None),
            (5, 2, 0.0, "without a star found"),
            (7, 3, 0.0, None),
            (7, 2, 0.0, "without a star found"),
        ],
        *[(40, 4, 0.0, None), (40, 3, 0.0, "without a star found"), (41, 4, 0.0, "without a star found")],
        *[(0, 0, 0.3, "without a predicted star"), (0, 0, 0.31, "saturated")],
    ],
)
def test_an_image_is_rejected_below_a_tenth_or_half_of_its_stars(predicted, found, saturated_fraction, kind) -> None:
    sky = SimpleNamespace(saturated_fraction=saturated_fraction, usual_noise_dn=1.0)
    reason = rejection(pairing(predicted, found), sky)
    assert (reason and reason[0]) == kind


def test_the_eight_best_and_worst_pairs_of_all_images_are_kept() -> None:
    centroids, noises = [5.0, 1, 9, 3, 7, 2], [0.0, 0, 4, 0, 0, 0]
    pairs = [replace(ANY_PAIR, centroid_px=c, noise_px=n) for c, n in zip(centroids, noises, strict=True)]
    others = [replace(pair, centroid_px=pair.centroid_px + 0.5) for pair in pairs]
    collected = Collector()
    collected.add(IMAGE, Measures(tuple(pairs), tuple(pairs)))
    collected.add(replace(IMAGE, file="b.png"), Measures(tuple(others), tuple(others)))
    result = collected.result(None, "", Path("images"))

    assert [pair.centroid_px for pair, _ in result.best] == [1, 1.5, 2, 2.5, 3, 3.5, 5, 5.5]
    # Without noise the largest would come first: 9.5 - 8 is only 1.5.
    assert [pair.beyond_noise_px for pair, _ in result.worst] == [7.5, 7, 5.5, 5, 3.5, 3, 2.5, 2]
    assert (len(result.pairs), len(result.images)) == (12, 2)


def test_a_comparison_without_pairs_names_the_most_frequent_reason() -> None:
    collected = Collector()
    for file, kind in (("a", "broken"), ("b", "saturated"), ("c", "saturated")):
        collected.reject(file, kind, f"{kind} for a reason")
    with pytest.raises(ImagesError, match=r"2 saturated, 1 broken; b: saturated for a reason"):
        collected.result(None, "", Path("images"))
    assert _nothing_paired([]) == "no image"


def test_two_pairs_of_a_cell_have_a_standard_error_and_one_has_none() -> None:
    pairs = [
        replace(ANY_PAIR, x_px=x, y_px=0.5 * x, shift_x_px=u, shift_y_px=v, signal_to_noise=10.0)
        for x, u, v in ((0.0, 1.0, 0.0), (2.0, 3.0, 1.0), (900.0, 5.0, 5.0))
    ]
    grid = shift_grid(pairs)
    assert grid.pairs.tolist() == [2, 1]
    np.testing.assert_allclose(grid.shift_px, [[2.0, 0.5], [5.0, 5.0]], rtol=0, atol=1e-12)
    # The mean of both axes of squares about the mean, (1 + 1/4) / 2 for each, over 1 and over 2.
    assert grid.std_px[0] == pytest.approx(np.sqrt(2 * 0.625 / 1 / 2))
    assert np.isnan(grid.std_px[1])
