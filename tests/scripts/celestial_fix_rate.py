"""How many random frames the example navigator solves: ``python -m tests.scripts.celestial_fix_rate [FRAMES]``.

Static frames, and frames of a camera that turns by 10 deg/s for 0.5 s: 55 deg wide, V 6.5, default noise, at random
times, places and attitudes.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.examples import celestial_fix

SWEEP = """
[sweep]
draws = {frames}
flight.synthetic.utc_start = { min = 2024-01-01T00:00:00Z, max = 2025-01-01T00:00:00Z }
flight.synthetic.latitude_deg = { min = -70, max = 70 }
flight.synthetic.longitude_deg = { min = -180, max = 180 }
flight.synthetic.heading_deg = { min = 0, max = 360 }
"""
STATIC = """
[flight.synthetic]
path = "still"
duration_s = 1.0
rate_hz = 10
[navigator]
gps = "denied"
"""
STATIC_SWEEP = """
flight.synthetic.roll_deg = { min = -30, max = 30 }
flight.synthetic.pitch_deg = { min = -30, max = 30 }
"""
TURNING = """
[flight.synthetic]
path = "spin"
yaw_rate_deg_per_s = 10
duration_s = 1.0
rate_hz = 50
[navigator]
gps = "denied"
"""
TURNING_SWEEP = """
mount.pitch_deg = { min = 20, max = 60 }
"""
KINDS = {"static": STATIC + SWEEP + STATIC_SWEEP, "turning": TURNING + SWEEP + TURNING_SWEEP}


def summary_of(kind: str, frames: int, folder: Path) -> dict[str, Any]:
    """Return the summary of the score of random frames of one kind.

    Parameters
    ----------
    kind : {"static", "turning"}
    frames : int
    folder : Path
        For the frames and the answers.

    Returns
    -------
    dict
    """
    text = KINDS[kind].replace("{frames}", str(frames))
    (folder / f"{kind}.toml").write_text(text, encoding="utf-8")
    return _summary(folder / kind, "-c", folder / f"{kind}.toml", "--every", 1)


def summary_of_accelerated(rates_deg_per_s: Sequence[tuple[float, float]], folder: Path) -> dict[str, Any]:
    """Return the summary of the score of frames in which the camera accelerates.

    Parameters
    ----------
    rates_deg_per_s : sequence of (float, float)
        Of each frame, the rate of yaw when the shutter opens and when it closes, deg/s.
    folder : Path

    Returns
    -------
    dict
    """
    logs = []
    for number, (first, last) in enumerate(rates_deg_per_s):
        t_s = np.arange(0.0, 0.51, 0.02)
        yaw_deg = 40.0 * number + first * t_s + (last - first) * t_s**2
        rows = [
            f"{1.71e9 + 7e6 * number + t:.2f},5,0,{yaw:.9f},-30,140,300" for t, yaw in zip(t_s, yaw_deg, strict=True)
        ]
        logs.append(folder / f"accelerated{number}.csv")
        head = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
        logs[-1].write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    (folder / "denied.toml").write_text('[mount]\npitch_deg = 50\n[navigator]\ngps = "denied"\n', encoding="utf-8")
    return _summary(folder / "accelerated", *logs, "-c", folder / "denied.toml", "--exposure", 0.5)


def _summary(place: Path, *arguments: object) -> dict[str, Any]:
    """Export one frame of each flight, answer it and return the summary of the score."""
    seen, hidden, answers = (place.with_name(f"{place.name}{end}") for end in ("-seen", "-hidden", ".jsonl"))
    _glstar("export", *arguments, "-o", seen, "--blind", hidden, "--frames", 1)
    celestial_fix.main(seen, answers)
    found: dict[str, Any] = json.loads(_glstar("score", hidden, answers, "--json"))["summary"]
    return found


def _glstar(*arguments: object) -> str:
    program = [sys.executable, "-m", "glstar", *map(str, arguments)]
    return subprocess.run(program, check=True, capture_output=True, text=True, timeout=3600).stdout


def main() -> None:
    """Print the rates."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            found = summary_of(kind, frames, Path(folder))
            position = found["position_km"] or {"median": float("nan"), "p90": float("nan")}
            print(
                f"{kind}: {found['solved']} of {found['frames']} solved, {found['false']} false,"
                f" {found['refused']} refused; position {position['median'] / 1.852:.3f} nm (median),"
                f" {position['p90'] / 1.852:.3f} nm (90 %)"
            )


if __name__ == "__main__":
    main()
