"""Observed places: the stars of a catalogue as seen from a site at a time."""

from dataclasses import dataclass
from functools import lru_cache
from math import sin

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.rotation import about_z
from glstar.sky.air.refraction import refraction_rad, refraction_scale
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.satellites import Satellites
from glstar.sky.place import horizon
from glstar.sky.place.apparent import ASTROMETRY, Astrometry, right_ascension_declination, sun_direction
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import EarthOrientation, earth_orientation

# Rotation rate of the Earth relative to the equinox, rad per second of UT1.
SIDEREAL_RAD_PER_S = 2 * np.pi * 1.00273790935 / 86400

# Distance of the bound of a horizon profile from its lowest point, rad.
_BELOW_PROFILE_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ObservedPlaces:
    """Observed places of stars at a site."""

    stars: StarField
    ra_rad: Float  # (n,) geocentric apparent right ascension of date
    dec_rad: Float  # (n,) geocentric apparent declination of date
    azimuth_rad: Float  # (n,) from north through east
    altitude_rad: Float  # (n,) without refraction
    apparent_altitude_rad: Float  # (n,) with refraction


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """The stars of a catalogue, and the model of their apparent and observed places.

    Attributes
    ----------
    catalogue : StarCatalogue
        The stars.
    astrometry : Astrometry
        The paper's formulae or ERFA.
    dut1_s : float or None
        UT1 - UTC, s, with a fixed pole.  None takes UT1 - UTC and polar motion from the IERS table of the package
        astropy-iers-data, after its end from its last day; without the package, UT1 = UTC.
    refraction : bool
        Whether atmospheric refraction is simulated.
    dip : bool
        Whether the horizon lies below the horizontal, as seen from a height.
    profile : HorizonProfile or None
        The horizon by azimuth; None for one of equal altitude all around.
    satellites : Satellites or None
        The satellites of a file of two-line elements.

    Raises
    ------
    ConfigError
        If UT1 - UTC is more than 1 s, because leap seconds keep it below 0.9 s.
    """

    catalogue: StarCatalogue
    astrometry: Astrometry = ASTROMETRY["paper"]
    dut1_s: float | None = 0.0
    refraction: bool = True
    dip: bool = False
    profile: horizon.HorizonProfile | None = None
    satellites: Satellites | None = None

    def __post_init__(self) -> None:
        if self.dut1_s is not None and not abs(self.dut1_s) <= 1:
            raise ConfigError(
                f"UT1 - UTC is {self.dut1_s} s; leap seconds keep it between -0.9 and 0.9", key="sky.dut1_s"
            )

    def star_field(self, utc_s: float) -> StarField:
        """Return the stars with their apparent directions at one time.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970.

        Returns
        -------
        StarField
        """
        stars = self.catalogue
        directions = self.astrometry.apparent_directions(
            stars.ra_rad,
            stars.dec_rad,
            stars.pm_ra_cosdec_rad_per_yr,
            stars.pm_dec_rad_per_yr,
            utc_s,
            parallax_rad=stars.parallax_rad,
            radial_velocity_m_per_s=stars.radial_velocity_m_per_s,
        )
        return StarField(
            catalogue=stars.catalogue,
            star_id=stars.star_id,
            name=tuple(stars.name),
            vmag=stars.vmag,
            direction_eq=directions,
            epoch_utc_s=utc_s,
            C_eq_icrs=self.astrometry.C_eq_icrs(utc_s),
            bv=stars.bv,
        )

    def C_ned_eq(self, utc_s: ArrayLike, latitude_rad: ArrayLike, longitude_rad: ArrayLike) -> Float:
        """Return the matrices from the true equator and equinox to north, east, down.

        Parameters
        ----------
        utc_s : (n,) array_like
            Times within minutes of each other, UTC seconds since 1970.
        latitude_rad, longitude_rad : (n,) array_like
            Geodetic latitudes and longitudes, rad; longitude is positive eastward.

        Returns
        -------
        (n, 3, 3) float64
        """
        times = np.asarray(utc_s, dtype=np.float64)
        first_s = float(times.flat[0])
        earth = self.earth(first_s)
        first_rad = _at_greenwich_rad(self.astrometry, first_s, earth.dut1_s)
        at_greenwich = first_rad + SIDEREAL_RAD_PER_S * (times - first_s)
        if earth.x_pole_rad == earth.y_pole_rad == 0:
            return horizon.C_ned_eq(latitude_rad, at_greenwich + np.asarray(longitude_rad, dtype=np.float64))
        return np.asarray(horizon.C_ned_eq(latitude_rad, longitude_rad) @ earth.polar_motion @ about_z(at_greenwich))

    def earth(self, utc_s: float) -> EarthOrientation:
        """Return the Earth orientation parameters at one time.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970.

        Returns
        -------
        EarthOrientation
        """
        if self.dut1_s is not None:
            return EarthOrientation(self.dut1_s)
        return earth_orientation(utc_s) or EarthOrientation()

    def refraction_scale(self, site: Site) -> float:
        """Return the ratio of the refractions of a site's air and of standard air; 0 without refraction.

        Parameters
        ----------
        site : Site

        Returns
        -------
        float
        """
        return refraction_scale(site.pressure_hpa, site.temperature_c) if self.refraction else 0.0

    def sine_horizon(self, height_m: float) -> float:
        """Return the sine of the apparent altitude of the horizon: 0, or below it with `dip`.

        Parameters
        ----------
        height_m : float
            Height above the sea, m.

        Returns
        -------
        float
            For a profile, the bound 1 deg below its lowest point.
        """
        if self.profile is not None:
            return sin(self.profile.lowest_rad - _BELOW_PROFILE_RAD)
        return -sin(horizon.dip_rad(height_m)) if self.dip else 0.0

    def observed_places(self, utc_s: float, site: Site) -> ObservedPlaces:
        """Return the observed places of the stars at a site.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970.
        site : Site

        Returns
        -------
        ObservedPlaces

        Notes
        -----
        Teague & Chahl, sections 2.1 and 2.2.  Departs from the paper: diurnal aberration is added.
        """
        stars = self.star_field(utc_s)
        ra_rad, dec_rad = right_ascension_declination(stars.direction_eq)
        C = self.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0]
        seen_ned = horizon.with_diurnal_aberration(stars.direction_eq @ C.T, site.latitude_rad, site.height_m)
        azimuth_rad, altitude_rad = horizon.ned_to_azimuth_altitude_rad(seen_ned)
        refracted_rad = altitude_rad + refraction_rad(altitude_rad, self.refraction_scale(site))
        return ObservedPlaces(stars, ra_rad, dec_rad, azimuth_rad, altitude_rad, refracted_rad)


# Cached, because a scene needs the sidereal time at the start of its exposure several times.
@lru_cache(maxsize=16)
def _at_greenwich_rad(astrometry: Astrometry, utc_s: float, dut1_s: float) -> float:
    return astrometry.sidereal_time_rad(utc_s, dut1_s)


def sun_altitude_rad(utc_s: float, site: Site) -> float:
    """Return the altitude of the Sun, rad, without refraction; `utc_s`: UTC seconds since 1970."""
    sidereal_rad = ASTROMETRY["erfa"].sidereal_time_rad(utc_s, 0.0)
    _, altitude_rad = horizon.ned_to_azimuth_altitude_rad(
        horizon.C_ned_eq(site.latitude_rad, sidereal_rad + site.longitude_rad) @ sun_direction(utc_s)
    )
    return float(altitude_rad)
