"""The search for a readout time and its fit, on stars with a known one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.geometry import readout as module
from glstar.calibrate.geometry.lenschoice import LensCandidate
from glstar.calibrate.geometry.readout import (
    _joint_fit,
    _matched,
    _matched_again,
    _stars_and_solutions,
    _State,
    _std_s,
    _with_readout,
    fit_readout,
    search_readout,
)
from glstar.calibrate.identify.leastsquares import CameraPoses, IdentifiedStars
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.minimise import Minimum
from glstar.calibrate.notes import Note, NoteKind
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.flight import AttitudeTrack
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)
NOTE = Note(NoteKind.IDENTIFICATION, "mirrored")


def turns(rate_rad_per_s, readout_s: float = 0.03, readout="down") -> RowTurns:
    t = np.arange(-40, 41) * 0.005
    track = AttitudeTrack.from_samples(5 + t, quaternion_from_turn(np.array(rate_rad_per_s) * t[:, np.newaxis]))
    return RowTurns(track, 5.0, about_z(0.4), readout_s, readout)


def reference(rows: RowTurns | None, direction_eq: np.ndarray | None = None) -> ReferenceStars:
    stars = SimpleNamespace(direction_eq=np.eye(3) if direction_eq is None else direction_eq)
    return ReferenceStars(stars, np.zeros(3), np.zeros(3), 0.0, None, rows)


def matches(count: int, *, off_px: float = 1.0, **more: object) -> Matches:
    index = np.arange(count)
    usual = {"star": index, "detection": index, "residual_px": np.full((count, 2), off_px), "predicted": index}
    solution = PlateSolution(CAMERA, np.eye(3))
    return Matches(**{"solution": solution, "predicted_xy_px": np.zeros((count, 2)), "chance": 0.0, **usual} | more)


def test_the_readout_time_with_most_stars_and_least_residuals_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: dict[float, list[str]] = {}

    def matched(detected, over, solution):
        time_s = over.rows.readout_s
        tried.setdefault(round(time_s, 9), []).append(detected)
        if detected == "faster" and time_s < -0.2:
            return None
        return matches(7 if time_s > 0.1 else 5, off_px=abs(time_s - 0.15))

    monkeypatch.setattr(module, "_matched", matched)
    rows = [turns([0.1, 0, 0]), turns([0, 0.9, 0]), turns([0.4, 0, 0.0]), None]
    over = [reference(one) for one in rows]
    names = ["slow", "fastest", "faster", "still"]
    found = search_readout(names, over, [matches(4) for _ in names])
    # 6 px at the border, where half the readout time has passed: 700 px times 0.9 rad/s.
    step = 12 / (0.9 * 700)
    times = [0.03, *(k * step for k in range(-13, 14))]
    assert list(tried) == pytest.approx(times, abs=1e-8)
    assert all(images == ["fastest", "faster"] for images in tried.values())
    assert found == pytest.approx(8 * step)  # 0.152 s
    # At most 40 on each side; those given first of equals.
    tried.clear()
    monkeypatch.setattr(module, "_matched", lambda d, over, s: tried.setdefault(over.rows.readout_s) or matches(5))
    fast = reference(turns([0, 3.0, 0], 0.0321))
    assert search_readout(["one"], [fast], [matches(4)]) == 0.0321
    np.testing.assert_allclose(sorted(set(tried) - {0.0321}), np.arange(-40, 41) * 0.25 / 40, atol=1e-12, rtol=0)
    still = reference(turns([0, 0, 0.0], 0.0321))
    tried.clear()
    assert search_readout(["one"], [still], [matches(4)]) == 0.0321
    assert set(tried) == {0.0321, 0.0}
    assert [one.rows and one.rows.readout_s for one in _with_readout(over, 0.07)] == [0.07, 0.07, 0.07, None]


def test_stars_are_matched_again_without_what_made_up_for_a_wrong_time(monkeypatch: pytest.MonkeyPatch) -> None:
    prior = replace(CAMERA, cx_px=320.0)
    bent = PlateSolution(CAMERA, np.eye(3), k1=0.1, prior_camera=prior)
    seen, result, significant = [], matches(8), True
    monkeypatch.setattr(module, "refine", lambda detected, over, solution: seen.append(solution) or result)
    monkeypatch.setattr(module, "is_significant", lambda found: significant)
    assert _matched("stars", reference(None), bent) is result
    assert (seen[0].k1, seen[0].camera.cx_px, seen[0].prior_camera) == (0.0, 320.0, prior)
    _matched("stars", reference(None), replace(bent, prior_camera=None))
    assert (seen[1].k1, seen[1].camera.cx_px) == (0.0, 322.0)
    lens = replace(bent, camera=replace(CAMERA, lens=Lens("plumb_bob", (0.1,))))
    _matched("stars", reference(None), lens)
    assert seen[2] is lens
    before = matches(5, notes=(NOTE,), solution=bent)
    again = _matched_again("stars", reference(None), before)
    assert (len(again), again.notes) == (8, (NOTE,))
    significant = False
    assert _matched("stars", reference(None), bent) is None
    assert _matched_again("stars", reference(None), before) is before
    significant, result = True, None
    assert _matched("stars", reference(None), bent) is None


def test_all_images_start_with_the_camera_of_the_most_stars() -> None:
    rays = CAMERA.unit_vectors(np.array([[100.0, 50], [500, 400], [320, 200]]))
    over = [reference(turns([0.1, 0.2, 0]), rays), reference(turns([0.3, 0, 0]), rays)]
    detected = [SimpleNamespace(xy_px=np.array([[100.0, 51], [501, 400], [320, 202]]))] * 2
    prior = replace(CAMERA, cx_px=320.0)
    few = matches(2, solution=PlateSolution(replace(CAMERA, fx_px=650.0), np.eye(3), k1=0.2))
    most = matches(
        3, solution=PlateSolution(CAMERA, about_z(0.1), k1=0.1, prior_camera=prior), star=np.array([2, 1, 0])
    )
    stars, solutions = _stars_and_solutions(detected, over, [few, most])
    assert [(one.camera, one.k1, one.prior_camera) for one in solutions] == [(CAMERA, 0.1, prior)] * 2
    assert [one.C_camera_eq.tolist() for one in solutions] == [np.eye(3).tolist(), about_z(0.1).tolist()]
    assert [len(one) for one in stars] == [2, 3]
    for k, (one, index) in enumerate(zip(stars, ([0, 1], [2, 1, 0]), strict=True)):
        xy = detected[0].xy_px[: len(index)]
        np.testing.assert_allclose(one.apparent, over[k].rows.turned(rays[index], xy, CAMERA), rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.by_readout, over[k].rows.by_readout(rays[index], xy, CAMERA), rtol=0, atol=1e-9)
    assert _stars_and_solutions(detected[:1], over[:1], [few])[1][0].prior_camera.fx_px == 650.0


def scene(true_s: float, start_s: float, *, lens: Lens | None = None):
    """Return identified stars of two images, read out in a time, as a fit from another time has them."""
    rng = np.random.default_rng(3)
    camera = replace(CAMERA, lens=lens)
    poses, stars = [], []
    for rate, axis in (([0.5, -0.3, 0.4], [0.3, -0.2, 0.5]), ([-0.2, 0.6, 0.7], [-0.4, 0.1, 0.9])):
        rows = turns(rate, true_s)
        C = matrix_from_quaternion(quaternion_from_turn(axis))
        xy = rng.uniform(5, [635, 475], (40, 2))
        # What the middle row would see there; the rows' own turn is undone.
        apparent = camera.unit_vectors(xy) @ C
        for _ in range(30):
            direction = apparent - (rows.turned(apparent, xy, camera) - camera.unit_vectors(xy) @ C)
            apparent = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        np.testing.assert_allclose(rows.turned(apparent, xy, camera), camera.unit_vectors(xy) @ C, rtol=0, atol=1e-9)
        given = rows.with_readout_s(start_s)
        noisy = xy + rng.normal(0, 0.05, xy.shape)
        stars.append(IdentifiedStars(given.turned(apparent, xy, camera), noisy, given.by_readout(apparent, xy, camera)))
        poses.append(C)
    return tuple(stars), CameraPoses(camera, tuple(poses))


@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.1, 0.02))])
def test_a_readout_time_is_fitted_with_camera_and_attitudes(lens: Lens | None, monkeypatch: pytest.MonkeyPatch) -> None:
    stars, poses = scene(0.043, 0.04, lens=lens)
    candidate = LensCandidate("plumb_bob" if lens else None, (0, 1) if lens else (), principal_point=True)
    best = SimpleNamespace(poses=poses, candidate=candidate)
    solutions = [PlateSolution(poses.camera, C) for C in poses.C_camera_eq]
    fit = _joint_fit(best, solutions, stars, 0.04)
    assert fit.state.readout_s == pytest.approx(0.043, abs=3e-4)
    assert fit.state.poses.camera.fx_px == pytest.approx(700, rel=2e-3)
    assert abs(fit.state.readout_s - 0.043) < 4 * _std_s(fit) < 6e-4
    seen = {}

    def kept(start, measured, moved, *, scale, most_steps):
        seen.update(start=start, measured=measured, moved=moved, scale=scale, most_steps=most_steps)

    monkeypatch.setattr(module, "minimise", kept)
    prior = replace(CAMERA, cx_px=310.0)
    _joint_fit(best, [replace(solutions[0], prior_camera=prior)], stars, 0.04)
    start, measured, moved = seen["start"], seen["measured"], seen["moved"]
    assert (start.readout_s, seen["most_steps"]) == (0.04, 50)
    residual, slopes = measured(start)
    # Two coordinates of 80 stars, and the priors of the principal point.
    assert seen["scale"].tolist() == [2.0] * 160 + [np.inf] * 2
    assert residual[160] == pytest.approx((322 - 310) / (640 * 0.02))
    count = 6 + 1 + 2 + (2 if lens else 0) + 1
    assert slopes.shape == (162, count)
    later = moved(start, np.eye(count)[-1] * 0.01)
    assert (later.readout_s, later.poses.camera) == (pytest.approx(0.05), start.poses.camera)
    h = 1e-6
    numerical = np.column_stack([
        (measured(moved(start, step))[0] - measured(moved(start, -step))[0]) / (2 * h) for step in h * np.eye(count)
    ])  # fmt: skip
    np.testing.assert_allclose(slopes, numerical, rtol=2e-4, atol=2e-2 * np.abs(slopes).max(axis=0).min())
    np.testing.assert_allclose(slopes[:, -1], numerical[:, -1], rtol=1e-4, atol=1e-2)
    assert np.abs(slopes[:160, -1]).max() > 100


def test_the_error_of_a_readout_time_includes_that_of_the_others() -> None:
    rng = np.random.default_rng(4)
    slopes, residual = rng.normal(size=(30, 4)), rng.normal(0, 0.7, 30)
    slopes[:, 3] += 0.8 * slopes[:, 0]
    fit = Minimum(None, residual, slopes, np.full(30, np.inf))
    covariance = np.linalg.inv(slopes.T @ slopes) * (residual @ residual) / (30 - 4)
    assert _std_s(fit) == pytest.approx(np.sqrt(covariance[3, 3]), rel=1e-9)
    slopes[:, 3] = 2 * slopes[:, 0] - slopes[:, 1]
    assert _std_s(Minimum(None, residual, slopes, np.full(30, np.inf))) == np.inf
    exact = Minimum(None, np.zeros(30), rng.normal(size=(30, 4)), np.full(30, np.inf))
    expected = np.sqrt(1e-12 * np.linalg.inv(exact.slopes.T @ exact.slopes)[3, 3])
    assert _std_s(exact) == pytest.approx(expected, rel=1e-6)
    few = Minimum(None, residual[:4], exact.slopes[:4], np.full(4, np.inf))
    expected = np.sqrt(residual[:4] @ residual[:4] * np.linalg.inv(few.slopes.T @ few.slopes)[3, 3])
    assert _std_s(few) == pytest.approx(expected, rel=1e-6)


def fitted(monkeypatch: pytest.MonkeyPatch, found_s: list[float], std_s: float, stars: int = 1501, **more: object):
    """Fit two images whose fits give certain times, and return the fit and what was called."""
    calls: dict[str, list] = {"cameras": [], "lens": [], "fits": [], "matched": []}
    answers = iter(found_s)

    def best(parts, solutions, lens):
        calls["lens"].append(([len(part) for part in parts], solutions, lens))
        assert [part.xy_px[0].tolist() for part in parts] == [[0, 1], [0, 1]]
        return "best"

    def joint(best_lens, solutions, parts, readout_s):
        calls["fits"].append((readout_s, [len(part) for part in parts]))
        return SimpleNamespace(state=SimpleNamespace(readout_s=next(answers)))

    def again(detected, over, found):
        calls["matched"].append((detected, over.rows.readout_s))
        return replace(found, needed=found.needed + 1)

    parts = [IdentifiedStars(np.zeros((n, 3)), np.arange(2.0 * n).reshape(n, 2)) for n in (stars - 500, 500)]
    monkeypatch.setattr(module, "_matched_again", again)
    monkeypatch.setattr(module, "require_one_camera", lambda names, cameras: calls["cameras"].append((names, cameras)))
    monkeypatch.setattr(module, "_stars_and_solutions", lambda detected, over, found: (parts, "solutions"))
    monkeypatch.setattr(module, "best_lens", best)
    monkeypatch.setattr(module, "_joint_fit", joint)
    monkeypatch.setattr(module, "_std_s", lambda fit: std_s)
    over = [reference(turns([0.3, 0.4, 0], 0.03, "up")), reference(turns([0, 0, 0.2], 0.031, "up"))]
    return fit_readout(["a", "b"], ["stars a", "stars b"], over, [matches(5), matches(6)], **more), calls


def test_a_readout_time_is_fitted_until_it_changes_by_a_tenth_of_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, calls = fitted(monkeypatch, [0.05, 0.0499, 0.04999, 0.07], 0.001, lens="fisheye")
    # 0.05 to 0.0499 is a tenth of the error: not less than that.
    assert [readout_s for readout_s, _ in calls["fits"]] == [0.03, 0.05, 0.0499][: len(calls["fits"])]
    assert len(calls["fits"]) in {2, 3}
    assert calls["fits"][0][1] == [1001, 500]
    # The lens is chosen with every second of 1501 stars.
    assert calls["lens"][0] == ([501, 250], "solutions", "fisheye")
    assert calls["cameras"][0] == (["a", "b"], [CAMERA, CAMERA])
    assert calls["matched"][:2] == [("stars a", 0.03), ("stars b", 0.03)]
    last = fit.time.readout_s
    assert calls["matched"][-2:] == [("stars a", last), ("stars b", last)]
    time = fit.time
    assert (time.std_s, time.direction, time.opposite, time.stars, time.images) == (0.001, "up", False, 1501, 2)
    assert time.turn_rad == pytest.approx(0.5 * last, rel=1e-6)
    assert [one.readout for one in fit.matches] == [time, time]
    assert [one.rows.readout_s for one in fit.reference] == [last, last]
    assert [one.needed for one in fit.matches] == [len(calls["fits"]) + 1] * 2


def test_a_readout_time_against_the_given_direction_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, calls = fitted(monkeypatch, [-0.05, -0.05], 0.002, stars=1500)
    assert (fit.time.readout_s, fit.time.direction, fit.time.opposite) == (0.05, "down", True)
    assert fit.reference[0].rows.readout_s == -0.05
    assert calls["lens"][0] == ([1000, 500], "solutions", "auto")
    # Six rounds, and no longer than a quarter of a second.
    fit, calls = fitted(monkeypatch, [0.1, -0.1, 0.1, -0.1, 0.1, -0.3, 0.2], 0.001)
    assert (fit.time.readout_s, len(calls["fits"])) == (0.25, 6)
    assert fitted(monkeypatch, [0.3, 0.3], 0.001)[0].time.readout_s == 0.25
    # A time of 0 has the turn of its error.
    assert fitted(monkeypatch, [0.0, 0.0], 0.01)[0].time.turn_rad == 0


def test_too_little_turn_is_refused_with_its_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fitted(monkeypatch, [0.05, 0.05], 0.02)[0].time.std_s == 0.02
    for std_s, words in ((0.0208, "only to 20.8 ms"), (np.inf, "not at all"), (np.nan, "not at all")):
        with pytest.raises(CalibrationError) as caught:
            fitted(monkeypatch, [0.05, 0.05], std_s)
        assert str(caught.value) == (
            "the aircraft turned at up to 28.6 deg/s while the rows were read: 1501 stars of 2 images determine the"
            f" readout time {words}, and 20 ms are needed; take photographs in a faster turn, with stars from the first"
            " to the last row, or leave --fit-readout out"
        )
        assert caught.value.stars_used == 1501
    assert _State(CameraPoses(CAMERA, ()), 0.1).readout_s == 0.1
