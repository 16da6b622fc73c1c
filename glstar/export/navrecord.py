"""What a navigator is handed of each frame: its image, clock, estimated attitude, nominal mount and lens."""

from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.flight.navigator import EstimatedAttitude
from glstar.render.truth import camera_keys
from glstar.rotation import conjugate, matrix_from_quaternion, multiply, turn_from_quaternion
from glstar.sky.timescale import format_utc

__all__ = ["NAV_SCHEMA", "Navigator"]

Float = NDArray[np.float64]

NAV_SCHEMA: Final = "glstar-nav-1"
_INSTANTS: Final = ("start", "middle", "end")
_UP_NED: Final = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Navigator:
    """What the aircraft knows on one flight.

    Attributes
    ----------
    attitude : EstimatedAttitude
    clock_offset_s : float
        The clock that stamps the frames minus UTC, s.
    camera : Camera
    C_camera_body : (3, 3) float64
        The nominal mount.
    position : PositionTrack or None
        None where GPS is denied.
    gimbal : (AttitudeTrack, AttitudeTrack) or None
        The attitudes of a gimbal's platform and of the aircraft, whose difference the gimbal states; None without one.
    """

    attitude: EstimatedAttitude
    clock_offset_s: float
    camera: Camera
    C_camera_body: Float
    position: PositionTrack | None
    gimbal: tuple[AttitudeTrack, AttitudeTrack] | None = None

    @classmethod
    def of(
        cls,
        config: Config,
        flight: Flight,
        *,
        estimate: AttitudeTrack | None = None,
        stream: int = 0,
        until_utc_s: float | None = None,
    ) -> Self:
        """Return the navigator of ``[navigator]``.

        Parameters
        ----------
        config : Config
        flight : Flight
        estimate : AttitudeTrack, optional
            The attitude of another message of the log; by default the flight's.
        stream : int
            Index of the flight in a data set: another realisation of the random errors.
        until_utc_s : float, optional
            Until when errors are drawn, UTC seconds since 1970; by default the end of the flight.

        Returns
        -------
        Navigator
        """
        section = config.navigator
        rng = np.random.default_rng([section.seed, stream])
        last_utc_s = flight.attitude.last_s if until_utc_s is None else until_utc_s
        errors = section.errors.drawn(flight.attitude.first_s, last_utc_s, rng)
        return cls(
            EstimatedAttitude(
                flight.aircraft_attitude if estimate is None else estimate, errors, is_held=estimate is None
            ),
            flight.time_offset_s + section.clock_offset_s,
            config.camera(),
            config.mount().C_camera_body,
            flight.position if section.gps == "known" else None,
            None if flight.own_attitude is None else (flight.attitude, flight.own_attitude),
        )

    def record(self, exposure: Exposure, *, number: int, file: str) -> dict[str, Any]:
        """Return the record of one frame, ready for JSON.

        Parameters
        ----------
        exposure : Exposure
            When the camera really exposed.
        number : int
            The frame's number.
        file : str
            Its image.

        Returns
        -------
        dict
            ``schema, frame, file, utc`` and ``q_body_ned`` (at start, middle and end of the exposure),
            ``duration_s, readout_s, readout, rates_rad_per_s`` (forward, right, down; the mean over the exposure),
            ``up_camera`` (at the same instants), ``C_camera_body``, ``camera`` and ``position`` (null where GPS is
            denied).  The estimated attitude is that of the time on the frame's stamp, which the clock's error moves;
            ``q_body_ned``, ``rates_rad_per_s`` and ``up_camera`` are None where the estimate has a gap then.
            With a gimbal, all attitudes are those of its platform, and ``gimbal`` has ``q_gimbal_aircraft`` (from the
            aircraft to the platform, by the gimbal's joints) and ``q_aircraft_ned`` at the same instants.
        """
        true_s = np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])
        stamped_s = true_s + self.clock_offset_s
        q_body_ned = self.attitude.at(stamped_s)
        is_known = self.attitude.is_known(float(stamped_s[0]), float(stamped_s[2]))
        gimbal: dict[str, Any] = {}
        if self.gimbal is not None:
            turned, q_aircraft_ned = self._turned(stamped_s), q_body_ned
            q_body_ned = multiply(turned, q_aircraft_ned)
            aircraft = _at_instants(q_aircraft_ned) if is_known else None
            gimbal = {"gimbal": {"q_gimbal_aircraft": _at_instants(turned), "q_aircraft_ned": aircraft}}
        up_camera = matrix_from_quaternion(q_body_ned) @ _UP_NED @ self.C_camera_body.T
        rates = turn_from_quaternion(multiply(q_body_ned[2], conjugate(q_body_ned[0]))) / exposure.span_s
        return {
            "schema": NAV_SCHEMA,
            "frame": number,
            "file": file,
            "utc": {name: format_utc(utc_s) for name, utc_s in _at_instants(stamped_s).items()},
            "duration_s": exposure.duration_s,
            "readout_s": exposure.readout_s,
            "readout": exposure.readout,
            "q_body_ned": _at_instants(q_body_ned) if is_known else None,
            "rates_rad_per_s": rates.tolist() if is_known else None,
            "up_camera": _at_instants(up_camera) if is_known else None,
            "C_camera_body": self.C_camera_body.tolist(),
            "camera": camera_keys(self.camera),
            "position": self._position(float(true_s[1])),
            **gimbal,
        }

    def _turned(self, utc_s: Float) -> Float:
        """Return the rotations from the aircraft to the platform of the gimbal, (n, 4), by its joints."""
        assert self.gimbal is not None
        platform, aircraft = self.gimbal
        inside_s = np.clip(utc_s, platform.first_s, platform.last_s)
        return multiply(platform.at(inside_s), conjugate(aircraft.at(inside_s)))

    def _position(self, utc_s: float) -> dict[str, float] | None:
        if self.position is None:
            return None
        site = self.position.at(utc_s)
        return {
            "latitude_deg": float(np.rad2deg(site.latitude_rad)),
            "longitude_deg": float(np.rad2deg(site.longitude_rad)),
            "height_m": site.height_m,
        }


def _at_instants(values: Float) -> dict[str, Any]:
    """Return the values at start, middle and end of an exposure, by name."""
    return dict(zip(_INSTANTS, values.tolist(), strict=True))
