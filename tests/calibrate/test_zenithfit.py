"""The zenith of photographs without time and site, from the refraction of their stars."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.calibrate.geometry.lenschoice import LensCandidate, simple_lens
from glstar.calibrate.geometry.lensfit import fit_camera
from glstar.calibrate.geometry.zenith import _RefractedStars, find_zenith
from glstar.calibrate.identify.leastsquares import _SOFT_NOISE, IdentifiedStars
from glstar.calibrate.identify.platesolution import ReferenceStars
from glstar.camera.distortion import Lens
from tests.calibrate.test_lensfit import Detected, Photo
from tests.support.scenes import NIGHT_UTC_S

WEAK = Lens("plumb_bob", (-0.04, 0.05))
DECENTRED = Lens("plumb_bob", (-0.04, 0.05, 6e-4, -4e-4))
# 70 deg from the zenith, 30 deg wide.
LOW = {"f_px": 2400.0, "vmag_limit": 7.0, "pitch_rad": np.deg2rad(70.0)}


def anywhere(photo: Photo) -> ReferenceStars:
    """Return the reference stars of somebody who knows neither time nor site."""
    return ReferenceStars.anywhere(photo.sky, NIGHT_UTC_S)


def zenith_of(photo: Photo, scale: float = 1.0) -> ReferenceStars:
    return find_zenith(photo.detected, anywhere(photo), photo.matches, refraction_scale=scale)


def without_refraction(photo: Photo, scatter_px: float, seed: int) -> Photo:
    """Replace the positions by those of a sky without air."""
    xy = photo.camera.project(anywhere(photo).to_camera(photo.C_camera_eq)[photo.on_image])
    photo.detected = Detected(xy + np.random.default_rng(seed).normal(0, scatter_px, xy.shape))
    return photo


def off_rad(photo: Photo, found: ReferenceStars) -> float:
    return float(np.arccos(np.clip(found.zenith_eq @ photo.reference.zenith_eq, -1, 1)))


def test_the_zenith_is_found_within_its_error_or_not_at_all() -> None:
    """Views of 26 to 50 deg, 10 to 75 deg from the zenith, with three lenses."""
    rng = np.random.default_rng(5)
    errors, known = [], 0
    for seed in range(12):
        photo = Photo(
            (None, WEAK, DECENTRED)[seed % 3], f_px=rng.uniform(1400, 2800), vmag_limit=7.0, seed=seed,
            yaw_rad=rng.uniform(0, 6.28), pitch_rad=np.deg2rad(rng.uniform(10, 75)),
        )  # fmt: skip
        found = zenith_of(photo)
        if found.zenith_error_rad is None:
            assert not found.zenith_eq.any()
            continue
        known += 1
        errors.append(off_rad(photo, found) / found.zenith_error_rad)
    assert known >= 6
    assert max(errors) < 4.5
    assert np.median(errors) < 2.0


@pytest.mark.parametrize("lens", [None, WEAK, DECENTRED], ids=["pinhole", "weak", "decentred"])
def test_a_sky_without_air_has_no_zenith(lens: Lens | None) -> None:
    for seed in range(4):
        photo = Photo(lens, **LOW, yaw_rad=0.7 * seed)
        found = zenith_of(without_refraction(photo, 0.05 + 0.05 * seed, seed))
        assert found.zenith_error_rad is None
        assert not found.zenith_eq.any()
        assert found.refraction_scale == 0


def test_a_camera_in_thin_air_has_no_zenith() -> None:
    """A balloon at 20 km sees stars at the horizon, lifted by 0.03 deg."""
    photo = Photo(WEAK, **LOW | {"pitch_rad": np.deg2rad(82.0)})
    assert zenith_of(photo).zenith_error_rad is not None
    thin = replace(photo.reference, refraction_scale=0.05)
    xy = photo.camera.project(thin.to_camera(photo.C_camera_eq)[photo.on_image])
    photo.detected = Detected(xy + np.random.default_rng(1).normal(0, 0.05, xy.shape))
    assert zenith_of(photo).zenith_error_rad is None


def test_the_camera_is_better_with_the_zenith() -> None:
    photo = Photo(WEAK, **LOW)
    without = fit_camera(photo.detected, anywhere(photo), photo.matches)
    found = fit_camera(photo.detected, zenith_of(photo), photo.matches)

    assert without.camera.fx_px < 2400 - 1.5
    assert found.camera.fx_px == pytest.approx(2400, abs=0.5)
    assert found.chosen.rms_px < 0.5 * without.chosen.rms_px


def refracted_stars(photo: Photo) -> _RefractedStars:
    fitted = fit_camera(photo.detected, anywhere(photo), photo.matches).matches
    directions = anywhere(photo).to_camera(np.eye(3))
    identified = IdentifiedStars.of(photo.detected, directions, fitted.solution, fitted.star, fitted.detection)
    return _RefractedStars.of(identified, fitted.solution, 1.0)


def test_a_zenith_is_given_by_the_altitude_of_the_optical_axis_and_the_direction_from_the_top_of_the_image() -> None:
    stars = refracted_stars(Photo(None, **LOW))
    for direction_deg, x, y in ((0, 0, -1), (90, 1, 0), (180, 0, 1), (270, -1, 0)):
        in_camera = stars.solution.C_camera_eq @ stars.zenith_eq(np.deg2rad(30.0), np.deg2rad(direction_deg))
        np.testing.assert_allclose(in_camera, [np.sqrt(0.75) * x, np.sqrt(0.75) * y, 0.5], rtol=0, atol=1e-12)


def test_a_simple_lens_keeps_the_camera_before_the_first_refinement_as_prior() -> None:
    photo = Photo(Lens("plumb_bob", (-0.28, 0.09)))
    solution = photo.matches.solution
    directions = photo.reference.to_camera(np.eye(3))
    identified = IdentifiedStars.of(photo.detected, directions, solution, photo.matches.star, photo.matches.detection)
    first = simple_lens(identified, solution, "auto")
    assert first.prior_camera is solution.camera
    assert first.camera.fx_px == pytest.approx(900.0, rel=1e-3)
    assert first.k1 == 0
    assert simple_lens(identified, first, "auto").prior_camera is solution.camera


@pytest.mark.parametrize(
    ("candidate", "parameters"),
    [
        # Three angles and the focal length; coefficients besides; two angles of the zenith.
        (LensCandidate(None, (), principal_point=False), 4),
        (LensCandidate("plumb_bob", (0, 1), principal_point=False), 6),
    ],
)
def test_lenses_are_compared_by_the_information_criterion_of_bayes(candidate, parameters) -> None:
    photo = Photo(None, **LOW)
    photo.detected.xy_px[[6, 20]] += 0.5  # beyond which residuals count linearly
    stars = refracted_stars(photo)
    for zenith_eq, angles in ((photo.reference.zenith_eq, 2), (None, 0)):
        fitted = stars.fit(zenith_eq, candidate).state
        xy_px = fitted.camera.project(stars.at(zenith_eq).apparent @ fitted.C_camera_eq[0].T)
        scaled = (xy_px - stars.xy_px) / stars.noise_px / _SOFT_NOISE
        robust = _SOFT_NOISE**2 * np.sum(2 * (np.sqrt(1 + scaled**2) - 1))  # SciPy's soft_l1
        count = len(stars.xy_px)
        expected = count * np.log(robust / count) + (parameters + angles) * np.log(count)
        assert stars.criterion(zenith_eq, candidate) == pytest.approx(expected, rel=1e-9)


def test_the_error_of_a_zenith_is_that_of_its_worst_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sum of squares is a paraboloid with axes in any direction: its curvature is the information."""
    stars = refracted_stars(Photo(None, **LOW))
    zenith, first, second = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].T
    information = np.diag([4e4, 9e6])

    def cost(_stars, zenith_eq, _candidate):
        along = np.array([zenith_eq @ first, zenith_eq @ second]) / (zenith_eq @ zenith)
        return 700.0 + along @ information @ along

    monkeypatch.setattr(_RefractedStars, "cost", cost)
    # The noise is that of the residuals: 700 over the number of stars.
    expected = np.sqrt(700.0 / len(stars.xy_px) / 4e4)
    assert stars.error_rad(zenith, stars.plain_candidate) == pytest.approx(expected, rel=1e-9)
    information[0, 0] = -4e4
    assert stars.error_rad(zenith, stars.plain_candidate) == np.inf


def test_a_mirrored_image_has_the_same_zenith() -> None:
    photo = Photo(WEAK, **LOW, mirrored=True)
    found = zenith_of(photo)
    assert found.zenith_error_rad is not None
    assert off_rad(photo, found) < 4.5 * found.zenith_error_rad


def test_what_is_known_already_stays() -> None:
    photo = Photo(WEAK, **LOW)
    assert find_zenith(photo.detected, photo.reference, photo.matches, refraction_scale=1.0) is photo.reference
    unknown = anywhere(photo)
    assert find_zenith(photo.detected, unknown, photo.matches, refraction_scale=0.0) is unknown
    few = replace(photo.matches, star=photo.matches.star[:20], detection=photo.matches.detection[:20])
    assert find_zenith(photo.detected, unknown, few, refraction_scale=1.0) is unknown
