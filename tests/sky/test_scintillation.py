"""Scintillation against a simulated process in small steps, and against the published half second."""

import numpy as np
import pytest

from glstar.sky.air.extinction import SMALL_LENS_RMS, Scintillation

STARS = np.arange(1, 4001, dtype=np.int32)
RMS = np.full(len(STARS), 0.38)


def means_of_steps(duration_s, rng):
    """Return means of log-normal processes with exponential correlation over 4 ms, in steps of 0.1 ms."""
    steps = round(duration_s / 1e-4)
    kept = np.exp(-1e-4 / 4e-3)
    g = rng.normal(size=3000)
    total = np.zeros(3000)
    width = np.sqrt(np.log1p(0.38**2))
    for _ in range(steps):
        total += np.exp(width * g - width**2 / 2)
        g = kept * g + np.sqrt(1 - kept**2) * rng.normal(size=3000)
    return total / steps


@pytest.mark.parametrize("duration_s", [0.005, 0.1])
def test_an_exposure_averages_as_a_process_in_small_steps(duration_s):
    simulated = means_of_steps(duration_s, np.random.default_rng(2))
    scintillation = Scintillation(0.38)
    once = scintillation.mean_factors(RMS, STARS, 1.7e9, duration_s)
    times = 2 + round(duration_s / 5e-4)
    varied = scintillation.factors(RMS, STARS, 1.7e9, duration_s, times)
    averaged = (varied[1:] + varied[:-1]).mean(axis=0) / 2
    for found in (once, averaged):
        np.testing.assert_allclose(found.mean(), 1.0, rtol=0, atol=4 * simulated.std() / 60)
        np.testing.assert_allclose(found.std(), simulated.std(), rtol=0.07, atol=0)
    np.testing.assert_allclose(varied.std(), 0.38, rtol=0.05, atol=0)


def test_half_a_second_averages_to_a_twentieth():
    found = Scintillation(SMALL_LENS_RMS).mean_factors(RMS, STARS, 1.7e9, 0.5)
    np.testing.assert_allclose(found.std(), 0.045, rtol=0, atol=0.005)
    coarse = Scintillation(SMALL_LENS_RMS).factors(RMS, STARS, 1.7e9, 0.5, 26)
    np.testing.assert_allclose(((coarse[1:] + coarse[:-1]).mean(axis=0) / 2).std(), found.std(), rtol=0.07, atol=0)


def test_it_depends_on_star_exposure_and_seed_only():
    scintillation = Scintillation(0.38)
    found = scintillation.factors(RMS, STARS, 1.7e9, 0.5, 17)
    np.testing.assert_array_equal(scintillation.factors(RMS[5:9], STARS[5:9], 1.7e9, 0.5, 17), found[:, 5:9])
    for other in (
        scintillation.factors(RMS, STARS, 1.7e9 + 0.5, 0.5, 17),
        Scintillation(0.38, seed=1).factors(RMS, STARS, 1.7e9, 0.5, 17),
        np.roll(found, 1, axis=1),
    ):
        assert abs(np.corrcoef(np.log(found).ravel(), np.log(other).ravel())[0, 1]) < 0.02


def test_it_grows_with_air_mass_and_falls_with_height():
    scintillation = Scintillation(0.38)
    np.testing.assert_allclose(scintillation.rms(1.0, 0.0), 0.38, rtol=1e-3, atol=0)
    np.testing.assert_allclose(scintillation.rms(0.5, 0.0), 0.38 * 2**0.92, rtol=5e-3, atol=0)
    np.testing.assert_allclose(scintillation.rms(1.0, 8000.0), 0.38 / np.e, rtol=1e-3, atol=0)


def splitmix64(number: int) -> int:
    """Return the output of the generator after a state, as its authors publish it."""
    z = (number + 0x9E3779B97F4A7C15) % 2**64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) % 2**64
    return z ^ (z >> 31)


def normals(star_id, utc_s, seed, times):
    """Return normal deviates of a star by Box and Muller, from two uniform numbers of 53 bits each."""
    of_frame = splitmix64(round(utc_s * 1e6))
    of_star = splitmix64(star_id ^ splitmix64((seed + of_frame) % 2**64))
    uniform = [splitmix64((of_star + k * 0x9E3779B97F4A7C15) % 2**64) / 2**64 for k in range(2 * times)]
    return [
        np.sqrt(-2 * np.log(1 - first)) * np.cos(2 * np.pi * second)
        for first, second in zip(uniform[:times], uniform[times:], strict=True)
    ]


def test_the_hash_is_splitmix64():
    # The first numbers of the published generator that starts at 0.
    assert [splitmix64(0), splitmix64(0x9E3779B97F4A7C15)] == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4]


@pytest.mark.parametrize("utc_s", [1710068400.125, -86400.25])
def test_mean_factors_are_log_normal_numbers_of_star_exposure_and_seed(utc_s):
    star_id, rms = np.array([7, 4711, 32], np.int32), np.array([0.3, 0.5, 0.8])
    found = Scintillation(0.38, seed=9).mean_factors(rms, star_id, utc_s, 0.03)
    steps = 0.03 / 0.004
    # The variance of the mean over s correlation times of a process with exponential correlation.
    mean_rms = rms * np.sqrt(2 * (steps - 1 + np.exp(-steps)) / steps**2)
    deviates = np.array([normals(int(star), utc_s, 9, 1)[0] for star in star_id])
    expected = np.exp(np.sqrt(np.log(1 + mean_rms**2)) * deviates) / np.sqrt(1 + mean_rms**2)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_factors_are_an_autoregressive_process():
    star_id, rms = np.array([7, 4711], np.int32), np.array([0.3, 0.8])
    found = Scintillation(0.38).factors(rms, star_id, 1710068400.125, 0.02, 6)
    step = 0.02 / 5 / 0.004
    kept = np.exp(-step)
    expected = np.empty((6, 2))
    for column, star in enumerate(star_id):
        fresh = normals(int(star), 1710068400.125, 0, 6)
        value = fresh[0]
        # Averaged over a step, the variance is smaller by the ratio of tanh(h / 2) to h / 2.
        width2 = np.log(1 + rms[column] ** 2 * np.tanh(step / 2) / (step / 2))
        for row in range(6):
            if row:
                value = kept * value + np.sqrt(1 - kept**2) * fresh[row]
            expected[row, column] = np.exp(np.sqrt(width2) * value - width2 / 2)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_its_size_is_a_power_of_the_air_mass():
    assert SMALL_LENS_RMS == 0.38
    scintillation = Scintillation(0.5)
    sine = np.array([[0.0, 0.2], [0.7, 0.9]])
    mass = 1 / (sine + 0.025 * np.exp(-11 * sine))
    np.testing.assert_allclose(scintillation.rms(sine, 2000.0), 0.5 * np.exp(-0.25) * mass**0.92, rtol=1e-12)
    np.testing.assert_allclose(scintillation.rms(sine, -400.0), 0.5 * mass**0.92, rtol=1e-12)
