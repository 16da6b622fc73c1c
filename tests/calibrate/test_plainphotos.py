"""Calibration from images rendered with NumPy and OpenCV: hazy wide fields, and all-sky fisheyes."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.calibrate.geometry.lensfit import fit_lens
from glstar.calibrate.identify import lost
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, nominal_camera, sidereal_trails
from glstar.calibrate.photo.detection import DetectedStars, detect_stars
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from tests.support.plainphotos import (
    REFERENCE,
    PlainPhoto,
    all_sky,
    barrel,
    equidistant,
    focal_px,
    hazy,
    narrow,
    pinhole_camera,
)
from tests.support.starphotos import ALL_STARS

pytest.importorskip("tetra3rs")
pytestmark = pytest.mark.usefixtures("kept_patterns")
# True focal length of the all-sky lens, px: r = f theta, and the circle ends 4 px inside the image.
ALL_SKY_F_PX = 496 / (np.pi / 2)


def recognised(photo: PlainPhoto, fov_deg: float) -> tuple[DetectedStars, Matches]:
    detected = detect_stars(photo.image)
    return detected, identify_lost(detected, REFERENCE, ALL_STARS, pinhole_camera(photo, fov_deg))


@cache
def whole_sky() -> tuple[PlainPhoto, DetectedStars, Matches]:
    photo = all_sky()
    return photo, *recognised(photo, 140)


class Recorder:
    """Patterns that record what they are searched for."""

    def __init__(self, solution=None):
        self.searches, self.solution = [], solution

    def solve_from_centroids(self, stars, **options):
        self.searches.append((stars.copy(), options))
        return self.solution


def detections(xy_px, peak_dn) -> DetectedStars:
    count = len(xy_px)
    few = detect_stars(narrow(1, fov_deg=10.0, limit_vmag=7.0, peak_snr=20.0, uncatalogued=10).image)
    ones = np.ones(count)
    return replace(few, xy_px=xy_px, peak_dn=peak_dn, sigma_px=ones, noise_dn=ones, saturated=ones > 0)


def searches(monkeypatch, detected: DetectedStars, camera: Camera, solution=None) -> tuple[list, list[PlateSolution]]:
    """Return the searches for patterns, and the plate solutions that follow from their answer."""
    recorder = Recorder(solution)
    monkeypatch.setattr(lost, "pattern_database", lambda *_: recorder)
    solutions = list(lost._recognised(detected, REFERENCE, ALL_STARS, camera, 1e-3))
    return recorder.searches, solutions


@pytest.mark.parametrize(("count", "counts"), [(300, [200, 60, 25, 12, 6]), (25, [25, 12, 6]), (6, [6])])
def test_patterns_of_the_brightest_are_searched_around_the_middle_of_the_image(monkeypatch, count, counts) -> None:
    rng = np.random.default_rng(2)
    xy_px = rng.uniform([0, 0], [1199, 799], (count, 2))
    # The amplitudes of saturated stars are lower limits.
    peak_dn = np.sort(rng.uniform(10, 200, count))[::-1] * np.where(np.arange(count) < 3, 0.5, 1.0)
    asked, solutions = searches(
        monkeypatch, detections(xy_px, peak_dn), Camera(1200, 800, 1500.0, 1500.0, 599.5, 399.5)
    )
    assert [len(stars) for stars, _ in asked] == counts
    assert not solutions
    for stars, options in asked:
        # Pixel (0, 0) is the centre of the top-left pixel of 1200 columns and 800 rows.
        np.testing.assert_allclose(stars[:, :2], xy_px[: len(stars)] - [599.5, 399.5], rtol=0, atol=1e-9)
        expected = [peak_dn[k:].max() for k in range(len(stars))]
        np.testing.assert_allclose(stars[:, 2], expected, rtol=0, atol=1e-12)
        assert options["fov_estimate_rad"] == pytest.approx(2 * np.arctan2(600, 1500), rel=1e-12)
        assert options["fov_max_error_rad"] == pytest.approx(0.15 * 2 * np.arctan2(600, 1500), rel=1e-12)
        assert options["image_shape"] == (800, 1200)
        assert options["match_threshold"] == 1e-3


def test_with_a_lens_patterns_are_searched_in_its_undistorted_middle(monkeypatch) -> None:
    f_px, centre_px = 400.0, np.array([601.0, 402.0])
    fisheye = Camera(1200, 800, f_px, f_px, *centre_px, lens=Lens("fisheye", (0.0, 0.0, 0.0, 0.0)))
    rng = np.random.default_rng(3)
    theta, phi = np.sqrt(rng.uniform(0, 1, 400)) * 1.4, rng.uniform(0, 2 * np.pi, 400)
    across = np.column_stack([np.cos(phi), np.sin(phi)])
    xy_px = centre_px + f_px * theta[:, np.newaxis] * across  # r = f theta
    asked, _ = searches(monkeypatch, detections(xy_px, np.arange(400.0, 0.0, -1.0)), fisheye)
    half = f_px * np.tan(np.deg2rad(20.0)) * np.array([1.0, 800 / 1200])
    pinhole = f_px * np.tan(theta)[:, np.newaxis] * across
    expected = pinhole[(np.abs(pinhole) < half).all(axis=1)]
    assert 15 < len(expected) < 60
    np.testing.assert_allclose(asked[0][0][:, :2], expected, rtol=0, atol=1e-6)
    assert asked[0][1]["fov_estimate_rad"] == pytest.approx(np.deg2rad(40.0), rel=1e-9)
    assert asked[0][1]["image_shape"] == (round(2 * half[1]), round(2 * half[0]))


def test_too_few_stars_in_the_middle_of_a_lens_are_not_searched(monkeypatch) -> None:
    fisheye = Camera(1200, 800, 400.0, 400.0, 599.5, 399.5, lens=Lens("fisheye", (0.0, 0.0, 0.0, 0.0)))
    xy_px = np.array([[600.0 + 10 * k, 400.0] for k in range(3)] + [[1150.0, 20.0 * k] for k in range(20)])
    assert searches(monkeypatch, detections(xy_px, np.arange(23.0, 0.0, -1.0)), fisheye) == ([], [])


def test_a_recognised_pattern_gives_the_focal_length_of_its_field_of_view(monkeypatch) -> None:
    turn = Rotation.random(random_state=np.random.default_rng(4)).as_matrix()
    answer = SimpleNamespace(fov_deg=44.0, rotation_matrix_icrs_to_camera=turn, parity_flip=True)
    camera = Camera(1200, 800, 1500.0, 1480.0, 599.5, 399.5)
    xy_px = np.random.default_rng(5).uniform([0, 0], [1199, 799], (8, 2))
    _, (found, *others) = searches(monkeypatch, detections(xy_px, np.arange(8.0, 0.0, -1.0)), camera, answer)
    assert len(others) == 1  # eight stars, and six of them
    assert np.rad2deg(2 * np.arctan(600 / found.camera.fx_px)) == pytest.approx(44.0, rel=1e-12)
    assert found.camera.fy_px / found.camera.fx_px == pytest.approx(1480 / 1500, rel=1e-12)
    assert found.mirrored
    # A direction in the ICRS is turned to the equator of date, and to the camera.
    icrs = np.array([0.6, 0.0, 0.8])
    of_date = REFERENCE.stars.C_eq_icrs @ icrs
    np.testing.assert_allclose(found.C_camera_eq @ of_date, turn @ icrs, rtol=0, atol=1e-12)


# Without the test of significance, 15, 24, 18 and 3 stars of the first four are misidentified by more than 3 px; the
# last two are rejected if all catalogue stars are matched in a wide circle.
@pytest.mark.parametrize("seed", [3, 17, 38, 39, 4, 6])
def test_no_star_of_a_hazy_image_is_misidentified(seed: int) -> None:
    photo = hazy(seed, limit_vmag=5.5, false_stars=4000)
    detected, found = recognised(photo, 50)

    matches = fit_lens(detected, REFERENCE, found)

    assert len(matches) > 25
    assert (photo.off_px(matches) > 3).sum() == 0
    assert matches.rms_px < 0.8
    assert matches.expected_by_chance <= 0.5
    assert matches.solution.camera.fx_px == pytest.approx(focal_px(photo), rel=0.0015)


@pytest.mark.parametrize("seed", [20, 24, 27])
def test_ten_bright_stars_among_two_hundred_false_ones_are_recognised(seed: int) -> None:
    # False detections hide the pattern of all detections, but not that of the brightest.
    photo = hazy(seed, limit_vmag=4.5, false_stars=1000)
    detected, found = recognised(photo, 50)

    matches = fit_lens(detected, REFERENCE, found)

    assert len(matches) >= 8
    assert len(detected) > 8 * len(matches)
    assert (photo.off_px(matches) > 3).sum() == 0
    assert matches.solution.camera.fx_px == pytest.approx(focal_px(photo), rel=0.003)


def test_an_all_sky_image_gets_a_fisheye_and_no_pinhole() -> None:
    photo, detected, found = whole_sky()

    matches = fit_lens(detected, REFERENCE, found)

    camera = matches.solution.camera
    assert camera.lens is not None
    assert camera.lens.model == "fisheye"
    assert camera.fx_px == pytest.approx(ALL_SKY_F_PX, rel=2e-4)
    assert len(matches) > 800
    assert np.median(np.linalg.norm(matches.residual_px, axis=1)) < 0.36  # px
    assert (photo.off_px(matches) > 3).mean() < 0.005
    assert np.rad2deg(camera.limit_rad) == pytest.approx(90, abs=0.5)  # where stars end
    assert np.rad2deg(camera.horizontal_field_rad) == pytest.approx(180, abs=1)


@pytest.mark.parametrize(("across_deg", "fov_deg"), [(200.0, 185.0), (220.0, 230.0)])
def test_an_image_of_more_than_a_hemisphere_is_solved_beyond_90_deg(across_deg: float, fov_deg: float) -> None:
    photo = all_sky(across_deg=across_deg)
    detected = detect_stars(photo.image)
    height, width = photo.image.pixels_dn.shape
    nominal = nominal_camera(width, height, np.deg2rad(fov_deg))

    matches = fit_lens(detected, REFERENCE, identify_lost(detected, REFERENCE, ALL_STARS, nominal))

    camera = matches.solution.camera
    assert camera.lens is not None
    assert camera.lens.model == "fisheye"
    assert camera.fx_px == pytest.approx(496 / np.deg2rad(across_deg / 2), rel=2e-4)
    assert np.rad2deg(camera.limit_rad) == pytest.approx(across_deg / 2, abs=0.5)  # where stars end
    assert len(matches) > 900
    off_px = np.nan_to_num(photo.off_px(matches), nan=np.inf)  # NaN: outside the image circle
    assert (off_px > 3).mean() < 0.005
    behind = REFERENCE.stars.direction_eq[matches.star] @ photo.C_camera_eq[2] < 0
    assert behind.sum() > 150
    assert np.median(off_px[behind]) < 0.1


@pytest.mark.parametrize("lens", ["none", "plumb_bob", "rational"])
def test_a_lens_that_leaves_stars_far_off_is_refused_with_the_distance(lens) -> None:
    _, detected, found = whole_sky()
    with pytest.raises(
        CalibrationError, match=r"px rms.*this is not the camera's lens; use --lens auto|no .* stars, up to \d+ deg off"
    ) as caught:
        fit_lens(detected, REFERENCE, found, lens=lens)
    assert caught.value.stars_used is not None


@pytest.mark.parametrize("fov_deg", [160, 180])
def test_an_all_sky_image_is_recognised_at_a_nominal_field_of_view(fov_deg: float) -> None:
    photo, detected, _ = whole_sky()
    found = identify_lost(detected, REFERENCE, ALL_STARS, pinhole_camera(photo, fov_deg))
    assert found.solution.camera.fx_px == pytest.approx(ALL_SKY_F_PX, rel=2e-3)
    assert len(found) > 800


def test_residuals_of_few_stars_are_compared_with_their_noise() -> None:
    _, detected, found = whole_sky()
    few = slice(0, 8)
    xy_px = detected.xy_px + np.random.default_rng(1).normal(0, 6.0, detected.xy_px.shape)
    residual_px = found.residual_px + (xy_px - detected.xy_px)[found.detection]
    detected = replace(detected, xy_px=xy_px)
    found = replace(found, star=found.star[few], detection=found.detection[few], residual_px=residual_px[few])
    with pytest.raises(CalibrationError, match="this is not the camera's lens"):
        fit_lens(detected, REFERENCE, found)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    ("lens", "projection"),
    [
        (Lens("fisheye", ()), equidistant(300.0, 499.5, 499.5)),
        (Lens("plumb_bob", (-0.2, 0.03)), barrel(900.0, 499.5, 499.5, -0.2, 0.03, 0.0, 0.0)),
    ],
    ids=["fisheye", "barrel"],
)
def test_sidereal_trails_follow_the_lens_distortion(lens: Lens, projection, mirrored: bool) -> None:
    f_px = focal_px(PlainPhoto(whole_sky()[0].image, projection, np.eye(3)))
    C = Rotation.random(random_state=5).as_matrix()
    solution = PlateSolution(Camera(1000, 1000, f_px, f_px, 499.5, 499.5, 0.0, lens), C, mirrored)
    exposure_s = 60.0
    # The sky rotates about the pole of the true equator, from east to west; the stars' directions are those of
    # mid-exposure.
    turn_rad = 2 * np.pi / 86164.0905 * exposure_s / 2
    direction = REFERENCE.stars.direction_eq[REFERENCE.stars.vmag < 5]
    paths = [Rotation.from_rotvec([0, 0, -sign * turn_rad]).apply(direction) @ C.T for sign in (-1, 0, 1)]
    before, middle, after = (projection(path) for path in paths)
    inside = (np.linalg.norm(middle - 499.5, axis=1) < 440) & (paths[1][:, 2] > 0.05)
    expected = (after - before)[inside]
    xy_px = middle[inside]
    if mirrored:
        xy_px, expected = np.column_stack([999 - xy_px[:, 0], xy_px[:, 1]]), expected * [-1, 1]

    found = sidereal_trails(solution, xy_px, exposure_s)

    assert np.linalg.norm(expected, axis=1).max() > 1.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.002)  # px


def test_a_camera_without_a_lens_keeps_its_field_of_view() -> None:
    assert Camera(800, 600, 400.0, 400.0, 399.5, 299.5).horizontal_field_rad == pytest.approx(np.pi / 2)


BESIDE_A_TREE = {"fov_deg": 10.0, "limit_vmag": 7.0, "peak_snr": 14.0, "uncatalogued": 1, "tree": 0.3}
FEW_STARS = {"fov_deg": 6.0, "limit_vmag": 8.5, "peak_snr": 5.0, "uncatalogued": 5}


# The last two have five catalogue stars in clear view, and as many or five times as many others.
@pytest.mark.parametrize(
    ("seed", "given", "least"),
    [(14, BESIDE_A_TREE, 9), (10, FEW_STARS, 5), (4, BESIDE_A_TREE, 5), (2, FEW_STARS, 5)],
)
def test_few_stars_beside_a_tree_and_in_a_narrow_view_are_recognised(seed, given, least) -> None:
    photo = narrow(seed, **given)
    camera = pinhole_camera(photo, 1.04 * given["fov_deg"])
    matches = identify_lost(detect_stars(photo.image), REFERENCE, ALL_STARS, camera)
    assert len(matches) >= least
    assert photo.off_px(matches).max() < 2


@pytest.mark.parametrize("given", [BESIDE_A_TREE, FEW_STARS])
def test_random_stars_beside_a_tree_and_in_a_narrow_view_are_refused(given) -> None:
    photo = narrow(3, **given, is_decoy=True)
    with pytest.raises(CalibrationError):
        identify_lost(detect_stars(photo.image), REFERENCE, ALL_STARS, pinhole_camera(photo, given["fov_deg"]))


@pytest.mark.parametrize(
    ("seed", "given", "few"),
    [
        (3, BESIDE_A_TREE, r"has \d+ stars in such a view between crowded parts on average"),
        (0, FEW_STARS, "has 6 stars in such a view on average, and five must be among the brightest"),
    ],
)
def test_a_view_of_few_catalogue_stars_is_refused_with_their_number(seed, given, few) -> None:
    photo = narrow(seed, **given)
    with pytest.raises(CalibrationError, match=few) as refusal:
        identify_lost(detect_stars(photo.image), REFERENCE, ALL_STARS, pinhole_camera(photo, given["fov_deg"]))
    assert "try a deeper one (sky.catalogue)" in str(refusal.value)


def test_round_stars_above_a_bright_edge_are_no_trails() -> None:
    rng = np.random.default_rng(1)
    pixels = 30 + rng.normal(0, 2, (480, 640))
    rows, columns = np.indices(pixels.shape)
    for x, y in rng.uniform(40, 300, (8, 2)):
        pixels += 60 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.3**2))
    # A fence: all its parts are elongated alike, and it has more peaks than there are stars.
    for x in range(40, 620, 40):
        pixels += 150 * np.exp(-((columns - x) ** 2) / (2 * 12.0**2) - (rows - 420) ** 2 / (2 * 1.2**2))
    image = Photograph(Path("fence.png"), np.floor(np.clip(pixels, 0, 255) + 0.5), 8, "grey", 1.0)
    found = detect_stars(image)
    assert found.drawn_out_px == 0
    assert found.quality_note == ""
