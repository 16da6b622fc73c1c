"""Identification with an approximate attitude, by votes for a shift and a roll, and from labels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import convolve2d

from glstar.calibrate.identify import hints
from glstar.calibrate.identify.hints import Label as NamedStar
from glstar.calibrate.identify.hints import (
    _best_orientation,
    _by_votes,
    _rolls,
    identify_again,
    identify_by_labels,
    identify_near,
)
from glstar.calibrate.identify.platesolution import (
    Matches,
    PlateSolution,
    ReferenceStars,
    nominal_camera,
    orientation_notes,
    wide_angle_cameras,
)
from glstar.calibrate.notes import Note, NoteKind
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(1000, 700, 900.0, 890.0, 505.0, 345.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))


class Detections:
    quality_note = " (of trails)"

    def __init__(self, xy_px: np.ndarray) -> None:
        self.xy_px = np.asarray(xy_px, dtype=np.float64)

    def __len__(self) -> int:
        return len(self.xy_px)


def reference_of(direction_eq: np.ndarray, star_id: object = None) -> ReferenceStars:
    stars = SimpleNamespace(direction_eq=direction_eq, star_id=star_id, catalogue="bsc5")
    return ReferenceStars(stars, np.zeros(3), np.zeros(3), 0.0, None)


def matches(count: int, *, significant: bool = True, **more: object) -> Matches:
    index = np.arange(count)
    usual = {"star": index, "detection": index, "residual_px": np.zeros((count, 2)), "predicted": index}
    chance = 0.0 if significant else 1.0
    solution = PlateSolution(CAMERA, TURN)
    return Matches(
        **{"solution": solution, "predicted_xy_px": np.zeros((count, 2)), "chance": chance, "needed": 9, **usual} | more
    )


def test_rolls_are_tried_from_the_smallest_in_steps_of_a_bin_at_the_corner() -> None:
    rolls = np.array(list(_rolls(Camera(300, 400, 1.0, 1.0, 0.0, 0.0), 7.0)))
    step = 7.0 / 250  # half the diagonal
    count = 5  # 0.14 rad are 8.02 deg
    assert len(rolls) == 2 * count + 1
    np.testing.assert_allclose(np.sort(rolls), np.arange(-count, count + 1) * step, rtol=1e-7)
    assert rolls[0] == 0
    assert (np.diff(np.abs(rolls)) > -1e-12).all()


def sky_around(rng: np.random.Generator, C: np.ndarray, count: int) -> np.ndarray:
    """Return unit vectors spread over 40 deg around the optical axis, equatorial."""
    plane = rng.uniform(-0.85, 0.85, (count, 2))
    rays = np.column_stack([plane, np.ones(count)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True) @ C


def best_square(camera: Camera, xy: np.ndarray, detected: np.ndarray) -> tuple[float, float]:
    """Return the excess and the roll of the square of two by two bins with the most votes."""
    far, bin_px = camera.fx_px * np.tan(np.deg2rad(10)), max(0.008 * camera.width_px, 6.0)
    grown = (camera.width_px + 2 * far) * (camera.height_px + 2 * far) / (camera.width_px * camera.height_px)
    x, y = xy.T
    inside = (
        (x > -0.5 - far) & (y > -0.5 - far) & (x < camera.width_px - 0.5 + far) & (y < camera.height_px - 0.5 + far)
    )
    voters = xy[inside][: min(round(40 * grown), 400)]
    bins = int(np.ceil(2 * far / bin_px)) + 1
    edges = -far + bin_px * np.arange(bins + 1)
    best = (0.0, 0.0, 0.0)
    for roll in _rolls(camera, bin_px):
        relative = (voters - [camera.cx_px, camera.cy_px]) @ [1, 1j] * np.exp(1j * roll)
        offsets = (detected[:80] - [camera.cx_px, camera.cy_px]) @ [1, 1j] - relative[:, np.newaxis]
        offsets = offsets[(np.abs(offsets.real) < far) & (np.abs(offsets.imag) < far)]
        votes = np.histogram2d(offsets.imag, offsets.real, bins=(edges, edges))[0]
        most = convolve2d(votes, np.ones((2, 2)), "valid").max()
        if most > best[0]:
            usual = 4 * len(offsets) / bins**2
            best = (most, (most - usual) / np.sqrt(usual + 1), roll)
    return best[1:]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("camera", "stars"), [(CAMERA, 600), (Camera(500, 400, 450.0, 445.0, 252.0, 203.0), 180)])
def test_votes_find_the_shift_and_the_roll(camera: Camera, stars: int, mirrored: bool) -> None:
    rng = np.random.default_rng(7)
    direction = sky_around(rng, TURN, stars)
    given = PlateSolution(camera, TURN, mirrored)
    turn = matrix_from_quaternion(quaternion_from_turn([0.02, -0.05, 0.07]))
    truth = PlateSolution(camera, turn @ TURN, mirrored)
    xy = truth.project(direction @ truth.C_camera_eq.T)
    seen = xy[camera.contains(xy)]
    detected = np.concatenate([seen[:60], rng.uniform(0, [camera.width_px, camera.height_px], (70, 2))])
    excess, found = _by_votes(Detections(rng.permutation(detected[:75])), reference_of(direction), given)
    off = np.linalg.norm(found.predicted(reference_of(direction)) - xy, axis=1)[camera.contains(xy)]
    # The roll is right to half a bin at the corner, the shift to less than a bin.
    assert np.median(off) < 0.9 * max(0.008 * camera.width_px, 6)
    assert (found.mirrored, found.camera) == (mirrored, camera)
    order = rng.permutation(len(detected))
    expected, _ = best_square(camera, given.predicted(reference_of(direction)), detected[order])
    assert _by_votes(Detections(detected[order]), reference_of(direction), given)[0] == pytest.approx(
        expected, rel=1e-9
    )
    assert expected > 8
    assert excess > expected


def test_three_stars_must_vote_alike() -> None:
    direction = sky_around(np.random.default_rng(1), TURN, 40)
    given = PlateSolution(CAMERA, TURN)
    xy = given.predicted(reference_of(direction))
    on_image = xy[CAMERA.contains(xy)]
    found = _by_votes(Detections(on_image[:3]), reference_of(direction), given)[1]
    np.testing.assert_allclose(found.C_camera_eq, TURN, rtol=0, atol=0.01)
    assert _by_votes(Detections(on_image[:2]), reference_of(direction), given) == (0.0, None)
    nearest = np.argsort(np.linalg.norm(xy - [500, 350], axis=1))
    assert _by_votes(Detections(on_image), reference_of(direction[nearest[:2]]), given) == (0.0, None)
    assert _by_votes(Detections(xy[nearest[:3]]), reference_of(direction[nearest[:3]]), given)[1] is not None
    # Three stars that agree on nothing.
    scattered = Detections([[0, 0], [900, 30], [40, 690]])
    assert _by_votes(scattered, reference_of(direction[nearest[:3]]), given) == (0.0, None)


ORIENTATIONS = [(0, False), (180, False), (0, True), (180, True), (90, False), (270, False), (90, True), (270, True)]


def test_all_orientations_and_focal_lengths_vote_and_twelve_are_refined(monkeypatch) -> None:
    votes, refined = [], []
    ranks = np.random.default_rng(3).permutation(2 * 17 * 8).astype(float)

    def vote(detected, reference, solution):
        votes.append(solution)
        rank = ranks[len(votes) - 1]
        return rank, None if rank == 270 else replace(solution, k1=rank)

    monkeypatch.setattr(hints, "_by_votes", vote)
    wide = PlateSolution(replace(CAMERA, fx_px=500.0), np.eye(3))
    for result, tried in ((None, 12), (matches(5, significant=False), 12), (matches(5), 1)):
        votes.clear()
        refined.clear()

        def refine(detected, reference, solution, result=result):
            refined.append(solution.k1)
            return result

        start = (PlateSolution(CAMERA, TURN), wide)
        found = _best_orientation(Detections(np.zeros((3, 2))), None, start, refine, focal_known=False)
        assert refined == [271, *range(269, 258, -1)][:tried]
        assert (found is None) == (result is None)
        if found is not None:
            turned_deg, mirrored = ORIENTATIONS[int(np.argmax(ranks)) % 8]
            assert found.notes == orientation_notes(np.deg2rad(turned_deg), mirrored)
    factors = [np.exp(0.02 * k) for k in (0, *(s * j for j in range(1, 9) for s in (-1, 1)))]
    k = 0
    for solution in start:
        for factor in factors:
            for turned_deg, mirrored in ORIENTATIONS:
                voted = votes[k]
                assert voted.mirrored is mirrored
                assert voted.camera.fx_px == pytest.approx(solution.camera.fx_px * factor)
                assert voted.camera.fy_px == pytest.approx(890.0 * factor)
                expected = about_z(np.deg2rad(turned_deg)) @ solution.C_camera_eq
                np.testing.assert_allclose(voted.C_camera_eq, expected, rtol=0, atol=1e-12)
                k += 1
    assert k == len(votes)


def test_the_most_matches_are_the_best_and_the_first_significant_ones_end_the_search(monkeypatch) -> None:
    cameras = []

    def vote(detected, reference, solution):
        cameras.append(solution.camera)
        return 1.0, solution

    monkeypatch.setattr(hints, "_by_votes", vote)
    results = [matches(6, significant=False), None, matches(6, significant=False), matches(8), matches(20)]
    answers = iter(results)
    found = _best_orientation(
        Detections(np.zeros((3, 2))), None, (PlateSolution(CAMERA, TURN),), lambda *_: next(answers), focal_known=True
    )
    assert (len(found), next(answers)) == (8, results[4])
    assert cameras == [CAMERA] * 8  # a known focal length is not changed
    # As many as the best are no better: the notes are those of the first.
    answers = iter([matches(6, significant=False), matches(6, significant=False), *[None] * 6])
    found = _best_orientation(
        Detections(np.zeros((3, 2))), None, (PlateSolution(CAMERA, TURN),), lambda *_: next(answers), focal_known=True
    )
    assert (len(found), found.notes) == (6, ())
    assert list(answers) == []  # eight orientations


@pytest.mark.parametrize("focal_known", [True, False])
def test_wide_angle_lenses_are_tried_if_a_pinhole_fails(focal_known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def best(detected, reference, solutions, refine_with, *, focal_known):
        asked.append(([one.camera for one in solutions], refine_with, focal_known))
        return next(answers)

    monkeypatch.setattr(hints, "_best_orientation", best)
    detected = Detections(np.zeros((7, 2)))
    start = PlateSolution(CAMERA, TURN)
    good, bad = matches(12), matches(5, significant=False)
    wide = list(wide_angle_cameras(CAMERA))
    assert len(wide) == 2
    first, second = ([CAMERA], hints.refine, focal_known), (wide, hints.refine_outwards, focal_known)
    for given, expected, calls in (([good], good, [first]), ([bad, good], good, [first, second])):
        asked.clear()
        answers = iter(given)
        assert identify_near(detected, None, start, focal_known=focal_known) is expected
        assert asked == calls
    text = (
        "7 stars were found (of trails), but those of the catalogue within 10 deg of the given attitude are not among"
        " them ({} agree, {} are needed); check time, place, attitude, mount and camera, or leave the attitude out to"
        " search the whole sky"
    )
    few = matches(2, significant=False, needed=3)
    for given, used, needed in (([bad, None], 5, 9), ([None, None], 0, 4), ([bad, few], 2, 4)):
        answers = iter(given)
        with pytest.raises(CalibrationError) as caught:
            identify_near(detected, None, start, focal_known=focal_known)
        assert str(caught.value) == text.format(used, needed)
        assert (caught.value.stars_used, caught.value.stars_needed) == (used, needed)
    # A field beyond a pinhole is not tried as one.
    asked.clear()
    answers = iter([None, good])
    fisheye = replace(start, camera=nominal_camera(1000, 700, 2.6))
    identify_near(detected, None, fisheye, focal_known=focal_known)
    assert [len(cameras) for cameras, *_ in asked] == [0, 4]


def test_the_focal_length_is_known_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    known = []

    def best(*arguments, focal_known):
        known.append(focal_known)
        return matches(12)

    monkeypatch.setattr(hints, "_best_orientation", best)
    identify_near(Detections(np.zeros((7, 2))), None, PlateSolution(CAMERA, TURN))
    assert known == [True]
    monkeypatch.setattr(hints, "refine", lambda *arguments: matches(12))
    mirrored = PlateSolution(CAMERA, TURN, True)
    monkeypatch.setattr(hints, "refine", lambda *arguments: matches(12, solution=mirrored))
    assert identify_again(Detections(np.zeros((7, 2))), None, mirrored).notes == orientation_notes(0, True)


STARS_PX = np.array([[100.0, 80.0], [850.0, 600.0], [200.0, 640.0], [700.0, 90.0], [480.0, 300.0]])
IDS = np.array([11, 22, 33, 44, 55])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("focal_known", [True, False])
def test_labels_give_the_attitude_and_an_unknown_field_of_view(focal_known, mirrored, monkeypatch) -> None:
    fovs_deg = np.geomspace(2.0, 220.0, 222)
    true = CAMERA if focal_known else nominal_camera(1000, 700, np.deg2rad(fovs_deg[150]))
    solution = PlateSolution(true, TURN, mirrored)
    x = 999 - STARS_PX[:, 0] if mirrored else STARS_PX[:, 0]
    direction = true.unit_vectors(np.column_stack([x, STARS_PX[:, 1]])) @ TURN
    seen = []

    def refined(detected, reference, start):
        seen.append(start)
        return matches(3, star=np.array([0, 2, 3]), solution=start)

    monkeypatch.setattr(hints, "refine", refined)
    monkeypatch.setattr(hints, "is_significant", lambda found: len(found) == 3)
    # Labels within 8 px belong to a detection; the last star was not detected.
    moved = np.array([[7.7, 0], [0, -7.7], [3.0, 4.0], [-5, 5], [0, 0]])
    labels = [NamedStar(*xy, star) for xy, star in zip((STARS_PX + moved).tolist(), IDS.tolist(), strict=True)]
    detected = Detections(np.concatenate([STARS_PX[:4], [[488.3, 300.0]]]))
    camera = CAMERA if focal_known else nominal_camera(1000, 700, 1.0)
    found = identify_by_labels(detected, reference_of(direction, IDS), labels[1:], camera, focal_known=focal_known)
    [start] = seen
    assert start.mirrored is mirrored
    np.testing.assert_allclose(start.C_camera_eq, TURN, rtol=0, atol=1e-9)
    assert start.camera == true
    np.testing.assert_allclose(start.project(direction @ start.C_camera_eq.T), STARS_PX, rtol=0, atol=1e-6)
    assert solution.mirrored == start.mirrored
    text = "no star was found at the labels of HR 22, HR 55"
    assert found.notes == (*orientation_notes(0, mirrored), Note(NoteKind.IDENTIFICATION, text))
    complete = identify_by_labels(
        Detections(np.empty((0, 2))), reference_of(direction, IDS), [labels[k] for k in (0, 2, 3)], camera,
        focal_known=focal_known,
    )  # fmt: skip
    # Without detections the labels themselves count.
    assert complete.notes == orientation_notes(0, mirrored)
    assert np.abs(seen[1].C_camera_eq - TURN).max() > 1e-4


def test_labels_must_be_of_stars_and_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    direction = CAMERA.unit_vectors(STARS_PX) @ TURN
    reference = reference_of(direction, IDS)
    detected = Detections(STARS_PX)

    def refused(labels: list[NamedStar]) -> CalibrationError:
        with pytest.raises(CalibrationError) as caught:
            identify_by_labels(detected, reference, labels, CAMERA, focal_known=True)
        return caught.value

    labels = [NamedStar(*xy, star) for xy, star in zip(STARS_PX.tolist(), IDS.tolist(), strict=True)]
    error = refused(labels[:2])
    assert str(error) == "2 labels were given, and an attitude needs 3"
    assert (error.stars_used, error.stars_needed) == (2, 3)
    unknown = [replace(labels[0], star_id=k) for k in (7, 8, 9, 10, 12, 13)]
    error = refused([*labels[:2], *unknown])
    assert str(error) == "the labels name HR 7, HR 8, HR 9, HR 10, HR 12, which the catalogue lacks"
    assert (error.stars_used, error.stars_needed) == (2, 3)
    exchanged = [replace(labels[0], x_px=850.0, y_px=600.0), replace(labels[1], x_px=100.0, y_px=80.0), *labels[2:]]
    for found, count in ((None, 0), (matches(6, significant=False), 6)):
        monkeypatch.setattr(hints, "refine", lambda *arguments, found=found: found)
        error = refused(exchanged)
        assert f"px, and {count} stars of the catalogue match the 5 detected stars (of trails); check" in str(error)
        assert str(error).startswith("the labels contradict each other: with the best attitude their median error is")
        assert (error.stars_used, error.stars_needed) == (count, 4)


def test_labels_outside_of_a_lens_are_left_out() -> None:
    fisheye = Camera(1000, 700, 250.0, 250.0, 499.5, 349.5, lens=Lens("fisheye", (), 1.5))
    xy = np.array([[300.0, 200.0], [600.0, 500.0], [480.0, 300.0], [999.0, 0.0]])
    rays = fisheye.unit_vectors(xy)
    assert np.isnan(rays[3]).all()
    direction = np.nan_to_num(rays, nan=0.5) @ TURN
    found = hints._labelled_by_attitude(xy, direction, fisheye, mirrored=False)
    np.testing.assert_allclose(found.C_camera_eq, TURN, rtol=0, atol=1e-9)
