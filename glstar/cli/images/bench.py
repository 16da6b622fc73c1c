"""``glstar bench``: NightSky-Bench, named sets of frames, solvers run on them, and tables of their scores."""

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from glstar.cli.reporting import PLOT_FORMATS, echo_note, progress_bar, resumable
from glstar.cli.tables import print_table
from glstar.system.files import write_atomically
from glstar.system.process import exit_on_interrupt

if TYPE_CHECKING:
    from glstar.score.sets import MadeSet

app = typer.Typer(help="NightSky-Bench: draw named sets of frames, run solvers on them, compare.", no_args_is_help=True)

# Width of the list of sets that is written to a pipe, characters.
_PIPE_COLUMNS = 120

Json = Annotated[bool, typer.Option("--json", help="Report as JSON.")]


@app.command("sets")
def sets(*, as_json: Json = False) -> None:
    """List the sets, and how many frames each has.

    Try: glstar bench sets
    """
    from glstar.score.sets import recipe, set_names  # noqa: PLC0415 - OpenCV

    recipes = [recipe(name) for name in set_names()]
    if as_json:
        facts = [
            {"set": one.name, "title": one.title, "about": one.about, "version": one.version, "seed": one.seed}
            for one in recipes
        ]
        typer.echo(json.dumps(facts))
        return
    table = Table("set", "shows", box=None)
    for one in recipes:
        table.add_row(one.name, f"{one.title}. {one.about}")
    print_table(table, pipe_columns=_PIPE_COLUMNS)


@app.command()
def make(
    name: Annotated[str, typer.Argument(metavar="SET", help="Name of the set: glstar bench sets lists them.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The directory of the set.")],
    *,
    full: Annotated[bool, typer.Option("--full", help="About 1000 frames, not about 100.")] = False,
    workers: Annotated[int, typer.Option(help="Processes that draw.", min=1, max=64)] = 1,
    as_json: Json = False,
) -> None:
    """Draw a set: frames and nav.jsonl for solvers in DIR/frames, the truth in DIR/truth.

    Run again, it draws the missing frames only.  It ends with a comparison with the published checksums.

    Try: glstar bench make static -o static
    """
    with exit_on_interrupt():
        from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV
        from glstar.export.run.processes import local_executor  # noqa: PLC0415 - OpenCV
        from glstar.score.sets import difference_from, make_set, recipe, reference_of  # noqa: PLC0415 - OpenCV

    size = "full" if full else "small"
    chosen = recipe(name)
    with (
        resumable(),
        explain_disk_errors(output),
        local_executor(workers) as executor,
        progress_bar("frames") as on_frame,
    ):
        made = make_set(chosen, size, output, executor, on_part=_announce, on_frame=on_frame)
    reference = reference_of(name, size)
    difference = None if reference is None else difference_from(made, reference)
    if as_json:
        typer.echo(json.dumps(made.json | {"published": reference is not None, "difference": difference}))
        return
    typer.echo(f"{made.frames} frames of {name}, {size}: {output}")
    typer.echo(_verdict(made, published=reference is not None, difference=difference))


def _announce(part: str) -> None:
    echo_note(f"part {part}")


def _verdict(made: "MadeSet", *, published: bool, difference: str | None) -> str:
    if not published:
        return f"no checksums of {made.name}, {made.size} are published; those of {made.driver} are in set.json"
    return "every pixel as in the published set" if difference is None else f"note: {difference}"


@app.command()
def run(
    solver: Annotated[
        str,
        typer.Argument(
            help="Command of the solver, in quotes; two words are appended: a directory"
            " of frames with nav.jsonl, and the file for its answers."
        ),
    ],
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="The directory of a set.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The directory for answers, logs and result.json.")],
    name: Annotated[
        str | None, typer.Option(help="Name of the solver in tables; by default the last word of its command.")
    ] = None,
    solver_version: Annotated[str, typer.Option(help="Version of the solver in tables.", show_default=False)] = "",
    timeout_s: Annotated[float, typer.Option("--timeout", help="Longest time for a part, s.", min=1)] = 3600.0,
    as_json: Json = False,
) -> None:
    """Run a solver on each part of a set, and score its answers.

    The solver reads images and nav.jsonl and writes answers as JSON lines or CSV (glstar manual score).  A solver that
    fails on a part has refused what it did not answer; the exit status is 1 then.

    Try: glstar bench run "python solver_adapters.py tetra3rs" static -o results/tetra3rs
    """
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV
    from glstar.score.board import markdown, summary_rows  # noqa: PLC0415 - OpenCV
    from glstar.score.runs import Solver, run_solver  # noqa: PLC0415 - OpenCV
    from glstar.score.sets import MadeSet  # noqa: PLC0415 - OpenCV

    try:
        words = tuple(shlex.split(solver))
    except ValueError as error:
        raise typer.BadParameter(f"{solver}: {str(error).lower()}", param_hint="SOLVER") from None
    if not words:
        raise typer.BadParameter("an empty command", param_hint="SOLVER")
    made = MadeSet.read(directory)
    program = Solver(words, name or Path(words[-1]).stem, solver_version)
    with explain_disk_errors(output):
        result, failures = run_solver(program, made, output, timeout_s=timeout_s, on_part=_announce)
    for part, failure in failures.items():
        typer.echo(f"glstar: {part}: {program.name} {failure}; {output / part}.log", err=True)
    typer.echo(json.dumps(result) if as_json else markdown(summary_rows([result])), nl=as_json)
    if failures:
        raise typer.Exit(1)


@app.command("table")
def table(
    results: Annotated[list[Path], typer.Argument(help="Results of glstar bench run: directories or files.")],
    *,
    by: Annotated[
        list[str] | None,
        typer.Option(
            help='Also a table by groups of frames: part, "rate, deg/s", "field, deg" ...', show_default=False
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the outcomes as bars: .png, .svg or .pdf.", show_default=False)
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the tables to a file.", show_default="print them")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare the results of solvers: Markdown, JSON and a plot.

    Try: glstar bench table results/* --by part --plot board.png
    """
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV
    from glstar.score.board import draw_board, group_rows, in_order, markdown, summary_rows  # noqa: PLC0415
    from glstar.score.runs import read_result  # noqa: PLC0415 - OpenCV

    if plot is not None and plot.suffix.lower() not in PLOT_FORMATS:
        raise typer.BadParameter(f"{plot} must end with .png, .svg or .pdf", param_hint="--plot")
    read = in_order([read_result(path) for path in results])
    if as_json:
        text = json.dumps(read) + "\n"
    else:
        text = "\n".join(markdown(rows) for rows in (summary_rows(read), *(group_rows(read, one) for one in by or ())))
    if plot is not None:
        with explain_disk_errors(plot):
            draw_board(read, plot)
    if output is None:
        typer.echo(text, nl=False)
        return
    with explain_disk_errors(output):
        write_atomically(output, text.encode())
