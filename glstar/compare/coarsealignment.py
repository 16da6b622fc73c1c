"""Start values of the alignment, by cross-correlation of binned images with the predicted signal.

The fit of an alignment is linearised, so it starts within a few pixels of the solution.  Here the brightest stars are
rendered along their paths for a grid of clock offsets, and the common shift of all images gives the mount.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.compare.backgroundsubtraction import SubtractedImage
from glstar.compare.pairs import CrossCorrelation, coarse_side, shrunk
from glstar.render.simulator import Simulator

__all__ = ["likely_start"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _CoarseSearch:
    """The search for a start value, on binned images.

    Attributes
    ----------
    side_px : int
        Longer side of the binned images, px.
    images : int
        Number of images, evenly chosen.
    samples : int
        Samples along each star path.
    step_s : float
        Step of the clock offset, s.
    max_offsets : int
        Number of steps in each direction of time.
    stars : int
        Number of stars, the brightest.
    """

    side_px: int = 192
    images: int = 6
    samples: int = 24
    step_s: float = 0.0125
    max_offsets: int = 200
    stars: int = 150


_COARSE: Final = _CoarseSearch()


def likely_start(
    images: Sequence[tuple[Exposure, SubtractedImage]],
    simulator: Simulator,
    *,
    search_px: float,
    search_s: float,
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[Float, float]:
    """Return start values of the mount and the clock, by cross-correlation of binned images.

    Parameters
    ----------
    images : sequence of (Exposure, SubtractedImage)
        Images; six of them are used.
    simulator : Simulator
    search_px : float
        The largest common shift of the images, px.
    search_s : float
        The largest absolute delay, s; 0 to search the mount only.
    on_step : callable
        Called with the number of delays tried, and of all.

    Returns
    -------
    turn_rad : (3,) float64
        A rotation of the camera about its right, down and forward axes, rad.
    delay_s : float
    """
    report = on_step or (lambda *_: None)
    chosen = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, _COARSE.images).astype(int))]
    side = coarse_side(chosen[0][1].above_dn.shape, _COARSE.side_px)
    sigma_px = simulator.sensor.effective_sigma_px
    correlations = [CrossCorrelation(shrunk(sky.significance(sigma_px), side), search_px / side) for _, sky in chosen]
    steps = min(int(np.ceil(search_s / _COARSE.step_s)), _COARSE.max_offsets)
    offsets = np.linspace(-search_s, search_s, 2 * steps + 1).tolist() if steps else [0.0]
    track = simulator.flight.attitude
    best = -np.inf, np.zeros(2), 0.0
    for number, delay_s in enumerate(offsets):
        total: NDArray[np.float32] | None = None
        for (exposure, sky), correlation in zip(chosen, correlations, strict=True):
            moved = replace(exposure, start_utc_s=exposure.start_utc_s + delay_s)
            if moved.start_utc_s < track.first_s or moved.stop_utc_s > track.last_s:
                continue
            here = correlation.to(_density(simulator, moved, sky, side))
            total = here if total is None else total + here
        report(number + 1, len(offsets))
        if total is not None and total.max() > best[0]:
            best = float(total.max()), correlations[0].best(total) * side, delay_s
    # The shift gives the rotations about the right and down axes; the fit finds the one about the boresight.
    _, (x_px, y_px), delay_s = best
    camera = simulator.camera
    return np.array([y_px / camera.fy_px, -x_px / camera.fx_px, 0.0]), delay_s


def _density(simulator: Simulator, exposure: Exposure, sky: SubtractedImage, side: int) -> NDArray[np.float32]:
    """Return the signal of the brightest stars along their paths, in units of the noise, binned."""
    sensor, camera = simulator.sensor, simulator.camera
    pointing = simulator.pointing(exposure.sub_utc_s(_COARSE.samples))
    middle = pointing.boresight_eq[len(pointing) // 2]
    within = np.flatnonzero(simulator.stars.direction_eq @ middle > np.cos(min(camera.field_radius_rad * 1.3, np.pi)))
    within = within[np.argsort(simulator.stars.camera_mag[within], kind="stable")][: _COARSE.stars]
    xy = camera.project(pointing.to_camera(simulator.stars.direction_eq[within])) / side
    flux = sensor.flux_dn(sensor.peak_dn(simulator.stars.camera_mag[within], exposure.span_s)) / _COARSE.samples
    per_column_s, per_row_s, first_s = exposure.opening_s(camera.width_px, camera.height_px)
    since_s = exposure.sub_utc_s(_COARSE.samples)[:, np.newaxis] - exposure.start_utc_s
    open_for_s = since_s - first_s - side * (per_column_s * xy[..., 0] + per_row_s * xy[..., 1])
    on_image = np.isfinite(xy).all(axis=-1) & (open_for_s >= 0) & (open_for_s <= exposure.duration_s)
    y_px, x_px = xy[..., 1][on_image], xy[..., 0][on_image]
    edges = [np.arange(length // side + 1) - 0.5 for length in sky.above_dn.shape]
    weights = np.broadcast_to(flux, xy.shape[:2])[on_image]
    light = np.histogram2d(y_px, x_px, bins=edges, weights=weights)[0].astype(np.float32)
    sigma = max(sensor.effective_sigma_px / side, 0.8)
    smooth = cv2.GaussianBlur(light, (0, 0), float(np.hypot(sigma, sensor.effective_sigma_px / side)))
    return np.asarray(
        smooth * (2 * np.sqrt(np.pi) * sensor.effective_sigma_px / (side**2 * sky.usual_noise_dn)), np.float32
    )
