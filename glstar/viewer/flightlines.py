"""The curves of the timeline, computed from a flight on any thread."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.flight import AttitudeTrack
from glstar.rotation import euler_from_quaternion
from glstar.viewer.trace import Trace

__all__ = ["ANGLES", "FlightLines"]

Float = NDArray[np.float64]

# The angles; the rates about forward, right and down are labelled alike.
ANGLES: Final = ("roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True, eq=False)
class FlightLines:
    """Roll, pitch, yaw and the angular rates of the body over time; times are seconds from an origin.

    Attributes
    ----------
    attitude : AttitudeTrack
    second : (n,) float64
        The times of its samples, s from the origin.
    angles_rad : (3, n) float64
        Roll, pitch and yaw.
    angles, rates : tuple of Trace
        deg, and deg/s about forward, right and down.
    gaps_s : (m, 2) float64
        Start and end of each gap, s from the origin.
    """

    attitude: AttitudeTrack
    second: Float
    angles_rad: Float
    angles: tuple[Trace, ...]
    rates: tuple[Trace, ...]
    gaps_s: Float

    @classmethod
    def of(cls, attitude: AttitudeTrack, origin_s: float) -> Self:
        """Return the curves of a flight.

        Parameters
        ----------
        attitude : AttitudeTrack
        origin_s : float
            UTC seconds since 1970.

        Returns
        -------
        FlightLines
        """
        second = attitude.utc_s - origin_s
        angles_rad = np.stack(euler_from_quaternion(attitude.q_body_ned))
        gaps_s = np.array([(gap.start_utc_s, gap.stop_utc_s) for gap in attitude.gaps]).reshape(-1, 2) - origin_s
        angles = _angles(second, np.rad2deg(angles_rad), gaps_s)
        return cls(attitude, second, angles_rad, angles, _rates(attitude, origin_s), gaps_s)


def _angles(second: Float, angles_deg: Float, gaps_s: Float) -> tuple[Trace, ...]:
    gaps = np.zeros(second.size - 1, dtype=np.bool_)
    gaps[np.searchsorted(second, gaps_s[:, 0])] = True
    # An angle that passes 180 deg continues at -180 deg: the line is broken there.
    return tuple(Trace(second, angle_deg, gaps | (np.abs(np.diff(angle_deg)) > 180)) for angle_deg in angles_deg)


def _rates(attitude: AttitudeTrack, origin_s: float) -> tuple[Trace, ...]:
    utc_s, rate_rad_per_s = attitude.rates()
    after = np.searchsorted(utc_s, [gap.start_utc_s for gap in attitude.gaps])
    gaps = np.zeros(max(utc_s.size - 1, 0), dtype=np.bool_)
    gaps[after[(after > 0) & (after < utc_s.size)] - 1] = True
    rate_deg_per_s = np.ascontiguousarray(np.rad2deg(rate_rad_per_s).T)
    return tuple(Trace(utc_s - origin_s, rate, gaps) for rate in rate_deg_per_s)
