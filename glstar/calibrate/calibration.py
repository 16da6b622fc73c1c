"""A calibration: what one photograph told, and how it is written down."""

import csv
import io
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar import __version__
from glstar.apparent import right_ascension_declination
from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.identify import Field, Heavens, Matches
from glstar.calibrate.image import SkyImage
from glstar.calibrate.residuals import centroid_noise_px
from glstar.calibrate.sensorfit import LIGHT_DEX_PER_MAG, BrightnessFit, Criterion, MeasuredStars, fit_sensor
from glstar.horizon import ned_to_azimuth_altitude_rad
from glstar.sensor import Sensor
from glstar.toml import toml_value

__all__ = ["Calibration", "calibrate", "calibration_toml"]

Float = NDArray[np.float64]

_STAR_COLUMNS = (
    "hr", "name", "vmag", "x_px", "y_px", "residual_x_px", "residual_y_px",
    "peak_dn", "fitted_peak_dn", "sigma_px", "signal_to_noise", "saturated", "blended", "used",
)  # fmt: skip

# A sky whose level differs from place to place by more than this many times its noise is said to.
_UNEVEN: Final = 2.0
# Where more than this share of the stars is burnt out, those left are the few that look fainter and sharper than most.
_BURNT_OUT: Final = 0.3
# Stars worth measuring have their places to a fifth of a sigma and better: with more than this the camera is another.
_MISPLACED_SIGMA: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What one photograph told of a camera.

    Attributes
    ----------
    image : SkyImage
    detected : DetectedStars
    heavens : Heavens
    matches : Matches
    sensor : Sensor
    brightness : BrightnessFit
    stars : MeasuredStars
    way : str
        How the stars were identified.
    notes : tuple of str
        What a person should know.
    """

    image: SkyImage
    detected: DetectedStars
    heavens: Heavens
    matches: Matches
    sensor: Sensor
    brightness: BrightnessFit
    stars: MeasuredStars
    way: str
    notes: tuple[str, ...]

    @property
    def off_mag(self) -> Float:
        """How much fainter each star is than the fit has it, (n,) float64, magnitudes."""
        ratio = np.maximum(self.stars.peak_dn, 1e-3) / self.brightness.peak_dn(self.stars.vmag)
        return np.asarray(-2.5 * np.log10(ratio))

    @property
    def boresight_rad(self) -> tuple[float, float]:
        """Right ascension and declination (ICRS) that the optical axis points at, rad."""
        axis = self.matches.field.C_camera_eq[2] @ self.heavens.stars.C_eq_icrs
        ra_rad, dec_rad = right_ascension_declination(axis)
        return float(ra_rad), float(dec_rad)

    def to_toml(self) -> str:
        """Return the calibration as TOML: what ``[sensor] file`` takes, and ``--config`` too.

        Returns
        -------
        str
            ``[sensor]`` and ``[camera]``; where they came from is a comment.
        """
        head = [
            f"Calibrated by glstar {__version__} from {self.image.path.name}: {len(self.stars)} stars identified"
            f" ({self.way}), {int(self.brightness.used.sum())} used.",
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, self.sensor, self.matches.field)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers of the calibration, ready for JSON.

        Returns
        -------
        dict
        """
        matches, fit, sky, detected = self.matches, self.brightness, self.detected.sky, self.detected
        field, camera = matches.field, matches.field.camera
        ra_rad, dec_rad = self.boresight_rad
        looked: dict[str, float] = {"ra_deg": np.rad2deg(ra_rad), "dec_deg": np.rad2deg(dec_rad)}
        if self.heavens.C_ned_eq is not None:
            azimuth, altitude = ned_to_azimuth_altitude_rad(self.heavens.C_ned_eq @ field.C_camera_eq[2])
            looked |= {"azimuth_deg": float(np.rad2deg(azimuth)), "altitude_deg": float(np.rad2deg(altitude))}
        return {
            "schema": 1,
            "glstar": __version__,
            "image": {
                "file": self.image.path.name,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "bit_depth": self.image.bit_depth,
                "channel": self.image.channel,
                "exposure_s": self.sensor.reference_exposure_s,
            },
            "detection": {
                "stars": len(detected),
                "saturated": int(detected.saturated.sum()),
                "hot_pixels": detected.hot_pixels,
                "at_the_edge": detected.at_the_edge,
                "shapeless": detected.shapeless,
            },
            "identification": {
                "way": self.way,
                "stars_on_image": len(matches.predicted),
                "identified": len(matches),
                "expected_by_chance": matches.expected_by_chance,
                "rms_px": matches.rms_px,
                "median_px": float(np.median(np.linalg.norm(matches.residual_px, axis=1))),
                "centroid_noise_px": centroid_noise_px(detected, matches.detection),
                "chance": matches.chance,
                "mirrored": field.mirrored,
                "fx_px": camera.fx_px,
                "fy_px": camera.fy_px,
                "field_of_view_deg": float(np.rad2deg(camera.across_rad)),
                "cx_px": camera.cx_px,
                "cy_px": camera.cy_px,
                "radial_distortion_k1": field.bend,
                **({} if camera.lens is None else camera.lens.keys),
                "C_camera_icrs": (field.C_camera_eq @ self.heavens.stars.C_eq_icrs).tolist(),
                **{key: float(value) for key, value in looked.items()},
            },
            "trails": {
                "longest_px": self.stars.longest_trail_px,
                "drawn_out_px": detected.drawn_out_px,
                "model": "the turning sky" if self.stars.moved else "none",
            },
            "sensor": asdict(self.sensor),
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
                "share_at_zero": sky.clipped_share,
            },
            "notes": list(self.notes),
        }

    def to_csv(self) -> str:
        """Return the list of identified stars.

        Returns
        -------
        str
            One line a star, the brightest of the catalogue first; lengths in px, brightness in DN.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_STAR_COLUMNS)
        stars, fitted = self.stars, self.brightness.peak_dn(self.stars.vmag)
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
                [int(stars.hr[k]), stars.name[k], f"{stars.vmag[k]:.2f}"]
                + [f"{number:.4f}" for number in numbers]
                + [int(flag) for flag in flags]
            )
        return text.getvalue()


def calibrate(
    image: SkyImage,
    detected: DetectedStars,
    heavens: Heavens,
    matches: Matches,
    *,
    way: str,
    exposure_s: float,
    criterion: Criterion = "median",
) -> Calibration:
    """Return the calibration of a camera from one photograph whose stars are identified.

    Parameters
    ----------
    image : SkyImage
    detected : DetectedStars
    heavens : Heavens
    matches : Matches
    way : str
        How the stars were identified, in words.
    exposure_s : float
        How long the shutter was open, s.
    criterion : {"median", "paper"}
        How the reference brightness is found.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationError
        If too few stars can be measured.

    Notes
    -----
    Teague & Chahl, section 2.5.
    """
    sensor, fit, stars = fit_sensor(image, detected, heavens, matches, exposure_s=exposure_s, criterion=criterion)
    notes = (*matches.notes, *_doubts_of_places(matches, sensor), *_doubts(detected, sensor, fit, stars))
    return Calibration(image, detected, heavens, matches, sensor, fit, stars, way, notes)


def _doubts_of_places(matches: Matches, sensor: Sensor) -> tuple[str, ...]:
    """Return what a person should know before trusting the camera."""
    notes: tuple[str, ...] = ()
    if not matches.field.camera.can_be_drawn:
        notes = (
            f"the lens sees {np.rad2deg(matches.field.camera.reach_rad):.0f} deg off its axis, and glstar draws up to"
            " 70: sigma and brightness are those on the image; to draw, give the camera of a smaller part of it"
            " (width_px, height_px, cx_px, cy_px)",
        )
    if matches.rms_px <= _MISPLACED_SIGMA * sensor.psf_sigma_px:
        return notes
    lens = matches.field.camera.lens
    kind = "a pinhole" if lens is None else f"such a {lens.model} lens"
    return (
        *notes,
        f"the stars are {matches.rms_px:.2f} px rms from where the camera has them, and with a sigma of"
        f" {sensor.psf_sigma_px:.2f} px they are measured far better: it is not quite {kind}, or the image was smeared;"
        " towards the corners, and where no star was identified, it may be farther off",
    )


def _doubts(detected: DetectedStars, sensor: Sensor, fit: BrightnessFit, stars: MeasuredStars) -> tuple[str, ...]:
    """Return what a person should know before trusting the numbers."""
    notes = []
    if stars.moved:
        notes.append(
            f"the stars moved by up to {stars.longest_trail_px:.1f} px in {sensor.reference_exposure_s:g} s, as the sky"
            " turns: sigma and brightness are those of stars standing still"
        )
    elif detected.drawn_out_px:
        notes.append(
            f"the stars are drawn out by about {detected.drawn_out_px:.1f} px and were taken for round ones: sigma is"
            " that of the blur; hold the camera still, focus, and expose for a shorter time"
        )
    if not fit.linear:
        slope, span = fit.slope_dex_per_mag, stars.vmag[fit.used]
        ends = ", ".join(
            f"{100 * (10 ** ((LIGHT_DEX_PER_MAG - slope) * (m - fit.reference_vmag)) - 1):+.0f} % at {m:.1f} mag"
            for m in (span.min(), span.max())
        )
        notes.append(
            f"brightness falls by {-slope:.2f} decades a magnitude where light falls by {-LIGHT_DEX_PER_MAG:.2f}: the"
            f" image does not answer to light in proportion, but as to a gamma of {slope / LIGHT_DEX_PER_MAG:.2f}"
            f" (JPEG, processing): take raw images; the sensor is right at"
            f" {fit.reference_vmag:.1f} mag, and the simulated peaks are off by {ends}"
        )
    sky = detected.sky
    if sky.unevenness_dn > _UNEVEN * max(sky.std_dn, 1.0):
        notes.append(
            f"the sky is uneven: its level differs by {sky.unevenness_dn:.1f} DN over the image, its noise is"
            f" {sky.std_dn:.1f} DN, and the sensor knows one level only"
        )
    if stars.saturated.mean() > _BURNT_OUT:
        notes.append(
            f"{int(stars.saturated.sum())} of {len(stars)} identified stars are burnt out; a shorter exposure would"
            " tell more, of brightness and of sigma"
        )
    if fit.used.sum() < 10:
        notes.append(f"brightness rests on {int(fit.used.sum())} stars only, {fit.error_mag:.2f} mag uncertain")
    return tuple(notes)


def calibration_toml(head: list[str], sensor: Sensor, field: Field, *, star_brightness: str | None = None) -> str:
    """Return a calibration as TOML: ``[sensor]`` and ``[camera]``.

    Parameters
    ----------
    head : list of str
        What goes before as comments.
    sensor : Sensor
    field : Field
        The camera as the stars say, and what of its lens a pinhole does not tell.
    star_brightness : str, optional
        The file of the stars' own brightness.

    Returns
    -------
    str
    """
    camera = field.camera
    lines = [
        *(f"# {line}" for line in head),
        "",
        "[sensor]",
        *(f"{key} = {toml_value(value)}" for key, value in asdict(sensor).items()),
        *([f"star_brightness = {toml_value(star_brightness)}"] if star_brightness is not None else []),
        "",
        "# The camera that the stars say."
        if camera.lens is not None
        else f"# The pinhole that the stars say; what of its lens is not a pinhole (OpenCV's k1) is {field.bend:.4f}.",
        *(["# Left and right are exchanged on the image."] if field.mirrored else []),
        "[camera]",
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
        *(f"{key} = {toml_value(round(getattr(camera, key), 4))}" for key in ("fx_px", "fy_px", "cx_px", "cy_px")),
        f"skew_px = {toml_value(camera.skew_px)}",
        *(f"{key} = {toml_value(value)}" for key, value in ({} if camera.lens is None else camera.lens.keys).items()),
    ]
    return "\n".join(lines) + "\n"
