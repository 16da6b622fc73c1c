"""``glstar config``: the settings in effect and where each comes from, or a commented template."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from glstar.camera.mounts import mount_label
from glstar.cli.flightoptions import FlightFlags, with_flight_flags
from glstar.cli.tables import print_table
from glstar.config.config import DEFAULT, origins
from glstar.config.keys import toml_value
from glstar.errors import ConfigError
from glstar.system.resources import asset

_TEMPLATE = "glstar.toml"


@with_flight_flags()
def show_config(
    flags: FlightFlags,
    template: Annotated[
        Path | None,
        typer.Option(help="Write a config with every key and its meaning to a new .toml file.", show_default=False),
    ] = None,
    changed: Annotated[bool, typer.Option("--changed", help="Show only what differs from the defaults.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show every setting in effect, and whether it comes from a flag, the config file, a preset or the default.

    Try: glstar config -c night.toml --changed, or glstar config --template night.toml
    """
    if template is not None:
        _write_template(template)
        return
    settings = flags.settings()
    found = {
        section: {key: one for key, one in values.items() if not changed or one[1] != DEFAULT}
        for section, values in origins(settings, flags.by_key()).items()
    }
    found = {section: values for section, values in found.items() if values}
    if as_json:
        report = {
            section: {key: {"value": value, "from": origin} for key, (value, origin) in values.items()}
            for section, values in found.items()
        }
        typer.echo(json.dumps(report, indent=1, ensure_ascii=False))
        return
    table = Table("key", "value", "from", box=None)
    for section, values in found.items():
        for key, (value, origin) in values.items():
            table.add_row(f"{section}.{key}", toml_value(value), origin)
    print_table(table)
    if not changed:
        typer.echo(f"\n{mount_label(settings.mount())}: glstar manual mounts")


def _write_template(path: Path) -> None:
    if path.suffix.lower() != ".toml":
        raise ConfigError(f"{path}: a config is a .toml file")
    content = asset(_TEMPLATE).read_bytes()
    try:
        with path.open("xb") as file:
            file.write(content)
    except FileExistsError:
        raise ConfigError(f"{path}: exists already; name another file, or remove it") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    typer.echo(f"{path}: every key with its default")
