"""``glstar fly``: a flight without a log, written as a CSV table that every command reads."""

import json
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from glstar.cli.reporting import echo_note
from glstar.errors import ConfigError
from glstar.flight.synthetic.syntheticflight import FlightPath
from glstar.system.files import write_atomically
from glstar.telemetry import KEYS, PREFIX, as_table, synthetic_flight


def _with_keys(command: Any) -> Any:
    """Give a command one option for each key of a described flight: ``radius_m`` is ``--radius-m``."""

    def with_options(**values: Any) -> None:
        settings = {key: values.pop(key) for key in KEYS}
        command(**values, settings={key: text for key, text in settings.items() if text is not None})

    options = [
        Parameter(
            key,
            Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                str | None,
                typer.Option(f"--{key.replace('_', '-')}", help=f"{setting.help[0].upper()}{setting.help[1:]}.",
                             show_default=setting.default or False, metavar="TEXT"),
            ],
        )
        for key, setting in KEYS.items()
    ]  # fmt: skip
    own = [
        parameter.replace(kind=Parameter.KEYWORD_ONLY)
        for parameter in signature(command).parameters.values()
        if parameter.name != "settings"
    ]
    with_options.__signature__ = signature(command).replace(parameters=own + options)  # type: ignore[attr-defined]
    with_options.__doc__ = command.__doc__
    return with_options


@_with_keys
def fly(
    path: Annotated[FlightPath, typer.Argument(help=f"The path: {', '.join(get_args(FlightPath))}.", metavar="PATH")],
    *,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The CSV file to write.", show_default="PATH.csv")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
    settings: dict[str, str],
) -> None:
    """Write a flight without a log: an orbit, a transit, waypoints, a hover or a spin, in wind and gusts.

    This command goes with the next release: glstar convert 'fly:orbit?radius_m=300' -o orbit.csv writes the same.

    Every command also takes such a flight in one line, without a file: glstar export 'fly:orbit?radius_m=300'.

    Try: glstar fly orbit --radius-m 300 --turns 2 --wind-m-per-s 8 --gusts light -o orbit.csv
    """
    target = Path(f"{path}.csv") if output is None else output
    echo_note("note: glstar fly is glstar convert 'fly:...' -o FILE.csv now; the old name goes with the next release")
    if target.exists() and not force:
        raise ConfigError(f"{target} is there already; name another file with -o, or replace it with --force")
    flight = synthetic_flight(path, settings).flight()
    write_atomically(target, as_table(flight).encode())
    attitude = flight.attitude
    described = "&".join(f"{key}={text}" for key, text in settings.items())
    line = f"{PREFIX}{path}{'?' if described else ''}{described}"
    if as_json:
        facts = {
            "file": str(target),
            "duration_s": round(attitude.last_s - attitude.first_s, 3),
            "attitudes": int(attitude.utc_s.size),
            "rate_hz": round(attitude.rate_hz, 3),
            "flight": line,
        }
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{target}: {attitude.last_s - attitude.first_s:.1f} s, {attitude.utc_s.size} attitudes at"
        f" {attitude.rate_hz:.0f} Hz"
    )
    typer.echo(f"The same in one line: '{line}'")
    typer.echo(f"Try: glstar export {target} -o frames")
