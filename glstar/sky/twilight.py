"""Names of the light of day and night, by the altitude of the Sun."""

from math import inf, radians
from typing import Final

__all__ = ["LIGHT_LEVELS", "light_name"]

# Names of the light, brightest first, and the altitudes of the Sun's centre, rad, above which each begins: by day with
# the Sun's radius and the refraction at the horizon.
LIGHT_LEVELS: Final = (
    ("day", radians(-0.833)),
    ("civil twilight", radians(-6.0)),
    ("nautical twilight", radians(-12.0)),
    ("astronomical twilight", radians(-18.0)),
    ("night", -inf),
)


def light_name(sun_altitude_rad: float) -> str:
    """Return the name of the light.

    Parameters
    ----------
    sun_altitude_rad : float
        Altitude of the Sun's centre without refraction, rad.

    Returns
    -------
    str
        ``"day"``, ``"night"``, or which twilight.
    """
    return next(name for name, least_rad in LIGHT_LEVELS if sun_altitude_rad > least_rad)
