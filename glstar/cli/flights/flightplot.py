"""Plots of a flight: roll, pitch, yaw, rates and gaps over time."""

from io import BytesIO
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from glstar.errors import ExportError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion
from glstar.telemetry import Survey

Float = NDArray[np.float64]

_FORMATS: Final = (".png", ".svg", ".pdf")
_WRAP_DEG: Final = 180.0


def plot_flight(flight: Flight, found: Survey, path: Path) -> None:
    """Plot Euler angles and turn rates of a flight, with shaded gaps.

    `path`: the file to write: .png, .svg or .pdf.  Raises ExportError if the file has another suffix or cannot be
    written.
    """
    from glstar.export.directory import explain_disk_errors  # noqa: PLC0415 - OpenCV, when it is needed
    from glstar.system.files import write_atomically  # noqa: PLC0415 - OpenCV, when it is needed

    if path.suffix.lower() not in _FORMATS:
        raise ExportError(path, f"is not a supported image format; it must end with {', '.join(_FORMATS)}")
    track = flight.attitude
    t = track.utc_s - track.first_s
    figure = Figure(figsize=(12, 8), layout="constrained")
    FigureCanvasAgg(figure)
    angles, rates = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for name, angle_rad in zip(("roll", "pitch", "yaw"), euler_from_quaternion(track.q_body_ned), strict=True):
        angles.plot(t, _unbroken(np.rad2deg(angle_rad)), lw=0.8, label=name)
    rate_utc_s, rate_rad_per_s = track.rates()
    for name, rate in zip(("about forward", "about right", "about down"), np.rad2deg(rate_rad_per_s).T, strict=True):
        rates.plot(rate_utc_s - track.first_s, rate, lw=0.8, label=name)
    for axes, label in ((angles, "deg"), (rates, "deg/s")):
        for gap in track.gaps:
            axes.axvspan(gap.start_utc_s - track.first_s, gap.stop_utc_s - track.first_s, color="0.8", lw=1)
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="upper right", ncols=3)
    angles.set_yticks(np.arange(-180, 181, 60))
    rates.set_xlabel(f"s from the first attitude{'' if found.utc_first is None else f', {found.utc_first}'}")
    gaps = {0: "no gaps", 1: "1 gap, shaded"}.get(len(track.gaps), f"{len(track.gaps)} gaps, shaded")
    angles.set_title(f"{flight.name}: {flight.attitude_source}, {gaps}")
    with explain_disk_errors(path):
        drawn = BytesIO()
        # Without a date, and with fixed names in SVG: equal flights give equal files.
        dated = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}[path.suffix.lower()]
        with rc_context({"svg.hashsalt": "glstar"}):
            figure.savefig(drawn, format=path.suffix[1:].lower(), dpi=110, metadata=dated)
        write_atomically(path, drawn.getvalue())


def _unbroken(angle_deg: Float) -> Float:
    """Return an angle with NaN where it wraps around, so that no line crosses the plot."""
    broken = angle_deg.copy()
    broken[1:][np.abs(np.diff(angle_deg)) > _WRAP_DEG] = np.nan
    return broken
