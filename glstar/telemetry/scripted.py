"""A flight given by a function of time, for tests, examples and benchmarks."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.flight import Flight
from glstar.rotation import quaternion_from_euler
from glstar.sky.site import Site
from glstar.telemetry.recordedlog import read_flight
from glstar.telemetry.source import (
    AttitudeSamples,
    ClockSamples,
    PositionSamples,
    Samples,
    TelemetrySource,
)

__all__ = ["ScriptedFlight"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ScriptedFlight(TelemetrySource):
    """A telemetry source with scripted attitude at a fixed position.

    Attributes
    ----------
    q_body_ned : callable
        The script: seconds since the start, (n,) float64, to quaternions (w, x, y, z), NED to body, (n, 4) float64.
    site : Site
        The position.
    start_utc_s : float
        UTC of the first sample, seconds since 1970.
    duration_s : float
        Time from the first sample to the last, s.
    rate_hz : float
        Sample rate, Hz.
    name : str
        Name of the flight.

    Examples
    --------
    A turn of 8 deg/s over Adelaide, as in figure 6 of Teague & Chahl:

    >>> from math import radians
    >>> site = Site(latitude_rad=radians(-34.93), longitude_rad=radians(138.60))
    >>> flight = ScriptedFlight.steady(site, 1710068400.0, yaw_rate_rad_per_s=radians(8.0)).flight()
    >>> flight.attitude_source
    'script, 200.0 Hz'
    """

    q_body_ned: Callable[[Float], Float]
    site: Site
    start_utc_s: float
    duration_s: float = 10.0
    rate_hz: float = 200.0
    name: str = "scripted flight"

    @classmethod
    def steady(
        cls,
        site: Site,
        start_utc_s: float,
        *,
        duration_s: float = 10.0,
        rate_hz: float = 200.0,
        roll_rad: float = 0.0,
        pitch_rad: float = 0.0,
        yaw_rad: float = 0.0,
        roll_rate_rad_per_s: float = 0.0,
        pitch_rate_rad_per_s: float = 0.0,
        yaw_rate_rad_per_s: float = 0.0,
    ) -> Self:
        """Return a flight whose Euler angles change at constant rates.

        Parameters
        ----------
        site : Site
            The position.
        start_utc_s : float
            UTC of the first sample, seconds since 1970.
        duration_s, rate_hz : float
            Time from the first sample to the last, s; sample rate, Hz.
        roll_rad, pitch_rad, yaw_rad : float
            Euler angles at the start, rad.
        roll_rate_rad_per_s, pitch_rate_rad_per_s, yaw_rate_rad_per_s : float
            Rates of the angles, rad/s; equal to body rates only if the other two angles are zero.

        Returns
        -------
        ScriptedFlight
        """

        def script(t_s: Float) -> Float:
            return quaternion_from_euler(
                roll_rad + roll_rate_rad_per_s * t_s,
                pitch_rad + pitch_rate_rad_per_s * t_s,
                yaw_rad + yaw_rate_rad_per_s * t_s,
            )

        return cls(script, site, start_utc_s, duration_s, rate_hz)

    def samples(self) -> Iterator[Samples]:
        """Yield one batch of each kind."""
        clock_s = np.arange(round(self.duration_s * self.rate_hz) + 1) / self.rate_hz
        yield AttitudeSamples(clock_s, self.q_body_ned(clock_s), np.zeros(clock_s.size, dtype=np.int64), "script")
        latitude, longitude, height = np.array(
            [[self.site.latitude_rad], [self.site.longitude_rad], [self.site.height_m]]
        )
        yield PositionSamples(clock_s[:1], latitude, longitude, height, "script")
        yield ClockSamples(clock_s[:1], np.array([self.start_utc_s]), "script")

    def close(self) -> None:
        """Do nothing."""

    def flight(self) -> Flight:
        """Return the flight.

        Returns
        -------
        Flight
        """
        return read_flight(self)
