"""Background subtraction of real images, and detection of star trails without knowing the sky.

The paper rectifies its images before it measures them.  Here both images keep their lens distortion: the simulated one
is rendered through the camera's lens model.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import erf

from glstar.arrays import Float
from glstar.calibrate.photo.detection import background_of

# A pixel above this fraction of the largest digital number counts as saturated.
_SATURATION_FRACTION = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class SubtractedImage:
    """A real image minus its background."""

    above_dn: NDArray[np.float32]  # (height, width) pixels minus the local level of the background
    noise_dn: NDArray[np.float32]  # (height, width) standard deviation of the background
    usable: NDArray[np.bool_]  # (height, width) pixels that are not saturated

    @property
    def usual_noise_dn(self) -> float:
        """The median noise, DN."""
        return float(np.median(self.noise_dn[::8, ::8]))

    @property
    def saturated_fraction(self) -> float:
        """The fraction of saturated pixels."""
        return 1.0 - float(self.usable.mean())

    def significance(self, sigma_px: float) -> NDArray[np.float32]:
        """Return the image in units of its noise, smoothed by a star's width, (height, width) float32."""
        smooth = cv2.GaussianBlur(self.above_dn / self.noise_dn, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
        # The median of absolute values of a Gaussian is 0.6745 of its standard deviation.
        return np.asarray(smooth / max(float(np.median(np.abs(smooth[::3, ::3]))) / 0.6745, 1e-6), dtype=np.float32)


def subtract_background(pixels: NDArray[Any], *, saturation_dn: float) -> SubtractedImage:
    """Return a real image minus its background.

    `pixels` (height, width) uint8, uint16 or float32: digital numbers; `saturation_dn`: the digital number at which the
    sensor saturates.
    """
    image = pixels.astype(np.float64)
    background = background_of(image)
    return SubtractedImage(
        (image - background.level_dn).astype(np.float32),
        background.noise_dn.astype(np.float32),
        np.asarray(image < _SATURATION_FRACTION * saturation_dn),
    )


@dataclass(frozen=True, slots=True)
class _Limits:
    """Thresholds of detection."""

    smoothing_px: float = 1.5  # width of the smoothing before pixels are detected
    # A trail has a smoothed pixel of the first signal-to-noise ratio, and all connected ones above the second.
    seed_snr: float = 5.5
    grow_snr: float = 3.0
    least_pixels: int = 5  # smallest number of pixels of a trail: a smoothed hot pixel is smaller
    most_length_px: float = 2000.0  # longer patches are no trails
    most_width: float = 3.0  # patches wider than this multiple of the point spread function are no trails
    point_sigma: float = 6.0  # patches shorter than this multiple of the point spread function are points
    least_length_sigma: float = 3.0  # shorter trails are points: the patch of a bright star is large
    strip_sigma: float = 3.0  # half the width of the strip that is summed across a trail
    beyond_sigma: float = 8.0  # length of the strip beyond each end of the trail
    most_extensions: int = 12  # how often a trail that continues beyond the strip is followed


_LIMITS = _Limits()


@dataclass(frozen=True, slots=True, eq=False)
class DetectedTrails:
    """Star trails on an image, the brightest first; which end is the start is unknown.

    Attributes
    ----------
    ends_px : (n, 2, 2) float64
        Two ends (x, y) of each trail, px; equal for a point.
    middle_px : (n, 2) float64
        The position halfway along the trail, px: that of mid-exposure where the rate is constant.
    centroid_px : (n, 2) float64
        Centroid of the flux, px; a bent trail has it off the trail.
    flux_dn : (n,) float64
        Sum of the signal, DN.
    snr : (n,) float64
        Flux over the noise of the sky under it.
    at_edge : (n,) bool
        Whether the trail may continue beyond the image.
    """

    ends_px: Float
    middle_px: Float
    centroid_px: Float
    flux_dn: Float
    snr: Float
    at_edge: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.flux_dn)

    @property
    def length_px(self) -> Float:
        """Distance of the two ends, (n,) float64, px."""
        return np.asarray(np.linalg.norm(self.ends_px[:, 1] - self.ends_px[:, 0], axis=-1))


@dataclass(frozen=True, slots=True)
class _Trail:
    ends: Float
    middle: Float
    centroid: Float
    flux: float
    snr: float
    at_edge: bool


def detect_trails(
    pixels: NDArray[Any], *, saturation_dn: float | None = None, psf_sigma_px: float = 1.2
) -> DetectedTrails:
    """Detect star trails, or round stars.

    Parameters
    ----------
    pixels : (height, width) uint8, uint16 or float32
        The image, DN.
    saturation_dn : float, optional
        The digital number at which the sensor saturates; by default the largest of the type.
    psf_sigma_px : float
        Width of the point spread function, px.

    Returns
    -------
    DetectedTrails
        Crossing trails are left out.

    Notes
    -----
    Pixels of the image that is smoothed and divided by its noise are grouped from 5.5 sigma down to 3 sigma.  A trail
    is a uniform line of Gaussian cross-section along a parabola; its ends are fitted to its profile.
    """
    if saturation_dn is None:
        saturation_dn = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else np.inf
    sky = subtract_background(pixels, saturation_dn=saturation_dn)
    significance = sky.significance(_LIMITS.smoothing_px)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats((significance > _LIMITS.grow_snr).astype(np.uint8))
    strongest = np.zeros(len(boxes), dtype=np.float32)
    np.maximum.at(strongest, labels.ravel(), significance.ravel())
    trails = []
    for label in np.flatnonzero((strongest >= _LIMITS.seed_snr) & (boxes[:, cv2.CC_STAT_AREA] >= _LIMITS.least_pixels)):
        if label == 0:
            continue
        left, top, width, height = boxes[label, :4]
        inside = labels[top : top + height, left : left + width] == label
        rows, columns = (index.astype(np.float64) for index in np.nonzero(inside))
        trail = _measured(sky, columns + left, rows + top, psf_sigma_px)
        if trail is not None:
            trails.append(trail)
    trails = _without_repeats(trails, psf_sigma_px)
    return DetectedTrails(
        np.array([trail.ends for trail in trails], dtype=np.float64).reshape(-1, 2, 2),
        np.array([trail.middle for trail in trails], dtype=np.float64).reshape(-1, 2),
        np.array([trail.centroid for trail in trails], dtype=np.float64).reshape(-1, 2),
        np.array([trail.flux for trail in trails], dtype=np.float64),
        np.array([trail.snr for trail in trails], dtype=np.float64),
        np.array([trail.at_edge for trail in trails], dtype=np.bool_),
    )


def _without_repeats(trails: list[_Trail], sigma_px: float) -> list[_Trail]:
    """Return the trails, the brightest first, each found once although several of its pieces were."""
    kept: list[_Trail] = []
    for trail in sorted(trails, key=lambda trail: -trail.flux):
        near = 3 * sigma_px + 0.1 * float(np.linalg.norm(trail.ends[1] - trail.ends[0]))
        if all(np.linalg.norm(trail.middle - other.middle) > near for other in kept):
            kept.append(trail)
    return kept


def _measured(sky: SubtractedImage, x: Float, y: Float, sigma_px: float) -> _Trail | None:
    """Return the trail of a patch of pixels; None if its shape is another."""
    weight = np.maximum(sky.above_dn[y.astype(int), x.astype(int)].astype(np.float64), 0.0)
    if weight.sum() <= 0:
        return None
    centre = np.array([np.average(x, weights=weight), np.average(y, weights=weight)])
    offset = np.column_stack([x, y]) - centre
    variances, axes = np.linalg.eigh(np.cov(offset.T, aweights=weight + 1e-9) + 1e-9 * np.eye(2))
    along = offset @ axes[:, 1]
    extent_px = float(np.ptp(along))
    if extent_px > _LIMITS.most_length_px:
        return None
    if extent_px < _LIMITS.point_sigma * sigma_px + 2 * _LIMITS.smoothing_px:
        return _point(sky, centre, sigma_px)
    if float(np.sqrt(variances[0])) > _LIMITS.most_width * sigma_px + extent_px**2 / 4000:
        return None
    return _followed(sky, centre, axes, (float(along.min()), float(along.max())), sigma_px)


def _followed(
    sky: SubtractedImage, centre: Float, axes: Float, known_px: tuple[float, float], sigma_px: float
) -> _Trail | None:
    """Return the trail along the second axis; a faint one is found in pieces and followed until it ends."""
    first_px, last_px = known_px
    trail: _Trail | None = None
    for _ in range(_LIMITS.most_extensions):
        strip = _Strip.around(sky, centre, axes[:, 1], axes[:, 0], (first_px, last_px), sigma_px)
        fitted = None if strip is None else strip.fitted(sigma_px)
        if strip is None or fitted is None:
            return None
        if fitted[1] - fitted[0] < _LIMITS.least_length_sigma * sigma_px:
            return _point(sky, centre, sigma_px)
        trail = strip.trail(fitted)
        continues = fitted[0] < first_px - 2 * sigma_px, fitted[1] > last_px + 2 * sigma_px
        if not any(continues):
            break
        first_px, last_px = min(first_px, fitted[0]), max(last_px, fitted[1])
    return trail


def _point(sky: SubtractedImage, centre: Float, sigma_px: float) -> _Trail | None:
    """Return a round star: its centroid within a Gaussian window that follows it."""
    radius = int(np.ceil(4 * sigma_px))
    height, width = sky.above_dn.shape
    at = centre
    flux = 0.0
    for _ in range(8):
        column, row = np.rint(at).astype(int)
        if not (radius <= column < width - radius and radius <= row < height - radius):
            return None
        rows, columns = np.mgrid[row - radius : row + radius + 1, column - radius : column + radius + 1]
        signal = sky.above_dn[rows, columns].astype(np.float64)
        window = np.exp(-((columns - at[0]) ** 2 + (rows - at[1]) ** 2) / (2 * sigma_px**2))
        total = float((signal * window).sum())
        if total <= 0:
            return None
        step = np.array([((columns - at[0]) * signal * window).sum(), ((rows - at[1]) * signal * window).sum()]) / total
        # The window halves the distance of a Gaussian of the same width from its middle.
        at = at + 2 * step
        flux = 2 * total
    if np.linalg.norm(at - centre) > 2 * sigma_px + 1:
        return None
    noise_dn = float(sky.noise_dn[round(at[1]), round(at[0])])
    snr = flux / (noise_dn * np.sqrt(4 * np.pi) * sigma_px)
    return _Trail(np.stack([at, at]), at, at, flux, snr, at_edge=False)


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """The signal in the frame of a trail: profile along it, and its mean offset across."""

    centre: Float  # (2,)
    along_axis: Float
    across_axis: Float
    along_px: Float  # (m,) positions of the profile from the centre
    profile_dn: Float  # (m,) signal per pixel of length, DN
    bend: Float  # (3,) offset across as a polynomial of the position along, highest power first, px
    noise_dn: float  # Noise of a value of the profile, DN
    at_edge: bool

    @classmethod
    def around(
        cls,
        sky: SubtractedImage,
        centre: Float,
        along_axis: Float,
        across_axis: Float,
        known_px: tuple[float, float],
        sigma_px: float,
    ) -> "_Strip | None":
        """Return the strip around a patch; None if it has too little signal."""
        reach = _LIMITS.beyond_sigma * sigma_px
        first_px, last_px = known_px
        position = np.arange(np.floor(first_px - reach), np.ceil(last_px + reach) + 1)
        half = int(np.ceil(_LIMITS.strip_sigma * sigma_px))
        across = np.arange(-half, half + 1, dtype=np.float64)
        bend = np.zeros(3)
        for _ in range(3):
            offset = across + np.polyval(bend, position)[:, np.newaxis]
            xy = centre + position[:, np.newaxis, np.newaxis] * along_axis + offset[..., np.newaxis] * across_axis
            values = cv2.remap(
                sky.above_dn, xy[..., 0].astype(np.float32), xy[..., 1].astype(np.float32), cv2.INTER_LINEAR
            ).astype(np.float64)
            window = np.exp(-(across**2) / (2 * (1.5 * sigma_px) ** 2))
            profile = values @ window
            inside = (position > first_px + sigma_px) & (position < last_px - sigma_px) & (profile > 0)
            if inside.sum() < 4:
                return None
            shift = (values @ (window * across))[inside] / profile[inside]
            # A window of 1.5 sigma shows 1.5^2 / (1 + 1.5^2) of an offset.
            shift = np.clip(shift / (1.5**2 / (1 + 1.5**2)), -half, half)
            weights = np.sqrt(profile[inside])
            degree = 2 if inside.sum() > 12 else 1
            bend[2 - degree :] += np.polyfit(position[inside], shift, degree, w=weights)
        height, width = sky.above_dn.shape
        path = centre + position[:, np.newaxis] * along_axis + np.polyval(bend, position)[:, np.newaxis] * across_axis
        is_inside = ((path >= 0) & (path <= [width - 1, height - 1])).all(axis=1)
        column, row = np.clip(np.rint(centre).astype(int), 0, [width - 1, height - 1])
        noise_dn = float(sky.noise_dn[row, column]) * float(np.sqrt((window**2).sum()))
        return cls(centre, along_axis, across_axis, position, profile, bend, noise_dn, not bool(is_inside.all()))

    def at(self, along_px: Float) -> Float:
        """Return positions along the trail, (k, 2) px."""
        return (
            self.centre
            + along_px[:, np.newaxis] * self.along_axis
            + np.polyval(self.bend, along_px)[:, np.newaxis] * self.across_axis
        )

    def fitted(self, sigma_px: float) -> tuple[float, float, float] | None:
        """Return the ends, px, and the level, DN, of a box convolved with the point spread function; None without."""
        level = float(np.median(self.profile_dn[self.profile_dn > self.profile_dn.max() / 2]))
        above = np.flatnonzero(self.profile_dn > level / 2)
        start = np.array([self.along_px[above[0]], self.along_px[above[-1]], level])
        root = np.sqrt(2) * sigma_px

        def residual(parameters: Float) -> Float:
            first, last, height = parameters
            model = height / 2 * (erf((self.along_px - first) / root) - erf((self.along_px - last) / root))
            return np.asarray((model - self.profile_dn) / level)

        fitted = least_squares(residual, start, loss="soft_l1", f_scale=0.3, x_scale=np.array([1.0, 1.0, level])).x
        first, last, level = (float(value) for value in fitted)
        return (first, last, level) if last > first and level > 0 else None

    def trail(self, fitted: tuple[float, float, float]) -> _Trail:
        """Return the trail with the ends and the level of `fitted`."""
        first, last, level = fitted
        length_px = last - first
        # Every point of the box has the same flux, so that the centroid of a bent trail is the mean of the polynomial.
        path = self.at(np.linspace(first, last, 65))
        full = level / float(1.5 / np.sqrt(1 + 1.5**2))
        flux = full * length_px
        snr = level * np.sqrt(length_px) / self.noise_dn
        return _Trail(path[[0, -1]], path[32], path.mean(axis=0), flux, snr, self.at_edge)
