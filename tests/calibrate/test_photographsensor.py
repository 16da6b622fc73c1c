"""The sensor of one photograph by hand: hot pixels, electrons, vignetting, and what is written of them."""

import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import dblquad

from glstar import __version__
from glstar.calibrate.photo.sky import NoiseAgainstLevel, SkyMap
from glstar.calibrate.sensor import photographmodel
from glstar.calibrate.sensor.brightness import BrightnessTerms
from glstar.calibrate.sensor.combine import StarTable
from glstar.calibrate.sensor.jointpsf import JointPsf
from glstar.calibrate.sensor.misfit import Measurement
from glstar.calibrate.sensor.photographmodel import (
    HotPixels,
    PhotographModel,
    _detected_colours,
    _electrons,
    _gain,
    _matched_fluxes,
    _offset,
    _pixel_variance,
    _sensor,
    _shape,
    _stamps,
    _vignetting,
    find_hot_pixels,
    light_beside_star,
    measure_photograph,
)
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import PointSpread
from glstar.camera.vignetting import Vignetting, relative_solid_angle
from glstar.errors import CalibrationError
from tests.support.handmade import CAMERA, handmade, with_stars

OFF = np.random.default_rng(3).normal(0, 0.1, 30)
JOINT = JointPsf(
    PointSpread(psf_wing_fraction=0.1, psf_wing_sigma_px=4.0), 1.2, {"psf_sigma_px": 0.01}, 25, 1.1, ("no growth",)
)
TERMS = BrightnessTerms(
    zero_mag=-11.0,
    zero_error_mag=0.02,
    colour=Measurement(-0.31234, 0.02),
    curvature=Measurement(0.12345, 0.03),
    loss_mag=Measurement(0.4, 0.05),
    magnitude_slope=Measurement(0.01, 0.004),
    scatter_mag=0.07,
    stars=28,
    residual_mag=np.zeros(30),
)
NOISE = NoiseAgainstLevel(
    np.array([40.0, 60.0]),
    np.array([13.0, 19.0]),
    np.array([0.5, 0.6]),
    dn_per_e=0.3,
    dn_per_e_error=0.06,
    at_zero_dn2=1.5,
)


def sky_of(level_dn: float = 50.0, slope: float = 0.0) -> SkyMap:
    level = level_dn + slope * (np.arange(400) - 199.5)[np.newaxis] + np.zeros((300, 1))
    texels = np.array([[level_dn - 6.0, level_dn + 2.0], [level_dn, level_dn + 4.0]])
    return SkyMap(texels, level, np.zeros((300, 400)), np.ones((300, 400), bool), 0.05)


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


def stamps_call(monkeypatch: pytest.MonkeyPatch, part, sky, **given):
    calls = []
    monkeypatch.setattr(
        photographmodel, "cut_stamps", lambda **call: calls.append(SimpleNamespace(**call)) or ("stamps", "inside")
    )
    assert _stamps(part, sky, NOISE, part.stars.xy_px[:5], np.arange(5.0), **given) == ("stamps", "inside")
    return calls[0]


def test_stamps_leave_out_full_pixels_and_know_undetected_stars(monkeypatch: pytest.MonkeyPatch) -> None:
    part, sky = handmade(OFF), sky_of()
    part.image.pixels_dn[20, 30], part.image.pixels_dn[40, 50] = 0.95 * 4095, np.floor(0.95 * 4095)
    moved = part.matches.predicted_xy_px.copy()
    moved[0, 0] += 2.9
    moved[1, 1] += 3.1
    part = replace(part, matches=replace(part.matches, predicted_xy_px=moved))
    distance = np.linalg.norm(moved[1] - part.detected.xy_px, axis=1).min()
    assert distance == pytest.approx(3.1)
    call = stamps_call(monkeypatch, part, sky, moved=False)
    hidden = np.argwhere(~call.usable)
    assert (hidden.min(axis=0).tolist(), hidden.max(axis=0).tolist(), len(hidden)) == ([19, 29], [21, 31], 9)
    np.testing.assert_array_equal(call.others_px, np.concatenate([part.detected.xy_px, moved[1:2]]))
    assert (call.half_px, call.dn_per_e) == (9, 0.3)
    np.testing.assert_array_equal(call.trail_px, np.zeros((5, 2)))
    np.testing.assert_array_equal(call.offset, _offset(part, part.stars.xy_px[:5]))
    np.testing.assert_array_equal(call.variance_dn2, _pixel_variance(part, sky, NOISE))
    assert call.above_dn is sky.residual_dn
    assert call.bv.tolist() == [0, 1, 2, 3, 4]
    # Wide stars have stamps of six sigma, and trails half of their length more.
    wide = replace(
        part, detected=replace(part.detected, psf_sigma_px=1.75), sensor=replace(part.sensor, reference_exposure_s=60.0)
    )
    call = stamps_call(monkeypatch, wide, sky, moved=True)
    longest = np.linalg.norm(call.trail_px, axis=1).max()
    assert longest > 1
    assert call.half_px == int(np.ceil(10.5 + longest / 2))


class Stamps(SimpleNamespace):
    """The part of `StarStamps` that the choice of a shape uses."""

    def __len__(self) -> int:
        return len(self.trail_px)


def shape_of(monkeypatch: pytest.MonkeyPatch, part, *, trail_px: float, misfits: tuple[float, float], inside: int = 99):
    asked = []

    def stamps(calibration, sky, noise, xy_px, bv, *, moved):
        kept = np.arange(min(len(xy_px), inside))
        asked.append((xy_px, bv, moved))
        return Stamps(trail_px=np.full((len(kept), 2), [0.6 * trail_px, 0.8 * trail_px]) * moved, moved=moved), kept

    def fit(stamps, start_px):
        asked.append(start_px)
        return replace(JOINT, misfit=misfits[stamps.moved]), stamps

    monkeypatch.setattr(photographmodel, "_stamps", stamps)
    monkeypatch.setattr(photographmodel, "fit_joint_psf", fit)
    return *_shape(part, sky_of(), NOISE), asked


def test_a_shape_is_that_of_the_clearest_stars_at_rest_or_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    part = handmade(np.zeros(30))
    signal = np.linspace(14.8, 40, 30)[np.random.default_rng(0).permutation(30)]
    signal[np.argmin(np.where(signal > 15, signal, 99))] = 15.0
    saturated = np.zeros(30, bool)
    saturated[np.argmax(signal)] = True
    detected = replace(part.detected, peak_dn=signal * 4.0, saturated=saturated, psf_sigma_px=1.35)
    part = replace(part, detected=detected)
    for trail_px, misfits, moved, fits in (
        (0.41, (1.2, 1.1), True, 2), (0.39, (1.2, 1.1), False, 1), (5.0, (1.1, 1.2), False, 2),
    ):  # fmt: skip
        joint, has_moved, asked = shape_of(monkeypatch, part, trail_px=trail_px, misfits=misfits)
        assert (has_moved, joint.misfit) == (moved, misfits[moved])
        assert [one for one in asked if isinstance(one, float)] == [1.35] * fits
    order = [k for k in np.argsort(-signal) if not saturated[k] and signal[k] > 15]
    assert len(order) == 27
    np.testing.assert_array_equal(asked[0][0], detected.xy_px[order])
    np.testing.assert_array_equal(asked[0][1], part.reference.stars.bv[order])
    assert [one[2] for one in asked if isinstance(one, tuple)] == [False, False, True]
    narrow = replace(part, detected=replace(detected, psf_sigma_px=0.4))
    assert 0.5 in shape_of(monkeypatch, narrow, trail_px=0.0, misfits=(1.0, 1.0))[2]
    assert shape_of(monkeypatch, part, trail_px=0.0, misfits=(1.0, 1.0), inside=6)[0].misfit == 1.0
    with pytest.raises(
        CalibrationError, match=r"needs 6 stars of a signal-to-noise ratio of 15 .* the image has 5"
    ) as caught:
        shape_of(monkeypatch, part, trail_px=0.0, misfits=(1.0, 1.0), inside=5)
    assert (caught.value.stars_used, caught.value.stars_needed) == (5, 6)


def test_ninety_stars_give_a_shape_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    part = handmade(np.zeros(120))
    part = replace(part, detected=replace(part.detected, peak_dn=np.linspace(900, 100, 120)))
    asked = shape_of(monkeypatch, part, trail_px=0.0, misfits=(1.0, 1.0))[2]
    np.testing.assert_array_equal(asked[0][0], part.detected.xy_px[:90])


def fluxes_of(monkeypatch: pytest.MonkeyPatch, part, flux: np.ndarray, error: np.ndarray, inside: np.ndarray):
    monkeypatch.setattr(photographmodel, "_stamps", lambda *_, **__: ("stamps", inside))
    monkeypatch.setattr(photographmodel, "measure_fluxes", lambda *_: (flux[inside], error[inside], "stamps"))
    return _matched_fluxes(part, sky_of(), NOISE, JOINT, moved=False)


def test_fluxes_of_ten_errors_decide_the_zero_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not those of blended stars; those of saturated ones only where less than ten others are left."""
    flux, error = np.full(14, 1000.0), np.full(14, 10.0)
    error[1], error[2] = 100.0, 1000 / 10.2
    flux[3] = -5.0
    inside = np.delete(np.arange(14), 5)
    saturated, blended = np.arange(14) == 4, np.arange(14) == 6
    part = with_stars(handmade(np.zeros(14)), saturated=saturated, blended=blended)
    found, errors, used = fluxes_of(monkeypatch, part, flux, error, inside)
    assert found.tolist() == [0.0 if k in {3, 5} else 1000.0 for k in range(14)]
    assert errors.tolist() == [np.inf if k == 5 else error[k] for k in range(14)]
    # Nine are left: the saturated star counts.
    assert np.flatnonzero(~used).tolist() == [1, 3, 5, 6]
    flux[3] = 1000.0
    assert np.flatnonzero(~fluxes_of(monkeypatch, part, flux, error, inside)[2]).tolist() == [1, 4, 5, 6]
    few = np.where(np.arange(14) < 3, 1000.0, 50.0)
    assert fluxes_of(monkeypatch, part, few, np.full(14, 10.0), inside)[2].sum() == 3
    few[2] = 50.0
    with pytest.raises(CalibrationError, match=r"needs 3 identified stars of a signal-to-noise ratio of 10, .* has 2"):
        fluxes_of(monkeypatch, part, few, np.full(14, 10.0), inside)


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


def test_a_sky_is_uneven_beyond_a_tenth_of_its_noise_or_three_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    part = handmade(OFF)
    flux = part.stars.peak_dn * 2 * np.pi * 1.2**2
    monkeypatch.setattr(photographmodel, "measure_noise", lambda _: NOISE)
    monkeypatch.setattr(photographmodel, "_shape", lambda *_: (JOINT, True))
    monkeypatch.setattr(photographmodel, "_matched_fluxes", lambda *_, **__: (flux, 0.01 * flux, np.ones(30, bool)))
    hot = HotPixels(np.array([4]), np.array([3]), np.array([80.0]))
    monkeypatch.setattr(photographmodel, "find_hot_pixels", lambda *_: hot)
    std = np.std(np.arange(400) - 199.5)
    for error_dn, limit_dn in ((0.05, 0.4), (0.2, 0.6)):
        for factor, has_map in ((1.03, True), (0.97, False)):
            sky = replace(sky_of(slope=factor * limit_dn / std), error_dn=error_dn)
            monkeypatch.setattr(photographmodel, "measure_sky", lambda *_, sky=sky: sky)
            model = measure_photograph(part)
            said = f"the sky is even: its level differs by {factor * limit_dn:.2g} DN (limit {limit_dn:.2g})"
            assert (model.has_map, said in model.refused) == (has_map, not has_map)
            assert model.refused[0] == "no growth"
            assert (model.moved, model.joint, model.hot) == (True, JOINT, hot)
    assert not any("hot pixels" in one for one in model.refused)
    monkeypatch.setattr(photographmodel, "measure_noise", lambda _: None)
    assert (
        "1 hot pixels are not simulated: they need noise that grows with the level" in measure_photograph(part).refused
    )
