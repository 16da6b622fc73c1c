"""Start values of an alignment: the grids that are searched, and the signal that is correlated, summed star by star."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import coarsealignment
from glstar.compare.coarsealignment import _Correlations, _density, likely_delay_s, likely_readout, likely_start
from glstar.compare.detection import SubtractedImage
from glstar.compare.pairs import CrossCorrelation, shrunk
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn

CAMERA = Camera(300, 201, fx_px=400.0, fy_px=370.0, cx_px=140.0, cy_px=105.0)
SENSOR = Sensor(psf_sigma_px=1.7)
FIRST_S = 1000.0


def searched(monkeypatch: pytest.MonkeyPatch, value, turn) -> list[tuple]:
    """Let a correlation be a function of the exposures; return what the searches were made with."""
    made = []

    class Fake:
        chosen = (1, 2)

        def __init__(self, images, simulator, search_px):
            made.append((len(images), simulator, search_px))

        def best(self, exposures):
            return value(exposures), turn(exposures)

    monkeypatch.setattr(coarsealignment, "_Correlations", Fake)
    return made


def images(count: int) -> list[tuple]:
    return [(Exposure(FIRST_S + 10 * k, 0.1), f"image {k}") for k in range(count)]


def delay_s(exposures) -> float:
    """The common delay of the exposures 1 and 2, or the delay of exposure 0."""
    delays_s = [one.start_utc_s - FIRST_S - 10 * k for k, one in enumerate(exposures, len(exposures) > 1)]
    assert np.ptp(delays_s) < 1e-9
    return delays_s[0]


def test_the_start_of_a_clock_is_the_delay_of_the_largest_correlation(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, steps = [], []

    def value(exposures):
        tried.append(delay_s(exposures))
        return -abs(tried[-1] - 0.012)

    made = searched(monkeypatch, value, lambda exposures: np.array([delay_s(exposures), 2.0, 3.0]))
    limits = {"search_px": 7.0, "on_step": lambda done, of: steps.append((done, of))}
    turn_rad, found_s = likely_start(images(3), "simulator", search_s=0.03, **limits)

    # Steps of at most 12.5 ms on both sides.
    np.testing.assert_allclose(tried, [-0.03, -0.02, -0.01, 0, 0.01, 0.02, 0.03], rtol=0, atol=1e-9)
    assert (found_s, turn_rad[0], *turn_rad[1:]) == pytest.approx((0.01, 0.01, 2.0, 3.0))
    assert steps == [(k, 7) for k in range(1, 8)]
    assert made == [(3, "simulator", 7.0)]
    del tried[:]
    likely_start(images(3), "simulator", search_px=7.0, search_s=0.0376)
    np.testing.assert_allclose(tried, 0.0094 * np.arange(-4, 5), rtol=0, atol=1e-9)
    del tried[:]
    assert likely_start(images(3), "simulator", search_px=7.0, search_s=0.0)[1] == 0.0
    assert tried == [0.0]
    del tried[:]
    likely_start(images(3), "simulator", search_px=7.0, search_s=100.0)
    np.testing.assert_allclose(tried, np.arange(-200, 201) / 2, rtol=0, atol=1e-9)


def test_outside_of_the_flight_a_search_starts_without_a_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    searched(monkeypatch, lambda _: -np.inf, lambda _: np.ones(3))
    turn_rad, found_s = likely_start(images(3), None, search_px=7.0, search_s=0.02)
    assert (turn_rad.tolist(), found_s) == ([0, 0, 0], 0.0)
    assert likely_delay_s(images(1)[0], None, search_px=7.0, search_s=0.2) == 0.0


def test_of_likely_delays_that_of_the_smallest_shift_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    values = dict(zip(range(-4, 5), [0.95, 0.91, 0.89, 0.5, 1.0, 0.7, -np.inf, 0.99, 0.9], strict=True))
    shifts = dict(zip(range(-4, 5), [5.0, 3.0, 1.0, 0.0, 4.0, 0.0, 0.0, 3.5, 6.0], strict=True))
    tried = []

    def step(exposures) -> int:
        tried.append(delay_s(exposures))
        return round(tried[-1] / 0.0475)

    turn = np.array([0.6, -0.8, 0.0])
    made = searched(monkeypatch, lambda e: values[step(e)], lambda e: turn * shifts[step(e)])
    assert likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=0.19) == pytest.approx(-3 * 0.0475)
    assert made == [(1, "simulator", 5.0)]
    # Steps of at most 50 ms.
    np.testing.assert_allclose(sorted(set(np.round(tried, 6))), 0.0475 * np.arange(-4, 5), rtol=0, atol=1e-6)
    # Of equal shifts, the shortest delay.
    shifts |= dict.fromkeys(range(-4, 5), 2.0)
    values |= {0: 0.3, -3: 0.2}
    assert likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=0.19) == pytest.approx(3 * 0.0475)
    values |= {-3: 0.95, 3: 0.2, 4: 1.0}
    assert likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=0.19) == pytest.approx(-3 * 0.0475)
    values |= dict.fromkeys(range(-4, 5), -1.0)
    assert likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=0.19) == 0.0
    del tried[:]
    values |= dict.fromkeys(range(-20000, 20000), 1.0)
    shifts |= dict.fromkeys(range(-20000, 20000), 1.0)
    likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=0.201)
    np.testing.assert_allclose(np.unique(tried), 0.0402 * np.arange(-5, 6), rtol=0, atol=1e-9)
    del tried[:]
    likely_delay_s(images(1)[0], "simulator", search_px=5.0, search_s=100.0)
    np.testing.assert_allclose(np.unique(tried), np.arange(-200, 201) / 2, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("value", "expected_s"), [(1.004, 0.03), (1.0104, -0.15)])
def test_a_readout_time_replaces_the_given_one_if_it_correlates_one_percent_better(
    value: float, expected_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def exposure_at(k: int, readout_s: float) -> tuple[int, float]:
        tried.append((k, readout_s))
        return k, readout_s

    def correlation(exposures) -> float:
        (first, readout_s), (second, same_s) = exposures
        assert (first, second, same_s) == (1, 2, readout_s)
        return 1.0 if readout_s == 0.03 else value - 0.01 * abs(readout_s + 0.15)

    made = searched(monkeypatch, correlation, lambda exposures: np.array([0.0, exposures[0][1], 1.0]))
    turn_rad, found_s = likely_readout(images(3), "simulator", search_px=9.0, given_s=0.03, exposure_at=exposure_at)
    assert (found_s, turn_rad.tolist()) == (pytest.approx(expected_s), [0.0, pytest.approx(expected_s), 1.0])
    assert made == [(3, "simulator", 9.0)]
    np.testing.assert_allclose(
        [readout_s for _, readout_s in tried[::2]], [0.03, *(0.0125 * np.arange(-20, 21))], rtol=0, atol=1e-9
    )


class Turning:
    """A pointing that turns about two axes of the camera, from an attitude that points along x."""

    def __init__(self, times_s: np.ndarray, rate: tuple[float, float, float]) -> None:
        turns = (times_s - FIRST_S)[:, np.newaxis] * np.array(rate)
        start = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
        self.C_camera_eq = matrix_from_quaternion(quaternion_from_turn(turns)) @ start
        self.boresight_eq = self.C_camera_eq[:, 2]

    def __len__(self) -> int:
        return len(self.C_camera_eq)

    def to_camera(self, direction_eq: np.ndarray) -> np.ndarray:
        return np.einsum("nij,kj->nki", self.C_camera_eq, direction_eq)


def simulator(count: int = 40, rate: tuple[float, float, float] = (0.3, -0.5, 0.4)) -> SimpleNamespace:
    rng = np.random.default_rng(5)
    direction = np.column_stack([np.ones(count), rng.uniform(-0.6, 0.6, count), rng.uniform(-0.45, 0.45, count)])
    stars = SimpleNamespace(
        direction_eq=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        camera_mag=rng.uniform(0.0, 5.0, count),
    )
    track = SimpleNamespace(first_s=FIRST_S - 5, last_s=FIRST_S + 5)
    return SimpleNamespace(
        camera=CAMERA,
        sensor=SENSOR,
        stars=stars,
        pointing=lambda times_s: Turning(times_s, rate),
        flight=SimpleNamespace(attitude=track),
    )


def sky(above_dn: np.ndarray | None = None, noise_dn: float = 3.0) -> SubtractedImage:
    above = np.zeros((201, 300), np.float32) if above_dn is None else above_dn.astype(np.float32)
    return SubtractedImage(above, np.full_like(above, noise_dn), np.ones(above.shape, bool))


def summed(simulated: SimpleNamespace, exposure: Exposure, side: int, samples: int, most: int = 150) -> np.ndarray:
    """Return the density star by star and sample by sample."""
    light = np.zeros((201 // side, 300 // side))
    times_s = exposure.start_utc_s + (np.arange(samples) + 0.5) / samples * exposure.span_s
    pointing = simulated.pointing(times_s)
    to_centre = np.arccos(simulated.stars.direction_eq @ pointing.boresight_eq[samples // 2])
    near = np.flatnonzero(to_centre < 1.3 * CAMERA.field_radius_rad)
    bright = sorted(near, key=lambda k: simulated.stars.camera_mag[k])[:most]
    per_column_s, per_row_s, first_s = exposure.opening_s(300, 201)
    for k in bright:
        star = simulated.stars.camera_mag[k]
        flux_dn = float(SENSOR.flux_dn(SENSOR.peak_dn(star, exposure.span_s))) / samples
        for time_s, direction in zip(times_s, pointing.to_camera(simulated.stars.direction_eq[[k]])[:, 0], strict=True):
            x, y = CAMERA.project(direction)
            opens_s = exposure.start_utc_s + first_s + per_column_s * x + per_row_s * y
            starts_s = opens_s + np.arange(exposure.frames) * (exposure.duration_s + exposure.gap_s)
            is_open = ((time_s >= starts_s) & (time_s <= starts_s + exposure.duration_s)).any()
            row, column = int(np.floor(y / side + 0.5)), int(np.floor(x / side + 0.5))
            if is_open and 0 <= row < light.shape[0] and 0 <= column < light.shape[1]:
                light[row, column] += flux_dn
    sigma_px = SENSOR.effective_sigma_px
    drawn = max(sigma_px / side, 0.8)
    smooth = cv2.GaussianBlur(light.astype(np.float32), (0, 0), float(np.hypot(drawn, sigma_px / side)))
    # Over the noise of a sum that is weighted by the star's shape, as a mean over a block.
    return smooth * (2 * np.sqrt(np.pi) * sigma_px) / (3.0 * side**2)


@pytest.mark.parametrize(
    ("exposure", "samples"),
    [
        (Exposure(FIRST_S, 0.2), 24),
        (Exposure(FIRST_S + 0.1, 0.1, readout_s=0.15), 24),
        (Exposure(FIRST_S, 0.1, readout_s=0.15, readout="left"), 24),
        (Exposure(FIRST_S, 0.05, frames=3, gap_s=0.04), 72),
        (Exposure(FIRST_S, 0.05, frames=2, gap_s=0.04, readout_s=0.06, readout="up"), 48),
        (Exposure(FIRST_S, 1.5, frames=2, gap_s=0.1, readout_s=1.2), 48),
        (Exposure(FIRST_S, 0.01, frames=12, gap_s=0.007), 240),
    ],
)
@pytest.mark.parametrize("side", [2, 5])
def test_the_signal_of_stars_is_summed_while_their_rows_are_open(exposure: Exposure, samples: int, side: int) -> None:
    simulated = simulator(rate=(0.03, -0.05, 0.04) if exposure.duration_s > 1 else (0.3, -0.5, 0.4))
    found = _density(simulated, exposure, sky(), side)
    expected = summed(simulated, exposure, side, samples)

    assert (found.dtype, found.shape) == (np.float32, (201 // side, 300 // side))
    assert expected.max() > 1
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * expected.max())


def test_the_brightest_stars_near_the_field_are_drawn() -> None:
    simulated = simulator(400, (0.0, 0.0, 0.0))
    exposure = Exposure(FIRST_S, 0.2)
    expected = summed(simulated, exposure, 3, 24)
    assert np.abs(expected - summed(simulated, exposure, 3, 24, most=165)).max() > 1e-3 * expected.max()
    np.testing.assert_allclose(_density(simulated, exposure, sky(), 3), expected, rtol=0, atol=1e-4 * expected.max())


def test_a_shift_of_images_is_a_rotation_of_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(9)
    bins = np.zeros((101, 150), np.float32)
    bins[rng.integers(20, 80, 25), rng.integers(20, 130, 25)] = rng.uniform(20, 40, 25)
    bins = cv2.GaussianBlur(bins, (0, 0), 1.2)
    seen = np.roll(bins, (3, -4), axis=(0, 1))  # down and to the left
    noise = rng.normal(0, 1, (202, 300))
    real = [sky(0.4 * np.kron(seen * weight, np.ones((2, 2))) + 3 * noise, 3.0) for weight in (1.0, 1.4)]
    exposures = [Exposure(FIRST_S + k, 0.1) for k in range(2)]
    monkeypatch.setattr(coarsealignment, "_density", lambda _, exposure, image, side: bins * (side == 2))

    simulated = simulator()
    correlations = _Correlations(list(zip(exposures, real, strict=True)), simulated, 12.0)

    assert correlations.chosen == [0, 1]
    sigma_px = SENSOR.effective_sigma_px
    each = [CrossCorrelation(shrunk(one.significance(sigma_px), 2), 6.0).to(bins) for one in real]
    value, turn_rad = correlations.best(exposures)
    assert value == pytest.approx(float((each[0] + each[1]).max()), rel=1e-5)
    np.testing.assert_allclose(turn_rad, [6 / 370.0, 8 / 400.0, 0.0], rtol=1e-12)
    # An exposure that begins before the flight or ends after it does not count.
    for start_s, counted in (
        (FIRST_S - 5, True),
        (FIRST_S - 5.01, False),
        (FIRST_S + 4.9, True),
        (FIRST_S + 4.91, False),
    ):
        value, _ = correlations.best([replace(exposures[0], start_utc_s=start_s), exposures[1]])
        assert value == pytest.approx(float((each[0] + each[1] if counted else each[1]).max()), rel=1e-5)
    value, turn_rad = correlations.best([replace(one, start_utc_s=FIRST_S + 6) for one in exposures])
    assert (value, turn_rad.tolist()) == (-np.inf, [0, 0, 0])


def test_six_images_are_evenly_chosen_and_binned_to_192_pixels() -> None:
    many = [(Exposure(FIRST_S + k, 0.1), sky()) for k in range(13)]
    found = _Correlations(many, simulator(), 9.0)
    # 300 px in bins of 2 px; shifts of up to 4.5 bins.
    assert (found.chosen, found._side) == ([0, 2, 4, 7, 9, 12], 2)
    assert [one._shifts.tolist() for one in found._correlations] == [[*range(-5, 6)]] * 6
    wide = np.zeros((20, 385))
    assert _Correlations([(many[0][0], sky(wide))], simulator(), 9.0)._side == 3
    assert _Correlations([(many[0][0], sky(wide[:, :384]))], simulator(), 9.0)._side == 2
