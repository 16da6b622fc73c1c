"""Which stars and pixels of one photograph are measured: stamps, shapes, fluxes and the unevenness of the sky."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.sensor import photographmodel
from glstar.calibrate.sensor.photographmodel import (
    HotPixels,
    _matched_fluxes,
    _offset,
    _pixel_variance,
    _shape,
    _stamps,
    measure_photograph,
)
from glstar.errors import CalibrationError
from tests.support.handmade import JOINT, NOISE, OFF, handmade, sky_of, with_stars


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
        (0.41, (1.2, 1.1), True, 2),
        (0.4, (1.2, 1.1), False, 1),
        (0.39, (1.2, 1.1), False, 1),
        (5.0, (1.1, 1.2), False, 2),
    ):
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
