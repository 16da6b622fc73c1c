"""MAVLink telemetry logs (``.tlog``), and streams of packets without arrival times.

====================  ============================================  ================================================
message               fields                                        used for
====================  ============================================  ================================================
HEARTBEAT             autopilot, type, custom_mode                  which senders are autopilots; flight modes
ATTITUDE_QUATERNION   time_boot_ms, q1..q4, body to NED             attitude
ATTITUDE              time_boot_ms, roll, pitch, yaw                attitude, if it is sent more than twice as often
HIL_STATE_QUATERNION  time_usec, attitude_quaternion, body to NED,  a simulator's own attitude and position, if the
                      lat, lon, alt                                 system sends neither of the above
GLOBAL_POSITION_INT   time_boot_ms, lat, lon, alt                   position
GPS_RAW_INT           fix_type, lat, lon, alt                       position, if GLOBAL_POSITION_INT has none
SYSTEM_TIME           time_boot_ms, time_unix_usec                  UTC
HIGHRES_IMU           time_usec, xgyro, ygyro, zgyro (rad/s)        gyro rates, from the most frequent message, if
SCALED_IMU, 2, 3      time_boot_ms, xgyro, ygyro, zgyro (mrad/s)    that is as frequent as the attitude
RAW_IMU               the same with time_usec                       the same, of ArduPilot; others have no unit
CAMERA_FEEDBACK       time_usec, img_idx, cam_idx                   when the camera was triggered
CAMERA_IMAGE_...      time_utc, time_boot_ms, image_index,          the same, if there is no CAMERA_FEEDBACK
                      camera_id, capture_result (..._CAPTURED)
CAMERA_TRIGGER        time_usec, seq                                the same, if there is none of the above
GIMBAL_DEVICE_...      time_boot_ms, flags, q (..._ATTITUDE_STATUS)  attitude of a gimbal
MOUNT_ORIENTATION     time_boot_ms, roll, pitch, yaw (deg)          the same, if there is none of the above
MOUNT_STATUS          pointing_a, _b, _c (0.01 deg), on arrival     the same, if there is none of the above
AUTOPILOT_VERSION     flight_sw_version                             the firmware
STATUSTEXT            text                                          the firmware, of ArduPilot; messages, on arrival
====================  ============================================  ================================================

The clock is the autopilot's time since boot.  The arrival times of packets are by the ground station's clock, which
may be wrong by seconds or years.  Arrivals relate packets without a common time since boot: those of an autopilot
without UTC and of a ground station with UTC, or those of two boots of one autopilot.  A stream, such as Mission
Planner's ``.rlog`` or what a serial port received, is given arrival times by the autopilot's time since boot.
"""

import os
import re
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.errors import LogFormatError, reading
from glstar.flight import ONLY_CAMERA, EventKind
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.timescale import format_utc
from glstar.system.files import UnpackedFolder
from glstar.system.userinput import read_whole
from glstar.telemetry import source
from glstar.telemetry.mavlink import vehicles
from glstar.telemetry.mavlink.clock import NO_UTC, VehicleClock, other_clocks, readings_source
from glstar.telemetry.mavlink.packets import (
    COMPONENT,
    EULER,
    FIELDS_FROM,
    HIL_STATE,
    QUATERNION,
    SYSTEM,
    LogPackets,
    Packets,
    Sender,
    has_boot_ms,
    system_time_utc_s,
)

# Messages with gyro rates, and their unit, rad/s.  Of equally frequent ones the first is used.
_GYROS = {"HIGHRES_IMU": 1.0, "SCALED_IMU": 1e-3, "RAW_IMU": 1e-3, "SCALED_IMU2": 1e-3, "SCALED_IMU3": 1e-3}
# The status text with the firmware at start-up: "ArduSub V4.1.1 BETA5 (66c674c1)".
_BANNER = re.compile(r"([A-Z]\w+) V(\d+\.\d+\S*.*)", re.ASCII)
# MAV_COMP_ID_AUTOPILOT1.
_FIRST_AUTOPILOT = 1

# Messages of a triggered camera, the most exact one first: answers of ArduPilot and of PX4, and what was sent to it.
_CAPTURED, _SENT = "CAMERA_IMAGE_CAPTURED", "CAMERA_TRIGGER"
_TRIGGERS = ("CAMERA_FEEDBACK", _CAPTURED, _SENT)
# A packet arrives within this time on a slow link, s; a time that differs more from its arrival is of another clock.
_ARRIVES_WITHIN_S = 60.0
# A shorter loss of samples is not reported, s.
_REPORTED_S = 1.0
_FIX_3D = 3
_SIMULATED = f"the attitude is a simulator's own state ({HIL_STATE}), not an estimate of an autopilot"


class TelemetryLogReader(source.TelemetrySource):
    """A telemetry log as a telemetry source; its clock is the autopilot's time since its first boot.

    Every complete packet of a truncated or damaged log is read.  The options are those of `open_source`: `attitude` is
    ``"auto"`` for ATTITUDE_QUATERNION, or ATTITUDE if it is more than twice as frequent, or a simulator's
    HIL_STATE_QUATERNION if there is neither; or one of them by name.  The vehicle is by default the first autopilot
    with attitude.  Raises LogFormatError if the file holds no packet with attitude.
    """

    format = "MAVLink telemetry log"
    one_clock = True

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        attitude: str = "auto",
        sysid: int | None = None,
        boot: int | None = None,
    ) -> None:
        self.name = os.fspath(path)
        self._attitude = attitude
        self._sysid = sysid
        self._boot = boot
        self._packets = self._open()
        self._read_clock: tuple[Sender, VehicleClock] | None = None

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position and rates of each boot, a batch each, and the UTC of all boots.

        Messages are decoded on demand: the first three batches of a single boot do not wait for the gyro rates.
        Raises LogFormatError if the log has no attitude, not the requested one, or no such boot.
        """
        sender, others = self._vehicle()
        clock = self._clock(sender)
        boots = self.boots()
        self._require_attitude(sender)
        for boot in boots:
            yield self._attitudes(sender, others, clock, boot.number)
            yield replace(_positions(self._packets, sender, clock, boot.number), boot=boot.number)
            if boot is boots[0]:
                yield replace(self._utc(sender, clock, boots), boot=boot.number)
        for boot in boots:
            yield from _events(self._packets, sender, clock, boot.number)
            yield from _rates(self._packets, sender, clock, boot.number)
            yield from _triggers(self._packets, sender, clock, boot.number)
            yield from vehicles.gimbal_of_packets(self._packets, sender, clock, boot.number)

    def boots(self) -> tuple[source.Boot, ...]:
        """Return the boots of the autopilot in the log, or the requested one.

        Raises LogFormatError if the log has no attitude, or no such boot.
        """
        return source.chosen_boots(self.name, self._clock(self._vehicle()[0]).boots, self._boot)

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:  # noqa: ARG002 - the vehicle is that of all boots
        """Return the vehicle and its firmware; raises LogFormatError if the log has no attitude."""
        sender, systems = self._vehicle()
        vehicle = _vehicle_of(self._packets, sender)
        choice = f", system {sender[0]} of {_and(systems)}" if len(systems) > 1 else ""
        return source.LogFacts(
            self.format,
            f"{vehicle or 'vehicle'}{choice}" if vehicle or choice else None,
            self._firmware(sender),
            unread_bytes=self._packets.unread_bytes,
        )

    def attitudes(self) -> Iterator[tuple[str, source.AttitudeSamples]]:
        """Yield the name and the samples of every attitude of the vehicle, boot by boot."""
        sender, systems = self._vehicle()
        clock = self._clock(sender)
        for boot in self.boots():
            for name in self._available(sender, clock, boot.number):
                yield name, self._attitude_of(name, sender, systems, clock, boot.number)

    def close(self) -> None:
        """Do nothing: the file is only open while it is read."""

    def _open(self) -> Packets:
        return LogPackets(self.name)

    def _clock(self, sender: Sender) -> VehicleClock:
        if self._read_clock is None or self._read_clock[0] != sender:
            self._read_clock = sender, VehicleClock.of(self._packets, sender)
        return self._read_clock[1]

    def _firmware(self, sender: Sender) -> str | None:
        texts = self._packets.texts(sender)
        printable = ("".join(filter(str.isprintable, text)) for text in texts)
        if banners := [text for text in printable if _BANNER.fullmatch(text)]:
            return banners[-1]
        numbers = self._packets.rows("AUTOPILOT_VERSION", sender)[:, FIELDS_FROM]
        numbers = numbers[numbers > 0]
        if not numbers.size:
            return None
        name = (_vehicle_of(self._packets, sender) or "").split(" ")[0]
        return " ".join(filter(None, (name, vehicles.version(int(numbers[-1])))))

    def _vehicle(self) -> tuple[Sender, list[int]]:
        """Return the sender whose flight is read, and the systems of all candidates."""
        packets = self._packets
        estimated = packets.senders(QUATERNION, EULER)
        simulated = [
            sender for sender in packets.senders(HIL_STATE) if sender[0] not in {system for system, _ in estimated}
        ]
        with_attitude = [*estimated, *simulated]
        autopilots = [sender for sender in with_attitude if sender in packets.autopilots()]
        # A log that was cut out of another may have no heartbeats: then any sender with attitude is a candidate.
        candidates = autopilots or with_attitude
        systems = list(dict.fromkeys(system for system, _ in candidates))
        if not candidates:
            raise self._error(f"the log has no attitude: no {QUATERNION} or {EULER} in {packets.count} packets")
        if self._sysid is not None:
            candidates = [sender for sender in candidates if sender[0] == self._sysid]
            if not candidates:
                others = f"system {_and(systems)}"
                raise self._error(f"the log has no attitude of system {self._sysid} (sysid); it has that of {others}")
        system = candidates[0][0]
        components = [component for number, component in candidates if number == system]
        return (system, _FIRST_AUTOPILOT if _FIRST_AUTOPILOT in components else components[0]), systems

    def _available(self, sender: Sender, clock: VehicleClock, boot: int) -> list[str]:
        """Return the messages with attitude of a sender in a boot, the preferred one first."""
        names = self._packets.attitude_messages(sender)
        rows = {name: self._packets.rows(name, sender) for name in names}
        count = {name: np.count_nonzero(clock.read(packets)[1] == boot) for name, packets in rows.items()}
        # Both are float32 and equally accurate: the frequency decides.
        if count.get(EULER, 0) > 2 * count.get(QUATERNION, 0):
            names = names[::-1]
        return [name for name in names if count[name]]

    def _utc(self, sender: Sender, clock: VehicleClock, boots: Sequence[source.Boot]) -> source.ClockSamples:
        """Return the UTC of some boots; the source names what dates those without a reading of the autopilot."""
        if self._boot is not None and not clock.is_known[self._boot - 1]:
            return source.no_clock_samples(NO_UTC)
        utc = _utc(self._packets, sender, clock)
        if len(boots) == 1:
            return replace(utc, source=clock.utc_sources[boots[0].number - 1] or utc.source)
        others = [(boot.number, origin) for boot in boots if (origin := clock.utc_sources[boot.number - 1])]
        return replace(utc, source="; ".join([utc.source, *(f"boot {number}: {origin}" for number, origin in others)]))

    def _require_attitude(self, sender: Sender) -> None:
        """Raise an error if the requested attitude is not in the log."""
        names = self._packets.attitude_messages(sender)
        if self._attitude.strip().upper() not in ("AUTO", *names):
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {' and '.join(sorted(names))}")

    def _attitudes(self, sender: Sender, systems: list[int], clock: VehicleClock, boot: int) -> source.AttitudeSamples:
        available, requested = self._available(sender, clock, boot), self._attitude.strip().upper()
        name = requested if requested != "AUTO" else available[0] if available else QUATERNION
        return self._attitude_of(name, sender, systems, clock, boot)

    def _attitude_of(
        self, name: str, sender: Sender, systems: list[int], clock: VehicleClock, boot: int
    ) -> source.AttitudeSamples:
        rows, clock_s = clock.of_boot(self._packets.rows(name, sender), boot)
        with np.errstate(over="ignore", invalid="ignore"):
            fields = rows[:, FIELDS_FROM + 1 :]
            q = quaternion_from_euler(*fields.T) if name == EULER else conjugate(fields[:, :4])
        valid = source.unit_quaternions(q) & source.valid_times(clock_s)
        # An estimator sends (1, 0, 0, 0) until it is aligned.
        aligned = (q != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
        notes: tuple[str, ...] = (_SIMULATED,) if name == HIL_STATE else ()
        if name == QUATERNION:
            before = slice(None, int(np.argmax(aligned)) if aligned.any() else None)
            notes = self._left_out(clock_s, before, sender, clock, boot)
            valid[before] = False
        choice = f" of system {sender[0]} (of {_and(systems)}; sysid chooses)" if len(systems) > 1 else ""
        segment = np.zeros(np.count_nonzero(valid), dtype=np.int64)
        return source.AttitudeSamples(
            clock_s[valid], q[valid], segment, f"{name}{choice}", break_reason=source.REBOOT, boot=boot, notes=notes
        )

    def _left_out(
        self, clock_s: Float, before: slice, sender: Sender, clock: VehicleClock, boot: int
    ) -> tuple[str, ...]:
        """Return a remark that attitude before the alignment is left out, and which message covers more."""
        left_out_s = float(np.ptp(clock_s[before])) if clock_s[before].size else 0.0
        if left_out_s < _REPORTED_S:
            return ()
        euler_s = clock.of_boot(self._packets.rows(EULER, sender), boot)[1]
        better = f"; --attitude {EULER} covers {np.ptp(euler_s):.1f} s" if euler_s.size else ""
        remain_s = np.ptp(clock_s) - left_out_s
        return (
            f"the first {left_out_s:.1f} s of {QUATERNION} are left out, before its estimator was aligned:"
            f" {remain_s:.1f} s remain{better}",
        )

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._packets.whole_bytes)


def _triggers(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> Iterator[source.TriggerSamples]:
    """Yield when each camera was triggered in a boot."""
    for name in _TRIGGERS:
        rows = packets.message(name)
        rows = rows[(rows[:, SYSTEM] == sender[0]) & (clock.boot_of(rows) == boot)] if len(rows) else rows
        if not len(rows):
            continue
        # A packet may arrive twice, and again on request: it has the same fields.
        _, first = np.unique(rows[:, COMPONENT:], axis=0, return_index=True)
        rows = rows[np.sort(first)]
        numbered = name != _SENT
        cameras = rows[:, FIELDS_FROM + 2] if numbered else np.zeros(len(rows))
        if name == _CAPTURED:
            is_own = rows[:, COMPONENT] == sender[1]
            # A camera that is a component of its own has its component's number, and its own time since boot.
            cameras = np.where(is_own | (cameras > 0), cameras, rows[:, COMPONENT])
            boot_us = np.where(is_own, rows[:, FIELDS_FROM + 3] * 1e3, 0.0)
            rows[:, FIELDS_FROM] = np.where(rows[:, FIELDS_FROM] > 0, rows[:, FIELDS_FROM], boot_us)
        for camera in np.unique(cameras).astype(np.int64).tolist():
            called = f"{ONLY_CAMERA}:{camera}" if numbered else ONLY_CAMERA
            yield _triggers_of(rows[cameras == camera], name, called, clock, boot)
        return


def _triggers_of(rows: Float, name: str, camera: str, clock: VehicleClock, boot: int) -> source.TriggerSamples:
    """Return the triggers of one camera, whose times are UTC, or since boot, or 0 for none."""
    number, notes = rows[:, FIELDS_FROM + 1].astype(np.int64), list[str]()
    if name == _TRIGGERS[0]:
        # Its number has 16 bits, and goes on after 65535.
        number = np.unwrap(number, period=2**16).astype(np.int64)
    if is_numbered := np.unique(number).size == number.size:
        order = np.argsort(number)
        rows, number = rows[order], number[order]
        missing = int(np.ptp(number)) + 1 - number.size
        if missing:
            numbers = f"{number[0]} to {number[-1]}"
            notes.append(f"{missing} of the images {numbers} of {camera} are missing in {name}: packets were lost")
    if name == _CAPTURED and (failed := rows[:, -1] == 0).any():
        notes.append(f"{np.count_nonzero(failed)} of {len(rows)} captures of {camera} ({name}) failed and are left out")
        rows, number = rows[~failed], number[~failed]
    time_s, arrived_s = rows[:, FIELDS_FROM] * 1e-6, clock.on_arrival(rows)
    is_utc = source.plausible_utc(time_s)
    boot_s = clock.read_us(rows)
    is_timed = is_utc | ((time_s > 0) & (np.abs(boot_s - arrived_s) <= _ARRIVES_WITHIN_S))
    if not is_timed.all():
        untimed = f"{np.count_nonzero(~is_timed)} of {len(rows)} triggers of {camera} have no time in {name}"
        notes.append(f"{untimed}: their packets' arrival dates them, after the exposure")
    return source.TriggerSamples(
        np.where(is_timed & ~is_utc, boot_s, arrived_s),
        np.where(is_utc, time_s, np.nan),
        name,
        boot,
        camera,
        number if is_numbered else None,
        clock_error_s=_ARRIVES_WITHIN_S,
        notes=tuple(notes),
    )


def _events(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> Iterator[source.EventSamples]:
    """Yield flight modes and messages of a boot, timed by their arrival."""
    modes = packets.custom_modes(sender)
    modes = modes[clock.boot_of(modes) == boot] if len(modes) else modes
    vehicle = _vehicle_of(packets, sender)
    if len(modes) and vehicle is not None:
        numbers = modes[:, FIELDS_FROM].astype(np.int64).tolist()
        is_px4 = _autopilot_number(packets, sender) == vehicles.PX4
        names = [
            vehicles.px4_mode(number) if is_px4 else vehicles.ardupilot_mode(vehicle, number) for number in numbers
        ]
        yield source.EventSamples.of(EventKind.MODE, clock.on_arrival(modes), names, boot)
    rows, texts = packets.status_texts(sender)
    if len(rows):
        of_boot = np.flatnonzero(clock.boot_of(rows) == boot)
        texts = [texts[k] for k in of_boot]
        yield source.EventSamples.of(EventKind.MESSAGE, clock.on_arrival(rows[of_boot]), texts, boot)


def _positions(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> source.PositionSamples:
    """Return the positions of a sender in a boot, from the first message that has any."""
    is_simulated = packets.attitude_messages(sender) == (HIL_STATE,)
    rows: dict[str, Float] = {}
    for name in ("GLOBAL_POSITION_INT", *((HIL_STATE,) if is_simulated else ())):
        if name != HIL_STATE and packets.timestamps_are_utc(sender):
            continue  # it is timed by another clock
        rows[name], clock_s = clock.of_boot(packets.rows(name, sender), boot)
        samples = _position_samples(clock_s, rows[name][:, -3:], name)
        if samples.clock_s.size:
            return samples
    # Autopilots time GPS_RAW_INT by UTC or by the time since boot: the arrival time, a second late at most, is used.
    fixes = packets.rows("GPS_RAW_INT", sender)
    fixes = fixes[clock.boot_of(fixes) == boot]
    fixed = fixes[fixes[:, FIELDS_FROM] >= _FIX_3D]
    samples = _position_samples(clock.on_arrival(fixed), fixed[:, FIELDS_FROM + 1 :], "GPS_RAW_INT")
    if samples.clock_s.size:
        return samples
    empty = [name for name, packets_of in (*rows.items(), ("GPS_RAW_INT", fixes)) if len(packets_of)]
    return source.no_position_samples(
        f"its {' and '.join(empty)} never had a position" if empty else packets.lack("GLOBAL_POSITION_INT")
    )


def _position_samples(clock_s: Float, fields: Float, name: str) -> source.PositionSamples:
    """Return the valid positions of a message, from (n, 3) latitude and longitude, 1e-7 deg, and height, mm."""
    latitude, longitude, height_mm = fields.T
    return source.position_samples(clock_s, latitude / 1e7, longitude / 1e7, height_mm / 1e3, name)


def _utc(packets: Packets, sender: Sender, clock: VehicleClock) -> source.ClockSamples:
    """Return the UTC of the autopilot, else of another component of its system, else of any other system."""
    times = clock.readings
    if len(times):
        clock_s, boot = clock.read(times)
        origin = f"{HIL_STATE}, timed by UTC" if packets.timestamps_are_utc(sender) else readings_source(len(times))
        utc_s = system_time_utc_s(times)
        return source.ClockSamples(clock_s[boot > 0], utc_s[boot > 0], origin, notes=clock.notes)
    for other in other_clocks(packets, sender):
        if len(times := packets.times(other)):
            origin = readings_source(len(times), packets.called(other))
            return source.ClockSamples(clock.on_arrival(times), system_time_utc_s(times), origin)
    lack = "no SYSTEM_TIME after 2010" if packets.senders("SYSTEM_TIME") else packets.lack("SYSTEM_TIME")
    stamp_s = packets.first_stamp_s(sender)
    is_plausible = source.YEAR_2010_S <= stamp_s < source.YEAR_2100_S
    recorder = f"; the recorder's own clock said {format_utc(stamp_s)}" if is_plausible else ""
    return source.no_clock_samples(f"{lack}{recorder}")


def _rates(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> Iterator[source.RateSamples]:
    """Yield the most frequent gyro rates; nothing if the attitude is more frequent, or timed by another clock."""
    if packets.timestamps_are_utc(sender):
        return
    least = max([2, *(len(packets.rows(name, sender)) for name in packets.attitude_messages(sender))])
    is_ardupilot = np.any(packets.rows("HEARTBEAT", sender)[:, FIELDS_FROM] == vehicles.ARDUPILOT)
    names = [name for name in _GYROS if name != "RAW_IMU" or is_ardupilot]
    # Packets are counted before they are decoded, so that only one message is.
    often = [name for name in sorted(names, key=packets.amount, reverse=True) if packets.amount(name) >= least]
    name = next((name for name in often if len(packets.rows(name, sender)) >= least), None)
    if name is None:
        return
    rows = packets.rows(name, sender)
    rows = rows[clock.boot_of(rows) == boot]
    with np.errstate(invalid="ignore", over="ignore"):
        rate = rows[:, FIELDS_FROM + 1 :] * _GYROS[name]
    clock_s = clock.read(rows)[0] if has_boot_ms(name) else clock.read_us(rows)
    valid = source.valid_times(clock_s) & source.valid_rates(rate)
    if np.count_nonzero(valid) > 1:
        yield source.RateSamples(clock_s[valid], rate[valid], name, boot)


def _vehicle_of(packets: Packets, sender: Sender) -> str | None:
    """Return the name of an autopilot and its vehicle; None without a heartbeat."""
    number = _autopilot_number(packets, sender)
    types = packets.rows("HEARTBEAT", sender)[:, FIELDS_FROM + 1]
    return None if number is None else vehicles.autopilot(number, vehicles.vehicle_kind(types))


def _autopilot_number(packets: Packets, sender: Sender) -> int | None:
    """Return MAV_AUTOPILOT of a sender; None without a heartbeat."""
    beats = packets.rows("HEARTBEAT", sender)
    return int(np.median(beats[:, FIELDS_FROM])) if len(beats) else None


def _and(systems: list[int]) -> str:
    return " and ".join(map(str, systems))


_MAGIC = re.compile(rb"[\xfd\xfe]")
_V2 = 0xFD
_SIGNED = 0x01
# Bytes of a packet besides its payload, by version, and those of a signature.
_V1_BYTES, _V2_BYTES, _SIGNATURE_BYTES = 8, 12, 13
# Number of consecutive packets that are not there by chance.
_ROW = 5
# First of the arrival times that are given to a stream, UTC seconds since 1970.
_START_S = source.YEAR_2010_S + 86400.0


def is_mavlink_stream(head: bytes) -> bool:
    """Return whether a file holds consecutive MAVLink packets without arrival times, by its first bytes."""
    for magic in _MAGIC.finditer(head[:1024]):
        at: int | None = magic.start()
        for _ in range(_ROW):
            at = None if at is None else _stop(head, at)
        if at is not None:
            return True
    return False


def stream_reader(
    path: str, *, attitude: str = "auto", sysid: int | None = None, boot: int | None = None
) -> source.UnpackedSource:
    """Open a stream as a telemetry log; see `TelemetryLogReader`."""
    return source.UnpackedSource(
        path, _with_arrival_times, lambda log: TelemetryLogReader(log, attitude=attitude, sysid=sysid, boot=boot)
    )


def _with_arrival_times(name: str) -> tuple[UnpackedFolder, Path]:
    """Write the packets of a stream as a telemetry log into a temporary directory."""
    with reading(name, LogFormatError):
        content = read_whole(name)
    folder = UnpackedFolder()
    path = folder.path / f"{Path(name).stem}.tlog"
    clock_s = _START_S
    boot_s: float | None = None
    count = 0
    with path.open("wb") as file:
        for packet, message in _packets(content):
            count += 1
            time_ms = getattr(message, "time_boot_ms", None)
            if time_ms is not None and message.get_srcComponent() == _FIRST_AUTOPILOT:
                # A step back is a reboot, or a packet that overtook another.
                clock_s += 0.0 if boot_s is None else max(time_ms / 1e3 - boot_s, 0.0)
                boot_s = time_ms / 1e3
            file.write(struct.pack(">Q", round(clock_s * 1e6)) + packet)
    if not count:
        folder.cleanup()
        raise LogFormatError(name, "holds no valid MAVLink packet")
    return folder, path


def _packets(content: bytes) -> Iterator[tuple[bytes, Any]]:
    """Yield the packets with correct checksums, and their messages."""
    with source.suppressed_output():
        from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 - when a stream is read

        link = ardupilotmega.MAVLink(None)
    at = 0
    while (magic := _MAGIC.search(content, at)) is not None:
        at = magic.start()
        stop = _stop(content, at)
        if stop is not None:
            packet = content[at:stop]
            try:
                yield packet, link.decode(bytearray(packet))
            except (ardupilotmega.MAVError, struct.error):
                stop = None
        at = at + 1 if stop is None else stop


def _stop(content: bytes, at: int) -> int | None:
    """Return the end of the packet that begins at an offset; None if there is no packet."""
    if at + _V1_BYTES > len(content) or content[at] not in b"\xfd\xfe":
        return None
    is_v2, flags = content[at] == _V2, content[at + 2]
    if is_v2 and flags & ~_SIGNED:
        return None
    signature = _SIGNATURE_BYTES if is_v2 and flags & _SIGNED else 0
    stop = at + content[at + 1] + (_V2_BYTES if is_v2 else _V1_BYTES) + signature
    return stop if stop <= len(content) else None
