"""A calibration by hand: what is written of it, its doubtful numbers, and the shape of its stars."""

import csv
import io
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from glstar import __version__
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.sensor.calibration import _doubtful, fit_moffat, with_point_spread
from glstar.calibrate.sensor.misfit import Measurement, RadialProfile
from tests.support.handmade import PLAIN, handmade, with_stars

OFF = np.array([0.1, -0.2, 0.05, 0.3, -0.15, 0.0, 0.22, -0.08, 0.12, -0.3, 0.18, 0.02])


def test_brightness_is_compared_with_the_fit_behind_the_air() -> None:
    part = handmade(OFF)
    middle = np.median(OFF)
    np.testing.assert_allclose(part.off_mag, OFF - middle, rtol=0, atol=1e-12)
    air = replace(part, extinction_mag=np.linspace(0.2, 0.5, 12))
    np.testing.assert_array_equal(air.arriving_mag, part.stars.vmag + np.linspace(0.2, 0.5, 12))
    np.testing.assert_array_equal(part.arriving_mag, part.stars.vmag)
    np.testing.assert_allclose(air.off_mag, OFF - middle - np.linspace(0.2, 0.5, 12), rtol=0, atol=1e-12)
    np.testing.assert_allclose(air.fitted_peak_dn, air.brightness.peak_dn(air.arriving_mag), rtol=1e-12)
    dark = with_stars(part, peak_dn=np.full(12, -1.0))
    np.testing.assert_allclose(dark.off_mag, 2.5 * np.log10(part.fitted_peak_dn / 1e-3), rtol=1e-12)
    error = part.brightness.error_mag
    assert part.sensor_standard_error == {
        "reference_peak_dn": pytest.approx(part.sensor.reference_peak_dn * (10 ** (0.4 * error) - 1), rel=1e-12),
        "psf_sigma_px": 0.02,
    }


def test_what_is_written_as_json() -> None:
    used = np.arange(12) < 10
    part = handmade(OFF)
    part = replace(part, brightness=replace(part.brightness, used=used), notes=(Note(NoteKind.SENSOR, "a note"),))
    json, fit = part.to_json(), part.brightness
    assert json["image"]["exposure_s"] == 0.5
    assert json["trails"] == {"longest_px": 0.0, "drawn_out_px": 0.0, "model": "none"}
    wrong = np.abs(1 - 10 ** (0.4 * part.off_mag[:10]))
    assert json["brightness"] == {
        "criterion": "median",
        "stars_used": 10,
        "scatter_mag": fit.scatter_mag,
        "error_mag": fit.error_mag,
        "mean_absolute_error_percent": pytest.approx(100 * wrong.mean(), rel=1e-12),
        "slope_dex_per_mag": fit.slope_dex_per_mag,
        "slope_95_percent": [fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag],
    }
    assert json["sky"] == {
        "mean_dn": 50.0, "std_dn": 4.0, "unevenness_dn": 0.7, "pixels": 100000, "share_at_zero": 0.125,
    }  # fmt: skip
    assert json["extinction"] == {"reference_is": "below the air"}
    assert (json["notes"], json["schema"], json["glstar"]) == (["a note"], 2, __version__)
    assert (json["sensor"], json["sensor_standard_error"]) == (part.sensor.keys, part.sensor_standard_error)
    assert json["misfit"] == PLAIN.to_json()
    trails = np.zeros((12, 2))
    trails[3] = 3.0, 4.0
    moving = with_stars(part, trail_px=trails).to_json()["trails"]
    assert moving == {"longest_px": 5.0, "drawn_out_px": 0.0, "model": "the turning sky"}
    assert replace(part, air={"k": 1.0}).to_json()["extinction"] == {"k": 1.0}


def test_what_is_written_as_toml_and_csv() -> None:
    part = handmade(OFF)
    saturated, blended = np.arange(12) == 1, np.arange(12) == 2
    part = replace(with_stars(part, saturated=saturated, blended=blended), notes=(Note(NoteKind.SENSOR, "a note"),))
    part = replace(part, brightness=replace(part.brightness, used=np.arange(12) > 2))
    text = part.to_toml()
    head = text.splitlines()
    assert head[:3] == [
        f"# Calibrated by glstar {__version__} from a.png: 12 stars identified (by hand), 9 used.",
        "# reference_peak_dn has the extinction of that night in it: it is below the air.",
        "# a note.",
    ]
    assert tomllib.loads(text)["sensor"]["psf_sigma_px"] == pytest.approx(1.35)
    assert "below the air" not in replace(part, air={"k": 1.0}).to_toml()
    rows = list(csv.DictReader(io.StringIO(part.to_csv())))
    assert len(rows) == 12
    stars = part.stars
    for k, row in enumerate(rows):
        assert row == {
            "catalogue": "bsc5",
            "star_id": str(1000 + k),
            "name": f"S{k}",
            "vmag": f"{stars.vmag[k]:.2f}",
            "x_px": f"{stars.xy_px[k, 0]:.4f}",
            "y_px": f"{stars.xy_px[k, 1]:.4f}",
            "residual_x_px": f"{0.01 * k:.4f}",
            "residual_y_px": f"{-0.02 * k:.4f}",
            "peak_dn": f"{stars.peak_dn[k]:.4f}",
            "fitted_peak_dn": f"{part.fitted_peak_dn[k]:.4f}",
            "sigma_px": f"{1.3 + 0.002 * k:.4f}",
            "signal_to_noise": f"{stars.peak_dn[k] / 4.0:.4f}",
            "saturated": str(int(k == 1)),
            "blended": str(int(k == 2)),
            "used": str(int(k > 2)),
        }
    geometry = part.geometry
    assert (geometry.image, geometry.matches, geometry.method, geometry.notes) == (
        part.image,
        part.matches,
        "by hand",
        part.notes,
    )


def doubts(part, **given) -> list[str]:
    fields = {
        "detected": part.detected,
        "sensor": part.sensor,
        "fit": part.brightness,
        "stars": part.stars,
        "misfit": PLAIN,
    }
    return [note.text for note in _doubtful(**fields | given)]


def test_doubtful_numbers_are_noted() -> None:
    part = handmade(OFF)
    fit = replace(part.brightness, slope_dex_per_mag=-0.4, slope_low_dex_per_mag=-0.42, slope_high_dex_per_mag=-0.38)
    part = replace(part, brightness=fit)
    assert doubts(part) == []
    trails = np.zeros((12, 2))
    trails[3] = 3.0, 4.0
    moving = replace(part.stars, trail_px=trails)
    drawn_out = replace(part.detected, drawn_out_px=6.25)
    said = "the stars moved by up to 5.0 px in 0.5 s (sidereal motion): sigma and brightness are corrected for it"
    assert doubts(part, stars=moving) == doubts(part, stars=moving, detected=drawn_out) == [said]
    kinds = [note.kind for note in _doubtful(part.detected, part.sensor, fit, moving, PLAIN)]
    assert kinds == [NoteKind.MOTION]
    assert doubts(part, detected=drawn_out) == [
        "the stars are elongated by about 6.2 px but were fitted as round: sigma includes the blur; hold the camera"
        " still, focus, and use a shorter exposure"
    ]
    # Nine stars are few, and ten are enough.
    assert doubts(part, fit=replace(fit, used=np.arange(12) < 10)) == []
    few = doubts(part, fit=replace(fit, used=np.arange(12) < 9, error_mag=0.0625))
    assert few == ["the brightness is measured on 9 stars only: ± 0.06 mag"]
    # A quarter of the stars may be saturated, and a third not.
    assert doubts(part, stars=replace(part.stars, saturated=np.arange(12) < 3)) == []
    assert doubts(part, stars=replace(part.stars, saturated=np.arange(12) < 4)) == [
        "4 of 12 identified stars are saturated; a shorter exposure would measure brightness and sigma better"
    ]
    ten = handmade(OFF[:10])
    ten = replace(ten, brightness=replace(fit, used=np.ones(10, bool)))
    assert doubts(ten, stars=replace(ten.stars, saturated=np.arange(10) < 3)) == []


@pytest.mark.parametrize(
    ("std_dn", "uneven_dn", "noted"),
    [(4.0, 7.8, False), (4.0, 8.0, False), (4.0, 8.2, True), (0.3, 1.9, False), (0.3, 2.1, True)],
)
def test_an_uneven_sky_is_noted_beyond_twice_its_noise(std_dn: float, uneven_dn: float, noted: bool) -> None:
    part = handmade(OFF)
    fit = replace(part.brightness, slope_dex_per_mag=-0.4)
    sky = replace(part.detected.sky, std_dn=std_dn, unevenness_dn=uneven_dn)
    found = _doubtful(replace(part.detected, sky=sky), part.sensor, fit, part.stars, PLAIN)
    expected = (
        f"the sky is uneven: its level differs by {uneven_dn:.1f} DN over the image, its noise is {std_dn:.1f} DN, and"
        " the sensor model has a single level"
    )
    assert [(note.kind, note.text) for note in found] == ([(NoteKind.UNEVEN_SKY, expected)] if noted else [])


def test_a_response_that_is_not_linear_is_noted_with_its_gamma() -> None:
    part = handmade(OFF)
    fit = replace(
        part.brightness,
        reference_vmag=4.0,
        slope_dex_per_mag=-0.32,
        slope_low_dex_per_mag=-0.33,
        slope_high_dex_per_mag=-0.31,
    )
    [text] = doubts(part, fit=fit)
    bright, faint = part.stars.vmag.min(), part.stars.vmag.max()
    ends = [100 * (10 ** (-0.08 * (m - 4.0)) - 1) for m in (bright, faint)]
    assert text == (
        "brightness falls by 0.32 dex per magnitude and flux by 0.40: the response is not linear, but has a gamma of"
        " 0.80 (JPEG, processing): take raw images, or try --gamma 1.2; the calibration holds at 4.0 mag, and the"
        f" simulated peaks are off by {ends[0]:+.0f} % at {bright:.1f} mag, {ends[1]:+.0f} % at {faint:.1f} mag"
    )
    flat = replace(fit, slope_dex_per_mag=-0.02, slope_low_dex_per_mag=-0.03, slope_high_dex_per_mag=-0.01)
    assert "try --gamma 10;" in doubts(part, fit=flat)[0]


RADII = 0.25 + 0.5 * np.arange(16)


@pytest.mark.parametrize(("amplitude", "alpha", "beta"), [(0.9, 2.2, 2.6), (1.1, 3.5, 5.0)])
def test_a_moffat_profile_is_found_exactly(amplitude: float, alpha: float, beta: float) -> None:
    brightness = amplitude * (1 + (RADII / alpha) ** 2) ** -beta
    brightness[3] = np.nan
    found = fit_moffat(RadialProfile(RADII, brightness))
    fwhm = 2 * alpha * np.sqrt(2 ** (1 / beta) - 1)
    assert found == pytest.approx((beta, fwhm / np.sqrt(8 * np.log(2)), amplitude), rel=1e-4)


def test_the_exponent_of_a_moffat_profile_is_from_2_to_20() -> None:
    assert fit_moffat(RadialProfile(RADII, np.exp(-(RADII**2) / 2)))[0] == pytest.approx(20.0, rel=1e-3)
    assert fit_moffat(RadialProfile(RADII, (1 + RADII**2) ** -1.5))[0] == pytest.approx(2.0, rel=1e-3)


def test_a_profile_is_weighted_with_the_root_of_its_area() -> None:
    """A bump moves the fit by what the weighted normal equations say."""
    brightness = 0.9 * (1 + (RADII / 2.2) ** 2) ** -2.6
    brightness[12] += 0.01
    beta, width, amplitude = fit_moffat(RadialProfile(RADII, brightness))
    alpha = width * np.sqrt(8 * np.log(2)) / (2 * np.sqrt(2 ** (1 / beta) - 1))

    def model(a: float, s: float, b: float) -> np.ndarray:
        return a * (1 + (RADII / s) ** 2) ** -b

    residual = brightness - model(amplitude, alpha, beta)
    for step in np.eye(3) * 1e-5:
        slope = (
            model(*(np.array([amplitude, alpha, beta]) + step)) - model(*(np.array([amplitude, alpha, beta]) - step))
        ) / 2e-5
        assert abs((RADII * residual * slope).sum()) < 1e-3 * np.sqrt(
            (RADII * residual**2).sum() * (RADII * slope**2).sum()
        )


def shaped(**changes: object):
    part = handmade(OFF)
    notes = (Note(NoteKind.WINGS, "wings"), Note(NoteKind.GRADIENT, "sky"), Note(NoteKind.ELLIPSE, "long"))
    return part, with_point_spread(replace(part, notes=notes, misfit=replace(PLAIN, **changes)))


def test_plain_stars_stay_gaussians() -> None:
    part, found = shaped()
    assert found.sensor == part.sensor
    assert [note.text for note in found.notes] == ["sky", "shape of the stars: plain Gaussians"]
    assert found.notes[-1].kind is NoteKind.SENSOR
    stacked = RadialProfile(RADII, 1.02 * (1 + (RADII / 5.5) ** 2) ** -15.5)
    assert shaped(stacked=stacked)[1].sensor == part.sensor


def test_wings_make_a_moffat_profile_of_the_same_flux() -> None:
    amplitude, alpha, beta = 0.95, 2.2, 2.6
    stacked = RadialProfile(RADII, amplitude * (1 + (RADII / alpha) ** 2) ** -beta)
    part, found = shaped(stacked=stacked)
    width = 2 * alpha * np.sqrt(2 ** (1 / beta) - 1) / np.sqrt(8 * np.log(2))
    recorded = 1.35**2 + 1 / 12
    narrower = width**2 * recorded - 1 / 12
    assert found.sensor.psf_sigma_px == pytest.approx(np.sqrt(narrower), rel=1e-4)
    assert found.sensor.effects == {"sensor.psf": "moffat", "sensor.psf_beta": pytest.approx(2.6, abs=1e-3)}
    ratio = amplitude * 1.35**2 / recorded * width**2 * recorded / narrower
    assert found.sensor.reference_peak_dn == pytest.approx(part.sensor.reference_peak_dn * ratio, rel=1e-3)
    assert found.notes[-1].text == "shape of the stars: Moffat profile of beta 2.60"


def test_growth_and_ellipse_are_taken_where_they_are_significant() -> None:
    part, found = shaped(corner_growth=Measurement(0.3, 0.07), ellipticity=Measurement(0.2, 0.04))
    mean = 1 + 0.3 / 3
    assert found.sensor.psf_sigma_px == pytest.approx(1.35 / mean, rel=1e-12)
    assert found.sensor.reference_peak_dn == pytest.approx(part.sensor.reference_peak_dn * mean**2, rel=1e-12)
    short = np.sqrt(0.8 / 1.2)
    assert found.sensor.effects == {
        "sensor.psf_growth": 0.3,
        "sensor.psf_ellipticity": pytest.approx(1 - short, abs=1e-4),
        "sensor.psf_angle_deg": 28.6,
    }
    assert found.notes[-1].text == (
        f"shape of the stars: growth to the corners 0.300 ± 0.070, ellipticity {1 - short:.3f} ± 0.040"
    )
    for growth in (Measurement(0.3, 0.08), Measurement(-0.3, 0.01), None):
        assert "sensor.psf_growth" not in shaped(corner_growth=growth)[1].sensor.effects
    assert "sensor.psf_ellipticity" not in shaped(ellipticity=Measurement(0.2, 0.06))[1].sensor.effects
    assert shaped(ellipticity=Measurement(0.7, 0.04))[1].sensor.effects["sensor.psf_ellipticity"] == 0.4
