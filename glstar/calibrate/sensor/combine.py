"""Several photographs of one camera: one sensor, the brightness of each star as the camera records it, and a report."""

import csv
import io
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar import __version__
from glstar.arrays import Float, Index, Mask, robust_std
from glstar.calibrate.geometry.camera import calibration_toml
from glstar.calibrate.geometry.lensfit import SharedLensFit, require_one_camera
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.sensor.calibration import Calibration
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError
from glstar.sky.photometry import magnitude_difference

# Stars count from this signal-to-noise ratio on; pixel differences limit their accuracy to this, mag.
_BRIGHT_ENOUGH = 10.0
_LEAST_ERROR_MAG = 0.02
# Lower limit of the scatter of stars about the catalogue, mag.
_LEAST_SPREAD_MAG = 0.03
# The repeatability between images is estimated from this number of measurements on.
_MIN_REPEATED = 10
_ROUNDS = 100
_CONVERGED_MAG = 1e-5
# Images fainter or brighter than the others by more than this are reported, mag.
_REPORTED_MAG = 0.1
# So are backgrounds that differ by more than this multiple of the noise.
_REPORTED_SKY_SIGMA = 1.0
_STAR_COLUMNS = ("catalogue", "star_id", "name", "vmag", "camera_mag", "off_mag", "error_mag", "images")


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Measurements of stars on images."""

    image: Index  # (n,) intp: indices of the image and of the star
    star: Index
    off_mag: Float  # (n,) measured minus catalogue magnitude, up to a constant
    error_mag: Float  # (n,) its standard deviation due to noise


@dataclass(frozen=True, slots=True, eq=False)
class StarTable:
    """The brightness of each star as the camera records it."""

    catalogue: str  # The catalogue that numbers the stars
    star_id: NDArray[np.int32]  # (k,) int32
    name: tuple[str, ...]
    vmag: Float  # (k,)
    off_mag: Float  # (k,) camera magnitude minus V; shrunk towards 0 according to the uncertainty of the measurement
    error_mag: Float  # (k,) its standard error
    images: Index  # (k,) intp: number of images on which it was measured

    def __len__(self) -> int:
        return len(self.vmag)

    def to_csv(self) -> str:
        """Return the table as `glstar.sky.photometry.StarBrightness` reads it."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_STAR_COLUMNS)
        for k in range(len(self)):
            numbers = self.vmag[k] + self.off_mag[k], self.off_mag[k], self.error_mag[k]
            values = (f"{number:.4f}" for number in numbers)
            writer.writerow(
                [
                    self.catalogue,
                    int(self.star_id[k]),
                    self.name[k],
                    f"{self.vmag[k]:.2f}",
                    *values,
                    int(self.images[k]),
                ]
            )
        return text.getvalue()


@dataclass(frozen=True, slots=True, eq=False)
class CombinedCalibration:
    """The calibration of a camera from several photographs."""

    parts: tuple[Calibration, ...]  # One per photograph, each with its own sky
    sensor: Sensor  # The common sensor; its exposure is that of the first photograph
    table: StarTable
    fainter_mag: Float  # (images,) how much fainter each image is than the sensor predicts, magnitudes
    spread_mag: float  # Intrinsic standard deviation of stars about the catalogue, magnitudes
    # Repeatability of a star between images, standard deviation, magnitudes; NaN if no star is on two.
    repeat_mag: float
    notes: tuple[Note, ...]  # Remarks for the user
    shared_lens: SharedLensFit | None = None  # The lens fitted to all images together, if requested

    @property
    def best(self) -> Calibration:
        """The part with the most stars, whose camera is written."""
        return max(self.parts, key=lambda part: len(part.stars))

    def to_toml(self, star_brightness: str | None = None) -> str:
        """Return the calibration as TOML, for ``[sensor] file`` or ``--config``.

        `star_brightness`: the name of the table's file, beside this one; None to leave the table out.
        """
        names = ", ".join(part.image.path.name for part in self.parts)
        head = [
            f"Calibrated by glstar {__version__} from {len(self.parts)} images ({names}): {len(self.table)} stars.",
            *([] if self.air else ["reference_peak_dn has the extinction of that night in it: it is below the air."]),
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, self.sensor, self.best.matches, star_brightness=star_brightness)

    @property
    def air(self) -> dict[str, Any] | None:
        """The extinction that was taken out, for JSON; None if the reference brightness has the air in it."""
        return self.parts[0].air

    def _lens_json(self) -> dict[str, Any]:
        if self.shared_lens is None:
            return {}
        return {"shared_lens": self.shared_lens.to_json([part.image.path.name for part in self.parts])}

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values; ``images`` holds `Calibration.to_json` of each part."""
        return {
            "schema": 2,
            "glstar": __version__,
            "sensor": self.sensor.keys,
            "stars": len(self.table),
            "spread_mag": self.spread_mag,
            "repeat_mag": None if np.isnan(self.repeat_mag) else self.repeat_mag,
            "fainter_mag": self.fainter_mag.tolist(),
            "extinction": self.air or {"reference_is": "below the air"},
            "notes": [note.text for note in self.notes],
            **self._lens_json(),
            "images": [part.to_json() for part in self.parts],
        }


def combine(parts: tuple[Calibration, ...], *, shared_lens: SharedLensFit | None = None) -> CombinedCalibration:
    """Return one sensor from several photographs of one camera.

    `parts`: two or more, each calibrated on its own, all above the air or all below it; their exposures may differ;
    `shared_lens`: the lens fitted to all of them together.  Raises CalibrationError if they are not of one camera.
    Teague & Chahl, section 4, propose it as future work: the brightness of individual stars is biased by their colour
    and by the catalogue, and several images measure this bias.
    """
    _require_one_camera(parts)
    first = parts[0]
    star_id = np.unique(np.concatenate([part.stars.star_id for part in parts]))
    chosen = [_measured_well(part) for part in parts]
    seen = Observations(
        image=np.concatenate([np.full(int(good.sum()), i) for i, good in enumerate(chosen)]),
        star=np.concatenate(
            [np.searchsorted(star_id, part.stars.star_id[good]) for part, good in zip(parts, chosen, strict=True)]
        ),
        off_mag=np.concatenate([_off_mag(part, first)[good] for part, good in zip(parts, chosen, strict=True)]),
        error_mag=np.concatenate([_error_mag(part)[good] for part, good in zip(parts, chosen, strict=True)]),
    )
    off_mag, error_mag, zero_mag, spread_mag = solve_brightness(seen, len(star_id), len(parts))
    middle = float(np.median(zero_mag))
    count = np.bincount(seen.star, minlength=len(star_id))
    table = _table(parts, star_id, off_mag, error_mag, count)
    used = np.concatenate([part.stars.vmag[part.brightness.used] for part in parts])
    reference_vmag = round(float(np.median(used)), 2)
    alike = [part for part in parts if part.sensor.reference_exposure_s == first.sensor.reference_exposure_s]
    sensor = replace(
        first.sensor,
        reference_vmag=reference_vmag,
        reference_peak_dn=float(first.brightness.peak_dn(np.array([reference_vmag]))[0] * 10 ** (-0.4 * middle)),
        psf_sigma_px=float(np.median(np.concatenate([part.stars.sigma_px[part.brightness.used] for part in parts]))),
        sky_mean_dn=float(np.median([part.sensor.sky_mean_dn for part in alike])),
        sky_std_dn=float(np.median([part.sensor.sky_std_dn for part in alike])),
    )
    fainter_mag = zero_mag - middle
    lens_notes = () if shared_lens is None else (Note(NoteKind.CAMERA, shared_lens.summary),)
    notes = (*lens_notes, *_differences(parts, sensor, fainter_mag), *_of_each(parts))
    repeat_mag = _repeat_mag(seen, zero_mag)
    return CombinedCalibration(
        parts=parts,
        sensor=sensor,
        table=table,
        fainter_mag=fainter_mag,
        spread_mag=spread_mag,
        repeat_mag=repeat_mag,
        notes=notes,
        shared_lens=shared_lens,
    )


def solve_brightness(seen: Observations, stars: int, images: int) -> tuple[Float, Float, Float, float]:
    """Separate the brightness offsets of stars from the offsets of images.

    `stars`, `images`: number of stars and of images.  Returns `off_mag, error_mag` (stars,): camera magnitude minus
    catalogue magnitude of each star, with the common spread of all stars as its prior, and its standard error; 0 and
    the spread for stars without a measurement; `zero_mag` (images,): magnitude offset of each image: the median over
    its stars; `spread_mag`: standard deviation of stars about the catalogue.
    """
    off = np.zeros(stars)
    zero = np.zeros(images)
    error = seen.error_mag
    spread = 0.2
    for _ in range(_ROUNDS):
        before = zero.copy()
        for k in range(images):
            here = seen.image == k
            zero[k] = np.median((seen.off_mag - off[seen.star])[here]) if here.any() else 0.0
        rest = seen.off_mag - zero[seen.image]
        # Differences between images beyond the noise (corners, JPEG) add to the error.
        again = _deviations_mag(seen, zero)
        if len(again) >= _MIN_REPEATED:
            repeat = _clipped_std(again)
            more = np.sqrt(max(repeat**2 - float(np.median(seen.error_mag)) ** 2, 0.0))
            error = np.hypot(seen.error_mag, more)
        weight = 1 / error**2
        robust = robust_std(rest, float(np.median(rest)))
        spread = max(float(np.sqrt(max(robust**2 - np.median(error) ** 2, 0.0))), _LEAST_SPREAD_MAG)
        total = np.bincount(seen.star, weights=weight, minlength=stars) + 1 / spread**2
        off = np.bincount(seen.star, weights=weight * rest, minlength=stars) / total
        if np.abs(zero - before).max() < _CONVERGED_MAG:
            break
    return off, 1 / np.sqrt(total), zero, spread


def _measured_well(part: Calibration) -> Mask:
    """Return which stars of an image are measurable: not saturated, not blended, and above the noise."""
    stars = part.stars
    bright = part.fitted_peak_dn >= _BRIGHT_ENOUGH * stars.noise_dn
    return np.asarray(~stars.saturated & ~stars.blended & bright & (stars.peak_dn > stars.noise_dn))


def _off_mag(part: Calibration, first: Calibration) -> Float:
    """Return measured minus predicted magnitudes of stars, with the first image's sensor and the same exposure."""
    fraction = part.sensor.reference_exposure_s / first.sensor.reference_exposure_s
    expected = first.brightness.peak_dn(part.arriving_mag) * fraction
    return magnitude_difference(np.maximum(part.stars.peak_dn, 1e-3) / expected)


def _error_mag(part: Calibration) -> Float:
    """Return the standard error of each star's brightness due to noise, magnitudes, for a fit of its amplitude only."""
    stars, sensor = part.stars, part.sensor
    fraction = stars.noise_dn / np.maximum(stars.peak_dn, 1e-3) / (np.sqrt(np.pi) * sensor.effective_sigma_px)
    return np.asarray(np.hypot(2.5 / np.log(10) * fraction, _LEAST_ERROR_MAG))


def _table(
    parts: tuple[Calibration, ...], star_id: NDArray[np.int32], off_mag: Float, error_mag: Float, count: Index
) -> StarTable:
    catalogued: dict[int, tuple[str, float]] = {}
    for part in parts:
        for k, number in enumerate(part.stars.star_id):
            catalogued[int(number)] = part.stars.name[k], float(part.stars.vmag[k])
    vmag = np.array([catalogued[int(number)][1] for number in star_id])
    order = np.flatnonzero(count)[np.argsort(vmag[count > 0], kind="stable")]
    names = tuple(catalogued[int(star_id[k])][0] for k in order)
    return StarTable(
        catalogue=parts[0].stars.catalogue,
        star_id=star_id[order],
        name=names,
        vmag=vmag[order],
        off_mag=off_mag[order],
        error_mag=error_mag[order],
        images=count[order],
    )


def _repeat_mag(seen: Observations, zero_mag: Float) -> float:
    """Return the standard deviation of a star's brightness from image to image, magnitudes."""
    deviations = _deviations_mag(seen, zero_mag)
    return _clipped_std(deviations) if len(deviations) else float("nan")


def _clipped_std(values: Float) -> float:
    """Return the standard deviation about 0 of values within three robust standard deviations."""
    robust = robust_std(values)
    kept = values[np.abs(values) <= 3 * robust]
    return float(np.sqrt(np.mean(kept**2))) if kept.size else 0.0


def _deviations_mag(seen: Observations, zero_mag: Float) -> Float:
    """Return deviations of repeated measurements from the mean of their star, scaled to an unbiased variance."""
    rest = seen.off_mag - zero_mag[seen.image]
    count = np.bincount(seen.star)
    mean = np.bincount(seen.star, weights=rest) / np.maximum(count, 1)
    again = count[seen.star] > 1
    # The mean includes the star itself: each of two measurements is nearer to it by the root of two.
    larger = np.sqrt(count / np.maximum(count - 1, 1))[seen.star]
    return np.asarray(((rest - mean[seen.star]) * larger)[again])


def _require_one_camera(parts: tuple[Calibration, ...]) -> None:
    first = parts[0].image
    for part in parts[1:]:
        if part.image.bit_depth != first.bit_depth:
            raise CalibrationError(
                f"{first.path.name} has {first.bit_depth} bits and {part.image.path.name} {part.image.bit_depth}: not"
                " one camera; calibrate them separately"
            )
    names = [part.image.path.name for part in parts]
    require_one_camera(names, [part.matches.solution.camera for part in parts])


def _differences(parts: tuple[Calibration, ...], sensor: Sensor, fainter_mag: Float) -> tuple[Note, ...]:
    texts = []
    for part, fainter in zip(parts, fainter_mag, strict=True):
        name, sky = part.image.path.name, part.sensor
        if abs(fainter) > _REPORTED_MAG:
            word = "fainter" if fainter > 0 else "brighter"
            texts.append(
                f"{name} is {abs(fainter):.2f} mag {word} than the others: haze, or a different exposure than given"
            )
        same_time = sky.reference_exposure_s == sensor.reference_exposure_s
        if same_time and abs(sky.sky_mean_dn - sensor.sky_mean_dn) > _REPORTED_SKY_SIGMA * max(sensor.sky_std_dn, 1.0):
            texts.append(
                f"{name} has a sky of {sky.sky_mean_dn:.1f} ± {sky.sky_std_dn:.1f} DN, and the sensor"
                f" {sensor.sky_mean_dn:.1f} ± {sensor.sky_std_dn:.1f} DN"
            )
    return tuple(Note(NoteKind.COMBINATION, text) for text in texts)


def _of_each(parts: tuple[Calibration, ...]) -> tuple[Note, ...]:
    """Return the notes that all images share, once, and then the notes on each image."""
    shared = [note for note in parts[0].notes if all(note in part.notes for part in parts[1:])]
    own = (
        replace(note, text=f"{part.image.path.name}: {note}")
        for part in parts
        for note in part.notes
        if note not in shared
    )
    return (*shared, *own)


_DPI = 110
# With more images than colours the legend is omitted.
_MOST_NAMED = 10


def draw_combined(combined: CombinedCalibration) -> bytes:
    """Return the report of several photographs as a PNG.

    It shows brightness against magnitude on all images; measured minus catalogue magnitude of each star on one image
    against the other images; the residuals without and with the table; the magnitude offset of each image.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - a second to load
    from matplotlib.figure import Figure  # noqa: PLC0415 - a second to load

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
    """Draw each measurement of a star against its measurements on the other images."""
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
