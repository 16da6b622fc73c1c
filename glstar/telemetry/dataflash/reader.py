"""The reader of DataFlash logs: boots, attitude, UTC and position by GPS, gyro rates, gimbal, modes and messages."""

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.flight import ONLY_CAMERA, EventKind
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.timescale import GPS_EPOCH_S, WEEK_S, leap_seconds
from glstar.telemetry import source
from glstar.telemetry.boots import find_boots
from glstar.telemetry.dataflash.attitude import (
    AttitudeEstimate,
    active_estimator,
    estimates,
    estimator_notes,
    flown_attitude,
)
from glstar.telemetry.dataflash.records import DATAFLASH_MAGIC, BinaryRecords, Records, nearest, numbered, stamped
from glstar.telemetry.dataflash.text import TextRecords, is_dataflash_text
from glstar.telemetry.mavlink.vehicles import ardupilot_mode

_FIX_3D = 3
# Delay from a GPS sample to its record, s: 16 to 30 ms in the mean of logs with GPA, 21 ms by SYSTEM_TIME in the
# telemetry log of the Adelaide flight.
LOGGED_LATE_S = 0.020
# A GPA record belongs to the GPS record of the same receiver that was written within this time, s.
_SAME_SAMPLE_S = 0.05
# A sample that is older when it is written, s, has another clock.
_LATEST_S = 2.0
# Names of week and millisecond, now and before 2015.
_WEEK_AND_MS = (("GWk", "GMS"), ("Week", "TimeMS"))
_UNSTAMPED = "its GPS records are not stamped with the time since boot (TimeUS or T)"
# Raw samples are used if they cover this fraction of the flight; they may be logged for a part of it.
_NEARLY_ALL = 0.95

# Roll and pitch against the horizon, deg; the yaw against the aircraft's heading and against north, deg.
_ANGLES = ("Roll", "Pitch", "YawB", "YawE")
# Messages by which reboots are detected: those that are logged at a steady rate.
_CLOCKED = ["ATT", "AHR2", "SIM", "POS", "GPS"]
_CLOCKED += [f"{name}{number}" for name in ("XKQ", "NKQ", "IMU", "GYR") for number in ("", 1, 2, 3)]

# Firmware in a message: ArduPlane V4.5.1 (1a2b3c4d); APM:Copter V3.3 (acf71d5f); Rover V4.2.0-dev.
_FIRMWARE = re.compile(
    r"(?P<vehicle>(?:Ardu|APM:)[A-Z]\w+|AntennaTracker|Blimp|Rover) [Vv]?\d[\w.+-]*(?: \([0-9a-fA-F]+\))?"
)
# Vehicle by VER.BU, the build type of a firmware.
_BY_BUILD_TYPE = {
    1: "ArduRover",
    2: "ArduCopter",
    3: "ArduPlane",
    4: "AntennaTracker",
    7: "ArduSub",
    12: "Blimp",
    13: "ArduCopter",
}
# Parameters that only one kind of vehicle has.
_BY_PARAMETER = {
    "LIM_ROLL_CD": "ArduPlane",
    "ROLL_LIMIT_DEG": "ArduPlane",
    "PILOT_THR_BHV": "ArduCopter",
    "THR_MID": "ArduCopter",
    "CRUISE_SPEED": "ArduRover",
    "JS_GAIN_DEFAULT": "ArduSub",
}
# Records of a triggered camera: its answer, else that the trigger was sent, and the number of the camera in both.
_ANSWER, _TRIGGER, _CAMERA = "CAM", "TRIG", "I"


def is_dataflash(head: bytes) -> bool:
    """Return whether a file is a DataFlash log, binary or text, by its first bytes."""
    return head.startswith(DATAFLASH_MAGIC) or is_dataflash_text(head)


class DataFlashReader(source.TelemetrySource):
    """A DataFlash log as a telemetry source; its clock is the autopilot's time since boot.

    Every complete record of a truncated or damaged log is read.  The options are those of `open_source`: `attitude` is
    ``"auto"`` for the EKF lane in use, or ATT if no EKF was in use; or a message, ``"ATT"``, ``"AHR2"``, ``"SIM"``, or
    one lane of it as ``"XKQ1"`` or ``"XKQ[1]"``.  Raises LogFormatError if the file holds no complete record.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", boot: int | None = None) -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        self._boot = boot
        with Path(self.name).open("rb") as file:
            head = file.read(len(DATAFLASH_MAGIC))
        if not head:
            raise LogFormatError(self.name, "is empty: 0 bytes", offset=0)
        self._log: Records = BinaryRecords(self.name) if head == DATAFLASH_MAGIC else TextRecords(self.name)

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and, if the log has them, gyro rates of each boot, a batch each.

        Raises LogFormatError if the log has no attitude, not the requested one, or no such boot.
        """
        refusals: list[LogFormatError] = []
        for number, log in self._parts:
            try:
                attitude = self._requested(log)
            except LogFormatError as error:
                refusals.append(error)
                continue
            yield replace(attitude, boot=number)
            yield from (replace(batch, boot=number) for batch in self._beside_attitude(log))
        if len(refusals) == len(self._parts):
            raise refusals[0]

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:
        """Return the vehicle, its firmware and its estimator; `boots`: numbers of the boots; by default all."""
        facts = [_facts(log) for number, log in self._parts if not boots or number in boots]
        return source.LogFacts.joined(self._log.kind, facts, self._log.unread_bytes)

    def boots(self) -> tuple[source.Boot, ...]:
        """Return the boots of the log, or the requested one; raises LogFormatError if the log has no such boot."""
        return source.chosen_boots(self.name, self._found_boots, self._boot)

    def attitudes(self) -> Iterator[tuple[str, source.AttitudeSamples]]:
        """Yield the name and the samples of every lane of every attitude estimate, boot by boot."""
        for number, log in self._parts:
            for estimate in estimates(log):
                for lane in estimate.lanes:
                    yield estimate.called(lane), replace(estimate.only(lane), boot=number)

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    @cached_property
    def _found_boots(self) -> tuple[source.Boot, ...]:
        return boots_of(self._log)

    @cached_property
    def _parts(self) -> list[tuple[int, Records]]:
        """Number and records of each requested boot."""
        boots = self.boots()
        is_single = len(self._found_boots) == 1 and self._found_boots[0] == source.Boot(1)
        return [(boot.number, self._log if is_single else self._log.only(boot.spans)) for boot in boots]

    def _beside_attitude(self, log: Records) -> Iterator[source.Samples]:
        """Yield all other samples of one boot."""
        yield _positions(log)
        yield _utc(log)
        yield from _triggers(log)
        for samples in (_turn_rates(log), _gimbal(log)):
            if samples is not None:
                yield samples
        yield from _events(log, _facts(log).vehicle)

    def _requested(self, log: Records) -> source.AttitudeSamples:
        if self._attitude.lower() == "auto":
            if (flown := flown_attitude(log)) is not None:
                return _with_notes(log, *flown)
            raise self._error(f"the log has no attitude: {_contents(log)}")

        name = self._attitude.upper()
        lane: int | None = None
        estimate = AttitudeEstimate.of(log, name)
        if estimate is None and (requested := re.fullmatch(r"(.+?)(?:(\d)|\[(\d+)\])", name)):
            estimate = AttitudeEstimate.of(log, requested[1])
            lane = int(requested[2] or requested[3])
        if estimate is None or (lane is not None and lane not in estimate.lanes):
            offered = [estimate.summary() for estimate in estimates(log)]
            if not offered:
                raise self._error(f"the log has no attitude: {_contents(log)}")
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {'; '.join(offered)}")
        return _with_notes(log, estimate, estimate.primary(log) if lane is None else estimate.only(lane))

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._log.end)


def boots_of(log: Records, *, knows_utc: bool | None = None) -> tuple[source.Boot, ...]:
    """Return the boots of a log, in the order of the file; `knows_utc`: by default whether its GPS has UTC."""
    series = [(log.position(name), records[0]) for name in _CLOCKED if (records := stamped(log, name)) is not None]
    return find_boots(series, _gps_readings(log), log.heads, log.alike, knows_utc=knows_utc)


def _with_notes(log: Records, estimate: AttitudeEstimate, samples: source.AttitudeSamples) -> source.AttitudeSamples:
    return replace(samples, notes=estimator_notes(log, estimate, samples))


def _facts(log: Records) -> source.LogFacts:
    for text in (*log.texts("VER", "FWS"), *log.texts("MSG", "Message")):
        if firmware := _FIRMWARE.search(text):
            vehicle = firmware["vehicle"].replace("APM:", "Ardu")
            return source.LogFacts(log.kind, vehicle, firmware[0], active_estimator(log))
    built_for = log.columns("VER", "BU")
    if built_for is not None and built_for[0].size and built_for[0][0] in _BY_BUILD_TYPE:
        return source.LogFacts(log.kind, _BY_BUILD_TYPE[int(built_for[0][0])], estimator=active_estimator(log))
    vehicles = {_BY_PARAMETER[name] for name in log.texts("PARM", "Name") if name in _BY_PARAMETER}
    return source.LogFacts(log.kind, vehicles.pop() if len(vehicles) == 1 else None, estimator=active_estimator(log))


def _contents(log: Records) -> str:
    if {"Roll", "Pitch", "Yaw"} <= set(log.fields("ATT")) and stamped(log, "ATT") is None:
        return "its ATT records are not stamped with a time (ArduPilot before 2014), and glstar guesses none"
    return f"no XKQ, NKQ or ATT among the messages {', '.join(log.names)}{log.loss()}"


def _positions(log: Records) -> source.PositionSamples:
    """Return the positions of a log; if there are none, an empty batch that says why."""
    names = ("Lat", "Lng", "Alt")
    if (records := stamped(log, "POS", *names)) is not None:
        latitude_deg, longitude_deg, height_m = records[1]
        samples = source.position_samples(records[0], latitude_deg, longitude_deg, height_m, "POS")
        if samples.clock_s.size:
            return samples
    if "GPS" not in log:
        return source.no_position_samples("it has neither POS nor GPS records")
    if (fixes := _fixes(log, *names)) is None:
        return source.no_position_samples(_UNSTAMPED)
    _, clock_s, (latitude_deg, longitude_deg, height_m) = fixes
    samples = source.position_samples(clock_s, latitude_deg, longitude_deg, height_m, "GPS")
    return samples if samples.clock_s.size else source.no_position_samples("its GPS never had a 3D fix")


def _utc(log: Records) -> source.ClockSamples:
    """Return the UTC readings of the GPS of a log; if there are none, an empty batch that says why."""
    if "GPS" not in log:
        return source.no_clock_samples("it has no GPS records")
    fields = set(log.fields("GPS"))
    names = next((names for names in _WEEK_AND_MS if set(names) <= fields), None)
    if names is None:
        return source.no_clock_samples("its GPS records have no week and milliseconds (GWk, GMS)")
    if (fixes := _fixes(log, *names)) is None:
        return source.no_clock_samples(_UNSTAMPED)
    receiver, clock_s, (week, week_ms) = fixes
    fixed = week > 0
    if not fixed.any():
        return source.no_clock_samples("its GPS never had a 3D fix and a week")
    gps_s = _gps_s(week, week_ms)
    plausible = fixed & source.plausible_utc(gps_s)
    if not plausible.any():
        odd = f"its GPS says week {np.median(week[fixed]):.0f}, {1980 + np.median(week[fixed]) / 52.18:.0f}"
        return source.no_clock_samples(f"{odd}: the receiver's week has rolled over")
    clock_s, gps_s = clock_s[plausible], gps_s[plausible]
    sampled_s = _sampled_s(log, receiver, clock_s)
    valid = np.isfinite(sampled_s)
    if valid.any():
        how = "GPS time at GPA.SMS"
        lag_s = float(np.median((clock_s - sampled_s)[valid]))
        clock_s, gps_s = sampled_s[valid], gps_s[valid]
    else:
        how = f"GPS time when logged ({'GPA.SMS is of another clock' if 'GPA' in log else 'no GPA'})"
        lag_s = LOGGED_LATE_S
        clock_s = clock_s - LOGGED_LATE_S
    leap_s = leap_seconds(float(np.median(gps_s)))
    message = f"{how}, {gps_s.size} fixes, {leap_s:.0f} leap seconds"
    return source.ClockSamples(clock_s, gps_s - leap_s, message, lag_s=lag_s, lag_is_measured=bool(valid.any()))


def _gps_readings(log: Records) -> tuple[Integer, Float, Float]:
    """Return file positions, times since boot, s, and GPS times, s since 1970, of the readings of the GPS in use."""
    for names in _WEEK_AND_MS:
        if (records := stamped(log, "GPS", "Status", *names)) is None:
            continue
        clock_s, (status, week, week_ms) = records
        gps_s = _gps_s(week, week_ms)
        valid = (status >= _FIX_3D) & (week > 0) & source.plausible_utc(gps_s)
        receivers, in_use = numbered(log, "GPS", "I"), log.columns("GPS", "U")
        if in_use is not None and (valid & (in_use[0] == 1)).any():
            valid &= in_use[0] == 1
        elif valid.any():
            numbers, count = np.unique(receivers[valid], return_counts=True)
            valid &= receivers == numbers[count.argmax()]
        return log.position("GPS")[valid], clock_s[valid], gps_s[valid]
    return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)


def _gps_s(week: Float, week_ms: Float) -> Float:
    """Return GPS time, s since 1970, of weeks and the milliseconds in them, among them damaged ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        return GPS_EPOCH_S + week * WEEK_S + week_ms * 1e-3


def _fixes(log: Records, *names: str) -> tuple[int, Float, list[Float]] | None:
    """Return the number of the GPS receiver in use, and times and columns of its records with a 3D fix.

    None if a column is missing, or the records have no time since boot.
    """
    if (records := stamped(log, "GPS", "Status", *names)) is None:
        return None
    clock_s, (status, *columns) = records
    receivers, in_use = numbered(log, "GPS", "I"), log.columns("GPS", "U")
    fixed = status >= _FIX_3D
    if in_use is not None and (fixed & (in_use[0] == 1)).any():
        fixed &= in_use[0] == 1
    numbers, count = np.unique(receivers[fixed], return_counts=True)
    receiver = int(numbers[count.argmax()]) if numbers.size else 0
    fixed &= (receivers == receiver) & source.valid_times(clock_s)
    return receiver, clock_s[fixed], [column[fixed] for column in columns]


def _sampled_s(log: Records, receiver: int, clock_s: Float) -> Float:
    """Return the times of the samples of GPS records written at given times, s since boot; NaN without GPA."""
    sampled_s = np.full(clock_s.size, np.nan)
    if (accuracy := log.columns("GPA", "TimeUS", "SMS")) is None:
        return sampled_s
    valid = (accuracy[1] > 0) & (numbered(log, "GPA", "I") == receiver)
    written_s, sms_s = accuracy[0][valid] * 1e-6, accuracy[1][valid] * 1e-3
    if written_s.size:
        near = nearest(written_s, clock_s)
        together = np.abs(written_s[near] - clock_s) < _SAME_SAMPLE_S
        together &= np.abs(sms_s[near] - clock_s) <= _LATEST_S
        sampled_s[together] = sms_s[near][together]
    return sampled_s


def _turn_rates(log: Records) -> source.RateSamples | None:
    """Return the rates of one gyro: raw samples (GYR) if they cover the flight, else filtered ones (IMU).

    Both are in the axes of the autopilot's board, forward, right, down, as XKQ is.  Of several gyros, which are on one
    board, the first one is used.  None if the log has no rates.
    """
    filtered, raw = _first_gyro(log, "IMU"), _first_gyro(log, "GYR")
    if raw is None or filtered is None:
        return filtered or raw
    whole_s, raw_s = np.ptp(filtered.clock_s), np.ptp(raw.clock_s)
    faster = raw.clock_s.size / max(raw_s, 1e-6) > filtered.clock_s.size / max(whole_s, 1e-6)
    return raw if faster and raw_s >= _NEARLY_ALL * whole_s else filtered


def _first_gyro(log: Records, name: str) -> source.RateSamples | None:
    """Return the rates of the first instance; older logs number the messages (IMU, IMU2; GYR1, GYR2) instead."""
    for spelling in (name, *(f"{name}{number}" for number in (1, 2, 3))):
        if (records := stamped(log, spelling, "GyrX", "GyrY", "GyrZ")) is None:
            continue
        clock_s, rates = records
        if name == "GYR":  # written in bursts, with the time of each sample
            if (sampled := log.columns(spelling, "SampleUS")) is None:
                continue
            is_near = np.abs(sampled[0] * 1e-6 - clock_s) <= _LATEST_S
            clock_s = np.where(is_near, sampled[0] * 1e-6, clock_s)
        instance, rate_rad_per_s = numbered(log, spelling, "I"), np.stack(rates, axis=-1)
        valid = source.valid_rates(rate_rad_per_s)
        for number in np.unique(instance[valid]):
            rows = np.flatnonzero(valid & (instance == number))
            rows = rows[source.valid_times(clock_s[rows])]
            if rows.size > 1:
                return source.RateSamples(clock_s[rows], rate_rad_per_s[rows], f"{spelling} {number}")
    return None


def _triggers(log: Records) -> Iterator[source.TriggerSamples]:
    """Yield when each camera was triggered: CAM, written when the camera answered, otherwise TRIG."""
    answered, sent = (dict(_of_cameras(log, name)) for name in (_ANSWER, _TRIGGER))
    for camera in sorted({*answered, *sent}):
        name, clock_s = (_ANSWER, answered[camera]) if camera in answered else (_TRIGGER, sent[camera])
        notes: tuple[str, ...] = ()
        if camera in sent and (lost := sent[camera].size - clock_s.size) > 0:
            notes = (f"{lost} of {sent[camera].size} triggers of {camera} ({_TRIGGER}) have no answer ({_ANSWER})",)
        yield source.TriggerSamples(clock_s, np.full(clock_s.size, np.nan), name, camera=camera, notes=notes)


def _of_cameras(log: Records, name: str) -> Iterator[tuple[str, Float]]:
    """Yield the name of each camera in a message, and the times of its records, s since boot."""
    if (records := stamped(log, name)) is None:
        return
    clock_s, number = records[0], numbered(log, name, _CAMERA)
    valid = source.valid_rare_times(clock_s) & (number >= 0)
    for camera in np.unique(number[valid]).tolist():
        called = f"camera:{camera}" if _CAMERA in log.fields(name) else ONLY_CAMERA
        yield called, clock_s[valid & (number == camera)]


def _gimbal(log: Records) -> source.GimbalSamples | None:
    """Return the attitude of the first gimbal; None if the log has none."""
    if "MNT" not in log or (records := stamped(log, "MNT", *_ANGLES)) is None:
        return None
    clock_s, (roll_deg, pitch_deg, yaw_deg, yaw_earth_deg) = records
    # The yaw against north does not depend on the aircraft's heading; it is NaN where the gimbal does not know it.
    is_earth = np.isfinite(yaw_earth_deg)
    angles_deg = np.stack([roll_deg, pitch_deg, np.where(is_earth, yaw_earth_deg, yaw_deg)])
    number = numbered(log, "MNT", "I")
    valid = np.isfinite(angles_deg).all(axis=0) & source.valid_times(clock_s)
    if not valid.any():
        return None
    valid &= number == number[valid].min()
    if np.count_nonzero(valid) < 2:
        return None
    q = quaternion_from_euler(*np.deg2rad(angles_deg[:, valid]))
    return source.GimbalSamples(clock_s[valid], q, is_earth[valid], "MNT")


def _events(log: Records, vehicle: str | None) -> Iterator[source.EventSamples]:
    """Yield the flight modes and the messages of a boot; `vehicle`: the firmware, whose modes these are."""
    for field in ("ModeNum", "Mode"):
        modes = stamped(log, "MODE", field)
        if modes is not None and modes[0].size and np.isfinite(modes[1][0]).any():
            clock_s, (number,) = modes
            named = source.valid_rare_times(clock_s) & np.isfinite(number)
            names = [ardupilot_mode(vehicle, int(mode)) for mode in number[named].tolist()]
            yield source.EventSamples.of(EventKind.MODE, clock_s[named], names)
            break
    messages = stamped(log, "MSG")
    texts = log.texts("MSG", "Message")
    if messages is not None and messages[0].size == len(texts) and texts:
        clock_s = np.where(source.valid_rare_times(messages[0]), messages[0], np.nan)
        yield source.EventSamples.of(EventKind.MESSAGE, clock_s, texts)
