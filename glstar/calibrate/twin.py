"""The twin of a photograph: the image that the simulator makes of the same stars, and how the two differ."""

import json
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Index
from glstar.calibrate.identify.platesolution import ReferenceStars, sidereal_trails
from glstar.calibrate.photo.photograph import Photograph, encoded_image, linearised, recorded_again
from glstar.calibrate.photo.psf import fit_stars
from glstar.calibrate.photo.sky import SkyMap
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.photographmodel import PhotographModel
from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import PIXEL_VARIANCE_PX2
from glstar.config import Config
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.trailmodels import SubExposures
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Renderer, Scene
from glstar.render.scene.starcomponents import in_band
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn
from glstar.sky.observed.stars import SIDEREAL_RAD_PER_S
from glstar.sky.place.site import Site

# Sine of the altitude of the horizon that lets all stars be up.
_NO_HORIZON = -2.0
# Largest distance of the sub-exposures of a sidereal trail, px.
_SPACING_PX = 0.25
# Peaks above this multiple of the sky's noise are compared, and the widths of this number of the brightest stars.
_PEAK_SNR = 3.0
_WIDTHS = 60
_BRIGHTEST = 10
_PROFILE_PX = 10
# Half the side of the square around a star whose median is its sky, px.
_SKY_PX = 12
# A pixel above this fraction of the largest number is clipped.
_CLIPPED = 0.98
# The noise is compared at this number of levels of the sky, without differences of neighbours beyond this multiple of
# their standard deviation, and where this number of neighbours differ at all.
_NOISE_LEVELS = 12
_NOISE_SIGMA = 4.0
_LEAST_DIFFERENCES = 30
_CLIPS = 5


@dataclass(frozen=True, slots=True)
class TwinFigures:
    """How a twin differs from its photograph."""

    sky_ks: float  # Kolmogorov-Smirnov distance of the pixels of the sky
    # Root mean square of the relative difference of the noise over the levels of the sky; None if there is too little.
    noise_error: float | None
    neighbour_correlation: float  # Of the noise of neighbouring pixels
    twin_neighbour_correlation: float
    peak_error: float  # Mean absolute relative error of the brightest pixel of each star
    # The same of a twin whose stars have the brightness of the catalogue in the camera's band, and not each its own.
    catalogue_peak_error: float
    peak_noise: float  # The same between two twins that differ in their noise only
    width_ratio: float  # Median width of the twin's stars over that of the photograph's
    # Largest difference of the mean radial profiles of the ten brightest stars, over the profile's peak.
    profile_error: float
    # Number of stars whose peaks, and whose widths, were compared: those that the photograph does not clip.
    stars: int
    width_stars: int

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name."""
        return {name: None if value is None or np.isnan(value) else value for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    """A photograph's twin with what is compared."""

    pixels: NDArray[Any]  # (height, width) uint8 or uint16: the simulated image, DN
    figures: TwinFigures
    peaks_dn: Float  # (2, n) peaks of stars in photograph and twin
    profiles_dn: Float  # (2, k) mean radial profiles of the ten brightest stars, at 0, 1, 2 ... px
    noise_dn: Float  # (3, n) levels of the sky, and the noise of photograph and twin there


@dataclass(frozen=True, slots=True, eq=False)
class TwinResult:
    """A calibration with its twin."""

    calibration: Calibration
    model: PhotographModel
    twin: Twin

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values."""
        numbers = self.calibration.to_json() | {"sensor": self.model.calibration.sensor.keys}
        return numbers | {"photograph": self.model.to_json(), "twin": self.twin.figures.to_json()}

    def files(self, name: str) -> dict[str, bytes]:
        """Return all numbers, the twin and the comparison, by file name; `name`: without suffix."""
        recorded = recorded_again(self.calibration.image, self.twin.pixels)
        return {
            f"{name}.json": (json.dumps(self.to_json(), indent=1) + "\n").encode(),
            f"{name}.twin.png": encoded_image(".png", recorded),
            f"{name}.pair.png": draw_twin(self.model, self.twin),
        }


def model_files(model: PhotographModel, name: str) -> dict[str, bytes]:
    """Return a model and the maps that it refers to, by file name; `name`: without suffix."""
    sky_map, dark_frame, brightness = f"{name}.sky.tiff", f"{name}.hot.tiff", f"{name}.brightness.csv"
    files = {brightness: model.brightness.to_csv().encode()}
    if model.has_map:
        files[sky_map] = encoded_image(".tiff", model.sky_texels)
    if model.dark_frame is not None:
        files[dark_frame] = encoded_image(".tiff", model.dark_frame)
    return files | {f"{name}.toml": model.to_toml(sky_map, dark_frame, brightness).encode()}


def make_twin(calibration: Calibration, model: PhotographModel, config: Config) -> TwinResult:
    """Return the twin of a photograph, and how the two differ.

    `config`: what `model_files` holds, read from its files.  Raises CalibrationError as `render_twin`.
    """
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only where an image is drawn

    with GLRenderer.headless() as renderer:
        pixels = render_twin(model, config, renderer)
        again = render_twin(model, config, renderer, seed=2)
        of_catalogue = render_twin(model, config, renderer, catalogue_brightness=True)
    calibration = replace(calibration, notes=model.calibration.notes)
    return TwinResult(calibration, model, compare_twin(model, pixels, again, of_catalogue))


def render_twin(
    model: PhotographModel, config: Config, renderer: Renderer, *, seed: int = 1, catalogue_brightness: bool = False
) -> NDArray[Any]:
    """Return the image that the simulator makes of a photograph's stars.

    `config`: what the calibration wrote; `seed`: of the noise; `catalogue_brightness`: whether stars have the
    catalogue's brightness instead of the photograph's.  Returns (height, width) uint8 or uint16: mirrored if the
    photograph is.
    """
    calibration = model.calibration
    solution, reference = calibration.matches.solution, calibration.reference
    sensor, camera = config.sensor(), config.camera()
    exposure_s = calibration.sensor.reference_exposure_s
    recorded = None if catalogue_brightness else config.star_brightness()
    stars = in_band(reference.stars if recorded is None else recorded.applied(reference.stars), sensor.colour)
    shown = np.sort(calibration.matches.predicted).astype(np.int32)
    peak_dn = sensor.peak_dn(stars.camera_mag[shown], exposure_s)
    radius_px = sensor.truncation_radius_px(peak_dn)
    longest_px = 0.0
    if model.moved:
        trails_px = sidereal_trails(solution, calibration.matches.predicted_xy_px, exposure_s)
        longest_px = float(np.linalg.norm(trails_px, axis=1).max(initial=0.0))
    count = 1 + 2 * int(np.ceil(longest_px / _SPACING_PX / 2))

    def pointing(fraction: Float) -> Pointing:
        return _pointing(reference, _turning(solution.C_camera_eq, exposure_s if longest_px else 0.0, fraction))

    scene = Scene(
        stars=stars,
        draw_list=DrawList(shown, radius_px + longest_px / 2),
        trails=SubExposures(pointing((np.arange(count) + 0.5) / count)),
        camera=camera,
        sensor=sensor,
        exposure=Exposure(0.0, exposure_s, trail="sprites"),
        site=Site(0.0, 0.0, 0.0),
        C_camera_body=np.eye(3),
        q_body_ned=np.array([1.0, 0.0, 0.0, 0.0]),
        shutter=pointing(np.array([0.0, 0.5, 1.0])),
    )
    pixels = renderer.render(scene, seed=seed).pixels
    return np.ascontiguousarray(pixels[:, ::-1]) if solution.mirrored else pixels


def _pointing(reference: ReferenceStars, C_camera_eq: Float) -> Pointing:
    zenith, velocity = (
        np.repeat(one[np.newaxis], len(C_camera_eq), axis=0) for one in (reference.zenith_eq, reference.velocity_eq)
    )
    if zenith.any():
        return Pointing(C_camera_eq, zenith, velocity, reference.refraction_scale)
    # Without a site there is no horizon: all stars are up, those behind the camera too.
    return Pointing(C_camera_eq, C_camera_eq[:, 2], velocity, reference.refraction_scale, sine_horizon=_NO_HORIZON)


def _turning(C_camera_eq: Float, exposure_s: float, fraction: Float) -> Float:
    """Return the attitudes of a camera at rest on the ground, given its attitude at mid-exposure, (n, 3, 3).

    `fraction` is the time since the start of the exposure over its duration, (n,).
    """
    angles = SIDEREAL_RAD_PER_S * exposure_s * (fraction - 0.5)
    pole = np.array([0.0, 0.0, 1.0])
    return np.array([C_camera_eq @ matrix_from_quaternion(quaternion_from_turn(angle * pole)) for angle in angles])


def compare_twin(model: PhotographModel, pixels: NDArray[Any], again: NDArray[Any], of_catalogue: NDArray[Any]) -> Twin:
    """Return how a twin differs from its photograph.

    The images are (height, width) uint8 or uint16: the twin; `again`, a twin with other noise; `of_catalogue`, a twin
    whose stars have the brightness of the catalogue.
    """
    calibration = model.calibration
    real = calibration.image.pixels_dn
    twin, other, plain = (_light_dn(calibration.image, image) for image in (pixels, again, of_catalogue))
    both = (real, twin)
    sky = model.sky
    noise_dn = neighbour_noise_dn(sky, both)
    matches = calibration.matches
    at = np.rint(matches.predicted_xy_px[np.isin(matches.predicted, matches.star)]).astype(int)
    peaks = np.array([_peaks_dn(image, at) for image in (*both, other, plain)])
    bright_dn = _PEAK_SNR * calibration.sensor.background_std_dn(calibration.sensor.reference_exposure_s)
    # What a clipped star would have had is unknown, and two clipped peaks are equal.
    good = (peaks[0] > bright_dn) & [not _is_clipped(calibration, (real,), star) for star in at]
    order = np.flatnonzero(good)[np.argsort(-peaks[0][good], kind="stable")]
    whole = order[[not _is_clipped(calibration, both, star) for star in at[order]]]
    widths, counts = zip(*(_width(calibration, image, at[whole][:_WIDTHS]) for image in both), strict=True)
    profiles = np.array([_profile(image, at[order][:_BRIGHTEST]) for image in both])
    figures = TwinFigures(
        sky_ks=_distance(*(image[sky.is_sky] for image in both)),
        noise_error=float(np.sqrt(np.mean((noise_dn[2] / noise_dn[1] - 1) ** 2))) if noise_dn.size else None,
        neighbour_correlation=_correlation(sky.residual_dn, sky.is_sky),
        twin_neighbour_correlation=_correlation(twin - sky.level_dn, sky.is_sky),
        peak_error=_relative_error(peaks[1][good], peaks[0][good]),
        catalogue_peak_error=_relative_error(peaks[3][good], peaks[0][good]),
        peak_noise=_relative_error(peaks[2][good], peaks[1][good]),
        width_ratio=widths[1] / widths[0],
        profile_error=float(np.abs(profiles[1] - profiles[0]).max() / profiles[0].max()) if len(order) else np.nan,
        stars=int(good.sum()),
        width_stars=min(counts),
    )
    return Twin(pixels, figures, peaks[:2, good], profiles, noise_dn)


def _relative_error(values: Float, true: Float) -> float:
    """Return the mean absolute relative error; NaN of nothing."""
    return float(np.mean(np.abs(values / true - 1))) if len(true) else np.nan


def _light_dn(image: Photograph, pixels: NDArray[Any]) -> Float:
    """Return raw pixels with the steps that the file of a photograph has, DN of light."""
    if image.gamma == "linear":
        return pixels.astype(np.float64)
    recorded = recorded_again(image, pixels).astype(np.float64)
    return linearised(replace(image, pixels_dn=recorded, bit_depth=image.recorded_bits), image.gamma).pixels_dn


def _distance(one: Float, other: Float) -> float:
    """Return the Kolmogorov-Smirnov distance of two samples."""
    levels = np.unique(np.concatenate([one[::20], other[::20]]))
    below = [np.searchsorted(np.sort(values), levels, side="right") / len(values) for values in (one, other)]
    return float(np.abs(below[0] - below[1]).max())


def neighbour_noise_dn(sky: SkyMap, images: tuple[Float, ...]) -> Float:
    """Return levels of the sky, and the standard deviations of k images of it there, (1 + k, n), DN.

    By the differences of neighbours, which neither the slope of a sky nor an error of its map changes; the rounding is
    in them.  All images are compared at the same pixels.
    """
    levels, differences = [], []
    for axis in (0, 1):
        one, other = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        good = sky.is_sky[one] & sky.is_sky[other]
        levels.append(sky.level_dn[one][good])
        differences.append([(image[one] - image[other])[good] for image in images])
    level, difference = np.concatenate(levels), np.concatenate(differences, axis=1)
    rows = [
        [level[part].mean(), *(_clipped_rms(one[part]) / np.sqrt(2) for one in difference)]
        for part in np.array_split(np.argsort(level, kind="stable"), _NOISE_LEVELS)
        if all(np.count_nonzero(one[part]) >= _LEAST_DIFFERENCES for one in difference)
    ]
    return np.array(rows).T


def _clipped_rms(difference: Float) -> float:
    """Return the root mean square of differences without outliers; single steps of whole numbers are none."""
    size = np.abs(difference)
    step, limit = float(np.median(size[size > 0])), np.inf
    for _ in range(_CLIPS):
        rms = float(np.sqrt(np.mean(size[size <= limit] ** 2)))
        limit = max(_NOISE_SIGMA * rms, 1.01 * step)
    return rms


def _correlation(residual: Float, is_sky: NDArray[np.bool_]) -> float:
    """Return the correlation of horizontal and vertical neighbours, less the correlation of pixels 6 px away."""
    scale = np.median(np.abs(residual[is_sky])) * 1.4826
    good = is_sky & (np.abs(residual) < 3.5 * max(float(scale), 0.5))
    noise = np.where(good, residual - residual[good].mean(), 0.0)
    variance = float((noise**2).sum() / max(good.sum(), 1))

    def at(lag: int) -> float:
        pairs = (good[:, lag:] & good[:, :-lag]).sum() + (good[lag:] & good[:-lag]).sum()
        total = (noise[:, lag:] * noise[:, :-lag]).sum() + (noise[lag:] * noise[:-lag]).sum()
        return float(total / max(pairs, 1))

    return (at(1) - at(6)) / max(variance, 1e-9)


def _peaks_dn(image: Float, xy_px: Index) -> Float:
    """Return the largest pixel around each position above the median of its surroundings, DN."""
    peaks_dn = []
    for x, y in xy_px:
        near = image[max(0, y - _SKY_PX) : y + _SKY_PX + 1, max(0, x - _SKY_PX) : x + _SKY_PX + 1]
        peaks_dn.append(image[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].max() - np.median(near))
    return np.array(peaks_dn)


def _is_clipped(calibration: Calibration, images: tuple[Float, ...], star: Index) -> bool:
    """Return whether a pixel of a star is clipped in any of some images."""
    (x, y), limit = star.tolist(), _CLIPPED * calibration.image.saturation_dn
    return any(image[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4].max() >= limit for image in images)


def _width(calibration: Calibration, image: Float, xy_px: Index) -> tuple[float, int]:
    """Return the median width of Gaussians fitted to stars, pixel included, px, and how many converged."""
    if not len(xy_px):
        return np.nan, 0
    fits = fit_stars(
        image - calibration.detected.background.level_dn, np.ones(image.shape, np.bool_), xy_px.astype(np.float64),
        start_sigma_px=calibration.detected.psf_sigma_px,
    )  # fmt: skip
    recorded_px = np.sqrt(fits.sigma_px**2 + PIXEL_VARIANCE_PX2)[fits.converged]
    return (float(np.median(recorded_px)), len(recorded_px)) if len(recorded_px) else (np.nan, 0)


def _profile(image: Float, xy_px: Index) -> Float:
    """Return the mean radial profile of stars above their sky at 0, 1, 2 ... px, DN."""
    along = np.arange(-_PROFILE_PX, _PROFILE_PX + 1)
    radius = np.rint(np.hypot(along, along[:, np.newaxis])).astype(int)
    profiles_dn = []
    for x, y in xy_px:
        if min(x, y) < _SKY_PX or x + _SKY_PX >= image.shape[1] or y + _SKY_PX >= image.shape[0]:
            continue
        near = image[y - _SKY_PX : y + _SKY_PX + 1, x - _SKY_PX : x + _SKY_PX + 1]
        above = image[y - _PROFILE_PX : y + _PROFILE_PX + 1, x - _PROFILE_PX : x + _PROFILE_PX + 1] - np.median(near)
        profiles_dn.append([above[radius == r].mean() for r in range(_PROFILE_PX + 1)])
    return np.mean(profiles_dn, axis=0) if profiles_dn else np.zeros(_PROFILE_PX + 1)


_DPI = 110
# Black and white of the whole images, quantiles of the photograph; and of the details, noises about the sky.
_BLACK, _WHITE = 0.001, 0.9995
_DETAIL_SIGMA = (-3.0, 12.0)
# Side of the detail, px, which is shown at twice its size.
_DETAIL_PX = 220
_MEASURED, _SIMULATED = "k", "tab:red"


def draw_twin(model: PhotographModel, twin: Twin) -> bytes:
    """Return a photograph beside its twin as a PNG.

    It shows both images, a detail in the shadows, and measured beside simulated: the pixels of the sky, their noise
    against the level, the mean profile of the ten brightest stars, and the peaks of all, without clipped ones.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415 - a second to load

    figure = Figure(figsize=(15, 11))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 4, left=0.05, right=0.98, top=0.92, bottom=0.06, hspace=0.2, wspace=0.25, height_ratios=(1.25, 1)
    )
    both = (model.calibration.image.pixels_dn, twin.pixels.astype(np.float64))
    names = (model.calibration.image.path.name, "its twin")
    low, high = np.quantile(both[0], (_BLACK, _WHITE))
    for column, (image, name) in enumerate(zip(both, names, strict=True)):
        axes = figure.add_subplot(grid[0, 2 * column : 2 * column + 2])
        shown = np.clip((image - low) / max(high - low, 1e-9), 0, 1) ** 0.6
        axes.imshow(shown, cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
        axes.set_title(name, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
        _draw_detail(axes, model, image)
    _draw_sky(figure.add_subplot(grid[1, 0]), model, both)
    _draw_noise(figure.add_subplot(grid[1, 1]), twin)
    _draw_profiles(figure.add_subplot(grid[1, 2]), twin)
    _draw_peaks(figure.add_subplot(grid[1, 3]), twin)
    figures = twin.figures
    figure.suptitle(
        f"sky: Kolmogorov-Smirnov distance {figures.sky_ks:.3f}; peaks of {figures.stars} stars:"
        f" {100 * figures.peak_error:.0f} % off (the noise alone {100 * figures.peak_noise:.0f} %); widths of"
        f" {figures.width_stars}: ratio {figures.width_ratio:.3f}; profile: {100 * figures.profile_error:.0f} % off;"
        f" neighbouring pixels correlated {figures.neighbour_correlation:.2f},"
        f" twin {figures.twin_neighbour_correlation:.2f}",
        fontsize=11,
    )
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI, metadata={"Software": "glstar"}, pil_kwargs={"compress_level": 9})
    return drawn.getvalue()


def _draw_detail(axes: Any, model: PhotographModel, image: Float) -> None:
    """Draw an inset around the middle of the image, with the shadows brightened."""
    height, width = image.shape
    side = min(_DETAIL_PX, height, width)
    top, left = (height - side) // 2, (width - side) // 2
    part = slice(top, top + side), slice(left, left + side)
    level = float(np.median(model.sky.level_dn[part]))
    noise_dn = 1.4826 * float(np.median(np.abs(model.sky.residual_dn[part])))
    low, high = (level + sigma * max(noise_dn, 0.5) for sigma in _DETAIL_SIGMA)
    inset = axes.inset_axes((0.62, 0.0, 0.38, 0.38 * width / height))
    inset.imshow(image[part], cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    inset.set_xticks([])
    inset.set_yticks([])


def _draw_sky(axes: Any, model: PhotographModel, both: tuple[Float, Float]) -> None:
    values = [image[model.sky.is_sky] for image in both]
    low, high = np.quantile(values[0], (0.0005, 0.9995))
    step = max(1.0, np.ceil((high - low) / 100))
    bins = np.arange(np.floor(low) - 0.5, high + step, step)
    axes.hist(values[0], bins=bins, color="0.7", label="photograph")
    axes.hist(values[1], bins=bins, histtype="step", color=_SIMULATED, label="twin")
    axes.set_title("pixels of the sky", fontsize=10)
    axes.set_xlabel("DN")
    axes.legend(fontsize=7)


def _draw_noise(axes: Any, twin: Twin) -> None:
    if twin.noise_dn.size:
        level_dn, *both = twin.noise_dn
        for std_dn, colour, name in zip(both, (_MEASURED, _SIMULATED), ("photograph", "twin"), strict=True):
            axes.plot(level_dn, std_dn, "o-", ms=3, lw=1, color=colour, label=name)
    axes.set_title("noise of the sky against its level", fontsize=10)
    axes.set_xlabel("level, DN")
    axes.set_ylabel("standard deviation, DN")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7)


def _draw_profiles(axes: Any, twin: Twin) -> None:
    for profile, colour, name in zip(twin.profiles_dn, (_MEASURED, _SIMULATED), ("photograph", "twin"), strict=True):
        axes.plot(np.maximum(profile, 1e-3 * twin.profiles_dn.max()), "o-", ms=3, lw=1, color=colour, label=name)
    axes.set_yscale("log")
    axes.set_title("mean profile of the ten brightest stars", fontsize=10)
    axes.set_xlabel("distance from the centre, px")
    axes.set_ylabel("above the sky, DN")
    axes.legend(fontsize=7)


def _draw_peaks(axes: Any, twin: Twin) -> None:
    real, simulated = np.maximum(twin.peaks_dn, 1e-3)
    axes.plot(real, simulated, ".", ms=4, color=_SIMULATED)
    if len(real):
        ends = [real.min(), real.max()]
        axes.plot(ends, ends, "-", lw=1, color=_MEASURED)
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            _label_few(axis)
    axes.set_title("brightest pixel of each star above the sky", fontsize=10)
    axes.set_xlabel("photograph, DN")
    axes.set_ylabel("twin, DN")


def _label_few(axis: Any) -> None:
    """Label a logarithmic axis with numbers that do not overlap, also if it is shorter than a decade."""
    from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter  # noqa: PLC0415 - a second to load

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high > 5 * low else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(np.inf, np.inf)))
    axis.set_minor_formatter(NullFormatter())
