"""The bands of cameras: their channels agree with the mean of all pixels."""

import numpy as np
import pytest

from glstar.camera.sensor.colourband import BANDS_WITH_COLOURS, ColourBand
from glstar.errors import ConfigError

COUNTS = {"r": 1, "g": 2, "b": 1}


@pytest.mark.parametrize("band", BANDS_WITH_COLOURS)
def test_the_mean_of_a_mosaic_is_that_of_its_cells(band: str) -> None:
    colours = ColourBand(band=band)
    assert sum(count * colours.photons(c) for c, count in COUNTS.items()) / 4 == pytest.approx(1, rel=0, abs=0.007)
    for bv in (0.3, 0.65, 1.0, 1.5):
        signal = {
            c: count * colours.photons(c) * 10 ** (-0.4 * float(colours.magnitude_minus_v(bv, c)))
            for c, count in COUNTS.items()
        }
        mean_mag = -2.5 * np.log10(sum(signal.values()) / 4)
        assert float(colours.magnitude_minus_v(bv)) == pytest.approx(mean_mag, rel=0, abs=0.012)
        if bv == 0.65:
            mean_nm = sum(signal[c] * colours.wavelength_nm(c) for c in COUNTS) / sum(signal.values())
            assert colours.wavelength_nm() == pytest.approx(mean_nm, rel=0, abs=3)


@pytest.mark.parametrize("band", BANDS_WITH_COLOURS)
def test_channels_are_ordered_by_wavelength_and_colour(band: str) -> None:
    colours = ColourBand(band=band)
    wavelengths = [colours.wavelength_nm(c) for c in "bgr"]
    for nm, (low, high) in zip(wavelengths, ((465, 495), (530, 560), (580, 625)), strict=True):
        assert low < nm < high
    # A red star is faint in blue: about 0.65 mag for each mag of B - V, less than in B itself.
    by_channel = [float(colours.magnitude_minus_v(1.0, c)) for c in "bgr"]
    assert by_channel == sorted(by_channel, reverse=True)


def test_colours_are_clipped_to_their_range() -> None:
    custom = ColourBand(band="custom", band_slope=0.5, band_curvature=-0.1)
    found = custom.magnitude_minus_v([-1.0, -0.3, 0.0, 1.0, 1.7, 3.0])
    np.testing.assert_allclose(found, [-0.159, -0.159, 0.0, 0.4, 0.561, 0.561], rtol=0, atol=1e-12)
    assert custom.wavelength_nm() == 550.0
    bare = ColourBand(band="bare")
    assert float(bare.magnitude_minus_v(1.0)) == -0.8
    assert bare.wavelength_nm() == 650.0
    assert ColourBand().is_v
    assert not bare.is_v


def test_the_channel_of_a_pixel_is_a_letter_of_the_mosaic() -> None:
    colours = ColourBand(band="imx477", mosaic="grbg")
    assert [[colours.channel_at(x, y) for x in range(3)] for y in range(3)] == [list("grg"), list("bgb"), list("grg")]


def test_the_sky_has_the_colour_of_its_b_minus_v() -> None:
    for sky_bv in (0.0, 1.2):
        colours = ColourBand(band="imx219", mosaic="rggb", sky_bv=sky_bv)
        ratio = colours.sky_ratio
        assert (ratio["r"] + 2 * ratio["g"] + ratio["b"]) / 4 == pytest.approx(1, rel=1e-12)
        fainter = float(colours.magnitude_minus_v(sky_bv, "b") - colours.magnitude_minus_v(sky_bv, "r"))
        expected = colours.photons("b") / colours.photons("r") * 10 ** (-0.4 * fainter)
        assert ratio["b"] / ratio["r"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"band": "x"}, "sensor.band"),
        ({"mosaic": "rgb"}, "sensor.mosaic"),
        ({"band": "bare", "mosaic": "rggb"}, "sensor.mosaic"),
        ({"band": "v", "mosaic": "rggb"}, "sensor.mosaic"),
        ({"band_slope": 0.1}, "sensor.band_slope"),
        ({"band": "bare", "band_curvature": 0.1}, "sensor.band_slope"),
    ],
)
def test_what_a_band_has_not_is_an_error_that_names_the_key(keys: dict, key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        ColourBand(**keys)
    assert caught.value.key == key


# Sums over mean, red, green and blue, so that no value of a fit changes: slopes and curvatures in thousandths of a
# magnitude, photons in thousandths, and wavelengths, nm.
SUMS = {
    "imx477": (292 - 183 + 141 + 741, -56 - 14 - 16 - 61, 1000 + 312.5 + 1212.5 + 1237.5, 522 + 584 + 532 + 470),
    "imx219": (142 - 359 + 75 + 673, -86 - 35 - 32 - 77, 1000 + 727 + 1126 + 1022, 554 + 618 + 549 + 488),
    "ov5647": (186 - 340 + 37 + 685, -103 - 52 - 39 - 50, 1000 + 703 + 969 + 1359, 552 + 620 + 555 + 482),
}


@pytest.mark.parametrize("band", SUMS)
def test_the_numbers_of_a_band_are_those_of_its_fit(band: str) -> None:
    colours = ColourBand(band=band)
    channels = (None, "r", "g", "b")
    # Magnitudes at B - V of 1 and of 1/2 give slope and curvature.
    at_1, at_half = (sum(float(colours.magnitude_minus_v(bv, c)) for c in channels) for bv in (1.0, 0.5))
    curvature = 2 * (at_1 - 2 * at_half)
    photons = 1 + sum(colours.photons(c) for c in "rgb")
    wavelength_nm = sum(colours.wavelength_nm(c) for c in channels)
    found = (1000 * (at_1 - curvature), 1000 * curvature, 1000 * photons, wavelength_nm)
    assert found == pytest.approx(SUMS[band], rel=0, abs=1e-6)
