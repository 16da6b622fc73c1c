"""The joint fit of stars step by step: stamps, images, weights, fluxes, errors, against brute force."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from glstar.calibrate.sensor.jointpsf import (
    JointPsf,
    StarStamps,
    _covariance,
    _errors,
    _fitted,
    _free_pixels,
    _limits,
    _moved,
    _position_slopes,
    _residuals,
    _Shape,
    _slopes,
    _trail_samples,
    _unclear,
    _weights,
    cut_stamps,
    measure_fluxes,
)
from glstar.camera.sensor.pointspread import PointSpread
from tests.support.handmade import stamps_of

SHAPED = PointSpread(
    psf_wing_fraction=0.2,
    psf_wing_sigma_px=3.0,
    psf_growth=0.5,
    psf_ellipticity=0.2,
    psf_angle_rad=0.6,
    psf_tilt=0.3,
    psf_tilt_angle_rad=-0.8,
    psf_colour_growth=0.2,
)


def lit(
    stamps: StarStamps, psf: PointSpread, sigma_px: float, flux: np.ndarray, sky: float, noise: int | None = None
) -> StarStamps:
    light = flux[:, np.newaxis, np.newaxis] * stamps.profiles(psf, sigma_px) + sky
    if noise is not None:
        light += np.sqrt(stamps.variance_dn2) * np.random.default_rng(noise).standard_normal(light.shape)
    return replace(stamps, values_dn=light)


def test_some_stamps_keep_all_of_their_numbers() -> None:
    stamps = stamps_of(4)
    for chosen in (np.array([3, 1]), np.array([False, True, False, True])):
        some = stamps.some(chosen)
        assert len(some) == 2
        for name in ("corner_px", "values_dn", "variance_dn2", "xy_px", "trail_px", "offset", "bv"):
            np.testing.assert_array_equal(getattr(some, name), getattr(stamps, name)[chosen])
        assert some.dn_per_e == 0.3
    some = replace(stamps, variance_dn2=np.where(stamps.variance_dn2 < 5, np.inf, stamps.variance_dn2))
    assert _free_pixels(some) == (stamps.variance_dn2 >= 5).sum()


@pytest.mark.parametrize("trail", [False, True])
def test_the_image_of_a_star_is_the_integral_of_its_gaussians_over_pixels_and_time(trail: bool) -> None:
    stamps = stamps_of(2, trail=trail)
    light = stamps.profiles(SHAPED, 1.2)
    for k in range(2):
        scale = float(SHAPED.scale_at(stamps.offset[k], stamps.bv[k]))
        expected = np.zeros((13, 13))
        times = (np.arange(60) + 0.5) / 60 - 0.5 if trail else [0.0]
        for time in times:
            x, y = stamps.xy_px[k] - stamps.corner_px[k] + time * stamps.trail_px[k]
            for one in SHAPED.components(1.2, scale=scale):
                edges = np.arange(14) - 0.5
                across = np.diff(norm.cdf(edges, x + one.offset_px[0], one.sigma_px))
                down = np.diff(norm.cdf(edges, y + one.offset_px[1], one.sigma_px))
                expected += one.flux_fraction * np.outer(down, across) / len(times)
        np.testing.assert_allclose(light[k], expected, rtol=0, atol=2e-5 if trail else 1e-12)


def test_trails_have_nodes_for_each_width() -> None:
    nodes, weights = _trail_samples(np.array([[0.0, 0.0], [3.0, -4.0]]), 1.5)
    assert len(nodes) == 2 + 4
    assert weights.sum() == pytest.approx(1.0, rel=1e-12)
    assert (weights @ nodes, weights @ nodes**2) == (pytest.approx(0, abs=1e-12), pytest.approx(1 / 12, rel=1e-9))
    assert len(_trail_samples(np.array([[3.0, -4.0]]), 0.1)[0]) == 2 + 17
    assert len(_trail_samples(np.array([[0.0009, 0.0]]), 1.5)[0]) == 1
    assert len(_trail_samples(np.array([[0.001, 0.0]]), 1.5)[0]) == 3
    assert len(_trail_samples(np.array([[0.0011, 0.0]]), 1.5)[0]) == 3
    assert len(_trail_samples(np.empty((0, 2)), 1.5)[0]) == 1


def cut(xy: np.ndarray, others: np.ndarray, half_px: int = 5, **given: object):
    rng = np.random.default_rng(2)
    shape = (40, 60)
    fields = {
        "above_dn": rng.normal(0, 1, shape),
        "variance_dn2": rng.uniform(1, 2, shape),
        "usable": rng.random(shape) < 0.97,
        "xy_px": xy,
        "others_px": others,
        "trail_px": np.arange(2.0 * len(xy)).reshape(-1, 2),
        "offset": np.arange(2.0 * len(xy)).reshape(-1, 2) / 10,
        "bv": np.arange(float(len(xy))),
        "half_px": half_px,
        "dn_per_e": 0.4,
    }
    return fields, *cut_stamps(**fields | given)


def test_stamps_lie_wholly_on_the_image() -> None:
    xy = np.array([[5.4, 20], [4.4, 20], [54.4, 20], [54.6, 20], [30, 5.4], [30, 4.4], [30, 34.4], [30, 34.6]])
    given, stamps, inside = cut(xy, np.array([[30.0, 20.0]]) * 0 - 500)
    assert inside.tolist() == [0, 2, 4, 6]
    np.testing.assert_array_equal(stamps.corner_px, [[0, 15], [49, 15], [25, 0], [25, 29]])
    for row, k in enumerate(inside):
        x, y = stamps.corner_px[row].astype(int)
        part = slice(y, y + 11), slice(x, x + 11)
        np.testing.assert_array_equal(stamps.values_dn[row], given["above_dn"][part])
        np.testing.assert_array_equal(
            stamps.variance_dn2[row], np.where(given["usable"][part], given["variance_dn2"][part], np.inf)
        )
        assert stamps.bv[row] == k
        np.testing.assert_array_equal(stamps.trail_px[row], given["trail_px"][k])
        np.testing.assert_array_equal(stamps.offset[row], given["offset"][k])
    assert stamps.dn_per_e == 0.4


def test_pixels_nearer_to_another_star_do_not_count() -> None:
    """Nor those within six tenths of half a stamp of it; the star itself is no other."""
    xy = np.array([[20.3, 20.2]])
    for other, matters in (
        ([26.0, 22.0], True),
        ([20.9, 20.9], False),
        ([21.1, 20.9], True),
        ([34.5, 20.2], True),
        ([35.3, 20.2], False),
    ):
        _, stamps, _ = cut(xy, np.array([xy[0], other]), usable=np.ones((40, 60), bool))
        rows, columns = np.mgrid[15:26, 15:26]
        own = (columns - 20.3) ** 2 + (rows - 20.2) ** 2
        to_other = (columns - other[0]) ** 2 + (rows - other[1]) ** 2
        counts = to_other > np.minimum(own, 9.0) if matters else np.ones((11, 11), bool)
        np.testing.assert_array_equal(np.isfinite(stamps.variance_dn2[0]), counts)


def test_pixels_between_two_stars_count_for_neither() -> None:
    """Another star is one pixel away or more; whole numbers make distances equal."""
    xy = np.array([[20.0, 20.0]])
    for other in ([24.0, 20.0], [21.0, 20.0]):
        _, stamps, _ = cut(xy, np.array([xy[0], other]), usable=np.ones((40, 60), bool))
        rows, columns = np.mgrid[15:26, 15:26]
        own, to_other = ((columns - x) ** 2 + (rows - y) ** 2 for x, y in (xy[0], other))
        assert (to_other == np.minimum(own, 9)).any()
        np.testing.assert_array_equal(np.isfinite(stamps.variance_dn2[0]), to_other > np.minimum(own, 9))


def test_a_shape_is_a_point_spread_function_within_its_limits() -> None:
    plain = _Shape(1.3).psf
    assert plain == PointSpread()
    full = _Shape(1.3, 2.8, 0.4, 0.06, -0.08, 0.15, np.log(3.5), 0.3, -0.4, 0.2).psf
    assert full.psf == "moffat"
    expected = {
        "psf_beta": 2.8,
        "psf_wing_fraction": 0.15,
        "psf_wing_sigma_px": 3.5,
        "psf_halo_fraction": 0.0,
        "psf_halo_radius_px": 20.0,
        "psf_growth": 0.4,
        "psf_ellipticity": 0.1,
        "psf_angle_rad": np.arctan2(-0.08, 0.06) / 2,
        "psf_tilt": 0.5,
        "psf_tilt_angle_rad": np.arctan2(-0.4, 0.3),
        "psf_colour_growth": 0.2,
    }
    assert asdict(full) | {"psf": 0} == pytest.approx(expected | {"psf": 0}, rel=1e-9)
    assert _Shape(1.3, 15.0).psf == _Shape(1.3, e1=1e-4).psf == PointSpread()
    assert (_Shape(1.3, 14.9).psf.psf, _Shape(1.3, 15.1).psf.psf) == ("moffat", "gaussian")
    assert _Shape(1.3, 1.5).psf.psf_beta == 2.05
    far = _Shape(1.3, 20.0, 4.0, 0.5, 0.5, 0.9, 1.0, -2.0, 0.0, -0.7).psf
    assert (far.psf_growth, far.psf_ellipticity, far.psf_wing_fraction) == (3.0, 0.39, 0.8)
    assert (far.psf_tilt, far.psf_colour_growth, far.psf_tilt_angle_rad) == (0.9, -0.5, pytest.approx(np.pi))
    below = _Shape(1.3, 20.0, -1.0, 9e-5, 0.0, -0.1).psf
    assert below == PointSpread()
    assert _Shape(1.3, 20.0, e1=1.1e-4).psf.psf_ellipticity == 1.1e-4
    assert _Shape(1.3, fixed=SHAPED).psf is SHAPED


def test_parameters_are_logarithms_and_inverses() -> None:
    names = ("sigma", "beta", "wing", "ln_wing_px", "tilt_y", "e2")
    shape = _Shape(1.3, 4.0, wing=0.2, ln_wing_px=1.5, tilt_y=-0.3, e2=0.07)
    vector = shape.vector(names)
    np.testing.assert_allclose(vector, [np.log(1.3), 0.25, 0.2, 1.5, -0.3, 0.07], rtol=1e-12)
    again = _Shape(9.0, growth=0.6).at(names, vector)
    assert again.sigma_px == pytest.approx(1.3)
    assert again == replace(shape, sigma_px=again.sigma_px, growth=0.6)
    assert shape.without(("beta",)) == replace(shape, beta=20.0)
    assert shape.without(("wing", "ln_wing_px")) == replace(shape, wing=0.0, ln_wing_px=1.4)
    assert _Shape(1.3).started(("beta",)).beta == 4.0
    assert _Shape(1.3).started(("wing", "ln_wing_px")) == _Shape(1.3, wing=0.1, ln_wing_px=1.1)
    assert _Shape(1.3).started(("tilt_x", "tilt_y")) == _Shape(1.3)


def test_the_limits_of_wings_depend_on_the_stamps() -> None:
    names = ("sigma", "beta", "growth", "tilt_x", "tilt_y", "colour", "e1", "e2", "wing", "ln_wing_px")
    low, high = _limits(stamps_of(side=13), names)
    np.testing.assert_allclose(
        low, [np.log(0.2), 1 / 14.9, 0, -0.9, -0.9, -0.5, -0.27, -0.27, 0, np.log(0.8)], rtol=1e-12
    )
    expected = [np.log(12), 1 / 2.05, 3, 0.9, 0.9, 0.5, 0.27, 0.27, 0.8, np.log(13 / 4)]
    np.testing.assert_allclose(high, expected, rtol=1e-12)
    assert _limits(stamps_of(side=3), ("ln_wing_px",))[1] == 0.0
    assert _limits(stamps_of(count=1, side=61), ("ln_wing_px",))[1] == pytest.approx(np.log(12))


def test_weights_are_those_of_sky_star_and_model() -> None:
    stamps = stamps_of()
    shape = _Shape(1.3, fixed=SHAPED)
    np.testing.assert_array_equal(_weights(stamps, shape, np.zeros(3)), 1 / stamps.variance_dn2)
    flux = np.array([500.0, -20.0, 3000.0])
    model = np.array([500.0, 0, 3000])[:, np.newaxis, np.newaxis] * stamps.profiles(SHAPED, 1.3)
    expected = 1 / (stamps.variance_dn2 + 0.3 * model + (0.03 * model) ** 2)
    np.testing.assert_allclose(_weights(stamps, shape, flux), expected, rtol=1e-12)


def test_residuals_are_those_of_the_best_flux_and_sky() -> None:
    stamps = lit(stamps_of(), SHAPED, 1.3, np.array([500.0, 80.0, 3000.0]), 2.5, noise=3)
    stamps.variance_dn2[1, 4, 5] = np.inf
    values = stamps.values_dn.copy()
    values[1, 4, 5] = np.nan
    stamps = replace(stamps, values_dn=values)
    weight = 1 / stamps.variance_dn2
    residual, flux = _residuals(stamps, _Shape(1.2, fixed=SHAPED), weight)
    profile = stamps.profiles(SHAPED, 1.2)
    for k in range(3):
        root = np.sqrt(weight[k]).ravel()
        design = np.column_stack([profile[k].ravel(), np.ones(169)]) * root[:, np.newaxis]
        data = np.where(root > 0, values[k].ravel(), 0.0) * root
        best, *_ = np.linalg.lstsq(design, data, rcond=None)
        assert flux[k] == pytest.approx(best[0], rel=1e-9)
        np.testing.assert_allclose(residual[k].ravel(), data - design @ best, rtol=0, atol=1e-9)


def test_positions_converge_to_those_of_the_stars() -> None:
    flux = np.array([500.0, 80.0, 3000.0])
    true = stamps_of(seed=4)
    stamps = lit(true, SHAPED, 1.3, flux, 2.5)
    shape, weight = _Shape(1.3, fixed=SHAPED), 1 / stamps.variance_dn2
    off = np.array([[0.2, -0.1], [-0.3, 0.25], [0.05, 0.3]])
    moved = _moved(replace(stamps, xy_px=true.xy_px + off), shape, weight)
    np.testing.assert_allclose(moved.xy_px, true.xy_px, rtol=0, atol=3e-3)
    # A step is 0.4 px at most, three times.
    far = _moved(replace(stamps, xy_px=true.xy_px + np.array([1.9, 0.0])), shape, weight)
    assert (far.xy_px - true.xy_px)[:, 0].min() >= 1.9 - 1.2 - 1e-9
    residual, slopes = _position_slopes(stamps, shape, weight)
    assert (residual.shape, slopes.shape) == ((3, 169, 1), (3, 169, 2))
    for axis in (0, 1):
        step = np.eye(2)[axis] * 1e-4
        ahead, behind = (_residuals(replace(stamps, xy_px=true.xy_px + s * step), shape, weight)[0] for s in (1, -1))
        expected = ((ahead - behind) / 2e-4).reshape(3, -1)
        # The step is forward, and 0.02 px.
        np.testing.assert_allclose(slopes[..., axis], expected, rtol=0, atol=0.03 * np.abs(expected).max())


def test_slopes_are_the_derivatives_by_the_parameters() -> None:
    names = ("sigma", "growth", "e1")
    stamps = lit(stamps_of(seed=5), SHAPED, 1.3, np.array([500.0, 80.0, 3000.0]), 2.5)
    shape, weight = _Shape(1.25, growth=0.4, e1=0.05, e2=0.02), 1 / stamps.variance_dn2
    found = _slopes(stamps, names, shape, weight)
    assert found.shape == (3, 169, 3)
    vector = shape.vector(names)
    for k in range(3):
        step = np.eye(3)[k] * 1e-5
        ahead, behind = (_residuals(stamps, shape.at(names, vector + s * step), weight)[0] for s in (1, -1))
        expected = ((ahead - behind) / 2e-5).reshape(3, -1)
        np.testing.assert_allclose(found[..., k], expected, rtol=0, atol=0.01 * np.abs(expected).max())


def test_fluxes_have_the_errors_of_their_weights() -> None:
    flux = np.array([500.0, 80.0, 3000.0])
    true = stamps_of(seed=6)
    stamps = lit(true, SHAPED, 1.3, flux, 2.5)
    joint = JointPsf(SHAPED, 1.3, {}, 3, 1.0)
    found, error, moved = measure_fluxes(replace(stamps, xy_px=true.xy_px + 0.1), joint)
    np.testing.assert_allclose(found, flux, rtol=1e-3)
    np.testing.assert_allclose(moved.xy_px, true.xy_px, rtol=0, atol=2e-3)
    profile = true.profiles(SHAPED, 1.3)
    model = flux[:, np.newaxis, np.newaxis] * profile
    weight = 1 / (true.variance_dn2 + 0.3 * model + (0.03 * model) ** 2)
    for k in range(3):
        design = np.column_stack([profile[k].ravel(), np.ones(169)])
        covariance = np.linalg.inv(design.T @ (weight[k].ravel()[:, np.newaxis] * design))
        assert error[k] == pytest.approx(np.sqrt(covariance[0, 0]), rel=2e-3)


def test_errors_are_those_of_the_keys() -> None:
    names = ("sigma", "beta", "wing", "ln_wing_px", "growth", "tilt_x", "tilt_y", "colour", "e1", "e2")
    shape = _Shape(1.3, 4.0, 0.4, 0.06, -0.08, 0.15, np.log(3.5), 0.3, -0.4, 0.2)
    sd = np.array([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.07, 0.003, 0.004])
    assert _errors(names, shape, np.diag(sd**2)) == pytest.approx(
        {
            "psf_sigma_px": 0.013,
            "psf_beta": 0.02 * 16,
            "psf_wing_fraction": 0.03,
            "psf_wing_sigma_px": 0.04 * 3.5,
            "psf_growth": 0.05,
            "psf_tilt": 0.1 / np.sqrt(2),
            "psf_tilt_angle_deg": np.rad2deg(0.1 / np.sqrt(2) / 0.5),
            "psf_colour_growth": 0.07,
            "psf_ellipticity": 0.005 / np.sqrt(2),
            "psf_angle_deg": np.rad2deg(0.005 / np.sqrt(2) / 0.2),
        },
        rel=1e-9,
    )
    # Angles of shapes that are almost round have an end.
    round_ = replace(shape, tilt_x=0.0, tilt_y=0.0, e1=0.0, e2=0.0)
    errors = _errors(names, round_, np.diag(sd**2))
    assert errors["psf_tilt_angle_deg"] == pytest.approx(np.rad2deg(0.1 / np.sqrt(2) / 1e-3))
    assert errors["psf_angle_deg"] == pytest.approx(np.rad2deg(0.005 / np.sqrt(2) / 2e-3))
    assert _errors(("sigma",), shape, np.array([[4e-4]])) == {"psf_sigma_px": pytest.approx(0.026)}


@pytest.mark.parametrize(
    ("group", "shape", "sd", "reason"),
    [
        (("growth",), _Shape(1.3, growth=0.31), [0.1], None),
        (("growth",), _Shape(1.3, growth=0.375), [0.125], "psf_growth 0.38 ± 0.12 is not clear of 0"),
        (("growth",), _Shape(1.3, growth=0.29), [0.1], "psf_growth 0.29 ± 0.1 is not clear of 0"),
        (("growth",), _Shape(1.3, growth=2.9935), [0.1], None),
        (("growth",), _Shape(1.3, growth=2.9945), [0.1], "psf_growth 3 ± 0.1 ends at a limit of its fit, which"),
        (("colour",), _Shape(1.3, colour=-0.31), [0.1], None),
        (("colour",), _Shape(1.3, colour=-0.29), [0.1], "psf_colour_growth 0.29 ± 0.1 is not clear of 0"),
        (("tilt_x", "tilt_y"), _Shape(1.3, tilt_x=0.248, tilt_y=0.186), [0.1, 0.1], None),
        (("tilt_x", "tilt_y"), _Shape(1.3, tilt_x=0.232, tilt_y=0.174), [0.1, 0.1], "psf_tilt 0.29 ± 0.1 is not clear"),
        (("tilt_x", "tilt_y"), _Shape(1.3, tilt_x=0.717, tilt_y=0.5377), [0.1, 0.1], None),
        (("tilt_x", "tilt_y"), _Shape(1.3, tilt_x=0.7198, tilt_y=0.5399), [0.1, 0.1], "psf_tilt 0.9 ± 0.1 ends at"),
        (("e1", "e2"), _Shape(1.3, e1=0.1, e2=0.12), [0.05, 0.05], None),
        (("e1", "e2"), _Shape(1.3, e1=0.1, e2=0.11), [0.05, 0.05], "psf_ellipticity 0.15 ± 0.05 is not clear of 0"),
        (("wing", "ln_wing_px"), _Shape(1.3, wing=0.31, ln_wing_px=0.9), [0.1, 0.2], None),
        (("wing", "ln_wing_px"), _Shape(1.3, wing=0.31, ln_wing_px=1.1777), [0.1, 0.2], "psf_wing_fraction 0.31 "),
        # 1 / 5 - 1 / 15 is 0.1333 of the inverse.
        (("beta",), _Shape(1.3, beta=5.0), [0.0443], None),
        (("beta",), _Shape(1.3, beta=5.0), [0.0447], "psf_beta 5 ± 1.1 is not clear of a Gaussian"),
    ],
)  # fmt: skip
def test_a_group_is_clear_beyond_three_errors_and_off_its_limits(group, shape, sd, reason) -> None:
    names = ("sigma", *group)
    found = _unclear(stamps_of(), names, shape, np.diag(np.array([0.01, *sd]) ** 2))
    if reason is None:
        assert found == {}
    else:
        assert list(found) == [group]
        assert found[group].startswith(reason)


def test_the_covariance_is_that_of_leaving_out_each_star() -> None:
    """The jackknife of the linearised fit, for a width: with the positions free, each star moves it by its part."""
    rng = np.random.default_rng(7)
    count = 12
    true = stamps_of(count, seed=8)
    stamps = lit(true, PointSpread(), 1.3, rng.uniform(300, 2000, count), 2.5, noise=9)
    shape, stamps, _ = _fitted(stamps, ("sigma",), _Shape(1.3))
    found = _covariance(stamps, ("sigma",), shape)
    left_out = [
        _fitted(stamps.some(np.arange(count) != k), ("sigma",), shape)[0].vector(("sigma",))[0] for k in range(count)
    ]
    assert found.shape == (1, 1)
    assert np.sqrt(found[0, 0]) == pytest.approx(np.sqrt(np.var(left_out) * (count - 1)), rel=0.3)


def test_a_fit_of_exact_stars_is_exact() -> None:
    true = stamps_of(8, side=15, seed=10)
    stamps = lit(true, PointSpread(psf_growth=0.5), 1.3, np.linspace(300, 2000, 8), 2.5)
    shape, moved, cost = _fitted(stamps, ("sigma", "growth"), _Shape(1.5, growth=0.2))
    assert (shape.sigma_px, shape.growth) == (pytest.approx(1.3, rel=2e-3), pytest.approx(0.5, rel=1e-2))
    assert cost < 0.1
    np.testing.assert_allclose(moved.xy_px, true.xy_px, rtol=0, atol=5e-3)


def test_a_pixel_row_of_a_gaussian_is_its_integral() -> None:
    stamps = stamps_of(1, side=9, xy_px=np.array([[40.3, 50.8]]), corner_px=np.array([[36.0, 47.0]]))
    light = stamps.profiles(PointSpread(), 1.4)[0]
    expected = quad(lambda x: norm.pdf(x, 4.3, 1.4), 1.5, 2.5)[0] * quad(lambda y: norm.pdf(y, 3.8, 1.4), 4.5, 5.5)[0]
    assert light[5, 2] == pytest.approx(expected, rel=1e-9)


def test_stamps_have_no_gain_by_default() -> None:
    given, stamps, _ = cut(np.array([[20.0, 20.0]]), np.array([[20.0, 20.0]]))
    del given["dn_per_e"]
    assert (stamps.dn_per_e, cut_stamps(**given)[0].dn_per_e) == (0.4, 0.0)
    fields = {name: getattr(stamps, name) for name in StarStamps.__slots__ if name != "dn_per_e"}
    assert StarStamps(**fields).dn_per_e == 0.0
