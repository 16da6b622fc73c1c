"""What the brightness of stars depends on: each term, its chance, the air, and the table of a photograph."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_law

from glstar.arrays import robust_std
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.sensor import brightness
from glstar.calibrate.sensor.brightness import (
    AirTerm,
    _air_masses,
    _by_chance,
    _huber_weights,
    _left_out,
    above_air,
    above_air_together,
    fit_brightness_terms,
    recorded_brightness,
    robust_fit,
    with_air_noted,
)
from glstar.calibrate.sensor.misfit import Measurement
from glstar.calibrate.sensor.misfitmeasurement import corner_distance
from glstar.camera.sensor.colourband import ColourBand
from glstar.errors import CalibrationError
from tests.support.handmade import handmade, with_stars


def stars_of(count: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    return rng.uniform(2, 6, count), rng.uniform(-0.2, 1.6, count), np.sqrt(rng.uniform(0, 1, count))


def test_weights_fall_beyond_one_and_a_half_deviations() -> None:
    residual = np.array([0.1, -0.1, 0.5, -2.0, 0.0])
    total = np.hypot(0.2, np.array([0.05, 0.3, 0.1, 0.1, 0.1]))
    expected = [1, 1, 1.5 * total[2] / 0.5, 1.5 * total[3] / 2.0, 1] / total**2
    np.testing.assert_allclose(
        _huber_weights(residual, np.array([0.05, 0.3, 0.1, 0.1, 0.1]), 0.2), expected, rtol=1e-12
    )
    # The scatter is a hundredth of a magnitude at least.
    np.testing.assert_allclose(_huber_weights(np.zeros(1), np.zeros(1), 0.0), [1e4], rtol=1e-12)


def test_a_robust_fit_solves_its_weighted_equations() -> None:
    rng = np.random.default_rng(1)
    design = np.column_stack([np.ones(50), rng.normal(0, 1, 50), rng.uniform(0, 2, 50)])
    noise = rng.uniform(0.02, 0.2, 50)
    values = design @ [1.0, -0.5, 0.3] + 0.1 * rng.standard_normal(50)
    values[:4] += 3.0
    p, error, scatter = robust_fit(design, values, noise)
    residual = values - design @ p
    assert scatter == pytest.approx(robust_std(residual, np.median(residual)), rel=1e-9)
    weight = _huber_weights(residual, noise, scatter)
    np.testing.assert_allclose(design.T @ (weight * residual), 0, rtol=0, atol=1e-6 * weight.sum())
    np.testing.assert_allclose(p, [1.0, -0.5, 0.3], rtol=0, atol=0.15)
    inverse = np.linalg.inv(design.T @ np.diag(weight) @ design)
    meat = design.T @ np.diag((weight * residual) ** 2) @ design
    np.testing.assert_allclose(error, np.sqrt(np.diag(inverse @ meat @ inverse) * 50 / 47), rtol=1e-6)
    # Measurements of one star deviate together: twice the same counts once.
    twice = robust_fit(np.tile(design, (2, 1)), np.tile(values, 2), np.tile(noise, 2), same=np.tile(np.arange(50), 2))
    np.testing.assert_allclose(twice[0], p, rtol=1e-9)
    np.testing.assert_allclose(twice[1], error * np.sqrt(47 / 50 * 100 / 97), rtol=1e-6)


def test_the_probability_of_chance_is_that_of_an_f_test() -> None:
    rng = np.random.default_rng(2)
    design = np.column_stack([np.ones(30), rng.normal(0, 1, 30), rng.normal(0, 1, 30)])
    values = design @ [0.2, 0.05, 0.12] + 0.15 * rng.standard_normal(30)
    noise = rng.uniform(0.01, 0.1, 30)
    p = np.linalg.lstsq(design, values, rcond=None)[0]
    residual = values - design @ p
    root = np.sqrt(_huber_weights(residual, noise, robust_std(residual, np.median(residual))))

    def cost(columns: list[int]) -> float:
        part = design[:, columns] * root[:, np.newaxis]
        return float(np.linalg.lstsq(part, values * root, rcond=None)[1][0])

    def chance(columns: list[int], fewer: int) -> float:
        return float(f_law.sf((cost(columns) / cost([0, 1, 2]) - 1) * 27 / fewer, fewer, 27))

    every, each = _by_chance(design, values, noise, p)
    assert every == pytest.approx(chance([0], 2), rel=1e-6)
    assert each == pytest.approx([chance([0, 2], 1), chance([0, 1], 1)], rel=1e-6)
    assert _by_chance(design[:, :1], values, noise, p[:1]) == (pytest.approx(1.0), [])


@pytest.mark.parametrize(
    ("names", "values", "every", "each", "left_out"),
    [
        (["colour", "loss"], [0.1, 0.2], 0.0096, [0.02, 0.048], None),
        (["colour", "loss"], [0.1, 0.2], 0.0096, [0.02, 0.052], "loss"),
        (["colour", "loss"], [0.1, 0.2], 0.0104, [0.02, 0.03], "loss"),
        (["colour", "loss"], [0.1, 0.2], 0.0104, [0.04, 0.03], "colour"),
        (["colour", "loss"], [0.1, -0.2], 0.001, [0.02, 0.001], "loss"),  # corners brighter than the centre
        (["colour", "loss", "curvature"], [0.1, 0.2, 0.3], 0.001, [0.9, 0.04, 0.03], None),
        (["colour", "loss", "curvature"], [0.1, 0.2, 0.3], 0.001, [0.9, 0.04, 0.06], "curvature"),
        (["colour", "loss"], [0.1, 0.0], 0.001, [0.02, 0.001], "loss"),
        (["colour", "loss"], [0.1, 0.2], 0.001, [0.02, 0.05], "loss"),
        (["colour", "loss"], [0.1, 0.2], 0.01, [0.02, 0.03], "loss"),
        ([], [], 1.0, [], None),
    ],
)
def test_the_least_supported_term_is_left_out(names, values, every, each, left_out) -> None:
    assert _left_out(names, np.array([25.0, *values]), every, each) == left_out


def test_all_terms_of_the_brightness_are_found() -> None:
    vmag, bv, r = stars_of(60)
    rng = np.random.default_rng(3)
    off = -12.0 - 0.5 * bv + 0.2 * bv**2 + 0.4 * r**2 + 0.02 * rng.standard_normal(60)
    flux = 10 ** (-0.4 * (vmag + off))
    unknown = bv.copy()
    unknown[4] = np.nan
    off[4] += -0.5 * (0.65 - bv[4]) + 0.2 * (0.65**2 - bv[4] ** 2)
    flux[4] = 10 ** (-0.4 * (vmag[4] + off[4]))
    used = np.arange(60) != 7
    flux[8], flux[9], flux[12] = -1.0, 3 * flux[9], 0.0
    used[9] = False
    error = 0.01 * flux
    error[10] = np.inf
    terms = fit_brightness_terms(flux, error, vmag, unknown, r, used)
    assert terms.zero_mag == pytest.approx(-12.0, abs=0.02)
    for term, true in ((terms.colour, -0.5), (terms.curvature, 0.2), (terms.loss_mag, 0.4)):
        assert term.value == pytest.approx(true, abs=4 * term.standard_error)
        assert term.standard_error < 0.03
    assert terms.magnitude_slope.value == pytest.approx(0, abs=4 * terms.magnitude_slope.standard_error)
    assert terms.magnitude_slope.standard_error < 0.01
    assert terms.stars == 56
    c = np.where(np.isnan(unknown), 0.65, bv)
    model = terms.zero_mag + terms.colour.value * c + terms.curvature.value * c**2 + terms.loss_mag.value * r**2
    residual = np.full(60, np.nan)
    residual[flux > 0] = -2.5 * np.log10(flux[flux > 0]) - vmag[flux > 0] - model[flux > 0]
    np.testing.assert_allclose(terms.residual_mag, residual, rtol=0, atol=1e-9)
    fitted = residual[used & (flux > 0)]
    assert terms.scatter_mag == pytest.approx(robust_std(fitted, np.median(fitted)), rel=1e-6)
    assert terms.zero_error_mag < 0.02
    # A response that is not linear has a slope over magnitude.
    bent = fit_brightness_terms(np.sign(flux) * np.abs(flux) ** 0.9, error, vmag, unknown, r, used)
    assert bent.magnitude_slope.value == pytest.approx(-0.1, abs=0.01)


def test_terms_are_those_of_a_robust_fit_with_the_noise_of_each_star() -> None:
    vmag, bv, r = stars_of(50, seed=4)
    rng = np.random.default_rng(5)
    part = rng.uniform(0.01, 0.4, 50)
    off = -12.0 - 0.6 * bv + 0.7 * r**2 + 1.0857 * part * rng.standard_normal(50)
    flux = 10 ** (-0.4 * (vmag + off))
    error = part * flux
    error[3] = np.inf  # as large as the flux
    error[5] = 3 * flux[5]  # no noise is larger than that
    terms = fit_brightness_terms(flux, error, vmag, bv, r, np.ones(50, bool))
    noise = 1.0857 * np.where(np.arange(50) == 3, 1.0, np.minimum(error / flux, 1.0))
    names = [name for name in ("colour", "loss", "curvature") if getattr(terms, {"loss": "loss_mag"}.get(name, name))]
    columns = {"colour": bv, "loss": r**2, "curvature": bv**2}
    design = np.column_stack([np.ones(50), *(columns[name] for name in names)])
    p, sd, scatter = robust_fit(design, off, noise)
    assert (terms.zero_mag, terms.zero_error_mag, terms.scatter_mag) == pytest.approx((p[0], sd[0], scatter), rel=1e-9)
    for k, name in enumerate(names, start=1):
        found = getattr(terms, {"loss": "loss_mag"}.get(name, name))
        assert (found.value, found.standard_error) == pytest.approx((p[k], sd[k]), rel=1e-9)
    q, q_sd, _ = robust_fit(np.column_stack([design, vmag - np.median(vmag)]), off, noise)
    slope = terms.magnitude_slope
    assert (slope.value, slope.standard_error) == pytest.approx((q[-1], q_sd[-1]), rel=1e-9)


def test_a_term_needs_four_stars_and_a_span() -> None:
    def terms(
        count: int,
        bv_span: float = 1.8,
        bluest: float = 0.1,
        r_span: float = 1.0,
        v_span: float = 4.0,
        loss: float = 0.6,
    ):
        bv, r = np.linspace(bluest, bluest + bv_span, count), np.sqrt(np.linspace(0, r_span, count)[::-1])
        # The shuffled order keeps the columns independent.
        order = np.random.default_rng(0).permutation(count)
        bv = bv[order]
        vmag = np.linspace(2, 2 + v_span, count)[np.random.default_rng(1).permutation(count)]
        off = -12.0 - 0.5 * bv + loss * r**2 + 0.003 * np.random.default_rng(2).standard_normal(count)
        flux = 10 ** (-0.4 * (vmag + off))
        return fit_brightness_terms(flux, 0.001 * flux, vmag, bv, r, np.ones(count, bool))

    # Twelve stars are enough for two terms, eight for one, and seven for none.
    assert (terms(12).colour is None, terms(12).loss_mag is None) == (False, False)
    assert (terms(11).colour is None, terms(11).loss_mag is None) == (False, True)
    assert (terms(8, loss=0.0).colour is None, terms(7, loss=0.0).colour is None) == (False, True)
    assert (terms(40, bv_span=0.21).colour is None, terms(40, bv_span=0.19).colour is None) == (False, True)
    assert terms(40, bv_span=0.2, bluest=0.0).colour is None
    assert terms(40, r_span=0.2).loss_mag is None
    assert (terms(40, r_span=0.21).loss_mag is None, terms(40, r_span=0.19).loss_mag is None) == (False, True)
    # A slope over magnitude needs four stars for each parameter, and a span of its own.
    assert (terms(16).magnitude_slope is None, terms(15).magnitude_slope is None) == (False, True)
    assert (terms(40, v_span=0.21).magnitude_slope is None, terms(40, v_span=0.19).magnitude_slope is None) == (
        False,
        True,
    )


def masses_of(calibration) -> np.ndarray:
    """Return the air masses by Rozenberg 1966; the zenith is z, and nothing refracts."""
    sine = calibration.reference.stars.direction_eq[:, 2]
    return 1 / (sine + 0.025 * np.exp(-11 * sine))


def behind_air(count: int = 60, k: float = 0.3, haze: float = 0.0, scatter: float = 0.01, **given: object):
    plain = handmade(np.zeros(count), **given)
    noise = scatter * np.random.default_rng(8 + count).standard_normal(count)
    return handmade(k * masses_of(plain) + haze + noise, **given)


def test_air_masses_are_those_of_the_apparent_altitudes() -> None:
    part = handmade(np.zeros(60))
    mass = masses_of(part)
    assert 1.2 < mass.min() < mass.max() < 3
    np.testing.assert_allclose(_air_masses(part), mass, rtol=1e-9)
    unknown = replace(part, reference=replace(part.reference, C_ned_eq=None))
    with pytest.raises(
        CalibrationError, match="--extinction needs the altitude of the stars, so the site and the time"
    ):
        _air_masses(unknown)


def test_a_given_extinction_leaves_the_median_above_the_air() -> None:
    part = behind_air(k=0.3, haze=0.15)
    mass = masses_of(part)
    found = above_air(part, 0.3)
    free = part.off_mag - 0.3 * mass
    offset = float(np.median(free))
    peak = part.brightness.reference_peak_dn * 10 ** (-0.4 * offset)
    assert found.sensor.reference_peak_dn == found.brightness.reference_peak_dn == pytest.approx(peak, rel=1e-12)
    assert found.brightness.error_mag == pytest.approx(robust_std(free, offset) * np.sqrt(np.pi / 2 / 60), rel=1e-9)
    assert found.brightness.scatter_mag == pytest.approx(robust_std(free, offset), rel=1e-9)
    np.testing.assert_allclose(found.extinction_mag, 0.3 * mass, rtol=1e-9)
    assert found.air == {
        "reference_is": "above the air",
        "zenith_extinction_mag": 0.3,
        "standard_error_mag": None,
        "air_mass": [pytest.approx(mass.min()), pytest.approx(mass.max())],
        "stars": 60,
    }
    note = found.notes[0]
    assert note.kind is NoteKind.SENSOR
    assert note.text == (
        "reference_peak_dn is above the air: 0.300 mag per air mass (as given; 60 stars, air masses"
        f' {mass.min():.2f} to {mass.max():.2f}) are taken out; simulate with [sky] extinction = "standard"'
    )
    assert "± 0.012, fitted; 7 stars, air masses 1.20 to 2.30" in AirTerm(0.3, 0.012, 1.2, 2.3, 7).note.text
    # The image is as bright everywhere as its stars above the air: nothing is left to the corners.
    assert np.nanmax(np.abs(found.misfit.brightness_map_mag - np.nanmedian(found.misfit.brightness_map_mag))) < 0.03
    # Notes that are not of the misfit stay, after that of the air.
    remark = Note(NoteKind.CAMERA, "a remark")
    assert above_air(replace(part, notes=(remark,)), 0.3).notes == (note, remark)
    # Stars without light and those that are not used do not count.
    used = np.arange(60) % 2 == 0
    peak_dn = part.stars.peak_dn.copy()
    peak_dn[4], peak_dn[6] = -1.0, 0.0
    some = replace(with_stars(part, peak_dn=peak_dn), brightness=replace(part.brightness, used=used))
    assert above_air(some, 0.3).air["stars"] == 28


def test_the_extinction_of_several_photographs_is_one_fit() -> None:
    clear, hazy = behind_air(k=0.3), behind_air(50, k=0.3, haze=0.4, first=5, exposure_s=0.8)
    parts = (clear, hazy)
    found = above_air_together(parts)
    columns, values, noise, number, image = [], [], [], [], []
    for k, part in enumerate(parts):
        count = len(part.stars)
        columns.append(
            np.column_stack(
                [
                    masses_of(part),
                    part.reference.stars.bv,
                    corner_distance(part.image, part.matches, part.stars.xy_px) ** 2,
                ]
            )
        )
        values.append(part.off_mag)
        noise.append(1.0857 * part.stars.noise_dn / part.stars.peak_dn)
        number.append(part.stars.star_id)
        image.append(np.full(count, k))
    columns, image = np.concatenate(columns), np.concatenate(image)
    columns[:, 1:] -= np.median(columns[:, 1:], axis=0)
    design = np.column_stack([image == 0, image == 1, columns]).astype(float)
    p, error, _ = robust_fit(design, np.concatenate(values), np.concatenate(noise), same=np.concatenate(number))
    for k, part in enumerate(found):
        assert part.air["zenith_extinction_mag"] == pytest.approx(p[2], rel=1e-6)
        assert part.air["standard_error_mag"] == pytest.approx(error[2], rel=1e-6)
        assert part.brightness.error_mag == pytest.approx(error[k], rel=1e-6)
        assert part.sensor.reference_peak_dn == pytest.approx(
            parts[k].sensor.reference_peak_dn * 10 ** (-0.4 * p[k]), rel=1e-6
        )
        assert part.air["stars"] == 110
    assert p[2] == pytest.approx(0.3, abs=4 * error[2])


def test_the_message_for_too_few_stars_has_the_widest_air_masses() -> None:
    """One image has its own; of several, the one with the largest span is named."""
    for parts, where in (
        ((behind_air(19),), "the image has"),
        ((behind_air(7), behind_air(12, first=7)), "the images have, at best on one of them,"),
        ((behind_air(12, first=7), behind_air(7)), "the images have, at best on one of them,"),
    ):
        spans = [np.percentile(masses_of(part), [5, 95]) for part in parts]
        low, high = max(spans, key=np.ptp)
        with pytest.raises(CalibrationError) as caught:
            above_air_together(parts)
        assert str(caught.value) == (
            f"the extinction needs 20 stars whose air masses differ by 0.5, and {where} 19 of {low:.2f} to {high:.2f}:"
            " take a wider image down to low altitudes, or give the extinction per air mass, as --extinction 0.28"
        )
        assert (caught.value.stars_used, caught.value.stars_needed) == (19, 20)


@pytest.mark.parametrize("count", [20, 29])
def test_twenty_stars_have_terms_of_colour_and_distance(count: int) -> None:
    part = behind_air(count)
    distance2 = corner_distance(part.image, part.matches, part.stars.xy_px) ** 2
    more = [one - np.median(one) for one in (part.reference.stars.bv, distance2)]
    design = np.column_stack([np.ones(count), masses_of(part), *more])
    noise = 1.0857 * part.stars.noise_dn / part.stars.peak_dn
    p, error, _ = robust_fit(design, part.off_mag, noise)
    air = above_air(part).air
    assert (air["zenith_extinction_mag"], air["standard_error_mag"]) == pytest.approx((p[1], error[1]), rel=1e-6)


def test_an_extinction_needs_twenty_stars_and_a_span_of_half_an_air_mass() -> None:
    for count, enough in ((20, True), (19, False)):
        part = behind_air(count)
        if enough:
            assert above_air(part).air["zenith_extinction_mag"] == pytest.approx(0.3, abs=0.05)
        else:
            with pytest.raises(CalibrationError, match=r"air masses differ by 0\.5"):
                above_air(part)
    part = behind_air(120)
    mass = masses_of(part)
    order = np.sort(mass)
    spans = np.array([np.ptp(np.percentile(order[:count], [5, 95])) for count in range(1, 121)])
    for target, enough in ((0.515, True), (0.485, False)):
        most = int(np.argmin(np.abs(spans - target)))
        assert (spans[most] > 0.5) == enough
        assert abs(spans[most] - 0.5) < 0.03
        some = replace(part, brightness=replace(part.brightness, used=mass <= order[most]))
        if enough:
            assert above_air(some).air is not None
        else:
            with pytest.raises(CalibrationError, match=r"air masses differ by 0\.5"):
                above_air(some)


def test_an_extinction_is_noted_if_the_corners_are_darker(monkeypatch: pytest.MonkeyPatch) -> None:
    """An atmosphere takes 0.05 to 1.5 mag per air mass, and more than four standard errors."""
    part = behind_air(60)
    dark = replace(part.misfit, corner_loss_mag=Measurement(0.5, 0.01), gradient_dn=Measurement(30.0, 0.1))
    part = replace(part, misfit=dark)
    part = replace(part, notes=dark.notes(part.sensor))
    kinds = {note.kind for note in part.notes}
    assert kinds == {NoteKind.VIGNETTING, NoteKind.GRADIENT}
    free = replace(part, misfit=replace(dark, corner_loss_mag=Measurement(0.0, 0.01)))

    def noted(k: float, error: float, after=free):
        air = AirTerm(k, error, 1.25, 2.5, 60).to_json()
        monkeypatch.setattr(brightness, "above_air", lambda _: replace(after, air=air))
        return with_air_noted(part).notes

    cases = [(0.052, 0.01, True), (0.048, 0.01, False), (1.44, 0.1, True), (1.56, 0.1, False)]
    cases += [(0.05, 0.01, False), (1.5, 0.1, False), (0.5, 0.125, True)]
    for k, error, is_air in [*cases, (0.41, 0.1, True), (0.39, 0.1, False)]:
        found = noted(k, error)
        assert (found != part.notes) == is_air
        if is_air:
            assert [note.kind for note in found] == [NoteKind.VIGNETTING, NoteKind.GRADIENT]
            assert found[0].text == (
                f"the air dims the stars by {k:.3f} ± {error:.3f} mag per air mass (60 stars, air masses 1.25 to 2.50):"
                " the corners are as bright as the centre without it. reference_peak_dn is that below it;"
                " --extinction fit takes it out"
            )
    # What remains without the air stays a note of its own.
    found = noted(0.3, 0.01, part)
    assert [note.kind for note in found] == [NoteKind.VIGNETTING, NoteKind.GRADIENT, NoteKind.VIGNETTING]
    assert ": the corners" not in found[0].text
    bare = replace(part, notes=(), misfit=replace(dark, corner_loss_mag=None))
    assert with_air_noted(bare) is bare

    def fails(_: object) -> None:
        raise CalibrationError("no")

    monkeypatch.setattr(brightness, "above_air", fails)
    assert with_air_noted(part) is part


def test_each_star_has_the_brightness_of_the_photograph() -> None:
    """Deviations shrink towards their median; the band of the camera is added."""
    own = np.random.default_rng(9).normal(0, 0.2, 40)
    part = handmade(own)
    flux = part.stars.peak_dn * 2 * np.pi * 1.35**2
    bv, r = part.reference.stars.bv, np.zeros(40)
    terms = fit_brightness_terms(flux, 0.02 * flux, part.stars.vmag, bv, r, np.ones(40, bool))
    error = 0.02 * flux
    error[3], error[4] = flux[3] / 2.9, flux[4] / 3.1
    saturated, blended = np.arange(40) == 6, np.arange(40) == 8
    marked = with_stars(part, saturated=saturated, blended=blended)
    terms = replace(terms, residual_mag=np.where(np.arange(40) == 10, np.nan, terms.residual_mag))
    table = recorded_brightness(marked, terms, ColourBand("custom", -0.4, 0.1), flux, error)
    kept = np.delete(np.arange(40), [3, 6, 8, 10])
    assert table.star_id.tolist() == (1000 + kept).tolist()
    assert table.name == tuple(f"S{k}" for k in kept)
    assert (table.catalogue, set(table.images.tolist())) == ("bsc5", {1})
    np.testing.assert_array_equal(table.vmag, part.stars.vmag[kept])
    band = -0.4 * bv[kept] + 0.1 * bv[kept] ** 2
    deviation = terms.residual_mag[kept]
    noise = np.hypot(2.5 / np.log(10) * error[kept] / flux[kept], 0.02)
    # The fixed point: the median of what the stars leave, and weighted deviations about it.
    own_mag = table.off_mag - band
    zero = np.median(deviation)
    for _ in range(50):
        rest = deviation - zero
        spread = np.sqrt(robust_std(rest, np.median(rest)) ** 2 - np.median(noise) ** 2)
        shrunk = rest / noise**2 / (1 / noise**2 + 1 / spread**2)
        zero = np.median(deviation - shrunk)
    np.testing.assert_allclose(own_mag, zero + shrunk, rtol=0, atol=1e-4)
    np.testing.assert_allclose(table.error_mag, 1 / np.sqrt(1 / noise**2 + 1 / spread**2), rtol=1e-3)
