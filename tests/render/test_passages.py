"""Cloud, scintillation and the horizon in front of stars, with stand-ins for the sheet, the noise and the motion."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.render.motion.pointing import MotionSamples, Pointing
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene import clouds
from glstar.render.scene.attenuation import Attenuation, StarScintillation
from glstar.render.scene.bodies import centre_source, disc_sources
from glstar.render.scene.clouds import CloudCover, cloud_sheet, horizontal_axes, sheet_crossing
from glstar.render.scene.culling import DrawList, _while_seen
from glstar.render.scene.occlusion import NEVER, divided, rise_and_set
from glstar.render.scene.transmission import Sources, Transmission
from glstar.sky.air.extinction import Scintillation
from tests.render.test_scenegeometry import body
from tests.support.scenes import ADELAIDE, camera, star_field

EXPOSURE = Exposure(500.0, 4.0)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def flight_of(latitude: list[float], longitude: list[float], height_m: list[float]) -> SimpleNamespace:
    """Return a flight that goes from one place to another in the exposure, and begins before it."""

    def coordinates(times_s: np.ndarray) -> tuple[np.ndarray, ...]:
        part = (times_s - 500.0) / 4.0
        return tuple(of[0] + part * (of[1] - of[0]) for of in (latitude, longitude, height_m))

    return SimpleNamespace(
        position=SimpleNamespace(coordinates=coordinates), attitude=SimpleNamespace(first_s=496.0, utc_s=np.zeros(0))
    )


@pytest.mark.parametrize(("latitude", "longitude", "height_m", "wind_m_s", "moved_m"), [
    ([0.5, 0.5], [1.0, 1.0], [100.0, 100.0], 60.0, 240.0),
    ([0.5, 0.5], [1.0, 1.0], [100.0, 100.0], -60.0, 240.0),
    ([0.5, 0.5001], [1.0, 1.0], [100.0, 100.0], 10.0, 640.0 + 40),
    ([0.5, 0.5], [1.0, 1.0002], [100.0, 100.0], 10.0, 1280 * np.cos(0.5) + 40),
    ([0.5, 0.50005], [1.0, 1.0], [100.0, 340.0], 0.0, 400.0),
])  # fmt: skip
def test_cloud_is_computed_whenever_it_has_moved_by_an_eighth_of_its_cells(
    latitude: list[float], longitude: list[float], height_m: list[float], wind_m_s: float, moved_m: float
) -> None:
    motion = SimpleNamespace(flight=flight_of(latitude, longitude, height_m))
    for cells, times in ((moved_m / 9.9 * 8, 11), (moved_m / 10.1 * 8, 12), (1e9, 5), (1e-3, 513)):
        sheet = SimpleNamespace(wind_m_s=wind_m_s, cell_m=cells)
        assert CloudCover(sheet, motion, EXPOSURE).min_times == times


class Sheet:
    """A sheet whose transmission says what it was asked for."""

    height_m = 4100.0

    def __init__(self) -> None:
        self.asked: list[int] = []

    def crossed(self, sine: np.ndarray, east: np.ndarray, north: np.ndarray, site: tuple, utc_s: np.ndarray) -> object:
        self.asked.append(len(sine))
        latitude, longitude, height_m = site
        value = sine + 10 * east + 100 * north + latitude + longitude + height_m / 1e4 + utc_s / 1e3
        return SimpleNamespace(transmission=value)


def test_cloud_is_crossed_by_lines_of_sight_at_each_time_and_place_below_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    zenith = unit(rng.normal(size=(6, 3)) * 0.1 + [0.3, 0.2, 0.9])
    directions = unit(rng.normal(size=(7, 3)))
    for pole in (None, unit(rng.normal(size=(6, 3)) * 0.1 + [0.0, 0.1, 1.0])):
        pointing = Pointing(np.tile(np.eye(3), (6, 1, 1)), zenith, np.zeros((6, 3)), 0.0, pole_eq=pole)
        motion = SimpleNamespace(
            flight=flight_of([0.5, 0.6], [1.0, 1.1], [3000.0, 5000.0]), pointings=lambda _t, own=pointing: [own]
        )
        sheet = Sheet()
        expected = np.ones((6, 7))
        times_s = np.linspace(500.0, 504.0, 6)
        latitude, longitude, height_m = motion.flight.position.coordinates(times_s)
        for k in range(3):  # above it, all light arrives
            axis = np.array([0.0, 0.0, 1.0]) if pole is None else pole[k]
            east = unit(np.cross(axis, zenith[k]))
            north = np.cross(zenith[k], east)
            level = np.hypot(directions @ east, directions @ north)
            expected[k] = directions @ zenith[k] + 10 * directions @ east / level + 100 * directions @ north / level
            expected[k] += latitude[k] + longitude[k] + height_m[k] / 1e4 + times_s[k] / 1e3
        for most, blocks in ((8192, [3]), (14, [2, 1])):
            monkeypatch.setattr(clouds, "_MOST_CROSSINGS", most)
            sheet.asked.clear()
            cover = CloudCover(sheet, motion, EXPOSURE)
            found = cover.fraction(Sources(directions, np.zeros(0, np.int32)), 6)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
            assert sheet.asked == blocks
        assert cover.fraction(Sources(directions[:0], np.zeros(0, np.int32)), 6).shape == (6, 0)
    east, north = horizontal_axes(zenith[0])
    np.testing.assert_allclose(np.array([east, north, zenith[0]]) @ np.array([east, north, zenith[0]]).T, np.eye(3),
                               rtol=0, atol=1e-12)  # fmt: skip
    assert (north[2] > 0, abs(east[2]) < 1e-12) == (True, True)
    one = sheet_crossing(Sheet(), directions @ zenith[0], directions, zenith[0], (0.5, 1.0, 30.0), 700.0)
    level = np.hypot(directions @ east, directions @ north)
    value = directions @ zenith[0] + 10 * directions @ east / level + 100 * directions @ north / level + 1.503 + 0.7
    np.testing.assert_allclose(one.transmission, value, rtol=0, atol=1e-9)


def test_the_sheet_has_the_keys_of_the_sensor_and_its_origin_at_a_whole_degree() -> None:
    motion = SimpleNamespace(flight=flight_of([0.5, 0.6], [1.0, 1.1], [0.0, 0.0]))
    effects = {"cloud.coverage": 0.4, "cloud.wind_from_deg": 90.0, "cloud.seed": 7}
    sheet = cloud_sheet(Sensor(effects=effects), motion)
    keys = ("coverage", "optical_depth", "height_m", "scale_m", "edge", "wind_m_s", "seed")
    assert [getattr(sheet, key) for key in keys] == [0.4, 2.0, 4000.0, 2000.0, 1.0, 10.0, 7]
    assert sheet.wind_from_rad == pytest.approx(np.pi / 2)
    # A second before the exposure: 0.4 rad and 0.9 rad are 22.9 deg and 51.6 deg.
    assert sheet.latitude_rad == pytest.approx(np.deg2rad(23), rel=1e-12)
    assert sheet.longitude_rad == pytest.approx(np.deg2rad(52), rel=1e-12)
    plain = cloud_sheet(Sensor(effects={"cloud.coverage": 0.4}), motion)
    assert (plain.wind_from_rad, plain.seed) == (pytest.approx(1.5 * np.pi), 0)
    assert cloud_sheet(Sensor(effects=effects | {"cloud.coverage": 0.0}), motion) is None
    assert cloud_sheet(Sensor(effects=effects | {"cloud.optical_depth": 0.0}), motion) is None
    assert cloud_sheet(Sensor(effects=effects), None) is None


@pytest.mark.parametrize("is_fast", [False, True])
def test_stars_scintillate_by_their_altitude_and_bodies_do_not(is_fast: bool) -> None:
    zenith = np.array([[0.0, 0.0, 1.0]])
    pointing = Pointing(np.eye(3)[np.newaxis], zenith, 0 * zenith, 0.0)
    directions = unit(np.array([[0.1, 0.2, 0.9], [0.8, 0.1, 0.4], [0.0, 0.5, 0.5]]))
    times = []

    def at(times_s: np.ndarray) -> list[MotionSamples]:
        times.extend(times_s.tolist())
        return [MotionSamples(pointing, np.zeros((1, 4)), ADELAIDE)]

    scintillation = Scintillation(0.2, 5)
    one = StarScintillation(scintillation, SimpleNamespace(at=at), EXPOSURE, 1000.0)
    vars(one)["min_times"] = 33 if is_fast else 2
    found = one.fraction(Sources(directions, np.array([11, 12], np.int32)), 33)
    rms = scintillation.rms(directions[:2, 2], ADELAIDE.height_m)
    star_id = np.array([11, 12], np.int32)
    if is_fast:
        expected = scintillation.factors(rms, star_id, 500.0, 4.0, 33)
    else:
        expected = np.tile(scintillation.mean_factors(rms, star_id, 500.0, 4.0), (33, 1))
    np.testing.assert_allclose(found[:, :2], expected, rtol=1e-12)
    assert (found[:, 2] == 1).all()
    assert times == [502.0]
    attenuation = Attenuation(scintillation=one)
    stars = star_field(directions, np.ones(3))
    index = np.array([1, 0], np.int32)
    mean = attenuation.mean_scintillation(stars, index)
    whole = one.fraction(Sources.of(stars, index, None), one.min_times)
    np.testing.assert_allclose(mean, Transmission(whole).mean, rtol=1e-12)
    assert Attenuation().mean_scintillation(stars, index) is None


def test_what_changes_the_light_follows_from_the_keys_of_the_sensor_and_the_sky() -> None:
    profile = object()
    motion = SimpleNamespace(flight=flight_of([0.5, 0.6], [1.0, 1.1], [0.0, 0.0]), sky=SimpleNamespace(profile=None))
    lens = replace(camera(), fx_px=310.0, fy_px=320.0)
    plain = Attenuation.of(motion, lens, Sensor(), EXPOSURE, None)
    assert (plain.sunlight, plain.cloud, plain.scintillation, plain.ridge) == (None,) * 4
    assert plain.attenuators == plain.steady == ()
    motion.sky.profile = profile
    effects = {"cloud.coverage": 0.4, "sky.scintillation": 0.3, "sky.scintillation_seed": 9}
    light = SimpleNamespace(min_times=7)
    full = Attenuation.of(motion, lens, Sensor(effects=effects), EXPOSURE, light)
    assert full.attenuators == (light, full.cloud, full.scintillation, full.ridge)
    assert full.gradual == (light, full.cloud, full.scintillation)
    assert full.steady == (light, full.cloud)
    assert full.cloud.sheet.coverage == 0.4
    assert full.scintillation.scintillation == Scintillation(0.3, 9)
    assert (full.scintillation.px_per_rad, full.ridge.px_per_rad) == (320.0, 320.0)
    assert full.cloud.max_change == full.scintillation.max_change == 0.04


def turning_zenith(times: np.ndarray, rate: float = 0.02) -> Pointing:
    zenith = np.column_stack([np.sin(rate * times), 0 * times, np.cos(rate * times)])
    C = Rotation.from_rotvec(np.outer(0.3 * times, [0.0, 1.0, 0.0])).as_matrix()
    return Pointing(C, zenith, np.zeros((len(times), 3)), 1.0, sine_horizon=0.01)


def dense_times(directions: np.ndarray, lens: Camera) -> list[list[float]]:
    """Return when stars rise and set, by 4000 times."""
    t = (np.arange(4000) + 0.5) / 4000
    pointing = turning_zenith(t)
    is_up = pointing.heights(directions) >= 0
    if lens.lens is not None:
        is_up &= pointing.to_camera(directions, below_horizon=True)[..., 2] > np.cos(view_limit_rad(lens))
    times = []
    for up in is_up.T:
        both = [0.0 if up[0] else NEVER, NEVER]
        for k in np.flatnonzero(up[1:] != up[:-1])[:2]:
            both[int(up[k])] = float(t[k] + t[k + 1]) / 2
        times.append(both)
    return times


@pytest.mark.parametrize("has_lens", [False, True])
def test_stars_rise_and_set_when_their_height_changes_its_sign(has_lens: bool) -> None:
    lens = replace(camera(), lens=Lens("fisheye", (-0.3, 0.0, 0.0, 0.0))) if has_lens else camera()
    trails = AnalyticSegments(turning_zenith(np.arange(17) / 16), np.full(8, 0.125))
    rng = np.random.default_rng(4)
    level = unit(np.column_stack([rng.normal(size=(60, 2)), rng.uniform(-0.025, 0.025, 60)]))
    if has_lens:
        limit = view_limit_rad(lens)
        around = rng.uniform(0, 2 * np.pi, 60)
        off = rng.uniform(limit - 0.3, limit + 0.3, 60)
        high = np.column_stack([np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)])
        level = np.concatenate([level[:20], high])
    found = rise_and_set(trails, level, lens)
    # Behind a lens some graze its limit.
    np.testing.assert_allclose(found, dense_times(level, lens), rtol=0, atol=0.01 if has_lens else 1e-3)
    kinds = {tuple((row == NEVER).tolist()) for row in found}
    assert len(kinds) >= 3


def test_divided_segments_end_where_the_last_one_does() -> None:
    pointing = turning_zenith(np.arange(5) / 4)
    velocity = np.arange(15.0).reshape(5, 3)
    trails = AnalyticSegments(replace(pointing, velocity_eq=velocity, pole_eq=2 * velocity), np.array([0.5, 0.5]))
    fine = divided(trails, np.array([1, 3]))
    assert len(fine) == 4
    for name in ("C_camera_eq", "zenith_eq", "velocity_eq", "pole_eq"):
        values, expected = getattr(fine.pointing, name), getattr(trails.pointing, name)
        assert len(values) == 9
        np.testing.assert_array_equal(values[-1], expected[-1])
    without = divided(replace(trails, pointing=replace(trails.pointing, pole_eq=None)), np.array([1, 3]))
    assert without.pointing.pole_eq is None


def test_a_disc_of_too_many_sources_is_refused_and_a_centre_is_one_source() -> None:
    sigma = 1e-5
    largest = 490 * sigma
    with pytest.raises(ConfigError) as refused:
        disc_sources(body("Sun", radius_rad=1.01 * largest), sigma)
    assert str(refused.value) == (
        "sky.bodies: the disc of the Sun is 990 sigma wide, of at most 980; give a shorter focal length, a wider"
        " psf_sigma_px, or bodies = false"
    )
    moon = body("Moon", radius_rad=0.004)
    stars = star_field(np.array([[0.0, 0, 1]]), np.zeros(1))
    centre = centre_source(moon, stars)
    assert centre.bodies == (moon,)
    assert centre.stars.direction_eq.tolist() == [[0.0, 0.0, 1.0]]
    assert centre.stars.vmag.tolist() == [-10.0]
    assert (centre.draw_list.index.tolist(), centre.draw_list.truncation_radius_px.tolist()) == ([0], [0.0])


def test_stars_that_set_at_the_last_time_are_followed_below_the_horizon() -> None:
    pointing = replace(turning_zenith(np.arange(5) / 4, 0.4), refraction_scale=0.0)
    last = pointing.zenith_eq[-1]
    level = unit(np.cross([0.0, 1.0, 0.0], last))
    setting = unit(np.array([side * level - (0.005 - pointing.sine_horizon) * last for side in (1.0, -1.0)]))
    up = pointing.heights(setting) >= 0
    chosen = setting[[row.tolist() == [True, True, True, True, False] for row in up.T]]
    assert len(chosen) == 1
    seen = _while_seen(pointing, chosen)
    np.testing.assert_allclose(seen, pointing.to_camera(chosen, below_horizon=True), rtol=0, atol=1e-12)


def test_a_ridge_alone_dims_stars_by_the_part_of_the_time_that_they_are_up() -> None:
    trails = AnalyticSegments(turning_zenith(np.arange(5) / 4), np.array([0.5, 0.5]))
    above = np.array([[1.0, 0.0, 1.0], [1.0, 0.5, 0.0], [1.0, 1.0, 0.0]])
    ridge = SimpleNamespace(min_times=3, fraction=lambda _sources, _times: above, parts=lambda *_of: np.array([1, 2]))
    stars = star_field(unit(np.array([[0.1, 0, 1], [0.2, 0, 1], [0.3, 0, 1.0]])), np.zeros(3))
    drawn = DrawList(np.arange(3, dtype=np.int32), np.ones(3))
    fine, listed, bodies = Attenuation(ridge=ridge).behind(trails, stars, drawn, None)
    np.testing.assert_allclose(fine.time_fraction, [0.5, 0.25, 0.25], rtol=1e-12)
    np.testing.assert_allclose(listed.passage, Transmission(above).means(fine.time_fraction).T, rtol=1e-6)
    assert bodies is None
    same = Attenuation().behind(trails, stars, drawn, None)
    assert (same[0] is trails, same[1] is drawn) == (True, True)
