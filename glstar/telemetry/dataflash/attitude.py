"""Attitude estimates in a DataFlash log, the EKF lane and the estimator in use, and differences between estimators."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer
from glstar.flight import mean_rate_hz
from glstar.rotation import conjugate, euler_from_quaternion, multiply, quaternion_from_euler
from glstar.telemetry.dataflash.records import Records, nearest, numbered, stamped
from glstar.telemetry.source import AttitudeSamples, quaternion_lengths, unit_quaternions, valid_times

# Quaternions of EKF3 and of EKF2, one for each lane.
_OF_LANES = ("XKQ", "NKQ")
# Messages with the attitude of an EKF: quaternions, Euler angles, and the attitude in use.
_OF_AN_EKF = re.compile(r"[XN]KQ[1-3]?|[XN]KF1|EKF1|ATT")
# A lane with a smaller fraction of the samples of another is a damaged number; all lanes are logged equally often.
_RARE = 0.01

# A yaw reset is a jump to the yaw of compass or GPS.  Copters and quadplanes log it as an event, in the same loop; all
# vehicles log a text of the EKF at the same time: "EKF3 IMU0 MAG0 in-flight yaw alignment complete", "EKF2 IMU1 ground
# mag anomaly, yaw re-aligned", "EKF3 IMU0 yaw aligned to GPS velocity", "EKF3 IMU0 emergency yaw reset".  Other texts
# of the EKF ("is using GPS", "origin set") do not change the attitude.
_YAW_RESET_EVENT = 62
_YAW_RESET_TEXT = re.compile(r"EKF.*\byaw (?:(?:re-?)?aligned|alignment complete|reset)", re.IGNORECASE)

# The estimator of ATT, by ATT.AEKF.
_NAMES = {0: "DCM", 2: "EKF2", 3: "EKF3", 10: "the simulator's", 11: "an external AHRS"}
_MESSAGES = {2: ("NKQ", "XKQ", "ATT"), 3: ("XKQ", "NKQ", "ATT")}
_UNKNOWN = _MESSAGES[3]
_NO_EKF = ("ATT", "XKQ", "NKQ")

# Differences between two estimates from this on are reported, deg: 1 deg is 68 px at f = 3871 px.
_REPORTED_DEG = 1.0
# Attitudes are compared if they were logged within this time, s.
_TOGETHER_S = 0.05
# For differences in a part of the flight only, s: at 200 deg/s an aircraft turns by a degree in 5 ms.
_AT_ONCE_S = 0.002
# Those are reported from this number of samples and from this fraction of them on.
_FEWEST = 20
_RARELY = 0.01
# A shorter loss of samples is not reported, s.
_REPORTED_S = 1.0
# If a lane that is not logged flew for a larger fraction of the time, another lane is used, or ATT.
_MOSTLY_UNLOGGED = 0.5
# A lane that is farther from ATT did not fly, deg: ATT is rounded to 0.01 deg and logged in the same loop.
_SAME_LANE_DEG = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeEstimate:
    """The attitude in one message."""

    name: str  # The message
    clock_s: Float  # (n,) times since boot, s
    q_body_ned: Float  # (n, 4) quaternions (w, x, y, z), NED to body
    lane: Integer  # (n,) int64: EKF lane of each sample; 0 if the message has none
    _breaks: "_Breaks"
    unaligned_s: float = 0.0  # Time until the EKF was aligned, s; its samples are dropped

    @classmethod
    def of(cls, log: Records, name: str) -> Self | None:
        """Return the valid samples of a message; None if there are none."""
        # Until 2020 each lane had a message of its own: XKQ1 was lane 0, XKQ2 lane 1.
        lane_of: dict[str, int | None] = {}
        if name in log:
            own_number = re.fullmatch(r"[XN]KQ([1-3])", name)
            lane_of[name] = int(own_number[1]) - 1 if own_number else None
        elif name in _OF_LANES:
            lane_of = {f"{name}{lane + 1}": lane for lane in range(3)}
        parts = [part for spelling, lane in lane_of.items() if (part := cls._read(log, spelling, lane)) is not None]
        if not parts:
            return None
        clock_s, q, lanes = (np.concatenate(column) for column in zip(*(part[:3] for part in parts), strict=True))
        unaligned_s = min(part[3] for part in parts)
        return cls(name, clock_s, q, lanes, _Breaks.of(log, name), unaligned_s) if clock_s.size else None

    @staticmethod
    def usual_length(log: Records, name: str) -> float | None:
        """Return the median norm of the quaternions of a message; None if it has none."""
        if (quaternion := stamped(log, name, "Q1", "Q2", "Q3", "Q4")) is None or not quaternion[0].size:
            return None
        return float(np.median(quaternion_lengths(np.stack(quaternion[1], axis=-1))))

    @staticmethod
    def _read(log: Records, name: str, lane: int | None) -> tuple[Float, Float, Integer, float] | None:
        if (quaternion := stamped(log, name, "Q1", "Q2", "Q3", "Q4")) is not None:
            clock_s, components = quaternion
            q = conjugate(np.stack(components, axis=-1))
        elif (angles := stamped(log, name, "Roll", "Pitch", "Yaw")) is not None:
            clock_s, angles_deg = angles
            q = quaternion_from_euler(*np.deg2rad(angles_deg))
        else:
            return None
        lanes = numbered(log, name, "C") if lane is None else np.full(clock_s.size, lane)

        valid = unit_quaternions(q)
        numbers, count = np.unique(lanes, return_counts=True)
        valid &= (lanes >= 0) & np.isin(lanes, numbers[count >= _RARE * np.max(count, initial=0)])
        unaligned_s: list[float] = []
        for number in numbers:
            rows = np.flatnonzero(lanes == number)
            valid[rows[~valid_times(clock_s[rows])]] = False
            if name[:3] in _OF_LANES:
                # An EKF logs (1, 0, 0, 0) until it is aligned.
                aligned = (q[rows] != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
                before = rows[: np.argmax(aligned) if aligned.any() else None]
                unaligned_s.append(float(np.ptp(clock_s[before][valid[before]])) if valid[before].any() else 0.0)
                valid[before] = False
        return clock_s[valid], q[valid], lanes[valid], min(unaligned_s, default=0.0)

    @property
    def lanes(self) -> list[int]:
        """The lanes, sorted."""
        return [int(lane) for lane in np.unique(self.lane)]

    @property
    def has_lanes(self) -> bool:
        """Whether the lane is part of the name: always for quaternions of an EKF."""
        return self.is_of_lanes or len(self.lanes) > 1

    @property
    def is_of_lanes(self) -> bool:
        """Whether these are quaternions of an EKF, one for each lane."""
        return self.name[:3] in _OF_LANES

    def called(self, lane: int) -> str:
        """Return the name of a lane, a value of ``attitude=``."""
        return f"{self.name}[{lane}]" if self.has_lanes else self.name

    def only(self, lane: int, why: str = "") -> AttitudeSamples:
        """Return all samples of one lane; `why`: why it was chosen, for messages."""
        return self._samples(self.lane == lane, (f"{self.name} lane {lane}" if self.has_lanes else self.name) + why)

    def primary(self, log: Records) -> AttitudeSamples:
        """Return the samples of the lane in use at each time."""
        flown = self.flown(log)
        if flown is None:
            return self.only(self.lanes[0]) if len(self.lanes) == 1 else self._closest_to_att(log)
        in_use = self.lane == flown
        if in_use.all() and len(self.lanes) == 1:
            return self.only(self.lanes[0])
        if np.count_nonzero(in_use) >= 2 and np.mean(~np.isin(flown, self.lanes)) <= _MOSTLY_UNLOGGED:
            lanes = [int(lane) for lane in np.unique(self.lane[in_use])]
            return self._samples(in_use, f"{self.name} lane {_and(lanes)} by {self.primary_message}.PI")
        return self._closest_to_att(log)

    @property
    def primary_message(self) -> str:
        """The message that says which lane is in use."""
        return f"{self.name[:2]}F4"

    def flown(self, log: Records) -> Integer | None:
        """Return the lane in use at each sample, (n,); None if the log does not say it, or the message has no lanes."""
        primary = stamped(log, self.primary_message, "PI") if self.is_of_lanes else None
        if primary is None:
            return None
        known = np.flatnonzero(np.isfinite(primary[1][0]))
        if not known.size:
            return None
        order = known[np.argsort(primary[0][known], kind="stable")]
        since_s, lane = primary[0][order], primary[1][0][order].astype(np.int64)
        of_sample: Integer = lane[(np.searchsorted(since_s, self.clock_s, side="right") - 1).clip(min=0)]
        return of_sample

    def _closest_to_att(self, log: Records) -> AttitudeSamples:
        """Return the lane that agrees best with ATT, which is always of the lane in use."""
        att = AttitudeEstimate.of(log, "ATT")
        if att is None:  # nothing distinguishes them
            return self.only(self.lanes[0], f", the lowest of {_and(self.lanes)}")

        def deviation_deg(lane: int) -> float:
            of_lane = self.lane == lane
            near = nearest(att.clock_s, self.clock_s[of_lane])
            angle_deg = _angle_deg(self.q_body_ned[of_lane], att.q_body_ned[near])
            # Rounded as ATT is: of lanes that agree equally well, the first is used.
            return round(float(np.median(angle_deg)), 2)

        return self.only(min(self.lanes, key=deviation_deg), ", nearest to ATT")

    def summary(self) -> str:
        """Return the names of the lanes and their rate, for messages."""
        lanes = self.lanes
        clock_s = np.unique(self.clock_s[self.lane == lanes[0]])
        rate = f" {mean_rate_hz(clock_s):.1f} Hz" if clock_s.size > 1 else " once"
        return " and ".join(map(self.called, lanes)) + rate

    def _samples(self, which: NDArray[np.bool_], source: str) -> AttitudeSamples:
        clock_s, lane = self.clock_s[which], self.lane[which]
        segment, reason = self._breaks.segments(clock_s, lane)
        return AttitudeSamples(clock_s, self.q_body_ned[which], segment, source, reason)


@dataclass(frozen=True, slots=True, eq=False)
class _Breaks:
    """Times since boot at which an estimate jumps: resets of the EKF's yaw, and switches to another lane."""

    resets_s: Float  # (n,) s
    before_s: Float  # (m,) s: the record before each switch
    switched_s: Float  # (m,) s: the record after it

    @classmethod
    def of(cls, log: Records, name: str) -> Self:
        nothing = np.empty(0)
        if not _OF_AN_EKF.fullmatch(name):
            return cls(nothing, nothing, nothing)
        # Messages of an EKF have the lane in each record; ATT is of the lane in use.
        return cls(_resets_s(log), *(_switches_s(log) if name == "ATT" else (nothing, nothing)))

    def segments(self, clock_s: Float, lane: Integer) -> tuple[Integer, str]:
        """Return the number of the contiguous segment of each sample, and why a new segment begins."""
        lanes, of_lane = np.unique(lane, return_inverse=True)
        resets = np.searchsorted(self.resets_s, clock_s, side="right")
        switches = np.searchsorted(self.switched_s, clock_s, side="right")
        segment = (resets * (self.switched_s.size + 1) + switches) * lanes.size + of_lane.reshape(-1)
        if self.switched_s.size:
            # ATT may jump anywhere between the two records: each sample there is a segment of its own.
            following = switches.clip(max=self.switched_s.size - 1)
            unsure = (switches <= following) & (clock_s > self.before_s[following])
            segment[unsure] = -1 - np.arange(np.count_nonzero(unsure))
        names = []
        if lanes.size > 1 or self.switched_s.size:
            names.append("a switch of the EKF lane")
        if np.unique(resets).size > 1:
            names.append("a reset of the EKF's yaw")
        return segment.astype(np.int64), " or ".join(names) or "a switch of the EKF lane"


def _resets_s(log: Records) -> Float:
    """Return the times of yaw resets by events and texts, s since boot, sorted."""
    resets_s = [np.empty(0)]
    if (events := stamped(log, "EV", "Id")) is not None:
        resets_s.append(events[0][events[1][0] == _YAW_RESET_EVENT])
    if (texts := stamped(log, "MSG")) is not None:
        is_reset = [_YAW_RESET_TEXT.search(text) is not None for text in log.texts("MSG", "Message")]
        if len(is_reset) == texts[0].size:
            resets_s.append(texts[0][is_reset])
    return np.sort(np.concatenate(resets_s))


def _switches_s(log: Records) -> tuple[Float, Float]:
    """Return the times between which ATT switched to another lane or EKF, s since boot, sorted."""
    names = [f"{ekf}F4" for ekf in ("XK", "NK") if f"{ekf}F4" in log]
    in_use = stamped(log, "ATT", "AEKF")
    if in_use is not None and in_use[0].size and np.median(in_use[1][0]) == 2:
        names.reverse()
    before, since = [np.empty(0)], [np.empty(0)]
    for records in (in_use, stamped(log, names[0], "PI") if names else None):
        if records is not None:
            order = np.argsort(records[0], kind="stable")
            clock_s, number = records[0][order], records[1][0][order]
            switched = np.flatnonzero(np.diff(number))
            before.append(clock_s[switched])
            since.append(clock_s[switched + 1])
    before_s, since_s = np.concatenate(before), np.concatenate(since)
    order = np.argsort(since_s, kind="stable")
    return before_s[order], since_s[order]


def estimates(log: Records) -> Iterator[AttitudeEstimate]:
    """Yield all attitude estimates of the log, sorted by name."""
    for name in sorted({name[:3] if re.fullmatch(r"[XN]KQ[1-3]", name) else name for name in log.names}):
        if (estimate := AttitudeEstimate.of(log, name)) is not None:
            yield estimate


def preferred_messages(log: Records) -> tuple[str, ...]:
    """Return the messages with attitude, the estimator in use first; XKQ first if the log does not name it."""
    numbers, count = np.unique(_active(log)[1], return_counts=True)
    return _MESSAGES.get(int(numbers[count.argmax()]), _NO_EKF) if numbers.size else _UNKNOWN


def flown_attitude(log: Records) -> tuple[AttitudeEstimate, AttitudeSamples] | None:
    """Return the estimate whose attitude the autopilot used, and the samples of the lane in use; None without any.

    ATT is of the lane in use: it is taken if that lane is not logged, and the lanes that are differ from ATT.
    """
    for name in preferred_messages(log):
        if (estimate := AttitudeEstimate.of(log, name)) is None:
            continue
        samples = estimate.primary(log)
        lane = estimate.flown(log)
        if lane is not None and np.mean(~np.isin(lane, estimate.lanes)) > _MOSTLY_UNLOGGED:
            att = AttitudeEstimate.of(log, "ATT")
            if att is not None and not _is_lane_of(log, samples, att.primary(log)):
                return att, att.primary(log)
        return estimate, samples
    return None


def active_estimator(log: Records) -> str | None:
    """Return the estimator in use, by ATT.AEKF: ``"EKF3"``, or ``"EKF3 92.0 %, DCM 8.0 %"``; None without AEKF."""
    numbers, count = np.unique(_active(log)[1], return_counts=True)
    if numbers.size < 2:
        return _NAMES[int(numbers[0])] if numbers.size else None
    order = np.argsort(-count, kind="stable")
    return ", ".join(f"{_NAMES[int(numbers[k])]} {100 * count[k] / count.sum():.1f} %" for k in order)


def estimator_notes(log: Records, taken: AttitudeEstimate, samples: AttitudeSamples) -> tuple[str, ...]:
    """Return remarks on the estimate that is read: its difference from another estimator, and dropped samples."""
    return (*_unlogged(log, taken), *_difference(log, taken, samples), *_losses(log, taken, samples))


def _unlogged(log: Records, taken: AttitudeEstimate) -> tuple[str, ...]:
    """Return a remark if a lane flew that is not logged."""
    names = (taken.name,) if taken.is_of_lanes else preferred_messages(log) if taken.name == "ATT" else ()
    estimate = next((one for name in names if (one := AttitudeEstimate.of(log, name)) is not None), None)
    lane = None if estimate is None else estimate.flown(log)
    if estimate is None or lane is None:
        return ()
    missing = ~np.isin(lane, estimate.lanes)
    if not missing.any():
        return ()
    flew = f"by {estimate.primary_message}.PI lane {_and(np.unique(lane[missing]).tolist())} flew"
    share = "" if missing.all() else f" for {100 * np.mean(missing):.1f} % of the time"
    logged = f"{estimate.name} has only lane {_and(estimate.lanes)}"
    choice = "it is taken" if taken.name == "ATT" else "--attitude ATT takes it"
    return (f"{flew}{share}, but {logged}; ATT is of the lane that flew, {choice}",)


def _is_lane_of(log: Records, samples: AttitudeSamples, att: AttitudeSamples) -> bool:
    """Return whether a lane and ATT have the same attitude, as far as ATT resolves it and but for the trim of ATT."""
    near = nearest(att.clock_s, samples.clock_s)
    at_once = np.abs(att.clock_s[near] - samples.clock_s) < _AT_ONCE_S
    together = at_once if at_once.any() else np.abs(att.clock_s[near] - samples.clock_s) < _TOGETHER_S
    if not together.any():
        return False
    turn = multiply(samples.q_body_ned[together], conjugate(att.q_body_ned[near][together]))
    turn_deg = np.rad2deg(2 * turn[:, 1:] * np.sign(turn[:, :1]))
    trim_deg = np.rad2deg([_parameter(log, f"AHRS_TRIM_{axis}") for axis in "XYZ"])
    off_deg = min((np.linalg.norm(turn_deg - sign * trim_deg, axis=-1) for sign in (1, -1)), key=np.median)
    return bool(np.median(off_deg) <= _SAME_LANE_DEG and np.mean(off_deg > _REPORTED_DEG) < _RARELY)


def _parameter(log: Records, name: str) -> float:
    """Return the last value of a parameter; 0 if it is not logged."""
    names, values = log.texts("PARM", "Name"), log.columns("PARM", "Value")
    if values is None or len(names) != values[0].size:
        return 0.0
    known = [value for of, value in zip(names, values[0].tolist(), strict=True) if of == name and np.isfinite(value)]
    return float(known[-1]) if known else 0.0


def _active(log: Records) -> tuple[Float, Float]:
    """Return the times of ATT, s since boot, and the number of its estimator."""
    if (records := stamped(log, "ATT", "AEKF")) is None:
        return np.empty(0), np.empty(0)
    valid = np.isin(records[1][0], list(_NAMES))
    return records[0][valid], records[1][0][valid]


def _difference(log: Records, taken: AttitudeEstimate, samples: AttitudeSamples) -> tuple[str, ...]:
    """Return the difference between ATT and the quaternions of an EKF, if one of them is read."""
    others = ("ATT",) if taken.is_of_lanes else _OF_LANES if taken.name == "ATT" else ()
    other = next((estimate for name in others if (estimate := AttitudeEstimate.of(log, name)) is not None), None)
    if other is None:
        return ()
    ekf, att = (samples, other.primary(log)) if taken.is_of_lanes else (other.primary(log), samples)
    if not ekf.clock_s.size or not att.clock_s.size:
        return ()
    near = nearest(att.clock_s, ekf.clock_s)
    together = np.abs(att.clock_s[near] - ekf.clock_s) < _TOGETHER_S
    if not together.any():
        return ()
    q_ekf, q_att = ekf.q_body_ned[together], att.q_body_ned[near][together]
    angle_deg = _angle_deg(q_ekf, q_att)
    name = taken.name if taken.is_of_lanes else other.name
    active = active_estimator(log)
    in_use = "; the log does not say which one flew" if active is None else f"; by ATT.AEKF {active} flew"
    choice = f"{taken.name} is taken, --attitude {other.name}"
    if np.median(angle_deg) <= _REPORTED_DEG:
        at_once_deg = angle_deg[np.abs(att.clock_s[near] - ekf.clock_s)[together] < _AT_ONCE_S]
        far = at_once_deg > _REPORTED_DEG
        if at_once_deg.size < _FEWEST or np.mean(far) < _RARELY:
            return ()
        fraction = f"for {100 * np.mean(far):.1f} % of the time {name} is more than {_REPORTED_DEG:.0f} deg from ATT"
        return (f"{fraction}, {at_once_deg.max():.1f} deg at most{in_use}; {choice} takes the other",)
    yaw_deg = np.rad2deg(euler_from_quaternion(q_ekf)[2] - euler_from_quaternion(q_att)[2])
    yaw_deg = (yaw_deg + 180) % 360 - 180
    return (
        f"{name} is {np.median(angle_deg):.1f} deg from ATT in the median ({np.median(np.abs(yaw_deg)):.1f} deg in yaw)"
        f"{in_use}; {choice} takes the other",
    )


def _losses(log: Records, taken: AttitudeEstimate, samples: AttitudeSamples) -> tuple[str, ...]:
    """Return remarks on dropped samples, and on the message that covers more."""
    notes = []
    is_late = taken.unaligned_s >= _REPORTED_S
    att = AttitudeEstimate.of(log, "ATT") if is_late and taken.name != "ATT" else None
    better = f"; --attitude ATT covers {np.ptp(att.clock_s):.1f} s" if att is not None and att.clock_s.size else ""
    if is_late:
        notes.append(
            f"the first {taken.unaligned_s:.1f} s of {taken.name} are left out, before its EKF was aligned:"
            f" {np.ptp(samples.clock_s):.1f} s remain{better}"
        )
    if taken.name == "ATT":
        notes += [
            f"{name} is left out because its quaternions have length {length:.3g}, not 1; ATT is used"
            for name in _OF_LANES
            if (length := AttitudeEstimate.usual_length(log, name)) is not None
            and AttitudeEstimate.of(log, name) is None
        ]
    return tuple(notes)


def _angle_deg(q: Float, other: Float) -> Float:
    """Return the angles between (n, 4) attitudes, deg."""
    turn = multiply(q, conjugate(other))
    angle_deg: Float = np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=-1), np.abs(turn[:, 0])))
    return angle_deg


def _and(lanes: list[int]) -> str:
    return " and ".join(map(str, lanes))
