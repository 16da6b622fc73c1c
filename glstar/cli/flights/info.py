"""``glstar info``: what flight logs hold, as text, JSON or a plot of angles, rates and gaps over time."""

import json
import math
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from glstar.cli.flightoptions import CAMERA_FLAGS, FlightFlags, flights_of, with_flight_flags
from glstar.cli.reporting import PLOT_FORMATS, echo_note
from glstar.cli.tables import print_table
from glstar.config import Config
from glstar.errors import ExportError, LogFormatError
from glstar.flight import ClockQuality, Flight
from glstar.rotation import euler_from_quaternion
from glstar.system.files import write_atomically
from glstar.telemetry import LOG_SUFFIXES, Survey, TriggerSurvey, is_bag_directory

if TYPE_CHECKING:
    from glstar.render.scene.scene import Scene
    from glstar.render.truth.conditions import LimitingMagnitude


# If there are more gaps, they are counted instead of listed.
_GAPS_LISTED = 5
# Width of a report of one log that is written to a pipe, characters.
_PIPE_COLUMNS = 140
# A larger step between two samples of an angle is a wrap-around, deg.
_WRAP_DEG = 180.0


@with_flight_flags(but={*CAMERA_FLAGS, "mount"})
def info(
    flights: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Flights: logs of ArduPilot (.BIN, .log), MAVLink (.tlog), PX4 (.ulg), CSV tables; folders of"
            " them; demo; or fly:orbit and other described ones (glstar manual fly).",
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
    paths = [file for path in flights_of(flags.settings(), flights) for file in _logs_of(path)]
    if len(paths) > 1 or any(path.is_dir() and not is_bag_directory(path) for path in flights or ()):
        if plot is not None:
            raise typer.BadParameter("draws one log; name one", param_hint="--plot")
        _survey_several(paths, flags, as_json=as_json)
        return
    settings = flags.settings()
    log, track = settings.survey_flight(paths[0], flags=flags.given())
    scene = None if flags.config is None else _middle_scene(settings, log, track)
    limit = None if flags.config is None else _limiting_magnitude(settings, scene)
    if plot is not None:
        _plot(track, log, plot)
    if as_json:
        keys = asdict(log) | _limit_keys(limit) | _view_keys(scene)
        typer.echo(json.dumps(keys, indent=1, ensure_ascii=False))
        return
    _print(log, limit, scene)
    if plot is not None:
        typer.echo(f"plot: {plot}")


def _middle_scene(settings: Config, log: Survey, flight: Flight) -> "Scene | None":
    """Return the scene of an exposure in the middle of the flight; None if no sky is known there."""
    attitude, span_s = flight.attitude, settings.exposure.span_s
    start_s = (attitude.first_s + attitude.last_s - span_s) / 2
    is_inside = start_s >= attitude.first_s and attitude.gap_within(start_s, start_s + span_s) is None
    if not is_inside or log.sun_altitude_deg is None:
        return None
    return settings.simulator(flight).scene(settings.exposure.starting_at(start_s))


def _limiting_magnitude(settings: Config, scene: "Scene | None") -> "LimitingMagnitude":
    """Return the limiting magnitude of a scene; without one, the limit for a star at rest only."""
    from glstar.camera.sensor.sensor import limiting_mag, noise_equivalent_area_px2  # noqa: PLC0415 - only with -c
    from glstar.render.truth.conditions import LimitingMagnitude, limiting_magnitude  # noqa: PLC0415 - only with -c

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
    logs = sorted(file for file in path.iterdir() if file.suffix.lower() in LOG_SUFFIXES and file.is_file())
    if not logs:
        raise LogFormatError(path, f"has no flight log in it: no file that ends with {', '.join(LOG_SUFFIXES)}")
    return logs


def _survey_several(paths: list[Path], flags: FlightFlags, *, as_json: bool) -> None:
    """Print a line for each log; exit with 1 if none of them can be read."""
    settings = flags.settings()
    results: list[tuple[Path, Survey | LogFormatError]] = []
    for path in paths:
        try:
            results.append((path, settings.survey_flight(path, flags=flags.given())[0]))
        except LogFormatError as error:
            results.append((path, error))
    if as_json:
        reports = [
            asdict(result) if isinstance(result, Survey) else {"file": str(path), "error": result.reason}
            for path, result in results
        ]
        typer.echo(json.dumps(reports, indent=1, ensure_ascii=False))
    else:
        _print_table(results)
    if not any(isinstance(result, Survey) for _, result in results):
        raise typer.Exit(1)


def _print_table(results: "list[tuple[Path, Survey | LogFormatError]]") -> None:
    table = Table("log", "UTC", "seconds", "attitude", "light", "gaps", "boots", "notes", box=None)
    for column in (table.columns[2], *table.columns[5:]):
        column.justify = "right"
    for path, result in results:
        if not isinstance(result, Survey):
            table.add_row(path.name, "cannot be read")
            continue
        begins = result.utc_first[:19] if result.utc_first is not None else "not known"
        counts = (len(result.gaps), len(result.boots) or 1, len(result.notes))
        row = (path.name, begins, f"{result.duration_s:.1f}", result.attitude_source, result.light or "not known")
        table.add_row(*row, *map(str, counts))
    print_table(table)
    for path, result in results:
        if not isinstance(result, Survey):
            typer.echo(f"{path.name}: {result.reason}", err=True)


def _print(log: Survey, limit: "LimitingMagnitude | None", scene: "Scene | None") -> None:
    facts = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in (
        ("file", f"{log.file}, {log.file_bytes / 1e6:.1f} MB" if log.file_bytes else log.file),
        ("format", log.format),
        ("vehicle", log.vehicle or "unknown"),
        ("firmware", log.firmware or "unknown"),
        ("duration", _duration(log.duration_s)),
        ("UTC", _utc(log)),
        *(("readings", _readings(clock)) for clock in log.clocks),
        ("position", _position(log)),
        ("light", _light(log)),
        *([] if limit is None else [("stars", f"{limit.text}, on the optical axis with SNR 5")]),
        *_view(scene),
        ("gyros", "none" if log.gyros is None else f"{log.gyros.source}, {log.gyros.rate_hz:.1f} Hz"),
        *(("camera", _camera(triggers)) for triggers in log.triggers),
        *([("flew by", log.estimator)] if log.estimator else []),
        ("attitude", log.attitude_source),
        ("gaps", _gaps(log)),
    ):
        facts.add_row(name, value)
    print_table(facts, pipe_columns=_PIPE_COLUMNS)

    attitudes = Table("attitude", "samples", "Hz", "seconds", "gaps", "longest, s", "fastest, deg/s", box=None)
    for column in attitudes.columns[1:]:
        column.justify = "right"
    for attitude in log.attitudes:
        attitudes.add_row(
            attitude.name,
            str(attitude.samples),
            f"{attitude.rate_hz:.1f}",
            f"{attitude.duration_s:.1f}",
            str(attitude.gaps),
            f"{attitude.longest_gap_s:.3f}",
            f"{attitude.largest_rate_deg_per_s:.0f}",
        )
    typer.echo()
    print_table(attitudes, pipe_columns=_PIPE_COLUMNS)
    if log.boots:
        typer.echo()
        print_table(_boots(log), pipe_columns=_PIPE_COLUMNS)
    for note in log.notes:
        echo_note(f"note: {note}")
    typer.echo(f"\nTry: {log.command}")


def _boots(log: Survey) -> Table:
    table = Table("boot", "seconds", "samples", "UTC", "attitude", "in the flight", box=None)
    for column in table.columns[1:3]:
        column.justify = "right"
    for boot in log.boots:
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


def _utc(log: Survey) -> str:
    if log.utc_first is None:
        return f"none: {log.utc_source}; give it with --utc-start"
    return f"{log.utc_first} to {log.utc_last} ({log.utc_source})"


def _readings(clock: ClockQuality) -> str:
    """Return the agreement of the UTC readings and their logging delay."""
    cut = f" (and {clock.cut} that disagree, not used)" if clock.cut else ""
    within = f"{clock.readings} of UTC{cut}, 95 % within {_short(clock.spread_s)} of their median, all"
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


def _position(log: Survey) -> str:
    if log.latitude_deg is None or log.longitude_deg is None:
        return f"none: {log.position_source}; give it with --lat and --lon"
    north, east = "N" if log.latitude_deg >= 0 else "S", "E" if log.longitude_deg >= 0 else "W"
    return (
        f"{abs(log.latitude_deg):.5f} {north} {abs(log.longitude_deg):.5f} {east}, {log.height_m:.0f} m"
        f" ({log.position_source})"
    )


def _camera(triggers: TriggerSurvey) -> str:
    span = f"from {triggers.first_s:.1f} s to {triggers.last_s:.1f} s after the first attitude"
    return f"{triggers.count} triggers ({triggers.source}), {span}; --at {triggers.camera} exposes at them"


def _light(log: Survey) -> str:
    if log.sun_altitude_deg is None:
        return "unknown without UTC and position"
    over = "above" if log.sun_altitude_deg >= 0 else "below"
    remark = "" if log.light == "night" else "; glstar draws the stars nevertheless"
    return f"{log.light}: the Sun is {abs(log.sun_altitude_deg):.1f} deg {over} the horizon{_moon(log)}{remark}"


def _moon(log: Survey) -> str:
    if log.moon_altitude_deg is None or log.moon_illuminated_fraction is None:
        return ""
    up = f"{log.moon_altitude_deg:.1f} deg above" if log.moon_altitude_deg >= 0 else "below"
    return f", the Moon, {log.moon_illuminated_fraction:.0%} lit, {up} it"


def _gaps(log: Survey) -> str:
    if not log.gaps:
        return "none"
    if len(log.gaps) > _GAPS_LISTED:
        counted = ", ".join(
            f"{reason} {'once' if count == 1 else f'{count} times'}" for reason, count in log.gap_counts.items()
        )
        longest = max(log.gaps, key=lambda gap: gap.duration_s)
        return f"{counted}; the longest, {longest.duration_s:.3f} s, at {longest.start_s:.1f} s"
    return "; ".join(f"{gap.reason} of {gap.duration_s:.3f} s at {gap.start_s:.1f} s" for gap in log.gaps)


def _plot(flight: Flight, survey: Survey, path: Path) -> None:
    """Plot Euler angles and turn rates of a flight, with shaded gaps.

    `path`: the file to write: .png, .svg or .pdf.  Raises ExportError if the file has another suffix or cannot be
    written.
    """
    # Matplotlib and OpenCV, only for a plot.
    from matplotlib import rc_context  # noqa: PLC0415
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415

    if path.suffix.lower() not in PLOT_FORMATS:
        raise ExportError(path, f"is not a supported image format; it must end with {', '.join(PLOT_FORMATS)}")
    track = flight.attitude
    t = track.utc_s - track.first_s
    figure = Figure(figsize=(12, 8), layout="constrained")
    FigureCanvasAgg(figure)
    angles, rates = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for name, angle_rad in zip(("roll", "pitch", "yaw"), euler_from_quaternion(track.q_body_ned), strict=True):
        angles.plot(t, _unbroken(np.rad2deg(angle_rad)), lw=0.8, label=name)
    rate_utc_s, rate_rad_per_s = track.rates()
    for name, rate in zip(("about forward", "about right", "about down"), np.rad2deg(rate_rad_per_s).T, strict=True):
        rates.plot(rate_utc_s - track.first_s, rate, lw=0.8, label=name)
    for axes, label in ((angles, "deg"), (rates, "deg/s")):
        for gap in track.gaps:
            axes.axvspan(gap.start_utc_s - track.first_s, gap.stop_utc_s - track.first_s, color="0.8", lw=1)
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="upper right", ncols=3)
    angles.set_yticks(np.arange(-180, 181, 60))
    rates.set_xlabel(f"s from the first attitude{'' if survey.utc_first is None else f', {survey.utc_first}'}")
    gaps = {0: "no gaps", 1: "1 gap, shaded"}.get(len(track.gaps), f"{len(track.gaps)} gaps, shaded")
    angles.set_title(f"{flight.name}: {flight.attitude_source}, {gaps}")
    with explain_disk_errors(path):
        drawn = BytesIO()
        # Without a date, and with fixed names in SVG: equal flights give equal files.
        dated = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}[path.suffix.lower()]
        with rc_context({"svg.hashsalt": "glstar"}):
            figure.savefig(drawn, format=path.suffix[1:].lower(), dpi=110, metadata=dated)
        write_atomically(path, drawn.getvalue())


def _unbroken(angle_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an angle with NaN where it wraps around, so that no line crosses the plot."""
    broken = angle_deg.copy()
    broken[1:][np.abs(np.diff(angle_deg)) > _WRAP_DEG] = np.nan
    return broken
