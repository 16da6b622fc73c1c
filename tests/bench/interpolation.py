"""Accuracy of interpolated attitude: ``poe bench interpolation``, or ``python -m tests.bench.interpolation``.

Thins a record, interpolates, and compares with the removed samples.  Errors are in pixels at f = 3871 px (6 mm on the
PiCamHQ's 1.55 um pixels), of two kinds: the total rotation angle between the attitude and the true one, and the angle
between the boresights of a camera on top of the aircraft.

Adelaide    the simulated flight at 200 Hz, XKQ, to 156 deg/s; it has no gyros
Skywalker   a real flying wing at 50 Hz, ATT (rounded to 0.01 deg) and IMU, to 203 deg/s
vibration   0.2 deg at 15 Hz on a gentle manoeuvre, attitude 10 Hz; gyros of 0.1 deg/s noise and 0.6 deg/s bias
"""

import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from glstar.flight import AttitudeTrack
from glstar.rotation import conjugate, matrix_from_quaternion, multiply, turn_from_quaternion
from glstar.system.resources import asset
from glstar.telemetry import open_source
from glstar.telemetry.recording import Recording
from tests.flight.test_interpolation import DEG, F_PX, LOGS, manoeuvre, measured

_ROUNDS = 5


def main() -> None:
    console = Console(width=140)
    table = Table(title=f"errors in pixels at f = {F_PX:.0f} px; cost of an evaluated sample, slerp = 1")
    for column in ("flight", "attitude", "method", "rms", "95 %", "max", "boresight rms", "95 %", "max", "cost"):
        table.add_column(column, justify="right")
    for row in [*_adelaide(), *_skywalker(), *_vibration()]:
        table.add_row(*row)
    console.print(table)


def _adelaide() -> list[list[str]]:
    log = LOGS / "plane_SITL_adelaide_200Hz.BIN"
    t, q, _ = _recorded(log if log.exists() else asset("adelaide.BIN"))
    return [row for rate_hz in (30, 25, 10, 5) for row in _thinned("Adelaide", t, q, None, rate_hz)]


def _skywalker() -> list[list[str]]:
    log = LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN"
    if not log.exists():
        return []
    t, q, rates = _recorded(log)
    return [row for rate_hz in (10, 5) for row in _thinned("Skywalker", t, q, rates, rate_hz)]


def _vibration() -> list[list[str]]:
    rng = np.random.default_rng(0)
    rows = []
    for gyro_hz in (200, 400):
        t, rate_t = np.arange(0, 30, 0.001), np.arange(-0.1, 30.1, 1 / gyro_hz) + 0.0007
        rate = measured(rate_t, 0.2) + rng.normal(0, 0.1 * DEG, (rate_t.size, 3)) + np.array([0.5, -0.3, 0.2]) * DEG
        rows += _thinned(f"vibration, gyros {gyro_hz} Hz", t, manoeuvre(t, 0.2), (rate_t, rate), 10)
    return rows


def _recorded(log: Path) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray] | None]:
    with open_source(log) as source:
        reported = Recording.read(source)
    track = reported.attitude_track(0.0)
    rates = (reported.rates.clock_s, reported.rates.rate_rad_per_s) if reported.rates.clock_s.size else None
    return track.utc_s, track.q_body_ned, rates


def _thinned(
    name: str, t: np.ndarray, q: np.ndarray, rates: tuple[np.ndarray, np.ndarray] | None, rate_hz: float
) -> list[list[str]]:
    few = np.unique(np.searchsorted(t, np.arange(t[0], t[-1], 1 / rate_hz) - 1e-3))
    inside = t <= t[few[-1]]
    truth, rows, slerp_s = q[inside], [], 0.0
    for method in ("slerp", "spline", "gyro"):
        if method == "gyro" and rates is None:
            continue
        track = AttitudeTrack.from_samples(t[few], q[few], interpolation=method, rates=rates, max_gap_s=1.0)
        found = track.at(t[inside])
        cost_s = min(_seconds(track, t[inside]) for _ in range(_ROUNDS))
        slerp_s = slerp_s or cost_s
        whole = np.linalg.norm(turn_from_quaternion(multiply(found, conjugate(truth))), axis=-1)
        down, true_down = (matrix_from_quaternion(a)[:, 2] for a in (found, truth))
        boresight = np.linalg.norm(np.cross(down, true_down), axis=-1)
        rows.append(
            [name, f"{rate_hz:.0f} Hz", method, *_reported(whole), *_reported(boresight), f"{cost_s / slerp_s:.2f}"]
        )
    return rows


def _seconds(track: AttitudeTrack, t: np.ndarray) -> float:
    began_s = time.process_time()
    track.at(t)
    return time.process_time() - began_s


def _reported(error_rad: np.ndarray) -> list[str]:
    px = F_PX * error_rad
    return [f"{np.sqrt(np.mean(px**2)):.2f}", f"{np.percentile(px, 95):.2f}", f"{px.max():.1f}"]


if __name__ == "__main__":
    main()
