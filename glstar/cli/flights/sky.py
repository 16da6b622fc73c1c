"""``glstar sky``: a table of the stars, or of the Sun, the Moon and the planets, above a site.

The table of the Sun, the Moon and the planets of ``glstar sky --bodies``.

The table of satellites of ``glstar sky --satellites``.
"""

import csv
import io
import json
import sys
import time
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from glstar.cli.flightoptions import echo_catalogue_note
from glstar.errors import ConfigError
from glstar.sky.catalogue.reading import StarCatalogue, star_label
from glstar.sky.observed.satellites import Satellites, visible_vmag
from glstar.sky.observed.solarsystem import Body, is_corrected, observed_bodies
from glstar.sky.observed.stars import ObservedPlaces, Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.place.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site
from glstar.sky.place.timescale import described_earth_orientation, format_utc, parse_known_utc, tt_julian_date

# The columns, with their decimals in a table.
_BODY_DECIMALS: Final = {
    "azimuth_deg": 5,
    "altitude_deg": 5,
    "apparent_altitude_deg": 5,
    "ra_deg": 5,
    "dec_deg": 5,
    "distance_km": 0,
    "diameter_arcsec": 2,
    "phase_angle_deg": 2,
    "illuminated_fraction": 4,
    "bright_limb_deg": 2,
    "vmag": 2,
}
BODY_COLUMNS: Final = ("name", *_BODY_DECIMALS)
# Decimals of numbers in CSV and JSON: the last one of an angle is 0.00004".
_BODY_DIGITS: Final = 8

BodyRow = dict[str, Any]


def body_rows(sky: Sky, utc_s: float, site: Site) -> list[BodyRow]:
    """Return the bodies as rows, ready for CSV and JSON.

    `utc_s`: UTC seconds since 1970.  Returns: with the keys `BODY_COLUMNS`: every body, also below the horizon.
    """
    return [_row(body) for body in observed_bodies(sky, utc_s, site)]


def _row(body: Body) -> BodyRow:
    angles_rad = (body.azimuth_rad, body.altitude_rad, body.apparent_altitude_rad, *body.ra_dec_rad)
    numbers: dict[str, float | None] = {
        **dict(zip(BODY_COLUMNS[1:6], np.rad2deg(angles_rad).tolist(), strict=True)),
        "distance_km": body.distance_km,
        "diameter_arcsec": float(np.rad2deg(2 * body.angular_radius_rad)) * 3600,
        "phase_angle_deg": float(np.rad2deg(body.phase_angle_rad)),
        "illuminated_fraction": body.illuminated_fraction,
        "bright_limb_deg": None if body.bright_limb_rad is None else float(np.rad2deg(body.bright_limb_rad)),
        "vmag": body.vmag,
    }
    return {"name": body.name} | {
        key: None if number is None else round(number, _BODY_DIGITS) for key, number in numbers.items()
    }


def body_table(rows: Sequence[BodyRow], title: str, ut1: str, utc_s: float) -> Table:
    """Return the rows as a table for a terminal.

    `rows`: the result of `body_rows`; `ut1`: what UT1 - UTC is; `utc_s`: UTC seconds since 1970.
    """
    accuracy = "within 1 arcsec of DE421" if is_corrected(tt_julian_date(utc_s)) else "within 90 arcsec (not 1990-2050)"
    sun, moon = rows[0], rows[1]
    light = f"the Sun at {sun['altitude_deg']:.1f} deg, the Moon {moon['illuminated_fraction']:.0%} lit"
    table = Table(title=title, caption=f"{light}; topocentric apparent place of date, {accuracy}; {ut1}")
    for column in BODY_COLUMNS:
        header = column.replace("apparent_altitude_deg", "apparent_alt").replace("illuminated_fraction", "lit")
        table.add_column(header, justify="left" if column == "name" else "right", no_wrap=True)
    for row in rows:
        cells = ("" if row[key] is None else f"{row[key]:.{decimals}f}" for key, decimals in _BODY_DECIMALS.items())
        table.add_row(row["name"], *cells)
    return table


# The columns, with their decimals in a table.
_SATELLITE_DECIMALS: Final = {"azimuth_deg": 4, "altitude_deg": 4, "range_km": 1, "vmag": 1, "lit": 2}
SATELLITE_COLUMNS: Final = ("name", "satellite_number", *_SATELLITE_DECIMALS)
# Decimals of numbers in CSV and JSON.
_SATELLITE_DIGITS: Final = 8

SatelliteRow = dict[str, Any]


def satellite_rows(
    satellites: Satellites, sky: Sky, utc_s: float, site: Site, *, everything: bool
) -> list[SatelliteRow]:
    """Return satellites as rows, the highest first, ready for CSV and JSON.

    `utc_s`: UTC seconds since 1970; `everything`: whether those below the horizon are listed too.  Returns: with the
    keys `SATELLITE_COLUMNS`; ``vmag`` is that in sunlight, ``lit`` the part of the Sun that it sees.
    """
    (sun,) = observed_bodies(sky, utc_s, site, ("Sun",))
    C_ned_eq = sky.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0]
    rows = []
    for one in satellites.satellites:
        seen = one.seen(sky, np.array([utc_s]), site.latitude_rad, site.longitude_rad, site.height_m)
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(C_ned_eq @ seen.direction_eq[0])
        if not (np.isfinite(altitude_rad) and (everything or altitude_rad > 0)):
            continue
        vmag, lit = visible_vmag(one, seen, sun.direction_eq)
        numbers = (np.rad2deg(azimuth_rad), np.rad2deg(altitude_rad), seen.range_km[0], vmag[0], lit[0])
        named = {"name": one.name, "satellite_number": one.number}
        rows.append(
            named
            | {key: round(float(n), _SATELLITE_DIGITS) for key, n in zip(_SATELLITE_DECIMALS, numbers, strict=True)}
        )
    return sorted(rows, key=lambda row: -row["altitude_deg"])


def satellite_table(rows: list[SatelliteRow], title: str, note: str) -> Table:
    """Return the rows as a table for a terminal.

    `rows`: the result of `satellite_rows`; `note`: about the age of the elements; may be empty.
    """
    caption = "topocentric, with light time, without refraction; lit: the part of the Sun that it sees"
    table = Table(title=title, caption=f"{caption}; {note}" if note else caption)
    for column in SATELLITE_COLUMNS:
        table.add_column(column, justify="left" if column == "name" else "right", no_wrap=True)
    for row in rows:
        cells = (f"{row[key]:.{decimals}f}" for key, decimals in _SATELLITE_DECIMALS.items())
        table.add_row(row["name"], str(row["satellite_number"]), *cells)
    return table


class _Astrometry(StrEnum):
    paper = "paper"
    erfa = "erfa"


class _Format(StrEnum):
    table = "table"
    csv = "csv"
    json = "json"


_ANGLES: Final = ("ra_deg", "dec_deg", "azimuth_deg", "altitude_deg", "apparent_altitude_deg")
_COLUMNS: Final = ("catalogue", "star_id", "name", "vmag", *_ANGLES)
# Decimals of an angle in degrees: the last one is 0.00004".
_DIGITS: Final = 8
# Width of a table that is written to a pipe, characters.
_PIPE_WIDTH: Final = 180

Row = dict[str, Any]


def sky(
    lat: Annotated[float, typer.Option(help="Latitude, degrees, north positive.", show_default=False)],
    lon: Annotated[float, typer.Option(help="Longitude, degrees, east positive.", show_default=False)],
    utc: Annotated[str, typer.Option(help="Time, ISO 8601: 2024-03-10T11:00:00Z.", show_default="now")] = "",
    height: Annotated[float, typer.Option(help="Height above the ellipsoid, m.")] = 0.0,
    pressure: Annotated[
        float, typer.Option(help="Air pressure at the observer, hPa; 0 for no refraction.")
    ] = STANDARD_PRESSURE_HPA,
    temperature: Annotated[float, typer.Option(help="Air temperature, degrees Celsius.")] = STANDARD_TEMPERATURE_C,
    vmag: Annotated[float, typer.Option(help="The faintest magnitude to show.")] = 6.5,
    star_id: Annotated[
        list[int] | None,
        typer.Option(
            "--star-id", "--hr", help="Only this star, by its HR or HIP number; may be repeated.", show_default=False
        ),
    ] = None,
    catalogue: Annotated[str, typer.Option(help="bsc5, hipparcos, or the path of a catalogue file.")] = "bsc5",
    astrometry: Annotated[
        _Astrometry, typer.Option(help="The paper's formulae, corrected, or ERFA.")
    ] = _Astrometry.paper,
    dut1: Annotated[
        float | None,
        typer.Option(help="UT1 - UTC, s.", show_default="the IERS's table, if astropy-iers-data is installed; else 0"),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also stars below the horizon.")] = False,
    bodies: Annotated[
        bool, typer.Option("--bodies", help="The Sun, the Moon and the planets instead of stars, wherever they are.")
    ] = False,
    satellites: Annotated[
        Path | None,
        typer.Option(help="A file of two-line elements: its satellites instead of stars.", show_default=False),
    ] = None,
    satellite_mag: Annotated[float, typer.Option(help="V of a satellite 1000 km away, half lit.")] = 4.5,
    format_: Annotated[_Format, typer.Option("--format", help="The output format.")] = _Format.table,
    as_json: Annotated[bool, typer.Option("--json", help="As --format json.")] = False,
) -> None:
    """List the stars above a site, the Sun, Moon and planets, or satellites: apparent place, azimuth, altitude.

    Try: glstar sky --lat -34.93 --lon 138.60 --vmag 2
    """
    if not np.isfinite(vmag):
        raise ConfigError(f"--vmag {vmag} is no magnitude; 6.5 is the faintest that an eye sees")
    if satellites is not None and bodies:
        raise typer.BadParameter("and --bodies list different things; leave one out", param_hint="--satellites")
    utc_s = parse_known_utc(utc) if utc else time.time()
    site = Site(float(np.deg2rad(lat)), float(np.deg2rad(lon)), height, pressure, temperature)
    stars = StarCatalogue.open(catalogue)
    echo_catalogue_note(catalogue)
    chosen = stars.by_id(star_id) if star_id else stars.brighter_than(vmag)
    of_date = Sky(chosen, ASTROMETRY[astrometry.value], dut1)
    if satellites is not None:
        known = Satellites.open(satellites, satellite_mag)
        listing = _of_satellites(known, of_date, utc_s, site, everything=everything)
    elif bodies:
        listing = _of_bodies(of_date, utc_s, site)
    else:
        listing = _of_stars(of_date, utc_s, site, vmag, everything=everything)
    title = f"The sky over {lat:g}, {lon:g} at {format_utc(utc_s)}"
    _print(listing, _format_of(format_, as_json=as_json), title, _ut1_label(dut1, utc_s))


class _Listing(NamedTuple):
    """What is printed: rows, their columns, a function of title and UT1 to a table, and why there are no rows."""

    rows: list[Row]
    columns: Sequence[str]
    table: Callable[[str, str], Table]
    why_none: str


def _of_stars(sky: Sky, utc_s: float, site: Site, vmag: float, *, everything: bool) -> _Listing:
    rows = _rows(sky.observed_places(utc_s, site), everything=everything)
    return _Listing(rows, _COLUMNS, partial(_star_table, rows), _why_none(len(sky.catalogue), vmag))


def _of_bodies(sky: Sky, utc_s: float, site: Site) -> _Listing:
    rows = body_rows(sky, utc_s, site)
    return _Listing(rows, BODY_COLUMNS, lambda title, ut1: body_table(rows, title, ut1, utc_s), "")


def _of_satellites(known: Satellites, sky: Sky, utc_s: float, site: Site, *, everything: bool) -> _Listing:
    rows = satellite_rows(known, sky, utc_s, site, everything=everything)
    none_up = "no satellite is above the horizon; --all shows them too"
    note = known.age_note(utc_s)
    return _Listing(rows, SATELLITE_COLUMNS, lambda title, ut1: satellite_table(rows, title, note or ut1), none_up)


def _print(listing: _Listing, format_: _Format, title: str, ut1: str) -> None:
    if format_ is _Format.json:
        json.dump(listing.rows, sys.stdout, ensure_ascii=False, indent=1)
        typer.echo()
    elif format_ is _Format.csv:
        typer.echo(_csv(listing.rows, listing.columns), nl=False)
    else:
        # A pipe has no width: use one that is wide enough for all columns.
        Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH).print(listing.table(title, ut1))
    if not listing.rows:
        typer.echo(f"glstar: {listing.why_none}", err=True)


def _format_of(format_: _Format, *, as_json: bool) -> _Format:
    if as_json and format_ is _Format.csv:
        raise typer.BadParameter("and --format csv contradict each other; leave one out", param_hint="--json")
    return _Format.json if as_json else format_


def _why_none(count: int, vmag: float) -> str:
    if count == 0:
        return f"the catalogue has no star as bright as magnitude {vmag:g}"
    below = "the star is" if count == 1 else f"all {count} stars are"
    return f"{below} below the horizon; --all shows them too"


def _rows(places: ObservedPlaces, *, everything: bool) -> list[Row]:
    shown = np.flatnonzero(everything | (places.apparent_altitude_rad >= 0))
    stars = places.stars
    angles_rad = (
        places.ra_rad,
        places.dec_rad,
        places.azimuth_rad,
        places.altitude_rad,
        places.apparent_altitude_rad,
    )
    angles_deg = np.round(np.rad2deg(angles_rad), _DIGITS)
    return [
        {
            "catalogue": stars.catalogue,
            "star_id": int(stars.star_id[k]),
            "name": stars.name[k],
            "vmag": float(stars.vmag[k]),
        }
        | dict(zip(_ANGLES, angles_deg[:, k].tolist(), strict=True))
        for k in shown
    ]


def _csv(rows: list[Row], columns: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    angles = [angle for angle in _ANGLES if angle in columns]
    writer.writerows(row | {angle: f"{row[angle]:.{_DIGITS}f}" for angle in angles} for row in rows)
    return text.getvalue()


def _ut1_label(dut1_s: float | None, utc_s: float) -> str:
    """Return the UT1 - UTC of the table, and its source."""
    if dut1_s is not None:
        return f"UT1 - UTC = {dut1_s:+.4f} s as given by --dut1"
    table = described_earth_orientation(utc_s).get("earth_orientation")
    if table is None:
        return "UT1 = UTC assumed (astropy-iers-data is not installed)"
    if "covers" in table:
        return f"UT1 = UTC assumed ({table['source']} covers {table['covers']} only)"
    return f"UT1 - UTC = {table['dut1_s']:+.4f} s by {table['source']}"


def _star_table(rows: list[Row], title: str, ut1: str) -> Table:
    table = Table(title=title, caption=f"{len(rows)} stars; apparent place of date, degrees; {ut1}")
    for column in ("star", *_COLUMNS[2:]):
        table.add_column(column, justify="left" if column == "name" else "right", no_wrap=True)
    for row in rows:
        label = star_label(row["catalogue"], row["star_id"])
        table.add_row(label, row["name"], f"{row['vmag']:.2f}", *(f"{row[angle]:.5f}" for angle in _ANGLES))
    return table
