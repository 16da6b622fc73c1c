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
