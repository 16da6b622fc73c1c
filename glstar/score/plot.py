"""A score as a page of plots."""

from pathlib import Path
from typing import Any

import numpy as np

from glstar.camera.model import AttitudeError
from glstar.score.frames import Outcome
from glstar.score.metrics import BINS, Bin
from glstar.score.scoring import Score
from glstar.sky.place.apparent import ARCSEC_RAD

_COLOURS = {Outcome.SOLVED: "tab:blue", Outcome.FALSE: "tab:red"}


def draw_score(score: Score, path: Path) -> None:
    """Draw errors of attitude and position as an image file; `path`: output file; its suffix selects the format."""
    import matplotlib as mpl  # noqa: PLC0415 - slow to import

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - slow to import

    shown = [one for one in BINS if one.is_plotted and len({one.of(frame) for frame in score.frames}) > 1]
    rows = 2 + (len(shown) + 1) // 2
    figure, axes = plt.subplots(rows, 2, figsize=(11, 4 * rows), layout="constrained")
    boresight, roll, ground, outcome, *others = axes.flat
    for condition, axis in zip(shown, others, strict=False):
        _draw_condition(score, condition, axis)
    for axis in others[len(shown) :]:
        axis.set_axis_off()
    for kind, colour in _COLOURS.items():
        frames = [one for one in score.frames if one.outcome == kind]
        for axis, part in ((boresight, "boresight_rad"), (roll, "roll_rad")):
            errors = [(one.truth.trail_length_px, one.attitude) for one in frames if one.attitude is not None]
            axis.plot(
                [x for x, _ in errors], [_arcsec(error, part) for _, error in errors], ".", color=colour, label=kind
            )
        fixes = [one.position for one in frames if one.position is not None]
        ground.plot([fix.east_km for fix in fixes], [fix.north_km for fix in fixes], ".", color=colour, label=kind)
    floors = [(one.truth.trail_length_px, one.floor) for one in score.frames if one.floor is not None]
    boresight.plot(
        [x for x, _ in floors],
        [_arcsec(error, "boresight_rad") for _, error in floors],
        "_",
        color="0.6",
        label="plain fit",
    )
    boresight.set(xlabel="trail length, px", ylabel="boresight error, arcsec", yscale="log")
    roll.set(xlabel="trail length, px", ylabel="|roll error|, arcsec", yscale="log")
    ground.set(xlabel="east, km", ylabel="north, km", aspect="equal", title="position errors")
    ground.axhline(0, color="0.8", zorder=0)
    ground.axvline(0, color="0.8", zorder=0)
    counts = (score.summary.solved, score.summary.refused, score.summary.false)
    outcome.bar(["solved", "refused", "false"], counts, color=["tab:blue", "0.6", "tab:red"])
    outcome.set(ylabel="frames")
    for axis in (boresight, ground):
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_condition(score: Score, condition: Bin, axis: Any) -> None:
    """Draw errors of the optical axis against a condition; refused frames at the lower edge."""
    values = [(frame, value) for frame in score.frames if (value := condition.of(frame)) is not None]
    for kind, colour in _COLOURS.items():
        errors = [
            (value, _arcsec(frame.attitude, "boresight_rad"))
            for frame, value in values
            if frame.outcome == kind and frame.attitude is not None
        ]
        axis.plot([x for x, _ in errors], [y for _, y in errors], ".", color=colour, label=kind)
    refused = [value for frame, value in values if frame.outcome == Outcome.REFUSED]
    axis.plot(refused, [0.02] * len(refused), "|", color="0.6", transform=axis.get_xaxis_transform(), label="refused")
    axis.set(xlabel=condition.name, ylabel="boresight error, arcsec", yscale="log")


def _arcsec(error: AttitudeError, part: str) -> float:
    # A logarithmic axis has no zero.
    return max(abs(float(getattr(error, part))) / ARCSEC_RAD, float(np.finfo(np.float32).tiny))
