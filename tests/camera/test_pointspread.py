"""Point spread functions as sums of Gaussians, and their keys."""

import numpy as np
import pytest

from glstar.camera.sensor.pointspread import PointSpread, moffat_mixture
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.errors import ConfigError


@pytest.mark.parametrize(
    ("beta", "tolerance"), [(2.0, 5e-3), (2.3, 5e-3), (2.5, 4e-3), (3.2, 2e-3), (6.5, 1e-3), (20.0, 1e-3)]
)
def test_a_mixture_has_the_encircled_energy_and_the_profile_of_its_moffat_function(beta, tolerance):
    flux, sigma = np.transpose(moffat_mixture(beta))
    r = np.geomspace(0.01, 100, 500)
    inside = 1 - np.exp(-np.outer(r**2, 0.5 / sigma**2))
    assert np.abs(inside @ flux - (1 - (1 + r**2) ** (1 - beta))).max() < tolerance
    amplitude = (1 - inside) @ (flux / (2 * np.pi * sigma**2)) * np.pi / (beta - 1)
    assert np.abs(amplitude - (1 + r**2) ** -beta).max() < tolerance
    assert flux.min() > 0
    assert flux.sum() == pytest.approx(1, rel=1e-12, abs=0)


def test_all_gaussians_of_a_star_together_have_its_flux():
    psf = PointSpread("moffat", 2.7, 0.1, 5.0, 0.02, 30.0, 0.3, 0.2, 0.7)
    components = psf.components(1.3, scale=1.2)
    assert sum(one.flux_fraction for one in components) == pytest.approx(1, rel=1e-12, abs=0)
    assert np.sum([np.multiply(one.flux_fraction, one.offset_px) for one in components]) == pytest.approx(0, abs=1e-12)


def test_the_width_is_linear_in_the_direction_of_the_tilt_and_in_colour():
    psf = PointSpread(psf_growth=0.5, psf_tilt=0.3, psf_tilt_angle_rad=np.pi / 2, psf_colour_growth=0.2)
    assert psf.scale_at([0.0, 0.0]) == 1
    assert psf.scale_at([0.6, 0.0]) == pytest.approx(1 + 0.5 * 0.36, rel=1e-12, abs=0)
    assert psf.scale_at([0.0, -0.8]) == pytest.approx(1 + 0.5 * 0.64 - 0.3 * 0.8, rel=1e-12, abs=0)
    assert psf.scale_at([0.0, 0.0], [1.65, -0.15]) == pytest.approx([1.2, 0.84], rel=1e-12, abs=0)


def test_no_star_on_an_image_is_wider_or_narrower_than_the_range():
    rng = np.random.default_rng(1)
    for _ in range(200):
        psf = PointSpread(
            psf_growth=rng.uniform(0, 1), psf_tilt=rng.uniform(0, 0.9), psf_tilt_angle_rad=rng.uniform(-3, 3),
            psf_colour_growth=rng.uniform(-0.5, 0.5),
        )  # fmt: skip
        angle, distance = rng.uniform(0, 2 * np.pi, 50), rng.uniform(0, 1, 50)
        offset = distance[:, np.newaxis] * np.column_stack([np.cos(angle), np.sin(angle)])
        scales = psf.scale_at(offset, rng.uniform(-1, 3, 50))
        low, high = psf.scale_range
        assert low - 1e-12 <= scales.min() <= scales.max() <= high + 1e-12


def test_the_keys_of_a_shape_give_the_shape_again():
    psf = PointSpread("moffat", 2.7, 0.1, 5.0, 0.02, 30.0, 0.3, 0.2, 0.7, 0.25, -2.4, -0.1)
    assert set(psf.keys) == {"psf", *(f"psf_{name}" for name in (
        "beta", "wing_fraction", "wing_sigma_px", "halo_fraction", "halo_radius_px", "growth", "ellipticity",
        "angle_deg", "tilt", "tilt_angle_deg", "colour_growth",
    ))}  # fmt: skip
    again = PointSpread.of({f"sensor.{key}": value for key, value in psf.keys.items()})
    assert (again.psf_tilt, again.psf_halo_radius_px, again.psf_colour_growth) == (0.25, 30.0, -0.1)
    assert again.psf_tilt_angle_rad == pytest.approx(-2.4, rel=1e-12, abs=0)
    assert again.psf_angle_rad == pytest.approx(0.7, rel=1e-12, abs=0)


def test_an_ellipse_has_the_moments_of_its_axes():
    components = PointSpread(psf_ellipticity=0.3, psf_angle_rad=np.pi / 2).components(2.0)
    x, y = (
        sum(one.flux_fraction * (one.sigma_px**2 + one.offset_px[axis] ** 2) for one in components) for axis in (0, 1)
    )
    assert np.sqrt(x) == pytest.approx(2 * np.sqrt(0.7), rel=1e-9, abs=0)
    assert np.sqrt(y) == pytest.approx(2 / np.sqrt(0.7), rel=1e-9, abs=0)


def test_a_plain_gaussian_is_drawn_as_before():
    assert Sensor().point_spread.is_gaussian
    assert Sensor().flux_dn(100.0) == 2 * np.pi * 1.2**2 * 100.0
    assert Config().sensor().effects == {}


def test_wings_raise_the_flux_for_the_same_amplitude():
    plain, winged = Sensor(), Sensor(effects={"sensor.psf_wing_fraction": 0.5, "sensor.psf_wing_sigma_px": 1.2})
    assert winged.flux_dn(1.0) == pytest.approx(plain.flux_dn(1.0), rel=1e-12, abs=0)
    wide = Sensor(effects={"sensor.psf_wing_fraction": 0.5, "sensor.psf_wing_sigma_px": 12.0})
    assert wide.flux_dn(1.0) == pytest.approx(plain.flux_dn(1.0) * 2 / 1.01, rel=1e-12, abs=0)
    assert wide.truncation_radius_px(150.0) > 3 * plain.truncation_radius_px(150.0)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"psf_beta": 1.5}, "sensor.psf_beta"),
        ({"psf": "lorentzian"}, "sensor.psf"),
        ({"psf_ellipticity": 0.5}, "sensor.psf_ellipticity"),
        ({"psf_wing_fraction": 0.8, "psf_halo_fraction": 0.3}, "sensor.psf_halo_fraction"),
    ],
)
def test_an_impossible_shape_is_an_error_that_names_the_key(keys, named):
    with pytest.raises(ConfigError, match=named.replace("sensor.", r".*")):
        Config().override(**{f"sensor.{key}": value for key, value in keys.items()}).sensor()


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [
        ("psf_beta", 2.0, 20.0),
        ("psf_wing_fraction", 0.0, 0.9),
        ("psf_wing_sigma_px", 0.1, 40.0),
        ("psf_halo_fraction", 0.0, 0.5),
        ("psf_halo_radius_px", 1.0, 40.0),
        ("psf_growth", 0.0, 4.0),
        ("psf_ellipticity", 0.0, 0.4),
        ("psf_angle_rad", -2 * np.pi, 2 * np.pi),
        ("psf_tilt", 0.0, 0.9),
        ("psf_tilt_angle_rad", -2 * np.pi, 2 * np.pi),
        ("psf_colour_growth", -0.5, 0.5),
    ],
)
def test_the_limits_of_each_value_are_valid_and_what_lies_beyond_is_not(key, low, high):
    for value in (low, high):
        assert getattr(PointSpread(**{key: value}), key) == value
    for value in (low - 1e-6, high + 1e-6):
        with pytest.raises(ConfigError) as caught:
            PointSpread(**{key: value})
        assert caught.value.key == f"sensor.{key}"


def test_the_core_has_what_wings_and_halo_leave():
    psf = PointSpread(psf_wing_fraction=0.3, psf_wing_sigma_px=7.0, psf_halo_fraction=0.1, psf_halo_radius_px=16.0)
    core, wings, *halo = psf.circular(1.0)
    assert (core.flux_fraction, core.sigma_px) == (pytest.approx(0.6, rel=1e-12), 1.0)
    assert (wings.flux_fraction, wings.sigma_px) == (0.3, 7.0)
    # From its radius down in factors of 2, to twice the core.
    assert [one.sigma_px for one in halo] == [16.0, 8.0, 4.0, 2.0]
    assert [one.flux_fraction for one in halo] == pytest.approx([0.025] * 4, rel=1e-12)
    with pytest.raises(ConfigError, match="leaves 0 of the flux"):
        PointSpread(psf_wing_fraction=0.5, psf_halo_fraction=0.5).circular(1.0)


@pytest.mark.parametrize("beta", [2.5, 4.0])
def test_a_moffat_core_has_the_width_at_half_maximum_of_its_gaussian(beta):
    r = np.linspace(0, 6, 6001)
    profile = sum(
        one.flux_fraction / one.sigma_px**2 * np.exp(-(r**2) / (2 * one.sigma_px**2))
        for one in PointSpread("moffat", beta).circular(2.0)
    )
    half_px = r[np.argmax(profile < profile[0] / 2)]
    assert half_px == pytest.approx(2.0 * np.sqrt(2 * np.log(2)), rel=0.01)


def test_only_what_differs_from_one_gaussian_is_none():
    assert PointSpread(psf_wing_sigma_px=9.0, psf_beta=5.0).is_gaussian
    for keys in (
        {"psf": "moffat"}, {"psf_wing_fraction": 0.1}, {"psf_halo_fraction": 0.1}, {"psf_ellipticity": 0.1},
        {"psf_growth": 0.1}, {"psf_tilt": 0.1}, {"psf_colour_growth": 0.1},
    ):  # fmt: skip
        psf = PointSpread(**keys)
        assert not psf.is_gaussian
        assert psf.varies == any(key in keys for key in ("psf_growth", "psf_tilt", "psf_colour_growth"))


def test_stars_are_never_narrower_than_a_fifth():
    psf = PointSpread(psf_tilt=0.9)
    assert psf.scale_at([-1.0, 0.0]) == 0.2
    assert psf.scale_at([-0.88, 0.0]) == pytest.approx(1 - 0.9 * 0.88, rel=1e-12)
