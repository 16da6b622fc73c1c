"""The tables of metrics against the manual and score.json."""

from collections.abc import Sequence

from glstar.score.metrics import METRICS, Metric, summarized
from glstar.score.scoring import RUN_METRICS, RunMetric
from glstar.system.resources import manual_pages

PAGE = manual_pages()["score"].read_text(encoding="utf-8")


def rows(metrics: Sequence[Metric | RunMetric]) -> str:
    lines = [f"| `{metric.json_key}` | {metric.text} |\n" for metric in metrics]
    return "".join(["| key | meaning |\n|---|---|\n", *lines, "\n"])


def test_the_manual_lists_the_metrics_of_frames_and_of_runs() -> None:
    assert rows(METRICS) in PAGE
    assert rows(RUN_METRICS) in PAGE


def test_a_summary_without_frames_has_every_metric() -> None:
    summary = summarized([])

    assert list(summary.json) == [
        "frames",
        "solved",
        "refused",
        "false",
        *(metric.json_key for metric in METRICS),
    ]
    assert {summary.json[key] for key in ("boresight_arcsec", "precision", "kelvins")} == {None}
