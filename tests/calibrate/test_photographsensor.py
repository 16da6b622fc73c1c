"""The sensor of one photograph by hand: hot pixels, electrons, vignetting, and what is written of them."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad

from glstar import __version__
from glstar.calibrate.sensor.combine import StarTable
from glstar.calibrate.sensor.photographmodel import (
    HotPixels,
    PhotographModel,
    _detected_colours,
    _electrons,
    _gain,
    _offset,
    _pixel_variance,
    _sensor,
    _vignetting,
    find_hot_pixels,
    light_beside_star,
)
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import PointSpread
from glstar.camera.vignetting import Vignetting, relative_solid_angle
from tests.support.handmade import CAMERA, JOINT, NOISE, OFF, TERMS, handmade, sky_of


def test_the_light_beside_a_star_is_that_of_four_neighbours_over_its_pixel() -> None:
    psf = replace(JOINT.psf, psf_tilt=0.2, psf_ellipticity=0.3)
    joint = replace(JOINT, psf=psf)

    def light(x: float, y: float) -> float:
        parts = ((0.9, 1.2 * 0.8), (0.1, 4.0))
        return sum(f / (2 * np.pi * s**2) * np.exp(-(x**2 + y**2) / (2 * s**2)) for f, s in parts)

    centre = dblquad(light, -0.5, 0.5, -0.5, 0.5)[0]
    beside = 4 * dblquad(light, -0.5, 0.5, 0.5, 1.5)[0]
    assert light_beside_star(joint) == pytest.approx(beside / centre, rel=1e-6)


def test_hot_pixels_are_bright_and_their_neighbours_dark() -> None:
    """Eight standard deviations above the sky, and half of the light that is beside a star is missing."""
    variance = np.full((60, 70), 9.0)
    variance[:, 35:] = 16.0
    least = light_beside_star(JOINT)
    above = np.zeros((60, 70))
    above[10, 10], above[10, 20] = 24.5, 23.5  # eight times 3 DN
    above[10, 50], above[10, 60], above[40, 30] = 32.5, 31.5, 24.0
    above[30, 10] = above[30, 20] = 400.0
    for column, part in ((10, 0.45), (20, 0.55)):
        for y, x in ((29, column), (31, column), (30, column - 1), (30, column + 1)):
            above[y, x] = part * least * 100
    for y, x in ((10, 10), (10, 20)):
        above[y - 1, x - 1] = 20.0  # diagonal neighbours do not count
    above[0, 5] = above[59, 5] = above[20, 0] = above[20, 69] = 500.0
    found = find_hot_pixels(above, variance, 0.5, JOINT)
    at = list(zip(found.y_px.tolist(), found.x_px.tolist(), strict=True))
    assert at == [(10, 10), (10, 50), (30, 10)]
    assert found.excess_dn.tolist() == [24.5, 32.5, 400.0]
    assert len(found) == 3
    frame = found.dark_frame_dn((60, 70))
    assert (frame.dtype, frame.shape, frame[10, 10], frame[30, 10], np.count_nonzero(frame)) == (
        np.float32,
        (60, 70),
        24.5,
        400.0,
        3,
    )


@pytest.mark.parametrize("dn_per_e", [0.0, 2.0])
def test_the_neighbours_of_a_hot_pixel_are_dark_beyond_four_deviations(dn_per_e: float) -> None:
    """The noise is that of all five pixels, each with the noise of its own light."""
    least, peak = light_beside_star(JOINT), 45.0
    for factor, is_hot in ((4.08, True), (3.92, False)):
        beside = 0.0
        for _ in range(100):
            noise2 = 4 * 25.0 + dn_per_e * max(beside, 0.0) + least**2 * (25.0 + dn_per_e * peak)
            beside = least * peak - factor * np.sqrt(noise2)
        assert beside < least * peak / 2
        above = np.zeros((9, 9))
        above[4, 4] = peak
        above[3, 4] = above[5, 4] = above[4, 3] = above[4, 5] = beside / 4
        assert len(find_hot_pixels(above, np.full((9, 9), 25.0), dn_per_e, JOINT)) == is_hot


def test_positions_are_over_half_the_diagonal_and_mirrored() -> None:
    part = handmade(OFF)
    np.testing.assert_allclose(_offset(part, np.array([[310.0, 40.0]])), [[100 / 250, -100 / 250]], rtol=1e-12)
    solution = replace(part.matches.solution, mirrored=True)
    mirrored = replace(part, matches=replace(part.matches, solution=solution))
    np.testing.assert_allclose(
        _offset(mirrored, np.array([[310.0, 40.0]])), [[(89 - 210) / 250, -100 / 250]], rtol=1e-12
    )


def test_detected_stars_have_the_colours_of_their_matches() -> None:
    part = handmade(OFF)
    some = np.array([4, 7, 2])
    matches = replace(part.matches, star=some, detection=np.array([1, 2, 3]))
    bv = _detected_colours(replace(part, matches=matches))
    colours = part.reference.stars.bv[some]
    assert bv[1:4].tolist() == colours.tolist()
    assert set(np.delete(bv, [1, 2, 3]).tolist()) == {0.65}


def test_the_noise_of_a_pixel_is_that_of_its_level_if_it_grows() -> None:
    part, sky = handmade(OFF), sky_of(slope=0.02)
    np.testing.assert_allclose(_pixel_variance(part, sky, None), 16 + 1 / 12, rtol=1e-12)
    assert NOISE.is_shot_noise
    np.testing.assert_allclose(_pixel_variance(part, sky, NOISE), 1.5 + 0.3 * sky.level_dn + 1 / 12, rtol=1e-12)
    doubtful = replace(NOISE, dn_per_e_error=0.08)
    np.testing.assert_allclose(_pixel_variance(part, sky, doubtful), 16 + 1 / 12, rtol=1e-12)
    assert (_gain(None), _gain(NOISE), _gain(doubtful)) == (0.0, 0.3, 0.0)


def electrons(at_zero_dn2: float, texels: np.ndarray):
    sky = replace(sky_of(), texels_dn=texels)
    return _electrons(replace(NOISE, at_zero_dn2=at_zero_dn2), sky, TERMS, 0.5, 4095)


def test_the_black_level_is_the_smallest_that_the_noise_allows() -> None:
    texels = np.array([[44.0, 52.0], [50.0, 54.0]])
    flux = 10 ** (0.4 * 11.0)
    plain = electrons(1.5, texels)
    assert plain.keys == {
        "vmag_0_e_per_s": pytest.approx(flux / 0.3 / 0.5, rel=1e-12),
        "sky_e_per_s": pytest.approx(50 / 0.3 / 0.5, rel=1e-12),
        "gain_dn_per_e": 0.3,
        "analogue_gain": 1.0,
        "full_well_e": pytest.approx(1.05 * 4095 / 0.3, rel=1e-12),
        "black_level_dn": 0.0,
        "read_noise_before_gain_e": pytest.approx(np.sqrt(1.5) / 0.3, rel=1e-12),
        "read_noise_after_gain_e": 0.0,
        "dark_current_e_per_s": 0.0,
        "dark_doubling_c": 7.0,
        "temperature_c": 25.0,
    }
    # The line reaches 0 at 10 DN: the noise of a lower level would be negative.
    black = electrons(-3.0, texels)
    assert (black.black_level_dn, black.read_noise_before_gain_e) == (pytest.approx(10.0), 0.0)
    assert black.sky_e_per_s == pytest.approx(40 / 0.3 / 0.5, rel=1e-12)
    assert black.full_well_e == pytest.approx(1.05 * 4085 / 0.3, rel=1e-12)
    # It is not above the darkest sky.
    dark = electrons(-30.0, texels)
    assert (dark.black_level_dn, dark.read_noise_before_gain_e) == (44.0, 0.0)
    below = electrons(-3.0, texels - 60.0)
    assert (below.black_level_dn, below.sky_e_per_s) == (0.0, 0.0)


def sensor_of(part=None, noise=NOISE, terms=TERMS, joint=JOINT, has_map=False):
    return _sensor(handmade(OFF) if part is None else part, sky_of(), noise, joint, terms, has_map=has_map)


def test_a_sensor_in_electrons_has_the_terms_of_its_stars() -> None:
    part = handmade(OFF)
    sensor, errors, refused = sensor_of(part)
    assert refused == ()
    farthest = np.linalg.norm(_offset(part, part.stars.xy_px), axis=1).max()
    assert sensor.effects == {
        "sensor.psf_wing_fraction": 0.1,
        "sensor.band": "custom",
        "sensor.band_slope": -0.3123,
        "sensor.band_curvature": 0.1235,
        **_vignetting(CAMERA, 0.4, farthest),
    }
    model = _electrons(NOISE, sky_of(), TERMS, 0.5, 4095)
    assert sensor.electrons == model
    assert errors == {
        "psf_sigma_px": 0.01,
        "band_slope": 0.02,
        "band_curvature": 0.03,
        "vignetting_r2": pytest.approx(0.92 * 0.05),
        "gain_dn_per_e": 0.06,
        "vmag_0_e_per_s": pytest.approx(model.vmag_0_e_per_s * np.hypot(0.921 * 0.02, 0.2), rel=1e-12),
    }
    assert (sensor.psf_sigma_px, sensor.sky_mean_dn) == (1.2, 50.0)
    reference = part.sensor.reference_vmag
    flux = 10 ** (-0.4 * (reference - 11.0))
    area = 1 / (0.9 / (2 * np.pi * 1.44) + 0.1 / (2 * np.pi * 16))
    assert sensor.reference_peak_dn == pytest.approx(flux / area, rel=1e-12)
    assert sensor_of(part, has_map=True)[0].sky_mean_dn == 50.0
    lower = replace(sky_of(), texels_dn=np.array([[-3.0, -1.0]]))
    assert _sensor(part, lower, None, JOINT, TERMS, has_map=True)[0].sky_mean_dn == 0.0
    assert _sensor(part, lower, None, JOINT, TERMS, has_map=False)[0].sky_mean_dn == 50.0


def test_what_a_photograph_does_not_show_is_refused() -> None:
    part = handmade(OFF)
    bare = replace(TERMS, colour=None, curvature=None, loss_mag=None)
    doubtful = replace(NOISE, dn_per_e_error=0.08)
    sensor, errors, refused = sensor_of(part, doubtful, bare)
    assert refused == (
        "the stars do not show a colour term: brightness follows V",
        "the stars do not show vignetting",
        "the noise does not grow with the level of the sky (0.3 ± 0.08 DN/e): one standard deviation for all pixels",
    )
    assert (sensor.electrons, set(sensor.effects)) == (None, {"sensor.psf_wing_fraction"})
    peak = sensor.reference_peak_dn
    assert errors == {"psf_sigma_px": 0.01, "reference_peak_dn": pytest.approx(0.921 * peak * 0.02, rel=1e-12)}
    assert sensor_of(part, None, bare)[2] == refused[:2]
    straight = sensor_of(part, NOISE, replace(TERMS, curvature=None))
    assert "sensor.band_curvature" not in straight[0].effects
    assert "band_curvature" not in straight[1]


def test_the_shape_of_a_mirrored_photograph_is_that_of_the_scene() -> None:
    part = handmade(OFF)
    solution = replace(part.matches.solution, mirrored=True)
    mirrored = replace(part, matches=replace(part.matches, solution=solution))
    long = replace(JOINT, psf=PointSpread(psf_ellipticity=0.2, psf_angle_rad=0.5))
    assert sensor_of(mirrored, joint=long)[0].effects["sensor.psf_angle_deg"] == pytest.approx(180 - np.rad2deg(0.5))
    assert sensor_of(part, joint=long)[0].effects["sensor.psf_angle_deg"] == pytest.approx(np.rad2deg(0.5))
    assert "sensor.psf_angle_deg" not in sensor_of(mirrored)[0].effects


@pytest.mark.parametrize("centre", [(210.0, 140.0), (150.0, 180.0)])
def test_vignetting_is_a_polynomial_of_the_sky(centre: tuple[float, float]) -> None:
    """Stars lose 0.4 mag at half the diagonal; the sky also has the solid angle of its pixels."""
    camera = Camera(400, 300, 500.0, 500.0, *centre)
    keys = _vignetting(camera, 0.4, 0.9)
    assert keys["lens.vignetting"] == "polynomial"
    for r in (0.3, 0.6, 0.9):
        towards = np.where(np.array([200, 150]) < np.array(centre), -1, 1)
        xy = np.array(centre) + 250 * r * towards * [0.8, 0.6]
        expected = 10 ** (-0.4 * 0.4 * r**2) * relative_solid_angle(camera, xy)
        assert float(Vignetting.of(keys).of_sky(camera, xy)) == pytest.approx(float(expected), rel=2e-4)
    r = np.linspace(0, 1, 41)
    towards = np.array([0.8, 0.6]) * np.where(np.array([200, 150]) < np.array(centre), -1, 1)
    sky = 10 ** (-0.16 * r**2) * relative_solid_angle(camera, np.array(centre) + 250 * r[:, np.newaxis] * towards)
    weight = np.where(r <= 0.5, 1.0, 0.05)
    design = np.column_stack([r**2, r**4, r**6])
    v = np.linalg.lstsq(design * weight[:, np.newaxis], (sky - 1) * weight, rcond=None)[0]
    few = _vignetting(camera, 0.4, 0.5)
    assert [few[f"lens.vignetting_r{k}"] for k in (2, 4, 6)] == pytest.approx(v.tolist(), abs=6e-6)


def model_of(part=None, **given) -> PhotographModel:
    part = handmade(OFF) if part is None else part
    table = StarTable(
        "bsc5", np.array([7], np.int32), ("S",), np.array([3.0]), np.array([0.1]), np.array([0.02]), np.array([1])
    )
    fields = {
        "calibration": replace(part, sensor=sensor_of(part)[0]),
        "sky": sky_of(),
        "noise": NOISE,
        "joint": JOINT,
        "terms": TERMS,
        "hot": HotPixels(np.array([4, 390]), np.array([3, 200]), np.array([80.0, 90.5])),
        "brightness": table,
        "has_map": True,
        "moved": False,
        "flux_dn": np.ones(30),
        "standard_error": {"psf_sigma_px": 0.01},
        "refused": ("no tilt", "no wings"),
    }
    return PhotographModel(**fields | given)


def test_the_maps_of_a_photograph_are_those_of_the_scene() -> None:
    model = model_of()
    np.testing.assert_array_equal(model.sky_texels, np.float32([[44, 52], [50, 54]]))
    black = replace(
        model.calibration.sensor, electrons=replace(model.calibration.sensor.electrons, black_level_dn=48.0)
    )
    higher = replace(model, calibration=replace(model.calibration, sensor=black))
    np.testing.assert_array_equal(higher.sky_texels, np.float32([[0, 4], [2, 6]]))
    frame = model.dark_frame
    assert (frame.shape, frame[3, 4], frame[200, 390], np.count_nonzero(frame)) == ((300, 400), 80.0, 90.5, 2)
    solution = replace(model.calibration.matches.solution, mirrored=True)
    part = replace(model.calibration, matches=replace(model.calibration.matches, solution=solution))
    mirrored = replace(model, calibration=part)
    np.testing.assert_array_equal(mirrored.dark_frame, frame[:, ::-1])
    np.testing.assert_array_equal(mirrored.sky_texels, model.sky_texels[:, ::-1])
    paper = replace(model.calibration, sensor=replace(model.calibration.sensor, electrons=None))
    assert replace(model, calibration=paper).dark_frame is None
    assert replace(model, hot=HotPixels(np.empty(0, int), np.empty(0, int), np.empty(0))).dark_frame is None


def test_what_is_written_of_a_photograph() -> None:
    model = model_of()
    text = model.to_toml("sky.tiff", "hot.tiff", "stars.csv")
    head = text.splitlines()
    assert head[:3] == [
        f"# Calibrated by glstar {__version__} from a.png: shape of 25 stars, brightness of 28.",
        "# Not measured: no tilt.",
        "# Not measured: no wings.",
    ]
    sensor = tomllib.loads(text)["sensor"]
    assert (sensor["sky_map"], sensor["dark_frame"]) == ("sky.tiff", "hot.tiff")
    assert "stars.csv" in text
    table = model.brightness
    none = replace(table, star_id=table.star_id[:0], vmag=table.vmag[:0], off_mag=table.off_mag[:0])
    bare = replace(
        model, has_map=False, hot=HotPixels(np.empty(0, int), np.empty(0, int), np.empty(0)), brightness=none
    )
    text = bare.to_toml("sky.tiff", "hot.tiff", "stars.csv")
    assert not any(name in text for name in ("sky.tiff", "hot.tiff", "stars.csv"))
    assert model.to_json() == {
        "standard_error": {"psf_sigma_px": 0.01},
        "psf_stars": 25,
        "psf_misfit": 1.1,
        "brightness_scatter_mag": 0.07,
        "brightness_stars": 28,
        "noise_against_level": {"level_dn": [40.0, 60.0], "std_dn": [np.sqrt(13.0), np.sqrt(19.0)]},
        "response_exponent": [1.01, 0.004],
        "hot_pixels": [[4.0, 3.0, 80.0], [390.0, 200.0, 90.5]],
        "refused": ["no tilt", "no wings"],
    }
    unknown = replace(model, noise=None, terms=replace(TERMS, magnitude_slope=None)).to_json()
    assert (unknown["noise_against_level"], unknown["response_exponent"]) == (None, None)
