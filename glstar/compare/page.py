"""The page of a comparison: ``index.html`` with its numbers, plots and stars, for a browser without a network."""

from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np

from glstar.compare.comparison import Comparison
from glstar.export.report.charts import Point, curve
from glstar.export.report.html import columns, evenly, page, paragraph, picture, section, table

# Stars and images that are listed, and images of a curve.
_MOST_ROWS, _MOST_POINTS = 100, 2000


def comparison_page(comparison: Comparison, plots: Mapping[str, bytes], facts: Mapping[str, str]) -> bytes:
    """Return the page of a comparison; `plots`: PNGs by their titles, `facts`: what was compared."""
    rows = [("images", str(len(comparison.images))), ("stars paired on them", str(len(comparison.pairs)))]
    sections = [
        section(
            "Result",
            paragraph("Real images against simulated ones, by glstar; differences are simulated minus real."),
            table(("", ""), [*facts.items(), *rows, *comparison.figures]),
            *(paragraph(note) for note in comparison.notes),
        ),
        *(section(title, picture(title, png)) for title, png in plots.items()),
        section("By image", columns("curves", _curves(comparison))),
        section("Stars", table(("star", "V", "images", "mean centroid distance, px"), _stars(comparison))),
    ]
    if comparison.left_out:
        left_out = [(one.file, one.reason) for one in comparison.left_out[:_MOST_ROWS]]
        title = f"Images left out: {len(comparison.left_out)}"
        sections.append(section(title, table(("image", "reason"), left_out), is_closed=True))
    return page("Real and simulated images", sections, {"frames": []})


def _stars(comparison: Comparison) -> Iterable[tuple[str, ...]]:
    for star in comparison.stars[:_MOST_ROWS]:
        name = star["name"] or f"{star['catalogue']} {star['star_id']}"
        yield name, f"{star['vmag']:.2f}", str(star["found"]), f"{star['centroid_mean_px']:.3f}"


def _curves(comparison: Comparison) -> Iterable[str]:
    """Return the mean centroid distance and the number of pairs of each image, by its number in the comparison."""
    of_image: dict[str, list[float]] = defaultdict(list)
    for pair in comparison.pairs:
        of_image[pair.image].append(pair.centroid_px)
    distances = list(of_image.values())
    chosen = evenly(len(distances), _MOST_POINTS)
    means: list[Point] = [(None, k, float(np.mean(distances[k])), "") for k in chosen]
    counts: list[Point] = [(None, k, float(len(distances[k])), "") for k in chosen]
    if not chosen:
        return []
    return [curve("mean centroid distance, px", means), curve("stars paired", counts)]
