"""Plate solutions: projection, nominal cameras, refraction that is not known, and whether chance explains matches."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.identify.platesolution import (
    Matches,
    PlateSolution,
    ReferenceStars,
    exceeds_pinhole,
    is_significant,
    nominal_camera,
    orientation_notes,
    require_significant,
    sidereal_trails,
    wide_angle_cameras,
)
from glstar.calibrate.identify.rollingshutter import RowTurns
from glstar.calibrate.notes import Note, NoteKind
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.flight import AttitudeTrack
from glstar.rotation import about_z, matrix_from_quaternion, quaternion_from_turn
from glstar.sky.place.site import Site

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)
TURN = matrix_from_quaternion(quaternion_from_turn([0.3, -0.2, 0.5]))


def reference(**more: object) -> ReferenceStars:
    usual = {"zenith_eq": np.zeros(3), "velocity_eq": np.zeros(3), "refraction_scale": 0.0, "C_ned_eq": None}
    return ReferenceStars(**{"stars": SimpleNamespace(direction_eq=np.eye(3)), **usual} | more)


def test_stars_over_a_site_have_its_zenith_velocity_and_air() -> None:
    field, asked = object(), []

    def rotation(*arguments):
        asked.append(arguments)
        return TURN[np.newaxis]

    sky = SimpleNamespace(
        C_ned_eq=rotation,
        star_field=lambda utc_s: field if utc_s == 5.0 else None,
        refraction_scale=lambda site: 0.1 * site.height_m,
    )
    over = ReferenceStars.over(sky, 5.0, Site(-0.6, 2.4, 9.0))
    assert asked == [([5.0], [-0.6], [2.4])]
    assert (over.stars, over.rows, over.zenith_error_rad) == (field, None, None)
    assert over.refraction_scale == pytest.approx(0.9)
    np.testing.assert_allclose(over.zenith_eq, -TURN[2], rtol=1e-7)
    # A point of the Earth at 34 deg moves east at 384 m/s.
    speed = 7.292115e-5 * np.cos(0.6) * 6378137 / np.sqrt(1 - 0.00669438 * np.sin(0.6) ** 2) / 299792458
    np.testing.assert_allclose(over.velocity_eq, speed * TURN[1], rtol=1e-4)
    np.testing.assert_allclose(over.C_ned_eq, TURN, rtol=1e-7)
    anywhere = ReferenceStars.anywhere(sky, 5.0)
    assert (anywhere.stars, anywhere.refraction_scale, anywhere.C_ned_eq) == (field, 0.0, None)
    assert [anywhere.zenith_eq.tolist(), anywhere.velocity_eq.tolist()] == [[0, 0, 0], [0, 0, 0]]


def test_unknown_refraction_is_an_error_of_focal_length_and_principal_point() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    assert reference(C_ned_eq=np.eye(3)).refraction_error(axis) == (0.0, 0.0)
    assert reference().refraction_error(axis) == pytest.approx((1.55 * 2.8e-4, 1.97 * 2.8e-4))
    for z in (0.4, 1.1):
        zenith = np.array([np.sin(z), 0.0, np.cos(z)])
        known = reference(zenith_eq=zenith, refraction_scale=0.9, zenith_error_rad=0.02)

        # Of 0.9 times the refraction of standard air.
        def focal(z: float) -> float:
            return 0.9 * 2.8e-4 * (1 + 1 / np.cos(z) ** 2) / 2

        def point(z: float) -> float:
            return 0.9 * 2.8e-4 * np.tan(z) / np.cos(z) ** 2

        h = 1e-5
        of_focal, of_point = ((f(z + h) - f(z - h)) / (2 * h) * 0.02 for f in (focal, point))
        assert known.refraction_error(axis) == pytest.approx((of_focal, of_point + 0.02 * point(z)), rel=1e-6)
    # Lower than 11.5 deg above the horizon as there.
    low = reference(zenith_eq=np.array([0.98, 0, 0.1]), refraction_scale=0.9, zenith_error_rad=0.02)
    at_limit = replace(low, zenith_eq=np.array([0.98, 0.0, 0.2]))
    above = replace(low, zenith_eq=np.array([0.97, 0.0, 0.21]))
    assert low.refraction_error(axis) == at_limit.refraction_error(axis)
    assert low.refraction_error(axis)[0] > 1.05 * above.refraction_error(axis)[0]


def test_stars_are_recorded_in_the_attitude_of_their_row() -> None:
    t = np.arange(-20, 21) * 0.01
    turn = np.array([0.5, 0.2, -0.4]) * t[:, np.newaxis]
    rows = RowTurns(AttitudeTrack.from_samples(t, quaternion_from_turn(turn)), 0.0, about_z(0.3), 0.1)
    xy = np.array([[10.0, 479.0], [500.0, 120.0]])
    star = np.array([2, 0])
    still, moving = reference(), reference(rows=rows)
    np.testing.assert_allclose(still.recorded(TURN, star, xy, CAMERA), TURN.T[[2, 0]], rtol=0, atol=1e-12)
    expected = rows.turned(np.eye(3)[star], xy, CAMERA) @ TURN.T
    np.testing.assert_allclose(moving.recorded(TURN, star, xy, CAMERA), expected, rtol=0, atol=1e-12)
    assert not np.allclose(expected, TURN.T[[2, 0]], atol=1e-3, rtol=0)
    solution = PlateSolution(CAMERA, TURN)
    np.testing.assert_allclose(solution.predicted(still), solution.project(TURN.T), rtol=1e-7)
    np.testing.assert_allclose(solution.predicted(moving), solution.placed(np.eye(3), rows), rtol=1e-7)
    np.testing.assert_allclose(solution.placed(np.eye(3), None), solution.project(TURN.T), rtol=1e-7)


@pytest.mark.parametrize("mirrored", [False, True])
def test_k1_moves_positions_up_to_somewhat_beyond_the_corners(mirrored: bool) -> None:
    plane = np.array([[0.2, -0.1], [-0.3, 0.25], [0.9, 0.5], [-1.2, 0.4]])
    rays = np.column_stack([plane, np.ones(4)])
    # The distortion is that of 1.5 times the square of the farthest corner's distance from there on.
    for camera, farthest in (
        (CAMERA, (322.5, 243.5)),
        (replace(CAMERA, cx_px=316.0), (323.5, 243.5)),
        (replace(CAMERA, cy_px=244.0), (322.5, 244.5)),
        (replace(CAMERA, cx_px=316.0, cy_px=244.0), (323.5, 244.5)),
    ):
        found = PlateSolution(camera, TURN, mirrored, -0.2).project(rays)
        most = 1.5 * ((farthest[0] / 700) ** 2 + (farthest[1] / 690) ** 2)
        square = np.minimum((plane**2).sum(axis=1), most)
        assert (square == most).tolist() == [False, False, True, True]
        x = camera.cx_px + 700 * plane[:, 0] * (1 - 0.2 * square)
        y = camera.cy_px + 690 * plane[:, 1] * (1 - 0.2 * square)
        np.testing.assert_allclose(found, np.column_stack([639 - x if mirrored else x, y]), rtol=1e-12)
    behind = PlateSolution(CAMERA, TURN).project(np.array([[0.1, 0.1, -1.0]]))
    assert np.isnan(behind).all()


def test_stars_on_an_image_are_those_within_its_border() -> None:
    rays = CAMERA.unit_vectors(np.array([[100.0, 50], [-3, 50], [500, 400], [650, 20]]))
    found = reference(stars=SimpleNamespace(direction_eq=rays @ TURN))
    index, xy = PlateSolution(CAMERA, TURN).stars_on_image(found)
    assert index.tolist() == [0, 2]
    np.testing.assert_allclose(xy, [[100, 50], [500, 400]], rtol=1e-7)


def test_nominal_cameras_are_pinholes_up_to_140_deg() -> None:
    for fov_deg in (20.0, 140.4):
        camera = nominal_camera(800, 601, np.deg2rad(fov_deg))
        assert camera.lens is None
        assert camera.fx_px == camera.fy_px == pytest.approx(400 / np.tan(np.deg2rad(fov_deg / 2)))
        assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (800, 601, 399.5, 300.0)
        assert not exceeds_pinhole(camera)
    wide = nominal_camera(800, 601, np.deg2rad(140.6))
    assert wide.lens == Lens("fisheye", ())
    assert wide.fx_px == wide.fy_px == pytest.approx(400 / np.deg2rad(70.3))
    assert exceeds_pinhole(wide)
    assert not exceeds_pinhole(replace(wide, lens=Lens("fisheye", (0.01,))))
    assert not exceeds_pinhole(nominal_camera(800, 601, np.deg2rad(140.5)))


def test_wide_angle_lenses_have_the_same_field_of_view() -> None:
    def of(fov_deg: float, width_px: int = 800, height_px: int = 600) -> tuple[Camera, ...]:
        camera = nominal_camera(width_px, height_px, np.deg2rad(fov_deg))
        return wide_angle_cameras(replace(camera, fy_px=0.9 * camera.fx_px))

    assert of(34.9) == ()
    plain, steep = of(35.1)
    half = np.deg2rad(35.1 / 2)
    assert (plain.lens, steep.lens) == (Lens("fisheye", ()), Lens("fisheye", (1 / 6,)))
    assert plain.fx_px == pytest.approx(400 / half)
    assert steep.fx_px == pytest.approx(400 / (half + half**3 / 6))
    assert (plain.fy_px, steep.fy_px) == pytest.approx((0.9 * plain.fx_px, 0.9 * steep.fx_px))
    # Beyond a pinhole the circle of the field may be as high as the image.
    half = np.deg2rad(80.0)
    expected = [side / (half + k * half**3) for side in (400, 300) for k in (0, 1 / 6)]
    assert [camera.fx_px for camera in of(160.0)] == pytest.approx(expected)
    assert len(of(160.0, 600, 600)) == 2
    assert len(of(139.0)) == 2
    assert wide_angle_cameras(replace(CAMERA, fx_px=300.0, lens=Lens("plumb_bob", (0.1,)))) == ()


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_trail_is_the_turn_of_the_sky_during_the_exposure(mirrored: bool) -> None:
    solution = PlateSolution(CAMERA, TURN, mirrored)
    xy = np.array([[100.0, 50.0], [600.0, 300.0], [20.0, 470.0]])
    unmirrored = np.column_stack([639 - xy[:, 0] if mirrored else xy[:, 0], xy[:, 1]])
    rays_eq = CAMERA.unit_vectors(unmirrored) @ TURN
    # Over a camera at rest the sky turns westward, by 15.041 arcsec/s: right ascension zero comes later.
    angle = np.deg2rad(15.041067 / 3600) * 40 / 2
    ends = [solution.project(rays_eq @ about_z(sign * angle) @ TURN.T) for sign in (1.0, -1.0)]
    trails = sidereal_trails(solution, xy, 40.0)
    np.testing.assert_allclose(np.abs(trails), np.abs(ends[1] - ends[0]), rtol=1e-4, atol=1e-6)
    direction = np.array([[0.0, 1.0, 0.0]])  # on the equator, east of right ascension zero
    east = PlateSolution(Camera(100, 80, 300.0, 300.0, 49.5, 39.5), np.array([[0, 0, -1.0], [1, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(east.project(direction @ east.C_camera_eq.T), [[49.5, 39.5]], rtol=1e-7)
    # East is down on this image, so stars move up.
    assert sidereal_trails(east, np.array([[49.5, 39.5]]), 40.0)[0] == pytest.approx(
        [0, -600 * np.tan(angle)], abs=1e-6
    )


def matches(count: int, *, chance: float = 0.0, false_alarm: float = 1.0, bright: int | None = None, **more) -> Matches:
    """Return matches of which the first `bright` are the brightest predicted stars."""
    bright = count if bright is None else bright
    star = np.concatenate([np.arange(bright), np.arange(50, 50 + count - bright)])
    return Matches(
        solution=PlateSolution(CAMERA, TURN, **more),
        star=star,
        detection=np.arange(count),
        residual_px=np.tile([[3.0, 4.0], [1.0, -2.0]], (count, 1))[:count],
        predicted=np.arange(100),
        predicted_xy_px=np.zeros((100, 2)),
        chance=chance,
        false_alarm=false_alarm,
        needed=11,
    )


def test_matches_are_significant_if_chance_explains_neither_their_number_nor_the_bright_ones() -> None:
    assert [is_significant(matches(count)) for count in (3, 4)] == [False, True]
    assert [is_significant(matches(8, chance=chance)) for chance in (1e-9, 1.04e-9)] == [True, False]
    assert [is_significant(matches(8, bright=bright)) for bright in (4, 3)] == [True, False]
    assert [is_significant(matches(8, bright=0, false_alarm=p)) for p in (1e-12, 1.04e-12)] == [True, False]
    assert [is_significant(matches(8, chance=1.0, false_alarm=p)) for p in (1e-12, 1.04e-12)] == [True, False]
    assert not is_significant(matches(3, false_alarm=0.0))
    assert matches(2).rms_px == pytest.approx(np.sqrt((25 + 5) / 2))
    assert len(matches(5)) == 5


def test_insignificant_matches_are_refused_with_the_number_needed() -> None:
    class Detected:
        quality_note = " (of trails)"

        def __len__(self) -> int:
            return 23

    def refused(found: Matches | None) -> CalibrationError:
        with pytest.raises(CalibrationError) as caught:
            require_significant(Detected(), found)
        return caught.value

    text = (
        "23 stars were found (of trails), {} agree with the catalogue, and {} are needed to rule out chance; take a"
        " sharper image of a darker sky, or give time, site and attitude, or --labels"
    )
    for found, used, needed in ((None, 0, 4), (matches(8, chance=1.0), 8, 11)):
        error = refused(found)
        assert str(error) == text.format(used, needed)
        assert (error.stars_used, error.stars_needed) == (used, needed)
    assert refused(replace(matches(3), needed=0)).stars_needed == 4
    accepted = require_significant(Detected(), matches(8, mirrored=True))
    assert accepted.notes == orientation_notes(0, True)
    assert require_significant(Detected(), matches(8)).notes == ()


def test_a_turned_and_a_mirrored_image_are_noted() -> None:
    mirrored = Note(NoteKind.IDENTIFICATION, "the image is mirrored: left and right are exchanged")
    turned = Note(NoteKind.IDENTIFICATION, "the image is turned by 90 deg against the given attitude and mount")
    assert orientation_notes(np.pi / 2, True) == (mirrored, turned)
    assert orientation_notes(np.pi / 2, False) == (turned,)
    assert orientation_notes(0.0, True) == (mirrored,)
    assert orientation_notes(0.0, False) == ()
