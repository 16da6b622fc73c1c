"""A photograph beside its twin as a PNG: both images, sky, noise against level, star profiles and peaks."""

from io import BytesIO
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.photographmodel import PhotographModel
from glstar.calibrate.twin import Twin

__all__ = ["draw_twin"]

Float = NDArray[np.float64]

_DPI: Final = 110
# Black and white of the whole images, quantiles of the photograph; and of the details, noises about the sky.
_BLACK, _WHITE = 0.001, 0.9995
_DETAIL_SIGMA: Final = (-3.0, 12.0)
# Side of the detail, px, which is shown at twice its size.
_DETAIL_PX: Final = 220
_MEASURED, _SIMULATED = "k", "tab:red"


def draw_twin(model: PhotographModel, twin: Twin) -> bytes:
    """Return a photograph beside its twin as a PNG.

    Parameters
    ----------
    model : PhotographModel
    twin : Twin

    Returns
    -------
    bytes
        Both images, a detail in the shadows, and measured beside simulated: the pixels of the sky, their noise against
        the level, the mean profile of the ten brightest stars, and the peaks of all.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415

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
        _detail(axes, model, image)
    _sky(figure.add_subplot(grid[1, 0]), model, both)
    _noise(figure.add_subplot(grid[1, 1]), model, twin)
    _profiles(figure.add_subplot(grid[1, 2]), twin)
    _peaks(figure.add_subplot(grid[1, 3]), twin)
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


def _detail(axes: Any, model: PhotographModel, image: Float) -> None:
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


def _sky(axes: Any, model: PhotographModel, both: tuple[Float, Float]) -> None:
    values = [image[model.sky.is_sky] for image in both]
    low, high = np.quantile(values[0], (0.0005, 0.9995))
    step = max(1.0, np.ceil((high - low) / 100))
    bins = np.arange(np.floor(low) - 0.5, high + step, step)
    axes.hist(values[0], bins=bins, color="0.7", label="photograph")
    axes.hist(values[1], bins=bins, histtype="step", color=_SIMULATED, label="twin")
    axes.set_title("pixels of the sky", fontsize=10)
    axes.set_xlabel("DN")
    axes.legend(fontsize=7)


def _noise(axes: Any, model: PhotographModel, twin: Twin) -> None:
    for noise, colour, name in ((model.noise, _MEASURED, "photograph"), (twin.noise, _SIMULATED, "twin")):
        if noise is not None:
            axes.plot(noise.level_dn, np.sqrt(noise.variance_dn2), "o-", ms=3, lw=1, color=colour, label=name)
    axes.set_title("noise of the sky against its level", fontsize=10)
    axes.set_xlabel("level, DN")
    axes.set_ylabel("standard deviation, DN")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7)


def _profiles(axes: Any, twin: Twin) -> None:
    for profile, colour, name in zip(twin.profiles_dn, (_MEASURED, _SIMULATED), ("photograph", "twin"), strict=True):
        axes.plot(np.maximum(profile, 1e-3 * twin.profiles_dn.max()), "o-", ms=3, lw=1, color=colour, label=name)
    axes.set_yscale("log")
    axes.set_title("mean profile of the ten brightest stars", fontsize=10)
    axes.set_xlabel("distance from the centre, px")
    axes.set_ylabel("above the sky, DN")
    axes.legend(fontsize=7)


def _peaks(axes: Any, twin: Twin) -> None:
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
