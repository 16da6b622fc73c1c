"""Extinction in a photograph: a known loss by the air is fitted, taken out, and refused where it does not show."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.notes import NoteKind
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.brightness import above_air, above_air_together, with_air_noted
from glstar.calibrate.sensor.calibration import Calibration, calibrate
from glstar.calibrate.sensor.combine import combine
from glstar.calibrate.sensor.fit import fit_brightness
from glstar.calibrate.sensor.misfitmeasurement import corner_distance, measure_misfit
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError
from tests.support.starphotos import EXPOSURE_S, StarPhoto

LOSS_MAG = 0.31


@cache
def without_air() -> Calibration:
    drawn = StarPhoto.of(Sensor(reference_peak_dn=1500.0, psf_sigma_px=1.2))
    detected = detect_stars(drawn.image)
    matches = identify_near(detected, drawn.reference, drawn.solution)
    made = calibrate(drawn.image, detected, drawn.reference, matches, method="by attitude", exposure_s=EXPOSURE_S)
    return looking(made, 33.0)


def looking(calibration: Calibration, altitude_deg: float) -> Calibration:
    """Return a calibration as if the camera, which looked up, had looked above the horizon; without refraction."""
    right, _, axis = calibration.matches.solution.C_camera_eq
    off_rad = np.deg2rad(90 - altitude_deg)
    zenith_eq = np.cos(off_rad) * axis + np.sin(off_rad) * right
    return replace(calibration, reference=replace(calibration.reference, zenith_eq=zenith_eq, refraction_scale=0.0))


def masses(calibration: Calibration) -> np.ndarray:
    """Return the air masses by Kasten & Young 1989, eq. (3)."""
    reference = calibration.reference
    sine = reference.stars.direction_eq[calibration.matches.star] @ reference.zenith_eq
    altitude_deg = np.rad2deg(np.arcsin(sine))
    return 1 / (sine + 0.50572 * (altitude_deg + 6.07995) ** -1.6364)


def behind_air(loss_mag: float = LOSS_MAG, *, haze_mag: float = 0.0, altitude_deg: float = 33.0) -> Calibration:
    """Return the calibration of the stars dimmed by the air, and by haze that is the same in all directions."""
    above = looking(without_air(), altitude_deg)
    peak_dn = above.stars.peak_dn * 10 ** (-0.4 * (loss_mag * masses(above) + haze_mag))
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


def test_several_images_give_one_extinction_and_an_offset_each():
    hazy, clear = behind_air(haze_mag=0.4), behind_air(altitude_deg=60.0)
    with pytest.raises(CalibrationError, match=r"air masses differ by 0\.5.* or give"):
        above_air(clear)
    found, alone = above_air_together((hazy, clear)), above_air(hazy)
    terms = [part.air for part in found]
    assert terms[0] == terms[1]
    k, error = terms[0]["zenith_extinction_mag"], terms[0]["standard_error_mag"]
    assert abs(k - LOSS_MAG) < 4 * error
    assert terms[0]["stars"] == alone.air["stars"] + int(clear.brightness.used.sum())
    # It is the same photograph twice: its stars count once.
    assert alone.air["standard_error_mag"] / 2**0.5 < error < 0.01
    peaks = [part.sensor.peak_dn(np.array([3.0]), EXPOSURE_S)[0] for part in found]
    assert -2.5 * np.log10(peaks[0] / peaks[1]) == pytest.approx(0.4, rel=0, abs=0.03)

    combined = combine(found)
    assert combined.fainter_mag[0] - combined.fainter_mag[1] == pytest.approx(0.4, rel=0, abs=0.03)
    assert sum("above the air" in note.text for note in combined.notes) == 1
    assert combined.to_json()["extinction"] == terms[0]
    assert "below the air" not in combined.to_toml("stars.csv")
    assert "below the air" in combine((hazy, clear)).to_toml("stars.csv")


def test_a_given_extinction_is_taken_out_of_several_images():
    for part, above in zip(
        above_air_together((behind_air(), behind_air(altitude_deg=60.0)), LOSS_MAG), (without_air(),) * 2, strict=True
    ):
        assert part.sensor.reference_peak_dn == pytest.approx(above.sensor.reference_peak_dn, rel=0.01)


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


def with_misfit(calibration: Calibration) -> Calibration:
    """Return a calibration with the notes on what its model lacks."""
    given = calibration.image, calibration.detected, calibration.matches
    misfit = measure_misfit(*given, calibration.sensor, calibration.brightness, calibration.stars)
    return replace(calibration, misfit=misfit, notes=misfit.notes(calibration.sensor))


def test_darker_corners_of_a_low_image_are_put_down_to_the_air():
    """Behind 0.28 mag per air mass, 33 deg high, the corners of an image without vignetting are 25 % darker."""
    seen = with_misfit(behind_air(0.28))
    assert "the corners are 25 % darker than the centre" in str(seen.notes[0])

    [note] = with_air_noted(seen).notes

    assert note.kind is NoteKind.VIGNETTING
    assert "the air dims the stars by 0.279 ± 0.002 mag per air mass" in note.text
    assert "the corners are as bright as the centre without it" in note.text
    assert "--extinction fit" in note.text


def test_darker_corners_without_the_air_stay_vignetting():
    above = without_air()
    across = corner_distance(above.image, above.matches, above.stars.xy_px)
    peak_dn = above.stars.peak_dn * 10 ** (-0.4 * 0.4 * across**2)
    dark = with_misfit(replace(above, stars=replace(above.stars, peak_dn=peak_dn)))
    assert "vignetting" in str(dark.notes[0])

    assert with_air_noted(dark).notes == dark.notes


def test_darker_corners_by_lens_and_air_have_both_notes():
    low = behind_air(0.28)
    across = corner_distance(low.image, low.matches, low.stars.xy_px)
    peak_dn = low.stars.peak_dn * 10 ** (-0.4 * 0.4 * across**2)
    both = with_air_noted(with_misfit(replace(low, stars=replace(low.stars, peak_dn=peak_dn))))

    air, lens = (note.text for note in both.notes)
    assert "per air mass" in air
    assert "the corners are as bright" not in air
    assert "vignetting" in lens


def test_without_altitudes_darker_corners_stay_vignetting():
    seen = with_misfit(behind_air(0.28))
    unknown = replace(seen, reference=replace(seen.reference, C_ned_eq=None))

    assert with_air_noted(unknown).notes == seen.notes
