"""``glstar info``: what flight logs hold."""

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from glstar.cli.flightoptions import CAMERA_FLAGS, FlightFlags, flights_of, with_flight_flags
from glstar.cli.verbosity import echo_note, with_verbosity
from glstar.config import Config
from glstar.errors import LogFormatError
from glstar.flight import ClockQuality, Flight
from glstar.telemetry import LOG_SUFFIXES, Survey, TriggerSurvey, is_bag_directory

if TYPE_CHECKING:
    from glstar.render.scene.scene import Scene
    from glstar.render.truth.conditions import LimitingMagnitude


# If there are more gaps, they are counted instead of listed.
_GAPS_LISTED = 5


@with_verbosity
@with_flight_flags(but=CAMERA_FLAGS)
def info(
    flights: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Flight logs: ArduPilot .BIN or .log, MAVLink .tlog, PX4 .ulg, or CSV tables; or folders of them.",
            show_default="the bundled flight",
        ),
    ] = None,
    *,
    flags: FlightFlags,
    plot: Annotated[
        Path | None,
        typer.Option(help="Draw roll, pitch, yaw, rates and gaps to this .png, .svg or .pdf.", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Show what a flight log holds: vehicle, time, position, every attitude with its rate and gaps, night or day.

    For several logs, or a folder, print a line for each.  With -c, also the limiting magnitude of its camera.

    Try: glstar info flight.BIN --plot flight.png
    """
    paths = [one for path in flights_of(flags.settings(), flights) for one in _logs_of(path)]
    if len(paths) > 1 or any(path.is_dir() and not is_bag_directory(path) for path in flights or ()):
        if plot is not None:
            raise typer.BadParameter("draws one log; name one", param_hint="--plot")
        _survey_several(paths, flags, as_json=as_json)
        return
    settings = flags.settings()
    found, track = settings.survey_flight(paths[0], flags=flags.given())
    scene = None if flags.config is None else _middle_scene(settings, found, track)
    limit = None if flags.config is None else _limiting_magnitude(settings, scene)
    if plot is not None:
        from glstar.cli.flights.flightplot import plot_flight  # noqa: PLC0415 - matplotlib, when it is needed

        plot_flight(track, found, plot)
    if as_json:
        keys = asdict(found) | _limit_keys(limit) | _view_keys(scene)
        typer.echo(json.dumps(keys, indent=1, ensure_ascii=False))
        return
    _print(found, limit, scene)
    if plot is not None:
        typer.echo(f"plot: {plot}")


def _middle_scene(settings: Config, found: Survey, flight: Flight) -> "Scene | None":
    """Return the scene of an exposure in the middle of the flight; None if no sky is known there."""
    attitude, span_s = flight.attitude, settings.exposure.span_s
    start_s = (attitude.first_s + attitude.last_s - span_s) / 2
    is_inside = start_s >= attitude.first_s and attitude.gap_within(start_s, start_s + span_s) is None
    if not is_inside or found.sun_altitude_deg is None:
        return None
    return settings.simulator(flight).scene(settings.exposure.starting_at(start_s))


def _limiting_magnitude(settings: Config, scene: "Scene | None") -> "LimitingMagnitude":
    """Return the limiting magnitude of a scene; without one, that of a star at rest only."""
    # NumPy and the simulator, only with -c.
    from glstar.camera.sensor.sensor import limiting_mag, noise_equivalent_area_px2  # noqa: PLC0415
    from glstar.render.truth.conditions import LimitingMagnitude, limiting_magnitude  # noqa: PLC0415

    if scene is not None:
        return limiting_magnitude(scene)
    sensor, exposure = settings.sensor(), settings.exposure
    area_px2 = noise_equivalent_area_px2(sensor)
    return LimitingMagnitude(limiting_mag(sensor, exposure.duration_s, area_px2, frames=exposure.frames), math.nan)


def _view_keys(scene: "Scene | None") -> dict[str, float | bool]:
    """Return where the camera points, for JSON."""
    from glstar.render.truth.conditions import viewing_conditions  # noqa: PLC0415 - the simulator, only with -c

    if scene is None:
        return {}
    conditions = viewing_conditions(scene)
    return {
        "axis_altitude_deg": round(math.degrees(conditions.axis_altitude_rad), 3),
        "sees_only_ground": conditions.sees_only_ground,
    }


def _view(scene: "Scene | None") -> list[tuple[str, str]]:
    """Return a row that says that the camera points at the ground; none if it points at the sky."""
    from glstar.render.truth.conditions import viewing_conditions  # noqa: PLC0415 - the simulator, only with -c

    ground = "" if scene is None else viewing_conditions(scene).ground_warning
    return [("view", ground)] if ground else []


def _limit_keys(limit: "LimitingMagnitude | None") -> dict[str, float | None]:
    """Return the keys of a limiting magnitude for JSON: null where no star is seen."""
    if limit is None:
        return {}
    values = {"limiting_mag": limit.at_rest_mag, "trail_limiting_mag": limit.trail_mag}
    if limit.cloud_transmission is not None:
        values["cloud_transmission"] = limit.cloud_transmission
    return {key: round(value, 3) if math.isfinite(value) else None for key, value in values.items()}


def _logs_of(path: Path) -> list[Path]:
    """Return the logs in a folder, sorted by name; for a file, the file itself."""
    if not path.is_dir() or is_bag_directory(path):
        return [path]
    logs = sorted(one for one in path.iterdir() if one.suffix.lower() in LOG_SUFFIXES and one.is_file())
    if not logs:
        raise LogFormatError(path, f"has no flight log in it: no file that ends with {', '.join(LOG_SUFFIXES)}")
    return logs


def _survey_several(paths: list[Path], flags: FlightFlags, *, as_json: bool) -> None:
    """Print a line for each log; exit with 1 if none of them can be read."""
    settings = flags.settings()
    found: list[tuple[Path, Survey | LogFormatError]] = []
    for path in paths:
        try:
            found.append((path, settings.survey_flight(path, flags=flags.given())[0]))
        except LogFormatError as error:
            found.append((path, error))
    if as_json:
        reports = [
            asdict(one) if isinstance(one, Survey) else {"file": str(path), "error": one.reason} for path, one in found
        ]
        typer.echo(json.dumps(reports, indent=1, ensure_ascii=False))
    else:
        _print_table(found)
    if not any(isinstance(one, Survey) for _, one in found):
        raise typer.Exit(1)


def _print_table(found: "list[tuple[Path, Survey | LogFormatError]]") -> None:
    table = Table("log", "UTC", "seconds", "attitude", "light", "gaps", "boots", "notes", box=None)
    for column in (table.columns[2], *table.columns[5:]):
        column.justify = "right"
    for path, one in found:
        if not isinstance(one, Survey):
            table.add_row(path.name, "cannot be read")
            continue
        begins = one.utc_first[:19] if one.utc_first is not None else "not known"
        counts = (len(one.gaps), len(one.boots) or 1, len(one.notes))
        row = (path.name, begins, f"{one.duration_s:.1f}", one.attitude_source, one.light or "not known")
        table.add_row(*row, *map(str, counts))
    Console(width=None if sys.stdout.isatty() else 160, highlight=False, markup=False).print(table)
    for path, one in found:
        if not isinstance(one, Survey):
            typer.echo(f"{path.name}: {one.reason}", err=True)


def _print(found: Survey, limit: "LimitingMagnitude | None", scene: "Scene | None") -> None:
    facts = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in (
        ("file", f"{found.file}, {found.file_bytes / 1e6:.1f} MB" if found.file_bytes else found.file),
        ("format", found.format),
        ("vehicle", found.vehicle or "unknown"),
        ("firmware", found.firmware or "unknown"),
        ("duration", _duration(found.duration_s)),
        ("UTC", _utc(found)),
        *(("readings", _readings(clock)) for clock in found.clocks),
        ("position", _position(found)),
        ("light", _light(found)),
        *([] if limit is None else [("stars", f"{limit.text}, on the optical axis with SNR 5")]),
        *_view(scene),
        ("gyros", "none" if found.gyros is None else f"{found.gyros.source}, {found.gyros.rate_hz:.1f} Hz"),
        *([("camera", _camera(found.triggers))] if found.triggers else []),
        *([("flew by", found.estimator)] if found.estimator else []),
        ("attitude", found.attitude_source),
        ("gaps", _gaps(found)),
    ):
        facts.add_row(name, value)
    # A pipe has no width: use one that suffices for the table.
    console = Console(width=None if sys.stdout.isatty() else 140, highlight=False, markup=False)
    console.print(facts)

    attitudes = Table("attitude", "samples", "Hz", "seconds", "gaps", "longest, s", "fastest, deg/s", box=None)
    for column in attitudes.columns[1:]:
        column.justify = "right"
    for one in found.attitudes:
        attitudes.add_row(
            one.name,
            str(one.samples),
            f"{one.rate_hz:.1f}",
            f"{one.duration_s:.1f}",
            str(one.gaps),
            f"{one.longest_gap_s:.3f}",
            f"{one.largest_rate_deg_per_s:.0f}",
        )
    console.print()
    console.print(attitudes)
    if found.boots:
        console.print()
        console.print(_boots(found))
    for note in found.notes:
        echo_note(f"note: {note}")
    console.print(f"\nTry: {found.command}")


def _boots(found: Survey) -> Table:
    table = Table("boot", "seconds", "samples", "UTC", "attitude", "in the flight", box=None)
    for column in table.columns[1:3]:
        column.justify = "right"
    for boot in found.boots:
        table.add_row(
            str(boot.number),
            f"{boot.duration_s:.1f}",
            str(boot.samples),
            "not known" if boot.utc_first is None else f"{boot.utc_first[:19]} to {str(boot.utc_last)[:19]}",
            boot.attitude_source,
            f"no: {boot.left_out}" if boot.left_out else "yes",
        )
    return table


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    return f"{seconds:.1f} s" + (f" ({minutes:.0f} min {rest:.0f} s)" if minutes else "")


def _utc(found: Survey) -> str:
    if found.utc_first is None:
        return f"none: {found.utc_source}; give it with --utc-start"
    return f"{found.utc_first} to {found.utc_last} ({found.utc_source})"


def _readings(clock: ClockQuality) -> str:
    """Return the agreement of the UTC readings and their logging delay."""
    within = f"{clock.readings} of UTC, 95 % within {_short(clock.spread_s)} of their median, all"
    if clock.lag_s is None:
        lag = ""
    elif clock.lag_is_measured:
        lag = f"; logged {1000 * clock.lag_s:.1f} ms after the GPS sample, by GPA"
    else:
        lag = f"; logged {1000 * clock.lag_s:.0f} ms after the GPS sample, as is usual (no GPA)"
    return f"{within} within {_short(clock.largest_s)}{lag}"


def _short(seconds: float) -> str:
    """Return a time with a suitable unit."""
    for size_s, unit in ((86400.0, "days"), (3600.0, "h"), (1.0, "s")):
        if seconds >= size_s:
            return f"{seconds / size_s:.1f} {unit}"
    return f"{1000 * seconds:.1f} ms"


def _position(found: Survey) -> str:
    if found.latitude_deg is None or found.longitude_deg is None:
        return f"none: {found.position_source}; give it with --lat and --lon"
    north, east = "N" if found.latitude_deg >= 0 else "S", "E" if found.longitude_deg >= 0 else "W"
    return (
        f"{abs(found.latitude_deg):.5f} {north} {abs(found.longitude_deg):.5f} {east}, {found.height_m:.0f} m"
        f" ({found.position_source})"
    )


def _camera(triggers: TriggerSurvey) -> str:
    span = f"from {triggers.first_s:.1f} s to {triggers.last_s:.1f} s after the first attitude"
    return f"{triggers.count} triggers ({triggers.source}), {span}; --at camera exposes at them"


def _light(found: Survey) -> str:
    if found.sun_altitude_deg is None:
        return "unknown without UTC and position"
    over = "above" if found.sun_altitude_deg >= 0 else "below"
    remark = "" if found.light == "night" else "; glstar draws the stars nevertheless"
    return f"{found.light}: the Sun is {abs(found.sun_altitude_deg):.1f} deg {over} the horizon{_moon(found)}{remark}"


def _moon(found: Survey) -> str:
    if found.moon_altitude_deg is None or found.moon_illuminated_fraction is None:
        return ""
    up = f"{found.moon_altitude_deg:.1f} deg above" if found.moon_altitude_deg >= 0 else "below"
    return f", the Moon, {found.moon_illuminated_fraction:.0%} lit, {up} it"


def _gaps(found: Survey) -> str:
    if not found.gaps:
        return "none"
    if len(found.gaps) > _GAPS_LISTED:
        counted = ", ".join(
            f"{reason} {'once' if count == 1 else f'{count} times'}" for reason, count in found.gap_counts.items()
        )
        longest = max(found.gaps, key=lambda gap: gap.duration_s)
        return f"{counted}; the longest, {longest.duration_s:.3f} s, at {longest.start_s:.1f} s"
    return "; ".join(f"{gap.reason} of {gap.duration_s:.3f} s at {gap.start_s:.1f} s" for gap in found.gaps)
