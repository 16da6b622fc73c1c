"""A rolling shutter by brute force: many positions of a star, recorded by the rows that are open then, in float64."""

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.render.simulator import Simulator
from tests.support.reference import profile

Float = NDArray[np.float64]

_ALL = slice(None)


def star_positions(simulator: Simulator, star: int, utc_s: Float) -> Float:
    """Return where a star is at some times, (n, 2) px, from the interpolated attitude itself."""
    direction = simulator.stars.direction_eq[star : star + 1]
    return simulator.camera.project(simulator.pointing(utc_s).to_camera(direction))[:, 0]


def recorded_span_s(exposure: Exposure) -> float:
    """Return the time from the opening of the first row to the closing of the last one, of all short exposures, s."""
    period_s = exposure.duration_s + exposure.gap_s
    return (exposure.frames - 1) * period_s + exposure.duration_s + exposure.readout_s


def open_fractions(
    exposure: Exposure, width_px: int, height_px: int, samples: int, chosen: NDArray[np.intp] | slice = _ALL
) -> tuple[Float, bool]:
    """Return which fraction of some of the equal parts of an exposure each row is open, (chosen, rows).

    The flag says whether the rows of the readout are rows of the image, or columns.
    """
    vertical = exposure.readout in {"down", "up"}
    count = height_px if vertical else width_px
    order = np.arange(count) if exposure.readout in {"down", "right"} else np.arange(count)[::-1]
    part_s = recorded_span_s(exposure) / samples
    starts_s = part_s * np.arange(samples)[chosen, np.newaxis]
    fractions = np.zeros((len(starts_s), count))
    for number in range(exposure.frames):
        opens_s = number * (exposure.duration_s + exposure.gap_s) + exposure.readout_s * order / (count - 1)
        first = ((opens_s - starts_s) / part_s).clip(0, 1)
        fractions += ((opens_s + exposure.duration_s - starts_s) / part_s).clip(0, 1) - first
    return fractions, vertical


def rolling_light(simulator: Simulator, exposure: Exposure, star: int, samples: int = 20_000) -> Float:
    """Return the noiseless signal of one star, a Gaussian on the sensor, (height, width) float64, DN."""
    camera, sensor = simulator.camera, simulator.sensor
    span_s = recorded_span_s(exposure)
    utc_s = exposure.start_utc_s + (np.arange(samples) + 0.5) * (span_s / samples)
    xy = star_positions(simulator, star, utc_s)
    peak_dn = float(sensor.peak_dn(simulator.stars.camera_mag[star], exposure.duration_s))
    image = np.zeros((camera.height_px, camera.width_px))
    lit = np.flatnonzero(camera.contains(xy, 8 * sensor.effective_sigma_px))
    for block in np.array_split(lit, 1 + lit.size // 1000):
        fractions, vertical = open_fractions(exposure, camera.width_px, camera.height_px, samples, block)
        fractions *= peak_dn * span_s / exposure.duration_s / samples
        across = profile(np.arange(camera.width_px) - xy[block, :1], sensor)
        down = profile(np.arange(camera.height_px) - xy[block, 1:], sensor)
        image += (down * fractions).T @ across if vertical else down.T @ (across * fractions)
    return image
