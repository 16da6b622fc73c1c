"""A copy of what a receiver holds, from which a flight is made while the link continues to receive."""

from dataclasses import dataclass, replace
from typing import Self

from glstar.errors import TelemetryError
from glstar.flight import Flight
from glstar.flight.gimbal import Gimbal
from glstar.link.history import Estimate, HistorySnapshot
from glstar.link.receiver import Receiver
from glstar.telemetry.recording import FlightOptions
from glstar.telemetry.source import GimbalSamples

__all__ = ["Received"]


@dataclass(frozen=True, slots=True)
class Received:
    """The last minutes of one autopilot.

    Attributes
    ----------
    utc_minus_boot_s : float
        UTC minus the time since boot, s.
    utc_source, attitude_source, estimate_source : str
        Where UTC, the attitude of the sky and that of the estimate come from.
    sky : HistorySnapshot
        What the sky is drawn from.
    estimated : HistorySnapshot or None
        What the autopilot estimates, if the sky is that of a simulator.
    gimbal : GimbalSamples or None
        The attitudes of its gimbal over UTC.
    is_on_gimbal : bool
        Whether the camera is on the gimbal.
    """

    utc_minus_boot_s: float
    utc_source: str
    attitude_source: str
    estimate_source: str
    sky: HistorySnapshot
    estimated: HistorySnapshot | None
    gimbal: GimbalSamples | None
    is_on_gimbal: bool

    @classmethod
    def of(cls, receiver: Receiver, last_s: float, *, with_gimbal: bool) -> Self | None:
        """Copy what a receiver holds.

        Parameters
        ----------
        receiver : Receiver
        last_s : float
            Largest duration, s.
        with_gimbal : bool
            Whether the camera is on its gimbal.

        Returns
        -------
        Received or None
            None while UTC is not known.
        """
        utc_minus_boot_s, simulator = receiver.clock.utc_minus_boot_s, receiver.simulator
        if utc_minus_boot_s is None:
            return None
        return cls(
            utc_minus_boot_s,
            receiver.clock.source or "",
            (simulator and simulator.source) or receiver.attitude_source,
            receiver.attitude_source,
            receiver.sky_history.snapshot(last_s),
            None if simulator is None else receiver.history.snapshot(last_s),
            receiver.gimbal.samples(utc_minus_boot_s, last_s),
            with_gimbal,
        )

    def flight(self, name: str, position_source: str, options: FlightOptions) -> Flight | None:
        """Return the flight of the body that carries the camera.

        Parameters
        ----------
        name, position_source : str
        options : FlightOptions
            Without `utc_start`.

        Returns
        -------
        Flight or None
            None if attitude, position or the attitude of the gimbal are not known.
        """
        flight = self.sky.flight(
            self.utc_minus_boot_s,
            name=name,
            attitude_source=self.attitude_source,
            position_source=position_source,
            utc_source=self.utc_source,
            options=options,
        )
        if flight is None:
            return None
        flight = replace(flight, gimbal=None if self.gimbal is None else self.gimbal.over_utc(0.0))
        if not self.is_on_gimbal:
            return flight
        try:
            return Gimbal("log").carried(flight)
        except TelemetryError:
            return None

    def estimate(self, options: FlightOptions) -> Estimate | None:
        """Return what the autopilot estimates, if the sky is that of a simulator and its attitude is known.

        Parameters
        ----------
        options : FlightOptions
            Without `utc_start`.

        Returns
        -------
        Estimate or None
        """
        if self.estimated is None:
            return None
        return self.estimated.estimate(self.utc_minus_boot_s, attitude_source=self.estimate_source, options=options)
