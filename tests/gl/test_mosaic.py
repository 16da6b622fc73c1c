"""Stars in the band of a camera and behind the colour filters of a mosaic."""

from dataclasses import replace

import numpy as np
import orjson
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.colourband import ColourBand
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.config.reading import extinction_of
from glstar.errors import ConfigError
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import colours_used, in_band
from glstar.render.truth.frame import frame_truth
from glstar.sky.air.extinction import Extinction
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, with_stars_at

LENS = replace(camera(161, 121), lens=Lens("plumb_bob", (-0.1, 0.0, 0.0, 0.0, 0.0)))
# Pixels of each colour: first row and column, with steps of two.
CELLS = {"rggb": "rggb", "bggr": "bggr", "grbg": "grbg", "gbrg": "gbrg"}
SLOPES = {"r": (-0.183, -0.014, 2.5e5), "g": (0.141, -0.016, 9.7e5), "b": (0.741, -0.061, 9.9e5)}
MEAN = (0.292, -0.056, 8.0e5)


def sensor_with(**keys: float | str) -> Sensor:
    effects = {f"sensor.{key}": value for key, value in keys.items()}
    return Sensor(reference_peak_dn=30_000.0, bit_depth=16, sky_std_dn=0.0, effects=effects)


def star_of_colour(bv: float, sensor: Sensor, lens=None) -> Scene:
    scene = stars_at([(80.3, 60.6)], [3.0], sensor=sensor, lens=lens or camera(161, 121), n=4)
    stars = replace(scene.stars, catalogue="hipparcos", bv=np.array([bv]))
    return replace(scene, stars=in_band(stars, sensor.colour))


def light(renderer, scene: Scene) -> np.ndarray:
    drawn = renderer.render(scene, seed=0, light=True).light_dn
    assert drawn is not None
    return drawn.astype(np.float64)


def ratio(bv: float, channel: str) -> float:
    """Return the signal in one channel over that of an A0 star of the same V in the mean of the cells."""
    slope, curvature, photons = SLOPES[channel]
    return photons / MEAN[2] * 10 ** (-0.4 * (slope * bv + curvature * bv * bv))


@pytest.mark.parametrize("lens", [camera(161, 121), LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("mosaic", CELLS)
def test_a_mosaic_is_the_images_of_its_colours_each_in_its_own_pixels(renderer, mosaic, lens):
    white = light(renderer, star_of_colour(1.1, sensor_with(), lens))
    drawn = light(renderer, star_of_colour(1.1, sensor_with(band="imx477", mosaic=mosaic), lens))
    for at, channel in enumerate(CELLS[mosaic]):
        cells = slice(at // 2, None, 2), slice(at % 2, None, 2)
        expected = ratio(1.1, channel) * white[cells]
        assert np.abs(drawn[cells] - expected).max() < 1e-4 * expected.max()


@pytest.mark.parametrize("lens", [camera(161, 121), LENS], ids=["pinhole", "lens"])
def test_each_colour_of_a_mosaic_has_the_extinction_of_its_wavelength(renderer, lens):
    air = replace(Extinction().at_wavelength(522.0), by_channel=True)
    above = star_of_colour(0.65, sensor_with(band="imx477", mosaic="rggb"), lens)
    mean_mag = air.zenith_mag(above.site.height_m) * 3.0
    drawn = [
        light(renderer, replace(above, extinction=one, draw_list=replace(above.draw_list, extinction_mag=mag)))
        for one, mag in ((None, None), (air, np.array([mean_mag])))
    ]
    for at, wavelength_nm in enumerate((584.0, 532.0, 532.0, 470.0)):
        cells = slice(at // 2, None, 2), slice(at % 2, None, 2)
        lost_mag = 3.0 * air.at_wavelength(wavelength_nm).zenith_mag(above.site.height_m)
        expected = drawn[0][cells] * 10 ** (-0.4 * lost_mag)
        np.testing.assert_allclose(drawn[1][cells], expected, rtol=0, atol=2e-4 * expected.max())


def test_the_extinction_of_the_sensors_band_is_a_choice():
    given = {"sky.extinction": "standard", "sensor.band": "imx477", "sensor.mosaic": "rggb"}
    eye = Config().override(**given)
    assert extinction_of(eye.sky, eye.air, eye.sensor().colour) == Extinction()
    chosen = Config().override(**given, **{"sky.extinction_band": "sensor"})
    assert extinction_of(chosen.sky, chosen.air, chosen.sensor().colour) == replace(
        Extinction().at_wavelength(522.0), by_channel=True
    )


@pytest.mark.parametrize(("bv", "magnitude"), [(0.0, 0.0), (0.65, 0.292 * 0.65 - 0.056 * 0.65**2), (1.5, 0.312)])
def test_a_monochrome_image_has_the_magnitudes_of_the_band(bv, magnitude):
    assert ColourBand("imx477").magnitude_minus_v(bv) == pytest.approx(magnitude, abs=1e-9)


@pytest.mark.parametrize("band", ["imx477", "imx219", "ov5647"])
def test_the_mean_band_is_the_mean_of_its_colours(band):
    """Both were fitted to the same spectra, each with its own polynomial."""
    colour, bv = ColourBand(band), np.linspace(-0.3, 1.7, 21)
    r, g, b = (colour.photons(one) * 10 ** (-0.4 * colour.magnitude_minus_v(bv, one)) for one in "rgb")
    mean_mag = -2.5 * np.log10((r + 2 * g + b) / 4)
    np.testing.assert_allclose(mean_mag, colour.magnitude_minus_v(bv), rtol=0, atol=0.01)


@pytest.mark.parametrize("band", ["imx219", "ov5647"])
def test_a_mosaic_has_the_colours_of_its_camera(renderer, band):
    white = light(renderer, star_of_colour(1.1, sensor_with()))
    drawn = light(renderer, star_of_colour(1.1, sensor_with(band=band, mosaic="bggr")))
    for at, channel in enumerate("bggr"):
        cells = slice(at // 2, None, 2), slice(at % 2, None, 2)
        signal = ColourBand(band).photons(channel) * 10 ** (-0.4 * ColourBand(band).magnitude_minus_v(1.1, channel))
        assert drawn[cells].max() == pytest.approx(signal * white[cells].max(), rel=1e-4, abs=0)


def test_red_stars_are_fainter_behind_an_infra_red_filter_and_brighter_without():
    simulator = sky_over_adelaide(camera())
    magnitudes = {}
    for band in ("v", "imx477", "bare"):
        scene = replace(simulator, sensor=sensor_with(band=band)).scene(Exposure(NIGHT_UTC_S, 0.5))
        magnitudes[band] = dict(zip(scene.stars.star_id.tolist(), scene.stars.camera_mag.tolist(), strict=True))
    betelgeuse, rigel = 2061, 1713
    assert magnitudes["imx477"][betelgeuse] - magnitudes["v"][betelgeuse] == pytest.approx(0.312, abs=0.001)
    assert magnitudes["bare"][betelgeuse] - magnitudes["v"][betelgeuse] == pytest.approx(-1.2, abs=0.001)
    assert magnitudes["imx477"][rigel] - magnitudes["v"][rigel] == pytest.approx(-0.009, abs=0.001)


def test_the_background_of_each_colour_is_that_of_the_sky_and_its_mean_is_the_level(renderer):
    sensor = replace(sensor_with(band="imx477", mosaic="rggb", sky_bv=1.0), sky_mean_dn=2000.0)
    pixels = renderer.render(replace(star_of_colour(0.5, sensor), stars=dark()), seed=0).pixels
    assert pixels[:120, :160].mean() == pytest.approx(2000, abs=1)
    red, blue = float(pixels[0, 0]), float(pixels[1, 1])
    assert red / blue == pytest.approx(ratio(1.0, "r") / ratio(1.0, "b"), rel=1e-3, abs=0)


def dark():
    scene = star_of_colour(0.5, sensor_with())
    return replace(scene.stars, vmag=np.array([30.0]))


def test_stars_are_centred_at_the_same_place_in_all_colours(renderer):
    drawn = light(renderer, star_of_colour(0.9, sensor_with(band="imx477", mosaic="grbg")))
    rows, columns = np.indices(drawn.shape)
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        cells = slice(row, None, 2), slice(column, None, 2)
        flux = drawn[cells].sum()
        assert (columns[cells] * drawn[cells]).sum() / flux == pytest.approx(80.3, abs=0.01)
        assert (rows[cells] * drawn[cells]).sum() / flux == pytest.approx(60.6, abs=0.01)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"mosaic": "rggb"}, "sensor.mosaic"),
        ({"mosaic": "rggb", "band": "bare"}, "sensor.mosaic"),
        ({"band": "imx477", "band_slope": 0.3}, "sensor.band_slope"),
    ],
)
def test_contradicting_keys_of_colour_are_an_error(keys, named):
    with pytest.raises(ConfigError) as error:
        Config().override(**{f"sensor.{key}": value for key, value in keys.items()}).sensor()
    assert error.value.key == named


@pytest.mark.parametrize("psf", [{}, {"psf_wing_fraction": 0.2}], ids=["plain", "wings"])
@pytest.mark.parametrize("trail", ["analytic", "sprites"])
def test_a_trail_in_a_mosaic_is_that_of_each_colour_in_its_own_pixels(renderer, trail, psf):
    simulator = sky_over_adelaide(camera(96, 72), yaw_rate_rad_per_s=np.deg2rad(200))
    simulator = with_stars_at(simulator, [(62.3, 30.6)], [1.0], NIGHT_UTC_S + 1.1)
    mosaic = replace(simulator, sensor=sensor_with(band="imx477", mosaic="gbrg", **psf))
    white = replace(simulator, sensor=sensor_with(band="imx477", **psf))
    exposure = Exposure(NIGHT_UTC_S + 1, 0.25, 2000.0, trail=trail)
    bv = float(colours_used(white.scene(exposure).stars)[0])
    mean = 10 ** (-0.4 * (MEAN[0] * bv + MEAN[1] * bv * bv))
    drawn, expected = (light(renderer, one.scene(exposure)) for one in (mosaic, white))
    for at, channel in enumerate(CELLS["gbrg"]):
        cells = slice(at // 2, None, 2), slice(at % 2, None, 2)
        of_colour = ratio(bv, channel) / mean * expected[cells]
        assert of_colour.max() > 0
        assert np.abs(drawn[cells] - of_colour).max() < 2e-3 * of_colour.max()


@pytest.mark.parametrize("bv", [-0.2, 0.6, 1.6])
def test_the_flux_of_truth_is_that_of_the_mean_of_the_cells(renderer, bv):
    sensor = sensor_with(band="imx477", mosaic="rggb")
    scene = star_of_colour(bv, sensor)
    frame = renderer.render(scene, seed=0, light=True)
    (star,) = orjson.loads(frame_truth(scene, frame, number=0, file="x.png"))["stars"]
    # The cells beside each other sample the star at other phases, which makes no difference at this width.
    assert star["flux_dn"] == pytest.approx(float(frame.light_dn.sum(dtype=np.float64)), rel=1e-3)
