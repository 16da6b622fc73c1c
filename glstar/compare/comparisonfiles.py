"""A comparison's files: JSON, a table of the pairs, plots and cutouts of pairs."""

import csv
import json
import re
from collections import Counter
from dataclasses import asdict, fields
from io import StringIO
from math import degrees, isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np

from glstar.compare.alignment import Alignment
from glstar.compare.comparison import Comparison
from glstar.compare.comparisonreport import draw_pairs, draw_plots
from glstar.compare.pairs import Pair
from glstar.export.diskerrors import explain_disk_errors
from glstar.system.durable import write_atomically

__all__ = ["SCHEMA", "comparison_json", "comparison_table", "write_comparison"]

SCHEMA: Final = "glstar-compare-2"


def comparison_json(comparison: Comparison, **about: Any) -> dict[str, Any]:
    """Return a comparison, ready to be written as JSON.

    Parameters
    ----------
    comparison : Comparison
    **about
        Additional entries, placed first.

    Returns
    -------
    dict
        ``schema, images, summary, stars, alignment, left_out``; unknown values are null.
    """
    kinds = Counter(one.kind for one in comparison.left_out)
    facts = {
        "schema": SCHEMA,
        **about,
        "time_sources": comparison.time_sources,
        "pairs": len(comparison.pairs),
        "summary": comparison.summary,
        "alignment": None if comparison.alignment is None else alignment_json(comparison.alignment),
        "stars": comparison.stars,
        "images": [
            asdict(one) | {"turn_rad": None if one.turn_rad is None else list(one.turn_rad)}
            for one in comparison.images
        ],
        "left_out": {"count": len(comparison.left_out), "kinds": dict(kinds.most_common())},
        "left_out_images": [asdict(one) for one in comparison.left_out],
    }
    finite: dict[str, Any] = _finite(facts)
    return finite


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
    """Return the pairs as CSV, one per line, in the order of the images.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    str
        The columns are the attributes of `Pair`, angles in degrees; empty if unknown.
    """
    written = StringIO()
    table = csv.writer(written, lineterminator="\n")
    names = [field.name for field in fields(Pair)]
    table.writerow([re.sub("_rad$", "_deg", name) for name in names])
    for pair in comparison.pairs:
        given = ((name, getattr(pair, name)) for name in names)
        table.writerow([_cell(degrees(value) if name.endswith("_rad") else value) for name, value in given])
    return written.getvalue()


def write_comparison(comparison: Comparison, directory: Path, **about: Any) -> list[Path]:
    """Write a comparison's files, each atomically.

    Parameters
    ----------
    comparison : Comparison
    directory : Path
        Created if it does not exist.
    **about
        Additional entries of ``compare.json``.

    Returns
    -------
    list of Path
        ``compare.json``, ``pairs.csv``, ``compare.png``, ``best.png``, ``worst.png``.

    Raises
    ------
    ExportError
        If they cannot be written.
    """
    facts = json.dumps(comparison_json(comparison, **about), indent=1, allow_nan=False) + "\n"
    contents = {
        "pairs.csv": comparison_table(comparison).encode(),
        "compare.png": draw_plots(comparison),
        "best.png": draw_pairs(comparison.best, "the pairs with the smallest centroid distance"),
        "worst.png": draw_pairs(comparison.worst, "the pairs with the largest centroid distance beyond the noise"),
        # Written last: if it exists, so do the others.
        "compare.json": facts.encode(),
    }
    with explain_disk_errors(directory):
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
