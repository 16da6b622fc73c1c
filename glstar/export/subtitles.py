"""Subtitles of a video: time, attitude and stars of each frame, as a SubRip file beside it."""

from math import asin, degrees
from pathlib import Path
from typing import Any

import numpy as np

from glstar.errors import ExportError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.readtruth import read_truth
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion
from glstar.sky.horizon import ned_to_azimuth_altitude_rad
from glstar.system.durable import publish, temporary_path

__all__ = ["write_subtitles"]


def write_subtitles(export: Path, output: Path, *, frames_per_s: float) -> None:
    """Write the subtitles of the video that ``glstar export --video`` makes of the same frames.

    Parameters
    ----------
    export : Path
        The directory of an export.
    output : Path
        The SubRip file; players show it with a video of the same name.
    frames_per_s : float
        Frame rate of the video, 1/s.

    Raises
    ------
    ExportError
        If the directory has no truth, or the file cannot be written.
    """
    with explain_disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(output)
        try:
            is_empty = True
            with temporary.open("wb") as file:
                for number, truth in enumerate(read_truth(export)):
                    file.write(("\n" * (number > 0) + _entry(number, truth, frames_per_s)).encode())
                    is_empty = False
            if is_empty:
                raise ExportError(export, "has no frames")
            publish(temporary, output)
        finally:
            temporary.unlink(missing_ok=True)


def _entry(number: int, truth: dict[str, Any], frames_per_s: float) -> str:
    """Return the entry of one frame, which is shown as long as the frame."""
    roll, pitch, yaw = (degrees(float(angle)) for angle in euler_from_quaternion(truth["q_body_ned"]))
    C_camera_ned = np.array(truth["C_camera_body"]) @ matrix_from_quaternion(np.array(truth["q_body_ned"]))
    azimuth, _ = np.rad2deg(ned_to_azimuth_altitude_rad(C_camera_ned[2]))
    altitude = degrees(asin(min(max(truth["up_camera"][2], -1.0), 1.0)))
    site = truth["site"]
    lines = (
        str(number + 1),
        f"{_time(number / frames_per_s)} --> {_time((number + 1) / frames_per_s)}",
        f"{truth['file']}  {truth['utc_mid']}  {truth['duration_s']:g} s  {len(truth['stars'])} stars",
        f"axis: azimuth {azimuth:.2f} deg, altitude {altitude:.2f} deg"
        f"  aircraft: roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw % 360:.2f} deg",
        f"{site['latitude_deg']:.6f}, {site['longitude_deg']:.6f}, {site['height_m']:.0f} m",
    )
    return "\n".join(lines) + "\n"


def _time(seconds: float) -> str:
    """Return a time as SubRip writes it: ``00:01:02,345``."""
    milliseconds = round(seconds * 1000)
    minutes, rest = divmod(milliseconds, 60_000)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest // 1000:02d},{rest % 1000:03d}"
