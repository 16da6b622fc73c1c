"""When stars and bodies rise and set."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from glstar.arrays import Float
from glstar.sky.air.refraction import refraction_rad
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site

# Altitudes are sampled at this interval for a day and an hour, s: the Moon rises 50 min later every day.
_STEP_S = 600.0
_SPAN_S = 25 * 3600.0
# Bisections of a step: to 0.01 s.
_BISECTIONS = 16


class RiseAndSet(NamedTuple):
    """The next time above, and the next time below the horizon, UTC seconds since 1970; None within a day without."""

    rise_utc_s: float | None
    set_utc_s: float | None
    is_up: bool  # Whether it is above the horizon now


def star_rise_and_set(sky: Sky, direction_eq: Float, utc_s: float, site: Site) -> RiseAndSet:
    """Return when a star rises and sets next.

    `sky`: its frames and its refraction are used; `direction_eq` (3,): apparent unit vector, true equator and equinox
    of date; `utc_s`: UTC seconds since 1970.  The horizon is the horizontal; with refraction a star rises 34' below it.
    """
    scale = sky.refraction_scale(site)

    def altitude_rad(times_s: Float) -> Float:
        ned = sky.C_ned_eq(times_s, site.latitude_rad, site.longitude_rad) @ direction_eq
        altitude = np.arcsin(np.clip(-ned[..., 2], -1, 1))
        return np.asarray(altitude + refraction_rad(altitude, scale))

    return _crossings(altitude_rad, utc_s)


def body_rise_and_set(sky: Sky, name: str, utc_s: float, site: Site) -> RiseAndSet:
    """Return when the upper limb of the Sun, the Moon or a planet rises and sets next.

    `sky`: its frames and its refraction are used; `name`: of `glstar.sky.observed.solarsystem.BODIES`; `utc_s`: UTC
    seconds since 1970.  The horizon is the horizontal.
    """

    def altitude_rad(times_s: Float) -> Float:
        bodies = [observed_bodies(sky, float(each), site, (name,))[0] for each in times_s]
        return np.array([body.apparent_altitude_rad + body.angular_radius_rad for body in bodies])

    return _crossings(altitude_rad, utc_s)


def _crossings(altitude_rad: Callable[[Float], Float], utc_s: float) -> RiseAndSet:
    """Return when an altitude, (n,) rad at (n,) times, changes its sign next after a time."""
    times_s = utc_s + np.arange(0.0, _SPAN_S, _STEP_S)
    is_up = altitude_rad(times_s) > 0
    changes = np.flatnonzero(is_up[1:] != is_up[:-1])
    found: dict[bool, float] = {}
    for index in changes[::-1].tolist():  # the first of each kind stays
        rises = not is_up[index]
        low_s, high_s = times_s[index], times_s[index + 1]
        for _ in range(_BISECTIONS):
            middle_s = (low_s + high_s) / 2
            if (altitude_rad(np.array([middle_s]))[0] > 0) == rises:
                high_s = middle_s
            else:
                low_s = middle_s
        found[bool(rises)] = float(high_s)
    return RiseAndSet(found.get(True), found.get(False), bool(is_up[0]))
