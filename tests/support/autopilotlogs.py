"""Valid logs of autopilots with decoys beside the truth, made by a random generator.

The aircraft is level and turns: at any UTC its yaw is `yaw_deg`, by whatever clock, boot or lane the log has it.  A log
may have a second camera, failed captures, unanswered triggers, a clock of a ground station, a receiver without a
fix, ages of UTC beyond reason, an EKF lane that is not logged, and a reboot.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion
from glstar.telemetry import open_flight
from tests.support import dataflash, tlog, ulog
from tests.support.dataflash import with_head

ELEVEN_S = tlog.ELEVEN_S
_TURN_DEG_PER_S = 2.0
_ATTITUDE_HZ, _GPS_HZ = 20.0, 5.0
# A camera's times: 20 ms of a log's own clock, 0.3 s of a packet's arrival.
_EXACT_S, _ON_ARRIVAL_S = 0.02, 0.3
_FAR_DEG = 40.0


def yaw_deg(utc_s: float) -> float:
    """Return the yaw of the aircraft at a UTC."""
    return (100.0 + _TURN_DEG_PER_S * (utc_s - ELEVEN_S)) % 360


@dataclass(slots=True)
class Case:
    """A log, and what it should say."""

    path: Path
    decoys: list[str] = field(default_factory=list)
    triggers: dict[str, list[float]] = field(default_factory=dict)  # UTC of the triggers of each camera, s
    on_arrival: bool = False  # Whether some triggers are dated by their arrival only
    offset_s: float = 0.01  # Largest error of UTC that is not a fault
    numbers: list[int] | None = None  # Numbers of the images of the only camera; None: by their order

    def wrong(self, flight: Flight) -> str:
        """Return what a flight has wrong; empty if nothing."""
        utc_s = flight.attitude.utc_s[:: max(1, flight.attitude.utc_s.size // 50)]
        _, _, yaw_rad = euler_from_quaternion(flight.attitude.q_body_ned[:: max(1, flight.attitude.utc_s.size // 50)])
        off_deg = np.rad2deg(np.asarray(yaw_rad)) - np.array([yaw_deg(t) for t in utc_s.tolist()])
        largest_deg = float(np.abs((off_deg + 180) % 360 - 180).max())
        if largest_deg > _TURN_DEG_PER_S * self.offset_s + 0.011:
            return f"yaw is {largest_deg:.3f} deg off"
        found = {triggers.camera: triggers for triggers in flight.triggers}
        names = dict.fromkeys([*found, *self.triggers]) if len(self.triggers) != 1 or len(found) != 1 else ["camera"]
        for name in names:
            times_s = np.array(self.triggers.get(name, next(iter(self.triggers.values()), [])))
            if name not in found and name != "camera":
                return f"no triggers of {name}"
            triggers = flight.triggers_of(name)
            if triggers.utc_s.size != times_s.size:
                return f"{triggers.utc_s.size} triggers of {name}, not {times_s.size}"
            allowed_s = self.offset_s + (_ON_ARRIVAL_S if self.on_arrival else _EXACT_S)
            if np.abs(np.sort(triggers.utc_s) - np.sort(times_s)).max(initial=0.0) > allowed_s:
                return (
                    f"triggers of {name} are {np.round(np.sort(triggers.utc_s) - np.sort(times_s), 3).tolist()} s off"
                )
            if self.numbers is not None and triggers.numbers.tolist() != self.numbers:
                return f"images of {name} are numbered {triggers.numbers.tolist()}, not {self.numbers}"
        return ""


def judge(case: Case) -> str:
    """Return "" if a log is read right, "refused: ..." if it is refused, or else what is wrong."""
    try:
        flight = open_flight(case.path)
    except LogFormatError as error:
        return f"refused: {error.reason}"
    return case.wrong(flight)


def random_log(seed: int, folder: Path) -> Case:
    """Write the log of a seed into a folder."""
    rng = np.random.default_rng(seed)
    makers = (_px4, _dataflash, _dataflash, _telemetry, _telemetry)
    return makers[int(rng.integers(len(makers)))](rng, folder)


def _choice(rng: np.random.Generator, *options: str) -> str:
    return options[int(rng.integers(len(options)))]


def _shots(rng: np.random.Generator, duration_s: float) -> list[float]:
    """Return the times of some triggers, s from the first attitude, far from each other and from both ends."""
    count = int(rng.integers(2, 8))
    return np.round(np.linspace(1.5, duration_s - 1.5, count) + rng.uniform(-0.2, 0.2, count), 3).tolist()


def _times(duration_s: float, rate_hz: float) -> Iterator[float]:
    return (k / rate_hz for k in range(round(duration_s * rate_hz) + 1))


# --- PX4 ------------------------------------------------------------------------------------------------------------
def _px4(rng: np.random.Generator, folder: Path) -> Case:
    case = Case(folder / "log.ulg")
    parts = []
    start_s = 0.0
    for _ in range(int(rng.integers(1, 3))):
        duration_s = float(rng.uniform(10.0, 25.0))
        parts.append(_px4_boot(rng, case, start_s, duration_s))
        start_s += duration_s + float(rng.uniform(5.0, 2000.0))
    case.path.write_bytes(b"".join(parts))
    return case


def _px4_boot(rng: np.random.Generator, case: Case, start_s: float, duration_s: float) -> bytes:
    """Write a boot that begins `start_s` after 11:00 UTC, with its triggers."""
    log = ulog.Log()
    boot_s = float(np.round(rng.uniform(5.0, 300.0), 2))
    utc = lambda t: ELEVEN_S + start_s + t  # noqa: E731 - a short name for many calls
    clock = _choice(
        rng,
        "gps",
        "gps",
        "ages",
        "ages of another clock",
        "repeated without ages",
        "random ages",
        "some ages",
        "at boot only",
    )
    bogus = clock != "at boot only" and rng.random() < 0.3
    case.decoys += [clock] + (["a date of its own before the fix"] if bogus else [])
    case.offset_s = 0.01
    if clock == "at boot only" or rng.random() < 0.3:
        off_s = 0.0 if clock == "at boot only" else float(rng.uniform(-4000, 4000))
        log.about("boot_time_utc_us", "uint64_t", round((utc(0.0) - boot_s + off_s) * 1e6))
    fix_s = float(rng.uniform(0.0, 0.7)) * duration_s if bogus else 0.0
    second = rng.random() < 0.3
    odd_age_s = float(rng.uniform(2.1, 2000.0)) * (1 if rng.random() < 0.5 else -1)
    for k, t in enumerate(_times(duration_s, _ATTITUDE_HZ)):
        log.attitude(boot_s + t, yaw_deg(utc(t)), sampled=k % 2 == 0)
        log.attitude(boot_s + t, yaw_deg(utc(t)) + _FAR_DEG, name="vehicle_attitude_groundtruth")
        if k % 4:
            continue
        fixed, age_s, logged_age_s = t >= fix_s, 0.0, None
        if clock == "ages":
            age_s = round(t % 1.0, 6)
        elif clock in {"ages of another clock", "repeated without ages"}:
            age_s = round(t % 1.0, 6) if second or clock == "repeated without ages" else 0.0
            logged_age_s = odd_age_s if clock == "ages of another clock" else 0.0
        elif clock == "random ages":
            logged_age_s = float(rng.uniform(2.5, 2147.0))
        elif clock == "some ages" and k % 16:
            logged_age_s = odd_age_s
        elif clock == "at boot only":
            fixed = False
        # A fix at boot time 30 s is at 11:00 UTC by default.
        own_s = utc(t) - age_s if fixed else utc(t) + (0.0 if clock == "at boot only" else 5e6)
        if clock == "at boot only":
            log.gps(boot_s + t, fix=3, utc_s=0.0)
            continue
        log.gps(
            boot_s + t, fix=3 if fixed else 0, utc_s=own_s, age_s=age_s, logged_age_s=logged_age_s, instance=int(second)
        )
        if second:
            log.gps(boot_s + t, fix=0, utc_s=utc(t) - 9e6)
    _px4_triggers(rng, case, log, (start_s, boot_s, duration_s))
    return log.data()


def _px4_triggers(rng: np.random.Generator, case: Case, log: ulog.Log, boot: tuple[float, float, float]) -> None:
    """Write triggers of a boot: its start, s after 11:00 UTC, the clock then, and its duration."""
    start_s, boot_s, duration_s = boot
    kind = _choice(rng, "none", "sent", "answered", "captured", "failed", "late captures")
    stamped = _choice(rng, "right", "zero", "another")
    if case.triggers and kind == "none":
        kind = "sent"
    case.decoys += [f"triggers {kind}", f"UTC of triggers {stamped}"]
    cameras = 2 if kind in {"captured", "failed"} and rng.random() < 0.3 else 1
    for camera in range(cameras) if kind != "none" else ():
        exposed: list[float] = []
        for number, t in enumerate(_shots(rng, duration_s)):
            true_s = ELEVEN_S + start_s + t
            utc_s = {"right": true_s, "zero": 0.0, "another": true_s - 3600.0}[stamped]
            answers = kind == "answered" and (number == 0 or rng.random() < 0.7)
            if kind in {"sent", "answered", "late captures"}:
                log.trigger(boot_s + t, number, utc_s=utc_s)
            if answers:
                log.trigger(boot_s + t + 0.12, number, feedback=True, utc_s=utc_s and utc_s + 0.12)
            failed = kind == "failed" and number > 0 and rng.random() < 0.4
            if kind in {"captured", "failed"} or (kind == "late captures" and number > 0):
                log.capture(boot_s + t, number, result=0 if failed else _result(rng), utc_s=utc_s, instance=camera)
            if kind == "answered" and answers:
                exposed.append(true_s + 0.12)
            elif kind != "answered" and not failed:
                exposed.append(true_s)
        case.triggers.setdefault(f"camera:{camera}", []).extend(exposed)


def _result(rng: np.random.Generator) -> int:
    return 1 if rng.random() < 0.7 else -1


# --- ArduPilot's own log --------------------------------------------------------------------------------------------
# Part of a boot, as fractions, in which lane 0 is far from the truth, by what is logged.
_FAR = {
    "lanes 0 and 1": (0.0, 1.0),
    "lane 1 not logged, 0 far": (0.0, 1.0),
    "lane 1 not logged, 0 far later": (0.7, 1.0),
    "a lane not logged for a part": (0.3, 0.6),
}


def _dataflash(rng: np.random.Generator, folder: Path) -> Case:
    case = Case(folder / "log.BIN")
    text = rng.random() < 0.3
    parts = []
    start_s = 0.0
    for _ in range(int(rng.integers(1, 3)) if not text else 1):
        duration_s = float(rng.uniform(10.0, 25.0))
        log = dataflash.TextLog() if text else dataflash.Log()
        _dataflash_boot(rng, case, log, (start_s, float(np.round(rng.uniform(5.0, 300.0), 2)), duration_s))
        parts.append(log.data if text else with_head(log.data))
        start_s += duration_s + float(rng.uniform(5.0, 2000.0))
    case.path.write_bytes(b"".join(parts))
    return case


def _dataflash_boot(rng: np.random.Generator, case: Case, log: dataflash.Log, boot: tuple[float, float, float]) -> None:
    start_s, boot_s, duration_s = boot
    lanes = _choice(rng, "one lane", "ATT only", "lane 1 not logged", *_FAR)
    sampled = _choice(rng, "GPA", "no GPA", "GPA of another clock")
    bogus, second = rng.random() < 0.3, rng.random() < 0.3
    case.decoys += [lanes, sampled] + ["a week of its own before the fix"] * bogus + ["a second receiver"] * second
    case.offset_s = max(case.offset_s, 0.01 if sampled == "GPA" else 0.08)
    fix_s, lag_s = float(rng.uniform(0.0, 0.7)) * duration_s if bogus else 0.0, float(rng.uniform(0.01, 0.09))
    far_from_s, far_to_s = np.multiply(_FAR.get(lanes, (2.0, 2.0)), duration_s)
    if "1" in lanes:
        log.xkf4(boot_s - 0.1, primary=1)
    for k, t in enumerate(_times(duration_s, _ATTITUDE_HZ)):
        true_deg = yaw_deg(ELEVEN_S + start_s + t)
        log.att(boot_s + t, yaw_deg=true_deg)
        log.pos(boot_s + t)
        if lanes != "ATT only":
            log.xkq(boot_s + t, 0, true_deg + (_FAR_DEG if far_from_s <= t <= far_to_s else 0.0))
        if lanes == "lanes 0 and 1":
            log.xkq(boot_s + t, 1, true_deg)
        if lanes == "a lane not logged for a part":
            log.xkf4(boot_s + t - 0.001, primary=int(far_from_s <= t <= far_to_s))
        if k % 4:
            continue
        _dataflash_fix(log, boot_s + t, start_s + t - boot_s - t, lag_s, fixed=t >= fix_s, sampled=sampled)
        if second:
            log.gps(boot_s + t, receiver=1, in_use=0, week=dataflash.WEEK - 9)
    _dataflash_triggers(rng, case, log, boot)


def _dataflash_fix(
    log: dataflash.Log, clock_s: float, later_s: float, lag_s: float, *, fixed: bool, sampled: str
) -> None:
    """Write a GPS record and its GPA; `later_s`: seconds after 11:00 UTC minus the clock."""
    ms = dataflash.ELEVEN_MS + round((clock_s + later_s) * 1000)
    place = (-349300000, 1386000000, 48.0)
    week = dataflash.WEEK if fixed else dataflash.WEEK - 900
    values = (round((clock_s + lag_s) * 1e6), 0, 3 if fixed else 1, ms, week, *place, 1)
    log.add("GPS", "QBBIHLLfB", "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,U", *values)
    if sampled != "no GPA":
        sms = round(clock_s * 1000) + (0 if sampled == "GPA" else 1_351_000)
        log.add("GPA", "QBI", "TimeUS,I,SMS", round((clock_s + lag_s) * 1e6), 0, sms)


def _dataflash_triggers(
    rng: np.random.Generator, case: Case, log: dataflash.Log, boot: tuple[float, float, float]
) -> None:
    start_s, boot_s, duration_s = boot
    for camera in range(int(rng.integers(0, 4))):
        kind = _choice(rng, "CAM", "TRIG", "both", "partly")
        case.decoys.append(f"camera {camera} {kind}")
        exposed = []
        for number, t in enumerate(_shots(rng, duration_s)):
            answers = kind in {"CAM", "both"} or (kind == "partly" and (number == 0 or rng.random() < 0.7))
            if kind != "CAM":
                log.camera("TRIG", boot_s + t, camera, number)
            if answers:
                log.camera("CAM", boot_s + t + 0.1, camera, number)
            if answers or kind == "TRIG":
                exposed.append(ELEVEN_S + start_s + t + (0.1 if answers else 0.0))
        case.triggers.setdefault(f"camera:{camera}", []).extend(exposed)


# --- telemetry ------------------------------------------------------------------------------------------------------
def _telemetry(rng: np.random.Generator, folder: Path) -> Case:
    case = Case(folder / "log.tlog")
    log = tlog.Log()
    start_s, since_s, boots = 0.0, np.inf, int(rng.integers(1, 3))
    log.stamp_s = 0.0
    recorder_s = ELEVEN_S + float(rng.uniform(-1e8, 1e8))
    for _ in range(boots):
        duration_s = float(rng.uniform(15.0, 40.0))
        recorder_s += _telemetry_boot(rng, case, log, (start_s, duration_s, recorder_s), since_s)
        since_s = float(rng.uniform(5.0, 2000.0))
        start_s += duration_s + since_s
    if boots > 1:
        case.numbers = None
    log.save(case.path)
    return case


def _telemetry_boot(
    rng: np.random.Generator, case: Case, log: tlog.Log, boot: tuple[float, float, float], since_s: float
) -> float:
    """Write a boot `since_s` after the one before; return by how much the recorder's clock was set during it, s."""
    start_s, duration_s, recorder_s = boot
    # An autopilot is not switched on before its last boot ends: its clocks would be those of one boot.
    boot_s = min(float(np.round(rng.uniform(5.0, 300.0), 2)), since_s - 0.5)
    clock = _choice(rng, "gps", "gps", "station first", "station's only", "nearly right first")
    step_s = float(rng.uniform(2.0, 7200.0)) * (1 if rng.random() < 0.5 else -1) if rng.random() < 0.25 else 0.0
    loss = (float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.4, 0.7))) if rng.random() < 0.25 else (2.0, 2.0)
    case.decoys += [clock, "recorder's clock set"] if step_s else [clock]
    case.decoys += ["link lost"] * (loss[0] < 1)
    off_s = {"station first": float(rng.uniform(-9000, 9000)), "nearly right first": float(rng.uniform(0.15, 2.0))}
    # Not while the recorder's clock is set: such a boot could not be distinguished from another one.
    corrected_s = float(rng.uniform(0.1, 0.7)) * duration_s
    case.offset_s = max(case.offset_s, 0.15 if clock == "station's only" else 0.01)
    pending = _feedback(rng, case, (start_s, boot_s, duration_s), loss)
    second = rng.random() < 0.3
    case.decoys += ["a second vehicle"] * second
    for k, t in enumerate(_times(duration_s, _ATTITUDE_HZ)):
        is_lost = loss[0] * duration_s < t < loss[1] * duration_s
        utc_s, clock_s = ELEVEN_S + start_s + t, boot_s + t
        log.stamp_s = (
            recorder_s + start_s - boot_s + float(rng.uniform(0.0, 0.1)) + (step_s if t > 0.8 * duration_s else 0)
        )
        while pending and pending[0][0] <= t:
            _, *packet = pending.pop(0)
            log.feedback(clock_s, *packet)
        if is_lost:
            continue
        log.attitude(clock_s, yaw_deg(utc_s))
        if second:
            log.attitude(clock_s + 3.0, yaw_deg(utc_s) + _FAR_DEG, sender=(2, 1))
        if k % 10:
            continue
        for system in (1, 2) if second else (1,):
            log.heartbeat(clock_s, sender=(system, 1))
        log.place(clock_s)
        own_s = utc_s + (off_s.get(clock, 0.0) if t < corrected_s else 0.0)
        if k % 20 == 0:
            log.time(clock_s, utc_s=0.0 if clock == "station's only" else own_s)
            log.time(clock_s, sender=(255, 190), utc_s=utc_s if clock == "station's only" else utc_s + 777.0, boot_ms=k)
    return step_s


def _feedback(
    rng: np.random.Generator, case: Case, boot: tuple[float, float, float], loss: tuple[float, float]
) -> list[tuple[float, float, int, int]]:
    """Return packets of cameras: when each arrives, s from the first attitude, its time, img_idx and cam_idx."""
    start_s, boot_s, duration_s = boot
    cameras = 1 if case.triggers else int(rng.integers(0, 3))
    cameras = len(case.triggers) or cameras
    pending = []
    for camera in range(cameras):
        kind = _choice(rng, "UTC", "since boot", "none", "none before GPS")
        case.decoys.append(f"feedback {kind}")
        numbers, exposed = [], []
        first = int(rng.integers(0, 3))
        for number, t in enumerate(_shots(rng, duration_s)):
            utc_s = ELEVEN_S + start_s + t
            time_s = {"UTC": utc_s, "since boot": boot_s + t, "none": 0.0}.get(kind, 0.0 if number < 2 else utc_s)
            case.on_arrival |= time_s == 0.0
            arrival_s = t + float(rng.uniform(0.0, 0.1))
            if loss[0] * duration_s - 0.2 < t < loss[1] * duration_s + 0.2 or (number and rng.random() < 0.1):
                continue
            pending += [(arrival_s, time_s, number + first, camera)] * (2 if rng.random() < 0.2 else 1)
            exposed.append(utc_s)
            numbers.append(number + first)
        case.triggers.setdefault(f"camera:{camera}", []).extend(exposed)
        case.numbers = numbers if cameras == 1 else None
    return sorted(pending)
