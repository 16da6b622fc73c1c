"""``glstar sky``: a table of the stars, or of the Sun, the Moon and the planets, above a site."""

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

from glstar.cli.bodytable import BODY_COLUMNS, body_rows, body_table
from glstar.cli.flightoptions import echo_catalogue_note
from glstar.cli.satellitetable import SATELLITE_COLUMNS, satellite_rows, satellite_table
from glstar.errors import ConfigError
from glstar.sky.apparent import ASTROMETRY
from glstar.sky.catalogue import StarCatalogue, star_label
from glstar.sky.earthorientation import described_earth_orientation
from glstar.sky.observed import ObservedPlaces, Sky
from glstar.sky.satellites import Satellites
from glstar.sky.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site
from glstar.sky.timescale import format_utc, parse_known_utc

__all__ = ["sky"]


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
