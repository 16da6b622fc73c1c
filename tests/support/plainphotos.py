"""Photographs of the stars drawn with NumPy and OpenCV only, without glstar's own cameras.

Catalogue stars go through `cv2.projectPoints` or through r = f theta, so that `glstar camera calibrate` is compared
with independent code.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import erf

from glstar.calibrate.identify.platesolution import Matches, ReferenceStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.model import Camera
from glstar.sky.observed.stars import Sky
from glstar.sky.photometry import star_colours
from glstar.sky.place.apparent import ASTROMETRY
from tests.support.starphotos import ALL_STARS

Float = NDArray[np.float64]
Projection = Callable[[Float], Float]

# When the photographs are taken, UTC seconds since 1970.
UTC_S = 1_577_836_800.0
REFERENCE = ReferenceStars.anywhere(Sky(ALL_STARS, ASTROMETRY["paper"]), UTC_S)
# Stars fainter than any detection on these photographs are not drawn.
_FAINTEST_VMAG = 7.5


@dataclass(frozen=True)
class PlainPhoto:
    """A photograph, the attitude of its camera, and the projection of its lens."""

    image: Photograph
    projection: Projection
    C_camera_eq: Float

    def true_xy_px(self, star: NDArray[np.intp]) -> Float:
        """Return the true pixel positions of stars of `REFERENCE`, (n, 2)."""
        return self.projection(REFERENCE.stars.direction_eq[star] @ self.C_camera_eq.T)

    def off_px(self, matches: Matches) -> Float:
        """Return how far each identified star lies from its true position, (n,) px."""
        true = self.true_xy_px(matches.star)
        return np.asarray(np.linalg.norm(matches.residual_px + matches_xy(matches) - true, axis=1))


def matches_xy(matches: Matches) -> Float:
    """Return the positions of the catalogue's stars according to the fitted camera, (n, 2) px."""
    row = {int(star): k for k, star in enumerate(matches.predicted)}
    return matches.predicted_xy_px[[row[int(star)] for star in matches.star]]


def equidistant(f_px: float, cx_px: float, cy_px: float) -> Projection:
    """Return the projection r = f theta of a fisheye, of the whole sphere."""

    def project(direction: Float) -> Float:
        x, y, z = direction.T
        across = np.hypot(x, y)
        r_px = f_px * np.arctan2(across, z)
        return np.column_stack([x, y]) * (r_px / np.maximum(across, 1e-12))[:, np.newaxis] + (cx_px, cy_px)

    return project


def barrel(f_px: float, cx_px: float, cy_px: float, *coefficients: float) -> Projection:
    """Return OpenCV's projection through a plumb_bob lens; NaN more than 45 deg off the axis."""
    matrix = np.array([[f_px, 0, cx_px], [0, f_px, cy_px], [0, 0, 1.0]])

    def project(direction: Float) -> Float:
        ahead = direction[:, 2] > np.sqrt(0.5)
        points = np.where(ahead[:, np.newaxis], direction, [0.0, 0.0, 1.0])
        xy, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
        return np.where(ahead[:, np.newaxis], xy[:, 0], np.nan)

    return project


def _star_light(shape: tuple[int, int], xy_px: Float, peak_dn: Float, sigma_px: float) -> Float:
    """Return Gaussians integrated over the pixels, (height, width) float64, DN."""
    light = np.zeros(shape)
    half = int(np.ceil(5 * sigma_px)) + 1
    for (x, y), peak in zip(xy_px, peak_dn, strict=True):
        column, row = round(x), round(y)
        columns = np.arange(max(0, column - half), min(shape[1], column + half + 1))
        rows = np.arange(max(0, row - half), min(shape[0], row + half + 1))
        if columns.size and rows.size:
            profiles = [
                sigma_px
                * np.sqrt(np.pi / 8)
                * (erf((at + 0.5) / (sigma_px * 2**0.5)) - erf((at - 0.5) / (sigma_px * 2**0.5)))
                * 2
                for at in (rows - y, columns - x)
            ]
            light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += peak * np.outer(*profiles)
    return light


def _drawn_stars(
    projection: Projection, C_camera_eq: Float, shape: tuple[int, int], band_slope: float = 0.0, own_mag: float = 0.0
) -> tuple[Float, Float]:
    """Return pixel positions and magnitudes (V, or in the camera's band) of the catalogue's stars on an image."""
    bright = REFERENCE.stars.vmag < _FAINTEST_VMAG
    xy = projection(REFERENCE.stars.direction_eq[bright] @ C_camera_eq.T)
    x, y = xy.T
    on_image = (x > -3) & (y > -3) & (x < shape[1] + 2) & (y < shape[0] + 2)
    tint = band_slope * np.nan_to_num(star_colours(REFERENCE.stars)[bright][on_image], nan=0.65).clip(-0.3, 1.7)
    tint += own_mag * own_deviations()[bright][on_image]
    return xy[on_image], REFERENCE.stars.vmag[bright][on_image] + tint


def own_deviations() -> Float:
    """Return how much fainter each star of `REFERENCE` is than the catalogue says, of standard deviation 1."""
    return np.random.default_rng(77).normal(size=len(REFERENCE.stars))


def all_sky(seed: int = 1, *, shape: tuple[int, int] = (1000, 1000), across_deg: float = 180.0) -> PlainPhoto:
    """Return the sky through an equidistant fisheye whose circle touches the edges of the image."""
    rng = np.random.default_rng(seed)
    height, width = shape
    f_px = (min(shape) / 2 - 4) / np.deg2rad(across_deg / 2)
    circle = equidistant(f_px, width / 2 + 3.2, height / 2 - 2.1)
    C_camera_eq = Rotation.random(random_state=rng).as_matrix()

    def project(direction: Float) -> Float:
        off_rad = np.arccos(np.clip(direction[:, 2], -1, 1))
        return np.where((off_rad < np.deg2rad(across_deg / 2))[:, np.newaxis], circle(direction), np.nan)

    xy, vmag = _drawn_stars(project, C_camera_eq, shape)
    light = _star_light(shape, xy, 350 * 10 ** (-0.4 * (vmag - 2.0)), 1.2)
    pixels = light + rng.normal(14, 1.5, shape)
    image = Photograph(Path("allsky.png"), np.floor(np.clip(pixels, 0, 255) + 0.5), 8, "grey", 30.0)
    return PlainPhoto(image, project, C_camera_eq)


def hazy(
    seed: int = 1, *, shape: tuple[int, int] = (1520, 2028), limit_vmag: float = 4.5, false_stars: int = 1000
) -> PlainPhoto:
    """Return a short exposure of a wide hazy sky, with many false detections.

    50 deg wide through a moderate barrel; haze in patches of up to 1.5 mag before an uneven bright sky; noise that
    neighbouring pixels share, as after demosaicing, and hot pixels that it has spread to the size of stars.
    """
    rng = np.random.default_rng(seed)
    height, width = shape
    f_px = width / 2 / np.tan(np.deg2rad(25.0)) * rng.uniform(0.97, 1.03)
    k1, k2 = rng.uniform(-0.30, -0.06), rng.uniform(0.0, 0.1)
    centre = np.array([width / 2, height / 2]) + rng.normal(0, 0.005 * width, 2)
    projection = barrel(f_px, *centre, k1, k2, 0.0, 0.0)
    C_camera_eq = Rotation.random(random_state=rng).as_matrix()
    xy, vmag = _drawn_stars(projection, C_camera_eq, shape)

    def patches(scale_px: float) -> Float:
        coarse = rng.normal(size=(int(height / scale_px) + 4, int(width / scale_px) + 4))
        smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        return np.asarray((smooth - smooth.min()) / np.ptp(smooth))

    noise_dn, sigma_px = 3.0, 1.3
    # Detection begins at a peak of five times the noise after smoothing.
    noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 0.6)
    noise *= noise_dn / noise.std()
    haze_mag = 1.5 * patches(500)
    columns, rows = np.clip(np.rint(xy).astype(int), 0, [width - 1, height - 1]).T
    peak_dn = 3.0 * noise_dn * 10 ** (-0.4 * (vmag - limit_vmag + haze_mag[rows, columns]))
    light = _star_light(shape, xy, peak_dn, sigma_px)
    hot = np.zeros(shape)
    count = int(rng.uniform(0.5, 1.5) * false_stars)
    hot[rng.integers(0, height, count), rng.integers(0, width, count)] = rng.exponential(0.15, count) + 0.5
    hot = 40.0 * noise_dn * cv2.GaussianBlur(hot, (0, 0), 1.1)
    across, down = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    sky = 35 + 25 * rng.uniform(-1, 1) * across + 25 * rng.uniform(0, 1) * down + 20 * patches(400)
    pixels = np.clip(light + hot + sky + noise, 0, 255)
    image = Photograph(Path("hazy.png"), np.floor(pixels + 0.5), 8, "grey", 0.5)
    return PlainPhoto(image, projection, C_camera_eq)


def imperfect(
    seed: int = 1,
    *,
    moffat_beta: float | None = None,
    corner_loss: float = 0.0,
    gradient_dn: float = 0.0,
    axis_ratio: float = 1.0,
    corner_growth: float = 0.0,
    demosaiced: bool = False,
    dn_per_e: float = 0.0,
    band_slope: float = 0.0,
    tilt: float = 0.0,
    own_mag: float = 0.0,
    shape: tuple[int, int] = (768, 1024),
) -> PlainPhoto:
    """Return 42 deg of the sky through a pinhole with known imperfections of a real camera.

    A Moffat PSF of the same full width at half maximum as the Gaussian of 1.3 px; light of stars and sky lost towards
    the corner as r^2; a sky that brightens to the right; stars longer than wide at 30 deg from the x axis; sigma that
    grows as r^2; the brightest of three colours interpolated from a Bayer mosaic; Poisson noise of electrons
    besides the noise of 3 DN; stars brighter or fainter by `band_slope` times B - V, and each by its own deviation
    from the catalogue of `own_mag` rms; sigma that grows to the right by `tilt` over half the diagonal.
    """
    rng = np.random.default_rng(seed)
    height, width = shape
    sigma_px, noise_dn, sky_dn = 1.3, 3.0, 40.0
    axis_px = np.array([width / 2, height / 2])
    projection = barrel(width / 2 / np.tan(np.deg2rad(21.0)), *axis_px, 0.0, 0.0, 0.0, 0.0)
    C_camera_eq = Rotation.random(random_state=rng).as_matrix()
    xy, vmag = _drawn_stars(projection, C_camera_eq, shape, band_slope, own_mag)

    def corner2(x_px: Float, y_px: Float) -> Float:
        return np.asarray(((x_px - axis_px[0]) ** 2 + (y_px - axis_px[1]) ** 2) / (axis_px**2).sum())

    along = np.deg2rad(30.0)
    half, oversampled = 24, 5
    steps = (np.arange(oversampled) - oversampled // 2) / oversampled
    light = np.zeros((height + 2 * half, width + 2 * half))
    for (x, y), peak in zip(xy, 12 * noise_dn * 10 ** (-0.4 * (vmag - 5.6)), strict=True):
        column, row = round(x), round(y)
        at = (np.arange(-half, half + 1)[:, np.newaxis] + steps).ravel()
        dx, dy = np.meshgrid(at + column - x, at + row - y)
        long = (np.cos(along) * dx + np.sin(along) * dy) / np.sqrt(axis_ratio)
        short = (np.cos(along) * dy - np.sin(along) * dx) * np.sqrt(axis_ratio)
        to_the_right = float((x - axis_px[0]) / np.hypot(*axis_px))
        width_px = sigma_px * (1 + corner_growth * float(corner2(x, y)) + tilt * to_the_right)
        r2 = (long**2 + short**2) / width_px**2
        if moffat_beta is None:
            star = np.exp(-r2 / 2)
        else:
            star = (1 + r2 / (2 * np.log(2)) * (2 ** (1 / moffat_beta) - 1)) ** -moffat_beta
        # The flux does not depend on the width.
        star *= peak * (sigma_px / width_px) ** 2
        pixels = star.reshape(2 * half + 1, oversampled, 2 * half + 1, oversampled).mean(axis=(1, 3))
        if 0 <= column < width and 0 <= row < height:
            light[row : row + 2 * half + 1, column : column + 2 * half + 1] += pixels
    light = light[half:-half, half:-half]
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    light = (light + sky_dn) * (1 - corner_loss * corner2(columns, rows)) + gradient_dn * (columns / (width - 1) - 0.5)
    if dn_per_e:
        light = dn_per_e * rng.poisson(light / dn_per_e)
    mosaic = np.floor(np.clip(light + rng.normal(0, noise_dn, shape), 0, 255) + 0.5)
    if demosaiced:
        colours = cv2.demosaicing(mosaic.astype(np.uint8), cv2.COLOR_BayerBG2BGR)
        mosaic = colours.max(axis=-1).astype(np.float64)
    return PlainPhoto(Photograph(Path("imperfect.png"), mosaic, 8, "grey", 0.5), projection, C_camera_eq)


def narrow(
    seed: int,
    *,
    fov_deg: float,
    limit_vmag: float,
    peak_snr: float,
    uncatalogued: int,
    tree: float = 0.0,
    is_decoy: bool = False,
) -> PlainPhoto:
    """Return a narrow view of few catalogued stars among fainter ones, with bright leaves below.

    `limit_vmag`: magnitude of stars whose peak is `peak_snr` times the noise; `uncatalogued`: fainter stars for each
    catalogued one; `tree`: fraction of the image that leaves cover; `is_decoy`: whether all stars are at random
    positions, so that no part of the sky is on the image.
    """  # fmt: skip
    rng = np.random.default_rng(seed)
    shape = height, width = 960, 1280
    f_px = width / 2 / np.tan(np.deg2rad(fov_deg / 2))
    projection = barrel(f_px, width / 2 + rng.normal(0, 3), height / 2 + rng.normal(0, 3), 0.0, 0.0, 0.0, 0.0)
    C_camera_eq = Rotation.random(random_state=rng).as_matrix()
    xy, vmag = _drawn_stars(projection, C_camera_eq, shape)
    faint = rng.poisson(len(vmag) * uncatalogued)
    xy = np.concatenate([xy, rng.uniform(0, 1, (faint, 2)) * [width, height]])
    # Numbers grow by half a decade per magnitude.
    vmag = np.append(vmag, 6.8 + np.log10(1 + rng.uniform(0, 1, faint) * (10 ** (0.5 * 1.7) - 1)) / 0.5)
    if is_decoy:
        xy = rng.uniform(0, 1, xy.shape) * [width, height]
    noise_dn, sky_dn = 3.0, 30.0
    pixels = _star_light(shape, xy, peak_snr * noise_dn * 10 ** (-0.4 * (vmag - limit_vmag)), 1.2) + sky_dn
    if tree:
        waves = []
        for side_px, weight in ((8, 0.3), (24, 0.5), (160, 1.0)):
            coarse = rng.normal(size=(height // side_px + 3, width // side_px + 3))
            waves.append(weight * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))
        edge = 0.25 * sum(waves) + np.linspace(-1, 1, height)[:, np.newaxis]
        texture = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 2.0)
        leaves = np.clip(0.4 * sky_dn + 25 * np.abs(texture / texture.std()) ** 1.5, 0, 255)
        pixels = np.where(edge > np.quantile(edge, 1 - tree), leaves, pixels)
    pixels = np.floor(np.clip(pixels + rng.normal(0, noise_dn, shape), 0, 255) + 0.5)
    return PlainPhoto(Photograph(Path("narrow.png"), pixels, 8, "grey", 1.0), projection, C_camera_eq)


def focal_px(photo: PlainPhoto) -> float:
    """Return the true focal length on the axis, px."""
    step = 1e-4
    near, on_axis = photo.projection(np.array([[step, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    return float((near - on_axis)[0] / step)


def pinhole_camera(photo: PlainPhoto, fov_deg: float) -> Camera:
    """Return the initial camera of `glstar camera calibrate --fov`."""
    height, width = photo.image.pixels_dn.shape
    f_px = float(width / 2 / np.tan(np.deg2rad(fov_deg) / 2))
    return Camera(width, height, f_px, f_px, (width - 1) / 2, (height - 1) / 2)
