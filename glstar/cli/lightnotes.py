"""Notes of ``glstar export`` on the light: frames by day or of the ground, and what a natural sky shows."""

from math import asin, degrees
from typing import TYPE_CHECKING, Final

import numpy as np

from glstar.render.viewingconditions import conditions_report
from glstar.sky.observed import sun_altitude_rad

if TYPE_CHECKING:
    from glstar.export.frames import Frames, Shot

__all__ = ["light_notes"]

# Frames that are checked, evenly over an export.
_CHECKED: Final = 24
# With the Sun higher than this, deg, the sky hides all but the brightest stars: the end of civil twilight.
_DAY_DEG: Final = -6.0


def light_notes(frames: "Frames") -> list[str]:
    """Return notes on day, a camera that sees only the ground, the light of a natural sky, and old satellites.

    Parameters
    ----------
    frames : Frames

    Returns
    -------
    list of str
        Empty for frames of a night sky of uniform brightness.
    """
    if not len(frames.numbers):
        return []
    numbers = frames.numbers[np.unique(np.linspace(0, len(frames.numbers) - 1, _CHECKED).astype(np.intp))]
    checked = [_checked(frames.shot(int(number))) for number in numbers]
    grounded = sum(sees_ground for sees_ground, _ in checked)
    notes = []
    if grounded:
        notes.append(
            f"{_count(grounded, len(checked))} show only the ground, because the camera points below the horizon:"
            " [mount] says how it is mounted"
        )
    sun_deg = [sun for _, sun in checked]
    by_day = sum(sun > _DAY_DEG for sun in sun_deg)
    if by_day:
        notes.append(
            f"{_count(by_day, len(checked))} are of day or bright twilight, with the Sun up to {max(sun_deg):.0f} deg"
            ' high: a camera sees no stars then; [sky] brightness = "natural" shows it'
        )
    return [*notes, *_natural_conditions(frames), *_old_elements(frames)]


def _old_elements(frames: "Frames") -> list[str]:
    """Return a note on satellites whose elements do not describe the middle frame."""
    shot = frames.shot(int(frames.numbers[len(frames.numbers) // 2]))
    satellites = shot.simulator.sky.satellites
    note = "" if satellites is None else satellites.age_note(shot.exposure.mid_utc_s)
    return [note] if note else []


def _natural_conditions(frames: "Frames") -> list[str]:
    """Return what the middle frame is taken under, where its sky is natural."""
    shot = frames.shot(int(frames.numbers[len(frames.numbers) // 2]))
    if shot.simulator.sensor.effects.get("sky.brightness") != "natural":
        return []
    return [f"the middle frame: {conditions_report(shot.simulator.scene(shot.exposure))}"]


def _count(some: int, checked: int) -> str:
    return "all frames" if some == checked else f"{some} of {checked} frames checked"


def _checked(shot: "Shot") -> tuple[bool, float]:
    """Return whether a frame shows only the ground, and the altitude of the Sun, deg."""
    simulator, mid_s = shot.simulator, shot.exposure.mid_utc_s
    (samples,) = simulator.motion.at(np.array([mid_s]))
    altitude_rad = asin(float(np.clip(samples.pointing.boresight_eq[0] @ samples.pointing.zenith_eq[0], -1, 1)))
    highest_rad = altitude_rad + simulator.camera.field_radius_rad
    return highest_rad < asin(samples.pointing.sine_horizon), degrees(sun_altitude_rad(mid_s, samples.site))
