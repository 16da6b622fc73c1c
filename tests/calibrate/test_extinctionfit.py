"""Extinction in a photograph: a known loss by the air is fitted, taken out, and refused where it does not show."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from glstar.calibrate import Calibration, above_air, calibrate, detect_stars, fit_brightness, identify_near
from glstar.camera.sensor import Sensor
from glstar.errors import CalibrationError
from tests.support.starphotos import EXPOSURE_S, StarPhoto

LOSS_MAG = 0.31


@cache
def without_air() -> Calibration:
    drawn = StarPhoto.of(Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.2))
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, drawn.reference, drawn.solution)
    made = calibrate(drawn.image, detected, drawn.reference, matches, method="by attitude", exposure_s=EXPOSURE_S)
    # As if the camera, which looked up, had looked 33 deg above the horizon; without refraction.
    right, _, axis = matches.solution.C_camera_eq
    zenith_eq = np.cos(np.deg2rad(57.0)) * axis + np.sin(np.deg2rad(57.0)) * right
    return replace(made, reference=replace(drawn.reference, zenith_eq=zenith_eq, refraction_scale=0.0))


def masses(calibration: Calibration) -> np.ndarray:
    """Return the air masses by Kasten & Young 1989, eq. (3)."""
    reference = calibration.reference
    sine = reference.stars.direction_eq[calibration.matches.star] @ reference.zenith_eq
    altitude_deg = np.rad2deg(np.arcsin(sine))
    return 1 / (sine + 0.50572 * (altitude_deg + 6.07995) ** -1.6364)


def behind_air(loss_mag: float = LOSS_MAG) -> Calibration:
    """Return the calibration of the stars dimmed by the air."""
    above = without_air()
    peak_dn = above.stars.peak_dn * 10 ** (-0.4 * loss_mag * masses(above))
    fit = fit_brightness(above.stars.vmag, peak_dn, above.brightness.used)
    sensor = replace(above.sensor, reference_peak_dn=fit.reference_peak_dn, reference_vmag=fit.reference_vmag)
    return replace(above, stars=replace(above.stars, peak_dn=peak_dn), brightness=fit, sensor=sensor)


def test_a_given_extinction_is_taken_out():
    above, found = without_air(), above_air(behind_air(), LOSS_MAG)
    assert found.sensor.reference_peak_dn == pytest.approx(above.sensor.reference_peak_dn, rel=0.01)
    np.testing.assert_allclose(found.off_mag, above.off_mag, rtol=0, atol=0.03)
    assert found.air["reference_is"] == "above the air"
    assert "above the air: 0.310 mag per air mass (as given" in found.to_toml()
    assert "below the air" in behind_air().to_toml()


def test_the_fit_finds_the_extinction_within_its_error():
    above, found = without_air(), above_air(behind_air())
    k, error = found.air["zenith_extinction_mag"], found.air["standard_error_mag"]
    assert error < 0.05
    assert abs(k - LOSS_MAG) < 4 * error
    off = found.sensor.reference_peak_dn / above.sensor.reference_peak_dn
    assert abs(2.5 * np.log10(off)) < 4 * found.brightness.error_mag + 0.01


def test_an_image_of_one_altitude_is_refused():
    narrow = behind_air()
    mass = masses(narrow)
    used = narrow.brightness.used & (np.abs(mass - np.median(mass)) < 0.1)
    with pytest.raises(CalibrationError, match=r"air masses differ by 0\.5.* or give"):
        above_air(replace(narrow, brightness=replace(narrow.brightness, used=used)))


def test_an_unknown_site_is_refused():
    unknown = replace(behind_air(), reference=replace(behind_air().reference, C_ned_eq=None))
    with pytest.raises(CalibrationError, match=r"needs the altitude of the stars.*--utc"):
        above_air(unknown, 0.2)
