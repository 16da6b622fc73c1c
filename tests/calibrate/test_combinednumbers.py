"""Several photographs by hand: which stars count, what separates stars from images, and what is written."""

import csv
import io
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from glstar import __version__
from glstar.arrays import robust_std
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.sensor.combine import (
    Observations,
    _brightness,
    _clipped_std,
    _deviations_mag,
    _error_mag,
    _images,
    _measured_well,
    _off_mag,
    _repeat_mag,
    _repeatability,
    combine,
    solve_brightness,
)
from glstar.errors import CalibrationError
from tests.support.handmade import handmade, with_stars


def offsets(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.2, count)


def test_stars_are_measured_well_above_ten_times_the_noise() -> None:
    """Neither saturated nor blended; by the fit, and with an amplitude above the noise itself."""
    part = handmade(np.zeros(9))
    expected = part.fitted_peak_dn
    noise = np.full(9, 4.0)
    noise[0], noise[1] = expected[0] / 9.7, expected[1] / 10.3
    peak = part.stars.peak_dn.copy()
    peak[4], peak[5], peak[7] = 3.9, 4.1, 4.0
    # Ten times the noise exactly is enough.
    exact = next(k for k in (6, 8) if 10 * (expected[k] / 10) == expected[k])
    noise[exact] = expected[exact] / 10
    saturated, blended = np.arange(9) == 2, np.arange(9) == 3
    found = _measured_well(with_stars(part, noise_dn=noise, peak_dn=peak, saturated=saturated, blended=blended))
    assert found.tolist() == [False, True, False, False, False, True, True, False, True]


def test_brightness_is_measured_against_the_first_sensor_at_the_same_exposure() -> None:
    first, part = (
        handmade(np.zeros(6)),
        handmade(np.array([0.1, -0.2, 0.3, 0.0, 0.4, 0.25]), exposure_s=0.8, noise_dn=9.0),
    )
    np.testing.assert_allclose(_off_mag(part, first), [0.1, -0.2, 0.3, 0.0, 0.4, 0.25], rtol=0, atol=1e-12)
    faint = with_stars(part, peak_dn=np.full(6, -3.0))
    np.testing.assert_allclose(_off_mag(faint, first), 2.5 * np.log10(first.fitted_peak_dn * 1.6 / 1e-3), rtol=1e-12)
    # The amplitude of a Gaussian of s px has the error noise / (sqrt(pi) s), and pixels differ by 0.02 mag.
    wide_px = np.sqrt(1.35**2 + 1 / 12)
    noise = 2.5 / np.log(10) * 9.0 / part.stars.peak_dn / (np.sqrt(np.pi) * wide_px)
    np.testing.assert_allclose(_error_mag(part), np.sqrt(noise**2 + 0.02**2), rtol=1e-12)
    assert _error_mag(faint)[0] == pytest.approx(2.5 / np.log(10) * 9000 / (np.sqrt(np.pi) * wide_px), rel=1e-9)


def test_a_deviation_is_scaled_by_the_number_of_measurements_of_its_star() -> None:
    image, star = np.array([0, 1, 0, 1, 2, 0, 2]), np.array([0, 0, 2, 2, 2, 3, 1])
    off = np.array([0.1, 0.5, 0.2, -0.1, 0.6, 9.0, 7.0])
    seen = Observations(image, star, off, np.full(7, 0.02))
    zero = np.array([0.0, 0.1, 0.2])
    # Star 0 has 0.1 and 0.4, star 2 has 0.2, -0.2 and 0.4; the others one measurement each.
    pair = 0.15 * np.sqrt(2)
    three = (np.array([0.2, -0.2, 0.4]) - 0.4 / 3) * np.sqrt(1.5)
    expected = [-pair, pair, *three]
    np.testing.assert_allclose(_deviations_mag(seen, zero), expected, rtol=0, atol=1e-12)
    assert _repeat_mag(seen, zero) == pytest.approx(np.sqrt(np.mean(np.square(expected))), rel=1e-9)
    single = Observations(image[:1], star[:1], off[:1], np.full(1, 0.02))
    assert np.isnan(_repeat_mag(single, zero))


def test_a_clipped_deviation_leaves_out_what_is_beyond_three_robust_ones() -> None:
    values = np.array([1.0, -1.0, 2.0, -2.0, 0.5, 1.5, -1.5, 4.0, 0.2])
    robust = 1.4826 * 1.5
    for far, kept in ((2.9 * robust, True), (3 * robust_std(values), True), (3.1 * robust, False)):
        every = np.append(values, [far, -0.3])
        assert robust_std(every) == pytest.approx(robust, rel=1e-12)
        some = every if kept else np.append(values, -0.3)
        assert _clipped_std(every) == pytest.approx(np.sqrt(np.mean(some**2)), rel=1e-12)
    assert _clipped_std(np.empty(0)) == 0.0


def test_stars_seen_on_two_images_shrink_towards_the_catalogue() -> None:
    """The fixed point of the solution: medians of images, and weighted means of stars with the common spread."""
    rng = np.random.default_rng(4)
    stars, images = 30, 3
    image = np.repeat(np.arange(images), stars)
    star = np.tile(np.arange(stars), images)
    error = rng.uniform(0.02, 0.06, image.size)
    measured = rng.normal(0, 0.25, stars)[star] + np.array([0.0, 0.5, -0.2])[image] + rng.normal(0, 0.1, image.size)
    seen = Observations(image, star, measured, error)
    off, error_mag, zero, spread = solve_brightness(seen, stars + 1, images + 1)
    np.testing.assert_allclose(
        zero[:images], [np.median((measured - off[star])[image == k]) for k in range(images)], rtol=0, atol=3e-5
    )
    assert (zero[images], off[stars]) == (0.0, 0.0)
    rest = measured - zero[image]
    repeat = _clipped_std(_deviations_mag(seen, zero))
    assert repeat > np.median(error)
    all_error = np.sqrt(error**2 + repeat**2 - np.median(error) ** 2)
    robust = robust_std(rest, np.median(rest))
    assert spread == pytest.approx(np.sqrt(robust**2 - np.median(all_error) ** 2), rel=1e-4)
    weight = np.bincount(star, 1 / all_error**2, stars + 1) + 1 / spread**2
    np.testing.assert_allclose(error_mag, 1 / np.sqrt(weight), rtol=1e-4)
    np.testing.assert_allclose(off, np.bincount(star, rest / all_error**2, stars + 1) / weight, rtol=0, atol=1e-4)
    # An error below the noise adds nothing, and the spread has a limit.
    quiet = Observations(image, star, np.zeros(image.size), error)
    off, error_mag, zero, spread = solve_brightness(quiet, stars, images)
    assert (np.abs(off).max(), np.abs(zero).max(), spread) == (0.0, 0.0, 0.03)
    np.testing.assert_allclose(error_mag, (np.bincount(star, 1 / error**2) + 1 / 0.03**2) ** -0.5, rtol=1e-12)


@pytest.mark.parametrize(("on_images", "counts"), [((3, 3, 2, 2, 1), True), ((3, 3, 3, 1, 1), False)])
def test_ten_repeated_measurements_show_the_repeatability(on_images: tuple[int, ...], counts: bool) -> None:
    star = np.repeat(np.arange(5), on_images)
    image = np.concatenate([np.arange(count) for count in on_images])
    own = np.array([0.5, -0.4, 0.1, 0.3, -0.6])[star]
    measured = own + np.random.default_rng(6).normal(0, 0.06, len(star))
    seen = Observations(image, star, measured, np.full(len(star), 0.02))
    off, error_mag, zero, spread = solve_brightness(seen, 5, 3)
    deviations = _deviations_mag(seen, zero)
    assert (len(deviations) >= 10) == counts
    error = max(_clipped_std(deviations), 0.02) if counts else 0.02
    rest = measured - zero[image]
    assert spread == pytest.approx(np.sqrt(robust_std(rest, np.median(rest)) ** 2 - error**2), rel=1e-3)
    np.testing.assert_allclose(error_mag, 1 / np.sqrt(np.array(on_images) / error**2 + 1 / spread**2), rtol=1e-3)
    np.testing.assert_allclose(off, np.bincount(star, rest) / error**2 * error_mag**2, rtol=0, atol=1e-3)


def three() -> tuple:
    own = offsets(30)
    first = handmade(own[:24])
    second = handmade(own[3:27] + 0.3, name="b.png", first=3)
    third = handmade(own[6:] - 0.05, name="c.png", exposure_s=0.8, first=6)
    brighter = replace(third.sensor, sky_mean_dn=70.0, sky_std_dn=5.0)
    return (
        first,
        replace(second, sensor=replace(second.sensor, sky_mean_dn=57.0, sky_std_dn=4.6)),
        replace(third, sensor=brighter),
    )


def test_a_common_sensor_has_the_medians_of_its_photographs() -> None:
    first, second, third = three()
    combined = combine((first, second, third))
    sensor = combined.sensor
    np.testing.assert_allclose(combined.fainter_mag, [0.0, 0.3, -0.05], rtol=0, atol=0.01)
    assert combined.repeat_mag == pytest.approx(0, abs=0.01)
    every = np.concatenate([part.stars.vmag for part in (first, second, third)])
    assert sensor.reference_vmag == round(float(np.median(every)), 2)
    # Only the first two have the same exposure.
    assert (sensor.sky_mean_dn, sensor.sky_std_dn) == (pytest.approx(53.5), pytest.approx(4.3))
    assert sensor.psf_sigma_px == np.median(np.concatenate([part.stars.sigma_px for part in (first, second, third)]))
    assert (sensor.reference_exposure_s, sensor.bit_depth) == (0.5, 12)
    # The median image is that of the first: 900 DN at magnitude 4, and stars are fainter by their median.
    table = combined.table
    assert float(sensor.peak_dn(4.0, 0.5)) == pytest.approx(900 * 10 ** (-0.4 * np.median(offsets(30)[:24])), rel=0.05)
    row = table.star_id - 1000
    assert sorted(row.tolist()) == list(range(30))
    assert (np.diff(table.vmag) >= 0).all()
    assert table.images.tolist() == [1 + (3 <= k < 24) + (6 <= k < 24) if k < 24 else (2 if k < 27 else 1) for k in row]
    difference = table.off_mag - offsets(30)[row]
    assert np.std(difference) < 0.02
    assert combined.spread_mag == pytest.approx(robust_std(offsets(30), np.median(offsets(30))), rel=0.4)
    assert (combined.best, table.catalogue, len(table)) == (first, "bsc5", 30)
    assert table.name == tuple(f"S{k}" for k in row)


def test_a_table_of_stars_is_written_with_four_decimals() -> None:
    combined = combine(three())
    table = combined.table
    rows = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert len(rows) == 30
    for k, row in enumerate(rows):
        assert row == {
            "catalogue": "bsc5",
            "star_id": str(table.star_id[k]),
            "name": table.name[k],
            "vmag": f"{table.vmag[k]:.2f}",
            "camera_mag": f"{table.vmag[k] + table.off_mag[k]:.4f}",
            "off_mag": f"{table.off_mag[k]:.4f}",
            "error_mag": f"{table.error_mag[k]:.4f}",
            "images": str(table.images[k]),
        }


def test_differences_between_photographs_are_noted() -> None:
    """A tenth of a magnitude, and a noise of the sky at the same exposure."""
    first, second, third = three()
    [fainter] = combine((first, second, third)).notes
    assert fainter.text == "b.png is 0.30 mag fainter than the others: haze, or a different exposure than given"
    assert fainter.kind is NoteKind.COMBINATION
    own = offsets(24)
    for off, noted in ((0.194, False), (0.209, True)):
        # Half of the difference to either side of the median.
        notes = combine((handmade(own), handmade(own + off, name="b.png"))).notes
        texts = [note.text for note in notes]
        assert any("a.png is 0.10 mag brighter" in text for text in texts) == noted
        assert any("b.png is 0.10 mag fainter" in text for text in texts) == noted
    for difference_dn, noted in ((7.8, False), (8.0, False), (8.2, True)):
        other = handmade(own, name="b.png")
        other = replace(other, sensor=replace(other.sensor, sky_mean_dn=50 + difference_dn))
        texts = [note.text for note in combine((handmade(own), other)).notes]
        assert texts == (
            [
                "a.png has a sky of 50.0 ± 4.0 DN, and the sensor 54.1 ± 4.0 DN",
                "b.png has a sky of 58.2 ± 4.0 DN, and the sensor 54.1 ± 4.0 DN",
            ]
            if noted
            else []
        )
    # A sky without noise may differ by 1 DN.
    for difference_dn, noted in ((1.9, False), (2.1, True)):
        quiet = [handmade(own), handmade(own, name="b.png")]
        levels = (50.0, 50.0 + difference_dn)
        parts = [
            replace(part, sensor=replace(part.sensor, sky_mean_dn=level, sky_std_dn=0.1))
            for part, level in zip(quiet, levels, strict=True)
        ]
        assert bool(combine(tuple(parts)).notes) == noted


def test_notes_that_all_photographs_share_are_given_once() -> None:
    own = offsets(24)
    shared, mine = Note(NoteKind.CAMERA, "same"), Note(NoteKind.SENSOR, "own")
    first, second = handmade(own), handmade(own, name="b.png")
    combined = combine((replace(first, notes=(shared,)), replace(second, notes=(mine, shared))))
    assert combined.notes == (shared, Note(NoteKind.SENSOR, "b.png: own"))
    assert [note.text for note in combine((replace(first, notes=(mine,)), second)).notes] == ["a.png: own"]


def test_what_is_written_of_several_photographs() -> None:
    combined = combine(three())
    json = combined.to_json()
    assert json.pop("images") == [part.to_json() for part in combined.parts]
    assert json == {
        "schema": 2,
        "glstar": __version__,
        "sensor": combined.sensor.keys,
        "stars": 30,
        "spread_mag": combined.spread_mag,
        "repeat_mag": combined.repeat_mag,
        "fainter_mag": combined.fainter_mag.tolist(),
        "extinction": {"reference_is": "below the air"},
        "notes": [note.text for note in combined.notes],
    }
    text = combined.to_toml("table.csv")
    head = text.splitlines()
    assert head[0] == f"# Calibrated by glstar {__version__} from 3 images (a.png, b.png, c.png): 30 stars."
    assert head[1] == "# reference_peak_dn has the extinction of that night in it: it is below the air."
    assert head[2].startswith("# b.png is 0.30 mag fainter")
    assert tomllib.loads(text)["sensor"]["reference_peak_dn"] == pytest.approx(combined.sensor.reference_peak_dn)
    assert "table.csv" in text
    assert "table.csv" not in combined.to_toml()
    # Stars on one image only do not repeat.
    lone = combine((handmade(offsets(20)), handmade(offsets(20), name="b.png", first=40)))
    assert lone.to_json()["repeat_mag"] is None


def test_photographs_of_other_depths_are_not_of_one_camera() -> None:
    own = offsets(24)
    with pytest.raises(CalibrationError, match=r"a\.png has 12 bits and b\.png 10: not one camera"):
        combine((handmade(own), handmade(own, name="b.png", bits=10)))


def test_a_common_sensor_is_that_of_the_median_photograph() -> None:
    """The first is fainter by 0.3 mag than the two others: the common sensor is brighter than that of the first."""
    own = offsets(24)
    parts = handmade(own + 0.3), handmade(own, name="b.png"), handmade(own, name="c.png")
    combined = combine(parts)
    np.testing.assert_allclose(combined.fainter_mag, [0.3, 0.0, 0.0], rtol=0, atol=1e-3)
    first = parts[0].brightness
    peak = float(first.peak_dn(np.array([combined.sensor.reference_vmag]))[0])
    assert combined.sensor.reference_peak_dn == pytest.approx(peak * 10**0.12, rel=1e-3)


def test_the_plots_of_several_photographs_hold_their_measurements() -> None:
    """Brightness scaled to one exposure, and each star against the mean of its other images."""
    first, second, third = three()
    peak = second.stars.peak_dn.copy()
    peak[4], peak[5] = -1.0, 0.0
    flags = np.arange(24)
    second = with_stars(second, peak_dn=peak, saturated=flags == 6, blended=flags == 8)
    combined = combine((first, second, third))
    axes = Figure().subplots(2, 2)
    _brightness(axes[0, 0], combined)
    lines = axes[0, 0].get_lines()
    assert len(lines) == 4
    for line, part, fainter in zip(lines[:3], combined.parts, combined.fainter_mag, strict=True):
        good = ~part.stars.saturated & ~part.stars.blended & (part.stars.peak_dn > 0)
        x, y = line.get_data()
        np.testing.assert_allclose(x, part.stars.vmag[good], rtol=1e-12)
        scale = 0.5 / part.sensor.reference_exposure_s * 10 ** (0.4 * fainter)
        np.testing.assert_allclose(y, part.stars.peak_dn[good] * scale, rtol=1e-9)
        assert line.get_label() == part.image.path.name
    m, law = lines[3].get_data()
    np.testing.assert_allclose(law, combined.sensor.peak_dn(m, 0.5), rtol=1e-12)
    assert len(axes[0, 0].get_legend().get_texts()) == 4
    _repeatability(axes[0, 1], axes[1, 0], combined)
    table = combined.table
    row = {int(number): k for k, number in enumerate(table.star_id)}
    residuals = []
    for line, part, fainter in zip(axes[0, 1].get_lines()[:3], combined.parts, combined.fainter_mag, strict=True):
        stars, others, own = part.stars, [], []
        for k, number in enumerate(stars.star_id.tolist()):
            seen = number in row and table.images[row[number]] > 1
            if seen and not stars.saturated[k] and not stars.blended[k] and stars.peak_dn[k] > stars.noise_dn[k]:
                exposure_s = part.sensor.reference_exposure_s
                expected = float(combined.sensor.peak_dn(stars.vmag[k], exposure_s))
                own.append(-2.5 * np.log10(stars.peak_dn[k] / expected) - fainter)
                count, mean = table.images[row[number]], table.off_mag[row[number]]
                others.append((count * mean - own[-1]) / (count - 1))
        np.testing.assert_allclose(line.get_data(), [others, own], rtol=0, atol=1e-9)
        residuals += [a - b for a, b in zip(own, others, strict=True)]
    limit = max(0.3, 1.1 * np.abs(table.off_mag).max())
    assert axes[0, 1].get_xlim() == pytest.approx((-limit, limit))
    assert axes[0, 1].get_ylim() == pytest.approx((-1.5 * limit, 1.5 * limit))
    bars = [patch.get_height() for patch in axes[1, 0].patches[:60]]
    edges = np.linspace(-1.5 * limit, 1.5 * limit, 61)
    before = np.concatenate([line.get_data()[1] for line in axes[0, 1].get_lines()[:3]])
    assert bars == np.histogram(before, edges)[0].tolist()
    outline = axes[1, 0].patches[60].get_xy()
    assert outline[:, 1].max() == np.histogram(residuals, edges)[0].max()
    _images(axes[1, 1], combined)
    assert [patch.get_width() for patch in axes[1, 1].patches] == pytest.approx(combined.fainter_mag.tolist())
    limit = 1.2 * np.abs(combined.fainter_mag).max()
    assert axes[1, 1].get_xlim() == pytest.approx((-limit, limit))


@pytest.mark.parametrize(("images", "has_legend"), [(10, True), (11, False)])
def test_ten_photographs_have_a_legend(images: int, has_legend: bool) -> None:
    parts = tuple(handmade(np.zeros(5), name=f"{k}.png") for k in range(images))
    combined = combine(parts)
    axes = Figure().subplots(2, 2)
    _brightness(axes[0, 0], combined)
    assert (axes[0, 0].get_legend() is not None) == has_legend
    # Photographs and stars that are all alike have limits of their own.
    _repeatability(axes[0, 1], axes[1, 0], combined)
    _images(axes[1, 1], combined)
    assert axes[0, 1].get_xlim() == pytest.approx((-0.3, 0.3))
    assert axes[1, 1].get_xlim() == pytest.approx((-0.1, 0.1))
