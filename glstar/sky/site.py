"""Sites on the Earth and their air."""

from dataclasses import dataclass
from math import isfinite, pi
from typing import Final

from glstar.errors import ConfigError

__all__ = ["HEIGHTS_M", "PRESSURES_HPA", "STANDARD_PRESSURE_HPA", "STANDARD_TEMPERATURE_C", "TEMPERATURES_C", "Site"]

# The standard air of eqs (25) and (27).
STANDARD_PRESSURE_HPA = 1010.0
STANDARD_TEMPERATURE_C = 10.0

# Valid ranges: heights from below the Dead Sea to space, and the pressures and temperatures of the atmosphere.
HEIGHTS_M: Final = (-1000.0, 100_000.0)
PRESSURES_HPA: Final = (0.0, 1200.0)
TEMPERATURES_C: Final = (-120.0, 100.0)


@dataclass(frozen=True, slots=True)
class Site:
    """An observing site and its air.

    Attributes
    ----------
    latitude_rad, longitude_rad : float
        WGS84 geodetic latitude, and longitude positive eastward, rad.
    height_m : float
        Height above the WGS84 ellipsoid, m.
    pressure_hpa : float
        Pressure at the observer (not reduced to sea level), hPa; 0 means no refraction.
    temperature_c : float
        Air temperature at the observer, degrees Celsius.

    Raises
    ------
    ConfigError
        If a number is outside its limits, such as a latitude of more than 90 deg or a negative pressure.
    """

    latitude_rad: float
    longitude_rad: float
    height_m: float = 0.0
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    temperature_c: float = STANDARD_TEMPERATURE_C

    def __post_init__(self) -> None:
        numbers = (self.latitude_rad, self.longitude_rad, self.height_m, self.pressure_hpa, self.temperature_c)
        if not all(isfinite(number) for number in numbers):
            raise ConfigError(f"a site needs finite numbers, not {numbers}")
        if abs(self.latitude_rad) > pi / 2 + 1e-12:
            raise ConfigError(
                f"latitude {self.latitude_rad * 180 / pi:.6f} deg lies beyond the pole; it runs from -90 to 90"
            )
        if abs(self.longitude_rad) > 2 * pi + 1e-12:
            raise ConfigError(
                f"longitude {self.longitude_rad * 180 / pi:.6f} deg is more than a turn;"
                " it runs from -180 to 180, or 0 to 360"
            )
        if self.pressure_hpa < 0:
            raise ConfigError(
                f"a pressure of {self.pressure_hpa} hPa is negative; give the station pressure, or 0 for no air"
            )
        if self.temperature_c <= -273.0:
            raise ConfigError(f"an air temperature of {self.temperature_c} deg C is below absolute zero")
        limits = (
            (self.height_m, HEIGHTS_M, "a height", "m"),
            (self.pressure_hpa, PRESSURES_HPA, "a pressure", "hPa"),
            (self.temperature_c, TEMPERATURES_C, "an air temperature", "deg C"),
        )
        for number, (least, most), what, unit in limits:
            if not least <= number <= most:
                raise ConfigError(
                    f"{what} of {number:g} {unit} is not possible; it must be from {least:g} to {most:g} {unit}"
                )
