"""The residuals that the window shows beside a real image: what ``glstar compare`` measures in it."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # OpenCV and SciPy
    from glstar.viewer.trailresiduals import ResidualRequest, TrailResiduals

__all__ = ["measure_image"]


def measure_image(request: "ResidualRequest") -> "TrailResiduals":
    """Measure the trails of a real image; see `glstar.viewer.trailresiduals.MeasureImage`.

    Parameters
    ----------
    request : ResidualRequest

    Returns
    -------
    TrailResiduals

    Raises
    ------
    ImagesError
        If no trail is found.
    ConfigError
        If images are stacked.
    """
    from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415
    from glstar.viewer.trailresiduals import TrailResiduals  # noqa: PLC0415 - OpenCV

    flight = replace(request.simulator.flight, time_offset_s=request.ahead_s)
    with GLRenderer.headless() as renderer:
        comparison = FlightComparison(
            request.simulator.with_flight(flight),
            renderer,
            [request.image],
            request.exposure,
            reference=request.reference,
            own_length=request.own_length,
        ).run()
    pairs, [image] = comparison.pairs, comparison.images
    shift_px = np.array([[pair.shift_x_px, pair.shift_y_px] for pair in pairs])
    simulated_px = np.array([[pair.x_px, pair.y_px] for pair in pairs])
    figures = _figures(comparison.summary)
    return TrailResiduals(simulated_px - shift_px, shift_px, image.predicted, figures)


def _figures(summary: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Return the paper's measures: what, and its value, simulated minus real."""
    peak, pixel, centroid, own, shift, trail = (
        summary[key] for key in ("peak", "brightest_pixel", "centroid", "centroid_in_own_region", "shift", "trail")
    )
    rows = [
        ("centroid distance", _mean_and_median(centroid)),
        ("of it noise", f"{centroid['noise_px']:.3f} px"),
        ("each in its own region", _mean_and_median(own)),
        ("a straight line there", f"mean {own['baseline_mean_px']:.3f}, median {own['baseline_median_px']:.3f} px"),
        ("shift", f"{shift['x_px']:+.3f}, {shift['y_px']:+.3f} px in the mean"),
    ]
    for label, measured in (("peak intensity", peak), ("brightest pixel", pixel)):
        if measured["pairs"]:
            rows.append(
                (
                    label,
                    f"{measured['mean_error_dn']:+.1f} DN, absolute {measured['mean_absolute_percentage_error']:.1f} %,"
                    f" {measured['magnitude_error']:.2f} mag",
                )
            )
    if summary["saturated_pairs"]:
        rows.append(("saturated, not in these", f"{summary['saturated_pairs']}"))
    if trail["pairs"]:
        rows += [
            (
                "length",
                f"{trail['length_difference_px']['mean']:+.2f} px, {trail['length_difference_percent']['mean']:+.1f} %",
            ),
            ("direction", f"{trail['direction_difference_deg']['mean']:+.2f}\N{DEGREE SIGN}"),
        ]
    return tuple(rows)


def _mean_and_median(measured: dict[str, float]) -> str:
    return f"mean {measured['mean_px']:.3f}, median {measured['median_px']:.3f} px"
