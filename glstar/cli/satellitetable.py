"""The table of satellites of ``glstar sky --satellites``."""

from typing import Any, Final

import numpy as np
from rich.table import Table

from glstar.sky.bodies import observed_bodies
from glstar.sky.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.observed import Sky
from glstar.sky.satellites import Satellites, visible_vmag
from glstar.sky.site import Site

__all__ = ["SATELLITE_COLUMNS", "satellite_rows", "satellite_table"]

# The columns, with their decimals in a table.
_DECIMALS: Final = {"azimuth_deg": 4, "altitude_deg": 4, "range_km": 1, "vmag": 1, "lit": 2}
SATELLITE_COLUMNS: Final = ("name", "satellite_number", *_DECIMALS)
# Decimals of numbers in CSV and JSON.
_DIGITS: Final = 8

Row = dict[str, Any]


def satellite_rows(satellites: Satellites, sky: Sky, utc_s: float, site: Site, *, everything: bool) -> list[Row]:
    """Return satellites as rows, the highest first, ready for CSV and JSON.

    Parameters
    ----------
    satellites : Satellites
    sky : Sky
    utc_s : float
        UTC seconds since 1970.
    site : Site
    everything : bool
        Whether those below the horizon are listed too.

    Returns
    -------
    list of dict
        With the keys `SATELLITE_COLUMNS`; ``vmag`` is that in sunlight, ``lit`` the part of the Sun that it sees.
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
        rows.append(named | {key: round(float(n), _DIGITS) for key, n in zip(_DECIMALS, numbers, strict=True)})
    return sorted(rows, key=lambda row: -row["altitude_deg"])


def satellite_table(rows: list[Row], title: str, note: str) -> Table:
    """Return the rows as a table for a terminal.

    Parameters
    ----------
    rows : list of dict
        The result of `satellite_rows`.
    title : str
    note : str
        About the age of the elements; may be empty.

    Returns
    -------
    rich.table.Table
    """
    caption = "topocentric, with light time, without refraction; lit: the part of the Sun that it sees"
    table = Table(title=title, caption=f"{caption}; {note}" if note else caption)
    for column in SATELLITE_COLUMNS:
        table.add_column(column, justify="left" if column == "name" else "right", no_wrap=True)
    for row in rows:
        cells = (f"{row[key]:.{decimals}f}" for key, decimals in _DECIMALS.items())
        table.add_row(row["name"], str(row["satellite_number"]), *cells)
    return table
