"""The attitude estimator in use, and its difference from the one that is read."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.rotation import conjugate, euler_from_quaternion, multiply
from glstar.telemetry.dataflash.estimates import AttitudeEstimate
from glstar.telemetry.dataflash.records import Records, nearest, stamped
from glstar.telemetry.source import AttitudeSamples

__all__ = ["active_estimator", "estimator_notes", "preferred_messages"]

Float = NDArray[np.float64]

# The estimator of ATT, by ATT.AEKF.
_NAMES: Final = {0: "DCM", 2: "EKF2", 3: "EKF3", 10: "the simulator's", 11: "an external AHRS"}
_MESSAGES: Final = {2: ("NKQ", "XKQ", "ATT"), 3: ("XKQ", "NKQ", "ATT")}
_UNKNOWN = ("XKQ", "NKQ", "ATT")
_NO_EKF = ("ATT", "XKQ", "NKQ")

# Differences between two estimates from this on are reported, deg: 1 deg is 68 px at f = 3871 px.
_REPORTED_DEG: Final = 1.0
# Attitudes are compared if they were logged within this time, s.
_TOGETHER_S: Final = 0.05
# For differences in a part of the flight only, s: at 200 deg/s an aircraft turns by a degree in 5 ms.
_AT_ONCE_S: Final = 0.002
# Those are reported from this number of samples and from this fraction of them on.
_FEWEST: Final = 20
_RARELY: Final = 0.01
# A shorter loss of samples is not reported, s.
_REPORTED_S: Final = 1.0


def preferred_messages(log: Records) -> tuple[str, ...]:
    """Return the messages with attitude, those of the estimator in use first.

    Parameters
    ----------
    log : Records

    Returns
    -------
    tuple of str
        ``("XKQ", "NKQ", "ATT")`` if the log does not contain the estimator in use.
    """
    numbers = _active(log)[1]
    if not numbers.size:
        return _UNKNOWN
    found, count = np.unique(numbers, return_counts=True)
    return _MESSAGES.get(int(found[count.argmax()]), _NO_EKF)


def active_estimator(log: Records) -> str | None:
    """Return the estimator in use, by ATT.AEKF.

    Parameters
    ----------
    log : Records

    Returns
    -------
    str or None
        ``"EKF3"``, or ``"EKF3 92.0 %, DCM 8.0 %"`` for several; None if the log does not contain it.
    """
    numbers = _active(log)[1]
    if not numbers.size:
        return None
    found, count = np.unique(numbers, return_counts=True)
    if found.size == 1:
        return _NAMES[int(found[0])]
    order = np.argsort(-count, kind="stable")
    return ", ".join(f"{_NAMES[int(found[k])]} {100 * count[k] / numbers.size:.1f} %" for k in order)


def estimator_notes(log: Records, taken: AttitudeEstimate, samples: AttitudeSamples) -> tuple[str, ...]:
    """Return remarks on an attitude: its difference from the estimator in use, and dropped samples.

    Parameters
    ----------
    log : Records
    taken : AttitudeEstimate
        The estimate that is read.
    samples : AttitudeSamples
        Its samples.

    Returns
    -------
    tuple of str
    """
    return (*_difference(log, taken, samples), *_losses(log, taken, samples))


def _active(log: Records) -> tuple[Float, Float]:
    """Return the times of ATT, s since boot, and the number of its estimator."""
    if (records := stamped(log, "ATT", "AEKF")) is None:
        return np.empty(0), np.empty(0)
    known = np.isin(records[1][0], list(_NAMES))
    return records[0][known], records[1][0][known]


def _difference(log: Records, taken: AttitudeEstimate, samples: AttitudeSamples) -> tuple[str, ...]:
    """Return the difference between ATT and the quaternions of an EKF, if one of them is read."""
    ekf, att = (samples, None) if taken.name[:3] in ("XKQ", "NKQ") else (None, samples)
    if att is None:
        estimate = AttitudeEstimate.of(log, "ATT")
        att = None if estimate is None else estimate.primary(log)
    elif taken.name == "ATT":
        other = next((one for name in ("XKQ", "NKQ") if (one := AttitudeEstimate.of(log, name)) is not None), None)
        ekf = None if other is None else other.primary(log)
    if ekf is None or att is None or not ekf.clock_s.size or not att.clock_s.size:
        return ()
    near = nearest(att.clock_s, ekf.clock_s)
    together = np.abs(att.clock_s[near] - ekf.clock_s) < _TOGETHER_S
    if not together.any():
        return ()
    q_ekf, q_att = ekf.q_body_ned[together], att.q_body_ned[near][together]
    turn = multiply(q_ekf, conjugate(q_att))
    angle_deg = np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=-1), np.abs(turn[:, 0])))
    name = taken.name if taken.name != "ATT" else ekf.source.split(" ")[0]
    flew = active_estimator(log)
    flown = "; the log does not say which one flew" if flew is None else f"; by ATT.AEKF {flew} flew"
    choice = f"{'ATT' if samples is att else name} is taken, --attitude {'ATT' if samples is ekf else name}"
    if np.median(angle_deg) <= _REPORTED_DEG:
        at_once_deg = angle_deg[np.abs(att.clock_s[near] - ekf.clock_s)[together] < _AT_ONCE_S]
        far = at_once_deg > _REPORTED_DEG
        if at_once_deg.size < _FEWEST or np.mean(far) < _RARELY:
            return ()
        fraction = f"for {100 * np.mean(far):.1f} % of the time {name} is more than {_REPORTED_DEG:.0f} deg from ATT"
        return (f"{fraction}, {at_once_deg.max():.1f} deg at most{flown}; {choice} takes the other",)
    yaw_deg = np.rad2deg(euler_from_quaternion(q_ekf)[2] - euler_from_quaternion(q_att)[2])
    yaw_deg = (yaw_deg + 180) % 360 - 180
    return (
        f"{name} is {np.median(angle_deg):.1f} deg from ATT in the median ({np.median(np.abs(yaw_deg)):.1f} deg in yaw)"
        f"{flown}; {choice} takes the other",
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
            for name in ("XKQ", "NKQ")
            if (length := AttitudeEstimate.usual_length(log, name)) is not None
            and AttitudeEstimate.of(log, name) is None
        ]
    return tuple(notes)
