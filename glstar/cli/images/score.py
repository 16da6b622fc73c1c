"""``glstar score``: a navigator's answers against the truth of an export."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from glstar.cli.tables import console_of_width, print_table
from glstar.export.truth.lines import DETECTABLE_SNR
from glstar.score.frames import Limits
from glstar.score.gate import EXAMPLE, GateLimit, Verdict, gate_note, judged, read_gate
from glstar.score.metrics import ERRORS, METRICS, Metric, Spread, Summary
from glstar.score.scoring import RUN_METRICS, Orbit, Score, draw_score, orbits_by_setting
from glstar.system.files import write_atomically

# Width of a score that is written to a pipe, characters.
_PIPE_COLUMNS = 120
# Orbits that are printed one by one; score.json has all.
_MOST_ORBITS = 12
# Invalid lines that are reported one by one; score.json has all.
_MOST_FAULTS = 5


def _example_gate(gate: Path | None) -> Path | None:
    """Print an example of the file of ``--gate``, if it is requested in place of a file."""
    if gate == Path("example"):
        typer.echo(EXAMPLE, nl=False)
        raise typer.Exit
    return gate


def score(
    export: Annotated[Path, typer.Argument(metavar="SET", help="The directory of an export, with its truth.")],
    answers: Annotated[Path, typer.Argument(help="Answers: CSV with a header, or JSON lines, one for each frame.")],
    *,
    json_output: Annotated[bool, typer.Option("--json", help="Print the whole score as JSON.")] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Write score.json, score.png and index.html, a page for a browser, into this directory.",
            show_default=False,
        ),
    ] = None,
    false_deg: Annotated[float, typer.Option(help="Largest error of the optical axis of a solved frame, deg.")] = 1.0,
    false_roll_deg: Annotated[
        float, typer.Option(help="Largest error of the rotation about the optical axis of a solved frame, deg.")
    ] = 5.0,
    false_km: Annotated[float, typer.Option(help="Largest error of the position of a solved frame, km.")] = 200.0,
    tolerance_px: Annotated[
        float, typer.Option(help="Largest position error of a correctly identified star, px.")
    ] = 3.0,
    detectable_snr: Annotated[
        float, typer.Option(help="Smallest signal-to-noise ratio of a detectable star.")
    ] = DETECTABLE_SNR,
    gate: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Limits of the score (TOML): the exit status is 1 if one is not kept. --gate example prints a file.",
            callback=_example_gate,
            is_eager=True,
            show_default=False,
        ),
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(help="Print all ranges of a setting that the sweep drew at random.", show_default=False),
    ] = None,
) -> None:
    """Score a navigator's answers: attitude, position, identified stars and run time against the truth.

    Try: glstar score frames answers.csv -o score
    """
    from glstar.score.scoring import score as scored  # noqa: PLC0415 - the name of the command

    chosen = frozenset(by or ())
    gate_limits = () if gate is None else read_gate(gate)
    limits = Limits(float(np.deg2rad(false_deg)), float(np.deg2rad(false_roll_deg)), false_km, star_px=tolerance_px)
    found = scored(export, answers, limits=limits, least_snr=detectable_snr)
    _warn_of(answers, found.faults)
    if unknown := sorted(chosen - {name for name, _ in found.bins}):
        names = ", ".join(name for name, _ in found.bins) or "none"
        raise typer.BadParameter(f"{unknown[0]} is no bin of these frames; there are {names}", param_hint="--by")
    verdicts = judged(gate_limits, found)
    text = json.dumps(found.json | _gate_json(gate, verdicts), indent=1) + "\n"
    if output is not None:
        _write(found, text, export, answers, output, tolerance_px)
    if json_output:
        typer.echo(text, nl=False)
    else:
        _print_score(found, output, chosen)
    if gate is not None:
        _report_gate(gate, gate_limits, verdicts, as_json=json_output)


def _write(found: Score, text: str, export: Path, answers: Path, output: Path, tolerance_px: float) -> None:
    """Write the score as JSON, as plots and as a page."""
    from glstar.export.directory import REPORT, refuse_other_page  # noqa: PLC0415 - OpenCV
    from glstar.score.page import score_page  # noqa: PLC0415 - OpenCV

    refuse_other_page(output / REPORT)
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(output / "score.json", text.encode())
    draw_score(found, output / "score.png")
    write_atomically(output / REPORT, score_page(found, export, answers, star_px=tolerance_px))


def _print_score(found: Score, output: Path | None, by: frozenset[str]) -> None:
    console = console_of_width(_PIPE_COLUMNS)
    _print(found, console, by)
    if output is not None:
        typer.echo(f"{output / 'score.json'}, {output / 'score.png'}, {output / 'index.html'}")


def _gate_json(gate: Path | None, verdicts: Sequence[Verdict]) -> dict[str, object]:
    if gate is None:
        return {}
    passed = all(verdict.passed for verdict in verdicts)
    return {"gate": {"file": str(gate), "passed": passed, "verdicts": [verdict.json for verdict in verdicts]}}


def _report_gate(gate: Path, limits: Sequence[GateLimit], verdicts: Sequence[Verdict], *, as_json: bool) -> None:
    """Print the verdict on each limit, beside JSON the failed ones as errors; raises Exit(1) if one failed."""
    if (note := gate_note(limits)) is not None:
        typer.echo(f"{gate}: note: {note}", err=True)
    failed = [verdict for verdict in verdicts if not verdict.passed]
    for verdict in failed if as_json else verdicts:
        typer.echo(verdict.text, err=as_json)
    if failed:
        typer.echo(f"{gate}: {len(failed)} of {len(verdicts)} limits failed", err=True)
        raise typer.Exit(1)
    if not as_json:
        typer.echo(f"{gate}: all limits hold")


def _warn_of(answers: Path, faults: Sequence[str]) -> None:
    """Write the faults of lines that are no valid answers, each of the first ones in a line."""
    for fault in faults[:_MOST_FAULTS]:
        typer.echo(f"{answers}: {fault}; not counted", err=True)
    if len(faults) > _MOST_FAULTS:
        typer.echo(f"{answers}: {len(faults) - _MOST_FAULTS} more lines are not counted; score.json has all", err=True)


def _print(found: Score, console: Console, by: frozenset[str]) -> None:
    whole = found.summary
    console.print(
        f"{whole.frames} frames: {whole.solved} solved, {whole.refused} refused, {whole.false} false", highlight=False
    )
    table = Table("error of solved frames", "median", "rms", "90 %", "frames", box=None)
    for metric in ERRORS:
        _add_errors(table, metric, whole)
    print_table(table, pipe_columns=_PIPE_COLUMNS)
    precision, recall = whole.number("precision"), whole.number("recall")
    if precision is not None:
        of_detectable = "" if recall is None else f", recall {recall:.1%} of the detectable ones"
        console.print(f"stars identified: precision {precision:.1%}{of_detectable}", highlight=False)
    if whole.number("with_ellipse"):
        console.print(
            f"error ellipses: {whole.number('in_ellipse')} of {whole.number('with_ellipse')} contain the truth"
            f" (stated {whole.number('stated_confidence'):.0%})",
            highlight=False,
        )
    if whole.number("lost_rate") is not None:
        console.print(
            f"frames with two or more right and no wrong stars {whole.number('lost_rate'):.1%} (LOST),"
            f" score of right minus twice wrong {whole.number('kelvins'):.3f} (Kelvins)",
            highlight=False,
        )
    if found.spread is not None:
        _print_runs(found.spread, len(found.runs))
    for name, by_value in orbits_by_setting(found.runs).items():
        _print_orbits(name, by_value)
    for number, orbit in enumerate(found.orbits[:_MOST_ORBITS], 1):
        circle = (
            "" if orbit.circle_km is None else f", centre of a {orbit.radius_km:.2f} km circle {orbit.circle_km:.2f} km"
        )
        console.print(
            f"orbit {number}: {orbit.frames} positions, mean {orbit.mean_km:.2f} km off,"
            f" weighted by heading {orbit.weighted_mean_km:.2f} km{circle}",
            highlight=False,
        )
    drawn = found.drawn - by
    for name, groups in found.bins:
        if name not in drawn:
            _print_bins(name, groups)
    _print_drawn([(name, groups) for name, groups in found.bins if name in drawn])


def _add_errors(table: Table, metric: Metric, summary: Summary) -> None:
    """Add the rows of an error, one for each of its units."""
    spread = summary.spread(metric.name)
    if spread is not None:
        for unit in metric.units:
            table.add_row(unit.label, *_numbers(spread.scaled(unit.per_value)))


def _print_runs(spreads: Mapping[str, Spread | None], runs: int) -> None:
    table = Table(f"spread over {runs} runs", "median", "rms", "90 %", "count", box=None)
    for metric in RUN_METRICS:
        spread = spreads[metric.json_key]
        if spread is not None:
            table.add_row(metric.label, *_numbers(spread))
    print_table(table, pipe_columns=_PIPE_COLUMNS)


def _print_orbits(name: str, by_value: Mapping[str, Sequence[Orbit]]) -> None:
    """Print how far the means of the orbits are off, by the value of a setting: the spread says what chance does."""
    table = Table(name, "orbits", "mean, km", "10 %", "90 %", "weighted by heading, km", "10 %", "90 %", box=None)
    for label, orbits in by_value.items():
        cells = [str(len(orbits))]
        for values in ([orbit.mean_km for orbit in orbits], [orbit.weighted_mean_km for orbit in orbits]):
            cells += [f"{quantile:.3g}" for quantile in np.quantile(values, (0.5, 0.1, 0.9))]
        table.add_row(label, *cells)
    print_table(table, pipe_columns=_PIPE_COLUMNS)


def _print_bins(name: str, groups: tuple[tuple[str, Summary], ...]) -> None:
    metrics = [metric for metric in METRICS if metric.in_bins]
    labels = [metric.units[0].label for metric in metrics]
    table = Table(name, "frames", "solved", "refused", "false", *labels, box=None)
    for label, one in groups:
        medians = [_median(one, metric) for metric in metrics]
        table.add_row(label, *(str(count) for count in (one.frames, one.solved, one.refused, one.false)), *medians)
    print_table(table, pipe_columns=_PIPE_COLUMNS)


def _print_drawn(bins: list[tuple[str, tuple[tuple[str, Summary], ...]]]) -> None:
    """Print the lowest and the highest range of each setting that was drawn at random, a line for each setting."""
    if not bins:
        return
    table = Table(
        "drawn at random (--by prints all ranges)",
        "lowest",
        "solved",
        "arcsec",
        "highest",
        "solved",
        "arcsec",
        box=None,
    )
    boresight = next(metric for metric in METRICS if metric.in_bins)
    for name, groups in bins:
        cells = []
        for label, one in (groups[0], groups[-1]):
            cells += [label, f"{one.solved} of {one.frames}", _median(one, boresight)]
        table.add_row(name, *cells)
    print_table(table, pipe_columns=_PIPE_COLUMNS)


def _median(summary: Summary, metric: Metric) -> str:
    spread = summary.spread(metric.name)
    return "" if spread is None else f"{spread.scaled(metric.units[0].per_value).median:.3g}"


def _numbers(spread: Spread) -> tuple[str, str, str, str]:
    return f"{spread.median:.3g}", f"{spread.rms:.3g}", f"{spread.p90:.3g}", str(spread.count)
