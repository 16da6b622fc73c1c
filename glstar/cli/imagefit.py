"""The fit of clock and mount that the window offers: what ``glstar compare --fit-time-offset --fit-mount`` does."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from glstar.errors import ImagesError

if TYPE_CHECKING:  # OpenCV and SciPy
    from glstar.compare import Alignment, FlightComparison
    from glstar.viewer.imagefit import FitRequest, FitResult

__all__ = ["fit_images"]

# A mount with a larger standard error is not determined, deg.
_LARGEST_ERROR_DEG = 1.0
_BY_HAND = "set clock or mount by hand first"


def fit_images(request: "FitRequest", on_step: Callable[[int, int], None]) -> "FitResult":
    """Fit clock and mount to real images; see `glstar.viewer.imagefit.FitImages`.

    Parameters
    ----------
    request : FitRequest
    on_step : callable
        Called with the number of images done, and of all.

    Returns
    -------
    FitResult

    Raises
    ------
    ImagesError
        If the images determine neither the clock nor the mount.
    ConfigError
        If images are stacked.
    """
    from glstar.compare import FlightComparison  # noqa: PLC0415 - SciPy
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415
    from glstar.viewer.imagefit import FitResult  # noqa: PLC0415 - OpenCV

    with GLRenderer.headless() as renderer:
        job = FlightComparison(
            request.simulator,
            renderer,
            request.images,
            request.exposure,
            reference=request.reference,
            own_length=request.own_length,
        )
        fitted = _aligned(job, request, on_step)
        comparison = job.run(fitted, on_step=on_step)
    centroid = comparison.summary["centroid"]
    return FitResult(
        clock_change_s=-fitted.delay_s if fitted.fitted_time else None,
        clock_std_s=fitted.delay_std_s if fitted.fitted_time else None,
        mount_keys=fitted.mount_keys if fitted.fitted_mount else {},
        turn_rad=tuple(fitted.turn_rad.tolist()),
        turn_std_rad=tuple(fitted.turn_std_rad.tolist()),
        images=len(comparison.images),
        of=len(request.images),
        stars=fitted.stars,
        centroid_mean_px=centroid["mean_px"],
        centroid_median_px=centroid["median_px"],
        notes=fitted.notes,
    )


def _aligned(job: "FlightComparison", request: "FitRequest", on_step: Callable[[int, int], None]) -> "Alignment":
    """Return the fit; raise if the images determine nothing."""
    folder = request.images[0].path.parent
    fitted = job.align(fit_time=request.fits_time, fit_mount=request.fits_mount, on_step=on_step)
    if fitted is None:
        raise ImagesError(folder, f"no image shows the trails that the flight predicts; {_BY_HAND}")
    error_deg = float(np.rad2deg(fitted.turn_std_rad.max())) if fitted.fitted_mount else 0.0
    if not error_deg <= _LARGEST_ERROR_DEG:
        found = f"{fitted.stars} stars in {fitted.images} images"
        message = f"{found} determine the mount only to {error_deg:.1f} deg: other stars, by chance; {_BY_HAND}"
        raise ImagesError(folder, message)
    if not (fitted.fitted_time or fitted.fitted_mount):
        raise ImagesError(folder, "; ".join(fitted.notes) or "the images determine neither the clock nor the mount")
    return fitted
