"""The shape of the stars as sensor keys, measured on images rendered with known shapes."""

from functools import cache

import numpy as np
import pytest

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.notes import NoteKind
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.calibration import Calibration, calibrate, fit_moffat, with_point_spread
from glstar.calibrate.sensor.misfit import RadialProfile
from glstar.config import Config
from tests.support.plainphotos import REFERENCE, imperfect, pinhole_camera

TRUE_SIGMA_PX = 1.3


@cache
def calibrated(seed: int = 1, **shape: float) -> Calibration:
    drawn = imperfect(seed, **shape)
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, REFERENCE, PlateSolution(pinhole_camera(drawn, 42.0), drawn.C_camera_eq))
    return calibrate(drawn.image, detected, REFERENCE, matches, method="by attitude", exposure_s=0.5)


def keys(calibration: Calibration) -> dict[str, float]:
    return {key.removeprefix("sensor."): value for key, value in with_point_spread(calibration).sensor.effects.items()}


def test_round_gaussian_stars_need_no_other_shape():
    assert not keys(calibrated()).keys() & {"psf_growth", "psf_ellipticity"}
    assert keys(calibrated()).get("psf_beta", 20.0) > 6


@pytest.mark.parametrize("beta", [2.5, 3.5])
def test_moffat_stars_are_measured_with_their_exponent_width_and_flux(beta):
    before, after = calibrated(moffat_beta=beta), with_point_spread(calibrated(moffat_beta=beta))
    assert after.sensor.effects["sensor.psf"] == "moffat"
    assert after.sensor.effects["sensor.psf_beta"] == pytest.approx(beta, rel=0.25, abs=0)
    assert after.sensor.psf_sigma_px == pytest.approx(TRUE_SIGMA_PX, rel=0.06, abs=0)
    # Amplitude of the true profile at the reference magnitude: see `imperfect`.
    true_peak = 36.0 * 10 ** (-0.4 * (before.sensor.reference_vmag - 5.6))
    assert after.sensor.reference_peak_dn == pytest.approx(true_peak, rel=0.1, abs=0)
    kinds_before, kinds_after = ({note.kind for note in shaped.notes} for shaped in (before, after))
    assert NoteKind.WINGS in kinds_before - kinds_after


def test_growth_to_the_corners_becomes_a_key_with_its_width_on_the_axis():
    after = with_point_spread(calibrated(corner_growth=0.5))
    assert after.sensor.effects["sensor.psf_growth"] == pytest.approx(0.5, abs=0.15)
    assert after.sensor.psf_sigma_px == pytest.approx(TRUE_SIGMA_PX, rel=0.08, abs=0)


def test_elliptical_stars_become_keys_with_the_direction_of_their_long_axis():
    measured = keys(calibrated(axis_ratio=1.25))
    assert measured["psf_ellipticity"] == pytest.approx(1 - 1 / 1.25, abs=0.04)
    assert measured["psf_angle_deg"] == pytest.approx(30.0, abs=6)


def test_the_written_calibration_is_a_sensor_with_that_shape(tmp_path):
    (tmp_path / "c.toml").write_text(with_point_spread(calibrated(moffat_beta=2.5)).to_toml())
    sensor = Config.load(tmp_path / "c.toml").sensor()
    assert sensor.point_spread.psf == "moffat"


def test_a_profile_is_fitted_with_the_width_and_the_exponent_that_it_has():
    radius = (np.arange(16) + 0.5) / 2
    beta, width, amplitude = fit_moffat(RadialProfile(radius, 1.2 * (1 + (radius / 2.2) ** 2) ** -3.0))
    assert (beta, amplitude) == (pytest.approx(3.0, rel=1e-3, abs=0), pytest.approx(1.2, rel=1e-3, abs=0))
    assert width == pytest.approx(2 * 2.2 * np.sqrt(2 ** (1 / 3) - 1) / 2.354820, rel=1e-3, abs=0)
