"""Columns of truth of stars at known pixels, and how conditions read, by formulas and sentences written out."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import ElectronModel, Sensor, limiting_mag, noise_equivalent_area_px2
from glstar.camera.vignetting import Vignetting
from glstar.render.motion.starpaths import SampledPaths
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.readout.rows import RecordedTimes
from glstar.render.scene.scene import Frame, Scene
from glstar.render.scene.transmission import Transmission
from glstar.render.truth import conditions as conditions_module
from glstar.render.truth import frame as frame_module
from glstar.render.truth.conditions import LimitingMagnitude, ViewingConditions, limiting_magnitude
from glstar.render.truth.frame import as_current_schema, camera_keys, frame_truth
from glstar.render.truth.peaks import TrailPeaks
from glstar.render.truth.statistics import TrailStatistics
from glstar.sky.air.refraction import refraction_rad
from tests.support.scenes import camera, stars_at

LENS = camera(70, 50, 300.0)
SENSOR = Sensor(psf_sigma_px=1.6, sky_std_dn=3.0, bit_depth=12)
VARIANCE = 1.6**2 + 1 / 12


def moving(sensor: Sensor = SENSOR, n: int = 50) -> Scene:
    """Return a star on the image, one that crosses its left border, one beside the image and one far away."""
    return stars_at([(30.0, 20.0), (1.5, 40.0), (-5.0, 25.0), (-60.0, 10.0)], [3.0, 2.0, 1.0, 0.0], sensor=sensor,
                    lens=LENS, n=n, turn=lambda u: (-0.03 * u, 0.01 * u))  # fmt: skip


def listed(scene: Scene, pixels: np.ndarray | None = None, **of: object) -> list[dict]:
    frame = Frame(np.zeros((50, 70), np.uint16) if pixels is None else pixels, scene.exposure, 0, **of)
    return json.loads(frame_truth(scene, frame, number=0, file="a.png"))["stars"]


def test_stars_have_the_times_centroids_and_saturation_of_their_samples() -> None:
    scene = moving()
    xy = LENS.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))
    pixels = np.zeros((50, 70), np.uint16)
    pixels[round(xy[30, 1, 1]), round(xy[30, 1, 0])] = SENSOR.saturation_dn
    found = {star["star_id"]: star for star in listed(scene, pixels)}
    assert sorted(found) == [1, 2, 3]
    for k in range(3):
        outside = LENS.distance_outside_px(xy[:, k])
        touches = outside < scene.draw_list.truncation_radius_px[k]
        star = found[k + 1]
        assert star["in_frame"] == pytest.approx((outside < 0).mean(), abs=1e-6)
        assert [star["centroid_x_px"], star["centroid_y_px"]] == pytest.approx(
            xy[touches, k].mean(axis=0).tolist(), abs=1e-5
        )
        assert star["saturated"] == (k == 1)
        ends = LENS.project(scene.shutter.to_camera(scene.stars.direction_eq[[k]]))[:, 0]
        np.testing.assert_allclose([star["start"], [star["x_px"], star["y_px"]], star["end"]], ends, rtol=0, atol=1e-6)
        peak = SENSOR.peak_dn(scene.stars.vmag[k], 0.5)
        assert (star["vmag"], star["camera_mag"]) == (scene.stars.vmag[k],) * 2
        assert star["peak_dn"] == pytest.approx(peak, abs=1e-6)
        assert star["flux_dn"] == pytest.approx(2 * np.pi * 1.6**2 * peak, abs=1e-6)
    # Of a stack that is a sum all short exposures add up; where one of them is saturated the image is.
    stack = replace(scene, exposure=replace(scene.exposure, frames=3))
    flags = pixels > 0
    of_stack = {star["star_id"]: star for star in listed(stack, saturated=flags)}
    assert of_stack[1]["peak_dn"] == pytest.approx(3 * found[1]["peak_dn"], abs=1e-5)
    assert of_stack[1]["flux_dn"] == pytest.approx(3 * found[1]["flux_dn"], abs=1e-5)
    assert [of_stack[k]["saturated"] for k in (1, 2, 3)] == [False, True, False]


def test_statistics_are_those_of_the_samples_of_sub_exposures() -> None:
    scene = moving(n=30)
    found = TrailStatistics(scene)
    xy = LENS.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))
    outside = LENS.distance_outside_px(xy)
    touches = outside < scene.draw_list.truncation_radius_px
    np.testing.assert_allclose(found.touching, touches.mean(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.on_image, (outside < 0).mean(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        found.sum_xy.T, np.where(touches[..., np.newaxis], xy, 0.0).mean(axis=0), rtol=0, atol=1e-9
    )
    assert np.isnan(found.centroid[3]).all()
    assert 0.2 < found.touching[2] < 0.9
    assert not found.saturated.any()
    assert found.chosen_nodes_px(np.array([0])) is None
    assert found.recorded is None


def test_the_nodes_of_pieces_of_paths_are_joined_without_their_common_ends() -> None:
    found = TrailStatistics(moving(n=2))
    nodes = np.random.default_rng(1).normal(size=(2, 9, 4))
    found._nodes_px = [nodes[:, :5], nodes[:, 4:7], nodes[:, 6:]]
    np.testing.assert_array_equal(found.chosen_nodes_px(np.array([3, 1])), nodes[:, :, [3, 1]])


PEAKS = TrailPeaks(np.array([0.01, 0.03]), np.array([40.0, 25.0]))


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("stack", ["sum", "mean"])
@pytest.mark.parametrize("is_clouded", [False, True])
def test_the_expected_brightness_is_that_of_a_matched_filter(frames: int, stack: str, is_clouded: bool) -> None:
    exposure = Exposure(0.0, 0.5, frames=frames, stack=stack)
    scene = SimpleNamespace(sensor=SENSOR, exposure=exposure)
    peak, on_image = np.array([100.0, 300.0]), np.array([0.5, 0.0])
    passage = Transmission(np.array([[1.0, 0.5], [0.6, 0.3]])) if is_clouded else None
    found = frame_module._expected(scene, PEAKS, peak, on_image, passage)
    flux, factor = 2 * np.pi * 1.6**2 * peak, frames if stack == "sum" else 1
    np.testing.assert_allclose(found["trail_peak_dn"], flux * factor * [0.01, 0.03], rtol=0, atol=1e-6)
    passed = flux * (np.array([0.8, 0.4]) if is_clouded else 1.0)
    expected = passed[0] * 0.5 / np.sqrt((9 + 1 / 12) * 40 * 0.5) * np.sqrt(frames)
    np.testing.assert_allclose(found["snr"], [expected, 0.0], rtol=0, atol=1e-6)
    assert set(found) == {"trail_peak_dn", "snr"}
    model = ElectronModel(gain_dn_per_e=0.4, sky_e_per_s=50.0)
    counting = SimpleNamespace(sensor=Sensor(psf_sigma_px=1.6, bit_depth=12, electrons=model), exposure=exposure)
    found = frame_module._expected(counting, PEAKS, peak, on_image, passage)
    electrons = passed * on_image / 0.4
    np.testing.assert_allclose(found["flux_e"], electrons * factor, rtol=0, atol=1e-6)
    # Sky, dark current and both parts of the read noise.
    variance = 25.0 + 0.1 + 1.5**2 + 2.8**2
    expected = electrons[0] / np.sqrt(electrons[0] + 20 * variance) * np.sqrt(frames)
    assert found["snr"][0] == pytest.approx(expected, abs=1e-6)
    assert found["snr"][1] == 0.0


def test_what_cloud_transmits_is_listed_at_three_times_and_on_average() -> None:
    passage = Transmission(np.array([[1.0, 0.5], [0.6, 0.123456789], [0.4, 0.7]]))
    found = frame_module._cloud_columns(passage)
    assert {name: values.tolist() for name, values in found.items()} == {
        "cloud_transmission_start": [1.0, 0.5], "cloud_transmission_mid": [0.6, 0.123457],
        "cloud_transmission_end": [0.4, 0.7], "cloud_transmission_mean": [0.65, 0.361728],
    }  # fmt: skip
    assert frame_module._cloud_columns(None) == {}


def test_a_star_beside_the_image_has_the_transmission_of_the_pixel_nearest_to_its_mean() -> None:
    effects = {"lens.vignetting": "polynomial", "lens.vignetting_r2": -0.6}
    scene = SimpleNamespace(sensor=replace(SENSOR, effects=effects), camera=LENS)
    middle = np.array([[30.0, 20.0], [-0.6, 10.0], [np.nan, np.nan], [69.4, 49.4]])
    centroid = np.array([[31.0, 21.0], [-3.0, 12.0], [75.0, 60.0], [0.0, 0.0]])
    places = np.array([[30.0, 20.0], [0.0, 12.0], [69.0, 49.0], [69.4, 49.4]])
    found = frame_module._transmission(scene, middle, centroid)
    np.testing.assert_allclose(found, Vignetting.of(effects).of_stars(LENS, places), rtol=1e-12)
    assert frame_module._transmission(SimpleNamespace(sensor=SENSOR, camera=LENS), middle, centroid) is None


def test_widths_are_listed_where_they_differ() -> None:
    scene = moving()
    assert frame_module._widths(scene, np.array([0])) == {}
    growing = replace(scene, sensor=replace(SENSOR, effects={"sensor.psf_growth": 0.8}))
    widths = frame_module._widths(growing, np.array([0, 1]))["psf_sigma_px"]
    # In steps of 2 %, of which the middle is drawn: proportional to the squared distance from the middle.
    distance = np.hypot(np.array([30.0, 1.5]) - 34.5, np.array([20.0, 40.0]) - 24.5) / (np.hypot(70, 50) / 2)
    exact = 1.6 * (1 + 0.8 * distance**2)
    np.testing.assert_allclose(widths, exact, rtol=0.0101)
    steps = np.log(widths / 1.6) / np.log(1.02) - 0.5
    np.testing.assert_allclose(steps, np.round(steps), rtol=0, atol=1e-4)


def test_the_camera_and_lines_of_earlier_schemas_are_read() -> None:
    plain = {"K": [[300.0, 0.0, 34.5], [0.0, 300.0, 24.5], [0.0, 0.0, 1.0]], "width_px": 70, "height_px": 50}
    assert camera_keys(LENS) == {**plain, "lens": "none", "distortion": []}
    lens = Lens("plumb_bob", (-0.1, 0.02, 0.001, 0.0, 0.0))
    assert camera_keys(replace(LENS, lens=lens)) == {**plain, **lens.keys}
    old = {"schema": "glstar-truth-1", "frame": 3, "stars": [{"hr": 5, "vmag": 1.0}, {"vmag": 2.0, "hr": 6}]}
    assert as_current_schema(old) == {
        "schema": "glstar-truth-2", "frame": 3, "catalogue": "",
        "stars": [{"star_id": 5, "vmag": 1.0}, {"vmag": 2.0, "star_id": 6}],
    }  # fmt: skip
    assert old["stars"][0] == {"hr": 5, "vmag": 1.0}
    new = {"schema": "glstar-truth-2", "stars": [], "catalogue": "bsc5"}
    assert as_current_schema(new) == new
    assert as_current_schema(new) is not new
    with pytest.raises(
        ValueError, match=r"^a line of truth has the schema 'x'; known are glstar-truth-1, glstar-truth-2$"
    ):
        as_current_schema({"schema": "x"})


def conditions(**deg: float | bool) -> ViewingConditions:
    values = {"sun": -30.0, "moon": 20.0, "separation": 65.4, "axis": 80.0, "ground": False} | deg
    return ViewingConditions(
        *np.deg2rad([values["sun"], values["moon"]]).tolist(), 0.347, float(np.deg2rad(values["separation"])),
        float(np.deg2rad(values["axis"])), bool(values["ground"]), Mount(),
    )  # fmt: skip


def test_conditions_read_as_sentences() -> None:
    night = conditions()
    assert night.sun_and_moon == "Sun -30 deg, Moon 20 deg, 35% lit, 65 deg from the axis"
    assert conditions(moon=-0.1).sun_and_moon == "Sun -30 deg, Moon -0 deg"
    assert (night.light, night.warning, night.ground_warning) == ("night", "", "")
    assert conditions(sun=0.4).warning == "day: the Sun is 0 deg up"
    assert conditions(sun=-2.34).warning == "bright twilight: the Sun is 2.3 deg below the horizon"
    assert conditions(sun=-7.0).warning == ""
    assert conditions(sun=12.6, axis=-3.4).warning == (
        "day: the Sun is 13 deg up\nthe camera points at the ground, 3 deg below the horizon (zenith mount)"
    )
    assert conditions(axis=-50.0, ground=True).warning == (
        "the camera sees only the ground (zenith mount): [mount] says how it is mounted"
    )
    assert conditions(axis=0.1).ground_warning == ""


@pytest.mark.parametrize(("values", "text"), [
    ((6.54, 5.21, None), "limit V 6.5 at rest, 5.2 as a trail"),
    ((6.54, np.nan, None), "limit V 6.5 at rest"),
    ((6.54, 5.21, 0.347), "limit V 6.5 at rest, 5.2 as a trail, cloud transmits 35 % on average"),
    ((6.0, np.nan, 0.0), "limit V 6.0 at rest, cloud transmits 0 % on average"),
    ((np.nan, np.nan, 0.5), "no star: the sky saturates"),
])  # fmt: skip
def test_limiting_magnitudes_read_as_a_line(values: tuple[float, float, float | None], text: str) -> None:
    assert LimitingMagnitude(*values).text == text
    assert LimitingMagnitude(5.0, 4.0).cloud_transmission is None


@pytest.mark.parametrize("frames", [1, 4])
@pytest.mark.parametrize("is_ground", [False, True])
@pytest.mark.parametrize("has_cloud", [False, True])
def test_the_limit_is_fainter_by_what_the_air_and_the_cloud_on_the_axis_take(
    monkeypatch: pytest.MonkeyPatch, frames: int, is_ground: bool, has_cloud: bool
) -> None:
    monkeypatch.setattr(conditions_module, "natural_sky_dn", lambda _scene: 0.7)
    monkeypatch.setattr(conditions_module, "axis_transmission", lambda _scene: 0.4)
    monkeypatch.setattr(conditions_module, "frame_transmission", lambda _scene: 0.55)
    monkeypatch.setattr(conditions_module, "cloud_sheet", lambda _sensor, _motion: object() if has_cloud else None)
    monkeypatch.setattr(conditions_module, "_trail_area_px2", lambda _scene, axis: 130.0 + axis[2])
    axis, zenith = np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.0, 1.0])
    shutter = SimpleNamespace(
        zenith_eq=np.stack([-zenith, zenith, -zenith]), boresight_eq=np.stack([-axis, axis, -axis])
    )
    scene = SimpleNamespace(
        shutter=shutter, sensor=SENSOR, exposure=Exposure(0.0, 0.5, frames=frames), motion=None,
        above_horizon=lambda _axis: -0.1 if is_ground else 0.1, extinction_mag=lambda sine: 0.3 / sine,
    )  # fmt: skip
    found = limiting_magnitude(scene)
    lost = 0.0 if is_ground else 0.3 / 0.8 - 2.5 * np.log10(0.4)
    rest = limiting_mag(SENSOR, 0.5, noise_equivalent_area_px2(SENSOR), sky_dn=0.7, frames=frames)
    trail = limiting_mag(SENSOR, 0.5, 130.8, sky_dn=0.7, frames=frames)
    assert found.at_rest_mag == pytest.approx(rest - lost, abs=1e-9)
    assert found.trail_mag == pytest.approx(np.nan if is_ground else trail - lost, abs=1e-9, nan_ok=True)
    assert found.cloud_transmission == (0.55 if has_cloud else None)
    clear = SimpleNamespace(**vars(scene) | {"extinction_mag": lambda _sine: None})
    assert limiting_magnitude(clear).at_rest_mag == pytest.approx(rest - (0 if is_ground else lost - 0.375), abs=1e-9)


STARTS_PX = np.array([(30.0, 20.0), (-4.0, 40.0), (64.3, 25.0)])


def straight(sensor: Sensor = SENSOR) -> Scene:
    """Return three stars that move by 9 px to the right in two segments: one enters the image, one leaves it."""
    scene = moving(sensor, n=1)
    times = np.array([0.0, 0.15, 0.3, 0.65, 1.0])
    xy = STARTS_PX + times[:, np.newaxis, np.newaxis] * [9.0, 2.0]
    rays = LENS.unit_vectors(xy)
    rays /= rays[..., 2:]
    pointing = SimpleNamespace(
        to_camera=lambda _eq: rays, C_camera_eq=np.tile(np.eye(3), (5, 1, 1)),
        rotation_rad=np.zeros(4),
    )  # fmt: skip
    stars = replace(scene.stars, direction_eq=LENS.unit_vectors(xy[2]), star_id=scene.stars.star_id[:3],
                    vmag=scene.stars.vmag[:3], name=("",) * 3)  # fmt: skip
    drawn = replace(scene.draw_list[:3], truncation_radius_px=np.array([5.0, 2.0, 1.5]))
    return replace(scene, stars=stars, draw_list=drawn, trails=AnalyticSegments(pointing, np.array([0.3, 0.7])))


def part_between(low: float, high: float) -> tuple[float, float]:
    """Return the length and the middle of a part of the exposure."""
    return high - low, (high + low) / 2


def test_trails_across_the_border_are_cut_there() -> None:
    scene = straight()
    pixels = np.zeros((50, 70), np.uint16)
    pixels[21, 36], pixels[42, 3], pixels[25, 2] = (SENSOR.saturation_dn,) * 3
    found = TrailStatistics(scene, pixels)
    # The second enters after 3.5 px, its light 2 px before; the third leaves after 5.2 px, its light 1.5 px later.
    np.testing.assert_allclose(found.on_image, [1.0, 1 - 3.5 / 9, 5.2 / 9], rtol=0, atol=1e-3)
    lit = [part_between(0, 1), part_between(1.5 / 9, 1), part_between(0, 6.7 / 9)]
    np.testing.assert_allclose(found.touching, [length for length, _ in lit], rtol=0, atol=1e-3)
    expected = STARTS_PX + np.array([middle for _, middle in lit])[:, np.newaxis] * [9.0, 2.0]
    np.testing.assert_allclose(found.centroid, expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.sum_xy.T, expected * found.touching[:, np.newaxis], rtol=0, atol=1e-3)
    assert found.saturated.tolist() == [True, True, False]
    nodes = found.chosen_nodes_px(np.array([2, 0]))
    assert nodes.shape == (2, 5, 2)
    times = np.array([0.0, 0.15, 0.3, 0.65, 1.0])
    np.testing.assert_allclose(nodes[:, :, 1], [30 + 9 * times, 20 + 2 * times], rtol=1e-9)


@pytest.mark.parametrize("is_sampled", [False, True])
def test_a_rolling_shutter_counts_each_trail_while_its_row_is_open(is_sampled: bool) -> None:
    scene = straight()
    trails = scene.trails
    if is_sampled:
        (paths,) = trails.star_paths(LENS, scene.stars.direction_eq, 1.0)
        along = (np.arange(2000) + 0.5) / 2000
        elapsed = np.where(along < 0.3, along / 0.3, (along - 0.3) / 0.7)
        xy = paths.positions((along >= 0.3).astype(np.intp), elapsed)
        sampled = SampledPaths(np.moveaxis(xy, -1, 0), np.full(2000, 1 / 2000))
        trails = SimpleNamespace(star_paths=lambda *_: iter([sampled]))
    exposure = Exposure(0.0, 0.4, readout_s=0.1)
    opens, closes = np.array([0.0, 0.05, 0.1]), np.array([0.4, 0.45, 0.5])
    recorded = RecordedTimes(opens, closes, closes - opens, np.zeros((3, 3, 2)), np.zeros(3))
    rows = SimpleNamespace(times=lambda _directions: recorded)
    rolling = replace(scene, exposure=exposure, trails=trails)
    pixels = np.zeros((50, 70), np.uint16)
    # The first is there after nine tenths, when its row has closed; the second after a tenth and a half.
    pixels[22, 38], pixels[40, 0], pixels[26, 68] = (SENSOR.saturation_dn,) * 3
    found = TrailStatistics(rolling, pixels, rows)
    assert found.recorded is recorded
    ends = np.column_stack([opens, closes]) / 0.5
    inside = [(0.0, 1.0), (3.5 / 9, 1.0), (0.0, 5.2 / 9)]
    lit = [(0.0, 1.0), (1.5 / 9, 1.0), (0.0, 6.7 / 9)]
    for of, fraction in ((inside, found.on_image), (lit, found.touching)):
        both = np.array([(max(a, c), min(b, d)) for (a, b), (c, d) in zip(of, ends, strict=True)])
        np.testing.assert_allclose(fraction, np.diff(both)[:, 0] / np.diff(ends)[:, 0], rtol=0, atol=2e-3)
    middles = both.mean(axis=1, keepdims=True)
    expected = STARTS_PX + middles * [9.0, 2.0]
    np.testing.assert_allclose(found.centroid, expected, rtol=0, atol=0.02)
    assert found.saturated.tolist() == [False, False, True]
    assert (found.chosen_nodes_px(np.array([0])) is None) == is_sampled


def test_the_sun_and_the_moon_are_those_of_the_middle_of_the_minute_near_the_site(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []
    sun_eq, moon_eq = np.array([0.0, 0.6, -0.8]), np.array([0.8, 0.0, 0.6])
    sun = SimpleNamespace(direction_eq=sun_eq)
    moon = SimpleNamespace(direction_eq=moon_eq, illuminated_fraction=0.3)

    def observed(sky: object, utc_s: float, site: object, names: tuple[str, ...]) -> tuple[object, object]:
        asked.append((utc_s, site.latitude_rad, site.longitude_rad, site.height_m, names))
        return sun, moon

    monkeypatch.setattr(conditions_module, "observed_bodies", observed)
    axis, zenith = np.array([0.0, 0.28, 0.96]), np.array([0.0, 0.0, 1.0])
    shutter = SimpleNamespace(
        zenith_eq=np.stack([-zenith, zenith, -zenith]), boresight_eq=np.stack([-axis, axis, -axis]),
        refraction_scale=0.8, profile=None,
    )  # fmt: skip
    scene = SimpleNamespace(
        shutter=shutter, observing_sky="sky of this test", exposure=Exposure(12_345.0, 8.0), camera=LENS,
        site=SimpleNamespace(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.62)),
        above_horizon=lambda direction: direction[2] + 0.1, C_camera_body=Mount().C_camera_body,
    )  # fmt: skip
    found = conditions_module.viewing_conditions(scene)
    ((utc_s, latitude_rad, longitude_rad, height_m, names),) = asked
    # 12 349 s are in the minute from 12 300 s on; places are in tenths of a degree.
    assert (utc_s, height_m, names) == (12_330.0, 0.0, ("Sun", "Moon"))
    assert np.rad2deg([latitude_rad, longitude_rad]) == pytest.approx([-34.9, 138.6], abs=1e-9)
    assert found.sun_altitude_rad == pytest.approx(np.arcsin(-0.8))
    moon_rad = np.arcsin(0.6)
    assert found.moon_altitude_rad == pytest.approx(moon_rad + refraction_rad(moon_rad, 0.8))
    assert found.moon_illuminated_fraction == 0.3
    assert found.moon_separation_rad == pytest.approx(np.arccos(axis @ moon_eq))
    # The horizon lies 0.1 below the horizontal.
    assert found.axis_altitude_rad == pytest.approx(np.arcsin(0.96) + np.arcsin(0.1))
    assert found.sees_only_ground is False
    assert found.mount == Mount()
    # The image is 0.14 rad high above its middle.
    for axis_rad, only_ground in ((-0.99 * LENS.field_radius_rad, False), (-1.01 * LENS.field_radius_rad, True)):
        assert conditions_module._sees_only_ground(scene, axis_rad) == only_ground
    shutter.profile = object()
    for fraction in (0.0, 0.1):
        monkeypatch.setattr(conditions_module, "sky_fraction", lambda _scene, fraction=fraction: fraction)
        assert conditions_module._sees_only_ground(scene, 0.5) == (fraction == 0)


def test_a_report_joins_the_light_the_limit_and_the_warnings_but_that_of_the_day(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(conditions_module, "limiting_magnitude", lambda _scene: LimitingMagnitude(5.0, 4.0))
    for sun, report in (
        (-30.0, "night: Sun -30 deg, Moon -5 deg; limit V 5.0 at rest, 4.0 as a trail"),
        (-2.0, "civil twilight: Sun -2 deg, Moon -5 deg; limit V 5.0 at rest, 4.0 as a trail; "
               "bright twilight: the Sun is 2.0 deg below the horizon"),
        (12.0, "day: Sun 12 deg, Moon -5 deg; limit V 5.0 at rest, 4.0 as a trail"),
    ):  # fmt: skip
        monkeypatch.setattr(
            conditions_module, "viewing_conditions", lambda _scene, sun=sun: conditions(sun=sun, moon=-5.0)
        )
        assert conditions_module.conditions_report(None) == report
