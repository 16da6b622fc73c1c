"""A comparison's files: JSON, a table of the pairs, plots like the paper's figures 8 and 9, and cutouts of pairs."""

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, fields
from io import BytesIO, StringIO
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.compare.alignment import Alignment
from glstar.compare.comparison import Comparison, by_star, column, shift_grid
from glstar.compare.page import comparison_page
from glstar.compare.pairs import Cutouts, Pair
from glstar.export.directory import REPORT, explain_disk_errors, refuse_other_page
from glstar.sky.catalogue.reading import star_label
from glstar.sky.photometry import magnitude_difference
from glstar.system.files import write_atomically

SCHEMA = "glstar-compare-2"

_DPI = 110
_REAL, _BASELINE, _SATURATED = "tab:red", "0.6", "tab:orange"
_COLOUR = "tab:blue"
_BINS = 40


# Titles of the plots on the page.
_TITLES = {
    "compare.png": "Measured against simulated",
    "best.png": "Pairs with the smallest centroid distance",
    "worst.png": "Pairs with the largest centroid distance beyond the noise",
}


def draw_plots(comparison: Comparison) -> bytes:
    """Return a PNG with plots of all pairs.

    Peak intensities, measured against simulated, of the three stars found most often and of all stars (the paper's
    figure 8); centroid distances beside the distances on a straight line (figure 9); magnitudes, lengths, directions,
    shifts.
    """
    figure = Figure(figsize=(15, 13.2))
    FigureCanvasAgg(figure)
    # Fixed axes, because matplotlib's automatic layout is slower than all drawing.
    rectangles = [
        (0.055 + 0.325 * column_, 0.68 - 0.305 * row, 0.275, 0.225) for row in range(3) for column_ in range(3)
    ]
    axes = [figure.add_axes(rectangle) for rectangle in rectangles]
    pairs = comparison.pairs
    # Stars with the most unsaturated pairs: saturated ones have no brightness.
    stars = sorted(by_star(pairs), key=lambda star: -star["peak"]["pairs"])[:3]
    for number in range(3):
        if number < len(stars):
            star = stars[number]["catalogue"], stars[number]["star_id"]
            own = [pair for pair in pairs if (pair.catalogue, pair.star_id) == star]
            _one_star(axes[number], stars[number], own)
        else:
            axes[number].set_axis_off()
    _intensities(axes[3], pairs)
    _centroids(axes[4], comparison)
    _magnitudes(axes[5], pairs)
    _lengths(axes[6], pairs)
    _directions(axes[7], pairs)
    _shifts(axes[8], pairs)
    for each in axes:
        each.tick_params(labelsize=8)
    summary = comparison.summary
    figure.suptitle(
        f"{len(pairs)} stars paired on {_counted(len(comparison.images), 'image')}, {len(comparison.left_out)} left"
        f" out; differences are simulated minus real\ncentroid distance: mean {summary['centroid']['mean_px']:.3f} px,"
        f" median {summary['centroid']['median_px']:.3f} px",
        fontsize=12,
        y=0.985,
    )
    return _png(figure)


def draw_pairs(shown: Sequence[tuple[Pair, Cutouts]], title: str) -> bytes:
    """Return a PNG of pairs, two per row: real, simulated, and real minus simulated."""
    rows = -(-len(shown) // 2)
    figure = Figure(figsize=(15, 0.7 + 2.3 * rows))
    FigureCanvasAgg(figure)
    high = 1 / (rows + 0.29)
    for number, (pair, picture) in enumerate(shown):
        left, bottom = 0.5 * (number % 2), 1 - high * (0.29 + number // 2 + 1)
        _one_pair(figure, pair, picture, left, bottom, high)
    figure.suptitle(title, fontsize=12, y=1 - 0.05 * high)
    return _png(figure)


def _one_pair(figure: Figure, pair: Pair, picture: Cutouts, left: float, bottom: float, high: float) -> None:
    """Draw a pair with one grey scale; the difference is red where the real image is brighter."""
    top_dn = max(float(np.percentile(picture.simulated, 99.5)), float(np.percentile(picture.real, 99.5)), 1.0)
    difference = picture.real - picture.simulated
    kinds: list[tuple[str, NDArray[np.float32], dict[str, Any]]] = [
        ("real", picture.real, {"cmap": "gray", "vmin": -0.1 * top_dn, "vmax": top_dn}),
        ("simulated", picture.simulated, {"cmap": "gray", "vmin": -0.1 * top_dn, "vmax": top_dn}),
        ("real - simulated", difference, {"cmap": "RdBu_r", "vmin": -top_dn, "vmax": top_dn}),
    ]
    for column_, (title, image, style) in enumerate(kinds):
        axes = figure.add_axes((left + 0.012 + 0.158 * column_, bottom + 0.02 * high, 0.15, 0.7 * high))
        axes.imshow(image, interpolation="nearest", **style)
        axes.set_anchor("N")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(title, fontsize=8, pad=2)
    title = pair.name or (star_label(pair.catalogue, pair.star_id) if pair.star_id else "a star")
    if np.isfinite(pair.vmag):
        title += f", {pair.vmag:.2f} mag"
    figure.text(
        left + 0.012,
        bottom + 0.83 * high,
        f"{title}, at ({pair.x_px:.0f}, {pair.y_px:.0f}) on {pair.image}\ncentroid distance {pair.centroid_px:.3f} px"
        f" (noise {pair.noise_px:.3f}), peak {pair.peak_real_dn:.0f} against {pair.peak_simulated_dn:.0f} DN",
        fontsize=8.5,
    )


def _one_star(axes: Any, star: dict[str, Any], own: Sequence[Pair]) -> None:
    _against(axes, own)
    peak = star["peak"]
    name = star["name"] or star_label(star["catalogue"], star["star_id"])
    title = f"{name}, {star['vmag']:.2f} mag, {_counted(star['found'], 'image')}"
    if peak["pairs"]:
        title += f"\nmean error {peak['mean_error_dn']:+.1f} DN, {peak['mean_absolute_percentage_error']:.1f} %"
    axes.set_title(title, fontsize=9)


def _against(axes: Any, pairs: Sequence[Pair]) -> None:
    real, simulated = column(pairs, "peak_real_dn"), column(pairs, "peak_simulated_dn")
    saturated = np.array([pair.saturated for pair in pairs], dtype=np.bool_)
    axes.plot(real[~saturated], simulated[~saturated], "x", color=_REAL, ms=5)
    axes.plot(real[saturated], simulated[saturated], "^", color=_SATURATED, ms=4, label="saturated")
    limit = 1.08 * max(real.max(), simulated.max())
    axes.plot([0, limit], [0, limit], "k-", lw=0.8)
    axes.set_xlim(0, limit)
    axes.set_ylim(0, limit)
    axes.set_xlabel("measured peak, DN", fontsize=8)
    axes.set_ylabel("simulated peak, DN", fontsize=8)
    axes.grid(visible=True, alpha=0.3)
    if saturated.any():
        axes.legend(fontsize=7)


def _intensities(axes: Any, pairs: Sequence[Pair]) -> None:
    _against(axes, pairs)
    low = 0.8 * max(min(column(pairs, "peak_real_dn").min(), column(pairs, "peak_simulated_dn").min()), 0.1)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(low, axes.get_xlim()[1])
    axes.set_ylim(low, axes.get_ylim()[1])
    axes.set_title(f"all stars, {len(pairs)} pairs", fontsize=9)


def _centroids(axes: Any, comparison: Comparison) -> None:
    pairs, own = comparison.pairs, comparison.summary["centroid_in_own_region"]
    shape, baseline = column(pairs, "shape_px"), column(pairs, "baseline_px")
    edges = np.linspace(0, max(float(np.percentile(np.r_[shape, baseline], 98)), 1e-3), _BINS + 1)
    axes.hist(baseline.clip(max=edges[-1]), edges, color=_BASELINE, label=_label("straight line", baseline))
    axes.hist(
        shape.clip(max=edges[-1]), edges, histtype="step", color=_COLOUR, lw=1.6, label=_label("simulated", shape)
    )
    axes.set_xlabel("distance of centroids, each in its own region, px", fontsize=8)
    axes.set_ylabel("pairs", fontsize=8)
    axes.set_title(f"eq. (46): {own['reduction_percent']:.0f} % nearer than a straight line", fontsize=9)
    axes.legend(fontsize=7)


def _label(kind: str, values: Float) -> str:
    return f"{kind}: mean {values.mean():.2f}, median {np.median(values):.2f} px"


def _magnitudes(axes: Any, pairs: Sequence[Pair]) -> None:
    lone = [pair for pair in pairs if not pair.saturated]
    error_mag = magnitude_difference(column(lone, "peak_simulated_dn") / column(lone, "peak_real_dn"))
    if len(error_mag):
        axes.hist(error_mag, _BINS, color=_COLOUR)
        axes.set_title(f"magnitudes: {error_mag.mean():+.2f} in the mean, scatter {error_mag.std():.2f}", fontsize=9)
    axes.axvline(0, color="k", lw=0.8)
    axes.set_xlabel("simulated fainter by, mag", fontsize=8)
    axes.set_ylabel("pairs", fontsize=8)


def _lengths(axes: Any, pairs: Sequence[Pair]) -> None:
    error_px = column(pairs, "length_difference_px")
    _by_length(axes, pairs, error_px, "longer than the real one by, px")
    axes.set_title(f"trail lengths: {_middle(error_px)} px in the median", fontsize=9)


def _directions(axes: Any, pairs: Sequence[Pair]) -> None:
    error_deg = np.rad2deg(column(pairs, "direction_difference_rad"))
    _by_length(axes, pairs, error_deg, "turned clockwise by, deg")
    axes.set_title(f"trail directions: {_middle(error_deg)} deg in the median", fontsize=9)


def _by_length(axes: Any, pairs: Sequence[Pair], errors: Float, label: str) -> None:
    axes.plot(column(pairs, "length_px"), errors, ".", color=_COLOUR, ms=4)
    axes.axhline(0, color="k", lw=0.8)
    axes.set_xlabel("length of the simulated trail, px", fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.grid(visible=True, alpha=0.3)


def _middle(values: Float) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):+.2f}" if len(known) else "unknown"


def _shifts(axes: Any, pairs: Sequence[Pair]) -> None:
    grid = shift_grid(pairs)
    # Dots show single pairs, whose shifts are mostly noise.
    axes.plot(column(pairs, "x_px"), column(pairs, "y_px"), ".", color=_BASELINE, ms=1.5, alpha=0.5)
    size_px = np.linalg.norm(grid.shift_px, axis=1)
    # The longest significant arrow is as long as its cell.
    longest_px = max(float(size_px[grid.clear if grid.clear.any() else slice(None)].max()), 1e-3)
    key_px = float(f"{longest_px:.1g}")
    for which, colour in ((~grid.clear, _BASELINE), (grid.clear, _COLOUR)):
        (x, y), (u, v) = grid.middle_px[which].T, grid.shift_px[which].T
        # Longer arrows are due to noise and are cut off.
        cut = np.minimum(1, longest_px / np.maximum(size_px[which], 1e-9))
        arrows = axes.quiver(
            x, y, cut * u, cut * v, angles="xy", scale_units="xy", scale=longest_px / grid.cell_px,
            color=colour, width=0.005, minlength=0,
        )  # fmt: skip
    axes.quiverkey(arrows, 0.84, 1.045, key_px, f"{key_px:g} px", labelpos="E", fontproperties={"size": 8})
    x, y = column(pairs, "x_px"), column(pairs, "y_px")
    half_x_px, half_y_px = (max(float(np.ptp(each)) / 2 + 0.6 * grid.cell_px, 2 * grid.cell_px) for each in (x, y))
    axes.set_xlim((x.min() + x.max()) / 2 - half_x_px, (x.min() + x.max()) / 2 + half_x_px)
    axes.set_ylim((y.min() + y.max()) / 2 + half_y_px, (y.min() + y.max()) / 2 - half_y_px)
    axes.set_aspect("equal")
    axes.set_title("shift, simulated minus real", fontsize=9, loc="left")
    axes.set_xlabel(f"px; means over {grid.cell_px:.0f} px by SNR²; grey: within their noise", fontsize=8)


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' * (number != 1)}"


def _png(figure: Figure) -> bytes:
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI, metadata={"Software": "glstar"}, pil_kwargs={"compress_level": 4})
    return drawn.getvalue()


def comparison_json(comparison: Comparison, **about: Any) -> dict[str, Any]:
    """Return a comparison as the content of ``compare.json``; unknown values are None; `about` has more entries."""
    kinds = Counter(image.kind for image in comparison.left_out)
    facts = {
        "schema": SCHEMA,
        **about,
        "time_sources": comparison.time_sources,
        "notes": list(comparison.notes),
        "pairs": len(comparison.pairs),
        "summary": comparison.summary,
        "alignment": None if comparison.alignment is None else alignment_json(comparison.alignment),
        "stars": comparison.stars,
        "images": [
            asdict(image) | {"turn_rad": None if image.turn_rad is None else list(image.turn_rad)}
            for image in comparison.images
        ],
        "left_out": {"count": len(comparison.left_out), "kinds": dict(kinds.most_common())},
        "left_out_images": [asdict(image) for image in comparison.left_out],
    }
    return dict(_finite(facts))


def alignment_json(alignment: Alignment) -> dict[str, Any]:
    """Return an alignment, ready to be written as JSON; angles in degrees."""
    mount = alignment.mount
    angles = {"yaw_deg": mount.yaw_rad, "pitch_deg": mount.pitch_rad, "roll_deg": mount.roll_rad}
    return {
        "images": alignment.images,
        "stars": alignment.stars,
        "images_set_aside": alignment.set_aside,
        "time_offset_change_s": -alignment.delay_s if alignment.fitted_time else None,
        "time_offset_std_s": alignment.delay_std_s,
        "readout_s": alignment.readout_s if alignment.fitted_readout else None,
        "readout_std_s": alignment.readout_std_s,
        "mount": {key: float(np.rad2deg(angle)) for key, angle in angles.items()} | {"reading": mount.reading},
        "camera_turn_deg": np.rad2deg(alignment.turn_rad).tolist() if alignment.fitted_mount else None,
        "camera_turn_std_deg": np.rad2deg(alignment.turn_std_rad).tolist(),
        "attitude_std_deg": float(np.rad2deg(alignment.attitude_std_rad)),
        "notes": list(alignment.notes),
    }


def comparison_table(comparison: Comparison) -> str:
    """Return the pairs as CSV: the attributes of `Pair`, one pair per line, angles in degrees, empty if unknown."""
    written = StringIO()
    table = csv.writer(written, lineterminator="\n")
    names = [field.name for field in fields(Pair)]
    table.writerow([re.sub("_rad$", "_deg", name) for name in names])
    for pair in comparison.pairs:
        values = ((name, getattr(pair, name)) for name in names)
        table.writerow([_cell(degrees(value) if name.endswith("_rad") else value) for name, value in values])
    return written.getvalue()


def write_comparison(comparison: Comparison, directory: Path, **about: Any) -> list[Path]:
    """Write a comparison's files, each atomically.

    `directory`: created if it does not exist; `about`: more entries of ``compare.json``.  Returns the paths of
    ``pairs.csv``, ``compare.png``, ``best.png``, ``worst.png``, the page ``index.html`` and ``compare.json``.  Raises
    ExportError if they cannot be written, or another program's page is there.
    """
    facts = json.dumps(comparison_json(comparison, **about), indent=1, allow_nan=False) + "\n"
    plots = {
        "compare.png": draw_plots(comparison),
        "best.png": draw_pairs(comparison.best, "the pairs with the smallest centroid distance"),
        "worst.png": draw_pairs(comparison.worst, "the pairs with the largest centroid distance beyond the noise"),
    }
    shown = {_TITLES[name]: png for name, png in plots.items()}
    contents = {
        "pairs.csv": comparison_table(comparison).encode(),
        **plots,
        REPORT: comparison_page(comparison, shown, {name: str(value) for name, value in about.items()}),
        # Written last: if it exists, so do the others.
        "compare.json": facts.encode(),
    }
    with explain_disk_errors(directory):
        refuse_other_page(directory / REPORT)
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            write_atomically(directory / name, content)
    return [directory / name for name in contents]


def _finite(value: Any) -> Any:
    """Return the value with None in place of NaN."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return f"{value:.6g}" if isfinite(value) else ""
    return value
