"""How many random frames the example navigator solves: ``python -m tests.scripts.celestial_fix_rate [FRAMES]``.

Static frames, and frames of a camera that turns by 10 deg/s for 0.5 s: 55 deg wide, V 6.5, default noise, at random
times, places and attitudes.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tests.examples import celestial_fix

SWEEP = """
[sweep]
draws = {frames}
flight.synthetic.start_utc = { min = 2024-01-01T00:00:00Z, max = 2025-01-01T00:00:00Z }
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
    seen, hidden, answers = folder / f"{kind}-seen", folder / f"{kind}-hidden", folder / f"{kind}.jsonl"
    _glstar("export", "-c", folder / f"{kind}.toml", "-o", seen, "--blind", hidden, "--frames", 1, "--every", 1)
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
