"""Notes of misfits: each limit from both sides, and the numbers that a note states."""

import math
from dataclasses import replace

import numpy as np
import pytest

from glstar.calibrate.notes import NoteKind
from glstar.calibrate.photo.detection import SkyLevel
from glstar.calibrate.sensor.misfit import Measurement, Misfit, _direction
from glstar.camera.sensor.sensor import Sensor

FAINT = Measurement(0.0, 1e-3)
PLAIN = Misfit(
    wing_fraction=FAINT,
    stacked=None,
    corner_loss_mag=FAINT,
    mean_loss_mag=0.25,
    brightness_map_mag=np.full((3, 4), np.nan),
    gradient_dn=FAINT,
    gradient_towards_rad=0.0,
    rest_dn=1.5,
    rest_without_bowl_dn=0.5,
    ellipticity=FAINT,
    long_axis_rad=np.deg2rad(30.0),
    corner_growth=FAINT,
    neighbour_correlation=FAINT,
    lattice_excess=FAINT,
)
SENSOR = Sensor(sky_std_dn=4.0)


def loss_mag(fraction: float) -> float:
    return -2.5 * math.log10(1 - fraction)


def ellipticity(axis_ratio: float) -> float:
    return (axis_ratio**2 - 1) / (axis_ratio**2 + 1)


def kinds(**changes: float) -> set[NoteKind]:
    """Return the notes on measurements that are exact to a thousandth of their value."""
    measured = {name: Measurement(value, abs(value) / 1000) for name, value in changes.items()}
    return {note.kind for note in replace(PLAIN, **measured).notes(SENSOR)}


@pytest.mark.parametrize(
    ("name", "below", "above", "kind"),
    [
        ("wing_fraction", 0.029, 0.031, NoteKind.WINGS),
        ("corner_loss_mag", loss_mag(0.098), loss_mag(0.102), NoteKind.VIGNETTING),
        ("corner_loss_mag", -loss_mag(0.098), -loss_mag(0.102), NoteKind.BRIGHT_CORNERS),
        ("gradient_dn", 4.9, 5.1, NoteKind.GRADIENT),
        ("ellipticity", ellipticity(1.078), ellipticity(1.082), NoteKind.ELLIPSE),
        ("corner_growth", 0.078, 0.082, NoteKind.CORNER_WIDTH),
        ("corner_growth", -0.078, -0.082, NoteKind.CORNER_WIDTH),
        ("neighbour_correlation", 0.147, 0.153, NoteKind.PROCESSING),
        ("lattice_excess", 0.098, 0.102, NoteKind.PROCESSING),
    ],
)
def test_an_effect_is_noted_beyond_its_limit(name: str, below: float, above: float, kind: NoteKind) -> None:
    assert kinds(**{name: below}) == set()
    assert kinds(**{name: above}) == {kind}
    # Within four standard errors nothing is noted.
    for errors, noted in ((3.9, False), (4.1, True)):
        uncertain = replace(PLAIN, **{name: Measurement(5 * above, abs(5 * above) / errors)})
        assert {note.kind for note in uncertain.notes(SENSOR)} == ({kind} if noted else set())
    assert not replace(PLAIN, **{name: Measurement(0.0, 0.0)}).notes(SENSOR)


def test_a_measurement_at_its_limit_does_not_exceed_it() -> None:
    assert not Measurement(0.5, 0.0).exceeds(0.5)
    assert not Measurement(-0.5, 0.125).exceeds(0.1)
    assert Measurement(-0.5, 0.12).exceeds(0.1)


def test_an_unknown_or_missing_effect_is_not_noted() -> None:
    names = ("wing_fraction", "corner_loss_mag", "ellipticity", "corner_growth", "neighbour_correlation")
    unknown = replace(PLAIN, **dict.fromkeys((*names, "lattice_excess")))
    assert unknown.notes(SENSOR) == ()
    assert math.isnan(unknown.axis_ratio)
    assert kinds(wing_fraction=-0.5) == set()
    # The response of an image that is not linear distorts profiles.
    curved = replace(PLAIN, wing_fraction=Measurement(0.2, 0.01), corner_growth=Measurement(0.2, 0.01))
    assert {note.kind for note in curved.notes(SENSOR)} == {NoteKind.WINGS, NoteKind.CORNER_WIDTH}
    assert curved.notes(SENSOR, linear=False) == ()
    json = unknown.to_json()
    assert (json["psf_axis_ratio"], json["psf_long_axis_deg"], json["corner_loss_mag"]) == (None, None, None)


def test_a_gradient_matters_beyond_half_of_the_noise() -> None:
    steep = replace(PLAIN, gradient_dn=Measurement(10.0, 0.1))
    assert steep.has_gradient(19.0)
    assert not steep.has_gradient(21.0)


def test_unevenness_is_that_beyond_the_effects_noted() -> None:
    sky = SkyLevel(20.0, 4.0, 7.0, 1000, 0.0)
    assert PLAIN.unexplained_unevenness(sky)[0] == 7.0
    steep = replace(PLAIN, gradient_dn=Measurement(10.0, 0.1))
    assert steep.unexplained_unevenness(sky)[0] == 1.5
    assert replace(steep, corner_loss_mag=Measurement(0.5, 0.01)).unexplained_unevenness(sky)[0] == 0.5


def test_notes_state_fluxes_axes_and_directions() -> None:
    found = replace(
        PLAIN,
        wing_fraction=Measurement(0.25, 0.01),
        corner_loss_mag=Measurement(loss_mag(0.4), 0.01),
        ellipticity=Measurement(ellipticity(1.5), 0.01),
        corner_growth=Measurement(-0.2, 0.03),
        gradient_dn=Measurement(12.0, 0.1),
        gradient_towards_rad=np.deg2rad(135.0),
        lattice_excess=Measurement(0.3, 0.01),
    )
    text = {note.kind: note.text for note in found.notes(SENSOR)}
    # A Gaussian has exp(-9/2) = 1.1 % of its flux beyond 3 sigma; a fifth of 1.25 is the wings'.
    assert "21 % of their flux lies beyond 3 sigma, where a Gaussian has 1.1 %" in text[NoteKind.WINGS]
    assert "lack 20 % of the flux (0.24 mag)" in text[NoteKind.WINGS]
    assert "40 % darker than the centre (0.55" in text[NoteKind.VIGNETTING]
    assert "1.50 times as long as wide, 30 deg" in text[NoteKind.ELLIPSE]
    assert "20 ± 3 % narrower" in text[NoteKind.CORNER_WIDTH]
    assert "brightens by 12 DN across the image, towards the lower left" in text[NoteKind.GRADIENT]
    assert "differs by 30 %" in text[NoteKind.PROCESSING]
    assert found.axis_ratio == pytest.approx(1.5)
    # A line has no finite ratio: the ellipticity ends at 0.99.
    assert replace(PLAIN, ellipticity=Measurement(1.0, 0.0)).axis_ratio == pytest.approx(math.sqrt(199))


@pytest.mark.parametrize(
    ("clockwise_deg", "name"),
    [
        (0, "right"),
        (22, "right"),
        (23, "lower right"),
        (90, "bottom"),
        (180, "left"),
        (-90, "top"),
        (315, "upper right"),
    ],
)
def test_directions_are_clockwise_from_the_right(clockwise_deg: float, name: str) -> None:
    assert _direction(np.deg2rad(clockwise_deg)) == name


def test_all_numbers_of_a_misfit_are_written() -> None:
    cells = np.full((3, 4), np.nan)
    cells[1, 2] = 0.125
    found = replace(
        PLAIN,
        wing_fraction=Measurement(0.25, 0.01),
        corner_loss_mag=Measurement(0.5, 0.02),
        brightness_map_mag=cells,
        gradient_dn=Measurement(12.0, 0.3),
        gradient_towards_rad=np.deg2rad(135.0),
        ellipticity=Measurement(ellipticity(1.5), 0.04),
        corner_growth=Measurement(-0.2, 0.05),
        neighbour_correlation=Measurement(0.1, 0.06),
        lattice_excess=Measurement(0.3, 0.07),
    )
    none = [None] * 4
    assert found.to_json() == {
        "wing_fraction_beyond_gaussian": {"value": 0.25, "standard_error": 0.01},
        "corner_loss_mag": {"value": 0.5, "standard_error": 0.02},
        "brightness_residual_map_mag": [none, [None, None, 0.125, None], none],
        "sky_gradient_dn": {"value": 12.0, "standard_error": 0.3},
        "sky_brightens_towards_deg": pytest.approx(135.0),
        "sky_unevenness_without_gradient_dn": 1.5,
        "sky_unevenness_without_gradient_and_bowl_dn": 0.5,
        "psf_ellipticity": {"value": pytest.approx(ellipticity(1.5)), "standard_error": 0.04},
        "psf_axis_ratio": pytest.approx(1.5),
        "psf_long_axis_deg": pytest.approx(30.0),
        "corner_sigma_growth": {"value": -0.2, "standard_error": 0.05},
        "noise_neighbour_correlation": {"value": 0.1, "standard_error": 0.06},
        "noise_lattice_excess": {"value": 0.3, "standard_error": 0.07},
    }


def test_the_notes_of_a_misfit_are_whole_sentences() -> None:
    found = replace(
        PLAIN,
        wing_fraction=Measurement(0.25, 0.01),
        corner_loss_mag=Measurement(-0.5, 0.02),
        ellipticity=Measurement(ellipticity(1.5), 0.04),
        corner_growth=Measurement(0.2, 0.03),
        neighbour_correlation=Measurement(0.35, 0.06),
        lattice_excess=Measurement(0.3, 0.07),
        gradient_dn=Measurement(12.0, 0.3),
    )
    assert [note.text for note in found.notes(SENSOR)] == [
        "the stars have wings: 21 % of their flux lies beyond 3 sigma, where a Gaussian has 1.1 %: sigma is too"
        " wide for"
        " their cores, and simulated stars lack 20 % of the flux (0.24 mag); focus, and keep the lens clear of"
        " dew and haze",
        "the stars in the corner are 20 ± 3 % wider than on the axis: sigma is that of the typical star, and"
        " all simulated"
        " stars have it; focus between centre and corner, or stop the lens down",
        "stars in the corner are 0.50 ± 0.02 mag brighter than on the axis: the reference peak is 0.25 mag too"
        " bright for"
        " the centre; look for haze in the middle of the image, or a correction of vignetting that is too strong",
        "the sky has a gradient: it brightens by 12 DN across the image, towards the right, with a noise of 4.0 DN; the"
        " model has one level, 16 DN; take images away from the Moon, twilight and lights",
        "the stars are elliptical: 1.50 times as long as wide, 30 deg clockwise from the horizontal: sigma is"
        " the mean of"
        " the two axes, and simulated stars are round; hold the camera still, focus, and check the lens for"
        " astigmatism",
        "the noise of neighbouring pixels is correlated (0.35; 0 in raw images), and the noise differs by 30 %"
        " between the"
        " pixels of a 2 x 2 lattice, as after processing (demosaicing: colours interpolated between pixels): simulated"
        " noise is independent from pixel to pixel, the measured noise is not that of the raw sensor, and sigma"
        " includes"
        " the smoothing; take raw images of one colour",
    ]
    correlated = replace(PLAIN, neighbour_correlation=Measurement(0.35, 0.06))
    assert "as after processing (demosaicing, noise reduction, scaling or JPEG)" in correlated.notes(SENSOR)[0].text
    sky = SkyLevel(20.0, 4.0, 7.0, 1000, 0.0)
    said = [
        one.unexplained_unevenness(sky)[1]
        for one in (PLAIN, found, replace(found, corner_loss_mag=Measurement(0.5, 0.01)))
    ]
    assert said == ["over the image", "besides its gradient", "besides a gradient and the vignetting"]
