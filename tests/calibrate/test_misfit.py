"""Effects that the sensor model lacks, measured on images rendered with known effects."""

from functools import cache

import numpy as np
import pytest

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.calibration import Calibration, calibrate
from glstar.calibrate.sensor.report import draw_report
from tests.support.plainphotos import REFERENCE, imperfect, pinhole_camera

# The beginning of each note.
NOTES = {
    "wings": "the stars have wings",
    "vignetting": "the corners are",
    "gradient": "the sky has a gradient",
    "ellipse": "the stars are elliptical",
    "growth": "the stars in the corner are",
    "processing": "as after processing",
    "uneven": "the sky is uneven",
}


@cache
def calibrated(seed: int = 1, **faults: float) -> Calibration:
    drawn = imperfect(seed, **faults)
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, REFERENCE, PlateSolution(pinhole_camera(drawn, 42.0), drawn.C_camera_eq))
    return calibrate(drawn.image, detected, REFERENCE, matches, method="by attitude", exposure_s=0.5)


def named(found: Calibration) -> set[str]:
    """Return the kinds of notes of a calibration."""
    return {name for name, words in NOTES.items() if any(words in note.text for note in found.notes)}


def number(found: Calibration, name: str) -> float:
    return found.to_json()["misfit"][name]["value"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_camera_that_fits_the_model_has_no_note_of_a_misfit(seed: int) -> None:
    assert named(calibrated(seed)) == set()


def test_moffat_wings_are_noted_with_their_flux() -> None:
    found = calibrated(moffat_beta=3.0)

    assert named(found) == {"wings"}
    # Between 3 and 8 of the fitted sigma, a Moffat profile with beta 3 has 6 to 12 % more flux than the Gaussian.
    assert 0.05 < number(found, "wing_fraction_beyond_gaussian") < 0.14


def test_vignetting_is_noted_with_the_loss_in_the_corner() -> None:
    found = calibrated(corner_loss=0.4)

    assert "vignetting" in named(found)
    assert not named(found) & {"wings", "gradient", "ellipse", "growth"}
    loss = found.misfit.corner_loss_mag
    assert loss.value == pytest.approx(-2.5 * np.log10(1 - 0.4), abs=max(4 * loss.standard_error, 0.1))  # mag
    # Stars in the corners are fainter than those in the middle.
    off_mag = np.array(found.to_json()["misfit"]["brightness_residual_map_mag"], dtype=np.float64)
    assert np.nanmean(off_mag[[0, 0, -1, -1], [0, -1, 0, -1]]) > np.nanmean(off_mag[1, 1:3]) + 0.1


def test_a_sky_that_vignetting_makes_uneven_is_not_noted_twice() -> None:
    found = calibrated(corner_loss=0.75)

    assert found.detected.sky.unevenness_dn > 2 * found.detected.sky.std_dn
    assert named(found) == {"vignetting"}


def test_a_gradient_too_faint_to_matter_is_in_the_numbers_and_not_in_the_notes() -> None:
    found = calibrated(gradient_dn=3.0)

    assert named(found) == set()
    assert number(found, "sky_gradient_dn") == pytest.approx(3.0, abs=0.5)  # DN


def test_a_sky_gradient_is_noted_once_with_its_size_and_direction() -> None:
    found = calibrated(gradient_dn=30.0)

    # The uneven background has this note only.
    assert found.detected.sky.unevenness_dn > 2 * found.detected.sky.std_dn
    assert named(found) == {"gradient"}
    assert number(found, "sky_gradient_dn") == pytest.approx(30.0, abs=2.0)  # DN
    assert "towards the right" in next(note.text for note in found.notes if NOTES["gradient"] in note.text)


def test_elliptical_stars_are_noted_with_axis_ratio_and_direction() -> None:
    found = calibrated(axis_ratio=1.2)

    assert named(found) == {"ellipse"}
    assert found.misfit.axis_ratio == pytest.approx(1.2, abs=0.03)
    assert np.rad2deg(found.misfit.long_axis_rad) == pytest.approx(30.0, abs=5.0)  # deg


def test_stars_that_widen_off_the_axis_are_noted_and_are_no_vignetting() -> None:
    found = calibrated(corner_growth=0.3)

    assert named(found) == {"growth"}
    assert number(found, "corner_sigma_growth") == pytest.approx(0.3, abs=0.06)


def test_an_image_demosaiced_from_colours_is_noted() -> None:
    found = calibrated(demosaiced=True)

    assert named(found) == {"processing"}
    assert number(found, "noise_neighbour_correlation") > 0.15


def test_the_report_shows_the_misfits() -> None:
    assert draw_report(calibrated(moffat_beta=3.0)).startswith(b"\x89PNG")
