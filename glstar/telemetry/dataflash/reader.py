"""The reader of DataFlash logs."""

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np

from glstar.errors import LogFormatError
from glstar.telemetry.dataflash.estimates import AttitudeEstimate, estimates
from glstar.telemetry.dataflash.estimator import active_estimator, estimator_notes, preferred_messages
from glstar.telemetry.dataflash.eventrecords import event_records
from glstar.telemetry.dataflash.gimbalrecords import gimbal_of_records
from glstar.telemetry.dataflash.gps import positions, utc
from glstar.telemetry.dataflash.gyrorecords import turn_rates
from glstar.telemetry.dataflash.records import DATAFLASH_MAGIC, BinaryRecords, Records, stamped
from glstar.telemetry.dataflash.restarts import boots_of
from glstar.telemetry.dataflash.text import TextRecords, is_dataflash_text
from glstar.telemetry.samplevalidation import valid_rare_times
from glstar.telemetry.source import (
    AttitudeSamples,
    Boot,
    LogFacts,
    Samples,
    TelemetrySource,
    TriggerSamples,
    chosen_boots,
)

__all__ = ["DataFlashReader", "is_dataflash"]

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


def is_dataflash(head: bytes) -> bool:
    """Return whether a file is a DataFlash log, binary or text.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.

    Returns
    -------
    bool
    """
    return head.startswith(DATAFLASH_MAGIC) or is_dataflash_text(head)


# Records of a triggered camera, the most exact one first.
_TRIGGERS: Final = ("CAM", "TRIG")


class DataFlashReader(TelemetrySource):
    """A DataFlash log as a telemetry source; its clock is the autopilot's time since boot.

    Of a truncated or damaged log, every complete record is read.

    Parameters
    ----------
    path : path-like
        The log, binary or as text.
    attitude : str
        ``"auto"``: the EKF lane in use, or ATT if no EKF was in use.  Or a message by name, ``"ATT"``, ``"AHR2"``,
        ``"SIM"``, or one lane of it as ``"XKQ1"`` or ``"XKQ[1]"``.
    boot : int, optional
        Number of the boot, from 1, in a log of several; by default all.

    Raises
    ------
    LogFormatError
        If the file holds no complete record.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", boot: int | None = None) -> None:
        self.name = os.fspath(path)
        self._attitude, self._boot = attitude, boot
        with Path(self.name).open("rb") as file:
            head = file.read(len(DATAFLASH_MAGIC))
        if not head:
            raise LogFormatError(self.name, "is empty: 0 bytes", offset=0)
        self._log: Records = BinaryRecords(self.name) if head == DATAFLASH_MAGIC else TextRecords(self.name)

    def samples(self) -> Iterator[Samples]:
        """Yield attitude, position, UTC and, if the log has them, gyro rates of each boot, a batch each.

        Raises
        ------
        LogFormatError
            If the log has no attitude, not the requested one, or no such boot.
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

    def facts(self, boots: Collection[int] = ()) -> LogFacts:
        """Return the vehicle, its firmware and its estimator.

        Parameters
        ----------
        boots : collection of int
            Numbers of the boots; by default all.

        Returns
        -------
        LogFacts
        """
        found = [_facts(log) for number, log in self._parts if not boots or number in boots]
        vehicles, firmwares, estimators = (
            " and ".join(dict.fromkeys(filter(None, names))) or None
            for names in zip(*((one.vehicle, one.firmware, one.estimator) for one in found), strict=True)
        )
        return LogFacts(self._log.kind, vehicles, firmwares, estimators, self._log.unread_bytes)

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the log, or the requested one.

        Raises
        ------
        LogFormatError
            If the log has no such boot.
        """
        return chosen_boots(self.name, self._found_boots, self._boot)

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield the name and the samples of every lane of every attitude estimate, boot by boot."""
        for number, log in self._parts:
            for estimate in estimates(log):
                for lane in estimate.lanes:
                    yield estimate.called(lane), replace(estimate.only(lane), boot=number)

    def close(self) -> None:
        """Close the file."""
        self._log.close()

    @cached_property
    def _found_boots(self) -> tuple[Boot, ...]:
        return boots_of(self._log)

    @cached_property
    def _parts(self) -> list[tuple[int, Records]]:
        """Number and records of each requested boot."""
        boots = self.boots()
        is_single = len(self._found_boots) == 1 and self._found_boots[0] == Boot(1)
        return [(boot.number, self._log if is_single else self._log.only(boot.spans)) for boot in boots]

    def _beside_attitude(self, log: Records) -> Iterator[Samples]:
        """Yield position, UTC and rates of one boot."""
        yield positions(log)
        yield utc(log)
        if (rates := turn_rates(log)) is not None:
            yield rates
        if (triggers := _triggers(log)) is not None:
            yield triggers
        if (gimbal := gimbal_of_records(log)) is not None:
            yield gimbal
        yield from event_records(log, _facts(log).vehicle)

    def _requested(self, log: Records) -> AttitudeSamples:
        if self._attitude.lower() == "auto":
            for name in preferred_messages(log):
                if (estimate := AttitudeEstimate.of(log, name)) is not None:
                    return _with_notes(log, estimate, estimate.primary(log))
            raise self._error(f"the log has no attitude: {_contents(log)}")

        name, lane = self._attitude.upper(), None
        estimate = AttitudeEstimate.of(log, name)
        if estimate is None and (asked := re.fullmatch(r"(.+?)(?:(\d)|\[(\d+)\])", name)):
            estimate, lane = AttitudeEstimate.of(log, asked[1]), int(asked[2] or asked[3])
        if estimate is None or (lane is not None and lane not in estimate.lanes):
            offered = [estimate.summary() for estimate in estimates(log)]
            if not offered:
                raise self._error(f"the log has no attitude: {_contents(log)}")
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {'; '.join(offered)}")
        return _with_notes(log, estimate, estimate.primary(log) if lane is None else estimate.only(lane))

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._log.end)


def _triggers(log: Records) -> TriggerSamples | None:
    """Return when the camera was triggered: CAM, written when the camera answered, otherwise TRIG."""
    for name in _TRIGGERS:
        if (records := stamped(log, name)) is not None and records[0].size:
            clock_s = records[0][valid_rare_times(records[0])]
            return TriggerSamples(clock_s, np.full(clock_s.size, np.nan), name)
    return None


def _with_notes(log: Records, estimate: AttitudeEstimate, samples: AttitudeSamples) -> AttitudeSamples:
    return replace(samples, notes=estimator_notes(log, estimate, samples))


def _facts(log: Records) -> LogFacts:
    for text in (*log.texts("VER", "FWS"), *log.texts("MSG", "Message")):
        if found := _FIRMWARE.search(text):
            return LogFacts(log.kind, found["vehicle"].replace("APM:", "Ardu"), found[0], active_estimator(log))
    built_for = log.columns("VER", "BU")
    if built_for is not None and built_for[0].size and built_for[0][0] in _BY_BUILD_TYPE:
        return LogFacts(log.kind, _BY_BUILD_TYPE[int(built_for[0][0])], estimator=active_estimator(log))
    vehicles = {_BY_PARAMETER[name] for name in log.texts("PARM", "Name") if name in _BY_PARAMETER}
    return LogFacts(log.kind, vehicles.pop() if len(vehicles) == 1 else None, estimator=active_estimator(log))


def _contents(log: Records) -> str:
    if {"Roll", "Pitch", "Yaw"} <= set(log.fields("ATT")) and stamped(log, "ATT") is None:
        return "its ATT records are not stamped with a time (ArduPilot before 2014), and glstar guesses none"
    return f"no XKQ, NKQ or ATT among the messages {', '.join(log.names)}{log.loss()}"
