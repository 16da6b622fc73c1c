"""Parts of a sensor: fixed pattern, tone curve, colours and shapes, against laws, standards and moments."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.stats import kstest

from glstar.camera.sensor import tonecurve
from glstar.camera.sensor.colourband import BANDS_WITH_COLOURS, ColourBand
from glstar.camera.sensor.pixelpattern import PixelPattern, read_map, resampled, smooth
from glstar.camera.sensor.pointspread import PSF_KEYS, PointSpread, PsfComponent, moffat_mixture
from glstar.camera.sensor.tonecurve import (
    checked_points,
    curve_text,
    is_curve_text,
    light_before,
    parse_curve,
    read_curve,
    recorded_by,
)
from glstar.errors import ConfigError
from tests.support.dng import dng

# --- fixed pattern ----------------------------------------------------------------------------------------------------

MANY = PixelPattern(camera_seed=5, hot_pixels_per_mpx=4e4, stuck_fraction=0.25, dead_pixels_per_mpx=1e4)


def test_defects_follow_their_laws() -> None:
    """Factors from 10 to 1000 fall with the square, and the logarithm of offsets from 20 to 2000 e is uniform."""
    found = MANY.defects(500, 400)
    assert (len(found.x_px), found.is_dead.sum()) == (10000, 2000)
    assert (found.x_px.max(), found.y_px.max()) == (499, 399)
    stuck = found.offset_e > 0
    hot = ~found.is_dead & ~stuck
    assert stuck.sum() / 8000 == pytest.approx(0.25, abs=0.02)
    factor = found.dark_factor[hot]
    assert kstest(factor, lambda x: (1 / 10 - 1 / x) / (1 / 10 - 1 / 1000)).pvalue > 1e-3
    assert kstest(found.offset_e[stuck], lambda x: np.log(x / 20) / np.log(100)).pvalue > 1e-3
    assert set(found.dark_factor[~hot].tolist()) == {1.0}
    dead = found.is_dead
    assert set(found.offset_e[dead].tolist()) == {0.0}
    assert 20 <= found.offset_e[stuck].min() < found.offset_e[stuck].max() <= 2000
    assert 10 <= factor.min() < factor.max() <= 1000
    # Places are uniform over the image.
    assert kstest(found.x_px, "uniform", args=(0, 500)).pvalue > 1e-3
    assert kstest(found.y_px, "uniform", args=(0, 400)).pvalue > 1e-3


def test_a_small_image_has_as_many_defects_as_pixels_at_most() -> None:
    every = PixelPattern(hot_pixels_per_mpx=8e5, dead_pixels_per_mpx=4e5).defects(10, 10)
    assert (len(every.x_px), every.is_dead.sum()) == (100, 40)
    # Rounded to whole pixels: 0.6 of one dead and 2.4 hot ones.
    some = PixelPattern(hot_pixels_per_mpx=24.0, dead_pixels_per_mpx=6.0).defects(400, 250)
    assert (len(some.x_px), some.is_dead.sum()) == (3, 1)


def test_the_dark_has_the_defects_above_its_scatter() -> None:
    pattern = replace(MANY, dsnu_fraction=0.2)
    found = pattern.defects(500, 400)
    dark = pattern.dark_e(500, 400, 7.0)
    assert dark.dtype == np.float32
    own = replace(pattern, hot_pixels_per_mpx=0.0, dead_pixels_per_mpx=0.0).dark_e(500, 400, 7.0)
    expected = (found.dark_factor - 1) * 7.0 + found.offset_e
    np.testing.assert_allclose((dark - own)[found.y_px, found.x_px], expected, rtol=1e-4, atol=1e-4)
    # The logarithm of what is above -7 e is normal with the mean -0.02.
    logarithm = np.log(own.ravel() / 7.0 + 1)
    assert kstest(logarithm[:20000], "norm", args=(-0.02, 0.2)).pvalue > 1e-3
    response = replace(pattern, prnu_fraction=0.2).response(500, 400)
    scatter = response[response > -1]
    assert kstest(scatter[:20000], "norm", args=(0.0, 0.2)).pvalue > 1e-3
    # The two have streams of their own.
    alive = response > -1
    assert abs(np.corrcoef(response[alive], own[alive])[0, 1]) < 0.02


def test_maps_add_to_the_response(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    flat = (1000 * (1 + 0.05 * rng.standard_normal((70, 90)))).astype(np.float32)
    defects = np.zeros((70, 90), np.uint8)
    defects[3, 4], defects[50, 60] = 2, 255
    np.save(tmp_path / "flat.npy", flat)
    np.save(tmp_path / "defects.npy", defects)
    files = {"flat_field": str(tmp_path / "flat.npy"), "defect_map": str(tmp_path / "defects.npy")}
    plain = PixelPattern(prnu_fraction=0.03)
    found = replace(plain, **files).response(90, 70)
    smoothed = uniform_filter(flat.astype(float), 33, mode="reflect")
    np.testing.assert_allclose(smooth(flat), smoothed, rtol=1e-5)
    expected = (1 + plain.response(90, 70)) * flat / smoothed - 1
    expected[[3, 50], [4, 60]] = -1.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6)
    assert found.dtype == np.float32
    assert not read_map(files["flat_field"]).flags.writeable


def test_a_pattern_is_there_if_one_of_its_keys_is() -> None:
    plain = PixelPattern()
    assert (plain.has_dark, plain.has_response) == (False, False)
    for key in ("hot_pixels_per_mpx", "dsnu_fraction"):
        one = replace(plain, **{key: 0.1})
        assert (one.has_dark, one.has_response) == (True, False)
    for key in ("dead_pixels_per_mpx", "prnu_fraction"):
        one = replace(plain, **{key: 0.1})
        assert (one.has_dark, one.has_response) == (False, True)
    assert (replace(plain, dark_frame="x").has_dark, replace(plain, dark_frame="x").has_response) == (True, False)
    for key in ("flat_field", "defect_map"):
        assert (replace(plain, **{key: "x"}).has_dark, replace(plain, **{key: "x"}).has_response) == (False, True)
    assert plain == PixelPattern(0, 0.0, 0.4, 0.0, 0.0, 0.0, "", "", "")
    effects = {"sensor.camera_seed": 9, "sensor.prnu_fraction": 0.01, "lens.vignetting": "cos4", "sensor.psf": "moffat"}
    assert PixelPattern.of(effects) == PixelPattern(camera_seed=9, prnu_fraction=0.01)


@pytest.mark.parametrize("key", ["dark_frame", "flat_field", "defect_map"])
def test_each_map_must_have_the_size_of_the_image(tmp_path: Path, key: str) -> None:
    np.save(tmp_path / "m.npy", np.ones((30, 40)))
    pattern = PixelPattern(**{key: str(tmp_path / "m.npy")})
    pattern.require_size(40, 30)
    for size in ((40, 31), (41, 30)):
        with pytest.raises(ConfigError, match=rf"m\.npy has 40 x 30 px and the camera {size[0]} x {size[1]}") as caught:
            pattern.require_size(*size)
        assert caught.value.key == f"sensor.{key}"


@pytest.mark.parametrize(
    ("content", "words"),
    [(np.array([[1.0, np.nan]]), "pixels that are not finite"), (np.array([[1.0, 1e300]]), "not finite"),
     (np.zeros((2, 2), complex), "not an image of one channel"), (np.zeros((0, 3)), "not an image of one channel"),
     (np.zeros((2, 2, 3)), "not an image of one channel")],
)  # fmt: skip
def test_a_map_without_numbers_is_refused(tmp_path: Path, content: np.ndarray, words: str) -> None:
    np.save(tmp_path / "m.npy", content)
    with pytest.raises(ConfigError, match=words):
        read_map(str(tmp_path / "m.npy"))


def test_a_map_is_no_program_and_keeps_its_mosaic(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.array([[{"a": 1}]], dtype=object), allow_pickle=True)
    with pytest.raises(ConfigError, match=r"m\.npy: it is damaged or cut off"):
        read_map(str(tmp_path / "m.npy"))
    mosaic = np.arange(2400, dtype=np.uint16).reshape(40, 60)
    (tmp_path / "m.dng").write_bytes(dng(mosaic))
    np.testing.assert_array_equal(read_map(str(tmp_path / "m.dng")), mosaic)


def test_a_map_is_resampled_between_the_centres_of_its_pixels() -> None:
    pixels = np.float32([[1.0, 3.0, 7.0], [2.0, 6.0, 9.0]])
    np.testing.assert_allclose(resampled(pixels, 6, 2)[0], [1, 1.5, 2.5, 4, 6, 7], rtol=1e-6)
    assert resampled(pixels, 6, 4).shape == (4, 6)


# --- tone curves ------------------------------------------------------------------------------------------------------


def test_the_curve_of_srgb_is_that_of_its_standard() -> None:
    light = np.array([0.0, 0.001, 0.003, 0.0034, 0.02, 0.21404, 0.5, 1.0])
    expected = [0.0, 0.01292, 0.03876, 1.055 * 0.0034 ** (1 / 2.4) - 0.055, 0.15170, 0.5, 0.73536, 1.0]
    np.testing.assert_allclose(recorded_by(light, "srgb"), expected, rtol=0, atol=2e-5)
    np.testing.assert_allclose(light_before(np.array(expected), "srgb"), light, rtol=0, atol=2e-5)


def test_the_curve_of_the_raspberry_pi_goes_through_its_points() -> None:
    """libcamera's gamma_curve of the IMX477, of 65535: every 1024 to 15360, 2048 to 30720 and 4096 to 61440."""
    points = {0: 0, 1024: 5040, 2048: 9338, 8192: 25744, 15360: 39168, 16384: 40642, 20480: 45749, 30720: 53796}
    points |= {32768: 54876, 36864: 57012, 45056: 59954, 61440: 64476, 65535: 65535}
    light = np.array(list(points)) / 65535
    np.testing.assert_allclose(recorded_by(light, "rpi"), np.array(list(points.values())) / 65535, rtol=0, atol=2e-5)
    between = recorded_by(np.array([(1024 + 2048) / 2 / 65535]), "rpi")
    np.testing.assert_allclose(between, (5040 + 9338) / 2 / 65535, rtol=0, atol=2e-5)
    np.testing.assert_allclose(light_before(recorded_by(light, "rpi"), "rpi"), light, rtol=0, atol=2e-5)


@pytest.mark.parametrize("gamma", ["linear", "srgb", "rpi", 2.2])
def test_a_curve_is_that_of_numpy_and_has_an_inverse(gamma, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tonecurve, "_BLOCK", 7)
    light = np.random.default_rng(2).uniform(0, 1, (5, 9)).astype(np.float32)
    light[2, 3], light[4, 8] = 0.0, 1.0
    found = recorded_by(light, gamma)
    assert (found.shape, found.dtype) == ((5, 9), np.float64)
    if gamma == 2.2:
        np.testing.assert_allclose(found, light.astype(float) ** (1 / 2.2), rtol=1e-12)
    else:
        table = tonecurve._named_curve(gamma)
        np.testing.assert_allclose(found, np.interp(light, np.linspace(0, 1, 65536), table), rtol=0, atol=1e-9)
    np.testing.assert_allclose(light_before(found, gamma), light, rtol=0, atol=1e-5)


def test_points_replace_the_name_of_a_curve() -> None:
    points = "0.1,0;0.5,0.7;1,0.9"
    np.testing.assert_allclose(recorded_by(np.array([0.05, 0.3, 0.75]), "srgb", points), [0.0, 0.35, 0.8], rtol=1e-12)
    assert parse_curve(points) == ((0.1, 0.0), (0.5, 0.7), (1.0, 0.9))
    assert parse_curve(points + "; ") == parse_curve(points)
    assert curve_text(((0.1, 0.0), (1 / 3, 0.7))) == "0.1,0;0.33333333,0.7"
    assert (is_curve_text(points), is_curve_text("curve.csv")) == (True, False)


ORDER = "inputs must increase and outputs must not decrease, but"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 0), (0.5, 0.6), (0.5, 0.7)], f"{ORDER} [0.5, 0.7] follows [0.5, 0.6]"),
        ([(0, 0), (0.5, 0.6), (0.6, 0.59)], f"{ORDER} [0.6, 0.59] follows [0.5, 0.6]"),
        ([(0, 0)], "needs two points or more, not 1"),
        ([(0, 0), (1.01, 1)], "[1.01, 1] is no pair of fractions from 0 to 1: divide by full scale"),
        ([(0, -0.01), (1, 1)], "[0, -0.01] is no pair of fractions from 0 to 1: divide by full scale"),
        ([(0, 0, 0), (1, 1)], "(0, 0, 0) is no pair of numbers, [input, output]"),
        ([(0, "x"), (1, 1)], "(0, 'x') is no pair of numbers, [input, output]"),
        (["a" * 50], "a" * 40 + " is no pair of numbers, [input, output]"),
    ],
)  # fmt: skip
def test_rows_that_are_no_curve_are_refused(rows: list, message: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        checked_points(rows)
    assert str(caught.value) == message


def test_equal_outputs_and_the_ends_of_the_range_are_allowed() -> None:
    assert checked_points([(0, 0), (0.5, 0), (1, 1)]) == ((0.0, 0.0), (0.5, 0.0), (1.0, 1.0))


def test_files_of_curves_are_read(tmp_path: Path) -> None:
    expected = ((0.0, 0.0), (0.25, 0.5), (1.0, 0.75))
    (tmp_path / "a.csv").write_text("# of a camera\ninput;output\n0;0\n\n0.25;0.5\n1;0.75\n")
    (tmp_path / "b.txt").write_text("0 0\n# between\n0.25\t0.5\n1, 0.75\n")
    curve = [0, 0, 16384, 32768, 65535, 49152]
    (tmp_path / "c.JSON").write_text(json.dumps({"algorithms": [{"x": 1}, {"rpi.contrast": {"gamma_curve": curve}}]}))
    for name, tolerance in (("a.csv", 0), ("b.txt", 0), ("c.JSON", 1e-4)):
        np.testing.assert_allclose(read_curve(tmp_path / name), expected, rtol=0, atol=tolerance)
    for content, words in (
        ({"gamma_curve": curve[:5]}, "its gamma_curve is no list of inputs and outputs in turn"),
        ({"gamma_curve": 5}, "its gamma_curve is no list of inputs and outputs in turn"),
        ({"other": curve}, r"is no list of \[input, output\], and has no gamma_curve of libcamera"),
    ):
        (tmp_path / "d.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=rf"d\.json: {words}"):
            read_curve(tmp_path / "d.json")


# --- colours ----------------------------------------------------------------------------------------------------------


def test_a_colour_band_has_the_defaults_of_the_manual() -> None:
    assert ColourBand() == ColourBand("v", 0.0, 0.0, "none", 0.9)
    assert ColourBand.of({"sensor.band": "imx219", "sensor.mosaic": "bggr", "lens.x": 1}) == ColourBand(
        "imx219", mosaic="bggr"
    )
    assert (ColourBand().magnitude_minus_v(0.7), ColourBand().wavelength_nm()) == (0.0, 550.0)
    assert BANDS_WITH_COLOURS == ("imx477", "imx219", "ov5647")
    assert ColourBand("custom", 0.1, 0.2).wavelength_nm() == 550.0


def test_messages_of_a_band_name_the_choices() -> None:
    for given, message in (
        ({"band": "x"}, "sensor.band: must be one of v, imx477, imx219, ov5647, bare, custom, not 'x'"),
        ({"mosaic": "x"}, "sensor.mosaic: must be one of none, rggb, bggr, grbg, gbrg, not 'x'"),
        ({"mosaic": "rggb"}, 'sensor.mosaic: needs the response of each colour, and [sensor] band = "v" has one of all'
                             ' light; take band = "imx477" or "imx219" or "ov5647"'),
        ({"band_curvature": 0.1}, 'sensor.band_slope: belongs to band = "custom"'),
    ):  # fmt: skip
        with pytest.raises(ConfigError) as caught:
            ColourBand(**given)
        assert str(caught.value) == message


@pytest.mark.parametrize("band", BANDS_WITH_COLOURS)
def test_the_sky_of_each_channel_is_over_the_mean_of_the_cells(band: str) -> None:
    colours = ColourBand(band, mosaic="rggb")
    level = {c: colours.photons(c) * 10 ** (-0.4 * float(colours.magnitude_minus_v(0.9, c))) for c in "rgb"}
    mean = (level["r"] + 2 * level["g"] + level["b"]) / 4
    assert colours.sky_ratio == pytest.approx({c: level[c] / mean for c in "rgb"}, rel=1e-12)
    assert [colours.channel_at(x, y) for y in (0, 1, 2) for x in (0, 1, 2)] == list("rgrgbgrgr")


# --- shapes -----------------------------------------------------------------------------------------------------------


def test_a_shape_has_the_defaults_of_the_manual() -> None:
    plain = PointSpread()
    assert plain == PointSpread("gaussian", 3.0, 0.0, 4.0, 0.0, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert plain.keys == {}
    assert plain.circular(1.3) == (PsfComponent(1.0, 1.3, (0.0, 0.0)),)
    assert plain.components(1.3) == (PsfComponent(1.0, 1.3, (0.0, 0.0)),)
    assert plain.flux_per_peak_px2(1.3) == 2 * np.pi * 1.3**2
    assert (plain.scale_range, plain.widest(1.3)) == ((1.0, 1.0), ("psf_sigma_px", 1.3, 1.3))
    assert len(PSF_KEYS) == 12
    keys = {"psf_growth": 0.3, "psf_angle_deg": 90.0, "other": 1}
    assert PointSpread.of_keys(keys) == PointSpread(psf_growth=0.3, psf_angle_rad=np.pi / 2)


def test_the_flux_over_the_amplitude_is_that_of_its_gaussians() -> None:
    psf = PointSpread(psf_wing_fraction=0.2, psf_wing_sigma_px=5.0, psf_ellipticity=0.3)
    expected = 2 * np.pi / (0.8 / 1.3**2 + 0.2 / 25)
    assert psf.flux_per_peak_px2(1.3) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("ellipticity", "count"), [(0.09, 3), (0.1, 3), (0.11, 5), (0.2, 5), (0.21, 7), (0.3, 7), (0.31, 9), (0.4, 9)]
)
def test_an_ellipse_is_a_row_of_circles_along_its_axis(ellipticity: float, count: int) -> None:
    psf = PointSpread(psf_ellipticity=ellipticity, psf_angle_rad=0.6, psf_wing_fraction=0.1, psf_wing_sigma_px=5.0)
    *row, wing = psf.components(1.3, scale=1.5)
    assert wing == PsfComponent(0.1, 5.0, (0.0, 0.0))
    assert len(row) == count
    ratio = 1 - ellipticity
    assert {round(one.sigma_px, 12) for one in row} == {round(1.95 * np.sqrt(ratio), 12)}
    along = np.array([one.offset_px for one in row]) @ [np.cos(0.6), np.sin(0.6)]
    across = np.array([one.offset_px for one in row]) @ [-np.sin(0.6), np.cos(0.6)]
    np.testing.assert_allclose(across, 0, rtol=0, atol=1e-12)
    flux = np.array([one.flux_fraction for one in row])
    assert flux.sum() == pytest.approx(0.9, rel=1e-12)
    # The long axis has sigma / sqrt(ratio), and the fourth moment of a normal law.
    step2 = 1.95**2 * (1 / ratio - ratio)
    assert flux @ along**2 / 0.9 == pytest.approx(step2, rel=1e-9)
    assert flux @ along**4 / 0.9 == pytest.approx(3 * step2**2, rel=1e-9)


def test_the_widest_gaussian_is_named_with_its_key() -> None:
    growing = PointSpread(psf_growth=0.5, psf_tilt=0.2, psf_colour_growth=0.1)
    redder = 1.7 - 0.65
    assert growing.scale_range == (pytest.approx(1 - 0.2 - 0.1 * 0.95), pytest.approx(1.7 + 0.1 * redder))
    assert growing.widest(1.3) == ("psf_sigma_px", 1.3, pytest.approx(1.3 * (1.7 + 0.1 * redder)))
    bluer = PointSpread(psf_colour_growth=-0.4)
    assert bluer.scale_range == (pytest.approx(1 - 0.4 * redder), pytest.approx(1 + 0.4 * 0.95))
    wings = PointSpread(psf_wing_fraction=0.1, psf_wing_sigma_px=6.0, psf_halo_fraction=0.1, psf_halo_radius_px=9.0)
    assert wings.widest(1.3) == ("psf_halo_radius_px", 9.0, 9.0)
    assert replace(wings, psf_halo_fraction=0.0).widest(1.3) == ("psf_wing_sigma_px", 6.0, 6.0)
    assert PointSpread(psf_tilt=0.9, psf_colour_growth=0.5).scale_range[0] == 0.2


@pytest.mark.parametrize(("radius_px", "count"), [(4.9, 1), (5.3, 2), (10.3, 2), (10.5, 3), (2.0, 1)])
def test_a_halo_goes_down_to_twice_the_core(radius_px: float, count: int) -> None:
    halo = PointSpread(psf_halo_fraction=0.1, psf_halo_radius_px=radius_px).circular(1.3)[1:]
    assert [one.sigma_px for one in halo] == [radius_px / 2**k for k in range(count)]
    assert sum(one.flux_fraction for one in halo) == pytest.approx(0.1, rel=1e-12)


# Largest errors of encircled energy and profile, parts per million: each change of the mixture's table makes one worse.
MIXTURE_PPM = {2.0: 4400, 2.25: 2790, 2.45: 1990, 2.5: 3320, 2.75: 2260, 3.0: 1730, 3.25: 1310, 3.5: 1070, 3.75: 840}
MIXTURE_PPM |= {
    4.0: 750,
    4.5: 510,
    5.0: 460,
    5.5: 256,
    6.0: 169,
    7.0: 126,
    8.0: 69,
    10.0: 65,
    12.0: 31,
    16.0: 22,
    20.0: 5,
}


@pytest.mark.parametrize("beta", MIXTURE_PPM)
def test_a_mixture_is_as_near_to_its_moffat_function_as_its_search_found(beta: float) -> None:
    flux, sigma = np.transpose(moffat_mixture(beta))
    r = np.geomspace(0.01, 100, 500)
    outside = np.exp(-np.outer(r**2, 0.5 / sigma**2))
    encircled = np.abs((1 - outside) @ flux - 1 + (1 + r**2) ** (1 - beta)).max()
    profile = np.abs(outside @ (flux / (2 * np.pi * sigma**2)) * np.pi / (beta - 1) - (1 + r**2) ** -beta).max()
    assert 1e6 * max(encircled, profile) < MIXTURE_PPM[beta]
    assert len(flux) == (5 if beta < 2.5 else 4)
