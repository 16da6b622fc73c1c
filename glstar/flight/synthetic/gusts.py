"""Dryden gusts with the spectra of MIL-F-8785C, the response of an aircraft's attitude to them, and vibration.

The six gust components are outputs of linear filters driven by white noise.  The filters are discretised exactly
(Van Loan), so that their variance is right at any sample rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError

# Outputs of `DrydenGusts.system`: speeds forward, right and down, m/s; rates about the same axes, rad/s.
GUST_NAMES = ("u", "v", "w", "p", "q", "r")

_FEET_PER_M = 1 / 0.3048
# MIL-F-8785C: the low-altitude model is valid from 10 to 1000 ft, the high-altitude one from 2000 ft.
_LOWEST_FT = 10.0
_LOW_FT = 1000.0
_HIGH_FT = 2000.0
# Length scale of the high-altitude model.
_HIGH_LENGTH_FT = 1750.0


@dataclass(frozen=True, slots=True, eq=False)
class LinearSystem:
    """A linear system driven by white noise: dx/dt = A x + B n, y = C x."""

    A: Float  # (k, k)
    B: Float  # (k, m) the noise n has unit intensity (two-sided spectral density 1 per Hz) in each of its m components
    C: Float  # (o, k)

    def stationary_covariance(self) -> Float:
        """Return the stationary covariance of the state, (k, k): A P + P A^T + B B^T = 0."""
        from scipy.linalg import solve_continuous_lyapunov  # noqa: PLC0415 - slow to import, rarely needed

        covariance: Float = solve_continuous_lyapunov(self.A, -self.B @ self.B.T)
        return (covariance + covariance.T) / 2

    def discretised(self, step_s: float) -> tuple[Float, Float]:
        """Return the exact transition F of x(t + step) = F x(t) + noise, and the covariance of the noise, (k, k) both.

        C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).
        """
        from scipy.linalg import expm  # noqa: PLC0415 - slow to import, rarely needed

        states = len(self.A)
        block = np.zeros((2 * states, 2 * states))
        block[:states, :states] = -self.A
        block[:states, states:] = self.B @ self.B.T
        block[states:, states:] = self.A.T
        exponential = expm(block * step_s)
        transition: Float = exponential[states:, states:].T
        covariance = transition @ exponential[:states, states:]
        return transition, (covariance + covariance.T) / 2

    def simulated(self, samples: int, step_s: float, rng: np.random.Generator) -> Float:
        """Return a random history of the outputs, (samples, o), stationary from its first sample."""
        transition, noise_covariance = self.discretised(step_s)
        noise = rng.standard_normal((samples, len(self.A))) @ _root(noise_covariance).T
        state = _root(self.stationary_covariance()) @ rng.standard_normal(len(self.A))
        states = np.empty((samples, len(self.A)))
        for k in range(samples):
            states[k] = state
            state = transition @ state + noise[k]
        return states @ self.C.T


def _root(covariance: Float) -> Float:
    """Return a square root of a covariance that may be singular: R R^T = covariance."""
    variances, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variances, 0.0)))


@dataclass(frozen=True, slots=True)
class DrydenGusts:
    """Gusts of the Dryden model for an aircraft in level flight.

    Raises ConfigError if a number is not positive.  MIL-F-8785C, sections 3.7.1 to 3.7.3.  Between 1000 and 2000 ft
    the length scales are interpolated; the standard deviation above 1000 ft stays a tenth of the wind at 20 ft, to
    which the low-altitude model leads.
    """

    # Mean wind 20 ft above the ground, m/s: 7.7, 15.4 and 23.2 are light, moderate and severe turbulence.
    wind_20ft_m_per_s: float
    height_m: float  # Height above the ground, m
    airspeed_m_per_s: float
    span_m: float  # Wing span (or rotor base) that averages the gusts' gradients, m

    def __post_init__(self) -> None:
        for name in ("height_m", "airspeed_m_per_s", "span_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"gusts need {name} above 0, not {getattr(self, name):g}")
        if not self.wind_20ft_m_per_s >= 0:
            raise ConfigError(f"gusts need a wind of 0 m/s or more, not {self.wind_20ft_m_per_s:g}")

    @property
    def sigmas_m_per_s(self) -> tuple[float, float, float]:
        """Standard deviations of the gusts forward, right and down, m/s."""
        sigma_w = 0.1 * self.wind_20ft_m_per_s
        sigma_u = sigma_w / (0.177 + 0.000823 * self._height_ft(_LOW_FT)) ** 0.4
        return sigma_u, sigma_u, sigma_w

    @property
    def lengths_m(self) -> tuple[float, float, float]:
        """Length scales of the gusts forward, right and down, m."""
        low_ft = self._height_ft(_LOW_FT)
        length_u_ft, length_w_ft = low_ft / (0.177 + 0.000823 * low_ft) ** 1.2, low_ft
        fraction = (self._height_ft(_HIGH_FT) - _LOW_FT) / (_HIGH_FT - _LOW_FT)
        if fraction > 0:
            length_u_ft += fraction * (_HIGH_LENGTH_FT - length_u_ft)
            length_w_ft += fraction * (_HIGH_LENGTH_FT - length_w_ft)
        return length_u_ft / _FEET_PER_M, length_u_ft / _FEET_PER_M, length_w_ft / _FEET_PER_M

    def _height_ft(self, highest_ft: float) -> float:
        return min(max(self.height_m * _FEET_PER_M, _LOWEST_FT), highest_ft)

    def system(self) -> LinearSystem:
        """Return the filters of all six components, in the order of `GUST_NAMES`: eight states, four noises."""
        speed = self.airspeed_m_per_s
        (sigma_u, sigma_v, sigma_w), (length_u, length_v, length_w) = self.sigmas_m_per_s, self.lengths_m
        A, B, C = np.zeros((8, 8)), np.zeros((8, 4)), np.zeros((6, 8))
        # u: one pole.
        A[0, 0], B[0, 0], C[0, 0] = -speed / length_u, sqrt(2 * speed / length_u), sigma_u
        # v and w: sigma sqrt(T) (1 + sqrt(3) T s) / (1 + T s)^2 with T = L / V.
        for first, noise, output, sigma, length in ((1, 1, 1, sigma_v, length_v), (3, 2, 2, sigma_w, length_w)):
            rate = speed / length
            A[first, first + 1] = 1.0
            A[first + 1, first], A[first + 1, first + 1] = -(rate**2), -2 * rate
            B[first + 1, noise] = 1.0
            C[output, first : first + 2] = sigma * sqrt(1 / rate) * np.array([rate**2, sqrt(3) * rate])
        # p: one pole at pi V / (4 b).
        pole_p = pi * speed / (4 * self.span_m)
        gain_p = sigma_w * sqrt(pi * 0.8 / speed) * (pi / (4 * self.span_m)) ** (1 / 6) / length_w ** (1 / 3)
        A[5, 5], B[5, 3], C[3, 5] = -pole_p, pole_p, gain_p
        # q and r: high-passed w and v; y = (w - z) / (V tau), dz/dt = (w - z) / tau.
        for state, output, source, sign, arm in ((6, 4, 2, 1.0, 4 / pi), (7, 5, 1, -1.0, 3 / pi)):
            tau = arm * self.span_m / speed
            A[state] = C[source] / tau
            A[state, state] -= 1 / tau
            C[output] = sign * C[source] / (speed * tau)
            C[output, state] -= sign / (speed * tau)
        return LinearSystem(A, B, C)


_AXES = ("roll", "pitch", "yaw")
# Fraction of a gust's angle (v / V or w / V) that roll, pitch and yaw follow: a stable aircraft turns its nose into the
# gust and lifts its upwind wing, and its autopilot opposes most of that. A design choice, not a standard.
_ANGLE_GAINS = (-0.2, 0.25, 0.25)
# Index in `GUST_NAMES` of the gust speed and of the gust rate that drive roll, pitch and yaw.
_SPEEDS = (1, 2, 1)
_RATES = (3, 4, 5)


@dataclass(frozen=True, slots=True)
class AttitudeResponse:
    """An attitude-hold loop of second order on each axis, driven by the rates and the angles of gusts.

    Raises ConfigError if a number is not positive.
    """

    natural_frequency_hz: float = 1.5  # 1 to 2 Hz for a small fixed wing, 3 to 5 Hz for a multirotor
    damping: float = 0.7  # Damping ratio

    def __post_init__(self) -> None:
        if not (self.natural_frequency_hz > 0 and self.damping > 0):
            raise ConfigError(
                "an attitude response needs a natural frequency and a damping above 0,"
                f" not {self.natural_frequency_hz:g} Hz and {self.damping:g}"
            )

    def to(self, gusts: DrydenGusts) -> LinearSystem:
        """Return the system from white noise to turns about the body's axes forward, right and down, rad.

        On each axis d2x/dt2 + 2 z w (dx/dt - rate) + w^2 (x - k angle) = 0 with w the natural frequency, z the damping,
        and k = -0.2, 0.25, 0.25 for roll, pitch and yaw.
        """
        wind = gusts.system()
        states = len(wind.A)
        omega = 2 * np.pi * self.natural_frequency_hz
        A, C = np.zeros((states + 6, states + 6)), np.zeros((3, states + 6))
        A[:states, :states] = wind.A
        B = np.vstack([wind.B, np.zeros((6, wind.B.shape[1]))])
        for axis in range(3):
            angle, rate = states + 2 * axis, states + 2 * axis + 1
            A[angle, rate] = 1.0
            A[rate, angle], A[rate, rate] = -(omega**2), -2 * self.damping * omega
            A[rate, :states] = 2 * self.damping * omega * wind.C[_RATES[axis]]
            A[rate, :states] += omega**2 * _ANGLE_GAINS[axis] / gusts.airspeed_m_per_s * wind.C[_SPEEDS[axis]]
            C[axis, angle] = 1.0
        return LinearSystem(A, B, C)


@dataclass(frozen=True, slots=True)
class VibrationLine:
    """One line of the vibration of propellers and motors; raises ConfigError if a number or the axis is not one."""

    frequency_hz: float  # Revolutions a second, or a multiple of them
    amplitude_rad: float  # Amplitude of the turn, rad
    axis: str = "pitch"  # {"roll", "pitch", "yaw"}

    def __post_init__(self) -> None:
        if self.axis not in _AXES:
            raise ConfigError(f"a vibration has the axis roll, pitch or yaw, not {self.axis!r}")
        if not (self.frequency_hz > 0 and self.amplitude_rad >= 0):
            raise ConfigError(
                "a vibration needs a frequency above 0 and an amplitude of 0 or more,"
                f" not {self.frequency_hz:g} Hz and {self.amplitude_rad:g} rad"
            )


def vibration_turns(lines: Sequence[VibrationLine], t_s: Float, rng: np.random.Generator) -> Float:
    """Return turns by vibration lines of random phase about the body's axes forward, right and down, (n, 3) rad."""
    turns = np.zeros((t_s.size, 3))
    for line in lines:
        phase = rng.uniform(0, 2 * np.pi)
        turns[:, _AXES.index(line.axis)] += line.amplitude_rad * np.sin(2 * np.pi * line.frequency_hz * t_s + phase)
    return turns
