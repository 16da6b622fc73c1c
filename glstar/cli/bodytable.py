"""The table of the Sun, the Moon and the planets of ``glstar sky --bodies``."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from rich.table import Table

from glstar.sky.bodies import Body, observed_bodies
from glstar.sky.ephemeris import is_corrected
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.timescale import tt_julian_date

__all__ = ["BODY_COLUMNS", "body_rows", "body_table"]

# The columns, with their decimals in a table.
_DECIMALS: Final = {
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
BODY_COLUMNS: Final = ("name", *_DECIMALS)
# Decimals of numbers in CSV and JSON: the last one of an angle is 0.00004".
_DIGITS: Final = 8

Row = dict[str, Any]


def body_rows(sky: Sky, utc_s: float, site: Site) -> list[Row]:
    """Return the bodies as rows, ready for CSV and JSON.

    Parameters
    ----------
    sky : Sky
    utc_s : float
        UTC seconds since 1970.
    site : Site

    Returns
    -------
    list of dict
        With the keys `BODY_COLUMNS`: every body, also below the horizon.
    """
    return [_row(body) for body in observed_bodies(sky, utc_s, site)]


def _row(body: Body) -> Row:
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
        key: None if number is None else round(number, _DIGITS) for key, number in numbers.items()
    }


def body_table(rows: Sequence[Row], title: str, ut1: str, utc_s: float) -> Table:
    """Return the rows as a table for a terminal.

    Parameters
    ----------
    rows : sequence of dict
        The result of `body_rows`.
    title : str
    ut1 : str
        What UT1 - UTC is.
    utc_s : float
        UTC seconds since 1970.

    Returns
    -------
    rich.table.Table
    """
    accuracy = "within 1 arcsec of DE421" if is_corrected(tt_julian_date(utc_s)) else "within 90 arcsec (not 1990-2050)"
    sun, moon = rows[0], rows[1]
    light = f"the Sun at {sun['altitude_deg']:.1f} deg, the Moon {moon['illuminated_fraction']:.0%} lit"
    table = Table(title=title, caption=f"{light}; topocentric apparent place of date, {accuracy}; {ut1}")
    for column in BODY_COLUMNS:
        header = column.replace("apparent_altitude_deg", "apparent_alt").replace("illuminated_fraction", "lit")
        table.add_column(header, justify="left" if column == "name" else "right", no_wrap=True)
    for row in rows:
        cells = ("" if row[key] is None else f"{row[key]:.{decimals}f}" for key, decimals in _DECIMALS.items())
        table.add_row(row["name"], *cells)
    return table
