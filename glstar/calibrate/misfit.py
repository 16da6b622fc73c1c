"""What a photograph shows that the sensor model lacks: PSF wings, vignetting, a sky gradient and correlated noise."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.background import SkyLevel
from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.matches import Matches
from glstar.calibrate.psf import fit_stars, profile
from glstar.calibrate.sensorfit import BrightnessFit, MeasuredStars
from glstar.calibrate.shape import star_shapes
from glstar.calibrate.skyimage import SkyImage
from glstar.camera.sensor import PIXEL_VARIANCE_PX2, Sensor
from glstar.statistics import robust_std

__all__ = ["Estimate", "Misfit", "RadialProfile", "corner_distance", "measure_misfit"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# An effect is reported from this many standard errors up.
_SIGNIFICANT: Final = 4.0
# Smaller effects than these do not matter: wings beyond the Gaussian's, light lost at the corner, axis ratio, change of
# the PSF's width at the corner.
_WING_FRACTION: Final = 0.03
_VIGNETTING_FRACTION: Final = 0.10
_AXIS_RATIO: Final = 1.08
_GROWTH_FRACTION: Final = 0.08
# A sky gradient matters beyond both of these: DN across the image, and multiples of the sky noise.
_GRADIENT_DN: Final = 5.0
_GRADIENT_SIGMA: Final = 0.5
# Correlation of neighbouring pixels' noise, and ratio of its standard deviations on the 2 x 2 lattice: faint undetected
# stars correlate the noise by a few hundredths.
_CORRELATION: Final = 0.15
_LATTICE_RATIO: Final = 1.10
# Wings are measured between these radii, and the sky beneath them between those, in sigma as the pixels record it.
_WING_SIGMA: Final = (3.0, 8.0)
_RING_SIGMA: Final = (9.0, 12.0)
# The light of a Gaussian beyond 3 sigma.
_GAUSSIAN_WING: Final = float(np.exp(-(_WING_SIGMA[0] ** 2) / 2))
# Wings and shapes are those of at most this many stars, at least this many times as bright as the noise.
_MOST_STARS: Final = 150
_SHAPED_SNR: Final = 20.0
_CLEAREST_SNR: Final = 60.0
_WIDTH_SNR: Final = 10.0
# Fewer stars than these show neither a typical shape nor a change across the image.
_LEAST_SHAPES: Final = 8
_LEAST_STARS: Final = 20
# What happens at the corner is known where a tenth of the stars lie beyond this fraction of its distance.
_LEAST_REACH: Final = 0.6
# Shapes are measured where the turning sky moves stars by less than this, sigma: it adds 1 % to the axis ratio.
_STILL_SIGMA: Final = 0.5
_RESAMPLED: Final = 200
# Noise is examined in patches of this side, px, in a grid of this many each way; pixels this many sigma off are stars.
_PATCH_PX: Final = 192
_PATCHES: Final = 4
_STAR_SIGMA: Final = 3.5
_LEAST_PIXELS: Final = 2000
# The far lag whose correlation is subtracted: what is left of the background, px.
_FAR_LAG_PX: Final = 6
# The level is sampled on a grid of this many points each way, neighbours of which share tiles.
_LEVEL_GRID: Final = 16
_SHARED_TILES: Final = 2.0
# Rows and columns of the map of brightness residuals.
_MAP_SHAPE: Final = (3, 4)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measured number.

    Attributes
    ----------
    value, standard_error : float
        In one unit.
    """

    value: float
    standard_error: float

    def exceeds(self, limit: float) -> bool:
        """Whether it differs from 0 significantly, and by more than a limit in the same unit."""
        return abs(self.value) > max(_SIGNIFICANT * self.standard_error, limit)


@dataclass(frozen=True, slots=True, eq=False)
class RadialProfile:
    """The median profile of the bright stars, each divided by the amplitude that pixels record.

    Attributes
    ----------
    radius_sigma : (k,) float64
        Distance from the centre, in standard deviations as the pixels record them.
    brightness : (k,) float64
        1 at the centre of a Gaussian star.
    """

    radius_sigma: Float
    brightness: Float


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How a photograph differs from the sensor model; None where there are too few stars or pixels to tell.

    Attributes
    ----------
    wing_fraction : Estimate or None
        Light between 3 and 8 sigma beyond that of the fitted Gaussian, over the Gaussian's light.
    stacked : RadialProfile or None
    corner_loss_mag : Estimate or None
        How much fainter stars are in the farthest corner than on the axis, magnitudes.
    mean_loss_mag : float
        The same for the mean star that brightness rests on.
    brightness_map_mag : (3, 4) float64
        Median brightness residual in parts of the image, positive for faint stars; NaN where no star is.
    gradient_dn : Estimate
        Change of the background from one side or corner of the image to the other, DN.
    gradient_towards_rad : float
        Direction in which the sky brightens, rad from the right, clockwise.
    rest_dn, rest_without_bowl_dn : float
        How uneven the background is without that gradient, and without a paraboloid around the centre too, standard
        deviation, DN.
    ellipticity : Estimate or None
        (a^2 - b^2) / (a^2 + b^2) of the axes a, b of the mean star.
    long_axis_rad : float
        Direction of its long axis, rad from the horizontal, clockwise, 0 to pi.
    corner_growth : Estimate or None
        By what fraction the PSF is wider in the farthest corner than on the axis.
    neighbour_correlation : Estimate or None
        Correlation of the noise of neighbouring pixels.
    lattice_excess : Estimate or None
        Largest over smallest standard deviation of the noise on the 2 x 2 lattice, minus 1.
    """

    wing_fraction: Estimate | None
    stacked: RadialProfile | None
    corner_loss_mag: Estimate | None
    mean_loss_mag: float
    brightness_map_mag: Float
    gradient_dn: Estimate
    gradient_towards_rad: float
    rest_dn: float
    rest_without_bowl_dn: float
    ellipticity: Estimate | None
    long_axis_rad: float
    corner_growth: Estimate | None
    neighbour_correlation: Estimate | None
    lattice_excess: Estimate | None

    @property
    def axis_ratio(self) -> float:
        """Long axis over short axis of the mean star; NaN where it is unknown."""
        if self.ellipticity is None:
            return float("nan")
        e = min(self.ellipticity.value, 0.99)
        return float(np.sqrt((1 + e) / (1 - e)))

    def has_gradient(self, noise_dn: float) -> bool:
        """Whether the sky has a gradient that matters beside its noise, DN."""
        return self.gradient_dn.exceeds(max(_GRADIENT_DN, _GRADIENT_SIGMA * noise_dn))

    @property
    def has_vignetting(self) -> bool:
        """Whether stars lose light towards the corners, significantly and so much that it matters."""
        loss = self.corner_loss_mag
        return loss is not None and loss.value > 0 and loss.exceeds(-2.5 * np.log10(1 - _VIGNETTING_FRACTION))

    def unexplained_unevenness(self, sky: SkyLevel) -> tuple[float, str]:
        """Return how uneven the sky is besides a gradient and vignetting that have their own notes, and its label.

        Parameters
        ----------
        sky : SkyLevel

        Returns
        -------
        float
            Standard deviation, DN.
        str
        """
        if self.has_vignetting:
            return self.rest_without_bowl_dn, "besides a gradient and the vignetting"
        if self.has_gradient(sky.std_dn):
            return self.rest_dn, "besides its gradient"
        return sky.unevenness_dn, "over the image"

    def notes(self, sensor: Sensor, *, linear: bool = True) -> tuple[str, ...]:
        """Return what a photographer should know, a sentence for each effect that is significant and matters.

        Parameters
        ----------
        sensor : Sensor
        linear : bool
            Whether the image answers to light in proportion; otherwise the profiles of its stars are not those of the
            lens, and neither wings nor a change of width are reported.

        Returns
        -------
        tuple of str
        """
        of_lens = (self._wings(), self._growth()) if linear else ()
        notes = (*of_lens, self._vignetting(), self._gradient(sensor), self._ellipse(), self._processing())
        return tuple(note for note in notes if note)

    def _wings(self) -> str:
        if self.wing_fraction is None or self.wing_fraction.value < 0 or not self.wing_fraction.exceeds(_WING_FRACTION):
            return ""
        extra = self.wing_fraction.value
        lost = 100 * extra / (1 + extra)
        beyond = lost + 100 * _GAUSSIAN_WING / (1 + extra)
        return (
            f"the stars have wings: {beyond:.0f} % of their light lies beyond 3 sigma, where a Gaussian has"
            f" {100 * _GAUSSIAN_WING:.1f} %: sigma is too wide for their cores, and simulated stars lack"
            f" {lost:.0f} % of the light ({2.5 * np.log10(1 + extra):.2f} mag); focus, and keep the lens clear of dew"
            " and haze"
        )

    def _vignetting(self) -> str:
        loss = self.corner_loss_mag
        if loss is None or not loss.exceeds(-2.5 * np.log10(1 - _VIGNETTING_FRACTION)):
            return ""
        if not self.has_vignetting:
            return (
                f"stars in the corner are {-loss.value:.2f} ± {loss.standard_error:.2f} mag brighter than on the axis:"
                f" the reference peak is {abs(self.mean_loss_mag):.2f} mag too bright for the centre; look for haze in"
                " the middle of the image, or a correction of vignetting that is too strong"
            )
        corner = 100 * (1 - 10 ** (-0.4 * loss.value))
        return (
            f"the corners are {corner:.0f} % darker than the centre ({loss.value:.2f} ± {loss.standard_error:.2f} mag:"
            f" vignetting): the reference peak is {self.mean_loss_mag:.2f} mag too faint for the centre, and too bright"
            " for the corners; stop the lens down, or divide the image by a flat field"
        )

    def _gradient(self, sensor: Sensor) -> str:
        if not self.has_gradient(sensor.sky_std_dn):
            return ""
        return (
            f"the sky has a gradient: it brightens by {self.gradient_dn.value:.0f} DN across the image, towards the"
            f" {_direction(self.gradient_towards_rad)}, its noise is {sensor.sky_std_dn:.1f} DN, and the sensor has one"
            f" level, {sensor.sky_mean_dn:.0f} DN; take images away from the Moon, twilight and lights"
        )

    def _ellipse(self) -> str:
        if self.ellipticity is None or not self.ellipticity.exceeds(0.0) or self.axis_ratio < _AXIS_RATIO:
            return ""
        return (
            f"the stars are ellipses: {self.axis_ratio:.2f} times as long as wide,"
            f" {np.rad2deg(self.long_axis_rad):.0f} deg"
            " clockwise from the horizontal: sigma is the mean of the two axes, and simulated stars are round; hold the"
            " camera still, focus, and look at the lens for astigmatism"
        )

    def _growth(self) -> str:
        growth = self.corner_growth
        if growth is None or not growth.exceeds(_GROWTH_FRACTION):
            return ""
        kind = "wider" if growth.value > 0 else "narrower"
        return (
            f"the stars in the corner are {100 * abs(growth.value):.0f} ± {100 * growth.standard_error:.0f} % {kind}"
            " than on the axis: sigma is that of the typical star, and simulated stars have it everywhere; focus"
            " between centre and corner, or stop the lens down"
        )

    def _processing(self) -> str:
        correlation, lattice = self.neighbour_correlation, self.lattice_excess
        correlated = correlation is not None and correlation.exceeds(_CORRELATION)
        interpolated = lattice is not None and lattice.exceeds(_LATTICE_RATIO - 1)
        if not (correlated or interpolated):
            return ""
        seen, causes = [], "demosaicing, noise reduction, scaling or JPEG"
        if correlated and correlation is not None:
            seen.append(f"neighbouring pixels share their noise (correlation {correlation.value:.2f}, 0 in raw images)")
        if interpolated and lattice is not None:
            causes = "demosaicing: colours interpolated between pixels"
            seen.append(f"the noise differs by {100 * lattice.value:.0f} % between the pixels of a 2 x 2 lattice")
        return (
            f"{', and '.join(seen)}, as processing leaves it ({causes}): simulated noise is independent from pixel to"
            " pixel, its standard deviation is not that of the raw sensor, and sigma includes the smoothing; take raw"
            " images of one colour"
        )

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, ready for JSON: null where unknown.

        Returns
        -------
        dict
        """

        def number(estimate: Estimate | None) -> dict[str, float] | None:
            if estimate is None:
                return None
            return {"value": estimate.value, "standard_error": estimate.standard_error}

        known = self.ellipticity is not None
        return {
            "wing_fraction_beyond_gaussian": number(self.wing_fraction),
            "corner_loss_mag": number(self.corner_loss_mag),
            "brightness_residual_map_mag": [
                [None if np.isnan(off) else float(off) for off in row] for row in self.brightness_map_mag
            ],
            "sky_gradient_dn": number(self.gradient_dn),
            "sky_brightens_towards_deg": float(np.rad2deg(self.gradient_towards_rad)),
            "sky_unevenness_without_gradient_dn": self.rest_dn,
            "sky_unevenness_without_gradient_and_bowl_dn": self.rest_without_bowl_dn,
            "psf_ellipticity": number(self.ellipticity),
            "psf_axis_ratio": self.axis_ratio if known else None,
            "psf_long_axis_deg": float(np.rad2deg(self.long_axis_rad)) if known else None,
            "corner_sigma_growth": number(self.corner_growth),
            "noise_neighbour_correlation": number(self.neighbour_correlation),
            "noise_lattice_excess": number(self.lattice_excess),
        }


def measure_misfit(
    image: SkyImage,
    detected: DetectedStars,
    matches: Matches,
    sensor: Sensor,
    fit: BrightnessFit,
    stars: MeasuredStars,
) -> Misfit:
    """Return how a photograph differs from the sensor that was fitted to it.

    Parameters
    ----------
    image : SkyImage
    detected : DetectedStars
    matches : Matches
    sensor : Sensor
    fit : BrightnessFit
    stars : MeasuredStars
        Those that match, in the same order.

    Returns
    -------
    Misfit
    """
    axis_px = _axis_px(matches)
    lone = ~stars.saturated & ~stars.blended
    signal = stars.peak_dn / stars.noise_dn
    growth, wider = _growth(image, stars, lone & (signal >= _WIDTH_SNR), signal, axis_px)
    # One width was fitted to all: of a star that is wider than that, the amplitude tells less than its light.
    fitted_px2, real_px2 = (
        sigma**2 + PIXEL_VARIANCE_PX2 for sigma in (sensor.psf_sigma_px, sensor.psf_sigma_px * wider)
    )
    ratio = np.maximum(stars.peak_dn, 1e-3) / fit.peak_dn(stars.vmag) * (fitted_px2 + real_px2) / (2 * fitted_px2)
    off_mag = -2.5 * np.log10(ratio)
    loss, mean_loss_mag = _corner_loss(image, stars, fit, off_mag, axis_px)
    gradient, towards_rad, rest_dn, rest_without_bowl_dn = _gradient(detected.background.level_dn)
    shaped = np.flatnonzero(lone & (signal >= _SHAPED_SNR))
    shaped = shaped[np.argsort(-signal[shaped], kind="stable")][:_MOST_STARS]
    wings, stacked, ellipticity, long_axis_rad = None, None, None, 0.0
    if len(shaped) >= _LEAST_SHAPES and stars.longest_trail_px < _STILL_SIGMA * sensor.psf_sigma_px:
        wings, stacked = _wings(image, detected, matches.detection[shaped], sensor.psf_sigma_px, signal[shaped])
        # Stars drawn out more than this are reported as motion.
        if not detected.drawn_out_px:
            ellipticity, long_axis_rad = _ellipse(image, detected, stars.xy_px[shaped], sensor.psf_sigma_px)
    correlation, lattice = _noise_structure(image, detected)
    return Misfit(
        wings,
        stacked,
        loss,
        mean_loss_mag,
        _brightness_map(image, stars.xy_px[fit.used], off_mag[fit.used]),
        gradient,
        towards_rad,
        rest_dn,
        rest_without_bowl_dn,
        ellipticity,
        long_axis_rad,
        growth,
        correlation,
        lattice,
    )


def corner_distance(image: SkyImage, matches: Matches, xy_px: Float) -> Float:
    """Return the distance of pixel positions from the principal point over that of the farthest corner.

    Parameters
    ----------
    image : SkyImage
    matches : Matches
    xy_px : (n, 2) float64

    Returns
    -------
    (n,) float64
    """
    return np.asarray(np.linalg.norm(_offsets(xy_px, image.pixels_dn.shape, _axis_px(matches)), axis=1))


def _axis_px(matches: Matches) -> Float:
    """Return where the optical axis meets the image as it was taken."""
    camera = matches.solution.camera
    cx_px = camera.width_px - 1 - camera.cx_px if matches.solution.mirrored else camera.cx_px
    return np.array([cx_px, camera.cy_px])


def _offsets(xy_px: Float, shape: tuple[int, ...], axis_px: Float) -> Float:
    """Return offsets from the axis in units of the farthest corner's distance, (n, 2)."""
    corners = np.array([[x, y] for x in (0, shape[1] - 1) for y in (0, shape[0] - 1)])
    return np.asarray((xy_px - axis_px) / np.linalg.norm(corners - axis_px, axis=1).max())


def _reach_the_corner(offset: Float) -> bool:
    """Whether stars are enough, and far enough from the axis, to show what happens towards the corner."""
    return len(offset) >= _LEAST_STARS and float(np.quantile(np.linalg.norm(offset, axis=1), 0.9)) >= _LEAST_REACH


def _fit_radial(offset: Float, values: Float, weights: Float) -> tuple[Float, Float]:
    """Return the robust fit of a + b x + c y + d r^2 and its covariance (Huber's weights; sandwich estimator)."""
    design = np.column_stack([np.ones(len(offset)), offset, (offset**2).sum(axis=1)])
    weights = weights / weights.mean()
    robust, p = weights, np.zeros(4)
    for _ in range(20):
        p = np.linalg.lstsq(design * np.sqrt(robust)[:, np.newaxis], values * np.sqrt(robust), rcond=None)[0]
        left = np.abs(values - design @ p) * np.sqrt(weights)
        robust = weights * np.minimum(1.0, 1.5 * max(robust_std(left), 1e-12) / np.maximum(left, 1e-12))
    left = values - design @ p
    inverse = np.linalg.pinv((design * robust[:, np.newaxis]).T @ design)
    meat = (design * ((robust * left) ** 2)[:, np.newaxis]).T @ design
    return p, inverse @ meat @ inverse * len(values) / max(len(values) - 4, 1)


def _growth(
    image: SkyImage, stars: MeasuredStars, good: NDArray[np.bool_], signal: Float, axis_px: Float
) -> tuple[Estimate | None, Float]:
    """Return the growth of sigma to the corner, and each star's expected width over the typical one, (n,)."""
    offset = _offsets(stars.xy_px, image.pixels_dn.shape, axis_px)
    weights = np.minimum(signal[good], _CLEAREST_SNR) ** 2
    if not _reach_the_corner(offset[good]):
        return None, np.ones(len(stars))
    p, covariance = _fit_radial(offset[good], stars.sigma_px[good], weights)
    if p[0] <= 0:
        return None, np.ones(len(stars))
    growth = Estimate(float(p[3] / p[0]), float(np.sqrt(covariance[3, 3]) / p[0]))
    if not growth.exceeds(0.0):
        return growth, np.ones(len(stars))
    r2 = (offset**2).sum(axis=1)
    width = 1 + growth.value * r2
    return growth, np.asarray(width / np.median(width[good]))


def _corner_loss(
    image: SkyImage, stars: MeasuredStars, fit: BrightnessFit, off_mag: Float, axis_px: Float
) -> tuple[Estimate | None, float]:
    offset = _offsets(stars.xy_px[fit.used], image.pixels_dn.shape, axis_px)
    if not _reach_the_corner(offset):
        return None, 0.0
    p, covariance = _fit_radial(offset, off_mag[fit.used], np.ones(len(offset)))
    return Estimate(float(p[3]), float(np.sqrt(covariance[3, 3]))), float(p[3] * (offset**2).sum(axis=1).mean())


def _brightness_map(image: SkyImage, xy_px: Float, off_mag: Float) -> Float:
    height, width = image.pixels_dn.shape
    cells = np.full(_MAP_SHAPE, np.nan)
    rows = np.clip(xy_px[:, 1] / height * _MAP_SHAPE[0], 0, _MAP_SHAPE[0] - 1).astype(int)
    columns = np.clip(xy_px[:, 0] / width * _MAP_SHAPE[1], 0, _MAP_SHAPE[1] - 1).astype(int)
    for row, column in np.ndindex(_MAP_SHAPE):
        inside = (rows == row) & (columns == column)
        if inside.any():
            cells[row, column] = np.median(off_mag[inside])
    return cells


def _gradient(level_dn: Float) -> tuple[Estimate, float, float, float]:
    """Return the change of the background across the image and where it brightens to.

    After them how uneven it is without that plane, and without a paraboloid around the centre too.
    """
    height, width = level_dn.shape
    y, x = (np.rint(np.linspace(0, length - 1, _LEVEL_GRID)).astype(int) for length in (height, width))
    xx, yy = (grid.ravel().astype(np.float64) for grid in np.meshgrid(x, y))
    size_px = np.array([width - 1.0, height - 1.0])
    offset = (np.column_stack([xx, yy]) - size_px / 2) / np.linalg.norm(size_px / 2)
    levels = level_dn[np.ix_(y, x)].ravel()
    p, covariance = _fit_radial(offset, levels, np.ones(len(levels)))
    # From one side to the other.
    sides = 2 * size_px / np.linalg.norm(size_px)
    gradient_dn = float(np.abs(p[1:3] * sides).sum())
    error_dn = _SHARED_TILES * float(np.sqrt(np.diag(covariance)[1:3] @ sides**2))
    towards_rad = float(np.arctan2(p[2], p[1]) % (2 * np.pi))
    rest = levels - offset @ p[1:3]
    without_bowl = rest - p[3] * (offset**2).sum(axis=1)
    return (
        Estimate(gradient_dn, error_dn),
        towards_rad,
        robust_std(rest, float(np.median(rest))),
        robust_std(without_bowl, float(np.median(without_bowl))),
    )


def _direction(clockwise_rad: float) -> str:
    names = ("right", "lower right", "bottom", "lower left", "left", "upper left", "top", "upper right")
    return names[round(clockwise_rad / (np.pi / 4)) % 8]


def _wings(
    image: SkyImage, detected: DetectedStars, chosen: Index, sigma_px: float, signal: Float
) -> tuple[Estimate | None, RadialProfile | None]:
    """Return the wings' light beyond the Gaussian's over the Gaussian's, and the mean profile."""
    above = image.pixels_dn - detected.background.level_dn
    usable = image.pixels_dn < 0.98 * image.saturation_dn
    fits = fit_stars(above, usable, detected.xy_px, start_sigma_px=sigma_px, only=chosen)
    edges = np.linspace(0, _WING_SIGMA[1], 17)
    wings, weights, profiles = [], [], []
    for k, star in enumerate(chosen):
        measured = _star_profile(above, usable, detected.xy_px, int(star), float(fits.sigma_px[k]), fits.xy_px[k])
        if measured is None or not fits.converged[k]:
            continue
        radius, light, gaussian = measured
        peak = float(fits.peak_dn[k])
        outside = (radius >= _WING_SIGMA[0]) & (radius < _WING_SIGMA[1])
        sigma2 = float(fits.sigma_px[k]) ** 2
        # Where neighbours hide pixels, the others stand for them.
        area = np.pi * (_WING_SIGMA[1] ** 2 - _WING_SIGMA[0] ** 2) * (sigma2 + PIXEL_VARIANCE_PX2)
        wings.append(area * float(np.mean(light[outside] - peak * gaussian[outside])) / (2 * np.pi * sigma2 * peak))
        weights.append(min(signal[k], _CLEAREST_SNR) ** 2)
        count = np.histogram(radius, edges)[0]
        recorded_peak = peak * sigma2 / (sigma2 + PIXEL_VARIANCE_PX2)
        total = np.histogram(radius, edges, weights=light / recorded_peak)[0]
        profiles.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    if len(wings) < _LEAST_SHAPES:
        return None, None
    values, heavy = np.array(wings), np.array(weights)
    resampled = np.random.default_rng(0).integers(0, len(values), (_RESAMPLED, len(values)))
    spread = float(np.std([_weighted_median(values[some], heavy[some]) for some in resampled]))
    stacked = RadialProfile((edges[1:] + edges[:-1]) / 2, np.nanmedian(np.array(profiles), axis=0))
    return Estimate(_weighted_median(values, heavy), spread), stacked


def _star_profile(
    above: Float, usable: NDArray[np.bool_], xy_px: Float, star: int, sigma_px: float, centre: Float
) -> tuple[Float, Float, Float] | None:
    """Return of the pixels around a star their radius in sigma, their light above the ring around it, a Gaussian."""
    recorded_px = float(np.sqrt(sigma_px**2 + PIXEL_VARIANCE_PX2))
    half = int(np.ceil(_RING_SIGMA[1] * recorded_px)) + 1
    column, row = (round(float(value)) for value in centre)
    if min(column, row) < half or column + half >= above.shape[1] or row + half >= above.shape[0]:
        return None
    x, y = np.arange(column - half, column + half + 1), np.arange(row - half, row + half + 1)
    part = np.ix_(y, x)
    radius = np.hypot(x - centre[0], (y - centre[1])[:, np.newaxis]) / recorded_px
    good = usable[part].copy()
    others = np.delete(xy_px, star, axis=0)
    for near in others[(np.abs(others - centre) < half + 5 * recorded_px).all(axis=1)]:
        good &= np.hypot(x - near[0], (y - near[1])[:, np.newaxis]) > 5 * recorded_px
    ring = good & (radius >= _RING_SIGMA[0]) & (radius < _RING_SIGMA[1])
    wing = good & (radius >= _WING_SIGMA[0]) & (radius < _WING_SIGMA[1])
    if min(ring.sum(), wing.sum()) < 40:
        return None
    gaussian = np.outer(profile(y - centre[1], sigma_px), profile(x - centre[0], sigma_px))
    inside = good & (radius < _WING_SIGMA[1])
    return radius[inside], above[part][inside] - float(np.mean(above[part][ring])), gaussian[inside]


def _weighted_median(values: Float, weights: Float) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    return float(np.interp(weights.sum() / 2, below, values[order]))


def _ellipse(image: SkyImage, detected: DetectedStars, xy_px: Float, sigma_px: float) -> tuple[Estimate | None, float]:
    """Return the ellipticity of the mean star without the pixel's own width, and the direction of its long axis."""
    above = image.pixels_dn - detected.background.level_dn
    usable = image.pixels_dn < 0.98 * image.saturation_dn
    xx, yy, xy = star_shapes(above, usable, xy_px, sigma_px)
    size = xx + yy - 2 * PIXEL_VARIANCE_PX2
    good = size > 0.1 * sigma_px**2
    if good.sum() < _LEAST_SHAPES:
        return None, 0.0
    parts = np.column_stack([(xx - yy)[good], 2 * xy[good]]) / float(np.median(size[good]))
    resampled = np.random.default_rng(0).integers(0, len(parts), (_RESAMPLED, len(parts)))
    error = float(np.median(parts[resampled], axis=1).std(axis=0).max())
    e1, e2 = np.median(parts, axis=0)
    return Estimate(float(np.hypot(e1, e2)), error), float(np.arctan2(e2, e1) / 2 % np.pi)


def _noise_structure(image: SkyImage, detected: DetectedStars) -> tuple[Estimate | None, Estimate | None]:
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
        Estimate(float(np.median(correlations)), 1.25 * float(np.std(correlations, ddof=1)) / count),
        Estimate(ratio - 1, ratio * error / float(middle.min() * np.sqrt(2))),
    )


def _patch_noise(above: Float, noise_dn: float, xy_px: Float, sigma_px: float) -> tuple[float, Float] | None:
    """Return the correlation of neighbours, and the noise variance of the lattice's four pixels over their mean."""
    starless = np.abs(above) < _STAR_SIGMA * max(noise_dn, 0.3)
    reach = 5 * sigma_px + 2
    for x, y in xy_px[((xy_px > -reach) & (xy_px < len(above) + reach)).all(axis=1)]:
        rows = slice(max(0, int(y - reach)), max(0, int(y + reach) + 1))
        columns = slice(max(0, int(x - reach)), max(0, int(x + reach) + 1))
        starless[rows, columns] = False
    if starless.sum() < _LEAST_PIXELS:
        return None
    left = np.where(starless, above - above[starless].mean(), 0.0)
    variance = float((left**2).sum() / starless.sum())
    phases = [(slice(row, None, 2), slice(column, None, 2)) for row in (0, 1) for column in (0, 1)]
    counts = np.array([starless[phase].sum() for phase in phases])
    lattice = np.array([(left[phase] ** 2).sum() for phase in phases]) / np.maximum(counts, 1)
    # A sky of one number has no noise to examine.
    if variance < 1e-3 or counts.min() < _LEAST_PIXELS // 8 or lattice.min() <= 0:
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
