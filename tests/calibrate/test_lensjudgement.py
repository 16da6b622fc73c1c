"""When a fitted lens is accepted, which stars it matches again, and how images share one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.geometry import lensfit
from glstar.calibrate.geometry.lenschoice import BestLens, LensCandidate, LensTrial
from glstar.calibrate.geometry.lensfit import (
    CameraFit,
    Pairs,
    _fit_jointly,
    _within_circle,
    centroid_noise_px,
    fit_camera,
    fit_lens,
    fit_shared_lens,
    match_again,
    matches_of,
    require_explained,
    require_one_camera,
    with_refraction,
)
from glstar.calibrate.identify.leastsquares import CameraPoses, IdentifiedStars
from glstar.calibrate.identify.matching import mutual_nearest, offset_probability, significant
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.notes import Note, NoteKind
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))
FIRST = Note(NoteKind.IDENTIFICATION, "first")


class Detected(SimpleNamespace):
    """The part of `DetectedStars` that is used here."""

    def __len__(self) -> int:
        return len(self.xy_px)


def detections(xy_px: np.ndarray, **more: object) -> Detected:
    count = len(xy_px)
    usual = {"signal_to_noise": np.full(count, 50.0), "saturated": np.zeros(count, bool), "psf_sigma_px": 1.2}
    return Detected(**{"xy_px": np.asarray(xy_px, float), "drawn_out_px": 0.0, **usual} | more)


def reference_of(direction_eq: np.ndarray, **more: object) -> ReferenceStars:
    usual = {"zenith_eq": np.zeros(3), "velocity_eq": np.zeros(3), "refraction_scale": 0.0, "C_ned_eq": None}
    vmag = np.arange(len(direction_eq)) / 10
    return ReferenceStars(SimpleNamespace(direction_eq=direction_eq, vmag=vmag), **usual | more)


def matches(count: int = 3, **more: object) -> Matches:
    index = np.arange(count)
    usual = {"star": index, "detection": index, "residual_px": np.full((count, 2), 0.1), "predicted": index}
    solution = PlateSolution(CAMERA, TURN)
    return Matches(**{"solution": solution, "predicted_xy_px": np.zeros((count, 2)), "chance": 0.0, **usual} | more)


def test_centroids_have_the_bound_of_cramer_and_rao() -> None:
    detected = detections(
        np.zeros((5, 2)),
        signal_to_noise=np.array([4.0, 20.0, 9.0, 100.0, 15.0]),
        saturated=np.array([False, False, False, True, True]),
    )
    single = np.hypot(np.sqrt(2 / np.pi) / detected.signal_to_noise, 0.05)
    single[3:] = np.maximum(single[3:], 0.6)
    for some in ([0, 1, 2], [1, 3, 4], [3], [1, 2]):
        assert centroid_noise_px(detected, np.array(some)) == pytest.approx(np.median(single[some]))
    moved = Detected(**vars(detected) | {"drawn_out_px": 3.0})
    assert centroid_noise_px(moved, np.array([0, 1, 2])) == pytest.approx(np.hypot(np.median(single[:3]), 0.75))
    sharp = Detected(**vars(detected) | {"psf_sigma_px": 0.05})
    assert centroid_noise_px(sharp, np.array([4])) == pytest.approx(np.hypot(np.sqrt(2 / np.pi) / 15, 0.05))


def judged(off_px: np.ndarray, residual_px: np.ndarray, *, sigma_px: float = 0.5, noise: float = 50.0, **more) -> None:
    """Judge a camera whose identified stars lie some px to the right, with the residuals of those that still match."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(50, 400, (len(off_px), 2))
    reference = reference_of(CAMERA.unit_vectors(xy) @ TURN, **more)
    found = detections(xy + np.column_stack([off_px, np.zeros_like(off_px)]), psf_sigma_px=sigma_px)
    found.signal_to_noise[:] = noise
    residual = np.column_stack([residual_px, residual_px])
    require_explained(
        found,
        reference,
        matches(len(xy)),
        matches(len(residual_px), residual_px=residual),
        lens="a pinhole",
        advice="go",
    )


def test_a_camera_is_refused_if_its_residuals_exceed_noise_pixel_and_star() -> None:
    near, exact = np.zeros(10), np.full(8, 0.1)
    # A pixel, for sharp stars without noise; the robust deviation is 1.4826 times the residual.
    judged(near, exact)
    judged(near, np.full(8, 0.98 / 1.4826))
    # The width of wide stars.
    judged(near, np.full(8, 1.96 / 1.4826), sigma_px=2.0)
    # Five times the noise: sqrt(2 / pi) over the signal.
    noise = np.hypot(np.sqrt(2 / np.pi) / 2, 0.05)
    judged(near, np.full(8, 0.98 * 5 * noise / 1.4826), noise=2.0)
    judged(np.array([3.06, 3.06, *[0.0] * 8]), exact)
    judged(np.array([2.94] * 10), exact)
    judged(np.array([5.88] * 10), exact, sigma_px=2.0)
    # The root mean square of most stars with small residuals.
    one = np.append(np.full(7, 0.1), 0.98 * 3 * 2)
    judged(near, one)
    for off, residual, options in (
        (near, np.full(8, 1.02 / 1.4826), {}),
        (near, np.full(8, 2.04 / 1.4826), {"sigma_px": 2.0}),
        (near, np.full(8, 1.02 * 5 * noise / 1.4826), {"noise": 2.0}),
        (np.array([3.06] * 3 + [0.0] * 7), exact, {}),
        (np.array([6.12] * 3 + [0.0] * 7), exact, {"sigma_px": 2.0}),
        (np.array([np.nan] * 3 + [0.0] * 7), exact, {}),
        (near, np.append(np.full(7, 0.1), 1.02 * 3 * 2), {}),
    ):
        with pytest.raises(CalibrationError):
            judged(off, residual, **options)
    with pytest.raises(CalibrationError) as caught:
        judged(np.array([3.06] * 3 + [0.0] * 7), exact)
    assert str(caught.value) == (
        "10 stars are identified, but a pinhole leaves 3 of them more than 3.0 px from where they are found (those that"
        " still match: 0.14 px rms), and their centres are measured to 0.05 px: this is not the camera's lens; go; near"
        " the horizon, refraction bends an image too: give --utc, --lat and --lon"
    )
    assert caught.value.stars_used == 8
    with pytest.raises(CalibrationError, match=r"lens; go$"):
        judged(np.array([3.06] * 3 + [0.0] * 7), exact, C_ned_eq=np.eye(3))


def test_matches_of_a_fitted_camera_have_its_residuals_and_errors() -> None:
    xy = np.array([[100.0, 50], [500, 400], [-30, 200], [320, 200]])
    directions = CAMERA.unit_vectors(xy) @ TURN
    reference = reference_of(directions)
    pairs = Pairs(np.array([3, 0]), np.array([5, 6]), 0.25)
    shift = np.array([[0.5, -0.25], [0.125, 1.0]])
    stars = IdentifiedStars(directions[[3, 0]], xy[[3, 0]] + shift)
    for mirrored in (False, True):
        solution = PlateSolution(CAMERA, TURN, mirrored)
        found = matches_of(reference, matches(notes=(FIRST,)), solution, pairs, stars, {"fx_px": 0.3, "k1": 0.01})
        np.testing.assert_allclose(found.residual_px, shift * [-1 if mirrored else 1, 1], rtol=0, atol=1e-9)
        assert found.predicted.tolist() == [0, 1, 3]
        shown = xy[[0, 1, 3]]
        shown = np.column_stack([639 - shown[:, 0], shown[:, 1]]) if mirrored else shown
        np.testing.assert_allclose(found.predicted_xy_px, shown, rtol=1e-7)
        assert (found.star.tolist(), found.detection.tolist(), found.expected_by_chance) == ([3, 0], [5, 6], 0.25)
        assert (found.solution, found.notes) == (solution, (FIRST,))
        assert found.standard_error == {
            "fx_px": pytest.approx(np.hypot(0.3, 700 * 1.55 * 2.8e-4)),
            "k1": pytest.approx(0.01),
        }
    sd = with_refraction({"cx_px": 0.2, "cy_px": 0.1, "k1": 0.3}, reference, PlateSolution(CAMERA, TURN))
    of_point = 700 * 1.97 * 2.8e-4
    assert sd == {
        "cx_px": pytest.approx(np.hypot(0.2, of_point)), "cy_px": pytest.approx(np.hypot(0.1, of_point)), "k1": 0.3
    }  # fmt: skip
    assert with_refraction({"fx_px": 0.2}, reference_of(directions, C_ned_eq=np.eye(3)), solution) == {"fx_px": 0.2}


def placed(xy: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(camera=CAMERA, placed=lambda apparent, rows: xy)


@pytest.mark.parametrize("spread_px", [0.05, 0.8, 3.0])
def test_stars_are_matched_again_within_three_residuals(spread_px: float) -> None:
    rng = np.random.default_rng(8)
    xy = rng.uniform(-20, [660, 500], (90, 2))
    reference = reference_of(np.zeros((90, 3)))
    found = np.concatenate([xy[:60:2] + rng.normal(0, spread_px, (30, 2)), rng.uniform(0, [640, 480], (70, 2))])
    detected = detections(rng.permutation(found))
    before = np.array([2, 8, 40])
    on_image = np.flatnonzero(CAMERA.contains(xy) & (np.arange(90) <= 45))  # 4.0 mag and half a magnitude
    nearest, distance = mutual_nearest(xy[on_image], detected.xy_px, 1.0)
    known = distance[np.isin(on_image, before) & np.isfinite(distance)]
    assert len(known) >= 2
    radius = max(3 * min(np.quantile(known, 0.9), 3.0), 1.0)
    assert (radius == 1.0) == (spread_px == 0.05)
    offset = detected.xy_px[nearest] - xy[on_image]
    probability = offset_probability(offset, distance < radius, np.ones(len(on_image)), 100 / (640 * 480), radius)
    kept = significant(probability)
    pairs = match_again(detected, reference, None, placed(xy), before)
    assert pairs.star.tolist() == on_image[kept].tolist()
    assert pairs.detection.tolist() == nearest[kept].tolist()
    assert pairs.expected_by_chance == pytest.approx((1 - probability[kept]).sum())
    assert len(pairs) > 5


def test_without_stars_on_the_image_nothing_is_matched_again() -> None:
    xy = np.full((9, 2), -50.0)
    detected = detections(np.random.default_rng(1).uniform(0, 400, (9, 2)))
    pairs = match_again(detected, reference_of(np.zeros((9, 3))), None, placed(xy), np.array([1]))
    assert (len(pairs), pairs.expected_by_chance) == (0, 0.0)
    # Stars that were matched and have no detection now: the radius is three pixels.
    xy[:6] = detected.xy_px[:6] + np.array([2.9, 0.0])
    xy[6:] = [600.0, 450.0]
    found = match_again(detected, reference_of(np.zeros((9, 3))), None, placed(xy), np.array([7, 8]))
    assert set(found.star.tolist()) <= set(range(6))
    assert Pairs(np.array([1, 2]), np.array([3, 4]), 0.0).is_same(Pairs(np.array([1, 2]), np.array([3, 4]), 0.9))
    assert not Pairs(np.array([1, 2]), np.array([3, 4]), 0.0).is_same(Pairs(np.array([1, 2]), np.array([3, 5]), 0.0))
    assert not Pairs(np.array([1, 2]), np.array([3, 4]), 0.0).is_same(Pairs(np.array([1, 3]), np.array([3, 4]), 0.0))


FISHEYE = Camera(640, 480, 220.0, 220.0, 319.5, 239.5, lens=Lens("fisheye", ()))


def circle(end_deg: float, count: int, *, beyond: int, false: int = 0, lost: int = 0):
    """Return matches of bright stars up to some angle off the axis, and the stars' angles."""
    angle = np.concatenate([np.linspace(3, end_deg - 0.3, count), np.linspace(end_deg + 0.3, end_deg + 12, beyond)])
    about = np.arange(len(angle)) * 2.4
    order = np.random.default_rng(2).permutation(len(angle))
    theta = np.deg2rad(angle)[order]
    rays = np.column_stack([np.sin(theta) * np.cos(about), np.sin(theta) * np.sin(about), np.cos(theta)])
    found = angle < end_deg
    found[len(angle) - false :] = True
    found[:lost] = False
    star = np.flatnonzero(found[order])
    predicted = np.arange(len(angle))
    solution = PlateSolution(FISHEYE, TURN)
    total = len(star)
    return reference_of(rays @ TURN), matches(
        total, solution=solution, star=star, predicted=predicted, detection=np.arange(total) + 100,
        residual_px=np.arange(2.0 * total).reshape(-1, 2), predicted_xy_px=np.zeros((len(angle), 2)), notes=(FIRST,),
    ), np.rad2deg(theta)  # fmt: skip


def test_the_image_circle_ends_where_the_bright_stars_do() -> None:
    reference, given, angle = circle(70.0, 80, beyond=30, false=1)
    given = replace(given, star=np.concatenate([given.star, np.full(29, 999)]))  # of 110 bright ones
    given = replace(given, detection=np.arange(110) + 100, residual_px=np.arange(220.0).reshape(-1, 2))
    found = _within_circle(reference, given)
    lens = found.solution.camera.lens
    # Halfway between the last star within and the first beyond, but for a false one.
    assert np.rad2deg(lens.max_angle_rad) == pytest.approx(70.0, abs=0.02)
    assert lens.max_angle_rad == np.deg2rad(np.rad2deg(lens.max_angle_rad).round(2))
    within = np.flatnonzero(angle < np.rad2deg(lens.max_angle_rad))
    assert sorted(found.predicted.tolist()) == sorted(set(within.tolist()) & set(found.predicted.tolist()))
    kept = np.isin(given.star, found.predicted)
    np.testing.assert_array_equal(found.star, given.star[kept])
    np.testing.assert_array_equal(found.detection, given.detection[kept])
    np.testing.assert_array_equal(found.residual_px, given.residual_px[kept])
    assert len(found.predicted_xy_px) == len(found.predicted)
    text = (
        f"the image circle ends {np.rad2deg(lens.max_angle_rad):.1f} deg off the axis: bright stars beyond it are mis"
    )
    assert [str(note)[: len(text)] for note in found.notes] == ["first", text]


def bright_circle(count: int, beyond: int, false: int = 0, lost: int = 0) -> bool:
    """Return whether an image circle is seen if as many stars are matched as are bright."""
    reference, given, _ = circle(60.0, count, beyond=beyond, false=false, lost=lost)
    more = count + beyond - len(given.star)
    star = np.concatenate([given.star, np.full(more, 999)])
    given = replace(given, star=star, detection=np.arange(len(star)), residual_px=np.zeros((len(star), 2)))
    return _within_circle(reference, given) is not given


def test_an_image_circle_needs_many_bright_stars_within_and_missing_beyond() -> None:
    assert [bright_circle(50, beyond) for beyond in (11, 12)] == [False, True]
    # A fraction of four fifths is found within: 15 stars beyond lack twelve.
    assert [bright_circle(50, beyond, lost=10) for beyond in (14, 16)] == [False, True]
    # A tenth of those beyond may seem to be found.
    assert [bright_circle(60, 30, false=false) for false in (3, 4)] == [True, False]
    assert [bright_circle(36 + more, 13) for more in (0, 1)] == [False, True]  # 49 and 50 bright stars
    reference, given, _ = circle(60.0, 60, beyond=20)
    bent = replace(given.solution, camera=replace(FISHEYE, lens=Lens("plumb_bob", ())))
    assert _within_circle(reference, replace(given, solution=bent)).solution is bent
    plain = replace(given.solution, camera=replace(FISHEYE, lens=None))
    assert _within_circle(reference, replace(given, solution=plain)).solution is plain


def fit_of(found: Matches, lens: Lens | None, trials=()) -> CameraFit:
    camera = replace(CAMERA, lens=lens)
    found = replace(found, solution=PlateSolution(camera, TURN), standard_error={"fx_px": 0.25})
    return CameraFit(found, trials, LensTrial("chosen lens", 5, 0.123, -9.0), 0.456, 0.876)


@pytest.mark.parametrize(("choice", "count", "lens", "fitted", "is_noted"), [
    ("auto", 11, None, "a pinhole with radial distortion", None),
    ("auto", 12, None, "the best of all lens models (chosen lens)", False),
    ("auto", 12, Lens("plumb_bob", (-0.1,)), "the best of all lens models (chosen lens)", True),
    ("none", 5, None, "a pinhole", True),
    ("fisheye", 11, Lens("fisheye", (0.1,)), "a fisheye lens", True),
])  # fmt: skip
def test_a_lens_is_fitted_noted_and_judged(choice, count, lens, fitted, is_noted, monkeypatch) -> None:
    given = matches(count, notes=(FIRST,))
    calls = []

    def fit(detected, reference, start, *, lens: str):
        calls.append((start, lens))
        return fit_of(replace(given, notes=(), needed=8), camera_lens)

    camera_lens = lens
    judged_with = []
    monkeypatch.setattr(lensfit, "fit_camera", fit)
    monkeypatch.setattr(
        lensfit, "require_explained", lambda *arguments, lens, advice: judged_with.append((arguments, lens, advice))
    )
    monkeypatch.setattr(lensfit, "_within_circle", lambda reference, found: ("within", found))
    _, found = fit_lens("stars", "reference", given, lens=choice)
    assert calls == ([] if is_noted is None else [(given, choice)])
    [(arguments, lens_text, advice)] = judged_with
    assert (arguments, lens_text) == (("stars", "reference", given, found), fitted)
    assert advice == (
        "give an image as the camera took it, neither cropped nor stitched" if choice == "auto" else "use --lens auto"
    )
    shown = str(camera_lens) if camera_lens else "a pinhole"
    summary = (
        f"lens fitted to {count} stars: {shown}, f = 700.00 ± 0.25 px, 0.123 px rms (as a pinhole 0.456); the stars"
        " cover 88 % of the distance to the corners"
    )
    assert found.notes == ((FIRST, Note(NoteKind.CAMERA, summary)) if is_noted else (FIRST,))
    assert found.needed == (0 if is_noted is None else 8)
    no_pinhole = replace(fit_of(given, None), pinhole_rms_px=np.inf)
    assert "0.123 px rms (no pinhole fits)" in no_pinhole.summary


def best_of(number: int, trials=()) -> BestLens:
    camera = replace(CAMERA, fx_px=700.0 + number)
    candidate = LensCandidate(None, (), principal_point=False)
    return BestLens(
        CameraPoses(camera, (about_z(0.1 * number), about_z(0.2 * number))), LensTrial(f"best {number}", 4, 0.1, -5.0),
        candidate, trials, {"fx_px": 0.1 * number},
    )  # fmt: skip


def some(*star: int, detection: list[int] | None = None) -> Pairs:
    return Pairs(np.array(star), np.array(star if detection is None else detection), 0.01 * len(star))


def fitting(monkeypatch: pytest.MonkeyPatch, answers: list[Pairs], *, fails_at: int = -1):
    """Fit a camera whose matches with each lens are given, and return the fit and the order of the calls."""
    calls: list[object] = []
    later = iter(answers)
    rng = np.random.default_rng(1)
    xy = rng.uniform(20, 460, (12, 2))
    reference = reference_of(CAMERA.unit_vectors(xy) @ TURN)

    def simple(stars, solution, choice):
        calls.append(("simple", len(stars), solution.k1, choice))
        return replace(solution, k1=solution.k1 + 1)

    def again(detected, over, apparent, solution, before):
        calls.append(("match", before.tolist(), solution.k1, solution.camera.fx_px))
        return next(later)

    def best(stars, solutions, choice):
        number = sum(call[0] == "best" for call in calls)
        calls.append(("best", len(stars[0]), solutions[0].camera.fx_px, choice))
        if number == fails_at:
            raise CalibrationError("too few")
        trials = (
            (LensTrial("a", 4, 0.5, 0.0), None),
            (LensTrial("b", 6, 0.3, 0.0), None),
            (LensTrial("c", 9, 0.1, 0), "k"),
        )
        return best_of(number, trials if number == 0 else ((LensTrial("c", 9, 0.1, 0.0), "fisheye"),))

    monkeypatch.setattr(lensfit, "simple_lens", simple)
    monkeypatch.setattr(lensfit, "match_again", again)
    monkeypatch.setattr(lensfit, "best_lens", best)
    given = matches(4, expected_by_chance=0.5)
    return fit_camera(detections(xy), reference, given, lens="plumb_bob"), calls


def test_a_camera_is_fitted_and_matched_in_turn_until_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    six, eight = some(0, 1, 2, 3, 4, 5), some(0, 1, 2, 3, 4, 5, 6, 7)
    other = some(0, 1, 2, 3, 4, 5, 6, 7, detection=[0, 1, 2, 3, 4, 5, 7, 6])
    fit, calls = fitting(monkeypatch, [six, eight, other, eight, other, other])
    # A simple lens extends the matches as long as other stars match; then all detections must be the same.
    assert calls[:6] == [
        ("simple", 4, 0.0, "plumb_bob"), ("match", [0, 1, 2, 3], 1.0, 700.0),
        ("simple", 6, 1.0, "plumb_bob"), ("match", list(range(6)), 2.0, 700.0),
        ("simple", 8, 2.0, "plumb_bob"), ("match", list(range(8)), 3.0, 700.0),
    ]  # fmt: skip
    assert calls[6:] == [
        ("best", 8, 700.0, "plumb_bob"), ("match", list(range(8)), 0.0, 700.0),
    ]  # fmt: skip
    assert (len(fit.matches), fit.chosen.label, fit.pinhole_rms_px) == (8, "best 0", 0.3)
    assert fit.matches.expected_by_chance == pytest.approx(0.08)
    assert [trial.label for trial in fit.trials] == ["a", "b", "c"]
    fit, calls = fitting(monkeypatch, [some(0, 1, 2, 3), some(0, 1, 2, 3, 4), six, six])
    assert [call[0] for call in calls] == ["simple", "match", "best", "match", "best", "match", "best", "match"]
    assert [call[2] for call in calls if call[0] == "best"] == [700.0, 700.0, 701.0]
    assert (len(fit.matches), fit.chosen.label, fit.pinhole_rms_px, fit.camera.fx_px) == (6, "best 2", np.inf, 702.0)
    np.testing.assert_allclose(fit.matches.solution.C_camera_eq, about_z(0.2), rtol=1e-7)
    assert fit.matches.solution.k1 == 0
    assert fit.sd["fx_px"] == pytest.approx(np.hypot(0.2, 702 * 1.55 * 2.8e-4))
    outermost = np.linalg.norm(np.random.default_rng(1).uniform(20, 460, (12, 2))[:6] - [322, 236], axis=1).max()
    assert fit.corner_fraction == pytest.approx(outermost / np.hypot(322.5, 243.5))


def test_far_fewer_matches_end_the_fit_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, calls = fitting(monkeypatch, [some(0), some(0)])
    assert [call[0] for call in calls] == ["simple", "match", "best", "match"]
    assert len(fit.matches) == 4
    # Half of them are enough.
    fit, calls = fitting(monkeypatch, [some(0, 1), some(0, 1), some(0), some(0)])
    assert [call[0] for call in calls] == ["simple", "match", "simple", "match", "best", "match", "best", "match"]
    fit, _ = fitting(monkeypatch, [some(0), some(0, 1, 5)], fails_at=1)
    assert (len(fit.matches), fit.chosen.label) == (4, "best 0")
    # Six rounds of each.
    grown = [some(*range(4 + k)) for k in range(1, 7)]
    turns = [some(*range(6)), some(*range(7))] * 3
    fit, calls = fitting(monkeypatch, [*grown, *turns])
    assert [call[0] for call in calls] == ["simple", "match"] * 6 + ["best"] + ["match", "best"] * 6
    assert len(fit.matches) == 7


def test_images_of_one_camera_have_its_size_and_focal_length() -> None:
    cameras = [CAMERA, replace(CAMERA, fx_px=700 * 1.0099), replace(CAMERA, fx_px=700 / 1.0099)]
    require_one_camera(["a", "b", "c"], cameras)
    for other in (700 * 1.0105, 700 / 1.0105):
        with pytest.raises(
            CalibrationError, match=rf"^a has f = 700\.0 px and c f = {other:.1f} px: not one lens, or it"
        ):
            require_one_camera(["a", "b", "c"], [*cameras[:2], replace(CAMERA, fx_px=other)])
    for size in ({"width_px": 641}, {"height_px": 481}):
        with pytest.raises(CalibrationError, match="a is 640 x 480 px and b 64"):
            require_one_camera(["a", "b"], [CAMERA, replace(CAMERA, **size)])


def sharing(monkeypatch: pytest.MonkeyPatch, answers: list[Pairs]):
    """Fit a lens to two images whose matches with each lens are given."""
    calls: list[tuple[object, ...]] = []
    later = iter(answers)
    rng = np.random.default_rng(1)
    xy = rng.uniform(20, 460, (12, 2))
    over = [reference_of(CAMERA.unit_vectors(xy) @ TURN)] * 2

    def best(stars, solutions, choice):
        calls.append(([len(one) for one in stars], [one.camera.fx_px for one in solutions], solutions[0].k1, choice))
        return best_of(len(calls))

    def again(detected, reference, apparent, solution, before):
        return next(later)

    monkeypatch.setattr(lensfit, "best_lens", best)
    monkeypatch.setattr(lensfit, "match_again", again)
    prior = replace(CAMERA, fx_px=650.0)
    few = matches(4, solution=PlateSolution(replace(CAMERA, fx_px=690.0), TURN))
    most = matches(5, solution=PlateSolution(CAMERA, TURN, k1=0.5, prior_camera=prior))
    return _fit_jointly([detections(xy)] * 2, over, [few, most], "auto"), calls


def test_images_share_a_lens_until_their_matches_do_not_change(monkeypatch: pytest.MonkeyPatch) -> None:
    five, six = some(0, 1, 2, 3, 4), some(0, 1, 2, 3, 4, 5)
    (best, solutions, pairs, stars), calls = sharing(monkeypatch, [five, six, five, six])
    # The first fit starts from the camera of the image with most stars.
    assert calls == [([4, 5], [700.0, 700.0], 0.5, "auto"), ([5, 6], [701.0, 701.0], 0.0, "auto")]
    assert best.chosen.label == "best 2"
    assert [one.camera.fx_px for one in solutions] == [702.0, 702.0]
    assert [one.prior_camera.fx_px for one in solutions] == [650.0, 650.0]
    np.testing.assert_allclose([one.C_camera_eq for one in solutions], [about_z(0.2), about_z(0.4)], rtol=1e-7)
    assert [len(one) for one in pairs] == [len(one) for one in stars] == [5, 6]
    # One image with fewer than half its stars ends it.
    (_, _, pairs, _), calls = sharing(monkeypatch, [five, some(0), five, six])
    assert ([len(one) for one in pairs], len(calls)) == ([4, 5], 1)
    (_, _, pairs, _), calls = sharing(monkeypatch, [five, some(0, 1), five, some(0, 1)])
    assert ([len(one) for one in pairs], len(calls)) == ([5, 2], 2)
    changing = [some(*range(5 + k % 2)) for k in range(14) for _ in range(2)]
    (_, _, pairs, _), calls = sharing(monkeypatch, changing)
    assert len(calls) == 7  # six rounds after the first


def test_a_shared_lens_has_the_largest_errors_and_the_fits_of_single_images(monkeypatch: pytest.MonkeyPatch) -> None:
    candidates, judged_images = [], []
    monkeypatch.setattr(lensfit, "fit_lens", lambda d, r, m, *, lens: replace(m, needed=len(lens)))
    solution = PlateSolution(CAMERA, TURN)
    stars = [IdentifiedStars(np.ones((n, 3)), np.ones((n, 2))) for n in (4, 5)]
    best = replace(best_of(1), sd={"fx_px": 0.1})

    def jointly(detected, reference, single, lens):
        assert [one.needed for one in single] == [len(lens)] * 2
        return best, [solution] * 2, ["pairs a", "pairs b"], stars

    def fitted(candidate, part, start):
        candidates.append((candidate, len(part), start))
        return None if len(part) == 4 else (replace(CAMERA, fx_px=699.0), {"fx_px": 0.4})

    def of(reference, identified, solution, pairs, part, sd):
        return matches(len(part), standard_error={"fx_px": 0.1 * len(part)}, needed=identified.needed)

    def explained(d, r, before, after, *, lens, advice):
        judged_images.append((d, len(after), lens, advice))
        if d == bad:
            raise CalibrationError("bad", stars_used=7)

    bad = None
    monkeypatch.setattr(lensfit, "_fit_jointly", jointly)
    monkeypatch.setattr(lensfit, "fit_candidate", fitted)
    monkeypatch.setattr(lensfit, "matches_of", of)
    monkeypatch.setattr(lensfit, "require_explained", explained)
    over = [reference_of(np.eye(3)), reference_of(np.eye(3))]
    given = [matches(4), matches(5)]
    fit = fit_shared_lens(["a", "b"], ["stars a", "stars b"], over, given, lens="none")
    assert [len(one) for one in fit.matches] == [4, 5]
    assert [one.needed for one in fit.matches] == [0, 0]
    assert fit.standard_error == {"fx_px": pytest.approx(0.5)}
    assert (fit.chosen, fit.single[0]) == (best.chosen, None)
    assert fit.single[1].camera.fx_px == 699.0
    # Refraction moves the focal length of the solution.
    assert fit.single[1].standard_error == {"fx_px": pytest.approx(np.hypot(0.4, 700 * 1.55 * 2.8e-4))}
    assert candidates == [(best.candidate, 4, solution), (best.candidate, 5, solution)]
    advice = "leave this image out, or calibrate it separately"
    assert judged_images == [
        (f"stars {n}", k, "the lens of all images (best 1)", advice) for n, k in (("a", 4), ("b", 5))
    ]
    bad = "stars b"
    with pytest.raises(CalibrationError, match=r"^b: bad$") as caught:
        fit_shared_lens(["a", "b"], ["stars a", "stars b"], over, given)
    assert caught.value.stars_used == 7
    wide = [given[0], matches(5, solution=PlateSolution(replace(CAMERA, fx_px=750.0), TURN))]
    with pytest.raises(CalibrationError, match="not one lens"):
        fit_shared_lens(["a", "b"], ["stars a", "stars b"], over, wide)
