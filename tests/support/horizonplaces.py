"""What ``glstar sky`` lists at random times and sites, against Skyfield and ERFA."""

import json
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import erfa
import numpy as np
import skyfield_data
from skyfield.api import EarthSatellite, Loader, wgs84
from typer.testing import CliRunner

from glstar.cli import app
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.timescale import format_utc, parse_utc, tt_julian_date
from tests.support.satellites import HIGHER, PASS, elements, with_checksum

ARCSEC_RAD = np.pi / 648000
# What `glstar manual accuracy` and `glstar manual sky` claim, arcsec: azimuth and altitude, right ascension and
# declination.
CLAIMS_ARCSEC = {
    ("stars", "paper"): (0.23, 0.40),
    ("stars", "erfa"): (0.001, 0.001),
    ("bodies", "paper"): (0.6, 0.8),
    ("bodies", "erfa"): (0.4, 0.4),
    ("satellites", "paper"): (0.05, np.nan),
    ("satellites", "erfa"): (0.05, np.nan),
}
_FIRST_S, _LAST_S = parse_utc("2000-01-01"), parse_utc("2036-01-01")
_STARS = 12
_BARYCENTRES = ("Jupiter", "Saturn", "Uranus", "Neptune")
# The paper's formulae are not compared nearer to a celestial pole, or to the Sun, whose light deflection they lack.
_POLE_DEC_RAD, _SUN_RAD = np.deg2rad(89.0), np.deg2rad(10.0)


class Listed(NamedTuple):
    """A row of ``glstar sky`` beside its authority."""

    kind: str
    astrometry: str
    name: str
    row: dict[str, Any]
    horizon_arcsec: float  # distance of azimuth and altitude from the authority's
    equator_arcsec: float  # that of right ascension and declination; NaN if there are none

    @property
    def excess(self) -> float:
        """The larger distance divided by its claim: 1 or less is as claimed."""
        claims = CLAIMS_ARCSEC[self.kind, self.astrometry]
        return float(np.nanmax(np.divide((self.horizon_arcsec, self.equator_arcsec), claims)))


class _View(NamedTuple):
    utc_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    dut1_s: float
    astrometry: str

    @property
    def radians(self) -> tuple[float, float, float]:
        """Longitude, latitude, rad, and height, m, in ERFA's order."""
        return float(np.deg2rad(self.longitude_deg)), float(np.deg2rad(self.latitude_deg)), self.height_m

    def listed(self, *words: str) -> list[dict[str, Any]]:
        """Return what ``glstar sky`` lists, in JSON."""
        where = f"sky --lat {self.latitude_deg!r} --lon {self.longitude_deg!r} --height {self.height_m!r} --pressure 0"
        when = f"--utc {format_utc(self.utc_s)} --dut1 {self.dut1_s!r} --astrometry {self.astrometry} --all --json"
        result = CliRunner().invoke(app, [*where.split(), *when.split(), *words])
        assert result.exit_code == 0, result.output
        return list(json.loads(result.stdout))


def listed_beside_authorities(seed: int, folder: Path) -> Iterator[Listed]:
    """Yield stars, bodies and satellites at one random time and site from 2000 to 2035, on the ground or in the air.

    Stars are compared with ERFA, bodies with Skyfield and DE421, satellites with Skyfield's observation of the same
    elements, with light time and aberration; all without air, with Skyfield's UT1 and the pole fixed.
    """
    random = np.random.default_rng(seed)
    utc_s = round(float(random.uniform(_FIRST_S, _LAST_S)), 6)
    view = _View(
        utc_s,
        float(np.rad2deg(np.arcsin(random.uniform(-1, 1)))),
        float(random.uniform(-180, 180)),
        float(random.choice([0.0, random.uniform(0, 20_000)])),
        float(_time(utc_s).dut1),
        str(random.choice(["paper", "erfa"])),
    )
    yield from _stars(view, random)
    yield from _bodies(view)
    yield from _satellites(view, folder)


def _stars(view: _View, random: np.random.Generator) -> Iterator[Listed]:
    numbers = random.choice(StarCatalogue.open("bsc5").brighter_than(6.5).star_id, _STARS, replace=False)
    rows = view.listed(*(word for number in numbers for word in ("--star-id", str(number))))
    stars = StarCatalogue.open("bsc5").by_id([row["star_id"] for row in rows])
    pm_ra = stars.pm_ra_cosdec_rad_per_yr / np.cos(stars.dec_rad)
    day = np.floor(view.utc_s / 86400)
    utc = 2440587.5 + day, (view.utc_s - day * 86400) / 86400
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # leap seconds after the end of its table
        astrom, origins = erfa.apco13(*utc, view.dut1_s, *view.radians, *(0.0, 0.0, 0.0, 0.0, 0.0, 0.55))
        tt = erfa.taitt(*erfa.utctai(*utc))
    places = stars.ra_rad, stars.dec_rad, pm_ra, stars.pm_dec_rad_per_yr, 0.0, 0.0
    azimuth_rad, zenith_rad, *_ = erfa.atioq(*erfa.atciq(*places, astrom), astrom)
    ra_cirs, dec_rad, _ = erfa.atci13(*places, *tt)
    expected = zip(azimuth_rad, np.pi / 2 - zenith_rad, ra_cirs - origins, dec_rad, strict=True)
    from_sun_rad = erfa.sepp(-astrom["eh"], erfa.s2c(stars.ra_rad, stars.dec_rad))
    for row, angles, separation_rad in zip(rows, expected, from_sun_rad, strict=True):
        near = abs(angles[3]) > _POLE_DEC_RAD or separation_rad < _SUN_RAD
        if view.astrometry == "erfa" or not near:
            yield _beside("stars", view, f"HR {row['star_id']}", row, *angles)


def _bodies(view: _View) -> Iterator[Listed]:
    observer = (_ephemeris()["earth"] + _place(view)).at(_time(view.utc_s))
    for row in view.listed("--bodies"):
        name = row["name"]
        apparent = observer.observe(_ephemeris()[f"{name} barycenter" if name in _BARYCENTRES else name]).apparent()
        altitude, azimuth, _ = apparent.altaz()
        ra, dec, _ = apparent.radec("date")
        yield _beside("bodies", view, name, row, azimuth.radians, altitude.radians, ra.radians, dec.radians)


def _satellites(view: _View, folder: Path) -> Iterator[Listed]:
    # Elements of the time: those of 2024 would have left their orbits.
    epoch = datetime.fromtimestamp(view.utc_s, UTC)
    day = f"{epoch:%y%j}.{(epoch.hour * 60 + epoch.minute) / 1440 * 1e8:08.0f}"
    pairs = [(f"{first[:18]}{day}{first[32:]}", second) for first, second in (PASS, *HIGHER)]
    path = folder / "random.tle"
    path.write_text(elements(*pairs), encoding="utf-8")
    observer = (_ephemeris()["earth"] + _place(view)).at(_time(view.utc_s))
    rows = {row["satellite_number"]: row for row in view.listed("--satellites", str(path))}
    for number, pair in enumerate(pairs, 99001):
        satellite = EarthSatellite(*map(with_checksum, pair), "", _timescale())
        altitude, azimuth, _ = observer.observe(_ephemeris()["earth"] + satellite).apparent().altaz()
        yield _beside("satellites", view, str(number), rows[number], azimuth.radians, altitude.radians)


def _beside(kind: str, view: _View, name: str, row: dict[str, Any], *expected_rad: float) -> Listed:
    """Return a row with its distances from azimuth, altitude, right ascension and declination of an authority."""
    separations = [np.nan, np.nan]
    for which, keys in enumerate((("azimuth_deg", "altitude_deg"), ("ra_deg", "dec_deg"))[: len(expected_rad) // 2]):
        ours = np.deg2rad([row[key] for key in keys])
        theirs = expected_rad[2 * which : 2 * which + 2]
        separations[which] = float(erfa.seps(*ours, *theirs)) / ARCSEC_RAD
    return Listed(kind, view.astrometry, name, row, *separations)


def _place(view: _View) -> Any:
    return wgs84.latlon(view.latitude_deg, view.longitude_deg, elevation_m=view.height_m)


def _time(utc_s: float) -> Any:
    return _timescale().tt_jd(*tt_julian_date(utc_s))


@cache
def _timescale() -> Any:
    return _loader().timescale(builtin=True)


@cache
def _loader() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package's table of UT1, which is not read, has expired
        return Loader(skyfield_data.get_skyfield_data_path(), verbose=False)


@cache
def _ephemeris() -> Any:
    return _loader()("de421.bsp")
