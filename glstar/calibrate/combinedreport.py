"""The report of several photographs of one camera as a PNG."""

from io import BytesIO
from typing import Any, Final

import numpy as np

from glstar.calibrate.combine import CombinedCalibration

__all__ = ["draw_combined"]

_DPI: Final = 110
# With more images than colours the legend is omitted.
_MOST_NAMED: Final = 10


def draw_combined(combined: CombinedCalibration) -> bytes:
    """Return the report of several photographs as a PNG.

    Parameters
    ----------
    combined : CombinedCalibration

    Returns
    -------
    bytes
        Brightness against magnitude on all images; measured minus catalogue magnitude of each star on one image
        against the other images; the residuals without and with the table; the magnitude offset of each image.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(15, 10.5))
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, gridspec_kw={"left": 0.06, "right": 0.98, "top": 0.92, "bottom": 0.06})
    _brightness(axes[0, 0], combined)
    _repeatability(axes[0, 1], axes[1, 0], combined)
    _images(axes[1, 1], combined)
    sensor = combined.sensor
    figure.suptitle(
        f"{len(combined.parts)} images of one camera, {len(combined.table)} stars:"
        f" peak {sensor.reference_peak_dn:.1f} DN at {sensor.reference_vmag:.2f} mag in"
        f" {sensor.reference_exposure_s:g} s, sigma {sensor.psf_sigma_px:.3f} px; stars differ from V by"
        f" {combined.spread_mag:.2f} mag, and repeat to {combined.repeat_mag:.2f} mag",
        fontsize=11,
    )
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI, metadata={"Software": "glstar"}, pil_kwargs={"compress_level": 4})
    return drawn.getvalue()


def _colour(number: int) -> str:
    return f"C{number % 10}"


def _brightness(axes: Any, combined: CombinedCalibration) -> None:
    sensor, seconds = combined.sensor, combined.sensor.reference_exposure_s
    for number, (part, fainter) in enumerate(zip(combined.parts, combined.fainter_mag, strict=True)):
        stars = part.stars
        good = ~stars.saturated & ~stars.blended & (stars.peak_dn > 0)
        # Scaled to the sensor's exposure, and by the magnitude offset of the image.
        peak_dn = stars.peak_dn * seconds / part.sensor.reference_exposure_s * 10 ** (0.4 * fainter)
        axes.plot(part.arriving_mag[good], peak_dn[good], ".", ms=4, color=_colour(number), label=part.image.path.name)
    brightest, faintest = axes.get_xlim()
    m = np.linspace(brightest, faintest, 100)
    axes.plot(m, sensor.peak_dn(m, seconds), "k-", lw=1, label="eq. (37)")
    axes.set_yscale("log")
    axes.set_xlabel("V magnitude" if combined.air is None else "V magnitude, dimmed by the extinction")
    axes.set_ylabel(f"amplitude above the sky in {seconds:g} s, DN")
    axes.set_title("brightness on all images", fontsize=10)
    axes.grid(visible=True, alpha=0.3)
    if len(combined.parts) <= _MOST_NAMED:
        axes.legend(fontsize=7)


def _repeatability(axes: Any, histogram: Any, combined: CombinedCalibration) -> None:
    """Draw each measurement of a star against those of the other images."""
    table = combined.table
    place = {int(number): k for k, number in enumerate(table.star_id)}
    before: list[float] = []
    after: list[float] = []
    for number, (part, fainter) in enumerate(zip(combined.parts, combined.fainter_mag, strict=True)):
        stars = part.stars
        expected = combined.sensor.peak_dn(part.arriving_mag, part.sensor.reference_exposure_s)
        row = np.array([place.get(int(star_id), -1) for star_id in stars.star_id])
        good = (row >= 0) & ~stars.saturated & ~stars.blended & (stars.peak_dn > stars.noise_dn)
        good &= table.images[row] > 1
        off_mag = -2.5 * np.log10(stars.peak_dn[good] / expected[good]) - fainter
        images = table.images[row[good]]
        others_mag = (images * table.off_mag[row[good]] - off_mag) / (images - 1)
        axes.plot(others_mag, off_mag, ".", ms=4, color=_colour(number))
        before += off_mag.tolist()
        after += (off_mag - others_mag).tolist()
    limit_mag = max(0.3, 1.1 * float(np.abs(table.off_mag).max(initial=0.0)))
    axes.plot([-limit_mag, limit_mag], [-limit_mag, limit_mag], "k-", lw=1)
    axes.set_xlim(-limit_mag, limit_mag)
    axes.set_ylim(-1.5 * limit_mag, 1.5 * limit_mag)
    axes.set_xlabel("fainter than V by, on the other images, mag")
    axes.set_ylabel("on one image, mag")
    axes.set_title("stars on more than one image", fontsize=10)
    axes.grid(visible=True, alpha=0.3)
    bins = np.linspace(-1.5 * limit_mag, 1.5 * limit_mag, 61)
    histogram.hist(before, bins=bins, color="0.7", label="V and one sensor")
    histogram.hist(
        after,
        bins=bins,
        histtype="step",
        color="tab:blue",
        lw=1.5,
        label="with the stars' own brightness, from the other images",
    )
    histogram.set_xlabel("fainter than expected by, mag")
    histogram.set_ylabel("measurements")
    histogram.set_title("residuals of stars on more than one image", fontsize=10)
    histogram.legend(fontsize=7)


def _images(axes: Any, combined: CombinedCalibration) -> None:
    numbers = range(len(combined.parts))
    axes.barh(numbers, combined.fainter_mag, color=[_colour(k) for k in numbers])
    axes.set_yticks(numbers, [part.image.path.name for part in combined.parts], fontsize=7)
    axes.invert_yaxis()
    axes.axvline(0, color="k", lw=1)
    limit = max(0.1, 1.2 * float(np.abs(combined.fainter_mag).max()))
    axes.set_xlim(-limit, limit)
    axes.set_xlabel("fainter than the sensor by, mag")
    axes.set_title("the images", fontsize=10)
    axes.grid(visible=True, alpha=0.3)
