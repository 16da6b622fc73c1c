"""Mounts by name: ``zenith``, ``down``, ``forward-up-30``, and the names of mounts that are given by angles."""

import re
from dataclasses import dataclass
from math import degrees, radians
from types import MappingProxyType
from typing import Final

import numpy as np

from glstar.camera.model import Mount
from glstar.errors import ConfigError
from glstar.system.userinput import nearest_word


@dataclass(frozen=True, slots=True)
class NamedMount:
    """A mount that has a name."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    points: str  # Where the camera points on a level aircraft
    image: str  # What is to the right and at the bottom of the image


MOUNTS: Final = MappingProxyType(
    {
        "zenith": NamedMount(-90, 90, 0, "straight up", "right is forward, bottom is the left wing"),
        "down": NamedMount(0, -90, 0, "straight down", "right is the right wing, bottom is the tail"),
        "nose": NamedMount(0, 0, 0, "forward, at the horizon", "right is the right wing, bottom is down"),
        "right": NamedMount(90, 0, 0, "along the right wing", "right is the tail, bottom is down"),
        "left": NamedMount(-90, 0, 0, "along the left wing", "right is forward, bottom is down"),
        "tail": NamedMount(180, 0, 0, "backward, at the horizon", "right is the left wing, bottom is down"),
        "forward-up-30": NamedMount(0, 30, 0, "forward, 30 deg up", "right is the right wing"),
        "right-up-30": NamedMount(90, 30, 0, "to the right, 30 deg up", "right is the tail"),
        "left-up-30": NamedMount(-90, 30, 0, "to the left, 30 deg up", "right is forward"),
        "back-up-30": NamedMount(180, 30, 0, "backward, 30 deg up", "right is the left wing"),
        "forward-down-30": NamedMount(0, -30, 0, "forward, 30 deg down", "right is the right wing"),
    }
)

# Directions of the names with an elevation, such as ``forward-up-22.5``: yaw, deg.
_YAW_DEG: Final = MappingProxyType({"forward": 0.0, "right": 90.0, "left": -90.0, "back": 180.0})
# Angles that differ by less are the same mount, deg.
_SAME_DEG = 1e-6


def mount_by_name(name: str) -> NamedMount:
    """Return a mount by its name: of `MOUNTS`, or a direction with an elevation of any size, ``left-up-22.5``.

    Raises ConfigError, which continues "mount.preset", if there is none of that name.
    """
    if name in MOUNTS:
        return MOUNTS[name]
    parts = re.fullmatch(rf"({'|'.join(_YAW_DEG)})-(up|down)-(\d+(?:\.\d+)?)", name)
    if parts is not None and 0 < float(parts[3]) < 90:
        side, sense, angle = parts[1], parts[2], float(parts[3])
        return NamedMount(_YAW_DEG[side], angle if sense == "up" else -angle, 0, f"{side}, {angle:g} deg {sense}", "")
    near = nearest_word(name, MOUNTS)
    suggestion = f" (did you mean {near}?)" if near else ""
    raise ConfigError(
        f"{name!r} is no mount{suggestion}; mounts are {', '.join(MOUNTS)}, and forward, right, left or back with -up-"
        " or -down- and an angle of 0 to 90 deg"
    )


def mount_label(mount: Mount) -> str:
    """Return what messages call a mount: ``zenith mount``, or its angles."""
    if mount.reading == "body":
        for name, known in MOUNTS.items():
            named = Mount(radians(known.roll_deg), radians(known.pitch_deg), radians(known.yaw_deg))
            if np.allclose(mount.C_camera_body, named.C_camera_body, rtol=0, atol=radians(_SAME_DEG)):
                return f"{name} mount"
        for side, yaw_deg in _YAW_DEG.items():
            pitch_deg = degrees(mount.pitch_rad)
            named = Mount(0.0, mount.pitch_rad, radians(yaw_deg))
            if np.allclose(mount.C_camera_body, named.C_camera_body, rtol=0, atol=radians(_SAME_DEG)):
                return f"{side}-{'up' if pitch_deg > 0 else 'down'}-{abs(pitch_deg):g} mount"
    angles = ", ".join(
        f"{axis} {degrees(angle):.4g}"
        for axis, angle in (("yaw", mount.yaw_rad), ("pitch", mount.pitch_rad), ("roll", mount.roll_rad))
    )
    return f"mount of {angles} deg"
