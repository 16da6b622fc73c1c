"""Which log, and how it is read: the options that every command with a flight has."""

from pathlib import Path
from typing import Annotated

import typer

from glstar.config import Config
from glstar.resources import asset
from glstar.track import Interpolation

__all__ = [
    "Attitude",
    "ConfigFile",
    "Flight",
    "Interpolate",
    "Lat",
    "Lon",
    "MaxGap",
    "Sysid",
    "TimeOffset",
    "UtcStart",
    "log_of",
    "settings_of",
]

_BUNDLED_FLIGHT = "adelaide.BIN"

Flight = Annotated[
    Path | None,
    typer.Argument(
        help="A flight log: ArduPilot .BIN or .log, MAVLink .tlog, PX4 .ulg, or a CSV table.",
        show_default="the bundled flight",
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option("-c", "--config", help="A TOML file of settings.", show_default="the bundled camera")
]
UtcStart = Annotated[
    str | None,
    typer.Option(help="UTC of the first attitude, ISO 8601, for a log without UTC.", show_default="the log's"),
]
Lat = Annotated[
    float | None,
    typer.Option(help="Latitude, deg, north positive, for a log without positions.", show_default="the log's"),
]
Lon = Annotated[float | None, typer.Option(help="Longitude, deg, east positive.", show_default="the log's")]
Sysid = Annotated[
    int | None,
    typer.Option(
        help="Whose flight, in a .tlog of several vehicles: a MAVLink system.", show_default="the first with attitude"
    ),
]
Attitude = Annotated[
    str | None, typer.Option(help="Which attitude of the log, by its name in glstar info.", show_default="auto")
]
TimeOffset = Annotated[
    float | None, typer.Option(help="The camera's clock minus the log's, s.", show_default="0, or the config's")
]
Interpolate = Annotated[
    Interpolation | None,
    typer.Option("--interpolation", help="How attitude is known between samples.", show_default="slerp"),
]
MaxGap = Annotated[
    float | None,
    typer.Option(help="The longest silence of the log to interpolate across, s.", show_default="3 usual intervals"),
]


def log_of(flight: Path | None) -> Path:
    """Return the log that was named, else the bundled one.

    Parameters
    ----------
    flight : Path or None

    Returns
    -------
    Path
    """
    return asset(_BUNDLED_FLIGHT) if flight is None else flight


def settings_of(
    config: Path | None,
    *,
    utc_start: str | None = None,
    lat: float | None = None,
    lon: float | None = None,
    sysid: int | None = None,
    attitude: str | None = None,
    time_offset: float | None = None,
    max_gap: float | None = None,
    interpolation: Interpolation | None = None,
    **others: object,
) -> Config:
    """Return the settings of a file with flags on top.

    Parameters
    ----------
    config : Path or None
        None for the defaults.
    utc_start, lat, lon, sysid, attitude, time_offset, max_gap, interpolation
        The flags of ``[flight]``; None where they were not given.
    **others
        Other flags, by dotted key.

    Returns
    -------
    Config

    Raises
    ------
    ConfigError
        If the file or a flag cannot be meant.
    """
    return (Config() if config is None else Config.load(config)).override(
        **{
            "flight.utc_start": utc_start,
            "flight.latitude_deg": lat,
            "flight.longitude_deg": lon,
            "flight.sysid": sysid,
            "flight.attitude": attitude,
            "flight.time_offset_s": time_offset,
            "flight.max_gap_s": max_gap,
            "flight.interpolation": interpolation,
        },
        **others,
    )
