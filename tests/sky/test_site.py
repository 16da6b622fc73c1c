"""Places of observation and their air."""

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ConfigError
from glstar.sky.air.refraction import refraction_scale
from glstar.sky.place.site import Site

DEG = np.pi / 180


def test_a_site_is_at_height_0_in_standard_air_by_default() -> None:
    site = Site(-34.93 * DEG, 138.60 * DEG)

    assert (site.height_m, site.pressure_hpa, site.temperature_c) == (0.0, 1010.0, 10.0)


def test_standard_air_is_the_air_of_eqs_25_and_27() -> None:
    site = Site(0.0, 0.0)

    assert refraction_scale(site.pressure_hpa, site.temperature_c) == 1.0


@pytest.mark.parametrize("latitude_deg", [-90.0, 90.0])
def test_the_poles_are_valid_sites(latitude_deg: float) -> None:
    assert Site(latitude_deg * DEG, 0.0).latitude_rad == latitude_deg * DEG


@pytest.mark.parametrize("longitude_deg", [-180.0, 180.0, 221.4, 360.0])
def test_longitudes_may_be_given_up_to_180_or_360_degrees(longitude_deg: float) -> None:
    assert Site(0.0, longitude_deg * DEG).longitude_rad == longitude_deg * DEG


@pytest.mark.parametrize("latitude_deg", [-90.001, 91.0, 138.6])
def test_a_latitude_beyond_the_pole_is_refused_in_degrees(latitude_deg: float) -> None:
    with pytest.raises(ConfigError, match=f"latitude {latitude_deg:.6f} deg lies beyond the pole; .* -90 to 90"):
        Site(latitude_deg * DEG, 0.0)


def test_degrees_instead_of_radians_are_refused() -> None:
    with pytest.raises(ConfigError, match="beyond the pole"):
        Site(-34.93, 138.60)
    with pytest.raises(ConfigError, match="more than a turn"):
        Site(-34.93 * DEG, 138.60)


@pytest.mark.parametrize("longitude_deg", [-360.1, 400.0])
def test_a_longitude_of_more_than_a_turn_is_refused(longitude_deg: float) -> None:
    with pytest.raises(ConfigError, match=r"is more than a turn; it runs from -180 to 180, or 0 to 360"):
        Site(0.0, longitude_deg * DEG)


def test_a_negative_pressure_is_refused_and_zero_means_no_air() -> None:
    with pytest.raises(ConfigError, match=r"-1\.0 hPa is negative; give the station pressure, or 0 for no air"):
        Site(0.0, 0.0, pressure_hpa=-1.0)
    assert Site(0.0, 0.0, pressure_hpa=0.0).pressure_hpa == 0.0


@pytest.mark.parametrize("temperature_c", [-273.0, -300.0])
def test_a_temperature_below_absolute_zero_is_refused(temperature_c: float) -> None:
    # 273, as eq. (28) has it, so that its denominator never vanishes.
    with pytest.raises(ConfigError, match="below absolute zero"):
        Site(0.0, 0.0, temperature_c=temperature_c)


@pytest.mark.parametrize("key", ["latitude_rad", "longitude_rad", "height_m", "pressure_hpa", "temperature_c"])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_a_site_needs_finite_numbers(key: str, number: float) -> None:
    with pytest.raises(ConfigError, match="finite numbers"):
        Site(**{"latitude_rad": 0.0, "longitude_rad": 0.0} | {key: number})


@pytest.mark.parametrize(
    ("key", "limits"), [("height_m", (-1000, 1e5)), ("pressure_hpa", (0, 1200)), ("temperature_c", (-120, 100))]
)
def test_air_and_height_have_the_limits_of_the_config(key: str, limits: tuple[float, float]) -> None:
    for number in limits:
        assert getattr(Site(0.0, 0.0, **{key: number}), key) == number
        beyond = np.nextafter(number, number * 2 if number else -1.0)
        with pytest.raises(ConfigError):
            Site(0.0, 0.0, **{key: float(beyond)})
        dotted = f"{'flight' if key == 'height_m' else 'air'}.{key}"
        place = {"flight.latitude_deg": 0.0, "flight.longitude_deg": 0.0}
        Config().override(**place, **{dotted: float(number)})
        with pytest.raises(ConfigError, match=key):
            Config().override(**place, **{dotted: float(beyond)})
