"""Start values of the alignment, by cross-correlation of binned images with the predicted signal.

The fit of an alignment is linearised, so it starts within a few pixels of the solution.  Here the brightest stars are
rendered along their paths for a grid of clock offsets, or of readout times, and the common shift of all images gives
the mount.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.compare.detection import SubtractedImage
from glstar.compare.pairs import CrossCorrelation, coarse_side, shrunk
from glstar.render.simulator import Simulator


@dataclass(frozen=True, slots=True)
class _CoarseSearch:
    """The search for a start value, on binned images."""

    side_px: int = 192  # longer side of the binned images
    images: int = 6  # number of images, evenly chosen
    samples: int = 24  # samples along each star path, in each short exposure of a stacked image
    most_samples: int = 240  # largest number of samples along the path of a stacked image
    step_s: float = 0.0125  # step of the clock offset
    own_step_s: float = 0.05  # step of the delay of a single image: 1 deg at 20 deg/s, within the search for its shift
    likely: float = 0.9  # correlations above this fraction of the largest one are likely
    max_offsets: int = 200  # number of steps in each direction of time
    readout_s: float = 0.25  # largest readout time
    readout_step_s: float = 0.0125  # a third of a bin at the border of the image, at 20 deg/s and a field of 50 deg
    least_gain: float = 1.01  # a readout time replaces the configured one if its correlation is higher by this factor
    stars: int = 150  # number of stars, the brightest


_COARSE = _CoarseSearch()


def likely_start(
    images: Sequence[tuple[Exposure, SubtractedImage]],
    simulator: Simulator,
    *,
    search_px: float,
    search_s: float,
    on_step: Callable[[int, int], None] | None = None,
) -> tuple[Float, float]:
    """Return start values of the mount and the clock, by cross-correlation of binned images.

    `images`: six of them are used; `search_px`: the largest common shift of the images, px; `search_s`: the largest
    absolute delay, s; 0 to search the mount only; `on_step`: called with the number of delays tried, and of all.
    Returns a rotation of the camera about its right, down and forward axes, (3,) rad, and a delay, s.
    """
    report = on_step or (lambda *_: None)
    search = _Correlations(images, simulator, search_px)
    steps = min(int(np.ceil(search_s / _COARSE.step_s)), _COARSE.max_offsets)
    offsets = np.linspace(-search_s, search_s, 2 * steps + 1).tolist() if steps else [0.0]
    best = -np.inf, np.zeros(3), 0.0
    for number, delay_s in enumerate(offsets):
        exposures = [images[k][0] for k in search.chosen]
        value, turn_rad = search.best([replace(e, start_utc_s=e.start_utc_s + delay_s) for e in exposures])
        report(number + 1, len(offsets))
        if value > best[0]:
            best = value, turn_rad, delay_s
    return best[1], best[2]


def likely_delay_s(
    image: tuple[Exposure, SubtractedImage], simulator: Simulator, *, search_px: float, search_s: float
) -> float:
    """Return the delay of one image, s, by cross-correlation of the binned image with its predicted signal.

    `search_px`: the largest shift of the image, px; `search_s`: the largest absolute delay, s.  A turning aircraft and
    a turned camera shift the image alike, so of all likely delays that with the smallest shift is taken.
    """
    search = _Correlations([image], simulator, search_px)
    steps = min(int(np.ceil(search_s / _COARSE.own_step_s)), _COARSE.max_offsets)
    offsets = np.linspace(-search_s, search_s, 2 * steps + 1)
    exposure, _ = image
    found = [search.best([replace(exposure, start_utc_s=exposure.start_utc_s + float(s))]) for s in offsets]
    value, shift_rad = np.array([one[0] for one in found]), np.array([np.linalg.norm(one[1]) for one in found])
    # Outside of the flight, a correlation is -inf.
    likely = value >= _COARSE.likely * np.max(value, initial=0.0)
    if not likely.any():
        return 0.0
    return float(offsets[np.argmin(np.where(likely, shift_rad + 1e-9 * np.abs(offsets), np.inf))])


def likely_readout(
    images: Sequence[tuple[Exposure, SubtractedImage]],
    simulator: Simulator,
    *,
    search_px: float,
    given_s: float,
    exposure_at: Callable[[int, float], Exposure],
) -> tuple[Float, float]:
    """Return start values of the mount and the readout time, by cross-correlation of binned images.

    `images`: six of them are used; `search_px`: the largest common shift of the images, px; `given_s`: the configured
    readout time, s; `exposure_at`: returns the exposure of an image, by its index, at a readout time, s: negative if
    the rows open in the opposite direction.  Returns a rotation of the camera about its right, down and forward axes,
    (3,) rad, and a readout time, s.
    """
    search = _Correlations(images, simulator, search_px)
    steps = round(_COARSE.readout_s / _COARSE.readout_step_s)
    value, turn_rad = search.best([exposure_at(k, given_s) for k in search.chosen])
    best = _COARSE.least_gain * value, turn_rad, given_s
    for readout_s in (_COARSE.readout_step_s * np.arange(-steps, steps + 1)).tolist():
        value, turn_rad = search.best([exposure_at(k, readout_s) for k in search.chosen])
        if value > best[0]:
            best = value, turn_rad, readout_s
    return best[1], best[2]


class _Correlations:
    """Cross-correlations of a few binned images with their predicted signals; parameters as for `likely_start`."""

    def __init__(
        self, images: Sequence[tuple[Exposure, SubtractedImage]], simulator: Simulator, search_px: float
    ) -> None:
        self.chosen = np.unique(np.linspace(0, len(images) - 1, _COARSE.images).astype(int)).tolist()
        self._simulator = simulator
        self._subtracted = [images[k][1] for k in self.chosen]
        side = self._side = coarse_side(self._subtracted[0].above_dn.shape, _COARSE.side_px)
        sigma_px = simulator.sensor.effective_sigma_px
        self._correlations = [
            CrossCorrelation(shrunk(sky.significance(sigma_px), side), search_px / side) for sky in self._subtracted
        ]

    def best(self, exposures: Sequence[Exposure]) -> tuple[float, Float]:
        """Return the largest summed correlation of all images, -inf outside of the flight, and the camera's rotation.

        The shift gives the rotations about the right and down axes; the fit finds the one about the boresight.
        """
        track, camera = self._simulator.flight.attitude, self._simulator.camera
        total: NDArray[np.float32] | None = None
        for exposure, sky, correlation in zip(exposures, self._subtracted, self._correlations, strict=True):
            if exposure.start_utc_s < track.first_s or exposure.stop_utc_s > track.last_s:
                continue
            here = correlation.to(_density(self._simulator, exposure, sky, self._side))
            total = here if total is None else total + here
        if total is None:
            return -np.inf, np.zeros(3)
        x_px, y_px = self._correlations[0].best(total) * self._side
        return float(total.max()), np.array([y_px / camera.fy_px, -x_px / camera.fx_px, 0.0])


def _density(simulator: Simulator, exposure: Exposure, sky: SubtractedImage, side: int) -> NDArray[np.float32]:
    """Return the signal of the brightest stars along their paths, in units of the noise, binned."""
    sensor, camera = simulator.sensor, simulator.camera
    samples = min(_COARSE.samples * exposure.frames, _COARSE.most_samples)
    pointing = simulator.pointing(exposure.sub_utc_s(samples))
    middle = pointing.boresight_eq[len(pointing) // 2]
    within = np.flatnonzero(simulator.stars.direction_eq @ middle > np.cos(min(camera.field_radius_rad * 1.3, np.pi)))
    within = within[np.argsort(simulator.stars.camera_mag[within], kind="stable")][: _COARSE.stars]
    xy = camera.project(pointing.to_camera(simulator.stars.direction_eq[within])) / side
    flux = sensor.flux_dn(sensor.peak_dn(simulator.stars.camera_mag[within], exposure.span_s)) / samples
    per_column_s, per_row_s, first_s = exposure.opening_s(camera.width_px, camera.height_px)
    since_s = exposure.sub_utc_s(samples)[:, np.newaxis] - exposure.start_utc_s
    open_for_s = since_s - first_s - side * (per_column_s * xy[..., 0] + per_row_s * xy[..., 1])
    period_s = exposure.duration_s + exposure.gap_s
    if exposure.frames > 1:  # within one of the short exposures
        open_for_s = np.where(open_for_s < exposure.frames * period_s, open_for_s, -1.0)
        open_for_s = np.where(open_for_s < 0, -1.0, open_for_s % period_s)
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
