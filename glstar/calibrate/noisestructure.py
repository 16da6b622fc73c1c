"""Structure of the noise of a photograph: correlation of neighbouring pixels, and differences on the 2 x 2 lattice."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.misfit import Measurement
from glstar.calibrate.photograph import Photograph

__all__ = ["measure_noise_structure"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# Noise is examined in patches of this side, px, in a square grid of this many per side.
_PATCH_PX: Final = 192
_PATCHES: Final = 4
# Pixels this many standard deviations off the sky belong to stars.
_STAR_SIGMA: Final = 3.5
# A patch needs this number of starless pixels.
_MIN_PIXELS: Final = 2000
# The correlation at this lag, px, is due to residual structure of the background; it is subtracted.
_FAR_LAG_PX: Final = 6


def measure_noise_structure(
    image: Photograph, detected: DetectedStars
) -> tuple[Measurement | None, Measurement | None]:
    """Return the correlation of neighbouring pixels and the spread on the 2 x 2 lattice: medians over patches."""
    height, width = image.pixels_dn.shape
    side = min(_PATCH_PX, height, width) // 2 * 2
    correlations, lattices = [], []
    for top in np.linspace(0, height - side, _PATCHES).astype(int) // 2 * 2:
        for left in np.linspace(0, width - side, _PATCHES).astype(int) // 2 * 2:
            part = slice(top, top + side), slice(left, left + side)
            above = image.pixels_dn[part] - detected.background.level_dn[part]
            noise_dn = float(np.median(detected.background.noise_dn[part]))
            near = detected.xy_px - (left, top)
            found = _patch_noise(above, noise_dn, near, detected.psf_sigma_px)
            if found is not None:
                correlations.append(found[0])
                lattices.append(found[1])
    if len(correlations) < _PATCHES:
        return None, None
    count = float(np.sqrt(len(correlations)))
    variances = np.array(lattices)
    middle = np.median(variances, axis=0)
    # The standard error of a median is 1.25 times that of the mean.
    error = 1.25 * float(variances.std(axis=0, ddof=1).max()) / count
    ratio = float(np.sqrt(middle.max() / middle.min()))
    return (
        Measurement(float(np.median(correlations)), 1.25 * float(np.std(correlations, ddof=1)) / count),
        Measurement(ratio - 1, ratio * error / float(middle.min() * np.sqrt(2))),
    )


def _patch_noise(above: Float, noise_dn: float, xy_px: Float, sigma_px: float) -> tuple[float, Float] | None:
    """Return the correlation of neighbours, and the noise variance of the lattice's four pixels over their mean."""
    starless = np.abs(above) < _STAR_SIGMA * max(noise_dn, 0.3)
    radius = 5 * sigma_px + 2
    for x, y in xy_px[((xy_px > -radius) & (xy_px < len(above) + radius)).all(axis=1)]:
        rows = slice(max(0, int(y - radius)), max(0, int(y + radius) + 1))
        columns = slice(max(0, int(x - radius)), max(0, int(x + radius) + 1))
        starless[rows, columns] = False
    if starless.sum() < _MIN_PIXELS:
        return None
    left = np.where(starless, above - above[starless].mean(), 0.0)
    variance = float((left**2).sum() / starless.sum())
    phases = [(slice(row, None, 2), slice(column, None, 2)) for row in (0, 1) for column in (0, 1)]
    counts = np.array([starless[phase].sum() for phase in phases])
    lattice = np.array([(left[phase] ** 2).sum() for phase in phases]) / np.maximum(counts, 1)
    # A constant sky has no noise to examine.
    if variance < 1e-3 or counts.min() < _MIN_PIXELS // 8 or lattice.min() <= 0:
        return None

    def correlation(lag: int) -> float:
        total, pairs = 0.0, 0
        for one, other in (
            ((slice(lag, None), slice(None)), (slice(None, -lag), slice(None))),
            ((slice(None), slice(lag, None)), (slice(None), slice(None, -lag))),
        ):
            total += float((left[one] * left[other]).sum())
            pairs += int((starless[one] & starless[other]).sum())
        return total / max(pairs, 1) / variance

    return correlation(1) - correlation(_FAR_LAG_PX), np.asarray(lattice / lattice.mean())
