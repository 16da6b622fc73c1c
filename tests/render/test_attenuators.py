"""What dims stars and bodies together, satellites as sources at rest, and the view of a lens, by stand-ins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.render.motion.pointing import MotionSamples, Pointing
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene import satellites
from glstar.render.scene.attenuation import Attenuation
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.culling import DrawList, StarCuller
from glstar.render.scene.occlusion import NEVER, rise_and_set
from glstar.render.scene.satellites import SatelliteMotion, Sunlight, passing_satellites
from glstar.render.scene.transmission import Sources, Transmission
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from tests.support.scenes import ADELAIDE, camera, star_field

EXPOSURE = Exposure(1000.0, 8.0)


def turned(angles_rad: np.ndarray) -> Pointing:
    """Return a camera that turns about its second axis, without refraction, under a zenith on that axis."""
    C = Rotation.from_rotvec(np.outer(angles_rad, [0.0, 1.0, 0])).as_matrix()
    zenith = np.tile([0.0, 0.999, np.sqrt(1 - 0.999**2)], (len(C), 1))
    return Pointing(C, zenith, 0 * zenith, 0.0, sine_horizon=-0.5)


def unit(xyz: list[list[float]]) -> np.ndarray:
    vectors = np.array(xyz)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("has_bodies", [True, False])
def test_stars_and_bodies_have_each_their_own_light_in_the_same_segments(has_bodies: bool) -> None:
    trails = AnalyticSegments(turned(np.linspace(0, 0.02, 5)), np.array([0.25, 0.75]))
    stars = star_field(unit([[0.1, 0, 1], [0.2, 0, 1], [0.3, 0, 1]]), np.zeros(3))
    moon = star_field(unit([[0.6, 0, 1], [0.7, 0, 1]]), np.array([-3.0, -2.0]))
    drawn = DrawList(np.array([2, 0], np.int32), np.ones(2))
    bodies = BodySources((), moon, DrawList(np.array([1], np.int32), np.ones(1))) if has_bodies else None
    time = np.linspace(0, 1, 9)[:, np.newaxis]

    def cloud(sources: Sources, times: int) -> np.ndarray:
        assert times == 9
        return 1 - time * sources.direction_eq[:, 0]

    def ridge(sources: Sources, _times: int) -> np.ndarray:
        return np.where(time < 0.5, 1.0, sources.direction_eq[:, 0] > 0.2)

    attenuation = Attenuation(
        cloud=SimpleNamespace(fraction=cloud, min_times=9, max_change=0.1),
        ridge=SimpleNamespace(fraction=ridge, min_times=2, parts=lambda *_: np.array([3, 1])),
    )
    fine, listed, dimmed = attenuation.behind(trails, stars, drawn, bodies)
    # The light of the source that changes most, in the last segment by 0.75 of it; the ridge divides the first in 3.
    largest = 0.7 / np.hypot(0.7, 1) if has_bodies else 0.3 / np.hypot(0.3, 1)
    parts = [max(3, np.ceil(0.25 * largest / 0.1)), np.ceil(0.75 * largest / 0.1)]
    np.testing.assert_allclose(
        fine.time_fraction, np.repeat([0.25, 0.75] / np.array(parts), np.array(parts, int)), rtol=1e-12
    )
    for light, source in ((listed, stars), *([] if dimmed is None else [(dimmed.draw_list, moon)])):
        x = source.direction_eq[light.index][:, 0]
        fraction = (1 - time * x) * np.where(time < 0.5, 1.0, x > 0.2)
        np.testing.assert_allclose(light.passage, Transmission(fraction).means(fine.time_fraction).T, rtol=1e-6)
    assert (dimmed is not None) == has_bodies


def test_bodies_without_stars_are_dimmed_and_bodies_do_not_scintillate() -> None:
    trails = AnalyticSegments(turned(np.linspace(0, 0.02, 3)), np.ones(1))
    stars, none = star_field(unit([[0.1, 0, 1]]), np.zeros(1)), DrawList(np.zeros(0, np.int32), np.zeros(0))
    moon = BodySources((), star_field(unit([[0.6, 0, 1]]), np.zeros(1)), DrawList(np.zeros(1, np.int32), np.ones(1)))
    half = SimpleNamespace(fraction=lambda s, n: np.full((n, len(s.direction_eq)), 0.5), min_times=2, max_change=0.1)
    _, listed, dimmed = Attenuation(cloud=half).behind(trails, stars, none, moon)
    assert (len(listed), listed.passage, dimmed.draw_list.passage.tolist()) == (0, None, [[0.5]])
    # Nothing to dim, and nothing that dims.
    assert Attenuation(cloud=half).behind(trails, stars, none, None) == (trails, none, None)
    assert Attenuation().behind(trails, stars, none, moon) == (trails, none, moon)
    both = Attenuation(cloud=half, scintillation=half)
    assert both.dimmed_bodies(moon, np.ones(1)).draw_list.passage.tolist() == [[0.5]]
    assert both.dimmed(moon.stars, moon.draw_list, np.ones(1)).passage.tolist() == [[0.25]]
    assert both.dimmed_bodies(None, np.ones(1)) is None
    assert both.dimmed(stars, none, np.ones(1)) is none


CIRCLE = replace(camera(1000, 1000, 300.0), lens=Lens("fisheye", (-0.3, 0.0, 0.0, 0.0)))


def test_stars_come_into_the_view_of_a_lens_and_leave_it_at_its_limit() -> None:
    rate, ends = 0.4, np.linspace(0, 1, 9)
    trails = AnalyticSegments(turned(-rate * np.linspace(0, 1, 17)), np.diff(ends))
    limit_rad = view_limit_rad(CIRCLE)
    # Angles from the axis at the start, towards which the camera turns if they are positive.
    start_rad = np.array([limit_rad + 0.1, limit_rad + 0.3, limit_rad + 0.5, -limit_rad + 0.2, 0.0, -limit_rad - 0.1])
    directions = np.column_stack([np.sin(start_rad), 0 * start_rad, np.cos(start_rad)])
    moved = np.abs(start_rad - rate)
    assert (moved < limit_rad).tolist() == [True, True, False, False, True, False]
    expected = [[0.1 / rate, NEVER], [0.3 / rate, NEVER], [NEVER, NEVER], [0, 0.2 / rate], [0, NEVER], [NEVER, NEVER]]
    np.testing.assert_allclose(rise_and_set(trails, directions, CIRCLE), expected, rtol=0, atol=1e-5)
    # A camera without a lens has no such limit.
    np.testing.assert_array_equal(rise_and_set(trails, directions, camera()), np.tile([0.0, NEVER], (6, 1)))


def test_the_sides_of_the_image_are_wider_by_all_that_moves_a_star_between_their_tests() -> None:
    """By the rotation up to the farthest time that is not tested, a step, the drawn radius and refraction."""
    lens, step_rad = camera(320, 240, 300.0), 0.01
    C = Rotation.from_rotvec(np.outer([*range(8), 0], [0.0, -step_rad, 0])).as_matrix()
    zenith = np.tile([0.0, 0, 1], (9, 1))
    pointing = Pointing(C, zenith, 0 * zenith, 0.0)
    border_rad = np.arctan(160 / 300)
    slack_rad = 7 * step_rad + step_rad + np.arctan((8 * 1.5 + 1) / 300) + MAX_REFRACTION_RAD
    angles = border_rad + slack_rad * np.array([0.0, 0.98, 1.02])
    stars = star_field(np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)]), np.ones(3))
    culler = StarCuller(stars, lens, SimpleNamespace(widest_sigma_px=1.5))
    assert culler._within_sides(pointing, step_rad, np.arange(3)).tolist() == [0, 1]
    assert culler._within_sides(pointing, 1.5, np.arange(3)).tolist() == [0, 1, 2]


def moving(directions_eq: np.ndarray, **more) -> SatelliteMotion:
    """Return the motion of a satellite that is in given directions, in the middle in the second of them."""
    view = SimpleNamespace(direction_eq=directions_eq, range_km=np.full(len(directions_eq), 900.0))
    flight = SimpleNamespace(position=SimpleNamespace(coordinates=lambda t: (0 * t, 0 * t, 0 * t)))
    satellite = SimpleNamespace(seen=lambda _sky, t, *_: view, number=7, name="Seven")
    values = {"direction_eq": directions_eq[1], "sun_eq": np.array([0.0, 0, 1]), "brightest_mag": 4.0} | more
    return SatelliteMotion(flight, None, None, 1000.0, 10.0, satellite, **values)


def test_a_satellite_at_rest_is_seen_where_it_moves_to() -> None:
    directions = unit([[0.1, 0.2, 1], [0.15, 0.1, 1], [0.2, -0.3, 1], [0.3, -0.4, 0.9]])
    pointing = replace(turned(np.array([0.0, 0.02, 0.05, 0.07])), velocity_eq=np.array([[1e-6, 2e-6, -1e-6]] * 4))
    samples = MotionSamples(pointing, np.tile([1.0, 0, 0, 0], (4, 1)), ADELAIDE)
    motion = moving(directions)
    rest = motion._turned(samples, np.arange(4.0)).pointing
    seen = rest.to_camera(motion.direction_eq[np.newaxis])[:, 0]
    np.testing.assert_allclose(seen, pointing.each_to_camera(directions), rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        rest.zenith_eq @ motion.direction_eq, np.sum(pointing.zenith_eq * directions, axis=1), rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        rest.pole_eq @ motion.direction_eq, directions[:, 2], rtol=0, atol=1e-14
    )  # the pole is (0, 0, 1)
    np.testing.assert_allclose(rest.pole_eq[1], [0, 0, 1], rtol=0, atol=1e-14)
    field = motion.field(star_field(directions, np.zeros(4)))
    assert (field.star_id.tolist(), field.name, field.vmag.tolist()) == ([7], ("Seven",), [4.0])
    assert field.direction_eq.tolist() == [directions[1].tolist()]


@pytest.mark.parametrize(("duration_s", "times"), [(0.1, 3), (0.49, 3), (0.51, 4), (8.0, 33), (127.9, 513), (500, 513)])
def test_the_light_of_a_satellite_is_computed_four_times_a_second(duration_s: float, times: int) -> None:
    assert Sunlight(moving(unit([[0, 0, 1]] * 2)), Exposure(1000.0, duration_s)).min_times == times


def test_a_satellite_is_as_bright_as_its_lit_fraction_and_its_distance_say(monkeypatch: pytest.MonkeyPatch) -> None:
    def visible(_satellite, _view, _sun_eq):
        return 4.0 + 2.5 * np.arange(33) / 32, np.linspace(1, 0, 33)

    monkeypatch.setattr(satellites, "visible_vmag", visible)
    light = Sunlight(moving(unit([[0, 0, 1]] * 2)), EXPOSURE)
    u = np.arange(33) / 32
    brightness = (1 - u) * 0.1**u
    np.testing.assert_allclose(light.fraction(Sources(np.zeros((1, 3)), np.zeros(0)), 33)[:, 0], brightness, rtol=1e-12)
    assert light.mean == pytest.approx(np.trapezoid(brightness, u), rel=1e-12)


@pytest.mark.parametrize(
    ("sine", "lit", "range_km", "passes"),
    [
        (-0.09, 0.01, 900.0, True),  # refraction and a profile may lift what is little below the horizon
        (-0.11, 1.0, 900.0, False),
        (0.5, 0.0, 900.0, False),
        (0.5, 1.0, np.nan, False),
        (0.5, 1.0, 900.0, True),
    ],
)
def test_a_satellite_passes_if_it_is_up_and_lit_at_some_time(
    monkeypatch: pytest.MonkeyPatch, sine: float, lit: float, range_km: float, passes: bool
) -> None:
    level = np.sqrt(1 - sine**2)
    below, up = [1.0, 0.0, -0.2], [level, 0.0, sine]
    view = SimpleNamespace(direction_eq=np.array([below, below, up]), range_km=np.array([900.0, range_km, 900.0]))
    asked = {}

    def near(_sky, middle_s, span_s, site, middle_eq, angle_rad):
        asked.update(middle_s=middle_s, span_s=span_s, site=site, middle_eq=middle_eq, angle_rad=angle_rad)
        return [SimpleNamespace(seen=lambda _sky, t, *_: asked.update(times_s=t) or view, name="One", number=1)]

    angles = np.linspace(-0.1, 0.3, 9)
    pointing = replace(turned(angles), zenith_eq=np.tile([0.0, 0, 1], (9, 1)))
    motion = SimpleNamespace(
        sky=SimpleNamespace(satellites=SimpleNamespace(near=near)),
        at=lambda times_s: [MotionSamples(pointing, np.zeros((len(times_s), 4)), ADELAIDE)],
        flight=SimpleNamespace(position=SimpleNamespace(coordinates=lambda t: (t, t, t))),
        mount=None,
        pressure_hpa=1000.0,
        temperature_c=10.0,
    )
    sun = SimpleNamespace(direction_eq=np.array([0.0, 1, 0]))
    monkeypatch.setattr(satellites, "observed_bodies", lambda *_: (sun,))
    monkeypatch.setattr(satellites, "visible_vmag", lambda *_: (np.array([5.0, 4.5, 6.0]), np.array([0.0, lit, 0.0])))
    lens = camera()
    found = list(passing_satellites(motion, lens, EXPOSURE))
    assert len(found) == passes
    assert (asked["middle_s"], asked["span_s"]) == (1004.0, 8.0)
    np.testing.assert_array_equal(asked["middle_eq"], pointing.boresight_eq[4])
    assert asked["angle_rad"] == pytest.approx(lens.field_radius_rad + 0.2 + MAX_REFRACTION_RAD, rel=1e-9)
    assert asked["times_s"].tolist() == [1000.0, 1004.0, 1008.0]
    for one in found:
        assert (one.brightest_mag, one.direction_eq.tolist(), one.sun_eq.tolist()) == (4.5, below, [0, 1, 0])


def test_a_sky_without_satellites_has_none() -> None:
    assert list(passing_satellites(SimpleNamespace(sky=SimpleNamespace(satellites=None)), camera(), EXPOSURE)) == []
