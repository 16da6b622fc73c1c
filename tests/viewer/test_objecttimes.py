"""When an object is in the image, rises and sets; pinned objects; and the stretch and the view of a picture."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.sky.observed.risings import RiseAndSet
from glstar.viewer import skyobjects
from glstar.viewer.picture.view import ColourMap, Histogram, ImageView, Stretch, StretchKind
from glstar.viewer.skyobjects import ObjectKind, Selection, SkyObject, SkySearch, time_in_image_s

STAR = SkyObject(ObjectKind.STAR, "Vega", star_id=7001)
MOON = SkyObject(ObjectKind.BODY, "Moon")


def simulator(*spans_s: tuple[float, float], length_s: float = 100.0, gap_s: tuple[float, float] = (0.0, 0.0)) -> Any:
    """Return a simulator in whose images an object is between some times, s; with a gap of the attitude."""
    asked: list[int] = []

    def pointing(times_s: np.ndarray) -> SimpleNamespace:
        asked.append(len(times_s))
        return SimpleNamespace(to_camera=lambda directions: np.repeat(times_s[:, np.newaxis, np.newaxis], 2, axis=2))

    def contains(xy: np.ndarray) -> np.ndarray:
        return np.any([(xy[..., 0] >= a) & (xy[..., 0] <= b) for a, b in spans_s], axis=0) & (xy[..., 0] > -1)

    attitude = SimpleNamespace(
        first_s=0.0, last_s=length_s, gap_within=lambda a, b: "gap" if gap_s[0] <= a < gap_s[1] else None
    )
    camera = SimpleNamespace(project=lambda vectors: vectors, contains=contains)
    return SimpleNamespace(
        flight=SimpleNamespace(attitude=attitude), camera=camera, pointing=pointing, sky="sky", asked=asked
    )


def test_an_object_is_in_the_image_next_or_was_first() -> None:
    """Sampled every 0.25 s, at most 400 times at once."""
    direction = np.array([0.0, 0.0, 1.0])
    own = simulator((20.1, 30.0), (60.0, 62.0))
    assert time_in_image_s(own, direction, 0.0) == 20.25
    assert time_in_image_s(own, direction, 25.0) == 25.25
    assert time_in_image_s(own, direction, 30.0) == 60.0
    # Not any more: when it was first; never: None.
    assert time_in_image_s(own, direction, 62.0) == 20.25
    assert time_in_image_s(own, direction, 1000.0) == 20.25
    assert time_in_image_s(simulator((200.0, 300.0)), direction, 0.0) is None
    assert time_in_image_s(simulator((20.0, 30.0), gap_s=(20.0, 22.5)), direction, 0.0) == 22.5
    long = simulator((180.0, 181.0), length_s=250.0)
    assert time_in_image_s(long, direction, -1.0) == 180.0
    assert long.asked == [400, 400]


def selection(
    monkeypatch: pytest.MonkeyPatch, selected: SkyObject | None, direction: Any = (0.0, 0.0, 1.0)
) -> Selection:
    made = Selection()
    made.selected = selected
    monkeypatch.setattr(made, "direction_eq", lambda *_: None if direction is None else np.array(direction))
    return made


def test_the_times_of_an_object_are_found_once_for_a_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    own, chosen = simulator((20.1, 21.0), (60.0, 60.6), gap_s=(20.5, 20.9)), selection(monkeypatch, STAR)
    times_s = chosen.times_in_image_s(own, None)
    assert times_s.tolist() == [20.25, 21.0, 60.0, 60.25, 60.5]
    assert chosen.times_in_image_s(own, None) is times_s
    assert own.asked == [400]
    # A flight of an hour has as many samples as one of a quarter of an hour: one a second.
    long = simulator((500.2, 503.0), length_s=3600.0)
    assert chosen.times_in_image_s(long, None).tolist() == [501.0, 502.0, 503.0]
    assert sum(long.asked) == 3600
    chosen.selected = MOON
    assert chosen.times_in_image_s(long, None) is not None
    assert sum(long.asked) == 7200
    assert selection(monkeypatch, None, None).times_in_image_s(own, None) is None


def test_rise_and_set_are_computed_again_after_ten_minutes_or_a_crossing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    ends: list[RiseAndSet] = [RiseAndSet(9000.0, None, is_up=True)]
    monkeypatch.setattr(
        skyobjects, "star_rise_and_set", lambda sky, direction, utc_s, site: asked.append(("star", utc_s)) or ends[0]
    )
    monkeypatch.setattr(
        skyobjects, "body_rise_and_set", lambda sky, name, utc_s, site: asked.append((name, utc_s)) or ends[0]
    )
    chosen, own = selection(monkeypatch, STAR), simulator()

    def at(utc_s: float) -> RiseAndSet | None:
        return chosen.rise_and_set(own, SimpleNamespace(exposure=SimpleNamespace(mid_utc_s=utc_s), site="site"))

    assert at(6000.0) is ends[0]
    at(6599.0)
    assert asked == [("star", 6000.0)]
    at(6600.0)
    assert asked[1:] == [("star", 6600.0)]
    ends[0] = RiseAndSet(6700.0, 6650.0, is_up=True)
    at(7300.0)
    ends[0] = RiseAndSet(7400.0, 7500.0, is_up=True)
    at(7310.0)
    assert len(asked) == 4
    at(7399.0)
    assert len(asked) == 4
    at(7400.0)
    assert len(asked) == 5
    chosen.selected = MOON
    at(7400.0)
    assert asked[-1] == ("Moon", 7400.0)
    assert selection(monkeypatch, None).rise_and_set(own, None) is None
    assert selection(monkeypatch, STAR, None).rise_and_set(own, None) is None


def test_a_selected_object_has_its_direction_body_and_truth_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def direction(target: SkyObject, *what: Any) -> np.ndarray:
        asked.append(target.name)
        if target.name == "faint":
            raise KeyError("faint")
        return np.array([1.0, 0.0, 0.0])

    monkeypatch.setattr(skyobjects, "object_direction_eq", direction)
    monkeypatch.setattr(
        skyobjects, "object_place", lambda scene, direction: SimpleNamespace(message=lambda name: f"{name} there")
    )
    monkeypatch.setattr(skyobjects, "observed_bodies", lambda *what: [what[3]])
    monkeypatch.setattr(
        skyobjects, "_star_truth", lambda scene, star_id, pixels: asked.append(star_id) or {"star_id": star_id}
    )
    scene = SimpleNamespace(stars="stars", site="site", exposure=SimpleNamespace(mid_utc_s=5.0, stop_utc_s=6.0))
    own, chosen = simulator(), Selection()
    faint = SkyObject(ObjectKind.STAR, "faint", star_id=9)
    assert (chosen.direction_eq(own, scene), chosen.place(own, scene), chosen.body(own, scene)) == (None, None, None)
    assert chosen.star_truth(scene, "pixels") is None
    assert chosen.next_in_image_s(own, scene) is None
    assert chosen.select(None, own, scene) == ""
    assert chosen.select(STAR, own, scene) == "Vega there"
    assert chosen.select(faint, own, scene) == ""
    assert chosen.select(MOON, own, scene) == "Moon there"
    assert asked == ["Vega", "faint", "Moon"]
    chosen.direction_eq(own, scene)
    assert len(asked) == 3
    assert chosen.body(own, scene) == ("Moon",)
    assert chosen.star_truth(scene, "pixels") is None
    chosen.select(STAR, own, scene)
    assert chosen.body(own, scene) is None
    asked.clear()
    pixels, others = object(), object()
    for which in (pixels, pixels, others):
        assert chosen.star_truth(scene, which) == {"star_id": 7001}
    assert asked == [7001, 7001]
    # Places of pinned objects are found once for a scene.
    for each in (STAR, faint, MOON):
        chosen.pin(each)
    asked.clear()
    places = chosen.pinned_places(own, scene)
    assert ([place is None for place in places], asked) == ([False, True, False], ["Vega", "faint", "Moon"])
    assert chosen.pinned_places(own, scene) is places
    chosen.pin(STAR)
    assert len(chosen.pinned_places(own, scene)) == 2


def test_a_search_finds_names_numbers_and_the_brightest_first() -> None:
    stars = SimpleNamespace(
        catalogue="bsc5",
        star_id=np.array([2491, 7001, 15, 9107]),
        name=("Sirius", "Vega", "", ""),
        vmag=np.array([-1.5, 0.0, 2.1, 6.0]),
    )
    search = SkySearch(stars)
    sirius = search.star(2491)
    assert (sirius.name, sirius.other_names[-1], sirius.vmag) == ("Sirius", "HR 2491", -1.5)
    assert sirius.label == f"Sirius ({', '.join(sirius.other_names)})"
    assert search.star(98) is None
    assert search.matches("  ") == []
    assert search.matches("sirius")[0] is sirius
    assert search.matches("HR 9107")[0].star_id == 9107
    # A number alone is a star's; with another word it is a name.
    assert search.matches("9107", limit=1)[0].star_id == 9107
    assert search.matches("M31")[0].kind is ObjectKind.DEEP_SKY
    assert search.matches("moon")[0].kind is ObjectKind.BODY
    assert search.matches("ori", limit=2)[0].name == "Orion"
    assert len(search.matches("a", limit=5)) == 5
    assert search.matches("no such name") == []
    unnamed = search.star(9107)
    assert (unnamed.name, unnamed.label) == ("HR 9107", "HR 9107")


# --- stretch and view ---


def test_a_stretch_is_fitted_to_the_sky_and_the_brightest_pixels() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.normal(100.0, 4.0, (1200, 300)).round().astype(np.uint16)
    pixels[::2, ::50] = 700
    fitted = Stretch(boost=9.0, colours=ColourMap.TURBO).fitted(pixels, 1023)
    # Black is a standard deviation below the sky, white at the brightest 0.05 %; of 1200 rows each second is sampled.
    assert fitted.black * 1023 == pytest.approx(96.0, abs=0.5)
    assert fitted.white * 1023 == pytest.approx(700.0)
    assert (fitted.held, fitted.colours, fitted.kind) == (True, ColourMap.TURBO, StretchKind.ASINH)
    dark = np.zeros((10, 10), np.uint8)
    fitted = Stretch().fitted(dark, 255)
    # At least half a digital number of noise, and 20 of them of range.
    assert (fitted.black, fitted.white * 255) == (0.0, pytest.approx(10.0))


def test_a_stretch_is_limited_and_keeps_digital_numbers() -> None:
    stretch = Stretch(StretchKind.LINEAR, boost=4.0, black=0.125)
    assert stretch.white == 0.375
    assert stretch.between(0.5, 0.75) == Stretch(StretchKind.LINEAR, 4.0, 0.5, held=True)
    assert stretch.between(0.5, 0.5).boost == pytest.approx(1e6)
    assert [stretch.brighter(factor).boost for factor in (2.0, 1000.0, 0.001)] == [8.0, 1024.0, 0.125]
    assert stretch.for_white(255, 255) is stretch
    later = stretch.for_white(255, 1020)
    assert (later.boost, later.black) == (16.0, 0.03125)
    np.testing.assert_allclose(stretch(np.array([0.0, 0.25, 0.375, 0.9], np.float32)), [0, 0.5, 1, 1], rtol=1e-6)
    curved = Stretch(StretchKind.ASINH, boost=4.0, black=0.125)(np.float32([0.25]))
    assert float(curved[0]) == pytest.approx(np.arcsinh(4.0) / np.arcsinh(8.0), rel=1e-6)
    assert [each.following for each in ColourMap] == [*list(ColourMap)[1:], ColourMap.GREY]
    assert (Stretch().softening, stretch.softening) == (8.0, 0.0)


def test_the_initial_stretch_shows_stars_of_other_sensors_as_bright() -> None:
    def sensor(peak_dn: float, saturation_dn: int) -> Any:
        return SimpleNamespace(
            peak_dn=lambda vmag, seconds: np.array([peak_dn]) if (vmag, seconds) == ([3.0], 0.5) else None,
            saturation_dn=saturation_dn, background_mean_dn=lambda seconds: 16.0 * seconds / 0.5,
        )  # fmt: skip

    for peak_dn, saturation_dn, boost in (
        (150.0, 255, 5.0),
        (300.0, 255, 5.0),
        (75.0, 255, 10.0),
        (60.0, 1023, 50.15),
        (0.0, 255, 5.0),
    ):
        made = Stretch.for_sensor(sensor(peak_dn, saturation_dn))
        assert made.boost == pytest.approx(boost, rel=1e-4)
        assert made.black == pytest.approx(16 / saturation_dn)


def test_a_view_fits_zooms_and_pans_within_its_picture() -> None:
    view = ImageView()
    view.resize(100, 80, 400.0, 300.0)
    assert (view.zoom, view.centre_px.tolist(), view.middle.tolist()) == (3.75, [49.5, 39.5], [200.0, 150.0])
    assert view.corner == pytest.approx((50 - 200 / 3.75, 40 - 150 / 3.75))
    np.testing.assert_allclose(view.edges(100, 80), [[12.5, 0.0], [387.5, 300.0]], rtol=0, atol=1e-9)
    view.zoom_at([237.5, 150.0], 2.0)
    np.testing.assert_allclose(view.to_picture([237.5, 150.0]), [59.5, 39.5], rtol=0, atol=1e-9)
    assert (view.zoom, view.fitted) == (7.5, False)
    # Another panel leaves the zoom, another picture fits again.
    view.resize(100, 80, 500.0, 300.0)
    assert view.zoom == 7.5
    view.resize(100, 81, 500.0, 0.0)
    assert (view.zoom, view.fitted) == (pytest.approx(1 / 32), True)
    view.resize(2, 1, 5000.0, 3000.0)
    assert view.zoom == 64.0
    view.zoom_at([0.0, 0.0], 1e-9)
    assert view.zoom == 1 / 32
    view.resize(100, 80, 400.0, 300.0)
    view.one_to_one()
    view.pan(30.0, -20.0)
    np.testing.assert_allclose(view.centre_px, [19.5, 59.5], rtol=0, atol=1e-9)
    for delta, centre in ((1e4, [0.0, 0.0]), (-1e4, [99.0, 79.0])):
        view.pan(delta, delta)
        assert view.centre_px.tolist() == centre


def test_a_histogram_has_whole_numbers_in_its_bins() -> None:
    pixels = np.array([[3, 3, 3, 4], [4, 6, 6, 9]], dtype=np.uint8)
    counted = Histogram.of(pixels)
    assert counted.level_dn.tolist() == [3, 4, 5, 6, 7, 8, 9]
    assert (8 * counted.fraction).tolist() == [3, 2, 0, 2, 0, 0, 1]
    # 600 levels on 256 bins are three numbers a bin.
    wide = Histogram.of(np.arange(1000, 1600, dtype=np.uint16)[np.newaxis])
    assert wide.level_dn[:3].tolist() == [1001, 1004, 1007]
    assert len(wide.level_dn) == 200
    np.testing.assert_allclose(wide.fraction, np.full(200, 3 / 600), rtol=1e-12)
    flat = Histogram.of(np.full((3, 4), 7, np.uint8))
    assert flat.level_dn[0] == 7
    assert flat.fraction[0] == 1.0


def test_distances_are_from_the_nearest_point_of_a_trail() -> None:
    # Three positions each of three stars: a corner, one that does not move, and one that is partly off the image.
    xy = np.array(
        [
            [[0.0, 0.0], [3.0, 4.0], [np.nan, np.nan]],
            [[10.0, 0.0], [3.0, 4.0], [6.0, 0.0]],
            [[10.0, 8.0], [3.0, 4.0], [6.0, 5.0]],
        ]
    )
    for position, expected in (
        ((4.0, -3.0), [3.0, np.hypot(1, 7), np.hypot(2, 3)]),
        ((-3.0, -4.0), [5.0, 10.0, np.hypot(9, 4)]),
        ((12.0, 3.0), [2.0, np.hypot(9, 1), 6.0]),
        ((13.0, 12.0), [5.0, np.hypot(10, 8), np.hypot(7, 7)]),
    ):
        np.testing.assert_allclose(skyobjects._distance_to_trail_px(xy, np.array(position)), expected, rtol=1e-9)
    single = skyobjects._distance_to_trail_px(xy[1:2], np.array([10.0, 7.0]))
    np.testing.assert_allclose(single, [7.0, np.hypot(7, 3), np.hypot(4, 7)], rtol=1e-9)
