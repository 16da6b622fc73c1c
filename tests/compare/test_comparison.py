"""Comparison: injected errors of "real" images are recovered, and images that cannot be compared are reported."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import Comparison, FlightComparison, Search, compare_folders, write_comparison
from glstar.compare.coarsealignment import likely_start
from glstar.compare.comparison import chance
from glstar.compare.report import alignment_json, comparison_json, comparison_table
from glstar.errors import ImagesError
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.images import ImageTime, RealImage
from glstar.render.effects import scaled_keys
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.rotation import matrix_from_quaternion, quaternion_from_euler, quaternion_from_turn
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.photometry import brightness_ratio, magnitude_difference
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S

LENS = Camera(380, 285, 363.0, 363.0, 189.5, 142.0)
SENSOR = Sensor(reference_peak_dn=300.0, sky_std_dn=0.6)
EXPOSURE_S = 0.4
STARTS_S = (1.0, 5.2, 8.1, 10.6, 13.3)
# The injected errors.
SCATTER_MAG = 0.42
CLOCK_S = 0.010
TURN_DEG = np.array([0.30, -0.35, 0.20])  # 0.5 deg in all


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    with GLRenderer.headless() as drawing:
        yield drawing


def flown(rate_hz: float, *, rolling: bool = True) -> Flight:
    """Return sixteen seconds of flight in turbulence, sampled at a rate in Hz."""
    t = np.arange(0.0, 16.0, 1 / 240)[:: round(240 / rate_hz)]
    if rolling:
        roll = 0.25 * np.sin(2 * np.pi * t / 5.0) + 0.01 * np.sin(2 * np.pi * 2.1 * t)
        pitch = 0.08 * np.sin(2 * np.pi * t / 3.7)
        yaw = 1.0 + 0.12 * t + 0.1 * np.sin(2 * np.pi * t / 6.1)
    else:
        roll, pitch, yaw = np.full_like(t, 0.05), np.full_like(t, -0.03), np.full_like(t, 1.0)
    attitude = AttitudeTrack(NIGHT_UTC_S + t, quaternion_from_euler(roll, pitch, yaw))
    return Flight(attitude, PositionTrack.fixed(ADELAIDE))


def simulator(flight: Flight, sensor: Sensor = SENSOR) -> Simulator:
    # A limited number of stars, because they would overlap on such a small image.
    return Simulator.of(flight, Sky(StarCatalogue.open("bsc5").brighter_than(4.5)), LENS, Mount(), sensor)


def turned(mount: Mount, turn_deg: np.ndarray) -> Mount:
    C = matrix_from_quaternion(quaternion_from_turn(np.deg2rad(turn_deg)))
    return Mount.from_matrix(C @ mount.C_camera_body)


@dataclass(frozen=True)
class RealSet:
    """Rendered images that serve as real ones, and the simulator that rendered them."""

    images: list[RealImage]
    drawn_by: Simulator


def taken(
    folder: Path,
    renderer: GLRenderer,
    truth: Simulator,
    *,
    clock_s: float = 0.0,
    turn_deg: np.ndarray | None = None,
    scatter_mag: float = 0.0,
    starts_s: tuple[float, ...] = STARTS_S,
) -> RealSet:
    stars = truth.stars
    vmag = stars.vmag + np.random.default_rng(5).normal(0, scatter_mag, len(stars))
    mount = truth.mount if turn_deg is None else turned(truth.mount, turn_deg)
    real = replace(truth, stars=replace(stars, vmag=vmag), mount=mount)
    images = []
    folder.mkdir(parents=True, exist_ok=True)
    for number, start_s in enumerate(starts_s):
        frame = renderer.render(real.scene(Exposure(NIGHT_UTC_S + start_s, EXPOSURE_S)), seed=1000 + number)
        path = folder / f"image_{number:02d}.png"
        cv2.imwrite(str(path), frame.pixels)
        time = ImageTime(NIGHT_UTC_S + start_s + clock_s, "a test", EXPOSURE_S, is_start=True)
        images.append(RealImage(path, time))
    return RealSet(images, real)


def job(simulated: Simulator, renderer: GLRenderer, images: list[RealImage], **search: float) -> FlightComparison:
    return FlightComparison(
        simulated,
        renderer,
        images,
        Exposure(NIGHT_UTC_S, EXPOSURE_S),
        search=Search(**{"most_stars": 16, "time_s": 0.1} | search),
    )


@pytest.fixture(scope="module")
def injected(tmp_path_factory: pytest.TempPathFactory, renderer: GLRenderer) -> RealSet:
    folder = tmp_path_factory.mktemp("injected")
    return taken(folder, renderer, simulator(flown(240)), clock_s=CLOCK_S, turn_deg=TURN_DEG, scatter_mag=SCATTER_MAG)


@pytest.fixture(scope="module")
def compared(injected: RealSet, renderer: GLRenderer) -> Comparison:
    return job(simulator(flown(30)), renderer, injected.images, least_signal=25.0).run()


def paths(real: Simulator, simulated: Simulator, images: list[RealImage], comparison: Comparison) -> list[np.ndarray]:
    """Return the true and the simulated path of each pair's star: two (n, 2) arrays each, px."""
    start_s = {image.path.name: STARTS_S[number] for number, image in enumerate(images)}
    stated_s = {image.path.name: image.time.utc_s for image in images}
    both = []
    for pair in comparison.pairs:
        exposures = Exposure(NIGHT_UTC_S + start_s[pair.image], EXPOSURE_S), Exposure(stated_s[pair.image], EXPOSURE_S)
        star = real.stars.direction_eq[real.stars.star_id == pair.star_id]
        both.append(
            np.stack(
                [
                    LENS.project(source.pointing(exposure.sub_utc_s(120)).to_camera(star))[:, 0]
                    for source, exposure in zip((real, simulated), exposures, strict=True)
                ]
            )
        )
    return both


def intensities(real: Simulator, comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return the peaks of all unsaturated pairs: simulated, and scaled by the catalogue magnitudes, DN."""
    lone = [pair for pair in comparison.pairs if not pair.saturated]
    drawn_mag = dict(zip(real.stars.star_id.tolist(), real.stars.vmag.tolist(), strict=True))
    simulated_dn = np.array([pair.peak_simulated_dn for pair in lone])
    return simulated_dn, simulated_dn * brightness_ratio(
        np.array([drawn_mag[pair.star_id] - pair.vmag for pair in lone])
    )


def test_the_metrics_of_the_paper_recover_the_injected_errors(injected: RealSet, compared: Comparison) -> None:
    real, simulated = injected.drawn_by, simulator(flown(30))
    summary = compared.summary
    star_paths = paths(real, simulated, injected.images, compared)
    # Expected brightness: from the magnitudes that the images were rendered with.
    simulated_dn, true_dn = intensities(real, compared)
    percent = 100 * np.abs(simulated_dn / true_dn - 1).mean()
    peak = summary["peak"]

    assert len(compared.images) == len(STARTS_S)
    assert len(true_dn) > 60
    assert peak["mean_absolute_percentage_error"] == pytest.approx(percent, rel=0.03)
    assert peak["magnitude_error"] == pytest.approx(2.5 * np.log10(1 + percent / 100), rel=0.03)
    scatter_mag = np.std(magnitude_difference(simulated_dn / true_dn), ddof=1)
    assert peak["magnitude_difference_std"] == pytest.approx(scatter_mag, rel=0.03)
    # A clock error changes the shape of trails, which limits the accuracy of their flux to 1 or 2 %.
    assert peak["mean_error_dn"] == pytest.approx((simulated_dn - true_dn).mean(), abs=0.02 * true_dn.mean())
    # Expected centroids: from the true star paths.
    distance_px = np.array([np.linalg.norm(a.mean(axis=0) - b.mean(axis=0)) for a, b in star_paths])
    assert summary["centroid"]["mean_px"] == pytest.approx(distance_px.mean(), rel=0.03)
    assert summary["centroid"]["median_px"] == pytest.approx(np.median(distance_px), rel=0.03)


def test_the_start_value_of_mount_and_clock_is_within_a_degree(tmp_path: Path, renderer: GLRenderer) -> None:
    turn_deg = np.array([1.5, -2.5, 0.0])
    real = taken(tmp_path, renderer, simulator(flown(240)), clock_s=CLOCK_S, turn_deg=turn_deg, starts_s=STARTS_S[:4])
    start_simulator = simulator(flown(30))
    comparing = job(start_simulator, renderer, real.images)
    images = [(exposure, comparing._subtracted_image(image)) for image, exposure in comparing._exposures]

    turn_rad, delay_s = likely_start(images, start_simulator, search_px=80.0, search_s=0.1)

    assert np.rad2deg(turn_rad[:2]) == pytest.approx(turn_deg[:2], abs=0.8)
    assert -delay_s == pytest.approx(CLOCK_S, abs=0.05)


def test_every_pair_is_the_same_star(injected: RealSet, compared: Comparison) -> None:
    for (true, simulated), pair in zip(
        paths(injected.drawn_by, simulator(flown(30)), injected.images, compared), compared.pairs, strict=True
    ):
        shift = simulated.mean(axis=0) - true.mean(axis=0)
        assert np.hypot(*(shift - (pair.shift_x_px, pair.shift_y_px))) < 0.5  # px


def test_clock_and_mount_are_recovered_within_their_uncertainty(injected: RealSet, renderer: GLRenderer) -> None:
    comparing = job(simulator(flown(30)), renderer, injected.images)
    steps: list[tuple[int, int]] = []
    fitted = comparing.align(fit_time=True, fit_mount=True, on_step=lambda *step: steps.append(step))

    assert fitted is not None
    # It has converged before the largest number of iterations.
    assert steps[-1][0] < steps[-1][1]
    assert -fitted.delay_s == pytest.approx(CLOCK_S, abs=0.002)  # s
    assert alignment_json(fitted)["time_offset_change_s"] == pytest.approx(CLOCK_S, abs=0.002)  # s
    assert np.rad2deg(fitted.turn_rad) == pytest.approx(TURN_DEG, abs=0.05)  # deg
    assert abs(-fitted.delay_s - CLOCK_S) < 5 * fitted.delay_std_s + 1e-4
    assert (np.abs(np.rad2deg(fitted.turn_rad) - TURN_DEG) < 5 * np.rad2deg(fitted.turn_std_rad) + 0.002).all()
    assert fitted.delay_std_s < 0.002
    assert turned(Mount(), TURN_DEG).C_camera_body == pytest.approx(fitted.mount.C_camera_body, abs=0.05 * np.pi / 180)
    # With both corrections the trails coincide.
    aligned = comparing.run(fitted)
    assert aligned.summary["shift"]["median_px"] < 0.1
    # The errors have both signs, so their mean is compared to within 3 % of their mean size.
    simulated_dn, true_dn = intensities(injected.drawn_by, aligned)
    error_dn = simulated_dn - true_dn
    assert aligned.summary["peak"]["mean_error_dn"] == pytest.approx(
        error_dn.mean(), abs=0.03 * np.abs(error_dn).mean()
    )
    # The centroid of a saturated trail is biased towards its middle, because its profile is flat.
    star_paths = paths(injected.drawn_by, simulator(flown(30)), injected.images, aligned)
    line = [np.linalg.norm(true.mean(axis=0) - (true.min(axis=0) + true.max(axis=0)) / 2) for true, _ in star_paths]
    sharp = [(pair.baseline_px, px) for pair, px in zip(aligned.pairs, line, strict=True) if not pair.saturated]
    assert np.mean([found for found, _ in sharp]) == pytest.approx(np.mean([px for _, px in sharp]), rel=0.03)


def test_without_injected_errors_the_centroids_agree(tmp_path: Path, renderer: GLRenderer) -> None:
    finely = replace(SENSOR, sky_std_dn=0.3).with_bit_depth(16, scaled_keys())
    truth = simulator(flown(240), finely)
    same = taken(tmp_path, renderer, truth, starts_s=STARTS_S[:3])

    found = job(truth, renderer, same.images, least_signal=60.0).run()

    assert len(found.pairs) > 15
    assert found.summary["centroid"]["mean_px"] < 0.05
    assert found.summary["shift"]["mean_px"] < 0.05
    assert found.summary["peak"]["mean_absolute_percentage_error"] < 1.0
    assert found.images[0].astray == 0


def test_an_aircraft_that_does_not_turn_gives_no_time_offset(tmp_path: Path, renderer: GLRenderer) -> None:
    still = simulator(flown(60, rolling=False))
    images = taken(tmp_path, renderer, still, turn_deg=TURN_DEG, starts_s=(2.0, 9.0)).images

    fitted = job(still, renderer, images).align(fit_time=True, fit_mount=True)

    assert fitted is not None
    assert not fitted.fitted_time
    assert fitted.delay_s == 0
    assert any("hardly turned" in note for note in fitted.notes)
    assert np.rad2deg(fitted.turn_rad) == pytest.approx(TURN_DEG, abs=0.05)


def test_one_steady_turn_does_not_separate_clock_from_mount(tmp_path: Path, renderer: GLRenderer) -> None:
    t = np.arange(0.0, 16.0, 1 / 60)
    turning = AttitudeTrack(NIGHT_UTC_S + t, quaternion_from_euler(0 * t, 0 * t, np.deg2rad(8.0) * t))
    steady = simulator(Flight(turning, PositionTrack.fixed(ADELAIDE)))
    images = taken(tmp_path, renderer, steady, starts_s=(2.0, 6.0, 9.0)).images

    fitted = job(steady, renderer, images).align(fit_time=True, fit_mount=True)

    assert fitted is not None
    assert not fitted.fitted_time
    assert any("turned at the same rate in every image" in note for note in fitted.notes)
    assert np.rad2deg(np.linalg.norm(fitted.turn_rad)) < 0.01


def test_attitude_errors_between_images_widen_the_uncertainty(tmp_path: Path, renderer: GLRenderer) -> None:
    truth = simulator(flown(60, rolling=False))
    rng = np.random.default_rng(3)
    own_deg, wrong = rng.normal(0, 0.1, (5, 3)), []
    for number in range(5):
        wrong += taken(
            tmp_path / str(number), renderer, truth, turn_deg=own_deg[number], starts_s=(1.0 + 2.5 * number,)
        ).images

    fitted = job(truth, renderer, wrong).align(fit_time=False, fit_mount=True)

    assert fitted is not None
    assert np.rad2deg(fitted.attitude_std_rad) == pytest.approx(0.1, rel=0.5)
    assert np.rad2deg(fitted.turn_rad) == pytest.approx(own_deg.mean(axis=0), abs=0.02)
    disagreeing_deg = own_deg.std(axis=0, ddof=1) / np.sqrt(5)
    assert (np.rad2deg(fitted.turn_std_rad) > 0.8 * disagreeing_deg).all()
    assert np.rad2deg(fitted.turn_std_rad).max() < 2 * disagreeing_deg.max()


def test_images_that_cannot_be_compared_are_left_out_with_a_reason(
    tmp_path: Path, injected: RealSet, renderer: GLRenderer
) -> None:
    t = np.arange(0.0, 16.0, 1 / 30)
    steady = flown(30)
    gap = steady.attitude.from_samples(
        NIGHT_UTC_S + t[(t < 5.0) | (t > 6.0)], steady.attitude.q_body_ned[(t < 5.0) | (t > 6.0)]
    )
    rng = np.random.default_rng(1)

    def image(name: str, pixels: np.ndarray, start_s: float = 1.0) -> RealImage:
        cv2.imwrite(str(tmp_path / name), pixels)
        return RealImage(tmp_path / name, ImageTime(NIGHT_UTC_S + start_s, "a test", EXPOSURE_S, is_start=True))

    sky = np.rint(rng.normal(16, 3, (285, 380)).clip(0)).astype(np.uint8)
    cloud = (
        np.rint(cv2.GaussianBlur(rng.normal(0, 400, (285, 380)), (0, 0), 12) + sky + 40).clip(0, 255).astype(np.uint8)
    )
    bad = [
        image("empty.png", sky),
        image("cloud.png", cloud),
        image("day.png", np.full((285, 380), 255, np.uint8)),
        image("large.png", np.zeros((300, 400), np.uint8)),
        image("deep.png", np.zeros((285, 380), np.uint16)),
        image("early.png", sky, start_s=-30.0),
        image("late.png", sky, start_s=15.9),
    ]
    (tmp_path / "broken.png").write_bytes((tmp_path / "empty.png").read_bytes()[:2000])
    bad.append(RealImage(tmp_path / "broken.png", bad[0].time))
    attitude = replace(steady, attitude=gap)
    comparing = FlightComparison(
        simulator(attitude),
        renderer,
        [*injected.images[:2], *bad],
        Exposure(NIGHT_UTC_S, EXPOSURE_S),
        problems=["IMG_0001.jpg: no time: no table, EXIF or file name gives one"],
    )

    found = comparing.run()

    reasons = {one.file: one.reason for one in found.left_out}
    assert [seen.file for seen in found.images] == ["image_00.png"]
    assert "meets a data gap" in reasons.pop("image_01.png")
    assert "no time" in reasons.pop("IMG_0001.jpg")
    assert "could be found" in reasons.pop("empty.png")
    assert "cloud" in reasons.pop("cloud.png")
    assert "sensor's limit" in reasons.pop("day.png")
    assert "400 x 300 px and the camera 380 x 285 px" in reasons.pop("large.png")
    assert "bits" in reasons.pop("deep.png")
    assert "30.000 s before the flight" in reasons.pop("early.png")
    assert "after the flight" in reasons.pop("late.png")
    assert "cut off" in reasons.pop("broken.png")
    assert reasons == {}
    with pytest.raises(ImagesError, match="no star of any image could be paired: 1 without a star found"):
        job(simulator(flown(30)), renderer, bad[:1]).run()


def test_the_same_comparison_writes_the_same_files(
    tmp_path: Path, injected: RealSet, renderer: GLRenderer, compared: Comparison
) -> None:
    again = job(simulator(flown(30)), renderer, injected.images, least_signal=25.0).run()

    first = write_comparison(compared, tmp_path / "first")

    names = ["pairs.csv", "compare.png", "best.png", "worst.png", "index.html", "compare.json"]
    assert [path.name for path in first] == names
    page = first[4].read_text(encoding="utf-8")
    assert f"<tr><td>stars paired on them</td><td>{len(compared.pairs)}</td></tr>" in page
    assert all(f"<td>{label}</td>" in page for label, _ in compared.figures)
    assert page.count('<img class="plot"') == 3
    assert write_comparison(again, tmp_path / "first")[4].read_text(encoding="utf-8") == page
    assert comparison_table(again) == first[0].read_text(encoding="utf-8")
    assert comparison_json(again) == comparison_json(compared)
    facts = json.loads((tmp_path / "first" / "compare.json").read_text(encoding="utf-8"))
    assert facts["pairs"] == len(compared.pairs) == len((tmp_path / "first" / "pairs.csv").read_text().splitlines()) - 1
    assert {star["star_id"] for star in facts["stars"]} == {pair.star_id for pair in compared.pairs}


def test_two_folders_are_compared_by_name_without_a_flight(
    tmp_path: Path, injected: RealSet, renderer: GLRenderer, compared: Comparison
) -> None:
    simulated = simulator(flown(30))
    (tmp_path / "simulated").mkdir()
    for number, image in enumerate(injected.images[:3]):
        frame = renderer.render(simulated.scene(Exposure(image.time.utc_s, EXPOSURE_S)), seed=number)
        cv2.imwrite(str(tmp_path / "simulated" / f"frame_{number:06d}.png"), frame.pixels)

    found = compare_folders([image.path for image in injected.images], tmp_path / "simulated")

    assert [seen.file for seen in found.images] == [image.path.name for image in injected.images[:3]]
    assert {one.kind for one in found.left_out} == {"without a counterpart"}
    # The identified stars agree with those of the comparison with the flight.
    with_flight = {(pair.image, round(pair.x_px / 4), round(pair.y_px / 4)): pair for pair in compared.pairs}
    both = [
        (pair, with_flight[pair.image, round(pair.x_px / 4), round(pair.y_px / 4)])
        for pair in found.pairs
        if (pair.image, round(pair.x_px / 4), round(pair.y_px / 4)) in with_flight
    ]
    assert len(both) > 10
    assert np.median([np.hypot(a.shift_x_px - b.shift_x_px, a.shift_y_px - b.shift_y_px) for a, b in both]) < 0.15  # px
    assert np.median([a.peak_real_dn / b.peak_real_dn for a, b in both]) == pytest.approx(1, abs=0.1)


def test_a_folder_without_counterparts_gives_a_one_line_error(tmp_path: Path, injected: RealSet) -> None:
    (tmp_path / "sim").mkdir()
    cv2.imwrite(str(tmp_path / "sim" / "other_77.png"), np.zeros((285, 380), np.uint8))

    with pytest.raises(ImagesError, match="no star of any image could be paired: 5 without a counterpart"):
        compare_folders([image.path for image in injected.images], tmp_path / "sim")
    with pytest.raises(ImagesError, match="is not a folder of images"):
        compare_folders([injected.images[0].path], tmp_path / "nowhere")


@pytest.mark.parametrize("turn_deg", [(60.0, 0.0, 0.0), (0.0, 90.0, 40.0), (-45.0, 45.0, 180.0)])
def test_other_stars_near_the_predicted_trails_are_no_comparison(
    injected: RealSet, renderer: GLRenderer, turn_deg: tuple[float, float, float]
) -> None:
    away = replace(simulator(flown(30)), mount=turned(Mount(), np.array(turn_deg)))

    with pytest.raises(ImagesError, match=r"could be found|no predicted star"):
        job(away, renderer, injected.images).run()


@pytest.mark.parametrize(
    ("found", "scatter_px", "is_chance"), [(9, 1.72, True), (9, 0.1, False), (20, 1.72, False), (0, np.nan, False)]
)
def test_a_few_trails_that_do_not_move_together_are_chance(found: int, scatter_px: float, is_chance: bool) -> None:
    # 9 of 26 with 1.72 px: measured in an image of another part of the sky.
    pairing = SimpleNamespace(trails=range(26), found_indices=range(found), scatter_px=scatter_px)

    reason = chance(pairing)

    assert (reason is not None) is is_chance
    assert reason is None or "9 could be found, and these scatter by 1.7 px: other stars, by chance" in reason[1]
