"""Scenes and stacks without a renderer: selections, bodies, displays, and the sums of short exposures."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ExportError
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import AnalyticSegments, SubExposures
from glstar.render.readout.rows import RecordedTimes
from glstar.render.readout.stacking import (
    StackedListing,
    StackedTrails,
    short_seed,
    stacked_frame,
    stacked_frame_keys,
    stacked_segments,
    union,
)
from glstar.render.scene import scene as scene_module
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Frame, ListedStars, Scene
from glstar.sky.air.extinction import Extinction, air_mass
from tests.support.scenes import camera, star_field, stars_at

LENS = camera(40, 30, 200.0)
XY_PX = [(10.0, 12.0), (20.0, 5.0), (33.0, 22.0)]


def scene_of(**changed: object) -> Scene:
    return replace(stars_at(XY_PX, [3.0, 4.0, 5.0], sensor=Sensor(), lens=LENS, n=2), **changed)


def test_a_listing_says_which_stars_are_visible_and_both_are_selected_together() -> None:
    listed = DrawList(np.array([2, 0, 1], np.int32), np.array([9.0, 8, 7]), extinction_mag=np.array([0.1, 0.2, 0.3]))
    drawn = DrawList(np.array([0, 2], np.int32), np.array([3.0, 4]))
    scene = scene_of(draw_list=drawn)
    assert scene.listed is drawn
    assert scene.visible.tolist() == [0, 2]
    assert scene.with_visible(np.array([1])).draw_list.index.tolist() == [2]
    listing = SimpleNamespace(stars=listed, trails="true")
    full = replace(scene, listing=listing)
    assert full.listed is listed
    assert full.visible.tolist() == [2, 0, 1]
    np.testing.assert_allclose(full.observed_mag, [5.1, 3.2, 4.3], rtol=1e-12)
    some = full.with_visible(np.array([True, False, True]))
    assert (some.visible.tolist(), some.draw_list.index.tolist()) == ([2, 1], [2])
    assert isinstance(some.listing, ListedStars)
    assert some.listing.trails == "true"
    assert some.with_visible(slice(1, None)).visible.tolist() == [1]


def test_bodies_are_a_scene_of_their_own() -> None:
    assert scene_of().body_scene is None
    field = star_field(np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    bodies = BodySources((), field, DrawList(np.array([0], np.int32), np.ones(1)))
    plain = scene_of(bodies=bodies).body_scene
    assert (plain.stars is field, plain.draw_list is bodies.draw_list, plain.bodies, plain.listing) == (
        True,
        True,
        None,
        None,
    )
    listing = SimpleNamespace(stars=None, trails="true")
    listed = scene_of(bodies=bodies, listing=listing).body_scene
    assert (listed.listing.stars is bodies.draw_list, listed.listing.trails) == (True, "true")


def test_the_white_of_a_sum_and_the_sensor_of_short_exposures_and_satellites() -> None:
    short = scene_of()
    stack = scene_of(shorts=(short, short), satellites=(short,), exposure=Exposure(0.0, 0.5, frames=3))
    assert (short.white_dn, stack.white_dn) == (255, 765)
    assert replace(stack, exposure=replace(stack.exposure, stack="mean")).white_dn == 255
    other = Sensor(bit_depth=10)
    changed = stack.with_sensor(other)
    assert changed.sensor is other
    assert [part.sensor is other for part in (*changed.shorts, *changed.satellites)] == [True] * 3


def test_heights_above_the_horizon_and_extinction_are_those_of_the_shutter_times() -> None:
    zenith = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    shutter = Pointing(np.tile(np.eye(3), (3, 1, 1)), zenith, np.zeros((3, 3)), 0.0, sine_horizon=-0.1)
    scene = scene_of(shutter=shutter)
    direction = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(scene.above_horizon(direction), [0.64 + 0.1, 0.6 + 0.1], rtol=1e-12)
    np.testing.assert_allclose(scene.above_horizon(direction, 0), [0.9, 0.1], rtol=1e-12)
    np.testing.assert_allclose(scene.above_horizon(direction, 2), [0.7, 0.1], rtol=1e-12)
    assert scene.sine_horizon == -0.1
    assert scene.extinction_mag(0.5) is None
    air = Extinction()
    hazy = replace(scene, extinction=air)
    expected = air.zenith_mag(scene.site.height_m) * air_mass(np.array([0.5, 0.9]))
    np.testing.assert_allclose(hazy.extinction_mag(np.array([0.5, 0.9])), expected, rtol=1e-12)


def test_bodies_are_observed_once_and_those_that_are_drawn_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def observed(sky: object, utc_s: float, site: object, names: tuple[str, ...]) -> tuple[str, ...]:
        asked.append((utc_s, names))
        return tuple(f"new {name}" for name in names)

    monkeypatch.setattr(scene_module, "observed_bodies", observed)
    assert scene_of().observed_bodies(("Sun",)) == ()
    scene = scene_of(observing_sky=object())
    assert scene.observed_bodies(("Sun", "Moon")) == ("new Sun", "new Moon")
    assert scene.observed_bodies(("Sun", "Moon")) == ("new Sun", "new Moon")
    assert asked == [(0.25, ("Sun", "Moon"))]
    sun, moon = (SimpleNamespace(name=name) for name in ("Sun", "Moon"))
    drawn = BodySources((sun, moon), None, None)
    known = scene_of(observing_sky=object(), bodies=drawn)
    assert known.observed_bodies(("Moon",)) == (moon,)
    assert known.observed_bodies(("Moon", "Mars")) == ("new Moon", "new Mars")
    # Those of a stack are at the middle of one of its short exposures.
    assert replace(known, shorts=(known,)).observed_bodies(("Moon",)) == ("new Moon",)


def test_the_scintillation_of_a_stack_is_the_mean_of_its_short_exposures() -> None:
    def factor(value: float | None) -> SimpleNamespace:
        mean = None if value is None else np.array([value, 2 * value])
        return SimpleNamespace(mean_scintillation=lambda _stars, index: None if mean is None else mean[index])

    index = np.array([1, 0])
    one = scene_of(attenuation=factor(0.8))
    np.testing.assert_allclose(one.mean_scintillation(index), [1.6, 0.8], rtol=1e-12)
    stack = replace(one, shorts=(scene_of(attenuation=factor(0.5)), scene_of(attenuation=factor(0.7))))
    np.testing.assert_allclose(stack.mean_scintillation(index), [1.2, 0.6], rtol=1e-12)
    assert scene_of(attenuation=factor(None)).mean_scintillation(index) is None


def test_a_frame_is_shown_from_its_median_to_its_maximum(tmp_path) -> None:
    pixels = np.array([[10, 10, 10], [10, 20, 200]], np.uint16)
    frame = Frame(pixels, Exposure(0.0, 0.5), 0)
    scale = 255 / np.arcsinh(30.0)
    expected = np.floor(np.arcsinh(30 * np.array([[0, 0, 0], [0, 10, 190]]) / 190) * scale + 0.5)
    assert frame.for_display().tolist() == expected.tolist()
    assert frame.for_display().dtype == np.uint8
    # Of an even image nothing is divided by 0.
    assert not Frame(np.full((2, 2), 7, np.uint8), Exposure(0.0, 0.5), 0).for_display().any()
    shown = cv2.imdecode(np.frombuffer(frame._repr_png_(), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shown, expected)
    frame.save(tmp_path / "a.PNG")
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.PNG"), cv2.IMREAD_UNCHANGED), pixels)
    with pytest.raises(ExportError, match=r"a frame is saved as a PNG file; use a name that ends with \.png$"):
        frame.save(tmp_path / "a.jpg")
    with pytest.raises(ExportError, match=r"cannot be written \(No such file or directory\)"):
        frame.save(tmp_path / "none" / "a.png")


def trails(shift: float, n: int) -> SubExposures:
    turns = np.outer(shift + 0.01 * np.arange(n), [0.0, 1.0, 0.0])
    zenith = np.column_stack([turns[:, 1], np.zeros(n), np.ones(n)])
    return SubExposures(Pointing(Rotation.from_rotvec(turns).as_matrix(), zenith, zenith * 1e-6, 0.0))


DIRECTIONS = LENS.unit_vectors(XY_PX)


def test_the_trails_of_a_stack_are_those_of_its_short_exposures_one_after_the_other() -> None:
    each = [trails(0.0, 4), trails(0.05, 4), trails(0.1, 4)]
    stack = StackedTrails(each)
    assert len(stack) == 12
    for name in ("C_camera_eq", "zenith_eq", "velocity_eq"):
        joined = np.concatenate([getattr(one.pointing, name) for one in each])
        np.testing.assert_array_equal(getattr(stack.pointing, name), joined)
    times = np.array([0.0, 0.2, 0.34, 0.66, 0.67, 1.0])
    found = stack.positions(LENS, DIRECTIONS, times)
    for row, (short, within) in enumerate([(0, 0.0), (0, 0.6), (1, 0.02), (1, 0.98), (2, 0.01), (2, 1.0)]):
        expected = each[short].positions(LENS, DIRECTIONS, np.array([within]))[0]
        np.testing.assert_allclose(found[row], expected, rtol=1e-12)
    paths = list(stack.star_paths(LENS, DIRECTIONS, 1.3))
    assert [len(part.time_fraction) for part in paths] == [4, 4, 4]
    np.testing.assert_allclose([part.time_fraction.sum() for part in paths], [1 / 3] * 3, rtol=1e-12)
    segments = AnalyticSegments(trails(0.0, 5).pointing, np.array([0.4, 0.6]))
    conics = list(StackedTrails([segments, segments]).star_paths(LENS, DIRECTIONS, 0.01))
    (alone, *rest) = segments.star_paths(LENS, DIRECTIONS, 0.01)
    assert len(conics) == 2 * (1 + len(rest))
    np.testing.assert_allclose(conics[0].time_fraction, alone.time_fraction / 2, rtol=1e-12)
    np.testing.assert_array_equal(conics[0].sample_counts, alone.sample_counts)


def test_the_stars_of_several_lists_have_their_largest_radius_and_the_extinction_of_the_middle() -> None:
    def of(index: list[int], radius: list[float], mag: list[float] | None) -> DrawList:
        return DrawList(
            np.array(index, np.int32), np.array(radius), extinction_mag=None if mag is None else np.array(mag)
        )

    lists = [of([3, 1], [5.0, 2.0], [0.1, 0.2]), of([1, 7], [4.0, 1.0], [0.3, 0.4]), of([7, 3], [3.0, 6.0], [0.5, 0.6])]
    found = union(lists)
    assert found.index.tolist() == [1, 3, 7]
    assert found.truncation_radius_px.tolist() == [4.0, 6.0, 3.0]
    # Of the middle list, and where that has none, of the first.
    assert found.extinction_mag.tolist() == [0.3, 0.1, 0.4]
    assert union([*lists[:2], of([9], [1.0], None)]).extinction_mag is None
    one, other = (SimpleNamespace(stars=of_stars, trails=name) for of_stars, name in zip(lists[:2], "ab", strict=True))
    listing = StackedListing([one, other])
    assert listing.stars.index.tolist() == [1, 3, 7]
    assert list(listing.trails.shorts) == ["a", "b"]


@pytest.mark.parametrize("stack", ["sum", "mean"])
@pytest.mark.parametrize("has_light", [False, True])
def test_short_exposures_are_added_or_averaged_with_halves_up(stack: str, has_light: bool) -> None:
    each = [np.full((30, 40), value, np.uint8) for value in (10, 11, 13, 24)]
    each[0][2, 3], each[3][4, 5] = 255, 254
    seeds = []

    def render(scene: Scene, *, seed: int) -> Frame:
        seeds.append(seed)
        number = scene.exposure.frames - 11
        light = np.full((30, 40), 1.5 + number, np.float32) if has_light else None
        return Frame(each[number], scene.exposure, seed, light)

    shorts = tuple(scene_of(exposure=Exposure(0.0, 0.5, frames=11 + number)) for number in range(4))
    scene = scene_of(shorts=shorts, exposure=Exposure(0.0, 0.5, frames=4, stack=stack))
    frame = stacked_frame(render, scene, seed=77)
    assert seeds == [short_seed(77, number) for number in range(4)]
    assert seeds[1] == int(np.random.SeedSequence([77, 1]).generate_state(1)[0])
    total = np.sum([one.astype(int) for one in each], axis=0)
    assert frame.pixels.dtype == (np.uint16 if stack == "sum" else np.uint8)
    # 58 / 4 is 14.5.
    np.testing.assert_array_equal(frame.pixels, total if stack == "sum" else np.floor(total / 4 + 0.5))
    assert np.argwhere(frame.saturated).tolist() == [[2, 3]]
    assert (frame.exposure, frame.seed) == (scene.exposure, 77)
    if has_light:
        assert frame.light_dn.dtype == np.float32
        np.testing.assert_allclose(frame.light_dn, 12.0 if stack == "sum" else 3.0, rtol=1e-6)
    else:
        assert frame.light_dn is None


def test_the_keys_and_segments_of_a_stack() -> None:
    exposure = Exposure(50.0, 0.5, frames=2, gap_s=0.25, stack="mean")
    assert stacked_frame_keys(exposure) == {"frames": 2, "gap_s": 0.25, "stack": "mean", "total_s": 1.25}
    assert stacked_frame_keys(exposure.first) == {}
    asked = []

    def pointings(times_s: np.ndarray) -> list[Pointing]:
        asked.append(times_s.tolist())
        turns = np.outer(0.02 * (times_s - 50.0), [0.0, 1.0, 0.0])
        ahead = np.tile([0.0, 0.0, 1.0], (len(times_s), 1))
        return [Pointing(Rotation.from_rotvec(turns).as_matrix(), ahead, 0 * ahead, 0.0)]

    short = scene_of()
    index = np.array([2, 0], np.int32)
    for gap_s, times_s in ((0.25, [50.0, 50.5, 50.75, 51.25]), (0.0, [50.0, 50.5, 51.0])):
        scene = scene_of(exposure=replace(exposure, gap_s=gap_s), shorts=(short, short),
                         motion=SimpleNamespace(pointings=pointings))  # fmt: skip
        found = stacked_segments(scene, index, None)["segments"]
        assert asked.pop() == times_s
        (pointing,) = pointings(np.array([50.0, 50.5, 50.5 + gap_s, 51.0 + gap_s]))
        asked.clear()
        expected = LENS.project(pointing.to_camera(scene.stars.direction_eq[index])).reshape(2, 2, 2, 2)
        np.testing.assert_allclose(found, np.moveaxis(expected, 2, 0), rtol=1e-12)
    assert stacked_segments(replace(scene, motion=None), index, None) == {}
    assert stacked_segments(replace(scene, shorts=()), index, None) == {}
    positions = [np.arange(12.0).reshape(3, 2, 2) + 100 * k for k in range(2)]
    each = tuple(RecordedTimes(*(np.zeros(2),) * 3, one, np.zeros(2)) for one in positions)
    recorded = RecordedTimes(*(np.zeros(2),) * 3, np.zeros((3, 2, 2)), np.zeros(2), each)
    found = stacked_segments(scene, index, recorded)["segments"]
    assert found.shape == (2, 2, 2, 2)
    for star in range(2):
        for number in range(2):
            assert found[star, number].tolist() == positions[number][[0, 2], star].tolist()
