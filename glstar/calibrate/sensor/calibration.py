"""The calibration of a sensor from one photograph, its output formats, and the shape of the stars."""

import csv
import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from glstar import __version__
from glstar.arrays import Float
from glstar.calibrate.geometry.camera import GeometryCalibration, calibration_toml, camera_notes, refraction_notes
from glstar.calibrate.identify.platesolution import Matches, ReferenceStars
from glstar.calibrate.notes import SHAPE_NOTES, Note, NoteKind, notes_without
from glstar.calibrate.photo.detection import DetectedStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.sensor.fit import LIGHT_DEX_PER_MAG, BrightnessFit, Criterion, MeasuredStars, fit_sensor
from glstar.calibrate.sensor.misfit import Misfit, RadialProfile
from glstar.calibrate.sensor.misfitmeasurement import measure_misfit
from glstar.camera.sensor.sensor import PIXEL_VARIANCE_PX2, EffectValue, Sensor

_STAR_COLUMNS = (
    "catalogue", "star_id", "name", "vmag", "x_px", "y_px", "residual_x_px", "residual_y_px",
    "peak_dn", "fitted_peak_dn", "sigma_px", "signal_to_noise", "saturated", "blended", "used",
)  # fmt: skip

# An unevenness of the background above this multiple of its noise is reported.
_UNEVEN = 2.0
# Above this fraction of saturated stars, the others are biased towards stars measured too faint and too sharp.
_MANY_SATURATED = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The calibration of a sensor from one photograph."""

    image: Photograph
    detected: DetectedStars
    reference: ReferenceStars
    matches: Matches
    sensor: Sensor
    brightness: BrightnessFit
    stars: MeasuredStars
    method: str  # How the stars were identified
    notes: tuple[Note, ...]  # Remarks for the user
    misfit: Misfit  # Effects in the photograph that the sensor model lacks
    # (n,) or None: what the air took from each star, if the reference brightness is above the air.
    extinction_mag: Float | None = None
    # The extinction that was taken out, for JSON; None if the reference brightness has the air in it.
    air: dict[str, Any] | None = None

    @property
    def fitted_peak_dn(self) -> Float:
        """Amplitude of each star by the fit, (n,) float64, DN."""
        return self.brightness.peak_dn(self.arriving_mag)

    @property
    def arriving_mag(self) -> Float:
        """V of each star, dimmed by the extinction that was taken out, (n,) float64."""
        return self.stars.vmag if self.extinction_mag is None else self.stars.vmag + self.extinction_mag

    @property
    def off_mag(self) -> Float:
        """Measured minus fitted brightness of each star, (n,) float64, magnitudes; positive for faint stars."""
        ratio = np.maximum(self.stars.peak_dn, 1e-3) / self.fitted_peak_dn
        return np.asarray(-2.5 * np.log10(ratio))

    @property
    def sensor_standard_error(self) -> dict[str, float]:
        """Standard errors of the sensor's ``reference_peak_dn`` and ``psf_sigma_px``."""
        return {
            "reference_peak_dn": self.sensor.reference_peak_dn * (10 ** (0.4 * self.brightness.error_mag) - 1),
            "psf_sigma_px": self.stars.psf_sigma_error_px,
        }

    @property
    def geometry(self) -> GeometryCalibration:
        """Camera and attitude only."""
        return GeometryCalibration(self.image, self.detected, self.reference, self.matches, self.method, self.notes)

    def to_toml(self) -> str:
        """Return ``[sensor]`` and ``[camera]`` as TOML, with their origin as a comment."""
        head = [
            f"Calibrated by glstar {__version__} from {self.image.path.name}: {len(self.stars)} stars identified"
            f" ({self.method}), {int(self.brightness.used.sum())} used.",
            *([] if self.air else ["reference_peak_dn has the extinction of that night in it: it is below the air."]),
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, self.sensor, self.matches, sensor_error=self.sensor_standard_error)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers of the calibration as JSON-serialisable values."""
        fit, sky = self.brightness, self.detected.sky
        geometry = self.geometry.facts
        return {
            "schema": 2,
            "glstar": __version__,
            **geometry,
            "image": geometry["image"] | {"exposure_s": self.sensor.reference_exposure_s},
            "trails": {
                "longest_px": self.stars.longest_trail_px,
                "drawn_out_px": self.detected.drawn_out_px,
                "model": "the turning sky" if self.stars.moved else "none",
            },
            "sensor": self.sensor.keys,
            "sensor_standard_error": self.sensor_standard_error,
            "brightness": {
                "criterion": fit.criterion,
                "stars_used": int(fit.used.sum()),
                "scatter_mag": fit.scatter_mag,
                "error_mag": fit.error_mag,
                "mean_absolute_error_percent": float(100 * np.mean(np.abs(1 - 10 ** (0.4 * self.off_mag[fit.used])))),
                "slope_dex_per_mag": fit.slope_dex_per_mag,
                "slope_95_percent": [fit.slope_low_dex_per_mag, fit.slope_high_dex_per_mag],
            },
            "sky": {
                "mean_dn": sky.mean_dn,
                "std_dn": sky.std_dn,
                "unevenness_dn": sky.unevenness_dn,
                "pixels": sky.pixels,
                "share_at_zero": sky.clipped_fraction,
            },
            "extinction": self.air or {"reference_is": "below the air"},
            "misfit": self.misfit.to_json(),
            "notes": [note.text for note in self.notes],
        }

    def to_csv(self) -> str:
        """Return a line for each identified star, the brightest first; lengths in px, brightness in DN."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_STAR_COLUMNS)
        stars, fitted = self.stars, self.fitted_peak_dn
        for k in range(len(stars)):
            (x, y), (dx, dy) = stars.xy_px[k], stars.residual_px[k]
            numbers = (
                x,
                y,
                dx,
                dy,
                stars.peak_dn[k],
                fitted[k],
                stars.sigma_px[k],
                stars.peak_dn[k] / stars.noise_dn[k],
            )
            flags = (stars.saturated[k], stars.blended[k], self.brightness.used[k])
            writer.writerow(
                [stars.catalogue, int(stars.star_id[k]), stars.name[k], f"{stars.vmag[k]:.2f}"]
                + [f"{number:.4f}" for number in numbers]
                + [int(flag) for flag in flags]
            )
        return text.getvalue()


def calibrate(
    image: Photograph,
    detected: DetectedStars,
    reference: ReferenceStars,
    matches: Matches,
    *,
    method: str,
    exposure_s: float,
    criterion: Criterion = "median",
) -> Calibration:
    """Return the calibration of a camera from one photograph with identified stars.

    `method`: how the stars were identified; `criterion` {"median", "paper"}: how the reference brightness is found.
    Raises CalibrationError if too few stars can be measured.  Teague & Chahl, section 2.5.
    """
    sensor, fit, stars = fit_sensor(image, detected, reference, matches, exposure_s=exposure_s, criterion=criterion)
    misfit = measure_misfit(image, detected, matches, sensor, fit, stars)
    notes = (
        *matches.notes,
        *camera_notes(matches, sensor.psf_sigma_px),
        *refraction_notes(reference, matches),
        *_doubtful(detected, sensor, fit, stars, misfit),
        *misfit.notes(sensor, linear=fit.linear),
    )
    sensor = replace(sensor, effects=dict(sensor.effects) | image.output_keys)
    return Calibration(
        image=image,
        detected=detected,
        reference=reference,
        matches=matches,
        sensor=sensor,
        brightness=fit,
        stars=stars,
        method=method,
        notes=notes,
        misfit=misfit,
    )


def _doubtful(
    detected: DetectedStars, sensor: Sensor, fit: BrightnessFit, stars: MeasuredStars, misfit: Misfit
) -> tuple[Note, ...]:
    """Return remarks on doubtful numbers."""
    notes = []

    def note(text: str, kind: NoteKind = NoteKind.SENSOR) -> None:
        notes.append(Note(kind, text))

    if stars.moved:
        note(
            f"the stars moved by up to {stars.longest_trail_px:.1f} px in {sensor.reference_exposure_s:g} s (sidereal"
            " motion): sigma and brightness are corrected for it",
            NoteKind.MOTION,
        )
    elif detected.drawn_out_px:
        note(
            f"the stars are elongated by about {detected.drawn_out_px:.1f} px but were fitted as round: sigma includes"
            " the blur; hold the camera still, focus, and use a shorter exposure"
        )
    if not fit.linear:
        exponent = fit.slope_dex_per_mag / LIGHT_DEX_PER_MAG
        slope, span = fit.slope_dex_per_mag, stars.vmag[fit.used]
        ends = ", ".join(
            f"{100 * (10 ** ((LIGHT_DEX_PER_MAG - slope) * (m - fit.reference_vmag)) - 1):+.0f} % at {m:.1f} mag"
            for m in (span.min(), span.max())
        )
        note(
            f"brightness falls by {-slope:.2f} dex per magnitude and flux by {-LIGHT_DEX_PER_MAG:.2f}: the response is"
            f" not linear, but has a gamma of {exponent:.2f} (JPEG, processing): take raw images, or try"
            f" --gamma {1 / max(exponent, 0.1):.2g}; the calibration holds at"
            f" {fit.reference_vmag:.1f} mag, and the simulated peaks are off by {ends}"
        )
    sky = detected.sky
    # A gradient and vignetting have their own notes.
    uneven_dn, besides = misfit.unexplained_unevenness(sky)
    if uneven_dn > _UNEVEN * max(sky.std_dn, 1.0):
        note(
            f"the sky is uneven: its level differs by {uneven_dn:.1f} DN {besides}, its noise is"
            f" {sky.std_dn:.1f} DN, and the sensor model has a single level",
            NoteKind.UNEVEN_SKY,
        )
    if stars.saturated.mean() > _MANY_SATURATED:
        note(
            f"{int(stars.saturated.sum())} of {len(stars)} identified stars are saturated; a shorter exposure would"
            " measure brightness and sigma better"
        )
    if fit.used.sum() < 10:
        note(f"the brightness is measured on {int(fit.used.sum())} stars only: ± {fit.error_mag:.2f} mag")
    return tuple(notes)


_SIGMA_PER_FWHM = 1 / (2 * np.sqrt(2 * np.log(2)))
# Range of the exponent; above the upper limit a Moffat profile is a Gaussian.
_BETA = (2.0, 20.0)
_GAUSSIAN_BETA = 15.0
# Mean square of the distance from the centre of stars all over an image, over that of a corner.
_MEAN_SQUARE_DISTANCE = 1 / 3
_LARGEST_ELLIPTICITY = 0.4


def with_point_spread(calibration: Calibration) -> Calibration:
    """Return a calibration whose sensor has the shape of the stars: Moffat wings, ellipticity and growth off axis.

    Ellipticity and growth are there only where they are significant; width and amplitude belong to the profile on axis.
    """
    sensor, misfit = calibration.sensor, calibration.misfit
    effects: dict[str, EffectValue] = dict(sensor.effects)
    terms = []
    sigma_px, peak_dn = sensor.psf_sigma_px, sensor.reference_peak_dn
    if misfit.stacked is not None:
        beta, width, amplitude = fit_moffat(misfit.stacked)
        if beta < _GAUSSIAN_BETA:
            recorded_px2 = sigma_px**2 + PIXEL_VARIANCE_PX2
            narrower_px2 = max(width**2 * recorded_px2 - PIXEL_VARIANCE_PX2, 0.01)
            # The flux of a Gaussian of this width over that of the wider one that was fitted.
            peak_dn *= amplitude * (sigma_px**2 / recorded_px2) * (width**2 * recorded_px2 / narrower_px2)
            sigma_px = float(np.sqrt(narrower_px2))
            effects |= {"sensor.psf": "moffat", "sensor.psf_beta": round(beta, 3)}
            terms.append(f"Moffat profile of beta {beta:.2f}")
    growth = misfit.corner_growth
    if growth is not None and growth.exceeds(0.0) and growth.value > 0:
        effects["sensor.psf_growth"] = round(growth.value, 4)
        sigma_px /= 1 + growth.value * _MEAN_SQUARE_DISTANCE
        peak_dn *= (1 + growth.value * _MEAN_SQUARE_DISTANCE) ** 2
        terms.append(f"growth to the corners {growth.value:.3f} ± {growth.standard_error:.3f}")
    if misfit.ellipticity is not None and misfit.ellipticity.exceeds(0.0):
        ellipticity = min(1 - 1 / misfit.axis_ratio, _LARGEST_ELLIPTICITY)
        effects["sensor.psf_ellipticity"] = round(ellipticity, 4)
        effects["sensor.psf_angle_deg"] = round(float(np.rad2deg(misfit.long_axis_rad)), 1)
        terms.append(f"ellipticity {ellipticity:.3f} ± {misfit.ellipticity.standard_error:.3f}")
    shaped = replace(sensor, psf_sigma_px=sigma_px, reference_peak_dn=float(peak_dn), effects=effects)
    shape = f"shape of the stars: {', '.join(terms) if terms else 'plain Gaussians'}"
    notes = (*notes_without(calibration.notes, SHAPE_NOTES), Note(NoteKind.SENSOR, shape))
    return replace(calibration, sensor=shaped, notes=notes)


def fit_moffat(stacked: RadialProfile) -> tuple[float, float, float]:
    """Fit a Moffat profile to the median profile of the stars.

    Returns `beta`: exponent, 2 to 20; `width`: ratio of its width at half maximum to the width of the Gaussian fit of
    the same stars; `amplitude`: ratio of its amplitude to the Gaussian's.  Least squares over the bins up to 8 sigma,
    weighted with the square root of their area, so that wings count.
    """
    radius, brightness = stacked.radius_sigma, stacked.brightness
    is_known = np.isfinite(brightness)
    radius, brightness = radius[is_known], brightness[is_known]
    weight = np.sqrt(radius)

    def residuals(parameters: Float) -> Float:
        amplitude, alpha, beta = parameters
        return np.asarray(weight * (amplitude * (1 + (radius / alpha) ** 2) ** -beta - brightness))

    fitted = least_squares(residuals, (1.0, 2.5, 4.0), bounds=((0.2, 0.2, _BETA[0]), (5.0, 20.0, _BETA[1])))
    amplitude, alpha, beta = fitted.x.tolist()
    return beta, 2 * alpha * np.sqrt(2 ** (1 / beta) - 1) * _SIGMA_PER_FWHM, amplitude
