"""The report of a calibration as a PNG."""

from functools import cache
from io import BytesIO
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.calibrate.geometry.camera import GeometryCalibration
from glstar.calibrate.identify.platesolution import sidereal_trails
from glstar.calibrate.photo.psf import draw_stars
from glstar.calibrate.sensor.calibration import Calibration
from glstar.calibrate.sensor.misfitmeasurement import corner_distance
from glstar.sky.catalogue.reading import star_label

_NAMED_STARS = 30
# If stars are closer than this fraction of the image's width, only the brightest is labelled.
_LABEL_SEPARATION = 0.03
_DPI = 110
# Number of ticks of an axis: matplotlib draws ten stars in the time of one tick.
_TICKS = 6
# Black and white levels of images, in standard deviations of the noise about the sky, so that faint stars are visible.
_BLACK_SIGMA, _WHITE_SIGMA = -2.0, 25.0
_STAMP_SIGMA = 4.5
# Height of the lowest row, which shows effects that the sensor model lacks, inches.
_MISFIT_TALL = 3.9
_USED, _UNUSED, _SATURATED = "tab:blue", "0.65", "tab:red"


@cache
def prepare_to_draw() -> None:
    """Load matplotlib and its fonts once; it takes 0.5 s and can run in another thread while stars are detected."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415 - a second to load

    # A small page with all elements of a report: their first use is slow.
    figure = Figure(figsize=(4, 4))
    FigureCanvasAgg(figure)
    curve = figure.add_axes((0.1, 0.1, 0.3, 0.3))
    curve.plot([1, 2], [1, 10], "o-", label="0")
    curve.set_yscale("log")
    curve.legend(fontsize=7)
    curve.set_title("prepared", fontsize=10)
    image = figure.add_axes((0.6, 0.1, 0.3, 0.3))
    image.imshow([[0.0, 1.0]], cmap="gray")
    arrows = image.quiver([0.0], [0.0], [1.0], [1.0])
    image.quiverkey(arrows, 0.9, 1.04, 1.0, "1 px", fontproperties={"size": 8})
    space: Any = figure.add_axes((0.1, 0.6, 0.3, 0.3), projection="3d")
    flat = np.zeros((2, 2))
    space.plot_surface(*np.mgrid[:2, :2], flat)
    space.plot_wireframe(*np.mgrid[:2, :2], flat)
    figure.savefig(BytesIO(), format="png")


def draw_report(calibration: Calibration) -> bytes:
    """Return the report of a calibration as a PNG.

    It has the photograph with its stars labelled, beside a simulated image of the same sky.  Then follow
    brightness against magnitude with the fit and its residuals (the paper's figure 2), width against magnitude (figure
    3), and one star measured and simulated (figure 4).  The last are the residuals of the positions, and effects that
    the sensor model lacks: the mean profile, and brightness and width against the distance from the optical axis.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415 - a second to load

    height, width = calibration.image.pixels_dn.shape
    # All positions are fixed, including titles and labels: matplotlib's automatic layout takes longer than the fit.
    tall = 7.2 * height / width
    total = tall + 11.5 + _MISFIT_TALL
    figure = Figure(figsize=(15, total), dpi=_DPI)

    def axes_at(left: float, bottom: float, wide: float, high: float, **kind: Any) -> Any:
        """Return axes at a position in inches from the page's lower left corner."""
        above = bottom + _MISFIT_TALL
        return figure.add_axes((left / 15, above / total, wide / 15, high / total), **kind)

    _photograph(axes_at(0.4, 10.9, 7.0, 7.0 * height / width), calibration.geometry)
    _simulation(axes_at(7.8, 10.9, 7.0, 7.0 * height / width), calibration)
    brightness = axes_at(0.9, 6.6, 6.3, 3.7)
    _brightness(brightness, axes_at(0.9, 5.1, 6.3, 1.3, sharex=brightness), calibration)
    _width(axes_at(8.3, 5.1, 6.3, 5.2), calibration)
    _surface(axes_at(0.9, 0.2, 6.0, 4.2, projection="3d"), calibration)
    _residuals(axes_at(8.3, 0.4, 6.3, 3.9), calibration.geometry)
    _profile(axes_at(0.9, 0.6 - _MISFIT_TALL, 3.7, 2.6), calibration)
    _off_axis(axes_at(5.9, 0.6 - _MISFIT_TALL, 3.7, 2.6), axes_at(10.9, 0.6 - _MISFIT_TALL, 3.7, 2.6), calibration)
    sensor = calibration.sensor
    figure.suptitle(
        f"{calibration.image.path.name}: {len(calibration.stars)} stars identified ({calibration.method});"
        f" peak {sensor.reference_peak_dn:.1f} DN at {sensor.reference_vmag:.2f} mag in"
        f" {sensor.reference_exposure_s:g} s, sigma {sensor.psf_sigma_px:.3f} px, sky {sensor.sky_mean_dn:.2f}"
        f" ± {sensor.sky_std_dn:.2f} DN",
        y=1 - 0.15 / total,
        fontsize=11,
    )
    FigureCanvasAgg(figure)
    drawn = BytesIO()
    figure.savefig(drawn, format="png", metadata={"Software": "glstar"}, pil_kwargs={"compress_level": 1})
    return drawn.getvalue()


def draw_geometry(geometry: GeometryCalibration) -> bytes:
    """Return a PNG of the photograph with its stars labelled, and of the residuals of their positions."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415 - a second to load

    height, width = geometry.image.pixels_dn.shape
    tall = 7.2 * height / width
    total = tall + 1.0
    figure = Figure(figsize=(15, total), dpi=_DPI)
    sizes = (7.0 / 15, 7.0 * height / width / total)
    _photograph(figure.add_axes((0.4 / 15, 0.4 / total, *sizes)), geometry)
    _residuals(figure.add_axes((7.8 / 15, 0.4 / total, *sizes)), geometry)
    figure.suptitle(
        f"{geometry.image.path.name}: {len(geometry.matches)} stars identified ({geometry.method}); geometry only",
        y=1 - 0.15 / total,
        fontsize=11,
    )
    FigureCanvasAgg(figure)
    drawn = BytesIO()
    figure.savefig(drawn, format="png", metadata={"Software": "glstar"}, pil_kwargs={"compress_level": 1})
    return drawn.getvalue()


def simulated(calibration: Calibration, *, seed: int = 0) -> Float:
    """Return a simulated image of the same sky with the calibrated sensor, with all catalogue stars at rest.

    `seed`: seed of the noise.  Returns (height, width) DN.
    """
    sensor, matches = calibration.sensor, calibration.matches
    vmag = calibration.reference.stars.vmag[matches.predicted]
    shape = calibration.image.pixels_dn.shape
    peak_dn = sensor.peak_dn(vmag, sensor.reference_exposure_s)
    xy_px = matches.predicted_xy_px
    trail_px = (
        sidereal_trails(matches.solution, xy_px, sensor.reference_exposure_s) if calibration.stars.moved else None
    )
    light = draw_stars((shape[0], shape[1]), xy_px, peak_dn, sensor.psf_sigma_px, trail_px=trail_px)
    sky = np.random.default_rng(seed).normal(sensor.sky_mean_dn, sensor.sky_std_dn, shape)
    return np.asarray(np.clip(np.floor(light + sky + 0.5), 0, sensor.saturation_dn))


def _photograph(axes: Any, geometry: GeometryCalibration) -> None:
    detected, matches, stars = geometry.detected, geometry.matches, geometry.reference.stars
    level_dn, sky = detected.background.level_dn, detected.sky
    _show(axes, geometry.image.pixels_dn - level_dn + sky.mean_dn, sky.mean_dn, sky.std_dn)
    _titled(axes, "photograph, flattened background")
    xy_px = detected.xy_px[matches.detection]
    axes.plot(*xy_px[:_NAMED_STARS].T, "o", mfc="none", mec="tab:orange", ms=7, mew=0.7)
    for k in range(min(_NAMED_STARS, len(xy_px))):
        brighter_px = np.linalg.norm(xy_px[:k] - xy_px[k], axis=1)
        if brighter_px.min(initial=np.inf) < _LABEL_SEPARATION * level_dn.shape[1]:
            continue
        axes.annotate(
            stars.name[matches.star[k]] or star_label(stars.catalogue, stars.star_id[matches.star[k]]),
            tuple(xy_px[k]),
            xytext=(5, 4),
            textcoords="offset points",
            color="gold",
            fontsize=6.5,
            clip_on=True,
        )


def _simulation(axes: Any, calibration: Calibration) -> None:
    _show(axes, simulated(calibration), calibration.sensor.sky_mean_dn, calibration.sensor.sky_std_dn)
    # It shares the pixel axes of the photograph.
    axes.set_xticks([])
    axes.set_yticks([])
    _titled(axes, f"simulated: the {len(calibration.matches.predicted)} stars of the catalogue")


def _show(axes: Any, pixels: Float, sky_dn: float, sky_std_dn: float) -> None:
    noise_dn = max(sky_std_dn, 1.0)
    axes.imshow(
        _shrunk(pixels),
        cmap="gray",
        extent=(-0.5, pixels.shape[1] - 0.5, pixels.shape[0] - 0.5, -0.5),
        interpolation="nearest",
        vmin=sky_dn + _BLACK_SIGMA * noise_dn,
        vmax=sky_dn + _WHITE_SIGMA * noise_dn,
    )
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=_TICKS)


def _titled(axes: Any, title: str, *, loc: str = "center") -> None:
    axes.set_title(title, fontsize=10, loc=loc, y=1.0)


def _labelled(axes: Any, *, across: str | None, up: str) -> None:
    """Label the axes, at the same distance from all of them."""
    wide, high = axes.get_position().size * axes.figure.get_size_inches()
    axes.set_ylabel(up)
    axes.yaxis.set_label_coords(-0.55 / wide, 0.5)
    if across is not None:
        axes.set_xlabel(across)
        axes.xaxis.set_label_coords(0.5, -0.3 / high)


def _shrunk(pixels: Float) -> Float:
    """Return a smaller image with the maximum of each block of pixels, so that stars of one pixel remain visible."""
    side = max(1, round(max(pixels.shape) / 820))
    rows, columns = pixels.shape[0] // side * side, pixels.shape[1] // side * side
    blocks = pixels[:rows, :columns].reshape(rows // side, side, columns // side, side)
    return np.asarray(blocks.max(axis=(1, 3)))


def _brightness(above: Any, below: Any, calibration: Calibration) -> None:
    stars, fit, sensor = calibration.stars, calibration.brightness, calibration.sensor
    used, saturated = fit.used, stars.saturated
    rest = ~used & ~saturated
    for axes, values in ((above, stars.peak_dn), (below, calibration.off_mag)):
        axes.plot(stars.vmag[rest], values[rest], ".", color=_UNUSED, label="faint, blended or near the limit")
        axes.plot(
            stars.vmag[saturated], values[saturated], "^", color=_SATURATED, ms=4, label="saturated (lower limit)"
        )
        axes.plot(stars.vmag[used], values[used], "o", color=_USED, ms=4, label=f"used, {int(used.sum())}")
        axes.grid(visible=True, alpha=0.3)
    m = np.linspace(stars.vmag.min() - 0.3, stars.vmag.max() + 0.3, 100)
    above.plot(m, fit.peak_dn(m), "k-", lw=1, label="eq. (37)")
    if np.isfinite(fit.slope_dex_per_mag):
        middle = np.log10(fit.reference_peak_dn)
        above.plot(
            m,
            10 ** (middle + fit.slope_dex_per_mag * (m - fit.reference_vmag)),
            "k:",
            lw=1,
            label=f"own slope, {fit.slope_dex_per_mag:.3f} dex/mag",
        )
    above.axhline(sensor.saturation_dn - sensor.sky_mean_dn, color=_SATURATED, lw=0.6, ls="--")
    above.axhline(sensor.sky_std_dn, color="0.4", lw=0.6, ls="--")
    above.set_yscale("log")
    # The residuals below share the magnitude axis.
    above.tick_params(labelbottom=False)
    above.minorticks_off()
    _labelled(above, across=None, up="amplitude above the sky, DN")
    _titled(above, f"brightness ({fit.criterion}): scatter {fit.scatter_mag:.2f} mag")
    above.legend(fontsize=7)
    below.axhline(0, color="k", lw=1)
    limit = max(0.5, 1.1 * float(np.abs(calibration.off_mag[used]).max()))
    below.set_ylim(limit, -limit)
    below.locator_params(axis="x", nbins=_TICKS)
    below.locator_params(axis="y", nbins=4)
    _labelled(below, across="V magnitude", up="brighter than\nfit by, mag")


def _width(axes: Any, calibration: Calibration) -> None:
    stars, sensor = calibration.stars, calibration.sensor
    signal = stars.peak_dn / stars.noise_dn
    good = ~stars.saturated & ~stars.blended & (signal >= 10)
    axes.plot(stars.vmag[~good], stars.sigma_px[~good], ".", color=_UNUSED, label="saturated, blended or faint")
    axes.plot(
        stars.vmag[good], stars.sigma_px[good], "o", color=_USED, ms=4, label="signal-to-noise ratio of 10 or more"
    )
    axes.axhline(
        sensor.psf_sigma_px,
        color="k",
        lw=1,
        label=f"median {sensor.psf_sigma_px:.3f} ± {stars.psf_sigma_error_px:.3f} px",
    )
    axes.set_ylim(0, 3 * sensor.psf_sigma_px)
    axes.locator_params(nbins=_TICKS)
    _labelled(axes, across="V magnitude", up="sigma, px")
    _titled(axes, "width of the point spread function")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize=7)


def _surface(axes: Any, calibration: Calibration) -> None:
    """Draw a bright star close to the fit, measured and simulated."""
    stars, sensor, pixels = calibration.stars, calibration.sensor, calibration.image.pixels_dn
    used = np.flatnonzero(calibration.brightness.used)
    bright = used[np.argsort(-stars.peak_dn[used])][: max(1, len(used) // 4)]
    k = int(bright[np.argmin(np.abs(calibration.off_mag[bright]))])
    half = int(np.ceil(_STAMP_SIGMA * max(sensor.psf_sigma_px, 0.8) + stars.longest_trail_px / 2))
    x, y = np.rint(stars.xy_px[k]).astype(int)
    rows = slice(max(0, y - half), min(pixels.shape[0], y + half + 1))
    columns = slice(max(0, x - half), min(pixels.shape[1], x + half + 1))
    measured = pixels[rows, columns]
    peak_dn = sensor.peak_dn([stars.vmag[k]], sensor.reference_exposure_s)
    axes_at = stars.xy_px[k : k + 1] - [columns.start, rows.start]
    drawn = sensor.sky_mean_dn + draw_stars(
        (measured.shape[0], measured.shape[1]),
        axes_at,
        peak_dn,
        sensor.psf_sigma_px,
        trail_px=stars.trail_px[k : k + 1] if stars.moved else None,
    )
    X, Y = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
    axes.plot_surface(X, Y, drawn, color="tab:blue", alpha=0.55, lw=0, rcount=60, ccount=60)
    axes.plot_wireframe(X, Y, measured, color="tab:red", lw=0.9)
    name = stars.name[k] or star_label(stars.catalogue, stars.star_id[k])
    _titled(axes, f"{name}, {stars.vmag[k]:.2f} mag: measured (red), simulated (blue)")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")
    axes.set_zlabel("DN")
    axes.locator_params(nbins=_TICKS)
    axes.tick_params(labelsize=7)


def _profile(axes: Any, calibration: Calibration) -> None:
    """Draw the mean profile of bright stars and the Gaussian."""
    stacked = calibration.misfit.stacked
    radius = np.linspace(0, 8, 81)
    axes.plot(radius, np.exp(-(radius**2) / 2), "k-", lw=1, label="Gaussian")
    if stacked is not None:
        axes.plot(stacked.radius_sigma, stacked.brightness, "o", color=_USED, ms=4, label="bright stars, median")
    axes.set_yscale("symlog", linthresh=0.01)
    axes.set_ylim(-0.01, 1.5)
    axes.minorticks_off()
    _labelled(axes, across="distance from the centre, sigma", up="brightness")
    _titled(axes, "profile of the stars")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(fontsize=7)


def _off_axis(brightness: Any, width: Any, calibration: Calibration) -> None:
    """Draw brightness and width of the stars against the distance from the optical axis."""
    stars, misfit, used = calibration.stars, calibration.misfit, calibration.brightness.used
    distance = corner_distance(calibration.image, calibration.matches, stars.xy_px)
    r = np.linspace(0, 1, 50)
    corner_loss, corner_growth = misfit.corner_loss_mag, misfit.corner_growth
    brightness.plot(distance[used], -calibration.off_mag[used], "o", color=_USED, ms=3)
    brightness.axhline(0, color="k", lw=1)
    brightness.set_ylim(-1.0, 1.0)
    if corner_loss is not None:
        label = f"corner {-corner_loss.value:+.2f} ± {corner_loss.standard_error:.2f} mag"
        brightness.plot(r, misfit.mean_loss_mag - corner_loss.value * r**2, "r-", lw=1, label=label)
        brightness.legend(fontsize=7)
    _titled(brightness, "brightness off the axis")
    _labelled(brightness, across="distance from the axis; the corner is 1", up="brighter than fit by, mag")
    sigma_px = calibration.sensor.psf_sigma_px
    width.plot(distance[used], stars.sigma_px[used] / sigma_px, "o", color=_USED, ms=3)
    width.axhline(1, color="k", lw=1)
    width.set_ylim(0, 2)
    if corner_growth is not None:
        typical = 1 + corner_growth.value * float(np.median(distance[used] ** 2))
        label = f"corner {100 * corner_growth.value:+.0f} ± {100 * corner_growth.standard_error:.0f} %"
        width.plot(r, (1 + corner_growth.value * r**2) / typical, "r-", lw=1, label=label)
        width.legend(fontsize=7)
    _titled(width, "width off the axis")
    _labelled(width, across="distance from the axis; the corner is 1", up="sigma over the typical one")
    for axes in (brightness, width):
        axes.set_xlim(0, 1)
        axes.locator_params(nbins=_TICKS)
        axes.grid(visible=True, alpha=0.3)


def _residuals(axes: Any, geometry: GeometryCalibration) -> None:
    matches, shape = geometry.matches, geometry.image.pixels_dn.shape
    arrows = axes.quiver(
        *geometry.detected.xy_px[matches.detection].T,
        *matches.residual_px.T,
        angles="xy",
        color=_USED,
        width=0.003,
        scale_units="width",
        scale=20 * max(matches.rms_px, 0.01),
    )
    axes.quiverkey(
        arrows, 0.86, -0.05, matches.rms_px, f"{matches.rms_px:.2f} px", labelpos="E", fontproperties={"size": 8}
    )
    axes.set_xlim(-0.5, shape[1] - 0.5)
    axes.set_ylim(shape[0] - 0.5, -0.5)
    axes.set_aspect("equal")
    camera, error_px = matches.solution.camera, matches.standard_error.get("fx_px")
    focal = f"f = {camera.fx_px:.1f}" + ("" if error_px is None else f" ± {error_px:.1f}")
    _titled(
        axes,
        f"found minus predicted; {focal} px\n"
        f"{len(matches)} matched, {matches.expected_by_chance:.1f} expected by chance",
        loc="left",
    )
    axes.set_xticks([])
    axes.set_yticks([])
