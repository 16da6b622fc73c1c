"""The response of an aircraft's attitude to gusts, and the vibration of its propellers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError
from glstar.flight.synthetic.dryden import DrydenGusts, LinearSystem

__all__ = ["AttitudeResponse", "VibrationLine", "vibration_turns"]

Float = NDArray[np.float64]

_AXES: Final = ("roll", "pitch", "yaw")
# Fraction of a gust's angle (v / V or w / V) that roll, pitch and yaw follow: a stable aircraft turns its nose into the
# gust and lifts its upwind wing, and its autopilot opposes most of that. A design choice, not a standard.
_ANGLE_GAINS: Final = (-0.2, 0.25, 0.25)
# Index in `GUST_NAMES` of the gust speed and of the gust rate that drive roll, pitch and yaw.
_SPEEDS: Final = (1, 2, 1)
_RATES: Final = (3, 4, 5)


@dataclass(frozen=True, slots=True)
class AttitudeResponse:
    """An attitude-hold loop of second order on each axis, driven by the rates and the angles of gusts.

    Attributes
    ----------
    natural_frequency_hz : float
        1 to 2 Hz for a small fixed wing, 3 to 5 Hz for a multirotor.
    damping : float
        Damping ratio.

    Raises
    ------
    ConfigError
        If a number is not positive.
    """

    natural_frequency_hz: float = 1.5
    damping: float = 0.7

    def __post_init__(self) -> None:
        if not (self.natural_frequency_hz > 0 and self.damping > 0):
            raise ConfigError(
                "an attitude response needs a natural frequency and a damping above 0,"
                f" not {self.natural_frequency_hz:g} Hz and {self.damping:g}"
            )

    def to(self, gusts: DrydenGusts) -> LinearSystem:
        """Return the system from white noise to roll, pitch and yaw, rad.

        Parameters
        ----------
        gusts : DrydenGusts

        Returns
        -------
        LinearSystem
            Three outputs: turns about the body's axes forward, right and down, rad.

        Notes
        -----
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
    """One line of the vibration of propellers and motors.

    Attributes
    ----------
    frequency_hz : float
        Revolutions a second, or a multiple of them.
    amplitude_rad : float
        Amplitude of the turn, rad.
    axis : {"roll", "pitch", "yaw"}

    Raises
    ------
    ConfigError
        If a number or the axis is not one.
    """

    frequency_hz: float
    amplitude_rad: float
    axis: str = "pitch"

    def __post_init__(self) -> None:
        if self.axis not in _AXES:
            raise ConfigError(f"a vibration has the axis roll, pitch or yaw, not {self.axis!r}")
        if not (self.frequency_hz > 0 and self.amplitude_rad >= 0):
            raise ConfigError(
                "a vibration needs a frequency above 0 and an amplitude of 0 or more,"
                f" not {self.frequency_hz:g} Hz and {self.amplitude_rad:g} rad"
            )


def vibration_turns(lines: Sequence[VibrationLine], t_s: Float, rng: np.random.Generator) -> Float:
    """Return the turns of vibration lines, each with a random phase.

    Parameters
    ----------
    lines : sequence of VibrationLine
    t_s : (n,) float64
        Times, s.
    rng : numpy.random.Generator

    Returns
    -------
    (n, 3) float64
        Turns about the body's axes forward, right and down, rad.
    """
    turns = np.zeros((t_s.size, 3))
    for line in lines:
        phase = rng.uniform(0, 2 * np.pi)
        turns[:, _AXES.index(line.axis)] += line.amplitude_rad * np.sin(2 * np.pi * line.frequency_hz * t_s + phase)
    return turns
