"""A flight: attitude and position over UTC, where each comes from, and what else a log records of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from math import isfinite
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float, Integer
from glstar.errors import ConfigError, TelemetryError
from glstar.flight.attitude import AttitudeTrack
from glstar.sky.place.site import Site


@dataclass(frozen=True, slots=True, eq=False)
class PositionTrack:
    """Recorded position over UTC.

    Attributes
    ----------
    utc_s : (n,) float64, n >= 1
        Sample times, UTC seconds since 1970, strictly increasing.
    latitude_rad, longitude_rad : (n,) float64
        WGS84 latitude, and longitude positive eastward, rad; continuous: beyond pi east of the date line.
    height_m : (n,) float64
        Height, m.

    Raises
    ------
    TelemetryError
        If there is no sample, or the times do not increase.
    """

    utc_s: Float
    latitude_rad: Float
    longitude_rad: Float
    height_m: Float

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.utc_s, self.latitude_rad, self.longitude_rad, self.height_m)}
        if len(shapes) != 1 or self.utc_s.ndim != 1 or self.utc_s.size < 1:
            raise TelemetryError(f"a position track needs four columns of one length, not {sorted(shapes)}")
        if not np.all(np.diff(self.utc_s) > 0):
            raise TelemetryError("the times of a position track must increase")
        # Continuous, so that interpolation across the date line does not go around the world.
        object.__setattr__(self, "longitude_rad", np.unwrap(self.longitude_rad))
        for array in (self.utc_s, self.latitude_rad, self.longitude_rad, self.height_m):
            array.flags.writeable = False

    @classmethod
    def from_samples(
        cls, utc_s: ArrayLike, latitude_rad: ArrayLike, longitude_rad: ArrayLike, height_m: ArrayLike
    ) -> Self:
        """Return a track from samples as logged: unsorted and repeated.

        Parameters
        ----------
        utc_s, latitude_rad, longitude_rad, height_m : (n,) array_like
            Sample times (UTC seconds since 1970) and positions (rad, rad, m); samples that are not finite are dropped.

        Returns
        -------
        PositionTrack

        Raises
        ------
        TelemetryError
            If no sample remains.
        """
        arrays = [np.asarray(column, dtype=np.float64) for column in (utc_s, latitude_rad, longitude_rad, height_m)]
        if len({array.shape for array in arrays}) != 1:
            raise TelemetryError(f"a position track needs four columns of one length, not {[a.size for a in arrays]}")
        columns = np.stack(arrays)
        columns = columns[:, np.isfinite(columns).all(axis=0)]
        _, first = np.unique(columns[0], return_index=True)
        # Each column in consecutive memory: np.interp would copy the whole of it at every call.
        return cls(*(column[first] for column in columns))

    @classmethod
    def joined(cls, tracks: Sequence[Self]) -> Self:
        """Concatenate tracks.

        Parameters
        ----------
        tracks : sequence of PositionTrack
            One or more, sorted by time, without overlaps.

        Returns
        -------
        PositionTrack
        """
        columns = ("utc_s", "latitude_rad", "longitude_rad", "height_m")
        return cls(*(np.concatenate([getattr(track, column) for track in tracks]) for column in columns))

    def clipped(self, first_utc_s: float, last_utc_s: float) -> Self:
        """Return the part of the track within a time interval, with a sample at both of its ends.

        Parameters
        ----------
        first_utc_s, last_utc_s : float
            Ends of the interval, UTC seconds since 1970; outside the track the nearest sample is used.

        Returns
        -------
        PositionTrack
        """
        inside = self.utc_s[(self.utc_s > first_utc_s) & (self.utc_s < last_utc_s)]
        utc_s = np.concatenate([[first_utc_s], inside, [last_utc_s]])
        columns = (self.latitude_rad, self.longitude_rad, self.height_m)
        return type(self)(utc_s, *(np.interp(utc_s, self.utc_s, column) for column in columns))

    @classmethod
    def fixed(cls, site: Site) -> Self:
        """Return the track of an observer at rest.

        Parameters
        ----------
        site : Site
            Where the observer is.

        Returns
        -------
        PositionTrack
        """
        return cls(*(np.array([x]) for x in (0.0, site.latitude_rad, site.longitude_rad, site.height_m)))

    def at(self, utc_s: float) -> Site:
        """Return the position at a time, in standard air.

        Before the first sample and after the last, the nearest sample is used: a GPS fix often comes later than the
        first attitude, and 1 km changes the altitudes of stars by only 32".

        Parameters
        ----------
        utc_s : float
            Time, UTC seconds since 1970.

        Returns
        -------
        Site
        """
        return Site(*(float(x) for x in self.coordinates(utc_s)))

    def coordinates(self, utc_s: ArrayLike) -> tuple[Float, Float, Float]:
        """Return latitude, longitude and height at each of the given times; see `at`.

        Parameters
        ----------
        utc_s : (m,) array_like
            Times, UTC seconds since 1970.

        Returns
        -------
        latitude_rad, longitude_rad, height_m : (m,) float64
            Longitude from -pi to pi.
        """
        t = np.asarray(utc_s, dtype=np.float64)
        longitude_rad = np.interp(t, self.utc_s, self.longitude_rad)
        return (
            np.interp(t, self.utc_s, self.latitude_rad),
            (longitude_rad + np.pi) % (2 * np.pi) - np.pi,
            np.interp(t, self.utc_s, self.height_m),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Where an aircraft is at the end of a step.

    Attributes
    ----------
    q_body_ned : (4,) array_like
        Unit quaternion (w, x, y, z), NED to body.
    site : Site
    """

    q_body_ned: ArrayLike
    site: Site

    @property
    def unit(self) -> Float:
        """The quaternion, normalised, (4,) float64.

        Raises
        ------
        ConfigError
            If it is not four finite numbers, or all of them are 0.
        """
        q = np.asarray(self.q_body_ned, dtype=np.float64)
        length = float(np.linalg.norm(q))
        if q.shape != (4,) or not (isfinite(length) and length > 0):
            raise ConfigError(f"a pose's q_body_ned must be four finite numbers (w, x, y, z), not {self.q_body_ned!r}")
        unit: Float = q / length
        return unit


@dataclass(frozen=True, slots=True, eq=False)
class TimedRecord:
    """What a log records at several times."""

    utc_s: NDArray[np.float64]  # (n,) UTC seconds since 1970

    def shifted(self, shift_s: float) -> Self:
        """Return the record with a shift added to all times, s."""
        return replace(self, utc_s=self.utc_s + shift_s)


class EventKind(StrEnum):
    """A kind of event."""

    MODE = "mode"
    MESSAGE = "message"


@dataclass(frozen=True, slots=True, eq=False)
class FlightEvents(TimedRecord):
    """Flight modes and messages of an autopilot, in ascending order of time."""

    kinds: tuple[EventKind, ...]  # Kind of each event
    texts: tuple[str, ...]  # The mode that begins (``"LOITER"``), or the message

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> Self | None:
        """Return the events of several parts of a flight in the order of time; None if there are none."""
        events = [event for part in parts for event in zip(part.utc_s.tolist(), part.kinds, part.texts, strict=True)]
        if not events:
            return None
        times_s, kinds, texts = zip(*sorted(events, key=lambda event: event[0]), strict=True)
        return cls(np.array(times_s), kinds, texts)


@dataclass(frozen=True, slots=True)
class ClockQuality:
    """Agreement between the UTC readings of a log, and their logging delay."""

    readings: int  # Number of readings
    spread_s: float  # 95th percentile of the deviations from the median, s
    largest_s: float  # Largest deviation from the median, s
    # Median delay from the GPS sample to its record in the log, s; None where it does not matter.
    lag_s: float | None = None
    lag_is_measured: bool = False  # Whether the log contains the delay; otherwise the usual one is assumed
    cut: int = 0  # Number of other readings that disagree and are not used


# Name of the triggers of a camera without a number or a topic of its own, and of those of the only camera.
ONLY_CAMERA = "camera"


@dataclass(frozen=True, slots=True, eq=False)
class CameraTriggers(TimedRecord):
    """When one camera was triggered, by the log of the aircraft; times are in the order of the images."""

    source: str  # The message that says so: ``"CAM"``
    camera: str = ONLY_CAMERA  # Name by which ``--at`` chooses it: ``"camera:1"``, ``"/cam0/camera_info"``
    number: Integer | None = None  # (n,) number of each image, by the camera; None if their order numbers them

    @property
    def numbers(self) -> Integer:
        """Number of each image, (n,), from 0; by the camera, some may be missing."""
        return np.arange(self.utc_s.size) if self.number is None else self.number

    @classmethod
    def joined(cls, parts: Iterable[Self]) -> tuple[Self, ...]:
        """Join parts of a flight: return the triggers of each camera once, in the order of their parts."""
        by_camera: dict[str, list[Self]] = {}
        for part in parts:
            by_camera.setdefault(part.camera, []).append(part)
        return tuple(
            replace(
                cameras[0], utc_s=np.concatenate([part.utc_s for part in cameras]), number=cls._joined_numbers(cameras)
            )
            for cameras in by_camera.values()
        )

    @staticmethod
    def _joined_numbers(parts: Sequence["CameraTriggers"]) -> Integer | None:
        """Return the numbers of the images of several parts; None if a number is unknown, or if two images have it."""
        known = [part.number for part in parts if part.number is not None]
        number = np.concatenate(known) if known and len(known) == len(parts) else np.empty(0, dtype=np.int64)
        return number if number.size and np.unique(number).size == number.size else None


@dataclass(frozen=True, slots=True, eq=False)
class GimbalAttitude(TimedRecord):
    """The attitude of a gimbal's platform, as a log states it."""

    # (n, 4) unit quaternions (w, x, y, z) that turn components in the frame of reference into those of the platform.
    q_gimbal_reference: NDArray[np.float64]
    # (n,) bool: whether the frame of reference is NED; otherwise it is level, with its first axis along the aircraft's
    # heading.
    is_earth: NDArray[np.bool_]
    source: str  # The message that says so: ``"GIMBAL_DEVICE_ATTITUDE_STATUS"``


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Attitude and position of an aircraft over UTC.

    Attributes
    ----------
    attitude : AttitudeTrack
        Attitude of the body that carries the camera: the aircraft, or the platform of its gimbal.
    position : PositionTrack
    name : str
        File name of the log.
    attitude_source, position_source, utc_source : str
        Source of each, for messages: ``"XKQ lane 0, 200.0 Hz"``.
    time_offset_s : float
        The camera's clock minus UTC, s.  It only applies to names of images: an image with the camera's timestamp t was
        taken at t - `time_offset_s`.
    notes : tuple of str
        Remarks for the user on how the log was read.
    clocks : tuple of ClockQuality
        Quality of UTC, for each boot; empty where the user gave UTC, or where UTC is the clock of the log.
    triggers : tuple of CameraTriggers
        When each camera was triggered; empty if the log does not say.
    gimbal : GimbalAttitude or None
        What the log states of a gimbal; None if it has none.
    events : FlightEvents or None
        Flight modes and messages; None if the log has none.
    own_attitude : AttitudeTrack or None
        The attitude of the aircraft, where `attitude` is a gimbal platform's; else None.
    """

    attitude: AttitudeTrack
    position: PositionTrack
    name: str = "flight"
    attitude_source: str = "given"
    position_source: str = "given"
    utc_source: str = "given"
    time_offset_s: float = 0.0
    notes: tuple[str, ...] = ()
    clocks: tuple[ClockQuality, ...] = ()
    triggers: tuple[CameraTriggers, ...] = ()
    gimbal: GimbalAttitude | None = None
    own_attitude: AttitudeTrack | None = None
    events: FlightEvents | None = None

    @property
    def aircraft_attitude(self) -> AttitudeTrack:
        """The attitude of the aircraft, whether or not a gimbal carries the camera."""
        return self.attitude if self.own_attitude is None else self.own_attitude

    def triggers_of(self, camera: str) -> CameraTriggers:
        """Return the triggers of a camera.

        Parameters
        ----------
        camera : str
            Value of ``--at``: the name of a camera in `triggers`, or ``"camera"`` for the only one.

        Returns
        -------
        CameraTriggers

        Raises
        ------
        ConfigError
            If the log has no such camera, or ``"camera"`` could be several.
        """
        by_name = {triggers.camera: triggers for triggers in self.triggers}
        if camera == ONLY_CAMERA and len(by_name) == 1:
            return self.triggers[0]
        if camera in by_name and camera != ONLY_CAMERA:
            return by_name[camera]
        if not by_name:
            raise ConfigError(
                f"{self.name} does not say when a camera was triggered (CAM, TRIG, CAMERA_FEEDBACK, camera_capture,"
                f" CameraInfo); leave out --at {camera}"
            )
        named = ", ".join(f"{name} ({triggers.utc_s.size} triggers)" for name, triggers in by_name.items())
        if camera == ONLY_CAMERA:
            raise ConfigError(f"{self.name} has triggers of {len(by_name)} cameras; give one to --at: {named}")
        raise ConfigError(f"{self.name} has no triggers of {camera!r} (--at); it has {named}")

    def shifted(self, shift_s: float) -> Self:
        """Return the flight with all times shifted.

        Parameters
        ----------
        shift_s : float
            Added to all times, s.

        Returns
        -------
        Flight
        """
        return replace(
            self,
            attitude=self.attitude.shifted(shift_s),
            position=replace(self.position, utc_s=self.position.utc_s + shift_s),
            triggers=tuple(camera.shifted(shift_s) for camera in self.triggers),
            gimbal=None if self.gimbal is None else self.gimbal.shifted(shift_s),
            own_attitude=None if self.own_attitude is None else self.own_attitude.shifted(shift_s),
            events=None if self.events is None else self.events.shifted(shift_s),
        )
