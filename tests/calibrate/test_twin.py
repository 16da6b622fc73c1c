"""How a twin differs from its photograph, by sums over all pixels, and what is drawn of both."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from glstar.calibrate import twin as module
from glstar.calibrate.identify.platesolution import PlateSolution, sidereal_trails
from glstar.calibrate.inputs import inputs_of
from glstar.calibrate.photo.photograph import Photograph, linearised, recorded_again
from glstar.calibrate.photo.psf import draw_stars
from glstar.calibrate.photo.sky import SkyMap
from glstar.calibrate.twin import (
    Twin,
    TwinFigures,
    TwinResult,
    _clipped_rms,
    _correlation,
    _distance,
    _is_clipped,
    _light_dn,
    _peaks_dn,
    _pointing,
    _profile,
    _relative_error,
    _turning,
    _width,
    compare_twin,
    draw_twin,
    make_twin,
    model_files,
    neighbour_noise_dn,
    render_twin,
)
from glstar.camera.model import Camera
from glstar.config import Config
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from tests.support.starphotos import ALL_STARS

TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
PLAIN = inputs_of(1, fov_deg=40.0, utc="2024-03-10T11:00:05Z", site_deg=(-35.0, 138.0))[0].reference.stars


def test_errors_are_relative_to_the_photograph() -> None:
    assert _relative_error(np.array([3.0, 9.0]), np.array([2.0, 10.0])) == pytest.approx(0.3)
    assert np.isnan(_relative_error(np.zeros(0), np.zeros(0)))


def test_the_distance_of_two_backgrounds_is_that_of_their_distributions() -> None:
    rng = np.random.default_rng(1)
    one, other = rng.integers(10, 30, 400).astype(float), rng.integers(12, 40, 700).astype(float)
    levels = {*one[::20].tolist(), *other[::20].tolist()}
    expected = max(abs((one <= level).mean() - (other <= level).mean()) for level in levels)
    assert _distance(one, other) == pytest.approx(expected, abs=1e-12)
    assert len(levels) < 28
    assert _distance(one, one) == 0


def test_outliers_beyond_four_sigma_are_left_out_five_times() -> None:
    rng = np.random.default_rng(2)
    difference = np.concatenate([rng.normal(0, 2, 3000), [9.0, -9.5, 60, -300, 4000]])
    limit, used = np.inf, np.abs(difference)
    for _ in range(5):
        rms = np.sqrt(np.mean(used[used <= limit] ** 2))
        limit = 4 * rms
    assert _clipped_rms(difference) == pytest.approx(rms, rel=1e-12)
    # One more round would change it: the outliers are left out one after the other.
    slow = np.array([1.0] * 40 + [7.0**k for k in range(1, 9)])
    limit = np.inf
    rounds = []
    for _ in range(6):
        rounds.append(np.sqrt(np.mean(slow[slow <= limit] ** 2)))
        limit = max(4 * rounds[-1], 1.01)
    assert rounds[4] != rounds[5]
    assert _clipped_rms(slow) == pytest.approx(rounds[4], rel=1e-12)
    # Of whole numbers that hardly differ, the single steps are noise.
    steps = np.zeros(1000)
    steps[:20], steps[20] = 3.0, 3.02
    assert _clipped_rms(steps) == pytest.approx(np.sqrt((180 + 3.02**2) / 1000), rel=1e-12)
    steps[20] = 3.04
    assert _clipped_rms(steps) == pytest.approx(np.sqrt(180 / 999), rel=1e-12)


def test_the_noise_is_that_of_differences_at_twelve_levels() -> None:
    rng = np.random.default_rng(3)
    level = rng.permutation(40 * 50).reshape(40, 50) / 10.0
    is_sky = rng.random(level.shape) > 0.1
    images = rng.normal(0, 3, level.shape), rng.normal(0, 5, level.shape)
    pairs = []
    for y in range(40):
        for x in range(50):
            for j, i in ((y + 1, x), (y, x + 1)):
                if j < 40 and i < 50 and is_sky[y, x] and is_sky[j, i]:
                    pairs.append([level[y, x], *(image[y, x] - image[j, i] for image in images)])
    pairs = np.array(sorted(pairs, key=lambda pair: pair[0]))
    found = neighbour_noise_dn(SkyMap(level, level, level, is_sky, 0.1), images)
    expected = [
        [part[:, 0].mean(), *(_clipped_rms(part[:, k]) / 2**0.5 for k in (1, 2))] for part in np.array_split(pairs, 12)
    ]
    # Differences at the same pixel have the same level, in any order.
    np.testing.assert_allclose(found, np.array(expected).T, rtol=0.02)
    np.testing.assert_allclose(found[0], np.array(expected)[:, 0], rtol=2e-3)
    flat = np.ones((20, 40))
    assert neighbour_noise_dn(SkyMap(flat, flat, flat, flat > 0, 0.1), (flat,)).size == 0
    # A level counts if 30 neighbours differ there.
    for count, levels in ((60, 0), (400, 12)):
        image = np.zeros((20, 41))
        image.ravel()[: 2 * count : 2] = 1.0
        rising = np.arange(820.0).reshape(20, 41)
        found = neighbour_noise_dn(SkyMap(rising, rising, rising, rising >= 0, 0.1), (image,))
        assert found.shape[-1] <= max(levels, 3)


def test_neighbours_are_correlated_beyond_pixels_six_px_away() -> None:
    rng = np.random.default_rng(4)
    white = rng.normal(0, 4, (33, 41))
    residual = 1.5 + white + 0.5 * np.roll(white, 1, axis=1) + 0.3 * np.roll(white, 1, axis=0)
    residual[5, 7], residual[20, 30] = 90.0, -70.0
    is_sky = rng.random(residual.shape) > 0.15
    scale = 1.4826 * np.median(np.abs(residual[is_sky]))
    good = is_sky & (np.abs(residual) < 3.5 * scale)
    noise = residual - residual[good].mean()

    def at(lag: int) -> float:
        products = []
        for y in range(33):
            for x in range(41):
                for j, i in ((y + lag, x), (y, x + lag)):
                    if j < 33 and i < 41 and good[y, x] and good[j, i]:
                        products.append(noise[y, x] * noise[j, i])
        return float(np.mean(products))

    expected = (at(1) - at(6)) / np.mean(noise[good] ** 2)
    assert expected > 0.2
    assert _correlation(residual, is_sky) == pytest.approx(expected, rel=1e-9)
    # Residuals within 1.75 DN are noise, however little the others scatter.
    still = np.zeros((20, 20))
    still[::2, ::2], still[3, 3] = 1.74, 1.76
    assert _correlation(still, still > -1) == pytest.approx(
        _correlation(np.where(still == 1.76, 0, still), still < 1.75)
    )
    assert _correlation(np.zeros((9, 9)), np.ones((9, 9), bool)) == 0


IMAGE = np.random.default_rng(5).normal(40, 5, (60, 80))
IMAGE[3, 0] = 70
AT = np.array([[40, 30], [1, 2], [79, 58], [20, 12], [12, 20], [67, 40], [68, 40], [40, 47], [40, 48]])


def test_peaks_and_profiles_are_above_the_median_of_their_surroundings() -> None:
    expected = []
    rows, columns = np.indices(IMAGE.shape)
    for x, y in AT:
        around = np.maximum(np.abs(rows - y), np.abs(columns - x))
        expected.append(IMAGE[around <= 1].max() - np.median(IMAGE[around <= 12]))
    np.testing.assert_allclose(_peaks_dn(IMAGE, AT), expected, rtol=1e-12)
    # Only stars 12 px within the image have a profile.
    profiles = []
    for x, y in AT[[0, 3, 4, 5, 7]]:
        radius = np.rint(np.hypot(rows - y, columns - x))
        box = np.maximum(np.abs(rows - y), np.abs(columns - x)) <= 10
        sky = np.median(IMAGE[np.maximum(np.abs(rows - y), np.abs(columns - x)) <= 12])
        profiles.append([(IMAGE - sky)[box & (radius == r)].mean() for r in range(11)])
    np.testing.assert_allclose(_profile(IMAGE, AT), np.mean(profiles, axis=0), rtol=1e-9, atol=1e-12)
    assert _profile(IMAGE, AT[1:2]).tolist() == [0.0] * 11
    small = np.arange(25.0 * 25).reshape(25, 25)
    assert _profile(small, np.array([[12, 12]])).shape == (11,)
    assert _profile(small, np.array([[12, 12]]))[0] == 0


def calibration_of(image: np.ndarray, **more: object) -> SimpleNamespace:
    photo = Photograph(Path("p.png"), image, 8, "grey", None)
    return SimpleNamespace(**{"image": photo} | more)


def test_a_star_is_clipped_within_three_px() -> None:
    calibration = calibration_of(np.zeros((60, 80)))
    plain, full = np.zeros((60, 80)), np.zeros((60, 80))
    full[20, 30] = 0.98 * 255
    for star, expected in (
        ((33, 23), True),
        ((27, 17), True),
        ((34, 20), False),
        ((30, 24), False),
        ((26, 20), False),
        ((30, 16), False),
    ):
        assert _is_clipped(calibration, (plain, full), np.array(star)) is expected
        assert _is_clipped(calibration, (plain, plain), np.array(star)) is False
    full[20, 30] = 0.979 * 255
    assert not _is_clipped(calibration, (full,), np.array([30, 20]))
    corner = np.zeros((60, 80))
    corner[0, 0] = 255
    assert _is_clipped(calibration, (corner,), np.array([2, 1]))
    assert not _is_clipped(calibration, (corner,), np.array([77, 57]))


@pytest.mark.parametrize("sigma_px", [0.8, 1.4])
def test_widths_are_those_of_fits_with_the_pixel(sigma_px: float) -> None:
    xy = np.array([[20, 15], [55, 40], [30, 42]])
    image = 9 + draw_stars((60, 80), xy + np.array([0.2, -0.3]), np.array([200.0, 500.0, 90.0]), sigma_px)
    detected = SimpleNamespace(background=SimpleNamespace(level_dn=9.0), psf_sigma_px=sigma_px)
    width, count = _width(calibration_of(image, detected=detected), image, xy)
    assert width == pytest.approx(np.sqrt(sigma_px**2 + 1 / 12), rel=2e-3)
    assert count == 3
    assert _width(calibration_of(image, detected=detected), image, xy[:0])[1] == 0
    nothing = _width(calibration_of(image, detected=detected), np.full((60, 80), np.nan), xy[:1])
    assert np.isnan(nothing[0])
    assert nothing[1] == 0


def test_a_camera_at_rest_turns_with_the_earth() -> None:
    sky = Sky(ALL_STARS, ASTROMETRY["paper"])
    utc_s = 1.71e9 + np.array([-30.0, 0.0, 18.0])
    expected = TURN @ sky.C_ned_eq(utc_s, [0.5] * 3, [1.0] * 3)
    found = _turning(expected[1], 60.0, np.array([0.0, 0.5, 0.8]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    over = _pointing(PLAIN, found)
    assert len(over) == 3
    np.testing.assert_allclose(over.zenith_eq, [PLAIN.zenith_eq] * 3, rtol=1e-7)
    np.testing.assert_allclose(over.velocity_eq, [PLAIN.velocity_eq] * 3, rtol=1e-7)
    assert (over.refraction_scale, over.sine_horizon) == (PLAIN.refraction_scale, 0.0)
    anywhere = _pointing(replace(PLAIN, zenith_eq=np.zeros(3)), found)
    np.testing.assert_allclose(anywhere.zenith_eq, found[:, 2], rtol=1e-7)
    # All stars are up, those behind the camera too.
    assert np.isfinite(anywhere.to_camera(-found[0, 2:3])).all()


def test_light_has_the_steps_of_the_file() -> None:
    pixels = np.arange(256, dtype=np.uint16).reshape(8, 32) * 257
    plain = Photograph(Path("p.png"), pixels.astype(float), 16, "grey", None)
    assert _light_dn(plain, pixels).tolist() == pixels.tolist()
    processed = linearised(replace(plain, bit_depth=8, pixels_dn=pixels / 257.0), "srgb")
    light = _light_dn(processed, pixels)
    recorded = recorded_again(processed, pixels)
    assert recorded.dtype == np.uint8
    expected = linearised(replace(plain, bit_depth=8, pixels_dn=recorded.astype(float)), "srgb").pixels_dn
    np.testing.assert_allclose(light, expected, rtol=1e-12)
    assert not np.allclose(light, pixels, rtol=1e-7)


SIZE = (120, 160)
STARS = np.array([[30.0, 30], [80, 30], [130, 30], [30, 80], [80, 80], [130, 80], [60, 105], [110, 105], [150, 15]])
PEAKS = np.array([150.0, 60, 290, 90, 5, 120, 80, 40, 100])


def model_of(image: np.ndarray, **more: object) -> SimpleNamespace:
    level = np.full(SIZE, 20.0) + np.linspace(-3, 3, SIZE[1])
    is_sky = np.ones(SIZE, bool)
    for x, y in STARS.astype(int):
        is_sky[max(y - 9, 0) : y + 10, max(x - 9, 0) : x + 10] = False
    predicted = np.arange(10, 19)
    star = predicted[[8, 0, 1, 2, 3, 4, 5, 7]]
    calibration = calibration_of(
        image,
        matches=SimpleNamespace(predicted=predicted, predicted_xy_px=STARS + 0.2, star=star),
        sensor=SimpleNamespace(
            background_std_dn=lambda exposure_s: 2.0 * exposure_s, reference_exposure_s=1.5, keys={"a": 1.0}
        ),
        detected=SimpleNamespace(background=SimpleNamespace(level_dn=level), psf_sigma_px=1.3),
    )
    sky = SkyMap(level, level, image - level, is_sky, 0.1)
    return SimpleNamespace(**{"calibration": calibration, "sky": sky} | more)


def drawn(peak: np.ndarray, sigma_px: float, noise_dn: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(20, noise_dn, SIZE)
    return np.rint(np.clip(draw_stars(SIZE, STARS, peak, sigma_px) + noise, 0, 255))


def pair() -> tuple[SimpleNamespace, Twin, list[np.ndarray]]:
    real = drawn(PEAKS, 1.3, 2.0, 1)
    images = [drawn(PEAKS * 0.9, 1.5, 2.4, 2), drawn(PEAKS * 0.9, 1.5, 2.4, 3), drawn(PEAKS * 0.7, 1.5, 2.4, 4)]
    images[0][79:82, 79:82] += 40  # bright in the twin only
    images[0][27, 82] = 251  # clipped in the twin only: no width, but a peak
    model = model_of(real)
    return model, compare_twin(model, *(one.astype(np.uint8) for one in images)), images


def test_a_twin_is_compared_at_its_bright_unclipped_stars() -> None:
    model, twin, (one, again, plain) = pair()
    real, sky = model.calibration.image.pixels_dn, model.sky
    figures = twin.figures
    at = STARS[[0, 1, 2, 3, 4, 5, 7, 8]].astype(int)
    peaks = [_peaks_dn(image, at) for image in (real, one, again, plain)]
    # Three times the noise of 3 DN, and the star of 240 DN is clipped.
    good = [0, 1, 3, 5, 6, 7]
    assert (peaks[0][4] < 9, figures.stars) == (True, 6)
    p = [one[good] for one in peaks]
    assert figures.peak_error == pytest.approx(np.mean(np.abs(p[1] / p[0] - 1)))
    assert figures.catalogue_peak_error == pytest.approx(np.mean(np.abs(p[3] / p[0] - 1)))
    assert figures.peak_noise == pytest.approx(np.mean(np.abs(p[2] / p[1] - 1)))
    np.testing.assert_allclose(twin.peaks_dn, p[:2], rtol=1e-7)
    order = np.argsort(-p[0])
    whole = at[good][order][[k != 1 for k in order]]
    widths = [_width(model.calibration, image, whole)[0] for image in (real, one)]
    assert figures.width_ratio == pytest.approx(widths[1] / widths[0], rel=1e-9)
    assert 1.05 < figures.width_ratio < 1.3
    assert figures.width_stars == 5
    profiles = [_profile(image, at[good]) for image in (real, one)]
    np.testing.assert_allclose(twin.profiles_dn, profiles, rtol=1e-9)
    assert figures.profile_error == pytest.approx(np.abs(profiles[1] - profiles[0]).max() / profiles[0].max())
    noise = neighbour_noise_dn(sky, (real, one))
    np.testing.assert_allclose(twin.noise_dn, noise, rtol=1e-7)
    assert figures.noise_error == pytest.approx(np.sqrt(np.mean((noise[2] / noise[1] - 1) ** 2)))
    assert figures.sky_ks == _distance(real[sky.is_sky], one[sky.is_sky])
    assert figures.neighbour_correlation == _correlation(real - sky.level_dn, sky.is_sky)
    assert figures.twin_neighbour_correlation == _correlation(one - sky.level_dn, sky.is_sky)
    assert twin.pixels.dtype == np.uint8


def test_a_twin_without_stars_and_noise_has_no_figures_of_both() -> None:
    flat = np.full(SIZE, 20.0)
    twin = compare_twin(model_of(flat), *(flat.astype(np.uint8),) * 3)
    figures = twin.figures
    assert (figures.noise_error, figures.stars, figures.width_stars, figures.sky_ks) == (None, 0, 0, 0.0)
    numbers = figures.to_json()
    assert [name for name, value in numbers.items() if value is None] == [
        *("noise_error", "peak_error", "catalogue_peak_error", "peak_noise", "width_ratio", "profile_error")
    ]
    assert set(numbers) == set(TwinFigures.__dataclass_fields__)
    assert twin.noise_dn.size == 0


def test_sixty_widths_and_ten_profiles_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    counts: dict[str, list[int]] = {"width": [], "profile": []}

    def counted(name: str, result: object):
        def count(*arguments):
            counts[name].append(len(arguments[-1]))
            assert arguments[-1][0].tolist() == [69, 50]  # the brightest
            return result

        return count

    monkeypatch.setattr(module, "_width", counted("width", (1.0, 5)))
    monkeypatch.setattr(module, "_profile", counted("profile", np.ones(11)))
    monkeypatch.setattr(module, "_peaks_dn", lambda image, at: np.linspace(50, 90, len(at)))
    model = model_of(np.full(SIZE, 20.0))
    model.calibration.matches = SimpleNamespace(
        predicted=np.arange(70),
        star=np.arange(70),
        predicted_xy_px=np.column_stack([np.arange(70.0), np.full(70, 50.0)]),
    )
    compare_twin(model, *(np.full(SIZE, 20, np.uint8),) * 3)
    assert counts == {"width": [60, 60], "profile": [10, 10]}


def test_files_of_a_twin_are_its_numbers_its_image_and_the_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    model, twin, _ = pair()
    calibration = SimpleNamespace(to_json=lambda: {"sensor": 1, "camera": 2}, image=model.calibration.image)
    fitted = SimpleNamespace(calibration=model.calibration, to_json=lambda: {"b": 3})
    monkeypatch.setattr(module, "draw_twin", lambda *arguments: b"pair" if arguments == (fitted, twin) else b"")
    result = TwinResult(calibration, fitted, twin)
    files = result.files("night")
    assert set(files) == {"night.json", "night.twin.png", "night.pair.png"}
    assert files["night.pair.png"] == b"pair"
    assert files["night.twin.png"].startswith(b"\x89PNG")
    numbers = {"sensor": {"a": 1.0}, "camera": 2, "photograph": {"b": 3}, "twin": twin.figures.to_json()}
    assert json.loads(files["night.json"]) == numbers
    assert files["night.json"].startswith(b'{\n "sensor": {\n  "a": 1.0')


@pytest.mark.parametrize("has_maps", [False, True])
def test_files_of_a_model_are_those_that_its_config_names(has_maps: bool) -> None:
    model = SimpleNamespace(
        brightness=SimpleNamespace(to_csv=lambda: "a,b\n"),
        has_map=has_maps,
        sky_texels=np.ones((3, 4), np.float32),
        dark_frame=np.ones((3, 4), np.uint8) if has_maps else None,
        to_toml=lambda *names: "\n".join(names),
    )
    files = model_files(model, "night")
    maps = {"night.sky.tiff", "night.hot.tiff"} if has_maps else set()
    assert set(files) == {"night.brightness.csv", "night.toml"} | maps
    assert files["night.brightness.csv"] == b"a,b\n"
    assert files["night.toml"] == b"night.sky.tiff\nnight.hot.tiff\nnight.brightness.csv"


CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)


def rendering(monkeypatch: pytest.MonkeyPatch, *, moved: bool, mirrored: bool) -> tuple:
    """Return a model, its config and a renderer that keeps what it draws."""
    settings = Config().override(**{"sensor.reference_peak_dn": 80.0})
    solution = PlateSolution(CAMERA, np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]) @ PLAIN.C_ned_eq, mirrored)
    index, xy = solution.stars_on_image(PLAIN)
    matches = SimpleNamespace(solution=solution, predicted=index[::-1], predicted_xy_px=xy[::-1])
    sensor = SimpleNamespace(reference_exposure_s=40.0)
    model = SimpleNamespace(calibration=SimpleNamespace(matches=matches, reference=PLAIN, sensor=sensor), moved=moved)
    brighter = SimpleNamespace(applied=lambda stars: replace(stars, measured_mag=stars.vmag - 1.0))
    config = SimpleNamespace(sensor=settings.sensor, camera=lambda: CAMERA, star_brightness=lambda: brighter)
    drawn = []

    def render(scene, *, seed):
        drawn.append((scene, seed))
        return SimpleNamespace(pixels=np.arange(160 * 120, dtype=np.uint16).reshape(120, 160))

    return model, config, SimpleNamespace(render=render), drawn


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_twin_is_drawn_with_the_stars_of_the_photograph(mirrored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, config, renderer, drawn = rendering(monkeypatch, moved=False, mirrored=mirrored)
    pixels = render_twin(model, config, renderer)
    expected = np.arange(160 * 120).reshape(120, 160)
    assert pixels.tolist() == (expected[:, ::-1] if mirrored else expected).tolist()
    [(scene, seed)] = drawn
    matches = model.calibration.matches
    shown = np.sort(matches.predicted)
    assert (seed, len(shown) > 5) == (1, True)
    np.testing.assert_array_equal(scene.draw_list.index, shown)
    peak = config.sensor().peak_dn(PLAIN.stars.vmag[shown] - 1.0, 40.0)
    np.testing.assert_allclose(
        scene.draw_list.truncation_radius_px, config.sensor().truncation_radius_px(peak), rtol=1e-5
    )
    assert (scene.camera, scene.exposure.duration_s, scene.exposure.trail) == (CAMERA, 40.0, "sprites")
    assert len(scene.trails) == 1
    # Without trails the camera does not turn.
    np.testing.assert_allclose(scene.shutter.C_camera_eq, [matches.solution.C_camera_eq] * 3, rtol=0, atol=1e-12)
    assert scene.C_camera_body.tolist() == np.eye(3).tolist()
    assert scene.q_body_ned.tolist() == [1, 0, 0, 0]
    render_twin(model, config, renderer, seed=5, catalogue_brightness=True)
    scene, seed = drawn[1]
    fainter = config.sensor().peak_dn(PLAIN.stars.vmag[shown], 40.0)
    np.testing.assert_allclose(
        scene.draw_list.truncation_radius_px, config.sensor().truncation_radius_px(fainter), rtol=1e-5
    )
    assert seed == 5


def test_a_moving_sky_is_drawn_in_steps_of_a_quarter_of_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    model, config, renderer, drawn = rendering(monkeypatch, moved=True, mirrored=False)
    render_twin(model, config, renderer)
    [(scene, _)] = drawn
    matches = model.calibration.matches
    longest = np.linalg.norm(sidereal_trails(matches.solution, matches.predicted_xy_px, 40.0), axis=1).max()
    count = 1 + 2 * int(np.ceil(longest / 0.5))
    assert (len(scene.trails), longest > 0.3) == (count, True)
    peak = config.sensor().peak_dn(PLAIN.stars.vmag[np.sort(matches.predicted)] - 1.0, 40.0)
    expected = config.sensor().truncation_radius_px(peak) + longest / 2
    np.testing.assert_allclose(scene.draw_list.truncation_radius_px, expected, rtol=1e-5)
    ends = _turning(matches.solution.C_camera_eq, 40.0, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(scene.shutter.C_camera_eq, ends, rtol=0, atol=1e-12)
    middles = _turning(matches.solution.C_camera_eq, 40.0, (np.arange(count) + 0.5) / count)
    np.testing.assert_allclose(scene.trails.pointing.C_camera_eq, middles, rtol=0, atol=1e-12)


def test_three_twins_are_made_of_a_photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    import glstar.render.opengl as opengl  # noqa: PLC0415

    asked = []

    class Headless:
        def __enter__(self) -> str:
            return "renderer"

        def __exit__(self, *_: object) -> None:
            asked.append("closed")

    monkeypatch.setattr(opengl, "GLRenderer", SimpleNamespace(headless=Headless))
    monkeypatch.setattr(module, "render_twin", lambda *arguments, **more: asked.append((arguments, more)) or len(asked))
    monkeypatch.setattr(module, "compare_twin", lambda *arguments: arguments)
    real = pair_calibration()
    model = SimpleNamespace(calibration=replace(real, notes=("of the model",)))
    result = make_twin(real, model, "config")
    usual = (model, "config", "renderer")
    assert asked == [(usual, {}), (usual, {"seed": 2}), (usual, {"catalogue_brightness": True}), "closed"]
    assert result.twin == (model, 1, 2, 3)
    assert result.calibration.notes == ("of the model",)
    assert result.model is model


def pair_calibration():
    from dataclasses import dataclass  # noqa: PLC0415

    @dataclass(frozen=True)
    class Notes:
        notes: tuple[str, ...]

    return Notes(())


def corners(inset) -> list[float]:
    x, y, width, height = inset.get_axes_locator()(inset, None).bounds
    return [x, y, x + width, y + height]


def test_details_are_from_the_middle_and_wide_histograms_have_a_hundred_bars() -> None:
    axes = Figure().subplots(1, 3)
    image = np.random.default_rng(1).normal(200, 90, (300, 260))
    level = np.full(image.shape, 7.0)
    model = SimpleNamespace(sky=SkyMap(level, level, np.zeros_like(level), level > 0, 0.1))
    module._draw_detail(axes[0], model, image)
    [inset] = axes[0].child_axes
    np.testing.assert_array_equal(inset.images[0].get_array(), image[40:260, 20:240])
    # Without noise, of half a DN.
    assert inset.images[0].get_clim() == (5.5, 13.0)
    module._draw_sky(axes[1], model, (image, image))
    low, high = np.quantile(image, (0.0005, 0.9995))
    edges = [patch.get_x() for patch in axes[1].patches if hasattr(patch, "get_x")]
    np.testing.assert_allclose(np.diff(edges), np.ceil((high - low) / 100), rtol=1e-7)
    twin = SimpleNamespace(peaks_dn=np.array([[3.0, 20.0, -4.0], [0.0, 15.0, 5.0]]))
    module._draw_peaks(axes[2], twin)
    assert axes[2].lines[0].get_xydata().tolist() == [[3.0, 1e-3], [20.0, 15.0], [1e-3, 5.0]]


def test_photograph_and_twin_are_drawn_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    model, twin, _ = pair()
    figures = []

    def kept(figure, target, **options):
        figures.append((figure, options))
        target.write(b"drawn")

    monkeypatch.setattr(Figure, "savefig", kept)
    assert draw_twin(model, twin) == b"drawn"
    [(figure, options)] = figures
    assert (options["dpi"], options["format"], options["metadata"]) == (110, "png", {"Software": "glstar"})
    left, right, sky, noise, profiles, peaks = figure.axes
    assert figure.get_size_inches().tolist() == [15, 11]
    real = model.calibration.image.pixels_dn
    low, high = np.quantile(real, (0.001, 0.9995))
    for axes, image, name in ((left, real, "p.png"), (right, twin.pixels, "its twin")):
        np.testing.assert_allclose(
            axes.images[0].get_array(), np.clip((image - low) / (high - low), 0, 1) ** 0.6, rtol=1e-7
        )
        assert (axes.get_title(), axes.images[0].get_clim()) == (name, (0, 1))
        [inset] = axes.child_axes
        # Of 120 x 160 px the middle 120 px, from 3 noises below the sky to 12 above it.
        np.testing.assert_array_equal(inset.images[0].get_array(), image[:, 20:140])
        noise_dn = 1.4826 * np.median(np.abs(model.sky.residual_dn[:, 20:140]))
        level_dn = np.median(model.sky.level_dn[:, 20:140])
        assert inset.images[0].get_clim() == pytest.approx((level_dn - 3 * noise_dn, level_dn + 12 * noise_dn))
        # A square in the lower right corner, on a picture of this shape.
        around = axes.get_position().bounds
        across = [
            (one - at) / side for one, at, side in zip(corners(inset), around[:2] * 2, around[2:] * 2, strict=True)
        ]
        assert across == pytest.approx([0.62, 0.0, 1.0, 0.38 * 160 / 120])
    places = [(one.get_subplotspec().rowspan, one.get_subplotspec().colspan) for one in figure.axes]
    assert places == [
        (range(1), range(2)),
        (range(1), range(2, 4)),
        *((range(1, 2), range(k, k + 1)) for k in range(4)),
    ]
    values = real[model.sky.is_sky]
    ends = np.quantile(values, (0.0005, 0.9995))
    assert len(sky.patches) > 10
    edges = np.array([patch.get_x() for patch in sky.patches if hasattr(patch, "get_x")])
    assert edges[0] == np.floor(ends[0]) - 0.5
    heights = [patch.get_height() for patch in sky.patches if hasattr(patch, "get_height")]
    assert heights == np.histogram(values, [*edges, edges[-1] + 1])[0].tolist()
    assert np.diff(edges).tolist() == pytest.approx([1.0] * (len(edges) - 1))
    assert edges[-1] + 1 == pytest.approx(np.arange(edges[0], ends[1] + 1, 1.0)[-1])
    np.testing.assert_allclose(
        [line.get_xydata().T for line in noise.lines], [twin.noise_dn[[0, k]] for k in (1, 2)], rtol=1e-7
    )
    assert noise.get_ylim()[0] == 0
    shown = [line.get_ydata() for line in profiles.lines]
    np.testing.assert_allclose(shown, np.maximum(twin.profiles_dn, 1e-3 * twin.profiles_dn.max()), rtol=1e-7)
    points, diagonal = peaks.lines
    np.testing.assert_allclose(points.get_xydata().T, np.maximum(twin.peaks_dn, 1e-3), rtol=1e-7)
    limits = [twin.peaks_dn[0].min(), twin.peaks_dn[0].max()]
    assert diagonal.get_xydata().tolist() == [[limits[0]] * 2, [limits[1]] * 2]
    assert (peaks.get_xscale(), peaks.get_yscale(), profiles.get_yscale()) == ("log",) * 3
    of_twin = twin.figures
    assert f"{100 * of_twin.peak_error:.0f} % off" in figure._suptitle.get_text()
    assert {text.get_text() for axes in (sky, noise, profiles) for text in axes.get_legend().get_texts()} == {
        *("photograph", "twin")
    }
