"""Expected peaks and areas of the trails of rough flights, against brute force along their true paths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.readout.rows import recorded_positions, recorded_times
from glstar.render.simulator import Simulator
from glstar.render.truth import brightest
from glstar.render.truth.peaks import trail_peaks
from glstar.render.truth.statistics import TrailStatistics
from glstar.rotation import quaternion_from_euler
from glstar.telemetry import open_flight
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(1014, 760, 967.7425)
LAST_PX = np.array([1013.5, 759.5])
EXPOSURE = Exposure(NIGHT_UTC_S + 0.213, 0.5, trail="analytic")
SAMPLES, STEP, STARS = 2400, 8, 24
# Points from which the peak is climbed, and steps of each.
_CLIMBED, _STEPS = 40, 30


def shaken(deg: float, seed: int, turn_deg_per_s: tuple[float, float, float] = (8.0, -3.0, 5.0)) -> Simulator:
    """Return an aircraft that turns at some deg/s and swings by some degrees at three frequencies about each axis."""
    random, t = np.random.default_rng(seed), np.arange(0.0, 1.0, 0.02)
    rate_hz, phase = random.uniform(2, 8, (3, 3, 1)), random.uniform(0, 6, (3, 3, 1))
    angles_deg = deg * np.sin(2 * np.pi * rate_hz * t + phase).sum(axis=1) + np.outer(turn_deg_per_s, t)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, quaternion_from_euler(*np.deg2rad(angles_deg)))
    still = sky_over_adelaide(LENS)
    return Simulator.of(Flight(track, PositionTrack.fixed(ADELAIDE)), still.sky, LENS, Mount(), still.sensor)


def brute_force(path_px: np.ndarray, sigma_px: float) -> tuple[float, float]:
    """Return the largest signal of a path on the image over its flux, and the area of its part on the image."""
    point_px = path_px[::STEP]
    # Of a path beside the image the border is brightest.
    place_px = point_px.clip(-0.5, LAST_PX)
    signal = np.exp(_squares_px2(place_px, path_px) / (-2 * sigma_px**2)).mean(axis=1) / (2 * np.pi * sigma_px**2)
    # Between two parts of the path there may be more light than on either: mean shifts climb there.
    top_px = place_px[np.argsort(signal)[-_CLIMBED:]]
    for _ in range(_STEPS):
        near = np.exp(_squares_px2(top_px, path_px) / (-2 * sigma_px**2))
        top_px = ((near @ path_px) / near.sum(axis=1, keepdims=True)).clip(-0.5, LAST_PX)
    climbed = near.mean(axis=1).max() / (2 * np.pi * sigma_px**2)
    return max(signal.max(), climbed), LENS.contains(point_px).mean() / _overlap_on_image(point_px, path_px, sigma_px)


def _squares_px2(first_px: np.ndarray, second_px: np.ndarray) -> np.ndarray:
    """Return the squared distances of each of n points to each of m, (n, m); a sum over an axis of 2 is far slower."""
    x, y = (np.subtract.outer(first_px[:, k], second_px[:, k]) for k in range(2))
    return x * x + y * y


def _overlap_on_image(point_px: np.ndarray, path_px: np.ndarray, sigma_px: float) -> float:
    """Return the mean of the light that two stars share on the image, 1/px^2: one at points, one on a path."""
    square_px2 = _squares_px2(point_px, path_px)
    at, near = np.nonzero(square_px2 < (12 * sigma_px) ** 2)
    shared = np.exp(square_px2[at, near] / (-4 * sigma_px**2)) / (4 * np.pi * sigma_px**2)
    # Their product is a Gaussian in the middle between them, whose width is that of a star over sqrt(2).
    for k in range(2):
        middle_px = (point_px[at, k] + path_px[near, k]) / 2
        z = np.array([-0.5 - middle_px, LAST_PX[k] - middle_px]) / sigma_px
        inside, is_close = np.sign(z), np.abs(z) < 5
        inside[is_close] = erf(z[is_close])
        shared *= (inside[1] - inside[0]) / 2
    return float(shared.sum() / square_px2.size)


@pytest.mark.parametrize(
    ("deg", "exposure"),
    [
        (0.3, EXPOSURE),
        (0.3, replace(EXPOSURE, readout_s=0.087)),
        (2.0, EXPOSURE),
        (0.3, replace(EXPOSURE, duration_s=0.15, frames=3, gap_s=0.02)),
    ],
)
def test_expected_peaks_and_areas_of_rough_flights_are_those_of_brute_force(deg, exposure):
    simulator = shaken(deg, seed=4)
    scene = simulator.scene(exposure)
    listed_eq = scene.stars.direction_eq[scene.visible[np.flatnonzero(TrailStatistics(scene).touching)]]
    assert len(listed_eq) > 300
    recorded = recorded_times(scene, listed_eq) if exposure.readout_s else None
    peaks = trail_peaks(scene, listed_eq, recorded=recorded)
    some = np.random.default_rng(0).choice(len(listed_eq), STARS, replace=False)
    paths_px = recorded_positions(
        scene if exposure.frames > 1 else simulator.scene(replace(exposure, path_tolerance_px=0.0)),
        listed_eq[some],
        (np.arange(SAMPLES) + 0.5) / SAMPLES,
    )

    sigma_px, errors = scene.sensor.effective_sigma_px, []
    for star, path_px in zip(some, np.moveaxis(paths_px, 1, 0), strict=True):
        if np.isfinite(path_px).all() and LENS.contains(path_px[::STEP]).any():
            peak, area_px2 = brute_force(path_px, sigma_px)
            errors.append((peaks.peak_fraction_per_px2[star] / peak - 1, peaks.area_px2[star] / area_px2 - 1))

    assert len(errors) >= STARS - 4
    peak_errors, area_errors = np.abs(errors).T
    assert np.median(peak_errors) < 0.003
    assert peak_errors.max() < 0.02
    assert np.median(area_errors) < 0.005
    assert np.quantile(area_errors, 0.9) < 0.02


def test_stars_beside_the_border_are_brightest_on_it() -> None:
    """Half of their trails and more is beside the image; the brightest place is often the border itself."""
    errors = []
    for seed in (0,):
        simulator = shaken(0.3, seed=seed)
        scene = simulator.scene(EXPOSURE)
        statistics = TrailStatistics(scene)
        across = np.flatnonzero((statistics.on_image > 0.1) & (statistics.on_image < 0.6))
        listed_eq = scene.stars.direction_eq[scene.visible[across]]
        peaks, sigma_px = trail_peaks(scene, listed_eq), scene.sensor.effective_sigma_px
        exact = simulator.scene(replace(EXPOSURE, path_tolerance_px=0.0))
        paths_px = recorded_positions(exact, listed_eq, (np.arange(SAMPLES) + 0.5) / SAMPLES)
        for star, path_px in enumerate(np.moveaxis(paths_px, 1, 0)):
            if np.isfinite(path_px).all():
                peak, area_px2 = brute_force(path_px, sigma_px)
                errors.append((peaks.peak_fraction_per_px2[star] / peak - 1, peaks.area_px2[star] / area_px2 - 1))

    assert len(errors) > 10
    peak_errors, area_errors = np.abs(errors).T
    assert np.median(peak_errors) < 0.003
    assert peak_errors.max() < 0.03
    assert np.median(area_errors) < 0.01
    assert np.quantile(area_errors, 0.9) < 0.05


@pytest.mark.parametrize("deg", [0.0, 0.03, 0.1, 0.3, 1.0])
def test_light_on_the_image_of_stars_that_shake_on_its_border_is_that_of_the_pixels(deg):
    """A star that stays within some sigma of the border shares most of its light with itself beside the image."""
    errors = []
    for seed in (1, 2):
        simulator = shaken(deg, seed, (0.0, 0.0, 0.0))
        scene = simulator.scene(EXPOSURE)
        statistics = TrailStatistics(scene)
        across = np.flatnonzero((statistics.on_image > 0.05) & (statistics.on_image < 1))
        if not deg:  # and stars at rest: all of their path is on the image, a part of the light is not
            (centre_px,) = scene.camera.project(scene.shutter[1:2].to_camera(scene.stars.direction_eq[scene.visible]))
            outside_px = scene.camera.distance_outside_px(centre_px)
            across = np.flatnonzero((outside_px < 0) & (outside_px > -2 * scene.sensor.effective_sigma_px))
        listed_eq = scene.stars.direction_eq[scene.visible[across]]
        peaks, sigma_px = trail_peaks(scene, listed_eq), scene.sensor.effective_sigma_px
        exact = simulator.scene(replace(EXPOSURE, path_tolerance_px=0.0))
        paths_px = recorded_positions(exact, listed_eq, (np.arange(SAMPLES) + 0.5) / SAMPLES)
        for star, path_px in enumerate(np.moveaxis(paths_px, 1, 0)):
            square_per_px2 = statistics.on_image[across[star]] / peaks.area_px2[star]
            errors.append(np.sqrt(square_per_px2 / pixels_of_path(path_px, sigma_px)) - 1)

    assert len(errors) >= 4
    assert np.median(np.abs(errors)) < 0.005
    assert np.max(np.abs(errors)) < 0.02


def pixels_of_path(path_px: np.ndarray, sigma_px: float) -> float:
    """Return the sum over the pixels of the squared signal of a path over its flux, 1/px^2."""
    low, high = np.clip([path_px.min(axis=0) - 6 * sigma_px, path_px.max(axis=0) + 7 * sigma_px], 0, LAST_PX + 0.5)
    across, down = (
        np.exp((np.arange(int(low[axis]), int(high[axis])) - path_px[:, axis, None]) ** 2 / (-2 * sigma_px**2))
        for axis in (0, 1)
    )
    image = down.T @ across / (2 * np.pi * sigma_px**2 * len(path_px))
    return float((image * image).sum())


@pytest.mark.parametrize(("duration_s", "within"), [(0.5, 0.003), (2.0, 0.01), (6.0, 0.02)])
def test_the_noise_of_long_exposures_with_gusts_and_vibration_is_that_of_brute_force(duration_s, within):
    """Paths of 200 to 2400 lines: groups of them are as wide as the vibration."""
    flight = open_flight("fly:orbit?radius_m=300&gusts=severe&vibration=37,0.15;61,0.1,pitch&seed=1")
    still = sky_over_adelaide(LENS)
    position = PositionTrack.fixed(ADELAIDE)
    simulator = Simulator.of(Flight(flight.attitude, position), still.sky, LENS, Mount(), still.sensor)
    exposure = Exposure(flight.attitude.first_s + 20.213, duration_s, trail="analytic")
    scene = simulator.scene(exposure)
    listed_eq = scene.stars.direction_eq[scene.visible[np.flatnonzero(TrailStatistics(scene).touching)]]
    peaks = trail_peaks(scene, listed_eq)
    some = np.random.default_rng(0).choice(len(listed_eq), STARS, replace=False)
    exact = simulator.scene(replace(exposure, path_tolerance_px=0.0))
    paths_px = recorded_positions(exact, listed_eq[some], (np.arange(SAMPLES) + 0.5) / SAMPLES)

    # The ratio is the flux over the root of the area.
    errors = [
        np.sqrt(brute_force(path_px, scene.sensor.effective_sigma_px)[1] / peaks.area_px2[star]) - 1
        for star, path_px in zip(some, np.moveaxis(paths_px, 1, 0), strict=True)
        if np.isfinite(path_px).all() and LENS.contains(path_px[::STEP]).any()
    ]

    assert len(errors) >= STARS - 4
    assert np.median(np.abs(errors)) < within
    assert np.quantile(np.abs(errors), 0.9) < 0.05


@pytest.mark.parametrize(
    "exposure",
    [
        EXPOSURE,
        replace(EXPOSURE, readout_s=0.087),
        replace(EXPOSURE, duration_s=0.15, frames=3, gap_s=0.02),
    ],
)
def test_an_image_without_stars_has_no_peaks(exposure: Exposure) -> None:
    """A camera that points at the ground."""
    scene = shaken(0.3, seed=4).scene(exposure)
    none_eq = np.zeros((0, 3))
    recorded = recorded_times(scene, none_eq) if exposure.readout_s else None

    peaks = trail_peaks(scene, none_eq, recorded=recorded)

    assert peaks.peak_fraction_per_px2.shape == peaks.area_px2.shape == (0,)


def test_lines_far_beside_the_image_leave_finite_signals() -> None:
    """Near the plane of the camera a star moves by a hundred thousand pixels from one time to the next."""
    rng = np.random.default_rng(3)
    step_px = rng.normal(0, 6e4, (2, 50, 40))
    middle_px = np.cumsum(step_px, axis=1) - step_px / 2
    lines = brightest._Lines(middle_px, step_px, np.full((50, 40), 0.02))

    with np.errstate(all="raise", under="ignore"):
        narrow, wide = brightest._signals_and_overlaps(
            lines, brightest._as_gaussians(lines, 1.2), 1.2, np.ones((50, 40), np.bool_)
        )

    # A line of its own: its light per length; 50 lines cross rarely.
    length_px = np.hypot(*step_px)
    alone = 0.02 / (np.sqrt(2 * np.pi) * 1.2 * length_px)
    assert np.all(narrow >= 0.5 * alone)
    assert np.all(narrow.sum(axis=0) <= 50 * alone.sum(axis=0))
    assert np.all(np.isfinite(wide))
