"""Dryden gusts against the closed forms of MIL-F-8785C."""

import numpy as np
import pytest
from scipy.integrate import quad

from glstar.errors import ConfigError
from glstar.flight.synthetic.gusts import (
    GUST_NAMES,
    AttitudeResponse,
    DrydenGusts,
    LinearSystem,
    VibrationLine,
    vibration_turns,
)

LIGHT = DrydenGusts(7.7, 100.0, 18.0, 2.0)


def density(system: LinearSystem, omega: float) -> np.ndarray:
    """Return the two-sided spectral densities of a system's outputs at an angular frequency, in units of 1 / Hz."""
    transfer = system.C @ np.linalg.solve(1j * omega * np.eye(len(system.A)) - system.A, system.B)
    return (np.abs(transfer) ** 2).sum(axis=1)


def test_light_turbulence_at_100_m_has_the_published_size() -> None:
    np.testing.assert_allclose(LIGHT.sigmas_m_per_s, (1.06, 1.06, 0.77), rtol=0, atol=0.005)
    np.testing.assert_allclose(LIGHT.lengths_m, (263, 263, 100), rtol=0, atol=0.5)


@pytest.mark.parametrize("omega", [0.01, 0.3, 2.0, 15.0, 80.0])
def test_the_filters_have_the_spectra_of_the_specification(omega: float) -> None:
    # MIL-F-8785C, in one-sided density per rad/s, which is two-sided density per Hz divided by pi.
    (su, sv, sw), (lu, lv, lw), speed, span = LIGHT.sigmas_m_per_s, LIGHT.lengths_m, 18.0, 2.0
    wave = omega / speed
    phi_u = su**2 * 2 * lu / (np.pi * speed) / (1 + (lu * wave) ** 2)
    phi_v = sv**2 * lv / (np.pi * speed) * (1 + 3 * (lv * wave) ** 2) / (1 + (lv * wave) ** 2) ** 2
    phi_w = sw**2 * lw / (np.pi * speed) * (1 + 3 * (lw * wave) ** 2) / (1 + (lw * wave) ** 2) ** 2
    phi_p = sw**2 / (speed * lw) * 0.8 * (np.pi * lw / (4 * span)) ** (1 / 3) / (1 + (4 * span * wave / np.pi) ** 2)
    phi_q = wave**2 / (1 + (4 * span * wave / np.pi) ** 2) * phi_w
    phi_r = wave**2 / (1 + (3 * span * wave / np.pi) ** 2) * phi_v

    measured = density(LIGHT.system(), omega) / np.pi

    np.testing.assert_allclose(measured, [phi_u, phi_v, phi_w, phi_p, phi_q, phi_r], rtol=1e-9)


def test_the_stationary_covariance_is_that_of_the_filters() -> None:
    system = LIGHT.system()

    covariance = system.C @ system.stationary_covariance() @ system.C.T

    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:3], LIGHT.sigmas_m_per_s, rtol=1e-9)
    for k in range(len(GUST_NAMES)):
        variance = quad(lambda w, k=k: density(system, w)[k] / np.pi, 0, np.inf, limit=400)[0]
        assert covariance[k, k] == pytest.approx(variance, rel=1e-4)


@pytest.mark.parametrize("step_s", [0.0025, 0.02, 1.0])
def test_the_discrete_filter_keeps_the_covariance_at_any_rate(step_s: float) -> None:
    system = AttitudeResponse().to(LIGHT)
    covariance = system.stationary_covariance()

    transition, noise = system.discretised(step_s)

    np.testing.assert_allclose(
        transition @ covariance @ transition.T + noise, covariance, rtol=0, atol=1e-9 * np.abs(covariance).max()
    )


def test_a_long_sample_has_the_spectrum_of_the_specification_in_every_octave() -> None:
    step_s, system = 0.02, LIGHT.system()
    history = system.simulated(1 << 19, step_s, np.random.default_rng(1))

    power = np.abs(np.fft.rfft(history, axis=0)) ** 2 * step_s / len(history)
    frequency_hz = np.fft.rfftfreq(len(history), step_s)
    for low_hz in 0.1 * 2.0 ** np.arange(5):
        octave = (frequency_hz >= low_hz) & (frequency_hz < 2 * low_hz)
        centres = frequency_hz[octave][:: max(1, octave.sum() // 200)]
        expected = np.mean([density(system, 2 * np.pi * f)[:3] for f in centres], axis=0)
        np.testing.assert_allclose(power[octave, :3].mean(axis=0), expected, rtol=0.05, err_msg=f"{low_hz} Hz")


def test_sampled_gusts_have_their_standard_deviation() -> None:
    # 18 m/s and 263 m: 29 s of correlation; 5 hours are some 600 independent values, 3 % of the standard deviation.
    history = LIGHT.system().simulated(180_000, 0.1, np.random.default_rng(2))

    np.testing.assert_allclose(history[:, :3].std(axis=0), LIGHT.sigmas_m_per_s, rtol=0.12)


def test_lengths_are_continuous_from_low_to_high_altitude() -> None:
    lengths = [DrydenGusts(7.7, height_m, 18.0, 2.0).lengths_m[0] for height_m in (304.0, 305.0, 457.2, 609.7, 5000.0)]

    assert lengths[0] == pytest.approx(lengths[1], abs=1.0)
    assert lengths[2] == pytest.approx((1000 + 1750) / 2 * 0.3048, abs=1.0)
    assert lengths[3] == lengths[4] == pytest.approx(1750 * 0.3048)


def test_gusts_without_height_are_refused() -> None:
    with pytest.raises(ConfigError, match="height_m above 0, not 0"):
        DrydenGusts(7.7, 0.0, 18.0, 2.0)


def test_a_vibration_line_has_half_its_squared_amplitude_as_second_moment() -> None:
    t_s = np.arange(200_000) / 7919.0

    turns = vibration_turns([VibrationLine(110.0, 2e-4, "yaw")], t_s, np.random.default_rng(3))

    assert (turns[:, 2] ** 2).mean() == pytest.approx(2e-4**2 / 2, rel=1e-3)
    assert not turns[:, :2].any()


@pytest.mark.parametrize("line", [{"axis": "nose"}, {"frequency_hz": 0.0}, {"amplitude_rad": -1.0}])
def test_an_impossible_vibration_is_refused(line: dict) -> None:
    with pytest.raises(ConfigError, match="a vibration"):
        VibrationLine(**{"frequency_hz": 100.0, "amplitude_rad": 1e-4} | line)
