"""``glstar sky``: a table of the stars above a site, of the Sun, the Moon and the planets, or of satellites."""

import csv
import io
import json
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.table import Table

from glstar.cli.reporting import echo_note
from glstar.cli.tables import print_table
from glstar.errors import ConfigError
from glstar.sky.catalogue.reading import StarCatalogue, star_label
from glstar.sky.observed.satellites import Satellites, visible_vmag
from glstar.sky.observed.solarsystem import Body, is_corrected, observed_bodies
from glstar.sky.observed.stars import ObservedPlaces, Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad, with_diurnal_aberration
from glstar.sky.place.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site
from glstar.sky.place.timescale import (
    described_earth_orientation,
    earth_orientation_note,
    format_utc,
    parse_known_utc,
    tt_julian_date,
)

# Columns of the Sun, the Moon and the planets, with their decimals in a table.
_BODY_DECIMALS = {
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
# Columns of satellites, with their decimals in a table.
_SATELLITE_DECIMALS = {"azimuth_deg": 4, "altitude_deg": 4, "range_km": 1, "vmag": 1, "lit": 2}
_ANGLES = ("ra_deg", "dec_deg", "azimuth_deg", "altitude_deg", "apparent_altitude_deg")
_COLUMNS = ("catalogue", "star_id", "name", "vmag", *_ANGLES)
# Decimals of numbers in CSV and JSON: the last one of an angle in degrees is 0.00004".
_DIGITS = 8
# Width of a table that is written to a pipe, characters.
_PIPE_WIDTH = 180

_Row = dict[str, Any]


class _Astrometry(StrEnum):
    paper = "paper"
    erfa = "erfa"


class _Format(StrEnum):
    table = "table"
    csv = "csv"
    json = "json"


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
        typer.Option("--star-id", help="Only this star, by its HR or HIP number; may be repeated.", show_default=False),
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
    chosen = stars.by_id(star_id) if star_id else stars.brighter_than(vmag)
    of_date = Sky(chosen, ASTROMETRY[astrometry.value], dut1)
    if satellites is not None:
        elements = Satellites.open(satellites, satellite_mag)
        listing = _of_satellites(elements, of_date, utc_s, site, everything=everything)
    elif bodies:
        listing = _of_bodies(of_date, utc_s, site)
    else:
        listing = _of_stars(of_date, utc_s, site, vmag, everything=everything)
    title = f"The sky over {lat:g}, {lon:g} at {format_utc(utc_s)}"
    _print(listing.with_notes(stars.note, dut1, utc_s), _format_of(format_, as_json=as_json), title, stars.note)


class _Listing(NamedTuple):
    """The printed result: rows and their columns, the table of a terminal, and the limits of the accuracy."""

    rows: list[_Row]
    columns: Sequence[str]
    headers: Sequence[str]  # of the table
    cells: Iterable[Sequence[str]]  # of the table, by row
    caption: str
    why_none: str  # why there are no rows
    notes: tuple[str, ...] = ()  # errors to expect

    def with_notes(self, of_catalogue: str, dut1_s: float | None, utc_s: float) -> "_Listing":
        """Return the listing with the UT1 - UTC that it uses: in the caption, or among the notes if it is a guess."""
        ut1, note = "", ""
        if dut1_s is not None:
            ut1 = f"; UT1 - UTC = {dut1_s:+.4f} s as given by --dut1"
        elif not (note := earth_orientation_note(utc_s)):
            table = described_earth_orientation(utc_s)["earth_orientation"]
            ut1 = f"; UT1 - UTC = {table['dut1_s']:+.4f} s by {table['source']}"
        # No number depends on UT1 where there is no row.
        notes = (*self.notes, of_catalogue, note if self.rows else "")
        return self._replace(caption=self.caption + ut1, notes=tuple(filter(None, notes)))


def _of_stars(sky: Sky, utc_s: float, site: Site, vmag: float, *, everything: bool) -> _Listing:
    rows = _star_rows(sky.observed_places(utc_s, site), everything=everything)
    cells = (
        (
            star_label(row["catalogue"], row["star_id"]),
            row["name"],
            f"{row['vmag']:.2f}",
            *(f"{row[angle]:.5f}" for angle in _ANGLES),
        )
        for row in rows
    )
    caption = f"{len(rows)} stars; apparent place of date, degrees"
    return _Listing(rows, _COLUMNS, ("star", *_COLUMNS[2:]), cells, caption, _why_none(len(sky.catalogue), vmag))


def _of_bodies(sky: Sky, utc_s: float, site: Site) -> _Listing:
    rows = [_body_row(body) for body in observed_bodies(sky, utc_s, site)]
    is_accurate = is_corrected(tt_julian_date(utc_s))
    notes = () if is_accurate else ("places are within 90 arcsec only: outside of 1990-2050 they have no corrections",)
    sun, moon = rows[0], rows[1]
    light = f"the Sun at {sun['altitude_deg']:.1f} deg, the Moon {moon['illuminated_fraction']:.0%} lit"
    short = {"apparent_altitude_deg": "apparent_alt", "illuminated_fraction": "lit"}
    columns = ("name", *_BODY_DECIMALS)
    cells = ((row["name"], *_decimal(row, _BODY_DECIMALS)) for row in rows)
    caption = f"{light}; topocentric apparent place of date{', within 1 arcsec of DE421' if is_accurate else ''}"
    return _Listing(rows, columns, [short.get(column, column) for column in columns], cells, caption, "", notes)


def _body_row(body: Body) -> _Row:
    angles_rad = (body.azimuth_rad, body.altitude_rad, body.apparent_altitude_rad, *body.ra_dec_rad)
    numbers = {
        **dict(zip(_BODY_DECIMALS, np.rad2deg(angles_rad).tolist(), strict=False)),
        "distance_km": body.distance_km,
        "diameter_arcsec": float(np.rad2deg(2 * body.angular_radius_rad)) * 3600,
        "phase_angle_deg": float(np.rad2deg(body.phase_angle_rad)),
        "illuminated_fraction": body.illuminated_fraction,
        "bright_limb_deg": None if body.bright_limb_rad is None else float(np.rad2deg(body.bright_limb_rad)),
        "vmag": body.vmag,
    }
    return {"name": body.name} | {key: None if n is None else round(n, _DIGITS) for key, n in numbers.items()}


def _of_satellites(satellites: Satellites, sky: Sky, utc_s: float, site: Site, *, everything: bool) -> _Listing:
    rows = _satellite_rows(satellites, sky, utc_s, site, everything=everything)
    columns = ("name", "satellite_number", *_SATELLITE_DECIMALS)
    cells = ((row["name"], str(row["satellite_number"]), *_decimal(row, _SATELLITE_DECIMALS)) for row in rows)
    caption = "topocentric, with light time, without refraction; lit: the part of the Sun that it sees"
    why_none = "no satellite is above the horizon; --all shows them too"
    return _Listing(rows, columns, columns, cells, caption, why_none, (satellites.age_note(utc_s),))


def _satellite_rows(satellites: Satellites, sky: Sky, utc_s: float, site: Site, *, everything: bool) -> list[_Row]:
    """Return satellites, the highest first; ``vmag`` is that in sunlight, ``lit`` the visible part of the Sun."""
    (sun,) = observed_bodies(sky, utc_s, site, ("Sun",))
    C_ned_eq = sky.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0]
    rows = []
    for satellite in satellites.satellites:
        seen = satellite.seen(sky, np.array([utc_s]), site.latitude_rad, site.longitude_rad, site.height_m)
        seen_ned = with_diurnal_aberration(C_ned_eq @ seen.direction_eq[0], site.latitude_rad, site.height_m)
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(seen_ned)
        if not (np.isfinite(altitude_rad) and (everything or altitude_rad > 0)):
            continue
        vmag, lit = visible_vmag(satellite, seen, sun.direction_eq)
        numbers = (np.rad2deg(azimuth_rad), np.rad2deg(altitude_rad), seen.range_km[0], vmag[0], lit[0])
        row: _Row = {"name": satellite.name, "satellite_number": satellite.number}
        row |= {key: round(float(n), _DIGITS) for key, n in zip(_SATELLITE_DECIMALS, numbers, strict=True)}
        rows.append(row)
    return sorted(rows, key=lambda row: -row["altitude_deg"])


def _decimal(row: _Row, decimals: Mapping[str, int]) -> Iterator[str]:
    """Return the numbers of a row with their decimals; empty where there is none."""
    return ("" if row[key] is None else f"{row[key]:.{count}f}" for key, count in decimals.items())


def _print(listing: _Listing, format_: _Format, title: str, of_catalogue: str) -> None:
    if format_ is _Format.json:
        notes = {"notes": list(listing.notes)} if listing.notes else {}
        json.dump([row | notes for row in listing.rows], sys.stdout, ensure_ascii=False, indent=1)
        typer.echo()
    elif format_ is _Format.csv:
        typer.echo(_csv(listing.rows, listing.columns), nl=False)
    else:
        table = Table(title=title, caption="; ".join([listing.caption, *listing.notes]))
        for header in listing.headers:
            table.add_column(header, justify="left" if header == "name" else "right", no_wrap=header != "name")
        for cells in listing.cells:
            table.add_row(*cells)
        print_table(table, pipe_columns=_PIPE_WIDTH)
    of_table = format_ is _Format.table
    for note in listing.notes:
        if not of_table or note == of_catalogue:
            echo_note(f"note: {note}")
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


def _star_rows(places: ObservedPlaces, *, everything: bool) -> list[_Row]:
    shown = np.flatnonzero(everything | (places.apparent_altitude_rad >= 0))
    stars = places.stars
    angles_rad = [getattr(places, angle.replace("_deg", "_rad")) for angle in _ANGLES]
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


def _csv(rows: list[_Row], columns: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    angles = [angle for angle in _ANGLES if angle in columns]
    writer.writerows(row | {angle: f"{row[angle]:.{_DIGITS}f}" for angle in angles} for row in rows)
    return text.getvalue()
