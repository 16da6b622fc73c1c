"""Tables and a plot of the results of solvers."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from glstar.errors import GlstarError
from glstar.system.userinput import did_you_mean

Result = Mapping[str, Any]

_COLUMNS = (
    "set",
    "solver",
    "frames",
    "solved",
    "refused",
    "false",
    "boresight, arcsec: median, 90 %",
    "roll, arcsec: median",
    "position, km: median, 90 %",
    "run time, s: median",
)
_OUTCOMES = {"solved": "tab:blue", "refused": "0.8", "false": "tab:red"}


def _label(result: Result) -> str:
    solver = result["solver"]
    return f"{solver['name']} {solver['version']}".strip()


def _set_label(result: Result) -> str:
    return f"{result['set']['set']}-{result['set']['size']}"


def in_order(results: Sequence[Result]) -> list[Result]:
    """Return results by set, in each set those that solved most first.

    Raises GlstarError if two results of one set are of other frames.
    """
    pixels: dict[str, tuple[Result, Any]] = {}
    for result in results:
        key, sums = _set_label(result), result["set"]["pixels_sha256"]
        first, known = pixels.setdefault(key, (result, sums))
        if sums != known:
            raise GlstarError(
                f"{_label(first)} and {_label(result)} were run on different frames of {key} (version or driver): run"
                " both on one copy of the set"
            )
    return sorted(results, key=lambda one: (_set_label(one), -one["summary"]["solved"], one["summary"]["false"]))


def summary_rows(results: Sequence[Result]) -> Iterator[tuple[str, ...]]:
    """Yield the titles, then a row for each result: counts, and errors of solved frames."""
    yield _COLUMNS
    for one in in_order(results):
        summary = one["summary"]
        yield (
            _set_label(one),
            _label(one),
            *(str(summary[count]) for count in ("frames", "solved", "refused", "false")),
            _errors(summary["boresight_arcsec"], "median", "p90"),
            _errors(summary["roll_arcsec"], "median"),
            _errors(summary["position_km"], "median", "p90"),
            _errors(summary["run_time_s"], "median"),
        )


def group_rows(results: Sequence[Result], by: str) -> Iterator[tuple[str, ...]]:
    """Yield the titles, then for each result how many frames of each group it solved, and answered wrongly.

    Raises GlstarError if no result has these groups.
    """
    known = sorted({name for one in results for name in one["by"]})
    if by not in known:
        raise GlstarError(f"no result is grouped by {by}{did_you_mean(by, known)}")
    ordered = [one for one in in_order(results) if by in one["by"]]
    labels = list(dict.fromkeys(label for one in ordered for label in one["by"][by]))
    yield "set", "solver", *(f"{by} {label}" for label in labels)
    for one in ordered:
        groups = one["by"][by]
        yield _set_label(one), _label(one), *(_solved(groups.get(label)) for label in labels)


def _solved(summary: Mapping[str, Any] | None) -> str:
    if summary is None:
        return ""
    wrong = f", {summary['false']} false" if summary["false"] else ""
    return f"{summary['solved']} of {summary['frames']}{wrong}"


def _errors(spread: Mapping[str, float] | None, *quantiles: str) -> str:
    return "" if spread is None else ", ".join(f"{spread[quantile]:.3g}" for quantile in quantiles)


def markdown(rows: Iterator[tuple[str, ...]]) -> str:
    """Return a table as Markdown."""
    titles, *others = rows
    lines = [titles, tuple("---" for _ in titles), *others]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def draw_board(results: Sequence[Result], path: Path) -> None:
    """Draw the outcomes of each result as bars, a panel for each set; the suffix of the path selects the format."""
    import matplotlib as mpl  # noqa: PLC0415 - slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - slow to import

    sets: dict[str, list[Result]] = {}
    for one in in_order(results):
        sets.setdefault(_set_label(one), []).append(one)
    figure, panels = plt.subplots(
        len(sets), 1, figsize=(8, 1 + 0.45 * len(results)), squeeze=False, layout="constrained"
    )
    for (name, inside), panel in zip(sets.items(), panels[:, 0], strict=True):
        labels, left = [_label(one) for one in inside], [0.0] * len(inside)
        for outcome, colour in _OUTCOMES.items():
            shares = [one["summary"][outcome] / one["summary"]["frames"] for one in inside]
            panel.barh(labels, shares, left=left, color=colour, label=outcome)
            left = [start + share for start, share in zip(left, shares, strict=True)]
        panel.invert_yaxis()
        panel.set(title=name, xlim=(0, 1))
    panels[0, 0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.15), ncols=len(_OUTCOMES), frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
